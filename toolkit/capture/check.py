"""Look for inconsistencies in a capture: every one, with file and line."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from toolkit.capture.cameras import CAMERA_TYPES, parse_camera
from toolkit.capture.devices import OTHER_SESSIONS, SPLITS, kinds
from toolkit.capture.folder import Capture
from toolkit.capture.session import RAW_DATA, Session
from toolkit.capture.tables import ALIGNED, POSE_NAMES, KeyIndex, TextTable
from toolkit.capture.trajectory import Trajectory

ERROR, WARNING = "error", "warning"
UNUSED = {"wifi": "wifi.txt", "bluetooth": "bt.txt", "point clouds": "pointclouds.txt"}
"""Files of the format that nothing here reads; sensors of these kinds are passed over."""
UNIT_TOLERANCE = 1e-3  # longer or shorter quaternions were not meant to be rotations, or lost digits
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Problem:
    """One inconsistency."""

    session: str
    file: str
    """Relative to the session's folder."""
    line: int
    """From 1; 0 where it is about the whole file."""
    message: str
    severity: str
    """`error`: data would be missing or wrong; `warning`: worth a look."""

    def __str__(self) -> str:
        place = f"{self.session}/{self.file}" + (f":{self.line}" if self.line else "")
        return f"{place}: {self.severity}: {self.message}"


@dataclass
class CheckReport:
    """What a capture holds and what is wrong with it."""

    path: Path
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    """For each session, a table [what, count, details]."""
    problems: list[Problem] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether there is no error; warnings do not count."""
        return not self.errors

    @property
    def errors(self) -> list[Problem]:
        return [problem for problem in self.problems if problem.severity == ERROR]

    def text(self, most: int | None = None) -> str:
        """Return the report as text: a table a session, then the problems, one a line, or so many of them."""
        parts = [f"Capture {self.path}"]
        for session, table in self.tables.items():
            widths = [max(map(len, table[name])) for name in ("what", "count")]
            rows = [
                f"  {what:<{widths[0]}}  {count:>{widths[1]}}  {details}".rstrip()
                for what, count, details in table.itertuples(index=False)
            ]
            parts.append("\n".join([session, *rows]))
        if self.problems:
            lines = [str(problem) for problem in self.problems[:most]]
            if len(self.problems) > len(lines):
                lines.append(f"... and {len(self.problems) - len(lines)} more: python -m toolkit check {self.path}")
            parts.append("\n".join(lines))
        warnings = len(self.problems) - len(self.errors)
        parts.append(f"{_count(len(self.errors), 'error')}, {_count(warnings, 'warning')}.")
        return "\n\n".join(parts)


def check_capture(path: str | Path) -> CheckReport:
    """Read every session of a capture and list all inconsistencies.

    Raises:
        CaptureError: the folder is not a capture at all.
    """
    capture = Capture.open(path)
    report = CheckReport(capture.path)
    for session_id in capture.session_ids:
        checker = _SessionCheck(capture.folder(session_id))
        checker.run()
        report.tables[session_id] = checker.summary()
        report.problems += checker.problems
    return report


class _SessionCheck:
    def __init__(self, path: Path) -> None:
        self.session = Session(path, strict=False)
        self.problems: list[Problem] = []
        self.missing: dict[str, int] = {}
        self.sensor_ids = self._column("sensors.txt", "sensor_id")
        self.rig_ids = self._column("rigs.txt", "rig_id")

    def _column(self, file: str, name: str) -> pa.Array:
        table = self.session.tables.get(file)
        return pa.array([], pa.large_string()) if table is None else table.columns[name]

    def _add(self, file: str, line: int, message: str, severity: str = ERROR) -> None:
        self.problems.append(Problem(self.session.id, file, int(line), message, severity))

    def _add_rows(self, file: str, wrong: Mask, message: str, *names: str, severity: str = ERROR) -> None:
        """Report the rows of a table where `wrong`; `{}` in the message stand for the values of columns."""
        table = self.session.tables[file]
        for row in np.flatnonzero(wrong):
            values = [table.columns[name][row].as_py() for name in names]
            self._add(file, table.lines[row], message.format(*values), severity)

    def run(self) -> None:
        session = self.session
        known = [kind.key for kind in kinds()]
        if session.split not in SPLITS:
            expected = f"<{', '.join(known)}>_<map or query>"
            self._add("", 0, f"found session name {session.path.name!r}, expected {expected}", WARNING)
        elif session.device not in [*known, *(device for device, _ in OTHER_SESSIONS.values())]:
            message = f"device {session.device!r} is none of {', '.join(known)}; it takes part. Meant? Else rename it"
            self._add("", 0, message, WARNING)
        subsessions, _ = session.subsessions, session.depths
        self._check_sensors()
        self._check_records("images.txt", "image_path")
        if "depths.txt" in session.tables:
            self._check_records("depths.txt", "depth_path")
        if "rigs.txt" in session.tables:
            self._check_rigs()
        for file, trajectory in (
            ("trajectories.txt", session.trajectory),
            (ALIGNED, session.ground_truth),
        ):
            if trajectory is not None and file in session.tables:
                self._check_trajectory(file, trajectory)
        if session.split == "map":
            self._check_images_have_poses()
        for name in session.keyframe_files:
            self._check_keyframes(name)
        self._check_subsessions(subsessions)
        for file, table in session.tables.items():
            for line, message in table.problems:
                self._add(file, line, message)
        order = {file: place for place, file in enumerate(session.tables)}
        self.problems.sort(key=lambda problem: (order.get(problem.file, -1), problem.line))

    def _check_sensors(self) -> None:
        table = self.session.tables["sensors.txt"]
        keys = KeyIndex(np.zeros(len(table), np.int64), self.sensor_ids)
        self._add_rows(
            "sensors.txt", _mask(keys.repeated(), len(table)), "duplicate sensor {!r}", "sensor_id"
        )
        verdicts: dict[tuple[str, str], str] = {}
        kinds, params = (table.columns[name].to_pylist() for name in ("sensor_type", "extra"))
        for row, key in enumerate(zip(kinds, params, strict=True)):
            if key[0] not in CAMERA_TYPES:
                continue
            if key not in verdicts:
                try:
                    parse_camera(*key)
                    verdicts[key] = ""
                except ValueError as error:
                    verdicts[key] = str(error)
            if verdicts[key]:
                self._add("sensors.txt", table.lines[row], verdicts[key].rstrip("."))

    def _check_records(self, file: str, path_column: str) -> None:
        table = self.session.tables[file]
        sensors = table.columns["sensor_id"]
        unknown = ~_is_in(sensors, self.sensor_ids)
        if file == "depths.txt":  # maps that were rendered for a photograph: <prefix>/<sensor id>
            unknown &= ~_is_in(pc.replace_substring_regex(sensors, "^[^/]*/", ""), self.sensor_ids)
        self._add_rows(file, unknown, "unknown sensor {!r}: not in sensors.txt", "sensor_id")
        types = self._column("sensors.txt", "sensor_type")
        others = self.sensor_ids.filter(
            pc.invert(pc.is_in(types, value_set=pa.array(CAMERA_TYPES, types.type)))
        )
        self._add_rows(file, _is_in(sensors, others), "sensor {!r} of an image is no camera", "sensor_id")
        self._add_duplicates(file, "sensor_id")
        present = _existing(self.session.path / RAW_DATA, table.columns[path_column])
        self.missing[file] = int(np.sum(~present))
        self._add_rows(file, ~present, f"missing file {RAW_DATA}/{{}}", path_column)

    def _add_duplicates(self, file: str, column: str) -> None:
        table = self.session.tables[file]
        keys = KeyIndex(table.columns["timestamp"].to_numpy(), table.columns[column])
        repeated = _mask(keys.repeated(), len(table))
        self._add_rows(
            file, repeated, f"duplicate key (timestamp {{}}, {column} {{!r}})", "timestamp", column
        )

    def _add_not_unit(self, file: str) -> None:
        lengths = np.linalg.norm(self.session.tables[file].numbers(POSE_NAMES[:4]), axis=1)
        wrong = np.abs(lengths - 1) > UNIT_TOLERANCE
        message = "quaternion {} {} {} {} is not of length 1"
        self._add_rows(file, wrong, message, *POSE_NAMES[:4], severity=WARNING)

    def _check_rigs(self) -> None:
        table = self.session.tables["rigs.txt"]
        unknown = ~_is_in(table.columns["sensor_id"], self.sensor_ids)
        self._add_rows("rigs.txt", unknown, "unknown sensor {!r}: not in sensors.txt", "sensor_id")
        clash = _is_in(self.rig_ids, self.sensor_ids)
        self._add_rows("rigs.txt", clash, "rig {!r} has the name of a sensor", "rig_id")
        rig_codes = pc.index_in(self.rig_ids, value_set=pc.unique(self.rig_ids)).to_numpy().astype(np.int64)
        repeated = _mask(KeyIndex(rig_codes, table.columns["sensor_id"]).repeated(), len(table))
        self._add_rows("rigs.txt", repeated, "duplicate key (rig {!r}, sensor {!r})", "rig_id", "sensor_id")
        self._add_not_unit("rigs.txt")

    def _check_trajectory(self, file: str, trajectory: Trajectory) -> None:
        session, table = self.session, self.session.tables[file]
        devices = table.columns["device_id"]
        in_rigs, in_sensors = _is_in(devices, self.rig_ids), _is_in(devices, self.sensor_ids)
        self._add_rows(
            file,
            ~in_rigs & ~in_sensors,
            "unknown device {!r}: neither in rigs.txt nor in sensors.txt",
            "device_id",
        )
        self._add_duplicates(file, "device_id")
        self._add_not_unit(file)
        with_image = KeyIndex(session.images["timestamp"].to_numpy(), session.device_ids).find(
            trajectory.timestamps, devices
        )
        takes_images = in_rigs | _is_in(devices, self._cameras())
        without = takes_images & (with_image < 0)
        message = "pose without image (timestamp {}, device {!r})"
        self._add_rows(file, without, message, "timestamp", "device_id", severity=WARNING)
        if table.has_extra:
            self._check_covariances(file)

    def _check_covariances(self, file: str) -> None:
        for line, extra in _extra_columns(self.session.path / file, self.session.tables[file]):
            values = extra.split(",")
            if len(values) != 36:
                self._add(
                    file,
                    line,
                    f"{len(values)} values after the pose, expected none or 36 (covariance)",
                    WARNING,
                )
            elif not _all_finite(values):
                self._add(file, line, "the covariance has values that are not finite numbers")

    def _cameras(self) -> pa.Array:
        types = self._column("sensors.txt", "sensor_type")
        return self.sensor_ids.filter(pc.equal(types, "camera"))

    def _check_images_have_poses(self) -> None:
        session = self.session
        if session.trajectory is None:
            if len(session.images):
                self._add("trajectories.txt", 0, "file not found: images of a map session need poses")
            return
        poses = session.trajectory.index.find(session.images["timestamp"].to_numpy(), session.device_ids)
        message = "image without pose (timestamp {}, sensor {!r})"
        self._add_rows("images.txt", poses < 0, message, "timestamp", "sensor_id", severity=WARNING)

    def _check_keyframes(self, name: str) -> None:
        session, file = self.session, self.session.keyframe_files[name]
        keys = session.keyframes(name)
        devices = session.tables[file].columns["device_id"]
        known = _is_in(devices, self.rig_ids) | _is_in(devices, self.sensor_ids)
        message = "unknown device {!r}: neither in rigs.txt nor in sensors.txt"
        self._add_rows(file, ~known, message, "device_id")
        self._add_duplicates(file, "device_id")
        images = np.array([len(rows) for rows in session.rows_of_keyframes(keys)], np.int64)
        message = "keyframe without image (timestamp {}, device {!r})"
        self._add_rows(file, known & (images == 0), message, "timestamp", "device_id")
        if session.ground_truth is not None:
            poses = session.ground_truth.index.find(keys["timestamp"].to_numpy(), devices)
            message = "keyframe without ground truth (timestamp {}, device {!r})"
            self._add_rows(file, known & (poses < 0), message, "timestamp", "device_id", severity=WARNING)

    def _check_subsessions(self, subsessions: list[str]) -> None:
        file = "proc/subsessions.txt"
        if file not in self.session.tables:
            return
        of_image = self.session.subsession_of()
        table = self.session.tables[file]
        empty = ~np.isin(np.array(subsessions, object), of_image)
        self._add_rows(file, empty, "subsession {!r} has no images", "subsession", severity=WARNING)
        repeated = KeyIndex(np.zeros(len(table), np.int64), table.columns["subsession"]).repeated()
        self._add_rows(file, _mask(repeated, len(table)), "duplicate subsession {!r}", "subsession")
        message = "image {} is in no subsession of proc/subsessions.txt"
        self._add_rows("images.txt", of_image == "", message, "image_path", severity=WARNING)

    def summary(self) -> pd.DataFrame:
        """Return a table [what, count, details] of texts."""
        session = self.session
        rows: list[tuple[str, str, str]] = []

        def add(what: str, count: int | None, details: str = "") -> None:
            rows.append((what, "-" if count is None else f"{count:,}", details))

        times = session.images["timestamp"].to_numpy()
        span = f"over {(times.max() - times.min()) / 1e6:,.1f} s" if len(times) else ""
        missing = self.missing["images.txt"]
        add(
            "images",
            len(session.images),
            ", ".join(filter(None, [span, f"{missing:,} files missing" if missing else ""])),
        )
        kinds = session.sensors["sensor_type"].value_counts(sort=False)
        add("sensors", len(session.sensors), ", ".join(f"{count:,} {kind}" for kind, count in kinds.items()))
        add("cameras", len(self._cameras()), self._camera_models())
        if session.rigs is None:
            add("rigs", None)
        else:
            per_rig = session.rigs["rig_id"].value_counts()
            sizes = (
                f"{per_rig.min()}"
                if per_rig.min() == per_rig.max()
                else f"{per_rig.min()} to {per_rig.max()}"
            )
            add("rigs", len(per_rig), f"{sizes} sensors each" if len(per_rig) else "")
        for what, trajectory in (("poses", session.trajectory), ("ground truth", session.ground_truth)):
            if trajectory is None:
                no_truth = what == "ground truth" and session.split == "query"
                add(what, None, f"no {ALIGNED}: these queries cannot be evaluated" if no_truth else "")
                continue
            found = trajectory.index.find(times, session.device_ids)
            details = f"{np.sum(found >= 0):,} of {len(times):,} images have one"
            if what == "ground truth" and trajectory is session.trajectory:
                details += ", from trajectories.txt"
            elif what == "poses" and session.split != "map":
                details += ", the device's own odometry: never used as ground truth"
            add(what, len(trajectory), details)
        depths = session.depths
        missing = self.missing.get("depths.txt", 0)
        add(
            "depth maps",
            None if depths is None else len(depths),
            f"{missing:,} files missing" if missing else "",
        )
        images = pd.Series(session.subsession_of()).value_counts()
        shown = [f"{name} ({images.get(name, 0):,} images)" for name in session.subsessions[:6]]
        add(
            "subsessions",
            len(session.subsessions),
            ", ".join(shown) + (", ..." if len(session.subsessions) > 6 else ""),
        )
        for name in session.keyframe_files:
            table = session.tables[session.keyframe_files[name]]
            devices = len(pc.unique(table.columns["device_id"]))
            add(f"keyframes {name}", len(table), f"{_count(devices, 'device')}")
        for what, file in UNUSED.items():
            if (session.path / file).exists():
                add(what, None, f"{file} is there and is not used")
        return pd.DataFrame(rows, columns=["what", "count", "details"])

    def _camera_models(self) -> str:
        params = self.session.sensors["params"][self.session.sensors["sensor_type"] == "camera"]
        heads = params.str.split(",", n=3).str[:3].map(lambda words: " ".join(word.strip() for word in words))
        counts = heads.value_counts()
        shown = [f"{count:,} {head}" for head, count in counts.head(4).items()]
        return ", ".join(shown) + (", ..." if len(counts) > 4 else "")


def _extra_columns(path: Path, table: TextTable) -> Iterable[tuple[int, str]]:
    """Yield line and text of what follows the columns of a table's rows, where there is something."""
    width = len(table.columns)
    wanted = iter(table.lines.tolist())
    line = next(wanted, None)
    with open(path, encoding="utf-8-sig", errors="replace") as stream:
        for number, text in enumerate(stream, 1):
            if number == line:
                words = text.strip().split(",", width)
                if len(words) > width:
                    yield number, words[width]
                line = next(wanted, None)


def _all_finite(values: list[str]) -> bool:
    try:
        return bool(np.all(np.isfinite([float(value) for value in values])))
    except ValueError:
        return False


def _existing(root: Path, paths: pa.Array) -> Mask:
    """Tell which paths relative to `root` are files: a folder is listed once, not asked file by file."""
    listed: dict[str, set[str]] = {}
    found = np.zeros(len(paths), bool)
    for row, path in enumerate(paths.to_pylist()):
        folder, name = os.path.split(path)
        if folder not in listed:
            try:
                with os.scandir(root / folder) as entries:
                    listed[folder] = {entry.name for entry in entries}
            except OSError:
                listed[folder] = set()
        found[row] = name in listed[folder]
    return found


def _is_in(values: pa.Array, known: pa.Array) -> Mask:
    return pc.is_in(values, value_set=known).to_numpy(zero_copy_only=False)


def _mask(rows: NDArray[np.int64], size: int) -> Mask:
    mask = np.zeros(size, bool)
    mask[rows] = True
    return mask


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}" + ("" if number == 1 else "s")
