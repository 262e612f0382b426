"""VGGT as a predictor: groups, batches, the cache, memory and bad images, with a small network of its kind."""

import logging
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from scipy.ndimage import map_coordinates

from tests.models.test_da3 import tiny as da3
from tests.models.test_omega import tiny as omega
from tests.models.test_vggt import tiny
from toolkit.capture.images import read_image, turn_image, turn_points, turned_from_cam
from toolkit.errors import ManifestError, ToolkitError, WeightsError
from toolkit.geometry import invert
from toolkit.manifest import LocalizeSettings
from toolkit.models.da3 import DepthAnything3
from toolkit.models.da3 import cameras_from_pose_encoding as da3_cameras
from toolkit.models.da3 import load_images as load_da3_images
from toolkit.models.multiview import Views
from toolkit.models.omega import VGGTOmega
from toolkit.models.omega import load_images as load_omega_images
from toolkit.models.vggt import VGGT, cameras_from_pose_encoding, load_images
from toolkit.pose.base import View
from toolkit.prediction.interface import ARCHITECTURES, PlacedView, Prediction, shown_size
from toolkit.prediction.network import NetworkPredictor, TokenCache, open_predictor

# In the network 518 x 112, 518 x 126 and 112 x 518 pixels.
WIDE, HIGHER, PORTRAIT = (370, 80), (333, 81), (80, 370)

VGGT_ROW = ARCHITECTURES["vggt"]

Make = Callable[..., NetworkPredictor]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Make:
    """Return a function that makes a predictor with a small network in float32; options as the predictor's."""
    monkeypatch.setattr(VGGT, "from_checkpoint", lambda _, heads, compute_dtype: tiny(heads, compute_dtype))
    checkpoint = tmp_path / "model.pt"
    checkpoint.write_bytes(b"stands for weights")
    defaults: dict[str, Any] = {"dtype_compute": "float32"}
    return lambda **options: NetworkPredictor(checkpoint, "cpu", **(defaults | options))


class Photographs:
    """Writes photographs that differ, and names them as views."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.count = 0

    def view(self, size: tuple[int, int] = WIDE, in_map: bool = True) -> View:
        self.count += 1
        path = self.folder / f"{self.count}.png"
        width, height = size
        coarse = np.random.default_rng(self.count).integers(0, 256, (4, 5, 3), np.uint8)
        Image.fromarray(coarse).resize(size, Image.Resampling.BICUBIC).save(path)
        camera = pycolmap.Camera(
            model="PINHOLE", width=width, height=height, params=[width, width, width / 2, height / 2]
        )
        return View(f"map/raw_data/{path.name}", path, camera, in_map)

    def group(self, *sizes: tuple[int, int]) -> list[View]:
        return [self.view(size, in_map=index > 0) for index, size in enumerate(sizes)]


@pytest.fixture
def photographs(tmp_path: Path) -> Photographs:
    return Photographs(tmp_path)


def assert_same(found: Prediction, expected: Prediction) -> None:
    np.testing.assert_allclose(found.model_from_cams, expected.model_from_cams, atol=2e-5)
    for name in ("depth", "depth_conf", "map_from_image"):
        one, other = getattr(found, name), getattr(expected, name)
        assert (one is None) == (other is None), name
        if one is not None:
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=2e-5, err_msg=name)


def count_encoded(predictor: NetworkPredictor, monkeypatch: pytest.MonkeyPatch) -> list[torch.Tensor]:
    """Return a list that fills with the images that are encoded."""
    encoded: list[torch.Tensor] = []
    encode = predictor._model.encode
    monkeypatch.setattr(predictor._model, "encode", lambda x: (encoded.extend(x.cpu()), encode(x))[1])
    return encoded


def record_shapes(predictor: NetworkPredictor, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Return a list that fills with the groups and views of each run of the network."""
    shapes: list[tuple[int, int]] = []
    forward = predictor._model.forward
    monkeypatch.setattr(
        predictor._model, "forward", lambda x, *a: (shapes.append(tuple(x.shape[:2])), forward(x, *a))[1]
    )
    return shapes


def test_a_prediction_is_what_the_network_says(make: Make, photographs: Photographs) -> None:
    group = photographs.group(WIDE, WIDE, HIGHER)
    [found] = make().predict([group])
    loaded = load_images([view.image for view in group], "crop")
    assert loaded.images.shape == (3, 3, 126, 518)
    output = tiny(("camera", "depth"))(loaded.images)
    cam_from_model, _ = cameras_from_pose_encoding(output["pose_enc"][0], (126, 518))
    product = np.concatenate([cam_from_model, np.tile([[[0.0, 0, 0, 1]]], (3, 1, 1))], axis=1) @ found.model_from_cams
    np.testing.assert_allclose(product, np.tile(np.eye(4), (3, 1, 1)), atol=1e-4)
    assert found.model_from_cams.dtype == np.float64
    assert found.map_from_image is not None
    np.testing.assert_allclose(found.map_from_image, np.hstack([loaded.scale, loaded.offset]))
    assert found.depth is not None
    assert found.depth_conf is not None
    assert found.depth[0].dtype == found.depth_conf[0].dtype == np.float32
    # The two of 112 rows have 7 rows of white above and below.
    rows = np.arange(126)
    for index, covered in ((0, (rows >= 7) & (rows < 119)), (2, rows >= 0)):
        for mine, theirs in ((found.depth, output["depth"][..., 0]), (found.depth_conf, output["depth_conf"])):
            np.testing.assert_allclose(mine[index][covered], theirs[0, index].numpy()[covered], rtol=1e-4)
            assert np.isnan(mine[index][~covered]).all()
    pixel = np.array([[200.5, 33.25]])
    x, y = loaded.scale[0] * pixel[0] + loaded.offset[0] - 0.5
    between = map_coordinates(found.depth[0].astype(float), [[y], [x]], order=1)  # bilinear
    np.testing.assert_allclose(found.depth_at(0, pixel), between, rtol=1e-6)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
@pytest.mark.parametrize("size", [WIDE, PORTRAIT])
def test_a_point_is_seen_where_the_intrinsics_say(size: tuple[int, int], turns: int) -> None:
    """Projected by the network's camera and moved to the photograph, or by the photograph's camera: the same pixel."""
    width, height = size
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[width, width, 5, 5])
    view = View("v", Path("v"), camera, False, turns)
    placed = PlacedView(view, VGGT_ROW.lay_out([shown_size(view), WIDE]), 0)
    shown_height, shown_width = placed.size
    K = np.array([[300.0, 0, shown_width / 2], [0, 320.0, shown_height / 2], [0, 0, 1]])
    point = np.array([0.3, -0.2, 2.0])
    turned = turned_from_cam(turns)[:3, :3] @ point
    in_network = (K @ turned)[:2] / turned[2]
    [stored] = turn_points(in_network[None], shown_width, shown_height, -turns)
    scale, offset = placed.map_from_image[:2], placed.map_from_image[2:]
    seen = placed.intrinsics(K) @ point
    np.testing.assert_allclose(seen[:2] / seen[2], (stored - offset) / scale, atol=1e-9)


class Row(NamedTuple):
    """What a predictor is to be compared with."""

    network: type
    tiny: Callable[..., Any]
    load_images: Callable[..., Views]
    cameras: Callable[..., Any]


ROWS = {
    "vggt-omega": Row(VGGTOmega, omega, load_omega_images, cameras_from_pose_encoding),
    "da3-base": Row(DepthAnything3, da3, load_da3_images, da3_cameras),
    "da3-small": Row(DepthAnything3, da3, load_da3_images, da3_cameras),
}

Create = Callable[..., NetworkPredictor]


@pytest.fixture
def create(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Create:
    """Return a function that creates the predictor of that name with a small network; options as its settings."""

    def make_predictor(name: str, **options: Any) -> NetworkPredictor:
        small = ROWS[name].tiny
        monkeypatch.setattr(
            ROWS[name].network, "from_checkpoint", lambda _, heads, compute_dtype: small(heads, compute_dtype)
        )
        if ARCHITECTURES[name].channels:
            monkeypatch.setattr(ARCHITECTURES[name], "channels", small().channels)
        checkpoint = tmp_path / "weights.pt"
        checkpoint.write_bytes(b"stands for weights")
        asked = {"name": name, "checkpoint": str(checkpoint), **options}
        settings = {"predictor": asked, "compute_device": "cpu", "dtype_compute": "float32"}
        predictor = open_predictor(LocalizeSettings.of(settings), None, tmp_path)  # type: ignore[arg-type]
        assert isinstance(predictor, NetworkPredictor)
        return predictor

    return make_predictor


@pytest.mark.parametrize(
    "sizes",
    [[(370, 280), (370, 280)], pytest.param([(370, 280), (280, 370), (500, 100)], marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("name", ["vggt-omega", "da3-base"])
def test_other_rows(create: Create, photographs: Photographs, name: str, sizes: list[tuple[int, int]]) -> None:
    predictor, row = create(name), ROWS[name]
    group = photographs.group(*sizes)
    for _ in range(2):  # the second time from what is kept
        [found] = predictor.predict([group])
        loaded = row.load_images([view.image for view in group])
        output = row.tiny()(loaded.images)
        cam_from_model, K = row.cameras(output["pose_enc"][0], loaded.images.shape[2:])
        np.testing.assert_allclose(invert(found.model_from_cams)[:, :3], cam_from_model, atol=1e-5)
        np.testing.assert_allclose(found.map_from_image, np.hstack([loaded.scale, loaded.offset]))
        assert found.intrinsics is not None
        np.testing.assert_allclose(found.intrinsics[:, 0, 0], K[:, 0, 0] / loaded.scale[:, 0], rtol=1e-4)
        assert found.depth is not None
        inside = np.isfinite(found.depth[0])
        assert inside.mean() > 0.4
        expected = output["depth"][0, 0].reshape(found.depth[0].shape).numpy()
        np.testing.assert_allclose(found.depth[0][inside], expected[inside], rtol=1e-4)


def test_weights_of_the_other_size_are_refused(create: Create, photographs: Photographs) -> None:
    predictor = create("da3-base")
    predictor._architecture.channels = 768
    with pytest.raises(WeightsError, match=r"weights\.pt: these are weights with 32 channels, not DA3-BASE.*768"):
        predictor.predict([photographs.group(WIDE, WIDE)])


def test_nothing_of_a_portrait_photograph_is_cut(
    make: Make, photographs: Photographs, monkeypatch: pytest.MonkeyPatch
) -> None:
    predictor = make()
    encoded = count_encoded(predictor, monkeypatch)
    group = photographs.group(PORTRAIT, WIDE)
    [found] = predictor.predict([group])
    loaded = load_images([view.image for view in group], "pad")
    assert loaded.images.shape == (2, 3, 518, 518)
    torch.testing.assert_close(torch.stack(encoded), loaded.images)
    np.testing.assert_allclose(found.map_from_image, np.hstack([loaded.scale, loaded.offset]))
    assert load_images([group[0].image], "crop").offset[0, 1] < -800, "that is what the other way would cut"


@pytest.mark.slow
def test_a_map_image_in_groups_of_other_sizes(make: Make, photographs: Photographs) -> None:
    """Its encoding in one group is of no use in the other."""
    reference = photographs.view()
    groups = [[photographs.view(size, in_map=False), reference] for size in (WIDE, HIGHER, PORTRAIT)]
    predictor = make()
    for found, group in zip(predictor.predict(groups), groups, strict=True):
        assert_same(found, make().predict([group])[0])
    assert predictor._cache.bytes == sum(32 * 4 * 37 * rows for rows in (8, 9, 37))


@pytest.mark.parametrize("size", [WIDE, HIGHER, PORTRAIT])
def test_a_blob_is_where_the_map_says(
    make: Make, photographs: Photographs, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]
) -> None:
    group = photographs.group(size, HIGHER)
    width, height = size
    center = np.array([0.3 * width, 0.7 * height])
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    blob = np.exp(-((x - center[0]) ** 2 + (y - center[1]) ** 2) / (2 * 4.0**2))
    Image.fromarray(np.rint(255 * blob).astype(np.uint8)).save(group[0].image)
    predictor = make()
    encoded = count_encoded(predictor, monkeypatch)
    [found] = predictor.predict([group])
    assert found.map_from_image is not None
    seen = encoded[0][0].numpy().astype(np.float64)
    scale, offset = found.map_from_image[0, :2], found.map_from_image[0, 2:]
    x, y = np.meshgrid(np.arange(518) + 0.5, np.arange(len(seen)) + 0.5)
    near = np.hypot(x - (scale * center + offset)[0], y - (scale * center + offset)[1]) < 20
    weight = seen * near
    at = np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()
    np.testing.assert_allclose(at, scale * center + offset, atol=0.05)


@pytest.mark.slow
def test_groups_do_not_change_each_other(make: Make, photographs: Photographs, monkeypatch: pytest.MonkeyPatch) -> None:
    groups = [photographs.group(*sizes) for sizes in ([WIDE] * 3, [HIGHER] * 2, [WIDE] * 3, [WIDE] * 2, [WIDE] * 3)]
    predictor = make(batch_size=2)
    shapes = record_shapes(predictor, monkeypatch)
    together = predictor.predict([*groups, []])
    assert sorted(shapes) == [(1, 2), (1, 2), (1, 3), (2, 3)]
    for found, group in zip(together, groups, strict=False):
        assert len(found.model_from_cams) == len(group)
        assert_same(found, make().predict([group])[0])
    assert together[-1].model_from_cams.shape == (0, 4, 4)


@pytest.mark.slow
def test_map_images_are_encoded_once(make: Make, photographs: Photographs, monkeypatch: pytest.MonkeyPatch) -> None:
    references = [photographs.view() for _ in range(4)]
    groups = [[photographs.view(in_map=False), *references[start : start + 3]] for start in (0, 1, 0)]
    predictor, forgetful = make(batch_size=2), make(cache_bytes=0)
    encoded = count_encoded(predictor, monkeypatch)  # both share the network
    first = predictor.predict(groups)
    assert len(encoded) == 4 + 3
    second = predictor.predict(groups)
    assert len(encoded) == 4 + 3 + 3, "queries are not kept"
    for one, other, expected in zip(first, second, forgetful.predict(groups), strict=True):
        assert_same(one, other)
        assert_same(one, expected)
    assert len(encoded) == 4 + 3 + 3 + 12
    for reference in references:
        reference.image.unlink()
    assert np.isfinite(predictor.predict(groups)[1].model_from_cams).all(), "what is kept is not read again"


def test_the_cache_forgets_the_longest_unused() -> None:
    cache = TokenCache(100)
    for key in "abc":
        cache.put(key, torch.zeros(10))
    assert cache.get("a") is None
    assert cache.get("b") is not None
    cache.put("d", torch.ones(10))
    assert ("b" in cache, "c" in cache, "d" in cache) == (True, False, True)
    cache.put("too large", torch.zeros(26))
    cache.put("d", torch.zeros(10))
    assert cache.bytes == 80
    assert cache.get("d")[0] == 1  # type: ignore[index]


def test_bfloat16_is_near_and_keeps_half_as_much(make: Make, photographs: Photographs) -> None:
    groups = [photographs.group(WIDE, WIDE, WIDE)]
    exact, predictor = make(), make(dtype_compute="bfloat16")
    [expected], [found], [again] = exact.predict(groups), predictor.predict(groups), predictor.predict(groups)
    assert predictor._cache.bytes * 2 == exact._cache.bytes
    error = np.abs(found.model_from_cams - expected.model_from_cams).max()
    assert 1e-6 < error < 0.1
    assert_same(again, found)


# Memory


def short_of_memory(predictor: NetworkPredictor, monkeypatch: pytest.MonkeyPatch, most: int) -> list[tuple[int, int]]:
    """Make the network fail on more views in all than that; returns a list that fills with what it is asked."""
    shapes: list[tuple[int, int]] = []
    forward = predictor._model.forward

    def fails(images: torch.Tensor, *rest: Any) -> Any:
        shapes.append((images.shape[0], images.shape[1]))
        if images.shape[0] * images.shape[1] > most:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return forward(images, *rest)

    monkeypatch.setattr(predictor._model, "forward", fails)
    return shapes


@pytest.mark.slow
def test_what_does_not_fit_after_all_is_halved(
    make: Make, photographs: Photographs, monkeypatch: pytest.MonkeyPatch
) -> None:
    groups = [photographs.group(*[WIDE] * 4) for _ in range(6)]
    predictor = make(batch_size=4)
    expected = predictor.predict(groups)
    shapes = short_of_memory(predictor, monkeypatch, most=8)
    for found, other in zip(predictor.predict(groups), expected, strict=True):
        assert_same(found, other)
    assert shapes == [(4, 4), (2, 4), (2, 4), (2, 4)], "what did not fit is not tried again"


def test_memory_for_not_even_one_group(make: Make, photographs: Photographs, monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = make()
    short_of_memory(predictor, monkeypatch, most=1)
    with pytest.raises(ToolkitError, match="one of the groups of 3 views of 518 x 112 pixels"):
        predictor.predict([photographs.group(WIDE, WIDE, WIDE)])


# What is wrong with files


@pytest.mark.slow
def test_a_reference_that_cannot_be_read_is_left_out(
    make: Make, photographs: Photographs, caplog: pytest.LogCaptureFixture
) -> None:
    groups = [photographs.group(*[WIDE] * 4) for _ in range(3)]
    predictor = make(batch_size=3)
    whole = predictor.predict(groups)
    bad = groups[1][2]
    bad.image.write_bytes(b"not an image")
    fresh = make(batch_size=3)
    found = fresh.predict(groups)
    assert_same(found[0], whole[0])
    assert_same(found[2], whole[2])
    assert str(bad.image) in caplog.text
    [expected] = fresh.predict([[groups[1][0], groups[1][1], groups[1][3]]])
    order = [0, 1, 3]
    np.testing.assert_allclose(found[1].model_from_cams[order], expected.model_from_cams, atol=2e-5)
    assert found[1].depth is not None
    np.testing.assert_allclose(np.stack(found[1].depth)[order], expected.depth, rtol=1e-4)
    assert np.isnan(found[1].model_from_cams[2]).all()
    assert np.isnan(found[1].depth_at(2, [[50.0, 40.0]])).all()


def test_a_query_that_cannot_be_read_fails_alone(
    make: Make, photographs: Photographs, caplog: pytest.LogCaptureFixture
) -> None:
    groups = [photographs.group(WIDE, WIDE, WIDE) for _ in range(4)]
    expected = make().predict(groups)
    groups[1][0].image.unlink()
    Image.new("RGB", (WIDE[0], 2 * WIDE[1])).save(groups[2][0].image)
    found = make(batch_size=4).predict(groups)
    for number in (0, 3):
        assert_same(found[number], expected[number])
    for number in (1, 2):
        assert found[number].model_from_cams.shape == (3, 4, 4)
        assert np.isnan(found[number].model_from_cams).all()
        assert found[number].depth is None
    assert found[1].reason == f"Image not found: {groups[1][0].image}"
    assert found[0].reason == ""
    assert found[1].reason in caplog.text
    assert "Image of 370 x 160 pixels" in caplog.text
    assert "its camera has 370 x 80" in caplog.text


def test_a_prediction_that_is_no_camera(make: Make, photographs: Photographs, monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = make()
    forward = predictor._model.forward

    def spoils(*arguments: Any) -> Any:
        output = forward(*arguments)
        output["pose_enc"][:, 1, 3:7] = 0.0
        output["pose_enc"][:, 2, 0] = float("nan")
        return output

    monkeypatch.setattr(predictor._model, "forward", spoils)
    [found] = predictor.predict([photographs.group(*[WIDE] * 4)])
    assert np.isfinite(found.model_from_cams).all(axis=(1, 2)).tolist() == [True, False, False, True]


def test_settings_and_what_is_refused(make: Make, tmp_path: Path) -> None:
    predictor = make()
    assert predictor.settings["dtype_compute"] == "float32"
    assert make(dtype_compute="bfloat16").settings != predictor.settings == make().settings
    (tmp_path / "model.pt").write_bytes(b"stands for other weights")
    assert make().settings["weights"] != predictor.settings["weights"]
    for wrong, error, named in (
        (lambda: make(dtype_compute="float16"), ManifestError, "'float16'; VGGT .* one of auto, float32, bfloat16"),
        (lambda: NetworkPredictor(tmp_path / "none.pt"), WeightsError, r"none\.pt"),
    ):
        with pytest.raises(error, match=named):
            wrong()


def test_weights_are_held_once(make: Make, photographs: Photographs, tmp_path: Path) -> None:
    """A stage localizes, then its notebook looks into one query."""
    group = photographs.group(WIDE, WIDE)
    first, second = make(), make()
    expected, found = first.predict([group])[0], second.predict([group])[0]
    assert first._model is second._model
    assert np.array_equal(expected.model_from_cams, found.model_from_cams)
    (tmp_path / "model.pt").write_bytes(b"stands for other weights")
    assert make()._model is not first._model


def test_a_network_is_let_go_before_another_is_loaded(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """The memory may hold one, and not two; nor does a load that fails keep the one before."""
    held = weakref.ref(make()._model)
    assert held() is not None

    def refuse(*_: Any, **__: Any) -> VGGT:
        assert held() is None
        raise WeightsError("no such weights")

    with monkeypatch.context() as patch:
        patch.setattr(VGGT, "from_checkpoint", refuse)
        for _ in range(2):
            with pytest.raises(WeightsError):
                _ = make(dtype_compute="bfloat16")._model
    assert make(dtype_compute="bfloat16")._model is not None


def test_a_file_of_another_network_is_refused_when_loaded(
    tmp_path: Path, photographs: Photographs, caplog: pytest.LogCaptureFixture
) -> None:
    torch.save({"aggregator.camera_token": torch.zeros(1, 2, 1, 32)}, tmp_path / "other.pt")
    predictor = NetworkPredictor(tmp_path / "other.pt", "cpu", "float32")
    caplog.set_level(logging.ERROR)
    with pytest.raises(WeightsError):
        predictor.predict([photographs.group(WIDE, WIDE)])


@pytest.mark.slow
@pytest.mark.parametrize("turns", [1, 2, 3])
@pytest.mark.parametrize("size", [WIDE, PORTRAIT])
def test_a_rolled_camera_is_shown_upright_and_answered_as_it_is(
    make: Make, photographs: Photographs, size: tuple[int, int], turns: int
) -> None:
    """A photograph stored upright, and stored after turns: its camera differs by the turn, its depth is turned."""
    query, upright = photographs.view(size), photographs.view(size)
    path = upright.image.with_name("rolled.png")
    Image.fromarray(turn_image(read_image(upright.image), -turns)).save(path)
    width, height = size[:: -1 if turns % 2 else 1]
    params = [size[0], size[0], width / 2, height / 2]
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
    rolled = View("rolled", path, camera, in_map=True, turns=turns)
    expected, found = make().predict([[query, upright], [query, rolled]])
    np.testing.assert_allclose(found.model_from_cams[0], expected.model_from_cams[0], atol=1e-6)
    model_from_turned = found.model_from_cams[1] @ invert(turned_from_cam(turns))
    np.testing.assert_allclose(model_from_turned, expected.model_from_cams[1], atol=1e-6)
    pixels = np.random.default_rng(0).uniform(1, np.array(size) - 1, (40, 2))
    depth = found.depth_at(1, turn_points(pixels, *size, -turns))
    np.testing.assert_allclose(depth, expected.depth_at(1, pixels), rtol=1e-4)
    assert np.isfinite(depth).any()
