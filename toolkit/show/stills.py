"""Still pictures of queries in a map, which need no viewer."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
from matplotlib.collections import LineCollection
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.images import read_for_display
from toolkit.capture.upright import up_of_cameras
from toolkit.geometry import pose_error, project
from toolkit.show.figures import (
    ESTIMATED,
    GREEN,
    MAP,
    TRUE,
    error_bar,
    error_colors,
    new_figure,
    save_figure,
    styled,
)
from toolkit.show.localization_view import ShownImage
from toolkit.show.top_view import ground_axes, places_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class WorstQuery:
    """A query of the sheet of the worst."""

    pair: str
    reason: str
    """Status and counts of matches."""
    image: ShownImage
    reference: ShownImage | None
    """The best one; None where there is none."""
    rotation_deg: float = np.nan
    translation_m: float = np.nan
    """Its errors; NaN without a pose, or where the truth is not known."""


@styled
def draw_scene_png(
    points: ArrayLike,
    colors: NDArray[np.uint8] | None,
    map_poses: ArrayLike,
    queries_est: ArrayLike,
    queries_true: ArrayLike | None,
    out: str | Path | None = None,
    up: ArrayLike | None = None,
    title: str = "",
    max_places: int = 6,
    max_points: int = 60_000,
    map_tracks: Sequence[Array] = (),
    query_tracks: Sequence[Array] = (),
) -> "Figure":
    """Draw the map from above with estimated and true queries, one panel a place; return the figure.

    Args:
        points: (P, 3), meters.
        colors: (P, 3) RGB, or None.
        map_poses: world_from_cam (N, 4, 4) of the map; NaN rows are passed over.
        queries_est: world_from_cam (Q, 4, 4) of the queries, NaN where there is no pose.
        queries_true: the same, true; None where there is no ground truth.
        out: PNG to write; None: no file.
        up: direction (3,) that is up; None: estimated from the map's cameras.
        title: of the figure.
        max_places: panels at most; the places with the most map images.
        max_points: points drawn at most in all, a regular choice.
        map_tracks: ways of the map's devices, (n, 3) each, drawn as lines.
        query_tracks: true ways of the query devices.
    """
    map_poses = _finite(map_poses)
    estimated = np.asarray(queries_est, np.float64).reshape(-1, 4, 4)
    true = np.full_like(estimated, np.nan) if queries_true is None else np.asarray(queries_true, np.float64)
    axes, labels = ground_axes(up_of_cameras(map_poses) if up is None else up)
    xyz = np.asarray(points, np.float64).reshape(-1, 3)
    step = len(xyz) // max_points + 1
    cloud, shades = xyz[::step] @ axes.T, None if colors is None else colors[::step]
    cameras, seen = map_poses[:, :3, 3] @ axes.T, estimated[:, :3, 3] @ axes.T
    known = true[:, :3, 3] @ axes.T

    place = places_of(cameras)
    anchors = np.where(np.isfinite(known), known, seen)
    query_place = _nearest(anchors, cameras, place)
    point_place = _nearest(cloud, cameras, place)
    counts = np.bincount(place, minlength=1)
    shown = np.sort(np.argsort(-counts, kind="stable")[:max_places])
    windows = [_window(cloud[point_place == p], cameras[place == p], anchors[query_place == p]) for p in shown]

    columns = min(len(shown), 3)
    rows = -(-len(shown) // columns)
    shape = max(0.5, min(1.4, float(np.mean([np.ptp(w[1]) / np.ptp(w[0]) for w in windows]))))
    width = 8.0 if columns == 1 else 4.6
    figure = new_figure(width * columns, width * shape * rows + 1.2)
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axis in panels[len(shown) :]:
        axis.set_visible(False)
    for axis, p, window in zip(panels, shown, windows, strict=False):
        near, mine = point_place == p, query_place == p
        tint = "#9A9A9A" if shades is None else _muted(shades[near])
        _dots(axis, cloud[near], s=1.2, c=tint, lw=0, rasterized=True)
        for tracks, color, label in ((map_tracks, MAP, "way of the map's devices"), (query_tracks, TRUE, "true way")):
            for number, track in enumerate(tracks):
                axis.plot(*(np.asarray(track).reshape(-1, 3) @ axes.T).T, color=color, lw=0.7, alpha=0.5, zorder=2,
                          label=None if number else label)  # fmt: skip
        _draw_heading(axis, cameras[place == p], map_poses[place == p], axes, MAP, window, "map cameras")
        _draw_queries(axis, seen[mine], known[mine], estimated[mine], true[mine], axes, window)
        axis.set(xlim=window[0], ylim=window[1], aspect="equal", xlabel=labels[0])
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.2)
        located = np.isfinite(seen[mine]).all(1)
        name = f"place {int(p) + 1}: " if len(counts) > 1 else ""
        outside = _outside(seen[mine], window)
        far = f", {outside} estimated outside the picture" if outside else ""
        axis.set_title(f"{name}{located.sum()} of {mine.sum()} queries have a pose{far}", fontsize=9)
        if len(shown) < len(counts) and axis is panels[len(shown) - 1]:
            axis.annotate(f"{len(counts) - len(shown)} smaller places not shown", (1, -0.2), fontsize=8,
                          xycoords="axes fraction", ha="right")  # fmt: skip
    for row in range(rows):
        panels[row * columns].set_ylabel(labels[1])
    if (np.isfinite(seen).all(1) & np.isfinite(known).all(1)).any():
        error_bar(figure, list(panels[: len(shown)]), shrink=0.8)
    handles: dict[str, Any] = {}
    for axis in panels:
        handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5, frameon=False,
                  fontsize=9)  # fmt: skip
    figure.suptitle(title or "Queries in the map, seen from above")
    if out is not None:
        save_figure(figure, out, title or "Queries in the map, seen from above")
    return figure


@styled
def draw_localization(
    query_image: Image,
    camera: pycolmap.Camera,
    world_from_cam_est: ArrayLike | None,
    points_world: ArrayLike,
    references: Sequence[tuple[Image, str]],
    out: str | Path | None = None,
    title: str = "",
    keypoints: ArrayLike | None = None,
    inliers: NDArray[np.bool_] | None = None,
    world_from_cam_true: ArrayLike | None = None,
    max_references: int = 4,
) -> "Figure":
    """Draw one query beside its references, with map points reprojected by its pose; return the figure.

    Green dots are inliers' map points as the pose projects them, a white line leads from each to where it was
    measured; orange dots are measurements that do not agree.

    Args:
        query_image: (H, W, 3) or (H, W).
        camera: its intrinsics.
        world_from_cam_est: (4, 4); None or NaN where it was not localized.
        points_world: (n, 3) map points that were matched.
        references: pictures and captions, best first.
        out: PNG to write; None: no file.
        title: of the figure; the errors are added to it where the true pose is given.
        keypoints: (n, 2) pixels of the query that were matched to the points; an inlier's distance to its
            reprojection is drawn.
        inliers: (n,) of the points; None: all.
        world_from_cam_true: (4, 4) for the errors; None where it is not known.
        max_references: drawn at most.
    """
    points = np.asarray(points_world, np.float64).reshape(-1, 3)
    good = np.ones(len(points), bool) if inliers is None else np.asarray(inliers, bool)
    pose = None if world_from_cam_est is None else np.asarray(world_from_cam_est, np.float64)
    located = pose is not None and bool(np.isfinite(pose).all())
    shown = list(references[:max_references])
    height, width = query_image.shape[:2]
    # The query is as high as two rows of references, so that its points can be seen.
    rows = 2 if len(shown) > 1 else 1
    columns = -(-len(shown) // rows)
    ratio = width / height
    shapes = [image.shape[1] / image.shape[0] for image, _ in shown]
    small = max(shapes) if shapes else 1.0
    figure = new_figure(4.4 * ratio + columns * small * 4.4 / rows + 0.6, 5.3)
    grid = figure.add_gridspec(rows, 1 + columns, width_ratios=[ratio, *[small / rows] * columns])
    axis = figure.add_subplot(grid[:, 0])
    axis.imshow(query_image, cmap="gray", vmin=0, vmax=255)
    caption = "query"
    if located:
        pixels, visible = project(points, camera, np.asarray(pose))
        inside = visible & (pixels >= 0).all(1) & (pixels < [width, height]).all(1)
        if keypoints is not None:
            measured = np.asarray(keypoints, np.float64).reshape(-1, 2)
            _dots(axis, _on(measured[~good]), s=7, c=ESTIMATED, alpha=0.5, lw=0)
            lines = np.stack([_on(measured[good & inside]), _on(pixels[good & inside])], axis=1)
            axis.add_collection(LineCollection(list(lines), colors="white", linewidths=0.8))
        _dots(axis, _on(pixels[good & inside]), s=11, c=GREEN, edgecolors="white", lw=0.35)
        caption += f": {good.sum()} of {len(good)} map points agree"
    else:
        if keypoints is not None:
            _dots(axis, _on(np.asarray(keypoints, np.float64)), s=7, c=ESTIMATED, lw=0)
        caption += ": not localized"
    axis.set_title(caption, fontsize=9)
    _frame(axis, GREEN if located else ESTIMATED, width, height)
    for k, (image, text) in enumerate(shown):
        panel = figure.add_subplot(grid[k // columns, 1 + k % columns])
        panel.imshow(image, cmap="gray", vmin=0, vmax=255)
        panel.set_title(text, fontsize=8)
        _frame(panel, "0.6", image.shape[1], image.shape[0])
    if located and world_from_cam_true is not None and np.isfinite(world_from_cam_true).all():
        rotation, meters = pose_error(np.asarray(pose), world_from_cam_true)
        title = f"{title}{' · ' if title else ''}off by {float(rotation):.2g}°, {_length(float(meters))}"
    figure.suptitle(title)
    if out is not None:
        save_figure(figure, out, title)
    return figure


@styled
def draw_worst(
    queries: Sequence[WorstQuery], out: str | Path | None = None, title: str = "The worst queries"
) -> "Figure":
    """Draw the worst queries, each beside its best reference with their common matches joined; return the figure.

    Args:
        queries: the worst first.
        out: PNG to write; None: no file.
        title: of the figure.
    """
    columns = 2 if len(queries) > 1 else 1
    rows = max(1, -(-len(queries) // columns))
    figure = new_figure(6.0 * columns, 2.75 * rows + 0.5)
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axis in panels:
        axis.set_axis_off()
    if not len(queries):
        panels[0].text(0.5, 0.5, "no queries", ha="center")
    for rank, (axis, query) in enumerate(zip(panels, queries, strict=False), start=1):
        _draw_side_by_side(axis, query)
        off = f"off by {query.rotation_deg:.2g}°, {_length(query.translation_m)}; " if (
            np.isfinite(query.translation_m)) else ""  # fmt: skip
        axis.set_title(f"{rank}. {query.pair}: {off}{query.reason}", fontsize=8, loc="left", wrap=True)
    figure.suptitle(f"{title} (left: query, right: its best reference; lines: inliers that both see)")
    if out is not None:
        save_figure(figure, out, title)
    return figure


def _draw_side_by_side(axis: "Axes", query: WorstQuery) -> None:
    """Draw a query and its best reference at one height, and join the points that both see."""
    left = read_for_display(query.image.path)
    height = left.shape[0]
    placed = [(left, 0.0, 1.0)]
    if query.reference is not None:
        right = read_for_display(query.reference.path)
        placed.append((right, left.shape[1] * 1.03, height / right.shape[0]))
    width = 0.0
    for image, offset, scale in placed:
        width = offset + scale * image.shape[1]
        axis.imshow(image, extent=(offset, width, height, 0), interpolation="antialiased")
    if query.reference is not None:
        _, i, j = np.intersect1d(query.image.point_ids, query.reference.point_ids, return_indices=True)
        start, end = query.image.pixels[i], query.reference.pixels[j] * placed[1][2] + [placed[1][1], 0.0]
        step = len(start) // 80 + 1  # more lines than this hide the pictures
        lines = np.stack([start, end], axis=1)[::step]
        axis.add_collection(LineCollection(list(lines), colors=GREEN, linewidths=0.5, alpha=0.8))
        _dots(axis, start, s=4, c=GREEN, lw=0)
        _dots(axis, end, s=4, c=GREEN, lw=0)
        if not len(start):
            axis.text(width / 2, height * 0.96, "no common inliers", ha="center", color="white", fontsize=8,
                      bbox={"facecolor": "black", "alpha": 0.6, "lw": 0, "pad": 2})  # fmt: skip
    axis.set(xlim=(0, width), ylim=(height, 0), aspect="equal")


def _on(pixels: Array) -> Array:
    """Return pixels as imshow counts them: it has the center of the top-left pixel at (0, 0)."""
    return pixels - 0.5


def _frame(axis: "Axes", color: str, width: int, height: int) -> None:
    axis.set(xticks=[], yticks=[], xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axis.spines[:].set(color=color, linewidth=1.5, visible=True)


def _length(meters: float) -> str:
    return f"{100 * meters:.2g} cm" if meters < 0.995 else f"{meters:.3g} m"


def _known(poses: Array) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(poses).all((1, 2)), bool)


def _finite(poses: ArrayLike) -> Array:
    poses = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    return poses[_known(poses)]


def _dots(axis: "Axes", xy: Array, **style: Any) -> None:
    axis.scatter(xy[:, 0], xy[:, 1], **style)


def _nearest(positions: Array, cameras: Array, place: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the place of the nearest camera; -1 where the position is not known."""
    from scipy.spatial import cKDTree

    found = np.full(len(positions), -1, np.int64)
    known = np.isfinite(positions).all(1)
    if known.any() and len(cameras):
        found[known] = place[cKDTree(cameras).query(positions[known])[1]]
    return found


def _window(cloud: Array, cameras: Array, queries: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return x and y limits that hold the cameras and queries, and all but the farthest of the points."""
    parts = [cameras, queries[np.isfinite(queries).all(1)]]
    if len(cloud):
        parts.append(np.percentile(cloud, [3, 97], axis=0))
    held = np.concatenate(parts) if sum(map(len, parts)) else np.zeros((1, 2))
    low, high = held.min(0), held.max(0)
    half = (high - low) / 2 * 1.08 + 0.5
    # A street is long and thin; a panel should not be.
    half = np.maximum(half, half.max() / 2.2)
    middle = (low + high) / 2
    (x0, y0), (x1, y1) = middle - half, middle + half
    return (float(x0), float(x1)), (float(y0), float(y1))


def _outside(positions: Array, window: tuple[tuple[float, float], tuple[float, float]]) -> int:
    known = positions[np.isfinite(positions).all(1)]
    low, high = np.array(window).T
    return int(((known < low) | (known > high)).any(1).sum())


def _muted(colors: NDArray[np.uint8]) -> Array:
    """Return colors for thin points on white: bright ones would not be seen."""
    rgb = colors.astype(np.float64) / 255
    return np.clip(rgb * 0.75 + 0.2, 0, 0.75)


def _draw_heading(
    axis: "Axes",
    positions: Array,
    poses: Array,
    axes: Array,
    color: str,
    window: tuple[tuple[float, float], tuple[float, float]],
    label: str,
) -> None:
    """Draw cameras as dots with a line in the direction they look."""
    if not len(positions):
        return
    length = 0.035 * max(np.ptp(window[0]), np.ptp(window[1]))
    heads = positions + length * poses[:, :3, 2] @ axes.T
    lines = np.full((3 * len(positions), 2), np.nan)
    lines[0::3], lines[1::3] = positions, heads
    axis.plot(*lines.T, color=color, lw=1.0, alpha=0.7)
    _dots(axis, positions, s=9, color=color, lw=0, zorder=3, label=label)


def _draw_queries(
    axis: "Axes",
    seen: Array,
    known: Array,
    estimated: Array,
    true: Array,
    axes: Array,
    window: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    has_estimate, has_truth = np.isfinite(seen).all(1), np.isfinite(known).all(1)
    both = has_estimate & has_truth
    errors = np.where(both, np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1), np.nan)
    colors = error_colors(errors) / 255.0
    lines = np.stack([seen[both], known[both]], axis=1)
    axis.add_collection(LineCollection(list(lines), colors=list(colors[both]), linewidths=1.6, zorder=4))
    _dots(axis, known[both], s=52, facecolors="none", edgecolors=TRUE, lw=1.2, zorder=5,
                 label="query, true" if both.any() else None)  # fmt: skip
    lost = has_truth & ~has_estimate
    _dots(axis, known[lost], s=42, marker="x", color=ESTIMATED, lw=1.8, zorder=6,
                 label="query without a pose, where it truly was" if lost.any() else None)  # fmt: skip
    length = 0.035 * max(np.ptp(window[0]), np.ptp(window[1]))
    heads = seen + length * estimated[:, :3, 2] @ axes.T
    lines = np.stack([seen[has_estimate], heads[has_estimate]], axis=1)
    axis.add_collection(LineCollection(list(lines), colors=list(colors[has_estimate]), linewidths=1.0, zorder=4))
    _dots(axis, seen[has_estimate], s=16, c=colors[has_estimate], lw=0, zorder=5,
                 label="query, estimated; a line leads to its true place" if has_estimate.any() else None)  # fmt: skip
