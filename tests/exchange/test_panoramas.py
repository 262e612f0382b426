"""Panoramas: views see what the panorama shows, poses are those of the table, rendered ones are localized."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pycolmap
import pytest

from tests.unattended import no_kernels
from toolkit.capture import Capture, parse_camera
from toolkit.capture.images import invertible, rays_of, sees_all, view_bounds
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import CaptureError
from toolkit.exchange.interchange import YAWS_DEG, import_colmap, import_panoramas
from toolkit.features.features import LocalFeatures, usable
from toolkit.geometry import Floats, invert, make_pose, qt_from_pose, quaternion_to_rotation
from toolkit.pipeline import run
from toolkit.scene import Run
from toolkit.synthetic.capture import looking
from toolkit.synthetic.render import Rays, Scene, build_room, paint, render

WIDTH = 2048


def directions(width: int) -> Floats:
    """The viewing ray of each pixel of a panorama, (H, W, 3), by COLMAP's own model."""
    camera = pycolmap.Camera.create_from_model_name(0, "EQUIRECTANGULAR", 1.0, width, width // 2)
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(width // 2) + 0.5), -1).reshape(-1, 2)
    return np.asarray(camera.cam_ray_from_img(pixels)).reshape(width // 2, width, 3)


def save_panorama(path: Path, width: int = 512) -> None:
    """A panorama whose colors are the directions: red x, green y, blue z."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.round((directions(width)[..., ::-1] + 1) * 127.5).astype(np.uint8))


def write_table(path: Path, poses: dict[str, Floats]) -> Path:
    table = pd.DataFrame([qt_from_pose(pose) for pose in poses.values()], columns=list(POSE_NAMES))
    table.insert(0, "image", list(poses))
    table.to_csv(path, index=False)
    return path


def test_views_see_the_directions_of_the_panorama(tmp_path: Path) -> None:
    save_panorama(tmp_path / "photos/a/1.png")
    save_panorama(tmp_path / "photos/2.png", 640)
    cv2.imwrite(str(tmp_path / "photos/narrow.png"), np.zeros((100, 300, 3), np.uint8))
    mask = np.full((256, 512), 255, np.uint8)
    mask[:, :256] = 0  # everything to the left of the center
    (tmp_path / "masks/a").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "masks/a/1.png.png"), mask)
    pose = make_pose(quaternion_to_rotation([0.9, 0.1, -0.2, 0.3]), [4.0, 5.0, 6.0])
    table = write_table(tmp_path / "poses.csv", {"a/1.png": pose, "2.png": np.eye(4), "narrow.png": np.eye(4)})
    report = import_panoramas(tmp_path / "photos", tmp_path / "CAP", split="map", table=table)
    assert report.images.set_index("image")["status"]["narrow.png"].startswith("no equirectangular panorama: 300 x 100")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["CAP", "masks", "photos", "poses.csv"]
    session = Capture.open(tmp_path / "CAP")["ios_map"]
    assert len(session.images) == 2 * len(YAWS_DEG)
    for row, name in enumerate(session.image_names):
        camera, world_from_cam = session.cameras([row])[0], session.world_from_cam([row])[0]
        world_from_pano = pose if "/a/1/" in name else np.eye(4)
        assert camera.width == (162 if "/a/1/" in name else 204)
        assert np.allclose(world_from_cam[:3, 3], world_from_pano[:3, 3])
        pano_from_cam = world_from_pano[:3, :3].T @ world_from_cam[:3, :3]
        pixels = np.array([[0.5, 0.5], [50.5, 70.5], [camera.width - 0.5, 40.5]])
        expected = rays_of(camera, pixels) @ pano_from_cam.T
        view = cv2.imread(str(session.image_path(row)))[..., ::-1]
        seen = view[tuple(pixels.astype(int).T[::-1])] / 127.5 - 1
        assert np.abs(seen - expected).max() < 0.05, name
        if (mask_path := session.mask_path(row)) is not None:
            hidden = cv2.imread(str(mask_path), 0)
            assert np.array_equal(hidden[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] > 0, expected[:, 0] > 0)
    assert sum(session.mask_path(row) is not None for row in range(len(session.images))) == len(YAWS_DEG)


def test_times_and_odometry_are_those_of_the_panoramas(tmp_path: Path) -> None:
    for name in ("17.png", "18.png"):
        save_panorama(tmp_path / "photos" / name)
    (tmp_path / "odometry.txt").write_text("17 0 0 0 0 0 0 1\n18 1 0 0 0 0 0 1\n")
    (tmp_path / "gps.csv").write_text("image,latitude,longitude\n18.png,47,8\n")
    import_panoramas(
        tmp_path / "photos", tmp_path / "CAP", timestamps="names", timestamps_unit="s",
        odometry=tmp_path / "odometry.txt", fixes=tmp_path / "gps.csv",
    )  # fmt: skip
    session = Capture.open(tmp_path / "CAP")["ios_query"]
    assert sorted(set(session.images["timestamp"])) == [17_000_000, 18_000_000]
    assert session.odometry is not None
    assert session.odometry.timestamps.tolist() == [17_000_000, 18_000_000]
    assert set(session.odometry.device_ids) == set(session.device_ids)
    assert session.gps is not None
    assert session.gps["timestamp"].tolist() == [18_000_000]


@pytest.mark.parametrize(
    ("names", "split", "named"),
    [(["1.png"], "map", "A map needs poses"), (["1.png", "1.jpg"], "query", "two panoramas")],
)
def test_what_is_refused(names: list[str], split: str, named: str, tmp_path: Path) -> None:
    for name in names:
        save_panorama(tmp_path / "photos" / name)
    with pytest.raises(CaptureError, match=named):
        import_panoramas(tmp_path / "photos", tmp_path / "CAP", split=split)
    assert not (tmp_path / "CAP").exists()


def test_an_equirectangular_camera_is_refused_by_name(tmp_path: Path) -> None:
    """In a camera, and in a COLMAP model."""
    save_panorama(tmp_path / "photos/1.png")
    (tmp_path / "model").mkdir()
    (tmp_path / "model/cameras.txt").write_text("1 EQUIRECTANGULAR 512 256 512 256\n")
    (tmp_path / "model/images.txt").write_text("1 1 0 0 0 0 0 0 1 1.png\n\n")
    (tmp_path / "model/points3D.txt").write_text("")
    for error, read in (
        (ValueError, lambda: parse_camera("camera", "EQUIRECTANGULAR, 512, 256, 512, 256")),
        (CaptureError, lambda: import_colmap(tmp_path / "model", tmp_path / "photos", tmp_path / "CAP")),
    ):
        with pytest.raises(error, match=r"model 'EQUIRECTANGULAR': cut such images into views.*import panoramas"):
            read()


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE, 1000, 1000, 300, 300, 500, 500, 0, 0, 0, 0",
                                   "SIMPLE_RADIAL_FISHEYE, 1000, 1000, 300, 500, 500, 0"])  # fmt: skip
def test_features_beyond_half_a_sphere_are_cut(model: str) -> None:
    camera = parse_camera("camera", model)
    degrees = np.array([0.0, 60, 85, 92, 100, -95])
    keypoints = np.column_stack([500 + 300 * np.radians(degrees), np.full(6, 500.0)]).astype(np.float32)
    assert invertible(camera, keypoints).tolist() == [True, True, True, False, False, False]
    assert not sees_all(camera)
    ones = np.ones(6, np.float32)
    features = LocalFeatures(keypoints, ones, ones, np.zeros((6, 128), np.uint8), (1000, 1000))
    assert np.array_equal(usable(features, None, camera).keypoints, keypoints[:3])
    assert view_bounds(camera).tolist() == pytest.approx([-5, 5, -5, 5])
    narrow = parse_camera("camera", model.replace(", 300", ", 700"))
    assert sees_all(narrow)
    assert usable(features, None, narrow) is features


@cache
def cube(width: int) -> tuple[Rays, list[tuple[Floats, np.ndarray, list[np.ndarray]]]]:
    """Return the rays of a face of a cube, and for each face its axes in the panorama, and which pixels of the panorama
    see it where."""
    side = width // 3
    camera = pycolmap.Camera(model="PINHOLE", width=side, height=side, params=[side / 2] * 4)
    ways, faces = directions(width), []
    largest = np.abs(ways).argmax(axis=-1)
    for axis in range(3):
        for sign in (1, -1):
            z = np.zeros(3)
            z[axis] = sign
            y = np.array([0.0, 1, 0]) if axis != 1 else np.array([0.0, 0, 1])
            pano_from_face = np.stack([np.cross(y, z), y, z], axis=1)
            here = (largest == axis) & (np.sign(ways[..., axis]) == sign)
            at = ways @ pano_from_face
            depth = np.maximum(at[..., 2], 0.1)
            seen = [((at[..., k] / depth + 1) * side / 2 - 0.5).astype(np.float32) for k in (0, 1)]
            faces.append((pano_from_face, here, seen))
    return Rays.of(camera), faces


def rendered_panorama(scene: Scene, world_from_pano: Floats, width: int = WIDTH) -> np.ndarray:
    """Render the six faces of a cube, and put them together."""
    rays, faces = cube(width)
    panorama = np.zeros((width // 2, width, 3), np.float32)
    for pano_from_face, here, seen in faces:
        face, _ = render(scene.quads, world_from_pano @ make_pose(pano_from_face, np.zeros(3)), rays, False)
        panorama[here] = cv2.remap(face, *seen, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[here]
    return np.clip(panorama, 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_rendered_panoramas_are_localized_to_centimeters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = build_room(0, 0)
    for number in range(len(scene.quads)):
        paint(scene, 0, 0, number)
    rng, poses = np.random.default_rng(0), {}
    low, high = scene.origin[:2] - np.array(scene.size[:2]) / 4, scene.origin[:2] + np.array(scene.size[:2]) / 4
    for kind, count in (("map", 10), ("query", 4)):
        for number in range(count):
            at = [*rng.uniform(low, high), scene.origin[2] + rng.uniform(1.4, 1.7)]
            tilt = rng.normal(size=2) * 3
            pose = make_pose(looking(rng.uniform(0, 360), *tilt), at)
            path = tmp_path / kind / f"{number}.jpg"
            path.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(path), rendered_panorama(scene, pose), [cv2.IMWRITE_JPEG_QUALITY, 95])
            poses[kind, path.name] = pose
    for kind in ("map", "query"):
        named = {name: pose for (split, name), pose in poses.items() if split == kind}
        table = write_table(tmp_path / f"{kind}.csv", named)
        import_panoramas(tmp_path / kind, tmp_path / "PLACE", split=kind, table=table)
    manifest = tmp_path / "place.yaml"
    manifest.write_text(f"description: _\ncaptures: ['{tmp_path / 'PLACE'}']\noutput_root: '{tmp_path / 'runs'}'\n")
    with no_kernels():
        finished = Run.open(run(manifest, only="embed,retrieve,localize"))
    queries = finished.queries
    assert (queries["status"] == "ok").all()
    errors = []
    for row in range(len(queries)):
        result = finished.result(str(queries["image"][row]).split(";")[0])
        name = str(queries["image"][row]).split("/")[0] + ".jpg"
        true = poses["query", name]
        assert result.world_from_rig is not None
        apart = invert(true) @ result.world_from_rig
        angle_deg = np.degrees(np.linalg.norm(apart[:3, :3] - np.eye(3)) / np.sqrt(2))
        errors.append([np.linalg.norm(apart[:3, 3]), angle_deg])
    assert len(errors) == 4
    assert (np.max(errors, axis=0) < [0.02, 0.1]).all(), errors
