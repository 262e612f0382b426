"""Real photographs: how accurate the poses are, against the numbers of hloc + SIFT. Minutes; see CONTRIBUTING."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toolkit.embed import embed_sessions
from toolkit.evaluate import Evaluation, evaluate_scene
from toolkit.files import SceneFiles
from toolkit.localize import localize_pairs
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


def run_all(name: str, root: Path, run: Path) -> Evaluation:
    """Run the stages on a capture, all nine pairs; skip where the capture is absent."""
    sessions = root / name / "sessions"
    if not sessions.is_dir():
        pytest.skip(f"needs the capture {name}: no folder {sessions}")
    files = SceneFiles(run, name)
    embed_sessions(sessions, files.embeddings, features_dir=files.features)
    retrieve_pairs(sessions, files.embeddings, out_jsonl=files.retrieval_dir)
    localize_pairs(sessions, files.retrieval_dir, files.poses_dir, files.features, files.maps)
    return evaluate_scene(sessions, files.poses_dir, files.retrieval_dir, files.evaluation)


@pytest.fixture(scope="module")
def evaluation_of(captures_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Evaluation]:
    """Evaluate a capture by name, once."""
    done: dict[str, Evaluation] = {}

    def of(name: str) -> Evaluation:
        if name not in done:
            done[name] = run_all(name, captures_root, tmp_path_factory.mktemp(name))
        return done[name]

    return of


def test_strecha_is_solved(evaluation_of: Callable[[str], Evaluation]) -> None:
    table = evaluation_of("STRECHA").recall
    assert len(table) == 9
    assert (table["state"] == "evaluated").all()
    assert (table["queries"] > 0).all()
    assert (table["ok"] + table["low_confidence"] + table["failed"] == table["queries"]).all()
    assert (table[STRICT] == 1.0).all(), table
    assert (table[FINE] == 1.0).all(), table


@pytest.mark.parametrize("mapped", DEVICES)
@pytest.mark.parametrize("query", DEVICES)
def test_no_pair_of_strecha_is_less_accurate_than_hloc(
    evaluation_of: Callable[[str], Evaluation], mapped: str, query: str
) -> None:
    table = evaluation_of("STRECHA").recall.set_index(["map_device", "query_device"])
    row, (degrees, centimeters) = table.loc[(mapped, query)], HLOC[mapped][DEVICES.index(query)]
    # To the digits in which hloc's numbers are known.
    assert round(row["median_rotation_deg"], 2) <= degrees
    assert round(100 * row["median_translation_m"], 1) <= centimeters


def test_the_medians_over_all_of_strecha_are_close_to_repaired_hloc(
    evaluation_of: Callable[[str], Evaluation],
) -> None:
    errors = evaluation_of("STRECHA").errors
    assert errors[["map_device", "query_device"]].drop_duplicates().shape[0] == 9
    assert np.median(errors["rotation_error_deg"]) <= 1.2 * HLOC_REPAIRED[0]
    assert 100 * np.median(errors["translation_error_m"]) <= 1.2 * HLOC_REPAIRED[1]


def test_hard_strecha_reaches_its_recall(evaluation_of: Callable[[str], Evaluation]) -> None:
    table = evaluation_of("STRECHA_HARD").recall
    assert len(table) == 9
    means = table[[STRICT, FINE, COARSE]].mean()
    assert (means >= pd.Series([0.60, 0.78, 0.80], index=[STRICT, FINE, COARSE])).all(), table


def test_few_poses_of_hard_strecha_are_ok_and_wrong(evaluation_of: Callable[[str], Evaluation]) -> None:
    errors = evaluation_of("STRECHA_HARD").errors
    wrong = (errors["rotation_error_deg"] > 5) | (errors["translation_error_m"] > 0.5)
    assert ((errors["status"] == "ok") & wrong).mean() <= 0.02
