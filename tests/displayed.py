"""What a notebook shows of a value."""

import base64
import io
import re
from typing import Any

from PIL import Image


def picture_of(value: Any) -> Image.Image:
    """Return the one picture that a notebook displays and keeps of a value."""
    from IPython.core.formatters import DisplayFormatter

    formatter = DisplayFormatter()
    formatter.active_types = list(formatter.format_types)  # as a kernel does
    content, _ = formatter.format(value)
    pictures = [(kind, data) for kind, data in content.items() if kind.startswith("image/")]
    pictures += re.findall(r"<img src='data:([^;]+);base64,([^']+)'", content.get("text/html", ""))
    ((kind, data),) = pictures
    picture = Image.open(io.BytesIO(base64.b64decode(data) if isinstance(data, str) else data))
    assert picture.get_format_mimetype() == kind
    return picture
