"""VLAD: finds the same place again, is the same bytes each time, and survives little data."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from toolkit.embedders import create_embedder, resolve_name
from toolkit.embedders import vlad as vlad_module
from toolkit.embedders.vlad import MIN_SCALE_PX, Vlad
from toolkit.errors import ArtifactError, ManifestError, ToolkitError, WeightsError
from toolkit.features.features import LocalFeatures


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"MAX_WORDS": 16, "LOCAL_DIM": 16, "MIN_FEATURES": 20, "SAMPLE_DESCRIPTORS": 3000}
    for name, value in sizes.items():
        monkeypatch.setattr(vlad_module, name, value)


def features_of(descriptors: np.ndarray, scale: float = MIN_SCALE_PX) -> LocalFeatures:
    count = len(descriptors)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    quantized = np.clip(np.round(root * 512), 0, 255).astype(np.uint8)
    return LocalFeatures(
        np.zeros((count, 2), np.float32), np.full(count, scale, np.float32), np.ones(count, np.float32), quantized,
        (640, 480),
    )  # fmt: skip


def places(count: int, views: int, noise: float, seed: int) -> list[LocalFeatures]:
    """`views` images of each of `count` places: the place's descriptors, some replaced, with noise."""
    rng = np.random.default_rng(1)
    truth = [rng.gamma(0.5, size=(150, 128)) for _ in range(count)]
    rng = np.random.default_rng(seed)
    images = []
    for place in truth:
        for _ in range(views):
            view = place[rng.permutation(150)[:110]] * (1 + noise * rng.random((110, 128)))
            images.append(features_of(np.concatenate([view, rng.gamma(0.5, size=(40, 128))])))
    return images


def learn(images: list[LocalFeatures], seed: int = 0) -> Vlad:
    return Vlad.learn(lambda: iter(images), len(images), seed)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_finds_the_same_place() -> None:
    database, queries = places(8, 2, 0.3, seed=2), places(8, 1, 0.3, seed=3)
    vlad = learn(database)
    similarity = unit(vlad.embed(queries)) @ unit(vlad.embed(database)).T
    assert (similarity.argmax(axis=1) // 2).tolist() == list(range(8))
    assert vlad.dim <= len(database)


def test_same_bytes_each_time_and_after_reading(tmp_path: Path) -> None:
    database = places(4, 2, 0.3, seed=2)
    first, second = learn(database), learn(database)
    first.save(tmp_path / "a.npz")
    second.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    read = create_embedder("vlad", vocabulary=tmp_path / "a.npz")
    assert read.settings == first.settings
    np.testing.assert_array_equal(read.embed(database), first.embed(database))
    learn(database, seed=1).save(tmp_path / "c.npz")
    assert (tmp_path / "c.npz").read_bytes() != (tmp_path / "a.npz").read_bytes()


def test_batches_do_not_matter() -> None:
    database = places(3, 2, 0.3, seed=2)
    vlad = learn(database)
    singly = np.concatenate([vlad.embed([image]) for image in database])
    np.testing.assert_allclose(vlad.embed(database), singly, atol=1e-6)


def test_shrinkage_follows_the_number_of_images(monkeypatch: pytest.MonkeyPatch) -> None:
    def spread(prior: int) -> float:
        monkeypatch.setattr(vlad_module, "PRIOR_IMAGES", prior)
        lengths = np.linalg.norm(learn(places(4, 3, 0.3, seed=2)).projection, axis=0)
        return float(lengths.max() / lengths.min())

    assert spread(0) > 1.5, "no prior: whitened"
    assert spread(10**6) < 1.01, "a strong prior: only rotated"


def test_fine_keypoints_are_left_out_unless_there_are_no_others() -> None:
    database = places(4, 2, 0.3, seed=2)
    vlad = learn(database)
    coarse = database[0]
    clutter = features_of(np.random.default_rng(5).gamma(0.5, size=(300, 128)), scale=0.5)
    both = LocalFeatures(
        np.concatenate([clutter.keypoints, coarse.keypoints]),
        np.concatenate([clutter.scales, coarse.scales]),
        np.concatenate([clutter.scores, coarse.scores]),
        np.concatenate([clutter.descriptors, coarse.descriptors]),
        (640, 480),
    )
    np.testing.assert_allclose(vlad.embed([both]), vlad.embed([coarse]), atol=1e-6)
    assert np.linalg.norm(vlad.embed([clutter])) > 0


def test_an_image_without_features_is_a_zero_row() -> None:
    vlad = learn(places(3, 2, 0.3, seed=2))
    empty = features_of(np.zeros((0, 128)))
    assert not vlad.embed([empty]).any()
    assert vlad.embed([]).shape == (0, vlad.dim)


@pytest.mark.parametrize("images", [[], [features_of(np.zeros((0, 128)))]])
def test_nothing_to_learn_from(images: Iterable[LocalFeatures]) -> None:
    with pytest.raises(ToolkitError, match="cannot be learned"):
        learn(list(images))


def test_one_image_is_enough() -> None:
    images = places(1, 1, 0.3, seed=2)
    vlad = learn(images)
    assert vlad.dim == 1
    assert np.isfinite(vlad.embed(images)).all()


def test_a_file_that_is_no_vocabulary(tmp_path: Path) -> None:
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04torn")
    for name, named in (("none.npz", "run the embed stage"), ("torn.npz", r"torn\.npz")):
        with pytest.raises(ArtifactError, match=named):
            Vlad.load(tmp_path / name)


@pytest.mark.usefixtures("no_hub")
def test_names(tmp_path: Path) -> None:
    assert resolve_name("auto") == "vlad"
    for wrong, error, named in (
        (lambda: create_embedder("megaloc"), WeightsError, r"MegaLoc: no weights.*\n.*\n.*`embed\.model: vlad`"),
        (lambda: create_embedder("vald"), ManifestError, "Unknown embedder 'vald'.*vlad"),
        (lambda: resolve_name("auto", tmp_path / "none.pt"), WeightsError, r"no weights file .*none\.pt"),
    ):
        with pytest.raises(error, match=named):
            wrong()
    weights = tmp_path / "weights.safetensors"
    weights.write_bytes(b"some")
    assert resolve_name("auto", weights) == "megaloc"
