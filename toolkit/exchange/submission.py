"""Collect and check the poses of finished runs, and write the zip file that the CroCoDL challenge accepts.

Names and contents follow the benchmark's own combine script: `description.txt`, and for each pair a text file in the
trajectories format without covariances. Equal runs and options give equal bytes.
"""

import itertools
import json
import os
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from toolkit.capture import COLUMNS, Capture, Trajectory
from toolkit.capture.check import UNIT_TOLERANCE
from toolkit.capture.devices import SPLITS, extra_devices
from toolkit.capture.names import allow_outside
from toolkit.capture.tables import read_query_table, read_table
from toolkit.errors import ArtifactError, CaptureError, ManifestError, ToolkitError
from toolkit.files import (
    SceneFiles,
    file_fingerprint,
    pair_name,
    read_references,
    require_current,
    write_atomic,
    write_sidecar,
)
from toolkit.geometry import invert, qt_from_pose, unit

FAILED = ("nearest", "leave-out")
LEFT_OUT, FILLED = "left out", "nearest"
SCENES = {"HYDRO": "HYDRO", "SUCCULENT": "SUCCU"}
"""Captures of the CroCoDL challenge, with their names in its files; it asks for all pairs of `DEVICES`."""
DEVICES = ["ios", "hl", "spot"]
QUERIES = "keyframes_pruned_subsampled"
"""The challenge's list of the query keyframes to be localized."""
COUNTS = ["asked", "written", "ok", "low_confidence", "filled", "left_out", "not_asked"]

Key = tuple[int, str]


@dataclass
class Entry:
    """The file of one pair."""

    scene: str
    map_device: str
    query_device: str
    name: str
    """Its name in the zip."""
    state: str = "complete"
    """`complete`, or why the file is missing or incomplete."""
    poses: Trajectory | None = None
    """The poses to write; None: the pair is missing."""
    queries: pd.DataFrame = field(default_factory=pd.DataFrame)
    """One row per query: timestamp, device_id, pose (`ok`, `low_confidence`, `nearest`, `left out`), reason."""
    not_asked: int = 0
    """Number of poses whose query is not in the list; they are not written."""

    def counts(self) -> dict[str, int]:
        """Return the counts of the pair, with the keys `COUNTS`."""
        poses = Counter(self.queries.get("pose", ()))
        written = 0 if self.poses is None else len(self.poses)
        by_kind = [poses[kind] for kind in ("ok", "low_confidence", FILLED, LEFT_OUT)]
        return dict(zip(COUNTS, [len(self.queries), written, *by_kind, self.not_asked], strict=True))


@dataclass
class Submission:
    """The checked content of the zip file."""

    description: str
    entries: list[Entry]
    sources: dict[str, str]
    """Fingerprint of the source file of each entry, by entry name."""
    failed: str
    path: Path

    @property
    def missing(self) -> list[Entry]:
        """The pairs without a file."""
        return [entry for entry in self.entries if entry.poses is None]

    def table(self) -> pd.DataFrame:
        """Return one row per pair: file, counts, state."""
        rows = [{"file": entry.name, **entry.counts(), "state": entry.state} for entry in self.entries]
        return pd.DataFrame(rows, columns=["file", *COUNTS, "state"])

    def text(self) -> str:
        """Return the table, its totals and the missing pairs as text."""
        table = self.table()
        total = table[COUNTS].sum()
        sums = (
            f"{len(table) - len(self.missing)} of {len(table)} pairs, {total['written']} poses for {total['asked']} "
            f"queries: {total['ok']} ok, {total['low_confidence']} of low confidence, {total['filled']} filled with "
            f"the pose of the nearest reference, {total['left_out']} left out."
        )
        missing = f"\nMissing: {', '.join(entry.name for entry in self.missing)}." if self.missing else ""
        return f"{table.to_string(index=False, justify='left')}\n\n{sums}{missing}"

    def write(self) -> Path:
        """Write the zip file, and a CSV file beside it with the origin of each query's pose.

        Raises:
            ToolkitError: no pair has poses.
        """
        with tempfile.TemporaryDirectory() as folder:
            files = {"description.txt": self.description.encode()}
            for entry in self.entries:
                if entry.poses is not None:
                    entry.poses.write(Path(folder) / entry.name)
                    files[entry.name] = (Path(folder) / entry.name).read_bytes()
        if len(files) == 1:
            raise ToolkitError(f"Nothing to submit: none of the {len(self.entries)} pairs has poses.\n{self.text()}")
        with write_atomic(self.path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for name, content in files.items():
                # Time, system and mode are fixed, so the same poses give the same bytes.
                info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
                info.compress_type, info.create_system, info.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
                archive.writestr(info, content)
        write_sidecar(self.path, {"sources": self.sources, "failed": self.failed, "description": self.description})
        rows = [entry.queries.assign(file=entry.name) for entry in self.entries if len(entry.queries)]
        with write_atomic(self.path.with_suffix(".csv")) as temporary:
            columns = ["file", "timestamp", "device_id", "pose", "reason"]
            pd.concat(rows)[columns].to_csv(temporary, index=False)
        return self.path


def collect(
    runs: Sequence[str | Path],
    description: str = "",
    out: str | Path | None = None,
    failed: str = "nearest",
    queries: str | None = None,
    scenes: Sequence[str] = (),
    captures: Sequence[str | Path] = (),
    sequence: bool = False,
) -> Submission:
    """Collect and check the poses of runs for submission; `.write()` then writes the zip file.

    If the runs contain a scene of the challenge, all its scenes and pairs are expected, and those without poses are
    listed as missing. Otherwise the submission has all scenes of the runs with the pairs of their captures.

    Args:
        runs: run folders, `<output_root>/<manifest name>`; scenes and pairs may be distributed over several.
        description: a text, or the name of a file with the text.
        out: the zip file; None: `submission.zip` in the first run folder.
        failed: what to write for a query without a pose: `nearest`, the pose of the best retrieved reference, or
            `leave-out`, nothing.
        queries: list of the query keyframes to be localized, in the query session's `proc/`; None: the challenge's.
        scenes: only these scenes; default: see above.
        captures: folders of captures that have moved since the runs.
        sequence: use the poses of the stage `sequence` instead of those of single queries.

    Raises:
        ManifestError: an unknown value, no such run, or a file that cannot be read as a description.
        ArtifactError: two runs have the same pair, the poses of a sequence were made from other poses of single
            queries, or a poses file has a duplicate key or a quaternion that is not of unit length.
        CaptureError: a malformed poses file, or no such keyframe list; names file and line.
    """
    if failed not in FAILED:
        raise ManifestError(f"failed: unknown choice {failed!r}. Known: {', '.join(FAILED)}.")
    folders = [Path(run) for run in runs]
    for folder in folders:
        if not folder.is_dir():
            raise ManifestError(f"{folder}: no such run folder. Expected <output_root>/<manifest name>.")
    present = {path.parent.name for folder in folders for path in sorted(folder.glob("*/poses"))}
    if not present:
        raise ManifestError(f"{', '.join(map(str, folders))}: no poses in it. Run the manifest first.")
    expected = SCENES if present & SCENES.keys() else {}
    out = Path(out) if out else folders[0] / "submission.zip"
    submission = Submission(_description(description), [], {}, failed, out)
    with open_captures(folders, captures, sorted(present.union(scenes, expected))) as captures_by_scene:
        for scene in scenes or expected or sorted(present):
            mapped = asked = DEVICES
            if scene not in expected:  # not part of the challenge: all pairs of the capture
                mapped, asked = (captures_by_scene[scene].devices_with(split) for split in SPLITS)
            for pair in itertools.product(mapped, asked):
                entry = Entry(scene, *pair, f"{pair_name(expected.get(scene, scene), *pair)}.txt")
                submission.entries.append(entry)
                _fill_entry(entry, folders, captures_by_scene, queries or QUERIES, failed, submission.sources, sequence)
    total = submission.table()[COUNTS].sum()
    if total["filled"]:
        submission.description += (
            f"{total['filled']} of {total['asked']} queries were not localized and have the pose of their nearest "
            "reference image.\n"
        )
    return submission


class Captures(dict[str, Capture]):
    """The capture of each scene, opened from the folder given by the user, else from the folder recorded in a run."""

    def __init__(self, folders: Mapping[str, Path]) -> None:
        self._folders = folders

    def __missing__(self, scene: str) -> Capture:
        if scene not in self._folders:
            raise ManifestError(f"{scene}: the runs do not say where this capture is. Give it: --capture PATH/{scene}.")
        try:
            self[scene] = Capture.open(self._folders[scene])
        except CaptureError as error:
            raise ManifestError(f"{scene}: {error} Give the folder: --capture PATH/{scene}.") from None
        return self[scene]


@contextmanager
def open_captures(runs: Iterable[Path], given: Iterable[str | Path], scenes: Sequence[str]) -> Iterator[Captures]:
    """Open the captures of runs, with the kinds of devices and the permission of links in the runs' manifests.

    Args:
        given: capture folders given by the user; each must have the name of one of the `scenes`.

    Raises:
        ManifestError: a given folder has another name.
    """
    folders: dict[str, Path] = {}
    devices, outside = list[Mapping[str, object]](), False
    for run in runs:
        try:
            record = json.loads((run / "run.json").read_text(encoding="utf-8"))
            folders |= {row["scene"]: Path(row["parameters"]["sessions_root"]).parent for row in record["stages"]}
            devices += record["manifest"].get("extra_devices", [])
            outside |= record["manifest"].get("allow_outside", False)
        except (OSError, ValueError, KeyError, TypeError):
            continue  # poses of another tool, or stages run by hand: the user must give the captures
    for path in map(Path, given):
        if path.resolve().name not in scenes:
            raise ManifestError(f"{path}: the folder has no scene's name. Expected {', '.join(scenes)}.")
        folders[path.resolve().name] = path.resolve()
    with extra_devices(devices), allow_outside(outside):
        yield Captures(folders)


def _description(text: str) -> str:
    """Return the text, or the content of the file with this name."""
    path = Path(text)
    if os.path.isfile(text):  # noqa: PTH113 - Path.is_file raises an error for a long text
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise ManifestError(f"{path}: the description is not UTF-8 text ({error}).") from None
    elif path.suffix == ".txt" and len(text.split()) == 1:
        raise ManifestError(f"{path}: no such file. Give an existing file, or the description itself.")
    return text.rstrip() + "\n" if text.strip() else ""


def _fill_entry(
    entry: Entry, runs: Sequence[Path], captures: Captures, queries: str, failed: str, sources: dict[str, str],
    sequence: bool,
) -> None:  # fmt: skip
    """Read the poses of a pair from the run that has them, and choose the pose to write for each query of the list."""
    pair = (entry.map_device, entry.query_device)
    scenes = [SceneFiles(run, entry.scene) for run in runs]
    paths = [files.sequence_txt(*pair) if sequence else files.poses_txt(*pair) for files in scenes]
    with_poses = [(files, path) for files, path in zip(scenes, paths, strict=True) if path.is_file()]
    if not with_poses:
        kind = "poses of the stage `sequence`" if sequence else "poses"
        entry.state = f"missing: no {kind} in " + ", ".join(str(files.poses_dir) for files in scenes)
        return
    if len(with_poses) > 1:
        both = " and ".join(str(path) for _, path in with_poses)
        raise ArtifactError(f"Two runs have poses of the same pair: {both}. Give one of the two runs.")
    files, path = with_poses[0]
    if sequence:
        require_current(path, "sequence")
    keyframes = captures[entry.scene][f"{entry.query_device}_query"].keyframes(queries)
    timestamps, device_ids = keyframes["timestamp"].to_numpy(np.int64), keyframes["device_id"]
    poses = _read_poses(path)
    statuses, sources[entry.name] = _statuses(path.with_suffix(".csv")), file_fingerprint(path)
    rows = poses.index.find(timestamps, device_ids)
    entry.not_asked = len(poses) - int(np.sum(rows >= 0))
    nearest, why_not = dict[Key, np.ndarray](), "not localized"
    if failed == "nearest" and np.any(rows < 0):
        require_current(files.poses_txt(*pair), "localize", (".jsonl",), missing=False)
        nearest, why_not = _nearest_references(files.retrieval(*pair))
    qt, origins, reasons = np.full((len(rows), 7), np.nan), [LEFT_OUT] * len(rows), [""] * len(rows)
    for index, (key, row) in enumerate(zip(zip(timestamps.tolist(), device_ids, strict=True), rows, strict=True)):
        status = statuses.get(key, "no row in the run's table")
        if row >= 0:
            qt[index], origins[index] = poses.qt[row], "low_confidence" if status.startswith("low_confidence") else "ok"
        elif key in nearest:
            qt[index], origins[index], reasons[index] = qt_from_pose(nearest[key]), FILLED, status
        else:
            reasons[index] = f"{status}; {why_not}"
    entry.queries = keyframes.assign(pose=origins, reason=reasons)
    posed = np.isfinite(qt).all(axis=1)
    qt[:, :4] = unit(qt[:, :4])
    entry.poses = Trajectory(timestamps[posed], device_ids[posed], qt[posed])
    counts = entry.counts()
    notes = {"left_out": "left out", "filled": "filled", "not_asked": "not asked"}
    entry.state = ", ".join(f"{counts[name]} {what}" for name, what in notes.items() if counts[name]) or "complete"


def _read_poses(path: Path) -> Trajectory:
    """Read a poses file. Raise ArtifactError for a duplicate key or a quaternion that is not of unit length."""
    table = read_table(path, COLUMNS["trajectories.txt"])
    poses = Trajectory.from_table(table)
    repeated = np.flatnonzero(table.frame("timestamp", "device_id").duplicated())
    lengths = np.linalg.norm(poses.qt[:, :4], axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1) > UNIT_TOLERANCE)
    for rows, problem in ((repeated, "occurs twice"), (wrong, "has a quaternion that is not of length 1")):
        if len(rows):
            key = f"(timestamp {poses.timestamps[rows[0]]}, device {poses.device_ids[rows[0]]!r})"
            where = table.where(rows[0])
            raise ArtifactError(f"{where}: {key} {problem}. Localize this pair again, or correct the line.")
    return poses


def _statuses(path: Path) -> dict[Key, str]:
    """Return the status of each query in a run's table of a pair; empty if the run has no table."""
    if not path.is_file():
        return {}
    table = read_query_table(path, ["status"])
    return dict(zip(zip(table["timestamp"].tolist(), table["device_id"], strict=True), table["status"], strict=True))


def _nearest_references(path: Path) -> tuple[dict[Key, np.ndarray], str]:
    """Return substitute poses for queries that were not localized, and the reason why other queries have none.

    Of all cameras of a query, take the one whose first reference has the best score, and give it the pose of that
    reference. The substitutes are world_from_device (4, 4).
    """
    if not path.is_file():
        return {}, f"no retrieval to fill it from: {path} is missing"
    best: dict[Key, tuple[float, np.ndarray]] = {}
    for row in read_references(path, "device_id", "Trs"):
        try:
            key = int(row["timestamp"]), str(row["device_id"])
            for reference in row["topk"][:1]:
                world_from_rig = np.array(reference["Tws"], np.float64) @ invert(np.array(row["Trs"], np.float64))
                score = float(reference["score"])
                if key not in best or score > best[key][0]:
                    best[key] = score, world_from_rig
        except (ValueError, KeyError, TypeError) as error:
            where = f"{path}, query of {row['timestamp']}"
            raise ArtifactError(f"{where}: not a retrieval row ({error!r}). Retrieve again.") from None
    return {key: pose for key, (_, pose) in best.items()}, "no reference was retrieved"
