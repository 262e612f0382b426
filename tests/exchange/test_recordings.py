"""What recordings have besides images: times and their unit, lists of poses, GPS fixes, depth maps."""

from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from typer.testing import CliRunner

from toolkit.__main__ import app
from toolkit.capture import Capture, Session
from toolkit.capture.check import check_capture
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.interchange import import_colmap, import_images
from toolkit.exchange.recordings import find_depths, lines_of_images, read_times, read_track
from toolkit.geometry import Floats, invert, make_pose, qt_from_pose, quaternion_to_rotation
from toolkit.prediction.depths import DepthMaps

CAMERA = "PINHOLE, 64, 48, 50, 51, 32, 24"
START_S = 1_305_031_102.175304
TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def pose(number: int) -> Floats:
    rng = np.random.default_rng(number)
    return make_pose(quaternion_to_rotation(rng.normal(size=4)), rng.normal(size=3) * 10)


def photos(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.new("RGB", (64, 48)).save(folder / name)
    return folder


def words(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def listed(kind: str, times_s: list[float], poses: list[Floats]) -> str:
    """A list of poses as a tool of this kind writes it."""
    lines = []
    for time_s, one in zip(times_s, poses, strict=True):
        qw, qx, qy, qz, *xyz = qt_from_pose(one if np.isfinite(one).all() else np.eye(4))
        lines.append(
            {
                "tum": f"{time_s:.6f} {words(xyz)} {words((qx, qy, qz, qw))}",
                "euroc": f"{round(time_s * 1e9)},{words((*xyz, qw, qx, qy, qz, *[0] * 9)).replace(' ', ',')}",
                "euroc8": f"{round(time_s * 1e9)}, {words((*xyz, qw, qx, qy, qz)).replace(' ', ', ')}",
                "relative": f"{time_s - START_S:.6f},{words((*xyz, qw, qx, qy, qz)).replace(' ', ',')}",
                "kitti": words(one[:3]),
                "timed": f"{time_s:.6f} {words(one[:3])}",
                "rows": f"{time_s:.6f} {words(one)}",
                "columns": f"{time_s:.6f} {words(one.T)}",
            }[kind]
        )
    head = {
        "tum": "# timestamp tx ty tz qx qy qz qw\n", "euroc": "#timestamp, p_RS_R_x [m]\n",
        "euroc8": "timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z\n", "relative": "time,px,py,pz,qw,qx,qy,qz\n",
    }  # fmt: skip
    return head.get(kind, "") + "\n".join(lines)


@pytest.mark.parametrize("kind", ["tum", "euroc", "euroc8", "kitti", "timed", "rows", "columns"])
def test_lists_of_poses_of_the_field_become_maps_and_truth(kind: str, tmp_path: Path) -> None:
    times = [START_S + number / 10 for number in range(4)]
    names = [f"rgb/{time_s + 0.004:.6f}.png" for time_s in times]
    file = tmp_path / "poses.txt"
    file.write_text(listed(kind, times, [pose(number) for number in range(4)]))
    folder = photos(tmp_path / "photos", *names)
    for split, option in (("map", "table"), ("query", "truth")):
        given: dict[str, Any] = {"split": split, option: file, "camera": CAMERA}
        report = import_images(folder, tmp_path / "PLACE", **given)
        assert any("without names of images" in note for note in report.notes)
        session = Capture.open(tmp_path / "PLACE")[f"ios_{split}"]
        poses = session.world_from_cam(ground_truth=split == "query")
        np.testing.assert_allclose(poses, [pose(number) for number in range(4)], rtol=0, atol=1e-9)
        if kind != "kitti":
            assert session.images["timestamp"].iloc[0] == pytest.approx((START_S + 0.004) * 1e6, abs=1)
    with pytest.raises(ManifestError):  # the truth of a map
        import_images(folder, tmp_path / "OTHER", split="map", table=file, truth=file, camera=CAMERA)
    photos(folder, f"rgb/{START_S + 9:.6f}.png")
    if kind == "kitti":
        with pytest.raises(CaptureError, match=r"poses\.txt: found 4 poses of 5 images"):
            import_images(folder, tmp_path / "OTHER", split="map", table=file, camera=CAMERA)
    else:
        report = import_images(folder, tmp_path / "OTHER", split="map", table=file, camera=CAMERA)
        assert report.record["left out"][0]["reason"] == f"{file}, no pose within 0.02 s"


def test_lines_without_names_belong_to_images_by_order_or_number() -> None:
    assert lines_of_images(["c.png", "a.png", "b.png"], 3) == [2, 0, 1]
    assert lines_of_images(["10.png", "9.png", "a/1.png"], 3) == [1, 0, 2]
    assert lines_of_images(["image_0/000004.png", "image_0/000000.png"], 5) == [4, 0]
    assert lines_of_images(["000004.png", "000005.png"], 5) is None
    assert lines_of_images(["a.png"], 5) is None


@pytest.mark.parametrize(
    "bad",
    ["1305031104.1 1 2 3 0 0 0 2", "1305031104.1 nan 2 3 0 0 0 1", "1305031104.1 1e20 2 3 0 0 0 1", "1305031104.1 1 2"],
)
def test_lines_that_are_no_pose_are_counted(bad: str, tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text(listed("tum", [START_S, START_S + 1], [pose(0), pose(1)]) + f"\n{bad}\n")
    track = read_track(file, None)
    assert track is not None
    np.testing.assert_allclose(track.poses, [pose(0), pose(1)], rtol=0, atol=1e-9)
    assert track.note.startswith(f"1 of 3 lines are no pose; first: {file}, line 4: found '{bad}'")
    file.write_text("\n".join([file.read_text(), bad, bad, bad, bad]))
    with pytest.raises(CaptureError, match=r"t\.txt, line 4: .*no pose"):
        read_track(file, None)
    file.write_text(listed("kitti", [0, 1, 2], [pose(0), np.full((4, 4), np.nan), pose(2)]))
    folder = photos(tmp_path / "photos", "0.png", "1.png", "2.png")
    report = import_images(folder, tmp_path / "PLACE", split="map", table=file, camera=CAMERA)
    assert [(one["first"], one["reason"]) for one in report.record["left out"]] == [
        ("1.png", f"{file}, its line is no pose")
    ]
    assert any("1 of 3 lines are no pose" in note for note in report.notes)
    file.write_text("image,qw\na.jpg,1\n")
    assert read_track(file, None) is None


@pytest.mark.parametrize(("unit", "scale"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_the_unit_of_times_is_told_by_their_size_or_given(unit: str, scale: float, tmp_path: Path) -> None:
    names = [f"{round(scale * (1.7e9 + number))}.png" for number in range(3)]
    expected = {name: round((1.7e9 + number) * 1e6) for number, name in enumerate(names)}
    assert read_times("names", names, None) == expected
    file = tmp_path / "times.txt"
    file.write_text("".join(f"{scale * number / 10} rgb/{number}.png\n" for number in range(3)))
    listed_names = [f"{number}.png" for number in range(3)]
    assert read_times(file, listed_names, unit) == {name: k * 100_000 for k, name in enumerate(listed_names)}
    file.write_text("image,time\n" + "".join(f"{number}.png,{scale * number / 10}\n" for number in range(3)))
    assert read_times(file, listed_names, unit) == {name: k * 100_000 for k, name in enumerate(listed_names)}
    file.write_text("".join(f"{scale * number / 10:e}\n" for number in range(3)))  # KITTI's times.txt
    assert read_times(file, listed_names, unit) == {name: k * 100_000 for k, name in enumerate(listed_names)}


def test_a_table_has_a_column_of_times(tmp_path: Path) -> None:
    folder, table = photos(tmp_path / "photos", "0.png", "1.png"), tmp_path / "t.csv"
    table.write_text("image,timestamp\n0.png,0.25\n1.png,0.75\n")
    report = import_images(folder, tmp_path / "PLACE", table=table, camera=CAMERA, timestamps_unit="s")
    assert report.images["timestamp"].tolist() == [250_000, 750_000]
    assert report.record["timestamps"] == [2, "as given"]


SCALES = (1, 1e3, 1e6, 1e9)
ASKED = "timestamps: found times such as .* Give --timestamps-unit"


@pytest.mark.parametrize(("given", "unit", "named"), [
    *(({"timestamps": [f"{scale * k / 10} rgb/{k}.png" for k in range(3)]}, None, ASKED) for scale in SCALES),
    ({"table": ["image,timestamp", "0.png,0.25", "1.png,0.75"]}, None, "table: found times such as 0.5. Give"),
    ({"timestamps": ["0,0.png", "33,1.png"]}, "hours", "timestamps-unit: found 'hours'"),
])  # fmt: skip
def test_times_of_an_unknown_unit_are_refused(
    given: dict[str, list[str]], unit: str | None, named: str, tmp_path: Path
) -> None:
    folder, ((option, lines),) = photos(tmp_path / "photos", "0.png", "1.png"), given.items()
    (tmp_path / option).write_text("\n".join(lines))
    options: dict[str, Any] = {option: tmp_path / option, "timestamps_unit": unit}
    with pytest.raises(ManifestError, match=named):
        import_images(folder, tmp_path / "PLACE", camera=CAMERA, **options)


def test_names_that_end_alike_are_not_confused(tmp_path: Path) -> None:
    file, names = tmp_path / "times.txt", ["cam0/1.png", "cam1/1.png", "cam1/2.png"]
    file.write_text("1 1.png\n2 2.png\n3 cam0/1.png\n")
    assert read_times(file, names, "s") == {"cam1/2.png": 2_000_000, "cam0/1.png": 3_000_000}


def test_times_in_a_wrong_unit_are_said(tmp_path: Path) -> None:
    folder, file = photos(tmp_path / "photos", *(f"{number}.png" for number in range(6))), tmp_path / "times.csv"
    file.write_text("".join(f"{33 * number},{number}.png\n" for number in range(5)))
    options: dict[str, Any] = {"camera": CAMERA, "timestamps": file}
    report = import_images(folder, tmp_path / "PLACE", timestamps_unit="us", **options)
    assert [(one["first"], one["reason"]) for one in report.record["left out"]] == [("5.png", f"no time in {file}")]
    said = check_capture(tmp_path / "PLACE").text()
    assert "the median step between images is 33 us: are these milliseconds?" in said
    import_images(folder, tmp_path / "PLACE", timestamps_unit="ms", replace=True, **options)
    assert check_capture(tmp_path / "PLACE").problems == []


@pytest.mark.parametrize("kind", ["tum", "euroc8", "relative", "kitti", "columns"])
def test_odometry_becomes_that_of_the_queries(kind: str, tmp_path: Path) -> None:
    folder = photos(tmp_path / "photos", *(f"{number:06d}.png" for number in range(4)))
    times, true = [START_S + number / 10 for number in range(8)], [pose(number) for number in range(8)]
    in_cm = [one @ TO_GL for one in true]
    for one in in_cm:
        one[:3, 3] *= 100
    (tmp_path / "odometry.txt").write_text(listed(kind, times, in_cm))
    begin = START_S if kind == "relative" else 0.0
    (tmp_path / "times.txt").write_text("".join(f"{time_s - begin:.6f}\n" for time_s in times))
    command = ["import", "images", str(folder), str(tmp_path / "PLACE"), "--camera", CAMERA, "--axes", "opengl"]
    command += ["--unit", "0.01", "--odometry", str(tmp_path / "odometry.txt")]
    command += ["--timestamps", str(tmp_path / "times.txt"), "--timestamps-unit", "s"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    session = Capture.open(tmp_path / "PLACE")["ios_query"]
    assert session.odometry is not None
    assert session.ground_truth is None
    np.testing.assert_allclose(session.odometry.world_from_device, true, rtol=0, atol=1e-9)
    assert session.odometry.timestamps[:4].tolist() == session.images["timestamp"].tolist()
    assert set(session.odometry.device_ids) == set(session.device_ids)
    assert check_capture(tmp_path / "PLACE").ok
    assert f"8  poses, from {tmp_path / 'odometry.txt'}" in done.output


def test_a_time_again_counts_once(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text(listed("tum", [START_S + 1, START_S, START_S], [pose(0), pose(1), pose(2)]))
    track = read_track(file, None)
    assert track is not None
    np.testing.assert_allclose(track.poses, [pose(1), pose(0)], rtol=0, atol=1e-9)
    assert track.note == "1 lines repeat a time, of which the first counts"


def test_odometry_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    folder = photos(tmp_path / "photos", "0.png", "1.png")
    times, file, table = (tmp_path / name for name in ("times.txt", "odometry.txt", "t.csv"))
    times.write_text("0.1\n0.1\n")
    rows = [f"{k}.png,PINHOLE,64,48,{50 + k} 50 32 24" for k in range(2)]
    table.write_text("\n".join(["image,model,width,height,params", *rows]))
    near, later, untimed = (
        listed(kind, [start, start + 0.1], [pose(0), pose(1)])
        for kind, start in (("tum", 0.0), ("tum", 5.0), ("kitti", 5.0))
    )
    for text, options, error, named in (
        (later, {}, CaptureError, r"odometry\.txt: no image was taken in its time"),
        ("nothing of the kind\n", {}, CaptureError, r"odometry\.txt: is no list of poses"),
        (untimed, {"timestamps": None, "timestamps_unit": None}, CaptureError, "without times"),
        (later, {"split": "map"}, ManifestError, "is given for a map"),
        (near, {"table": table, "camera": None}, CaptureError, r"odometry\.txt: is of one device, but several"),
    ):
        file.write_text(text)
        given: dict[str, Any] = {"camera": CAMERA, "timestamps": times, "timestamps_unit": "s"} | options
        with pytest.raises(error, match=named):
            import_images(folder, tmp_path / "PLACE", odometry=file, **given)
    assert not (tmp_path / "PLACE").exists()


def test_gps_fixes_of_images_and_of_times(tmp_path: Path) -> None:
    folder = photos(tmp_path / "photos", "0.png", "1.png")
    for number in range(2):
        exif = PIL.Image.Exif()
        exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 30.0, number), 3: "W", 4: (8.0, 0.0, 0.0), 6: 400.0})
        PIL.Image.new("RGB", (64, 48)).save(folder / f"{number}.jpg", exif=exif)
    fixes, times = tmp_path / "fixes.csv", tmp_path / "times.txt"
    times.write_text("".join(f"{number}.{suffix} {number}\n" for number in range(2) for suffix in ("png",)))
    fixes.write_text(
        "image,latitude,longitude,altitude,accuracy\n0.png,47.5,-8,400,3\n1.png,47.5,-8,400,\nx.png,1,2,3,4\n"
    )
    options: dict[str, Any] = {"camera": CAMERA, "only": ["*.png"], "timestamps": times, "timestamps_unit": "s"}
    import_images(folder, tmp_path / "A", fixes=fixes, **options)
    gps = Capture.open(tmp_path / "A")["ios_query"].gps
    assert gps is not None
    assert gps["timestamp"].tolist() == [0, 1_000_000]
    assert gps.iloc[:, 1:].to_numpy().tolist() == [["import/gps", 47.5, -8, 400, 3], ["import/gps", 47.5, -8, 400, 10]]
    fixes.write_text("timestamp,latitude,longitude\n0.5,47.5,-8\n0.7,47.6,-8\n")
    report = import_images(folder, tmp_path / "B", fixes=fixes, **options)
    assert report.record["GPS"] == [2, f"fixes, from {fixes}"]
    gps = Capture.open(tmp_path / "B")["ios_query"].gps
    assert gps is not None
    assert gps["timestamp"].tolist() == [500_000, 700_000]
    import_images(folder, tmp_path / "C", camera=CAMERA, fixes="exif")
    gps = Capture.open(tmp_path / "C")["ios_query"].gps
    assert gps is not None
    assert gps["latitude_deg"].tolist() == pytest.approx([47.5, 47.5 + 1 / 3600])
    for place in "ABC":
        assert check_capture(tmp_path / place).ok
    command = ["import", "images", str(folder), str(tmp_path / "E"), "--camera", CAMERA, "--fixes", "exif"]
    done = CliRunner().invoke(app, [*command, "--timestamps", "names", "--timestamps-unit", "s"])
    assert done.exit_code == 0, done.output
    assert "2  fixes, from exif" in done.output
    rows = ("image,latitude,longitude\n0.png,x,8\n", "image,latitude,longitude\n0.png,91,8\n", "latitude\n47\n")
    odd = "timestamp,latitude,longitude\n1.7F9,47,8\n"
    for bad, named in (*((row, ", line 2") for row in rows), (odd, ": found the time '1.7F9'")):
        fixes.write_text(bad)
        with pytest.raises(CaptureError, match=rf"fixes\.csv{named}"):
            import_images(folder, tmp_path / "D", fixes=fixes, **options)


@pytest.mark.parametrize("own", [False, True])
def test_depth_maps_are_those_of_the_images(own: bool, tmp_path: Path) -> None:
    folder = photos(tmp_path / "photos", *(f"seq/frame-{number:06d}.color.png" for number in range(3)))
    size = (32, 24) if own else (64, 48)
    for number in range(2):
        depth = np.full(size[::-1], 1000 * (number + 1), np.uint16)
        depth[:, : size[0] // 2] = 65535
        depth[:4] = 0
        PIL.Image.fromarray(depth).save(folder / "seq" / f"frame-{number:06d}.depth.png")
    options: dict[str, Any] = {"camera": CAMERA, "only": ["*.color.png"], "depth": folder}
    options |= {"depth_camera": "PINHOLE, 32, 24, 20, 20, 16, 12"} if own else {}
    report = import_images(folder, tmp_path / "PLACE", **options)
    assert report.record["depth maps"][0] == 2
    session = Capture.open(tmp_path / "PLACE")["ios_query"]
    assert check_capture(tmp_path / "PLACE", deep=True).problems == []
    maps = DepthMaps(session)
    for row in range(2):
        seen = maps.of(row)
        assert len(seen) > 50, seen.reason
        np.testing.assert_allclose(seen.depth_m, row + 1, rtol=1e-6)
        assert seen.pixels[:, 0].min() >= 31
    # The other camera has a wider view: its right half is 50 / 20 of the image's, which it fills.
    assert seen.pixels[:, 0].max() > 60
    assert len(maps.of(2)) == 0
    with pytest.raises(CaptureError, match=r"no depth map of an image. Expected that of seq/frame-000000.color.png"):
        import_images(folder, tmp_path / "OTHER", **{**options, "depth": photos(tmp_path / "none", "a.jpg")})


def test_depth_maps_are_found_by_names_and_times(tmp_path: Path) -> None:
    folder = tmp_path
    found = find_depths(folder, ["a/1.png", "v1.0/2.png"], {"a/1.jpg": 0, "v1.0/2.jpg": 0, "v1.0/3.jpg": 0})
    assert found == {"a/1.jpg": folder / "a/1.png", "v1.0/2.jpg": folder / "v1.0/2.png"}
    found = find_depths(folder, ["depth_07.png"], {"rgb/image_07.jpg": 0})
    assert found == {"rgb/image_07.jpg": folder / "depth_07.png"}
    files = [f"depth/{START_S + 0.01 + number / 10:.6f}.png" for number in range(2)]
    times = {"rgb/a.png": round(START_S * 1e6), "rgb/b.png": round((START_S + 0.05) * 1e6)}
    assert find_depths(folder, files, times) == {"rgb/a.png": folder / files[0]}


def test_a_model_takes_times_and_odometry_too(tmp_path: Path) -> None:
    folder = photos(tmp_path / "photos", "0.jpg", "1.jpg", "2.jpg", "3.jpg")
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cameras.txt").write_text("1 PINHOLE 64 48 50 51 32 24\n")
    lines = [f"{k + 1} {words(qt_from_pose(invert(pose(k))))} 1 {k}.jpg\n" for k in range(4)]
    (tmp_path / "model" / "images.txt").write_text("".join(lines))
    (tmp_path / "times.txt").write_text("0\n0.1\n0.2\n0.3\n")
    (tmp_path / "odometry.txt").write_text(listed("tum", [0.1, 0.2, 0.3], [np.eye(4)] * 3))
    options: dict[str, Any] = {"timestamps": tmp_path / "times.txt", "timestamps_unit": "s", "hold_out": 2}
    import_colmap(tmp_path / "model", folder, tmp_path / "PLACE", odometry=tmp_path / "odometry.txt", **options)
    queries = Session.open(tmp_path / "PLACE" / "sessions" / "ios_query")
    assert queries.images["timestamp"].tolist() == [100_000, 300_000]
    assert queries.odometry is not None
    assert len(queries.odometry) == 3
    assert queries.ground_truth is not None
    np.testing.assert_allclose(queries.world_from_cam(ground_truth=True), [pose(1), pose(3)], rtol=0, atol=1e-9)
