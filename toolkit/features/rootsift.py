"""Shorten RootSIFT descriptors to half of their length without losing matches.

A descriptor is a 4 x 4 x 8 array: rows and columns of cells, and directions. Its cosine transform over rows and columns
and Fourier transform over directions decorrelate it nearly as well as principal components, and need no training. The
64 components with the largest standard deviation are kept. Each is divided by the square root of its standard
deviation, halfway to whitening, so that the few strong components do not outweigh the others.
With the same ratio test, shortened and full descriptors give equally many right matches, and equally many wrong ones
(STRECHA and STRECHA_HARD, 378 pairs of query and reference each).

Components and shortened descriptors are multiples of `STEP`, so that float32 holds their products and sums without
rounding: scores, and so matches, are the same for every number of threads and every kernel of BLAS.
"""

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import rounded, unit

LENGTH = 64  # length of a shortened descriptor
STEP = 2**-11
# Measured on 20 photographs that are not in STRECHA or STRECHA_HARD, whose deviations differ by 5 %.
_DEVIATIONS = np.array([
    [[74, 140, 116, 152, 105, 49, 40, 56], [95, 124, 67, 95, 72, 41, 33, 30],
     [54, 107, 44, 68, 44, 36, 25, 24], [29, 94, 24, 36, 29, 23, 18, 16]],
    [[71, 57, 108, 91, 78, 32, 35, 26], [51, 65, 72, 51, 54, 26, 27, 19],
     [30, 63, 52, 42, 42, 22, 24, 16], [21, 47, 27, 23, 25, 15, 16, 11]],
    [[48, 36, 87, 50, 41, 25, 25, 18], [33, 42, 65, 38, 35, 21, 21, 15],
     [27, 42, 46, 28, 29, 18, 17, 14], [16, 46, 25, 19, 20, 14, 12, 11]],
    [[25, 19, 60, 30, 30, 16, 19, 13], [19, 21, 47, 22, 23, 14, 15, 11],
     [16, 21, 41, 19, 22, 12, 14, 10], [14, 18, 21, 12, 16, 11, 10, 9]],
]) / 1000  # fmt: skip
"""Standard deviations of the components: frequency along the first and the second axis of the cells, and directions
(mean; cosine and sine of one, two and three periods; cosine of four)."""


def _components() -> NDArray[np.float32]:
    """Return the matrix (128, `LENGTH`) from descriptors to weighted components."""
    along_cells = unit(np.cos(np.pi / 4 * np.outer(np.arange(4), np.arange(4) + 0.5)))
    angles = 2 * np.pi * np.arange(8) / 8
    waves = [wave(periods * angles) for periods in (1, 2, 3) for wave in (np.cos, np.sin)]
    directions = unit(np.stack([np.ones(8), *waves, np.cos(4 * angles)]))
    components = np.einsum("ai,bj,ck->abcijk", along_cells, along_cells, directions).reshape(128, 128)
    kept = np.argsort(-_DEVIATIONS, axis=None, kind="stable")[:LENGTH]
    weighted = components[kept] / np.sqrt(_DEVIATIONS.reshape(-1)[kept, None])
    return rounded(weighted, STEP).T


_COMPONENTS = _components()


def rootsift_64(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return RootSIFT descriptors (N, 128) as unit vectors (N, `LENGTH`).

    Imported features of an unknown kind may have descriptors of another length; they stay as they are. The name of this
    function is part of the fingerprint of matches: rename it if it returns other vectors.
    """
    if descriptors.shape[1] != len(_COMPONENTS):
        return descriptors
    shortened = descriptors @ _COMPONENTS
    # In float64, the squares and their sums are exact, too.
    steps = 1 / (STEP * np.sqrt(np.einsum("nd,nd->n", shortened, shortened, dtype=np.float64)).clip(1e-12))
    return np.asarray(np.rint(shortened * steps[:, None].astype(np.float32)) * STEP)
