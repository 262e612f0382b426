"""Find the inconsistencies of a capture and list each with file and line."""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import KDTree

from toolkit.capture.images import CAMERA_TYPES, default_workers, parse_camera, prefetch, read_image, stored_size
from toolkit.capture.names import HOW_TO_ALLOW, OTHER_SESSIONS, SPLITS, has_long_part, kinds
from toolkit.capture.session import IMPORT_RECORD, SUBSESSIONS, Capture, Session
from toolkit.capture.tables import (
    ALIGNED,
    COLUMNS,
    POSE_NAMES,
    SIGNALS,
    KeyIndex,
    key_of,
    read_depth,
    read_table,
    times_of,
)
from toolkit.capture.upright import estimate_world_up, posed_images
from toolkit.errors import COMMAND, CaptureError, ImageError
from toolkit.files import RAW_DATA, read_json
from toolkit.geometry import unit

ERROR, WARNING = "error", "warning"
ASKED = "pruned_subsampled"  # keyframe list that manifests localize by default
SAME_PLACE_M = 1e-6  # positions closer than this are the same, meters
PLACE_SHARE = 0.005  # positions closer than this share of the extent of all positions are one place, as of a tripod
WALK = 10  # smallest number of steps between camera positions from which the direction of motion is judged
SHORTEST_STEP_US, LONGEST_STEP_US = 1e3, 6e8  # median steps of a recording that are plausible
LATEST_US = 4e15  # plausible time: the year 2096
UNIT_TOLERANCE = 1e-3  # largest deviation of a quaternion's length from 1; beyond, it has lost digits
Rule = tuple[Any, str, str]
"""Which rows break the rule, (N,) bool; the message, with `{column}` for a row's value; and the severity."""


@dataclass(frozen=True)
class Problem:
    """One inconsistency: `error`, data are missing or wrong, or `warning`, data may be wrong."""

    session: str
    file: str  # relative to the session's folder
    line: int  # line number from 1; 0 if the problem concerns the whole file
    message: str
    severity: str

    def __str__(self) -> str:
        where = f"{self.session}/{self.file}" + (f":{self.line}" if self.line else "")
        return f"{where}: {self.severity}: {self.message}"


@dataclass
class CheckReport:
    """The contents of a capture and its problems."""

    path: Path
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    """Contents of each session: a table [what, count, details] of texts."""
    problems: list[Problem] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether there are no errors; warnings are allowed."""
        return not self.errors

    @property
    def errors(self) -> list[Problem]:
        return [problem for problem in self.problems if problem.severity == ERROR]

    def text(self, most: int | None = None) -> str:
        """Return the report as text: a table per session, then at most `most` problems, one per line."""
        parts = [f"Capture {self.path}"]
        for session, table in self.tables.items():
            width, digits = (max(map(len, table[name])) for name in ("what", "count"))
            rows = (f"  {what:<{width}}  {count:>{digits}}  {details}" for what, count, details in table.to_numpy())
            parts.append("\n".join([session, *map(str.rstrip, rows)]))
        if self.problems:
            lines = [str(problem) for problem in self.problems[:most]]
            if len(self.problems) > len(lines):
                lines.append(f"... and {len(self.problems) - len(lines)} more: {COMMAND} check {self.path}")
            parts.append("\n".join(lines))
        warnings = len(self.problems) - len(self.errors)
        parts.append(f"{_count(len(self.errors), 'error')}, {_count(warnings, 'warning')}.")
        return "\n\n".join(parts)


def check_capture(path: str | Path, deep: bool = False) -> CheckReport:
    """Read all sessions of a capture and the headers of its images, and list all inconsistencies.

    With `deep`, every image and depth map is decoded. Raise CaptureError if the folder is not a capture.
    """
    capture = Capture.open(path)
    report = CheckReport(capture.path)
    for session_id in capture.session_ids:
        try:
            checker = _SessionCheck(capture.folder(session_id), deep)
            checker.run()
        except CaptureError as error:  # the session cannot be read at all
            report.problems.append(Problem(session_id, "", 0, str(error), ERROR))
            continue
        report.tables[session_id] = checker.summary()
        report.problems += checker.problems
    report.problems += [Problem(name, "", 0, why, ERROR) for name, why in capture.unreadable.items()]
    return report


class _SessionCheck:
    """Collects the problems of one session."""

    def __init__(self, path: Path, deep: bool) -> None:
        self.session = session = Session(path, strict=False)
        self.deep = deep
        self.problems: list[Problem] = []
        self.missing: dict[str, int] = {}
        self.sizes: dict[str, tuple[int, int]] = {}
        """Image width and height of each camera and depth sensor."""
        # Reading these adds their files to `session.tables`.
        _ = session.subsessions, session.depths, [session.keyframes(name) for name in session.keyframe_files]
        _ = session.wifi, session.bluetooth, session.gps
        self.rows = {
            file: table.frame(*table.columns).set_index(pd.Index(table.lines)) for file, table in session.tables.items()
        }
        """The well-formed rows of each file, indexed by line number."""
        sensors = self.rows["sensors.txt"]
        self.rig_ids = session.rigs["rig_id"] if session.rigs is not None else pd.Series([], dtype=object)
        self.cameras = sensors[sensors["sensor_type"] == "camera"]["sensor_id"]
        self.devices = pd.concat([self.rig_ids, sensors["sensor_id"]])

    def _add(self, file: str, line: int, message: str, severity: str = ERROR) -> None:
        self.problems.append(Problem(self.session.id, file, int(line), message, severity))

    def _add_rows(self, file: str, mask: Any, message: str, severity: str = ERROR) -> None:
        """Report the rows of a file where the mask holds; `{column}` in the message is replaced by the row's value."""
        rows = self.rows[file][mask]
        for line, row in zip(rows.index, rows.to_dict("records") if len(rows) else [], strict=True):
            self._add(file, line, message.format(**row), severity)

    @property
    def _has_errors(self) -> bool:
        return any(problem.severity == ERROR for problem in self.problems)

    def run(self) -> None:
        session = self.session
        known = [kind.key for kind in kinds()]
        if session.split not in SPLITS:
            expected = f"<{', '.join(known)}>_<map or query>"
            self._add("", 0, f"found session name {session.path.name!r}, expected {expected}", WARNING)
        elif session.device not in [*known, *(device for device, _ in OTHER_SESSIONS.values())]:
            message = f"device {session.device!r} is none of {', '.join(known)}; it is used. Rename it if not intended"
            self._add("", 0, message, WARNING)
        if not len(session.images) and not session.tables["images.txt"].problems:
            self._add("images.txt", 0, "lists no image", WARNING)
        for file, table in session.tables.items():
            for line, message in table.problems:
                self._add(file, line, message)
        if session.split == "map" and session.trajectory is None and len(session.images):
            self._add("trajectories.txt", 0, "file not found: images of a map session need poses")
        record = read_json(session.path / IMPORT_RECORD)
        if session.split == "map" and record.get("unit") == "m" and "meters" not in record:
            message = "says meters, not from where; earlier versions did of any unit: import again, or set `unit`"
            self._add(IMPORT_RECORD, 0, message, WARNING)
        if session.split == "query" and ASKED not in session.keyframe_files:
            lists = ", ".join(session.keyframe_files) or "none"
            message = f"no such list, the default for queries; found: {lists}. Set `queries` in the manifest, or add it"
            self._add(f"proc/keyframes_{ASKED}.txt", 0, message, WARNING)
        self._check_cameras()
        self._check_steps()
        for file, rows in self.rows.items():
            for rule in (*self._rules(file, rows), *self._rules_of(file, rows)):
                self._add_rows(file, *rule)
            if file in ("images.txt", "depths.txt"):
                self._check_files(file, rows)
            elif session.tables[file].has_extra and file in ("trajectories.txt", ALIGNED):
                self._check_covariances(file)
        if session.split == "map" and not self._has_errors:
            self._check_map_poses()
        order = {file: rank for rank, file in enumerate(session.tables)}
        self.problems.sort(key=lambda problem: (order.get(problem.file, -1), problem.line))

    def _rules(self, file: str, rows: pd.DataFrame) -> Iterator[Rule]:
        """Yield what holds for any file: distinct keys, known ids, unit quaternions."""
        key, sensors = key_of(file), self.rows["sensors.txt"]["sensor_id"]
        if file not in SIGNALS:
            shown = ", ".join(f"{name} {{{name}!r}}" for name in key)
            again, same = rows.duplicated(key), rows.duplicated()
            yield again & ~same, f"duplicate key ({shown}), with other values", ERROR
            yield again & same, f"duplicate key ({shown}), same values: counts once", WARNING
        if "sensor_id" in rows:
            unknown, severity = ~rows["sensor_id"].isin(sensors), ERROR
            if file == "depths.txt":  # ids of rendered depth maps: <prefix>/<sensor id of the image>
                unknown &= ~rows["sensor_id"].str.replace("^[^/]*/", "", regex=True).isin(sensors)
            elif file in (*SIGNALS, "gps.txt"):  # usable without a line in sensors.txt; one warning per sensor
                unknown, severity = unknown & ~rows.duplicated("sensor_id"), WARNING
            yield unknown, "unknown sensor {sensor_id!r}: not in sensors.txt", severity
        if "device_id" in rows:
            unknown = ~rows["device_id"].isin(self.devices)
            yield unknown, "unknown device {device_id!r}: neither in rigs.txt nor in sensors.txt", ERROR
        if "qw" in rows:
            off = np.abs(np.linalg.norm(rows[list(POSE_NAMES[:4])].to_numpy(np.float64), axis=1) - 1) > UNIT_TOLERANCE
            yield off, "quaternion {qw} {qx} {qy} {qz} is not of length 1", WARNING

    def _rules_of(self, file: str, rows: pd.DataFrame) -> Iterator[Rule]:
        """Yield what holds for one file: how its rows fit those of other files."""
        session, shown = self.session, "(timestamp {timestamp}, device {device_id!r})"
        is_map, of_image = session.split == "map", session.subsession_of()
        if file == "rigs.txt":
            clash = rows["rig_id"].isin(self.rows["sensors.txt"]["sensor_id"])
            yield clash, "rig {rig_id!r} has the name of a sensor", ERROR
        elif file == "images.txt":
            if is_map and session.trajectory is not None:
                without = session.trajectory.index.find(times_of(session.images), session.device_ids) < 0
                yield without, "image without pose (timestamp {timestamp}, sensor {sensor_id!r})", WARNING
            if SUBSESSIONS in self.rows:
                yield of_image == "", f"image {{image_path}} is in no subsession of {SUBSESSIONS}", WARNING
        elif file in ("trajectories.txt", ALIGNED) and is_map:  # odometry of queries also has poses between images
            images = KeyIndex(times_of(session.images), session.device_ids)
            takes_images = rows["device_id"].isin(self.rig_ids) | rows["device_id"].isin(self.cameras)
            without = takes_images & (images.find(times_of(rows), rows["device_id"]) < 0)
            yield without, f"pose without image {shown}", WARNING
        elif file == SUBSESSIONS:
            long = rows["subsession"].map(lambda name: has_long_part(name, "subsession")).astype(bool)
            yield long, "subsession {subsession!r} has a name too long for files", ERROR
            yield ~rows["subsession"].isin(of_image), "subsession {subsession!r} has no images", WARNING
        elif file in session.keyframe_files.values():
            is_known = rows["device_id"].isin(self.devices)
            without = np.array([not len(images) for images in session.rows_of_keyframes(rows)], bool)
            yield is_known & without, f"keyframe without image {shown}", ERROR
            if session.ground_truth is not None:
                without = session.ground_truth.index.find(times_of(rows), rows["device_id"]) < 0
                yield is_known & without, f"keyframe without ground truth {shown}", WARNING

    def _check_cameras(self) -> None:
        rows, parsed = self.rows["sensors.txt"], cache(parse_camera)  # a phone may have a sensor per image
        for line, sensor, _, kind, params in rows[rows["sensor_type"].isin(CAMERA_TYPES)].itertuples(name=None):
            try:
                camera = parsed(kind, params)
                self.sizes[sensor] = camera.width, camera.height
            except ValueError as error:
                self._add("sensors.txt", line, str(error).rstrip("."))

    def _check_steps(self) -> None:
        """Report times that seem to have another unit than microseconds; those that imports made are from EXIF."""
        record = self.session.path / IMPORT_RECORD
        if record.is_file() and "as given" not in (read_json(record).get("timestamps") or ()):
            return
        frames = self.session.images[["timestamp"]].assign(subsession=self.session.subsession_of())
        steps = [np.diff(np.unique(times_of(one))) for _, one in frames.groupby("subsession")]
        step_us = float(np.median(np.concatenate(steps))) if sum(map(len, steps)) >= 3 else 0.0
        units = {"nanoseconds": 1e3, "milliseconds": 1e-3, "seconds": 1e-6}
        text = f"the median step between images is {step_us:,.0f} us"
        text = f"{text} ({step_us / 1e6:,.0f} s)" if step_us > 1e6 else text
        fitting = [unit for unit, factor in units.items() if 1e4 <= step_us / factor <= 5e6]
        if len(frames) and frames["timestamp"].max() > LATEST_US:
            self._add("images.txt", 0, "times after the year 2096, as microseconds: are these nanoseconds?", WARNING)
        elif step_us and fitting and not SHORTEST_STEP_US <= step_us <= LONGEST_STEP_US:
            self._add("images.txt", 0, f"{text}: are these {' or '.join(fitting)}?", WARNING)

    def _check_files(self, file: str, rows: pd.DataFrame) -> None:
        sensors, path = self.rows["sensors.txt"], rows.columns[2]
        wrong = rows["sensor_id"].isin(sensors[~sensors["sensor_type"].isin(CAMERA_TYPES)]["sensor_id"])
        self._add_rows(file, wrong, "sensor {sensor_id!r} of an image is not a camera")
        again = rows.duplicated(path) & ~rows.duplicated(key_of(file))
        self._add_rows(file, again, f"{RAW_DATA}/{{{path}}} is listed again, under another key")
        inside = np.ones(len(rows), bool)
        for row, target in self.session.links_out(rows[path]).items():
            inside[row], shown = False, f"{RAW_DATA}/{rows[path].iloc[row]} is a link to {target}"
            self._add(file, rows.index[row], f"{shown}, outside of the capture; {HOW_TO_ALLOW}")
        files = [f"{self.session.path}/{RAW_DATA}/{name}" for name in rows[path]]
        exist = np.array([os.path.lexists(name) for name in files], bool)
        gone = exist & ~np.array([os.path.exists(name) for name in files], bool)  # noqa: PTH110
        self.missing[file] = int(((~exist & inside) | gone).sum())
        self._add_rows(file, ~exist & inside, f"missing file {RAW_DATA}/{{{path}}}")
        if gone.any():
            first = int(np.argmax(gone))
            lost = os.readlink(files[first])  # noqa: PTH115
            found = f"{gone.sum()} of {len(rows)} files are links to files that are gone, such as {lost}"
            do = "Move them back, or import again with --replace; --images copy does not depend on them"
            self._add(file, rows.index[first], f"{found}. {do}")
        self._check_content(file, rows[exist & inside & ~gone])

    def _check_content(self, file: str, rows: pd.DataFrame) -> None:
        """Open the files of rows, and compare the size of images with that of their camera."""
        root, read = self.session.path / RAW_DATA, read_depth if file == "depths.txt" else read_image
        is_image = rows["sensor_id"].isin(self.cameras) & (file == "images.txt")

        def fault(item: tuple[str, str, bool]) -> str:
            path, sensor, of_camera = item
            try:
                size = stored_size(root / path)
                if self.deep:
                    read(root / path)
            except (ImageError, CaptureError) as error:
                return str(error)
            camera_size = self.sizes.get(sensor, size) if of_camera else size
            found, expected = (f"{width} x {height}" for width, height in (size, camera_size))
            return "" if size == camera_size else f"{path} has {found} pixels, its sensor {sensor!r} {expected}"

        items = zip(rows[rows.columns[2]], rows["sensor_id"], is_image, strict=True)
        workers = default_workers()
        for line, message in zip(rows.index, prefetch(fault, items, workers, ahead=4 * workers), strict=True):
            if message:
                self._add(file, line, message)

    def _check_covariances(self, file: str) -> None:
        table = read_table(self.session.path / file, COLUMNS[file], strict=False, extra=True)
        for line, extra in zip(table.lines, table.columns["extra"].to_pylist(), strict=True):
            numbers = extra.split(",")
            if extra and len(numbers) != 36:
                message = f"{len(numbers)} values after the pose, expected none or 36 (covariance)"
                self._add(file, line, message, WARNING)
            elif extra and not np.isfinite(pd.to_numeric(pd.Series(numbers).str.strip(), errors="coerce")).all():
                self._add(file, line, "the covariance has values that are not finite numbers")

    def _check_map_poses(self) -> None:
        """Report implausible map poses: all in one place, all with one rotation, or all cameras moving backwards."""
        session, file = self.session, "trajectories.txt"
        poses, rows = posed_images(session)
        order = np.lexsort((times_of(session.images)[rows], session.subsession_of(rows).astype(str)))
        poses, recording = poses[order], session.subsession_of(rows)[order]
        if len(poses) < 3:
            return
        tree, extent = KDTree(poses[:, :3, 3]), float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
        together = int(tree.query_ball_point(poses[:, :3, 3], PLACE_SHARE * extent, return_length=True).max())
        if np.ptp(poses[:, :3, 3], axis=0).max() < SAME_PLACE_M:
            self._add(file, 0, f"all {len(poses)} images stand in one place: nothing can be triangulated")
        elif np.ptp(poses[:, :3, :3], axis=0).max() < 1e-9:
            self._add(file, 0, f"all {len(poses)} images have the same rotation: were rotations lost?", WARNING)
        elif together >= max(3, len(poses) / 2):
            message = f"{together} of {len(poses)} images were taken from one place: nothing has parallax between them"
            self._add(file, 0, message, WARNING)
        steps = np.diff(poses[:, :3, 3], axis=0)
        walked = (np.linalg.norm(steps, axis=1) > SAME_PLACE_M) & (recording[1:] == recording[:-1])
        forward = np.sum(unit(steps[walked]) * poses[1:][walked, :3, 2], axis=1)
        if len(forward) >= WALK and np.median(forward) < -np.cos(np.radians(45)):
            message = "cameras move backwards: z axes must point forward (OpenCV); do they point backward (OpenGL)?"
            self._add(file, 0, message, WARNING)

    def summary(self) -> pd.DataFrame:
        """Return a table [what, count, details] of texts."""
        session, rows = self.session, list[tuple[str, str, str]]()

        def add(what: str, count: int | None, *details: str) -> None:
            rows.append((what, "-" if count is None else f"{count:,}", ", ".join(filter(None, details))))

        def missing(file: str) -> str:
            return f"{self.missing[file]:,} files missing" if self.missing.get(file) else ""

        times = times_of(session.images)
        span = f"over {(int(times.max()) - int(times.min())) / 1e6:,.1f} s" if len(times) else ""
        add("images", len(times), span, missing("images.txt"))
        types = session.sensors["sensor_type"].value_counts(sort=False)
        add("sensors", len(session.sensors), *(f"{count:,} {kind}" for kind, count in types.items()))
        add("cameras", len(self.cameras), *self._camera_models())
        sizes = self.rig_ids.value_counts()
        span = f"{sizes.min()} to {sizes.max()}" if sizes.nunique() > 1 else f"{sizes.min()}"
        add("rigs", None if session.rigs is None else len(sizes), f"{span} sensors each" if len(sizes) else "")
        lacking = f"no {ALIGNED}: these queries cannot be evaluated" if session.split == "query" else ""
        source = "from trajectories.txt" if session.ground_truth is session.trajectory else ""
        odometry = "" if session.split == "map" else "odometry of the device, not used as ground truth"
        for what, trajectory, without, note in (("poses", session.trajectory, "", odometry),
                                                ("ground truth", session.ground_truth, lacking, source)):  # fmt: skip
            if trajectory is None:
                add(what, None, without)
            else:
                posed = np.sum(trajectory.index.find(times, session.device_ids) >= 0)
                add(what, len(trajectory), f"{posed:,} of {len(times):,} images have one", note)
        if session.split == "map" and not self._has_errors and len(posed_images(session)[1]):
            add("up in the world", None, estimate_world_up([session]).reason)
        add("depth maps", None if session.depths is None else len(session.depths), missing("depths.txt"))
        for what, signals in (("WiFi", session.wifi), ("Bluetooth", session.bluetooth)):
            if signals is not None:
                scans = len(signals[["timestamp", "sensor_id"]].drop_duplicates())
                add(what, len(signals), f"{scans:,} scans", f"{signals.iloc[:, 2].nunique():,} emitters")
        if session.gps is not None:
            add("GPS", len(session.gps), f"{np.sum(session.gps['horizontal_accuracy_m'] >= 0):,} with an accuracy")
        images = pd.Series(session.subsession_of()).value_counts()
        shown = [f"{name} ({images.get(name, 0):,} images)" for name in session.subsessions[:6]]
        add("subsessions", len(session.subsessions), *shown, "..." if len(session.subsessions) > 6 else "")
        for name, file in session.keyframe_files.items():
            add(f"keyframes {name}", len(self.rows[file]), _count(self.rows[file]["device_id"].nunique(), "device"))
        if (session.path / "pointclouds.txt").exists():
            add("point clouds", None, "pointclouds.txt is not used")
        return pd.DataFrame(rows, columns=["what", "count", "details"])

    def _camera_models(self) -> list[str]:
        params = self.rows["sensors.txt"].query("sensor_type == 'camera'")["extra"]
        counts = params.str.split(",", n=3).map(lambda words: " ".join(map(str.strip, words[:3]))).value_counts()
        return [*(f"{count:,} {head}" for head, count in counts.head(4).items()), "..." if len(counts) > 4 else ""]


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}" + ("" if number == 1 else "s")
