"""Robust pose estimation: checks of input, the noise prior, the nearest rotation, the mean of poses of one camera."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.errors import ToolkitError
from toolkit.geometry import Floats

Bools = NDArray[np.bool_]

NOISE_FACTOR = np.log(2.5)  # standard deviation of the log-normal prior of the noise, as a logarithm
_LEVELS = np.exp(np.linspace(-3.5, 3.5, 29))  # ratios of actual to expected noise, integrated over
_GATE = 3.0  # standard deviations per axis; hypotheses further from the mean are outliers
_TOO_SMALL = 2.0  # factor by which stated standard deviations are often too small


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

    Raise AlignmentError for a wrong shape, or a finite matrix that is not a rigid pose; gives `name` and the index.
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
        do = "Remove a scale or a flip of axes first."
        raise AlignmentError(f"{name}[{bad[0]}] {what}: expected a rigid pose, orthonormal to 1e-3. {do}")
    matrices[:, :3, :3] = nearest_rotation(R)
    return matrices, finite


def checked_weights(weights: ArrayLike | None, count: int) -> Floats:
    """Return weights (count,), all 1 for None.

    Raise AlignmentError for a wrong shape, or a weight that is negative or not finite.
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


@dataclass(frozen=True)
class PoseMean:
    """The mean of several hypotheses of one pose."""

    world_from_cam: Floats
    """(4, 4)"""
    covariance: Floats
    """(6, 6) of d in world_from_cam @ Exp(d): rotation in radians, then translation in meters, in the camera frame.
    Infinite on the diagonal if as many hypotheses agree on another pose."""
    consistent: Bools
    """(H,) hypotheses that agree with the mean."""
    reason: str
    """What was left out or is unknown; may be empty."""


def robust_mean_pose(world_from_cams: ArrayLike, covariances: ArrayLike) -> PoseMean:
    """Return the robust mean of pose hypotheses on SE(3), and its covariance.

    The hypotheses are taken as independent. The start is the hypothesis closest to all of them. Iteratively reweighted
    least squares in its tangent space refine it, with Huber weights within the gate and 0 beyond.

    Args:
        world_from_cams: (H, 4, 4), finite rigid poses, at least one.
        covariances: (H, 6, 6), positive definite, see `PoseMean.covariance`. A common factor of at least 1 widens them
            to explain the spread.
    """
    poses, information = np.array(world_from_cams, np.float64), np.linalg.inv(np.asarray(covariances, np.float64))
    poses[:, :3, :3] = nearest_rotation(poses[:, :3, :3])
    pose, covariance, inside = _mean(poses, information)
    notes = []
    if not inside.all():
        notes.append(f"hypotheses {listed(~inside)} left out: far from the others")
        rivals = int(_mean(poses[~inside], information[~inside])[2].sum())
        if rivals > 0.9 * inside.sum():
            notes.append(f"{int(inside.sum())} hypotheses agree, and {rivals} others elsewhere: undecided")
            covariance = np.diag(np.full(6, np.inf))
    return PoseMean(pose, covariance, inside, "; ".join(notes))


def _mean(poses: Floats, information: Floats) -> tuple[Floats, Floats, Bools]:
    """Return the mean (4, 4) of poses (H, 4, 4), its covariance (6, 6) and which hypotheses agree (H,)."""

    def distances(errors: Floats) -> Floats:
        """Return distances (H,) in standard deviations per axis of errors (H, 6)."""
        return np.sqrt(np.einsum("hi,hij,hj->h", errors, information, errors) / 6 / _TOO_SMALL**2)

    # The geodesic median among the hypotheses; distances beyond the gate count as equal.
    motions = (geometry.small_motions(geometry.invert(start) @ poses) for start in poses)
    costs = [np.minimum(distances(errors), _GATE).sum() for errors in motions]
    mean = poses[int(np.argmax(np.array(costs) < min(costs) + 1e-12))]
    for _ in range(30):
        errors = geometry.small_motions(geometry.invert(mean) @ poses)
        distance = distances(errors)
        inside = distance <= _GATE
        if not inside.any():
            inside = distance == distance.min()
        share = np.where(inside, np.minimum(1.0, 2.0 / np.maximum(distance, 1e-12)), 0.0)
        joint = np.einsum("h,hij->ij", share, information)
        step = np.linalg.solve(joint, np.einsum("h,hij,hj->i", share, information, errors))
        mean = mean @ geometry.make_pose(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])
        if np.abs(step).max() < 1e-13:
            break
    free = 6 * (int(inside.sum()) - 1)
    squared = np.einsum("h,hi,hij,hj->", share, errors, information, errors)
    return mean, np.linalg.inv(joint) * max(1.0, squared / free if free else 1.0), inside
