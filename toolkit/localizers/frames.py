"""Frames with odometry, localized from Python: a whole recording, or frame by frame as a device moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray

from toolkit import geometry
from toolkit.capture.world_up import up_of_cameras
from toolkit.errors import ImageError
from toolkit.geometry import Floats, Ints
from toolkit.localizers.base import PoseEstimate, RoughPose, carried_over
from toolkit.localizers.bundle import Observations
from toolkit.localizers.gravity import measured_gravity
from toolkit.localizers.map import Map
from toolkit.localizers.odometry import Odometry, cut, with_measured_drift
from toolkit.localizers.picture import Picture, check_camera, localize_image
from toolkit.localizers.pose_graph import FAR, PlacedPiece, is_sure
from toolkit.localizers.recording import localize_piece, queries_of
from toolkit.manifest import SequenceSettings

Pictures = Picture | Sequence[Picture] | None
"""What a frame shows: a picture, of a rig those of its cameras, or nothing."""
Cameras = pycolmap.Camera | Sequence[pycolmap.Camera]


@dataclass(frozen=True)
class LocalizedFrames:
    """The poses of N frames in the map."""

    world_from_rig: Floats
    """(N, 4, 4); of a single camera world_from_cam; NaN where there is none."""
    covariances: Floats
    """(N, 6, 6) of a small motion in the rig's frame: rotation, radians, then translation, meters."""
    status: NDArray[np.object_]
    """(N,) `ok`, `low_confidence: <reason>` or `failed: <reason>`."""
    piece: Ints
    """(N,) number of the piece of odometry, between losses of tracking."""
    single: dict[int, PoseEstimate]
    """What each picture says alone, by the frame."""
    again: dict[int, PoseEstimate]
    """What it says near its predicted pose, where it was in doubt."""


def _localize(
    place: Map,
    rig_from_cams: NDArray[np.float64] | None,
    turns: Sequence[int] | None,
    picture: Pictures,
    cameras: Cameras,
    near: RoughPose | None = None,
) -> PoseEstimate:
    """Localize what a frame shows, alone or near a pose; one picture that cannot be read does not end a recording."""
    for camera in cameras if isinstance(cameras, list | tuple) else [cameras]:
        check_camera(camera)
    try:
        return localize_image(place, picture, cameras, rig_from_cams, turns, near=near)
    except ImageError as error:
        return PoseEstimate(f"failed: {error}")


def localize_sequence(
    place: Map,
    images: Sequence[Pictures],
    cameras: Cameras | Sequence[Cameras],
    odometry: Odometry,
    settings: SequenceSettings | dict[str, Any] | None = None,
    rig_from_cams: NDArray[np.float64] | None = None,
    turns: Sequence[int] | None = None,
) -> LocalizedFrames:
    """Localize the frames of a recording, with and without pictures.

    Args:
        place: an open map, see `Map.open`.
        images: of each of N frames its picture, of a rig its C pictures, or None.
        cameras: the intrinsics of all pictures, or N, those of each frame; of a rig sequences of C.
            A phone that focuses has others in each frame.
        odometry: of the N frames, as the device measured it; tracking may have been lost in between.
        settings: see `SequenceSettings`; a dict holds what differs from the defaults. If `online`, only frames with a
            picture have a pose, which rests on what was before them.
        rig_from_cams, turns: as of `localize_image`.

    Raises:
        ValueError: as many images as poses are expected, and as many cameras, or one.
        ManifestError: GTSAM is not installed.
        ImageError: no camera, or none that the pictures can be of. A picture that cannot be read is `failed`.
    """
    settings = SequenceSettings.of(settings)
    if len(images) != len(odometry):
        raise ValueError(f"Found {len(images)} images and {len(odometry)} poses: expected one of each for a frame.")
    given: Any = cameras
    several = given[0] if isinstance(given, list | tuple) and rig_from_cams is not None else given
    of_each = list(given) if isinstance(several, list | tuple) else [given] * len(images)
    if len(of_each) != len(images):
        raise ValueError(f"Found {len(of_each)} cameras and {len(images)} images: expected one for all, or for each.")
    localize = partial(_localize, place, rig_from_cams, turns)
    single = {frame: localize(image, of_each[frame]) for frame, image in enumerate(images) if image is not None}
    piece, again = np.zeros(len(odometry), int), dict[int, PoseEstimate]()
    parts = list[PlacedPiece]()
    pieces, queries = odometry.split(settings), queries_of(single)
    if not settings.online:
        settings = with_measured_drift([(odometry.part(rows), queries.part(rows)) for rows in pieces], settings)
        pieces = [
            slice(rows.start + part.start, rows.start + part.stop)
            for rows in pieces
            for part in cut(odometry.part(rows), queries.part(rows), settings)
        ]
    tracks = [(odometry.part(rows), queries.part(rows)) for rows in pieces]
    gravity = measured_gravity(tracks, lambda: up_of_cameras(place.session.world_from_cam()), settings)
    for number, rows in enumerate(pieces):
        piece[rows] = number
        asked = np.array([frame for frame in single if rows.start <= frame < rows.stop], np.int64)

        def localize_again(todo: Sequence[tuple[int, RoughPose]], start: int = rows.start) -> list[PoseEstimate]:
            return [localize(images[start + frame], of_each[start + frame], near) for frame, near in todo]

        def observe(frame: int, again: PoseEstimate | None, start: int = rows.start) -> Observations:
            estimate, each = again or single[start + frame], of_each[start + frame]
            rig = np.eye(4)[None] if rig_from_cams is None else np.asarray(rig_from_cams, np.float64)
            cameras = each if isinstance(each, list | tuple) else [each]
            return Observations.of(estimate.correspondences, cameras, rig)

        ask = localize_again if settings.relocalize else None
        done = localize_piece(*tracks[number], asked - rows.start, settings, ask, gravity, observe)
        again |= {rows.start + frame: estimate for frame, estimate in done.again.items()}
        parts.append(done.placed)
    return LocalizedFrames(
        np.concatenate([np.zeros((0, 4, 4)), *(part.world_from_rig for part in parts)]),
        np.concatenate([np.zeros((0, 6, 6)), *(part.covariances for part in parts)]),
        np.concatenate([np.zeros(0, object), *(part.status for part in parts)]),
        piece,
        single,
        again,
    )


class SequenceLocalizer:
    """Tells a moving device where it is now, frame by frame, from the frames before.

    At a picture, the pose graph of the last `settings.length_s` seconds is solved, all of the piece without a limit: of
    600 frames that takes some 50 ms, besides the picture. Between pictures odometry leads on from the last solution.
    """

    def __init__(
        self,
        place: Map,
        settings: SequenceSettings | dict[str, Any] | None = None,
        rig_from_cams: NDArray[np.float64] | None = None,
        turns: Sequence[int] | None = None,
    ) -> None:
        """See `localize_sequence`; `settings.length_s` is the window."""
        self.settings = self._drift = SequenceSettings.of({"online": True}, settings)
        self._localize = partial(_localize, place, rig_from_cams, turns)
        self._timestamps, self._poses = list[int](), list[Floats]()
        self._queries = queries_of({})
        """Of the piece, with those found again."""
        self._solved: tuple[int, PlacedPiece] | None = None
        self.single: PoseEstimate | None = None
        """What the picture of the latest frame says alone; None: it had none."""

    def add(
        self, timestamp: int, odom_from_rig: ArrayLike, image: Pictures = None, cameras: Cameras | None = None
    ) -> PoseEstimate:
        """Add a frame, and return where it is: `found_by` is `sequence`.

        Args:
            timestamp: microseconds, later than those before.
            odom_from_rig: (4, 4) as the device measured it; of a single camera odom_from_cam.
            image: the frame's picture, or those of a rig.
            cameras: its intrinsics; of a rig a sequence.

        Raises:
            ValueError: the time is not later than the last, or the pose is none.
            ImageError: no camera, or none that a picture can be of. A picture that cannot be read is `failed`.
            ManifestError: GTSAM is not installed.
        """
        pose = np.asarray(odom_from_rig, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"odom_from_rig: found {pose.tolist()}, expected a pose (4, 4) of finite numbers.")
        if self._timestamps and timestamp <= self._timestamps[-1]:
            raise ValueError(f"timestamp: found {timestamp} after {self._timestamps[-1]}, expected a later one.")
        self._timestamps.append(int(timestamp))
        self._poses.append(pose)
        latest = self._since(-4)
        if latest.split(self.settings)[-1].start == len(latest) - 1:  # tracking was lost: a new piece
            del self._timestamps[:-1], self._poses[:-1]
            self._queries, self._solved = queries_of({}), None
        if image is None:
            self.single = None
            return self._led_on()
        given: Any = cameras
        self.single = self._localize(image, given)
        self._queries = self._queries.joined(queries_of({len(self._poses) - 1: self.single}))
        return self._solve(image, given)

    def _since(self, start: int) -> Odometry:
        return Odometry(np.array(self._timestamps[start:], np.int64), np.stack(self._poses[start:]))

    def _forget(self, start: int) -> None:
        """Leave out the frames before one."""
        del self._timestamps[:start], self._poses[:start]
        self._queries = self._queries.part(slice(start, start + len(self._poses)))

    def _solve(self, image: Pictures, cameras: Cameras) -> PoseEstimate:
        if self.settings.length_s is not None:
            self._forget(int(np.searchsorted(self._timestamps, self._timestamps[-1] - self.settings.length_s * 1e6)))
        self._drift = with_measured_drift([(self._since(0), self._queries)], self.settings)
        self._forget(cut(self._since(0), self._queries, self._drift)[-1].start)
        window = self._since(0)
        offline = self._drift.model_copy(update={"online": False, "length_s": None})

        def localize_again(todo: Sequence[tuple[int, RoughPose]]) -> list[PoseEstimate]:
            return [self._localize(image, cameras, near) for _, near in todo]

        again = localize_again if self.settings.relocalize else None
        done = localize_piece(window, self._queries, np.array([len(window) - 1]), offline, again)
        self._queries, placed = done.queries, done.placed
        self._solved = len(window) - 1, placed
        if not np.isfinite(placed.world_from_rig[-1]).all():
            return PoseEstimate(str(placed.status[-1]), found_by="sequence")
        return self._estimate(placed.world_from_rig[-1], placed.covariances[-1], str(placed.status[-1]))

    def _led_on(self) -> PoseEstimate:
        """Return the latest pose as odometry leads to it from the last picture."""
        if self._solved is None:
            return PoseEstimate("failed: no query of this piece has a pose", found_by="sequence")
        last, placed = self._solved
        status = str(placed.status[-1])
        if not np.isfinite(placed.world_from_rig[-1]).all():
            return PoseEstimate(status, found_by="sequence")
        way = self._since(last).scaled(placed.scale)
        step = geometry.invert(way.odom_from_rig[0]) @ way.odom_from_rig[-1]
        turn, shift = way.drift(self._drift, np.array([0]), np.array([len(way) - 1]))
        shift = np.hypot(shift, self.settings.scale_std * np.linalg.norm(step[:3, 3]))
        covariance = carried_over(placed.covariances[-1], geometry.invert(step))
        covariance += np.diag(np.repeat([turn[0], shift[0]], 3) ** 2)
        status = FAR if status == "ok" and not is_sure(covariance[None])[0] else status
        return self._estimate(placed.world_from_rig[-1] @ step, covariance, status)

    def _estimate(self, pose: Floats, covariance: Floats, status: str) -> PoseEstimate:
        return replace(
            self.single or PoseEstimate(status),
            status=status,
            world_from_rig=pose,
            covariance=covariance,
            found_by="sequence",
        )
