"""Queries localized again with a method that the run did not have."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.rendered import copy_shared
from toolkit.capture import Session
from toolkit.errors import ArtifactError
from toolkit.files import SceneFiles
from toolkit.manifest import LocalizeSettings
from toolkit.pose.base import QueryResult
from toolkit.prediction import network as predictors
from toolkit.prediction.network import SimulatedPredictor
from toolkit.scene import map as maps
from toolkit.scene.map import WITHOUT_FEATURES, Map
from toolkit.scene.run import StoredQueries

SIMULATED = {"name": "simulated"}


def asking(capture: Path, files: SceneFiles, **of_map: Any) -> tuple[Map, StoredQueries]:
    """Open the phone's map, some of its fields replaced, for the queries of the phone."""
    h5 = files.poses_txt("ios", "ios").with_suffix(".h5")
    scene_map = replace(Map.of_pair(h5, "ios", files.features, files.maps), **of_map)
    return scene_map, StoredQueries(Session(capture / "sessions/ios_query"), files.retrieval("ios", "ios"))


def answer(again: tuple[Map, StoredQueries], **changes: Any) -> QueryResult:
    scene_map, stored = again[0].changed(changes), again[1]
    if scene_map.settings.method not in WITHOUT_FEATURES:
        stored.open_features(scene_map)
    query, references = stored.query(scene_map, np.array([0]))
    return scene_map.locate(query, references=references)


@pytest.fixture
def on_their_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """All images are to be turned once."""

    def of(session: Session, rows: np.ndarray | None = None) -> np.ndarray:
        return np.ones(len(session.images if rows is None else rows), int)

    monkeypatch.setattr(maps, "upright_turns", lambda *_: SimpleNamespace(of=of))


@pytest.mark.parametrize("method", ["feed_forward", "hybrid"])
def test_a_network_that_the_run_did_not_have_sees_the_query_as_upright_as_its_references(
    small_capture: Path, finished: SceneFiles, monkeypatch: pytest.MonkeyPatch, on_their_side: None, method: str
) -> None:
    predict, seen = SimulatedPredictor.predict, list[int]()

    class Seeing(SimulatedPredictor):
        def predict(self, groups: Any) -> Any:
            seen.extend(view.turns for group in groups for view in group)
            return predict(self, groups)

    monkeypatch.setattr(predictors, "SimulatedPredictor", Seeing)
    again = asking(small_capture, finished, settings=LocalizeSettings())
    assert answer(again, method=method, predictor=SIMULATED).status == "ok"
    assert set(seen) == {1}


def test_features_for_queries_without_a_sure_pose_are_those_of_the_upright_query(
    small_capture: Path, finished: SceneFiles, on_their_side: None
) -> None:
    escalation = [SimpleNamespace(name="aliked")]
    again = asking(small_capture, finished, settings=LocalizeSettings(), escalation=escalation)
    query, _ = again[1].query(again[0], np.array([0]))
    assert [view.turns for view in query.views] == [1]


@pytest.mark.parametrize("method", ["pnp", "hybrid"])
def test_a_run_of_predictions_can_be_asked_to_match_if_features_of_its_queries_are_there(
    small_capture: Path, finished: SceneFiles, tmp_path: Path, method: str
) -> None:
    again = asking(small_capture, finished)
    assert again[0].settings.method == "feed_forward"
    estimate = answer(again, method=method)
    found_by = "pnp" if method == "pnp" else "hybrid:simulated/pnp"
    assert (estimate.status, estimate.found_by) == ("ok", found_by)
    features = copy_shared(finished.features, tmp_path / "features")
    (of_queries,) = (features / "ios_query").iterdir()
    shutil.rmtree(of_queries)
    again = asking(small_capture, finished, features_dir=features)
    assert answer(again).status == "ok", "needs none"
    assert answer(again, method="nearest").found_by == "nearest"
    with pytest.raises(ArtifactError, match=f"^{of_queries}: .*--set localize.method="):
        answer(again, method=method)
