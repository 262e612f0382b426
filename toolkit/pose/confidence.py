"""Probability that a pose is correct, that is, within 5 degrees and 0.5 m of the true pose.

A logistic regression on statistics of the estimate. `benchmarks/confidence.py` fits the weights on rendered captures
and on real images that it darkens, blurs, fogs and half covers, and measures the calibration on held-out ones.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import chdtr, expit

from toolkit.geometry import Floats

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


LIMITS = (0.5, 5.0)  # meters, degrees: a pose within them is correct
MARGIN = 1.5  # factor on stated deviations, which are right only to about as much


def bounded_by_deviation(probability: float, position_std: float, rotation_std_deg: float) -> float:
    """Return the probability that a pose is correct, at most what its standard deviations leave.

    The probability that normal errors with `MARGIN` times these deviations, equal along three axes, are within
    `LIMITS`.

    Args:
        probability: that of the pose without this bound.
        position_std: of the pose, map lengths, see `Survey.length`, as in `EVIDENCE`.
        rotation_std_deg: of the pose.
    """
    stds = MARGIN * np.array([position_std, rotation_std_deg]) / np.sqrt(3)
    within = chdtr(3, (np.array(LIMITS) / np.maximum(stds, 1e-9)) ** 2)  # scipy.stats takes 0.5 s to import
    return float(min(probability, np.nan_to_num(within.prod(), nan=0.0)))


def bounded_by_rivals(probability: float, supports: Sequence[float]) -> float:
    """Return the probability that a pose is correct, at most what its rivals leave: one half for one of equal support.

    Args:
        probability: that of the pose alone, see `probability_right`.
        supports: of the rivals, relative to that of the pose.
    """
    return float(min(probability, 1 / (1 + odds_of_rivals(supports).sum())))


def odds_of_rivals(supports: Sequence[float]) -> Floats:
    """Return how probable each rival is, relative to the pose, from its relative support: 1 for equal support."""
    relative = np.clip(np.array(supports, np.float64), 1e-3, 1.0)
    return np.asarray(np.exp(-RIVAL_SLOPE * (1 / relative - 1)), np.float64)


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
