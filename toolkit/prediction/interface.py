"""The output of a feed-forward network for a group of views, and the interface that localizers use."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.geometry import Floats
from toolkit.pose.base import View

LOW_CONFIDENCE = 0.2
"""Share of the depths of a view, the least confident ones, that are not used."""


@dataclass(frozen=True)
class Prediction:
    """Cameras and depth of the S views of one group, in a frame `model` with an arbitrary unit."""

    model_from_cams: Floats
    """(S, 4, 4); NaN where unknown."""
    depth: Sequence[NDArray[np.float32]] | NDArray[np.float32] | None = None
    """S arrays (h, w) along the optical axis, in units of the model; NaN where unknown."""
    depth_conf: Sequence[NDArray[np.float32]] | NDArray[np.float32] | None = None
    """S arrays (h, w), larger is more confident."""
    map_from_image: Floats | None = None
    """(S, 4) scale_x, scale_y, offset_x, offset_y of each view, from pixels of the photograph to pixels of the depth
    map; the center of the top-left pixel is (0.5, 0.5) in both."""
    intrinsics: Floats | None = None
    """(S, 3, 3) K in pixels of the photographs; NaN where unknown."""
    reason: str = ""
    """Why the cameras are missing, if known."""

    def depth_at(self, view: int, xy: ArrayLike) -> Floats:
        """Return the depth (N,), in units of the model, at pixels (N, 2) of the photograph.

        The depth is bilinearly interpolated. It is NaN outside the depth map, if one of the four neighbors is unknown
        or not positive, and if the nearest one is among the least confident of the view (`LOW_CONFIDENCE`).
        """
        pixels = np.asarray(xy, np.float64).reshape(-1, 2)
        if self.depth is None or self.map_from_image is None:
            return np.full(len(pixels), np.nan)
        depth = np.where(self.depth[view] > 0, self.depth[view], np.nan).astype(np.float64)
        size = np.array(depth.shape[::-1])
        at = pixels * self.map_from_image[view, :2] + self.map_from_image[view, 2:]
        inside = np.asarray((np.isfinite(at) & (at >= 0) & (at <= size)).all(axis=1))
        at = np.clip(np.where(inside[:, None], at, 0.0) - 0.5, 0, size - 1)
        low = np.minimum(at.astype(np.int64), np.maximum(size - 2, 0))
        high = np.minimum(low + 1, size - 1)
        (x, y), (x0, y0), (x1, y1) = (at - low).T, low.T, high.T
        upper = depth[y0, x0] * (1 - x) + depth[y0, x1] * x
        lower = depth[y1, x0] * (1 - x) + depth[y1, x1] * x
        interpolated = np.where(inside, upper * (1 - y) + lower * y, np.nan)
        if self.depth_conf is not None:
            confidence = self.depth_conf[view]
            column, row = np.rint(at).astype(np.int64).T
            interpolated[confidence[row, column] < np.nanquantile(confidence, LOW_CONFIDENCE)] = np.nan
        return interpolated


class Predictor(Protocol):
    """A network that predicts cameras, or its simulation."""

    name: str
    simulated: bool
    """Whether it looks up the ground truth. Poses that depend on it are labeled and are no results."""

    @property
    def settings(self) -> dict[str, Any]:
        """Everything besides the views that the predictions depend on; part of the fingerprint of the poses."""

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        """Return a prediction for each group of views, the query's first; groups do not influence each other."""
