"""Compress pictures for pages and notebooks."""

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PIL.Image import Image


def as_jpeg(picture: "Image", max_width: int) -> bytes:
    """Return a picture as a JPEG file, at most `max_width` pixels wide and ten times as high."""
    small = picture.convert("RGB")
    small.thumbnail((max_width, 10 * max_width))
    stream = io.BytesIO()
    small.save(stream, "JPEG", quality=85, optimize=True)
    return stream.getvalue()


def as_shown(png: bytes) -> dict[str, bytes]:
    """Return a PNG by MIME type for a notebook, as a JPEG if that has less than half its size.

    So photographs become JPEG; lines and text stay PNG, which is sharper and no larger.
    """
    from PIL import Image

    with Image.open(io.BytesIO(png)) as picture:
        small = as_jpeg(picture, picture.width)
    return {"image/jpeg": small} if 2 * len(small) < len(png) else {"image/png": png}
