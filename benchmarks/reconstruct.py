"""Photographs without poses to a model: `toolkit reconstruct` beside COLMAP's own pipeline, on the same files.

    python benchmarks/reconstruct.py [--capture PATH]... [--images FOLDER --truth CSV] [--threads 2] [--only TEXT]
                                     [--methods toolkit,global,colmap] [--out FILE]

Each recording of each map session of a capture, and a folder of images with a table of poses, is a set of its own:
links to its files, in a folder per camera. COLMAP has its defaults (SIFT, all pairs, the incremental mapper, a camera
per folder) without GPU. Without input, one rendered room is measured. Errors are those of all registered photographs
after a similarity to the true poses: rotation from all orientations, then scale and shift from the positions.
"""

import argparse
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import add_out, check_out, in_own_process, limit_cores, markdown_table, write_out

from toolkit.geometry import Floats

Sets = dict[str, tuple[Path, dict[str, Floats]]]


def sets_of_capture(path: Path, folder: Path) -> Sets:
    """Link the images of each recording of a map; return the folders, and true world_from_cam by name."""
    from toolkit.capture import Capture

    sets: Sets = {}
    for session in Capture.open(path).usable("map"):
        poses, names = session.world_from_cam(), session.subsession_of(np.arange(len(session.images)))
        for row, (part, sensor) in enumerate(zip(names, session.images["sensor_id"], strict=True)):
            name = f"{path.name} {session.device} {part}"
            target, truth = sets.setdefault(name, (folder / name.replace(" ", "_"), {}))
            camera = sensor.rpartition("/")[2] if session.rigs is not None else ""
            own = str(Path(camera) / session.image_path(row).name)
            (target / own).parent.mkdir(parents=True, exist_ok=True)
            (target / own).symlink_to(session.image_path(row).resolve())
            truth[own] = poses[row]
    return sets


def set_of_table(images: Path, table: Path) -> Sets:
    """Return a folder of images with the poses of a CSV table, see `docs/own-data.md`."""
    import pandas as pd

    from toolkit.capture.tables import POSE_NAMES
    from toolkit.geometry import pose_from_qt

    rows = pd.read_csv(table)
    poses = pose_from_qt(rows[list(POSE_NAMES)].to_numpy(float))
    return {f"{images.parent.name} {images.name}": (images.resolve(), dict(zip(rows["image"], poses, strict=True)))}


def run_toolkit(images: Path, work: Path, threads: int, mapper: str) -> dict[str, Floats]:
    """Return world_from_cam by name."""
    from toolkit.capture import Capture
    from toolkit.exchange.reconstruct import reconstruct

    reconstruct([images], work / "PLACE", mapper=mapper)
    session = Capture.open(work / "PLACE")["ios_map"]
    names = session.own_names([np.array([row]) for row in range(len(session.images))])
    return dict(zip(names, session.world_from_cam(), strict=True))


def run_colmap(images: Path, work: Path, threads: int) -> dict[str, Floats]:
    """Return world_from_cam by name."""
    import pycolmap

    from toolkit.geometry import make_pose

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    database, cpu = work / "database.db", pycolmap.Device.cpu
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    mode = pycolmap.CameraMode.PER_FOLDER
    pycolmap.extract_features(database, images, camera_mode=mode, extraction_options=extraction, device=cpu)
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    pycolmap.match_exhaustive(database, matching_options=matching, device=cpu)
    (work / "models").mkdir()
    options = pycolmap.IncrementalPipelineOptions(num_threads=threads, min_model_size=3)
    models = pycolmap.incremental_mapping(database, images, work / "models", options)
    if not models:
        return {}
    largest = max(models.values(), key=lambda model: model.num_reg_images())
    poses = {image.name: image.cam_from_world().inverse() for image in largest.images.values() if image.has_pose}
    return {name: make_pose(pose.rotation.matrix(), pose.translation) for name, pose in poses.items()}


METHODS: dict[str, Callable[[Path, Path, int], dict[str, Floats]]] = {
    "toolkit": partial(run_toolkit, mapper="incremental"),
    "global": partial(run_toolkit, mapper="global"),
    "colmap": run_colmap,
}


def errors(estimated: dict[str, Floats], truth: dict[str, Floats]) -> tuple[Floats, Floats]:
    """Return rotation (degrees) and position errors (meters) after a similarity to the truth."""
    from toolkit.alignment.robust import nearest_rotation

    names = sorted(set(estimated) & set(truth))
    if len(names) < 3:
        return np.full(1, np.nan), np.full(1, np.nan)
    ours, true = (np.stack([poses[name] for name in names]) for poses in (estimated, truth))
    rotation = nearest_rotation(np.einsum("nij,nkj->ik", true[:, :3, :3], ours[:, :3, :3])[None])[0]
    turned, centers = ours[:, :3, 3] @ rotation.T, true[:, :3, 3]
    turned, centers = turned - turned.mean(axis=0), centers - centers.mean(axis=0)
    scale = (turned * centers).sum() / (turned**2).sum()
    apart = np.einsum("nji,jk,nkl->nil", true[:, :3, :3], rotation, ours[:, :3, :3])
    # Small angles from the skew part, where the trace has lost its digits.
    skew = apart - apart.transpose(0, 2, 1)
    sines = np.linalg.norm(skew.reshape(-1, 9), axis=1) / (2 * np.sqrt(2))
    angles = np.arctan2(sines, (np.trace(apart, axis1=1, axis2=2) - 1) / 2)
    return np.degrees(angles), np.linalg.norm(scale * turned - centers, axis=1)


def measure(method: str, images: Path, threads: int) -> tuple[float, float, dict[str, Floats]]:
    """Run a method in this process; return wall and CPU seconds and poses."""
    import pycolmap  # noqa: F401 - imports are not timed

    import toolkit.exchange.reconstruct  # noqa: F401

    with tempfile.TemporaryDirectory() as folder:
        cpu, wall = os.times(), time.perf_counter()
        try:
            poses = METHODS[method](images, Path(folder), threads)
        except Exception as error:  # a method that fails is a row, not the end
            print(f"{method}: {error}")
            poses = {}
        end = os.times()
        return time.perf_counter() - wall, end.user + end.system - cpu.user - cpu.system, poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, action="append", default=[])
    parser.add_argument("--images", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", default="", help="only sets whose names contain this text")
    parser.add_argument("--methods", default=",".join(METHODS))
    add_out(parser)
    arguments = parser.parse_args()
    check_out(parser, arguments.out)
    limit_cores(arguments.threads)
    folder = Path(tempfile.mkdtemp())
    try:
        captures = arguments.capture
        if not captures and arguments.images is None:
            from toolkit.synthetic import render_capture

            captures = [render_capture(folder / "demo", 1, 20)]
        sets: Sets = {}
        for capture in captures:
            sets |= sets_of_capture(capture, folder / capture.name)
        if arguments.images is not None:
            sets |= set_of_table(arguments.images, arguments.truth)
        rows, document = [], dict[str, Any]()
        for name, (images, truth) in sets.items():
            for method in arguments.methods.split(",") if arguments.only in name else []:
                load = os.getloadavg()[0]
                wall_s, cpu_s, poses = in_own_process(measure, method, images, arguments.threads)
                degrees, meters = errors(poses, truth)
                middle, high = (f"{np.median(meters):.4f}", f"{meters.max():.4f}")
                rows.append([name, method, f"{len(poses)} / {len(truth)}", f"{np.median(degrees):.3f}",
                             f"{degrees.max():.3f}", middle, high, f"{wall_s:.1f}", f"{cpu_s:.1f}",
                             f"{load:.1f}"])  # fmt: skip
                print(*rows[-1], sep="  ", flush=True)
                document.setdefault(name, {})[method] = {
                    "registered": len(poses), "images": len(truth), "degrees": degrees.tolist(),
                    "meters": meters.tolist(), "wall_s": wall_s, "cpu_s": cpu_s, "load_before": load,
                }  # fmt: skip
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    header = ["set", "method", "registered", "median, deg", "largest, deg", "median, m", "largest, m", "s", "CPU s",
              "load before"]  # fmt: skip
    text = markdown_table(header, rows) + "\n"
    print(text)
    write_out(arguments.out, text, document)


if __name__ == "__main__":
    main()
