"""VGGT-Omega: what a small network of its kind must do, the official loader, and the official numbers."""

import struct
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import PIL.Image
import pytest
import torch

from tests.models.test_vggt import (
    SIZES,
    assert_equal,
    assert_official_images,
    fill_randomly,
    find_spot,
    golden,
    picture,
)
from toolkit.errors import ImageError, WeightsError
from toolkit.models.multiview import ResidualUnit
from toolkit.models.omega import HEADS, SPECIAL, PlaceRope, VGGTOmega, cameras_from_pose_encoding, load_images

__all__ = ["golden"]  # a fixture

H, W = 48, 64
PATCHES = 3 * 4
KEYS = {"camera": {"pose_enc"}, "depth": {"depth", "depth_conf"}}
ALWAYS = {"camera_and_register_tokens"}
TINY: dict[str, Any] = {
    "dim": 32,
    "depth": 5,
    "num_heads": 2,
    "encoder_depth": 2,
    "encoder_num_heads": 4,
    "register_layers": (1, 2),
    "camera_depth": 2,
    "camera_num_heads": 4,
    "dense_layers": (0, 1, 3, 4),
    "dense_channels": (8, 12, 16, 20),
    "dense_features": 16,
}


def tiny(heads: tuple[str, ...] = HEADS, compute_dtype: torch.dtype = torch.float32) -> VGGTOmega:
    """A network of VGGT-Omega's structure, small, with the same random weights for the parts it has in common."""
    model = fill_randomly(VGGTOmega(heads, compute_dtype, **TINY))
    for name, buffer in model.named_buffers():
        if name.endswith("periods"):
            buffer.copy_(100 ** (torch.arange(len(buffer)) / len(buffer)))
        else:
            buffer.fill_(1).chunk(3)[1].zero_()
    return model


@pytest.fixture(scope="module")
def model() -> VGGTOmega:
    return tiny()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """Three views of each of two scenes."""
    return torch.rand(2, 3, 3, H, W, generator=torch.Generator().manual_seed(0))


# The network


def test_outputs_have_the_official_names_and_shapes(model: VGGTOmega, images: torch.Tensor) -> None:
    output = model(images)
    assert output.keys() == ALWAYS.union(*KEYS.values())
    assert output["pose_enc"].shape == (2, 3, 9)
    assert output["depth"].shape == (2, 3, H, W, 1)
    assert output["depth_conf"].shape == (2, 3, H, W)
    assert output["camera_and_register_tokens"].shape == (2, 3, SPECIAL, 64)
    assert (output["depth"] > 0).all()
    assert (output["depth_conf"] > 1).all()
    assert model(images[0, :1, :, :16, :32])["depth"].shape == (1, 1, 16, 32, 1)


def test_scenes_of_a_batch_do_not_see_each_other(model: VGGTOmega, images: torch.Tensor) -> None:
    together = model(images)
    for scene in range(2):
        assert_equal(model(images[scene]), {name: value[scene : scene + 1] for name, value in together.items()})


def test_only_the_first_view_is_special(model: VGGTOmega, images: torch.Tensor) -> None:
    output, swapped, first = (model(images[:, order]) for order in ([0, 1, 2], [0, 2, 1], [1, 0, 2]))
    for name in ("pose_enc", "depth"):
        torch.testing.assert_close(swapped[name][:, [0, 2, 1]], output[name], atol=2e-5, rtol=1e-4)
        assert not torch.allclose(first[name][:, [1, 0, 2]], output[name], atol=1e-3)
    assert not torch.allclose(model(images[:, :2])["pose_enc"], output["pose_enc"][:, :2], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("heads", [("camera",), ("depth",)])
def test_heads_asked_for_are_as_with_all(model: VGGTOmega, images: torch.Tensor, heads: tuple[str, ...]) -> None:
    everything = model(images)
    expected = {name: everything[name] for name in ALWAYS.union(*(KEYS[head] for head in heads))}
    assert_equal(model(images, heads=heads), expected)
    assert_equal(tiny(heads)(images), expected)


def test_camera_head_alone_computes_no_patches_last(model: VGGTOmega) -> None:
    patches = torch.randn(2, 3, PATCHES, 32, generator=torch.Generator().manual_seed(0))
    for last in (4, 2):  # of all tokens, of registers
        every = model.aggregator(patches, 3, 4, {last})[last]
        only = model.aggregator(patches, 3, 4, {last}, cameras_only=True)[last]
        for part, whole in zip(only, every, strict=True):
            assert whole.shape == (2, 3, SPECIAL + PATCHES, 32)
            torch.testing.assert_close(part, whole[:, :, :SPECIAL], atol=1e-5, rtol=1e-4)


def test_patches_do_not_attend_among_views_in_register_layers(model: VGGTOmega) -> None:
    patches = torch.randn(1, 3, PATCHES, 32, generator=torch.Generator().manual_seed(0))
    layers = model.aggregator(patches, 3, 4, {0, 1, 2, 3})
    for layer, same in ((0, False), (1, True), (2, True), (3, False)):
        within, among = layers[layer]
        assert torch.equal(within[:, :, SPECIAL:], among[:, :, SPECIAL:]) is same
        assert not torch.allclose(within[:, :, :SPECIAL], among[:, :, :SPECIAL], atol=1e-3)
    expected = model.aggregator.inter_frame_blocks[1](layers[1][0][:, :, :SPECIAL].flatten(1, 2))
    torch.testing.assert_close(layers[1][1][:, :, :SPECIAL].flatten(1, 2), expected)
    # Among views, no token has a position.
    expected = model.aggregator.inter_frame_blocks[3](layers[3][0].flatten(1, 2))
    torch.testing.assert_close(layers[3][1].flatten(1, 2), expected)


def test_patch_tokens_may_come_from_a_cache(model: VGGTOmega, images: torch.Tensor) -> None:
    cached = torch.stack([model.encode(images[:, view]) for view in range(3)], dim=1)
    assert cached.shape == (2, 3, PATCHES, 32)
    assert_equal(model(torch.empty(images.shape, device="meta"), patch_tokens=cached), model(images))
    assert_equal(model(images[1], patch_tokens=cached[1]), model(images[1]))


def test_bfloat16_stays_in_the_trunk(model: VGGTOmega, images: torch.Tensor) -> None:
    half = tiny(compute_dtype=torch.bfloat16)
    types = {name: value.dtype for name, value in half.state_dict().items()}
    matrices = {n for n in types if n.endswith(("qkv.weight", "bias_mask", "fc2.bias")) and n.startswith("aggregator")}
    assert {types[name] for name in matrices} == {torch.bfloat16}
    others = ("camera_head", "dense_head", "aggregator.rope", "aggregator.camera")
    assert all(t == torch.float32 for n, t in types.items() if n.startswith(others) or "norm" in n)
    assert half.encode(images[0]).dtype == torch.float32
    expected = model(images)
    for name, value in half(images).items():
        assert value.dtype == torch.float32
        error = (value - expected[name]).square().mean().sqrt() / expected[name].square().mean().sqrt()
        assert 1e-5 < error < 0.03, name


def test_places_from_the_longer_side() -> None:
    rope = PlaceRope(8)
    rope.periods.copy_(torch.tensor([1.0, 10.0]))
    cosine, sine = rope(3, 4, 5)
    assert cosine.shape == sine.shape == (5 + 12, 8)
    assert torch.equal(cosine[:5], torch.ones(5, 8))
    assert not sine[:5].any()
    # Row 2 of 3 and column 1 of 4: centers of fourths of [-1, 1], by y with both periods, then by x.
    angles = 2 * np.pi * np.array([0.25, 0.025, -0.25, -0.025])
    token = 5 + 2 * 4 + 1
    np.testing.assert_allclose(cosine[token], np.tile(np.cos(angles), 2), atol=1e-6)
    np.testing.assert_allclose(sine[token], np.concatenate([-np.sin(angles), np.sin(angles)]), atol=1e-6)


def test_least_field_of_view(images: torch.Tensor) -> None:
    model = tiny(("camera",))
    before = model(images)["pose_enc"]
    model.camera_head.camera_branch[2].bias[7:] = -20.0
    after = model(images)["pose_enc"]
    assert torch.equal(after[..., :7], before[..., :7])
    assert (after[..., 7:] == 0.01).all()
    _, K = cameras_from_pose_encoding(after, (H, W))
    np.testing.assert_allclose(K[0, 0, 0, 0], W / 2 / np.tan(0.005), rtol=1e-6)


def test_pixels_of_a_patch_of_the_dense_head(images: torch.Tensor) -> None:
    """Each fused pixel is 4 x 4 pixels, row by row; depth is exp, confidence 1 + exp."""
    model = tiny(("depth",))
    for part, slope in ((model.dense_head.proj, 0.1), (model.dense_head.proj_conf, -0.2)):
        part.weight.zero_()
        part.bias.copy_(slope * torch.arange(16))
    output = model(images)
    number = np.arange(16.0).reshape(4, 4)
    for name, square in (("depth", np.exp(0.1 * number)), ("depth_conf", 1 + np.exp(-0.2 * number))):
        np.testing.assert_allclose(output[name].reshape(2, 3, H, W)[1, 2], np.tile(square, (12, 16)), rtol=1e-5)


@pytest.mark.parametrize("overwrites", [True, False])
def test_what_a_residual_is_added_to(overwrites: bool) -> None:
    """VGGT's official code overwrites it with its positive part; Omega's does not."""
    unit = ResidualUnit(2, overwrites).requires_grad_(False)
    unit.conv2.weight.zero_()
    unit.conv2.bias.zero_()
    x = torch.tensor([-1.0, 2.0]).view(1, 2, 1, 1).expand(1, 2, 3, 3)
    assert torch.equal(unit(x), x.clamp(min=0) if overwrites else x)


def test_wrong_input_is_refused(model: VGGTOmega, images: torch.Tensor) -> None:
    shapes = [(3, H, W), (1, 3, 3, H, W + 14), (2, 4, H, W), (0, 3, H, W), (1, 0, 3, H, W)]
    for call, named in (
        *((partial(model, torch.zeros(shape)), "expected ") for shape in shapes),
        (partial(model, images, patch_tokens=torch.zeros(2, 3, 11, 32)), r"patch_tokens.*\(2, 3, 12, 32\)"),
        (partial(tiny(("camera",)), images, heads=("depth",)), "heads"),
        (partial(VGGTOmega, ("point",)), "heads"),
    ):
        with pytest.raises(ValueError, match=named):
            call()


# Loading


def test_checkpoint_fills_a_whole_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """From a file, in both types; one of another network, or with the head for texts, is refused."""
    state = tiny().state_dict()
    torch.save(state, tmp_path / "model.pt")
    images = torch.rand(2, 3, H, W, generator=torch.Generator().manual_seed(1))
    constructor = VGGTOmega.__init__
    with pytest.raises(WeightsError, match=r"VGGT-Omega.*(?s:.*)camera_token .*\(1, 2, 1, 32\).*\(1, 2, 1, 1024\)"):
        VGGTOmega.from_checkpoint(state)
    monkeypatch.setattr(VGGTOmega, "__init__", lambda self, heads, dtype: constructor(self, heads, dtype, **TINY))
    without = {key: value for key, value in state.items() if not key.endswith("periods")}
    for wrong, named in (
        ({**state, "text_alignment_head.x": torch.zeros(1)}, r"1 unexpected: text_alignment_head\.x"),
        (without, r"2 missing: .*rope_embed\.periods"),
    ):
        with pytest.raises(WeightsError, match=named):
            VGGTOmega.from_checkpoint(wrong)
    model = VGGTOmega.from_checkpoint(tmp_path / "model.pt")
    assert not model.training
    assert not any(value.is_meta for value in [*model.parameters(), *model.buffers()])
    half = VGGTOmega.from_checkpoint(state, heads=("camera",), compute_dtype=torch.bfloat16)
    monkeypatch.undo()
    assert_equal(model(images), tiny()(images))
    assert_equal(half(images), tiny(("camera",), torch.bfloat16)(images))


# Images


@pytest.mark.parametrize("mode", ["balanced", "max_size"])
@pytest.mark.parametrize("together", [True, False])
def test_a_marked_pixel_goes_where_the_map_says(mode: str, together: bool) -> None:
    """Also in images that are cut to 1 to 2, or 2 to 1."""
    spots = [(0.5 * width, 0.45 * height) for width, height in SIZES]
    pictures = [picture(*size, spot) for size, spot in zip(SIZES, spots, strict=True)]
    for index in range(len(SIZES)):
        views = load_images(pictures if together else pictures[index : index + 1], mode)
        row = index if together else 0
        assert views.images.dtype == torch.float32
        assert all(side % 16 == 0 for side in views.images.shape[2:])
        assert tuple(views.sizes[row]) == SIZES[index]
        place = find_spot(views.images[row])
        np.testing.assert_allclose(views.scale[row] * spots[index] + views.offset[row], place, atol=0.1)


@pytest.mark.parametrize(
    ("size", "balanced", "max_size"),
    [
        ((640, 480), (592, 448), (512, 384)),
        ((480, 640), (448, 592), (384, 512)),
        ((1000, 1000), (512, 512), (512, 512)),
        ((3000, 300), (720, 368), (512, 256)),
        ((1, 5), (368, 720), (256, 512)),
    ],
)
def test_sizes_of_images(size: tuple[int, int], balanced: tuple[int, int], max_size: tuple[int, int]) -> None:
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    for mode, (width, height) in (("balanced", balanced), ("max_size", max_size)):
        assert load_images([pixels], mode).images.shape == (1, 3, height, width)


@pytest.mark.parametrize(("images", "mode", "error", "named"), [
    (["none.png"], [], ImageError, r"none\.png"),
    ([], [], ValueError, "no images"),
    ([np.zeros((10, 10, 3), np.uint8)], ["crop"], ValueError, r"crop.*balanced.*max_size"),
])  # fmt: skip
def test_wrong_images_are_refused(images: list[Any], mode: list[str], error: type[Exception], named: str) -> None:
    with pytest.raises(error, match=named):
        load_images(images, *mode)


def test_the_largest_image_is_ours_and_not_that_of_pillow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    PIL.Image.new("RGB", (64, 48)).save(tmp_path / "photo.jpg")
    monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", 100)
    assert len(load_images([tmp_path / "photo.jpg"]).images) == 1
    content = (tmp_path / "photo.jpg").read_bytes()
    place = content.index(b"\xff\xc0") + 5  # height and width in the frame header
    (tmp_path / "large.jpg").write_bytes(content[:place] + struct.pack(">HH", 14_000, 20_000) + content[place + 4 :])
    with pytest.raises(ImageError, match=r"large\.jpg \(20000 x 14000 pixels, more than 268,435,456\)"):
        load_images([tmp_path / "large.jpg"])


# The official numbers


def test_keys_are_the_official_ones(golden: ModuleType) -> None:
    with torch.device("meta"):
        model = VGGTOmega()
    assert {key: tuple(value.shape) for key, value in model.state_dict().items()} == golden.shapes("omega")


def test_images_are_as_of_the_official_loader(golden: ModuleType, tmp_path: Path) -> None:
    assert_official_images(golden, "omega", load_images, ("balanced", "max_size"), tmp_path)


@pytest.mark.slow
def test_official_numbers(golden: ModuleType) -> None:
    """All recorded outputs and slices, in float32. Takes 5 GB of memory."""
    model = VGGTOmega.from_checkpoint(golden.state("omega"))
    trunk, seen = model.aggregator, {}
    part = np.s_[:, 14:22, ::16]
    trunk.patch_embed.register_forward_hook(lambda m, i, o: seen.update(patch_tokens=o[:, :6, ::16]))
    trunk.frame_blocks[0].register_forward_hook(lambda m, i, o: seen.update(frame0=o[part]))
    trunk.inter_frame_blocks[0].register_forward_hook(lambda m, i, o: seen.update(inter0=o[part]))
    trunk.inter_frame_blocks[2].register_forward_hook(lambda m, i, o: seen.update(inter2=o[part]))
    trunk.register_forward_hook(lambda m, i, o: seen.update(layers=o))
    wrong = []
    for case, spec in golden.info("omega")["cases"].items():
        images = golden.case_images("omega", spec)
        output = model(images[None])
        layers = seen.pop("layers")
        tokens = [torch.cat(layers[layer], dim=-1)[0, :, 14:22, ::32] for layer in model.dense_layers]
        outputs = output | seen | {"tokens": torch.stack(tokens)}
        outputs["camera_and_register_tokens"] = output["camera_and_register_tokens"][..., ::16]
        outputs["extrinsic"], outputs["intrinsic"] = cameras_from_pose_encoding(output["pose_enc"], images.shape[2:])
        assert spec["outputs"].keys() <= outputs.keys()
        wrong += [line for line, ok in golden.compare("omega", case, outputs) if not ok]
    assert not wrong
