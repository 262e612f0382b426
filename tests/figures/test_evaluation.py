"""Figures of an evaluation: what they count."""

import numpy as np
import pandas as pd
import pytest

from toolkit.figures.evaluation import draw_deviations, draw_reliability, wilson_interval


def test_wilson_interval() -> None:
    """Known values: 8 of 10 (Newcombe, Statistics in Medicine 1998, formula 3), and the ends."""
    assert wilson_interval(0.8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson_interval(1.0, 4)[1] == pytest.approx(1.0)
    assert wilson_interval(0.0, 4)[0] == pytest.approx(0.0)


def test_the_share_of_right_poses_stands_over_what_was_stated() -> None:
    """Of four poses of 60 % three are right; one of 99.5 % is wrong; what has no probability is left out."""
    errors = pd.DataFrame({
        "p_correct": [0.6, 0.6, 0.6, 0.6, 0.995, float("nan")],
        "rotation_error_deg": [1, 1, 1, 9, 1, 1],
        "translation_error_m": [0.1, 0.1, 0.4, 0.1, 0.7, 0.1],
    })  # fmt: skip
    (axis,) = draw_reliability(errors).axes
    points = [tuple(line.get_xydata()[0]) for line in axis.lines if line.get_marker() == "o"]
    assert points == [pytest.approx((60, 75)), pytest.approx((99.5, 0))]
    assert [text.get_text() for text in axis.texts] == ["4", "1"]


def test_errors_stand_over_the_deviations_that_were_stated() -> None:
    """One of two `ok` poses is off by ten stated deviations; what has no deviation or no pose is left out."""
    errors = pd.DataFrame({
        "status": ["ok", "ok", "low_confidence: camera?", "low_confidence", "failed: no match"],
        "position_std_m": [0.01, 0.01, 0.5, float("nan"), float("nan")],
        "translation_error_m": [0.005, 0.1, 0.4, 2.0, float("inf")],
    })  # fmt: skip
    (axis,) = draw_deviations(errors).axes
    points = {line.get_label(): line.get_xydata() for line in axis.lines if line.get_alpha()}
    assert list(points) == ["ok: 2, 50 % above", "low confidence: 1, 0 % above"]
    np.testing.assert_allclose(np.concatenate(list(points.values())), [(0.01, 0.005), (0.01, 0.1), (0.5, 0.4)])
    assert not [line for line in axis.lines if "median" in line.get_label()], "of three poses, they would hide them"
    (axis,) = draw_deviations(pd.concat([errors] * 10)).axes
    (medians,) = [line for line in axis.lines if "median" in line.get_label()]
    assert len(medians.get_xydata()) == 10
