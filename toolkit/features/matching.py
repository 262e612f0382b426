"""Match local features between images: mutual nearest neighbors, networks, and along epipolar lines.

Matches of two sessions are kept in one HDF5 file, in the layout of hloc
(https://github.com/cvg/Hierarchical-Localization): a group a pair of images, `<image>/<image>` with `/` in the names
replaced by `-` (see `group_names` for names that this makes the same), with `matches0` (N,), for each feature of the
first image that of the second or -1, and `matching_scores0` (N,).
"""

import threading
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.errors import ArtifactError, ManifestError
from toolkit.features.features import (
    DESCRIPTOR_SCALE,
    KINDS,
    Descriptors,
    Extractor,
    FeatureStore,
    LocalFeatures,
    create_extractor,
    feature_kind,
)
from toolkit.features.groups import GroupWriter
from toolkit.files import fingerprint
from toolkit.manifest import FeaturesSettings, MatcherSettings
from toolkit.models.weights import LIGHTGLUE, SUPERPOINT, WeightsSource

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PairMatches:
    """K matches of the features of two images."""

    indices: NDArray[np.int64]
    """(K, 2) indices of features of the one and of the other; no feature is there twice."""
    scores: NDArray[np.float32]
    """(K,) larger is better: cosine similarity of the descriptors, or the confidence of a network."""

    def __len__(self) -> int:
        return len(self.indices)


class Matcher(Protocol):
    """What matches the features of images whose poses are not known."""

    batch_size: int
    """How many pairs a call is best given."""

    @property
    def settings(self) -> dict[str, Any]:
        """All that the matches depend on besides the features, `name` first; part of their fingerprint."""
        ...

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images."""
        ...


MATCHERS: dict[str, str] = {
    "mutual": "toolkit.features.matching:MutualMatcher",
    "lightglue": "toolkit.features.lightglue:LightGlueMatcher",
}
"""Name of a matcher -> `module:callable` that makes it, imported when it is asked for."""
LOCAL_WEIGHTS: dict[str, WeightsSource] = {"superpoint": SUPERPOINT, "lightglue": LIGHTGLUE}
"""The weights of the extractors and matchers that need some."""


def create_matcher(name: str, **options: Any) -> Matcher:
    """Return a ready matcher.

    Args:
        name: a key of `MATCHERS`.
        options: the matcher's own: `ratio` and `min_score` of `mutual`; `checkpoint`, `device`, `dtype` and others
            of a network.

    Raises:
        ManifestError: it is not known.
        WeightsError: the network has no weights.
    """
    if name not in MATCHERS:
        raise ManifestError(f"Unknown matcher {name!r}. Known: {', '.join(MATCHERS)}.")
    module, _, attribute = MATCHERS[name].partition(":")
    factory: Callable[..., Matcher] = getattr(import_module(module), attribute)
    return factory(**options)


def matchers_of(features: Sequence[str], matcher: str | None = None) -> dict[str, str]:
    """Return the matcher of each kind of features.

    Raises:
        ManifestError: no features, unknown ones, or a matcher that suits none of them.
    """
    if isinstance(features, str) or not len(features):
        raise ManifestError(f"features is {features!r}; expected a list of one or more of {', '.join(KINDS)}.")
    suited = {name: feature_kind(name).matchers for name in features}
    if matcher is not None and not any(matcher in known for known in suited.values()):
        text = "; ".join(f"{name}: {', '.join(known)}" for name, known in suited.items())
        raise ManifestError(f"The matcher {matcher!r} suits none of the features. Known for {text}.")
    return {name: matcher if matcher in known else known[0] for name, known in suited.items()}


class MutualMatcher:
    """Matches mutual nearest neighbors that pass Lowe's ratio test, of any descriptors."""

    batch_size = 1

    def __init__(self, ratio: float = 0.8, min_score: float = -1.0):
        """
        Args:
            ratio, min_score: see `mutual_matches`.
        """
        self.ratio = ratio
        self.min_score = min_score

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": "mutual", "ratio": self.ratio, "min_score": self.min_score}

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        """Return the matches of pairs of images; the ratio test is of the first image's features."""
        found = []
        for a, b in pairs:
            scores = similarity(unit_descriptors(a.descriptors), unit_descriptors(b.descriptors))
            indices = mutual_matches(scores, self.ratio, self.min_score)
            found.append(PairMatches(indices, scores[indices[:, 0], indices[:, 1]]))
        return found


@dataclass(frozen=True)
class LocalMethod:
    """One kind of local features: how they are found and matched."""

    name: str
    """A key of `KINDS`."""
    extractor: Extractor
    matcher: Matcher


def create_local_methods(
    features: FeaturesSettings, matcher: MatcherSettings, device: str = "auto", dtype: str = "auto"
) -> list[LocalMethod]:
    """Return the kinds of local features that are asked for, with their networks ready.

    Args:
        features: the kinds and how they are extracted.
        matcher: how they are matched; `mutual` takes the limits of the kind.
        device, dtype: of networks, see `create_extractor`.

    Raises:
        ManifestError: a matcher that suits none of the features.
        WeightsError: a network has no weights.
    """
    methods = []
    for name, matched_by in matchers_of(features.kinds, matcher.name).items():
        extractor = create_extractor(name, features, device, dtype)
        if matched_by == "mutual":
            methods.append(LocalMethod(name, extractor, MutualMatcher(KINDS[name].ratio, KINDS[name].min_score)))
        else:
            network = create_matcher(
                matched_by,
                checkpoint=matcher.checkpoint,
                device=device,
                dtype=dtype,
                min_score=matcher.min_confidence,
            )
            methods.append(LocalMethod(name, extractor, network))
    return methods


def matches_path(out: str | Path, session0: str, session1: str, made_by: Mapping[str, Any]) -> Path:
    """Return the file of the matches of two sessions.

    Args:
        out: folder of all matches.
        session0, session1: the sessions' ids.
        made_by: settings of the `features`, each by session, and of the `matcher`.
    """
    features, matcher = made_by["features"][0].get("name", "features"), made_by["matcher"]["name"]
    return Path(out) / f"{session0}-{session1}" / f"{features}-{matcher}-{fingerprint(made_by)}.h5"


class MatchStore:
    """Read access to the matches of two sessions' images. Safe to use from several threads."""

    def __init__(self, path: str | Path):
        """
        Args:
            path: a file of the toolkit or of hloc.
        """
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._lock = threading.Lock()

    def __getitem__(self, names: tuple[str, str]) -> PairMatches:
        """Return the matches of two images, in whichever order the file has them.

        Raises:
            KeyError: the file does not have the pair.
            ArtifactError: the file cannot be read.
        """
        with self._lock:
            if self._file is None:
                try:
                    self._file = h5py.File(self.path, "r")
                except OSError as error:
                    raise ArtifactError(f"Matches {self.path} cannot be read ({error}). Match again.") from None
            places = [(of(*names[::step]), step) for step in (1, -1) for of in (_own_group_name, group_name)]
            try:
                found = [(self._file[place], step) for place, step in places if place in self._file]
                arrays = [found[0][0][key][()] for key in ("matches0", "matching_scores0")] if found else []
            except (OSError, RuntimeError, KeyError) as error:  # what HDF5 raises for what is not its format
                raise ArtifactError(
                    f"Matches {self.path} are damaged at {' and '.join(names)} ({error}). Delete the file: it is made "
                    "again."
                ) from None
        if not found:
            raise KeyError(names)
        (partners, scores), reverse = arrays, found[0][1] < 0
        first = np.flatnonzero(partners >= 0)
        indices = np.stack([first, partners[first].astype(np.int64)], axis=1)
        return PairMatches(indices[:, ::-1] if reverse else indices, scores[first].astype(np.float32))


def write_matches(
    writer: GroupWriter, group: str, made_from: str, counts: tuple[int, int], matches: PairMatches
) -> None:
    """Add the matches of two images, of which each has so many features, to a file, as a group of `group_names`."""
    # hloc has 16 bits too; networks that find more features than these hold are rare.
    matches0 = np.full(counts[0], -1, np.int16 if max(counts) <= np.iinfo(np.int16).max else np.int32)
    scores = np.zeros(counts[0], np.float16)
    matches0[matches.indices[:, 0]] = matches.indices[:, 1]
    scores[matches.indices[:, 0]] = matches.scores
    writer.add(group, made_from, {"matches0": matches0, "matching_scores0": scores})


def match_sessions(
    stores: tuple[FeatureStore, FeatureStore],
    pairs: Iterable[tuple[str, str]],
    matcher: Matcher,
    out: str | Path,
    sessions: tuple[str, str],
    skip_existing: bool = True,
) -> MatchStore:
    """Match pairs of images of two sessions, or reuse the matches that are there. A killed run goes on where it was.

    Args:
        stores: features of the first images and of the second ones.
        pairs: names of images, the first session's first.
        matcher: how to match.
        out: folder of all matches, see `matches_path`.
        sessions: the sessions' ids.
        skip_existing: reuse the matches of features that have not changed since.

    Returns:
        The matches of (at least) these pairs; of a pair with an image that has no features there are none.
    """
    made_by = {"features": [store.settings for store in stores], "matcher": matcher.settings}
    path = matches_path(out, *sessions, made_by)
    with GroupWriter(path, made_by) as writer:
        known = writer.index.groups if skip_existing else {}
        there = [(name0, name1) for name0, name1 in pairs if name0 in stores[0] and name1 in stores[1]]
        groups = group_names(there, writer.index.groups)
        todo = []
        for name0, name1 in groups:
            made_from = stores[0].made_from[name0] + stores[1].made_from[name1]
            if known.get(groups[name0, name1]) != made_from:
                todo.append((name0, name1, made_from))
        label = f"{matcher.settings['name']} {' '.join(sessions)}"
        with tqdm(total=len(todo), desc=label, unit="pair", disable=not todo) as bar:
            for part in _parts(todo, matcher.batch_size):
                features = [(stores[0][name0], stores[1][name1]) for name0, name1, _ in part]
                for (name0, name1, made_from), both, found in zip(part, features, matcher.match(features), strict=True):
                    counts = len(both[0]), len(both[1])
                    write_matches(writer, groups[name0, name1], made_from, counts, found)
                bar.update(len(part))
        writer.finish()
    return MatchStore(path)


def _parts(items: Sequence[tuple[str, str, str]], size: int) -> Iterator[list[tuple[str, str, str]]]:
    rest = iter(items)
    while part := list(islice(rest, size)):
        yield part


def group_name(name0: str, name1: str) -> str:
    """Return the group of a file that has the matches of two images."""
    return f"{name0.replace('/', '-')}/{name1.replace('/', '-')}"


def group_names(pairs: Iterable[tuple[str, str]], known: Container[str] = ()) -> dict[tuple[str, str], str]:
    """Return the groups of pairs of images: those of `group_name`, where no two pairs share one.

    Images whose names differ in `-` against `/` alone would. Their pairs have groups of their own, which readers of
    hloc's layout do not find.

    Args:
        pairs: names of images.
        known: groups that the file has.
    """
    shared = {pair: group_name(*pair) for pair in pairs}
    count = Counter(shared.values())
    return {
        pair: own if (own := _own_group_name(*pair)) in known or count[group] > 1 else group
        for pair, group in shared.items()
    }


def _own_group_name(name0: str, name1: str) -> str:
    return f"{group_name(name0, name1)}~{fingerprint([name0, name1])}"


def unit_descriptors(descriptors: Descriptors) -> NDArray[np.float32]:
    """Return descriptors (N, D) of `LocalFeatures` as float32 of length about 1, ready for dot products."""
    unit = descriptors.astype(np.float32, copy=False)
    return unit * np.float32(1.0 / DESCRIPTOR_SCALE) if descriptors.dtype == np.uint8 else unit


def similarity(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the cosine similarities (N, M) of unit descriptors (N, D) and (M, D)."""
    return a @ b.T


def mutual_matches(scores: NDArray[np.float32], ratio: float = 0.8, min_score: float = -1.0) -> NDArray[np.int64]:
    """Return mutual nearest neighbors whose rows pass Lowe's ratio test.

    Args:
        scores: (N, M) cosine similarities; candidates that geometry excludes are below -1.
        ratio: the nearest must be closer than `ratio` times the second nearest, as Euclidean distance.
        min_score: least cosine similarity of a match.

    Returns:
        (K, 2) indices into the rows and the columns.
    """
    n, m = scores.shape
    if n == 0 or m == 0:
        return np.zeros((0, 2), np.int64)
    best, second = _two_best(scores)
    rows = np.arange(n)
    top = scores[rows, best]
    # |a - b|^2 = 2 - 2 a.b for unit vectors
    keep = np.flatnonzero(((1.0 - top) < ratio**2 * (1.0 - second)) & (top > min_score))
    # Only the columns that are somebody's best need to be looked at from the other side.
    keep = keep[np.argmax(scores[:, best[keep]], axis=0) == keep]
    return np.stack([keep, best[keep]], axis=1)


def _two_best(scores: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the best column of each row, (N,), and the second best score, (N,), -1 where there is none."""
    best = np.argmax(scores, axis=1)
    if scores.shape[1] == 1:
        return best, np.full(len(scores), -1.0, np.float32)
    rows = np.arange(len(scores))
    top = scores[rows, best]
    scores[rows, best] = -2.0
    second = np.maximum(scores.max(axis=1), np.float32(-1.0))
    scores[rows, best] = top
    return best, second


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
) -> NDArray[np.int64]:
    """Match two images whose poses are known, comparing only what can be the same point.

    The planes through both camera centers turn about the baseline. Two rays can meet only if they lie in one
    half-plane, so rays are sorted by the angle of itss and each is compared with its neighbors in that order
    alone: some hundredths of all pairs. Works on rays, so for every central camera model.

    Args:
        descriptors_a, descriptors_b: (N, D), (M, D) unit descriptors.
        rays_a, rays_b: (N, 3), (M, 3) unit rays in the cameras' frames.
        b_from_a: (4, 4) relative pose, meters.
        max_angle_a, max_angle_b: largest angle of a ray to the other's epipolar plane, radians.
        ratio: the nearest must be closer than `ratio` times the second nearest of the candidates.
        min_score: least cosine similarity of a match.

    Returns:
        (K, 2) indices of matched features; none where the cameras share one place.
    """
    baseline = np.linalg.norm(b_from_a[:3, 3])
    if baseline < 1e-6 or not len(rays_a) or not len(rays_b):
        return np.zeros((0, 2), np.int64)
    axis = b_from_a[:3, 3] / baseline  # from b toward a, in b
    turn_a, elevation_a = _about_axis(rays_a @ b_from_a[:3, :3].T, axis)
    turn_b, elevation_b = _about_axis(rays_b, axis)
    # The same sideways error is a larger turn close to the epipole.
    reach_a = np.arcsin(np.minimum(max_angle_a / np.maximum(np.sin(elevation_a), 1e-9), 1.0))
    reach_b = np.arcsin(np.minimum(max_angle_b / np.maximum(np.sin(elevation_b), 1e-9), 1.0))
    order_a = np.argsort(turn_a, kind="stable")
    order_b = np.argsort(turn_b, kind="stable")
    # Turns wrap around: b is laid out three times so that every window is one slice.
    m = len(order_b)
    wrapped = np.concatenate([turn_b[order_b] - 2 * np.pi, turn_b[order_b], turn_b[order_b] + 2 * np.pi])
    row_best = np.full(len(rays_a), -1, np.int64)
    column_best = np.full(m, -1, np.int64)
    column_score = np.full(m, -2.0, np.float32)
    slack = max_angle_a + max_angle_b
    for start in range(0, len(order_a), 64):
        rows = order_a[start : start + 64]
        low = np.searchsorted(wrapped, (turn_a[rows] - reach_a[rows]).min())
        high = np.searchsorted(wrapped, (turn_a[rows] + reach_a[rows]).max())
        if high - low > m:
            low, high = m, 2 * m
        if high <= low:
            continue
        columns = order_b[np.arange(low, high) % m]
        apart = np.abs(turn_a[rows, None] - wrapped[None, low:high])
        apart = np.minimum(apart, 2 * np.pi - apart)
        # In their half-plane the rays meet in front of both cameras only if b's opens wider, seen from the axis.
        allowed = (apart < np.minimum(reach_a[rows, None], reach_b[columns])) & (
            elevation_b[columns] < elevation_a[rows, None] + slack
        )
        scores = np.where(allowed, descriptors_a[rows] @ descriptors_b[columns].T, np.float32(-2.0))
        best, second = _two_best(scores)
        top = scores[np.arange(len(rows)), best]
        good = (top > min_score) & ((1.0 - top) < ratio**2 * (1.0 - second))
        row_best[rows[good]] = columns[best[good]]
        winners = np.argmax(scores, axis=0)
        winning = scores[winners, np.arange(len(columns))]
        better = winning > column_score[columns]
        column_best[columns[better]] = rows[winners[better]]
        column_score[columns[better]] = winning[better]
    matched = np.flatnonzero(row_best >= 0)
    matched = matched[column_best[row_best[matched]] == matched]
    return np.stack([matched, row_best[matched]], axis=1)


def _about_axis(rays: Floats, axis: Floats) -> tuple[Floats, Floats]:
    """Return the angles of rays (N, 3) about a unit axis and from it, radians, each (N,)."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(axis, helper)
    x /= np.linalg.norm(x)
    y = np.cross(axis, x)
    return np.arctan2(rays @ y, rays @ x), np.arccos(np.clip(rays @ axis, -1.0, 1.0))
