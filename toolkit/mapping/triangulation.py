"""Triangulate points from matches between images with known poses."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture.cameras import projection_jacobian, rays_of
from toolkit.capture.images import default_workers, prefetch
from toolkit.geometry import Floats, Ints
from toolkit.manifest import MapSettings
from toolkit.mapping.local_map import LocalMap

_CHUNK = 2048  # number of points that are refined at once, so that their observations fit into the processor's cache
_MIN_DEPTH = 1e-3  # smallest depth of a point in front of a camera, map lengths
MAX_REPROJECTION_ERROR_PX = 4.0
"""Observations with a larger reprojection error, in pixels, are removed from a point's track."""


def triangulate(
    names: Sequence[str], cameras: Sequence[pycolmap.Camera], world_from_cams: Floats,
    keypoints: Sequence[NDArray[np.float32]], pairs: Ints, matches: Sequence[Ints], settings: MapSettings | None = None,
    seed: int = 0, max_error_px: float = MAX_REPROJECTION_ERROR_PX,
) -> LocalMap:  # fmt: skip
    """Triangulate points from matches between images with known poses, which are kept fixed.

    COLMAP's triangulator builds the tracks. The points are then refined here, all at once: with fixed poses, each point
    is an independent problem, which a bundle adjuster does not exploit (16 s against 0.3 s for 65,000 points).

    Args:
        names, cameras, world_from_cams: names, cameras and poses (N, 4, 4) of N images.
        keypoints: for each image, keypoints (n, 2), pixels.
        pairs: (Q, 2) indices of the images of each pair.
        matches: for each pair, indices (K, 2) of matched keypoints.
        settings, seed: of the triangulation.
        max_error_px: largest reprojection error of an observation.

    Returns:
        The map; its points are gray.
    """
    settings = settings or MapSettings()
    # A function of its own, so that the memory that COLMAP takes, about 2 MB per image, is free afterward.
    origin = geometry.local_origin(np.asarray(world_from_cams)[:, :3, 3])
    local = geometry.shifted(world_from_cams, -origin)
    tracks = _tracks(names, cameras, local, keypoints, pairs, matches, settings, seed, max_error_px)
    refined = refine_points(*tracks, cameras, local, keypoints, max_error_px)
    points, observations = refined.points + origin, refined.observations
    return LocalMap(
        image_names=list(names),
        cameras=list(cameras),
        world_from_cams=np.asarray(world_from_cams, np.float64),
        points=points,
        colors=np.full((len(points), 3), 128, np.uint8),
        obs_image=observations[:, 0],
        obs_keypoint=observations[:, 1],
        obs_point=observations[:, 2],
        noise_px=np.full(len(points), refined.noise_px, np.float32),
    )


def _tracks(
    names: Sequence[str], cameras: Sequence[pycolmap.Camera], world_from_cams: Floats,
    keypoints: Sequence[NDArray[np.float32]], pairs: Ints, matches: Sequence[Ints], settings: MapSettings, seed: int,
    max_error_px: float,
) -> tuple[Floats, Ints]:  # fmt: skip
    """Return points (P, 3) triangulated by COLMAP, and their observations (n, 3), sorted: image, keypoint, point."""
    graph = pycolmap.CorrespondenceGraph()
    reconstruction = pycolmap.Reconstruction()
    for index, (name, camera, cam_from_world, xy) in enumerate(
        zip(names, cameras, geometry.invert(world_from_cams), keypoints, strict=True), start=1
    ):
        camera, xy = pycolmap.Camera(camera.todict() | {"camera_id": index}), np.asarray(xy, np.float64)
        center, size = [camera.principal_point_x, camera.principal_point_y], [camera.width, camera.height]
        if np.any(np.less(center, 0) | np.greater(center, size)):  # of a crop; COLMAP silently ignores such cameras
            xy = xy + np.subtract(np.array(size) / 2, center)
            camera.principal_point_x, camera.principal_point_y = camera.width / 2, camera.height / 2
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=name, camera_id=index, image_id=index, keypoints=xy)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_world[:3]))
        graph.add_image(index, len(xy))
    for (i, j), indices in zip(pairs, matches, strict=True):
        if len(indices):
            two_view = pycolmap.TwoViewGeometry()
            # COLMAP silently ignores matches without a configuration.
            two_view.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            two_view.inlier_matches = indices.astype(np.uint32)
            graph.add_two_view_geometry(int(i) + 1, int(j) + 1, two_view)
    graph.finalize()
    observations = pycolmap.ObservationManager(reconstruction, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, reconstruction, observations)
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = seed
    # COLMAP silently ignores cameras beyond these limits, among them calibrated ones: Azure Kinect's has k > 1.
    options.min_focal_length_ratio, options.max_focal_length_ratio, options.max_extra_param = 0.0, np.inf, np.inf
    options.ignore_two_view_tracks = False
    options.min_angle = settings.min_triangulation_angle_deg
    for index in range(1, len(names) + 1):
        triangulator.triangulate_image(options, index)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    observations.filter_all_points3D(max_error_px, settings.min_triangulation_angle_deg)
    xyz = {number: point.xyz for number, point in reconstruction.points3D.items()}
    ids = np.array(sorted(xyz), np.uint64)
    rows = [np.zeros((0, 3), np.int64)]
    for index in range(len(names)):
        image = reconstruction.image(index + 1)
        seen = np.array(image.get_observation_point2D_idxs(), np.int64)
        points = np.array([point.point3D_id for point in image.get_observation_points2D()], np.uint64)
        rows.append(np.column_stack([np.full(len(seen), index), seen, np.searchsorted(ids, points)]))
    return np.array([xyz[number] for number in sorted(xyz)]).reshape(-1, 3), np.concatenate(rows)


class RefinedPoints(NamedTuple):
    """Points that minimize the reprojection errors of their observations."""

    points: Floats  # (P, 3) in the world
    observations: Ints  # (n, 3) image, keypoint and point
    error2: float  # sum of the squared reprojection errors of the observations, square pixels
    freedom: int  # degrees of freedom of `error2`

    @property
    def noise_px(self) -> float:
        """Standard deviation of the reprojection errors per axis, pixels."""
        return float(np.sqrt(self.error2 / self.freedom)) if self.freedom else 1.0


def _gauss_newton(
    points: Floats, point: Ints, rotation: Floats, translation: Floats, focal: Floats, plane: Floats, iterations: int
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Move points (P, 3) so that they project to n keypoints, each of the point with index `point` (n,).

    Args:
        rotation, translation: from the world to the keypoint's camera, (n, 3, 3) and (n, 3).
        focal: focal lengths (n,), pixels.
        plane: the keypoints (n, 2) on the undistorted image plane at depth 1.

    Returns:
        The points, the errors (n, 2) in pixels, and whether the points are in front of the cameras, (n,).
    """

    def project() -> tuple[Floats, Floats]:
        in_cam = np.einsum("oij,oj->oi", rotation, points[point]) + translation
        z = np.maximum(in_cam[:, 2], _MIN_DEPTH)
        return (in_cam[:, :2] / z[:, None] - plane) * focal[:, None], in_cam

    for _ in range(iterations):
        error, in_cam = project()
        jacobian = projection_jacobian(in_cam, focal) @ rotation
        weight = 1.0 / (1.0 + (error**2).sum(1))
        weighted = (weight[:, None, None] * jacobian).transpose(0, 2, 1)  # one einsum of all three is slower
        hessian = (weighted @ jacobian).reshape(-1, 9)
        gradient = (weighted @ error[:, :, None])[:, :, 0]
        # Without observations, bincount returns integers.
        H = np.stack([np.bincount(point, h, len(points)) for h in hessian.T], -1, dtype=np.float64).reshape(-1, 3, 3)
        g = np.stack([np.bincount(point, d, len(points)) for d in gradient.T], -1, dtype=np.float64)
        # A little damping keeps points with an uncertain depth from jumping.
        H += 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        points = points - np.linalg.solve(H, g[..., None])[..., 0]
    error, in_cam = project()
    return points, error, in_cam[:, 2] > _MIN_DEPTH


def refine_points(
    points: Floats, observations: Ints, cameras: Sequence[pycolmap.Camera], world_from_cams: Floats,
    keypoints: Sequence[NDArray[np.float32]], max_error_px: float = MAX_REPROJECTION_ERROR_PX, iterations: int = 8,
) -> RefinedPoints:  # fmt: skip
    """Minimize the reprojection errors of each point under a Cauchy loss of 1 px, by Gauss-Newton on all at once.

    Errors are measured on the undistorted image plane, times the focal length. Observations with a larger error than
    `max_error_px` are then dropped, and points that fewer than two images observe.

    Args:
        points: (P, 3).
        observations: (n, 3) image, keypoint and point, sorted by image.
        cameras, world_from_cams, keypoints: of the images, as for `triangulate`.
        max_error_px: largest reprojection error of an observation.
        iterations: number of Gauss-Newton steps.
    """
    if not len(observations):  # earlier tiles may have taken all points of a tile
        return RefinedPoints(points[:0], observations, 0.0, 0)
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
    order = np.argsort(observations[:, 2], kind="stable")
    firsts = range(0, len(points), _CHUNK)
    bounds = np.searchsorted(observations[order, 2], [*firsts, len(points)])

    def refine(number: int) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        part = order[bounds[number] : bounds[number + 1]]
        chunk = points[firsts[number] : firsts[number] + _CHUNK]
        point = observations[part, 2] - firsts[number]
        return _gauss_newton(chunk, point, rotation[part], translation[part], focal[part], plane[part], iterations)

    refined = list(prefetch(refine, range(len(firsts)), default_workers()))
    points = np.concatenate([chunk for chunk, _, _ in refined])
    error, in_front = np.empty_like(plane), np.empty(len(plane), bool)
    error[order] = np.concatenate([errors for _, errors, _ in refined])
    in_front[order] = np.concatenate([front for _, _, front in refined])
    count = len(points)
    good = in_front & ((error**2).sum(1) < max_error_px**2)
    kept = observations[good]
    # Two keypoints of one image at one position (two orientations) are one view.
    views = np.unique(kept[:, 0] * count + kept[:, 2]) % count
    seen = np.bincount(views, minlength=count) >= 2
    seen &= np.isfinite(points).all(axis=1)
    new_index = np.cumsum(seen) - 1
    used = seen[kept[:, 2]]
    kept = kept[used]
    kept[:, 2] = new_index[kept[:, 2]]
    # Two coordinates per observation, three parameters per point.
    freedom = max(2 * len(kept) - 3 * int(seen.sum()), 1)
    return RefinedPoints(points[seen], kept, float((error[good][used] ** 2).sum()), freedom)
