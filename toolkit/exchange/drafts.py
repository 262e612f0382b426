"""Assemble a session from a user's own images. All imports share this module.

Images are linked or copied to `raw_data/import/images/` under their names. `proc/import.csv` has a row with the status
of each image; `proc/import.json` has the table of the import (see `import_report`) and the unit of the poses: `m`, or
null if unknown. Images are not rotated: intrinsics belong to the stored pixels, whatever orientation EXIF states.
"""

import dataclasses
import json
import os
import re
import shutil
import time
import unicodedata
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
import PIL.Image
import pycolmap

from toolkit.capture import Session, Trajectory, parse_camera, write_session
from toolkit.capture.images import (
    CONVERT,
    HEIC_HOW,
    NO_FILE,
    ORIENTATION,
    camera_text,
    find_mask,
    invertible_share,
    is_file,
    read_header,
    read_number,
    stored_size,
    time_taken,
    zone_of,
)
from toolkit.capture.names import EXPECTED_NAME, SPLITS, has_long_part, is_bad_name, is_linked_here, note_linked_here
from toolkit.capture.session import IMPORT_RECORD
from toolkit.capture.tables import COLUMNS, read_depth, write_depth, write_table
from toolkit.capture.upright import look_down_z, up_of_cameras
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.exchange.georeference import alignment, gps_position, quarter_turns, read_positions
from toolkit.exchange.import_report import ImportReport, cameras_of, grouped
from toolkit.exchange.recordings import (
    FIX,
    NAMES,
    NO_ACCURACY_M,
    find_depths,
    read_fixes,
    read_times,
    read_track,
    to_us,
)
from toolkit.files import (
    IMPORTED,
    MASKS,
    RAW_DATA,
    own_name,
    read_json,
    recover_folder,
    write_csv,
    write_folder,
    write_text,
)
from toolkit.geometry import Floats, make_pose, scaled
from toolkit.manifest import require_known

SUBSESSION = "import"
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
READ_SUFFIXES = (*IMAGE_SUFFIXES, ".webp", ".tif", ".tiff", ".bmp", ".jp2")  # that the toolkit reads
HEIC_SUFFIXES = (".heic", ".heif")
# Formats that a reconstruction converts to PNG; HEIC needs the package pillow-heif.
CONVERTED_SUFFIXES = (*READ_SUFFIXES[len(IMAGE_SUFFIXES) :], *HEIC_SUFFIXES, ".gif", ".avif")
KNOWN_SUFFIXES = (*IMAGE_SUFFIXES, *CONVERTED_SUFFIXES, ".dng", ".cr2", ".nef", ".arw")  # of images, read or not
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
PLACING = ("link", "copy")
EXIF = "exif"  # given for a table of GPS fixes if the images have them
MIN_INVERTIBLE = 0.9  # smallest share of the image in which the distortion of a usable camera can be inverted
# Focal lengths outside of these multiples of the image's longer side are of no lens, but in another unit.
MIN_FOCAL, MAX_FOCAL = 0.01, 1000
NOT_INSIDE = "not a path inside the folder of images"
FROM_ELSEWHERE = "{} images have paths of another machine: their ends are in this folder"
AXES = {"opencv": np.eye(4), "opengl": np.diag([1.0, -1.0, -1.0, 1.0])}
"""named_from_cam (4, 4) for each named convention of camera axes; `opencv` is the toolkit's own."""
_AXES = {"opencv": "camera x right, y down, z forward", "opengl": "camera x right, y up, z backward"}
_MAX_FOR_UP = 300  # cameras that tell what is up


@dataclass(kw_only=True)
class Options:
    """What all imports take, besides their own input."""

    placing: str = "link"  # to the images, or `copy` them
    axes: str = "opencv"  # camera axes of the poses, see `AXES`
    unit_m: float | None = None  # meters per unit of the poses; None: unknown and recorded as such, not scaled
    hold_out: int = 0  # every `hold_out`-th frame of a map, in order of names, becomes a query with truth; 0: none
    match_names: bool = False  # take files whose names differ only in case, extension or separators
    masks: str | Path | None = None  # folder of masks, see `images.find_mask`; they are placed as the images are
    gps: bool = False  # move the world to x east, y north, z up, in meters, by GPS of three images: of `fixes`, or EXIF
    positions: str | Path | None = None  # the same by a CSV file, columns image, x, y, z: camera centers, meters
    timestamps: str | Path | None = None  # file of times and names, or `names`: `recordings.read_times`; None: EXIF
    timestamps_unit: str | None = None  # of these: `s`, `ms`, `us` or `ns`; None: told by times since 1970
    odometry: str | Path | None = None  # of queries: a list as of `recordings.read_track`, with `axes` and `unit_m`
    depth: str | Path | None = None  # folder, see `recordings.find_depths`: PNG, 16 bits, 0 and 65535 where unknown
    depth_unit_mm: float = 1.0  # millimeters per unit of these; TUM: 0.2
    depth_camera: str | None = None  # their intrinsics, `MODEL, width, height, ...`, if not those of the images
    fixes: str | Path | None = None  # GPS, which can limit the search: a table as of `recordings.read_fixes`, or `exif`
    replace: bool = False  # a session that exists, at once
    add: bool = False  # the images that a session lacks; what it has stays as it is
    record: dict[str, Any] = field(default_factory=dict)  # further content of `proc/import.json`


@dataclass
class DraftImage:
    """An image to be imported."""

    name: str
    camera: pycolmap.Camera
    sensor: str
    frame: str  # images with the same frame were taken at the same time
    rig: str | None = None
    origin: str = ""  # where its intrinsics are from
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


Prepared: TypeAlias = tuple[
    dict[str, int], dict[str, Path], Trajectory | None, list[tuple[Any, ...]], dict[Path, tuple[int, str, str]]
]
"""Times of frames, masks of images, odometry, rows of gps.txt, and rows of depths.txt by the file."""


@dataclass
class Draft(Options):
    """A session being assembled."""

    session: Path
    folder: Path  # folder of the images
    images: list[DraftImage] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)  # rows of `proc/import.csv`
    poses: dict[str, Floats] = field(default_factory=dict)  # world_from_device (4, 4) by frame; queries may have none
    rigs: list[tuple[str, str, Floats]] = field(default_factory=list)  # rig, sensor, rig_from_sensor (4, 4)
    convention: str = "world_from_cam"  # of the poses as they were given
    unit_hint: str = "If you know it, give --unit METERS (1 if a phone's tracking or a scanner gave the poses)"
    listed_in: str = ""  # what names the images; those of the folder that it does not name are counted; empty: none
    frames_are_names: bool = True  # of images, or of the panoramas that these are cut from
    beside: bool = False  # count only those in the same folders
    others: dict[str, list[str]] = field(default_factory=dict)  # files that are no row, by the reason
    notes: list[str] = field(default_factory=list)
    sources: dict[str, Path] = field(default_factory=dict)  # files that are not in `folder` under their names
    mask_files: dict[str, Path] = field(default_factory=dict)  # those that are not in `masks` under their names
    given_times: int = 0  # images whose time is not from EXIF
    times_from: str = ""
    before: int = 0  # images in the session that these are added to
    old_times: frozenset[int] = frozenset()  # and their timestamps
    sensors: dict[str, str] = field(default_factory=dict)  # id by `camera_text`, for images that are not in a rig
    started: float = field(default_factory=time.perf_counter)

    def add_image(
        self, name: str, camera: pycolmap.Camera | str, world_from_cam: Floats | str | None, origin: str,
        time_us: int | None = None,
    ) -> None:  # fmt: skip
        """Add an image without a rig; those with equal intrinsics, from `origin`, share a camera.

        Camera or pose may be why there is none, and the image is left out. Without `time_us`, its time is from EXIF.
        """
        if isinstance(camera, str) or isinstance(world_from_cam, str):
            self.rows.append({"image": name, "status": camera if isinstance(camera, str) else world_from_cam})
            return
        sensor = self.sensors.setdefault(camera_text(camera), f"{SUBSESSION}/cam_{len(self.sensors) + 1}")
        self.images.append(DraftImage(name, camera, sensor, name, origin=origin, time_us=time_us))
        if world_from_cam is not None:
            self.poses[name] = world_from_cam

    def finish(self, held: Collection[str] | None = None) -> ImportReport:
        """Write the session, and the queries held out of it: the frames `held`; None: every `hold_out`-th.

        Raise CaptureError if a session has no usable image, or exists, and ManifestError if `hold_out` is larger than
        the number of frames; none is then written.
        """
        self._take_times()
        self._place_world()
        self._compare_worlds()
        if held is None:
            frames = [image.frame for image in sorted(self.images, key=lambda image: image.name)]
            held = every_nth(list(dict.fromkeys(frames)), self.hold_out)
        listed = {_composed(name) for name in self._names()}
        drafts = [self, self._split(held)] if held else [self]
        for draft in drafts:
            draft.follow()
            draft.leave_out()
        depths = [draft.prepared[-1] for draft in drafts]  # all errors come before a session is written
        if self.depth is not None and not any(depths):
            expected = f"that of {self.images[0].name} under the same name, or with `depth` for `color`"
            raise CaptureError(f"{self.depth}: no depth map of an image. Expected {expected}.")
        if self.listed_in:
            listed |= {_composed(name) for draft in drafts for name in draft._names()}
            self.others[f"not in {self.listed_in}"] = self._others_than(listed)
        report, *queries = [draft.write() for draft in drafts]
        report.held_out = queries[0] if queries else None
        return report

    def _others_than(self, listed: Collection[str]) -> list[str]:
        """Return the images in the folder that are not listed: with `beside`, only in folders of listed ones."""
        names = list[str]()
        if self.beside:
            folders = sorted({PurePosixPath(name).parent for name in listed})
            files = (file for folder in folders for file in (self.folder / folder).glob("*"))
            names = [one.relative_to(self.folder).as_posix() for one in files if one.suffix.lower() in IMAGE_SUFFIXES]
        else:
            with suppress(CaptureError):  # there may be none
                names = list_images(self.folder)
        return [name for name in names if _composed(name) not in listed]

    def _names(self) -> list[str]:
        return [*(image.name for image in self.images), *(str(row["image"]) for row in self.rows)]

    def _take_times(self) -> None:
        """Give images the times of `timestamps`, and leave out those without one."""
        if self.timestamps is None:
            return
        name_of = {image.name: image.frame if self.frames_are_names else image.name for image in self.images}
        times = read_times(self.timestamps, sorted(set(name_of.values())), self.timestamps_unit)
        for image in self.images:
            image.time_us = times.get(name_of[image.name])
        why = "no time in its name" if self.timestamps == NAMES else f"no time in {self.timestamps}"
        self.rows += [{"image": image.name, "status": why} for image in self.images if image.time_us is None]
        self.images = [image for image in self.images if image.time_us is not None]

    def _place_world(self) -> None:
        """Convert poses to the toolkit's axes and meters, by the given unit, GPS in EXIF or known camera centers."""
        is_aligned = self.gps or self.positions is not None
        if is_aligned and self.unit_m not in (None, 1):
            raise ManifestError(f"unit: found {self.unit_m:g} together with GPS or positions, which tell the unit.")
        scale = 1.0 if self.unit_m is None else self.unit_m
        if self.axes != "opencv" or scale != 1:
            turn = AXES[self.axes]
            self.poses = {frame: scaled(pose @ turn, scale) for frame, pose in self.poses.items()}
            self.rigs = [(rig, sensor, scaled(turn @ pose @ turn, scale)) for rig, sensor, pose in self.rigs]
        if self.unit_m is not None and not is_aligned:
            self.record = {"meters": f"--unit {self.unit_m:g}"} | self.record
        self.record["unit"] = "m" if not self.poses or "meters" in self.record else None
        if is_aligned and self.poses:
            self._align()

    def _compare_worlds(self) -> None:
        """Note the other sessions of the capture whose world another tool changed otherwise."""
        if "up" in self.record:  # it was placed by GPS or positions
            self.record.pop("applied", None)
        for path in sorted(self.session.parent.glob(f"*/{IMPORT_RECORD}")):
            name, other = path.parents[1].name, read_json(path)
            differ = bool(self.poses and other.get("poses")) and other.get("applied") != self.record.get("applied")
            if differ and name != self.session.name:
                note = f"applied_transform of {name} is another or none, so its world is another"
                self.notes.append(f"{note}. Give --undo-applied to the import that has one")

    def _align(self) -> None:
        """Move the poses to the world of known camera centers, or of GPS: z is up, in meters, if they tell it."""
        poses = self._camera_poses([image for image in self.images if is_file(self.source(image.name))])
        turns = dict[str, int]()
        for name in poses:
            with suppress(ImageError):
                turns[name] = quarter_turns(read_header(self.source(name))[1])
        fixes = self._fixes() if self.positions is None else pd.DataFrame(columns=["image", *FIX])
        geo: dict[str, Any] = dict(zip(fixes["image"], fixes[list(FIX[:3])].to_numpy(float), strict=True))
        known = None if self.positions is None else read_positions(Path(self.positions))
        if not poses:
            return
        placed, new_from_old = alignment(poses, turns, geo, known)
        self.record["unit"] = placed.unit
        if placed.unit is None:
            self.notes += placed.notes or ["no photograph has GPS" if known is None else "no image has a position"]
            return
        rotation, scale = new_from_old.rotation.matrix(), new_from_old.scale
        self.poses = {name: make_pose(rotation @ one[:3, :3], new_from_old * one[:3, 3]) for name, one in
                      self.poses.items()}  # fmt: skip
        self.rigs = [(rig, sensor, make_pose(pose[:3, :3], scale * pose[:3, 3])) for rig, sensor, pose in self.rigs]
        self.record |= placed.record
        self.notes += placed.notes

    def _fixes(self) -> pd.DataFrame:
        """Return the GPS fixes of the given table, see `recordings.read_fixes`, else those in EXIF."""
        if self.fixes not in (None, EXIF):
            return read_fixes(Path(str(self.fixes)))
        found = ((image.name, gps_position(self.source(image.name))) for image in self.images)
        rows = [(name, "", *at, NO_ACCURACY_M) for name, at in found if at is not None]
        return pd.DataFrame(rows, columns=["image", "timestamp", *FIX])

    def _camera_poses(self, images: Sequence[DraftImage]) -> dict[str, Floats]:
        """Return world_from_cam (4, 4) of images that have one, by name."""
        of_sensor = {(rig, sensor): rig_from_sensor for rig, sensor, rig_from_sensor in self.rigs}
        posed = {image.name: (image, self.poses[image.frame]) for image in images if image.frame in self.poses}
        return {name: pose @ of_sensor[image.rig, image.sensor] if image.rig else pose
                for name, (image, pose) in posed.items()}  # fmt: skip

    def _split(self, held: Collection[str]) -> "Draft":
        """Move some frames to the draft of a query session."""
        capture, device = self.session.parents[1], self.session.name.removesuffix("_map")
        queries = dataclasses.replace(self, session=_session(capture, device, "query", self.replace or self.add))
        for draft, is_query in ((self, False), (queries, True)):
            draft.images = [image for image in draft.images if (image.frame in held) == is_query]
            draft.poses = {frame: pose for frame, pose in draft.poses.items() if (frame in held) == is_query}
            draft.rows = [row for row in draft.rows if (row["image"] in held) == is_query]
        queries.notes, queries.others = [], {}
        return queries

    def follow(self) -> None:
        """Fit the images to the session that they are added to: leave out what it has; give sensors and rigs new ids.

        Raise CaptureError if it has another unit, or all the images.
        """
        if not (self.add and self.session.is_dir()):
            return
        old = Session.open(self.session)
        known, before = set(map(own_name, old.image_names)), read_json(self.session / IMPORT_RECORD)
        unit = before.get("unit", "m")
        found = self.record.get("unit", unit) if self.poses else unit
        if found != unit:
            units = f"{unit or 'unknown'}, that of the new ones {found or 'unknown'}"
            raise CaptureError(f"{self.session}: the unit of its poses is {units}.")
        self.record = {key: before[key] for key in before if key == "meters"} | self.record | {"unit": unit}
        there = [image.name for image in self.images if {image.name, f"{image.name}.png"} & known]
        if there and len(there) == len(self.images):
            raise CaptureError(f"{self.session}: has all {len(there)} images already, so there is none to add.")
        self.images = [image for image in self.images if {image.name, f"{image.name}.png"}.isdisjoint(known)]
        self.others |= {"in the session already": there} if there else {}
        if not is_linked_here(self.session):  # links of others do not become the user's own
            self.placing = "copy"
        self.before, self.old_times = len(known), frozenset(old.images["timestamp"].tolist())
        of_rigs = set() if old.rigs is None else set(old.rigs["sensor_id"])
        cameras = set(old.sensors["sensor_id"][old.sensors["sensor_type"] == "camera"]) - of_rigs
        equal, suffix = {camera_text(old.camera(sensor)): sensor for sensor in cameras}, f"_{len(known)}"
        for image in self.images:
            renamed = f"{image.sensor}{suffix}"
            image.sensor = renamed if image.rig else equal.get(camera_text(image.camera), renamed)
            image.rig = None if image.rig is None else f"{image.rig}{suffix}"
        self.rigs = [(f"{rig}{suffix}", f"{sensor}{suffix}", pose) for rig, sensor, pose in self.rigs]

    def source(self, name: str) -> Path:
        return self.sources.get(name, self.folder / name)

    def _find_masks(self) -> dict[str, Path]:
        """Return masks by image, and note those that do not fit; raise CaptureError if a given folder has none."""
        folder = None if self.masks is None else Path(self.masks)
        found = {image.name: self.mask_files.get(image.name) or find_mask(self.source(image.name), folder)
                 for image in self.images}  # fmt: skip
        masks = {name: path for name, path in found.items() if path is not None}
        if folder is not None and not masks:
            first = self.images[0].name
            raise CaptureError(f"{folder}: no mask of {self.folder}. Expected that of {first} as {first}.png.")
        for image in (image for image in self.images if image.name in masks):
            size, expected = stored_size(masks[image.name]), (image.camera.width, image.camera.height)
            if size != expected:
                pixels = f"{size[0]} x {size[1]} pixels, expected {expected[0]} x {expected[1]}, as {image.name}"
                self.notes.append(f"{masks[image.name]}: {pixels}, which has no features until you correct its mask")
        return masks

    def leave_out(self) -> None:
        """Leave out the images that cannot be used; raise CaptureError if none is left."""
        hint = self._match_names()
        problems = {image.name: self._problem(image) for image in self.images}
        cameras = {image.sensor: image.camera for image in self.images}
        share = {sensor: invertible_share(camera) for sensor, camera in cameras.items()}
        for image in self.images:
            focal = image.camera.mean_focal_length() / max(image.camera.width, image.camera.height)
            if not MIN_FOCAL <= focal <= MAX_FOCAL and not problems[image.name]:
                problems[image.name] = f"its focal length is {focal:.2g} times the image's size: is it in pixels?"
            if share[image.sensor] < MIN_INVERTIBLE and not problems[image.name]:
                percent = f"{100 * (1 - share[image.sensor]):.0f} %"
                problems[image.name] = f"the distortion of its camera cannot be inverted in {percent} of the image"
        if partly := [sensor for sensor, part in share.items() if MIN_INVERTIBLE <= part < 1]:
            of = f"{', '.join(partly[:5])}{' and others' if len(partly) > 5 else ''} ({len(partly)} of {len(share)})"
            self.notes.append(f"distortion that cannot be inverted near the edge of the image: {of}")
        self.rows += [{"image": name, "status": problem} for name, problem in problems.items() if problem]
        self.images = [image for image in self.images if not problems[image.name]]
        for image in self.images:
            if image.name.lower().endswith(HEIC_SUFFIXES):  # OpenCV cannot read it
                self.sources[f"{image.name}.png"] = self.source(image.name)
                image.name = f"{image.name}.png"
        if not self.images:
            none = {"image": "none", "status": f"no image is listed in {self.listed_in or self.folder}"}
            name, status = (self.rows or [none])[0]["image"], (self.rows or [none])[0]["status"]
            where = hint or "names are paths in this folder: correct it or the list, or put the list beside the images"
            where = f" {where[0].upper()}{where[1:]}." if status in (NO_FILE, NOT_INSIDE) else ""
            why = f"First: {printable(name)}: {status.rstrip('.')}.{where}"
            raise CaptureError(f"{self.folder}: none of {len(self.rows)} images can be imported. {why}")

    def _match_names(self) -> str:
        """Give images whose file is missing the file that their name probably means. Return a note, or an empty text.

        Ends of absolute paths and equal names in another encoding (macOS decomposes letters) are taken; those that
        differ in case, extension or separators with `match_names`, else only noted.
        """
        ends = {image.name: end for image in self.images if (end := end_below(self.folder, image.name)) is not None}
        once = Counter([*ends.values(), *(image.name for image in self.images)])
        ends = {name: end for name, end in ends.items() if once[end] == 1}
        for image in self.images:
            image.name = ends.get(image.name, image.name)
        missing = [image for image in self.images if not is_file(self.source(image.name))]
        elsewhere = sum(not name.startswith("./") for name in ends)
        self.notes += [FROM_ELSEWHERE.format(elsewhere)] if elsewhere else []
        if not missing or not self.folder.is_dir():
            return ""
        wanted = {image.name for image in self.images}
        files = [name for name in walk_files(self.folder)[0] if name not in wanted]
        notes = []
        for key_of, taken, differ in (
            (_composed, True, "the encoding of letters"),
            (_loose, self.match_names, "case, extension or separators"),
        ):
            asked, there = Counter(key_of(image.name) for image in missing), Counter(map(key_of, files))
            only = {key_of(name): name for name in files if there[key_of(name)] == 1}
            keys = [(image, key_of(image.name)) for image in missing]
            pairs = [(image, only[key]) for image, key in keys if key in only and asked[key] == 1]
            if pairs:
                example = f"{printable(pairs[0][1])} for {printable(pairs[0][0].name)}"
                do = "" if taken else "; give --match-names to take them"
                notes.append(f"names of {len(pairs)} images differ from their files in {differ}: {example}{do}")
            for image, name in pairs if taken else ():
                image.name = name
            missing = [image for image in missing if not is_file(self.source(image.name))]
        self.notes += notes
        return "; ".join(notes)

    @cached_property
    def prepared(self) -> Prepared:
        times = self._choose_times()
        return times, self._find_masks(), self._odometry(times), self._fix_rows(times), self._find_depths(times)

    def write(self) -> ImportReport:
        if turned := sum(image.turned for image in self.images):
            self.notes.append(f"{turned} images have an EXIF orientation, which is ignored: pixels are used as stored")
        times, masks, odometry, fixes, depths = self.prepared
        columns = ["image", "status", "path", "timestamp", "sensor_id", "device_id", "camera"]
        left_out = [(str(row["image"]), str(row["status"])) for row in self.rows]
        left_out += [(name, reason) for reason, names in self.others.items() for name in names]
        for image in self.images:
            values = image.path, times[image.frame], image.sensor, image.device, camera_text(image.camera)
            self.rows.append(dict(zip(columns, (image.name, "imported", *values), strict=True)))
        self.rows = [row | {"image": printable(row["image"]), "status": printable(row["status"])} for row in self.rows]
        table = pd.DataFrame(self.rows, columns=columns).astype({"timestamp": "Int64"})
        posed = list(self._camera_poses(self.images[:: max(1, len(self.images) // _MAX_FOR_UP)]).values())
        axis = ", ".join(f"{value + 0.0:.2f}" for value in up_of_cameras(posed))
        how = "a guess: all look along -z" if look_down_z(np.reshape(posed, (-1, 4, 4))) else "as most cameras are held"
        by = f"z, {self.record['up']}" if "up" in self.record else f"({axis}), {how}"
        record = {
            "unit": self.record.get("unit", "m"), "source": str(self.folder), "used": len(self.images),
            "seen": len(self.images) + len(left_out),
            "left out": grouped((printable(name), printable(reason)) for name, reason in left_out),
            "cameras": cameras_of((image.sensor, image.camera, image.origin) for image in self.images),
            "poses": len({*self.poses} & {image.frame for image in self.images}),
            "convention": f"{self.convention}, {_AXES[self.axes]}",
            "unit from": self.record.get("meters", self.unit_hint), "timestamps": [len(times), self.times_from],
            "masks": [len(masks), "no features where they are black"] if masks else None, "notes": self.notes,
            "odometry": [len(odometry), f"poses, from {self.odometry}"] if odometry is not None else None,
            "GPS": [len(fixes), f"fixes, from {self.fixes}"] if fixes else None,
            "depth maps": [len(depths), f"from {self.depth}"] if depths else None,
        } | self.record | {"up": by if posed else None}  # fmt: skip
        with write_folder(self.session, self.replace or self.add, keep=self.add) as session:
            files = [(self.source(image.name), session / RAW_DATA / image.path) for image in self.images]
            files += [(path, session / MASKS / f"{IMPORTED}{name}.png") for name, path in masks.items()]
            files += [(source, session / RAW_DATA / path) for source, (_, _, path) in depths.items()]
            for source, target in files:
                target.parent.mkdir(parents=True, exist_ok=True)
                if source.name.lower().endswith(HEIC_SUFFIXES):
                    write_png(source, target)
                elif source in depths and self.depth_unit_mm != 1:
                    write_depth(target, self.depth_unit_mm * read_depth(source))
                elif self.placing == "copy":
                    shutil.copyfile(source, target)
                else:
                    target.symlink_to(os.path.abspath(source))  # noqa: PTH100 - must not resolve links in the source
            made = session / "new" if self.before else session
            self._write_tables(made)
            listed, list_file = table, session / "proc" / "import.csv"
            if self.before:
                _append(made, session)
                if list_file.exists():
                    listed = pd.concat([pd.read_csv(list_file, dtype=str, keep_default_na=False), table])
                    listed = listed.drop_duplicates("image", keep="last")
                old = read_json(session / IMPORT_RECORD)
                world = {key: (old or record).get(key) for key in ("up", "z is up")}
                record = old | record | {"before": self.before} | world
            write_csv(list_file, listed)
            if self.placing == "link" or (self.before and is_linked_here(self.session)):
                note_linked_here(session)
            record["seconds"] = round(time.perf_counter() - self.started, 3)
            write_text(session / IMPORT_RECORD, json.dumps(record, indent=1) + "\n")
        return ImportReport(self.session, table, record)

    def _odometry(self, times: Mapping[str, int]) -> Trajectory | None:
        """Return the given odometry; None for a map, or if none is given."""
        if self.odometry is None or self.session.name.endswith("_map"):
            return None
        times_file = None if self.timestamps in (None, NAMES) else Path(str(self.timestamps))
        track = read_track(Path(self.odometry), self.timestamps_unit, times_file, times.values())
        if track is None:
            expected = "lines of 8 (TUM, EuRoC), 12 (KITTI), 13 or 17 numbers (a time and a matrix)"
            raise CaptureError(f"{self.odometry}: is no list of poses. Expected {expected}.")
        # One device, also where each image has its own intrinsics, as those of phones.
        if len(set(times.values())) < len(times):
            do = "Import them one by one, with --device"
            raise CaptureError(f"{self.odometry}: is of one device, but several took images at the same time. {do}.")
        at = track.times_us
        if at is None:
            do = "Give them by --timestamps, one per line, or before each line"
            raise CaptureError(f"{self.odometry}: is of {len(track.poses)} {track.kind} without times. {do}.")
        if not any(at.min() <= time <= at.max() for time in times.values()):
            span = f"from {at.min()} to {at.max()} us, the images from {min(times.values())} to {max(times.values())}"
            raise CaptureError(f"{self.odometry}: no image was taken in its time: {span}. Give --timestamps.")
        self.notes += [track.note] if track.note else []
        poses = scaled(track.poses @ AXES[self.axes], self.unit_m or 1.0)
        return Trajectory.from_poses(at, [self.images[0].device] * len(at), poses)

    def _fix_rows(self, times: Mapping[str, int]) -> list[tuple[Any, ...]]:
        """Return the rows of gps.txt."""
        if self.fixes is None:
            return []
        fixes, of_image = self._fixes(), {**times, **{image.name: times[image.frame] for image in self.images}}
        timed = fixes[fixes["timestamp"] != ""]
        named = fixes[(fixes["timestamp"] == "") & fixes["image"].isin(of_image.keys())]
        at = to_us(timed["timestamp"], self.timestamps_unit, self.fixes, times.values()).tolist() if len(timed) else []
        at += named["image"].map(of_image).tolist()
        values = pd.concat([timed, named])[list(FIX)].to_numpy(float).tolist()
        rows = {time_us: (time_us, f"{SUBSESSION}/gps", *row) for time_us, row in zip(at, values, strict=True)}
        return [rows[time_us] for time_us in sorted(rows)]

    def _find_depths(self, times: Mapping[str, int]) -> dict[Path, tuple[int, str, str]]:
        """Return the rows of depths.txt by the file of the depth map."""
        if self.depth is None:
            return {}
        folder, images = Path(self.depth), {self.source(image.name).resolve() for image in self.images}
        files = [name for name in walk_files(folder)[0] if name.lower().endswith(".png")]
        files = [name for name in files if (folder / name).resolve() not in images]
        found = find_depths(folder, files, {image.name: times[image.frame] for image in self.images})
        return {
            found[one.name]: (times[one.frame], self._depth_sensor(one.sensor), f"{SUBSESSION}/depth/{one.name}.png")
            for one in self.images if one.name in found
        }  # fmt: skip

    def _depth_sensor(self, sensor: str) -> str:
        folder, _, name = sensor.rpartition("/")
        return sensor if self.depth_camera is None else f"{folder}/{name.replace('cam', 'depth')}"

    def _write_tables(self, session: Path) -> None:
        """Write the text files of the capture format."""
        times, _, odometry, fixes, depths = self.prepared
        frame_of = {(times[image.frame], image.device): image.frame for image in self.images}
        keys = pd.DataFrame(sorted(frame_of), columns=["timestamp", "device_id"])
        trajectory = None
        if posed := [key for key in sorted(frame_of) if frame_of[key] in self.poses]:
            poses = np.stack([self.poses[frame_of[key]] for key in posed])
            trajectory = Trajectory.from_poses([time for time, _ in posed], [device for _, device in posed], poses)
        cameras = {image.sensor: image.camera for image in self.images}
        rigs = {image.rig for image in self.images}
        is_map = self.session.name.endswith("_map")
        sensors = [(name, "", "camera", *camera_text(camera).split(", ")) for name, camera in sorted(cameras.items())]
        if self.depth_camera is not None:
            measured = camera_text(parse_camera("depth", self.depth_camera)).split(", ")
            sensors += [(self._depth_sensor(name), "", "depth", *measured) for name in sorted(cameras)]
        if fixes:
            sensors.append((f"{SUBSESSION}/gps", "", "gps"))
            write_table(session / "gps.txt", ", ".join(name for name, _ in COLUMNS["gps.txt"]),
                        (", ".join(map(str, row)) for row in fixes))  # fmt: skip
        write_session(
            session, sensors, [row for row in self.rigs if row[0] in rigs and row[1] in cameras] or None,
            trajectory if is_map else odometry,
            sorted((times[image.frame], image.sensor, image.path) for image in self.images),
            depths=sorted(depths.values()) or None,
            subsessions=[SUBSESSION],
            keyframes=None if is_map else {"pruned_subsampled": keys},  # the list localized by default
            ground_truth=None if is_map else trajectory,
        )  # fmt: skip

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
            problem += f"{'; it seems to be cropped' if is_crop else ''}; use images of the camera's size"
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
        # Clocks of devices differ, so equal times in EXIF mean nothing; several may take an image at a given time.
        device_of = {image.frame: image.device if self.given_times else "" for image in self.images}
        different = len({(time_us, device_of[frame]) for frame, time_us in taken.items()}) == len(frames)
        if different and self.old_times.isdisjoint(taken.values()):
            zone = ", in UTC, as its time zone changes" if in_zones else ""
            if zones and len(zones) < len(frames):
                zone = "; only some images have a time zone, which is ignored"
            self.times_from = "as given" if self.given_times else f"camera clock, from EXIF{zone}"
            return taken
        why = f"some images have {'no' if len(taken) < len(frames) else 'the same'} time"
        why += "" if self.given_times else " in EXIF"
        self.times_from = f"made up, one second apart in the order of the images ({why})"
        first = max(self.old_times, default=0) // 10**6 + 1
        return {frame: (number + first) * 10**6 for number, frame in enumerate(frames)}


def start(capture: str | Path, device: str, split: str, folder: Path, **options: Any) -> Draft:
    """Return the draft of a new session. Raise CaptureError if it exists; ManifestError for an unknown split, placing
    or axes, a length that is not positive, an invalid `hold_out` or device, or options that exclude each other."""
    may_exist = options.get("replace", False) or options.get("add", False)
    draft = Draft(_session(Path(capture), device, split, may_exist), folder, **options)
    if draft.add and (draft.replace or draft.gps):
        raise ManifestError(f"add: found together with {'replace' if draft.replace else 'gps'}. Give one of them.")
    require_known("images", draft.placing, PLACING)
    require_known("axes", draft.axes, AXES)
    if draft.unit_m is not None and not 0 < draft.unit_m < np.inf:
        raise ManifestError(f"unit: found {draft.unit_m:g}, expected the meters per unit of the poses, such as 0.01.")
    if not 0 < draft.depth_unit_mm < np.inf:
        raise ManifestError(f"depth-unit: found {draft.depth_unit_mm:g}, expected millimeters per unit, such as 0.2.")
    if draft.hold_out and (draft.hold_out < 2 or split != "map"):
        raise ManifestError(f"hold-out: found {draft.hold_out} for a {split}, expected 2 or more, for a map.")
    if draft.hold_out:
        _session(Path(capture), device, "query", may_exist)
    if draft.odometry is not None and split == "map" and not draft.hold_out:
        raise ManifestError(f"odometry: {draft.odometry} is given for a map. Give it for queries.")
    return draft


def _session(capture: Path, device: str, split: str, may_exist: bool) -> Path:
    """Return the folder of a session. Raise CaptureError if it must not exist, ManifestError if its name is invalid."""
    require_known("split", split, SPLITS)
    session = capture / "sessions" / f"{device}_{split}"
    if not re.fullmatch(r"[a-z0-9-]+", device) or has_long_part(session.name, "session"):  # as `extra_devices`
        expected = "lower-case letters, digits and '-', such as drone; a session's name has 40 bytes at most"
        raise ManifestError.at("device", repr(device), expected)
    recover_folder(session)
    if session.exists() and not may_exist:
        do = "Give --replace to make it again, --add to add what it lacks, or another device or capture."
        raise CaptureError(f"{session} exists already. {do}")
    return session


def _append(made: Path, session: Path) -> None:
    """Append the new lines of a folder's tables to those of a session, and remove the folder."""
    for path in sorted(made.rglob("*.txt")):
        target = session / path.relative_to(made)
        old = target.read_text(encoding="utf-8").splitlines() if target.exists() else []
        known = set(old)
        added = [line for line in path.read_text(encoding="utf-8").splitlines() if line not in known]
        write_table(target, None, [*old, *(line for line in added if not (old and line.startswith("#")))])
    shutil.rmtree(made)


def every_nth(frames: Sequence[str], number: int) -> set[str]:
    """Return every `number`-th of the frames; none if it is 0. Raise ManifestError if there are fewer."""
    if number > len(frames):
        raise ManifestError(f"hold-out: found {number}, but there are {len(frames)} frames. Give a smaller number.")
    return set(frames[number - 1 :: number]) if number else set()


def list_images(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES, draft: Draft | None = None) -> list[str]:
    """Return the images in and below a folder, sorted by path, see `walk_files`; raise CaptureError if there is none.

    Masks are skipped, and names that are not Unicode. The draft gets the files that are left out, by the reason.
    """
    files, captures = walk_files(folder)
    others = dict[str, list[str]]()
    names = sorted((name for name in files if name.lower().endswith(suffixes) and not _is_mask(name)), key=Path)
    if broken := [name for name in names if printable(name) != name]:
        names, others["its name is not UTF-8: rename it"] = [name for name in names if name not in broken], broken
    for name in files:
        if (suffix := name[name.rfind(".") :].lower()) in KNOWN_SUFFIXES and suffix not in suffixes:
            how = HEIC_HOW if suffix in HEIC_SUFFIXES else CONVERT
            others.setdefault(f"{suffix} is not read: {how}", []).append(name)
    note = [f"captures in the folder of images are skipped: {', '.join(captures[:3])}"] if captures else []
    if draft is not None:
        draft.others |= others
        draft.notes += note
    if not names:
        said = [*(f"{len(found)} files: {reason}" for reason, found in others.items()), *note]
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


def write_png(source: Path, target: Path) -> None:
    """Write an image in another format as PNG with its EXIF tags. Raise `images.HEADER_ERRORS` if it is none."""
    with PIL.Image.open(source) as image:
        pixels, exif = image.convert("RGB"), image.getexif()  # in this order: Pillow turns a TIFF upright
    pixels.save(target, "PNG", exif=exif)


def printable(name: str) -> str:
    """Return a name in which bytes that are not UTF-8 are replaced."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def end_below(folder: Path, name: str) -> str | None:
    """Return the longest end of an absolute path, or what follows `./`, that is a file in a folder; None if none is."""
    path = name.replace("\\", "/") if re.match(r"[A-Za-z]:", name) else name
    parts = PurePosixPath(path).parts
    first = 1 if re.match(r"/|[A-Za-z]:/", path) else 0 if path.startswith("./") else len(parts)
    return next((end for at in range(first, len(parts)) if is_file(folder / (end := "/".join(parts[at:])))), None)


def _composed(name: str) -> str:
    """Return a name with composed letters (NFC); one that is not UTF-8 is read as Windows writes it."""
    if printable(name) != name:
        name = name.encode("utf-8", "surrogateescape").decode("cp1252", "replace")
    return unicodedata.normalize("NFC", name)


def _loose(name: str) -> str:
    name = _composed(name).replace("\\", "/").casefold()
    stem, dot, suffix = name.rpartition(".")
    return stem if f"{dot}{suffix}" in KNOWN_SUFFIXES else name


def _is_mask(name: str) -> bool:
    path = PurePosixPath(name)
    return MASKS in path.parts[:-1] and path.suffix == ".png" and path.stem.lower().endswith(IMAGE_SUFFIXES)
