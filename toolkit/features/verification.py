"""Geometric verification: count the matches of two images that agree with one relative pose of their cameras."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.special import gammaln

from toolkit.features.features import LocalFeatures
from toolkit.features.matching import Matcher
from toolkit.geometry import Floats, Ints
from toolkit.manifest import RerankSettings
from toolkit.threads import fixed_sums

MAP_IMAGES_KEPT = 256  # number of map images whose features stay in memory, about 60 MB
MAX_ERROR_DEG = 0.2  # largest Sampson error of a match that agrees, as an angle seen from the camera, degrees
MAX_ERROR_SHARE = 0.003  # the same without intrinsics, in multiples of the longer side of the image
MAX_TRIALS = 500  # largest number of RANSAC samples, of five matches each; the best matches are sampled first


class Verifier:
    """Counts the matches of a query image and map images that agree with one relative pose.

    Safe to use from several threads. The features of the most recently used map images stay in memory.
    """

    def __init__(self, settings: RerankSettings, matcher: Matcher, store: Mapping[str, LocalFeatures]):
        self.settings = settings
        self.matcher = matcher
        self.store = store
        self._map_features = lru_cache(MAP_IMAGES_KEPT)(lambda name: self._strongest(store[name]))

    @fixed_sums
    def verify(
        self,
        features: LocalFeatures,
        camera: pycolmap.Camera,
        references: Sequence[str],
        cameras: Sequence[pycolmap.Camera],
    ) -> tuple[list[int], list[int]]:
        """Return the numbers of verified and of all matches of a query image with map images, given by name; 0 without
        features.
        """
        features, counts = self._strongest(features), np.zeros((2, len(references)), np.int64)
        readable = [index for index, name in enumerate(references) if name in self.store]
        map_features = [self._map_features(references[index]) for index in readable]
        all_matches = self.matcher.match([(features, reference) for reference in map_features])
        for matches, reference, index in zip(all_matches, map_features, readable, strict=True):
            pixels, in_map = features.keypoints[matches.indices[:, 0]], reference.keypoints[matches.indices[:, 1]]
            pair = camera, pixels, cameras[index], in_map, matches.scores
            counts[:, index] = verified_matches(*pair, self.settings, tests=len(readable)).distinct, len(matches)
        verified, matched = counts.tolist()
        return verified, matched

    def _strongest(self, features: LocalFeatures) -> LocalFeatures:
        return features.take(slice(self.settings.max_features))


class Verified(NamedTuple):
    """The matches that agree with one essential matrix."""

    agree: Ints  # (A,) indices of these matches
    distinct: int  # their number; those that share a keypoint count once
    essential: Floats  # (3, 3) the essential matrix


@fixed_sums
def verified_matches(
    camera_a: pycolmap.Camera,
    pixels_a: NDArray[np.floating],
    camera_b: pycolmap.Camera,
    pixels_b: NDArray[np.floating],
    scores: NDArray[np.floating],
    settings: RerankSettings,
    tests: int = 1,
) -> Verified:
    """Return the matches that agree with one essential matrix; none if random matches could give as many.

    The essential matrix is estimated from five matches (D. Nister, "An Efficient Solution to the Five-Point Relative
    Pose Problem", PAMI 2004), sampled by score (O. Chum, J. Matas, "Matching with PROSAC", CVPR 2005).

    Args:
        camera_a, camera_b: intrinsics, with distortion.
        pixels_a, pixels_b: (K, 2) matched pixels.
        scores: (K,) scores of the matches, larger is better.
        settings: threshold and limits.
        tests: number of image pairs that are tested together; with more tests, more matches can agree by chance.
    """
    nothing = Verified(np.zeros(0, np.int64), 0, np.zeros((3, 3)))
    if len(scores) < 6:  # five matches always agree
        return nothing
    order = np.argsort(-scores, kind="stable")
    pixels_a, pixels_b = (np.asarray(pixels, np.float64)[order] for pixels in (pixels_a, pixels_b))
    rays_a, rays_b = np.asarray(camera_a.cam_from_img(pixels_a)), np.asarray(camera_b.cam_from_img(pixels_b))
    # Far from the image center, some distortion models cannot be inverted.
    finite = np.isfinite(rays_a).all(axis=1) & np.isfinite(rays_b).all(axis=1)
    if finite.sum() < 6:
        return nothing
    options = _prosac(float(np.tan(np.radians(MAX_ERROR_DEG))), settings.seed)
    pinhole = np.eye(3), np.eye(3), np.zeros(5), np.zeros(5)  # the rays are calibrated already
    essential, mask = cv2.findEssentialMat(rays_a[finite], rays_b[finite], *pinhole, options)
    agree = np.flatnonzero(finite)[:0] if mask is None else np.flatnonzero(finite)[np.ravel(mask) > 0]
    distinct = min(len(np.unique(pixels[agree], axis=0)) for pixels in (pixels_a, pixels_b))
    chance = max(_chance(camera, options.threshold) for camera in (camera_a, camera_b))
    if not is_meaningful(distinct, len(scores), chance, tests):
        return nothing
    return Verified(order[agree], distinct, np.asarray(essential[:3], np.float64))


@fixed_sums
def epipolar_matches(
    size_a: tuple[int, int], pixels_a: Floats, size_b: tuple[int, int], pixels_b: Floats,
    scores: NDArray[np.floating], seed: int = 0, tests: int = 1,
) -> Ints:  # fmt: skip
    """Return the indices of matches that agree with one fundamental matrix, as `verified_matches` without intrinsics.

    It is as good as COLMAP's estimate of three models, and takes a hundredth of its time (STRECHA).

    Args:
        size_a, size_b: width and height of the images, pixels.
        pixels_a, pixels_b, scores, tests: see `verified_matches`.
        seed: of the samples.
    """
    if len(scores) < 8:
        return np.zeros(0, np.int64)
    order = np.argsort(-scores, kind="stable")
    pixels_a, pixels_b = (np.asarray(pixels, np.float64)[order] for pixels in (pixels_a, pixels_b))
    # One threshold is for both images, so the second one is scaled to the size of the first.
    scale = max(size_a) / max(size_b)
    threshold_px = MAX_ERROR_SHARE * max(size_a)
    _, mask = cv2.findFundamentalMat(pixels_a, scale * pixels_b, _prosac(threshold_px, seed))
    agree = np.zeros(0, np.int64) if mask is None else np.flatnonzero(np.ravel(mask))
    distinct = min(len(np.unique(pixels[agree], axis=0)) for pixels in (pixels_a, pixels_b))
    chance = max(2 * np.sqrt(2) * MAX_ERROR_SHARE * max(size) * np.hypot(*size) / (size[0] * size[1])
                 for size in (size_a, size_b))  # fmt: skip
    return order[agree] if is_meaningful(distinct, len(scores), chance, tests) else np.zeros(0, np.int64)


def _prosac(threshold: float, seed: int) -> cv2.UsacParams:
    """Return parameters of RANSAC for matches in the order of their scores."""
    options = cv2.UsacParams()
    options.sampler = cv2.SAMPLING_PROSAC
    options.score = cv2.SCORE_METHOD_MSAC
    options.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    options.loIterations, options.loSampleSize = 5, 20
    options.confidence = 0.999
    options.maxIterations = MAX_TRIALS
    options.randomGeneratorState = seed
    options.isParallel = False
    options.threshold = threshold
    return options


def is_meaningful(agree: int, matches: int, chance: float, tests: int = 1) -> bool:
    """Tell whether fewer than one such set of agreeing matches is expected among random matches.

    The expected number follows L. Moisan, B. Stival, "A Probabilistic Criterion to Detect Rigid Point Matches Between
    Two Images and Estimate the Fundamental Matrix", IJCV 2004, for a model of five matches and a fixed threshold.

    Args:
        agree: number of matches that agree with a model.
        matches: number of all matches.
        chance: probability that a random match agrees with a model.
        tests: number of sets of matches that are tested.
    """
    if agree <= 5:
        return False

    def log_choose(n: int, k: int) -> float:
        return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))

    models = 10  # largest number of essential matrices that fit five matches
    ways = np.log(models * (matches - 5)) + log_choose(matches, agree) + log_choose(agree, 5)
    return bool(np.log(tests) + ways + (agree - 5) * np.log(min(chance, 1.0)) < 0)


def _chance(camera: pycolmap.Camera, threshold: float) -> float:
    """Return the largest share of an image that lies within the threshold of a line through it."""
    # Sampson's error is shared by both images, so the distance in one of them can be sqrt(2) times larger.
    band_px = 2 * np.sqrt(2) * threshold * camera.mean_focal_length()
    return float(band_px * np.hypot(camera.width, camera.height) / (camera.width * camera.height))
