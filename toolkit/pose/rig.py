"""Geometry of a query: its camera, or the cameras of its rig, and their matches with map points."""

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit import geometry
from toolkit.capture.cameras import projection_jacobian, view_bounds
from toolkit.features.features import LocalFeatures, Shorten
from toolkit.features.matching import unit_descriptors
from toolkit.geometry import Floats, Ints

RANSAC_CONFIDENCE = 0.999
MAX_RANSAC_TRIALS = 5000
"""Largest number of RANSAC samples."""
MAX_RANSAC_MATCHES = 2500
"""Largest number of matches given to RANSAC, chosen at random; guided matching finds the others again."""
LOSS_PX = 1.0
"""Scale of the loss of a refinement from a rough pose, pixels."""
LOSS_SHARE = 0.6
"""Scale from a close pose, as a share of the median error. Errors of points and keypoints have heavy tails: with 1 px,
the position errors of the captures in docs/results.md are 4 % larger. With a smaller share, poses are clearly worse
where errors are Gaussian, and the covariance, which is that of plain least squares, is too small for them."""
MIN_LOSS_PX = 0.05
"""Smallest scale, pixels: exact matches have no error."""
STEP = 1e-6
"""Length of the step, meters and radians, after which a refinement ends."""
CELLS = 4
"""Columns and rows of the cells of an image."""
POSELIB_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
"""COLMAP's names of the camera models that PoseLib 2.0.5 can refine with. With others it returns the pose unchanged."""

# PoseLib's solver for rigs uses the random generator of the C library, which all threads share. So that equal seeds
# give equal poses, it is seeded before each call, and only one call runs at a time. Other libraries (ZeroMQ in a
# notebook) may still draw from it and change the last digits: so the pose is rounded before it is refined.
_RIG_RANSAC = Lock()
_DECIMALS = 9


@dataclass(frozen=True)
class Matches:
    """K matches of query keypoints with map points."""

    camera: Ints
    """(K,) index of the query image."""
    pixels: Floats
    """(K, 2) keypoints in that image."""
    point: Ints
    """(K,) index of the map point."""

    @classmethod
    def pooled(cls, parts: "Sequence[Matches]") -> "Matches":
        """Return the matches of all parts, in order."""
        return cls(
            np.concatenate([np.zeros(0, np.int64), *(part.camera for part in parts)]),
            np.concatenate([np.zeros((0, 2)), *(part.pixels for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.point for part in parts)]),
        )

    def rows(self) -> NDArray[np.void]:
        """Return the matches (K,) as values that can be tested for equality."""
        rows = np.ascontiguousarray(np.column_stack([self.camera, self.point, self.pixels]))
        return rows.view([("", rows.dtype)] * rows.shape[1])[:, 0]

    def __len__(self) -> int:
        return len(self.point)

    def __getitem__(self, part: NDArray[np.bool_] | Ints) -> "Matches":
        return Matches(self.camera[part], self.pixels[part], self.point[part])


class RigQuery:
    """The cameras of a query and their features; computes poses, projections and errors of matches.

    A single camera is a rig of one.
    """

    def __init__(self, cameras: list[pycolmap.Camera], rig_from_cams: Floats, features: list[list[LocalFeatures]]):
        self.cameras = cameras
        self.rig_from_cams = rig_from_cams
        self.features = features  # [camera][kind]
        self._cams_from_rig = [_poselib(pose) for pose in geometry.invert(rig_from_cams)]
        self.focals_px = np.array([camera.mean_focal_length() for camera in cameras])
        self.bounds = np.stack([view_bounds(camera) for camera in cameras])
        self._unit: dict[tuple[int, int], NDArray[np.float32]] = {}
        self.trees = [
            [KDTree(f.keypoints) if len(f) else KDTree(np.zeros((1, 2)) - 1e9) for f in kinds] for kinds in features
        ]

    def unit_descriptors(self, camera: int, kind: int, shorten: Shorten | None) -> NDArray[np.float32]:
        """Return the `unit_descriptors` (N, D) of an image's features of one kind; `shorten` belongs to the kind."""
        if (camera, kind) not in self._unit:
            self._unit[camera, kind] = unit_descriptors(self.features[camera][kind].descriptors, shorten)
        return self._unit[camera, kind]

    def num_cells(self, matches: Matches) -> int:
        """Return the number of cells, of all images, with a match."""
        sizes = np.array([(camera.width, camera.height) for camera in self.cameras])
        cells = np.clip(CELLS * matches.pixels / sizes[matches.camera], 0, CELLS - 1).astype(np.int64)
        return len(np.unique(np.column_stack([matches.camera, cells]), axis=0))

    def pixels(self, camera: Ints, keypoint: Ints, kind: int) -> Floats:
        """Return the pixels (K, 2) of keypoints of one kind, given by camera (K,) and index (K,)."""
        pixels = np.zeros((len(camera), 2))
        for index, kinds in enumerate(self.features):
            pixels[camera == index] = kinds[kind].keypoints[keypoint[camera == index]]
        return pixels

    def ransac(
        self,
        matches: Matches,
        points: Floats,
        max_error_deg: float,
        seed: int,
        least_inliers: int = 0,
        max_trials: int = MAX_RANSAC_TRIALS,
    ) -> Floats | None:
        """Return the pose rig_from_world (4, 4) with the most inliers, by LO-RANSAC (PoseLib), or None.

        Errors are measured on the undistorted image plane at depth 1, times the mean focal length.

        Args:
            matches: K matches.
            points: (P, 3) the map points.
            max_error_deg: inlier threshold, as an angle.
            seed: of the random generators.
            least_inliers: RANSAC may miss poses with fewer inliers, which saves time.
            max_trials: largest number of samples.
        """
        if len(np.unique(matches.point)) < 4:
            return None
        if len(matches) > MAX_RANSAC_MATCHES:
            chosen = np.random.default_rng(seed).permutation(len(matches))
            kept = np.zeros(len(matches), bool)
            kept[chosen[:MAX_RANSAC_MATCHES]] = True
            least_inliers = least_inliers * MAX_RANSAC_MATCHES // len(matches)
            matches = matches[kept]
        least_share = np.clip(least_inliers / len(matches), 1e-3, 0.99)
        trials = np.log(1 - RANSAC_CONFIDENCE) / np.log1p(-(least_share**3))  # to draw one sample of three inliers
        options = {
            "success_prob": RANSAC_CONFIDENCE,
            "dyn_num_trials_mult": 1.0,
            "min_iterations": 100,
            "max_iterations": int(np.clip(trials, 100, max_trials)),
            "seed": seed,
            "max_reproj_error": float(np.tan(np.radians(max_error_deg)) * self.focals_px.mean()),
        }
        origin = geometry.local_origin(points[matches.point])
        pixels, xyz, cameras = self._by_camera(matches, points, origin, undistort=True)
        if sum(map(len, xyz)) < 4:
            return None
        if len(self.cameras) == 1:
            pose, info = poselib.estimate_absolute_pose(pixels[0], xyz[0], cameras[0], options)
        else:
            with _RIG_RANSAC:
                pycolmap.set_random_seed(seed)  # seeds the C library, too
                pose, info = poselib.estimate_generalized_absolute_pose(
                    pixels, xyz, self._cams_from_rig, cameras, options
                )
        if info["num_inliers"] < 4 or not np.isfinite(pose.Rt).all():
            return None
        if len(self.cameras) == 1:
            return _from_world(self.rig_from_cams[0] @ _matrix(pose.Rt), origin)
        rotation = geometry.quaternion_to_rotation(np.round(pose.q, _DECIMALS))
        return _from_world(geometry.make_pose(rotation, np.round(pose.t, _DECIMALS - 3)), origin)

    def _by_camera(
        self, matches: Matches, points: Floats, origin: Floats, undistort: bool
    ) -> tuple[list[Floats], list[Floats], list[dict[str, Any]]]:
        """Return pixels (n, 2) and points (n, 3) of the matches of each camera, and the cameras, as PoseLib takes them.

        Args:
            origin: (3,) in the world, origin of the returned points.
            undistort: return pixels of pinhole cameras with the mean focal length of the rig, not of the actual lenses.
        """
        focal_px = float(self.focals_px.mean())
        pixels, xyz, cameras = [], [], []
        for index, camera in enumerate(self.cameras):
            part = matches.camera == index
            xy, in_world = matches.pixels[part], points[matches.point[part]] - origin
            model, params = camera.model.name, camera.params.tolist()
            if undistort or model not in POSELIB_MODELS:
                xy = focal_px * np.asarray(camera.cam_from_img(xy)).reshape(-1, 2)
                finite = np.isfinite(xy).all(axis=1)
                xy, in_world = xy[finite], in_world[finite]
                model, params = "SIMPLE_PINHOLE", [focal_px, 0.0, 0.0]
            pixels.append(xy)
            xyz.append(in_world)
            cameras.append({"model": model, "width": camera.width, "height": camera.height, "params": params})
        return pixels, xyz, cameras

    def refine(self, rig_from_world: Floats, matches: Matches, points: Floats, close: bool = False) -> Floats:
        """Return rig_from_world (4, 4) that minimizes the reprojection errors of matches, by PoseLib.

        The loss is Cauchy's. For camera models that PoseLib does not know, errors are measured as in `ransac`.

        Args:
            rig_from_world: the pose to start from, (4, 4).
            matches: K matches.
            points: (P, 3) the map points.
            close: whether that pose is refined already. The scale of the loss then follows the errors, up to `LOSS_PX`,
                if PoseLib knows the lenses.
        """
        scale_px = LOSS_PX
        if close and len(matches) > 6 and all(camera.model.name in POSELIB_MODELS for camera in self.cameras):
            median_px = np.median(self.errors_px(rig_from_world, matches, points))
            # A pose fits few matches too well (Rousseeuw and Leroy 1987, "Robust Regression", section 5.1).
            scale_px = float(np.clip(LOSS_SHARE * (1 + 5 / (len(matches) - 6)) * median_px, MIN_LOSS_PX, LOSS_PX))
        origin = geometry.local_origin(points[matches.point])
        pixels, xyz, cameras = self._by_camera(matches, points, origin, undistort=False)
        options = {"loss_type": "CAUCHY", "loss_scale": scale_px, "step_tol": STEP}
        refined, _ = poselib.refine_generalized_absolute_pose(
            pixels, xyz, _poselib(_from_world(rig_from_world, -origin)), self._cams_from_rig, cameras, options
        )
        return _from_world(_matrix(refined.Rt), origin)

    def projected(self, rig_from_world: Floats, matches: Matches, points: Floats) -> Floats:
        """Return the projections (K, 2) of the matched points in their images, pixels; inf behind a camera."""
        pixels = np.full((len(matches), 2), np.inf)
        for index, camera in enumerate(self.cameras):
            part = np.flatnonzero(matches.camera == index)
            if not len(part):
                continue
            cam_from_world = geometry.invert(self.rig_from_cams[index]) @ rig_from_world
            in_cam = geometry.transform(cam_from_world, points[matches.point[part]])
            projected = np.asarray(camera.img_from_cam(in_cam))
            seen = (in_cam[:, 2] > 1e-3) & np.isfinite(projected).all(axis=1)
            pixels[part] = np.where(seen[:, None], projected, np.inf)
        return pixels

    def errors_px(self, rig_from_world: Floats, matches: Matches, points: Floats) -> Floats:
        """Return the reprojection errors (K,) of matches with points (P, 3), pixels; inf behind a camera."""
        errors = self.projected(rig_from_world, matches, points) - matches.pixels
        return np.asarray(np.linalg.norm(errors, axis=1), np.float64)

    def errors_deg(self, rig_from_world: Floats, matches: Matches, points: Floats) -> Floats:
        """Return the reprojection errors (K,) as angles."""
        errors = self.errors_px(rig_from_world, matches, points)
        return np.degrees(np.arctan(errors / self.focals_px[matches.camera]))

    def jacobians(self, rig_from_world: Floats, matches: Matches, points: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of the projections of K matches, in pixels.

        Returns:
            The derivatives by a small motion d of the rig, (K, 2, 6): rotation (radians) and translation (meters) in
            the rig's frame, world_from_rig @ Exp(d), as in the benchmark's covariances; and by a motion of the point in
            the world, (K, 2, 3).
        """
        of_pose, of_point = np.zeros((len(matches), 2, 6)), np.zeros((len(matches), 2, 3))
        for index in np.unique(matches.camera):
            part = matches.camera == index
            cam_from_rig = geometry.invert(self.rig_from_cams[index])
            in_rig = geometry.transform(rig_from_world, points[matches.point[part]])
            in_cam = geometry.transform(cam_from_rig, in_rig)
            # A motion d of the rig moves a point in its frame by -(rotation x point) - translation.
            x, y, z = in_rig.T
            zero = np.zeros_like(x)
            skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
            moved = np.concatenate([skew, np.broadcast_to(-np.eye(3), skew.shape)], axis=2)
            projection = projection_jacobian(in_cam, np.full(len(in_cam), self.focals_px[index]))
            of_pose[part] = projection @ (cam_from_rig[:3, :3] @ moved)
            of_point[part] = projection @ (cam_from_rig[:3, :3] @ rig_from_world[:3, :3])
        return of_pose, of_point


def least_squares_covariance(
    jacobian: Floats,
    errors_px: Floats,
    noise_px2: Floats,
    prior_information: Floats | None = None,
    weights: Floats | None = None,
) -> Floats | None:
    """Return the covariance (U, U) of a least squares estimate of U unknowns from K projections; None if undefined.

    It is the sandwich N^-1 M N^-1 (Huber 1967): N is the information of the projections for unit noise, M is computed
    from the actual noise, the spread of the errors plus `noise_px2`. The spread already contains part of `noise_px2`;
    counting it twice makes up for noise that is not modeled, such as the errors of the map's poses.

    Args:
        jacobian: (K, 2, U), derivatives of the projections by the unknowns.
        errors_px: (K,) reprojection errors.
        noise_px2: (K, 2, 2), covariance of each projection due to its point, square pixels. Projections whose
            covariance is not finite are left out.
        prior_information: (U, U), information on the unknowns from other sources.
        weights: (K,), at most 1, of the information of the projections. The spread of the errors is that of the
            projections of weight 1. None: all have it.
    """
    weights = np.ones(len(errors_px)) if weights is None else weights
    valid = np.isfinite(noise_px2).all(axis=(1, 2))
    measured = errors_px[valid & (weights == 1)]
    if len(measured) < 4:
        return None
    jacobian, noise_px2 = jacobian[valid] * np.sqrt(weights[valid])[:, None, None], noise_px2[valid]
    # Two coordinates per point, six parameters of the pose.
    variance = float((measured**2).sum()) / max(2 * len(measured) - 6, 1)
    prior = np.zeros((jacobian.shape[2],) * 2) if prior_information is None else prior_information
    information = np.einsum("oki,okj->ij", jacobian, jacobian) + variance * prior
    if not np.isfinite(information).all() or np.linalg.cond(information) > 1e14:
        return None
    noise = noise_px2 + variance * np.eye(2)
    middle = np.einsum("oki,okl,olj->ij", jacobian, noise, jacobian) + variance**2 * prior
    inverse = np.linalg.inv(information)
    return np.asarray(inverse @ middle @ inverse, np.float64)


def _from_world(rig_from_local: Floats, origin: Floats) -> Floats:
    """Return rig_from_world (4, 4), given a pose in a frame whose origin (3,) is in the world; zero: the same frame."""
    if not origin.any():
        return np.asarray(rig_from_local, np.float64)
    return geometry.shifted(rig_from_local, -rig_from_local[:3, :3] @ origin)


def _poselib(pose: Floats) -> poselib.CameraPose:
    converted = poselib.CameraPose()
    converted.Rt = pose[:3]
    return converted


def _matrix(pose: Floats) -> Floats:
    """Return a pose (3, 4) as (4, 4)."""
    return np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
