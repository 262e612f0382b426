"""VGGT: what a small network of its kind must do, the official loader, and the official numbers where they are."""

import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from toolkit.errors import ImageError, WeightsError
from toolkit.geometry import invert, make_pose, transform
from toolkit.models.multiview import add_position, dense_output
from toolkit.models.vggt import (
    HEADS,
    SPECIAL,
    VGGT,
    Views,
    cameras_from_pose_encoding,
    load_images,
)
from toolkit.models.vit import places_of_view, rope_of_places, rotate_
from toolkit.prediction.depths import lifted

REPOSITORY = Path(__file__).resolve().parents[2]
H, W = 42, 56
KEYS = {
    "camera": {"pose_enc", "pose_enc_list"},
    "depth": {"depth", "depth_conf"},
    "point": {"world_points", "world_points_conf"},
}


def tiny(heads: tuple[str, ...] = HEADS, compute_dtype: torch.dtype = torch.float32) -> VGGT:
    """A network of VGGT's structure, small, with the same random weights for the parts it has in common."""
    model = VGGT(
        heads,
        compute_dtype,
        dim=32,
        depth=5,
        num_heads=2,
        encoder_depth=2,
        encoder_num_heads=4,
        grid=5,
        camera_depth=2,
        camera_num_heads=4,
        dense_layers=(0, 1, 3, 4),
        dense_channels=(8, 12, 16, 20),
        dense_features=16,
    )
    return fill_randomly(model)


Network = TypeVar("Network", bound=torch.nn.Module)


def fill_randomly(model: Network) -> Network:
    """Return a network with random weights, which depend on the names of its parameters only."""
    for name, parameter in model.named_parameters():
        seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little")
        noise = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(seed))
        fan_in = parameter[0].numel() if parameter.ndim > 1 else 1
        center = 0.7 if parameter.ndim == 1 and name.endswith(("weight", "gamma")) else 0.0
        with torch.no_grad():
            parameter.copy_(center + noise * (0.2 if parameter.ndim == 1 else fan_in**-0.5))
    return model.requires_grad_(False).eval()


@pytest.fixture(scope="module")
def model() -> VGGT:
    return tiny()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """Three views of each of two scenes."""
    return torch.rand(2, 3, 3, H, W, generator=torch.Generator().manual_seed(0))


def assert_equal(found: dict[str, Any], expected: dict[str, Any], atol: float = 2e-5) -> None:
    assert found.keys() == expected.keys()
    for name in found:
        for one, other in zip(_list(found[name]), _list(expected[name]), strict=True):
            torch.testing.assert_close(one, other, atol=atol, rtol=1e-4, msg=lambda text, name=name: f"{name}: {text}")


def _list(value: Any) -> list[torch.Tensor]:
    return value if isinstance(value, list) else [value]


# The network


@pytest.mark.parametrize("enabled", [True, False])
def test_dense_heads_convolve_without_cudnn(
    images: torch.Tensor, monkeypatch: pytest.MonkeyPatch, enabled: bool
) -> None:
    """On a GPU, cuDNN's choice for them takes 36 GB and many times as long; only there does the flag have an effect."""
    monkeypatch.setattr(torch.backends.cudnn, "enabled", enabled)
    model, seen = tiny(("depth",)), []
    kinds = (torch.nn.Conv2d, torch.nn.ConvTranspose2d)
    convolutions = [layer for layer in model.depth_head.modules() if isinstance(layer, kinds)]
    for layer in convolutions:
        layer.register_forward_pre_hook(lambda *_: seen.append(torch.backends.cudnn.enabled))
    model(images)
    assert len(seen) >= len(convolutions)
    assert not any(seen)
    assert torch.backends.cudnn.enabled == enabled
    convolutions[-1].register_forward_pre_hook(lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        model(images)
    assert torch.backends.cudnn.enabled == enabled


def test_outputs_have_the_official_names_and_shapes(model: VGGT, images: torch.Tensor) -> None:
    output = model(images)
    assert output.keys() == set.union(*KEYS.values())
    assert output["pose_enc"].shape == (2, 3, 9)
    assert len(output["pose_enc_list"]) == 4
    assert output["depth"].shape == (2, 3, H, W, 1)
    assert output["world_points"].shape == (2, 3, H, W, 3)
    assert output["depth_conf"].shape == output["world_points_conf"].shape == (2, 3, H, W)
    assert (output["depth"] > 0).all()
    assert (output["depth_conf"] > 1).all()
    assert torch.equal(output["pose_enc"], output["pose_enc_list"][-1])
    assert all(not value.requires_grad for values in output.values() for value in _list(values))


def test_scenes_of_a_batch_do_not_see_each_other(model: VGGT, images: torch.Tensor) -> None:
    together = model(images)
    for scene in range(2):
        alone = model(images[scene])
        part = {name: [v[scene : scene + 1] for v in _list(value)] for name, value in together.items()}
        assert_equal({name: _list(value) for name, value in alone.items()}, part)


def test_only_the_first_view_is_special(model: VGGT, images: torch.Tensor) -> None:
    output, swapped, first = (model(images[:, order]) for order in ([0, 1, 2], [0, 2, 1], [1, 0, 2]))
    for name in ("pose_enc", "depth", "world_points"):
        torch.testing.assert_close(swapped[name][:, [0, 2, 1]], output[name], atol=2e-5, rtol=1e-4)
        assert not torch.allclose(first[name][:, [1, 0, 2]], output[name], atol=1e-3)


def test_views_see_each_other(model: VGGT, images: torch.Tensor) -> None:
    assert not torch.allclose(model(images[:, :2])["pose_enc"], model(images)["pose_enc"][:, :2], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("heads", [("camera",), ("depth",), ("point",), ("camera", "depth"), ("depth", "point")])
def test_heads_asked_for_are_as_with_all(model: VGGT, images: torch.Tensor, heads: tuple[str, ...]) -> None:
    everything = model(images)
    expected = {name: everything[name] for head in heads for name in KEYS[head]}
    assert_equal(model(images, heads=heads), expected)
    assert_equal(tiny(heads)(images), expected)


def test_camera_head_alone_computes_only_camera_tokens_last(model: VGGT, images: torch.Tensor) -> None:
    patches = model.encode(images[0])[None]
    every = model.aggregator(patches, 3, 4, {2, 4})
    only = model.aggregator(patches, 3, 4, {4}, cameras_only=True)
    assert only.keys() == {4}
    for part, whole in zip(only[4], every[4], strict=True):
        assert part.shape == (1, 3, 1, 32)
        torch.testing.assert_close(part, whole[:, :, :1], atol=1e-5, rtol=1e-4)
    assert every[2][0].shape == (1, 3, SPECIAL + 12, 32)


def test_patch_tokens_may_come_from_a_cache(model: VGGT, images: torch.Tensor) -> None:
    cached = torch.stack([model.encode(images[:, view]) for view in range(3)], dim=1)
    assert cached.shape == (2, 3, 12, 32)
    assert_equal(model(torch.empty(images.shape, device="meta"), patch_tokens=cached), model(images))
    assert_equal(model(images[1], patch_tokens=cached[1]), model(images[1]))


def test_dense_heads_in_any_portions(model: VGGT, images: torch.Tensor) -> None:
    layers = model.aggregator(model.encode(images.flatten(0, 1)).unflatten(0, (2, 3)), 3, 4, model.dense_layers)
    values, confidence = dense_output(model.point_head, layers, model.dense_layers, (H, W))  # a frame at a time
    flat = [(within.flatten(0, 1), among.flatten(0, 1)) for within, among in map(layers.get, model.dense_layers)]
    for frames in (4, 6):
        parts = [[(a[part], b[part]) for a, b in flat] for part in (slice(frames), slice(frames, None))]
        again = torch.cat([model.point_head(part, (H, W)) for part in parts if len(part[0][0])])
        again = again.permute(0, 2, 3, 1).unflatten(0, (2, 3))
        torch.testing.assert_close(again[..., :-1], values, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(1 + again[..., -1].exp(), confidence, atol=1e-5, rtol=1e-4)


def test_bfloat16_stays_in_the_trunk(model: VGGT, images: torch.Tensor) -> None:
    half = tiny(compute_dtype=torch.bfloat16)
    types = {name: parameter.dtype for name, parameter in half.named_parameters()}
    matrices = {n for n in types if n.endswith(("qkv.weight", "fc1.weight", "fc2.bias")) and n.startswith("aggregator")}
    assert {types[name] for name in matrices} == {torch.bfloat16}
    assert all(t == torch.float32 for n, t in types.items() if not n.startswith("aggregator") or "norm" in n)
    assert half.encode(images[0]).dtype == torch.float32
    expected = model(images)
    output = half(images)
    for name, value in output.items():
        for one, other in zip(_list(value), _list(expected[name]), strict=True):
            assert one.dtype == torch.float32
            error = (one - other).square().mean().sqrt() / other.square().mean().sqrt()
            assert 1e-5 < error < 0.03, name


def test_position_embedding_at_its_own_size_is_as_stored(model: VGGT) -> None:
    encoder = model.aggregator.patch_embed
    torch.testing.assert_close(encoder._position(5, 5), encoder.pos_embed)
    # Resizing keeps the mean of a smooth embedding, and its order: rows first.
    ramp = torch.arange(5.0).repeat_interleave(5)[None, :, None].expand(1, 25, 32)
    kept = encoder.pos_embed.clone()
    encoder.pos_embed[:, 1:] = ramp
    resized = encoder._position(3, 4)[:, 1:].unflatten(1, (3, 4))
    encoder.pos_embed.copy_(kept)
    assert (resized.diff(dim=1) > 0.5).all()
    torch.testing.assert_close(resized[:, :, 0], resized[:, :, 3], atol=1e-4, rtol=0)


def test_fields_of_view_are_not_negative_but_go_on_raw(images: torch.Tensor) -> None:
    model = tiny(("camera",))
    bias = model.camera_head.pose_branch.fc2.bias
    bias[7:] = -20.0
    output = model(images)["pose_enc_list"]
    assert all((encoding[..., 7:] == 0).all() for encoding in output)
    bias[7:] = -30.0
    again = model(images)["pose_enc_list"]
    assert torch.equal(again[0], output[0])
    # The next step reads the raw field of view, and so notices.
    assert not torch.allclose(again[1][..., :7], output[1][..., :7], atol=1e-3)


def test_activations_of_dense_heads(images: torch.Tensor) -> None:
    model = tiny(("depth", "point"))
    for head, bias in ((model.depth_head, [1.0, 2.0]), (model.point_head, [-2.0, 2.0, 0.5, -1.0])):
        head.scratch.output_conv2[2].weight.zero_()
        head.scratch.output_conv2[2].bias.copy_(torch.tensor(bias))
    output = {name: value[1, 2, 7, 9].double().numpy() for name, value in model(images).items()}
    np.testing.assert_allclose(output["depth"], [np.e], rtol=1e-6)
    np.testing.assert_allclose(output["depth_conf"], 1 + np.e**2, rtol=1e-6)
    np.testing.assert_allclose(output["world_points"], [1 - np.e**2, np.e**2 - 1, np.e**0.5 - 1], rtol=1e-6)
    np.testing.assert_allclose(output["world_points_conf"], 1 + 1 / np.e, rtol=1e-6)


def test_tokens_keep_their_places_among_views(model: VGGT) -> None:
    trunk = model.aggregator
    patches = torch.randn(1, 2, 12, 32, generator=torch.Generator().manual_seed(0))
    within, among = trunk(patches, 3, 4, {0})[0]
    cosine, sine = rope_of_places(places_of_view(3, 4, SPECIAL, torch.device("cpu")), 16)
    expected = trunk.global_blocks[0](within.flatten(1, 2), (torch.cat([cosine] * 2), torch.cat([sine] * 2)))
    torch.testing.assert_close(among.flatten(1, 2), expected)
    assert not torch.allclose(trunk.global_blocks[0](within.flatten(1, 2)), expected, atol=1e-3)


def test_rope_turns_by_place() -> None:
    cosine, sine = rope_of_places(places_of_view(3, 4, SPECIAL, torch.device("cpu")), 16)
    assert cosine.shape == sine.shape == (SPECIAL + 12, 16)
    x = torch.randn(2, 3, SPECIAL + 12, 16, generator=torch.Generator().manual_seed(0))
    turned = rotate_(x.clone(), (cosine, sine))
    assert torch.equal(turned[:, :, :SPECIAL], x[:, :, :SPECIAL])
    # Row 2, column 1 is at place (3, 2). Channels 0 to 7 are of y: i and i + 4 a pair, by place * 100 ** (-i / 4).
    token = SPECIAL + 2 * 4 + 1
    for place, start in ((3, 0), (2, 8)):
        quarter = 100.0 ** -(np.arange(4) / 4)
        pair = x[0, 1, token, start : start + 8].double().numpy().reshape(2, 4)
        expected = (pair[0] + 1j * pair[1]) * np.exp(1j * place * quarter)
        found = turned[0, 1, token, start : start + 8].numpy()
        np.testing.assert_allclose(found, np.concatenate([expected.real, expected.imag]), atol=1e-5)


def test_position_of_pixels_in_dense_heads() -> None:
    maps = add_position(torch.zeros(1, 8, 3, 5), aspect=2.0)
    center = torch.tensor([0, 0, 1, 1, 0, 0, 1, 1]) * 0.1
    torch.testing.assert_close(maps[0, :, 1, 2], center)
    # Half the width of the plane is 2 / sqrt(5); the last pixel's center is 1 / 10 of the width from its edge.
    x, y = 2 / 5**0.5 * 4 / 5, 1 / 5**0.5 * 2 / 3
    expected = np.concatenate([f([a, a / 10]) for a in (x, y) for f in (np.sin, np.cos)])
    np.testing.assert_allclose(maps[0, :, 2, 4].numpy(), 0.1 * expected, atol=1e-6)


def test_wrong_input_is_refused(model: VGGT, images: torch.Tensor) -> None:
    shapes = [(3, H, W), (1, 3, 3, H, W + 1), (2, 4, H, W), (0, 3, H, W), (1, 0, 3, H, W)]
    for call, named in (
        *((partial(model, torch.zeros(shape)), "expected ") for shape in shapes),
        (partial(model, images, patch_tokens=torch.zeros(2, 3, 11, 32)), r"patch_tokens.*\(2, 3, 12, 32\)"),
        (partial(tiny(("camera",)), images, heads=("depth",)), "heads"),
        *((partial(VGGT, heads), "heads") for heads in (("track",), (), "camera")),
        (partial(model.encode, images), r"expected \(N, 3, H, W\)"),
    ):
        with pytest.raises(ValueError, match=named):
            call()


# Loading


def test_checkpoint_of_another_network_is_refused() -> None:
    with pytest.raises(WeightsError, match=r"camera_token .*\(1, 2, 1, 32\).*\(1, 2, 1, 1024\)"):
        VGGT.from_checkpoint(tiny().state_dict())


def test_checkpoint_fills_a_whole_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """From a file, in both types, with the keys of the track head in it."""
    state = {**tiny().state_dict(), "track_head.x": torch.zeros(1)}
    torch.save(state, tmp_path / "model.pt")
    images = torch.rand(2, 3, H, W, generator=torch.Generator().manual_seed(1))
    constructor = VGGT.__init__
    sizes = {"dim": 32, "depth": 5, "num_heads": 2, "encoder_depth": 2, "encoder_num_heads": 4, "grid": 5}
    sizes |= {"camera_depth": 2, "camera_num_heads": 4, "dense_layers": (0, 1, 3, 4), "dense_features": 16}
    sizes |= {"dense_channels": (8, 12, 16, 20)}
    monkeypatch.setattr(VGGT, "__init__", lambda self, heads, dtype: constructor(self, heads, dtype, **sizes))
    model = VGGT.from_checkpoint(tmp_path / "model.pt")
    assert not model.training
    assert not any(value.is_meta for value in [*model.parameters(), *model.buffers()])
    half = VGGT.from_checkpoint(state, heads=("camera",), compute_dtype=torch.bfloat16)
    monkeypatch.undo()
    assert_equal(model(images), tiny()(images))
    assert_equal(half(images), tiny(("camera",), torch.bfloat16)(images))


# Cameras


def random_cameras(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """cam_from_world (count, 3, 4) and K (count, 3, 3) of 560 x 420 images, and their encodings (count, 9)."""
    rng = np.random.default_rng(0)
    rotation, translation = Rotation.random(count, rng=0), rng.normal(size=(count, 3))
    K = np.zeros((count, 3, 3))
    K[:, 0, 0], K[:, 1, 1] = rng.uniform(200, 900, (2, count))
    K[:, :2, 2], K[:, 2, 2] = (280, 210), 1
    fields = 2 * np.arctan(np.stack([210 / K[:, 1, 1], 280 / K[:, 0, 0]], axis=1))
    encoding = np.concatenate([translation, rotation.as_quat(), fields], axis=1)
    return np.concatenate([rotation.as_matrix(), translation[:, :, None]], axis=2), K, encoding


def test_cameras_of_pose_encodings() -> None:
    cam_from_world, K, encoding = random_cameras(50)
    pose, intrinsics = cameras_from_pose_encoding(encoding, (420, 560))
    np.testing.assert_allclose(pose, cam_from_world, atol=1e-12)
    np.testing.assert_allclose(intrinsics, K, rtol=1e-12)
    # The quaternion's length and sign say nothing.
    encoding[:, 3:7] *= -3.0
    pose, _ = cameras_from_pose_encoding(torch.from_numpy(encoding).view(5, 10, 9), (420, 560))
    np.testing.assert_allclose(pose.reshape(50, 3, 4), cam_from_world, atol=1e-12)


def test_pose_encoding_known_answers() -> None:
    half = np.sqrt(0.5)
    # A quarter turn around z takes x to y; 90 degrees high, 53.13 wide.
    pose, K = cameras_from_pose_encoding([1, 2, 3, 0, 0, half, half, np.pi / 2, 2 * np.arctan(0.5)], (100, 200))
    np.testing.assert_allclose(pose, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-15)
    np.testing.assert_allclose(K, [[200, 0, 100], [0, 50, 50], [0, 0, 1]], atol=1e-12)
    _, K = cameras_from_pose_encoding([0, 0, 0, 0, 0, 0, 1, 0, 0], (100, 200))
    assert np.isinf(K[[0, 1], [0, 1]]).all()
    for wrong, named in ((np.zeros((2, 8)), r"\(2, 8\)"), (np.zeros(9), "zero or not finite")):
        with pytest.raises(ValueError, match=named):
            cameras_from_pose_encoding(wrong, (100, 200))


def unprojected(depth: Any, cam_from_world: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """World points (S, H, W, 3) of depth maps (S, H, W, 1), by cameras of the toolkit: the first pixel is at 0.5."""
    depth = np.asarray(depth, np.float64)
    height, width = depth.shape[1:3]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2) + 0.5
    points = []
    for z, pose, K in zip(depth, cam_from_world, intrinsics, strict=True):
        params = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5]
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
        points.append(transform(invert(make_pose(pose[:, :3], pose[:, 3])), lifted(camera, pixels, z.ravel())))
    return np.reshape(points, (*depth.shape[:3], 3))


def test_unprojected_points_project_back() -> None:
    cam_from_world, K, _ = random_cameras(3)
    depth = np.random.default_rng(1).uniform(1, 5, (3, 6, 8, 1))
    world = unprojected(torch.from_numpy(depth), cam_from_world, K)
    assert world.shape == (3, 6, 8, 3)
    for pose, k, z, points in zip(cam_from_world, K, depth, world, strict=True):
        projected = (points @ pose[:, :3].T + pose[:, 3]) @ k.T
        np.testing.assert_allclose(projected[..., 2], z[..., 0])
        pixels = projected[..., :2] / projected[..., 2:]
        np.testing.assert_allclose(pixels[4, 7], [7, 4], atol=1e-9)
        np.testing.assert_allclose(pixels[0, 0], [0, 0], atol=1e-9)


# Images


def picture(width: int, height: int, spot: tuple[float, float]) -> np.ndarray:
    """Black, with a red spot around a point."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[..., 0] = 255 * np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / (2 * 8**2))
    return pixels


def find_spot(image: torch.Tensor) -> np.ndarray:
    """Where the red spot is; white has as much green as red."""
    weight = (image[0] - image[1]).double().clamp(min=0).numpy()
    x, y = np.meshgrid(np.arange(weight.shape[1]) + 0.5, np.arange(weight.shape[0]) + 0.5)
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


SIZES = [(640, 480), (300, 700), (1200, 400), (518, 518)]


@pytest.mark.parametrize("mode", ["crop", "pad"])
@pytest.mark.parametrize("together", [True, False])
def test_a_marked_pixel_goes_where_the_map_says(mode: str, together: bool) -> None:
    spots = [(0.4 * width, 0.55 * height) for width, height in SIZES]
    pictures = [picture(*size, spot) for size, spot in zip(SIZES, spots, strict=True)]
    for index in range(len(SIZES)):
        views = load_images(pictures if together else pictures[index : index + 1], mode)
        row = index if together else 0
        assert views.images.dtype == torch.float32
        assert all(side % 14 == 0 for side in views.images.shape[2:])
        assert tuple(views.sizes[row]) == SIZES[index]
        place = find_spot(views.images[row])
        np.testing.assert_allclose(views.scale[row] * spots[index] + views.offset[row], place, atol=0.1)


def test_all_kinds_of_sources_are_alike(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (60, 80, 4)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    path = tmp_path / "a.png"
    expected = load_images([path]).images
    for source in (str(path), Image.open(path), pixels):
        assert torch.equal(load_images([source]).images, expected)
    gray = load_images([pixels[..., 0]]).images
    assert torch.equal(gray[:, 0], gray[:, 2])


@pytest.mark.parametrize(("images", "mode", "error", "named"), [
    (["none.png"], "crop", ImageError, r"none\.png"),
    (["torn.png"], "crop", ImageError, r"torn\.png"),
    ([np.zeros((10, 1000, 3), np.uint8)], "crop", ImageError, "1000 x 10 pixels"),
    ([np.zeros((1000, 10, 3), np.uint8)], "pad", ImageError, "10 x 1000 pixels"),
    ([], "crop", ValueError, "no images"),
    ([np.zeros((10, 10, 3), np.uint8)], "stretch", ValueError, "stretch"),
])  # fmt: skip
def test_wrong_images_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, images: list[Any], mode: str, error: type[Exception], named: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(error, match=named):
        load_images(images, mode)


# The official numbers


@pytest.fixture(scope="module")
def golden() -> Iterator[ModuleType]:
    """The module that reads the fixtures: $GOLDEN, or beside the clone; skips where absent."""
    folder = Path(os.environ.get("GOLDEN", REPOSITORY.parent / "shared" / "golden"))
    if not (folder / "golden.py").is_file():
        pytest.skip(f"needs the golden fixtures: no {folder / 'golden.py'}; set GOLDEN")
    sys.path.insert(0, str(folder))
    import golden

    yield golden
    sys.path.remove(str(folder))


def test_keys_are_the_official_ones(golden: ModuleType) -> None:
    with torch.device("meta"):
        model = VGGT()
    official = {k: shape for k, shape in golden.shapes("vggt").items() if not k.startswith("track_head.")}
    assert {key: tuple(value.shape) for key, value in model.state_dict().items()} == official


def assert_official_images(
    golden: ModuleType, network: str, load: Callable[..., Views], modes: Sequence[str], folder: Path
) -> None:
    """Compare a loader with the official one of a network; writes images to a folder."""
    image_u8 = golden.weights.image_u8
    spec = golden.info(network)["loader"]
    paths = []
    for name, height, width in spec["images"]:
        Image.fromarray(image_u8(name, height, width)).save(folder / f"{name}.png")
        paths.append(folder / f"{name}.png")
    alpha = image_u8("load-alpha-mask", 80, 110)[..., :1]
    Image.fromarray(np.concatenate([image_u8("load-alpha", 80, 110), alpha], axis=2)).save(folder / "alpha.png")
    with np.load(golden.HERE / f"{network}.golden.npz") as data:
        for mode in modes:
            for which, sources in (("all", paths), ("first", paths[:1]), ("alpha", [folder / "alpha.png"])):
                images = load(sources, mode).images
                assert list(images.shape) == spec[f"{mode}/{which}"]["shape"]
                found = np.rint(255 * images.numpy()).astype(int)[:, :, 2::11, 1::13]
                assert np.abs(found - data[f"loader/{mode}/{which}"]).max() <= 1  # Pillow versions differ by that
                assert images.mean().item() == pytest.approx(spec[f"{mode}/{which}"]["mean"], abs=1e-3)


def test_images_are_as_of_the_official_loader(golden: ModuleType, tmp_path: Path) -> None:
    assert_official_images(golden, "vggt", load_images, ("crop", "pad"), tmp_path)


@pytest.mark.slow
def test_official_numbers(golden: ModuleType) -> None:
    """All recorded outputs and slices, in float32. Takes 5 GB of memory."""
    model = VGGT.from_checkpoint(golden.state("vggt"))
    trunk, seen = model.aggregator, {}
    trunk.patch_embed.register_forward_hook(lambda m, i, o: seen.update(patch_tokens=o[:, :6, ::16]))
    trunk.frame_blocks[0].register_forward_hook(lambda m, i, o: seen.update(frame0=o[:, :8, ::16]))
    trunk.global_blocks[0].register_forward_hook(lambda m, i, o: seen.update(global0=o[:, :8, ::16]))
    trunk.register_forward_hook(lambda m, i, o: seen.update(layers=o))
    wrong = []
    for case, spec in golden.info("vggt")["cases"].items():
        images = golden.case_images("vggt", spec)
        output = model(images[None])
        outputs = {name: torch.stack(value) if isinstance(value, list) else value for name, value in output.items()}
        layers = seen.pop("layers")
        kept_tokens = [torch.cat(layers[layer], dim=-1)[0, :, :8, ::32] for layer in model.dense_layers]
        outputs |= {**seen, "tokens": torch.stack(kept_tokens)}
        bias = model.camera_head.pose_branch.fc2.bias
        kept = bias.clone()
        bias[7:9] = -0.25
        outputs["pose_enc_negative_fov"] = model(images[None], heads=("camera",))["pose_enc"]
        bias.copy_(kept)
        outputs = {name: value.numpy() for name, value in outputs.items()}
        pose, K = cameras_from_pose_encoding(output["pose_enc"], images.shape[2:])
        points = unprojected(output["depth"][0], pose[0], K[0])
        outputs |= {"extrinsic": pose, "intrinsic": K, "unprojected": points}
        recorded = json.loads((golden.HERE / "vggt.golden.json").read_text())["cases"][case]["outputs"]
        assert recorded.keys() <= outputs.keys()
        wrong += [line for line, ok in golden.compare("vggt", case, outputs) if not ok]
    assert not wrong
