"""Bundle adjustment of a recording's queries: known answers, wrong matches, rigs."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from tests.localizers.drifting import Drive, drive
from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.localizers import bundle
from toolkit.localizers.base import PoseEstimate
from toolkit.localizers.bundle import MAX_POINTS, Observations, adjusted
from toolkit.localizers.correspondences import Correspondences
from toolkit.localizers.pose_graph import PlacedPiece, place_piece
from toolkit.localizers.recording import GRAPH_AGAIN, localize_piece
from toolkit.manifest import SequenceSettings

pytest.importorskip("gtsam")

SETTINGS = SequenceSettings()
CAMERA = pycolmap.Camera(model="OPENCV", width=640, height=480, params=[500, 500, 320, 240, 0.05, -0.01, 0, 0])
ALONG = geometry.make_pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
"""rig_from_cam of a camera that looks along the rig's x, where it drives to."""


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points and pixels are exact here: they count for as much."""
    for name, value in (("PIXEL_STD", 0.05), ("POINT_STD_M", 1e-4), ("POINT_STD_SHARE", 0.0)):
        monkeypatch.setattr(bundle, name, value)


def seen(way: Drive, frame: int, wrong: float = 0.0, rig: Floats = ALONG[None], count: int = 60) -> Correspondences:
    """Return exact matches with points 5 to 20 m before the cameras of a frame, and some wrong ones."""
    rng = np.random.default_rng(frame)
    cams, camera = way.world_from_rig[frame] @ rig, rng.integers(0, len(rig), count)
    depth = rng.uniform(5, 20, (count, 1))
    in_cam = np.concatenate([rng.uniform(-0.4, 0.4, (count, 2)) * depth, depth], axis=1)
    points = np.einsum("kij,kj->ki", cams[camera, :3, :3], in_cam) + cams[camera, :3, 3]
    pixels = np.asarray(CAMERA.img_from_cam(in_cam), np.float64)
    bad = rng.random(count) < wrong
    pixels[bad] += rng.uniform(-80, 80, (bad.sum(), 2))
    return Correspondences(camera, pixels, points, np.full(count, -1), np.ones(count, bool))


def errors(placed: PlacedPiece, way: Drive) -> Floats:
    return np.asarray(geometry.pose_error(placed.world_from_rig, way.world_from_rig)[1])


@pytest.mark.parametrize("wrong", [0.0, 0.2])
@pytest.mark.parametrize("cameras", [1, 2])
def test_exact_points_give_the_exact_poses(wrong: float, cameras: int) -> None:
    way = drive(np.random.default_rng(0))
    rig = np.stack([ALONG, geometry.make_pose(np.eye(3), [0.0, 0.5, 0.2]) @ ALONG])[:cameras]
    placed = place_piece(way.odometry, way.queries, SETTINGS)
    shown = {
        frame: Observations.of(seen(way, frame, wrong, rig), [CAMERA] * cameras, rig)
        for frame in way.queries.frames.tolist()
    }
    found = adjusted(way.odometry, placed, way.queries, shown, SETTINGS)
    asked = way.queries.frames
    assert errors(found, way)[asked].max() < (0.005 if not wrong else 0.03)
    assert np.median(errors(placed, way)[asked]) > 0.02
    assert np.median(errors(found, way)) < np.median(errors(placed, way)), "the frames between profit"
    np.testing.assert_array_equal(found.covariances, placed.covariances)


def test_a_query_without_points_keeps_its_pose_as_a_prior() -> None:
    way = drive(np.random.default_rng(1))
    placed = place_piece(way.odometry, way.queries, SETTINGS)
    frame = int(way.queries.frames[3])
    shown = {frame: Observations.of(seen(way, frame), [CAMERA], ALONG[None])}
    found = adjusted(way.odometry, placed, way.queries, shown, SETTINGS)
    assert errors(found, way)[frame] < 0.005
    assert np.abs(errors(found, way) - errors(placed, way))[frame + 12 :].max() < 0.02


def test_points_that_contradict_all_else_change_nothing() -> None:
    way = drive(np.random.default_rng(2))
    placed = place_piece(way.odometry, way.queries, SETTINGS)
    frames, moved = way.queries.frames.tolist(), np.array([3.0, 0.0, 0.0])
    shown = {frame: Observations.of(seen(way, frame), [CAMERA], ALONG[None]) for frame in frames}
    shown = {frame: replace(each, points=each.points + moved) for frame, each in shown.items()}
    assert adjusted(way.odometry, placed, way.queries, shown, SETTINGS) is placed


def test_errors_are_as_large_as_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each neighborhood of the map is off by itself, and so are all points that a query shows."""
    monkeypatch.undo()
    squares = []
    for seed in range(3):
        way = drive(np.random.default_rng(seed))
        placed, rng = place_piece(way.odometry, way.queries, SETTINGS), np.random.default_rng(seed)
        shown = {}
        for frame in way.queries.frames.tolist():
            found = seen(way, frame)
            found = replace(
                found, points=found.points + rng.normal(0, 0.03, 3) + rng.normal(0, 0.02, found.points.shape),
                pixels=found.pixels + rng.normal(0, 2, found.pixels.shape),
            )  # fmt: skip
            shown[frame] = Observations.of(found, [CAMERA], ALONG[None])
        moved = adjusted(way.odometry, placed, way.queries, shown, SETTINGS)
        assert moved is not placed
        variances = np.trace(moved.covariances[:, 3:, 3:], axis1=1, axis2=2)
        squares.append((errors(moved, way) ** 2 / variances).mean())
    assert 0.2 < np.mean(squares) < 1.5


def test_what_is_observed() -> None:
    way = drive(np.random.default_rng(3))
    many = seen(way, 0, count=3 * MAX_POINTS)
    inlier = np.arange(len(many)) % 2 == 0
    found = Observations.of(replace(many, inlier=inlier), [CAMERA], ALONG[None])
    assert len(found.points) <= MAX_POINTS
    cam = way.world_from_rig[0] @ ALONG
    in_cam = geometry.transform(geometry.invert(cam), found.points)
    np.testing.assert_allclose(found.rays, in_cam[:, :2] / in_cam[:, 2:], atol=1e-6)
    assert not len(Observations.of(Correspondences(), [CAMERA], ALONG[None]).points)


def test_a_piece_is_adjusted_on_request() -> None:
    way = drive(np.random.default_rng(4))
    asked = way.queries.frames

    def observe(frame: int, again: PoseEstimate | None) -> Observations:
        assert again is None
        return Observations.of(seen(way, frame), [CAMERA], ALONG[None])

    plain = localize_piece(way.odometry, way.queries, asked, SETTINGS, None, None, observe)
    assert GRAPH_AGAIN not in plain.steps
    on = SETTINGS.model_copy(update={"bundle_adjust": True})
    done = localize_piece(way.odometry, way.queries, asked, on, None, None, observe)
    np.testing.assert_array_equal(done.steps[GRAPH_AGAIN], plain.placed.world_from_rig[asked])
    assert errors(done.placed, way)[asked].max() < 0.005
