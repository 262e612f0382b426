import csv
import re
import shutil
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from toolkit.files import SceneFiles
from toolkit.manifest import EmbedSettings, LocalizeSettings, RerankSettings, RetrieveSettings
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import split_status
from toolkit.report import review

LIMIT = "recall@(1deg,0.1m)"
PAIRS = {"map_device": ["ios", "ios"], "query_device": ["ios", "hl"]}
QUERIES = split_status(pd.DataFrame({
    "map_device": "ios", "query_device": ["ios"] * 5 + ["hl"], "status": ["ok"] * 5 + ["failed: x"],
    "seconds": [0.1, 0.2, 0.3, 0.4, 5.0, np.nan],
}))  # fmt: skip
RECALL = pd.DataFrame({**PAIRS, "state": ["evaluated", "no poses file"], "queries": [5.0, 1.0], "ok": [5, np.nan],
                       LIMIT: [0.8, np.nan], "ok_wrong": [0.2, np.nan]})  # fmt: skip


def test_the_main_table_has_intervals_and_latencies() -> None:
    table = review.main_table(RECALL, QUERIES, [LIMIT]).set_index("query_device")
    expected = binomtest(4, 5).proportion_ci(method="wilson")
    found = table.loc["ios", [f"{LIMIT}_low", f"{LIMIT}_high", "seconds_median", "seconds_95"]].tolist()
    assert found == pytest.approx([expected.low, expected.high, 0.3, 4.08], abs=1e-4)
    assert table.loc["hl", [LIMIT, f"{LIMIT}_low", "seconds_median"]].isna().all()
    shown = review.readable(table.reset_index(), [LIMIT])
    assert shown[LIMIT].map(str).tolist() == ["80 [38, 96]", "–"]
    assert shown["state"].tolist() == ["", "no poses file"]


def test_without_an_evaluation_the_main_table_counts() -> None:
    table = review.main_table(pd.DataFrame(), QUERIES, [])
    assert table[["query_device", *review.COUNTS]].to_numpy().tolist() == [["ios", 5, 5, 0, 0], ["hl", 1, 0, 0, 1]]
    assert table["seconds_median"].tolist() == pytest.approx([0.3, np.nan], nan_ok=True)
    assert review.main_table(pd.DataFrame(), pd.DataFrame(), []).empty


def test_tables_are_written_as_csv_and_latex_and_removed_with_their_rows(tmp_path: Path) -> None:
    table = review.main_table(RECALL, QUERIES, [LIMIT])
    names = ["map_1", "query", "recall 1°, 0.1\N{NO-BREAK SPACE}m [%]", "95 % #"]
    shown = pd.DataFrame([["a & b", "1°", "80 [38, 96]", "a_b"], ["50 %", "–", "{x}", "#1"]], columns=names)
    paths = review.write_tables(tmp_path / "report-S", table, shown, "100 % of S_1 & #2")
    assert [path.name for path in paths] == ["report-S.csv", "report-S.tex"]
    with paths[0].open() as stream:
        rows = list(csv.DictReader(stream))
    assert (rows[0][LIMIT], rows[0]["seconds_95"], rows[1][f"{LIMIT}_low"]) == ("0.8", "4.08", "")
    lines = paths[1].read_text().splitlines()
    recall = r"\shortstack[r]{{recall}\\{1\textdegree{}, 0.1~m}\\{[\%]}}"
    assert rf"map\_1 & query & {recall} & \shortstack[r]{{{{95 \%}}\\{{\#}}}} \\" in lines
    assert r"a \& b & 1\textdegree{} & 80 [38, 96] & a\_b \\" in lines
    assert r"50 \% & -- & \{x\} & \#1 \\" in lines
    assert r"\caption{100 \% of S\_1 \& \#2}" in lines
    text = paths[1].read_text()
    assert text.count("{") == text.count("}"), "LaTeX does not end otherwise"
    rows = [line for line in lines if line.endswith(r"\\")]
    assert {re.sub(r"\\.", "", row).count("&") for row in rows} == {3}, "columns of llrr"
    assert not re.search(r"(?<!\\)[%#_$]", "".join(rows))
    assert r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}" in text, "no wider than the page"
    assert review.write_tables(tmp_path / "report-S", table.iloc[:0], shown, "") == []
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs LaTeX: texlive-latex-recommended")
def test_the_table_of_latex_is_typeset_and_fits_the_page(tmp_path: Path) -> None:
    columns = ["map", "query", *(f"recall {k}°, 0.1\N{NO-BREAK SPACE}m [%]" for k in range(8)), "queries"]
    shown = pd.DataFrame([["my_map", "a & b", *["100 [65, 100]"] * 8, "–"]] * 9, columns=columns)
    review.write_tables(tmp_path / "report-S_1 %", shown, shown, "95 % of S_1")
    page = r"\documentclass{article}\usepackage{booktabs,graphicx}\begin{document}\input{table}\end{document}"
    (tmp_path / "page.tex").write_text(page)
    (tmp_path / "report-S_1 %.tex").rename(tmp_path / "table.tex")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "Overfull" not in done.stdout


def test_maps_have_images_points_and_observations(tmp_path: Path) -> None:
    files = SceneFiles(tmp_path, "S")
    for folder in (files.poses_dir, files.maps, files.embeddings / "ios_map" / "first"):
        folder.mkdir(parents=True)
    (files.embeddings / "ios_map" / "first" / "manifest.csv").write_text("row_index,path\n0,a.jpg\n1,b.jpg\n")
    index = np.zeros(3, np.int64)
    points = np.zeros((2, 3)), np.zeros((2, 3), np.uint8)
    local_map = LocalMap(["a"], [], np.eye(4)[None], *points, index, index, index, np.ones(2, np.float32))
    local_map.save(files.maps / "ios_map.npz")
    for pair in ("ios_query_ios", "ios_query_hl", "hl_query_ios"):
        h5py.File(files.poses_dir / f"S_map_{pair}.h5", "w").close()
    (files.poses_dir / "S_map_ios.json").write_text('{"verdict": "consistent"}')
    table = review.maps_table(files).set_index("map")
    assert table.loc["ios"].tolist() == [2, 2, 3, "consistent"]
    assert table.loc["hl"].isna().tolist() == [True, True, True, False], "neither embedded nor triangulated"


def test_the_method_is_told_from_the_settings_of_the_results(tmp_path: Path) -> None:
    files = SceneFiles(tmp_path, "S")
    assert review.method(files, reranked=False) == ""
    localize = {"features": {"kinds": ["sift"], "escalation": ["aliked"]}, "pnp": {"min_inliers": 15}}
    written = {
        files.embeddings: EmbedSettings.of({"model": ["megaloc", "vlad"]}),
        files.retrieval_dir: RetrieveSettings.of({"topk": 30, "mask": {"gps": True}}),
        files.reranked_dir: RerankSettings.of({"topk": 7}),
        files.poses_dir: LocalizeSettings.of(localize),
    }
    for folder, settings in written.items():
        folder.mkdir(parents=True)
        (folder / "settings.json").write_text(settings.model_dump_json())
    text = review.method(files, reranked=True)
    for said in ("the 30 map images", "(MegaLoc and VLAD of RootSIFT)", "limited by GPS.", "keeps the 7",
                 "SIFT features", "localized again with ALIKED", "at least 15 inliers",
                 "is 99\N{NO-BREAK SPACE}% or more"):  # fmt: skip
        assert said in text
    assert "keeps the 7" not in review.method(files, reranked=False)
    others = {"nearest": "of its first reference", "feed_forward": "VGGT predicts", "hybrid": "guide further matching"}
    for method, said in others.items():
        settings = LocalizeSettings.of(localize | {"method": method})
        (files.poses_dir / "settings.json").write_text(settings.model_dump_json())
        assert said in review.method(files, reranked=False)
