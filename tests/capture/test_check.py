import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from toolkit.capture import Trajectory, write_session
from toolkit.capture.check import check_capture
from toolkit.capture.session import IMPORT_RECORD

CAPTURES = Path(__file__).parents[2].parent / "shared" / "data" / "captures"
PINHOLE = ("camera", "PINHOLE", 64, 48, 50.5, 51.5, 32.0, 24.0)
QT = "1, 0, 0, 0, 0, 0, 0"


@pytest.mark.parametrize(
    ("times", "asked"),
    [
        ([0, 1_400_000_000, 2_800_000_000, 4_200_000_000], "1,400,000,000 us (1,400 s): are these nanoseconds?"),
        ([0, 33, 66, 100], "33 us: are these milliseconds?"),
        ([10, 11, 12, 13], "1 us: are these seconds?"),
        ([1_700_000_000_000_000_000 + k * 33_000_000 for k in range(4)], "are these nanoseconds?"),
        ([0, 33_000, 66_000, 100_000], ""),
        ([1_700_000_000_000_000 + k * 60_000_000 for k in range(4)], ""),
        ([0, 2_000], ""),
    ],
)
def test_times_of_another_unit_are_asked_about(times: list[int], asked: str, tmp_path: Path) -> None:
    session = tmp_path / "PLACE" / "sessions" / "ios_query"
    images = [(time, "cam", f"{time}.jpg") for time in times]
    listed = pd.DataFrame({"timestamp": times, "device_id": "cam"})
    write_session(session, [("cam", "", *PINHOLE)], None, None, images, keyframes={"pruned_subsampled": listed})
    problems = check_capture(tmp_path / "PLACE").problems
    questions = [problem.message for problem in problems if "are these" in problem.message]
    assert len(questions) == bool(asked)
    assert all(message.endswith(asked) for message in questions)


def test_photographs_that_were_moved_are_one_problem(capture: Path) -> None:
    photos = capture / "sessions" / "hl_map" / "raw_data" / "s"
    moved = capture.parent / "moved"
    photos.rename(moved)
    for path in moved.rglob("*.jpg"):
        link = photos / path.relative_to(moved)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(capture / "gone" / path.name)
    (problem,) = check_capture(capture).errors
    assert "4 of 4 files are links to files that are gone" in problem.message
    assert f"{capture / 'gone'}" in problem.message


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A capture without problems: a map of two rig frames and one query."""
    root = tmp_path / "PLACE" / "sessions"
    identity = [1.0, 0, 0, 0, 0, 0, 0]
    images = [(t, f"s/{c}", f"s/{c}/{t}.jpg") for t in (10, 20) for c in "ab"]
    sensors = [("s/a", "", *PINHOLE), ("s/b", "", *PINHOLE), ("imu", "", "imu")]
    rigs = [(f"s/rig_{t}", f"s/{c}", identity) for t in (10, 20) for c in "ab"]
    farther = [0.8, 0.6, 0, 0, 1, 0, 0]
    poses = Trajectory([10, 20], ["s/rig_10", "s/rig_20"], [identity, farther], [np.eye(6)] * 2)
    listed = pd.DataFrame({"timestamp": [10, 20], "device_id": ["s/rig_10", "s/rig_20"]})
    keyframes = {"pruned": listed, "pruned_subsampled": listed}
    write_session(root / "hl_map", sensors, rigs, poses, images, subsessions=["s"])
    write_session(root / "hl_query", sensors, rigs, None, images, None, ["s"], keyframes, ground_truth=poses)
    for session in ("hl_map", "hl_query"):
        for _, _, path in images:
            file = root / session / "raw_data" / path
            file.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (64, 48)).save(file)
    return tmp_path / "PLACE"


def found(capture: Path) -> list[str]:
    return [str(problem) for problem in check_capture(capture).problems]


def append(capture: Path, file: str, text: str) -> None:
    with open(capture / "sessions" / file, "a") as stream:
        stream.write(text)


def test_odometry_of_queries_is_told_from_ground_truth(capture: Path) -> None:
    query = capture / "sessions" / "hl_query"
    (query / "trajectories.txt").write_text(f"10, s/rig_10, {QT}\n")

    table = check_capture(capture).tables["hl_query"].set_index("what")
    assert table["count"][["poses", "ground truth"]].tolist() == ["1", "2"]
    assert "odometry" in table["details"]["poses"]
    (query / "proc" / "alignment_trajectories.txt").unlink()
    table = check_capture(capture).tables["hl_query"].set_index("what")
    assert table["count"][["poses", "ground truth"]].tolist() == ["1", "-"]
    assert "alignment_trajectories.txt" in table["details"]["ground truth"]


def test_a_good_capture_has_no_problems(capture: Path) -> None:
    report = check_capture(capture)
    assert report.ok
    assert report.problems == []
    text = report.text()
    assert "0 errors, 0 warnings." in text
    for expected in ("hl_map", "2 camera, 1 imu", "2 PINHOLE 64 48", "2 sensors each", "4 of 4 images have one"):
        assert expected in text
    table = report.tables["hl_query"].set_index("what")
    assert table.loc["images", "count"] == "4"
    assert table.loc["poses", "count"] == "-"
    assert table.loc["keyframes pruned", "count"] == "2"
    assert table.loc["subsessions", "details"] == "s (4 images)"


def test_scans_and_fixes_are_counted_and_a_sensor_that_is_not_known_is_told_once(capture: Path) -> None:
    append(capture, "hl_map/sensors.txt", "s/wifi, , wifi\n")
    append(capture, "hl_map/wifi.txt", "1, s/wifi, aa:bb, 2412000, -50\n" * 2 + "2, s/wifi, aa:cc, 2412000, -50\n")
    append(capture, "hl_map/bt.txt", "1, s/bt, a:1:2, -50\n1, s/bt, a:1:3, -50\n2, s/bt, a:1:3\n")
    append(capture, "hl_map/gps.txt", "1, s/gps, 47, 8, 400, 5\n2, s/gps, 47, 8, 400, -1\n")
    report = check_capture(capture)
    table = report.tables["hl_map"].set_index("what")
    assert table.loc["WiFi"].tolist() == ["3", "2 scans, 2 emitters"]
    assert table.loc["Bluetooth"].tolist() == ["2", "1 scans, 2 emitters"]
    assert table.loc["GPS"].tolist() == ["2", "1 with an accuracy"]
    assert [str(problem).split(",")[0] for problem in report.problems] == [
        "hl_map/bt.txt:1: warning: unknown sensor 's/bt': not in sensors.txt",
        "hl_map/bt.txt:3: error: found 3 values in '2",
        "hl_map/gps.txt:1: warning: unknown sensor 's/gps': not in sensors.txt",
    ]


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("hl_map/images.txt", "1, s/a", ":6: error: found 2 values in '1, s/a', expected 3"),
        ("hl_map/images.txt", "30, s/x, s/a/10.jpg", ":6: error: unknown sensor 's/x': not in sensors.txt"),
        ("hl_map/images.txt", "20, s/a, s/a/30.jpg", ":6: error: duplicate key (timestamp 20, sensor_id 's/a'), with"),
        ("hl_map/images.txt", "20, s/a, s/a/20.jpg", ":6: warning: duplicate key (timestamp 20, sensor_id 's/a')"),
        ("hl_map/images.txt", "30, s/a, s/a/30.jpg", ":6: error: missing file raw_data/s/a/30.jpg"),
        ("hl_map/images.txt", "30, s/a, s/a/10.jpg", ":6: warning: image without pose (timestamp 30, sensor 's/a')"),
        (
            "hl_map/images.txt",
            "10, imu, t/10.jpg",
            ":6: warning: image t/10.jpg is in no subsession of proc/subsessions.txt",
        ),
        ("hl_map/images.txt", "30, imu, s/a/10.jpg", ":6: error: sensor 'imu' of an image is not a camera"),
        ("hl_map/depths.txt", "10, s/a, s/a/10.png", ":1: error: missing file raw_data/s/a/10.png"),
        ("hl_map/depths.txt", "10, render/s/x, s/a/10.jpg", ":1: error: unknown sensor 'render/s/x'"),
        ("hl_map/rigs.txt", f"r, s/x, {QT}", ":6: error: unknown sensor 's/x': not in sensors.txt"),
        ("hl_map/rigs.txt", f"s/rig_10, s/a, {QT}", ":6: warning: duplicate key (rig_id 's/rig_10', sensor_id 's/a')"),
        ("hl_map/rigs.txt", f"imu, s/a, {QT}", ":6: error: rig 'imu' has the name of a sensor"),
        ("hl_map/rigs.txt", "r, s/a, 0, 0, 0, 0, 1, 1, 1", ":6: error: found a zero quaternion"),
        ("hl_map/sensors.txt", "s/a, , wifi", ":5: error: duplicate key (sensor_id 's/a')"),
        ("hl_map/sensors.txt", "c, , camera, PINHOLE, 1, 1, 1", ":5: error: found 1 parameters for model PINHOLE"),
        ("hl_map/sensors.txt", "c, , depth, PIN, 1, 1, 1", ":5: error: found camera model 'PIN', expected one of"),
        ("hl_map/trajectories.txt", f"10, x, {QT}", ":4: error: unknown device 'x'"),
        ("hl_map/trajectories.txt", f"10, s/rig_10, {QT}", ":4: warning: duplicate key (timestamp 10, device_id"),
        (
            "hl_map/trajectories.txt",
            f"30, s/rig_10, {QT}",
            ":4: warning: pose without image (timestamp 30, device 's/rig_10')",
        ),
        ("hl_map/trajectories.txt", "10, s/a, 0, 0, 0, 0, 1, 1, 1", ":4: error: found a zero quaternion"),
        ("hl_map/trajectories.txt", "10, s/a, 1, 0, 0, 0, 1, nan, 1", ":4: error: found ty = 'nan'"),
        (
            "hl_map/trajectories.txt",
            "10, s/a, 2, 0, 0, 0, 1, 1, 1",
            ":4: warning: quaternion 2.0 0.0 0.0 0.0 is not of length 1",
        ),
        ("hl_map/trajectories.txt", f"10, s/a, {QT}, 1, 2", ":4: warning: 2 values after the pose, expected none"),
        (
            "hl_map/trajectories.txt",
            f"10, s/a, {QT}" + ", 1" * 35 + ", nan",
            ":4: error: the covariance has values that are not finite",
        ),
        ("hl_query/proc/keyframes_pruned.txt", "10, x", ":3: error: unknown device 'x'"),
        ("hl_query/proc/keyframes_pruned.txt", "10, s/rig_10", ":3: warning: duplicate key (timestamp 10, device_id"),
        ("hl_query/proc/keyframes_pruned.txt", "30, s/rig_10", ":3: error: keyframe without image (timestamp 30"),
        ("hl_query/proc/keyframes_pruned.txt", "ten, s/rig_10", ":3: error: found timestamp = 'ten'"),
        ("hl_query/proc/keyframes_new.txt", "10, s/a", ":1: warning: keyframe without ground truth (timestamp 10"),
        ("hl_map/images.txt", "30, s/a, s/a/10.jpg", ":6: error: raw_data/s/a/10.jpg is listed again, under"),
        ("hl_map/images.txt", "30, s/a, ../x.jpg", ":6: error: found image_path = '../x.jpg'"),
        ("hl_map/images.txt", "0x1e, s/a, s/a/30.jpg", ":6: error: found timestamp = '0x1e'"),
        ("hl_map/images.txt", "30, s/a, s/a\r40, s/a, s/b", ":6: error: found a carriage return within the line"),
        ("hl_map/sensors.txt", "c, , camera, PINHOLE, 9, 9, -5, 5, 4, 4", ":5: error: found a focal length that is"),
        ("hl_map/sensors.txt", "c, , camera, PINHOLE, 9, 9, 5, 5, 40, 4", ":5: error: found a principal point at 40"),
        ("hl_map/trajectories.txt", "10, s/a, 1, 0, 0, 0, 1e308, 0, 0", ":4: error: found tx = '1e308'"),
        ("hl_map/proc/subsessions.txt", "t", ":2: warning: subsession 't' has no images"),
        ("hl_map/proc/subsessions.txt", "s", ":2: warning: duplicate key (subsession 's')"),
    ],
)
def test_each_inconsistency_is_found_at_its_line(capture: Path, file: str, text: str, expected: str) -> None:
    append(capture, file, text + "\n")
    report = check_capture(capture)
    assert any(str(problem).startswith(file + expected) for problem in report.problems), found(capture)
    assert expected in report.text()


def test_all_problems_are_listed_not_the_first_alone(capture: Path) -> None:
    append(capture, "hl_map/images.txt", "bad\nworse\n30, s/x, none.jpg\n")
    append(capture, "hl_query/images.txt", "bad\n")
    (capture / "sessions" / "hl_map" / "raw_data" / "s" / "a" / "10.jpg").unlink()
    (capture / "sessions" / "hl_query" / "sensors.txt").unlink()
    lines = found(capture)
    assert [line.split(": ")[0] for line in lines if "/images.txt" in line and "found 1 value " in line] == [
        "hl_map/images.txt:6",
        "hl_map/images.txt:7",
        "hl_query/images.txt:6",
    ]
    assert "hl_map/images.txt:2: error: missing file raw_data/s/a/10.jpg" in lines
    assert "hl_map/images.txt:8: error: missing file raw_data/none.jpg" in lines
    assert any(line.startswith("hl_query/sensors.txt: error: file not found") for line in lines)
    assert sum("hl_query" in line and "unknown sensor" in line for line in lines) == 8, "4 images, 4 rig rows"


def test_a_long_list_of_problems_can_be_cut(capture: Path) -> None:
    append(capture, "hl_map/images.txt", "".join(f"30, s/a, s/a/none{i}.jpg\n" for i in range(9)))
    report = check_capture(capture)
    count = len(report.problems)
    assert count > 5
    lines = report.text(most=2).splitlines()
    assert str(report.problems[1]) in lines
    assert str(report.problems[2]) not in lines
    assert f"... and {count - 2} more: visloc check {capture}" in lines
    assert "more:" not in report.text()
    assert "more:" not in report.text(most=count)


def test_images_are_looked_at(capture: Path) -> None:
    raw = capture / "sessions" / "hl_map" / "raw_data" / "s"
    Image.new("RGB", (48, 64)).save(raw / "a" / "10.jpg")
    (raw / "b" / "10.jpg").unlink()
    os.mkfifo(raw / "b" / "10.jpg")
    (raw / "a" / "20.jpg").write_bytes(b"")
    whole = (raw / "b" / "20.jpg").read_bytes()
    (raw / "b" / "20.jpg").write_bytes(whole[:-30])
    expected = {
        2: "s/a/10.jpg has 48 x 64 pixels, its sensor 's/a' 64 x 48",
        3: "is a folder, a pipe or a device, expected a file",
        4: "Image cannot be decoded (",
    }
    for deep in (False, True):  # only decoding shows that an image is cut short
        lines = expected | ({5: "Image cannot be decoded ("} if deep else {})
        errors = check_capture(capture, deep).errors
        assert {(problem.file, problem.line) for problem in errors} == {("images.txt", line) for line in lines}
        for problem in errors:
            assert lines[problem.line] in problem.message


def walk(capture: Path, step: list[float], turn: float = 0.01, frames: int = 12, still: int = 0) -> None:
    """Let the map be of one camera that moves by `step` meters and turns by `turn` a frame; `still` on a tripod."""
    angles = turn * np.arange(frames)
    qt = np.zeros((frames, 7))
    qt[:, 0], qt[:, 2], qt[:, 4:] = np.cos(angles), np.sin(angles), np.outer(np.arange(frames), step)
    qt[:still, 4:] = 0.01 * np.arange(still)[:, None] / max(still, 1)  # about a tripod
    session = capture / "sessions" / "hl_map"
    rows = [(time, "s/a", f"s/a/{time}.jpg") for time in range(0, 50_000 * frames, 50_000)]
    for _, _, path in rows:
        Image.new("RGB", (64, 48)).save(session / "raw_data" / path)
    shutil.rmtree(session / "proc", ignore_errors=True)
    (session / "rigs.txt").unlink(missing_ok=True)
    poses = Trajectory(50_000 * np.arange(frames), ["s/a"] * frames, qt)
    write_session(session, [("s/a", "", *PINHOLE)], None, poses, rows, subsessions=["s"])


def test_poses_that_cannot_be_right_are_found(capture: Path) -> None:
    walk(capture, [0, 0, 0.5])
    assert found(capture) == []
    assert "up in the world" in check_capture(capture).text()
    walk(capture, [0, 0, 0])
    assert any("trajectories.txt: error: all 12 images stand in one place" in line for line in found(capture))
    walk(capture, [0, 0, -0.5])
    assert any("trajectories.txt: warning: cameras move backwards" in line for line in found(capture))
    walk(capture, [0, 0, 0.5], still=7)
    tripod = "trajectories.txt: warning: 7 of 12 images were taken from one place: nothing has parallax"
    assert any(tripod in line for line in found(capture))
    walk(capture, [0, 0, 0.5], turn=0)
    assert any("trajectories.txt: warning: all 12 images have the same rotation" in line for line in found(capture))


def test_a_session_without_images_is_noted(capture: Path) -> None:
    (capture / "sessions" / "hl_map" / "images.txt").write_text("# timestamp, sensor_id, image_path\n")
    assert "hl_map/images.txt: warning: lists no image" in found(capture)


def test_queries_without_a_list_are_noted(capture: Path) -> None:
    (capture / "sessions" / "hl_query" / "proc" / "keyframes_pruned_subsampled.txt").unlink()
    (line,) = found(capture)
    assert line.startswith("hl_query/proc/keyframes_pruned_subsampled.txt: warning: no such list")
    assert "found: pruned." in line


def test_a_session_that_cannot_be_read_does_not_hide_the_others(capture: Path, tmp_path: Path) -> None:
    append(capture, "hl_query/images.txt", "bad\n")
    (capture / "sessions" / "hl_map" / "sensors.txt").rename(tmp_path / "sensors.txt")
    (capture / "sessions" / "hl_map" / "sensors.txt").symlink_to(tmp_path / "sensors.txt")
    lines = found(capture)
    assert any(line.startswith("hl_map/: error: ") and "is a link to" in line for line in lines)
    assert any(line.startswith("hl_query/images.txt:6: error: found 1 value") for line in lines)


def test_depth_that_was_rendered_for_a_photograph_is_known(capture: Path) -> None:
    append(capture, "hl_map/depths.txt", "10, render/s/a, s/a/10.jpg\n")
    assert found(capture) == []


def test_warnings_alone_leave_it_ok(capture: Path) -> None:
    append(capture, "hl_map/trajectories.txt", f"30, s/rig_10, {QT}\n")
    report = check_capture(capture)
    assert report.ok
    assert "0 errors, 1 warning." in report.text()


def test_a_map_without_trajectories_is_an_error(capture: Path) -> None:
    (capture / "sessions" / "hl_map" / "trajectories.txt").unlink()
    assert found(capture) == ["hl_map/trajectories.txt: error: file not found: images of a map session need poses"]


@pytest.mark.parametrize(
    ("record", "warned"),
    [({"unit": "m"}, True), ({"unit": "m", "meters": "--unit 1"}, False), ({"unit": None}, False), ({}, False)],
)
def test_meters_of_an_import_that_does_not_say_from_where_are_noted(
    capture: Path, record: dict[str, str | None], warned: bool
) -> None:
    path = capture / "sessions" / "hl_map" / IMPORT_RECORD
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(record))
    expected = "hl_map/proc/import.json: warning: says meters, not from where; earlier versions did of any unit"
    assert found(capture) == [f"{expected}: import again, or set `unit`"] * warned


def test_a_strange_session_name_is_noted(capture: Path) -> None:
    (capture / "sessions" / "hl_map").rename(capture / "sessions" / "walk")
    assert any("found session name 'walk', expected <ios, hl, spot>_<map or query>" in line for line in found(capture))


@pytest.mark.parametrize("name", ["STRECHA", "STRECHA_HARD"])
def test_real_captures_have_no_problems(name: str) -> None:
    if not (CAPTURES / name).exists():
        pytest.skip(f"the capture {name} is not on this machine")
    assert found(CAPTURES / name) == []
