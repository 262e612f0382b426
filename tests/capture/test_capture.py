import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toolkit.capture import (
    Capture,
    Session,
    Trajectory,
    camera_text,
    parse_camera,
    read_depth,
    write_depth,
    write_session,
)
from toolkit.capture.check import check_capture
from toolkit.errors import CaptureError

CAPTURES = Path(__file__).parents[2].parent / "shared" / "data" / "captures"
IDENTITY = [1.0, 0, 0, 0, 0, 0, 0]
QUARTER_Z = [np.sqrt(0.5), 0, 0, np.sqrt(0.5), 0, 0, 0]  # x to y
PINHOLE = ("camera", "PINHOLE", 64, 48, 50.5, 51.5, 32.0, 24.0)


def write(path: Path, files: dict[str, str]) -> Path:
    """Write text files of a session; sensors.txt and images.txt of one camera unless given."""
    defaults = {"sensors.txt": "cam, , camera, PINHOLE, 64, 48, 50, 50, 32, 24\n", "images.txt": "1, cam, a/1.jpg\n"}
    for name, text in (defaults | files).items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def rows_of(session: Session, timestamp: int, device_id: str) -> list[int]:
    """Return the rows of the images that a device took at a time."""
    return session.rows_of_keyframes(pd.DataFrame({"timestamp": [timestamp], "device_id": [device_id]}))[0].tolist()


@pytest.fixture
def session(tmp_path: Path) -> Session:
    """Two cameras, a rig made anew for each of three frames, one more camera without rig, a covariance."""
    rng = np.random.default_rng(0)
    rows = [(t, f"s/cam{c}", f"s/cam{c}/{t}.jpg") for t in (10, 20, 30) for c in (0, 1)] + [(20, "s/free", "s/f.jpg")]
    qt = rng.normal(size=(4, 7))
    qt[:, :4] /= np.linalg.norm(qt[:, :4], axis=1, keepdims=True)
    trajectory = Trajectory(
        [10, 20, 30, 20], ["s/rig_10", "s/rig_20", "s/rig_30", "s/free"], qt, rng.normal(size=(4, 6, 6))
    )
    write_session(
        tmp_path / "hl_map",
        [("s/cam0", "left", *PINHOLE), ("s/cam1", "", *PINHOLE), ("s/free", "free", *PINHOLE), ("s/imu", "", "imu")],
        [(f"s/rig_{t}", f"s/cam{c}", rng.normal(size=7)) for t in (10, 20, 30) for c in (0, 1)],
        trajectory,
        rows,
        depths=[(10, "s/depth", "s/d/10.png")],
        subsessions=["s"],
        keyframes={"pruned": pd.DataFrame({"timestamp": [20], "device_id": ["s/rig_20"]})},
        ground_truth=trajectory,
    )
    return Session.open(tmp_path / "hl_map")


def test_a_written_session_reads_back_equal_and_is_written_again_byte_for_byte(
    session: Session, tmp_path: Path
) -> None:
    again = write_session(
        tmp_path / "again" / "hl_map",
        [
            (row.sensor_id, row.name, row.sensor_type, *filter(None, row.params.split(", ")))
            for row in session.sensors.itertuples(index=False, name="Sensor")
        ],
        list(zip(session.rigs["rig_id"], session.rigs["sensor_id"], session._rig_qt, strict=True)),
        session.trajectory,
        session.images,
        depths=session.depths,
        subsessions=session.subsessions,
        keyframes={name: session.keyframes(name) for name in session.keyframe_files},
        ground_truth=session.ground_truth,
    )
    files = sorted(path.relative_to(session.path) for path in session.path.rglob("*.txt"))
    assert len(files) == 8
    for file in files:
        assert (again / file).read_bytes() == (session.path / file).read_bytes(), file


def test_rigs_given_as_matrices_are_written_as_poses(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    write_session(tmp_path / "hl_map", [("cam", "", *PINHOLE)], [("rig", "cam", pose)], None, [(1, "cam", "a.jpg")])
    np.testing.assert_array_equal(Session.open(tmp_path / "hl_map").rig_from_sensor_table, [pose])


def test_a_comma_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a,b"):
        write_session(tmp_path, [("a,b", "", *PINHOLE)], None, None, [])


def test_poses_compose_as_world_from_device_times_rig_from_sensor(tmp_path: Path) -> None:
    # The rig stands at x = 10 and its x axis points along the world's y; the camera is 1 m along the rig's x.
    quarter = "0.7071067811865476, 0, 0, 0.7071067811865476"
    path = write(
        tmp_path / "spot_map",
        {
            "images.txt": "5, cam, a/5.jpg\n6, cam, a/6.jpg\n",
            "rigs.txt": "rig, cam, 1, 0, 0, 0, 1, 0, 0\n",
            "trajectories.txt": f"5, rig, {quarter}, 10, 0, 0\n",
        },
    )
    session = Session.open(path)
    expected = [[0, -1, 0, 10], [1, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(session.world_from_cam([0])[0], expected, atol=1e-12)
    assert np.isnan(session.world_from_cam()[1]).all()
    assert session.device_ids.tolist() == ["rig", "rig"]


@pytest.mark.parametrize("name", ["spot_query", "query_phone"])
def test_odometry_of_queries_is_no_ground_truth(tmp_path: Path, name: str) -> None:
    odometry, aligned = "1, cam, 1, 0, 0, 0, 5, 6, 7\n", "1, cam, 1, 0, 0, 0, 10, 0, 0\n"
    path = write(tmp_path / name, {"trajectories.txt": odometry})
    session = Session.open(path)
    assert session.ground_truth is None
    assert np.isnan(session.world_from_cam(ground_truth=True)).all()
    write(path, {"proc/alignment_trajectories.txt": aligned})
    assert Session.open(path).world_from_cam(ground_truth=True)[0, :3, 3].tolist() == [10, 0, 0]


def test_poses_of_a_map_are_its_ground_truth(tmp_path: Path) -> None:
    session = Session.open(write(tmp_path / "spot_map", {"trajectories.txt": "1, cam, 1, 0, 0, 0, 5, 6, 7\n"}))
    assert session.ground_truth is session.trajectory


def test_a_frame_takes_the_rig_of_its_time(session: Session) -> None:
    assert session.device_ids.tolist() == [f"s/rig_{t}" for t in (10, 10, 20, 20, 30, 30)] + ["s/free"]
    table = session.rig_from_sensor_table
    np.testing.assert_array_equal(session.rig_from_cam(), [*table, np.eye(4)])
    expected = session.trajectory.world_from_device[[0, 0, 1, 1, 2, 2]] @ table
    np.testing.assert_allclose(session.world_from_cam(np.arange(6)), expected, atol=1e-12)
    np.testing.assert_array_equal(session.world_from_cam([6], ground_truth=True), session.world_from_cam([6]))
    assert rows_of(session, 20, "s/rig_20") == [2, 3]
    assert rows_of(session, 20, "s/rig_10") == []
    assert [rows.tolist() for rows in session.rows_of_keyframes(session.keyframes("all"))] == [
        [0, 1],
        [2, 3],
        [4, 5],
        [6],
    ]


def test_without_poses_a_keyframe_then_the_name_of_the_rig_tells_it(tmp_path: Path) -> None:
    rigs = "".join(f"{rig}, cam, 1, 0, 0, 0, {i}, 0, 0\n" for i, rig in enumerate(["s1/a_7", "s1/b", "s2022/9-body"]))
    path = write(
        tmp_path / "spot_query",
        {
            "images.txt": "7, cam, x/7.jpg\n8, cam, x/8.jpg\n9, cam, x/9.jpg\n2022, cam, x/2022.jpg\n",
            "rigs.txt": rigs,
            "proc/keyframes_pruned.txt": "8, s1/b\n",
        },
    )
    session = Session.open(path)
    assert session.device_ids.tolist() == ["s1/a_7", "s1/b", "s2022/9-body", "cam"]
    assert session.trajectory is None
    assert np.isnan(session.world_from_cam()).all()
    assert session.keyframes("all").to_numpy().tolist()[0] == [7, "s1/a_7"]


def test_files_as_programs_write_them(tmp_path: Path) -> None:
    """A byte-order mark, Windows line ends, comments and blank lines anywhere, no last newline."""
    path = write(
        tmp_path / "ios_query",
        {
            "sensors.txt": "\ufeff# sensor_id, name, sensor_type, [sensor_params]+\r\n"
            "s/cam 1/ä?,,camera,PINHOLE,64,48,50,50,32,24\r\n\r\nwifi, w, wifi\r\nbt, , bluetooth, a, 1\r\n"
            "tof, , depth, SIMPLE_PINHOLE, 64, 48, 50, 32.0, 24.0\r\n",
            "images.txt": "#timestamp,sensor_id\n  1 ,s/cam 1/ä?,  s/1.jpg , extra, 3\n# comment\n\n"
            "2, s/cam 1/ä?, s/2.jpg\n"
            "1, tof, s/d.png",
            "trajectories.txt": "1, s/cam 1/ä?, 1,0,0,0, 1e1,2,3, more\n",
        },
    )
    session = Session.open(path)
    assert session.images.to_numpy().tolist()[:2] == [[1, "s/cam 1/ä?", "s/1.jpg"], [2, "s/cam 1/ä?", "s/2.jpg"]]
    assert session.image_path(1) == path / "raw_data" / "s" / "2.jpg"
    assert session.image_name(1) == "ios_query/raw_data/s/2.jpg"
    assert [session.row_of_name[name] for name in session.image_names] == [0, 1, 2]
    assert session.sensors["params"].tolist()[1:3] == ["", "a, 1"]
    assert (session.device, session.split, session.subsessions) == ("ios", "query", ["s"])
    assert rows_of(session, 1, "s/cam 1/ä?") == [0]
    assert rows_of(session, 1, "tof") == [], "a depth map is no photograph"
    assert session.camera("tof").width == 64
    assert session.cameras([2, 0]) == [session.camera("tof"), session.camera("s/cam 1/ä?")]
    assert session.cameras([]) == []
    assert session.camera_rows.tolist() == [0, 1]
    assert session.trajectory.covariances is None
    assert session.trajectory.qt[0, 4] == 10
    for sensor, named in (("wifi", r"sensors.txt, line 4: .*'wifi'"), ("nothing", r"'nothing'.*sensors\.txt")):
        with pytest.raises(CaptureError, match=named):
            session.camera(sensor)


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("images.txt", "2, cam", "found 2 values in '2, cam'"),
        ("images.txt", "2.5, cam, a.jpg", "found timestamp = '2.5'"),
        ("images.txt", "x, cam, a.jpg", "found timestamp = 'x'"),
        ("images.txt", "2, , a.jpg", "found sensor_id = ''"),
        ("images.txt", "2, cam,", "found image_path = ''"),
        ("sensors.txt", "cam2, name", "found 2 values in 'cam2, name'"),
        ("rigs.txt", "rig, cam, 1, 0, 0, 0, 0, 0", "found 8 values in 'rig, cam, 1, 0, 0, 0, 0, 0'"),
        ("rigs.txt", "rig, cam, 0, 0, 0, 0, 1, 2, 3", "found a zero quaternion"),
        ("trajectories.txt", "2, cam, 1, 0, 0, 0, 0, nan, 0", "found ty = 'nan'"),
        ("trajectories.txt", "2, cam, 1, 0, 0, 0, 0, one, 0", "found ty = 'one'"),
        ("proc/alignment_trajectories.txt", "2, cam, inf, 0, 0, 0, 0, 0, 0", "found qw = 'inf'"),
        ("images.txt", b"2, c\xe4m, a.jpg", "found bytes that are not UTF-8"),
        ("images.txt", "0x10, cam, a.jpg", "found timestamp = '0x10'"),
        ("images.txt", "0X1F, cam, a.jpg", "found timestamp = '0X1F'"),
        ("trajectories.txt", "2, cam, 1, 0, 0, 0, 1e308, 0, 0", "found tx = '1e308'"),
        ("rigs.txt", "rig, cam, 1, 0, 0, 0, 0, 0, -1e13", "found tz = '-1e13'"),
        ("trajectories.txt", "2, cam, 1e200, 0, 0, 0, 0, 0, 0", "found a quaternion of huge length"),
        ("images.txt", "2, cam, a.jpg\r3, cam, b.jpg", "found a carriage return within the line"),
        ("images.txt", "1, cam, b.jpg", "timestamp 1, sensor_id 'cam' again, with other values than in line 3"),
        ("rigs.txt", "rig, cam, 1, 0, 0, 0, 5, 0, 0", "rig_id 'rig', sensor_id 'cam' again, with other values than"),
        ("trajectories.txt", "1, cam, 1, 0, 0, 0, 5, 0, 0", "timestamp 1, device_id 'cam' again, with other values"),
    ],
)
def test_a_malformed_line_is_named(tmp_path: Path, file: str, line: str | bytes, message: str) -> None:
    good = {
        "images.txt": "1, cam, a/1.jpg",
        "sensors.txt": "cam, , camera, PINHOLE, 64, 48, 50, 50, 32, 24",
        "rigs.txt": "rig, cam, 1, 0, 0, 0, 0, 0, 0",
    }.get(file, "1, cam, 1, 0, 0, 0, 0, 0, 0")
    bad = line if isinstance(line, bytes) else line.encode()
    path = write(tmp_path / "ios_map", {file: f"# header\n\n{good}\n".encode() + bad + b"\n"})
    with pytest.raises(CaptureError) as caught:
        Session.open(path)
    text = str(caught.value)
    assert f"{path / file}, line 4: {message}" in text
    assert "visloc check" in text or " again, " in text


def test_scans_and_fixes_are_tables(tmp_path: Path) -> None:
    header = "# timestamp, sensor_id, mac_addr, frequency_khz, rssi_dbm, name, scan_time_start_us, scan_time_end_us\n"
    path = write(
        tmp_path / "ios_query",
        {
            # The name of a network may have a comma; a scan may receive an emitter twice.
            "wifi.txt": f"{header}5, s/wifi, AA:BB:CC:DD:EE:FF, 2412000, -61.5, Tom, Dick, 4, 5\n" * 2,
            "bt.txt": "6, s/bt, 8f14e45f-ceea-467f-a8f4-6f2d2e1a9c01:0:0, -80\n7, s/bt, b:1:2, -90, beacon\n",
            "gps.txt": "8, s/gps, 47.3763, -8.5477, 408.5, 4.7\n9, s/gps, 47.4, -8.5, 0, -1\n",
        },
    )
    session = Session.open(path)
    assert session.wifi.to_numpy().tolist() == [[5, "s/wifi", "AA:BB:CC:DD:EE:FF", 2412000.0, -61.5]] * 2
    assert list(session.wifi) == ["timestamp", "sensor_id", "mac_addr", "frequency_khz", "rssi_dbm"]
    assert session.bluetooth["rssi_dbm"].tolist() == [-80, -90]
    assert session.bluetooth["id"].tolist()[1] == "b:1:2"
    assert session.gps.iloc[0].tolist() == [8, "s/gps", 47.3763, -8.5477, 408.5, 4.7]
    other = Session.open(write(tmp_path / "hl_query", {}))
    assert other.wifi is other.bluetooth is other.gps is None


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("wifi.txt", "2, w, aa:bb, 2412000", "found 4 values in '2, w, aa:bb, 2412000', expected 5: timestamp,"),
        ("wifi.txt", "2, w, aa:bb, 2412000, loud", "found rssi_dbm = 'loud'"),
        ("wifi.txt", "2, w, , 2412000, -50", "found mac_addr = ''"),
        ("bt.txt", "now, w, a:1:2, -50", "found timestamp = 'now'"),
        ("gps.txt", "2, g, 90.1, 8, 400, 5", "found latitude_deg = '90.1', expected degrees from -90 to 90"),
        ("gps.txt", "2, g, 47, 181, 400, 5", "found longitude_deg = '181', expected degrees from -180 to 180"),
        ("gps.txt", "1, g, 47, 8, 400, 6", "timestamp 1, sensor_id 'g' again, with other values than in line 1"),
    ],
)
def test_a_malformed_scan_or_fix_is_named(tmp_path: Path, file: str, line: str, message: str) -> None:
    good = {"wifi.txt": "1, w, aa:bb, 2412000, -50", "bt.txt": "1, b, a:1:2, -50", "gps.txt": "1, g, 47, 8, 400, 5"}
    session = Session.open(write(tmp_path / "ios_map", {file: f"{good[file]}\n{line}\n"}))
    with pytest.raises(CaptureError) as caught:
        getattr(session, {"wifi.txt": "wifi", "bt.txt": "bluetooth", "gps.txt": "gps"}[file])
    assert f"{session.path / file}, line 2: {message}" in str(caught.value)


SENSOR = "cam, , camera, PINHOLE, 64, 48, 50, 50, 32, 24\n"


@pytest.mark.parametrize(
    ("file", "text", "named"),
    [
        # One line, which begins with `#`.
        ("images.txt", "# timestamp, sensor_id, image_path\r1, cam, a/1.jpg\r", ", line 1: found a carriage return"),
        ("images.txt", "1, cam, a/1.jpg\n2, cam, a/1.jpg\n", ", line 2: found the image 'a/1.jpg' again"),
        (
            "sensors.txt",
            SENSOR + SENSOR.replace("50, 50", "60, 60"),
            ", line 2: sensor_id 'cam' again, with other values",
        ),
        ("rigs.txt", None, " (not a file)"),  # a pipe, which is not waited for
    ],
)
def test_files_that_contradict_themselves_are_refused(file: str, text: str | None, named: str, tmp_path: Path) -> None:
    path = write(tmp_path / "ios_map", {file: text} if text else {})
    if text is None:
        os.mkfifo(path / file)

    def read() -> None:
        session = Session.open(path)
        _ = session.image_path(0), session.camera("cam")

    with pytest.raises(CaptureError, match=re.escape(f"{file}{named}")):
        read()


def test_a_line_that_is_there_twice_counts_once_and_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    camera = "cam, , camera, PINHOLE, 64, 48, 50, 50, 32, 24\n"
    path = write(
        tmp_path / "ios_query",
        {
            "sensors.txt": camera * 2,
            "images.txt": "2, cam, a/2.jpg\n1, cam, a/1.jpg\n2, cam, a/2.jpg\n",
            "rigs.txt": "rig, cam, 1, 0, 0, 0, 0, 0, 0\n" * 3,
            "proc/keyframes_pruned.txt": "1, rig\n2, rig\n1, rig\n",
            "proc/alignment_trajectories.txt": "1, rig, 1, 0, 0, 0, 0, 0, 0\n" * 2,
        },
    )
    session = Session.open(path)
    assert session.camera("cam").width == 64
    assert session.images["timestamp"].tolist() == [2, 1]
    assert session.keyframes("pruned")["timestamp"].tolist() == [1, 2]
    assert session.keyframes("all")["timestamp"].tolist() == [1]
    assert session.rig_from_sensor_table.shape == (1, 4, 4)
    for told in (
        *("sensors.txt, line 2: sensor_id 'cam' again, as in line 1; each counts once", "images.txt, line 3: "),
        "rigs.txt, line 2: rig_id 'rig', sensor_id 'cam' again, as in line 1, and 1 more",
        "keyframes_pruned.txt, line 3",
    ):
        assert told in caplog.text
    assert caplog.text.count("keyframes_pruned.txt, line 3") == 1


def test_line_numbers_hold_in_a_long_file(tmp_path: Path) -> None:
    rows = [f"{t}, cam, a/{t}.jpg" for t in range(3000)]
    path = write(tmp_path / "ios_map", {"images.txt": "# header\n" + "\n".join(rows)})
    assert Session.open(path).images["path"].tolist() == [f"a/{t}.jpg" for t in range(3000)]
    rows[2345] = "nonsense"
    rows[77] = "1.5, cam, a.jpg"
    path = write(tmp_path / "ios_map", {"images.txt": "# header\n" + "\n".join(rows)})
    with pytest.raises(CaptureError, match=r"images.txt, line 79: .*'1.5'.*1 more"):
        Session.open(path)
    assert [line for line, _ in Session(path, strict=False).tables["images.txt"].problems] == [79, 2347]


def test_every_camera_model_of_colmap_opens(tmp_path: Path) -> None:
    import pycolmap

    models = [name for name in pycolmap.CameraModelId.__members__ if name not in ("INVALID", "EQUIRECTANGULAR")]
    cameras = {name: pycolmap.Camera.create_from_model_name(0, name, 50.0, 64, 48) for name in models}
    sensors = [
        (name, "", "camera", name, 64, 48, *(camera.params + 0.125).tolist()) for name, camera in cameras.items()
    ]
    write_session(tmp_path / "ios_map", sensors, None, None, [])
    session = Session.open(tmp_path / "ios_map")
    assert len(models) >= 11
    for name, expected in cameras.items():
        camera = session.camera(name)
        assert (camera.model.name, camera.width, camera.height) == (name, 64, 48)
        np.testing.assert_array_equal(camera.params, expected.params + 0.125)
    assert session.camera("PINHOLE") is session.camera("PINHOLE")


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ("PINHOL, 64, 48, 50, 50, 32, 24", "found camera model 'PINHOL', expected one of"),
        ("PINHOLE, 64, 48, 50, 50, 32", "found 3 parameters for model PINHOLE"),
        ("PINHOLE, 64, 48, 50, 50, 32, x", "expected numbers after the model"),
        ("PINHOLE, 64, 48, 50, 50, 32, nan", "finite"),
        ("PINHOLE, 64.5, 48, 50, 50, 32, 24", "found image size 64.5 x 48"),
        ("PINHOLE, -64, 48, 50, 50, 32, 24", "found image size -64 x 48"),
        ("PINHOLE, 64, 18446744073709551616, 50, 50, 32, 24", "found image size 64 x 1.84467e+19"),
        ("PINHOLE, 64, 48, -50, 50, 32, 24", "found a focal length that is not positive"),
        ("PINHOLE, 64, 48, 50, 50, 3200, 24", "found a principal point at 3200"),
        ("SIMPLE_RADIAL, 64, 48, 50, 32, -49, 0", "found a principal point at -49"),
        ("PINHOLE, 64, 48, 5_0, 50, 32, 24", "expected numbers after the model"),
        ("", "found camera model ''"),
    ],
)
def test_a_wrong_camera_is_named(tmp_path: Path, params: str, message: str) -> None:
    path = write(tmp_path / "ios_map", {"sensors.txt": f"# header\ncam, , camera, {params}\n"})
    session = Session.open(path)  # cameras are parsed when asked for: a phone has one for each frame
    with pytest.raises(CaptureError) as caught:
        session.camera("cam")
    assert f"{path / 'sensors.txt'}, line 2: sensor 'cam': " in str(caught.value)
    assert message in str(caught.value)


def test_trajectories_keep_poses_and_covariances_exactly(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    covariances = rng.normal(size=(3, 6, 6))
    trajectory = Trajectory([3, 1, 2], ["a", "b", "a"], rng.normal(size=(3, 7)), covariances)
    trajectory.write(tmp_path / "t.txt")
    read = Trajectory.read(tmp_path / "t.txt")
    np.testing.assert_array_equal(read.qt, trajectory.qt)
    np.testing.assert_array_equal(read.covariances, covariances)
    assert (read.timestamps.tolist(), read.device_ids.tolist(), len(read)) == ([3, 1, 2], ["a", "b", "a"], 3)
    poses = read.lookup([1, 1, 9, 2], ["b", "a", "b", "a"])
    np.testing.assert_array_equal(poses[[0, 3]], read.world_from_device[[1, 2]])
    assert np.isnan(poses[[1, 2]]).all()
    header = (tmp_path / "t.txt").read_text().splitlines()[0]
    assert header == "# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz, *covar"


def test_a_covariance_that_is_nan_is_left_out(tmp_path: Path) -> None:
    covariances = np.stack([np.eye(6), np.full((6, 6), np.nan)])
    Trajectory([1, 2], ["a", "b"], np.tile(np.eye(7)[0], (2, 1)), covariances).write(tmp_path / "t.txt")
    lines = (tmp_path / "t.txt").read_text().splitlines()
    assert [line.count(",") for line in lines[-2:]] == [8 + 36, 8]
    np.testing.assert_array_equal(Trajectory.read(tmp_path / "t.txt").covariances, covariances)


def test_a_covariance_that_is_malformed_is_not_used_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """It would be 0 there, which is certain."""
    numbers = ", ".join(["1"] * 35)
    lines = [f"{time}, a, 1, 0, 0, 0, 0, 0, 0, {numbers}, {last}" for time, last in enumerate(("1", "O.5", "nan", "2"))]
    (tmp_path / "t.txt").write_text("\n".join(lines))
    covariances = Trajectory.read(tmp_path / "t.txt").covariances
    assert covariances is not None
    assert covariances[[0, 3], 5, 5].tolist() == [1, 2]
    assert np.isnan(covariances[1:3]).all()
    assert "t.txt, line 2: the covariance" in caplog.text


def test_rows_without_covariance_are_nan(tmp_path: Path) -> None:
    numbers = ", ".join(map(str, range(36)))
    (tmp_path / "t.txt").write_text(f"1, a, 1, 0, 0, 0, 0, 0, 0\n2, a, 1, 0, 0, 0, 0, 0, 0, {numbers}\n")
    covariances = Trajectory.read(tmp_path / "t.txt").covariances
    assert np.isnan(covariances[0]).all()
    np.testing.assert_array_equal(covariances[1].ravel(), np.arange(36))


def test_an_empty_trajectory_is_written_and_read(tmp_path: Path) -> None:
    Trajectory([], [], np.zeros((0, 7))).write(tmp_path / "t.txt")
    read = Trajectory.read(tmp_path / "t.txt")
    assert len(read) == 0
    assert np.isnan(read.lookup([1], ["a"])).all()


def test_timestamps_stay_integers(tmp_path: Path) -> None:
    stamp = 2**62 + 1  # a float would round it
    path = write(tmp_path / "ios_map", {"images.txt": f"{stamp}, cam, a.jpg\n"})
    assert Session.open(path).images["timestamp"].iloc[0] == stamp


def test_the_longest_subsession_counts(tmp_path: Path) -> None:
    path = write(
        tmp_path / "ios_map",
        {
            "images.txt": "1, cam, a/1.jpg\n2, cam, a/b/2.jpg\n3, cam, ab/3.jpg\n4, ab/x, other/4.jpg\n",
            "proc/subsessions.txt": "a\na/b",
        },
    )
    session = Session.open(path)
    assert session.subsession_of().tolist() == ["a", "a/b", "", ""]
    assert session.subsession_of([1]).tolist() == ["a/b"]
    (path / "proc" / "subsessions.txt").write_text("ab\n")
    assert Session.open(path).subsession_of().tolist() == ["", "", "ab", "ab"]
    (path / "proc" / "subsessions.txt").unlink()
    assert Session.open(path).subsessions == ["a", "ab", "other"]


def test_keyframe_lists(session: Session) -> None:
    expected = [[20, "s/rig_20"]]
    assert session.keyframes("pruned").to_numpy().tolist() == expected
    assert session.keyframes("keyframes_pruned").to_numpy().tolist() == expected
    with pytest.raises(CaptureError, match=r"'keyframes_pruned_subsampled'; available: pruned, all"):
        session.keyframes()


def test_depth_maps(session: Session, tmp_path: Path) -> None:
    assert session.depths is not None
    assert session.depths.to_numpy().tolist() == [[10, "s/depth", "s/d/10.png"]]
    depth = np.array([[0, 1.5], [70, np.nan], [-1, 65.534]], np.float32)
    write_depth(tmp_path / "d.png", depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.png"), np.float32([[0, 1.5], [0, 0], [0, 65.534]]))
    (tmp_path / "bad.png").write_bytes(b"no image")
    for name in ("none.png", "bad.png"):
        with pytest.raises(CaptureError, match=f"Depth map.*{name}"):
            read_depth(tmp_path / name)


def test_the_file_of_an_image_is_found_by_its_name(tmp_path: Path) -> None:
    path = write(tmp_path / "PLACE" / "sessions" / "query_phone", {})
    capture = Capture.open(tmp_path / "PLACE")
    assert capture.image_path("query_phone/raw_data/a/1.jpg") == path / "raw_data" / "a" / "1.jpg"
    with pytest.raises(CaptureError, match=r"images\.txt: has no image 'query_phone/raw_data/\.\./2\.jpg'"):
        capture.image_path("query_phone/raw_data/../2.jpg")


def test_capture_opens_sessions_lazily(tmp_path: Path) -> None:
    root = tmp_path / "PLACE" / "sessions"
    write(root / "spot_query", {})
    write(root / "ios_map", {"images.txt": "broken\n"})
    (root / "notes").mkdir()
    capture = Capture.from_sessions_root(root)
    assert (capture.name, list(capture), capture.devices) == ("PLACE", ["ios_map", "spot_query"], ["ios", "spot"])
    assert "ios_map" in capture
    assert "hl_map" not in capture
    assert capture["spot_query"] is capture["spot_query"]
    for name, named in (("ios_map", r"images\.txt, line 1"), ("hl_map", "'hl_map'.*ios_map, spot_query")):
        with pytest.raises(CaptureError, match=named):
            capture[name]


@pytest.mark.parametrize(("open_folder", "made", "asked", "named"), [
    (Capture.open, "", "none", "capture folder"),
    (Capture.open, "", "", "sessions"),
    (Capture.open, "sessions", "", "sessions"),
    (check_capture, "", "", "has no folder `sessions`"),
    (Capture.from_sessions_root, "sessions", "", "is not the `sessions` folder"),
    (Session.open, "", "ios_map", "ios_map"),
    (Session.open, "ios_map", "ios_map", r"sensors.txt: "),
])  # fmt: skip
def test_what_is_no_capture_is_refused(
    open_folder: Callable[[Path], object], made: str, asked: str, named: str, tmp_path: Path
) -> None:
    (tmp_path / made).mkdir(exist_ok=True)
    with pytest.raises(CaptureError, match=named):
        open_folder(tmp_path / asked)


def test_a_large_session_opens_at_once_in_little_memory(tmp_path: Path) -> None:
    import subprocess
    import sys

    root = Path(__file__).parents[2]
    result = subprocess.run(
        [sys.executable, root / "benchmarks" / "capture.py", "--images", "20000"],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(root)},
    )
    assert "toolkit    imports" in result.stdout, result.stdout + result.stderr
    assert float(result.stdout.split("peak")[1].split("MB")[0]) < 300


@pytest.mark.parametrize("name", ["STRECHA", "STRECHA_HARD"])
def test_real_captures_open(name: str) -> None:
    if not (CAPTURES / name).exists():
        pytest.skip(f"the capture {name} is not on this machine")
    capture = Capture.open(CAPTURES / name)
    assert capture.devices == ["ios", "hl", "spot"]
    per_frame = {"ios": 1, "hl": 2, "spot": 3}
    for session_id in capture:
        session = capture[session_id]
        assert np.isfinite(session.world_from_cam(ground_truth=True)).all()
        assert np.isfinite(session.world_from_cam()).all() == (session.split == "map")
        assert all(session.image_path(row).exists() for row in range(len(session)))
        assert len(session.subsessions) == 3
        assert set(session.subsession_of()) == set(session.subsessions)
        frames = session.rows_of_keyframes(session.keyframes("all"))
        assert {len(rows) for rows in frames} == {per_frame[session.device]}
        # The cameras of a rig share one center here: only the right direction of composing shows that.
        centers = session.world_from_cam(ground_truth=True)[:, :3, 3]
        assert max(np.ptp(centers[rows], axis=0).max() for rows in frames) < 1e-9
        if session.split == "query":
            assert list(session.keyframe_files) == ["original", "pruned", "pruned_subsampled"]
            assert all(len(rows) for rows in session.rows_of_keyframes(session.keyframes()))


@pytest.mark.parametrize(
    "text", ["PINHOLE, 640, 480, 500.25, 500.0, 320.0, 240.1", "SIMPLE_RADIAL, 64, 48, 50.0, 32.0, 24.0, -1e-05"]
)
def test_a_camera_reads_back_as_it_was_written(text: str) -> None:
    assert camera_text(parse_camera("camera", text)) == text


def test_a_session_without_access_leaves_the_others(
    small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    exists = Path.exists

    def denied(path: Path) -> bool:  # root may enter everything, so chmod does not show it
        if path.parent.name == "ios_query":
            raise PermissionError(13, "Permission denied", str(path))
        return exists(path)

    monkeypatch.setattr(Path, "exists", denied)
    capture = Capture.open(place)
    assert "ios_query" not in capture.session_ids
    assert "ios_map" in capture.session_ids
    problems = [problem for problem in check_capture(place).errors if problem.session == "ios_query"]
    assert len(problems) == 1
    assert "Permission denied" in problems[0].message


@pytest.mark.parametrize(("text", "named"), [
    ("EQUIRECTANGULAR, 2048, 1024, 2048, 1024", "EQUIRECTANGULAR"),
    ("PINHOLE, 640, 480, 0, 500, 320, 240", "focal length"),
])  # fmt: skip
def test_a_panorama_and_a_focal_length_of_zero_are_no_camera(text: str, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        parse_camera("camera", text)
