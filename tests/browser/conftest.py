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
def finished_run(browser: "Browser", request: pytest.FixtureRequest) -> Path:
    """`small_run`; the browser is asked for first, as without one the run is work for nothing."""
    folder: Path = request.getfixturevalue("small_run")
    return folder
