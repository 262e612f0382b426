"""Which retrieved images are shown to a network: similar, seeing the same, and apart."""

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.prediction.feed_forward import select_references

Floats = NDArray[np.float64]
CAMERA = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])


def cameras_at(*places: tuple[float, float, float], yaw_deg: tuple[float, ...] = ()) -> Floats:
    """Return world_from_cam (N, 4, 4) of cameras that look along z, turned about y."""
    yaws = [*yaw_deg, *[0.0] * (len(places) - len(yaw_deg))]
    turns = Rotation.from_rotvec([[0.0, np.radians(yaw), 0.0] for yaw in yaws])
    return geometry.make_pose(turns.as_matrix(), np.array(places))


def choose(scores: list[float], poses: Floats, k: int, **more: object) -> list[int]:
    return select_references(scores, poses, k, [CAMERA] * len(scores), **more).tolist()  # type: ignore[arg-type]


def test_near_duplicates_come_last() -> None:
    poses = cameras_at((0, 0, 0), (0.02, 0, 0), (0, 0.03, 0), (1.2, 0, 0), (-1.2, 0, 0))
    assert choose([0.9, 0.89, 0.88, 0.6, 0.5], poses, 3) == [0, 3, 4]
    assert set(choose([0.9, 0.89, 0.88, 0.6, 0.5], poses, 5)[3:]) == {1, 2}


def test_a_near_duplicate_is_relative_to_the_depth() -> None:
    poses = cameras_at((0, 0, 0), (0.1, 0, 0), (0.3, 0, 0))
    assert choose([0.9, 0.8, 0.5], poses, 2, depth_m=10.0) == [0, 2]
    assert choose([0.9, 0.8, 0.5], poses, 2, depth_m=0.4) == [0, 1]


def test_an_image_of_another_place_comes_last() -> None:
    poses = cameras_at((0, 0, 0), (500, 0, 0), (1, 0, 0), (-1, 0, 0))
    assert choose([0.9, 0.85, 0.5, 0.4], poses, 4) == [0, 2, 3, 1]


def test_the_best_score_is_not_first_where_it_alone_is_elsewhere() -> None:
    poses = cameras_at((0, 0, 0), (1, 0, 0), (300, 0, 0))
    assert choose([0.7, 0.6, 0.9], poses, 3)[0] == 0
    # Nobody shares a view with anybody: then the scores decide.
    poses = cameras_at((0, 0, 0), (100, 0, 0), (300, 0, 0))
    assert choose([0.7, 0.6, 0.9], poses, 3) == [2, 0, 1]


def test_an_image_that_looks_away_comes_last() -> None:
    poses = cameras_at((0, 0, 0), (1, 0, 0), (0.5, 0, 0), yaw_deg=(0, 180, 5))
    assert choose([0.9, 0.8, 0.3], poses, 3) == [0, 2, 1]


def test_a_wall_between_is_seen_by_the_points_that_are_not_shared() -> None:
    poses = cameras_at((0, 0, 0), (1, 0, 0), (-1, 0, 0))
    shared = np.array([[90, 0, 80], [0, 90, 0], [80, 0, 90]])
    assert choose([0.9, 0.6, 0.6], poses, 2, shared_points=shared) == [0, 2]
    assert choose([0.9, 0.6, 0.6], poses, 2) == [0, 1]  # equals are taken in order


@pytest.mark.parametrize(("k", "count"), [(0, 0), (1, 1), (3, 3), (10, 3)])
def test_as_many_as_asked_and_there(k: int, count: int) -> None:
    poses = cameras_at((0, 0, 0), (1, 0, 0), (2, 0, 0))
    found = choose([0.1, 0.3, 0.2], poses, k)
    assert len(found) == len(set(found)) == count


def test_none_of_none() -> None:
    assert choose([], np.zeros((0, 4, 4)), 5) == []


def test_without_a_pose_or_a_score_an_image_is_never_chosen() -> None:
    poses = cameras_at((0, 0, 0), (1, 0, 0), (2, 0, 0), (1, 1, 0))
    poses[0] = np.nan
    assert choose([0.9, 0.5, np.nan, 0.4], poses, 4) == [1, 3]
    poses[:] = np.nan
    assert choose([0.9, 0.5, 0.3, 0.4], poses, 4) == []


def test_one_place_for_all_still_gives_as_many() -> None:
    poses = cameras_at(*[(0, 0, 0)] * 4, yaw_deg=(0, 5, 10, 15))
    assert sorted(choose([0.4, 0.9, 0.2, 0.3], poses, 4)) == [0, 1, 2, 3]


def test_the_choice_does_not_depend_on_the_order_or_the_world() -> None:
    rng = np.random.default_rng(0)
    poses = geometry.make_pose(
        Rotation.from_rotvec(rng.normal(size=(12, 3)) * 0.2).as_matrix(), rng.normal(size=(12, 3)) * 2
    )
    scores = rng.random(12)
    found = choose(scores.tolist(), poses, 6)
    order = rng.permutation(12)
    assert order[choose(scores[order].tolist(), poses[order], 6)].tolist() == found
    elsewhere = geometry.make_pose(Rotation.random(random_state=1).as_matrix(), [100.0, -50.0, 7.0])
    assert choose(scores.tolist(), elsewhere @ poses, 6) == found
    assert choose((scores * 3 + 1).tolist(), poses, 6) == found
