"""Turn images, poses and pixel positions by quarter turns.

`k` is always a number of COUNTER-CLOCKWISE quarter turns of the image, as in `np.rot90`.
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
    """Return pixel positions (N, 2) of an image of this size as they are after k quarter turns, (N, 2).

    The center of the top-left pixel is (0.5, 0.5), before and after.
    """
    x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
    turned = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)][k % 4]
    return np.stack(turned, axis=-1)


def turned_from_cam(k: ArrayLike) -> Floats:
    """Return the pose of the camera in the coordinates of the camera after k quarter turns, (..., 4, 4).

    A turned image's pose is world_from_cam @ invert(turned_from_cam(k)).

    Args:
        k: quarter turns, any shape.
    """
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, 1], [-1, 0]]  # what pointed right points up, along -y
    return np.stack([np.linalg.matrix_power(quarter, turn) for turn in range(4)])[np.asarray(k) % 4]
