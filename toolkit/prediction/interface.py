"""Feed-forward networks for a group of views: the output, the interface that localizers use, the supported networks,
and how each places the views of a group in its input images.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.images import turn_image, turn_points
from toolkit.errors import WeightsError
from toolkit.geometry import Floats
from toolkit.models import weights
from toolkit.models.weights import WeightsSource
from toolkit.pose.base import View

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from toolkit.models.multiview import Layout

LOW_CONFIDENCE = 0.2
"""Share of the depths of a view, the least confident ones, that are not used."""
Size = tuple[int, int]
HEADS = ("camera", "depth")


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
    """(S, 4) scale_x, scale_y, offset_x, offset_y of each view, from pixels of the image to pixels of the depth
    map; the center of the top-left pixel is (0.5, 0.5) in both."""
    intrinsics: Floats | None = None
    """(S, 3, 3) K in pixels of the images; NaN where unknown."""
    reason: str = ""
    """Why the cameras are missing, if known."""

    def depth_at(self, view: int, xy: ArrayLike) -> Floats:
        """Return the depth (N,), in units of the model, at pixels (N, 2) of the image.

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


# Supported networks


def shown_size(view: View) -> Size:
    """Return the width and height of the upright image."""
    size = (view.camera.width, view.camera.height)
    return size[::-1] if view.turns % 2 else size


@dataclass(frozen=True)
class PlacedView:
    """A view and its place in the input image of the network; maps between both."""

    view: View
    layout: "Layout"
    """Layout of its group."""
    number: int
    """Index in its group."""

    @property
    def size(self) -> Size:
        """(H, W) of the network image."""
        return self.layout.size

    @property
    def key(self) -> tuple[Path | int, Size, int]:
        """Cache key of its encoding. The size of the network image determines the place of the stored image in it."""
        image = self.view.image
        return image if isinstance(image, Path) else id(image), self.size, self.view.turns

    @property
    def map_from_image(self) -> Floats:
        """(4,) from the stored image to the network image turned back to its orientation, see `Prediction`."""
        camera, (height, width) = self.view.camera, self.size
        corners = np.array([[0, 0], [camera.width, camera.height]], np.float64)
        turned = turn_points(corners, camera.width, camera.height, self.view.turns)
        shown = turned * self.layout.scale[self.number] + self.layout.offset[self.number]
        first, last = turn_points(shown, width, height, -self.view.turns)
        scale = (last - first) / corners[1]
        return np.concatenate([scale, first])

    def turned_back(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Turn a map (H, W) of the network image back to the orientation of the stored image."""
        return turn_image(values, -self.view.turns)

    def intrinsics(self, K: Floats) -> Floats:
        """Convert K (3, 3) of the network image to K of the stored image, pixels."""
        height, width = self.size
        [center] = turn_points(K[None, :2, 2], width, height, -self.view.turns)
        scale, offset = self.map_from_image[:2], self.map_from_image[2:]
        focal = np.diag(K)[:2][:: -1 if self.view.turns % 2 else 1] / scale
        x, y = (center - offset) / scale
        return np.array([[focal[0], 0, x], [0, focal[1], y], [0, 0, 1]])

    @property
    def outside(self) -> NDArray[np.bool_]:
        """(H, W) mask of the pixels of the network image that the stored image does not cover."""
        scale, offset = self.layout.scale[self.number], self.layout.offset[self.number]
        ends = np.rint(np.array([offset, offset + scale * shown_size(self.view)])).astype(int)
        (left, top), (right, bottom) = np.maximum(ends, 0)
        outside = np.ones(self.size, bool)
        outside[top:bottom, left:right] = False
        return outside


@dataclass
class Architecture:
    """A network that predicts cameras and depth of the views of one scene."""

    name: str
    """Name of the predictor in the settings."""
    title: str
    """Name in messages."""
    module: str
    """Module in `toolkit.models`; imported only where it is used, as it imports torch."""
    network: str
    """Class of the network in the module."""
    weights: WeightsSource
    mode: str
    """Mode of the module's image loader."""
    portrait_mode: str = ""
    """Mode for a group with an image in portrait format; empty: `mode`."""
    channels: int | None = None
    """Channels of the network, if the module has several sizes."""

    def lay_out(self, sizes: Sequence[Size]) -> "Layout":
        """Return the layout of images of these sizes (width, height), at least one."""
        portrait = any(height > width for width, height in sizes)
        mode = self.portrait_mode if portrait and self.portrait_mode else self.mode
        layout: Layout = self._imported.LOADER.lay_out(sizes, mode)
        return layout

    def load(self, checkpoint: Path, dtype: "torch.dtype") -> Any:
        """Return the network, on the CPU; raise WeightsError if the file does not belong to it.

        It has `encode(images)` and is called as `network(images, heads, tokens)`, which returns the outputs of its
        heads.
        """
        network = getattr(self._imported, self.network).from_checkpoint(checkpoint, heads=HEADS, compute_dtype=dtype)
        if self.channels not in (None, network.channels):
            fault = f"these are weights with {network.channels} channels, not {self.title}, which has {self.channels}"
            raise WeightsError(f"{checkpoint}: {fault}. Correct `{self.weights.setting}`, or the predictor's name.")
        return network

    def read(self, image: Path | NDArray[np.uint8], layout: "Layout") -> "tuple[Tensor, Size]":
        """Return the network image (3, H, W) of an image, and the (width, height) of the image; raise ImageError as
        `read_image`.

        An image smaller than the images of its group gets a white border; a larger one is cropped to its middle.
        """
        from toolkit.models.multiview import centered

        loaded = self._imported.load_images([image], layout.mode)
        width, height = loaded.sizes[0].tolist()
        return centered(loaded.images[0], layout.size), (width, height)

    def cameras(self, encoding: ArrayLike, size: Size) -> tuple[Floats, Floats]:
        """Return `cam_from_model` (..., 3, 4) and K (..., 3, 3) in pixels of network images of size (H, W)."""
        cameras: tuple[Floats, Floats] = self._imported.cameras_from_pose_encoding(encoding, size)
        return cameras

    @property
    def _imported(self) -> Any:
        return import_module(f"toolkit.models.{self.module}")


ARCHITECTURES = {
    architecture.name: architecture
    for architecture in (
        # "crop" would cut an image of a phone in portrait format to its middle 75 % (3:4) or 56 % (9:16). "pad" keeps
        # all of it, in an image of the same 518 x 518. For landscape images "crop" cuts nothing, and as it adds no
        # white bars, it needs a quarter to two fifths fewer tokens.
        Architecture("vggt", "VGGT", "vggt", "VGGT", weights.VGGT, "crop", "pad"),
        Architecture("vggt-omega", "VGGT-Omega", "omega", "VGGTOmega", weights.VGGT_OMEGA, "balanced"),
        *(
            Architecture(name, of_size.model, "da3", "DepthAnything3", of_size, "upper_bound_resize", channels=channels)
            for (name, of_size), channels in zip(weights.DA3.items(), (768, 384), strict=True)
        ),
    )
}
"""The networks by name of the predictor."""
