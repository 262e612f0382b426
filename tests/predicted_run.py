"""A rendered capture that is localized in the phone's map by a simulated network."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.rendered import World, copy_shared, prepared, run_stage
from toolkit.capture import Capture
from toolkit.files import SceneFiles


@pytest.fixture(scope="session")
def finished(
    small_capture: Path, small_features: Path, made_once: Callable[[str, Callable[[Path], object]], Path]
) -> SceneFiles:
    """A run that has localized all devices in the phone's map by predictions; do not write to it."""

    def make(folder: Path) -> None:
        run_stage(small_capture, prepared(folder, small_capture, small_features, Capture.open(small_capture).devices))

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
