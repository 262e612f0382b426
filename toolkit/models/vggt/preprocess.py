"""Images in the form that VGGT takes, and where their pixels come from."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from toolkit.capture.images import read_file
from toolkit.errors import ImageError
from toolkit.geometry import Floats, Ints
from toolkit.models.vit import PATCH

SIDE = 518
MODES = ("crop", "pad")

Source = str | Path | Image.Image | NDArray[np.uint8]


@dataclass(frozen=True)
class Views:
    """Images for the network, and how their pixels map to those of the given images.

    Image coordinates (x, y) are in pixels; the center of the top-left one is (0.5, 0.5).
    """

    images: Tensor
    """(S, 3, H, W) float32, RGB in [0, 1]."""
    scale: Floats
    """(S, 2): for x and y. The point (x, y) of the given image i is at scale[i] * (x, y) + offset[i] in images[i]."""
    offset: Floats
    """(S, 2), network pixels."""
    sizes: Ints
    """(S, 2): width and height of the given images."""


def resized_size(width: int, height: int, mode: str) -> tuple[int, int]:
    """Return the width and height to which `load_images` resizes an image, before it crops or pads."""
    longest = width if mode == "crop" else max(width, height)
    # Computed in the order of the official code: near a half, another order rounds differently.
    new_width = SIDE if longest == width else round(width * (SIDE / height) / PATCH) * PATCH
    new_height = SIDE if longest != width else round(height * (SIDE / width) / PATCH) * PATCH
    return new_width, new_height


def load_images(sources: Sequence[Source], mode: str = "crop") -> Views:
    """Load images as the official loader does.

    Transparent pixels become white. Images are resized (bicubic, by Pillow) in proportion, to multiples of 14:
    "crop" makes the width 518 and keeps the middle 518 rows where there are more; "pad" makes the longer side 518 and
    adds white up to 518 x 518. Smaller images then get a white border. EXIF orientation is not applied.

    Args:
        sources: paths, Pillow images, or arrays (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) gray, uint8.
        mode: "crop" or "pad".

    Raises:
        ImageError: a file is missing or cannot be decoded, or an image is too elongated.
        ValueError: no images, or unknown mode.
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
    """Return an RGB image; one with an alpha channel is blended with white."""
    if isinstance(source, Image.Image):
        image = source
    elif isinstance(source, np.ndarray):
        image = Image.fromarray(source)
    else:
        try:
            with Image.open(BytesIO(read_file(source))) as opened:
                opened.load()
                image = opened
        except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
            raise ImageError(f"Image cannot be decoded: {source} ({error}); expected a whole image file.") from None
    if image.mode == "RGBA":
        image = Image.alpha_composite(Image.new("RGBA", image.size, (255, 255, 255, 255)), image)
    return image.convert("RGB")
