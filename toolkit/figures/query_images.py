"""Draw queries beside their references, with the matches between them."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from toolkit.capture.images import read_for_display
from toolkit.figures.style import ESTIMATED, GREEN, SKY, new_figure, styled
from toolkit.files import own_name
from toolkit.geometry import Floats, pose_error, project
from toolkit.pose.base import Query
from toolkit.results.localized import QueryDetails, ShownImage
from toolkit.results.metrics import is_posed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

PURPLE = "#CC79A7"
WAYS = {"": GREEN, "guided": GREEN, "descriptors": SKY, "lifted": PURPLE}
"""Colors of correspondences that agree with the pose, by how they were found."""
MARKERS = {"": "o", "sift": "o", "aliked": "^", "superpoint": "s"}
"""Markers, by kind of features."""
MAX_LINES = 60
"""Lines drawn for correspondences that agree, and for rejected ones: more would hide the images."""
MAX_SHOWN = 8
"""References of an image that `draw_query_and_references` draws."""
MAX_LETTERS = 50
"""Letters of an image name in a table, or on the sheet of the worst queries: more would run into the next image."""


def shown_name(name: str, most: int = 1000) -> str:
    """Return an image's name without its session; of one longer than `most` letters, the end of the file's name."""
    name = own_name(name.rpartition("/raw_data/")[2])
    name = name if len(name) <= most else f"…/{name.rpartition('/')[2]}"
    return name if len(name) <= most else f"…{name[1 - most :]}"


def query_and_references(
    figure: "Figure | SubFigure", count: int, rows: int, query_ratio: float, widest: float
) -> tuple["Axes", list["Axes"]]:
    """Return axes of a query, and of its references in some rows to the right, which are as high together; the ratios
    are width by height of the query, and of the widest reference.
    """
    columns = -(-count // rows)
    grid = figure.add_gridspec(rows, 1 + columns, width_ratios=[query_ratio, *[widest / rows] * columns])
    query = figure.add_subplot(grid[:, 0])
    return query, [figure.add_subplot(grid[k // columns, 1 + k % columns]) for k in range(count)]


def draw_image(
    axis: "Axes",
    image: ShownImage | Path | NDArray[np.uint8],
    inches: float,
    title: str = "",
    color: str = "black",
    frame: str | None = None,
    left: float = 0.0,
    height: float | None = None,
) -> float:
    """Draw an image and return its right edge; a `ShownImage` is drawn in its own pixels.

    Args:
        inches: its longer side in the figure; of a `ShownImage` its height, if it is wider than high.
        color: color of the title.
        frame: color of the frame; None: no frame.
        left, height: where a `ShownImage` begins, and its height, in pixels of another image; None: its own.
    """
    extent = None
    if isinstance(image, ShownImage):
        height, ratio = image.camera.height if height is None else height, image.ratio
        extent, inches = (left, left + height * ratio, height, 0), inches * max(1.0, ratio)
        image = image.image
    in_file = math.ceil(inches * mpl.rcParams["savefig.dpi"])
    pixels = read_for_display(image, in_file) if isinstance(image, Path) else image
    axis.imshow(pixels, cmap="gray", extent=extent, interpolation="antialiased")
    for side in (axis.xaxis, axis.yaxis):
        side.set_visible(False)  # a layout also measures axes without ticks
    axis.set_title(title, fontsize=8, color=color)
    axis.spines[:].set(visible=frame is not None, color=frame, linewidth=2)
    return extent[1] if extent else pixels.shape[1]


def style_of(kind: str, agrees: bool) -> dict[str, Any]:
    """Return color and marker of a kind of correspondences, such as `sift/guided`."""
    features, _, way = kind.rpartition("/")
    return {"color": WAYS.get(way, SKY) if agrees else ESTIMATED, "marker": MARKERS.get(features, "D")}


def draw_matches(
    axis: "Axes",
    image: ShownImage,
    size: float,
    by_kind: bool = False,
    only: NDArray[np.bool_] | bool = True,
    at: Floats | None = None,
) -> None:
    """Draw the keypoints of an image: those that agree with the pose, and those of rejected matches.

    With `by_kind`, colors and markers tell how matches were found; else those that agree are green. Only some, (n,),
    are drawn, or all; `at` (n, 2), or at their pixels.
    """
    kinds = image.found_by if by_kind else np.full(len(image.pixels), "")
    for agrees in (False, True):
        for kind in sorted(set(kinds.tolist())):
            chosen = (kinds == kind) & (image.agrees == agrees) & only
            if chosen.any():
                x, y = (image.pixels if at is None else at)[chosen].T
                axis.scatter(x, y, s=size, lw=0, alpha=0.9 if agrees else 0.6, **style_of(kind, agrees))


def draw_joined(axis: "Axes", query: QueryDetails, inches: float, by_kind: bool = False) -> None:
    """Draw the first image of a query and its best reference, `inches` high, and join their common points.

    With `by_kind`, see `draw_matches`, the query also has the keypoints that the reference does not see.
    """
    image, height = query.cameras[0], query.cameras[0].camera.height
    end = draw_image(axis, image, inches)
    if by_kind:
        draw_matches(axis, image, 9, by_kind)
    for reference, _, _ in query.captioned_references()[:1]:
        left = 1.02 * end
        end = draw_image(axis, reference, inches, left=left, height=height)
        _, i, j = np.intersect1d(image.matches, reference.matches, return_indices=True)
        seen = reference.pixels * (height / reference.camera.height) + [left, 0.0]
        draw_matches(axis, reference, 5, by_kind, np.isin(reference.matches, image.matches), seen)
        if not by_kind:
            draw_matches(axis, image, 5, only=np.isin(image.matches, reference.matches))
        lines = np.stack([image.pixels[i], seen[j]], axis=1)
        for agrees in (False, True):
            chosen = np.flatnonzero(image.agrees[i] == agrees)
            chosen = chosen[:: len(chosen) // MAX_LINES + 1]
            kinds = image.found_by[i[chosen]].tolist() if by_kind else [""] * len(chosen)
            colors = [style_of(kind, agrees)["color"] for kind in kinds]
            axis.add_collection(LineCollection(list(lines[chosen]), colors=colors, linewidths=0.6, alpha=0.7))
    axis.set(xlim=(0, end), ylim=(height, 0), aspect="equal")


@styled
def draw_pair(query: ShownImage, reference: ShownImage, title: str) -> "Figure":
    """Draw a query image and a reference with lines between their matches."""
    figure = new_figure(11, 4.2)
    axis = figure.subplots()
    draw_joined(axis, QueryDetails([query], [reference]), 3.6)
    axis.set_axis_off()
    axis.set_title(f"{title}\n{shown_name(query.name)}  |  {shown_name(reference.name)}", fontsize=9)
    return figure


@styled
def draw_query_and_references(
    images: Sequence[Path | NDArray[np.uint8]], references: Sequence[Sequence[tuple[Path, float]]]
) -> "Figure":
    """Draw the images of a query, files or pixels, in rows, each beside its references: file and score, best first."""
    shown_rows = [found[:MAX_SHOWN] for found in references]
    columns = max([len(found) for found in shown_rows], default=0)
    figure = new_figure(13, 1.75 * len(images))
    panels = figure.subplots(len(images), 1 + max(columns, 1), squeeze=False)
    for axis in panels.flat:
        axis.set_axis_off()
    for row, image, found in zip(panels, images, shown_rows, strict=True):
        row[0].set_axis_on()
        draw_image(row[0], image, 2.0, "query", frame="black")
        for rank, (axis, (file, score)) in enumerate(zip(row[1:], found, strict=False), start=1):
            draw_image(axis, file, 2.0, f"{rank}: {score:.2f}")
    return figure


@styled
def draw_keypoints(query: Query) -> "Figure":
    """Draw the images of a query with the keypoints of its first kind of features; return the figure."""
    figure = new_figure(5.0 * len(query.views), 4.0)
    axes = figure.subplots(1, len(query.views), squeeze=False)[0]
    for axis, view, features in zip(axes, query.views, query.features, strict=True):
        keypoints = np.zeros((0, 2)) if isinstance(features, str) else features[0].keypoints
        image = ShownImage(view.name, view.image, view.camera, np.eye(4))
        draw_image(axis, image, 4.0, f"{len(keypoints)} keypoints")
        axis.scatter(*keypoints.T, s=6, facecolors="none", edgecolors=SKY, lw=0.7)
    return figure


@styled
def draw_localization(query: QueryDetails, title: str = "", unit: tuple[str, float] = ("m", 1.0)) -> "Figure":
    """Draw the first image of a query beside its references, with their correspondences; return the figure.

    Green dots are the projections of map points that agree with the pose; a white line joins each to its measured
    keypoint. Orange dots are keypoints of rejected matches. The references have the same colors. A pose without matches
    is shown with the references that it was computed from, and those that were rejected. If the true pose is known, the
    errors follow the title.
    """
    query = query.of_first_camera()
    shown, references = query.cameras[0], query.captioned_references()
    # The query is as high as two rows of references, to keep its points visible.
    rows = 2 if len(references) > 1 else 1
    size = shown.camera.width, shown.camera.height
    widest = max((image.ratio for image, _, _ in references), default=1.0)
    figure = new_figure(4.4 * (shown.ratio + widest * -(-len(references) // rows) / rows) + 0.6, 5.3)
    axis, panels = query_and_references(figure, len(references), rows, shown.ratio, widest)
    located, good = bool(is_posed(shown.world_from_cam)), shown.agrees
    if not located:
        caption = "query: not localized" + (f", {len(good)} matches" if len(good) else "")
    elif query.has_matches:
        caption = f"query: {shown.num_agreeing} of {len(good)} map points agree"
    else:
        caption = "query: no matches, the pose comes from the references"
    draw_image(axis, shown, 4.4, caption, frame=GREEN if located else ESTIMATED)
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
        draw_image(panel, image, 4.4 / rows, text, frame="0.6" if agrees else ESTIMATED)
        draw_matches(panel, image, 4)
    if located and is_posed(shown.world_from_cam_true):
        rotation_deg, distance = map(float, pose_error(shown.world_from_cam, shown.world_from_cam_true))
        title = f"{title}{' · ' if title else ''}{off_by(rotation_deg, distance / unit[1], unit[0])}"
    figure.suptitle(title)
    return figure


@styled
def draw_worst(queries: Sequence[tuple[str, QueryDetails]], title: str = "The worst queries") -> "Figure":
    """Draw queries, a caption and details each, beside their best references, with lines between common points."""
    columns = 2 if len(queries) > 1 else 1
    rows = max(1, -(-len(queries) // columns))
    figure = new_figure(6.0 * columns, 2.75 * rows + 0.8)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in panels:
        axis.set_axis_off()
    if not len(queries):
        panels[0].text(0.5, 0.5, "no queries", ha="center")
    for rank, (axis, (caption, query)) in enumerate(zip(panels, queries, strict=False), start=1):
        draw_joined(axis, query, 2.2)
        image, references = query.cameras[0], query.captioned_references()
        if references and not image.agrees[np.isin(image.matches, references[0][0].matches)].any():
            text = "no common points" if query.has_matches else f"no matches; {references[0][1]}"
            box = {"facecolor": "black", "alpha": 0.6, "lw": 0, "pad": 2}
            axis.text(0.5, 0.04, text, ha="center", color="white", fontsize=8, bbox=box, transform=axis.transAxes)
        text = f"{rank}. {caption}\n{shown_name(image.name, MAX_LETTERS)}"
        axis.set_title(text, fontsize=8, loc="left", wrap=True)
    legend = "left: query, right: its best reference; lines: agreeing (green) and rejected matches (orange) of both"
    figure.suptitle(f"{title}\n({legend})")
    return figure


def off_by(rotation_deg: float, length: float, unit: str) -> str:
    """Return the errors of a pose, in degrees and a unit of lengths, as a text such as `off by 2°, 50 cm`."""
    small = f"{100 * length:.2g} cm" if unit == "m" and length < 0.995 else f"{length:.3g} {unit}"
    return f"off by {rotation_deg:.{2 if rotation_deg < 99.5 else 3}g}°, {small}"
