"""The localize stage from files to files, on a rendered capture: poses, rows, resuming, and single pictures."""

import json
import os
import re
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal
from unittest.mock import Mock

import cv2
import h5py
import numpy as np
import pandas as pd
import pycolmap
import pytest
import torch
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from tests.calls import call
from tests.other_kind import add_other_kind
from tests.rendered import copy_shared
from toolkit import geometry, localize, sequence
from toolkit.__main__ import app
from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.images import camera_text, read_image
from toolkit.capture.session import IMPORT_RECORD
from toolkit.capture.tables import POSE_NAMES
from toolkit.embed import embed_sessions
from toolkit.embedders import EMBEDDERS
from toolkit.embedders import embedded as search
from toolkit.errors import ArtifactError, CaptureError, ImageError, ManifestError, ToolkitError
from toolkit.evaluate import evaluate_scene
from toolkit.features.features import KINDS, LocalFeatures, MutualMatcher, SiftExtractor, SiftSettings, unit_descriptors
from toolkit.features.matching import MATCHERS, LocalMethod
from toolkit.features.stores import extract_session
from toolkit.figures import top_view
from toolkit.files import SceneFiles, image_name, map_record_path, read_map_record, read_references, sidecar_path
from toolkit.localize import COLUMNS, Map, localize_image, localize_pairs
from toolkit.manifest import EmbedSettings, LocalizeSettings
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import (
    NOISE,
    Localizer,
    Prior,
    Query,
    QueryMatches,
    QueryResult,
    References,
    RoughPose,
    Status,
    View,
)
from toolkit.pose.map_matching import MappedFeatures
from toolkit.pose.pnp import CURE, PnpLocalizer
from toolkit.prediction import network as predictors
from toolkit.prediction.interface import Prediction
from toolkit.prediction.network import SimulatedPredictor
from toolkit.rerank import rerank_pairs
from toolkit.results.localized import sure_points
from toolkit.results.pair import PairResults
from toolkit.retrieve import load_embeddings, retrieve_pairs
from toolkit.scene import map as maps
from toolkit.scene.query import pixels_from
from toolkit.scene.run import InspectedPair
from toolkit.sequence import sequence_pairs

LIST = "keyframes_original"
DEVICES = ("ios", "hl", "spot")


def run_stage(capture: Path, files: SceneFiles, **more: object) -> pd.DataFrame:
    """Localize in the phone's map, one thread where nothing else is said."""
    options = {"map_device": "ios", "queries": LIST, "workers": 1} | more
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    return call(localize_pairs, capture / "sessions", *folders, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def finished(
    small_capture: Path, small_embedded: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[SceneFiles, pd.DataFrame]:
    """A run that has localized all devices in the phone's map, and its table; do not write to it."""
    files = SceneFiles(tmp_path_factory.mktemp("run"), small_capture.name)
    copy_shared(small_embedded, files.root)
    sessions = small_capture / "sessions"
    retrieve_pairs(sessions, files.embeddings, map_device="ios", out_jsonl=files.retrieval_dir, queries=LIST)
    return files, run_stage(small_capture, files)


@pytest.fixture
def run(finished: tuple[SceneFiles, pd.DataFrame], tmp_path: Path) -> SceneFiles:
    """A copy of the run without its poses, to work in."""
    files = SceneFiles(tmp_path / "run", finished[0].scene)
    copy_shared(finished[0].root, files.root)
    shutil.rmtree(files.poses_dir)
    return files


@pytest.fixture
def capture(small_capture: Path, tmp_path: Path) -> Path:
    """A copy of the capture, to damage."""
    return Path(shutil.copytree(small_capture, tmp_path / "data" / small_capture.name))


def rows_of(files: SceneFiles, query: str, mapped: str = "ios") -> pd.DataFrame:
    return pd.read_csv(files.poses_csv(mapped, query))


def without_times(files: SceneFiles, query: str) -> str:
    return rows_of(files, query).drop(columns="seconds").to_csv()


# ------------------------------------------------------------------------------------------------ the answer


@pytest.mark.parametrize("device", DEVICES)
def test_poses_are_right(small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame], device: str) -> None:
    files, _ = finished
    session = Capture.open(small_capture)[f"{device}_query"]
    estimated = Trajectory.read(files.poses_txt("ios", device))
    true = session.ground_truth.lookup(estimated.timestamps, estimated.device_ids)
    rotation_deg, distance_m = geometry.pose_error(estimated.world_from_device, true)
    assert len(estimated) == len(session.keyframes(LIST))
    assert ((rotation_deg < 1) & (distance_m < 0.1)).mean() > 0.6
    assert np.median(distance_m) < 0.02
    # Device ids are those of the files: the rig's where there is one, else the camera's.
    assert list(estimated.device_ids) == session.keyframes(LIST)["device_id"].tolist()
    assert estimated.covariances.shape == (len(estimated), 6, 6)
    assert (np.linalg.eigvalsh(estimated.covariances) > 0).all()


def test_counts_balance(small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame]) -> None:
    files, table = finished
    assert table[["map_device", "query_device"]].to_numpy().tolist() == [["ios", d] for d in DEVICES]
    np.testing.assert_array_equal(table["ok"] + table["low_confidence"] + table["failed"], table["queries"])
    for row in table.itertuples():
        session = Capture.open(small_capture)[f"{row.query_device}_query"]
        keyframes, found = session.keyframes(LIST), rows_of(files, row.query_device)
        images = [";".join(session.images["path"].iloc[rows]) for rows in session.rows_of_keyframes(keyframes)]
        assert found["image"].tolist() == images  # all of a rig's
        assert list(found.columns) == COLUMNS
        assert row.queries == len(found) == len(keyframes)
        assert found["timestamp"].tolist() == keyframes["timestamp"].tolist()  # a row each, in the list's order
        assert found["device_id"].tolist() == keyframes["device_id"].tolist()
        assert Path(row.path) == files.poses_txt("ios", row.query_device)
        assert len(Trajectory.read(row.path)) == row.ok + row.low_confidence
        assert not row.skipped


def lengthen(sensors: Path, factor: float) -> None:
    """Multiply all focal lengths of a session."""
    text = sensors.read_text()
    for line in text.splitlines():
        if ", camera, " in line:
            *start, focal_x, focal_y, x, y = line.split(", ")
            wrong = [f"{factor * float(focal)}" for focal in (focal_x, focal_y)]
            text = text.replace(line, ", ".join([*start, *wrong, x, y]))
    sensors.write_text(text)


def test_wrong_focal_lengths_of_the_map_are_not_blamed_on_the_queries(
    capture: Path, run: SceneFiles, caplog: pytest.LogCaptureFixture
) -> None:
    lengthen(capture / "sessions" / "ios_map" / "sensors.txt", 1.1)
    shutil.rmtree(run.maps, ignore_errors=True)
    table = run_stage(capture, run, query_device="ios")
    found = rows_of(run, "ios")
    assert table["map_poses"].tolist() == ["inconsistent"]
    assert set(found["status"]) == {"low_confidence: the intrinsics of the map contradict its images"}
    assert found["focal_px"].isna().all()
    (said,) = {record for record in caplog.messages if "intrinsics of the map" in record}
    assert "the focal length" in said
    assert "the poses of the map are good to" not in said, "wrong intrinsics look like noise of the poses"
    assert not [record for record in caplog.messages if "ios_query/sensors.txt" in record]


def test_a_wrong_focal_length_is_doubted_and_said_once_a_camera(
    capture: Path, run: SceneFiles, caplog: pytest.LogCaptureFixture
) -> None:
    lengthen(capture / "sessions" / "ios_query" / "sensors.txt", 1.1)
    run_stage(capture, run, query_device="ios")
    found = rows_of(run, "ios")
    assert not (found["status"] == "ok").any()
    doubted = found[found["status"] == "low_confidence: camera?"]
    assert len(doubted) > len(found) / 2
    assert doubted["focal_px"].notna().all()
    assert doubted["reason"].str.contains("the focal length that fits").all()
    assert [record for record in caplog.messages if "ios_query/sensors.txt" in record]


def test_rows_say_how_a_pose_came_about(finished: tuple[SceneFiles, pd.DataFrame]) -> None:
    found = rows_of(finished[0], "hl")
    ok = found[found["status"] == "ok"]
    assert len(ok)
    assert (ok["method"] == "pnp").all()
    assert (ok["num_inliers"] <= ok["num_matches"]).all()
    np.testing.assert_allclose(ok["inlier_ratio"], ok["num_inliers"] / ok["num_matches"], atol=1e-4)
    assert ok[["rmse_px", "position_std_m", "rotation_std_deg", "seconds"]].gt(0).all(axis=None)
    listed = {name for names in ok["references"] for name in names.split(";")}
    retrieved = set()
    for line in finished[0].retrieval("ios", "hl").read_text().splitlines():
        retrieved |= {entry["path"].split("/sessions/")[1] for entry in json.loads(line)["topk"]}
    assert listed
    assert listed <= retrieved


def test_a_finished_run_leaves_no_partial_files(finished: tuple[SceneFiles, pd.DataFrame]) -> None:
    names = {path.name for path in finished[0].poses_dir.iterdir()}
    stems = [finished[0].poses_txt("ios", device).stem for device in DEVICES]
    ends = ".txt", ".csv", ".h5", ".txt.meta.json", ".items"
    of_the_map = {f"{finished[0].scene}_map_ios.json", f"{finished[0].scene}_map_ios.json.meta.json", "settings.json"}
    assert names == {stem + end for stem in stems for end in ends} | of_the_map


def test_nearest_is_the_pose_of_the_best_reference_and_labeled(small_capture: Path, run: SceneFiles) -> None:
    table = run_stage(small_capture, run, method="nearest", query_device="hl")
    found = rows_of(run, "hl")
    assert (found["method"] == "nearest").all()
    assert (found["status"] == "low_confidence").all()  # never `ok`: nothing has confirmed it
    assert table["low_confidence"].tolist() == [len(found)]
    session = Capture.open(small_capture)["hl_query"]
    best: dict[int, dict] = {}
    for line in run.retrieval("ios", "hl").read_text().splitlines():
        row = json.loads(line)
        entry = row["topk"][0] | {"Trs": row["Trs"]}
        best[int(row["timestamp"])] = max(best.get(int(row["timestamp"]), entry), entry, key=lambda e: e["score"])
    estimated = Trajectory.read(run.poses_txt("ios", "hl"))
    assert estimated.covariances is None
    assert len(estimated) == len(session.keyframes(LIST))
    for timestamp, pose, names in zip(
        estimated.timestamps, estimated.world_from_device, found["references"], strict=True
    ):
        entry = best[int(timestamp)]
        # The camera stands where the reference stood; the device's pose follows from its place in the rig.
        np.testing.assert_allclose(pose @ np.array(entry["Trs"]), entry["Tws"], atol=1e-9)
        assert entry["path"].endswith(names)


# ------------------------------------------------------------------------------------------ wrong questions


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"method": "magic"}, ManifestError, r"method: found 'magic'.*nearest, pnp"),
        ({"map_device": "drone"}, ToolkitError, r"drone.*ios, hl, spot"),
        ({"query_device": "drone"}, ToolkitError, r"drone.*ios, hl, spot"),
        ({"queries": "keyframes_best"}, CaptureError, "original"),
        ({"map_device": "hl"}, ArtifactError, r"SMALL_map_hl_query_ios\.jsonl: .*Run the retrieve stage first"),
        ({"features": ["surf"]}, ManifestError, "Unknown local features 'surf'"),
        ({"features": []}, ManifestError, "features: kinds is empty"),
        ({"matcher": "lightglue"}, ManifestError, "suits none of the features. Known for sift: mutual"),
    ],
)
def test_wrong_questions_are_refused(
    small_capture: Path, run: SceneFiles, wrong: dict, error: type[ToolkitError], message: str
) -> None:
    with pytest.raises(error, match=re.compile(message, re.DOTALL)):
        run_stage(small_capture, run, **wrong)
    assert not run.poses_dir.exists() or not list(run.poses_dir.glob("*.txt"))


def test_a_pose_without_covariance_leaves_the_others_theirs(tmp_path: Path) -> None:
    results = [QueryResult(Status.OK, "", np.eye(4), covariance) for covariance in (np.eye(6), None)]
    localize._write_poses(tmp_path / "pair.txt", [(0, "a"), (1, "a")], ["", ""], results, LocalizeSettings())
    written = Trajectory.read(tmp_path / "pair.txt").covariances
    np.testing.assert_array_equal(written, [np.eye(6), np.full((6, 6), np.nan)])


def test_a_map_of_an_older_format_is_built_anew(small_capture: Path, run: SceneFiles) -> None:
    run_stage(small_capture, run, query_device="ios")
    path = run.maps / "ios_map.npz"
    with np.load(path) as arrays:
        old = {name: arrays[name] for name in arrays.files if name != "noise_px"}
    np.savez(path, **old)
    for record in (sidecar_path(path), sidecar_path(run.poses_txt("ios", "ios"))):
        record.write_text(record.read_text().replace('"format": 3', '"format": 2'))
    table = run_stage(small_capture, run, query_device="ios")
    assert not table["skipped"].any()
    assert (LocalMap.load(path).noise_px > 0).all()


@pytest.mark.parametrize("line", ["{", '{"timestamp": "1"}', '{"timestamp": "x", "sensor_id": "a", "topk": []}', "[]"])
def test_a_garbled_retrieval_names_the_line(small_capture: Path, run: SceneFiles, line: str) -> None:
    path = run.retrieval("ios", "ios")
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(ArtifactError, match=r"SMALL_map_ios_query_ios\.jsonl, line 4: not a retrieval row"):
        run_stage(small_capture, run, query_device="ios")


# -------------------------------------------------------------------------------------------- what is broken


def test_an_unreadable_photograph_is_a_row_and_the_others_go_on(
    capture: Path, run: SceneFiles, finished: tuple[SceneFiles, pd.DataFrame]
) -> None:
    session = Capture.open(capture)["ios_query"]
    session.image_path(1).write_bytes(b"\xff\xd8 torn")
    table = run_stage(capture, run, query_device="ios")
    found, before = rows_of(run, "ios"), rows_of(finished[0], "ios")
    bad = found["timestamp"] == session.images["timestamp"].iloc[1]
    assert bad.sum() == 1
    assert found["status"][bad].iloc[0].startswith("failed: no readable image (Image cannot be decoded")
    assert found["status"][~bad].tolist() == before["status"][~bad].tolist()
    assert table["failed"].tolist() == [1]
    poses = dict(zip(before["timestamp"], Trajectory.read(finished[0].poses_txt("ios", "ios")).qt, strict=True))
    estimated = Trajectory.read(run.poses_txt("ios", "ios"))
    assert set(estimated.timestamps) == set(found["timestamp"][~bad])
    for timestamp, qt in zip(estimated.timestamps, estimated.qt, strict=True):
        np.testing.assert_array_equal(qt, poses[timestamp])


def test_a_rig_goes_on_with_the_cameras_that_it_has(capture: Path, run: SceneFiles) -> None:
    session = Capture.open(capture)["spot_query"]
    keyframe = session.keyframes(LIST).iloc[:1]
    rows = session.rows_of_keyframes(keyframe)[0]
    session.image_path(int(rows[0])).unlink()
    run_stage(capture, run, query_device="spot")
    row = rows_of(run, "spot").iloc[0]
    assert row["status"] in ("ok", "low_confidence")
    assert f"Image not found: {session.image_path(int(rows[0]))}" in row["reason"]
    estimated = Trajectory.read(run.poses_txt("ios", "spot"))
    true = session.ground_truth.lookup(estimated.timestamps[:1], estimated.device_ids[:1])
    assert geometry.pose_error(estimated.world_from_device[:1], true)[1] < 0.1


def test_a_keyframe_without_photographs_is_a_row(capture: Path, run: SceneFiles) -> None:
    path = capture / "sessions" / "ios_query" / "proc" / f"{LIST}.txt"
    path.write_text(path.read_text() + "123456789, nobody/cam\n")
    table = run_stage(capture, run, query_device="ios")
    last = rows_of(run, "ios").iloc[-1]
    assert (last["timestamp"], last["device_id"]) == (123456789, "nobody/cam")
    assert last["status"] == "failed: no images of this device at this time"
    assert table[["queries", "failed"]].to_numpy().tolist() == [[4, 1]]
    assert 123456789 not in Trajectory.read(run.poses_txt("ios", "ios")).timestamps


def test_a_keyframe_that_is_listed_twice_is_one_query(capture: Path, run: SceneFiles) -> None:
    path = capture / "sessions" / "ios_query" / "proc" / f"{LIST}.txt"
    path.write_text(path.read_text() + path.read_text().splitlines()[-1] + "\n5, a/b\n5, a-b\n")
    table = run_stage(capture, run, query_device="ios")
    assert table[["queries", "failed"]].to_numpy().tolist() == [[5, 2]]
    assert [bool(result.images) for result in PairResults.open(run.poses_txt("ios", "ios"))] == [True] * 3 + [False] * 2


def test_an_image_that_was_not_retrieved_for_is_a_row(small_capture: Path, run: SceneFiles) -> None:
    path = run.retrieval("ios", "ios")
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(ArtifactError):  # damaged, as its sidecar says
        run_stage(small_capture, run, query_device="ios")
    sidecar_path(path).unlink()
    run_stage(small_capture, run, query_device="ios")
    assert rows_of(run, "ios")["status"].tolist()[-1] == "failed: no references"


def test_an_exception_in_one_query_does_not_end_the_run(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    calls = spy(monkeypatch, fail_at=1, error=ZeroDivisionError("by chance"))
    run_stage(small_capture, run, query_device="ios")
    status = rows_of(run, "ios")["status"]
    assert len(calls) == 3
    assert (status == "failed: internal: ZeroDivisionError: by chance").sum() == 1
    assert (status == "ok").sum() == 2
    assert "Traceback" in caplog.text


def test_an_exception_in_a_retry_leaves_the_pose_that_was_found_before(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_other_kind(monkeypatch)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Map, "retry", Mock(side_effect=ZeroDivisionError("by chance")))
        run_stage(small_capture, run, query_device="ios", **ESCALATES)
    rows = rows_of(run, "ios")
    assert set(rows["status"]) == {"low_confidence"}
    assert set(rows["reason"]) == {"internal: ZeroDivisionError: by chance"}
    assert len(Trajectory.read(run.poses_txt("ios", "ios"))) == 3
    run_stage(small_capture, run, query_device="ios", **ESCALATES)
    assert rows_of(run, "ios")["first_status"].tolist() == ["low_confidence"] * 3, "the next run tries it again"


def test_a_fault_of_the_toolkit_is_tried_again_by_the_next_run(
    small_capture: Path, run: SceneFiles, finished: tuple[SceneFiles, pd.DataFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        spy(patch, fail_at=1, error=TypeError("a slip"))
        run_stage(small_capture, run, query_device="ios")
    calls = spy(monkeypatch)
    table = run_stage(small_capture, run, query_device="ios")
    assert len(calls) == 1, "of that query alone"
    assert not table["skipped"].item()
    assert run.poses_txt("ios", "ios").read_bytes() == finished[0].poses_txt("ios", "ios").read_bytes()
    assert all(query.correspondences.agrees.any() for query in PairResults.open(run.poses_txt("ios", "ios")))
    assert run_stage(small_capture, run, query_device="ios")["skipped"].item()


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("no room"),
        OSError(5, "input/output error"),
        ArtifactError("torn"),
        RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"),
        cv2.error("Insufficient memory (Failed to allocate 3 bytes)"),
    ],
)
def test_what_is_no_property_of_a_query_ends_the_stage_and_what_is_done_is_kept(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        spy(patch, fail_at=1, error=error)
        with pytest.raises(type(error)):
            run_stage(small_capture, run, query_device="ios")
    assert not run.poses_txt("ios", "ios").exists()
    calls = spy(monkeypatch)
    run_stage(small_capture, run, query_device="ios")
    assert len(calls) == 2, "the first was done"


@pytest.mark.parametrize("error", [ImageError("dark.jpg: torn"), np.linalg.LinAlgError("singular")])
def test_what_is_a_property_of_a_query_is_its_result(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    spy(monkeypatch, fail_at=1, error=error)
    run_stage(small_capture, run, query_device="ios")
    assert rows_of(run, "ios")["status"].tolist()[1] == f"failed: {type(error).__name__}: {error}"
    assert run_stage(small_capture, run, query_device="ios")["skipped"].item()


# -------------------------------------------------------------------------------------- reuse, resume, order


def described(vectors: Sequence[np.ndarray]) -> Query:
    """Return a query that has global descriptors (C, D), by embedder, and nothing else."""
    return Query([], np.tile(np.eye(4), (len(vectors[0]), 1, 1)), descriptors=vectors)


def spy(monkeypatch: pytest.MonkeyPatch, fail_at: int | None = None, error: BaseException | None = None) -> list[int]:
    """Count the queries that are localized from now on; fail at one of them."""
    calls: list[int] = []
    work: Callable[..., QueryResult] = PnpLocalizer.solve

    def counted(self: PnpLocalizer, *args: object, **named: object) -> QueryResult:
        calls.append(len(calls))
        if error is not None and calls[-1] == fail_at:
            raise error
        return work(self, *args, **named)

    monkeypatch.setattr(PnpLocalizer, "solve", counted)
    return calls


@pytest.mark.parametrize("device", ["ios", "spot"])
def test_a_killed_run_goes_on_where_it_was(
    small_capture: Path,
    run: SceneFiles,
    finished: tuple[SceneFiles, pd.DataFrame],
    device: str,
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        spy(patch, fail_at=2, error=KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, query_device=device)
    assert not run.poses_txt("ios", device).exists()
    with pytest.MonkeyPatch.context() as patch:
        calls = spy(patch)
        table = run_stage(small_capture, run, query_device=device)
    assert len(calls) == table["queries"].iloc[0] - 2
    assert run.poses_txt("ios", device).read_bytes() == finished[0].poses_txt("ios", device).read_bytes()
    assert without_times(run, device) == without_times(finished[0], device)


@pytest.mark.slow
@pytest.mark.parametrize(("killed_at", "calls_left"), [(2, 4), (4, 2)])
def test_a_killed_run_goes_on_where_it_asks_for_more_features(
    small_capture: Path,
    run: SceneFiles,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    killed_at: int,
    calls_left: int,
) -> None:
    """Three queries are localized once, then with further features.

    A kill in the first round, or in the second, costs one query.
    """
    add_other_kind(monkeypatch)
    whole = SceneFiles(tmp_path / "whole", run.scene)
    shutil.copytree(run.root, whole.root)
    run_stage(small_capture, whole, query_device="ios", **ESCALATES)
    with pytest.MonkeyPatch.context() as patch:
        spy(patch, fail_at=killed_at, error=KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, query_device="ios", **ESCALATES)
    with pytest.MonkeyPatch.context() as patch:
        calls = spy(patch)
        run_stage(small_capture, run, query_device="ios", **ESCALATES)
    assert len(calls) == calls_left
    assert run.poses_txt("ios", "ios").read_bytes() == whole.poses_txt("ios", "ios").read_bytes()
    table = pd.read_csv(run.poses_txt("ios", "ios").with_suffix(".csv"))
    assert (table["method"] == "pnp+other").all()
    assert (table["first_status"] == "low_confidence").all()
    assert (table["seconds"] > table["first_seconds"]).all()
    with pytest.MonkeyPatch.context() as patch:
        assert not spy(patch)
        assert run_stage(small_capture, run, query_device="ios", **ESCALATES)["skipped"].all()


def test_a_sure_pose_asks_for_nothing_more(
    small_capture: Path, run: SceneFiles, finished: tuple[SceneFiles, pd.DataFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    add_other_kind(monkeypatch)
    run_stage(small_capture, run, query_device="ios", features=ESCALATES["features"])
    assert not list(run.features.glob("*/other*"))
    assert run.poses_txt("ios", "ios").read_bytes() == finished[0].poses_txt("ios", "ios").read_bytes()
    assert pd.read_csv(run.poses_txt("ios", "ios").with_suffix(".csv"))["first_status"].isna().all()


@pytest.mark.parametrize(("sure_m", "asked"), [(1.0, 1), (0.0, 2)])
def test_an_ok_pose_that_is_not_precise_asks_the_references_that_support_it_before_all(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch, sure_m: float, asked: int
) -> None:
    """A query asks few references; all only if it is still unsure. The deviations of the first poses count as large."""
    add_other_kind(monkeypatch)
    monkeypatch.setattr(maps, "FEW_REFERENCES", 2)
    with_other = lambda result: result.found_by.endswith("other")  # noqa: E731
    unsure = lambda _, result: result.position_std > (sure_m if with_other(result) else 0)  # noqa: E731
    monkeypatch.setattr(maps.Map, "is_unsure", unsure)
    counts, match = list[int](), maps.OnDemandLocalizer.match

    def counted(self: Any, query: Query, references: Sequence[References]) -> Any:
        counts.append(sum(len(found.images) for found in references))
        return match(self, query, references)

    monkeypatch.setattr(maps.OnDemandLocalizer, "match", counted)
    table = run_stage(small_capture, run, query_device="ios", features=ESCALATES["features"])
    queries, rounds = table["queries"].item(), sorted(counts)
    assert table["escalated"].item() == table["ok"].item() == queries
    assert len(rounds) == asked * queries
    assert rounds[:queries] == [2] * queries
    assert all(count > 2 for count in rounds[queries:])
    rows = rows_of(run, "ios")
    assert (rows["method"] == "pnp+other").all()
    assert run_stage(small_capture, run, query_device="ios", features=ESCALATES["features"])["skipped"].all()


@pytest.mark.slow
def test_a_first_answer_that_is_not_bettered_stays(
    small_capture: Path, run: SceneFiles, finished: tuple[SceneFiles, pd.DataFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    add_other_kind(monkeypatch)
    failed = QueryResult.failed("no consistent pose")
    monkeypatch.setattr(maps.OnDemandLocalizer, "solve", lambda *_: failed)
    run_stage(small_capture, run, query_device="ios", **ESCALATES)
    assert run.poses_txt("ios", "ios").read_bytes() == finished[0].poses_txt("ios", "ios").read_bytes()
    table = rows_of(run, "ios")
    assert (table["status"] == "low_confidence").all()
    assert (table["method"] == "pnp").all()
    assert (table["first_status"] == "low_confidence").all()
    for both in zip(*(PairResults.open(files.poses_txt("ios", "ios")) for files in (run, finished[0])), strict=True):
        a, b = (result.correspondences for result in both)
        np.testing.assert_array_equal(a.pixels, b.pixels)
        np.testing.assert_array_equal(a.agrees, b.agrees)


def test_a_query_without_references_asks_for_nothing_more(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_other_kind(monkeypatch)
    rows = [json.loads(line) | {"topk": []} for line in run.retrieval("ios", "ios").read_text().splitlines()]
    run.retrieval("ios", "ios").write_text("\n".join(map(json.dumps, rows)))
    sidecar_path(run.retrieval("ios", "ios")).unlink()
    table = run_stage(small_capture, run, query_device="ios", **ESCALATES)
    assert (table["escalated"].item(), table["failed"].item()) == (0, len(rows_of(run, "ios")))
    assert not list(run.features.glob("*/other*"))


@pytest.mark.slow
def test_a_network_is_asked_once_about_a_query_that_escalates(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_other_kind(monkeypatch)
    predictor, asked = ByContent(Capture.open(small_capture), run.maps), list[int]()

    def predict(groups: Sequence[Sequence[View]]) -> list[Prediction]:
        asked.append(len(groups))
        return ByContent.predict(predictor, groups)

    monkeypatch.setattr(predictor, "predict", predict)
    monkeypatch.setattr(predictors, "NetworkPredictor", lambda *_, **__: predictor)
    settings = ESCALATES | {"method": "hybrid", "predictor": {"num_references": 3}}
    table = run_stage(small_capture, run, query_device="ios", **settings)
    assert sum(asked) == table["queries"].item() == table["escalated"].item()


def test_a_torn_shard_costs_at_most_what_it_held(
    small_capture: Path,
    run: SceneFiles,
    finished: tuple[SceneFiles, pd.DataFrame],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        spy(patch, fail_at=2, error=KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, query_device="ios")
    (shard,) = run.poses_dir.glob("*.items/*.shard")
    shard.write_bytes(shard.read_bytes()[:-100])
    calls = spy(monkeypatch)
    run_stage(small_capture, run, query_device="ios")
    assert len(calls) == 3
    assert run.poses_txt("ios", "ios").read_bytes() == finished[0].poses_txt("ios", "ios").read_bytes()


@pytest.mark.parametrize("torn", ["_write_poses", "write_sidecar", "write_groups"])
def test_a_run_killed_at_its_end_leaves_no_files_of_two_runs(small_capture: Path, run: SceneFiles, torn: str) -> None:
    run_stage(small_capture, run, query_device="ios")
    before = run.poses_txt("ios", "ios").read_bytes()
    path = run.poses_txt("ios", "ios").with_suffix(".h5")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(localize, torn, Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, query_device="ios", method="nearest")
    assert not run.poses_txt("ios", "ios").exists()
    run_stage(small_capture, run, query_device="ios")
    assert run.poses_txt("ios", "ios").read_bytes() == before
    assert all(query.correspondences.agrees.any() for query in PairResults.open(path))


@pytest.mark.slow
def test_progress_of_another_question_is_not_taken_over(small_capture: Path, run: SceneFiles) -> None:
    with pytest.MonkeyPatch.context() as patch:
        spy(patch, fail_at=2, error=KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, query_device="ios", seed=5)
    with pytest.MonkeyPatch.context() as patch:
        calls = spy(patch)
        run_stage(small_capture, run, query_device="ios")
    assert len(calls) == 3


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_equal_seeds_give_equal_files(
    small_capture: Path, run: SceneFiles, finished: tuple[SceneFiles, pd.DataFrame], workers: int
) -> None:
    shutil.rmtree(run.maps)  # the map too is made anew
    run_stage(small_capture, run, workers=workers)
    for device in DEVICES:
        assert run.poses_txt("ios", device).read_bytes() == finished[0].poses_txt("ios", device).read_bytes()
        assert without_times(run, device) == without_times(finished[0], device)


def test_a_finished_pair_is_reused_until_something_changes(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_stage(small_capture, run, query_device="ios")
    stamp = run.poses_txt("ios", "ios").stat().st_mtime_ns
    calls = spy(monkeypatch)

    def again(**more: object) -> bool:
        calls.clear()
        table = run_stage(small_capture, run, query_device="ios", **more)
        assert table["queries"].tolist() == [3]
        assert table["ok"].iloc[0] + table["low_confidence"].iloc[0] == 3
        return bool(table["skipped"].iloc[0])

    assert again()
    assert again(workers=2)  # the answer does not depend on it
    assert calls == []
    assert run.poses_txt("ios", "ios").stat().st_mtime_ns == stamp
    assert not again(skip_existing=False)
    assert len(calls) == 3
    assert not again(method="nearest")
    assert not again()  # the poses that lay there were the baseline's
    assert (rows_of(run, "ios")["method"] == "pnp").all()
    run.poses_csv("ios", "ios").unlink()
    assert not again()
    sidecar_path(run.poses_txt("ios", "ios")).unlink()
    assert not again()
    path = run.retrieval("ios", "ios")
    path.write_text(path.read_text() + path.read_text().splitlines(keepends=True)[-1])
    sidecar_path(path).unlink()
    assert not again()
    assert again()


@pytest.mark.parametrize("file", ["images.txt", "sensors.txt", "trajectories.txt"])
def test_changed_files_of_the_map_make_the_poses_anew(capture: Path, run: SceneFiles, file: str) -> None:
    """A map session whose last photograph is gone, or whose files were touched up, is another map."""
    run_stage(capture, run, query_device="ios")
    assert run_stage(capture, run, query_device="ios")["skipped"].all()
    path = capture / "sessions" / "ios_map" / file
    path.write_text(path.read_text() + "# corrected\n")
    assert not run_stage(capture, run, query_device="ios")["skipped"].any()


def test_poses_are_made_anew_if_another_map_tells_which_way_up_the_images_are(capture: Path, run: SceneFiles) -> None:
    def skipped(**settings: object) -> bool:
        return bool(run_stage(capture, run, query_device="hl", **settings)["skipped"].item())

    predicts = {"method": "feed_forward", "predictor": {"name": "simulated"}}
    assert [skipped(**predicts), skipped(**predicts)] == [False, True]
    with_poses(capture, lambda poses: poses @ np.diag([1.0, -1, -1, 1]), "hl_map/trajectories.txt")
    assert [skipped(**predicts), skipped(**predicts)] == [False, True]
    as_stored = {"method": "pnp"}
    assert [skipped(**as_stored), skipped(**as_stored)] == [False, True]
    with_poses(capture, lambda poses: poses @ np.diag([1.0, -1, -1, 1]), "hl_map/trajectories.txt")
    assert skipped(**as_stored), "nothing is turned"


# ---------------------------------------------------------------------------------------- a single picture


@pytest.fixture(scope="module")
def opened(finished: tuple[SceneFiles, pd.DataFrame]) -> Map:
    return Map.open(finished[0].run, finished[0].scene, "ios")


def test_a_picture_without_a_camera_gets_the_focal_length_that_fits(opened: Map, small_capture: Path) -> None:
    session = Capture.open(small_capture)["ios_query"]
    rows = session.rows_of_keyframes(session.keyframes("pruned"))
    found = []
    for row in [int(rows[0]) for rows in rows]:
        pixels, camera = read_image(session.image_path(row)), session.camera(session.images["sensor_id"].iloc[row])
        # Cropped about its principal point, as no camera of the map has this size.
        left, top = 40, 30
        part = np.ascontiguousarray(pixels[top : camera.height - top, left : camera.width - left])
        answer = localize_image(opened, part)
        if answer.status == Status.OK:
            errors = geometry.pose_error(answer.world_from_rig, session.world_from_cam([row], ground_truth=True)[0])
            assert errors[0] < 5
            assert errors[1] < 0.5
            assert "focal length" in answer.remark
            found.append(float(answer.remark.split()[2]) / camera.mean_focal_length())
    assert found
    assert np.median(found) == pytest.approx(1, abs=0.05)


def test_a_picture_without_a_camera_is_described_once(
    opened: Map, small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its features were extracted again for each focal length that was tried."""
    session = Capture.open(small_capture)["ios_query"]
    pixels, extract, calls = read_image(session.image_path(0))[20:, 20:], SiftExtractor.extract, list[int]()
    monkeypatch.setattr(SiftExtractor, "extract", lambda *given: calls.append(1) or extract(*given))
    answer = localize_image(opened, np.ascontiguousarray(pixels))
    assert answer.world_from_rig is not None
    assert len(calls) == 1


def test_a_picture_without_a_camera_that_tells_nothing(opened: Map) -> None:
    answer = localize_image(opened, np.full((300, 400), 90, np.uint8))
    assert answer.status == Status.FAILED
    assert "480 px, a guess" in answer.remark


def test_photographs_on_the_command_line(
    opened: Map, small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Capture.open(small_capture)["ios_query"]
    assert opened.files is not None
    run = tmp_path / "run"
    shutil.copytree(opened.files.run, run)
    (run / "run.json").write_text("{}")
    photo = str(session.image_path(0))
    camera = camera_text(session.camera(session.images["sensor_id"].iloc[0]))
    command = ["localize", str(run), photo, str(tmp_path / "nowhere.jpg"), "--camera", camera, "--json"]
    before = snapshot(run)
    drawn: list[tuple[Any, ...]] = []
    draw_scene = top_view.draw_scene
    monkeypatch.setattr(top_view, "draw_scene", lambda *a, **k: drawn.append((*a, k["title"])) or draw_scene(*a, **k))
    result = CliRunner().invoke(app, [*command, "--picture", str(tmp_path / "above.png")])
    assert result.exit_code == 0
    np.testing.assert_array_equal(drawn[0][0], sure_points(opened.mapped[0].map)[0], "without points that are noisy")
    assert drawn[0][-1] == "Photographs in the map, from above: 1 of 2 have a pose"
    answer, missing = json.loads(result.stdout)["photographs"]
    expected = localize_image(opened, photo, session.camera(session.images["sensor_id"].iloc[0]))
    assert answer["status"] == expected.status_text
    if expected.world_from_rig is not None:
        np.testing.assert_array_equal(answer["world_from_cam"], expected.world_from_rig)
    assert missing["status"].startswith("failed: ImageError")
    assert (tmp_path / "above.png").stat().st_size > 0
    assert snapshot(run) == before


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(path): (path.stat().st_size, path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_single_picture_gets_the_pipelines_pose_and_changes_nothing(
    small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame], opened: Map
) -> None:
    session = Capture.open(small_capture)["ios_query"]
    before = snapshot(finished[0].run)
    estimated = Trajectory.read(finished[0].poses_txt("ios", "ios"))
    for row in range(len(session.images)):
        image = session.images.iloc[row]
        expected = estimated.lookup([image["timestamp"]], [image["sensor_id"]])[0]
        answer = localize_image(opened, session.image_path(row), session.camera(image["sensor_id"]))
        assert answer.status in ("ok", "low_confidence")
        np.testing.assert_allclose(answer.world_from_rig, expected, atol=1e-9)
    assert snapshot(finished[0].run) == before


def test_a_picture_may_be_pixels(small_capture: Path, opened: Map) -> None:
    session = Capture.open(small_capture)["ios_query"]
    path, camera = session.image_path(0), session.camera(session.images["sensor_id"].iloc[0])
    from_file = localize_image(opened, str(path), camera)
    gray = localize_image(opened, read_image(path, gray=True), camera)
    np.testing.assert_allclose(gray.world_from_rig, from_file.world_from_rig, atol=1e-9)
    color = localize_image(opened, read_image(path), camera)
    rotation_deg, distance_m = geometry.pose_error(color.world_from_rig, from_file.world_from_rig)
    assert rotation_deg < 0.1
    assert distance_m < 0.01


def camera_of(params: list[float], width: int = 10) -> pycolmap.Camera:
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=20, params=[10, 10, 5, 10])
    camera.params = params
    return camera


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"image": np.full((20, 10), np.nan)}, r"\(20, 10\) float64 from nan"),
        ({"image": np.full((20, 10), -1)}, "int64 from -1"),
        ({"image": np.full((20, 10), 300.0)}, "to 300"),
        ({"image": np.zeros((20, 10, 4), np.uint8)}, r"\(20, 10, 4\)"),
        ({"image": np.zeros((20, 10), complex)}, "complex"),
        ({"image": np.zeros((0, 10), np.uint8)}, r"\(0, 10\)"),
        ({"image": np.zeros(20, np.uint8)}, r"\(20,\)"),
        ({"image": None}, "None"),
        ({"image": b"bytes"}, "bytes"),
        ({"image": [[1, 2], [3]]}, "list"),
        ({"image": ["1.jpg", "2.jpg"]}, "2 images, 1 cameras"),
        ({"camera": "PINHOLE, 10, 20, 10, 10, 5, 10"}, "camera: found 'PINHOLE.*parse_camera"),
        ({"camera": camera_of([10, 10, 5])}, "camera: found 3 parameters"),
        ({"camera": camera_of([-10, 10, 5, 10])}, "camera: found a focal length"),
        ({"camera": camera_of([np.nan, 10, 5, 10])}, "camera: .*finite"),
        ({"camera": camera_of([10, 10, 5, 10], width=11)}, "10 x 20 pixels, its camera 11 x 20"),
        ({"rig_from_cams": np.eye(3)}, r"rig_from_cams: found \(3, 3\)"),
        ({"image": ["a.jpg", "b.jpg"], "camera": None}, "camera: found None"),
        ({"image": [], "camera": []}, "0 images"),
        ({"image": "12345.jpg", "camera": []}, "1 images, 0 cameras"),
        ({"turns": [1, 2]}, "2 turns"),
        ({"turns": 1}, "turns: found 1, expected whole numbers"),
        ({"turns": ["a"]}, r"turns: found \['a'\], expected whole numbers"),
        ({"rig_from_cams": "x"}, r"rig_from_cams: found 'x', expected \(C, 4, 4\) numbers"),
        ({"rig_from_cams": np.diag([1.0, 1, -1, 1])}, "rig_from_cams: found no pose for image 1: .* nor mirrors"),
        ({"rig_from_cams": np.diag([2.0, 2, 2, 1])}, "rig_from_cams: found no pose for image 1: .* neither scales"),
        ({"rig_from_cams": np.ones((1, 4, 4))}, "rig_from_cams: found no pose for image 1"),
    ],
)
def test_what_is_no_picture_is_refused(opened: Map, changed: dict, message: str) -> None:
    camera = pycolmap.Camera(model="PINHOLE", width=10, height=20, params=[10, 10, 5, 10])
    with pytest.raises(ImageError, match=message):
        localize_image(opened, **({"image": np.zeros((20, 10), np.uint8), "camera": camera} | changed))


def test_what_other_libraries_call_an_image_is_the_same_picture() -> None:
    from PIL import Image

    color = np.random.default_rng(0).integers(0, 256, (20, 10, 3), np.uint8)
    gray = color[:, :, 0]
    for same in (
        color.astype(np.float32) / 255, color.astype(float), color.astype(np.int64), color.astype(np.uint16) * 257,
        np.moveaxis(color, 2, 0), np.moveaxis(color, 2, 0).astype(np.float32) / 255, torch.from_numpy(color),
        color.astype(np.uint16), color.tolist(), Image.fromarray(color), Image.fromarray(color).convert("RGBA"),
    ):  # fmt: skip
        np.testing.assert_array_equal(pixels_from(same), color)
    for same in (gray[:, :, None], gray[None], gray.tolist(), Image.fromarray(gray), gray.astype(np.uint16) << 8):
        np.testing.assert_array_equal(pixels_from(same), gray)
    np.testing.assert_array_equal(pixels_from(gray > 99), np.where(gray > 99, 255, 0))


def test_pixels_of_other_types_get_the_pose_of_their_file(small_capture: Path, opened: Map) -> None:
    session = Capture.open(small_capture)["ios_query"]
    path, camera = session.image_path(0), session.camera(session.images["sensor_id"].iloc[0])
    pixels = read_image(path)
    expected = localize_image(opened, pixels, camera).world_from_rig
    answer = localize_image(opened, np.moveaxis(pixels, 2, 0).astype(np.float32) / 255, camera)
    np.testing.assert_array_equal(answer.world_from_rig, expected)


@pytest.mark.parametrize("upright", [None, False])
def test_a_picture_is_turned_for_what_the_run_turned_images_for(
    small_capture: Path,
    finished: tuple[SceneFiles, pd.DataFrame],
    upright: bool | None,
) -> None:
    files = finished[0]
    scene_map = Map.open(files.run, files.scene, "ios")
    scene_map.settings = LocalizeSettings.of({"method": "feed_forward"})
    scene_map.search.embed_settings = EmbedSettings.of({"upright": upright})
    learned = Learned(np.ones(scene_map.search.vectors.shape[1], np.float32))
    scene_map.search.embedders = [learned]
    asked: list[Query] = []
    localizer = AsManyAsFeatures(scene_map.mapped)
    localizer.solve = lambda matches, *_: asked.append(matches.query) or QueryResult(Status.OK)  # type: ignore
    vars(scene_map)["localizer"] = localizer
    camera = pycolmap.Camera(model="PINHOLE", width=10, height=20, params=[10, 10, 5, 10])
    localize_image(scene_map, np.zeros((20, 10), np.uint8), camera, turns=[1])
    assert learned.seen == [(10, 20, 3) if upright is None else (20, 10, 3)]
    assert asked[0].views[0].turns == 1


def test_a_picture_of_nothing_has_no_pose(small_capture: Path, opened: Map) -> None:
    session = Capture.open(small_capture)["ios_query"]
    camera = session.camera(session.images["sensor_id"].iloc[0])
    answer = localize_image(opened, np.zeros((camera.height, camera.width), np.uint8), camera)
    assert answer.status_text == "failed: too few matches"
    assert answer.world_from_rig is None


def test_a_picture_of_another_size_than_its_camera_is_refused(small_capture: Path, opened: Map) -> None:
    session = Capture.open(small_capture)["ios_query"]
    camera = session.camera(session.images["sensor_id"].iloc[0])
    for picture, named in (
        (np.zeros((20, 10), np.uint8), f"10 x 20 pixels, its camera {camera.width} x {camera.height}"),
        ("nowhere.jpg", "not found"),
    ):
        with pytest.raises(ImageError, match=named):
            localize_image(opened, picture, camera)


def test_a_run_whose_capture_has_moved_opens_after_the_next_run(
    capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_stage(capture, run, query_device="ios")
    moved = capture.parent.with_name("moved") / capture.name
    capture.parent.rename(moved.parent)
    calls = spy(monkeypatch)
    assert run_stage(moved, run, query_device="ios", compute_device="cpu")["skipped"].all()
    assert not calls
    scene_map = Map.open(run.run, run.scene, "ios")
    assert scene_map.session.path == moved / "sessions" / "ios_map"
    assert scene_map.settings.compute_device == "cpu", "as the last run had it"
    path = run.poses_txt("ios", "ios").with_suffix(".h5")
    assert all(query.correspondences.agrees.any() for query in PairResults.open(path))
    stamp = path.stat().st_mtime_ns
    run_stage(moved, run, query_device="ios", compute_device="cpu")
    assert path.stat().st_mtime_ns == stamp


@pytest.mark.parametrize("beside", [True, False])
@pytest.mark.parametrize("content", [b"torn", b"", None])
def test_a_torn_file_of_correspondences_is_named(
    run: SceneFiles, finished: tuple[SceneFiles, pd.DataFrame], content: bytes | None, beside: bool
) -> None:
    """Of something else, without queries, and cut short; beside the tables of its pair, and alone."""
    path = run.poses_txt("ios", "ios").with_suffix(".h5")
    path.parent.mkdir()
    for file in finished[0].poses_dir.glob(f"{path.stem}.[cht]*" if beside else path.name):
        shutil.copy(file, path.parent)
    if content == b"":
        h5py.File(path, "w").close()
    else:
        path.write_bytes(content or path.read_bytes()[:500])
    with pytest.raises(ArtifactError, match=path.name):
        Map.open(run.run, run.scene, "ios")


def test_a_map_without_points_gets_them_for_a_query(small_capture: Path, run: SceneFiles) -> None:
    """It was refused: a run with `nearest` has no features and no points."""
    run_stage(small_capture, run, query_device="ios", method="nearest")
    scene_map = Map.open(run.run, run.scene, "ios")
    session = scene_map.capture["ios_query"]
    query = scene_map.query_of_session(session, session.camera_rows[:1])
    references = [References.of(list(range(6)))]
    assert scene_map.locate(query, references=references).status == "low_confidence"
    assert scene_map.changed({"method": "pnp", "features": "sift"}).locate(query, references=references).status == "ok"


def test_a_localizer_of_another_method_sees_images_upright_as_its_settings_say(
    opened: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    directions: list[object] = []
    monkeypatch.setattr(maps, "upright_turns", lambda _, direction: directions.append(direction))
    settings = {"method": "feed_forward", "predictor": {"name": "simulated"}, "world_up": [0, 0, 1]}
    _ = replace(opened, settings=LocalizeSettings.of(opened.settings, settings)).localizer
    assert directions == [[0, 0, 1]]


def test_an_unknown_run_scene_or_device_is_told_with_the_known_ones(
    finished: tuple[SceneFiles, pd.DataFrame], tmp_path: Path
) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "run.json").touch()
    run = finished[0].run
    for ask, named in (
        (lambda: Map.open(run, "SMALL", "hl"), r"'hl'.*Known: ios\."),
        (lambda: Map.open(run, "SMAL", "ios"), r"'SMAL'.*Known: SMALL\."),
        (lambda: Map.open(tmp_path / "dem", "SMALL", "ios"), r"dem: no such run.*Known: demo\."),
        (lambda: Map.open(None, "SMALL", "ios"), "None"),
        (lambda: Map.open(run, None, "ios"), "None"),
        (lambda: Map.open(run, "SMALL", 5), "5"),
        (lambda: localize_image(None, "a.jpg", None), "NoneType"),
    ):
        with pytest.raises(ArtifactError, match=named):
            ask()


@pytest.mark.slow
def test_the_settings_of_the_last_run_count_whatever_the_clock_says(small_capture: Path, run: SceneFiles) -> None:
    run_stage(small_capture, run, query_device="hl", seed=1)
    run_stage(small_capture, run, query_device="ios", seed=2)
    future = time.time_ns() + 10**15
    os.utime(run.poses_dir / "SMALL_map_ios_query_hl.h5", ns=(future, future))
    assert Map.open(run.run, run.scene, "ios").settings.seed == 2


def test_an_unusable_session_stops_its_own_pairs_alone(capture: Path, run: SceneFiles) -> None:
    run_stage(capture, run, query_device="hl")
    hl = capture / "sessions" / "hl_query" / "images.txt"
    before, poses = hl.read_text(), run.poses_txt("ios", "hl").read_bytes()
    hl.write_text("a line\n")
    table = run_stage(capture, run).set_index("query_device")
    assert "hl_query/images.txt, line 1" in table["reason"]["hl"]
    assert (table["reason"].drop("hl") == "").all()
    assert table["ok"].drop("hl").gt(0).all()
    assert not run.poses_txt("ios", "hl").exists(), "poses of another capture than this"
    hl.write_text(before)
    table = run_stage(capture, run).set_index("query_device")
    assert (table["reason"] == "").all()
    assert run.poses_txt("ios", "hl").read_bytes() == poses


def test_a_pair_that_retrieval_left_out_has_its_reason(small_capture: Path, run: SceneFiles) -> None:
    (run.retrieval_dir / "SMALL_map_ios_query_hl.left_out.json").write_text('{"reason": "a dragon"}')
    table = run_stage(small_capture, run).set_index("query_device")
    assert table["reason"].to_dict() == {"ios": "", "hl": "a dragon", "spot": ""}
    with pytest.raises(ArtifactError):
        run_stage(small_capture, run, query_device="hl")


class Learned:
    """An embedder of images that always points at the same descriptor."""

    name, upright = "learned", True
    inputs: Literal["images"] = "images"
    min_side: int | None = None

    def __init__(self, vector: np.ndarray) -> None:
        self.vector = vector
        self.dim = len(vector)
        self.seen: list[tuple[int, ...]] = []

    def prepare(self, image: np.ndarray) -> np.ndarray:
        return image

    def stack(self, inputs: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
        return inputs

    def embed(self, inputs: Sequence[np.ndarray]) -> np.ndarray:
        self.seen += [image.shape for image in inputs]
        return np.repeat(self.vector[None], len(inputs), axis=0)


def test_a_learned_embedder_is_given_colors(small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame]) -> None:
    files = finished[0]
    session = Capture.open(small_capture)["ios_query"]
    path, camera = session.image_path(0), session.camera(session.images["sensor_id"].iloc[0])
    scene_map = Map.open(files.run, files.scene, "ios")
    expected = localize_image(scene_map, path, camera)
    store = extract_session(session, files.features)
    learned = Learned(scene_map.search.embedders[0].embed([store[session.image_name(0)]])[0])
    scene_map.search.embedders = [learned]
    np.testing.assert_array_equal(localize_image(scene_map, path, camera).world_from_rig, expected.world_from_rig)
    assert learned.seen == [(camera.height, camera.width, 3)]
    learned.min_side = camera.height // 4
    np.testing.assert_array_equal(localize_image(scene_map, path, camera).world_from_rig, expected.world_from_rig)
    assert learned.seen[1] == (camera.height // 4, camera.width // 4, 3), "as the stage decodes it"
    scene_map.search.embedders = [Learned(np.zeros(7, np.float32))]
    with pytest.raises(ArtifactError, match="expected 7 of learned"):
        localize_image(scene_map, path, camera)


class AsManyAsFeatures(Localizer):
    """A localizer of somebody's own, which counts the features that it is given."""

    def __init__(self, mapped: Sequence[MappedFeatures], *_: object) -> None:
        self.image_names = mapped[0].map.image_names

    def solve(self, matches: QueryMatches, prediction: None = None, priors: Sequence[Prior] = ()) -> QueryResult:
        return QueryResult.failed("counts only", num_matches=len(matches.query.features[0][0]))


def test_a_method_of_ones_own_is_given_features_as_in_a_run(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(maps, "PnpLocalizer", AsManyAsFeatures)
    monkeypatch.setattr(maps, "lifts", lambda *_: False)  # it matches nothing, so nothing could be lifted
    run_stage(small_capture, run, query_device="ios")
    scene_map = Map.open(run.run, run.scene, "ios")
    session = Capture.open(small_capture)["ios_query"]
    row = int(session.rows_of_keyframes(session.keyframes(LIST))[0][0])
    camera = session.camera(session.images["sensor_id"].iloc[row])
    count = localize_image(scene_map, session.image_path(row), camera).num_matches
    assert count == rows_of(run, "ios")["num_matches"].iloc[0] > 0


class ByContent:
    """A predictor that knows a photograph by its pixels, wherever they come from, and looks up its true pose."""

    def __init__(self, capture: Capture, map_dir: Path) -> None:
        sessions = [capture[key] for key in capture.session_ids]
        self.simulated_predictor = SimulatedPredictor(sessions, map_dir)
        self.name, self.simulated = "by content", False
        self.settings: dict[str, object] = {}
        self.names = {
            read_image(session.image_path(row)).tobytes(): session.image_name(row)
            for session in sessions
            for row in session.camera_rows.tolist()
        }

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        def named(view: View) -> View:
            pixels = read_image(view.image) if isinstance(view.image, Path) else view.image
            return replace(view, name=self.names[pixels.tobytes()])

        return self.simulated_predictor.predict([[named(view) for view in group] for group in groups])


ESCALATES = {"features": {"kinds": ["sift"], "escalation": ["other"]}, "pnp": {"ok_probability": 1.0}}
"""No pose is sure, so each query is asked again with another kind of features."""


@pytest.mark.parametrize(
    ("method", "device"),
    [
        ({"method": "pnp"}, "ios"),
        ({"method": "pnp"}, "spot"),
        ({"method": "nearest"}, "ios"),
        ({"method": "nearest"}, "spot"),
        pytest.param({"method": "feed_forward"}, "spot", marks=pytest.mark.slow),
        pytest.param({"method": "hybrid"}, "ios", marks=pytest.mark.slow),
        pytest.param({"map": None}, "spot", marks=pytest.mark.slow),
        pytest.param(ESCALATES, "ios", marks=pytest.mark.slow),
        pytest.param({**ESCALATES, "method": "hybrid"}, "spot", marks=pytest.mark.slow),
        pytest.param({**ESCALATES, "map": None}, "ios", marks=pytest.mark.slow),
    ],
)
def test_pictures_and_inspections_get_the_pose_of_the_run_byte_for_byte(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch, method: dict[str, Any], device: str
) -> None:
    add_other_kind(monkeypatch)
    predictor = ByContent(Capture.open(small_capture), run.maps)
    monkeypatch.setattr(predictors, "NetworkPredictor", lambda *_, **__: predictor)
    settings = {"features": ["sift"], "seed": 3, "pnp": {"min_inliers": 11}, "predictor": {"num_references": 3}}
    settings |= method
    run_stage(small_capture, run, query_device=device, **settings)
    scene_map = Map.open(run.run, run.scene, "ios")
    assert scene_map.settings == LocalizeSettings.of(settings, {"unit": "m"}), "the run's own settings"
    session = Capture.open(small_capture)[f"{device}_query"]
    pair = InspectedPair("ios", device, run.poses_dir)
    keyframes = session.keyframes(LIST)
    quarter_turns = scene_map.turns.of(session) if scene_map.turns else np.zeros(len(session.images), int)
    lines = run.poses_txt("ios", device).read_text().splitlines()[1:]
    localized = PairResults.open(run.poses_txt("ios", device))
    queries = zip(lines, session.rows_of_keyframes(keyframes), keyframes.itertuples(index=False), strict=True)
    for number, (line, rows, key) in enumerate(queries):
        paths = [session.image_path(int(row)) for row in rows]
        cameras = [session.camera(sensor) for sensor in session.images["sensor_id"].iloc[rows]]
        rig = session.rig_from_cam(rows)
        estimate = (
            localize_image(scene_map, paths[0], cameras[0], turns=quarter_turns[rows])
            if device == "ios"
            else localize_image(scene_map, paths, cameras, rig, quarter_turns[rows])
        )
        text = ", ".join(repr(float(number)) for number in geometry.qt_from_pose(estimate.world_from_rig))
        assert text in line, f"{key.timestamp}"
        if number < 2:
            again = pair.look(number).result.what_if().after
            np.testing.assert_array_equal(again.result.world_from_rig, estimate.world_from_rig)
            assert (again.result.status, again.numbers["num_inliers"]) == (estimate.status, estimate.num_inliers)
        before = localized[number].correspondences
        np.testing.assert_array_equal(before.point_index, estimate.correspondences.point_index)
        np.testing.assert_array_equal(before.agrees, estimate.correspondences.agrees)


def test_the_unit_that_an_import_noted_is_that_of_every_door(capture: Path, run: SceneFiles) -> None:
    record = capture / "sessions" / "ios_map" / IMPORT_RECORD
    record.parent.mkdir(exist_ok=True)
    record.write_text('{"unit": null}')
    run_stage(capture, run, query_device="ios")  # as a notebook by hand: no word about the unit
    by_hand = run.poses_txt("ios", "ios").read_bytes()
    assert read_map_record(map_record_path(run.poses_dir, run.scene, "ios"))["unit"] is None
    assert Map.open(run.run, run.scene, "ios").settings.unit is None
    assert InspectedPair("ios", "ios", run.poses_dir).localized.results.unit[0] != "m"
    assert not [name for name in pd.read_csv(run.poses_csv("ios", "ios")) if name.endswith("_m")], "no meters"
    folders = run.poses_dir, run.retrieval_dir, run.evaluation
    evaluate_scene(capture / "sessions", *folders, map_device="ios", query_device="ios", queries=LIST)
    for path in run.evaluation.glob("*.csv"):
        assert not [name for name in pd.read_csv(path) if name.endswith("_m")], path.name
    errors = pd.read_csv(run.evaluation / "errors.csv")
    assert {"translation_error_L", "position_std_L"} <= {*errors}
    table = pd.read_csv(run.poses_csv("ios", "ios"))
    length = InspectedPair("ios", "ios", run.poses_dir).localized.results.unit[1]
    np.testing.assert_allclose(errors["position_std_L"] * length, table["position_std"])
    assert set(table["unit"]) == {"unknown"}
    table = run_stage(capture, run, query_device="ios", unit=None)  # as a run of the manifest of `new`
    assert table["skipped"].all(), "the same settings"
    run_stage(capture, run, query_device="ios", unit="m")
    assert read_map_record(map_record_path(run.poses_dir, run.scene, "ios"))["unit"] == "m", "who knows better, decides"
    assert by_hand != run.poses_txt("ios", "ios").read_bytes()


@pytest.mark.slow
def test_a_picture_is_reranked_as_the_run_was(small_capture: Path, run: SceneFiles) -> None:
    sessions = small_capture / "sessions"
    retrieve_pairs(sessions, run.embeddings, run.retrieval_dir, {"topk": 9}, map_device="ios", queries=LIST)
    settings = {"topn": 9, "topk": 3, "seed": 2}
    rerank_pairs(sessions, run.retrieval_dir, run.features, run.reranked_dir, settings, map_device="ios")
    folders = (run.reranked_dir, run.poses_dir, run.features, run.maps)
    localize_pairs(sessions, *folders, map_device="ios", query_device="ios", queries=LIST, workers=1)
    scene_map = Map.open(run.run, run.scene, "ios")
    assert scene_map.reranked
    session = Capture.open(small_capture)["ios_query"]
    lines = run.poses_txt("ios", "ios").read_text().splitlines()[1:]
    for line, rows in zip(lines, session.rows_of_keyframes(session.keyframes(LIST)), strict=True):
        camera = session.camera(session.images["sensor_id"].iloc[rows[0]])
        pose = localize_image(scene_map, session.image_path(int(rows[0])), camera).world_from_rig
        assert ", ".join(repr(float(number)) for number in geometry.qt_from_pose(pose)) in line


def test_a_picture_has_the_references_of_a_run_with_an_index(small_capture: Path, run: SceneFiles) -> None:
    sessions, asked = small_capture / "sessions", {"map_device": "ios", "query_device": "ios"}
    settings = {"index": "IVF2,Flat", "index_candidates": 4, "nprobe": 1, "topk": 4}
    retrieve_pairs(sessions, run.embeddings, run.retrieval_dir, settings, queries=LIST, **asked)
    run_stage(small_capture, run, query_device="ios")
    of_run = run.retrieval_dir / "settings.json"
    of_run.write_text(json.dumps(json.loads(of_run.read_text()) | {"faiss_gpu": True}))  # where the run was
    scene_map = Map.open(run.run, run.scene, "ios")
    vectors, table = load_embeddings(run.embeddings / "ios_query")
    found = dict(zip(table["abs_path"], scene_map.retrieve(described([vectors])), strict=True))
    names = scene_map.localizer.image_names
    rows = read_references(run.retrieval("ios", "ios"))
    assert len(rows) >= 3
    assert any(len(row["topk"]) < 4 for row in rows), "one cell of two does not hold enough"
    for row in rows:
        expected = [image_name(reference["path"]) for reference in row["topk"]]
        assert [names[index] for index in found[row["path"]].images] == expected


@pytest.mark.slow
def test_a_picture_has_the_references_of_a_run_with_several_descriptors(
    small_capture: Path, run: SceneFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(EMBEDDERS, "thumbnail", "tests.embedders.test_fusion:Thumbnail")
    sessions = small_capture / "sessions"
    alone = run.retrieval("ios", "ios").read_text()
    table = embed_sessions(sessions, run.embeddings, {"model": ["thumbnail", "vlad"]}, device="ios")
    assert (table["skipped"] == (table["model"] == "vlad")).all()
    retrieve_pairs(sessions, run.embeddings, run.retrieval_dir, map_device="ios", query_device="ios", queries=LIST)
    assert run.retrieval("ios", "ios").read_text() != alone
    run_stage(small_capture, run, query_device="ios")
    scene_map = Map.open(run.run, run.scene, "ios")
    session = Capture.open(small_capture)["ios_query"]
    folders = (run.embeddings / name / "ios_query" for name in ("thumbnail", "vlad"))
    stored, tables = zip(*map(load_embeddings, folders), strict=True)
    as_run = scene_map.search.embed_settings
    answers, localizer = [], scene_map.localizer
    scene_map.localizer = SimpleNamespace(  # type: ignore[misc, assignment]
        match=lambda query, references: answers.append(references) or localizer.match(query, references),
        solve=localizer.solve,
        image_names=localizer.image_names,
    )
    rows = {image_name(row["path"]): row["topk"] for row in read_references(run.retrieval("ios", "ios"))}
    for line, of_query in zip(
        run.poses_txt("ios", "ios").read_text().splitlines()[1:3],
        session.rows_of_keyframes(session.keyframes(LIST)),
        strict=False,
    ):
        camera = session.camera(session.images["sensor_id"].iloc[of_query[0]])
        scene_map.search.embed_settings = as_run
        pose = localize_image(scene_map, session.image_path(int(of_query[0])), camera).world_from_rig
        assert ", ".join(repr(float(number)) for number in geometry.qt_from_pose(pose)) in line
        expected = rows[session.image_name(int(of_query[0]))]
        names = [scene_map.localizer.image_names[index] for index in answers[-1][0].images]
        assert names == [image_name(reference["path"]) for reference in expected]
        stated = [reference["score"] for reference in expected]
        np.testing.assert_allclose(answers[-1][0].scores, stated, atol=1e-6)  # a batch of another size
        row = tables[0]["abs_path"].map(image_name).tolist().index(session.image_name(int(of_query[0])))
        # Stored vectors are normalized already, and normalizing once more can change their last bit.
        scene_map.search.embed_settings = as_run.model_copy(update={"normalize": False})
        (again,) = scene_map.retrieve(described([vectors[row : row + 1] for vectors in stored]))
        np.testing.assert_array_equal(again.scores, stated)


# ------------------------------------------------------------------------------------- other features, and several


class OtherFeatures(SiftExtractor):
    """A second kind of features, without weights: keypoints of a smaller image, float descriptors, in batches."""

    threaded, batch_size = False, 3

    def __init__(self, *_: object, **of_networks: object) -> None:
        super().__init__(SiftSettings(min_long_side=0, max_long_side=448))

    @property
    def settings(self) -> dict:
        return super().settings | {"name": "other"}

    def extract(self, images: Sequence[np.ndarray]) -> list[LocalFeatures]:
        return [
            replace(found, descriptors=unit_descriptors(found.descriptors).astype(np.float16))
            for found in super().extract(images)
        ]


class OtherMatcher(MutualMatcher):
    """Matches as a network does: asked by the stage, for all pairs, before any pose is sought."""

    asked = 0

    def __init__(self, *_: object, **of_networks: object) -> None:
        super().__init__(ratio=0.85)

    def match(self, pairs):  # type: ignore[no-untyped-def]
        OtherMatcher.asked += len(pairs)
        return super().match(pairs)


class Wrapped:
    """A matcher that is no `MutualMatcher`."""

    batch_size = 5
    settings = {"name": "network"}  # noqa: RUF012

    def __init__(self, *_: object, **of_networks: object) -> None:
        self.match = OtherMatcher().match


@pytest.fixture
def other_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """A manifest can name the features `other` and the matcher `network`."""
    kind = replace(KINDS["sift"], extractor=f"{__name__}:OtherFeatures", matchers=("network", "mutual"))
    monkeypatch.setitem(KINDS, "other", kind)
    monkeypatch.setitem(MATCHERS, "network", f"{__name__}:Wrapped")
    monkeypatch.setattr(OtherMatcher, "asked", 0)


@pytest.mark.slow
def test_several_features_are_pooled_in_one_pose(
    small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame], run: SceneFiles, other_kind: None
) -> None:
    run_stage(small_capture, run, query_device="ios", features=["sift", "other"])
    alone, both = rows_of(finished[0], "ios"), rows_of(run, "ios")
    assert {path.name for path in run.maps.glob("*.npz")} == {"ios_map.npz", "ios_map-other.npz"}
    assert (both["num_matches"] > 1.3 * alone["num_matches"]).all()
    assert both["num_inliers"].sum() > 1.2 * alone["num_inliers"].sum()
    assert (both["status"] == "ok").sum() >= (alone["status"] == "ok").sum()
    session = Capture.open(small_capture)["ios_query"]
    estimated = Trajectory.read(run.poses_txt("ios", "ios"))
    true = session.ground_truth.lookup(estimated.timestamps, estimated.device_ids)
    rotation_deg, distance_m = geometry.pose_error(estimated.world_from_device, true)
    assert np.median(rotation_deg) < 0.1
    assert np.median(distance_m) < 0.01


@pytest.mark.slow
def test_what_a_network_has_matched_is_kept(small_capture: Path, run: SceneFiles, other_kind: None) -> None:
    first = run_stage(small_capture, run, query_device="ios", features=["other"])
    assert first["ok"].sum() > 0
    asked = OtherMatcher.asked
    retrieved = [json.loads(line) for line in run.retrieval("ios", "ios").read_text().splitlines()]
    assert 0 < asked <= sum(len(row["topk"]) for row in retrieved)
    before = run.poses_txt("ios", "ios").read_bytes()
    run.poses_txt("ios", "ios").unlink()
    run_stage(small_capture, run, query_device="ios", features=["other"])
    assert OtherMatcher.asked == asked
    assert run.poses_txt("ios", "ios").read_bytes() == before
    mutual = run_stage(small_capture, run, query_device="ios", features=["other"], matcher="mutual")
    assert not mutual["skipped"].any()
    assert OtherMatcher.asked == asked


# ------------------------------------------------------------------------------- maps that are wrong, and unitless


def with_poses(capture: Path, change: Callable[[np.ndarray], np.ndarray], *files: str) -> None:
    """Change the poses in files of a capture's sessions, given as paths."""
    for file in files:
        path = capture / "sessions" / file
        before = Trajectory.read(path)
        poses = geometry.qt_from_pose(change(geometry.pose_from_qt(before.qt)))
        ids = before.arrow_ids
        path.unlink()
        Trajectory(before.timestamps, ids, poses).write(path)


@pytest.mark.slow
def test_no_pose_is_ok_in_a_map_that_contradicts_its_images(
    capture: Path, run: SceneFiles, caplog: pytest.LogCaptureFixture
) -> None:
    with_poses(capture, lambda poses: poses @ np.diag([1.0, -1, -1, 1]), "ios_map/trajectories.txt")
    table = run_stage(capture, run, query_device="ios")
    assert table["map_poses"].item() == "inconsistent"
    assert table["ok"].item() == 0
    said = read_map_record(map_record_path(run.poses_dir, run.scene, "ios"))
    assert "OpenGL" in said["text"]
    assert said["text"] in caplog.text
    scene_map = Map.open(run.run, run.scene, "ios")
    right = QueryResult(Status.OK, world_from_rig=np.eye(4))
    judged = scene_map.finished(Query([], np.eye(4)[None]), right)
    assert (judged.status, judged.reason[:9]) == (Status.LOW_CONFIDENCE, "the poses")
    assert "OpenGL" in judged.remark
    blamed = QueryResult(Status.LOW_CONFIDENCE, world_from_rig=np.eye(4), reason=NOISE, remark=f"it may be off; {CURE}")
    assert CURE not in scene_map.finished(Query([], np.eye(4)[None]), blamed).remark  # it would not cure this map
    session = Capture.open(capture)["ios_query"]
    picture = localize_image(scene_map, session.image_path(0), session.camera(session.images["sensor_id"].iloc[0]))
    assert picture.status != "ok"


@pytest.mark.slow
def test_a_map_does_not_hang_on_the_unit_of_length(
    capture: Path, run: SceneFiles, finished: tuple[SceneFiles, pd.DataFrame]
) -> None:
    poses, statuses = [], []
    files = "ios_map/trajectories.txt", "ios_query/proc/alignment_trajectories.txt"
    for factor in (1.0, 100.0):
        if factor != 1:
            with_poses(capture, lambda poses: _times(poses, factor), *files)  # noqa: B023 - called at once
        table = run_stage(capture, run, query_device="ios", unit=None)
        assert table["map_poses"].item() == "consistent"
        found = Trajectory.read(run.poses_txt("ios", "ios"))
        poses.append(_times(geometry.pose_from_qt(found.qt), 1 / factor))
        statuses.append(rows_of(run, "ios")["status"].tolist())
    assert statuses[0] == statuses[1]
    assert set(statuses[0]) == {"ok"}
    assert_allclose(poses[1], poses[0], atol=1e-4)
    assert_allclose(poses[0][:, :3, 3], Trajectory.read(finished[0].poses_txt("ios", "ios")).qt[:, 4:], atol=0.05)


def test_pairs_of_a_map_do_not_call_its_record_damaged(
    small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = SceneFiles(tmp_path / "run", finished[0].scene)
    copy_shared(finished[0].root, run.root)
    run_stage(small_capture, run, query_device="spot", unit=None)
    table = run_stage(small_capture, run)
    assert "damaged" not in caplog.text
    assert table["skipped"].tolist() == [False, True, False]
    assert read_map_record(map_record_path(run.poses_dir, run.scene, "ios"))["unit"] == "m"
    for device in DEVICES:
        assert run.poses_txt("ios", device).read_bytes() == finished[0].poses_txt("ios", device).read_bytes()


def test_errors_without_a_unit_are_relative_to_the_depth(capture: Path, run: SceneFiles) -> None:
    files = "ios_map/trajectories.txt", "ios_query/proc/alignment_trajectories.txt"
    with_poses(capture, lambda poses: _times(poses, 100.0), *files)
    run_stage(capture, run, query_device="ios", unit=None)
    found = evaluate_scene(
        capture / "sessions", run.poses_dir, run.retrieval_dir, None, query_device="ios", map_device="ios", queries=LIST
    )
    assert found.unit == "L"
    assert found.recall["recall@(1deg,0.1L)"].item() == 1.0
    assert found.recall["median_translation_L"].item() < 0.05


def _times(poses: np.ndarray, factor: float) -> np.ndarray:
    return geometry.make_pose(poses[:, :3, :3], factor * poses[:, :3, 3])


def test_a_picture_is_localized_near_a_rough_pose(
    small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame]
) -> None:
    files, _ = finished
    scene_map = Map.open(files.run, files.scene, "ios")
    session = Capture.open(small_capture)["ios_query"]
    path, camera = session.image_path(0), session.camera(session.images["sensor_id"][0])
    found = localize_image(scene_map, path, camera).world_from_rig
    assert found is not None
    estimate = localize_image(scene_map, path, camera, near=RoughPose(found, 1.0, 0.05))
    assert estimate.status == "ok"
    assert geometry.pose_error(np.asarray(estimate.world_from_rig), found)[1] < 0.01
    rows = [scene_map.session.row_of_name[name] for name in scene_map.localizer.image_names]
    mapped = scene_map.session.world_from_cam(np.array(rows))
    vectors, _ = load_embeddings(files.embeddings / "ios_map")
    for about in mapped:  # whatever the picture looks like
        (references,) = scene_map.retrieve(described([vectors[:1]]), near=RoughPose(about, 1.0, 0.05))
        angles = np.degrees(np.arccos(np.clip(mapped[:, :3, 2] @ about[:3, 2], -1, 1)))
        assert sorted(references.images) == np.flatnonzero(angles < 63.0).tolist()
    away = geometry.make_pose(found[:3, :3], [1e6, 0.0, 0.0])
    nowhere = localize_image(scene_map, path, camera, near=RoughPose(away, 1.0, 0.05))
    assert nowhere.status == "ok"  # no image of the map is there: all are searched


def test_further_features_know_the_images_of_every_kind(opened: Map) -> None:
    all_, first = opened.mapped[0], opened.mapped[0].map.image_names[0]
    none = all_.map.part(np.zeros(0, np.int64))
    rest: dict[str, Any] = {name: getattr(none, name)[1:] for name in ("image_names", "cameras", "world_from_cams")}
    further: Any = SimpleNamespace(name="aliked")
    scene_map = replace(opened, mapped=[MappedFeatures(replace(none, **rest), {}), all_], escalation=[further])
    assert scene_map.fallback is not None
    assert scene_map.fallback.image_names == scene_map.localizer.image_names == [*rest["image_names"], first]


@pytest.mark.parametrize(("length", "radius_deg"), [(1.0, 1.0), (0.1, 3.8183), (0.01, 6.0)])
def test_a_rough_pose_is_as_rough_as_the_map_is_small(
    opened: Map, monkeypatch: pytest.MonkeyPatch, length: float, radius_deg: float
) -> None:
    """1 cm at a depth of 3 m, 0.3 m and 3 cm; two standard deviations, from 1 to 6 degrees."""
    mapped = opened.mapped[0]
    scene_map = replace(opened, mapped=[MappedFeatures(replace(mapped.map, length=length), mapped.features)])
    priors: list[Prior] = []
    localizer = AsManyAsFeatures(scene_map.mapped)
    localizer.solve = lambda *asked: priors.extend(asked[2]) or QueryResult(Status.OK)  # type: ignore[method-assign]
    vars(scene_map)["localizer"] = localizer
    camera = pycolmap.Camera(model="PINHOLE", width=10, height=20, params=[10, 10, 5, 10])
    localize_image(scene_map, np.zeros((20, 10), np.uint8), camera, near=RoughPose(np.eye(4), 0.0, 0.01))
    assert [prior.radius_deg for prior in priors] == [pytest.approx(radius_deg, abs=1e-4)]


def test_a_picture_is_not_compared_with_vectors_of_another_vocabulary(
    capture: Path, finished: tuple[SceneFiles, pd.DataFrame], tmp_path: Path
) -> None:
    files = SceneFiles(tmp_path / "run", finished[0].scene)
    copy_shared(finished[0].root, files.root)
    scene_map, session = Map.open(files.run, files.scene, "ios"), Capture.open(capture)["ios_query"]
    path, camera = session.image_path(0), session.camera(session.images["sensor_id"][0])
    with np.load(files.embeddings / "vlad.npz") as stored:
        arrays = dict(stored)
    np.savez(files.embeddings / "vlad.npz", **arrays | {"centroids": 2 * arrays["centroids"]})
    sidecar_path(files.embeddings / "vlad.npz").unlink()
    with pytest.raises(ArtifactError, match=r"embeddings/ios_map/.*\.npy was made by another .*vocabulary"):
        localize_image(scene_map, path, camera)


def test_a_query_that_failed_is_localized_again_where_odometry_leads(
    capture: Path, finished: tuple[SceneFiles, pd.DataFrame], tmp_path: Path
) -> None:
    pytest.importorskip("gtsam")
    files = SceneFiles(tmp_path / "run", finished[0].scene)
    copy_shared(finished[0].root, files.root)
    session = Session(capture / "sessions/ios_query")
    truth = session.ground_truth
    assert truth is not None
    Trajectory.from_poses(truth.timestamps, truth.device_ids, truth.world_from_device).write(
        session.path / "trajectories.txt"
    )
    table, poses = rows_of(files, "ios"), Trajectory.read(files.poses_txt("ios", "ios"))
    key = table["timestamp"][1], table["device_id"][1]
    table.loc[1, "status"] = "failed: too few matches"
    table.to_csv(files.poses_csv("ios", "ios"), index=False)
    kept = poses.timestamps != key[0]
    assert poses.covariances is not None
    Trajectory(poses.timestamps[kept], poses.device_ids[kept], poses.qt[kept], poses.covariances[kept]).write(
        files.poses_txt("ios", "ios")
    )
    sidecar_path(files.poses_txt("ios", "ios")).unlink()
    only = {"map_device": "ios", "query_device": "ios"}
    without = sequence_pairs(capture / "sessions", files.poses_dir, {"relocalize": False}, **only).iloc[0]
    assert (without["again"], without["used"]) == (0, kept.sum())
    done = sequence_pairs(capture / "sessions", files.poses_dir, **only).iloc[0]
    assert (done["again"], done["used"], done["ok"]) == (1, kept.sum() + 1, len(truth))
    rows = pd.read_csv(str(done["path"]).replace(".txt", ".csv"), keep_default_na=False)
    row = rows[rows["timestamp"] == key[0]].iloc[0]
    assert (row["single_status"], row["again_status"]) == ("failed: too few matches", "ok")
    steps = pd.read_csv(str(done["path"]).replace(".txt", "_steps.csv"))
    again = steps[(steps["step"] == "again") & (steps["timestamp"] == key[0])].iloc[0]
    found = geometry.pose_from_qt(again[list(POSE_NAMES)].to_numpy(float))
    assert geometry.pose_error(found, truth.lookup([key[0]], [key[1]])[0])[1] < 0.02


def test_threads_that_localize_again_have_nothing_to_load(
    small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    files, session = finished[0], Capture.open(small_capture)["ios_query"]
    opened: list[Map] = []
    open_map = Map.open
    monkeypatch.setattr(Map, "open", lambda *run: opened.append(open_map(*run)) or opened[-1])
    loaders = [(maps, name) for name in ("PnpLocalizer", "upright_turns", "load_index")]
    loaders += [(search, name) for name in ("create_embedder", "open_descriptors")]

    def in_threads(localize: Callable[[int], QueryResult], numbers: range, _: int) -> list[QueryResult]:
        for module, name in loaders:
            monkeypatch.setattr(module, name, Mock(side_effect=AssertionError(name)))
        assert all("_method" in vars(kind) for kind in opened[0].escalation)
        return [localize(number) for number in numbers]

    monkeypatch.setattr(sequence, "prefetch", in_threads)
    keys, poses = session.keyframes(LIST), session.world_from_cam(ground_truth=True)
    again = sequence._Relocalizer(files.poses_txt("ios", "ios"), session, keys)
    (estimate,) = again([(0, RoughPose(poses[session.rows_of_keyframes(keys)[0][0]], 1.0, 0.1))])
    assert estimate.status == "ok"


@pytest.mark.parametrize("network", ["embedder", "reranker", "none"])
def test_a_query_is_localized_again_as_upright_as_the_networks_of_the_run_saw_it(
    small_capture: Path, finished: tuple[SceneFiles, pd.DataFrame], monkeypatch: pytest.MonkeyPatch, network: str
) -> None:
    files, session = finished[0], Capture.open(small_capture)["hl_query"]
    scene_map = replace(Map.open(files.run, files.scene, "ios"), escalation=[])
    if network == "embedder":
        scene_map.search.embedders = [Learned(np.zeros(1, np.float32))]
    if network == "reranker":
        scene_map.search.verification = LocalMethod("superpoint", Mock(), Mock()), Mock()
    monkeypatch.setattr(Map, "open", lambda *_: scene_map)
    shown: list[Any] = []
    monkeypatch.setattr(
        Map,
        "locate",
        lambda _, query, near: shown.append([view.turns for view in query.views]) or QueryResult.failed("only shown"),
    )
    keys = session.keyframes(LIST)
    again = sequence._Relocalizer(files.poses_txt("ios", "hl"), session, keys)
    again([(0, RoughPose(np.eye(4), 1.0, 0.1))])
    [rows, *_] = session.rows_of_keyframes(keys)
    turned = [3 if sensor.endswith("/hetrf") else 0 for sensor in session.images["sensor_id"].iloc[rows]]
    assert any(turned)
    assert shown == [[0] * len(turned) if network == "none" else turned]


def test_poses_of_no_run_cannot_be_localized_again(
    capture: Path, finished: tuple[SceneFiles, pd.DataFrame], tmp_path: Path
) -> None:
    pytest.importorskip("gtsam")
    session = Session(capture / "sessions/ios_query")
    truth = session.ground_truth
    assert truth is not None
    Trajectory.from_poses(truth.timestamps, truth.device_ids, truth.world_from_device).write(
        session.path / "trajectories.txt"
    )
    shutil.copytree(finished[0].poses_dir, tmp_path / "elsewhere")
    table = pd.read_csv(tmp_path / "elsewhere" / finished[0].poses_csv("ios", "ios").name)
    table.assign(status="low_confidence").to_csv(tmp_path / "elsewhere" / finished[0].poses_csv("ios", "ios").name)
    sidecar_path(tmp_path / "elsewhere" / finished[0].poses_txt("ios", "ios").name).unlink()
    only = {"map_device": "ios", "query_device": "ios"}
    row = sequence_pairs(capture / "sessions", tmp_path / "elsewhere", **only).iloc[0]
    assert "relocalize: false" in row["reason"]
    assert str(tmp_path / "elsewhere") in row["reason"]
