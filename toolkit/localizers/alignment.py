"""The similarity that brings predicted cameras into the map, and how well it is known.

A network predicts the cameras of a query and of its references in a frame of its own, `model`, without meters. The
references' poses in the map are known. The noise sits in the prediction; the map counts as exact. So:

- Rotation comes from orientations, which are never degenerate, and from baselines where they are long.
- Scale is regressed from map to model. The other direction, which is that of Umeyama (1991), divides by the spread
  of noisy centers and shrinks as the noise nears the baselines (errors in variables; Fuller 1987).
- Depth ratios, metric over model, give scale without baselines.
- The noise is unknown. It has a broad prior and is estimated from the residuals.
- Wrong references are found by a mixture: a reference either has that noise, or is anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit import geometry
from toolkit.errors import ToolkitError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
DepthSamples = ArrayLike | Sequence[ArrayLike]

OUTLIER_SHARE = 0.2  # the share of wrong references expected before looking
WRONG_PLACE = 20.0  # wrong centers are spread over that many times the noise expected at least
NOISE_FACTOR = np.log(2.5)  # one standard deviation of what is known of a noise before looking, in its logarithm
DEPTH_NOISE = 0.1  # relative noise expected of one depth ratio
CENTER_NOISE_SHARE = 0.01  # of the references' typical distance: a prediction of a wider place is less exact
_STARTS = 6  # hypotheses refined of all that were scored
_ROUNDS = 10
_LEVELS = np.exp(np.linspace(-3.5, 3.5, 29))  # noise over its expected size, to integrate over
_LOG_PEAK = 1.5 * np.log(2 * np.pi)  # what a Gaussian of three coordinates is divided by
_LOG_SPHERE = np.log(8 * np.pi**2)  # volume of all rotations, as rotation vectors near the identity measure it


class AlignmentError(ToolkitError):
    """Cameras, weights or depth ratios that cannot be what they should be."""


@dataclass(frozen=True)
class Sim3:
    """A similarity, world = scale * rotation @ model + translation."""

    scale: float
    rotation: Floats
    """(3, 3)"""
    translation: Floats
    """(3,), in units of the world"""

    def transform(self, points: ArrayLike) -> Floats:
        """Return points in the world, (..., 3), of points in the model, (..., 3)."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def apply_to_pose(self, model_from_cam: ArrayLike) -> Floats:
        """Return world_from_cam, (..., 4, 4), of cameras in the model, (..., 4, 4).

        The center is transformed, the orientation turned; the camera keeps its own meters, so the pose stays rigid.
        """
        pose = np.asarray(model_from_cam, np.float64)
        return geometry.make_pose(self.rotation @ pose[..., :3, :3], self.transform(pose[..., :3, 3]))

    def inverse(self) -> Sim3:
        """Return the similarity from the world to the model."""
        return Sim3(1 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale)


@dataclass(frozen=True)
class Alignment:
    """How predicted cameras lie in the map, and how well that is known.

    Standard deviations are lengths of vectors: the root of the trace of a covariance.
    """

    world_from_model: Sim3
    """Where the scale is unknown, its `scale` is the likeliest one, positive and finite but of no value as a
    measurement, and the centroids of the consistent references still coincide."""
    inliers: Bools
    """(M,) references whose predicted relative poses agree with the map's."""
    scale_std: float
    """Relative standard deviation of the scale; inf if unknown."""
    rotation_std_deg: float
    """Of the rotation; inf if unknown."""
    rmse_m: float
    """Of the inliers' centers, after alignment; nan without inliers."""
    reason: str
    """What was left out or is unknown, and why; empty if nothing."""
    num_rivals: int
    """The most references left out that agree with each other on another alignment: 1 for a lone wrong one."""
    centroid_m: Floats
    """(3,) weighted centroid of the inliers in the world; about it rotation, scale and place are uncorrelated."""
    rotation_covariance: Floats
    """(3, 3) of a small rotation in the world's frame, radians."""
    centroid_covariance: Floats
    """(3, 3) of the place of the model's centroid in the world, square meters."""
    rotation_noise_deg: float
    """Estimated noise of a predicted orientation, of which `rotation_std_deg` is made; also the query's."""
    center_noise_m: float
    """Estimated noise of a predicted center, brought to meters; also the query's."""

    @property
    def scale_known(self) -> bool:
        return bool(np.isfinite(self.scale_std))

    @property
    def num_inliers(self) -> int:
        return int(self.inliers.sum())


def align_to_map(
    model_from_cams: ArrayLike,
    world_from_cams: ArrayLike,
    weights: ArrayLike | None = None,
    depth_ratios: DepthSamples | None = None,
    *,
    depth_ratio_stds: DepthSamples | None = None,
    center_noise_m: float = 0.02,
    rotation_noise_deg: float = 1.0,
    max_scale_std: float = 0.2,
) -> Alignment:
    """Find the similarity from a predicted frame to the map, robustly.

    The likelihood of each camera is a mixture of the noise about its place in the map and a constant for a wrong
    one. Every reference and every pair proposes a similarity (with the pair's baseline for scale, and with the
    depth ratios'); the most likely ones are refined by expectation maximization, in which the noise is estimated
    too, and the best is kept.

    Args:
        model_from_cams: (M, 4, 4) predicted poses of the references. One with a number that is not finite is left out.
        world_from_cams: (M, 4, 4) their poses in the map, meters; left out likewise.
        weights: (M,) relative confidence, not negative: the variance of a camera's noise goes with 1 / weight, its
            say in which references are right with weight. 0 leaves a reference out.
        depth_ratios: metric over predicted depth of map points seen in references. One array (R,), or a list or
            tuple of M arrays, one a reference: then those of references left out are not used, and what a
            reference's samples have in common counts in their uncertainty. Up to 40 % may be wrong. Samples that
            are not finite or not positive are left out.
        depth_ratio_stds: relative standard deviations of the samples, of the same shape, if they differ; only their
            proportions count.
        center_noise_m: the noise expected of a predicted center, as a length. 1 % of the references' typical
            distance is added, in squares. As for `rotation_noise_deg`, the data decide within some factors of it.
        rotation_noise_deg: the noise expected of a predicted orientation, as an angle.
        max_scale_std: a scale with a larger relative standard deviation is called unknown.

    Returns:
        The alignment. Nothing is raised for few, coincident, collinear or contradicting references: what cannot be
        known then has an infinite standard deviation, and `reason` says why.

    Raises:
        AlignmentError: a wrong shape, a matrix that is not a rigid pose (its index is named), a negative weight.
    """
    model, model_finite = rigid_poses(model_from_cams, "model_from_cams")
    world, world_finite = rigid_poses(world_from_cams, "world_from_cams")
    if len(model) != len(world):
        raise AlignmentError(f"Found {len(model)} model_from_cams and {len(world)} world_from_cams: expected as many.")
    weight = checked_weights(weights, len(model))
    ratios = _DepthRatios.of(depth_ratios, depth_ratio_stds, len(model))
    for name, value in (("center_noise_m", center_noise_m), ("rotation_noise_deg", rotation_noise_deg)):
        if not (np.isfinite(value) and value > 0):
            raise AlignmentError(f"{name} is {value}: expected a number above 0.")
    finite = model_finite & world_finite
    notes = []
    if not finite.all():
        notes.append(f"references {listed(~finite)} left out: not finite")
    usable = np.flatnonzero(finite & (weight > 0))
    if not len(usable):
        return _nothing_known(len(model), [*notes, "no usable reference"])
    problem = _Problem(
        model[usable], world[usable], weight[usable] / weight[usable].mean(), center_noise_m, rotation_noise_deg
    )
    depth = ratios.estimate(None)
    found = problem.search(depth)
    left_out = ~found.inliers
    num_rivals, undecided = 0, False
    if left_out.any():
        others = problem.subset(left_out)
        # Twice the noise of those found: more than that and they do not agree.
        noise = found.state.with_noise(2.0)
        rival = others.search(depth, (float(noise.rotation_noise[0]), float(noise.center_noise[0])))
        num_rivals = int(rival.inliers.sum())
        support, against = problem.weight[found.inliers].sum(), others.weight[rival.inliers].sum()
        undecided = bool(against > 0.9 * support)
        excluded = np.zeros(len(model), bool)
        excluded[usable[left_out]] = True
        notes.append(f"references {listed(excluded)} left out: their poses contradict the others'")
    inliers = np.zeros(len(model), bool)
    inliers[usable[found.inliers]] = True
    if ratios.grouped and left_out.any():
        depth = ratios.estimate(inliers)
    notes += ratios.notes
    alignment = problem.solve(found, depth, max_scale_std, notes)
    alignment = replace(alignment, inliers=inliers, num_rivals=num_rivals)
    if undecided:
        why = f"{alignment.num_inliers} references agree, and {num_rivals} others on another alignment: undecided"
        alignment = replace(
            alignment,
            scale_std=np.inf,
            rotation_std_deg=np.inf,
            rotation_covariance=np.diag(np.full(3, np.inf)),
            centroid_covariance=np.diag(np.full(3, np.inf)),
            reason="; ".join([*notes, why]),
        )
    return alignment


def query_pose(alignment: Alignment, model_from_query: ArrayLike) -> tuple[Floats, Floats]:
    """Bring a predicted camera into the map, with its covariance.

    The covariance has the toolkit's convention, that of `localizers.pnp.PoseEstimate`: (6, 6) of a small motion of
    the camera in its own frame, world_from_cam @ Exp(d), d = rotation, radians, then translation, meters. It holds
    the query's own noise, taken to be that of the references, the alignment's rotation and scale acting over the
    distance from the references' centroid, and the centroid's place. Its blocks of place (of everything) are infinite
    on the diagonal where the scale (the alignment) is unknown.

    Args:
        alignment: of `align_to_map`.
        model_from_query: (4, 4) predicted with the references, in their frame.

    Returns:
        world_from_query (4, 4) and its covariance (6, 6).

    Raises:
        AlignmentError: not a rigid pose, or not finite.
    """
    model, finite = rigid_poses(np.asarray(model_from_query, np.float64)[None], "model_from_query")
    if not finite[0]:
        raise AlignmentError("model_from_query is not finite: expected a rigid pose (4, 4).")
    pose = alignment.world_from_model.apply_to_pose(model[0])
    if not np.isfinite(alignment.rotation_std_deg):
        return pose, np.diag(np.full(6, np.inf))
    arm = pose[:3, 3] - alignment.centroid_m
    noise_rad = np.radians(alignment.rotation_noise_deg)
    shared = np.zeros((6, 6))
    moved = np.vstack([np.eye(3), -_skew(arm)])  # a rotation e of the model turns the query by e, moves it by e x arm
    shared += moved @ alignment.rotation_covariance @ moved.T
    shared[:3, :3] += np.eye(3) * noise_rad**2 / 3
    if alignment.scale_known:
        shared[3:, 3:] += alignment.centroid_covariance + np.outer(arm, arm) * alignment.scale_std**2
        shared[3:, 3:] += np.eye(3) * alignment.center_noise_m**2 / 3
    to_camera = np.kron(np.eye(2), pose[:3, :3].T)
    covariance = to_camera @ shared @ to_camera.T
    if not alignment.scale_known:
        covariance[3:] = covariance[:, 3:] = 0.0
        covariance[3:, 3:] = np.diag(np.full(3, np.inf))
    return pose, covariance


def is_trustworthy(
    alignment: Alignment,
    covariance: Floats,
    *,
    max_position_std_m: float = 0.2,
    max_rotation_std_deg: float = 2.25,
    min_inliers: int = 2,
    max_rival_share: float = 0.5,
) -> bool:
    """Say whether a pose of `query_pose` may be called `ok`.

    The defaults ask that (5 deg, 0.5 m) is more than 2.2 standard deviations away (2.5 for the place, whose error may
    lie along one axis), that references confirm each other, and that no large other group agrees on something else.

    Args:
        alignment: that the pose came from.
        covariance: (6, 6) of the pose, as `query_pose` gives it.
        max_position_std_m: root of the trace of the covariance of the place.
        max_rotation_std_deg: root of the trace of that of the rotation.
        min_inliers: least number of consistent references. Nothing checks a single one.
        max_rival_share: largest other group of references which agree, 2 or more, over the number of inliers.
    """
    rivals = alignment.num_rivals if alignment.num_rivals > 1 else 0
    return bool(
        alignment.scale_known
        and alignment.num_inliers >= min_inliers
        and rivals <= max_rival_share * alignment.num_inliers
        and np.sqrt(np.trace(covariance[3:, 3:])) <= max_position_std_m
        and np.degrees(np.sqrt(np.trace(covariance[:3, :3]))) <= max_rotation_std_deg
    )


class _Problem:
    """References in both frames. Hypotheses are batched: K of them have a membership (K, M) of each reference."""

    def __init__(self, model: Floats, world: Floats, weight: Floats, center_noise_m: float, rotation_noise_deg: float):
        self.weight = weight
        self.expected = (center_noise_m, rotation_noise_deg)
        self.world_from_model = world[:, :3, :3] @ np.swapaxes(model[:, :3, :3], -1, -2)  # each camera's own opinion
        self.flat_opinions = self.world_from_model.reshape(-1, 9)
        self.model, self.world = model, world
        # About a reference near the middle: products of large coordinates would lose digits.
        self.origin_m, self.origin_c = _middle(model[:, :3, 3]), _middle(world[:, :3, 3])
        self.m, self.c = model[:, :3, 3] - self.origin_m, world[:, :3, 3] - self.origin_c
        # Sums over references become products with a membership.
        self.outer_cm = (self.c[:, :, None] * self.m[:, None, :]).reshape(-1, 9)
        typical = np.median(np.linalg.norm(self.c, axis=1))
        # Noise by axis, of which three make the length.
        self.center_prior = float(np.hypot(center_noise_m, CENTER_NOISE_SHARE * typical) / np.sqrt(3))
        self.rotation_prior = float(np.radians(rotation_noise_deg) / np.sqrt(3))
        first, second = np.triu_indices(len(self.m), 1)
        gaps_m, gaps_c = (((x[first] - x[second]) ** 2).sum(axis=1) for x in (self.m, self.c))
        # Room, in the model, in which a wrong camera may be: the references' extent.
        self.extent = float(np.sqrt(np.mean(gaps_m))) if len(first) else 0.0
        apart = gaps_m > 1e-18 * max(self.extent**2, 1e-300)
        ratios = np.sqrt((gaps_c[apart] + 6 * self.center_prior**2) / gaps_m[apart])
        # For want of better where centers say nothing.
        self.rough_scale = float(np.median(ratios)) if apart.any() else 1.0

    def subset(self, kept: Bools) -> _Problem:
        return _Problem(self.model[kept], self.world[kept], self.weight[kept], *self.expected)

    def search(self, depth: _Scale | None, noise: tuple[float, float] | None = None) -> _Found:
        """Return the most likely similarity and which references agree with it, within this noise if it is known."""
        count = len(self.m)
        first, second = np.triu_indices(count, 1)
        members = np.zeros((len(first) + count, count))
        members[np.arange(len(first)), first] = members[np.arange(len(first)), second] = 1.0
        members[len(first) + np.arange(count), np.arange(count)] = 1.0
        state = self.fit(members, self.opening(members), None)
        if depth is not None:
            state = state.joined(self.fit(members, self.opening(members), depth))
        # A proposal from two noisy cameras predicts the others less well than the noise says.
        residuals = self.residuals(state)
        scores = np.max([self.score(state.with_noise(factor), residuals)[0] for factor in (1.0, 3.0, 9.0)], axis=0)
        state = state[np.argsort(-scores, kind="stable")[:_STARTS]].with_noise(3.0)
        _, members = self.score(state, self.residuals(state))
        for _ in range(_ROUNDS):
            state = self.fit(members, state, depth)
            residuals = self.residuals(state)
            if noise is None:
                state = state.with_noise_of(self, members, residuals)
            else:
                fixed = (np.full(len(state.scale), value) for value in noise)
                state = replace(state, **dict(zip(("rotation_noise", "center_noise"), fixed, strict=True)))
            before = members
            scores, members = self.score(state, residuals)
            best = int(np.argmax(scores))
            if np.abs(members[best] - before[best]).max() < 1e-3:
                break
        inliers = members[best] > 0.5
        if not inliers.any():
            inliers[np.argmax(members[best])] = True
        return _Found(state[best : best + 1], np.where(inliers, np.maximum(members[best], 0.5), 0.0), inliers)

    def opening(self, members: Floats) -> _State:
        """Return a state to fit memberships (K, M) from: the orientations' mean and the noise expected."""
        count = len(members)
        opinions = ((members * self.weight) @ self.flat_opinions).reshape(-1, 3, 3)
        return _State(
            rotation=_nearest_rotation(opinions),
            scale=np.full(count, self.rough_scale),
            mean_c=np.zeros((count, 3)),
            mean_m=np.zeros((count, 3)),
            rotation_noise=np.full(count, self.rotation_prior),
            center_noise=np.full(count, self.center_prior),
        )

    def fit(self, members: Floats, last: _State, depth: _Scale | None) -> _State:
        """Return the weighted least squares similarities (K) of memberships (K, M), given noise by axis.

        First the scale for the last rotation, then the rotation for that scale, each in closed form. The scale
        maximizes s^D exp(-|c - s R m|^2 / (2 noise^2)), the likelihood of the model's centers over D coordinates: it
        is free of the bias, and positive whatever the data. The rotation joins orientations and baselines (Wahba
        1965).
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
        # The positive root of square_m s^2 - along s - room, in the form that loses no digits.
        over = np.where(along > 0, along + root, 2 * room)
        under = np.where(along > 0, 2 * square_m, root - along)
        scale = over / np.where(apart, under, 1.0)
        scale = np.where(apart, scale, depth.value if depth is not None else self.rough_scale)
        if depth is not None:
            square_c = (share * ((self.c[None] - mean_c[:, None]) ** 2).sum(axis=2)).sum(axis=1)
            from_centers, from_depth = square_c / variance, 1 / max(depth.std, 1e-6) ** 2
            part = from_centers / (from_centers + from_depth)
            scale = np.exp(part * np.log(scale) + (1 - part) * np.log(depth.value))
        opinions = (share @ self.flat_opinions).reshape(-1, 3, 3) / (last.rotation_noise**2)[:, None, None]
        rotation = _nearest_rotation(opinions + (2 * scale / variance)[:, None, None] * cross)
        return _State(rotation, scale, mean_c, mean_m, last.rotation_noise, last.center_noise)

    def residuals(self, state: _State) -> tuple[Floats, Floats]:
        """Return squared angles (K, M), radians, and squared distances (K, M), meters."""
        trace = state.rotation.reshape(-1, 9) @ self.flat_opinions.T
        moved = (self.m[None] - state.mean_m[:, None]) @ np.swapaxes(state.rotation, 1, 2) * state.scale[:, None, None]
        distance = ((self.c[None] - state.mean_c[:, None] - moved) ** 2).sum(axis=2)
        # 2 (1 - cos) of the angle: its square where it is small.
        return np.maximum(3 - trace, 0), distance

    def score(self, state: _State, residuals: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Return the log likelihoods (K) and the probability of each reference to be right (K, M)."""
        angle, distance = residuals
        rotation_noise = state.rotation_noise[:, None] / np.sqrt(self.weight)
        center_noise = state.center_noise[:, None] / np.sqrt(self.weight)
        # The density of a wrong one is constant: over all rotations, and over a room about the references. It is the
        # model's, brought to meters: a scale near zero, which puts all centers at one place, makes it small too.
        room = 3 * (state.scale * self.extent)[:, None] + WRONG_PLACE * self.center_prior
        turned = _LOG_SPHERE - _LOG_PEAK - 3 * np.log(rotation_noise) - angle / (2 * rotation_noise**2)
        placed = 3 * np.log(room / center_noise) - _LOG_PEAK - distance / (2 * center_noise**2)
        right = np.log(1 - OUTLIER_SHARE) + turned + placed
        # Wrong in both, or only in place, or only in orientation.
        wrong = np.log(OUTLIER_SHARE / 3) + np.logaddexp(0.0, np.logaddexp(turned, placed))
        either = np.logaddexp(right, wrong)
        likelihood = either @ self.weight  # a confident reference has more of a say, too
        for noise, expected in ((state.rotation_noise, self.rotation_prior), (state.center_noise, self.center_prior)):
            likelihood = likelihood - (np.log(noise / expected) / NOISE_FACTOR) ** 2 / 2
        return likelihood, np.exp(right - either)

    def solve(self, found: _Found, depth: _Scale | None, max_scale_std: float, notes: list[str]) -> Alignment:
        """Return the weighted least squares alignment of the references found, with what it is worth."""
        state, share = found.state, found.members * self.weight
        rotation, scale = state.rotation[0], float(state.scale[0])
        rotation_noise, center_noise = float(state.rotation_noise[0]), float(state.center_noise[0])
        count = float(found.members.sum())
        c0, m0 = share @ self.c / share.sum(), share @ self.m / share.sum()
        c, m = self.c - c0, self.m - m0
        square_c = float(share @ (c**2).sum(axis=1))
        lever = np.eye(3) * square_c - np.einsum("m,mi,mj->ij", share, c, c)  # how baselines hold the rotation
        opinions = np.einsum("m,mij->ij", share, self.world_from_model)
        cross = np.einsum("m,mi,mj->ij", share, c, m)
        for _ in range(4):
            fitted = _State(rotation[None], *(np.array([x]) for x in (scale, c0, m0, rotation_noise, center_noise)))
            rotation = _nearest_rotation(
                (opinions / rotation_noise**2 + 2 * scale / center_noise**2 * cross)[None], keep=rotation
            )[0]
            estimate = _combined_scale(float(np.sum(rotation * cross)), square_c, center_noise / scale, depth)
            scale_std, conflict = (estimate.std, estimate.conflict) if estimate is not None else (np.inf, False)
            if estimate is not None and scale_std <= max_scale_std:
                scale = estimate.value
            else:
                scale = float(self.fit(found.members[None], fitted, depth).scale[0])
            fitted = replace(fitted, rotation=rotation[None], scale=np.array([scale]))
            angle, distance = (values[0] @ share for values in self.residuals(fitted))
            # The rotation is shared by orientations and baselines; each pays for its part.
            by_orientation, by_baselines = 3 * share.sum() / rotation_noise**2, np.trace(lever) / center_noise**2
            part = by_orientation / (by_orientation + by_baselines)
            free = (3 * count - 3 * part, 3 * (count - 1) - 3 * (1 - part) - float(square_c > 0))
            rotation_noise = float(np.sqrt(noise_variance(angle, max(free[0], 0.0), self.rotation_prior)))
            center_noise = float(np.sqrt(noise_variance(distance, max(free[1], 0.0), self.center_prior)))
        known = scale_std <= max_scale_std
        notes = list(notes)
        if conflict:
            notes.append("depth ratios and baselines contradict each other on the scale")
        if not known:
            if depth is None:
                notes.append("scale unknown: baselines not above the noise of the centers, and no depth ratios")
            else:
                notes.append("scale unknown: neither baselines nor depth ratios give it well enough")
        translation = self.origin_c + c0 - scale * rotation @ (self.origin_m + m0)
        covariance = np.linalg.inv(np.eye(3) * share.sum() / rotation_noise**2 + lever / center_noise**2)
        plain = ((c - scale * m @ rotation.T) ** 2).sum(axis=1)
        return Alignment(
            world_from_model=Sim3(scale, rotation, translation),
            inliers=found.inliers,
            scale_std=scale_std if known else np.inf,
            rotation_std_deg=float(np.degrees(np.sqrt(np.trace(covariance)))),
            rmse_m=float(np.sqrt(plain[found.inliers].mean())),
            reason="; ".join(notes),
            num_rivals=0,
            centroid_m=self.origin_c + c0,
            rotation_covariance=covariance,
            centroid_covariance=np.eye(3) * center_noise**2 / share.sum(),
            rotation_noise_deg=float(np.degrees(rotation_noise) * np.sqrt(3)),
            center_noise_m=float(center_noise * np.sqrt(3)),
        )


@dataclass(frozen=True)
class _State:
    """K similarities world = scale R (model - mean_m) + mean_c, with their noise by axis."""

    rotation: Floats
    scale: Floats
    mean_c: Floats
    mean_m: Floats
    rotation_noise: Floats
    center_noise: Floats

    def _parts(self) -> tuple[Floats, ...]:
        return self.rotation, self.scale, self.mean_c, self.mean_m, self.rotation_noise, self.center_noise

    def __getitem__(self, index: Ints | slice) -> _State:
        return _State(*(part[index] for part in self._parts()))

    def joined(self, other: _State) -> _State:
        return _State(*(np.concatenate(pair) for pair in zip(self._parts(), other._parts(), strict=True)))

    def with_noise(self, factor: float) -> _State:
        return replace(self, rotation_noise=self.rotation_noise * factor, center_noise=self.center_noise * factor)

    def with_noise_of(self, problem: _Problem, members: Floats, residuals: tuple[Floats, Floats]) -> _State:
        angle, distance = ((members * values) @ problem.weight for values in residuals)
        free = 3 * np.maximum(members.sum(axis=1) - 1, 0)
        return replace(
            self,
            rotation_noise=np.sqrt(noise_variance(angle, free, problem.rotation_prior)),
            center_noise=np.sqrt(noise_variance(distance, np.maximum(free - 1, 0), problem.center_prior)),
        )


@dataclass(frozen=True)
class _Found:
    state: _State
    """One similarity."""
    members: Floats
    """(M,) probability to be right, 0 where left out."""
    inliers: Bools


@dataclass(frozen=True)
class _Scale:
    """A scale and its relative standard deviation."""

    value: float
    std: float
    conflict: bool = False


def _combined_scale(along: float, square_c: float, noise_in_model: float, depth: _Scale | None) -> _Scale | None:
    """Join the scale of baselines and of depth ratios, or None if there is neither.

    1 / scale is linear in the model's noisy centers, so it is averaged by inverse variance. Two that differ by more
    than their uncertainty widen it, as in Birge (1932).
    """
    values, variances = [], []
    if square_c > 0:
        values.append(along / square_c)
        variances.append(max(noise_in_model**2 / square_c, 1e-300))
    if depth is not None:
        values.append(1 / depth.value)
        variances.append(max((depth.std / depth.value) ** 2, 1e-300))
    if not values:
        return None
    information = 1 / np.array(variances)
    value = float(information @ np.array(values) / information.sum())
    if value <= 0:
        return None
    variance, conflict = 1 / information.sum(), False
    if len(values) == 2:
        squared = (values[0] - values[1]) ** 2 / (variances[0] + variances[1])
        conflict = bool(squared > 3.0**2)
        variance *= squared if conflict else 1.0
    return _Scale(1 / value, float(np.sqrt(variance)) / value, conflict)


@dataclass(frozen=True)
class _DepthRatios:
    """Logarithms of ratios with relative standard deviations (proportions) and the reference of each, or -1."""

    log: Floats
    stds: Floats
    reference: Ints
    notes: list[str]

    @classmethod
    def of(cls, ratios: DepthSamples | None, stds: DepthSamples | None, count: int) -> _DepthRatios:
        if ratios is None:
            return cls(np.zeros(0), np.zeros(0), np.zeros(0, np.int64), [])
        values, reference = _samples(ratios, count, "depth_ratios")
        spread = np.ones(len(values))
        if stds is not None:
            spread, other = _samples(stds, count, "depth_ratio_stds")
            if not np.array_equal(other, reference):
                raise AlignmentError("depth_ratio_stds has another shape than depth_ratios: expected one a sample.")
            if not np.all(np.isfinite(spread) & (spread > 0)):
                raise AlignmentError("depth_ratio_stds holds a number that is not finite and above 0.")
        with np.errstate(invalid="ignore"):
            kept = np.isfinite(values) & (values > 0)
        dropped = int((~kept).sum())
        notes = [f"{dropped} of {len(kept)} depth ratios left out: not finite and positive"] if dropped else []
        return cls(np.log(values[kept]), spread[kept], reference[kept], notes)

    @property
    def grouped(self) -> bool:
        return len(self.reference) > 0 and bool(self.reference[0] >= 0)

    def estimate(self, inliers: Bools | None) -> _Scale | None:
        """Return the scale of the samples, of these references only if they are told apart; None without samples.

        The mixture of noise about one value and of wrong samples anywhere is fitted by expectation maximization,
        from the middle of the shortest interval that holds half of them (Rousseeuw 1984). What a reference's samples
        have in common is found by the moments of DerSimonian and Laird (1986).
        """
        kept = inliers[self.reference] if self.grouped and inliers is not None else np.ones(len(self.log), bool)
        log, stds, reference = self.log[kept], self.stds[kept], self.reference[kept]
        if not len(log):
            return None
        stds = stds / np.sqrt(np.mean(stds**2))
        ordered = np.sort(log)
        half = (len(log) + 1) // 2 + (len(log) > 2)
        widths = ordered[half - 1 :] - ordered[: len(log) - half + 1]
        start = int(np.argmin(widths))
        center = (ordered[start] + ordered[start + half - 1]) / 2
        noise = max(widths[start], 1e-3)
        room = np.log(max(ordered[-1] - ordered[0], 1.0) + 1.0)
        wrong = OUTLIER_SHARE
        for _ in range(15):
            spread = noise * stds
            right = np.log1p(-wrong) - np.log(spread * np.sqrt(2 * np.pi)) - ((log - center) / spread) ** 2 / 2
            members = 1 / (1 + np.exp(np.clip(np.log(wrong) - room - right, -700, 700)))
            share = members / stds**2
            center = float(share @ log / share.sum())
            squares, free = share @ (log - center) ** 2, max(members.sum() - 1, 0.0)
            noise = float(np.sqrt(noise_variance(squares, free, DEPTH_NOISE)))
            before, wrong = wrong, float(np.clip(1 - members.mean(), 0.01, 0.6))
            if abs(wrong - before) < 1e-4:
                break
        variance = noise**2 / share.sum()
        if self.grouped:
            center, variance = _between(log, share, reference, noise, center, variance)
        return _Scale(float(np.exp(center)), float(np.sqrt(variance)))


def _between(
    log: Floats, share: Floats, reference: Ints, noise: float, center: float, variance: float
) -> tuple[float, float]:
    """Return the mean of references' means and its variance, with the variance between references."""
    _, index = np.unique(reference, return_inverse=True)
    total = np.bincount(index, share)
    held = total > 0.5  # a reference all of whose samples are wrong says nothing
    if held.sum() < 2:
        return center, variance
    means = np.bincount(index, share * log)[held] / total[held]
    information = total[held] / noise**2
    excess = information @ (means - information @ means / information.sum()) ** 2 - (len(means) - 1)
    between = max(excess / (information.sum() - (information**2).sum() / information.sum()), 0.0)
    information = 1 / (1 / information + between)
    return float(information @ means / information.sum()), float(1 / information.sum())


def noise_variance(squares: ArrayLike, free: ArrayLike, expected: float) -> Floats:
    """Return the mean of the variance by axis, (...), given sums of squared residuals and their degrees of freedom.

    The prior of the noise is log-normal about `expected`, within a factor of exp(NOISE_FACTOR). The mean of the
    variance, not the likeliest, is what the variance of an estimate is in proportion to.
    """
    squares, free = np.asarray(squares)[..., None], np.asarray(free)[..., None]
    logs = np.log(_LEVELS)
    log_density = -((logs / NOISE_FACTOR) ** 2) / 2 - free * logs - squares / (2 * (expected * _LEVELS) ** 2)
    density = np.exp(log_density - log_density.max(axis=-1, keepdims=True))
    return np.asarray(expected**2 * (density @ _LEVELS**2) / density.sum(axis=-1))


def _nearest_rotation(matrices: Floats, keep: Floats | None = None) -> Floats:
    """Return the rotations (K, 3, 3) with the largest trace of their transpose times the matrices (Umeyama 1991).

    `keep` is returned where a matrix is zero.
    """
    U, values, Vt = np.linalg.svd(matrices)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    rotations = U @ Vt
    if keep is not None:
        rotations = np.where((values[..., 0] > 0)[..., None, None], rotations, keep)
    return np.asarray(rotations, np.float64)


def _middle(points: Floats) -> Floats:
    """Return the point (3,) of points (M, 3) with the least sum of distances to the others."""
    distances = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=2))
    return np.asarray(points[np.argmin(distances.sum(axis=1))], np.float64)


def _skew(vector: Floats) -> Floats:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rigid_poses(poses: ArrayLike, name: str) -> tuple[Floats, Bools]:
    """Return poses (M, 4, 4) with their rotations made exact, and which are finite; the others are identities.

    Raises:
        AlignmentError: a wrong shape, or what is finite and no rigid pose; names it by `name` and its index.
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
            f"{name}[{bad[0]}] {what}: expected a rigid pose, its rotation orthonormal to 1e-3. "
            "A scale or a flip of axes has to be taken out before."
        )
    matrices[:, :3, :3] = _nearest_rotation(R)
    return matrices, finite


def checked_weights(weights: ArrayLike | None, count: int) -> Floats:
    """Return weights (count,), all 1 where there are none.

    Raises:
        AlignmentError: a wrong shape, or one that is negative or not finite.
    """
    if weights is None:
        return np.ones(count)
    values = np.asarray(weights, np.float64)
    if values.shape != (count,):
        raise AlignmentError(f"weights has shape {values.shape}: expected ({count},), one a camera.")
    bad = np.flatnonzero(~np.isfinite(values) | (values < 0))
    if len(bad):
        raise AlignmentError(f"weights[{bad[0]}] is {values[bad[0]]}: expected a finite number, 0 or more.")
    return values


def _samples(samples: DepthSamples, count: int, name: str) -> tuple[Floats, Ints]:
    """Return samples (R,) and the reference of each, -1 where they are not told apart."""
    if isinstance(samples, list | tuple) and any(np.ndim(part) > 0 for part in samples):
        if len(samples) != count:
            raise AlignmentError(f"{name} has {len(samples)} arrays: expected one array, or {count}, one a reference.")
        parts = [np.asarray(part, np.float64).ravel() for part in samples]
        return np.concatenate(parts), np.repeat(np.arange(count), [len(part) for part in parts])
    values = np.asarray(samples, np.float64)
    if values.ndim != 1:
        raise AlignmentError(f"{name} has shape {values.shape}: expected (R,), or a list of {count} arrays.")
    return values, np.full(len(values), -1)


def listed(chosen: Bools) -> str:
    """Return the indices that are chosen, as a message lists them."""
    return ", ".join(str(index) for index in np.flatnonzero(chosen))


def _nothing_known(count: int, notes: list[str]) -> Alignment:
    unknown = np.diag(np.full(3, np.inf))
    return Alignment(
        world_from_model=Sim3(1.0, np.eye(3), np.zeros(3)),
        inliers=np.zeros(count, bool),
        scale_std=np.inf,
        rotation_std_deg=np.inf,
        rmse_m=np.nan,
        reason="; ".join(notes),
        num_rivals=0,
        centroid_m=np.zeros(3),
        rotation_covariance=unknown,
        centroid_covariance=unknown,
        rotation_noise_deg=np.inf,
        center_noise_m=np.inf,
    )
