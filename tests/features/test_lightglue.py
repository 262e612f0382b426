"""LightGlue: the same as the package's own forward, batches that change nothing, and what is refused."""

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from toolkit.errors import ManifestError, ToolkitError, WeightsError
from toolkit.features.features import LocalFeatures, PairMatches
from toolkit.features.network import LightGlueMatcher, _pack

transformers = pytest.importorskip("transformers", reason="needs the extra `learned`")

State = dict[str, torch.Tensor]


def network(**settings: Any) -> Any:
    detector = transformers.SuperPointConfig(border_removal_distance=0)
    return transformers.LightGlueForKeypointMatching(
        transformers.LightGlueConfig(keypoint_detector_config=detector, **settings)
    )


def random_state() -> State:
    """Random weights of the official names and shapes that match alike descriptors."""
    generator = torch.Generator().manual_seed(0)
    with torch.device("meta"):
        shapes = network().state_dict()
    made = {}
    for name, value in shapes.items():
        if name.endswith("layer_norm.weight"):
            made[name] = torch.ones(value.shape)
        elif name.endswith("weight"):
            gain = 2 if name.startswith("keypoint_detector") else 0.3
            made[name] = torch.randn(value.shape, generator=generator) * (gain / max(value[0].numel(), 1)) ** 0.5
        else:
            made[name] = 0.1 * torch.randn(value.shape, generator=generator)
    for name in [name for name in made if "cross_attention.k_proj" in name]:
        made[name.replace("k_proj", "q_proj")] = made[name]  # as in the official file
    made["positional_encoder.projector.weight"] *= 5
    made["match_assignment_layers.8.final_projection.weight"] = 10 * torch.eye(256)
    made["match_assignment_layers.8.matchability.bias"] += 4
    return made


@pytest.fixture(scope="module")
def state() -> State:
    return random_state()


@pytest.fixture(scope="module")
def matcher(state: State) -> LightGlueMatcher:
    return LightGlueMatcher(state, device="cpu", dtype="float32", batch_size=3)


def features(seed: int, count: int, size: tuple[int, int] = (640, 480)) -> LocalFeatures:
    """Features of which the first are alike whatever the seed, but for some noise."""
    common, own = np.random.default_rng(99), np.random.default_rng(seed)
    descriptors = common.normal(size=(200, 256))[:count] + 0.3 * own.normal(size=(count, 256))
    keypoints = common.uniform(0, 1, (200, 2))[:count] * size
    order = own.permutation(count)
    return LocalFeatures(
        keypoints[order].astype(np.float32),
        np.ones(count, np.float32),
        np.linspace(1, 0.1, count, dtype=np.float32),
        (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))[order].astype(np.float16),
        size,
    )


def assert_equal(found: PairMatches, expected: PairMatches) -> None:
    np.testing.assert_array_equal(found.indices, expected.indices)
    np.testing.assert_allclose(found.scores, expected.scores, rtol=1e-3)


def test_same_as_the_network_of_the_package(state: State) -> None:
    """If this fails with a newer transformers: its parts have changed that `_forward` calls."""
    least = 1e-6  # few features of noise are alike
    matcher = LightGlueMatcher(state, device="cpu", dtype="float32", min_score=least)
    first = np.random.default_rng(0).integers(0, 256, (64, 96), np.uint8)
    images = [first, np.roll(first, 8, axis=1), np.rot90(first, 2).copy()]
    pixels = torch.stack([torch.from_numpy(image)[None].float() / 255 for image in images])
    whole = network(depth_confidence=-1.0, width_confidence=-1.0, filter_threshold=least).eval()
    whole.load_state_dict(state)
    with torch.inference_mode():
        output = whole(torch.stack([pixels[[0, 1]], pixels[[2, 0]]]))
        detected = whole.keypoint_detector(pixels)
    shown = [
        LocalFeatures(
            (keypoints * torch.tensor([96, 64])).round().numpy()[mask] + np.float32(0.5),
            np.ones(mask.sum(), np.float32),
            scores.numpy()[mask],
            descriptors.numpy()[mask],
            (96, 64),
        )
        for keypoints, scores, descriptors, mask in zip(
            detected.keypoints, detected.scores, detected.descriptors, detected.mask.numpy() > 0, strict=True
        )
    ]
    found = matcher.match([(shown[0], shown[1]), (shown[2], shown[0])])
    partners = output.matches.reshape(2, 2, -1)[:, 0].numpy()
    confidence = output.matching_scores.reshape(2, 2, -1)[:, 0].numpy()
    assert min(map(len, found)) > 5
    for matches, partner, score in zip(found, partners, confidence, strict=True):
        rows = np.flatnonzero(partner >= 0)
        np.testing.assert_array_equal(matches.indices, np.stack([rows, partner[rows]], axis=1))
        np.testing.assert_allclose(matches.scores, score[rows], rtol=1e-2)


def test_alike_features_match(matcher: LightGlueMatcher) -> None:
    a, b = features(1, 150), features(2, 150)
    (found,) = matcher.match([(a, b)])
    assert found.indices.dtype == np.int64
    assert found.scores.dtype == np.float32
    assert len(found) > 50
    assert ((found.scores > 0.1) & (found.scores <= 1)).all()
    for column in found.indices.T:
        assert len(np.unique(column)) == len(column)
    true = np.linalg.norm(a.keypoints[found.indices[:, 0]] - b.keypoints[found.indices[:, 1]], axis=1) < 1e-3
    assert true.mean() > 0.9


def test_the_order_of_the_images_does_not_count(matcher: LightGlueMatcher) -> None:
    a, b = features(1, 60), features(2, 90, (480, 640))
    forth, back = matcher.match([(a, b), (b, a)])
    assert len(forth) > 10
    assert {*map(tuple, forth.indices.tolist())} == {(i, j) for j, i in back.indices.tolist()}


@pytest.mark.slow
@pytest.mark.parametrize("by_itself", [True, False])
def test_pairs_do_not_depend_on_each_other(
    matcher: LightGlueMatcher, monkeypatch: pytest.MonkeyPatch, by_itself: bool
) -> None:
    """On a CPU, where each pair runs alone, not by a bit; in batches, as on a GPU, but for rounding."""
    counts = [(50, 80), (3, 120), (120, 120), (1, 1), (0, 70), (70, 0), (20, 21), (99, 5)]
    sizes = [(640, 480), (480, 640), (1920, 1440), (64, 64)]
    pairs = [
        (features(2 * k, a, sizes[k % 4]), features(2 * k + 1, b, sizes[(k + 1) % 4]))
        for k, (a, b) in enumerate(counts)
    ]
    pairs += [(pairs[0][0], pairs[2][1]), (pairs[0][0], pairs[0][0]), pairs[0]]  # images that are in several pairs
    alone = [matcher.match([pair])[0] for pair in pairs]
    assert matcher._one_by_one
    monkeypatch.setattr(matcher, "_one_by_one", by_itself)
    together = matcher.match(pairs)
    assert sum(len(found) > 0 for found in together) >= 8
    for found, expected in zip(together, alone, strict=True):
        assert_equal(found, expected)
        if by_itself:
            np.testing.assert_array_equal(found.scores, expected.scores)


def test_an_image_in_several_pairs_is_encoded_once(matcher: LightGlueMatcher, monkeypatch: pytest.MonkeyPatch) -> None:
    encoded = []
    encode = matcher._model.encode
    monkeypatch.setattr(matcher._model, "encode", lambda xy, *others: encoded.append(len(xy)) or encode(xy, *others))
    query = features(0, 30)
    matcher.match([(query, features(k, 30)) for k in range(1, 5)])
    assert sum(encoded) == 5


def test_what_does_not_fit_is_halved(
    state: State, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    matcher = LightGlueMatcher(state, device="cpu", dtype="float32", batch_size=4)
    monkeypatch.setattr(matcher, "_one_by_one", False)
    pairs = [(features(k, 20 + k), features(k + 1, 40 - k)) for k in range(5)]
    expected = matcher.match(pairs)
    assign = matcher._model._assign

    def limited(a: torch.Tensor, *others: Any) -> Any:
        if len(a) > 2:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return assign(a, *others)

    monkeypatch.setattr(matcher._model, "_assign", limited)
    for found, wanted in zip(matcher.match(pairs), expected, strict=True):
        assert_equal(found, wanted)
    assert "pairs of images do not fit the memory of cpu" in caplog.text


def test_nothing_to_match(matcher: LightGlueMatcher) -> None:
    nothing, something = features(0, 0), features(1, 9)
    assert matcher.match([]) == []
    for found in matcher.match([(nothing, something), (something, nothing), (nothing, nothing)]):
        assert found.indices.shape == (0, 2)
        assert found.scores.shape == (0,)


def test_an_unreadable_image_matches_nothing(matcher: LightGlueMatcher) -> None:
    """Its features have no descriptors, in the type and length of another kind."""
    unreadable, pair = LocalFeatures.none((640, 480)), (features(1, 9), features(2, 9))
    found = matcher.match([(pair[0], unreadable), pair, (unreadable, pair[1])])
    assert [len(found[0]), len(found[2])] == [0, 0]
    assert_equal(found[1], matcher.match([pair])[0])


def test_positions_are_those_of_training() -> None:
    corners = np.array([[0.5, 0.5], [320.5, 240.5], [640.5, 480.5]], np.float32)
    packed = _pack(replace(features(0, 3), keypoints=corners))
    np.testing.assert_allclose(packed[:, :2], [[-1, -0.75], [0, 0], [1, 0.75]], atol=1e-6)
    assert packed[:, -1].tolist() == [1, 1, 1]


def test_bfloat16_finds_much_the_same(state: State, matcher: LightGlueMatcher) -> None:
    pair = features(1, 40), features(2, 40)
    (exact,), (coarse,) = matcher.match([pair]), LightGlueMatcher(state, "cpu", "bfloat16").match([pair])
    common = {*map(tuple, exact.indices.tolist())} & {*map(tuple, coarse.indices.tolist())}
    assert len(common) > 0.9 * len(exact)


def test_the_threshold(state: State, matcher: LightGlueMatcher) -> None:
    pair = features(1, 120), features(2, 120)
    (loose,) = matcher.match([pair])
    least = float(np.median(loose.scores))
    strict = LightGlueMatcher(state, "cpu", "float32", min_score=least)
    assert strict.settings != matcher.settings
    (found,) = strict.match([pair])
    np.testing.assert_array_equal(found.indices, loose.indices[loose.scores > least])


def test_other_features_are_refused(matcher: LightGlueMatcher) -> None:
    sift = replace(features(0, 5), descriptors=np.zeros((5, 128), np.uint8))
    aliked = replace(features(0, 5), descriptors=np.zeros((5, 128), np.float16))
    for other, found in ((sift, "uint8"), (aliked, "float16")):
        with pytest.raises(ToolkitError, match=rf"superpoint, \(N, 256\).*found {found} \(5, 128\).*`mutual`"):
            matcher.match([(features(0, 5), other)])


@pytest.mark.parametrize(("checkpoint", "wrong", "named"), [
    ({}, {"min_score": 1.5}, r"min_score is 1\.5"),
    (None, {"features": "sift"}, r"no weights for 'sift'\. Known: superpoint, aliked"),
])  # fmt: skip
def test_wrong_settings(checkpoint: State | None, wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ManifestError, match=named):
        LightGlueMatcher(checkpoint, "cpu", **wrong)


def test_weights_that_are_not_finite(state: State) -> None:
    broken = {**state, "transformer_layers.3.self_mlp.fc2.bias": torch.full((256,), torch.nan)}
    with pytest.raises(ToolkitError, match="not finite"):
        LightGlueMatcher(broken, "cpu", "float32").match([(features(0, 5), features(1, 6))])


def test_the_official_file_with_and_without_its_detector(state: State, matcher: LightGlueMatcher) -> None:
    # What the hub lists: 55 MB.
    assert sum(4 * value.numel() for value in state.values()) == 54_978_376
    alone = {name: value for name, value in state.items() if not name.startswith("keypoint_detector.")}
    assert (len(state), len(alone)) == (329, 305)
    assert LightGlueMatcher(alone, "cpu", "float32").settings == matcher.settings


def test_other_weights(state: State) -> None:
    detector = {
        name.removeprefix("keypoint_detector."): value
        for name, value in state.items()
        if name.startswith("keypoint_detector.")
    }
    with pytest.raises(WeightsError, match="not weights of LightGlue, which has 251 keys; found 24") as caught:
        LightGlueMatcher(detector, "cpu")
    assert "251 missing: posenc.Wr.weight, transformers.0" in str(caught.value)
    assert "24 unexpected: encoder.conv_blocks.0.conv_a.weight" in str(caught.value)


MANY_SHAPES = """
import numpy as np, psutil
from toolkit.features.features import LocalFeatures
from toolkit.features.matching import create_matcher

def features(count):
    descriptors = rng.normal(size=(count, 128)) / 11
    keypoints, ones = rng.uniform(0, 640, (count, 2)), np.ones(count, np.float32)
    return LocalFeatures(keypoints.astype(np.float32), ones, ones, descriptors.astype(np.float16), (640, 640))

rng = np.random.default_rng(0)
matcher = create_matcher("lightglue", device="cpu", features="aliked")
for call in range(12):
    matcher.match([(features(200 + 7 * call), features(100 + 5 * call))] * 2)
    if call == 3:
        before = psutil.Process().memory_info().rss
print((psutil.Process().memory_info().rss - before) // 2**20)
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_numbers_of_features(learned_weights: None) -> None:
    done = subprocess.run([sys.executable, "-c", MANY_SHAPES], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 60, "megabytes; 80 and more where all shapes are kept"
