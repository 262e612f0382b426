"""Unpack zip archives from elsewhere: only below their folder, only files, only what the disk has room for."""

import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from toolkit.errors import DownloadError, first_line

_SPARE = 1.02  # of the disk: folders and file systems need some for themselves


class FileError(DownloadError):
    """Something is wrong with one file; the others can go on."""


def unpack(archive: Path, target: Path, place: Callable[[list[str]], str | None], name: str = "") -> int:
    """Unpack a zip archive into a new folder, and return how many files it has written.

    Args:
        place: returns the path in the folder (with `/`) for the parts of a member's path, or None to leave it out.
        name: of the archive, for messages and the progress bar; its file name when not given.

    Raises:
        DownloadError: a member's path leads out of the folder; a member is not a file, is encrypted, or is there twice;
            the archive is damaged; or the disk has no room for it. Nothing outside of `target` was written.
    """
    from tqdm.auto import tqdm

    name = name or archive.name
    try:
        with zipfile.ZipFile(archive) as zipped:
            members = _members(zipped, place, name)
            size = sum(member.file_size for member in members.values())
            target.mkdir(parents=True)
            require_space(target, size, "unpack fewer sessions (--sessions)")
            with tqdm(total=size, desc=f"unpack {PurePosixPath(name).name}", unit="B", unit_scale=True) as bar:
                for path, member in members.items():
                    file = target / path
                    file.parent.mkdir(parents=True, exist_ok=True)
                    # Reading stops at the size that the archive states, and compares the checksum.
                    with zipped.open(member) as source, open(file, "xb") as out:
                        while piece := source.read(1 << 20):
                            bar.update(out.write(piece))
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise FileError(
            f"{name}: not a whole zip archive: {first_line(error)}. Nothing of it was used. Run the same command "
            "again; if this comes back, the archive is damaged where it is published."
        ) from error
    except (NotImplementedError, RuntimeError) as error:
        raise FileError(
            f"{name}: cannot be unpacked here: {first_line(error)}. Unpack {archive} with another program."
        ) from error
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise FileError(
            f"{name}: holds a file and a folder of one name, {error.filename}. Nothing of it was used."
        ) from error
    return len(members)


def _members(
    zipped: zipfile.ZipFile, place: Callable[[list[str]], str | None], name: str
) -> dict[str, zipfile.ZipInfo]:
    """Return the members to unpack by their paths in the folder; refuse what a capture has no use for."""
    members: dict[str, zipfile.ZipInfo] = {}
    for member in zipped.infolist():
        parts = safe_parts(member.filename, name)  # also of what is left out: such an archive is not to be trusted
        if member.is_dir() or (path := place(parts)) is None:
            continue
        mode = member.external_attr >> 16
        if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise FileError(
                f"{name}: holds {member.filename!r}, which is a link or no file at all. Nothing of it was used: "
                "the data may have been tampered with. Tell those who publish them."
            )
        if member.flag_bits & 1:
            raise FileError(f"{name}: {member.filename!r} is encrypted. Unpack it yourself with its password.")
        if path in members:
            raise FileError(f"{name}: holds {path} twice. Nothing of it was used. Tell those who publish it.")
        members[path] = member
    return members


def top_folders(archive: Path) -> list[str]:
    """Return the first folders in an archive, three levels deep, for messages."""
    with zipfile.ZipFile(archive) as zipped:
        tops = {"/".join(name.split("/")[:3]) for name in zipped.namelist()}
    return sorted(tops)[:20]


def safe_parts(name: str, where: str | Path) -> list[str]:
    """Return the folders and the name of a path from outside, or refuse one that leads out of its folder."""
    path = name.replace("\\", "/")
    parts = [part for part in path.split("/") if part not in ("", ".")]
    if not parts or path.startswith("/") or ".." in parts or re.match("[A-Za-z]:", path) or "\0" in path:
        raise FileError(
            f"{where}: holds {name!r}, a path that leads out of the folder it belongs in. Nothing of it was used: "
            "the data may have been tampered with. Tell those who publish them."
        )
    return parts


def require_space(place: Path, needed: int, otherwise: str) -> None:
    """Raise DownloadError if `needed` bytes do not fit on the disk of a folder; `otherwise` is another way out."""
    free = shutil.disk_usage(place).free
    if needed * _SPARE > free:
        raise DownloadError(
            f"{place}: about {size_text(int(needed * _SPARE))} are needed on this disk and {size_text(free)} are free. "
            f"Free some, set CAPTURES (or `captures` in the manifest) to a folder on another disk, or {otherwise}."
        )


def size_text(count: int | None) -> str:
    """Return a number of bytes as people read it; `?` for None."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count is not None and count >= scale:
            return f"{count / scale:.1f} {unit}"
    return "?" if count is None else f"{count} B"
