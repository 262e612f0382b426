"""MegaLoc: the official numbers where the golden files are, and what holds for any weights on a tiny network."""

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from toolkit.embedders import create_embedder
from toolkit.embedders.megaloc import MegaLocEmbedder
from toolkit.errors import ManifestError, ToolkitError, WeightsError
from toolkit.models.megaloc import MegaLoc, transport


@pytest.fixture(scope="module")
def golden(golden_root: Path) -> Iterator[ModuleType]:
    sys.path.insert(0, str(golden_root))
    yield importlib.import_module("golden")
    sys.path.remove(str(golden_root))


@pytest.fixture(scope="module")
def official(golden: ModuleType) -> MegaLoc:
    return MegaLoc.from_checkpoint(golden.state("megaloc"))


SLOW_CASES = [pytest.param(case, marks=pytest.mark.slow) for case in "bc"]


@pytest.mark.parametrize("case", ["a", *SLOW_CASES])
def test_official_numbers(golden: ModuleType, official: MegaLoc, case: str) -> None:
    images = golden.case_images("megaloc", golden.info("megaloc")["cases"][case])
    seen: dict[str, torch.Tensor] = {}
    hooks = [
        module.register_forward_hook(lambda _, __, output, name=name: seen.__setitem__(name, output))
        for name, module in {
            "block0": official.backbone.blocks[0],
            "backbone": official.backbone,
            "salad": official.aggregator.agg,
        }.items()
    ]
    with torch.inference_mode():
        descriptor = official(images)
    for hook in hooks:
        hook.remove()
    patches, cls_token = seen["backbone"]
    rows, columns = (round(side / 14) for side in images.shape[2:])
    grid = patches.transpose(1, 2).unflatten(2, (rows, columns))
    outputs = {
        "descriptor": descriptor,
        "salad": seen["salad"][:, ::4],
        "cls_token": cls_token,
        "patch_features": grid[:, ::48],
        "block0": seen["block0"][:, :8, ::16],
    }
    report = golden.compare("megaloc", case, {name: value.numpy() for name, value in outputs.items()})
    assert len(report) == len(outputs)
    assert all(ok for _, ok in report), "\n".join(line for line, _ in report)


def test_the_state_dict_is_the_official_one(golden_root: Path) -> None:
    keys = json.loads((golden_root / "megaloc.keys.json").read_text())
    with torch.device("meta"):
        state = MegaLoc().state_dict()
    assert {name: list(tensor.shape) for name, tensor in state.items()} == {
        name: entry["shape"] for name, entry in keys.items()
    }


@pytest.fixture(scope="module")
def official_bfloat16(golden: ModuleType) -> MegaLoc:
    model = MegaLoc.from_checkpoint(golden.state("megaloc"))
    model.compute_in(torch.bfloat16)
    return model


@pytest.mark.slow
@pytest.mark.parametrize("case", ["a", "b", "c"])
def test_bfloat16_on_the_cpu_points_the_same_way(
    golden: ModuleType, official: MegaLoc, official_bfloat16: MegaLoc, case: str
) -> None:
    images = golden.case_images("megaloc", golden.info("megaloc")["cases"][case])
    with torch.inference_mode():
        exact, rough = official(images), official_bfloat16(images)
    assert rough.dtype == torch.float32
    assert (exact * rough).sum(dim=1).min() >= 1 - 1e-5


def tiny_megaloc(seed: int = 0, out: int = 32) -> MegaLoc:
    """A network of the same make with small random weights."""
    generator = torch.Generator().manual_seed(seed)
    model = MegaLoc(dim=24, depth=2, num_heads=2, grid=5, clusters=6, cluster_dim=8, token_dim=4, hidden=16, out=out)
    for parameter in model.parameters():
        parameter.data = torch.randn(parameter.shape, generator=generator) * 0.3
    return model.eval().requires_grad_(False)


@pytest.fixture
def tiny() -> MegaLoc:
    return tiny_megaloc()


@pytest.mark.parametrize("size", [(126, 126), (126, 154), (70, 70), (133, 140), (100, 211)])
def test_images_do_not_see_each_other(tiny: MegaLoc, size: tuple[int, int]) -> None:
    images = torch.randn(3, 3, *size, generator=torch.Generator().manual_seed(1))
    together = tiny(images)
    assert together.shape == (3, 32)
    torch.testing.assert_close(together.norm(dim=1), torch.ones(3))
    apart = torch.cat([tiny(image[None]) for image in images])
    torch.testing.assert_close(together, apart, atol=1e-6, rtol=1e-5)
    assert (together[0] - together[1]).abs().max() > 1e-3


def test_other_sizes_are_resized_to_whole_patches(tiny: MegaLoc) -> None:
    images = torch.randn(2, 3, 133, 147, generator=torch.Generator().manual_seed(1))  # 9.5 and 10.5 patches
    resized = F.interpolate(images, (140, 140), mode="bilinear", antialias=True)  # half goes to even: 10 and 10
    torch.testing.assert_close(tiny(images), tiny(resized))


def test_the_trained_grid_is_taken_as_it_is(tiny: MegaLoc) -> None:
    assert tiny.backbone._position(5, 5) is tiny.backbone.pos_embed
    assert tiny.backbone._position(4, 7).shape == (1, 29, 24)


@pytest.mark.parametrize(("shape", "dtype", "named"), [
    ((3, 126, 126), torch.float32, r"expected \(B, 3, H, W\)"),
    ((1, 4, 126, 126), torch.float32, r"expected \(B, 3, H, W\)"),
    ((1, 3, 28, 42), torch.float32, "more than 6"),
    ((1, 3, 6, 500), torch.float32, "more than 6"),
    ((1, 3, 126, 126), torch.uint8, "uint8"),
])  # fmt: skip
def test_images_that_cannot_be_described(tiny: MegaLoc, shape: tuple[int, ...], dtype: torch.dtype, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        tiny(torch.zeros(shape, dtype=dtype))


def test_transport_shares_each_patch_out() -> None:
    scores = 3 * torch.randn(2, 5, 40, generator=torch.Generator().manual_seed(0))
    share = transport(scores, torch.tensor(1.0))
    assert share.shape == (2, 5, 40)
    # A patch is given away once at most; what is missing went to the bin, which shall have 40 - 5 patches.
    assert share.sum(1).max() <= 1 + 1e-6
    torch.testing.assert_close(share.sum((1, 2)), torch.full((2,), 5.0), atol=0.5, rtol=0)
    torch.testing.assert_close(transport(scores, torch.tensor(-7.0)), share)  # an even row cancels
    even = transport(torch.zeros(1, 5, 40), torch.tensor(0.0))
    torch.testing.assert_close(even, torch.full((1, 5, 40), 1 / 40))


def test_other_weights_are_refused() -> None:
    with torch.device("meta"):
        state = {name: tensor for name, tensor in MegaLoc().state_dict().items() if "blocks.3." not in name}
    state["head.weight"] = torch.zeros(2)
    state["backbone.pos_embed"] = torch.zeros(1, 257, 768)
    with pytest.raises(WeightsError) as error:
        MegaLoc.from_checkpoint(state)
    for part in ("backbone.blocks.3.", "head.weight", "(1, 257, 768)", "(1, 1370, 768)"):
        assert part in str(error.value)


# The embedder: photographs in


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)


def test_the_embedder_sees_what_the_official_loop_sees(tiny: MegaLoc) -> None:
    """Pillow's bilinear resize, [0, 1], ImageNet's mean and deviation."""
    embedder = MegaLocEmbedder(tiny, device="cpu", dtype_compute="float32", image_size=126)
    image = noise(200, 300)
    pixels = np.asarray(Image.fromarray(image).resize((126, 126), Image.Resampling.BILINEAR), np.float32) / 255
    pixels = (pixels - np.float32([0.485, 0.456, 0.406])) / np.float32([0.229, 0.224, 0.225])
    expected = tiny(torch.from_numpy(pixels).permute(2, 0, 1)[None])
    np.testing.assert_allclose(embedder.embed([image]), expected.numpy(), atol=1e-6)
    assert embedder.dim == 32
    prepared = embedder.prepare(image)
    assert prepared.shape == (126, 126, 3)
    np.testing.assert_array_equal(embedder.embed([prepared]), embedder.embed([image]))


def test_the_embedder_takes_any_photographs(tiny: MegaLoc) -> None:
    embedder = create_embedder("megaloc", checkpoint=tiny, device="cpu", image_size=126)
    gray = noise(90, 130)[:, :, 0]
    vectors = embedder.embed([noise(200, 300), noise(126, 126), gray, np.repeat(gray[..., None], 3, axis=2)])
    assert vectors.shape == (4, 32)
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    np.testing.assert_array_equal(vectors[2], vectors[3])
    assert embedder.embed([]).shape == (0, 32)
    for wrong in (noise(9, 9).astype(np.float32), noise(9, 9)[:, :, :2], noise(9, 9)[:0], noise(9, 9)[0, 0]):
        with pytest.raises(ValueError, match="uint8"):
            embedder.embed([wrong])


@pytest.mark.parametrize("size", [100, 112, 0, -14, 323, 322.0])
def test_image_sizes_that_are_refused(size: Any) -> None:
    with pytest.raises(ManifestError, match=f"image_size.*{size}"):
        MegaLocEmbedder(tiny_megaloc(), device="cpu", image_size=size)


def test_settings_tell_what_changes_the_vectors(tiny: MegaLoc) -> None:
    settings = MegaLocEmbedder(tiny_megaloc(), device="cpu", dtype_compute="float32").settings
    assert MegaLocEmbedder(tiny_megaloc(), device="cpu", dtype_compute="float32").settings == settings
    others = [
        MegaLocEmbedder(tiny_megaloc(seed=1), device="cpu", dtype_compute="float32"),
        MegaLocEmbedder(tiny_megaloc(), device="cpu", dtype_compute="bfloat16"),
        MegaLocEmbedder(tiny_megaloc(), device="cpu", dtype_compute="float32", image_size=336),
    ]
    assert all(other.settings != settings for other in others)
    json.dumps(settings)


def test_half_precision_points_the_same_way() -> None:
    images = [noise(130, 170, seed) for seed in range(4)]
    exact = MegaLocEmbedder(tiny_megaloc(), device="cpu", dtype_compute="float32", image_size=126).embed(images)
    for precision in ("bfloat16", "float16"):
        embedder = MegaLocEmbedder(tiny_megaloc(), device="cpu", dtype_compute=precision, image_size=126)
        rough = embedder.embed(images)
        assert rough.dtype == np.float32
        assert (exact * rough).sum(axis=1).min() > 0.99


def test_a_network_that_is_given_stays_as_it_is(tiny: MegaLoc) -> None:
    exact = MegaLocEmbedder(tiny, device="cpu", dtype_compute="float32", image_size=126)
    before = exact.embed([noise(126, 126)])
    rough = MegaLocEmbedder(tiny, device="cpu", dtype_compute="bfloat16", image_size=126)
    assert rough.settings["weights"] == exact.settings["weights"]
    np.testing.assert_array_equal(exact.embed([noise(126, 126)]), before)
    assert tiny.backbone.cls_token.dtype == torch.float32


def test_descriptors_that_are_no_numbers_are_not_written(tiny: MegaLoc) -> None:
    tiny.aggregator.linear.bias[3] = torch.nan
    with pytest.raises(ToolkitError, match=r"NaN.*bfloat16"):
        MegaLocEmbedder(tiny, device="cpu", image_size=126).embed([noise(126, 126)])
