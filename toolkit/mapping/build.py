"""Build a map: choose pairs of posed images, match them, and triangulate points from the matches."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree
from tqdm.auto import tqdm

from toolkit import geometry
from toolkit.capture import Session
from toolkit.capture.images import camera_text, default_workers, in_view, prefetch, rays_of, read_image, view_bounds
from toolkit.errors import ArtifactError, ImageError
from toolkit.features.features import (
    KINDS,
    FeatureKind,
    LocalFeatures,
    PairMatches,
    feature_kind,
    shorten_settings,
    unit_descriptors,
)
from toolkit.features.matching import match_along_epipolar_lines
from toolkit.features.stores import FeatureStore, MatchStore, match_name, matches_path, write_matches
from toolkit.files import Remade, fingerprint, is_current, temporary_folder, write_sidecar
from toolkit.geometry import Floats, Ints
from toolkit.manifest import MapSettings
from toolkit.mapping.local_map import LocalMap
from toolkit.mapping.pose_consistency import MapImages, PoseConsistency
from toolkit.mapping.pose_noise import refined_poses
from toolkit.mapping.triangulation import (
    MAX_REPROJECTION_ERROR_PX,
    JoinedImages,
    home_of,
    join_tiles,
    plan_tiles,
    triangulate,
)
from toolkit.runs.cluster import current_cluster
from toolkit.store.items import Items
from toolkit.threads import fixed_sums

_ToMatch = tuple[str, str, int, int]
"""A pair to match: name of its item, fingerprint of the inputs of the matches, indices of the two images."""
DEPTHS = (2.0, 4.0, 8.0, 16.0)
"""Depths at which the views of two images are compared, in map lengths (meters; see `PoseConsistency.length`)."""
MAX_EPIPOLAR_ERROR_PX = 4.0  # largest distance of a match from its epipolar line, on either side, pixels
RATIO = 0.9  # threshold of Lowe's ratio test among the candidates along the epipolar line
MAX_REFINEMENTS = 3  # rounds of bundle adjustment
MIN_NOISE_PX = 1.0  # noise of the direction to points of the map, pixels, from which poses are refined
NOISE_LIMIT = 4.0  # limits of a map whose poses are refined, in multiples of the noise of the direction to its points
_MAP_FORMAT = 8  # increase when the same settings give another file, so that existing maps are built again


def select_pairs(
    world_from_cams: Floats, cameras: Sequence[pycolmap.Camera], groups: Ints, per_image: int = 20, length: float = 1.0,
) -> Ints:  # fmt: skip
    """Choose the image pairs of a map that are worth matching, from the poses alone.

    A pair is good if the cameras see the same part of the scene at an angle that triangulates well. The depth of the
    scene is unknown, so each image is given hypothetical points at several depths. The score of a pair is the share of
    these points that the other camera sees too, weighted by the triangulation angle.

    Args:
        world_from_cams: (N, 4, 4).
        cameras: N cameras.
        groups: (N,) images of one group (the cameras of one rig at one instant) are never paired, because they have
            almost no baseline.
        per_image: largest number of partners per image.
        length: unit of `DEPTHS`, in the unit of the poses; see `PoseConsistency.length`.

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
        # Distant cameras share no view at these depths; 200 candidates are plenty for 20 partners.
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
        # Below 4 degrees, depth is uncertain; beyond 30 degrees, descriptors match less and less.
        weight = np.clip(angle_deg / 4, 0.1, 1) * np.clip((60 - angle_deg) / 30, 0, 1)
        scores = (seen * weight).mean(axis=1)
        order = np.argsort(-scores, kind="stable")[:per_image]
        chosen = near[order[scores[order] > 0.02]]
        pairs.append(np.column_stack([np.minimum(i, chosen), np.maximum(i, chosen)]))
    return np.column_stack(geometry.unique_columns(np.concatenate(pairs).T))


def instants(session: Session, rows: Ints) -> Ints:
    """Return a number (N,) per image, equal for images that one rig took at one instant."""
    devices = session.images["timestamp"].astype(str) + " " + session.device_ids
    return np.asarray(np.unique(devices.to_numpy(str)[rows], return_inverse=True)[1], np.int64)


def match_pairs(
    pairs: Ints, load: Callable[[int], LocalFeatures], cameras: Sequence[pycolmap.Camera], world_from_cams: Floats,
    max_error_px: float = MAX_EPIPOLAR_ERROR_PX, kind: FeatureKind = KINDS["sift"], workers: int = 1,
) -> Iterator[PairMatches]:  # fmt: skip
    """Match the features of image pairs with known poses along epipolar lines.

    Args:
        pairs: (Q, 2) indices of images; if they are sorted, an image's features are read only once or twice.
        load: returns the features of an image.
        cameras, world_from_cams: cameras and poses (N, 4, 4) of the N images.
        max_error_px: largest distance of a match from its epipolar line, in both images.
        kind: entry of the features in `KINDS`.
        workers: threads.

    Yields:
        The matches of each pair.
    """
    cams_from_world = geometry.invert(world_from_cams)

    @lru_cache(maxsize=128)  # about 1 MB of SIFT an image: memory does not grow with the map
    def prepare(index: int) -> tuple[NDArray[np.float32], Floats]:
        features = load(index)
        return unit_descriptors(features.descriptors, kind.shorten), rays_of(cameras[index], features.keypoints)

    def match(pair: Ints) -> PairMatches:
        i, j = int(pair[0]), int(pair[1])
        (descriptors_i, rays_i), (descriptors_j, rays_j) = prepare(i), prepare(j)
        angle_i, angle_j = (max_error_px / cameras[index].mean_focal_length() for index in (i, j))
        j_from_i = cams_from_world[j] @ world_from_cams[i]
        indices = match_along_epipolar_lines(
            descriptors_i, descriptors_j, rays_i, rays_j, j_from_i, angle_i, angle_j, RATIO, kind.epipolar_min_score
        )
        if not len(indices):  # empty descriptors may have another length
            return PairMatches.none()
        scores = np.einsum("kd,kd->k", descriptors_i[indices[:, 0]], descriptors_j[indices[:, 1]])
        return PairMatches(indices, scores)

    return prefetch(match, pairs, workers)


def map_settings(settings: MapSettings, seed: int) -> dict[str, Any]:
    """Return everything that a map depends on except its inputs; part of fingerprints."""
    return {**settings.model_dump(), "seed": seed, "format": _MAP_FORMAT}


def _matcher_settings(kind: FeatureKind, max_error_px: float = MAX_EPIPOLAR_ERROR_PX) -> dict[str, Any]:
    """Return everything that the matches of map images depend on besides features and poses."""
    return {
        "name": "epipolar",
        "max_error_px": max_error_px,
        "ratio": RATIO,
        "min_score": kind.epipolar_min_score,
        **shorten_settings(kind.shorten),
    }


def _kind_of(features: FeatureStore) -> FeatureKind:
    """Return the kind of stored features; other tools do not record it."""
    return feature_kind(features.settings.get("name", "sift"))


@fixed_sums
def build_map(
    session: Session, features: FeatureStore, path: str | Path, settings: MapSettings | None = None, seed: int = 0,
    skip_existing: bool = True, inputs: str = "", workers: int = 1, metric: bool = True,
    poses: Mapping[str, Floats] | None = None,
) -> LocalMap:  # fmt: skip
    """Triangulate the map of a session with its known poses, or open the one at `path` if it is current.

    A map of more than `settings.tile_images` images is built in tiles. Matches and tiles are stored beside it, so a
    killed run resumes there, and a run after a change matches only the images that changed.

    Args:
        session: a map session.
        features: local features of its images; images without features are left out.
        path: the `.npz` file of the map.
        settings, seed: how to triangulate.
        skip_existing: reuse the file if it was made from the same features, poses and settings.
        inputs: fingerprint of the inputs of the features and poses.
        workers: threads.
        metric: whether the poses are in meters; if not, limits are relative to the depth of the scene.
        poses: world_from_cam (4, 4) by image name, instead of those of the session.

    Raises:
        ArtifactError: no image has both a pose and features.
    """
    settings = settings or MapSettings()
    map_record = {
        "map": map_settings(settings, seed),
        "matcher": _matcher_settings(_kind_of(features)),
        "inputs": inputs,
        "metric": metric,
        "poses": fingerprint({name: pose.tolist() for name, pose in poses.items()}) if poses else "",
    }
    if skip_existing and is_current(path, map_record):
        with suppress(ArtifactError):  # the file is damaged: build it again
            return LocalMap.load(path)
    plan = MapPlan(session, features, Path(path), settings, seed, metric, poses=poses)
    if settings.refine_poses and poses is None:
        plan = _refined(plan, workers)
    for number in range(len(plan.tiles)):
        plan.match(number, skip_existing, workers)
    plan.build(skip_existing)
    write_sidecar(path, map_record)
    return LocalMap.load(path)


def _refined(given: "MapPlan", workers: int) -> "MapPlan":
    """Return the plan of a map with poses refined by bundle adjustment; the given plan if its poses are good.

    Each round matches and triangulates with limits as wide as the remaining noise asks for.
    """
    plan, depth = given, given.pose_consistency.typical_depth() / given.length
    focal_px = float(np.median([camera.mean_focal_length() for camera in given.cameras]))
    for _ in range(MAX_REFINEMENTS):
        noise = plan.pose_consistency.pairs.noise(plan.length)
        noise_px = np.radians(noise.direction_deg(depth)) * focal_px
        if plan is given and noise_px < MIN_NOISE_PX:
            break
        settings = given.settings.model_copy(update={"tile_images": len(given.names)})
        with temporary_folder(given.path) as folder:
            path = folder / given.path.name
            wide = given.with_poses(plan.world_from_cams, path, settings, NOISE_LIMIT * noise_px)
            wide.match(0, False, workers)
            local_map = wide.triangulated(0)
            if plan is given and not given.pose_consistency.judge(local_map).trusted:
                break  # it would bend the map to intrinsics that are wrong
            keypoints = [wide.keypoints(image) for image in range(len(wide.names))]
            poses = refined_poses(local_map, keypoints, noise, workers)
        plan = given.with_poses(poses, given.path, given.settings)
    return plan


def _match_share(items: Items, todo: Sequence[_ToMatch], plan: "MapPlan") -> None:
    plan.match_into(items, todo, default_workers(), label="")


class MapPlan(Remade):
    """The work of building a map: its images, the pairs to match, and the tiles to triangulate."""

    def __init__(
        self, session: Session, features: FeatureStore, path: Path, settings: MapSettings, seed: int = 0,
        metric: bool = True, length: float | None = None, poses: Mapping[str, Floats] | None = None,
        min_limit_px: float = 0.0,
    ):  # fmt: skip
        """See `build_map`; `length` is that of `pose_consistency` if it is known, which saves the matching.

        Limits of errors in pixels are at least `min_limit_px`.
        """
        self.session, self.features, self.path, self.settings, self.seed = session, features, path, settings, seed
        names, world_from_cams = session.image_names, session.world_from_cam()
        self._poses, self._min_limit_px = poses, min_limit_px
        for name, pose in (poses or {}).items():
            world_from_cams[session.row_of_name[name]] = pose
        posed = np.isfinite(world_from_cams).reshape(-1, 16).all(axis=1)
        self.rows = np.flatnonzero(posed & np.array([name in features for name in names], bool))
        """(N,) rows of the map images in the session."""
        if not len(self.rows):
            raise ArtifactError(f"{session.id} has no image with a pose and local features: no map can be built.")
        self.world_from_cams = world_from_cams[self.rows]
        self.names = [names[row] for row in self.rows]
        self.cameras = session.cameras(self.rows)
        self.kind, self.groups = _kind_of(features), instants(session, self.rows)
        self.length = self.pose_consistency.length(metric) if length is None else length
        pairs_per_image = settings.pairs_per_image
        self.pairs = select_pairs(self.world_from_cams, self.cameras, self.groups, pairs_per_image, self.length)
        centers, axes = self.world_from_cams[:, :3, 3], self.world_from_cams[:, :3, 2]
        self.tiles = plan_tiles(centers + DEPTHS[1] * self.length * axes, self.pairs, settings.tile_images)
        self._home = home_of([tile.core for tile in self.tiles])
        order = np.argsort(self._home[self.pairs[:, 0]], kind="stable")
        starts = np.searchsorted(self._home[self.pairs[order, 0]], np.arange(len(self.tiles) + 1))
        self.pairs_of = [self.pairs[np.sort(order[slice(*starts[tile : tile + 2])])] for tile in range(len(self.tiles))]
        """For each tile, the pairs whose first image is in its core."""
        self.keypoints = lru_cache(maxsize=512)(lambda image: self._features_of(image).keypoints)
        self.matcher = _matcher_settings(self.kind, max(MAX_EPIPOLAR_ERROR_PX, min_limit_px))

    @cached_property
    def pose_consistency(self) -> PoseConsistency:
        """The check of the poses, from a sample of image pairs."""
        rig_from_cams = self.session.rig_from_cam(self.rows)
        world_from_rigs = self.world_from_cams @ geometry.invert(rig_from_cams)
        sensors = self.session.images["sensor_id"].to_numpy()[self.rows].tolist()
        images = MapImages(self.names, self.cameras, world_from_rigs, rig_from_cams, self.groups, sensors)
        return PoseConsistency(images, self._features_of, self.kind)

    @cached_property
    def of_worker(self) -> Any:
        """This plan for a worker, which gets the length and so matches no sample."""
        more = {"length": self.length, "poses": self._poses, "min_limit_px": self._min_limit_px}
        return MapPlan.elsewhere(self.session, self.features, self.path, self.settings, self.seed, **more)

    def with_poses(
        self, world_from_cams: Floats, path: Path, settings: MapSettings, min_limit_px: float = 0.0
    ) -> "MapPlan":
        """Return the plan of the same map with other poses (N, 4, 4) of its images, file and settings."""
        more: dict[str, Any] = {"length": self.length, "min_limit_px": min_limit_px}
        more["poses"] = dict(zip(self.names, world_from_cams, strict=True))
        plan = MapPlan(self.session, self.features, path, settings, self.seed, **more)
        plan.pose_consistency = self.pose_consistency.with_poses(world_from_cams)
        return plan

    @cached_property
    def _made_from(self) -> list[str]:
        """For each image, a fingerprint of everything that its matches depend on."""
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
        """Match the pairs of a tile along epipolar lines; skip pairs that are matched already."""
        pairs, names, made_from = self.pairs_of[number].tolist(), self.names, self._made_from
        with Items(self._matches_path(number), self._matches_made_by(number), skip_existing=skip_existing) as items:
            todo = items.left((match_name(names[i], names[j]), made_from[i] + made_from[j], i, j) for i, j in pairs)
            label = f"match {self.session.id}" + (f" {number + 1}/{len(self.tiles)}" if len(self.tiles) > 1 else "")
            todo = items.distribute(_match_share, todo, (self.of_worker,), label, "pair")
            self.match_into(items, todo, workers, label if todo else "")

    def match_into(self, items: Items, todo: Sequence[_ToMatch], workers: int, label: str) -> None:
        """Add the matches of pairs to a folder."""
        pairs = np.array([pair[2:] for pair in todo], np.int64).reshape(-1, 2)
        poses, max_error_px = self.world_from_cams, self.matcher["max_error_px"]
        matches = match_pairs(pairs, self._features_of, self.cameras, poses, max_error_px, self.kind, workers)
        bar = tqdm(matches, total=len(todo), desc=label, unit="pair", disable=not label)
        for (name, source, _, _), matched in zip(todo, bar, strict=True):
            write_matches(items, name, source, matched)

    def tile_path(self, number: int) -> Path:
        """Return the file of a tile, which is a map of its own."""
        return self.path.with_name(f"{self.path.stem}.tiles") / f"{number:05d}.npz"

    def triangulate(self, number: int, skip_existing: bool = True) -> None:
        """Triangulate a tile and write it; its pairs and those of its neighbors must be matched."""
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
            self.triangulated(number).save(path)
            write_sidecar(path, record)

    def _pairs_in(self, number: int) -> Ints:
        """Return the pairs whose images are both in a tile."""
        images = self.tiles[number].images
        pairs = np.concatenate([self.pairs_of[tile] for tile in np.unique(self._home[images])])
        return pairs[np.isin(pairs, images).all(axis=1)]

    def triangulated(self, number: int) -> LocalMap:
        """Return the map of a tile, with the points that images of its core see."""
        core, images = self.tiles[number]
        pairs = self._pairs_in(number)
        stores = {tile: MatchStore(self._matches_path(tile)) for tile in np.unique(self._home[images]).tolist()}

        poses = self.world_from_cams[images]
        # In the unit of the poses: divided by the length, a shift by whole hundreds would no longer be one.
        origin = geometry.local_origin(self.world_from_cams[:, :3, 3])
        local_map = triangulate(
            [self.names[image] for image in images],
            [self.cameras[image] for image in images],
            geometry.make_pose(poses[:, :3, :3], (poses[:, :3, 3] - origin) / self.length),
            [self.keypoints(image) for image in images],
            np.searchsorted(images, pairs),
            [stores[self._home[i]][self.names[i], self.names[j]].indices for i, j in pairs.tolist()],
            self.settings,
            self.seed,
            max(MAX_REPROJECTION_ERROR_PX, self._min_limit_px),
        ).scaled(self.length)
        points = local_map.points + origin
        local_map = replace(local_map, world_from_cams=poses, points=points, length=self.length)
        if len(core) == len(images):
            return local_map
        in_core = np.isin(images[local_map.obs_image], core)
        return local_map.part(np.unique(local_map.obs_point[in_core]))

    def build(self, skip_existing: bool = True) -> None:
        """Triangulate the map and write it; all pairs must be matched."""
        if len(self.tiles) == 1:
            local_map = self.triangulated(0)
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
        images = JoinedImages(self.names, self.cameras, self.world_from_cams, self.keypoints, self._colors)
        with temporary_folder(self.path) as folder:
            self._save(join_tiles(self.tiles, lambda number: LocalMap.load(self.tile_path(number)), images, folder))

    def _save(self, local_map: LocalMap) -> None:
        local_map.judged(self.pose_consistency.judge(local_map)).save(self.path)

    def _features_of(self, image: int) -> LocalFeatures:
        return self.features[self.names[image]]

    def _colors(self, images: Ints, keypoints: Ints) -> NDArray[np.uint8]:
        """Return the colors (n, 3) at n keypoints of images; gray where an image cannot be read."""
        wanted, which = np.unique(images, return_inverse=True)

        def read(image: int) -> NDArray[np.uint8]:
            in_image = which == np.searchsorted(wanted, image)
            xy = self.keypoints(image)[keypoints[in_image]].astype(np.int64)
            try:
                pixels = read_image(self.session.image_path(int(self.rows[image])))
            except ImageError:
                return np.full((len(xy), 3), 128, np.uint8)
            height, width = pixels.shape[:2]
            return pixels[np.clip(xy[:, 1], 0, height - 1), np.clip(xy[:, 0], 0, width - 1)]

        colors = np.full((len(images), 3), 128, np.uint8)
        for number, image_colors in enumerate(prefetch(read, wanted.tolist())):
            colors[which == number] = image_colors
        return colors
