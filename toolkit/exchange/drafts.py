"""Assemble a session from a user's own images. All imports share this module.

Images are linked or copied to `raw_data/import/images/` under their names. `proc/import.csv` has a row with the status
of each image; `proc/import.json` has the unit of the poses: `m`, or null if unknown. Images are not rotated: intrinsics
belong to the stored pixels, whatever orientation EXIF states.
"""

import json
import os
import re
import shutil
import unicodedata
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pandas as pd
import PIL.Image
import pycolmap

from toolkit.capture import RAW_DATA, Trajectory, write_session
from toolkit.capture.cameras import camera_text, invertible_share
from toolkit.capture.devices import SPLITS
from toolkit.capture.folder import IMPORT_RECORD
from toolkit.capture.images import (
    NO_FILE,
    ORIENTATION,
    find_mask,
    is_file,
    read_header,
    read_number,
    stored_size,
    time_taken,
    zone_of,
)
from toolkit.capture.names import EXPECTED_NAME, has_long_part, is_bad_name, note_linked_here
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.files import IMPORTED, MASKS, write_folder
from toolkit.geometry import Floats, make_pose
from toolkit.manifest import nearest

SUBSESSION = "import"
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
DECODED_SUFFIXES = (".webp", ".tif", ".tiff", ".bmp", ".jp2")
"""Other formats that are read."""
READ_SUFFIXES = (*IMAGE_SUFFIXES, *DECODED_SUFFIXES)
HEIC_SUFFIXES = (".heic", ".heif")
PHOTOGRAPHS = (*IMAGE_SUFFIXES, *DECODED_SUFFIXES, *HEIC_SUFFIXES, ".gif", ".avif", ".dng", ".cr2", ".nef", ".arw")
"""Formats of photographs, read or not."""
CONVERT = "convert them to JPEG or PNG"
_HOW = dict.fromkeys(HEIC_SUFFIXES, f"pip install 'visual-localization[heic]', or {CONVERT}")
PLACING = ("link", "copy")
MIN_INVERTIBLE = 0.9
"""Smallest share of the image in which the distortion of a usable camera can be inverted."""
NOT_INSIDE = "not a path inside the folder of images"
AXES = {"opencv": np.eye(4), "opengl": np.diag([1.0, -1.0, -1.0, 1.0])}
"""named_from_cam (4, 4) for each named convention of camera axes: `opencv`, the toolkit's own, has x right, y down, z
forward; `opengl` has x right, y up, z backward."""


@dataclass
class ImportReport:
    """The result of an import."""

    session: Path
    images: pd.DataFrame  # image, status (`imported` or why not), path, timestamp, sensor_id, device_id, camera
    notes: list[str] = field(default_factory=list)  # guesses, made-up values, and anything the user should look at
    held_out: "ImportReport | None" = None  # the queries that were made of a part of the images

    def text(self) -> str:
        """Return the report as text."""
        imported = self.images["status"] == "imported"
        cameras = self.images[imported]["sensor_id"].nunique()
        lines = [f"{self.session}: {imported.sum()} of {len(self.images)} images, {cameras} cameras", *self.notes]
        left_out = self.images[~imported]
        lines += [f"left out: {row.image}: {row.status}" for row in left_out.head(10).itertuples()]
        if len(left_out) > 10:
            lines.append(f"... and {len(left_out) - 10} more, see proc/import.csv")
        lines += [self.held_out.text()] if self.held_out is not None else []
        return "\n".join(lines)


@dataclass
class DraftImage:
    """An image to be imported."""

    name: str
    camera: pycolmap.Camera
    sensor: str
    frame: str  # images with the same frame were taken at the same time
    rig: str | None = None
    time_us: int | None = None
    zone_us: int | None = None  # offset of the camera's clock from UTC
    turned: bool = False  # whether the EXIF orientation says to rotate the image

    @property
    def path(self) -> str:
        """Path relative to raw_data."""
        return f"{IMPORTED}{self.name}"

    @property
    def device(self) -> str:
        return self.rig or self.sensor


@dataclass
class Draft:
    """A session being assembled."""

    session: Path
    folder: Path  # folder of the images
    placing: str
    images: list[DraftImage] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)  # rows of `proc/import.csv`
    poses: dict[str, Floats] = field(default_factory=dict)  # world_from_device (4, 4) by frame; queries may have none
    rigs: list[tuple[str, str, Floats]] = field(default_factory=list)  # rig, sensor, rig_from_sensor (4, 4)
    unit: str | None = "m"  # unit of the poses; None: unknown
    notes: list[str] = field(default_factory=list)
    sources: dict[str, Path] = field(default_factory=dict)  # files that are not in `folder` under their names
    given_times: int = 0  # images whose time is not from EXIF
    masks: Path | None = None  # folder of masks as COLMAP names them; None: see `images.find_mask`
    mask_files: dict[str, Path] = field(default_factory=dict)  # those that are not in `masks` under their names
    record: dict[str, Any] = field(default_factory=dict)  # further content of `proc/import.json`
    match_names: bool = False  # take files whose names differ only in case, extension or separators
    sensors: dict[str, str] = field(default_factory=dict)  # id by `camera_text`, for images that are not in a rig

    def add(
        self, name: str, camera: pycolmap.Camera, world_from_cam: Floats | None, time_us: int | None = None
    ) -> None:
        """Add an image that is not in a rig. Images with equal intrinsics share a camera.

        Args:
            time_us: when it was taken, microseconds; None: from EXIF.
        """
        sensor = self.sensors.setdefault(camera_text(camera), f"{SUBSESSION}/cam_{len(self.sensors) + 1}")
        self.images.append(DraftImage(name, camera, sensor, name, time_us=time_us))
        if world_from_cam is not None:
            self.poses[name] = world_from_cam

    def convert(self, axes: str, unit_m: float | None) -> None:
        """Change poses from camera axes of `AXES` and a unit of `unit_m` meters; None: unknown, which is noted."""
        if axes != "opencv" or unit_m not in (None, 1):
            turn = AXES[axes]
            self.poses = {frame: posed_camera(pose, axes, unit_m or 1.0) for frame, pose in self.poses.items()}
            self.rigs = [
                (rig, sensor, posed_camera(turn @ pose, axes, unit_m or 1.0)) for rig, sensor, pose in self.rigs
            ]
        self.note_unit(unit_m)

    def note_unit(self, unit_m: float | None) -> None:
        """Record and note that the unit of the poses is not known, if `unit_m` is None."""
        if unit_m is None:
            self.unit = None
            self.notes.append(
                "unit of the poses: not known. If you know its length in meters, give --unit METERS (1 if a phone's "
                "tracking or a scanner gave the poses). Lengths are otherwise relative to the depth of the scene"
            )

    def hold_out(self, number: int) -> "Draft | None":
        """Move every `number`-th frame, in order of names, to the draft of a query session; None if `number` is 0.

        Raises:
            CaptureError: the query session exists.
            ManifestError: a number that is not 0 or between 2 and the number of frames.
        """
        require_hold_out(number, self.session.name.rpartition("_")[2], len({image.frame for image in self.images}))
        if not number:
            return None
        queries = start(
            self.session.parents[1], self.session.name.removesuffix("_map"), "query", self.folder, self.placing,
            self.masks,
        )  # fmt: skip
        frames = list(dict.fromkeys(image.frame for image in sorted(self.images, key=lambda image: image.name)))
        held = set(frames[number - 1 :: number])
        queries.images = [image for image in self.images if image.frame in held]
        self.images = [image for image in self.images if image.frame not in held]
        queries.poses = {frame: pose for frame, pose in self.poses.items() if frame in held}
        self.poses = {frame: pose for frame, pose in self.poses.items() if frame not in held}
        queries.rigs, queries.unit, queries.sources = self.rigs, self.unit, self.sources
        queries.record, queries.mask_files, queries.match_names = self.record, self.mask_files, self.match_names
        return queries

    def source(self, name: str) -> Path:
        """Return the file of an image."""
        return self.sources.get(name, self.folder / name)

    def _find_masks(self) -> dict[str, Path]:
        """Return the masks of the images by name, and note how many images have one.

        Raises:
            CaptureError: the user gave a folder of masks, but no image has one there.
        """
        found = {image.name: self.mask_files.get(image.name) or find_mask(self.source(image.name), self.masks)
                 for image in self.images}  # fmt: skip
        masks = {name: path for name, path in found.items() if path is not None}
        first = self.images[0].name
        if self.masks is not None and not masks:
            raise CaptureError(f"{self.masks}: no mask of {self.folder}. Expected that of {first} as {first}.png.")
        if masks:
            self.notes.append(f"masks of {len(masks)} of {len(found)} images; no features where they are black")
        for image in self.images:
            size = stored_size(masks[image.name]) if image.name in masks else (image.camera.width, image.camera.height)
            if size != (image.camera.width, image.camera.height):
                self.notes.append(
                    f"{masks[image.name]}: {size[0]} x {size[1]} pixels, expected {image.camera.width} x "
                    f"{image.camera.height}, as {image.name}, which has no features until you correct its mask"
                )
        return masks

    def leave_out(self) -> None:
        """Leave out the images that cannot be used; raise CaptureError if none is left."""
        hint = self._match_names()
        problems = {image.name: self._problem(image) for image in self.images}
        cameras = {image.sensor: image.camera for image in self.images}
        share = {sensor: invertible_share(camera) for sensor, camera in cameras.items()}
        for image in self.images:
            if share[image.sensor] < MIN_INVERTIBLE and not problems[image.name]:
                percent = f"{100 * (1 - share[image.sensor]):.0f} %"
                problems[image.name] = f"the distortion of its camera cannot be inverted in {percent} of the image"
        partly = [sensor for sensor, part in share.items() if MIN_INVERTIBLE <= part < 1]
        if partly:
            of = f"{', '.join(partly[:5])}{' and others' if len(partly) > 5 else ''} ({len(partly)} of {len(share)})"
            self.notes.append(f"distortion that cannot be inverted near the edge of the image: {of}")
        self.rows += [{"image": name, "status": problem} for name, problem in problems.items() if problem]
        self.images = [image for image in self.images if not problems[image.name]]
        for image in self.images:
            if image.name.lower().endswith(HEIC_SUFFIXES):  # OpenCV cannot read it
                self.sources[f"{image.name}.png"] = self.source(image.name)
                image.name = f"{image.name}.png"
        if not self.images:
            name, status = (self.rows[0]["image"], self.rows[0]["status"]) if self.rows else ("", "there is none")
            where = " Names are paths in this folder: correct them in the list, or put the list beside the images."
            where = f" {hint[0].upper()}{hint[1:]}." if hint else where
            name = printable(name)
            why = f"First: {name}: {status.rstrip('.')}.{where if status in (NO_FILE, NOT_INSIDE) else ''}"
            raise CaptureError(f"{self.folder}: none of {len(self.rows)} images can be imported. {why}")

    def _match_names(self) -> str:
        """Give images whose file is missing the file that their name probably means. Return a note, or an empty text.

        Equal names in another encoding (macOS decomposes letters) are taken; those that differ in case, extension
        or separators with `match_names`, else only noted.
        """
        missing = [image for image in self.images if not is_file(self.source(image.name))]
        if not missing or not self.folder.is_dir():
            return ""
        wanted = {image.name for image in self.images}
        files = [name for name in walk_files(self.folder)[0] if name not in wanted]
        notes = []
        for key_of, taken, differ in (
            (_composed, True, "the encoding of letters"),
            (_loose, self.match_names, "case, extension or separators"),
        ):
            keys = Counter(key_of(image.name) for image in missing)
            found: dict[str, list[str]] = {}
            for name in files:
                found.setdefault(key_of(name), []).append(name)
            pairs = [(image, found.get(key_of(image.name), [])) for image in missing]
            pairs = [(image, names) for image, names in pairs if len(names) == 1 == keys[key_of(image.name)]]
            if pairs:
                example = f"{printable(pairs[0][1][0])} for {printable(pairs[0][0].name)}"
                do = "" if taken else "; give --match-names to take them"
                notes.append(f"names of {len(pairs)} images differ from their files in {differ}: {example}{do}")
            for image, names in pairs if taken else ():
                image.name = names[0]
            missing = [image for image in missing if image not in [one for one, _ in pairs]] if taken else missing
        self.notes += notes
        return "; ".join(notes)

    def write(self) -> ImportReport:
        """Write the session; call `leave_out` before."""
        if turned := sum(image.turned for image in self.images):
            self.notes.append(f"{turned} images have an EXIF orientation, which is ignored: pixels are used as stored")
        times, masks = self._choose_times(), self._find_masks()
        columns = ["image", "status", "path", "timestamp", "sensor_id", "device_id", "camera"]
        for image in self.images:
            values = image.path, times[image.frame], image.sensor, image.device, camera_text(image.camera)
            self.rows.append(dict(zip(columns, (image.name, "imported", *values), strict=True)))
        self.rows = [row | {"image": printable(row["image"]), "status": printable(row["status"])} for row in self.rows]
        table = pd.DataFrame(self.rows, columns=columns).astype({"timestamp": "Int64"})
        with write_folder(self.session) as session:
            files = [(self.source(image.name), session / RAW_DATA / image.path) for image in self.images]
            files += [(path, session / MASKS / f"{IMPORTED}{name}.png") for name, path in masks.items()]
            for source, target in files:
                target.parent.mkdir(parents=True, exist_ok=True)
                if source.name.lower().endswith(HEIC_SUFFIXES):
                    with PIL.Image.open(source) as picture:
                        picture.convert("RGB").save(target, exif=picture.getexif())
                elif self.placing == "copy":
                    shutil.copyfile(source, target)
                else:
                    target.symlink_to(os.path.abspath(source))  # noqa: PTH100 - must not resolve links in the source
            self._write_tables(session, times)
            table.to_csv(session / "proc" / "import.csv", index=False)
            (session / IMPORT_RECORD).write_text(json.dumps({"unit": self.unit} | self.record) + "\n", encoding="utf-8")
            if self.placing == "link":
                note_linked_here(session)
        return ImportReport(self.session, table, self.notes)

    def _write_tables(self, session: Path, times: Mapping[str, int]) -> None:
        """Write the text files of the capture format; `times` are the timestamps of the frames, microseconds."""
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
            keyframes=None if is_map else {"pruned_subsampled": keys},  # the list localized by default
            ground_truth=None if is_map else trajectory,
        )

    def _problem(self, image: DraftImage) -> str:
        """Return why an image cannot be used, or an empty text. Set its time and orientation from its EXIF header."""
        name = PurePosixPath(image.name)
        if "," in image.name:
            return "the capture format cannot hold the comma in its name"
        if image.name.startswith("/") or ".." in name.parts:
            return NOT_INSIDE
        if printable(image.name) != image.name:
            return "its name is not UTF-8: rename it"
        if is_bad_name(image.name):
            return f"the capture format cannot hold this name, expected {EXPECTED_NAME}"
        if image.name.lower().endswith(HEIC_SUFFIXES) and not heic_is_read():
            return f"HEIC is not read: {_HOW[HEIC_SUFFIXES[0]]}"
        try:
            size, exif = read_header(self.source(image.name))
        except ImageError as error:
            return str(error)
        orientation, camera = read_number(exif, ORIENTATION), image.camera
        # Other values than 1 to 8 mean nothing (COLMAP #4322: some cameras write 0).
        image.turned = 1 < orientation <= 8
        self.given_times += image.time_us is not None
        if image.time_us is None:
            image.time_us, image.zone_us = time_taken(exif), zone_of(exif)
        (width, height), sides = size, (*size, camera.width, camera.height)
        if size == (camera.width, camera.height):
            return ""
        problem = f"the image is stored as {width} x {height} pixels, its camera has {camera.width} x {camera.height}"
        if abs(width * camera.height - height * camera.width) <= max(sides) / 2:  # equal ratio up to rounding
            factor = width / camera.width
            is_crop = 0.9 < factor < 1.1  # nobody resizes by so little; undistortion and stabilization crop
            problem += "; it seems to be cropped" if is_crop else ""
            problem += "; use images of the camera's size"
            problem += "" if is_crop else f", or multiply its intrinsics by {factor:.6g}"
        if 4 < orientation <= 8 and size == (camera.height, camera.width):
            problem += "; the camera fits the rotated image: rotate the pixels and remove the EXIF orientation"
        return problem

    def _choose_times(self) -> dict[str, int]:
        """Return the timestamp of each frame, microseconds: from EXIF if all frames have different times there."""
        frames = list(dict.fromkeys(image.frame for image in self.images))
        taken = {image.frame: image.time_us for image in reversed(self.images) if image.time_us is not None}
        zones = {image.frame: image.zone_us for image in reversed(self.images) if image.zone_us is not None}
        in_zones = len(zones) == len(frames) and len(set(zones.values())) > 1  # a journey, or daylight saving ended
        if in_zones:
            taken = {frame: time - zones[frame] for frame, time in taken.items()}
        if len(taken) == len(frames) == len(set(taken.values())):
            zone = ", in UTC, as its time zone changes" if in_zones else ""
            if zones and len(zones) < len(frames):
                zone = "; only some images have a time zone, which is ignored"
            how = "as given" if self.given_times else f"camera clock, from EXIF{zone}"
            self.notes.append(f"timestamps: {how}")
            return taken
        why = f"some images have {'no' if len(taken) < len(frames) else 'the same'} time in EXIF"
        self.notes.append(f"timestamps: made up, one second apart in the order of the images ({why})")
        return {frame: (number + 1) * 10**6 for number, frame in enumerate(frames)}


def start(
    capture: str | Path, device: str, split: str, folder: Path, placing: str, masks: str | Path | None = None
) -> Draft:
    """Return the draft of a new session. Raise CaptureError if it exists, ManifestError for an invalid argument."""
    if split not in SPLITS:
        raise ManifestError(f"split: unknown {split!r}. {nearest(split, SPLITS)}")
    if placing not in PLACING:
        raise ManifestError(f"images: unknown choice {placing!r}. {nearest(placing, PLACING)}")
    if not re.fullmatch(r"[a-z0-9-]+", device):  # the rule for `extra_devices` in a manifest
        raise ManifestError(f"device: found {device!r}, expected lower-case letters, digits and '-', such as drone.")
    session = Path(capture) / "sessions" / f"{device}_{split}"
    if has_long_part(session.name, "session"):
        raise ManifestError(f"device: found {device!r}, expected fewer letters: a session's name has 40 bytes at most.")
    if session.exists():
        raise CaptureError(f"{session} exists already. Import into another capture or device, or remove it first.")
    return Draft(session, folder, placing, masks=None if masks is None else Path(masks))


def write_drafts(*drafts: Draft) -> list[ImportReport]:
    """Write sessions without the images that cannot be used.

    Raises:
        CaptureError: a session has no image left; none is written.
    """
    for draft in drafts:
        draft.leave_out()
    return [draft.write() for draft in drafts]


def write_with_queries(draft: Draft, hold_out: int) -> ImportReport:
    """Write a session and, with `hold_out`, the queries of it; see `Draft.hold_out` and `write_drafts`."""
    queries = draft.hold_out(hold_out)
    report, *others = write_drafts(draft, *([queries] if queries else []))
    report.held_out = others[0] if others else None
    return report


def require_hold_out(number: int, split: str, count: int) -> None:
    """Raise ManifestError unless `number` is 0, or 2 to `count` images for a map."""
    if number and (number < 2 or split != "map"):
        raise ManifestError(f"hold-out: found {number} for a {split}, expected 2 or more, for a map.")
    if number > count:
        raise ManifestError(f"hold-out: found {number}, but there are {count} frames. Give a smaller number.")


def list_images(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES, notes: list[str] | None = None) -> list[str]:
    """Return the images in and below a folder, sorted by path. Links to folders elsewhere are followed, each once.

    Sessions that an import has made are skipped, masks (see `images.find_mask`), and names that are not Unicode.

    Args:
        notes: gets a line for each kind of files that are left out.

    Raises:
        CaptureError: there is no image.
    """
    files, captures = walk_files(folder)
    names = sorted((name for name in files if name.lower().endswith(suffixes) and not _is_mask(name)), key=Path)
    broken = [name for name in names if printable(name) != name]
    names = [name for name in names if name not in set(broken)] if broken else names
    suffix_of = (name[name.rfind(".") :].lower() for name in files)
    others = Counter(suffix for suffix in suffix_of if suffix in PHOTOGRAPHS and suffix not in suffixes)
    said = [f"{count} files {suffix} are not read: {_HOW.get(suffix, CONVERT)}" for suffix, count in others.items()]
    if broken:
        said.append(f"{len(broken)} images have a name that is not UTF-8: rename them; first: {printable(broken[0])}")
    if captures:
        said.append(f"captures in the folder of images are skipped: {', '.join(captures[:3])}")
    if notes is not None:
        notes += said
    if not names:
        why = "".join(f" {line[0].upper()}{line[1:]}." for line in said)
        raise CaptureError(f"{folder}: no image in or below it. Expected {', '.join(suffixes)}.{why}")
    return names


def walk_files(folder: Path) -> tuple[list[str], list[str]]:
    """Return the files in and below a folder, and the captures there that an import has made, which are skipped.

    Links to folders elsewhere are followed, each once.
    """
    visited, names, captures = [folder.resolve()], list[str](), list[str]()
    for root, folders, files in os.walk(folder, followlinks=True):
        if "sessions" in folders and any(Path(root).glob(f"sessions/*/{IMPORT_RECORD}")):
            captures.append(Path(root).relative_to(folder).as_posix())
            folders[:] = [name for name in folders if name not in ("sessions", "reconstruction")]
        for link in [name for name in folders if Path(root, name).is_symlink()]:
            target = Path(root, link).resolve()
            if any(target.is_relative_to(path) or path.is_relative_to(target) for path in visited):
                folders.remove(link)
            else:
                visited.append(target)
        inside = Path(root).relative_to(folder).as_posix()
        names += files if inside == "." else [f"{inside}/{name}" for name in files]
    return names, captures


def heic_is_read() -> bool:
    """Tell whether Pillow reads HEIC, with the optional package pillow-heif."""
    try:
        import pillow_heif
    except ImportError:
        return False
    pillow_heif.register_heif_opener()
    return True


def printable(name: str) -> str:
    """Return a name in which bytes that are not UTF-8 are replaced."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def _composed(name: str) -> str:
    """Return a name with composed letters (NFC); one that is not UTF-8 is read as Windows writes it."""
    if printable(name) != name:
        name = name.encode("utf-8", "surrogateescape").decode("cp1252", "replace")
    return unicodedata.normalize("NFC", name)


def _loose(name: str) -> str:
    name = _composed(name).replace("\\", "/").casefold()
    stem, dot, suffix = name.rpartition(".")
    return stem if f"{dot}{suffix}" in (*IMAGE_SUFFIXES, *PHOTOGRAPHS) else name




def _is_mask(name: str) -> bool:
    path = PurePosixPath(name)
    return MASKS in path.parts[:-1] and path.suffix == ".png" and path.stem.lower().endswith(IMAGE_SUFFIXES)


def posed_camera(world_from_named: Floats, axes: str, unit_m: float) -> Floats:
    """Return world_from_cam (4, 4) in meters and with the toolkit's camera axes.

    Args:
        world_from_named: pose (4, 4) of a camera with the axes `AXES[axes]`.
        unit_m: length of the pose's unit, meters.
    """
    world_from_cam = world_from_named @ AXES[axes]
    return make_pose(world_from_cam[:3, :3], unit_m * world_from_cam[:3, 3])


def require_convention(axes: str, unit_m: float) -> None:
    """Raise ManifestError for unknown camera axes or a unit that is not a positive length."""
    if axes not in AXES:
        raise ManifestError(f"axes: unknown {axes!r}. {nearest(axes, AXES)}")
    if not (np.isfinite(unit_m) and unit_m > 0):
        raise ManifestError(f"unit: found {unit_m:g}, expected the meters per unit of the poses, such as 0.01.")
