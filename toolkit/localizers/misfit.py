"""Detect wrong intrinsics of a query from the matches of its pose.

The pose absorbs most of the error: a wrong focal length changes the distance, a wrong principal point the rotation. A
pattern remains in the reprojection errors, as near and far points, image center and border, and the cameras of a rig
need different corrections. So pose and intrinsics are estimated together, as in bundle adjustment, and the result is
compared with the stated intrinsics.

Some scenes do not determine the intrinsics: for a plane that faces the camera, every focal length fits at some
distance. The standard deviation of the focal length is then so large that no difference is significant, and the stated
one is accepted.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from toolkit import geometry
from toolkit.capture.cameras import projection_jacobian
from toolkit.geometry import Floats
from toolkit.localizers.rig import Matches, RigQuery
from toolkit.localizers.robust import Bools

SIGNIFICANCE = 1e-4
"""False alarm rate: the probability that noise alone makes correct intrinsics look wrong."""
LEAST_SIZE = 0.01
"""Smallest misfit that makes a pose doubtful, relative to the distance of a pixel from the principal point.
Calibrations in the field are accurate to some tenths of a percent."""
SUSPICIOUS = 0.01  # largest probability of the first step (a cheap test) for which the full test runs
WIDENINGS = (8.0, 8.0, 4.0, 2.0)  # factors of the inlier limit in the first steps: wrong intrinsics enlarge errors
STEPS = 15
SETTLED_PX = 0.02  # largest motion of a projection in a step at which the fit has converged
LEAST_SCALE_PX = 0.5  # least scale of the Cauchy weights
PRIOR_STD = (0.2, 0.02, 0.02, 0.05)  # prior standard deviations of the four `Misfit.parameters`


@dataclass(frozen=True)
class Misfit:
    """Intrinsics that fit the matches of a pose significantly better than the stated ones."""

    shift: Floats
    """(6,) motion of the rig, in its own frame, to the pose with these intrinsics: rotation in radians, then
    translation in meters."""
    parameters: Floats
    """(C, 4) change of the intrinsics of each camera: relative change of the focal length; shift of the principal point
    in x and y, in focal lengths; and radial distortion, as the relative change of the distance from the principal point
    at an image corner."""
    sizes: Floats
    """(C, 3) effect of the changes of focal length, principal point and distortion: motion of the pixels of a camera
    over their distance from the principal point, root mean square; 0 if not significant."""

    @property
    def doubtful(self) -> bool:
        """Whether the misfit of a camera reaches `LEAST_SIZE`."""
        return bool(np.linalg.norm(self.sizes, axis=1).max() >= LEAST_SIZE)

    def focals_px(self, cameras: list[pycolmap.Camera]) -> tuple[float, ...]:
        """Return the focal length that fits each camera; NaN if something else or nothing misfits."""
        at_fault = (self.sizes[:, 0] > 0) & (self.sizes.argmax(axis=1) == 0)
        stated = np.array([camera.mean_focal_length() for camera in cameras])
        return tuple(np.where(at_fault, stated * (1 + self.parameters[:, 0]), np.nan).tolist())

    def reason(self, cameras: list[pycolmap.Camera]) -> str:
        """Return a text that compares, for each camera that misfits, the fitted and the stated value."""
        texts = []
        for number, (camera, change, sizes) in enumerate(zip(cameras, self.parameters, self.sizes, strict=True)):
            if not sizes.any():
                continue
            stated_px, (x, y) = camera.mean_focal_length(), (camera.principal_point_x, camera.principal_point_y)
            fitted_px, right_px, down_px = stated_px * (np.array([1, 0, 0]) + change[:3])
            text = (
                f"the focal length that fits is {fitted_px:.1f} px, its intrinsics say {stated_px:.1f} px",
                f"the principal point that fits is {x + right_px:.1f}, {y + down_px:.1f}, its intrinsics say "
                f"{x:.1f}, {y:.1f}",
                f"the radial distortion that fits moves the corners by {100 * change[3]:+.1f} % against its intrinsics",
            )[int(np.argmax(sizes))]
            texts.append(f"camera {number + 1} of {len(cameras)}: {text}" if len(cameras) > 1 else text)
        return "; ".join(texts)


def find_misfit(
    query: RigQuery,
    rig_from_world: Floats,
    matches: Matches,
    points: Floats,
    max_error_deg: float,
    focal_alone: bool = False,
) -> Misfit | None:
    """Return the intrinsics that fit significantly better than the stated ones; None if there are none.

    Gauss-Newton with Cauchy weights fits the pose and the focal lengths. Principal points and distortions are added if
    they improve the fit significantly. An F-test compares the errors with fewer and with more unknowns, each at its
    best pose.

    Args:
        query: the cameras.
        rig_from_world: the pose (4, 4) found with the stated intrinsics.
        matches: all matches from descriptors alone, inliers and outliers. Guided matches cannot be used: they were
            searched near the pose, so they agree with it even if it is wrong.
        points: (P, 3) the map points.
        max_error_deg: largest error of an inlier.
        focal_alone: keep principal points and distortions as stated; changing them can make wrong poses look correct.
    """
    problem = _Problem(query, matches, points, max_error_deg)
    which = np.arange(problem.unknowns)
    pose, all_unknowns = which < 6, which >= 0
    focal = ~pose & (which % 4 == 2)  # six unknowns of the pose come first, then four per camera
    start = _Estimate(rig_from_world, np.zeros(problem.unknowns - 6))
    first = problem.step(start, all_unknowns, WIDENINGS[0])
    if first is None or first.probability(first.change, ~pose) > SUSPICIOUS:
        return None
    stated = problem.fit(start, pose)
    if stated is None:
        return None
    chosen, free = stated, pose
    for unknowns in (pose | focal,) if focal_alone else (pose | focal, all_unknowns):
        fitted = problem.fit(start, unknowns)
        if fitted is not None and problem.by_chance(chosen, fitted, int((unknowns & ~free).sum())) < SIGNIFICANCE:
            chosen, free = fitted, unknowns
    last = problem.step(chosen, free, 1.0)
    if chosen is stated or last is None:
        return None
    changes, of_camera = np.concatenate([np.zeros(6), chosen.parameters]), (which - 6) // 4
    by_chance = [last.probability(changes, free & ~pose & (of_camera == index)) for index in range(len(query.cameras))]
    at_fault = np.array(by_chance) <= max(SIGNIFICANCE, min(by_chance))
    motion = rig_from_world @ geometry.invert(chosen.rig_from_world)
    shift = np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])
    return Misfit(shift, chosen.parameters.reshape(-1, 4), np.where(at_fault[:, None], problem.sizes(chosen), 0.0))


class _Estimate(NamedTuple):
    rig_from_world: Floats
    parameters: Floats
    """(4 C,) changes of the intrinsics, `Misfit.parameters` flattened."""


class _Step(NamedTuple):
    """A step of Gauss-Newton."""

    change: Floats
    """(U,) change of the unknowns."""
    largest_px: float
    """Largest weighted motion of a projection, per coordinate."""
    covariance: Floats
    """(U, U), 0 for unknowns that are not free."""
    freedom: int
    """Degrees of freedom."""

    def probability(self, values: Floats, tested: Bools) -> float:
        """Return the probability (F-test) that noise alone makes the tested ones of values (U,) this large."""
        values, covariance = values[tested], self.covariance[np.ix_(tested, tested)]
        squares = float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)
        return float(fdtrc(len(values), self.freedom, max(squares, 0.0) / len(values)))


class _Problem:
    """U unknowns, the pose and the intrinsics of a query, and the K matches to fit them to."""

    def __init__(self, query: RigQuery, matches: Matches, points: Floats, max_error_deg: float) -> None:
        self._query, self._matches, self._points = query, matches, points[matches.point]
        self._limits_px = np.tan(np.radians(max_error_deg)) * query.focals_px[matches.camera]
        self._prior = np.diag(np.concatenate([np.zeros(6), np.tile(1 / np.square(PRIOR_STD), len(query.cameras))]))
        self.unknowns = len(self._prior)

    def linearize(self, estimate: _Estimate) -> tuple[Floats, Floats]:
        """Return residuals (K, 2), infinite behind a camera, and the Jacobian (K, 2, U) of the projections."""
        residuals = np.full((len(self._matches), 2), np.inf)
        jacobian = np.zeros((len(self._matches), 2, self.unknowns))
        in_rig = geometry.transform(estimate.rig_from_world, self._points)
        for index, camera in enumerate(self._query.cameras):
            rows = np.flatnonzero(self._matches.camera == index)
            cam_from_rig = geometry.invert(self._query.rig_from_cams[index])
            in_cam = geometry.transform(cam_from_rig, in_rig[rows])
            projected = np.asarray(camera.img_from_cam(in_cam), np.float64).reshape(-1, 2)
            visible = (in_cam[:, 2] > 1e-3) & np.isfinite(projected).all(axis=1)
            rows, in_cam, projected = rows[visible], in_cam[visible], projected[visible]
            focal_px, changes = self._query.focals_px[index], estimate.parameters[4 * index : 4 * index + 4]
            offsets = projected - (camera.principal_point_x, camera.principal_point_y)
            corner_px2 = (camera.width**2 + camera.height**2) / 4
            of_intrinsics = np.zeros((len(rows), 2, 4))
            of_intrinsics[:, :, 0] = offsets
            of_intrinsics[:, 0, 1] = of_intrinsics[:, 1, 2] = focal_px
            of_intrinsics[:, :, 3] = offsets * ((offsets**2).sum(axis=1) / corner_px2)[:, None]
            residuals[rows] = self._matches.pixels[rows] - projected - of_intrinsics @ changes
            of_point = projection_jacobian(in_cam, np.full(len(rows), focal_px * (1 + changes[0])))
            of_point = of_point @ cam_from_rig[:3, :3]  # with the point in the rig frame
            # A motion of the rig moves a point in it by -(rotation x point) - translation.
            jacobian[rows, :, :3] = np.cross(of_point, in_rig[rows, None])
            jacobian[rows, :, 3:6] = -of_point
            jacobian[rows, :, 6 + 4 * index : 10 + 4 * index] = of_intrinsics
        return residuals, jacobian

    def step(self, estimate: _Estimate, free: Bools, widening: float) -> _Step | None:
        """Return the next step of the free unknowns (U,); None if the matches do not determine them.

        Inliers have errors up to `widening` times the limit.
        """
        residuals, jacobian = self.linearize(estimate)
        errors = np.linalg.norm(residuals, axis=1)
        inliers = errors < widening * self._limits_px
        freedom = 2 * int(inliers.sum()) - int(free.sum())
        if freedom < 1:
            return None
        errors = errors[inliers]
        # Square roots of the Cauchy weights.
        roots = 1 / np.sqrt(1 + (errors / max(float(np.median(errors)), LEAST_SCALE_PX)) ** 2)
        weighted = roots[:, None, None] * jacobian[inliers][:, :, free]
        residuals = roots[:, None] * residuals[inliers]
        variance = float((residuals**2).sum()) / freedom
        prior = self._prior[np.ix_(free, free)]
        flat = weighted.reshape(-1, weighted.shape[2])
        information = flat.T @ flat + variance * prior
        if np.linalg.cond(information) > 1e14:
            return None
        inverse = np.linalg.inv(information)
        so_far = np.concatenate([np.zeros(6), estimate.parameters])[free]
        solved = inverse @ (flat.T @ residuals.ravel() - variance * (prior @ so_far))
        if not np.isfinite(solved).all():
            return None
        change, covariance = np.zeros(self.unknowns), np.zeros((self.unknowns, self.unknowns))
        change[free], covariance[np.ix_(free, free)] = solved, variance * inverse
        return _Step(change, float(np.abs(flat @ solved).max()), covariance, freedom)

    def fit(self, start: _Estimate, free: Bools) -> _Estimate | None:
        """Return the estimate at the minimum; each step selects inliers again. None if there is no minimum."""
        estimate = start
        for number in range(STEPS):
            step = self.step(estimate, free, WIDENINGS[number] if number < len(WIDENINGS) else 1.0)
            if step is None:
                return None
            motion = geometry.make_pose(Rotation.from_rotvec(step.change[:3]).as_matrix(), step.change[3:6])
            estimate = _Estimate(
                geometry.invert(motion) @ estimate.rig_from_world, estimate.parameters + step.change[6:]
            )
            if number >= len(WIDENINGS) and step.largest_px < SETTLED_PX:
                break
        return estimate

    def by_chance(self, fewer: _Estimate, more: _Estimate, added: int) -> float:
        """Return the probability (F-test) that an estimate with `added` more unknowns is better by chance alone.

        An error counts by its logarithmic (Cauchy) cost, and no more than an error at the limit of an inlier.
        """
        errors = [np.linalg.norm(self.linearize(estimate)[0], axis=1) for estimate in (fewer, more)]
        inliers = np.minimum(*errors) < self._limits_px  # of at least one of the two
        before, after = (np.minimum(error, self._limits_px)[inliers] for error in errors)
        freedom = 2 * len(after) - self.unknowns
        if freedom < 1:
            return 1.0
        scale = max(float(np.median(after)), LEAST_SCALE_PX)
        costs = [float(np.log1p((error / scale) ** 2).sum()) for error in (before, after)]
        prior = [float(np.diagonal(self._prior)[6:] @ estimate.parameters**2) / 2 for estimate in (fewer, more)]
        gain = costs[0] + prior[0] - costs[1] - prior[1]
        return float(fdtrc(added, freedom, max(gain, 0.0) / added / (costs[1] / freedom)))

    def sizes(self, estimate: _Estimate) -> Floats:
        """Return `Misfit.sizes` (C, 3)."""
        residuals, jacobian = self.linearize(estimate)
        inliers = np.linalg.norm(residuals, axis=1) < self._limits_px
        sizes = np.zeros((len(self._query.cameras), 3))
        for index, changes in enumerate(estimate.parameters.reshape(-1, 4)):
            rows = inliers & (self._matches.camera == index)
            of_intrinsics = jacobian[rows][:, :, 6 + 4 * index : 10 + 4 * index]
            distances = max(float(np.linalg.norm(of_intrinsics[:, :, 0])), 1e-12)
            for kind, columns in enumerate(([0], [1, 2], [3])):
                sizes[index, kind] = np.linalg.norm(of_intrinsics[:, :, columns] @ changes[columns]) / distances
        return sizes
