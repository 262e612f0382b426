"""Decoding, its errors, and the prefetching iterator."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.capture.images import default_workers, prefetch, read_for_display, read_image
from toolkit.errors import ImageError


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


def test_missing_image(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"not found: .*nowhere\.jpg"):
        read_image(tmp_path / "nowhere.jpg")


def test_a_folder_is_not_an_image(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="cannot be read"):
        read_image(tmp_path)


@pytest.mark.parametrize("content", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe0" + b"junk" * 50, b"<html>404</html>"])
def test_what_is_no_image_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.jpg").write_bytes(content)
    with pytest.raises(ImageError, match=rf"cannot be decoded \({len(content)} bytes.*bad\.jpg"):
        read_image(tmp_path / "bad.jpg")


def noise_file(path: Path) -> bytes:
    noise = np.random.default_rng(0).integers(0, 255, (200, 300, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    return path.read_bytes()


def test_a_header_without_pixels_is_refused(tmp_path: Path) -> None:
    whole = noise_file(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes(whole[:300])
    with pytest.raises(ImageError, match="cannot be decoded"):
        read_image(tmp_path / "a.jpg")


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_half_an_image_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(noise_file(path)[: path.stat().st_size // 2])
    with pytest.raises(ImageError, match="cannot be decoded"):
        read_image(path)


def test_default_workers() -> None:
    assert 1 <= default_workers() <= 8


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
    with pytest.raises(ImageError, match="three"):
        got.extend(prefetch(fails_at_three, range(50), workers=2, ahead=4))
    assert got == [0, 1, 2]
    assert threading.active_count() <= before, "the pool is gone"


def test_a_picture_of_an_unreadable_image_is_a_placeholder(tmp_path: Path) -> None:
    (tmp_path / "empty.jpg").write_bytes(b"")
    for name in ("empty.jpg", "missing.jpg"):
        shown = read_for_display(tmp_path / name)
        assert shown.ndim == 3
        assert shown.std() > 0, "it says so"
