"""The CroCoDL/LaMAR capture format: read and write it. `toolkit.capture.check` looks for inconsistencies.

    CAPTURE/sessions/<device>_<map|query>/          (LaMAR: map, query_phone, query_hololens; see capture.devices)
        sensors.txt  rigs.txt  images.txt  depths.txt  trajectories.txt  raw_data/
        proc/subsessions.txt  proc/keyframes_*.txt  proc/alignment_trajectories.txt      (LaMAR: queries.txt)

Directions, said once: `trajectories.txt` and `alignment_trajectories.txt` hold world_from_device,
`rigs.txt` holds rig_from_sensor. Lengths are meters, timestamps int64 microseconds, quaternions qw qx qy qz.
An image is known by (timestamp, sensor_id), a device pose and a keyframe by (timestamp, device_id), where
the device is the rig or, for a sensor in no rig, the sensor itself.

A session may hold 200,000 images, sensors and rigs: tables stay columns (Arrow strings, NumPy numbers), and
nothing loops over rows in Python on the way in.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.cameras import parse_camera
from toolkit.capture.devices import SPLITS, in_order, session_id, session_of
from toolkit.capture.tables import (
    ID,
    INTEGER,
    NUMBER,
    POSE,
    POSE_NAMES,
    TEXT,
    Columns,
    Floats,
    Ints,
    KeyIndex,
    TextTable,
    as_strings,
    codes_of,
    convert,
    read_table,
    write_table,
)
from toolkit.errors import CaptureError
from toolkit.files import files_fingerprint, write_atomic
from toolkit.geometry import pose_from_qt, qt_from_pose

if TYPE_CHECKING:
    import pycolmap

Strings = NDArray[np.object_]
Rows = ArrayLike | slice | None

RAW_DATA = "raw_data"
ALIGNED = "proc/alignment_trajectories.txt"
DEPTH_SCALE = 1000.0  # depth maps are 16-bit PNGs in millimeters

COLUMNS: dict[str, Columns] = {
    "sensors.txt": (("sensor_id", ID), ("name", TEXT), ("sensor_type", ID)),
    "rigs.txt": (("rig_id", ID), ("sensor_id", ID), *POSE),
    "images.txt": (("timestamp", INTEGER), ("sensor_id", ID), ("image_path", ID)),
    "depths.txt": (("timestamp", INTEGER), ("sensor_id", ID), ("depth_path", ID)),
    "trajectories.txt": (("timestamp", INTEGER), ("device_id", ID), *POSE),
    ALIGNED: (("timestamp", INTEGER), ("device_id", ID), *POSE),
    "proc/subsessions.txt": (("subsession", ID),),
    "keyframes": (("timestamp", INTEGER), ("device_id", ID)),
}


class Trajectory:
    """Poses of devices over time, world_from_device.

    Attributes:
        timestamps: (N,) int64 microseconds.
        qt: (N, 7) float64: qw qx qy qz tx ty tz, as in the file.
    """

    def __init__(
        self,
        timestamps: ArrayLike,
        device_ids: Any,
        qt: ArrayLike,
        covariances: ArrayLike | None = None,
        source: Path | None = None,
    ) -> None:
        """
        Args:
            device_ids: N texts.
            covariances: (N, 6, 6), or None.
            source: file to read the covariances from when somebody asks for them.
        """
        self.timestamps = np.asarray(timestamps, np.int64)
        self._ids = as_strings(device_ids)
        self.qt = np.asarray(qt, np.float64).reshape(-1, 7)
        if not len(self.timestamps) == len(self._ids) == len(self.qt):
            raise ValueError(
                f"Expected as many timestamps as device ids and poses, got {len(self.timestamps)}, "
                f"{len(self._ids)} and {len(self.qt)}."
            )
        self._covariances = (
            None if covariances is None else np.asarray(covariances, np.float64).reshape(-1, 6, 6)
        )
        self._source = source

    @classmethod
    def from_poses(
        cls,
        timestamps: ArrayLike,
        device_ids: Any,
        world_from_device: ArrayLike,
        covariances: ArrayLike | None = None,
    ) -> "Trajectory":
        """Make a trajectory of poses (N, 4, 4)."""
        return cls(timestamps, device_ids, qt_from_pose(world_from_device), covariances)

    @classmethod
    def read(cls, path: str | Path) -> "Trajectory":
        """Read a trajectories file; columns after the pose that are no covariance are passed over.

        Raises:
            CaptureError: no such file, or a malformed line.
        """
        return cls.from_table(read_table(Path(path), COLUMNS["trajectories.txt"]))

    @classmethod
    def from_table(cls, table: TextTable) -> "Trajectory":
        """Make a trajectory of the rows of a trajectories file."""
        return cls(
            table.columns["timestamp"].to_numpy(),
            table.columns["device_id"],
            table.numbers(POSE_NAMES),
            source=table.path if table.has_extra and not table.problems else None,
        )

    def write(self, path: str | Path) -> None:
        """Write the file in one piece, with numbers that read back exactly; a covariance that is NaN is left out."""
        covariances, values = self.covariances, self.qt.tolist()
        if covariances is not None:
            known = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
            flat = covariances.reshape(-1, 36).tolist()
            values = [pose + flat[row] if known[row] else pose for row, pose in enumerate(values)]
        rows = zip(self.timestamps.tolist(), self._ids.to_pylist(), values, strict=True)
        write_table(
            Path(path),
            "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz, *covar",
            (f"{time}, {device}, {_numbers(row)}" for time, device, row in rows),
        )

    def __len__(self) -> int:
        return len(self.timestamps)

    @cached_property
    def device_ids(self) -> Strings:
        """(N,) array of str."""
        return self._ids.to_numpy(zero_copy_only=False)

    @property
    def covariances(self) -> Floats | None:
        """(N, 6, 6), NaN in rows without one, or None. Read from the file when first asked for."""
        if self._covariances is None and self._source is not None:
            extra = read_table(self._source, COLUMNS["trajectories.txt"], extra=True).columns["extra"]
            rows = np.flatnonzero(pc.equal(pc.count_substring(extra, ","), 35).to_numpy(zero_copy_only=False))
            if len(rows):
                self._covariances = np.full((len(self), 6, 6), np.nan)
                for start in range(0, len(rows), 4096):
                    part = rows[start : start + 4096]
                    values = pc.split_pattern(extra.take(pa.array(part)), ",").flatten()
                    numbers, _ = convert(pc.ascii_trim_whitespace(values), NUMBER)
                    self._covariances[part] = numbers.to_numpy().reshape(-1, 6, 6)
            self._source = None
        return self._covariances

    @property
    def world_from_device(self) -> Floats:
        """(N, 4, 4) float64, meters."""
        return pose_from_qt(self.qt)

    @cached_property
    def index(self) -> KeyIndex:
        """Finds rows by (timestamp, device_id)."""
        return KeyIndex(self.timestamps, self._ids)

    def lookup(self, timestamps: ArrayLike, device_ids: Any) -> Floats:
        """Return world_from_device, (n, 4, 4), of keys; NaN where there is no pose."""
        rows = self.index.find(np.atleast_1d(np.asarray(timestamps, np.int64)), as_strings(device_ids))
        poses = np.full((len(rows), 4, 4), np.nan)
        poses[rows >= 0] = pose_from_qt(self.qt[rows[rows >= 0]])
        return poses


class Session:
    """One folder of a capture: the recordings of one device, for the map or as queries.

    Attributes:
        path: the folder.
        device, split: a key of `toolkit.capture.devices`, and `map` or `query`; from the folder's name.
        id: `<device>_<split>`, the name of all that is made of the session.
        images: table [timestamp, sensor_id, path], in the order of images.txt; path is relative to raw_data/.
        sensors: table [sensor_id, name, sensor_type, params], params as written.
        rigs: table [rig_id, sensor_id], or None.
        trajectory: trajectories.txt, or None. Of a query session it is the device's own odometry, in a frame of its
            own: good for motion between two times, never a place in the map.
        ground_truth: poses in the world of the map: proc/alignment_trajectories.txt; of a map session without that
            file trajectories.txt; else None.
    """

    def __init__(self, path: str | Path, strict: bool = True) -> None:
        """Read a session; with strict=False leave malformed lines out and keep what was read in `tables`."""
        self.path = Path(path)
        self.device, self.split = session_of(self.path.name)
        self.id = session_id(self.path.name)
        self.tables: dict[str, TextTable] = {}
        self._strict = strict
        if not self.path.is_dir():
            raise CaptureError(f"No such session folder: {self.path}.")
        self._sensor_table = self._read("sensors.txt", extra=True)
        self.sensors = _frame(self._sensor_table, ["sensor_id", "name", "sensor_type"])
        self.sensors["params"] = _pandas(self._sensor_table.columns["extra"])
        self.images = self._records("images.txt", "image_path")
        self.rigs: pd.DataFrame | None = None
        self._rig_qt = np.zeros((0, 7))
        if (self.path / "rigs.txt").exists():
            table = self._read("rigs.txt")
            self.rigs = _frame(table, ["rig_id", "sensor_id"])
            self._rig_qt = table.numbers(POSE_NAMES)
        self.trajectory = self._trajectory("trajectories.txt")
        aligned = self._trajectory(ALIGNED)
        self.ground_truth = self.trajectory if aligned is None and self.split == "map" else aligned
        self._cameras: dict[str, pycolmap.Camera] = {}

    @classmethod
    def open(cls, path: str | Path) -> "Session":
        """Read a session.

        Raises:
            CaptureError: the folder, sensors.txt or images.txt is missing, or a line is malformed.
        """
        return cls(path)

    def __repr__(self) -> str:
        poses = 0 if self.ground_truth is None else len(self.ground_truth)
        return f"Session({self.id}: {len(self.images)} images, {len(self.sensors)} sensors, {poses} poses)"

    def __len__(self) -> int:
        return len(self.images)

    def _read(self, file: str, extra: bool = False) -> TextTable:
        columns = COLUMNS.get(file, COLUMNS["keyframes"])
        table = read_table(self.path / file, columns, self._strict, extra)
        if not self._strict:
            self.tables[file] = table
        return table

    def _records(self, file: str, column: str) -> pd.DataFrame:
        table = self._read(file)
        return _frame(table, ["timestamp", "sensor_id", column]).rename(columns={column: "path"})

    def _trajectory(self, file: str) -> Trajectory | None:
        return Trajectory.from_table(self._read(file)) if (self.path / file).exists() else None

    # Files

    def image_path(self, row: int) -> Path:
        """Return the file of an image."""
        return self.path / RAW_DATA / self.images["path"].iloc[row]

    def image_name(self, row: int) -> str:
        """Return the name of an image in the whole capture: its path relative to sessions/."""
        return f"{self.path.name}/{RAW_DATA}/{self.images['path'].iloc[row]}"

    @cached_property
    def image_names(self) -> list[str]:
        """The names of all images, in the order of `images`."""
        return [f"{self.path.name}/{RAW_DATA}/{path}" for path in self.images["path"]]

    @cached_property
    def row_of_name(self) -> dict[str, int]:
        """Row of `images` by the image's name."""
        return {name: row for row, name in enumerate(self.image_names)}

    @cached_property
    def depths(self) -> pd.DataFrame | None:
        """Table [timestamp, sensor_id, path] of depths.txt, or None."""
        return self._records("depths.txt", "depth_path") if (self.path / "depths.txt").exists() else None

    @cached_property
    def camera_rows(self) -> Ints:
        """Rows of `images` that were taken by cameras, in file order."""
        codes = codes_of(as_strings(self.images["sensor_id"]), as_strings(self.sensors["sensor_id"]))
        if (codes < 0).any():
            self._sensor_row(str(self.images["sensor_id"].iloc[int(np.argmax(codes < 0))]))
        return np.flatnonzero((self.sensors["sensor_type"] == "camera").to_numpy(bool)[codes])

    @cached_property
    def files_fingerprint(self) -> str:
        """16 hex digits that identify the image files as they were when first asked."""
        return files_fingerprint([self.image_path(row) for row in range(len(self.images))])

    @cached_property
    def _depth_index(self) -> KeyIndex | None:
        return None if self.depths is None else KeyIndex(_times(self.depths), self.depths["sensor_id"])

    def depth_path(self, timestamp: int, sensor_id: str) -> Path | None:
        """Return the depth map of a depth sensor at a time, None if there is none."""
        if self.depths is None or self._depth_index is None:
            return None
        (row,) = self._depth_index.find(np.array([timestamp], np.int64), [sensor_id])
        return None if row < 0 else self.path / RAW_DATA / self.depths["path"].iloc[row]

    @cached_property
    def depths_fingerprint(self) -> str:
        """16 hex digits that identify the list of depth maps and their files as they were when first asked."""
        if self.depths is None:
            return ""
        root = self.path / RAW_DATA
        return files_fingerprint([self.path / "depths.txt", *(root / path for path in self.depths["path"])])

    # Sensors

    @cached_property
    def _sensor_rows(self) -> dict[str, int]:
        return {sensor: row for row, sensor in enumerate(self._sensor_table.columns["sensor_id"].to_pylist())}

    def _sensor_row(self, sensor_id: str) -> int:
        row = self._sensor_rows.get(sensor_id)
        if row is None:
            raise CaptureError(
                f"Unknown sensor {sensor_id!r} in session {self.id}: no such line in "
                f"{self._sensor_table.path} (but {len(self.sensors)}, e.g. {list(self._sensor_rows)[:3]}). "
                "Add it there, or correct the id where it is used."
            )
        return row

    def has_sensor(self, sensor_id: str) -> bool:
        """Tell whether sensors.txt has a sensor."""
        return sensor_id in self._sensor_rows

    def is_camera(self, sensor_id: str) -> bool:
        """Tell whether a sensor takes photographs (type `camera`; a `depth` camera does not)."""
        return self.sensors["sensor_type"].iloc[self._sensor_row(sensor_id)] == "camera"

    def camera(self, sensor_id: str) -> "pycolmap.Camera":
        """Return the intrinsics of a `camera` or `depth` sensor: any camera model of COLMAP.

        Raises:
            CaptureError: no such sensor, not a camera, unknown model or wrong parameters; names the line.
        """
        if sensor_id not in self._cameras:
            row = self._sensor_row(sensor_id)
            kind, params = self.sensors["sensor_type"].iloc[row], self.sensors["params"].iloc[row]
            try:
                self._cameras[sensor_id] = parse_camera(kind, params)
            except ValueError as error:
                raise CaptureError(
                    f"{self._sensor_table.where(row)}: sensor {sensor_id!r}: {error}"
                ) from None
        return self._cameras[sensor_id]

    # Subsessions and keyframes

    @cached_property
    def subsessions(self) -> list[str]:
        """The recordings in the session: proc/subsessions.txt, else the first folders of image paths."""
        if self._has_subsessions:
            return self._read("proc/subsessions.txt").columns["subsession"].to_pylist()
        return sorted(set(self._first_folders().to_pylist()))

    @property
    def _has_subsessions(self) -> bool:
        return (self.path / "proc" / "subsessions.txt").exists()

    def _first_folders(self) -> pa.Array:
        parts = pc.split_pattern(as_strings(self.images["path"]), "/", max_splits=1)
        return pc.if_else(pc.greater(pc.list_value_length(parts), 1), pc.list_element(parts, 0), self.id)

    def subsession_of(self, rows: Rows = None) -> Strings:
        """Return the subsession of images, (n,) str: the longest that starts path or sensor id, else ""."""
        return self._subsession_of_image[_selection(rows)]

    @cached_property
    def _subsession_of_image(self) -> Strings:
        if not self._has_subsessions:
            return self._first_folders().to_numpy(zero_copy_only=False)
        found = np.full(len(self.images), "", object)
        columns = [as_strings(self.images[name]) for name in ("sensor_id", "path")]
        for name in sorted(self.subsessions, key=len):
            for column in columns:
                found[pc.starts_with(column, f"{name}/").to_numpy(zero_copy_only=False)] = name
        return found

    @property
    def keyframe_files(self) -> dict[str, str]:
        """The lists, by name: proc/keyframes_<name>.txt, and `queries` of LaMAR; relative to the session's folder."""
        found = sorted(path.name for path in (self.path / "proc").glob("keyframes_*.txt"))
        files = {name.removesuffix(".txt").removeprefix("keyframes_"): f"proc/{name}" for name in found}
        return files | ({"queries": "queries.txt"} if (self.path / "queries.txt").exists() else {})

    @property
    def keyframe_lists(self) -> list[str]:
        """Names of the lists."""
        return list(self.keyframe_files)

    def keyframes(self, name: str = "keyframes_pruned_subsampled") -> pd.DataFrame:
        """Return a keyframe list, table [timestamp, device_id].

        Args:
            name: a list of `keyframe_lists`, with or without the prefix `keyframes_`; or `all`: every device
                pose of the ground truth, without one every device that took an image.

        Raises:
            CaptureError: there is no such list.
        """
        if name == "all":
            if self.ground_truth is not None:
                return _keys_frame(self.ground_truth.timestamps, self.ground_truth._ids)
            keys = _keys_frame(_times(self.images), self._devices[0])
            return keys.drop_duplicates(ignore_index=True)
        short = name.removesuffix(".txt").removeprefix("keyframes_")
        files = self.keyframe_files
        if short not in files:
            raise CaptureError(
                f"Session {self.id} has no keyframe list {name!r}; available: "
                f"{', '.join([*files, 'all'])} (from {self.path / 'proc'}/keyframes_*.txt)."
            )
        return _frame(self._read(files[short]), ["timestamp", "device_id"])

    # Devices and poses

    @cached_property
    def device_ids(self) -> Strings:
        """The posed device of each image, (N,) array of str: its rig at that time, else the sensor itself."""
        return self._devices[0].to_numpy(zero_copy_only=False)

    @cached_property
    def _devices(self) -> tuple[pa.Array, Ints]:
        """The device of each image, and the row of rigs.txt that holds it there (-1 without a rig)."""
        sensors = as_strings(self.images["sensor_id"])
        rig_rows = self._find_rigs(_times(self.images), sensors)
        if self.rigs is None or not np.any(rig_rows >= 0):
            return sensors, rig_rows
        in_rig = rig_rows >= 0
        rigs = as_strings(self.rigs["rig_id"]).take(pa.array(np.where(in_rig, rig_rows, 0)))
        return pc.if_else(pa.array(in_rig), rigs, sensors), rig_rows

    def _find_rigs(self, timestamps: Ints, sensors: pa.Array) -> Ints:
        """Return the row of rigs.txt for each (timestamp, sensor), -1 where none applies.

        Rig ids are often made anew for each frame, so a sensor can be in any number of rigs: the one that has
        a pose, or is a keyframe, at that time counts. Where no file says so: the sensor's only rig; as a
        last resort, the rig named by the timestamp.
        """
        rig_rows = np.full(len(timestamps), -1, np.int64)
        if self.rigs is None or self.rigs.empty:
            return rig_rows
        rig_ids, rig_sensors = as_strings(self.rigs["rig_id"]), as_strings(self.rigs["sensor_id"])
        known_rigs = pc.unique(rig_ids)
        by_rig = np.argsort(codes_of(rig_ids, known_rigs), kind="stable")
        sizes = np.bincount(codes_of(rig_ids, known_rigs))
        starts = np.cumsum(sizes) - sizes

        alone = np.zeros(len(timestamps), bool)
        for times, devices in self._posed_keys():
            todo = np.flatnonzero((rig_rows < 0) & ~alone)
            if not len(todo):
                return rig_rows
            codes = codes_of(devices, known_rigs)
            if np.any(codes < 0):  # a pose of the sensor itself comes before its rig's
                direct = KeyIndex(times, devices).find(timestamps[todo], sensors.take(pa.array(todo)))
                alone[todo] = direct >= 0
                todo = todo[direct < 0]
            times, codes = times[codes >= 0], codes[codes >= 0]
            # Every posed rig holds `sizes` sensors: one (timestamp, sensor) key for each.
            poses = np.repeat(np.arange(len(codes)), sizes[codes])
            within = np.arange(len(poses)) - np.repeat(np.cumsum(sizes[codes]) - sizes[codes], sizes[codes])
            rows = by_rig[starts[codes[poses]] + within]
            found = KeyIndex(times[poses], rig_sensors.take(pa.array(rows))).find(
                timestamps[todo], sensors.take(pa.array(todo))
            )
            rig_rows[todo[found >= 0]] = rows[found[found >= 0]]

        todo = np.flatnonzero((rig_rows < 0) & ~alone)
        if len(todo):
            known_sensors = pc.unique(rig_sensors)
            codes = codes_of(rig_sensors, known_sensors)
            only = np.full(len(known_sensors), -1, np.int64)
            only[codes] = np.arange(len(codes))
            only[np.bincount(codes) > 1] = -1
            of_image = codes_of(sensors.take(pa.array(todo)), known_sensors)
            rig_rows[todo] = np.where(of_image >= 0, only[of_image], -1)
            todo = todo[(rig_rows[todo] < 0) & (of_image >= 0)]
        if len(todo):
            name = pc.struct_field(pc.extract_regex(rig_ids, r"(?P<name>[^/]*)$"), "name")
            digits = pc.struct_field(pc.extract_regex(name, r"^[^0-9]*(?P<digits>[0-9]{1,18})"), "digits")
            named = np.flatnonzero(pc.is_valid(digits).to_numpy(zero_copy_only=False))
            named_times = digits.take(pa.array(named)).cast(pa.int64()).to_numpy()
            index = KeyIndex(named_times, rig_sensors.take(pa.array(named)))
            found = index.find(timestamps[todo], sensors.take(pa.array(todo)))
            rig_rows[todo[found >= 0]] = named[found[found >= 0]]
        return rig_rows

    def devices_of(self, timestamps: ArrayLike, sensor_ids: Any) -> tuple[Strings, Floats]:
        """Return the posed device of sensors of any type at given times, (n,), and device_from_sensor (n, 4, 4).

        The device is the rig at that time, else the sensor itself, with the identity.
        """
        sensors = as_strings(sensor_ids)
        rig_rows = self._find_rigs(np.asarray(timestamps, np.int64), sensors)
        devices, poses = sensors.to_numpy(zero_copy_only=False).copy(), np.tile(np.eye(4), (len(rig_rows), 1, 1))
        if self.rigs is not None and np.any(rig_rows >= 0):
            held = rig_rows >= 0
            devices[held] = self.rigs["rig_id"].to_numpy()[rig_rows[held]]
            poses[held] = pose_from_qt(self._rig_qt[rig_rows[held]])
        return devices, poses

    def _posed_keys(self) -> Iterator[tuple[Ints, pa.Array]]:
        if self.trajectory is not None:
            yield self.trajectory.timestamps, self.trajectory._ids
        if self.ground_truth is not None and self.ground_truth is not self.trajectory:
            yield self.ground_truth.timestamps, self.ground_truth._ids
        for name in self.keyframe_lists:
            keys = self.keyframes(name)
            yield _times(keys), as_strings(keys["device_id"])

    @property
    def rig_from_sensor_table(self) -> Floats:
        """rig_from_sensor of each row of `rigs`, (R, 4, 4) float64, meters."""
        return pose_from_qt(self._rig_qt)

    def rig_from_cam(self, rows: Rows = None) -> Floats:
        """Return rig_from_cam of images, (n, 4, 4) float64; the identity for a camera without a rig."""
        rig_rows = self._devices[1][_selection(rows)]
        poses = np.tile(np.eye(4), (len(rig_rows), 1, 1))
        poses[rig_rows >= 0] = pose_from_qt(self._rig_qt[rig_rows[rig_rows >= 0]])
        return poses

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
        pose_rows = trajectory.index.find(_times(self.images)[selection], devices.take(pa.array(selection)))
        for start in range(0, len(selection), 16384):  # in parts: the products need several times the result
            part = slice(start, start + 16384)
            poses, rigs = pose_rows[part], rig_rows[selection[part]]
            known = poses >= 0
            world_from_rig = pose_from_qt(trajectory.qt[poses[known]])
            in_rig = rigs[known] >= 0
            world_from_rig[in_rig] = world_from_rig[in_rig] @ pose_from_qt(self._rig_qt[rigs[known][in_rig]])
            world_from_cam[part][known] = world_from_rig
        return world_from_cam

    def poses_of_sensor(self, sensor_id: str) -> tuple[Ints, Floats]:
        """Return when a sensor has a pose, (n,) microseconds ascending, and world_from_sensor then, (n, 4, 4).

        Of `trajectory`: the poses of the sensor itself and of all rigs that hold it.
        """
        if self.trajectory is None:
            return np.zeros(0, np.int64), np.zeros((0, 4, 4))
        devices, qt = [sensor_id], np.zeros((0, 7))
        if self.rigs is not None:
            held = np.flatnonzero(self.rigs["sensor_id"] == sensor_id)
            devices, qt = [*self.rigs["rig_id"].iloc[held], sensor_id], self._rig_qt[held]
        codes = codes_of(self.trajectory._ids, as_strings(devices))
        rows = np.flatnonzero(codes >= 0)
        rows = rows[np.argsort(self.trajectory.timestamps[rows], kind="stable")]
        poses, in_rig = pose_from_qt(self.trajectory.qt[rows]), codes[rows] < len(qt)
        poses[in_rig] = poses[in_rig] @ pose_from_qt(qt[codes[rows][in_rig]])
        return self.trajectory.timestamps[rows], poses

    @cached_property
    def _image_index(self) -> tuple[KeyIndex, Ints]:
        """Finds photographs by (timestamp, device_id), among the rows given second."""
        types = as_strings(self.sensors["sensor_type"])
        others = as_strings(self.sensors["sensor_id"]).filter(pc.not_equal(types, "camera"))
        photographs = np.flatnonzero(codes_of(as_strings(self.images["sensor_id"]), others) < 0)
        devices = self._devices[0].take(pa.array(photographs))
        return KeyIndex(_times(self.images)[photographs], devices), photographs

    def rows_of(self, timestamp: int, device_id: str) -> Ints:
        """Return the rows of `images` that a device photographed at a time, in file order; no depth maps."""
        index, photographs = self._image_index
        return photographs[index.find_all(np.array([timestamp], np.int64), [device_id])[0]]

    def rows_of_keyframes(self, keyframes: pd.DataFrame) -> list[Ints]:
        """Return, for each row of a keyframe table, the rows of `images` (see `rows_of`)."""
        index, photographs = self._image_index
        return [photographs[rows] for rows in index.find_all(_times(keyframes), keyframes["device_id"])]


def _frame(table: TextTable, names: Sequence[str]) -> pd.DataFrame:
    return pd.DataFrame({name: _pandas(table.columns[name]) for name in names}, copy=False)


def _keys_frame(timestamps: Ints, device_ids: pa.Array) -> pd.DataFrame:
    return pd.DataFrame({"timestamp": timestamps, "device_id": _pandas(device_ids)}, copy=False)


def _pandas(column: pa.Array) -> Any:
    """Return a column for a table: numbers as NumPy, texts as pandas' str on Arrow memory."""
    if pa.types.is_large_string(column.type):
        return pd.array(column, dtype=pd.StringDtype("pyarrow", na_value=np.nan))
    return column.to_numpy()


def _times(table: pd.DataFrame) -> Ints:
    return table["timestamp"].to_numpy(np.int64)


def _selection(rows: Rows) -> Any:
    if rows is None or isinstance(rows, slice):
        return slice(None) if rows is None else rows
    rows = np.atleast_1d(np.asarray(rows))
    return rows if rows.dtype == bool else rows.astype(np.int64)


class Capture:
    """A capture folder: its sessions, each read when first asked for."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise CaptureError(
                f"No such capture folder: {self.path}. Expected a folder that holds `sessions/`."
            )
        self._root = self.path / "sessions"
        if not self._root.is_dir():
            raise CaptureError(
                f"{self.path} is not a capture: it has no folder `sessions`. Expected "
                f"{self.path.name}/sessions/<device>_<map|query>/images.txt."
            )
        self._folders: dict[str, Path] = {}
        for folder in sorted(folder for folder in self._root.iterdir() if _is_session(folder)):
            name = session_id(folder.name)
            if name not in self._folders or folder.name == name:
                self._folders[name] = folder
        self.session_ids = sorted(self._folders)
        if not self.session_ids:
            raise CaptureError(
                f"{self._root} holds no session: no folder in it has a sensors.txt or images.txt. "
                "Expected e.g. ios_map, hl_query."
            )
        self._sessions: dict[str, Session] = {}

    @classmethod
    def open(cls, path: str | Path) -> "Capture":
        """Open a capture folder.

        Raises:
            CaptureError: no such folder, no `sessions/` in it, or nothing in that.
        """
        return cls(path)

    @classmethod
    def from_sessions_root(cls, sessions_root: str | Path) -> "Capture":
        """Open the capture whose `sessions` folder this is."""
        root = Path(sessions_root).absolute()
        if root.name != "sessions":
            raise CaptureError(
                f"{root} is not the `sessions` folder of a capture; expected <capture>/sessions."
            )
        return cls(root.parent)

    @property
    def name(self) -> str:
        """Name of the folder; the scene's name in all outputs."""
        return self.path.absolute().name

    @property
    def devices(self) -> list[str]:
        """The device keys that have a session."""
        found = (session_of(folder.name) for folder in self._folders.values())
        return in_order(device for device, split in found if split in SPLITS)

    def devices_with(self, split: str, device: str = "all") -> list[str]:
        """Return the devices that have a session of a split, all of them or the one asked for.

        Args:
            split: `map` or `query`.
            device: a device key, or `all` (also `auto`).

        Raises:
            CaptureError: no device, or not this one, has such a session.
        """
        present = [key for key in self.devices if f"{key}_{split}" in self]
        if device in ("all", "auto") and present:
            return present
        if device not in present:
            raise CaptureError(
                f"No {split} session of device {device!r} in {self.path}. "
                f"Devices with one: {', '.join(present) or 'none'} (or `all`)."
            )
        return [device]

    def folder(self, session_id: str) -> Path:
        """Return the folder of a session."""
        return self._folders[session_id]

    def __getitem__(self, session_id: str) -> Session:
        if session_id not in self.session_ids:
            raise CaptureError(
                f"Capture {self.path} has no session {session_id!r}; known: {', '.join(self.session_ids)}."
            )
        if session_id not in self._sessions:
            self._sessions[session_id] = Session.open(self._folders[session_id])
        return self._sessions[session_id]

    def __contains__(self, session_id: object) -> bool:
        return session_id in self.session_ids

    def __iter__(self) -> Iterator[str]:
        return iter(self.session_ids)

    def __len__(self) -> int:
        return len(self.session_ids)


def _is_session(folder: Path) -> bool:
    return (folder / "sensors.txt").exists() or (folder / "images.txt").exists()


def write_session(
    path: str | Path,
    sensors: Iterable[Sequence[Any]],
    rigs: Iterable[tuple[str, str, ArrayLike]] | None,
    trajectory: Trajectory | None,
    images: pd.DataFrame | Iterable[tuple[int, str, str]],
    depths: pd.DataFrame | Iterable[tuple[int, str, str]] | None = None,
    subsessions: Sequence[str] | None = None,
    keyframes: dict[str, pd.DataFrame] | None = None,
    ground_truth: Trajectory | None = None,
) -> Path:
    """Write the text files of a session (not the images); what is None is not written.

    Args:
        path: the session's folder; made where it does not exist.
        sensors: rows (sensor_id, name, sensor_type, parameter, ...).
        rigs: rows (rig_id, sensor_id, rig_from_sensor), the pose as (4, 4) or as qw qx qy qz tx ty tz.
        images, depths: rows (timestamp, sensor_id, path relative to raw_data/).
        keyframes: tables [timestamp, device_id] by name, e.g. `pruned_subsampled`.
        ground_truth: goes to proc/alignment_trajectories.txt.

    Returns:
        The folder.

    Raises:
        ValueError: a value has a comma or line break, which the format cannot hold.
    """
    path = Path(path)
    proc = path / "proc"
    write_table(path / "sensors.txt", "sensor_id, name, sensor_type, [sensor_params]+", map(_row, sensors))
    if rigs is not None:
        poses = ((rig, sensor, np.asarray(pose, np.float64)) for rig, sensor, pose in rigs)
        rows = (
            (rig, sensor, *(qt_from_pose(pose) if pose.shape == (4, 4) else pose).tolist())
            for rig, sensor, pose in poses
        )
        write_table(path / "rigs.txt", "rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz", map(_row, rows))
    write_table(path / "images.txt", "timestamp, sensor_id, image_path", map(_row, _records_of(images)))
    if depths is not None:
        write_table(path / "depths.txt", "timestamp, sensor_id, depth_path", map(_row, _records_of(depths)))
    if trajectory is not None:
        trajectory.write(path / "trajectories.txt")
    if ground_truth is not None:
        ground_truth.write(path / ALIGNED)
    if subsessions is not None:
        write_table(proc / "subsessions.txt", None, (_row([name]) for name in subsessions))
    for name, table in (keyframes or {}).items():
        file = proc / f"keyframes_{name.removeprefix('keyframes_')}.txt"
        # The benchmark writes these without a header, and its evaluation reads them so.
        write_table(file, None, map(_row, zip(_times(table).tolist(), table["device_id"], strict=True)))
    return path


def _records_of(table: pd.DataFrame | Iterable[tuple[int, str, str]]) -> Iterable[Sequence[Any]]:
    return table.itertuples(index=False) if isinstance(table, pd.DataFrame) else table


def _row(values: Sequence[Any]) -> str:
    texts = [repr(float(value)) if isinstance(value, float) else str(value) for value in values]
    for text in texts:
        if "," in text or "\n" in text:
            raise ValueError(f"The capture format cannot hold a comma or line break: {text!r}.")
    return ", ".join(texts)


def _numbers(values: Iterable[float]) -> str:
    # repr is the shortest text that reads back as the same number
    return ", ".join(map(repr, values))


def read_depth(path: str | Path) -> NDArray[np.float32]:
    """Return a depth map, (H, W) float32 meters along the camera's z axis, 0 where unknown.

    Raises:
        CaptureError: the file is missing or is not a 16-bit image.
    """
    import cv2

    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if Path(path).exists() else None
    if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
        found = "no such file" if not Path(path).exists() else "no 16-bit image of one channel"
        raise CaptureError(f"Depth map {path}: {found}. Expected a 16-bit PNG in millimeters.")
    return (depth / np.float32(DEPTH_SCALE)).astype(np.float32)


def write_depth(path: str | Path, depth_m: ArrayLike) -> None:
    """Write a depth map (H, W), meters, as a 16-bit PNG in millimeters; beyond 65.5 m becomes unknown."""
    import cv2

    millimeters = np.round(np.asarray(depth_m, np.float64) * DEPTH_SCALE)
    millimeters = np.where(
        np.isfinite(millimeters) & (millimeters >= 0) & (millimeters <= 65535), millimeters, 0
    )
    done, png = cv2.imencode(".png", millimeters.astype(np.uint16))
    if not done:
        raise CaptureError(
            f"Depth map of shape {millimeters.shape} cannot be written to {path}; expected (H, W)."
        )
    with write_atomic(path) as temporary:
        temporary.write_bytes(png.tobytes())
