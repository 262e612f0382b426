"""Common parts of robust pose estimation: input checks, the noise prior, the nearest rotation."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import ToolkitError
from toolkit.geometry import Floats

Bools = NDArray[np.bool_]

NOISE_FACTOR = np.log(2.5)  # standard deviation of the log-normal prior of the noise, as a logarithm
_LEVELS = np.exp(np.linspace(-3.5, 3.5, 29))  # ratios of actual to expected noise, integrated over


class AlignmentError(ToolkitError):
    """Invalid poses, weights or depth ratios."""


def noise_variance(squares: ArrayLike, free: ArrayLike, expected: float) -> Floats:
    """Return the posterior mean of the noise variance per axis, (...).

    It is the mean and not the mode, as the variance of an estimate is proportional to it.

    Args:
        squares: (...) sums of squared residuals.
        free: (...) their degrees of freedom.
        expected: standard deviation of the noise around which its prior is log-normal, within a factor of
            exp(NOISE_FACTOR).
    """
    squares, free = np.asarray(squares)[..., None], np.asarray(free)[..., None]
    logs = np.log(_LEVELS)
    log_density = -((logs / NOISE_FACTOR) ** 2) / 2 - free * logs - squares / (2 * (expected * _LEVELS) ** 2)
    density = np.exp(log_density - log_density.max(axis=-1, keepdims=True))
    return np.asarray(expected**2 * (density @ _LEVELS**2) / density.sum(axis=-1))


def nearest_rotation(matrices: Floats, keep: Floats | None = None) -> Floats:
    """Return rotations R (K, 3, 3) that maximize trace(R^T M) for matrices M (Umeyama 1991); `keep` where M is 0."""
    U, values, Vt = np.linalg.svd(matrices)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    rotations = U @ Vt
    if keep is not None:
        rotations = np.where((values[..., 0] > 0)[..., None, None], rotations, keep)
    return np.asarray(rotations, np.float64)


def rigid_poses(poses: ArrayLike, name: str) -> tuple[Floats, Bools]:
    """Return poses (M, 4, 4) with exact rotations, and which of them are finite; the other ones become identities.

    Raises:
        AlignmentError: a wrong shape, or a finite matrix that is not a rigid pose; gives `name` and the index.
    """
    matrices = np.array(poses, np.float64)
    if matrices.size == 0 and matrices.shape[:1] == (0,):
        matrices = matrices.reshape(0, 4, 4)
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise AlignmentError(f"{name} has shape {matrices.shape}: expected (M, 4, 4).")
    finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2)), np.bool_)
    matrices[~finite] = np.eye(4)
    R = matrices[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    last = np.abs(matrices[:, 3] - [0, 0, 0, 1]).max(axis=1)
    bad = np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0) | (last > 1e-6))
    if len(bad):
        mirrored = np.linalg.det(R[bad[0]]) < 0
        what = "is mirrored (determinant below 0)" if mirrored else "is not a rotation and a translation"
        raise AlignmentError(
            f"{name}[{bad[0]}] {what}: expected a rigid pose with a rotation orthonormal to 1e-3. "
            "Remove a scale or a flip of axes first."
        )
    matrices[:, :3, :3] = nearest_rotation(R)
    return matrices, finite


def checked_weights(weights: ArrayLike | None, count: int) -> Floats:
    """Return weights (count,), all 1 for None.

    Raises:
        AlignmentError: a wrong shape, or a weight that is negative or not finite.
    """
    if weights is None:
        return np.ones(count)
    values = np.asarray(weights, np.float64)
    if values.shape != (count,):
        raise AlignmentError(f"weights has shape {values.shape}: expected ({count},), one per camera.")
    bad = np.flatnonzero(~np.isfinite(values) | (values < 0))
    if len(bad):
        raise AlignmentError(f"weights[{bad[0]}] is {values[bad[0]]}: expected a finite number, 0 or more.")
    return values


def listed(chosen: Bools) -> str:
    """Return the chosen indices as text for a message."""
    return ", ".join(str(index) for index in np.flatnonzero(chosen))
