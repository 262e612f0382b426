"""Map a view to the input image of a network and back."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.upright import turn_image, turn_points
from toolkit.geometry import Floats
from toolkit.pose.base import View
from toolkit.prediction.architectures import Layout, Size


def shown_size(view: View) -> Size:
    """Return the width and height of the upright photograph."""
    size = (view.camera.width, view.camera.height)
    return size[::-1] if view.turns % 2 else size


@dataclass(frozen=True)
class PlacedView:
    """A view and its place in the input image of the network."""

    view: View
    layout: Layout
    """Layout of its group."""
    number: int
    """Index in its group."""

    @property
    def size(self) -> Size:
        """(H, W) of the network image."""
        return self.layout.size

    @property
    def key(self) -> tuple[Path | int, Size, int]:
        """Cache key of its encoding. The size of the network image determines the place of the photograph in it."""
        image = self.view.image
        return image if isinstance(image, Path) else id(image), self.size, self.view.turns

    @property
    def map_from_image(self) -> Floats:
        """(4,) from the stored photograph to the network image turned back to its orientation, see `Prediction`."""
        camera, (height, width) = self.view.camera, self.size
        corners = np.array([[0, 0], [camera.width, camera.height]], np.float64)
        turned = turn_points(corners, camera.width, camera.height, self.view.turns)
        shown = turned * self.layout.scale[self.number] + self.layout.offset[self.number]
        first, last = turn_points(shown, width, height, -self.view.turns)
        scale = (last - first) / corners[1]
        return np.concatenate([scale, first])

    def turned_back(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Turn a map (H, W) of the network image back to the orientation of the stored photograph."""
        return turn_image(values, -self.view.turns)

    def intrinsics(self, K: Floats) -> Floats:
        """Convert K (3, 3) of the network image to K of the stored photograph, pixels."""
        height, width = self.size
        [center] = turn_points(K[None, :2, 2], width, height, -self.view.turns)
        scale, offset = self.map_from_image[:2], self.map_from_image[2:]
        focal = np.diag(K)[:2][:: -1 if self.view.turns % 2 else 1] / scale
        x, y = (center - offset) / scale
        return np.array([[focal[0], 0, x], [0, focal[1], y], [0, 0, 1]])

    @property
    def outside(self) -> NDArray[np.bool_]:
        """(H, W) mask of the pixels of the network image that the photograph does not cover."""
        scale, offset = self.layout.scale[self.number], self.layout.offset[self.number]
        ends = np.rint(np.array([offset, offset + scale * shown_size(self.view)])).astype(int)
        (left, top), (right, bottom) = np.maximum(ends, 0)
        outside = np.ones(self.size, bool)
        outside[top:bottom, left:right] = False
        return outside
