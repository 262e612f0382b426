"""Draw still pictures of queries in a map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import LineCollection
from numpy.typing import ArrayLike, NDArray

from toolkit.figures.choice import shown_name
from toolkit.figures.query_images import draw_image, draw_joined, draw_matches, query_and_references
from toolkit.figures.style import (
    ESTIMATED,
    GREEN,
    MAP,
    TRUE,
    error_bar,
    error_colors,
    new_figure,
    shared_legend,
    styled,
)
from toolkit.figures.top_view import Ground, Layer, draw_places
from toolkit.geometry import Floats, pose_error, project
from toolkit.results.images import QueryDetails
from toolkit.results.metrics import is_posed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_POINTS = 60_000
"""Points in the map from above, at most: a regular sample."""
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
    ground, step = Ground.below(map_poses, up, unit), len(points) // MAX_POINTS + 1
    points = points[::step]
    # Darker colors: small bright points would vanish on white.
    tint = "#9A9A9A" if colors is None else np.clip(colors[::step] / 255 * 0.75 + 0.2, 0, 0.75)
    has_estimate, has_truth = is_posed(estimated), is_posed(true)
    both, lost = has_estimate & has_truth, has_truth & ~has_estimate
    errors = error_colors(np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1) / unit[1]) / 255.0
    line: dict[str, Any] = {"track": True, "lw": 0.7, "alpha": 0.5, "zorder": 2}
    layers = [
        Layer(points, None, tint, s=1.2, lw=0, rasterized=True),
        *(Layer(track, "map tracks", MAP, **line) for track in map_tracks),
        *(Layer(track, "true query tracks", TRUE, **line) for track in query_tracks),
        Layer(map_poses, "map cameras", MAP, 0.035, s=9, lw=0, zorder=3),
        Layer(true[both], "query, true", TRUE, hollow=True, s=52, lw=1.2, zorder=5),
        Layer(true[lost], "query without a pose, true", ESTIMATED, s=42, marker="x", lw=1.8, zorder=6),
        Layer(estimated[has_estimate], "query, estimated; a line joins it to its true position", errors[has_estimate],
              0.035, s=16, lw=0, zorder=5),
    ]  # fmt: skip
    anchors = np.where(has_truth[:, None, None], true, estimated)
    figure, places, panels = draw_places(ground, layers, map_poses, points, anchors)
    centers = ground.flat(estimated)
    joins = np.stack([centers, ground.flat(true)], axis=1)
    of_place = places.nearest(ground.flat(anchors))
    for axis, place, (low, high) in panels:
        here = of_place == place
        joined = both & here
        axis.add_collection(LineCollection(list(joins[joined]), colors=errors[joined], linewidths=1.6, zorder=4))
        name = f"place {place + 1}: " if places.numbers.any() else ""
        outside = int((((centers < low) | (centers > high)).any(axis=1) & here).sum())
        far = f", {outside} estimated outside the picture" if outside else ""
        axis.set_title(f"{name}{(has_estimate & here).sum()} of {here.sum()} queries have a pose{far}", fontsize=9)
    axes = [axis for axis, _, _ in panels]
    if both.any():
        error_bar(figure, unit[0], ax=axes, shrink=0.8)
    shared_legend(figure, axes, ncols=5, frameon=False, fontsize=9)
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
    size = shown.camera.width, shown.camera.height
    ratio = size[0] / size[1]
    widest = max((image.camera.width / image.camera.height for image, _, _ in references), default=1.0)
    figure = new_figure(4.4 * (ratio + widest * -(-len(references) // rows) / rows) + 0.6, 5.3)
    axis, panels = query_and_references(figure, len(references), rows, ratio, widest)
    located, good = bool(is_posed(shown.world_from_cam)), shown.inlier
    if not located:
        caption = "query: not localized" + (f", {len(good)} matches" if len(good) else "")
    elif query.has_matches:
        caption = f"query: {shown.num_inliers} of {len(good)} map points agree"
    else:
        caption = "query: no matches, the pose comes from the references"
    draw_image(axis, shown, 4.4 * max(1.0, ratio), caption, frame=GREEN if located else ESTIMATED)
    draw_matches(axis, shown, 7, only=~good)
    if located and good.any():
        projected, visible = project(shown.points, shown.camera, shown.world_from_cam)
        inside = good & visible & (projected >= 0).all(1) & (projected < size).all(1)
        lines = np.stack([shown.pixels[inside], projected[inside]], axis=1)
        axis.add_collection(LineCollection(list(lines), colors="white", linewidths=0.8))
        x, y = projected[inside].T
        axis.scatter(x, y, s=11, c=GREEN, edgecolors="white", lw=0.35)
    axis.set(xlim=(0, size[0]), ylim=(size[1], 0))
    for panel, (image, text, agrees) in zip(panels, references, strict=True):
        wide = image.camera.width / image.camera.height
        draw_image(panel, image, 4.4 / rows * max(1.0, wide), text, frame="0.6" if agrees else ESTIMATED)
        draw_matches(panel, image, 4)
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
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in panels:
        axis.set_axis_off()
    if not len(queries):
        panels[0].text(0.5, 0.5, "no queries", ha="center")
    for rank, (axis, query) in enumerate(zip(panels, queries, strict=False), start=1):
        draw_joined(axis, query.details, 2.2)
        image, references = query.details.cameras[0], query.details.captioned_references()
        if references and not image.inlier[np.isin(image.matches, references[0][0].matches)].any():
            text = "no common points" if query.details.has_matches else f"no matches; {references[0][1]}"
            box = {"facecolor": "black", "alpha": 0.6, "lw": 0, "pad": 2}
            axis.text(0.5, 0.04, text, ha="center", color="white", fontsize=8, bbox=box, transform=axis.transAxes)
        has_error = np.isfinite(query.translation_m)
        off = f"off by {query.rotation_deg:.2g}°, {_length(query.translation_m, query.unit)}; " if has_error else ""
        name = shown_name(image.name, MOST_LETTERS)
        axis.set_title(f"{rank}. {query.pair}: {off}{query.reason}\n{name}", fontsize=8, loc="left", wrap=True)
    legend = "left: query, right: its best reference; lines: agreeing (green) and rejected matches (orange) of both"
    figure.suptitle(f"{title}\n({legend})")
    return figure


def _length(length: float, unit: str) -> str:
    return f"{100 * length:.2g} cm" if unit == "m" and length < 0.995 else f"{length:.3g} {unit}"
