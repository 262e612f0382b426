"""The robust mean of several hypotheses of one pose, such as those of the cameras of a rig."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.alignment.robust import AlignmentError, Bools, listed, rigid_poses
from toolkit.geometry import Floats

_GATE = 3.0  # standard deviations per axis; hypotheses further from the mean are outliers
_TOO_SMALL = 2.0  # factor by which stated standard deviations are often too small


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
        world_from_cams: (H, 4, 4); hypotheses that are not finite are left out.
        covariances: (H, 6, 6), see `PoseMean.covariance`. A common factor of at least 1 widens them to explain the
            spread.

    Raises:
        AlignmentError: there is no hypothesis, a shape is wrong, a matrix is not a rigid pose, or a covariance is not
            positive definite; gives the index.
    """
    poses, finite = rigid_poses(world_from_cams, "world_from_cams")
    usable = np.flatnonzero(finite)
    if not len(usable):
        raise AlignmentError(f"None of {len(poses)} hypotheses is finite: expected at least one.")
    information = _information(covariances, len(poses))
    notes = [] if finite.all() else [f"hypotheses {listed(~finite)} left out: not finite"]
    pose, covariance, inside = _mean(poses[usable], information[usable])
    consistent, left_out = np.zeros(len(poses), bool), np.zeros(len(poses), bool)
    consistent[usable], left_out[usable] = inside, ~inside
    if left_out.any():
        notes.append(f"hypotheses {listed(left_out)} left out: far from the others")
        rivals = int(_mean(poses[left_out], information[left_out])[2].sum())
        if rivals > 0.9 * inside.sum():
            notes.append(f"{int(inside.sum())} hypotheses agree, and {rivals} others elsewhere: undecided")
            covariance = np.diag(np.full(6, np.inf))
    return PoseMean(pose, covariance, consistent, "; ".join(notes))


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


def _information(covariances: ArrayLike, count: int) -> Floats:
    matrices = np.asarray(covariances, np.float64)
    if matrices.shape != (count, 6, 6):
        raise AlignmentError(f"covariances has shape {matrices.shape}: expected ({count}, 6, 6).")
    for index, matrix in enumerate(matrices):
        if not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix).min() <= 0:
            raise AlignmentError(f"covariances[{index}] is not finite and positive definite.")
    return np.asarray(np.linalg.inv(matrices), np.float64)
