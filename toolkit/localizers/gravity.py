"""Which direction is up in odometry: devices measure it, so that odometry leans by less than a degree in the map."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.localizers.odometry import Odometry, PosedQueries
from toolkit.manifest import SequenceSettings

MAX_TILT_DEG = 5.0
"""Odometry that leans by more is wrongly placed: drift included, devices lean by a degree or two."""
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

    def tilt_deg(self, odometry: Odometry, queries: PosedQueries) -> Floats:
        """Return by how much (Q,) odometry leans in the map if it is placed as each query says."""
        ups = _map_from_odom(odometry, queries) @ self.in_odometry
        return np.degrees(np.arccos(np.clip(ups @ self.in_map, -1, 1)))

    def upright(self, odometry: Odometry, queries: PosedQueries) -> PosedQueries:
        """Return the queries without a voice for those that would make odometry lean."""
        kept = self.tilt_deg(odometry, queries) <= MAX_TILT_DEG
        return replace(queries, weights=np.where(kept, queries.weights, 0.0), trusted=queries.trusted & kept)


def measured_gravity(
    pieces: Sequence[tuple[Odometry, PosedQueries]], map_up: Floats, settings: SequenceSettings
) -> Gravity | None:
    """Return which axis of a device's odometry is up, as its `ok` queries tell; None where they do not.

    Pieces have any heading: only the vertical axis leads to the same direction in the map from all of them. Odometry
    whose frame does not stand upright gives None.

    Args:
        map_up: (3,) direction that is about up in the map, such as how its cameras are held tells.
        settings: with `gravity_std_deg: null` nothing is asked for.
    """
    if settings.gravity_std_deg is None:
        return None
    map_up = np.asarray(map_up, np.float64) / np.linalg.norm(map_up)
    sure = [(odometry, queries.choose(queries.trusted)) for odometry, queries in pieces]
    rotations = np.concatenate([np.zeros((0, 3, 3)), *(_map_from_odom(*piece) for piece in sure)])
    if len(rotations) < _LEAST_QUERIES:
        return None
    found: list[tuple[float, Gravity]] = []
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        ups = rotations @ axis
        in_map = geometry.unit(np.median(ups, axis=0)[None])[0]
        apart_deg = np.degrees(np.arccos(np.clip(ups @ in_map, -1, 1)))
        if in_map @ map_up > np.cos(np.radians(_ABOUT_DEG)) and np.mean(apart_deg <= MAX_TILT_DEG) >= _LEAST_SHARE:
            found.append((float(np.median(apart_deg)), Gravity(axis, in_map)))
    return min(found, key=lambda each: each[0], default=(0.0, None))[1]


def _map_from_odom(odometry: Odometry, queries: PosedQueries) -> Floats:
    """Return the rotation (Q, 3, 3) of odometry in the map as each query says."""
    from_rig = odometry.odom_from_rig[queries.frames, :3, :3]
    return np.asarray(queries.world_from_rig[:, :3, :3] @ from_rig.transpose(0, 2, 1))
