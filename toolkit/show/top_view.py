"""Draw a map from above: axes of the ground plane, places that lie apart, dots and viewing directions."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from toolkit.geometry import Floats, Ints

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def ground_axes(up: ArrayLike, unit: str | None = "m") -> tuple[Floats, list[str]]:
    """Return the right and the upward axis of a picture from above, (2, 3), and their labels.

    If `up` is a world axis, the two are world axes, so the picture shows world coordinates.

    Args:
        up: up direction (3,).
        unit: unit of the coordinates, None if unknown.
    """
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    axis = int(np.argmax(np.abs(up)))
    first = np.eye(3)[0 if axis != 0 else 1]
    right = first - up * (first @ up)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(up, right)])
    labels, in_unit = [], f" [{unit}]" if unit else ""
    for row in axes:
        k = int(np.argmax(np.abs(row)))
        sign = "−" if row[k] < 0 else ""
        labels.append((f"{sign}{'xyz'[k]}" if abs(row[k]) > 0.99 else "along the ground") + in_unit)
    return axes, labels


def places_of(positions: Floats) -> Ints:
    """Cluster positions (N, 2 or 3) into places; return place numbers (N,), from 0 in order of appearance.

    Places are apart by more than 12 % of the whole extent and by more than five times the median step to a neighbor.
    """
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial import cKDTree

    if len(positions) < 2:
        return np.zeros(len(positions), np.int64)
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    # Merge positions on one spot (cameras of a rig), which would bias the step; about a thousand spots suffice.
    spots = np.unique(np.round(positions / max(extent / 400, 1e-9)), axis=0) * max(extent / 400, 1e-9)
    spots = spots[:: len(spots) // 1500 + 1]
    if len(spots) < 2:
        return np.zeros(len(positions), np.int64)
    tree = linkage(spots, "single")
    gap = max(5.0 * float(np.median(tree[:, 2])), 0.12 * extent)
    labels = fcluster(tree, gap, "distance")[cKDTree(spots).query(positions)[1]]
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def draw_headings(axis: "Axes", positions: Floats, poses: Floats, axes: Floats, length: float, **style: Any) -> None:
    """Draw the viewing direction of each camera (N, 4, 4) as a line from its position (N, 2) in the picture."""
    from matplotlib.collections import LineCollection

    ends = positions + length * poses[:, :3, 2] @ axes.T
    axis.add_collection(LineCollection(list(np.stack([positions, ends], axis=1)), **style))


def draw_dots(axis: "Axes", xy: Floats, **style: Any) -> None:
    """Draw positions, (N, 2) or one, (2,); `style` is passed to matplotlib's `scatter`."""
    axis.scatter(*np.reshape(xy, (-1, 2)).T, **style)
