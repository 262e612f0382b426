"""Noisy poses of a map, refined by bundle adjustment."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.capture import Capture, Trajectory
from toolkit.features.features import SiftExtractor
from toolkit.features.stores import FeatureStore
from toolkit.manifest import MapSettings
from toolkit.mapping.build import build_map
from toolkit.mapping.local_map import LocalMap

REFINE = MapSettings(refine_poses=True)


def rebuilt(capture: Path, features: Path, path: Path, settings: MapSettings) -> LocalMap:
    session = Capture.open(capture)["ios_map"]
    store = FeatureStore.of_session(features, session.id, SiftExtractor().settings)
    return build_map(session, store, path, settings)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 5e6], ids=["near", "utm"])
def test_noise_of_poses_is_removed_and_the_map_stays_where_it_was(
    small_capture: Path, small_features: Path, tmp_path: Path, shift: float
) -> None:
    capture = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    path = capture / "sessions" / "ios_map" / "trajectories.txt"
    exact, rng = Trajectory.read(path), np.random.default_rng(0)
    noisy = exact.world_from_device
    turns = Rotation.from_rotvec(rng.normal(0, 0.5, (len(noisy), 3)), degrees=True)
    noisy[:, :3, :3] = noisy[:, :3, :3] @ turns.as_matrix()
    noisy[:, :3, 3] += rng.normal(0, 0.02, (len(noisy), 3)) + shift
    path.unlink()
    Trajectory.from_poses(exact.timestamps, exact.arrow_ids, noisy).write(path)
    given = rebuilt(capture, small_features, tmp_path / "given.npz", MapSettings())
    refined = rebuilt(capture, small_features, tmp_path / "refined.npz", REFINE)
    truth = Capture.open(small_capture)["ios_map"].world_from_cam()
    errors = [geometry.pose_error(geometry.shifted(one.world_from_cams, -shift), truth) for one in (given, refined)]
    assert np.median(errors[1][0]) < 0.4 * np.median(errors[0][0])
    assert np.median(errors[1][1]) < 0.7 * np.median(errors[0][1]), "of this, the shift of all positions remains"
    assert len(refined.points) > len(given.points)
    assert refined.consistency.rotation_noise_deg < 0.3 * given.consistency.rotation_noise_deg


@pytest.mark.slow
def test_exact_poses_stay_as_they_are(small_capture: Path, small_features: Path, tmp_path: Path) -> None:
    refined = rebuilt(small_capture, small_features, tmp_path / "refined.npz", REFINE)
    given = rebuilt(small_capture, small_features, tmp_path / "given.npz", MapSettings())
    np.testing.assert_array_equal(refined.world_from_cams, given.world_from_cams)
    np.testing.assert_array_equal(refined.points, given.points)
