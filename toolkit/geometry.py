"""SE(3) and SO(3) on arrays, batched over leading dimensions.

Poses are `a_from_b`, (..., 4, 4) float64; quaternions are qw qx qy qz.
"""

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    import pycolmap

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Real = TypeVar("Real", np.float32, np.float64)


def unit(vectors: NDArray[Real], shortest: float = 1e-12) -> NDArray[Real]:
    """Return vectors (..., D) scaled to unit length, in their type; shorter ones than `shortest` are divided by it."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: NDArray[Real] = vectors / np.maximum(lengths, vectors.dtype.type(shortest))
    return units


def rounded(values: NDArray[Any], step: float) -> NDArray[np.float32]:
    """Return values rounded to multiples of `step`, a power of two: float32 sums such numbers exactly, in any order."""
    return np.asarray(np.rint(values / np.float32(step)) * np.float32(step), np.float32)


def quaternion_to_rotation(qwxyz: ArrayLike) -> Floats:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) of any length.

    Raise ValueError if the shape is wrong, or a quaternion is zero or not finite.
    """
    q = np.asarray(qwxyz, np.float64)
    if q.shape[-1:] != (4,):
        raise ValueError(f"Expected quaternions of shape (..., 4), got {q.shape}.")
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.isfinite(norm)) or np.any(norm < 1e-12):
        raise ValueError("A quaternion is zero or not finite; expected qw qx qy qz of length 1.")
    w, x, y, z = np.moveaxis(unit(q), -1, 0)
    elements = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return np.stack(elements, axis=-1).reshape(*q.shape[:-1], 3, 3)


def rotation_to_quaternion(rotation: ArrayLike) -> Floats:
    """Return unit quaternions (..., 4), qw >= 0, of rotation matrices (..., 3, 3); raise ValueError for another shape.

    Each is computed from its largest component (Shepperd 1978), which is exact also at 180 degrees. SciPy's conversions
    round differently, in both directions, and would change the last digits of poses in files.
    """
    R = np.asarray(rotation, np.float64)
    if R.shape[-2:] != (3, 3):
        raise ValueError(f"Expected rotations of shape (..., 3, 3), got {R.shape}.")
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    a, b, c = R[..., 2, 1], R[..., 0, 2], R[..., 1, 0]
    d, e, f = R[..., 1, 2], R[..., 2, 0], R[..., 0, 1]
    # Row k is 4 * q_k * q: each row is the quaternion up to scale.
    elements = [
        *(1 + m00 + m11 + m22, a - d, b - e, c - f),
        *(a - d, 1 + m00 - m11 - m22, c + f, b + e),
        *(b - e, c + f, 1 - m00 + m11 - m22, a + d),
        *(c - f, b + e, a + d, 1 - m00 - m11 + m22),
    ]
    rows = np.stack(elements, axis=-1).reshape(*R.shape[:-2], 4, 4)
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    return np.where(q[..., :1] < 0, -unit(q), unit(q))


def pose_from_qt(qt: ArrayLike) -> Floats:
    """Return poses (..., 4, 4) of rows qw qx qy qz tx ty tz, (..., 7)."""
    qt = np.asarray(qt, np.float64)
    return make_pose(quaternion_to_rotation(qt[..., :4]), qt[..., 4:7])


def qt_from_pose(pose: ArrayLike) -> Floats:
    """Return rows qw qx qy qz tx ty tz, (..., 7), of poses (..., 4, 4)."""
    pose = np.asarray(pose, np.float64)
    return np.concatenate([rotation_to_quaternion(pose[..., :3, :3]), pose[..., :3, 3]], axis=-1)


def make_pose(rotation: ArrayLike, translation: ArrayLike) -> Floats:
    """Return a_from_b, (..., 4, 4), with a rotation (..., 3, 3) and a translation (..., 3)."""
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    pose = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rotation, translation, 1.0
    return pose


FAR = 1e4
"""Distance from the origin beyond which coordinates (UTM, ECEF) are shifted before numbers are squared."""


def local_origin(points: ArrayLike) -> Floats:
    """Return a point (3,) near the middle of points (N, 3) that are `FAR` away, in whole hundreds; else zero.

    Numerical results depend a little on the frame, so a local one is the same wherever a world is shifted to.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    return 100 * np.round(middle / 100) if np.abs(middle).max() > FAR else np.zeros(3)


def shifted(a_from_b: ArrayLike, offset: ArrayLike) -> Floats:
    """Return poses (..., 4, 4) with an offset (3,), in frame a, added to their translations."""
    poses = np.array(a_from_b, np.float64)
    poses[..., :3, 3] += np.asarray(offset, np.float64)
    return poses


def scaled(poses: Floats, factor: float) -> Floats:
    """Return poses (..., 4, 4) with their translations multiplied by a factor."""
    return make_pose(poses[..., :3, :3], factor * poses[..., :3, 3])


def invert(a_from_b: ArrayLike) -> Floats:
    """Return b_from_a, (..., 4, 4), of rigid poses a_from_b, (..., 4, 4)."""
    pose = np.asarray(a_from_b, np.float64)
    Rt = np.swapaxes(pose[..., :3, :3], -1, -2)
    return make_pose(Rt, -(Rt @ pose[..., :3, 3:])[..., 0])


def transform(a_from_b: ArrayLike, points_in_b: ArrayLike) -> Floats:
    """Return points in frame a, (..., N, 3), given in frame b, (..., N, 3)."""
    pose, points = np.asarray(a_from_b, np.float64), np.asarray(points_in_b, np.float64)
    return points @ np.swapaxes(pose[..., :3, :3], -1, -2) + pose[..., None, :3, 3]


def rotation_angle_deg(rotation: ArrayLike) -> Floats:
    """Return the angle, degrees in [0, 180], of rotations (..., 3, 3); NaN for NaN.

    Computed by atan2 of the skew part and the trace, which is exact near 0, unlike arccos of the trace.
    """
    R = np.asarray(rotation, np.float64)
    skew = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    trace = np.trace(R, axis1=-2, axis2=-1)
    return np.degrees(np.arctan2(np.linalg.norm(skew, axis=-1), trace - 1.0))


def pose_error(world_from_estimated: ArrayLike, world_from_true: ArrayLike) -> tuple[Floats, Floats]:
    """Return the rotation error, degrees, and the translation error, meters, of poses (..., 4, 4).

    Defined as in the LaMAR benchmark: rotation angle and translation length of inverse(estimated) @ true.
    """
    estimated_from_true = invert(world_from_estimated) @ np.asarray(world_from_true, np.float64)
    distance_m = np.linalg.norm(estimated_from_true[..., :3, 3], axis=-1)
    return rotation_angle_deg(estimated_from_true[..., :3, :3]), distance_m


def small_motions(poses: Floats) -> Floats:
    """Return rotation vectors, radians, and translations (n, 6) of poses (n, 4, 4): SO(3) x R^3.

    For small poses, this is equal to the logarithm of SE(3) to first order.
    """
    from scipy.spatial.transform import Rotation

    return np.hstack([Rotation.from_matrix(poses[:, :3, :3]).as_rotvec(), poses[:, :3, 3]])


def project(points: Floats, camera: "pycolmap.Camera", world_from_cam: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the pixels (n, 2) of world points (n, 3), NaN behind the camera, and which are valid, (n,) bool."""
    in_cam = transform(invert(world_from_cam), points)
    front = in_cam[:, 2] > 1e-3
    pixels = np.full((len(points), 2), np.nan)
    if front.any():
        pixels[front] = camera.img_from_cam(in_cam[front])
    return pixels, front & np.isfinite(pixels).all(1)


def unique_columns(numbers: Ints) -> tuple[Ints, ...]:
    """Return the unique columns of non-negative integers (R, K), in ascending order, as R arrays."""
    shape = tuple((numbers.max(axis=1, initial=0) + 1).tolist())
    # Each column becomes one number, as `np.unique` takes five times as long with an axis.
    return np.unravel_index(np.unique(np.ravel_multi_index(tuple(numbers), shape)), shape)
