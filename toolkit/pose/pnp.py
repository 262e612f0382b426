"""Localize by matching a query's features to triangulated map points, and PnP for single cameras and rigs.

It takes two steps:

1. Match the query with its retrieved references by descriptors alone, and find a pose by LO-RANSAC.
2. Project the points of all covisible map images into the query at this pose, and match them only with keypoints near
   their projections (guided matches). This finds several times as many matches, and refines the pose.

Several kinds of features can be used together: one pose is estimated from the pooled matches of all kinds.

The probability that a pose is correct, that is, within 5 degrees and 0.5 m of the true pose, is a logistic regression
on statistics of the estimate. `benchmarks/confidence.py` fits the weights on rendered captures and on real images that
it darkens, blurs, fogs and half covers, and measures the calibration on held-out ones.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, expit

from toolkit import geometry
from toolkit.geometry import Floats, Ints
from toolkit.manifest import PnpSettings
from toolkit.pose.base import (
    CAMERA,
    CELLS,
    NOISE,
    Correspondences,
    Localizer,
    Matches,
    Prior,
    Query,
    QueryMatches,
    QueryResult,
    References,
    RigQuery,
    Rival,
    Status,
    agree,
    stds_of,
)
from toolkit.pose.map_matching import MapMatcher, MappedFeatures, MatchCache, Vicinity, check_intrinsics
from toolkit.threads import fixed_sums

# Of the probability that a pose is correct
EVIDENCE = (
    "num_inliers", "inlier_ratio", "coverage", "rival_support", "position_std", "rotation_std_deg", "agreement"
)  # fmt: skip
"""Inputs of the regression: attributes of `QueryResult` and columns of `poses/<pair>.csv`."""
WEIGHTS: dict[str, float] = {
    "constant": -2.1948,
    "log_inliers": 1.2564,
    "inlier_ratio": 2.2838,
    "coverage": 4.7817,
    "rival_support": -2.8002,
    "log_position_std": -0.0932,
    "log_rotation_std": -0.6491,
    "log_agreement": 0.4397,
}
"""Weights of the columns that `terms` returns, fitted by `benchmarks/confidence.py` on 2026-11-22 to 1,861 queries of
rendered rooms and of real images made hard; `benchmarks/README.md` lists them, and what a fit to others gives."""
RIVAL_SLOPE = 10.7
"""How clearly support tells a pose from its rival. With it, a pose is `ok` beside a rival of up to 0.7 of its support.
`benchmarks/confidence.py`, 2026-11-28, on rendered captures whose two rooms are copies (`demo-data --alike`, SIFT): the
most probable value is 5.7 (seeds 0 to 9) and 3.3 (10 to 13); at most 1 % of `ok` poses are wrong up to 15.4 and 7.3, by
all up to 7.5. So of copies, 1.5 % of `ok` poses are wrong. Where nothing is a copy (STRECHA_HARD, castle-P30 made
hard), all 23 `ok` poses with a rival above 0.5 are right; 7.0 would refuse 15 of them."""
CURE = "`localize.map.refine_poses: true` removes most of this noise"
LIMITS = (0.5, 5.0)  # meters, degrees: a pose within them is correct
MARGIN = 1.5  # factor on stated deviations, which are right only to about as much
WIDER = 1.5
"""Limit of the errors of guided matches, in multiples of the noise of directions to map points."""
STRAYS = 0.15
"""Share of poses that go where the noise of the map's poses lets them. An image that is off bends the map, and the pose
with most matches may be one that fits the bent part. Of 522 poses in maps with noise of 0.5 deg, 1 cm and 1 deg, 2 cm
(kitchen, STRECHA, STRECHA_HARD; SIFT, 2026-11-29) that were `ok` without this, 43 were wrong; 0.155 is most
probable."""

# Of the search for the pose
PNP_FORMAT = 13
"""Version of the poses. Increase when the same settings and files give other poses, or they are written otherwise."""
FIRST_REFERENCES = {2: 200, 4: 100}
"""Number of references per image to match first -> independent inliers that their pose needs to be kept. The next
number, and finally all references, are matched if the pose has fewer, or if too few of the matches are inliers."""
MIN_SHARED_POINTS = 12
"""A map image that observes at least so many inliers shows their place, so it cannot be of a rival."""
CLEAR_INLIER_RATIO = 0.56
"""Above this share of inliers among the matches, a rival is searched among the other matches alone: its support may be
near that of the pose, see `RIVAL_SHARE`, but a pose near by can no longer be the better one."""
CONTESTED_INLIER_RATIO = 0.4
"""Below this share of inliers, the pose may mix two places: RANSAC runs again with the tighter `max_error_deg`, and
separately for single references."""
CONTESTED_REFERENCES = 4
"""How many references, those with the most matches, then get a RANSAC of their own: several similar-looking places
together can outvote the one reference that shows the right place."""
CLOSE = 0.35
"""Of `max_error_deg`: correct matches fit their pose so closely, matches of one window with the next do not. By a limit
that both keep, a pose that is off by a window can have more inliers than the correct one, and hide it."""
WIDE_RADIUS_DEG = 1.5
"""Guided matching as far around a doubtful pose as a neighboring window may be: the best descriptors there are mostly
those of the right window, far more of them than among the matches by descriptors alone."""
RIVAL_DISTANCE, NEAR_DISTANCE = 0.5, 0.05
"""Of what a right pose may be off: poses farther apart than the first are rivals; between poses that are farther apart
than the second, the pose is uncertain."""
MAX_RIVAL_SUPPORT = 0.8
"""A pose is `ok` only if the best rival pose has at most this fraction of its support. With the default
`ok_probability` the limit is 0.7, see `benchmarks/confidence.py`."""
GUIDED_RADII_DEG = (0.7, 0.35)
"""Guided matching: search radius around each projected map point, degrees; one pass per radius."""
MAX_GUIDED_MATCHES = 1000
"""Largest number of guided matches per camera; those with the most similar descriptors are kept."""
RIVAL_SHARE = 0.25
"""Smallest number of matches by descriptors that agree with a rival, as a share of those that agree with the pose. Such
a rival may have most of the guided matches, as references of one place hide those of its double."""
KIND_SHARE = 0.25
"""A kind of features with more than this share of the support of a pose judges its rivals alone, too."""
GUIDED_WEIGHT = 0.5
"""Weight in the covariance of a match that only the search near the pose found. Errors over stated deviations then have
medians of 0.7 (drone), 0.9, 1.4 (kitchen) and 1.0 (STRECHA); with 0: 0.2, 0.9, 1.1, 0.8; with 1: 0.9, 1.0, 1.6, 1.2."""
VIEWS = 4
"""Number of references whose keypoints are stored with the correspondences: those that observe the most of them."""


def bounded_by_deviation(probability: float, position_std: float, rotation_std_deg: float) -> float:
    """Return the probability that a pose is correct, at most what its standard deviations leave.

    The probability that normal errors with `MARGIN` times these deviations, equal along three axes, are within
    `LIMITS`.

    Args:
        probability: that of the pose without this bound.
        position_std: of the pose, map lengths, see `LocalMap.length`, as in `EVIDENCE`.
        rotation_std_deg: of the pose.
    """
    stds = MARGIN * np.array([position_std, rotation_std_deg]) / np.sqrt(3)
    within = chdtr(3, (np.array(LIMITS) / np.maximum(stds, 1e-9)) ** 2)  # scipy.stats takes 0.5 s to import
    return float(min(probability, np.nan_to_num(within.prod(), nan=0.0)))


def bounded_by_map(probability: float, covariance: Floats) -> float:
    """Return the probability that a pose is correct, at most what the noise of the map's poses leaves.

    `STRAYS` of the poses have normal errors as large as this noise lets them be, equal along three axes.

    Args:
        probability: that of the pose without this bound.
        covariance: (6, 6) of poses that this noise cannot tell from the estimate, see `PnpLocalizer._left_open`.
    """
    rotation_deg, position = stds_of(covariance)
    within = chdtr(3, 3 * (np.array(LIMITS) / np.maximum([position, rotation_deg], 1e-9)) ** 2)
    return float(min(probability, 1 - STRAYS * (1 - within.prod())))


def bounded_by_rivals(probability: float, supports: Sequence[float], clarity: float = 1.0) -> float:
    """Return the probability that a pose is correct, at most what its rivals leave: one half for one of equal support.

    Args:
        probability: that of the pose alone, see `probability_right`.
        supports: of the rivals, relative to that of the pose.
        clarity: of the support, see `clarity_of_support`.
    """
    return float(min(probability, 1 / (1 + odds_of_rivals(supports, clarity).sum())))


def odds_of_rivals(supports: Sequence[float] | Floats, clarity: float | Floats = 1.0) -> Floats:
    """Return how probable each rival is, relative to the pose, from its relative support: 1 for equal support."""
    relative = np.clip(np.array(supports, np.float64), 1e-3, 1.0)
    return np.asarray(np.exp(-RIVAL_SLOPE * clarity * (1 / relative - 1)), np.float64)


def clarity_of_support(noise_deg: float, max_error_deg: float) -> float:
    """Return how clearly support tells a pose from its rival in a map, compared with a map of exact poses.

    Where the noise of the map's poses asks for a wider limit of errors, other poses have more support within it. In
    maps with noise of 0.5 deg, 1 cm (see `STRAYS`), the most probable value is 0.48; this gives 0.34 to 0.5.

    Args:
        noise_deg: of the directions to map points, see `Consistency`.
        max_error_deg: limit for a map of exact poses.
    """
    return min(1.0, max_error_deg / max(WIDER * noise_deg, 1e-9))


def terms(evidence: Mapping[str, Floats | float]) -> Floats:
    """Return the terms of the regression, in the order of `WEIGHTS`, (..., 8).

    Args:
        evidence: the quantities in `EVIDENCE`, as numbers or arrays of equal shape, one entry per pose.
    """
    values = (np.asarray(evidence[name], np.float64) for name in EVIDENCE)
    inliers, ratio, coverage, rival, position, rotation, agreement = values
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithms = np.log(position), np.log(rotation), np.log1p(agreement)
        return np.stack([np.ones_like(inliers), np.log(inliers), ratio, coverage, rival, *logarithms], axis=-1)


def probability_right(evidence: Mapping[str, Floats | float], weights: Floats | None = None) -> Floats:
    """Return the probability that each pose is correct, shaped like the evidence; 0 if a standard deviation is unknown.

    Args:
        evidence: as for `terms`.
        weights: (8,); None takes `WEIGHTS`.
    """
    weights = np.array(list(WEIGHTS.values())) if weights is None else weights
    with np.errstate(invalid="ignore"):  # unknown deviations
        return np.asarray(np.nan_to_num(expit(terms(evidence) @ weights), nan=0.0), np.float64)


# The search for the pose


@dataclass(frozen=True)
class _Hypothesis:
    """A pose and the matches that support it: guided matches, or those of RANSAC if guided matching finds too few."""

    rig_from_world: Floats
    matches: Matches
    support: float
    """How well the matches fit, see `_support`."""
    supports: tuple[float, ...] = ()
    """The same for the matches of each kind of features."""

    @property
    def world_from_rig(self) -> Floats:
        return geometry.invert(self.rig_from_world)


@dataclass(frozen=True)
class PnpMatches(QueryMatches):
    """Matches of a query by descriptors alone. Those with a reference are computed when they are first needed."""

    localizer: "PnpLocalizer"
    """Localizer in the map that has the matched points."""
    point_index: Ints | None = None
    """If that map was made for the query: for each of its points, the index in the stored maps, -1 for none."""
    cache: MatchCache = field(default_factory=dict)

    @cached_property
    def usable(self) -> list[int]:
        """Indices of the images with features; only these are matched."""
        return [index for index, features in enumerate(self.query.features) if not isinstance(features, str)]

    @cached_property
    def rig(self) -> RigQuery:
        """Cameras and features of the usable images."""
        return RigQuery(
            [self.query.views[index].camera for index in self.usable],
            np.asarray(self.query.rig_from_cams, np.float64)[self.usable],
            [features for features in self.query.features if not isinstance(features, str)],
        )

    def _repr_html_(self) -> str:
        found = self.with_references([self.references[index] for index in self.usable])
        per_image = np.bincount(found.camera, minlength=len(self.usable)).tolist()
        counts = ", ".join(f"{count} in image {index}" for index, count in zip(self.usable, per_image, strict=True))
        return f"<p>{len(found)} matches with map points by descriptors: {counts or 'no image has features'}.</p>"

    def with_references(self, references: Sequence[References]) -> Matches:
        """Return the matches of each usable image with some of its references."""
        stored = [self.query.network_matches[index] for index in self.usable] if self.query.network_matches else []
        return self.localizer.matcher.by_descriptors(self.rig, references, stored, self.cache)


class PnpLocalizer(Localizer):
    """Localizes queries in one map by matching and PnP, with one or several kinds of features.

    Safe to use from several threads; the map is never changed.
    """

    def __init__(self, mapped: Sequence[MappedFeatures], settings: PnpSettings | None = None, seed: int = 0):
        self.seed, consistency, settings = seed, mapped[0].map.consistency, settings or PnpSettings()
        self._noise_deg = consistency.direction_noise_deg
        # Noise of the map's poses asks for a wider search.
        limit = max(settings.max_error_deg, WIDER * self._noise_deg)
        self._clarity = clarity_of_support(self._noise_deg, settings.max_error_deg)
        self.settings = settings.model_copy(update={"max_error_deg": limit})
        self._radii_deg = [max(radius, 3 * self._noise_deg) for radius in GUIDED_RADII_DEG]
        stds = np.repeat([np.radians(consistency.rotation_noise_deg), consistency.position_noise], 3)
        self._noise_of_poses = np.diag(stds**2)
        """Covariance (6, 6) of a pose of the map. A query's pose is as far off as the map's poses around it are."""
        self.matcher = MapMatcher(mapped)
        self.map = self.matcher.map
        self.image_names = self.map.image_names
        self.lift: Callable[[Query, Sequence[References], None, Sequence[Prior]], QueryResult | None] | None = None
        """Localizes a query that has no pose otherwise by depth maps, see `prediction.hybrid.DepthLifter`."""

    def match(self, query: Query, references: Sequence[References]) -> PnpMatches:
        """Return the matches of a query with its references; see `Localizer`."""
        return PnpMatches(query, references, self)

    @fixed_sums
    def solve(self, matches: PnpMatches, prediction: None = None, priors: Sequence[Prior] = ()) -> QueryResult:
        """Return one pose for the cameras of a rig, or for a single camera; see `Localizer`.

        Images without features are left out. A prior is one more hypothesis: it wins if it has clearly more
        support. A prior that agrees with an `ok` pose changes nothing.
        """
        missing = "; ".join(features for features in matches.query.features if isinstance(features, str))
        if not matches.usable:
            return QueryResult.failed(f"no readable image ({missing})")
        references = [matches.references[index] for index in matches.usable]
        if not any(len(retrieved.images) for retrieved in references):
            return QueryResult.failed("no references", remark=missing)
        rig = matches.rig
        all_matches, first_matches, start = self._first_pose(matches, references)
        hypotheses = [] if start is None else self._hypotheses(rig, start, first_matches, all_matches, references)
        if hypotheses:
            result = self._estimate(rig, all_matches, hypotheses, references)
        else:
            reason = "no consistent pose" if len(np.unique(all_matches.point)) >= 4 else "too few matches"
            result = self._failed(reason, all_matches)
        for prior in priors:
            result = self._compare(rig, all_matches, hypotheses, result, references, prior)
        result = self._with_checked_intrinsics(rig, all_matches, result)
        partly = len(matches.usable) < len(matches.query.features)
        result = _of_all_images(matches, result, missing) if partly else result
        if self.lift is None or result.world_from_rig is not None:
            return result
        lifted = self.lift(matches.query, matches.references, None, priors)
        return result if lifted is None or lifted.world_from_rig is None else lifted

    def _with_checked_intrinsics(self, query: RigQuery, matches: Matches, estimate: QueryResult) -> QueryResult:
        """Return the estimate, with a warning if matches made without the pose contradict the query's intrinsics.

        The pose remains that of the stated intrinsics. Its covariance grows to cover the pose of those that would fit.
        """
        if estimate.world_from_rig is None:
            return estimate
        check = check_intrinsics(
            query,
            geometry.invert(estimate.world_from_rig),
            matches[self.map.track_lengths(matches.point) > 1],  # points with one observation are not triangulated
            self.map.points,
            self.settings.ransac_max_error_deg,
            focal_alone=estimate.rival_support > MAX_RIVAL_SUPPORT,
            noise_deg=self._noise_deg,
        )
        if check is None:
            return estimate
        covariance = estimate.covariance
        wider = None if covariance is None else covariance + np.outer(check.shift, check.shift)
        estimate = replace(estimate, covariance=wider, camera_contradicted=True)
        if not check.doubtful:
            return estimate
        return replace(
            estimate,
            status=Status.LOW_CONFIDENCE,
            reason=CAMERA,
            focals_px=check.focals_px(query.cameras),
            centers_px=check.centers_px(query.cameras),
            remark=check.reason(query.cameras),
        )

    def _compare(
        self,
        query: RigQuery,
        matches: Matches,
        hypotheses: list[_Hypothesis],
        estimate: QueryResult,
        references: Sequence[References],
        prior: Prior,
    ) -> QueryResult:
        """Return the estimate found without a prior, or the one found from the prior if it is better supported."""
        if estimate.status is Status.OK and agree(estimate.world_from_rig, prior.world_from_rig):
            return estimate  # each confirms the other
        rig_from_world = geometry.invert(prior.world_from_rig)
        points = [self.map.observations(int(image))[1] for image in prior.images]
        seen = np.concatenate([np.zeros(0, np.int64), *points])
        near = self._guided_around(query, rig_from_world, seen, prior.radius_deg)
        start = self._ransac(query, near, self.settings.ransac_max_error_deg) if len(near) else None
        if start is None:
            return estimate
        # Where windows repeat, RANSAC may leave a prior that is a rival for a neighboring window.
        found = _best_first([self._improve(query, pose, near) for pose in (start, rig_from_world)])
        hypothesis = found[0]
        same = bool(hypotheses) and not _differ(hypotheses[0], hypothesis)
        support = hypotheses[0].support if hypotheses else 0.0
        clearly_more = support <= MAX_RIVAL_SUPPORT * hypothesis.support  # a tie keeps the first estimate
        as_much = hypothesis.support >= 0.99 * support  # found from two starts, one pose differs in the last digits
        if (as_much and estimate.status is not Status.OK) if same else clearly_more:
            # The matches near the prior judge the pose: like matches by descriptors, they were made without it.
            prior_references = [References.of(prior.images.tolist())]
            with_prior = self._estimate(query, near, [hypothesis, *hypotheses], prior_references)
            lost = estimate.world_from_rig is None
            if with_prior.world_from_rig is not None and (not same or lost or with_prior.status is Status.OK):
                return replace(with_prior, found_by=f"pnp+{prior.source}")
            return estimate
        if estimate.world_from_rig is None or not any(_differ(hypotheses[0], one) for one in found):
            return estimate
        # One pose, found from two starts, differs in the last digits: the first stays.
        best = hypotheses[0].world_from_rig
        others = [one for one in found if not agree(best, one.world_from_rig, NEAR_DISTANCE)]
        return self._estimate(query, matches, _best_first([*hypotheses, *others]), references)

    def _first_pose(
        self, of_query: PnpMatches, references: Sequence[References]
    ) -> tuple[Matches, Matches, Floats | None]:
        """Match the query by descriptors and find a first pose by RANSAC.

        The best references give most of the correct matches; later ones give mostly wrong matches, which slow RANSAC
        down. So RANSAC runs on the best few references, and on more if the pose has few inliers. If most matches of the
        best references are inliers, later references are matched only if they show another place, which may be a rival.

        Returns:
            All matches, the matches given to RANSAC, and the pose rig_from_world (4, 4), or None if there is none.
        """
        settings, query = self.settings, of_query.rig
        start: Floats | None = None
        for count, enough in FIRST_REFERENCES.items():
            if all(len(retrieved.images) <= count for retrieved in references):
                break
            best = [retrieved.take(np.arange(len(retrieved.images)) < count) for retrieved in references]
            first_matches = of_query.with_references(best)
            start = self._ransac(query, first_matches, settings.ransac_max_error_deg)
            none = np.zeros(len(first_matches), bool)
            inliers = first_matches[none if start is None else self._inliers(query, start, first_matches)]
            if self._independent(inliers) < enough:
                start = None
            elif len(inliers) > CLEAR_INLIER_RATIO * len(first_matches):
                same_place = self.map.images_seeing(np.unique(inliers.point)) >= MIN_SHARED_POINTS
                references = [
                    retrieved.take((np.arange(len(retrieved.images)) < count) | ~same_place[retrieved.images])
                    for retrieved in references
                ]
                break
        matches = of_query.with_references(references)
        if start is not None:
            return matches, first_matches, start
        return matches, matches, self._ransac(query, matches, settings.ransac_max_error_deg)

    def _hypotheses(
        self, query: RigQuery, start: Floats, first_matches: Matches, matches: Matches, references: Sequence[References]
    ) -> list[_Hypothesis]:
        """Return refined poses, best supported first; one of them is refined from the first pose `start`.

        With repeated structure (a row of similar windows), many descriptors agree with several poses, and RANSAC may
        find one of them or something in between. So unless the first pose is clear, search for others: with a tighter
        threshold, among the outliers of the first, among the matches of single references, and by closely fitting
        matches in a wide surrounding of the best. The number and errors of guided matches decide: only at the correct
        pose does the rest of the map project where the query shows it.
        """
        settings = self.settings
        hypotheses = [self._improve(query, start, matches)]
        inliers = self._inliers(query, hypotheses[0].rig_from_world, matches)
        share = float(inliers.mean())
        clear, contested = share > CLEAR_INLIER_RATIO, share < CONTESTED_INLIER_RATIO
        if contested:
            other = self._ransac(query, first_matches, settings.max_error_deg)
            if other is not None:
                hypotheses.append(self._improve(query, other, matches))
                inliers |= self._inliers(query, hypotheses[1].rig_from_world, matches)
        rest = matches[~inliers]
        # A pose with a smaller share of inliers is no rival.
        least = RIVAL_SHARE * int(inliers.sum())
        enough = contested or len(rest) >= least
        other = self._ransac(query, rest, settings.ransac_max_error_deg, int(least)) if enough else None
        if other is not None and (contested or self._inliers(query, other, rest).sum() >= least):
            found = self._improve(query, other, matches)
            if not clear or _differ(hypotheses[0], found):
                hypotheses.append(found)
        if contested:
            self._add_other_places(query, matches, references, hypotheses)
        if not clear:
            self._add_neighbor(query, matches, hypotheses)
        return _best_first(hypotheses)

    def _add_other_places(
        self, query: RigQuery, matches: Matches, references: Sequence[References], hypotheses: list[_Hypothesis]
    ) -> None:
        """Add clearly different poses, found from the matches with single references."""
        images = dict.fromkeys(int(index) for retrieved in references for index in retrieved.images)
        seen_in = {index: np.isin(matches.point, self.map.observations(index)[1]) for index in images}
        best = sorted(seen_in, key=lambda index: -int(seen_in[index].sum()))
        for index in best[:CONTESTED_REFERENCES]:
            some = matches[seen_in[index]]
            start = self._ransac(query, some, self.settings.ransac_max_error_deg, min_inliers=5)
            self._add(query, matches, hypotheses, start, 1.0)

    def _add_neighbor(self, query: RigQuery, matches: Matches, hypotheses: list[_Hypothesis]) -> None:
        """Add the pose that fits most closely around the best so far; even one 0.1 m away may be the better of two."""
        pose = _best_first(hypotheses)[0].rig_from_world
        seen = matches.point[self._inliers(query, pose, matches)]
        around = self._guided_around(query, pose, seen, WIDE_RADIUS_DEG)
        start = self._ransac(query, around, CLOSE * self.settings.max_error_deg)
        self._add(query, matches, hypotheses, start, 0.2)

    def _add(
        self, query: RigQuery, matches: Matches, hypotheses: list[_Hypothesis], start: Floats | None, share: float
    ) -> None:
        """Add the pose refined from `start`, unless it agrees with one that is there, see `agree`."""
        if start is None:
            return
        if not any(agree(one.world_from_rig, geometry.invert(start), share) for one in hypotheses):
            hypotheses.append(self._improve(query, start, matches))

    def _guided_around(self, query: RigQuery, rig_from_world: Floats, points: Ints, radius_deg: float) -> Matches:
        """Return the guided matches at a pose with the images that observe some of the given points."""
        vicinity = self.matcher.vicinity(query, rig_from_world, points, radius_deg)
        return vicinity.guided(rig_from_world, radius_deg, MAX_GUIDED_MATCHES)

    def _independent(self, inliers: Matches) -> int:
        """Return the number of independent inliers: those that share a point or a keypoint count once."""
        xy = inliers.pixels.astype(np.float32).view(np.uint64)[:, 0]  # x and y as one number
        keypoints = sum(len(np.unique(xy[inliers.camera == camera])) for camera in np.unique(inliers.camera))
        return min(len(np.unique(inliers.point)), keypoints)

    def _inliers(self, query: RigQuery, rig_from_world: Floats, matches: Matches) -> NDArray[np.bool_]:
        return self._errors(query, rig_from_world, matches) < self.settings.ransac_max_error_deg

    def _errors(self, query: RigQuery, rig_from_world: Floats, matches: Matches) -> Floats:
        return query.errors_deg(rig_from_world, matches, self.map.points)

    def _improve(self, query: RigQuery, rig_from_world: Floats, matches: Matches) -> _Hypothesis:
        """Alternate between guided matching around the pose and refinement, while enough matches support it."""
        settings = self.settings
        pose, inliers = rig_from_world, matches[self._inliers(query, rig_from_world, matches)]
        min_matches = max(4, 0.5 * len(np.unique(inliers.point)))
        vicinity: Vicinity | None = None
        for radius in self._radii_deg:
            if vicinity is None or not vicinity.reaches(pose, radius):
                vicinity = self.matcher.vicinity(query, pose, inliers.point, radius)
            guided = vicinity.guided(pose, radius, MAX_GUIDED_MATCHES)
            if len(guided) < min_matches:
                break
            refined = query.refine(pose, guided, self.map.points)
            guided = guided[self._errors(query, refined, guided) < settings.max_error_deg]
            if len(guided) < min_matches:
                break
            pose, inliers = query.refine(refined, guided, self.map.points, close=True), guided
        errors, kinds = self._errors(query, pose, inliers), self.matcher.kind_of(inliers.point)
        of_kinds = [errors[kinds == kind] for kind in range(len(self.matcher.mapped))]
        support, *supports = [_support(part, settings.max_error_deg) for part in (errors, *of_kinds)]
        return _Hypothesis(pose, inliers, support, tuple(supports))

    def _estimate(
        self, query: RigQuery, matches: Matches, hypotheses: list[_Hypothesis], references: Sequence[References]
    ) -> QueryResult:
        """Return the first hypothesis as an estimate, judged by the matches made without it and by its rivals.

        The other hypotheses must be sorted by support, best first.
        """
        settings = self.settings
        rig_from_world, guided = hypotheses[0].rig_from_world, hypotheses[0].matches
        inliers = matches[self._inliers(query, rig_from_world, matches)]
        independent = self._independent(inliers)
        if independent < settings.min_inliers:
            reason = f"too few inliers ({independent} within {settings.ransac_max_error_deg} deg)"
            return self._failed(reason, matches, independent)
        errors, rivals = query.errors_px(rig_from_world, guided, self.map.points), self._rivals(hypotheses)
        unguided = matches[~np.isin(matches.rows(), guided.rows())]
        unguided_agree = self._errors(query, rig_from_world, unguided) < settings.max_error_deg
        all_matches = Matches.pooled([guided, unguided])
        agreeing = np.concatenate([np.ones(len(guided), bool), unguided_agree])
        images = np.unique(np.concatenate([retrieved.images for retrieved in references]))
        seen = self.map.images_seeing(np.unique(all_matches.point[agreeing]))[images]
        used = [int(images[index]) for index in np.argsort(-seen, kind="stable") if seen[index]]
        covariance = self._covariance(query, rig_from_world, guided, inliers)
        estimate = QueryResult(
            Status.OK,
            world_from_rig=geometry.invert(rig_from_world),
            covariance=None if covariance is None else covariance + self._spread(hypotheses),
            num_matches=len(matches),
            num_inliers=independent,
            num_guided=len(guided),
            rmse_px=float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan"),
            rival_support=rivals[0].support if rivals else 0.0,
            rivals=tuple(rivals),
            coverage=query.num_cells(inliers) / (CELLS**2 * len(query.cameras)),
            agreement=self._agreement(inliers),
            references=tuple(self.image_names[image] for image in used),
            correspondences=self._correspondences(all_matches, agreeing, len(guided), used),
        )
        evidence = {name: getattr(estimate, name) for name in EVIDENCE}
        supports = [rival.support for rival in rivals]
        probability = bounded_by_rivals(float(probability_right(evidence)), supports, self._clarity)
        probability = bounded_by_deviation(probability, estimate.position_std, estimate.rotation_std_deg)
        left_open = self._left_open(query, rig_from_world, guided)
        bound = bounded_by_map(probability, left_open)
        certain, ok = estimate.rival_support <= MAX_RIVAL_SUPPORT, settings.ok_probability
        estimate = replace(estimate, status=Status.LOW_CONFIDENCE, p_correct=bound)
        if certain and bound >= ok:
            return replace(estimate, status=Status.OK)
        if certain and probability >= ok:
            remark = f"poses within {stds_of(left_open)[0]:.1f} deg may fit as well; {CURE}"
            return replace(estimate, reason=NOISE, remark=remark)
        return estimate

    def _left_open(self, query: RigQuery, rig_from_world: Floats, matches: Matches) -> Floats:
        """Return the covariance (6, 6) of poses that noise of the map's poses cannot tell from an estimated one.

        As of an estimate from one match that is as informative as all are on average: where an image bends the map, all
        matches that fit have errors alike, and their number does not help.
        """
        if not self._noise_deg:
            return np.zeros((6, 6))
        of_pose = query.jacobians(rig_from_world, matches, self.map.points)[0]
        of_pose = of_pose / query.focals_px[matches.camera][:, None, None]
        of_one = np.einsum("oki,okj->ij", of_pose, of_pose) / max(len(matches), 1)
        return np.asarray(np.radians(self._noise_deg) ** 2 * np.linalg.pinv(of_one, hermitian=True), np.float64)

    def _agreement(self, inliers: Matches) -> int:
        """Return the number of inlier points of the kind of features that has the second most."""
        counts = np.unique(self.matcher.kind_names(np.unique(inliers.point)), return_counts=True)[1]
        return int(np.sort(counts)[-2]) if len(counts) > 1 else 0

    def _correspondences(
        self, matches: Matches, agrees: NDArray[np.bool_], guided: int, references: Sequence[int]
    ) -> Correspondences:
        """Return K matches as correspondences, with the keypoints of the first `VIEWS` references.

        Args:
            matches: guided matches first.
            agrees: (K,) whether they agree with the pose.
            guided: number of guided matches.
            references: map images, those that observe the most points that agree first.
        """
        views = [(rank, *self.matcher.keypoints(i, matches.point)) for rank, i in enumerate(references[:VIEWS])]
        found_by = np.repeat(["/guided", "/descriptors"], [guided, len(matches) - guided])
        return Correspondences(
            camera=matches.camera,
            pixels=matches.pixels,
            points=self.map.points[matches.point],
            point_index=matches.point,
            agrees=agrees,
            found_by=np.char.add(self.matcher.kind_names(matches.point), found_by),
            view_of=np.concatenate([np.zeros(0, np.int64), *(at for _, at, _ in views)]),
            view_reference=np.concatenate([np.zeros(0, np.int64), *(np.full(len(at), rank) for rank, at, _ in views)]),
            view_pixels=np.concatenate([np.zeros((0, 2)), *(pixels for _, _, pixels in views)]),
        )

    def _covariance(self, query: RigQuery, rig_from_world: Floats, guided: Matches, inliers: Matches) -> Floats | None:
        """Return the covariance (6, 6) of a pose estimated from guided matches; None if it is undefined.

        Guided matches were searched near the pose, so their errors are small wherever it is. Only those that were also
        found by descriptors alone, `inliers`, measure the spread of the errors; the others count for less.
        """
        found_twice = np.isin(guided.rows(), inliers.rows())
        of_pose, of_point = query.jacobians(rig_from_world, guided, self.map.points)
        errors = query.errors_px(rig_from_world, guided, self.map.points)
        weights, noise = np.where(found_twice, 1.0, GUIDED_WEIGHT), self._noise_of_points(query, guided, of_point)
        of_matches = least_squares_covariance(of_pose, errors, noise, weights=weights)
        return None if of_matches is None else of_matches + self._noise_of_poses

    def _noise_of_points(self, query: RigQuery, matches: Matches, of_point: Floats) -> Floats:
        """Return the covariance (K, 2, 2) of projections due to the noise of their points, square pixels; NaN: unknown.

        `of_point` (K, 2, 3) are the derivatives of the K projections by their points.
        """
        noise = of_point @ self.map.point_covariances(matches.point) @ of_point.transpose(0, 2, 1)
        # Inliers have errors below the threshold, so the noise of their points cannot be larger.
        limit_px = np.tan(np.radians(self.settings.max_error_deg)) * query.focals_px[matches.camera]
        share = limit_px**2 / np.maximum(np.trace(noise, axis1=1, axis2=2), 1e-12)
        return np.asarray(noise * np.minimum(share, 1)[:, None, None], np.float64)

    def _failed(self, reason: str, matches: Matches, inliers: int = 0) -> QueryResult:
        """Return a result without a pose; none of the matches agrees with one."""
        rejected = self._correspondences(matches, np.zeros(len(matches), bool), 0, [])
        return QueryResult.failed(reason, num_matches=len(matches), num_inliers=inliers, correspondences=rejected)

    def _rivals(self, hypotheses: list[_Hypothesis], distance: float = RIVAL_DISTANCE) -> list[Rival]:
        """Return the poses that differ from the best and from each other, with their support relative to the best's."""
        kept = hypotheses[:1]
        for other in hypotheses[1:]:
            if not any(agree(one.world_from_rig, other.world_from_rig, distance) for one in kept):
                kept.append(other)
        return [Rival(other.world_from_rig, _relative_support(other, kept[0])) for other in kept[1:]]

    def _spread(self, hypotheses: list[_Hypothesis]) -> Floats:
        """Return the covariance (6, 6) due to poses with similar support that are too near to the best to be rivals."""
        best = hypotheses[0]
        near = [one for one in self._rivals(hypotheses, NEAR_DISTANCE) if not _differ(best, one)]
        odds = odds_of_rivals([one.support for one in near], self._clarity)
        poses = np.reshape([one.world_from_rig for one in near], (-1, 4, 4))
        shifts = geometry.small_motions(best.rig_from_world @ poses) if near else np.zeros((0, 6))
        return np.asarray((shifts.T * (odds / (1 + odds.sum()))) @ shifts, np.float64)

    def _ransac(self, query: RigQuery, matches: Matches, max_error_deg: float, min_inliers: int = 0) -> Floats | None:
        return query.ransac(matches, self.map.points, max_error_deg, self.seed, min_inliers)


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


def _support(errors_deg: Floats, max_error_deg: float) -> float:
    """Return how well a pose is supported by n matches that it was fitted to.

    The sum of 1 - (error / limit)^2, at least 0 each, as in MSAC (Torr and Zisserman, CVIU 2000): the geometric mean
    for two limits. Guided matches are searched near the projections of the map, so a wrong pose near the right one may
    have as many or more, but with larger errors. Three of the matches do not count, as six parameters fit any three.
    """
    sums = [np.maximum(1 - (errors_deg / limit) ** 2, 0).sum() for limit in (max_error_deg, CLOSE * max_error_deg)]
    return float(np.sqrt(np.prod(sums)) * max(1 - 3 / max(len(errors_deg), 1), 0))


def _relative_support(other: _Hypothesis, best: _Hypothesis) -> float:
    """Return the support of a hypothesis, divided by that of the best: by all matches, or by the kind that doubts most.

    Kinds of features see the same surfaces, so those that agree are no independent witnesses, and one that can tell two
    places less well than all together has found a reason to doubt them.
    """
    kinds = zip(other.supports, best.supports, strict=True)
    shares = [theirs / own for theirs, own in kinds if own > KIND_SHARE * best.support]
    return max([other.support / max(best.support, np.finfo(float).tiny), *shares])


def _best_first(hypotheses: Sequence[_Hypothesis]) -> list[_Hypothesis]:
    return sorted(hypotheses, key=lambda hypothesis: -hypothesis.support)


def _differ(hypothesis: _Hypothesis, other: _Hypothesis | Rival) -> bool:
    return not agree(hypothesis.world_from_rig, other.world_from_rig, RIVAL_DISTANCE)


def _of_all_images(matches: PnpMatches, result: QueryResult, missing: str) -> QueryResult:
    """Return a result that counts all images of the query, not only the usable ones; `missing` says why."""
    used = np.array(matches.usable, np.int64)[result.correspondences.camera]
    fitted = np.full((len(matches.query.views), 3), np.nan)
    if result.focals_px:
        fitted[matches.usable] = np.column_stack([result.focals_px, result.centers_px])
    return replace(
        result,
        correspondences=replace(result.correspondences, camera=used),
        focals_px=tuple(fitted[:, 0].tolist()),
        centers_px=tuple((x, y) for _, x, y in fitted.tolist()),
        remark="; ".join(filter(None, [result.remark, missing])),
    )
