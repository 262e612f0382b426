"""A rendered capture that is localized in the phone's map by a simulated network."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.rendered import World, copy_shared, run_stage, write_retrieval
from toolkit.capture import Capture
from toolkit.files import SceneFiles


@pytest.fixture(scope="session")
def finished(
    small_capture: Path, small_features: Path, made_once: Callable[[str, Callable[[Path], object]], Path]
) -> SceneFiles:
    """A run that has localized all devices in the phone's map by predictions; do not write to it."""

    def make(folder: Path) -> None:
        files = SceneFiles(folder, small_capture.name)
        copy_shared(small_features, files.features)
        capture = Capture.open(small_capture)
        for device in capture.devices:
            write_retrieval(files.retrieval("ios", device), capture["ios_map"], capture[f"{device}_query"])
        run_stage(small_capture, files)

    return SceneFiles(made_once("predicted", make), small_capture.name)


@pytest.fixture(scope="session")
def world(small_capture: Path, finished: SceneFiles) -> World:
    return World(small_capture, finished)


@pytest.fixture
def run(finished: SceneFiles, tmp_path: Path) -> SceneFiles:
    """A copy of the run without its poses, to work in."""
    files = SceneFiles(tmp_path / "run", finished.scene)
    copy_shared(finished.root, files.root)
    shutil.rmtree(files.poses_dir)
    return files
