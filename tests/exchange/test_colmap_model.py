"""COLMAP models as other tools write and people edit them: read right, or refused; never half read."""

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest

from toolkit.capture import Capture
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.colmap_model import read_model
from toolkit.exchange.georeference import geographic
from toolkit.exchange.interchange import import_colmap
from toolkit.geometry import Floats, invert, make_pose, quaternion_to_rotation

NAMES = ["a.jpg", "IMG (1).jpg", "2 of 3 .jpg", "0004", "b/5.jpg", "six.jpg"]
CAMERAS = "1 PINHOLE 64 48 50 51 32 24\n"
RIG = make_pose(quaternion_to_rotation([0.9, 0.1, -0.2, 0.3]), [0.11, -0.02, 0.03])  # right from left


def pose(number: int) -> Floats:
    rng = np.random.default_rng(number)
    return make_pose(quaternion_to_rotation(rng.normal(size=4)), rng.normal(size=3) * 100)


def qt(number: int, digits: int = 17) -> str:
    rng = np.random.default_rng(number)
    q = rng.normal(size=4)
    return " ".join(f"{value:.{digits}g}" for value in (*q / np.linalg.norm(q), *rng.normal(size=3) * 100))


def images_txt(points: str = "\n", digits: int = 17) -> str:
    return "".join(f"{k + 1} {qt(k, digits)} 1 {name}\n{points}" for k, name in enumerate(NAMES))


def write(folder: Path, images: str | bytes, cameras: str = CAMERAS, **others: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_bytes(images if isinstance(images, bytes) else images.encode())
    for name, text in others.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def binary(folder: Path, target: Path) -> Path:
    target.mkdir()
    (folder / "points3D.txt").write_text("")
    pycolmap.Reconstruction(str(folder)).write_binary(str(target))
    return target


def assert_read(folder: Path, atol: float = 1e-9) -> None:
    images = read_model(folder).images.values()
    assert [image.name for image in images] == NAMES
    for number, image in enumerate(images):
        np.testing.assert_allclose(image.cam_from_world.matrix(), pose(number)[:3], rtol=0, atol=atol)


POINTS = "".join(f"{x}.5 7 {x % 3 - 1} " for x in range(5)).strip() + "\n"


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text,
        lambda text: text.rstrip("\n"),  # editors strip the last line
        lambda text: text.rstrip("\n") + "\n",
        lambda text: text.replace("\n\n", "\n"),  # all lines of points deleted
        lambda text: text.replace("\n\n", "\n", 2),
        lambda text: text.replace("\n\n", f"\n{POINTS}"),
        lambda text: text.replace("\n\n", "\n1 2 3 4 5 6 7 8 9 10 11 12\n"),  # points at whole pixels
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n\n", "\n").replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: "# Image list\n#\n" + text,
        lambda text: text.replace("\n\n", "\n\n\n"),
        lambda text: "\ufeff" + text,
        lambda text: text.encode("utf-16"),
        lambda text: text.encode("utf-16-le"),
        lambda text: text.encode("utf-16-be"),
        lambda text: text.replace(" 1 ", "\t1\t"),
    ],
)
def test_text_is_read_however_it_was_written(change: Callable[[str], str | bytes], tmp_path: Path) -> None:
    assert_read(write(tmp_path, change(images_txt())))


def test_exponents_of_three_digits_are_read(tmp_path: Path) -> None:
    line = "1 1.000e+000 0 0 0 -2.5e-002 1e+001 3E+000 1 a.jpg"
    found = read_model(write(tmp_path, line)).images[1].cam_from_world
    np.testing.assert_array_equal(found.translation, [-0.025, 10, 3])


def test_quaternions_of_few_digits_are_normalized_and_positions_do_not_scale(tmp_path: Path) -> None:
    model = read_model(write(tmp_path, images_txt(digits=3)))
    for number, image in enumerate(model.images.values()):
        center, expected = image.cam_from_world.inverse().translation, invert(pose(number))[:3, 3]
        rotation = image.cam_from_world.rotation.matrix()
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.norm(center) == pytest.approx(np.linalg.norm(image.cam_from_world.translation), rel=1e-12)
        np.testing.assert_allclose(center, expected, atol=1.0)


@pytest.mark.parametrize("q", ["0 0 0 0", "2 0 0 0", "0.9 0 0 0", "nan 0 0 0", "inf 0 0 0"])
def test_an_image_without_a_rotation_is_a_row(q: str, tmp_path: Path) -> None:
    lines = images_txt().splitlines()
    lines[2] = f"2 {q} 0 0 0 1 b.jpg"
    model = read_model(write(tmp_path, "\n".join(lines)))
    assert [number for number, image in model.images.items() if isinstance(image.cam_from_world, str)] == [2]
    assert len(model.images) == 6


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (11, "6 0.5 0.5"),  # cut
        (11, "6 0,5 0,5 0,5 0,5 1 2 3 1 six.jpg"),
        (11, f"6 {qt(5)} 1"),  # without a name
        (2, "1.5 2.5"),
        (2, "six.jpg"),
        (11, f"3 {qt(5)} 1 six.jpg"),  # the number of another image
    ],
)
@pytest.mark.parametrize("points", ["\n", ""])
def test_a_line_that_is_neither_image_nor_points_is_refused(line: int, text: str, points: str, tmp_path: Path) -> None:
    lines = images_txt().split("\n")
    lines[line - 1] = text
    content = "\n".join(lines) if points else "\n".join(filter(None, lines))
    with pytest.raises(CaptureError, match=r"images\.txt"):
        read_model(write(tmp_path, content))


def test_a_header_with_another_count_is_said(tmp_path: Path) -> None:
    model = read_model(write(tmp_path, "# Number of images: 9, mean observations per image: 0\n" + images_txt()))
    assert any("6 images, its header says 9" in note for note in model.notes)


def rig_model(folder: Path) -> Path:
    """A rig of two cameras with two frames, and a phone; numbers of frames and images overlap."""
    cameras = "".join(f"{k} PINHOLE 64 48 50 51 32 24\n" for k in (1, 2, 3))
    right = pycolmap.Rigid3d(RIG[:3])
    x, y, z, w = right.rotation.quat
    sensor = f"CAMERA 2 1 {w!r} {x!r} {y!r} {z!r} {' '.join(map(repr, right.translation.tolist()))}".replace(
        "np.float64(", "").replace(")", "")  # fmt: skip
    frames = f"3 1 {qt(10)} 2 CAMERA 1 1 CAMERA 2 2\n4 2 {qt(12)} 1 CAMERA 3 3\n5 1 {qt(11)} 1 CAMERA 1 4\n"

    def line(number: int, cam_from_world: Floats, camera: int) -> str:
        moved = pycolmap.Rigid3d(cam_from_world[:3])
        q = moved.rotation.quat
        values = [q[3], *q[:3], *moved.translation]
        return f"{number} {' '.join(f'{v:.17g}' for v in values)} {camera} {number}.jpg\n\n"

    images = line(1, pose(10), 1) + line(2, RIG @ pose(10), 2) + line(3, pose(12), 3) + line(4, pose(11), 1)
    return write(folder, images, cameras, rigs=f"1 2 CAMERA 1 {sensor}\n2 1 CAMERA 3\n", frames=frames)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    for number in (1, 2, 3, 4):
        PIL.Image.new("RGB", (64, 48)).save(tmp_path / "photos" / f"{number}.jpg")
    return tmp_path / "photos"


def centers(session: Path) -> dict[str, Floats]:
    opened = Capture.open(session.parents[1])[session.name]
    poses = opened.world_from_cam()
    return {path.split("/images/")[1]: p[:3, 3] for path, p in zip(opened.images["path"], poses, strict=True)}


@pytest.mark.parametrize("form", ["txt", "bin"])
def test_rigs_and_single_cameras_whose_numbers_overlap_keep_their_poses(
    form: str, tmp_path: Path, photos: Path
) -> None:
    folder = rig_model(tmp_path / "model")
    folder = folder if form == "txt" else binary(folder, tmp_path / "bin")
    found = centers(import_colmap(folder, photos, tmp_path / "PLACE", device="hl").session)
    expected = {"1.jpg": pose(10), "2.jpg": RIG @ pose(10), "3.jpg": pose(12), "4.jpg": pose(11)}
    assert found.keys() == expected.keys()
    for name, cam_from_world in expected.items():
        np.testing.assert_allclose(found[name], invert(cam_from_world)[:3, 3], rtol=0, atol=1e-9)


def test_a_sensor_of_a_rig_that_is_not_calibrated_leaves_its_images_out(tmp_path: Path, photos: Path) -> None:
    folder = rig_model(tmp_path / "model")
    (folder / "rigs.txt").write_text("1 2 CAMERA 1 CAMERA 2 0\n2 1 CAMERA 3\n")
    report = import_colmap(folder, photos, tmp_path / "PLACE", device="hl")
    left_out = report.images[report.images["status"] != "imported"]
    assert list(left_out["image"]) == ["2.jpg"]
    assert "rig" in left_out["status"].iloc[0]


def test_a_frame_with_a_camera_that_its_rig_does_not_have(tmp_path: Path, photos: Path) -> None:
    folder = rig_model(tmp_path / "model")
    images = (folder / "images.txt").read_text().replace(" 1 4.jpg", " 3 4.jpg")
    (folder / "images.txt").write_text(images)
    report = import_colmap(folder, photos, tmp_path / "PLACE", device="hl")
    assert list(report.images[report.images["status"] != "imported"]["image"]) == ["4.jpg"]


def test_edited_images_beside_frames_are_said(tmp_path: Path, photos: Path) -> None:
    folder = rig_model(tmp_path / "model")
    lines = (folder / "images.txt").read_text().splitlines()
    lines[2] = f"2 {qt(33)} 2 2.jpg"
    (folder / "images.txt").write_text("\n".join(lines))
    report = import_colmap(folder, photos, tmp_path / "PLACE", device="hl")
    assert "1 images have another pose than their rig gives them" in report.text()


def test_a_binary_file_of_any_other_length_is_refused(tmp_path: Path) -> None:
    """COLMAP read on beyond its end, and a camera of a rig moved by 0.7 m."""
    whole = binary(rig_model(tmp_path / "model"), tmp_path / "bin")
    assert len(read_model(whole).images) == 4
    for name in ("cameras", "images", "rigs", "frames"):
        path = whole / f"{name}.bin"
        data = path.read_bytes()
        more = [data[:-1], data + b"\0", struct.pack("<Q", 2**60) + data[8:]]
        for damaged in [data[:size] for size in range(0, len(data), 3)] + more:
            path.write_bytes(damaged)
            with pytest.raises(CaptureError, match=rf"{name}\.bin: {'cut short' if len(damaged) < len(data) else ''}"):
                read_model(whole)
        path.write_bytes(data)


def test_bad_cameras_are_rows(tmp_path: Path) -> None:
    cameras = (
        "1 PINHOLE 64 48 0 0 32 24\n2 PINHOLE 64 48 50 50 5000 24\n3 PINHOLE 64 48 nan 50 32 24\n4 NONE 64 48 1\n"
        f"5 RAD_TAN_THIN_PRISM_FISHEYE 64 48 {'50 ' * 14}\n6 PINHOLE 64 48 50 50 32 24\n"
    )
    model = read_model(write(tmp_path, images_txt(), cameras))
    assert [number for number, camera in model.cameras.items() if isinstance(camera, str)] == [1, 2, 3, 4, 5]


def test_distortion_that_cannot_be_inverted_leaves_the_camera_out(tmp_path: Path, photos: Path) -> None:
    cameras = (
        "1 OPENCV 64 48 50 50 32 24 -44 300 0 0\n2 EQUIRECTANGULAR 64 48 64 48\n"
        "3 SIMPLE_RADIAL 64 48 50 32 24 -0.3\n4 PINHOLE 64 48 50 50 32 24\n"
        "5 SIMPLE_PINHOLE 64 48 0.078 32 24\n6 PINHOLE 64 48 50 1e9 32 24\n"  # f / width, as OpenSfM's; overflow
    )
    images = "".join(f"{k} {qt(k)} {k} {k}.jpg\n\n" for k in range(1, 7))
    for name in ("5.jpg", "6.jpg"):
        shutil.copy(photos / "1.jpg", photos / name)
    report = import_colmap(write(tmp_path / "model", images, cameras), photos, tmp_path / "PLACE")
    status = report.images.set_index("image")["status"]
    assert list(status.index[status == "imported"]) == ["3.jpg", "4.jpg"]
    assert "cannot be inverted" in status["1.jpg"]
    assert "EQUIRECTANGULAR" in status["2.jpg"]
    assert status[["5.jpg", "6.jpg"]].str.contains("is it in pixels").all()
    assert any("near the edge" in note and "import/cam_3" in note for note in report.notes)


def test_binary_beside_text_is_said(tmp_path: Path) -> None:
    folder = binary(rig_model(tmp_path / "model"), tmp_path / "bin")
    assert read_model(folder).notes == []
    shutil.copy(tmp_path / "model" / "images.txt", folder)
    shutil.copy(tmp_path / "model" / "cameras.txt", folder)
    assert any(".bin is read" in note for note in read_model(folder).notes)


def test_the_folder_of_models(tmp_path: Path) -> None:
    write(tmp_path / "sparse" / "0", images_txt())
    (tmp_path / "sparse" / "x").symlink_to("/nowhere")
    for folder in (tmp_path / "sparse", tmp_path):
        assert_read(folder)
        assert any("sparse/0" in note for note in read_model(folder).notes)
    write(tmp_path / "sparse" / "1", f"1 {qt(1)} 1 a.jpg")
    for folder, named in (
        (tmp_path, r"0 \(6 images\), sparse/1 \(1 images\)"),
        (Path(__file__).parent, "expected a COLMAP model"),
    ):
        with pytest.raises(CaptureError, match=named):
            read_model(folder)


@pytest.mark.parametrize("by", ["positions", "gps"])
def test_a_model_is_aligned_to_known_places(by: str, tmp_path: Path) -> None:
    """A model in another world and unit, with a rig, comes out in the world of its camera centers."""
    rng = np.random.default_rng(5)
    count, origin = 12, np.array([47.0, 8.0, 400.0])
    truth = [make_pose(quaternion_to_rotation(rng.normal(size=4)), rng.uniform(-60, 60, 3)) for _ in range(count)]
    turn, scale, shift = quaternion_to_rotation([0.3, 0.5, -0.7, 0.2]), 0.05, np.array([3.0, -1.0, 2.0])
    given = [make_pose(turn @ p[:3, :3], scale * turn @ p[:3, 3] + shift) for p in truth]  # world_from_cam
    lines = []
    for k, pose_given in enumerate(given, start=1):
        moved = pycolmap.Rigid3d(invert(pose_given)[:3])
        q = moved.rotation.quat
        lines.append(" ".join(f"{v:.17g}" for v in (k, q[3], *q[:3], *moved.translation)) + f" 1 {k}.jpg\n\n")
        exif, degrees = PIL.Image.Exif(), geographic(truth[k - 1][None, :3, 3], origin)[0]
        gps = {1: "N", 2: (degrees[0], 0.0, 0.0), 3: "E", 4: (degrees[1], 0.0, 0.0), 6: degrees[2]}
        exif.get_ifd(0x8825).update(gps if by == "gps" else {})
        (tmp_path / "photos").mkdir(exist_ok=True)
        PIL.Image.new("RGB", (64, 48)).save(tmp_path / "photos" / f"{k}.jpg", exif=exif)
    folder = write(tmp_path / "model", "".join(lines))
    rows = [f"{k}.jpg," + ",".join(f"{v:.9f}" for v in p[:3, 3]) for k, p in enumerate(truth, start=1)]
    (tmp_path / "t.csv").write_text("\n".join(["image,x,y,z", *rows]))
    options = {"gps": True} if by == "gps" else {"positions": tmp_path / "t.csv"}
    report = import_colmap(folder, tmp_path / "photos", tmp_path / "PLACE", **options)
    capture = Capture.open(tmp_path / "PLACE")
    assert capture.unit == "m"
    assert any(note.startswith("meters: from") for note in report.notes)
    found = capture["ios_map"].world_from_cam()
    names = [int(Path(path).stem) - 1 for path in capture["ios_map"].images["path"]]
    expected = np.stack([truth[k] for k in names])
    if by == "gps":  # in the frame at the median position
        assert "origin" in report.session.joinpath("proc/import.json").read_text()
        expected[:, :3, 3] += (found - expected)[:, :3, 3].mean(axis=0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.02 if by == "gps" else 1e-5)
    with pytest.raises(ManifestError, match="unit"):
        import_colmap(folder, tmp_path / "photos", tmp_path / "OTHER", unit_m=0.5, **options)


def test_a_model_without_gps_says_so(tmp_path: Path, photos: Path) -> None:
    report = import_colmap(rig_model(tmp_path / "model"), photos, tmp_path / "PLACE", device="hl", gps=True)
    assert any("no photograph has GPS" in note for note in report.notes)
    assert Capture.open(tmp_path / "PLACE").unit is None


@pytest.mark.parametrize("form", ["txt", "bin"])
def test_poses_are_those_of_colmaps_own_reader(form: str, tmp_path: Path) -> None:
    folder = write(tmp_path / "model", images_txt().replace(" of 3 ", "").replace("IMG (1)", "b"))
    folder = binary(folder, tmp_path / "bin") if form == "bin" else folder
    (folder / "points3D.txt").touch()
    expected = pycolmap.Reconstruction(str(folder)).images
    found = read_model(folder).images
    assert found.keys() == set(expected)
    for number, image in found.items():
        np.testing.assert_array_equal(image.cam_from_world.matrix(), expected[number].cam_from_world().matrix())
