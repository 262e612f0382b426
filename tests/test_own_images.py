"""Notebook 00, which is no stage: clean as committed, and it runs."""

from pathlib import Path

import nbformat
import pytest

from toolkit.notebook import NOTEBOOKS, notebook_parameters
from toolkit.pipeline import execute

PATH = NOTEBOOKS / "00_own_images.ipynb"


def test_it_is_committed_clean() -> None:
    content = nbformat.read(PATH, as_version=4)
    nbformat.validate(content)
    code = [cell for cell in content.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
    assert content.cells[0].source.startswith("# ")
    assert "notebook.finish(" in content.cells[-1].source
    assert all(len(cell.source.splitlines()) <= 18 for cell in code)
    assert [cell.id for cell in content.cells] == [f"00-{i:02d}" for i in range(len(content.cells))]
    assert all("  # " in line for line in content.cells[1].source.splitlines())
    assert notebook_parameters(PATH)["poses_are"] == "world_from_cam"


@pytest.mark.slow
def test_it_runs(small_capture: Path, tmp_path: Path) -> None:
    folders = {"sessions_root": str(small_capture / "sessions"), "out_dir": str(tmp_path / "data" / "OWN")}
    execute(PATH, tmp_path / "out.ipynb", folders)
    assert "there and back: 6 images" in (tmp_path / "out.ipynb").read_text()
