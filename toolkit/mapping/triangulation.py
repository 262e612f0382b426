"""Triangulate points from matches between images with known poses; a large map in overlapping tiles of bounded size,
which are joined without seams.

Tiles share images, and so share observations (keypoints of images). Two points from different tiles that share an
observation are one point: the joined point has the observations of both and is triangulated again from all of them.
The memory needed depends on the size of a tile, not of the map.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture.images import default_workers, prefetch, projection_jacobian, rays_of
from toolkit.geometry import Floats, Ints
from toolkit.manifest import MapSettings
from toolkit.mapping.local_map import LocalMap

_CHUNK = 2048  # number of points that are refined at once, so that their observations fit into the processor's cache
_MIN_DEPTH = 1e-3  # smallest depth of a point in front of a camera, map lengths
MAX_REPROJECTION_ERROR_PX = 4.0
"""Observations with a larger reprojection error, in pixels, are removed from a point's track."""
OPEN_TILES = 16  # number of tiles whose files are open at once during joining


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


# Tiles


class Tile(NamedTuple):
    """Images that are triangulated together."""

    core: Ints  # (n,) core images, ascending; each image of the map is in the core of one tile
    images: Ints  # (m,) core images and the images matched with them, ascending


def plan_tiles(positions: Floats, pairs: Ints, max_core: int) -> list[Tile]:
    """Partition the images of a map into tiles by the position that they look at.

    Args:
        positions: (N, 3) position that each image looks at.
        pairs: (Q, 2) pairs of images that are matched.
        max_core: largest number of core images per tile.

    Returns:
        The tiles; neighbors in the list are near each other.
    """
    cores = _halved(positions, np.arange(len(positions)), -(-len(positions) // max_core))
    home = home_of(cores)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(home[both[:, 0]], kind="stable")]
    starts = np.searchsorted(home[both[:, 0]], np.arange(len(cores) + 1))
    return [
        Tile(core, np.union1d(core, both[starts[number] : starts[number + 1], 1])) for number, core in enumerate(cores)
    ]


def home_of(cores: Sequence[Ints]) -> Ints:
    """Return, for each image, the index (N,) of the tile that has it in its core."""
    home = np.zeros(sum(map(len, cores)), np.int64)
    for number, core in enumerate(cores):
        home[core] = number
    return home


def _halved(positions: Floats, images: Ints, count: int) -> list[Ints]:
    """Split images recursively into `count` groups of similar size, across the axis of their largest extent."""
    if count <= 1:
        return [np.sort(images)]
    along = positions[images, np.ptp(positions[images], axis=0).argmax()]
    order = images[np.lexsort((images, along))]
    cut = len(images) * (count // 2) // count
    return [*_halved(positions, order[:cut], count // 2), *_halved(positions, order[cut:], count - count // 2)]


class JoinedImages(NamedTuple):
    """All N images of a map."""

    names: list[str]
    cameras: list[pycolmap.Camera]
    world_from_cams: Floats  # (N, 4, 4)
    keypoints: Callable[[int], NDArray[np.float32]]  # returns the keypoints (n, 2) of an image, pixels
    colors: Callable[[Ints, Ints], NDArray[np.uint8]]  # returns the colors (n, 3) at n keypoints of n images


def join_tiles(tiles: Sequence[Tile], load: Callable[[int], LocalMap], images: JoinedImages, folder: Path) -> LocalMap:
    """Join the maps of tiles.

    Args:
        tiles: the result of `plan_tiles`.
        load: returns the map of a tile, by index.
        images: all images of the map.
        folder: empty folder for temporary files and for the memory-mapped arrays of the joined map.
    """
    opened = lru_cache(OPEN_TILES)(load)
    length = opened(0).length
    world_from_cams = images.world_from_cams.copy()
    world_from_cams[:, :3, 3] /= length
    first, sharing = _assign(tiles, opened, len(images.names), folder)
    error2, freedom, counts = 0.0, 0, np.zeros((len(tiles), 2), np.int64)
    of_image = np.zeros(len(images.names), np.int64)
    for number in range(len(tiles)):
        rows = [_rows_of(number, other, tiles[other], opened(other), first, folder) for other in sharing[number]]
        observations = np.concatenate([np.zeros((0, 3), np.int64), *rows])
        observations = observations[np.lexsort((observations[:, 1], observations[:, 0]))]
        seen, observations[:, 0] = np.unique(observations[:, 0], return_inverse=True)
        refined = refine_points(
            opened(number).points / length,
            observations,
            [images.cameras[image] for image in seen],
            world_from_cams[seen],
            [images.keypoints(int(image)) for image in seen],
        )
        points, observations = refined.points, refined.observations
        observations[:, 0] = seen[observations[:, 0]]
        first_of = np.unique(observations[:, 2], return_index=True)[1]
        np.savez(
            folder / f"{number}.npz",
            points=length * points,
            observations=observations,
            colors=images.colors(observations[first_of, 0], observations[first_of, 1]),
        )
        error2, freedom = error2 + refined.error2, freedom + refined.freedom
        counts[number] = len(points), len(observations)
        np.add.at(of_image, observations[:, 0], 1)
    noise_px = float(np.sqrt(error2 / max(freedom, 1)))
    return _written(images, length, counts, of_image, noise_px, folder)


def _assign(
    tiles: Sequence[Tile], load: Callable[[int], LocalMap], count: int, folder: Path
) -> tuple[Ints, list[list[int]]]:
    """Assign each observation of each tile to a point, counted through all tiles.

    A point that shares observations with points of earlier tiles becomes the one with which it shares the most. The
    assignments are saved in `folder`; -1 marks an observation that an earlier tile has assigned.

    Returns:
        The first point of each tile, (T + 1,), and for each tile, the tiles with observations of its points.
    """
    last = np.zeros(count, np.int64)  # last tile of each image
    for number, tile in enumerate(tiles):
        last[tile.images] = number
    # Observations in images that later tiles have too, as image << 32 | keypoint, ascending; and their points.
    assigned = point_of = np.zeros(0, np.int64)
    first, sharing = [0], [list[int]() for _ in tiles]
    for number, tile in enumerate(tiles):
        part = load(number)
        keys = tile.images[part.obs_image] << 32 | part.obs_keypoint
        at = np.searchsorted(assigned, keys)
        shared = np.append(assigned, -1)[at] == keys
        earlier = point_of[at[shared]]
        same, counts = np.unique(
            np.column_stack([part.obs_point[shared], earlier]), axis=0, return_counts=True
        )  # (point of this tile, earlier point)
        order = np.lexsort((same[:, 1], -counts, same[:, 0]))
        same = same[order][np.unique(same[order, 0], return_index=True)[1]]
        final = first[-1] + np.arange(len(part.points))
        final[same[:, 0]] = same[:, 1]
        first.append(first[-1] + len(part.points))
        point = np.where(shared, -1, final[part.obs_point])
        np.save(folder / f"{number}.npy", point)
        for owner in np.unique(np.searchsorted(first, point[~shared], "right") - 1).tolist():
            sharing[owner].append(number)
        assigned, point_of = np.concatenate([assigned, keys[~shared]]), np.concatenate([point_of, point[~shared]])
        order = np.argsort(assigned)
        order = order[last[assigned[order] >> 32] > number]
        assigned, point_of = assigned[order], point_of[order]
    return np.array(first, np.int64), sharing


def _rows_of(owner: int, number: int, tile: Tile, part: LocalMap, first: Ints, folder: Path) -> Ints:
    """Return the observations (n, 3) in one tile of the points of its owner tile: image, keypoint, point."""
    point = np.load(folder / f"{number}.npy")
    rows = np.flatnonzero((point >= first[owner]) & (point < first[owner + 1]))
    return np.column_stack([tile.images[part.obs_image[rows]], part.obs_keypoint[rows], point[rows] - first[owner]])


def _written(
    images: JoinedImages, length: float, counts: Ints, of_image: Ints, noise_px: float, folder: Path
) -> LocalMap:
    """Join the files of points, one per tile, in a map.

    Args:
        counts: (T, 2) number of points and of observations of each tile.
        of_image: (N,) number of observations of each image.
    """
    num_points, num_observations = counts.sum(axis=0).tolist()

    def array(name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        if not shape[0]:  # an empty array cannot be memory-mapped
            return np.zeros(shape, dtype)
        return np.lib.format.open_memmap(folder / f"{name}.npy", "w+", dtype, shape)

    points, colors = array("points", (num_points, 3), np.float64), array("colors", (num_points, 3), np.uint8)
    noise = array("noise_px", (num_points,), np.float32)
    point_starts = array("point_starts", (num_points + 1,), np.int64)
    obs_image, obs_keypoint, obs_point, by_point = (
        array(name, (num_observations,), np.int64) for name in ("obs_image", "obs_keypoint", "obs_point", "by_point")
    )
    image_starts = np.concatenate([[0], np.cumsum(of_image)])
    free = image_starts[:-1].copy()  # row for the next observation of each image
    point = observation = 0
    for number in range(len(counts)):
        with np.load(folder / f"{number}.npz") as tile:
            rows = tile["observations"]
            here = slice(point, point + len(tile["points"]))
            points[here], colors[here] = tile["points"], tile["colors"]
        seeing, begin, each = np.unique(rows[:, 0], return_index=True, return_counts=True)
        at = np.repeat(free[seeing] - begin, each) + np.arange(len(rows))
        free[seeing] += each
        obs_image[at], obs_keypoint[at], obs_point[at] = rows[:, 0], rows[:, 1], rows[:, 2] + point
        order = np.lexsort((at, rows[:, 2]))
        by_point[observation : observation + len(rows)] = at[order]
        of_point = np.bincount(rows[:, 2], minlength=here.stop - here.start)
        point_starts[here.start + 1 : here.stop + 1] = observation + np.cumsum(of_point)
        noise[here] = noise_px
        point, observation = here.stop, observation + len(rows)
    return LocalMap(
        images.names, images.cameras, images.world_from_cams, points, colors, obs_image, obs_keypoint, obs_point, noise,
        length,
    ).knowing(image_starts=image_starts, by_point=by_point, point_starts=point_starts)  # fmt: skip
