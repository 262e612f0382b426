"""SuperPoint: where keypoints lie, that batches change nothing, and what is refused. Weights are random or made up."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from toolkit.errors import ManifestError, ToolkitError, WeightsError
from toolkit.features.features import LocalFeatures
from toolkit.features.network import SuperPointExtractor
from toolkit.manifest import SuperPointSettings

transformers = pytest.importorskip("transformers", reason="needs the extra `learned`")

State = dict[str, torch.Tensor]
# Where `planted_state` sees a keypoint in a bright cell of 8 x 8 pixels, the center of its first pixel being at 0.
COLUMN, ROW = 5, 3


def random_state(seed: int = 0) -> State:
    """Weights of the official names and shapes that keep the size of activations."""
    generator = torch.Generator().manual_seed(seed)
    with torch.device("meta"):
        shapes = transformers.SuperPointForKeypointDetection(transformers.SuperPointConfig()).state_dict()
    return {
        name: torch.randn(value.shape, generator=generator) * (2 / max(value[0].numel(), 1)) ** 0.5
        if name.endswith("weight")
        else 0.1 * torch.randn(value.shape, generator=generator)
        for name, value in shapes.items()
    }


def planted_state() -> State:
    """Weights that find one keypoint in each cell with a white pixel, and none elsewhere."""
    state = {name: torch.zeros_like(value) for name, value in random_state().items()}
    for name, value in state.items():
        if ("conv_blocks" in name or "conv_score_a" in name) and name.endswith("weight"):
            value[0, 0, 1, 1] = 1  # hands on the image; pooling takes the brightest pixel of each cell
    state["keypoint_decoder.conv_score_b.weight"][8 * ROW + COLUMN, 0] = 40
    state["keypoint_decoder.conv_score_b.bias"][64] = 10  # the bin for "none"
    state["descriptor_decoder.conv_descriptor_b.bias"][:] = 1
    return state


@pytest.fixture(scope="module")
def extractor() -> SuperPointExtractor:
    settings = SuperPointSettings(max_keypoints=100)
    return SuperPointExtractor(random_state(), "cpu", "float32", batch_size=2, settings=settings)


def planted(dtype: str = "float32", batch_size: int | None = None, **settings: Any) -> SuperPointExtractor:
    return SuperPointExtractor(planted_state(), "cpu", dtype, batch_size, SuperPointSettings.of(settings))


def photograph(seed: int, height: int, width: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)


def assert_equal(found: LocalFeatures, expected: LocalFeatures) -> None:
    np.testing.assert_array_equal(found.keypoints, expected.keypoints)
    np.testing.assert_allclose(found.scores, expected.scores, rtol=1e-4)
    np.testing.assert_allclose(found.descriptors, expected.descriptors, atol=1e-3)
    assert found.image_size == expected.image_size


def test_shapes_and_order(extractor: SuperPointExtractor) -> None:
    (found,) = extractor.extract([photograph(0, 60, 90)])
    count = len(found)
    assert 20 < count <= 100
    assert found.image_size == (90, 60)
    assert found.keypoints.shape == (count, 2)
    assert found.keypoints.dtype == found.scores.dtype == found.scales.dtype == np.float32
    assert found.descriptors.shape == (count, 256)
    assert found.descriptors.dtype == np.float16
    np.testing.assert_allclose(np.linalg.norm(found.descriptors.astype(np.float64), axis=1), 1, atol=2e-3)
    assert (np.diff(found.scores) <= 0).all()
    np.testing.assert_array_equal(found.scales, 1)
    assert next(iter(extractor.settings.items())) == ("name", "superpoint")


def test_same_as_the_network_of_the_package(extractor: SuperPointExtractor) -> None:
    image = photograph(1, 64, 88)
    config = transformers.SuperPointConfig(border_removal_distance=0)
    network = transformers.SuperPointForKeypointDetection(config).eval()
    network.load_state_dict(random_state())
    with torch.inference_mode():
        output = network(torch.from_numpy(image)[None, None].float() / 255)
    pixels = (output.keypoints[0] * torch.tensor([88, 64])).round().numpy()
    inside = ((pixels >= 4) & (pixels < [84, 60])).all(axis=1)
    best = np.flatnonzero(inside)[np.argsort(-output.scores[0].numpy()[inside], kind="stable")[:100]]
    (found,) = extractor.extract([image])
    np.testing.assert_array_equal(found.keypoints, pixels[best] + 0.5)
    np.testing.assert_allclose(found.scores, output.scores[0].numpy()[best], rtol=1e-4)
    np.testing.assert_allclose(found.descriptors, output.descriptors[0].numpy()[best], atol=1e-3)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])  # bfloat16 cannot tell x = 325 from 324
def test_a_white_pixel_is_found_where_it_is(monkeypatch: pytest.MonkeyPatch, dtype: str) -> None:
    monkeypatch.setattr(SuperPointExtractor, "border", 0)
    image = np.zeros((8, 350), np.uint8)
    image[6, 8 * 40 + 1] = 255
    (found,) = planted(dtype).extract([image])
    np.testing.assert_array_equal(found.keypoints, [[8 * 40 + COLUMN + 0.5, ROW + 0.5]])


@pytest.mark.parametrize("factor", [2, 2.5, 4])
def test_keypoints_are_in_the_pixels_of_the_photograph(factor: float) -> None:
    image = np.zeros((round(80 * factor), round(120 * factor)), np.uint8)
    cell = round(8 * factor)
    image[4 * cell : 5 * cell, 7 * cell : 8 * cell] = 255
    (found,) = planted(max_long_side=120).extract([image])
    expected = [[(8 * 7 + COLUMN + 0.5) * factor, (8 * 4 + ROW + 0.5) * factor]]
    np.testing.assert_allclose(found.keypoints, expected, atol=1e-3)
    assert found.image_size == (round(120 * factor), round(80 * factor))


def test_a_shifted_photograph_has_shifted_keypoints(extractor: SuperPointExtractor) -> None:
    wide = photograph(2, 96, 160)
    (a,), (b,) = extractor.extract([wide[:, :128]]), extractor.extract([wide[:, 16:144]])
    # The grid moves by two of its cells; what the borders reach is left out.
    middle = a.keypoints[(abs(a.keypoints - [72, 48]) < [16, 8]).all(axis=1)]
    assert len(middle) > 3
    assert all((b.keypoints + np.array([16, 0]) == keypoint).all(axis=1).any() for keypoint in middle)


@pytest.mark.parametrize(
    ("height", "expected"),
    [
        (27, []),  # the pixel at y = 27 is only there because the last row is repeated up to a whole cell
        (31, []),  # in the image, and 4 pixels from its end
        (32, [3 * 8 + ROW + 0.5]),
    ],
)
def test_the_border_is_that_of_the_photograph(height: int, expected: list[float]) -> None:
    image = np.full((height, 40), 255, np.uint8)
    image[:24] = 0
    (found,) = planted().extract([image])
    assert sorted({*found.keypoints[:, 1].tolist()}) == expected
    assert len(found) == 4 * len(expected)  # of 5 cells in a row; in the last, x = 37 is too close to the right


def test_gray_and_color(extractor: SuperPointExtractor, monkeypatch: pytest.MonkeyPatch) -> None:
    gray = photograph(3, 48, 64)
    same, again = extractor.extract([np.repeat(gray[:, :, None], 3, axis=2), gray])
    assert_equal(same, again)
    red = np.zeros((40, 40, 3), np.uint8)
    red[8:16, 8:16, 0] = 255
    monkeypatch.setattr(SuperPointExtractor, "min_response", 0.2)
    (found,) = planted().extract([red])
    gray_of_red = 76  # of 255, by ITU-R BT.601
    expected = torch.tensor([40 * gray_of_red / 255, 10] + 63 * [0.0]).softmax(0)[0]
    assert found.scores[0] == pytest.approx(float(expected), rel=1e-3)


def test_a_batch_is_its_images_one_by_one(extractor: SuperPointExtractor) -> None:
    sizes = [(48, 64), (50, 70), (48, 64), (64, 48), (48, 64), (7, 5)]
    images = [photograph(seed, *size) for seed, size in enumerate(sizes)]
    images.append(np.full((48, 64), 128, np.uint8))
    together = extractor.extract(images)
    assert len({len(found) for found in together}) > 2
    for image, found in zip(images, together, strict=True):
        assert_equal(found, extractor.extract([image])[0])


def test_what_does_not_fit_is_halved(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    extractor = SuperPointExtractor(random_state(), device="cpu", dtype="float32", batch_size=4)
    images = [photograph(seed, 48, 64) for seed in range(5)]
    expected = extractor.extract(images)
    forward = extractor._model.encoder.forward

    def limited(pixels: torch.Tensor) -> Any:
        if len(pixels) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return forward(pixels)

    monkeypatch.setattr(extractor._model.encoder, "forward", limited)
    for found, wanted in zip(extractor.extract(images), expected, strict=True):
        assert_equal(found, wanted)
    assert "images do not fit the memory of cpu" in caplog.text


def test_nothing_to_find() -> None:
    extractor = planted()
    black = np.zeros((40, 60), np.uint8)
    white = np.full((40, 60), 255, np.uint8)
    assert extractor.extract([]) == []
    nothing, something = extractor.extract([black, white])
    assert len(nothing) == 0 < len(something)
    assert nothing.keypoints.shape == (0, 2)
    assert nothing.descriptors.shape == (0, 256)
    assert nothing.image_size == (60, 40)


def test_the_fingerprint_tells_weights_and_settings_apart(extractor: SuperPointExtractor) -> None:
    assert planted(batch_size=7).settings == planted().settings
    assert planted().settings["weights"] != extractor.settings["weights"]
    assert planted(max_keypoints=9).settings != planted("bfloat16", max_keypoints=9).settings != planted().settings


@pytest.mark.parametrize(("wrong", "named"), [
    ({"max_keypoint": 3}, "'max_keypoint'.*max_keypoints"),
    ({"max_keypoints": 0}, "max_keypoints"),
    ({"dtype": "float8"}, "dtype_compute is 'float8'"),
])  # fmt: skip
def test_wrong_settings(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ManifestError, match=named):
        planted(**wrong)


@pytest.mark.parametrize("image", [np.zeros((8, 8)), np.zeros((8, 8, 4), np.uint8), np.zeros((0, 8), np.uint8)])
def test_not_an_image(extractor: SuperPointExtractor, image: NDArray[Any]) -> None:
    with pytest.raises(ValueError, match="expected uint8"):
        extractor.extract([image])


@pytest.mark.parametrize("part", ["encoder.conv_blocks.0.conv_a.bias", "descriptor_decoder.conv_descriptor_b.bias"])
def test_weights_that_are_not_finite(part: str) -> None:
    state = planted_state()
    state[part] = torch.full_like(state[part], torch.nan)
    with pytest.raises(ToolkitError, match="not finite"):
        SuperPointExtractor(state, device="cpu", dtype="float32").extract([np.full((40, 40), 255, np.uint8)])


def test_other_weights() -> None:
    state = random_state()
    del state["encoder.conv_blocks.0.conv_a.bias"]
    state |= {"extra": torch.ones(1), "keypoint_decoder.conv_score_b.bias": torch.ones(64)}
    with pytest.raises(WeightsError) as caught:
        SuperPointExtractor(state, device="cpu")
    message = str(caught.value)
    assert "not weights of SuperPoint, which has 24 keys" in message
    assert "1 missing: encoder.conv_blocks.0.conv_a.bias" in message
    assert "1 unexpected: extra" in message
    assert "keypoint_decoder.conv_score_b.bias found (64,)" in message
