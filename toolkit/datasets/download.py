"""Download the captures of a manifest: list, fetch, unpack, arrange in the capture format, check.

`<capture>/.download/` keeps the state, so the same command resumes after a failure or a kill:

    unfinished-*     one for each session whose download has started and not finished
    done.jsonl       files that were fetched, verified and unpacked, one JSON object per line
    partial/         files being fetched and archives to be unpacked, named by a fingerprint of path and version
    unpacked/        an archive being unpacked

`hf_hub_download` of huggingface_hub 2.4 fetches to a random name that no later process finds; `http_get` appends.
"""

import fnmatch
import hashlib
import json
import os
import re
import shutil
import stat
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any
from urllib.parse import unquote, urlsplit

from pydantic import ByteSize
from tqdm.auto import tqdm

from toolkit.capture import Session
from toolkit.capture.check import CheckReport, check_capture
from toolkit.capture.tables import COLUMNS
from toolkit.errors import CaptureError, DownloadError, ManifestError, first_line
from toolkit.files import fingerprint, try_lock, write_text
from toolkit.manifest import DatasetSettings, Source, load_manifest, nearest, require_known
from toolkit.models.weights import failure_reason

STATE = ".download"
WHOLE = {"Accept-Encoding": "identity"}  # for each request: a compressed response could not be resumed in the middle
MAX_ATTEMPTS = 6  # in a row that bring no data, besides those of http_get
MAX_RANGE_BYTES = 32 << 30  # per request: the hub's content network does not answer requests for 50 GB
_WORKERS = 8  # threads for small files, which mostly wait for the network; archives are fetched one by one
# For each file of a session, the column whose values are `<subsession>/<sensor>` or `<subsession>`.
_KEY_COLUMNS = {file: int(columns[0][0] == "timestamp") for file, columns in COLUMNS.items()}
_KEY_COLUMNS |= {"pointclouds.txt": 1, "queries.txt": 1}


class FileError(DownloadError):
    """One file failed; the download of other files can continue."""


def unpack(archive: Path, target: Path, target_path: Callable[[str], str | None], name: str) -> None:
    """Unpack a zip archive into a new folder: regular files only, nothing outside of it, no more than the disk holds.

    `target_path` maps a member's path to its path below `target`, or to None to skip it; `name` is for messages. Raise
    DownloadError for other members, no requested session, a disk too small, and a damaged archive, which is deleted.
    """
    try:
        with zipfile.ZipFile(archive) as zipped:
            members: dict[str, zipfile.ZipInfo] = {}
            for info in zipped.infolist():
                path = target_path(safe_path(info.filename, name))  # one unsafe path makes the whole archive suspect
                if path is None or info.is_dir():
                    continue
                if path in members or stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
                    raise FileError(f"{name}: contains {info.filename!r}, which is there twice, a link, or no file.")
                members[path] = info
            if not members:
                listed = sorted({"/".join(path.split("/")[:3]) for path in zipped.namelist()})
                raise FileError(f"{name}: contains no requested session. It has: {', '.join(listed[:20])}.")
            require_space(archive.parent, sum(info.file_size for info in members.values()))
            for path, info in tqdm(members.items(), desc=f"unpack {name.rpartition('/')[2]}", unit="file"):
                info.filename = path
                zipped.extract(info, target)  # stops at the size stated in the archive and verifies the checksum
    # Damaged; encrypted, or compressed by an unknown method (both RuntimeError); a file and a folder of one name.
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, FileExistsError, NotADirectoryError) as error:
        archive.unlink()
        raise FileError(f"{name}: cannot be unpacked: {first_line(error)}. Run the command again.") from error


def safe_path(name: str, where: str) -> str:
    """Return an untrusted relative path with `/` only. Raise FileError if it leaves its folder on any system."""
    path = PureWindowsPath(name)  # knows both separators, and drives
    if path.anchor or ".." in path.parts or not path.parts or "\0" in name:
        raise FileError(f"{where}: contains {name!r}, a path outside the target folder. Nothing of it was used.")
    return path.as_posix()


def require_space(folder: Path, needed_bytes: int) -> None:
    """Raise DownloadError if `needed_bytes` do not fit on the disk of `folder`."""
    free, needed = shutil.disk_usage(folder).free, int(needed_bytes * 1.02)  # folders take some space themselves
    if needed > free:
        do = "Free some, set CAPTURES to a folder on another disk, or fetch fewer sessions (--sessions)."
        raise DownloadError(f"{folder}: about {size_text(needed)} are needed and {size_text(free)} are free. {do}")


def size_text(count_bytes: int) -> str:
    return ByteSize(count_bytes).human_readable(decimal=True, separator=" ")


def arrange(sessions: Path, names: Mapping[str, str]) -> list[str]:
    """Rename the sessions of a data set; split by device, in place, a session that several new names refer to.

    `names` maps `<device>_<map or query>` to a name in the data set. In LaMAR (Sarlin, Dusmanu et al., ECCV 2022) the
    session `map` has subsessions `<device>_*` of several devices, and `queries.txt` lists the queries. Return notes on
    what was left out. Raise CaptureError if a device has no subsession, or for an invalid subsession name.
    """
    notes = []
    for old in [sessions / name for name in dict.fromkeys(names.values())]:
        new = [sessions / name for name, source in names.items() if source == old.name]
        if not old.is_dir() or new == [old]:
            continue
        if len(new) > 1:
            notes += _split(old, new)
        else:
            old.rename(new[0])
        for session in [session for session in new if (session / "queries.txt").is_file()]:
            (session / "proc").mkdir(exist_ok=True)
            shutil.copyfile(session / "queries.txt", session / "proc" / "keyframes_original.txt")
    return notes


def _split(old: Path, new: list[Path]) -> list[str]:
    subsessions = Session.open(old).subsessions
    unclaimed = set(subsessions)
    for session in new:
        prefix = session.name.rpartition("_")[0] + "_"
        unclaimed -= (own := {name for name in subsessions if name.startswith(prefix)})
        if not own:
            found = ", ".join(sorted(subsessions)[:3]) or "none"
            raise CaptureError.at(old.name, found, f"subsessions named {prefix}...")
        for file, column in _KEY_COLUMNS.items():
            if (old / file).is_file():
                is_own = re.compile(rf"#|([^,]*,){{{column}}}\s*{prefix}").match
                with open(old / file, encoding="utf-8") as rows:
                    write_text(session / file, "".join(filter(is_own, rows)))
        (session / "raw_data").mkdir(parents=True, exist_ok=True)
        for folder in (old / "raw_data").glob(f"{prefix}*"):
            folder.rename(session / "raw_data" / folder.name)
    others = {path.relative_to(old).as_posix() for path in old.rglob("*") if path.is_file()} - _KEY_COLUMNS.keys()
    shutil.rmtree(old)
    left_out = {"subsessions of other devices": unclaimed, "files that cannot be split by device": others}
    return [f"{old.name}: {len(items)} {what}, such as {min(items)}" for what, items in left_out.items() if items]


def download(
    manifest_path: str | Path, sessions: Sequence[str] = (), dry_run: bool = False, overrides: Iterable[str] = ()
) -> list[CheckReport]:
    """Download the captures of a manifest, or only some sessions, into their folders; return their check reports.

    Files already there are not fetched again; on a dry run none is, only listed. `overrides` are `key=value` or
    `section.key=value`, in place of the manifest's values. Raise ManifestError if the manifest does not say where its
    captures are, or has no such session; DownloadError or OSError if something cannot be fetched, unpacked or stored.
    """
    manifest = load_manifest(manifest_path, overrides)
    if (dataset := manifest.dataset) is None:
        raise ManifestError(f"{manifest_path}: has no section `dataset`. See data_manifests/crocodl-hydro.yaml.")
    for name in sessions:
        require_known("--sessions", name, dataset.session_names)
    names = {name: source for name, source in dataset.session_names.items() if not sessions or name in sessions}
    captures = []
    for folder in map(Path, manifest.captures):
        if source := dataset.sources.get(folder.name):
            captures.append(_Capture(folder, dataset, source, names))
        else:
            print(f"{folder.name}: nothing is fetched. dataset.sources: {nearest(folder.name, dataset.sources)}")
    if not captures:
        raise ManifestError(f"{manifest_path}: dataset.sources has no entry for any folder in `captures`.")
    needed_bytes = Counter[Path]()
    for capture in captures:
        capture.list_files(dry_run)
        disk = next(parent for parent in capture.folder.parents if parent.exists())  # of all captures in this folder
        needed_bytes[disk] += sum(capture.needed_bytes())
        require_space(disk, needed_bytes[disk])
    reports, failures = [], []
    for capture in captures if not dry_run else ():
        try:
            reports.append(capture.run())
        except DownloadError as error:  # the other captures continue
            failures.append(str(error))
    if failures:
        raise DownloadError("\n".join(failures))
    return reports


def is_unfinished(capture: Path) -> bool:
    """Return whether a download into this capture's folder has started and not finished."""
    return any((capture / STATE).glob("unfinished-*"))


@dataclass(frozen=True)
class RemoteFile:
    """A file to fetch."""

    path: str  # target path relative to the capture's folder, with `/`. An archive is unpacked into its parent folder.
    url: str
    size: int
    version: str  # the checksum of the file, `sha256:...` or `git:...`, else `etag:...` of the server

    @property
    def is_archive(self) -> bool:
        return self.path.lower().endswith(".zip")

    def matches(self, local: Path) -> bool:
        """Return whether a local file has the size of this file, and its checksum if that is known."""
        if _size(local) != self.size:
            return False
        kind, _, expected = self.version.partition(":")
        # git: SHA-1 of a header and the content, https://git-scm.com/book/en/v2/Git-Internals-Git-Objects
        digests = {"sha256": hashlib.sha256, "git": lambda: hashlib.sha1(b"blob %d\0" % self.size)}
        with open(local, "rb") as stream:
            return kind not in digests or hashlib.file_digest(stream, digests[kind]).hexdigest() == expected

    def fetch(self, partial: Path, headers: Mapping[str, str], bar: Any) -> None:
        """Append the missing bytes to `partial`, which stays if an error is raised, and advance a tqdm bar."""
        from huggingface_hub.file_download import http_get

        if _size(partial) > self.size:
            partial.unlink()
        partial.touch()
        failures = 0
        while (have := _size(partial)) < self.size:
            end = min(have + MAX_RANGE_BYTES, self.size)
            asked = {**headers, **WHOLE, "Range": f"bytes=0-{end - 1}"}  # http_get adds `have`
            try:
                with open(partial, "ab") as out:
                    http_get(self.url, out, resume_size=have, headers=asked, expected_size=end, _tqdm_bar=bar)
            except Exception as error:  # the type for a connection that broke depends on the HTTP client's version
                failures = 1 if _size(partial) > have else failures + 1
                if failures == MAX_ATTEMPTS or _status(error) < 500:
                    raise
                time.sleep(2**failures)


def _status(error: Exception) -> int:
    """Return the HTTP status of an error of huggingface_hub; 0 for one of the disk, 999 for one of the connection."""
    unanswered = 0 if getattr(error, "errno", None) else 999
    return getattr(getattr(error, "response", None), "status_code", unanswered)


@dataclass
class _Capture:
    """The download of one capture."""

    folder: Path
    dataset: DatasetSettings
    source: Source
    names: dict[str, str]  # for each requested session, its name in the source

    def __post_init__(self) -> None:
        self.state, hub = self.folder / STATE, self.source.hub
        self.origin = f"dataset {hub} ({self.source.revision})" if hub else ", ".join(self.source.urls)
        self.page = f"https://huggingface.co/datasets/{hub}" if hub else self.dataset.page
        self.files = self.missing = list[RemoteFile]()
        self.bar: Any = None
        # Path, version and, for an archive, a session: it may be unpacked for one now and for another later.
        self.done = set[tuple[str, str, str]]()
        if (record := self.state / "done.jsonl").is_file():
            for line in record.read_text(encoding="utf-8").splitlines():
                with suppress(ValueError):  # a kill cut this line off: its file counts as not done
                    row = json.loads(line)
                    self.done |= {(row["path"], row["version"], name) for name in row.get("sessions") or [""]}

    def list_files(self, in_full: bool) -> None:
        """List the files of the requested sessions; print their origin and license, and with `in_full` each file."""
        try:
            listed = list(self._list_hub(self.source.hub) if self.source.hub else self._list_urls())
        except Exception as error:  # the library's own, or its HTTP client's, which depends on its version
            raise self._failure(f"{self.origin} cannot be listed", error) from error
        self.files = [file for file in listed if self._wants(safe_path(file.path, self.origin)) or self.source.urls]
        self.missing = [file for file in self.files if not self._is_done(file)]
        if not self.files:
            folders = sorted({"/".join(file.path.split("/")[:2]) for file in listed})
            found, asked = ", ".join(folders[:20]) or "nothing", ", ".join(self.names.values())
            raise DownloadError(f"{self.folder.name}: {self.origin} has no file for {asked}. It has {found}.")
        data, size = self.dataset, f"{len(self.files)} files, {size_text(sum(file.size for file in self.files))}"
        print(f"{self.folder.name}: {self.origin}\n  to       {self.folder}\n  size     {size}")
        print(f"  license  {data.license}\n  cite     {data.citation or '-'}\n  about    {data.page}")
        for file in self.files if in_full else ():
            print(f"    {size_text(file.size):>9}  {file.path}")

    def _list_hub(self, repo: str) -> Iterator[RemoteFile]:
        from huggingface_hub import HfApi, hf_hub_url
        from huggingface_hub.hf_api import RepoFile

        commit = HfApi().dataset_info(repo, revision=self.source.revision).sha or self.source.revision
        self.origin += f", commit {commit[:7]}"
        for entry in HfApi().list_repo_tree(repo, recursive=True, revision=commit, repo_type="dataset"):
            if isinstance(entry, RepoFile):
                path = PurePosixPath(self.dataset.into, entry.path).as_posix()
                url = hf_hub_url(repo, entry.path, repo_type="dataset", revision=commit)
                version = f"sha256:{entry.lfs.sha256}" if entry.lfs else f"git:{entry.blob_id}"
                yield RemoteFile(path, url, entry.size, version)

    def _list_urls(self) -> Iterator[RemoteFile]:
        from huggingface_hub.utils import get_session, hf_raise_for_status

        for url in self.source.urls:
            name = PurePosixPath(unquote(urlsplit(url).path)).name
            response = get_session().head(url, headers=WHOLE, timeout=20)
            hf_raise_for_status(response)
            size = int(response.headers["Content-Length"])
            checksum, tag = self.source.sha256.get(name), response.headers.get("ETag", size)
            yield RemoteFile(name, url, size, f"sha256:{checksum}" if checksum else f"etag:{tag}")

    def _failure(self, what: str, error: Exception) -> DownloadError:
        """Return the error about a failed request to the hub or a URL; a FileError if the server has no such file."""
        kind = FileError if _status(error) in (404, 416) else DownloadError
        reason = failure_reason(error, ", ".join(self.source.urls))
        check = f"the network, HTTPS_PROXY, HF_ENDPOINT, HF_HUB_OFFLINE, `dataset.sources.{self.folder.name}` by"
        access = f"{self.dataset.page}, access to {self.page} (accept its license, `hf auth login`)"
        return kind(f"{what}: {reason}.\nCheck {check} {access}. Then run the same command: it resumes.")

    def _wants(self, path: str) -> bool:
        included = any(fnmatch.fnmatchcase(path, pattern) for pattern in self.dataset.include)
        return included or any(_is_of(path, session) for session in self.names.values())

    def _sessions_in(self, file: RemoteFile) -> list[str]:
        """Return the requested sessions that an archive may hold, by their names in the capture; "" for other files."""
        own = [name for name, name_in_source in self.names.items() if _is_of(file.path, name_in_source)]
        return own or [*self.names] if file.is_archive else [""]

    def _places(self, file: RemoteFile) -> tuple[Path, Path]:
        """Return where a file is fetched to, and where it is put, or for an archive, unpacked from."""
        partial = self.state / "partial" / fingerprint([file.path, file.version])
        return partial, partial if file.is_archive else self.folder / file.path

    def _is_done(self, file: RemoteFile) -> bool:
        """Return whether this version of a file, or what an archive was unpacked to, is in place already."""
        sessions, is_there = self._sessions_in(file), file.is_archive or _size(self.folder / file.path) == file.size
        recorded = {(file.path, file.version, name) for name in sessions} <= self.done
        return is_there and recorded and all((self.folder / "sessions" / name).is_dir() for name in sessions)

    def needed_bytes(self) -> tuple[int, int]:
        """Return how many bytes are to be fetched, and about how many an archive takes more: images hardly shrink."""
        missing = sum(max(0, file.size - max(0, *map(_size, self._places(file)))) for file in self.missing)
        return missing, max((file.size for file in self.missing if file.is_archive), default=0)

    def run(self) -> CheckReport:
        """Fetch, unpack and arrange all files of the capture; check it."""
        self.state.mkdir(parents=True, exist_ok=True)
        lock, acquired = try_lock(self.state / "lock")
        if not acquired:
            fault = f"{self.folder}: another download into this folder is running"
            raise DownloadError(f"{fault}. Wait for it; if there is none, delete {lock.lock_file}.")
        try:
            self._fetch_all()
        finally:
            lock.release()
        report = check_capture(self.folder)
        print("\n" + report.text(most=20))
        if missing := [name for name in self.names if name not in report.tables]:
            found = f"there is no session {', '.join(missing)} in it; found {', '.join(report.tables)}"
            raise DownloadError(f"{self.folder}: {self.origin} is here, but {found}. Correct `dataset.sessions`.")
        return report

    def _fetch_all(self) -> None:
        marks = [self.state / f"unfinished-{name}" for name in self.names]
        for mark in marks:
            mark.touch()
        self.bar = tqdm(total=self.needed_bytes()[0], desc=self.folder.name, unit="B", unit_scale=True)
        with self.bar, ThreadPoolExecutor(_WORKERS) as pool:
            errors = [*pool.map(self._obtain, [file for file in self.missing if not file.is_archive])]
            errors += map(self._obtain, [file for file in self.missing if file.is_archive])
        if failures := [str(error) for error in errors if error]:
            some = f"{len(failures)} of {len(self.files)} files failed; the others are there. Run the command again."
            raise DownloadError("\n  ".join([f"{self.folder.name}: {some}", *failures[:5]]))
        for mark in marks:
            mark.unlink()
        if not is_unfinished(self.folder):
            shutil.rmtree(self.state / "partial", ignore_errors=True)

    def _obtain(self, file: RemoteFile) -> FileError | None:
        """Put a file, or the content of an archive, into its place; return the error if only this file failed."""
        partial, target = self._places(file)
        try:
            if not file.matches(target):  # else it is from another tool, or of a process that was killed later
                self._fetch(file, partial, target)
            if file.is_archive:
                self._unpack(file, target)
        except FileError as error:
            return error
        row = {"path": file.path, "version": file.version, "sessions": self._sessions_in(file)}
        with open(self.state / "done.jsonl", "a", encoding="utf-8") as stream:  # one write, so threads need no lock
            stream.write("\n" + json.dumps(row))  # newline first: a kill may have cut off the previous line
        if file.is_archive:
            target.unlink()
        return None

    def _fetch(self, file: RemoteFile, partial: Path, target: Path) -> None:
        from huggingface_hub.utils import build_hf_headers

        for path in (partial, target):
            path.parent.mkdir(parents=True, exist_ok=True)
        try:
            file.fetch(partial, build_hf_headers() if self.source.hub else {}, self.bar)  # the token
        except Exception as error:  # of the disk, the library, or its HTTP client, which depends on its version
            if _status(error) == 0:
                raise
            if _status(error) == 416:  # the file is shorter than the listing says
                partial.unlink()
            what = f"{file.path}: cannot be fetched from {file.url} (you can also put it at {target} yourself)"
            raise self._failure(what, error) from error
        if not file.matches(partial):
            partial.unlink()
            do = f"It was deleted. Run the command again, or put a right file of {file.url} at {target}."
            raise FileError(f"{file.path}: wrong checksum, expected {file.version}. {do}")
        partial.replace(target)

    def _unpack(self, file: RemoteFile, archive: Path) -> None:
        """Unpack an archive to a temporary folder, and move the requested files into the capture."""
        unpacked, parent = self.state / "unpacked", PurePosixPath(file.path).parent
        shutil.rmtree(unpacked, ignore_errors=True)  # left by a kill

        def target_path(path: str) -> str | None:
            if parent == PurePosixPath():
                path = re.sub("^[^/]+/(?=sessions/)", "", path)  # without the capture's own folder
            path = (parent / path).as_posix()
            return path if self._wants(path) else None

        try:
            unpack(archive, unpacked, target_path, file.path)
            if isinstance(self.dataset.sessions, dict):
                for note in arrange(unpacked / "sessions", self.dataset.sessions):
                    print(f"{self.folder.name}: left out of {note}")
                for name in self.dataset.sessions.keys() - self.names.keys():  # split off but not requested
                    shutil.rmtree(unpacked / "sessions" / name, ignore_errors=True)
            shutil.copytree(unpacked, self.folder, copy_function=os.replace, dirs_exist_ok=True)
        finally:
            shutil.rmtree(unpacked, ignore_errors=True)


def _is_of(path: str, session: str) -> bool:
    """Return whether a file lies in the folder of a session, or is an archive in `sessions/` named after it."""
    return re.match(rf"sessions/{re.escape(session)}(/|([._-][^/]*)?\.(?i:zip)$)", path) is not None


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else -1
