import numpy as np
import pandas as pd

from toolkit.show.metrics import parse_threshold, threshold_name, worst_first


def test_without_truth_failed_and_weak_queries_come_first():
    """A sheet of 18 phone pictures once began with the query of the most inliers and left out the weakest."""
    queries = pd.DataFrame({
        "status": ["ok", "ok", "low_confidence", "failed: too few inliers", "ok", "low_confidence"],
        "num_inliers": [593, 20, 30, np.nan, 20, 12],
        "position_std_m": [0.01, 0.02, 0.5, np.nan, 0.3, 0.1],
    })  # fmt: skip
    assert worst_first(queries).tolist() == [3, 5, 2, 4, 1, 0]
    nothing = np.full(6, np.nan)
    unknown = queries.assign(rotation_error_deg=nothing, translation_error_m=nothing)
    assert worst_first(unknown).tolist() == [3, 5, 2, 4, 1, 0]


def test_with_truth_the_larger_error_in_units_of_the_threshold_decides():
    queries = pd.DataFrame({
        "status": ["ok", "low_confidence", "failed", "ok"],
        "num_inliers": [9, 8, 0, 500],
        "rotation_error_deg": [2.0, 0.1, np.inf, 0.1],
        "translation_error_m": [0.01, 0.15, np.inf, 0.4],
    })  # fmt: skip
    assert worst_first(queries, (1, 0.1)).tolist() == [2, 3, 0, 1]
    assert worst_first(queries, (0.1, 10)).tolist() == [2, 0, 1, 3]
    assert not len(worst_first(queries.iloc[:0]))


def test_names_of_thresholds_are_read_back():
    assert parse_threshold(f"recall@{threshold_name((5, 0.5))}") == (5, 0.5)
