"""Odometry: its pieces, and the placements in the map that single queries vote for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.sequences.drifting import PLACE, Drive, drive, lost_in_a_gap
from toolkit import geometry
from toolkit.manifest import SequenceSettings
from toolkit.sequences.odometry import (
    Odometry,
    PosedQueries,
    cut,
    first_guess,
    fitted_scale,
    place,
    with_measured_drift,
)

SETTINGS = SequenceSettings()


def test_losses_of_tracking_end_a_piece() -> None:
    times = np.array([0, 1, 2, 20, 21, 22, 23], np.int64) * 1_000_000  # a gap of 18 s
    poses = np.tile(np.eye(4), (7, 1, 1))
    poses[:, 0, 3] = [0, 1, 2, 3, 4, 64, 65]  # a step of 60 m in a second
    assert Odometry(times, poses).split() == [slice(0, 3), slice(3, 5), slice(5, 7)]
    assert Odometry(times[:1], poses[:1]).split() == [slice(0, 1)]
    assert Odometry(times[:0], poses[:0]).split() == []


def walk(rate_hz: float, seconds: float = 40.0) -> Odometry:
    """Someone who walks, stops, walks faster and looks to both sides, as often as `rate_hz` says."""
    time = np.arange(0, seconds, 1 / rate_hz)
    speed = np.where((time > 10) & (time < 15), 0.0, np.where(time > 25, 2.5, 1.2))
    heading = 0.1 * time + 1.0 * np.sin(1.5 * time)
    places = np.cumsum(speed[:, None] / rate_hz * np.stack([np.cos(0.1 * time), np.sin(0.1 * time)], axis=1), axis=0)
    turns = Rotation.from_rotvec(np.stack([0 * time, 0 * time, heading], axis=1)).as_matrix()
    return Odometry((time * 1e6).astype(np.int64), geometry.make_pose(turns, np.pad(places, ((0, 0), (0, 1)))))


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 30.0])
def test_a_walk_is_one_piece(rate_hz: float) -> None:
    odometry = walk(rate_hz)
    assert odometry.split() == [slice(0, len(odometry))]
    missing = np.delete(np.arange(len(odometry)), np.arange(int(20 * rate_hz), int(24 * rate_hz)))
    silent = Odometry(odometry.timestamps[missing], odometry.odom_from_rig[missing])
    assert silent.split() == [slice(0, len(silent))]
    fast = Odometry(odometry.timestamps[:2], odometry.scaled(10.0).odom_from_rig[:2])
    assert fast.split() == [slice(0, 2)]


@pytest.mark.parametrize("rate_hz", [5.0, 30.0])
@pytest.mark.parametrize("at_s", [5.0, 12.0, 30.0])
def test_tracking_that_begins_again_where_the_device_is_is_a_loss(rate_hz: float, at_s: float) -> None:
    odometry, lost = walk(rate_hz), int(at_s * rate_hz)
    poses = odometry.odom_from_rig.copy()
    poses[lost:] = geometry.invert(poses[lost]) @ poses[lost:]
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 75
    assert Odometry(odometry.timestamps, poses).split() == [slice(0, lost), slice(lost, len(poses))]
    # A few decimeters are enough, or a turn on the spot.
    about = Rotation.from_rotvec([0.0, 0.0, 1.6]).as_matrix()
    for off in (geometry.make_pose(np.eye(3), [0.0, 1.0, 0.0]), geometry.make_pose(about, np.zeros(3))):
        poses = odometry.odom_from_rig.copy()
        poses[lost:] = poses[lost - 1] @ off @ geometry.invert(poses[lost]) @ poses[lost:]
        assert Odometry(odometry.timestamps, poses).split() == [slice(0, lost), slice(lost, len(poses))]


def test_drift_does_not_depend_on_the_number_of_steps() -> None:
    coarse = drive(np.random.default_rng(0), frames=11).odometry
    times = np.linspace(coarse.timestamps[0], coarse.timestamps[-1], 101).astype(np.int64)
    poses = np.tile(np.eye(4), (101, 1, 1))
    for axis in range(3):
        poses[:, axis, 3] = np.interp(times, coarse.timestamps, coarse.odom_from_rig[:, axis, 3])
    fine = Odometry(times, poses)
    first, last = np.array([0]), np.array([-1])
    np.testing.assert_allclose(fine.drift(SETTINGS, first, last), coarse.drift(SETTINGS, first, last), rtol=1e-6)
    steps = np.arange(100)
    of_steps = np.linalg.norm(fine.drift(SETTINGS, steps, steps + 1), axis=1)
    np.testing.assert_allclose(of_steps, np.ravel(fine.drift(SETTINGS, first, last)), rtol=1e-6)


def test_the_placement_with_the_most_support_comes_first() -> None:
    rng = np.random.default_rng(1)
    way = drive(rng, wrong=0.4)
    found = place(way.odometry, way.queries, SETTINGS)
    assert set(found[0].members.tolist()) == set(np.flatnonzero(~way.is_wrong).tolist())
    assert found[0].trusted
    assert found[0].support > 2 * found[0].rival_support
    members = np.concatenate([placement.members for placement in found])
    assert sorted(members.tolist()) == list(range(len(way.queries)))


def test_a_rival_as_likely_is_not_trusted() -> None:
    way = drive(np.random.default_rng(2), wrong=0.0)
    elsewhere = geometry.make_pose(np.eye(3), [30.0, 0.0, 0.0])  # a room that looks alike
    poses = way.queries.world_from_rig.copy()
    poses[::2] = elsewhere @ poses[::2]
    queries = PosedQueries(way.queries.frames, poses, *list(vars(way.queries).values())[2:])
    found = place(way.odometry, queries, SETTINGS)
    assert not found[0].trusted
    assert found[0].rival_support == pytest.approx(found[1].support)


@pytest.mark.parametrize(
    ("trusted", "count", "sure"), [(True, 1, True), (False, 1, False), (False, 2, False), (False, 3, True)]
)
def test_one_sure_query_or_three_that_agree_are_trusted(trusted: bool, count: int, sure: bool) -> None:
    way = drive(np.random.default_rng(3), wrong=0.0)
    some = way.queries.choose(np.arange(count))
    queries = PosedQueries(*list(vars(some).values())[:4], np.full(count, trusted))
    assert place(way.odometry, queries, SETTINGS)[0].trusted == sure


def test_look_alikes_are_not_trusted_however_many_agree() -> None:
    way = drive(np.random.default_rng(2), wrong=0.0)
    count = len(way.queries)
    weights, trusted = np.full(count, 0.51), np.zeros(count, bool)
    either = replace(way.queries, weights=weights, trusted=trusted)
    (alone,) = place(way.odometry, either, SETTINGS)
    assert len(alone.members) == count
    assert not alone.trusted
    poses = way.queries.world_from_rig.copy()
    poses[1:4] = geometry.make_pose(np.eye(3), [30.0, 0.0, 0.0]) @ poses[1:4]
    weights[0], trusted[0] = 0.99, True  # one that knows, against three that were led astray
    best = place(way.odometry, replace(either, world_from_rig=poses).choose(np.arange(4)), SETTINGS)[0]
    assert best.members.tolist() == [0]
    assert not best.trusted


def test_scale_is_fitted_as_far_as_queries_know_it() -> None:
    way = drive(np.random.default_rng(4), wrong=0.0)
    assert fitted_scale(way.odometry.scaled(1 / 1.03), way.queries, SETTINGS) == pytest.approx(1.03, abs=0.01)
    near = way.queries.choose(np.arange(2))
    vague = PosedQueries(near.frames, near.world_from_rig, 1e4 * near.covariances, near.weights, near.trusted)
    assert fitted_scale(way.odometry.scaled(1 / 1.03), vague, SETTINGS) == pytest.approx(1.0, abs=0.002)
    assert fitted_scale(way.odometry, near.choose(np.arange(1)), SETTINGS) == 1.0


def test_the_first_guess_follows_odometry_from_the_next_query() -> None:
    way: Drive = drive(np.random.default_rng(5), wrong=0.0, noise=0.0, drift=0.0)
    guess = first_guess(way.odometry, way.queries.choose(np.array([0, 3])))
    np.testing.assert_allclose(guess, way.world_from_rig, atol=1e-9)
    places = guess @ geometry.invert(way.odometry.odom_from_rig)
    np.testing.assert_allclose(places, np.tile(PLACE, (len(guess), 1, 1)), atol=1e-9)


@pytest.mark.parametrize("wrong", [0.0, 0.2])
@pytest.mark.parametrize("drift", [0.1, 1.0, 3.0, 10.0])
def test_drift_is_measured_by_the_queries(drift: float, wrong: float) -> None:
    ways = [drive(np.random.default_rng(seed), frames=80, every=4, wrong=wrong, drift=drift) for seed in range(3)]
    found = with_measured_drift([(way.odometry, way.queries) for way in ways], SETTINGS)
    factors = found.rotation_drift_deg / SETTINGS.rotation_drift_deg, found.position_drift / SETTINGS.position_drift
    if drift <= 1:
        assert 1.0 <= min(factors) <= max(factors) < 2.5  # never less than the settings say
    else:
        assert factors == pytest.approx([drift, drift], rel=0.7)
    doubtful = [(way.odometry, replace(way.queries, trusted=~way.queries.trusted)) for way in ways]
    assert with_measured_drift(doubtful, SETTINGS) == SETTINGS


def test_what_drift_is_measured_by() -> None:
    way = drive(np.random.default_rng(0), every=6, drift=5.0)
    few = way.queries.choose(np.arange(5))  # four motions, and three over two of them
    assert with_measured_drift([(way.odometry, few)], SETTINGS).rotation_drift_deg > 2 * SETTINGS.rotation_drift_deg
    assert with_measured_drift([(way.odometry, few.choose(np.arange(4)))], SETTINGS) == SETTINGS
    assert with_measured_drift([], SETTINGS) == SETTINGS
    still = replace(way.odometry, odom_from_rig=np.tile(np.eye(4), (len(way.odometry), 1, 1)))
    assert with_measured_drift([(still, way.queries)], SETTINGS).position_drift == SETTINGS.position_drift
    no_odometry = with_measured_drift([(way.odometry.scaled(30.0), way.queries)], SETTINGS)
    assert no_odometry.position_drift == pytest.approx(20 * SETTINGS.position_drift)


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_queries_tell_a_loss_of_tracking_that_no_step_shows(wrong: float) -> None:
    for seed in range(5):
        whole = drive(np.random.default_rng(seed), wrong=wrong)
        way = lost_in_a_gap(whole)
        assert way.odometry.split() == [slice(0, len(way.odometry))]
        assert cut(way.odometry, way.queries, SETTINGS) == [slice(0, 21), slice(21, 37)]
        assert cut(whole.odometry, whole.queries, SETTINGS) == [slice(0, 40)]
        doubtful = replace(way.queries, trusted=~way.queries.trusted)
        assert cut(way.odometry, doubtful, SETTINGS) == [slice(0, 37)]
    one_after = way.queries.choose(way.queries.frames <= way.queries.frames[way.queries.frames >= 21][0])
    assert cut(way.odometry, one_after, SETTINGS) == [slice(0, 37)], "it may be wrong"


def test_scale_is_fitted_where_drift_has_bent_the_way() -> None:
    way = drive(np.random.default_rng(6), frames=2000, every=10, drift=3.0)
    turned = geometry.pose_error(way.odometry.odom_from_rig[-1:], geometry.invert(PLACE) @ way.world_from_rig[-1:])[0]
    assert turned.item() > 5.0
    assert fitted_scale(way.odometry, way.queries, SETTINGS) == pytest.approx(1.0, abs=0.01)


def test_between_two_poses_motion_is_steady() -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix()
    poses = np.stack([np.eye(4), geometry.make_pose(turn, [1.0, 2.0, 0.0])])
    odometry = Odometry(np.array([0, 1_000_000]), poses)
    which, found = odometry.at(np.array([-1, 250_000, 0, 1_000_000, 1_000_001]))
    assert which.tolist() == [1, 2, 3]  # outside nothing is known
    expected = geometry.make_pose(Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix(), [0.25, 0.5, 0.0])
    np.testing.assert_allclose(found, [expected, *poses], atol=1e-12)
    every, order = odometry.joined(np.array([1_000_000, 250_000]), found[[2, 0]])
    assert order.tolist() == [0, 3, 1, 2]
    np.testing.assert_allclose(every.odom_from_rig, [poses[0], expected, poses[1], poses[1]], atol=1e-12)


def test_many_queries_are_compared_by_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    way = drive(np.random.default_rng(10), wrong=0.3)
    whole = place(way.odometry, way.queries, SETTINGS)
    monkeypatch.setattr("toolkit.sequences.odometry._PAIRS", 30)
    parts = place(way.odometry, way.queries, SETTINGS)
    assert [placement.members.tolist() for placement in parts] == [placement.members.tolist() for placement in whole]
