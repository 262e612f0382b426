"""The pose graph of odometry and single queries."""

from dataclasses import replace

import numpy as np
import pytest

from tests.sequences.drifting import drive, small_motion
from toolkit import geometry
from toolkit.manifest import SequenceSettings
from toolkit.pose.base import Status
from toolkit.sequences.odometry import Odometry, PosedQueries, with_measured_drift
from toolkit.sequences.pose_graph import FAR, place_online, place_piece

pytest.importorskip("gtsam")
SETTINGS = SequenceSettings()


def test_exact_measurements_give_the_exact_poses() -> None:
    way = drive(np.random.default_rng(0), noise=0.0, drift=0.0)
    placed = place_piece(way.odometry, way.queries, SETTINGS)
    np.testing.assert_allclose(placed.world_from_rig, way.world_from_rig, atol=1e-6)
    assert set(placed.status) == {"ok"}
    assert placed.used.all()
    assert placed.scale == pytest.approx(1.0, abs=1e-6)
    assert (np.linalg.eigvalsh(placed.covariances) > 0).all()


def test_wrong_queries_are_not_used_and_harm_nothing() -> None:
    way = drive(np.random.default_rng(1), wrong=0.5)
    placed = place_piece(way.odometry, way.queries, SETTINGS)
    assert placed.used.tolist() == (~way.is_wrong).tolist()
    rotation_deg, position_m = geometry.pose_error(placed.world_from_rig, way.world_from_rig)
    assert rotation_deg.max() < 1.0
    assert position_m.max() < 0.3
    assert set(placed.status) == {"ok"}


def test_odometry_does_not_pull_poses_that_are_better_than_it() -> None:
    """It did: poses good to 0.3 mm got the noise of the odometry, as all poses counted as good to 1 cm at best."""
    rng = np.random.default_rng(0)
    way = drive(rng)
    noise = np.stack([small_motion(rng, np.deg2rad(0.003), 0.0003) for _ in way.queries.frames])
    poses = way.world_from_rig[way.queries.frames] @ noise
    covariances = np.tile(np.diag(np.repeat([np.deg2rad(0.003), 0.0003], 3) ** 2), (len(poses), 1, 1))
    queries = replace(way.queries, world_from_rig=poses, covariances=covariances)
    placed = place_piece(way.odometry, queries, SETTINGS)
    _, alone = geometry.pose_error(poses, way.world_from_rig[queries.frames])
    _, joined = geometry.pose_error(placed.world_from_rig[queries.frames], way.world_from_rig[queries.frames])
    assert np.median(joined) < 1.15 * np.median(alone)


def test_the_stated_covariance_is_as_large_as_the_errors() -> None:
    chi2 = []
    for seed in range(12):
        way = drive(np.random.default_rng(seed), every=5)
        placed = place_piece(way.odometry, way.queries, SETTINGS)
        error = geometry.small_motions(geometry.invert(placed.world_from_rig) @ way.world_from_rig)
        chi2.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(placed.covariances), error))
    assert 4.0 < np.mean(chi2) < 8.0  # 6 degrees of freedom


@pytest.mark.parametrize("open_by_m", [10.0, 50.0, 1000.0])
def test_a_pose_that_is_open_in_one_direction_is_solved(open_by_m: float) -> None:
    """GTSAM found the system singular and ended the run: 50 m beside 0.1 mm is too much for float64."""
    way = drive(np.random.default_rng(2))
    covariance = np.diag(np.repeat([1e-4, 1e-2], 3) ** 2)
    covariance[5, 5] = open_by_m**2
    queries = replace(way.queries, covariances=np.tile(covariance, (len(way.queries), 1, 1)))
    placed = place_piece(way.odometry.part(slice(0, 2)), queries.part(slice(0, 2)), SETTINGS)
    assert np.isfinite(placed.world_from_rig).all()
    assert set(placed.reason) == {FAR}
    assert set(placed.status) == {Status.LOW_CONFIDENCE}


def test_a_pose_is_less_sure_the_farther_it_is_from_a_query() -> None:
    way = drive(np.random.default_rng(2))
    placed = place_piece(way.odometry, way.queries.choose(np.array([0])), SETTINGS)
    stds = np.sqrt(np.trace(placed.covariances[:, 3:, 3:], axis1=1, axis2=2))
    assert (np.diff(stds) > 0).all()


def test_far_from_a_query_a_pose_is_not_sure() -> None:
    way = drive(np.random.default_rng(0), frames=60)
    placed = place_piece(way.odometry, way.queries.choose(np.arange(3)), SequenceSettings())
    stds = np.sqrt(np.trace(placed.covariances[:, 3:, 3:], axis1=1, axis2=2))
    assert (stds < 0.2).any()
    assert (stds > 0.5).any()
    assert all((status == "ok") == (std <= 0.2) for status, std in zip(placed.status, stds, strict=True))
    assert set(placed.reason[placed.status != Status.OK]) == {FAR}


def test_a_piece_without_a_sure_query_says_so() -> None:
    way = drive(np.random.default_rng(3))
    nothing = place_piece(way.odometry, way.queries.choose(np.zeros(0, np.int64)), SETTINGS)
    assert all(status.startswith("failed") for status in nothing.status)
    assert np.isnan(nothing.world_from_rig).all()
    one = way.queries.choose(np.array([4]))
    doubtful = PosedQueries(one.frames, one.world_from_rig, one.covariances, one.weights, np.array([False]))
    placed = place_piece(way.odometry, doubtful, SETTINGS)
    assert all(status.startswith("low_confidence") for status in placed.status)
    assert np.isfinite(placed.world_from_rig).all()


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_a_device_that_stands_still_is_placed(frames: int) -> None:
    way = drive(np.random.default_rng(4))
    still = Odometry(np.arange(frames) * 33_333, np.tile(np.eye(4), (frames, 1, 1)))
    one = way.queries.choose(np.array([0]))
    placed = place_piece(still, one, SETTINGS)
    np.testing.assert_allclose(placed.world_from_rig, np.tile(one.world_from_rig[0], (frames, 1, 1)), atol=1e-6)


def test_a_wrong_scale_of_odometry_is_found() -> None:
    way = drive(np.random.default_rng(5), frames=80)
    placed = place_piece(way.odometry.scaled(1 / 1.04), way.queries, SETTINGS)
    assert placed.scale == pytest.approx(1.04, abs=0.01)
    assert geometry.pose_error(placed.world_from_rig, way.world_from_rig)[1].max() < 0.3


@pytest.mark.parametrize("scale", [0.3, 3.0, -1.0])
def test_odometry_that_contradicts_the_queries_takes_no_pose_from_them(scale: float) -> None:
    way = drive(np.random.default_rng(9))
    placed = place_piece(way.odometry.scaled(scale), way.queries, SETTINGS)  # -1: of a mirrored frame
    frames = way.queries.frames
    assert geometry.pose_error(placed.world_from_rig[frames], way.world_from_rig[frames])[1].max() < 0.3
    assert set(np.delete(placed.status, frames)) == {Status.LOW_CONFIDENCE}
    assert set(np.delete(placed.reason, frames)) == {"odometry contradicts the queries"}
    assert (placed.status[frames] == "ok").mean() > 0.8


def test_online_only_the_past_counts() -> None:
    way = drive(np.random.default_rng(7), wrong=0.3)
    asked = way.queries.frames
    whole = place_online(way.odometry, way.queries, asked, SequenceSettings(online=True))
    frame = int(asked[12])
    until = Odometry(way.odometry.timestamps[: frame + 1], way.odometry.odom_from_rig[: frame + 1])
    past = way.queries.choose(asked <= frame)
    alone = place_piece(until, past, with_measured_drift([(until, past)], SETTINGS))
    np.testing.assert_allclose(whole.world_from_rig[frame], alone.world_from_rig[-1], atol=1e-9)
    assert np.isnan(whole.world_from_rig[frame + 1]).all()  # not asked for
    assert whole.status[frame + 1] is None
    assert whole.used[12] == alone.used[-1]


def test_online_poses_rest_on_so_many_seconds() -> None:
    way = drive(np.random.default_rng(8))  # a frame a second, a query every other
    short = SequenceSettings(online=True, length_s=10.0)
    asked = np.array([5, 30])
    placed = place_online(way.odometry, way.queries, asked, short)
    harmed = way.queries.world_from_rig.copy()
    harmed[way.queries.frames < 20] = np.eye(4)
    others = PosedQueries(way.queries.frames, harmed, *list(vars(way.queries).values())[2:])
    again = place_online(way.odometry, others, asked, short)
    np.testing.assert_array_equal(placed.world_from_rig[30], again.world_from_rig[30])
    assert not np.allclose(placed.world_from_rig[5], again.world_from_rig[5])
    late = place_online(way.odometry, way.queries.choose(way.queries.frames < 15), asked, short)
    assert late.status[30].startswith("failed")
