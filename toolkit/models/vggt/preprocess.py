"""Loads images for VGGT."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from toolkit.models.views import Source, Views, check_arguments, open_image, stack, too_elongated
from toolkit.models.vit import PATCH

SIDE = 518
MODES = ("crop", "pad")


def resized_size(width: int, height: int, mode: str) -> tuple[int, int]:
    """Return the width and height to which `load_images` resizes an image, before it crops or pads."""
    longest = width if mode == "crop" else max(width, height)
    # Keep the official order of operations: near one half, another order rounds differently.
    new_width = SIDE if longest == width else round(width * (SIDE / height) / PATCH) * PATCH
    new_height = SIDE if longest != width else round(height * (SIDE / width) / PATCH) * PATCH
    return new_width, new_height


def load_images(sources: Sequence[Source], mode: str = "crop") -> Views:
    """Load images as the official loader does.

    Transparent pixels of RGBA images become white. Resizes images (bicubic, by Pillow) in proportion, to multiples
    of 14: "crop" makes the width 518 and keeps at most the 518 middle rows; "pad" makes the longer side 518 and
    adds white up to 518 x 518. Smaller images then get a white border. Does not apply the EXIF orientation.

    Args:
        sources: paths, Pillow images or arrays.
        mode: "crop" or "pad".

    Raises:
        ImageError: a file is missing or cannot be decoded, or an image is too elongated.
        ValueError: no images, or unknown mode.
    """
    check_arguments(sources, mode, MODES)
    pixels, scales, offsets, sizes = [], [], [], []
    for position, source in enumerate(sources):
        image = open_image(source)
        width, height = image.size
        new_width, new_height = resized_size(width, height, mode)
        if not min(new_width, new_height):
            raise too_elongated(image.size, source if isinstance(source, str | Path) else f"no. {position}")
        image = image.resize((new_width, new_height), Image.Resampling.BICUBIC)
        top = max(0, (new_height - SIDE) // 2) if mode == "crop" else 0
        pixels.append(image.crop((0, top, new_width, min(top + SIDE, new_height))))
        scales.append([new_width / width, new_height / height])
        offsets.append([0.0, -float(top)])
        sizes.append((width, height))
    return stack(pixels, scales, offsets, sizes, (SIDE, SIDE if mode == "pad" else 0))
