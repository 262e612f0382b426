"""Files of features and matches: what they give back, and that they never give old features for new."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.features.test_matching import features_of, random_units
from tests.features.test_sift import assert_same, textured
from toolkit.capture import Session, write_session
from toolkit.capture.images import read_image
from toolkit.errors import ArtifactError
from toolkit.features import stores
from toolkit.features.features import LocalFeatures, MutualMatcher, PairMatches, SiftExtractor, SiftSettings
from toolkit.features.stores import (
    FeatureStore,
    MatchStore,
    extract_session,
    features_path,
    match_name,
    match_sessions,
    write_matches,
)
from toolkit.store.items import Items


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


def test_a_folder_gives_back_what_was_extracted(session: Session, tmp_path: Path) -> None:
    class Edge:
        """Gives keypoints next to the border, where a shift by half a pixel would cost bits of a float32."""

        color, batch_size, threaded = False, 1, False
        settings: ClassVar[dict[str, Any]] = {"name": "edge"}

        def __init__(self, descriptors: NDArray[Any]):
            self.features = LocalFeatures(
                np.float32([[0.1, 0.2], [0.49999, 7], [3.3, 1e-6]]), *np.float32([[1, 2, 3], [0.3, 0.2, 0.1]]),
                descriptors, (320, 240), 3,
            )  # fmt: skip

        def extract(self, images: list[NDArray[np.uint8]]) -> list[LocalFeatures]:
            return [self.features] * len(images)

    rng = np.random.default_rng(0)
    for dtype in (np.uint8, np.float16, np.float32):
        edge = Edge((rng.random((3, 8)) * 200).astype(dtype))
        written = extract_session(session, tmp_path / np.dtype(dtype).name, edge)[session.image_name(0)]
        assert_same(written, edge.features)
        assert written.descriptors.dtype == dtype
        assert written.turns == 3


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


def shard_of(store: FeatureStore) -> Path:
    (shard,) = store.path.iterdir()
    return shard


@pytest.mark.parametrize("keep", [0, 100, 0.5, -1])
def test_a_torn_file_is_made_anew(
    session: Session, tmp_path: Path, keep: float, caplog: pytest.LogCaptureFixture
) -> None:
    store = extract(session, tmp_path / "features")
    shard = shard_of(store)
    content = shard.read_bytes()
    size = len(content) - 1 if keep == -1 else int(keep * len(content)) if 0 < keep < 1 else int(keep)
    shard.write_bytes(content[:size])
    again = extract(session, tmp_path / "features")
    assert f"{shard} is damaged" in caplog.text
    for row in (0, 2, 3, 4, 5):
        name = session.image_name(row)
        assert_same(again[name], SiftExtractor(SETTINGS).extract([textured(row)])[0])
    assert again.fingerprint == store.fingerprint
    assert shard_of(store).stat().st_size == len(content)


def test_open_refuses_a_folder_without_features(session: Session, tmp_path: Path) -> None:
    store = extract(session, tmp_path / "features")
    shard_of(store).write_bytes(b"torn")
    for path in (store.path, tmp_path / "nowhere"):
        with pytest.raises(ArtifactError, match="no local features"):
            FeatureStore.open(path)


def test_features_of_older_versions_are_not_used_and_that_is_said(
    session: Session, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "features" / session.id
    folder.mkdir(parents=True)
    (folder / "sift-0123456789abcdef.h5").write_bytes(b"")
    assert len(extract(session, tmp_path / "features")) == 5
    assert f"{folder}: features in .h5 files" in caplog.text
    caplog.clear()
    extract(session, tmp_path / "features")
    assert not caplog.text


def test_a_stopped_run_keeps_what_it_finished(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(path: Path, gray: bool = False) -> NDArray[np.uint8]:
        if "/b/" in str(path):
            raise KeyboardInterrupt
        return read_image(path, gray)

    monkeypatch.setattr(stores, "read_image", stopped)
    with pytest.raises(KeyboardInterrupt):
        extract(session, tmp_path / "features", workers=1)
    assert not list((tmp_path / "features").rglob("*partial*"))
    seen = count_reads(monkeypatch)
    store = extract(session, tmp_path / "features")
    assert sorted(seen) == ["b/images/0.png", "b/images/1.png"]
    assert len(store) == 5
    assert [path.name for path in store.path.parent.iterdir()] == [store.path.name]


KILLED = """
import os, signal, sys
import numpy as np
from toolkit.features import features as sift
from toolkit.features import stores
from toolkit.capture import Session
from toolkit.store import items

folder, out = sys.argv[1:]
items.SHARD_SECONDS = 0.0
class Killed(sift.SiftExtractor):
    count = 0
    def extract(self, images):
        self.count += 1
        if self.count == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().extract(images)
killed = Killed(sift.SiftSettings(min_long_side=0, max_keypoints=200))
stores.prefetch = lambda function, items, workers: map(function, items)  # the one before has been written
stores.extract_session(Session.open(folder), out, killed, progress=False)
"""


def test_a_killed_writer_loses_no_more_than_a_shard(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "features"
    first = extract(session, out, rows=np.array([5]))  # an image is already there
    ended = subprocess.run([sys.executable, "-c", KILLED, str(session.path), str(out)], check=False)
    assert ended.returncode == -signal.SIGKILL
    seen = count_reads(monkeypatch)
    store = extract(session, out)
    assert sorted(seen) == ["b/images/0.png"]
    for row in (0, 2, 3, 4, 5):
        assert_same(store[session.image_name(row)], SIFT.extract([textured(row)])[0])
    assert not list(first.path.parent.rglob(".*"))


def test_a_folder_says_what_it_was_made_from(session: Session, tmp_path: Path) -> None:
    store = extract(session, tmp_path / "features")
    opened = FeatureStore.open(store.path)
    assert opened.settings == store.settings == SIFT.settings
    assert opened.made_from == store.made_from
    assert store.path == features_path(tmp_path / "features", "ios_map", SIFT.settings)


def test_an_image_that_is_listed_twice_is_there_once(session: Session, tmp_path: Path) -> None:
    images = session.path / "images.txt"
    lines = images.read_text().splitlines()
    images.write_text("\n".join([*lines, lines[-1]]) + "\n")
    twice = Session.open(session.path)
    assert len(twice.camera_rows) == 5
    assert len(extract(twice, tmp_path / "features")) == 5


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
    content = shard_of(store).read_bytes()
    quarter = len(content) // 4
    shard_of(store).write_bytes(content[:quarter] + bytes(2 * quarter) + content[3 * quarter :])
    with pytest.raises(ArtifactError, match="is made again"):
        list(store.values())


NAMES = ("ios_query/raw_data/a/1.jpg", "hl_map/raw_data/b/2.jpg")


@pytest.mark.parametrize("count", [100, 40_000, 70_000])
def test_matches_come_back_in_either_order(tmp_path: Path, count: int) -> None:
    indices = np.array([[3, 0], [0, count - 1], [99, 7]])
    matches = PairMatches(indices, np.array([0.5, 1.0, 0.25], np.float32))
    with Items(tmp_path / "matches") as items:
        write_matches(items, match_name(*NAMES), "key", matches)
    store = MatchStore(tmp_path / "matches")
    np.testing.assert_array_equal(store[NAMES].indices, indices[[1, 0, 2]])
    np.testing.assert_array_equal(store[NAMES].scores, matches.scores[[1, 0, 2]])
    np.testing.assert_array_equal(store[NAMES[::-1]].indices, indices[[1, 0, 2], ::-1])
    assert store[NAMES].indices.dtype == np.int64
    assert store[NAMES].scores.dtype == np.float32
    with pytest.raises(KeyError):
        store["other.jpg", NAMES[1]]


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
