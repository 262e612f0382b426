"""A run in the hand."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toolkit import pipeline
from toolkit.capture import Capture
from toolkit.embed import embed_sessions
from toolkit.errors import ArtifactError
from toolkit.files import SceneFiles, file_fingerprint
from toolkit.geometry import pose_error
from toolkit.localize import localize_image, localize_pairs
from toolkit.manifest import load_manifest
from toolkit.pose.base import split_status
from toolkit.results.pair import PairResults
from toolkit.retrieve import retrieve_pairs
from toolkit.scene import Run


@pytest.mark.slow
def test_a_run_has_its_settings_maps_and_queries(small_run: Path, released_weights: None) -> None:
    run = Run.open(small_run)
    assert re.findall("<th>(ok|low_confidence|failed)</th>", run._repr_html_()) == ["ok", "low_confidence", "failed"]
    assert run.scenes == ["SMALL"]
    assert run.settings["name"] == small_run.name
    queries = run.queries
    poses = SceneFiles(small_run, "SMALL").poses_dir
    tables = {path.stem: pd.read_csv(path) for path in poses.glob("*_query_??*.csv") if "_sequence" not in path.stem}
    assert len(queries) == sum(map(len, tables.values()))
    (device, *_) = queries["map_device"]
    assert run.map(device).device == device
    of_device = queries[queries["map_device"] == device]
    assert set(of_device["status_text"]) == set(
        pd.concat([table for stem, table in tables.items() if f"_map_{device}_query_" in stem])["status"]
    )
    row = of_device.iloc[-1]
    name, *others = row["image"].split(";")
    query = run[name]
    folder = run.map(device).capture[f"{row['query_device']}_query"].path / "raw_data"
    assert {view.image for view in query.views} == {folder / image for image in (name, *others)}
    assert run.map(device).locate(query).status == row["status"]
    with pytest.raises(ArtifactError, match=r"no query has an image 'nowhere.jpg'"):
        run["nowhere.jpg"]


def test_what_is_no_run_names_those_beside_it(tmp_path: Path) -> None:
    for name in ("fox", "castle"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text("{}")
    run = Run.open(tmp_path / "fox")
    assert run.queries.empty
    assert "No queries" in run._repr_html_()
    for ask, named in ((lambda: Run.open(tmp_path / "fos"), "fox"), (lambda: run.map("ios"), "found the scenes none")):
        with pytest.raises(ArtifactError, match=named):
            ask()


@pytest.mark.slow
def test_a_map_by_itself_localizes_as_a_run_with_queries(small_capture: Path, tmp_path: Path) -> None:
    sessions = tmp_path / "PLACE" / "sessions"
    sessions.mkdir(parents=True)
    (sessions / "ios_map").symlink_to(small_capture / "sessions" / "ios_map")
    manifest = tmp_path / "place.yaml"
    manifest.write_text("captures: [PLACE]\noutput_root: runs\nqueries: all\nlocalize: {features: {escalation: []}}\n")
    folder = pipeline.run(manifest, only="map", say=lambda *a, **k: None)
    run = Run.open(folder)
    assert (run.scenes, run.record["status"], run.queries.empty) == (["PLACE"], "done", True)
    with pytest.raises(ArtifactError, match="no map of 'hl'"):
        run.map("hl")
    mapped = run.map().session  # what start.ipynb takes in the hand; it ended with an error
    assert run.best_query("ios").views[0].image == mapped.image_path(len(mapped) // 2)
    session = Capture.open(small_capture)["ios_query"]
    cameras = session.cameras(np.arange(3))
    results = [localize_image(run.map(), session.image_path(row), camera) for row, camera in enumerate(cameras)]
    poses = np.stack([result.world_from_rig for result in results if result.world_from_rig is not None])
    _, meters = pose_error(poses, session.world_from_cam(np.arange(3), ground_truth=True))
    assert meters.max() < 0.05

    (sessions / "ios_query").symlink_to(small_capture / "sessions" / "ios_query")
    files, settings = SceneFiles(folder, "PLACE"), load_manifest(manifest)
    made = file_fingerprint(files.maps / "ios_map.npz"), file_fingerprint(files.embeddings / "vlad.npz")
    embed_sessions(sessions, files.embeddings, settings.embed, features_dir=files.features)
    retrieve_pairs(sessions, files.embeddings, files.retrieval_dir, settings.retrieve, queries="all")
    where = files.retrieval_dir, files.poses_dir, files.features, files.maps
    localize_pairs(sessions, *where, settings.stage("localize"), queries="all")  # type: ignore[arg-type]
    assert made == (file_fingerprint(files.maps / "ios_map.npz"), file_fingerprint(files.embeddings / "vlad.npz"))
    pair = PairResults.open(files.poses_txt("ios", "ios"))
    keys = list(zip(pair.table["timestamp"], pair.table["device_id"], strict=True))
    rows = [keys.index(key) for key in zip(session.images["timestamp"][:3], session.device_ids[:3], strict=True)]
    np.testing.assert_allclose(poses, pair.poses[rows], atol=1e-12)
    assert len(run.queries) == 0  # of the run as it was opened
    assert len(Run.open(folder).queries) == len(pair.table)

    (sessions / "ios_map").unlink()  # the map changes, and is made again without the queries, as it is when it grows
    shutil.copytree(small_capture / "sessions" / "ios_map", sessions / "ios_map", symlinks=True)
    for name in ("trajectories.txt", "images.txt"):
        lines = (sessions / "ios_map" / name).read_text().splitlines()
        (sessions / "ios_map" / name).write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(ArtifactError, match="run the localize stage again"):
        Run.open(folder).map()
    pipeline.run(manifest, only="map", say=lambda *a, **k: None)
    grown = Run.open(folder).map()
    assert len(grown.session) == len(mapped) - 1
    assert localize_image(grown, session.image_path(0), cameras[0]).world_from_rig is not None


def test_the_best_query_has_a_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses by networks have no inliers; the first row was taken, whatever its status."""
    rows = [("a.jpg", "failed: undecided", 0), ("b.jpg", "low_confidence: rivals", 0), ("c.jpg", "ok", 0)]
    table = split_status(pd.DataFrame(rows, columns=["image", "status", "num_inliers"]))
    table = table.assign(map_device="ios", scene="PLACE")
    monkeypatch.setattr(Run, "queries", table)
    monkeypatch.setattr(Run, "scenes", ["PLACE"])
    monkeypatch.setattr(Run, "__getitem__", lambda _, name: name)
    assert Run(tmp_path).best_query("ios") == "c.jpg"
    monkeypatch.setattr(Run, "queries", table.iloc[:1])
    with pytest.raises(ArtifactError):
        Run(tmp_path).best_query("ios")
