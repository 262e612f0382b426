"""Align predicted cameras to the map by a similarity, and estimate its uncertainty.

A network predicts the cameras of a query image and of its references in a frame `model` of unknown scale. The poses of
the references in the map are known. The prediction is noisy; the map is taken as exact. Therefore:

- Rotation comes from orientations, which are never degenerate, and from long baselines.
- Scale is regressed from map to model. The other direction, that of Umeyama (1991), divides by the spread of noisy
  centers, so its scale shrinks if the noise is as large as the baselines (errors in variables; Fuller 1987).
- Depth ratios, metric over predicted, give the scale without baselines.
- The size of the noise is unknown. It has a broad prior and is estimated from the residuals.
- A mixture model detects wrong references: a reference either has that noise, or lies anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from toolkit import geometry
from toolkit.alignment.robust import (
    NOISE_FACTOR,
    AlignmentError,
    Bools,
    checked_weights,
    listed,
    nearest_rotation,
    noise_variance,
    rigid_poses,
)
from toolkit.geometry import Floats, Ints
from toolkit.threads import fixed_sums

DepthSamples = ArrayLike | Sequence[ArrayLike]
DEPTH_OUTLIER_SHARE = 0.2  # expected share of wrong samples
DEPTH_NOISE = 0.1  # expected relative noise of one depth ratio
OUTLIER_SHARE = 0.2  # expected share of wrong references
WRONG_PLACE = 20.0  # least extent of the space of wrong centers, in multiples of the expected noise
CENTER_NOISE_SHARE = 0.01  # noise over the typical distance of references: larger scenes are predicted less exactly
MAX_POSITION_STD_M, MAX_ROTATION_STD_DEG = 0.2, 2.25  # of a pose that is `ok`: root of the trace of the covariance
MIN_CONSISTENT = 2  # consistent references of a pose that is `ok`; nothing checks a single one
MAX_RIVAL_SHARE = 0.5  # size of the largest other group of references that agree, over that of consistent ones
MAX_SCALE_STD = 0.2  # a scale with a larger relative standard deviation counts as unknown
_STARTS = 6  # number of best hypotheses that are refined
_ROUNDS = 10  # of reweighting, at most; a few are enough
_LOG_PEAK = 1.5 * np.log(2 * np.pi)  # log normalization of a Gaussian in three coordinates
_LOG_SPHERE = np.log(8 * np.pi**2)  # log volume of all rotations, measured as rotation vectors near the identity
_UNKNOWN: dict[str, Any] = {
    "scale_std": np.inf,
    "rotation_std_deg": np.inf,
    "rotation_covariance": np.diag(np.full(3, np.inf)),
    "centroid_covariance": np.diag(np.full(3, np.inf)),
}


# Scale from depth


@dataclass(frozen=True)
class ScaleEstimate:
    """A scale and its relative standard deviation."""

    value: float
    std: float
    conflict: bool = False


def combined_scale(
    along: float, square_c: float, noise_in_model: float, depth: ScaleEstimate | None
) -> ScaleEstimate | None:
    """Combine the scale from baselines with that from depth ratios; return None if there is neither.

    1 / scale is linear in the noisy centers of the model, so the two values of 1 / scale are averaged by inverse
    variance. If they differ by more than three standard deviations, the variance is widened (Birge 1932).

    Args:
        along: sum of the products of baselines in the map and in the model.
        square_c: sum of squared baselines in the map.
        noise_in_model: noise of a predicted center per axis, in units of the model.
        depth: scale from depth ratios, if any.
    """
    values, variances = np.zeros(0), np.zeros(0)
    if square_c > 0:
        values, variances = np.array([along / square_c]), np.array([noise_in_model**2 / square_c])
    if depth is not None:
        values, variances = np.append(values, 1 / depth.value), np.append(variances, (depth.std / depth.value) ** 2)
    information = 1 / np.maximum(variances, 1e-300)
    value = float(information @ values / information.sum()) if len(values) else 0.0
    if value <= 0:
        return None
    variance, conflict = 1 / information.sum(), False
    if len(values) == 2:
        squared = (values[0] - values[1]) ** 2 / np.maximum(variances, 1e-300).sum()
        conflict = bool(squared > 3.0**2)
        variance *= squared if conflict else 1.0
    return ScaleEstimate(1 / value, float(np.sqrt(variance)) / value, conflict)


@dataclass(frozen=True)
class DepthRatios:
    """Valid depth ratios of map points."""

    log: Floats
    """(R,) logarithms."""
    reference: Ints
    """(R,) the reference that each belongs to, -1 if unknown."""
    notes: list[str]
    """Descriptions of what was left out."""

    @classmethod
    def of(cls, ratios: DepthSamples | None, count: int) -> DepthRatios:
        """Check the `depth_ratios` of `align_to_map` for `count` references. Raise AlignmentError for a wrong shape."""
        reference = np.zeros(0, np.int64)
        if ratios is None:
            return cls(np.zeros(0), reference, [])
        if isinstance(ratios, list | tuple) and any(np.ndim(part) > 0 for part in ratios):
            if len(ratios) != count:
                raise AlignmentError(f"depth_ratios has {len(ratios)} arrays: expected one, or {count} of references.")
            parts = [np.asarray(part, np.float64).ravel() for part in ratios]
            values, reference = np.concatenate(parts), np.repeat(np.arange(count), [len(part) for part in parts])
        else:
            values = np.asarray(ratios, np.float64)
            if values.ndim != 1:
                raise AlignmentError(f"depth_ratios has shape {values.shape}: expected (R,), or {count} arrays.")
            reference = np.full(len(values), -1)
        with np.errstate(invalid="ignore"):
            kept = np.isfinite(values) & (values > 0)
        left_out = f"{(~kept).sum()} of {len(kept)} depth ratios left out: not finite and positive"
        return cls(np.log(values[kept]), reference[kept], [] if kept.all() else [left_out])

    @property
    def grouped(self) -> bool:
        """Whether the reference of each ratio is known."""
        return len(self.reference) > 0 and bool(self.reference[0] >= 0)

    def estimate(self, consistent: Bools | None) -> ScaleEstimate | None:
        """Return the scale from the samples of some references, (M,) bool, or of all; None without samples.

        Expectation maximization fits a mixture of noise around one value and uniformly distributed wrong samples. It
        starts from the middle of the shortest interval that contains half of the samples (Rousseeuw 1984). The error
        that the samples of one reference share is estimated by moments (DerSimonian and Laird 1986).
        """
        kept = consistent[self.reference] if self.grouped and consistent is not None else np.ones(len(self.log), bool)
        log, reference = self.log[kept], self.reference[kept]
        if not len(log):
            return None
        ordered = np.sort(log)
        half = (len(log) + 1) // 2 + (len(log) > 2)
        widths = ordered[half - 1 :] - ordered[: len(log) - half + 1]
        start = int(np.argmin(widths))
        center = (ordered[start] + ordered[start + half - 1]) / 2
        noise, wrong = max(widths[start], 1e-3), DEPTH_OUTLIER_SHARE
        room = np.log(max(ordered[-1] - ordered[0], 1.0) + 1.0)
        for _ in range(15):
            right = np.log1p(-wrong) - np.log(noise * np.sqrt(2 * np.pi)) - ((log - center) / noise) ** 2 / 2
            share = 1 / (1 + np.exp(np.clip(np.log(wrong) - room - right, -700, 700)))
            center = float(share @ log / share.sum())
            squares, free = share @ (log - center) ** 2, max(share.sum() - 1, 0.0)
            noise = float(np.sqrt(noise_variance(squares, free, DEPTH_NOISE)))
            before, wrong = wrong, float(np.clip(1 - share.mean(), 0.01, 0.6))
            if abs(wrong - before) < 1e-4:
                break
        variance = noise**2 / share.sum()
        if self.grouped:
            center, variance = _between(log, share, reference, noise, center, variance)
        return ScaleEstimate(float(np.exp(center)), float(np.sqrt(variance)))


def _between(
    log: Floats, share: Floats, reference: Ints, noise: float, center: float, variance: float
) -> tuple[float, float]:
    """Return the mean over the references' means, and its variance, which includes that between references."""
    _, index = np.unique(reference, return_inverse=True)
    total = np.bincount(index, share)
    held = total > 0.5  # excludes references whose samples are all wrong
    if held.sum() < 2:
        return center, variance
    means = np.bincount(index, share * log)[held] / total[held]
    information = total[held] / noise**2
    excess = information @ (means - information @ means / information.sum()) ** 2 - (len(means) - 1)
    between = max(excess / (information.sum() - (information**2).sum() / information.sum()), 0.0)
    information = 1 / (1 / information + between)
    return float(information @ means / information.sum()), float(1 / information.sum())


# Similarity


@dataclass(frozen=True)
class Sim3:
    """A similarity, world = scale * rotation @ model + translation."""

    scale: float
    rotation: Floats
    """(3, 3)"""
    translation: Floats
    """(3,), in units of the world"""

    def transform(self, points: ArrayLike) -> Floats:
        """Transform points (..., 3) from the model to the world."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def apply_to_pose(self, model_from_cam: ArrayLike) -> Floats:
        """Return world_from_cam (..., 4, 4) of cameras (..., 4, 4) in the model.

        The scale applies to the camera center but not to the camera frame, so the pose stays rigid.
        """
        pose = np.asarray(model_from_cam, np.float64)
        return geometry.make_pose(self.rotation @ pose[..., :3, :3], self.transform(pose[..., :3, 3]))

    def inverse(self) -> Sim3:
        """Return the similarity from the world to the model."""
        return Sim3(1 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale)


@dataclass(frozen=True)
class Alignment:
    """Similarity from predicted cameras to the map, with its uncertainty.

    Standard deviations are lengths of vectors: the root of the trace of a covariance.
    """

    world_from_model: Sim3
    """If the scale is unknown, `scale` is the most likely one, positive and finite, but not a measurement. The
    centroids of the consistent references coincide in any case."""
    consistent: Bools
    """(M,) references whose predicted relative poses agree with the map. An inlier is a match, see `QueryResult`."""
    scale_std: float
    """Relative standard deviation of the scale; inf if unknown."""
    rotation_std_deg: float
    """Standard deviation of the rotation; inf if unknown."""
    rmse_m: float
    """Root mean square distance of the consistent references' centers after alignment; NaN without any."""
    reason: str
    """What was left out or is unknown, and why; may be empty."""
    num_rivals: int
    """Largest number of excluded references that agree with each other on another alignment; 1 if none agree."""
    centroid_m: Floats
    """(3,) weighted centroid of the consistent references in the world; rotation about it, scale and translation are
    uncorrelated."""
    rotation_covariance: Floats
    """(3, 3) of a small rotation in the world frame, radians."""
    centroid_covariance: Floats
    """(3, 3) of the position of the model's centroid in the world, square meters."""
    rotation_noise_deg: float
    """Estimated noise of a predicted orientation, the same for references and query."""
    center_noise_m: float
    """Estimated noise of a predicted center in meters, the same for references and query."""

    @property
    def scale_known(self) -> bool:
        return bool(np.isfinite(self.scale_std))

    @property
    def num_consistent(self) -> int:
        return int(self.consistent.sum())


@fixed_sums
def align_to_map(
    model_from_cams: ArrayLike,
    world_from_cams: ArrayLike,
    weights: ArrayLike | None = None,
    depth_ratios: DepthSamples | None = None,
    *,
    center_noise_m: float = 0.02,
    rotation_noise_deg: float = 1.0,
) -> Alignment:
    """Estimate the similarity from a predicted frame to the map, robustly.

    The likelihood of each camera is a mixture: noise around its map pose, or a constant density for a wrong one.
    Every reference and every pair of references gives a hypothesis, with the scale of the pair's baseline and again
    with that of the depth ratios. Expectation maximization refines the most likely hypotheses and the noise. The best
    one is returned.

    Args:
        model_from_cams: (M, 4, 4) predicted poses of the references. Poses that are not finite are left out.
        world_from_cams: (M, 4, 4) their poses in the map, meters; left out likewise.
        weights: (M,) relative confidence, 0 or more. The noise variance of a camera is proportional to 1 / weight; its
            vote on which references are correct is proportional to weight. 0 leaves a reference out.
        depth_ratios: metric over predicted depth of map points seen in references. Either one array (R,), or a list or
            tuple of M arrays, one per reference. With one array per reference, samples of excluded references are not
            used, and the error that the samples of a reference share adds to the uncertainty. Up to 40 % of the
            samples may be wrong. Samples that are not finite or not positive are left out.
        center_noise_m: expected noise of a predicted center, as a length. 1 % of the references' typical distance is
            added, in squares. Within a small factor of it, and of `rotation_noise_deg`, the data decide.
        rotation_noise_deg: expected noise of a predicted orientation, as an angle.

    Returns:
        The alignment. Too few, coincident, collinear or contradicting references raise no error: unknown quantities get
        an infinite standard deviation, and `reason` says why.

    Raises:
        AlignmentError: a shape is wrong, a matrix is not a rigid pose (the message gives its index), or a weight is
            negative.
    """
    model, model_finite = rigid_poses(model_from_cams, "model_from_cams")
    world, world_finite = rigid_poses(world_from_cams, "world_from_cams")
    if len(model) != len(world):
        found = f"{len(model)} model_from_cams and {len(world)} world_from_cams"
        raise AlignmentError(f"Found {found}: expected equal numbers.")
    weight = checked_weights(weights, len(model))
    ratios = DepthRatios.of(depth_ratios, len(model))
    for name, value in (("center_noise_m", center_noise_m), ("rotation_noise_deg", rotation_noise_deg)):
        if not (np.isfinite(value) and value > 0):
            raise AlignmentError(f"{name} is {value}: expected a number above 0.")
    finite = model_finite & world_finite
    notes = [] if finite.all() else [f"references {listed(~finite)} left out: not finite"]
    usable = np.flatnonzero(finite & (weight > 0))
    if not len(usable):
        return Alignment(
            Sim3(1.0, np.eye(3), np.zeros(3)), np.zeros(len(model), bool), rmse_m=np.nan, num_rivals=0,
            reason="; ".join([*notes, "no usable reference"]), centroid_m=np.zeros(3), rotation_noise_deg=np.inf,
            center_noise_m=np.inf, **_UNKNOWN,
        )  # fmt: skip
    problem = _Problem(
        model[usable], world[usable], weight[usable] / weight[usable].mean(), center_noise_m, rotation_noise_deg
    )
    depth = ratios.estimate(None)
    best, members = problem.search(depth)
    consistent, excluded = np.zeros(len(model), bool), np.zeros(len(model), bool)
    consistent[usable], excluded[usable] = members > 0, members == 0
    num_rivals, undecided = 0, []
    if excluded.any():
        notes.append(f"references {listed(excluded)} left out: their poses contradict the others'")
        others = problem.weight[members == 0]
        rest = _Problem(model[excluded], world[excluded], others, center_noise_m, rotation_noise_deg)
        # Excluded references agree with each other only within twice the noise of the others.
        _, rivals = rest.search(depth, (2 * float(best.rotation_noise[0]), 2 * float(best.center_noise[0])))
        num_rivals = int((rivals > 0).sum())
        if others[rivals > 0].sum() > 0.9 * problem.weight[members > 0].sum():
            counts = f"{consistent.sum()} references agree, and {num_rivals} others on another alignment"
            undecided = [f"{counts}: undecided"]
        if ratios.grouped:
            depth = ratios.estimate(consistent)
    notes += ratios.notes
    alignment = replace(problem.solve(best, members, depth, notes), consistent=consistent, num_rivals=num_rivals)
    if undecided:
        alignment = replace(alignment, reason="; ".join([*notes, *undecided]), **_UNKNOWN)
    return alignment


def query_pose(alignment: Alignment, model_from_query: ArrayLike) -> tuple[Floats, Floats]:
    """Return the pose of a predicted camera in the map, world_from_query (4, 4), and its covariance (6, 6).

    The covariance follows `pose.base.QueryResult`: it is that of d in world_from_cam @ Exp(d), rotation in
    radians, then translation in meters. It adds three parts: the noise of the query's prediction (assumed equal to that
    of the references), the uncertainty of the alignment's rotation and scale times the distance from the references'
    centroid, and the uncertainty of the centroid. If the scale is unknown, its diagonal is infinite for the
    translation; if the alignment is unknown, the whole diagonal is.

    Args:
        alignment: alignment of the references that were predicted together with the query.
        model_from_query: (4, 4) predicted pose of the query in the same frame.

    Raises:
        AlignmentError: the pose is not rigid or not finite.
    """
    model, finite = rigid_poses(np.asarray(model_from_query, np.float64)[None], "model_from_query")
    if not finite[0]:
        raise AlignmentError("model_from_query is not finite: expected a rigid pose (4, 4).")
    pose = alignment.world_from_model.apply_to_pose(model[0])
    if not np.isfinite(alignment.rotation_std_deg):
        return pose, np.diag(np.full(6, np.inf))
    lever = pose[:3, 3] - alignment.centroid_m
    # A rotation e of the model turns the query by e and moves it by e x lever.
    moved = np.vstack([np.eye(3), np.cross(lever, np.eye(3))])
    in_world = moved @ alignment.rotation_covariance @ moved.T
    in_world[:3, :3] += np.eye(3) * np.radians(alignment.rotation_noise_deg) ** 2 / 3
    if alignment.scale_known:
        in_world[3:, 3:] += alignment.centroid_covariance + np.outer(lever, lever) * alignment.scale_std**2
        in_world[3:, 3:] += np.eye(3) * alignment.center_noise_m**2 / 3
    to_camera = np.kron(np.eye(2), pose[:3, :3].T)
    covariance = to_camera @ in_world @ to_camera.T
    if not alignment.scale_known:
        covariance[3:] = covariance[:, 3:] = 0.0
        covariance[3:, 3:] = np.diag(np.full(3, np.inf))
    return pose, covariance


def is_trustworthy(alignment: Alignment, covariance: Floats) -> bool:
    """Tell whether a pose from `query_pose`, with this covariance (6, 6), is `ok`.

    Errors of 5 deg and 0.5 m must be more than 2.2 standard deviations away (2.5 for the position, whose error may lie
    along one axis), references must confirm each other, and no large group of references may agree on another
    alignment.
    """
    rivals = alignment.num_rivals if alignment.num_rivals > 1 else 0
    return bool(
        alignment.scale_known
        and alignment.num_consistent >= MIN_CONSISTENT
        and rivals <= MAX_RIVAL_SHARE * alignment.num_consistent
        and np.sqrt(np.trace(covariance[3:, 3:])) <= MAX_POSITION_STD_M
        and np.degrees(np.sqrt(np.trace(covariance[:3, :3]))) <= MAX_ROTATION_STD_DEG
    )


class _Problem:
    """The M references in both frames, for K hypotheses at once; `members` (K, M) are probabilities to be correct."""

    def __init__(self, model: Floats, world: Floats, weight: Floats, center_noise_m: float, rotation_noise_deg: float):
        self.weight = weight
        self.world_from_model = world[:, :3, :3] @ np.swapaxes(model[:, :3, :3], -1, -2)  # rotation from each camera
        self.flat_rotations = self.world_from_model.reshape(-1, 9)
        # Centers in the model (m) and in the world (c), relative to a middle reference: large coordinates lose digits.
        self.origin_m, self.origin_c = _middle(model[:, :3, 3]), _middle(world[:, :3, 3])
        self.m, self.c = model[:, :3, 3] - self.origin_m, world[:, :3, 3] - self.origin_c
        # Flat, so that a sum over references is a matrix product with members.
        self.outer_cm = (self.c[:, :, None] * self.m[:, None, :]).reshape(-1, 9)
        typical = np.median(np.linalg.norm(self.c, axis=1))
        # Noise per axis; three axes make the length.
        self.center_prior = float(np.hypot(center_noise_m, CENTER_NOISE_SHARE * typical) / np.sqrt(3))
        self.rotation_prior = float(np.radians(rotation_noise_deg) / np.sqrt(3))
        first, second = np.triu_indices(len(self.m), 1)
        gaps_m, gaps_c = (((x[first] - x[second]) ** 2).sum(axis=1) for x in (self.m, self.c))
        # Extent of the references in the model; wrong cameras lie in a space of about this size.
        self.extent = float(np.sqrt(np.mean(gaps_m))) if len(first) else 0.0
        apart = gaps_m > 1e-18 * max(self.extent**2, 1e-300)
        ratios = np.sqrt((gaps_c[apart] + 6 * self.center_prior**2) / gaps_m[apart])
        # Scale to use where the centers do not determine it.
        self.rough_scale = float(np.median(ratios)) if apart.any() else 1.0

    def search(
        self, depth: ScaleEstimate | None, noise: tuple[float, float] | None = None
    ) -> tuple[_Similarities, Floats]:
        """Return the most likely similarity, and the probability (M,) that each reference is correct, 0 if left out.

        `noise` (rotation, center) fixes the noise per axis.
        """
        alone, (first, second) = np.eye(len(self.m)), np.triu_indices(len(self.m), 1)
        members = np.vstack([alone[first] + alone[second], alone])
        state = self.fit(members, self.opening(members), None)
        if depth is not None:
            state = state.joined(self.fit(members, self.opening(members), depth))
        # A hypothesis from two noisy cameras fits the other ones less well than the noise suggests.
        residuals = self.residuals(state)
        scores = np.max([self.score(state.with_noise(factor), residuals)[0] for factor in (1.0, 3.0, 9.0)], axis=0)
        state = state[np.argsort(-scores, kind="stable")[:_STARTS]].with_noise(3.0)
        _, members = self.score(state, self.residuals(state))
        for _ in range(_ROUNDS):
            state = self.fit(members, state, depth)
            residuals = self.residuals(state)
            if noise is None:
                angle, distance = ((members * values) @ self.weight for values in residuals)
                free = 3 * np.maximum(members.sum(axis=1) - 1, 0)
                rotation_noise = np.sqrt(noise_variance(angle, free, self.rotation_prior))
                center_noise = np.sqrt(noise_variance(distance, np.maximum(free - 1, 0), self.center_prior))
            else:
                rotation_noise, center_noise = (np.full(len(state.scale), value) for value in noise)
            state = replace(state, rotation_noise=rotation_noise, center_noise=center_noise)
            before = members
            scores, members = self.score(state, residuals)
            best = int(np.argmax(scores))
            if np.abs(members[best] - before[best]).max() < 1e-3:
                break
        consistent = members[best] > 0.5
        if not consistent.any():
            consistent[np.argmax(members[best])] = True
        return state[best : best + 1], np.where(consistent, np.maximum(members[best], 0.5), 0.0)

    def opening(self, members: Floats) -> _Similarities:
        """Return starting points for the fit of members (K, M): their mean rotations, and the expected noise."""
        count = len(members)
        rotations = ((members * self.weight) @ self.flat_rotations).reshape(-1, 3, 3)
        return _Similarities(
            rotation=nearest_rotation(rotations),
            scale=np.full(count, self.rough_scale),
            mean_c=np.zeros((count, 3)),
            mean_m=np.zeros((count, 3)),
            rotation_noise=np.full(count, self.rotation_prior),
            center_noise=np.full(count, self.center_prior),
        )

    def fit(self, members: Floats, last: _Similarities, depth: ScaleEstimate | None) -> _Similarities:
        """Return the weighted least squares similarities (K) of members (K, M), given the noise per axis.

        First the scale for the last rotation, then the rotation for that scale, each in closed form. The scale
        maximizes s^D exp(-|c - s R m|^2 / (2 noise^2)), the likelihood of the model's centers over D coordinates. It
        is unbiased, and positive for any data. The rotation combines orientations and baselines (Wahba 1965).
        """
        share = members * self.weight
        total = np.maximum(share.sum(axis=1), 1e-12)[:, None]
        mean_c, mean_m = share @ self.c / total, share @ self.m / total
        variance = last.center_noise**2
        cross = (share @ self.outer_cm).reshape(-1, 3, 3)
        cross -= total[:, :, None] * mean_c[:, :, None] * mean_m[:, None, :]
        square_m = ((self.m[None] - mean_m[:, None]) ** 2).sum(axis=2)
        square_m = (share * square_m).sum(axis=1)
        apart = (square_m > 1e-18 * self.extent**2) & (square_m > 1e-300)
        room = variance * 3 * np.maximum(members.sum(axis=1) - 1, 1e-9)
        along = (last.rotation * cross).sum(axis=(1, 2))
        root = np.sqrt(along**2 + 4 * square_m * room)
        # The positive root of square_m s^2 - along s - room, in the numerically stable form.
        over = np.where(along > 0, along + root, 2 * room)
        under = np.where(along > 0, 2 * square_m, root - along)
        scale = over / np.where(apart, under, 1.0)
        scale = np.where(apart, scale, depth.value if depth is not None else self.rough_scale)
        if depth is not None:
            square_c = (share * ((self.c[None] - mean_c[:, None]) ** 2).sum(axis=2)).sum(axis=1)
            from_centers, from_depth = square_c / variance, 1 / max(depth.std, 1e-6) ** 2
            part = from_centers / (from_centers + from_depth)
            scale = np.exp(part * np.log(scale) + (1 - part) * np.log(depth.value))
        rotations = (share @ self.flat_rotations).reshape(-1, 3, 3) / (last.rotation_noise**2)[:, None, None]
        rotation = nearest_rotation(rotations + (2 * scale / variance)[:, None, None] * cross)
        return _Similarities(rotation, scale, mean_c, mean_m, last.rotation_noise, last.center_noise)

    def residuals(self, state: _Similarities) -> tuple[Floats, Floats]:
        """Return squared angles (K, M) in radians and squared distances (K, M) in meters."""
        trace = state.rotation.reshape(-1, 9) @ self.flat_rotations.T
        moved = (self.m[None] - state.mean_m[:, None]) @ np.swapaxes(state.rotation, 1, 2) * state.scale[:, None, None]
        distance = ((self.c[None] - state.mean_c[:, None] - moved) ** 2).sum(axis=2)
        # 2 (1 - cos) of the angle, which is its square for small angles.
        return np.maximum(3 - trace, 0), distance

    def score(self, state: _Similarities, residuals: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Return the log likelihoods (K) and the probability (K, M) that each reference is correct."""
        angle, distance = residuals
        rotation_noise = state.rotation_noise[:, None] / np.sqrt(self.weight)
        center_noise = state.center_noise[:, None] / np.sqrt(self.weight)
        # The density of a wrong reference is constant over all rotations and over a space around the references. That
        # space is the model's extent in meters: otherwise a scale near zero, which merges all centers, would win.
        space = 3 * (state.scale * self.extent)[:, None] + WRONG_PLACE * self.center_prior
        # Log likelihood ratios of noise over a constant density, for orientation and for position.
        orientation = _LOG_SPHERE - _LOG_PEAK - 3 * np.log(rotation_noise) - angle / (2 * rotation_noise**2)
        position = 3 * np.log(space / center_noise) - _LOG_PEAK - distance / (2 * center_noise**2)
        right = np.log(1 - OUTLIER_SHARE) + orientation + position
        # Wrong in both, or only in position, or only in orientation.
        wrong = np.log(OUTLIER_SHARE / 3) + np.logaddexp(0.0, np.logaddexp(orientation, position))
        either = np.logaddexp(right, wrong)
        likelihood = either @ self.weight
        for noise, expected in ((state.rotation_noise, self.rotation_prior), (state.center_noise, self.center_prior)):
            likelihood = likelihood - (np.log(noise / expected) / NOISE_FACTOR) ** 2 / 2
        return likelihood, np.exp(right - either)

    def solve(self, state: _Similarities, members: Floats, depth: ScaleEstimate | None, notes: list[str]) -> Alignment:
        """Return the weighted least squares alignment of the consistent references, with its uncertainty."""
        share = members * self.weight
        rotation, scale = state.rotation[0], float(state.scale[0])
        rotation_noise, center_noise = float(state.rotation_noise[0]), float(state.center_noise[0])
        count = float(members.sum())
        c0, m0 = share @ self.c / share.sum(), share @ self.m / share.sum()
        c, m = self.c - c0, self.m - m0
        square_c = float(share @ (c**2).sum(axis=1))
        lever = np.eye(3) * square_c - np.einsum("m,mi,mj->ij", share, c, c)  # information of baselines on rotation
        rotations = np.einsum("m,mij->ij", share, self.world_from_model)
        cross = np.einsum("m,mi,mj->ij", share, c, m)
        for _ in range(4):
            numbers = (np.array([value]) for value in (scale, c0, m0, rotation_noise, center_noise))
            fitted = _Similarities(rotation[None], *numbers)
            rotation = nearest_rotation(
                (rotations / rotation_noise**2 + 2 * scale / center_noise**2 * cross)[None], keep=rotation
            )[0]
            estimate = combined_scale(float(np.sum(rotation * cross)), square_c, center_noise / scale, depth)
            scale_std, conflict = (estimate.std, estimate.conflict) if estimate is not None else (np.inf, False)
            if estimate is not None and scale_std <= MAX_SCALE_STD:
                scale = estimate.value
            else:
                scale = float(self.fit(members[None], fitted, depth).scale[0])
            fitted = replace(fitted, rotation=rotation[None], scale=np.array([scale]))
            angle, distance = (values[0] @ share for values in self.residuals(fitted))
            # The rotation's degrees of freedom are split between orientations and baselines by information.
            by_orientation, by_baselines = 3 * share.sum() / rotation_noise**2, np.trace(lever) / center_noise**2
            part = by_orientation / (by_orientation + by_baselines)
            free = (3 * count - 3 * part, 3 * (count - 1) - 3 * (1 - part) - float(square_c > 0))
            rotation_noise = float(np.sqrt(noise_variance(angle, max(free[0], 0.0), self.rotation_prior)))
            center_noise = float(np.sqrt(noise_variance(distance, max(free[1], 0.0), self.center_prior)))
        known = scale_std <= MAX_SCALE_STD
        why = "baselines not above the noise of the centers, and no depth ratios"
        if depth is not None:
            why = "neither baselines nor depth ratios give it well enough"
        notes = [
            *notes,
            *(["depth ratios and baselines contradict each other on the scale"] if conflict else []),
            *([] if known else [f"scale unknown: {why}"]),
        ]
        translation = self.origin_c + c0 - scale * rotation @ (self.origin_m + m0)
        covariance = np.linalg.inv(np.eye(3) * share.sum() / rotation_noise**2 + lever / center_noise**2)
        squared_m2 = ((c - scale * m @ rotation.T) ** 2).sum(axis=1)
        return Alignment(
            world_from_model=Sim3(scale, rotation, translation),
            consistent=members > 0,
            scale_std=scale_std if known else np.inf,
            rotation_std_deg=float(np.degrees(np.sqrt(np.trace(covariance)))),
            rmse_m=float(np.sqrt(squared_m2[members > 0].mean())),
            reason="; ".join(notes),
            num_rivals=0,
            centroid_m=self.origin_c + c0,
            rotation_covariance=covariance,
            centroid_covariance=np.eye(3) * center_noise**2 / share.sum(),
            rotation_noise_deg=float(np.degrees(rotation_noise) * np.sqrt(3)),
            center_noise_m=float(center_noise * np.sqrt(3)),
        )


@dataclass(frozen=True)
class _Similarities:
    """K similarities world = scale R (model - mean_m) + mean_c, with their noise per axis."""

    rotation: Floats
    scale: Floats
    mean_c: Floats
    mean_m: Floats
    rotation_noise: Floats
    center_noise: Floats

    def __getitem__(self, index: Ints | slice) -> _Similarities:
        return _Similarities(**{name: part[index] for name, part in vars(self).items()})

    def joined(self, other: _Similarities) -> _Similarities:
        parts = vars(other)
        return _Similarities(**{name: np.concatenate([part, parts[name]]) for name, part in vars(self).items()})

    def with_noise(self, factor: float) -> _Similarities:
        return replace(self, rotation_noise=self.rotation_noise * factor, center_noise=self.center_noise * factor)


def _middle(points: Floats) -> Floats:
    """Return the one of the points (M, 3) with the least sum of distances to all of them."""
    distances = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=2))
    return np.asarray(points[np.argmin(distances.sum(axis=1))], np.float64)
