"""Text tables of the capture format: their columns, a fast reader, and an index of rows by key.

The reader accepts comma-separated values with `#` comments and blank lines anywhere, spaces around values, Windows line
ends and a byte-order mark. Columns beyond the expected ones are ignored or kept as one text; their number varies from
line to line, which the CSV readers of Arrow and pandas refuse. So Arrow's functions on texts split the lines and
convert the columns. Only malformed values are looked at one by one, and error messages name the line.
"""

import errno
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from toolkit.capture.names import EXPECTED_NAME, HOW_TO_ALLOW, bad_names, outside_allowed
from toolkit.errors import COMMAND, ArtifactError, CaptureError
from toolkit.files import write_atomic
from toolkit.geometry import Floats, Ints

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


def _layout(columns: Columns) -> str:
    return ", ".join(name for name, _ in columns)


def _parse(path: Path, data: bytes, columns: Columns, keep_extra: bool) -> TextTable:
    """Split and convert the lines of a file."""
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
        wrong |= pc.match_substring(column, "x").to_numpy(zero_copy_only=False)
        wrong |= pc.match_substring(column, "X").to_numpy(zero_copy_only=False)
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


POSES_UNIT = {"position_std": "position_std_m", "moved": "moved_m"}
"""Columns of lengths in a pair's table if the unit of its poses is unknown, and their names where it is the meter."""


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
