"""The map: images with known poses, and points triangulated from matches between them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
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
from toolkit.capture.cameras import camera_text, in_view, projection_jacobian, rays_of, view_bounds
from toolkit.capture.images import prefetch, read_image
from toolkit.errors import ArtifactError, ImageError
from toolkit.features.features import LocalFeatures, feature_kind
from toolkit.features.groups import GroupWriter
from toolkit.features.matching import PairMatches, match_along_epipolar_lines, unit_descriptors
from toolkit.features.stores import FeatureStore, MatchStore, group_names, matches_path, write_matches
from toolkit.files import fingerprint, is_current, write_sidecar
from toolkit.localizers.local_map import LocalMap
from toolkit.localizers.survey import Survey, SurveyedImages
from toolkit.manifest import MapSettings

Floats = NDArray[np.float64]


DEPTHS = (2.0, 4.0, 8.0, 16.0)
"""Depths at which views are compared, "meters"."""
_MAP_FORMAT = 3
"""Raised when the same settings give another file: maps of before are then built anew."""


def select_pairs(
    world_from_cams: Floats,
    cameras: Sequence[pycolmap.Camera],
    groups: NDArray[np.int64],
    per_image: int = 20,
    length: float = 1.0,
) -> NDArray[np.int64]:
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
    pairs: set[tuple[int, int]] = set()
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
        pairs.update((min(i, int(j)), max(i, int(j))) for j in near[order[scores[order] > 0.02]])
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def instants(session: Session, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number for each image (N,): those that one rig took at one instant have the same."""
    devices = session.images["timestamp"].astype(str) + " " + session.device_ids
    return np.asarray(np.unique(devices.to_numpy(str)[rows], return_inverse=True)[1], np.int64)


def match_pairs(
    pairs: NDArray[np.int64],
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

    def match(pair: NDArray[np.int64]) -> PairMatches:
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


def triangulate(
    names: Sequence[str],
    cameras: Sequence[pycolmap.Camera],
    world_from_cams: Floats,
    keypoints: Sequence[NDArray[np.float32]],
    pairs: NDArray[np.int64],
    matches: Sequence[NDArray[np.int64]],
    settings: MapSettings | None = None,
    seed: int = 0,
) -> LocalMap:
    """Triangulate points from matches between images with known poses, which stay as they are.

    COLMAP's triangulator builds the tracks; the points are then refined here, all at once: with fixed poses each
    is a problem of its own, which a bundle adjuster does not exploit (16 s against 0.3 s for 65,000 points).

    Args:
        names, cameras, world_from_cams: N images, (N, 4, 4).
        keypoints: for each image (n, 2), pixels.
        pairs: (Q, 2) pairs of images.
        matches: for each pair (K, 2) indices of keypoints.

    Returns:
        The map, its points not yet colored.
    """
    settings = settings or MapSettings()
    graph = pycolmap.CorrespondenceGraph()
    reconstruction = pycolmap.Reconstruction()
    for index, (name, camera, cam_from_world, xy) in enumerate(
        zip(names, cameras, geometry.invert(world_from_cams), keypoints, strict=True), start=1
    ):
        camera = pycolmap.Camera(camera.todict() | {"camera_id": index})
        reconstruction.add_camera_with_trivial_rig(camera)
        points2D = pycolmap.Point2DList([pycolmap.Point2D(p) for p in np.asarray(xy, np.float64)])
        image = pycolmap.Image(name=name, camera_id=index, image_id=index, points2D=points2D)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_world[:3]))
        graph.add_image(index, len(xy))
    for (i, j), found in zip(pairs, matches, strict=True):
        if len(found):
            two_view = pycolmap.TwoViewGeometry()
            # COLMAP silently ignores matches whose configuration is not set
            two_view.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            two_view.inlier_matches = found.astype(np.uint32)
            graph.add_two_view_geometry(int(i) + 1, int(j) + 1, two_view)
    graph.finalize()
    observed = pycolmap.ObservationManager(reconstruction, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, reconstruction, observed)
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = seed
    options.ignore_two_view_tracks = False
    options.min_angle = settings.min_triangulation_angle_deg
    for index in range(1, len(names) + 1):
        triangulator.triangulate_image(options, index)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    observed.filter_all_points3D(settings.max_reprojection_error_px, settings.min_triangulation_angle_deg)
    tracks = sorted(reconstruction.points3D.items())
    points = np.array([point.xyz for _, point in tracks]).reshape(-1, 3)
    observations = np.array(
        [
            (element.image_id - 1, element.point2D_idx, index)
            for index, (_, point) in enumerate(tracks)
            for element in point.track.elements
        ],
        np.int64,
    ).reshape(-1, 3)
    observations = observations[np.lexsort((observations[:, 1], observations[:, 0]))]
    points, observations, noise_px = _refine_points(
        points, observations, cameras, world_from_cams, keypoints, settings
    )
    return LocalMap(
        image_names=list(names),
        cameras=list(cameras),
        world_from_cams=np.asarray(world_from_cams, np.float64),
        points=points,
        colors=np.full((len(points), 3), 128, np.uint8),
        obs_image=observations[:, 0],
        obs_keypoint=observations[:, 1],
        obs_point=observations[:, 2],
        noise_px=np.full(len(points), noise_px, np.float32),
    )


def _refine_points(
    points: Floats,
    observations: NDArray[np.int64],
    cameras: Sequence[pycolmap.Camera],
    world_from_cams: Floats,
    keypoints: Sequence[NDArray[np.float32]],
    settings: MapSettings,
    iterations: int = 8,
) -> tuple[Floats, NDArray[np.int64], float]:
    """Minimize the reprojection errors of each point under a Cauchy loss of 1 px, by Gauss-Newton on all at once.

    Errors are measured on the undistorted image plane, times the focal length. Observations beyond the limit are
    dropped, and then points that fewer than two images see. Also returned is the standard deviation of the errors.
    """
    if not len(points):
        return points, observations, 1.0
    cams_from_world = geometry.invert(world_from_cams)
    image, keypoint, _ = observations.T
    plane = np.zeros((len(observations), 2))
    focal = np.array([camera.mean_focal_length() for camera in cameras])[image]
    starts = np.searchsorted(image, np.arange(len(cameras) + 1))
    for index, camera in enumerate(cameras):
        part = slice(starts[index], starts[index + 1])
        rays = rays_of(camera, keypoints[index][keypoint[part]])
        plane[part] = rays[:, :2] / np.maximum(rays[:, 2:], 1e-3)
    rotation, translation = cams_from_world[image, :3, :3], cams_from_world[image, :3, 3]

    def residuals(xyz: Floats, obs: NDArray[np.int64]) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        in_cam = np.einsum("oij,oj->oi", rotation, xyz[obs[:, 2]]) + translation
        z = np.maximum(in_cam[:, 2], 1e-3)
        return (in_cam[:, :2] / z[:, None] - plane) * focal[:, None], in_cam, in_cam[:, 2] > 1e-3

    count = len(points)
    for _ in range(iterations):
        error, in_cam, _ = residuals(points, observations)
        jacobian = projection_jacobian(in_cam, focal) @ rotation
        weight = 1.0 / (1.0 + (error**2).sum(1))
        hessian = np.einsum("o,oki,okj->oij", weight, jacobian, jacobian).reshape(-1, 9)
        gradient = np.einsum("o,oki,ok->oi", weight, jacobian, error)
        H = np.stack([np.bincount(observations[:, 2], h, count) for h in hessian.T], -1).reshape(-1, 3, 3)
        g = np.stack([np.bincount(observations[:, 2], d, count) for d in gradient.T], -1)
        # A little damping keeps points with a poor depth from jumping.
        H += 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        points = points - np.linalg.solve(H, g[..., None])[..., 0]
    error, _, in_front = residuals(points, observations)
    good = in_front & ((error**2).sum(1) < settings.max_reprojection_error_px**2)
    kept = observations[good]
    # Keypoints of one image at one place (two orientations) are one view.
    views = np.unique(kept[:, [0, 2]], axis=0)[:, 1]
    seen = np.bincount(views, minlength=count) >= 2
    seen &= np.isfinite(points).all(axis=1)
    new_index = np.cumsum(seen) - 1
    used = seen[kept[:, 2]]
    kept = kept[used]
    kept[:, 2] = new_index[kept[:, 2]]
    # Two coordinates an observation, three parameters a point.
    freedom = max(2 * len(kept) - 3 * int(seen.sum()), 1)
    noise_px = float(np.sqrt((error[good][used] ** 2).sum() / freedom))
    return points[seen], kept, noise_px


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
    """Triangulate the map of a session from its poses, or load the one at `path` if it is current.

    Matches are kept beside it (see `matching.matches_path`), so that a killed run goes on there, and one after
    a change matches only the images that have changed.

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
    names = session.image_names
    poses = session.world_from_cam()
    rows = np.array(
        [row for row, name in enumerate(names) if name in features and np.isfinite(poses[row]).all()],
        np.int64,
    )
    if not len(rows):
        raise ArtifactError(f"Session {session.id} has no image with both a pose and local features; nothing to map.")
    sensor_ids = session.images["sensor_id"].to_numpy()
    cameras = [session.camera(sensor_ids[row]) for row in rows]
    names = [names[row] for row in rows]
    rig_from_cams, groups = session.rig_from_cam(rows), instants(session, rows)
    world_from_rigs = poses[rows] @ geometry.invert(rig_from_cams)
    surveyed = SurveyedImages(names, cameras, world_from_rigs, rig_from_cams, groups, sensor_ids[rows].tolist())
    kind = feature_kind(features.settings.get("name", "sift"))
    with threadpool_limits(1, "blas"):
        survey = Survey(surveyed, lambda index: features[names[index]], kind.min_score, kind.ratio)
    length = survey.length(metric)
    pairs = select_pairs(poses[rows], cameras, groups, settings.pairs_per_image, length)
    keypoints = [features[name].keypoints for name in names]
    matcher = _matcher(features, settings)
    made_by = {"features": [features.settings] * 2, "matcher": matcher}
    matches_file = matches_path(Path(path).parent, session.id, session.id, made_by)
    with GroupWriter(matches_file, made_by) as writer:
        counts = [len(xy) for xy in keypoints]
        _match(writer, features, names, counts, cameras, poses[rows], pairs, matcher, skip_existing, workers)
        writer.finish()
    kept = MatchStore(matches_file)
    matches = [kept[names[i], names[j]].indices for i, j in pairs]
    near = geometry.make_pose(poses[rows][:, :3, :3], poses[rows][:, :3, 3] / length)
    local_map = triangulate(names, cameras, near, keypoints, pairs, matches, settings, seed).scaled(length)
    local_map = replace(
        local_map, world_from_cams=poses[rows], length=length, consistency=survey.consistency(local_map)
    )
    local_map = _colored(local_map, session, rows, keypoints)
    local_map.save(path)
    write_sidecar(path, map_record)
    return local_map


def _matcher(features: FeatureStore, settings: MapSettings) -> dict[str, Any]:
    """Return how the pairs of a map are matched."""
    return {
        "name": "epipolar",
        "max_error_px": settings.max_epipolar_error_px,
        "ratio": settings.ratio,
        "min_score": feature_kind(features.settings.get("name", "sift")).epipolar_min_score,
    }


def _match(
    writer: GroupWriter,
    features: FeatureStore,
    names: Sequence[str],
    counts: Sequence[int],
    cameras: Sequence[pycolmap.Camera],
    world_from_cams: Floats,
    pairs: NDArray[np.int64],
    matcher: Mapping[str, Any],
    skip_existing: bool,
    workers: int,
) -> None:
    """Match the pairs of a map along epipolar lines, but for those whose matches are there."""
    made_from = [
        fingerprint([features.made_from[name], camera_text(camera), pose.tolist()])
        for name, camera, pose in zip(names, cameras, world_from_cams, strict=True)
    ]
    known = writer.index.groups if skip_existing else {}
    groups = group_names([(names[i], names[j]) for i, j in pairs.tolist()], writer.index.groups)
    wanted = {(i, j): (groups[names[i], names[j]], made_from[i] + made_from[j]) for i, j in pairs.tolist()}
    todo = [pair for pair, (group, source) in wanted.items() if known.get(group) != source]
    found = match_pairs(
        np.array(todo, np.int64).reshape(-1, 2),
        lambda index: features[names[index]],
        cameras,
        world_from_cams,
        matcher["max_error_px"],
        matcher["ratio"],
        matcher["min_score"],
        workers,
    )
    label = f"match {names[0].split('/')[0]}"
    for (i, j), matches in zip(todo, tqdm(found, total=len(todo), desc=label, unit="pair"), strict=True):
        write_matches(writer, *wanted[i, j], (counts[i], counts[j]), matches)


def _colored(
    local_map: LocalMap, session: Session, rows: NDArray[np.int64], keypoints: Sequence[NDArray[np.float32]]
) -> LocalMap:
    """Return the map with each point in the color of its first observation."""
    _, first = np.unique(local_map.obs_point, return_index=True)
    colors = local_map.colors.copy()
    images = local_map.obs_image[first]

    def read(index: int) -> NDArray[np.uint8] | None:
        try:
            return read_image(session.image_path(int(rows[index])))
        except ImageError:
            return None

    wanted = np.unique(images)
    for index, pixels in zip(wanted, prefetch(read, wanted.tolist()), strict=True):
        obs = first[images == index]
        if pixels is not None:
            xy = keypoints[index][local_map.obs_keypoint[obs]].astype(np.int64)
            height, width = pixels.shape[:2]
            colors[local_map.obs_point[obs]] = pixels[np.clip(xy[:, 1], 0, height - 1), np.clip(xy[:, 0], 0, width - 1)]
    return replace(local_map, colors=colors)
