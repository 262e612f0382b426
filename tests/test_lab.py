"""JupyterLab on copies: which copies are taken, and what of them is saved."""

import shutil
import subprocess
from pathlib import Path

import pytest
from jupyter_server.services.contents.filemanager import FileContentsManager
from traitlets.config import PyFileConfigLoader

from toolkit.notebook import NOTEBOOKS

WIDGET = "application/vnd.jupyter.widget-view+json"
ROOT = NOTEBOOKS.parent


def test_a_saved_notebook_has_its_results_and_no_widgets(tmp_path: Path) -> None:
    """Saved as JupyterLab saves it, with the settings that `make lab` gives it."""
    manager = FileContentsManager(
        root_dir=str(tmp_path), config=PyFileConfigLoader("lab_config.py", str(NOTEBOOKS)).load_config()
    )
    text = {"output_type": "stream", "name": "stdout", "text": "9 queries"}
    bar = {"output_type": "display_data", "metadata": {}, "data": {WIDGET: {"model_id": "1"}, "text/plain": "  0%|"}}
    picture = {"output_type": "display_data", "metadata": {}, "data": {"image/jpeg": "aGk="}}
    cell = {"cell_type": "code", "id": "a", "metadata": {}, "source": "1", "execution_count": 1}
    note = {"cell_type": "markdown", "id": "b", "metadata": {}, "source": "# mine"}
    view = {"output_type": "display_data", "metadata": {}, "data": bar["data"] | picture["data"]}
    content = {
        "cells": [cell | {"outputs": [bar, text, picture, bar]}, cell | {"id": "c", "outputs": [view]}, note],
        "metadata": {"widgets": {"application/vnd.jupyter.widget-state+json": {}}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    manager.save({"type": "notebook", "content": content}, "mine.ipynb")
    saved = manager.get("mine.ipynb")["content"]
    assert [output.output_type for output in saved["cells"][0]["outputs"]] == ["stream", "display_data"]
    assert saved["cells"][0]["outputs"][1]["data"] == picture["data"]
    (kept,) = saved["cells"][1]["outputs"]
    assert kept["data"] == picture["data"], "what a viewer left for a page without a kernel"
    assert saved["cells"][2]["source"] == "# mine"
    assert "widgets" not in saved["metadata"]
    manager.save({"type": "file", "format": "text", "content": "a file"}, "file.txt")
    assert (tmp_path / "file.txt").read_text() == "a file"


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_lab_is_on_copies_that_keep_what_was_done_in_them(tmp_path: Path) -> None:
    """With a stand-in for Python, so that nothing is installed or started."""
    (tmp_path / "notebooks").mkdir()
    for name in ("Makefile", "pyproject.toml", "constraints.txt", "weights.txt"):
        shutil.copy(ROOT / name, tmp_path / name)
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\necho started \"$@\"\n")
    python.chmod(0o755)
    (tmp_path / ".venv" / ".installed").touch()
    for name in ("1", "2", "3"):
        (tmp_path / "notebooks" / f"{name}.ipynb").write_text("first")

    def lab() -> str:
        ask = ["make", "lab", "LAB_ARGS=--port 9"]
        done = subprocess.run(ask, cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout

    said = lab()
    assert "-m jupyterlab --config=notebooks/lab_config.py --notebook-dir . --port 9 lab/start.ipynb" in said
    assert "newer" not in said
    (tmp_path / "lab" / "1.ipynb").write_text("mine")
    (tmp_path / "lab" / "2.ipynb").write_text("mine")
    for name in ("1", "3"):
        (tmp_path / "notebooks" / f"{name}.ipynb").write_text("second")
    said = lab()
    assert [(tmp_path / "lab" / f"{name}.ipynb").read_text() for name in ("1", "2", "3")] == ["mine", "mine", "second"]
    assert "notebooks/1.ipynb is newer than lab/1.ipynb, which you have changed" in said
    assert said.count("newer") == 1
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    assert "/lab/" in ignored
