"""Fetch the captures of a manifest: list, download, unpack, lay out as the capture format wants, check.

What is under way is kept in `<capture>/.download/`, so that the same command goes on after a failure or a kill:

    unfinished       the sessions that have been begun, one a line, while they are not complete
    done.jsonl       what has been fetched, unpacked and verified, one JSON object a line
    partial/         files that are being fetched; the name says which version of which file
    archives/        whole archives that wait to be unpacked
    unpacked/        an archive that is being unpacked
"""

import errno
import fnmatch
import hashlib
import json
import os
import re
import shutil
import stat
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from toolkit.errors import DownloadError, ManifestError
from toolkit.exchange.archives import FileError, first_line, require_space, safe_parts, size_text, top_folders, unpack
from toolkit.exchange.datasets import arrange
from toolkit.files import fingerprint, write_text
from toolkit.manifest import DatasetSettings, Source, load_manifest, nearest
from toolkit.models.hub import failure_reason, status_of

if TYPE_CHECKING:
    import requests

    from toolkit.capture.check import CheckReport

Say = Callable[..., None]

STATE = ".download"
_UNFINISHED = "unfinished"
_ARCHIVE = ".zip"
_WORKERS = 8  # of small files, whose time is mostly waiting; archives come one by one
_TIMEOUT_S = (20, 60)  # to connect, between two pieces
_WAITS_S = (1, 2, 4, 8, 16)  # between attempts that bring nothing; one that brings something starts anew
_LONGEST_WAIT_S = 330  # the hub counts requests over five minutes
_MOST_WAITS = 50
_PIECE = 1 << 18
_PART = 32 << 30  # asked for at once: networks in front of the hub answer no request for 50 GB


class _StoppedError(Exception):
    """Another file's failure, or the user, ends this download."""


@dataclass(frozen=True)
class RemoteFile:
    """A file to fetch."""

    path: str
    """Where it belongs, relative to the capture's folder, with `/`; an archive unpacks in the folder of its path."""
    url: str
    size: int | None
    """Bytes; None where the server does not say."""
    version: str
    """Tells one version of the file from another: its checksum, `sha256:...` or `git:...`, or else what the server
    has: `etag:...`, `size:...`."""

    @property
    def is_archive(self) -> bool:
        return self.path.lower().endswith(_ARCHIVE)

    @property
    def is_whole_capture(self) -> bool:
        """Whether an archive stands above `sessions/`."""
        return self.is_archive and "/" not in self.path


@dataclass
class Plan:
    """What there is to fetch for one capture."""

    folder: Path
    dataset: DatasetSettings
    source: Source
    names: dict[str, str]
    """The name in the source of each session that is wanted."""
    files: list[RemoteFile] = field(default_factory=list)
    left_out: list[RemoteFile] = field(default_factory=list)
    origin: str = ""
    headers: dict[str, str] = field(default_factory=dict)
    """To send along: the hub's token."""

    @property
    def state(self) -> Path:
        return self.folder / STATE

    @property
    def page(self) -> str:
        """Where terms are accepted."""
        return f"https://huggingface.co/datasets/{self.source.hub}" if self.source.hub else self.dataset.page

    def sessions_in(self, file: RemoteFile) -> list[str]:
        """Return the wanted sessions, by their names here, that an archive may hold."""
        own = _session_of(file.path, self.names.values())
        return sorted(name for name, there in self.names.items() if own in (None, there))

    def wants(self, path: str) -> bool:
        """Tell whether a file with this path in the capture is to be fetched, or to be taken from an archive."""
        return _session_of(path, self.names.values()) in self.names.values() or any(
            fnmatch.fnmatchcase(path, pattern) for pattern in self.dataset.include
        )


def download(
    manifest_path: str | Path,
    sessions: Sequence[str] = (),
    keep_archives: bool = False,
    dry_run: bool = False,
    overrides: Iterable[str] = (),
    say: Say = print,
) -> "list[CheckReport]":
    """Fetch the captures of a manifest into their folders, and check them. What is there already is not fetched again.

    Args:
        manifest_path: YAML file with `captures` and a section `dataset`, see `toolkit.manifest`.
        sessions: only these, of those of the manifest.
        keep_archives: keep archives in `<capture>/.download/archives` after they are unpacked.
        dry_run: list what would be fetched, and write nothing.
        overrides: `key=value` or `section.key=value`, replacing what the manifest says.
        say: takes the lines of the report; called like `print`.

    Returns:
        For each capture, what the check found; nothing on a dry run.

    Raises:
        ManifestError: the manifest does not say where its captures are, or has no such session.
        DownloadError: what is wrong, and what to do. The same command then goes on where it was.
    """
    manifest = load_manifest(manifest_path, overrides)
    dataset = manifest.dataset
    if dataset is None:
        raise ManifestError(
            f"{manifest_path}: has no section `dataset`, so where to download from is not known. "
            "data_manifests/crocodl-hydro.yaml is one that has."
        )
    for name in sessions:
        if name not in dataset.session_names:
            raise ManifestError(f"--sessions {name}: no such session. {nearest(name, dataset.session_names)}")
    names = {name: there for name, there in dataset.session_names.items() if not sessions or name in sessions}
    captures = {Path(capture).name: Path(capture) for capture in manifest.captures}
    if without := [name for name in captures if name not in dataset.sources]:
        if len(without) == len(captures):
            raise ManifestError(
                f"{manifest_path}: dataset.sources has no {without[0]!r}, which is the name of a folder in `captures`. "
                f"{nearest(without[0], dataset.sources)}"
            )
        say(f"{', '.join(without)}: not in dataset.sources, so nothing is fetched for it.")
    plans = [
        _plan(folder, dataset, dataset.sources[name], names)
        for name, folder in captures.items()
        if name in dataset.sources
    ]
    for plan in plans:
        _describe(plan, dry_run, say)
    _check_space(plans, keep_archives)
    if dry_run:
        return []
    reports, failures = [], []
    for plan in plans:
        try:
            _Fetch(plan, keep_archives, say).run()
            reports.append(_check(plan, say))
        except DownloadError as error:  # of one capture; the others can go on
            failures.append(str(error))
    if failures:
        raise DownloadError("\n".join(failures))
    return reports


def is_unfinished(capture: Path) -> bool:
    """Tell whether a download into this capture's folder has begun and not ended."""
    return (capture / STATE / _UNFINISHED).exists()


# What there is


def _plan(folder: Path, dataset: DatasetSettings, source: Source, names: dict[str, str]) -> Plan:
    plan = Plan(folder, dataset, source, names)
    found = _list_hub(plan) if source.hub else _list_urls(plan)
    for file in found:
        wanted = bool(source.urls) or plan.wants(file.path)
        (plan.files if wanted else plan.left_out).append(file)
    if not plan.files:
        there = Counter(_session_of(file.path, ()) or file.path.partition("/")[0] for file in plan.left_out)
        raise DownloadError(
            f"{folder.name}: {plan.origin} has no file for {', '.join(names.values())}. Found there: "
            f"{', '.join(sorted(there)[:20]) or 'nothing'}. Correct `dataset.sessions` or `dataset.into`."
        )
    return plan


def _list_hub(plan: Plan) -> list[RemoteFile]:
    import huggingface_hub
    from huggingface_hub.hf_api import RepoFile
    from huggingface_hub.utils import build_hf_headers

    repo, revision = plan.source.hub or "", plan.source.revision
    plan.origin = f"dataset {repo}"
    api = huggingface_hub.HfApi()
    files = []
    try:
        commit = api.dataset_info(repo, revision=revision).sha or revision
        for entry in api.list_repo_tree(repo, recursive=True, revision=commit, repo_type="dataset"):
            if isinstance(entry, RepoFile):
                path = "/".join(filter(None, [plan.dataset.into, *safe_parts(entry.path, plan.origin)]))
                url = huggingface_hub.hf_hub_url(repo, entry.path, repo_type="dataset", revision=commit)
                version = f"sha256:{entry.lfs.sha256}" if entry.lfs else f"git:{entry.blob_id}"
                files.append(RemoteFile(path, url, entry.size, version))
    except DownloadError:
        raise
    except Exception as error:  # of the library, and of its HTTP client, which differs with its version
        refused = status_of(error) in (401, 403, 404)
        raise DownloadError(
            f"{plan.folder.name}: {plan.origin} (revision {revision}) cannot be listed: "
            f"{failure_reason(error, plan.page)}.\n{_access(plan) if refused else _NETWORK}"
        ) from error
    plan.origin += f" ({revision}, commit {commit[:7]})"
    plan.headers = build_hf_headers()
    return files


def _list_urls(plan: Plan) -> list[RemoteFile]:
    import requests

    plan.origin = ", ".join(plan.source.urls)
    files = []
    for url in plan.source.urls:
        name = safe_parts(unquote(PurePosixPath(urlsplit(url).path).name), url)[-1]
        if not name.lower().endswith(_ARCHIVE):
            raise ManifestError(f"dataset.sources.{plan.folder.name}.urls: {url} does not name a {_ARCHIVE} archive.")
        try:
            response = requests.head(url, allow_redirects=True, timeout=_TIMEOUT_S, headers=_PLAIN)
        except requests.RequestException as error:
            raise DownloadError(f"{plan.folder.name}: {url}: no answer, {first_line(error)}.\n{_NETWORK}") from error
        if response.status_code in (405, 501):  # will only be asked for the whole file
            response.headers.clear()
        elif not response.ok:
            raise DownloadError(f"{plan.folder.name}: {url}: HTTP {response.status_code}. {_access(plan)}")
        size = _full_size(response)
        tag = response.headers.get("ETag") or response.headers.get("Last-Modified")
        version = f"etag:{tag}" if tag else f"size:{size}"
        if checksum := plan.source.sha256.get(name):
            version = f"sha256:{checksum}"
        files.append(RemoteFile(name, url, size, version))
    return files


_PLAIN = {"Accept-Encoding": "identity"}  # what is packed on the way cannot be taken up in the middle
_NETWORK = (
    "Check the network, and HTTPS_PROXY, HF_ENDPOINT and HF_HUB_OFFLINE where they are set, then run the same command: "
    "it goes on where it was."
)


def _access(plan: Plan) -> str:
    """Return what to do where the server does not let one in."""
    if plan.source.hub:
        return (
            f"Look at {plan.page} in a browser: accept the terms if it has some, make a token (Settings, Access "
            "Tokens), and set HF_TOKEN to it or log in with `hf auth login`. If there is no such page, look for the "
            f"data set's present name at {plan.dataset.page} and set `dataset.sources.{plan.folder.name}.hub`."
        )
    return (
        f"See {plan.dataset.page} for how to get access and for the present addresses; set them as "
        f"`dataset.sources.{plan.folder.name}.urls`."
    )


def _session_of(path: str, known: Iterable[str]) -> str | None:
    """Return the session in whose folder a file lies, or whose name an archive in `sessions/` begins with."""
    parts = path.split("/")
    if parts[0] != "sessions" or len(parts) < 2:
        return None
    if len(parts) > 2:
        return parts[1]
    stem = parts[1][: -len(_ARCHIVE)] if parts[1].lower().endswith(_ARCHIVE) else ""
    return next((name for name in known if re.match(re.escape(name) + r"([._-]|$)", stem)), stem or None)


def _describe(plan: Plan, in_full: bool, say: Say) -> None:
    say(f"{plan.folder.name}: {plan.origin}\n  to        {plan.folder}\n  license   {plan.dataset.license}")
    if plan.dataset.citation:
        say(f"  cite      {plan.dataset.citation}")
    say(f"  about     {plan.dataset.page}")
    counts: dict[str, list[RemoteFile]] = {}
    for file in plan.files:
        counts.setdefault(_session_of(file.path, plan.names.values()) or "archives", []).append(file)
    for name, files in [*sorted(counts.items()), ("left out", plan.left_out)]:
        if files:
            say(f"  {name:<11} {len(files):>7} files  {_total(files):>9}")
    if in_full:
        for file in plan.files:
            say(f"    {size_text(file.size):>9}  {file.path}")


def _check_space(plans: list[Plan], keep_archives: bool) -> None:
    """Refuse, before anything is fetched, what the disk cannot hold: archives are there packed and unpacked."""
    needed: Counter[int] = Counter()
    places: dict[int, Path] = {}
    for plan in plans:
        place = next(parent for parent in (plan.folder, *plan.folder.parents) if parent.exists())
        device = place.stat().st_dev
        places.setdefault(device, place)
        fetch = _Fetch(plan, keep_archives, print)
        missing = [file for file in plan.files if not fetch.is_done(file)]
        packed = [file.size or 0 for file in missing if file.is_archive]
        # Photographs hardly shrink in an archive; what one really takes is looked at before it is unpacked.
        unpacked = sum(packed) if keep_archives else max(packed, default=0)
        fetched = sum(fetch.fetched(file) for file in missing)
        needed[device] += sum(file.size or 0 for file in missing) + unpacked - fetched
    for device, count in needed.items():
        require_space(places[device], count, "fetch fewer sessions at once (--sessions)")


# Fetching


class _Fetch:
    """The download of one capture."""

    def __init__(self, plan: Plan, keep_archives: bool, say: Say) -> None:
        self.plan, self.keep_archives, self.say = plan, keep_archives, say
        self.state = plan.state
        self.done = self._read_done()
        self.lock = threading.Lock()
        self.stop = threading.Event()
        self.bar: Any = None
        self.local = threading.local()

    def run(self) -> None:
        """Fetch, unpack and lay out everything."""
        from filelock import FileLock, Timeout
        from tqdm.auto import tqdm

        files = [file for file in self.plan.files if not self.is_done(file)]
        with _disk_errors(self.plan.folder):
            self.state.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.state / "lock")
            try:
                lock.acquire(timeout=0)
            except Timeout:
                raise DownloadError(
                    f"{self.plan.folder}: another download into this folder is running. Wait for it."
                ) from None
            try:
                self._begin()
                total = sum(file.size or 0 for file in self.plan.files)
                have = total - sum((file.size or 0) - self.fetched(file) for file in files)
                name = self.plan.folder.name
                with tqdm(total=total, initial=have, desc=name, unit="B", unit_scale=True) as self.bar:
                    failures = self._fetch_loose([file for file in files if not file.is_archive])
                    failures += self._fetch_archives([file for file in files if file.is_archive])
                if failures:
                    first = "\n  ".join(map(str, failures[:5])) + ("\n  ..." if len(failures) > 5 else "")
                    raise DownloadError(
                        f"{self.plan.folder.name}: {len(failures)} of {len(self.plan.files)} files failed; the others "
                        f"are there. The same command tries these again.\n  {first}"
                    )
                shutil.rmtree(self.state / "unpacked", ignore_errors=True)
                self._end()
                if not is_unfinished(self.plan.folder):
                    shutil.rmtree(self.state / "partial", ignore_errors=True)
            finally:
                lock.release()

    def _begin(self) -> None:
        begun = self._begun() | set(self.plan.names)
        write_text(self.state / _UNFINISHED, "\n".join(sorted(begun)))

    def _end(self) -> None:
        """Take away the mark of what was begun, unless an earlier download has begun other sessions as well."""
        if others := self._begun() - set(self.plan.names):
            write_text(self.state / _UNFINISHED, "\n".join(sorted(others)))
        else:
            (self.state / _UNFINISHED).unlink()

    def _begun(self) -> set[str]:
        mark = self.state / _UNFINISHED
        return set(mark.read_text(encoding="utf-8").split()) if mark.exists() else set()

    # What is there already

    def _read_done(self) -> dict[str, dict[str, Any]]:
        done: dict[str, dict[str, Any]] = {}
        try:
            lines = (self.state / "done.jsonl").read_text(encoding="utf-8").splitlines()
        except (FileNotFoundError, NotADirectoryError):
            return done
        for line in lines:
            try:
                row = json.loads(line)
            except ValueError:
                continue  # a kill tore the last line: what it said is looked at again
            done[row["path"]] = row
        return done

    def _mark(self, file: RemoteFile, **more: Any) -> None:
        row = {"path": file.path, "version": file.version, **more}
        with self.lock:
            self.done[file.path] = row
            with open(self.state / "done.jsonl", "a", encoding="utf-8") as stream:
                # The break comes first: a kill may have torn the line above.
                stream.write("\n" + json.dumps(row))

    def is_done(self, file: RemoteFile) -> bool:
        """Tell whether a file has been fetched before, and is still there, or what came out of it."""
        row = self.done.get(file.path, {})
        if row.get("version") != file.version:
            return False
        if file.is_archive:
            return set(self.plan.sessions_in(file)) <= set(row["sessions"]) and all(
                (self.plan.folder / name).is_dir() for name in row["folders"]
            )
        return _file_size(self.plan.folder / file.path) == file.size

    def fetched(self, file: RemoteFile) -> int:
        """Return how many bytes of a file that is not done are here."""
        return _file_size(self._archive(file)) or _file_size(self._partial(file)) or 0

    def _partial(self, file: RemoteFile) -> Path:
        # Another version has another name, so that no file is put together from two.
        return self.state / "partial" / fingerprint([file.path, file.version])

    def _archive(self, file: RemoteFile) -> Path:
        name = PurePosixPath(file.path).stem
        return self.state / "archives" / f"{name}-{fingerprint([file.path, file.version])}{_ARCHIVE}"

    # Loose files

    def _fetch_loose(self, files: list[RemoteFile]) -> list[FileError]:
        failures = []
        pool = ThreadPoolExecutor(_WORKERS)
        try:
            tasks = [pool.submit(self._fetch_one, file) for file in files]
            for task in as_completed(tasks):
                try:
                    task.result()
                except FileError as error:
                    failures.append(error)
        finally:
            self.stop.set()  # when one has failed for all; else none is left
            pool.shutdown(wait=True, cancel_futures=True)
        self.stop.clear()
        return failures

    def _fetch_one(self, file: RemoteFile) -> None:
        target = self.plan.folder / file.path
        if _file_size(target) == file.size and _matches(target, file):  # fetched by other means
            self._advance(file.size or 0)
        else:
            self._fetch(file, target)
        self._mark(file)

    # One file

    def _fetch(self, file: RemoteFile, target: Path) -> None:
        """Fetch a file, going on where an earlier attempt stopped; verify it, and move it into place."""
        partial = self._partial(file)
        partial.parent.mkdir(parents=True, exist_ok=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        partial.touch()
        if file.size is not None and partial.stat().st_size > file.size:
            os.truncate(partial, 0)
        resumed = partial.stat().st_size > 0
        empty_handed = waits = 0
        whole = file.size is not None and partial.stat().st_size == file.size
        while not whole:
            before = partial.stat().st_size
            try:
                whole = self._continue(file, partial)
                empty_handed = 0
            except _TryAgainError as again:
                empty_handed = 0 if partial.stat().st_size > before else empty_handed + 1
                waits += 1
                if empty_handed > len(_WAITS_S) or waits > _MOST_WAITS:
                    raise DownloadError(
                        f"{file.path}: {file.url}: {again}, {empty_handed} times in a row.\n{_NETWORK}"
                    ) from again
                if self.stop.wait(again.wait_s or _WAITS_S[max(empty_handed, 1) - 1]):
                    raise _StoppedError from None
        if not _matches(partial, file):
            partial.unlink()
            raise FileError(
                f"{file.path}: wrong checksum, expected {file.version}; what was fetched"
                f"{' in several attempts' if resumed else ''} has been deleted. Run the same command again; if this "
                f"comes back, the file is damaged where it is published ({file.url})."
            )
        partial.replace(target)

    def _advance(self, count: int) -> None:
        with self.lock:
            self.bar.update(count)

    @property
    def _session(self) -> "requests.Session":
        if not hasattr(self.local, "session"):
            import requests

            self.local.session = requests.Session()
            self.local.session.headers.update(self.plan.headers | _PLAIN)
            self.local.session.auth = lambda request: request  # else ~/.netrc would replace the hub's token
        session: requests.Session = self.local.session
        return session

    def _continue(self, file: RemoteFile, partial: Path) -> bool:
        """Fetch what is missing of a file, or a part of that; return whether it is whole."""
        import requests

        have = partial.stat().st_size
        headers = {}
        if have or (file.size or 0) > _PART:
            last = "" if (file.size or 0) - have <= _PART else have + _PART - 1
            headers["Range"] = f"bytes={have}-{last}"
        try:
            with self._session.get(file.url, headers=headers, stream=True, timeout=_TIMEOUT_S) as response:
                self._require(response, file, have)
                start = have if response.status_code == 206 else 0
                if start == 0 and have:  # a server that only sends whole files
                    self._advance(-have)
                size = file.size or _full_size(response)
                with open(partial, "ab" if start else "wb") as out:
                    for piece in response.iter_content(_PIECE):
                        if self.stop.is_set():
                            raise _StoppedError
                        out.write(piece)
                        self._advance(len(piece))
        except requests.RequestException as error:  # before OSError, of which it is one
            raise _TryAgainError(f"the connection broke ({first_line(error)})") from error
        return size is None or partial.stat().st_size == size

    def _require(self, response: "requests.Response", file: RemoteFile, have: int) -> None:
        """Raise unless the answer is the file, or the part of it that was asked for."""
        status = response.status_code
        if status in (401, 403):
            raise DownloadError(f"{file.path}: access is refused (HTTP {status}). {_access(self.plan)}")
        if status == 416:  # what is here is longer than the file
            os.truncate(self._partial(file), 0)
            raise _TryAgainError("the server does not have the part that is missing (HTTP 416)")
        if status == 429 or status == 408 or status >= 500:
            raise _TryAgainError(f"HTTP {status}", _asked_wait(response))
        if not response.ok:
            raise FileError(f"{file.path}: HTTP {status} from {file.url}. {_access(self.plan)}")
        size = _full_size(response)
        if None not in (size, file.size) and size != file.size:
            raise FileError(
                f"{file.path}: the server has {size} bytes, expected {file.size} ({file.url}). Run the same command "
                "again; if this comes back, the file is damaged where it is published."
            )
        begin = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
        if status == 206 and (begin is None or int(begin[1]) != have):
            os.truncate(self._partial(file), 0)
            raise _TryAgainError("the server sent another part than was asked for")

    # Archives

    def _fetch_archives(self, files: list[RemoteFile]) -> list[FileError]:
        failures = []
        for file in files:
            try:
                archive = self._archive(file)
                if not archive.exists():
                    self._fetch(file, archive)
                self._unpack(file, archive)
            except FileError as error:
                failures.append(error)
        return failures

    def _unpack(self, file: RemoteFile, archive: Path) -> None:
        """Unpack an archive aside, and move what is wanted of it into place; again from the start after a kill."""
        plan = self.plan
        aside = self.state / "unpacked" / archive.stem
        shutil.rmtree(aside, ignore_errors=True)
        above = [] if file.is_whole_capture else file.path.split("/")[:-1]

        def place(parts: list[str]) -> str | None:
            if file.is_whole_capture and "sessions" in parts[:2]:
                parts = parts[parts.index("sessions") :]  # a folder of the capture's name may stand above
            path = "/".join([*above, *parts])
            return path if plan.wants(path) else None

        try:
            try:
                count = unpack(archive, aside, place, file.path)
            except FileError:
                # With a checksum it is what was published, and fetching it again would bring the same.
                if not file.version.startswith(("sha256:", "git:")):
                    archive.unlink()
                raise
            if count == 0:
                raise FileError(
                    f"{file.path}: holds nothing of {', '.join(plan.names.values())}. It has: "
                    f"{', '.join(top_folders(archive))}. Correct `dataset.sessions`."
                )
            if isinstance(plan.dataset.sessions, dict):
                for note in arrange(aside / "sessions", plan.dataset.sessions):
                    self.say(f"{plan.folder.name}: left out of {note}")
                for name in set(plan.dataset.sessions) - set(plan.names):  # of a session that several share
                    shutil.rmtree(aside / "sessions" / name, ignore_errors=True)
            folders = _move_into(aside, plan.folder)
        finally:
            shutil.rmtree(aside, ignore_errors=True)
        self._mark(file, sessions=plan.sessions_in(file), folders=folders)
        if not self.keep_archives:
            archive.unlink()


class _TryAgainError(Exception):
    """An attempt failed in a way that another may not; `wait_s` is how long the server asks to wait."""

    def __init__(self, what: str, wait_s: float = 0) -> None:
        super().__init__(what)
        self.wait_s = wait_s


def _asked_wait(response: "requests.Response") -> float:
    """Return the seconds that a server asks to wait, in `Retry-After` or the hub's `RateLimit`; 0 if it does not."""
    after = re.fullmatch(r"\d+", response.headers.get("Retry-After", "").strip())
    limit = re.search(r"\bt=(\d+)", response.headers.get("RateLimit", ""))
    seconds = int(after[0]) if after else int(limit[1]) if limit else 0
    return min(seconds, _LONGEST_WAIT_S)


def _full_size(response: "requests.Response") -> int | None:
    """Return the size of the whole file that an answer is of, or is a part of; None where it is not said."""
    if "Content-Encoding" in response.headers:
        return None
    if response.status_code == 206:
        text = response.headers.get("Content-Range", "").rpartition("/")[2]
    else:
        text = response.headers.get("Content-Length", "")
    return int(text) if text.isdigit() else None


def _matches(path: Path, file: RemoteFile) -> bool:
    """Tell whether a whole file has the checksum that it should have; True where none is known."""
    kind, _, expected = file.version.partition(":")
    if kind not in ("sha256", "git"):
        return True
    # git: SHA-1 of a header and the content, https://git-scm.com/book/en/v2/Git-Internals-Git-Objects
    digest = hashlib.sha256() if kind == "sha256" else hashlib.sha1(f"blob {path.stat().st_size}\0".encode())
    with open(path, "rb") as stream:
        while piece := stream.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest() == expected


# Afterwards


def _move_into(aside: Path, folder: Path) -> list[str]:
    """Move all files below one folder to their places below another; return the folders, two levels deep."""
    folders = set()
    for root, _, files in os.walk(aside):
        place = Path(root).relative_to(aside)
        if files:
            folders.add("/".join(place.parts[:2]))
            (folder / place).mkdir(parents=True, exist_ok=True)
        for file in files:
            (Path(root) / file).replace(folder / place / file)
    return sorted(folders)


def _check(plan: Plan, say: Say) -> "CheckReport":
    from toolkit.capture.check import check_capture

    report = check_capture(plan.folder)
    say("\n" + report.text(most=20))
    if missing := [name for name in plan.names if name not in report.tables]:
        raise DownloadError(
            f"{plan.folder}: all of {plan.origin} that was asked for is here, but there is no session "
            f"{', '.join(missing)} in it; found {', '.join(report.tables)}. If the data are published without, take "
            "them out of `dataset.sessions`, or name the others with --sessions."
        )
    return report


@contextmanager
def _disk_errors(folder: Path) -> Iterator[None]:
    """Say what to do about a disk that is full, or that cannot be written."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            text = f"the disk is full ({size_text(shutil.disk_usage(folder).free)} free). Free some space"
        else:
            text = f"{first_line(error)}. See to it that you can write there, or choose another folder (`captures`)"
        raise DownloadError(
            f"{error.filename or folder}: {text}; then run the same command: it goes on where it was."
        ) from error


def _file_size(path: Path) -> int | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None


def _total(files: list[RemoteFile]) -> str:
    sizes = [file.size for file in files]
    return "?" if None in sizes else size_text(sum(size or 0 for size in sizes))


