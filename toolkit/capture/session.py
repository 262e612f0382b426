"""A capture in the CroCoDL/LaMAR format, and its sessions. `toolkit.capture.check` finds inconsistencies.

    CAPTURE/sessions/<device>_<map|query>/          (LaMAR: map, query_phone, query_hololens; see capture.names)
        sensors.txt  rigs.txt  images.txt  depths.txt  trajectories.txt  wifi.txt  bt.txt  gps.txt  raw_data/
        proc/subsessions.txt  proc/keyframes_*.txt  proc/alignment_trajectories.txt      (LaMAR: queries.txt)

`trajectories.txt` and `alignment_trajectories.txt` contain world_from_device, `rigs.txt` contains rig_from_sensor.
Lengths are in meters, timestamps in int64 microseconds, quaternions are qw qx qy qz. The key of an image is (timestamp,
sensor_id), the key of a device pose or a keyframe is (timestamp, device_id). The device is the rig or, for a sensor
without a rig, the sensor itself.

A session may have 200,000 images, sensors and rigs. Tables are therefore kept as columns (Arrow strings, NumPy
numbers), and no Python code loops over rows while a session is read.
"""

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from html import escape
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pycolmap
from numpy.typing import ArrayLike, NDArray

from toolkit.capture import names
from toolkit.capture.images import camera_text, parse_camera, thumbnails
from toolkit.capture.names import SPLITS, in_order, require_name, session_id, session_of
from toolkit.capture.tables import (
    ALIGNED,
    COLUMNS,
    POSE_NAMES,
    SIGNALS,
    KeyIndex,
    TextTable,
    Trajectory,
    as_pandas,
    as_strings,
    codes_of,
    key_of,
    read_table,
    times_of,
)
from toolkit.errors import COMMAND, CaptureError
from toolkit.files import MASKS, RAW_DATA, files_fingerprint, own_name, read_json
from toolkit.geometry import Floats, Ints, pose_from_qt

log = logging.getLogger(__name__)
Strings = NDArray[np.object_]
Rows = ArrayLike | slice | None
SUBSESSIONS = "proc/subsessions.txt"
IMPORT_RECORD = "proc/import.json"
RECONSTRUCTION_RECORD = "proc/reconstruction.json"
"""What an import has noted in a session: the unit of its poses, `m` or null if unknown, and its inputs."""


@lru_cache(maxsize=16)
def _reopened(path: Path, state: str) -> "Session":
    return Session(path)


class Session:
    """One folder of a capture: the recordings of one device, for the map or as queries.

    Attributes:
        path: the folder.
        device: a key of `toolkit.capture.names`, from the folder's name.
        split: `map` or `query`, from the folder's name.
        id: `<device>_<split>`, the name of the session in all outputs.
        images: table [timestamp, sensor_id, path], in the order of images.txt; path is relative to raw_data/.
        sensors: table [sensor_id, name, sensor_type, params]; params is the text in sensors.txt.
        rigs: table [rig_id, sensor_id], or None.
        trajectory: trajectories.txt, or None. For a query session, this is the odometry of the device in its own
            frame: it gives the motion between two times, but no position in the map.
        ground_truth: poses in the world of the map: proc/alignment_trajectories.txt; a map session without that file
            uses trajectories.txt; else None.
    """

    def __init__(self, path: str | Path, strict: bool = True) -> None:
        """Read a session. With strict=False, drop malformed lines and keep the tables of all files in `tables`."""
        self.path = Path(path)
        self.device, self.split = session_of(self.path.name)
        self.id = session_id(self.path.name)
        self.tables: dict[str, TextTable] = {}
        self._strict = strict
        if not self.path.is_dir():
            raise CaptureError(f"No such session folder: {self.path}.")
        names.require_name(self.path.name, "session", self.path.parent)
        self._links_allowed = names.outside_allowed() or names.is_linked_here(self.path)
        self._sensor_table = self._read("sensors.txt", extra=True)
        self.sensors = self._sensor_table.frame("sensor_id", "name", "sensor_type")
        self.sensors["params"] = as_pandas(self._sensor_table.columns["extra"])
        self._image_table = self._read("images.txt")
        self.images = _records(self._image_table, "image_path")
        self.rigs: pd.DataFrame | None = None
        self._rig_qt = np.zeros((0, 7))
        if (self.path / "rigs.txt").exists():
            table = self._read("rigs.txt")
            self.rigs = table.frame("rig_id", "sensor_id")
            self._rig_qt = table.numbers(POSE_NAMES)
        self.trajectory = self._trajectory("trajectories.txt")
        aligned = self._trajectory(ALIGNED)
        self.ground_truth = self.trajectory if aligned is None and self.split == "map" else aligned
        self._cameras: dict[str, pycolmap.Camera] = {}
        self._keyframes: dict[str, pd.DataFrame] = {}

    @classmethod
    def open(cls, path: str | Path) -> "Session":
        """Read a session.

        Raises:
            CaptureError: the folder, sensors.txt or images.txt is missing, or a line is malformed.
        """
        return cls(path)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the folder. A process that unpickles it reads the session once, and again if its files change."""
        files = [*sorted(self.path.glob("*.txt")), *sorted((self.path / "proc").rglob("*.txt"))]
        return _reopened, (self.path, files_fingerprint(files))

    def __repr__(self) -> str:
        poses = 0 if self.ground_truth is None else len(self.ground_truth)
        return f"Session({self.id}: {len(self.images)} images, {len(self.sensors)} sensors, {poses} poses)"

    def _repr_html_(self) -> str:
        rows = self.camera_rows
        sample = rows[np.unique(np.linspace(0, len(rows) - 1, min(6, len(rows))).astype(int))] if len(rows) else rows
        cameras = [camera_text(self.camera(sensor)) for sensor in pd.unique(self.images["sensor_id"].iloc[rows])]
        listed = "".join(f"<li>{escape(text)}</li>" for text in dict.fromkeys(cameras[:4]))
        return (
            f"<p><b>{escape(self.id)}</b>: {len(self)} images in {len(self.subsessions)} recordings, "
            f"{len(pd.unique(self.device_ids))} frames.</p>"
            f"{thumbnails(self.image_path(row) for row in sample.tolist())}<ul>{listed}</ul>"
        )

    def __len__(self) -> int:
        return len(self.images)

    def _read(self, file: str, extra: bool = False) -> TextTable:
        path = self.path / file
        if not self._links_allowed and (target := names.leads_out(path, self._roots)):
            raise CaptureError(f"{path}: {_linked_out(target)}")
        table = read_table(path, COLUMNS.get(file, COLUMNS["keyframes"]), self._strict, extra)
        if not self._strict:
            self.tables[file] = table
            return table
        if file in ("sensors.txt", *SIGNALS):  # sensors: see `_sensor_rows`; signals may repeat
            return table
        again = table.repeated(key_of(file))
        is_trajectory = file in ("trajectories.txt", ALIGNED)  # keeps its rows: covariances are read later by row
        return table if is_trajectory or not len(again) else table.without(again)

    def _trajectory(self, file: str) -> Trajectory | None:
        return Trajectory.from_table(self._read(file)) if (self.path / file).exists() else None

    @property
    def odometry(self) -> Trajectory | None:
        """trajectories.txt of a query session, or None: world_from_device in the device's own frame, which changes when
        tracking is lost. None for a map session, whose poses are in the world."""
        return self.trajectory if self.split == "query" else None

    @cached_property
    def wifi(self) -> pd.DataFrame | None:
        """Signals of access points, table [timestamp, sensor_id, mac_addr, frequency_khz, rssi_dbm]; None without a
        wifi.txt. Rows with one timestamp and sensor form a scan."""
        return self._optional("wifi.txt")

    @cached_property
    def bluetooth(self) -> pd.DataFrame | None:
        """Signals of beacons, table [timestamp, sensor_id, id, rssi_dbm]; None without a bt.txt."""
        return self._optional("bt.txt")

    @cached_property
    def gps(self) -> pd.DataFrame | None:
        """GPS fixes, table [timestamp, sensor_id, latitude_deg, longitude_deg, altitude_m, horizontal_accuracy_m],
        WGS 84; None without a gps.txt. A negative accuracy means no fix."""
        return self._optional("gps.txt")

    def _optional(self, file: str) -> pd.DataFrame | None:
        return self._read(file).frame(*dict(COLUMNS[file])) if (self.path / file).exists() else None

    @cached_property
    def _roots(self) -> list[Path]:
        """The resolved folders in which files may lie: that of the session and its capture's."""
        path = self.path.absolute()
        in_capture = path.parent.name == "sessions"
        return [root.resolve() for root in (path, *(path.parents[:2] if in_capture else ()))]

    # Files

    def image_path(self, row: int) -> Path:
        """Return the file of an image.

        Raises:
            CaptureError: an image of the session is listed twice, or a link leads outside of the capture.
        """
        return self._raw_data / self.images["path"].iloc[row]

    def mask_path(self, row: int) -> Path | None:
        """Return the mask of an image, the file `masks/<path>.png` that is black where to extract no features, or None.

        The name is COLMAP's, with the image's path relative to raw_data.
        """
        path = self.path / MASKS / f"{self.images['path'].iloc[row]}.png" if self._has_masks else None
        return path if path is not None and os.path.lexists(path) else None  # a broken link is no missing mask

    @cached_property
    def _has_masks(self) -> bool:
        return (self.path / MASKS).is_dir()

    def mask_paths(self, rows: Iterable[int]) -> list[Path]:
        """Return the masks of those of the images that have one."""
        return [path for row in rows if (path := self.mask_path(row)) is not None] if self._has_masks else []

    def image_name(self, row: int) -> str:
        """Return the name of an image in the whole capture: its path relative to sessions/."""
        return f"{self.path.name}/{RAW_DATA}/{self.images['path'].iloc[row]}"

    @cached_property
    def image_names(self) -> list[str]:
        """The names of all images, in the order of `images`."""
        return [f"{self.path.name}/{RAW_DATA}/{path}" for path in self.images["path"]]

    def own_names(self, rows_of_queries: Iterable[Ints]) -> list[str]:
        """Return the user's names of the images of each query (`files.own_name`), joined by `;`."""
        paths = self.images["path"]
        return [";".join(own_name(path) for path in paths.iloc[rows]) for rows in rows_of_queries]

    @cached_property
    def row_of_name(self) -> dict[str, int]:
        """Row of `images` by image name."""
        return {name: row for row, name in enumerate(self.image_names)}

    @cached_property
    def depths(self) -> pd.DataFrame | None:
        """Table [timestamp, sensor_id, path] of depths.txt, or None.

        Raises:
            CaptureError: a line is malformed, or a link leads outside of the capture.
        """
        if not (self.path / "depths.txt").exists():
            return None
        table = self._read("depths.txt")
        self._require_no_link_out(table, "depth_path")
        return _records(table, "depth_path")

    @cached_property
    def _raw_data(self) -> Path:
        """The folder of the images. Checks their paths first, which sessions without image access need not wait for."""
        again = np.flatnonzero(self.images["path"].duplicated())
        if len(again) and self._strict:  # outputs identify an image by its path
            found = f"the image {self.images['path'][again[0]]!r} again, with another timestamp or sensor"
            raise CaptureError(f"{self._image_table.where(again[0])}: found {found}. Remove a line, or use two files.")
        self._require_no_link_out(self._image_table, "image_path")
        return self.path / RAW_DATA

    def _require_no_link_out(self, table: TextTable, column: str) -> None:
        for row, target in self.links_out(table.frame(column)[column]).items() if self._strict else ():
            path = f"{RAW_DATA}/{table.columns[column][row].as_py()}"
            raise CaptureError(f"{table.where(row)}: {path} {_linked_out(target)}")

    def links_out(self, paths: "pd.Series[str]") -> dict[int, Path]:
        """Return the paths below raw_data/ that links lead outside of the capture: their rows in `paths` and targets.

        Empty if links are allowed, or if `import` made the links of this session on this machine.
        """
        return {} if self._links_allowed else names.links_out(self.path / RAW_DATA, paths, self._roots)

    @cached_property
    def camera_rows(self) -> Ints:
        """Rows of `images` of sensors of type `camera`, in file order; depth maps are not included."""
        sensors = self.images["sensor_id"]
        for sensor in sensors[~sensors.isin(self.sensors["sensor_id"])][:1]:
            self._sensor_row(sensor)  # raises
        return np.flatnonzero(sensors.isin(self.sensors["sensor_id"][self.sensors["sensor_type"] == "camera"]))

    @cached_property
    def files_fingerprint(self) -> str:
        """16 hex digits that identify the image files, and their masks, at first use."""
        rows = range(len(self.images))
        return files_fingerprint([*map(self.image_path, rows), *self.mask_paths(rows)])

    @cached_property
    def depths_fingerprint(self) -> str:
        """16 hex digits that identify depths.txt and the depth map files at first use."""
        if self.depths is None:
            return ""
        root = self.path / RAW_DATA
        return files_fingerprint([self.path / "depths.txt", *(root / path for path in self.depths["path"])])

    # Sensors

    @cached_property
    def _sensor_rows(self) -> dict[str, int]:
        rows = {sensor: row for row, sensor in enumerate(self._sensor_table.columns["sensor_id"].to_pylist())}
        if len(rows) < len(self._sensor_table) and self._strict:
            self._sensor_table.repeated(key_of("sensors.txt"))  # logs the repeated line, or raises
        return rows

    def _sensor_row(self, sensor_id: str) -> int:
        row = self._sensor_rows.get(sensor_id)
        if row is None:
            known = f"the {len(self.sensors)} sensors in {self._sensor_table.path}, e.g. {list(self._sensor_rows)[:3]}"
            raise CaptureError(f"Unknown sensor {sensor_id!r} in session {self.id}: it is none of {known}. Add it.")
        return row

    def has_sensor(self, sensor_id: str) -> bool:
        """Tell whether sensors.txt lists a sensor."""
        return sensor_id in self._sensor_rows

    def camera(self, sensor_id: str) -> pycolmap.Camera:
        """Return the intrinsics of a `camera` or `depth` sensor, with any camera model of COLMAP.

        Raises:
            CaptureError: unknown sensor, not a camera, unknown model or wrong parameters; names the line.
        """
        if sensor_id not in self._cameras:
            row = self._sensor_row(sensor_id)
            kind, params = self.sensors["sensor_type"].iloc[row], self.sensors["params"].iloc[row]
            try:
                self._cameras[sensor_id] = parse_camera(kind, params)
            except ValueError as error:
                raise CaptureError(f"{self._sensor_table.where(row)}: sensor {sensor_id!r}: {error}") from None
        return self._cameras[sensor_id]

    def cameras(self, rows: Rows = None) -> list[pycolmap.Camera]:
        """Return the intrinsics of images; see `camera`."""
        return [self.camera(sensor) for sensor in self.images["sensor_id"].to_numpy()[_selection(rows)]]

    # Subsessions and keyframes

    @cached_property
    def subsessions(self) -> list[str]:
        """Names of the recordings of the session: proc/subsessions.txt, else the top folders of the image paths."""
        if (self.path / SUBSESSIONS).exists():
            return self._checked(self._read(SUBSESSIONS).columns["subsession"].to_pylist(), SUBSESSIONS)
        return sorted(set(self._subsession_of_image))

    def _checked(self, subsessions: Sequence[str], file: str) -> list[str]:
        for name in subsessions if self._strict else ():
            names.require_name(name, "subsession", self.path / file)
        return list(subsessions)

    def subsession_of(self, rows: Rows = None) -> Strings:
        """Return the subsession of images, (n,) str: the longest prefix of path or sensor id, "" without any."""
        return self._subsession_of_image[_selection(rows)]

    @cached_property
    def _subsession_of_image(self) -> Strings:
        columns = [as_strings(self.images[name]) for name in ("sensor_id", "path")]
        if not (self.path / SUBSESSIONS).exists():
            parts = pc.split_pattern(columns[1], "/", max_splits=1)
            in_folder = pc.and_(pc.greater(pc.list_value_length(parts), 1), pc.invert(names.bad_names(columns[1])))
            first = pc.if_else(in_folder, pc.list_element(parts, 0), self.id)  # the id if in no folder
            self._checked(pc.unique(first).to_pylist(), "images.txt")
            return first.to_numpy(zero_copy_only=False)
        return self.subsession_by_prefix(*columns)

    def subsession_by_prefix(self, *columns: Any) -> Strings:
        """Return the subsession (n,) that is the longest prefix of a text in a column (n,), "" without any."""
        subsessions = np.full(len(columns[0]), "", object)
        for name in sorted(self.subsessions, key=len):
            for column in columns:
                found = pc.starts_with(as_strings(column), f"{name}/")
                subsessions[found.to_numpy(zero_copy_only=False)] = name
        return subsessions

    @property
    def keyframe_files(self) -> dict[str, str]:
        """File of each keyframe list, relative to the session's folder, by the name of the list.

        The name is `<name>` for `proc/keyframes_<name>.txt`, and `queries` for LaMAR's `queries.txt`.
        """
        paths = sorted((self.path / "proc").glob("keyframes_*.txt"))
        files = {path.stem.removeprefix("keyframes_"): f"proc/{path.name}" for path in paths}
        return files | ({"queries": "queries.txt"} if (self.path / "queries.txt").exists() else {})

    def keyframes(self, name: str = "keyframes_pruned_subsampled") -> pd.DataFrame:
        """Return a keyframe list, table [timestamp, device_id].

        Args:
            name: a list of `keyframe_files`, with or without the prefix `keyframes_`; or `all`: all device poses of
                the ground truth or, without it, all devices that took an image.

        Raises:
            CaptureError: there is no such list.
        """
        if name == "all":
            times, ids = times_of(self.images), self._devices[0]
            if self.ground_truth is not None:
                times, ids = self.ground_truth.timestamps, self.ground_truth.arrow_ids
            keys = pd.DataFrame({"timestamp": times, "device_id": as_pandas(ids)}, copy=False)
            return keys.drop_duplicates(ignore_index=True)
        short, files = name.removesuffix(".txt").removeprefix("keyframes_"), self.keyframe_files
        if short not in files:
            available = f"{', '.join([*files, 'all'])} (from {self.path / 'proc'}/keyframes_*.txt)"
            raise CaptureError(f"Session {self.id} has no keyframe list {name!r}; available: {available}.")
        if short not in self._keyframes:
            self._keyframes[short] = self._read(files[short]).frame("timestamp", "device_id")
        return self._keyframes[short].copy()

    # Devices and poses

    @cached_property
    def device_ids(self) -> Strings:
        """The device of each image, (N,) array of str: its rig at that time, else the sensor itself."""
        return self._devices[0].to_numpy(zero_copy_only=False)

    @cached_property
    def _devices(self) -> tuple[pa.Array, Ints]:
        """The device of each image, and its row of rigs.txt (-1 without a rig)."""
        return self._find_devices(times_of(self.images), as_strings(self.images["sensor_id"]))

    def _find_devices(self, timestamps: Ints, sensors: pa.Array) -> tuple[pa.Array, Ints]:
        rig_rows = _find_rigs(self.rigs, timestamps, sensors, self._posed_keys())
        in_rig = rig_rows >= 0
        if self.rigs is None or not in_rig.any():
            return sensors, rig_rows
        rigs = as_strings(self.rigs["rig_id"]).take(pa.array(np.where(in_rig, rig_rows, 0)))
        return pc.if_else(pa.array(in_rig), rigs, sensors), rig_rows

    def devices_of(self, timestamps: ArrayLike, sensor_ids: Any) -> tuple[Strings, Floats]:
        """Return the devices (n,) of sensors of any type at given times, and device_from_sensor (n, 4, 4).

        The device is the rig at that time, else the sensor itself, with an identity pose.
        """
        devices, rig_rows = self._find_devices(np.asarray(timestamps, np.int64), as_strings(sensor_ids))
        return devices.to_numpy(zero_copy_only=False), self._rig_from_sensor(rig_rows)

    def _rig_from_sensor(self, rig_rows: Ints) -> Floats:
        """Return rig_from_sensor, (n, 4, 4), for rows of rigs.txt; the identity for -1."""
        poses = np.tile(np.eye(4), (len(rig_rows), 1, 1))
        poses[rig_rows >= 0] = pose_from_qt(self._rig_qt[rig_rows[rig_rows >= 0]])
        return poses

    def _posed_keys(self) -> Iterator[tuple[Ints, pa.Array]]:
        """Yield timestamps and device ids of poses, then of keyframes: they tell which rigs exist at which time."""
        for trajectory in dict.fromkeys((self.trajectory, self.ground_truth)):
            if trajectory is not None:
                yield trajectory.timestamps, trajectory.arrow_ids
        for name in self.keyframe_files:
            keys = self.keyframes(name)
            yield times_of(keys), as_strings(keys["device_id"])

    @property
    def rig_from_sensor_table(self) -> Floats:
        """rig_from_sensor of each row of `rigs`, (R, 4, 4) float64, meters."""
        return pose_from_qt(self._rig_qt)

    def rig_from_cam(self, rows: Rows = None) -> Floats:
        """Return rig_from_cam of images, (n, 4, 4) float64; the identity for a camera without a rig."""
        return self._rig_from_sensor(self._devices[1][_selection(rows)])

    def world_from_cam(self, rows: Rows = None, ground_truth: bool = False) -> Floats:
        """Return world_from_cam of images, (n, 4, 4) float64, meters; NaN where there is no pose.

        Args:
            rows: rows of `images`; None means all.
            ground_truth: use `ground_truth` instead of `trajectory`.
        """
        selection = np.arange(len(self.images))[_selection(rows)]
        trajectory = self.ground_truth if ground_truth else self.trajectory
        world_from_cam = np.full((len(selection), 4, 4), np.nan)
        if trajectory is None:
            return world_from_cam
        devices, rig_rows = self._devices
        pose_rows = trajectory.index.find(times_of(self.images)[selection], devices.take(pa.array(selection)))
        posed = np.flatnonzero(pose_rows >= 0)
        for block in np.split(posed, range(16384, len(posed), 16384)):  # intermediate arrays are several times larger
            poses, rigs = pose_from_qt(trajectory.qt[pose_rows[block]]), rig_rows[selection[block]]
            in_rig = rigs >= 0
            poses[in_rig] = poses[in_rig] @ pose_from_qt(self._rig_qt[rigs[in_rig]])
            world_from_cam[block] = poses
        return world_from_cam

    def poses_of_sensor(self, sensor_id: str) -> tuple[Ints, Floats]:
        """Return the times of a sensor's poses, (n,) ascending microseconds, and world_from_sensor, (n, 4, 4).

        These are the poses in `trajectory` of the sensor itself and of all rigs that hold it.
        """
        if self.trajectory is None:
            return np.zeros(0, np.int64), np.zeros((0, 4, 4))
        devices, qt = [sensor_id], np.zeros((0, 7))
        if self.rigs is not None:
            held = np.flatnonzero(self.rigs["sensor_id"] == sensor_id)
            devices, qt = [*self.rigs["rig_id"].iloc[held], sensor_id], self._rig_qt[held]
        codes = codes_of(self.trajectory.arrow_ids, as_strings(devices))
        rows = np.flatnonzero(codes >= 0)
        rows = rows[np.argsort(self.trajectory.timestamps[rows], kind="stable")]
        poses, in_rig = pose_from_qt(self.trajectory.qt[rows]), codes[rows] < len(qt)
        poses[in_rig] = poses[in_rig] @ pose_from_qt(qt[codes[rows][in_rig]])
        return self.trajectory.timestamps[rows], poses

    @cached_property
    def _image_index(self) -> tuple[KeyIndex, Ints]:
        """An index of the images of cameras by (timestamp, device_id), and the row of each in `images`."""
        non_cameras = self.sensors["sensor_id"][self.sensors["sensor_type"] != "camera"]
        images = np.flatnonzero(~self.images["sensor_id"].isin(non_cameras))
        return KeyIndex(times_of(self.images)[images], self._devices[0].take(pa.array(images))), images

    def rows_of_keyframes(self, keyframes: pd.DataFrame) -> list[Ints]:
        """Return, for each row of a keyframe table, the rows in `images` of its camera images, in file order."""
        index, images = self._image_index
        return [images[rows] for rows in index.find_all(times_of(keyframes), keyframes["device_id"])]


def _linked_out(target: Path) -> str:
    how = f"Copy the file, or, if the link is yours: {names.HOW_TO_ALLOW}."
    return f"is a link to {target}, outside of the capture. {how}"


def _records(table: TextTable, column: str) -> pd.DataFrame:
    return table.frame("timestamp", "sensor_id", column).rename(columns={column: "path"})


def _selection(rows: Rows) -> Any:
    """Return rows as an index for arrays; None selects all."""
    if rows is None or isinstance(rows, slice):
        return slice(None) if rows is None else rows
    rows = np.atleast_1d(np.asarray(rows))
    return rows if rows.dtype == bool else rows.astype(np.int64)


def _find_rigs(
    rigs: pd.DataFrame | None, timestamps: Ints, sensors: pa.Array, posed: Iterable[tuple[Ints, pa.Array]]
) -> Ints:
    """Return the row of rigs.txt for each (timestamp, sensor), (n,), -1 where no rig holds the sensor.

    A sensor can be in any number of rigs, because rig ids often differ from frame to frame. The rig is the one with a
    pose or a keyframe at that time (`posed`: of several files, the first with an entry wins); without any, the sensor's
    only rig; as a last resort, the rig named after the timestamp.
    """
    rig_rows = np.full(len(timestamps), -1, np.int64)
    if rigs is None or rigs.empty:
        return rig_rows
    rig_ids, members = as_strings(rigs["rig_id"]), as_strings(rigs["sensor_id"])
    different_rigs = pc.unique(rig_ids)
    rows_of_rig = pd.DataFrame({"rig": codes_of(rig_ids, different_rigs), "row": np.arange(len(rigs))})
    unknown = np.ones(len(timestamps), bool)  # keys without a rig or a pose of the sensor itself so far
    for times, devices in posed:
        keys = np.flatnonzero(unknown)
        if not len(keys):
            return rig_rows
        rig_codes = codes_of(devices, different_rigs)
        if np.any(rig_codes < 0):  # a pose of the sensor itself takes precedence over that of its rig
            direct = KeyIndex(times, devices).find(timestamps[keys], sensors.take(pa.array(keys))) >= 0
            unknown[keys[direct]] = False
            keys = keys[~direct]
        held = pd.DataFrame({"time": times, "rig": rig_codes}).merge(rows_of_rig, on="rig")
        rows = held["row"].to_numpy(np.int64)
        index = KeyIndex(held["time"].to_numpy(np.int64), members.take(pa.array(rows)))
        matches = index.find(timestamps[keys], sensors.take(pa.array(keys)))
        keys, matches = keys[matches >= 0], matches[matches >= 0]
        rig_rows[keys], unknown[keys] = rows[matches], False

    keys = np.flatnonzero(unknown)
    if len(keys):
        only_rigs = np.flatnonzero(~rigs["sensor_id"].duplicated(keep=False))
        matches = codes_of(sensors.take(pa.array(keys)), members.take(pa.array(only_rigs)))
        rig_rows[keys] = np.append(only_rigs, -1)[matches]
        keys = keys[matches < 0]
    if len(keys):
        digits = pc.struct_field(pc.extract_regex(rig_ids, r"(?P<digits>[0-9]{1,18})[^/]*$"), "digits")
        rows = np.flatnonzero(pc.is_valid(digits).to_numpy(zero_copy_only=False))
        times = digits.take(pa.array(rows)).cast(pa.int64()).to_numpy()
        matches = KeyIndex(times, members.take(pa.array(rows))).find(timestamps[keys], sensors.take(pa.array(keys)))
        rig_rows[keys] = np.append(rows, -1)[matches]
    return rig_rows


class Capture:
    """A capture folder. A session is read at its first use."""

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        self.path = path.resolve() if path.name == ".." else path  # the folder's name is the scene's name
        if not self.path.is_dir():
            raise CaptureError(f"No such capture folder: {self.path}. Expected a folder that contains `sessions/`.")
        self._root = self.path / "sessions"
        if not self._root.is_dir():
            expected = f"{self.path.name}/sessions/<device>_<map|query>/images.txt"
            raise CaptureError(f"{self.path} is not a capture: it has no folder `sessions`. Expected {expected}.")
        require_name(self.name, "capture", self.path.parent)
        self._folders: dict[str, Path] = {}
        self.unreadable: dict[str, str] = {}
        """Why folders in `sessions` cannot be entered, by name."""
        for folder in sorted(self._root.iterdir()):
            name = session_id(folder.name)
            try:
                is_session = any((folder / file).exists() for file in ("sensors.txt", "images.txt"))
            except OSError as error:  # others go on
                log.warning("%s: left out: %s.", folder, error.strerror)
                self.unreadable[folder.name] = f"{folder}: {error.strerror}. Give yourself access to it, or move it."
                continue
            if is_session:
                require_name(folder.name, "session", self._root)
            if is_session and (name not in self._folders or folder.name == name):
                self._folders[name] = folder
        self.session_ids = sorted(self._folders)
        if not self.session_ids:
            found = "no folder in it has a sensors.txt or images.txt"
            raise CaptureError(f"{self._root} contains no session: {found}. Expected e.g. ios_map and hl_query.")
        self._sessions: dict[str, Session] = {}

    @classmethod
    def open(cls, path: str | Path) -> "Capture":
        """Open a capture folder.

        Raises:
            CaptureError: the folder is missing, has no `sessions/`, or contains no session.
        """
        return cls(path)

    @classmethod
    def from_sessions_root(cls, sessions_root: str | Path) -> "Capture":
        """Open the capture of a given `sessions` folder."""
        root = Path(sessions_root).absolute()
        if root.name != "sessions":
            raise CaptureError(f"{root} is not the `sessions` folder of a capture; expected <capture>/sessions.")
        return cls(root.parent)

    @classmethod
    def reconstruct(cls, sources: Sequence[str | Path], capture: str | Path, **options: Any) -> "Capture":
        """Make a map from photographs or videos without poses, and open it; see `exchange.reconstruct.reconstruct`."""
        # That module stands on captures, so it is imported by its name.
        made: Capture = import_module("toolkit.exchange.reconstruct").reconstruct(sources, capture, **options).capture
        return made

    @property
    def name(self) -> str:
        """Name of the folder, which is the name of the scene in all outputs."""
        return self.path.absolute().name

    @property
    def unit(self) -> str | None:
        """Unit of the map's poses: `m`, or None if the import of a map session has noted that it is unknown."""
        maps = [folder for folder in self._folders.values() if session_of(folder.name)[1] == "map"]
        units = [read_json(folder / IMPORT_RECORD).get("unit", "m") for folder in maps or self._folders.values()]
        return None if None in units else "m"

    def unit_of(self, setting: str | None) -> str | None:
        """Return the unit that a setting `unit` means: `m`, None if it is unknown, or for `auto` that of the import."""
        return self.unit if setting == "auto" else setting

    @property
    def devices(self) -> list[str]:
        """Keys of the devices that have a session."""
        sessions = (session_of(folder.name) for folder in self._folders.values())
        return in_order(device for device, split in sessions if split in SPLITS)

    def devices_with(self, split: str, device: str = "all") -> list[str]:
        """Return the devices that have a session of a split: all of them, or only the given one.

        Args:
            split: `map` or `query`.
            device: a device key, or `all` (also `auto`).

        Raises:
            CaptureError: no device has such a session, or the given one has none.
        """
        present = [key for key in self.devices if f"{key}_{split}" in self]
        if device in ("all", "auto") and present:
            return present
        if not present:
            expected = f"sessions/<device>_{split}, as made by `{COMMAND} import ... --split {split}`"
            alone = " Without queries, build the map: run MANIFEST --only map." if split == "query" else ""
            raise CaptureError(f"{self.path}: no {split} session. Expected {expected}.{alone}")
        if device not in present:
            known = f"Devices with one: {', '.join(present)} (or `all`)"
            raise CaptureError(f"No {split} session of device {device!r} in {self.path}. {known}.")
        return [device]

    def pairs(
        self, map_device: str = "all", query_device: str = "all", pairs: Iterable[Sequence[str]] | None = None
    ) -> list[tuple[str, str]]:
        """Return (map device, query device) of all pairs of devices as in `devices_with`, or else the given `pairs`."""
        if pairs is not None:
            return [(mapped, query) for mapped, query in pairs]
        return list(product(self.devices_with("map", map_device), self.devices_with("query", query_device)))

    def folder(self, session_id: str) -> Path:
        """Return the folder of a session."""
        return self._folders[session_id]

    def image_path(self, name: str) -> Path:
        """Return the file of an image by its name, as from `Session.image_name`.

        Raises:
            CaptureError: no session lists the image.
        """
        if (found := self.find_image(name)) is None:
            session = self[session_id(name.partition("/")[0])]
            raise CaptureError(f"{session.path / 'images.txt'}: has no image {name!r}. Run its stages again.")
        return found[0].image_path(found[1])

    def find_image(self, name: str) -> tuple[Session, int] | None:
        """Return the session of an image, and its row there, by its name; None if no session lists the image."""
        of_image = session_id(name.partition("/")[0])
        row = self[of_image].row_of_name.get(name) if of_image in self else None
        return None if row is None else (self[of_image], row)

    def __getitem__(self, session_id: str) -> Session:
        if session_id not in self.session_ids:
            known = ", ".join(self.session_ids)
            raise CaptureError(f"Capture {self.path} has no session {session_id!r}; known: {known}.")
        if session_id not in self._sessions:
            try:
                self._sessions[session_id] = Session.open(self._folders[session_id])
            except OSError as error:
                fault = f"{error.filename or 'a file'} cannot be read ({error.strerror})"
                raise CaptureError(f"{self._folders[session_id]}: {fault}.") from None
        return self._sessions[session_id]

    def usable(self, split: str) -> list[Session]:
        """Return the readable sessions of a split; log the others with the reason."""
        sessions = []
        for name in (name for name in self.session_ids if session_of(self._folders[name].name)[1] == split):
            try:
                sessions.append(self[name])
            except CaptureError as error:
                log.warning("%s is not used: %s", name, error)
        return sessions

    def _repr_html_(self) -> str:
        rows = "".join(f"<li>{escape(repr(session))}</li>" for split in SPLITS for session in self.usable(split))
        return f"<p><b>{escape(self.name)}</b>: {escape(str(self.path))}</p><ul>{rows}</ul>"

    def __contains__(self, session_id: object) -> bool:
        return session_id in self.session_ids

    def __iter__(self) -> Iterator[str]:
        return iter(self.session_ids)
