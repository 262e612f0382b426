"""Decode images, with errors that say whether a file is missing or unreadable."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.errors import ImageError

T = TypeVar("T")
R = TypeVar("R")


def read_image(path: str | Path, gray: bool = False) -> NDArray[np.uint8]:
    """Return an image as stored, (H, W, 3) RGB uint8, or (H, W) where `gray`.

    EXIF orientation is not applied: a capture's intrinsics belong to the pixels as they are in the file.

    Raises:
        ImageError: the file is missing, or is not an image that can be decoded.
    """
    path = Path(path)
    flags = (cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR) | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        data = np.fromfile(path, np.uint8)
    except FileNotFoundError:
        raise ImageError(f"Image not found: {path}") from None
    except OSError as error:
        raise ImageError(f"Image cannot be read: {path} ({error})") from None
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise ImageError(f"Image cannot be decoded ({data.size} bytes; expected a whole JPEG or PNG): {path}")
    return np.asarray(image if gray else image[:, :, ::-1], np.uint8)


def pixels_of(image: str | Path | NDArray[np.uint8], gray: bool = False) -> NDArray[np.uint8]:
    """Return the pixels of a file, see `read_image`, or those given, (H, W) or (H, W, 3) RGB, in gray or in color.

    Raises:
        ImageError: the file is missing or cannot be decoded, or pixels of another shape or type.
    """
    if isinstance(image, str | Path):
        return read_image(image, gray)
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise ImageError(f"Found pixels {image.shape} {image.dtype}: expected (H, W) or (H, W, 3) uint8.")
    if gray == (image.ndim == 2):
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY if gray else cv2.COLOR_GRAY2RGB), np.uint8)


def read_for_display(path: str | Path) -> NDArray[np.uint8]:
    """Return an image, (H, W, 3) RGB; a gray image with the text `unreadable` if it cannot be read."""
    try:
        return read_image(path)
    except ImageError:
        blank = np.full((240, 320, 3), 200, np.uint8)
        cv2.putText(blank, "unreadable", (60, 130), cv2.FONT_HERSHEY_SIMPLEX, 1.1, (90, 90, 90), 2)
        return blank


def default_workers() -> int:
    """Return the default number of threads: the available cores, at most 8."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, 8)


def prefetch(function: Callable[[T], R], items: Iterable[T], workers: int = 2, ahead: int = 4) -> Iterator[R]:
    """Yield `function(item)` in order while `workers` threads work on the next ones, at most `ahead` of them.

    Memory stays bounded however long `items` is. Meant for functions that release the interpreter lock (decoding, SIFT,
    RANSAC). An exception of `function` is raised when its item's turn comes.
    """
    pool = ThreadPoolExecutor(workers)
    pending: deque[Future[R]] = deque()
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > workers + ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        for future in pending:
            future.cancel()
        pool.shutdown(wait=True)
