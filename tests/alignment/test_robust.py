"""The mean of several poses: known answers, what must not matter, wrong hypotheses, calibration."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.alignment.robust import PoseMean, robust_mean_pose

NOISE = np.diag([np.radians(1.0) ** 2 / 3] * 3 + [0.05**2 / 3] * 3)


def mean_of(poses: np.ndarray) -> PoseMean:
    """Return the mean of hypotheses that are as exact as those of `scattered`."""
    return robust_mean_pose(poses, np.stack([NOISE] * len(poses)))


def random_poses(count: int, seed: int, spread_m: float = 2.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return geometry.make_pose(Rotation.random(count, rng=rng).as_matrix(), rng.normal(0, spread_m, (count, 3)))


def scattered(count: int, seed: int, noise_m: float = 0.05, noise_deg: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng, pose = np.random.default_rng(seed), random_poses(1, seed)[0]
    turns = Rotation.from_rotvec(rng.normal(0, np.radians(noise_deg) / np.sqrt(3), (count, 3))).as_matrix()
    return pose, pose @ geometry.make_pose(turns, rng.normal(0, noise_m / np.sqrt(3), (count, 3)))


def test_mean_of_equal_poses_is_that_pose() -> None:
    pose = random_poses(1, 40)[0]
    for count in (1, 2, 7):
        mean = mean_of(np.stack([pose] * count))
        np.testing.assert_allclose(mean.world_from_cam, pose, atol=1e-12)
        assert mean.consistent.all()
        assert (np.linalg.eigvalsh(mean.covariance) > 0).all()
        assert mean.reason == ""


def test_mean_of_two_poses_is_half_way() -> None:
    first = geometry.make_pose(np.eye(3), [0, 0, 0])
    second = geometry.make_pose(Rotation.from_euler("z", 2, degrees=True).as_matrix(), [0.04, 0, 0])
    mean = mean_of(np.stack([first, second])).world_from_cam
    np.testing.assert_allclose(mean[:3, :3], Rotation.from_euler("z", 1, degrees=True).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(mean[:3, 3], [0.02, 0, 0], atol=1e-9)


def test_mean_follows_a_change_of_the_world_and_the_order() -> None:
    _, poses = scattered(7, 41)
    poses[3:5] = random_poses(2, 42)
    mean, new_from_world, order = mean_of(poses), random_poses(1, 43)[0], [3, 1, 5, 0, 2, 6, 4]
    moved = mean_of(new_from_world @ poses[order])
    np.testing.assert_allclose(moved.world_from_cam, new_from_world @ mean.world_from_cam, atol=1e-9)
    np.testing.assert_allclose(moved.covariance, mean.covariance, atol=1e-9)
    np.testing.assert_array_equal(moved.consistent, mean.consistent[order])


def test_mean_leaves_out_what_is_far() -> None:
    pose, poses = scattered(8, 44)
    poses[[0, 5, 7]] = random_poses(3, 45, spread_m=5)
    mean = mean_of(poses)
    np.testing.assert_array_equal(np.flatnonzero(mean.consistent), [1, 2, 3, 4, 6])
    degrees, meters = geometry.pose_error(mean.world_from_cam, pose)
    assert degrees < 2
    assert meters < 0.1
    assert "0, 5, 7 left out: far" in mean.reason


def test_two_camps_of_poses_and_opposite_rotations_are_undecided() -> None:
    _, first = scattered(3, 46)
    _, second = scattered(3, 47)
    mean = mean_of(np.concatenate([first, second]))
    assert mean.consistent.tolist() in ([True] * 3 + [False] * 3, [False] * 3 + [True] * 3)
    assert np.isinf(np.diagonal(mean.covariance)).all()
    assert "undecided" in mean.reason
    opposite = np.stack([np.eye(4), geometry.make_pose(np.diag([1.0, -1, -1]), np.zeros(3))])
    mean = mean_of(opposite)
    assert mean.consistent.sum() == 1
    assert np.isinf(np.diagonal(mean.covariance)).all()


@pytest.mark.parametrize("count", [4, 12])
def test_covariance_of_the_mean_is_calibrated(count: int) -> None:
    ratios = []
    for seed in range(100):
        pose, poses = scattered(count, 100 + seed)
        mean = mean_of(poses)
        error = geometry.invert(mean.world_from_cam) @ pose
        vector = np.concatenate([Rotation.from_matrix(error[:3, :3]).as_rotvec(), error[:3, 3]])
        ratios.append(vector @ np.linalg.solve(mean.covariance, vector) / 6)
    assert 0.5 < np.mean(ratios) < 1.5


def test_covariances_weigh_and_are_widened_to_the_spread() -> None:
    first, second = np.eye(4), geometry.make_pose(np.eye(3), [0.3, 0, 0])
    exact_one, loose = np.diag([1e-4] * 3 + [1e-2] * 3), np.diag([1e-4] * 3 + [9e-2] * 3)
    mean = robust_mean_pose([first, second], covariances=[exact_one, loose])
    np.testing.assert_allclose(mean.world_from_cam[:3, 3], [0.03, 0, 0], atol=1e-9)
    together = np.linalg.inv(np.linalg.inv(exact_one) + np.linalg.inv(loose))
    np.testing.assert_allclose(mean.covariance, together, rtol=1e-9)
    _, poses = scattered(10, 48)
    square = np.diag([np.radians(0.6) ** 2 / 3] * 3 + [0.03**2 / 3] * 3)
    widened = robust_mean_pose(poses, covariances=np.stack([square] * 10))
    assert 1.5 < np.trace(widened.covariance) / np.trace(square / 10) < 5
