"""The run folder: its lock, its log, its record `run.json`, and what killed runs left in it; and the folders of a
sweep, runs of a manifest with other values of some settings: their names, and the results that they share.
"""

import importlib.metadata
import json
import logging
import os
import platform
import re
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from itertools import product, takewhile
from pathlib import Path
from typing import Any

import yaml
from filelock import SoftFileLock

from toolkit import __version__
from toolkit.capture import Capture
from toolkit.capture.names import allow_outside, extra_devices
from toolkit.errors import CaptureError, ManifestError, ToolkitError, exit_code, sentence
from toolkit.files import (
    SceneFiles,
    environment_variable,
    fingerprint,
    is_left_over,
    link_folder,
    read_json,
    sweep_partials,
    try_lock,
    write_text,
)
from toolkit.manifest import STAGES, Manifest
from toolkit.manifest.settings import merge

log = logging.getLogger(__name__)
LOG, RECORD = "run.log", "run.json"
LOG_VARIABLE = "TOOLKIT_RUN_LOG"
"""Environment variable with the path of the log, for the kernels of a run."""
OLDER = "older"
"""Status of a stage that this run left out (`--only`), and whose results are older than what they were made from."""
# Distributions whose versions may change results.
_VERSIONS = ("numpy", "pycolmap", "faiss-cpu", "opencv-python-headless", "pandas", "pillow", "torch", "rerun-sdk")
MAX_RUNS = 100
"""Limit of runs in a sweep: more are most likely a mistake."""
_NO_RESULT = {"name", "output_root", "tolerate_failed", "description"}
"""Keys of a manifest that change no result."""
_LONGEST = 100
"""Longest name of a run folder, letters; a longer one ends in a fingerprint."""
TAKEN = ("embed", "retrieve", "rerank", "localize", "sequence")
"""Stages whose results a run takes over, in order."""


@contextmanager
def held(run_dir: Path) -> Iterator[None]:
    """Lock a run folder, log to its `run.log`, and remove the leftovers of a killed run.

    The operating system releases the lock when the process ends, however it ends. Raise ToolkitError if another run
    holds it; the message names its process, host and start.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    holder = run_dir / ".run.lock.json"
    lock, acquired = try_lock(run_dir / ".run.lock")
    only_marked = isinstance(lock, SoftFileLock)
    if not acquired:
        other = read_json(holder)
        who = f"process {other.get('pid', '?')} on {other.get('host', '?')}, since {other.get('since', '?')}"
        do = "Wait until it ends, stop it, or write this run to another folder (--set output_root=FOLDER)."
        if only_marked:
            do += f" If it no longer runs, delete {lock.lock_file}: this file system has no locks, so a kill leaves it."
        raise ToolkitError(f"{run_dir}: another run is using this folder: {who}. {do}")
    try:
        me = {"pid": os.getpid(), "host": socket.gethostname()}
        with log_to(run_dir / LOG), environment_variable(LOG_VARIABLE, str((run_dir / LOG).absolute())):
            if only_marked:
                log.warning(
                    "The file system of %s has no locks: %s marks that a run uses it, and stays if the run is killed.",
                    run_dir, lock.lock_file,
                )  # fmt: skip
            if before := read_json(holder):
                log.warning("The run of process %s on %s was killed.", before.get("pid"), before.get("host"))
            write_text(holder, json.dumps(me | {"since": datetime.now().isoformat(" ", "seconds")}) + "\n")
            _sweep(run_dir)
            yield
    finally:
        for path in (holder, run_dir / ".run.lock"):  # before the release, so that no other run's files are removed
            with suppress(OSError):
                path.unlink()
        lock.release()


def _sweep(run_dir: Path) -> None:
    """Remove temporary files and folders of killed runs, and mark a record that still says `running` as interrupted."""
    sweep_partials(run_dir)
    # Papermill writes the executed notebook under a name without a process id, which `sweep_partials` does not know.
    for notebook in run_dir.glob("notebooks/.*.partial.ipynb"):
        notebook.unlink()
    for folder in Path(tempfile.gettempdir()).glob("kernel.*"):
        if is_left_over(folder.name):
            log.debug("Removed %s of a killed run.", folder)
            shutil.rmtree(folder, ignore_errors=True)
    record = read_json(run_dir / RECORD)
    if record.get("status") == "running":
        killed = {"status": "interrupted", "error": "The run was killed. The same command continues it."}
        write_text(run_dir / RECORD, json.dumps(record | killed, indent=1) + "\n")


def log_to(path: Path) -> ExitStack:
    """Log to a file, with times, until the returned context closes: all messages of the toolkit, debug included, and
    warnings of other libraries, which still appear on the terminal.
    """
    root, own, ending = logging.getLogger(), logging.getLogger("toolkit"), ExitStack()
    file = logging.FileHandler(path, encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(process)d %(levelname)s %(name)s: %(message)s"))
    # A full disk would print a traceback for each line; the run itself fails with the error.
    file.handleError = lambda record: None  # type: ignore[method-assign]
    handlers: list[logging.Handler] = [file]
    if not root.handlers and logging.lastResort is not None:
        handlers.append(logging.lastResort)  # prints warnings; logging skips it as soon as there is another handler
    for handler in handlers:
        root.addHandler(handler)
        ending.callback(root.removeHandler, handler)
    ending.callback(own.setLevel, own.level)
    own.setLevel(logging.DEBUG)
    ending.callback(_close, file)
    return ending


def warnings_of_kernels(path: Path, start: int) -> list[str]:
    """Return the distinct warnings of other processes (kernels) in a log after its first `start` bytes.

    Warnings of this process are already on the terminal.
    """
    lines = path.read_bytes()[start:].decode("utf-8", errors="replace").splitlines()
    matches = (re.fullmatch(r"\S+ \S+ (\d+) WARNING toolkit\.\S+: (.+)", line) for line in lines)
    return list(dict.fromkeys(match[2] for match in matches if match and int(match[1]) != os.getpid()))


def _close(file: logging.FileHandler) -> None:
    with suppress(OSError):  # a full disk: report the error that stopped the run, not this one
        file.close()


@dataclass
class RunLog:
    """The content of `run.json`, rewritten after every stage.

    A reused stage keeps the seconds and memory of the run that executed it. `total_seconds` and `work_seconds` count
    only what this run executed, `peak_memory_mb` covers all stages.
    """

    run_dir: Path
    manifest: Manifest
    inputs: dict[str, str]
    """Fingerprint of each scene's capture."""
    code: str
    """Fingerprint of the toolkit's code."""
    earlier: Callable[[], list[dict[str, Any]]] = list
    """Returns the rows of the stages that this run leaves out (`--only`)."""
    status: str = "running"
    """`running`, `done`, `incomplete` (more failed than the manifest tolerates), `failed`, or `interrupted`."""
    error: str | None = None
    exit_code: int | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)
    shown: set[str] = field(default_factory=set)
    """Warnings that the terminal has already shown."""
    started: float = field(default_factory=time.perf_counter)
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    def add(self, row: dict[str, Any]) -> None:
        """Add the row of a stage that has ended, and write the record."""
        self.rows.append(row)
        self.write()

    def end(self, error: BaseException | None = None, incomplete: str | None = None) -> None:
        """Write how the run ended: stopped by an error, or at its end, perhaps `incomplete`, with a description of the
        failures.

        If the disk is too full for that, remove the record rather than leave a wrong one.
        """
        self.status, self.error, self.exit_code = ("incomplete", incomplete, 2) if incomplete else ("done", None, 0)
        if error is not None:
            self.status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            self.error, self.exit_code = sentence(error), exit_code(error)
        try:
            self.write()
        except OSError:
            with suppress(OSError):
                (self.run_dir / RECORD).unlink(missing_ok=True)  # frees space for the second try
                self.write()
            if error is None:
                raise

    def write(self) -> None:
        """Write the current state to `run.json`."""
        rows = self.all_rows()
        as_taken = self.manifest.model_copy(update={one: self.manifest.stage(one) for one in self.manifest.stages})
        all_set = as_taken.model_dump(mode="json", exclude_none=True)
        work = sum(row.get("work_seconds", 0.0) for row in rows if row["status"] == "done")
        content = {
            "name": self.manifest.name,
            "status": self.status,
            "exit_code": self.exit_code,
            "error": self.error,
            "failed": failures(rows),
            "created": self.created,
            "pid": os.getpid(),
            # Null is left out where it is the default: it is said where it turns something off, as `unit: null`.
            "manifest": merge(all_set, as_taken.model_dump(mode="json", exclude_defaults=True)),
            "versions": _versions(),
            "machine": machine(),
            "code": self.code,
            "commit": commit(),
            "scenes": list(self.inputs),
            "inputs": self.inputs,
            "stages": rows,
            "total_seconds": round(time.perf_counter() - self.started, 2),
            "work_seconds": round(work, 2),
            "peak_memory_mb": max((row.get("peak_memory_mb", 0) for row in rows), default=0),
        }
        write_text(self.run_dir / RECORD, json.dumps(content, indent=1) + "\n")

    def all_rows(self) -> list[dict[str, Any]]:
        """Return this run's rows and those of the stages that it left out."""
        scenes = list(self.inputs)
        rows = [*self.rows, *self.earlier()]
        return sorted(rows, key=lambda row: (scenes.index(row["scene"]), STAGES.index(row["stage"])))


@contextmanager
def open_captures(
    runs: Iterable[Path], given: Iterable[str | Path], scenes: Sequence[str]
) -> Iterator[Callable[[str], Capture]]:
    """Yield a function that opens a scene's capture, with the kinds of devices and the links of the runs' manifests.

    Captures that have moved since are in the `given` folders, which have the names of scenes, else raise ManifestError.
    """
    folders, devices, outside = dict[str, Path](), [], False
    for record in [read_json(run / "run.json") for run in runs]:
        # Poses of another tool and stages run by hand have no such record: the user must give the captures.
        with suppress(KeyError, TypeError):
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


def failures(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Return how many images, queries and pairs failed, `{kind: {"failed": n, "of": total}}`, from rows of stages."""
    totals = {kind: {"failed": 0, "of": 0} for kind in ("images", "queries", "pairs")}
    for row in rows:
        counts = row.get("counts") or {}
        for kind, stage, name in (("images", "embed", "unreadable"), ("queries", "localize", "failed")):
            if row["stage"] == stage and {kind, name} <= counts.keys():
                totals[kind]["failed"] += counts[name]
                totals[kind]["of"] += counts[kind]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        asked = [row for row in rows if row["scene"] == scene and "asked" in row]
        # The rows of embed are recordings, not pairs. A failed pair fails in all later stages: count it once.
        asked = [row for row in asked if row["stage"] != "embed"] or asked
        totals["pairs"]["failed"] += len({one["what"] for row in asked for one in row.get("left_out", ())})
        totals["pairs"]["of"] += max((row["asked"] for row in asked), default=0)
    return totals


def summary(run_dir: Path) -> dict[str, Any]:
    """Return the output of `--json`: how the run ended, what failed, and the result of each stage."""
    record = read_json(run_dir / RECORD)
    kept = ("name", "status", "exit_code", "error", "failed", "created", "pid", "total_seconds")
    of_stage = ("scene", "stage", "status", "reason", "seconds", "counts", "left_out", "error")
    stages = [{key: row[key] for key in of_stage if key in row} for row in record.get("stages", ())]
    return {key: record.get(key) for key in kept} | {"run": str(run_dir), "stages": stages}


def counted(number: int, plural: str) -> str:
    """Return a count with its noun: `2 queries`, `1 query`, `1 pair of devices`."""
    noun, of, rest = plural.replace("_", " ").partition(" of ")
    if number == 1:
        noun = f"{noun[:-3]}y" if noun.endswith("ies") else noun.removesuffix("s")
    return f"{number} {noun}{of}{rest}"


def counts_text(counts: Mapping[str, int]) -> str:
    """Return the counts of a stage in words."""
    return ", ".join(counted(number, name) for name, number in counts.items())


@cache
def machine() -> dict[str, Any]:
    """Return the CPU, the cores that this process may use, memory, GPUs (`none` without any) and operating system."""
    import psutil

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    info = Path("/proc/cpuinfo")
    named = re.search(r"model name\s*: (.+)", info.read_text()) if info.is_file() else None
    cpu = named[1] if named else _output("sysctl", "-n", "machdep.cpu.brand_string")  # macOS
    gpus = _output("nvidia-smi", "--query-gpu=name", "--format=csv,noheader").splitlines()
    return {
        "cpu": cpu or platform.processor() or platform.machine(),
        "cores": cores,
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "gpu": ", ".join(gpus) or "none",
        "platform": platform.platform(),
    }


@cache
def commit() -> str:
    """Return the git commit of the toolkit, with `-dirty` if files differ from it; empty without a repository."""
    root = Path(__file__).resolve().parents[2]
    # Otherwise, an installed toolkit would name the commit of the repository around its environment.
    if not (root / ".git").exists():
        return ""
    described = "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"
    return _output("git", "--no-optional-locks", "-C", str(root), *described)


def _output(*command: str) -> str:
    """Return what a command prints; empty if it fails or does not exist."""
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def _versions() -> dict[str, str]:
    versions = {"toolkit": __version__, "python": platform.python_version()}
    for name in _VERSIONS:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


# Sweeps


def changed_keys(plain: Manifest, changed: Manifest, overrides: Iterable[str]) -> dict[str, str]:
    """Return, by key, the values of the overrides, `key=value` each, that make a difference between two manifests."""
    before, after = (manifest.model_dump(mode="json") for manifest in (plain, changed))
    keys = {}
    for override in overrides:
        key, _, value = override.partition("=")
        if key.partition(".")[0] not in _NO_RESULT and _value(before, key) != _value(after, key):
            keys[key.strip()] = value
    return keys


def _value(content: Any, key: str) -> Any:
    """Return the value of a key `stage.key` in nested dicts, None without one."""
    for part in key.strip().split("."):
        content = content.get(part) if isinstance(content, dict) else None
    return content


def variant_name(name: str, keys: Mapping[str, str]) -> str:
    """Return the name of a run that differs from the run `name` in these keys and values: `<name>-<key>-<value>`."""
    short = [key.rpartition(".")[2] for key in keys]
    labels = short if len(set(short)) == len(short) else list(keys)
    values = (re.sub(r"[^\w.+-]+", "-", value).strip("-") or "none" for value in keys.values())
    whole = "-".join([name, *(f"{label}-{value}" for label, value in zip(labels, values, strict=True))])
    return whole if len(whole) <= _LONGEST else f"{whole[: _LONGEST - 9]}-{fingerprint(whole)[:8]}"


def swept_runs(name: str, sweeps: Sequence[str]) -> dict[str, list[str]]:
    """Return the runs of a sweep: one per value or, for several keys, one per combination of values.

    Args:
        name: name of the manifest.
        sweeps: `key=a,b,c` each. Values are YAML: `embed.model=vlad,[megaloc, vlad]` has two values.

    Returns:
        The overrides of each run, `key=value` each as for `--set`, by its name, `<manifest>-<key>-<value>`.
    """
    values: dict[str, list[str]] = {}
    for sweep in sweeps:
        key, equals, text = sweep.partition("=")
        key = key.strip()
        try:
            parsed = yaml.safe_load(f"[{text}]") if equals and key else None
        except yaml.YAMLError:
            parsed = None
        if not parsed:
            example = "localize.pnp.min_inliers=10,20,40"
            raise ManifestError.at(f"--sweep {sweep}", expected=f"key=value,value,..., for example {example}")
        if key in values:
            raise ManifestError.at(f"--sweep {key}", "it twice", "one list of values per key")
        if key.partition(".")[0] in ("captures", "demo_data"):
            do = f"The runs could not be compared: run the manifest once per value, --set {key}=... --set name=..."
            raise ManifestError.at(f"--sweep {key}", expected="the same captures for all runs", do=do)
        texts = [yaml.safe_dump(value, default_flow_style=True, width=10**6).split("\n")[0] for value in parsed]
        values[key] = list(dict.fromkeys(texts))
    combinations = [dict(zip(values, chosen, strict=True)) for chosen in product(*values.values())]
    if len(combinations) > MAX_RUNS:
        raise ManifestError.at("--sweep", f"{len(combinations)} runs", f"at most {MAX_RUNS}", "Use fewer values.")
    runs = {variant_name(name, keys): [f"{key}={value}" for key, value in keys.items()] for keys in combinations}
    if len(runs) < len(combinations):
        found = "two runs with the same folder name"
        raise ManifestError.at(f"--sweep {' '.join(sweeps)}", found, do="Sweep one key at a time.")
    return runs


def take_over(donors: Sequence[Path], own: Manifest) -> None:
    """Fill a new run folder with the results of the donor, a run folder, that shares most with it.

    These are features, maps, and the results of all stages before the first stage with other settings. Too much does no
    harm: each stage reuses only what fits its settings. Files become hard links, since the toolkit never changes a file
    but replaces it as a whole; or copies, if the disk does not support links. Scenes that have a folder are skipped.
    """
    shared = {donor: _shared_stages(donor, own) for donor in donors if donor.is_dir()}
    donor = max(shared, key=lambda donor: shared[donor], default=None)
    for scene in (Path(capture).name for capture in own.captures):
        mine = SceneFiles(Path(own.output_root) / own.name, scene)
        if donor is None or mine.root.exists():
            continue
        theirs = SceneFiles(donor, scene)
        for source in {*theirs.caches, *(theirs.of_stage(stage) for stage in TAKEN[: shared[donor]])}:
            if source is not None and source.is_dir():
                link_folder(source, mine.root / source.name)


def _shared_stages(donor: Path, own: Manifest) -> int:
    """Return how many stages of `TAKEN`, from the first on, have the same settings in the record of a run."""
    try:
        theirs = Manifest.of(read_json(donor / RECORD).get("manifest"))
    except ManifestError:  # without a record, or of an older version
        return 0
    if any(getattr(theirs, key) != getattr(own, key) for key in ("queries", "devices", "pairs", "extra_devices")):
        return 0
    before, after = ([one.stage(stage) if stage in one.stages else None for stage in TAKEN] for one in (theirs, own))
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(before, after, strict=True)))
