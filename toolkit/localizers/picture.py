"""A single picture, or those of a rig, in the open map of a run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from toolkit.capture.images import pixels_of
from toolkit.capture.turning import turn_image
from toolkit.errors import ImageError
from toolkit.features.features import KINDS, LocalFeatures, SiftExtractor, extract_turned
from toolkit.features.matching import AnyMethod
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
    if place.settings.method != "vggt" and place.kinds:
        # As a run reads them: the file of features rounds keypoints at the border.
        extracted = [
            [
                as_stored(extract_turned(kind.extractor, [picture.read(kind.extractor.color)], [turn])[0])
                for picture, turn in zip(pixels, quarter_turns if KINDS[kind.name].upright else none, strict=True)
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
            inputs = [as_stored(found) for found in sift.extract([picture.read(color=False) for picture in pixels])]
    else:
        turned = embedder.upright if place.embed_settings.upright is None else place.embed_settings.upright
        shown = zip(pixels, quarter_turns if turned else none, strict=True)
        inputs = [embedder.prepare(turn_image(picture.read(color=True), turn)) for picture, turn in shown]
    references = place.retrieve(embedder.embed(inputs), [picture.read for picture in pixels], cameras, quarter_turns)
    with threadpool_limits(1, "blas"):  # sums stay in one order, as in a run
        return place.localizer.localize(Query(views, poses, features), references)


class _Pixels:
    """The pixels of a picture, decoded when they are asked for."""

    def __init__(self, image: Picture, camera: pycolmap.Camera) -> None:
        self.image = Path(image) if isinstance(image, str) else image
        self._camera = camera
        self._decoded: dict[bool, NDArray[np.uint8]] = {}

    def read(self, color: bool) -> NDArray[np.uint8]:
        """Return the pixels in color, (H, W, 3), or in gray, (H, W), as a run reads them."""
        if color not in self._decoded:
            pixels = pixels_of(self.image, gray=not color)
            if (self._camera.width, self._camera.height) != pixels.shape[1::-1]:
                raise ImageError(
                    f"The image is {pixels.shape[1]} x {pixels.shape[0]} pixels, its camera {self._camera.width} x "
                    f"{self._camera.height}. Give the intrinsics of the image as it is stored."
                )
            self._decoded[color] = pixels
        return self._decoded[color]
