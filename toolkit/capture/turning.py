"""Turn images, intrinsics, poses and pixel positions by quarter turns.

`k` is always a number of COUNTER-CLOCKWISE quarter turns of the image, as in `np.rot90`.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import ToolkitError
from toolkit.geometry import Array

if TYPE_CHECKING:
    import pycolmap

# Distortion terms with a direction in the image: pairs of indices into the parameters, of the x and y of a vector.
# OpenCV's p1, p2 are such a vector in the order p2, p1, as its equations show.
DIRECTED: dict[str, list[tuple[int, int]]] = {
    "SIMPLE_PINHOLE": [], "PINHOLE": [], "SIMPLE_RADIAL": [], "RADIAL": [], "FOV": [], "EUCM": [],
    "SIMPLE_DIVISION": [], "DIVISION": [], "SIMPLE_FISHEYE": [], "FISHEYE": [],
    "SIMPLE_RADIAL_FISHEYE": [], "RADIAL_FISHEYE": [], "OPENCV_FISHEYE": [],
    "OPENCV": [(7, 6)],
    "FULL_OPENCV": [(7, 6)],
    "THIN_PRISM_FISHEYE": [(7, 6), (10, 11)],
    "RAD_TAN_THIN_PRISM_FISHEYE": [(10, 11), (12, 14), (13, 15)],
}  # fmt: skip


def turn_image(image: NDArray[Any], k: int) -> NDArray[Any]:
    """Return an image (H, W) or (H, W, 3) after k counter-clockwise quarter turns, contiguous; itself for k = 0."""
    import cv2

    codes = (cv2.ROTATE_90_COUNTERCLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_CLOCKWISE)
    image = np.ascontiguousarray(image)
    return image if k % 4 == 0 else cv2.rotate(image, codes[k % 4 - 1])


def turn_points(xy: ArrayLike, width: int, height: int, k: int) -> Array:
    """Return pixel positions (N, 2) of an image of this size as they are after k quarter turns, (N, 2).

    The center of the top-left pixel is (0.5, 0.5), before and after.
    """
    x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
    turned = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)][k % 4]
    return np.stack(turned, axis=-1)


def turned_from_cam(k: ArrayLike) -> Array:
    """Return the pose of the camera in the coordinates of the camera after k quarter turns, (..., 4, 4).

    A turned image's pose is world_from_cam @ invert(turned_from_cam(k)).

    Args:
        k: quarter turns, any shape.
    """
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, 1], [-1, 0]]  # what pointed right points up, along -y
    return np.stack([np.linalg.matrix_power(quarter, turn) for turn in range(4)])[np.asarray(k) % 4]


def turn_camera(camera: "pycolmap.Camera", k: int) -> "pycolmap.Camera":
    """Return the intrinsics, with distortion, of the image after k quarter turns.

    Raises:
        ToolkitError: the camera model has no turned version, as EQUIRECTANGULAR.
    """
    import pycolmap

    vectors = DIRECTED.get(camera.model_name)
    if vectors is None:
        raise ToolkitError(
            f"Found camera model {camera.model_name}, whose images cannot be turned by 90 degrees; expected one of "
            f"{', '.join(DIRECTED)}. Set `upright: false` for this capture, or undistort its images."
        )
    params, width, height = np.array(camera.params, np.float64), camera.width, camera.height
    focal, center = list(camera.focal_length_idxs()), list(camera.principal_point_idxs())
    params[center] = turn_points(params[center], width, height, k)
    if k % 2:
        params[focal] = params[focal[::-1]]
        width, height = height, width
    vector_turn = turned_from_cam(k)[:2, :2]
    for pair in vectors:
        params[list(pair)] = vector_turn @ params[list(pair)]
    turned = pycolmap.Camera(model=camera.model_name, width=width, height=height, params=params + 0.0)
    turned.camera_id = camera.camera_id
    turned.has_prior_focal_length = camera.has_prior_focal_length
    return turned
