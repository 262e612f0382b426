"""Reranking: inliers of known geometry, what chance gives, and the stage from files to files."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest

from tests.calls import call
from tests.other_kind import add_other_kind
from tests.rendered import copy_shared
from toolkit import rerank
from toolkit.capture import Capture, Trajectory
from toolkit.errors import ArtifactError, ManifestError, ToolkitError
from toolkit.evaluate import overlap_table
from toolkit.features import matching as verification
from toolkit.features.features import KINDS, LocalFeatures, MutualMatcher, SiftExtractor
from toolkit.features.matching import LocalMethod, is_meaningful, verified_matches
from toolkit.files import SceneFiles, read_references, sidecar_path
from toolkit.geometry import invert, make_pose, transform
from toolkit.manifest import RerankSettings
from toolkit.rerank import rerank_pairs
from toolkit.results.metrics import overlap_in_view
from toolkit.retrieve import retrieve_pairs

WIDE = pycolmap.Camera(model="PINHOLE", width=960, height=720, params=[700, 700, 480, 360])
BENT = pycolmap.Camera(model="OPENCV", width=640, height=480, params=[430, 428, 319, 242, -0.25, 0.04, 0, 0])
LIST = "keyframes_original"


def turned(degrees: float, center: tuple[float, float, float]) -> np.ndarray:
    """Return world_from_cam, turned about the vertical."""
    a = np.radians(degrees)
    rotation = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return make_pose(rotation, np.array(center))


def two_views(count: int, right: int, seed: int = 0, center: tuple[float, float, float] = (1.2, 0.1, 0.3)) -> Any:
    """Return matched pixels of two cameras, the first `right` of which see the same points, and scores that say so."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.5, -1.2, 4], [1.5, 1.2, 9], (count, 3))
    pixels_a = np.asarray(WIDE.img_from_cam(points))
    pixels_b = np.asarray(BENT.img_from_cam(transform(invert(turned(-8, center)), points)))
    pixels_b[right:] = rng.uniform(0, [640, 480], (count - right, 2))
    scores = np.where(np.arange(count) < right, 0.9, 0.7) + rng.uniform(0, 0.1, count)
    return pixels_a + rng.normal(0, 0.3, (count, 2)), pixels_b + rng.normal(0, 0.3, (count, 2)), scores


# ------------------------------------------------------------------------------------------------ inliers


def count_inliers(*args: Any, **kwargs: Any) -> int:
    return verified_matches(*args, **kwargs).distinct


@pytest.mark.parametrize("right", [40, 80, 200])
def test_matches_of_one_scene_are_inliers(right: int) -> None:
    pixels_a, pixels_b, scores = two_views(200, right)
    found = count_inliers(WIDE, pixels_a, BENT, pixels_b, scores, RerankSettings())
    assert 0.85 * right <= found <= right + 0.1 * (200 - right)


def test_distortion_is_taken_into_account(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-4, -3, 4], [4, 3, 6], (400, 3))  # up to the edges, where distortion is large
    pixels_a = np.asarray(WIDE.img_from_cam(points))
    pixels_b = np.asarray(BENT.img_from_cam(transform(invert(turned(-8, (1.2, 0.1, 0.3))), points)))
    seen = ((pixels_a > 0) & (pixels_a < [960, 720]) & (pixels_b > 0) & (pixels_b < [640, 480])).all(axis=1)
    pixels_a, pixels_b, scores = pixels_a[seen], pixels_b[seen], np.ones(seen.sum())
    settings = RerankSettings()
    monkeypatch.setattr(verification, "MAX_ERROR_DEG", 0.08)
    ideal = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=BENT.params[:4])
    assert count_inliers(WIDE, pixels_a, BENT, pixels_b, scores, settings) > 0.95 * seen.sum()
    assert count_inliers(WIDE, pixels_a, ideal, pixels_b, scores, settings) < 0.5 * seen.sum()


def test_a_camera_that_only_turned_still_agrees() -> None:
    pixels_a, pixels_b, scores = two_views(150, 150, center=(0, 0, 0))
    assert count_inliers(WIDE, pixels_a, BENT, pixels_b, scores, RerankSettings()) > 120


@pytest.mark.parametrize("count", [6, 12, 30, 100, 300, 800])
def test_random_matches_count_nothing(count: int) -> None:
    for seed in range(5):
        pixels_a, pixels_b, scores = two_views(count, 0, seed)
        assert count_inliers(WIDE, pixels_a, BENT, pixels_b, scores, RerankSettings(seed=seed), tests=30) == 0


def test_what_shares_a_keypoint_counts_once() -> None:
    pixels_a, pixels_b, scores = two_views(60, 60)
    once = count_inliers(WIDE, pixels_a, BENT, pixels_b, scores, RerankSettings())
    tripled = [np.repeat(values, 3, axis=0) for values in (pixels_a, pixels_b, scores)]
    assert count_inliers(WIDE, tripled[0], BENT, tripled[1], tripled[2], RerankSettings()) <= once + 2


def test_degenerate_matches_count_nothing_or_little() -> None:
    none = np.zeros((0, 2))
    assert count_inliers(WIDE, none, BENT, none, np.zeros(0), RerankSettings()) == 0
    pixels_a, pixels_b, scores = two_views(5, 5)
    assert count_inliers(WIDE, pixels_a, BENT, pixels_b, scores, RerankSettings()) == 0
    one_place = np.full((50, 2), 100.0)
    assert count_inliers(WIDE, one_place, BENT, one_place, np.ones(50), RerankSettings()) == 0


def test_meaning_grows_with_inliers_and_shrinks_with_matches_and_tests() -> None:
    assert not is_meaningful(5, 5, 1e-9)  # any five agree
    assert is_meaningful(20, 30, 0.02)
    assert not is_meaningful(20, 400, 0.02)
    least = [next(k for k in range(6, 100) if is_meaningful(k, 100, 0.02, tests)) for tests in (1, 30, 1000)]
    assert least == sorted(least)
    assert least[0] < least[2]
    assert not is_meaningful(50, 50, 1.0)


# ------------------------------------------------------------------------------------------------ overlap


def test_overlap_is_the_share_of_points_in_view() -> None:
    points = np.array([[x, 0.0, 5.0] for x in np.linspace(-3, 3, 61)])
    seen = np.abs(points[:, 0]) < 5 * 480 / 700
    here = turned(0, (0, 0, 0))
    assert overlap_in_view(points, np.zeros(3), here, WIDE) == pytest.approx(seen.mean())
    assert overlap_in_view(points, np.zeros(3), turned(180, (0, 0, 0)), WIDE) == 0  # looks away
    assert overlap_in_view(points, np.zeros(3), turned(180, (0, 0, 10)), WIDE) == 0  # from behind
    assert overlap_in_view(points[:0], np.zeros(3), here, WIDE) == 0


# ------------------------------------------------------------------------------------------------ files to files


@pytest.fixture(scope="module")
def finished(small_capture: Path, small_embedded: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    """A retrieval in the phone's map in reversed order, reranked; do not write to it."""
    files = SceneFiles(tmp_path_factory.mktemp("run"), small_capture.name)
    copy_shared(small_embedded, files.root)
    sessions = small_capture / "sessions"
    retrieve_pairs(
        sessions, files.embeddings, files.retrieval_dir, {"topk": 6}, map_device="ios", query_device="hl", queries=LIST
    )
    path = files.retrieval("ios", "hl")
    rows = read_references(path)
    for row in rows:  # the best come last, so that there is something to put right
        row["topk"] = [
            hit | {"rank": rank, "score": 1 - 0.1 * rank} for rank, hit in enumerate(row["topk"][::-1], start=1)
        ]
    write(path, rows)
    run(small_capture, files)
    return files


@pytest.fixture
def files(finished: SceneFiles, tmp_path: Path) -> SceneFiles:
    """A copy of the run, to work in."""
    copy = SceneFiles(tmp_path / "run", finished.scene)
    copy_shared(finished.root, copy.root)
    return copy


def run(capture: Path, files: SceneFiles, **more: Any) -> Any:
    options = {"map_device": "ios", "query_device": "hl", "topn": 6, "topk": 4, "workers": 1} | more
    return call(rerank_pairs, capture / "sessions", files.retrieval_dir, files.features, files.reranked_dir, **options)


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    sidecar_path(path).unlink(missing_ok=True)  # changed on purpose


def reranked(files: SceneFiles) -> Path:
    return files.reranked_dir / files.retrieval("ios", "hl").name


def test_the_right_references_come_first(small_capture: Path, finished: SceneFiles) -> None:
    folders = {"retrieved": finished.retrieval_dir, "reranked": finished.reranked_dir}
    row = overlap_table(small_capture / "sessions", folders, None, "ios", "hl").iloc[0]
    assert row["state"] == "evaluated"
    assert row["images"] == len(read_references(reranked(finished)))
    assert row["reranked_mean"] > row["retrieved_mean"]
    assert row["reranked"] >= row["retrieved"]


def test_rows_are_those_of_retrieval_with_both_scores(finished: SceneFiles) -> None:
    before = read_references(finished.retrieval("ios", "hl"))
    after = read_references(reranked(finished))
    assert len(before) == len(after) > 0
    for old, new in zip(before, after, strict=True):
        assert {key: new[key] for key in old if key != "topk"} == {key: old[key] for key in old if key != "topk"}
        assert [hit["rank"] for hit in new["topk"]] == [1, 2, 3, 4]
        order = [(-hit["score"], hit["retrieval_rank"]) for hit in new["topk"]]
        assert order == sorted(order)
        for hit in new["topk"]:
            source = old["topk"][hit["retrieval_rank"] - 1]
            assert hit["retrieval_score"] == source["score"]
            assert {key: hit[key] for key in source if key not in ("rank", "score")} == {
                key: source[key] for key in source if key not in ("rank", "score")
            }
            assert 0 <= hit["score"] <= hit["num_matches"]
    assert any(row["topk"][0]["retrieval_rank"] > 1 for row in after)


def test_bytes_do_not_depend_on_threads(small_capture: Path, files: SceneFiles) -> None:
    before = reranked(files).read_bytes()
    table = run(small_capture, files, skip_existing=False, workers=3)
    assert reranked(files).read_bytes() == before
    assert table["query_images"].tolist() == (table["confirmed"] + table["kept"]).tolist()
    assert table["changed"].item() > 0


def test_what_is_current_is_reused_and_a_killed_run_goes_on(
    small_capture: Path, files: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = reranked(files).read_bytes()
    assert run(small_capture, files)["skipped"].tolist() == [True]
    asked: list[int] = []
    rank = verification.Verifier.rank

    def count(self: Any, *arguments: Any) -> Any:
        asked.append(1)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return rank(self, *arguments)

    monkeypatch.setattr(verification.Verifier, "rank", count)
    sidecar_path(reranked(files)).unlink()
    with pytest.raises(KeyboardInterrupt):
        run(small_capture, files)
    queries = len(before.splitlines())
    again = len(asked)
    run(small_capture, files)
    assert len(asked) - again < queries  # some were finished before
    assert reranked(files).read_bytes() == before
    assert not list(files.reranked_dir.glob(".*"))
    assert run(small_capture, files, topk=2)["skipped"].tolist() == [False]
    assert all(len(row["topk"]) == 2 for row in read_references(reranked(files)))


def test_a_run_killed_after_the_file_was_written_leaves_no_progress_beside_it(
    small_capture: Path, files: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    sidecar_path(reranked(files)).unlink()
    with monkeypatch.context() as patch:
        patch.setattr(rerank, "remove_items", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run(small_capture, files)
    assert list(files.reranked_dir.glob(".*"))
    assert run(small_capture, files)["skipped"].tolist() == [True]
    assert not list(files.reranked_dir.glob(".*"))


@pytest.mark.slow
def test_another_map_that_turns_the_images_makes_the_file_anew(
    small_capture: Path, files: SceneFiles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_other_kind(monkeypatch)
    capture = Path(shutil.copytree(small_capture, tmp_path / "data" / small_capture.name))
    path = capture / "sessions/hl_map/trajectories.txt"

    def skipped(features: str) -> bool:
        return bool(run(capture, files, features=features, topn=2, topk=2)["skipped"].item())

    def flip() -> None:
        poses = Trajectory.read(path)
        flipped = poses.world_from_device @ np.diag([1.0, -1, -1, 1])
        Trajectory.from_poses(poses.timestamps, poses.device_ids, flipped).write(path)

    assert [skipped("other"), skipped("other")] == [False, True]
    flip()
    assert [skipped("other"), skipped("other")] == [False, True]
    assert [skipped("sift"), skipped("sift")] == [False, True]
    flip()
    assert skipped("sift"), "nothing is turned"


def test_a_query_that_fails_keeps_the_order_of_retrieval(
    small_capture: Path, files: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = read_references(files.retrieval("ios", "hl"))
    rows[0]["topk"] = []
    write(files.retrieval("ios", "hl"), rows)

    def broken(*_: Any) -> Any:
        raise RuntimeError("no such luck")

    before = MutualMatcher.match
    monkeypatch.setattr(MutualMatcher, "match", broken)
    table = run(small_capture, files)
    found = read_references(reranked(files))
    assert table["kept"].item() == table["query_images"].item() == len(rows)
    assert "no reference" in found[0]["reason"]
    for old, new in zip(rows[1:], found[1:], strict=True):
        assert new["reason"] == "internal: RuntimeError: no such luck"
        assert [hit["path"] for hit in new["topk"]] == [hit["path"] for hit in old["topk"][:4]]
        assert all(hit["score"] == 0 for hit in new["topk"])
    monkeypatch.setattr(MutualMatcher, "match", before)
    again = run(small_capture, files)
    assert not again["skipped"].item(), "what a fault of the toolkit left undone is tried again"
    assert again["kept"].item() < table["kept"].item()
    assert run(small_capture, files)["skipped"].item()
    assert not list(files.reranked_dir.glob(".*"))


@pytest.mark.parametrize("error", [MemoryError("no room"), OSError(5, "input/output error"), ToolkitError("no device")])
def test_what_is_no_property_of_a_query_ends_the_stage(
    small_capture: Path, files: SceneFiles, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def broken(*_: Any) -> Any:
        raise error

    monkeypatch.setattr(MutualMatcher, "match", broken)
    with pytest.raises(type(error)):
        run(small_capture, files, skip_existing=False)


def test_a_network_matches_all_references_of_a_query_at_once(
    small_capture: Path, files: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What stands in for a network finds the same matches, so the order is that of `mutual`."""
    batches: list[int] = []
    matcher = MutualMatcher.of(KINDS["sift"])

    class Network:
        batch_size = 8
        settings: ClassVar[dict[str, Any]] = {"name": "network"}

        def match(self, pairs: Sequence[Any]) -> Any:
            batches.append(len(pairs))
            return matcher.match(pairs)

    run(small_capture, files)
    expected = reranked(files).read_bytes()
    asked: list[RerankSettings] = []

    def create(settings: RerankSettings) -> list[LocalMethod]:
        asked.append(settings)
        return [LocalMethod("sift", SiftExtractor(), Network())]

    monkeypatch.setattr(rerank, "create_local_methods", create)
    glue = {"name": "lightglue", "checkpoint": "glue.safetensors"}
    table = run(small_capture, files, features="superpoint", matcher=glue)
    (settings,) = asked
    assert settings.features.kinds == ["superpoint"]
    assert (settings.matcher.name, settings.matcher.checkpoint) == ("lightglue", "glue.safetensors")
    assert not table["skipped"].item(), "other matches, another file"
    assert batches == [6] * table["query_images"].item()
    assert reranked(files).read_bytes() == expected


def test_an_image_without_features_is_named(small_capture: Path, files: SceneFiles, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(small_capture, tmp_path / "data" / small_capture.name))
    session = Capture.open(capture)["hl_query"]
    row = read_references(files.retrieval("ios", "hl"))[0]
    (session.path.parent / rerank._name(row)).write_bytes(b"no image")
    run(capture, files)
    found = read_references(reranked(files))
    assert "cannot be decoded" in found[0]["reason"]
    assert found[1]["reason"] == ""


@pytest.mark.slow
def test_sessions_may_have_the_names_of_lamar(small_capture: Path, files: SceneFiles, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(small_capture, tmp_path / "data" / small_capture.name))
    (capture / "sessions" / "hl_query").rename(capture / "sessions" / "query_hololens")
    path = files.retrieval("ios", "hl")
    path.write_text(path.read_text().replace("/hl_query/", "/query_hololens/"))
    expected = reranked(files).read_text().replace("/hl_query/", "/query_hololens/")
    run(capture, files)
    assert reranked(files).read_text() == expected


def test_wrong_settings_and_files_are_refused(small_capture: Path, files: SceneFiles) -> None:
    path = files.retrieval("ios", "hl")
    whole = path.read_text()
    elsewhere = whole.splitlines()[0].replace("ios_map/raw_data/", "ios_map/raw_data/x")
    for text, options, error, named in (
        (whole, {"matcher": "lightglue"}, ManifestError, "lightglue"),
        (whole, {"topk": 7}, ManifestError, "topk is 7"),
        (whole + "{}\n", {}, ArtifactError, rf"\.jsonl, line {whole.count(chr(10)) + 1}"),
        (elsewhere + "\n", {}, ArtifactError, "belongs to another capture"),
        (None, {}, ArtifactError, "Run the retrieve stage first"),
    ):
        path.write_text(text) if text else path.unlink()
        with pytest.raises(error, match=named):
            run(small_capture, files, **options)


def test_map_images_in_memory_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verification, "MAP_IMAGES_KEPT", 2)
    features = LocalFeatures(
        np.zeros((9, 2), np.float32), *[np.ones(9, np.float32)] * 2, np.zeros((9, 128), np.uint8), (640, 480)
    )
    read: list[str] = []

    class Store(dict[str, LocalFeatures]):
        def __getitem__(self, name: str) -> LocalFeatures:
            read.append(name)
            return features

    store = Store(dict.fromkeys("abc", features))
    verifier = verification.Verifier(RerankSettings(max_features=4), MutualMatcher(0.8), store)
    for name in "ababcab":
        verifier.rank(features, WIDE, [name], [WIDE])
    assert read == ["a", "b", "c", "a", "b"]
    assert len(verifier._map_features("a")) == 4
