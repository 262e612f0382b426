"""On a GPU: the official numbers in each precision, memory that runs out, and the whole chain; see `make test-gpu`."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from tests.features.test_aliked import SETTINGS, Small
from tests.features.test_lightglue import features
from tests.features.test_lightglue import state as lightglue_state
from tests.features.test_superpoint import planted_state
from tests.golden import da3
from tests.models.test_aliked_network import photograph
from tests.models.test_aliked_network import random_state as aliked_state
from tests.models.test_megaloc import golden
from toolkit import pipeline
from toolkit.embedders.megaloc import MegaLocEmbedder
from toolkit.errors import ToolkitError
from toolkit.features.network import LightGlueMatcher, NetworkExtractor, SuperPointExtractor
from toolkit.manifest import AlikedSettings
from toolkit.models.compute import full_float32
from toolkit.models.da3 import DepthAnything3, choose_reference
from toolkit.models.megaloc import MegaLoc
from toolkit.models.omega import VGGTOmega
from toolkit.models.vggt import VGGT
from toolkit.pose.base import View
from toolkit.prediction import network
from toolkit.prediction.network import NetworkPredictor

__all__ = ["golden", "lightglue_state"]  # fixtures

GPU = torch.device("cuda")
pytestmark = pytest.mark.gpu


@pytest.fixture(autouse=True)
def gpu() -> Iterator[None]:
    """Skips where torch has no GPU; gives back the memory and the choices that a test has made."""
    if not torch.cuda.is_available():
        pytest.skip("needs a GPU that torch can use: torch.cuda.is_available() is False")
    with torch.inference_mode():
        yield
    network._loaded.clear()
    torch.cuda.set_per_process_memory_fraction(1.0)
    torch.cuda.empty_cache()
    torch.backends.cuda.matmul.fp32_precision = "none"


def random_weights(model: nn.Module, path: Path) -> Path:
    """Write weights of a network that was made on the device `meta` that keep activations finite."""
    generator = torch.Generator().manual_seed(0)
    made = {}
    for name, value in model.state_dict().items():
        if "norm" in name and name.endswith("weight"):
            made[name] = torch.ones(value.shape)
        elif name.endswith("bias"):
            made[name] = torch.zeros(value.shape)
        else:
            fan_in = value.shape[1:].numel() if value.ndim > 1 else 1000
            made[name] = torch.randn(value.shape, generator=generator) / max(fan_in, 1) ** 0.5
    save_file(made, path)
    return path


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Random weights of the official names and sizes."""
    folder = tmp_path_factory.mktemp("weights")
    with torch.device("meta"):
        models = {"megaloc": MegaLoc(), "vggt": VGGT(("camera", "depth"))}
    return {name: random_weights(model, folder / f"{name}.safetensors") for name, model in models.items()}


# ------------------------------------------------------------------------------------------ the official numbers


def run_as(precision: str, run: Callable[[], dict[str, Tensor]]) -> dict[str, NDArray[np.float32]]:
    """Return what a network that is in the precision gives; float32 in full, tf32 as torch's flags allow it."""
    if precision == "tf32":
        torch.backends.cuda.matmul.fp32_precision = "tf32"
        found = run()
    else:
        with full_float32(GPU):
            found = run()
    return {name: value.float().cpu().numpy() for name, value in found.items()}


PRECISIONS = [("float32", 1e-3, 1e-6), ("tf32", 3e-2, 1e-4), ("bfloat16", 1e-1, 1e-4)]
"""Each with the largest difference of cameras and, in the median, depths, and of the cosine of MegaLoc."""


@pytest.mark.parametrize(("precision", "_", "least"), PRECISIONS)
def test_megaloc_gives_the_official_numbers(golden: ModuleType, precision: str, _: float, least: float) -> None:
    model = MegaLoc.from_checkpoint(golden.state("megaloc"))
    model.compute_in(torch.bfloat16 if precision == "bfloat16" else torch.float32)
    model.to(GPU)
    for case, spec in golden.info("megaloc")["cases"].items():
        images = golden.case_images("megaloc", spec).to(GPU)
        found = run_as(precision, lambda images=images: {"d": model(images)})["d"]
        cosines = (found * golden.expected("megaloc", case)["descriptor"]).sum(axis=1)
        print(f"MegaLoc, {precision}, case {case}: 1 - cosine at most {1 - cosines.min():.1e}")
        assert cosines.min() > 1 - least


@pytest.mark.parametrize(("precision", "most", "_"), PRECISIONS)
@pytest.mark.parametrize(("network", "name"), [(VGGT, "vggt"), (VGGTOmega, "omega")])
def test_cameras_and_depth_are_the_official_numbers(
    golden: ModuleType, network: type[VGGT | VGGTOmega], name: str, precision: str, most: float, _: float
) -> None:
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    model = network.from_checkpoint(golden.state(name), ("camera", "depth"), dtype).to(GPU)
    for case, spec in golden.info(name)["cases"].items():
        images, expected = golden.case_images(name, spec).to(GPU), golden.expected(name, case)
        output = run_as(precision, lambda images=images: {k: model(images[None])[k] for k in ("pose_enc", "depth")})
        cameras = np.abs(output["pose_enc"] - expected["pose_enc"]).max()
        depths = np.median(np.abs(output["depth"] / expected["depth"] - 1))
        print(f"{name}, {precision}, case {case}: cameras within {cameras:.1e}, depths within {depths:.1e} (median)")
        assert max(cameras, depths) < most


@pytest.mark.parametrize(("precision", "most", "_"), PRECISIONS)
@pytest.mark.parametrize("size", da3.SIZES)
def test_depth_anything_3_gives_the_official_numbers(size: str, precision: str, most: float, _: float) -> None:
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    model = DepthAnything3.from_checkpoint(da3.state(da3.shapes(size)), compute_dtype=dtype).to(GPU)
    for case, reference in da3.info()["references"][size].items():
        given = da3.inputs(case)
        given["images"] = given["images"].to(GPU)
        chosen = int(choose_reference(model.encode(given["images"])[None, :, 0], "saddle_balanced"))
        if case == "four" and chosen != reference:
            assert precision == "bfloat16", "another view is the reference, as rounding may decide"
            continue
        output = run_as(precision, lambda given=given: {k: model(**given)[k][0] for k in ("pose_enc", "depth")})
        expected = da3.expected(f"{size}/{case}")
        found = da3.sampled(output)
        cameras = np.abs(found["pose_enc"] - expected["pose_enc"]).max()
        depths = np.median(np.abs(found["depth"] / expected["depth"] - 1))
        print(f"{size}, {precision}, case {case}: cameras within {cameras:.1e}, depths within {depths:.1e} (median)")
        assert max(cameras, depths) < most


def test_attention_is_flash_attention(weights: dict[str, Path]) -> None:
    """Torch raises where it cannot use it."""
    megaloc = MegaLoc.from_checkpoint(weights["megaloc"])
    megaloc.compute_in(torch.bfloat16)
    vggt = VGGT.from_checkpoint(weights["vggt"], ("camera",), torch.bfloat16).to(GPU)
    with sdpa_kernel(SDPBackend.FLASH_ATTENTION):
        megaloc.to(GPU)(torch.rand(2, 3, 322, 322, device=GPU))
        tokens = vggt.encode(torch.rand(3, 3, 294, 518, device=GPU))
        vggt.aggregator(tokens[None], 21, 37, {23}, True)


# ----------------------------------------------------------------------------------------------------- memory


def photographs(count: int, size: tuple[int, int] = (518, 294)) -> list[NDArray[np.uint8]]:
    return [np.random.default_rng(seed).integers(0, 256, (*size[::-1], 3), np.uint8) for seed in range(count)]


def group(count: int) -> list[View]:
    camera = pycolmap.Camera(model="PINHOLE", width=518, height=294, params=[500, 500, 259, 147])
    return [View(f"{n}", image, camera, n > 0) for n, image in enumerate(photographs(count))]


def leave(needed: float) -> None:
    """Let the process have so many bytes beside those that it holds."""
    torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(GPU).total_memory
    torch.cuda.set_per_process_memory_fraction((torch.cuda.memory_reserved(GPU) + needed) / total)


def test_megaloc_goes_on_in_smaller_batches(weights: dict[str, Path], caplog: pytest.LogCaptureFixture) -> None:
    embedder = MegaLocEmbedder(weights["megaloc"], "cuda", "float32")
    images = photographs(64)
    embedder.embed(images[:1])  # cuBLAS allocates its workspace at the first use, and keeps it
    baseline = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    expected = embedder.embed(images)
    leave((torch.cuda.max_memory_allocated() - baseline) / 3)
    with caplog.at_level(logging.WARNING):
        found = embedder.embed(images)
    assert "images do not fit the memory of cuda" in caplog.text
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert torch.cuda.memory_allocated() == baseline


def test_vggt_goes_on_with_what_fits(weights: dict[str, Path], caplog: pytest.LogCaptureFixture) -> None:
    predictor = NetworkPredictor(weights["vggt"], "cuda", "float32", batch_size=24, cache_bytes=0)
    predictor.predict([group(2)])
    baseline = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    [expected] = predictor.predict([group(6)])
    leave(1.5 * (torch.cuda.max_memory_allocated() - baseline))
    with caplog.at_level(logging.WARNING):
        found = predictor.predict([group(6) for _ in range(24)])
    assert "24 groups of 6 views do not fit the memory of cuda" in caplog.text
    for one in found:
        np.testing.assert_allclose(one.model_from_cams, expected.model_from_cams, atol=1e-3)
    assert torch.cuda.memory_allocated() == baseline


def test_weights_that_do_not_fit_end_the_run(weights: dict[str, Path]) -> None:
    leave(100e6)
    with pytest.raises(ToolkitError, match=r"memory of cuda.* does not hold the weights of VGGT"):
        NetworkPredictor(weights["vggt"], "cuda", "float32").predict([group(2)])


# ---------------------------------------------------------------------------------------------- local features


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
@pytest.mark.parametrize(
    "make",
    [
        lambda device, dtype: Small(aliked_state(), device, dtype, settings=AlikedSettings.of(SETTINGS)),
        lambda device, dtype: SuperPointExtractor(planted_state(), device, dtype),
    ],
    ids=["aliked", "superpoint"],
)
def test_extractors_under_autocast(make: Callable[[str, str], NetworkExtractor], precision: str) -> None:
    images = [photograph(96, 640) for _ in range(3)]
    here, there = make("cpu", "float32"), make("cuda", precision)
    for exact, rough in zip(here.extract(images), there.extract(images), strict=True):
        assert abs(len(rough) - len(exact)) <= 0.1 * len(exact)
        distance = np.linalg.norm(rough.keypoints[:, None] - exact.keypoints, axis=2).min(axis=1)
        assert np.median(distance) < 0.1


@pytest.mark.parametrize("precision", ["float32", "bfloat16", "float16"])
def test_lightglue_under_autocast(lightglue_state: dict[str, Tensor], precision: str) -> None:
    pairs = [(features(1, 180), features(2, 150)), (features(1, 180), features(3, 200))]
    exact = LightGlueMatcher(lightglue_state, device="cpu", dtype="float32").match(pairs)
    rough = LightGlueMatcher(lightglue_state, device="cuda", dtype=precision).match(pairs)
    for one, other in zip(exact, rough, strict=True):
        same = set(map(tuple, one.indices.tolist())) & set(map(tuple, other.indices.tolist()))
        assert len(same) > 0.9 * len(one.indices)


# ------------------------------------------------------------------------------------------------ the whole chain


def test_the_chain_with_every_network(
    small_capture: Path, weights: dict[str, Path], lightglue_state: dict[str, Tensor], tmp_path: Path
) -> None:
    """With random weights poses mean nothing, but each query has a row that says what came of it."""
    superpoint, lightglue = tmp_path / "superpoint.pth", tmp_path / "lightglue.pth"
    torch.save(planted_state(), superpoint)
    torch.save(lightglue_state, lightglue)
    settings: dict[str, Any] = {
        "output_root": str(tmp_path),
        "embed": {"model": "megaloc", "checkpoint": str(weights["megaloc"]), "compute_device": "cuda"},
        "localize": {
            "method": "hybrid",
            "compute_device": "cuda",
            "features": {"kinds": ["sift", "superpoint"], "checkpoint": str(superpoint)},
            "matcher": {"name": "lightglue", "checkpoint": str(lightglue)},
            "predictor": {"checkpoint": str(weights["vggt"])},
        },
        "retrieve": {"use_faiss": False, "compute_device": "cuda"},
    }
    manifest = tmp_path / "all.yaml"
    manifest.write_text(f"captures: ['{small_capture}']\n")
    overrides = [f"{key}={value}" for key, value in flat(settings)]
    run = pipeline.run(manifest, overrides=overrides, say=lambda *a, **k: None)
    tables = [pd.read_csv(path) for path in (run / "SMALL" / "poses").glob("*.csv")]
    assert len(tables) == 9
    assert all(len(table) and table["status"].notna().all() for table in tables)


def flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
