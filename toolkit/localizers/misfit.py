"""Tell from the matches of a pose whether the cameras of a query are what their intrinsics say.

A wrong focal length mostly hides in a wrong distance, a wrong principal point in a rotation. What is left is a pattern
in the errors, because near and far points, the middle and the border, and the cameras of a rig ask for different
amends. So the intrinsics are estimated along with the pose, as bundle adjustment does, and compared with the stated.

What matches cannot tell stays unsaid: in a plane that faces the camera every focal length fits at some distance. Then
the deviation of the focal length is so large that no difference is significant, and the stated one is taken as right.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from toolkit import geometry
from toolkit.capture.cameras import projection_jacobian
from toolkit.geometry import Floats
from toolkit.localizers.rig import Matches, RigQuery

SIGNIFICANCE = 1e-4
"""Probability with which noise alone makes right cameras look wrong."""
LEAST_SIZE = 0.01
"""Smallest misfit that a pose is doubted for, relative to the distance of a pixel from the principal point:
calibrations in the field are good to some tenths of a percent."""
SUSPICIOUS = 0.01  # probability of a first step that is worth a second look
WIDENINGS = (8.0, 8.0, 4.0, 2.0)  # of the largest error, a step each: those that a wrong camera put out have a say
STEPS = 15
SETTLED_PX = 0.02
LEAST_SCALE_PX = 0.5  # of the Cauchy weights, where errors are smaller
PRIOR_STD = (0.2, 0.02, 0.02, 0.05)  # of the four parameters: how far off they are, where matches tell little

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Misfit:
    """Intrinsics that fit the matches of a pose significantly better than the stated."""

    shift: Floats
    """(6,) motion of the rig in its own frame to where it is with them: rotation, radians, then translation, meters."""
    parameters: Floats
    """(C, 4) of each camera: relative change of the focal length; shift of the principal point in x and y, in focal
    lengths; and radial distortion, as the relative change of the distance from the principal point at a corner."""
    sizes: Floats
    """(C, 3) how far focal length, principal point and distortion each move the pixels of a camera, relative to their
    distance from the principal point, root mean square; 0 where that is not significant."""

    @property
    def doubtful(self) -> bool:
        """Whether it is larger than `LEAST_SIZE`."""
        return bool(np.linalg.norm(self.sizes, axis=1).max() >= LEAST_SIZE)

    def focals_px(self, cameras: list[pycolmap.Camera]) -> tuple[float, ...]:
        """Return the focal length that fits each camera; NaN where it is not what misfits."""
        at_fault = (self.sizes[:, 0] > 0) & (self.sizes.argmax(axis=1) == 0)
        stated = np.array([camera.mean_focal_length() for camera in cameras])
        return tuple(np.where(at_fault, stated * (1 + self.parameters[:, 0]), np.nan).tolist())

    def reason(self, cameras: list[pycolmap.Camera]) -> str:
        """Return what fits better than what the intrinsics of which camera say."""
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
    """Return the intrinsics that fit significantly better than the stated; None where none do.

    Gauss-Newton with Cauchy weights on pose and intrinsics: on the focal lengths alone, unless principal points and
    distortions make the fit significantly better. Significance is that of an F-test of the errors that are left with
    fewer and with more unknowns, each at its best pose.

    Args:
        query: the cameras.
        rig_from_world: the pose (4, 4) that was found with the stated intrinsics.
        matches: made from descriptors alone, right and wrong: those sought near where a pose puts their points agree
            with it, be it right or wrong.
        points: (P, 3) the map points.
        max_error_deg: largest error of an inlier.
        focal_alone: leave principal points and distortions as stated; with them, wrong poses can look like right ones.
    """
    problem = _Problem(query, matches, points, max_error_deg)
    which = np.arange(problem.unknowns)
    pose, every = which < 6, which >= 0
    focal = ~pose & (which % 4 == 2)  # the pose has six unknowns, each camera four
    start = _Estimate(rig_from_world, np.zeros(problem.unknowns - 6))
    first = problem.step(start, every, WIDENINGS[0])
    if first is None or first.probability(first.change, ~pose) > SUSPICIOUS:
        return None
    stated = problem.fit(start, pose)
    if stated is None:
        return None
    chosen, free = stated, pose
    for unknowns in (pose | focal,) if focal_alone else (pose | focal, every):
        fitted = problem.fit(start, unknowns)
        if fitted is not None and problem.by_chance(chosen, fitted, int((unknowns & ~free).sum())) < SIGNIFICANCE:
            chosen, free = fitted, unknowns
    last = problem.step(chosen, free, 1.0)
    if chosen is stated or last is None:
        return None
    changes, of_camera = np.concatenate([np.zeros(6), chosen.parameters]), (which - 6) // 4
    by_noise = [last.probability(changes, free & ~pose & (of_camera == index)) for index in range(len(query.cameras))]
    at_fault = np.array(by_noise) <= max(SIGNIFICANCE, min(by_noise))
    motion = rig_from_world @ geometry.invert(chosen.rig_from_world)
    shift = np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])
    return Misfit(shift, chosen.parameters.reshape(-1, 4), np.where(at_fault[:, None], problem.sizes(chosen), 0.0))


class _Estimate(NamedTuple):
    rig_from_world: Floats
    parameters: Floats
    """(4 C,) changes of the intrinsics, those of a camera one after the other."""


class _Step(NamedTuple):
    """A step of Gauss-Newton."""

    change: Floats
    """(U,)"""
    largest_px: float
    covariance: Floats
    """(U, U), 0 of unknowns that are not free."""
    freedom: int

    def probability(self, values: Floats, tested: Bools) -> float:
        """Return the probability (F-test) that those of the unknowns that are tested are so large by noise alone."""
        values, covariance = values[tested], self.covariance[np.ix_(tested, tested)]
        squares = float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)
        return float(fdtrc(len(values), self.freedom, max(squares, 0.0) / len(values)))


class _Problem:
    """The pose and the intrinsics of a query, U unknowns, and the K matches that they have to explain."""

    def __init__(self, query: RigQuery, matches: Matches, points: Floats, max_error_deg: float) -> None:
        self._query, self._matches, self._points = query, matches, points[matches.point]
        self._limits_px = np.tan(np.radians(max_error_deg)) * query.focals_px[matches.camera]
        self._known = np.diag(np.concatenate([np.zeros(6), np.tile(1 / np.square(PRIOR_STD), len(query.cameras))]))
        self.unknowns = len(self._known)

    def linear(self, estimate: _Estimate) -> tuple[Floats, Floats]:
        """Return residuals (K, 2), infinite behind a camera, and how projections move with the unknowns, (K, 2, U)."""
        residuals = np.full((len(self._matches), 2), np.inf)
        of_unknowns = np.zeros((len(self._matches), 2, self.unknowns))
        in_rig = geometry.transform(estimate.rig_from_world, self._points)
        for index, camera in enumerate(self._query.cameras):
            part = np.flatnonzero(self._matches.camera == index)
            cam_from_rig = geometry.invert(self._query.rig_from_cams[index])
            in_cam = geometry.transform(cam_from_rig, in_rig[part])
            projected = np.asarray(camera.img_from_cam(in_cam), np.float64).reshape(-1, 2)
            seen = (in_cam[:, 2] > 1e-3) & np.isfinite(projected).all(axis=1)
            part, in_cam, projected = part[seen], in_cam[seen], projected[seen]
            focal_px, changes = self._query.focals_px[index], estimate.parameters[4 * index : 4 * index + 4]
            offsets = projected - (camera.principal_point_x, camera.principal_point_y)
            corner_px2 = (camera.width**2 + camera.height**2) / 4
            of_intrinsics = np.zeros((len(part), 2, 4))
            of_intrinsics[:, :, 0] = offsets
            of_intrinsics[:, 0, 1] = of_intrinsics[:, 1, 2] = focal_px
            of_intrinsics[:, :, 3] = offsets * ((offsets**2).sum(axis=1) / corner_px2)[:, None]
            residuals[part] = self._matches.pixels[part] - projected - of_intrinsics @ changes
            projection = projection_jacobian(in_cam, np.full(len(part), focal_px * (1 + changes[0])))
            of_place = projection @ cam_from_rig[:3, :3]
            # A motion of the rig moves a point in it by -(rotation x point) - translation.
            of_unknowns[part, :, :3] = np.cross(of_place, in_rig[part, None])
            of_unknowns[part, :, 3:6] = -of_place
            of_unknowns[part, :, 6 + 4 * index : 10 + 4 * index] = of_intrinsics
        return residuals, of_unknowns

    def step(self, estimate: _Estimate, free: Bools, widening: float) -> _Step | None:
        """Return the next step of the unknowns that are free (U,); None where the matches do not determine them.

        Errors up to `widening` times the limit are those of inliers.
        """
        residuals, of_unknowns = self.linear(estimate)
        errors = np.linalg.norm(residuals, axis=1)
        inliers = errors < widening * self._limits_px
        freedom = 2 * int(inliers.sum()) - int(free.sum())
        if freedom < 1:
            return None
        errors = errors[inliers]
        roots = 1 / np.sqrt(1 + (errors / max(float(np.median(errors)), LEAST_SCALE_PX)) ** 2)  # of the Cauchy weights
        weighted = roots[:, None, None] * of_unknowns[inliers][:, :, free]
        residuals = roots[:, None] * residuals[inliers]
        variance = float((residuals**2).sum()) / freedom
        known = self._known[np.ix_(free, free)]
        flat = weighted.reshape(-1, weighted.shape[2])
        information = flat.T @ flat + variance * known
        if np.linalg.cond(information) > 1e14:
            return None
        inverse = np.linalg.inv(information)
        so_far = np.concatenate([np.zeros(6), estimate.parameters])[free]
        solved = inverse @ (flat.T @ residuals.ravel() - variance * (known @ so_far))
        if not np.isfinite(solved).all():
            return None
        change, whole = np.zeros(self.unknowns), np.zeros((self.unknowns, self.unknowns))
        change[free], whole[np.ix_(free, free)] = solved, variance * inverse
        return _Step(change, float(np.abs(flat @ solved).max()), whole, freedom)

    def fit(self, start: _Estimate, free: Bools) -> _Estimate | None:
        """Return the estimate at the minimum, its inliers chosen anew at each step; None where there is none."""
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
        """Return the probability (F-test) that an estimate with some more unknowns is better by chance alone.

        Errors count as their logarithmic (Cauchy) cost, up to the limit of an inlier.
        """
        errors = [np.linalg.norm(self.linear(estimate)[0], axis=1) for estimate in (fewer, more)]
        of_either = np.minimum(*errors) < self._limits_px
        before, after = (np.minimum(error, self._limits_px)[of_either] for error in errors)
        freedom = 2 * len(after) - self.unknowns
        if freedom < 1:
            return 1.0
        scale = max(float(np.median(after)), LEAST_SCALE_PX)
        costs = [float(np.log1p((error / scale) ** 2).sum()) for error in (before, after)]
        prior = [float(np.diagonal(self._known)[6:] @ estimate.parameters**2) / 2 for estimate in (fewer, more)]
        gain = costs[0] + prior[0] - costs[1] - prior[1]
        return float(fdtrc(added, freedom, max(gain, 0.0) / added / (costs[1] / freedom)))

    def sizes(self, estimate: _Estimate) -> Floats:
        """Return the sizes (C, 3) of the changes, see `Misfit`."""
        residuals, of_unknowns = self.linear(estimate)
        inliers = np.linalg.norm(residuals, axis=1) < self._limits_px
        sizes = np.zeros((len(self._query.cameras), 3))
        for index, changes in enumerate(estimate.parameters.reshape(-1, 4)):
            part = inliers & (self._matches.camera == index)
            own = of_unknowns[part][:, :, 6 + 4 * index : 10 + 4 * index]
            distances = max(float(np.linalg.norm(own[:, :, 0])), 1e-12)
            for kind, columns in enumerate(([0], [1, 2], [3])):
                sizes[index, kind] = np.linalg.norm(own[:, :, columns] @ changes[columns]) / distances
        return sizes
