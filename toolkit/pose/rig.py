"""Geometry of a query: its camera, or the cameras of its rig, and their matches with map points; and whether these
matches contradict its intrinsics.

The pose absorbs most of an error of the intrinsics: a wrong focal length changes the distance, a wrong principal point
the rotation. A pattern remains in the reprojection errors, as near and far points, image center and border, and the
cameras of a rig need different corrections. So pose and intrinsics are estimated together, as in bundle adjustment, and
the result is compared with the stated intrinsics.

Errors of neighboring matches are not independent: a rolling shutter, noise of the map's poses and a lens that the model
describes only roughly move them together, and such a pattern looks like other intrinsics. So all matches in a cell of
the image count as one observation.

Some scenes do not determine the intrinsics: for a plane that faces the camera, every focal length fits at some
distance. The standard deviation of the focal length is then so large that no difference is significant, and the stated
one is accepted.

Absurd intrinsics (ten times the focal length) give a pose from which no fit begins. Then other cameras are tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from toolkit import geometry
from toolkit.alignment.robust import Bools
from toolkit.capture.images import projection_jacobian, view_bounds
from toolkit.features.features import LocalFeatures, Shorten
from toolkit.features.matching import unit_descriptors
from toolkit.geometry import Floats, Ints
from toolkit.pose.base import AGREEMENT

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
STEP = 1e-8
"""Length of the step, meters and radians, after which a refinement ends. With 1e-6, 1.7 micrometers are left."""
CELLS = 4
"""Columns and rows of the cells of an image."""
POSELIB_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
"""COLMAP's names of the camera models that PoseLib 2.0.5 can refine with. With others it returns the pose unchanged."""
# PoseLib's solver for rigs uses the random generator of the C library, which all threads share. So that equal seeds
# give equal poses, it is seeded before each call, and only one call runs at a time. Other libraries (ZeroMQ in a
# notebook) may still draw from it and change the last digits: so the pose is rounded before it is refined.
_RIG_RANSAC = Lock()
_DECIMALS = 9

# Of the check of the intrinsics
SIGNIFICANCE = 1e-4
"""False alarm rate: the probability that noise alone makes correct intrinsics look wrong."""
MAX_SHARES = (0.1, 0.3, 0.1)
"""Largest motion of the pose to that of the intrinsics that fit, as a share of what `ok` allows (5 degrees, 0.5 m): due
to focal length, principal point, radial distortion. Nominal principal points are often 1 % of the focal length off."""
SUSPICIOUS = 0.01  # largest probability of the first step (a cheap test) for which the full test runs
CERTAIN = 1e-6  # largest probability of the first step for which intrinsics are wrong even if no others are found
WIDENINGS = (8.0, 8.0, 4.0, 2.0)  # factors of the inlier limit in the first steps: wrong intrinsics enlarge errors
STEPS = 15
SETTLED_PX = 0.02  # largest motion of a projection in a step at which the fit has converged
MIN_SCALE_PX = 0.5  # least scale of the Cauchy weights
PRIOR_STD = (0.2, 0.02, 0.02, 0.05)  # prior standard deviations of the four `Misfit.parameters`
FOCALS = (0.45, 0.7, 1.1, 1.7, 2.6, 4.0)  # focal lengths of the cameras to try, over the longer side of the image
MORE = 3.0
"""Such a camera fits if its odds of an inlier, times the cells that have one, are so many times those of the stated.
A wrong camera fits a part of the image: where focal lengths, distortions or principal points are absurd, or images are
cropped off-center, the ratio is 4.5 and more; of right cameras by night, where windows repeat, at most 2.6."""
LEAST = 12  # its inliers must be more than these
FEW = 0.3  # share of inliers among the matches below which other cameras are tried if the first step is certain
VERY_FEW = 0.2  # share below which they are tried in any case
TRIALS = 1000  # samples of their RANSAC
ABSURD = 0.2  # smallest change of the intrinsics, relatively, that makes another camera another


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
        return len(np.unique(self.cells(matches)))

    def cells(self, matches: Matches, along: int = CELLS) -> Ints:
        """Return the cells (K,) of matches, as numbers; an image has `along` columns and rows of them."""
        sizes = np.array([(camera.width, camera.height) for camera in self.cameras])
        column, row = np.clip(along * matches.pixels / sizes[matches.camera], 0, along - 1).astype(np.int64).T
        return np.asarray((matches.camera * along + row) * along + column, np.int64)

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
    jacobian: Floats, errors_px: Floats, noise_px2: Floats, weights: Floats | None = None
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
    information = np.einsum("oki,okj->ij", jacobian, jacobian)
    if not np.isfinite(information).all() or np.linalg.cond(information) > 1e14:
        return None
    noise = noise_px2 + variance * np.eye(2)
    middle = np.einsum("oki,okl,olj->ij", jacobian, noise, jacobian)
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


# The check of the intrinsics


@dataclass(frozen=True)
class Misfit:
    """Intrinsics that fit the matches of a pose significantly better than the stated ones."""

    shift: Floats
    """(6,) motion of the rig, in its own frame, to the pose with these intrinsics: rotation in radians, then
    translation in meters."""
    parameters: Floats
    """(C, 4) change of the intrinsics of each camera: relative change of the focal length; shift of the principal point
    in x and y, in focal lengths; and radial distortion, as the relative change of the distance from the principal point
    at an image corner. NaN if the intrinsics that fit are unknown."""
    shares: Floats
    """(C, 3) how far the changes of focal length, principal point and distortion move the pose, as a share of what `ok`
    allows; 0 if a change is not significant."""

    @property
    def doubtful(self) -> bool:
        """Whether a significant change moves the pose beyond `MAX_SHARES`, or the intrinsics that fit are unknown."""
        return bool(np.isnan(self.parameters).any() or (self.shares > MAX_SHARES).any())

    @property
    def _at_fault(self) -> Ints:
        """(C,) what misfits most: focal length (0), principal point (1), distortion (2) or nothing (-1)."""
        excess = self.shares / MAX_SHARES
        return np.where(excess.any(axis=1), excess.argmax(axis=1), -1)

    def focals_px(self, cameras: list[pycolmap.Camera]) -> tuple[float, ...]:
        """Return the focal length that fits each camera; NaN if something else or nothing misfits."""
        return tuple(np.where(self._at_fault == 0, self._fitted(cameras)[:, 0], np.nan).tolist())

    def centers_px(self, cameras: list[pycolmap.Camera]) -> tuple[tuple[float, float], ...]:
        """Return the principal point that fits each camera; NaN if something else or nothing misfits."""
        centers = np.where(self._at_fault[:, None] == 1, self._fitted(cameras)[:, 1:], np.nan)
        return tuple((x, y) for x, y in centers.tolist())

    def _fitted(self, cameras: list[pycolmap.Camera]) -> Floats:
        """Return focal length and principal point x, y that fit each camera, (C, 3), pixels."""
        stated = _stated(cameras)
        focal, *center = self.parameters[:, :3].T
        return np.column_stack([stated[:, 0] * (1 + focal), stated[:, 1:] + stated[:, :1] * np.transpose(center)])

    def reason(self, cameras: list[pycolmap.Camera]) -> str:
        """Return a text that compares, for each camera that misfits, the fitted and the stated value."""
        if np.isnan(self.parameters).any():
            return "the matches contradict the intrinsics, and no others were found that fit: check model and numbers"
        texts, stated, fitted = [], _stated(cameras), self._fitted(cameras)
        for number in np.flatnonzero(self._at_fault >= 0):
            (focal_px, x, y), (fitted_px, fitted_x, fitted_y) = stated[number], fitted[number]
            corners = 100 * self.parameters[number, 3]
            text = (
                f"the focal length that fits is {fitted_px:.1f} px, its intrinsics say {focal_px:.1f} px",
                f"the principal point that fits is {fitted_x:.1f}, {fitted_y:.1f}, its intrinsics say {x:.1f}, {y:.1f}",
                f"the radial distortion that fits moves the corners by {corners:+.1f} % against its intrinsics",
            )[self._at_fault[number]]
            texts.append(f"camera {number + 1} of {len(cameras)}: {text}" if len(cameras) > 1 else text)
        return "; ".join(texts)


def _stated(cameras: list[pycolmap.Camera]) -> Floats:
    """Return mean focal length and principal point x, y of cameras, (C, 3), pixels."""
    return np.array([(one.mean_focal_length(), one.principal_point_x, one.principal_point_y) for one in cameras])


def find_misfit(
    query: RigQuery,
    rig_from_world: Floats,
    matches: Matches,
    points: Floats,
    max_error_deg: float,
    focal_alone: bool = False,
    noise_deg: float = 0.0,
) -> Misfit | None:
    """Return the intrinsics that fit significantly better than the stated ones; None if there are none.

    Gauss-Newton with Cauchy weights fits pose and intrinsics. An F-test tells whether the change is significant.

    Args:
        query: the cameras.
        rig_from_world: the pose (4, 4) found with the stated intrinsics.
        matches: all matches from descriptors alone, inliers and outliers. Guided matches cannot be used: they were
            searched near the pose, so they agree with it even if it is wrong.
        points: (P, 3) the map points.
        max_error_deg: largest error of an inlier.
        focal_alone: keep principal points and distortions as stated; changing them can make wrong poses look correct.
        noise_deg: standard deviation of the direction to map points due to noise of the map's poses, degrees.
    """
    problem = _Problem(query, matches, points, max_error_deg)
    which = np.arange(problem.unknowns)
    pose = which < 6
    free = pose | (which % 4 == 2) if focal_alone else ~np.zeros(problem.unknowns, bool)
    start = _Estimate(rig_from_world, np.zeros(problem.unknowns - 6))
    first = problem.step(start, free, WIDENINGS[0])
    by_chance = 1.0 if first is None else first.probability(first.change, free & ~pose)
    inliers = problem.inliers(start)
    share = float(inliers.mean()) if inliers.size else 1.0
    if by_chance > SUSPICIOUS and share > VERY_FEW:
        return None
    fitted = problem.fit(start, free)
    if share < VERY_FEW or (by_chance < CERTAIN and (fitted is None or problem.inliers(fitted).mean() < FEW)):
        other = _try_cameras(problem, start, problem.inliers(fitted or start))
        if other is not None:
            return other
    if fitted is None or by_chance > SUSPICIOUS:
        unknown = np.full((len(query.cameras), 4), np.nan)
        return Misfit(np.zeros(6), unknown, np.zeros((len(unknown), 3))) if by_chance < CERTAIN else None
    return problem.misfit(start, fitted, free, float(np.tan(np.radians(noise_deg)) * query.focals_px.mean()))


def _try_cameras(stated: "_Problem", start: "_Estimate", inliers: Bools) -> Misfit | None:
    """Return the misfit of stated cameras to which others are clearly preferable; None if there are no such others.

    The others have the principal point in the center of the image and, to start with, no distortion.

    Args:
        stated, start: the matches with the stated cameras, and the pose found with them.
        inliers: (K,) whether matches are inliers of the stated cameras, with small changes of the intrinsics.
    """

    def fit_of(inliers: Bools) -> float:
        """Return the odds of an inlier, times the cells that have one."""
        return stated.query.num_cells(stated.matches[inliers]) * int(inliers.sum()) / max(int((~inliers).sum()), 1)

    best, misfit = MORE * fit_of(inliers), None
    for share in FOCALS:
        cameras = [_simple(camera, share) for camera in stated.query.cameras]
        query = RigQuery(cameras, stated.query.rig_from_cams, [[] for _ in cameras])
        pose = query.ransac(stated.matches, stated.points, stated.max_error_deg, seed=0, max_trials=TRIALS)
        if pose is None:
            continue
        problem = _Problem(query, stated.matches, stated.points, stated.max_error_deg)
        fitted = problem.fit(_Estimate(pose, np.zeros(problem.unknowns - 6)), ~np.zeros(problem.unknowns, bool))
        if fitted is not None and (found := problem.inliers(fitted)).sum() > LEAST and fit_of(found) > best:
            best = fit_of(found)
            changes = np.array(list(map(_change, stated.query.cameras, cameras, fitted.parameters.reshape(-1, 4))))
            # If it is nearly the stated camera, the fit will tell.
            focal, right, down, distortion = changes.T  # and how far they move pixels, relatively
            sizes = np.column_stack([np.abs(np.log1p(focal)), np.hypot(right, down), np.abs(distortion)])
            largest = np.where(sizes == sizes.max(axis=1, keepdims=True), 1.0, 0.0)
            misfit = Misfit(_motion(start, fitted), changes, largest) if sizes.max() > ABSURD else None
    return misfit


def _simple(camera: pycolmap.Camera, share: float) -> pycolmap.Camera:
    """Return a camera for the same images without distortion, with a focal length of a share of the longer side."""
    width, height = camera.width, camera.height
    params = [share * max(width, height), width / 2, height / 2]
    return pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)


def _change(stated: pycolmap.Camera, other: pycolmap.Camera, parameters: Floats) -> Floats:
    """Return the `Misfit.parameters` (4,) from stated intrinsics to those at a change (4,) of another camera."""
    (focal_px, *center), (other_px, *other_center) = _stated([stated, other])
    center, other_center = np.array(center), other_center + other_px * parameters[1:3]
    corner = np.hypot(stated.width, stated.height) / 2 / focal_px
    seen = np.asarray(stated.img_from_cam(np.array([[corner, 0.0, 1.0]]))).ravel()
    distortion = float(np.nan_to_num(np.linalg.norm(seen - center) / (corner * focal_px) - 1, nan=-1.0))
    focal = other_px * (1 + parameters[0]) / focal_px - 1
    return np.array([focal, *((other_center - center) / focal_px), parameters[3] - distortion])


def _motion(start: "_Estimate", end: "_Estimate") -> Floats:
    """Return `Misfit.shift` (6,) from one pose to another."""
    return geometry.small_motions((start.rig_from_world @ geometry.invert(end.rig_from_world))[None])[0]


class _Estimate(NamedTuple):
    rig_from_world: Floats
    parameters: Floats
    """(4 C,) changes of the intrinsics, `Misfit.parameters` flattened."""


class _Step(NamedTuple):
    """A step of Gauss-Newton."""

    change: Floats
    """(U,) change of the unknowns."""
    largest_px: float
    """Largest weighted motion of a projection, per coordinate."""
    covariance: Floats
    """(U, U), 0 for unknowns that are not free."""
    freedom: int
    """Degrees of freedom."""

    def probability(self, values: Floats, tested: Bools) -> float:
        """Return the probability (F-test) that noise alone makes the tested ones of values (U,) this large."""
        values, covariance = values[tested], self.covariance[np.ix_(tested, tested)]
        squares = float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)
        return float(fdtrc(len(values), self.freedom, max(squares, 0.0) / len(values)))


class _Problem:
    """U unknowns, the pose and the intrinsics of a query, and the K matches to fit them to."""

    def __init__(self, query: RigQuery, matches: Matches, points: Floats, max_error_deg: float) -> None:
        self.query, self.matches, self.points, self.max_error_deg = query, matches, points, max_error_deg
        self._limits_px = np.tan(np.radians(max_error_deg)) * query.focals_px[matches.camera]
        self._prior = np.diag(np.concatenate([np.zeros(6), np.tile(1 / np.square(PRIOR_STD), len(query.cameras))]))
        self.unknowns = len(self._prior)

    def linearize(self, estimate: _Estimate) -> tuple[Floats, Floats]:
        """Return residuals (K, 2), infinite behind a camera, and the Jacobian (K, 2, U) of the projections."""
        residuals = np.full((len(self.matches), 2), np.inf)
        jacobian = np.zeros((len(self.matches), 2, self.unknowns))
        in_rig = geometry.transform(estimate.rig_from_world, self.points[self.matches.point])
        for index, camera in enumerate(self.query.cameras):
            rows = np.flatnonzero(self.matches.camera == index)
            cam_from_rig = geometry.invert(self.query.rig_from_cams[index])
            in_cam = geometry.transform(cam_from_rig, in_rig[rows])
            projected = np.asarray(camera.img_from_cam(in_cam), np.float64).reshape(-1, 2)
            visible = (in_cam[:, 2] > 1e-3) & np.isfinite(projected).all(axis=1)
            rows, in_cam, projected = rows[visible], in_cam[visible], projected[visible]
            focal_px, changes = self.query.focals_px[index], estimate.parameters[4 * index : 4 * index + 4]
            offsets = projected - (camera.principal_point_x, camera.principal_point_y)
            corner_px2 = (camera.width**2 + camera.height**2) / 4
            of_intrinsics = np.zeros((len(rows), 2, 4))
            of_intrinsics[:, :, 0] = offsets
            of_intrinsics[:, 0, 1] = of_intrinsics[:, 1, 2] = focal_px
            of_intrinsics[:, :, 3] = offsets * ((offsets**2).sum(axis=1) / corner_px2)[:, None]
            residuals[rows] = self.matches.pixels[rows] - projected - of_intrinsics @ changes
            of_point = projection_jacobian(in_cam, np.full(len(rows), focal_px * (1 + changes[0])))
            of_point = of_point @ cam_from_rig[:3, :3]  # with the point in the rig frame
            # A motion of the rig moves a point in it by -(rotation x point) - translation.
            jacobian[rows, :, :3] = np.cross(of_point, in_rig[rows, None])
            jacobian[rows, :, 3:6] = -of_point
            jacobian[rows, :, 6 + 4 * index : 10 + 4 * index] = of_intrinsics
        return residuals, jacobian

    def step(self, estimate: _Estimate, free: Bools, widening: float) -> _Step | None:
        """Return the next step of the free unknowns (U,); None if the matches do not determine them.

        Inliers have errors up to `widening` times the limit.
        """
        residuals, jacobian = self.linearize(estimate)
        errors = np.linalg.norm(residuals, axis=1)
        inliers = errors < widening * self._limits_px
        freedom = 2 * int(inliers.sum()) - int(free.sum())
        if freedom < 1:
            return None
        errors = errors[inliers]
        # Square roots of the Cauchy weights.
        roots = 1 / np.sqrt(1 + (errors / max(float(np.median(errors)), MIN_SCALE_PX)) ** 2)
        weighted = roots[:, None, None] * jacobian[inliers][:, :, free]
        residuals = roots[:, None] * residuals[inliers]
        variance = float((residuals**2).sum()) / freedom
        prior = self._prior[np.ix_(free, free)]
        flat = weighted.reshape(-1, weighted.shape[2])
        information = flat.T @ flat + variance * prior
        if np.linalg.cond(information) > 1e14:
            return None
        inverse = np.linalg.inv(information)
        so_far = np.concatenate([np.zeros(6), estimate.parameters])[free]
        solved = inverse @ (flat.T @ residuals.ravel() - variance * (prior @ so_far))
        if not np.isfinite(solved).all():
            return None
        change, covariance = np.zeros(self.unknowns), np.zeros((self.unknowns, self.unknowns))
        change[free], covariance[np.ix_(free, free)] = solved, variance * inverse
        return _Step(change, float(np.abs(flat @ solved).max()), covariance, freedom)

    def fit(self, start: _Estimate, free: Bools) -> _Estimate | None:
        """Return the estimate at the minimum; each step selects inliers again. None if there is no minimum."""
        estimate = start
        for number in range(STEPS):
            step = self.step(estimate, free, WIDENINGS[number] if number < len(WIDENINGS) else 1.0)
            if step is None:
                return None
            motion = geometry.make_pose(Rotation.from_rotvec(step.change[:3]).as_matrix(), step.change[3:6])
            estimate = _Estimate(
                geometry.invert(motion) @ estimate.rig_from_world, estimate.parameters + step.change[6:]
            )
            if number >= len(WIDENINGS) and step.largest_px < SETTLED_PX:
                break
        return estimate

    def inliers(self, estimate: _Estimate) -> Bools:
        """Tell which matches (K,) are inliers."""
        return np.linalg.norm(self.linearize(estimate)[0], axis=1) < self._limits_px

    def misfit(self, start: _Estimate, fitted: _Estimate, free: Bools, noise_px: float) -> Misfit | None:
        """Return what fitted intrinsics say of the stated ones; None if noise alone may explain the difference.

        Args:
            start: the pose with the stated intrinsics.
            fitted: the estimate at the minimum.
            free: (U,) the unknowns that were fitted.
            noise_px: standard deviation of projections due to noise of the map's poses.
        """
        residuals, jacobian = self.linearize(fitted)
        errors = np.linalg.norm(residuals, axis=1)
        inliers = errors < self._limits_px
        observations, cameras = self.query.num_cells(self.matches[inliers]), len(self.query.cameras)
        freedom = 2 * observations - int(free.sum())
        if freedom < 1:
            return None
        errors = errors[inliers]
        weights = 1 / (1 + (errors / max(float(np.median(errors)), MIN_SCALE_PX)) ** 2)
        variance = float((weights * errors**2).sum()) / max(2 * len(errors) - int(free.sum()), 1)
        information = np.einsum("k,kia,kib->ab", weights, jacobian[inliers], jacobian[inliers])
        # The covariance if all errors in a cell are equal, and noise of the map's poses comes on top.
        excess = len(errors) / observations * (1 + noise_px**2 / variance)
        inverse = np.linalg.inv((information / variance + self._prior)[np.ix_(free, free)])
        covariance = np.zeros_like(information)
        covariance[np.ix_(free, free)] = excess * inverse @ information[np.ix_(free, free)] @ inverse / variance
        changes = np.concatenate([np.zeros(6), fitted.parameters])
        step = _Step(changes, 0.0, covariance, freedom)
        which = np.arange(self.unknowns)
        if step.probability(changes, free & (which >= 6)) > SIGNIFICANCE:
            return None
        by_chance, shares = np.ones((cameras, 3)), np.zeros((cameras, 3))
        for camera in range(cameras):
            for kind, columns in enumerate(([0], [1, 2], [3])):
                tested = np.isin(which, 6 + 4 * camera + np.array(columns)) & free
                if tested.any():
                    by_chance[camera, kind] = step.probability(changes, tested)
                    motion = np.linalg.solve(information[:6, :6], information[:6, tested] @ changes[tested])
                    sizes = np.degrees(np.linalg.norm(motion[:3])), np.linalg.norm(motion[3:])
                    shares[camera, kind] = max(np.divide(sizes, AGREEMENT))
        at_fault = by_chance <= max(SIGNIFICANCE, float(by_chance.min()))
        return Misfit(_motion(start, fitted), fitted.parameters.reshape(-1, 4), np.where(at_fault, shares, 0.0))
