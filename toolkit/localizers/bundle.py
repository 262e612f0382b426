"""Bundle adjustment of a recording: reprojection errors of its queries in place of their poses, beside odometry.

The unknowns are the poses of a piece's frames and the map points that its queries see, which several may share. A
point lies where the map has it, up to its uncertainty: it belongs to the map's images, which are not moved.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from toolkit import geometry
from toolkit.geometry import Floats, Ints
from toolkit.localizers.base import PoseEstimate
from toolkit.localizers.correspondences import Correspondences
from toolkit.localizers.gravity import Gravity
from toolkit.localizers.odometry import Odometry, PosedQueries
from toolkit.localizers.pose_graph import PlacedPiece, motion_graph, require_gtsam, rigid
from toolkit.manifest import SequenceSettings

PIXEL_STD = 4.0
"""Of a keypoint, pixels: more than the noise of one, for those of an image err alike."""
POINT_STD_M, POINT_STD_SHARE = 0.01, 0.002
"""Of a map point by axis: meters, and of its distance."""
MAX_POINTS = 2000
"""Of a query, an even choice."""
_HUBER = 1.345


@dataclass(frozen=True)
class Observations:
    """K points that a query shows."""

    rays: Floats
    """(K, 2) at depth 1 in the camera, without distortion."""
    stds: Floats
    """(K,) of a ray by axis."""
    points: Floats
    """(K, 3) in the world, meters."""
    point_index: Ints
    """(K,) of the map; -1: it has none."""
    camera: Ints
    """(K,) index of the query image."""
    rig_from_cams: Floats
    """(C, 4, 4)."""

    @classmethod
    def of(cls, found: Correspondences, cameras: Sequence[pycolmap.Camera], rig_from_cams: Floats) -> "Observations":
        """Return the inliers among correspondences, `MAX_POINTS` at most."""
        rows = np.flatnonzero(found.inlier)
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_POINTS)).astype(np.int64))]
        camera, rays, stds = found.camera[rows], np.full((len(rows), 2), np.nan), np.ones(len(rows))
        for number, each in enumerate(cameras):
            own = camera == number
            rays[own] = np.asarray(each.cam_from_img(found.pixels[rows[own]]), np.float64).reshape(-1, 2)
            stds[own] = PIXEL_STD / each.mean_focal_length()
        known = np.isfinite(rays).all(axis=1)
        rows, camera = rows[known], camera[known]
        return cls(rays[known], stds[known], found.points[rows], found.point_index[rows], camera, rig_from_cams)


Observe = Callable[[int, PoseEstimate | None], Observations | None]
"""Of a frame, and of what was found there near its predicted pose, if that is used: what its query shows, if known."""


def adjusted(
    odometry: Odometry,
    placed: PlacedPiece,
    queries: PosedQueries,
    shown: Mapping[int, Observations],
    settings: SequenceSettings,
    gravity: Gravity | None = None,
) -> PlacedPiece:
    """Return a placed piece whose poses fit what its queries show; covariances stay as they were.

    Those of this problem would be too small: errors of the map's points are alike in a neighborhood.

    Args:
        queries: those that the poses rest on; one without observations keeps its pose as a prior.
        shown: by frame what its query shows, of those whose matches are trusted.
        gravity: which direction is up; None: not known.

    Raises:
        ManifestError: GTSAM is not installed.
    """
    gtsam = require_gtsam()
    others = queries.choose(~np.isin(queries.frames, list(shown)))
    graph = motion_graph(odometry.scaled(placed.scale), others, settings, gravity)
    values = gtsam.Values()
    for number, pose in enumerate(placed.world_from_rig):
        values.insert(number, gtsam.Pose3(rigid(pose)))
    kernel, pinhole = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER), gtsam.Cal3_S2(1, 1, 0, 0, 0)
    keys: dict[int, int] = {}
    for frame, seen in shown.items():
        centers = (placed.world_from_rig[frame] @ seen.rig_from_cams)[seen.camera, :3, 3]
        point_stds = POINT_STD_M + POINT_STD_SHARE * np.linalg.norm(seen.points - centers, axis=1)
        mounts = [gtsam.Pose3(rigid(mount)) for mount in seen.rig_from_cams]
        rows = zip(seen.rays, seen.stds, seen.points, seen.point_index.tolist(), seen.camera, point_stds, strict=True)
        for ray, std, point, index, camera, point_std in rows:
            key = keys.get(index, len(odometry) + values.size())
            if not values.exists(key):
                values.insert(key, point)
                graph.add(gtsam.PriorFactorPoint3(key, point, gtsam.noiseModel.Isotropic.Sigma(3, point_std)))
                keys |= {index: key} if index >= 0 else {}
            noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, std))
            factor = gtsam.GenericProjectionFactorCal3_S2(
                *(ray, noise, frame, key, pinhole), False, False, mounts[camera]
            )  # neither throws nor speaks of a point behind the camera
            graph.add(factor)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    poses = np.stack([result.atPose3(number).matrix() for number in range(len(odometry))])
    turned_deg, moved_m = geometry.pose_error(poses, placed.world_from_rig)
    variances = np.diagonal(placed.covariances, axis1=1, axis2=2)
    rotation_std, position_std = (np.sqrt(variances[:, part].sum(axis=1)) for part in (slice(3), slice(3, 6)))
    # Beyond what the graph allows, the points contradict odometry and the other queries: they were wrong matches.
    agrees = (np.radians(turned_deg) < 4 * rotation_std) & (moved_m < 4 * position_std)
    return replace(placed, world_from_rig=poses) if agrees.all() else placed
