"""Import of transforms.json: conventions, intrinsics, what is malformed."""

import json
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from typer.testing import CliRunner

from toolkit.__main__ import app
from toolkit.capture import Capture, Session
from toolkit.capture.check import check_capture
from toolkit.capture.upright import estimate_world_up
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.drafts import list_images
from toolkit.exchange.interchange import import_images, import_transforms
from toolkit.geometry import invert, make_pose, quaternion_to_rotation, transform

SIZE = (64, 48)
SHARED = {"fl_x": 50.0, "fl_y": 51.0, "cx": 30.0, "cy": 25.0, "w": SIZE[0], "h": SIZE[1]}


def matrix(number: int) -> list[list[float]]:
    """world_from_cam of a frame, OpenGL axes."""
    rng = np.random.default_rng(number)
    pose: list[list[float]] = make_pose(quaternion_to_rotation(rng.normal(size=4)), rng.normal(size=3) * 9).tolist()
    return pose


def write(folder: Path, frames: list[dict[str, Any]] | None = None, **shared: Any) -> Path:
    """Write a file with three frames, or these; their images are there."""
    if frames is None:
        frames = [{"file_path": f"images/{k}.jpg", "transform_matrix": matrix(k)} for k in range(3)]
    for frame in frames:
        path = folder / str(frame.get("file_path", "x.jpg"))
        path = path if path.suffix else path.with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.new("RGB", SIZE, (90, 120, 150)).save(path)
    file = folder / "transforms.json"
    file.write_text(json.dumps({**SHARED, **shared, "frames": frames}))
    return file


def imported(file: Path, place: Path, **options: Any) -> Session:
    import_transforms(file, place, **options)
    return Capture.open(place)["ios_map"]


def camera_of(session: Session, name: str) -> Any:
    row = session.row_of_name[f"ios_map/raw_data/import/images/{name}"]
    return session.camera(str(session.images["sensor_id"].iloc[row]))


def distorted(x: float, y: float, k: tuple[float, ...], p: tuple[float, float]) -> tuple[float, float]:
    """OpenCV's distortion of a point of the plane at depth 1, k1 k2 k3 and p1 p2."""
    r2 = x * x + y * y
    radial = 1 + sum(one * r2 ** (power + 1) for power, one in enumerate(k))
    return (
        x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x),
        y * radial + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y,
    )


@pytest.mark.parametrize(
    ("intrinsics", "model"),
    [
        ({}, "PINHOLE"),
        ({"camera_model": "OPENCV", "k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": -0.004}, "OPENCV"),
        ({"k1": 0.1, "k2": -0.02, "k3": 0.05, "p1": 0.003, "p2": -0.004}, "FULL_OPENCV"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": -0.02, "k3": 0.03, "k4": 0.01}, "OPENCV_FISHEYE"),
        ({"is_fisheye": True, "k1": 0.1}, "OPENCV_FISHEYE"),
    ],
)
def test_points_are_seen_where_the_file_says(tmp_path: Path, intrinsics: dict[str, Any], model: str) -> None:
    """A point in front of an OpenGL camera, projected by hand, and by the session's pose and camera."""
    session = imported(write(tmp_path, **intrinsics), tmp_path / "PLACE")
    k = [float(intrinsics.get(f"k{i}", 0)) for i in (1, 2, 3, 4)]
    p = float(intrinsics.get("p1", 0)), float(intrinsics.get("p2", 0))
    for row, path in enumerate(session.images["path"]):
        in_gl = np.array([0.3, 0.2, -1.5])  # right, up, in front
        world = transform(np.array(matrix(int(Path(path).stem))), in_gl[None])
        x, y = in_gl[0] / -in_gl[2], in_gl[1] / in_gl[2]  # y down
        if model == "OPENCV_FISHEYE":
            r = np.hypot(x, y)
            theta = np.arctan(r)
            scale = theta * (1 + sum(one * theta ** (2 * power) for power, one in enumerate(k, start=1))) / r
            x, y = x * scale, y * scale
        else:
            x, y = distorted(x, y, (k[0], k[1], k[2]), p)
        camera = session.camera(str(session.images["sensor_id"].iloc[row]))
        in_cam = transform(invert(session.world_from_cam([row])[0]), world)
        assert camera.model.name == model
        np.testing.assert_allclose(camera.img_from_cam(in_cam)[0], [50 * x + 30, 51 * y + 25], rtol=0, atol=1e-9)
    assert len(session.sensors) == 1
    assert check_capture(tmp_path / "PLACE").problems == []


def test_the_axes_may_be_those_of_opencv_and_the_unit_not_the_meter(tmp_path: Path) -> None:
    file = write(tmp_path)
    report = import_transforms(file, tmp_path / "A")
    assert "unknown: relative to the depth of the scene" in report.text()
    assert json.loads((report.session / "proc" / "import.json").read_text())["unit"] is None
    opengl = Session.open(report.session).world_from_cam()
    np.testing.assert_allclose(opengl[1], np.array(matrix(1)) @ np.diag([1, -1, -1, 1]), rtol=0, atol=1e-12)
    opencv = imported(file, tmp_path / "B", axes="opencv", unit_m=0.01)
    assert json.loads((opencv.path / "proc" / "import.json").read_text())["unit"] == "m"
    np.testing.assert_allclose(opencv.world_from_cam()[1][:3, :3], np.array(matrix(1))[:3, :3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(opencv.world_from_cam()[:, :3, 3], opengl[:, :3, 3] / 100, rtol=0, atol=1e-12)
    for options in ({"axes": "arkit"}, {"unit_m": 0.0}, {"split": "train"}, {"hold_out": 1}, {"hold_out": 4}):
        with pytest.raises(ManifestError):
            import_transforms(file, tmp_path / "C", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "C").exists()


def test_frames_may_have_intrinsics_of_their_own_and_no_extension(tmp_path: Path) -> None:
    frames = [
        {"file_path": "./train/r_0", "transform_matrix": matrix(0)},
        {"file_path": "train/r_1.png", "transform_matrix": matrix(1)[:3], "fl_x": 60, "k1": 0.1, "cx": 31.5},
        {"file_path": str(tmp_path / "train" / "r_2"), "transform_matrix": matrix(2)},
    ]
    session = imported(write(tmp_path, frames), tmp_path / "PLACE")
    names = ["train/r_0.png", "train/r_1.png", "train/r_2.png"]
    assert session.images["path"].tolist() == [f"import/images/{name}" for name in names]
    assert camera_of(session, names[0]).params.tolist() == [50, 51, 30, 25]
    assert camera_of(session, names[1]).params.tolist() == [60, 51, 31.5, 25, 0.1, 0, 0, 0]
    assert len(session.sensors) == 2


def test_a_field_of_view_is_a_focal_length(tmp_path: Path) -> None:
    """As in the files of NeRF's rendered scenes, which have nothing else; a right angle has half the width."""
    file = write(tmp_path)
    content = json.loads(file.read_text())
    file.write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": content["frames"], "aabb_scale": 16}))
    assert camera_of(imported(file, tmp_path / "A"), "images/0.jpg").params.tolist() == pytest.approx([32, 32, 32, 24])
    file.write_text(json.dumps(json.loads(file.read_text()) | {"camera_angle_y": 2 * np.arctan(0.5)}))
    assert camera_of(imported(file, tmp_path / "B"), "images/0.jpg").params.tolist() == pytest.approx([32, 48, 32, 24])


def test_every_so_many_frames_become_queries_with_their_truth(tmp_path: Path) -> None:
    names = [f"{k:02d}.jpg" for k in range(7)]
    frames = [{"file_path": name, "transform_matrix": matrix(k)} for k, name in enumerate(names)]
    file = write(tmp_path, frames[::-1])
    PIL.Image.new("RGB", SIZE).save(tmp_path / "other.jpg")
    command = ["import", "transforms", str(file), str(tmp_path / "PLACE"), "--hold-out", "3", "--unit", "2"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert "5  used of 6 in" in done.output
    assert "1  not in transforms.json (other.jpg)" in done.output
    place = Capture.open(tmp_path / "PLACE")
    queries = place["ios_query"]
    assert [Path(path).name for path in queries.images["path"]] == ["02.jpg", "05.jpg"]
    assert [Path(path).name for path in place["ios_map"].images["path"]] == [f"0{k}.jpg" for k in (0, 1, 3, 4, 6)]
    truth = queries.world_from_cam(ground_truth=True)
    np.testing.assert_allclose(truth[1][:3, 3], 2 * np.array(matrix(5))[:3, 3], rtol=0, atol=1e-12)
    assert queries.odometry is None


def test_a_map_without_any_query_left_is_not_written(tmp_path: Path) -> None:
    """The same command then works once the images are there."""
    file = write(tmp_path)
    (tmp_path / "images" / "2.jpg").rename(tmp_path / "images" / "two.jpg")
    with pytest.raises(CaptureError, match=r"images/2\.jpg: no such file"):
        import_transforms(file, tmp_path / "PLACE", hold_out=3)
    assert not (tmp_path / "PLACE").exists()
    (tmp_path / "images" / "two.jpg").rename(tmp_path / "images" / "2.jpg")
    report = import_transforms(file, tmp_path / "PLACE", hold_out=3)
    assert report.held_out is not None
    assert (len(report.images), len(report.held_out.images)) == (2, 1)


def test_images_that_cannot_be_used_are_rows(tmp_path: Path) -> None:
    file = write(tmp_path)
    content = json.loads(file.read_text())
    (tmp_path / "images" / "1.jpg").unlink()
    content["frames"][2]["w"] = 65
    outside = {"file_path": "../outside.jpg", "transform_matrix": matrix(4)}
    PIL.Image.new("RGB", SIZE).save(tmp_path.parent / "outside.jpg")
    long = {"file_path": "x" * 300, "transform_matrix": matrix(5)}
    lost = {"file_path": "images/lost.jpg", "transform_matrix": [[float("nan")] * 4] * 4}
    PIL.Image.new("RGB", SIZE).save(tmp_path / "images" / "lost.jpg")
    file.write_text(json.dumps(content | {"frames": [*content["frames"], outside, long, lost]}))
    status = import_transforms(file, tmp_path / "PLACE").images.set_index("image")["status"]
    assert status["images/0.jpg"] == "imported"
    assert status["images/1.jpg"] == status["x" * 300] == "no such file"
    assert status["images/2.jpg"] == "the image is stored as 64 x 48 pixels, its camera has 65 x 48"
    assert status["../outside.jpg"] == "not a path inside the folder of images"
    assert "frame 5 (images/lost.jpg), transform_matrix: found [[nan" in status["images/lost.jpg"]


@pytest.mark.parametrize(("stored", "file", "listed", "named"), [
    ("images", "", "images/", r"has 32 x 24; use images of the camera's size, or .* intrinsics by 2"),
    ("pictures", "", "images/", r"First: images/0.jpg: no such file. Names are paths in this folder: corr"),
    ("pictures", "elsewhere", "{}/pictures/", r"not a path inside the folder of images. Names are paths in this"),
])  # fmt: skip
def test_images_of_another_size_or_place_say_what_to_do(
    stored: str, file: str, listed: str, named: str, tmp_path: Path
) -> None:
    written = write(tmp_path, fl_x=25.0, w=SIZE[0] // 2, h=SIZE[1] // 2)
    (tmp_path / "images").rename(tmp_path / stored)
    (tmp_path / file).mkdir(exist_ok=True)
    path = tmp_path / file / "transforms.json"
    path.write_text(written.read_text().replace("images/", listed.format(tmp_path)))
    with pytest.raises(CaptureError, match=named):
        import_transforms(path, tmp_path / "PLACE")


def test_the_folder_of_images_may_be_a_link(tmp_path: Path) -> None:
    """As where images are on another disk. Links in circles end, and images beside the listed ones are counted."""
    file = write(tmp_path / "here")
    disk = tmp_path / "disk"
    (tmp_path / "here" / "images").rename(disk)
    PIL.Image.new("RGB", SIZE).save(disk / "other.jpg")
    (tmp_path / "here" / "images").symlink_to(disk)
    (disk / "circle").symlink_to(tmp_path / "here")
    (tmp_path / "here" / "again").symlink_to(disk)
    report = import_transforms(file, tmp_path / "PLACE")
    assert [(one["count"], one["first"]) for one in report.record["left out"]] == [(1, "images/other.jpg")]
    assert not check_capture(tmp_path / "PLACE").problems
    assert len(list_images(tmp_path / "here")) == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"file_path": None}, "frame 1, file_path: found None; expected the path of an image"),
        ({"file_path": "images/0.jpg"}, "frame 1 (images/0.jpg), file_path: found that of frame 0 again; expected one"),
        ({"fl_x": "wide"}, "frame 1 (images/1.jpg), fl_x: found 'wide'; expected a focal length in pixels"),
        ({"file_path": "\ud800.jpg"}, "frame 1, file_path: found '\\ud800.jpg'; expected the path of an image"),
        ({"fl_x": 10**400}, "frame 1 (images/1.jpg), fl_x: found 1000"),
        ({"transform_matrix": [[1, 0, 0, 10**400]] * 4}, "transform_matrix: found [[1, 0, 0, 1000"),
        ({"transform_matrix": [[1, 0, 0, 1e13]] * 3}, "transform_matrix: found [[1, 0, 0, 10000000000000.0]"),
        ({"fl_x": -5}, "frame 1 (images/1.jpg), intrinsics: found PINHOLE, 64.0, 48.0, -5.0, "),
        ({"fl_y": True}, "frame 1 (images/1.jpg), fl_y: found True; expected"),
        ({"k1": float("nan")}, "frame 1 (images/1.jpg), k1: found nan; expected a number"),
        ({"k4": 0.5}, "frame 1 (images/1.jpg), k4: found 0.5; expected 0 for OPENCV"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "frame 1 (images/1.jpg), p1, p2: found 0.1, 0; expected 0, 0"),
        ({"camera_model": "EQUIRECTANGULAR"}, "frame 1 (images/1.jpg), camera_model: found 'EQUIRECTANGULAR'; "),
        ({"transform_matrix": None}, "frame 1 (images/1.jpg), transform_matrix: found None; expected 4 rows of 4"),
        ({"transform_matrix": [[1, 2], [3]]}, "frame 1 (images/1.jpg), transform_matrix: found [[1, 2], [3]]; "),
        ({"transform_matrix": np.diag([2, 2, 2, 1]).tolist()}, "transform_matrix: found [[2. 0. 0.]"),
        ({"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, "expected a rotation: columns of length 1"),
        ({"transform_matrix": np.array(matrix(1)).T.tolist()}, "the last row 0 0 0 1. Correct it in the file."),
    ],
)
def test_what_is_malformed_is_named_with_frame_and_key(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    file = write(tmp_path)
    content = json.loads(file.read_text())
    content["frames"][1] |= change
    file.write_text(json.dumps(content))
    status = import_transforms(file, tmp_path / "PLACE").images.set_index("image")["status"]
    (why,) = [one for one in status if one.startswith(f"{file}, frame 1")]
    assert message in why
    again = change.get("file_path") == "images/0.jpg"  # with another pose: which one is right is unknown
    good = ["images/2.jpg"] if again else ["images/0.jpg", "images/2.jpg"]
    assert sorted(status.index[status == "imported"]) == good, "the others go on"


def test_a_frame_that_is_none_leaves_the_others_and_one_given_twice_counts_once(tmp_path: Path) -> None:
    file = write(tmp_path)
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"frames": [*content["frames"], None, content["frames"][0]]}))
    status = import_transforms(file, tmp_path / "PLACE").images.set_index("image")["status"]
    assert status.pop("frame 3").startswith(f"{file}, frame 3, file_path: found None")
    assert status.to_dict() == {f"images/{k}.jpg": "imported" for k in range(3)}


@pytest.mark.parametrize(("listed", "stored"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_in_another_encoding_of_letters_are_in_the_file(listed: str, stored: str, tmp_path: Path) -> None:
    file = write(tmp_path)
    for k in range(3):
        name = unicodedata.normalize(stored, f"images/caf\u00e9{k}.jpg")
        (tmp_path / "images" / f"{k}.jpg").rename(tmp_path / name)
        file.write_text(file.read_text().replace(f"images/{k}.jpg", unicodedata.normalize(listed, name)))
    report = import_transforms(file, tmp_path / "PLACE")
    assert (report.record["used"], report.record["left out"]) == (3, [])


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_file_of_another_encoding_is_read(encoding: str, tmp_path: Path) -> None:
    file = write(tmp_path)
    file.write_text(file.read_text(), encoding=encoding)
    assert len(imported(file, tmp_path / "PLACE").images) == 3


def test_the_splits_of_the_file_are_map_and_queries(tmp_path: Path) -> None:
    names = [f"images/{k}.jpg" for k in range(3)]
    split = {"train_filenames": names[:1], "test_filenames": names[1:2]}
    report = import_transforms(write(tmp_path, **split), tmp_path / "PLACE")
    assert list(report.records()) == ["ios_map", "ios_query"]
    assert report.held_out is not None
    reports = report, report.held_out
    statuses = [dict(zip(report.images["image"], report.images["status"], strict=True)) for report in reports]
    assert statuses[1] == {"images/1.jpg": "imported"}
    assert statuses[0]["images/0.jpg"] == "imported"
    assert "in none of train_filenames" in statuses[0]["images/2.jpg"]
    queries = import_transforms(tmp_path / "transforms.json", tmp_path / "OTHER", split="query")
    assert (queries.images["status"] == "imported").all()


@pytest.mark.parametrize("suffix", ["", ".png"])
def test_the_splits_are_matched_without_extensions_if_only_one_frame_fits(suffix: str, tmp_path: Path) -> None:
    frames = [{"file_path": f"./images/{name}", "transform_matrix": matrix(0)} for name in ("0.jpg", "1.jpg", "a", "b")]
    frames += [{"file_path": f"images/c.{suffix}", "transform_matrix": matrix(1)} for suffix in ("jpg", "png")]
    split = {"train_filenames": [f"images/0{suffix}", "images/a.JPG"], "test_filenames": [f"images\\1{suffix}"]}
    split["val_filenames"] = ["./images/b", "images/c", "images/gone.jpg"]
    report = import_transforms(write(tmp_path, frames, **split), tmp_path / "PLACE")
    assert report.held_out is not None
    taken = [one.images.query("status == 'imported'")["image"].tolist() for one in (report, report.held_out)]
    assert taken == [["images/0.jpg", "images/a.png"], ["images/1.jpg", "images/b.png"]]
    assert any(note.startswith("3 names in these lists match but for their extensions, as ") for note in report.notes)
    assert "2 names in these lists are of no frame, or of several, as 'images/c'" in report.notes


def test_the_world_of_the_input_is_restored(tmp_path: Path) -> None:
    turn = make_pose(quaternion_to_rotation([0.5, -0.5, 0.5, 0.5]), [1.0, -2.0, 3.0])
    given = [turn @ matrix(k) for k in range(3)]
    for pose in given:
        pose[:3, 3] *= 0.25
    frames = [{"file_path": f"images/{k}.jpg", "transform_matrix": pose.tolist()} for k, pose in enumerate(given)]
    file = write(tmp_path, frames, applied_transform=turn[:3].tolist(), applied_scale=0.25)
    said = import_transforms(file, tmp_path / "SAID")
    assert any("applied_scale 0.25" in note and "--undo-applied" in note for note in said.notes)
    session = imported(file, tmp_path / "PLACE", undo_applied=True, unit_m=1.0)
    for k, found in enumerate(session.world_from_cam()):
        np.testing.assert_allclose(found, np.array(matrix(k)) @ np.diag([1, -1, -1, 1]), rtol=0, atol=1e-9)
    differ = "applied_transform of ios_map is another or none, so its world is another. Give --undo-applied"
    for first, then in ((False, False), (True, False), (False, True), (True, True)):
        place = tmp_path / f"{first}{then}"
        import_transforms(file, place, undo_applied=first)
        query = import_transforms(file, place, split="query", undo_applied=then)
        assert any(note.startswith(differ) for note in query.notes) == (first != then)


@pytest.mark.parametrize(
    ("text", "tool", "command"),
    [
        ('[{"cameras": {}, "shots": {"0.jpg": {"rotation": [0, 0, 0]}}}]', "OpenSfM", "opensfm export_colmap"),
        ('{"sfm_data_version": "0.3", "views": []}', "OpenMVG", "openMVG_main_openMVG2Colmap"),
        ("# kapture format: 1.1\n# timestamp, device_id, qw\n0, a, 1\n", "kapture", "kapture_export_colmap.py"),
    ],
)
def test_files_of_other_tools_are_told_how_to_come(text: str, tool: str, command: str, tmp_path: Path) -> None:
    write(tmp_path)
    file = tmp_path / ("poses.txt" if tool == "kapture" else "poses.json")
    file.write_text(text)
    told = rf"poses.{file.suffix[1:]}: found a file of {tool}.*`{command}`"
    for door in (import_images, import_transforms) if file.suffix == ".json" else (import_images,):
        given = {"table": file, "split": "map"} if door is import_images else {}
        with pytest.raises(CaptureError, match=told):
            door(tmp_path / "images" if given else file, tmp_path / "PLACE", **given)


@pytest.mark.parametrize("root", ["/home/them/project/", "C:/Users/them/", "C:\\Users\\them\\"])
def test_absolute_paths_of_another_machine_are_found_by_their_ends(root: str, tmp_path: Path) -> None:
    file = write(tmp_path)
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        path = root + frame["file_path"]
        frame["file_path"] = path.replace("/", "\\") if "\\" in root else path
    file.write_text(json.dumps(content))
    report = import_transforms(file, tmp_path / "PLACE")
    assert list(report.images["image"]) == [f"images/{k}.jpg" for k in range(3)]
    assert any(note.startswith("3 images have paths of another machine") for note in report.notes)


FRAMES = [{"file_path": "images/0.jpg", "transform_matrix": matrix(0)}]


@pytest.mark.parametrize(("content", "named"), [
    (json.dumps({"frames": FRAMES}), r"fl_x: found nothing; .* or camera_angle_x"),
    (json.dumps(SHARED | {"frames": FRAMES, "applied_transform": [[1, 0], [0, 1]]}), "applied_transform"),
    *(
        (text, "an object with a list `frames`")
        for text in ("", "{", "[]", '{"frames": []}', '{"frames": [1]}', '{"images": 1}', "[" * 100_000)
    ),
    (None, "cannot be read"),
])  # fmt: skip
def test_a_file_without_intrinsics_or_frames_is_refused(content: str | None, named: str, tmp_path: Path) -> None:
    file = write(tmp_path, FRAMES)
    file.unlink() if content is None else file.write_text(content)
    with pytest.raises(CaptureError, match=named):
        import_transforms(file, tmp_path / "PLACE")
    assert not (tmp_path / "PLACE").exists()


def test_the_world_is_moved_to_known_places(tmp_path: Path) -> None:
    """Centers of the cameras in meters: the poses of an unknown unit, and their rotations, follow."""
    count, turn = 8, quaternion_to_rotation([0.9, 0.1, -0.2, 0.3])
    frames = [{"file_path": f"images/{k}.jpg", "transform_matrix": matrix(k)} for k in range(count)]
    true = [5.0 * turn @ np.array(matrix(k))[:3, 3] + [100.0, 50.0, 3.0] for k in range(count)]
    rows = [f"images/{k}.jpg,{','.join(map(repr, xyz.tolist()))}" for k, xyz in enumerate(true)]
    (tmp_path / "places.csv").write_text("\n".join(["image,x,y,z", *rows]))
    session = imported(write(tmp_path, frames), tmp_path / "PLACE", positions=tmp_path / "places.csv")
    found = session.world_from_cam()
    np.testing.assert_allclose(found[:, :3, 3], true, rtol=0, atol=1e-6)
    expected = [turn @ (np.array(matrix(k)) @ np.diag([1, -1, -1, 1]))[:3, :3] for k in range(count)]
    np.testing.assert_allclose(found[:, :3, :3], expected, rtol=0, atol=1e-6)
    record = json.loads((session.path / "proc" / "import.json").read_text())
    assert (record["unit"], record["z is up"]) == ("m", True)
    up = estimate_world_up([session])
    assert (up.direction.tolist(), up.known, up.reason) == ([0, 0, 1], True, record["up"])
