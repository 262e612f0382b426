"""Depth Anything 3: what a small network of its kind must do, the official loader, and the official numbers."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.golden import da3 as golden
from tests.golden.formula import cameras, photograph
from tests.models.test_vggt import SIZES, assert_equal, fill_randomly, find_spot, picture
from toolkit.errors import ImageError, WeightsError
from toolkit.geometry import invert
from toolkit.models.da3 import HEADS, DepthAnything3, cameras_from_pose_encoding, choose_reference, load_images
from toolkit.models.vit import places_of_view, rope_of_places

H, W = 42, 56
PATCHES = 3 * 4
KEYS = {"camera": {"pose_enc", "extrinsics", "intrinsics"}, "depth": {"depth", "depth_conf"}}
TINY: dict[str, Any] = {
    "dim": 32,
    "depth": 8,
    "num_heads": 2,
    "grid": 5,
    "alternate_from": 2,
    "dense_layers": (3, 5, 5, 7),
    "dense_channels": (8, 12, 16, 20),
    "dense_features": 16,
}


def tiny(heads: tuple[str, ...] = HEADS, compute_dtype: torch.dtype = torch.float32) -> DepthAnything3:
    """A network of the structure of Depth Anything 3, small, with the same random weights for the parts it has."""
    model = fill_randomly(DepthAnything3(heads, compute_dtype, **TINY))
    if "camera" in heads:
        model.cam_dec.fc_fov[0].bias.fill_(1.5)  # as random numbers, half of the fields of view would be 0
    return model


@pytest.fixture(scope="module")
def model() -> DepthAnything3:
    return tiny()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """Four views of each of two scenes."""
    return torch.rand(2, 4, 3, H, W, generator=torch.Generator().manual_seed(0))


# The network


@pytest.mark.slow
def test_outputs_have_the_official_names_and_shapes(model: DepthAnything3, images: torch.Tensor) -> None:
    output = model(images)
    assert output.keys() == set.union(*KEYS.values())
    assert output["pose_enc"].shape == (2, 4, 9)
    assert output["extrinsics"].shape == (2, 4, 3, 4)
    assert output["intrinsics"].shape == (2, 4, 3, 3)
    assert output["depth"].shape == output["depth_conf"].shape == (2, 4, H, W)
    assert (output["depth"] > 0).all()
    assert (output["depth_conf"] > 1).all()
    assert (output["pose_enc"][..., 7:] >= 0).all()
    assert model(images[0, :1, :, :14, :28])["depth"].shape == (1, 1, 14, 28)


@pytest.mark.slow
def test_scenes_of_a_batch_do_not_see_each_other(model: DepthAnything3, images: torch.Tensor) -> None:
    together = model(images)
    for scene in range(2):
        assert_equal(model(images[scene]), {name: value[scene : scene + 1] for name, value in together.items()})


@pytest.mark.slow
def test_only_the_reference_is_special(model: DepthAnything3, images: torch.Tensor) -> None:
    """Whatever the order of the views; asked for the first, whatever the order of the others."""
    output, moved = model(images), model(images[:, [3, 1, 0, 2]])
    assert_equal({name: value[:, [2, 1, 3, 0]] for name, value in moved.items()}, output, atol=1e-4)
    output, swapped, first = (
        model(images[:, order], reference="first") for order in ([0, 1, 2, 3], [0, 2, 1, 3], [1, 0, 2, 3])
    )
    for name in ("pose_enc", "depth"):
        torch.testing.assert_close(swapped[name][:, [0, 2, 1, 3]], output[name], atol=2e-5, rtol=1e-4)
        assert not torch.allclose(first[name][:, [1, 0, 2, 3]], output[name], atol=1e-3)
    # Of two views the first is taken.
    assert_equal(model(images[:, :2]), model(images[:, :2], reference="first"))
    assert not torch.allclose(model(images[:, :2])["pose_enc"], output["pose_enc"][:, :2], atol=1e-3)


def test_the_reference_is_in_the_middle_of_all_respects() -> None:
    """Of three views with like variances: lengths 1, 2, 3; the second is as like to both others."""
    base = torch.tensor([1.0, -1, 1, -1, 0, 0])
    across = torch.tensor([0.0, 0, 0, 0, 1, -1])
    tokens = torch.stack([length * (base + part * across) for length, part in ((1, -0.5), (2, 0.1), (3, 0.5))])
    units = tokens / tokens.norm(dim=1, keepdim=True)
    similarity = np.array([((units[i] @ units.T).sum() - 1) / 2 for i in range(3)])
    respects = np.stack([similarity, tokens.norm(dim=1).numpy(), units.numpy().var(axis=1, ddof=1)])
    scaled = (respects - respects.min(axis=1, keepdims=True)) / np.ptp(respects, axis=1, keepdims=True)
    expected = int(np.abs(scaled - 0.5).sum(axis=0).argmin())
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        [found] = choose_reference(tokens[None, order], "saddle_balanced")
        assert order[found] == expected
    assert choose_reference(tokens[None], "first").tolist() == [0]
    with pytest.raises(ValueError, match=r"'middle'.*saddle_balanced.*first"):
        choose_reference(tokens[None], "middle")


@pytest.mark.slow
@pytest.mark.parametrize("heads", [("camera",), ("depth",)])
def test_heads_asked_for_are_as_with_all(model: DepthAnything3, images: torch.Tensor, heads: tuple[str, ...]) -> None:
    everything = model(images)
    expected = {name: everything[name] for head in heads for name in KEYS[head]}
    assert_equal(model(images, heads=heads), expected)
    assert_equal(tiny(heads)(images), expected)


def test_tokens_of_single_views_may_come_from_a_cache(model: DepthAnything3, images: torch.Tensor) -> None:
    cached = torch.stack([model.encode(images[:, view]) for view in range(4)], dim=1)
    assert cached.shape == (2, 4, 1 + PATCHES, 32)
    assert_equal(model(torch.empty(images.shape, device="meta"), patch_tokens=cached), model(images))
    assert_equal(model(images[1], patch_tokens=cached[1]), model(images[1]))


def test_blocks_attend_within_views_and_among_them_in_turns(model: DepthAnything3) -> None:
    trunk = model.trunk
    generator = torch.Generator().manual_seed(0)
    tokens, roles = torch.randn(1, 2, 13, 32, generator=generator), torch.randn(1, 2, 32, generator=generator)
    layers, camera = trunk(tokens, roles, 3, 4, {3, 5})
    places = places_of_view(3, 4, 1, tokens.device)
    x = torch.cat([roles[:, :, None], tokens[:, :, 1:]], dim=2)
    one_place = rope_of_places(torch.cat([torch.zeros(1, 2), torch.ones(12, 2)]), 16)
    for block in (2, 4):
        within = trunk.blocks[block](x[0], rope_of_places(places, 16))[None]
        among = trunk.blocks[block + 1](within.flatten(1, 2), tuple(part.repeat(2, 1) for part in one_place))
        x = among.view(1, 2, 13, 32)
        torch.testing.assert_close(layers[block + 1], (within, trunk.norm(x)))
    torch.testing.assert_close(camera, torch.cat([within[:, :, 0], x[:, :, 0]], dim=-1))
    only = trunk(tokens, roles, 3, 4, {3, 5}, cameras_only=True)
    assert only[0] == {}
    torch.testing.assert_close(only[1], camera, atol=1e-5, rtol=1e-4)


def test_bfloat16_stays_in_the_trunk(model: DepthAnything3, images: torch.Tensor) -> None:
    half = tiny(compute_dtype=torch.bfloat16)
    types = {name: value.dtype for name, value in half.state_dict().items()}
    matrices = {n for n in types if n.endswith(("qkv.weight", "fc2.bias")) and n.startswith("backbone")}
    assert {types[name] for name in matrices} == {torch.bfloat16}
    others = ("cam_dec", "head", "backbone.pretrained.camera", "backbone.pretrained.pos")
    assert all(t == torch.float32 for n, t in types.items() if n.startswith(others) or "norm" in n)
    assert half.encode(images[0]).dtype == torch.float32
    expected = model(images, reference="first")
    for name, value in half(images, reference="first").items():
        assert value.dtype == torch.float32
        error = (value - expected[name]).square().mean().sqrt() / expected[name].square().mean().sqrt()
        assert 1e-5 < error < 0.05, name


def test_wrong_input_is_refused(model: DepthAnything3, images: torch.Tensor) -> None:
    shapes = [(3, H, W), (1, 3, 3, H, W + 2), (2, 4, H, W), (0, 3, H, W), (1, 0, 3, H, W)]
    for call, named in (
        *((partial(model, torch.zeros(shape)), "expected ") for shape in shapes),
        (partial(model, images, patch_tokens=torch.zeros(2, 4, 12, 32)), r"patch_tokens.*\(2, 4, 13, 32\)"),
        (partial(tiny(("camera",)), images, heads=("depth",)), "heads"),
    ):
        with pytest.raises(ValueError, match=named):
            call()


# Cameras


def test_encoded_cameras_come_back() -> None:
    """`world_from_cam` is encoded, with quaternions of any length, and the vertical field of view comes first."""
    poses, K = cameras("any", 6, 70, 98)
    world_from_cam = invert(poses)
    quaternions = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat()
    fields = 2 * np.arctan(np.array([70, 98]) / 2 / K[:, [1, 0], [1, 0]])
    encoding = np.concatenate([world_from_cam[:, :3, 3], quaternions, fields], axis=1)
    encoding[1, 3:7] *= -3
    cam_from_world, intrinsics = cameras_from_pose_encoding(encoding, (70, 98))
    np.testing.assert_allclose(cam_from_world, poses[:, :3], atol=1e-12)
    np.testing.assert_allclose(intrinsics, K, atol=1e-9)
    encoding[0, 7:] = [0.0, 3.3]
    _, intrinsics = cameras_from_pose_encoding(encoding, (70, 98))
    np.testing.assert_allclose(intrinsics[0, [1, 0], [1, 0]], [35e6, 49e6], rtol=1e-6)


def test_what_is_no_camera_is_nan(images: torch.Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny(("camera",))
    forward = model.cam_dec.forward

    def spoils(tokens: torch.Tensor) -> torch.Tensor:
        encoding = forward(tokens)
        encoding[0, 1, 3:7] = 0.0
        encoding[1, 2, 0] = torch.nan
        return encoding

    monkeypatch.setattr(model.cam_dec, "forward", spoils)
    output = model(images)
    for name in ("extrinsics", "intrinsics"):
        wrong = torch.isnan(output[name]).all(dim=-1).all(dim=-1)
        assert wrong.nonzero().tolist() == [[0, 1], [1, 2]]


# Loading


def test_a_checkpoint_fills_a_whole_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """From a file with the prefix of the official class, in both types, with parts that are not held."""
    state = {f"model.{name}": value for name, value in tiny().state_dict().items()}
    state |= {f"model.{name}": torch.zeros(1) for name in ("head.scratch.refinenet2_aux.x", "gs_head.y", "cam_enc.z")}
    torch.save(state, tmp_path / "model.pt")
    images = torch.rand(3, 3, H, W, generator=torch.Generator().manual_seed(1))
    constructor = DepthAnything3.__init__
    monkeypatch.setattr(DepthAnything3, "__init__", lambda self, heads, dtype: constructor(self, heads, dtype, **TINY))
    lacking = {key: value for key, value in state.items() if not key.endswith("blocks.2.attn.q_norm.weight")}
    for wrong, named in (
        ({**state, "model.backbone.mask_token": torch.zeros(1)}, r"1 unexpected: backbone\.mask_token"),
        (lacking, r"1 missing: backbone\.pretrained\.blocks\.2\.attn\.q_norm\.weight"),
    ):
        with pytest.raises(WeightsError, match=named):
            DepthAnything3.from_checkpoint(wrong)
    model = DepthAnything3.from_checkpoint(tmp_path / "model.pt")
    assert not model.training
    assert not any(value.is_meta for value in [*model.parameters(), *model.buffers()])
    half = DepthAnything3.from_checkpoint(state, heads=("camera",), compute_dtype=torch.bfloat16)
    monkeypatch.undo()
    assert_equal(model(images), tiny()(images))
    assert_equal(half(images), tiny(("camera",), torch.bfloat16)(images))


@pytest.mark.parametrize(("size", "channels"), [("da3-base", 768), ("da3-small", 384)])
def test_the_size_is_read_off_the_official_keys(size: str, channels: int) -> None:
    state = {f"model.{name}": torch.empty(shape, device="meta") for name, shape in golden.shapes(size).items()}
    model = DepthAnything3.from_checkpoint(state)
    assert model.channels == channels
    held = {key: tuple(value.shape) for key, value in model.state_dict().items()}
    left_out = {name for name in golden.shapes(size) if "_aux." in name or name.startswith("cam_enc.")}
    assert held == {name: shape for name, shape in golden.shapes(size).items() if name not in left_out}
    assert len(left_out) == 164


def test_another_size_is_refused(tmp_path: Path) -> None:
    torch.save({f"model.{name}": value for name, value in tiny().state_dict().items()}, tmp_path / "model.pt")
    token = {"model.backbone.pretrained.camera_token": torch.zeros(1, 2, 1024)}
    for given, named in (
        (tmp_path / "model.pt", r"model\.pt: these are not weights of Depth Anything 3(?s:.*)mis-shaped"),
        (token, r"camera_token found \(1, 2, 1024\) .*, expected \(1, 2, 768\)"),
    ):
        with pytest.raises(WeightsError, match=named):
            DepthAnything3.from_checkpoint(given)


# Images


@pytest.mark.parametrize("together", [True, False])
def test_a_marked_pixel_goes_where_the_map_says(together: bool) -> None:
    """Also in images that are cut to the smallest of several."""
    sizes = [size for size in SIZES if 4 * min(size) > max(size)]
    assert len(sizes) > 2
    spots = [(0.5 * width, 0.45 * height) for width, height in sizes]
    pictures = [picture(*size, spot) for size, spot in zip(sizes, spots, strict=True)]
    for index in range(len(sizes)):
        views = load_images(pictures if together else pictures[index : index + 1])
        row = index if together else 0
        assert views.images.dtype == torch.float32
        assert all(side % 14 == 0 for side in views.images.shape[2:])
        assert tuple(views.sizes[row]) == sizes[index]
        place = find_spot(views.images[row])
        np.testing.assert_allclose(views.scale[row] * spots[index] + views.offset[row], place, atol=0.1)


@pytest.mark.parametrize(
    ("size", "shown"),
    [
        ((640, 480), (504, 378)),
        ((480, 640), (378, 504)),
        ((1920, 1080), (504, 280)),
        ((1, 50), (14, 504)),
        ((7, 7), (504, 504)),
    ],
)
def test_sizes_of_images(size: tuple[int, int], shown: tuple[int, int]) -> None:
    images = load_images([np.zeros((size[1], size[0], 3), np.uint8)]).images
    assert images.shape == (1, 3, shown[1], shown[0])


@pytest.mark.parametrize(("images", "mode", "error", "named"), [
    (["none.png"], [], ImageError, r"none\.png"),
    ([np.zeros((10, 1000, 3), np.uint8)], [], ImageError, r"1000 x 10 pixels is too elongated.*no\. 0"),
    ([], [], ValueError, "no images"),
    ([np.zeros((10, 10, 3), np.uint8)], ["crop"], ValueError, r"crop.*upper_bound_resize"),
])  # fmt: skip
def test_wrong_images_are_refused(images: list[Any], mode: list[str], error: type[Exception], named: str) -> None:
    with pytest.raises(error, match=named):
        load_images(images, *mode)


# The official numbers


def test_images_are_as_of_the_official_loader(tmp_path: Path) -> None:
    """Up to one level, as versions of OpenCV may round otherwise."""
    paths = {}
    for name, size in golden.PICTURES.items():
        paths[name] = tmp_path / f"{name}.png"
        Image.fromarray(photograph(name, *size)).save(paths[name])
    for name, shape in golden.info()["loader"].items():
        images = load_images([*paths.values()] if name == "all" else [paths[name]]).images
        assert list(images.shape) == shape
        found = np.rint(255 * images.numpy())[:, :, 3::17, 5::19]
        assert np.abs(found - golden.expected("loader")[name]).max() <= 1, name


@pytest.mark.parametrize("size", ["da3-small", pytest.param("da3-base", marks=pytest.mark.slow)])
def test_official_numbers(size: str) -> None:
    """All recorded outputs and slices, in float32, of the official code with weights by formula."""
    model = DepthAnything3.from_checkpoint(golden.state(golden.shapes(size)))
    seen: dict[str, Any] = {}
    for number in (2, 3):
        model.trunk.blocks[number].register_forward_hook(
            lambda _m, _i, out, name=f"block{number}": seen.update({name: out})
        )
    model.trunk.register_forward_hook(lambda _m, _i, out: seen.update(layers=out[0], camera_tokens=out[1][0]))
    wrong = {}
    for case in golden.CASES:
        output = model(**golden.inputs(case))
        layers = seen.pop("layers")
        tokens = torch.stack([torch.cat(layers[layer], dim=-1)[0, :, 1:] for layer in model.dense_layers])
        found = {name: value[0] for name, value in output.items()} | seen | {"tokens": tokens}
        errors = golden.errors(size, case, found)
        print(size, case, {name: f"{error:.2f}" for name, error in errors.items()})
        wrong |= {f"{case} {name}": error for name, error in errors.items() if not error <= 1}
        chosen = choose_reference(model.encode(golden.inputs(case)["images"])[None, :, 0], "saddle_balanced")
        assert "reference" in golden.CASES[case] or chosen.tolist() == [golden.info()["references"][size][case]]
    assert not wrong
