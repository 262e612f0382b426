"""Rotate images, poses and pixel positions by quarter turns.

`k` is always the number of COUNTER-CLOCKWISE quarter turns of the image, as in `np.rot90`.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.geometry import Floats


def turn_image(image: NDArray[Any], k: int) -> NDArray[Any]:
    """Return an image (H, W) or (H, W, 3) after k counter-clockwise quarter turns, contiguous; itself for k = 0."""
    import cv2

    codes = (cv2.ROTATE_90_COUNTERCLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_CLOCKWISE)
    image = np.ascontiguousarray(image)
    return image if k % 4 == 0 else cv2.rotate(image, codes[k % 4 - 1])


def turn_points(xy: ArrayLike, width: int, height: int, k: int) -> Floats:
    """Return the pixel positions (N, 2) after k quarter turns of an image of this size, (N, 2).

    The center of the top-left pixel is (0.5, 0.5), before and after.
    """
    x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
    turned = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)][k % 4]
    return np.stack(turned, axis=-1)


def turned_from_cam(k: ArrayLike) -> Floats:
    """Return turned_from_cam, (..., 4, 4): it maps camera coordinates to those of the camera after k quarter turns.

    The pose of a turned image is world_from_cam @ invert(turned_from_cam(k)).

    Args:
        k: quarter turns, any shape.
    """
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, 1], [-1, 0]]  # right becomes up (-y)
    return np.stack([np.linalg.matrix_power(quarter, turn) for turn in range(4)])[np.asarray(k) % 4]
