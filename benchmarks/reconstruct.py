"""Photographs without poses to a model: `toolkit reconstruct` beside COLMAP's own pipeline, on the same files.

    python benchmarks/reconstruct.py [--capture PATH]... [--images FOLDER --truth CSV] [--threads 2] [--only TEXT]
                                     [--methods toolkit,known,global,colmap,hloc,given] [--queries]
                                     [--hloc CHECKOUT [--hloc-python PYTHON]] [--out FILE]

Each recording of each map session of a capture, and a folder of images with a table of poses, is a set of its own:
links to its files, in a folder per camera. `known` is the toolkit with the capture's intrinsics, `given` the capture's
own map. COLMAP has its defaults (SIFT, all pairs, the incremental mapper, a camera
per folder) without GPU. Without input, one rendered room is measured. Errors are those of all registered photographs
after a similarity to the true poses: rotation from all orientations, then scale and shift from the positions.
`--queries` localizes the capture's queries of the same device and place in each map of the toolkit after this
similarity, with default settings: with their given intrinsics and rigs where the map has the given ones, else each
image alone, with the intrinsics that were estimated for the map's camera.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import add_out, check_out, in_own_process, limit_cores, markdown_table, write_out

from toolkit.capture import Session
from toolkit.geometry import Floats


class Photographs(NamedTuple):
    """Photographs of one recording, with what is known of them."""

    images: Path
    truth: dict[str, Floats]  # world_from_cam (4, 4) by name
    session: Path | None = None  # of the map, in a capture
    part: str = ""  # its recording
    table: Path | None = None  # intrinsics, as `reconstruct --table` takes them


Sets = dict[str, Photographs]


def sets_of_capture(path: Path, folder: Path) -> Sets:
    """Link the images of each recording of a map."""
    from toolkit.capture import Capture
    from toolkit.capture.images import camera_text

    sets: Sets = {}
    for session in Capture.open(path).usable("map"):
        poses, names = session.world_from_cam(), session.subsession_of(np.arange(len(session.images)))
        for row, (part, sensor) in enumerate(zip(names, session.images["sensor_id"], strict=True)):
            name = f"{path.name} {session.device} {part}"
            target = folder / name.replace(" ", "_")
            made = Photographs(target, {}, session.path, part, target.with_suffix(".txt"))
            made = sets.setdefault(name, made)
            made.truth[own := linked(session, row, target)] = poses[row]
            assert made.table is not None
            with made.table.open("a") as stream:
                stream.write(f"{own} {camera_text(session.camera(sensor)).replace(',', '')}\n")
    return sets


def linked(session: Session, row: int, folder: Path) -> str:
    """Link an image of a session into a folder of its camera, if it is of a rig; return its name there."""
    sensor = session.images["sensor_id"].iloc[row]
    name = str(Path(sensor.rpartition("/")[2] if session.rigs is not None else "") / session.image_path(row).name)
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).symlink_to(session.image_path(row).resolve())
    return name


def set_of_table(images: Path, table: Path) -> Sets:
    """Return a folder of images with the poses of a CSV table, see `docs/own-data.md`."""
    import pandas as pd

    from toolkit.capture.tables import POSE_NAMES
    from toolkit.geometry import pose_from_qt

    rows = pd.read_csv(table)
    poses = pose_from_qt(rows[list(POSE_NAMES)].to_numpy(float))
    truth = dict(zip(rows["image"], poses, strict=True))
    return {f"{images.parent.name} {images.name}": Photographs(images.resolve(), truth)}


def run_toolkit(photographs: Photographs, work: Path, threads: int, mapper: str, known: bool) -> dict[str, Floats]:
    """Return world_from_cam by name."""
    from toolkit.capture import Capture
    from toolkit.exchange.reconstruct import reconstruct

    device = "ios" if photographs.session is None else photographs.session.name.removesuffix("_map")
    table = photographs.table if known else None
    reconstruct([photographs.images], work / "PLACE", device, mapper=mapper, table=table)
    (session,) = Capture.open(work / "PLACE").usable("map")
    names = session.own_names([np.array([row]) for row in range(len(session.images))])
    return dict(zip(names, session.world_from_cam(), strict=True))


def run_colmap(photographs: Photographs, work: Path, threads: int) -> dict[str, Floats]:
    """Return world_from_cam by name."""
    images = photographs.images
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


def run_hloc(photographs: Photographs, work: Path, threads: int) -> dict[str, Floats]:
    """Return world_from_cam by name; hloc's interpreter and checkout are in the environment."""
    from toolkit.geometry import invert

    worker = str(Path(__file__).with_name("hloc_reconstruct.py"))
    arguments = [os.environ["HLOC"], str(photographs.images), str(work), str(threads)]
    with open(work / "log", "w", encoding="utf-8") as log:
        subprocess.run([os.environ["HLOC_PYTHON"], worker, *arguments], stdout=log, stderr=log, check=True)
    found = json.loads((work / "poses.json").read_text())["poses"]
    return {name: invert(np.vstack([pose, [0, 0, 0, 1]])) for name, pose in found.items()}


def take_given(photographs: Photographs, work: Path, threads: int) -> dict[str, Floats]:
    """Copy the capture's own map; return its poses."""
    if photographs.session is None:
        return {}
    part_of_session(photographs.session, work / "PLACE" / "sessions" / photographs.session.name, photographs.part)
    return photographs.truth


METHODS: dict[str, Callable[[Photographs, Path, int], dict[str, Floats]]] = {
    "toolkit": partial(run_toolkit, mapper="incremental", known=False),
    "known": partial(run_toolkit, mapper="incremental", known=True),
    "global": partial(run_toolkit, mapper="global", known=False),
    "colmap": run_colmap,
    "hloc": run_hloc,
    "given": take_given,
}


def part_of_session(session: Path, target: Path, part: str) -> None:
    """Copy a recording of a session."""
    for path in [*session.glob("*.txt"), *session.glob("proc/*.txt")]:
        lines = path.read_text(encoding="utf-8").splitlines()
        kept = [line for line in lines if line.startswith("#") or part in line]
        (target / path.relative_to(session)).parent.mkdir(parents=True, exist_ok=True)
        (target / path.relative_to(session)).write_text("\n".join(kept) + "\n", encoding="utf-8")
    shutil.copytree(session / "raw_data" / part, target / "raw_data" / part)


def ask_queries(
    photographs: Photographs, place: Path, poses: dict[str, Floats], own_cameras: bool
) -> tuple[list[float], list[float]]:
    """Localize the queries of the same place in a map, moved to the truth; return errors in degrees and meters."""
    import pandas as pd

    from toolkit import embed, localize, retrieve
    from toolkit.capture import Capture, Trajectory
    from toolkit.capture.tables import POSE_NAMES
    from toolkit.evaluate import evaluate_scene
    from toolkit.exchange.interchange import import_images
    from toolkit.files import SceneFiles
    from toolkit.geometry import make_pose, qt_from_pose

    assert photographs.session is not None
    device = photographs.session.name.removesuffix("_map")
    given = Capture.open(photographs.session.parents[1])
    number = given[f"{device}_map"].subsessions.index(photographs.part)
    queries, root = given[f"{device}_query"], place / "sessions"
    if own_cameras:
        part_of_session(queries.path, root / f"{device}_query", queries.subsessions[number])
    session = Session.open(root / f"{device}_map")
    if session.rigs is None and poses is not photographs.truth:
        rotation, scale, shift = similarity(poses, photographs.truth)
        own = session.own_names([np.array([row]) for row in range(len(session.images))])
        ours = np.stack([poses[name] for name in own])
        ours = make_pose(rotation @ ours[:, :3, :3], scale * ours[:, :3, 3] @ rotation.T + shift)
        times, sensors = session.images["timestamp"].tolist(), session.images["sensor_id"].tolist()
        Trajectory.from_poses(times, sensors, ours).write(session.path / "trajectories.txt")
        record = json.loads((session.path / "proc/import.json").read_text())
        (session.path / "proc/import.json").write_text(json.dumps(record | {"unit": "m"}))
    if not own_cameras:
        rows = np.flatnonzero(queries.subsession_of() == queries.subsessions[number])
        names = [linked(queries, row, place.parent / "queries") for row in rows.tolist()]
        table = pd.DataFrame(qt_from_pose(queries.world_from_cam(rows, ground_truth=True)), columns=list(POSE_NAMES))
        table.assign(image=names).to_csv(place.parent / "queries.csv", index=False)
        import_images(place.parent / "queries", place, device, table=place.parent / "queries.csv")
    files = SceneFiles(place / "run", place.name)
    embed.embed_sessions(root, files.embeddings, features_dir=files.features)
    retrieve.retrieve_pairs(root, files.embeddings, out_jsonl=files.retrieval_dir, queries="all")
    localize.localize_pairs(root, files.retrieval_dir, files.poses_dir, files.features, files.maps, queries="all")
    found = evaluate_scene(root, files.poses_dir, None, None, queries="all").errors
    return found["rotation_error_deg"].tolist(), found["translation_error_m"].tolist()


def similarity(estimated: dict[str, Floats], truth: dict[str, Floats]) -> tuple[Floats, float, Floats]:
    """Return rotation (3, 3) from all orientations, and scale and shift (3,) from positions, to the truth."""
    from toolkit.alignment.robust import nearest_rotation

    names = sorted(set(estimated) & set(truth))
    ours, true = (np.stack([poses[name] for name in names]) for poses in (estimated, truth))
    rotation = nearest_rotation(np.einsum("nij,nkj->ik", true[:, :3, :3], ours[:, :3, :3])[None])[0]
    turned, centers = ours[:, :3, 3] @ rotation.T, true[:, :3, 3]
    a, b = turned - turned.mean(axis=0), centers - centers.mean(axis=0)
    scale = float((a * b).sum() / (a**2).sum())
    return rotation, scale, centers.mean(axis=0) - scale * turned.mean(axis=0)


def errors(estimated: dict[str, Floats], truth: dict[str, Floats]) -> tuple[Floats, Floats]:
    """Return rotation (degrees) and position errors (meters) after a similarity to the truth."""
    names = sorted(set(estimated) & set(truth))
    if len(names) < 3:
        return np.full(1, np.nan), np.full(1, np.nan)
    ours, true = (np.stack([poses[name] for name in names]) for poses in (estimated, truth))
    rotation, scale, shift = similarity(estimated, truth)
    meters = np.linalg.norm(scale * ours[:, :3, 3] @ rotation.T + shift - true[:, :3, 3], axis=1)
    apart = np.einsum("nji,jk,nkl->nil", true[:, :3, :3], rotation, ours[:, :3, :3])
    # Small angles from the skew part, where the trace has lost its digits.
    skew = apart - apart.transpose(0, 2, 1)
    sines = np.linalg.norm(skew.reshape(-1, 9), axis=1) / (2 * np.sqrt(2))
    angles = np.arctan2(sines, (np.trace(apart, axis1=1, axis2=2) - 1) / 2)
    return np.degrees(angles), meters


def measure(
    method: str, photographs: Photographs, threads: int, ask: bool
) -> tuple[float, float, dict[str, Floats], tuple[list[float], list[float]]]:
    """Run a method in this process; return wall and CPU seconds, poses, and errors of queries."""
    import pycolmap  # noqa: F401 - imports are not timed

    import toolkit.exchange.reconstruct  # noqa: F401

    with tempfile.TemporaryDirectory() as folder:
        cpu, wall = os.times(), time.perf_counter()
        try:
            poses = METHODS[method](photographs, Path(folder), threads)
        except Exception as error:  # a method that fails is a row, not the end
            print(f"{method}: {error}")
            poses = {}
        end, wall_s = os.times(), time.perf_counter() - wall
        place = Path(folder) / "PLACE"
        asked: tuple[list[float], list[float]] = ([], [])
        if ask and place.is_dir() and photographs.session is not None:
            asked = ask_queries(photographs, place, poses, method in ("known", "given"))
        # hloc runs in a child process
        cpu_s = sum(end[:4]) - sum(cpu[:4])
        return wall_s, cpu_s, poses, asked


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, action="append", default=[])
    parser.add_argument("--images", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", default="", help="only sets whose names contain this text")
    parser.add_argument("--methods", default="toolkit,global,colmap")
    parser.add_argument("--queries", action="store_true", help="localize the capture's queries in the maps")
    parser.add_argument("--hloc", help="checkout of cvg/Hierarchical-Localization, for the method hloc")
    parser.add_argument("--hloc-python", default=sys.executable, help="interpreter with hloc's needs (default: this)")
    add_out(parser)
    arguments = parser.parse_args()
    check_out(parser, arguments.out)
    limit_cores(arguments.threads)
    if "hloc" in arguments.methods.split(","):
        if arguments.hloc is None:
            parser.error("hloc: give --hloc CHECKOUT.")
        os.environ |= {"HLOC": str(Path(arguments.hloc).resolve()), "HLOC_PYTHON": arguments.hloc_python}
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
        for name, photographs in sets.items():
            truth = photographs.truth
            for method in arguments.methods.split(",") if arguments.only in name else []:
                load = os.getloadavg()[0]
                job = method, photographs, arguments.threads, arguments.queries
                wall_s, cpu_s, poses, asked = in_own_process(measure, *job)
                degrees, meters = errors(poses, truth)
                middle, high = (f"{np.median(meters):.4f}", f"{meters.max():.4f}")
                rows.append([name, method, f"{len(poses)} / {len(truth)}", f"{np.median(degrees):.3f}",
                             f"{degrees.max():.3f}", middle, high, f"{wall_s:.1f}", f"{cpu_s:.1f}",
                             f"{load:.1f}"])  # fmt: skip
                if arguments.queries:
                    within = sum(deg < 1 and off < 0.1 for deg, off in zip(*asked, strict=True))
                    middles = [f"{np.median(values):.3f}" if values else "" for values in asked]
                    rows[-1] += [f"{within} / {len(asked[0])}", *middles]
                print(*rows[-1], sep="  ", flush=True)
                document.setdefault(name, {})[method] = {
                    "registered": len(poses), "images": len(truth), "degrees": degrees.tolist(),
                    "meters": meters.tolist(), "wall_s": wall_s, "cpu_s": cpu_s, "load_before": load,
                    "queries": asked,
                }  # fmt: skip
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    header = ["set", "method", "registered", "median, deg", "largest, deg", "median, m", "largest, m", "s", "CPU s",
              "load before"]  # fmt: skip
    header += ["queries within 1 deg, 0.1 m", "deg", "m"] if arguments.queries else []
    text = markdown_table(header, rows) + "\n"
    print(text)
    write_out(arguments.out, text, document)


if __name__ == "__main__":
    main()
