"""Whether the poses of a map are those of its images, and how far away the scene is: from matches made without poses.

A sample of image pairs is matched and verified by the essential matrix alone. Poses that are right put most of these
matches on their epipolar lines, in front of both cameras. Where they do not, the usual mistakes are tried: another
direction of the poses, other axes of the cameras or of the positions, mirrored ones, another order of the quaternions.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import permutations, product
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit import geometry
from toolkit.capture.cameras import rays_of
from toolkit.features.features import LocalFeatures
from toolkit.features.matching import MutualMatcher
from toolkit.features.verification import verified_matches
from toolkit.geometry import Floats, Ints
from toolkit.localizers.local_map import OPENGL_AXES, Consistency, LocalMap
from toolkit.manifest import RerankSettings

ANCHORS = 12
"""Images whose neighbors are matched, evenly spread over the map."""
MAX_FEATURES = 1024
"""Features of an image that are matched, the strongest."""
LEAST_MATCHES = 24
"""Verified matches of a pair that tells something: few wrong pairs of look-alikes have as many."""
LEAST_PAIRS = 5
"""Pairs that tell something of a whole map, at least."""
MAX_ERROR_DEG = 1.0
"""Largest angle, in the median, between the rays of a pair's matches and the planes in which the poses put them. Good
poses have some hundredths; another convention has tens."""
LEAST_PARALLAX_DEG = 0.5
"""Rays that are more parallel do not tell whether their point is in front of the cameras."""
MAX_ROTATION_ERROR_DEG = 5.0
"""Largest difference, in the median, of relative rotations from those of the matches, under a convention that fits."""
MOST_TRIED = 12
"""Pairs, those with the most matches, that conventions are tried with."""
CLEAR = 0.75
"""With as many of them that agree, no further convention is tried."""
COARSE_DEG = 3.0
"""Poses that are right, but coarse, have smaller errors."""
NOISE = 20.0
"""An image's poses are wrong from so many times the usual error on, but not below 0.3 degrees."""
WEAK = 0.3
"""Images with less than this share of the median image's support in the map are looked at one by one ..."""
MOST_WEAK = 8
"""... at most so many, the weakest: what a survey takes does not grow with the map."""


NOMINAL_DEPTH = 10.0
"""What the median depth of a map is to localizers where the unit of its poses is not known."""
USUAL_DEPTHS_M = (2.0, 16.0)
"""Limits of the median depth between which the limits of localizers, in meters, hold as they are."""


class SurveyedImages(NamedTuple):
    """The N images of a map."""

    names: Sequence[str]
    cameras: Sequence[pycolmap.Camera]
    world_from_rigs: Floats
    """(N, 4, 4)."""
    rig_from_cams: Floats
    """(N, 4, 4)."""
    instants: Ints
    """(N,) images that one rig took at one instant have the same number."""
    sensors: Sequence[str]
    """(N,)."""

    @property
    def world_from_cams(self) -> Floats:
        return self.world_from_rigs @ self.rig_from_cams


class VerifiedPair(NamedTuple):
    """Two images with the matches that one essential matrix explains."""

    i: int
    j: int
    rays_i: Floats
    """(K, 3) unit rays in the camera's frame."""
    rays_j: Floats
    j_from_i: Floats
    """(4, 4) the relative pose that the matches alone give; the translation has length 1."""


class Survey:
    """Matches a sample of a map's images without their poses, and compares."""

    def __init__(
        self, images: SurveyedImages, load: Callable[[int], LocalFeatures], min_score: float, ratio: float = 0.8
    ):
        """
        Args:
            images: all of the map.
            load: returns the features of one, by index.
            min_score, ratio: of matches of their descriptors.
        """
        self.images = images
        self._matcher = MutualMatcher(ratio, min_score)
        self._load = lru_cache(maxsize=64)(lambda index: load(index).take(slice(MAX_FEATURES)))
        self._verified = lru_cache(maxsize=None)(self._verify)
        self.sample = self.verify(_sampled_pairs(images))
        """Pairs all over the map."""

    def verify(self, pairs: Iterable[tuple[int, int]]) -> list[VerifiedPair]:
        """Return those of some pairs of images that show the same, by their matches alone."""
        found = (self._verified(min(pair), max(pair)) for pair in dict.fromkeys(pairs))
        return [pair for pair in found if pair is not None]

    def _verify(self, i: int, j: int) -> VerifiedPair | None:
        a, b = self._load(i), self._load(j)
        (matches,) = self._matcher.match([(a, b)])
        cameras = self.images.cameras
        xy = a.keypoints[matches.indices[:, 0]], b.keypoints[matches.indices[:, 1]]
        kept, _, essential = verified_matches(cameras[i], xy[0], cameras[j], xy[1], matches.scores, RerankSettings())
        if len(kept) < LEAST_MATCHES:
            return None
        rays = rays_of(cameras[i], xy[0][kept]), rays_of(cameras[j], xy[1][kept])
        plane_i, plane_j = (np.ascontiguousarray(r[:, :2] / r[:, 2:]) for r in rays)
        _, rotation, translation, _ = cv2.recoverPose(essential, plane_i, plane_j, np.eye(3))
        return VerifiedPair(i, j, *rays, geometry.make_pose(rotation, np.ravel(translation)))

    def typical_depth(self) -> float:
        """Return the median depth of what the sample shows, by the poses, in their unit; NaN where there is none."""
        poses = self.images.world_from_cams
        depths = [np.zeros(0)]
        for pair in self.sample:
            error_deg, depth_i, depth_j, parallax_deg = _compare(pair, _relative(poses, pair))
            good = (error_deg < MAX_ERROR_DEG) & (parallax_deg > 2 * LEAST_PARALLAX_DEG) & (depth_i > 0) & (depth_j > 0)
            depths += [depth_i[good], depth_j[good]]
        every = np.concatenate(depths)
        return float(np.median(every)) if len(every) >= LEAST_MATCHES else float("nan")

    def length(self, metric: bool) -> float:
        """Return what localizers should take as a meter, in the unit of the poses.

        Args:
            metric: the unit is the meter; then it is 1 but for scenes that are very near or very far.
        """
        depth = self.typical_depth()
        if metric:
            return 1.0 if np.isnan(depth) else float(depth / np.clip(depth, *USUAL_DEPTHS_M))
        if np.isnan(depth):  # as if neighbors stood a tenth of the depth apart
            centers = self.images.world_from_cams[:, :3, 3]
            depth = 10 * float(np.median(KDTree(centers).query(centers, k=2)[0][:, 1])) if len(centers) > 1 else 0.0
        return depth / NOMINAL_DEPTH or 1.0

    def consistency(self, local_map: LocalMap) -> Consistency:
        """Judge the poses.

        Args:
            local_map: what was triangulated with them; its images are those of the survey.
        """
        lengths = np.diff(local_map.point_starts)
        three = float((lengths >= 3).mean()) if len(lengths) else 0.0
        agree = _agreeing(self.images.world_from_cams, self.sample)
        known = Consistency(pairs=len(agree), agreeing=int(agree.sum()), seen_by_three=round(three, 4))
        if len(agree) < LEAST_PAIRS:
            return known
        share = float(agree.mean())
        if share < CLEAR:
            fits = _fitting_convention(self.images, self.sample, share)
            # Without another convention that is better, the poses may just be coarse.
            if fits or (share < 0.5 and np.median(self._errors_deg(self.sample)) > COARSE_DEG):
                return replace(known, verdict="inconsistent", fits=fits)
        return replace(known, verdict="consistent", wrong=self._wrong_images(local_map))

    def _errors_deg(self, pairs: Sequence[VerifiedPair]) -> list[float]:
        """Return the median angle of each pair's matches to their epipolar planes."""
        poses = self.images.world_from_cams
        return [float(np.median(_compare(pair, _relative(poses, pair))[0])) for pair in pairs]

    def _wrong_images(self, local_map: LocalMap) -> list[str]:
        """Return the images that have hardly a part in the map, and whose matches contradict their poses."""
        poses = self.images.world_from_cams
        support = local_map.images_seeing(np.flatnonzero(np.diff(local_map.point_starts) >= 3))
        weak = np.flatnonzero(support < WEAK * np.median(support))
        suspects = weak[np.argsort(support[weak], kind="stable")][:MOST_WEAK].tolist()
        pairs = self.verify((index, other) for index in suspects for other in self._likely(index))
        usual = float(np.median(self._errors_deg(self.sample)))
        agree = _agreeing(poses, pairs, float(np.clip(NOISE * usual, 0.3, MAX_ERROR_DEG)))
        # With many matches of a pair, look-alikes are improbable.
        votes = [(pair.i, pair.j, len(pair.rays_i), good) for pair, good in zip(pairs, agree, strict=True)]
        wrong: set[int] = set()
        # The worst first: that an image contradicts it is no sign against that image.
        while True:
            balance = {}
            for index in set(suspects) - wrong:
                of = [(count, good) for i, j, count, good in votes if index in (i, j) and not {i, j} & wrong]
                against = [count for count, good in of if not good]
                in_favor = sum(count for count, good in of if good)
                if len(against) >= 2 and sum(against) > max(4 * in_favor, 4 * LEAST_MATCHES):
                    balance[index] = sum(against) - in_favor
            if not balance:
                return sorted(self.images.names[index] for index in wrong)
            wrong.add(max(balance, key=lambda index: (balance[index], -index)))

    def _likely(self, index: int) -> list[int]:
        """Return images that may show the same as one whose pose is in doubt: those before and after it, near it, and
        some of all."""
        n, instants = len(self.images.names), self.images.instants
        centers = self.images.world_from_cams[:, :3, 3]
        near = np.argsort(np.linalg.norm(centers - centers[index], axis=1), kind="stable")[:6]
        about = index + np.array([-3, -2, -1, 1, 2, 3])
        spread = np.linspace(0, n - 1, 8).astype(np.int64)
        every = dict.fromkeys(np.concatenate([about[(about >= 0) & (about < n)], near, spread]).tolist())
        return [other for other in every if instants[other] != instants[index]]


def _sampled_pairs(images: SurveyedImages) -> list[tuple[int, int]]:
    """Return pairs all over a map that are likely to show the same: of images near each other, and of successive ones.

    Poses that are wrong as a whole leave next to each other what is so, or the order of the images does.
    """
    n, pairs = len(images.names), list[tuple[int, int]]()
    centers, axes = images.world_from_cams[:, :3, 3], images.world_from_cams[:, :3, 2]
    tree = KDTree(centers)
    for i in np.unique(np.linspace(0, n - 1, ANCHORS).astype(np.int64)):
        other = images.instants != images.instants[i]
        same = other & (np.asarray(images.sensors) == images.sensors[i])
        following = np.flatnonzero((same if same.any() else other)[i:])[:2] + i
        _, near = tree.query(centers[i], k=min(n, 40))
        near = np.atleast_1d(near)[other[np.atleast_1d(near)]][:10]
        near = near[np.argsort(-(axes[near] @ axes[i]), kind="stable")[:2]]
        pairs += [(min(int(i), int(j)), max(int(i), int(j))) for j in [*following, *near]]
    return list(dict.fromkeys(pairs))


def _relative(world_from_cams: Floats, pair: VerifiedPair) -> Floats:
    """Return j_from_i (4, 4) by the poses."""
    return geometry.invert(world_from_cams[pair.j]) @ world_from_cams[pair.i]


def _compare(pair: VerifiedPair, j_from_i: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return of K matches the angle to their epipolar planes, their depths along both rays, the angle between the rays.

    Angles are in degrees. Where both cameras share one place, the first is the angle between the rays.
    """
    a, b = pair.rays_i @ j_from_i[:3, :3].T, pair.rays_j
    baseline = j_from_i[:3, 3]
    length = float(np.linalg.norm(baseline))
    cosine = (a * b).sum(axis=1)
    parallax_deg = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), cosine))
    if length == 0:
        return parallax_deg, np.ones(len(a)), np.ones(len(a)), np.zeros(len(a))
    # The larger of the two angles between a ray and the plane of the baseline and the other.
    errors = [
        np.abs((geometry.unit(np.cross(baseline / length, one)) * other).sum(axis=1)) for one, other in ((a, b), (b, a))
    ]
    error_deg = np.degrees(np.arcsin(np.clip(np.max(errors, axis=0), 0, 1)))
    # The places nearest to each other of the two rays: baseline + depth_i a = depth_j b.
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
        telling = parallax_deg > LEAST_PARALLAX_DEG
        behind = telling & ((depth_i <= 0) | (depth_j <= 0))
        agree[index] = np.median(error_deg) < max_error_deg and 2 * behind.sum() <= telling.sum()
    return agree


# The conventions that poses come in


class _Convention(NamedTuple):
    """A way in which a file of poses may be meant."""

    mistakes: float
    """How much is otherwise than it should be."""
    text: str
    poses: Callable[[], Floats]
    """Returns world_from_cams (N, 4, 4) as they would be."""


def _fitting_convention(images: SurveyedImages, pairs: Sequence[VerifiedPair], share_given: float) -> str:
    """Return in words the simplest convention under which most pairs agree with the poses, and clearly more than the
    share that does as they are given; empty if there is none."""
    # A few pairs tell conventions apart.
    pairs = sorted(pairs, key=lambda pair: -len(pair.rays_i))[:MOST_TRIED]
    best = (max(0.5, share_given + 0.25), "")
    for convention in sorted(_conventions(images, pairs), key=lambda each: each.mistakes):
        share = float(_agreeing(convention.poses(), pairs).mean())
        if share > best[0]:
            best = share, convention.text
        if share >= CLEAR and best[1]:
            break
    return best[1]


def _conventions(images: SurveyedImages, pairs: Sequence[VerifiedPair]) -> Iterator[_Convention]:
    """Yield the conventions under which the cameras turn from image to image as the matches of pairs say."""
    i, j = (np.array(ends) for ends in zip(*((pair.i, pair.j) for pair in pairs), strict=True))
    seen = np.stack([pair.j_from_i[:3, :3] for pair in pairs])
    given, places = images.world_from_rigs[:, :3, :3], images.world_from_rigs[:, :3, 3]
    reordered = geometry.quaternion_to_rotation(np.roll(geometry.rotation_to_quaternion(given), 1, axis=-1))
    rigs = [("", images.rig_from_cams)]
    if not np.allclose(images.rig_from_cams, np.eye(4)):
        rigs.append(("rigs as sensor_from_rig", geometry.invert(images.rig_from_cams)))
    every = [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
    ]
    for order, inverse, X, (rigs_text, rig_from_cams) in product((0, 1), (0, 1), every, rigs):
        if np.linalg.det(X) < 0:
            continue
        R = (given, reordered)[order]
        R = np.swapaxes(R, 1, 2) if inverse else R
        in_world = R @ X @ rig_from_cams[:, :3, :3]
        turned = np.swapaxes(in_world[j], 1, 2) @ in_world[i]
        if np.median(geometry.rotation_angle_deg(np.swapaxes(turned, 1, 2) @ seen)) > MAX_ROTATION_ERROR_DEG:
            continue
        # What is written as the place: that of the camera, or the translation of cam_from_world.
        for translations, A in product((0, 1), every):
            centers = -(R @ places[..., None])[..., 0] if translations else places
            direction = ["", "translations", "rotations", "poses"][2 * inverse + translations]
            texts = [f"{direction} of cam_from_world" if direction else "", rigs_text]
            texts.append("quaternions in the order x, y, z, w" if order else "")
            # Mirroring world and cameras along one axis leaves rotations, about other axes, and opposite places.
            mirrored = np.trace(X) == -1 and np.array_equal(X, np.diag(np.diag(X))) and np.array_equal(A, -np.eye(3))
            texts.append("a mirrored world" if mirrored else _axes_text(X))
            flipped = "mirrored" if np.linalg.det(A) < 0 else "other"
            same = mirrored or np.array_equal(A, np.eye(3))
            texts.append("" if same else f"{flipped} axes of the places ({_axes(A.T)})")
            texts = [text for text in texts if text]
            yield _Convention(
                len(texts) + 0.5 * order + 0.5 * (not same) + 0.5 * (direction in ("translations", "rotations")),
                ", ".join(texts),
                partial(_as_meant, R @ X, centers @ A.T, rig_from_cams),
            )


def _as_meant(rotations: Floats, centers: Floats, rig_from_cams: Floats) -> Floats:
    """Return world_from_cams (N, 4, 4)."""
    return geometry.make_pose(rotations, centers) @ rig_from_cams


def _axes_text(axes: Floats) -> str:
    """Return in words what the columns of a rotation make of a camera's axes."""
    if np.array_equal(axes, np.eye(3)):
        return ""
    if np.array_equal(axes, np.diag([1, -1, -1])):
        return OPENGL_AXES
    if axes[2, 2] == 1:
        return f"images turned by {round(float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))))} degrees"
    return f"other camera axes (x right, y down, z forward are {_axes(axes)})"


def _axes(axes: Floats) -> str:
    """Return the signed axes that the columns of a matrix are."""
    return ", ".join(f"{'-' if column.sum() < 0 else ''}{'xyz'[int(np.argmax(np.abs(column)))]}" for column in axes.T)
