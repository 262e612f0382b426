"""Check the poses of a map against its images, and measure the depth of the scene, with matches made without poses.

A sample of image pairs is matched and verified by the essential matrix alone. Correct poses put most of these matches
on their epipolar lines, in front of both cameras. If they do not, common mistakes are tried: inverted poses, other or
mirrored axes of the cameras or of the positions, another order of the quaternions.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import lru_cache
from itertools import permutations, product
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit import geometry
from toolkit.capture.images import default_workers, prefetch, rays_of
from toolkit.features.features import FeatureKind, LocalFeatures, MutualMatcher
from toolkit.features.matching import verified_matches
from toolkit.geometry import Floats, Ints
from toolkit.manifest import RerankSettings
from toolkit.mapping.local_map import OPENGL_AXES, Consistency, LocalMap
from toolkit.mapping.pose_noise import PosedPairs, VerifiedPair
from toolkit.threads import fixed_sums

ANCHORS = 12  # number of images, evenly spread over the map, that are matched with their neighbors
MAX_FEATURES = 1024  # number of features that are matched per image, the strongest ones
MIN_MATCHES = 24
"""Fewest verified matches of a pair that counts; few pairs of different places that look alike have as many."""
MIN_PAIRS = 5  # fewest verified pairs for a verdict on a map
MAX_ERROR_DEG = 1.0
"""Largest median angle between the rays of a pair's matches and their epipolar planes. Good poses have some hundredths
of a degree, poses in another convention tens of degrees."""
MIN_PARALLAX_DEG = 0.5  # least angle between two rays that tells whether their point is in front of the cameras
MAX_ROTATION_ERROR_DEG = 5.0
"""Largest median difference between the relative rotations of poses and matches under a convention that fits."""
INVERTED = "camera centers that were inverted with the rotations"
MAX_TRIED = 12  # number of pairs that conventions are tried with, those with the most matches
CLEAR = 0.75  # share of agreeing pairs from which no further convention is tried
COARSE_DEG = 3.0  # largest median error of correct but coarse poses
COARSE_ROTATION_DEG = 10.0  # largest median error of their relative rotations
NOISE = 20.0
"""Error of an image, in multiples of the median error, from which its pose is wrong; but at least 0.3 degrees."""
WEAK = 0.3  # images with less than this share of the median number of shared points are checked individually
MAX_WEAK = 8  # largest number of images that are checked individually, so that the effort does not grow with the map

NOMINAL_DEPTH = 10.0  # median depth to which a map with poses of unknown unit is scaled for the localizers
USUAL_DEPTHS_M = (2.0, 16.0)
"""Range of median depths for which the limits of the localizers, in meters, apply unchanged."""
ODD_DEPTHS_M = (0.1, 200.0)
"""Plausible range of a map's median depth, meters; outside, the map may be in another unit."""
WORTH_DEG, WORTH_LENGTHS = 0.05, 0.005
"""Noise of the map's poses, degrees and map lengths per axis, from which the user is told of it."""


class MapImages(NamedTuple):
    """The N images of a map."""

    names: Sequence[str]
    cameras: Sequence[pycolmap.Camera]
    world_from_rigs: Floats  # (N, 4, 4)
    rig_from_cams: Floats  # (N, 4, 4)
    instants: Ints  # (N,) number of the instant; images that a rig took at the same time share it
    sensors: Sequence[str]  # (N,) sensor ids

    @property
    def world_from_cams(self) -> Floats:
        return self.world_from_rigs @ self.rig_from_cams


class PoseConsistency:
    """Matches a sample of the map images without their poses, and compares the matches with the poses."""

    @fixed_sums
    def __init__(self, images: MapImages, load: Callable[[int], LocalFeatures], kind: FeatureKind):
        """
        Args:
            images: all images of the map.
            load: returns the features of an image, by index.
            kind: entry of the features in `KINDS`.
        """
        self.images = images
        self._matcher = MutualMatcher.of(kind)
        self._load = lru_cache(maxsize=64)(lambda index: load(index).take(slice(MAX_FEATURES)))
        self._verified = lru_cache(maxsize=None)(self._verify)
        self.sample = self.verify(_sampled_pairs(images))  # verified pairs all over the map

    def verify(self, pairs: Iterable[tuple[int, int]]) -> list[VerifiedPair]:
        """Return the covisible ones of pairs of images, by their matches alone."""
        ordered = dict.fromkeys((min(pair), max(pair)) for pair in pairs)
        verified = prefetch(lambda pair: self._verified(*pair), ordered, default_workers())
        return [pair for pair in verified if pair is not None]

    def _verify(self, i: int, j: int) -> VerifiedPair | None:
        a, b = self._load(i), self._load(j)
        (matches,) = self._matcher.match([(a, b)])
        cameras = self.images.cameras
        xy = a.keypoints[matches.indices[:, 0]], b.keypoints[matches.indices[:, 1]]
        kept, _, essential = verified_matches(cameras[i], xy[0], cameras[j], xy[1], matches.scores, RerankSettings())
        if len(kept) < MIN_MATCHES:
            return None
        rays = rays_of(cameras[i], xy[0][kept]), rays_of(cameras[j], xy[1][kept])
        plane_i, plane_j = (np.ascontiguousarray(r[:, :2] / r[:, 2:]) for r in rays)
        _, rotation, translation, _ = cv2.recoverPose(essential, plane_i, plane_j, np.eye(3))
        return VerifiedPair(i, j, *rays, geometry.make_pose(rotation, np.ravel(translation)))

    def typical_depth(self) -> float:
        """Return the median depth of matches triangulated with the poses, in their unit; NaN with too few matches."""
        poses = self.images.world_from_cams
        per_pair = [np.zeros(0)]
        for pair in self.sample:
            error_deg, depth_i, depth_j, parallax_deg = _compare(pair, _relative(poses, pair))
            good = (error_deg < MAX_ERROR_DEG) & (parallax_deg > 2 * MIN_PARALLAX_DEG) & (depth_i > 0) & (depth_j > 0)
            per_pair += [depth_i[good], depth_j[good]]
        depths = np.concatenate(per_pair)
        return float(np.median(depths)) if len(depths) >= MIN_MATCHES else float("nan")

    def length(self, metric: bool) -> float:
        """Return the length, in the unit of the poses, that localizers should treat as one meter.

        Args:
            metric: whether the unit is the meter; the length is then 1, except for very near or very far scenes.
        """
        depth = self.typical_depth()
        if metric:
            return 1.0 if np.isnan(depth) else float(depth / np.clip(depth, *USUAL_DEPTHS_M))
        if np.isnan(depth):  # assume that neighbors are a tenth of the depth apart
            centers = self.images.world_from_cams[:, :3, 3]
            depth = 10 * float(np.median(KDTree(centers).query(centers, k=2)[0][:, 1])) if len(centers) > 1 else 0.0
        return depth / NOMINAL_DEPTH or 1.0

    @fixed_sums
    def judge(self, local_map: LocalMap) -> Consistency:
        """Judge the poses of the map.

        Args:
            local_map: the map triangulated with the poses; it has the same images.
        """
        lengths = np.diff(local_map.point_starts)
        three = float((lengths >= 3).mean()) if len(lengths) else 0.0
        agree = _agreeing(self.images.world_from_cams, self.sample)
        result = Consistency(pairs=len(agree), agreeing=int(agree.sum()), seen_by_three=round(three, 4))
        if len(agree) < MIN_PAIRS:
            return result
        share = float(agree.mean())
        if share < CLEAR:
            fits = _fitting_convention(self.images, self.sample, share)
            # If no convention fits better, the poses may just be coarse.
            too_coarse = (
                np.median(self._errors_deg(self.sample)) > COARSE_DEG
                or np.median(self._rotation_errors_deg(self.sample)) > COARSE_ROTATION_DEG
            )
            if fits or (share < 0.5 and too_coarse):
                return replace(result, verdict="inconsistent", fits=fits)
        pairs = self.pairs
        noise = pairs.noise(local_map.length)
        return replace(
            result,
            verdict="consistent",
            wrong=self._wrong_images(local_map),
            camera=pairs.check_intrinsics(self.images.cameras),
            rotation_noise_deg=round(noise.rotation_deg, 4),
            position_noise=round(noise.position, 6),
            direction_noise_deg=round(noise.direction_deg(self.typical_depth() / local_map.length), 4),
        )

    @property
    def pairs(self) -> PosedPairs:
        """The sample with the poses of its images, for their noise and the intrinsics."""
        return PosedPairs(self.sample, self.images.world_from_cams)

    def with_poses(self, world_from_cams: Floats) -> "PoseConsistency":
        """Return this check by the same matches of other poses (N, 4, 4)."""
        other = copy(self)
        world_from_rigs = world_from_cams @ geometry.invert(self.images.rig_from_cams)
        other.images = self.images._replace(world_from_rigs=world_from_rigs)
        return other

    def _errors_deg(self, pairs: Sequence[VerifiedPair]) -> list[float]:
        """Return, per pair, the median angle between matches and their epipolar planes."""
        poses = self.images.world_from_cams
        return [float(np.median(_compare(pair, _relative(poses, pair))[0])) for pair in pairs]

    def _rotation_errors_deg(self, pairs: Sequence[VerifiedPair]) -> Floats:
        """Return, per pair, the angle between the relative rotations of the poses and of the matches."""
        poses = self.images.world_from_cams
        stated = np.array([_relative(poses, pair)[:3, :3] for pair in pairs])
        matched = np.array([pair.j_from_i[:3, :3] for pair in pairs])
        return geometry.rotation_angle_deg(np.swapaxes(stated, 1, 2) @ matched)

    def _wrong_images(self, local_map: LocalMap) -> list[str]:
        """Return the names of images with few points in the map whose matches contradict their poses."""
        poses = self.images.world_from_cams
        support = local_map.images_seeing(np.flatnonzero(np.diff(local_map.point_starts) >= 3))
        weak = np.flatnonzero(support < WEAK * np.median(support))
        suspects = weak[np.argsort(support[weak], kind="stable")][:MAX_WEAK].tolist()
        pairs = self.verify((index, other) for index in suspects for other in self._candidates(index))
        usual_deg = float(np.median(self._errors_deg(self.sample)))
        agree = _agreeing(poses, pairs, float(np.clip(NOISE * usual_deg, 0.3, MAX_ERROR_DEG)))
        # Pairs vote with their number of matches, as many matches between different places are improbable.
        votes = [(pair.i, pair.j, len(pair.rays_i), good) for pair, good in zip(pairs, agree, strict=True)]
        wrong: set[int] = set()
        # The worst image is taken first, and its pairs no longer count against the other images.
        while True:
            balance = {}
            for index in set(suspects) - wrong:
                own = [(count, good) for i, j, count, good in votes if index in (i, j) and not {i, j} & wrong]
                against = [count for count, good in own if not good]
                in_favor = sum(count for count, good in own if good)
                if len(against) >= 2 and sum(against) > max(4 * in_favor, 4 * MIN_MATCHES):
                    balance[index] = sum(against) - in_favor
            if not balance:
                return sorted(self.images.names[index] for index in wrong)
            wrong.add(max(balance, key=lambda index: (balance[index], -index)))

    def _candidates(self, index: int) -> list[int]:
        """Return images that may be covisible with one of doubtful pose: neighbors in time and space, and a sample."""
        n, instants = len(self.images.names), self.images.instants
        centers = self.images.world_from_cams[:, :3, 3]
        near = np.argsort(np.linalg.norm(centers - centers[index], axis=1), kind="stable")[:6]
        in_time = index + np.array([-3, -2, -1, 1, 2, 3])
        spread = np.linspace(0, n - 1, 8).astype(np.int64)
        images = dict.fromkeys(np.concatenate([in_time[(in_time >= 0) & (in_time < n)], near, spread]).tolist())
        return [other for other in images if instants[other] != instants[index]]


def _sampled_pairs(images: MapImages) -> list[tuple[int, int]]:
    """Return pairs all over a map that are probably covisible: images near each other, and successive images.

    Where poses are wrong, one of the two still works: a wrong convention keeps neighbors close, and the order of the
    images does not depend on poses.
    """
    n, pairs = len(images.names), list[tuple[int, int]]()
    centers, axes = images.world_from_cams[:, :3, 3], images.world_from_cams[:, :3, 2]
    tree = KDTree(centers)
    for i in np.unique(np.linspace(0, n - 1, ANCHORS).astype(np.int64)):
        other = images.instants != images.instants[i]
        same_sensor = other & (np.asarray(images.sensors) == images.sensors[i])
        following = np.flatnonzero((same_sensor if same_sensor.any() else other)[i:])[:2] + i
        _, near = tree.query(centers[i], k=min(n, 40))
        near = np.atleast_1d(near)[other[np.atleast_1d(near)]][:10]
        near = near[np.argsort(-(axes[near] @ axes[i]), kind="stable")[:2]]
        pairs += [(min(int(i), int(j)), max(int(i), int(j))) for j in [*following, *near]]
    return list(dict.fromkeys(pairs))


def _relative(world_from_cams: Floats, pair: VerifiedPair) -> Floats:
    """Return j_from_i (4, 4) from the poses."""
    return geometry.invert(world_from_cams[pair.j]) @ world_from_cams[pair.i]


def _compare(pair: VerifiedPair, j_from_i: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Compare K matches with a relative pose.

    Returns:
        Angles to the epipolar planes, depths along the rays of i and of j, and angles between the rays, each (K,), with
        angles in degrees. Without a baseline, the first are the angles between the rays.
    """
    a, b = pair.rays_i @ j_from_i[:3, :3].T, pair.rays_j
    baseline = j_from_i[:3, 3]
    length = float(np.linalg.norm(baseline))
    cosine = (a * b).sum(axis=1)
    parallax_deg = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), cosine))
    if length == 0:
        return parallax_deg, np.ones(len(a)), np.ones(len(a)), np.zeros(len(a))
    # Each ray has an angle to the plane of the baseline and the other ray; take the larger of the two.
    errors = [
        np.abs((geometry.unit(np.cross(baseline / length, one)) * other).sum(axis=1)) for one, other in ((a, b), (b, a))
    ]
    error_deg = np.degrees(np.arcsin(np.clip(np.max(errors, axis=0), 0, 1)))
    # The closest points of the two rays: baseline + depth_i a = depth_j b.
    sine2 = np.maximum(1 - cosine**2, 1e-18)
    along_a, along_b = a @ baseline, b @ baseline
    return error_deg, (cosine * along_b - along_a) / sine2, (along_b - cosine * along_a) / sine2, parallax_deg


def _agreeing(
    world_from_cams: Floats, pairs: Sequence[VerifiedPair], max_error_deg: float = MAX_ERROR_DEG
) -> NDArray[np.bool_]:
    """Tell for each pair whether the poses put most of its matches on epipolar lines, in front of both cameras."""
    agree = np.zeros(len(pairs), bool)
    for index, pair in enumerate(pairs):
        error_deg, depth_i, depth_j, parallax_deg = _compare(pair, _relative(world_from_cams, pair))
        telling = parallax_deg > MIN_PARALLAX_DEG
        behind = telling & ((depth_i <= 0) | (depth_j <= 0))
        agree[index] = np.median(error_deg) < max_error_deg and 2 * behind.sum() <= telling.sum()
    return agree


def _fitting_convention(images: MapImages, pairs: Sequence[VerifiedPair], share_given: float) -> str:
    """Describe the simplest convention under which most pairs agree with the poses; return "" if there is none.

    The share of agreeing pairs must clearly exceed `share_given`, that of the poses as they are.
    """
    pairs = sorted(pairs, key=lambda pair: -len(pair.rays_i))[:MAX_TRIED]  # a few pairs are enough
    used, ends = np.unique([(pair.i, pair.j) for pair in pairs], return_inverse=True)
    ends = ends.reshape(-1, 2)
    pairs = [pair._replace(i=i, j=j) for pair, (i, j) in zip(pairs, ends.tolist(), strict=True)]
    matched = np.stack([pair.j_from_i[:3, :3] for pair in pairs])
    conventions = _conventions(images.world_from_rigs[used], images.rig_from_cams[used], ends, matched)
    best = (max(0.5, share_given + 0.25), "")
    for _, text, world_from_cams in sorted(conventions, key=lambda convention: convention[0]):
        share = float(_agreeing(world_from_cams, pairs).mean())
        if share > best[0]:
            best = share, text
        if share >= CLEAR and best[1]:
            break
    return best[1]


def _conventions(
    world_from_rigs: Floats, rig_from_cams: Floats, pairs: Ints, matched: Floats
) -> Iterator[tuple[float, str, Floats]]:
    """Yield the conventions under which the relative rotations of pairs (P, 2) agree with those of their matches.

    Each has the number of its differences from the expected one, their description, and world_from_cams (N, 4, 4).

    Args:
        world_from_rigs, rig_from_cams: as given, (N, 4, 4).
        matched: j_from_i of the pairs, (P, 3, 3).
    """
    (i, j), stated, positions = pairs.T, world_from_rigs[:, :3, :3], world_from_rigs[:, :3, 3]
    reordered = geometry.quaternion_to_rotation(np.roll(geometry.rotation_to_quaternion(stated), 1, axis=-1))
    all_rigs = [("", rig_from_cams)]
    if not np.allclose(rig_from_cams, np.eye(4)):
        all_rigs.append(("rigs as sensor_from_rig", geometry.invert(rig_from_cams)))
    signs = [np.diag(signs) for signs in product((1, -1), repeat=3)]
    signed_axes = [sign @ np.eye(3)[list(order)] for order in permutations(range(3)) for sign in signs]
    for order, inverse, X, (rigs_text, rigs) in product((0, 1), (0, 1), signed_axes, all_rigs):
        if np.linalg.det(X) < 0:
            continue
        R = (stated, reordered)[order]
        R = np.swapaxes(R, 1, 2) if inverse else R
        world_from_cams = R @ X @ rigs[:, :3, :3]
        j_from_i = np.swapaxes(world_from_cams[j], 1, 2) @ world_from_cams[i]
        if np.median(geometry.rotation_angle_deg(np.swapaxes(j_from_i, 1, 2) @ matched)) > MAX_ROTATION_ERROR_DEG:
            continue
        # The stated position is the camera center, the translation of cam_from_world, or a center that was turned as
        # if it were one.
        turned = np.swapaxes(R, 1, 2)
        places = (positions, -(R @ positions[..., None])[..., 0], -(turned @ positions[..., None])[..., 0])
        for translations, A in product((0, 1) if inverse else (0, 1, 2), signed_axes):
            centers = places[translations]
            # Mirroring world and cameras along one axis gives rotations about other axes, and negated positions.
            mirrored = np.trace(X) == -1 and np.array_equal(X, np.diag(np.diag(X))) and np.array_equal(A, -np.eye(3))
            moved = not mirrored and not np.array_equal(A, np.eye(3))
            direction = (("", "translations", INVERTED), ("rotations", "poses"))[inverse][translations]
            texts = [
                f"{direction} of cam_from_world" if direction else "",
                rigs_text,
                "quaternions in the order x, y, z, w" if order else "",
                "a mirrored world" if mirrored else _axes_text(X),
                f"{'mirrored' if np.linalg.det(A) < 0 else 'other'} axes of the places ({_axes(A.T)})" if moved else "",
            ]
            texts = [text for text in texts if text]
            mistakes = len(texts) + 0.5 * (order + moved + (inverse != translations))
            yield mistakes, ", ".join(texts), geometry.make_pose(R @ X, centers @ A.T) @ rigs


def _axes_text(axes: Floats) -> str:
    """Describe the camera axes that the columns of a rotation give."""
    if np.array_equal(axes, np.eye(3)):
        return ""
    if np.array_equal(axes, np.diag([1, -1, -1])):
        return OPENGL_AXES
    if axes[2, 2] == 1:
        return f"images turned by {round(float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))))} degrees"
    return f"other camera axes (x right, y down, z forward are {_axes(axes)})"


def _axes(axes: Floats) -> str:
    """Name the signed axes in the columns of a matrix, such as "x, -y, -z"."""
    return ", ".join(f"{'-' if column.sum() < 0 else ''}{'xyz'[int(np.argmax(np.abs(column)))]}" for column in axes.T)


# What the user is told


def remarks(consistency: Consistency, length: float, metric: bool) -> str:
    """Return warnings about the poses of a map; empty if there are none.

    Args:
        consistency: of the map.
        length: that of the map, see `PoseConsistency.length`.
        metric: whether the poses are in meters, as far as is known.
    """
    parts = [consistency.text, _noise_text(consistency, length, metric)]
    depth = length * USUAL_DEPTHS_M[int(length > 1)]
    measured = metric and length != 1 and consistency.verdict != "inconsistent"
    if measured and not ODD_DEPTHS_M[0] < depth < ODD_DEPTHS_M[1]:
        parts.append(
            f"the median depth of the map is {depth:.3g} m: if its poses are not in meters, write `unit: null` in "
            "the manifest, or import them with their `--unit`"
        )
    return "; ".join(filter(None, parts))


def _noise_text(noise: Consistency, length: float, metric: bool) -> str:
    """Return how good the poses are, if their noise is worth a word."""
    small = noise.rotation_noise_deg < WORTH_DEG and noise.position_noise < WORTH_LENGTHS
    if small or not noise.trusted:  # wrong intrinsics look like noise of the poses
        return ""
    unit, factor = ("cm", length) if metric else ("% of the median depth", 1 / NOMINAL_DEPTH)
    rotation_deg, position = np.sqrt(3) * noise.rotation_noise_deg, np.sqrt(3) * noise.position_noise * factor
    return f"the poses of the map are good to about {rotation_deg:.2g} deg, {100 * position:.2g} {unit}"
