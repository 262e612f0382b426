"""JupyterLab on copies: which copies are taken, and what of them is saved."""

import os
from pathlib import Path

import pytest
from jupyter_server.services.contents.filemanager import FileContentsManager
from nbconvert import HTMLExporter
from traitlets.config import PyFileConfigLoader
from typer.testing import CliRunner

from toolkit import notebook, pipeline
from toolkit.__main__ import app
from toolkit.errors import ArtifactError
from toolkit.notebook import NOTEBOOKS

WIDGET = "application/vnd.jupyter.widget-view+json"


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
    page, _ = HTMLExporter().from_filename(str(tmp_path / "mine.ipynb"))
    assert page.count("data:image/jpeg;base64,aGk=") == 2, "in HTML; nbconvert prefers widgets"
    assert saved["cells"][2]["source"] == "# mine"
    assert "widgets" not in saved["metadata"]
    manager.save({"type": "file", "format": "text", "content": "a file"}, "file.txt")
    assert (tmp_path / "file.txt").read_text() == "a file"


def test_lab_is_on_copies_that_keep_what_was_done_in_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "new").mkdir()
    monkeypatch.setattr(notebook, "NOTEBOOKS", tmp_path / "new")
    monkeypatch.chdir(tmp_path)
    started: list[list[str]] = []
    monkeypatch.setattr(os, "execv", lambda _, arguments: started.append(arguments))
    for name in ("1", "2", "3"):
        (tmp_path / "new" / f"{name}.ipynb").write_text("first")

    def lab() -> str:
        result = CliRunner().invoke(app, ["lab", "--port", "9"], catch_exceptions=False)
        assert result.exit_code == 0
        return result.stdout

    assert "newer" not in lab()
    assert started[0][1:3] == ["-m", "jupyterlab"]
    assert started[0][-3:] == ["--port", "9", "lab/start.ipynb"]
    (config,) = (text.partition("=")[2] for text in started[0] if text.startswith("--config="))
    assert Path(config).is_file()
    (tmp_path / "lab" / "1.ipynb").write_text("mine")
    (tmp_path / "lab" / "2.ipynb").write_text("mine")
    for name in ("1", "3"):
        (tmp_path / "new" / f"{name}.ipynb").write_text("second")
    said = lab()
    assert [(tmp_path / "lab" / f"{name}.ipynb").read_text() for name in ("1", "2", "3")] == ["mine", "mine", "second"]
    assert "1.ipynb is newer than lab/1.ipynb, which you have changed" in " ".join(said.split())
    assert said.count("newer") == 1
    ignored = (NOTEBOOKS.parent / ".gitignore").read_text().splitlines()
    assert "/lab/" in ignored


def test_copies_take_the_runs_of_the_folder_that_lab_was_started_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kernel works in lab/; the demo ran again there, and the one beside it was not found."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "execv", lambda *_: None)
    assert CliRunner().invoke(app, ["lab"], catch_exceptions=False).exit_code == 0
    (mine := tmp_path / "runs" / "mine").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "lab")
    assert notebook.find_run("runs/mine") == mine
    asked: list[Path] = []

    def make(manifest: Path) -> None:
        asked.append(manifest)
        raise RuntimeError

    monkeypatch.setattr(pipeline, "run", make)
    with pytest.raises(RuntimeError):
        pipeline.open_run("runs/demo")
    assert asked == [tmp_path / "data_manifests" / "demo.yaml"]
    assert not (tmp_path / "lab" / "data_manifests").exists()


def test_a_folder_that_is_no_run_is_named_by_the_parameter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    (tmp_path / "runs" / "mine" / "run.json").write_text("{}")
    mine, mind = tmp_path / "runs" / "mine", tmp_path / "runs" / "mind"
    for parameter, ask in (
        ("run", lambda: pipeline.open_run(mind)),
        ("others", lambda: pipeline.runs_to_compare(mine, [mind])),
    ):
        with pytest.raises(ArtifactError, match=rf"^{parameter}: .*mind: no such run\. Did you mean 'mine'"):
            ask()
