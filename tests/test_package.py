"""The installed package: what a wheel holds, and what it does where there is no clone and no extra."""

import importlib.metadata
import os
import subprocess
import sys
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.sequences.drifting import drive
from toolkit import __version__
from toolkit.__main__ import app
from toolkit.errors import EXTRAS, ManifestError
from toolkit.features.features import create_extractor
from toolkit.manifest import FeaturesSettings, LocalizeSettings, SequenceSettings, find_manifest, load_manifest
from toolkit.runs.cluster import open_cluster
from toolkit.sequences.pose_graph import place_piece

WAY = drive(np.random.default_rng(6))
ROOT = Path(__file__).resolve().parents[1]
WITHOUT_EXTRAS = """
import sys
for name in {absent}:
    sys.modules[name] = None
from toolkit.localize import Map, localize_image
from toolkit.__main__ import app
"""


def test_a_manifest_of_the_toolkit_is_found_by_its_name_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = find_manifest("crocodl-hydro")
    assert path == Path("data_manifests/crocodl-hydro.yaml")
    assert path.read_bytes() == (ROOT / path).read_bytes()
    assert sorted(str(file) for file in Path().rglob("*.yaml")) == [
        "data_manifests/base/crocodl.yaml", "data_manifests/crocodl-hydro.yaml",
    ]  # fmt: skip
    demo = load_manifest(find_manifest("data_manifests/demo.yaml"))  # as the README of a clone names it
    assert Path(demo.output_root) == tmp_path / "runs"
    Path("data_manifests/demo.yaml").write_text("description: mine\ndemo_data: {}\n")
    assert load_manifest(find_manifest("demo")).description == "mine", "a user's own comes first"
    Path("other.yaml").write_text("description: beside\n")
    assert find_manifest("other.yaml") == Path("other.yaml")
    # Where a folder is named, this very file is meant.
    for name, named in (("dmeo", "dmeo: .*Did you mean 'demo'"), ("gone/demo.yaml", r"gone.*demo\.yaml")):
        with pytest.raises(ManifestError, match=named):
            load_manifest(find_manifest(name))


@pytest.mark.parametrize(("package", "ask", "installed"), [
    ("distributed", lambda: open_cluster("local").__enter__(), "dask-jobqueue"),
    ("transformers", lambda: create_extractor("superpoint", FeaturesSettings()), "'transformers"),
    ("gtsam", lambda: place_piece(WAY.odometry, WAY.queries, SequenceSettings()), "gtsam"),
])  # fmt: skip
def test_without_an_extra_one_sentence_says_what_to_install(
    package: str, ask: Callable[[], object], installed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ManifestError, match=f"{package} cannot be imported .* pip install .*{installed}"):
        ask()


def test_one_branch_of_the_settings_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    app(["settings", "localize.pnp"], standalone_mode=False)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["localize:", "  pnp:"]
    assert all(line.startswith("    ") for line in lines[2:])
    assert yaml.safe_load("\n".join(lines))["localize"]["pnp"] == LocalizeSettings().pnp.model_dump()
    with pytest.raises(ManifestError, match=r"no section 'pmp'.*Did you mean 'pnp'"):
        app(["settings", "localize.pmp"], standalone_mode=False)


def test_localization_needs_no_package_of_an_extra(tmp_path: Path) -> None:
    absent = [package for packages in EXTRAS.values() for package in packages]
    subprocess.run([sys.executable, "-c", WITHOUT_EXTRAS.format(absent=absent)], cwd=tmp_path, check=True)


def test_a_missing_package_of_an_extra_is_one_sentence(tmp_path: Path) -> None:
    code = "import sys; sys.modules['papermill'] = None; from toolkit.__main__ import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "run", "demo"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("Error: The package papermill cannot be imported")
    assert "pip install" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "data").exists(), "told before anything is rendered"


def test_every_extra_is_in_the_metadata() -> None:
    described = importlib.metadata.metadata("visual-localization").get_all("Provides-Extra") or []
    assert {*EXTRAS, "all"} <= set(described)


@pytest.mark.slow
def test_a_wheel_runs_the_demo_in_an_empty_folder(tmp_path: Path) -> None:
    """The environment has the wheel; other packages are taken from this one, without its link to the clone."""
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-q", "-w", str(tmp_path)]
    done = subprocess.run([*build, str(ROOT)], capture_output=True, text=True, check=False)
    if done.returncode and "hatchling" in done.stderr:
        pytest.skip("hatchling is not installed")
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == {
        *(str(file.relative_to(ROOT)) for file in (ROOT / "toolkit").rglob("*")
          if file.is_file() and "__pycache__" not in file.parts),
        *(f"toolkit/{file.relative_to(ROOT)}" for folder in ("notebooks", "data_manifests")
          for file in (ROOT / folder).rglob("*")
          if file.is_file() and not {"__pycache__", ".ipynb_checkpoints"} & set(file.parts)),
    }  # fmt: skip
    venv.create(tmp_path / "env", with_pip=False, symlinks=True)
    (packages,) = (tmp_path / "env").glob("lib/python*/site-packages")
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(packages), str(wheel)], check=True
    )
    here = Path(importlib.metadata.distribution("numpy").locate_file(""))
    (packages / "others.pth").write_text(f"{here}\n")
    place = tmp_path / "place"
    place.mkdir()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def visloc(*arguments: str) -> str:
        python = tmp_path / "env" / "bin" / "python"
        asked = [str(python), "-c", "from toolkit.__main__ import main; main()", *arguments]
        ended = subprocess.run(asked, cwd=place, env=environment, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return ended.stdout

    assert __version__ in visloc("--version")
    small = ["demo_data.rooms=1", "demo_data.frames=6", "demo_data.hard=false", "devices=[ios]"]
    told = visloc("run", "demo", "--in-place", *(part for one in small for part in ("--set", one)))
    assert "Report: " in told
    assert (place / "runs" / "demo" / "report.html").is_file()
    assert (place / "data_manifests" / "demo.yaml").is_file()
    photograph = next((place / "data").rglob("ios_query/raw_data/**/*.jpg"))
    assert "ok" in visloc("localize", "runs/demo", str(photograph))
    assert {path.name for path in place.iterdir()} == {"data", "data_manifests", "runs"}
