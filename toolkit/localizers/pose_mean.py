"""The mean of several hypotheses of one pose, robustly: what the cameras of a rig say of it together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.localizers.alignment import AlignmentError, checked_weights, listed, noise_variance, rigid_poses

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class PoseMean:
    """The mean of several hypotheses of one pose."""

    world_from_cam: Floats
    """(4, 4)"""
    covariance: Floats
    """(6, 6) of world_from_cam @ Exp(d), d = rotation, radians, then translation, meters, in the camera's frame;
    infinite on the diagonal where as many hypotheses say something else."""
    inliers: Bools
    """(H,)"""
    reason: str
    """What was left out or is unknown; empty if nothing."""


def robust_mean_pose(
    world_from_cams: ArrayLike,
    weights: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    *,
    center_noise_m: float = 0.05,
    rotation_noise_deg: float = 1.0,
    gate: float = 3.0,
) -> PoseMean:
    """Return the mean of hypotheses of a pose on SE(3), robustly, and its covariance.

    The hypotheses count as independent. Each in turn is a start; the one with the most others near it, refined by
    iteratively reweighted least squares in its tangent space (Huber within the gate, none beyond), is kept. Noise is
    estimated from the spread of those kept.

    Args:
        world_from_cams: (H, 4, 4). One that is not finite is left out.
        weights: (H,) relative confidence, not negative; 0 leaves out.
        covariances: (H, 6, 6) in the convention of `PoseMean.covariance`. Together they are widened, never
            narrowed, to explain the spread. Without them the two noises below are estimated from the spread.
        center_noise_m: noise expected of a hypothesis, as a length, where there are no covariances.
        rotation_noise_deg: noise expected, as an angle, likewise.
        gate: hypotheses further from the mean, in standard deviations by axis, are left out.

    Raises:
        AlignmentError: no hypothesis, a wrong shape, a matrix that is not a rigid pose or a covariance that is not
            positive definite (its index is named), a negative weight.
    """
    poses, finite = rigid_poses(world_from_cams, "world_from_cams")
    weight = checked_weights(weights, len(poses))
    usable = np.flatnonzero(finite & (weight > 0))
    if not len(usable):
        raise AlignmentError(f"None of {len(poses)} hypotheses is finite and has a weight: expected at least one.")
    notes = [f"hypotheses {listed(~finite)} left out: not finite"] if not finite.all() else []
    information = _information(covariances, len(poses))
    problem = _Mean(
        poses[usable],
        weight[usable] / weight[usable].mean(),
        None if information is None else information[usable],
        (center_noise_m / np.sqrt(3), np.radians(rotation_noise_deg) / np.sqrt(3)),
        gate,
    )
    pose, covariance, inside = problem.solve()
    inliers = np.zeros(len(poses), bool)
    inliers[usable[inside]] = True
    if not inside.all():
        others = problem.subset(~inside)
        rival = others.solve()[2]
        left_out = np.zeros(len(poses), bool)
        left_out[usable[~inside]] = True
        notes.append(f"hypotheses {listed(left_out)} left out: far from the others")
        if others.weight[rival].sum() > 0.9 * problem.weight[inside].sum():
            notes.append(f"{int(inside.sum())} hypotheses agree, and {int(rival.sum())} others elsewhere: undecided")
            covariance = np.diag(np.full(6, np.inf))
    return PoseMean(pose, covariance, inliers, "; ".join(notes))


class _Mean:
    """Hypotheses of one pose (H, 4, 4) with weights (H,) and information (H, 6, 6) or None."""

    def __init__(
        self, poses: Floats, weight: Floats, information: Floats | None, prior: tuple[float, float], gate: float
    ):
        self.poses, self.weight, self.information, self.prior, self.gate = poses, weight, information, prior, gate

    def subset(self, kept: Bools) -> _Mean:
        information = None if self.information is None else self.information[kept]
        return _Mean(self.poses[kept], self.weight[kept], information, self.prior, self.gate)

    def solve(self) -> tuple[Floats, Floats, Bools]:
        """Return the mean (4, 4), its covariance (6, 6) and the hypotheses kept (H,)."""
        wide = np.array([self.prior[1] * 3] * 3 + [self.prior[0] * 3] * 3)
        best: tuple[float, Floats] | None = None
        for start in self.poses:  # the weighted geodesic median among the hypotheses, with far ones all equally far
            squared = self._squared(_log(geometry.invert(start) @ self.poses), wide)
            cost = float(self.weight @ np.minimum(np.sqrt(squared), self.gate))
            if best is None or cost < best[0] - 1e-12:
                best = cost, start
        assert best is not None
        mean, noise = best[1], wide
        for _ in range(30):
            error = _log(geometry.invert(mean) @ self.poses)
            distance = np.sqrt(self._squared(error, noise))
            inside = distance <= self.gate
            if not inside.any():
                inside = distance == distance.min()
            huber = np.minimum(1.0, 2.0 / np.maximum(distance, 1e-12))
            share = np.where(inside, huber * self.weight, 0.0)
            information = np.einsum("h,hij->ij", share, self._matrices(noise))
            step = np.linalg.solve(information, np.einsum("h,hij,hj->i", share, self._matrices(noise), error))
            mean = mean @ _exp(step)
            noise = self._noise(error - step, share, inside, noise)
            if np.abs(step).max() < 1e-13:
                break
        covariance = np.linalg.inv(information)
        if self.information is not None:
            free = 6 * (int(inside.sum()) - 1)
            squared = np.einsum("h,hi,hij,hj->", share, error, self.information, error)
            covariance = covariance * max(1.0, squared / free if free else 1.0)
        return mean, covariance, inside

    def _matrices(self, noise: Floats) -> Floats:
        if self.information is not None:
            return self.information
        return np.broadcast_to(np.diag(1 / noise**2), (len(self.poses), 6, 6))

    def _squared(self, error: Floats, noise: Floats) -> Floats:
        """Return squared distances (H,), 1 for one standard deviation along one axis, of errors (H, 6)."""
        if self.information is not None:
            # Covariances that are twice too small, as standard deviations, are common, and widened in the end.
            return np.einsum("hi,hij,hj->h", error, self.information, error) * self.weight / 6 / 2**2
        return self.weight * ((error / noise) ** 2).reshape(-1, 2, 3).mean(axis=2).max(axis=1)

    def _noise(self, error: Floats, share: Floats, inside: Bools, noise: Floats) -> Floats:
        free = 3.0 * (int(inside.sum()) - 1)
        squares = share @ error**2
        rotation = np.sqrt(noise_variance(squares[:3].sum(), free, self.prior[1]))
        center = np.sqrt(noise_variance(squares[3:].sum(), free, self.prior[0]))
        return np.array([rotation] * 3 + [center] * 3)


def _log(poses: Floats) -> Floats:
    """Return rotation vectors and translations (H, 6) of small poses: SO(3) x R^3, the same to first order."""
    return np.hstack([Rotation.from_matrix(poses[:, :3, :3]).as_rotvec(), poses[:, :3, 3]])


def _exp(step: Floats) -> Floats:
    return geometry.make_pose(Rotation.from_rotvec(step[:3]).as_matrix(), step[3:])


def _information(covariances: ArrayLike | None, count: int) -> Floats | None:
    if covariances is None:
        return None
    matrices = np.asarray(covariances, np.float64)
    if matrices.shape != (count, 6, 6):
        raise AlignmentError(f"covariances has shape {matrices.shape}: expected ({count}, 6, 6).")
    for index, matrix in enumerate(matrices):
        if not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix).min() <= 0:
            raise AlignmentError(f"covariances[{index}] is not finite and positive definite.")
    return np.asarray(np.linalg.inv(matrices), np.float64)
