"""Which direction is up in odometry: devices measure it, so that odometry leans by less than a degree in the map."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.localizers.odometry import Odometry, PosedQueries, floored
from toolkit.manifest import SequenceSettings

MAX_TILT_DEG = 5.0
"""Odometry that leans by more, beyond drift and the query's own deviation, is wrongly placed."""
_ABOUT_DEG = 30.0
"""How cameras are held tells up no better."""
_LEAST_QUERIES, _LEAST_SHARE = 6, 0.8
"""Of `ok` queries that have to agree before a direction is believed."""


@dataclass(frozen=True)
class Gravity:
    """The direction that is up."""

    in_odometry: Floats
    """(3,) unit, an axis of the odometry's frame, the same in all of a device's pieces."""
    in_map: Floats
    """(3,) unit."""
    std_deg: float
    """By how much a piece leans, by axis: as the settings say, and as the queries differ."""

    def upright(self, odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> PosedQueries:
        """Return the queries without a voice for those that would make odometry lean; all, where most `ok` ones do."""
        ups = _map_from_odom(odometry, queries) @ self.in_odometry
        drift_std, _ = odometry.drift(settings, np.zeros_like(queries.frames), queries.frames)
        own_var = np.trace(floored(queries.covariances)[:, :3, :3], axis1=1, axis2=2) / 3
        most_deg = MAX_TILT_DEG + 3 * np.degrees(np.sqrt(drift_std**2 + own_var))
        kept = _apart_deg(ups, self.in_map) <= most_deg
        leaning, standing = (int(np.count_nonzero(queries.trusted & rows)) for rows in (~kept, kept))
        if leaning > max(standing, 1):
            return queries  # this piece does not stand upright
        return replace(queries, weights=np.where(kept, queries.weights, 0.0), trusted=queries.trusted & kept)


def measured_gravity(
    pieces: Sequence[tuple[Odometry, PosedQueries]], map_up: Callable[[], Floats], settings: SequenceSettings
) -> Gravity | None:
    """Return which axis of a device's odometry is up, as its `ok` queries tell; None where they do not.

    Pieces have any heading: only the vertical axis leads to the same direction in the map from all of them. Where all
    three do, as in a single piece, or none, as in odometry whose frame does not stand upright, up is not known.

    Args:
        map_up: says which direction (3,) is about up in the map, such as how its cameras are held tells.
        settings: with `gravity_std_deg: null` nothing is asked for; nor online, where the past is one piece.
    """
    if settings.gravity_std_deg is None or settings.online:
        return None
    sure = [(odometry, queries.choose(queries.trusted)) for odometry, queries in pieces]
    rotations = np.concatenate([np.zeros((0, 3, 3)), *(_map_from_odom(*piece) for piece in sure)])
    if len(rotations) < _LEAST_QUERIES:
        return None
    in_map = geometry.unit(np.median(rotations, axis=0).T)
    apart_deg = _apart_deg(rotations.transpose(0, 2, 1), in_map)
    steady = np.flatnonzero((apart_deg <= MAX_TILT_DEG).mean(axis=0) >= _LEAST_SHARE)
    if len(steady) != 1:
        return None
    [axis] = steady.tolist()
    about = geometry.unit(np.asarray(map_up(), np.float64))
    sign = np.sign(in_map[axis] @ about)
    if _apart_deg(sign * in_map[axis], about) > _ABOUT_DEG:
        return None
    std_deg = float(np.hypot(settings.gravity_std_deg, np.median(apart_deg[:, axis])))
    return Gravity(sign * np.eye(3)[axis], sign * in_map[axis], std_deg)


def _apart_deg(directions: Floats, others: Floats) -> Floats:
    """Return the angles between unit vectors (..., 3)."""
    return np.asarray(np.degrees(np.arccos(np.clip((directions * others).sum(axis=-1), -1, 1))))


def _map_from_odom(odometry: Odometry, queries: PosedQueries) -> Floats:
    """Return the rotation (Q, 3, 3) of odometry in the map as each query says."""
    from_rig = odometry.odom_from_rig[queries.frames, :3, :3]
    return np.asarray(queries.world_from_rig[:, :3, :3] @ from_rig.transpose(0, 2, 1))
