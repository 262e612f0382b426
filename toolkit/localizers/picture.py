"""A single picture, or those of a rig, in the open map of a run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from toolkit.capture.images import read_image
from toolkit.capture.turning import turn_image
from toolkit.errors import ImageError
from toolkit.features.features import LocalFeatures, SiftExtractor, extract_turned
from toolkit.features.stores import as_stored
from toolkit.localizers.base import PoseEstimate, Query, View
from toolkit.localizers.map import Map

Picture = str | Path | NDArray[np.uint8]


def localize_image(
    place: Map,
    image: Picture | Sequence[Picture],
    camera: pycolmap.Camera | Sequence[pycolmap.Camera],
    rig_from_cams: NDArray[np.float64] | None = None,
    turns: Sequence[int] | None = None,
) -> PoseEstimate:
    """Localize one picture, or those that the cameras of a rig took at one instant, as the run of the map would.

    Args:
        place: an open map, see `Map.open`; it stays as it is.
        image: a file, or pixels (H, W) or (H, W, 3) RGB uint8; of a rig a sequence of C.
        camera: its intrinsics, with the size of the picture; of a rig C of them.
        rig_from_cams: (C, 4, 4) of a rig.
        turns: for each picture, the counter-clockwise quarter turns that bring gravity down; None: it is upright. Of
            use to learned embedders and networks only.

    Returns:
        The estimate: `world_from_rig` (of a single picture world_from_cam), (4, 4), or None where `status` says why.

    Raises:
        ImageError: a file cannot be read, or its size is not the camera's.
        ArtifactError: files of the run are missing.
    """
    pictures: list[Any] = [image] if isinstance(image, str | Path | np.ndarray) else list(image)
    cameras = [camera] if isinstance(camera, pycolmap.Camera) else list(camera)
    poses = np.eye(4)[None] if rig_from_cams is None else np.asarray(rig_from_cams, np.float64).reshape(-1, 4, 4)
    quarter_turns = [0] * len(cameras) if turns is None else list(turns)
    if not 0 < len(pictures) == len(cameras) == len(poses) == len(quarter_turns):
        raise ImageError(
            f"Found {len(pictures)} pictures, {len(cameras)} cameras, {len(poses)} rig_from_cams and "
            f"{len(quarter_turns)} turns: expected as many, and at least one."
        )
    pixels = [_read(picture, of) for picture, of in zip(pictures, cameras, strict=True)]
    learned = any(kind.extractor.upright for kind in (*place.kinds, *place.escalation))
    upright = learned or place.settings.predictor.upright
    views = [
        View(f"picture {number}", color, of, in_map=False, turns=turn if upright else 0)
        for number, ((color, _), of, turn) in enumerate(zip(pixels, cameras, quarter_turns, strict=True), start=1)
    ]
    none = [0] * len(pixels)
    features: list[list[LocalFeatures]] = []
    if place.settings.method != "vggt" and place.kinds:
        # As a run reads them: the file of features rounds keypoints at the border.
        extracted = [
            [
                as_stored(extract_turned(kind.extractor, [color if kind.extractor.color else gray], [turn])[0])
                for (color, gray), turn in zip(pixels, quarter_turns if kind.extractor.upright else none, strict=True)
            ]
            for kind in place.kinds
        ]
        features = [list(kinds) for kinds in zip(*extracted, strict=True)]
    embedder = place.embedder
    if embedder.inputs == "features":
        sift = SiftExtractor()
        settings = [kind.extractor.settings for kind in place.kinds]
        if features and sift.settings in settings:  # the features that are matched serve the embedder, too
            inputs = [kinds[settings.index(sift.settings)] for kinds in features]
        else:
            inputs = [as_stored(found) for found in sift.extract([gray for _, gray in pixels])]
    else:
        turned = embedder.upright if place.embed_settings.upright is None else place.embed_settings.upright
        shown = zip(pixels, quarter_turns if turned else none, strict=True)
        inputs = [embedder.prepare(turn_image(color, turn)) for (color, _), turn in shown]
    references = place.retrieve(embedder.embed(inputs), pixels, cameras, quarter_turns)
    with threadpool_limits(1, "blas"):  # sums stay in one order, as in a run
        return place.localizer.localize(Query(views, poses, features), references)


def _read(picture: Picture, camera: pycolmap.Camera) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the pixels of a picture in color, (H, W, 3), and in gray, (H, W), as a run reads them."""
    if isinstance(picture, str | Path):
        gray, color = read_image(picture, gray=True), read_image(picture)
    elif picture.dtype != np.uint8 or picture.shape[2:] not in ((), (3,)):
        raise ImageError(f"Found pixels {picture.shape} {picture.dtype}: expected (H, W) or (H, W, 3) uint8.")
    elif picture.ndim == 2:
        gray, color = picture, np.repeat(picture[:, :, None], 3, axis=2)
    else:
        gray, color = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8), picture
    if (camera.width, camera.height) != (gray.shape[1], gray.shape[0]):
        raise ImageError(
            f"The image is {gray.shape[1]} x {gray.shape[0]} pixels, its camera {camera.width} x {camera.height}. "
            "Give the intrinsics of the image as it is stored."
        )
    return color, gray
