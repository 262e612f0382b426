"""Errors whose message is meant for the user: what was found, where, what was expected, what to do."""

import logging
from pathlib import Path

import numpy as np

log = logging.getLogger(__name__)

INTERNAL = "internal: "
"""Before the reason of a row that is there for a fault of the toolkit: the next run tries it again."""
_OF_THE_MACHINE = ("out of memory", "allocate memory", "insufficient memory", "not enough memory", "bad_alloc",
                   "cuda error", "device-side assert")  # fmt: skip


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
