"""Notebook 07, which is no stage: clean as committed, and it runs on runs that are there."""

import json
import re
from pathlib import Path

import nbformat
import pytest

from tests.report.test_comparison import GOOD, LOST, PAIRS, write_run
from toolkit.__main__ import main
from toolkit.notebook import NOTEBOOKS, handed_counts, notebook_parameters

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
    assert "pipeline.runs_to_compare(" in content.cells[2].source
    assert notebook_parameters(PATH)["others"] is None


@pytest.mark.slow
def test_the_command_executes_it_and_writes_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [write_run(tmp_path / name, {PAIRS[0]: [GOOD, error]}) for name, error in (("a", LOST), ("b", GOOD))]
    monkeypatch.setattr("sys.argv", ["toolkit", "compare", *map(str, runs), "--pictures", "1", "--json"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 0
    page = Path(json.loads(capsys.readouterr().out)["page"])
    assert page == tmp_path / "compare_a_b.html"
    counts = handed_counts(nbformat.read(page.with_suffix(".ipynb"), as_version=4))
    assert {"runs": 2, "queries": 2, "won": 1, "lost": 0}.items() <= counts.items()
    text = page.read_text()
    assert not re.search(r'(src|href)="(?!data:|#)|import\(|No description', text), "it needs nothing else"
    assert "No picture of hl query" in text
    assert "compare_runs(" not in text
