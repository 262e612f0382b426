"""Sessions that are put together from images of the user's own: what every import shares.

Images are linked or copied to `raw_data/import/images/`, under their names. The status of each image is a row of
`proc/import.csv`; `proc/import.json` has the unit of the poses: `m`, or null where it is not known. Images stay as they
are stored, and intrinsics belong to the stored pixels, whether or not EXIF asks to turn the image.
"""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pandas as pd
import pycolmap

from toolkit.capture import RAW_DATA, Trajectory, write_session
from toolkit.capture.cameras import camera_text
from toolkit.capture.devices import SPLITS
from toolkit.capture.exif import NO_FILE, ORIENTATION, read_header, read_number, time_taken
from toolkit.capture.names import EXPECTED_NAME, is_bad_name, note_linked_here
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.files import IMPORTED, write_folder
from toolkit.geometry import Floats, make_pose
from toolkit.manifest import nearest

SUBSESSION = "import"
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
PLACING = ("link", "copy")
IMPORT_RECORD = "proc/import.json"
NOT_INSIDE = "not a path inside the folder of images"
AXES = {"opencv": np.eye(4), "opengl": np.diag([1.0, -1.0, -1.0, 1.0])}
"""Conventions of camera axes, as named_from_cam: `opencv` has x right, y down, z forward, as the toolkit has them;
`opengl` x right, y up, z backward."""


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
class DraftImage:
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
        return f"{IMPORTED}{self.name}"

    @property
    def device(self) -> str:
        return self.rig or self.sensor


@dataclass
class Draft:
    """A session that is being put together."""

    session: Path
    folder: Path
    """Of the images."""
    placing: str
    images: list[DraftImage] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    """Of `proc/import.csv`."""
    poses: dict[str, Floats] = field(default_factory=dict)
    """world_from_device, (4, 4), by frame; a frame of queries may have none."""
    rigs: list[tuple[str, str, Floats]] = field(default_factory=list)
    """Rig, sensor, rig_from_sensor."""
    unit: str | None = "m"
    """Of the poses; None: not known."""
    notes: list[str] = field(default_factory=list)
    sensors: dict[str, str] = field(default_factory=dict)
    """Sensor by the text of its camera, of images that are in no rig."""

    def add(self, name: str, camera: pycolmap.Camera, world_from_cam: Floats | None) -> None:
        """Add an image of a camera in no rig; images with equal intrinsics are of one camera."""
        sensor = self.sensors.setdefault(camera_text(camera), f"{SUBSESSION}/cam_{len(self.sensors) + 1}")
        self.images.append(DraftImage(name, camera, sensor, name))
        if world_from_cam is not None:
            self.poses[name] = world_from_cam

    def write(self) -> ImportReport:
        """Leave out the images that cannot be used, and write the session of the others."""
        problems = {image.name: self._problem(image) for image in self.images}
        self.rows += [{"image": name, "status": problem} for name, problem in problems.items() if problem]
        self.images = [image for image in self.images if not problems[image.name]]
        if not self.images:
            why = f" First: {self.rows[0]['image']}: {self.rows[0]['status']}." if self.rows else ""
            if self.rows and self.rows[0]["status"] in (NO_FILE, NOT_INSIDE):
                why += " Names are paths in this folder: correct them in the list, or put the list beside the images."
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
            (part / IMPORT_RECORD).write_text(json.dumps({"unit": self.unit}) + "\n", encoding="utf-8")
            if self.placing == "link":
                note_linked_here(part)
        return ImportReport(self.session, table, self.notes)

    def _write_tables(self, session: Path, times: Mapping[str, int]) -> None:
        """Write the text files of the capture format, `times` being those of frames."""
        frame_of = {(times[image.frame], image.device): image.frame for image in self.images}
        keys = pd.DataFrame(sorted(frame_of), columns=["timestamp", "device_id"])
        trajectory = None
        if posed := [key for key in sorted(frame_of) if frame_of[key] in self.poses]:
            poses = np.stack([self.poses[frame_of[key]] for key in posed])
            trajectory = Trajectory.from_poses([time for time, _ in posed], [device for _, device in posed], poses)
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

    def _problem(self, image: DraftImage) -> str:
        """Set what an image's header says; return why the image cannot be used, or nothing."""
        name = PurePosixPath(image.name)
        if "," in image.name:
            return "the capture format cannot hold the comma in its name"
        if image.name.startswith("/") or ".." in name.parts:
            return NOT_INSIDE
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
        sides = (*size, camera.width, camera.height)
        if abs(size[0] * camera.height - size[1] * camera.width) <= max(sides) / 2:  # sides are rounded to pixels
            problem += f"; take images of the camera's size, or its intrinsics times {size[0] / camera.width:.6g}"
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


def start(capture: str | Path, device: str, split: str, folder: Path, placing: str) -> Draft:
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
    return Draft(session, folder, placing)


def list_images(folder: Path) -> pd.DataFrame:
    """Return the images in and below a folder, a table [image, line] without lines, in order of their names.

    A folder in it may be a link to another disk.

    Raises:
        CaptureError: there are none.
    """
    paths = sorted(path for path in _files_below(folder) if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise CaptureError(f"{folder}: no image in or below it. Expected {', '.join(IMAGE_SUFFIXES)}.")
    return pd.DataFrame({"image": [path.relative_to(folder).as_posix() for path in paths], "line": 0})


def _files_below(folder: Path) -> Iterator[Path]:
    """Yield the files in and below a folder, also in folders that it links to elsewhere, each of these once."""
    known = [folder.resolve()]
    for root, folders, names in os.walk(folder, followlinks=True):
        for link in [name for name in folders if Path(root, name).is_symlink()]:
            target = Path(root, link).resolve()
            if any(target.is_relative_to(one) or one.is_relative_to(target) for one in known):
                folders.remove(link)
            else:
                known.append(target)
        yield from (Path(root, name) for name in names)


def posed_camera(world_from_named: Floats, axes: str, unit_m: float) -> Floats:
    """Return world_from_cam, (4, 4), meters, of a pose whose camera axes are those of `AXES[axes]`.

    Args:
        unit_m: meters in the unit of the pose.
    """
    world_from_cam = world_from_named @ AXES[axes]
    return make_pose(world_from_cam[:3, :3], unit_m * world_from_cam[:3, 3])


def require_convention(axes: str, unit_m: float) -> None:
    """Refuse unknown camera axes, and a unit that is no length.

    Raises:
        ManifestError: naming what was found, and what is known.
    """
    if axes not in AXES:
        raise ManifestError(f"axes: unknown {axes!r}. {nearest(axes, AXES)}")
    if not (np.isfinite(unit_m) and unit_m > 0):
        raise ManifestError(f"unit: found {unit_m:g}, expected the meters in a unit of the poses, such as 0.01.")
