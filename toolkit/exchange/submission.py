"""Collect and check the poses of finished runs, and write the zip file that the CroCoDL challenge accepts.

Names and contents follow the benchmark's own combine script: `description.txt`, and for each pair a text file in the
trajectories format without covariances. Equal runs and options give equal bytes.
"""

import os
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from toolkit.capture.check import UNIT_TOLERANCE
from toolkit.capture.names import SPLITS
from toolkit.capture.tables import COLUMNS, Trajectory, read_table
from toolkit.errors import ArtifactError, ManifestError, ToolkitError
from toolkit.files import RAW_DATA, SceneFiles, pair_name, read_references, require_current, write_atomic, write_csv
from toolkit.geometry import invert, unit
from toolkit.manifest import require_known
from toolkit.pose.base import Status
from toolkit.results.pair import PairResults
from toolkit.runs.folder import open_captures

FAILED = ("nearest", "leave-out")
SCENES = {"HYDRO": "HYDRO", "SUCCULENT": "SUCCU"}  # captures of the CroCoDL challenge, with their names in its files
DEVICES = ["ios", "hl", "spot"]  # it asks for all pairs of them
QUERIES = "keyframes_pruned_subsampled"  # and for this list of queries
# Where the pose of a query is from (the run, its nearest reference, or nowhere), and the name of the counts.
ORIGINS = {"ok": "ok", "low_confidence": "low_confidence", "nearest": "filled", "left out": "left_out"}
COUNTS = ["asked", "written", *ORIGINS.values(), "not_asked"]
NOTED = ["left_out", "filled", "not_asked"]  # counts that make a pair incomplete
COLUMNS_OF_QUERIES = ["file", "timestamp", "device_id", "pose", "reason"]


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
        contents = {"description.txt": self.description.encode()}
        with tempfile.TemporaryDirectory() as folder:
            for name, poses in self.poses.items():
                poses.write(Path(folder) / name)
                contents[name] = (Path(folder) / name).read_bytes()
        with write_atomic(self.path) as partial, zipfile.ZipFile(partial, "w") as archive:
            for name, content in contents.items():
                info = zipfile.ZipInfo(name)  # its time is fixed, so the same poses give the same bytes
                info.external_attr = 0o644 << 16
                archive.writestr(info, content, zipfile.ZIP_DEFLATED)
        write_csv(self.path.with_suffix(".csv"), self.queries)
        return self.path


def collect(
    runs: Sequence[str | Path], description: str = "", out: str | Path | None = None, failed: str = "nearest",
    queries: str | None = None, scenes: Sequence[str] = (), captures: Sequence[str | Path] = (), sequence: bool = False,
) -> Submission:  # fmt: skip
    """Collect and check the poses of runs for submission; `.write()` then writes the zip file.

    The arguments are those of `visloc submit`. With a scene of the challenge, all its scenes and pairs are expected,
    else those of the captures. Raise ManifestError for an unknown value, run or description, ArtifactError for two runs
    with one pair, outdated poses, a duplicate key or a wrong quaternion, CaptureError for a bad file or keyframe list.
    """
    require_known("failed", failed, FAILED)
    folders, stage = [Path(run) for run in runs], "sequence" if sequence else "localize"
    if absent := [folder for folder in folders if not folder.is_dir()]:
        raise ManifestError.at(absent[0], "no such run folder", "<output_root>/<manifest name>")
    if os.path.isfile(description):  # noqa: PTH113 - Path.is_file raises an error for a long text
        description = Path(description).read_text(encoding="utf-8", errors="replace")
    elif description.endswith(".txt") and len(description.split()) == 1:
        raise ManifestError(f"{description}: no such file. Give an existing file, or the description itself.")
    present = {path.parent.name for folder in folders for path in folder.glob("*/poses")}
    if not present:
        raise ManifestError.at(", ".join(map(str, folders)), "no poses", "finished runs, <output_root>/<manifest name>")
    expected = SCENES if present & SCENES.keys() else {}
    poses, tables, rows = dict[str, Trajectory](), [pd.DataFrame(columns=COLUMNS_OF_QUERIES)], list[dict[str, object]]()
    with open_captures(folders, captures, sorted(present.union(scenes, expected))) as capture_of:
        for scene in scenes or expected or sorted(present):
            devices = (DEVICES, DEVICES) if scene in expected else map(capture_of(scene).devices_with, SPLITS)
            for pair in product(*devices):
                name, counts = f"{pair_name(expected.get(scene, scene), *pair)}.txt", dict.fromkeys(COUNTS, 0)
                of_runs = [SceneFiles(run, scene) for run in folders]
                paths = {files.sequence_txt(*pair) if sequence else files.poses_txt(*pair): files for files in of_runs}
                found = [path for path in paths if path.is_file()]
                if len(found) > 1:
                    raise ArtifactError.at(" and ".join(map(str, found)), "the same pair", do="Give one of the runs.")
                state = f"missing: no poses of the stage `{stage}` in {', '.join(map(str, folders))}"
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
    text = f"{description.rstrip()}\n" if description.strip() else ""
    if filled := pairs["filled"].sum():
        how = "were not localized and have the pose of their nearest reference image"
        text += f"{filled} of {pairs['asked'].sum()} queries {how}.\n"
    path, asked = Path(out or folders[0] / "submission.zip"), pd.concat(tables)[COLUMNS_OF_QUERIES]
    return Submission(path, text, poses, asked, pairs)


def _answers(
    files: SceneFiles, pair: tuple[str, ...], path: Path, keyframes: pd.DataFrame, failed: str
) -> tuple[Trajectory, pd.DataFrame, int]:
    """Return the poses to write for the keyframes, their origins, and the number of poses that nobody asked for."""
    results = PairResults.open(path, whole=False)
    poses, table = results.trajectory, results.at(keyframes).table.fillna({"status_text": "no row in the run's table"})
    repeated = poses.index.find(poses.timestamps, poses.device_ids) < np.arange(len(poses))  # it finds the first one
    is_wrong = repeated | (np.abs(np.linalg.norm(poses.qt[:, :4], axis=1) - 1) > UNIT_TOLERANCE)
    for row in np.flatnonzero(is_wrong)[:1].tolist():
        found = f"{poses.timestamps[row]}, device {poses.device_ids[row]!r}"
        found += " twice" if repeated[row] else " with a quaternion that is not of length 1"
        where = read_table(path, COLUMNS["trajectories.txt"]).where(row)
        raise ArtifactError.at(where, found, do="Localize this pair again, or correct the line.")
    status, times, devices = (table[name] for name in ("status_text", "timestamp", "device_id"))
    rows, own, why_not = poses.index.find(times.to_numpy(np.int64), devices), len(poses), "not localized"
    is_own = rows >= 0
    if failed == "nearest" and not is_own.all():
        require_current(files.poses_txt(*pair), "localize", (".jsonl", ".txt", RAW_DATA), missing=False)
        nearest, why_not = _nearest_references(files.retrieval(*pair))
        ids = [*poses.device_ids, *nearest.device_ids]
        poses = Trajectory([*poses.timestamps, *nearest.timestamps], ids, np.vstack([poses.qt, nearest.qt]))
        rows = poses.index.find(times.to_numpy(np.int64), devices)  # so nearest come last
    is_posed, is_low = rows >= 0, table["status"] == Status.LOW_CONFIDENCE
    table["pose"] = np.select([is_own & is_low, is_own, is_posed], ["low_confidence", "ok", "nearest"], "left out")
    table["reason"] = np.where(is_own, "", status + np.where(is_posed, "", f"; {why_not}"))
    qt = poses.qt[rows[is_posed]]
    qt[:, :4] = unit(qt[:, :4])
    return Trajectory(times[is_posed], devices[is_posed], qt), table, own - int(np.sum(is_own))


def _nearest_references(path: Path) -> tuple[Trajectory, str]:
    """Return poses of queries by the first references of their cameras, best first; why others have none."""
    if not path.is_file():
        return Trajectory([], [], []), f"no retrieval to fill it from: {path} is missing"
    rows = [row for row in read_references(path, "device_id", "Trs") if row["topk"]]
    rows = [row for row in rows if np.isfinite([row["topk"][0]["Tws"], row["Trs"]]).all()]
    rows.sort(key=lambda row: float(row["topk"][0]["score"]), reverse=True)
    world_from_camera = np.array([row["topk"][0]["Tws"] for row in rows], np.float64).reshape(-1, 4, 4)
    camera_from_rig = np.reshape([invert(np.array(row["Trs"], np.float64)) for row in rows], (-1, 4, 4))
    times, devices = [int(row["timestamp"]) for row in rows], [str(row["device_id"]) for row in rows]
    return Trajectory.from_poses(times, devices, world_from_camera @ camera_from_rig), "no reference was retrieved"
