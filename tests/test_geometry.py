"""Poses on arrays: round trips, known answers, and the rotations where formulas break."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit import geometry


def random_poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return geometry.make_pose(Rotation.random(count, random_state=seed).as_matrix(), rng.normal(0, 10, (count, 3)))


def test_quaternion_of_known_rotations() -> None:
    half = np.sqrt(0.5)
    about_z_90 = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # x goes to y
    np.testing.assert_allclose(geometry.quaternion_to_rotation([half, 0, 0, half]), about_z_90, atol=1e-15)
    about_x_90 = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # y goes to z
    np.testing.assert_allclose(geometry.quaternion_to_rotation([half, half, 0, 0]), about_x_90, atol=1e-15)
    np.testing.assert_array_equal(geometry.quaternion_to_rotation([1, 0, 0, 0]), np.eye(3))


def test_rotations_are_those_of_scipy() -> None:
    q = np.random.default_rng(1).normal(size=(5, 20, 4))
    expected = Rotation.from_quat(q.reshape(-1, 4)[:, [1, 2, 3, 0]]).as_matrix().reshape(5, 20, 3, 3)
    np.testing.assert_allclose(geometry.quaternion_to_rotation(q), expected, atol=1e-14)


def test_quaternions_need_not_be_unit_and_come_back_unit_and_positive() -> None:
    q = np.random.default_rng(2).normal(size=(200, 4))
    back = geometry.rotation_to_quaternion(geometry.quaternion_to_rotation(1e-6 * q))
    unit = q / np.linalg.norm(q, axis=1, keepdims=True) * np.sign(q[:, :1])
    np.testing.assert_allclose(back, unit, atol=1e-14)
    assert (back[:, 0] >= 0).all()


@pytest.mark.parametrize("angle_deg", [180.0, 179.9999999, 1e-7, 1e-12, 90.0, 120.0])
def test_quaternion_round_trip_where_formulas_break(angle_deg: float) -> None:
    axes = np.vstack([np.eye(3), -np.eye(3), [[1, 1, 1], [1, -1, 0], [0.1, 1e-9, 3]]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    half = np.radians(angle_deg) / 2
    R = geometry.quaternion_to_rotation(np.column_stack([np.full(len(axes), np.cos(half)), np.sin(half) * axes]))
    q = geometry.rotation_to_quaternion(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(geometry.quaternion_to_rotation(q), R, atol=1e-15)
    # The vector part keeps its full precision, also of tiny angles: up to the sign at 180 degrees.
    found = q[:, 1:] * np.sign((q[:, 1:] * axes).sum(1, keepdims=True))
    np.testing.assert_allclose(found, np.sin(half) * axes, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-9, 1e-4, 0.03, 45.0, 90.0, 179.0, 180.0])
def test_rotation_angle(angle_deg: float) -> None:
    axis = np.array([1.0, -2.0, 0.5])
    R = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
    assert geometry.rotation_angle_deg(R) == pytest.approx(angle_deg, rel=1e-9, abs=1e-14)
    assert geometry.rotation_angle_deg(R.T) == pytest.approx(angle_deg, rel=1e-9, abs=1e-14)


@pytest.mark.parametrize(("bad", "named"), [
    *((bad, "quaternion") for bad in ([0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1])),
    ([[1, 0, 0, 0], [0, 0, 0, 0]], "quaternion"),
    ([1, 0, 0], r"\(\.\.\., 4\)"),
    (np.eye(4), r"\(\.\.\., 3, 3\)"),
])  # fmt: skip
def test_what_is_no_rotation_is_refused(bad: list | np.ndarray, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        geometry.quaternion_to_rotation(bad) if isinstance(bad, list) else geometry.rotation_to_quaternion(bad)


def test_pose_rows_round_trip_in_any_number_of_dimensions() -> None:
    poses = random_poses(24).reshape(2, 3, 4, 4, 4)
    rows = geometry.qt_from_pose(poses)
    assert rows.shape == (2, 3, 4, 7)
    np.testing.assert_allclose(geometry.pose_from_qt(rows), poses, atol=1e-14)
    np.testing.assert_array_equal(rows[..., 4:], poses[..., :3, 3])
    assert geometry.pose_from_qt(np.zeros((0, 7))).shape == (0, 4, 4)
    assert geometry.qt_from_pose(np.zeros((0, 4, 4))).shape == (0, 7)


def test_inverse_and_composition_are_those_of_matrices() -> None:
    a, b = random_poses(50, 1), random_poses(50, 2)
    np.testing.assert_allclose(geometry.invert(a), np.linalg.inv(a), atol=1e-12)
    np.testing.assert_allclose(geometry.invert(a @ b), geometry.invert(b) @ geometry.invert(a), atol=1e-12)
    points = np.random.default_rng(3).normal(size=(50, 7, 3))
    homogeneous = np.concatenate([points, np.ones((50, 7, 1))], -1)
    expected = np.einsum("nij,npj->npi", a @ b, homogeneous)[..., :3]
    np.testing.assert_allclose(geometry.transform(a, geometry.transform(b, points)), expected, atol=1e-12)


def test_transform_broadcasts_one_set_of_points_over_many_poses() -> None:
    poses, points = random_poses(4), np.random.default_rng(0).normal(size=(5, 3))
    moved = geometry.transform(poses, points)
    assert moved.shape == (4, 5, 3)
    np.testing.assert_allclose(moved[2], points @ poses[2, :3, :3].T + poses[2, :3, 3], atol=1e-13)
    assert geometry.transform(poses[0], np.zeros((0, 3))).shape == (0, 3)


def test_make_pose_broadcasts() -> None:
    poses = geometry.make_pose(np.eye(3), np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(poses[1], [[1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]])


def test_pose_error_of_answers_by_hand() -> None:
    true = geometry.make_pose(Rotation.from_euler("y", 90, degrees=True).as_matrix(), [10.0, -4.0, 2.0])
    assert geometry.pose_error(true, true) == (0.0, 0.0)
    # A turn about the estimate's own axes leaves its place: the errors are independent.
    turned = true @ geometry.make_pose(Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.zeros(3))
    rotation_deg, distance_m = geometry.pose_error(turned, true)
    assert rotation_deg == pytest.approx(30)
    assert distance_m == pytest.approx(0, abs=1e-12)
    moved = true.copy()
    moved[:3, 3] += [3, 0, 4]
    rotation_deg, distance_m = geometry.pose_error(moved, true)
    assert rotation_deg == pytest.approx(0, abs=1e-12)
    assert distance_m == pytest.approx(5)
    upside_down = true @ np.diag([1.0, -1, -1, 1])
    assert geometry.pose_error(upside_down, true)[0] == pytest.approx(180)


def test_pose_error_of_many_and_of_missing_poses() -> None:
    true = random_poses(3)
    estimated = true.copy()
    estimated[1] = np.nan  # how a missing pose looks in a table
    estimated[2, 0, 3] += 2
    rotation_deg, distance_m = geometry.pose_error(estimated, true)
    assert np.isnan(rotation_deg[1])
    assert np.isnan(distance_m[1])
    np.testing.assert_allclose(distance_m[[0, 2]], [0, 2], atol=1e-12)
    # Symmetric, though only the distance is obviously so.
    np.testing.assert_allclose(geometry.pose_error(true, estimated)[0][[0, 2]], rotation_deg[[0, 2]], atol=1e-9)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 90.0, 179.9999, 180.0])
def test_a_motion_is_the_rotation_vector_and_the_translation_of_its_pose(angle_deg: float) -> None:
    vector, shift = np.radians(angle_deg) * np.array([0.6, 0.0, 0.8]), [1.0, -2.0, 3.0]
    motion = geometry.small_motions(geometry.make_pose([Rotation.from_rotvec(vector).as_matrix()], shift))
    np.testing.assert_allclose(motion, [[*vector, *shift]], atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_unit_vectors_keep_their_type_and_zero_stays_zero(dtype: type) -> None:
    unit = geometry.unit(np.array([[[3, 4], [0, 0]]], dtype))
    assert unit.dtype == dtype
    np.testing.assert_allclose(unit, [[[0.6, 0.8], [0, 0]]], atol=1e-7)
    assert 0 < geometry.unit(np.array([1e-9, 0], dtype), shortest=1.0)[0] < 1e-8
