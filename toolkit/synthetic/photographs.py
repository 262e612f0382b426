"""Arrange photographs with known poses as captures of a phone, a headset and a robot, by day or with hard queries.

Every image is a photograph seen through another pinhole camera at the same place: a homography, without parallax, so
that the new pose is as exact as the photograph's. The photographs are those of C. Strecha et al., "On Benchmarking
Camera Calibration and Multi-View Stereo for High Resolution Imagery", CVPR 2008, in the folders of openMVG's
SfM_quality_evaluation.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from toolkit.capture import Trajectory
from toolkit.capture.images import default_workers
from toolkit.errors import CaptureError
from toolkit.files import write_folder
from toolkit.geometry import Floats, invert, make_pose
from toolkit.manifest import nearest
from toolkit.synthetic.capture import (
    BODY_FROM_LEVEL_CAM,
    Device,
    Sensor,
    Tables,
    looking,
    names_of,
    save_image,
    shaken,
    subsession_of,
)
from toolkit.synthetic.render import named_rng
from toolkit.synthetic.textures import Image, Rng

KINDS = {"strecha": False, "strecha-hard": True}
"""By the name of the data set: whether queries are hard."""
SCENES = ("fountain-P11", "Herz-Jesus-P25", "entry-P10")
"""Scenes of the captures STRECHA and STRECHA_HARD."""
THRESHOLDS: Sequence[tuple[float, float]] = ((1.0, 0.1), (2.0, 0.25), (5.0, 0.5))
_APART_M = 100.0  # between the origins of two scenes
_OVERSAMPLING = 3  # per axis, against aliasing where an image is made smaller
_DAY_TURN_DEG, _NIGHT_TURN_DEG = 0.5, 6.0
"""Largest angle by which a camera is turned from its place on the device: yaw, pitch, roll."""
_ZOOM, _SMALLER = 1.25, 0.6
"""Of hard queries: focal length, in image widths, over that of the map; size of the images of headset and robot."""


def _device(gray: bool, rig: tuple[float, ...] | None, *sensors: Sensor) -> Device:
    return Device(sensors, 0, 0, gray, 0, 1, (1.0, 1.0, 1.0), 0, 0, 92, rig)


_DEVICES = {
    "ios": _device(False, None, Sensor("cam_phone", "PINHOLE", (960, 640), (927.0, 927.0, 481.8, 317.9))),
    "hl": _device(
        True, (0.36, 0.55, -0.42, 0.63, 0.08, -0.22, 0.31),
        Sensor("hetlf", "PINHOLE", (480, 640), (1042.0, 1038.0, 243.1, 316.4), yaw_deg=11.8, pitch_deg=0.4),
        Sensor("hetrf", "PINHOLE", (480, 640), (1106.0, 1110.0, 237.4, 322.9), yaw_deg=-12.0, roll_deg=90.0),
    ),
    "spot": _device(
        True, (1.0, 0.0, 0.0, 0.0, 0.4, 0.03, 0.12),
        Sensor("frontleft", "PINHOLE", (640, 480), (932.0, 928.0, 318.7, 242.2), (0, 0, 0), 7.6, -2.8, 2.6),
        Sensor("frontright", "PINHOLE", (640, 480), (926.0, 922.0, 322.6, 237.3), (0, 0, 0), -8.3, 1.5, -4.2),
        Sensor("left", "PINHOLE", (640, 480), (1043.0, 1038.0, 315.9, 239.7), (0, 0, 0), 9.2, 2.8, 5.6),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Photograph:
    """A photograph of a scene."""

    path: Path
    matrix: Floats
    """Intrinsics (3, 3), pixels; the center of the top-left pixel is (0.5, 0.5)."""
    size: tuple[int, int]
    world_from_cam: Floats
    """Pose (4, 4), meters; z of the world points down."""


def arrange(path: str | Path, out: str | Path, scenes: tuple[str, ...] = SCENES, hard: bool = False, seed: int = 0,
            ) -> Path:  # fmt: skip
    """Write a capture of photographs that three devices share, in sessions of a map and of queries; return its folder.

    Two photographs of five are queries, interleaved along the path. With `hard`, two of three are, and they are by
    night: dark but for a pool of light, blurred by motion, noisy, zoomed in, turned by some degrees, and partly hidden.
    `path` has the scenes' folders, each with images/ and gt_dense_cameras/; the origins of their worlds are put 100 m
    apart. The same seed gives the same poses and the same images. Raise CaptureError if a scene or a file of it is
    missing or malformed, or `out` exists.
    """
    out = Path(out)
    if out.exists() and any(out.iterdir()):
        raise CaptureError.at(out, "files", "no such folder, or an empty one", "Remove it, or name another.")
    tables = {f"{name}_{split}": Tables() for name in _DEVICES for split in ("map", "query")}
    with write_folder(out) as folder, ThreadPoolExecutor(default_workers()) as pool:
        for index, scene in enumerate(scenes):
            shots = list[Shot]()
            for number, photograph in enumerate(_along_the_path(_read_scene(Path(path), scene))):
                split = "query" if (number % 3 != 1 if hard else number % 5 in (1, 3)) else "map"
                for name in _DEVICES:
                    shots += _plan(tables[f"{name}_{split}"], split, name, index, number, photograph, hard, seed)
            # One photograph after the other, as each is decoded once for all devices.
            shots.sort(key=lambda shot: shot[0].path)
            list(pool.map(partial(_take, folder / "sessions", seed), shots))
        for session, table in tables.items():
            _write(folder / "sessions" / session, table)
    return out


def _read_scene(root: Path, scene: str) -> list[Photograph]:
    folder = root / scene
    cameras = sorted((folder / "gt_dense_cameras").glob("*.camera"))
    if not cameras:
        known = [path.parent.name for path in root.glob("*/gt_dense_cameras")]
        do = f"{nearest(scene, known)} Give the folder Benchmarking_Camera_Calibration_2008 of SfM_quality_evaluation."
        raise CaptureError.at(folder, "no gt_dense_cameras/*.camera", "a scene as openMVG publishes it", do)
    photographs = []
    for file in cameras:
        try:
            numbers = np.array(file.read_text().split(), np.float64)
            matrix, rotation, center = numbers[:9].reshape(3, 3), numbers[12:21].reshape(3, 3), numbers[21:24]
            width, height = numbers[24:].astype(int).tolist()
        except (OSError, ValueError):
            expected = "K (9 numbers), distortion (3), R (9), center (3), width and height"
            raise CaptureError.at(file, "other content", expected, "Unpack the scene again.") from None
        image = folder / "images" / file.stem
        photographs.append(Photograph(image, matrix, (width, height), make_pose(rotation, center)))
    return photographs


def _along_the_path(photographs: list[Photograph]) -> list[Photograph]:
    """Return photographs in the order of their centers along the direction in which they spread most."""
    centers = np.stack([one.world_from_cam[:3, 3] for one in photographs])
    axis = np.linalg.svd(centers - centers.mean(axis=0))[2][0]
    return [photographs[k] for k in np.argsort(centers @ axis * np.sign(axis[np.abs(axis).argmax()]))]


Shot = tuple[Photograph, str, Sensor, bool, bool, Floats, str]
"""Photograph, session, sensor as it is in this image, gray?, hard?, photo_from_cam (3, 3), path of the image."""


def _plan(table: Tables, split: str, name: str, scene: int, number: int, photograph: Photograph, hard: bool, seed: int,
          ) -> Iterator[Shot]:  # fmt: skip
    """Add a frame to the tables of its session, and yield its images."""
    night = hard and split == "query"
    device = _DEVICES[name]
    smaller = _SMALLER if name != "ios" else 1.0
    if night:
        device = replace(device, sensors=tuple(_resized(one, smaller, _ZOOM) for one in device.sensors))
    rng = named_rng(seed, scene, "frame", name, split, number)
    subsession, start = subsession_of(name, split, scene, 1)
    table.subsessions[subsession] = start
    timestamp = start + 1_000_000 * (5 + 2 * number) + int(rng.integers(0, 700_000))
    if name == "ios":
        zoom = float(np.round(rng.normal(1, 0.006), 5))
        device = replace(device, sensors=(_resized(device.sensors[0], 1.0, zoom),))
    turn = rng.uniform(-1, 1, 3) * (_NIGHT_TURN_DEG if night else _DAY_TURN_DEG)
    level_from_body = invert(BODY_FROM_LEVEL_CAM)
    while True:
        turned = make_pose(looking(*turn), (0, 0, 0))  # body_from_cam of a camera that was at the photograph's
        photo_from_body = level_from_body @ turned @ level_from_body
        views = [(photo_from_body @ sensor.body_from_cam)[:3, :3] for sensor in device.sensors]
        if all(_is_covered(photograph, *pair) for pair in zip(device.sensors, views, strict=True)):
            break
        if np.abs(turn).max() < 1e-3:
            raise CaptureError(f"{photograph.path}: its field of view is too small for the cameras of {name}.")
        turn *= 0.8
    world_from_photo = photograph.world_from_cam.copy()
    world_from_photo[0, 3] += _APART_M * scene
    device_id, body_from_device = table.add_frame(name, device, subsession, timestamp)
    table.poses.append((timestamp, device_id, world_from_photo @ photo_from_body @ body_from_device))
    for sensor, photo_from_cam in zip(device.sensors, views, strict=True):
        sensor_id, folder, stem = names_of(name, sensor, subsession, timestamp)
        image = f"{subsession}/{folder}{stem}.jpg"
        table.images.append((timestamp, sensor_id, image))
        yield photograph, f"{name}_{split}", sensor, device.gray, night, photo_from_cam, image


def _resized(sensor: Sensor, size: float, zoom: float) -> Sensor:
    """Return a sensor with images of another size, and of another focal length in image widths."""
    width, height = (round(size * side) for side in sensor.size)
    fx, fy, cx, cy = sensor.params
    params = (fx * size * zoom, fy * size * zoom, cx * size, cy * size)
    return replace(sensor, size=(width, height), params=tuple(round(value, 3) for value in params))


def _matrix(sensor: Sensor) -> Floats:
    fx, fy, cx, cy = sensor.params
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _is_covered(photograph: Photograph, sensor: Sensor, photo_from_cam: Floats) -> bool:
    """Tell whether all of an image is seen in a photograph."""
    width, height = sensor.size
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1.0]])
    seen = corners @ (photograph.matrix @ photo_from_cam @ np.linalg.inv(_matrix(sensor))).T
    xy = seen[:, :2] / seen[:, 2:]
    return bool((seen[:, 2] > 0).all() and (xy > 2).all() and (xy < np.array(photograph.size) - 2).all())


@lru_cache(maxsize=4)
def _decoded(path: Path) -> Image:
    image = cv2.imread(str(path))
    if image is None:
        raise CaptureError(f"{path}: no such image, or it cannot be decoded. Unpack the scene again.")
    return image


def _take(sessions: Path, seed: int, shot: Shot) -> None:
    photograph, session, sensor, gray, night, photo_from_cam, path = shot
    width, height = sensor.size
    to_large = np.diag([_OVERSAMPLING, _OVERSAMPLING, 1.0])
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])  # OpenCV's pixel centers are whole numbers
    photo_from_large = photograph.matrix @ photo_from_cam @ np.linalg.inv(to_large @ _matrix(sensor))
    warp = half @ photo_from_large @ np.linalg.inv(half)
    large = cv2.warpPerspective(
        _decoded(photograph.path), warp, (width * _OVERSAMPLING, height * _OVERSAMPLING),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )  # fmt: skip
    image = cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA)
    rng, quality = named_rng(seed, "light", session, path), 92
    if night:
        quality = int(rng.integers(60, 71))
        image = _by_night(image, rng, gray, blur=0.012 if session.startswith("spot") else 0.006)
    if gray:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    save_image(sessions / session / "raw_data" / path, image, [cv2.IMWRITE_JPEG_QUALITY, quality])


def _by_night(image: Image, rng: Rng, gray: bool, blur: float) -> Image:
    """Return an image in the dark with a pool of light, shaken over `blur` of its width at most, and partly hidden."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width] / width
    center, radius = rng.uniform((0.3, 0.3 * height / width), (0.7, 0.7 * height / width)), rng.uniform(0.3, 0.5)
    pool = 0.12 + np.exp(-0.5 * ((x - center[0]) ** 2 + (y - center[1]) ** 2) / radius**2)
    exponent, gain = rng.uniform((0.8, 0.35), (1.2, 0.7))
    light: Floats = gain * pool[..., None] * (image.astype(np.float64) / 255) ** exponent
    if not gray:
        light *= rng.uniform((0.6, 0.8, 0.95), (0.85, 0.95, 1.1))
    for _ in range(rng.integers(1, 3)):
        light = _hide(light, rng, x, y)
    longest = max(2, round(blur * width))
    blurred: Floats = shaken(light.astype(np.float32), int(rng.integers(2, longest + 1)), rng.uniform(0, np.pi))
    noisy = blurred + rng.normal(0, 1, blurred.shape) * np.sqrt(4e-5 + 6e-4 * np.clip(blurred, 0, 1))
    return (255 * np.clip(noisy, 0, 1) + 0.5).astype(np.uint8)


def _hide(light: Floats, rng: Rng, x: Floats, y: Floats) -> Floats:
    """Return an image behind an opaque, textured blob with soft edges over about a tenth of it."""
    height, width = light.shape[:2]
    waves = rng.uniform(-0.15, 0.15, 4)
    center = rng.uniform((0, 0), (1, height / width))
    angle = np.arctan2(y - center[1], x - center[0])
    radius = np.sqrt(rng.uniform(0.08, 0.13) * height / width / np.pi)
    edge = radius * (1 + sum(wave * np.sin((k + 2) * angle + 9 * wave) for k, wave in enumerate(waves)))
    opaque = 1 / (1 + np.exp((np.hypot(x - center[0], y - center[1]) - edge) * 0.15 * width))
    texture = rng.uniform(0.1, 0.35, 3) * rng.uniform(0.8, 1.2, (height // 8 + 1, width // 8 + 1, 1))
    smooth = np.asarray(cv2.resize(texture, (width, height), interpolation=cv2.INTER_CUBIC), np.float64)
    return light * (1 - opaque[..., None]) + smooth * opaque[..., None]


def _write(path: Path, table: Tables) -> None:
    rows = sorted(table.poses, key=lambda row: row[:2])
    times, ids = [row[0] for row in rows], [row[1] for row in rows]
    trajectory = Trajectory.from_poses(np.array(times, np.int64), ids, np.stack([row[2] for row in rows]))
    frames = pd.DataFrame({"timestamp": times, "device_id": ids})
    lists = {"original": frames, "pruned": frames, "pruned_subsampled": frames[np.arange(len(frames)) % 5 != 4]}
    table.write(path, trajectory, None, lists)
