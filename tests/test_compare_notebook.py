"""Notebook 07, which is no stage: clean as committed, and it runs on runs that are there."""

from pathlib import Path

import nbformat
import pytest

from tests.show.test_comparison import GOOD, LOST, PAIRS, write_run
from toolkit.notebook import NOTEBOOKS, notebook_parameters
from toolkit.pipeline import execute, handed_counts

PATH = NOTEBOOKS / "07_compare.ipynb"


def test_it_is_committed_clean() -> None:
    content = nbformat.read(PATH, as_version=4)
    nbformat.validate(content)
    code = [cell for cell in content.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
    assert content.cells[0].source.startswith("# ")
    assert "notebook.finish(" in content.cells[-1].source
    assert all(len(cell.source.splitlines()) <= 18 for cell in code)
    assert [cell.id for cell in content.cells] == [f"07-{i:02d}" for i in range(len(content.cells))]
    parameters = content.cells[1].source.splitlines()
    assert [line for line in parameters if "  # " not in line] == ["# Change these first.", "", "# The rest."]
    assert "notebook.check_given(" in content.cells[2].source
    assert notebook_parameters(PATH)["runs"] is None


@pytest.mark.slow
def test_it_runs(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, {PAIRS[0]: [GOOD, error]}) for name, error in (("a", LOST), ("b", GOOD))]
    parameters = {"runs": list(map(str, runs)), "pictures": 0, "out": str(tmp_path / "page.html")}
    content, _ = execute(PATH, tmp_path / "out.ipynb", parameters)
    assert {"runs": 2, "queries": 2, "won": 1, "lost": 0}.items() <= handed_counts(content).items()
    assert (tmp_path / "page.html").is_file()
