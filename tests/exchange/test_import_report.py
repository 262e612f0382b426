"""`new`: a manifest that runs, with what was found in the capture."""

import json
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from toolkit.__main__ import app
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.import_report import TEMPLATE, new_manifest
from toolkit.manifest import load_manifest


def test_the_manifest_is_the_template_with_the_capture_in_it(
    small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    place = tmp_path / "data" / small_capture.name
    place.symlink_to(small_capture)
    done = CliRunner().invoke(app, ["new", "my-place", str(place)])
    assert done.exit_code == 0, done.output
    path = Path("data_manifests/my-place.yaml")
    assert done.output.endswith(f"Run it: visloc run {path}\n")
    manifest, template = load_manifest(path), yaml.safe_load(TEMPLATE.read_text())
    assert manifest.name == "my-place"
    assert [Path(one).resolve() for one in manifest.captures] == [small_capture.resolve()]
    content = yaml.safe_load(path.read_text())
    changed = {key for key in template if content[key] != template[key]}
    assert changed == {"description", "captures"}
    assert content["description"].startswith(f"{small_capture.name}: hl_map, ")
    assert "#   images" in path.read_text()
    assert "\n# 0 errors, " in path.read_text()


def test_a_capture_of_the_given_name_is_meant(
    small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("PLACE").symlink_to(small_capture)
    assert "Name your capture" not in CliRunner().invoke(app, ["new", "PLACE"]).output
    (capture,) = load_manifest("data_manifests/PLACE.yaml").captures
    assert Path(capture).resolve() == small_capture.resolve()
    assert "Name your capture" in CliRunner().invoke(app, ["new", "OTHER"]).output


def test_an_unknown_unit_and_a_missing_list_are_set(small_capture: Path, tmp_path: Path) -> None:
    sessions = tmp_path / "PLACE" / "sessions"
    for name in ("ios_map", "ios_query"):
        (sessions / name / "proc").mkdir(parents=True)
        for file in ("sensors.txt", "images.txt", "trajectories.txt"):
            if (source := small_capture / "sessions" / name / file).is_file():
                (sessions / name / file).write_text(source.read_text())
    (sessions / "ios_map" / "proc" / "import.json").write_text(json.dumps({"unit": None}))
    path = new_manifest("place", tmp_path / "PLACE", tmp_path)
    manifest = load_manifest(path)
    assert manifest.unit is None
    assert manifest.queries == "all"
    assert "error: missing file" in path.read_text()  # a capture with problems has a manifest, too


def test_without_a_capture_there_is_a_place_for_one(tmp_path: Path) -> None:
    path = new_manifest("place", folder=tmp_path)
    assert yaml.safe_load(path.read_text()) == yaml.safe_load(TEMPLATE.read_text())
    assert "cp " not in path.read_text()
    for name, capture, error, named in (
        ("place", None, ManifestError, r"place\.yaml exists already"),
        ("../place", None, ManifestError, "not a run name"),
        ("other", tmp_path / "nowhere", CaptureError, "nowhere"),
    ):
        with pytest.raises(error, match=named):
            new_manifest(name, capture, tmp_path)
    assert not (tmp_path / "other.yaml").exists()
