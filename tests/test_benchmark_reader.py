"""Our files read by the benchmark's own code: a clone of cvg/crocodl-benchmark that $CROCODL_BENCHMARK names."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from toolkit.capture import Capture, Trajectory
from toolkit.exchange.export import export_table
from toolkit.exchange.interchange import import_images
from toolkit.exchange.submission import collect
from toolkit.files import SceneFiles

DEVICES = ("ios", "hl", "spot")
# Runs outside this repository, with the clone on its path. Prints the poses of all images and of a zip file.
READ = """
import json, sys, tempfile, zipfile
from pathlib import Path
from scantools.capture import Capture, Trajectories
from lamar.combine_results_crocodl import DEVICES, SCENES, combine_results
poses = {}
for place in sys.argv[2:]:
    for name, session in Capture.load(Path(place)).sessions.items():
        known = session.trajectories or session.proc.alignment_trajectories
        for time, sensor in session.images.key_pairs():
            pose = session.get_pose(time, sensor, known)
            poses[f"{Path(place).name} {name} {time} {sensor}"] = pose.to_4x4mat().tolist()
folder = Path(tempfile.mkdtemp())
with zipfile.ZipFile(sys.argv[1]) as archive:
    archive.extractall(folder)
for path in folder.glob("*_query_*.txt"):
    found = Trajectories.load(path)
    poses |= {f"{path.name} {t} {d}": found[t, d].to_4x4mat().tolist() for t, d in found.key_pairs()}
names = [f"{s}_map_{m}_query_{q}" for s in SCENES for m in DEVICES for q in DEVICES]
paths = {f"{name}_path": folder / f"{name[:name.index('_')].upper()}{name[name.index('_'):]}.txt" for name in names}
combine_results(folder / "description.txt", paths, folder / "out")
print(json.dumps({"poses": poses, "zip": str(next((folder / "out").glob("*.zip")))}))
"""


@pytest.fixture
def benchmark() -> str:
    root = os.environ.get("CROCODL_BENCHMARK", "")
    if not (Path(root) / "scantools" / "capture").is_dir():
        pytest.skip("needs a clone of cvg/crocodl-benchmark: set CROCODL_BENCHMARK to its folder")
    return root


def test_the_benchmark_reads_what_we_write(benchmark: str, small_capture: Path, tmp_path: Path) -> None:
    session = Capture.open(small_capture)["spot_map"]
    table = export_table(session, tmp_path / "spot.csv")
    import_images(session.path / "raw_data", tmp_path / "OWN", "spot", "map", table)
    expected = {}
    for place in (small_capture, tmp_path / "OWN"):
        for name, opened in ((name, Capture.open(place)[name]) for name in Capture.open(place)):
            world_from_cams = opened.world_from_cam(ground_truth=opened.split == "query")
            for row, pose in zip(opened.images.itertuples(), world_from_cams, strict=True):
                expected[f"{place.name} {name} {row.timestamp} {row.sensor_id}"] = pose
    for scene in ("HYDRO", "SUCCULENT"):
        (tmp_path / scene).symlink_to(small_capture)
        for query in DEVICES:
            truth = Capture.open(small_capture)[f"{query}_query"].ground_truth
            assert truth is not None
            for mapped in DEVICES:
                truth.write(SceneFiles(tmp_path / "run", scene).poses_txt(mapped, query))
    rows = [{"scene": s, "parameters": {"sessions_root": f"{tmp_path / s}/sessions"}} for s in ("HYDRO", "SUCCULENT")]
    (tmp_path / "run" / "run.json").write_text(json.dumps({"stages": rows}))
    ours = collect([tmp_path / "run"], "Ours.", queries="original").write()
    for scene, name in (("HYDRO", "HYDRO"), ("SUCCULENT", "SUCCU")):
        for mapped in DEVICES:
            for query in DEVICES:
                poses = Trajectory.read(SceneFiles(tmp_path / "run", scene).poses_txt(mapped, query))
                for time, device, pose in zip(poses.timestamps, poses.device_ids, poses.world_from_device, strict=True):
                    expected[f"{name}_map_{mapped}_query_{query}.txt {time} {device}"] = pose

    command = [sys.executable, "-c", READ, str(ours), str(small_capture), str(tmp_path / "OWN")]
    environment = os.environ | {"PYTHONPATH": benchmark}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.splitlines()[-1])
    assert answer["poses"].keys() == expected.keys()
    for key, pose in answer["poses"].items():
        np.testing.assert_allclose(pose, expected[key], rtol=0, atol=1e-12, err_msg=key)
    with zipfile.ZipFile(ours) as mine, zipfile.ZipFile(answer["zip"]) as theirs:
        assert mine.namelist() == theirs.namelist()
        assert all(mine.read(name) == theirs.read(name) for name in mine.namelist())
