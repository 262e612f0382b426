"""Bring your own: COLMAP models and folders of images become sessions of a capture.

A session's images are linked or copied to `raw_data/import/images/`, under their names. The status of each image is a
row of `proc/import.csv`. Images stay as they are stored, and intrinsics belong to the stored pixels, whether or not
EXIF asks to turn the image.

The table of a folder of images is a CSV file with a header. Column `image` is the path in the folder; `qw qx qy qz tx
ty tz` are the image's pose; `camera_id` names a camera of a `cameras.txt` in COLMAP's format, or `model width height
params` (params separated by spaces) are the camera itself. Columns may stand in any order; an unknown one is refused.
"""

import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pandas as pd
import pycolmap

from toolkit.capture import RAW_DATA, Trajectory, parse_camera, write_session
from toolkit.capture.devices import SPLITS
from toolkit.capture.exif import ORIENTATION, exif_camera, read_header, read_number, time_taken
from toolkit.capture.names import EXPECTED_NAME, is_bad_name, note_linked_here
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.files import write_folder
from toolkit.geometry import Floats, invert, make_pose, pose_from_qt
from toolkit.localizers.mapping import camera_text
from toolkit.manifest import nearest

SUBSESSION = "import"
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
POSE_DIRECTIONS = ("world_from_cam", "cam_from_world")
PLACING = ("link", "copy")
PROBE_S = 60
"""How long COLMAP may take to read a model, besides 10 s a megabyte; at damaged files it may take for ever."""
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
class _Image:
    """An image that is to become part of a session."""

    name: str
    camera: pycolmap.Camera
    sensor: str
    frame: str
    """Images of one frame were taken at one time."""
    rig: str | None = None
    time_us: int | None = None
    turned: bool = False
    """Whether EXIF asks to turn the image."""

    @property
    def path(self) -> str:
        """Relative to raw_data."""
        return f"{SUBSESSION}/images/{self.name}"

    @property
    def device(self) -> str:
        return self.rig or self.sensor


@dataclass
class _Draft:
    """A session that is being put together."""

    session: Path
    folder: Path
    """Of the images."""
    placing: str
    images: list[_Image] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    """Of `proc/import.csv`."""
    poses: dict[str, Floats] = field(default_factory=dict)
    """world_from_device, (4, 4), by frame."""
    rigs: list[tuple[str, str, Floats]] = field(default_factory=list)
    """Rig, sensor, rig_from_sensor."""
    notes: list[str] = field(default_factory=list)

    def write(self) -> ImportReport:
        """Leave out the images that cannot be used, and write the session of the others."""
        problems = {image.name: self._problem(image) for image in self.images}
        self.rows += [{"image": name, "status": problem} for name, problem in problems.items() if problem]
        self.images = [image for image in self.images if not problems[image.name]]
        if not self.images:
            why = f" First: {self.rows[0]['image']}: {self.rows[0]['status']}." if self.rows else ""
            raise CaptureError(f"{self.folder}: none of {len(self.rows)} images can be imported.{why}")
        if turned := sum(image.turned for image in self.images):
            self.notes.append(f"{turned} images have an EXIF tag that asks for turning: the pixels are used as stored")
        times = self._choose_times()
        self.rows += [
            {"image": image.name, "status": "imported", "path": image.path, "timestamp": times[image.frame],
             "sensor_id": image.sensor, "device_id": image.device, "camera": camera_text(image.camera)}
            for image in self.images
        ]  # fmt: skip
        columns = ["image", "status", "path", "timestamp", "sensor_id", "device_id", "camera"]
        table = pd.DataFrame(self.rows, columns=columns).astype({"timestamp": "Int64"})
        with write_folder(self.session) as part:
            for image in self.images:
                source, target = self.folder / image.name, part / RAW_DATA / image.path
                target.parent.mkdir(parents=True, exist_ok=True)
                if self.placing == "copy":
                    shutil.copyfile(source, target)
                else:
                    target.symlink_to(os.path.abspath(source))  # noqa: PTH100 - a link in the source stays one
            self._write_tables(part, times)
            table.to_csv(part / "proc" / "import.csv", index=False)
            if self.placing == "link":
                note_linked_here(part)
        return ImportReport(self.session, table, self.notes)

    def _write_tables(self, session: Path, times: Mapping[str, int]) -> None:
        """Write the text files of the capture format, `times` being those of frames."""
        frame_of = {(times[image.frame], image.device): image.frame for image in self.images}
        keys = pd.DataFrame(sorted(frame_of), columns=["timestamp", "device_id"])
        trajectory = None
        if self.poses:
            poses = np.stack([self.poses[frame_of[key]] for key in sorted(frame_of)])
            trajectory = Trajectory.from_poses(keys["timestamp"], keys["device_id"], poses)
        cameras = {image.sensor: image.camera for image in self.images}
        rigs = {image.rig for image in self.images}
        is_map = self.session.name.endswith("_map")
        write_session(
            session,
            [(name, "", "camera", *camera_text(camera).split(", ")) for name, camera in sorted(cameras.items())],
            [row for row in self.rigs if row[0] in rigs and row[1] in cameras] or None,
            trajectory if is_map else None,
            sorted((times[image.frame], image.sensor, image.path) for image in self.images),
            subsessions=[SUBSESSION],
            keyframes=None if is_map else {"pruned_subsampled": keys},  # the list that is localized by default
            ground_truth=None if is_map else trajectory,
        )

    def _problem(self, image: _Image) -> str:
        """Set what an image's header says; return why the image cannot be used, or nothing."""
        name = PurePosixPath(image.name)
        if "," in image.name:
            return "the capture format cannot hold the comma in its name"
        if image.name.startswith("/") or ".." in name.parts:
            return "not a path inside the folder of images"
        if is_bad_name(image.name):
            return f"the capture format cannot hold this name, expected {EXPECTED_NAME}"
        try:
            size, exif = read_header(self.folder / name)
        except ImageError as error:
            return str(error)
        orientation, camera = read_number(exif, ORIENTATION), image.camera
        image.turned, image.time_us = orientation > 1, time_taken(exif)
        if size == (camera.width, camera.height):
            return ""
        stored = f"{size[0]} x {size[1]}"
        problem = f"the image is stored as {stored} pixels, its camera is of {camera.width} x {camera.height}"
        if orientation > 4 and size == (camera.height, camera.width):
            problem += "; the camera is of the turned image: turn the pixels and remove the EXIF orientation"
        return problem

    def _choose_times(self) -> dict[str, int]:
        """Return the time of each frame, microseconds: from EXIF if that tells the frames apart."""
        frames = list(dict.fromkeys(image.frame for image in self.images))
        taken = {image.frame: image.time_us for image in reversed(self.images) if image.time_us is not None}
        if len(taken) == len(frames) == len(set(taken.values())):
            self.notes.append("timestamps: of the camera's clock, from EXIF")
            return taken
        why = "some images have no time" if len(taken) < len(frames) else "some images have the same time"
        self.notes.append(f"timestamps: made up, a second apart in the order of the images ({why} in EXIF)")
        return {frame: (number + 1) * 10**6 for number, frame in enumerate(frames)}


def import_colmap(
    model: str | Path,
    images: str | Path,
    capture: str | Path,
    device: str = "ios",
    split: str = "map",
    placing: str = "link",
) -> ImportReport:
    """Make a session of a COLMAP model and its images: cameras, poses, and rigs where a rig has several cameras.

    Camera models are kept as they are, without undistortion: the capture format holds all of COLMAP's. Points and
    tracks are not kept, for the map is triangulated anew. Images of the folder that are not in the model are left out,
    and counted in the report.

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
    draft = _start(capture, device, split, Path(images), placing)
    reconstruction = _read_model(Path(model))
    rigs = {rig_id: rig for rig_id, rig in sorted(reconstruction.rigs.items()) if rig.num_sensors() > 1}
    for rig_id, rig in rigs.items():
        for sensor in sorted(rig.sensor_ids(), key=lambda sensor: sensor.id):
            if sensor.type == pycolmap.SensorType.CAMERA:
                rig_from_sensor = np.eye(4) if rig.is_ref_sensor(sensor) else _inverse(rig.sensor_from_rig(sensor))
                draft.rigs.append((f"{SUBSESSION}/rig_{rig_id}", f"{SUBSESSION}/cam_{sensor.id}", rig_from_sensor))
    for _, image in sorted(reconstruction.images.items()):
        if not image.has_pose:  # a model in a file has registered images only
            continue
        rig_name = f"{SUBSESSION}/rig_{image.frame.rig_id}" if image.frame.rig_id in rigs else None
        frame, sensor_name = f"{image.frame_id}", f"{SUBSESSION}/cam_{image.camera_id}"
        draft.images.append(_Image(image.name, image.camera, sensor_name, frame, rig_name))
        draft.poses[frame] = _inverse(image.frame.rig_from_world if rig_name else image.cam_from_world())
    not_in_model = set(_list_images(draft.folder)["image"]) - {image.name for image in draft.images}
    if not_in_model:
        draft.notes.append(f"{len(not_in_model)} images of the folder are not in the model")
    return draft.write()


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
        capture, device, split, placing: as of `import_colmap`. A map needs poses.
        table: CSV file, see the head of this module.
        poses_are: direction of the table's poses, `world_from_cam` or `cam_from_world`; meters.
        camera: intrinsics of all images, `MODEL, width, height, parameter, ...`, with COLMAP's models.
        cameras: COLMAP's cameras.txt; its only camera is of all images, else the table's `camera_id` says which.

    Raises:
        CaptureError: a malformed table or camera (names file and line), an image without intrinsics, a map without
            poses, the session exists already, or no image is left.
        ManifestError: an unknown split, placing or direction, or a device that cannot be part of a name.
    """
    if poses_are not in POSE_DIRECTIONS:
        raise ManifestError(f"poses_are: unknown {poses_are!r}. {nearest(poses_are, POSE_DIRECTIONS)}")
    draft, folder = _start(capture, device, split, Path(images), placing), Path(images)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder of images.")
    rows = _read_table(Path(table)) if table is not None else _list_images(folder)
    if split == "map" and "qw" not in rows:
        raise CaptureError(f"A map needs poses: give a table with the columns image, {', '.join(POSE_NAMES)}.")
    listed_cameras = _read_cameras(Path(cameras)) if cameras is not None else {}
    given_camera = None if camera is None else _camera(camera, "camera")
    sensors: dict[str, str] = {}
    origins = Counter[str]()
    for row in rows.to_dict("records"):
        name, where = str(row["image"]), f"{table}, line {row['line']}"
        try:
            image_camera, origin = _camera_of(row, listed_cameras, given_camera, folder / name, where)
        except ImageError as error:
            draft.rows.append({"image": name, "status": str(error)})
            continue
        origins[origin] += 1
        sensor = sensors.setdefault(camera_text(image_camera), f"{SUBSESSION}/cam_{len(sensors) + 1}")
        draft.images.append(_Image(name, image_camera, sensor, name))
        if "qw" in row:
            pose = pose_from_qt(np.array([float(row[key]) for key in POSE_NAMES]))
            draft.poses[name] = pose if poses_are == "world_from_cam" else invert(pose)
    draft.notes += [f"intrinsics of {count} images: {origin}" for origin, count in origins.items()]
    return draft.write()


def _start(capture: str | Path, device: str, split: str, folder: Path, placing: str) -> _Draft:
    """Return the draft of a new session, or refuse one that cannot be made."""
    if split not in SPLITS:
        raise ManifestError(f"split: unknown {split!r}. {nearest(split, SPLITS)}")
    if placing not in PLACING:
        raise ManifestError(f"images: unknown choice {placing!r}. {nearest(placing, PLACING)}")
    if not re.fullmatch(r"[a-z0-9-]+", device):  # as `extra_devices` of a manifest has it
        raise ManifestError(f"device: found {device!r}, expected small letters, digits and '-', such as ios or drone.")
    session = Path(capture) / "sessions" / f"{device}_{split}"
    if session.exists():
        raise CaptureError(f"{session} exists already. Import into another capture or device, or remove it first.")
    return _Draft(session, folder, placing)


_PROBE = """
import os, sys, pycolmap
size = sum(entry.stat().st_size for entry in os.scandir(sys.argv[1]))
if sys.platform == "linux":
    import resource
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30) + 50 * size,) * 2)
try:
    model = pycolmap.Reconstruction(sys.argv[1])
    [image.cam_from_world() for image in model.images.values() if image.has_pose]
except MemoryError:
    sys.exit("a file is damaged: it asks for more memory than its size can mean")
except Exception as error:
    sys.exit(str(error) or type(error).__name__)
"""


def _read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model, first in a process of its own: at damaged files COLMAP ends the process, or fills the memory."""
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder. Expected one with a COLMAP model.")
    for path in folder.glob("*.bin"):
        if path.stat().st_size < 8:
            raise CaptureError(f"{path}: no part of a COLMAP model: it is cut short. Export the model again.")
    limit_s = PROBE_S + 1e-5 * sum(path.stat().st_size for path in folder.iterdir())
    try:
        tried = subprocess.run(
            [sys.executable, "-c", _PROBE, str(folder)], capture_output=True, timeout=limit_s, check=False
        )
        said = [line for line in tried.stderr.decode(errors="replace").split("\n") if line.strip(" *")]
        reason = said[0].strip()[:300] if said else f"COLMAP ended with status {tried.returncode}"
    except subprocess.TimeoutExpired:
        tried, reason = None, f"COLMAP was not done with it after {limit_s:.0f} s"
    if tried is None or tried.returncode:
        raise CaptureError(
            f"{folder}: no COLMAP model can be read here ({reason}). Expected cameras, images, points3D as .bin or "
            ".txt."
        )
    return pycolmap.Reconstruction(str(folder))


# Cameras


def _camera(params: str, where: str) -> pycolmap.Camera:
    try:
        return parse_camera("camera", params)
    except ValueError as error:
        raise CaptureError(f"{where}: {error}") from None


def _camera_of(
    row: Mapping[Any, Any], listed: Mapping[str, pycolmap.Camera], given: pycolmap.Camera | None, path: Path, where: str
) -> tuple[pycolmap.Camera, str]:
    """Return the camera of an image, and where it is from: its row of the table, a list, the user, or EXIF."""
    if "model" in row:
        text = ", ".join([row["model"], row["width"], row["height"], *str(row["params"]).split()])
        return _camera(text, where), "the table's"
    if "camera_id" in row:
        if row["camera_id"] not in listed:
            ids = ", ".join(listed) or "none: give cameras.txt"
            raise CaptureError(f"{where}: camera_id {row['camera_id']!r} is not in cameras.txt (there: {ids}).")
        return listed[row["camera_id"]], "those of cameras.txt"
    if len(listed) > 1:
        raise CaptureError(
            f"cameras.txt has {len(listed)} cameras; give a table with the columns image, camera_id that says which."
        )
    if listed:
        return next(iter(listed.values())), "the camera of cameras.txt"
    return (given, "the camera that was given") if given is not None else exif_camera(path)


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
    columns = ("image", *POSE_NAMES, "camera_id", *_CAMERA_COLUMNS)
    for name in rows.columns:
        if name not in columns:
            raise CaptureError(f"{path}: unknown column {name!r}. {nearest(name, columns)}")
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
            raise CaptureError(
                f"{path}, line {row['line']}: found the pose {', '.join(row[list(POSE_NAMES)])}; expected seven finite "
                "numbers, qw qx qy qz of length 1 and meters."
            )
    return rows


def _inverse(a_from_b: pycolmap.Rigid3d) -> Floats:
    """Return b_from_a, (4, 4)."""
    b_from_a = a_from_b.inverse()
    return make_pose(b_from_a.rotation.matrix(), b_from_a.translation)
