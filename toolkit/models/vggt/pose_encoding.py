"""Cameras as VGGT encodes them, and points from depth.

Nine numbers a camera: translation and quaternion (x, y, z, w, of any length) of `cam_from_world`, then the vertical
and the horizontal field of view, radians. The principal point is the image's center. "World" is VGGT's own frame,
near that of the first view, in a unit of its own.
"""

import numpy as np
from numpy.typing import ArrayLike

from toolkit.geometry import Array, quaternion_to_rotation, rotation_to_quaternion


def cameras_from_pose_encoding(pose_enc: ArrayLike, size: tuple[int, int]) -> tuple[Array, Array]:
    """Return `cam_from_world` (..., 3, 4) and intrinsics K (..., 3, 3), pixels, of pose encodings (..., 9).

    A field of view of 0, to which the network clamps negative ones, gives an infinite focal length.

    Args:
        pose_enc: (..., 9), numbers or a tensor on the CPU.
        size: (H, W) of the images.

    Raises:
        ValueError: not 9 numbers, or a quaternion is zero or not finite.
    """
    encoding = np.asarray(pose_enc, np.float64)
    if encoding.shape[-1:] != (9,):
        raise ValueError(f"pose encodings have shape {encoding.shape}; expected (..., 9).")
    rotation = quaternion_to_rotation(encoding[..., [6, 3, 4, 5]])
    height, width = size
    intrinsics = np.zeros((*encoding.shape[:-1], 3, 3))
    with np.errstate(divide="ignore"):
        intrinsics[..., 0, 0] = width / 2 / np.tan(encoding[..., 8] / 2)
        intrinsics[..., 1, 1] = height / 2 / np.tan(encoding[..., 7] / 2)
    intrinsics[..., 0, 2], intrinsics[..., 1, 2], intrinsics[..., 2, 2] = width / 2, height / 2, 1.0
    return np.concatenate([rotation, encoding[..., :3, None]], axis=-1), intrinsics


def pose_encoding_from_cameras(cam_from_world: ArrayLike, intrinsics: ArrayLike, size: tuple[int, int]) -> Array:
    """Return pose encodings (..., 9), the quaternion of length 1 with w >= 0.

    The encoding has no place for a principal point: that of `intrinsics` is lost.

    Args:
        cam_from_world: (..., 3, 4) or (..., 4, 4).
        intrinsics: K, (..., 3, 3), pixels.
        size: (H, W) of the images.
    """
    pose, K = np.asarray(cam_from_world, np.float64), np.asarray(intrinsics, np.float64)
    quaternion = rotation_to_quaternion(pose[..., :3, :3])[..., [1, 2, 3, 0]]
    height, width = size
    fields = 2 * np.arctan(np.stack([height / 2 / K[..., 1, 1], width / 2 / K[..., 0, 0]], axis=-1))
    return np.concatenate([pose[..., :3, 3], quaternion, fields], axis=-1)


def unproject_depth(depth: ArrayLike, cam_from_world: ArrayLike, intrinsics: ArrayLike) -> Array:
    """Return the world points (S, H, W, 3) that depth maps show.

    As in the official code the center of the first pixel is (0, 0) here, not (0.5, 0.5) as elsewhere in this toolkit:
    for cameras of that convention, take 0.5 from their principal points first.

    Args:
        depth: (S, H, W) or (S, H, W, 1), along the camera's z.
        cam_from_world: (S, 3, 4) or (S, 4, 4).
        intrinsics: K, (S, 3, 3), pixels.
    """
    z = np.asarray(depth, np.float64)
    z = z[..., 0] if z.ndim == 4 else z
    pose, K = np.asarray(cam_from_world, np.float64), np.asarray(intrinsics, np.float64)
    v, u = np.indices(z.shape[1:])
    focal, center = K[:, None, None, [0, 1], [0, 1]], K[:, None, None, :2, 2]
    rays = (np.stack([u, v], axis=-1) - center) / focal
    in_camera = np.concatenate([rays * z[..., None], z[..., None]], axis=-1)
    # Rows of points times R: the inverse rotation of each.
    return np.einsum("shwi,sij->shwj", in_camera - pose[:, None, None, :3, 3], pose[:, :3, :3])
