import base64
import io
import itertools
import json
import re
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from PIL import Image, PngImagePlugin

from toolkit.errors import ArtifactError
from toolkit.figures.style import SHOWN_DPI, STORED_DPI
from toolkit.files import SceneFiles, write_sidecar
from toolkit.pose.base import split_status
from toolkit.report import page as report
from toolkit.report.page import write_report


def write_run(folder, **content):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "run.json").write_text(json.dumps(content))
    return folder


def write_png(path, size=(80, 60), caption="", noise=False):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(0).integers(0, 255, (*size[::-1], 3), np.uint8) if noise else None
    image = Image.fromarray(pixels) if noise else Image.new("RGB", size, "white")
    info = PngImagePlugin.PngInfo()
    if caption:
        info.add_text("Description", caption)
    image.save(path, pnginfo=info)


def text_of(page):
    """Return what a reader sees, in one line."""
    body = re.sub(r"<(style|head)\b.*?</\1>", "", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", body))


@pytest.fixture
def full(tmp_path):
    files = SceneFiles(tmp_path / "run", "PLACE & <b>")
    files.evaluation.mkdir(parents=True)
    pairs = [(m, q) for m in ("ios", "hl", "spot") for q in ("ios", "hl", "spot")]
    recall = pd.DataFrame(pairs, columns=["map_device", "query_device"]).assign(
        state="evaluated", queries=20, localized=19, ok=18, low_confidence=1, failed=1
    )
    recall["recall@(1deg,0.1m)"], recall["recall@(5deg,0.5m)"] = np.linspace(0.1, 0.9, 9), 0.95
    recall["median_rotation_deg"], recall["median_translation_m"] = 0.0312, [0.0123, *[np.inf] * 8]
    recall["ok_wrong"] = 0.05
    recall.loc[8, "state"] = "no poses file"
    recall.loc[8, "localized":] = np.nan
    recall.to_csv(files.evaluation / "recall.csv", index=False)
    write_sidecar(files.evaluation / "recall.csv", {"messages": ["spot <spot>: no poses file."]})
    losses = (
        recall[["map_device", "query_device", "state", "queries"]].iloc[:8].assign(threshold="(1deg,0.1m)", missed=4)
    )
    losses = losses.assign(**{"no good reference": 1, "no pose": 2, "wrong pose": 1})
    losses.to_csv(files.evaluation / "losses.csv", index=False)
    retrieval = recall[["map_device", "query_device", "state", "queries"]].assign(radius_m=8.0, angle_deg=45.0)
    retrieval.assign(**{"recall@1": 0.77, "recall@10": 1.0, "in_map": 1.0}).to_csv(
        files.evaluation / "retrieval.csv", index=False
    )
    errors = recall[["map_device", "query_device"]].iloc[[0, 1, 2]].assign(
        timestamp=[11, 12, 13], device_id=["007", "hetlf", "cam"], num_inliers=[30, 9, 70],
        image=["1.jpg", "left/2.jpg;right/2.jpg", "3.jpg"],
        status=["ok", "failed: too few matches", "low_confidence"],
        rotation_error_deg=[0.02, np.inf, 2.5], translation_error_m=[0.004, np.inf, 3.0],
    )  # fmt: skip
    errors["loss@(1deg,0.1m)"] = ["", "no pose", "wrong pose"]
    errors["loss@(5deg,0.5m)"] = ["", "no pose", "wrong pose"]
    errors.to_csv(files.evaluation / "errors.csv", index=False)
    files.poses_dir.mkdir()
    for pair, status in (("ios_query_ios", "ok"), ("hl_query_ios", "failed: too few inliers (3 within <1> deg)")):
        table = errors.iloc[:2].assign(status=["low_confidence", status])
        table.to_csv(files.poses_dir / f"{files.scene}_map_{pair}.csv", index=False)
        (files.poses_dir / f"{files.scene}_map_{pair}.txt").write_text("# timestamp, device_id, ...\n")
    write_png(files.evaluation / "error_curves.png", size=(200, 90))
    write_png(files.visualization / "scene_ios.png", caption='from "above" <x>')
    write_png(files.visualization / "localization_1.png", size=(2400, 600), caption="a sample", noise=True)
    write_png(files.visualization / "worst_2.png", caption="second worst")
    write_png(files.visualization / "worst_10.png", caption="tenth worst")
    (files.visualization / "scene_ios.rrd").write_bytes(b"RRF2")
    stage = {"scene": files.scene, "status": "done", "seconds": 130.0, "work_seconds": 100.0}
    stage |= {"peak_memory_mb": 900, "counts": {"images_embedded": 12}, "parameters": {"model": "<vlad>"}}
    stage["notebook"] = "notebooks/PLACE_02_embed.ipynb"
    (files.run / "notebooks").mkdir()
    (files.run / stage["notebook"]).write_text("{}")
    return write_run(
        files.run, name="a <script>alert(1)</script>", status="done", created="2026-01-02T03:04:05+00:00",
        manifest={"description": "R&D", "seed": 0}, versions={"numpy": "2"}, commit="0a1b2c-dirty",
        machine={"cpu": "A CPU", "cores": 2, "memory_gb": 8.4, "gpu": "none"},
        inputs={files.scene: "0123456789abcdef"}, code="fedcba9876543210", scenes=[files.scene],
        stages=[{"stage": "embed", **stage}, {"stage": "retrieve"}],
        total_seconds=150.0, work_seconds=120.0, peak_memory_mb=1234,
    )  # fmt: skip


def test_full_run(full):
    page = write_report(full).read_text()
    text = text_of(page)
    for expected in (
        "2026-01-02 03:04:05 UTC", "2 min 30 s", "1.23 GB", "45 % mean recall at 1°, 0.1 m", "5 % called ok",
        "recall 5°, 0.5 m [%]", "95 [76, 99]", "A CPU, 2 cores, 8.4 GB of memory, GPU: none", "git commit 0a1b2c-dirty",
        "0.031", "1.23", "∞", "no poses file", "in the first 10", "77 %",
        "8 m of the query", "12 images embedded", "embed", "numpy 2", "scene_ios.rrd",
        "4 queries in 2 pairs of devices: 1 ok, 2 low confidence, 1 failed.",
        "Weakest pair at 1°, 0.1 m: ios queries in the ios map, 10 %.",
        "3.00 m median position error; rotation 2.50°",
        "100 % have a good reference in the first 10",
        "0123456789abcdef", "fedcba9876543210", "model", "too few inliers 1 ios in hl map 1",
    ):  # fmt: skip
        assert expected in text, expected
    assert page.count("<img") == 5


def test_the_worst_queries_come_first_and_say_why(full):
    page = write_report(full).read_text()
    text = text_of(page)
    order = ["hl in ios map no pose no pose at 5°, 0.5 m failed: too few matches 9 left/2.jpg and 1 more",
             "spot in ios map 2.50°, 3.00 m wrong pose at 5°, 0.5 m low confidence 70 3.jpg",
             "ios in ios map 0.020°, 0.40 cm within every threshold ok 30 1.jpg"]  # fmt: skip
    places = [text.index(row) for row in order]
    assert places == sorted(places)
    assert page.index('alt="second worst"') < page.index('alt="tenth worst"') < page.index('alt="a sample"')


def test_what_is_called_ok_but_wrong_comes_first_and_in_red(full):
    page = write_report(full).read_text()
    assert "Called ok, but wrong" not in page
    path = next(full.rglob("errors.csv"))
    errors = pd.read_csv(path).assign(p_correct=0.998, rival_support=[0.62, 0, 0])
    errors.loc[0, ["rotation_error_deg", "translation_error_m"]] = 2.0, 28.3
    errors.to_csv(path, index=False)
    page = write_report(full).read_text()
    alarm = text_of(page[page.index('<div class="alarm wrong">') : page.index('class="verdict"')])
    assert "Called ok, but wrong (beyond 5°, 0.5 m): 1 of 1 pose." in alarm
    assert "ios in ios map 2.00°, 28 m within every threshold ok 30 99.8 % 62 % 1.jpg" in alarm


def test_links_are_relative_and_lead_to_files(full):
    links = re.findall(r'href="([^"#]*)"', write_report(full).read_text())
    assert len(links) == len(re.findall("<a href", write_report(full).read_text())) - 4
    for link in links:
        assert ":" not in link
        assert (full / unquote(link)).is_file(), link
    ends = {Path(unquote(link)).suffix for link in links}
    assert ends == {".png", ".rrd", ".csv", ".tex", ".txt", ".ipynb", ".json"}


def test_headings_do_not_skip_levels_and_tables_have_captions(full):
    page = write_report(full).read_text()
    levels = [int(level) for level in re.findall(r"<h(\d)", page)]
    assert levels[0] == 1
    assert all(later <= earlier + 1 for earlier, later in itertools.pairwise(levels))
    assert page.count("<table") == page.count("<caption>") == 5
    assert not re.search(r'<img(?![^>]*alt="[^"])', page)


def test_page_needs_nothing_else_and_no_script(full):
    page = write_report(full).read_text()
    assert not re.search(r'src="(?!data:)', page)
    assert not re.search(r"<link|@import|url\(", page)
    assert "http" not in re.sub(r'src="data:[^"]*"', "", page)
    assert "<script" not in page


def test_html_is_escaped(full):
    page = write_report(full).read_text()
    assert "a &lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "PLACE &amp; &lt;b&gt;" in page
    assert 'alt="from &#34;above&#34; &lt;x&gt;"' in page
    assert "spot &lt;spot&gt;: no poses file." in page
    assert "R&amp;D" in page


def test_large_pictures_are_reduced_and_the_page_is_bounded(full, monkeypatch):
    page = write_report(full).read_text()
    data = re.search(r'data:image/jpeg;base64,([^"]+)', page)
    assert data is not None
    assert Image.open(io.BytesIO(base64.b64decode(data[1]))).size == (1600, 400)
    monkeypatch.setattr(report, "PICTURE_BUDGET", 5000)
    page = write_report(full).read_text()
    assert "Not embedded, to keep this page small" in page
    assert "localization_1.png" in page


def test_minimal_and_failed_run(tmp_path):
    page = write_report(write_run(tmp_path / "a")).read_text()
    assert "<h1>a</h1>" in page
    run = write_run(tmp_path / "b", name="b", status="failed", error="NameError: <x>", stages=[{"scene": "S"}])
    text = text_of(write_report(run).read_text())
    assert "This run stopped before its end. NameError: &lt;x&gt;" in text
    assert "S Not evaluated." in text


def test_a_stopped_run_names_the_stage(tmp_path):
    row = {"scene": "S", "stage": "localize", "status": "failed", "seconds": 1.0}
    run = write_run(tmp_path / "b", status="failed", error="out of luck", stages=[row])
    assert "Stage localize of S: failed." in text_of(write_report(run).read_text())
    row["status"] = "interrupted"
    run = write_run(tmp_path / "c", status="interrupted", stages=[row])
    assert "stopped before its end. Stage localize of S: interrupted." in text_of(write_report(run).read_text())


def test_what_was_left_out_has_its_reason(tmp_path):
    lost = [{"what": "hl queries in the ios map", "reason": "images.txt, line 3: a <dragon>."}]
    rows = [{"scene": "S", "stage": stage, "status": "done", "left_out": lost} for stage in ("retrieve", "localize")]
    run = write_run(tmp_path / "b", status="incomplete", error="1 of 9 pairs failed", stages=rows)
    text = text_of(write_report(run).read_text())
    assert "More failed than the manifest tolerates. 1 of 9 pairs failed" in text
    assert "S hl queries in the ios map images.txt, line 3: a &lt;dragon&gt;. retrieve, localize" in text


def test_every_scene_has_room_for_pictures(full, monkeypatch):
    second = SceneFiles(full, "OTHER")
    write_png(second.visualization / "map.png", caption="the other map")
    content = json.loads((full / "run.json").read_text())
    write_run(full, **{**content, "scenes": [*content["scenes"], "OTHER"]})
    monkeypatch.setattr(report, "PICTURE_BUDGET", 4000)
    page = write_report(full).read_text()
    assert "localization_1.png" in page[page.index("Not embedded") :]
    assert '<img src="data:image/png' in page[page.index("<h2>OTHER") :]


def test_unreadable_tables_are_named_and_the_rest_is_shown(full):
    (next(full.rglob("errors.csv"))).write_text('a,b\n"1,2\n3,4,5\n')
    (next(full.rglob("*_map_ios_query_ios.csv"))).write_bytes(b"\xff\xfe\x00\xd8")
    text = text_of(write_report(full).read_text())
    assert "errors.csv cannot be read" in text
    assert "_map_ios_query_ios.csv cannot be read" in text
    assert "recall 5°, 0.5 m [%]" in text


def test_without_ground_truth_the_least_supported_are_listed(full):
    for path in full.rglob("evaluation/*.csv"):
        path.unlink()
    assert "The 2 least supported; there is no ground truth" in text_of(write_report(full).read_text()), "of both maps"
    for number, path in enumerate(sorted(full.rglob("poses/*.csv"))):
        table = pd.read_csv(path)
        if "status" in table:
            table.assign(timestamp=range(10 * number, 10 * number + len(table))).to_csv(path, index=False)
    text = text_of(write_report(full).read_text())
    assert "The 4 least supported; there is no ground truth" in text
    assert text.index("failed: too few inliers (3") < text.index("low confidence 30")
    assert "why" not in text[text.index("The 4 least supported") :].split(" low confidence ")[0]
    tables = [path for path in full.rglob("poses/*.csv") if "_sequence" not in path.name]
    for path in tables:
        table = pd.read_csv(path)
        table["reason"] = ["the focal length that fits is 921 px", *[None] * (len(table) - 1)]
        table.to_csv(path, index=False)
    text = text_of(write_report(full).read_text())
    assert "query status inliers why image" in text
    assert "the focal length that fits is 921 px" in text


def test_scene_without_ground_truth(tmp_path):
    files = SceneFiles(write_run(tmp_path / "run", scenes=["S"]), "S")
    files.evaluation.mkdir(parents=True)
    pair = {"map_device": ["ios"], "query_device": ["hl"]}
    table = pd.DataFrame({**pair, "state": ["no ground truth"], "queries": [None]})
    table.to_csv(files.evaluation / "recall.csv", index=False)
    for name in ("losses", "errors", "retrieval"):
        table.iloc[:0].to_csv(files.evaluation / f"{name}.csv", index=False)
    assert "ios hl no ground truth" in text_of(write_report(files.run).read_text())


def test_letters_are_as_large_in_all_pictures(full):
    """A small figure was stretched to the width of the page."""
    assert f'width="{round(200 * SHOWN_DPI / STORED_DPI)}" alt="Error curves"' in write_report(full).read_text()


def test_unreadable_picture_is_named(full):
    path = next(full.rglob("scene_ios.png"))
    path.write_bytes(b"no picture")
    assert "scene_ios.png cannot be read" in write_report(full).read_text()


@pytest.mark.parametrize(("content", "named"), [(None, r"run\.json is missing"), ('{"name": ', "not valid JSON")])
def test_torn_or_missing_run_is_an_error_that_says_so(tmp_path, content, named):
    if content:
        (tmp_path / "run.json").write_text(content)
    with pytest.raises(ArtifactError, match=named):
        write_report(tmp_path)


def test_what_escalation_gave_and_took():
    statuses = split_status(pd.DataFrame({
        "status": ["ok", "ok", "ok", "low_confidence", "failed: no references"],
        "first_status": [None, "low_confidence", "failed: too few matches", "low_confidence", "failed: no references"],
        "seconds": [1.0, 4.0, 5.0, 6.0, 3.0],
        "first_seconds": [None, 1.0, 1.0, 1.0, 1.0],
    }))  # fmt: skip
    (sentence,) = report._escalation(statuses)
    assert sentence == (
        "4 queries localized with the fallback features too, because not sure: 2 now ok, 1 with a first pose. "
        "That took 14 s, 3.50 s per query."
    )
    assert report._escalation(statuses.iloc[:1]) == []


def test_what_is_known_of_a_map_is_said_and_lengths_without_a_unit_are_no_meters(full):
    scene = next(path.parent for path in full.glob("*/poses"))
    for name in ("recall", "errors", "losses"):
        path = scene / "evaluation" / f"{name}.csv"
        path.write_text(path.read_text().replace("m)", "L)"))
    said = "the poses of the map contradict its images"
    (scene / "poses" / f"{scene.name}_map_ios.json").write_text(json.dumps({"unit": None, "depth": 30.0, "text": said}))
    text = text_of(write_report(full).read_text())
    assert text.index("Before you read the numbers.") < text.index(f"_map_ios: {said}") < text.index("mean recall at")
    assert said not in text[text.index("Before you trust these numbers:") :]
    assert "45 % mean recall at 1°, 0.1 L" in text
    assert f"L is a tenth of the median scene depth of a map: 3 in {scene.name}_map_ios" in unescape(text)
    assert not re.search(r"\d\s*(cm|m)\b|\[c?m\]", text)


def test_captions_name_no_unit_that_a_run_may_not_have():
    assert not any("[m]" in text for texts in report.EVALUATION_FIGURES.values() for text in texts)
