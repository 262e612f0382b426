"""Pictures made small, for pages and notebooks that hold them."""

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


def as_shown(png: bytes) -> dict[str, bytes]:
    """Return a PNG by its kind, as a notebook displays it; a JPEG where that is less than half, as with photographs.

    Lines and text alone are sharper as PNG, and no larger.
    """
    from PIL import Image

    with Image.open(io.BytesIO(png)) as picture:
        small = as_jpeg(picture, picture.width)
    return {"image/jpeg": small} if 2 * len(small) < len(png) else {"image/png": png}
