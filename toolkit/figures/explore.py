"""Tables and figures for the notebooks: the content of a capture, and the results of the stages."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit.capture import Capture, Session
from toolkit.capture.names import color_of
from toolkit.capture.tables import POSE_NAMES
from toolkit.embedders import embedding_folders, open_descriptors
from toolkit.errors import CaptureError
from toolkit.figures.query_images import draw_image
from toolkit.figures.style import GREEN, ORANGE, VERMILLION, new_figure, plain_log, shared_legend, styled
from toolkit.figures.top_view import Ground, Layer, draw_places
from toolkit.files import image_name, pair_devices, read_references
from toolkit.geometry import Floats, qt_from_pose
from toolkit.pose.base import Status, short_status
from toolkit.results.metrics import is_posed
from toolkit.results.pair import PairResults
from toolkit.sequences.odometry import Odometry, recordings_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def describe(capture: Capture, queries: str = "keyframes_pruned_subsampled") -> pd.DataFrame:
    """Return one row per session: counts of images, posed images, rigs, subsessions and queries.

    `odometry` tells the number of odometry poses, their duration, and the number of pieces between losses of tracking
    (by the defaults of the stage `sequence`); `radio` lists the kinds of scans. `reason` tells why later stages cannot
    use a session.
    """
    rows = []
    for name in capture:
        device, _, split = name.rpartition("_")
        row: dict[str, Any] = {"session": name, "device": device, "split": split}
        row |= dict.fromkeys(("images", "subsessions", "cameras", "rigs", "with pose", "queries"), 0)
        row |= dict.fromkeys(("odometry", "radio", "reason"), "")
        rows.append(row)
        try:
            session = capture[name]
            row |= {
                "images": len(session.images), "subsessions": len(session.subsessions),
                "cameras": int(session.sensors["sensor_type"].eq("camera").sum()),
                "rigs": 0 if session.rigs is None else session.rigs["rig_id"].nunique(),
                "with pose": len(_poses(session)), "odometry": _odometry(session),
                "radio": ", ".join(kind for kind in ("wifi", "bt") if (session.path / f"{kind}.txt").exists()),
            }  # fmt: skip
            if split == "query":
                row["queries"] = len(session.keyframes(queries))
            elif not row["with pose"]:
                row["reason"] = "a map without poses"
        except CaptureError as error:
            row["reason"] = str(error)
    return pd.DataFrame(rows).set_index("session")


def _odometry(session: Session) -> str:
    if session.odometry is None:
        return ""
    times, poses = session.odometry.timestamps, session.odometry.world_from_device
    pieces, seconds = 0, 0.0
    for rows in recordings_of(session, session.odometry).values():
        pieces += len(Odometry(times[rows], poses[rows]).split())
        seconds += np.ptp(times[rows]) / 1e6
    return f"{len(times):,} poses, {seconds:,.0f} s, {pieces:,} piece{'s' if pieces > 1 else ''}"


def list_poses(path: str | Path) -> pd.DataFrame:
    """Return image, status, shortened, and world_from_device of the queries in a pair's `.csv`; NaN without a pose."""
    results = PairResults.open(path)
    table, poses = results.table, results.poses
    rows = np.full((len(table), len(POSE_NAMES)), np.nan)
    rows[is_posed(poses)] = qt_from_pose(poses[is_posed(poses)])
    shown = table.reindex(columns=["image"]).assign(status=table["status_text"].map(short_status))
    return shown.join(pd.DataFrame(rows, columns=POSE_NAMES))


def list_unsure(paths: Iterable[str | Path]) -> pd.DataFrame:
    """Return the queries of pairs, `.csv` each, whose pose is not `ok`: devices, image, status, inliers."""
    tables = []
    for results in map(PairResults.open, paths):
        (mapped, queried), table = results.devices, results.table
        unsure = table.assign(status=table["status_text"])[table["status"] != Status.OK]
        tables.append(unsure.reindex(columns=["image", "status", "num_inliers"]).assign(pair=f"{queried} in {mapped}"))
    columns = ["pair", "status", "num_inliers", "image"]
    return pd.concat(tables, ignore_index=True)[columns] if tables else pd.DataFrame(columns=columns)


@styled
def draw_samples(capture: Capture, count: int = 4) -> "Figure":
    """Draw `count` images of each session, evenly spread over the recording; return the figure."""
    sessions = [session for session in _usable(capture) if len(session)]
    if not sessions:
        return _empty("no session with images can be used")
    figure = new_figure(2.4 * count, 1.9 * len(sessions))
    for line, session in zip(figure.subplots(len(sessions), count, squeeze=False), sessions, strict=True):
        for axis, row in zip(line, np.linspace(0, len(session) - 1, count).round().astype(int), strict=True):
            draw_image(axis, session.image_path(row), 2.4)
        line[0].set_title(session.id, fontsize=8, loc="left")
    return figure


@styled
def draw_top_view(
    capture: Capture, up: ArrayLike | None = None, unit: str | None = "auto", points: Floats | None = None,
    colors: NDArray[np.uint8] | None = None,
) -> "Figure":  # fmt: skip
    """Draw all camera centers from above, those of queries only with ground truth; places far apart get panels.

    The up direction (3,) is estimated from the cameras by default, the unit is the capture's. Points (P, 3) of the
    scene and their RGB (P, 3) are drawn, too.
    """
    layers = []
    for session in _usable(capture):
        style = {"s": 14} if session.split == "map" else {"s": 36, "marker": "x"}
        if len(poses := _poses(session)):
            layers.append(Layer(poses, session.id, color_of(session.device), alpha=0.8, **style))
    if not layers:
        return _empty("no session with poses can be used")
    everything = np.concatenate([layer.at for layer in layers])
    ground = Ground.below(everything, up, (capture.unit_of(unit), 1.0))
    points = np.zeros((0, 3)) if points is None else points
    tint = "#9A9A9A" if colors is None else np.clip(colors / 255 * 0.75 + 0.2, 0, 0.75)
    layers.insert(0, Layer(points, None, tint, s=1.2, lw=0, rasterized=True))
    figure, _, panels = draw_places(ground, layers, everything, points)
    shared_legend(figure, [axis for axis, _, _ in panels], ncols=6, frameon=False, fontsize=8)
    has_queries = any("marker" in layer.style for layer in layers)
    crosses = ", queries where their pose is known (crosses)" if has_queries else ""
    figure.suptitle(f"Cameras from above: maps (dots){crosses}")
    return figure


@styled
def draw_similarity(embeddings: str | Path, limit: int = 300) -> "Figure":
    """Draw the similarity of a query session's images to another device's map, fused if there are several descriptors.

    Sessions are thinned evenly to at most `limit` images.
    """
    from toolkit.embedders.search import fused_products  # loads FAISS

    first = next(iter(embedding_folders(embeddings).values()))
    sessions = [folder.name for folder in sorted(first.iterdir()) if folder.is_dir()]
    query = next((name for name in sessions if name.endswith("_query")), sessions[0])
    maps = [name for name in sessions if name.endswith("_map")] or sessions
    of_others = (name for name in maps if name.rpartition("_")[0] != query.rpartition("_")[0])
    map_id = next(of_others, maps[0])
    opened = [open_descriptors(embeddings, session, normalize=True)[0] for session in (query, map_id)]
    rows, columns = (vectors[:: max(1, -(-len(vectors) // limit))] for vectors in opened)
    values = fused_products(rows, columns, opened[0].dims, lambda a, b: a @ b.T)
    figure = new_figure(8, 4.5)
    plot = figure.subplots()
    image = plot.imshow(values, aspect="auto", interpolation="nearest", cmap="viridis")
    plot.set(xlabel=f"images of {map_id}", ylabel=f"images of {query}")
    figure.colorbar(image, label="cosine similarity" if len(opened[0].dims) == 1 else "fused similarity")
    return figure


@styled
def draw_references(sessions_root: str | Path, jsonl: str | Path, samples: int = 4, references: int = 4) -> "Figure":
    """Draw some query images of a pair's retrieval, a `.jsonl`, each beside its first references; return the figure."""
    lines = read_references(jsonl)
    chosen = np.unique(np.linspace(0, len(lines) - 1, min(samples, len(lines))).round().astype(int))
    return _draw_rows(sessions_root, jsonl, [[lines[row]] for row in chosen], references)


@styled
def draw_reranked(
    sessions_root: str | Path, jsonl: str | Path, retrieved: str | Path, samples: int = 4, references: int = 3
) -> "Figure":
    """Draw query images, each with its first references before and (to the right) after reranking; return the figure.

    They are those whose new first reference had the worst rank in `retrieved`, the references before.
    """
    before, after = read_references(retrieved), read_references(jsonl)
    moved = [-row["topk"][0]["retrieval_rank"] if row["topk"] else 0 for row in after]
    chosen = np.argsort(moved, kind="stable")[:samples]
    return _draw_rows(sessions_root, jsonl, [[before[row], after[row]] for row in chosen], references)


def _draw_rows(
    sessions_root: str | Path, jsonl: str | Path, rows: list[list[dict[str, Any]]], references: int
) -> "Figure":
    """Draw one row per query: its image, then its first references in each entry of `rows`."""
    capture = Capture.from_sessions_root(sessions_root)
    map_device, query_device = pair_devices(Path(jsonl).stem)
    if not rows:
        return _empty(f"no queries of {query_device}")
    width = 1 + references * max(len(row) for row in rows)
    figure = new_figure(2.2 * width, 1.9 * len(rows))
    for line, row in zip(figure.subplots(len(rows), width, squeeze=False), rows, strict=True):
        for axis in line[1:]:
            axis.set_axis_off()  # a query may have fewer references
        shown = [(line[0], row[0], f"query {query_device}")]
        for block, query in enumerate(row):
            for axis, hit in zip(line[1 + block * references :], query["topk"][:references], strict=False):
                verified = "retrieval_rank" in hit
                score = f"{hit['score']} verified, was {hit['retrieval_rank']}" if verified else f"{hit['score']:.2f}"
                shown.append((axis, hit, f"{map_device} {score}"))
        for axis, entry, title in shown:
            draw_image(axis, capture.image_path(image_name(entry["path"])), 2.2, title)
    return figure


@styled
def draw_statuses(paths: Iterable[str | Path]) -> "Figure":
    """Draw the number of inliers of each query, by pair (`.txt` or `.csv` each) and status; return the figure."""
    tables = {results.devices: results.table for results in map(PairResults.open, paths)}
    figure = new_figure(8, 0.35 * len(tables) + 1.2)
    plot = figure.subplots()
    for status, color in {"ok": GREEN, "low_confidence": ORANGE, "failed": VERMILLION}.items():
        rows = [table[table["status"] == status] for table in tables.values()]
        inliers = np.concatenate([row["num_inliers"].fillna(0).to_numpy(float) for row in rows])
        heights = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
        label = f"{status.replace('_', ' ')}: {len(inliers)}"
        plot.scatter(np.maximum(inliers, 0.5), heights, s=24, c=color, alpha=0.6, label=label, clip_on=False)
    plot.set_yticks(range(len(tables)), [f"{queried} in {mapped} map" for mapped, queried in tables])
    plot.invert_yaxis()
    plot.set_xscale("log")
    least, most = plot.get_xlim()
    if least < 0.5:  # there are queries without inliers: failed ones, or those of a method without matches
        plot.set_xlim(0.5, max(most, 10.0))
    plain_log(plot, "x")
    plot.set_xlabel("inliers of a query (log scale; none at the left edge)")
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    return figure


def _empty(why: str) -> "Figure":
    figure = new_figure(4, 1)
    figure.text(0.5, 0.5, why, ha="center", va="center")
    return figure


def _usable(capture: Capture) -> list[Session]:
    return sorted([*capture.usable("map"), *capture.usable("query")], key=lambda session: session.id)


def _poses(session: Session) -> Floats:
    """Return world_from_cam (n, 4, 4) of the images with a pose; of queries the true one."""
    poses = session.world_from_cam(ground_truth=session.split == "query")
    return poses[is_posed(poses)]
