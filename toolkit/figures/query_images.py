"""Draw images of a query and of its references, with the matches between them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from toolkit.capture.images import read_for_display
from toolkit.figures.style import ESTIMATED, GREEN, SKY, inches_to_pixels
from toolkit.geometry import Floats
from toolkit.results.images import QueryDetails, ShownImage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PURPLE = "#CC79A7"
WAYS = {"": GREEN, "guided": GREEN, "descriptors": SKY, "lifted": PURPLE}
"""Colors of correspondences that agree with the pose, by how they were found."""
MARKERS = {"": "o", "sift": "o", "aliked": "^", "superpoint": "s"}
"""Markers, by kind of features."""
LINES = 60
"""Lines drawn at most for correspondences that agree, and for rejected ones: more would hide the images."""


def query_and_references(
    figure: "Figure", count: int, rows: int, query_ratio: float, widest: float
) -> tuple["Axes", list["Axes"]]:
    """Return axes of a query, and of its references in some rows to the right, which are as high together.

    Args:
        query_ratio, widest: width by height of the query, and of the widest reference.
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
        inches: its longer side in the figure.
        color: color of the title.
        frame: color of the frame; None: no frame.
        left, height: where a `ShownImage` begins, and its height, in pixels of another image; None: its own.
    """
    extent = None
    if isinstance(image, ShownImage):
        height = image.camera.height if height is None else height
        extent = (left, left + height * image.camera.width / image.camera.height, height, 0)
        image = image.path
    pixels = read_for_display(image, inches_to_pixels(inches)) if isinstance(image, Path) else image
    axis.imshow(pixels, cmap="gray", extent=extent, interpolation="antialiased")
    axis.set(xticks=[], yticks=[])
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
    only: NDArray[np.bool_] | None = None,
    at: Floats | None = None,
) -> None:
    """Draw the keypoints of an image: those that agree with the pose, and those of rejected matches.

    Args:
        by_kind: whether colors and markers tell how matches were found; else those that agree are green.
        only: (n,) the keypoints to draw; None: all.
        at: (n, 2) where they are drawn; None: at their pixels.
    """
    kinds = image.found_by if by_kind else np.full(len(image.pixels), "")
    for agrees in (False, True):
        for kind in sorted(set(kinds.tolist())):
            chosen = (kinds == kind) & (image.inlier == agrees) & (True if only is None else only)
            if chosen.any():
                x, y = (image.pixels if at is None else at)[chosen].T
                axis.scatter(x, y, s=size, lw=0, alpha=0.9 if agrees else 0.6, **style_of(kind, agrees))


def draw_joined(axis: "Axes", query: QueryDetails, inches: float, by_kind: bool = False) -> None:
    """Draw the first image of a query and its best reference at one height, and join their common points.

    Args:
        inches: height in the figure.
        by_kind: see `draw_matches`; the query then also has the keypoints that the reference does not see.
    """
    from matplotlib.collections import LineCollection

    image, height = query.cameras[0], query.cameras[0].camera.height
    end = draw_image(axis, image, inches * max(1.0, image.camera.width / height))
    if by_kind:
        draw_matches(axis, image, 9, by_kind)
    for reference, _, _ in query.captioned_references()[:1]:
        left = 1.02 * end
        camera = reference.camera
        end = draw_image(axis, reference, inches * max(1.0, camera.width / camera.height), left=left, height=height)
        _, i, j = np.intersect1d(image.matches, reference.matches, return_indices=True)
        seen = reference.pixels * (height / camera.height) + [left, 0.0]
        draw_matches(axis, reference, 5, by_kind, np.isin(reference.matches, image.matches), seen)
        if not by_kind:
            draw_matches(axis, image, 5, only=np.isin(image.matches, reference.matches))
        lines = np.stack([image.pixels[i], seen[j]], axis=1)
        for agrees in (False, True):
            chosen = np.flatnonzero(image.inlier[i] == agrees)
            chosen = chosen[:: len(chosen) // LINES + 1]
            kinds = image.found_by[i[chosen]].tolist() if by_kind else [""] * len(chosen)
            colors = [style_of(kind, agrees)["color"] for kind in kinds]
            axis.add_collection(LineCollection(list(lines[chosen]), colors=colors, linewidths=0.6, alpha=0.7))
    axis.set(xlim=(0, end), ylim=(height, 0), aspect="equal")
