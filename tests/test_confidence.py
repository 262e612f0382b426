"""The fit of the probability that a pose is right."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from toolkit.capture import Capture
from toolkit.geometry import pose_error
from toolkit.pose.pnp import (
    STRAYS,
    WEIGHTS,
    bounded_by_deviation,
    bounded_by_map,
    bounded_by_rivals,
    clarity_of_support,
    probability_right,
)

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "confidence.py"


@pytest.fixture(scope="module")
def confidence() -> ModuleType:
    """The script, which imports its neighbors by their bare names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCRIPT.parent)
        spec = importlib.util.spec_from_file_location("confidence", SCRIPT)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return module


def rows(count: int, **columns: object) -> pd.DataFrame:
    plain = {"scene": "a", "posed": True, "wrong": False, "num_inliers": 100, "inlier_ratio": 0.5, "coverage": 0.5}
    plain |= {"rival_support": 0.0, "agreement": 0, "position_std": 0.01, "rotation_std_deg": 0.1}
    plain |= {"refused": False, "way": "as it is", "escalated": False, "ok": True, "clarity": 1.0}
    return pd.DataFrame([plain | columns] * count)


def test_the_fit_finds_the_weights_that_made_the_rows(confidence: ModuleType) -> None:
    rng = np.random.default_rng(0)
    made = rows(20_000)
    made["num_inliers"] = rng.integers(10, 400, len(made))
    made["rival_support"] = rng.uniform(0, 1, len(made))
    odds = -4 + 2 * np.log(made["num_inliers"]) - 5 * made["rival_support"]
    made["wrong"] = rng.uniform(size=len(made)) > 1 / (1 + np.exp(-odds))
    weights = dict(zip(WEIGHTS, confidence.fit(made), strict=True))
    assert weights["log_inliers"] == pytest.approx(2, abs=0.15)
    assert weights["rival_support"] == pytest.approx(-5, abs=0.4)
    probability = probability_right(made, np.array(list(weights.values())))
    for low, high in ((0.2, 0.5), (0.5, 0.8), (0.8, 0.95), (0.95, 1)):
        part = (probability >= low) & (probability < high)
        assert (~made["wrong"][part]).mean() == pytest.approx(probability[part].mean(), abs=0.03)


def test_more_evidence_is_never_less_probable() -> None:
    plain = {"num_inliers": 30, "inlier_ratio": 0.2, "coverage": 0.4, "rival_support": 0.5, "position_std": 0.05}
    plain |= {"rotation_std_deg": 0.2, "agreement": 5}
    better = {"num_inliers": 60, "inlier_ratio": 0.5, "coverage": 0.8, "rival_support": 0.1, "position_std": 0.01}
    better |= {"rotation_std_deg": 0.05, "agreement": 50}
    for name, value in better.items():
        assert probability_right(plain | {name: value}) >= probability_right(plain), name
    assert 0 < probability_right(plain) < probability_right(better) <= 1
    assert probability_right(plain | {"position_std": np.nan}) == 0
    together = {name: np.array([value, better[name]]) for name, value in plain.items()}
    np.testing.assert_array_equal(
        probability_right(together), [probability_right(plain), probability_right(better)]
    )


def test_what_is_not_known_is_not_accepted(confidence: ModuleType) -> None:
    unknown = pd.concat([rows(5, position_std=np.nan), rows(5, posed=False)], ignore_index=True)
    sure = np.array([100.0, *[0.0] * 7])
    assert confidence.judge(unknown, confidence.stated(unknown, sure))["accepted"] == 0
    assert confidence.judge(rows(5, rival_support=0.9), confidence.stated(rows(5), sure))["accepted"] == 0


def test_rivals_count_more_in_a_noisy_map(confidence: ModuleType) -> None:
    sure = np.array([100.0, *[0.0] * 7])
    beside = {"rival_support": 0.6}
    exact, noisy = (confidence.stated(rows(1, **beside, clarity=clarity), sure)[0] for clarity in (1.0, 0.4))
    assert exact > 0.99 > noisy > 0.5


def test_the_share_of_wrong_ones_is_bounded(confidence: ModuleType) -> None:
    sure = np.ones(598)
    assert confidence.judge(rows(598), sure)["upper"] <= 0.005 < confidence.judge(rows(597), sure[:597])["upper"]
    one = pd.concat([rows(597), rows(1, wrong=True)], ignore_index=True)
    judged = confidence.judge(one, sure)
    assert (judged["wrong"], judged["found"]) == (1, 1.0)


def test_scenes_are_judged_by_weights_of_others(confidence: ModuleType) -> None:
    parts = [
        rows(40, scene=scene, wrong=wrong, num_inliers=20 if wrong else 200)
        for scene in ("a", "b", "c")
        for wrong in (False, True)
    ]
    text = confidence.markdown(pd.concat(parts, ignore_index=True), ["c"])
    assert "weights fitted on 160" in text
    assert "c (held out)" in text


def test_degradations_keep_the_picture_and_make_it_worse(confidence: ModuleType) -> None:
    image = np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8)
    made = {how: confidence.degrade(image, how, np.random.default_rng(1)) for how in confidence.DEGRADATIONS}
    assert all(one.shape == image.shape and one.dtype == np.uint8 for one in made.values())
    np.testing.assert_array_equal(made["none"], image)
    assert made["dark"].mean() < 0.3 * image.mean()
    assert 0.02 < (made["hidden"] == image).mean() < 0.5
    assert made["blurred"].std() < 0.6 * image.std()


def test_deviations_bound_the_probability() -> None:
    assert bounded_by_deviation(0.97, 0.01, 0.1) == 0.97
    assert bounded_by_deviation(1.0, 0.5, 0.1) < 0.9, "an error of 0.5 m is as probable as not"
    assert bounded_by_deviation(1.0, 0.01, 5.0) < 0.9
    assert bounded_by_deviation(1.0, np.nan, 0.1) == 0
    bounds = [bounded_by_deviation(1.0, position_std, 0.1) for position_std in np.linspace(0, 2, 11)]
    assert bounds == sorted(bounds, reverse=True)


def test_noise_of_the_map_bounds_the_probability() -> None:
    def covariance(rotation_deg: float, position: float) -> np.ndarray:
        return np.diag(np.repeat([np.radians(rotation_deg) ** 2 / 3, position**2 / 3], 3))

    assert bounded_by_map(0.97, np.zeros((6, 6))) == 0.97
    assert bounded_by_map(1.0, covariance(0.1, 0.2)) > 0.99
    assert bounded_by_map(1.0, covariance(1e3, 1e3)) == pytest.approx(1 - STRAYS), "most poses do not stray"
    assert bounded_by_map(1.0, covariance(5.0, 0.1)) < 0.95
    for unit in ((0.0, 1.0), (10.0, 0.0)):
        bounds = [bounded_by_map(1.0, covariance(size * unit[0], size * unit[1])) for size in np.linspace(0, 2, 11)]
        assert bounds == sorted(bounds, reverse=True)


def test_support_tells_less_in_a_noisy_map() -> None:
    clarity = [clarity_of_support(noise_deg, 0.17) for noise_deg in (0.0, 0.1, 0.3, 1.0)]
    assert clarity[:2] == [1.0, 1.0]
    assert 1 > clarity[2] > clarity[3] > 0
    assert bounded_by_rivals(1.0, [1.0], clarity[3]) == pytest.approx(1 / 2)
    assert bounded_by_rivals(1.0, [0.6], 1.0) > 0.99 > bounded_by_rivals(1.0, [0.6], clarity[2])


def test_a_capture_is_made_hard(confidence: ModuleType, small_capture: Path, tmp_path: Path) -> None:
    way = confidence.Way(degraded=True, max_rotation_deg=2.0, max_shift=0.03, max_focal=0.15)
    confidence.harden(small_capture, tmp_path / "hard", way, 0)
    given, hard = Capture.open(small_capture), Capture.open(tmp_path / "hard")
    rotation_deg, shift = pose_error(hard["ios_map"].world_from_cam(), given["ios_map"].world_from_cam())
    assert 0 < np.median(rotation_deg) < 5
    assert 0 < np.median(shift) < 0.1
    focals = [session.camera(session.images["sensor_id"][0]).mean_focal_length() for session in (
        given["ios_map"], hard["ios_map"], given["ios_query"], hard["ios_query"])]  # fmt: skip
    assert 1 < focals[1] / focals[0] < 1.15
    assert focals[2] == focals[3]
    before, after = (
        [capture["ios_query"].image_path(row).read_bytes() for row in range(3)] for capture in (given, hard)
    )
    assert before != after


def test_rivals_bound_the_probability() -> None:
    assert bounded_by_rivals(0.97, []) == 0.97
    assert bounded_by_rivals(1.0, [1.0]) == pytest.approx(1 / 2)
    assert bounded_by_rivals(1.0, [1.0, 1.0]) == pytest.approx(1 / 3)
    bounds = [bounded_by_rivals(1.0, [support]) for support in np.linspace(0, 1, 11)]
    assert bounds == sorted(bounds, reverse=True), "more support of a rival never makes the pose more probable"
    assert bounded_by_rivals(0.3, [0.1]) == 0.3


def test_the_slope_that_made_the_rivals_is_found(confidence: ModuleType) -> None:
    rng = np.random.default_rng(0)
    made = rows(4000, num_inliers=1000, coverage=1.0)
    made["rival_support"] = rng.uniform(0.3, 1, len(made))
    made["wrong"] = rng.uniform(size=len(made)) > 1 / (1 + np.exp(-8 * (1 / made["rival_support"] - 1)))
    likely, largest = confidence.rival_slopes(made)
    assert likely == pytest.approx(8, abs=1)
    assert largest > likely, "most poses that are `ok` are surer than 99 %"
