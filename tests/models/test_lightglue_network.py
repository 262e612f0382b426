"""LightGlue's network: the numbers of the authors' code, names of checkpoints, padding, and SDPA beside oneDNN."""

import re

import numpy as np
import pytest
import torch

from toolkit.errors import WeightsError
from toolkit.features.features import LocalFeatures
from toolkit.features.lightglue import LightGlueMatcher
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


def run(network: LightGlue, counts: tuple[int, int], padding: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
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
    partners, scores = network((xy[0], xy[1]), (encoded[0], encoded[1]), (masks[0], masks[1]))
    return partners[:, : counts[0]], scores[:, : counts[0]]


def test_same_as_the_authors_code(learned_weights: None) -> None:
    """Their numbers, in float64, for ALIKED's weights; pixel centers at whole numbers."""
    n = np.arange(24)

    def features(second: int) -> LocalFeatures:
        order = (5 * n + 3) % 24 if second else n
        rows, columns = n[:, None] + 1.0, np.arange(128) + 1.0
        vectors = np.sin((rows * columns) ** 1.5) + 0.6 * second * np.sin(((rows + 1) * (columns + 2)) ** 1.3)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        xy = np.stack([(n * 137.5 + 20) % 600, (n * 71.3 + 30) % 440], axis=1) + second * np.array([25, -10])
        ones = np.ones(24, np.float32)
        return LocalFeatures(xy[order].astype(np.float32), ones, ones, vectors[order].astype(np.float32), (640, 480))

    first = [0, 1, 2, 3, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 19, 20, 21, 23]
    partners = [9, 14, 19, 0, 15, 20, 1, 6, 11, 16, 21, 2, 7, 12, 17, 8, 13, 18, 4]
    scores = [
        0.72433, 0.38928, 0.97317, 0.30001, 0.49498, 0.85667, 0.80379, 0.71992, 0.25934, 0.33423, 0.28127, 0.99272,
        0.89253, 0.80731, 0.14003, 0.66726, 0.94331, 0.87545, 0.24683,
    ]  # fmt: skip
    matcher = LightGlueMatcher(device="cpu", dtype="float32", features="aliked")
    (matches,) = matcher.match([(features(0), features(1))])
    assert matches.indices.T.tolist() == [first, partners]
    np.testing.assert_allclose(matches.scores, scores, atol=2e-5)


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
    with pytest.raises(WeightsError, match=r"1 unexpected: .*3\.cross_attention\.k_proj\.bias"):
        LightGlueMatcher(hub, "cpu", features="aliked")


def test_loaded_tensors_are_not_changed(state: State) -> None:
    before = {name: value.clone() for name, value in state.items()}
    LightGlueMatcher(state, "cpu", "float32", features="aliked")
    assert all(torch.equal(value, before[name]) for name, value in state.items())


@torch.inference_mode()
def test_padding_and_the_products_of_torch_change_nothing(network: LightGlue, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = run(network, (300, 41))
    assert (expected[0] >= 0).sum() > 10
    padded = run(network, (300, 41), padding=7)
    monkeypatch.setattr(lightglue, "has_onednn", lambda x: False)
    for partners, scores in (padded, run(network, (300, 41))):
        assert torch.equal(partners, expected[0])
        torch.testing.assert_close(scores, expected[1], rtol=1e-4, atol=1e-6)


def test_other_kinds_weights_are_refused(state: State) -> None:
    with pytest.raises(WeightsError, match=r"2 unexpected: input_proj\.weight"):
        LightGlueMatcher(state, "cpu")
    assert state["posenc.Wr.weight"].shape == (DIM // 8, 2)
