"""Data sets of the field, in small copies of the layouts in which they are published."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest
import yaml
from typer.testing import CliRunner

from toolkit.__main__ import app
from toolkit.capture import Capture
from toolkit.capture.check import check_capture
from toolkit.datasets.layouts import LAYOUTS, import_dataset
from toolkit.errors import CaptureError, ManifestError
from toolkit.geometry import Floats, invert, make_pose, qt_from_pose, quaternion_to_rotation
from toolkit.prediction.depths import DepthMaps

Poses = dict[str, Floats]
"""The true world_from_cam by the end of the image's path."""


def pose(number: int) -> Floats:
    rng = np.random.default_rng(number)
    return make_pose(quaternion_to_rotation(rng.normal(size=4)), rng.normal(size=3) * 10)


def photograph(path: Path, size: tuple[int, int] = (64, 48)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    PIL.Image.new("RGB", size, (90, 120, 150)).save(path)
    return path


def two_meters(path: Path, units_per_m: int = 1000) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    PIL.Image.fromarray(np.full((480, 640), 2 * units_per_m, np.uint16)).save(path)


def text(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def words(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def seven_scenes(root: Path) -> Poses:
    scene, poses = root / "chess", dict[str, Floats]()
    for number, name in enumerate(("seq-01/frame-000000", "seq-01/frame-000001", "seq-03/frame-000000")):
        photograph(scene / f"{name}.color.png", (640, 480))
        poses[f"{name}.color.png"] = pose(number)
        text(scene / f"{name}.pose.txt", *map(words, pose(number)))
        two_meters(scene / f"{name}.depth.png")
    photograph(scene / "seq-03" / "frame-000001.color.png", (640, 480))
    text(scene / "seq-03" / "frame-000001.pose.txt", *["nan nan nan nan"] * 4)
    text(scene / "TrainSplit.txt", "sequence1")
    text(scene / "TestSplit.txt", "sequence3")
    return poses


def twelve_scenes(root: Path) -> Poses:
    scene, poses = root / "apt1" / "kitchen", dict[str, Floats]()
    for number in range(3):
        name = f"data/frame-{number:06d}"
        photograph(scene / f"{name}.color.jpg", (1296, 968))
        poses[f"{name}.color.jpg"] = pose(number)
        text(scene / f"{name}.pose.txt", *map(words, pose(number)))
        two_meters(scene / f"{name}.depth.png")
    text(scene / "split.txt", "sequence0 [frames=1]  [start=0 ; end=0]", "sequence1 [frames=2]  [start=1 ; end=2]")
    color, depth = "1170.1 0 647.7 0 0 1170.2 483.7 0", "572 0 320 0 0 572 240 0"
    lines = [f"m_calibrationColorIntrinsic = {color}", f"m_calibrationDepthIntrinsic = {depth}"]
    text(scene / "info.txt", "m_colorWidth = 1296", *lines)
    return poses


def cambridge(root: Path) -> Poses:
    scene, poses = root / "ShopFacade", dict[str, Floats]()
    header = ["Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", ""]
    for number, (file, name) in enumerate((("train", "seq1/frame00001"), ("test", "seq2/frame00007"))):
        photograph(scene / f"{name}.png")
        poses[f"{name}.png"] = pose(number)
        rotation = qt_from_pose(invert(pose(number)))[:4]
        text(scene / f"dataset_{file}.txt", *header, f"{name}.png {words(pose(number)[:3, 3])} {words(rotation)}")
    nvm = [f"{name} {50 + number} 1 0 0 0 0 0 0 -0.1 0" for number, name in enumerate(("seq1/frame00001.jpg",))]
    text(scene / "reconstruction.nvm", "NVM_V3", "", "1", *nvm, "", "0")
    return poses


def colmap(folder: Path, images: Path, names: list[str], suffix: str) -> Poses:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 64, 48))
    for number, name in enumerate(names, start=1):
        image = pycolmap.Image(name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(pose(number))[:3]))
        photograph(images / name)
    folder.mkdir(parents=True)
    (model.write_text if suffix == "txt" else model.write_binary)(str(folder))
    return {name: pose(number) for number, name in enumerate(names, start=1)}


def aachen(root: Path) -> Poses:
    poses = colmap(root / "3D-models" / "aachen_v_1_1", root / "images_upright", ["db/1.jpg", "db/2.jpg"], "bin")
    photograph(root / "images_upright" / "query" / "night" / "a.jpg")
    line = "query/night/a.jpg SIMPLE_RADIAL 64 48 50 32 24 -0.01"
    text(root / "queries" / "night_time_queries_with_intrinsics.txt", line)
    return poses


def eth3d(root: Path) -> Poses:
    scene, folder = root / "facade", "dslr_images_undistorted"
    names = [f"{folder}/{number}.JPG" for number in range(4)]
    return colmap(scene / "dslr_calibration_undistorted", scene / "images", names, "txt")


def tum(root: Path) -> Poses:
    scene, poses = root / "rgbd_dataset_freiburg1_xyz", dict[str, Floats]()
    truth, images = [], ["# color images"]
    for number in range(4):
        time, name = 1305031102.175304 + number / 30, f"rgb/{number}.png"
        photograph(scene / name, (640, 480))
        two_meters(scene / "depth" / f"{time + 0.012:.6f}.png", units_per_m=5000)
        images.append(f"{time:.6f} {name}")
        if number < 3:
            poses[name] = pose(number)
            qt = qt_from_pose(pose(number))
            truth.append(f"{time + 0.004:.4f} {words(qt[4:])} {words(qt[[1, 2, 3, 0]])}")
    text(scene / "rgb.txt", *images)
    text(scene / "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw", *truth)
    return poses


def kitti(root: Path) -> Poses:
    scene, poses, lines = root / "sequences" / "05", dict[str, Floats](), []
    for number in range(4):
        photograph(scene / "image_2" / f"{number:06d}.png")
        # The left color camera is 0.06 m left of the left gray one, whose poses are published.
        poses[f"image_2/{number:06d}.png"] = pose(number) @ make_pose(np.eye(3), [-0.06, 0, 0])
        lines.append(words(pose(number)[:3]))
    text(root / "poses" / "05.txt", *lines)
    text(scene / "times.txt", *(f"{number / 10:e}" for number in range(4)))
    text(scene / "calib.txt", *(f"P{k}: 50 0 32 {50 * x} 0 50 24 0 0 0 1 0" for k, x in enumerate((0, -0.5, 0.06, 0))))
    return poses


def euroc(root: Path) -> Poses:
    cam0, body_from_cam, poses = root / "MH_01" / "mav0" / "cam0", pose(99), dict[str, Floats]()
    truth, images = ["#timestamp, p_RS_R_x [m]"], ["#timestamp [ns],filename"]
    for number in range(4):
        time = 1403636579763555584 + number * 50_000_000
        photograph(cam0 / "data" / f"{time}.png")
        poses[f"{time}.png"] = pose(number) @ body_from_cam
        qt = qt_from_pose(pose(number))
        truth.append(f"{time + 1000}," + words(np.r_[qt[4:], qt[:4], np.zeros(9)]).replace(" ", ","))
        images.append(f"{time},{time}.png")
    text(cam0 / "data.csv", *images)
    text(cam0.parent / "state_groundtruth_estimate0" / "data.csv", *truth)
    sensor = {
        "T_BS": {"rows": 4, "cols": 4, "data": body_from_cam.ravel().tolist()}, "resolution": [64, 48],
        "intrinsics": [50.0, 51.0, 32.0, 24.0], "distortion_coefficients": [-0.1, 0.01, 0.0, 0.0],
    }  # fmt: skip
    text(cam0 / "sensor.yaml", yaml.safe_dump(sensor))
    return poses


WRITERS: dict[str, tuple[Callable[[Path], Poses], str | None, int]] = {
    "7scenes": (seven_scenes, "chess", 1),
    "12scenes": (twelve_scenes, "apt1/kitchen", 1),
    "cambridge": (cambridge, "ShopFacade", 1),
    "aachen": (aachen, None, 1),
    "eth3d": (eth3d, "facade", 2),
    "tum": (tum, "rgbd_dataset_freiburg1_xyz", 1),
    "kitti": (kitti, "sequences/05", 2),
    "euroc": (euroc, "MH_01", 2),
}
"""How each layout is written, the scene, and the number of its queries."""


@pytest.mark.parametrize("kind", LAYOUTS)
def test_a_data_set_becomes_a_capture_with_its_poses_and_thresholds(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, scene, queries = WRITERS[kind]
    poses = write(tmp_path / kind)
    monkeypatch.chdir(tmp_path)
    command = ["import", "dataset", kind, kind, "PLACE", "--hold-out", "2", *(["--scene", scene] if scene else [])]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert check_capture(tmp_path / "PLACE").ok
    capture, found = Capture.open(tmp_path / "PLACE"), dict[str, Floats]()
    for split in ("map", "query"):
        session = capture[f"ios_{split}"]
        known = session.world_from_cam(ground_truth=split == "query")
        found |= dict(zip(session.image_names, known, strict=True))
    assert len(capture["ios_query"]) == queries
    for name, expected in poses.items():
        (match,) = [key for key in found if key.endswith(f"/{name}")]
        np.testing.assert_allclose(found[match], expected, rtol=0, atol=1e-9)
    manifest = yaml.safe_load(Path("data_manifests/PLACE.yaml").read_text())
    assert manifest["evaluate"]["thresholds"] == [list(limit) for limit in LAYOUTS[kind].thresholds]
    assert CliRunner().invoke(app, command).exit_code == 1
    assert CliRunner().invoke(app, [*command, "--replace"]).exit_code == 0


@pytest.mark.parametrize("kind", ["7scenes", "12scenes", "tum"])
def test_depth_maps_of_data_sets_are_in_meters_and_in_their_own_camera(kind: str, tmp_path: Path) -> None:
    write, scene, _ = WRITERS[kind]
    write(tmp_path / kind)
    report = import_dataset(kind, tmp_path / kind, tmp_path / "PLACE", scene, hold_out=2)
    assert report.record["depth maps"][0] == len(report.images[report.images["status"] == "imported"])
    assert check_capture(tmp_path / "PLACE", deep=True).ok
    for name in ("ios_map", "ios_query"):
        session = Capture.open(tmp_path / "PLACE")[name]
        seen = DepthMaps(session).of(0)
        assert len(seen) > 1000, seen.reason
        np.testing.assert_allclose(seen.depth_m, 2, rtol=1e-6)
        # The depth camera of 7-Scenes sees less than that for color, by 525 / 585 of the half width.
        assert (seen.pixels[:, 0].min() > 30) == (kind == "7scenes")


def test_a_split_without_depth_maps_stops_no_other(tmp_path: Path) -> None:
    seven_scenes(tmp_path / "7")
    for path in (tmp_path / "7" / "chess" / "seq-03").glob("*.depth.png"):
        path.unlink()
    report = import_dataset("7scenes", tmp_path / "7", tmp_path / "A", "chess")
    assert report.held_out is not None
    assert report.record["depth maps"][0] == 2
    assert report.held_out.record["depth maps"] is None


def test_images_without_a_pose_are_rows(tmp_path: Path) -> None:
    seven_scenes(tmp_path / "7")
    queries = import_dataset("7scenes", tmp_path / "7", tmp_path / "A", "chess").held_out
    assert queries is not None
    status = queries.images.set_index("image")["status"]
    assert status["seq-03/frame-000001.color.png"] == "frame-000001.pose.txt: no pose in it"
    tum(tmp_path / "tum")
    report = import_dataset("tum", tmp_path / "tum", tmp_path / "B", "rgbd_dataset_freiburg1_xyz", hold_out=2)
    assert report.held_out is not None
    assert [list(one.images["status"]) for one in (report, report.held_out)] == [
        ["imported", "imported"], ["no true pose within 0.02 s", "imported"],
    ]  # fmt: skip
    assert report.record["timestamps"] == [2, "as given"]
    assert report.images["timestamp"].dropna().tolist() == [1305031102175304, 1305031102241971]


def test_only_every_such_image_is_taken(tmp_path: Path) -> None:
    seven_scenes(tmp_path / "7")
    report = import_dataset("7scenes", tmp_path / "7", tmp_path / "A", "chess", every=2)
    assert report.held_out is not None
    assert [list(one.images["image"]) for one in (report, report.held_out)] == [
        ["seq-01/frame-000000.color.png"], ["seq-03/frame-000000.color.png"],
    ]  # fmt: skip
    assert [(one["count"], one["reason"]) for one in report.record["left out"]] == [(2, "not taken by --every")]


def test_what_has_no_effect_on_a_data_set_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`--device`, `--every`, `--masks` and `--json` of strecha were ignored without a word."""
    monkeypatch.chdir(tmp_path)
    for option in (["--device", "hl"], ["--every", "2"], ["--masks", "m"], ["--hold-out", "4"], ["--json"]):
        done = CliRunner().invoke(app, ["import", "dataset", "strecha-hard", ".", "PLACE", *option])
        assert isinstance(done.exception, ManifestError)
        assert str(done.exception) == f"{option[0]}: found an option without effect on this data set. Leave it out."
    done = CliRunner().invoke(app, ["import", "dataset", "strecha", ".", "PLACE", "--scene", "entry"])
    assert "gt_dense_cameras" in str(done.exception), "--scene has one"
    done = CliRunner().invoke(app, ["import", "dataset", "strech", ".", "PLACE"])
    assert re.match(r"KIND: found 'strech'. Did you mean 'strecha'\?.*7scenes.*strecha-hard", str(done.exception))
    assert not list(tmp_path.iterdir())


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    seven_scenes(tmp_path / "7")
    with pytest.raises(ManifestError, match=r"'7scene'. Did you mean '7scenes'"):
        import_dataset("7scene", tmp_path / "7", tmp_path / "A")
    with pytest.raises(CaptureError, match=r"TrainSplit\.txt.*--scene.*chess"):
        import_dataset("7scenes", tmp_path / "7", tmp_path / "A")
    text(tmp_path / "7" / "chess" / "TrainSplit.txt", "sequence1", "sequence9")
    with pytest.raises(CaptureError, match=r"seq-09: no such folder. Unpack"):
        import_dataset("7scenes", tmp_path / "7", tmp_path / "A", "chess")
    text(tmp_path / "7" / "chess" / "TrainSplit.txt", "first")
    with pytest.raises(CaptureError, match=r"TrainSplit\.txt, line 1: found 'first'"):
        import_dataset("7scenes", tmp_path / "7", tmp_path / "A", "chess")
