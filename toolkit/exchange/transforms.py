"""Import transforms.json, the format in which nerfstudio and instant-ngp store images, cameras and poses.

Each entry of `frames` may have these keys; keys it lacks are read from the top level of the file (not `file_path`):

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
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap

from toolkit.capture import parse_camera
from toolkit.capture.images import is_file, read_header
from toolkit.capture.tables import FARTHEST_M
from toolkit.errors import CaptureError, ImageError
from toolkit.exchange.drafts import IMAGE_SUFFIXES, every_nth, start
from toolkit.exchange.import_report import ImportReport
from toolkit.geometry import Floats

PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = "OPENCV_FISHEYE"
TOLERANCE = 1e-3  # largest deviation of R^T R from the identity, per element, that still counts as a rotation


def import_transforms(
    path: str | Path, capture: str | Path, device: str = "ios", split: str = "map", undo_applied: bool = False,
    own_split: bool = True, **options: Any,
) -> ImportReport:  # fmt: skip
    """Make a session, or a map and a query session, from a transforms.json. Images keep their `file_path` as names.

    Raise CaptureError for a malformed file (names frame and key), or a session that exists already or has no usable
    image; ManifestError as for `drafts.start`.

    Args:
        capture, device, split: as for `interchange.import_colmap`.
        undo_applied: return to the world before `applied_transform` and `applied_scale`, as of the COLMAP model that
            the file was made from.
        own_split: without `hold_out`, the images of a map that the file names in `test_filenames` and `val_filenames`
            become queries.
        options: see `drafts.Options`; `axes` are `opengl` by default.
    """
    path = Path(path)
    options.setdefault("axes", "opengl")
    draft = start(capture, device, split, path.parent, **options)
    content = _read(path)
    held = _named(content, "val_filenames", "test_filenames")
    own_split = own_split and bool(held) and split == "map" and not draft.hold_out
    frames: dict[str, _Frame] = {}
    applied = _applied(path, content)
    for number, entry in enumerate(content["frames"]):
        frame = _Frame(path, number, entry, content)
        if frame.name in frames:
            raise frame.error("file_path", f"that of frame {frames[frame.name].number} again", "one frame per image")
        frames[frame.name] = frame
    trained = _named(content, "train_filenames") or {frame.listed for frame in frames.values()} - held
    for name, frame in sorted(frames.items()):
        try:
            if own_split and frame.listed not in held | trained:
                raise CaptureError("it is in none of train_filenames, val_filenames and test_filenames")
            pose = frame.world_from_named()
            pose = _undone(pose, *applied) if undo_applied else pose
            draft.add_image(name, frame.camera(), pose, f"given by {path.name}")
        except (ImageError, CaptureError) as error:
            draft.add_image(name, str(error), None, "")
    draft.listed_in, draft.beside = path.name, True
    if own_split:
        draft.notes.append("map and queries: train_filenames, and val_filenames and test_filenames of the file")
    elif held and split == "map":
        draft.notes.append(f"val_filenames and test_filenames ({len(held)} images) of the file are not used")
    if found := sum(frame.from_elsewhere for frame in frames.values()):
        draft.notes.append(f"{found} images have paths of another machine: their ends are in this folder")
    turn, scale = applied
    if not (np.array_equal(turn, np.eye(4)) and scale == 1):
        world = "that of the file's input" if undo_applied else "the file's, turned from that of its input"
        other = "" if undo_applied else ". For the input's, as of a COLMAP model beside it, give --undo-applied"
        draft.notes.append(f"applied_transform, applied_scale {scale:g}: the world is {world}{other}")
    of_file = {name for name, frame in frames.items() if frame.listed in held}
    return draft.finish(of_file if own_split else every_nth(sorted(frames), draft.hold_out))


def _read(path: Path) -> dict[str, Any]:
    expected = "Expected a transforms.json of nerfstudio or instant-ngp: an object with a list `frames`."
    try:
        content = json.loads(path.read_bytes())  # also UTF-16, and with a byte-order mark
    except (OSError, ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: cannot be read ({error}). {expected}") from None
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        found = f"keys {', '.join(map(repr, content))[:100]}" if isinstance(content, dict) else repr(content)[:100]
        raise CaptureError(f"{path}: frames: found {found or 'nothing'}, no list of frames. {expected}")
    assert isinstance(content, dict)
    return content


def _named(content: Mapping[str, Any], *keys: str) -> set[str]:
    """Return the images in lists of the file, as they are written there."""
    lists = (content.get(key) for key in keys)
    return {name for names in lists if isinstance(names, list) for name in names if isinstance(name, str)}


def _applied(path: Path, content: Mapping[str, Any]) -> tuple[Floats, float]:
    """Return applied_transform (4, 4), a rigid motion, and applied_scale, above 0; the identity and 1 if they are
    missing.
    """
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


def _undone(pose: Floats, applied: Floats, scale: float) -> Floats:
    """Return a pose (4, 4) as it was before `applied`, and then `scale`, were applied to its world."""
    pose = pose.copy()
    pose[:3, 3] /= scale
    return np.asarray(np.linalg.inv(applied) @ pose)


class _Frame:
    """One image of the file. Its own values override those at the top level."""

    def __init__(self, path: Path, number: int, entry: Mapping[str, Any], shared: Mapping[str, Any]) -> None:
        self.path, self.number, self.values = path, number, {**shared, **entry}
        image = entry.get("file_path")
        if not isinstance(image, str) or not image.strip() or re.search("[\ud800-\udfff]", image):
            raise self.error("file_path", repr(image)[:80], "the path of an image, relative to the folder of this file")
        self.listed, self.from_elsewhere = image, False
        self.name = self._with_suffix(image.replace("\\", "/"))

    def _with_suffix(self, image: str) -> str:
        """Return an image's path relative to the folder of the file, with its extension added if it is missing."""
        is_absolute = re.match(r"/|[A-Za-z]:/", image) is not None
        name = os.path.normpath(os.path.relpath(image, self.path.parent) if image.startswith("/") else image)
        parts = PurePosixPath(image).parts
        if is_absolute and not is_file(self.path.parent / name):  # of another machine
            tails = ("/".join(parts[start:]) for start in range(1, len(parts)))
            tail = next((tail for tail in tails if is_file(self.path.parent / tail)), None)
            self.from_elsewhere, name = tail is not None, tail or name
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
        """Return the intrinsics.

        Raise ImageError if the file does not state the image size, and the image header cannot be read; CaptureError if
        the intrinsics are missing or malformed.
        """
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
