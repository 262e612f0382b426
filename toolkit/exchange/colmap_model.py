"""Read cameras, poses and rigs of a COLMAP model, .bin or .txt (https://colmap.github.io/format.html).

COLMAP's own readers end the name of an image at a space, take a pose for points if the line of points is missing, read
on beyond the end of a file that is cut short, and refuse a whole model for one sensor. Points are not read.
"""

import codecs
import mmap
import re
import struct
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from toolkit.capture.images import parse_camera
from toolkit.capture.tables import FARTHEST_M
from toolkit.errors import CaptureError
from toolkit.geometry import Floats, make_pose

NORM_TOLERANCE = 0.01
"""Deviation from 1 of the length of a quaternion that counts as rounding."""
_CAMERA = 0
"""Type of the sensors that are cameras, in .bin files."""
_LATER_CHANGED = int(pycolmap.CameraModelId.RAD_TAN_THIN_PRISM_FISHEYE)
"""Model that had 14 parameters in earlier versions of COLMAP."""


@dataclass(frozen=True)
class ModelImage:
    """An image of a model."""

    name: str
    camera_id: int
    cam_from_world: pycolmap.Rigid3d | str
    """The pose, or why there is none."""


@dataclass(frozen=True)
class ModelFrame:
    """What the sensors of a rig measured at one instant."""

    rig_id: int
    rig_from_world: pycolmap.Rigid3d | str
    """The pose, or why there is none."""
    image_ids: Sequence[int]


@dataclass
class ColmapModel:
    """The parts of a COLMAP model that make a session, by their ids."""

    cameras: dict[int, pycolmap.Camera | str] = field(default_factory=dict)
    """Each camera, or why it cannot be used."""
    images: dict[int, ModelImage] = field(default_factory=dict)
    rigs: dict[int, dict[int, pycolmap.Rigid3d | None]] = field(default_factory=dict)
    """sensor_from_rig by camera, of all rigs with several sensors; None for a camera that is not calibrated."""
    frames: dict[int, ModelFrame] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    """What a user should know of how the files were read."""


def read_model(folder: Path) -> ColmapModel:
    """Read a COLMAP model: cameras and images, and rigs and frames if it has them.

    Raises:
        CaptureError: there is no model in the folder, or several; or a file is damaged (names file and line or byte).
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder. Expected one with a COLMAP model.")
    suffixes = _formats(folder)
    if not suffixes:
        models = [path for path in sorted([*folder.glob("*/"), *folder.glob("sparse/*/")]) if _formats(path)]
        if len(models) != 1:
            raise _no_model(folder, models)
        model = read_model(models[0])
        model.notes.insert(0, f"the model is in {models[0]}")
        return model
    model, suffix = ColmapModel(), suffixes[0]
    if len(suffixes) > 1:
        model.notes.append("the model has .bin and .txt files: .bin is read. Move it elsewhere to read .txt")
    images = _binary_images if suffix == ".bin" else _text_images
    for name, read in (("cameras", _cameras), ("images", images), ("rigs", _rigs), ("frames", _frames)):
        path = folder / f"{name}{suffix}"
        if path.is_file():
            read(path, model)
    return model


def read_cameras(path: Path) -> dict[str, pycolmap.Camera | str]:
    """Return the cameras in cameras.txt or cameras.bin by id as text; each may be why it cannot be used.

    Raise CaptureError if the file is missing, damaged (names line or byte), or has no camera.
    """
    model = ColmapModel()
    try:
        _cameras(path, model)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error}). Expected COLMAP's cameras.txt.") from None
    if not model.cameras:
        raise CaptureError(f"{path}: no camera in it. Expected lines of `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...`.")
    return {str(number): camera for number, camera in model.cameras.items()}


def _formats(folder: Path) -> list[str]:
    """Return the suffixes of the formats in which a folder has cameras and images."""
    names = ("cameras", "images")
    return [suffix for suffix in (".bin", ".txt") if all((folder / f"{name}{suffix}").is_file() for name in names)]


def _no_model(folder: Path, models: Sequence[Path]) -> CaptureError:
    if models:
        sizes = []
        for path in models:
            with suppress(CaptureError):
                sizes.append(f"{path.relative_to(folder)} ({len(read_model(path).images)} images)")
        return CaptureError(f"{folder}: found the models {', '.join(sizes)}. Give the folder of one of them.")
    found = ", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "nothing"
    expected = "cameras and images, both as .bin or both as .txt"
    return CaptureError(f"{folder}: found {found}, expected a COLMAP model: {expected}.")


# What both formats share


def _pose(values: Sequence[float]) -> pycolmap.Rigid3d | str:
    return _poses([values])[0]


def _poses(rows: Sequence[Sequence[float]]) -> list[pycolmap.Rigid3d | str]:
    """Return the pose of each row qw qx qy qz tx ty tz, or why it is none. Quaternions are normalized."""
    table = np.array(rows, np.float64).reshape(-1, 7)
    finite = np.all(np.abs(table) < FARTHEST_M, axis=1)
    lengths = np.linalg.norm(np.where(finite[:, None], table[:, :4], 0.0), axis=1)
    valid = np.abs(lengths - 1) <= NORM_TOLERANCE
    poses: list[pycolmap.Rigid3d | str] = [f"its quaternion has the length {one:.4g}, expected 1" for one in lengths]
    for index in np.flatnonzero(~finite).tolist():
        poses[index] = f"its pose is not finite: {', '.join(f'{value:g}' for value in rows[index])}"
    table[valid, :4] /= np.where(np.abs(lengths - 1) > 1e-12, lengths, 1.0)[valid, None]
    for index in np.flatnonzero(valid).tolist():
        poses[index] = pycolmap.Rigid3d(pycolmap.Rotation3d(table[index, [1, 2, 3, 0]]), table[index, 4:])
    return poses


def inverse(a_from_b: pycolmap.Rigid3d) -> Floats:
    """Return b_from_a, (4, 4)."""
    b_from_a = a_from_b.inverse()
    return make_pose(b_from_a.rotation.matrix(), b_from_a.translation)


def _set_images(model: ColmapModel, rows: Mapping[int, tuple[str, int, Sequence[float]]]) -> None:
    """Set the images of a model: name, camera and pose by id. All poses are converted at once, which is faster."""
    poses = _poses([values for _, _, values in rows.values()])
    for (image_id, (name, camera_id, _)), pose in zip(rows.items(), poses, strict=True):
        model.images[image_id] = ModelImage(name, camera_id, pose)


def _camera(model_name: str, size: Sequence[Any], params: Sequence[Any], where: str = "") -> pycolmap.Camera | str:
    try:
        return parse_camera("camera", ", ".join([model_name, *map(str, size), *map(str, params)]))
    except ValueError as error:
        return f"its camera cannot be used: {where}{error}"


# Text


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Return number and text of the lines of a file that are no comments; empty ones, too."""
    number = 0
    try:
        # Names are those of files, which may have any bytes.
        with path.open(encoding=encoding_of(path), errors="surrogateescape") as lines:
            for number, line in enumerate(lines, start=1):
                if not line.startswith("#"):
                    yield number, line.strip(" \t\r\n")
    except UnicodeError as error:
        raise CaptureError(f"{path}, line {number + 1}: cannot be read as UTF-16 ({error}).") from None


def encoding_of(path: Path) -> str:
    """Return the encoding of a text file: UTF-16 by its mark or its zeros, else UTF-8."""
    with path.open("rb") as file:
        start = file.read(64)
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    zeros = start[0::2].count(0), start[1::2].count(0)
    return "utf-8-sig" if max(zeros) < len(start) / 4 else ("utf-16-be" if zeros[0] > zeros[1] else "utf-16-le")


def _new(path: Path, kind: str, number: int, known: Container[int]) -> int:
    """Return the id of a camera, image, rig or frame. Raise CaptureError if the file has it already."""
    if number in known:
        raise CaptureError(f"{path}: {kind} {number} is in it twice. Export the model again.")
    return number


def _malformed(path: Path, number: int, line: str, expected: str) -> CaptureError:
    return CaptureError(f"{path}, line {number}: found {line[:80]!r}, expected {expected}. Export the model again.")


def _cameras(path: Path, model: ColmapModel) -> None:
    if path.suffix == ".bin":
        _binary_cameras(path, model)
        return
    for number, line in _lines(path):
        if words := line.split():
            if len(words) < 4 or not words[0].isdecimal():
                raise _malformed(path, number, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]")
            model.cameras[_new(path, "camera", int(words[0]), model.cameras)] = _camera(
                words[1], words[2:4], words[4:], f"{path.name}, line {number}: "
            )


def _text_images(path: Path, model: ColmapModel) -> None:
    expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of points"
    points_follow, without_points, rows = False, 0, dict[int, tuple[str, int, Sequence[float]]]()
    for number, line in _lines(path):
        words = line.split(maxsplit=9)
        is_image = _is_image(words)
        if points_follow and not is_image and _is_points(line):
            points_follow = False
        elif is_image:
            without_points += points_follow
            try:
                values, image_id, camera_id = [float(word) for word in words[1:8]], int(words[0]), int(words[8])
            except ValueError:
                raise _malformed(path, number, line, expected) from None
            rows[_new(path, "image", image_id, rows)] = words[9], camera_id, values
            points_follow = True
        elif line:
            raise _malformed(path, number, line, expected)
    _set_images(model, rows)
    if without_points:
        model.notes.append(f"{path.name}: {without_points} images have no line of points, which is not needed")
    with path.open(encoding=encoding_of(path), errors="replace") as file:
        stated = re.search(r"# *Number of images: *(\d+)", file.read(2000))
    if stated and int(stated[1]) != len(model.images):
        model.notes.append(f"{path.name}: {len(model.images)} images, its header says {int(stated[1])}")


def _is_image(words: Sequence[str]) -> bool:
    """Tell whether a line, split at its first nine spaces, is about an image rather than about points.

    Lines of points are numbers, three for each. A name may have spaces, and may be a number if it has none.
    """
    if len(words) < 10 or not words[0].isdecimal() or not words[8].isdecimal():
        return False
    name = words[9].split()
    return len(name) == 1 or not (is_number(name[0]) and is_number(name[-1]))


def _is_points(line: str) -> bool:
    """Tell whether a line is X Y POINT3D_ID for each point, by its length and its first point: it may be long."""
    words = line.split(maxsplit=3)
    numbers = line.count(" ") + 1 if "  " not in line and "\t" not in line else len(line.split())
    return not words or (numbers % 3 == 0 and all(map(is_number, words[:2])) and words[2].lstrip("-").isdecimal())


def is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


class _Words:
    """A line of rigs.txt or frames.txt, read as the record of a binary file."""

    def __init__(self, path: Path, number: int, line: str, expected: str) -> None:
        self.words, self.error = iter(line.split()), _malformed(path, number, line, expected)

    def read(self, form: str) -> list[Any]:
        """Return values by `struct`'s format; an `i` is the type of a sensor."""
        codes = re.sub(r"(\d+)(.)", lambda found: int(found[1]) * found[2], form)
        try:
            words = [(code, next(self.words)) for code in codes]
            return [float(word) if code == "d" else word != "CAMERA" if code == "i" else int(word)
                    for code, word in words]  # fmt: skip
        except (ValueError, StopIteration):
            raise self.error from None


# Binary


class _Binary:
    """A binary file, read from its start; every read is checked against its size."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        with path.open("rb") as file:
            # Points fill most of the file and are skipped, so it is not read into memory.
            self.data: Any = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if path.stat().st_size else b""

    def read(self, form: str) -> tuple[Any, ...]:
        """Return values by `struct`'s format, little-endian without gaps."""
        self.skip(size := struct.calcsize("<" + form))
        return struct.unpack_from("<" + form, self.data, self.at - size)

    def skip(self, size: int) -> None:
        if self.at + size > len(self.data):
            raise CaptureError(f"{self.path}: cut short: found {len(self.data)} bytes. Export the model again.")
        self.at += size

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        name = self.data[self.at : end]
        self.skip(end - self.at + 1 if end >= 0 else len(self.data))
        return bytes(name).decode("utf-8", "surrogateescape")

    def __iter__(self) -> Iterator[int]:
        """Count the records; the file must end with the last."""
        (count,) = self.read("Q")
        yield from range(count)
        if self.at != len(self.data):
            found = f"{len(self.data)} bytes, expected {self.at} for {count} records"
            raise CaptureError(f"{self.path}: damaged: found {found}. Export the model again.")


def _binary_cameras(path: Path, model: ColmapModel) -> None:
    file = _Binary(path)
    known = {int(kind): name for name, kind in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    for _ in file:
        camera_id, kind, *size = file.read("IiQQ")
        if kind not in known:
            found = f"camera {camera_id} of the unknown model number {kind}"
            raise CaptureError(f"{path}: found {found}, expected one of {', '.join(known.values())}.")
        count = len(pycolmap.Camera.create_from_model_name(0, known[kind], 1.0, 1, 1).params)
        try:
            params = file.read(f"{count}d")
        except CaptureError as error:
            older = f"{error} Or an older COLMAP wrote other parameters of {known[kind]}: export the model as .txt."
            raise CaptureError(older if kind == _LATER_CHANGED else str(error)) from None
        camera = _camera(known[kind], size, params)
        model.cameras[_new(path, "camera", camera_id, model.cameras)] = camera


def _binary_images(path: Path, model: ColmapModel) -> None:
    file, rows = _Binary(path), dict[int, tuple[str, int, Sequence[float]]]()
    for _ in file:
        image_id, *values, camera_id = file.read("I7dI")
        rows[_new(path, "image", image_id, rows)] = file.name(), camera_id, values
        (points,) = file.read("Q")
        file.skip(24 * points)
    _set_images(model, rows)


# Rigs and frames, in both formats


def _records(path: Path, expected: str) -> "Iterator[_Binary | _Words]":
    """Yield the records of a file, to be read to their ends; `expected` is the content of a line of text."""
    if path.suffix == ".bin":
        file = _Binary(path)
        for _ in file:
            yield file
    for number, line in _lines(path) if path.suffix == ".txt" else ():
        if line:
            words = _Words(path, number, line, expected)
            yield words
            if next(words.words, None) is not None:
                raise words.error


def _rigs(path: Path, model: ColmapModel) -> None:
    expected = "RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID, then TYPE ID HAS_POSE [QW QX QY QZ TX TY TZ]"
    for record in _records(path, expected):
        rig_id, count = record.read("II")
        cameras = dict[int, pycolmap.Rigid3d | None]()
        for sensor in range(count):
            kind, sensor_id = record.read("iI")
            pose: pycolmap.Rigid3d | str | None = pycolmap.Rigid3d()
            if sensor:
                pose = _pose(record.read("7d")) if record.read("B")[0] else None
            if kind == _CAMERA:
                cameras[sensor_id] = None if isinstance(pose, str) else pose
        _new(path, "rig", rig_id, model.rigs)
        if count > 1:
            model.rigs[rig_id] = cameras


def _frames(path: Path, model: ColmapModel) -> None:
    expected = "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS, then TYPE SENSOR_ID DATA_ID"
    for record in _records(path, expected):
        frame_id, rig_id, *values, count = record.read("II7dI")
        data = [record.read("iIQ") for _ in range(count)]
        images = [image_id for kind, _, image_id in data if kind == _CAMERA]
        model.frames[_new(path, "frame", frame_id, model.frames)] = ModelFrame(rig_id, _pose(values), images)
