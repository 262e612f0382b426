"""Frames with odometry from Python, at once and one by one; what pictures say is given."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest

from tests.sequences.drifting import Drive, drive, lost_in_a_gap
from toolkit import geometry
from toolkit.errors import CameraError, ImageError
from toolkit.features.features import MutualMatcher, SiftExtractor
from toolkit.features.matching import LocalMethod
from toolkit.manifest import LocalizeSettings, SequenceSettings
from toolkit.pose.base import QueryResult, RoughPose, Status
from toolkit.scene import frames
from toolkit.scene.frames import LocalizedFrames, SequenceLocalizer, localize_sequence
from toolkit.scene.map import Map
from toolkit.sequences.odometry import Odometry
from toolkit.sequences.pose_graph import place_piece, queries_of

pytest.importorskip("gtsam")
CAMERA = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
PLACE: Map = None  # type: ignore[assignment]
SURE = np.diag(np.repeat([1e-3, 0.01], 3) ** 2)


def pictures_of(way: Drive) -> list[int | None]:
    """A picture is the number of its query; every third cannot be localized alone."""
    every: list[int | None] = [None] * len(way.odometry)
    for number, frame in enumerate(way.queries.frames):
        every[frame] = number
    return every


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> Callable[[Drive], list[tuple[int, RoughPose | None]]]:
    def answer(way: Drive) -> list[tuple[int, RoughPose | None]]:
        asked = list[tuple[int, RoughPose | None]]()

        def localize(scene_map: object, image: int, *_: object, near: RoughPose | None = None) -> QueryResult:
            asked.append((image, near))
            if image == 6:
                raise ImageError("torn")
            if image % 3 == 1 and near is None:
                return QueryResult.failed("too few matches")
            frame = way.queries.frames[image]
            pose = way.world_from_rig[frame] if near is not None else way.queries.world_from_rig[image]
            covariance = SURE if near is not None else way.queries.covariances[image]
            return QueryResult(Status.OK, "", pose, covariance, p_correct=0.99)

        monkeypatch.setattr(frames, "localize_image", localize)
        return asked

    return answer


def errors_of(done: LocalizedFrames, way: Drive) -> np.ndarray:
    return np.asarray(geometry.pose_error(done.world_from_rig, way.world_from_rig)[1])


def test_all_frames_have_poses_and_what_failed_is_asked_again(answering: Any) -> None:
    way = drive(np.random.default_rng(0))
    asked = answering(way)
    done = localize_sequence(PLACE, pictures_of(way), CAMERA, way.odometry)
    assert set(done.status) == {"ok"}
    assert errors_of(done, way).max() < 0.3
    assert list(done.single) == way.queries.frames.tolist()
    failed = [frame for frame, estimate in done.single.items() if estimate.status.startswith("failed")]
    assert list(done.relocalized) == failed
    assert {image for image, near in asked if near is not None} == {1, 4, 6, 7, 10, 13, 16, 19}
    assert done.single[int(way.queries.frames[6])].status_text == "failed: torn"


def test_pieces_are_placed_each_on_its_own(answering: Any) -> None:
    way = drive(np.random.default_rng(1))
    answering(way)
    poses = way.odometry.odom_from_rig.copy()
    poses[25:] = geometry.make_pose(np.eye(3), [300.0, 0.0, 0.0]) @ poses[25:]
    pictures = [picture if frame < 25 else None for frame, picture in enumerate(pictures_of(way))]
    done = localize_sequence(PLACE, pictures, CAMERA, Odometry(way.odometry.timestamps, poses))
    assert done.piece.tolist() == [0] * 25 + [1] * 15
    assert all(status == "ok" for status in done.status[:25])
    assert all(status.startswith("failed") for status in done.status[25:])
    assert np.isnan(done.world_from_rig[25:]).all()


def test_a_loss_of_tracking_that_pictures_tell(answering: Any) -> None:
    way = lost_in_a_gap(drive(np.random.default_rng(1), every=1))
    answering(way)
    done = localize_sequence(PLACE, pictures_of(way), CAMERA, way.odometry)
    assert done.piece.tolist() == [0] * 21 + [1] * 16
    assert errors_of(done, way).max() < 0.3
    online = localize_sequence(PLACE, pictures_of(way), CAMERA, way.odometry, {"online": True, "relocalize": False})
    live = SequenceLocalizer(PLACE, {"relocalize": False})
    latest = [
        live.add(time, pose, picture, CAMERA).world_from_rig
        for time, pose, picture in zip(way.odometry.timestamps, way.odometry.odom_from_rig, pictures_of(way),
                                       strict=True)
    ]  # fmt: skip
    # The first two pictures after it could be wrong.
    for poses in (np.stack(latest), online.world_from_rig):  # type: ignore[arg-type]
        assert geometry.pose_error(poses[26:], way.world_from_rig[26:])[1].max() < 0.3


def test_frames_and_cameras_that_do_not_fit_are_refused(answering: Any) -> None:
    way = drive(np.random.default_rng(2))
    answering(way)
    for first, cameras, named in ((1, CAMERA, "39 images and 40 poses"), (0, [CAMERA] * 3, "3 cameras and 40 images")):
        with pytest.raises(ValueError, match=named):
            localize_sequence(PLACE, pictures_of(way)[first:], cameras, way.odometry)
    localize_sequence(PLACE, pictures_of(way), [CAMERA] * 40, way.odometry)


GRAY = np.zeros((CAMERA.height, CAMERA.width), np.uint8)


@pytest.mark.parametrize(
    ("picture", "cameras", "rig_from_cams", "message"),
    [
        (GRAY, "phone", None, "camera: found 'phone'"),
        (GRAY[:, 1:], CAMERA, None, "639 x 480 pixels, its camera 640 x 480"),
        ([GRAY, GRAY], (CAMERA,), np.eye(4)[None], "2 images, 1 cameras"),
        ([GRAY], (CAMERA,), np.diag([2.0, 2, 2, 1])[None], "rig_from_cams: found no pose"),
    ],
)
def test_a_camera_that_does_not_fit_its_picture_is_an_error_unlike_an_unreadable_picture(
    picture: Any, cameras: Any, rig_from_cams: Any, message: str
) -> None:
    sift = LocalMethod("sift", SiftExtractor(), MutualMatcher())
    scene_map = Map("ios", Path("sessions"), Path("maps"), LocalizeSettings(), [sift])
    odometry = Odometry(np.zeros(1, np.int64), np.eye(4)[None])
    for door in (
        lambda: localize_sequence(scene_map, [picture], cameras, odometry, None, rig_from_cams),
        lambda: SequenceLocalizer(scene_map, None, rig_from_cams).add(0, np.eye(4), picture, cameras),
    ):
        with pytest.raises(CameraError, match=message):
            door()
    done = localize_sequence(scene_map, ["nowhere.jpg"], CAMERA, odometry)
    assert done.single[0].status_text == "failed: Image not found: nowhere.jpg"
    localizer = SequenceLocalizer(scene_map)
    assert localizer.add(0, np.eye(4), "nowhere.jpg", CAMERA).status.startswith("failed")
    assert localizer.single is not None
    assert localizer.single.status == done.single[0].status


def test_a_frame_can_be_added_again_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    found = QueryResult(Status.OK, "", np.eye(4), SURE, p_correct=0.99)
    monkeypatch.setattr(frames, "localize_image", Mock(side_effect=[CameraError("another size"), found, found]))
    localizer = SequenceLocalizer(PLACE)
    with pytest.raises(CameraError):
        localizer.add(5, np.eye(4), 0, CAMERA)
    assert localizer.single is None
    for timestamp in (5, 6):
        np.testing.assert_allclose(np.asarray(localizer.add(timestamp, np.eye(4), 0, CAMERA).world_from_rig), np.eye(4))
    assert localizer._queries.frames.tolist() == [0, 1]


def test_frame_by_frame_the_latest_pose_rests_on_the_past(answering: Any) -> None:
    way = drive(np.random.default_rng(3))
    answering(way)
    localizer = SequenceLocalizer(PLACE, {"relocalize": False})
    estimates = [
        localizer.add(time, pose, picture, CAMERA)
        for time, pose, picture in zip(
            way.odometry.timestamps, way.odometry.odom_from_rig, pictures_of(way), strict=True
        )
    ]
    assert estimates[0].status == "ok"
    assert {estimate.found_by for estimate in estimates} == {"sequence"}
    found = np.stack([np.asarray(estimate.world_from_rig) for estimate in estimates])
    assert geometry.pose_error(found, way.world_from_rig)[1].max() < 0.5
    numbers = [number for number in range(16) if number % 3 != 1 and number != 6]
    known = {
        int(way.queries.frames[number]): QueryResult(
            Status.OK, "", way.queries.world_from_rig[number], way.queries.covariances[number], p_correct=0.99
        )
        for number in numbers
    }
    alone = place_piece(way.odometry.part(slice(0, 31)), queries_of(known), SequenceSettings())
    np.testing.assert_allclose(found[30], alone.world_from_rig[-1], atol=1e-9)


def test_between_pictures_odometry_leads_on_and_the_covariance_grows_as_in_the_graph(answering: Any) -> None:
    way = drive(np.random.default_rng(4), drift=0.0)
    answering(way)
    localizer = SequenceLocalizer(PLACE, {"scale_std": 1e-6})
    localizer.add(0, way.odometry.odom_from_rig[0], 0, CAMERA)
    later = way.odometry.part(slice(1, 6))
    led = [localizer.add(time, pose) for time, pose in zip(later.timestamps, later.odom_from_rig, strict=True)]
    assert localizer.single is None
    first = queries_of({0: QueryResult(Status.OK, "", way.queries.world_from_rig[0], way.queries.covariances[0])})
    graph = place_piece(way.odometry.part(slice(0, 6)), first, SequenceSettings(scale_std=1e-6))
    np.testing.assert_allclose(np.asarray(led[-1].world_from_rig), graph.world_from_rig[-1], atol=1e-6)
    stated = np.sqrt(np.diag(np.asarray(led[-1].covariance)))
    np.testing.assert_allclose(stated, np.sqrt(np.diag(graph.covariances[-1])), rtol=0.3)


def test_what_is_found_again_counts_for_later_frames(answering: Any) -> None:
    way = drive(np.random.default_rng(5))
    asked = answering(way)
    localizer = SequenceLocalizer(PLACE, {"length_s": 8.0})
    for time, pose, picture in zip(way.odometry.timestamps, way.odometry.odom_from_rig, pictures_of(way), strict=True):
        estimate = localizer.add(time, pose, picture, CAMERA)
    assert [image for image, near in asked if near is not None] == [1, 4, 6, 7, 10, 13, 16, 19]
    assert localizer._queries.frames.tolist() == [0, 2, 4, 6, 8]  # of the last 8 s
    assert len(localizer._motion) == 10
    assert geometry.pose_error(np.asarray(estimate.world_from_rig), way.world_from_rig[-1])[1] < 0.3


def test_a_loss_of_tracking_begins_anew(answering: Any) -> None:
    way = drive(np.random.default_rng(6))
    answering(way)
    localizer = SequenceLocalizer(PLACE)
    poses = way.odometry.odom_from_rig.copy()
    poses[10:] = geometry.make_pose(np.eye(3), [300.0, 0.0, 0.0]) @ poses[10:]
    pictures = pictures_of(way)
    pictures[10] = None
    statuses = [
        localizer.add(int(way.odometry.timestamps[frame]), poses[frame], pictures[frame], CAMERA).status
        for frame in range(20)
    ]
    assert statuses[9] == "ok"
    assert statuses[10].startswith("failed")
    assert statuses[12].startswith("failed")  # a torn picture
    assert statuses[16] == "ok"


def test_frames_come_in_the_order_of_time(answering: Any) -> None:
    answering(drive(np.random.default_rng(7)))
    localizer = SequenceLocalizer(PLACE)
    localizer.add(1_000_000, np.eye(4))
    for timestamp, pose, named in (
        (1_000_000, np.eye(4), "1000000"),
        (2_000_000, np.full((4, 4), np.nan), "odom_from_rig"),
    ):
        with pytest.raises(ValueError, match=named):
            localizer.add(timestamp, pose)
