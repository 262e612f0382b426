"""The up direction in odometry: devices measure gravity, so odometry should lean by less than a degree in the map."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.localizers.odometry import Odometry, PosedQueries, floored
from toolkit.manifest import SequenceSettings

MAX_TILT_DEG = 5.0
"""Largest tilt of odometry in the map, besides drift and the deviation of the query: more is a wrong placement."""
_ROUGH_UP_DEG = 30.0
"""Accuracy of the map's rough up direction, e.g. from how its cameras were held."""
_LEAST_QUERIES, _LEAST_SHARE = 6, 0.8
"""Number of `ok` queries, and share of them that must agree, to accept an axis as up."""


@dataclass(frozen=True)
class Gravity:
    """The up direction in the frames of the odometry and of the map."""

    in_odometry: Floats
    """(3,) unit, an axis of the odometry's frame, the same in all pieces of a device."""
    in_map: Floats
    """(3,) unit."""
    std_deg: float
    """Standard deviation of the up direction in a piece, by axis: that of the settings and of the queries combined."""

    def upright(self, odometry: Odometry, queries: PosedQueries, settings: SequenceSettings) -> PosedQueries:
        """Return the queries with weight 0 for those that make odometry lean; unchanged if most `ok` queries do."""
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
    """Find the axis of a device's odometry that points up, by its `ok` queries; None if they do not determine it.

    Pieces differ in heading, so only the vertical axis has the same direction in the map in all of them. Up is unknown
    if all three axes have (a single piece) or none has (the odometry's frame is not aligned with gravity).

    Args:
        map_up: returns the rough up direction (3,) in the map, e.g. from how its cameras were held.
        settings: returns None with `gravity_std_deg: null`, and online, where the past is a single piece.
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
    rough_up = geometry.unit(np.asarray(map_up(), np.float64))
    sign = np.sign(in_map[axis] @ rough_up)
    if _apart_deg(sign * in_map[axis], rough_up) > _ROUGH_UP_DEG:
        return None
    std_deg = float(np.hypot(settings.gravity_std_deg, np.median(apart_deg[:, axis])))
    return Gravity(sign * np.eye(3)[axis], sign * in_map[axis], std_deg)


def _apart_deg(directions: Floats, others: Floats) -> Floats:
    """Return the angles (...) between unit vectors (..., 3)."""
    return np.asarray(np.degrees(np.arccos(np.clip((directions * others).sum(axis=-1), -1, 1))))


def _map_from_odom(odometry: Odometry, queries: PosedQueries) -> Floats:
    """Return the rotation (Q, 3, 3) from odometry to map by each query."""
    from_rig = odometry.odom_from_rig[queries.frames, :3, :3]
    return np.asarray(queries.world_from_rig[:, :3, :3] @ from_rig.transpose(0, 2, 1))
