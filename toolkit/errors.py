"""Errors with messages for the user: what was found, where, what was expected, and what to do."""

import errno
import logging
import os
import re
import signal
import sys
import traceback
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path
from typing import Any, Self

import numpy as np

log = logging.getLogger(__name__)

COMMAND_VARIABLE = "TOOLKIT_COMMAND"
"""Environment variable that tells kernels and workers how the command line was called."""
_BY_MODULE = Path(sys.argv[0]).parts[-2:] == (Path(__file__).parent.name, "__main__.py")
COMMAND = "python -m toolkit" if _BY_MODULE else os.environ.get(COMMAND_VARIABLE, "visloc")
"""The command line in messages, by the name it was called by."""
INTERNAL = "internal: "
"""Prefix of the reason in a row that failed because of a bug of the toolkit; the next run tries the row again."""
_OF_THE_MACHINE = ("out of memory", "allocate memory", "insufficient memory", "not enough memory", "bad_alloc",
                   "cuda error", "device-side assert", "hip error", "cublas", "cudnn", "find an engine",
                   "invalid buffer size", "mps framework", "mps device")  # fmt: skip


class ToolkitError(Exception):
    """Base of all errors that the command line prints without a traceback."""

    @classmethod
    def at(cls, place: object, found: str = "", expected: str = "", do: str = "") -> Self:
        """Return the error `<place>: found <found>, expected <expected>. <do>`; empty parts are left out.

        `place` is a file and line, key, option or folder; `do` are sentences that say what to do.
        """
        parts = [f"found {found}" if found else "", f"expected {expected}" if expected else ""]
        said = ", ".join(part for part in parts if part)
        return cls(f"{place}: " + " ".join(text for text in (said and f"{said}.", do) if text))

    def _render_traceback_(self) -> list[str]:
        """Return what IPython shows of the error: its message, and the user's lines that led into the toolkit.

        The traceback goes to the log of a run. In a notebook, `traceback.print_last()` prints it.
        """
        log.debug("an error in a notebook", exc_info=self)
        frames, toolkit = traceback.extract_tb(self.__traceback__), str(Path(__file__).parent)
        lines = [
            f"  {frame.filename if Path(frame.filename).is_file() else 'cell'}, line {frame.lineno}: {frame.line}"
            for frame in takewhile(lambda frame: not frame.filename.startswith(toolkit), frames)
            if "site-packages" not in frame.filename  # IPython's own
        ]
        return [f"\x1b[31m{type(self).__name__}\x1b[0m: {self}", *lines]


class CaptureError(ToolkitError):
    """A capture folder or one of its files does not follow the format."""


class ManifestError(ToolkitError):
    """A manifest or a parameter is not valid."""


class ArtifactError(ToolkitError):
    """A file from an earlier stage is missing, damaged or made from other inputs."""


class DamagedError(ArtifactError):
    """Items of a file differ from what was written; see `store.items.retry_damaged`."""

    def __init__(self, path: Path, message: str) -> None:
        super().__init__(message)
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, str(self))


class ImageError(ToolkitError):
    """An image file is missing or cannot be decoded."""


class CameraError(ImageError):
    """A camera, or a camera's pose or turn, is invalid or does not fit the images."""


class WeightsError(ToolkitError):
    """Weights are missing, cannot be downloaded, are damaged, or belong to another network."""


class DownloadError(ToolkitError):
    """A capture, or a file of it, cannot be listed, downloaded, unpacked or moved into place."""


def reason_of(error: Exception, doing: str) -> str:
    """Return the reason why one query or image has no result, for its row; raise errors that concern all of them.

    An unreadable image or an unsolvable geometry is a result. A damaged file and errors of memory, disk or device are
    raised, because they do not depend on the query. Any other error is a bug of the toolkit (`INTERNAL`): its traceback
    is logged, other queries continue, and the row must not be recorded as done.

    Args:
        doing: the operation and the query, for the log.
    """
    if isinstance(error, ImageError | CaptureError | np.linalg.LinAlgError):
        return f"{type(error).__name__}: {error}"
    text = str(error).lower()
    if isinstance(error, ToolkitError | OSError | MemoryError) or any(words in text for words in _OF_THE_MACHINE):
        raise error
    log.error("%s: a bug of the toolkit; the next run tries it again", doing, exc_info=error)
    return INTERNAL + first_line(error)


def first_line(error: BaseException) -> str:
    """Return the type of an error and the first line of its message."""
    return f"{type(error).__name__}: {str(error).strip()}".split("\n")[0].rstrip(".")[:300]


class StageError(ToolkitError):
    """A stage failed; the message contains the error of the cell and the path of the executed notebook."""

    def __init__(self, message: str, of_the_data: bool = False, internal: bool = False) -> None:
        super().__init__(message)
        self.of_the_data = of_the_data
        """Whether the cause is the capture or a file made from it, so that other captures and pairs may succeed."""
        self.internal = internal
        """Whether the cause is a bug of the toolkit."""


class IncompleteError(ToolkitError):
    """A run completed, but with more failures than its manifest tolerates."""


BUG = "Internal error: "
OF_THE_DATA = (CaptureError, ArtifactError, ImageError)
"""Errors of a single session or pair; others can still be processed."""

FREE_MEMORY = "Free some, or run fewer devices or pairs at a time (`devices:`, `pairs:` in the manifest)."
_MEMORY = re.compile(
    r"MemoryError|OutOfMemory|out of memory|bad_alloc|(cannot|can't|unable to) allocate|insufficient memory"
    r"|can't start new thread", re.IGNORECASE
)  # fmt: skip
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NO_PLACE = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG}


def shortage(kind: str, text: str) -> str | None:
    """Return a sentence about a lack of memory, disk space or permission; None for other errors.

    Of the exception's name and its message; Python, HDF5, OpenCV, NumPy and torch word these differently.
    """
    if _MEMORY.search(f"{kind}: {text}"):
        detail = text.strip().splitlines()[0] if text.strip() else "no details"
        return f"Out of memory ({kind}: {detail}). {FREE_MEMORY}"
    match = re.search(r"\berrno[ =]+(\d+)", text, re.IGNORECASE)
    number = int(match[1]) if match else 0
    if number not in _FULL | _NO_PLACE:
        return None
    # HDF5 writes a path between apostrophes as it is; Python writes one with an apostrophe between quotation marks.
    names = re.findall(r"name = (')(.+?)',", text) or re.findall(r"""(['"])(.+?)\1""", text.partition("]")[2])
    path, reason = names[-1][1] if names else "a file", os.strerror(number)
    if number in _FULL:
        return f"The disk is full: {path} cannot be written ({reason}). Free some space, or choose another output_root."
    return f"{path} cannot be read or written ({reason}). Fix that, or choose another folder, e.g. output_root."


EXTRAS = {
    "notebook": ("papermill", "nbformat", "nbconvert", "jupyter_client", "jupyter_core", "jupyterlab", "IPython"),
    "viewer": ("rerun", "rerun_notebook"),
    "cluster": ("distributed", "dask_jobqueue"),
    "sequence": ("gtsam",),
    "learned": ("transformers",),
}
"""Packages that only a part of the toolkit needs, by the extra of `pyproject.toml` that brings them."""


def optional(package: str) -> Any:
    """Import and return a package of an extra; raise ManifestError that says how to install it."""
    try:
        return import_module(package)
    except ImportError as error:
        raise ManifestError(_not_installed(package, error)) from None


def require_packages(*packages: str) -> None:
    """Raise ManifestError if a package of an extra is not installed; none of them is imported."""
    for package in packages:
        if find_spec(package) is None:
            raise ManifestError(_not_installed(package, ImportError("not installed")))


def _not_installed(package: str, error: ImportError) -> str:
    extra = next(extra for extra, packages in EXTRAS.items() if package in packages)
    try:
        every = [text.replace('"', "'").partition(";") for text in requires("visual-localization") or ()]
        needed = [text.strip() for text, _, of in every if f"extra == '{extra}'" in of]
    except PackageNotFoundError:  # run from a folder, without having been installed
        needed = [package]
    install = " ".join(f"'{one}'" for one in needed if not one.startswith("visual-localization"))
    return f"The package {package} cannot be imported ({error}). To install the extra `{extra}`: pip install {install}"


def sentence(error: BaseException) -> str:
    """Return the message about an error for the user."""
    if isinstance(error, ToolkitError):
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        package = (error.name or "").partition(".")[0]
        if any(package in packages for packages in EXTRAS.values()):
            return _not_installed(package, error)
    if isinstance(error, KeyboardInterrupt):
        return "Interrupted. The same command goes on from here."
    if text := shortage(type(error).__name__, str(error)):
        return text
    if isinstance(error, OSError) and error.filename is not None:
        path = error.filename2 or error.filename
        return f"{path}: {error.strerror}. Make it readable and writable, or name another."
    return f"{BUG}{first_line(error)}. This is a bug."


def exit_code(error: BaseException) -> int:
    """Return the exit code of a command: 1 fixable by the user, 2 incomplete run, 3 bug, 130 or 143 interrupted."""
    if isinstance(error, KeyboardInterrupt):
        return 128 + int(error.args[0] if error.args else signal.SIGINT)  # the shells' convention
    if isinstance(error, IncompleteError):
        return 2
    if isinstance(error, ToolkitError):
        return 3 if isinstance(error, StageError) and error.internal else 1
    return 3 if sentence(error).startswith(BUG) else 1
