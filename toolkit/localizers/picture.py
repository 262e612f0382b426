"""A single picture, or those of a rig, in the open map of a run."""

import operator
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from toolkit.capture.cameras import camera_text, parse_camera
from toolkit.capture.images import pixels_of, stored_size
from toolkit.capture.turning import turn_image
from toolkit.errors import ArtifactError, ImageError
from toolkit.features.features import KINDS, LocalFeatures, extract_turned
from toolkit.features.matching import AnyMethod
from toolkit.features.sift import SiftExtractor
from toolkit.features.stores import as_stored
from toolkit.localizers.base import PoseEstimate, Prior, Query, RoughPose, View
from toolkit.localizers.map import Map

_NO_ROTATION = 1e-3
"""A matrix further off, times its transpose, is no rotation; float32 and files round by less."""
Picture = Any
"""A file (str, Path), or pixels: see `pixels_from`."""


@threadpool_limits.wrap(limits=1, user_api="blas")  # sums stay in one order, as in a run
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
        place: an open map, see `Map.open`; it stays as it is.
        image: a file, or pixels as `pixels_from` takes them; of a rig a sequence of C.
        camera: its intrinsics, with the size of the picture; of a rig C of them.
        rig_from_cams: (C, 4, 4) of a rig.
        turns: for each picture, the counter-clockwise quarter turns that bring gravity down; None: it is upright. Of
            use to learned embedders and networks only.
        near: about where it is, if that is known: references are then images of the map that look the same way from
            there, and features are also sought where this pose puts the map's points.

    Returns:
        The estimate: `world_from_rig` (of a single picture world_from_cam), (4, 4), or None where `status` says why.

    Raises:
        ImageError: a file cannot be read, or its size is not the camera's; no picture, camera, pose or turn.
        ArtifactError: files of the run are missing.
    """
    if not isinstance(place, Map):
        raise ArtifactError(f"Found {type(place).__name__} for a map, expected what `Map.open` returns.")
    pictures = list(image) if _are_several(image) else [image]
    cameras: list[Any] = list(camera) if isinstance(camera, list | tuple) else [camera]
    for of in cameras:
        check_camera(of)
    poses = np.eye(4)[None] if rig_from_cams is None else _poses(rig_from_cams)
    quarter_turns = [0] * len(cameras) if turns is None else _turns(turns)
    if not 0 < len(pictures) == len(cameras) == len(poses) == len(quarter_turns):
        raise ImageError(
            f"Found {len(pictures)} pictures, {len(cameras)} cameras, {len(poses)} rig_from_cams and "
            f"{len(quarter_turns)} turns: expected as many, and at least one."
        )
    pixels = [_Pixels(picture, of) for picture, of in zip(pictures, cameras, strict=True)]
    kinds: list[AnyMethod] = [*place.kinds, *place.escalation]
    learned = any(KINDS[kind.name].upright for kind in kinds)
    upright = learned or place.settings.predictor.upright
    views = [
        View(f"picture {number}", picture.image, of, in_map=False, turns=turn if upright else 0)
        for number, (picture, of, turn) in enumerate(zip(pixels, cameras, quarter_turns, strict=True), start=1)
    ]
    none = [0] * len(pixels)
    features: list[list[LocalFeatures]] = []
    if place.settings.method != "feed_forward" and place.kinds:
        # As a run reads them: the file of features rounds keypoints at the border.
        extracted = [
            [
                as_stored(extract_turned(kind.extractor, [picture.read(kind.extractor.color)], [turn])[0])
                for picture, turn in zip(pixels, quarter_turns if KINDS[kind.name].upright else none, strict=True)
            ]
            for kind in place.kinds
        ]
        features = [list(kinds) for kinds in zip(*extracted, strict=True)]
    described = []
    for embedder in place.embedders:
        if embedder.inputs == "features":
            sift = SiftExtractor()
            settings = [kind.extractor.settings for kind in place.kinds]
            if features and sift.settings in settings:  # the features that are matched serve the embedder, too
                inputs = [kinds[settings.index(sift.settings)] for kinds in features]
            else:
                found = sift.extract([picture.read(color=False) for picture in pixels])
                inputs = [as_stored(of_picture) for of_picture in found]
        else:
            turned = embedder.upright if place.embed_settings.upright is None else place.embed_settings.upright
            shown = zip(pixels, quarter_turns if turned else none, strict=True)
            side = embedder.least_side
            inputs = [embedder.prepare(turn_image(picture.read(True, side), turn)) for picture, turn in shown]
        described.append(embedder.embed(inputs))
    about = [] if near is None else [replace(near, world_from_rig=pose) for pose in near.world_from_rig @ poses]
    readers = [picture.read for picture in pixels]
    references = place.retrieve(described, readers, cameras, quarter_turns, about)
    query = Query(views, poses, features)
    if near is None:
        return place.judged(place.localizer.localize(query, references))
    images = np.unique(np.concatenate([part.images for part in references]))
    prior = Prior.about(near.world_from_rig, images, near.rotation_std_deg, near.position_std_m, "near")
    return place.judged(place.localizer.localize(query, references, None, [prior]))


def pixels_from(image: Any) -> NDArray[np.uint8]:
    """Return pixels as they are worked on, (H, W) or (H, W, 3) RGB uint8, from what other libraries call an image.

    Args:
        image: an array or tensor (H, W), (H, W, 1), (H, W, 3), (1, H, W) or (3, H, W), a nest of lists, or a Pillow
            image. uint8 and other integers from 0 to 255; uint16 from 0 to 65535; floats from 0 to 1 or, if one is
            larger, to 255; bool. uint16 up to 255 counts as uint8.

    Raises:
        ImageError: anything else; names what was found.
    """
    expected = "Expected a file or the pixels of a picture: (H, W) or (H, W, 3) RGB, uint8."
    if image is None or isinstance(image, bytes | dict | set):
        raise ImageError(f"Found {image if image is None else type(image).__name__} for a picture. {expected}")
    if hasattr(image, "getbands"):  # of Pillow
        image = image if image.mode in ("1", "L", "RGB", "F") or image.mode.startswith("I") else image.convert("RGB")
    try:
        pixels = np.asarray(image)
    except (ValueError, TypeError, RuntimeError) as error:  # lists of different lengths; a tensor on a GPU
        raise ImageError(f"Found a {type(image).__name__} that is no array ({error}). {expected}") from None
    found = f"{pixels.shape} {pixels.dtype}"
    if pixels.ndim == 3 and pixels.shape[0] in (1, 3) and pixels.shape[2] not in (1, 3):
        pixels = np.moveaxis(pixels, 0, 2)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    of_a_picture = pixels.ndim in (2, 3) and pixels.shape[2:] in ((), (3,)) and pixels.size
    if not of_a_picture or pixels.dtype.kind not in "buif":
        raise ImageError(f"Found pixels {found}. {expected}")
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == bool:
        return pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype == np.uint16 and pixels.max() > 255:  # else 8 bits of many libraries: a file would be black
        return (pixels >> 8).astype(np.uint8)  # as a file with 16 bits is decoded
    least, most = pixels.min(), pixels.max()
    if not (least >= 0 and most <= 255):
        raise ImageError(f"Found pixels {found} from {least:g} to {most:g}; expected 0 to 1, or 0 to 255.")
    scale = 255 if pixels.dtype.kind == "f" and most <= 1 else 1
    return np.round(pixels * scale).astype(np.uint8)


def _are_several(image: Any) -> bool:
    """Tell whether this is a sequence of pictures, rather than one, which may be a nest of lists."""
    return isinstance(image, list | tuple) and not (image and isinstance(image[0], list | tuple | int | float))


def check_camera(camera: Any) -> None:
    """Refuse what is no camera, or one that no picture can have been taken with.

    Raises:
        ImageError: it is one of these.
    """
    if not isinstance(camera, pycolmap.Camera):
        raise ImageError(
            f"camera: found {camera!r}, a {type(camera).__name__}; expected a pycolmap.Camera, such as "
            "parse_camera('camera', 'PINHOLE, 640, 480, 500, 500, 320, 240') of toolkit.capture makes."
        )
    try:
        parse_camera("camera", camera_text(camera))
    except ValueError as error:
        raise ImageError(f"camera: {error}") from None


def _poses(rig_from_cams: Any) -> NDArray[np.float64]:
    """Return the poses of a rig, (C, 4, 4); refuses matrices that scale or mirror what they turn."""
    try:
        poses = np.asarray(rig_from_cams, np.float64)
    except (ValueError, TypeError):
        raise ImageError(f"rig_from_cams: found {rig_from_cams!r}, expected (C, 4, 4) numbers.") from None
    if poses.shape[-2:] != (4, 4) or not np.isfinite(poses).all():
        raise ImageError(f"rig_from_cams: found {poses.shape}, expected (C, 4, 4) finite numbers, a pose a camera.")
    poses = poses.reshape(-1, 4, 4)
    turned = poses[:, :3, :3]
    off = np.abs(turned @ np.swapaxes(turned, 1, 2) - np.eye(3)).max(axis=(1, 2))
    off = np.maximum(off, np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1))
    for number in np.flatnonzero((off > _NO_ROTATION) | (np.linalg.det(turned) < 0))[:1].tolist():
        raise ImageError(
            f"rig_from_cams: found no pose for picture {number + 1}: {poses[number].tolist()}. Expected a rotation, "
            "which neither scales nor mirrors, a translation, and 0, 0, 0, 1 in the last row."
        )
    return poses


def _turns(turns: Any) -> list[int]:
    try:
        return [operator.index(turn) for turn in turns]
    except TypeError:
        raise ImageError(f"turns: found {turns!r}, expected whole numbers of quarter turns, a picture each.") from None


class _Pixels:
    """The pixels of a picture, decoded when they are asked for."""

    def __init__(self, image: Picture, camera: pycolmap.Camera) -> None:
        self.image = Path(image) if isinstance(image, str | Path) else pixels_from(image)
        self._camera = camera
        self._decoded: dict[tuple[bool, int | None], NDArray[np.uint8]] = {}

    def read(self, color: bool, least_side: int | None = None) -> NDArray[np.uint8]:
        """Return the pixels in color, (H, W, 3), or in gray, (H, W), as a run reads them; see `read_image`."""
        if (color, least_side) not in self._decoded:
            pixels = pixels_of(self.image, not color, least_side)
            width, height = stored_size(self.image) if isinstance(self.image, Path) else pixels.shape[1::-1]
            if (self._camera.width, self._camera.height) != (width, height):
                raise ImageError(
                    f"The image is {width} x {height} pixels, its camera {self._camera.width} x "
                    f"{self._camera.height}. Give the intrinsics of the image as it is stored."
                )
            self._decoded[color, least_side] = pixels
        return self._decoded[color, least_side]
