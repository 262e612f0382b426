"""Runs against each other, on runs written by hand whose differences are known."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toolkit.errors import ArtifactError
from toolkit.files import SceneFiles, write_sidecar
from toolkit.notebook import linked
from toolkit.report.comparison import Comparison, bootstrap, compare_runs, draw_changes, readable

LIMITS = ("(1deg,0.1m)", "(5deg,0.5m)")
GOOD, FAIR, LOST = (0.5, 0.05), (2.0, 0.3), (np.inf, np.inf)
PAIRS = (("ios", "hl"), ("hl", "hl"))


def write_run(folder: Path, errors: dict[tuple[str, str], list[tuple[float, float]]], **record: object) -> Path:
    """Write what a run leaves of errors (degrees, meters) of the queries of each pair."""
    files = SceneFiles(folder, "PLACE")
    files.evaluation.mkdir(parents=True)
    rows = [
        {"map_device": m, "query_device": q, "timestamp": k, "device_id": f"00{k}", "image": f"{k}.jpg",
         "status": "ok" if error[0] < 9 else "failed: too few matches", "num_inliers": 9,
         "rotation_error_deg": error[0], "translation_error_m": error[1]}
        for (m, q), of_pair in errors.items() for k, error in enumerate(of_pair)
    ]  # fmt: skip
    columns = {f"loss@{name}": "" for name in LIMITS}
    pd.DataFrame(rows).assign(**columns).to_csv(files.evaluation / "errors.csv", index=False)
    (files.evaluation / "recall.csv").write_text("map_device\n")
    write_sidecar(files.evaluation / "recall.csv", {}, [files.evaluation / "errors.csv"])
    stages = [{"scene": "PLACE", "stage": "localize", "seconds": 4.0, "peak_memory_mb": 500, "parameters": {}}]
    content = {"scenes": ["PLACE"], "inputs": {"PLACE": "f00"}, "stages": stages, "status": "done", **record}
    (folder / "run.json").write_text(json.dumps(content))
    return folder


def manifest(name: str, **pnp: object) -> dict[str, object]:
    return {"name": name, "output_root": f"/{name}", "localize": {"method": "pnp", "pnp": pnp}}


@pytest.fixture
def two(tmp_path: Path) -> list[Path]:
    """Run b has won one query at both thresholds, one at the strict one, and lost one at the strict one."""
    before = {pair: [GOOD] * 5 for pair in PAIRS} | {PAIRS[0]: [GOOD, GOOD, LOST, FAIR, FAIR]}
    after = {pair: [GOOD] * 5 for pair in PAIRS} | {PAIRS[0]: [GOOD, FAIR, GOOD, GOOD, FAIR]}
    return [
        write_run(tmp_path / "a", before, manifest=manifest("a", min_inliers=12, seed=0)),
        write_run(tmp_path / "b", after, manifest=manifest("b", min_inliers=20, seed=0)),
    ]


def rows_of(comparison: Comparison, threshold: str, run: str = "b", scene: str = "all") -> pd.DataFrame:
    table = comparison.recall
    return table[(table["threshold"] == threshold) & (table["run"] == run) & (table["scene"] == scene)]


def test_won_and_lost_are_those_within_in_one_run_only(two: list[Path]) -> None:
    comparison = compare_runs(two)
    (strict,) = rows_of(comparison, LIMITS[0]).to_dict("records")
    assert (strict["won"], strict["lost"], strict["queries"]) == (2, 1, 10)
    assert strict["recall"] == pytest.approx(0.8)
    assert strict["difference"] == pytest.approx(0.1)
    (loose,) = rows_of(comparison, LIMITS[1]).to_dict("records")
    assert (loose["won"], loose["lost"]) == (1, 0)
    changes = comparison.changes
    assert list(zip(changes["change"], changes["timestamp"], changes["at"], strict=True)) == [
        ("lost", 1, LIMITS[0]), ("won", 2, "; ".join(LIMITS)), ("won", 3, LIMITS[0])
    ]  # fmt: skip
    assert set(changes["device_id"]) == {"001", "002", "003"}, "identifiers are texts"
    of_pairs = rows_of(comparison, LIMITS[0], scene="PLACE").set_index("map_device")
    assert of_pairs["won"].to_dict() == {"ios": 2, "hl": 0}


def test_a_threshold_is_strict_as_in_the_evaluation(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, {PAIRS[0]: [(1.0, 0.05), error]}) for name, error in (("a", GOOD), ("b", GOOD))]
    assert rows_of(compare_runs(runs), LIMITS[0])["recall"].item() == 0.5


def test_settings_and_costs_that_differ_are_told(two: list[Path]) -> None:
    comparison = compare_runs(two)
    assert comparison.settings.T.to_dict("list") == {"localize.pnp.min_inliers": ["12", "20"]}, "not name and folder"
    summary = comparison.summary()
    assert summary["resources"]["localize"]["a"] == {"seconds": 4.0, "memory_mb": 500.0}
    assert summary["settings"]["localize.pnp.min_inliers"] == {"a": "12", "b": "20"}
    assert [change["run"] for change in summary["changes"]] == ["b", "b", "b"]
    assert json.loads(json.dumps(summary, allow_nan=False))["queries"] == 10, "also with a query without a pose"
    assert "difference won lost" in comparison.text()
    assert "localize.pnp.min_inliers" in comparison.text()


def test_a_record_without_stages_costs_nothing_that_is_known(two: list[Path]) -> None:
    record = json.loads((two[1] / "run.json").read_text())
    (two[1] / "run.json").write_text(json.dumps(record | {"stages": []}))
    assert readable(compare_runs(two))["resources"].loc[("all", "b")].tolist() == ["–", "–"]


def test_identical_runs_differ_by_nothing(two: list[Path]) -> None:
    comparison = compare_runs([two[0], two[0]])
    assert comparison.names == ["a (1)", "a (2)"]
    mine = comparison.recall[comparison.recall["run"] == "a (2)"]
    for name in ("difference", "difference_low", "difference_high", "won", "lost"):
        assert (mine[name] == 0).all(), name
    assert (mine["recall_low"] <= mine["recall"]).all()
    assert comparison.changes.empty
    assert readable(comparison)["changes"].empty
    assert comparison.settings.empty


def test_queries_have_the_names_of_their_images(two: list[Path]) -> None:
    for run in two:
        table = run / "PLACE" / "evaluation" / "errors.csv"
        errors = pd.read_csv(table, dtype={"device_id": str})
        errors["image"] = [f"walk/{'long/' * 20}{k}.jpg" for k in errors["timestamp"]]
        errors.to_csv(table, index=False)
        write_sidecar(table.with_name("recall.csv"), {}, [table])
    comparison = compare_runs(two)
    assert comparison.changes["image"].str.startswith("walk/").all(), "whole, for scripts"
    html = linked(readable(comparison)["changes"]).to_html()
    assert len(re.findall(r"…[a-z/]*/[123]\.jpg", html)) == 3
    titles = [title for title, drawn in draw_changes(comparison, 4) if not drawn]
    assert len(titles) == 3
    assert all(title.startswith("No picture of hl query …/") for title in titles), "its capture is not there"


def test_intervals_repeat_with_the_seed(two: list[Path]) -> None:
    first, again, other = (compare_runs(two, seed, 50).recall for seed in (3, 3, 4))
    pd.testing.assert_frame_equal(first, again)
    assert not first.equals(other)


def test_an_interval_covers_a_binomial_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    p, covered, apart = 0.7, 0, 0
    for _ in range(200):
        hits = rng.random((120, 2, 1)) < p
        within, difference = bootstrap(hits, np.arange(120), seed=0, resamples=400)
        covered += within[0, 0, 0] <= p <= within[1, 0, 0]
        apart += difference[0, 1, 0] <= 0 <= difference[1, 1, 0]
    assert 0.90 <= covered / 200 <= 0.985
    assert 0.90 <= apart / 200 <= 0.985


def test_an_interval_is_as_wide_as_the_binomial_says() -> None:
    hits = (np.arange(400) < 280)[:, None, None]
    (low, high), _ = bootstrap(hits, np.arange(400))
    assert (high - low).item() == pytest.approx(2 * 1.96 * np.sqrt(0.7 * 0.3 / 400), rel=0.1)


def test_pairing_takes_out_what_runs_have_in_common() -> None:
    hits = np.random.default_rng(0).random((200, 1, 1)) < 0.5
    both = np.concatenate([hits, hits], axis=1)
    both[0, 1] ^= True
    within, apart = bootstrap(both, np.arange(200))
    assert np.ptp(within[:, 1]) > 0.1
    assert np.ptp(apart[:, 1]) < 0.02


def test_answers_to_one_query_in_several_maps_are_not_independent() -> None:
    hits = np.repeat(np.random.default_rng(0).random((100, 1, 1)) < 0.5, 4, axis=0)
    alone, _ = bootstrap(hits, np.arange(400))
    together, _ = bootstrap(hits, np.repeat(np.arange(100), 4))
    assert np.ptp(together) == pytest.approx(2 * np.ptp(alone), rel=0.2)


def test_one_query_is_compared(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, {PAIRS[0]: [error]}) for name, error in (("a", LOST), ("b", GOOD))]
    comparison = compare_runs(runs)
    (row,) = rows_of(comparison, LIMITS[0]).to_dict("records")
    assert (row["difference_low"], row["difference"], row["difference_high"]) == (1, 1, 1)
    assert readable(comparison)["changes"]["off in a"].tolist() == ["no pose"]


def test_other_queries_are_left_out_and_counted(two: list[Path], tmp_path: Path) -> None:
    fewer = write_run(tmp_path / "c", {PAIRS[0]: [GOOD] * 3}, inputs={"PLACE": "other"})
    comparison = compare_runs([two[0], fewer])
    assert len(comparison.queries) == 3
    assert any("a 10, c 3" in text and "the 3 in common" in text for text in comparison.messages)
    assert any("PLACE: its files were changed" in text for text in comparison.messages)
    assert rows_of(comparison, LIMITS[0], "c")["recall"].item() == 1


def test_three_runs_are_each_compared_with_the_first(two: list[Path], tmp_path: Path) -> None:
    third = write_run(tmp_path / "c", {pair: [LOST] * 5 for pair in PAIRS})
    comparison = compare_runs([*two, third])
    assert rows_of(comparison, LIMITS[0], "c")[["won", "lost"]].to_numpy().tolist() == [[0, 7]]
    assert set(comparison.changes["run"]) == {"b", "c"}
    tables = readable(comparison)
    of_all = tables["recall"].xs("all", level="map")["won"].tolist()
    assert of_all == ["", 2, 0, "", 1, 0], "of a, b, c at each threshold"
    assert len(tables["changes"]) == 3 + 9, "of b, of c"
    assert tables["settings"].loc["localize.pnp.min_inliers"].tolist() == ["12", "20", "–"]


def test_it_says_why_there_is_no_picture(two: list[Path]) -> None:
    titles = [title for title, drawn in draw_changes(compare_runs(two), 4) if not drawn]
    assert len(titles) == 3
    assert all("_map_ios_query_hl.h5" in title for title in titles)


def damage(kind: str, run: Path) -> None:
    table = SceneFiles(run, "PLACE").evaluation / "errors.csv"
    if kind == "no run":
        (run / "run.json").unlink()
    elif kind == "torn record":
        (run / "run.json").write_text("{")
    elif kind == "odd record":
        (run / "run.json").write_text('{"scenes": ["PLACE"], "stages": ["localize"]}')
    elif kind == "not evaluated":
        table.unlink()
    elif kind == "torn table":
        table.write_bytes(table.read_bytes()[:-30])
    else:
        content = pd.read_csv(table, dtype={"device_id": str})
        if kind == "no truth":
            content = content.iloc[:0]
        elif kind == "no truth of any query":  # as evaluate writes it
            content = content.drop(columns=[f"loss@{name}" for name in LIMITS])
            content[["rotation_error_deg", "translation_error_m"]] = np.nan
        elif kind == "no column":
            content = content.drop(columns="status")
        elif kind == "text for a number":
            content["rotation_error_deg"] = "half"
        elif kind == "other unit":
            content = content.rename(columns=lambda name: name.replace("m)", "L)"))
        elif kind == "twice":
            content = pd.concat([content, content])
        elif kind == "other queries":
            content["timestamp"] += 100
        content.to_csv(table, index=False)
        write_sidecar(table.with_name("recall.csv"), {}, [table])


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("no run", r"No run at .*b: run\.json is missing"),
        ("torn record", r"run\.json is not valid JSON"),
        ("odd record", r"run\.json: 'stages' is not as a run writes it"),
        ("not evaluated", r"b: not evaluated .*errors\.csv is missing.*visloc run"),
        ("torn table", r"errors\.csv.*Run the stage"),
        ("no truth", r"b: found no query with ground truth.*evaluate again"),
        ("no truth of any query", r"b: found no query with ground truth.*evaluate again"),
        ("no column", r"errors\.csv: column 'status' is missing"),
        ("text for a number", r"errors\.csv: not a table of errors .*half"),
        ("other unit", r"b: found errors in L, expected m .*`unit`"),
        ("twice", r"b: .*has a query twice"),
        ("other queries", r"no query in common \(a 10, b 10\)"),
    ],
)
def test_what_cannot_be_compared_is_one_clear_error(two: list[Path], kind: str, said: str) -> None:
    damage(kind, two[1])
    with pytest.raises(ArtifactError, match=said):
        compare_runs(two)


def test_one_run_is_not_enough(two: list[Path]) -> None:
    for given in (two[:1], str(two[0])):
        with pytest.raises(ArtifactError, match=r"found .*a'.*expected a list of two or more"):
            compare_runs(given)
