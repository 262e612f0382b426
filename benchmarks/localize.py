"""Time, memory and accuracy of map x query pairs of a capture, from nothing, beside hloc with SIFT or with ALIKED.

    python benchmarks/localize.py [--capture PATH] [--map DEVICE] [--query DEVICE] [--threads 2]
                                  [--hloc CHECKOUT [--hloc-python PYTHON] [--hloc-features aliked] | --plain]

Both do the same job on the same cores, one right after the other, each in a fresh process and an empty folder: local
features once an image, a map of each device triangulated from its known poses, and a pose for each query of the
keyframe list in each map. The toolkit runs with its defaults; hloc with SIFT, or with ALIKED + LightGlue on the
toolkit's weights, and gets the toolkit's retrieved references for nothing. Wall seconds mean little while
others use the machine; CPU seconds mean more. Without a capture, a small one is rendered.

With --plain, the toolkit is compared with itself: SIFT and one RANSAC a query, with no guided matching and no search
for rivals. Features and maps are the same, and count for both as they were measured once.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from common import add_out, check_out, in_own_process, limit_cores, markdown_table, part_of_capture, write_out
from numpy.typing import NDArray

HLOC_WORKER = Path(__file__).with_name("hloc_worker.py")
# Rows of the table: a stage, and the parts that the tools report of it.
STAGES = {
    "local features": ["local features"],
    "global descriptors": ["global descriptors"],
    "retrieve": ["retrieve"],
    "map": ["map", "map: match", "map: triangulate"],
    "localize": ["localize", "localize: match", "localize: pose"],
    "imports, not in the total": ["imports"],
}
LIMITS = ((1, 0.1), (5, 0.5), (5, 1))
"""Recall is counted at these degrees and meters."""


@dataclass
class Measurement:
    """What one tool took, and how good its poses are."""

    seconds: dict[str, float]
    """Wall seconds by stage."""
    cpu: dict[str, float]
    """CPU seconds by stage, of all threads and child processes."""
    peak_mb: float
    peak_child_mb: float
    """Of the largest child process; 0 without children."""
    counts: dict[str, int]
    load: list[float] = field(default_factory=list)
    """Load averages of one minute before and after."""
    pairs: list[dict[str, Any]] = field(default_factory=list)

    @property
    def total(self) -> float:
        """Wall seconds of all stages without imports."""
        return sum(value for stage, value in self.seconds.items() if stage != "imports")


def run_toolkit(
    sessions_root: Path, run: Path, queries: str, threads: int, kinds: Sequence[str]
) -> dict[str, Any]:
    """Run the stages in this process, which should be a fresh one; returns the fields of a `Measurement`."""
    start = _clocks()
    import torch  # noqa: F401  # the stages import it when they need it

    from toolkit import embed, localize, retrieve
    from toolkit.features import stores
    from toolkit.files import SceneFiles
    from toolkit.mapping.local_map import LocalMap
    from toolkit.scene import map as map_module

    imported = _clocks()
    files = SceneFiles(run, sessions_root.parent.name)
    inner = _time_parts(embed, localize, map_module, stores)
    started = _clocks()
    table = embed.embed_sessions(sessions_root, files.embeddings, features_dir=files.features)
    embedded, features = _clocks(), inner["features"]
    retrieve.retrieve_pairs(sessions_root, files.embeddings, out_jsonl=files.retrieval_dir, queries=queries)
    retrieved = _clocks()
    localized_pairs = localize.localize_pairs(
        sessions_root,
        files.retrieval_dir,
        files.poses_dir,
        files.features,
        files.maps,
        {"features": list(kinds)},
        queries=queries,
        workers=threads,
    )
    localized = _clocks()
    stages = {
        "imports": imported - start,
        "local features": inner["features"],
        "global descriptors": embedded - started - features,
        "retrieve": retrieved - embedded,
        "map": inner["map"],
        "localize": localized - retrieved - inner["map"] - (inner["features"] - features),
    }
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    maps = [LocalMap.load(path) for path in sorted(files.maps.glob("*.npz"))]
    return {
        "seconds": {stage: float(clocks[0]) for stage, clocks in stages.items()},
        "cpu": {stage: float(clocks[1]) for stage, clocks in stages.items()},
        "peak_mb": peak_mb,
        "peak_child_mb": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024,
        "counts": {
            "images extracted": int(table["embedded"].sum()),
            "map points": sum(len(m.points) for m in maps),
            "poses ok": int(localized_pairs["ok"].sum()),
            "queries escalated": int(localized_pairs["escalated"].sum()),
        },
    }


def _time_parts(*stages: Any) -> dict[str, NDArray[np.float64]]:
    """Time what stages call, to tell their parts apart; else they run as they are."""
    inner = {"features": np.zeros(2), "map": np.zeros(2)}

    def timed(function: Callable[..., Any], part: str) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            began = _clocks()
            try:
                return function(*args, **kwargs)
            finally:
                inner[part] = inner[part] + _clocks() - began

        return call

    for stage in stages:
        stage.extract_session = timed(partial(stage.extract_session, progress=False), "features")
        if hasattr(stage, "build_map"):
            stage.build_map = timed(stage.build_map, "map")
    return inner


def _clocks() -> NDArray[np.float64]:
    """Return the wall clock, and the CPU seconds of this process and of its children that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return np.array([time.perf_counter(), sum(usage.ru_utime + usage.ru_stime for usage in usages)])


def measure_toolkit(
    sessions_root: Path, run: Path, queries: str, threads: int, features: Sequence[str]
) -> Measurement:
    """Measure the toolkit in a process of its own."""
    from toolkit.files import SceneFiles

    before = os.getloadavg()[0]
    fields = in_own_process(run_toolkit, sessions_root, run, queries, threads, features)
    measured = Measurement(**fields, load=[before, os.getloadavg()[0]])
    measured.pairs = accuracy(sessions_root, SceneFiles(run, sessions_root.parent.name).poses_dir, queries)
    return measured


PLAIN = {"GUIDED_RADII_DEG": (), "CLEAR_INLIER_RATIO": 0.0}
"""Constants of `pose/pnp.py` of the plain setting: no guided matching, no search for rivals."""


def localize_plainly(sessions_root: Path, run: Path, queries: str, threads: int) -> list[float]:
    """Localize in a finished run's maps with the plain setting; returns wall and CPU seconds."""
    from toolkit import localize
    from toolkit.files import SceneFiles
    from toolkit.pose import pnp
    from toolkit.scene import map as map_module

    files = SceneFiles(run, sessions_root.parent.name)
    inner = _time_parts(localize, map_module)
    started = _clocks()
    folders = (files.retrieval_dir, run / "plain_poses", files.features, files.maps)
    with mock.patch.multiple(pnp, **PLAIN):
        localize.localize_pairs(sessions_root, *folders, {"features": ["sift"]}, queries=queries, workers=threads)
    return [float(value) for value in _clocks() - started - inner["features"] - inner["map"]]


def measure_plain(ours: Measurement, sessions_root: Path, run: Path, queries: str, threads: int) -> Measurement:
    """Measure the plain setting in a process of its own, on the features and maps of a run of the toolkit."""
    before = os.getloadavg()[0]
    seconds, cpu = in_own_process(localize_plainly, sessions_root, run, queries, threads)
    measured = replace(ours, seconds=ours.seconds | {"localize": seconds}, cpu=ours.cpu | {"localize": cpu})
    measured = replace(measured, load=[before, os.getloadavg()[0]])
    measured.pairs = accuracy(sessions_root, run / "plain_poses", queries)
    return measured


def write_job(
    path: Path, kind: str, sessions_root: Path, run: Path, queries: str, threads: int, map_pairs: int
) -> None:
    """Write what hloc is asked: posed map images, query images, and the references that the toolkit retrieved."""
    from toolkit import geometry
    from toolkit.capture import Capture, Session
    from toolkit.files import SceneFiles, pair_name
    from toolkit.models.weights import ALIKED, ALIKED_LIGHTGLUE, resolve_weights

    capture = Capture.from_sessions_root(sessions_root)

    def described(session: Session, row: int) -> dict[str, Any]:
        name = session.image_name(row)
        if len(name.split()) != 1:
            sys.exit(f"hloc's lists are split at spaces, so it cannot take the image {name!r}.")
        camera = session.camera(session.images["sensor_id"].iloc[row])
        params = [float(value) for value in camera.params]
        size = {"width": camera.width, "height": camera.height}
        return {"name": name, "camera": {"model": camera.model.name, **size, "params": params}}

    maps: dict[str, list[dict[str, Any]]] = {}
    pairs: list[dict[str, Any]] = []
    for mapped in (device for device in capture.devices if f"{device}_map" in capture):
        session = capture[f"{mapped}_map"]
        poses = session.world_from_cam()
        posed = np.flatnonzero(np.isfinite(poses).all((1, 2))).tolist()
        cams_from_world = geometry.invert(poses[posed])[:, :3].tolist()
        maps[mapped] = [
            described(session, row) | {"cam_from_world": pose} for row, pose in zip(posed, cams_from_world, strict=True)
        ]
        for asked in (device for device in capture.devices if f"{device}_query" in capture):
            session = capture[f"{asked}_query"]
            members = session.rows_of_keyframes(session.keyframes(queries))
            retrieved = {}
            retrieval = SceneFiles(run, capture.name).retrieval(mapped, asked).read_text(encoding="utf-8")
            for line in map(json.loads, retrieval.splitlines()):
                names = [reference["path"].split("/sessions/", 1)[1] for reference in line["topk"]]
                retrieved[line["path"].split("/sessions/", 1)[1]] = names
            images = [described(session, row) for row in np.concatenate(members).tolist()]
            asking = [image | {"references": retrieved.get(image["name"], [])} for image in images]
            pairs.append({"name": pair_name(capture.name, mapped, asked), "map": mapped, "queries": asking})
    names = [image["name"] for images in maps.values() for image in images]
    names += [query["name"] for pair in pairs for query in pair["queries"]]
    job = {
        "image_dir": str(sessions_root),
        "threads": threads,
        "map_pairs": map_pairs,
        "maps": maps,
        "pairs": pairs,
        "extract": list(dict.fromkeys(names)),
    }
    if kind == "aliked":
        sources = {"ALIKED": ALIKED["aliked-n16"], "LightGlue": ALIKED_LIGHTGLUE}
        job["weights"] = {name: str(resolve_weights(source)) for name, source in sources.items()}
    path.write_text(json.dumps(job))


def write_device_poses(out: Path, sessions_root: Path, queries: str, poses: dict[str, dict[str, Any]]) -> None:
    """Write hloc's poses of images as poses of devices: of a rig's cameras, the one with the most inliers decides."""
    from toolkit import geometry
    from toolkit.capture import Capture, Trajectory
    from toolkit.files import pair_name

    capture = Capture.from_sessions_root(sessions_root)
    for asked in (device for device in capture.devices if f"{device}_query" in capture):
        session = capture[f"{asked}_query"]
        keyframes = session.keyframes(queries)
        members = session.rows_of_keyframes(keyframes)
        keys = list(zip(keyframes["timestamp"].tolist(), keyframes["device_id"].tolist(), strict=True))
        for mapped in capture.devices:
            name = pair_name(capture.name, mapped, asked)
            if name not in poses:
                continue
            found = []
            for key, rows in zip(keys, members, strict=True):
                answers = [
                    (poses[name][image], session.rig_from_cam([row])[0])
                    for image, row in ((session.image_name(row), row) for row in rows.tolist())
                    if image in poses[name]
                ]
                if answers:
                    best, rig_from_cam = max(answers, key=lambda answer: answer[0]["num_inliers"])
                    cam_from_world = np.vstack([best["cam_from_world"], [0, 0, 0, 1]])
                    found.append((*key, geometry.invert(rig_from_cam @ cam_from_world)))
            if not found:
                sys.exit(f"hloc gave no pose for any query of {name}; were references retrieved for it?")
            times, ids, world_from_rigs = zip(*found, strict=True)
            Trajectory.from_poses(times, list(ids), np.stack(world_from_rigs)).write(out / f"{name}.txt")


def measure_hloc(
    checkout: str, python: str, kind: str, sessions_root: Path, run: Path, queries: str, threads: int, map_pairs: int
) -> Measurement:
    """Measure hloc in a process of its own, on the references in the toolkit's run folder."""
    job, result, log = run / "job.json", run / "result.json", run / "hloc.log"
    write_job(job, kind, sessions_root, run, queries, threads, map_pairs)
    before = os.getloadavg()[0]
    with open(log, "w", encoding="utf-8") as stream:
        command = [python, str(HLOC_WORKER), checkout, kind, str(job), str(result)]
        ended = subprocess.run(command, stdout=stream, stderr=subprocess.STDOUT, check=False)
    if ended.returncode:
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-15:])
        sys.exit(f"hloc ended with status {ended.returncode}:\n{tail}")
    fields = json.loads(result.read_text())
    poses = fields.pop("poses")
    measured = Measurement(**fields, load=[before, os.getloadavg()[0]])
    write_device_poses(run / "hloc_poses", sessions_root, queries, poses)
    measured.pairs = accuracy(sessions_root, run / "hloc_poses", queries)
    return measured


def accuracy(sessions_root: Path, poses_dir: Path, queries: str) -> list[dict[str, Any]]:
    """Return queries, median errors and recall of each pair, and of all queries together."""
    from toolkit.evaluate import evaluate_scene

    evaluation = evaluate_scene(sessions_root, poses_dir, None, None, queries=queries)
    errors = evaluation.errors
    groups = [((str(m), str(q)), part) for (m, q), part in errors.groupby(["map_device", "query_device"], sort=False)]
    rows = []
    for (mapped, asked), part in [*groups, *([(("all", "all"), errors)] if len(errors) else [])]:
        rotation_deg = part["rotation_error_deg"].to_numpy(float)
        translation_m = part["translation_error_m"].to_numpy(float)
        rows.append(
            {
                "map": mapped,
                "query": asked,
                "queries": len(part),
                "median_rotation_deg": float(np.median(rotation_deg)),
                "median_translation_cm": 100 * float(np.median(translation_m)),
                "recall": [float(np.mean((rotation_deg < deg) & (translation_m < m))) for deg, m in LIMITS],
            }
        )
    return rows


def markdown(capture: str, threads: int, ours: Measurement, theirs: Measurement | None, other: str) -> str:
    """Return the tables of a benchmark, `theirs` under the name `other`."""
    tools = [ours, theirs] if theirs else [ours]
    names = ["toolkit", other][: len(tools)]
    header = ["stage"]
    for name in names:
        header += [f"{name}: s", "CPU s"]
    header += ["ratio", "CPU ratio"] if theirs else []

    def line(label: str, parts: list[str]) -> list[str]:
        known = [[part for part in parts if part in tool.seconds] for tool in tools]
        wall = [sum(tool.seconds[p] for p in part) for tool, part in zip(tools, known, strict=True)]
        cpu = [sum(tool.cpu[p] for p in part) for tool, part in zip(tools, known, strict=True)]
        pairs = zip(wall, cpu, known, strict=True)
        cells = [cell for w, c, part in pairs for cell in ((f"{w:.1f}", f"{c:.1f}") if part else ("–", "–"))]
        ratios = [f"{values[0] / values[1]:.2f}" if all(known) else "–" for values in (wall, cpu)] if theirs else []
        return [label, *cells, *ratios]

    everything = [part for parts in STAGES.values() for part in parts if part != "imports"]
    rows = [line(stage, parts) for stage, parts in STAGES.items()]
    rows.insert(-1, line("**total**", everything))
    text = [f"{capture}, {threads} cores:", "", markdown_table(header, rows), ""]
    for name, tool in zip(names, tools, strict=True):
        facts = [f"{value} {key}" for key, value in tool.counts.items()]
        facts.append(f"peak memory {tool.peak_mb:.0f} MB")
        if tool.peak_child_mb:
            facts.append(f"largest child process {tool.peak_child_mb:.0f} MB")
        facts.append(f"load of the machine {tool.load[0]:.1f} before, {tool.load[1]:.1f} after")
        facts += [f"{part} {value:.1f} s" for part, value in tool.seconds.items() if ":" in part]
        text.append(f"- {name}: {', '.join(facts)}.")
    if ours.pairs:
        header = ["map", "query", "queries"]
        for name in names:
            header += [f"{name}: deg", "cm", "recall %"]
        rows = []
        for results in zip(*(tool.pairs for tool in tools), strict=True):
            cells = [results[0]["map"], results[0]["query"], str(results[0]["queries"])]
            for result in results:
                cells += [f"{result['median_rotation_deg']:.3f}", f"{result['median_translation_cm']:.2f}"]
                cells += [" / ".join(f"{100 * recall:.1f}" for recall in result["recall"])]
            rows.append(cells)
        limits = " / ".join(f"({deg}°, {m} m)" for deg, m in LIMITS)
        text += ["", f"Median errors, and recall at {limits}:", "", markdown_table(header, rows)]
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, help="capture folder, with sessions/ in it; default: render one")
    parser.add_argument("--map", default="all", help="map device, to measure a part of the capture (default: all)")
    parser.add_argument("--query", default="all", help="query device, likewise (default: all)")
    parser.add_argument("--queries", default="keyframes_pruned_subsampled", help="keyframe list (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="cores for each tool (default: %(default)s)")
    parser.add_argument(
        "--features", nargs="+", default=["auto"], help="local features of the toolkit (default: %(default)s)"
    )
    parser.add_argument("--hloc", help="checkout of cvg/Hierarchical-Localization, to run hloc too")
    parser.add_argument(
        "--hloc-features", choices=["sift", "aliked"], default="sift", help="local features of hloc (default: sift)"
    )
    parser.add_argument("--plain", action="store_true", help="compare with the toolkit's plain setting instead")
    parser.add_argument("--hloc-python", default=sys.executable, help="interpreter with hloc's needs (default: this)")
    parser.add_argument("--hloc-map-pairs", type=int, default=20, help="partners of a map image (default: %(default)s)")
    parser.add_argument("--repeat", type=int, default=1, help="runs in turn; the fastest of each tool counts")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    if options.plain and options.hloc:
        parser.error("--plain and --hloc are two comparisons: give one.")
    limit_cores(options.threads)
    from toolkit.capture import Capture
    from toolkit.errors import ToolkitError

    checkout = str(Path(options.hloc).resolve()) if options.hloc else ""
    kind = options.hloc_features
    if checkout and subprocess.run([options.hloc_python, str(HLOC_WORKER), checkout, kind], check=False).returncode:
        sys.exit(1)
    ours: list[Measurement] = []
    theirs: list[Measurement] = []
    with tempfile.TemporaryDirectory() as folder:
        capture = options.capture
        if capture is None:
            from toolkit.synthetic import render_capture

            capture = render_capture(Path(folder) / "RENDERED", rooms=2, frames=12, seed=0, progress=False)
        capture = capture.resolve()
        if (options.map, options.query) != ("all", "all"):
            capture = part_of_capture(capture, options.map, options.query, Path(folder) / "part")
        try:
            sessions_root = Capture.open(capture).path / "sessions"
        except ToolkitError as error:
            sys.exit(str(error))
        for turn in range(options.repeat):
            run = Path(folder) / f"run{turn}"
            ours.append(measure_toolkit(sessions_root, run, options.queries, options.threads, options.features))
            print(f"toolkit {ours[-1].total:.1f} s", file=sys.stderr)
            if checkout:
                arguments = (sessions_root, run, options.queries, options.threads, options.hloc_map_pairs)
                theirs.append(measure_hloc(checkout, options.hloc_python, kind, *arguments))
                print(f"hloc {theirs[-1].total:.1f} s", file=sys.stderr)
            elif options.plain:
                theirs.append(measure_plain(ours[-1], sessions_root, run, options.queries, options.threads))
                print(f"plain {theirs[-1].total:.1f} s", file=sys.stderr)
    best = min(ours, key=lambda measured: measured.total)
    other = min(theirs, key=lambda measured: measured.total) if theirs else None
    label = "plain" if options.plain else {"sift": "hloc + SIFT", "aliked": "hloc + ALIKED + LightGlue"}[kind]
    text = markdown(sessions_root.parent.name, options.threads, best, other, label)
    results = {"toolkit": vars(best) | {"total": best.total}}
    if other:
        results["plain" if options.plain else "hloc"] = vars(other) | {"total": other.total}
    document = {"capture": sessions_root.parent.name, "queries": options.queries, "threads": options.threads}
    print(text)
    write_out(options.out, text, document | results)


if __name__ == "__main__":
    main()
