"""What the pictures of the documentation and the browser tests rest on, as far as it needs no browser."""

import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from docs import chromium, make_images
from toolkit.notebook import notebook_parameters

ROOT = Path(__file__).resolve().parents[1]


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(stream, "PNG")
    return stream.getvalue()


def test_an_empty_viewer_is_no_scene() -> None:
    flat = np.full((200, 300, 3), 20)
    panels = flat.copy()
    panels[:, 100:] = 40
    panels[50:60, ::7] = 230  # text
    grays = np.broadcast_to(np.arange(300)[None, :, None] % 256, (200, 300, 3))
    for empty in (flat, panels, grays):
        assert not chromium.is_scene(png(empty))
    speck = flat.copy()
    speck[:30, :30] = np.random.default_rng(0).integers(0, 256, (30, 30, 3))
    assert not chromium.is_scene(png(speck)), "many colors, on 1.5 % of the pixels"


def test_points_and_pictures_are_a_scene() -> None:
    rng = np.random.default_rng(0)
    scene = np.full((200, 300, 3), 20)
    scene[rng.random((200, 300)) < 0.2] = [200, 120, 40]
    scene[100:, 150:] = rng.integers(0, 256, (100, 150, 3))
    assert chromium.is_scene(png(scene))


def test_colors_counts_and_shares() -> None:
    pixels = np.zeros((10, 10, 3))
    pixels[:2] = [255, 0, 0]
    pixels[2] = [250, 5, 3]  # the same to 16 steps a channel
    assert chromium.colors(png(pixels)) == (2, pytest.approx(0.3))


def test_a_copied_notebook_works_on_the_run(tmp_path: Path) -> None:
    name = chromium.copy_notebook("visualize", tmp_path / "run", tmp_path / "PLACE" / "sessions", tmp_path / "copies")
    parameters = notebook_parameters(tmp_path / "copies" / name)
    assert parameters["sessions_root"] == str(tmp_path / "PLACE" / "sessions")
    assert parameters["poses_dir"] == str(tmp_path / "run" / "PLACE" / "poses")
    assert parameters["out_dir"] == str(tmp_path / "run" / "PLACE" / "visualization")
    assert parameters["map_device"] == "all"


def test_what_is_missing_is_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert chromium.find_chromium() is None
    assert "make browser-setup" in chromium.why_missing()
    monkeypatch.setenv("CHROMIUM", "/opt/browser")
    assert chromium.find_chromium() == "/opt/browser"


def test_pictures_are_made_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(make_images, "ROOT", tmp_path)
    smooth = np.linspace(0, 255, 400 * 300 * 3).reshape(300, 400, 3)
    monkeypatch.setattr(make_images, "LARGEST", 20_000)
    make_images.save(png(smooth), tmp_path / "images" / "a.png")
    assert (tmp_path / "images" / "a.png").stat().st_size <= 20_000
    assert Image.open(tmp_path / "images" / "a.png").size == (400, 300)


def test_pictures_of_the_readme_exist_and_are_small() -> None:
    pictures = re.findall(r"!\[[^\]]+\]\((docs/images/[^)]+)\)", (ROOT / "README.md").read_text())
    assert pictures
    for picture in pictures:
        assert (ROOT / picture).stat().st_size <= 300_000, picture
