"""Import COLMAP models and folders of images as sessions of a capture (see `drafts`).

A folder of images may have a table, a CSV file with a header. Column `image` is the path in the folder; `qw qx qy qz tx
ty tz` are the pose; `timestamp` is the time; `camera_id` names a camera in a COLMAP `cameras.txt`, or `model width
height params` (params separated by spaces) give the camera directly. The order of columns is free; unknown columns are
an error. A query list of hloc, `name MODEL width height parameters` per line, is accepted in place of the table; and
lists of poses without names, see `recordings.read_track`.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pycolmap

from toolkit.capture import parse_camera
from toolkit.capture.folder import IMPORT_RECORD
from toolkit.capture.images import decode, exif_camera
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import COMMAND, CaptureError, ImageError, ManifestError
from toolkit.exchange.colmap_model import NORM_TOLERANCE, inverse, read_cameras, read_model
from toolkit.exchange.drafts import (
    HEIC_SUFFIXES,
    READ_SUFFIXES,
    SUBSESSION,
    Draft,
    DraftImage,
    heic_is_read,
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
from toolkit.exchange.transforms import import_transforms
from toolkit.files import file_fingerprint, files_fingerprint, read_json
from toolkit.geometry import Floats, invert, make_pose, pose_from_qt, qt_from_pose
from toolkit.manifest import nearest

POSE_DIRECTIONS = ("world_from_cam", "cam_from_world", "rotation_of_cam_from_world")
_CAMERA_COLUMNS = ("model", "width", "height", "params")


def import_colmap(
    model: str | Path, images: str | Path, capture: str | Path, device: str = "ios", split: str = "map",
    **options: Any,
) -> ImportReport:  # fmt: skip
    """Make a session from a COLMAP model and its images: cameras, poses, and the rigs that have several cameras.

    The capture format supports all camera models of COLMAP, so they are kept without undistortion. Points and tracks
    are dropped, because the toolkit triangulates its own map. Images of the folder that are not in the model are left
    out and counted in the report.

    Args:
        model: folder with cameras, images (and rigs, frames), as .bin or .txt; or the folder of one such folder.
        images: folder that the model's image names are relative to.
        capture: folder of the capture; created if it does not exist.
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

    Intrinsics come from the table, else from `cameras`, else from `camera`, else they are guessed from each image's
    EXIF.

    Args:
        images: folder; without a table, all JPEG and PNG files in and below it are imported.
        capture, device, split: as for `import_colmap`. A map needs poses.
        table: CSV file, see the module's docstring.
        poses_are: direction of the poses in table and truth: `world_from_cam`, `cam_from_world`, or
            `rotation_of_cam_from_world`, whose positions are the camera centers, as in NVM, Bundler and the Cambridge
            Landmarks.
        camera: intrinsics of all images, `MODEL, width, height, parameter, ...`, with COLMAP's models.
        cameras: COLMAP's cameras.txt. A single camera applies to all images; of several, the table's `camera_id`
            selects one.
        truth: CSV file like the table; its poses become the ground truth of queries. Images not in it are queries
            without ground truth.
        only, skip: patterns such as `*.color.png`, without a table; only images of these names, and none of those.
        options: see `drafts.Options`; `unit_m` is 1 by default.

    Raises:
        CaptureError: a malformed table or camera (names file and line), an image without intrinsics, a map without
            poses, truth that names no image, the session exists already, or no image is left.
        ManifestError: an unknown direction, truth for a map or together with poses in the table; as for `drafts.start`.
    """
    if poses_are not in POSE_DIRECTIONS:
        raise ManifestError(f"poses_are: unknown {poses_are!r}. {nearest(poses_are, POSE_DIRECTIONS)}")
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
    shared_camera = None if camera is None else camera_at("camera", camera)
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
            image_camera, origin = _camera_of(row, listed_cameras, shared_camera, folder / name, where)
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

    Args:
        unit_m: meters per unit of the poses; None: unknown.
        options: as for `import_images`; `table` may be a transforms.json in the folder of images.

    Raises:
        CaptureError: the session was imported from other input (the message names it); or as for the imports.
        ManifestError: not the folder of the transforms.json; or as for the imports.
    """
    session = Path(capture) / "sessions" / f"{device}_{split}"
    inputs: dict[str, Any] = {"images": str(Path(images).resolve()), **options}
    if unit_m != 1:  # sessions of earlier versions do not record it
        inputs["unit_m"] = unit_m
    for name in ("table", "truth", "cameras"):
        if inputs.get(name) is not None:
            inputs[f"content of {name}"] = file_fingerprint(inputs[name])
            inputs[name] = str(Path(inputs[name]).resolve())
    if inputs.get("camera") is not None and _has_cameras(table=options.get("table"), cameras=options.get("cameras")):
        inputs["camera"] = None  # the table or cameras.txt override it
    try:
        names = list_images(Path(images), READ_SUFFIXES)
    except CaptureError as error:
        raise CaptureError(f"{split}_images: {error}") from None
    inputs["files of images"] = files_fingerprint([Path(images) / name for name in names])

    def make(record: dict[str, Any]) -> ImportReport:
        file = options.get("table")
        if file is None or not _is_transforms(file):
            return import_images(images, capture, device, split, unit_m=unit_m, record=record, **options)
        if Path(images).resolve() != Path(file).resolve().parent:
            raise ManifestError(f"{split}_images: found {images}, expected the folder of {file}.")
        if (found := options.get("poses_are", POSE_DIRECTIONS[0])) != POSE_DIRECTIONS[0]:
            raise ManifestError(f"poses_are: found {found!r}, expected world_from_cam, the direction in {file}.")
        return import_transforms(file, capture, device, split, own_split=False, unit_m=unit_m, record=record)

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
        raise CaptureError(
            f"{session} was imported from other input ({changes}). Delete it to import again, or give another capture."
        )
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
    pngs = [name for name in chosen if name.lower().endswith(".png")]
    sample = pngs[:: max(1, len(pngs) // 40)]
    flat = [name for name in sample if _is_no_photograph(folder / name)]
    if flat and len(flat) / len(sample) * len(pngs) >= 0.5 * len(chosen):
        kinds = f"{len(flat)} of {len(sample)} PNG files that were looked at, such as {flat[0]}, have 16 bits or two"
        draft.notes.append(f"{kinds} values, like depth and masks: leave such out with --only or --skip")
    return chosen


def _fits(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(one, pattern) for pattern in patterns for one in (name, Path(name).name))


def _is_no_photograph(path: Path) -> bool:
    """Tell whether an image has 16 bits in one channel, or at most two values."""
    try:
        pixels = decode(path, cv2.IMREAD_UNCHANGED)
    except ImageError:
        return False
    return (pixels.dtype == np.uint16 and pixels.ndim == 2) or len(np.unique(pixels[::2, ::2])) <= 2


def camera_at(where: object, params: str) -> pycolmap.Camera:
    """Return the camera `MODEL, width, height, parameter, ...`; `where` names file and line for a CaptureError."""
    try:
        return parse_camera("camera", params)
    except ValueError as error:
        raise CaptureError(f"{where}: {error}") from None


def _camera_of(
    row: Mapping[Any, Any], by_id: Mapping[str, pycolmap.Camera | str], shared: pycolmap.Camera | None, path: Path,
    where: str,
) -> tuple[pycolmap.Camera | str, str]:  # fmt: skip
    """Return the camera of an image and its origin: the table, cameras.txt, the camera shared by all images, or EXIF.

    The camera may be why it cannot be used. `where` names file and line of the image's row, for messages.
    """
    if "model" in row:
        text = ", ".join([row["model"], row["width"], row["height"], *str(row["params"]).split()])
        return camera_at(where, text), "given by the table"
    if "camera_id" in row:
        if row["camera_id"] not in by_id:
            ids = ", ".join(by_id) or "none: give cameras.txt"
            raise CaptureError(f"{where}: camera_id {row['camera_id']!r} is not in cameras.txt (it has: {ids}).")
        return by_id[row["camera_id"]], "given by cameras.txt"
    if len(by_id) > 1:
        raise CaptureError(f"cameras.txt has {len(by_id)} cameras; give a table with the columns image, camera_id.")
    if by_id:
        return next(iter(by_id.values())), "given by cameras.txt"
    return (shared, "given by --camera") if shared is not None else exif_camera(path)


def _has_cameras(table: str | Path | None, cameras: str | Path | None) -> bool:
    """Return whether the table or cameras.txt give cameras, which override the camera given for all images."""
    if _is_transforms(table):
        return True
    columns = _read_table(Path(table)).columns if table is not None else []
    return cameras is not None or not {"model", "camera_id"}.isdisjoint(columns)


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
    if poses_are not in POSE_DIRECTIONS:
        raise ManifestError(f"poses_are: unknown {poses_are!r}. {nearest(poses_are, POSE_DIRECTIONS)}")
    rows = _read_table(table)
    return list(rows["image"]), _poses_of(rows, poses_are)


def read_intrinsics(table: Path) -> dict[str, pycolmap.Camera]:
    """Return the cameras of the images in a table with the columns model, width, height, params, or in hloc's list."""
    rows = _read_table(table)
    if "model" not in rows:
        raise CaptureError(f"{table}: no intrinsics in it. Expected the columns image, {', '.join(_CAMERA_COLUMNS)}.")
    found = {}
    for row in rows.to_dict("records"):
        camera, _ = _camera_of(row, {}, None, table, f"{table}, line {row['line']}")
        assert isinstance(camera, pycolmap.Camera)
        found[str(row["image"])] = camera
    return found


def _read_table(path: Path) -> pd.DataFrame:
    """Read the table of a folder of images, all values as text, with the additional column `line`; with poses, also
    column `problem`, why the pose of a row is none.
    """
    if _is_transforms(path):
        raise CaptureError(f"{path}: not a CSV table. Import it by {COMMAND} import transforms.")
    text = read_text(path)
    first = next((line for line in text.splitlines() if line.strip()), "").split()
    of_hloc = len(first) > 4 and first[1] in pycolmap.CameraModelId.__members__
    rows = _read_hloc_list(text) if of_hloc else read_csv(path)
    columns = ("image", *POSE_NAMES, "timestamp", "camera_id", *_CAMERA_COLUMNS)
    if {"heading", "pitch", "roll"} <= set(rows.columns):
        do = f"Export as COLMAP there, and import that by `{COMMAND} import colmap`."
        raise CaptureError.at(path, "angles (heading, pitch, roll), as RealityScan writes them", "quaternions", do)
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
