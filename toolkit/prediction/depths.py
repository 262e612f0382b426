"""The depth of images, from the depth maps of a capture.

In `depths.txt` of the official tools, a depth map belongs to an image in one of three ways:

- rendered for it: same timestamp, and its sensor id or `<prefix>/<sensor id>`, an id that is not in sensors.txt;
- measured with it (phones): same timestamp, and its sensor id with `cam` replaced by `depth` in the last part;
- measured by another sensor of its rig (headsets, robots), with its own intrinsics, pose in the rig and timestamps.

In each case the points of the depth map are transformed to the image's camera, and occluded points are dropped.
"""

import logging
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from threading import Lock

import numpy as np
import pycolmap
from numpy.typing import ArrayLike
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation, Slerp

from toolkit import geometry
from toolkit.capture.images import in_view, rays_of, view_bounds
from toolkit.capture.session import Session
from toolkit.capture.tables import read_depth
from toolkit.errors import CaptureError
from toolkit.files import RAW_DATA
from toolkit.geometry import Floats, Ints

log = logging.getLogger(__name__)

# Largest time between an image and the depth map of another sensor: half the period of the slowest, at 5 Hz.
MAX_OFFSET_US = 100_000
MAX_GAP_US = 1_000_000  # largest time between two poses of a sensor to interpolate between them
_MAX_POINTS = 30_000  # per depth map; enough for a few hundred features
_HIDDEN = 1.1  # a point deeper than its nearest neighbor by this factor is occluded, or on an edge
_CELL = 1.5  # width of a cell, in point spacings; only the nearest point of a cell is visible
_FITTED = 8  # points that a plane is fitted to
_UNEVEN = 0.05  # largest residual of a point to the plane, relative to the inverse depth
_KEPT = 32  # images whose depth is cached


@dataclass(frozen=True)
class SeenDepth:
    """Depth at some pixels of an image."""

    pixels: Floats  # (P, 2) pixels of the image, in row order from the top
    depth_m: Floats  # (P,) depth along the image's optical axis, meters
    cell_px: float = 1.0  # width of the grid cells, pixels; each cell has at most one point
    reason: str = ""  # which depth maps were left out and why; without points, why there are none

    def __len__(self) -> int:
        return len(self.depth_m)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.pixels)

    def at(self, xy: ArrayLike) -> Floats:
        """Return the depth (N,), meters, at pixels (N, 2), from a plane fitted to the nearest points.

        The fit is linear, because the inverse depth of a plane is linear in the pixels. NaN where fewer than four
        points are near, or where the points do not lie on one surface.
        """
        xy = np.asarray(xy, np.float64).reshape(-1, 2)
        depth_m = np.full(len(xy), np.nan)
        if len(self) < _FITTED or not len(xy):
            return depth_m
        distance, near = self._tree.query(xy, k=_FITTED)
        inside = np.flatnonzero(distance[:, 3] <= 2 * self.cell_px)
        inverse = 1 / self.depth_m[near[inside]]
        offset = (self.pixels[near[inside]] - xy[inside, None]) / self.cell_px
        rows = np.concatenate([np.ones((*inverse.shape, 1)), offset], axis=2)
        # The damping makes depth constant across a line if all points lie on it.
        normal = np.einsum("nki,nkj->nij", rows, rows) + 1e-6 * np.eye(3)
        plane = np.linalg.solve(normal, np.einsum("nki,nk->ni", rows, inverse)[..., None])
        residual = np.abs((rows @ plane)[..., 0] - inverse).max(axis=1)
        value = plane[:, 0, 0]
        smooth = (value > 0) & (residual <= _UNEVEN * np.abs(value))
        depth_m[inside[smooth]] = 1 / value[smooth]
        return depth_m


def lifted(camera: pycolmap.Camera, pixels: Floats, depth_m: Floats) -> Floats:
    """Return the points (P, 3), in the camera's frame, at pixels (P, 2) and depths (P,)."""
    rays = rays_of(camera, pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(rays / rays[:, 2:] * np.asarray(depth_m)[:, None], np.float64)


_DepthMap = tuple[str, pycolmap.Camera | None, Floats]
"""A depth map of an image: its path relative to raw_data/; its camera, None for that of the image, possibly resized;
and cam_from_depth (4, 4), the pose of its sensor in the image's camera."""


class DepthMaps:
    """The depth maps of a session by image. Thread-safe."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.of = lru_cache(_KEPT)(self._see)
        self._track_of = cache(session.poses_of_sensor)
        self._lock = Lock()
        self._logged: set[str] = set()

    def _see(self, row: int) -> SeenDepth:
        """Return the depth in an image, a row of `Session.images`: of each depth sensor of its camera, the depth
        map nearest in time, within `MAX_OFFSET_US`. One that cannot be read or does not fit is left out, and logged
        once.
        """
        image = self._session.images.iloc[row]
        camera = self._session.camera(str(image["sensor_id"]))
        sources, reasons = self._sources(row, int(image["timestamp"]), str(image["sensor_id"]))
        points, spacing = [np.zeros((0, 3))], 0.0
        for source in sources:
            try:
                points_of_map, spacing_px = self._points(camera, *source)
                points, spacing = [*points, points_of_map], max(spacing, spacing_px)
            except CaptureError as error:
                reasons.append(str(error))
        with self._lock:
            for reason in dict.fromkeys(reasons):
                if reason not in self._logged:
                    log.warning("left out: %s", reason)
            self._logged.update(reasons)
        return _visible(np.concatenate(points), camera, max(1.0, _CELL * spacing), "; ".join(reasons))

    @cached_property
    def _rows_of_sensor(self) -> dict[str, Ints]:
        """Rows of depths.txt of each sensor, sorted by time."""
        depths = self._session.depths
        if depths is None:
            return {}
        ordered = depths.sort_values("timestamp", kind="stable")
        return {str(key): np.asarray(rows, np.int64) for key, rows in ordered.groupby("sensor_id").groups.items()}

    @cached_property
    def _renderings(self) -> dict[str, str]:
        """Ids `<prefix>/<sensor id>` of rendered depth maps, by sensor id."""
        ids = [depth_id for depth_id in self._rows_of_sensor if not self._session.has_sensor(depth_id)]
        return {depth_id.partition("/")[2]: depth_id for depth_id in ids}

    @cached_property
    def _rig_depth_sensors(self) -> dict[str, list[str]]:
        """Depth sensors that share a rig with each sensor."""
        rigs = self._session.rigs
        if rigs is None:
            return {}
        depth = rigs[rigs["sensor_id"].isin(list(self._rows_of_sensor))]
        pairs = rigs.merge(depth, on="rig_id", suffixes=("", "_depth"))[["sensor_id", "sensor_id_depth"]]
        pairs = pairs[pairs["sensor_id"] != pairs["sensor_id_depth"]].drop_duplicates()
        return {str(key): [str(i) for i in group] for key, group in pairs.groupby("sensor_id")["sensor_id_depth"]}

    def _sources(self, row: int, timestamp: int, sensor: str) -> tuple[list[_DepthMap], list[str]]:
        """Return the depth maps of an image, and the reasons why others are left out."""
        session = self._session
        if session.depths is None:
            return [], []
        in_rig = self._rig_depth_sensors.get(sensor, [])
        folder, slash, last = sensor.rpartition("/")
        paired = folder + slash + last.replace("cam", "depth")
        for depth_id in (sensor, self._renderings.get(sensor, ""), "" if paired in in_rig else paired):
            nearest = self._nearest(depth_id, timestamp, 0)
            if nearest is not None:
                own = depth_id == sensor or not session.has_sensor(depth_id)
                return [(nearest[1], None if own else session.camera(depth_id), np.eye(4))], []
        sources, reasons = list[_DepthMap](), []
        world_from_cam = session.world_from_cam([row])[0]
        for depth_id in in_rig:
            nearest = self._nearest(depth_id, timestamp, MAX_OFFSET_US)
            if nearest is None:
                continue
            world_from_depth = self._pose(depth_id, nearest[0])
            if world_from_depth is None or not np.isfinite(world_from_cam).all():
                missing = "its sensor" if world_from_depth is None else "the image"
                reasons.append(f"depth map {nearest[1]}: {missing} has no pose at that time or near it")
                continue
            cam_from_depth = geometry.invert(world_from_cam) @ world_from_depth
            sources.append((nearest[1], session.camera(depth_id), cam_from_depth))
        return sources, reasons

    def _nearest(self, sensor: str, timestamp: int, tolerance_us: int) -> tuple[int, str] | None:
        """Return time and path of a sensor's depth map nearest in time, None beyond the tolerance."""
        rows = self._rows_of_sensor.get(sensor)
        if rows is None or self._session.depths is None:
            return None
        times = self._session.depths["timestamp"].to_numpy(np.int64)[rows]
        best = int(np.argmin(np.abs(times - timestamp)))
        if abs(int(times[best]) - timestamp) > tolerance_us:
            return None
        return int(times[best]), str(self._session.depths["path"].iloc[int(rows[best])])

    def _pose(self, sensor: str, timestamp: int) -> Floats | None:
        """Return world_from_sensor at a time, interpolated between two poses; None if they are too far apart."""
        times, poses = self._track_of(sensor)
        after = int(np.searchsorted(times, timestamp))
        if after < len(times) and times[after] == timestamp:
            return np.asarray(poses[after])
        if after in (0, len(times)) or times[after] - times[after - 1] > MAX_GAP_US:
            return None
        share = (timestamp - times[after - 1]) / (times[after] - times[after - 1])
        rotation = Slerp([0, 1], Rotation.from_matrix(poses[after - 1 : after + 1, :3, :3]))(share).as_matrix()
        return geometry.make_pose(rotation, (1 - share) * poses[after - 1, :3, 3] + share * poses[after, :3, 3])

    def _points(
        self, image_camera: pycolmap.Camera, file: str, own_camera: pycolmap.Camera | None, cam_from_depth: Floats
    ) -> tuple[Floats, float]:
        """Return the points (P, 3) of a depth map in the image's camera, and their spacing in its pixels."""
        path = self._session.path / RAW_DATA / file
        depth = read_depth(path)
        height, width = depth.shape
        camera = own_camera or image_camera
        resized = own_camera is None and abs(width - height * camera.width / camera.height) <= 1
        if not resized and (width, height) != (camera.width, camera.height):
            expected = f"{camera.width} x {camera.height}" + (", or that aspect ratio" if own_camera is None else "")
            raise CaptureError(f"Depth map {path}: found {width} x {height} pixels, expected {expected}.")
        step = int(np.ceil(np.sqrt(max(np.count_nonzero(depth) / _MAX_POINTS, 1.0))))
        y, x = np.nonzero(depth[step // 2 :: step, step // 2 :: step])
        y, x = y * step + step // 2, x * step + step // 2
        size = np.array([camera.width / width, camera.height / height])
        points = lifted(camera, (np.column_stack([x, y]) + 0.5) * size, depth[y, x].astype(np.float64))
        points = points[np.isfinite(points).all(axis=1)]
        spacing_px = step * size.max() * image_camera.mean_focal_length() / camera.mean_focal_length()
        return geometry.transform(cam_from_depth, points), float(spacing_px)


def _visible(points: Floats, camera: pycolmap.Camera, cell_px: float, reason: str) -> SeenDepth:
    """Project points (P, 3) in a camera's frame; keep the nearest point of each cell unless a neighbor occludes it."""
    if len(points):
        points = points[in_view(points[None], view_bounds(camera)[None])[0]]
    pixels = np.asarray(camera.img_from_cam(points), np.float64).reshape(-1, 2) if len(points) else np.zeros((0, 2))
    size = np.array([camera.width, camera.height])
    inside = (np.isfinite(pixels) & (pixels >= 0) & (pixels < size)).all(axis=1)
    pixels, depth = pixels[inside], points[inside, 2]
    if not len(depth):
        return SeenDepth(np.zeros((0, 2)), np.zeros(0), cell_px, reason or "no depth map of this image")
    column, row = (pixels / cell_px).astype(np.int64).T
    shape = tuple(int(n) + 1 for n in (size[::-1] / cell_px))
    cell = row * shape[1] + column
    order = np.lexsort((depth, cell))
    nearest = order[np.unique(cell[order], return_index=True)[1]]
    grid = np.full(shape, np.inf)
    grid[row[nearest], column[nearest]] = depth[nearest]
    around = minimum_filter(grid, size=3, mode="nearest")[row[nearest], column[nearest]]
    kept = nearest[depth[nearest] <= _HIDDEN * around]
    return SeenDepth(pixels[kept], depth[kept], cell_px, reason)
