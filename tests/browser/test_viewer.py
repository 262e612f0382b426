"""06_visualize in JupyterLab, as a person opens it: the viewer in the notebook draws the scene, with no network."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from docs import chromium
from toolkit.notebook import notebook_path

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.browser
NOTEBOOK = notebook_path("visualize")


@pytest.mark.skipif("show_recording(" not in NOTEBOOK.read_text(), reason=f"{NOTEBOOK.name} does not open the viewer")
def test_the_viewer_in_the_notebook_draws_the_scene(
    browser: "Browser", finished_run: Path, small_capture: Path, tmp_path: Path
) -> None:
    name = chromium.copy_notebook("visualize", finished_run, small_capture / "sessions", tmp_path / "notebooks")
    with chromium.serve_lab(tmp_path / "notebooks", tmp_path / "state") as url:
        page = browser.new_page(viewport={"width": 1300, "height": 1000})
        traffic = chromium.watch(page)
        errors = chromium.run_notebook(page, url.format(name))
        assert not errors
        picture = chromium.wait_for_scene(chromium.find_viewer(page))
        (tmp_path / "viewer.png").write_bytes(picture)
        page.screenshot(path=tmp_path / "lab.png", timeout=120_000)
        page.close()
    assert chromium.is_scene(picture), f"colors, and share of pixels that differ: {chromium.colors(picture)}"
    # The viewer asks its maker for news of itself; refused, it works all the same.
    assert all("rerun" in request for request in traffic.outside), traffic.outside
