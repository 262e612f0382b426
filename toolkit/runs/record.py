"""`run.json`: the record of what a run did."""

import importlib.metadata
import json
import os
import platform
import time
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from toolkit import __version__
from toolkit.files import write_text
from toolkit.manifest import STAGES, Manifest

# Distributions whose versions may change results.
_VERSIONS = ("numpy", "pycolmap", "faiss-cpu", "opencv-python-headless", "pandas", "pillow", "torch", "rerun-sdk")


@dataclass
class RunLog:
    """The content of `run.json`, written anew after every stage.

    A reused stage keeps the seconds and memory of the execution that made it; `total_seconds` and
    `work_seconds` are of what this run executed, `peak_memory_mb` is of all its stages.
    """

    run_dir: Path
    manifest: Manifest
    inputs: dict[str, str]
    """Fingerprint of each scene's capture."""
    code: str
    """Fingerprint of the toolkit's code."""
    status: str = "running"
    error: str | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    def add(self, row: dict[str, Any]) -> None:
        """Add a stage that has ended."""
        self.rows.append(row)
        self.write()

    def write(self) -> None:
        """Write `run.json` as things stand."""
        rows = self._all_rows()
        work = sum(row.get("work_seconds", 0.0) for row in rows if row["status"] == "done")
        content = {
            "name": self.manifest.name,
            "status": self.status,
            "error": self.error,
            "created": self.created,
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
        write_text(self.run_dir / "run.json", json.dumps(content, indent=1) + "\n")

    def _all_rows(self) -> list[dict[str, Any]]:
        """Return this run's rows and, for stages that `--only` left alone, those of their records."""
        mine = {(row["scene"], row["stage"]) for row in self.rows}
        rows = list(self.rows)
        for scene in self.inputs:
            for record in sorted((self.run_dir / scene / ".stages").glob("*.json")):
                row = read_json(record).get("row")
                if row and row["stage"] in self.manifest.stages and (scene, row["stage"]) not in mine:
                    rows.append({**row, "status": "reused"})
        scenes = list(self.inputs)
        return sorted(rows, key=lambda row: (scenes.index(row["scene"]), STAGES.index(row["stage"])))


def read_json(path: Path) -> dict[str, Any]:
    """Return a JSON object, an empty one where the file is missing or holds something else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _versions() -> dict[str, str]:
    versions = {"toolkit": __version__, "python": platform.python_version()}
    for name in _VERSIONS:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def _machine() -> dict[str, Any]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"cores": cores, "python": platform.python_version(), "platform": platform.platform()}
