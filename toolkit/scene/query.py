"""A query from any images with cameras, and checks of what a person gives."""

import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.capture.cameras import camera_text, parse_camera
from toolkit.capture.images import exif_camera, exif_key, find_mask, read_header, stored_size
from toolkit.errors import CameraError, ImageError
from toolkit.pose.base import Query, View

_MAX_DEVIATION = 1e-3
"""Largest deviation of R @ R.T from the identity for a rotation R; rounding to float32 or in files stays below."""
FOCAL_PRIOR = 1.2  # focal length of a camera that nothing is known of, in multiples of the longer side
Image = Any
"""A file (str, Path), or pixels as `pixels_from` takes them."""


def query_from(
    image: Image | Sequence[Image],
    camera: pycolmap.Camera | Sequence[pycolmap.Camera],
    rig_from_cams: NDArray[np.float64] | None = None,
    turns: Sequence[int] | None = None,
) -> Query:
    """Return a query of one image, or of those that the cameras of a rig took at one instant.

    Args:
        image: a file, which may have a mask, see `find_mask`; or pixels as `pixels_from` takes them; for a rig, a
            sequence of C images.
        camera: intrinsics, with the size of the image; for a rig, a sequence of C cameras.
        rig_from_cams: (C, 4, 4), for a rig.
        turns: for each image, the counter-clockwise quarter turns that bring gravity down; None: all are upright.
            Only learned embedders and networks use them.

    Raises:
        ImageError: an image is neither a file nor pixels.
        CameraError: an invalid camera, pose or turn. It is an ImageError.
    """
    images = list(image) if _are_several(image) else [image]
    cameras: list[Any] = list(camera) if isinstance(camera, list | tuple) else [camera]
    for intrinsics in cameras:
        _check_camera(intrinsics)
    poses = np.eye(4)[None] if rig_from_cams is None else _poses(rig_from_cams)
    quarter_turns = [0] * len(cameras) if turns is None else _turns(turns)
    if not 0 < len(images) == len(cameras) == len(poses) == len(quarter_turns):
        raise CameraError(
            f"Found {len(images)} images, {len(cameras)} cameras, {len(poses)} rig_from_cams and "
            f"{len(quarter_turns)} turns: expected the same number of each, and at least one."
        )
    pixels = [Path(one) if isinstance(one, str | Path) else pixels_from(one) for one in images]
    numbered = enumerate(zip(pixels, cameras, quarter_turns, strict=True), start=1)
    masks = [find_mask(one) if isinstance(one, Path) else None for one in pixels]
    views = [View(f"image {k}", image, one, False, turn, masks[k - 1]) for k, (image, one, turn) in numbered]
    return Query(views, poses)


def pixels_from(image: Any) -> NDArray[np.uint8]:
    """Return the pixels, (H, W) or (H, W, 3) RGB uint8, of an image in one of the forms that other libraries use.

    Args:
        image: an array or tensor (H, W), (H, W, 1), (H, W, 3), (1, H, W) or (3, H, W), a nest of lists, or a Pillow
            image. uint8 and other integers from 0 to 255; uint16 from 0 to 65535; floats from 0 to 1 or, if one is
            larger, to 255; bool. uint16 up to 255 counts as uint8.

    Raises:
        ImageError: anything else.
    """
    expected = "Expected a file or the pixels of an image: (H, W) or (H, W, 3) RGB, uint8."
    if hasattr(image, "getbands"):  # a Pillow image
        image = image if image.mode in ("1", "L", "RGB", "F") or image.mode.startswith("I") else image.convert("RGB")
    try:
        pixels = np.asarray(image)
    except (ValueError, TypeError, RuntimeError) as error:  # lists of different lengths; a tensor on a GPU
        raise ImageError(f"Found a {type(image).__name__} that is not an array ({error}). {expected}") from None
    found = f"a {type(image).__name__} of pixels {pixels.shape} {pixels.dtype}"
    if pixels.ndim == 3 and pixels.shape[0] in (1, 3) and pixels.shape[2] not in (1, 3):
        pixels = np.moveaxis(pixels, 0, 2)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    shape_fits = pixels.ndim in (2, 3) and pixels.shape[2:] in ((), (3,)) and pixels.size
    if not shape_fits or pixels.dtype.kind not in "buif":
        raise ImageError(f"Found {found}. {expected}")
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == bool:
        return pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype == np.uint16 and pixels.max() > 255:  # up to 255, a library has put 8 bits into 16
        return (pixels >> 8).astype(np.uint8)  # as a 16-bit file is decoded
    low, high = pixels.min(), pixels.max()
    if not (low >= 0 and high <= 255):
        raise ImageError(f"Found {found} from {low:g} to {high:g}; expected 0 to 1, or 0 to 255.")
    scale = 255 if pixels.dtype.kind == "f" and high <= 1 else 1
    return np.round(pixels * scale).astype(np.uint8)


def guessed_camera(image: Image, known: Sequence[pycolmap.Camera]) -> tuple[pycolmap.Camera, str]:
    """Return a camera of an image, and where its focal length is from: EXIF, the only known one of its size, or none.

    Raises:
        ImageError: the image cannot be read.
    """
    is_file = isinstance(image, str | Path)
    if is_file:
        try:
            return exif_camera(Path(image))
        except ImageError:  # no focal length, or no image, which the next line says
            width, height = stored_size(image)
    else:
        height, width = pixels_from(image).shape[:2]
    alike = {camera_text(camera): camera for camera in known if (camera.width, camera.height) == (width, height)}
    if len(alike) == 1:
        return next(iter(alike.values())), "that of the map's camera"
    params = [FOCAL_PRIOR * max(width, height), width / 2, height / 2]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)
    return camera, f"a guess, {FOCAL_PRIOR:g} times the longer side"


def camera_key(image: Image, camera: pycolmap.Camera) -> tuple[Any, ...]:
    """Return what images of one camera have in common: size, and what EXIF says of the camera."""
    exif = read_header(Path(image))[1] if isinstance(image, str | Path) else {}
    return camera.width, camera.height, *exif_key(exif)


def with_focal(camera: pycolmap.Camera, focal_px: float) -> pycolmap.Camera:
    """Return a camera with another focal length, in x, pixels."""
    params = np.array(camera.params)
    params[list(camera.focal_length_idxs())] *= focal_px / camera.mean_focal_length()
    return pycolmap.Camera(model=camera.model.name, width=camera.width, height=camera.height, params=params.tolist())


def _are_several(image: Any) -> bool:
    """Tell whether this is a sequence of images rather than one image, which may be nested lists of numbers."""
    return isinstance(image, list | tuple) and not (image and isinstance(image[0], list | tuple | int | float))


def _check_camera(camera: Any) -> None:
    """Raise CameraError if an object is not a camera with valid intrinsics."""
    if not isinstance(camera, pycolmap.Camera):
        raise CameraError(
            f"camera: found {camera!r}, a {type(camera).__name__}; expected a pycolmap.Camera. To make one: "
            "parse_camera('camera', 'PINHOLE, 640, 480, 500, 500, 320, 240') of toolkit.capture."
        )
    try:
        parse_camera("camera", camera_text(camera))
    except ValueError as error:
        raise CameraError(f"camera: {error}") from None


def _poses(rig_from_cams: Any) -> NDArray[np.float64]:
    """Return the poses of a rig, (C, 4, 4), after checking that their rotations neither scale nor mirror."""
    try:
        poses = np.asarray(rig_from_cams, np.float64)
    except (ValueError, TypeError):
        raise CameraError(f"rig_from_cams: found {rig_from_cams!r}, expected (C, 4, 4) numbers.") from None
    if poses.shape[-2:] != (4, 4) or not np.isfinite(poses).all():
        raise CameraError(f"rig_from_cams: found {poses.shape}, expected (C, 4, 4) finite numbers, a pose per camera.")
    poses = poses.reshape(-1, 4, 4)
    rotations = poses[:, :3, :3]
    deviations = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(axis=(1, 2))
    deviations = np.maximum(deviations, np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1))
    for number in np.flatnonzero((deviations > _MAX_DEVIATION) | (np.linalg.det(rotations) < 0))[:1].tolist():
        raise CameraError(
            f"rig_from_cams: found no pose for image {number + 1}: {poses[number].tolist()}. Expected a rotation, "
            "which neither scales nor mirrors, a translation, and 0, 0, 0, 1 in the last row."
        )
    return poses


def _turns(turns: Any) -> list[int]:
    try:
        return [operator.index(turn) for turn in turns]
    except TypeError:
        raise CameraError(f"turns: found {turns!r}, expected whole numbers of quarter turns, one per image.") from None
