"""Errors whose message is meant for the user: what was found, where, what was expected, what to do."""

import errno
import logging
import os
import re
import signal
from pathlib import Path
from typing import Any

import numpy as np

log = logging.getLogger(__name__)

INTERNAL = "internal: "
"""Before the reason of a row that is there for a fault of the toolkit: the next run tries it again."""
_OF_THE_MACHINE = ("out of memory", "allocate memory", "insufficient memory", "not enough memory", "bad_alloc",
                   "cuda error", "device-side assert", "hip error", "cublas", "cudnn", "find an engine",
                   "invalid buffer size", "mps framework", "mps device")  # fmt: skip


class ToolkitError(Exception):
    """Base of all errors that the command line prints without a traceback."""


class CaptureError(ToolkitError):
    """A capture folder or one of its files is not as the format wants it."""


class ManifestError(ToolkitError):
    """A manifest or a parameter is not valid."""


class ArtifactError(ToolkitError):
    """A file that an earlier stage should have written is missing, torn or made from something else."""


class DamagedError(ArtifactError):
    """Groups of a file are not what was written; see `features.groups.heals`."""

    def __init__(self, path: Path, message: str) -> None:
        super().__init__(message)
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, str(self))


class ImageError(ToolkitError):
    """An image file is missing or cannot be decoded."""


class WeightsError(ToolkitError):
    """Weights are missing, cannot be fetched, are damaged, or are those of another network."""


class DownloadError(ToolkitError):
    """A capture, or a file of it, cannot be listed, fetched, unpacked or put in its place."""


def reason_of(error: Exception, doing: str) -> str:
    """Return why one query or image has no result, for its row; raise what no other would do better with.

    An image that cannot be read, or a geometry that cannot be solved, is a result. A damaged file, and what memory,
    disk or device refuse, is raised: it says nothing of the query. The rest is a fault of the toolkit, `INTERNAL`: its
    traceback is logged, the others go on, and it is not to be recorded as done.

    Args:
        doing: what was done to which query.
    """
    if isinstance(error, ImageError | CaptureError | np.linalg.LinAlgError):
        return f"{type(error).__name__}: {error}"
    said = str(error).lower()
    if isinstance(error, ToolkitError | OSError | MemoryError) or any(words in said for words in _OF_THE_MACHINE):
        raise error
    log.error("%s: a fault of the toolkit; the next run tries it again", doing, exc_info=error)
    return INTERNAL + first_line(error)


def first_line(error: BaseException) -> str:
    """Return the kind and the first line of an error."""
    return f"{type(error).__name__}: {str(error).strip()}".split("\n")[0].rstrip(".")[:300]


class StageError(ToolkitError):
    """A stage stopped; the message holds the failing cell's error and the path of the executed notebook."""

    def __init__(self, message: str, of_the_data: bool = False, internal: bool = False) -> None:
        super().__init__(message)
        self.of_the_data = of_the_data
        """Whether the capture, or a file made of it, is at fault: other captures and pairs may do."""
        self.internal = internal
        """Whether the toolkit is."""


class IncompleteError(ToolkitError):
    """A run that ended, but in which more failed than its manifest tolerates."""


BUG = "Internal error: "
OF_THE_DATA = (CaptureError, ArtifactError, ImageError)
"""Errors that one session or pair may have while the others can be done."""

FREE_MEMORY = "Free some, or run fewer devices or pairs at a time (`devices:`, `pairs:` in the manifest)."
_MEMORY = re.compile(
    r"MemoryError|OutOfMemory|out of memory|bad_alloc|(cannot|can't|unable to) allocate|insufficient memory"
    r"|can't start new thread", re.IGNORECASE
)  # fmt: skip
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NO_PLACE = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG}


def shortage(kind: str, text: str) -> str | None:
    """Return a sentence for an error that means: no memory, no disk space, no place to write; None for another.

    Args:
        kind: name of the exception.
        text: what it says; Python, HDF5, OpenCV, NumPy and torch each have their own words.
    """
    if _MEMORY.search(f"{kind}: {text}"):
        said = text.strip().splitlines()[0] if text.strip() else "no more was said"
        return f"Out of memory ({kind}: {said}). {FREE_MEMORY}"
    found = re.search(r"\berrno[ =]+(\d+)", text, re.IGNORECASE)
    number = int(found[1]) if found else 0
    if number not in _FULL | _NO_PLACE:
        return None
    names = re.findall(r"name = '([^']+)'", text) or re.findall(r"'([^']+)'", text.partition("]")[2])
    path, reason = names[-1] if names else "a file", os.strerror(number)
    if number in _FULL:
        return f"The disk is full: {path} cannot be written ({reason}). Free some space, or choose another output_root."
    return f"{path} cannot be read or written ({reason}). Mend that, or choose another place, e.g. output_root."


def sentence(error: BaseException) -> str:
    """Return what to tell the user about an error."""
    if isinstance(error, ToolkitError):
        return str(error)
    if isinstance(error, KeyboardInterrupt):
        return "Interrupted. The same command goes on from here."
    if text := shortage(type(error).__name__, str(error)):
        return text
    if isinstance(error, OSError) and error.filename is not None:
        path = error.filename2 or error.filename
        return f"{path}: {error.strerror}. See that it can be read and written, or name another."
    return f"{BUG}{first_line(error)}. This is a bug."


def exit_code(error: BaseException) -> int:
    """Return what a command ends with: 1 what the user can mend, 2 an incomplete run, 3 a bug; 130 or 143 stopped."""
    if isinstance(error, KeyboardInterrupt):
        return 128 + int(error.args[0] if error.args else signal.SIGINT)  # the shells' convention
    if isinstance(error, IncompleteError):
        return 2
    if isinstance(error, ToolkitError):
        return 3 if isinstance(error, StageError) and error.internal else 1
    return 3 if sentence(error).startswith(BUG) else 1
