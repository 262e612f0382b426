"""Masks of map images: what is known of a query before images are compared."""

import numpy as np
from scipy.spatial.transform import Rotation

from toolkit.capture.masks import near
from toolkit.geometry import make_pose


def turned(axis: str, angle_deg: float, at: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    return make_pose(Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix(), at)


def test_cameras_near_a_pose_stand_close_and_look_a_similar_way() -> None:
    query = turned("y", 30, (1, 2, 3))
    cams = np.stack([
        query,
        turned("y", 30, (1, 2, 5)),
        turned("y", 30, (1, 2, 5.001)),
        turned("y", 74, (1, 2, 3)),
        turned("y", 76, (1, 2, 3)),
        turned("y", 210, (1, 2, 3)),
        query @ turned("z", 90),
        np.full((4, 4), np.nan),
    ])  # fmt: skip
    assert near(cams, query, 2, 45).tolist() == [True, True, False, True, False, False, True, False]
    assert near(cams, query, 2).tolist() == [True, True, False, True, True, True, True, False]
    assert near(cams[:1], query, 0, 0).tolist() == [True], "the pose itself"
    assert near(cams, np.full((4, 4), np.nan), 2).sum() == 0
    assert near(cams[:0], query, 2).shape == (0,)
