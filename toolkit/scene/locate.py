"""Localize a single picture, or those of a rig, in the open map of a run."""

import operator
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.capture.cameras import camera_text, parse_camera
from toolkit.capture.images import pixels_of, stored_size
from toolkit.capture.upright import turn_image
from toolkit.errors import ArtifactError, CameraError, ImageError
from toolkit.features.features import KINDS, LocalFeatures, extract_turned
from toolkit.features.matching import LocalMethod
from toolkit.features.sift import SiftExtractor
from toolkit.pose.base import PoseEstimate, Prior, Query, RoughPose, View
from toolkit.scene.map import Map
from toolkit.threads import fixed_sums

_MAX_DEVIATION = 1e-3
"""Largest deviation of R @ R.T from the identity for a rotation R; rounding to float32 or in files stays below."""
Picture = Any
"""A file (str, Path), or pixels as `pixels_from` takes them."""


@fixed_sums
def localize_image(
    place: Map,
    image: Picture | Sequence[Picture],
    camera: pycolmap.Camera | Sequence[pycolmap.Camera],
    rig_from_cams: NDArray[np.float64] | None = None,
    turns: Sequence[int] | None = None,
    near: RoughPose | None = None,
) -> PoseEstimate:
    """Localize one picture, or those that the cameras of a rig took at one instant, as the run of the map would.

    Args:
        place: an open map, see `Map.open`; it is not changed.
        image: a file, or pixels as `pixels_from` takes them; for a rig, a sequence of C pictures.
        camera: intrinsics, with the size of the picture; for a rig, a sequence of C cameras.
        rig_from_cams: (C, 4, 4), for a rig.
        turns: for each picture, the counter-clockwise quarter turns that bring gravity down; None: all are upright.
            Only learned embedders and networks use them.
        near: a rough pose, if it is known. References are then map images that look the same way from nearby, and
            features are also matched near the projections of the map points at this pose.

    Returns:
        The estimate. Its `world_from_rig` (4, 4) is world_from_cam for a single picture, and None on failure, for which
        `status` gives the reason.

    Raises:
        ImageError: a picture is invalid or cannot be read.
        CameraError: the size of a picture is not the camera's; an invalid camera, pose or turn. It is an ImageError.
        ArtifactError: files of the run are missing.
    """
    if not isinstance(place, Map):
        raise ArtifactError(f"Found {type(place).__name__} for a map, expected what `Map.open` returns.")
    pictures = list(image) if _are_several(image) else [image]
    cameras: list[Any] = list(camera) if isinstance(camera, list | tuple) else [camera]
    for intrinsics in cameras:
        _check_camera(intrinsics)
    poses = np.eye(4)[None] if rig_from_cams is None else _poses(rig_from_cams)
    quarter_turns = [0] * len(cameras) if turns is None else _turns(turns)
    if not 0 < len(pictures) == len(cameras) == len(poses) == len(quarter_turns):
        raise CameraError(
            f"Found {len(pictures)} pictures, {len(cameras)} cameras, {len(poses)} rig_from_cams and "
            f"{len(quarter_turns)} turns: expected the same number of each, and at least one."
        )
    pixels = [_Pixels(picture, intrinsics) for picture, intrinsics in zip(pictures, cameras, strict=True)]
    views = [
        View(f"picture {number}", picture.image, intrinsics, in_map=False, turns=turn)
        for number, (picture, intrinsics, turn) in enumerate(zip(pixels, cameras, quarter_turns, strict=True), start=1)
    ]
    features = _extract(place, pixels, quarter_turns)
    described = _embed(place, pixels, quarter_turns, features)
    rough_poses = [] if near is None else [replace(near, world_from_rig=pose) for pose in near.world_from_rig @ poses]
    readers = [picture.read for picture in pixels]
    references = place.retrieve(described, readers, cameras, quarter_turns, rough_poses)
    query = Query(views, poses, features)
    if near is None:
        return place.judged(place.localizer.localize(query, references))
    images = np.unique(np.concatenate([retrieved.images for retrieved in references]))
    position_std = near.position_std_m / place.length  # the depth that it is compared with is in map lengths
    prior = Prior.about(near.world_from_rig, images, near.rotation_std_deg, position_std, "near")
    return place.judged(place.localizer.localize(query, references, None, [prior]))


def _extract(map_: Map, pictures: Sequence["_Pixels"], turns: Sequence[int]) -> list[list[LocalFeatures]]:
    """Return the local features of each picture, one entry per kind of the map; empty if the method uses none."""
    if map_.settings.method == "feed_forward" or not map_.kinds:
        return []

    def extract(picture: _Pixels, turn: int, kind: LocalMethod) -> LocalFeatures:
        pixels = picture.read(kind.extractor.color)
        (features,) = extract_turned(kind.extractor, [pixels], [turn if KINDS[kind.name].upright else 0])
        return features

    return [[extract(*item, kind) for kind in map_.kinds] for item in zip(pictures, turns, strict=True)]


def _embed(
    map_: Map, pictures: Sequence["_Pixels"], turns: Sequence[int], features: Sequence[list[LocalFeatures]]
) -> list[NDArray[np.float32]]:
    """Return for each embedder of the map the global descriptors (C, D) of C pictures with their local features."""
    described = []
    for embedder in map_.embedders:
        if embedder.inputs == "features":
            sift = SiftExtractor()
            settings = [kind.extractor.settings for kind in map_.kinds]
            if features and sift.settings in settings:  # the embedder can use the features of the localizer
                inputs = [kinds[settings.index(sift.settings)] for kinds in features]
            else:
                inputs = sift.extract([picture.read(color=False) for picture in pictures])
        else:
            turned, side = map_.shows_upright(embedder), embedder.least_side
            inputs = [
                embedder.prepare(turn_image(picture.read(True, side), turn if turned else 0))
                for picture, turn in zip(pictures, turns, strict=True)
            ]
        described.append(embedder.embed(inputs))
    return described


def pixels_from(image: Any) -> NDArray[np.uint8]:
    """Return the pixels, (H, W) or (H, W, 3) RGB uint8, of an image in one of the forms that other libraries use.

    Args:
        image: an array or tensor (H, W), (H, W, 1), (H, W, 3), (1, H, W) or (3, H, W), a nest of lists, or a Pillow
            image. uint8 and other integers from 0 to 255; uint16 from 0 to 65535; floats from 0 to 1 or, if one is
            larger, to 255; bool. uint16 up to 255 counts as uint8.

    Raises:
        ImageError: anything else.
    """
    expected = "Expected a file or the pixels of a picture: (H, W) or (H, W, 3) RGB, uint8."
    if image is None or isinstance(image, bytes | dict | set):
        raise ImageError(f"Found {image if image is None else type(image).__name__} for a picture. {expected}")
    if hasattr(image, "getbands"):  # a Pillow image
        image = image if image.mode in ("1", "L", "RGB", "F") or image.mode.startswith("I") else image.convert("RGB")
    try:
        pixels = np.asarray(image)
    except (ValueError, TypeError, RuntimeError) as error:  # lists of different lengths; a tensor on a GPU
        raise ImageError(f"Found a {type(image).__name__} that is not an array ({error}). {expected}") from None
    found = f"{pixels.shape} {pixels.dtype}"
    if pixels.ndim == 3 and pixels.shape[0] in (1, 3) and pixels.shape[2] not in (1, 3):
        pixels = np.moveaxis(pixels, 0, 2)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    shape_fits = pixels.ndim in (2, 3) and pixels.shape[2:] in ((), (3,)) and pixels.size
    if not shape_fits or pixels.dtype.kind not in "buif":
        raise ImageError(f"Found pixels {found}. {expected}")
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == bool:
        return pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype == np.uint16 and pixels.max() > 255:  # up to 255, a library has put 8 bits into 16
        return (pixels >> 8).astype(np.uint8)  # as a 16-bit file is decoded
    low, high = pixels.min(), pixels.max()
    if not (low >= 0 and high <= 255):
        raise ImageError(f"Found pixels {found} from {low:g} to {high:g}; expected 0 to 1, or 0 to 255.")
    scale = 255 if pixels.dtype.kind == "f" and high <= 1 else 1
    return np.round(pixels * scale).astype(np.uint8)


def _are_several(image: Any) -> bool:
    """Tell whether this is a sequence of pictures rather than one picture, which may be nested lists of numbers."""
    return isinstance(image, list | tuple) and not (image and isinstance(image[0], list | tuple | int | float))


def _check_camera(camera: Any) -> None:
    """Check that an object is a camera with valid intrinsics.

    Raises:
        CameraError: it is not.
    """
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
            f"rig_from_cams: found no pose for picture {number + 1}: {poses[number].tolist()}. Expected a rotation, "
            "which neither scales nor mirrors, a translation, and 0, 0, 0, 1 in the last row."
        )
    return poses


def _turns(turns: Any) -> list[int]:
    try:
        return [operator.index(turn) for turn in turns]
    except TypeError:
        expected = "expected whole numbers of quarter turns, one per picture"
        raise CameraError(f"turns: found {turns!r}, {expected}.") from None


class _Pixels:
    """The pixels of a picture, decoded at the first use."""

    def __init__(self, image: Picture, camera: pycolmap.Camera) -> None:
        self.image = Path(image) if isinstance(image, str | Path) else pixels_from(image)
        self._camera = camera
        self._decoded: dict[tuple[bool, int | None], NDArray[np.uint8]] = {}

    def read(self, color: bool, least_side: int | None = None) -> NDArray[np.uint8]:
        """Return the pixels in color, (H, W, 3), or gray, (H, W), as a run reads them; see `read_image`."""
        if (color, least_side) not in self._decoded:
            pixels = pixels_of(self.image, not color, least_side)
            width, height = stored_size(self.image) if isinstance(self.image, Path) else pixels.shape[1::-1]
            if (self._camera.width, self._camera.height) != (width, height):
                raise CameraError(
                    f"The image is {width} x {height} pixels, its camera {self._camera.width} x "
                    f"{self._camera.height}. Give the intrinsics of the image as it is stored."
                )
            self._decoded[color, least_side] = pixels
        return self._decoded[color, least_side]
