"""The supported networks, and how each places the views of a group in its input images."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.turning import turn_image, turn_points
from toolkit.errors import WeightsError
from toolkit.geometry import Floats
from toolkit.models import weights
from toolkit.models.weights import WeightsSource
from toolkit.pose.base import View

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Size = tuple[int, int]
HEADS = ("camera", "depth")


@dataclass(frozen=True)
class Layout:
    """Places of the photographs of a group in the network images, which have one size."""

    mode: str
    """Mode of the network's image loader."""
    size: Size
    """(H, W) of the network images."""
    scale: Floats
    """(S, 2) scale of x and y. The point (x, y) of photograph i maps to scale[i] * (x, y) + offset[i]; the center
    of the top-left pixel is (0.5, 0.5) in both."""
    offset: Floats
    """(S, 2) in pixels of the network images."""


def shown_size(view: View) -> Size:
    """Return the width and height of the upright photograph."""
    size = (view.camera.width, view.camera.height)
    return size[::-1] if view.turns % 2 else size


@dataclass(frozen=True)
class PlacedView:
    """A view and its place in the input image of the network; maps between both."""

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


class Architecture(ABC):
    """A network that predicts cameras and depth of the views of one scene."""

    name: str
    """Name of the predictor in the settings."""
    title: str
    """Name in messages."""
    package: str
    """Package in `toolkit.models`; imported only where it is used, as it imports torch."""
    network: str
    """Class of the network in the package."""
    weights: WeightsSource
    patch: int
    """Side of a patch, pixels."""

    @abstractmethod
    def lay_out(self, sizes: Sequence[Size]) -> Layout:
        """Return the layout of photographs of these sizes (width, height)."""

    def load(self, checkpoint: Path, dtype: "torch.dtype") -> Any:
        """Return the network, on the CPU.

        It has `encode(images)` and is called as `network(images, heads, tokens)`, which returns the outputs of its
        heads.

        Raises:
            WeightsError: the file does not belong to this network.
        """
        return getattr(self._imported, self.network).from_checkpoint(checkpoint, heads=HEADS, compute_dtype=dtype)

    def read(self, image: Path | NDArray[np.uint8], layout: Layout) -> "tuple[Tensor, Size]":
        """Return the network image (3, H, W) of a photograph, and the (width, height) of the photograph.

        A photograph smaller than the images of its group gets a white border; a larger one is cropped to its middle.

        Raises:
            ImageError: the file is missing or cannot be decoded.
        """
        import torch.nn.functional as F

        loaded = self._imported.load_images([image], layout.mode)
        width, height = loaded.sizes[0].tolist()
        down, right = (all_ - own for all_, own in zip(layout.size, loaded.images.shape[2:], strict=True))
        top, left = int(down / 2), int(right / 2)
        return F.pad(loaded.images[0], (left, right - left, top, down - top), value=1.0), (width, height)

    def cameras(self, encoding: ArrayLike, size: Size) -> tuple[Floats, Floats]:
        """Return `cam_from_model` (..., 3, 4) and K (..., 3, 3) in pixels of network images of size (H, W)."""
        cameras: tuple[Floats, Floats] = self._imported.cameras_from_pose_encoding(encoding, size)
        return cameras

    @property
    def _imported(self) -> Any:
        return import_module(f"toolkit.models.{self.package}")


class VggtArchitecture(Architecture):
    """VGGT-1B, with uncropped photographs.

    The official "crop" mode would cut a portrait photograph of a phone to its middle 75 % (3:4) or 56 % (9:16). "pad"
    keeps all of it, in an image of the same 518 x 518. For landscape photographs "crop" cuts nothing, and as it adds no
    white bars, it needs a quarter to two fifths fewer tokens.
    """

    name = "vggt"
    title = network = "VGGT"
    package = "vggt"
    weights = weights.VGGT
    patch = 14
    _side = 518

    def lay_out(self, sizes: Sequence[Size]) -> Layout:
        from toolkit.models.vggt import resized_size

        portrait = any(height > width for width, height in sizes)
        # "crop" resizes a landscape photograph to the same size.
        resized = np.array([resized_size(*size, "pad") for size in sizes]).reshape(-1, 2)
        height = self._side if portrait else int(resized[:, 1].max(initial=0))
        offset = (np.array([self._side, height]) - resized) // 2
        scale = resized / np.array(sizes, np.float64).reshape(-1, 2)
        return Layout("pad" if portrait else "crop", (height, self._side), scale, offset.astype(np.float64))


class OmegaArchitecture(Architecture):
    """VGGT-Omega, 1B-512. Photographs of any shape get about the same number of pixels. As in the official loader,
    those with an aspect ratio above 2 are cropped to the middle."""

    name = "vggt-omega"
    title = "VGGT-Omega"
    package, network = "omega", "VGGTOmega"
    weights = weights.VGGT_OMEGA
    patch = 16

    def lay_out(self, sizes: Sequence[Size]) -> Layout:
        from toolkit.models.omega import cropped_size, resized_size

        original = np.array(sizes, np.int64).reshape(-1, 2)
        cropped = np.array([cropped_size(*size) for size in sizes], np.int64).reshape(-1, 2)
        shown = [resized_size(width, height, "balanced") for width, height in cropped.tolist()]
        resized = np.array(shown, np.float64).reshape(-1, 2)
        width, height = resized.max(axis=0, initial=0).tolist()
        scale = resized / cropped
        offset = (np.array([width, height]) - resized) // 2 - scale * ((original - cropped) // 2)
        return Layout("balanced", (int(height), int(width)), scale, offset)


class Da3Architecture(Architecture):
    """Depth Anything 3. As in the official loader, photographs of different shapes are cropped to a common middle."""

    package, network = "da3", "DepthAnything3"
    patch = 14

    def __init__(self, name: str, channels: int) -> None:
        self.name = name
        self.weights = weights.DA3[name]
        self.title = self.weights.model
        self._channels = channels

    def lay_out(self, sizes: Sequence[Size]) -> Layout:
        from toolkit.models.da3 import MODES, resized_sizes

        resized = np.array([resized_sizes(*size)[1] for size in sizes], np.float64).reshape(-1, 2)
        width, height = resized.min(axis=0, initial=np.inf if len(sizes) else 0).tolist()
        scale = resized / np.array(sizes, np.float64).reshape(-1, 2)
        return Layout(MODES[0], (int(height), int(width)), scale, -((resized - [width, height]) // 2))

    def load(self, checkpoint: Path, dtype: "torch.dtype") -> Any:
        network = super().load(checkpoint, dtype)
        if network.channels != self._channels:
            raise WeightsError(
                f"{checkpoint}: these are weights with {network.channels} channels, not {self.title}, which has "
                f"{self._channels}. Correct `{self.weights.setting}`, or the predictor's name."
            )
        return network


ARCHITECTURES: dict[str, Architecture] = {
    architecture.name: architecture
    for architecture in (
        VggtArchitecture(),
        OmegaArchitecture(),
        Da3Architecture("da3-base", 768),
        Da3Architecture("da3-small", 384),
    )
}
"""The networks by name of the predictor."""
