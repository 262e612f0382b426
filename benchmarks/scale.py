"""Rooms with N rendered map images, from capture to report: seconds, memory and files of each stage, and how they grow.

    python benchmarks/scale.py [--images 60 240] [--folder runs/scale] [--threads 2] [--resume] [--set KEY=VALUE]
    python benchmarks/scale.py --bookkeeping 10000 100000 [--folder runs/scale]

Each room has 50 map images of a phone, 480 x 360, and 3 or 4 queries, so more images are more of the same. Captures are
kept in FOLDER/N/ROOMS and used again. The run is headless, in a process of its own, with VLAD and SIFT alone: learned
features on a CPU take the same seconds for each image whatever the size, and hide what grows. Seconds are those of
run.json, without starting a kernel; of `localize`, those until the map stands are a row of their own. Memory is that of
all processes of the run, sampled twice a second: the sum of their proportional sets (PSS: a page that several have
mapped counts once in all), and of their resident sets (RSS: it counts in each). The exponent is the slope of a line
through log seconds over log images: 1 is linear. FOLDER/growth.png draws it, FOLDER/scale.md and scale.json hold the
figures. With --resume, sizes that were measured before are taken as they were, and a stopped run goes on.

With --bookkeeping, what needs no pixels, for maps of poses and random descriptors along straight walks, each size in a
process of its own: peak memory is the process's largest resident set while a step runs, less what it had before.
"""

import argparse
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from common import add_out, check_out, in_own_process, limit_cores, markdown_table, scaled, write_out

from toolkit.files import SceneFiles

FRAMES, STEP = 50, 8
"""Map images of a room. It has half as many query images, of which every eighth is asked."""
QUERIES = "keyframes_scale"
SCENE = "ROOMS"
STAGES = ("explore", "embed", "retrieve", "map", "localize", "evaluate", "visualize", "report")
"""Rows of the table; the map is the first part of the stage `localize`, and the report what follows the last stage."""
MANIFEST: dict[str, Any] = {
    "description": "Rendered rooms.",
    "queries": QUERIES,
    "embed": {"model": "vlad"},
    "localize": {"method": "pnp", "features": {"kinds": ["sift"], "escalation": []}},
}
MIB = 2**20


class Watch(threading.Thread):
    """Samples the memory of a run's processes, and which stage they are at."""

    def __init__(self, process: subprocess.Popen[bytes], run: Path, log: Path) -> None:
        super().__init__(daemon=True)
        self.process, self.run_dir, self.log = process, run, log
        self.peaks: dict[str, dict[str, float]] = {}
        """Highest sums by stage, in MB: `pss`, `rss`."""
        self.began: dict[str, float] = {}
        """When a stage was first seen, seconds."""
        self.start()

    def run(self) -> None:
        import psutil

        me = psutil.Process(self.process.pid)
        while self.process.poll() is None:
            with suppress(psutil.Error):
                stage = self._stage()
                self.began.setdefault(stage, time.perf_counter())
                sums = {"pss": 0.0, "rss": 0.0}
                for process in [me, *me.children(recursive=True)]:
                    with suppress(psutil.Error, OSError):
                        sums["rss"] += process.memory_info().rss / MIB
                        sums["pss"] += _proportional_mb(process.pid)
                peak = self.peaks.setdefault(stage, dict.fromkeys(sums, 0.0))
                for name, total in sums.items():
                    peak[name] = max(peak[name], total)
            time.sleep(0.5)
        self.ended = time.perf_counter()

    def _stage(self) -> str:
        """Return the stage that the log names last: each begins a line with its name, and ends it when it is done."""
        begun = list(re.finditer(r"^\[(\d+)/(\d+)\] +(\w+)(.*\n)?", self.log.read_text(), re.MULTILINE))
        if not begun:
            return STAGES[0]
        number, of, stage, ended = begun[-1].groups()
        if number == of and ended:
            return "report"
        maps = SceneFiles(self.run_dir, SCENE).maps
        return "map" if stage == "localize" and not any(maps.glob("*.npz")) else stage


def _proportional_mb(pid: int) -> float:
    """Return a process's proportional set size; 0 where the system does not tell."""
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1024
    return 0.0


def render(folder: Path, images: int) -> Path:
    """Render whole rooms of about so many map images, if they are not there, and list the queries."""
    from toolkit.capture import Session
    from toolkit.synthetic import capture as rendering
    from toolkit.synthetic.capture import DEVICES

    rendering.DEVICES = {"ios": scaled(DEVICES["ios"], 0.5)}  # this process renders nothing else
    rooms = max(1, round(images / FRAMES))
    capture = rendering.render_capture(folder / SCENE, rooms, round(images / rooms), progress=sys.stderr.isatty())
    session = Session(capture / "sessions" / "ios_query")
    asked = session.keyframes("keyframes_original").iloc[::STEP]
    asked.to_csv(session.path / "proc" / f"{QUERIES}.txt", index=False, header=False)
    return capture


def measure(folder: Path, images: int, settings: list[str], resume: bool) -> dict[str, Any]:
    """Run the chain on rooms of so many images; return what it took."""
    capture = in_own_process(render, folder, images)
    record, run = folder / "measured.json", folder / "runs" / "scale"
    if resume and record.exists():
        return dict(json.loads(record.read_text()))
    record.unlink(missing_ok=True)
    if not resume:
        shutil.rmtree(run.parent, ignore_errors=True)
    manifest = folder / "scale.yaml"
    # JSON is YAML.
    manifest.write_text(json.dumps(MANIFEST | {"captures": [str(capture)], "output_root": str(run.parent)}, indent=1))
    started, load = time.perf_counter(), os.getloadavg()[0]
    command = [sys.executable, "-m", "toolkit", "run", manifest, *(f"--set={one}" for one in settings)]
    path = folder / "run.log"
    with open(path, "wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        watch = Watch(process, run, path)
        status = process.wait()
    watch.join()
    if status:
        raise SystemExit(f"The run of {images} images ended with {status}: see {path}.")
    measured = {"load": [load, os.getloadavg()[0]], "total": time.perf_counter() - started}
    measured |= read_run(run, capture) | {"peaks": watch.peaks, "seconds": seconds_of(run, watch)}
    # Of stages that a run before this one did, their records have to do.
    for stage, (mb, _) in measured["stages"].items():
        peak = measured["peaks"].setdefault(stage, {"pss": 0.0, "rss": 0.0})
        peak["pss"] = max(peak["pss"], 0.0 if stage == "localize" and "map" in measured["peaks"] else mb)
    stages = sum(seconds for _, seconds in measured.pop("stages").values())
    measured["total"] = max(measured["total"], stages + measured["seconds"].get("report", 0.0))
    record.write_text(json.dumps(measured, indent=1) + "\n")
    return measured


def seconds_of(run: Path, watch: Watch) -> dict[str, float]:
    """Return the seconds of each row of the table."""
    rows = {row["stage"]: row for row in json.loads((run / "run.json").read_text())["stages"]}
    seconds = {stage: float(row["work_seconds"]) for stage, row in rows.items()}
    if {"map", "localize"} <= watch.began.keys():  # else the stage was reused
        localizing = watch.began["evaluate"] - watch.began["localize"]
        seconds["map"] = max(0.0, seconds["localize"] - localizing)
        seconds["localize"] = min(seconds["localize"], localizing)
    if "report" in watch.began:
        seconds["report"] = watch.ended - watch.began["report"]
    return seconds


def read_run(run: Path, capture: Path) -> dict[str, Any]:
    """Return sizes, counts and accuracy of a finished run."""
    import pandas as pd

    files = [path.stat().st_size for path in run.rglob("*") if path.is_file()]
    record = json.loads((run / "run.json").read_text())["stages"]
    recall = pd.read_csv(run / SCENE / "evaluation" / "recall.csv").iloc[0]
    names = [name for name in recall.index if name.startswith("recall@")]
    return {
        "stages": {row["stage"]: (row["peak_memory_mb"], row["seconds"]) for row in record},
        "images": sum(1 for _ in open(capture / "sessions" / "ios_map" / "images.txt")) - 1,
        "queries": int(recall["queries"]),
        "counts": {row["stage"]: row["counts"] for row in record},
        "ok": float((pd.read_csv(next((run / SCENE / "poses").glob("*.csv")))["status"] == "ok").mean()),
        "recall": {name: float(recall[name]) for name in names},
        "files": len(files),
        "bytes": sum(files),
    }


def exponent(sizes: list[float], values: list[float]) -> float:
    """Return the slope of log values over log sizes by least squares; NaN for fewer than two sizes."""
    known = [(size, value) for size, value in zip(sizes, values, strict=True) if value > 0]
    if len(known) < 2:
        return float("nan")
    return float(np.polyfit(*np.log(known).T, 1)[0])


def growth_table(sizes: list[float], rows: dict[str, list[float]], form: str) -> str:
    """Return a table: a row a stage, a column a size, the fitted exponent and that of the two largest sizes."""
    header = ["", *(f"{size:,.0f}" for size in sizes), "exponent", "of the last two"]
    lines = [
        [name, *(format(value, form) for value in values), f"{exponent(sizes, values):.2f}",
         f"{exponent(sizes[-2:], values[-2:]):.2f}"]
        for name, values in rows.items()
    ]  # fmt: skip
    return markdown_table(header, lines)


def draw_growth(path: Path, sizes: list[float], seconds: dict[str, list[float]], mb: dict[str, list[float]]) -> None:
    """Draw seconds and memory over images, a line a row, with the slope in the legend."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt
    from matplotlib import ticker

    figure, axes = plt.subplots(1, 2, figsize=(15, 5.5), layout="constrained")
    for panel, rows, label in zip(axes, (seconds, mb), ("seconds", "peak memory, MB"), strict=True):
        for (name, values), marker in zip(rows.items(), "osD^v<>PXh*" * 3, strict=False):
            panel.plot(sizes, values, marker=marker, label=f"{name}: {exponent(sizes, values):.2f}")
        panel.set(xscale="log", yscale="log", xlabel="map images", ylabel=label, xticks=sizes)
        panel.set_xticks(sizes, [f"{size:,.0f}" for size in sizes])
        panel.xaxis.set_minor_locator(ticker.NullLocator())
        panel.yaxis.set_major_formatter("{x:g}")
        if np.ptp(np.log10(panel.get_ylim())) < 1.5:
            panel.yaxis.set_minor_formatter("{x:g}")
        panel.grid(alpha=0.3)
        low, high = panel.get_ylim()
        panel.plot(sizes, [low * 1.3 * size / sizes[0] for size in sizes], "k:", lw=1, label="linear: 1.00")
        panel.set_ylim(low, high)
        panel.legend(title="slope", loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(path, dpi=110)
    plt.close(figure)


class Books:
    """A map of poses and random descriptors, and what is done with it without pixels; `steps` are timed in order."""

    def __init__(self, folder: Path, images: int) -> None:
        self.capture_dir, self.images = folder / SCENE, images
        self.run = folder / "run"

    @property
    def steps(self) -> list[tuple[str, Callable[[], object]]]:
        return [
            ("write the sessions", self.write),
            ("open the sessions", self.open),
            ("select pairs", self.select_pairs),
            ("plan tiles", self.plan_tiles),
            ("write tiles", self.write_tiles),
            ("join tiles", self.join_tiles),
            ("open the joined map, look at 100 images", self.open_map),
            ("write descriptors", self.write_descriptors),
            ("retrieve", self.retrieve),
            ("write poses", self.write_poses),
            ("evaluate", self.evaluate),
            ("write features of up to 10,000 images in shards", self.write_items),
            ("open and read these", self.read_items),
            ("write them, a file an image", self.write_files),
            ("read these files", self.read_files),
        ]

    def write(self) -> None:
        """Write both sessions, a phone's: a camera an image. Images are 0.24 m apart in rows of 1,200 m, 40 m apart."""
        import pandas as pd

        from toolkit.capture import Trajectory, write_session
        from toolkit.geometry import make_pose, qt_from_pose
        from toolkit.synthetic.capture import DEVICES, looking

        (sensor,) = DEVICES["ios"].sensors
        for split, step in (("map", 1), ("query", 17)):
            numbers = np.arange(0, self.images, step)
            centers = np.stack([0.24 * (numbers % 5000), 40.0 * (numbers // 5000), np.full(len(numbers), 1.6)], axis=1)
            rotations = np.stack([looking(90 + 25 * np.sin(number / 12), 0, 0) for number in numbers])
            qt = qt_from_pose(make_pose(rotations, centers))
            times = [10**9 * (1 + (split == "query")) + 10**6 * i for i in range(len(qt))]
            ids = [f"walk/cam_phone_{stamp}" for stamp in times]
            trajectory = Trajectory(times, ids, qt)
            keyframes = pd.DataFrame({"timestamp": times, "device_id": ids})
            asked = {"keyframes": {"pruned": keyframes}, "ground_truth": trajectory}
            write_session(
                self.capture_dir / "sessions" / f"ios_{split}",
                sensors=[(name, "phone", "camera", "PINHOLE", *sensor.size, *sensor.params) for name in ids],
                rigs=None,
                trajectory=trajectory if split == "map" else None,
                images=[(*key, f"walk/images/{key[0]}.jpg") for key in zip(times, ids, strict=True)],
                subsessions=["walk"],
                **(asked if split == "query" else {}),
            )

    def open(self) -> None:
        """Open the sessions; poses and cameras of the map."""
        from toolkit.capture import Capture

        self.capture = Capture.open(self.capture_dir)
        session = self.capture["ios_map"]
        self.poses = session.world_from_cam()
        self.cameras = session.cameras()

    def select_pairs(self) -> None:
        from toolkit.mapping.build import instants, select_pairs

        session = self.capture["ios_map"]
        groups = instants(session, np.arange(len(self.poses)))
        self.pairs = select_pairs(self.poses, self.cameras, groups)

    def plan_tiles(self) -> None:
        from toolkit.manifest import MapSettings
        from toolkit.mapping.triangulation import plan_tiles

        self.tiles = plan_tiles(self.poses[:, :3, 3] + 4 * self.poses[:, :3, 2], self.pairs, MapSettings().tile_images)

    def write_tiles(self) -> None:
        """Write tiles of random points: 50 before each image, which up to three of its partners see, too."""
        from toolkit.geometry import transform
        from toolkit.mapping.local_map import LocalMap

        count, each = len(self.poses), 50
        starts = np.searchsorted(self.pairs[:, 0], np.arange(count + 1))
        partners = [self.pairs[start:end, 1][:3] for start, end in itertools.pairwise(starts)]
        lengths = np.array([1 + len(of_image) for of_image in partners])
        seeing = np.concatenate([np.append(image, of_image) for image, of_image in enumerate(partners)])
        image = np.repeat(seeing, each)
        point = np.repeat(np.repeat(np.arange(count), lengths) * each, each) + np.tile(np.arange(each), len(seeing))
        order = np.lexsort((point, image))
        self.obs_image, self.obs_point = image[order], point[order]
        self.starts = np.searchsorted(self.obs_image, np.arange(count + 1))
        rays = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (count, each, 3)) * 4
        self.points = transform(self.poses, rays).reshape(-1, 3)
        for number, (core, images) in enumerate(self.tiles):
            rows = np.concatenate([np.arange(*self.starts[image : image + 2]) for image in images])
            image, points = self.obs_image[rows], self.obs_point[rows]
            known = np.unique(points[np.isin(image, core)])
            rows = rows[np.isin(points, known)]
            observed, place = np.unique(self.obs_point[rows], return_inverse=True)
            LocalMap(
                [f"{image}" for image in images],
                [self.cameras[image] for image in images],
                self.poses[images],
                self.points[observed],
                np.zeros((len(observed), 3), np.uint8),
                np.searchsorted(images, self.obs_image[rows]),
                rows - self.starts[self.obs_image[rows]],
                place,
                np.ones(len(observed), np.float32),
            ).save(self.run / "tiles" / f"{number}.npz")

    def join_tiles(self) -> None:
        from toolkit.geometry import invert, transform
        from toolkit.mapping.local_map import LocalMap
        from toolkit.mapping.triangulation import JoinedImages, join_tiles

        def keypoints(image: int) -> np.ndarray:
            seen = self.points[self.obs_point[slice(*self.starts[image : image + 2])]]
            in_cam = transform(invert(self.poses[image]), seen)
            return np.asarray(self.cameras[image].img_from_cam(in_cam), np.float32)

        def gray(images: np.ndarray, _: np.ndarray) -> np.ndarray:
            return np.full((len(images), 3), 128, np.uint8)

        names = [f"ios_map/raw_data/walk/images/{image}.jpg" for image in range(len(self.poses))]
        images = JoinedImages(names, self.cameras, self.poses, keypoints, gray)
        (self.run / "joined").mkdir()
        tiles = self.run / "tiles"
        joined = join_tiles(
            self.tiles,
            lambda number: LocalMap.load(tiles / f"{number}.npz"),
            images,
            self.run / "joined",
        )
        assert len(joined.points) > 0.99 * len(self.points)
        joined.save(self.run / "map.npz")
        del self.obs_image, self.obs_point, self.points

    def open_map(self) -> None:
        from toolkit.mapping.local_map import LocalMap

        opened = LocalMap.load(self.run / "map.npz")
        for image in np.linspace(0, len(self.poses) - 1, 100).astype(int):
            opened.around(np.array([image]))

    def write_descriptors(self) -> None:
        """Write as many random numbers as VLAD has dimensions, as float16."""
        from toolkit.embedders.search import MANIFEST_COLUMNS

        rng = np.random.default_rng(0)
        for session in (self.capture[name] for name in self.capture):
            folder = self.run / "embeddings" / session.id / "walk"
            folder.mkdir(parents=True)
            np.save(folder / "walk.npy", rng.standard_normal((len(session.images), 512), np.float32).astype(np.float16))
            table = session.images.assign(row_index=range(len(session.images)), device_id=session.device_ids)
            table["abs_path"] = [f"{SCENE}/sessions/{session.id}/raw_data/{path}" for path in table["path"]]
            table[MANIFEST_COLUMNS].to_csv(folder / "manifest.csv", index=False)

    def retrieve(self) -> None:
        from toolkit.retrieve import retrieve_pairs

        folders = self.capture_dir / "sessions", self.run / "embeddings", self.run / "retrieval"
        retrieve_pairs(*folders, queries="keyframes_pruned")

    def write_poses(self) -> None:
        """Write the true poses as the localized ones."""
        truth = self.capture["ios_query"].ground_truth
        assert truth is not None
        (self.run / "poses").mkdir()
        truth.write(self.run / "poses" / f"{SCENE}_map_ios_query_ios.txt")

    def evaluate(self) -> None:
        from toolkit.evaluate import evaluate_scene

        folders = (self.run / name for name in ("poses", "retrieval", "evaluation"))
        evaluation = evaluate_scene(self.capture_dir / "sessions", *folders, queries="keyframes_pruned")
        assert evaluation.recall["localized"].sum() == len(self.capture["ios_query"].images)

    def write_items(self) -> None:
        from toolkit.store.items import Items

        with Items(self.run / "items") as store:
            for image in self.with_features:
                store.add(str(image), "source", self.features, {})
        print(f"{len(self.with_features)} items: {sum(1 for _ in (self.run / 'items').iterdir())} files", flush=True)

    def read_items(self) -> None:
        from toolkit.store.items import Items

        store = Items(self.run / "items")
        assert all(len(store[str(image)]["keypoints"]) == 1000 for image in self.with_features)

    def write_files(self) -> None:
        from toolkit.files import write_atomic

        for image in self.with_features:
            with write_atomic(self.run / "files" / f"{image}.npz") as temporary, open(temporary, "wb") as stream:
                np.savez(stream, allow_pickle=False, **self.features)

    def read_files(self) -> None:
        for image in self.with_features:
            with np.load(self.run / "files" / f"{image}.npz") as stored:
                assert all(len(stored[name]) == 1000 for name in stored.files)

    @property
    def with_features(self) -> range:
        """More would fill the disk: 10,000 take 1.4 GB, and as much again as files."""
        return range(min(self.images, 10_000))

    @cached_property
    def features(self) -> dict[str, np.ndarray]:
        """As many random numbers as 1,000 SIFT features have, 136 kB."""
        rng = np.random.default_rng(0)
        descriptors = rng.integers(0, 255, (1000, 128), np.uint8)
        return {"keypoints": rng.standard_normal((1000, 2), np.float32), "descriptors": descriptors}


def keep_books(folder: Path, images: int) -> dict[str, dict[str, float]]:
    """Time every step for so many images; should be a fresh process. Returns seconds and MB by step."""
    from threadpoolctl import threadpool_limits

    import toolkit.evaluate
    import toolkit.mapping.build  # noqa: F401  # that imports take time is no matter of size

    shutil.rmtree(folder, ignore_errors=True)
    books, found = Books(folder, images), dict[str, dict[str, float]]()
    with threadpool_limits(1):
        for name, step in books.steps:
            _forget_peak()
            before, started = _status_mb("VmRSS"), time.perf_counter()
            step()
            seconds = time.perf_counter() - started
            found[name] = {"seconds": seconds, "mb": max(0.1, _status_mb("VmHWM") - before)}
            print(f"{images} {name}: {found[name]}", flush=True)
    shutil.rmtree(folder)
    return found


def _forget_peak() -> None:
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _status_mb(name: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1024
    return 0.0


def report_run(measured: list[dict[str, Any]], threads: int, plot: Path) -> str:
    """Return the tables of rendered rooms, and draw their growth."""
    sizes = [float(one["images"]) for one in measured]
    nan = float("nan")
    stages = [stage for stage in STAGES if any(stage in one["seconds"] for one in measured)]
    seconds = {stage: [one["seconds"].get(stage, nan) for one in measured] for stage in stages}
    mb = {stage: [one["peaks"].get(stage, {}).get("pss", nan) for one in measured] for stage in stages}
    resident = {"sum of RSS, all stages": [max(peak["rss"] for peak in one["peaks"].values()) for one in measured]}
    disk = {"files": [one["files"] for one in measured], "MB": [one["bytes"] / MIB for one in measured]}
    seconds["from capture to report"] = [one["total"] for one in measured]
    draw_growth(plot, sizes, seconds, mb)
    names = list(measured[0]["recall"])
    accuracy = [
        [f"{one['images']:,}", str(one["queries"]), f"{100 * one['ok']:.1f} %",
         *(f"{100 * one['recall'][name]:.1f} %" for name in names), "{:.1f} / {:.1f}".format(*one["load"])]
        for one in measured
    ]  # fmt: skip
    return "\n\n".join((
        f"Seconds by map images, {threads} threads:", growth_table(sizes, seconds, ".1f"),
        "Peak memory of all processes, MB (sum of PSS):", growth_table(sizes, mb | resident, ".0f"),
        "The run's folder:", growth_table(sizes, disk, ".0f"),
        markdown_table(["map images", "queries", "ok", *names, "load before / after"], accuracy),
    )) + "\n"  # fmt: skip


def report_books(sizes: list[int], found: list[dict[str, dict[str, float]]]) -> str:
    """Return the tables of poses without pixels."""
    exact = [float(size) for size in sizes]
    rows = {name: {key: [one[name][key] for one in found] for key in ("seconds", "mb")} for name in found[0]}
    return "\n\n".join((
        "Bookkeeping alone, seconds by map images, 1 thread:",
        growth_table(exact, {name: row["seconds"] for name, row in rows.items()}, ".2f"),
        "Memory that a step adds at most, MB:",
        growth_table(exact, {name: row["mb"] for name, row in rows.items()}, ".0f"),
    )) + "\n"  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, nargs="+", default=[60, 240], help="map images of each size")
    parser.add_argument("--bookkeeping", type=int, nargs="+", metavar="IMAGES", help="instead: no pixels")
    parser.add_argument("--folder", type=Path, default=Path("runs/scale"), help="of captures, runs and results; kept")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help="of the run")
    parser.add_argument("--render-only", action="store_true", help="render the captures, and measure nothing")
    parser.add_argument(
        "--resume", action="store_true", help="keep figures of before, and go on with a run that was stopped"
    )
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    limit_cores(options.threads)
    root = options.folder.resolve()
    root.mkdir(parents=True, exist_ok=True)
    if options.render_only:
        for images in options.images:
            print(in_own_process(render, root / str(images), images))
        return
    if options.bookkeeping:
        sizes = sorted(options.bookkeeping)
        found = [in_own_process(keep_books, root / "bookkeeping", images) for images in sizes]
        text, name = report_books(sizes, found), "bookkeeping"
        rows = [{step: [one[step][key] for one in found] for step in found[0]} for key in ("seconds", "mb")]
        draw_growth(root / "bookkeeping.png", [float(size) for size in sizes], *rows)
        document: dict[str, Any] = {"sizes": sizes, "steps": found}
    else:
        measured = [
            measure(root / str(images), images, options.settings, options.resume) for images in sorted(options.images)
        ]
        text, name = report_run(measured, options.threads, root / "growth.png"), "scale"
        document = {"threads": options.threads, "settings": options.settings, "sizes": measured}
    print(text)
    write_out([*options.out, root / f"{name}.md", root / f"{name}.json"], text, document)
    print(f"Results: {root}")


if __name__ == "__main__":
    main()
