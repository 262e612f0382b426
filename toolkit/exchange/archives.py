"""Unpack untrusted zip archives: regular files only, nothing outside the target folder, no more than the disk holds."""

import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PureWindowsPath

from pydantic import ByteSize

from toolkit.errors import DownloadError, first_line

_SPACE_FACTOR = 1.02  # folders and file systems take some space themselves


class FileError(DownloadError):
    """One file failed; the download of other files can continue."""


def unpack(archive: Path, target: Path, target_path: Callable[[str], str | None], name: str) -> None:
    """Unpack a zip archive into a new folder.

    Args:
        target_path: maps a member's path to its path below `target` (with `/`), or to None to skip it.
        name: name of the archive in messages and the progress bar.

    Raises:
        DownloadError: a member's path leaves the folder; a member is no regular file, is encrypted, or occurs twice;
            the archive is damaged, or all is skipped; the disk is too small. Nothing is written outside `target`.
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
            "space, set CAPTURES (or `captures` in the manifest) to a folder on another disk, or fetch fewer sessions "
            "(--sessions)."
        )


def size_text(count_bytes: int) -> str:
    return ByteSize(count_bytes).human_readable(decimal=True, separator=" ")
