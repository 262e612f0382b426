"""Features and matches in the files of hloc, out and in again."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from tests.features.test_matching import features_of, random_units
from tests.features.test_sift import assert_same
from tests.rendered import copy_shared
from toolkit.__main__ import app
from toolkit.capture import Capture
from toolkit.errors import ArtifactError
from toolkit.exchange.export import export_features, export_matches, import_features, import_matches
from toolkit.features.features import LocalFeatures, MutualMatcher, PairMatches, unit_descriptors
from toolkit.features.stores import (
    FeatureStore,
    MatchStore,
    features_path,
    match_name,
    match_sessions,
    write_features,
    write_matches,
)  # fmt: skip
from toolkit.files import SceneFiles
from toolkit.manifest import MapSettings
from toolkit.mapping.build import build_map
from toolkit.store.items import Items

SETTINGS = {"name": "sift"}


@pytest.fixture(scope="module")
def run(small_capture: Path, small_features: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    """A run that has built the phone's map, in tiles; do not write to it."""
    files = SceneFiles(tmp_path_factory.mktemp("run"), small_capture.name)
    copy_shared(small_features, files.features)
    session = Capture.open(small_capture)["ios_map"]
    store = FeatureStore.of_session(files.features, session.id)
    build_map(session, store, files.maps / "ios_map.npz", MapSettings(tile_images=3))
    return files


def hloc_features(path: Path, name: str) -> dict[str, NDArray]:
    """Read an image's features as hloc's matcher does, and its keypoints as hloc's triangulation does."""
    with h5py.File(str(path), "r", libver="latest") as file:
        return {key: item.__array__() for key, item in file[name].items()}


def hloc_matches(path: Path, name0: str, name1: str) -> tuple[NDArray[np.int64], NDArray[np.float16]]:
    """Read the matches of a pair as hloc does."""
    with h5py.File(str(path), "r", libver="latest") as file:
        group = file["/".join((name0.replace("/", "-"), name1.replace("/", "-")))]
        matches, scores = group["matches0"].__array__(), group["matching_scores0"].__array__()
    index = np.where(matches != -1)[0]
    return np.stack([index, matches[index]], -1), scores[index]


def test_features_are_in_the_layout_of_hloc(run: SceneFiles, tmp_path: Path) -> None:
    path, store = tmp_path / "out" / "features.h5", FeatureStore.of_session(run.features, "ios_map")
    assert export_features(run.run, run.scene, "ios_map", path) == len(store)
    for name, ours in store.items():
        theirs = hloc_features(path, name)
        np.testing.assert_array_equal(theirs["keypoints"] + 0.5, ours.keypoints)  # "COLMAP origin"
        assert theirs["descriptors"].shape == (128, len(ours))
        np.testing.assert_array_equal(theirs["descriptors"].T.astype(np.float32), unit_descriptors(ours.descriptors))
        np.testing.assert_allclose(np.linalg.norm(theirs["descriptors"].astype(np.float32), axis=0), 1, atol=0.02)
        np.testing.assert_array_equal(theirs["scores"], ours.scores)
        assert theirs["image_size"].tolist() == list(ours.image_size)
    with h5py.File(path) as file:  # every data set is an image's: hloc takes its parent for one
        items: dict[str, bool] = {}
        file.visititems(lambda key, item: items.update({key: isinstance(item, h5py.Dataset)}))
        assert {key.rpartition("/")[0] for key, is_dataset in items.items() if is_dataset} == set(store)
        assert file.attrs["top_left_pixel_center"] == 0
    back = import_features(path, tmp_path / "back")
    assert set(back) == set(store)
    for name, ours in store.items():
        np.testing.assert_array_equal(back[name].keypoints, ours.keypoints)
        np.testing.assert_array_equal(back[name].scales, ours.scales)
        np.testing.assert_array_equal(unit_descriptors(back[name].descriptors), unit_descriptors(ours.descriptors))
    with pytest.raises(ArtifactError, match="0 folders of aliked features"):
        export_features(run.run, run.scene, "ios_map", path, "aliked")


def test_the_matches_of_a_map_are_in_the_layout_of_hloc(run: SceneFiles, tmp_path: Path) -> None:
    folders = sorted((run.maps / "ios_map-ios_map").iterdir())
    assert len(folders) > 1, "a folder a tile"
    done = CliRunner().invoke(
        app, ["export", "matches", str(run.run), run.scene, "ios_map", "ios_map", str(tmp_path / "matches.h5")]
    )
    pairs = [tuple(item.split("\n")) for folder in folders for item in Items(folder)]
    assert done.stdout.strip() == f"{tmp_path / 'matches.h5'}: {len(pairs)} pairs"
    stores = [MatchStore(folder) for folder in folders]
    back = import_matches(tmp_path / "matches.h5", pairs, tmp_path / "back")  # type: ignore[arg-type]
    features = FeatureStore.of_session(run.features, "ios_map")
    for name0, name1 in pairs:
        ours = next(store[name0, name1] for store in stores if match_name(name0, name1) in Items(store.path))
        indices, scores = hloc_matches(tmp_path / "matches.h5", name0, name1)
        np.testing.assert_array_equal(indices, ours.indices)
        np.testing.assert_array_equal(scores, ours.scores)
        np.testing.assert_array_equal(back[name0, name1].indices, ours.indices)
        np.testing.assert_array_equal(back[name1, name0].indices, ours.indices[:, ::-1])
    with h5py.File(tmp_path / "matches.h5") as file:
        group = file["/".join(name.replace("/", "-") for name in pairs[0])]
        assert group["matches0"].shape == group["matching_scores0"].shape == (len(features[pairs[0][0]]),)
        assert group["matches0"].dtype == np.int16


@pytest.mark.parametrize("ratios", [(), (0.8, 0.9)])
def test_matches_of_no_or_several_settings_are_refused(
    ratios: tuple[float, ...], run: SceneFiles, tmp_path: Path
) -> None:
    files = SceneFiles(tmp_path, run.scene)
    stores = [FeatureStore.of_session(run.features, "ios_map")] * 2
    for ratio in ratios:
        pairs = [tuple(stores[0])[:2]]
        match_sessions(tuple(stores), pairs, MutualMatcher(ratio), files.maps, ("ios_map", "ios_map"))  # type: ignore[arg-type]
    with pytest.raises(ArtifactError, match=f"{len(ratios)} settings"):
        export_matches(files.run, files.scene, "ios_map", "ios_map", tmp_path / "matches.h5")


def test_pairs_that_hloc_cannot_tell_apart_are_refused(tmp_path: Path) -> None:
    files, rng = SceneFiles(tmp_path, "S"), np.random.default_rng(0)
    with Items(features_path(files.features, "ios_map", SETTINGS), SETTINGS) as items:
        for name in ("a/b-c.jpg", "a-b/c.jpg", "d.jpg"):
            write_features(items, name, "key", features_of(random_units(rng, 20)))
    with Items(files.maps / "ios_map-ios_map" / "sift-x", {"features": [SETTINGS] * 2}) as items:
        for name in ("a/b-c.jpg", "a-b/c.jpg"):
            write_matches(items, match_name(name, "d.jpg"), "key", PairMatches.none())
    with pytest.raises(ArtifactError, match="cannot tell the pairs"):
        export_matches(files.run, "S", "ios_map", "ios_map", tmp_path / "matches.h5")
    assert not list(tmp_path.glob("*matches.h5"))


def test_many_features_need_more_bits(tmp_path: Path) -> None:
    files, one = SceneFiles(tmp_path, "S"), np.ones(100, np.float32)
    with Items(features_path(files.features, "ios_map", SETTINGS), SETTINGS) as items:
        write_features(items, "a", "", LocalFeatures(np.ones((100, 2), np.float32), one, one, np.ones((100, 8), np.uint8), (1, 1)))  # noqa: E501  # fmt: skip
    indices = np.array([[0, 39_999], [3, 0], [99, 7]])
    with Items(files.maps / "ios_map-ios_map" / "sift-x", {"features": [SETTINGS] * 2}) as items:
        write_matches(items, match_name("a", "b"), "", PairMatches(indices, np.array([0.5, 1.0, 0.25], np.float32)))
    assert export_matches(files.run, "S", "ios_map", "ios_map", tmp_path / "matches.h5") == 1
    np.testing.assert_array_equal(hloc_matches(tmp_path / "matches.h5", "a", "b")[0], indices)


def test_a_file_of_hloc_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "feats-superpoint-n4096-r1024.h5"
    xy = rng.uniform(0, 1000, (50, 2)).astype(np.float16)
    descriptors = rng.normal(size=(256, 50)).astype(np.float16)
    with h5py.File(path, "a", libver="latest") as file:
        group = file.create_group("db/1.jpg")
        group.create_dataset("keypoints", data=xy)
        group["keypoints"].attrs["uncertainty"] = 1.5
        group.create_dataset("descriptors", data=descriptors)
        group.create_dataset("scores", data=np.ones(50, np.float16))
        group.create_dataset("image_size", data=np.array([1000, 800]))
    store = import_features(path, tmp_path / "features")
    ones = np.ones(50, np.float32)
    assert list(store) == ["db/1.jpg"]
    expected = LocalFeatures(xy.astype(np.float32) + np.float32(0.5), ones, ones, descriptors.T, (1000, 800))
    assert_same(store["db/1.jpg"], expected)
    assert store["db/1.jpg"].keypoints.dtype == np.float32


OTHER = {"numbers": np.zeros(3), "a/b/matches0": np.zeros((3, 2), int)}


@pytest.mark.parametrize(("content", "pair", "named"), [
    (None, None, r"other\.h5 cannot be read"),
    (OTHER, None, "no local features"),
    (OTHER, ("a", "b"), "not in the layout of hloc"),
    (OTHER, ("a", "c"), "no matches of a and c"),
    ({"a/keypoints": np.zeros((3, 2))}, None, "a is not in the layout of hloc"),
])  # fmt: skip
def test_what_is_no_file_of_hloc_is_refused_by_name(
    content: dict[str, np.ndarray] | None, pair: tuple[str, str] | None, named: str, tmp_path: Path
) -> None:
    path = tmp_path / "other.h5"
    if content is not None:
        with h5py.File(path, "w") as file:
            file.update(content)
    with pytest.raises(ArtifactError, match=named):
        import_matches(path, [pair], tmp_path / "out") if pair else import_features(path, tmp_path / "out")
