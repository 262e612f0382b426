"""Odometry, the motion that a device measures in a frame of its own, and its placement in the map by single queries.

Each loss of tracking ends a piece; every piece has its own frame. Odometry drifts: the relative pose of two frames of a
piece becomes less certain with the distance traveled and the time between them.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.capture import Session, Trajectory
from toolkit.geometry import Floats, Ints
from toolkit.manifest import SequenceSettings

MIN_STD_M, MIN_STD_DEG = 0.001, 0.005
"""Standard deviation by axis that is added to each single pose, whose covariance has the noise of the map already.
With ten times as much, odometry pulled the poses of an exact map by 0.5 mm in the median, twice their error."""
JUMP_M, JUMP_DEG = 0.2, 20.0
"""Tracking was lost if a step is further than this from all steps that the largest acceleration allows."""
MAX_GAP_S = 10.0
"""A longer time without odometry counts as a loss of tracking: a new piece with its own frame begins."""
MAX_SPEED_M_S = 15.0
"""A faster motion between two poses also counts as a loss of tracking."""
ACCELERATION_M_S2, ACCELERATION_DEG_S2 = 10.0, 500.0
"""Largest acceleration of a hand, a head or a wheel."""
_BLIND_S = 0.8
"""In a step longer than this, a device may accelerate and stop again, so a jump does not show."""
_TELLING = 2 / 3
"""Least probability of a pose that counts as independent evidence: every other pose is at most half as likely."""
_CHI2_99 = 16.81
"""99 % quantile of the chi-squared distribution with 6 degrees of freedom."""
_SHARE, _CHI2_3 = 0.25, 1.213
"""A probability, and that quantile of the chi-squared distribution with 3 degrees of freedom."""
_PAIRS = 1 << 18
"""Pairs of queries that are compared at a time, to limit memory."""
_MIN_MOTIONS = 6
"""Fewer motions do not determine the drift."""
_MAX_DRIFT = 20.0
"""Largest factor on the drift of the settings. More means that this is no odometry, or most single poses are wrong."""


@dataclass(frozen=True)
class Odometry:
    """N poses of one device in the odometry's own frame, in order of time."""

    timestamps: Ints
    """(N,) microseconds."""
    odom_from_rig: Floats
    """(N, 4, 4), meters."""

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def traveled_m(self) -> Floats:
        """(N,) distance traveled since the first pose, meters."""
        steps = np.diff(self.odom_from_rig[:, :3, 3], axis=0)
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])

    def scaled(self, factor: float) -> "Odometry":
        """Return the odometry with all translations multiplied by a factor."""
        return replace(self, odom_from_rig=geometry.scaled(self.odom_from_rig, factor))

    def drift(self, settings: SequenceSettings, first: Ints, second: Ints) -> tuple[Floats, Floats]:
        """Return standard deviations (n,) by axis of the relative poses of n pairs of frames: radians, meters."""
        traveled, seconds = self.traveled_m, self.timestamps / 1e6
        rotation = np.deg2rad(settings.rotation_drift_deg) * np.sqrt(np.abs(seconds[first] - seconds[second]))
        # A random walk: many short steps add up to the same as one long step.
        return rotation, settings.position_drift * np.sqrt(np.abs(traveled[first] - traveled[second]))

    def part(self, frames: slice) -> "Odometry":
        """Return some consecutive frames."""
        return Odometry(self.timestamps[frames], self.odom_from_rig[frames])

    def at(self, timestamps: Ints) -> tuple[Ints, Floats]:
        """Interpolate poses at some times, with constant velocity and rate of rotation between two frames.

        Returns:
            Indices (n,) of the times within the odometry, and their odom_from_rig (n, 4, 4).
        """
        after = np.searchsorted(self.timestamps, timestamps).clip(max=len(self) - 1)
        before = np.maximum(after - (self.timestamps[after] > timestamps), 0)
        inside = np.flatnonzero((self.timestamps[before] <= timestamps) & (timestamps <= self.timestamps[after]))
        first, second = (self.odom_from_rig[each[inside]] for each in (before, after))
        past, whole = ((each - self.timestamps[before])[inside] for each in (timestamps, self.timestamps[after]))
        share = (past / np.maximum(whole, 1))[:, None]
        turn = Rotation.from_matrix(second[:, :3, :3] @ first[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        turned = Rotation.from_rotvec(share * turn).as_matrix() @ first[:, :3, :3]
        moved = first[:, :3, 3] + share * (second - first)[:, :3, 3]
        return inside, geometry.make_pose(turned, moved)

    def joined(self, timestamps: Ints, odom_from_rig: Floats) -> tuple["Odometry", Ints]:
        """Insert more poses. Return the odometry and the index of each frame in (own frames, then the new ones)."""
        times = np.append(self.timestamps, timestamps)
        order = np.argsort(times, kind="stable")
        return Odometry(times[order], np.concatenate([self.odom_from_rig, odom_from_rig])[order]), order

    def split(self) -> list[slice]:
        """Split at losses of tracking: gaps in time, and steps that no device makes.

        Such a step is too fast, or no possible acceleration leads to its speed from the speeds of the steps beside it.
        """
        seconds = np.diff(self.timestamps) / 1e6
        lost = (seconds > MAX_GAP_S) | (np.diff(self.traveled_m) > MAX_SPEED_M_S * seconds)
        ends = [0, *(np.flatnonzero(lost | self._jumps(seconds)) + 1).tolist(), len(self)]
        return [slice(start, end) for start, end in pairwise(ends) if end > start]

    def _jumps(self, seconds: Floats) -> NDArray[np.bool_]:
        """Return which steps (N - 1,) no possible acceleration explains, from standing still or the neighbor steps."""
        jumps = np.zeros(len(seconds), bool)
        if len(seconds) < 2:
            return jumps
        steps = geometry.invert(self.odom_from_rig[:-1]) @ self.odom_from_rig[1:]
        turns = np.degrees(Rotation.from_matrix(steps[:, :3, :3]).as_rotvec())
        seconds = np.maximum(seconds, 1e-6)
        for moved, least, acceleration in (
            (steps[:, :3, 3], JUMP_M, ACCELERATION_M_S2), (turns, JUMP_DEG, ACCELERATION_DEG_S2),
        ):  # fmt: skip
            speeds = moved / seconds[:, None]
            # The velocity is in the device's own frame, so it is the same in every odometry frame.
            off = np.linalg.norm(np.diff(speeds, axis=0), axis=1) - acceleration * (seconds[1:] + seconds[:-1]) / 2
            # Standing still is always possible, so that a step beside a jump does not count as one.
            still = np.linalg.norm(speeds, axis=1) - acceleration * seconds
            nearest = np.minimum(np.minimum(np.append(off, np.inf), np.insert(off, 0, np.inf)), still)
            jumps |= nearest * seconds > least
        return jumps


def recordings_of(session: Session, odometry: Trajectory) -> dict[str, Ints]:
    """Return the odometry's rows of each recording, in order of time.

    A recording is a subsession, or one device if several devices move in the subsession. Of several poses of a device
    at the same time, the first counts.
    """
    subsessions, recordings = session.subsession_by_prefix(odometry.arrow_ids), dict[str, Ints]()
    names, times = device_names(odometry.timestamps, odometry.device_ids), odometry.timestamps
    repeated = pd.DataFrame({"device": names, "timestamp": times}).duplicated().to_numpy()
    for name in dict.fromkeys(subsessions.tolist()):
        rows = np.flatnonzero((subsessions == name) & ~repeated)
        rows = rows[np.argsort(times[rows], kind="stable")]
        devices = dict.fromkeys(names[rows].tolist())
        # With few poses per name, the names contain something else that changes with time, and the device is the same.
        # But a device is never in two places at once.
        several = 1 < len(devices) <= len(rows) / 2 or len(np.unique(times[rows])) < len(rows)
        recordings |= {device: rows[names[rows] == device] for device in devices} if several else {name: rows}
    return recordings


def device_names(timestamps: Ints, device_ids: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return device names (N,) that do not change with time: some ids of rigs and sensors contain the timestamp."""
    pairs = zip(device_ids.tolist(), timestamps.tolist(), strict=True)
    return np.array([device.replace(str(time), "") for device, time in pairs], object)


@dataclass(frozen=True)
class PosedQueries:
    """Poses of Q single queries in one piece of odometry."""

    frames: Ints
    """(Q,) indices of their frames in the odometry."""
    world_from_rig: Floats
    """(Q, 4, 4)."""
    covariances: Floats
    """(Q, 6, 6) of a small motion in the rig's frame: rotation, radians, then translation, meters."""
    weights: Floats
    """(Q,) probability that each pose is right."""
    trusted: NDArray[np.bool_]
    """(Q,) whether the status is `ok`."""

    def __len__(self) -> int:
        return len(self.frames)

    def choose(self, rows: Ints | NDArray[np.bool_]) -> "PosedQueries":
        return PosedQueries(*(values[rows] for values in vars(self).values()))

    def part(self, frames: slice) -> "PosedQueries":
        """Return the queries in some consecutive frames of the odometry; see `Odometry.part`."""
        within = self.choose((self.frames >= frames.start) & (self.frames < frames.stop))
        return replace(within, frames=within.frames - frames.start)

    def joined(self, other: "PosedQueries") -> "PosedQueries":
        """Return the queries of both, sorted by frame."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        queries = PosedQueries(*(np.concatenate(pair) for pair in pairs))
        return queries.choose(np.argsort(queries.frames, kind="stable"))


UNKNOWN_COVARIANCE = np.diag(np.repeat([0.1, 4.0], 3))
"""Covariance for a pose without one, such as a pose by `nearest`: some meters."""


def vote_weights(ok: NDArray[np.bool_], p_correct: Floats, rival_support: Floats) -> Floats:
    """Return the probability (Q,) that each single pose is right. `p_correct` and `rival_support` may be NaN."""
    # Without a probability, the status decides.
    weights = np.where(np.isnan(p_correct), np.where(ok, 0.95, 0.05), p_correct)
    # Two poses with equal support, e.g. in rooms that look alike, share the probability.
    return np.where(ok, weights, weights / (1 + np.nan_to_num(rival_support)))


def bounded(covariances: Floats) -> Floats:
    """Return covariances (n, 6, 6) of poses plus the variance of errors of the map, `MIN_STD_M`, `MIN_STD_DEG`.

    No direction gets a larger variance than `UNKNOWN_COVARIANCE` has. A pose whose depth is open by 50 m, for example,
    is known to 0.1 mm in other directions, and the graph's linear system would be singular in float64.
    """
    least = np.repeat([np.deg2rad(MIN_STD_DEG), MIN_STD_M], 3) ** 2
    most, limited = UNKNOWN_COVARIANCE.max(), covariances.copy()
    for row in np.flatnonzero(np.trace(covariances, axis1=1, axis2=2) > most):
        variances, directions = np.linalg.eigh(covariances[row])
        limited[row] = directions @ np.diag(variances.clip(max=most)) @ directions.T
    return limited + np.diag(least)


def _variances(queries: PosedQueries) -> tuple[Floats, Floats]:
    """Return mean variances (Q,) by axis of the single poses: square radians, square meters."""
    covariances = bounded(queries.covariances)
    rotation, position = (np.trace(covariances[:, s, s], axis1=1, axis2=2) / 3 for s in (slice(3), slice(3, 6)))
    return rotation, position


@dataclass(frozen=True)
class Placement:
    """A placement of odometry in the map: single poses that agree with each other, given the odometry between them."""

    members: Ints
    """Queries that agree, ascending."""
    support: float
    """Sum of the members' weights."""
    trusted: bool
    """Whether a member is `ok` or three members are likely right, and no rival has half the support."""
    rival_support: float
    """Support of the best other placement."""


def place(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> list[Placement]:
    """Return the rival placements of odometry in the map, by descending support of `ok` queries, then of all queries.

    Each query votes: its pose gives one placement, supported by all queries whose poses this placement predicts within
    the drift and the covariances of both poses. A query supports only one of the returned placements.
    """
    agree = _agreement(odometry, queries, settings)
    left = np.ones(len(queries), bool)
    clusters: list[tuple[Ints, float]] = []
    while left.any():
        seed = int(np.argmax(np.where(left, (agree & left) @ queries.weights, -1.0)))
        members = agree[seed] & left
        # Drop members that contradict most other members: they agree with the seed by chance.
        with_others = agree[:, members] @ queries.weights[members]
        members &= with_others >= 0.5 * queries.weights[members].sum()
        members[seed] = True
        clusters.append((np.flatnonzero(members), float(queries.weights[members].sum())))
        left &= ~members
    clusters.sort(key=lambda cluster: (-queries.weights[cluster[0]] @ queries.trusted[cluster[0]], -cluster[1]))
    placements = []
    for number, (rows, support) in enumerate(clusters):
        rival = max((other for index, (_, other) in enumerate(clusters) if index != number), default=0.0)
        # Many weak poses are no evidence: a look-alike leads all of them to the same wrong place.
        independent = np.count_nonzero(queries.weights[rows] > _TELLING)
        sure = bool(queries.trusted[rows].any() or independent >= 3) and rival < 0.5 * support
        placements.append(Placement(rows, support, sure, rival))
    return placements


def _agreement(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> NDArray[np.bool_]:
    """Return (Q, Q) whether two single poses are consistent with the odometry between them."""
    count = len(queries)
    agree, columns = np.zeros((count, count), bool), np.arange(count)
    for rows in np.array_split(columns, 1 + count**2 // _PAIRS):
        off = _Differences.between(odometry, queries, settings, np.repeat(rows, count), np.tile(columns, len(rows)))
        rotation_var, position_var = off.drift[0] ** 2 + off.rotation_var, off.drift[1] ** 2 + off.position_var
        agree[rows] = (off.angle2 / rotation_var + off.distance2 / position_var < _CHI2_99).reshape(len(rows), count)
    return agree | agree.T


def cut(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> list[slice]:
    """Split at losses of tracking that only the `ok` queries reveal, because a long step hides the jump.

    At such a step, no query before it agrees with any after it, and on either side at least two agree with each other.
    """
    sure = queries.choose(queries.trusted)
    agree, ends, between = _agreement(odometry, sure, settings), [0], slice(0, 0)
    seconds = np.diff(odometry.timestamps) / 1e6
    for count in range(2, len(sure)):
        sides = agree[:count, :count], agree[count:, count:]
        if not agree[:count, count:].any() and min(int(side.sum(axis=1).max()) for side in sides) > 1:
            between = slice(between.start or int(sure.frames[count - 1]), int(sure.frames[count]))
        elif between.stop:  # cut at the longest step of the range, which may include queries that agree with no other
            step = between.start + int(np.argmax(seconds[between]))
            ends += [step + 1] * bool(seconds[step] > _BLIND_S)
            between = slice(0, 0)
    return [slice(start, end) for start, end in pairwise([*ends, len(odometry)])]


@dataclass(frozen=True)
class _Differences:
    """Differences between n relative poses of queries and the odometry between them, and their variances by axis."""

    angle2: Floats
    """(n,) radians squared."""
    distance2: Floats
    """(n,) square meters."""
    drift: tuple[Floats, Floats]
    """Standard deviations (n,) of the odometry: radians, meters."""
    rotation_var: Floats
    """(n,) from the two poses, square radians."""
    position_var: Floats
    """(n,) from the two poses and the odometry's rotation and scale, square meters."""

    @classmethod
    def between(
        cls, odometry: Odometry, queries: PosedQueries, settings: SequenceSettings, first: Ints, second: Ints
    ) -> "_Differences":
        inverse = geometry.invert(odometry.odom_from_rig[queries.frames]), geometry.invert(queries.world_from_rig)
        expected = inverse[0][first] @ odometry.odom_from_rig[queries.frames[second]]
        difference = geometry.invert(expected) @ inverse[1][first] @ queries.world_from_rig[second]
        drift = odometry.drift(settings, queries.frames[first], queries.frames[second])
        rotation, position = _variances(queries)
        rotation_var = rotation[first] + rotation[second]
        # A wrong heading at the first query moves the second sideways, a wrong scale moves it along the path.
        length2 = (expected[:, :3, 3] ** 2).sum(axis=1)
        position_var = position[first] + position[second]
        position_var += length2 * ((drift[0] ** 2 + rotation_var) / 2 + settings.scale_std**2)
        angle = np.deg2rad(geometry.rotation_angle_deg(difference[:, :3, :3]))
        return cls(angle**2, (difference[:, :3, 3] ** 2).sum(axis=1), drift, rotation_var, position_var)


def with_measured_drift(
    pieces: Iterable[tuple[Odometry, PosedQueries]], settings: SequenceSettings
) -> SequenceSettings:
    """Return the settings, with a larger drift if the motions between `ok` queries of a device's pieces show it.

    Each motion between two successive queries gives an estimate of the drift. The lower quartile of the estimates is
    compared with its expectation, so up to 40 % wrong single poses and undetected losses of tracking do not change it.
    """
    sure = [(odometry, queries.choose(queries.trusted)) for odometry, queries in pieces]
    # Few motions: add pairs that are two queries apart. They tell more of the rotation and less of the position drift.
    lags = (1,) if sum(max(len(queries) - 1, 0) for _, queries in sure) >= _MIN_MOTIONS else (1, 2)
    values = settings.model_dump()
    for name, turns in (("rotation_drift_deg", True), ("position_drift", False)):
        ratios = [np.zeros(0)]  # drift variance of each motion, relative to that of the settings
        for (odometry, queries), lag in product(sure, lags):
            second: Ints = np.arange(lag, len(queries))
            off = _Differences.between(odometry, queries, settings.model_copy(update=values), second - lag, second)
            square, other_var = (off.angle2, off.rotation_var) if turns else (off.distance2, off.position_var)
            drift2 = off.drift[0 if turns else 1] ** 2
            ratios.append((square / _CHI2_3 - other_var)[drift2 > 0] / drift2[drift2 > 0])
        joined = np.concatenate(ratios)
        factor = float(np.sqrt(max(1.0, np.quantile(joined, _SHARE)))) if len(joined) >= _MIN_MOTIONS else 1.0
        values[name] *= min(factor, _MAX_DRIFT)
    return settings.model_copy(update=values)


def fitted_scale(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> float:
    """Estimate the scale factor of the odometry from the single poses of one placement, with a prior of 1.

    Compares the motions between queries in the frame of the first, which drift before it does not affect.
    """
    if len(queries) < 2:
        return 1.0
    moved, placed = odometry.odom_from_rig[queries.frames], queries.world_from_rig
    rotation, position = _variances(queries)
    best, lag = (0.0, 0.0), 1
    while lag < len(queries):
        first, second = np.arange(len(queries) - lag), np.arange(lag, len(queries))
        by_odometry, by_poses = ((geometry.invert(poses[first]) @ poses[second])[:, :3, 3] for poses in (moved, placed))
        turn, shift = odometry.drift(settings, queries.frames[first], queries.frames[second])
        length2 = (by_odometry**2).sum(axis=1)
        variance = shift**2 + position[first] + position[second] + length2 * (turn**2 + rotation[first])
        # Divide by the lag, because `lag` motions overlap.
        information = float((length2 / variance).sum() / lag)
        product = float(((by_odometry * by_poses).sum(axis=1) / variance).sum() / lag)
        best = max(best, (information, product))
        lag *= 2
    prior = 1 / settings.scale_std**2
    return (best[1] + prior) / (best[0] + prior)


def first_guess(odometry: Odometry, queries: PosedQueries) -> Floats:
    """Return world_from_rig (N, 4, 4): the pose of the nearest query by distance traveled, continued by odometry."""
    traveled = odometry.traveled_m
    between = (traveled[queries.frames[1:]] + traveled[queries.frames[:-1]]) / 2
    nearest = np.searchsorted(between, traveled)
    moved = odometry.odom_from_rig
    return queries.world_from_rig[nearest] @ geometry.invert(moved[queries.frames[nearest]]) @ moved
