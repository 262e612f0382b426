"""Depth of a prediction, read where a photograph has it."""

import numpy as np

from toolkit.prediction.interface import Prediction


def test_depth_is_read_where_the_photograph_has_it() -> None:
    depth = np.arange(12, dtype=np.float32).reshape(1, 3, 4) + 1
    # Half the size, cut by 10 pixels at the top.
    prediction = Prediction(np.eye(4)[None], depth, map_from_image=np.array([[0.5, 0.5, 0.0, -10.0]]))
    xy = [[1, 21], [3, 21], [2, 21], [7, 25], [4, 23], [9, 21], [1, 19], [np.nan, 21]]
    np.testing.assert_allclose(prediction.depth_at(0, xy), [1, 2, 1.5, 12, 6.5, np.nan, np.nan, np.nan])


def test_depth_next_to_unknown_or_unsure_depth_is_unknown() -> None:
    depth = np.full((1, 4, 5), 2.0, np.float32)
    depth[0, 0, 0], depth[0, 0, 4] = np.nan, 0.0
    confidence = np.full((1, 4, 5), 3.0, np.float32)
    whole = np.array([[1.0, 1.0, 0.0, 0.0]])
    sure = Prediction(np.eye(4)[None], depth, confidence, whole)
    np.testing.assert_array_equal(sure.depth_at(0, [[1, 1], [4, 1], [2.5, 2.5]]), [np.nan, np.nan, 2])
    confidence[0, 3] = 1.0  # a quarter of the pixels
    confidence[0, 3, 4] = 0.9
    unsure = Prediction(np.eye(4)[None], depth, confidence, whole).depth_at(0, [[4.5, 3.5], [2.5, 2.5]])
    np.testing.assert_array_equal(unsure, [np.nan, 2])


def test_no_depth_is_unknown_depth() -> None:
    assert np.isnan(Prediction(np.eye(4)[None]).depth_at(0, [[1, 1], [2, 2]])).all()
