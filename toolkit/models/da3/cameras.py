"""Cameras as Depth Anything 3 takes and returns them.

The encoding of a camera has nine numbers, as VGGT's, but of the inverse pose: translation and quaternion (x, y, z, w,
of any length) of `world_from_cam`, then the vertical and the horizontal field of view in radians. The principal point
is the image's center.
"""

import numpy as np
from numpy.typing import ArrayLike

from toolkit.geometry import Floats, invert, make_pose, rotation_to_quaternion
from toolkit.models.vggt.pose_encoding import cameras_from_pose_encoding as vggt_cameras

_LEAST_DISTANCE = 0.1
_LEAST_TANGENT = 1e-6


def cameras_from_pose_encoding(pose_enc: ArrayLike, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return `cam_from_world` (..., 3, 4) and intrinsics K (..., 3, 3), pixels, of pose encodings (..., 9).

    As officially, half a field of view has a tangent of at least 1e-6, so that focal lengths are finite.

    Args:
        pose_enc: (..., 9), numbers or a tensor on the CPU.
        size: (H, W) of the images.

    Raises:
        ValueError: not 9 numbers, or a quaternion is zero or not finite.
    """
    encoding = np.asarray(pose_enc, np.float64).copy()
    half = encoding[..., 7:] / 2
    encoding[..., 7:] = np.where(np.tan(half) < _LEAST_TANGENT, 2 * _LEAST_TANGENT, 2 * half)
    world_from_cam, intrinsics = vggt_cameras(encoding, size)
    return invert(make_pose(world_from_cam[..., :3], world_from_cam[..., 3]))[..., :3, :], intrinsics


def pose_encoding(cam_from_world: ArrayLike, intrinsics: ArrayLike, size: tuple[int, int]) -> Floats:
    """Return pose encodings (..., 9) of cameras.

    Args:
        cam_from_world: (..., 3, 4) or (..., 4, 4).
        intrinsics: K, (..., 3, 3), pixels of the images; the principal point is not read.
        size: (H, W) of the images.
    """
    pose, K = np.asarray(cam_from_world, np.float64), np.asarray(intrinsics, np.float64)
    world_from_cam = invert(pose)
    qwxyz = rotation_to_quaternion(world_from_cam[..., :3, :3])
    fields = 2 * np.arctan(np.array(size) / 2 / K[..., [1, 0], [1, 0]])
    return np.concatenate([world_from_cam[..., :3, 3], qwxyz[..., [1, 2, 3, 0]], fields], axis=-1)


def normalized_poses(cam_from_world: ArrayLike) -> Floats:
    """Return poses (S, 4, 4) in the frame of the first camera, and in a unit of their own, of poses (S, 3 or 4, 4).

    The unit is the median distance of the cameras (the first included, of the two middle ones of an even number the
    smaller) from the first, but at least 0.1, as in the official interface.
    """
    pose = np.asarray(cam_from_world, np.float64)
    from_world = make_pose(pose[:, :3, :3], pose[:, :3, 3])
    from_first = from_world @ invert(from_world[0])
    distances = np.sort(np.linalg.norm(from_first[:, :3, 3], axis=-1))
    from_first[:, :3, 3] /= max(distances[(len(distances) - 1) // 2], _LEAST_DISTANCE)
    return from_first
