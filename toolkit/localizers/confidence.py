"""How probable it is that a pose is right: within 5 degrees and 0.5 m.

A logistic regression on what the localizer knows of a pose. `benchmarks/confidence.py` fits the weights on rendered
captures and on photographs made dark, blurred, foggy and half hidden, and tells how well they hold on others.
"""

from collections.abc import Mapping

import numpy as np
from scipy.special import expit

from toolkit.geometry import Floats

EVIDENCE = (
    "num_inliers", "inlier_ratio", "coverage", "rival_support", "position_std_m", "rotation_std_deg", "agreement"
)  # fmt: skip
"""What is asked of a pose: attributes of `PoseEstimate` and columns of `poses/<pair>.csv`."""
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
"""Of the terms that `terms` returns."""


def terms(evidence: Mapping[str, Floats | float]) -> Floats:
    """Return what the regression weighs, in the order of `WEIGHTS`, (..., 8).

    Args:
        evidence: of poses what `EVIDENCE` names; numbers, or arrays of equal shape.
    """
    inliers, ratio, coverage, rival, position_std_m, rotation_std_deg, agreement = (
        np.asarray(evidence[name], np.float64)
        for name in EVIDENCE
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithms = [np.log(values) for values in (inliers, position_std_m, rotation_std_deg)]
    columns = [
        np.ones_like(inliers), logarithms[0], ratio, coverage, rival, logarithms[1], logarithms[2], np.log1p(agreement)
    ]  # fmt: skip
    return np.stack(columns, axis=-1)


def probability_right(evidence: Mapping[str, Floats | float], weights: Floats | None = None) -> Floats:
    """Return the probability that poses are right, of the shape of the evidence; 0 where the deviation is unknown.

    Args:
        evidence: as for `terms`.
        weights: (8,); None: those of `WEIGHTS`.
    """
    weights = np.array(list(WEIGHTS.values())) if weights is None else weights
    return np.asarray(np.nan_to_num(expit(terms(evidence) @ weights), nan=0.0), np.float64)
