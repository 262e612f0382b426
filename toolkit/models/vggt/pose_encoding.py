"""Cameras from VGGT's pose encoding, and points from depth.

The encoding of a camera has nine numbers: translation and quaternion (x, y, z, w, of any length) of `cam_from_world`,
then the vertical and horizontal field of view in radians. The principal point is the image's center. "World" is VGGT's
frame, close to that of the first view, in an arbitrary unit.
"""

import numpy as np
from numpy.typing import ArrayLike

from toolkit.geometry import Floats, quaternion_to_rotation


def cameras_from_pose_encoding(pose_enc: ArrayLike, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return `cam_from_world` (..., 3, 4) and intrinsics K (..., 3, 3), pixels, of pose encodings (..., 9).

    A field of view of 0 gives an infinite focal length; the network returns 0 for negative fields of view.

    Args:
        pose_enc: (..., 9), an array or a tensor on the CPU.
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


def unproject_depth(depth: ArrayLike, cam_from_world: ArrayLike, intrinsics: ArrayLike) -> Floats:
    """Return the world point of each pixel of depth maps, (S, H, W, 3).

    As in the official code, the center of the top-left pixel is (0, 0) here. Elsewhere in this toolkit it is (0.5,
    0.5): subtract 0.5 from the principal points of such cameras first.

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
    # Multiplying row vectors by R applies the inverse rotation.
    return np.einsum("shwi,sij->shwj", in_camera - pose[:, None, None, :3, 3], pose[:, :3, :3])
