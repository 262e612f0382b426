"""Text tables of the capture format: their columns, a fast reader, an index of rows by key; poses of devices over time;
and the writer of a session's files, with its depth maps.

The reader accepts comma-separated values with `#` comments and blank lines anywhere, spaces around values, Windows line
ends and a byte-order mark. Columns beyond the expected ones are ignored or kept as one text; their number varies from
line to line, which the CSV readers of Arrow and pandas refuse. So Arrow's functions on texts split the lines and
convert the columns. Only malformed values are looked at one by one, and error messages name the line.
"""

import errno
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.images import decode
from toolkit.capture.names import EXPECTED_NAME, HOW_TO_ALLOW, bad_names, outside_allowed
from toolkit.errors import COMMAND, ArtifactError, CaptureError, ImageError
from toolkit.files import write_atomic
from toolkit.geometry import Floats, Ints, pose_from_qt, qt_from_pose

log = logging.getLogger(__name__)
Columns = Sequence[tuple[str, str]]
# Column types. METERS is a bounded coordinate, ID a valid name, PATH the path of an image, TEXT any text.
INTEGER, NUMBER, METERS, LATITUDE, LONGITUDE = "integer", "finite number", "meters", "latitude", "longitude"
ID, PATH, TEXT = "id", "path", "text"
FARTHEST_M = 1e12  # largest coordinate, meters: beyond any place, and small enough that its square is finite
POSE_NAMES = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
POSE = tuple((name, NUMBER if name.startswith("q") else METERS) for name in POSE_NAMES)
ALIGNED = "proc/alignment_trajectories.txt"
_TRAJECTORY: Columns = (("timestamp", INTEGER), ("device_id", ID), *POSE)
_DBM = ("rssi_dbm", NUMBER)
COLUMNS: dict[str, Columns] = {
    "sensors.txt": (("sensor_id", ID), ("name", TEXT), ("sensor_type", ID)),
    "rigs.txt": (("rig_id", ID), ("sensor_id", ID), *POSE),
    "images.txt": (("timestamp", INTEGER), ("sensor_id", ID), ("image_path", PATH)),
    "depths.txt": (("timestamp", INTEGER), ("sensor_id", ID), ("depth_path", PATH)),
    "wifi.txt": (("timestamp", INTEGER), ("sensor_id", ID), ("mac_addr", ID), ("frequency_khz", NUMBER), _DBM),
    "bt.txt": (("timestamp", INTEGER), ("sensor_id", ID), ("id", ID), _DBM),
    "gps.txt": (
        *(("timestamp", INTEGER), ("sensor_id", ID), ("latitude_deg", LATITUDE), ("longitude_deg", LONGITUDE)),
        *(("altitude_m", METERS), ("horizontal_accuracy_m", METERS)),
    ),
    "trajectories.txt": _TRAJECTORY,
    ALIGNED: _TRAJECTORY,
    "proc/subsessions.txt": (("subsession", ID),),
    "keyframes": (("timestamp", INTEGER), ("device_id", ID)),
}
"""Names and types of the columns of each file of a session. Further columns of wifi.txt and bt.txt (name, times of the
scan) are not used."""
SIGNALS = ("wifi.txt", "bt.txt")  # files whose keys may repeat, because a scan may receive an emitter several times
_TYPES: dict[str, tuple[pa.DataType, float | None, str]] = {
    INTEGER: (pa.int64(), None, "an integer (microseconds)"),
    NUMBER: (pa.float64(), np.inf, "a finite number"),
    METERS: (pa.float64(), FARTHEST_M, f"a finite number of meters, at most {FARTHEST_M:.0e}"),
    LATITUDE: (pa.float64(), 90.0, "degrees from -90 to 90"),
    LONGITUDE: (pa.float64(), 180.0, "degrees from -180 to 180"),
    ID: (pa.large_string(), None, EXPECTED_NAME),
    PATH: (pa.large_string(), None, f"{EXPECTED_NAME}, below raw_data/ (for your own files elsewhere, {HOW_TO_ALLOW})"),
    TEXT: (pa.large_string(), None, "any text"),
}
"""Type in memory, largest absolute value, and what is expected, for messages, of each type of column."""
POSES_UNIT = {"position_std": "position_std_m", "moved": "moved_m"}
"""Columns of lengths in a pair's table if the unit of its poses is unknown, and their names where it is the meter."""
UNKNOWN_DEPTH = 65535  # what some cameras write where they have none
DEPTH_SCALE = 1000.0  # depth maps are 16-bit PNGs in millimeters
_WIFI = "mac_addr, frequency_khz, rssi_dbm, name, scan_time_start_us, scan_time_end_us"
_BLUETOOTH = "id, rssi_dbm, name"
Records: TypeAlias = pd.DataFrame | Iterable[tuple[int, str, str]]


def key_of(file: str) -> list[str]:
    """Return the columns that identify a row of a file of a session."""
    columns = COLUMNS.get(file, COLUMNS["keyframes"])
    return [name for name, _ in columns[: 1 if file in ("sensors.txt", "proc/subsessions.txt") else 2]]


@dataclass
class TextTable:
    """The well-formed rows of a text file, and the problems of its other lines."""

    path: Path
    columns: dict[str, pa.Array]  # values by column name; `extra`, if requested, holds the text after the last column
    lines: Ints  # line number of each row, from 1
    problems: list[tuple[int, str]]
    """Line number (0 for the whole file) and fault of each malformed line; these lines are not in `columns`."""
    has_extra: bool  # whether any line has more columns than expected

    def __len__(self) -> int:
        return len(self.lines)

    def numbers(self, names: Sequence[str]) -> Floats:
        """Return number columns side by side, (N, len(names))."""
        return np.stack([self.columns[name].to_numpy() for name in names], axis=1)

    def frame(self, *names: str) -> pd.DataFrame:
        """Return columns as a table: numbers as NumPy arrays, texts as pandas' str on Arrow memory."""
        return pd.DataFrame({name: as_pandas(self.columns[name]) for name in names}, copy=False)

    def where(self, row: int) -> str:
        """Return the file and line of a row, for messages."""
        return f"{self.path}, line {self.lines[row]}"

    def repeated(self, key: list[str]) -> Ints:
        """Return the rows that repeat a key, ascending, and log the first; raise CaptureError if its values differ."""
        if key[0] == "timestamp" and np.all(np.diff(self.columns["timestamp"].to_numpy()) > 0):
            return np.zeros(0, np.int64)  # the usual case: distinct timestamps make distinct keys
        keys = self.frame(*key)
        again = np.flatnonzero(keys.duplicated())
        if not len(again):
            return again
        different = again[~self.frame(*self.columns).duplicated().to_numpy()[again]]
        row = int([*different, again[0]][0])
        first = self.lines[np.flatnonzero((keys == keys.iloc[row]).all(axis=1))[0]]
        shown = f"{self.where(row)}: {', '.join(f'{name} {self.columns[name][row].as_py()!r}' for name in key)} again"
        if len(different):
            raise CaptureError(f"{shown}, with other values than in line {first}. Remove one of the two.")
        more = f", and {len(again) - 1} more such lines" if len(again) > 1 else ""
        log.warning("%s, as in line %d%s; each counts once.", shown, first, more)
        return again

    def without(self, rows: Ints) -> "TextTable":
        """Return the table without some rows."""
        kept = np.delete(np.arange(len(self)), rows)
        columns = {name: column.take(pa.array(kept)) for name, column in self.columns.items()}
        return replace(self, columns=columns, lines=self.lines[kept])


def read_table(path: Path, columns: Columns, strict: bool = True, extra: bool = False) -> TextTable:
    """Read a comma-separated text file of the capture format.

    Raise CaptureError if the file cannot be read, or (strict) is missing or has a malformed line. The message gives the
    line number, the text found and what was expected.

    Args:
        columns: name and type of each column, as in COLUMNS.
        strict: raise at a malformed line; else drop it and list it in `.problems`.
        extra: keep the text after the last column, as column `extra`.
    """
    try:
        if path.exists() and not path.is_file():  # opening a pipe blocks forever, reading a device never ends
            raise OSError(errno.EINVAL, "not a file")
        table = _parse(path, path.read_bytes(), columns, extra)
    except FileNotFoundError:
        table = replace(
            _parse(path, b"", columns, extra), problems=[(0, f"file not found; expected {_layout(columns)}")]
        )
    except OSError as error:
        raise CaptureError(f"File cannot be read: {path} ({error.strerror}). Expected a text file.") from None
    if not strict or not table.problems:
        return table
    line, fault = table.problems[0]
    if not line:
        raise CaptureError(f"{path}: {fault}. Is the session complete?")
    more = f" ({len(table.problems) - 1} more such lines.)" if len(table.problems) > 1 else ""
    advice = f"Correct or remove the line; `{COMMAND} check CAPTURE` lists all problems.{more}"
    raise CaptureError(f"{path}, line {line}: {fault}. {advice}")


def _layout(columns: Columns) -> str:
    return ", ".join(name for name, _ in columns)


def _parse(path: Path, data: bytes, columns: Columns, keep_extra: bool) -> TextTable:
    texts = data.removeprefix(b"\xef\xbb\xbf").split(b"\n")  # without the byte-order mark of Windows editors
    problems: list[tuple[int, str]] = []
    if _fault(data.replace(b"\r\n", b"\n")):
        for number, line in enumerate(texts, 1):
            if fault := _fault(line):
                problems.append((number, fault))
                texts[number - 1] = b"#"  # a comment, so that the line is skipped below
    text = pc.ascii_trim_whitespace(pa.array(texts, pa.large_string()))
    del data, texts  # large files need the memory for their columns
    kept = pc.invert(pc.or_(pc.starts_with(text, "#"), pc.equal(text, "")))
    text, lines = text.filter(kept), np.flatnonzero(kept.to_numpy(zero_copy_only=False)) + 1

    width = len(columns)
    values = pc.split_pattern(text, ",", max_splits=width)
    counts = pc.list_value_length(values).to_numpy()
    bad = np.zeros(len(lines), bool)

    def refuse(wrong: NDArray[np.bool_], fault: Callable[[int], str]) -> None:
        problems.extend((int(lines[row]), fault(row)) for row in np.flatnonzero(wrong & ~bad).tolist())
        bad[wrong] = True

    def too_few(row: int) -> str:
        line = text[row].as_py()
        shown = repr(line if len(line) <= 60 else line[:57] + "...")
        return (
            f"found {counts[row]} value{'s' * bool(counts[row] > 1)} in {shown}, expected {width}: {_layout(columns)}"
        )

    refuse(counts < width, too_few)
    if bad.any():
        values, lines, counts, bad = values.filter(pa.array(~bad)), lines[~bad], counts[~bad], bad[~bad]
    arrays: dict[str, pa.Array] = {}
    for index, (name, kind) in enumerate(columns):
        column = pc.ascii_trim_whitespace(pc.list_element(values, index))
        arrays[name], wrong = convert(column, kind)
        refuse(wrong, lambda row: f"found {name} = {column[row].as_py()!r}, expected {_TYPES[kind][2]}")  # noqa: B023
    has_extra = bool(np.any(counts > width))
    if keep_extra:
        # The extra text is the last value of its line, after the `width` expected ones.
        extra = pc.ascii_trim_whitespace(values.flatten().take(pa.array(np.cumsum(counts) - 1)))
        arrays["extra"] = pc.if_else(pa.array(counts > width), extra, "")
    if columns[-len(POSE) :] == POSE:
        q = np.stack([arrays[name].to_numpy() for name, _ in POSE[:4]], axis=1)
        with np.errstate(over="ignore"):
            squared = np.einsum("ij,ij->i", q, q)
        refuse(squared < 1e-12, lambda _: "found a zero quaternion, expected length 1")
        refuse(squared > FARTHEST_M**2, lambda _: "found a quaternion of huge length, expected length 1")
    if bad.any():
        arrays, lines = {name: array.filter(pa.array(~bad)) for name, array in arrays.items()}, lines[~bad]
    return TextTable(path, arrays, lines, sorted(problems), has_extra)


def convert(column: pa.Array, kind: str) -> tuple[pa.Array, NDArray[np.bool_]]:
    """Return a column converted to its type, and which of its values are wrong; such numbers may become 0."""
    if kind in (ID, PATH):
        return column, bad_names(column, kind == PATH and outside_allowed()).to_numpy(zero_copy_only=False)
    target, most, _ = _TYPES[kind]
    wrong = np.zeros(len(column), bool)
    try:
        converted = column.cast(target)
    except pa.ArrowInvalid:  # find the malformed values among those that are not plain numbers
        plain = pc.match_substring_regex(column, r"^-?\d{1,18}$" if most is None else r"^-?\d{1,18}(\.\d{1,18})?$")
        for row in np.flatnonzero(~plain.to_numpy(zero_copy_only=False)):
            try:
                column[row].cast(target)
            except pa.ArrowInvalid:
                wrong[row] = True
        converted = pc.if_else(pa.array(wrong), "0", column).cast(target)
    if kind == INTEGER:  # Arrow reads 0x10 as 16
        wrong |= pc.match_substring(column, "x", ignore_case=True).to_numpy(zero_copy_only=False)
    elif most is not None:
        values = np.abs(converted.to_numpy())
        wrong |= ~((values <= most) & (values < np.inf))
    return converted, wrong


def _fault(text: bytes) -> str:
    """Return why a line cannot be read; empty if it can."""
    try:
        text.decode()
    except UnicodeDecodeError as error:
        return f"found bytes that are not UTF-8 ({error.reason}), expected UTF-8 text"
    if b"\r" in text.removesuffix(b"\r"):
        return "found a carriage return within the line, expected each line to end in a line feed"
    return ""


def as_pandas(column: pa.Array) -> Any:
    """Return a column for a pandas table."""
    if pa.types.is_large_string(column.type):
        return pd.array(column, dtype=pd.StringDtype("pyarrow", na_value=np.nan))
    return column.to_numpy()


def times_of(table: pd.DataFrame) -> Ints:
    """Return the timestamps of a table, (N,) int64 microseconds."""
    return table["timestamp"].to_numpy(np.int64)


def as_strings(ids: Any) -> pa.Array:
    """Return ids (a sequence, array or Series of str) as one Arrow array."""
    if not isinstance(ids, pa.Array | pa.ChunkedArray):
        is_pandas = isinstance(ids, pd.Series | pd.api.extensions.ExtensionArray)
        ids = pa.array(ids) if is_pandas else pa.array(np.asarray(ids, object).ravel(), pa.large_string())
    ids = ids.combine_chunks() if isinstance(ids, pa.ChunkedArray) else ids
    return ids.cast(pa.large_string())


def codes_of(ids: pa.Array, vocabulary: pa.Array) -> Ints:
    """Return the position of each id in a vocabulary, -1 if it is missing."""
    codes = pc.fill_null(pc.index_in(ids, value_set=vocabulary), -1)
    return codes.to_numpy(zero_copy_only=False).astype(np.int64)


class KeyIndex:
    """Index that finds rows of a table by (timestamp, id)."""

    def __init__(self, timestamps: Ints, ids: Any) -> None:
        ids = as_strings(ids)
        self._times, self._ids = pd.Index(np.unique(timestamps)), pc.unique(ids)
        keys = self._keys(timestamps, ids)
        self._order = np.argsort(keys, kind="stable")
        self._sorted = keys[self._order]

    def _keys(self, timestamps: Ints, ids: Any) -> Ints:
        times, codes = self._times.get_indexer(timestamps), codes_of(as_strings(ids), self._ids)
        return np.where((times >= 0) & (codes >= 0), times * len(self._ids) + codes, -1)

    def find(self, timestamps: Ints, ids: Any) -> Ints:
        """Return the first row with each key, (n,) int64, -1 without any."""
        keys = self._keys(timestamps, ids)
        first = np.searchsorted(self._sorted, keys)
        found = (np.append(self._sorted, -1)[first] == keys) & (keys >= 0)
        return np.where(found, np.append(self._order, -1)[first], -1)

    def find_all(self, timestamps: Ints, ids: Any) -> list[Ints]:
        """Return all rows with each key, in the table's order."""
        keys = self._keys(timestamps, ids)
        starts, ends = np.searchsorted(self._sorted, keys), np.searchsorted(self._sorted, keys, side="right")
        ends = np.where(keys >= 0, ends, starts)
        return [self._order[start:end] for start, end in zip(starts, ends, strict=True)]


def in_unit_of_poses(table: pd.DataFrame, unit: str | None) -> pd.DataFrame:
    """Return a pair's table as it is written: in an unknown unit (None), no name says meters, `unit` is `unknown`."""
    if unit is not None:
        return table
    return table.rename(columns={name: unknown for unknown, name in POSES_UNIT.items()}).assign(unit="unknown")


def read_query_table(path: Path, columns: Sequence[str]) -> pd.DataFrame:
    """Read the CSV file of a pair with one row per query: timestamp as int64, device_id and `columns` as text.

    Raise ArtifactError if the file cannot be read, is not such a table, or lacks a column.
    """
    types: dict[Any, Any] = {"timestamp": np.int64, "device_id": str, **dict.fromkeys(columns, str)}
    try:
        table = pd.read_csv(path, dtype=types)
    except (OSError, ValueError, OverflowError) as error:
        raise ArtifactError(f"{path}: not a table of queries ({error}). Localize this pair again.") from None
    if missing := [name for name in types if name not in table]:
        raise ArtifactError(f"{path}: column {missing[0]!r} is missing. Localize this pair again.")
    return table


def write_table(path: Path, header: str | None, rows: Iterable[str]) -> None:
    """Write lines to a file atomically, after a comment."""
    with write_atomic(path) as temporary, open(temporary, "w", encoding="utf-8", newline="\n") as stream:
        if header is not None:
            stream.write(f"# {header}\n")
        stream.writelines(f"{row}\n" for row in rows)


# Poses of devices


class Trajectory:
    """Poses of devices over time, world_from_device.

    Attributes:
        timestamps: (N,) int64 microseconds.
        qt: (N, 7) float64, qw qx qy qz tx ty tz, as in the file.
        arrow_ids: N device ids as an Arrow array.
    """

    def __init__(
        self,
        timestamps: ArrayLike,
        device_ids: Any,
        qt: ArrayLike,
        covariances: ArrayLike | None = None,
        source: Path | None = None,
    ) -> None:
        """Make a trajectory. Covariances are given, (N, 6, 6), or read from the file `source` at first use."""
        self.timestamps = np.asarray(timestamps, np.int64)
        self.arrow_ids = as_strings(device_ids)
        self.qt = np.asarray(qt, np.float64).reshape(-1, 7)
        if not len(self.timestamps) == len(self.arrow_ids) == len(self.qt):
            found = f"{len(self.timestamps)}, {len(self.arrow_ids)} and {len(self.qt)}"
            raise ValueError(f"Expected equally many timestamps, device ids and poses, got {found}.")
        self._covariances = None if covariances is None else np.asarray(covariances, np.float64).reshape(-1, 6, 6)
        self._source = source

    @classmethod
    def from_poses(
        cls, timestamps: ArrayLike, device_ids: Any, world_from_device: ArrayLike, covariances: ArrayLike | None = None
    ) -> "Trajectory":
        """Make a trajectory from poses (N, 4, 4)."""
        return cls(timestamps, device_ids, qt_from_pose(world_from_device), covariances)

    @classmethod
    def read(cls, path: str | Path) -> "Trajectory":
        """Read a trajectories file. Columns after the pose are ignored unless they are a covariance.

        Raises:
            CaptureError: the file is missing or has a malformed line.
        """
        return cls.from_table(read_table(Path(path), COLUMNS["trajectories.txt"]))

    @classmethod
    def from_table(cls, table: TextTable) -> "Trajectory":
        """Make a trajectory from the table of a trajectories file."""
        source = table.path if table.has_extra and not table.problems else None
        times, devices = table.columns["timestamp"].to_numpy(), table.columns["device_id"]
        return cls(times, devices, table.numbers(POSE_NAMES), source=source)

    def write(self, path: str | Path) -> None:
        """Write the file atomically, with numbers that read back exactly. NaN covariances are omitted."""
        covariances, values = self.covariances, self.qt.tolist()
        if covariances is not None:
            finite = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
            flat = covariances.reshape(-1, 36).tolist()
            values = [[*pose, *more] if has else pose for pose, more, has in zip(values, flat, finite, strict=True)]
        rows = zip(self.timestamps.tolist(), self.arrow_ids.to_pylist(), values, strict=True)
        lines = (f"{time}, {device}, {', '.join(map(repr, numbers))}" for time, device, numbers in rows)
        write_table(Path(path), "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz, *covar", lines)

    def __len__(self) -> int:
        return len(self.timestamps)

    @cached_property
    def device_ids(self) -> NDArray[np.object_]:
        """Device ids, (N,) array of str."""
        return self.arrow_ids.to_numpy(zero_copy_only=False)

    @property
    def covariances(self) -> Floats | None:
        """Pose covariances (N, 6, 6), NaN in rows without one; None without any. Read from the file at first use.

        A covariance with a value that is not a finite number counts as none, with a warning.
        """
        if self._covariances is None and self._source is not None:
            table = read_table(self._source, COLUMNS["trajectories.txt"], extra=True)
            extra, self._source = table.columns["extra"], None
            rows = np.flatnonzero(pc.equal(pc.count_substring(extra, ","), 35).to_numpy(zero_copy_only=False))
            covariances = np.full((len(self), 6, 6), np.nan)
            for block in np.split(rows, range(4096, len(rows), 4096)):  # bounds the memory
                values = pc.split_pattern(extra.take(pa.array(block)), ",").flatten()
                numbers, wrong = convert(pc.ascii_trim_whitespace(values), NUMBER)
                finite = ~wrong.reshape(-1, 36).any(axis=1)
                covariances[block[finite]] = numbers.to_numpy().reshape(-1, 6, 6)[finite]
            malformed = rows[np.isnan(covariances[rows, 0, 0])]
            if len(malformed):
                more = f", and in {len(malformed) - 1} more lines" if len(malformed) > 1 else ""
                fault = f"the covariance has values that are not finite numbers{more}; such a covariance is not used"
                log.warning("%s: %s.", table.where(malformed[0]), fault)
            self._covariances = covariances if len(rows) else None
        return self._covariances

    @property
    def world_from_device(self) -> Floats:
        """(N, 4, 4) float64, meters."""
        return pose_from_qt(self.qt)

    @cached_property
    def index(self) -> KeyIndex:
        """Index of the rows by (timestamp, device_id)."""
        return KeyIndex(self.timestamps, self.arrow_ids)

    def lookup(self, timestamps: ArrayLike, device_ids: Any) -> Floats:
        """Return world_from_device, (n, 4, 4), for n keys; NaN for keys without a pose."""
        rows = self.index.find(np.atleast_1d(np.asarray(timestamps, np.int64)), as_strings(device_ids))
        poses = np.full((len(rows), 4, 4), np.nan)
        poses[rows >= 0] = pose_from_qt(self.qt[rows[rows >= 0]])
        return poses


# The files of a session


def write_session(
    path: str | Path,
    sensors: Iterable[Sequence[Any]],
    rigs: Iterable[tuple[str, str, ArrayLike]] | None,
    trajectory: Trajectory | None,
    images: Records,
    depths: Records | None = None,
    subsessions: Sequence[str] | None = None,
    keyframes: Mapping[str, pd.DataFrame] | None = None,
    ground_truth: Trajectory | None = None,
    wifi: Iterable[Sequence[Any]] | None = None,
    bt: Iterable[Sequence[Any]] | None = None,
) -> Path:
    """Write the text files of a session, not its images. Return the folder.

    Arguments that are None are not written. Raise ValueError if the format cannot store a value: it contains a comma or
    a line break, begins or ends with a space, or starts a line with #.

    Args:
        path: the session's folder; created if missing.
        sensors: rows (sensor_id, name, sensor_type, parameter, ...).
        rigs: rows (rig_id, sensor_id, rig_from_sensor), the pose as (4, 4) or as qw qx qy qz tx ty tz.
        trajectory: written to trajectories.txt: the poses of a map, or the odometry of queries.
        images, depths: rows (timestamp, sensor_id, path relative to raw_data/).
        keyframes: tables [timestamp, device_id] by name, e.g. `pruned_subsampled`.
        ground_truth: written to proc/alignment_trajectories.txt.
        wifi: rows (timestamp, sensor_id, MAC address, kHz, dBm, name, start and end of the scan, microseconds).
        bt: rows (timestamp, sensor_id, id, dBm, name), the id as `<guid>:<major>:<minor>`.
    """
    path = Path(path)
    write_table(path / "sensors.txt", "sensor_id, name, sensor_type, [sensor_params]+", map(_line, sensors))
    if rigs is not None:
        rows = (
            (rig, sensor, *(qt_from_pose(pose) if np.shape(pose) == (4, 4) else np.asarray(pose, np.float64)).tolist())
            for rig, sensor, pose in rigs
        )
        write_table(path / "rigs.txt", "rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz", map(_line, rows))
    for file, column, records in (("images.txt", "image_path", images), ("depths.txt", "depth_path", depths)):
        if records is not None:
            lines = records.itertuples(index=False) if isinstance(records, pd.DataFrame) else records
            write_table(path / file, f"timestamp, sensor_id, {column}", map(_line, lines))
    if trajectory is not None:
        trajectory.write(path / "trajectories.txt")
    if ground_truth is not None:
        ground_truth.write(path / ALIGNED)
    for file, columns, signals in (("wifi.txt", _WIFI, wifi), ("bt.txt", _BLUETOOTH, bt)):
        if signals is not None:
            write_table(path / file, f"timestamp, sensor_id, {columns}", map(_line, signals))
    # The benchmark's evaluation expects the files in proc/ without a header.
    if subsessions is not None:
        write_table(path / "proc" / "subsessions.txt", None, (_line([name]) for name in subsessions))
    for name, table in (keyframes or {}).items():
        file = f"keyframes_{name.removeprefix('keyframes_')}.txt"
        write_table(path / "proc" / file, None, map(_line, zip(times_of(table), table["device_id"], strict=True)))
    return path


def _line(values: Sequence[Any]) -> str:
    # repr of a float is the shortest text that reads back as the same number.
    texts = [repr(float(value)) if isinstance(value, float) else str(value) for value in values]
    for text in texts:
        if any(sign in text for sign in ",\n\r") or text != text.strip(" \t\r\v\f"):
            raise ValueError(f"The capture format cannot hold a comma, a line break or spaces at an end: {text!r}.")
    if texts[0].startswith("#"):
        raise ValueError(f"A line of the capture format that starts with # is a comment: {texts[0]!r}.")
    return ", ".join(texts)


def read_depth(path: str | Path) -> NDArray[np.float32]:
    """Return a depth map, (H, W) float32 meters along the camera's z axis, 0 where unknown.

    The largest number, 65535, means unknown, too, as in 7-Scenes. Raise CaptureError if the file cannot be read or is
    not a 16-bit image.
    """
    try:
        depth = decode(path, cv2.IMREAD_UNCHANGED)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise ImageError(f"{depth.dtype} {depth.shape}")
    except ImageError as error:
        fault = f"no such file, or not a 16-bit image of one channel ({error})"
        raise CaptureError(f"Depth map {path}: {fault}. Expected a 16-bit PNG in millimeters.") from None
    depth[depth == UNKNOWN_DEPTH] = 0
    return (depth / np.float32(DEPTH_SCALE)).astype(np.float32)


def write_depth(path: str | Path, depth_m: ArrayLike) -> None:
    """Write a depth map (H, W), meters, as a 16-bit PNG in millimeters; depth beyond 65.5 m becomes 0, unknown."""
    millimeters = np.round(np.asarray(depth_m, np.float64) * DEPTH_SCALE)
    in_range = (millimeters >= 0) & (millimeters < UNKNOWN_DEPTH)  # False for NaN
    done, png = cv2.imencode(".png", np.where(in_range, millimeters, 0).astype(np.uint16))
    if not done:
        raise CaptureError(f"Depth map of shape {millimeters.shape} cannot be written to {path}; expected (H, W).")
    with write_atomic(path) as temporary:
        temporary.write_bytes(png.tobytes())
