"""A picture of a map and of cameras in it, in perspective: what a saved notebook keeps of the 3D view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from toolkit.figures.style import GRAY, MAP, ORANGE, new_figure, styled
from toolkit.figures.top_view import places_of
from toolkit.geometry import Floats, invert, transform, unit
from toolkit.results.metrics import is_posed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_POINTS = 80_000
"""Points that are drawn, at most: a regular sample."""
PYRAMID = np.array([[0, 0, 0], [-0.4, -0.3, 1], [0.4, -0.3, 1], [0.4, 0.3, 1], [-0.4, 0.3, 1.0]])
"""Corners (5, 3) of a drawn camera of depth 1: its center, and its image plane."""
OUTLINE = [0, 1, 2, 0, 3, 4, 0, 1, 4, 3, 2]
"""Order of the corners in which a line draws the pyramid."""


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

    step = len(points) // MAX_POINTS + 1
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
