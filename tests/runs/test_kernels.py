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


def test_a_kernel_that_was_prepared_is_the_first_one_taken(tmp_path: Path) -> None:
    with Kernels(tmp_path / "new" / "notebooks") as kernels:
        kernels.prepare()
        prepared = kernels._spare
        kernels.prepare()
        assert prepared is not None
        assert kernels._spare is prepared
        assert kernels.take() is prepared
        assert kernels._spare is None, "no notebook is left"
        prepared.started.result(timeout=60)
