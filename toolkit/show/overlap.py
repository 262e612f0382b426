"""Do two images show the same? By the points that one sees, and the view of the other."""

from typing import TYPE_CHECKING, Any

import numpy as np

from toolkit.capture import Session
from toolkit.capture.cameras import in_view, view_bounds
from toolkit.files import image_name
from toolkit.geometry import Floats, invert, transform

if TYPE_CHECKING:
    import pycolmap

    from toolkit.localizers.local_map import LocalMap

LEAST_OVERLAP = 0.1
"""A first reference overlaps with the query if the query sees at least this share of the map points that it sees."""


def overlap_in_view(points: Floats, reference: Floats, world_from_cam: Floats, camera: "pycolmap.Camera") -> float:
    """Return the share, 0 to 1, of the points that a reference sees which lie in the view of another camera.

    The overlap of two images by sparse points, as M. Dusmanu et al., "D2-Net", CVPR 2019, choose training pairs. A
    point that the camera would look at from behind (over 90 degrees from the reference's line of sight) is not seen.

    Args:
        points: (P, 3) triangulated points that the reference observes, world, meters.
        reference: (3,) its center.
        world_from_cam: (4, 4) the other camera's pose.
        camera: its intrinsics.
    """
    if not len(points):
        return 0.0
    in_cam = transform(invert(world_from_cam), points)
    same_side = np.sum((points - reference) * (points - world_from_cam[:3, 3]), axis=1) > 0
    seen = in_view(in_cam[None], view_bounds(camera)[None])[0] & same_side
    return float(seen.mean())


def seen_by(reference: dict[str, Any], session: Session, local_map: "LocalMap | None") -> Floats:
    """Return the points (P, 3) that a reference sees, world, meters."""
    if local_map is not None:
        image = local_map.index_of.get(image_name(str(reference["path"])))
        points = np.zeros(0, np.int64) if image is None else np.unique(local_map.observations(image)[1])
        return local_map.points[points]
    left, right, top, bottom = view_bounds(session.camera(reference["sensor_id"]))
    x, y = np.meshgrid(np.linspace(left, right, 9), np.linspace(top, bottom, 9))
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(1, -1, 3)
    points = (rays * np.array([2.0, 4.0, 8.0, 16.0])[:, None, None]).reshape(-1, 3)
    return transform(np.array(reference["Tws"], float), points)
