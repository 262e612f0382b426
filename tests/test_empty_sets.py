"""Nothing to do, and more asked than there is: every stage ends well, and its tables say so."""

from pathlib import Path

import pandas as pd
import pytest

from tests.calls import call
from tests.test_embed import write_tiny_capture
from toolkit.capture import Trajectory
from toolkit.embed import embed_sessions
from toolkit.evaluate import draw_evaluation, evaluate_scene
from toolkit.figures.explore import draw_references, draw_reranked, draw_similarity, draw_statuses
from toolkit.files import SceneFiles, read_references
from toolkit.localize import localize_pairs
from toolkit.rerank import rerank_pairs
from toolkit.retrieve import retrieve_pairs
from toolkit.visualize import visualize_scene

KEYFRAMES = "proc/keyframes_pruned_subsampled.txt"
SHOWN = {"recordings": False, "session_recordings": False}
PAIR = {"map_device": "ios", "query_device": "ios"}


def keep_lines(path: Path, count: int) -> None:
    """Cut a text file of a session to its first lines, besides comments."""
    lines = path.read_text().splitlines(keepends=True)
    rows = [line for line in lines if not line.startswith("#")][:count]
    path.write_text("".join([line for line in lines if line.startswith("#")] + rows))


def run_stages(capture: Path, files: SceneFiles) -> pd.DataFrame:
    """Run all stages on the pair ios x ios, with their figures; return the row of the pair."""
    sessions = capture / "sessions"
    embed_sessions(sessions, files.embeddings, device="ios", features_dir=files.features)
    draw_similarity(files.embeddings)
    retrieve_pairs(sessions, files.embeddings, files.retrieval_dir, **PAIR)
    retrieved = files.retrieval("ios", "ios")
    draw_references(sessions, retrieved)
    call(rerank_pairs, sessions, files.retrieval_dir, files.features, files.reranked_dir, workers=1, **PAIR)
    draw_reranked(sessions, files.reranked_dir / retrieved.name, retrieved)
    folders = (files.reranked_dir, files.poses_dir, files.features, files.maps)
    table = call(localize_pairs, sessions, *folders, workers=1, **PAIR)
    draw_statuses(table["path"])
    evaluation = evaluate_scene(sessions, files.poses_dir, files.retrieval_dir, files.evaluation, **PAIR)
    draw_evaluation(evaluation)
    call(visualize_scene, sessions, files.poses_dir, files.maps, files.visualization, **SHOWN, **PAIR)
    return table.iloc[0]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_tiny_capture(tmp_path / "TINY")


@pytest.fixture
def files(tmp_path: Path) -> SceneFiles:
    return SceneFiles(tmp_path / "run", "TINY")


@pytest.mark.slow
def test_no_queries_are_a_pair_without_rows(capture: Path, files: SceneFiles) -> None:
    (capture / "sessions" / "ios_query" / KEYFRAMES).write_text("")
    row = run_stages(capture, files)
    assert row[["queries", "ok", "low_confidence", "failed"]].tolist() == [0, 0, 0, 0]
    assert len(Trajectory.read(files.poses_txt("ios", "ios"))) == 0
    assert pd.read_csv(files.poses_csv("ios", "ios")).empty
    recall = pd.read_csv(files.evaluation / "recall.csv")
    assert recall["state"].tolist() == ["no queries"]


@pytest.mark.slow
def test_a_map_of_one_image_answers_with_reasons(capture: Path, files: SceneFiles) -> None:
    """More references are asked than the map has, and one image has no triangulated points."""
    keep_lines(capture / "sessions" / "ios_map" / "images.txt", 1)
    row = run_stages(capture, files)
    assert row[["queries", "failed"]].tolist() == [3, 3]
    assert all(len(query["topk"]) == 1 for query in read_references(files.retrieval("ios", "ios")))
    statuses = pd.read_csv(files.poses_csv("ios", "ios"))["status"]
    assert statuses.eq("failed: too few matches").all()
