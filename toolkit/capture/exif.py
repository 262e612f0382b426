"""Metadata of an image file: its stored size, the time it was taken, and a guess of its intrinsics."""

import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from toolkit.capture.images import HEADER_ERRORS, open_lazily
from toolkit.errors import ImageError

# Numbers of the EXIF tags, and the length in millimeters of each value of FocalPlaneResolutionUnit.
ORIENTATION, _EXIF, _TIME, _SUBSECOND = 0x0112, 0x8769, 0x9003, 0x9291
_FOCAL_MM, _FOCAL_35MM, _WIDTH = 0x920A, 0xA405, 0xA002
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
_UNIT_MM = {0.0: 25.4, 2.0: 25.4, 3.0: 10.0, 4.0: 1.0}  # 0, a missing tag, means inches
NO_FILE = "no such file"
_FILM_DIAGONAL_MM = float(np.hypot(36, 24))


def is_file(path: Path) -> bool:
    """Tell whether a file exists; False for a name that is too long for a file."""
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises for too long a name


def read_header(path: Path) -> tuple[tuple[int, int], dict[int, Any]]:
    """Return the stored width and height of an image, and its EXIF tags by number.

    Raises:
        ImageError: the file is missing, not an image, or has more than `images.MOST_PIXELS` pixels.
    """
    if not is_file(path):
        raise ImageError(NO_FILE)
    try:
        with open(path, "rb") as stream:
            image = open_lazily(stream)
            exif = image.getexif()
            return image.size, {**exif, **exif.get_ifd(_EXIF)}
    except HEADER_ERRORS as error:
        raise ImageError(f"cannot be read as an image ({error})") from None


def time_taken(exif: Mapping[int, Any]) -> int | None:
    """Return the time on the camera's clock, microseconds since 1970 in an unknown time zone; None without a tag."""
    try:
        taken = datetime.strptime(str(exif[_TIME]), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except (KeyError, ValueError):
        return None
    digits = str(exif.get(_SUBSECOND, "")).strip()
    return int(taken.timestamp()) * 10**6 + (int(f"{digits:0<6}"[:6]) if digits.isdecimal() else 0)


def read_number(exif: Mapping[int, Any], tag: int) -> float:
    """Return the value of a tag as a number; 0 if it is missing, not a number or not finite."""
    try:
        number = float(exif.get(tag, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if np.isfinite(number) else 0.0


def exif_camera(path: Path) -> tuple[pycolmap.Camera, str]:
    """Guess the intrinsics of an image from its EXIF tags: no distortion, principal point in the image center.

    FocalLengthIn35mmFilm refers to the diagonal of 36 mm x 24 mm film (CIPA DC-008). Without that tag, the focal length
    is FocalLength times FocalPlaneXResolution, scaled if the image was resized later.

    Returns:
        A SIMPLE_PINHOLE camera, and a phrase that names the tags used.

    Raises:
        ImageError: the image cannot be read, or has no focal length in EXIF.
    """
    (width, height), exif = read_header(path)
    focal_mm, film_mm = read_number(exif, _FOCAL_MM), read_number(exif, _FOCAL_35MM)
    plane_x, unit_mm = read_number(exif, _PLANE_X), _UNIT_MM.get(read_number(exif, _PLANE_UNIT))
    if film_mm > 0:
        focal_px, how = film_mm * np.hypot(width, height) / _FILM_DIAGONAL_MM, "FocalLengthIn35mmFilm"
    elif focal_mm > 0 and plane_x > 0 and unit_mm:
        stored = read_number(exif, _WIDTH)
        focal_px = focal_mm * plane_x / unit_mm * (width / stored if stored > 0 else 1.0)
        how = "FocalLength and FocalPlaneXResolution"
    else:
        such_as = f"'SIMPLE_PINHOLE,{width},{height},FOCAL_PX,{width / 2:g},{height / 2:g}'"
        options = f"--camera 'MODEL,W,H,...', such as {such_as}, with --cameras, or in the table"
        raise ImageError(f"no focal length in EXIF: give the intrinsics with {options}")
    params = [float(focal_px), width / 2, height / 2]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)
    return camera, f"a guess from EXIF ({how}), without distortion"
