"""Odometry: motion that a device measures itself, in a frame of its own, and which place of that frame in the map the
poses of single queries agree with.

Of a recording whose tracking was lost, each piece has a frame of its own. Odometry drifts: what two poses of a piece
say of each other becomes less sure with the way and the time between them.
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

LEAST_STD_M, LEAST_STD_DEG = 0.01, 0.05
"""A single query's pose is not surer than this: its covariance does not know of errors that a part of the map has."""
JUMP_M, JUMP_DEG = 0.2, 20.0
"""A step is off by no more, beyond what `ACCELERATION` makes of those beside it."""
ACCELERATION_M_S2, ACCELERATION_DEG_S2 = 10.0, 500.0
"""Of a hand, a head or a wheel at most."""
_BLIND_S = 0.8
"""In a longer step a device may accelerate and stop again: it does not show that tracking was lost."""
_TELLING = 2 / 3
"""Probability of a pose that says where it is without the others: more than half as likely is no other pose."""
_CHI2_99 = 16.81
"""99 % quantile of the chi-squared distribution with 6 degrees of freedom."""
_SHARE, _CHI2_3 = 0.25, 1.213
"""Quantile of the chi-squared distribution with 3 degrees of freedom."""
_PAIRS = 1 << 18
"""Pairs of queries that are looked at at a time."""
_LEAST_MOTIONS = 6
"""Fewer do not say how large a drift is."""
_MOST_DRIFT = 20.0
"""Times what the settings say, at most. What drifts more is no odometry, or most single poses are wrong."""


@dataclass(frozen=True)
class Odometry:
    """N poses of one device in a frame of its own, in the order of time, without a loss of tracking."""

    timestamps: Ints
    """(N,) microseconds."""
    odom_from_rig: Floats
    """(N, 4, 4), meters."""

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def way_m(self) -> Floats:
        """(N,) meters from the first pose, along the way."""
        steps = np.diff(self.odom_from_rig[:, :3, 3], axis=0)
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])

    def scaled(self, factor: float) -> "Odometry":
        """Return it with all lengths times a factor."""
        poses = self.odom_from_rig.copy()
        poses[:, :3, 3] *= factor
        return replace(self, odom_from_rig=poses)

    def drift(self, settings: SequenceSettings, first: Ints, second: Ints) -> tuple[Floats, Floats]:
        """Return standard deviations (n,) by axis of what pairs of poses say of each other: radians, meters."""
        way, seconds = self.way_m, self.timestamps / 1e6
        rotation = np.deg2rad(settings.rotation_drift_deg) * np.sqrt(np.abs(seconds[first] - seconds[second]))
        # A random walk: the same for many short steps as for one long one.
        return rotation, settings.position_drift * np.sqrt(np.abs(way[first] - way[second]))

    def part(self, frames: slice) -> "Odometry":
        """Return some consecutive poses."""
        return Odometry(self.timestamps[frames], self.odom_from_rig[frames])

    def at(self, timestamps: Ints) -> tuple[Ints, Floats]:
        """Return which of some times are between two poses or at one, (n,) their numbers, and their poses (n, 4, 4).

        Between two, it turns and moves at a constant rate.
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
        """Return it with more poses, and where each is from: its own, then those."""
        times = np.append(self.timestamps, timestamps)
        order = np.argsort(times, kind="stable")
        return Odometry(times[order], np.concatenate([self.odom_from_rig, odom_from_rig])[order]), order

    def split(self, settings: SequenceSettings) -> list[slice]:
        """Return the pieces between losses of tracking: gaps in time, and steps that no device makes.

        A step is one if it is too fast, or if no acceleration leads to its speed from that of the steps beside it.
        """
        seconds = np.diff(self.timestamps) / 1e6
        lost = (seconds > settings.max_gap_s) | (np.diff(self.way_m) > settings.max_speed_m_s * seconds)
        ends = [0, *(np.flatnonzero(lost | self._jumps(seconds)) + 1).tolist(), len(self)]
        return [slice(start, end) for start, end in pairwise(ends) if end > start]

    def _jumps(self, seconds: Floats) -> NDArray[np.bool_]:
        """Return which steps (N - 1,) differ from those beside them, and from none, by more than an acceleration."""
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
            # A velocity in the device's own frame is the same whichever frame its odometry is in.
            off = np.linalg.norm(np.diff(speeds, axis=0), axis=1) - acceleration * (seconds[1:] + seconds[:-1]) / 2
            still = np.linalg.norm(speeds, axis=1) - acceleration * seconds  # a step beside a jump is none
            nearest = np.minimum(np.minimum(np.append(off, np.inf), np.insert(off, 0, np.inf)), still)
            jumps |= nearest * seconds > least
        return jumps


def recordings_of(session: Session, odometry: Trajectory) -> dict[str, Ints]:
    """Return the rows of each recording, in the order of time: a subsession, or one device of those that move in it.

    Of a pose that is there twice the first counts.
    """
    subsessions, recordings = subsessions_of(session, odometry.device_ids), dict[str, Ints]()
    names, times = device_names(odometry.timestamps, odometry.device_ids), odometry.timestamps
    repeated = pd.DataFrame({"device": names, "timestamp": times}).duplicated().to_numpy()
    for name in dict.fromkeys(subsessions.tolist()):
        rows = np.flatnonzero((subsessions == name) & ~repeated)
        rows = rows[np.argsort(times[rows], kind="stable")]
        devices = dict.fromkeys(names[rows].tolist())
        # Ids of one device may have something else in them that changes; but it is not at two places at once.
        several = 1 < len(devices) <= len(rows) / 2 or len(np.unique(times[rows])) < len(rows)
        recordings |= {device: rows[names[rows] == device] for device in devices} if several else {name: rows}
    return recordings


def device_names(timestamps: Ints, device_ids: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return a name (N,) of each device that is the same at all times: some ids of rigs and sensors have the time."""
    pairs = zip(device_ids.tolist(), timestamps.tolist(), strict=True)
    return np.array([device.replace(str(time), "") for device, time in pairs], object)


def subsessions_of(session: Session, device_ids: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return the subsession (N,) of each device, empty where it is of none."""
    found = np.full(len(device_ids), "", object)
    for name in sorted(session.subsessions, key=len):
        found[[device.startswith(f"{name}/") for device in device_ids]] = name
    return found


@dataclass(frozen=True)
class PosedQueries:
    """Q poses of single queries of one piece of odometry."""

    frames: Ints
    """(Q,) their indices in the odometry."""
    world_from_rig: Floats
    """(Q, 4, 4)."""
    covariances: Floats
    """(Q, 6, 6) of a small motion in the rig's frame: rotation, radians, then translation, meters."""
    weights: Floats
    """(Q,) probability that each is right."""
    trusted: NDArray[np.bool_]
    """(Q,) whether localization said `ok`."""

    def __len__(self) -> int:
        return len(self.frames)

    def choose(self, rows: Ints | NDArray[np.bool_]) -> "PosedQueries":
        return PosedQueries(*(values[rows] for values in vars(self).values()))

    def part(self, frames: slice) -> "PosedQueries":
        """Return those of some consecutive poses of the odometry; see `Odometry.part`."""
        within = self.choose((self.frames >= frames.start) & (self.frames < frames.stop))
        return replace(within, frames=within.frames - frames.start)

    def joined(self, other: "PosedQueries") -> "PosedQueries":
        """Return both, by frame."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        every = PosedQueries(*(np.concatenate(pair) for pair in pairs))
        return every.choose(np.argsort(every.frames, kind="stable"))


UNKNOWN_COVARIANCE = np.diag(np.repeat([0.1, 4.0], 3))
"""Of a pose without one, such as that of `nearest`: it is not known better than to some meters."""


def vote_weights(ok: NDArray[np.bool_], p_correct: Floats, rival_support: Floats) -> Floats:
    """Return the probability (Q,) that each single pose is right; NaN in `p_correct` and `rival_support` is unknown."""
    # Where localization gives no probability, its word counts.
    weights = np.where(np.isnan(p_correct), np.where(ok, 0.95, 0.05), p_correct)
    # Of two poses with as much support, such as in rooms that look alike, either may be right.
    return np.where(ok, weights, weights / (1 + np.nan_to_num(rival_support)))


def floored(covariances: Floats) -> Floats:
    """Return covariances (n, 6, 6) of poses that are not surer than a map is right."""
    least = np.repeat([np.deg2rad(LEAST_STD_DEG), LEAST_STD_M], 3) ** 2
    return covariances + np.diag(least)


@dataclass(frozen=True)
class Placement:
    """Which single poses agree with each other, given the odometry between them."""

    seed: int
    """The query that the others agree with."""
    members: Ints
    """Queries that agree, ascending."""
    support: float
    """Sum of their weights."""
    trusted: bool
    """Whether one of them is `ok`, or three agree that are likely right, and no rival is half as well supported."""
    rival_support: float
    """That of the best placement that contradicts this one."""


def place(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> list[Placement]:
    """Return the rival placements of odometry in the map, the best supported first: by `ok` queries, then by all.

    Each query votes: its pose gives one placement, which is supported by all queries whose poses it predicts, within
    the drift between the two and the covariances of both.
    """
    agree = _agreement(odometry, queries, settings)
    left = np.ones(len(queries), bool)
    found: list[tuple[int, Ints, float]] = []
    while left.any():
        seed = int(np.argmax(np.where(left, (agree & left) @ queries.weights, -1.0)))
        members = agree[seed] & left
        # Who contradicts most of the others was predicted by the seed by chance.
        with_others = agree[:, members] @ queries.weights[members]
        members &= with_others >= 0.5 * queries.weights[members].sum()
        members[seed] = True
        found.append((seed, np.flatnonzero(members), float(queries.weights[members].sum())))
        left &= ~members
    found.sort(key=lambda one: (-queries.weights[one[1]] @ queries.trusted[one[1]], -one[2]))
    placements = []
    for number, (seed, rows, support) in enumerate(found):
        others = [other for index, (_, _, other) in enumerate(found) if index != number]
        rival = max(others, default=0.0)
        # Those that are led astray by a look-alike are led to the same place, however many there are.
        independent = np.count_nonzero(queries.weights[rows] > _TELLING)
        sure = bool(queries.trusted[rows].any() or independent >= 3) and rival < 0.5 * support
        placements.append(Placement(seed, rows, support, sure, rival))
    return placements


def _agreement(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> NDArray[np.bool_]:
    """Return (Q, Q) whether two poses fit the motion between them."""
    count = len(queries)
    agree, every = np.zeros((count, count), bool), np.arange(count)
    for rows in np.array_split(every, 1 + count**2 // _PAIRS):
        off = _Differences.between(odometry, queries, settings, np.repeat(rows, count), np.tile(every, len(rows)))
        rotation_var, position_var = off.drift[0] ** 2 + off.rotation_var, off.drift[1] ** 2 + off.position_var
        agree[rows] = (off.angle2 / rotation_var + off.distance2 / position_var < _CHI2_99).reshape(len(rows), count)
    return agree | agree.T


def cut(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> list[slice]:
    """Return the parts between losses of tracking that no step shows, those of seconds, but that `ok` queries tell.

    None before one agrees with any after it, and on both sides at least two agree with each other.
    """
    sure = queries.choose(queries.trusted)
    agree, ends, between = _agreement(odometry, sure, settings), [0], slice(0, 0)
    seconds = np.diff(odometry.timestamps) / 1e6
    for count in range(2, len(sure)):
        sides = agree[:count, :count], agree[count:, count:]
        if not agree[:count, count:].any() and min(int(side.sum(axis=1).max()) for side in sides) > 1:
            between = slice(between.start or int(sure.frames[count - 1]), int(sure.frames[count]))
        elif between.stop:  # around who agrees with none
            step = between.start + int(np.argmax(seconds[between]))
            ends += [step + 1] * bool(seconds[step] > _BLIND_S)
            between = slice(0, 0)
    return [slice(start, end) for start, end in pairwise([*ends, len(odometry)])]


@dataclass(frozen=True)
class _Differences:
    """How far n pairs of poses are from the motion between them, and how far they may be, by axis."""

    angle2: Floats
    """(n,) radians squared."""
    distance2: Floats
    """(n,) square meters."""
    drift: tuple[Floats, Floats]
    """Standard deviations (n,) of the odometry: radians, meters."""
    rotation_var: Floats
    """(n,) of the two poses, besides."""
    position_var: Floats
    """(n,) of the two poses, and of the odometry's rotation and scale."""

    @classmethod
    def between(
        cls, odometry: Odometry, queries: PosedQueries, settings: SequenceSettings, first: Ints, second: Ints
    ) -> "_Differences":
        inverse = geometry.invert(odometry.odom_from_rig[queries.frames]), geometry.invert(queries.world_from_rig)
        expected = inverse[0][first] @ odometry.odom_from_rig[queries.frames[second]]
        difference = geometry.invert(expected) @ inverse[1][first] @ queries.world_from_rig[second]
        drift = odometry.drift(settings, queries.frames[first], queries.frames[second])
        covariances = floored(queries.covariances)
        rotation, position = (
            np.trace(covariances[:, part, part], axis1=1, axis2=2) / 3 for part in (slice(3), slice(3, 6))
        )
        rotation_var = rotation[first] + rotation[second]
        # A wrong heading at the first puts the second aside, a wrong scale before or behind.
        length2 = (expected[:, :3, 3] ** 2).sum(axis=1)
        position_var = position[first] + position[second]
        position_var += length2 * ((drift[0] ** 2 + rotation_var) / 2 + settings.scale_std**2)
        angle = np.deg2rad(geometry.rotation_angle_deg(difference[:, :3, :3]))
        return cls(angle**2, (difference[:, :3, 3] ** 2).sum(axis=1), drift, rotation_var, position_var)


def with_measured_drift(
    pieces: Iterable[tuple[Odometry, PosedQueries]], settings: SequenceSettings
) -> SequenceSettings:
    """Return the settings with more drift, if the motions between `ok` queries of a device's pieces ask for it.

    Each asks for a drift; what a quarter of them stays below is compared with what would by chance. Single poses that
    are wrong do not move it, up to 40 % of them, nor does a loss of tracking that was not seen.
    """
    sure = [(odometry, queries.choose(queries.trusted)) for odometry, queries in pieces]
    # Over two motions more is seen of turning and less of moving.
    lags = (1,) if sum(max(len(queries) - 1, 0) for _, queries in sure) >= _LEAST_MOTIONS else (1, 2)
    values = settings.model_dump()
    for name, turns in (("rotation_drift_deg", True), ("position_drift", False)):
        asked = [np.zeros(0)]
        for (odometry, queries), lag in product(sure, lags):
            second: Ints = np.arange(lag, len(queries))
            off = _Differences.between(odometry, queries, settings.model_copy(update=values), second - lag, second)
            square, others = (off.angle2, off.rotation_var) if turns else (off.distance2, off.position_var)
            drift2 = off.drift[0 if turns else 1] ** 2
            asked.append((square / _CHI2_3 - others)[drift2 > 0] / drift2[drift2 > 0])
        every = np.concatenate(asked)
        factor = float(np.sqrt(max(1.0, np.quantile(every, _SHARE)))) if len(every) >= _LEAST_MOTIONS else 1.0
        values[name] *= min(factor, _MOST_DRIFT)
    return settings.model_copy(update=values)


def fitted_scale(odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> float:
    """Return the factor of the odometry's lengths that single poses of one placement ask for; 1 says the prior.

    Compared are motions between queries, in the frame of the first, which no drift before it has turned.
    """
    if len(queries) < 2:
        return 1.0
    moved, placed = odometry.odom_from_rig[queries.frames], queries.world_from_rig
    rotation = np.trace(floored(queries.covariances)[:, :3, :3], axis1=1, axis2=2) / 3
    position = np.trace(floored(queries.covariances)[:, 3:, 3:], axis1=1, axis2=2) / 3
    best = 0.0, 0.0
    lag = 1
    while lag < len(queries):
        first, second = np.arange(len(queries) - lag), np.arange(lag, len(queries))
        by_odometry, by_poses = (
            (geometry.invert(poses[first]) @ poses[second])[:, :3, 3] for poses in (moved, placed)
        )
        turn, shift = odometry.drift(settings, queries.frames[first], queries.frames[second])
        length2 = (by_odometry**2).sum(axis=1)
        variance = shift**2 + position[first] + position[second] + length2 * (turn**2 + rotation[first])
        # So many motions of this lag overlap.
        information = float((length2 / variance).sum() / lag)
        product = float(((by_odometry * by_poses).sum(axis=1) / variance).sum() / lag)
        best = max(best, (information, product))
        lag *= 2
    prior = 1 / settings.scale_std**2
    return (best[1] + prior) / (best[0] + prior)


def first_guess(odometry: Odometry, queries: PosedQueries) -> Floats:
    """Return world_from_rig (N, 4, 4): each pose as odometry leads to it from the next query along the way."""
    way = odometry.way_m
    between = (way[queries.frames[1:]] + way[queries.frames[:-1]]) / 2
    nearest = np.searchsorted(between, way)
    moved = odometry.odom_from_rig
    return queries.world_from_rig[nearest] @ geometry.invert(moved[queries.frames[nearest]]) @ moved

