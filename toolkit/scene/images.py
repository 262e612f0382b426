"""Images from anywhere, localized in a map of a finished run: with or without a camera, one or many."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture.images import sees_all
from toolkit.errors import ArtifactError, CameraError, ImageError, reason_of
from toolkit.pose.base import CAMERA, Query, QueryResult, RoughPose, Status
from toolkit.runs.folder import counted
from toolkit.scene.map import Map
from toolkit.scene.query import Image, camera_key, guessed_camera, with_focal

FOCAL_STEPS, FOCAL_DOUBT = 3, 1.3
"""Steps of the estimate of an unknown focal length; the matches must contradict one that is larger or smaller by a
factor."""
CENTER_DOUBT = 0.1
"""Shift of the principal point of a cropped image, in focal lengths, that the matches must contradict, too: 6 deg."""


def localize_image(
    scene_map: Map,
    image: Image | Sequence[Image],
    camera: pycolmap.Camera | Sequence[pycolmap.Camera] | None = None,
    rig_from_cams: NDArray[np.float64] | None = None,
    turns: Sequence[int] | None = None,
    near: RoughPose | None = None,
) -> QueryResult:
    """Localize one image, or those of a rig, as the run of the map would: `Map.query` and `Map.locate` in one call.

    Without a camera, the focal length of one image is estimated from its matches. It starts at that of EXIF, at that of
    the map's camera with equal image size, or at 1.2 times the longer side; `remark` says which one was used. If the
    matches do not tell it, for example on a plane, the pose is `low_confidence: camera?`.

    Args:
        scene_map: an open map, see `Map.open`; it is not changed.
        image, camera, rig_from_cams, turns: see `scene.query.query_from`.
        near: a rough pose, if it is known; see `Map.locate`.

    Raises:
        ImageError, CameraError, ArtifactError: see `Map.query` and `Map.locate`.
    """
    if not isinstance(scene_map, Map):
        raise ArtifactError(f"Found {type(scene_map).__name__} for a map, expected what `Map.open` returns.")
    if camera is None:
        if rig_from_cams is not None or isinstance(image, list | tuple):
            raise CameraError("camera: found None for several images, expected a camera for each.")
        return _UnknownFocal(scene_map, image, turns, near).estimate()[0]
    return scene_map.locate(scene_map.query(image, camera, rig_from_cams, turns), near)


def localize_images(
    scene_map: Map, images: Sequence[Image], camera: pycolmap.Camera | None = None
) -> list[QueryResult]:
    """Localize images, each alone, as `localize_image` does. Without a camera, images of one camera help each other.

    Those with equal size, in EXIF equal camera and focal length, and the same camera of the map, if any, are of one
    camera. The median of the focal lengths that matches of its `ok` images tell, weighted by inliers, is tried for the
    other images.

    Returns:
        One result per image. If an image cannot be read or does not fit the camera, it is `failed`, with the reason.

    Raises:
        ArtifactError: see `localize_image`.
    """
    results, cameras = list[QueryResult](), dict[Any, list[tuple[int, _UnknownFocal, float | None]]]()
    for number, image in enumerate(tqdm(images, "localize", unit="image", disable=len(images) < 2)):
        try:
            if camera is not None:
                results.append(localize_image(scene_map, image, camera))
                continue
            unknown = _UnknownFocal(scene_map, image)
            result, told_px = unknown.estimate()
            results.append(result)
            sure_px = told_px if result.status is Status.OK else None
            cameras.setdefault(camera_key(image, unknown.camera), []).append((number, unknown, sure_px))
        except ImageError as error:
            results.append(QueryResult.failed(reason_of(error, f"localizing {image}")))
    for of_camera in cameras.values():
        sure = sorted((sure_px, number) for number, _, sure_px in of_camera if sure_px is not None)
        if not sure:
            continue
        inliers = np.cumsum([results[number].num_inliers for _, number in sure])
        focal_px, _ = sure[np.searchsorted(inliers, inliers[-1] / 2)]
        for number, unknown, sure_px in of_camera:
            if sure_px is not None:
                continue
            result = unknown.locate(focal_px)
            # Unlike in `Map.retry`, rivals may come from a wrong focal length, so an `ok` result keeps its status.
            if result.status.rank >= results[number].status.rank and not result.camera_contradicted:
                text = f"focal length {focal_px:.0f} px, from {counted(len(sure), 'other images of its camera')}"
                results[number] = replace(result, remark="; ".join(filter(None, [text, result.remark])))
    return results


class _UnknownFocal:
    """An image in a map, without a camera."""

    def __init__(
        self, scene_map: Map, image: Image, turns: Sequence[int] | None = None, near: RoughPose | None = None
    ) -> None:
        self.scene_map, self.image, self.turns, self.near = scene_map, image, turns, near
        self.camera, self.origin, self.cropped = guessed_camera(image, scene_map.cameras)
        self.described: Query | None = None  # with features, while different intrinsics are tried

    def locate(self, focal_px: float, right: float = 0.0, down: float = 0.0) -> QueryResult:
        """Localize with a focal length, and the principal point moved by shares of it."""
        camera = with_focal(self.camera, focal_px)
        camera.principal_point_x += right * focal_px
        camera.principal_point_y += down * focal_px
        query = self.scene_map.query(self.image, camera, None, self.turns)
        if sees_all(camera):  # else features depend on the focal length
            self.described = self.described or self.scene_map.describe(query)
            query = replace(query, features=self.described.features, descriptors=self.described.descriptors)
        return self.scene_map.locate(query, self.near)

    def estimate(self) -> tuple[QueryResult, float | None]:
        """Localize again with the focal length that fits the matches, until none fits better.

        Returns:
            The result, and the focal length in pixels; None if the matches do not contradict the guess.
        """
        started = time.perf_counter()
        focal_px, told = self.camera.mean_focal_length(), False
        result = self.locate(focal_px)
        for _ in range(FOCAL_STEPS):
            fitting = result.focals_px[0] if result.focals_px else np.nan
            if not np.isfinite(fitting):
                break
            focal_px, told = float(fitting), True
            result = self.locate(focal_px)
        text = f"focal length {focal_px:.0f} px, {'which fits its matches' if told else self.origin}"
        others: list[tuple[float, ...]] = [(focal_px * FOCAL_DOUBT, 0.0, 0.0), (focal_px / FOCAL_DOUBT, 0.0, 0.0)]
        if self.cropped:
            others += [(focal_px, *(sign * CENTER_DOUBT)) for sign in (*np.eye(2), *-np.eye(2))]
        # No single pose tells this, so neither `Map.solve` nor `Map.finished` can.
        if result.status == Status.OK and not all(self.locate(*other).camera_contradicted for other in others):
            result = replace(result, status=Status.LOW_CONFIDENCE, reason=CAMERA)
            text += ", as other intrinsics do" if told else ", and the matches do not tell it"
        self.described = None
        remark, seconds = "; ".join(filter(None, [text, result.remark])), time.perf_counter() - started
        return replace(result, remark=remark, seconds=seconds), focal_px if told else None
