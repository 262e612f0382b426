"""References, matches and results that show themselves, and a query that is tried with something changed."""

import pickle
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from tests.displayed import picture_of
from tests.rendered import localized_by_pnp
from toolkit.errors import ArtifactError
from toolkit.features.stores import FeatureStore
from toolkit.figures.answers import Answer
from toolkit.files import SceneFiles
from toolkit.geometry import transform
from toolkit.pose.base import Query, QueryResult, References, Rival, Status
from toolkit.runs.kernel import TEXT_BARS
from toolkit.scene.map import Map
from toolkit.scene.run import InspectedPair
from toolkit.viewer.queries import View3D


@pytest.fixture(scope="module")
def files(
    small_capture: Path, small_features: Path, made_once: Callable[[str, Callable[[Path], object]], Path]
) -> SceneFiles:
    """A run that has localized the phone in its own map by PnP; do not write to it."""

    run = made_once("located", lambda folder: localized_by_pnp(folder, small_capture, small_features, "ios"))
    return SceneFiles(run, small_capture.name)


@pytest.fixture(scope="module")
def scene_map(files: SceneFiles) -> Map:
    (pair,) = files.poses_dir.glob("*.h5")
    return Map.of_pair(pair, "ios", files.features, files.maps)


@pytest.fixture(scope="module")
def query(scene_map: Map) -> Query:
    session = scene_map.capture["ios_query"]
    return scene_map.query_of_session(session, session.camera_rows[:1])


@pytest.fixture(scope="module")
def references(scene_map: Map) -> list[References]:
    return [References.of(list(range(6)))]


@pytest.fixture(scope="module")
def result(scene_map: Map, query: Query, references: list[References]) -> QueryResult:
    return scene_map.solve(query, scene_map.match(query, references))


def test_the_verbs_by_hand_are_locate(
    scene_map: Map, query: Query, references: list[References], result: QueryResult
) -> None:
    located = scene_map.locate(query, references=references)
    np.testing.assert_array_equal(result.world_from_rig, located.world_from_rig)
    assert (result.status, result.num_inliers) == (Status.OK, located.num_inliers)
    assert repr(result).startswith("QueryResult(ok, at (")


def test_a_query_reads_no_features_of_the_map(
    files: SceneFiles, query: Query, references: list[References], result: QueryResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    (pair,) = files.poses_dir.glob("*.h5")
    opened = Map.of_pair(pair, "ios", files.features, files.maps)
    assert opened.localizer.image_names
    monkeypatch.setattr(FeatureStore, "__getitem__", Mock(side_effect=AssertionError("read for a query")))
    np.testing.assert_array_equal(opened.locate(query, references=references).world_from_rig, result.world_from_rig)


def test_a_result_shows_itself_with_its_true_error(scene_map: Map, result: QueryResult) -> None:
    answer = result.show()
    assert isinstance(answer, Answer)
    assert picture_of(answer).width > 800
    alone = replace(answer)  # `details` are cached; without references, their row was left empty
    alone.__dict__["details"] = replace(answer.details, references=[])
    assert alone.figure.get_size_inches()[1] < answer.figure.get_size_inches()[1] - 1
    true = scene_map.capture["ios_query"].world_from_cam([0], ground_truth=True)[0]
    np.testing.assert_allclose(answer.true_pose, true, atol=1e-12)
    assert answer.error[1] == pytest.approx(np.linalg.norm(true[:3, 3] - result.world_from_rig[:3, 3]))
    html = result._repr_html_()
    assert all(text in html for text in (">ok<", "data:image/jpeg", f"{result.num_inliers} of {result.num_matches}"))
    assert len(html) < 60_000, "a screen at most"


def test_a_result_of_no_map_says_so() -> None:
    alone = QueryResult.failed("too few <matches>")
    assert alone._repr_html_() == "<p>failed: too few &lt;matches&gt;</p>"
    for ask in (alone.show, alone.show_3d, alone.what_if):
        with pytest.raises(ArtifactError, match=r"Map\.locate"):
            ask()


def test_a_result_is_pickled_without_its_map_and_copied_with_it(result: QueryResult) -> None:
    again = pickle.loads(pickle.dumps(result))
    assert again.context is None
    np.testing.assert_array_equal(again.world_from_rig, result.world_from_rig)
    assert asdict(result)["context"] is result.context
    assert replace(result, seconds=1.0).context is result.context


def test_a_result_keeps_no_pixels_and_no_features(result: QueryResult) -> None:
    """A sequence keeps the results of hundreds of frames."""
    _, query, _ = result.context._opened  # type: ignore[union-attr]
    assert not query.features
    assert not any(view._decoded for view in query.views)


def test_one_thing_is_changed_and_nothing_is_written(files: SceneFiles, result: QueryResult) -> None:
    before = {path: path.stat().st_mtime_ns for path in files.run.rglob("*")}
    fewer = result.what_if(drop=[1, 2])
    assert fewer.changes == {"drop": [1, 2]}
    assert len(fewer.after.retrieved) == len(fewer.before.retrieved) - 2
    assert fewer.after.result.num_matches < result.num_matches
    same = result.what_if(drop=[fewer.before.references["name"].iloc[0]])
    assert fewer.before.references["name"].iloc[0] not in same.after.retrieved
    chosen = list(fewer.before.retrieved)[3]
    alone = result.what_if(references=[chosen.rpartition("/")[2]])
    assert list(alone.after.retrieved) == [chosen]
    longer = result.what_if(focal_px=1.15 * result.show().views[0].camera.mean_focal_length())
    assert longer.after.result.status_text == "low_confidence: camera?"
    assert longer.table.loc["status"].tolist() == ["ok", "low_confidence: camera?"]
    with pytest.raises(ArtifactError, match=r"map image: .* 'nowhere\.jpg'"):
        result.what_if(references=["nowhere.jpg"])
    assert {path: path.stat().st_mtime_ns for path in files.run.rglob("*")} == before


@pytest.mark.parametrize(
    "changes",
    [{"localize.features.sift.max_keypoints": 800}, {"localize": {"map": {"min_triangulation_angle_deg": 3.0}}}],
)
def test_points_that_the_map_does_not_have_are_made_for_the_references(
    result: QueryResult, changes: dict[str, object]
) -> None:
    after = result.what_if(changes).after.result
    assert after.status is Status.OK
    assert (after.correspondences.point_index < 0).all(), "in no map file"
    np.testing.assert_allclose(after.world_from_rig, result.world_from_rig, atol=0.02)


@pytest.mark.slow
def test_features_that_retry_may_also_come_first(result: QueryResult, learned_weights: None) -> None:
    """It was refused, as ALIKED is the fallback of `auto`: "expected each kind once"."""
    both = result.what_if({"localize.features": ["sift", "aliked"], "localize.matcher": "mutual"}).after
    assert both.result.status is Status.OK
    assert {kind.partition("/")[0] for kind in both.matches.index} == {"sift", "aliked"}


def test_matches_with_one_reference_are_drawn(scene_map: Map, query: Query, references: list[References]) -> None:
    matches = scene_map.match(query, references)
    assert "matches with map points" in matches._repr_html_()  # type: ignore[attr-defined]
    assert picture_of(scene_map.show_matches(matches, 2)).width > 400
    with pytest.raises(ArtifactError, match=r"a reference from 1 to 6"):
        scene_map.show_matches(matches, 7)


def test_a_map_and_results_are_shown_in_3d(
    scene_map: Map, result: QueryResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TEXT_BARS, "1")
    away = result.world_from_rig.copy()
    away[0, 3] += 1.0
    doubted = replace(result, rivals=(Rival(away, 0.9),))
    lost = replace(QueryResult.failed("no consistent pose"), context=result.context)
    view = doubted.show_3d(lost, rays=True)
    assert isinstance(view, View3D)
    assert picture_of(view).width > 800
    labels = [line.get_label() for line in view.figure.axes[0].collections]
    assert any(label.startswith("rival, 90% of the support") for label in labels)
    assert view.save(tmp_path / "view.rrd").stat().st_size > 100_000
    assert picture_of(scene_map.show_3d()).width > 800
    assert scene_map.show_3d().save(tmp_path / "map.rrd").stat().st_size > 10_000, "a map without queries"


def test_rivals_outside_the_map_are_counted(result: QueryResult) -> None:
    """Five, each with its support, made a title wider than the figure."""
    far = result.world_from_rig.copy()
    far[:2, 3] += 500.0
    figure = replace(result, rivals=(Rival(far, 0.4),) * 5).show().figure
    titles = [axis.get_title() for part in figure.subfigs for axis in part.axes]
    assert "from above\noutside the picture: 5 rivals" in titles


def test_the_eye_sees_the_chosen_camera_in_the_middle(scene_map: Map) -> None:
    from toolkit.figures.top_view import Eye

    poses, up = scene_map.session.world_from_cam(), np.array([0.0, 0.0, 2.0])
    away = poses[0] + 1000 * np.eye(4)[:, [3]] * np.array([0, 0, 0, 1])
    for others in ([], [poses[0]], [away]):
        eye = Eye.of(poses, up, others)
        assert np.linalg.norm(eye.target - poses[:, :3, 3].mean(0)) < 500, "not where a query of elsewhere was taken"
        (seen,) = transform(eye.eye_from_world, eye.target)
        np.testing.assert_allclose(seen[:2], 0.0, atol=1e-9)
        assert seen[2] > 1.0
        (above,) = transform(eye.eye_from_world, eye.target + up)
        assert above[1] < seen[1], "y is down"


def test_a_stored_result_is_looked_at_without_the_map(files: SceneFiles, tmp_path: Path) -> None:
    """Features, points and weights are needed only to localize again."""
    copied = Path(shutil.copytree(files.root, tmp_path / files.scene))
    shutil.rmtree(copied / "features")
    one = InspectedPair("ios", "ios", copied / "poses").look(0)
    assert picture_of(one.result.show()).width > 800
    with pytest.raises(ArtifactError):
        one.result.what_if()
