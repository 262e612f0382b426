"""Fetch the captures of a manifest: list, download, unpack, lay out as the capture format wants, check.

What is under way is kept in `<capture>/.download/`, so that the same command goes on after a failure or a kill:

    unfinished       the sessions whose download has begun and not ended, one a line
    done.jsonl       what has been fetched, unpacked and verified, one JSON object a line
    partial/         files that are being fetched; the name says which version of which file
    archives/        whole archives that wait to be unpacked
    unpacked/        an archive that is being unpacked
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
_WORKERS = 8  # of small files, whose time is mostly waiting; archives come one by one


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
        sessions: only these of the manifest's sessions.
        keep_archives: keep archives in `<capture>/.download/archives` after they are unpacked.
        dry_run: list what would be fetched, and write nothing.
        overrides: `key=value` or `section.key=value`, in place of the manifest's values.
        say: called with each line of the report, like `print`.

    Returns:
        For each capture, the report of the check; nothing on a dry run.

    Raises:
        ManifestError: the manifest does not say where its captures are, or has no such session.
        DownloadError: something cannot be fetched, unpacked or stored. The same command goes on where it was.
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
    names = {name: source for name, source in dataset.session_names.items() if not sessions or name in sessions}
    folders = {Path(capture).name: Path(capture) for capture in manifest.captures}
    if without := [name for name in folders if name not in dataset.sources]:
        if len(without) == len(folders):
            raise ManifestError(
                f"{manifest_path}: dataset.sources has no {without[0]!r}, which is the name of a folder in `captures`. "
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
        except DownloadError as error:  # of one capture; the others can go on
            failures.append(str(error))
    if failures:
        raise DownloadError("\n".join(failures))
    return reports


def is_unfinished(capture: Path) -> bool:
    """Tell whether a download into this capture's folder has begun and not ended."""
    return (capture / STATE / _UNFINISHED).exists()


@dataclass
class _CaptureDownload:
    """The download of one capture: the files of its source, those that are here already, and the steps between."""

    folder: Path
    """The capture's folder."""
    dataset: DatasetSettings
    source: Source
    names: dict[str, str]
    """For each session that is wanted, its name in the source."""
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

    # What there is to fetch

    def list_files(self) -> None:
        """Ask the source for its files, and choose those of the wanted sessions."""
        for file in self._list_hub(self.source.hub) if self.source.hub else self._list_urls():
            (self.files if self.source.urls or self._wants(file.path) else self.left_out).append(file)
        if not self.files:
            listed = {_session_of(file.path, ()) or file.path.partition("/")[0] for file in self.left_out}
            raise DownloadError(
                f"{self.folder.name}: {self.origin} has no file for {', '.join(self.names.values())}. Found there: "
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
        except Exception as error:  # of the library, and of its HTTP client, which differs with its version
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
        """What to do if the server refuses access."""
        if self.source.hub:
            return (
                f"Look at {self.page} in a browser: accept the terms if it has some, make a token (Settings, Access "
                "Tokens), and set HF_TOKEN to it or log in with `hf auth login`. If there is no such page, look for "
                f"the data set's present name at {self.dataset.page} and set "
                f"`dataset.sources.{self.folder.name}.hub`."
            )
        return (
            f"See {self.dataset.page} for how to get access and for the present addresses; set them as "
            f"`dataset.sources.{self.folder.name}.urls`."
        )

    def _wants(self, path: str) -> bool:
        """Tell whether the download needs the file with this path in the capture."""
        return _session_of(path, self.names.values()) in self.names.values() or any(
            fnmatch.fnmatchcase(path, pattern) for pattern in self.dataset.include
        )

    def describe(self, in_full: bool) -> None:
        """Say what is fetched, from where, and under which license; `in_full` lists each file."""
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

    # What has been fetched before

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
                continue  # a kill tore this line: its file counts as not done, and is looked at again
            done[row["path"]] = row
        return done

    def _mark_done(self, file: RemoteFile, **more: Any) -> None:
        row = self.done[file.path] = {"path": file.path, "version": file.version, **more}
        with self.lock, open(self.state / "done.jsonl", "a", encoding="utf-8") as stream:
            stream.write("\n" + json.dumps(row))  # the break comes first: a kill may have torn the line above

    def is_done(self, file: RemoteFile) -> bool:
        """Tell whether a file has been fetched before, and is still there; of an archive, what was unpacked from it."""
        row = self.done.get(file.path, {})
        if row.get("version") != file.version:
            return False
        if file.is_archive:
            folders = [self.folder / name for name in row["folders"]]
            return set(self._sessions_in(file)) <= set(row["sessions"]) and all(map(Path.is_dir, folders))
        return _file_size(self.folder / file.path) == file.size

    def count_fetched(self, file: RemoteFile) -> int:
        """Return how many bytes of a file that is not done are here."""
        return _file_size(self._archive(file)) or _file_size(self._partial(file)) or 0

    def _sessions_in(self, archive: RemoteFile) -> list[str]:
        """Return the wanted sessions, by their names in the capture, that an archive may hold."""
        session = _session_of(archive.path, self.names.values())
        return sorted(name for name, name_in_source in self.names.items() if session in (None, name_in_source))

    def _partial(self, file: RemoteFile) -> Path:
        # Another version has another name, so that no file is put together from two versions.
        return self.state / "partial" / fingerprint([file.path, file.version])

    def _archive(self, file: RemoteFile) -> Path:
        return self.state / "archives" / f"{PurePosixPath(file.path).stem}-{self._partial(file).name}.zip"

    # Fetching

    def run(self) -> None:
        """Fetch, unpack and lay out everything."""
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
                text = f"{first_line(error)}. See to it that you can write there, or choose another folder (`captures`)"
            raise DownloadError(
                f"{error.filename or self.folder}: {text}; then run the same command: it goes on where it was."
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
                f"{self.folder.name}: {len(failures)} of {len(self.files)} files failed; the others are there. The "
                f"same command tries these again.\n  {first}"
            )
        shutil.rmtree(self.state / "unpacked", ignore_errors=True)
        self._set_unfinished(False)
        if not is_unfinished(self.folder):
            shutil.rmtree(self.state / "partial", ignore_errors=True)

    def _set_unfinished(self, unfinished: bool) -> None:
        """Add the wanted sessions to those that are unfinished, or remove them; the file goes with the last one."""
        mark = self.state / _UNFINISHED
        names = set(mark.read_text(encoding="utf-8").split()) if mark.exists() else set()
        if names := names | self.names.keys() if unfinished else names - self.names.keys():
            write_text(mark, "\n".join(sorted(names)))
        else:
            mark.unlink()

    def _advance(self, count: int) -> None:
        with self.lock:
            self.bar.update(count)

    def _fetch_loose(self, transfer: Transfer, files: list[RemoteFile]) -> list[FileError]:
        """Fetch the files that are no archives, several at a time; return what failed for single files."""
        failures = []
        pool = ThreadPoolExecutor(_WORKERS)
        try:
            for task in as_completed([pool.submit(self._fetch_one, transfer, file) for file in files]):
                try:
                    task.result()
                except FileError as error:
                    failures.append(error)
        except BaseException:  # of one file for all, or Ctrl-C: end the others
            transfer.stop.set()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
        return failures

    def _fetch_one(self, transfer: Transfer, file: RemoteFile) -> None:
        target = self.folder / file.path
        if _file_size(target) == file.size and file.matches(target):  # fetched by other means
            self._advance(file.size or 0)
        else:
            transfer.fetch(file, self._partial(file), target)
        self._mark_done(file)

    def _fetch_archive(self, transfer: Transfer, file: RemoteFile) -> None:
        """Fetch an archive, unpack it aside, and move what is wanted into place; unpack it anew after a kill."""
        archive = self._archive(file)
        if not archive.exists():
            transfer.fetch(file, self._partial(file), archive)
        aside = self.state / "unpacked" / archive.stem
        shutil.rmtree(aside, ignore_errors=True)
        above = file.path.split("/")[:-1]

        def place(parts: list[str]) -> str | None:
            if not above and "sessions" in parts[:2]:
                parts = parts[parts.index("sessions") :]  # a folder of the capture's name may stand above
            path = "/".join([*above, *parts])
            return path if self._wants(path) else None

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
                    f"{file.path}: holds nothing of {', '.join(self.names.values())}. It has: "
                    f"{', '.join(top_folders(archive))}. Correct `dataset.sessions`."
                )
            if isinstance(self.dataset.sessions, dict):
                for note in arrange(aside / "sessions", self.dataset.sessions):
                    self.say(f"{self.folder.name}: left out of {note}")
                for name in self.dataset.sessions.keys() - self.names.keys():  # of a session that several share
                    shutil.rmtree(aside / "sessions" / name, ignore_errors=True)
            folders = _move_into(aside, self.folder)
        finally:
            shutil.rmtree(aside, ignore_errors=True)
        self._mark_done(file, sessions=self._sessions_in(file), folders=folders)
        if not self.keep_archives:
            archive.unlink()

    def check(self) -> "CheckReport":
        """Check the capture, report the result, and raise if a wanted session is not in it."""
        from toolkit.capture.check import check_capture

        report = check_capture(self.folder)
        self.say("\n" + report.text(most=20))
        if missing := [name for name in self.names if name not in report.tables]:
            raise DownloadError(
                f"{self.folder}: all of {self.origin} that was asked for is here, but there is no session "
                f"{', '.join(missing)} in it; found {', '.join(report.tables)}. If the data are published without, "
                "take them out of `dataset.sessions`, or name the others with --sessions."
            )
        return report


def _require_space_for(captures: list[_CaptureDownload]) -> None:
    """Refuse, before anything is fetched, what the disks cannot hold: archives take space packed and unpacked."""
    needed: Counter[int] = Counter()
    places: dict[int, Path] = {}
    for capture in captures:
        place = next(parent for parent in (capture.folder, *capture.folder.parents) if parent.exists())
        disk = place.stat().st_dev
        places.setdefault(disk, place)
        missing = [file for file in capture.files if not capture.is_done(file)]
        packed = [file.size or 0 for file in missing if file.is_archive]
        # Photographs hardly shrink in an archive. The true size is compared with the disk before it is unpacked.
        needed[disk] += sum(packed) if capture.keep_archives else max(packed, default=0)
        needed[disk] += sum((file.size or 0) - capture.count_fetched(file) for file in missing)
    for disk, count in needed.items():
        require_space(places[disk], count, "fetch fewer sessions at once (--sessions)")


def _session_of(path: str, sessions: Iterable[str]) -> str | None:
    """Return the session in whose folder a file lies, or whose name an archive in `sessions/` begins with."""
    parts = path.split("/")
    if parts[0] != "sessions" or len(parts) < 2:
        return None
    if len(parts) > 2:
        return parts[1]
    stem = parts[1][:-4] if parts[1].lower().endswith(".zip") else ""
    return next((name for name in sessions if re.match(re.escape(name) + r"([._-]|$)", stem)), stem or None)


def _move_into(source: Path, target: Path) -> list[str]:
    """Move all files below one folder to their places below another; return the folders, two levels deep."""
    folders = set()
    for path in [path for path in source.rglob("*") if path.is_file()]:
        place = target / path.relative_to(source)
        folders.add("/".join(path.relative_to(source).parts[:-1][:2]))
        place.parent.mkdir(parents=True, exist_ok=True)
        path.replace(place)
    return sorted(folders)


def _file_size(path: Path) -> int | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None
