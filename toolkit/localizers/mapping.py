"""The map: images with known poses, and points triangulated from matches between them."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from toolkit import geometry
from toolkit.capture import Session
from toolkit.capture.cameras import camera_text, in_view, rays_of, view_bounds
from toolkit.capture.images import default_workers, prefetch, read_image
from toolkit.errors import ArtifactError, ImageError
from toolkit.features.features import LocalFeatures, feature_kind
from toolkit.features.groups import GroupWriter
from toolkit.features.matching import PairMatches, match_along_epipolar_lines, unit_descriptors
from toolkit.features.stores import FeatureStore, MatchStore, group_names, matches_path, write_matches
from toolkit.files import Remade, fingerprint, is_current, temporary_folder, write_sidecar
from toolkit.geometry import Floats, Ints
from toolkit.localizers.local_map import LocalMap
from toolkit.localizers.survey import Survey, SurveyedImages
from toolkit.localizers.tiles import JoinedImages, home_of, join_tiles, plan_tiles
from toolkit.localizers.triangulation import triangulate
from toolkit.manifest import MapSettings
from toolkit.runs.cluster import current_cluster

_ToMatch = tuple[str, str, int, int]
"""A pair to match: group of the file, what the matches are made from, images."""
DEPTHS = (2.0, 4.0, 8.0, 16.0)
"""Depths at which views are compared, "meters"."""
_MAP_FORMAT = 4
"""Raised when the same settings give another file: maps of before are then built anew."""


def select_pairs(
    world_from_cams: Floats,
    cameras: Sequence[pycolmap.Camera],
    groups: Ints,
    per_image: int = 20,
    length: float = 1.0,
) -> Ints:
    """Choose the image pairs of a map that are worth matching, from the poses alone.

    A pair is good if each camera sees what the other sees, under an angle that triangulates well. The depth of each
    view is not known, so points are laid at several depths into it, and the share is counted that the other camera sees
    too, weighted by the angle between the two lines of sight.

    Args:
        world_from_cams: (N, 4, 4).
        cameras: N cameras.
        groups: (N,) images of one group (the cameras of one rig at one instant) are never paired: they have
            next to no baseline.
        per_image: partners an image.
        length: in the unit of the poses, of the "meter" that `DEPTHS` are in; see `Survey.length`.

    Returns:
        (P, 2) indices, i < j, sorted.
    """
    n = len(world_from_cams)
    if n < 2:
        return np.zeros((0, 2), np.int64)
    world_from_cams = geometry.make_pose(world_from_cams[:, :3, :3], world_from_cams[:, :3, 3] / length)
    cams_from_world = geometry.invert(world_from_cams)
    centers = world_from_cams[:, :3, 3]
    bounds = np.stack([view_bounds(camera) for camera in cameras])  # (N, 4)
    tree = KDTree(centers)
    pairs = [np.zeros((0, 2), np.int64)]
    steps = np.linspace(0.1, 0.9, 5)
    for i in range(n):
        # Far away cameras share no view at the depths considered; 200 candidates are plenty for 20 partners.
        _, near = tree.query(centers[i], k=min(n, 200), distance_upper_bound=2 * max(DEPTHS))
        near = near[near < n]
        near = near[(groups[near] != groups[i]) & (near != i)]
        if not len(near):
            continue
        x = bounds[i, 0] + steps * (bounds[i, 1] - bounds[i, 0])
        y = bounds[i, 2] + steps * (bounds[i, 3] - bounds[i, 2])
        rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], -1).reshape(-1, 3)
        points = geometry.transform(world_from_cams[i], (rays * np.asarray(DEPTHS)[:, None, None]).reshape(-1, 3))
        seen = in_view(geometry.transform(cams_from_world[near], points[None]), bounds[near])
        to_i = geometry.unit(centers[i] - points)
        to_j = geometry.unit(centers[near][:, None] - points)
        angle_deg = np.degrees(np.arccos(np.clip((to_j * to_i).sum(-1), -1, 1)))
        # Below 4 degrees depth is poor; beyond 30 descriptors stop matching.
        weight = np.clip(angle_deg / 4, 0.1, 1) * np.clip((60 - angle_deg) / 30, 0, 1)
        scores = (seen * weight).mean(axis=1)
        order = np.argsort(-scores, kind="stable")[:per_image]
        chosen = near[order[scores[order] > 0.02]]
        pairs.append(np.column_stack([np.minimum(i, chosen), np.maximum(i, chosen)]))
    every = np.concatenate(pairs)
    return np.column_stack(np.divmod(np.unique(every[:, 0] * n + every[:, 1]), n))


def instants(session: Session, rows: Ints) -> Ints:
    """Return a number for each image (N,): those that one rig took at one instant have the same."""
    devices = session.images["timestamp"].astype(str) + " " + session.device_ids
    return np.asarray(np.unique(devices.to_numpy(str)[rows], return_inverse=True)[1], np.int64)


def match_pairs(
    pairs: Ints,
    load: Callable[[int], LocalFeatures],
    cameras: Sequence[pycolmap.Camera],
    world_from_cams: Floats,
    max_error_px: float = 4.0,
    ratio: float = 0.9,
    min_score: float = 0.6,
    workers: int = 1,
) -> Iterator[PairMatches]:
    """Match the features of image pairs whose poses are known, along epipolar lines only.

    Args:
        pairs: (Q, 2) indices of images; in sorted order an image's features are read once or twice.
        load: returns the features of an image.
        cameras, world_from_cams: N images, (N, 4, 4).
        max_error_px: largest distance of a match to its epipolar line, at either side.
        ratio: Lowe's ratio, among the candidates along the line.
        min_score: least cosine similarity of a match.
        workers: threads.

    Yields:
        The matches of each pair.
    """
    cams_from_world = geometry.invert(world_from_cams)

    @lru_cache(maxsize=128)  # 1.6 MB an image: memory does not grow with the map
    def prepare(index: int) -> tuple[NDArray[np.float32], Floats]:
        features = load(index)
        return unit_descriptors(features.descriptors), rays_of(cameras[index], features.keypoints)

    def match(pair: Ints) -> PairMatches:
        i, j = int(pair[0]), int(pair[1])
        (descriptors_i, rays_i), (descriptors_j, rays_j) = prepare(i), prepare(j)
        angle_i, angle_j = (max_error_px / cameras[index].mean_focal_length() for index in (i, j))
        j_from_i = cams_from_world[j] @ world_from_cams[i]
        indices = match_along_epipolar_lines(
            descriptors_i, descriptors_j, rays_i, rays_j, j_from_i, angle_i, angle_j, ratio, min_score
        )
        scores = np.einsum("kd,kd->k", descriptors_i[indices[:, 0]], descriptors_j[indices[:, 1]])
        return PairMatches(indices, scores)

    return prefetch(match, pairs, workers)


def map_settings(settings: MapSettings, seed: int) -> dict[str, Any]:
    """Return what a map depends on besides what it is made of; part of fingerprints."""
    return {**settings.model_dump(), "seed": seed, "format": _MAP_FORMAT}


def build_map(
    session: Session,
    features: FeatureStore,
    path: str | Path,
    settings: MapSettings | None = None,
    seed: int = 0,
    skip_existing: bool = True,
    inputs: str = "",
    workers: int = 1,
    metric: bool = True,
) -> LocalMap:
    """Triangulate the map of a session from its poses, or open the one at `path` if it is current.

    A map of more than `settings.tile_images` images is made in tiles. Matches and tiles are kept beside it, so that
    a killed run goes on there, and one after a change matches only the images that have changed.

    Args:
        session: a map session.
        features: local features of its images; images that could not be read are left out.
        path: the `.npz` file of the map.
        settings, seed: how to triangulate.
        skip_existing: reuse the file if it was made from the same features, poses and settings.
        inputs: fingerprint of what the features and poses were made from.
        workers: threads.
        metric: the poses are in meters; else limits are relative to the depth of the scene.

    Raises:
        ArtifactError: no image has both a pose and features.
    """
    settings = settings or MapSettings()
    map_record = {"map": map_settings(settings, seed), "inputs": inputs, "metric": metric}
    if skip_existing and is_current(path, map_record):
        with suppress(ArtifactError):  # torn behind our back: build it anew
            return LocalMap.load(path)
    plan = MapPlan(session, features, Path(path), settings, seed, metric)
    for number in range(len(plan.tiles)):
        plan.match(number, skip_existing, workers)
    plan.build(skip_existing)
    write_sidecar(path, map_record)
    return LocalMap.load(path)


def _match_share(writer: GroupWriter, todo: Sequence[_ToMatch], plan: "MapPlan") -> None:
    plan.match_into(writer, todo, default_workers(), label="")


class MapPlan(Remade):
    """What there is to do for a map: images, pairs of them to match, tiles to triangulate."""

    def __init__(
        self,
        session: Session,
        features: FeatureStore,
        path: Path,
        settings: MapSettings,
        seed: int = 0,
        metric: bool = True,
        length: float | None = None,
    ):
        """See `build_map`; `length` is that of the survey, where it is known."""
        self.session, self.features, self.path, self.settings, self.seed = session, features, path, settings, seed
        names, poses = session.image_names, session.world_from_cam()
        self.rows = np.array(
            [row for row, name in enumerate(names) if name in features and np.isfinite(poses[row]).all()], np.int64
        )
        """(N,) of the session's images, those of the map."""
        if not len(self.rows):
            raise ArtifactError(
                f"Session {session.id} has no image with both a pose and local features; nothing to map."
            )
        self.world_from_cams = poses[self.rows]
        self.names = [names[row] for row in self.rows]
        sensor_ids = session.images["sensor_id"].to_numpy()[self.rows]
        self.cameras = [session.camera(sensor) for sensor in sensor_ids]
        self.kind, self.groups = feature_kind(features.settings.get("name", "sift")), instants(session, self.rows)
        self.length = self.survey.length(metric) if length is None else length
        pairs_per_image = settings.pairs_per_image
        self.pairs = select_pairs(self.world_from_cams, self.cameras, self.groups, pairs_per_image, self.length)
        centers, axes = self.world_from_cams[:, :3, 3], self.world_from_cams[:, :3, 2]
        self.tiles = plan_tiles(centers + DEPTHS[1] * self.length * axes, self.pairs, settings.tile_images)
        self._home = home_of([tile.core for tile in self.tiles])
        order = np.argsort(self._home[self.pairs[:, 0]], kind="stable")
        starts = np.searchsorted(self._home[self.pairs[order, 0]], np.arange(len(self.tiles) + 1))
        self.pairs_of = [self.pairs[np.sort(order[slice(*starts[tile : tile + 2])])] for tile in range(len(self.tiles))]
        """Of each tile the pairs whose first image is in its core."""
        self.matcher: dict[str, Any] = {
            "name": "epipolar",
            "max_error_px": settings.max_epipolar_error_px,
            "ratio": settings.ratio,
            "min_score": self.kind.epipolar_min_score,
        }

    @cached_property
    def survey(self) -> Survey:
        """What some pairs of images tell of the poses."""
        rig_from_cams = self.session.rig_from_cam(self.rows)
        surveyed = SurveyedImages(
            self.names,
            self.cameras,
            self.world_from_cams @ geometry.invert(rig_from_cams),
            rig_from_cams,
            self.groups,
            self.session.images["sensor_id"].to_numpy()[self.rows].tolist(),
        )
        kind = self.kind
        with threadpool_limits(1, "blas"):
            return Survey(surveyed, lambda index: self.features[self.names[index]], kind.min_score, kind.ratio)

    @cached_property
    def of_worker(self) -> Any:
        """This plan for a worker, which need not survey."""
        given = self.session, self.features, self.path, self.settings, self.seed
        return MapPlan.elsewhere(*given, length=self.length)

    @cached_property
    def _made_from(self) -> list[str]:
        """Of each image, what its matches depend on."""
        return [
            fingerprint([self.features.made_from[name], camera_text(camera), pose.tolist()])
            for name, camera, pose in zip(self.names, self.cameras, self.world_from_cams, strict=True)
        ]

    def _matches_made_by(self, number: int) -> dict[str, Any]:
        tile = {"tile": number} if len(self.tiles) > 1 else {}
        return {"features": [self.features.settings] * 2, "matcher": self.matcher, **tile}

    def _matches_path(self, number: int) -> Path:
        return matches_path(self.path.parent, self.session.id, self.session.id, self._matches_made_by(number))

    def match(self, number: int, skip_existing: bool = True, workers: int = 1) -> None:
        """Match the pairs of a tile along epipolar lines, but for those whose matches are there."""
        pairs, names, made_from = self.pairs_of[number].tolist(), self.names, self._made_from
        with GroupWriter(self._matches_path(number), self._matches_made_by(number)) as writer:
            groups = group_names([(names[i], names[j]) for i, j in pairs], writer.index.groups)
            todo = [(groups[names[i], names[j]], made_from[i] + made_from[j], i, j) for i, j in pairs]
            todo = writer.left(todo) if skip_existing else todo
            label = f"match {self.session.id}" + (f" {number + 1}/{len(self.tiles)}" if len(self.tiles) > 1 else "")
            todo = writer.spread(_match_share, todo, (self.of_worker,), label, "pair")
            self.match_into(writer, todo, workers, label if todo else "")
            writer.finish()

    def match_into(self, writer: GroupWriter, todo: Sequence[_ToMatch], workers: int, label: str) -> None:
        """Add the matches of pairs to a file."""
        counts: dict[int, int] = {}

        def load(index: int) -> LocalFeatures:
            found = self.features[self.names[index]]
            counts[index] = len(found)
            return found

        found = match_pairs(
            np.array([pair[2:] for pair in todo], np.int64).reshape(-1, 2),
            load,
            self.cameras,
            self.world_from_cams,
            self.matcher["max_error_px"],
            self.matcher["ratio"],
            self.matcher["min_score"],
            workers,
        )
        bar = tqdm(found, total=len(todo), desc=label, unit="pair", disable=not label)
        for (group, source, i, j), matches in zip(todo, bar, strict=True):
            write_matches(writer, group, source, (counts[i], counts[j]), matches)

    def tile_path(self, number: int) -> Path:
        """Return the file of a tile, a map of its own."""
        return self.path.with_name(f"{self.path.stem}.tiles") / f"{number:05d}.npz"

    def triangulate(self, number: int, skip_existing: bool = True) -> None:
        """Triangulate a tile, whose pairs and those of its neighbors were matched, and write it."""
        images, path = self.tiles[number].images.tolist(), self.tile_path(number)
        record = {
            "map": map_settings(self.settings, self.seed),
            "features": self.features.settings,
            "matcher": self.matcher,
            "length": self.length,
            "images": fingerprint([[self.names[image], self._made_from[image]] for image in images]),
            "core": fingerprint(self.tiles[number].core.tolist()),
            "pairs": fingerprint(self._pairs_in(number).tolist()),
        }
        if not (skip_existing and is_current(path, record)):
            self._triangulated(number).save(path)
            write_sidecar(path, record)

    def _pairs_in(self, number: int) -> Ints:
        """Return the pairs that the images of a tile are among themselves."""
        images = self.tiles[number].images
        pairs = np.concatenate([self.pairs_of[tile] for tile in np.unique(self._home[images])])
        return pairs[np.isin(pairs, images).all(axis=1)]

    def _triangulated(self, number: int) -> LocalMap:
        """Return the points that images of the core of a tile see."""
        core, images = self.tiles[number]
        pairs = self._pairs_in(number)
        stores = {tile: MatchStore(self._matches_path(tile)) for tile in np.unique(self._home[images]).tolist()}
        matches = [stores[self._home[i]][self.names[i], self.names[j]].indices for i, j in pairs]
        poses = self.world_from_cams[images]
        local_map = triangulate(
            [self.names[image] for image in images],
            [self.cameras[image] for image in images],
            geometry.make_pose(poses[:, :3, :3], poses[:, :3, 3] / self.length),
            [self._keypoints(image) for image in images],
            np.searchsorted(images, pairs),
            matches,
            self.settings,
            self.seed,
        ).scaled(self.length)
        local_map = replace(local_map, world_from_cams=poses, length=self.length)
        if len(core) == len(images):
            return local_map
        of_core = np.isin(images[local_map.obs_image], core)
        return local_map.part(np.unique(local_map.obs_point[of_core]))

    def build(self, skip_existing: bool = True) -> None:
        """Triangulate the map, whose pairs were matched, and write it."""
        if len(self.tiles) == 1:
            local_map = self._triangulated(0)
            first = np.unique(local_map.obs_point, return_index=True)[1]
            colors = self._colors(local_map.obs_image[first], local_map.obs_keypoint[first])
            self._save(replace(local_map, colors=colors))
            return
        numbers, label = range(len(self.tiles)), f"triangulate {self.session.id}"
        if cluster := current_cluster():
            shares = [(self.of_worker, number, skip_existing) for number in numbers]
            cluster.run(MapPlan.triangulate, shares, [1] * len(shares), label, "tile")
        else:
            for number in tqdm(numbers, desc=label, unit="tile"):
                self.triangulate(number, skip_existing)
        images = JoinedImages(self.names, self.cameras, self.world_from_cams, self._keypoints, self._colors)
        with temporary_folder(self.path) as folder:
            self._save(
                join_tiles(
                    self.tiles, lambda number: LocalMap.load(self.tile_path(number)), images, self.settings, folder
                )
            )

    def _save(self, local_map: LocalMap) -> None:
        local_map.judged(self.survey.consistency(local_map)).save(self.path)

    def _keypoints(self, image: int) -> NDArray[np.float32]:
        return self.features[self.names[image]].keypoints

    def _colors(self, images: Ints, keypoints: Ints) -> NDArray[np.uint8]:
        """Return the colors (n, 3) at n keypoints of images; gray where an image cannot be read."""
        wanted, which = np.unique(images, return_inverse=True)

        def read(image: int) -> NDArray[np.uint8]:
            at = which == np.searchsorted(wanted, image)
            xy = self._keypoints(image)[keypoints[at]].astype(np.int64)
            try:
                pixels = read_image(self.session.image_path(int(self.rows[image])))
            except ImageError:
                return np.full((len(xy), 3), 128, np.uint8)
            height, width = pixels.shape[:2]
            return pixels[np.clip(xy[:, 1], 0, height - 1), np.clip(xy[:, 0], 0, width - 1)]

        colors = np.full((len(images), 3), 128, np.uint8)
        for number, found in enumerate(prefetch(read, wanted.tolist())):
            colors[which == number] = found
        return colors
