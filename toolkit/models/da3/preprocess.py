"""Loads images for Depth Anything 3."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from toolkit.models.views import Source, Views, check_arguments, open_image, stack, too_elongated
from toolkit.models.vit import PATCH

SIDE = 504
MODES = ("upper_bound_resize",)


def resized_sizes(width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the width and height after each of the two steps in which `load_images` resizes an image."""
    scale = SIDE / max(width, height)
    first = (max(1, round(width * scale)), max(1, round(height * scale)))
    # The nearest multiple of the patch; half way, the larger.
    columns, rows = ((side + PATCH // 2) // PATCH for side in first)
    return first, (PATCH * columns, PATCH * rows)


def load_images(sources: Sequence[Source], mode: str = "upper_bound_resize") -> Views:
    """Load images as the official loader does.

    Resizes the longer side to 504 pixels, then both sides to the nearest multiples of 14 (by OpenCV, with area
    interpolation if the image shrinks, else bicubic). Crops images of different sizes at their center to the smallest
    width and height among them. Transparent pixels become white (the official loader keeps their hidden color). Does
    not apply the EXIF orientation.

    Args:
        sources: paths, Pillow images or arrays.
        mode: "upper_bound_resize", the official default.

    Raises:
        ImageError: a file is missing or cannot be decoded, or an image is too elongated.
        ValueError: no images, or unknown mode.
    """
    check_arguments(sources, mode, MODES)
    pixels, scales, sizes = [], [], []
    for position, source in enumerate(sources):
        image = open_image(source)
        first, second = resized_sizes(*image.size)
        if not min(second):
            raise too_elongated(image.size, source if isinstance(source, str | Path) else f"no. {position}")
        pixels.append(_resize(_resize(np.asarray(image), first), second))
        scales.append(np.divide(second, image.size))
        sizes.append(image.size)
    height, width = (min(image.shape[axis] for image in pixels) for axis in (0, 1))
    corners = [((image.shape[1] - width) // 2, (image.shape[0] - height) // 2) for image in pixels]
    cropped = [
        Image.fromarray(image[top : top + height, left : left + width])
        for image, (left, top) in zip(pixels, corners, strict=True)
    ]
    return stack(cropped, scales, -np.array(corners, np.float64), sizes)


def _resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    if image.shape[1::-1] == size:
        return image
    grows = size[0] > image.shape[1] or size[1] > image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_CUBIC if grows else cv2.INTER_AREA)
