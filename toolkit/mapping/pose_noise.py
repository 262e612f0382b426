"""Measure the noise of a map's poses and errors of its intrinsics, from image pairs matched without poses; and adjust a
map whose poses are noisy.

Each match puts the second ray off its epipolar plane by an angle. Over a pair, noise of the two poses gives this angle
a pattern of six numbers; one common error of the cameras gives it the same pattern in all pairs.

In the bundle adjustment, the given positions are priors, and intrinsics stay as they are.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.special import fdtrc

from toolkit import geometry
from toolkit.alignment.similarity import align_to_map
from toolkit.geometry import Floats
from toolkit.mapping.local_map import LocalMap

MIN_MATCHES = 16  # of a pair that counts
MAX_MATCHES = 200  # of a pair that are used
MIN_PAIRS = 6  # for an estimate
INDEPENDENT = 20.0  # number of independent matches of a pair, as errors of neighbors are alike
MIN_PARALLAX_DEG = 0.3  # of a match that tells the depth of its point; others count as infinitely far
NEAREST = 0.01  # map lengths; no point is nearer
MIN_ERROR = 2e-4  # radians; least scale of the errors of matches
SAME_SCALE = 2.0  # factor on the scale of the errors below which most matches agree with the poses as they are
FREEDOM = 5.0  # degrees of freedom of Student's distribution, in which a few pairs may be wrong
ROTATION_GRID_DEG = (0.0, *np.geomspace(0.02, 4, 18))
POSITION_GRID = (0.0, *np.geomspace(0.001, 0.4, 18))  # map lengths
MIN_GAIN = 5.0  # of the logarithm of the likelihood; without noise, twice the gain is distributed as chi-squared
SCAN = (-0.7, -0.5, -0.3, -0.15, 0.0, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0)  # changes of the focal length to start from
MIN_CHANGE = 0.03  # smallest change of intrinsics that is worth a word: of 1 %, poses feel nothing
IMITATED = 0.02  # change that systematic errors of SLAM poses imitate: KinectFusion's ask for 2 % of the focal length
SIGNIFICANCE = 1e-5  # largest probability that noise alone asks for what is beyond the imitated change
MIN_ANGLE = 5e-4  # radians; with smaller errors, principal points and distortions are right
STEP = 1e-4  # of numeric derivatives, and the smallest change of intrinsics that counts
MAX_REST_FOCAL, MAX_REST = 0.8, 0.5  # share of the errors that may be left: noise of poses imitates the other two

# Of the bundle adjustment
MIN_OBSERVATIONS = 12  # of an image; with fewer, its pose stays as it is
MAX_ITERATIONS = 50
PRIOR_NOISE = 3.0  # standard deviation of a given position, in multiples of the measured noise, which misses slow drift
MAX_ALIGNED = 50  # images by which the refined map is put where the given one was


class VerifiedPair(NamedTuple):
    """Two images and their matches that agree with one essential matrix."""

    i: int
    j: int
    rays_i: Floats  # (K, 3) unit rays in the frame of camera i
    rays_j: Floats  # (K, 3) unit rays in the frame of camera j
    j_from_i: Floats  # (4, 4) relative pose from the matches alone; the translation has length 1


class PoseNoise(NamedTuple):
    """Standard deviations of the noise of a map's poses, per axis."""

    rotation_deg: float = 0.0
    position: float = 0.0  # in map lengths, see `PoseConsistency.length`

    def direction_deg(self, depth: float) -> float:
        """Return the standard deviation of the direction to a point at a depth, map lengths; NaN: far away."""
        return float(np.hypot(self.rotation_deg, np.nan_to_num(np.degrees(np.arctan(self.position / depth)))))


class PosedPairs:
    """The matches of all pairs of a sample, one after the other, with the poses of their images."""

    def __init__(self, pairs: Sequence[VerifiedPair], world_from_cams: Floats) -> None:
        """
        Args:
            pairs: verified pairs; those with few matches are left out, and of the others matches above `MAX_MATCHES`.
            world_from_cams: (N, 4, 4).
        """
        pairs = [pair for pair in pairs if len(pair.rays_i) >= MIN_MATCHES]
        counts = np.array([min(len(pair.rays_i), MAX_MATCHES) for pair in pairs], np.int64)
        self.starts = np.concatenate([[0], np.cumsum(counts)])
        self._pair_of = np.repeat(np.arange(len(pairs)), counts)
        j_from_i = np.array([geometry.invert(world_from_cams[pair.j]) @ world_from_cams[pair.i] for pair in pairs])
        self._rotations, self._baselines = j_from_i.reshape(-1, 4, 4)[:, :3, :3], j_from_i.reshape(-1, 4, 4)[:, :3, 3]
        images = np.array([(pair.i, pair.j) for pair in pairs], np.int64).reshape(-1, 2)
        self._images = len(np.unique(images))
        self._share_image = (images[:, None, :, None] == images[None, :, None, :]).any(axis=(2, 3)).astype(np.float64)
        none = np.zeros((0, 3))
        chosen = [
            (pair, np.linspace(0, len(pair.rays_i) - 1, count).astype(np.int64))
            for pair, count in zip(pairs, counts, strict=True)
        ]
        self._rays_i = np.concatenate([none, *(pair.rays_i[rows] for pair, rows in chosen)])
        self._rays_j = np.concatenate([none, *(pair.rays_j[rows] for pair, rows in chosen)])

    def __len__(self) -> int:
        return len(self.starts) - 1

    def rows(self) -> list[slice]:
        """Return the rows of each pair."""
        return [slice(start, end) for start, end in pairwise(self.starts.tolist())]

    def planes(self, change: Floats | None = None) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the epipolar planes of all matches, with changed intrinsics (4,), see `_changed`.

        Returns:
            Signed angles of the second rays to the planes (K,), radians; normals of the planes, first rays and second
            rays, (K, 3) in the frame of the second camera.
        """
        first, second = (_changed(rays, change) for rays in (self._rays_i, self._rays_j))
        first = np.einsum("kab,kb->ka", self._rotations[self._pair_of], first)
        normals = np.cross(self._baselines[self._pair_of], first)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return (normals * second).sum(axis=1), normals, first, second

    def medians(self, change: Floats | None = None) -> Floats:
        """Return the median size of the angles of each pair, radians."""
        errors = np.abs(self.planes(change)[0])
        return np.array([np.median(errors[rows]) for rows in self.rows()])

    def noise(self, length: float) -> PoseNoise:
        """Return the noise of the poses for which the matches are most probable; none with too few pairs.

        For each pair, g = J'We and L = J'WJ are gradient and information of the motion between its cameras, from the
        angles e with derivatives J and robust weights W. With noise of covariance D of that motion, g is normal with
        covariance L + L D L. With S, the root of L, the pseudoinverse of S times g has the covariance 1 + S D S.

        Args:
            length: `PoseConsistency.length`, in the unit of the poses.
        """
        parts = self._motions(length)
        if len(parts) < MIN_PAIRS:
            return PoseNoise()
        values, vectors = np.linalg.eigh(np.array([information for information, _ in parts]))
        known = values > 1e-9 * values[:, -1:]
        roots = np.sqrt(np.where(known, values, 0.0))
        root = np.einsum("nai,ni,nbi->nab", vectors, roots, vectors)
        inverse = np.where(known, 1 / np.where(known, roots, 1.0), 0.0)
        gradient = np.einsum("nai,ni,nbi,nb->na", vectors, inverse, vectors, np.array([part for _, part in parts]))
        best, none = (-np.inf, PoseNoise()), -np.inf
        for rotation_deg in ROTATION_GRID_DEG:
            for position in POSITION_GRID:
                # Both cameras of a pair have the noise.
                motion = np.diag(np.repeat([2 * np.radians(rotation_deg) ** 2, 2 * position**2], 3))
                covariance = np.eye(6) + root @ motion @ root
                distance = (gradient * np.linalg.solve(covariance, gradient[..., None])[..., 0]).sum(axis=1)
                tails = (FREEDOM + 6) * np.log1p(distance / FREEDOM)
                likelihood = -0.5 * float((np.linalg.slogdet(covariance)[1] + tails).sum())
                if likelihood > best[0]:
                    best = likelihood, PoseNoise(float(rotation_deg), float(position))
                if rotation_deg == position == 0:
                    none = likelihood
        return best[1] if best[0] > none + MIN_GAIN else PoseNoise()

    def _motions(self, length: float) -> list[tuple[Floats, Floats]]:
        """Return information (6, 6) and gradient (6,) of the motion between the cameras of each pair that tells it."""
        all_errors, normals, first, second = self.planes()
        baselines = self._baselines[self._pair_of]
        cosine = (first * second).sum(axis=1)
        sine2 = np.maximum(1 - cosine**2, 1e-12)
        along = (first * baselines).sum(axis=1), (second * baselines).sum(axis=1)
        depth_i, depth_j = (cosine * along[1] - along[0]) / sine2, (along[1] - cosine * along[0]) / sine2
        far = np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), cosine)) <= MIN_PARALLAX_DEG
        # Of cameras with one center, as of a rig, noise alone makes points, within millimeters.
        near = ~far & (np.minimum(depth_i, depth_j) > NEAREST * length)
        ratio = np.where(near, depth_i / np.where(near, depth_j, 1.0), 1.0)
        nearness = np.where(near, length / np.where(near, depth_j, 1.0), 0.0)
        derivatives = np.column_stack([ratio[:, None] * np.cross(first, normals), normals * nearness[:, None]])
        parts = []
        for rows in self.rows():
            valid = (far | near)[rows]
            if valid.sum() < MIN_MATCHES:
                continue
            jacobian, errors = derivatives[rows][valid], all_errors[rows][valid]
            stated_scale, stated = scale, weighted = _robust(jacobian, errors)
            for _ in range(7):  # to the motion without which the errors are those of the matches alone
                motion = np.linalg.solve(weighted.T @ jacobian + 100 * np.eye(6), weighted.T @ errors)
                scale, weighted = _robust(jacobian, errors - jacobian @ motion)
            if stated_scale < SAME_SCALE * scale:  # the motion serves a minority, such as windows matched to others
                weighted = stated
            share = min(1.0, INDEPENDENT / len(errors))
            parts.append((share * weighted.T @ jacobian, share * weighted.T @ errors))
        return parts

    def check_intrinsics(self, cameras: Sequence[pycolmap.Camera]) -> str:
        """Say which one change of all intrinsics the matches ask for; empty if for none.

        Args:
            cameras: of the images of the map.
        """
        if len(self) < MIN_PAIRS:
            return ""
        stated = float(self.medians().mean())
        starts = [np.array([factor, 0, 0, 0]) for factor in SCAN]
        nearest = min(starts, key=lambda start: float(self.medians(start).mean()))
        corner = float(np.median([np.hypot(one.width, one.height) / 2 / one.mean_focal_length() for one in cameras]))
        fits = [self._fit([0], nearest, corner)]
        if stated > MIN_ANGLE:
            fits += [self._fit([1, 2], np.zeros(4), corner), self._fit([3], np.zeros(4), corner)]
        right = [
            fit
            for fit in fits
            if fit.size >= MIN_CHANGE
            and fit.by_chance < SIGNIFICANCE
            and fit.errors < stated * (MAX_REST_FOCAL if fit.change[0] else MAX_REST)
        ]
        return _text(min(right, key=lambda fit: fit.errors).change, cameras, corner) if right else ""

    def _fit(self, columns: list[int], start: Floats, corner: float) -> "_Fit":
        """Fit some of the changes by Gauss-Newton with Cauchy weights; each pair counts alike.

        The significance is from the scatter of the pairs' gradients, as errors within a pair are not independent, and
        those of pairs that share an image neither (Aronow, Samii and Assenova, Political Analysis 2015). `corner` is
        the distance of an image corner from the center, in focal lengths.
        """
        change = start.astype(np.float64)
        steps = STEP * np.eye(4)[columns]
        for _ in range(12):
            errors = self.planes(change)[0]
            scale = max(float(np.median([np.median(np.abs(errors[rows])) for rows in self.rows()])), MIN_ERROR / 2)
            moved = np.column_stack([self.planes(change + step)[0] - errors for step in steps]) / STEP
            weights = 1 / (1 + (errors / (2 * scale)) ** 2) / np.diff(self.starts)[self._pair_of]
            gradients = np.add.reduceat(weights[:, None] * moved * errors[:, None], self.starts[:-1])
            information = (weights[:, None] * moved).T @ moved
            step = -np.linalg.lstsq(information, gradients.sum(axis=0))[0]
            change[columns] += np.clip(step, -0.3, 0.3)
            change[0] = max(change[0], -0.9)
            if np.abs(step).max() < STEP:
                break
        inverse = np.linalg.pinv(information)
        size = float(np.linalg.norm(change * (1, 1, 1, corner**2)))
        beyond = change[columns] * max(0.0, 1 - IMITATED / max(size, IMITATED))
        products = [gradients.T @ gradients, gradients.T @ self._share_image @ gradients]
        freedom = max(self._images - len(columns) - 1, 1)
        by_chance = []
        for product in products:
            covariance = inverse @ product @ inverse * self._images / freedom
            squares = float(beyond @ np.linalg.pinv(covariance, hermitian=True) @ beyond)
            by_chance.append(float(fdtrc(len(columns), freedom, max(squares, 0.0) / len(columns))))
        return _Fit(change, size, max(by_chance), float(self.medians(change).mean()))


def _robust(jacobian: Floats, errors: Floats) -> tuple[float, Floats]:
    """Return the scale of errors (K,), and their derivatives (K, 6) times weights of Cauchy's distribution."""
    scale = max(1.48 * float(np.median(np.abs(errors))), MIN_ERROR)
    return scale, jacobian * (1 / (1 + (errors / (2 * scale)) ** 2) / scale**2)[:, None]


class _Fit(NamedTuple):
    """A change of intrinsics that minimizes the angles of all pairs."""

    change: Floats  # (4,), see `_changed`
    size: float  # of the change, in focal lengths; of a distortion at the corners of the images
    by_chance: float  # probability that noise alone asks for such a change
    errors: float  # mean over the pairs of their median angle, radians


def _changed(rays: Floats, change: Floats | None) -> Floats:
    """Return rays (K, 3) of cameras whose intrinsics change.

    Args:
        rays: with the given intrinsics.
        change: (4,) relative change of the focal length, shift of the principal point in focal lengths, and the
            coefficient of radial distortion; None: no change.
    """
    if change is None:
        return rays
    plane = rays[:, :2] / rays[:, 2:] - change[1:3]
    plane = plane / (1 + change[0]) * (1 - change[3] * (plane**2).sum(axis=1, keepdims=True))
    return geometry.unit(np.column_stack([plane, np.ones(len(plane))]))


def _text(change: Floats, cameras: Sequence[pycolmap.Camera], corner: float) -> str:
    """Return what changed intrinsics (4,) say of the given ones; `corner` is the distance of an image corner from the
    center, in focal lengths."""
    focals = np.unique(np.round([camera.mean_focal_length() for camera in cameras], 1))
    if change[0] and len(focals) == 1:
        fitted = focals[0] * (1 + change[0])
        return f"the focal length of the map's camera that fits is {fitted:.0f} px, given {focals[0]:g}"
    if change[0]:
        return f"the focal lengths of the map's cameras that fit are {1 + change[0]:.3f} times those given"
    if change[3]:
        moved = f"{100 * change[3] * corner**2:+.1f} %"
        return f"the radial distortion of the map's cameras that fits moves the corners by {moved} against the given"
    right, down = focals.mean() * change[1:3]
    return f"the principal point of the map's cameras that fits is {right:+.1f}, {down:+.1f} px from the given"


MIN_NOISE = PoseNoise(0.02, 0.001)  # one of the two may be zero


# Bundle adjustment


def refined_poses(
    local_map: LocalMap, keypoints: Sequence[NDArray[np.float32]], noise: PoseNoise, threads: int = -1
) -> Floats:
    """Return world_from_cams (N, 4, 4) that agree best with the observations of a map.

    COLMAP's bundle adjustment with position priors, and a similarity that puts the result where the given poses are.

    Args:
        local_map: triangulated with the given poses.
        keypoints: of each image, (n, 2), pixels.
        noise: of the given poses.
        threads: of the solver; -1: all.
    """
    origin = geometry.local_origin(local_map.world_from_cams[:, :3, 3])
    given = geometry.shifted(local_map.world_from_cams, -origin)
    position_std = PRIOR_NOISE * max(noise.position, MIN_NOISE.position) * local_map.length
    model = pycolmap.Reconstruction()
    seen = np.bincount(local_map.obs_image, minlength=len(given)) >= MIN_OBSERVATIONS
    config, priors = pycolmap.BundleAdjustmentConfig(), []
    for index in np.flatnonzero(seen).tolist():
        camera = pycolmap.Camera(local_map.cameras[index].todict() | {"camera_id": index + 1})
        model.add_camera_with_trivial_rig(camera)
        xy = keypoints[index].astype(np.float64)
        image = pycolmap.Image(name=f"{index}", camera_id=index + 1, image_id=index + 1, keypoints=xy)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(geometry.invert(given[index])[:3]))
        config.add_image(index + 1)
        config.set_constant_cam_intrinsics(index + 1)
        priors.append(
            pycolmap.PosePrior(
                pose_prior_id=index + 1,
                corr_data_id=model.image(index + 1).data_id,
                position=given[index, :3, 3],
                position_covariance=position_std**2 * np.eye(3),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    for point, xyz in enumerate(local_map.points - origin):
        track = pycolmap.Track()
        for observation in local_map.by_point[slice(*local_map.point_starts[point : point + 2])].tolist():
            if seen[local_map.obs_image[observation]]:
                image_id = int(local_map.obs_image[observation]) + 1
                track.add_element(image_id, int(local_map.obs_keypoint[observation]))
        if track.length() > 1:
            model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.num_threads = threads
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(
        options, pycolmap.PosePriorBundleAdjustmentOptions(), config, priors, model
    )
    poses, level = np.array(local_map.world_from_cams), pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value  # each step that it retries is a warning
    try:
        usable = adjuster.solve().is_solution_usable()
    finally:
        pycolmap.logging.minloglevel = level
    if usable:
        adjusted = np.flatnonzero(seen)
        cams_from_world = np.tile(np.eye(4), (len(adjusted), 1, 1))
        cams_from_world[:, :3] = [model.image(index + 1).cam_from_world().matrix() for index in adjusted.tolist()]
        refined = geometry.invert(cams_from_world)
        some = np.unique(np.linspace(0, len(adjusted) - 1, MAX_ALIGNED).astype(np.int64))
        alignment = align_to_map(
            refined[some],
            given[adjusted[some]],
            center_noise_m=np.sqrt(3) * max(noise.position, MIN_NOISE.position) * local_map.length,
            rotation_noise_deg=np.sqrt(3) * max(noise.rotation_deg, MIN_NOISE.rotation_deg),
        )
        poses[adjusted] = geometry.shifted(alignment.world_from_model.apply_to_pose(refined), origin)
    return poses
