"""Python interface to localize frames with odometry: a whole recording, or frame by frame while a device moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray

from toolkit import geometry
from toolkit.errors import CameraError, ImageError
from toolkit.geometry import Floats, Ints
from toolkit.manifest import SequenceSettings
from toolkit.pose.base import QueryResult, RoughPose, Status, carried_over
from toolkit.scene.images import localize_image
from toolkit.scene.map import Map
from toolkit.scene.query import Image
from toolkit.sequences.odometry import Odometry
from toolkit.sequences.pose_graph import (
    FAR,
    NO_QUERY,
    PlacedPiece,
    is_sure,
    latest_part,
    localize_pieces,
    pieces_of,
    queries_of,
)
from toolkit.threads import fixed_sums

Images = Image | Sequence[Image] | None
"""The image of a frame, one image per camera of a rig, or None for a frame with odometry only."""
Cameras = pycolmap.Camera | Sequence[pycolmap.Camera]


@dataclass(frozen=True)
class LocalizedFrames:
    """The poses of N frames in the map."""

    world_from_rig: Floats
    """(N, 4, 4), NaN for none; with a single camera, world_from_cam."""
    covariances: Floats
    """(N, 6, 6) of a small motion in the rig's frame: rotation, radians, then translation, meters."""
    status: NDArray[np.object_]
    """(N,) `Status`; online None for frames without a picture."""
    reason: NDArray[np.object_]
    """(N,) why it is not `ok`, in few words."""
    piece: Ints
    """(N,) number of the piece of odometry; losses of tracking separate pieces."""
    single: dict[int, QueryResult]
    """Estimate from each image alone, by frame."""
    relocalized: dict[int, QueryResult]
    """Estimates of doubtful images that were localized again near their predicted pose, by frame."""


def _localize(
    scene_map: Map,
    rig_from_cams: NDArray[np.float64] | None,
    turns: Sequence[int] | None,
    image: Images,
    cameras: Cameras,
    near: RoughPose | None = None,
) -> QueryResult:
    """Localize the image of a frame, alone or near a pose. An image that cannot be read gives `failed`."""
    try:
        return localize_image(scene_map, image, cameras, rig_from_cams, turns, near=near)
    except CameraError:
        raise
    except ImageError as error:
        return QueryResult.failed(str(error))


@fixed_sums
def localize_sequence(
    scene_map: Map,
    images: Sequence[Images],
    cameras: Cameras | Sequence[Cameras],
    odometry: Odometry,
    settings: SequenceSettings | dict[str, Any] | None = None,
    rig_from_cams: NDArray[np.float64] | None = None,
    turns: Sequence[int] | None = None,
) -> LocalizedFrames:
    """Localize the N frames of a recording, with and without images.

    Args:
        scene_map: an open map, see `Map.open`.
        images: for each frame its image, the C images of a rig, or None.
        cameras: the intrinsics of all images, or a list with those of each of the N frames, because they may change
            when a phone focuses. For a rig, each is a sequence of C.
        odometry: the device's own poses of the N frames. Losses of tracking are detected.
        settings: see `SequenceSettings`; a dict holds values that differ from the defaults. If `online`, only frames
            with an image get a pose, estimated from the frames before them.
        rig_from_cams, turns: see `localize_image`.

    Raises:
        ValueError: the numbers of images and poses differ, or there is neither one camera nor one per image.
        ManifestError: GTSAM is not installed.
        CameraError: a camera is missing, or does not fit the images. An image that cannot be read is `failed`.
    """
    settings = SequenceSettings.of(settings)
    if len(images) != len(odometry):
        raise ValueError(f"Found {len(images)} images and {len(odometry)} poses: expected one of each per frame.")
    cams: Any = cameras
    first = cams[0] if isinstance(cams, list | tuple) and rig_from_cams is not None else cams
    cams_of_frames = list(cams) if isinstance(first, list | tuple) else [cams] * len(images)
    if len(cams_of_frames) != len(images):
        expected = "expected one for all, or one per image"
        raise ValueError(f"Found {len(cams_of_frames)} cameras and {len(images)} images: {expected}.")
    localize = partial(_localize, scene_map, rig_from_cams, turns)
    single = {frame: localize(image, cams_of_frames[frame]) for frame, image in enumerate(images) if image is not None}

    def relocalize(todo: Sequence[tuple[int, RoughPose]]) -> list[QueryResult]:
        return [localize(images[frame], cams_of_frames[frame], near) for frame, near in todo]

    queries, asked = queries_of(single), np.array(list(single), np.int64)
    pieces, settings = pieces_of(odometry, odometry.split(), queries, settings)
    done = localize_pieces(odometry, queries, asked, settings, relocalize, pieces)
    placed = done.placed
    poses = placed.world_from_rig, placed.covariances, placed.status, placed.reason
    return LocalizedFrames(*poses, done.piece, single, done.relocalized)


class SequenceLocalizer:
    """Localizes a moving device frame by frame, from the current and earlier frames.

    Each image solves the pose graph of the last `settings.length_s` seconds (None: of the whole piece). With 600
    frames this takes some 50 ms, besides localization of the image. Between images, odometry continues the last
    solution.
    """

    def __init__(
        self,
        scene_map: Map,
        settings: SequenceSettings | dict[str, Any] | None = None,
        rig_from_cams: NDArray[np.float64] | None = None,
        turns: Sequence[int] | None = None,
    ) -> None:
        """See `localize_sequence`; `settings.length_s` is the window."""
        self.settings = self._drift = SequenceSettings.of({"online": True}, settings)
        self._localize = partial(_localize, scene_map, rig_from_cams, turns)
        self._motion = Odometry(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
        """Frames of the window."""
        self._queries = queries_of({})
        """Single poses of the current piece, including those found again."""
        self._solved: tuple[int, PlacedPiece] | None = None
        """Frame of the last image, and the solution there."""
        self.single: QueryResult | None = None
        """Estimate from the latest frame's image alone; None if it had no image."""

    @fixed_sums
    def add(
        self, timestamp: int, odom_from_rig: ArrayLike, image: Images = None, cameras: Cameras | None = None
    ) -> QueryResult:
        """Add a frame and return its pose, with `found_by` = `sequence`.

        Args:
            timestamp: microseconds, later than the last one.
            odom_from_rig: (4, 4) pose by the device's odometry; with a single camera, odom_from_cam.
            image: the frame's image, or a sequence of images of a rig; None: odometry only.
            cameras: the intrinsics; a sequence for a rig.

        Raises:
            ValueError: the timestamp is not later than the last one, or the pose is invalid.
            CameraError: a camera is missing, or does not fit the image. An image that cannot be read is `failed`.
            ManifestError: GTSAM is not installed.
        """
        pose = np.asarray(odom_from_rig, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"odom_from_rig: found {pose.tolist()}, expected a pose (4, 4) of finite numbers.")
        before = self._motion.timestamps
        if len(before) and timestamp <= before[-1]:
            raise ValueError(f"timestamp: found {timestamp} after {before[-1]}, expected a later one.")
        cams: Any = cameras
        # Before the frame is added, so that it can be added again after an error.
        self.single = None if image is None else self._localize(image, cams)
        self._motion = Odometry(np.append(before, timestamp), np.concatenate([self._motion.odom_from_rig, pose[None]]))
        latest = self._motion.part(slice(-4, None))
        if latest.split()[-1].start == len(latest) - 1:  # tracking was lost: start a new piece
            self._motion, self._queries, self._solved = self._motion.part(slice(-1, None)), queries_of({}), None
        if self.single is None:
            return self._extrapolate()
        self._queries = self._queries.joined(queries_of({len(self._motion) - 1: self.single}))
        return self._solve(image, cams)

    def _solve(self, image: Images, cameras: Cameras) -> QueryResult:
        self._motion, self._queries, self._drift = latest_part(self._motion, self._queries, self.settings)
        offline = self._drift.model_copy(update={"online": False, "length_s": None})

        def relocalize(todo: Sequence[tuple[int, RoughPose]]) -> list[QueryResult]:
            return [self._localize(image, cameras, near) for _, near in todo]

        done = localize_pieces(self._motion, self._queries, np.array([len(self._motion) - 1]), offline, relocalize)
        self._queries, placed = done.queries, done.placed
        self._solved = len(self._motion) - 1, placed
        return self._estimate(placed.world_from_rig[-1], placed.covariances[-1], placed.status[-1], placed.reason[-1])

    def _extrapolate(self) -> QueryResult:
        """Return the pose of the latest frame by odometry from the last image."""
        if self._solved is None:
            return QueryResult.failed(NO_QUERY, found_by="sequence")
        last, placed = self._solved
        status, reason = placed.status[-1], placed.reason[-1]
        since = self._motion.part(slice(last, None)).scaled(placed.scale)
        step = geometry.invert(since.odom_from_rig[0]) @ since.odom_from_rig[-1]
        rotation_std, position_std = since.drift(self._drift, np.array([0]), np.array([len(since) - 1]))
        position_std = np.hypot(position_std, self.settings.scale_std * np.linalg.norm(step[:3, 3]))
        covariance = carried_over(placed.covariances[-1], geometry.invert(step))
        covariance += np.diag(np.repeat([rotation_std[0], position_std[0]], 3) ** 2)
        if status is Status.OK and not is_sure(covariance[None])[0]:
            status, reason = Status.LOW_CONFIDENCE, FAR
        return self._estimate(placed.world_from_rig[-1] @ step, covariance, status, reason)

    def _estimate(self, pose: Floats, covariance: Floats, status: Status, reason: str) -> QueryResult:
        if not np.isfinite(pose).all():
            return QueryResult(status, reason, found_by="sequence")
        single = replace(self.single or QueryResult(status), status=status, reason=reason)
        return replace(single, world_from_rig=pose, covariance=covariance, found_by="sequence")
