"""Artifacts on disk: written atomically, each with a record of its settings, inputs and checksums."""

import csv
import ctypes
import errno
import glob
import hashlib
import json
import logging
import os
import pickle
import platform
import re
import secrets
import shutil
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import xxhash

from toolkit import __version__
from toolkit.errors import COMMAND, ArtifactError, ToolkitError

if TYPE_CHECKING:
    import pandas as pd
    from filelock import BaseFileLock

log = logging.getLogger(__name__)

NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
"""Errors of file systems that have no locks."""


@contextmanager
def write_atomic(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which is moved to `path` if the block ends without an error."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The name contains process and machine, so that `sweep_partials` recognizes abandoned files.
    temporary = path.with_name(f".{path.name}.{process_tag()}-{secrets.token_hex(4)}.partial{path.suffix}")
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def write_folder(path: str | Path, replace: bool = False, keep: bool = False) -> Iterator[Path]:
    """Yield a hidden folder, which is moved to `path` if the block ends without an error.

    Args:
        replace: `path` may be a folder with files, which is replaced at once; else it must be missing or empty.
        keep: the new folder starts with these files, as hard links: replace them rather than write into them.
    """
    path = Path(path)
    recover_folder(path)
    with temporary_folder(path) as folder:
        content = folder / path.name
        content.mkdir()
        if keep and path.is_dir():
            shutil.copytree(path, content, symlinks=True, copy_function=link_or_copy, dirs_exist_ok=True)
        yield content
        if replace and path.is_dir():
            _exchange(content, path)
        else:
            content.replace(path)


def recover_folder(path: Path) -> None:
    """Remove remains of killed writers of a folder; a folder that one has moved away for a new one comes back."""
    for stale in path.parent.glob(f".{glob.escape(path.name)}.*-*"):
        if is_left_over(stale.name):
            if (stale / _ASIDE).is_dir() and not path.exists():
                (stale / _ASIDE).replace(path)
            shutil.rmtree(stale, ignore_errors=True)


_ASIDE = "old"


def _exchange(new: Path, old: Path) -> None:
    """Exchange two folders: at once by Linux's renameat2, where the file system has it; else the old one goes first."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE of linux/fs.h
    if rename is None or rename(here, os.fsencode(new), here, os.fsencode(old), exchange) != 0:
        aside = old.replace(new.with_name(_ASIDE))
        try:
            new.replace(old)
        except BaseException:
            aside.replace(old)
            raise


@contextmanager
def temporary_folder(path: str | Path) -> Iterator[Path]:
    """Yield a hidden folder beside `path`, which is removed when the block ends, or else by `sweep_partials`."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(".partial", f".{path.name}.{process_tag()}-", path.parent) as folder:
        yield Path(folder)


def try_lock(path: Path) -> "tuple[BaseFileLock, bool]":
    """Return a lock, and whether this process got it, without waiting.

    On file systems without locks (NFS without lockd, FUSE), it is a `SoftFileLock`: a file that exists while the lock
    is held. A process that is killed leaves it; where its host is another, a person must remove it.
    """
    from filelock import FileLock, SoftFileLock, Timeout

    lock: BaseFileLock = FileLock(path)
    try:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of filelock, that it takes a SoftFileLock for ENOSYS
                lock.acquire(timeout=0)
        except (OSError, NotImplementedError) as error:  # NotImplementedError: ENOSYS in earlier versions of filelock
            if isinstance(error, OSError) and error.errno not in NO_LOCKS:  # such as Timeout
                raise
            lock = SoftFileLock(path.with_name(f"{path.name}.mark"))
            lock.acquire(timeout=0)
    except Timeout:
        return lock, False
    return lock, True


def process_tag() -> str:
    """Return `<process>-<machine>`, for names of temporary files and folders; see `is_left_over`."""
    return f"{os.getpid()}-{_machine()}"


def is_left_over(name: str) -> bool:
    """Tell whether a temporary file or folder, with `.<process_tag()>-` in its name, is from a process that ended.

    False for those of other machines, whose processes are not known here.
    """
    import psutil

    writer = re.search(rf"\.(\d{{1,9}})-{_machine()}-", name)
    return writer is not None and not psutil.pid_exists(int(writer[1]))


def sweep_partials(folder: str | Path) -> None:
    """Remove temporary files and folders below a folder that killed processes of this machine left."""
    for path in Path(folder).rglob(".*.partial*"):
        if is_left_over(path.name):
            with suppress(OSError):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


@cache
def _machine() -> str:
    """Return 8 hex digits that distinguish this machine from others with the same disks."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


@contextmanager
def environment_variable(name: str, value: str) -> Iterator[None]:
    """Set an environment variable within the context, for this process and the processes that it starts."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]
        if before is not None:
            os.environ[name] = before


def link_or_copy(source: str | Path, target: str | Path) -> None:
    """Make `target` a hard link to a file of a run, or a copy: the toolkit never changes a file, but replaces it."""
    try:
        os.link(source, target)
    except OSError:  # another disk, or one without hard links
        shutil.copy2(source, target)


def relative_url(path: Path) -> str:
    """Return the address of a link relative to the notebook, as JupyterLab opens only what is below its own folder."""
    return quote(os.path.relpath(path, Path.cwd()))


def link_folder(source: str | Path, target: str | Path) -> None:
    """Make a new folder of hard links to the files of another, see `link_or_copy`; hidden ones are left out."""
    shutil.copytree(source, target, copy_function=link_or_copy, ignore=shutil.ignore_patterns(".*"))


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically; see `write_atomic`."""
    with write_atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_csv(path: str | Path, table: "pd.DataFrame", **options: Any) -> None:
    """Write a table atomically, by default without its index; see `write_atomic` and pandas' `to_csv` for `options`."""
    with write_atomic(path) as temporary:
        table.to_csv(temporary, lineterminator="\n", **({"index": False} | options))


def fingerprint(value: Any) -> str:
    """Return 16 hex digits that identify a nested value of dicts, lists, strings, numbers, None and paths."""
    canonical = json.dumps(value, sort_keys=True, separators=(",", ":"), default=_jsonable)
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def file_fingerprint(path: str | Path) -> str:
    """Return 16 hex digits that identify the content of a file."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:16]


def files_fingerprint(paths: list[Path]) -> str:
    """Return 16 hex digits that identify files by name, size and modification time, without reading them."""
    rows = []
    for path in paths:
        try:
            stat = path.stat()
            rows.append([path.name, stat.st_size, stat.st_mtime_ns])
        except OSError:  # missing, or a path that cannot be followed
            rows.append([path.name, None, None])
    return fingerprint(rows)


def checksum(path: str | Path) -> str:
    """Return the XXH3 hash of a file's content, 32 hex digits, cached until the file changes.

    It detects damage at the speed of memory, but gives no protection against deliberate changes.
    """
    stat = os.stat(path)  # noqa: PTH116 - faster; called often
    return _checksum(str(path), stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)


@lru_cache(maxsize=1 << 16)
def _checksum(path: str, *state: int) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, xxhash.xxh3_128).hexdigest()


def sidecar_path(path: str | Path) -> Path:
    """Return the path of an artifact's record: `<name>.meta.json` beside it."""
    path = Path(path)
    return path.with_name(path.name + ".meta.json")


def write_sidecar(
    path: str | Path,
    settings: dict[str, Any],
    others: Iterable[str | Path] = (),
    *,
    made_from: Iterable[str | Path] = (),
    captured: Iterable[str | Path] = (),
    unfinished: bool = False,
) -> None:
    """Record the settings and inputs of a written artifact, and the checksums of its files.

    Args:
        others: further files beside it that belong to the artifact.
        made_from: existing files of the run that it was made from, see `changed_sources`.
        captured: likewise existing files of the capture.
        unfinished: a part of the artifact failed and must be tried again: this run uses it, later runs do not reuse it.
    """
    files = [Path(path), *map(Path, others)]
    sources = {os.path.relpath(one, Path(path).parent): _content(one) for one in made_from}
    # Run and capture move apart. The folder of the images may be a link.
    sources |= {str(Path(one).parent.resolve() / Path(one).name): _content(one) for one in captured}
    record = {
        "version": __version__,
        "fingerprint": fingerprint(settings),
        "files": {file.name: [file.stat().st_size, checksum(file)] for file in files},
        "made_from": sources,
        "sources": fingerprint(sources),
        **({"unfinished": True} if unfinished else {}),
        "settings": settings,
    }
    write_text(sidecar_path(path), json.dumps(record, indent=1, default=_jsonable) + "\n")


def read_sidecar(path: str | Path) -> dict[str, Any] | None:
    """Return an artifact's settings; None, with a warning, unless it is complete, undamaged and from this version."""
    record = _read_record(path)
    if record.get("version") != __version__ or record.get("unfinished") or not record.get("files"):
        return None
    if damage := _damage(path, record):
        log.warning("%s: not reused.", damage)
    return None if damage else record["settings"]


def is_current(path: str | Path, settings: dict[str, Any]) -> bool:
    """Tell whether the artifact `path` is undamaged and was made by this version with exactly these settings."""
    same = _read_record(path).get("fingerprint") == fingerprint(settings)  # fast, without reading the artifact
    return same and read_sidecar(path) is not None


def require_whole(path: str | Path, of: str | Path | None = None) -> None:
    """Refuse a file that differs from its record, or from that of the artifact that it is `of`: raise ArtifactError.

    A file without a record is accepted: it is from another tool.
    """
    artifact = Path(of or path)
    if damage := _damage(artifact, _read_record(artifact), Path(path).name):
        record = sidecar_path(artifact)
        text = f"Run the stage that makes it again. To use a file that was changed on purpose, delete {record}"
        raise ArtifactError(f"{damage}. {text}.")


def changed_sources(artifact: str | Path) -> list[Path]:
    """Return the files that an artifact was made from and that have changed since, or are missing.

    Artifacts of which one is older than another that it was made from do not belong together. One without a record is
    from another tool, and as current as can be known. A file of the capture that is missing has not changed: results
    are read where their capture is not.
    """
    # A file of the capture, which alone has an absolute path in the record, may be elsewhere.
    found = [(name, path, content, _content(path)) for name, path, content in _sources(artifact)]
    return [path for name, path, content, now in found if now != content and (now or not Path(name).is_absolute())]


def sources_of(artifact: str | Path) -> dict[Path, Any]:
    """Return the files that an artifact was made from, in a copied run those of the copy, with a hash of each."""
    return {path: content for _, path, content in _sources(artifact)}


def _sources(artifact: str | Path) -> list[tuple[str, Path, Any]]:
    """Return name in the record, path and hash of the files that an artifact was made from."""
    recorded = _read_record(artifact).get("made_from")
    sources = recorded if isinstance(recorded, dict) else {}
    folder = Path(artifact).parent
    return [(name, Path(os.path.normpath(folder / name)), content) for name, content in sources.items()]


def why_older(
    artifact: str | Path, stage: str, endings: Sequence[str] = (), missing: bool = True, inputs: str | None = None
) -> str:
    """Return a sentence that says which sources of an artifact have changed since it was made; empty if none has.

    Args:
        stage: the stage that makes it again.
        endings: only sources whose paths end with one of these; empty: all.
        missing: whether a source that is missing counts as changed.
        inputs: fingerprint of what is no file of its own, as the artifact's settings record it under `inputs`.
    """
    changed = [path for path in changed_sources(artifact) if missing or path.exists()]
    changed = [path for path in changed if path.as_posix().endswith(tuple(endings) or "")]
    name = Path(artifact).name
    if not changed:
        made_of = _read_record(artifact).get("settings", {}).get("inputs") or inputs
        other = f"{name} is of other images or features: run the {stage} stage again."
        return "" if made_of == (inputs or made_of) else other
    first = f"{changed[0].parent.name}/{changed[0].name}"
    more = f" (and of {len(changed) - 1} more that changed)" if len(changed) > 1 else ""
    found = f"is of an older {first}{more}" if changed[0].exists() else f"is of {first}, which is missing now"
    return f"{name} {found}: run the {stage} stage again."


def require_current(
    artifact: str | Path, stage: str, endings: Sequence[str] = (), missing: bool = True, inputs: str | None = None
) -> None:
    """Refuse an artifact whose sources have changed since it was made, see `why_older`: raise ArtifactError."""
    if why := why_older(artifact, stage, endings, missing, inputs):
        raise ArtifactError(f"{Path(artifact).parent}: {why}")


def older_files(folder: str | Path, stage: str) -> dict[str, str]:
    """Return the sentence of `why_older`, by path, for all files below a stage's folder that are older."""
    older: dict[str, str] = {}
    for record in sorted(Path(folder).rglob("*.meta.json")):
        artifact = record.with_name(record.name.removesuffix(".meta.json"))
        if stage in ("localize", "sequence") and of_sequence(artifact.name) != (stage == "sequence"):
            continue  # the two write to one folder
        if why := why_older(artifact, stage, missing=stage not in ("retrieve", "rerank", "localize")):
            files = _read_record(artifact).get("files", {})
            older |= {artifact.with_name(file).relative_to(folder).as_posix(): why for file in (artifact.name, *files)}
    return older


_TIMES = {"seconds", "first_seconds"}
"""Columns that differ between two equal tables of queries."""


def _content(path: str | Path) -> str | None:
    """Return a hash of a file, which is quick for an artifact with a record; None if it is missing. The time that
    queries took does not count. The folder `raw_data` of a session stands for its images.
    """
    try:
        if Path(path).name == RAW_DATA:
            return _images_of(Path(path).parent)
        if Path(path).suffix == ".csv":
            with open(path, newline="", encoding="utf-8") as stream:
                rows = csv.reader(stream)
                columns = [number for number, name in enumerate(next(rows, [])) if name not in _TIMES]
                return fingerprint([[row[number] for number in columns if number < len(row)] for row in rows])
        size, recorded = _read_record(path).get("files", {}).get(Path(path).name, (None, None))
        return recorded if recorded and Path(path).stat().st_size == size else checksum(path)
    except (OSError, TypeError, ValueError, AttributeError, csv.Error):
        return None


_LISTED: dict[Path, tuple[float, str]] = {}
"""By session: the time until which its images count as unchanged, and their hash."""


def _images_of(session: Path) -> str | None:
    """Return a hash of the names, sizes and times of a session's images and masks; None if all images are missing.

    Looking at 200,000 files takes 2 s, and the record of each pair asks: an answer that took long is used for a while.
    """
    started = time.monotonic()
    until, found = _LISTED.get(session, (0.0, ""))
    if started < until:
        return found
    lines = (session / "images.txt").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    names = [line.split(",", 2)[-1].strip() for line in lines if line.strip() and line[0] != "#"]
    images = [session / RAW_DATA / name for name in names]
    if not any(map(Path.exists, images)):
        return None
    masks = [session / MASKS / f"{name}.png" for name in names] if (session / MASKS).is_dir() else []
    found, now = files_fingerprint(images + masks), time.monotonic()
    _LISTED[session] = now + (20 * (now - started) if now - started > 0.1 else 0.0), found
    return found


def _read_record(path: str | Path) -> dict[str, Any]:
    try:
        record = json.loads(sidecar_path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        log.warning("%s cannot be read (%s): %s is not reused.", sidecar_path(path), error, path)
        return {}
    return record if isinstance(record, dict) else {}


def _damage(path: str | Path, record: dict[str, Any], only: str | None = None) -> str:
    """Return what is wrong with the files and the record of an artifact, or only with the file named `only`."""
    try:
        for name, (size, expected) in record.get("files", {}).items():
            file = Path(path).with_name(name)
            if only not in (None, name):
                continue
            if not file.is_file():
                return f"{file} is missing"
            if (found := file.stat().st_size) != size:
                return f"{file} is damaged ({found} bytes; {size} were written)"
            if expected is not None and checksum(file) != expected:
                return f"{file} is damaged (its content is not what was written)"
        parts = {"fingerprint": record.get("settings"), "sources": record.get("made_from")}
        whole = only or all(record.get(name) == fingerprint(part) for name, part in parts.items())
    except OSError as error:
        return f"{error.filename or path} cannot be read ({error.strerror})"
    except (ValueError, TypeError, AttributeError):
        whole = False
    older = "fingerprint" in record and not record.keys() & {"sources", "made_from"}
    return "" if whole else f"{sidecar_path(path)} is {'of an older version of the toolkit' if older else 'damaged'}"


def _jsonable(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item"):  # a numpy scalar
        return value.item()
    raise TypeError(f"Settings must be JSON values: {value!r} is a {type(value).__name__}.")


_PACKAGE = Path(__file__).resolve().parent


def shipped(folder: str) -> Path:
    """Return `notebooks` or `data_manifests`, beside the package in a clone, and inside of an installed one."""
    inside = _PACKAGE / folder
    return inside if inside.is_dir() else _PACKAGE.parent / folder


def project_root() -> Path:
    """Return the folder with `data/` and `runs/`: the nearest from here up with manifests; else the clone, or here."""
    here = Path.cwd()
    otherwise = here if (_PACKAGE / "notebooks").is_dir() else _PACKAGE.parent
    return next((folder for folder in (here, *here.parents) if (folder / "data_manifests").is_dir()), otherwise)


RUN_FILES = (
    "notebooks", "report.html", "report.html.meta.json", "run.json", "run.log", "submission.csv", "submission.zip"
)  # fmt: skip
"""Files and folders of a run beside its scenes; no scene can have one of these names."""


@dataclass
class SceneFiles:
    """Paths of the files of one scene in a run folder."""

    run: Path  # `<output_root>/<manifest name>`
    scene: str  # name of the capture folder

    def __post_init__(self) -> None:
        self.root = Path(self.run) / self.scene
        self.embeddings = self.root / "embeddings"
        self.features = self.root / "features"
        self.maps = self.root / "map"
        self.index = self.root / "index"
        self.retrieval_dir = self.root / "retrieval"
        self.reranked_dir = self.root / "reranked"
        self.poses_dir = self.root / "poses"
        self.evaluation = self.root / "evaluation"
        self.visualization = self.root / "visualization"

    def of_stage(self, stage: str) -> Path | None:
        """Return the folder of a stage's results; None if the stage writes only its executed notebook."""
        of = {"embed": self.embeddings, "retrieve": self.retrieval_dir, "rerank": self.reranked_dir}
        of |= {"localize": self.poses_dir, "sequence": self.poses_dir}
        of |= {"evaluate": self.evaluation, "visualize": self.visualization}
        return of.get(stage)

    @property
    def caches(self) -> tuple[Path, ...]:
        """Folders in which every stage finds what fits its settings, whatever run has made it."""
        return self.features, self.maps, self.index

    def folders(self, stage: str, reranked: bool = False) -> dict[str, Path]:
        """Return the folders through which stages exchange results, by the names of the notebooks' parameters."""
        out = self.of_stage(stage)
        return {
            "map_feats_root": self.embeddings,
            "out_jsonl": self.retrieval_dir,
            "retrieval_dir": self.reranked_dir if reranked and stage == "localize" else self.retrieval_dir,
            **({"reranked_dir": self.reranked_dir} if reranked else {}),
            "features_dir": self.features,
            "map_dir": self.maps,
            "poses_dir": self.poses_dir,
            **({"out_dir": out} if out else {}),
        }

    def retrieval(self, map_device: str, query_device: str) -> Path:
        return self.retrieval_dir / f"{pair_name(self.scene, map_device, query_device)}.jsonl"

    def poses_txt(self, map_device: str, query_device: str) -> Path:
        return self.poses_dir / f"{pair_name(self.scene, map_device, query_device)}.txt"

    def poses_csv(self, map_device: str, query_device: str) -> Path:
        return self.poses_dir / f"{pair_name(self.scene, map_device, query_device)}.csv"

    def sequence_txt(self, map_device: str, query_device: str) -> Path:
        return self.poses_dir / f"{pair_name(self.scene, map_device, query_device)}_sequence.txt"


RAW_DATA = "raw_data"
"""Folder of the images of a session."""
MASKS = "masks"
"""Folder of the masks of a session, or beside a folder of images."""
IMPORTED = "import/images/"
"""Folder of imported images, relative to a session's `raw_data`."""


def image_name(path: str) -> str:
    """Return the name of an image, `<session>/raw_data/<path>`, from `<scene>/sessions/<name>` in outputs."""
    return path.split("/sessions/", 1)[-1]


def own_name(name: str) -> str:
    """Return the user's name of an image, its path in the folder it was imported from; unchanged for others. `name` is
    relative to `raw_data`, or an `image_name`.
    """
    return re.sub(f"^([^/]+/raw_data/)?{IMPORTED}", "", name)


def pair_name(scene: str, map_device: str, query_device: str) -> str:
    """Return the file stem of a pair of map and query devices, as in the challenge."""
    return f"{scene}_map_{map_device}_query_{query_device}"


def pair_devices(stem: str) -> tuple[str, str]:
    """Return map and query device of a file by its `stem`, `pair_name` or that and `_sequence`; else two empty ones."""
    devices = re.fullmatch(r".*_map_(.+?)_query_(.+?)(?:_sequence)?", stem)
    return (devices[1], devices[2]) if devices else ("", "")


def of_sequence(name: str) -> bool:
    """Tell by its name whether a file is from the sequence stage, which writes beside the poses of single queries."""
    return "_query_" in name and "_sequence" in name.rpartition("_query_")[2]


def map_record_path(poses_dir: str | Path, scene: str, map_device: str) -> Path:
    """Return the path of the localize stage's record of a map."""
    return Path(poses_dir) / f"{scene}_map_{map_device}.json"


def read_json(path: str | Path) -> dict[str, Any]:
    """Return the JSON object in a file; an empty one if the file is missing or contains something else."""
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def read_map_record(path: str | Path) -> dict[str, Any]:
    """Return the localize stage's record of a map; by default, the unit of its poses is meters."""
    unknown: dict[str, Any] = {"unit": "m", "depth": None, "length": None}
    unknown |= {"verdict": "unknown", "text": "", "wrong": [], "camera": ""}
    return unknown | read_json(path)


def read_references(path: str | Path, *needed: str) -> list[dict[str, Any]]:
    """Return the rows of a file of references, one per query image.

    A row has at least `timestamp` (an integer), `sensor_id`, and `topk`, a list of map images, each with a `path`, and
    the `needed` keys. Raise ArtifactError if the file is missing or damaged, or a line is not such a row.
    """
    rows, number = list[dict[str, Any]](), 0
    try:
        with open(path, encoding="utf-8") as lines:
            for line in lines:
                number += 1
                if line.strip():
                    rows.append(_checked(json.loads(line), {"timestamp", "sensor_id", "topk", *needed}))
    except FileNotFoundError:
        do = f"Run the retrieve stage first ({COMMAND} run MANIFEST --only retrieve)."
        raise ArtifactError.at(path, "no such file of references", do=do) from None
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ArtifactError(f"{path}, line {number}: not a retrieval row ({error}). Retrieve again.") from None
    require_whole(path)
    return rows


def _checked(row: Any, keys: set[str]) -> dict[str, Any]:
    if not isinstance(row, dict) or not keys <= row.keys():
        raise ValueError(f"found {str(row)[:80]}; expected the keys {', '.join(sorted(keys))} and others")
    if not isinstance(row["topk"], list):
        raise TypeError("expected a list of references as topk")
    if not all(isinstance(reference, dict) and "path" in reference for reference in row["topk"]):
        raise ValueError("a reference in topk has no path")
    int(row["timestamp"])
    return row


class Remade:
    """Base of objects that are pickled as their constructor arguments and made again where they are unpickled.

    A process keeps the last object of each class. If `settings` is a dict, the new object must have the same ones:
    `auto` may select another precision on another machine.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        made = super().__new__(cls)
        made.__dict__["_made_with"] = args, kwargs
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        settings = getattr(self, "settings", None)
        expected = settings if isinstance(settings, dict) else None
        return _remade, (type(self), pickle.dumps(self.__dict__["_made_with"]), expected)

    @classmethod
    def elsewhere(cls, *args: Any, **kwargs: Any) -> Any:
        """Return an object to pickle with these arguments, without running its constructor here."""
        return cls.__new__(cls, *args, **kwargs)


_last_remade: dict[type, tuple[bytes, Any]] = {}


def _remade(kind: type, made_with: bytes, expected: dict[str, Any] | None = None) -> Any:
    if _last_remade.get(kind, (b"", None))[0] != made_with:
        _last_remade.pop(kind, None)  # free the old one first, because both may not fit in memory
        args, kwargs = pickle.loads(made_with)
        _last_remade[kind] = made_with, kind(*args, **kwargs)
    made = _last_remade[kind][1]
    if expected is not None:
        require_same(expected, made.settings)
    return made


def require_same(expected: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    """Refuse, by a ToolkitError, to compute with settings that differ from those in the record of the results."""
    differing = [name for name in {**expected, **here} if expected.get(name) != here.get(name)]
    if found := "; ".join(f"{name}: {here.get(name)} here, {expected.get(name)} there" for name in differing):
        do = "Set them in the manifest, or use machines of one kind."
        raise ToolkitError.at(f"worker on {platform.node()}", found, "the settings of the main process", do)
