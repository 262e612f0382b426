"""Localize with points that are triangulated for each query from its references, without a map of such features.

The poses of the references are known, so their features are matched along epipolar lines. In addition, if the same
query keypoint matches in two references, their two keypoints match each other, provided that they agree with the poses.
A network can match features with a dark query image that the search along epipolar lines does not match.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from threading import Lock
from types import MappingProxyType

import numpy as np
import pycolmap

from toolkit import geometry
from toolkit.capture import Session
from toolkit.capture.images import rays_of
from toolkit.features.features import KINDS, FeatureKind, LocalFeatures, PairMatches
from toolkit.features.matching import AnyMethod
from toolkit.geometry import Floats, Ints
from toolkit.manifest import MapSettings, PnpSettings
from toolkit.mapping.build import MAX_EPIPOLAR_ERROR_PX, instants, match_pairs, select_pairs
from toolkit.mapping.local_map import LocalMap
from toolkit.mapping.triangulation import triangulate
from toolkit.pose.base import Localizer, NetworkMatches, Prior, Query, QueryResult, References
from toolkit.pose.map_matching import MappedFeatures
from toolkit.pose.pnp import PnpLocalizer, PnpMatches
from toolkit.threads import fixed_sums


@dataclass(frozen=True)
class PosedImages:
    """The N images of a map."""

    names: list[str]
    cameras: list[pycolmap.Camera]
    world_from_cams: Floats
    """(N, 4, 4)."""
    instants: Ints
    """(N,) equal numbers for images that one rig took at one instant; these are never paired."""

    @classmethod
    def of_session(
        cls,
        session: Session,
        names: list[str] | None = None,
        length: float = 1.0,
        refined: Mapping[str, Floats] = MappingProxyType({}),
    ) -> "PosedImages":
        """Return images of a session.

        Args:
            session: the map session.
            names: of the images; None: all images with a pose.
            length: positions are divided by it.
            refined: poses (4, 4) by image name, instead of those of the session.
        """
        rows = session.camera_rows if names is None else np.array([session.row_of_name[name] for name in names], int)
        if names is None:
            rows = rows[np.isfinite(session.world_from_cam(rows)).reshape(-1, 16).all(axis=1)]
        names, poses = [session.image_name(int(row)) for row in rows], session.world_from_cam(rows)
        poses = np.array([refined.get(name, pose) for name, pose in zip(names, poses, strict=True)]).reshape(-1, 4, 4)
        poses[:, :3, 3] /= length
        return cls(names, session.cameras(rows), poses, instants(session, rows))


class OnDemandLocalizer(Localizer):
    """Localizes with triangulated maps of some kinds of features, and for other kinds with points made for each query.

    Safe to use from several threads.
    """

    def __init__(
        self,
        posed: PosedImages,
        mapped: Sequence[MappedFeatures],
        on_demand: Sequence[tuple[AnyMethod, Callable[[str], LocalFeatures]]],
        map_settings: MapSettings | None = None,
        settings: PnpSettings | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            posed: the images of all kinds, in the order of `LocalMap.pooled`.
            mapped: kinds of features with triangulated points. Queries have features of these kinds first.
            on_demand: kinds of features without points, which follow in the queries, and for each a function that
                returns the features of a map image by its name; no features if the image cannot be read.
            map_settings: how points are triangulated.
            settings, seed: as for `PnpLocalizer`.
        """
        self.posed, self.mapped, self.on_demand = posed, list(mapped), list(on_demand)
        self._map_settings, self._settings = map_settings or MapSettings(), settings or PnpSettings()
        self._seed = seed
        self._network = Lock()
        self.image_names = posed.names

    @fixed_sums
    def match(self, query: Query, references: Sequence[References]) -> PnpMatches:
        """Return the matches of a query, with a map that has the points of its references; see `Localizer`."""
        images = np.unique(np.concatenate([np.zeros(0, np.int64), *(retrieved.images for retrieved in references)]))
        names = [self.posed.names[index] for index in images]
        mapped, point_index, first_point = [], [], 0
        for whole in self.mapped:
            index_of = whole.map.index_of  # a kind may lack images whose features could not be extracted
            part, points = whole.map.around(np.array([index_of[name] for name in names if name in index_of], np.int64))
            mapped.append(whole.with_map(part))
            point_index.append(first_point + points)
            first_point += len(whole.map.points)
        stored_matches = query.network_matches or [[None] * len(self.mapped) for _ in query.views]
        matches = [list(of_camera[: len(self.mapped)]) for of_camera in stored_matches]
        for number, (method, source) in enumerate(self.on_demand, start=len(self.mapped)):
            features = {name: source(name) for name in names}
            new_matches = self._match(query, references, features, method, number)
            local_map = self.triangulate(images, features, new_matches, KINDS[method.name])
            mapped.append(MappedFeatures(local_map, features, method.name, method.matcher))
            point_index.append(np.full(len(local_map.points), -1))  # these points are in no map file
            for of_camera, of_kind in zip(matches, new_matches, strict=True):
                of_camera.append(of_kind.__getitem__)
        localizer, stored = PnpLocalizer(mapped, self._settings, self._seed), np.concatenate(point_index)
        return PnpMatches(replace(query, network_matches=matches), references, localizer, stored)

    @fixed_sums
    def solve(self, matches: PnpMatches, prediction: None = None, priors: Sequence[Prior] = ()) -> QueryResult:
        """Return one pose for the cameras of a rig, or for a single camera; see `Localizer`."""
        result = matches.localizer.solve(matches, prediction, priors)
        assert matches.point_index is not None
        used = result.correspondences
        return replace(result, correspondences=replace(used, point_index=matches.point_index[used.point_index]))

    def _match(
        self,
        query: Query,
        references: Sequence[References],
        features: Mapping[str, LocalFeatures],
        method: AnyMethod,
        number: int,
    ) -> list[dict[str, PairMatches]]:
        """Return for each query image its matches with its references, by name, of the kind with the given number."""
        to_match: dict[tuple[int, str], tuple[LocalFeatures, LocalFeatures]] = {}
        matches: list[dict[str, PairMatches]] = [{} for _ in query.views]
        for camera, (query_features, retrieved) in enumerate(zip(query.features, references, strict=True)):
            if isinstance(query_features, str):
                continue  # no matches of an unreadable image are stored
            known: NetworkMatches = dict[str, PairMatches]().__getitem__
            if query.network_matches:
                known = query.network_matches[camera][number] or known
            for name in (self.posed.names[index] for index in retrieved.images):
                if not len(features[name]):  # matches of its earlier content may still be stored
                    matches[camera][name] = PairMatches.none()
                    continue
                try:
                    matches[camera][name] = known(name)
                except KeyError:  # not asked before
                    to_match[camera, name] = query_features[number], features[name]
        with self._network:
            new_matches = method.matcher.match(list(to_match.values()))
        for (camera, name), pair_matches in zip(to_match, new_matches, strict=True):
            matches[camera][name] = pair_matches
        return matches

    def triangulate(
        self,
        images: Ints,
        features: Mapping[str, LocalFeatures],
        query_matches: Sequence[Mapping[str, PairMatches]],
        kind: FeatureKind,
    ) -> LocalMap:
        """Triangulate the points that some of the images see; return a map of all images with these points.

        Args:
            images: (n,) indices of these images, ascending.
            features: their features, by name.
            query_matches: for each query image, its matches with some of these images, by name.
            kind: entry of the features in `KINDS`.
        """
        posed, settings = self.posed, self._map_settings
        names = [posed.names[index] for index in images]
        cameras, poses = [posed.cameras[index] for index in images], posed.world_from_cams[images]
        loaded = [features[name] for name in names]
        pairs = select_pairs(poses, cameras, posed.instants[images], settings.pairs_per_image)
        along_lines = match_pairs(pairs, loaded.__getitem__, cameras, poses, kind=kind)
        matches = {(int(i), int(j)): pair.indices for (i, j), pair in zip(pairs, along_lines, strict=True)}
        number_of = {name: number for number, name in enumerate(names)}
        for of_image in query_matches:
            matched = sorted((number_of[name], pair.indices) for name, pair in of_image.items() if name in number_of)
            for (i, with_i), (j, with_j) in combinations(matched, 2):
                if posed.instants[images[i]] == posed.instants[images[j]]:
                    continue
                _, at_i, at_j = np.intersect1d(with_i[:, 0], with_j[:, 0], assume_unique=True, return_indices=True)
                through_query = np.column_stack([with_i[at_i, 1], with_j[at_j, 1]])
                in_i = cameras[i], poses[i], loaded[i].keypoints[through_query[:, 0]]
                in_j = cameras[j], poses[j], loaded[j].keypoints[through_query[:, 1]]
                errors_px = np.maximum(_epipolar_errors_px(*in_i, *in_j), _epipolar_errors_px(*in_j, *in_i))
                earlier = matches.get((i, j), np.zeros((0, 2), np.int64))
                # A keypoint has one partner in an image: the first one found.
                new = errors_px < MAX_EPIPOLAR_ERROR_PX
                new &= ~np.isin(through_query[:, 0], earlier[:, 0]) & ~np.isin(through_query[:, 1], earlier[:, 1])
                matches[i, j] = np.concatenate([earlier, through_query[new]])
        ordered = sorted(matches)
        keypoints, numbers = [image.keypoints for image in loaded], np.array(ordered, np.int64).reshape(-1, 2)
        along_pairs = [matches[pair] for pair in ordered]
        local_map = triangulate(names, cameras, poses, keypoints, numbers, along_pairs, settings, self._seed)
        return replace(
            local_map,
            image_names=posed.names,
            cameras=posed.cameras,
            world_from_cams=posed.world_from_cams,
            obs_image=images[local_map.obs_image],
        )


def _epipolar_errors_px(
    camera_a: pycolmap.Camera,
    world_from_a: Floats,
    pixels_a: Floats,
    camera_b: pycolmap.Camera,
    world_from_b: Floats,
    pixels_b: Floats,
) -> Floats:
    """Return the distances (K,) of pixels (K, 2) of image b from the epipolar lines of pixels of image a, pixels.

    They are inf if there is no baseline.
    """
    b_from_a = geometry.invert(world_from_b) @ world_from_a
    normals = np.cross(b_from_a[:3, 3], rays_of(camera_a, pixels_a) @ b_from_a[:3, :3].T)
    lengths = np.linalg.norm(normals, axis=1)
    sines = np.abs((normals * rays_of(camera_b, pixels_b)).sum(axis=1)) / np.maximum(lengths, 1e-12)
    return np.where(lengths > 1e-6, sines * camera_b.mean_focal_length(), np.inf)
