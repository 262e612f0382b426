"""Images as VGGT takes them, with what that does to pixels: to intrinsics on the way in, to depth on the way back."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image, UnidentifiedImageError
from scipy.ndimage import map_coordinates
from torch import Tensor

from toolkit.errors import ImageError
from toolkit.geometry import Array
from toolkit.models.vggt.aggregator import PATCH

SIDE = 518
MODES = ("crop", "pad")

Source = str | Path | Image.Image | NDArray[np.uint8]


@dataclass(frozen=True)
class Views:
    """Images for the network, and where their pixels came from.

    Image coordinates (x, y) are in pixels; the center of the top-left one is (0.5, 0.5).
    """

    images: Tensor
    """(S, 3, H, W) float32, RGB in [0, 1]."""
    scale: Array
    """(S, 2): of x and of y. A point (x, y) of image i is at scale[i] * (x, y) + offset[i] in images[i]."""
    offset: Array
    """(S, 2), network pixels."""
    sizes: NDArray[np.int64]
    """(S, 2): width and height of the images as given."""

    def intrinsics(self, K: ArrayLike) -> Array:
        """Return the cameras' K (S, 3, 3) for the network's images, for those of the images as given.

        Args:
            K: (S, 3, 3), or (3, 3) for all: focal lengths and principal point, pixels. Distortion is no part of it.
        """
        change = np.zeros((len(self.scale), 3, 3))
        change[:, [0, 1], [0, 1]], change[:, :2, 2], change[:, 2, 2] = self.scale, self.offset, 1.0
        return change @ np.asarray(K, np.float64)

    def to_network(self, index: int, points: ArrayLike) -> Array:
        """Return where points (..., 2) of image `index` are in its network image, (..., 2)."""
        return np.asarray(points, np.float64) * self.scale[index] + self.offset[index]

    def from_network(self, index: int, points: ArrayLike) -> Array:
        """Return where points (..., 2) of network image `index` are in the image as given, (..., 2)."""
        return (np.asarray(points, np.float64) - self.offset[index]) / self.scale[index]

    def sample(self, index: int, values: ArrayLike, points: ArrayLike) -> Array:
        """Return a network map, such as depth, at points of the image as given: bilinear; NaN where it was cropped.

        Args:
            index: of the image.
            values: (H, W), one a pixel of the network's image.
            points: (..., 2) in the image as given.
        """
        values = np.asarray(values, np.float64)
        size = np.array(values.shape[::-1])
        if values.shape != tuple(self.images.shape[2:]):
            raise ValueError(f"the map has shape {values.shape}; expected {tuple(self.images.shape[2:])}.")
        in_network = self.to_network(index, points)
        x, y = np.moveaxis(in_network - 0.5, -1, 0)
        inside = ((in_network >= 0) & (in_network <= size)).all(axis=-1)
        return np.where(inside, map_coordinates(values, [y, x], order=1, mode="nearest"), np.nan)

    def to_image(self, index: int, values: ArrayLike) -> Array:
        """Return a network map (H, W) for all pixels of the image as given, (height, width); NaN where cropped."""
        width, height = self.sizes[index]
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        return self.sample(index, values, np.stack([x, y], axis=-1))


def resized_size(width: int, height: int, mode: str) -> tuple[int, int]:
    """Return the width and height to which `load_images` resizes an image, before it cuts or fills."""
    longest = width if mode == "crop" else max(width, height)
    # In the order of the official code: where a quotient is near a half, another one rounds otherwise.
    new_width = SIDE if longest == width else round(width * (SIDE / height) / PATCH) * PATCH
    new_height = SIDE if longest != width else round(height * (SIDE / width) / PATCH) * PATCH
    return new_width, new_height


def load_images(sources: Sequence[Source], mode: str = "crop") -> Views:
    """Return images as the official loader makes them.

    Each is put on white where it is transparent, resized (bicubic, by Pillow) and cut or filled:
    "crop": to a width of 518, the height in proportion to the nearest multiple of 14, its middle 518 rows where it
    has more; "pad": its longer side to 518, the other in proportion to a multiple of 14, white up to 518 x 518. Where
    images then differ in size, white is added around the smaller. EXIF orientation is not applied.

    Args:
        sources: paths, Pillow images, or arrays (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) gray, uint8.
        mode: "crop" or "pad".

    Raises:
        ImageError: a file is missing or cannot be decoded, or an image is too elongated.
        ValueError: no image, or another mode.
    """
    if mode not in MODES:
        raise ValueError(f"mode is {mode!r}; expected one of {list(MODES)}.")
    if not len(sources):
        raise ValueError("found no images; expected at least one.")
    arrays, scales, offsets, sizes = [], [], [], []
    for position, source in enumerate(sources):
        image = _open(source)
        width, height = image.size
        new_width, new_height = resized_size(width, height, mode)
        if not min(new_width, new_height):
            where = source if isinstance(source, str | Path) else f"no. {position}"
            raise ImageError(
                f"Image of {width} x {height} pixels is too elongated for the network: {where}. Its shorter side would "
                f"be less than half a patch of {PATCH} pixels; cut it."
            )
        pixels = np.asarray(image.resize((new_width, new_height), Image.Resampling.BICUBIC))
        top = max(0, (new_height - SIDE) // 2) if mode == "crop" else 0
        arrays.append(pixels[top : top + SIDE])
        scales.append([new_width / width, new_height / height])
        offsets.append([0.0, -float(top)])
        sizes.append([width, height])
    full_height = SIDE if mode == "pad" else max(len(pixels) for pixels in arrays)
    images = torch.ones(len(arrays), 3, full_height, SIDE)
    for index, pixels in enumerate(arrays):
        rows, columns = pixels.shape[:2]
        top, left = (full_height - rows) // 2, (SIDE - columns) // 2
        tensor = torch.from_numpy(pixels.copy()).permute(2, 0, 1)
        images[index, :, top : top + rows, left : left + columns] = tensor.float() / 255
        offsets[index][0] += left
        offsets[index][1] += top
    return Views(images, np.array(scales), np.array(offsets), np.array(sizes, np.int64))


def _open(source: Source) -> Image.Image:
    """Return an RGB image, blended on white where it has an alpha channel."""
    if isinstance(source, Image.Image):
        image = source
    elif isinstance(source, np.ndarray):
        image = Image.fromarray(source)
    else:
        try:
            with Image.open(source) as opened:
                opened.load()
                image = opened
        except FileNotFoundError:
            raise ImageError(f"Image not found: {source}") from None
        except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
            raise ImageError(f"Image cannot be decoded: {source} ({error}); expected a whole image file.") from None
    if image.mode == "RGBA":
        image = Image.alpha_composite(Image.new("RGBA", image.size, (255, 255, 255, 255)), image)
    return image.convert("RGB")
