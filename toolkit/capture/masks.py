"""Which images of a map a query may show, by what is known before the images are compared."""

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import Floats


def near(
    world_from_cams: Floats, world_from_cam: Floats, distance_m: float, angle_deg: float = 180.0
) -> NDArray[np.bool_]:
    """Return which of N map cameras could see what a camera at a roughly known pose sees, (N,) bool.

    Roll about the viewing direction does not count: it moves what is seen only within the image.

    Args:
        world_from_cams: (N, 4, 4) of the map, OpenCV axes; one that is NaN is not near.
        world_from_cam: (4, 4) of the query, in the map's frame.
        distance_m: most distance between the camera centers, in the unit of the poses.
        angle_deg: most angle between the viewing directions (z axes).
    """
    distance = np.linalg.norm(world_from_cams[:, :3, 3] - world_from_cam[:3, 3], axis=1)
    forward = world_from_cams[:, :3, 2], world_from_cam[:3, 2]
    # atan2 is exact near 0 and 180 degrees, where the arccos of rounded numbers is not.
    sine, cosine = np.linalg.norm(np.cross(*forward), axis=1), forward[0] @ forward[1]
    with np.errstate(invalid="ignore"):
        return np.asarray((distance <= distance_m) & (np.degrees(np.arctan2(sine, cosine)) <= angle_deg))
