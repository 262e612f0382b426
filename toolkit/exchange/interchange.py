"""Bring your own: COLMAP models and folders of images become sessions of a capture.

A session's images are linked or copied to `raw_data/import/images/`, under their names. What became of each is a row of
`proc/import.csv`. Pixels stay as they are stored: intrinsics belong to them, whatever an EXIF tag says about turning.

The table of a folder of images is a CSV file with a header. Column `image` is the path in the folder; `qw qx qy qz tx
ty tz` are its pose; `camera_id` names a camera of a `cameras.txt` in COLMAP's format, or `model width height params`
(params separated by spaces) are the camera itself. Columns may stand in any order; what is not known is refused.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from toolkit.capture import RAW_DATA, Trajectory, parse_camera, write_session
from toolkit.capture.devices import SPLITS
from toolkit.capture.exif import ORIENTATION, exif_camera, read_header, read_number, time_taken
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.files import write_atomic
from toolkit.geometry import invert, make_pose, pose_from_qt
from toolkit.manifest import nearest

SUBSESSION = "import"
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
POSE_DIRECTIONS = ("world_from_cam", "cam_from_world")
PLACING = ("link", "copy")
_CAMERA_COLUMNS = ("model", "width", "height", "params")


@dataclass
class ImportReport:
    """What an import made."""

    session: Path
    images: pd.DataFrame
    """One row an image: image, status (`imported` or why not), path, timestamp, sensor_id, device_id, camera."""
    notes: list[str] = field(default_factory=list)
    """What was guessed, made up, or deserves a look."""

    def text(self) -> str:
        """Return what was made, as text."""
        done = self.images["status"] == "imported"
        cameras = self.images[done]["sensor_id"].nunique()
        lines = [f"{self.session}: {done.sum()} of {len(self.images)} images, {cameras} cameras", *self.notes]
        left_out = self.images[~done]
        lines += [f"left out: {row.image}: {row.status}" for row in left_out.head(10).itertuples()]
        if len(left_out) > 10:
            lines.append(f"... and {len(left_out) - 10} more, see proc/import.csv")
        return "\n".join(lines)


@dataclass
class _Item:
    """An image on its way into a session."""

    name: str
    camera: pycolmap.Camera
    sensor: str
    frame: str
    """Images of one frame were taken at one time."""
    rig: str | None = None
    time_us: int | None = None
    turned: bool = False


def import_colmap(
    model: str | Path,
    images: str | Path,
    capture: str | Path,
    device: str = "ios",
    split: str = "map",
    placing: str = "link",
) -> ImportReport:
    """Make a session of a COLMAP model and its images: cameras, poses, and rigs where a rig has several cameras.

    Camera models are kept as they are, none is undistorted: the capture format holds all of COLMAP's. Points and tracks
    are not kept, for the map is triangulated anew. Images that the model does not have are counted, and left out.

    Args:
        model: folder with cameras, images, points3D (and rigs, frames), as .bin or .txt.
        images: folder that the model's image names are relative to.
        capture: folder of the capture; made where it does not exist.
        device, split: the session is `<device>_<split>`. Poses of queries become their ground truth.
        placing: `link` images to where they are, or `copy` them.

    Raises:
        CaptureError: no model in the folder, the session exists already, or no image is left.
        ManifestError: an unknown split or placing, or a device that cannot be part of a name.
    """
    session = _new_session(capture, device, split, placing)
    try:
        reconstruction = pycolmap.Reconstruction(str(model))
    except (ValueError, RuntimeError, MemoryError) as error:  # the last where a file is cut short
        reason = str(error).strip().split("\n")[0]
        raise CaptureError(f"{model}: no COLMAP model can be read here ({reason}). Expected cameras, images, points3D "
                           "as .bin or .txt.") from None  # fmt: skip
    items, poses, rigs = [], {}, []
    many = {rig_id: rig for rig_id, rig in reconstruction.rigs.items() if rig.num_sensors() > 1}
    for rig_id, rig in sorted(many.items()):
        for sensor in sorted(rig.sensor_ids(), key=lambda sensor: sensor.id):
            if sensor.type == pycolmap.SensorType.CAMERA:
                sensor_from_rig = None if rig.is_ref_sensor(sensor) else rig.sensor_from_rig(sensor)
                rig_from_sensor = np.eye(4) if sensor_from_rig is None else _matrix(sensor_from_rig.inverse())
                rigs.append((f"{SUBSESSION}/rig_{rig_id}", f"{SUBSESSION}/cam_{sensor.id}", rig_from_sensor))
    for _, image in sorted(reconstruction.images.items()):
        if not image.has_pose:  # a model in a file has registered images only
            continue
        rig_id = image.frame.rig_id
        rig_name = f"{SUBSESSION}/rig_{rig_id}" if rig_id in many else None
        frame, sensor_name = f"{image.frame_id}", f"{SUBSESSION}/cam_{image.camera_id}"
        items.append(_Item(image.name, image.camera, sensor_name, frame, rig_name))
        device_from_world = image.frame.rig_from_world if rig_name else image.cam_from_world()
        poses[frame] = _matrix(device_from_world.inverse())
    known, found = {item.name for item in items}, _list_images(Path(images))["image"]
    others = len(set(found) - known)
    notes = [f"{others} images of the folder are not in the model"] if others else []
    return _write(session, Path(images), items, [], poses, rigs, placing, notes)


def import_images(
    images: str | Path,
    capture: str | Path,
    device: str = "ios",
    split: str = "query",
    table: str | Path | None = None,
    poses_are: str = "world_from_cam",
    camera: str | None = None,
    cameras: str | Path | None = None,
    placing: str = "link",
) -> ImportReport:
    """Make a session of a folder of images, each camera on its own.

    Intrinsics are those of the table, else of `cameras`, else `camera`, else a guess from each image's EXIF.

    Args:
        images: folder; without a table, all JPEG and PNG files in and below it.
        capture: folder of the capture; made where it does not exist.
        device, split: the session is `<device>_<split>`. A map needs poses; those of queries become their ground truth.
        table: CSV file, see the head of this module.
        poses_are: direction of the table's poses, `world_from_cam` or `cam_from_world`; meters.
        camera: intrinsics of all images, `MODEL, width, height, parameter, ...`, with COLMAP's models.
        cameras: COLMAP's cameras.txt; its only camera is of all images, else the table's `camera_id` says which.
        placing: `link` images to where they are, or `copy` them.

    Raises:
        CaptureError: a malformed table or camera (names file and line), intrinsics that are nowhere, a map without
            poses, the session exists already, or no image is left.
        ManifestError: an unknown split, placing or direction, or a device that cannot be part of a name.
    """
    if poses_are not in POSE_DIRECTIONS:
        raise ManifestError(f"poses_are: unknown {poses_are!r}. {nearest(poses_are, POSE_DIRECTIONS)}")
    session, folder = _new_session(capture, device, split, placing), Path(images)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder of images.")
    rows = _read_table(Path(table)) if table is not None else _list_images(folder)
    posed = "qw" in rows
    if split == "map" and not posed:
        raise CaptureError(f"A map needs poses: give a table with the columns image, {', '.join(POSE_NAMES)}.")
    known = _read_cameras(Path(cameras)) if cameras is not None else {}
    given = None if camera is None else _camera(camera, "camera")
    items, dropped, notes = [], list[tuple[str, str]](), dict[str, int]()
    sensors: dict[str, str] = {}
    poses: dict[str, NDArray[np.float64]] = {}
    for row in rows.to_dict("records"):
        name, where = str(row["image"]), f"{table}, line {row['line']}"
        try:
            found, how = _camera_of(row, known, given, folder / name, where)
        except ImageError as error:
            dropped.append((name, str(error)))
            continue
        notes[how] = notes.get(how, 0) + 1
        params = _camera_text(found)
        sensor = sensors.setdefault(params, f"{SUBSESSION}/cam_{len(sensors) + 1}")
        items.append(_Item(name, found, sensor, name))
        if posed:
            pose = pose_from_qt(np.array([float(row[key]) for key in POSE_NAMES]))
            poses[name] = pose if poses_are == "world_from_cam" else invert(pose)
    said = [f"intrinsics of {count} images: {how}" for how, count in notes.items()]
    return _write(session, folder, items, dropped, poses, [], placing, said)


def _new_session(capture: str | Path, device: str, split: str, placing: str) -> Path:
    if split not in SPLITS:
        raise ManifestError(f"split: unknown {split!r}. {nearest(split, SPLITS)}")
    if placing not in PLACING:
        raise ManifestError(f"images: unknown choice {placing!r}. {nearest(placing, PLACING)}")
    if not re.fullmatch(r"[a-z0-9-]+", device):  # as `extra_devices` of a manifest has it
        raise ManifestError(f"device: found {device!r}, expected small letters, digits and '-', such as ios or drone.")
    session = Path(capture) / "sessions" / f"{device}_{split}"
    if session.exists():
        raise CaptureError(f"{session} exists already. Import into another capture or device, or remove it first.")
    return session


def _write(
    session: Path,
    folder: Path,
    items: Sequence[_Item],
    dropped: Iterable[tuple[str, str]],
    poses: Mapping[str, NDArray[np.float64]],
    rigs: Sequence[tuple[str, str, NDArray[np.float64]]],
    placing: str,
    notes: list[str],
) -> ImportReport:
    """Write the session of the images that can be used, poses by frame."""
    rows: list[dict[str, Any]] = [{"image": name, "status": why} for name, why in dropped]
    usable = []
    for item in items:
        problem = _look_at(folder / item.name, item)
        if problem:
            rows.append({"image": item.name, "status": problem})
        else:
            usable.append(item)
    if not usable:
        why = f" First: {rows[0]['image']}: {rows[0]['status']}." if rows else ""
        raise CaptureError(f"{folder}: none of {len(rows)} images can be imported.{why}")
    session.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{session.name}.", dir=session.parent) as part:
        # Moved into place when it is whole.
        report = _write_files(Path(part) / session.name, folder, usable, rows, poses, rigs, placing, notes)
        report.session.rename(session)
    return replace(report, session=session)


def _write_files(
    session: Path,
    folder: Path,
    usable: Sequence[_Item],
    rows: list[dict[str, Any]],
    poses: Mapping[str, NDArray[np.float64]],
    rigs: Sequence[tuple[str, str, NDArray[np.float64]]],
    placing: str,
    notes: list[str],
) -> ImportReport:
    times, said = _times_of(usable)
    turned = sum(item.turned for item in usable)
    if turned:
        notes = [*notes, f"{turned} images have an EXIF tag that asks for turning: the pixels are used as stored"]
    devices = [item.rig or item.sensor for item in usable]
    for item, device in zip(usable, devices, strict=True):
        path = f"{SUBSESSION}/images/{item.name}"
        _place(folder / item.name, session / RAW_DATA / path, placing)
        rows.append({"image": item.name, "status": "imported", "path": path, "timestamp": times[item.frame],
                     "sensor_id": item.sensor, "device_id": device, "camera": _camera_text(item.camera)})  # fmt: skip
    keys = {(times[item.frame], device): item.frame for item, device in zip(usable, devices, strict=True)}
    order = sorted(keys)
    stamps, names = [time for time, _ in order], [name for _, name in order]
    trajectory = None
    if poses:
        trajectory = Trajectory.from_poses(stamps, names, np.stack([poses[keys[key]] for key in order]))
    cameras = {item.sensor: item.camera for item in usable}
    used = {rig for rig in devices if rig not in cameras}
    is_map = session.name.endswith("_map")
    columns = ["image", "status", "path", "timestamp", "sensor_id", "device_id", "camera"]
    table = pd.DataFrame(rows, columns=columns).astype({"timestamp": "Int64"})
    write_session(
        session,
        [(name, "", "camera", *_camera_text(camera).split(", ")) for name, camera in sorted(cameras.items())],
        [row for row in rigs if row[0] in used and row[1] in cameras] or None,
        trajectory if is_map else None,
        sorted((times[item.frame], item.sensor, f"{SUBSESSION}/images/{item.name}") for item in usable),
        subsessions=[SUBSESSION],
        # All queries, as the list that is localized by default.
        keyframes=None if is_map else {"pruned_subsampled": pd.DataFrame({"timestamp": stamps, "device_id": names})},
        ground_truth=None if is_map else trajectory,
    )
    with write_atomic(session / "proc" / "import.csv") as temporary:
        table.to_csv(temporary, index=False)
    return ImportReport(session, table, [*notes, said])


def _place(source: Path, target: Path, placing: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if placing == "copy":
        with write_atomic(target) as temporary:
            shutil.copyfile(source, temporary)
    else:
        target.symlink_to(os.path.abspath(source))  # noqa: PTH100 - a link in the source stays one


def _look_at(path: Path, item: _Item) -> str:
    """Set time and turning of an image from its header; returns why it cannot be used, or nothing."""
    if "," in item.name or "\n" in item.name:
        return "the capture format cannot hold the comma or line break in its name"
    if PurePosixPath(item.name).is_absolute() or ".." in PurePosixPath(item.name).parts:
        return "not a path inside the folder of images"
    try:
        size, exif = read_header(path)
    except ImageError as error:
        return str(error)
    wanted = (item.camera.width, item.camera.height)
    orientation = read_number(exif, ORIENTATION)
    item.turned, item.time_us = orientation > 1, time_taken(exif)
    if size == wanted:
        return ""
    why = f"the image is stored as {size[0]} x {size[1]} pixels, its camera is of {wanted[0]} x {wanted[1]}"
    if orientation > 4 and size == wanted[::-1]:
        why += "; the camera is of the turned image: turn the pixels and remove the EXIF orientation"
    return why


def _times_of(items: Sequence[_Item]) -> tuple[dict[str, int], str]:
    """Return the time of each frame, microseconds, and how it was found."""
    frames = list(dict.fromkeys(item.frame for item in items))
    taken: dict[str, int] = {}
    for item in items:
        if item.time_us is not None:
            taken.setdefault(item.frame, item.time_us)
    if len(taken) == len(frames) == len(set(taken.values())):
        return taken, "timestamps: of the camera's clock, from EXIF"
    why = "some images have no time" if len(taken) < len(frames) else "some images have the same time"
    return (
        {frame: (number + 1) * 10**6 for number, frame in enumerate(frames)},
        f"timestamps: made up, a second apart in the order of the images ({why} in EXIF)",
    )


# Cameras


def _camera(params: str, where: str) -> pycolmap.Camera:
    try:
        return parse_camera("camera", params)
    except ValueError as error:
        raise CaptureError(f"{where}: {error}") from None


def _camera_text(camera: pycolmap.Camera) -> str:
    values = [str(camera.width), str(camera.height), *(repr(float(value)) for value in camera.params)]
    return ", ".join([camera.model.name, *values])


def _camera_of(
    row: Mapping[Any, Any], known: Mapping[str, pycolmap.Camera], given: pycolmap.Camera | None, path: Path, where: str
) -> tuple[pycolmap.Camera, str]:
    """Return the camera of an image, and where it is from."""
    if "model" in row:
        text = ", ".join([row["model"], row["width"], row["height"], *str(row["params"]).split()])
        return _camera(text, where), "the table's"
    if "camera_id" in row:
        if row["camera_id"] not in known:
            listed = ", ".join(known) or "none: give cameras.txt"
            raise CaptureError(f"{where}: camera_id {row['camera_id']!r} is not in cameras.txt (there: {listed}).")
        return known[row["camera_id"]], "those of cameras.txt"
    if known:
        if len(known) > 1:
            raise CaptureError(
                f"cameras.txt has {len(known)} cameras; give a table with the columns image, camera_id that says which."
            )
        return next(iter(known.values())), "the camera of cameras.txt"
    if given is not None:
        return given, "the camera that was given"
    return exif_camera(path)


def _read_cameras(path: Path) -> dict[str, pycolmap.Camera]:
    """Read COLMAP's cameras.txt: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...` a line."""
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


def _list_images(folder: Path) -> pd.DataFrame:
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise CaptureError(f"{folder}: no image in or below it. Expected {', '.join(IMAGE_SUFFIXES)}.")
    return pd.DataFrame({"image": [path.relative_to(folder).as_posix() for path in paths], "line": 0})


def _read_table(path: Path) -> pd.DataFrame:
    """Read the table of a folder of images, all values as text; adds the column `line`."""
    try:
        rows = pd.read_csv(path, dtype=str, keep_default_na=False, skipinitialspace=True, skip_blank_lines=False)
    except (OSError, UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise CaptureError(f"{path}: cannot be read as a CSV table ({error}).") from None
    rows.columns = [name.strip().lstrip("# ") for name in rows.columns]
    known = ("image", *POSE_NAMES, "camera_id", *_CAMERA_COLUMNS)
    for name in rows.columns:
        if name not in known:
            raise CaptureError(f"{path}: unknown column {name!r}. {nearest(name, known)}")
    for group in (("image",), POSE_NAMES, _CAMERA_COLUMNS):
        missing = [name for name in group if name not in rows]
        if missing and (group == ("image",) or len(missing) < len(group)):
            raise CaptureError(f"{path}: column {missing[0]!r} is missing; expected {', '.join(group)}.")
    rows["line"] = np.arange(len(rows)) + 2
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
            raise CaptureError(
                f"{path}, line {row['line']}: found the pose {found}; expected seven finite numbers, qw qx qy qz of "
                "length 1 and meters."
            )
    return rows


def _matrix(rigid: pycolmap.Rigid3d) -> NDArray[np.float64]:
    return make_pose(rigid.rotation.matrix(), rigid.translation)
