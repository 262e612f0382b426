"""Points that are triangulated for one query, from its references alone: no map of such features is needed before.

The poses of the references are known. So their features are matched along epipolar lines. And where two references
show the same keypoint of the query, that is a match of the two as well, if it agrees with their poses: what a network
matches with a dark photograph, it need not find along a line.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from threading import Lock

import numpy as np
import pycolmap

from toolkit import geometry
from toolkit.capture import Session
from toolkit.capture.cameras import rays_of
from toolkit.features.features import KINDS, LocalFeatures
from toolkit.features.matching import AnyMethod, PairMatches
from toolkit.geometry import Floats, Ints
from toolkit.localizers.base import NetworkMatches, PoseEstimate, Prior, Query, QueryInput, References
from toolkit.localizers.local_map import LocalMap
from toolkit.localizers.mapping import instants, match_pairs, select_pairs
from toolkit.localizers.matches import MappedFeatures
from toolkit.localizers.pnp import PnpLocalizer
from toolkit.localizers.triangulation import triangulate
from toolkit.manifest import MapSettings, PnpSettings

FeatureSource = Callable[[str], LocalFeatures]
"""Returns the features of a map image, by its name; none where it cannot be read."""


@dataclass(frozen=True)
class PosedImages:
    """The N images of a map."""

    names: list[str]
    cameras: list[pycolmap.Camera]
    world_from_cams: Floats
    """(N, 4, 4)."""
    instants: Ints
    """(N,) images that one rig took at one instant have the same number; they are not paired."""

    @classmethod
    def of_session(cls, session: Session, names: list[str] | None = None, length: float = 1.0) -> "PosedImages":
        """Return images of a session, by name; None: all camera images with a pose. Lengths are divided by `length`."""
        if names is None:
            rows = session.camera_rows
            rows = rows[np.isfinite(session.world_from_cam(rows)).reshape(-1, 16).all(axis=1)]
            names = [session.image_name(int(row)) for row in rows]
        else:
            rows = np.array([session.row_of_name[name] for name in names], np.int64)
        cameras = [session.camera(sensor) for sensor in session.images["sensor_id"].to_numpy()[rows]]
        poses = session.world_from_cam(rows)
        poses[:, :3, 3] /= length
        return cls(names, cameras, poses, instants(session, rows))


class OnDemandLocalizer:
    """Localizes with maps of some kinds of features, and with points of other kinds that are made for each query.

    Safe to use from several threads.
    """

    batch_size = 1

    def __init__(
        self,
        posed: PosedImages,
        mapped: Sequence[MappedFeatures],
        on_demand: Sequence[tuple[AnyMethod, FeatureSource]],
        map_settings: MapSettings | None = None,
        settings: PnpSettings | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            posed: the map's images; those of `mapped`, in their order.
            mapped: kinds of features with triangulated points. A query's features are of these, then of `on_demand`.
            on_demand: the other kinds.
            map_settings: how points are triangulated.
            settings, seed: as of `PnpLocalizer`.
        """
        self.posed, self.mapped, self.on_demand = posed, list(mapped), list(on_demand)
        self._map_settings, self._settings = map_settings or MapSettings(), settings or PnpSettings()
        self._seed = seed
        self._network = Lock()
        self.image_names = posed.names

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[None]:
        """Return nothing for each query: no network is asked for cameras."""
        return [None] * len(queries)

    def localize(
        self, query: Query, references: Sequence[References], prediction: None = None, priors: Sequence[Prior] = ()
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; see `Localizer`."""
        images = np.unique(np.concatenate([np.zeros(0, np.int64), *(part.images for part in references)]))
        mapped, point_index, before = [], [], 0
        for whole in self.mapped:
            part, points = whole.map.around(images)
            mapped.append(MappedFeatures(part, whole.features, whole.kind, whole.matcher, whole.name))
            point_index.append(before + points)
            before += len(whole.map.points)
        given = query.network_matches or [[None] * (len(self.mapped) + len(self.on_demand)) for _ in query.views]
        matches = [list(of_camera[: len(self.mapped)]) for of_camera in given]
        for number, (method, source) in enumerate(self.on_demand, start=len(self.mapped)):
            features = {self.posed.names[index]: source(self.posed.names[index]) for index in images}
            found = self._match(query, references, features, method, number)
            made = self.triangulate(images, features, found, KINDS[method.name].epipolar_min_score)
            mapped.append(MappedFeatures(made, features, KINDS[method.name], method.matcher, method.name))
            point_index.append(np.full(len(made.points), -1))  # they are in no file
            for of_camera, of_kind in zip(matches, found, strict=True):
                of_camera.append(of_kind.__getitem__)
        estimate = PnpLocalizer(mapped, self._settings, self._seed).localize(
            replace(query, network_matches=matches), references, None, priors
        )
        used = estimate.correspondences
        index = np.concatenate([np.zeros(0, np.int64), *point_index])[used.point_index]
        return replace(estimate, correspondences=replace(used, point_index=index))

    def _match(
        self,
        query: Query,
        references: Sequence[References],
        features: Mapping[str, LocalFeatures],
        method: AnyMethod,
        number: int,
    ) -> list[dict[str, PairMatches]]:
        """Return for each query image its matches with its references of one kind, that with the given number."""
        pairs: list[tuple[int, str]] = []
        to_match: list[tuple[LocalFeatures, LocalFeatures]] = []
        found: list[dict[str, PairMatches]] = [{} for _ in query.views]
        for camera, (of_image, retrieved) in enumerate(zip(query.features, references, strict=True)):
            names = [self.posed.names[index] for index in retrieved.images]
            before: NetworkMatches | None = query.network_matches[camera][number] if query.network_matches else None
            if before is not None:
                # What could not be read has no matches, not even none.
                found[camera] = {name: before(name) if len(features[name]) else PairMatches.none() for name in names}
            elif not isinstance(of_image, str):
                pairs += [(camera, name) for name in names]
                to_match += [(of_image[number], features[name]) for name in names]
        with self._network:
            matched = method.matcher.match(to_match)
        for (camera, name), matches in zip(pairs, matched, strict=True):
            found[camera][name] = matches
        return found

    def triangulate(
        self,
        images: Ints,
        features: Mapping[str, LocalFeatures],
        query_matches: Sequence[Mapping[str, PairMatches]],
        min_score: float,
    ) -> LocalMap:
        """Return a map of all images with the points that some of them see.

        Args:
            images: (n,) indices, ascending.
            features: of them, by name.
            query_matches: of each query image its matches with some of them, by name.
            min_score: least cosine similarity of a match along an epipolar line.
        """
        posed, settings = self.posed, self._map_settings
        names = [posed.names[index] for index in images]
        cameras, poses = [posed.cameras[index] for index in images], posed.world_from_cams[images]
        loaded = [features[name] for name in names]
        pairs = select_pairs(poses, cameras, posed.instants[images], settings.pairs_per_image)
        along_lines = match_pairs(
            pairs, loaded.__getitem__, cameras, poses, settings.max_epipolar_error_px, settings.ratio, min_score
        )
        matches = {(int(i), int(j)): found.indices for (i, j), found in zip(pairs, along_lines, strict=True)}
        place = {name: index for index, name in enumerate(names)}
        for of_image in query_matches:
            seen = sorted((place[name], found.indices) for name, found in of_image.items() if name in place)
            for (i, of_i), (j, of_j) in combinations(seen, 2):
                if posed.instants[images[i]] == posed.instants[images[j]]:
                    continue
                _, at_i, at_j = np.intersect1d(of_i[:, 0], of_j[:, 0], assume_unique=True, return_indices=True)
                through = np.column_stack([of_i[at_i, 1], of_j[at_j, 1]])
                errors = [
                    _epipolar_errors_px(
                        (cameras[a], cameras[b]),
                        geometry.invert(poses[b]) @ poses[a],
                        loaded[a].keypoints[through[:, first]],
                        loaded[b].keypoints[through[:, 1 - first]],
                    )
                    for a, b, first in ((i, j, 0), (j, i, 1))
                ]
                before = matches.get((i, j), np.zeros((0, 2), np.int64))
                # A keypoint has one partner in an image: the one that was found first.
                new = np.max(errors, axis=0) < settings.max_epipolar_error_px
                new &= ~np.isin(through[:, 0], before[:, 0]) & ~np.isin(through[:, 1], before[:, 1])
                matches[i, j] = np.concatenate([before, through[new]])
        ordered = sorted(matches)
        made = triangulate(
            names,
            cameras,
            poses,
            [of_image.keypoints for of_image in loaded],
            np.array(ordered, np.int64).reshape(-1, 2),
            [matches[pair] for pair in ordered],
            settings,
            self._seed,
        )
        return replace(
            made,
            image_names=posed.names,
            cameras=posed.cameras,
            world_from_cams=posed.world_from_cams,
            obs_image=images[made.obs_image],
        )


def _epipolar_errors_px(
    cameras: tuple[pycolmap.Camera, pycolmap.Camera], b_from_a: Floats, pixels_a: Floats, pixels_b: Floats
) -> Floats:
    """Return how far pixels (K, 2) of image b are from the epipolar lines of pixels of image a, pixels; inf where both
    cameras share one place."""
    baseline = b_from_a[:3, 3]
    normals = np.cross(baseline, rays_of(cameras[0], pixels_a) @ b_from_a[:3, :3].T)
    lengths = np.linalg.norm(normals, axis=1)
    sines = np.abs((normals * rays_of(cameras[1], pixels_b)).sum(axis=1)) / np.maximum(lengths, 1e-12)
    return np.where(lengths > 1e-6, sines * cameras[1].mean_focal_length(), np.inf)
