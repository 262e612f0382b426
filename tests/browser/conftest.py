"""A finished run of the small capture, and a browser to look at what it left; skips where there is no browser."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from docs import chromium

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    if reason := chromium.why_missing():
        pytest.skip(reason)
    with chromium.open_browser() as browser:
        yield browser


@pytest.fixture(scope="session")
def finished_run(browser: "Browser", small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run folder of the small capture; the browser is asked for first, as without one this is work for nothing."""
    from toolkit import pipeline

    folder = tmp_path_factory.mktemp("run")
    manifest = folder / "small.yaml"
    manifest.write_text(f"description: a small run\ncaptures: ['{small_capture}']\n")
    overrides = [f"output_root={folder}", "visualize.samples=1"]
    return pipeline.run(manifest, overrides=overrides, say=lambda *a, **k: None)
