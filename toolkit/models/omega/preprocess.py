"""Loads images for VGGT-Omega."""

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image

from toolkit.models.omega.aggregator import PATCH
from toolkit.models.views import Source, Views, check_arguments, open_image, stack

SIDE = 512
MODES = ("balanced", "max_size")


def cropped_size(width: int, height: int) -> tuple[int, int]:
    """Return the width and height of the central crop of an image, with an aspect ratio of at most 2 to 1 or 1 to 2."""
    return min(width, 2 * height), min(height, 2 * width)


def resized_size(width: int, height: int, mode: str) -> tuple[int, int]:
    """Return the width and height to which `load_images` resizes a cropped image, before it pads."""
    # Keep the official order of operations: near one half, another order rounds differently.
    aspect = height / width
    if mode == "balanced":
        patches = (SIDE // PATCH) ** 2
        columns = math.sqrt(patches / aspect)
        return PATCH * round(columns), PATCH * round(patches / columns)
    if aspect >= 1:
        return PATCH * round(SIDE / aspect / PATCH), SIDE
    return SIDE, PATCH * round(SIDE * aspect / PATCH)


def load_images(sources: Sequence[Source], mode: str = "balanced") -> Views:
    """Load images as the official loader does.

    Transparent pixels of RGBA images become white. Crops images of more than 2 to 1 at their center. Resizes images
    (bicubic, by Pillow) in proportion, rounded to multiples of 16: "balanced" to about the area of 512 x 512
    pixels; "max_size" to a longer side of 512 pixels. Smaller images then get a white border, up to the largest
    width and height among them. Does not apply the EXIF orientation.

    Args:
        sources: paths, Pillow images or arrays.
        mode: "balanced" or "max_size".

    Raises:
        ImageError: a file is missing or cannot be decoded.
        ValueError: no images, or unknown mode.
    """
    check_arguments(sources, mode, MODES)
    pixels, scales, offsets, sizes = [], [], [], []
    for source in sources:
        image = open_image(source)
        sizes.append(image.size)
        width, height = cropped_size(*image.size)
        left, top = (image.width - width) // 2, (image.height - height) // 2
        new_size = resized_size(width, height, mode)
        pixels.append(image.crop((left, top, left + width, top + height)).resize(new_size, Image.Resampling.BICUBIC))
        scales.append(np.divide(new_size, (width, height)))
        offsets.append(-scales[-1] * (left, top))
    return stack(pixels, scales, offsets, sizes)
