"""The kernels of a run, and what is left when they have ended."""

import gc
from pathlib import Path

import nbformat
import pytest

from toolkit.notebook import execute
from toolkit.runs.kernel import Kernels


@pytest.mark.slow
def test_nothing_is_left_open(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Clients that are left open say so when they are collected, in the middle of a run's output."""
    parameters = nbformat.v4.new_code_cell("number = 1", metadata={"tags": ["parameters"]})
    python = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    nbformat.write(nbformat.v4.new_notebook(cells=[parameters], metadata=python), tmp_path / "one.ipynb")
    execute(tmp_path / "one.ipynb", tmp_path / "out.ipynb", {"number": 2})
    gc.collect()
    assert "zmq" not in caplog.text


def test_the_next_kernel_starts_while_a_notebook_runs(tmp_path: Path) -> None:
    with Kernels(tmp_path / "new" / "notebooks") as kernels:
        kernels.left = 2
        kernels.take()
        spare = kernels._spare
        assert spare is not None
        assert kernels.take() is spare
        assert kernels._spare is None, "no notebook is left"
    assert spare.ended_by is not None
