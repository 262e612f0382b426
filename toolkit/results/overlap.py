"""Overlap of two images in view: the share of the points seen by one that lie in the view of the other."""

from typing import TYPE_CHECKING, Any

import numpy as np

from toolkit.capture import Session
from toolkit.capture.cameras import in_view, view_bounds
from toolkit.files import image_name
from toolkit.geometry import Floats, invert, transform

if TYPE_CHECKING:
    import pycolmap

    from toolkit.mapping.local_map import LocalMap

LEAST_OVERLAP = 0.1
"""A reference overlaps with a query if the query sees at least this share of the points that the reference sees."""


def overlap_in_view(points: Floats, reference: Floats, world_from_cam: Floats, camera: "pycolmap.Camera") -> float:
    """Return the share, 0 to 1, of a reference's points that lie in the view of another camera.

    D2-Net (M. Dusmanu et al., CVPR 2019) selects training pairs by such an overlap of sparse points. A point counts as
    not seen if the two lines of sight differ by more than 90 degrees, as it would be seen from behind.

    Args:
        points: (P, 3) triangulated points that the reference observes, world, meters.
        reference: (3,) center of the reference.
        world_from_cam: (4, 4) pose of the other camera.
        camera: intrinsics of the other camera.
    """
    if not len(points):
        return 0.0
    in_cam = transform(invert(world_from_cam), points)
    same_side = np.sum((points - reference) * (points - world_from_cam[:3, 3]), axis=1) > 0
    seen = in_view(in_cam[None], view_bounds(camera)[None])[0] & same_side
    return float(seen.mean())


def seen_by(reference: dict[str, Any], session: Session, local_map: "LocalMap | None") -> Floats:
    """Return the points (P, 3) that a reference sees, world, meters; without a map, a grid of points in its view."""
    if local_map is not None:
        image = local_map.index_of.get(image_name(str(reference["path"])))
        points = np.zeros(0, np.int64) if image is None else np.unique(local_map.observations(image)[1])
        return local_map.points[points]
    left, right, top, bottom = view_bounds(session.camera(reference["sensor_id"]))
    x, y = np.meshgrid(np.linspace(left, right, 9), np.linspace(top, bottom, 9))
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(1, -1, 3)
    points = (rays * np.array([2.0, 4.0, 8.0, 16.0])[:, None, None]).reshape(-1, 3)
    return transform(np.array(reference["Tws"], float), points)
