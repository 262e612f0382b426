"""04_localize in JupyterLab, as a person works with it: choose a query, save, and open the saved notebook again."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from docs import chromium
from toolkit.notebook import NOTEBOOKS

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.browser
WIDGET = "application/vnd.jupyter.widget-view+json"


def test_a_query_is_chosen_and_the_saved_notebook_opens_without_widgets(
    browser: "Browser", finished_run: Path, small_capture: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "notebooks"
    name = chromium.copy_notebook("localize", finished_run, small_capture / "sessions", folder)
    with chromium.serve_lab(folder, tmp_path / "state", NOTEBOOKS / "lab_config.py") as url:
        page = browser.new_page(viewport={"width": 1300, "height": 1000})
        assert not chromium.run_notebook(page, url.format(name))
        listed = page.locator(".jp-Notebook select")
        picture = page.locator(".jp-Cell", has=page.locator("select")).locator("img")
        picture.wait_for(timeout=60_000)
        before = picture.get_attribute("src")
        listed.select_option(index=1)
        page.wait_for_function(
            "before => ![...document.querySelectorAll('.jp-Cell img')].some(image => image.src === before)",
            arg=before, timeout=60_000,
        )  # fmt: skip
        after = str(picture.get_attribute("src")).partition(",")[2]
        page.evaluate("window.jupyterapp.commands.execute('docmanager:save')")
        page.evaluate("window.jupyterapp.serviceManager.sessions.shutdownAll()")
        page.close()

        saved = json.loads((folder / name).read_text())
        kept = [output.get("data", {}) for cell in saved["cells"] for output in cell.get("outputs", [])]
        assert not any(WIDGET in data for data in kept)
        assert "widgets" not in saved["metadata"]
        pages = ["".join(data.get("text/html", "")) for data in kept]
        assert any(after.strip() in page for page in pages), "what was chosen is what is saved"

        page = browser.new_page(viewport={"width": 1300, "height": 1000})
        page.goto(f"{url.format(name)}&reset")
        page.locator(".jp-Notebook .jp-OutputArea-output img").first.wait_for(timeout=60_000)
        assert "Error displaying widget" not in page.locator(".jp-Notebook").inner_text()
        page.close()
