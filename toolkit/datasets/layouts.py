"""Import data sets of the field, in the layout in which they are published, with their own split, truth and thresholds.

Layouts: 7-Scenes (J. Shotton et al., CVPR 2013), 12-Scenes (J. Valentin et al., 3DV 2016), Cambridge Landmarks (A.
Kendall et al., ICCV 2015), Aachen Day-Night v1.1 (Z. Zhang et al., IJCV 2021), ETH3D (T. Schöps et al., CVPR 2017),
TUM RGB-D (J. Sturm et al., IROS 2012), KITTI odometry (A. Geiger et al., CVPR 2012), EuRoC MAV (M. Burri et al., IJRR
2016).
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import yaml

from toolkit.capture.images import stored_size
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.exchange.colmap_model import ColmapModel, inverse, read_model
from toolkit.exchange.drafts import every_nth, start
from toolkit.exchange.import_report import ImportReport
from toolkit.exchange.interchange import camera_at
from toolkit.exchange.recordings import MAX_OFFSET_S, lines_of, numbers_of, read_track
from toolkit.geometry import Floats, invert, make_pose, pose_from_qt
from toolkit.manifest import nearest, require_known

HOLD_OUT = 8
"""Every such image becomes a query, in data sets without a split."""
_SEVEN_SCENES = (525.0, 525.0, 320.0, 240.0)  # of the color camera, as usual for this data set; none is published
_TWELVE_SCENES = (572.0, 572.0, 320.0, 240.0)  # at 640 x 480, where a scene has no info.txt
_TUM = {
    "freiburg1": "FULL_OPENCV, 640, 480, 517.3, 516.5, 318.6, 255.3, .2624, -.9531, -.0054, .0026, 1.1633, 0, 0, 0",
    "freiburg2": "FULL_OPENCV, 640, 480, 520.9, 521.0, 325.1, 249.7, .2312, -.7849, -.0033, -.0001, .9172, 0, 0, 0",
    "freiburg3": "PINHOLE, 640, 480, 535.4, 539.2, 320.1, 247.6",
}
"""Intrinsics of the color cameras, from the data set's page."""


class ListedImage(NamedTuple):
    """An image of a data set."""

    name: str  # path in the folder of the images
    split: str  # `map` or `query`; empty if the data set has no split
    camera: pycolmap.Camera | str  # intrinsics, or why there are none
    pose: Floats | str | None  # world_from_cam (4, 4), meters; None: not published; or why there is none
    time_us: int | None = None


class Layout(NamedTuple):
    """How a data set is read."""

    read: Callable[[Path], tuple[Path, list[ListedImage]]]  # from a scene's folder: the folder of its images, and these
    thresholds: Sequence[tuple[float, float]]  # of recall, as usual for the data set: degrees, meters
    example: str  # a file that tells a scene's folder
    depth: Callable[[Path], dict[str, Any]] = lambda _: {}
    """Returns the `drafts.Options` that tell where in a scene's folder depth maps are, and their camera and unit."""


def import_dataset(
    kind: str, path: str | Path, capture: str | Path, scene: str | None = None, device: str = "ios",
    every: int = 1, **options: Any,
) -> ImportReport:  # fmt: skip
    """Make a map and a query session from a data set of the field.

    Args:
        kind: one of `LAYOUTS`.
        path: folder of the data set, or of one of its scenes.
        scene: folder of the scene in `path`, such as `chess`; None: `path` is the scene.
        every: take only every such image of each folder.
        options: see `drafts.Options`; in data sets without a split, `hold_out` is `HOLD_OUT` by default.

    Raises:
        ManifestError: an unknown kind, scene, device or placing.
        CaptureError: a file of the data set is missing or malformed (names file and line); a session exists already,
            or has no usable image.
    """
    require_known("dataset", kind, LAYOUTS)
    if every < 1:
        raise ManifestError(f"every: found {every}, expected at least 1.")
    layout, folder = LAYOUTS[kind], Path(path) / (scene or "")
    if not any(folder.glob(layout.example)):
        scenes = sorted({match.parents[layout.example.count("/")] for match in Path(path).rglob(layout.example)})
        known = [one.relative_to(path).as_posix() for one in scenes]
        found = f"no {layout.example}" if folder.is_dir() else "no such folder"
        do = f"Give --scene: {nearest(scene or '', known)}" if known else "Give the unpacked folder of the data set."
        raise CaptureError.at(folder, found, "a scene in the layout in which it is published", do)
    root, images = layout.read(folder)
    options["unit_m"], options["hold_out"] = 1.0, options.get("hold_out") or HOLD_OUT
    if options.get("depth") is None:
        options |= layout.depth(folder)
    draft = start(capture, device, "map", root, **options)
    draft.record["meters"] = f"the files of {kind}"
    numbers, taken = Counter[str](), list[ListedImage]()
    for image in sorted(images, key=lambda image: image.name):
        number = numbers[parent := str(Path(image.name).parent)]
        numbers[parent] += 1
        if number % every:
            draft.others.setdefault("not taken by --every", []).append(image.name)
            continue
        taken.append(image)
        draft.add_image(image.name, image.camera, image.pose, f"given by {kind}", image.time_us)
    draft.convention = f"as published by {kind}"
    without_split = not any(image.split for image in taken)
    held = every_nth([image.name for image in taken], draft.hold_out) if without_split else set()
    return draft.finish(held | {image.name for image in taken if image.split == "query"})


# Reading


def _pose_of(image: Path) -> Floats | str:
    """Return the pose (4, 4) in `frame-000000.pose.txt` beside an image, or why there is none: tracking was lost."""
    path = image.with_name(f"{image.name.split('.')[0]}.pose.txt")
    try:
        rows = np.array([numbers_of(where, words, 4) for where, words in lines_of(path)])
    except CaptureError as error:
        return str(error)
    is_pose = rows.shape == (4, 4) and np.isfinite(rows).all()
    return rows if is_pose and abs(np.linalg.det(rows[:3, :3]) - 1) < 0.01 else f"{path.name}: no pose in it"


def _nearest_pose(path: Path, unit: str) -> Callable[[int], Floats | str]:
    """Return a function that returns the pose of a list that is nearest to a time, microseconds."""
    track = read_track(path, unit)
    if track is None:
        raise CaptureError(f"{path}: no list of poses over time. It is part of the data set.")

    def at(time_us: int) -> Floats | str:
        row = track.nearest(time_us)
        return f"no true pose within {MAX_OFFSET_S:g} s" if row is None else np.asarray(track.poses[row])

    return at


def _first(paths: Iterable[Path], folder: Path, expected: str) -> Path:
    path = next(iter(sorted(paths)), None)
    if path is None:
        raise CaptureError(f"{folder}: no {expected}. It is part of the data set: unpack all of it.")
    return path


def _first_size(paths: Iterable[Path], folder: Path, expected: str) -> tuple[int, int]:
    first = _first(paths, folder, expected)
    try:
        return stored_size(first)
    except ImageError as error:
        raise CaptureError(f"{first}: {error}.") from None


# The layouts


def _seven_scenes(folder: Path) -> tuple[Path, list[ListedImage]]:
    camera = camera_at(folder, ", ".join(map(str, ("PINHOLE", 640, 480, *_SEVEN_SCENES))))
    images = []
    for file, split in (("TrainSplit.txt", "map"), ("TestSplit.txt", "query")):
        for where, (word, *_) in lines_of(folder / file):
            number = re.search(r"\d+$", word)
            if number is None:
                raise CaptureError(f"{where}: found {word!r}, expected a sequence, such as sequence1.")
            recording = folder / f"seq-{int(number[0]):02d}"
            if not recording.is_dir():
                raise CaptureError(f"{recording}: no such folder. Unpack {recording.name}.zip there.")
            images += [
                ListedImage(path.relative_to(folder).as_posix(), split, camera, _pose_of(path))
                for path in recording.glob("*.color.png")
            ]
    return folder, images


def _twelve_scenes(folder: Path) -> tuple[Path, list[ListedImage]]:
    size = _first_size((folder / "data").glob("*.color.jpg"), folder, "data/*.color.jpg")
    camera = camera_at(folder / "info.txt", _twelve_scenes_camera(folder, "Color", size))
    # The first sequence is for tests: `sequence0 [frames=357]  [start=0 ; end=356]`.
    ranges = [words for _, words in lines_of(folder / "split.txt") if words[0].startswith("sequence")]
    found = re.search(r"start\s*=\s*(\d+).*?end\s*=\s*(\d+)", " ".join(ranges[0])) if ranges else None
    if found is None:
        raise CaptureError(f"{folder / 'split.txt'}: expected `sequence0 ... [start=0 ; end=356]`.")
    tested, images = range(int(found[1]), int(found[2]) + 1), []
    for path in (folder / "data").glob("*.color.jpg"):
        split = "query" if int(re.sub(r"\D", "", path.name.split(".")[0]) or -1) in tested else "map"
        name = path.relative_to(folder).as_posix()
        images.append(ListedImage(name, split, camera, _pose_of(path)))
    return folder, images


def _twelve_scenes_camera(folder: Path, which: str, size: tuple[int, int]) -> str:
    fx, fy, cx, cy = np.array(_TWELVE_SCENES) * size[0] / 640
    for where, words in lines_of(folder / "info.txt") if (folder / "info.txt").is_file() else ():
        if words[0] == f"m_calibration{which}Intrinsic":
            fx, _, cx, _, _, fy, cy = numbers_of(where, words[2:], 7)
    return f"PINHOLE, {size[0]}, {size[1]}, {fx}, {fy}, {cx}, {cy}"


def _depth_of_twelve_scenes(folder: Path) -> dict[str, Any]:
    try:
        size = _first_size((folder / "data").glob("*.depth.png"), folder, "data/*.depth.png")
    except CaptureError:  # there is no depth map
        return {}
    return {"depth": folder, "depth_camera": _twelve_scenes_camera(folder, "Depth", size)}


def _depth_in(name: str, pattern: str, **options: Any) -> Callable[[Path], dict[str, Any]]:
    return lambda folder: {"depth": folder / name, **options} if any(folder.glob(pattern)) else {}


def _cambridge(folder: Path) -> tuple[Path, list[ListedImage]]:
    """Read the lists of training and test images: the camera's center, and the rotation of cam_from_world. Focal
    lengths are those of the structure from motion, if it is there.
    """
    focals = dict[str, float]()
    if (folder / "reconstruction.nvm").is_file():
        for _, words in lines_of(folder / "reconstruction.nvm"):
            if len(words) == 11:
                focals[Path(words[0]).with_suffix("").as_posix()] = float(words[1])
            elif len(words) == 1 and focals:
                break  # points follow
    usual, images = float(np.median([*focals.values()])) if focals else np.nan, list[ListedImage]()
    for file, split in (("dataset_train.txt", "map"), ("dataset_test.txt", "query")):
        for where, (name, *words) in lines_of(folder / file):
            if len(words) != 7 or not re.search(r"\.\w+$", name):
                continue  # the header
            center, quaternion = np.split(numbers_of(where, words, 7), [3])
            rotation = pose_from_qt([*quaternion / np.linalg.norm(quaternion), 0, 0, 0])[:3, :3].T
            camera: pycolmap.Camera | str
            try:
                width, height = size = stored_size(folder / name)
                focal = focals.get(Path(name).with_suffix("").as_posix(), usual)
                focal = focal if np.isfinite(focal) else 1670.0 * max(size) / 1920  # that of the phone, as often used
                camera = camera_at(where, f"SIMPLE_PINHOLE, {width}, {height}, {focal}, {width / 2}, {height / 2}")
            except ImageError as error:
                camera = str(error)
            images.append(ListedImage(name, split, camera, make_pose(rotation, center)))
    return folder, images


def _aachen(folder: Path) -> tuple[Path, list[ListedImage]]:
    model = read_model(_first(folder.glob("3D-models/**/images.bin"), folder, "3D-models/*/images.bin").parent)
    choices = (folder / "images_upright", folder / "images" / "images_upright")
    root = _first(filter(Path.is_dir, choices), folder, "images_upright")
    images = _of_model(model, "map")
    for path in sorted(folder.glob("queries/*_with_intrinsics.txt")):
        for where, (name, *words) in lines_of(path):
            images.append(ListedImage(name, "query", camera_at(where, ", ".join(words)), None))
    return root, images


def _eth3d(folder: Path) -> tuple[Path, list[ListedImage]]:
    model = read_model(folder / "dslr_calibration_undistorted")
    return folder / "images", _of_model(model, "")


def _of_model(model: ColmapModel, split: str) -> list[ListedImage]:
    images = []
    for image in model.images.values():
        camera, pose = model.cameras.get(image.camera_id, "its camera is not in the model"), image.cam_from_world
        images.append(ListedImage(image.name, split, camera, pose if isinstance(pose, str) else inverse(pose)))
    return images


def _tum(folder: Path) -> tuple[Path, list[ListedImage]]:
    kind = next((name for name in _TUM if name in folder.resolve().name), None)
    if kind is None:
        expected = f"a name with {', '.join(_TUM)}, which tells the camera"
        raise CaptureError.at(folder, folder.name, expected, "Name it as published.")
    camera = camera_at(folder, _TUM[kind])
    pose_at, images = _nearest_pose(folder / "groundtruth.txt", "s"), []
    for where, words in lines_of(folder / "rgb.txt"):
        time_us = round(float(numbers_of(where, words, 1)[0]) * 1e6)
        images.append(ListedImage(words[1], "", camera, pose_at(time_us), time_us))
    return folder, images


def _kitti(folder: Path) -> tuple[Path, list[ListedImage]]:
    """Read a sequence, `sequences/<NN>`, with its poses in `poses/<NN>.txt`: world_from_cam of the left gray camera."""
    truth = folder.parents[1] / "poses" / f"{folder.resolve().name}.txt"
    track = read_track(truth, "s")
    poses = np.zeros((0, 4, 4)) if track is None else track.poses
    times = [float(words[0]) for _, words in lines_of(folder / "times.txt")]
    number = 2 if (folder / "image_2").is_dir() else 0  # left color, or left gray
    projections = {words[0].rstrip(":"): (where, words[1:]) for where, words in lines_of(folder / "calib.txt")}
    if f"P{number}" not in projections:
        raise CaptureError(f"{folder / 'calib.txt'}: expected a line P{number}: and 12 numbers.")
    projection = numbers_of(*projections[f"P{number}"], 12).reshape(3, 4)
    cam_from_gray = make_pose(np.eye(3), np.linalg.solve(projection[:, :3], projection[:, 3]))
    files = sorted((folder / f"image_{number}").glob("*.png"))
    size = _first_size(files, folder, f"image_{number}/*.png")
    fx, fy, cx, cy = projection[0, 0], projection[1, 1], projection[0, 2], projection[1, 2]
    camera = camera_at(folder / "calib.txt", f"PINHOLE, {size[0]}, {size[1]}, {fx}, {fy}, {cx}, {cy}")
    images = []
    for file in files:
        row = int(file.stem)
        known = row < min(len(poses), len(times)) and bool(np.isfinite(poses[row]).all())
        pose = poses[row] @ invert(cam_from_gray) if known else f"not in {truth}"
        name, time_us = file.relative_to(folder).as_posix(), round(times[row] * 1e6) if known else None
        images.append(ListedImage(name, "", camera, pose, time_us))
    return folder, images


def _euroc(folder: Path) -> tuple[Path, list[ListedImage]]:
    """Read the left camera of a recording, with the true poses of the vehicle's body."""
    cam0 = folder / "mav0" / "cam0"
    try:
        sensor = yaml.safe_load((cam0 / "sensor.yaml").read_text(encoding="utf-8"))
        body_from_cam = np.array(sensor["T_BS"]["data"], float).reshape(4, 4)
        values = [*sensor["resolution"], *sensor["intrinsics"], *sensor["distortion_coefficients"]]
    except (OSError, KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        keys = "T_BS, resolution, intrinsics, distortion_coefficients"
        raise CaptureError(f"{cam0 / 'sensor.yaml'}: cannot be read ({error}). Expected {keys}.") from None
    camera = camera_at(cam0 / "sensor.yaml", ", ".join(map(str, ("OPENCV", *values))))
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    body_at, images = _nearest_pose(truth, "ns"), []
    for _, words in lines_of(cam0 / "data.csv"):
        time_us = int(words[0]) // 1000
        body = body_at(time_us)
        pose = body if isinstance(body, str) else body @ body_from_cam
        images.append(ListedImage(f"data/{words[1]}", "", camera, pose, time_us))
    return cam0, images


_DEPTH_585 = _depth_in("", "seq-*/*.depth.png", depth_camera="PINHOLE, 640, 480, 585, 585, 320, 240")  # from its page
_DEPTH_TUM = _depth_in("depth", "depth/*.png", depth_unit_mm=0.2)
LAYOUTS = {
    "7scenes": Layout(_seven_scenes, [(5.0, 0.05)], "TrainSplit.txt", _DEPTH_585),
    "12scenes": Layout(_twelve_scenes, [(5.0, 0.05)], "split.txt", _depth_of_twelve_scenes),
    "cambridge": Layout(_cambridge, [(5.0, 0.25), (5.0, 0.5)], "dataset_train.txt"),
    "aachen": Layout(_aachen, [(2.0, 0.25), (5.0, 0.5), (10.0, 5.0)], "3D-models"),
    "eth3d": Layout(_eth3d, [(1.0, 0.05), (5.0, 0.25)], "dslr_calibration_undistorted"),
    "tum": Layout(_tum, [(1.0, 0.05), (5.0, 0.25)], "groundtruth.txt", _DEPTH_TUM),
    "kitti": Layout(_kitti, [(1.0, 0.25), (2.0, 0.5)], "calib.txt"),
    "euroc": Layout(_euroc, [(1.0, 0.1), (5.0, 0.5)], "mav0"),
}
