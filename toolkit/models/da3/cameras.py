"""Pose encodings of Depth Anything 3.

The encoding of a camera has nine numbers like VGGT's, but with the inverse pose: translation and quaternion (x, y, z,
w, of any length) of `world_from_cam`, then the vertical and horizontal field of view in radians. The principal point is
the image's center.
"""

import numpy as np
from numpy.typing import ArrayLike

from toolkit.geometry import Floats, invert, make_pose, rotation_to_quaternion
from toolkit.models.vggt.pose_encoding import cameras_from_pose_encoding as vggt_cameras

_LEAST_DISTANCE = 0.1  # in the unit of the given poses
_LEAST_TANGENT = 1e-6


def cameras_from_pose_encoding(pose_enc: ArrayLike, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return `cam_from_world` (..., 3, 4) and intrinsics K (..., 3, 3), pixels, of pose encodings (..., 9).

    As in the official code, the tangent of half a field of view is at least 1e-6, so that focal lengths are finite.

    Args:
        pose_enc: (..., 9), an array or a tensor on the CPU.
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
        intrinsics: K, (..., 3, 3), image pixels; only the focal lengths are used.
        size: (H, W) of the images.
    """
    pose, K = np.asarray(cam_from_world, np.float64), np.asarray(intrinsics, np.float64)
    world_from_cam = invert(pose)
    qwxyz = rotation_to_quaternion(world_from_cam[..., :3, :3])
    fields = 2 * np.arctan(np.array(size) / 2 / K[..., [1, 0], [1, 0]])
    return np.concatenate([world_from_cam[..., :3, 3], qwxyz[..., [1, 2, 3, 0]], fields], axis=-1)


def normalized_poses(cam_from_world: ArrayLike) -> Floats:
    """Return poses (S, 4, 4) relative to the first camera, in a normalized unit, for poses (S, 3 or 4, 4).

    As in the official interface, the unit is the median distance of the cameras from the first, but at least 0.1. The
    median includes the first camera; for an even number of cameras it is the smaller of the two middle distances.
    """
    pose = np.asarray(cam_from_world, np.float64)
    from_world = make_pose(pose[:, :3, :3], pose[:, :3, 3])
    from_first = from_world @ invert(from_world[0])
    distances = np.sort(np.linalg.norm(from_first[:, :3, 3], axis=-1))
    from_first[:, :3, 3] /= max(distances[(len(distances) - 1) // 2], _LEAST_DISTANCE)
    return from_first
