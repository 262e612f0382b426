"""What a notebook shows of a value."""

import base64
import io
from typing import Any

from PIL import Image


def picture_of(value: Any) -> Image.Image:
    """Return the one picture that a notebook displays and keeps of a value."""
    from IPython.core.formatters import DisplayFormatter

    formatter = DisplayFormatter()
    formatter.active_types = list(formatter.format_types)  # as a kernel does
    content, _ = formatter.format(value)
    (kind,) = [kind for kind in content if kind.startswith("image/")]
    data = content[kind]
    picture = Image.open(io.BytesIO(base64.b64decode(data) if isinstance(data, str) else data))
    assert picture.get_format_mimetype() == kind
    return picture
