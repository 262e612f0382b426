"""Preprocessed photographs for networks that take several views, and the map from original to network pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from torch import Tensor

from toolkit.capture.images import HEADER_ERRORS, open_lazily, read_file
from toolkit.errors import ImageError
from toolkit.geometry import Floats, Ints
from toolkit.models.vit import PATCH

Source = str | Path | Image.Image | NDArray[np.uint8]
"""A path, a Pillow image, or an array (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) gray, uint8."""


@dataclass(frozen=True)
class Views:
    """Images for the network, and how original pixels map to network pixels.

    Image coordinates (x, y) are in pixels; the center of the top-left one is (0.5, 0.5).
    """

    images: Tensor
    """(S, 3, H, W) float32, RGB in [0, 1]."""
    scale: Floats
    """(S, 2) for x and y. Point (x, y) of original image i is at scale[i] * (x, y) + offset[i] in images[i]."""
    offset: Floats
    """(S, 2), network pixels."""
    sizes: Ints
    """(S, 2): width and height of the original images."""


def open_image(source: Source) -> Image.Image:
    """Return an RGB image; blends RGBA with white, as the official loaders do. Does not apply the EXIF orientation.

    Raises:
        ImageError: the file is missing or cannot be decoded.
    """
    if isinstance(source, Image.Image):
        image = source
    elif isinstance(source, np.ndarray):
        image = Image.fromarray(source)
    else:
        try:
            image = open_lazily(BytesIO(read_file(source)))
            image.load()
        except HEADER_ERRORS as error:
            raise ImageError(f"Image cannot be decoded: {source} ({error}); expected a whole image file.") from None
    if image.mode == "RGBA":
        image = Image.alpha_composite(Image.new("RGBA", image.size, (255, 255, 255, 255)), image)
    return image.convert("RGB")


def check_arguments(sources: Sequence[Source], mode: str, modes: Sequence[str]) -> None:
    """Check that there are images, and that the mode is known.

    Raises:
        ValueError: no images, or an unknown mode.
    """
    if mode not in modes:
        raise ValueError(f"mode is {mode!r}; expected one of {list(modes)}.")
    if not len(sources):
        raise ValueError("found no images; expected at least one.")


def too_elongated(size: tuple[int, int], where: str | Path) -> ImageError:
    """Return the error for an image of this width and height whose shorter side would shrink to nothing."""
    return ImageError(
        f"Image of {size[0]} x {size[1]} pixels is too elongated for the network: {where}. Its shorter side would be "
        f"less than half a patch of {PATCH} pixels; crop it."
    )


def stack(
    pixels: Sequence[Image.Image], scales: ArrayLike, offsets: ArrayLike, sizes: ArrayLike,
    least: tuple[int, int] = (0, 0),
) -> Views:  # fmt: skip
    """Center the images on white canvases of one size; an odd border is one pixel narrower at the left and top.

    Args:
        pixels: the images, RGB.
        scales, offsets, sizes: see `Views`, for these images.
        least: smallest (W, H) of the canvases.
    """
    width, height = (max(least[axis], *(image.size[axis] for image in pixels)) for axis in (0, 1))
    images = torch.ones(len(pixels), 3, height, width)
    borders = np.array([((width - image.width) // 2, (height - image.height) // 2) for image in pixels])
    for canvas, image, (left, top) in zip(images, pixels, borders, strict=True):
        tensor = torch.from_numpy(np.array(image)).permute(2, 0, 1)
        canvas[:, top : top + image.height, left : left + image.width] = tensor.float() / 255
    return Views(images, np.array(scales), np.array(offsets) + borders, np.array(sizes, np.int64))
