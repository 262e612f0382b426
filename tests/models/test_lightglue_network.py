"""LightGlue's network: the numbers of the authors' code, names of checkpoints, padding, and SDPA beside oneDNN."""

import re

import numpy as np
import pytest
import torch

from toolkit.errors import WeightsError
from toolkit.features.features import LocalFeatures
from toolkit.features.network import LightGlueMatcher
from toolkit.models import lightglue
from toolkit.models.lightglue import DIM, LightGlue, official_names

State = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def state() -> State:
    """Random weights of ALIKED's LightGlue."""
    generator = torch.Generator().manual_seed(0)
    shapes = LightGlue(128).state_dict()
    return {
        name: torch.ones(value.shape)
        if name.endswith("ffn.1.weight")
        else torch.randn(value.shape, generator=generator) * (0.3 / value[0].numel()) ** 0.5
        for name, value in shapes.items()
    }


@pytest.fixture(scope="module")
def network(state: State) -> LightGlue:
    network = LightGlue(128)
    network.load_state_dict(state)
    network.fold_(torch.float32)
    return network


def run(
    network: LightGlue, counts: tuple[int, int], padding: int = 0, adaptive: bool = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """Match made-up features, of which each image has some more that are masked."""
    generator = torch.Generator().manual_seed(1)
    inputs = [torch.randn(1, max(counts), channels, generator=generator) for channels in (2, 128)]
    xy, encoded, masks = [], [], []
    for count in counts:
        points, descriptors = (torch.nn.functional.pad(x[:, :count], (0, 0, 0, padding)) for x in inputs)
        mask = torch.arange(count + padding)[None] < count if padding else None
        xy.append(points)
        encoded.append(network.encode(points, descriptors, mask))
        masks.append(mask)
    partners, scores = network((xy[0], xy[1]), (encoded[0], encoded[1]), (masks[0], masks[1]), adaptive)
    return partners[:, : counts[0]], scores[:, : counts[0]]


def made_up(second: int, count: int, step: int, spread: int) -> LocalFeatures:
    """Return features in float32 that anyone can make again, for the numbers of the authors' code."""
    n = np.arange(count)
    order = (step * n + 3) % count if second else n
    rows, columns = n[:, None] + 1.0, np.arange(128) + 1.0
    noise = 0.6 * second * (1 + spread * (n[:, None] % 2))
    vectors = np.sin((rows * columns) ** 1.5) + noise * np.sin(((rows + 1) * (columns + 2)) ** 1.3)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    xy = np.stack([(n * 137.5 + 20) % 600, (n * 71.3 + 30) % 440], axis=1) + second * np.array([25, -10])
    ones = np.ones(count, np.float32)
    return LocalFeatures(xy[order].astype(np.float32), ones, ones, vectors[order].astype(np.float32), (640, 480))


# What the authors' code returns in float64 for ALIKED's weights and `made_up`: matches of all layers; after its default
# early stop at layer 4; and after layer 7, where it has dropped 15 and 19 features.
ALL_LAYERS = (
    [0, 1, 2, 3, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 19, 20, 21, 23],
    [9, 14, 19, 0, 15, 20, 1, 6, 11, 16, 21, 2, 7, 12, 17, 8, 13, 18, 4],
    [0.72433, 0.38928, 0.97317, 0.30001, 0.49498, 0.85667, 0.80379, 0.71992, 0.25934, 0.33423, 0.28127, 0.99272,
     0.89253, 0.80731, 0.14003, 0.66726, 0.94331, 0.87545, 0.24683],
)  # fmt: skip
STOPPED = (
    [0, 1, 2, 3, 6, 7, 8, 9, 12, 13, 14, 15, 19, 20, 21],
    [9, 14, 19, 0, 15, 20, 1, 6, 21, 2, 7, 12, 8, 13, 18],
    [0.97059, 0.63008, 0.89299, 0.323, 0.7224, 0.58505, 0.3312, 0.53618, 0.10978, 0.99449, 0.98864, 0.85684, 0.88008,
     0.77375, 0.57872],
)  # fmt: skip
DROPPED = (
    [0, 2, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 28, 30, 32, 33, 34, 36, 38, 40, 41, 42, 44, 46],
    [27, 41, 21, 35, 1, 15, 29, 43, 9, 23, 37, 3, 31, 45, 11, 18, 25, 39, 5, 19, 26, 33, 47, 13],
    [0.63704, 0.95933, 0.60284, 0.88305, 0.57625, 0.98401, 0.94078, 0.6175, 0.82174, 0.96541, 0.50414, 0.60258,
     0.90455, 0.28563, 0.98856, 0.77345, 0.72088, 0.44497, 0.96567, 0.80452, 0.14506, 0.36059, 0.90001, 0.9924],
)  # fmt: skip


@pytest.mark.parametrize(
    ("adaptive", "made", "expected"),
    [(False, (24, 5, 0), ALL_LAYERS), (True, (24, 5, 0), STOPPED), (True, (48, 7, 9), DROPPED)],
)
def test_same_as_the_authors_code(
    learned_weights: None,
    monkeypatch: pytest.MonkeyPatch,
    adaptive: bool,
    made: tuple[int, int, int],
    expected: tuple[list[int], list[int], list[float]],
) -> None:
    matcher = LightGlueMatcher(device="cpu", dtype="float32", features="aliked")
    monkeypatch.setattr(matcher, "_one_by_one", adaptive)
    (matches,) = matcher.match([(made_up(0, *made), made_up(1, *made))])
    assert matches.indices.T.tolist() == [*expected[:2]]
    np.testing.assert_allclose(matches.scores, expected[2], atol=2e-5)


@torch.inference_mode()
def test_an_image_without_features_left_matches_nothing(state: State, monkeypatch: pytest.MonkeyPatch) -> None:
    network = LightGlue(128)
    network.load_state_dict({**state, "log_assignment.0.matchability.bias": torch.tensor([-100.0])})
    network.fold_(torch.float32)
    monkeypatch.setattr(network, "_is_confident", lambda states, number: torch.full((len(states),), len(states) == 20))
    for counts in ((30, 20), (20, 30)):
        partners, scores = run(network, counts, adaptive=True)
        assert (partners == -1).all()
        assert not scores.any()


def test_names_of_the_authors_first_files(state: State) -> None:
    first = {re.sub(r"transformers\.(\d+)\.(self|cross)_attn", r"\2_attn.\1", name): state[name] for name in state}
    renamed = official_names(first)
    assert first.keys() != state.keys() == renamed.keys()
    assert all(renamed[name] is value for name, value in state.items())


def test_names_of_the_hub(state: State) -> None:
    """What the hub's conversion does: queries, keys and values apart, and those across images twice."""
    hub = dict(state)
    for number in range(9):
        for kind in ("weight", "bias"):
            packed = hub.pop(f"transformers.{number}.self_attn.Wqkv.{kind}").unflatten(0, (-1, 3))
            for part, value in zip(("q_proj", "k_proj", "v_proj"), packed.unbind(1), strict=True):
                hub[f"transformer_layers.{number}.self_attention.{part}.{kind}"] = value
            across = hub.pop(f"transformers.{number}.cross_attn.to_qk.{kind}")
            for part in ("q_proj", "k_proj"):
                hub[f"transformer_layers.{number}.cross_attention.{part}.{kind}"] = across
    matcher = LightGlueMatcher(hub, "cpu", features="aliked")
    assert matcher.settings == LightGlueMatcher(state, "cpu", features="aliked").settings
    hub["transformer_layers.3.cross_attention.k_proj.bias"] = across + 1
    assert state["posenc.Wr.weight"].shape == (DIM // 8, 2)
    for given, features, named in (
        (hub, "aliked", r"1 unexpected: .*3\.cross_attention\.k_proj\.bias"),
        (state, "superpoint", r"2 unexpected: input_proj\.weight"),  # those of another kind
    ):
        with pytest.raises(WeightsError, match=named):
            LightGlueMatcher(given, "cpu", features=features)


def test_loaded_tensors_are_not_changed(state: State) -> None:
    before = {name: value.clone() for name, value in state.items()}
    LightGlueMatcher(state, "cpu", "float32", features="aliked")
    assert all(torch.equal(value, before[name]) for name, value in state.items())


@pytest.mark.slow
@torch.inference_mode()
def test_padding_and_the_products_of_torch_change_nothing(network: LightGlue, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = run(network, (300, 41))
    assert (expected[0] >= 0).sum() > 10
    padded = run(network, (300, 41), padding=7)
    monkeypatch.setattr(lightglue, "has_onednn", lambda x: False)
    for partners, scores in (padded, run(network, (300, 41))):
        assert torch.equal(partners, expected[0])
        torch.testing.assert_close(scores, expected[1], rtol=1e-4, atol=1e-6)
