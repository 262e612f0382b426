"""The commands of README.md and of the pages of docs/, run as they stand and in their order, on small inputs."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import PIL.Image
import pycolmap
import pytest
from typer.testing import CliRunner

from tests.datasets.test_layouts import seven_scenes
from tests.exchange.test_submission import DEVICES, make_capture, make_poses
from tests.test_docs import ROOT, commands_of
from tests.unattended import no_kernels
from toolkit.__main__ import app
from toolkit.capture import Session
from toolkit.exchange.export import export_table
from toolkit.exchange.georeference import geographic
from toolkit.geometry import Floats, pose_from_qt

FIRST = [ROOT / name for name in ("README.md", "docs/own-data.md", "docs/coming-from.md", "docs/settings.md",
                                  "docs/index.md", "docs/reading-results.md")]  # fmt: skip
"""Pages that make what the others change, in their order."""
PAGES = [*FIRST, *sorted({*(ROOT / "docs").rglob("*.md")} - {*FIRST})]
NOT_RUN = {
    "git clone": "needs the network",
    "python -m pip": "needs the network",
    ".venv/bin/python -m pip": "needs the network",
    "visloc download": "needs the network; tests/datasets/test_download.py has a server",
    "make demo": "installs the packages; tests/test_package.py installs a wheel and runs the demo",
    "make lab": "serves until it is stopped; tests/test_lab.py starts it",
    "make test-gpu": "needs a GPU",
    "make bench-gpu": "needs a GPU",
    "CUDA_VISIBLE_DEVICES=1 visloc run MANIFEST": "needs two GPUs",
    "visloc run data_manifests/my-place.yaml --set embed.model=megaloc": "needs the weights of MegaLoc",
    "visloc run data_manifests/my-place.yaml --set localize.method=hybrid": "needs weights of VGGT, Depth Anything 3",
    "visloc run MANIFEST": "a whole run for each setting; tests/test_docs.py checks that the settings exist",
    "visloc compare": "needs the true poses of queries; tests/report/test_comparison.py has them",
    "visloc record": "opens a window",
    ".venv/bin/rerun": "opens a window",
    "visloc run data_manifests/CHESS.yaml": "needs the photographs of 7-Scenes; tests/test_accuracy.py has real ones",
    "visloc run data_manifests/crocodl-hydro.yaml": "needs the photographs of CroCoDL",
    "visloc run data_manifests/strecha.yaml": "needs a real capture; so does tests/test_accuracy.py",
    "visloc run data_manifests/NIGHT.yaml": "needs the photographs of Strecha et al.",
    "visloc import dataset strecha": "needs the photographs of Strecha et al.",
    "make bench-paper": "needs the photographs of Strecha et al.",
    ".venv/bin/python benchmarks/": "needs a real capture; tests/test_benchmark_reader.py has their options",
    ".venv/bin/python -m pytest": "tests of their own",
    ".venv/bin/python -m tests.fuzz": "takes an hour; tests/fuzz/ has the first seconds",
    "visloc demo-data --out data/BIG": "renders for minutes; tests/synthetic/ has small captures",
    "export CAPTURES": "a variable of commands that are not run",
    "PHOTOS=": "a variable of commands that are not run",
}
"""What cannot run here, by how its line begins, and why."""
ALONE = (
    "visloc reconstruct PHOTOS MY_PLACE\n",
    "visloc reconstruct PHOTOS MY_PLACE --distance",
    "visloc import colmap",
    "visloc import transforms",
    "visloc import images PHOTOS",
    "visloc import images FRAMES",
    "visloc import panoramas MAP",
)
"""Commands that make a capture of their own: the pages name them as alternatives, so no earlier one is there."""
WITH_KERNELS = ("visloc run data_manifests/my-place.yaml",)
"""Runs of all stages whose notebooks have kernels."""
ORIGIN = np.array([47.37, 8.54, 408.0])
"""Latitude and longitude (degrees) and altitude (meters) of the photographs."""


def commands() -> Iterator[str]:
    """Yield the commands of the pages in their order, each once."""
    lines = [re.sub(" +", " ", line) for page in PAGES for line in commands_of(page)]
    yield from dict.fromkeys(lines)


def test_what_is_not_run_is_on_a_page() -> None:
    lines = [*commands()]
    assert {*WITH_KERNELS} < {*lines}
    assert all(any(f"{line}\n".startswith(start) for line in lines) for start in (*NOT_RUN, *ALONE))
    assert len([line for line in lines if not line.startswith((*NOT_RUN,))]) > 35


@pytest.fixture
def inputs(small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the input that the pages name: photographs, tables, frames, panoramas, a data set."""
    monkeypatch.chdir(tmp_path)
    posed, tables = dict[str, Floats](), []
    for split in ("map", "query"):
        session = Session.open(small_capture / "sessions" / f"ios_{split}")
        table = pd.read_csv(export_table(session, tmp_path / "all.csv", ground_truth=split == "query"))
        for row in table.to_dict("records"):
            name = f"IMG_{len(posed) + 1:04d}.jpg"
            pose = pose_from_qt([row[key] for key in ("qw", "qx", "qy", "qz", "tx", "ty", "tz")])
            posed[name] = pose
            take(session.path / "raw_data" / row["image"], Path("PHOTOS") / name, pose)
            tables.append({**row, "image": name})
    names = [*posed]
    for folder, chosen in {"MORE": names[6:8], "QUERIES": names[7:9], "IMAGES": names, "FRAMES": names[:4]}.items():
        for name in chosen:
            new = f"{folder}_{name}" if folder in ("MORE", "QUERIES") else name
            take(Path("PHOTOS") / name, Path(folder) / new, posed[name], (640, 480) if folder == "FRAMES" else None)
    shutil.copy(Path("PHOTOS") / names[-1], "photo.jpg")
    pd.DataFrame(tables).to_csv("poses.csv", index=False)
    write_transforms(Path("PHOTOS/transforms.json"), tables, posed)
    write_recording(names[:4], posed)
    for folder in ("MAP_PANORAMAS", "PANORAMAS"):
        Path(folder).mkdir()
        sphere = np.random.default_rng(0).integers(0, 255, (256, 512, 3), np.uint8)
        PIL.Image.fromarray(sphere).save(Path(folder) / names[0])
    seven_scenes(tmp_path / "DATASETS" / "7scenes")
    Path("method.txt").write_text("SIFT, thresholds as published, https://example.org/code")
    for scene in ("HYDRO", "SUCCULENT"):
        write_challenge_run(Path("runs") / scene.lower(), make_capture(tmp_path / "CAPTURES", scene))
    return tmp_path


def take(source: Path, target: Path, world_from_cam: Floats, size: tuple[int, int] | None = None) -> None:
    """Copy a photograph, with the tags of a phone: position, and focal length as of 35 mm film."""
    latitude, longitude, altitude = geographic(world_from_cam[None, :3, 3], ORIGIN)[0]
    exif = PIL.Image.Exif()
    exif.get_ifd(0x8825).update({1: "N", 2: (latitude, 0.0, 0.0), 3: "E", 4: (longitude, 0.0, 0.0), 6: altitude})
    exif.get_ifd(0x8769)[0xA405] = 28
    target.parent.mkdir(exist_ok=True)
    with PIL.Image.open(source) as image:
        (image.resize(size) if size else image).save(target, quality=95, exif=exif)


def write_transforms(path: Path, rows: list[dict[str, object]], posed: dict[str, Floats]) -> None:
    """Write the poses as nerfstudio does: axes of OpenGL."""
    frames = []
    for row in rows:
        fx, fy, cx, cy = [float(value) for value in str(row["params"]).split()][:4]
        matrix = posed[str(row["image"])] @ np.diag([1.0, -1.0, -1.0, 1.0])
        camera = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": row["width"], "h": row["height"]}
        frames.append({"file_path": row["image"], "transform_matrix": matrix.tolist(), **camera})
    path.write_text(json.dumps({"frames": frames}))


def write_recording(names: list[str], posed: dict[str, Floats]) -> None:
    """Write times, odometry (TUM), GPS fixes and depth maps of the frames."""
    seconds = [1_700_000_000 + number for number in range(len(names))]
    pairs = [*zip(seconds, names, strict=True)]
    Path("times.txt").write_text("".join(f"{time} {name}\n" for time, name in pairs))
    centers = [posed[name][:3, 3] for name in names]
    lines = [f"{time} {x} {y} {z} 0 0 0 1\n" for time, (x, y, z) in zip(seconds, centers, strict=True)]
    Path("odometry.txt").write_text("".join(lines))
    fixes = pd.DataFrame(geographic(np.array(centers), ORIGIN), columns=["latitude", "longitude", "altitude"])
    fixes.assign(image=names, accuracy=5.0).to_csv("gps.csv", index=False)
    Path("DEPTH").mkdir()
    for name in names:
        with PIL.Image.open(Path("FRAMES") / name) as image:
            PIL.Image.new("I;16", image.size, 2000).save(Path("DEPTH") / f"{Path(name).stem}.png")


def write_challenge_run(run: Path, capture: Path) -> None:
    """Write the poses and references of all pairs of a capture of the challenge."""
    for pair in product(DEVICES, DEVICES):
        make_poses(run, capture.name, *pair)
    stages = [{"scene": capture.name, "parameters": {"sessions_root": str(capture / "sessions")}}]
    (run / "run.json").write_text(json.dumps({"manifest": {}, "stages": stages}))


def write_model(found: Path) -> None:
    """Write the model that `reconstruct` has found as that of IMAGES."""
    model = pycolmap.Reconstruction(found)
    for image in model.images.values():
        image.name = Path(image.name).name
    Path("MODEL").mkdir()
    model.write("MODEL")


@pytest.mark.slow
def test_commands_run_as_they_stand(inputs: Path, released_weights: None) -> None:
    for line in commands():
        if line.startswith((*NOT_RUN,)):
            continue
        if line.startswith("visloc export"):
            name = "my-place" if "runs/my-place" in line else "MY_PLACE"  # the latter is a reconstruction with queries
            restore(name, "MY_PLACE", f"runs/{name}")
        elif f"{line}\n".startswith(ALONE):
            for path in ("MY_PLACE", "runs/MY_PLACE", "data_manifests/MY_PLACE.yaml"):
                remove(Path(path))
        if "runs/demo" in line:
            shutil.copytree("runs/my-place", "runs/demo")
        if "rough.txt" in line:  # the same format
            shutil.copy("runs/my-place/MY_PLACE/poses/MY_PLACE_map_ios_query_ios.txt", "rough.txt")
        words = shell_words(line)
        if words[0] == ".venv/bin/python":  # from the repository's root
            subprocess.run(
                [sys.executable, *words[1:]], cwd=ROOT, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
            )
            continue
        assert words[0] == "visloc", line
        # Other runs have the same notebooks.
        with nullcontext() if line in WITH_KERNELS else no_kernels():
            done = CliRunner().invoke(app, words[1:], catch_exceptions=True)
        assert done.exit_code == 0, f"{line}\n{done.output[-2000:]}\n{done.exception}"
        if line.startswith("visloc run MY_PLACE"):
            keep("MY_PLACE", "MY_PLACE", "runs/MY_PLACE")
        if line == "visloc run data_manifests/my-place.yaml":
            keep("my-place", "MY_PLACE", "runs/my-place")
        if "reconstruct" in line and not Path("MODEL").exists():
            write_model(next(Path("MY_PLACE/reconstruction/models").iterdir()))
    for made in (
        "above.png",
        "out/queries.geojson",
        "runs/my-place/report.html",
        "data_manifests/CHESS.yaml",
        "out/features.h5",
        "runs/hydro/submission.zip",
        "runs/my-place-poses-rough.txt/report.html",
        "runs/my-place-samples-6/report.html",
    ):
        assert Path(made).is_file(), made
    assert [*Path("out/pictures").rglob("*.jpg")]


def shell_words(line: str) -> list[str]:
    """Return the words of a command, with patterns of files replaced by the files, as a shell does."""
    found = [(word, sorted(map(str, Path().glob(word)))) for word in shlex.split(line, comments=True)]
    return [name for word, files in found for name in (files if "*" in word and files else [word])]


def keep(name: str, *paths: str) -> None:
    """Move files to `kept/<name>`.

    A copy of a capture would not do: its links to photographs are not the user's own any more.
    """
    for path in paths:
        (Path("kept") / name / path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).rename(Path("kept") / name / path)


def restore(name: str, *paths: str) -> None:
    for path in paths:
        if (Path("kept") / name / path).exists():
            remove(Path(path))
            (Path("kept") / name / path).rename(path)


def remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
