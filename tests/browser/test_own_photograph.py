"""A photograph of one's own in JupyterLab: chosen in the file chooser of `start.ipynb`, localized, and shown."""

from pathlib import Path
from typing import TYPE_CHECKING

import nbformat
import pytest

from docs import chromium
from toolkit.notebook import NOTEBOOKS, notebook_path

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.browser


def test_a_chosen_photograph_is_localized_and_shown(
    browser: "Browser", finished_run: Path, small_capture: Path, tmp_path: Path
) -> None:
    content = nbformat.read(notebook_path("start"), as_version=4)
    (chooser,) = (cell for cell in content.cells if "choose_photograph(scene_map)" in cell.source)
    opened = f"from toolkit.scene.run import Run\nscene_map = Run.open({str(finished_run)!r}).map('ios')"
    lines = "\n".join(line for line in chooser.source.splitlines() if line.startswith(("from ", "choose")))
    content.cells = [nbformat.v4.new_code_cell(source) for source in (opened, lines)]
    folder = tmp_path / "notebooks"
    folder.mkdir()
    nbformat.write(content, folder / "own.ipynb")
    photographs = sorted((small_capture / "sessions" / "ios_query" / "raw_data").rglob("*.jpg"))
    (torn := tmp_path / "torn.jpg").write_bytes(photographs[0].read_bytes()[:2000])
    with chromium.serve_lab(folder, tmp_path / "state", NOTEBOOKS / "lab_config.py") as url:
        page = browser.new_page(viewport={"width": 1300, "height": 1000})
        assert not chromium.run_notebook(page, url.format("own.ipynb"))
        button, shown = page.get_by_role("button", name="photograph"), page.locator(".jp-OutputArea-output")
        for photograph, told in ((torn, "torn.jpg"), (photographs[0], "position [m]")):
            with page.expect_file_chooser() as waiting:
                button.click()
            waiting.value.set_files(photograph)
            shown.get_by_text(told).last.wait_for(timeout=120_000)
        assert shown.get_by_text(photographs[0].name).count()
        assert not shown.get_by_text("torn.jpg").count(), "only what was chosen last"
        chromium.find_viewer(page)
        page.close()
