"""Unpack untrusted zip archives, and bring the sessions of other data sets into the capture format.

In LaMAR (Sarlin, Dusmanu et al., ECCV 2022) one session `map` holds phones and headsets, and `queries.txt` lists the
queries. Here each session has one device, and `proc/keyframes_*.txt` list the queries.
"""

import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path, PureWindowsPath

from pydantic import ByteSize

from toolkit.capture.names import require_name
from toolkit.capture.tables import COLUMNS
from toolkit.errors import CaptureError, DownloadError, first_line

_SPACE_FACTOR = 1.02  # folders and file systems take some space themselves
# For each file of a session, the column whose values are `<subsession>/<sensor>` or `<subsession>`.
_KEY_COLUMNS = {file: int(columns[0][0] == "timestamp") for file, columns in COLUMNS.items()}
_KEY_COLUMNS |= {"pointclouds.txt": 1, "queries.txt": 1}


class FileError(DownloadError):
    """One file failed; the download of other files can continue."""


def unpack(archive: Path, target: Path, target_path: Callable[[str], str | None], name: str) -> None:
    """Unpack a zip archive into a new folder: regular files only, nothing outside of it, no more than the disk holds.

    `target_path` maps a member's path to its path below `target`, or to None to skip it; `name` is for messages.

    Raises:
        DownloadError: a member's path leaves the folder; a member is no regular file, is encrypted, or occurs twice;
            the archive is damaged, or all is skipped; the disk is too small.
    """
    from tqdm.auto import tqdm

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
        raise FileError(f"{name}: cannot be unpacked: {first_line(error)}. Nothing of it was used.") from error


def safe_path(name: str, where: str) -> str:
    """Return an untrusted relative path with `/` only. Raise FileError if it leaves its folder on any system."""
    path = PureWindowsPath(name)  # knows both separators, and drives
    if path.anchor or ".." in path.parts or not path.parts or "\0" in name:
        raise FileError(f"{where}: contains {name!r}, a path outside the target folder. Nothing of it was used.")
    return path.as_posix()


def require_space(folder: Path, needed_bytes: int) -> None:
    """Raise DownloadError if `needed_bytes` do not fit on the disk of `folder`."""
    free, needed = shutil.disk_usage(folder).free, int(needed_bytes * _SPACE_FACTOR)
    if needed > free:
        raise DownloadError(
            f"{folder}: about {size_text(needed)} are needed on this disk and {size_text(free)} are free. Free some "
            "space, set CAPTURES to a folder on another disk, or fetch fewer sessions (--sessions)."
        )


def size_text(count_bytes: int) -> str:
    return ByteSize(count_bytes).human_readable(decimal=True, separator=" ")


def arrange(sessions: Path, names: Mapping[str, str]) -> list[str]:
    """Rename the sessions of a data set; split by device, in place, a session that several new names refer to.

    The subsessions of a device have names that begin with `<device>_`. `names` has, for each new name `<device>_<map or
    query>`, the session's name in the data set; others stay as they are. Return notes on what was left out.

    Raises:
        CaptureError: a session to split has no subsession of a device, or an invalid subsession name.
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
    """Split a session into one per device; return notes on what was left out."""
    list_file = old / "proc" / "subsessions.txt"
    lines = list_file.read_text(encoding="utf-8").splitlines() if list_file.is_file() else []
    subsessions = {line.strip() for line in lines if line.strip() and not line.startswith("#")}
    subsessions = subsessions or {path.name for path in (old / "raw_data").glob("*") if path.is_dir()}
    for name in subsessions:
        require_name(name, "subsession", list_file)
    unclaimed = set(subsessions)
    for session in new:
        device = session.name.rpartition("_")[0]
        own = {name for name in subsessions if name.startswith(f"{device}_")}
        unclaimed -= own
        if not own:
            found = ", ".join(sorted(subsessions)[:3]) or "none"
            raise CaptureError(f"{old.name}: expected subsessions of {device!r}, named {device}_...; found {found}.")
        for file, column in _KEY_COLUMNS.items():
            if (old / file).is_file():
                (session / file).parent.mkdir(parents=True, exist_ok=True)
                with open(old / file, encoding="utf-8") as rows, open(session / file, "w", encoding="utf-8") as out:
                    keyed = ((row, (*row.split(","), *[""] * column)[column].strip()) for row in rows)
                    out.writelines(row for row, key in keyed if row.startswith("#") or key.partition("/")[0] in own)
        (session / "raw_data").mkdir(parents=True, exist_ok=True)
        for folder in [old / "raw_data" / name for name in own if (old / "raw_data" / name).is_dir()]:
            folder.rename(session / "raw_data" / folder.name)
    others = {path.relative_to(old).as_posix() for path in old.rglob("*") if path.is_file()} - _KEY_COLUMNS.keys()
    shutil.rmtree(old)
    left_out = {"subsessions of other devices": unclaimed, "files that cannot be split by device": others}
    return [f"{old.name}: {len(items)} {what}, such as {min(items)}" for what, items in left_out.items() if items]
