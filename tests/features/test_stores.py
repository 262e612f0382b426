"""Files of features and matches: what they give back, and that they never give old features for new."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import cv2
import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.features.test_matching import features_of, random_units
from tests.features.test_sift import assert_same, textured
from toolkit.capture import Session, write_session
from toolkit.capture.images import read_image
from toolkit.errors import ArtifactError
from toolkit.features import groups, stores
from toolkit.features.features import (
    LocalFeatures,
)
from toolkit.features.groups import GroupWriter
from toolkit.features.matching import (
    MutualMatcher,
    PairMatches,
    unit_descriptors,
)
from toolkit.features.sift import SiftExtractor, SiftSettings
from toolkit.features.stores import (
    FeatureStore,
    MatchStore,
    as_stored,
    extract_session,
    features_path,
    group_names,
    match_sessions,
    write_matches,
)
from toolkit.files import is_current, sidecar_path


@pytest.fixture
def session(tmp_path: Path) -> Session:
    """Two subsessions of three and two pictures, and a sensor that is no camera."""
    path = tmp_path / "CAP" / "sessions" / "ios_map"
    rows = [(1000 + k, "a/cam", f"a/images/{k}.png") for k in range(3)]
    rows += [(2000 + k, "b/cam", f"b/images/{k}.png") for k in range(2)]
    rows.insert(1, (1000, "a/depth", "a/depth/0.png"))
    for seed, (_, _, name) in enumerate(rows):
        (path / "raw_data" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path / "raw_data" / name), textured(seed))
    pinhole = ("camera", "PINHOLE", 320, 240, 300, 300, 160, 120)
    sensors = [
        ("a/cam", "cam", *pinhole),
        ("b/cam", "cam", *pinhole),
        ("a/depth", "d", "depth", "PINHOLE", 320, 240, 1, 1, 1, 1),
    ]
    write_session(path, sensors, None, None, rows, subsessions=["a", "b"])
    return Session.open(path)


SETTINGS = SiftSettings(min_long_side=0, max_keypoints=200)
SIFT = SiftExtractor(SETTINGS)


def extract(session: Session, out: Path, settings: SiftSettings = SETTINGS, **more: object) -> FeatureStore:
    return extract_session(session, out, SiftExtractor(settings), progress=False, **more)  # type: ignore[arg-type]


def count_reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the names of the images that are decoded from now on."""
    seen: list[str] = []

    def spy(path: Path, gray: bool = False) -> NDArray[np.uint8]:
        seen.append("/".join(Path(path).parts[-3:]))
        return read_image(path, gray)

    monkeypatch.setattr(stores, "read_image", spy)
    return seen


def test_store_holds_every_photograph_as_the_extractor_gives_it(session: Session, tmp_path: Path) -> None:
    store = extract(session, tmp_path / "features")
    cameras = [row for row in range(6) if row != 1]
    assert sorted(store) == sorted(session.image_name(row) for row in cameras)
    assert store.failed == {}
    assert session.image_name(1) not in store
    for row in cameras:
        assert_same(store[session.image_name(row)], SiftExtractor(SETTINGS).extract([textured(row)])[0])
    with pytest.raises(KeyError):
        store["ios_map/raw_data/nowhere.png"]


def test_what_a_file_gives_back_is_known_without_writing_it(session: Session, tmp_path: Path) -> None:
    class Edge:
        """Gives keypoints next to the border, where a shift by half a pixel costs bits of a float32."""

        color, batch_size, threaded = False, 1, False
        settings: ClassVar[dict[str, Any]] = {"name": "edge"}

        def __init__(self, descriptors: NDArray[Any]):
            self.features = LocalFeatures(
                np.float32([[0.1, 0.2], [0.49999, 7], [3.3, 1e-6]]), *np.float32([[1, 2, 3], [0.3, 0.2, 0.1]]),
                descriptors, (320, 240),
            )  # fmt: skip

        def extract(self, images: list[NDArray[np.uint8]]) -> list[LocalFeatures]:
            return [self.features] * len(images)

    rng = np.random.default_rng(0)
    for dtype in (np.uint8, np.float16, np.float32):
        edge = Edge((rng.random((3, 8)) * 200).astype(dtype))
        written = extract_session(session, tmp_path / np.dtype(dtype).name, edge)[session.image_name(0)]
        stored = as_stored(edge.features)
        assert_same(written, stored)
        assert stored.descriptors.dtype == written.descriptors.dtype == dtype
        np.testing.assert_array_equal(stored.descriptors, edge.features.descriptors)
        assert (stored.keypoints != edge.features.keypoints).any(), "this is why it matters"
    assert_same(as_stored(SIFT.extract([textured(0)])[0]), extract(session, tmp_path / "f")[session.image_name(0)])


def test_a_second_call_reads_no_image_and_gives_the_same(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = extract(session, tmp_path / "features", workers=1)
    seen = count_reads(monkeypatch)
    again = extract(session, tmp_path / "features", workers=2)
    assert seen == []
    assert list(first) == list(again)
    assert first.fingerprint == again.fingerprint
    for name in first:
        assert_same(first[name], again[name])
    opened = FeatureStore.open(first.path)
    assert sorted(opened) == sorted(first)
    extract(session, tmp_path / "features", skip_existing=False)
    assert len(seen) == 5


def test_only_the_rows_asked_for_are_made_and_others_are_added_later(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = count_reads(monkeypatch)
    store = extract(session, tmp_path / "features", rows=np.array([5]))
    assert seen == ["b/images/1.png"]
    assert list(store) == [session.image_name(5)]
    before = store.fingerprint
    seen.clear()
    everything = extract(session, tmp_path / "features")
    assert sorted(seen) == [f"a/images/{k}.png" for k in range(3)] + ["b/images/0.png"]
    assert len(everything) == 5
    assert everything.path == store.path
    assert_same(store[session.image_name(5)], everything[session.image_name(5)])  # the old file stays open
    again = extract(session, tmp_path / "features", rows=np.array([5]))
    assert list(again) == [session.image_name(5)]
    assert again.fingerprint == before  # what rests on these rows does not change with what else is there
    assert len(extract(session, tmp_path / "features", rows=np.zeros(0, np.int64))) == 0


def test_a_changed_image_is_made_anew(session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = extract(session, tmp_path / "features")
    name, old, before = session.image_name(4), store[session.image_name(4)], store.fingerprint
    cv2.imwrite(str(session.image_path(4)), textured(99))
    seen = count_reads(monkeypatch)
    after = extract(session, tmp_path / "features")
    assert seen == ["b/images/0.png"]
    assert_same(after[name], SiftExtractor(SETTINGS).extract([textured(99)])[0])
    assert not np.array_equal(after[name].keypoints, old.keypoints)
    assert after.fingerprint != before


@pytest.mark.parametrize("change", [{"max_keypoints": 50}, {"min_long_side": 640}, {"max_long_side": 160}])
def test_changed_settings_make_everything_anew(session: Session, tmp_path: Path, change: dict) -> None:
    before = extract(session, tmp_path / "features").fingerprint
    settings = SETTINGS.model_copy(update=change)
    after = extract(session, tmp_path / "features", settings)
    name = session.image_name(0)
    assert_same(after[name], SiftExtractor(settings).extract([textured(0)])[0])
    assert after.fingerprint != before
    assert extract(session, tmp_path / "features").fingerprint == before  # and back


def test_unreadable_images_are_listed_and_the_others_are_not_lost(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session.image_path(0).write_bytes(b"this is no picture")
    session.image_path(5).unlink()
    store = extract(session, tmp_path / "features")
    assert len(store) == 3
    assert set(store.failed) == {session.image_name(0), session.image_name(5)}
    assert "cannot be decoded" in store.failed[session.image_name(0)]
    assert "not found" in store.failed[session.image_name(5)]
    seen = count_reads(monkeypatch)
    again = extract(session, tmp_path / "features")
    assert again.failed == store.failed
    assert seen == []  # known to be unreadable: not tried again
    cv2.imwrite(str(session.image_path(5)), textured(5))
    repaired = extract(session, tmp_path / "features")
    assert set(repaired.failed) == {session.image_name(0)}
    assert session.image_name(5) in repaired


@pytest.mark.parametrize("keep", [0, 100, 0.5, -1])
def test_a_torn_file_is_made_anew(
    session: Session, tmp_path: Path, keep: float, caplog: pytest.LogCaptureFixture
) -> None:
    store = extract(session, tmp_path / "features")
    content = store.path.read_bytes()
    size = len(content) - 1 if keep == -1 else int(keep * len(content)) if 0 < keep < 1 else int(keep)
    store.path.write_bytes(content[:size])
    assert sidecar_path(store.path).exists()  # the record says that all is well
    again = extract(session, tmp_path / "features")
    assert f"{store.path} is torn" in caplog.text
    for row in (0, 2, 3, 4, 5):
        name = session.image_name(row)
        assert_same(again[name], SiftExtractor(SETTINGS).extract([textured(row)])[0])
    assert again.fingerprint == store.fingerprint
    assert store.path.stat().st_size > 0.9 * len(content)


def test_a_file_of_the_right_size_that_is_no_hdf5_is_made_anew(session: Session, tmp_path: Path) -> None:
    store = extract(session, tmp_path / "features")
    store.path.write_bytes(b"\0" * store.path.stat().st_size)
    assert_same(extract(session, tmp_path / "features")[session.image_name(0)], SIFT.extract([textured(0)])[0])


def test_open_refuses_a_torn_file_and_one_of_something_else(session: Session, tmp_path: Path) -> None:
    path = extract(session, tmp_path / "features").path
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ArtifactError, match="cannot be read"):
        FeatureStore.open(path)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["numbers"] = np.zeros(3)
    with pytest.raises(ArtifactError, match="no local features"):
        FeatureStore.open(tmp_path / "other.h5")


def test_a_file_without_its_record_is_made_anew(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sidecar_path(extract(session, tmp_path / "features").path).unlink()
    seen = count_reads(monkeypatch)
    assert len(extract(session, tmp_path / "features")) == len(seen) == 5


def test_a_stopped_run_keeps_what_it_finished(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(path: Path, gray: bool = False) -> NDArray[np.uint8]:
        if "/b/" in str(path):
            raise KeyboardInterrupt
        return read_image(path, gray)

    monkeypatch.setattr(groups, "PART_GROUPS", 2)
    monkeypatch.setattr(stores, "read_image", stopped)
    with pytest.raises(KeyboardInterrupt):
        extract(session, tmp_path / "features", workers=1)
    assert not list((tmp_path / "features").rglob("*partial*"))
    seen = count_reads(monkeypatch)
    store = extract(session, tmp_path / "features")
    assert sorted(seen) == ["b/images/0.png", "b/images/1.png"]
    assert len(store) == 5
    assert sorted(path.name for path in store.path.parent.iterdir()) == [
        store.path.name, sidecar_path(store.path).name
    ]  # fmt: skip


KILLED = """
import os, signal, sys
import numpy as np
from toolkit.features import groups, sift, stores
from toolkit.capture import Session

folder, out = sys.argv[1:]
groups.PART_GROUPS = 2
class Killed(sift.SiftExtractor):
    count = 0
    def extract(self, images):
        self.count += 1
        if self.count == 4:  # two images are in a whole part, the third in one that is being written
            os.kill(os.getpid(), signal.SIGKILL)
        return super().extract(images)
killed = Killed(sift.SiftSettings(min_long_side=0, max_keypoints=200))
stores.prefetch = lambda function, items, workers: map(function, items)  # the one before has been written
stores.extract_session(Session.open(folder), out, killed, progress=False)
"""


def test_a_killed_writer_loses_no_more_than_a_part(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "features"
    first = extract(session, out, rows=np.array([5]))  # a whole file is already there
    ended = subprocess.run([sys.executable, "-c", KILLED, str(session.path), str(out)], check=False)
    assert ended.returncode == -signal.SIGKILL
    left = list(first.path.parent.glob(f".{first.path.name}.parts/.*partial*"))
    assert len(left) == 1  # torn, under a name that nobody takes for a part
    left[0].rename(left[0].with_name("00001.h5"))  # and under one that might be
    seen = count_reads(monkeypatch)
    store = extract(session, out)
    assert sorted(seen) == ["a/images/2.png", "b/images/0.png"]
    for row in (0, 2, 3, 4, 5):
        assert_same(store[session.image_name(row)], SIFT.extract([textured(row)])[0])
    assert not list(first.path.parent.glob(".*"))


def test_the_record_beside_a_file_says_what_it_was_made_from(session: Session, tmp_path: Path) -> None:
    store = extract(session, tmp_path / "features")
    record = json.loads(sidecar_path(store.path).read_text())["settings"]
    assert record["made_by"]["max_keypoints"] == 200
    assert record["groups"] == store.made_from
    assert is_current(store.path, record)
    assert store.path == features_path(tmp_path / "features", "ios_map", SIFT.settings)


def test_an_image_that_is_listed_twice_is_there_once(session: Session, tmp_path: Path) -> None:
    images = session.path / "images.txt"
    lines = images.read_text().splitlines()
    images.write_text("\n".join([*lines, lines[-1]]) + "\n")
    twice = Session.open(session.path)
    assert len(twice.camera_rows) == 5
    assert len(extract(twice, tmp_path / "features")) == 5


def hloc_features(path: Path, name: str) -> dict[str, NDArray]:
    """Read an image's features as hloc's matcher does, and its keypoints as hloc's triangulation does."""
    with h5py.File(str(path), "r", libver="latest") as file:
        return {key: item.__array__() for key, item in file[name].items()}


def test_files_are_in_the_layout_of_hloc(session: Session, tmp_path: Path) -> None:
    store = extract(session, tmp_path / "features")
    name = session.image_name(0)
    ours, theirs = store[name], hloc_features(store.path, name)
    np.testing.assert_array_equal(theirs["keypoints"] + 0.5, ours.keypoints)  # "COLMAP origin"
    assert theirs["descriptors"].shape == (128, len(ours))
    np.testing.assert_array_equal(theirs["descriptors"].T.astype(np.float32), unit_descriptors(ours.descriptors))
    np.testing.assert_allclose(np.linalg.norm(theirs["descriptors"].astype(np.float32), axis=0), 1, atol=0.02)
    np.testing.assert_array_equal(theirs["scores"], ours.scores)
    assert theirs["image_size"].tolist() == [320, 240]
    with h5py.File(store.path) as file:  # every data set is an image's: hloc takes its parent for one
        items: dict[str, bool] = {}
        file.visititems(lambda key, item: items.update({key: isinstance(item, h5py.Dataset)}))
        assert {key.rpartition("/")[0] for key, is_dataset in items.items() if is_dataset} == set(store)
        assert file.attrs["top_left_pixel_center"] == 0


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
    store = FeatureStore.open(path)
    assert list(store) == ["db/1.jpg"]
    found = store["db/1.jpg"]
    assert found.keypoints.dtype == np.float32
    np.testing.assert_array_equal(found.keypoints, xy.astype(np.float32) + 0.5)
    np.testing.assert_array_equal(found.descriptors, descriptors.T)
    np.testing.assert_array_equal(unit_descriptors(found.descriptors), descriptors.T.astype(np.float32))
    np.testing.assert_array_equal(found.scales, np.ones(50, np.float32))
    assert found.image_size == (1000, 800)


class Batched:
    """An extractor as a network is one: in color, some images at a time, float descriptors."""

    color, batch_size, threaded = True, 2, False

    def __init__(self) -> None:
        self.calls: list[list[tuple[int, ...]]] = []

    @property
    def settings(self) -> dict:
        return {"name": "corners"}

    def extract(self, images: list[NDArray[np.uint8]]) -> list[LocalFeatures]:
        self.calls.append([image.shape for image in images])
        one, place = np.ones(1, np.float32), np.array([[0.25, 7]], np.float32)
        means = [np.full((1, 4), image.mean() / 512, np.float16) for image in images]
        return [LocalFeatures(place, one, one, mean, (320, 240)) for mean in means]


def test_a_network_gets_batches_in_color_and_its_numbers_come_back(session: Session, tmp_path: Path) -> None:
    session.image_path(2).unlink()
    corners = Batched()
    store = extract_session(session, tmp_path / "features", corners, progress=False)
    assert [shape for call in corners.calls for shape in call] == [(240, 320, 3)] * 4
    assert max(map(len, corners.calls)) == 2
    assert set(store.failed) == {session.image_name(2)}
    for row in (0, 3, 4, 5):
        found = store[session.image_name(row)]
        np.testing.assert_allclose(found.keypoints, [[0.25, 7]], atol=1e-7)
        mean = np.float16(read_image(session.image_path(row)).mean() / 512)
        np.testing.assert_array_equal(found.descriptors, np.full((1, 4), mean, np.float16))
    both = extract(session, tmp_path / "features")
    assert both.path != store.path
    assert both.fingerprint != store.fingerprint


def test_the_same_features_from_a_copy_of_the_capture_elsewhere(session: Session, tmp_path: Path) -> None:
    """The cache rests on names, sizes and times of files, not on where the capture lies."""
    extract(session, tmp_path / "features")
    moved = tmp_path / "elsewhere" / "CAP"
    shutil.copytree(tmp_path / "CAP", moved, copy_function=shutil.copy2)
    os.sync()
    again = extract(Session.open(moved / "sessions" / "ios_map"), tmp_path / "features2")
    assert again.fingerprint == extract(session, tmp_path / "features").fingerprint


def test_image_of_another_size_than_its_camera_is_listed(session: Session, tmp_path: Path) -> None:
    cv2.imwrite(str(session.image_path(0)), textured(0)[::2, ::2])
    store = extract(session, tmp_path / "features", rows=np.array([0, 2]))
    assert list(store) == [session.image_name(2)]
    assert "sensors.txt says" in store.failed[session.image_name(0)]


def test_a_damaged_file_says_what_to_do(session: Session, tmp_path: Path) -> None:
    store = extract(session, tmp_path / "features")
    content = store.path.read_bytes()
    quarter = len(content) // 4
    store.path.write_bytes(content[:quarter] + bytes(2 * quarter) + content[3 * quarter :])
    with pytest.raises(ArtifactError, match="is made again"):
        list(store.values())


def hloc_matches(path: Path, name0: str, name1: str) -> tuple[NDArray[np.int64], NDArray[np.float16]]:
    """Read the matches of a pair as hloc does."""
    with h5py.File(str(path), "r", libver="latest") as file:
        group = file["/".join((name0.replace("/", "-"), name1.replace("/", "-")))]
        matches, scores = group["matches0"].__array__(), group["matching_scores0"].__array__()
    index = np.where(matches != -1)[0]
    return np.stack([index, matches[index]], -1), scores[index]


NAMES = ("ios_query/raw_data/a/1.jpg", "hl_map/raw_data/b/2.jpg")


@pytest.mark.parametrize(("count", "kind"), [(100, np.int16), (40_000, np.int32)])
def test_matches_are_in_the_layout_of_hloc_and_come_back(tmp_path: Path, count: int, kind: type) -> None:
    path = tmp_path / "matches.h5"
    indices = np.array([[0, count - 1], [3, 0], [99, 7]])
    matches = PairMatches(indices, np.array([0.5, 1.0, 0.25], np.float32))
    with GroupWriter(path, {"name": "test"}) as writer:
        write_matches(writer, group_names([NAMES])[NAMES], "key", (100, count), matches)
        writer.finish()
    found, scores = hloc_matches(path, *NAMES)
    with h5py.File(path) as file:
        assert file["ios_query-raw_data-a-1.jpg/hl_map-raw_data-b-2.jpg/matches0"].dtype == kind
    np.testing.assert_array_equal(found, indices)
    np.testing.assert_array_equal(scores, matches.scores)
    store = MatchStore(path)
    np.testing.assert_array_equal(store[NAMES].indices, indices)
    np.testing.assert_array_equal(store[NAMES].scores, matches.scores)
    np.testing.assert_array_equal(store[NAMES[::-1]].indices, indices[:, ::-1])
    with pytest.raises(KeyError):
        store["other.jpg", NAMES[1]]
    torn = tmp_path / "torn.h5"
    torn.write_bytes(path.read_bytes()[:600])
    with pytest.raises(ArtifactError, match="Match again"):
        MatchStore(torn)[NAMES]
    content = path.read_bytes()
    torn.write_bytes(content[: len(content) // 8] + bytes(len(content) - len(content) // 8))
    with pytest.raises(ArtifactError, match=r"run its stage again|Match again"):
        MatchStore(torn)[NAMES]


class Counting(MutualMatcher):
    """Counts the pairs that it is given, some at a time."""

    batch_size = 2

    def __init__(self) -> None:
        super().__init__(0.9)
        self.calls: list[int] = []

    def match(self, pairs):  # type: ignore[no-untyped-def]
        self.calls.append(len(pairs))
        return super().match(pairs)


class Features(FeatureStore):
    """Features in memory."""

    def __init__(self, images: dict[str, LocalFeatures], made_from: str):
        super().__init__(Path(), dict.fromkeys(images, made_from), settings={"name": "test"})
        self.images = images

    def __getitem__(self, name: str) -> LocalFeatures:
        return self.images[name]


def test_pairs_of_sessions_are_matched_once_in_batches_and_others_added(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = {f"m/{k}.jpg": features_of(random_units(rng, 30)) for k in range(4)}
    queries, maps = Features({"q/1.jpg": images["m/2.jpg"]}, "a"), Features(images, "b")
    matcher, sessions = Counting(), ("ios_query", "hl_map")
    pairs = [("q/1.jpg", f"m/{k}.jpg") for k in range(3)]
    asked = [*pairs, pairs[0], ("q/1.jpg", "m/unknown.jpg")]
    store = match_sessions((queries, maps), asked, matcher, tmp_path, sessions)
    assert matcher.calls == [2, 1]
    assert store.path.parent == tmp_path / "ios_query-hl_map"
    assert [len(store[pair]) for pair in pairs][2] == 30
    for name0, name1 in pairs:
        (expected,) = MutualMatcher(0.9).match([(queries[name0], maps[name1])])
        np.testing.assert_array_equal(store[name0, name1].indices, expected.indices)
    matcher.calls.clear()
    again = match_sessions((queries, maps), [*pairs, ("q/1.jpg", "m/3.jpg")], matcher, tmp_path, sessions)
    assert matcher.calls == [1]
    assert len(again[pairs[2]]) == 30
    match_sessions((Features(queries.images, "changed"), maps), pairs, matcher, tmp_path, sessions)
    assert matcher.calls == [1, 2, 1]


def test_names_that_differ_in_dash_and_slash_alone_keep_their_own_matches(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = {
        name: features_of(random_units(rng, 20 + k)) for k, name in enumerate(["a/b-c.jpg", "a-b/c.jpg", "d.jpg"])
    }
    features = Features(images, "key")
    matcher, sessions = Counting(), ("ios_map", "ios_map")
    pairs = [("a/b-c.jpg", "d.jpg"), ("a-b/c.jpg", "d.jpg"), ("a/b-c.jpg", "a-b/c.jpg")]
    for _ in range(2):
        store = match_sessions((features, features), pairs, matcher, tmp_path, sessions)
        for name0, name1 in pairs:
            (expected,) = MutualMatcher(0.9).match([(images[name0], images[name1])])
            np.testing.assert_array_equal(store[name0, name1].indices, expected.indices)
            np.testing.assert_array_equal(store[name1, name0].indices, expected.indices[:, ::-1])
    assert matcher.calls == [2, 1]  # the second time, all are there
    match_sessions((features, features), pairs[:1], matcher, tmp_path, sessions)
    assert matcher.calls == [2, 1]
    hloc_matches(store.path, *pairs[2])
