"""Bundle adjustment of a recording: odometry and the queries' reprojection errors instead of their poses.

The variables are the poses of a piece's frames and the map points that its queries observe; queries can share points.
Each point has its position in the map as a prior, with its uncertainty. The map's own images do not move.
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
"""Standard deviation of a keypoint, pixels: more than its noise, because errors within an image are correlated."""
POINT_STD_M, POINT_STD_SHARE = 0.01, 0.002
"""Standard deviation of a map point by axis: a constant, meters, plus a share of its distance to the camera."""
MAX_POINTS = 2000
"""Largest number of points per query; of more, an even selection is used."""
_HUBER = 1.345


@dataclass(frozen=True)
class Observations:
    """Observations of K map points by a query."""

    rays: Floats
    """(K, 2) undistorted coordinates at depth 1 in the camera."""
    stds: Floats
    """(K,) standard deviation of a ray by axis."""
    points: Floats
    """(K, 3) in the world, meters."""
    point_index: Ints
    """(K,) index in the map; -1: none."""
    camera: Ints
    """(K,) index of the query image."""
    rig_from_cams: Floats
    """(C, 4, 4)."""

    @classmethod
    def of(cls, matches: Correspondences, cameras: Sequence[pycolmap.Camera], rig_from_cams: Floats) -> "Observations":
        """Return the inliers among correspondences, `MAX_POINTS` at most."""
        rows = np.flatnonzero(matches.inlier)
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_POINTS)).astype(np.int64))]
        camera, rays, stds = matches.camera[rows], np.full((len(rows), 2), np.nan), np.ones(len(rows))
        for number, model in enumerate(cameras):
            own = camera == number
            rays[own] = np.asarray(model.cam_from_img(matches.pixels[rows[own]]), np.float64).reshape(-1, 2)
            stds[own] = PIXEL_STD / model.mean_focal_length()
        finite = np.isfinite(rays).all(axis=1)
        rows, camera = rows[finite], camera[finite]
        return cls(rays[finite], stds[finite], matches.points[rows], matches.point_index[rows], camera, rig_from_cams)


Observe = Callable[[int, PoseEstimate | None], Observations | None]
"""Function that returns the observations of a frame's query, None if unknown. Its second argument is the estimate near
the predicted pose if that one is used; None: those of the first estimate."""


def adjusted(
    odometry: Odometry,
    placed: PlacedPiece,
    queries: PosedQueries,
    observations: Mapping[int, Observations],
    settings: SequenceSettings,
    gravity: Gravity | None = None,
) -> PlacedPiece:
    """Return the piece with poses refined by the observations of its queries; covariances stay unchanged.

    The covariances of this problem would be too small, because errors of neighboring map points are correlated.

    Args:
        queries: the queries that the poses are based on; those without observations keep their pose as a prior.
        observations: by frame, of the queries whose matches are trusted.
        gravity: the up direction in the odometry and the map; None: unknown.

    Raises:
        ManifestError: GTSAM is not installed.
    """
    gtsam = require_gtsam()
    priors = queries.choose(~np.isin(queries.frames, list(observations)))
    graph = motion_graph(odometry.scaled(placed.scale), priors, settings, gravity)
    values = gtsam.Values()
    for number, pose in enumerate(placed.world_from_rig):
        values.insert(number, gtsam.Pose3(rigid(pose)))
    kernel, pinhole = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER), gtsam.Cal3_S2(1, 1, 0, 0, 0)
    keys: dict[int, int] = {}
    for frame, obs in observations.items():
        centers = (placed.world_from_rig[frame] @ obs.rig_from_cams)[obs.camera, :3, 3]
        point_stds = POINT_STD_M + POINT_STD_SHARE * np.linalg.norm(obs.points - centers, axis=1)
        mounts = [gtsam.Pose3(rigid(mount)) for mount in obs.rig_from_cams]
        rows = zip(obs.rays, obs.stds, obs.points, obs.point_index.tolist(), obs.camera, point_stds, strict=True)
        for ray, std, point, index, camera, point_std in rows:
            key = keys.get(index, len(odometry) + values.size())
            if not values.exists(key):
                values.insert(key, point)
                graph.add(gtsam.PriorFactorPoint3(key, point, gtsam.noiseModel.Isotropic.Sigma(3, point_std)))
                keys |= {index: key} if index >= 0 else {}
            noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, std))
            factor = gtsam.GenericProjectionFactorCal3_S2(
                *(ray, noise, frame, key, pinhole), False, False, mounts[camera]
            )  # False, False: a point behind the camera neither raises nor prints
            graph.add(factor)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    poses = np.stack([result.atPose3(number).matrix() for number in range(len(odometry))])
    turned_deg, moved_m = geometry.pose_error(poses, placed.world_from_rig)
    variances = np.diagonal(placed.covariances, axis1=1, axis2=2)
    rotation_std, position_std = (np.sqrt(variances[:, part].sum(axis=1)) for part in (slice(3), slice(3, 6)))
    # Larger changes contradict odometry and the other queries, so the observations were wrong matches.
    agrees = (np.radians(turned_deg) < 4 * rotation_std) & (moved_m < 4 * position_std)
    return replace(placed, world_from_rig=poses) if agrees.all() else placed
