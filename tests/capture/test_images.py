"""Decoding, its errors, and the prefetching iterator."""

import os
import struct
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from toolkit.capture import read_depth
from toolkit.capture.images import (
    WORKERS,
    default_workers,
    prefetch,
    read_for_display,
    read_image,
    stored_size,
)
from toolkit.errors import CaptureError, ImageError


@pytest.fixture
def picture() -> np.ndarray:
    pixels = np.zeros((48, 80, 3), np.uint8)
    pixels[:, :40, 0] = 200  # red at the left
    pixels[:20, 40:, 2] = 100  # blue at the top right
    return pixels


@pytest.mark.parametrize("name", ["a.png", "ä ö.png", "a.jpg", "a.jpeg"])
def test_reads_rgb(tmp_path: Path, picture: np.ndarray, name: str) -> None:
    Image.fromarray(picture).save(tmp_path / name, quality=98)
    image = read_image(tmp_path / name)
    assert (image.shape, image.dtype) == ((48, 80, 3), np.uint8)
    assert np.abs(image[10:15, 5:30].astype(int) - [200, 0, 0]).max() <= 4
    assert np.abs(image[5:10, 50:70].astype(int) - [0, 0, 100]).max() <= 4


@pytest.mark.parametrize("installed", [True, False])
def test_heic_is_read_with_its_package(
    tmp_path: Path, picture: np.ndarray, monkeypatch: pytest.MonkeyPatch, installed: bool
) -> None:
    """`import` converted HEIC to PNG; a query of `localize` and `localize_image` was no known image."""
    pytest.importorskip("pillow_heif").register_heif_opener()
    path = tmp_path / "a.heic"
    Image.fromarray(picture).save(path, quality=98)
    if not installed:
        monkeypatch.setitem(sys.modules, "pillow_heif", None)
        for read in (stored_size, read_image):
            with pytest.raises(ImageError, match="HEIC is not read: pip install pillow-heif"):
                read(path)
        return
    assert stored_size(path) == (80, 48)
    assert np.abs(read_image(path)[10:15, 5:30].astype(int) - [200, 0, 0]).max() <= 12
    assert read_image(path, gray=True).shape == (48, 80)


def test_gray_and_color_files_read_as_asked(tmp_path: Path, picture: np.ndarray) -> None:
    Image.fromarray(picture).save(tmp_path / "color.png")
    Image.fromarray(picture[..., 0]).save(tmp_path / "gray.png")
    gray = read_image(tmp_path / "color.png", gray=True)
    assert gray.shape == (48, 80)
    assert gray[5, 5] == pytest.approx(0.299 * 200, abs=1)  # luma, not one of the channels
    np.testing.assert_array_equal(read_image(tmp_path / "gray.png", gray=True), picture[..., 0])
    np.testing.assert_array_equal(read_image(str(tmp_path / "gray.png")), np.repeat(picture[..., :1], 3, axis=2))


@pytest.mark.parametrize("orientation", [3, 6])
@pytest.mark.parametrize("gray", [False, True])
def test_exif_orientation_is_not_applied(tmp_path: Path, picture: np.ndarray, orientation: int, gray: bool) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(picture).save(tmp_path / "a.jpg", exif=exif, quality=95)
    image = read_image(tmp_path / "a.jpg", gray=gray)
    assert image.shape[:2] == (48, 80)
    assert image[40, 5].max() > 50  # the red half is still at the left
    assert image[40, 75].max() < 20


@pytest.mark.parametrize(("name", "named"), [("nowhere.jpg", r"not found: .*nowhere\.jpg"), ("", "cannot be read")])
def test_no_file_and_a_folder_are_no_images(tmp_path: Path, name: str, named: str) -> None:
    with pytest.raises(ImageError, match=named):
        read_image(tmp_path / name)


def noise_file(path: Path) -> bytes:
    noise = np.random.default_rng(0).integers(0, 255, (200, 300, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    return path.read_bytes()


@pytest.mark.parametrize(("suffix", "cut", "min_side"), [
    *(("jpg", lambda whole, other=other: other, None)
      for other in (b"", b"\xff\xd8", b"\xff\xd8\xff\xe0" + b"junk" * 50, b"<html>404</html>")),
    ("jpg", lambda whole: whole[:300], None),
    ("jpg", lambda whole: whole[: len(whole) // 2], 50),
    *((suffix, lambda whole: whole[: len(whole) // 2], None) for suffix in ("jpg", "png")),
    *((suffix, lambda whole: whole[:-20], None) for suffix in ("jpg", "png")),
])  # fmt: skip
def test_what_is_no_image_or_cut_short_is_refused(
    tmp_path: Path, suffix: str, cut: Callable[[bytes], bytes], min_side: int | None
) -> None:
    """Something else; what is left after its header, at half, and without its last bytes."""
    path = tmp_path / f"bad.{suffix}"
    content = cut(noise_file(path))
    path.write_bytes(content)
    with pytest.raises(ImageError, match=rf"cannot be decoded \({len(content)} bytes.*bad\.{suffix}"):
        read_image(path, min_side=min_side)


@pytest.mark.parametrize(
    ("min_side", "size"),
    [(None, (896, 672)), (337, (896, 672)), (336, (448, 336)), (168, (224, 168)), (84, (112, 84)), (1, (112, 84))],
)
def test_photographs_are_decoded_smaller(tmp_path: Path, min_side: int | None, size: tuple[int, int]) -> None:
    """JPEG by 2, 4 and 8, as long as the shorter side has `min_side` pixels; nothing moves."""
    x, y = np.meshgrid(np.linspace(0, 1, 896), np.linspace(0, 1, 672))
    smooth = np.stack([255 * x, 255 * y, 127 * (1 + np.sin(6 * x + 9 * y))], axis=-1).astype(np.uint8)
    path = tmp_path / "a.jpg"
    Image.fromarray(smooth).save(path, quality=98)
    image = read_image(path, min_side=min_side)
    assert image.shape == (size[1], size[0], 3)
    shown, whole = (np.asarray(Image.fromarray(one).resize((42, 42)), int) for one in (image, smooth))
    assert np.abs(shown - whole).max() <= 3
    if min_side:
        assert read_image(path, gray=True, min_side=min_side).shape == (672, 896)
        Image.fromarray(smooth).save(tmp_path / "a.png")
        np.testing.assert_array_equal(read_image(tmp_path / "a.png", min_side=min_side), smooth)


@pytest.mark.parametrize(("size", "by"), [((900, 700), 4), ((900, 702), 2), ((899, 700), 1), ((896, 701), 1)])
def test_only_a_whole_number_of_pixels_is_left_out(tmp_path: Path, size: tuple[int, int], by: int) -> None:
    """Else the last column would stand for fewer, and all be moved: MegaLoc then loses up to 0.0025 of the cosine."""
    Image.new("RGB", size).save(tmp_path / "a.jpg")
    assert read_image(tmp_path / "a.jpg", min_side=80).shape == (size[1] // by, size[0] // by, 3)


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 64),
        ({"cpu.max": "max 100000"}, 64),
        ({"cpu.max": "250000 100000"}, 2),
        ({"cpu.max": "50000 100000"}, 1),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 64),
        ({"cpu/cpu.cfs_quota_us": "400000", "cpu/cpu.cfs_period_us": "100000"}, 4),
        ({"cpu.max": "nonsense"}, 64),
        ({"memory.max": "max"}, 64),
        ({"cpu.max": "800000 100000", "memory.max": str(2 << 30)}, 4),
        ({"memory/memory.limit_in_bytes": str(1 << 63)}, 64),
    ],
)
def test_workers_are_the_cores_that_a_container_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: dict[str, str], cores: int
) -> None:
    monkeypatch.delenv(WORKERS, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(64), raising=False)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(total=128 << 30))
    monkeypatch.setattr("toolkit.capture.images._CGROUPS", tmp_path)
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    assert default_workers() == cores


@pytest.mark.parametrize(("text", "workers"), [("0", 1), ("3", 3)])
def test_workers_are_at_least_one(monkeypatch: pytest.MonkeyPatch, text: str, workers: int) -> None:
    monkeypatch.setenv(WORKERS, text)
    assert default_workers() == workers


@pytest.mark.parametrize(("workers", "ahead"), [(1, 0), (2, 4), (4, 1)])
def test_prefetch_keeps_the_order(workers: int, ahead: int) -> None:
    def slow_first(item: int) -> int:
        time.sleep(0.02 if item % 3 == 0 else 0)
        return item * 10

    assert list(prefetch(slow_first, iter(range(20)), workers, ahead)) == [10 * item for item in range(20)]
    assert list(prefetch(slow_first, [], workers, ahead)) == []


def test_prefetch_works_on_several_items_at_once() -> None:
    barrier = threading.Barrier(2, timeout=10)
    assert list(prefetch(lambda item: barrier.wait() >= 0 and item, range(4), workers=2)) == [0, 1, 2, 3]


def test_prefetch_looks_ahead_only_so_far() -> None:
    drawn: list[int] = []
    done: list[int] = []

    def items() -> Iterator[int]:
        for item in range(100):
            drawn.append(item)
            yield item

    results = prefetch(lambda item: done.append(item) or item, items(), workers=2, ahead=3)
    for index in range(10):
        assert next(results) == index
        time.sleep(0.002)
        # Those handed out, and at most workers + ahead beyond; one is drawn to make room.
        assert len(done) <= len(drawn) <= index + 1 + 2 + 3 + 1
    results.close()
    time.sleep(0.02)
    assert len(drawn) <= 17  # a consumer that stops early does not pay for the rest


def test_prefetch_raises_at_the_turn_of_the_item() -> None:
    def fails_at_three(item: int) -> int:
        if item == 3:
            raise ImageError("three")
        return item

    got, before = [], threading.active_count()
    with pytest.raises(ImageError):
        got.extend(prefetch(fails_at_three, range(50), workers=2, ahead=4))
    assert got == [0, 1, 2]
    assert threading.active_count() <= before, "the pool is gone"


def test_a_picture_of_an_unreadable_image_is_a_placeholder(tmp_path: Path) -> None:
    (tmp_path / "empty.jpg").write_bytes(b"")
    for name in ("empty.jpg", "missing.jpg"):
        shown = read_for_display(tmp_path / name, 500)
        assert shown.ndim == 3
        assert shown.std() > 0, "it says so"


def test_a_format_whose_header_is_unknown_is_shown(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.hdr"), np.full((30, 40, 3), 0.5, np.float32))
    with pytest.raises(ImageError):
        stored_size(tmp_path / "a.hdr")
    assert read_for_display(tmp_path / "a.hdr", 20).shape == (15, 20, 3)


def png_of_zeros(width: int, height: int) -> bytes:
    """Return a PNG of some hundred bytes that claims to have many pixels."""
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


@pytest.mark.parametrize("size", [(40_000, 40_000), (20_000, 14_000)])
def test_a_small_file_of_too_many_pixels_is_not_decoded(tmp_path: Path, size: tuple[int, int]) -> None:
    """OpenCV raises an error of its own for the first, and would take 0.8 GB for the other."""
    (tmp_path / "bomb.png").write_bytes(png_of_zeros(*size))
    with pytest.raises(ImageError, match=rf"{size[0]} x {size[1]} pixels, more than .*bomb\.png"):
        read_image(tmp_path / "bomb.png")
    assert stored_size(tmp_path / "bomb.png") == size


@pytest.mark.parametrize("kind", ["pipe", "pipe by a link", "device", "circle of links", "sparse", "long name", "NUL"])
def test_what_is_no_plain_file_is_neither_waited_for_nor_read(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.jpg"
    if kind.startswith("pipe"):
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to("pipe")
        path = tmp_path / "pipe" if kind == "pipe" else path
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "circle of links":
        path.symlink_to("a.jpg")
    elif kind == "sparse":
        with open(path, "wb") as stream:
            stream.truncate(1 << 40)
    else:
        path = tmp_path / ("x" * 300 if kind == "long name" else "a\0b.jpg")
    for read in (read_image, stored_size, read_depth):
        with pytest.raises((ImageError, CaptureError)):
            read(path)


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_an_image_with_more_bytes_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(noise_file(path) + bytes(100) + b"what some cameras add")
    assert read_image(path).shape == (200, 300, 3)


@pytest.mark.parametrize("size", [(960, 720), (720, 960), (641, 480), (965, 725), (100, 80)])
def test_an_image_is_reduced_for_display_without_a_shift(tmp_path: Path, size: tuple[int, int]) -> None:
    """A reduced JPEG is decoded smaller first; gradients show a shift or a stretch, which marks would follow."""
    width, height = size
    rows, columns = np.mgrid[0:height, 0:width]
    levels = (columns + 0.5) * 200 / width, (rows + 0.5) * 200 / height, np.full((height, width), 90.0)
    image = np.dstack(levels).round().astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
    shown = read_for_display(tmp_path / "a.jpg", 240)
    assert max(shown.shape[:2]) == min(240, max(size))
    assert shown.shape[1] / shown.shape[0] == pytest.approx(width / height, rel=0.01)
    rows, columns = (np.mgrid[0 : shown.shape[0], 0 : shown.shape[1]] + 0.5).astype(np.float64)
    np.testing.assert_allclose(shown[..., 0], columns / shown.shape[1] * 200, atol=3)
    np.testing.assert_allclose(shown[..., 1], rows / shown.shape[0] * 200, atol=3)
    right, below = shown[..., 0] - columns / shown.shape[1] * 200, shown[..., 1] - rows / shown.shape[0] * 200
    # Closer on average, as rounding and JPEG change single pixels by more than a shift does.
    assert abs(right[:, -len(right[0]) // 10 :].mean()) < 0.2
    assert abs(below[-len(below) // 10 :].mean()) < 0.2
