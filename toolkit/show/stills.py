"""Draw still pictures of queries in a map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.images import read_for_display
from toolkit.capture.world_up import up_of_cameras
from toolkit.geometry import Floats, Ints, make_pose, pose_error, project
from toolkit.show.choice import shown_name
from toolkit.show.figures import (
    ESTIMATED,
    GREEN,
    MAP,
    TRUE,
    error_bar,
    error_colors,
    inches_to_pixels,
    new_figure,
    shared_legend,
    styled,
)
from toolkit.show.localized import QueryDetails, ShownImage
from toolkit.show.metrics import is_posed
from toolkit.show.top_view import draw_dots, draw_headings, ground_axes, places_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Window = tuple[tuple[float, float], tuple[float, float]]
"""Limits of x and y, meters."""

MAX_PLACES, MAX_POINTS = 6, 60_000
"""Limits of the map from above: panels (places with the most map images), and points in all (a regular sample)."""
MOST_LETTERS = 60
"""Letters of an image name on the sheet of the worst queries: more would run into the next picture."""


@dataclass(frozen=True)
class WorstQuery:
    """A query on the sheet of the worst queries."""

    pair: str
    reason: str
    """Status and counts of matches."""
    details: QueryDetails
    rotation_deg: float = np.nan
    translation_m: float = np.nan
    """Its errors; NaN without a pose or ground truth."""
    unit: str = "m"
    """Unit of lengths."""


@styled
def draw_scene(
    points: Floats,
    colors: NDArray[np.uint8] | None,
    map_poses: ArrayLike,
    estimated: Floats,
    true: Floats,
    up: ArrayLike | None = None,
    title: str = "Queries in the map, seen from above",
    map_tracks: Sequence[Floats] = (),
    query_tracks: Sequence[Floats] = (),
    unit: tuple[str, float] = ("m", 1.0),
) -> "Figure":
    """Draw the map from above with estimated and true query poses, one panel per place; return the figure.

    Args:
        points: (P, 3), meters.
        colors: (P, 3) RGB, or None.
        map_poses: world_from_cam (N, 4, 4) of the map; NaN rows are skipped.
        estimated: world_from_cam (Q, 4, 4) of the queries, NaN without a pose.
        true: true world_from_cam (Q, 4, 4) of the queries, NaN where unknown.
        up: up direction (3,); None: estimated from the map's cameras.
        map_tracks: tracks of the map devices, (n, 3) each, drawn as lines.
        query_tracks: true tracks of the query devices.
        unit: unit that lengths are shown in, see `metrics.length_unit`.
    """
    map_poses = np.asarray(map_poses, np.float64)
    map_poses = map_poses[is_posed(map_poses)]
    axes, labels = ground_axes(up_of_cameras(map_poses) if up is None else up, unit[0])
    points, map_poses, estimated, true = points / unit[1], *(_in(unit, poses) for poses in (map_poses, estimated, true))
    map_tracks, query_tracks = ([track / unit[1] for track in tracks] for tracks in (map_tracks, query_tracks))
    step = len(points) // MAX_POINTS + 1
    cloud, shades = points[::step] @ axes.T, None if colors is None else colors[::step]
    cameras, estimated_xy, true_xy = (poses[:, :3, 3] @ axes.T for poses in (map_poses, estimated, true))

    place = places_of(cameras)
    anchors = np.where(np.isfinite(true_xy), true_xy, estimated_xy)
    query_place = _nearest(anchors, cameras, place)
    point_place = _nearest(cloud, cameras, place)
    counts = np.bincount(place, minlength=1)
    shown = np.sort(np.argsort(-counts, kind="stable")[:MAX_PLACES])
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
        points_here, cameras_here, here = point_place == p, place == p, query_place == p
        queries, centers = estimated[here], estimated_xy[here]
        # Darker colors: small bright points would vanish on white.
        tint = "#9A9A9A" if shades is None else np.clip(shades[points_here] / 255 * 0.75 + 0.2, 0, 0.75)
        draw_dots(axis, cloud[points_here], s=1.2, c=tint, lw=0, rasterized=True)
        for tracks, color, label in ((map_tracks, MAP, "map tracks"), (query_tracks, TRUE, "true query tracks")):
            for number, track in enumerate(tracks):
                axis.plot(*(track @ axes.T).T, color=color, lw=0.7, alpha=0.5, zorder=2,
                          label=None if number else label)  # fmt: skip
        length = 0.035 * np.ptp(window, axis=1).max()
        style: dict[str, Any] = {"colors": MAP, "alpha": 0.7, "linewidths": 1.0}
        draw_headings(axis, cameras[cameras_here], map_poses[cameras_here], axes, length, **style)
        style = {"s": 9, "color": MAP, "lw": 0, "zorder": 3, "label": "map cameras" if cameras_here.any() else None}
        draw_dots(axis, cameras[cameras_here], **style)
        _draw_queries(axis, queries, true[here], axes, length)
        axis.set(xlim=window[0], ylim=window[1], aspect="equal", xlabel=labels[0])
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.2)
        name = f"place {int(p) + 1}: " if len(counts) > 1 else ""
        low, high = np.array(window).T
        outside = int(((centers < low) | (centers > high)).any(1).sum())
        far = f", {outside} estimated outside the picture" if outside else ""
        axis.set_title(f"{name}{is_posed(queries).sum()} of {len(queries)} queries have a pose{far}", fontsize=9)
        if len(shown) < len(counts) and axis is panels[len(shown) - 1]:
            axis.annotate(f"{len(counts) - len(shown)} smaller places not shown", (1, -0.2), fontsize=8,
                          xycoords="axes fraction", ha="right")  # fmt: skip
    for row in range(rows):
        panels[row * columns].set_ylabel(labels[1])
    if (is_posed(estimated) & is_posed(true)).any():
        error_bar(figure, unit[0], ax=list(panels[: len(shown)]), shrink=0.8)
    shared_legend(figure, panels, ncols=5, frameon=False, fontsize=9)
    figure.suptitle(title)
    return figure


@styled
def draw_localization(query: QueryDetails, title: str = "", unit: tuple[str, float] = ("m", 1.0)) -> "Figure":
    """Draw the first image of a query beside its references, with their correspondences; return the figure.

    Green dots are the projections of map points that agree with the pose; a white line joins each to its measured
    keypoint. Orange dots are keypoints of rejected matches. The references have the same colors. A pose without matches
    is shown with the references that it was computed from, and those that were rejected.

    Args:
        query: the query; its first image is drawn.
        title: title of the figure; if the true pose is known, the errors are appended.
        unit: unit that lengths are shown in, see `metrics.length_unit`.
    """
    query = query.of_first_camera()
    shown, references = query.cameras[0], query.captioned_references()
    # The query is as high as two rows of references, to keep its points visible.
    rows = 2 if len(references) > 1 else 1
    columns = -(-len(references) // rows)
    ratio = shown.camera.width / shown.camera.height
    widest = max((image.camera.width / image.camera.height for image, _, _ in references), default=1.0)
    figure = new_figure(4.4 * ratio + columns * widest * 4.4 / rows + 0.6, 5.3)
    grid = figure.add_gridspec(rows, 1 + columns, width_ratios=[ratio, *[widest / rows] * columns])
    axis = figure.add_subplot(grid[:, 0])
    located, good = bool(is_posed(shown.world_from_cam)), shown.inlier
    _draw_photograph(axis, shown, GREEN if located else ESTIMATED, 4.4)
    draw_dots(axis, _on(shown.pixels[~good]), s=7, c=ESTIMATED, alpha=0.5 if located else 1, lw=0)
    if not located:
        caption = "query: not localized" + (f", {len(good)} matches" if len(good) else "")
    elif query.has_matches:
        projected, visible = project(shown.points, shown.camera, shown.world_from_cam)
        size = shown.camera.width, shown.camera.height
        inside = good & visible & (projected >= 0).all(1) & (projected < size).all(1)
        lines = np.stack([_on(shown.pixels[inside]), _on(projected[inside])], axis=1)
        axis.add_collection(LineCollection(list(lines), colors="white", linewidths=0.8))
        draw_dots(axis, _on(projected[inside]), s=11, c=GREEN, edgecolors="white", lw=0.35)
        caption = f"query: {shown.num_inliers} of {len(good)} map points agree"
    else:
        caption = "query: no matches, the pose comes from the references"
    axis.set_title(caption, fontsize=9)
    for k, (image, text, agrees) in enumerate(references):
        panel = figure.add_subplot(grid[k // columns, 1 + k % columns])
        _draw_photograph(panel, image, "0.6" if agrees else ESTIMATED, 4.4 / rows)
        panel.set_title(text, fontsize=8)
        draw_dots(panel, _on(image.pixels[~image.inlier]), s=3, c=ESTIMATED, alpha=0.5, lw=0)
        draw_dots(panel, _on(image.pixels[image.inlier]), s=5, c=GREEN, lw=0)
    if located and is_posed(shown.world_from_cam_true):
        rotation, distance = pose_error(shown.world_from_cam, shown.world_from_cam_true)
        off = f"{float(rotation):.2g}°, {_length(float(distance) / unit[1], unit[0])}"
        title = f"{title}{' · ' if title else ''}off by {off}"
    figure.suptitle(title)
    return figure


@styled
def draw_worst(queries: Sequence[WorstQuery], title: str = "The worst queries") -> "Figure":
    """Draw queries, the worst first, each beside its best reference with lines between common points."""
    columns = 2 if len(queries) > 1 else 1
    rows = max(1, -(-len(queries) // columns))
    figure = new_figure(6.0 * columns, 2.75 * rows + 0.8)
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axis in panels:
        axis.set_axis_off()
    if not len(queries):
        panels[0].text(0.5, 0.5, "no queries", ha="center")
    for rank, (axis, query) in enumerate(zip(panels, queries, strict=False), start=1):
        _draw_side_by_side(axis, query.details)
        has_error = np.isfinite(query.translation_m)
        off = f"off by {query.rotation_deg:.2g}°, {_length(query.translation_m, query.unit)}; " if has_error else ""
        name = shown_name(query.details.cameras[0].name, MOST_LETTERS)
        axis.set_title(f"{rank}. {query.pair}: {off}{query.reason}\n{name}", fontsize=8, loc="left", wrap=True)
    legend = "left: query, right: its best reference; lines: agreeing (green) and rejected matches (orange) of both"
    figure.suptitle(f"{title}\n({legend})")
    return figure


def _draw_side_by_side(axis: "Axes", query: QueryDetails) -> None:
    """Draw a query and its best reference at one height, and join common points."""
    image, references = query.cameras[0], query.captioned_references()[:1]
    width, height = image.camera.width, image.camera.height
    axis.imshow(_read(image, 2.2), extent=(0, width, height, 0), interpolation="antialiased")
    end = float(width)
    for reference, caption, _ in references:
        offset, scale = width * 1.03, height / reference.camera.height
        end = offset + scale * reference.camera.width
        axis.imshow(_read(reference, 2.2), extent=(offset, end, height, 0), interpolation="antialiased")
        _, i, j = np.intersect1d(image.matches, reference.matches, return_indices=True)
        lines = np.stack([image.pixels[i], reference.pixels[j] * scale + [offset, 0.0]], axis=1)
        for agrees, color in ((False, ESTIMATED), (True, GREEN)):
            joined = lines[image.inlier[i] == agrees]
            step = len(joined) // 80 + 1  # more lines would hide the images
            axis.add_collection(LineCollection(list(joined[::step]), colors=color, linewidths=0.5, alpha=0.8))
            draw_dots(axis, joined.reshape(-1, 2), s=4, c=color, lw=0)
        if not image.inlier[i].any():
            text = "no common points" if query.has_matches else f"no matches; {caption}"
            axis.text(end / 2, height * 0.96, text, ha="center", color="white", fontsize=8,
                      bbox={"facecolor": "black", "alpha": 0.6, "lw": 0, "pad": 2})  # fmt: skip
    axis.set(xlim=(0, end), ylim=(height, 0), aspect="equal")


def _on(pixels: Floats) -> Floats:
    """Convert pixels to those of imshow, where the center of the top-left pixel is (0, 0)."""
    return pixels - 0.5


def _read(image: ShownImage, height: float) -> NDArray[np.uint8]:
    """Read an image that is drawn `height` inches high."""
    camera = image.camera
    return read_for_display(image.path, inches_to_pixels(height * max(1.0, camera.width / camera.height)))


def _draw_photograph(axis: "Axes", image: ShownImage, color: str, height: float) -> None:
    """Draw a framed image, `height` inches high."""
    extent = (-0.5, image.camera.width - 0.5, image.camera.height - 0.5, -0.5)
    axis.imshow(_read(image, height), extent=extent)
    axis.set(xticks=[], yticks=[], xlim=extent[:2], ylim=extent[2:])
    axis.spines[:].set(color=color, linewidth=1.5, visible=True)


def _length(length: float, unit: str) -> str:
    return f"{100 * length:.2g} cm" if unit == "m" and length < 0.995 else f"{length:.3g} {unit}"


def _in(unit: tuple[str, float], poses: Floats) -> Floats:
    """Convert the translation of poses to a unit."""
    return make_pose(poses[..., :3, :3], poses[..., :3, 3] / unit[1])


def _nearest(positions: Floats, cameras: Floats, place: Ints) -> Ints:
    """Return the place of the camera nearest to each position; -1 for an unknown position."""
    from scipy.spatial import cKDTree

    nearest = np.full(len(positions), -1, np.int64)
    finite = np.isfinite(positions).all(1)
    if finite.any() and len(cameras):
        nearest[finite] = place[cKDTree(cameras).query(positions[finite])[1]]
    return nearest


def _window(cloud: Floats, cameras: Floats, queries: Floats) -> Window:
    """Return x and y limits that contain the cameras and queries, and all but the farthest points."""
    parts = [cameras, queries[np.isfinite(queries).all(1)]]
    if len(cloud):
        parts.append(np.percentile(cloud, [3, 97], axis=0))
    contained = np.concatenate(parts) if sum(map(len, parts)) else np.zeros((1, 2))
    low, high = contained.min(0), contained.max(0)
    half = (high - low) / 2 * 1.08 + 0.5
    # Limit the aspect ratio: the panel of a street would be long and thin.
    half = np.maximum(half, half.max() / 2.2)
    middle = (low + high) / 2
    (x0, y0), (x1, y1) = middle - half, middle + half
    return (float(x0), float(x1)), (float(y0), float(y1))


def _draw_queries(axis: "Axes", estimated: Floats, true: Floats, axes: Floats, length: float) -> None:
    has_estimate, has_truth = is_posed(estimated), is_posed(true)
    both, lost = has_estimate & has_truth, has_truth & ~has_estimate
    estimated_xy, true_xy = estimated[:, :3, 3] @ axes.T, true[:, :3, 3] @ axes.T
    colors = error_colors(np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)) / 255.0
    lines = np.stack([estimated_xy[both], true_xy[both]], axis=1)
    axis.add_collection(LineCollection(list(lines), colors=list(colors[both]), linewidths=1.6, zorder=4))
    mine = colors[has_estimate]
    style: dict[str, Any] = {"colors": list(mine), "zorder": 4, "linewidths": 1.0}
    draw_headings(axis, estimated_xy[has_estimate], estimated[has_estimate], axes, length, **style)
    for chosen, places, label, style in (
        (both, true_xy, "query, true", {"s": 52, "facecolors": "none", "edgecolors": TRUE, "lw": 1.2, "zorder": 5}),
        (lost, true_xy, "query without a pose, true",
         {"s": 42, "marker": "x", "color": ESTIMATED, "lw": 1.8, "zorder": 6}),
        (has_estimate, estimated_xy, "query, estimated; a line joins it to its true position",
         {"s": 16, "c": mine, "lw": 0, "zorder": 5}),
    ):  # fmt: skip
        if chosen.any():
            draw_dots(axis, places[chosen], label=label, **style)
