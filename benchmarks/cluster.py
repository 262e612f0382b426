"""Workers of a cluster on this machine: seconds a stage with one and with more of them, one thread each.

    python benchmarks/cluster.py [--capture PATH] [--map ios] [--query ios] [--workers 1 2] [--tile-images N]
                                 [--repeat 2] [--out FILE]

Each row is a fresh folder: local features of all images, VLAD, retrieval, the triangulated map, poses. That the workers
start is not timed, that they load what they need is. Poses are compared with those of this process alone. Without a
capture, one is rendered.
"""

import argparse
import os
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

from common import add_out, check_out, in_own_process, limit_cores, markdown_table, part_of_capture, write_out

STAGES = ("embed", "retrieve", "map and queries", "queries alone")


def measure(sessions_root: Path, run: Path, workers: int, tile_images: int) -> dict[str, Any]:
    """Localize all queries with so many workers, none: in this process; return seconds a stage and the poses."""
    os.environ["TOOLKIT_WORKERS"] = str(workers or 1)  # a thread for each worker
    from toolkit.embed import embed_sessions
    from toolkit.files import SceneFiles
    from toolkit.localize import localize_pairs
    from toolkit.retrieve import retrieve_pairs
    from toolkit.runs.cluster import open_cluster

    files = SceneFiles(run, sessions_root.parent.name)
    settings = {"features": ["sift"], "map": {"tile_images": tile_images}}
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    with open_cluster(f"local:{workers}" if workers else None, lambda _: None):
        times = [time.perf_counter()]
        embed_sessions(sessions_root, files.embeddings, features_dir=files.features)
        times.append(time.perf_counter())
        retrieve_pairs(sessions_root, files.embeddings, files.retrieval_dir)
        times.append(time.perf_counter())
        table = localize_pairs(sessions_root, *folders, settings)
        times.append(time.perf_counter())
        localize_pairs(sessions_root, folders[0], run / "again", *folders[2:], settings)
        times.append(time.perf_counter())
    seconds = dict(zip(STAGES, (after - before for before, after in pairwise(times)), strict=True))
    poses = {path.name: path.read_text() for path in sorted(files.poses_dir.glob("*.txt"))}
    return {"seconds": seconds, "poses": poses, "queries": int(table["queries"].sum()), "ok": int(table["ok"].sum())}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, help="capture folder; else a small one is rendered")
    parser.add_argument("--map", default="ios", help="device of the map")
    parser.add_argument("--query", default="ios", help="device of the queries, or all")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2], help="numbers of workers to compare")
    parser.add_argument("--tile-images", type=int, default=400, help="images of a tile, see localize.map.tile_images")
    parser.add_argument("--repeat", type=int, default=1, help="times that each is run, in turn; the fastest counts")
    add_out(parser)
    arguments = parser.parse_args()
    check_out(parser, arguments.out)
    limit_cores(max(arguments.workers))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if arguments.capture is None:
            from toolkit.synthetic import render_capture

            arguments.capture = render_capture(folder / "RENDERED", rooms=1, frames=24, progress=False)
        capture = part_of_capture(arguments.capture, arguments.map, arguments.query, folder / "capture")
        sessions, size = capture / "sessions", arguments.tile_images
        alone = in_own_process(measure, sessions, folder / "alone", 0, size)
        runs: dict[int, list[dict[str, Any]]] = {workers: [] for workers in arguments.workers}
        for repeat in range(arguments.repeat):
            for workers in arguments.workers:
                place = folder / f"{workers}-{repeat}"
                runs[workers].append(in_own_process(measure, sessions, place, workers, size))
    fastest = {
        workers: {stage: min(run["seconds"][stage] for run in of) for stage in STAGES} for workers, of in runs.items()
    }
    first = fastest[arguments.workers[0]]
    rows = [
        [
            str(workers),
            *(f"{seconds[stage]:.1f} s ({first[stage] / seconds[stage]:.2f})" for stage in STAGES),
            f"{sum(seconds.values()):.1f} s ({sum(first.values()) / sum(seconds.values()):.2f})",
            "yes" if all(run["poses"] == alone["poses"] for run in runs[workers]) else "NO",
        ]
        for workers, seconds in fastest.items()
    ]
    text = (
        f"{arguments.capture.name}: {alone['queries']} queries, {alone['ok']} ok; in brackets how many times as fast "
        f"as with {arguments.workers[0]}\n\n"
        + markdown_table(["workers", *STAGES, "all", "poses of one process"], rows)
        + "\n"
    )
    print(text)
    document = {"capture": arguments.capture.name, "seconds": fastest, "queries": alone["queries"], "ok": alone["ok"]}
    write_out(arguments.out, text, document)
    return 0


if __name__ == "__main__":
    sys.exit(main())
