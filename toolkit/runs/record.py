"""`run.json`, the record of a run."""

import importlib.metadata
import json
import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from toolkit import __version__
from toolkit.errors import exit_code, sentence
from toolkit.files import read_json, write_text
from toolkit.manifest import STAGES, Manifest

RECORD = "run.json"
# Distributions whose versions may change results.
_VERSIONS = ("numpy", "pycolmap", "faiss-cpu", "opencv-python-headless", "pandas", "pillow", "torch", "rerun-sdk")


OLDER = "older"
"""Status of a stage that this run left out (`--only`), and whose results are older than what they were made from."""


@dataclass(frozen=True)
class Earlier:
    """A job that a run leaves out (`--only`)."""

    record: Path
    """Its record; missing if it has never been finished."""
    why_older: Callable[[], str]
    """Returns why its results are older than what they were made from; empty if they are not."""

    def row(self) -> dict[str, Any] | None:
        """Return the row of its last execution, with its present status."""
        row = read_json(self.record).get("row")
        if not row:
            return None
        reason = self.why_older()
        return {**row, "status": OLDER, "reason": reason} if reason else {**row, "status": "reused"}


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
    earlier: Sequence[Earlier] = ()
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
        """Write how the run ended. If the disk is too full for that, remove the record rather than leave a wrong one.

        Args:
            error: the error that stopped the run.
            incomplete: description of the failures, for a run that reached its end.
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
        work = sum(row.get("work_seconds", 0.0) for row in rows if row["status"] == "done")
        content = {
            "name": self.manifest.name,
            "status": self.status,
            "exit_code": self.exit_code,
            "error": self.error,
            "failed": failures(rows),
            "created": self.created,
            "pid": os.getpid(),
            "manifest": self.manifest.model_dump(mode="json", exclude_none=True),
            "versions": _versions(),
            "machine": _machine(),
            "code": self.code,
            "scenes": list(self.inputs),
            "inputs": self.inputs,
            "stages": rows,
            "total_seconds": round(time.perf_counter() - self.started, 2),
            "work_seconds": round(work, 2),
            "peak_memory_mb": max((row.get("peak_memory_mb", 0) for row in rows), default=0),
        }
        write_text(self.run_dir / RECORD, json.dumps(content, indent=1) + "\n")

    def all_rows(self) -> list[dict[str, Any]]:
        """Return this run's rows and, for stages that it did not run (`--only`), the rows in their records."""
        scenes = list(self.inputs)
        rows = [*self.rows, *(row for job in self.earlier if (row := job.row()))]
        return sorted(rows, key=lambda row: (scenes.index(row["scene"]), STAGES.index(row["stage"])))


def failures(rows: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Return how many images, queries and pairs failed, `{kind: {"failed": n, "of": total}}`, from rows of stages."""
    totals = {kind: {"failed": 0, "of": 0} for kind in ("images", "queries", "pairs")}
    lost: dict[tuple[str, str], set[str]] = {}
    asked = Counter[tuple[str, str]]()
    for row in rows:
        counts = row.get("counts") or {}
        for kind, stage, name in (("images", "embed", "unreadable"), ("queries", "localize", "failed")):
            if row["stage"] == stage and {kind, name} <= counts.keys():
                totals[kind]["failed"] += counts[name]
                totals[kind]["of"] += counts[kind]
        if "asked" in row:
            of_stage = row["scene"], row["stage"]
            asked[of_stage] += row["asked"]
            lost.setdefault(of_stage, set()).update(one["what"] for one in row.get("left_out", ()))
    for scene in dict.fromkeys(scene for scene, _ in asked):
        of_scene = [(of, stage) for of, stage in asked if of == scene]
        # The rows of embed are recordings, not pairs. A failed pair fails in all later stages: count it once.
        of_pairs = [(of, stage) for of, stage in of_scene if stage != "embed"] or of_scene
        totals["pairs"]["failed"] += len(set[str]().union(*(lost[of_stage] for of_stage in of_pairs)))
        totals["pairs"]["of"] += max(asked[of_stage] for of_stage in of_pairs)
    return totals


def summary(run_dir: Path) -> dict[str, Any]:
    """Return the output of `--json`: how the run ended, what failed, and the result of each stage."""
    record = read_json(run_dir / RECORD)
    kept = ("name", "status", "exit_code", "error", "failed", "created", "total_seconds")
    of_stage = ("scene", "stage", "part", "status", "reason", "seconds", "counts", "left_out", "error")
    stages = [{key: row[key] for key in of_stage if key in row} for row in record.get("stages", ())]
    return {key: record.get(key) for key in kept} | {"run": str(run_dir), "stages": stages}


def _versions() -> dict[str, str]:
    versions = {"toolkit": __version__, "python": platform.python_version()}
    for name in _VERSIONS:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def _machine() -> dict[str, Any]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"cores": cores, "python": platform.python_version(), "platform": platform.platform()}
