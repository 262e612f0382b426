"""Odd images and text files: what they are read as, or the reason for which they are refused."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from toolkit.capture import Session
from toolkit.capture.images import read_image
from toolkit.errors import CaptureError, ImageError

SHADES = np.linspace(0, 255, 40 * 30).reshape(30, 40)


def encoded(image: Image.Image, form: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, form, **options)
    return stream.getvalue()


def gray(size: tuple[int, int] = (40, 30)) -> Image.Image:
    return Image.fromarray(SHADES.astype(np.uint8)).resize(size)


def sixteen_bits() -> bytes:
    return cv2.imencode(".png", (SHADES * 257).astype(np.uint16))[1].tobytes()


FRAMES = [gray().point(lambda value, k=k: min(255, value + k)) for k in (0, 80)]
ODD_IMAGES = {
    "16 bits": sixteen_bits(),
    "gray": encoded(gray(), "PNG"),
    "gray and alpha": encoded(gray().convert("LA"), "PNG"),
    "color and alpha": encoded(gray().convert("RGBA"), "PNG"),
    "palette": encoded(gray().convert("P"), "PNG"),
    "palette with a transparent color": encoded(gray().convert("P"), "PNG", transparency=0),
    "CMYK JPEG": encoded(gray().convert("CMYK"), "JPEG", quality=95),
    "progressive JPEG": encoded(gray().convert("RGB"), "JPEG", progressive=True, quality=95),
    "interlaced": encoded(gray(), "PNG", interlace=1),
    "animated PNG": encoded(FRAMES[0], "PNG", save_all=True, append_images=FRAMES[1:]),
    "animated WebP": encoded(FRAMES[0].convert("RGB"), "WEBP", save_all=True, append_images=FRAMES[1:], lossless=True),
    "TIFF": encoded(gray(), "TIFF"),
    "bytes after the end": encoded(gray(), "PNG") + b"more" * 100,
    "metadata in front": encoded(gray().convert("RGB"), "JPEG", quality=95, exif=b"Exif\0\0" + b"x" * 60_000),
}


@pytest.mark.parametrize("kind", ODD_IMAGES)
@pytest.mark.parametrize("as_gray", [False, True])
def test_an_odd_image_is_read_with_its_shades(kind: str, as_gray: bool, tmp_path: Path) -> None:
    """Alpha is dropped, 16 bits become 8, the first frame of several counts; the name does not tell the format."""
    path = tmp_path / "a.jpg"
    path.write_bytes(ODD_IMAGES[kind])
    image = read_image(path, gray=as_gray)
    assert (image.shape, image.dtype) == ((30, 40) if as_gray else (30, 40, 3), np.uint8)
    shades = image if as_gray else image.mean(axis=2)
    assert np.abs(shades - SHADES).max() < 12


@pytest.mark.parametrize("size", [(1, 1), (1, 500), (500, 1)])
def test_an_image_of_one_pixel_is_an_image(size: tuple[int, int], tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(encoded(gray(size), "PNG"))
    assert read_image(path).shape == (size[1], size[0], 3)


@pytest.mark.parametrize(
    "content",
    [b"GIF89a", b"\x89PNG\r\n", b"RIFF\x10\0\0\0WEBPVP8 ", b"II*\0\x08\0\0\0", b"BM", b"P6 9 9 255\n", b"\0" * 999,
     encoded(gray(), "PNG")[8:], encoded(gray(), "PNG").replace(b"IDAT", b"XDAT")],
)  # fmt: skip
def test_a_beginning_of_an_image_is_none(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(ImageError, match=r"a\.png"):
        read_image(path)


# Text


SENSORS = "cam, , camera, PINHOLE, 40, 30, 50, 50, 20, 15\n"
IMAGES = "# timestamp, sensor_id, image_path\n1, cam, a/1.png\n2, cam, a/2.png\n"
ODD_TEXTS = {
    "a byte-order mark": "\ufeff" + IMAGES,
    "Windows line ends": IMAGES.replace("\n", "\r\n"),
    "spaces at the ends": IMAGES.replace("\n", "  \n"),
    "tabs": IMAGES.replace(", ", ",\t"),
    "no spaces": IMAGES.replace(", ", ","),
    "empty lines": IMAGES.replace("\n", "\n\n \t\n"),
    "comments between": IMAGES.replace("\n", "\n# more\n   # and more\n"),
    "no line end at the end": IMAGES.rstrip("\n"),
    "no header": IMAGES.split("\n", 1)[1],
    "more columns": IMAGES.replace(".png", ".png, 7, 8"),
    "a very long comment": IMAGES + "# " + "x" * 3_000_000 + "\n",
    "leading zeros": IMAGES.replace("1, cam", "0001, cam"),
}


def session(folder: Path, images: bytes) -> Path:
    (folder / "sensors.txt").write_text(SENSORS)
    (folder / "images.txt").write_bytes(images)
    return folder


@pytest.mark.parametrize("kind", ODD_TEXTS)
def test_an_odd_text_is_read_as_what_it_says(kind: str, tmp_path: Path) -> None:
    images = Session.open(session(tmp_path, ODD_TEXTS[kind].encode())).images
    assert images.to_numpy().tolist() == [[1, "cam", "a/1.png"], [2, "cam", "a/2.png"]]


WRONG_TEXTS = {
    "bytes that are not UTF-8": (IMAGES.encode() + b"3, cam, a/\xe4.png\n", 4),
    "UTF-16": (IMAGES.encode("utf-16"), 1),
    "a time with a fraction": (IMAGES.encode() + b"3.5, cam, a/3.png\n", 4),
    "a time in words": (IMAGES.encode() + b"noon, cam, a/3.png\n", 4),
    "a time beyond 64 bits": (IMAGES.encode() + b"9223372036854775808, cam, a/3.png\n", 4),
    "a line that is cut": (IMAGES.encode() + b"3, ca", 4),
    "semicolons": (IMAGES.replace(",", ";").encode(), 2),
    "an empty name": (IMAGES.encode() + b"3, cam,\n", 4),
    "a very long line": (IMAGES.encode() + b"x" * 3_000_000 + b"\n", 4),
}


@pytest.mark.parametrize("kind", WRONG_TEXTS)
def test_a_wrong_text_is_refused_with_its_line(kind: str, tmp_path: Path) -> None:
    content, line = WRONG_TEXTS[kind]
    with pytest.raises(CaptureError, match=rf"images\.txt, line {line}: ") as error:
        Session.open(session(tmp_path, content))
    assert len(str(error.value)) < 1000
