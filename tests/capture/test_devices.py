"""Kinds of devices are data: a fourth one, and the names that LaMAR gives its sessions."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toolkit import pipeline
from toolkit.capture import Capture, Trajectory, write_session
from toolkit.capture import names as devices
from toolkit.capture.check import check_capture
from toolkit.embed import embed_sessions
from toolkit.errors import CaptureError, ManifestError
from toolkit.evaluate import evaluate_scene
from toolkit.files import SceneFiles
from toolkit.localize import localize_pairs
from toolkit.manifest import load_manifest
from toolkit.retrieve import retrieve_pairs

SENSORS = [("s/phone", "", "camera", "PINHOLE", 4, 4, 4, 4, 2, 2), ("s/bt", "", "bluetooth"), ("s/wifi", "", "wifi")]


def write(root: Path, name: str, images: bool = True) -> Path:
    """Write a session of one camera without a rig, and radio sensors."""
    path = root / "sessions" / name
    write_session(
        path,
        SENSORS,
        None,
        Trajectory.from_poses([1], ["s/phone"], np.eye(4)[None]) if "map" in name else None,
        [(1, "s/phone", "s/1.jpg")] if images else [],
        keyframes={"pruned_subsampled": pd.DataFrame({"timestamp": [1], "device_id": ["s/phone"]})},
    )
    return path


def test_a_folder_name_says_kind_and_split() -> None:
    assert devices.session_of("ios_map") == ("ios", "map")
    assert devices.session_of("my_drone_query") == ("my_drone", "query")
    assert [devices.session_id(name) for name in ("map", "query_phone", "query_hololens")] == [
        "mixed_map",
        "ios_query",
        "hl_query",
    ]
    assert devices.session_of("hl_2023-10-18")[1] not in devices.SPLITS
    assert devices.session_id("hl_2023-10-18") == "hl_2023-10-18"


def test_rows_can_be_added_and_replaced_for_a_while() -> None:
    assert [kind.key for kind in devices.kinds()] == ["ios", "hl", "spot"]
    rows = [{"key": "drone", "label": "Drone"}, {"key": "ios", "sessions": {"query": "query_val_phone"}}]
    with devices.extra_devices(rows):
        assert [kind.key for kind in devices.kinds()] == ["ios", "hl", "spot", "drone"]
        assert devices.session_id("query_val_phone") == "ios_query"
        assert devices.in_order(["zebra", "drone", "spot", "ant", "ios"]) == ["ios", "spot", "drone", "ant", "zebra"]
        with devices.extra_devices([]):
            assert len(devices.kinds()) == 3
        assert devices.kinds()[0].label == "phone"  # what the row does not say stays
        assert devices.kinds()[3].label == "Drone"
    with devices.extra_devices([{"key": "ios", "label": "iPhone"}]):
        assert devices.kinds()[0].label == "iPhone"
        assert devices.session_id("query_phone") == "ios_query"
    assert len(devices.kinds()) == 3
    assert devices.color_of("drone").startswith("#")
    assert len({devices.color_of(kind.key) for kind in devices.TABLE}) == 3


def test_sessions_of_lamar_are_found(tmp_path: Path) -> None:
    root = tmp_path / "CAB"
    for name in ("map", "query_phone", "query_hololens", "query_val_phone"):
        write(root, name)
    capture = Capture.open(root)
    assert capture.devices == ["ios", "hl", "mixed"]
    assert (capture.devices_with("map"), capture.devices_with("query")) == (["mixed"], ["ios", "hl"])
    write(tmp_path / "MAPS", "map")
    for place, asked, named in (
        ("CAB", ("map", "ios"), "'ios' .* with one: mixed "),
        ("MAPS", ("query",), "MAPS: no query session. Expected .*_query, .* --split query"),
    ):
        with pytest.raises(CaptureError, match=named):
            Capture.open(tmp_path / place).devices_with(*asked)
    session = capture["ios_query"]
    assert (session.id, session.device, session.split) == ("ios_query", "ios", "query")
    # Files are where they are, whatever the session is called in outputs.
    assert session.image_name(0) == "query_phone/raw_data/s/1.jpg"
    assert session.image_path(0) == root / "sessions" / session.image_name(0)
    with devices.extra_devices([{"key": "ios", "sessions": {"query": "query_val_phone"}}]):
        assert Capture.open(root)["ios_query"].path.name == "query_val_phone"
    # The format's own name comes first.
    write(root, "ios_query")
    assert Capture.open(root)["ios_query"].path.name == "ios_query"


def test_the_query_list_of_lamar_is_a_keyframe_list(tmp_path: Path) -> None:
    path = write(tmp_path / "CAB", "query_phone")
    (path / "queries.txt").write_text("1, s/phone\n")
    session = Capture.open(tmp_path / "CAB")["ios_query"]
    assert list(session.keyframe_files) == ["pruned_subsampled", "queries"]
    assert session.keyframes("queries").to_numpy().tolist() == [[1, "s/phone"]]
    (path / "queries.txt").write_text("1, s/phone\n2, s/tablet\n")
    lines = [str(problem) for problem in check_capture(tmp_path / "CAB").problems]
    assert any(line.startswith("ios_query/queries.txt:2: error: unknown device 's/tablet'") for line in lines)


def test_check_says_what_is_not_used_and_what_has_no_row(tmp_path: Path) -> None:
    path = write(tmp_path / "CAB", "ios_map")
    (path / "pointclouds.txt").write_text("1, s/lidar, cloud.ply\n")
    write(tmp_path / "CAB", "drone_map")
    report = check_capture(tmp_path / "CAB")
    assert "pointclouds.txt is not used" in report.text()
    messages = [str(problem) for problem in report.problems if not problem.file]
    assert messages == [
        "drone_map/: warning: device 'drone' is none of ios, hl, spot; it is used. Rename it if not intended"
    ]
    with devices.extra_devices([{"key": "drone"}]):
        assert not [problem for problem in check_capture(tmp_path / "CAB").problems if not problem.file]


def test_a_manifest_adds_a_kind(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text("captures: [a]\ndevices: [ios, drone]\nextra_devices: [{key: drone, label: Drone}]\n")
    assert load_manifest(path).devices == ["ios", "drone"]
    for line, named in (
        ("devices: [ios, drone]", r"devices: found 'drone'\. .*Known: hl, ios, spot\. `extra_devices` adds"),
        ("extra_devices: [{key: drone, lable: Drone}]", r"extra_devices\.0\.lable'\. Did you mean 'label'"),
    ):
        path.write_text(f"captures: [a]\n{line}\n")
        with pytest.raises(ManifestError, match=named):
            load_manifest(path)


def test_a_run_hands_its_kinds_to_its_notebooks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def started(*_: object) -> Path:
        command = "from toolkit.capture.names import kinds; print(*[kind.key for kind in kinds()])"
        seen.append(subprocess.run([sys.executable, "-c", command], capture_output=True, text=True).stdout.split())
        return tmp_path

    monkeypatch.setattr(pipeline, "_run", started)
    (tmp_path / "m.yaml").write_text("captures: [a]\nextra_devices: [{key: drone}]\n")
    pipeline.run(tmp_path / "m.yaml")
    assert seen == [["ios", "hl", "spot", "drone"]]


@pytest.mark.slow
def test_a_fourth_kind_goes_from_images_to_recall(small_capture: Path, tmp_path: Path) -> None:
    """And a session that is called as LaMAR calls it is localized in its map."""
    root = tmp_path / "PLACE"
    for source, name in (("ios_map", "drone_map"), ("ios_query", "drone_query"), ("ios_query", "query_phone")):
        shutil.copytree(small_capture / "sessions" / source, root / "sessions" / name)
    sessions, files = root / "sessions", SceneFiles(tmp_path / "run", "PLACE")
    embed_sessions(sessions, files.embeddings, features_dir=files.features)
    assert (files.embeddings / "drone_map").is_dir()
    assert (files.embeddings / "ios_query").is_dir()
    retrieve_pairs(sessions, files.embeddings, out_jsonl=files.retrieval_dir)
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    table = localize_pairs(sessions, *folders, workers=1)
    assert table[["map_device", "query_device"]].to_numpy().tolist() == [["drone", "ios"], ["drone", "drone"]]
    names = ["PLACE_map_drone_query_drone.txt", "PLACE_map_drone_query_ios.txt"]
    assert sorted(path.name for path in files.poses_dir.glob("*.txt")) == names
    found = evaluate_scene(sessions, files.poses_dir, files.retrieval_dir, files.evaluation)
    assert found.recall["query_device"].tolist() == ["ios", "drone"]
    assert (found.recall["recall@(1deg,0.1m)"] == 1).all()
    line = json.loads(files.retrieval("drone", "ios").read_text().splitlines()[0])
    assert line["path"].startswith("PLACE/sessions/query_phone/raw_data/")
