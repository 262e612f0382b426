"""The noise of a map's poses, from pairs with known matches."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.mapping.pose_noise import PosedPairs, PoseNoise, VerifiedPair

NOISE_OF_RAYS = 2e-4


def posed_pairs(seed: int, shifted: float, turn_deg: float = 0.0) -> PosedPairs:
    """Return nine pairs of views of a wall with windows, with a share of matches of a window with its neighbor.

    Args:
        turn_deg: standard deviation, per axis, of the noise of the stated rotations.
    """
    rng = np.random.default_rng(seed)
    pairs, poses = [], []
    for _ in range(9):
        first, second = np.eye(4), np.eye(4)
        second[:3, 3] = rng.uniform((-1.5, -0.3, -1), (1.5, 0.3, 2.0))
        points = rng.uniform((-3, -2, 12), (3, 2, 13.5), (100, 3))
        matched = points.copy()
        matched[: round(100 * shifted), :2] += (0.6 * rng.choice([-1, 1]), 0.5 * rng.choice([-1, 0, 1]))
        rays = geometry.unit(points), geometry.unit(matched - second[:3, 3])
        rays = tuple(geometry.unit(one + NOISE_OF_RAYS * rng.normal(size=one.shape)) for one in rays)
        pairs.append(VerifiedPair(len(poses), len(poses) + 1, *rays, np.eye(4)))
        for pose in (first, second):
            noise = Rotation.from_rotvec(np.radians(turn_deg) * rng.normal(size=3)).as_matrix()
            poses.append(pose @ geometry.make_pose(noise, (0, 0, 0)))
    return PosedPairs(pairs, np.array(poses))


@pytest.mark.parametrize("shifted", [0.0, 0.2, 0.45])
def test_windows_matched_with_their_neighbors_are_no_noise_of_exact_poses(shifted: float) -> None:
    """They made 0.6 deg of it: of a facade in ten photographs, 0.33 deg, so that deviations were 5 times too large."""
    for seed in range(4):
        assert posed_pairs(seed, shifted).noise(1.0) == PoseNoise()


def test_noise_is_measured_beside_wrong_matches() -> None:
    for shifted, max_deg in ((0.0, 0.45), (0.2, 0.6)):
        found = [posed_pairs(seed, shifted, turn_deg=0.3).noise(1.0) for seed in range(4)]
        assert 0.2 < np.median([noise.rotation_deg for noise in found]) < max_deg


def test_two_cameras_that_almost_have_one_center() -> None:
    """Those of a rig whose poses were found one by one; noise of matches made points within micrometers."""
    pairs, along = [], np.array([0.8, 0.5, 0.33])
    for seed in range(9):
        rng = np.random.default_rng(seed)
        points = rng.uniform((-3, -2, 12), (3, 2, 13.5), (100, 3))
        shifted = points + 0.1 * along * rng.normal(size=(100, 1))
        pairs.append(VerifiedPair(0, 1, geometry.unit(points), geometry.unit(shifted), np.eye(4)))
    poses = np.stack([np.eye(4), geometry.make_pose(np.eye(3), 1e-7 * along)])
    assert PosedPairs(pairs, poses).noise(1.0).position < 0.02
