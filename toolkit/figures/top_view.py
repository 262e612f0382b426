"""Draw a map from above: layers of dots, cameras and tracks on the ground plane, one panel per place; and in
perspective, with cameras in it: what a saved notebook keeps of the 3D view.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.upright import up_of_cameras
from toolkit.figures.style import (
    ESTIMATED,
    GRAY,
    MAP,
    ORANGE,
    TRUE,
    error_bar,
    error_colors,
    new_figure,
    shared_legend,
    styled,
)
from toolkit.geometry import Floats, Ints, invert, transform, unit
from toolkit.results.metrics import is_posed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_POINTS = 60_000
"""Points in the map of `draw_scene`, at most: a regular sample."""
MAX_PLACES = 6
"""Panels of a figure, at most: the places with the most cameras."""
MAX_POINTS_3D = 80_000
"""Points that are drawn, at most: a regular sample."""
PYRAMID = np.array([[0, 0, 0], [-0.4, -0.3, 1], [0.4, -0.3, 1], [0.4, 0.3, 1], [-0.4, 0.3, 1.0]])
"""Corners (5, 3) of a drawn camera of depth 1: its center, and its image plane."""
OUTLINE = [0, 1, 2, 0, 3, 4, 0, 1, 4, 3, 2]
"""Order of the corners in which a line draws the pyramid."""


@dataclass(frozen=True)
class Ground:
    """The ground plane that a map is drawn on."""

    axes: Floats
    """(2, 3) right and upward axis of the picture, world."""
    labels: list[str]
    length: float
    """Unit of lengths in the picture, in the unit of the poses."""

    @classmethod
    def below(cls, poses: Floats, up: ArrayLike | None = None, unit: tuple[str | None, float] = ("m", 1.0)) -> "Ground":
        """Return the ground below cameras (N, 4, 4).

        Args:
            up: up direction (3,); None: estimated from the cameras. If it is a world axis, the two axes of the picture
                are world axes, so it shows world coordinates.
            unit: unit of lengths in the picture, None without one, and its length.
        """
        upward = np.asarray(up_of_cameras(poses) if up is None else up, np.float64)
        upward = upward / np.linalg.norm(upward)
        first = np.eye(3)[0 if np.argmax(np.abs(upward)) != 0 else 1]
        right = first - upward * (first @ upward)
        right /= np.linalg.norm(right)
        axes, labels = np.stack([right, np.cross(upward, right)]), []
        for row in axes:
            k = int(np.argmax(np.abs(row)))
            name = f"{'−' if row[k] < 0 else ''}{'xyz'[k]}" if abs(row[k]) > 0.99 else "along the ground"
            labels.append(f"{name} [{unit[0]}]" if unit[0] else name)
        return cls(axes, labels, unit[1])

    def flat(self, world: Floats) -> Floats:
        """Return positions (..., 2) in the picture of world positions (..., 3) or poses (..., 4, 4)."""
        positions = world[..., :3, 3] if world.shape[-1] == 4 else world
        return np.asarray(positions @ self.axes.T / self.length)


class Layer:
    """Positions, cameras, or a track, that are drawn in one style."""

    def __init__(
        self, at: Floats, label: str | None = None, color: Any = "0.6", heading: float = 0.0, track: bool = False,
        hollow: bool = False, **style: Any,
    ) -> None:  # fmt: skip
        """Take positions (N, 3) or poses of cameras (N, 4, 4), world; NaN is not drawn. The color may be an array, one
        per item.

        `heading` is the length of the line in a camera's viewing direction, as a share of the panel; positions of a
        `track` are joined; `style` is passed to matplotlib's `scatter`, of a track to `plot`.
        """
        self.at, self.label, self.color, self.heading = at, label, color, heading
        self.track, self.hollow, self.style = track, hollow, style


def draw_layers(axis: "Axes", ground: Ground, layers: Sequence[Layer], window: Floats) -> None:
    """Draw what lies in a window, low and high corner (2, 2); labels are only of what is drawn."""
    from matplotlib.collections import LineCollection

    for layer in layers:
        xy = ground.flat(layer.at)
        inside = ((xy >= window[0]) & (xy <= window[1])).all(axis=1)
        if not inside.any():
            continue
        if layer.track:
            axis.plot(*xy.T, color=layer.color, label=layer.label, **layer.style)
            continue
        color = layer.color[inside] if isinstance(layer.color, np.ndarray) else layer.color
        if layer.heading:
            length = layer.heading * np.ptp(window, axis=0).max()
            lines = np.stack([xy, xy + length * layer.at[:, :3, 2] @ ground.axes.T], axis=1)[inside]
            zorder = layer.style.get("zorder", 2)
            axis.add_collection(LineCollection(list(lines), colors=color, linewidths=1.1, alpha=0.8, zorder=zorder))
        face: dict[str, Any] = {"facecolors": "none", "edgecolors": color} if layer.hollow else {"c": color}
        x, y = xy[inside].T
        axis.scatter(x, y, label=layer.label, **face, **layer.style)
    axis.set(xlim=window[:, 0], ylim=window[:, 1], aspect="equal", xlabel=ground.labels[0], ylabel=ground.labels[1])


class Places:
    """Places of a map that lie apart, and their windows."""

    def __init__(self, cameras: Floats) -> None:
        """Cluster positions of cameras (N, 2)."""
        self.cameras, self.numbers = cameras, places_of(cameras)

    def nearest(self, xy: Floats) -> Ints:
        """Return the place of the camera nearest to each position (N, 2); -1 for an unknown position."""
        from scipy.spatial import cKDTree

        nearest = np.full(len(xy), -1, np.int64)
        finite = np.isfinite(xy).all(1)
        if finite.any() and len(self.cameras):
            nearest[finite] = self.numbers[cKDTree(self.cameras).query(xy[finite])[1]]
        return nearest

    def contents(self, place: int, cloud: Floats, others: Floats) -> Floats:
        """Return the positions that a picture of a place should contain: its cameras, those of `others` that are
        nearest to it, and the corners of its part of the cloud without the few points far away."""
        cloud = cloud[self.nearest(cloud) == place]
        corners = np.percentile(cloud, [3, 97], axis=0) if len(cloud) else cloud
        return np.concatenate([self.cameras[self.numbers == place], corners, others[self.nearest(others) == place]])


def window_of(xy: Floats, margin: float = 0.07, longest: float = 1.0) -> Floats:
    """Return a window, low and high corner (2, 2), around positions (N, 2), with a margin, a share of their extent, on
    each side, and a ratio of its sides of at most `longest`; 1: a square.
    """
    xy = xy if len(xy) else np.zeros((1, 2))
    half = (0.5 + margin) * np.ptp(xy, axis=0)
    half = np.maximum(half, max(half.max(), 0.5) / longest)
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2
    return np.stack([middle - half, middle + half])


def draw_places(
    ground: Ground, layers: Sequence[Layer], cameras: Floats, cloud: Floats | None = None, others: Floats | None = None
) -> tuple["Figure", Places, list[tuple["Axes", int, Floats]]]:
    """Draw layers, one panel per place that `cameras`, (N, 3) or (N, 4, 4), make; for `cloud` and `others` see
    `Places.contents`. Return the figure, the places, and each panel with the number and the window of its place.
    """
    none = np.zeros((0, 3))
    places = Places(ground.flat(cameras))
    counts = np.bincount(places.numbers, minlength=1)
    shown = np.sort(np.argsort(-counts, kind="stable")[:MAX_PLACES])
    flat = [ground.flat(none if each is None else each) for each in (cloud, others)]
    windows = [window_of(places.contents(place, *flat), longest=2.2) for place in shown]
    columns = min(len(shown), 3)
    rows = -(-len(shown) // columns)
    shape = np.clip(np.mean([np.divide(*np.ptp(window, axis=0)[::-1]) for window in windows]), 0.5, 1.4)
    width = 8.0 if columns == 1 else 4.6
    figure = new_figure(width * columns, width * shape * rows + 1.2)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis, window in zip(axes, windows, strict=False):
        draw_layers(axis, ground, layers, window)
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.2)
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    if len(shown) < len(counts):
        text = f"{len(counts) - len(shown)} smaller places not shown"
        axes[len(shown) - 1].annotate(text, (1, -0.2), fontsize=8, xycoords="axes fraction", ha="right")
    return figure, places, list(zip(axes, shown.tolist(), windows, strict=False))


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
        points, colors: (P, 3), meters, and (P, 3) RGB or None.
        map_poses, estimated, true: world_from_cam (N, 4, 4) of the map, and (Q, 4, 4) of the queries; NaN if unknown.
        map_tracks, query_tracks: tracks of the map devices and true ones of the query devices, (n, 3) each.
    """
    from matplotlib.collections import LineCollection

    map_poses = np.asarray(map_poses, np.float64)
    map_poses = map_poses[is_posed(map_poses)]
    ground, step = Ground.below(map_poses, up, unit), len(points) // MAX_POINTS + 1
    points = points[::step]
    # Darker colors: small bright points would vanish on white.
    tint = "#9A9A9A" if colors is None else np.clip(colors[::step] / 255 * 0.75 + 0.2, 0, 0.75)
    has_estimate, has_truth = is_posed(estimated), is_posed(true)
    both, lost = has_estimate & has_truth, has_truth & ~has_estimate
    errors = error_colors(np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1) / unit[1]) / 255.0
    joined = "; a line joins it to its true position" if both.any() else ""
    line: dict[str, Any] = {"track": True, "lw": 0.7, "alpha": 0.5, "zorder": 2}
    layers = [
        Layer(points, None, tint, s=1.2, lw=0, rasterized=True),
        *(Layer(track, "map tracks", MAP, **line) for track in map_tracks),
        *(Layer(track, "true query tracks", TRUE, **line) for track in query_tracks),
        Layer(map_poses, "map cameras", MAP, 0.035, s=9, lw=0, zorder=3),
        Layer(true[both], "query, true", TRUE, hollow=True, s=52, lw=1.2, zorder=5),
        Layer(true[lost], "query without a pose, true", ESTIMATED, s=42, marker="x", lw=1.8, zorder=6),
        Layer(estimated[has_estimate], f"query, estimated{joined}", errors[has_estimate] if joined else ESTIMATED,
              0.035, s=16, lw=0, zorder=5),
    ]  # fmt: skip
    anchors = np.where(has_truth[:, None, None], true, estimated)
    figure, places, panels = draw_places(ground, layers, map_poses, points, anchors)
    centers = ground.flat(estimated)
    joins = np.stack([centers, ground.flat(true)], axis=1)
    of_place = places.nearest(ground.flat(anchors))
    for axis, place, (low, high) in panels:
        here = of_place == place
        ends = both & here
        axis.add_collection(LineCollection(list(joins[ends]), colors=errors[ends], linewidths=1.6, zorder=4))
        name = f"place {place + 1}: " if places.numbers.any() else ""
        outside = int((((centers < low) | (centers > high)).any(axis=1) & here).sum())
        far = f", {outside} estimated outside the picture" if outside else ""
        # Without truth, it is not known in which place those without a pose are.
        counts = f"{(has_estimate & here).sum()} of {here.sum()} queries have a pose" if has_truth.any() else ""
        axis.set_title(f"{name}{counts}{far}", fontsize=9)
    axes = [axis for axis, _, _ in panels]
    if both.any():
        error_bar(figure, unit[0], ax=axes, shrink=0.8)
    shared_legend(figure, axes, ncols=5, frameon=False, fontsize=9)
    figure.suptitle(title)
    return figure


def places_of(positions: Floats) -> Ints:
    """Cluster positions (N, 2 or 3) into places; return place numbers (N,), from 0 in order of appearance.

    Places are apart by more than 12 % of the whole extent and by more than five times the median step to a neighbor.
    """
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial import cKDTree

    extent = float(np.linalg.norm(np.ptp(positions, axis=0))) if len(positions) else 0.0
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


# In perspective


def pyramids(poses: Floats, depth: float) -> Floats:
    """Return cameras (N, 4, 4) as lines (N, 11, 3) of pyramids of a depth."""
    outline = (depth * PYRAMID)[OUTLINE]
    return np.asarray(np.einsum("nij,kj->nki", poses[:, :3, :3], outline) + poses[:, None, :3, 3])


def _extent(poses: Floats) -> float:
    return max(3.0, float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0))))


@dataclass(frozen=True)
class Eye:
    """Where a scene is looked at from, in world coordinates."""

    position: Floats
    """(3,)"""
    target: Floats
    """(3,)"""
    up: Floats
    """(3,), of length 1."""

    @classmethod
    def of(cls, poses: Floats, up: Floats, others: Sequence[Floats] = ()) -> "Eye":
        """Return an eye behind and above the first other camera (4, 4) in the map, or else the place with the most
        cameras.

        A camera far from the map, such as the true one of a query of elsewhere, would be all that is seen.
        """
        up, place = unit(up), places_of(poses[:, :3, 3])
        here = poses[place == np.bincount(place).argmax()]
        center, view, reach = here[:, :3, 3].mean(0), here[:, :3, 2].mean(0), _extent(here)
        for other in others:
            distances = np.linalg.norm(poses[:, :3, 3] - other[:3, 3], axis=1)
            around = poses[place == place[distances.argmin()]]
            if distances.min() < _extent(around):
                (center, view), reach = other[:3, [3, 2]].T, _extent(around)
                break
        view = view - up * (view @ up)
        target = center + 0.3 * reach * view
        return cls(target - reach * view + 0.7 * reach * up, target, up)

    def farther(self, factor: float) -> "Eye":
        """Return the eye with its distance from the target multiplied by a factor."""
        return Eye(self.target + factor * (self.position - self.target), self.target, self.up)

    @property
    def eye_from_world(self) -> Floats:
        """(4, 4) of a camera at the eye."""
        z = unit(self.target - self.position)
        x = np.cross(z, self.up)
        x = unit(x) if np.linalg.norm(x) > 1e-9 else np.eye(3)[int(np.argmin(np.abs(z)))]
        world_from_eye = np.eye(4)
        world_from_eye[:3] = np.column_stack([x, np.cross(z, x), z, self.position])
        return invert(world_from_eye)


@styled
def draw_scene_3d(
    points: Floats,
    colors: NDArray[np.uint8] | None,
    map_poses: Floats,
    eye: Eye,
    size: float,
    cameras: Sequence[tuple[Floats, str, str]] = (),
    rays: Sequence[tuple[Floats, Floats]] = (),
    title: str = "",
) -> "Figure":
    """Draw map points, map cameras and further cameras as seen from an eye, with a field of view of 60 degrees.

    Args:
        points, colors: (P, 3), and (P, 3) RGB or None.
        map_poses: world_from_cam (N, 4, 4); NaN rows are skipped.
        size: depth of a drawn map camera.
        cameras: pose (4, 4), label and color; they are drawn larger.
        rays: for each of some cameras, its center (3,) and the points (n, 3) that it sees.
    """
    from matplotlib.collections import LineCollection

    figure = new_figure(11, 6.2)
    axis, eye_from_world = figure.subplots(), eye.eye_from_world

    def flat(world: Floats) -> tuple[Floats, NDArray[np.bool_], Floats]:
        """Return positions (..., 2) in the picture, whether they are in front of the eye, and depths."""
        seen = transform(eye_from_world, world.reshape(-1, 3)).reshape(world.shape)
        ahead = seen[..., 2] > 0.05 * size
        depth = np.where(ahead, seen[..., 2], 1.0)
        return np.stack([seen[..., 0] / depth, -seen[..., 1] / depth], axis=-1), ahead, depth

    step = len(points) // MAX_POINTS_3D + 1
    xy, ahead, depth = flat(points[::step])
    order = np.argsort(-depth[ahead])
    shades = GRAY if colors is None else (colors[::step][ahead] / 255.0)[order]
    x, y = xy[ahead][order].T
    axis.scatter(x, y, s=3.0, c=shades, lw=0, rasterized=True)

    def draw(poses: Floats, depth: float, color: str, width: float, label: str | None = None) -> None:
        xy, ahead, _ = flat(pyramids(poses, depth))
        kept = list(xy[ahead.all(axis=1)])
        axis.add_collection(LineCollection(kept, colors=color, linewidths=width, label=label, zorder=3 + width))

    for center, seen in rays:
        ends, ahead, _ = flat(np.stack([np.broadcast_to(center, seen.shape), seen], axis=1))
        lines = list(ends[ahead.all(axis=1)])
        axis.add_collection(LineCollection(lines, colors=ORANGE, linewidths=0.3, alpha=0.5))
    draw(map_poses[is_posed(map_poses)], size, MAP, 0.6, "map cameras")
    for pose, label, color in cameras:
        draw(pose[None], 2 * size, color, 1.8, label)
    half = np.tan(np.radians(30))
    axis.set(xlim=(-half, half), ylim=(-half * 6.2 / 11, half * 6.2 / 11), aspect="equal", xticks=[], yticks=[])
    axis.spines[:].set_visible(False)
    axis.legend(loc="lower right", fontsize=8)
    axis.set_title(title, fontsize=10)
    return figure
