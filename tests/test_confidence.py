"""The rule by which the limits of an `ok` pose are chosen."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

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
    plain = {"posed": True, "wrong": False, "inliers": 100, "rival_support": 0.0, "position_std_m": 0.01}
    return pd.DataFrame([plain | columns] * count)


def test_598_right_poses_show_half_a_percent_and_597_do_not(confidence: ModuleType) -> None:
    limits = (30, 0.8, 0.1)
    enough, too_few = (confidence.judge(rows(count), limits) for count in (598, 597))
    assert enough["upper"] <= 0.005 < too_few["upper"]
    assert confidence.fit(rows(597)) is None
    assert confidence.fit(rows(598)) == (60, 0.5, 0.02), "of equals, the strictest"


def test_limits_shut_out_what_is_wrong_and_no_more(confidence: ModuleType) -> None:
    wrong = rows(20, wrong=True, inliers=24, rival_support=0.3)
    contested = rows(20, wrong=True, rival_support=0.85)
    right = rows(700, inliers=26, rival_support=0.75, position_std_m=0.15)
    assert confidence.fit(pd.concat([wrong, contested, right])) == (25, 0.8, 0.2)


def test_what_is_not_known_is_not_accepted(confidence: ModuleType) -> None:
    unknown = pd.concat([rows(5, position_std_m=np.nan), rows(5, posed=False)])
    assert confidence.judge(unknown, (12, 1.0, 0.5))["accepted"] == 0


def test_degradations_keep_the_picture_and_make_it_worse(confidence: ModuleType) -> None:
    image = np.random.default_rng(0).integers(0, 255, (90, 120), np.uint8)
    made = {how: confidence.degrade(image, how, np.random.default_rng(1)) for how in confidence.DEGRADATIONS}
    assert all(one.shape == image.shape and one.dtype == np.uint8 for one in made.values())
    np.testing.assert_array_equal(made["none"], image)
    assert made["dark"].mean() < 0.3 * image.mean()
    assert 0.02 < (made["hidden"] == image).mean() < 0.5
    assert made["blurred"].std() < 0.6 * image.std()
