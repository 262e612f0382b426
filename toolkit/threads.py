"""The one place that limits threads, so that no result depends on their number.

BLAS splits a sum by its number of threads, and rounds differently for each. What computes poses, features or
descriptors therefore runs with one BLAS thread; images and queries are the parallel dimension.
"""

import ctypes
import threading
from collections.abc import Iterator
from contextlib import ContextDecorator, contextmanager, suppress

import cv2
from threadpoolctl import OpenBLASController, threadpool_limits


class _FixedSums(ContextDecorator):
    """Context and decorator in which BLAS uses one thread, whatever limit the caller has set.

    The limit is that of the process: it ends when the last of the threads that entered leaves.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entered = 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._entered:
                # Otherwise, a limit that a caller holds in another thread would silently outdo this one.
                OpenBLASController.clear_controlling_thread(force=True)
                self._limits = threadpool_limits(1, "blas")
            self._entered += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._entered -= 1
            if not self._entered:
                OpenBLASController.clear_controlling_thread(force=True)
                self._limits.restore_original_limits()


fixed_sums = _FixedSums()
"""`with fixed_sums:` or `@fixed_sums`, around everything whose numbers are kept or compared."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Let OpenCV, too, use one thread, where a loop over images or queries has a thread a core already."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with fixed_sums:
            yield
    finally:
        cv2.setNumThreads(threads)


def release_memory() -> None:
    """Return memory that threads have freed to the system: glibc keeps it. Other C libraries have no malloc_trim."""
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
