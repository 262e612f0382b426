"""Artifacts on disk: written whole or not at all, each with a record of what it was made from."""

import hashlib
import json
import os
import platform
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from toolkit import __version__
from toolkit.errors import ArtifactError


@contextmanager
def write_atomic(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that is moved into place when the block ends without an error.

    A killed or failing writer leaves the old file, or none, under the final name.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Process and machine are in the name: `sweep_partials` then knows what nobody writes any more.
    prefix = f".{path.name}.{os.getpid()}-{_machine()}-"
    handle, name = tempfile.mkstemp(prefix=prefix, suffix=f".partial{path.suffix}", dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes private files; an artifact is as readable as any other file of the user.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def sweep_partials(folder: str | Path) -> None:
    """Remove what killed writers of this machine left at and below a folder; what is still being written stays."""
    import psutil

    for path in Path(folder).rglob(".*.partial*"):
        writer = re.search(rf"\.(\d+)-{_machine()}-[^.]*\.partial", path.name)
        if writer and not psutil.pid_exists(int(writer[1])):
            with suppress(OSError):
                path.unlink()


@cache
def _machine() -> str:
    """Return 8 hex digits that tell this machine from others that share its disks."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in one piece (see `write_atomic`)."""
    with write_atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def fingerprint(value: Any) -> str:
    """Return 16 hex digits that identify a nest of dicts, lists, strings, numbers, None and paths."""
    canonical = json.dumps(value, sort_keys=True, separators=(",", ":"), default=_jsonable)
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def file_fingerprint(path: str | Path) -> str:
    """Return 16 hex digits that identify a file's content by its bytes."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:16]


def files_fingerprint(paths: list[Path]) -> str:
    """Return 16 hex digits that identify many files by name, size and time of change, without reading them."""
    rows = []
    for path in paths:
        try:
            stat = path.stat()
            rows.append([path.name, stat.st_size, stat.st_mtime_ns])
        except (FileNotFoundError, NotADirectoryError):
            rows.append([path.name, None, None])
    return fingerprint(rows)


def sidecar_path(path: str | Path) -> Path:
    """Return where the record of what an artifact was made from is kept: `<name>.meta.json` beside it."""
    path = Path(path)
    return path.with_name(path.name + ".meta.json")


def write_sidecar(path: str | Path, settings: dict[str, Any]) -> None:
    """Record the settings and inputs that the artifact `path` was made from.

    Call it after the artifact stands: an artifact without a matching record is made again.
    """
    size = Path(path).stat().st_size
    record = {"version": __version__, "fingerprint": fingerprint(settings), "bytes": size, "settings": settings}
    write_text(sidecar_path(path), json.dumps(record, indent=1, default=_jsonable) + "\n")


def read_sidecar(path: str | Path) -> dict[str, Any] | None:
    """Return the settings that the artifact `path` was made from; None unless it is whole and of this version."""
    try:
        record = json.loads(sidecar_path(path).read_text(encoding="utf-8"))
        current = {"version": __version__, "bytes": Path(path).stat().st_size}
    except (OSError, ValueError):
        return None
    if not isinstance(record, dict) or any(record.get(key) != value for key, value in current.items()):
        return None
    settings = record.get("settings")
    whole = isinstance(settings, dict) and record.get("fingerprint") == fingerprint(settings)
    return settings if whole else None


def is_current(path: str | Path, settings: dict[str, Any]) -> bool:
    """Tell whether the artifact `path` is whole and was made by this version from exactly these settings."""
    found = read_sidecar(path)
    return found is not None and fingerprint(found) == fingerprint(settings)


def _jsonable(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item"):  # a numpy scalar
        return value.item()
    raise TypeError(f"Settings must be JSON: {value!r} is a {type(value).__name__}.")


@dataclass(frozen=True)
class SceneFiles:
    """Where the files of one scene lie in a run folder."""

    run: Path
    """The run folder, `<output_root>/<manifest name>`."""
    scene: str
    """Name of the capture's folder."""

    @property
    def root(self) -> Path:
        return Path(self.run) / self.scene

    @property
    def embeddings(self) -> Path:
        return self.root / "embeddings"

    @property
    def features(self) -> Path:
        return self.root / "features"

    @property
    def maps(self) -> Path:
        return self.root / "map"

    @property
    def retrieval_dir(self) -> Path:
        return self.root / "retrieval"

    @property
    def reranked_dir(self) -> Path:
        return self.root / "reranked"

    @property
    def poses_dir(self) -> Path:
        return self.root / "poses"

    @property
    def evaluation(self) -> Path:
        return self.root / "evaluation"

    @property
    def visualization(self) -> Path:
        return self.root / "visualization"

    def retrieval(self, map_device: str, query_device: str) -> Path:
        return self.retrieval_dir / f"{pair_name(self.scene, map_device, query_device)}.jsonl"

    def poses_txt(self, map_device: str, query_device: str) -> Path:
        return self.poses_dir / f"{pair_name(self.scene, map_device, query_device)}.txt"

    def poses_csv(self, map_device: str, query_device: str) -> Path:
        return self.poses_dir / f"{pair_name(self.scene, map_device, query_device)}.csv"


def image_name(path: str) -> str:
    """Return the name of an image (`<session>/raw_data/<path>`) that outputs give as `<scene>/sessions/<name>`."""
    return path.split("/sessions/", 1)[-1]


def pair_name(scene: str, map_device: str, query_device: str) -> str:
    """Return the file stem of a map x query pair, as the challenge names it."""
    return f"{scene}_map_{map_device}_query_{query_device}"


def read_references(path: str | Path, *needed: str) -> list[dict[str, Any]]:
    """Return the rows of a file of references, one a query image.

    Each has at least `timestamp` (a whole number), `sensor_id`, and `topk`, a list of map images with a `path` each;
    those that the toolkit writes have the keys that the retrieve stage describes.

    Args:
        needed: further keys that each row must have.

    Raises:
        ArtifactError: the file is missing, or a line of it is no such row.
    """
    rows: list[dict[str, Any]] = []
    keys, number = {"timestamp", "sensor_id", "topk", *needed}, 0
    try:
        with open(path, encoding="utf-8") as lines:
            for line in lines:
                number += 1
                if line.strip():
                    rows.append(_checked(json.loads(line), keys))
    except FileNotFoundError:
        raise ArtifactError(
            f"No references: {path} is missing. Run the retrieve stage first "
            "(python -m toolkit run MANIFEST --only retrieve)."
        ) from None
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ArtifactError(f"{path}, line {number}: not a retrieval row ({error}). Retrieve again.") from None
    return rows


def _checked(row: Any, keys: set[str]) -> dict[str, Any]:
    if not isinstance(row, dict) or not keys <= row.keys():
        found = sorted(row) if isinstance(row, dict) else row
        raise ValueError(f"found {found!r}; expected the keys {', '.join(sorted(keys))} and others")
    if not isinstance(row["topk"], list):
        raise TypeError(f"found topk {row['topk']!r}; expected a list of references")
    if not all(isinstance(reference, dict) and "path" in reference for reference in row["topk"]):
        raise ValueError("a reference in topk has no path")
    int(row["timestamp"])
    return row
