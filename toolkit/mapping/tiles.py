"""Triangulate a large map in overlapping tiles of bounded size, and join them without seams.

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

from toolkit.geometry import Floats, Ints
from toolkit.mapping.local_map import LocalMap
from toolkit.mapping.triangulation import refine_points

OPEN_TILES = 16  # number of tiles whose files are open at once during joining


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
