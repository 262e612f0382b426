"""Choose the retrieved map images that a network gets together with the query.

The most similar ones are often near-duplicates: they add no information, and without a baseline they give no scale.
The map poses are known, so the choice considers covisibility and baselines too.
"""

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import ArrayLike

from toolkit import geometry
from toolkit.capture.cameras import in_view, view_bounds
from toolkit.geometry import Floats, Ints

WIDE_BASELINE = 0.25  # baseline over depth; a wider one counts no more
NEAR_DUPLICATE = 0.03  # baseline over depth; below, two images are near-duplicates
LEAST_SIMILARITY = 0.25  # similarity of the worst candidate, where that of the best one is 1
ALL_SHARED = 50  # shared points from which two images count as fully covisible
_LAST = 1e-3  # factor that puts near-duplicates and images without shared view last


def select_references(
    scores: ArrayLike,
    world_from_cams: ArrayLike,
    k: int,
    cameras: Sequence[pycolmap.Camera],
    shared_points: ArrayLike | None = None,
    depth_m: float = 5.0,
) -> Ints:
    """Choose references that are similar to the query, covisible, and apart from each other.

    The choice is greedy. The first reference has the best score; if other candidates share views, it must share one
    too. Each next reference maximizes the product of its similarity, the view it shares with those chosen, and its
    baseline to the nearest of them. Near-duplicates and images without shared view come last.

    Args:
        scores: (N,) similarities, higher is better.
        world_from_cams: (N, 4, 4) map poses.
        k: number of references to choose.
        cameras: N cameras. Their views are compared by points at half, once and twice the depth.
        shared_points: (N, N) number of triangulated points that both images observe, if known. Overlapping frusta
            alone do not reveal a wall in between.
        depth_m: typical depth of the scene, meters.

    Returns:
        At most k indices in order of choice. A candidate whose pose or score is not finite is never chosen. Ties go to
        the earlier candidate.
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
    """Return the share (N, N) of one camera's view that the other sees too, averaged over both directions."""
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
