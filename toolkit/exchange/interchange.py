"""Import COLMAP models, folders of images, panoramas, and transforms.json as sessions of a capture (see `drafts`).

A folder of images may have a table, a CSV file with a header. Column `image` is the path in the folder; `qw qx qy qz tx
ty tz` are the pose; `timestamp` is the time; `camera_id` names a camera in a COLMAP `cameras.txt`, or `model width
height params` (params separated by spaces) give the camera directly. In its place, hloc's query list, `name MODEL width
height parameters` per line, is accepted, and lists of poses without names, see `recordings.read_track`.

In transforms.json, nerfstudio and instant-ngp store images, cameras and poses. Each entry of `frames` may have these
keys; keys it lacks are read from the top level of the file (not `file_path`):

- `file_path`: relative to the folder of the file, with or without extension. `transform_matrix`: world_from_cam with
  OpenGL camera axes: x right, y up, z backward.
- `fl_x fl_y cx cy` in pixels, `w h`. Instead of the focal lengths, `camera_angle_x camera_angle_y` may give the fields
  of view in radians: f = (w / 2) / tan(angle / 2). The center of the top-left pixel is (0.5, 0.5), as in COLMAP, where
  these numbers come from.
- `k1 k2 k3 p1 p2`: OpenCV distortion. If `camera_model` is OPENCV_FISHEYE or `is_fisheye` is set, `k1 k2 k3 k4` are the
  coefficients of OpenCV's fisheye model (J. Kannala and S. Brandt, "A generic camera model and calibration method for
  conventional, wide-angle, and fish-eye lenses", PAMI 2006).

Keys for rendering (`aabb_scale`, `scale`, `offset`, masks, depths) are ignored. The matrices already include
`applied_transform` and `applied_scale`, by which nerfstudio has changed the world of its input; they can be undone.
`train_filenames`, `val_filenames` and `test_filenames` are the images of the map and, of the last two, the queries.
"""

import json
import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Session, parse_camera
from toolkit.capture.images import (
    camera_text,
    decode,
    default_workers,
    find_mask,
    heic_is_read,
    is_file,
    prefetch,
    read_header,
    read_image,
)
from toolkit.capture.session import IMPORT_RECORD
from toolkit.capture.tables import FARTHEST_M, POSE_NAMES
from toolkit.errors import COMMAND, CaptureError, ImageError, ManifestError
from toolkit.exchange.colmap_model import NORM_TOLERANCE, inverse, read_cameras, read_model
from toolkit.exchange.drafts import (
    AXES,
    FROM_ELSEWHERE,
    HEIC_SUFFIXES,
    IMAGE_SUFFIXES,
    READ_SUFFIXES,
    SUBSESSION,
    Draft,
    DraftImage,
    end_below,
    every_nth,
    list_images,
    start,
)
from toolkit.exchange.import_report import ImportReport
from toolkit.exchange.recordings import (
    MAX_OFFSET_S,
    NAMES,
    Track,
    lines_of_images,
    read_csv,
    read_text,
    read_times,
    read_track,
    to_us,
)
from toolkit.files import file_fingerprint, files_fingerprint, read_json
from toolkit.geometry import Floats, invert, make_pose, pose_from_qt, qt_from_pose
from toolkit.manifest import nearest, require_known
from toolkit.scene.query import MapCameras, known_camera

POSE_DIRECTIONS = ("world_from_cam", "cam_from_world", "rotation_of_cam_from_world")
_CAMERA_COLUMNS = ("model", "width", "height", "params")
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = "OPENCV_FISHEYE"
TOLERANCE = 1e-3  # largest deviation of R^T R from the identity, per element, that still counts as a rotation
YAWS_DEG = (0, 60, 120, 180, 240, 300)  # of the views, of 90 degrees each: neighbors share a third
_LARGEST = 2**15 - 1  # side of an image that cv2.remap can read, pixels


def import_colmap(
    model: str | Path, images: str | Path, capture: str | Path, device: str = "ios", split: str = "map",
    **options: Any,
) -> ImportReport:  # fmt: skip
    """Make a session from a COLMAP model and its images: cameras, poses, and the rigs that have several cameras.

    Images of the folder that are not in the model are left out and counted; points and tracks are dropped, because the
    toolkit triangulates its own map.

    Args:
        model: folder with cameras, images (and rigs, frames), as .bin or .txt; or the folder of one such folder.
        images: folder that the model's image names are relative to.
        device, split: the session is `<device>_<split>`. Poses of queries become their ground truth.
        options: see `drafts.Options`.

    Raises:
        CaptureError: no model in the folder, or a damaged one; the session exists already, or no image is left.
        ManifestError: as for `drafts.start`.
    """
    draft = start(capture, device, split, Path(images), **options)
    content = read_model(Path(model))
    draft.notes += content.notes
    draft.convention, draft.listed_in = "cam_from_world of the model", "the model"
    draft.frames_are_names = False
    of_rigs = ((frame_id, frame) for frame_id, frame in content.frames.items() if frame.rig_id in content.rigs)
    rig_of_image = {image_id: (frame_id, frame) for frame_id, frame in of_rigs for image_id in frame.image_ids}
    sensors = _sensors_of_rigs(content.rigs)
    draft.rigs = [
        (f"{SUBSESSION}/rig_{rig_id}", sensors[rig_id, camera_id], inverse(sensor_from_rig))
        for rig_id, cameras in sorted(content.rigs.items())
        for camera_id, sensor_from_rig in sorted(cameras.items()) if sensor_from_rig is not None
    ]  # fmt: skip
    moved, names = 0, set[str]()
    for image_id, image in sorted(content.images.items()):
        frame_id, frame = rig_of_image.get(image_id, (f"image {image_id}", None))  # a frame may have the same number
        camera, pose = content.cameras.get(image.camera_id, "its camera is not in the model"), image.cam_from_world
        rig_name, sensor = None, f"{SUBSESSION}/cam_{image.camera_id}"
        if frame is not None:
            rig_name, sensor = f"{SUBSESSION}/rig_{frame.rig_id}", sensors.get((frame.rig_id, image.camera_id), sensor)
            sensor_from_rig = content.rigs[frame.rig_id].get(image.camera_id)
            pose = "its camera has no pose in its rig" if sensor_from_rig is None else frame.rig_from_world
            if not (sensor_from_rig is None or isinstance(pose, str) or isinstance(image.cam_from_world, str)):
                by_rig, own = (sensor_from_rig * pose).matrix(), image.cam_from_world.matrix()
                moved += not np.allclose(by_rig, own, rtol=1e-4, atol=1e-4)
        if image.name in names:
            draft.rows.append({"image": image.name, "status": "its name occurs twice in the model"})
        elif isinstance(camera, str) or isinstance(pose, str):
            draft.rows.append({"image": image.name, "status": camera if isinstance(camera, str) else pose})
        else:
            draft.images.append(DraftImage(image.name, camera, sensor, f"{frame_id}", rig_name, "given by the model"))
            draft.poses[f"{frame_id}"] = inverse(pose)
        names.add(image.name)
    if moved:
        draft.notes.append(f"{moved} images have another pose than their rig gives them: that of the rig is taken")
    return draft.finish()


def import_images(
    images: str | Path, capture: str | Path, device: str = "ios", split: str = "query", table: str | Path | None = None,
    poses_are: str = "world_from_cam", camera: str | None = None, cameras: str | Path | None = None,
    truth: str | Path | None = None, only: Sequence[str] | None = None, skip: Sequence[str] | None = None,
    **options: Any,
) -> ImportReport:  # fmt: skip
    """Make a session from a folder of images without rigs.

    Intrinsics come from the table, else from `cameras`, else from `camera`; else they are, for queries, those of the
    map's camera that took the image, see `scene.query.known_camera`, or guessed from its EXIF.

    Args:
        images: folder; without a table, all JPEG and PNG files in and below it are imported.
        device, split: as for `import_colmap`. A map needs poses.
        table: CSV file, see the module's docstring.
        poses_are: direction of the poses in table and truth: `world_from_cam`, `cam_from_world`, or
            `rotation_of_cam_from_world`, whose positions are the camera centers, as in NVM and Bundler.
        camera: intrinsics of all images, `MODEL, width, height, parameter, ...`, with COLMAP's models.
        cameras: COLMAP's cameras.txt. One camera applies to all images; of several, the table's `camera_id` selects.
        truth: CSV file like the table; its poses become the ground truth of queries, which some may lack.
        only, skip: patterns such as `*.color.png`, without a table; only images of these names, and none of those.
        options: see `drafts.Options`; `unit_m` is 1 by default.

    Raises:
        CaptureError: a malformed table or camera (names file and line), an image without intrinsics, a map without
            poses, truth that names no image, the session exists already, or no image is left.
        ManifestError: an unknown direction, truth for a map or together with poses in the table; as for `drafts.start`.
    """
    require_known("poses_are", poses_are, POSE_DIRECTIONS)
    options.setdefault("unit_m", 1.0)
    draft, folder = start(capture, device, split, Path(images), **options), Path(images)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder of images.")
    draft.convention = poses_are
    tracks = [None if file is None else read_track(Path(file), draft.timestamps_unit) for file in (table, truth)]
    if table is not None and tracks[0] is None:
        rows, draft.listed_in = _read_table(Path(table)), "the table"
    else:
        rows = pd.DataFrame({"image": _listed(draft, folder, only or (), skip or ()), "line": 0})
    if tracks[0] is not None:
        rows = _with_poses(rows, tracks[0], draft, table)
    if split == "map" and "qw" not in rows:
        given = f"a table with the columns image, {', '.join(POSE_NAMES)}"
        raise CaptureError(f"A map needs poses: give {given}, or import a transforms.json or a COLMAP model.")
    listed_cameras = read_cameras(Path(cameras)) if cameras is not None else {}
    if "camera_id" not in rows:  # a model often has a camera for each image, all the same
        texts = [one if isinstance(one, str) else camera_text(one) for one in listed_cameras.values()]
        listed_cameras = dict(zip(texts, listed_cameras.values(), strict=True))
    shared_camera = None if camera is None else camera_at("camera", camera)
    unknown = camera is None and not listed_cameras and not {"model", "camera_id"} & {*rows}
    of_map = _map_cameras(draft, device) if unknown and split == "query" else None
    posed = rows if truth is None else _read_truth(Path(truth), rows, draft, tracks[1])
    poses = _poses_of(posed, poses_are)
    bad = posed[posed["problem"] != ""] if "problem" in posed else posed[:0]
    bad_poses = {str(row["image"]): (f"line {row['line']}: " if row["line"] else "") + row["problem"]
                 for row in bad.to_dict("records")}  # fmt: skip
    if bad_poses and truth is not None:
        first = next(iter(bad_poses.items()))
        draft.notes.append(f"{len(bad_poses)} images have no usable ground truth; first: {first[0]}: {first[1]}")
    stamps = to_us(rows["timestamp"], draft.timestamps_unit, table).tolist() if "timestamp" in rows else []
    times = dict(zip(rows["image"], stamps, strict=False))
    for row in rows.to_dict("records"):
        name, where = str(row["image"]), f"{table}, line {row['line']}"
        try:
            if truth is None and name in bad_poses:
                raise CaptureError(f"{table}, {bad_poses[name]}")
            image_camera, origin = _camera_of(row, listed_cameras, shared_camera, folder / name, where, of_map)
        except (ImageError, CaptureError) as error:
            image_camera, origin = str(error), ""
        draft.add_image(name, image_camera, poses.get(name), origin, times.get(name))
    if truth is not None:
        draft.notes.append(f"ground truth of {len(draft.poses)} of {len(rows)} images: {truth}")
    return draft.finish()


def import_once(
    images: str | Path, capture: str | Path, device: str, split: str, unit_m: float | None = 1.0, **options: Any
) -> str:
    """Import images, unless the session was imported before from the same input. Return a message for the user.

    Options are those of `import_images`; `table` may be a transforms.json in the folder of images. Raise CaptureError
    if the session was imported from other input, which it names; ManifestError if the transforms.json is in another
    folder; or as the imports.
    """
    session = Path(capture) / "sessions" / f"{device}_{split}"
    inputs: dict[str, Any] = {"images": str(Path(images).resolve()), **options}
    if unit_m != 1:  # sessions of earlier versions do not record it
        inputs["unit_m"] = unit_m
    for name in ("table", "truth", "cameras"):
        if inputs.get(name) is not None:
            inputs[f"content of {name}"] = file_fingerprint(inputs[name])
            inputs[name] = str(Path(inputs[name]).resolve())
    table = options.get("table")
    if inputs.get("camera") is not None:
        columns = ["model"] if _is_transforms(table) else [] if table is None else _read_table(Path(table))
        if options.get("cameras") is not None or "model" in columns or "camera_id" in columns:
            inputs["camera"] = None  # the table or cameras.txt override it
    try:
        names = list_images(Path(images), READ_SUFFIXES)
    except CaptureError as error:
        raise CaptureError(f"{split}_images: {error}") from None
    inputs["files of images"] = files_fingerprint([Path(images) / name for name in names])

    def make(record: dict[str, Any]) -> ImportReport:
        if table is None or not _is_transforms(table):
            return import_images(images, capture, device, split, unit_m=unit_m, record=record, **options)
        if Path(images).resolve() != Path(table).resolve().parent:
            raise ManifestError(f"{split}_images: found {images}, expected the folder of {table}.")
        if (found := options.get("poses_are", POSE_DIRECTIONS[0])) != POSE_DIRECTIONS[0]:
            raise ManifestError(f"poses_are: found {found!r}, expected world_from_cam, the direction in {table}.")
        return import_transforms(table, capture, device, split, own_split=False, unit_m=unit_m, record=record)

    return once(session, inputs, make)


def once(session: Path, inputs: Mapping[str, Any], make: Callable[[dict[str, Any]], ImportReport]) -> str:
    """Make a session, unless it was made before from the same inputs. Return a message for the user.

    `make` takes what `proc/import.json` is to have, see `drafts.Options`. Raise CaptureError for other inputs.
    """
    if not session.exists():
        return make({"input": dict(inputs)}).text()
    before = read_json(session / IMPORT_RECORD).get("input", {})
    if differing := [name for name in inputs if before.get(name) != inputs[name]]:
        changes = "; ".join(
            f"{name}: have changed" if name.split()[0] in ("content", "files") and name in before
            else f"{name}: then {before.get(name)!r}, now {inputs[name]!r}"
            for name in differing
        )  # fmt: skip
        do = "Delete it to import again, or give another capture."
        raise CaptureError(f"{session} was imported from other input ({changes}). {do}")
    return f"{session}: imported before from the same input, kept"


def _is_transforms(table: str | Path | None) -> bool:
    return table is not None and Path(table).suffix == ".json"


def _sensors_of_rigs(rigs: Mapping[int, Mapping[int, pycolmap.Rigid3d | None]]) -> dict[tuple[int, int], str]:
    """Return the sensor's name by rig and camera: a camera that is in several rigs becomes a sensor of each."""
    of_camera = Counter(camera_id for cameras in rigs.values() for camera_id in cameras)
    return {
        (rig_id, camera_id): f"{SUBSESSION}/cam_{camera_id}" + (f"_rig_{rig_id}" if of_camera[camera_id] > 1 else "")
        for rig_id, cameras in rigs.items()
        for camera_id in cameras
    }


# Cameras


def _listed(draft: Draft, folder: Path, only: Sequence[str], skip: Sequence[str]) -> list[str]:
    """Return the images of a folder that fit the patterns, and note what is left out or looks like no photograph."""
    names = list_images(folder, (*READ_SUFFIXES, *(HEIC_SUFFIXES if heic_is_read() else ())), draft)
    chosen = [name for name in names if (not only or _fits(name, only)) and not _fits(name, skip)]
    if not chosen:
        raise CaptureError(f"{folder}: none of {len(names)} images fits the patterns {', '.join([*only, *skip])}.")
    if len(chosen) < len(names):
        draft.others["by --only and --skip"] = sorted({*names} - {*chosen})
    exact = [name for name in chosen if not name.lower().endswith((".jpg", ".jpeg"))]
    sample = exact[:: max(1, len(exact) // 40)]
    flat = [name for name in sample if _is_no_photograph(folder / name)]
    if flat and len(flat) / len(sample) * len(exact) >= 0.5 * len(chosen):
        kinds = f"{len(flat)} of {len(sample)} files that were looked at, such as {flat[0]}, have 16 bits or few"
        draft.notes.append(f"{kinds} values, like depth, confidence and masks: leave such out with --only or --skip")
    return chosen


def _fits(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(one, pattern) for pattern in patterns for one in (name, Path(name).name))


def _is_no_photograph(path: Path) -> bool:
    """Tell whether an image has 16 bits or decimals in one channel, or at most 4 values (ARKit's confidence: 3)."""
    try:
        pixels = decode(path, cv2.IMREAD_UNCHANGED)
    except ImageError:
        return False
    return (pixels.dtype != np.uint8 and pixels.ndim == 2) or len(np.unique(pixels[::2, ::2])) <= 4


def camera_at(where: object, params: str) -> pycolmap.Camera:
    """Return the camera `MODEL, width, height, parameter, ...`; `where` names file and line for a CaptureError."""
    try:
        return parse_camera("camera", params)
    except ValueError as error:
        raise CaptureError(f"{where}: {error}") from None


def _camera_in(row: Mapping[Any, Any], where: str) -> pycolmap.Camera:
    return camera_at(where, ", ".join([row["model"], row["width"], row["height"], *str(row["params"]).split()]))


def _map_cameras(draft: Draft, device: str) -> MapCameras | None:
    """Return the cameras of the map that queries are imported beside; None if there is no map, or none to be read."""
    session = draft.session.with_name(f"{device}_map")
    try:
        return MapCameras(Session.open(session)) if session.is_dir() else None
    except (CaptureError, OSError) as error:
        draft.notes.append(f"{session.name} cannot be read, so its cameras are not used: {error}")
        return None


def _camera_of(
    row: Mapping[Any, Any], by_id: Mapping[str, pycolmap.Camera | str], shared: pycolmap.Camera | None, path: Path,
    where: str, of_map: MapCameras | None,
) -> tuple[pycolmap.Camera | str, str]:  # fmt: skip
    """Return the camera of an image and its origin: the table, cameras.txt, the camera shared by all images, or that of
    `known_camera`.

    The camera may be why it cannot be used. `where` names file and line of the image's row, for messages.
    """
    if "model" in row:
        return _camera_in(row, where), "given by the table"
    if "camera_id" in row:
        if row["camera_id"] not in by_id:
            ids = ", ".join(by_id) or "none: give cameras.txt"
            raise CaptureError(f"{where}: camera_id {row['camera_id']!r} is not in cameras.txt (it has: {ids}).")
        return by_id[row["camera_id"]], "given by cameras.txt"
    if len(by_id) > 1:
        do = f"a table with the columns image, camera_id, or one for all, such as --camera '{next(iter(by_id))}'"
        raise CaptureError(f"cameras.txt has {len(by_id)} different cameras; give {do}.")
    if by_id:
        return next(iter(by_id.values())), "given by cameras.txt"
    return (shared, "given by --camera") if shared is not None else known_camera(path, of_map)[:2]


# Tables


def _read_truth(path: Path, images: pd.DataFrame, draft: Draft, track: Track | None) -> pd.DataFrame:
    """Read the table with the ground truth of some of the query `images`; a `track` is its content without names."""
    is_map = draft.session.name.endswith("_map")
    if is_map or "qw" in images:
        why = "the images of a map" if is_map else "images whose table has poses already"
        raise ManifestError(f"truth: {path} is given for {why}. Give it for queries whose table has no poses.")
    if track is not None:
        return _with_poses(images, track, draft, path)
    rows = _read_table(path)
    if "qw" not in rows:
        raise CaptureError(f"{path}: no poses in it. Expected the columns image, {', '.join(POSE_NAMES)}.")
    if not set(rows["image"]) & set(images["image"]):
        names = [repr(next(iter(table["image"]), "")) for table in (rows, images)]
        found = f"found {names[0]} and others, expected {names[1]} and others, paths in the folder of images"
        raise CaptureError(f"{path}: no row is about an imported image: {found}.")
    return rows


def _poses_of(rows: pd.DataFrame, poses_are: str) -> dict[str, Floats]:
    """Return world_from_cam (4, 4) by image with a valid pose; empty if the table has no poses."""
    if "qw" not in rows:
        return {}
    rows = rows[rows["problem"] == ""]
    poses = pose_from_qt(rows[list(POSE_NAMES)].to_numpy(float))
    if poses_are == "cam_from_world":
        poses = invert(poses)
    elif poses_are == "rotation_of_cam_from_world":
        poses = make_pose(np.swapaxes(poses[:, :3, :3], 1, 2), poses[:, :3, 3])
    return dict(zip(map(str, rows["image"]), poses, strict=True))


def read_poses(table: Path, poses_are: str) -> tuple[list[str], dict[str, Floats]]:
    """Return the images of a table, and their world_from_cam (4, 4) in the table's unit; see `import_images`."""
    require_known("poses_are", poses_are, POSE_DIRECTIONS)
    rows = _read_table(table)
    return list(rows["image"]), _poses_of(rows, poses_are)


def read_intrinsics(table: Path) -> dict[str, pycolmap.Camera]:
    """Return the cameras of the images in a table with the columns model, width, height, params, or in hloc's list."""
    rows = _read_table(table)
    if "model" not in rows:
        raise CaptureError(f"{table}: no intrinsics in it. Expected the columns image, {', '.join(_CAMERA_COLUMNS)}.")
    records = rows.to_dict("records")
    return {str(row["image"]): _camera_in(row, f"{table}, line {row['line']}") for row in records}


def _read_table(path: Path) -> pd.DataFrame:
    """Read the table of a folder of images, all values as text, with columns `line` and, with poses, `problem`, why the
    pose of a row is none."""
    if _is_transforms(path):
        _read_transforms(path)
        raise CaptureError(f"{path}: not a CSV table. Import it by {COMMAND} import transforms.")
    text = read_text(path)
    if text.startswith("# kapture format"):
        raise _of_tool(path, "kapture", "kapture_export_colmap.py")
    first = next((line for line in text.splitlines() if line.strip()), "").split()
    # The header may follow a line with the number of cameras.
    if any({"heading", "pitch", "roll"} <= {*re.split(r"[\s,;]+", line)} for line in text.splitlines()[:2]):
        do = f"Export as COLMAP there, and import that by `{COMMAND} import colmap`."
        raise CaptureError.at(path, "angles (heading, pitch, roll), as RealityScan writes them", "quaternions", do)
    of_hloc = len(first) > 4 and first[1] in pycolmap.CameraModelId.__members__
    rows = _read_hloc_list(text) if of_hloc else read_csv(path)
    columns = ("image", *POSE_NAMES, "timestamp", "camera_id", *_CAMERA_COLUMNS)
    if path.name == "images.txt" and "image" not in rows:
        raise CaptureError(f"{path}: not a CSV table. Import its folder by {COMMAND} import colmap.")
    for name, count in Counter(rows.columns[:-1]).items():
        if name not in columns:
            raise CaptureError(f"{path}: unknown column {name!r}. {nearest(name, columns)}")
        if count > 1:
            raise CaptureError(f"{path}: column {name!r} occurs {count} times. Keep one of them.")
    for group in (("image",), POSE_NAMES, _CAMERA_COLUMNS):
        missing = [name for name in group if name not in rows]
        if missing and (group == ("image",) or len(missing) < len(group)):
            raise CaptureError(f"{path}: column {missing[0]!r} is missing; expected {', '.join(group)}.")
    rows = rows[rows["image"].str.strip() != ""].assign(image=lambda table: table["image"].str.strip())
    twice = rows["image"].duplicated()
    if twice.any():
        raise CaptureError(f"{path}, line {rows['line'][twice].iloc[0]}: image {rows['image'][twice].iloc[0]!r} again.")
    if "qw" in rows:
        values = rows[list(POSE_NAMES)].apply(pd.to_numeric, errors="coerce").to_numpy(float)
        lengths = np.linalg.norm(np.nan_to_num(values[:, :4]), axis=1)
        wrong = ~np.isfinite(values).all(axis=1) | (np.abs(lengths - 1) > NORM_TOLERANCE)
        found = ["found the pose " + ", ".join(row) for row in rows[list(POSE_NAMES)].to_numpy()]
        expected = "expected seven finite numbers, qw qx qy qz of length 1 and tx ty tz"
        rows["problem"] = [f"{one}; {expected}." if bad else "" for one, bad in zip(found, wrong, strict=True)]
        if wrong.all() and len(rows):
            raise CaptureError(f"{path}, line {rows['line'].iloc[0]}: {rows['problem'].iloc[0]}")
    return rows


def _with_poses(rows: pd.DataFrame, track: Track, draft: Draft, file: object) -> pd.DataFrame:
    """Return the images with the poses of a list without names: by their times, else one each, in order of names."""
    names = list(rows["image"])
    at: list[int | None] = [*(lines_of_images(names, len(track.poses)) or ())]
    if track.times_us is not None:
        draft.timestamps = draft.timestamps or NAMES
        times = read_times(draft.timestamps, names, draft.timestamps_unit)
        at = [track.nearest(times[name]) if name in times else None for name in names]
    elif not at:
        found = f"found {len(track.poses)} poses of {len(names)} images in {draft.folder}"
        raise CaptureError(f"{file}: {found}, expected one each, or numbers in their names.")
    draft.notes += [f"{file}: poses as of {track.kind}, without names of images", *([track.note] if track.note else [])]
    poses = np.stack([np.full((4, 4), np.nan) if one is None else track.poses[one] for one in at])
    known = np.isfinite(poses).all(axis=(1, 2))
    qt = np.full((len(names), 7), np.nan)
    qt[known] = qt_from_pose(poses[known])
    why = "its line is no pose" if track.times_us is None else f"no pose within {MAX_OFFSET_S:g} s"
    rows = rows.assign(**dict(zip(POSE_NAMES, qt.T, strict=True)))
    return rows.assign(problem=["" if is_known else why for is_known in known])


def _read_hloc_list(text: str) -> pd.DataFrame:
    """Read hloc's query list, `name MODEL width height parameters` per line without a header, as a table."""
    lines = [line.split(maxsplit=4) for line in text.splitlines()]
    rows = [[*line, *[""] * (5 - len(line)), number] for number, line in enumerate(lines, start=1)]
    return pd.DataFrame(rows, columns=["image", *_CAMERA_COLUMNS, "line"])


# transforms.json


def import_transforms(
    path: str | Path, capture: str | Path, device: str = "ios", split: str = "map", undo_applied: bool = False,
    own_split: bool = True, **options: Any,
) -> ImportReport:  # fmt: skip
    """Make a session, or a map and a query session, from a transforms.json. Images keep their `file_path` as names.

    Raise CaptureError for a malformed file (names frame and key), or a session that exists already or has no usable
    image; ManifestError as for `drafts.start`.

    Args:
        device, split: as for `import_colmap`.
        undo_applied: return to the world before `applied_transform` and `applied_scale`, as of the file's own input.
        own_split: without `hold_out`, the images of a map that the file names in `test_filenames` and `val_filenames`
            become queries.
        options: see `drafts.Options`; `axes` are `opengl` by default.
    """
    path = Path(path)
    options.setdefault("axes", "opengl")
    draft = start(capture, device, split, path.parent, **options)
    content = _read_transforms(path)
    frames: dict[str, _TransformsFrame] = {}
    applied = _applied(path, content)
    again: dict[str, CaptureError] = {}
    for number, entry in enumerate(content["frames"]):
        try:
            frame = _TransformsFrame(path, number, entry, content)
        except CaptureError as error:
            draft.add_image(f"frame {number}", str(error), None, "")
            continue
        first = frames.setdefault(frame.name, frame)
        if frame.values != first.values:
            again[frame.name] = frame.error("file_path", f"that of frame {first.number} again", "one frame per image")
    in_lists = [_named(content, *keys) for keys in (("val_filenames", "test_filenames"), ("train_filenames",))]
    meant = _frames_of(set().union(*in_lists), frames)
    held, trained = ({meant[name] for name in names if name in meant} for names in in_lists)
    trained = trained if in_lists[1] else set(frames) - held
    own_split = own_split and bool(held) and split == "map" and not draft.hold_out
    for name, frame in sorted(frames.items()):
        try:
            if name in again:
                raise again[name]
            if own_split and name not in held | trained:
                raise CaptureError("it is in none of train_filenames, val_filenames and test_filenames")
            pose = frame.world_from_named()
            if undo_applied:
                pose[:3, 3] /= applied[1]
                pose = np.asarray(np.linalg.inv(applied[0]) @ pose)
            draft.add_image(name, frame.camera(), pose, f"given by {path.name}")
        except (ImageError, CaptureError) as error:
            draft.add_image(name, str(error), None, "")
    draft.listed_in, draft.beside = path.name, True
    if own_split:
        draft.notes.append("map and queries: train_filenames, and val_filenames and test_filenames of the file")
    elif held and split == "map":
        draft.notes.append(f"val_filenames and test_filenames ({len(held)} images) of the file are not used")
    if split == "map" and (loose := [name for name, frame in meant.items() if name != frames[frame].listed]):
        names = f"{loose[0]!r} is {frames[meant[loose[0]]].listed!r}"
        draft.notes.append(f"{len(loose)} names in these lists match but for their extensions, as {names}")
    if split == "map" and (missing := sorted(set().union(*in_lists) - set(meant))):
        draft.notes.append(f"{len(missing)} names in these lists are of no frame, or of several, as {missing[0]!r}")
    if found := sum(frame.from_elsewhere for frame in frames.values()):
        draft.notes.append(FROM_ELSEWHERE.format(found))
    turn, scale = applied
    if not (np.array_equal(turn, np.eye(4)) and scale == 1):
        draft.record |= {} if undo_applied else {"applied": [*turn[:3].ravel().tolist(), scale]}
        world = "that of the file's input" if undo_applied else "the file's, turned from that of its input"
        other = "" if undo_applied else ". For the input's, as of a COLMAP model beside it, give --undo-applied"
        draft.notes.append(f"applied_transform, applied_scale {scale:g}: the world is {world}{other}")
    return draft.finish(held if own_split else every_nth(sorted(frames), draft.hold_out))


# Tools that write a JSON file with this key, and their commands that export a COLMAP model.
_OTHER_TOOLS = {"shots": ("OpenSfM", "opensfm export_colmap"),
                "sfm_data_version": ("OpenMVG", "openMVG_main_openMVG2Colmap")}  # fmt: skip


def _of_tool(path: Path, name: str, command: str) -> CaptureError:
    do = f"Export a COLMAP model by `{command}`, and import that by `{COMMAND} import colmap`."
    return CaptureError.at(path, f"a file of {name}", "a table, or a transforms.json", do)


def _read_transforms(path: Path) -> dict[str, Any]:
    expected = "Expected a transforms.json of nerfstudio or instant-ngp: an object with a list `frames`."
    try:
        content = json.loads(path.read_bytes())  # also UTF-16, and with a byte-order mark
    except (OSError, ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: cannot be read ({error}). {expected}") from None
    for entry in content[:1] if isinstance(content, list) else [content]:
        for key, tool in _OTHER_TOOLS.items():
            if isinstance(entry, dict) and key in entry:
                raise _of_tool(path, *tool)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not any(isinstance(frame, dict) for frame in frames):
        found = f"keys {', '.join(map(repr, content))[:100]}" if isinstance(content, dict) else repr(content)[:100]
        raise CaptureError(f"{path}: frames: found {found or 'nothing'}, no list of frames. {expected}")
    return content


def _named(content: Mapping[str, Any], *keys: str) -> set[str]:
    """Return the images in lists of the file, as they are written there."""
    lists = (content.get(key) for key in keys)
    return {name for names in lists if isinstance(names, list) for name in names if isinstance(name, str)}


def _frames_of(names: Iterable[str], frames: Mapping[str, "_TransformsFrame"]) -> dict[str, str]:
    """Return the frames that listed names mean: of the same path, else the only one that differs in its extension."""
    same = {frame.listed: name for name, frame in frames.items()}
    alike: dict[str, list[str]] = {}
    for name, frame in frames.items():
        alike.setdefault(_without_suffix(frame.listed), []).append(name)
    fitting = {name: [same[name]] if name in same else alike.get(_without_suffix(name), []) for name in sorted(names)}
    return {name: found[0] for name, found in fitting.items() if len(found) == 1}


def _without_suffix(image: str) -> str:
    path = PurePosixPath(image.replace("\\", "/"))
    return str(path.with_suffix("") if path.suffix.lower() in READ_SUFFIXES else path)


def _applied(path: Path, content: Mapping[str, Any]) -> tuple[Floats, float]:
    """Return applied_transform (4, 4), a rigid motion, and applied_scale, above 0; by default the identity and 1."""
    scale, rows = content.get("applied_scale", 1.0), content.get("applied_transform", np.eye(4))
    try:
        matrix = np.vstack([np.array(rows, np.float64)[:3], [0.0, 0.0, 0.0, 1.0]])
        rotation = matrix[:3, :3]
        if not (np.abs(rotation.T @ rotation - np.eye(3)).max() <= TOLERANCE and 0 < float(scale) < np.inf):
            raise ValueError
    except (TypeError, ValueError, IndexError):
        found = f"found {rows!r}"[:80] + f" and {scale!r}"[:40]
        expected = "expected 3 rows of 4 numbers, a rotation and a translation, and a positive number"
        raise CaptureError(f"{path}: applied_transform, applied_scale: {found}; {expected}.") from None
    return matrix, float(scale)


class _TransformsFrame:
    """One image of the file. Its own values override those at the top level."""

    def __init__(self, path: Path, number: int, entry: object, shared: Mapping[str, Any]) -> None:
        entry = entry if isinstance(entry, dict) else {}
        self.path, self.number, self.values = path, number, {**shared, **entry}
        image = entry.get("file_path")
        if not isinstance(image, str) or not image.strip() or re.search("[\ud800-\udfff]", image):
            raise self.error("file_path", repr(image)[:80], "the path of an image, relative to the folder of this file")
        self.listed, self.from_elsewhere = image, False
        self.name = self._with_suffix(image.replace("\\", "/"))

    def _with_suffix(self, image: str) -> str:
        """Return an image's path relative to the folder of the file, with its extension added if it is missing."""
        name = os.path.normpath(os.path.relpath(image, self.path.parent) if image.startswith("/") else image)
        if not is_file(self.path.parent / name) and (end := end_below(self.path.parent, image)) is not None:
            self.from_elsewhere, name = True, end  # a path of another machine
        suffixes = ["", *IMAGE_SUFFIXES, *map(str.upper, IMAGE_SUFFIXES)]
        name = next((name + suffix for suffix in suffixes if is_file(self.path.parent / (name + suffix))), name)
        return Path(name).as_posix()

    def error(self, key: str, found: str, expected: str) -> CaptureError:
        image = getattr(self, "name", "")
        frame = f"frame {self.number}" + (f" ({image})" if image else "")
        return CaptureError(f"{self.path}, {frame}, {key}: found {found}; expected {expected}. Correct it in the file.")

    def _number(self, key: str, expected: str, default: float | None = None) -> float:
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < FARTHEST_M:
            raise self.error(key, "nothing" if value is None else repr(value)[:80], expected)
        return float(value)

    def world_from_named(self) -> Floats:
        """Return world_from_camera (4, 4) as stored, with the file's camera axes and unit."""
        rows = self.values.get("transform_matrix")
        expected = "4 rows of 4 finite numbers, world_from_cam, the last row 0 0 0 1"
        try:
            matrix = np.array(rows, np.float64)
        except (TypeError, ValueError, OverflowError):
            raise self.error("transform_matrix", repr(rows)[:80], expected) from None
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
        is_pose = matrix.shape == (4, 4) and np.allclose(matrix[3], [0, 0, 0, 1])
        if not is_pose or not (np.abs(matrix) < FARTHEST_M).all():
            raise self.error("transform_matrix", repr(rows)[:80], expected)
        rotation = matrix[:3, :3]
        if np.abs(rotation.T @ rotation - np.eye(3)).max() > TOLERANCE or np.linalg.det(rotation) < 0:
            expected = "a rotation: columns of length 1 at right angles, x cross y = z"
            raise self.error("transform_matrix", np.array2string(rotation, precision=4).replace("\n", ""), expected)
        return matrix

    def camera(self) -> pycolmap.Camera:
        """Return the intrinsics. Raise ImageError if the image's size is neither stated nor in a header that can be
        read; CaptureError if they are missing or malformed."""
        pixels = "pixels, a number"
        size = [self._number(key, pixels) for key in "wh" if key in self.values]
        width, height = size if len(size) == 2 else map(float, read_header(self.path.parent / self.name)[0])
        fx = self._focal_px("x", width)
        fy = self._focal_px("y", height, fx)
        center = [self._number(key, pixels, side / 2) for key, side in (("cx", width), ("cy", height))]
        model, params = self._distortion()
        text = ", ".join([model, *map(repr, [width, height, fx, fy, *center, *params])])
        try:
            return parse_camera("camera", text)
        except ValueError as error:
            raise self.error("intrinsics", text, f"a camera ({error.args[0].rstrip('.')})") from None

    def _focal_px(self, axis: str, side_px: float, default: float | None = None) -> float:
        if f"fl_{axis}" in self.values:
            return self._number(f"fl_{axis}", "a focal length in pixels")
        if f"camera_angle_{axis}" in self.values:
            expected = "a field of view in radians, between 0 and pi"
            angle = self._number(f"camera_angle_{axis}", expected)
            if not 0 < angle < np.pi:
                raise self.error(f"camera_angle_{axis}", repr(angle), expected)
            return side_px / 2 / float(np.tan(angle / 2))
        return self._number(f"fl_{axis}", "a focal length in pixels, or camera_angle_x in radians", default)

    def _distortion(self) -> tuple[str, list[float]]:
        """Return the COLMAP camera model and its parameters after the principal point."""
        model = self.values.get("camera_model", FISHEYE if self.values.get("is_fisheye") else "OPENCV")
        if model not in (*PERSPECTIVE, FISHEYE):
            expected = f"one of {', '.join((*PERSPECTIVE, FISHEYE))}, the supported models"
            raise self.error("camera_model", repr(model)[:80], expected)
        k1, k2, k3, k4, p1, p2 = (self._number(key, "a number", 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
        if model == FISHEYE:
            if p1 or p2:
                raise self.error("p1, p2", f"{p1:g}, {p2:g}", f"0, 0, because {FISHEYE} has no such coefficients")
            return FISHEYE, [k1, k2, k3, k4]
        if k4:
            raise self.error("k4", f"{k4:g}", f"0 for {model}: COLMAP's models have no term in r^8. Is it {FISHEYE}")
        if k3:
            return "FULL_OPENCV", [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
        return ("OPENCV", [k1, k2, p1, p2]) if any((k1, k2, p1, p2)) else ("PINHOLE", [])


# Panoramas


def import_panoramas(
    images: str | Path, capture: str | Path, device: str = "ios", split: str = "query", table: str | Path | None = None,
    poses_are: str = "world_from_cam", **options: Any,
) -> ImportReport:  # fmt: skip
    """Make a session of equirectangular panoramas: a map with poses, or queries, whose poses become ground truth.

    Each becomes the images of a rig of perspective cameras, all in one place. The frame of a panorama is that of
    COLMAP's EQUIRECTANGULAR: z points to the center of the image, x to the right, y down; it is the frame of the rig.
    The ground and the sky more than 45 degrees from the horizon are left out. A mask of a panorama is cut as well, see
    `images.find_mask`. Arguments are as for `import_images`. Raise CaptureError for a malformed table, a map without
    poses, two panoramas of one name, the session exists already, or no panorama is left; ManifestError as there.
    """
    folder = Path(images)
    options["placing"], masks = "copy", options.pop("masks", None)  # masks are cut here
    options.setdefault("unit_m", 1.0)
    draft = start(capture, device, split, folder, **options)
    listed, poses = (list_images(folder, draft=draft), {}) if table is None else read_poses(Path(table), poses_are)
    if split == "map" and not poses:
        raise CaptureError(f"A map needs poses: give a table with the columns image, {', '.join(POSE_NAMES)}.")
    stems = Counter(str(Path(name).with_suffix("")) for name in listed)
    if twice := [name for name, count in stems.items() if count > 1]:
        raise CaptureError(f"{folder}: two panoramas have the name {twice[0]}. Rename one.")
    sizes: dict[int, int] = {}
    parent = next(one for one in (Path(capture).absolute(), *Path(capture).absolute().parents) if one.is_dir())
    with tempfile.TemporaryDirectory(dir=parent) as temporary:
        out = Path(temporary)

        def cut(name: str) -> int | str:
            try:
                return _cut(folder / name, out / Path(name).with_suffix(""), None if masks is None else Path(masks))
            except ImageError as error:
                return str(error)

        results = prefetch(cut, tqdm(listed, "cut", unit="panorama"), default_workers(), ahead=0)
        for name, side in zip(listed, results, strict=True):
            if isinstance(side, str):
                draft.rows.append({"image": name, "status": side})
                continue
            size = sizes.setdefault(side, len(sizes) + 1)
            params = [side / 2, side / 2, side / 2, side / 2]
            camera = pycolmap.Camera(model="PINHOLE", width=side, height=side, params=params)
            rig = f"{SUBSESSION}/panorama_{size}"
            for yaw in YAWS_DEG:
                view = (Path(name).with_suffix("") / f"{yaw:03d}.jpg").as_posix()
                draft.images.append(DraftImage(view, camera, f"{rig}_{yaw:03d}", name, rig, "a view of 90 degrees"))
                draft.sources[view] = out / view
            if name in poses:
                draft.poses[name] = poses[name]
        for side, size in sizes.items():
            draft.notes.append(f"panoramas are cut into {len(YAWS_DEG)} views of 90 degrees, {side} x {side} pixels")
            rig = f"{SUBSESSION}/panorama_{size}"
            turn = AXES[draft.axes]  # views have the same place in the panorama, whatever axes the poses have
            draft.rigs += [(rig, f"{rig}_{yaw:03d}", turn @ make_pose(rotation, np.zeros(3)) @ turn)
                           for yaw, rotation in _rig_from_views()]  # fmt: skip
        draft.convention = poses_are
        return draft.finish()


def _rig_from_views() -> Iterator[tuple[int, Floats]]:
    """Yield the yaw of each view, to the right, and its rotation rig_from_view (3, 3)."""
    for yaw in YAWS_DEG:
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        yield yaw, np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _cut(path: Path, out: Path, masks: Path | None) -> int:
    """Write the views of a panorama, and of its mask, to a folder; return their side in pixels.

    Raise ImageError if the image or its mask cannot be read, or does not show the whole sphere.
    """
    pixels = read_image(path)
    height, width = pixels.shape[:2]
    if width != 2 * height or width > _LARGEST:
        found = f"{width} x {height} pixels, expected twice as wide as high, the whole sphere, up to {_LARGEST} pixels"
        raise ImageError(f"no equirectangular panorama: {found}")
    mask_path = find_mask(path, masks)
    mask = None if mask_path is None else read_image(mask_path, gray=True)
    if mask is not None and mask.shape != (height, width):
        found = f"{mask.shape[1]} x {mask.shape[0]} pixels, expected {width} x {height}"
        raise ImageError(f"its mask has {found}: {mask_path}")
    side = 2 * round(width / np.pi / 2)  # in the center of a view, as many pixels per degree as in the panorama
    out.mkdir(parents=True)
    if mask is not None:
        (out / "masks").mkdir()
    for yaw, rig_from_view in _rig_from_views():
        columns, rows = pixels_in_panorama(side, rig_from_view, width)
        view = cv2.remap(pixels, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
        cv2.imwrite(str(out / f"{yaw:03d}.jpg"), view[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
        if mask is not None:
            hidden = cv2.remap(mask, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP)
            cv2.imwrite(str(out / "masks" / f"{yaw:03d}.jpg.png"), hidden)
    return side


def pixels_in_panorama(side: int, rig_from_view: Floats, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return for each pixel of a view of 90 degrees, (side, side), its column and row in a panorama, as cv2.remap does:
    the center of the top-left pixel is (0, 0)."""
    across = (np.arange(side) + 0.5) / (side / 2) - 1
    x, y = np.meshgrid(across, across)
    x, y, z = np.moveaxis(np.stack([x, y, np.ones_like(x)], axis=-1) @ rig_from_view.T, -1, 0)
    columns = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width - 0.5
    rows = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * width / 2 - 0.5
    return columns.astype(np.float32), rows.astype(np.float32)
