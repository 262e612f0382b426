"""Unpack untrusted zip archives: regular files only, nothing outside the target folder, no more than the disk holds."""

import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from toolkit.errors import DownloadError, first_line

_SPACE_FACTOR = 1.02  # folders and file systems take some space themselves


class FileError(DownloadError):
    """One file failed; the download of other files can continue."""


def unpack(archive: Path, target: Path, target_path: Callable[[list[str]], str | None], name: str = "") -> int:
    """Unpack a zip archive into a new folder and return the number of files written.

    Args:
        target_path: maps the parts of a member's path to its path below `target` (with `/`), or to None to skip it.
        name: archive name in messages and the progress bar; default: its file name.

    Raises:
        DownloadError: a member's path leaves the folder; a member is no regular file, is encrypted, or occurs twice;
            the archive is damaged; or the disk is too small. Nothing is written outside `target`.
    """
    from tqdm.auto import tqdm

    name = name or archive.name
    try:
        with zipfile.ZipFile(archive) as zipped:
            members = _members(zipped, target_path, name)
            size = sum(member.file_size for member in members.values())
            target.mkdir(parents=True)
            require_space(target, size, "unpack fewer sessions (--sessions)")
            with tqdm(total=size, desc=f"unpack {PurePosixPath(name).name}", unit="B", unit_scale=True) as bar:
                for path, member in members.items():
                    file = target / path
                    file.parent.mkdir(parents=True, exist_ok=True)
                    # zipfile stops at the size stated in the archive and verifies the checksum.
                    with zipped.open(member) as source, open(file, "xb") as out:
                        while chunk := source.read(1 << 20):
                            bar.update(out.write(chunk))
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise FileError(
            f"{name}: incomplete or damaged zip archive: {first_line(error)}. Nothing of it was used. Run the same "
            "command again; if the error persists, the published archive is damaged."
        ) from error
    except (NotImplementedError, RuntimeError) as error:
        raise FileError(
            f"{name}: cannot be unpacked here: {first_line(error)}. Unpack {archive} with another program."
        ) from error
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise FileError(
            f"{name}: contains a file and a folder with the same name, {error.filename}. Nothing of it was used."
        ) from error
    return len(members)


def _members(
    zipped: zipfile.ZipFile, target_path: Callable[[list[str]], str | None], name: str
) -> dict[str, zipfile.ZipInfo]:
    """Return the members to unpack by target path. Raise FileError for links, encrypted files and duplicates."""
    members: dict[str, zipfile.ZipInfo] = {}
    for member in zipped.infolist():
        parts = safe_parts(member.filename, name)  # skipped members too: one unsafe path makes the archive suspect
        if member.is_dir() or (path := target_path(parts)) is None:
            continue
        mode = member.external_attr >> 16
        if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise FileError(
                f"{name}: contains {member.filename!r}, which is a link or a special file. Nothing of it was used: "
                "the data may have been tampered with. Tell the publishers."
            )
        if member.flag_bits & 1:
            raise FileError(f"{name}: {member.filename!r} is encrypted. Unpack it yourself with its password.")
        if path in members:
            raise FileError(f"{name}: contains {path} twice. Nothing of it was used. Tell the publishers.")
        members[path] = member
    return members


def top_folders(archive: Path) -> list[str]:
    """Return up to 20 folders of an archive, at most three levels deep, for error messages."""
    with zipfile.ZipFile(archive) as zipped:
        return sorted({"/".join(name.split("/")[:3]) for name in zipped.namelist()})[:20]


def safe_parts(name: str, where: str | Path) -> list[str]:
    """Split an untrusted relative path into its parts. Raise FileError if it leaves its folder."""
    path = name.replace("\\", "/")
    parts = [part for part in path.split("/") if part not in ("", ".")]
    if not parts or path.startswith("/") or ".." in parts or re.match("[A-Za-z]:", path) or "\0" in path:
        raise FileError(
            f"{where}: contains {name!r}, a path outside the target folder. Nothing of it was used: the data may have "
            "been tampered with. Tell the publishers."
        )
    return parts


def require_space(folder: Path, needed_bytes: int, alternative: str) -> None:
    """Raise DownloadError if `needed_bytes` do not fit on the disk of `folder`; the message suggests `alternative`."""
    free_bytes = shutil.disk_usage(folder).free
    if needed_bytes * _SPACE_FACTOR > free_bytes:
        needed = size_text(int(needed_bytes * _SPACE_FACTOR))
        raise DownloadError(
            f"{folder}: about {needed} are needed on this disk and {size_text(free_bytes)} are free. Free some space, "
            f"set CAPTURES (or `captures` in the manifest) to a folder on another disk, or {alternative}."
        )


def size_text(count_bytes: int | None) -> str:
    """Return a size such as `1.2 GB`; `?` for None."""
    if count_bytes is None:
        return "?"
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count_bytes >= scale:
            return f"{count_bytes / scale:.1f} {unit}"
    return f"{count_bytes} B"
