"""Map a view to the input image of a network and back, and choose the cameras that are inputs of the network."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.turning import turn_image, turn_points, turned_from_cam
from toolkit.geometry import Floats, invert
from toolkit.localizers.architectures import Layout, Size
from toolkit.localizers.base import View

LEAST_REFERENCES = 6
"""Fewest references for which poses are inputs; with fewer, less than three would be left to align and confirm."""


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
    def shown_intrinsics(self) -> Floats:
        """K (3, 3) of the camera in the network image, pixels, without distortion."""
        sideways = self.view.turns % 2
        K = self.view.camera.calibration_matrix()
        scale, offset = self.map_from_image[:2], self.map_from_image[2:]
        unturned_width, unturned_height = self.size if sideways else self.size[::-1]
        [center] = turn_points(K[None, :2, 2] * scale + offset, unturned_width, unturned_height, self.view.turns)
        focal = (np.diag(K)[:2] * scale)[:: -1 if sideways else 1]
        return np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])

    @property
    def shown_from_world(self) -> Floats | None:
        """(4, 4) from the world to the camera of the network image; None if the pose is unknown."""
        world_from_cam = self.view.world_from_cam
        return None if world_from_cam is None else turned_from_cam(self.view.turns) @ invert(world_from_cam)

    @property
    def outside(self) -> NDArray[np.bool_]:
        """(H, W) mask of the pixels of the network image that the photograph does not cover."""
        scale, offset = self.layout.scale[self.number], self.layout.offset[self.number]
        ends = np.rint(np.array([offset, offset + scale * shown_size(self.view)])).astype(int)
        (left, top), (right, bottom) = np.maximum(ends, 0)
        outside = np.ones(self.size, bool)
        outside[top:bottom, left:right] = False
        return outside


def conditioned_views(group: Sequence[PlacedView]) -> NDArray[np.bool_]:
    """Return the views (S,) of a group, query first, whose poses are inputs: every other reference from the best on."""
    posed = [number for number, placed in enumerate(group) if number and placed.view.world_from_cam is not None]
    conditioned = np.zeros(len(group), bool)
    if len(posed) >= LEAST_REFERENCES:
        conditioned[posed[::2]] = True
    return conditioned


def input_cameras(group: Sequence[PlacedView]) -> tuple[Floats, Floats]:
    """Return the input cameras of a group: cam_from_world (S, 4, 4), NaN for views without, and K (S, 3, 3) of all."""
    poses = np.full((len(group), 4, 4), np.nan)
    for number in np.flatnonzero(conditioned_views(group)).tolist():
        poses[number] = group[number].shown_from_world
    return poses, np.stack([placed.shown_intrinsics for placed in group])
