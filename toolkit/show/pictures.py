"""Pictures made small, for pages that hold them."""

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PIL.Image import Image


def as_jpeg(picture: "Image", max_width: int) -> bytes:
    """Return a picture as a JPEG file of at most `max_width` pixels a row, and ten times as many rows."""
    small = picture.convert("RGB")
    small.thumbnail((max_width, 10 * max_width))
    stream = io.BytesIO()
    small.save(stream, "JPEG", quality=85, optimize=True)
    return stream.getvalue()
