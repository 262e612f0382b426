"""Collect and check the poses of finished runs, and write the zip file that the CroCoDL challenge accepts.

Names and contents follow the benchmark's own combine script: `description.txt`, and for each pair a text file in the
trajectories format without covariances. Equal runs and options give equal bytes.
"""

import json
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from toolkit.capture import COLUMNS, Capture, Trajectory
from toolkit.capture.check import UNIT_TOLERANCE
from toolkit.capture.names import SPLITS, allow_outside, extra_devices
from toolkit.capture.tables import read_table
from toolkit.errors import ArtifactError, CaptureError, ManifestError, ToolkitError
from toolkit.files import RAW_DATA, SceneFiles, pair_name, read_references, require_current, write_atomic
from toolkit.geometry import Floats, invert, qt_from_pose, unit
from toolkit.manifest import require_known
from toolkit.pose.base import Status
from toolkit.results.pair import PairResults

FAILED = ("nearest", "leave-out")
SCENES = {"HYDRO": "HYDRO", "SUCCULENT": "SUCCU"}
"""Captures of the CroCoDL challenge, with their names in its files; it asks for all pairs of `DEVICES`."""
DEVICES = ["ios", "hl", "spot"]
QUERIES = "keyframes_pruned_subsampled"  # the challenge's list of the query keyframes to be localized
ORIGINS = {"ok": "ok", "low_confidence": "low_confidence", "nearest": "filled", "left out": "left_out"}
"""Where the pose of a query is from (the run, its nearest reference, or nowhere), and the name of the counts."""
COUNTS = ["asked", "written", *ORIGINS.values(), "not_asked"]
NOTED = ["left_out", "filled", "not_asked"]  # counts that make a pair incomplete

COLUMNS_OF_QUERIES = ["file", "timestamp", "device_id", "pose", "reason"]
Key = tuple[int, str]


@dataclass
class Submission:
    """The checked content of the zip file."""

    path: Path
    description: str
    poses: dict[str, Trajectory]  # of each pair that has some, by the name of its file
    queries: pd.DataFrame  # one row per query of `COLUMNS_OF_QUERIES`; `pose` is a key of `ORIGINS`
    table: pd.DataFrame  # one row per pair: file, the numbers `COUNTS`, state (`complete`, or what is missing)

    @property
    def missing(self) -> list[str]:
        """The files of the pairs without poses."""
        return [name for name in self.table["file"] if name not in self.poses]

    def text(self) -> str:
        table, total = self.table.to_string(index=False, justify="left"), self.table[COUNTS].sum()
        sums = f"{len(self.poses)} of {len(self.table)} pairs, {total['written']} poses for {total['asked']} queries."
        return f"{table}\n\n{sums}" + (f"\nMissing: {', '.join(self.missing)}." if self.missing else "")

    def write(self) -> Path:
        """Write the zip file, and `queries` beside it. Raise ToolkitError if no pair has poses."""
        if not self.poses:
            raise ToolkitError(f"Nothing to submit: none of the {len(self.table)} pairs has poses.\n{self.text()}")
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "description.txt").write_text(self.description, encoding="utf-8", newline="\n")
            for name, poses in self.poses.items():
                poses.write(Path(folder) / name)
            with write_atomic(self.path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
                for name in ("description.txt", *self.poses):
                    # Time, system and mode are fixed, so the same poses give the same bytes.
                    info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
                    info.compress_type, info.create_system, info.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
                    archive.writestr(info, (Path(folder) / name).read_bytes())
        with write_atomic(self.path.with_suffix(".csv")) as temporary:
            self.queries.to_csv(temporary, index=False)
        return self.path


def collect(
    runs: Sequence[str | Path], description: str = "", out: str | Path | None = None, failed: str = "nearest",
    queries: str | None = None, scenes: Sequence[str] = (), captures: Sequence[str | Path] = (), sequence: bool = False,
) -> Submission:  # fmt: skip
    """Collect and check the poses of runs for submission; `.write()` then writes the zip file.

    The arguments are those of `visloc submit`. If the runs contain a scene of the challenge, all its scenes and pairs
    are expected, else those of their captures. Raise ManifestError for an unknown value, run or description;
    ArtifactError if two runs have the same pair, poses are outdated, or a poses file has a duplicate key or a wrong
    quaternion; CaptureError, with file and line, for a malformed file or no such keyframe list.
    """
    require_known("failed", failed, FAILED)
    folders = [Path(run) for run in runs]
    if absent := [folder for folder in folders if not folder.is_dir()]:
        raise ManifestError(f"{absent[0]}: no such run folder. Expected <output_root>/<manifest name>.")
    present = {path.parent.name for folder in folders for path in folder.glob("*/poses")}
    if not present:
        raise ManifestError(f"{', '.join(map(str, folders))}: no poses in it. Run the manifest first.")
    expected = SCENES if present & SCENES.keys() else {}
    poses, tables, rows = dict[str, Trajectory](), [pd.DataFrame(columns=COLUMNS_OF_QUERIES)], list[dict[str, object]]()
    with open_captures(folders, captures, sorted(present.union(scenes, expected))) as capture_of:
        for scene in scenes or expected or sorted(present):
            files, name_of = [SceneFiles(run, scene) for run in folders], expected.get(scene, scene)
            devices = (DEVICES, DEVICES) if scene in expected else map(capture_of(scene).devices_with, SPLITS)
            for pair in product(*devices):
                name, counts = f"{pair_name(name_of, *pair)}.txt", dict.fromkeys(COUNTS, 0)
                paths = {each.sequence_txt(*pair) if sequence else each.poses_txt(*pair): each for each in files}
                found = [path for path in paths if path.is_file()]
                if len(found) > 1:
                    both = " and ".join(map(str, found))
                    raise ArtifactError(f"Two runs have poses of the same pair: {both}. Give one of the two runs.")
                of = "of the stage `sequence` " if sequence else ""
                state = f"missing: no poses {of}in {', '.join(map(str, folders))}"
                for path in found:
                    if sequence:
                        require_current(path, "sequence")
                    keyframes = capture_of(scene)[f"{pair[1]}_query"].keyframes(queries or QUERIES)
                    poses[name], table, not_asked = _answers(paths[path], pair, path, keyframes, failed)
                    tables.append(table.assign(file=name))
                    by_origin = table["pose"].value_counts().reindex([*ORIGINS], fill_value=0).tolist()
                    counts = dict(zip(COUNTS, [len(table), len(poses[name]), *by_origin, not_asked], strict=True))
                    notes = [f"{counts[key]} {key.replace('_', ' ')}" for key in NOTED if counts[key]]
                    state = ", ".join(notes) or "complete"
                rows.append({"file": name, **counts, "state": state})
    pairs = pd.DataFrame(rows, columns=["file", *COUNTS, "state"])
    text = _description(description)
    if filled := pairs["filled"].sum():
        how = "were not localized and have the pose of their nearest reference image"
        text += f"{filled} of {pairs['asked'].sum()} queries {how}.\n"
    path = Path(out) if out else folders[0] / "submission.zip"
    return Submission(path, text, poses, pd.concat(tables)[COLUMNS_OF_QUERIES], pairs)


@contextmanager
def open_captures(
    runs: Iterable[Path], given: Iterable[str | Path], scenes: Sequence[str]
) -> Iterator[Callable[[str], Capture]]:
    """Yield a function that opens a scene's capture, with the kinds of devices and the links of the runs' manifests.

    Captures that have moved since are in the `given` folders, which have the names of scenes, else raise ManifestError.
    """
    folders, devices, outside = dict[str, Path](), [], False
    for run in runs:
        # Poses of another tool and stages run by hand have no such record: the user must give the captures.
        with suppress(OSError, ValueError, KeyError, TypeError):
            record = json.loads((run / "run.json").read_text(encoding="utf-8"))
            folders |= {row["scene"]: Path(row["parameters"]["sessions_root"]).parent for row in record["stages"]}
            devices += record["manifest"].get("extra_devices", [])
            outside |= record["manifest"].get("allow_outside", False)
    for path in map(Path.resolve, map(Path, given)):
        if path.name not in scenes:
            raise ManifestError(f"{path}: the folder has no scene's name. Expected {', '.join(scenes)}.")
        folders[path.name] = path

    @cache
    def open_capture(scene: str) -> Capture:
        if scene not in folders:
            raise ManifestError(f"{scene}: the runs do not say where this capture is. Give it: --capture PATH/{scene}.")
        try:
            return Capture.open(folders[scene])
        except CaptureError as error:
            raise ManifestError(f"{scene}: {error} Give the folder: --capture PATH/{scene}.") from None

    with extra_devices(devices), allow_outside(outside):
        yield open_capture


def _description(text: str) -> str:
    if os.path.isfile(text):  # noqa: PTH113 - Path.is_file raises an error for a long text
        text = Path(text).read_text(encoding="utf-8", errors="replace")
    elif text.endswith(".txt") and len(text.split()) == 1:
        raise ManifestError(f"{text}: no such file. Give an existing file, or the description itself.")
    return text.rstrip() + "\n" if text.strip() else ""


def _answers(
    files: SceneFiles, pair: tuple[str, ...], path: Path, keyframes: pd.DataFrame, failed: str
) -> tuple[Trajectory, pd.DataFrame, int]:
    """Return the poses to write for the keyframes, their origins, and the number of poses that nobody asked for."""
    poses = _checked(PairResults(path, keyframes))
    rows = poses.index.find(keyframes["timestamp"].to_numpy(np.int64), keyframes["device_id"])
    nearest, why_not = dict[Key, Floats](), "not localized"
    run_table = PairResults.open(path, whole=False).table
    statuses: dict[Key, str] = {(row.timestamp, row.device_id): row.status for row in run_table.itertuples()}
    if failed == "nearest" and np.any(rows < 0):
        require_current(files.poses_txt(*pair), "localize", (".jsonl", ".txt", RAW_DATA), missing=False)
        nearest, why_not = _nearest_references(files.retrieval(*pair))
    qt, answers = np.full((len(rows), 7), np.nan), list[tuple[str, str]]()
    qt[rows >= 0] = poses.qt[rows[rows >= 0]]
    for index, key in enumerate(zip(keyframes["timestamp"].tolist(), keyframes["device_id"], strict=True)):
        status = statuses.get(key, "no row in the run's table")
        if rows[index] >= 0:
            low = key in statuses and Status.parse(status)[0] is Status.LOW_CONFIDENCE
            answers.append((str(Status.LOW_CONFIDENCE if low else Status.OK), ""))
        elif key in nearest:
            qt[index] = qt_from_pose(nearest[key])
            answers.append(("nearest", status))
        else:
            answers.append(("left out", f"{status}; {why_not}"))
    posed = np.isfinite(qt).all(axis=1)
    qt[:, :4] = unit(qt[:, :4])
    written = Trajectory(keyframes["timestamp"][posed], keyframes["device_id"][posed], qt[posed])
    table = keyframes.assign(pose=[pose for pose, _ in answers], reason=[reason for _, reason in answers])
    return written, table, len(poses) - int(np.sum(rows >= 0))


def _checked(results: PairResults) -> Trajectory:
    """Return the poses. Raise ArtifactError for a duplicate key or a quaternion that is not of unit length."""
    poses = results.trajectory
    keys = pd.DataFrame({"timestamp": poses.timestamps, "device_id": poses.device_ids})
    repeated = np.flatnonzero(keys.duplicated())
    wrong = np.flatnonzero(np.abs(np.linalg.norm(poses.qt[:, :4], axis=1) - 1) > UNIT_TOLERANCE)
    for rows, problem in ((repeated, "occurs twice"), (wrong, "has a quaternion that is not of length 1")):
        for row in rows[:1].tolist():
            key = f"(timestamp {poses.timestamps[row]}, device {poses.device_ids[row]!r})"
            where = read_table(results.path, COLUMNS["trajectories.txt"]).where(row)
            raise ArtifactError(f"{where}: {key} {problem}. Localize this pair again, or correct the line.")
    return poses


def _nearest_references(path: Path) -> tuple[dict[Key, Floats], str]:
    """Return world_from_device (4, 4) of queries by the best first reference of their cameras; why others have none."""
    if not path.is_file():
        return {}, f"no retrieval to fill it from: {path} is missing"
    best: dict[Key, tuple[float, Floats]] = {}
    for row in read_references(path, "device_id", "Trs"):
        key = int(row["timestamp"]), str(row["device_id"])
        for reference in row["topk"][:1]:
            if (score := float(reference["score"])) > best.get(key, (-np.inf,))[0]:
                best[key] = score, np.array(reference["Tws"], np.float64) @ invert(np.array(row["Trs"], np.float64))
    return {key: pose for key, (_, pose) in best.items()}, "no reference was retrieved"
