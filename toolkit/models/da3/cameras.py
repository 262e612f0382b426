"""Pose encodings of Depth Anything 3.

The encoding of a camera has nine numbers like VGGT's, but with the inverse pose: translation and quaternion (x, y, z,
w, of any length) of `world_from_cam`, then the vertical and horizontal field of view in radians. The principal point is
the image's center.
"""

import numpy as np
from numpy.typing import ArrayLike

from toolkit.geometry import Floats, invert, make_pose
from toolkit.models.vggt.pose_encoding import cameras_from_pose_encoding as vggt_cameras

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
