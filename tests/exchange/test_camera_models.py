"""Photographs of every camera model of COLMAP: rendered pinhole images, warped, imported, mapped and localized."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from tests.calls import call
from tests.rendered import write_retrieval
from toolkit.capture import Capture, Trajectory
from toolkit.capture.images import read_image
from toolkit.exchange.interchange import import_colmap
from toolkit.files import SceneFiles
from toolkit.geometry import invert, pose_error, qt_from_pose
from toolkit.localize import localize_pairs

CENTER = "318 243"
MODELS = {
    "SIMPLE_PINHOLE": f"490 {CENTER}",
    "PINHOLE": f"490 495 {CENTER}",
    "SIMPLE_RADIAL": f"490 {CENTER} -0.12",
    "RADIAL": f"490 {CENTER} -0.15 0.03",
    "OPENCV": f"490 495 {CENTER} -0.2 0.06 0.002 -0.001",
    "FULL_OPENCV": f"490 495 {CENTER} -0.2 0.05 0.001 -0.001 0.01 0.02 0.01 0.005",
    "FOV": f"460 465 {CENTER} 0.8",
    "SIMPLE_FISHEYE": f"520 {CENTER}",
    "FISHEYE": f"520 525 {CENTER}",
    "SIMPLE_RADIAL_FISHEYE": f"520 {CENTER} 0.03",
    "RADIAL_FISHEYE": f"520 {CENTER} 0.03 -0.01",
    "OPENCV_FISHEYE": f"520 525 {CENTER} -0.03 0.01 -0.004 0.001",
    "THIN_PRISM_FISHEYE": f"520 525 {CENTER} -0.03 0.01 0.001 -0.001 0.002 0.001 0.001 -0.002",
    "RAD_TAN_THIN_PRISM_FISHEYE": f"520 525 {CENTER} -0.03 0.01 0 0 0 0 0.001 -0.001 0.001 0 -0.001 0",
    "SIMPLE_DIVISION": f"500 {CENTER} -0.1",
    "DIVISION": f"500 505 {CENTER} -0.1",
    "EUCM": f"480 485 {CENTER} 0.6 1.1",
}
QUICK = ("OPENCV", "RAD_TAN_THIN_PRISM_FISHEYE")
HOLD_OUT = 3


def rays_of(camera: pycolmap.Camera) -> NDArray[np.float64]:
    """Return the direction (H, W, 3) in which each pixel looks."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).reshape(-1, 2) + 0.5
    return np.asarray(camera.cam_ray_from_img(grid)).reshape(camera.height, camera.width, 3)


def warped(pixels: NDArray[np.uint8], pinhole: pycolmap.Camera, rays: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the image that a camera with these rays takes from the same place; black beyond the pinhole image."""
    seen = np.asarray(pinhole.img_from_cam(rays.reshape(-1, 3))) - 0.5
    x, y = seen.T.reshape(2, *rays.shape[:2]).astype(np.float32)
    return cv2.remap(pixels, x, y, cv2.INTER_AREA)  # type: ignore[return-value]


def write_model(folder: Path, small: Path, model: str) -> None:
    """Write the phone's images of a rendered capture, warped, and their poses as a COLMAP model."""
    (folder / "images").mkdir(parents=True)
    (folder / "model").mkdir()
    params = [float(word) for word in MODELS[model].split()]
    camera = pycolmap.Camera(model=model, width=640, height=480, params=params)
    (folder / "model" / "cameras.txt").write_text(f"1 {model} 640 480 {MODELS[model]}\n")
    capture, lines, rays = Capture.open(small), [], rays_of(camera)
    for name in ("ios_map", "ios_query"):
        session = capture[name]
        poses = session.world_from_cam(ground_truth=name == "ios_query")
        for row, pose in enumerate(poses):
            # Every third name is that of a query.
            file = f"{row // 2 * 3 + row % 2}.png" if name == "ios_map" else f"{3 * row + 2}.png"
            pixels = read_image(session.image_path(row))
            image = warped(pixels, session.cameras([row])[0], rays)
            cv2.imwrite(str(folder / "images" / file), image[..., ::-1])
            words = " ".join(repr(float(value)) for value in qt_from_pose(invert(pose)))
            lines.append(f"{len(lines) + 1} {words} 1 {file}\n\n")
    (folder / "model" / "images.txt").write_text("".join(lines))


@pytest.mark.parametrize(
    "model", [pytest.param(model, marks=() if model in QUICK else pytest.mark.slow) for model in MODELS]
)
def test_each_camera_model_localizes_as_the_pinhole(model: str, small_capture: Path, tmp_path: Path) -> None:
    write_model(tmp_path, small_capture, model)
    import_colmap(tmp_path / "model", tmp_path / "images", tmp_path / "SMALL", unit_m=1.0, hold_out=HOLD_OUT)
    capture, files = Capture.open(tmp_path / "SMALL"), SceneFiles(tmp_path / "run", "SMALL")
    queries = capture["ios_query"]
    assert queries.camera(str(queries.images["sensor_id"][0])).model.name == model
    write_retrieval(files.retrieval("ios", "ios"), capture["ios_map"], queries)
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    table = call(localize_pairs, capture.path / "sessions", *folders, features=["sift"], workers=1)
    assert table["ok"].tolist() == [3]
    poses = Trajectory.read(files.poses_txt("ios", "ios"))
    found = poses.lookup(queries.images["timestamp"], queries.device_ids)
    rotation_deg, distance_m = pose_error(found, queries.world_from_cam(ground_truth=True))
    assert rotation_deg.max() < 0.1
    assert distance_m.max() < 0.01


def test_every_camera_model_is_tested() -> None:
    assert set(MODELS) | {"INVALID", "EQUIRECTANGULAR"} == set(pycolmap.CameraModelId.__members__)
