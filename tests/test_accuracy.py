"""Real photographs: how accurate the poses are, against the numbers of hloc + SIFT. Minutes; see CONTRIBUTING."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toolkit import geometry
from toolkit.capture import Capture, Trajectory
from toolkit.embed import embed_sessions
from toolkit.evaluate import Evaluation, evaluate_scene, pose_errors, recall
from toolkit.files import SceneFiles
from toolkit.localize import Map, localize_image, localize_pairs
from toolkit.retrieve import retrieve_pairs

pytestmark = pytest.mark.slow

DEVICES = ("ios", "hl", "spot")
STRICT, FINE, COARSE = "recall@(1deg,0.1m)", "recall@(5deg,0.5m)", "recall@(5deg,1m)"

# Medians of hloc + SIFT as it comes: rows are maps, columns queries (ios, hl, spot), degrees and centimeters.
HLOC = {
    "ios": [(0.03, 0.6), (0.07, 1.0), (0.06, 1.2)],
    "hl": [(0.08, 2.2), (0.09, 2.4), (0.10, 2.5)],
    "spot": [(0.03, 0.7), (0.07, 1.3), (0.06, 1.3)],
}
# hloc, its half pixel repaired, the rig refined jointly: over all queries of all pairs.
HLOC_REPAIRED = (0.033, 0.8)


@dataclass(frozen=True)
class Run:
    """A capture, what the stages made of all nine pairs, and how good that is."""

    capture: Capture
    files: SceneFiles
    evaluation: Evaluation


def run_stages(sessions: Path, files: SceneFiles) -> Run:
    embed_sessions(sessions, files.embeddings, features_dir=files.features)
    retrieve_pairs(sessions, files.embeddings, out_jsonl=files.retrieval_dir)
    localize_pairs(sessions, files.retrieval_dir, files.poses_dir, files.features, files.maps)
    evaluation = evaluate_scene(sessions, files.poses_dir, files.retrieval_dir, files.evaluation)
    return Run(Capture.from_sessions_root(sessions), files, evaluation)


@pytest.fixture(scope="module")
def run_of(captures_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Run]:
    """Run the stages on a capture by name, once; skip where the capture is absent."""

    @cache
    def of(name: str) -> Run:
        sessions = captures_root / name / "sessions"
        if not sessions.is_dir():
            pytest.skip(f"needs the capture {name}: no folder {sessions}")
        return run_stages(sessions, SceneFiles(tmp_path_factory.mktemp(name), name))

    return of


def test_strecha_is_solved(run_of: Callable[[str], Run]) -> None:
    table = run_of("STRECHA").evaluation.recall
    assert len(table) == 9
    assert (table["state"] == "evaluated").all()
    assert (table["queries"] > 0).all()
    assert (table["ok"] + table["low_confidence"] + table["failed"] == table["queries"]).all()
    assert (table[STRICT] == 1.0).all(), table
    assert (table[FINE] == 1.0).all(), table


@pytest.mark.parametrize("mapped", DEVICES)
@pytest.mark.parametrize("query", DEVICES)
def test_no_pair_of_strecha_is_less_accurate_than_hloc(
    run_of: Callable[[str], Run], mapped: str, query: str
) -> None:
    table = run_of("STRECHA").evaluation.recall.set_index(["map_device", "query_device"])
    row, (degrees, centimeters) = table.loc[(mapped, query)], HLOC[mapped][DEVICES.index(query)]
    # To the digits in which hloc's numbers are known.
    assert round(row["median_rotation_deg"], 2) <= degrees
    assert round(100 * row["median_translation_m"], 1) <= centimeters


def test_the_medians_over_all_of_strecha_are_close_to_repaired_hloc(run_of: Callable[[str], Run]) -> None:
    errors = run_of("STRECHA").evaluation.errors
    assert errors[["map_device", "query_device"]].drop_duplicates().shape[0] == 9
    assert np.median(errors["rotation_error_deg"]) <= 1.2 * HLOC_REPAIRED[0]
    assert 100 * np.median(errors["translation_error_m"]) <= 1.2 * HLOC_REPAIRED[1]


def test_hard_strecha_reaches_its_recall(run_of: Callable[[str], Run]) -> None:
    table = run_of("STRECHA_HARD").evaluation.recall
    assert len(table) == 9
    means = table[[STRICT, FINE, COARSE]].mean()
    assert (means >= pd.Series([0.60, 0.78, 0.80], index=[STRICT, FINE, COARSE])).all(), table


def test_few_poses_of_hard_strecha_are_ok_and_wrong(run_of: Callable[[str], Run]) -> None:
    errors = run_of("STRECHA_HARD").evaluation.errors
    wrong = (errors["rotation_error_deg"] > 5) | (errors["translation_error_m"] > 0.5)
    assert ((errors["status"] == "ok") & wrong).mean() <= 0.02


@pytest.mark.parametrize("scene", ["STRECHA", "STRECHA_HARD"])
def test_retrieval_finds_views_of_the_same_place(run_of: Callable[[str], Run], scene: str) -> None:
    run = run_of(scene)
    for path in sorted(run.files.retrieval_dir.glob("*.jsonl")):
        session = run.capture[f"{path.stem.rpartition('_')[2]}_query"]
        names = [f"{scene}/sessions/{session.image_name(index)}" for index in range(len(session.images))]
        true = dict(zip(names, session.world_from_cam(ground_truth=True), strict=True))
        hits = []
        for record in map(json.loads, path.read_text().splitlines()):
            world_from_query = true[record["path"]]
            poses = np.array([reference["Tws"] for reference in record["topk"]])
            distance_m = np.linalg.norm(poses[:, :3, 3] - world_from_query[:3, 3], axis=1)
            hits.append((distance_m < 8) & (poses[:, :3, 2] @ world_from_query[:3, 2] > np.cos(np.radians(45))))
        assert np.mean(np.any(hits, axis=1)) == 1, path.stem
        assert np.mean(np.any(np.array(hits)[:, :5], axis=1)) >= 0.95, path.stem


def test_learned_features_find_what_sift_is_not_sure_of(
    captures_root: Path, run_of: Callable[[str], Run], learned_weights: None, tmp_path: Path
) -> None:
    """By night, in the phone's map: all poses are right and sure, and a picture gets the pose of the run."""
    with_sift = run_of("STRECHA_HARD").files
    sessions, files = captures_root / "STRECHA_HARD" / "sessions", SceneFiles(tmp_path, "STRECHA_HARD")
    for folder in ("embeddings", "features", "retrieval", "map"):
        shutil.copytree(with_sift.root / folder, files.root / folder)
    settings = {"compute_device": "cpu"}
    places = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    table = localize_pairs(sessions, *places, settings, map_device="ios", query_device="ios")
    assert 1 <= table["escalated"].item() <= 6
    assert table["ok"].item() == table["queries"].item() == 25
    session = Capture.from_sessions_root(sessions)["ios_query"]
    poses = Trajectory.read(files.poses_txt("ios", "ios"))
    keyframes = session.keyframes("keyframes_pruned_subsampled")
    rotation_deg, translation_m = pose_errors(poses, session.ground_truth, keyframes)
    assert recall(rotation_deg, translation_m, [(1.0, 0.1)]) == [1.0]
    rows = pd.read_csv(files.poses_txt("ios", "ios").with_suffix(".csv"))
    escalated = rows["first_status"].notna()
    assert (rows["method"][escalated] == "pnp+aliked").all()
    assert (rows["p_correct"] >= 0.99).all()
    scene_map = Map.open(tmp_path, "STRECHA_HARD", "ios")
    number = int(np.flatnonzero(escalated)[0])
    (row,) = session.rows_of_keyframes(keyframes)[number]
    camera = session.camera(session.images["sensor_id"].iloc[row])
    turns = scene_map.turns.of(session, row).tolist()
    estimate = localize_image(scene_map, session.image_path(int(row)), camera, turns=turns)
    np.testing.assert_array_equal(geometry.qt_from_pose(estimate.world_from_rig), poses.qt[number])
