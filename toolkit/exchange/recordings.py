"""What recordings have besides images: times, trajectories, GPS fixes and depth maps, in the formats of the field."""

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath

import numpy as np
import pandas as pd

from toolkit.capture.tables import FARTHEST_M
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.colmap_model import NORM_TOLERANCE, encoding_of, is_number
from toolkit.geometry import Floats, Ints, make_pose, pose_from_qt

UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
"""Microseconds in each unit of time."""
MAX_OFFSET_S = 0.02
"""Largest time between an image and what belongs to it, seconds."""
NO_ACCURACY_M = 10.0
"""Accuracy of a GPS fix that has none."""
FIX = ("latitude", "longitude", "altitude", "accuracy")
"""Columns of a GPS fix, degrees and meters."""
NAMES = "names"
"""What is given for a file of times if the times are the last numbers in the names of the images."""
_SINCE_2001_US, _UNTIL_2096_US = 1e15, 4e15
_LAST = 4e18  # of any unit, in nanoseconds


@dataclass(frozen=True)
class Track:
    """Poses over time, in the direction and unit of their file, N of them in order of time."""

    times_us: Ints | None  # (N,); None: one per image
    poses: Floats  # (N, 4, 4); NaN for a line that is no pose, if there are no times
    kind: str  # the format
    note: str = ""  # lines that are no pose

    def nearest(self, time_us: int) -> int | None:
        """Return the pose that is nearest to a time; None if none is within `MAX_OFFSET_S`."""
        assert self.times_us is not None
        at = int(np.searchsorted(self.times_us, time_us))
        near = [k for k in (at - 1, at) if 0 <= k < len(self.times_us)]
        best = min(near, key=lambda k: abs(int(self.times_us[k]) - time_us), default=None)  # type: ignore[index]
        return best if best is not None and abs(int(self.times_us[best]) - time_us) <= MAX_OFFSET_S * 1e6 else None


def read_text(path: Path, errors: str = "strict") -> str:
    """Return the content of a text file in UTF-8 or UTF-16, as of spreadsheets; raise CaptureError if it has none."""
    try:
        return path.read_text(encoding=encoding_of(path), errors=errors)
    except (OSError, UnicodeError) as error:
        raise CaptureError(f"{path}: cannot be read as text ({error}).") from None


def lines_of(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Return place and words of the lines of a text file, see `read_text`, that are neither empty nor comments."""
    for number, line in enumerate(read_text(path, "replace").splitlines(), start=1):
        if not line.startswith("#") and (words := line.replace(",", " ").split()):
            yield f"{path}, line {number}", words


def read_csv(path: Path) -> pd.DataFrame:
    """Read a CSV table with a header, all values as text, with the additional column `line`.

    Columns are separated by commas, or as the header: by semicolons or tabs. Empty values beyond its columns, which
    spreadsheets write, are ignored. Raise CaptureError if the file cannot be read, or a line has other columns than the
    header.
    """
    text = read_text(path)
    separator = next((one for one in ",;\t" if one in text.partition("\n")[0]), ",")
    reader = csv.reader(io.StringIO(text), delimiter=separator, skipinitialspace=True, strict=True)
    rows: list[list[str | int]] = []
    try:
        header = next(reader, [])
        while header and not header[-1].strip():
            header.pop()
        for values in reader:
            if any(value.strip() for value in values[len(header) :]):
                found = f"found {len(values)} values, expected {len(header)}, as in the header"
                raise CaptureError(f"{path}, line {reader.line_num}: {found}. A comma in a value needs double quotes.")
            rows.append([*values[: len(header)], *[""] * (len(header) - len(values)), reader.line_num])
    except csv.Error as error:
        raise CaptureError(f"{path}, line {reader.line_num}: cannot be read as a CSV table ({error}).") from None
    return pd.DataFrame(rows, columns=[*header, "line"])


def numbers_in(rows: pd.DataFrame, columns: Sequence[str], path: Path) -> Floats:
    """Return columns of a table, see `read_csv`, as numbers. Raise CaptureError if one is missing or no number."""
    table = rows.reindex(columns=columns).apply(pd.to_numeric, errors="coerce").to_numpy(float)
    for row in np.flatnonzero(~np.isfinite(table).all(axis=1)).tolist():
        found = ", ".join(map(str, rows.iloc[row, :-1]))
        raise CaptureError(f"{path}, line {rows['line'].iloc[row]}: found {found}, expected {', '.join(columns)}.")
    return table


def numbers_of(where: str, words: Sequence[str], count: int) -> Floats:
    """Return the first `count` words as numbers. Raise CaptureError, which names `where`, if they are none."""
    if len(words) < count or not all(map(is_number, words[:count])):
        raise CaptureError(f"{where}: found {' '.join(words)[:80]!r}, expected {count} numbers.")
    return np.array([float(word) for word in words[:count]])


def to_us(times: Iterable[str | float], unit: str | None, where: object, near_us: Iterable[int] = ()) -> Ints:
    """Return times (N,) in microseconds.

    Raise CaptureError if a time is no number; ManifestError if the unit is unknown.

    Args:
        unit: of `UNITS_US`; None: told by their size if they are times since 1970.
        near_us: times of images; the unit is that in which most of them are among the given times, if any is.
    """
    if unit is not None and unit not in UNITS_US:
        raise ManifestError(f"timestamps-unit: found {unit!r}, expected one of {', '.join(UNITS_US)}.")
    given, near = pd.Series([*times], dtype=object), np.array([*near_us])
    values = pd.to_numeric(given, errors="coerce").to_numpy(float)
    for time in given[~(np.abs(values) < _LAST)]:
        raise CaptureError(f"{where}: found the time {time!r}, expected a number.")
    typical = float(np.median(values)) if len(values) else 0.0
    within = {name: np.sum((values.min() * scale <= near) & (near <= values.max() * scale)) if len(values) else 0
              for name, scale in UNITS_US.items()}  # fmt: skip
    unit = max(within, key=lambda name: within[name]) if any(within.values()) else unit
    fitting = [name for name, scale in UNITS_US.items() if _SINCE_2001_US <= typical * scale <= _UNTIL_2096_US]
    if unit is None and not fitting:
        raise ManifestError(f"{where}: found times such as {typical:.10g}. Give --timestamps-unit s, ms, us or ns.")
    return np.round(np.clip(values * UNITS_US[unit or fitting[0]], -_LAST, _LAST)).astype(np.int64)


def read_times(source: str | Path, names: Sequence[str], unit: str | None) -> dict[str, int]:
    """Return the time of images, microseconds, by name; those without one are missing.

    Raise CaptureError if the file cannot be read, or has times of none of the images; ManifestError as for `to_us`.

    Args:
        source: a file with time and name in each line, in either order; or only times, see `lines_of_images` (KITTI);
            or `NAMES`.
        unit: see `to_us`.
    """
    found = dict[str, str]()
    if str(source) == NAMES:
        found = {name: numbers[-1] for name in names if (numbers := re.findall(r"\d+(?:\.\d+)?", _stem(name)))}
    else:
        rows = [words for _, words in lines_of(Path(source)) if any(map(is_number, words))]
        if all(len(words) == 1 for words in rows) and (lines := lines_of_images(names, len(rows))) is not None:
            found = {name: rows[line][0] for name, line in zip(names, lines, strict=True)}
        ends = Counter(PurePosixPath(name).name for name in names)
        by_end = {end: name for name in names if ends[end := PurePosixPath(name).name] == 1}
        by_end |= {name: name for name in names}
        for first, *rest in (words for words in rows if len(words) > 1):
            time, name = (first, " ".join(rest)) if is_number(first) else (rest[-1], " ".join([first, *rest[:-1]]))
            if (listed := by_end.get(name) or by_end.get(PurePosixPath(name).name)) and is_number(time):
                found[listed] = time
    if not found:
        raise CaptureError(f"{source}: has no time of {len(names)} images such as {names[0]}.")
    return dict(zip(found, to_us(found.values(), unit, source).tolist(), strict=True))


def lines_of_images(names: Sequence[str], count: int) -> list[int] | None:
    """Return the line, from 0, of each image in a file of `count` lines without names: in order of the names, where 2
    comes before 10, or else that of the last number in its name; None if neither is possible."""
    if len(names) == count:
        parts = {name: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)] for name in names}
        place = {name: line for line, name in enumerate(sorted(names, key=lambda name: parts[name]))}
        return [place[name] for name in names]
    numbers = [re.findall(r"\d+", _stem(name)) for name in names]
    lines = [int(found[-1]) for found in numbers if found]
    return lines if len(set(lines)) == len(names) and max(lines) < count else None


def read_track(path: Path, unit: str | None, times: Path | None = None, near_us: Iterable[int] = ()) -> Track | None:
    """Read a list of poses without names of images; None if the file is something else.

    A line has 8 numbers: time, position, qx qy qz qw (TUM), or of nanoseconds and commas: qw qx qy qz, which may be
    followed by a state (EuRoC); 12: a 3 x 4 matrix (KITTI); 13 or 17: a time, then a 3 x 4 or 4 x 4 matrix, whose
    columns may follow each other (ARKit). Raise CaptureError if the file cannot be read, or most lines are no poses;
    ManifestError as for `to_us`.

    Args:
        unit, near_us: see `to_us`.
        times: file with a time per line, for lists that have none.
    """
    lines, head = lines_of(path), read_text(path, "replace").partition("\n")[0]
    rows = list(islice(lines, 2))
    if rows and "image" not in rows[0][1] and not is_number(rows[0][1][0]):  # a header
        del rows[0]
    count = len(rows[0][1]) if rows else 0
    if count not in (8, 12, 13, 17) or not all(map(is_number, rows[0][1])):
        return None
    rows += lines
    whole = [words if len(words) == count and all(map(is_number, words)) else ["nan"] * count for _, words in rows]
    table = np.array(whole, np.float64)
    matrices = table if count == 12 else table[:, 1:]
    if count == 17 and np.allclose(matrices[0, [3, 7, 11, 15]], [0, 0, 0, 1]):
        poses, kind = matrices.reshape(-1, 4, 4).swapaxes(1, 2), "4 x 4 matrices, column by column"
    elif count == 17 and np.allclose(matrices[0, 12:], [0, 0, 0, 1]):
        poses, kind = matrices.reshape(-1, 4, 4), "4 x 4 matrices"
    elif count in (12, 13):
        rotations = matrices.reshape(-1, 3, 4)
        poses, kind = make_pose(rotations[:, :, :3], rotations[:, :, 3]), "3 x 4 matrices (KITTI)"
    else:
        in_head = re.search(r"q\w*w\b.*\bq\w*x", head) is not None
        w_first = count == 17 or in_head or table[0, 0] > _SINCE_2001_US * 1e3
        poses, kind = np.full((len(rows), 4, 4), np.nan), "EuRoC" if w_first else "TUM"
        qt = table[:, [4, 5, 6, 7, 1, 2, 3] if w_first else [7, 4, 5, 6, 1, 2, 3]]
        unit_length = np.abs(np.linalg.norm(qt[:, :4], axis=1) - 1) <= NORM_TOLERANCE
        poses[unit_length] = pose_from_qt(qt[unit_length])
    sizes = np.cbrt(np.linalg.det(np.nan_to_num(poses[:, :3, :3])))
    valid = (np.abs(poses) < FARTHEST_M).all(axis=(1, 2)) & (np.abs(sizes - 1) <= NORM_TOLERANCE)
    bad = [f"{where}: found {' '.join(words)[:80]!r}" for (where, words), is_pose in zip(rows, valid, strict=True)
           if not is_pose]  # fmt: skip
    if len(bad) > len(rows) / 2:
        raise CaptureError(f"{bad[0]}, which is no pose, as of {kind}.")
    note = f"{len(bad)} of {len(rows)} lines are no pose; first: {bad[0]}" if bad else ""
    stamps = table[:, 0] if count > 12 or count == 8 else np.array(
        [float(words[0]) for _, words in lines_of(times) if is_number(words[0])] if times is not None else []
    )  # fmt: skip
    if len(stamps) != len(rows):
        poses[~valid] = np.nan
        return Track(None, poses, kind, note)
    at, order = np.unique(to_us(stamps[valid], unit, path, near_us), return_index=True)
    if (again := np.count_nonzero(valid) - len(at)) > 0:
        note += f"{'; ' if note else ''}{again} lines repeat a time, of which the first counts"
    return Track(at, poses[valid][order], kind, note)


def read_fixes(path: Path) -> pd.DataFrame:
    """Read GPS fixes: a CSV file with the columns image or timestamp, latitude, longitude, altitude, and accuracy.

    Altitude and accuracy, in meters, may be missing. Raise CaptureError if the file cannot be read, or a column is
    missing or has another value than a number.

    Returns:
        A table with all columns, image and timestamp as text; empty where there is none.
    """
    rows = read_csv(path)
    defaults = {"image": "", "timestamp": "", "altitude": "0", "accuracy": str(NO_ACCURACY_M)}
    rows = rows.assign(**{name: rows[name].replace("", value) if name in rows else value
                          for name, value in defaults.items()})  # fmt: skip
    rows[list(FIX)] = numbers_in(rows, FIX, path)
    outside = (np.abs(rows[list(FIX)]) > [90, 180, FARTHEST_M, FARTHEST_M]).any(axis=1)
    for line in rows["line"][outside | ((rows["image"] == "") & (rows["timestamp"] == ""))]:
        expected = f"expected image or timestamp, and {', '.join(FIX)} in degrees and meters"
        raise CaptureError(f"{path}, line {line}: {expected}.")
    return rows


def find_depths(folder: Path, files: Sequence[str], times_us: Mapping[str, int]) -> dict[str, Path]:
    """Return the depth maps of images with `times_us`, by the name of the image; `files` are their paths in the folder.

    A depth map has the image's path, but for what follows the first dot and `depth` instead of `color` or `rgb`; or the
    time that is nearest, within `MAX_OFFSET_S`, where its name is a time in seconds (TUM).
    """
    by_key = {_key(file): file for file in files}
    found = {name: folder / by_key[_key(name)] for name in times_us if _key(name) in by_key}
    if not found and all(is_number(_stem(file)) for file in files):
        order = sorted(files, key=lambda file: float(_stem(file)))
        times = np.array([float(_stem(file)) * 1e6 for file in order])
        track = Track(times.astype(np.int64), np.zeros((len(order), 4, 4)), "")
        nearest = {name: track.nearest(time) for name, time in times_us.items()}
        found = {name: folder / order[row] for name, row in nearest.items() if row is not None}
    return found


def _key(name: str) -> str:
    folder, _, last = name.rpartition("/")
    return re.sub("color|rgb|image|depth", "", f"{folder}/{last.split('.')[0]}").strip("/")


def _stem(name: str) -> str:
    return PurePosixPath(name).name.rpartition(".")[0]
