"""ALIKED: where keypoints lie, that batches change nothing, what is refused. Weights are random but for one test."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tests.models.test_aliked_network import photograph, random_state
from toolkit.errors import ToolkitError, WeightsError
from toolkit.features.features import LocalFeatures, create_extractor
from toolkit.features.network import AlikedExtractor
from toolkit.manifest import AlikedSettings, FeaturesSettings

SETTINGS = {"model": "aliked-t16", "max_keypoints": 60}


@pytest.fixture(scope="module")
def extractor() -> AlikedExtractor:
    return make()


class Small(AlikedExtractor):
    """Photographs are not enlarged, which would take long."""

    min_long_side = 0


def make(dtype: str = "auto", **settings: int | float | str) -> AlikedExtractor:
    return Small(random_state(), "cpu", dtype, settings=AlikedSettings.of(SETTINGS, settings))


def assert_equal(found: LocalFeatures, expected: LocalFeatures, factor: float = 1.0) -> None:
    np.testing.assert_allclose(found.keypoints, expected.keypoints * factor, atol=1e-3 * factor)
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-5)
    np.testing.assert_allclose(found.descriptors, expected.descriptors, atol=1e-3)


def test_shapes_and_order(extractor: AlikedExtractor) -> None:
    (found,) = extractor.extract([photograph(75, 101)])
    assert len(found) == 60
    assert found.image_size == (101, 75)
    assert found.keypoints.dtype == found.scores.dtype == found.scales.dtype == np.float32
    assert found.descriptors.shape == (60, 64)
    assert found.descriptors.dtype == np.float16
    np.testing.assert_allclose(np.linalg.norm(found.descriptors.astype(np.float64), axis=1), 1, atol=2e-3)
    assert (np.diff(found.scores) <= 0).all()
    np.testing.assert_array_equal(found.scales, 1)
    assert extractor.settings["name"] == "aliked"
    assert extractor.settings["dtype_compute"] == "float32"
    assert make(max_keypoints=50).settings != extractor.settings != make(max_long_side=500).settings


@pytest.mark.parametrize("factor", [2, 3])
def test_keypoints_are_in_the_pixels_of_the_photograph(extractor: AlikedExtractor, factor: int) -> None:
    small = photograph(75, 100)
    large = np.kron(small, np.ones((factor, factor, 1), np.uint8))  # reduced, it is the small one again
    (expected,), (found,) = extractor.extract([small]), make(max_long_side=100).extract([large])
    assert_equal(found, expected, factor)
    assert found.image_size == (100 * factor, 75 * factor)
    # Enlarged photographs differ a little, so their size and their corners are looked at alone.
    enlarging = make(max_keypoints=2000)
    enlarging.min_long_side = 100 * factor
    (found,) = enlarging.extract([small])
    assert found.image_size == (100, 75)
    assert 97 < found.keypoints[:, 0].max() < 100
    assert found.keypoints.min() > 0


def test_a_shifted_photograph_has_shifted_keypoints() -> None:
    extractor = make(max_keypoints=2000)
    wide = photograph(160, 288)
    (a,), (b,) = extractor.extract([wide[:, :256]]), extractor.extract([wide[:, 32:]])
    # By a pixel of the coarsest level; enlarging it depends on the place in the image, so not all stay.
    apart = (b.keypoints + np.array([32, 0]) - a.keypoints[:, None]).reshape(-1, 2)
    same = apart[np.abs(apart).max(axis=1) < 0.5]
    assert len(same) > 0.4 * len(a)
    np.testing.assert_allclose(np.median(same, axis=0), 0, atol=0.05)


def test_gray_and_color(extractor: AlikedExtractor) -> None:
    gray = photograph(64, 96)[:, :, 0]
    color, again = extractor.extract([np.repeat(gray[:, :, None], 3, axis=2), gray])
    assert_equal(color, again)


def test_a_batch_is_its_images_one_by_one(extractor: AlikedExtractor) -> None:
    sizes = [(64, 96), (50, 70), (64, 96), (96, 64), (64, 96)]
    images = [photograph(*size, seed) for seed, size in enumerate(sizes)]
    threads = torch.get_num_threads()
    together = extractor.extract(images)
    assert torch.get_num_threads() == threads
    for image, found in zip(images, together, strict=True):
        assert_equal(found, extractor.extract([image])[0])
    pixels = torch.from_numpy(np.stack([images[0], images[2]]))
    rows = extractor._run(pixels)  # as on a GPU: together, not side by side
    torch.testing.assert_close(rows, torch.cat([extractor._run(row) for row in pixels.split(1)]), rtol=0, atol=1e-4)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_positions_keep_their_precision(extractor: AlikedExtractor, dtype: str) -> None:
    image = photograph(64, 1000)  # bfloat16 cannot tell x = 325 from 324
    (expected,), (found,) = extractor.extract([image]), make(dtype).extract([image])
    distance = np.linalg.norm(found.keypoints[:, None] - expected.keypoints, axis=2).min(axis=1)
    assert np.median(distance) < 0.1
    assert found.keypoints[:, 0].max() > 900


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (4, 100), (1, 640), (9, 9)])
def test_tiny_photographs(extractor: AlikedExtractor, size: tuple[int, int]) -> None:
    (found,) = extractor.extract([photograph(*size)])
    assert found.descriptors.shape == (len(found), 64)
    assert (len(found) > 0) <= (min(size) > 4)


def test_nothing_to_find(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AlikedExtractor, "min_score", 1.0)
    (found,) = make().extract([photograph(64, 96)])
    assert found.keypoints.shape == (0, 2)
    assert found.descriptors.shape == (0, 64)
    assert make().extract([]) == []


@pytest.mark.parametrize("part", ["block1.conv1.weight", "desc_head.agg_weights"])
def test_weights_that_are_not_finite(part: str) -> None:
    state = random_state()
    state[part] = torch.full_like(state[part], torch.nan)
    with pytest.raises(ToolkitError, match=r"ALIKED .* not finite"):
        AlikedExtractor(state, "cpu", settings=AlikedSettings.of(SETTINGS)).extract([photograph(64, 96)])


def test_weights_of_another_model() -> None:
    with pytest.raises(WeightsError):
        AlikedExtractor(random_state("aliked-t16"), "cpu")


def test_official_weights_in_the_dark(learned_weights: None) -> None:
    extractor = create_extractor("aliked", FeaturesSettings(), "cpu")
    scene: NDArray[np.uint8] = photograph(480, 640)
    flat = np.full((480, 640, 3), 40, np.uint8)
    day, night, nothing = extractor.extract([scene, scene // 16, flat])
    assert len(nothing) == 0
    assert len(night) > 0.5 * len(day) > 100
