"""Download the captures of a manifest: list, fetch, unpack, arrange in the capture format, check.

`<capture>/.download/` keeps the state, so the same command resumes after a failure or a kill:

    unfinished       sessions whose download has started and not finished, one per line
    done.jsonl       files that were fetched, verified and unpacked, one JSON object per line
    partial/         files being fetched, named by a fingerprint of path and version
    archives/        complete archives waiting to be unpacked
    unpacked/        an archive being unpacked
"""

import errno
import fnmatch
import json
import re
import shutil
import stat
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from toolkit.errors import DownloadError, ManifestError, first_line
from toolkit.exchange.archives import FileError, require_space, safe_parts, size_text, top_folders, unpack
from toolkit.exchange.datasets import arrange
from toolkit.exchange.transfer import NETWORK, RemoteFile, Transfer
from toolkit.files import fingerprint, write_text
from toolkit.manifest import DatasetSettings, Source, load_manifest, nearest
from toolkit.models.hub import failure_reason, status_of

if TYPE_CHECKING:
    from toolkit.capture.check import CheckReport

Say = Callable[..., None]

STATE = ".download"
_UNFINISHED = "unfinished"
_WORKERS = 8  # threads for small files, which mostly wait for the network; archives are fetched one by one


def download(
    manifest_path: str | Path,
    sessions: Sequence[str] = (),
    keep_archives: bool = False,
    dry_run: bool = False,
    overrides: Iterable[str] = (),
    say: Say = print,
) -> "list[CheckReport]":
    """Download the captures of a manifest into their folders and check them. Files already there are not fetched again.

    Args:
        manifest_path: YAML file with `captures` and a section `dataset`, see `toolkit.manifest`.
        sessions: download only these sessions of the manifest; default: all.
        keep_archives: keep archives in `<capture>/.download/archives` after unpacking.
        dry_run: list what would be fetched, and write nothing.
        overrides: `key=value` or `section.key=value`, in place of the manifest's values.
        say: called with each line of the report, like `print`.

    Returns:
        The check report of each capture; empty on a dry run.

    Raises:
        ManifestError: the manifest does not say where its captures are, or has no such session.
        DownloadError: something cannot be fetched, unpacked or stored. The same command resumes the download.
    """
    manifest = load_manifest(manifest_path, overrides)
    dataset = manifest.dataset
    if dataset is None:
        raise ManifestError(
            f"{manifest_path}: has no section `dataset`, which says where to download from. See "
            "data_manifests/crocodl-hydro.yaml for an example."
        )
    for name in sessions:
        if name not in dataset.session_names:
            raise ManifestError(f"--sessions {name}: no such session. {nearest(name, dataset.session_names)}")
    names = {name: source for name, source in dataset.session_names.items() if not sessions or name in sessions}
    folders = {Path(capture).name: Path(capture) for capture in manifest.captures}
    if without := [name for name in folders if name not in dataset.sources]:
        if len(without) == len(folders):
            raise ManifestError(
                f"{manifest_path}: dataset.sources has no entry for {without[0]!r}, a folder in `captures`. "
                f"{nearest(without[0], dataset.sources)}"
            )
        say(f"{', '.join(without)}: not in dataset.sources, so nothing is fetched for it.")
    captures = [
        _CaptureDownload(folder, dataset, dataset.sources[name], names, keep_archives, say)
        for name, folder in folders.items()
        if name in dataset.sources
    ]
    for capture in captures:
        capture.list_files()
        capture.describe(dry_run)
    _require_space_for(captures)
    if dry_run:
        return []
    reports, failures = [], []
    for capture in captures:
        try:
            capture.run()
            reports.append(capture.check())
        except DownloadError as error:  # the other captures continue
            failures.append(str(error))
    if failures:
        raise DownloadError("\n".join(failures))
    return reports


def is_unfinished(capture: Path) -> bool:
    """Return whether a download into this capture's folder has started and not finished."""
    return (capture / STATE / _UNFINISHED).exists()


@dataclass
class _CaptureDownload:
    """The download of one capture: the files of its source, the state on disk, and the steps."""

    folder: Path
    """The capture's folder."""
    dataset: DatasetSettings
    source: Source
    names: dict[str, str]
    """For each requested session, its name in the source."""
    keep_archives: bool
    say: Say

    def __post_init__(self) -> None:
        self.state = self.folder / STATE
        self.files: list[RemoteFile] = []
        self.left_out: list[RemoteFile] = []
        hub = self.source.hub
        self.origin = f"dataset {hub}" if hub else ", ".join(self.source.urls)
        self.page = f"https://huggingface.co/datasets/{hub}" if hub else self.dataset.page
        self.lock = threading.Lock()
        self.done = self._read_done()
        self.bar: Any = None

    # List the files of the source

    def list_files(self) -> None:
        """List the files of the source, and select those of the requested sessions."""
        for file in self._list_hub(self.source.hub) if self.source.hub else self._list_urls():
            (self.files if self.source.urls or self._wants(file.path) else self.left_out).append(file)
        if not self.files:
            listed = {_session_of(file.path, ()) or file.path.partition("/")[0] for file in self.left_out}
            raise DownloadError(
                f"{self.folder.name}: {self.origin} has no file for {', '.join(self.names.values())}. It has "
                f"{', '.join(sorted(listed)[:20]) or 'nothing'}. Correct `dataset.sessions` or `dataset.into`."
            )

    def _list_hub(self, repo: str) -> list[RemoteFile]:
        import huggingface_hub
        from huggingface_hub.hf_api import RepoFile

        revision, files = self.source.revision, []
        api = huggingface_hub.HfApi()
        try:
            commit = api.dataset_info(repo, revision=revision).sha or revision
            for entry in api.list_repo_tree(repo, recursive=True, revision=commit, repo_type="dataset"):
                if isinstance(entry, RepoFile):
                    path = "/".join(filter(None, [self.dataset.into, *safe_parts(entry.path, self.origin)]))
                    url = huggingface_hub.hf_hub_url(repo, entry.path, repo_type="dataset", revision=commit)
                    version = f"sha256:{entry.lfs.sha256}" if entry.lfs else f"git:{entry.blob_id}"
                    files.append(RemoteFile(path, url, entry.size, version))
        except DownloadError:
            raise
        except Exception as error:  # the library's own, or its HTTP client's, which depends on its version
            refused = status_of(error) in (401, 403, 404)
            raise DownloadError(
                f"{self.folder.name}: {self.origin} (revision {revision}) cannot be listed: "
                f"{failure_reason(error, self.page)}.\n{self._access if refused else NETWORK}"
            ) from error
        self.origin += f" ({revision}, commit {commit[:7]})"
        return files

    def _list_urls(self) -> list[RemoteFile]:
        transfer, files = Transfer({}, self._access, lambda count: None), []
        for url in self.source.urls:
            name = safe_parts(unquote(PurePosixPath(urlsplit(url).path).name), url)[-1]
            if not name.lower().endswith(".zip"):
                raise ManifestError(f"dataset.sources.{self.folder.name}.urls: {url} does not name a .zip archive.")
            size, version = transfer.describe(url)
            if checksum := self.source.sha256.get(name):
                version = f"sha256:{checksum}"
            files.append(RemoteFile(name, url, size, version))
        return files

    @property
    def _access(self) -> str:
        """What the user can do if the server refuses access."""
        if self.source.hub:
            return (
                f"Open {self.page} in a browser: accept the terms if it asks for that, create a token (Settings, "
                "Access Tokens), and set HF_TOKEN to it or log in with `hf auth login`. If there is no such page, look "
                f"up the data set's current name at {self.dataset.page} and set "
                f"`dataset.sources.{self.folder.name}.hub`."
            )
        return (
            f"See {self.dataset.page} for how to get access and for the current addresses; set them as "
            f"`dataset.sources.{self.folder.name}.urls`."
        )

    def _wants(self, path: str) -> bool:
        """Return whether to download the file with this path in the capture."""
        return _session_of(path, self.names.values()) in self.names.values() or any(
            fnmatch.fnmatchcase(path, pattern) for pattern in self.dataset.include
        )

    def describe(self, in_full: bool) -> None:
        """Print what is fetched, from where, and under which license; `in_full` lists each file."""
        self.say(f"{self.folder.name}: {self.origin}\n  to        {self.folder}\n  license   {self.dataset.license}")
        if self.dataset.citation:
            self.say(f"  cite      {self.dataset.citation}")
        self.say(f"  about     {self.dataset.page}")
        groups: dict[str, list[RemoteFile]] = {}
        for file in self.files:
            groups.setdefault(_session_of(file.path, self.names.values()) or "archives", []).append(file)
        for name, files in [*sorted(groups.items()), ("left out", self.left_out)]:
            sizes = [file.size for file in files]
            total = size_text(None if None in sizes else sum(size or 0 for size in sizes))
            if files:
                self.say(f"  {name:<11} {len(files):>7} files  {total:>9}")
        for file in self.files if in_full else ():
            self.say(f"    {size_text(file.size):>9}  {file.path}")

    # Files fetched before

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
                continue  # a kill cut this line off: its file counts as not done and is checked again
            done[row["path"]] = row
        return done

    def _mark_done(self, file: RemoteFile, **columns: list[str]) -> None:
        before = self.done.get(file.path, {})
        if before.get("version") == file.version:  # an archive of which other sessions were fetched
            columns = {name: sorted({*values, *before[name]}) for name, values in columns.items()}
        row = self.done[file.path] = {"path": file.path, "version": file.version, **columns}
        with self.lock, open(self.state / "done.jsonl", "a", encoding="utf-8") as stream:
            stream.write("\n" + json.dumps(row))  # newline first: a kill may have cut off the previous line

    def is_done(self, file: RemoteFile) -> bool:
        """Return whether this version of a file, or what an archive was unpacked to, is in place already."""
        row = self.done.get(file.path, {})
        if row.get("version") != file.version:
            return False
        if file.is_archive:
            asked = [name for name in row["folders"] if name.partition("sessions/")[2] in ("", *self.names)]
            in_place = all((self.folder / name).is_dir() for name in asked)
            return in_place and set(self._sessions_in(file)) <= set(row["sessions"])
        return _file_size(self.folder / file.path) == file.size

    def count_fetched(self, file: RemoteFile) -> int:
        """Return how many bytes of an unfinished file are on disk."""
        return _file_size(self._archive(file)) or _file_size(self._partial(file)) or 0

    def _sessions_in(self, archive: RemoteFile) -> list[str]:
        """Return the requested sessions, by their names in the capture, that an archive may contain."""
        session = _session_of(archive.path, self.names.values())
        return sorted(name for name, name_in_source in self.names.items() if session in (None, name_in_source))

    def _partial(self, file: RemoteFile) -> Path:
        # The name depends on the version, so a file is never assembled from two versions.
        return self.state / "partial" / fingerprint([file.path, file.version])

    def _archive(self, file: RemoteFile) -> Path:
        return self.state / "archives" / f"{PurePosixPath(file.path).stem}-{self._partial(file).name}.zip"

    # Fetch the files

    def run(self) -> None:
        """Fetch, unpack and arrange all files of the capture."""
        from filelock import FileLock, Timeout

        try:
            self.state.mkdir(parents=True, exist_ok=True)
            with FileLock(self.state / "lock", timeout=0):
                self._run()
        except Timeout:
            raise DownloadError(f"{self.folder}: another download into this folder is running. Wait for it.") from None
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                text = f"the disk is full ({size_text(shutil.disk_usage(self.folder).free)} free). Free some space"
            else:
                text = f"{first_line(error)}. Make the folder writable, or choose another folder (`captures`)"
            raise DownloadError(
                f"{error.filename or self.folder}: {text}; then run the same command: it resumes the download."
            ) from error

    def _run(self) -> None:
        from huggingface_hub.utils import build_hf_headers
        from tqdm.auto import tqdm

        headers = build_hf_headers() if self.source.hub else {}  # the token
        files = [file for file in self.files if not self.is_done(file)]
        self._set_unfinished(True)
        total = sum(file.size or 0 for file in self.files)
        have = total - sum((file.size or 0) - self.count_fetched(file) for file in files)
        with tqdm(total=total, initial=have, desc=self.folder.name, unit="B", unit_scale=True) as self.bar:
            transfer = Transfer(headers, self._access, self._advance)
            failures = self._fetch_loose(transfer, [file for file in files if not file.is_archive])
            for file in files:
                try:
                    if file.is_archive:
                        self._fetch_archive(transfer, file)
                except FileError as error:
                    failures.append(error)
        if failures:
            first = "\n  ".join(map(str, failures[:5])) + ("\n  ..." if len(failures) > 5 else "")
            raise DownloadError(
                f"{self.folder.name}: {len(failures)} of {len(self.files)} files failed; the others are there. Run the "
                f"same command to try these again.\n  {first}"
            )
        shutil.rmtree(self.state / "unpacked", ignore_errors=True)
        self._set_unfinished(False)
        if not is_unfinished(self.folder):
            shutil.rmtree(self.state / "partial", ignore_errors=True)

    def _set_unfinished(self, unfinished: bool) -> None:
        """Add the requested sessions to the list of unfinished ones, or remove them. Delete the list once empty."""
        list_file = self.state / _UNFINISHED
        names = set(list_file.read_text(encoding="utf-8").split()) if list_file.exists() else set()
        if names := names | self.names.keys() if unfinished else names - self.names.keys():
            write_text(list_file, "\n".join(sorted(names)))
        else:
            list_file.unlink()

    def _advance(self, count: int) -> None:
        with self.lock:
            self.bar.update(count)

    def _fetch_loose(self, transfer: Transfer, files: list[RemoteFile]) -> list[FileError]:
        """Fetch files that are not archives, several at a time; return the errors of single files."""
        failures = []
        pool = ThreadPoolExecutor(_WORKERS)
        try:
            for task in as_completed([pool.submit(self._fetch_one, transfer, file) for file in files]):
                try:
                    task.result()
                except FileError as error:
                    failures.append(error)
        except BaseException:  # an error that affects all files, or Ctrl-C: stop the other threads
            transfer.stop.set()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
        return failures

    def _fetch_one(self, transfer: Transfer, file: RemoteFile) -> None:
        target = self.folder / file.path
        if _file_size(target) == file.size and file.matches(target):  # fetched by another tool
            self._advance(file.size or 0)
        else:
            transfer.fetch(file, self._partial(file), target)
        self._mark_done(file)

    def _fetch_archive(self, transfer: Transfer, file: RemoteFile) -> None:
        """Fetch an archive, unpack it to a temporary folder, and move the requested files into the capture."""
        archive = self._archive(file)
        if not archive.exists():
            transfer.fetch(file, self._partial(file), archive)
        unpacked = self.state / "unpacked" / archive.stem
        shutil.rmtree(unpacked, ignore_errors=True)  # left by a kill
        parent = file.path.split("/")[:-1]

        def target_path(parts: list[str]) -> str | None:
            if not parent and "sessions" in parts[:2]:
                parts = parts[parts.index("sessions") :]  # without the capture's own folder, if the archive has it
            path = "/".join([*parent, *parts])
            return path if self._wants(path) else None

        try:
            try:
                count = unpack(archive, unpacked, target_path, file.path)
            except FileError:
                # If the checksum is known, the published archive itself is damaged: fetching it again is useless.
                if not file.version.startswith(("sha256:", "git:")):
                    archive.unlink()
                raise
            if count == 0:
                raise FileError(
                    f"{file.path}: contains nothing of {', '.join(self.names.values())}. It has: "
                    f"{', '.join(top_folders(archive))}. Correct `dataset.sessions`."
                )
            if isinstance(self.dataset.sessions, dict):
                for note in arrange(unpacked / "sessions", self.dataset.sessions):
                    self.say(f"{self.folder.name}: left out of {note}")
                for name in self.dataset.sessions.keys() - self.names.keys():  # split off but not requested
                    shutil.rmtree(unpacked / "sessions" / name, ignore_errors=True)
            folders = _move_into(unpacked, self.folder)
        finally:
            shutil.rmtree(unpacked, ignore_errors=True)
        self._mark_done(file, sessions=self._sessions_in(file), folders=folders)
        if not self.keep_archives:
            archive.unlink()

    def check(self) -> "CheckReport":
        """Check the capture, print the result, and raise DownloadError if a requested session is missing."""
        from toolkit.capture.check import check_capture

        report = check_capture(self.folder)
        self.say("\n" + report.text(most=20))
        if missing := [name for name in self.names if name not in report.tables]:
            raise DownloadError(
                f"{self.folder}: all requested files of {self.origin} are here, but there is no session "
                f"{', '.join(missing)} in it; found {', '.join(report.tables)}. If the data are published without, "
                "remove them from `dataset.sessions`, or name the sessions to download with --sessions."
            )
        return report


def _require_space_for(captures: list[_CaptureDownload]) -> None:
    """Check before the download that the disks have room. An archive takes space packed and unpacked."""
    needed_bytes: Counter[int] = Counter()  # by disk
    folders: dict[int, Path] = {}
    for capture in captures:
        folder = next(parent for parent in (capture.folder, *capture.folder.parents) if parent.exists())
        disk = folder.stat().st_dev
        folders.setdefault(disk, folder)
        missing = [file for file in capture.files if not capture.is_done(file)]
        packed = [file.size or 0 for file in missing if file.is_archive]
        # Images hardly shrink in an archive, so its size estimates the unpacked size. `unpack` checks the exact one.
        needed_bytes[disk] += sum(packed) if capture.keep_archives else max(packed, default=0)
        needed_bytes[disk] += sum((file.size or 0) - capture.count_fetched(file) for file in missing)
    for disk, count in needed_bytes.items():
        require_space(folders[disk], count, "fetch fewer sessions at once (--sessions)")


def _session_of(path: str, sessions: Iterable[str]) -> str | None:
    """Return the session folder that a file lies in, or the session that an archive in `sessions/` is named after."""
    parts = path.split("/")
    if parts[0] != "sessions" or len(parts) < 2:
        return None
    if len(parts) > 2:
        return parts[1]
    stem = parts[1][:-4] if parts[1].lower().endswith(".zip") else ""
    return next((name for name in sessions if re.match(re.escape(name) + r"([._-]|$)", stem)), stem or None)


def _move_into(source: Path, target: Path) -> list[str]:
    """Move all files from one folder to the same paths below another; return their folders, two levels deep."""
    folders = set()
    for path in [path for path in source.rglob("*") if path.is_file()]:
        relative = path.relative_to(source)
        folders.add("/".join(relative.parts[:-1][:2]))
        (target / relative).parent.mkdir(parents=True, exist_ok=True)
        path.replace(target / relative)
    return sorted(folders)


def _file_size(path: Path) -> int | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None
