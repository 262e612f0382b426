"""A piece of a recording, whose doubtful queries are localized again."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.sequences.drifting import Drive, drive
from toolkit import geometry
from toolkit.manifest import SequenceSettings
from toolkit.pose.base import QueryResult, RoughPose, Status
from toolkit.sequences.odometry import PosedQueries
from toolkit.sequences.pose_graph import STEPS, localize_pieces, with_relocalized

pytest.importorskip("gtsam")
SETTINGS = SequenceSettings()
SURE = np.diag(np.repeat([1e-3, 0.01], 3) ** 2)


def answer(way: Drive, frame: int, status: str = "ok") -> QueryResult:
    return QueryResult(Status(status), "", way.world_from_rig[frame], SURE)


def test_what_failed_or_contradicts_is_asked_again_and_then_counts() -> None:
    way = drive(np.random.default_rng(0), wrong=0.25)
    asked = np.append(way.queries.frames, 39)  # the last has no pose
    seen: list[int] = []

    def relocalize(todo: Sequence[tuple[int, RoughPose]]) -> list[QueryResult]:
        seen.extend(frame for frame, _ in todo)
        for frame, about in todo:
            rotation_deg, distance_m = geometry.pose_error(about.world_from_rig, way.world_from_rig[frame])
            assert rotation_deg < 4 * about.rotation_std_deg
            assert distance_m < 4 * about.position_std
        return [answer(way, frame) for frame, _ in todo]

    before = localize_pieces(way.odometry, way.queries, asked, SETTINGS)
    done = localize_pieces(way.odometry, way.queries, asked, SETTINGS, relocalize)
    assert seen == [*way.queries.frames[way.is_wrong], 39]
    assert list(done.relocalized) == seen
    first, second = (
        geometry.pose_error(each.placed.world_from_rig[seen], way.world_from_rig[seen])[1] for each in (before, done)
    )
    assert second.max() < 0.03 < first.max()
    assert tuple(done.steps) == STEPS
    np.testing.assert_array_equal(done.steps["graph"], before.placed.world_from_rig[asked])
    np.testing.assert_array_equal(done.steps["again"][-1], way.world_from_rig[39])
    assert np.isnan(before.steps["again"][-1]).all()
    votes = geometry.invert(done.steps["voted"]) @ way.world_from_rig[asked]
    assert np.linalg.norm(votes[:, :3, 3], axis=1).max() < 2.0


def test_what_is_found_again_has_no_vote_of_its_own() -> None:
    way = drive(np.random.default_rng(1))
    every = with_relocalized(way.queries, {1: answer(way, 1)})
    assert every.frames.tolist() == sorted([*way.queries.frames, 1])
    assert every.weights[every.frames == 1].tolist() == [0.0]
    assert not every.trusted[every.frames == 1].any()


def test_a_pose_that_agrees_replaces_the_first_and_another_stands_beside_it() -> None:
    way = drive(np.random.default_rng(2))
    frame = int(way.queries.frames[3])
    same = with_relocalized(way.queries, {frame: answer(way, frame)})
    assert len(same) == len(way.queries)
    np.testing.assert_array_equal(same.world_from_rig[3], way.world_from_rig[frame])
    np.testing.assert_array_equal(same.covariances[3], SURE)
    assert same.weights.tolist() == way.queries.weights.tolist()
    far = replace(answer(way, frame), world_from_rig=geometry.make_pose(np.eye(3), [500.0, 0.0, 0.0]))
    both = with_relocalized(way.queries, {frame: far})
    assert (both.frames == frame).sum() == 2
    for nothing in (QueryResult.failed("too few matches"), QueryResult(Status.LOW_CONFIDENCE, "", np.eye(4))):
        assert len(with_relocalized(way.queries, {1: nothing})) == len(way.queries)


def test_an_answer_that_contradicts_the_others_changes_nothing() -> None:
    way = drive(np.random.default_rng(3))
    far = QueryResult(Status.OK, "", geometry.make_pose(np.eye(3), [500.0, 0.0, 0.0]), SURE)
    asked = np.append(way.queries.frames, 39)
    alone = localize_pieces(way.odometry, way.queries, asked, SETTINGS)
    done = localize_pieces(way.odometry, way.queries, asked, SETTINGS, lambda todo: [far for _ in todo])
    np.testing.assert_allclose(done.placed.world_from_rig, alone.placed.world_from_rig, atol=1e-6)
    assert not done.placed.used[done.queries.frames == 39].any()


def test_a_piece_without_a_pose_is_not_searched_for() -> None:
    way = drive(np.random.default_rng(4))
    nothing: PosedQueries = way.queries.choose(np.zeros(0, np.int64))

    def relocalize(todo: Sequence[tuple[int, RoughPose]]) -> list[QueryResult]:
        raise AssertionError

    done = localize_pieces(way.odometry, nothing, np.array([3, 5]), SETTINGS, relocalize)
    assert all(status.startswith("failed") for status in done.placed.status)
    assert np.isnan(done.steps["voted"]).all()


def test_online_a_query_is_found_again_from_the_past_alone() -> None:
    way = drive(np.random.default_rng(5))
    settings = SequenceSettings(online=True)
    queries = way.queries.choose(way.queries.frames < 20)
    rough: dict[int, RoughPose] = {}

    def relocalize(todo: Sequence[tuple[int, RoughPose]]) -> list[QueryResult]:
        rough.update(todo)
        return [answer(way, frame) for frame, _ in todo]

    asked = np.array([10, 25, 30])
    done = localize_pieces(way.odometry, queries, asked, settings, relocalize)
    assert sorted(rough) == [25, 30]
    later = queries.choose(queries.frames < 12)
    localize_pieces(way.odometry, later, np.array([10, 11]), settings, relocalize)
    assert geometry.pose_error(done.placed.world_from_rig[30], way.world_from_rig[30])[1] < 0.05
    assert np.isfinite(done.placed.world_from_rig[25]).all()
