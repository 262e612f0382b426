"""A reconstructed map grows: what is there stays, to the last digit, and what was added can go again."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pycolmap
import pytest

from toolkit import files
from toolkit.capture import Capture
from toolkit.capture.check import check_capture
from toolkit.capture.session import RECONSTRUCTION_RECORD
from toolkit.errors import CaptureError
from toolkit.exchange.reconstruct import add_recording, model_points, reconstruct, remove_recording
from toolkit.features.features import SiftExtractor
from toolkit.features.stores import extract_session
from toolkit.files import read_json

TABLES = ("images.txt", "trajectories.txt", "sensors.txt")


pytestmark = pytest.mark.slow  # each reconstructs


@pytest.fixture(scope="module")
def folders(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`first` has 4 photographs of the phone's map, `more` 2 others, `foreign` one of nothing."""
    folder = tmp_path_factory.mktemp("folders")
    session = Capture.open(small_capture)["ios_map"]
    for row in range(len(session.images)):
        target = folder / ("more" if row in (2, 4) else "first") / f"{row:03d}{session.image_path(row).suffix}"
        target.parent.mkdir(exist_ok=True)
        shutil.copy(session.image_path(row), target)
    (folder / "foreign").mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    PIL.Image.fromarray(noise).save(folder / "foreign" / "noise.png")
    return folder


@pytest.fixture(scope="module")
def first(folders: Path) -> Path:
    reconstruct([folders / "first"], folders / "PLACE")
    return folders / "PLACE"


def test_new_photographs_are_registered_and_the_others_stay(
    folders: Path, first: Path, small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = first / "sessions" / "ios_map"
    before = {name: (session / name).read_text() for name in TABLES}
    assert len(extract_session(Capture.open(first)["ios_map"], folders / "earlier")) == 4  # by a run
    extracted, extract = [], SiftExtractor.extract

    def count(self: SiftExtractor, images: Sequence[Any]) -> Any:
        extracted.extend(images)
        return extract(self, images)

    monkeypatch.setattr(SiftExtractor, "extract", count)
    report = add_recording([folders / "more", folders / "foreign"], first)
    assert (report.record["used"], report.record["before"]) == (2, 4)
    assert report.images.set_index("image")["status"]["foreign/noise.png"].startswith("no matches")
    assert len(extracted) == 3
    assert all((session / name).read_text().startswith(before[name]) for name in TABLES)
    record = read_json(session / RECONSTRUCTION_RECORD)
    assert (record["photographs"], record["registered"]) == (7, 6)
    assert [len(one) for one in model_points(first)] == [record["points"]] * 2

    opened, true = Capture.open(first)["ios_map"], Capture.open(small_capture)["ios_map"].world_from_cam()
    order = [int(opened.image_path(row).stem) for row in range(6)]
    assert sorted(order) == list(range(6))
    ours, theirs = opened.world_from_cam()[:, :3, 3], true[order][:, :3, 3]
    found = pycolmap.estimate_sim3d(ours[:4], theirs[:4])  # those of the first
    assert found is not None
    spread = np.linalg.norm(theirs - theirs.mean(axis=0), axis=1).mean()
    assert np.linalg.norm(found * ours - theirs, axis=1).max() < 0.1 * spread
    for run in ("features", "earlier"):  # a run takes them all from the session
        assert len(extract_session(opened, folders / run)) == 6
    assert len(extracted) == 3

    for wrong, named in (
        (lambda: add_recording([folders / "more"], first), "are in .* already"),
        (lambda: remove_recording("mor", first), r"found 0 of 6 images of recording 'mor'\. Recordings: more"),
    ):
        with pytest.raises(CaptureError, match=named):
            wrong()
    assert remove_recording("more", first).startswith("2 images of more removed")
    assert {name: (session / name).read_text() for name in TABLES} == before
    assert not [*session.rglob("more")]
    assert add_recording([folders / "more"], first).record["used"] == 2


def test_a_file_is_a_recording_with_its_mask(folders: Path, tmp_path: Path) -> None:
    place = tmp_path / "PLACE"
    reconstruct([folders / "first"], place)
    session, (file, other) = place / "sessions" / "ios_map", sorted((folders / "more").iterdir())
    before = {name: (session / name).read_text() for name in TABLES}
    mask = tmp_path / "taken/masks" / f"{file.name}.png"
    mask.parent.mkdir(parents=True)
    shutil.copy(file, tmp_path / "taken")
    PIL.Image.new("L", PIL.Image.open(file).size, 255).save(mask)
    assert add_recording([tmp_path / "taken" / file.name, other], place).record["used"] == 2
    assert len([*session.rglob(mask.name)]) == 1
    for name in (file.name, other.name):
        assert remove_recording(name, place).startswith(f"1 images of {name} removed")
    assert {name: (session / name).read_text() for name in TABLES} == before
    assert not [*session.rglob(f"{file.name}*")]
    assert check_capture(place).ok


def test_a_killed_addition_is_repeated(folders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "PLACE"
    reconstruct([folders / "first"], place)
    session = place / "sessions" / "ios_map"
    before = (session / "images.txt").read_text()

    def kill(*_: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(files, "_exchange", kill)
        with pytest.raises(KeyboardInterrupt):
            add_recording([folders / "more"], place)
    assert (session / "images.txt").read_text() == before
    assert len(Capture.open(place)["ios_map"].images) == 4
    assert check_capture(place).ok
    assert add_recording([folders / "more"], place).record["used"] == 2
    assert np.isfinite(Capture.open(place)["ios_map"].world_from_cam()).all()
    assert check_capture(place).ok


def test_what_fits_nowhere_changes_nothing(folders: Path, first: Path, small_capture: Path) -> None:
    session = first / "sessions" / "ios_map"
    before = {name: (session / name).read_text() for name in TABLES}
    for capture, named in (
        (first, "no photograph fits into the model"),
        (small_capture, "was not reconstructed here"),
    ):
        with pytest.raises(CaptureError, match=named):
            add_recording([folders / "foreign"], capture)
    assert {name: (session / name).read_text() for name in TABLES} == before
