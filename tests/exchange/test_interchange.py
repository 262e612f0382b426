"""Import: COLMAP models and folders of images become sessions; what cannot be used is said."""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest
from typer.testing import CliRunner

from toolkit.__main__ import app
from toolkit.capture import Capture, Session
from toolkit.capture.check import check_capture
from toolkit.capture.images import camera_from_exif, read_header, read_image, read_number
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.interchange import import_colmap, import_images
from toolkit.geometry import invert, make_pose, pose_from_qt, qt_from_pose, quaternion_to_rotation
from toolkit.scene.query import MapCameras, known_camera

SIZE = (64, 48)
CAMERA = "PINHOLE, 64, 48, 50, 51, 32, 24"
TWO_CAMERAS = "# Camera list\n3 PINHOLE 64 48 50 51 32 24\n8 SIMPLE_RADIAL 64 48 40 32 24 0.01\n"
RIG = make_pose(quaternion_to_rotation([0.9, 0.1, -0.2, 0.3]), [0.11, -0.02, 0.03])  # left from right


def pose(number: int) -> np.ndarray:
    """world_from_cam of an image, far from the origin as real captures are."""
    rng = np.random.default_rng(number)
    return make_pose(quaternion_to_rotation(rng.normal(size=4)), rng.normal(size=3) * 100)


def save(path: Path, size: tuple[int, int] = SIZE, tags: dict[int, object] | None = None, time: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = PIL.Image.Exif()
    for tag, value in (tags or {}).items():
        if tag == 0x0112:
            exif[tag] = value
        else:
            exif.get_ifd(0x8769)[tag] = value
    if time:
        exif.get_ifd(0x8769)[0x9003] = time
    PIL.Image.new("RGB", size, (90, 120, 150)).save(path, exif=exif)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("b/1.jpg", "a/2.jpg", "a/10.png"):
        save(tmp_path / "photos" / name)
    return tmp_path / "photos"


def write_table(path: Path, names: list[str], poses: list[np.ndarray]) -> Path:
    head = "image, qw, qx, qy, qz, tx, ty, tz"
    rows = [f"{name}, {', '.join(map(repr, qt_from_pose(p).tolist()))}" for name, p in zip(names, poses, strict=True)]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def rigid(a_from_b: np.ndarray) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(a_from_b[:3])


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model of a phone with two images and a rig of two cameras with two frames; one image is not in it."""
    made = pycolmap.Reconstruction()
    for camera_id, name in ((1, "SIMPLE_RADIAL"), (2, "OPENCV"), (3, "PINHOLE")):
        camera = pycolmap.Camera.create_from_model_name(camera_id, name, 50.0, *SIZE)
        made.add_camera(camera) if camera_id > 1 else made.add_camera_with_trivial_rig(camera)
    rig = pycolmap.Rig()
    rig.rig_id = 7
    rig.add_ref_sensor(made.camera(2).sensor_id)
    rig.add_sensor(made.camera(3).sensor_id, rigid(invert(RIG)))
    made.add_rig(rig)
    for image_id in (1, 2):
        image = pycolmap.Image(f"phone/{image_id}.jpg", camera_id=1, image_id=image_id)
        made.add_image_with_trivial_frame(image, rigid(invert(pose(image_id))))
    for frame_id, members in ((10, (3, 4)), (11, (5,))):
        frame = pycolmap.Frame()
        frame.frame_id, frame.rig_id = frame_id, 7
        for camera_id, image_id in zip((2, 3), members, strict=False):
            frame.add_data_id(pycolmap.data_t(made.camera(camera_id).sensor_id, image_id))
        frame.rig_from_world = rigid(invert(pose(frame_id)))
        made.add_frame(frame)
        for camera_id, image_id in zip((2, 3), members, strict=False):
            image = pycolmap.Image(f"rig/{image_id}.jpg", camera_id=camera_id, image_id=image_id)
            image.frame_id = frame_id
            made.add_image(image)
    (tmp_path / "model").mkdir()
    made.write_text(str(tmp_path / "model"))
    for name in ("phone/1", "phone/2", "rig/3", "rig/4", "rig/5", "phone/6"):
        save(tmp_path / "photos" / f"{name}.jpg")
    return tmp_path / "model"


def poses_of(session: Session) -> dict[str, np.ndarray]:
    poses = session.world_from_cam(ground_truth=session.split == "query")
    return {path.split("/images/")[1]: p for path, p in zip(session.images["path"], poses, strict=True)}


# ------------------------------------------------------------------------------------------------ COLMAP models


def test_a_colmap_model_keeps_its_camera_centers_and_rigs(model: Path, tmp_path: Path) -> None:
    report = import_colmap(model, tmp_path / "photos", tmp_path / "PLACE", device="hl")
    session = Capture.open(tmp_path / "PLACE")["hl_map"]
    reference = pycolmap.Reconstruction(str(model))
    found = poses_of(session)
    assert len(found) == 5
    for name, world_from_cam in found.items():
        image = reference.find_image_with_name(name)
        np.testing.assert_allclose(world_from_cam[:3, 3], image.projection_center(), rtol=0, atol=1e-9)
        expected = invert(make_pose(image.cam_from_world().rotation.matrix(), image.cam_from_world().translation))
        np.testing.assert_allclose(world_from_cam, expected, rtol=0, atol=1e-9)
    # The second camera of the rig, from the numbers that the model was made of.
    np.testing.assert_allclose(found["rig/4.jpg"], pose(10) @ RIG, rtol=0, atol=1e-9)
    assert session.rigs is not None
    assert session.rigs.to_numpy().tolist() == [["import/rig_7", "import/cam_2"], ["import/rig_7", "import/cam_3"]]
    assert sorted(set(session.device_ids)) == ["import/cam_1", "import/rig_7"]
    assert session.camera("import/cam_2").model.name == "OPENCV"
    assert session.camera("import/cam_1").params.tolist() == reference.camera(1).params.tolist()
    assert check_capture(tmp_path / "PLACE").problems == []
    assert "5  used of 6 in" in report.text()
    assert "1  not in the model (phone/6.jpg)" in report.text()
    assert {one["from"] for one in report.record["cameras"]} == {"given by the model"}
    assert "made up" in report.record["timestamps"][1]


def test_a_sensor_of_a_rig_without_a_pose_is_left_out(model: Path, tmp_path: Path) -> None:
    made = pycolmap.Reconstruction(str(model))
    camera = pycolmap.Camera.create_from_model_name(4, "PINHOLE", 50.0, *SIZE)
    made.add_camera(camera)
    made.rig(7).add_sensor(camera.sensor_id, None)
    made.write_text(str(model))
    import_colmap(model, tmp_path / "photos", tmp_path / "PLACE", device="hl")
    session = Capture.open(tmp_path / "PLACE")["hl_map"]
    assert session.rigs is not None
    assert list(session.rigs["sensor_id"]) == ["import/cam_2", "import/cam_3"]
    assert len(poses_of(session)) == 5


def test_images_of_a_model_that_cannot_be_used_are_rows(model: Path, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    (photos / "phone" / "1.jpg").unlink()
    (photos / "phone" / "2.jpg").write_bytes(b"no image")
    save(photos / "rig" / "3.jpg", (32, 24))
    save(photos / "rig" / "4.jpg", SIZE[::-1], {0x0112: 6})
    report = import_colmap(model, photos, tmp_path / "PLACE")
    status = report.images.set_index("image")["status"]
    assert status["phone/1.jpg"] == "no such file"
    assert status["phone/2.jpg"] == "cannot be read as an image (of no known format, or damaged)"
    assert report.record["poses"] == report.record["used"] == 1
    assert status["rig/3.jpg"].startswith("the image is stored as 32 x 24 pixels, its camera has 64 x 48; use")
    assert status["rig/4.jpg"].endswith("rotate the pixels and remove the EXIF orientation")
    assert status["rig/5.jpg"] == "imported"
    session = report.session
    assert len((session / "proc" / "import.csv").read_text().splitlines()) == 6
    assert check_capture(tmp_path / "PLACE").ok
    (photos / "rig" / "5.jpg").unlink()
    with pytest.raises(CaptureError, match=r"phone/1\.jpg: no such file"):
        import_colmap(model, photos, tmp_path / "OTHER")
    assert not list((tmp_path / "OTHER").rglob("*"))


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=f"^{tmp_path}: "):
        import_colmap(tmp_path, tmp_path, tmp_path / "PLACE")


# ------------------------------------------------------------------------------------------------ folders of images


@pytest.mark.parametrize("direction", ["world_from_cam", "cam_from_world"])
def test_a_table_of_poses_becomes_a_map(folder: Path, tmp_path: Path, direction: str) -> None:
    names = ["a/10.png", "b/1.jpg"]
    poses = {name: pose(number) for number, name in enumerate(names)}
    written = [p if direction == "world_from_cam" else invert(p) for p in poses.values()]
    table = write_table(tmp_path / "poses.csv", names, written)
    options = {"split": "map", "table": table, "poses_are": direction, "camera": CAMERA}
    import_images(folder, tmp_path / "PLACE", **options)  # type: ignore[arg-type]
    session = Capture.open(tmp_path / "PLACE")["ios_map"]
    found = poses_of(session)
    assert sorted(found) == names
    for name in names:
        np.testing.assert_allclose(found[name], poses[name], rtol=0, atol=1e-12)
    assert session.camera("import/cam_1").params.tolist() == [50, 51, 32, 24]
    assert check_capture(tmp_path / "PLACE").problems == []


@pytest.mark.parametrize("direction", ["world_from_cam", "cam_from_world"])
def test_poses_may_have_the_axes_of_opengl_and_another_unit(folder: Path, tmp_path: Path, direction: str) -> None:
    """In centimeters, of a camera that has y up and looks along -z."""
    true = pose(3)
    written = true @ np.diag([1.0, -1.0, -1.0, 1.0])
    written[:3, 3] *= 100
    written = written if direction == "world_from_cam" else invert(written)
    table = write_table(tmp_path / "poses.csv", ["b/1.jpg"], [written])
    command = ["import", "images", str(folder), str(tmp_path / "PLACE"), "--split", "map", "--table", str(table)]
    command += ["--camera", CAMERA, "--axes", "opengl", "--unit", "0.01", "--poses-are", direction]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    found = poses_of(Capture.open(tmp_path / "PLACE")["ios_map"])
    np.testing.assert_allclose(found["b/1.jpg"], true, rtol=0, atol=1e-9)


def test_the_truth_of_queries_is_in_their_table_or_in_a_file(folder: Path, tmp_path: Path) -> None:
    names = ["a/2.jpg", "b/1.jpg"]
    truth = write_table(tmp_path / "truth.csv", names, [pose(1), pose(2)])
    import_images(folder, tmp_path / "ONE", table=truth, camera=CAMERA)
    report = import_images(folder, tmp_path / "TWO", truth=truth, camera=CAMERA)
    assert f"ground truth of 2 of 3 images: {truth}" in report.text()
    one, two = (poses_of(Capture.open(tmp_path / name)["ios_query"]) for name in ("ONE", "TWO"))
    for name, expected in zip(names, (pose(1), pose(2)), strict=True):
        np.testing.assert_allclose(one[name], expected, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(two[name], one[name])
    assert np.isnan(two["a/10.png"]).all()
    assert len(Capture.open(tmp_path / "TWO")["ios_query"].keyframes()) == 3
    assert check_capture(tmp_path / "TWO").ok


def test_a_folder_becomes_queries_without_ground_truth(folder: Path, tmp_path: Path) -> None:
    report = import_images(folder, tmp_path / "PLACE", "drone", camera=CAMERA)
    session = Capture.open(tmp_path / "PLACE")["drone_query"]
    assert session.ground_truth is None
    assert len(session.keyframes()) == 3
    assert session.images["path"].tolist() == [f"import/images/{name}" for name in ("a/10.png", "a/2.jpg", "b/1.jpg")]
    assert session.images["timestamp"].tolist() == [1_000_000, 2_000_000, 3_000_000]
    assert session.subsessions == ["import"]
    assert "of 3 images: PINHOLE, 64 x 48, focal length 50.5 px: given by --camera" in report.text()
    assert session.image_path(0).is_symlink()


def test_images_can_be_copied(folder: Path, tmp_path: Path) -> None:
    report = import_images(folder, tmp_path / "PLACE", camera=CAMERA, placing="copy")
    path = report.session / "raw_data" / "import" / "images" / "a" / "2.jpg"
    assert not path.is_symlink()
    assert path.read_bytes() == (folder / "a" / "2.jpg").read_bytes()


def test_a_list_of_queries_of_hloc_is_a_table(folder: Path, tmp_path: Path) -> None:
    names = ["a/2.jpg", "b/1.jpg"]
    lines = [f"{name} SIMPLE_RADIAL 64 48 {50 + number} 30 20.5 -0.01" for number, name in enumerate(names)]
    table = tmp_path / "queries_with_intrinsics.txt"
    table.write_text("\n".join(lines) + "\n")
    cameras = import_images(folder, tmp_path / "ONE", split="query", table=table).images.set_index("image")["camera"]
    expected = [f"SIMPLE_RADIAL, 64, 48, {50 + number}.0, 30.0, 20.5, -0.01" for number in range(2)]
    assert cameras[names].tolist() == expected
    table.write_text("\n".join([lines[0], lines[1].replace("-0.01", "x")]))
    status = import_images(folder, tmp_path / "TWO", split="query", table=table).images.set_index("image")["status"]
    assert status["a/2.jpg"] == "imported"
    assert "queries_with_intrinsics.txt, line 2" in status["b/1.jpg"]


def test_rotations_of_cam_from_world_with_camera_centers(folder: Path, tmp_path: Path) -> None:
    names = ["a/2.jpg", "a/10.png", "b/1.jpg"]
    given = [make_pose(pose(k)[:3, :3].T, pose(k)[:3, 3]) for k in range(3)]
    table = write_table(tmp_path / "t.csv", names, given)
    options = {"split": "map", "table": table, "camera": CAMERA, "poses_are": "rotation_of_cam_from_world"}
    import_images(folder, tmp_path / "PLACE", **options)
    found = poses_of(Capture.open(tmp_path / "PLACE")["ios_map"])
    for k, name in enumerate(names):
        np.testing.assert_allclose(found[name], pose(k), rtol=0, atol=1e-9)


def test_a_row_that_cannot_be_used_leaves_the_others(folder: Path, tmp_path: Path) -> None:
    table = tmp_path / "t.csv"
    table.write_text(
        "image,qw,qx,qy,qz,tx,ty,tz,camera_id\na/2.jpg,nan,0,0,0,1,2,3,1\na/10.png,0.707,0.707,0,0,1,2,3,1\n"
        "b/1.jpg,1,0,0,0,1,2,3,2\n"
    )
    cameras = tmp_path / "cameras.txt"
    cameras.write_bytes("1 PINHOLE 64 48 50 51 32 24\r\n2 PINHOLE 64 48 0 51 32 24\r\n".encode("utf-16"))
    report = import_images(folder, tmp_path / "PLACE", split="map", table=table, cameras=cameras)
    status = report.images.set_index("image")["status"]
    assert status["a/10.png"] == "imported"
    assert "line 2" in status["a/2.jpg"]
    assert "cameras.txt, line 2" in status["b/1.jpg"]
    rotation = poses_of(Capture.open(tmp_path / "PLACE")["ios_map"])["a/10.png"][:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    truth = tmp_path / "truth.csv"
    truth.write_text("image,qw,qx,qy,qz,tx,ty,tz\na/2.jpg,0,0,0,0,1,2,3\na/10.png,1,0,0,0,1,2,3\n")
    report = import_images(folder, tmp_path / "PLACE", camera=CAMERA, truth=truth)
    assert (report.images["status"] == "imported").all()
    assert any("1 images have no usable ground truth; first: a/2.jpg: line 2" in note for note in report.notes)


def test_a_table_in_utf16_is_read(folder: Path, tmp_path: Path) -> None:
    table = write_table(tmp_path / "t.csv", ["a/2.jpg"], [pose(0)])
    table.write_bytes(table.read_text().encode("utf-16"))
    import_images(folder, tmp_path / "PLACE", split="map", table=table, camera=CAMERA)
    np.testing.assert_allclose(poses_of(Capture.open(tmp_path / "PLACE")["ios_map"])["a/2.jpg"], pose(0), atol=1e-9)


def test_the_unit_and_the_axes_of_a_model(model: Path, tmp_path: Path) -> None:
    report = import_colmap(model, tmp_path / "photos", tmp_path / "A", device="hl")
    assert "unknown: relative to the depth of the scene" in report.text()
    assert Capture.open(tmp_path / "A").unit is None
    report = import_colmap(model, tmp_path / "photos", tmp_path / "B", device="hl", unit_m=0.5, axes="opengl")
    assert "m, from --unit 0.5" in report.text()
    assert Capture.open(tmp_path / "B").unit == "m"
    given, found = (poses_of(Capture.open(tmp_path / place)["hl_map"]) for place in "AB")
    assert given.keys() == found.keys()
    for name in given:
        expected = given[name] @ np.diag([1.0, -1, -1, 1])
        expected[:3, 3] *= 0.5
        np.testing.assert_allclose(found[name], expected, rtol=0, atol=1e-9)


def test_frames_are_held_out_as_queries(model: Path, tmp_path: Path, folder: Path) -> None:
    whole = import_colmap(model, tmp_path / "photos", tmp_path / "WHOLE", device="hl")
    report = import_colmap(model, tmp_path / "photos", tmp_path / "PLACE", device="hl", hold_out=2)
    capture = Capture.open(tmp_path / "PLACE")
    assert report.held_out is not None
    assert f"{report.held_out.session}" in report.text()
    parts = [poses_of(capture[name]) for name in ("hl_map", "hl_query")]
    assert sorted(parts[1]) == ["phone/2.jpg", "rig/5.jpg"], "the second and fourth frame"
    expected = poses_of(Capture.open(whole.session.parents[1])["hl_map"])
    assert parts[0].keys() | parts[1].keys() == expected.keys()
    for name, one in (parts[0] | parts[1]).items():
        np.testing.assert_array_equal(one, expected[name])
    assert check_capture(tmp_path / "PLACE").errors == []
    table = write_table(tmp_path / "t.csv", ["a/2.jpg", "a/10.png", "b/1.jpg"], [pose(k) for k in range(3)])
    options = {"split": "map", "table": table, "camera": CAMERA}
    report = import_images(folder, tmp_path / "TABLE", hold_out=3, **options)
    assert list(report.images["image"]) == ["a/2.jpg", "a/10.png"]


@pytest.mark.parametrize(
    ("listed", "stored", "flag"),
    [
        ("A/IMG.JPG", "a/img.jpg", True),
        ("a/img.png", "a/img.jpg", True),
        ("a\\img.jpg", "a/img.jpg", True),
        ("a/caf\u00e9.jpg", "a/cafe\u0301.jpg", False),
        ("a/cafe\u0301.jpg", "a/caf\u00e9.jpg", False),
        ("A/caf\u00e9.png", "a/cafe\u0301.jpg", True),
    ],
)
def test_names_that_differ_a_little_from_their_files(listed: str, stored: str, flag: bool, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    save(photos / stored)
    save(photos / "other.jpg")
    table = write_table(tmp_path / "t.csv", [listed], [pose(3)])
    options = {"split": "map", "table": table, "camera": CAMERA}
    if flag:
        with pytest.raises(CaptureError, match=r"1 images differ from their files in case.*--match-names"):
            import_images(photos, tmp_path / "PLACE", **options)
    report = import_images(photos, tmp_path / "PLACE", match_names=flag, **options)
    assert list(report.images["image"]) == [stored]
    assert any("names of 1 images differ" in note for note in report.notes)
    np.testing.assert_allclose(poses_of(Capture.open(tmp_path / "PLACE")["ios_map"])[stored], pose(3), atol=1e-9)


@pytest.mark.parametrize("root", ["/home/me/photos/", "C:\\photos\\", "./"])
def test_paths_of_another_machine_are_found_by_their_ends(root: str, tmp_path: Path) -> None:
    """As in a transforms.json; of a model or a table, the images were left out."""
    photos = tmp_path / "photos"
    save(photos / "a.jpg")
    save(photos / "b" / "c.jpg")
    names = [root + "a.jpg", root + ("b\\c.jpg" if "\\" in root else "b/c.jpg"), "/home/other/b/c.png"]
    table = write_table(tmp_path / "t.csv", names, [pose(3), pose(4), pose(5)])
    report = import_images(photos, tmp_path / "PLACE", split="map", table=table, camera=CAMERA)
    status = report.images.set_index("image")["status"]
    assert status.to_dict() == {
        "a.jpg": "imported", "b/c.jpg": "imported", names[2]: "not a path inside the folder of images"
    }  # fmt: skip
    np.testing.assert_allclose(poses_of(Capture.open(tmp_path / "PLACE")["ios_map"])["b/c.jpg"], pose(4), atol=1e-9)
    assert any("2 images have paths of another machine" in note for note in report.notes) == (root != "./")


@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_table_may_be_separated_as_spreadsheets_do(separator: str, tmp_path: Path) -> None:
    save(tmp_path / "photos" / "a.jpg")
    table = write_table(tmp_path / "t.csv", ["a.jpg"], [pose(3)])
    table.write_text(table.read_text().replace(",", separator))
    report = import_images(tmp_path / "photos", tmp_path / "PLACE", split="map", table=table, camera=CAMERA)
    assert report.images["status"].tolist() == ["imported"]


def test_names_that_are_not_utf8(tmp_path: Path) -> None:
    save(tmp_path / "photos" / "caf\u00e9.jpg")
    (tmp_path / "photos" / "m\udcfcller.jpg").write_bytes((tmp_path / "photos" / "caf\u00e9.jpg").read_bytes())
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cameras.txt").write_text("1 PINHOLE 64 48 50 51 32 24\n")
    lines = "1 1 0 0 0 1 2 3 1 caf\u00e9.jpg\n\n2 1 0 0 0 1 2 3 1 m\u00fcller.jpg\n\n"
    (tmp_path / "model" / "images.txt").write_text(lines, encoding="cp1252")
    report = import_colmap(tmp_path / "model", tmp_path / "photos", tmp_path / "PLACE")
    status = report.images.set_index("image")["status"]
    assert status["caf\u00e9.jpg"] == "imported"
    assert "not UTF-8" in status.drop("caf\u00e9.jpg").iloc[0]


def test_names_that_fit_two_files_are_not_guessed(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for name in ("img.jpg", "IMG.png", "good.jpg"):
        save(photos / name)
    table = write_table(tmp_path / "t.csv", ["Img.jpg", "good.jpg"], [pose(3), pose(4)])
    report = import_images(photos, tmp_path / "PLACE", split="map", table=table, camera=CAMERA, match_names=True)
    assert report.images.set_index("image")["status"].to_dict() == {"Img.jpg": "no such file", "good.jpg": "imported"}


def test_files_that_are_not_photographs_are_said(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for name in ("x.heic", "y.HEIC", "z.gif"):
        (folder / name).write_bytes(b"anything")
    (folder / "caf\udce9.jpg").write_bytes(b"not Unicode")
    PIL.Image.new("RGB", SIZE).save(folder / "t.tiff")
    report = import_images(folder, tmp_path / "PLACE", camera=CAMERA)
    assert sorted(report.images["image"]) == ["a/10.png", "a/2.jpg", "b/1.jpg", "t.tiff"]
    assert (report.images["status"] == "imported").all()
    text = report.text()
    assert "2  .heic is not read: pip install pillow-heif, or convert" in text, "a package that a registry has"
    assert "1  .gif is not read" in text
    assert "1  its name is not UTF-8" in text
    assert check_capture(tmp_path / "PLACE", deep=True).problems == []


@pytest.mark.parametrize(("size", "said"), [((62, 47), "cropped"), ((32, 24), "by 0.5"), ((128, 96), "by 2")])
def test_a_crop_is_not_a_smaller_image(size: tuple[int, int], said: str, tmp_path: Path) -> None:
    save(tmp_path / "photos" / "a.jpg", size)
    save(tmp_path / "photos" / "b.jpg")
    status = import_images(tmp_path / "photos", tmp_path / "PLACE", camera=CAMERA).images.set_index("image")["status"]
    assert said in status["a.jpg"]
    assert ("multiply" in status["a.jpg"]) == (said != "cropped")


def test_heic_is_read_with_its_package(folder: Path, tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    shade = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (48, 1))
    PIL.Image.fromarray(np.stack([shade] * 3, axis=-1)).save(folder / "p.HEIC", quality=95)
    report = import_images(folder, tmp_path / "PLACE", camera=CAMERA)
    assert "p.HEIC.png" in set(report.images["image"])
    path = tmp_path / "PLACE" / "sessions" / "ios_query" / "raw_data" / "import" / "images" / "p.HEIC.png"
    assert np.abs(read_image(path, gray=True).astype(int) - shade).max() < 16
    assert check_capture(tmp_path / "PLACE", deep=True).problems == []


def test_depth_and_masks_beside_photographs(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    rng = np.random.default_rng(0)
    for k in range(2):
        color = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
        (photos / "masks").mkdir(parents=True, exist_ok=True)
        PIL.Image.fromarray(color).save(photos / f"{k}.color.png")
        PIL.Image.fromarray((color[..., 0] * 255).astype(np.uint16)).save(photos / f"{k}.depth.png")
        PIL.Image.fromarray(np.uint8(255) * (color[..., 0] > 99).astype(np.uint8)).save(photos / "masks" / f"{k}.png")
    report = import_images(photos, tmp_path / "A", camera=CAMERA)
    assert "have 16 bits or few values" in report.text()
    for place, options in (("B", {"only": ["*.color.png"]}), ("C", {"skip": ["*.depth.png", "masks/*"]})):
        report = import_images(photos, tmp_path / place, camera=CAMERA, **options)
        assert list(report.images["image"]) == ["0.color.png", "1.color.png"]
        assert "16 bits" not in report.text()
        assert "4  by --only and --skip" in report.text()


def test_depth_in_meters_and_confidence_beside_photographs(folder: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(3):
        PIL.Image.fromarray(rng.random((48, 64), np.float32)).save(folder / f"{k}.tiff")
        PIL.Image.fromarray(rng.integers(0, 3, (48, 64)).astype(np.uint8)).save(folder / f"{k}.confidence.png")
    report = import_images(folder, tmp_path / "A", camera=CAMERA)
    assert "have 16 bits or few values, like depth, confidence" in report.text()


def test_a_capture_in_the_folder_of_photographs_is_skipped(folder: Path) -> None:
    for place in (folder / "place", folder):
        import_images(folder, place, camera=CAMERA)
        report = import_images(folder, place, "spot", camera=CAMERA)
        assert len(report.images) == 3
        assert any("captures in the folder" in note for note in report.notes)


def test_cameras_come_from_a_file_or_the_table(folder: Path, tmp_path: Path) -> None:
    cameras = tmp_path / "cameras.txt"
    cameras.write_text(TWO_CAMERAS)
    table = tmp_path / "t.csv"
    table.write_text("image,camera_id\na/2.jpg,8\nb/1.jpg,3\na/10.png,8\n")
    report = import_images(folder, tmp_path / "ONE", table=table, cameras=cameras)
    cams = report.images.set_index("image")["camera"]
    assert cams["a/2.jpg"] == cams["a/10.png"] == "SIMPLE_RADIAL, 64, 48, 40.0, 32.0, 24.0, 0.01"
    assert report.images["sensor_id"].nunique() == 2
    equal = tmp_path / "equal.txt"  # RealityScan writes a camera for each image
    equal.write_text("3 PINHOLE 64 48 50 51 32 24\n8 PINHOLE 64 48 50 51 32 24\n")
    assert import_images(folder, tmp_path / "EQUAL", cameras=equal).images["sensor_id"].nunique() == 1
    table.write_text("image,model,width,height,params\na/2.jpg,PINHOLE,64,48,50 51 32 24\n")
    assert len(import_images(folder, tmp_path / "TWO", table=table).images) == 1


# Known answers: 26 mm on film is 26/43.27 of the diagonal; 5 mm at 100 pixels a millimeter is 500 pixels.
@pytest.mark.parametrize(
    ("tags", "focal", "how"),
    [
        ({0xA405: 26, 0x920A: 4.2}, 26 * 80 / np.sqrt(36**2 + 24**2), "FocalLengthIn35mmFilm"),
        ({0x920A: 5.0, 0xA20E: 1000.0, 0xA210: 3}, 500.0, "FocalPlaneXResolution"),
        ({0x920A: 5.0, 0xA20E: 2540.0, 0xA002: 128}, 250.0, "FocalPlaneXResolution"),
    ],
)
def test_a_focal_length_is_guessed_from_exif(tmp_path: Path, tags: dict[int, object], focal: float, how: str) -> None:
    camera, said, cropped = camera_from_exif(*read_header(save(tmp_path / "x.jpg", tags=tags)))
    assert not cropped
    assert camera.params.tolist() == pytest.approx([focal, 32, 24], rel=1e-12)
    assert said.startswith("a guess from EXIF (")
    assert how in said


def test_images_without_a_focal_length_are_left_out(folder: Path, tmp_path: Path) -> None:
    save(folder / "c.jpg", tags={0xA405: 30})
    report = import_images(folder, tmp_path / "PLACE")
    left_out = report.images["status"][report.images["status"].str.startswith("no focal length in EXIF: give ")]
    assert len(left_out) == 3
    # What is given so is taken.
    camera = left_out.iloc[0].split("such as '")[1].split("'")[0].replace("FOCAL_PX", "50")
    assert "--camera 'MODEL,W,H,...'" in left_out.iloc[0]
    assert import_images(folder, tmp_path / "OTHER", camera=camera).images["status"].eq("imported").all()
    assert "of 1 images: SIMPLE_PINHOLE, 64 x 48, focal length 55.5 px: a guess from EXIF" in report.text()
    assert read_number({1: "many", 2: float("inf")}, 1) == read_number({2: float("inf")}, 2) == 0


def test_queries_without_intrinsics_are_of_the_camera_of_the_map_that_took_them(tmp_path: Path) -> None:
    """After `reconstruct`, the map's cameras are known better than EXIF tells them; folders tell cameras apart."""
    phone = {0xA405: 26, 0x920A: 4.2}
    focals = {"map/left/1.jpg": 50.0, "map/left/2.jpg": 50.0, "map/right/1.jpg": 60.0, "map/phone/1.jpg": 55.0}
    for name in focals:
        save(tmp_path / name, tags=phone if "phone" in name else None)
    rows = [f"{name[4:]},1,0,0,0,{number},0,0,PINHOLE,64,48,{focal} {focal} 31 25"
            for number, (name, focal) in enumerate(focals.items())]  # fmt: skip
    table = tmp_path / "map.csv"
    table.write_text("\n".join(["image,qw,qx,qy,qz,tx,ty,tz,model,width,height,params", *rows]) + "\n")
    import_images(tmp_path / "map", tmp_path / "PLACE", split="map", table=table)
    asked = {"left/9.jpg": None, "right/9.jpg": None, "other/9.jpg": None, "phone/9.jpg": phone, "else/9.jpg": phone,
             "zoomed/9.jpg": {0xA405: 52, 0x920A: 4.2}}  # fmt: skip
    for name, tags in asked.items():
        save(tmp_path / "queries" / name, tags=tags)
    save(tmp_path / "queries" / "small/9.jpg", (32, 24))
    images = import_images(tmp_path / "queries", tmp_path / "PLACE").images.set_index("image")
    session = Capture.open(tmp_path / "PLACE")["ios_query"]
    names = [path.split("/images/")[1] for path in session.images["path"]]
    found = {name: camera.params.tolist() for name, camera in zip(names, session.cameras(), strict=True)}
    assert {name: params[0] for name, params in found.items()} == pytest.approx(
        {"left/9.jpg": 50, "right/9.jpg": 60, "phone/9.jpg": 55, "else/9.jpg": 55, "zoomed/9.jpg": 96.15}, abs=0.01
    )
    assert found["left/9.jpg"] == [50, 50, 31, 25]
    assert images["status"][["other/9.jpg", "small/9.jpg"]].str.startswith("no focal length in EXIF").all()


def import_map(folder: Path, focals: dict[str, float], tags: dict[str, dict[int, object]]) -> Path:
    """Import a map of images with known intrinsics, and return its session."""
    rows = ["image,qw,qx,qy,qz,tx,ty,tz,model,width,height,params"]
    for number, (name, focal) in enumerate(focals.items()):
        save(folder / "map" / name, tags=tags.get(name))
        rows.append(f"{name},1,0,0,0,{number},0,0,PINHOLE,64,48,{focal} {focal} 32 24")
    (folder / "map.csv").write_text("\n".join(rows) + "\n")
    import_images(folder / "map", folder / "PLACE", split="map", table=folder / "map.csv")
    return folder / "PLACE/sessions/ios_map"


def test_a_camera_of_the_map_is_known_by_all_its_folders(tmp_path: Path) -> None:
    """Recordings with equal intrinsics share a camera; only the folder of its first image was compared."""
    import_map(tmp_path, {"first/1.jpg": 50.0, "second/1.jpg": 50.0, "third/1.jpg": 60.0}, {})
    for name in ("first", "second", "third", "fourth"):
        save(tmp_path / f"queries/{name}/9.jpg")
    images = import_images(tmp_path / "queries", tmp_path / "PLACE").images.set_index("image")["status"]
    assert images[images == "imported"].index.tolist() == ["first/9.jpg", "second/9.jpg", "third/9.jpg"]


@pytest.mark.parametrize("other", [{0x920A: 50.0}, {0x010F: "Other"}])
def test_the_camera_of_the_map_is_not_one_that_exif_contradicts(tmp_path: Path, other: dict[int, object]) -> None:
    """Of equal size, and with a lens or maker that EXIF tells, without a focal length in pixels."""
    import_map(tmp_path, {"1.jpg": 50.0}, {"1.jpg": {0x920A: 24.0, 0x010F: "Maker"}})
    save(tmp_path / "queries/other.jpg", tags=other)
    save(tmp_path / "queries/same.jpg", tags={0x010F: "Maker"})
    save(tmp_path / "queries/without.jpg")
    images = import_images(tmp_path / "queries", tmp_path / "PLACE").images.set_index("image")["status"]
    assert images.drop("other.jpg").eq("imported").all()
    assert images["other.jpg"].startswith("no focal length in EXIF")


@pytest.mark.parametrize("torn", ["sensors.txt", "images.txt"])
def test_queries_are_imported_beside_a_map_that_cannot_be_read(tmp_path: Path, torn: str) -> None:
    session = import_map(tmp_path, {"1.jpg": 50.0}, {})
    (session / torn).write_text("# none\ntorn\n")
    save(tmp_path / "queries/1.jpg", tags={0xA405: 26})
    report = import_images(tmp_path / "queries", tmp_path / "PLACE")
    assert report.images["status"].tolist() == ["imported"]
    assert any(note.startswith("ios_map cannot be read") and torn in note for note in report.record["notes"])


def test_two_estimates_of_one_camera_are_one_and_a_sensor_without_images_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a map that grew has them: then no query without EXIF could be imported."""
    rows = ["image,qw,qx,qy,qz,tx,ty,tz,model,width,height,params"]
    for number, focal in enumerate([50.0, 50.2]):
        name = save(tmp_path / f"map/{number}/1.jpg").relative_to(tmp_path / "map")
        rows.append(f"{name},1,0,0,0,{number},0,0,PINHOLE,64,48,{focal} {focal} 31 25")
    (tmp_path / "map.csv").write_text("\n".join(rows) + "\n")
    import_images(tmp_path / "map", tmp_path / "PLACE", split="map", table=tmp_path / "map.csv")
    with (tmp_path / "PLACE/sessions/ios_map/sensors.txt").open("a") as stream:
        stream.write("unused, , camera, PINHOLE, 64, 48, 90, 90, 31, 25\n")
    monkeypatch.chdir(save(tmp_path / "queries/9.jpg").parent)
    report = import_images(Path(), tmp_path / "PLACE")
    assert report.record["cameras"][0]["focal_px"] == [50.0]
    mapped = MapCameras(Capture.open(tmp_path / "PLACE")["ios_map"])
    assert known_camera("9.jpg", mapped).camera.mean_focal_length() == 50.0


def test_an_image_of_absurd_size_is_a_row(folder: Path, tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0))
    (folder / "absurd.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    for camera in (CAMERA, None):
        save(folder / "c.jpg", tags={0xA405: 30})
        report = import_images(folder, tmp_path / f"PLACE-{camera is None}", camera=camera)
        status = report.images.set_index("image")["status"]
        assert status["absurd.png"] == "cannot be read as an image (30000 x 30000 pixels, more than 268,435,456)"
        assert status["c.jpg"] == "imported"


def test_photographs_of_200_megapixels_are_imported(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    path = save(tmp_path / "photos" / "large.jpg", tags={0xA405: 26})
    content = path.read_bytes()
    place = content.index(b"\xff\xc0") + 5  # height and width in the frame header
    path.write_bytes(content[:place] + struct.pack(">HH", 12240, 16320) + content[place + 4 :])
    row = import_images(tmp_path / "photos", tmp_path / "PLACE").images.iloc[0]
    assert row["status"] == "imported"
    assert row["camera"].startswith("SIMPLE_PINHOLE, 16320, 12240, ")
    assert not recwarn.list


def test_time_zones_that_change_are_applied(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    save(photos / "a.jpg", time="2026:10:25 02:10:00", tags={0x9011: "+02:00"})
    save(photos / "b.jpg", time="2026:10:25 02:05:00", tags={0x9011: "+01:00"})  # an hour later, less 5 minutes
    report = import_images(photos, tmp_path / "PLACE", camera=CAMERA)
    times = report.images.set_index("image")["timestamp"]
    assert times["b.jpg"] - times["a.jpg"] == 55 * 60 * 10**6
    assert "time zone" in report.record["timestamps"][1]
    save(photos / "b.jpg", time="2026:10:25 02:15:00", tags={0x9011: "+02:00"})
    report = import_images(photos, tmp_path / "SAME", camera=CAMERA)
    assert report.images.set_index("image")["timestamp"]["a.jpg"] == times["a.jpg"] + 2 * 3600 * 10**6, "the clock's"


def test_a_crop_keeps_the_focal_length_of_the_whole_image(tmp_path: Path) -> None:
    tags = {0xA405: 28, 0xA002: 128, 0xA003: 96}
    whole = 28 * np.hypot(128, 96) / np.hypot(36, 24)
    sizes = {"crop": ((64, 30), whole), "turned": ((96, 128), whole), "small": ((64, 48), whole / 2)}
    for name, (size, expected) in sizes.items():
        camera, said, cropped = camera_from_exif(*read_header(save(tmp_path / f"{name}.jpg", size, tags)))
        assert camera.params[0] == pytest.approx(expected)
        assert ("cropped" in said) == cropped == (name == "crop")


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_an_orientation_that_means_nothing_is_ignored(orientation: int, tmp_path: Path) -> None:
    save(tmp_path / "photos" / "a.jpg", tags={0x0112: orientation})
    report = import_images(tmp_path / "photos", tmp_path / "PLACE", camera=CAMERA)
    assert not any("orientation" in note for note in report.notes)


def test_times_are_those_of_the_camera_where_all_have_one(tmp_path: Path) -> None:
    for second in (7, 5):
        save(tmp_path / "photos" / f"{second}.jpg", tags={0x9291: "25"}, time=f"2024:05:01 10:00:{second:02d}")
    report = import_images(tmp_path / "photos", tmp_path / "ONE", camera=CAMERA)
    first = 1714557600 * 10**6 + 250_000
    assert report.images.set_index("image")["timestamp"].to_dict() == {
        "5.jpg": first + 5 * 10**6,
        "7.jpg": first + 7 * 10**6,
    }
    assert "camera clock" in report.record["timestamps"][1]
    save(tmp_path / "photos" / "9.jpg", time="2024:05:01 10:00:05")
    twice = import_images(tmp_path / "photos", tmp_path / "TWO", camera=CAMERA)
    assert "camera clock" in twice.record["timestamps"][1]  # a quarter of a second apart
    save(tmp_path / "photos" / "9.jpg")
    without = import_images(tmp_path / "photos", tmp_path / "THREE", camera=CAMERA)
    assert "made up, one second apart in the order of the images (some images have no time in EXIF)" in without.text()


def test_turned_images_are_used_as_stored_and_said_so(folder: Path, tmp_path: Path) -> None:
    save(folder / "b" / "1.jpg", tags={0x0112: 6})
    report = import_images(folder, tmp_path / "PLACE", camera=CAMERA)
    assert "1 images have an EXIF orientation, which is ignored: pixels are used as stored" in report.text()


def test_names_that_the_format_cannot_hold_are_left_out(folder: Path, tmp_path: Path) -> None:
    save(folder / "one, two.jpg")
    save(tmp_path / "outside.jpg")
    status = import_images(folder, tmp_path / "PLACE", camera=CAMERA).images.set_index("image")["status"]
    assert "comma" in status["one, two.jpg"]
    table = tmp_path / "t.csv"
    table.write_text("image\n../outside.jpg\na/2.jpg\n")
    status = import_images(folder, tmp_path / "OTHER", table=table, camera=CAMERA).images.set_index("image")["status"]
    assert status["../outside.jpg"] == "not a path inside the folder of images"


POSED = "image,qw,qx,qy,qz,tx,ty,tz\n"
POSES = POSED + "".join(f"{name},1,0,0,0,0,0,{k}\n" for k, name in enumerate(("a/2.jpg", "a/10.png", "b/1.jpg")))
ANGLES = "name,x,y,alt,heading,pitch,roll,f,px,py\na/2.jpg,1,2,3,10,20,30,29,0,0\n"
ASK_REALITYSCAN = r"t\.csv: found angles .* RealityScan .* Export as COLMAP there"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,qw\n", r"t\.csv: .*'name'"),
        ("image,qw,qx,qy,qz,tx,ty\n", r"t\.csv: .*'tz'"),
        ("qw,qx,qy,qz,tx,ty,tz\n", r"t\.csv: .*'image'"),
        (f"{POSED}\na/2.jpg,1,0,0,0,0,0,nan\n", r"t\.csv, line 3: .* nan"),
        (f"{POSED}a/2.jpg,1,1,0,0,0,0,0\n", r"t\.csv, line 2: "),
        ("image\na/2.jpg\na/2.jpg\n", r"t\.csv, line 3: .*'a/2\.jpg'"),
        ("image\na/2.jpg\n", r"qw, qx, qy, qz, tx, ty, tz"),
        ("image\none, two.jpg\n", r"t\.csv, line 2: found 2 values, expected 1"),
        ("image,camera_id\na/2.jpg,1\n\nb/1.jpg,1,2\n", r"t\.csv, line 4: found 3 values, expected 2"),
        ("image,camera_id,image\na/2.jpg,1,b/1.jpg\n", r"t\.csv: column 'image' occurs 2 times"),
        ('image,camera_id\na/2.jpg,1\n"b/1.jpg,1\n', r"t\.csv, line 3: "),
        ("", r"t\.csv: "),
        (POSED, "no image is listed in the table"),
        (f"#{ANGLES}", ASK_REALITYSCAN),
        (f"#cameras 1\n#{ANGLES}", ASK_REALITYSCAN),
        (ANGLES, ASK_REALITYSCAN),
        (ANGLES.replace("heading,pitch", "pitch,heading"), ASK_REALITYSCAN),
    ],
)
def test_malformed_tables_are_refused(folder: Path, tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(CaptureError, match=message):
        import_images(folder, tmp_path / "PLACE", split="map", table=tmp_path / "t.csv", camera=CAMERA)
    assert not (tmp_path / "PLACE").exists()


def test_images_txt_of_colmap_says_how_it_is_imported(folder: Path, tmp_path: Path) -> None:
    table = tmp_path / "images.txt"
    table.write_text("# Image list with two lines of data per image:\n1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    with pytest.raises(CaptureError, match=r"images\.txt: not a CSV table. Import its folder by .* import colmap"):
        import_images(folder, tmp_path / "PLACE", split="map", table=table)


@pytest.mark.parametrize(("options", "error", "named"), [
    ({"split": "train"}, ManifestError, "Known: "),
    ({"placing": "move"}, ManifestError, "Known: "),
    ({"poses_are": "cam_to_world"}, ManifestError, "Known: "),
    *(({"device": device}, ManifestError, "device: ") for device in ("../drone", "", "my drone", "a/b")),
    ({"device": "a" * 60}, ManifestError, "40 bytes"),
    ({"axes": "openGL"}, ManifestError, r"axes: unknown 'openGL'. Did you mean 'opengl'"),
    ({"unit_m": -1}, ManifestError, "unit: found -1, expected the meters"),
    ({"split": "map", "table": POSES, "hold_out": 4}, ManifestError, "hold-out: found 4, but there are 3"),
    ({"split": "map", "table": POSES, "truth": POSES}, ManifestError, r"truth: .* the images of a map"),
    ({"table": POSES, "truth": POSES}, ManifestError, r"truth: .* whose table has poses"),
    ({"truth": f"{POSED}2.jpg,1,0,0,0,0,0,0\n"}, CaptureError,
     r"truth: no row .* '2\.jpg' and others, expected 'a/10\.png'"),
    ({"truth": "image\na/2.jpg\n"}, CaptureError, "truth: no poses"),
    ({"only": ["*.jpeg"]}, CaptureError, "none of 3 images fits"),
    ({"cameras": TWO_CAMERAS}, CaptureError, r"has 2 different cameras; .* --camera 'PINHOLE, 64, 48, 50\.0, 51"),
    ({"cameras": TWO_CAMERAS, "table": "image,camera_id\na/2.jpg,9\n"}, CaptureError,
     r"table, line 2: camera_id '9' .*3, 8"),
    ({"cameras": "1 PINHOLE 64 48 x 51 32 24\n"}, CaptureError, "cameras, line 1: "),
    ({"table": "image,model,width,height,params\n\na/2.jpg,PINHOLE,64,48,50 51 32\n"}, CaptureError, "table, line 3: "),
    ({"images": "nowhere"}, CaptureError, "nowhere: "),
    ({"images": "empty"}, CaptureError, "empty: "),
    ({"capture": "DONE"}, CaptureError, "ios_query"),
])  # fmt: skip
def test_wrong_choices_are_named_and_nothing_is_overwritten(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict, error: type[Exception], named: str
) -> None:
    """The texts of tables and cameras are in files of the options' names."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    import_images(folder, "DONE", camera=CAMERA)
    files = {name: Path(name) for name in options.keys() & {"table", "truth", "cameras"}}
    for name, path in files.items():
        path.write_text(options[name])
    intrinsics = {} if "cameras" in options or "params" in options.get("table", "") else {"camera": CAMERA}
    with pytest.raises(error, match=named):
        import_images(**{"images": folder, "capture": "PLACE"} | intrinsics | options | files)
    assert not (tmp_path / "PLACE").exists()


@pytest.mark.parametrize("end", [("", ","), (",", ","), (",,", ",,"), (",", "")])
def test_a_table_may_end_its_lines_with_empty_values(folder: Path, tmp_path: Path, end: tuple[str, str]) -> None:
    """As spreadsheets export it, which also write a byte order mark."""
    lines = (f"image,qw,qx,qy,qz,tx,ty,tz{end[0]}", f"a/2.jpg,1,0,0,0,1,2,3{end[1]}", "b/1.jpg,1,0,0,0,4,5,6")
    (tmp_path / "t.csv").write_text("\r\n".join(lines), encoding="utf-8-sig", newline="")
    import_images(folder, tmp_path / "PLACE", split="map", table=tmp_path / "t.csv", camera=CAMERA)
    found = poses_of(Capture.open(tmp_path / "PLACE")["ios_map"])
    assert {name: pose[:3, 3].tolist() for name, pose in found.items()} == {"a/2.jpg": [1, 2, 3], "b/1.jpg": [4, 5, 6]}


def test_the_command_line_imports(model: Path, tmp_path: Path) -> None:
    photos, place = str(tmp_path / "photos"), str(tmp_path / "PLACE")
    done = CliRunner().invoke(app, ["import", "colmap", str(model), photos, place, "--device", "spot"])
    assert done.exit_code == 0, done.output
    assert "5  used of 6 in" in done.output
    done = CliRunner().invoke(app, ["import", "images", photos, place, "--camera", CAMERA, "--images", "copy"])
    assert done.exit_code == 0, done.output
    assert Capture.open(place).session_ids == ["ios_query", "spot_map"]
    poses = Capture.open(place)["spot_map"].trajectory
    assert poses is not None
    np.testing.assert_allclose(pose_from_qt(poses.qt)[0, 3], [0, 0, 0, 1])


def test_a_model_with_rigs_is_added_to_a_session(model: Path, tmp_path: Path) -> None:
    later = tmp_path / "later"
    for name in ("phone/2.jpg", "rig/5.jpg"):
        (later / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "photos" / name).rename(later / name)
    import_colmap(model, tmp_path / "photos", tmp_path / "PLACE", device="hl", unit_m=1.0)
    report = import_colmap(model, later, tmp_path / "PLACE", device="hl", unit_m=1.0, add=True)
    assert (report.record["before"], report.record["used"]) == (3, 2)
    session, reference = Capture.open(tmp_path / "PLACE")["hl_map"], pycolmap.Reconstruction(str(model))
    for name, world_from_cam in poses_of(session).items():
        cam_from_world = reference.find_image_with_name(name).cam_from_world()
        expected = invert(make_pose(cam_from_world.rotation.matrix(), cam_from_world.translation))
        np.testing.assert_allclose(world_from_cam, expected, rtol=0, atol=1e-9)
    assert len(session.images) == 5
    assert session.rigs is not None
    assert sorted(set(session.rigs["rig_id"])) == ["import/rig_7", "import/rig_7_3"]
    cameras = session.images.set_index("path")["sensor_id"]
    assert cameras["import/images/phone/2.jpg"] == cameras["import/images/phone/1.jpg"]
    assert check_capture(tmp_path / "PLACE").problems == []
