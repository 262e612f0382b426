"""Which cameras a network is told of a group, where it is to use the map's."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import Floats
from toolkit.localizers.placed import PlacedView

LEAST_REFERENCES = 6
"""With fewer nothing is told: less than three would be left to align and confirm by."""


def told_views(group: Sequence[PlacedView]) -> NDArray[np.bool_]:
    """Return which views (S,) of a group, the query first, are told: every other reference, from the best on."""
    known = [number for number, placed in enumerate(group) if number and placed.view.world_from_cam is not None]
    told = np.zeros(len(group), bool)
    if len(known) >= LEAST_REFERENCES:
        told[known[::2]] = True
    return told


def cameras_to_tell(group: Sequence[PlacedView]) -> tuple[Floats, Floats]:
    """Return poses (S, 4, 4) of the network's images from the world, NaN where not told, and K (S, 3, 3) of all."""
    poses = np.full((len(group), 4, 4), np.nan)
    for number in np.flatnonzero(told_views(group)).tolist():
        poses[number] = group[number].shown_from_world
    return poses, np.stack([placed.shown_intrinsics for placed in group])
