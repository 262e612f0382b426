"""What is computed depends on no number of threads, and features, vocabularies and matches on no BLAS kernel.

`make test-kernels` runs the tests of numbers under other kernels and numbers of threads, too.
"""

import os
import subprocess
import sys
import threading
from contextlib import suppress

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from toolkit.threads import fixed_sums, one_thread


def blas_threads() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_sums_are_fixed_within_and_the_limit_of_the_caller_holds_after() -> None:
    with threadpool_limits(2, "blas"):
        before = blas_threads()
        with suppress(ValueError), fixed_sums:
            with fixed_sums:
                pass
            assert blas_threads() == {1}, "the outer one is still entered"
            raise ValueError
        assert blas_threads() == before != {1}


def test_the_limit_ends_with_the_last_thread_that_entered() -> None:
    entered, leave, seen = threading.Event(), threading.Event(), list[set[int]]()

    def stay() -> None:
        with fixed_sums:
            entered.set()
            leave.wait()
            seen.append(blas_threads())

    with threadpool_limits(2, "blas"):
        other = threading.Thread(target=stay)
        other.start()
        entered.wait()
        with fixed_sums:
            pass
        leave.set()
        other.join()
        assert seen == [{1}], "another thread that left must not end the limit"
        assert blas_threads() != {1}


def test_one_thread_each_and_then_as_before() -> None:
    def threads() -> list[int]:
        blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
        return [cv2.getNumThreads(), *blas]

    cv2_threads = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with threadpool_limits(2, "blas"):
            before = threads()
            inside = []
            with suppress(ValueError), one_thread():
                inside = threads()
                raise ValueError
            assert set(inside) == {1}
            assert threads() == before
            assert max(before) == 2
    finally:
        cv2.setNumThreads(cv2_threads)


NUMBERS = """
import hashlib
import cv2, numpy as np
from threadpoolctl import threadpool_limits
from toolkit.embedders import vlad
from toolkit.features.features import KINDS, MutualMatcher
from toolkit.features.features import SiftExtractor

vlad.MAX_WORDS = 32
rng = np.random.default_rng(0)
noise = [cv2.GaussianBlur(rng.integers(0, 256, (240, 320), np.uint8), (0, 0), 2.0) for _ in range(3)]
for threads in 1, 2:
    with threadpool_limits(threads, "blas"):
        images = SiftExtractor().extract([*noise, np.roll(noise[0], 9, axis=1)])
        learned = vlad.Vlad.learn(lambda: iter(images), len(images))
        matches = MutualMatcher.of(KINDS["sift"]).match([(images[0], images[3])])[0]
        whitened = learned._whitened(images[0].descriptors / np.float32(512))
    arrays = [images[0].keypoints, images[0].descriptors, learned.centroids, learned.local_projection, whitened,
              matches.indices, matches.scores]
    digests = [hashlib.sha1(np.ascontiguousarray(array)).hexdigest()[:8] for array in arrays]
    print(len(matches.indices), *digests)
"""


def numbers(kernel: str) -> list[str]:
    """Return how many matches there are and digests of what was computed, one line for one BLAS thread, one for two."""
    environment = os.environ | {"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "2"}
    command = [sys.executable, "-c", NUMBERS]
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.splitlines()


@pytest.mark.slow
@pytest.mark.skipif(np.__config__.show("dicts")["Machine Information"]["host"]["cpu"] != "x86_64", reason="x86 kernels")
def test_features_vocabulary_and_matches_are_the_same_for_every_kernel_and_number_of_threads() -> None:
    expected, *others = numbers("Haswell") + numbers("Prescott")
    assert int(expected.split()[0]) > 100
    assert others == [expected] * 3, "Haswell, 2 threads; Prescott, 1 and 2"
