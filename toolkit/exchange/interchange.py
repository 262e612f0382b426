"""Import COLMAP models and folders of images as sessions of a capture (see `drafts`).

A folder of images may have a table, a CSV file with a header. Column `image` is the path in the folder; `qw qx qy qz tx
ty tz` are the pose; `camera_id` names a camera in a COLMAP `cameras.txt`, or `model width height params` (params
separated by spaces) give the camera directly. The order of columns is free; unknown columns are an error. A query list
of hloc, `name MODEL width height parameters` per line, is accepted in place of the table.
"""

import csv
import io
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap

from toolkit.capture import parse_camera
from toolkit.capture.folder import IMPORT_RECORD
from toolkit.capture.images import exif_camera
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.exchange.colmap_model import read_model
from toolkit.exchange.drafts import (
    SUBSESSION,
    DraftImage,
    ImportReport,
    list_images,
    posed_camera,
    require_convention,
    start,
    write_drafts,
)
from toolkit.exchange.transforms import import_transforms
from toolkit.files import file_fingerprint, files_fingerprint, read_json, write_text
from toolkit.geometry import Floats, invert, pose_from_qt
from toolkit.manifest import nearest

POSE_DIRECTIONS = ("world_from_cam", "cam_from_world")
_CAMERA_COLUMNS = ("model", "width", "height", "params")


def import_colmap(
    model: str | Path, images: str | Path, capture: str | Path, device: str = "ios", split: str = "map",
    placing: str = "link", masks: str | Path | None = None,
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
        placing: `link` to the images, or `copy` them.
        masks: folder of masks, see `images.find_mask`; they are placed as the images are.

    Raises:
        CaptureError: no model in the folder, or a damaged one; the session exists already, or no image is left.
        ManifestError: an unknown split or placing, or a device that cannot be part of a name.
    """
    draft = start(capture, device, split, Path(images), placing, masks)
    content = read_model(Path(model))
    draft.notes += content.notes
    rig_of_image = {
        image_id: (frame_id, frame)
        for frame_id, frame in content.frames.items()
        for image_id in frame.image_ids
        if frame.rig_id in content.rigs
    }
    sensors = _sensors_of_rigs(content.rigs)
    for rig_id, cameras in sorted(content.rigs.items()):
        calibrated = {camera_id: pose for camera_id, pose in sorted(cameras.items()) if pose is not None}
        draft.rigs += [
            (f"{SUBSESSION}/rig_{rig_id}", sensors[rig_id, camera_id], invert(sensor_from_rig))
            for camera_id, sensor_from_rig in calibrated.items()
        ]
    moved, names = 0, set[str]()
    for image_id, image in sorted(content.images.items()):
        frame_id, frame = rig_of_image.get(image_id, (image_id, None))
        camera, pose = content.cameras.get(image.camera_id, "its camera is not in the model"), image.cam_from_world
        rig_name, sensor = None, f"{SUBSESSION}/cam_{image.camera_id}"
        if frame is not None:
            rig_name, sensor = f"{SUBSESSION}/rig_{frame.rig_id}", sensors[frame.rig_id, image.camera_id]
            sensor_from_rig = content.rigs[frame.rig_id].get(image.camera_id)
            pose = frame.rig_from_world if sensor_from_rig is not None else "its camera has no pose in its rig"
            if not isinstance(pose, str) and not isinstance(image.cam_from_world, str):
                moved += not np.allclose(sensor_from_rig @ pose, image.cam_from_world, rtol=1e-4, atol=1e-4)
        unusable = "its name occurs twice in the model" if image.name in names else camera
        unusable = unusable if isinstance(unusable, str) else pose
        names.add(image.name)
        if isinstance(unusable, str) or isinstance(camera, str):
            draft.rows.append({"image": image.name, "status": unusable})
            continue
        draft.images.append(DraftImage(image.name, camera, sensor, f"{frame_id}", rig_name))
        draft.poses[f"{frame_id}"] = invert(unusable)
    if moved:
        draft.notes.append(f"{moved} images have another pose than their rig gives them: that of the rig is taken")
    not_in_model = set(list_images(draft.folder)) - names
    if not_in_model:
        draft.notes.append(f"{len(not_in_model)} images of the folder are not in the model")
    return write_drafts(draft)[0]


def import_images(
    images: str | Path, capture: str | Path, device: str = "ios", split: str = "query", table: str | Path | None = None,
    poses_are: str = "world_from_cam", camera: str | None = None, cameras: str | Path | None = None,
    placing: str = "link", axes: str = "opencv", unit_m: float = 1.0, truth: str | Path | None = None,
    masks: str | Path | None = None,
) -> ImportReport:  # fmt: skip
    """Make a session from a folder of images without rigs.

    Intrinsics come from the table, else from `cameras`, else from `camera`, else they are guessed from each image's
    EXIF.

    Args:
        images: folder; without a table, all JPEG and PNG files in and below it are imported.
        capture, device, split, placing, masks: as for `import_colmap`. A map needs poses.
        table: CSV file, see the module's docstring.
        poses_are: direction of the poses in table and truth, `world_from_cam` or `cam_from_world`.
        camera: intrinsics of all images, `MODEL, width, height, parameter, ...`, with COLMAP's models.
        cameras: COLMAP's cameras.txt. A single camera applies to all images; of several, the table's `camera_id`
            selects one.
        axes: camera axes of the poses, see `drafts.AXES`.
        unit_m: meters per unit of the poses.
        truth: CSV file like the table; its poses become the ground truth of queries. Images not in it are queries
            without ground truth.

    Raises:
        CaptureError: a malformed table or camera (names file and line), an image without intrinsics, a map without
            poses, truth that names no image, the session exists already, or no image is left.
        ManifestError: an unknown split, placing, direction or axes, a unit that is not a positive length, truth for a
            map or together with poses in the table, or a device that cannot be part of a name.
    """
    if poses_are not in POSE_DIRECTIONS:
        raise ManifestError(f"poses_are: unknown {poses_are!r}. {nearest(poses_are, POSE_DIRECTIONS)}")
    require_convention(axes, unit_m)
    draft, folder = start(capture, device, split, Path(images), placing, masks), Path(images)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder of images.")
    rows = _read_table(Path(table)) if table is not None else pd.DataFrame({"image": list_images(folder), "line": 0})
    if split == "map" and "qw" not in rows:
        given = f"a table with the columns image, {', '.join(POSE_NAMES)}"
        raise CaptureError(f"A map needs poses: give {given}, or import a transforms.json or a COLMAP model.")
    listed_cameras = _read_cameras(Path(cameras)) if cameras is not None else {}
    shared_camera = None if camera is None else _camera(camera, "camera")
    posed = rows if truth is None else _read_truth(Path(truth), rows, split)
    poses = _poses_of(posed, poses_are, axes, unit_m)
    origins = Counter[str]()
    for row in rows.to_dict("records"):
        name, where = str(row["image"]), f"{table}, line {row['line']}"
        try:
            image_camera, origin = _camera_of(row, listed_cameras, shared_camera, folder / name, where)
        except ImageError as error:
            draft.rows.append({"image": name, "status": str(error)})
            continue
        origins[origin] += 1
        draft.add(name, image_camera, poses.get(name))
    if truth is not None:
        draft.notes.append(f"ground truth of {len(draft.poses)} of {len(rows)} images: {truth}")
    draft.notes += [f"intrinsics of {count} images: {origin}" for origin, count in origins.items()]
    return write_drafts(draft)[0]


def import_once(
    images: str | Path | None, capture: str | Path, device: str, split: str, unit_m: float | None = 1.0, **options: Any
) -> str:
    """Import images, unless the session was imported before from the same input. Return a message for the user.

    Args:
        unit_m: meters per unit of the poses; None: unknown.
        options: as for `import_images`; `table` may be a transforms.json in the folder of images.

    Raises:
        CaptureError: the session was imported from other input (the message names it); or as for the imports.
        ManifestError: no folder is given, or not the folder of the transforms.json; or as for the imports.
    """
    if images is None:
        raise ManifestError(f"{split}_images: found None, expected the folder of your images: other inputs are given.")
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
    inputs["files of images"] = files_fingerprint([Path(images) / name for name in list_images(Path(images))])
    record = session / IMPORT_RECORD
    if not session.exists():
        file = options.get("table")
        if file is not None and _is_transforms(file):
            if Path(images).resolve() != Path(file).resolve().parent:
                raise ManifestError(f"{split}_images: found {images}, expected the folder of {file}.")
            if (found := options.get("poses_are", POSE_DIRECTIONS[0])) != POSE_DIRECTIONS[0]:
                raise ManifestError(f"poses_are: found {found!r}, expected world_from_cam, the direction in {file}.")
            report = import_transforms(file, capture, device, split, unit_m=unit_m)[0]
        else:
            report = import_images(images, capture, device, split, unit_m=unit_m or 1.0, **options)
        unknown = {"unit": None} if unit_m is None else {}
        write_text(record, json.dumps(read_json(record) | unknown | {"input": inputs}, indent=1) + "\n")
        return report.text()
    before = read_json(record).get("input", {})
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


def _sensors_of_rigs(rigs: Mapping[int, Mapping[int, Floats | None]]) -> dict[tuple[int, int], str]:
    """Return the sensor's name by rig and camera: a camera that is in several rigs becomes a sensor of each."""
    of_camera = Counter(camera_id for cameras in rigs.values() for camera_id in cameras)
    return {
        (rig_id, camera_id): f"{SUBSESSION}/cam_{camera_id}" + (f"_rig_{rig_id}" if of_camera[camera_id] > 1 else "")
        for rig_id, cameras in rigs.items()
        for camera_id in cameras
    }


# Cameras


def _camera(params: str, where: str) -> pycolmap.Camera:
    try:
        return parse_camera("camera", params)
    except ValueError as error:
        raise CaptureError(f"{where}: {error}") from None


def _camera_of(
    row: Mapping[Any, Any], by_id: Mapping[str, pycolmap.Camera], shared: pycolmap.Camera | None, path: Path, where: str
) -> tuple[pycolmap.Camera, str]:
    """Return the camera of an image and its origin: the table, cameras.txt, the camera shared by all images, or EXIF.

    `where` names file and line of the image's row, for messages.
    """
    if "model" in row:
        text = ", ".join([row["model"], row["width"], row["height"], *str(row["params"]).split()])
        return _camera(text, where), "the table's"
    if "camera_id" in row:
        if row["camera_id"] not in by_id:
            ids = ", ".join(by_id) or "none: give cameras.txt"
            raise CaptureError(f"{where}: camera_id {row['camera_id']!r} is not in cameras.txt (it has: {ids}).")
        return by_id[row["camera_id"]], "those of cameras.txt"
    if len(by_id) > 1:
        raise CaptureError(f"cameras.txt has {len(by_id)} cameras; give a table with the columns image, camera_id.")
    if by_id:
        return next(iter(by_id.values())), "the camera of cameras.txt"
    return (shared, "the given camera") if shared is not None else exif_camera(path)


def _has_cameras(table: str | Path | None, cameras: str | Path | None) -> bool:
    """Return whether the table or cameras.txt give cameras, which override the camera given for all images."""
    if _is_transforms(table):
        return True
    columns = _read_table(Path(table)).columns if table is not None else []
    return cameras is not None or not {"model", "camera_id"}.isdisjoint(columns)


def _read_cameras(path: Path) -> dict[str, pycolmap.Camera]:
    """Read COLMAP's cameras.txt: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...` per line."""
    cameras: dict[str, pycolmap.Camera] = {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: cannot be read ({error}). Expected COLMAP's cameras.txt.") from None
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if words and not line.startswith("#"):
            cameras[words[0]] = _camera(", ".join(words[1:]), f"{path}, line {number}")
    if not cameras:
        raise CaptureError(f"{path}: no camera in it. Expected lines of `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...`.")
    return cameras


# Tables


def _read_truth(path: Path, images: pd.DataFrame, split: str) -> pd.DataFrame:
    """Read the table with the ground truth of some of the query `images`."""
    if split != "query" or "qw" in images:
        why = "the images of a map" if split != "query" else "images whose table has poses already"
        raise ManifestError(f"truth: {path} is given for {why}. Give it for queries whose table has no poses.")
    rows = _read_table(path)
    if "qw" not in rows:
        raise CaptureError(f"{path}: no poses in it. Expected the columns image, {', '.join(POSE_NAMES)}.")
    if not set(rows["image"]) & set(images["image"]):
        names = [repr(next(iter(table["image"]), "")) for table in (rows, images)]
        found = f"found {names[0]} and others, expected {names[1]} and others, paths in the folder of images"
        raise CaptureError(f"{path}: no row is about an imported image: {found}.")
    return rows


def _poses_of(rows: pd.DataFrame, poses_are: str, axes: str, unit_m: float) -> dict[str, Floats]:
    """Return world_from_cam (4, 4), meters, by image; empty if the table has no poses."""
    if "qw" not in rows:
        return {}
    poses = pose_from_qt(rows[list(POSE_NAMES)].to_numpy(float))
    poses = poses if poses_are == "world_from_cam" else invert(poses)
    return {str(name): posed_camera(pose, axes, unit_m) for name, pose in zip(rows["image"], poses, strict=True)}


def read_poses(
    table: Path, poses_are: str, axes: str, unit_m: float
) -> tuple[list[str], dict[str, Floats]]:  # fmt: skip
    """Return the images of a table, and their world_from_cam (4, 4) in meters; see `import_images`."""
    if poses_are not in POSE_DIRECTIONS:
        raise ManifestError(f"poses_are: unknown {poses_are!r}. {nearest(poses_are, POSE_DIRECTIONS)}")
    require_convention(axes, unit_m)
    rows = _read_table(table)
    return list(rows["image"]), _poses_of(rows, poses_are, axes, unit_m)


def _read_table(path: Path) -> pd.DataFrame:
    """Read the table of a folder of images, all values as text, with the additional column `line`."""
    if _is_transforms(path):
        raise CaptureError(f"{path}: not a CSV table. Import it by python -m toolkit import transforms.")
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets write the mark
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: cannot be read as a CSV table ({error}).") from None
    first = next((line for line in text.splitlines() if line.strip()), "").split()
    of_hloc = len(first) > 4 and first[1] in pycolmap.CameraModelId.__members__
    rows = _read_hloc_list(text) if of_hloc else _read_csv(path, text)
    columns = ("image", *POSE_NAMES, "camera_id", *_CAMERA_COLUMNS)
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
        wrong = ~np.isfinite(values).all(axis=1)
        wrong |= np.abs(np.linalg.norm(np.nan_to_num(values[:, :4]), axis=1) - 1) > 1e-3
        if wrong.any():
            row = rows.iloc[int(np.argmax(wrong))]
            found = ", ".join(row[list(POSE_NAMES)])
            expected = "seven finite numbers, qw qx qy qz of length 1 and tx ty tz"
            raise CaptureError(f"{path}, line {row['line']}: found the pose {found}; expected {expected}.")
    return rows


def _read_csv(path: Path, text: str) -> pd.DataFrame:
    """Read a CSV table with a header. Empty values beyond its columns, which spreadsheets write, are ignored."""
    reader = csv.reader(io.StringIO(text), skipinitialspace=True, strict=True)
    rows: list[list[str | int]] = []
    try:
        header = next(reader, [])
        while header and not header[-1].strip():
            header.pop()
        for values in reader:
            if any(value.strip() for value in values[len(header) :]):
                found = f"found {len(values)} values, expected {len(header)}, as in the header"
                raise CaptureError(f"{path}, line {reader.line_num}: {found}. A comma in a value needs double quotes.")
            rows.append([*values[: len(header)], *[""] * (len(header) - len(values)), reader.line_num])
    except csv.Error as error:
        raise CaptureError(f"{path}, line {reader.line_num}: cannot be read as a CSV table ({error}).") from None
    return pd.DataFrame(rows, columns=[*header, "line"])


def _read_hloc_list(text: str) -> pd.DataFrame:
    """Read hloc's query list, `name MODEL width height parameters` per line without a header, as a table."""
    lines = [line.split(maxsplit=4) for line in text.splitlines()]
    rows = [[*line, *[""] * (5 - len(line)), number] for number, line in enumerate(lines, start=1)]
    return pd.DataFrame(rows, columns=["image", *_CAMERA_COLUMNS, "line"])
