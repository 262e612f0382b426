"""What runs networks runs them on any device: here on one that refuses to mix devices, float64 and `.numpy()`."""

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.features.test_aliked import SETTINGS, Small
from tests.features.test_aliked import random_state as aliked_state
from tests.features.test_lightglue import features, state
from tests.features.test_superpoint import planted_state
from tests.models import test_da3 as da3
from tests.models import test_omega as omega
from tests.models.test_megaloc import tiny_megaloc
from tests.models.test_vggt import tiny
from tests.prediction.test_network import HIGHER, WIDE, Photographs, assert_same
from tests.pretend import DEVICE, PretendTensor, pretending, resolved
from toolkit.embedders import megaloc, search
from toolkit.embedders.masks import Masks
from toolkit.features import network
from toolkit.features.network import LightGlueMatcher, NetworkExtractor, SuperPointExtractor
from toolkit.manifest import AlikedSettings, SuperPointSettings
from toolkit.models.vggt import VGGT
from toolkit.prediction import network as predictors
from toolkit.prediction.network import NetworkPredictor

__all__ = ["state"]  # a fixture


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Lets `pretend` stand for a device; any other name is resolved as ever."""
    for module in (megaloc, search, network, predictors):
        resolve = module.resolve_device
        monkeypatch.setattr(
            module, "resolve_device", lambda name, resolve=resolve: resolved() if name == "pretend" else resolve(name)
        )
    # torch has no autocast for such a device, and no inference mode for such tensors.
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    monkeypatch.setattr(torch, "inference_mode", torch.no_grad)
    with pretending():
        yield


def test_the_device_refuses_what_an_accelerator_refuses(device: None) -> None:
    there = torch.arange(6.0).to(DEVICE)
    assert there.add_(1) is there
    np.testing.assert_array_equal(there.cpu().numpy(), np.arange(1.0, 7))
    for wrong, error, named in (
        (lambda: there + torch.ones(6), RuntimeError, "same device"),
        (there.numpy, RuntimeError, "numpy"),
        (there.double, TypeError, "float64"),
    ):
        with pytest.raises(error, match=named):
            wrong()


def test_megaloc(device: None) -> None:
    images = [np.random.default_rng(seed).integers(0, 256, (150, 200, 3), np.uint8) for seed in range(3)]
    here, there = (
        megaloc.MegaLocEmbedder(tiny_megaloc(), name, "float32", image_size=126) for name in ("cpu", "pretend")
    )
    assert isinstance(there.stack(images), PretendTensor)
    np.testing.assert_allclose(there.embed(images), here.embed(images), atol=1e-6)
    np.testing.assert_allclose(there.embed(there.stack(images)), here.embed(images), atol=1e-6)


@pytest.mark.slow
def test_vggt(device: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(VGGT, "from_checkpoint", lambda _, heads, compute_dtype: tiny(heads, compute_dtype))
    checkpoint = tmp_path / "model.pt"
    checkpoint.write_bytes(b"stands for weights")
    photographs = Photographs(tmp_path)
    groups = [photographs.group(*sizes) for sizes in ([WIDE] * 3, [HIGHER, WIDE])]
    here, there = (NetworkPredictor(checkpoint, name, "float32") for name in ("cpu", "pretend"))
    expected = here.predict(groups)
    for _ in range(2):  # the second time from what is kept
        for found, other in zip(there.predict(groups), expected, strict=True):
            assert_same(found, other)
    assert there._cache.bytes > 0
    assert not any(isinstance(kept, PretendTensor) for kept in there._cache._kept.values())


def test_omega(device: None) -> None:
    model, images = omega.tiny(), torch.rand(2, 2, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    expected = model(images)
    for name, found in model.to(DEVICE)(images.to(DEVICE)).items():
        assert isinstance(found, PretendTensor)
        torch.testing.assert_close(found.cpu(), expected[name], atol=1e-5, rtol=1e-4)


@pytest.mark.slow
def test_da3(device: None) -> None:
    model, images = da3.tiny(), torch.rand(2, 4, 3, 42, 56, generator=torch.Generator().manual_seed(0))
    expected = model(images)
    for name, found in model.to(DEVICE)(images.to(DEVICE)).items():
        assert isinstance(found, PretendTensor)
        torch.testing.assert_close(found.cpu(), expected[name], atol=1e-5, rtol=1e-4)


def make_aliked(name: str) -> NetworkExtractor:
    return Small(aliked_state(), name, settings=AlikedSettings.of(SETTINGS))


def make_superpoint(name: str) -> NetworkExtractor:
    return SuperPointExtractor(planted_state(), name, "float32", settings=SuperPointSettings(max_keypoints=100))


@pytest.mark.parametrize("make", [make_aliked, make_superpoint])
def test_extractors(device: None, make: object) -> None:
    images = [np.random.default_rng(seed).integers(0, 256, (96, 128, 3), np.uint8) for seed in range(3)]
    for found, expected in zip(make("pretend").extract(images), make("cpu").extract(images), strict=True):  # type: ignore[operator]
        assert len(found) > 10
        np.testing.assert_allclose(found.keypoints, expected.keypoints, atol=1e-3)
        np.testing.assert_allclose(found.descriptors, expected.descriptors, atol=2e-3)


@pytest.mark.slow
def test_lightglue(device: None, state: dict[str, torch.Tensor]) -> None:
    pairs = [(features(1, 60), features(2, 50)), (features(1, 60), features(3, 80))]
    here, there = (LightGlueMatcher(state, device=name, dtype="float32") for name in ("cpu", "pretend"))
    for found, expected in zip(there.match(pairs), here.match(pairs), strict=True):
        np.testing.assert_array_equal(found.indices, expected.indices)
        assert len(found.indices) > 10


def test_search(device: None) -> None:
    rng = np.random.default_rng(0)
    queries, rows = (rng.normal(size=(count, 16)).astype(np.float32) for count in (5, 40))
    masks = Masks(40, np.packbits(rng.random((5, 40)) < 0.5, axis=1, bitorder="little"), np.arange(5))
    for limits in (masks, None):
        found, expected = (
            search._torch_backend(queries, limits, device, (16,))(rows, 0, 3) for device in ("pretend", "cpu")
        )
        np.testing.assert_array_equal(found[1], expected[1])
