"""Which of the retrieved map images a network is shown beside the query.

The most similar are often near-duplicates of each other: they say the same twice, and have no baseline that scale
could be measured by. Their map poses are known, so they are chosen for what they add.
"""

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import ArrayLike

from toolkit import geometry
from toolkit.capture.cameras import in_view, view_bounds
from toolkit.geometry import Floats, Ints

WIDE_BASELINE = 0.25  # of the depth; wider adds nothing
NEAR_DUPLICATE = 0.03  # of the depth
LEAST_SIMILARITY = 0.25  # what the worst candidate's score counts, of the best one's
ALL_SHARED = 50  # points that two images share from which on they count as seeing the same
_LAST = 1e-3  # factor for what comes last: a near-duplicate, or an image that shares no view


def select_references(
    scores: ArrayLike,
    world_from_cams: ArrayLike,
    k: int,
    cameras: Sequence[pycolmap.Camera],
    shared_points: ArrayLike | None = None,
    depth_m: float = 5.0,
) -> Ints:
    """Choose references that are similar to the query, see what each other see, and stand apart.

    Greedy. The first is the best score, unless it alone shares no view with any other. Then, each time, the largest
    product of similarity, view shared with those chosen, and baseline to the nearest chosen. Near-duplicates come
    after all others, and so do images that share no view with those chosen.

    Args:
        scores: (N,) similarities, higher is better.
        world_from_cams: (N, 4, 4) map poses.
        k: how many.
        cameras: N, for what they see of points laid at half, once and twice the depth.
        shared_points: (N, N) triangulated points that two images both see, where known: overlapping frusta do not
            tell of a wall between.
        depth_m: typical depth of the scene, meters.

    Returns:
        At most k indices in order of choice; candidates whose pose or score is not finite are never chosen. Equal
        candidates are taken in their order.
    """
    score = np.asarray(scores, np.float64).reshape(-1)
    poses = np.asarray(world_from_cams, np.float64).reshape(-1, 4, 4)
    usable = np.flatnonzero(np.isfinite(score) & np.isfinite(poses).all(axis=(1, 2)))
    if not len(usable) or k < 1:
        return np.zeros(0, np.int64)
    score, poses = score[usable], poses[usable]
    spread = score.max() - score.min()
    similarity = LEAST_SIMILARITY + (1 - LEAST_SIMILARITY) * (score - score.min()) / (spread if spread > 0 else 1.0)
    if spread == 0:
        similarity[:] = 1.0
    shared = _shared_view(poses, [cameras[int(index)] for index in usable], depth_m)
    if shared_points is not None:
        counts = np.asarray(shared_points, np.float64)[np.ix_(usable, usable)]
        shared = (shared + np.minimum(counts / ALL_SHARED, 1.0)) / 2
    np.fill_diagonal(shared, 0.0)
    baseline = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1) / depth_m
    gain = np.clip(baseline / WIDE_BASELINE, 0.0, 1.0)
    gain[baseline < NEAR_DUPLICATE] = _LAST

    connected = shared.max(axis=1) > 0.02
    first = similarity if connected[np.argmax(score)] or not connected.any() else similarity * connected
    chosen = [int(np.argmax(first))]
    while len(chosen) < min(k, len(usable)):
        value = similarity * np.maximum(shared[:, chosen].max(axis=1), _LAST) * gain[:, chosen].min(axis=1)
        value[chosen] = -1.0
        chosen.append(int(np.argmax(value)))
    return usable[chosen]


def _shared_view(world_from_cams: Floats, cameras: Sequence[pycolmap.Camera], depth_m: float) -> Floats:
    """Return the share (N, N) of what one camera sees that the other sees too, the mean of both directions."""
    bounds = np.stack([view_bounds(camera) for camera in cameras])
    steps = np.linspace(0.1, 0.9, 5)
    x = bounds[:, :1] + steps * (bounds[:, 1:2] - bounds[:, :1])
    y = bounds[:, 2:3] + steps * (bounds[:, 3:] - bounds[:, 2:3])
    depths = depth_m * np.array([0.5, 1.0, 2.0])
    rays = np.stack(np.broadcast_arrays(x[:, None, :], y[:, :, None], 1.0), axis=-1).reshape(len(x), 1, -1, 3)
    points = geometry.transform(world_from_cams, (rays * depths[:, None, None]).reshape(len(x), -1, 3))
    cams_from_world = geometry.invert(world_from_cams)
    seen = np.stack([in_view(geometry.transform(cams_from_world, p[None]), bounds).mean(axis=1) for p in points])
    return (seen + seen.T) / 2
