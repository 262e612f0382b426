"""The zip file that a benchmark takes: the poses of finished runs, checked, under the names it expects.

Names and contents are those of the benchmarks' own combine scripts: `description.txt`, and for each pair a text file in
the trajectories format without covariances. Equal runs and options give equal bytes.
"""

import json
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from toolkit.capture import COLUMNS, Capture, Trajectory
from toolkit.capture.check import UNIT_TOLERANCE
from toolkit.capture.tables import KeyIndex, read_query_table, read_table
from toolkit.errors import ArtifactError, CaptureError, ManifestError, ToolkitError
from toolkit.files import SceneFiles, file_fingerprint, read_references, write_atomic, write_sidecar
from toolkit.geometry import invert, qt_from_pose

FAILED = ("nearest", "leave-out")
LEFT_OUT, FILLED = "left out", "nearest"
COUNTS = ["asked", "written", "ok", "low_confidence", "filled", "left_out", "not_asked"]

Key = tuple[int, str]


@dataclass(frozen=True)
class Challenge:
    """What one benchmark wants in its zip file."""

    name: str
    scenes: dict[str, str]
    """The captures, and what each is called in file names."""
    pairs: tuple[tuple[str, str], ...]
    """Map and query devices."""
    file: str
    """Name of a pair's file, of {scene}, {map} and {query}."""
    queries: str = "keyframes_pruned_subsampled"
    """The keyframe list that is asked."""
    devices: dict[str, str] = field(default_factory=dict)
    """What the benchmark calls devices that it does not call as we do."""

    def file_name(self, scene: str, map_device: str, query_device: str) -> str:
        """Return the name of a pair's file in the zip."""
        map_device, query_device = (self.devices.get(key, key) for key in (map_device, query_device))
        return self.file.format(scene=self.scenes.get(scene, scene), map=map_device, query=query_device)


_PAIR_FILE = "{scene}_map_{map}_query_{query}.txt"
CHALLENGES = (
    Challenge(
        "LaMAR",
        {"CAB": "CAB", "HGE": "HGE", "LIN": "LIN"},
        (("mixed", "ios"), ("mixed", "hl")),
        "{scene}_query_{query}.txt",
        "queries",
        {"ios": "phone", "hl": "hololens"},
    ),
    Challenge(
        "CroCoDL",
        {"HYDRO": "HYDRO", "SUCCULENT": "SUCCU"},
        tuple((m, q) for m in ("ios", "hl", "spot") for q in ("ios", "hl", "spot")),
        _PAIR_FILE,
    ),
)


@dataclass
class Entry:
    """The file of one pair."""

    scene: str
    map_device: str
    query_device: str
    name: str
    """In the zip."""
    state: str = "complete"
    """`complete`, or why it is not there or not whole."""
    poses: Trajectory | None = None
    """What is written; None: the pair is missing."""
    queries: pd.DataFrame = field(default_factory=pd.DataFrame)
    """One row a query asked: timestamp, device_id, pose (`ok`, `low_confidence`, `nearest`, `left out`), reason."""
    not_asked: int = 0
    """Poses of the run that the list does not ask for; they are not written."""

    def counts(self) -> dict[str, int]:
        """Return what the table says of the pair, by the names of `COUNTS`."""
        found = Counter(self.queries["pose"]) if len(self.queries) else Counter()
        return {
            "asked": len(self.queries),
            "written": 0 if self.poses is None else len(self.poses),
            "ok": found["ok"],
            "low_confidence": found["low_confidence"],
            "filled": found[FILLED],
            "left_out": found[LEFT_OUT],
            "not_asked": self.not_asked,
        }


@dataclass
class Submission:
    """What goes into the zip file, checked."""

    description: str
    entries: list[Entry]
    sources: dict[str, str]
    """Fingerprints of the files that it is made from."""
    failed: str
    path: Path

    @property
    def missing(self) -> list[Entry]:
        """The pairs that have no file."""
        return [entry for entry in self.entries if entry.poses is None]

    def table(self) -> pd.DataFrame:
        """Return one row a pair: file, counts, state."""
        rows = [{"file": entry.name, **entry.counts(), "state": entry.state} for entry in self.entries]
        return pd.DataFrame(rows, columns=["file", *COUNTS, "state"])

    def text(self) -> str:
        """Return the table and what to know of it, as text."""
        table = self.table()
        total = table[COUNTS].sum()
        lines = [table.to_string(index=False, justify="left"), ""]
        lines.append(
            f"{len(table) - len(self.missing)} of {len(table)} pairs, {total['written']} poses for {total['asked']} "
            f"queries: {total['ok']} ok, {total['low_confidence']} of low confidence, {total['filled']} filled with "
            f"the pose of the nearest reference, {total['left_out']} left out."
        )
        if self.missing:
            lines.append(f"Missing: {', '.join(entry.name for entry in self.missing)}.")
        return "\n".join(lines)

    def write(self) -> Path:
        """Write the zip file, and beside it a CSV that says of each query where its pose is from.

        Raises:
            ToolkitError: there is not one pair to write.
        """
        written = [entry for entry in self.entries if entry.poses is not None]
        if not written:
            raise ToolkitError(f"Nothing to submit: none of the {len(self.entries)} pairs has poses.\n{self.text()}")
        with write_atomic(self.path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            _add(archive, "description.txt", self.description.encode())
            with tempfile.TemporaryDirectory() as folder:
                for entry in written:
                    assert entry.poses is not None
                    entry.poses.write(Path(folder) / entry.name)
                    _add(archive, entry.name, (Path(folder) / entry.name).read_bytes())
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
) -> Submission:
    """Gather and check the poses of runs for submission; `.write()` then writes the zip file.

    Where the runs hold a scene of a challenge, all its scenes and pairs are expected, and those that are not there are
    listed as missing. Otherwise all scenes of the runs are taken, with the pairs that their captures have.

    Args:
        runs: run folders, `<output_root>/<manifest name>`; scenes and pairs may be spread over several.
        description: a text, or the name of a file that holds it.
        out: the zip file; None: `submission.zip` in the first run folder.
        failed: what stands for a query without a pose: `nearest`, the pose of the best retrieved reference, or
            `leave-out`, nothing.
        queries: the keyframe list that must be answered, of the query session's `proc/`; None: the challenge's.
        scenes: only these; none: see above.
        captures: capture folders, where they are no longer where the runs found them.

    Raises:
        ManifestError: an unknown value, no such run, or a file that cannot be read as a description.
        ArtifactError: a pair is in two runs, or a poses file has a key twice or a quaternion that is none.
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
    found = [challenge for challenge in CHALLENGES if present & set(challenge.scenes)]
    challenge = found[0] if found else None
    places = Captures(folders, captures, sorted(present.union(scenes, challenge.scenes if challenge else ())))
    submission = Submission(
        _description(description), [], {}, failed, Path(out) if out else folders[0] / "submission.zip"
    )
    for scene in scenes or (challenge.scenes if challenge else sorted(present)):
        rules = challenge if challenge and scene in challenge.scenes else _rules_of(scene, places)
        for map_device, query_device in rules.pairs:
            entry = Entry(scene, map_device, query_device, rules.file_name(scene, map_device, query_device))
            submission.entries.append(entry)
            _fill_entry(entry, folders, places, queries or rules.queries, failed, submission.sources)
    filled = sum(entry.counts()["filled"] for entry in submission.entries)
    if filled:
        asked = sum(entry.counts()["asked"] for entry in submission.entries)
        submission.description += (
            f"{filled} of {asked} queries were not localized and have the pose of their nearest reference image.\n"
        )
    return submission


def _rules_of(scene: str, captures: "Captures") -> Challenge:
    """Return what is expected of a scene that is in no challenge: every pair that its capture has."""
    capture = captures[scene]
    maps, queries = capture.devices_with("map"), capture.devices_with("query")
    return Challenge("", {}, tuple((m, q) for m in maps for q in queries), _PAIR_FILE)


class Captures:
    """The capture of each scene: a folder that was given, else where the runs found it. Each is opened once.

    Raises:
        ManifestError: a folder that was given is not named after one of the scenes, or holds no capture.
    """

    def __init__(self, runs: Iterable[Path], given: Iterable[str | Path], scenes: Sequence[str]) -> None:
        self._places: dict[str, Path] = {}
        self._open: dict[str, Capture] = {}
        for run in runs:
            try:
                rows = json.loads((run / "run.json").read_text(encoding="utf-8"))["stages"]
                self._places |= {row["scene"]: Path(row["parameters"]["sessions_root"]).parent for row in rows}
            except (OSError, ValueError, KeyError, TypeError):
                continue  # poses of another tool, or stages run by hand: then the captures must be given
        for path in map(Path, given):
            if path.resolve().name not in scenes:
                raise ManifestError(f"{path}: a capture of another name than the scene. Expected {', '.join(scenes)}.")
            self._places[path.resolve().name] = path.resolve()

    def __getitem__(self, scene: str) -> Capture:
        if scene not in self._places:
            raise ManifestError(f"{scene}: the runs do not say where this capture is. Give it: --capture PATH/{scene}.")
        if scene not in self._open:
            try:
                self._open[scene] = Capture.open(self._places[scene])
            except CaptureError as error:
                raise ManifestError(f"{scene}: {error} Give the folder: --capture PATH/{scene}.") from None
        return self._open[scene]


def _description(text: str) -> str:
    """Return the text, or the content of the file of that name."""
    path = Path(text)
    try:
        is_file = path.is_file()
    except OSError:  # a long text is no file name
        is_file = False
    if is_file:
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise ManifestError(f"{path}: the description is not UTF-8 text ({error}).") from None
    elif path.suffix == ".txt" and len(text.split()) == 1:
        raise ManifestError(f"{path}: no such file. Give an existing file, or the description itself.")
    return text.rstrip() + "\n" if text.strip() else ""


def _fill_entry(
    entry: Entry, runs: Sequence[Path], captures: Captures, queries: str, failed: str, sources: dict[str, str]
) -> None:
    """Read the poses of a pair, and set what is written of it."""
    pair = (entry.map_device, entry.query_device)
    found = [files for run in runs if (files := SceneFiles(run, entry.scene)).poses_txt(*pair).is_file()]
    if not found:
        entry.state = "missing: no poses in " + ", ".join(str(run / entry.scene / "poses") for run in runs)
        return
    if len(found) > 1:
        both = " and ".join(str(files.poses_txt(*pair)) for files in found)
        raise ArtifactError(f"Two runs have poses of the same pair: {both}. Give one of the two runs.")
    files = found[0]
    asked = _asked(captures[entry.scene], entry.query_device, queries)
    keys = list(zip(asked["timestamp"].tolist(), asked["device_id"].tolist(), strict=True))
    poses = _read_poses(files.poses_txt(*pair))
    statuses, sources[entry.name] = _statuses(files.poses_csv(*pair)), file_fingerprint(files.poses_txt(*pair))
    rows = poses.index.find(asked["timestamp"].to_numpy(np.int64), asked["device_id"])
    entry.not_asked = len(poses) - int(np.sum(rows >= 0))
    nearest: dict[Key, np.ndarray] = {}
    reason = "not localized"
    if failed == "nearest" and np.any(rows < 0):
        nearest, reason = _nearest_references(files.retrieval(*pair))
    qt, table = [], []
    for key, row in zip(keys, rows, strict=True):
        status = statuses.get(key, "")
        if row >= 0:
            qt.append(poses.qt[row])
            table.append(("low_confidence" if status == "low_confidence" else "ok", ""))
        elif key in nearest:
            qt.append(qt_from_pose(nearest[key]))
            table.append((FILLED, status or "no row in the run's table"))
        else:
            qt.append(np.full(7, np.nan))
            table.append((LEFT_OUT, "; ".join(filter(None, [status or "no row in the run's table", reason]))))
    entry.queries = asked.assign(pose=[pose for pose, _ in table], reason=[why for _, why in table])
    values = np.array(qt, np.float64).reshape(-1, 7)
    known = np.isfinite(values).all(axis=1)
    values[:, :4] /= np.linalg.norm(values[:, :4], axis=1, keepdims=True)
    entry.poses = Trajectory(asked["timestamp"].to_numpy(np.int64)[known], asked["device_id"][known], values[known])
    counts = entry.counts()
    notes = {"left_out": "left out", "filled": "filled", "not_asked": "not asked"}
    entry.state = ", ".join(f"{counts[name]} {what}" for name, what in notes.items() if counts[name]) or "complete"


def _asked(capture: Capture, device: str, queries: str) -> pd.DataFrame:
    """Return the keyframe list that must be answered, each key once."""
    session = capture[f"{device}_query"]
    asked = session.keyframes(queries)
    repeated = KeyIndex(asked["timestamp"].to_numpy(np.int64), asked["device_id"]).repeated()
    if len(repeated):
        time, name = asked.iloc[repeated[0]][["timestamp", "device_id"]]
        raise CaptureError(
            f"{session.path}: list {queries!r} has the key (timestamp {time}, device {name!r}) twice; expected once. "
            "`python -m toolkit check CAPTURE` names the lines."
        )
    return asked


def _read_poses(path: Path) -> Trajectory:
    """Read a poses file; refuses a key that is there twice and a quaternion that is no rotation."""
    table = read_table(path, COLUMNS["trajectories.txt"])
    poses = Trajectory.from_table(table)
    repeated = poses.index.repeated()
    lengths = np.linalg.norm(poses.qt[:, :4], axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1) > UNIT_TOLERANCE)
    for rows, what in ((repeated, "is there twice"), (wrong, "has a quaternion that is not of length 1")):
        if len(rows):
            key = f"(timestamp {poses.timestamps[rows[0]]}, device {poses.device_ids[rows[0]]!r})"
            raise ArtifactError(f"{table.where(rows[0])}: {key} {what}. Localize this pair again, or correct the line.")
    return poses


def _statuses(path: Path) -> dict[Key, str]:
    """Return the status of each query, where the run has a table of them."""
    if not path.is_file():
        return {}
    table = read_query_table(path, ["status"])
    return dict(zip(zip(table["timestamp"].tolist(), table["device_id"], strict=True), table["status"], strict=True))


def _nearest_references(path: Path) -> tuple[dict[Key, np.ndarray], str]:
    """Return for each query device the pose, world_from_device (4, 4), that puts its camera with the best score at its
    first reference; and what to say of devices that have none."""
    if not path.is_file():
        return {}, f"no retrieval to fill it from: {path} is missing"
    best: dict[Key, tuple[float, np.ndarray]] = {}
    for row in read_references(path):
        try:
            key = int(row["timestamp"]), str(row["device_id"])
            for reference in row["topk"][:1]:
                world_from_rig = np.array(reference["Tws"], np.float64) @ invert(np.array(row["Trs"], np.float64))
                score = float(reference["score"])
                if key not in best or score > best[key][0]:
                    best[key] = score, world_from_rig
        except (ValueError, KeyError, TypeError) as error:
            found = f"{path}, query of {row['timestamp']}: not a retrieval row"
            raise ArtifactError(f"{found} ({error!r}). Retrieve again.") from None
    return {key: pose for key, (_, pose) in best.items()}, "no reference was retrieved"


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    # A fixed time, system and mode: the same poses give the same bytes.
    info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    info.compress_type, info.create_system, info.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
    archive.writestr(info, content)
