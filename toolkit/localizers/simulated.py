"""A stand-in for a network, for tests and for trying things out without weights: it looks up the true cameras.

Poses come from the capture's ground truth and depth from triangulated map points, else from the capture's depth maps;
both are put under a random similarity, with noise. What it takes part in says nothing about any network, and is
labeled `simulated` everywhere.
"""

import hashlib
import json
from collections import OrderedDict
from collections.abc import Sequence
from functools import cache, cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.capture import Session
from toolkit.capture.cameras import in_view, view_bounds
from toolkit.capture.depths import DepthMaps, lifted
from toolkit.capture.devices import session_id
from toolkit.errors import CaptureError
from toolkit.geometry import Floats, Ints
from toolkit.localizers.base import View
from toolkit.localizers.local_map import LocalMap, map_path
from toolkit.localizers.prediction import Prediction

_GRID = 96  # pixels of the longer side of a depth map
_NEAREST = 5  # points whose depth a pixel has; some triangulated points are wrong
_FEW_POINTS = 20  # with fewer, a map image's depth maps are asked
_KEPT = 256  # depth maps of map images kept in memory


class SimulatedPredictor:
    """Ground truth under a random similarity for each group, with noise.

    A group's prediction depends on the seed and the names in the group alone: not on their order, on other groups, or
    on threads. Depth is, at each pixel of a small map, the median of those of the triangulated points seen nearest, or
    of points of the capture's depth maps where there are few.
    """

    name = "simulated"
    simulated = True

    def __init__(
        self,
        sessions: Sequence[Session],
        map_dir: str | Path | None = None,
        features: str = "sift",
        *,
        rotation_noise_deg: float = 1.0,
        position_noise_m: float = 0.03,
        depth_noise: float = 0.05,
        wrong_references: float = 0.0,
        seed: int = 0,
    ) -> None:
        """
        Args:
            sessions: those that the views are of, with ground truth.
            map_dir: folder of triangulated maps; None, or none of a session: no depth.
            features: kind of local features that they are triangulated from.
            rotation_noise_deg: standard deviation of a camera's rotation, as an angle.
            position_noise_m: standard deviation of a camera's place, as a length.
            depth_noise: relative standard deviation of each pixel's depth.
            wrong_references: share of the map images that are put anywhere, looking anywhere.
        """
        self._sessions = {session.id: session for session in sessions}
        self._map_dir = None if map_dir is None else Path(map_dir)
        self._features = features
        self._noise = {
            "rotation_noise_deg": rotation_noise_deg,
            "position_noise_m": position_noise_m,
            "depth_noise": depth_noise,
            "wrong_references": wrong_references,
            "seed": seed,
        }
        self._map = cache(self._load_map)
        self._depths: OrderedDict[str, Floats] = OrderedDict()
        self._lock = Lock()

    @property
    def settings(self) -> dict[str, Any]:
        """The noise and the seed."""
        return dict(self._noise)

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {name: row for s in self._sessions.values() for name, row in s.row_of_name.items()}

    @cached_property
    def _truth(self) -> dict[str, Floats]:
        return {
            name: pose
            for session in self._sessions.values()
            for name, pose in zip(session.image_names, session.world_from_cam(ground_truth=True), strict=True)
        }

    def predict(self, groups: Sequence[Sequence[View]], following: Sequence[Sequence[View]] = ()) -> list[Prediction]:
        """Return a prediction for each group of views.

        Raises:
            CaptureError: the true pose of a view is not known.
        """
        return [self._predict(list(group)) for group in groups]

    def _random(self, *key: Any) -> np.random.Generator:
        text = json.dumps([self._noise["seed"], *key])
        return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16]))

    def _predict(self, group: list[View]) -> Prediction:
        names = sorted(view.name for view in group)
        for view in group:
            if view.name not in self._truth or not np.isfinite(self._truth[view.name]).all():
                raise CaptureError(
                    f"The simulated predictor has no true pose of {view.name}: it works only where "
                    "queries have ground truth in proc/alignment_trajectories.txt. Use another predictor or method."
                )
        true = np.stack([self._truth[view.name] for view in group])
        noisy = np.stack([self._noisy(pose, names, view, true) for pose, view in zip(true, group, strict=True)])
        rng = self._random(names)
        turn, scale = Rotation.random(random_state=rng).as_matrix(), float(np.exp(rng.uniform(-2, 2)))
        shift = rng.normal(size=3) * 3
        model = geometry.make_pose(turn @ noisy[:, :3, :3], scale * noisy[:, :3, 3] @ turn.T + shift)
        sizes = np.array([[view.camera.width, view.camera.height] for view in group], np.float64)
        grid = np.maximum(np.rint(sizes * _GRID / sizes.max()), 1).astype(np.int64).max(axis=0)
        map_from_image = np.zeros((len(group), 4))
        map_from_image[:, :2] = grid / sizes
        depth = np.stack([self._depth(view, group, names, grid) * scale for view in group]).astype(np.float32)
        return Prediction(model, None if np.isnan(depth).all() else depth, map_from_image=map_from_image)

    def _noisy(self, world_from_cam: Floats, names: list[str], view: View, group: Floats) -> Floats:
        rng = self._random(names, view.name)
        turn = Rotation.from_rotvec(rng.normal(size=3) * np.radians(self._noise["rotation_noise_deg"]) / np.sqrt(3))
        moved = rng.normal(size=3) * self._noise["position_noise_m"] / np.sqrt(3)
        if view.in_map and rng.random() < self._noise["wrong_references"]:
            turn = Rotation.random(random_state=rng)
            moved = rng.normal(size=3) * max(2.0, float(np.ptp(group[:, :3, 3], axis=0).max()))
        return geometry.make_pose(world_from_cam[:3, :3] @ turn.as_matrix(), world_from_cam[:3, 3] + moved)

    def _depth(self, view: View, group: list[View], names: list[str], grid: Ints) -> Floats:
        key = f"{view.name} {grid}"
        with self._lock:
            kept = self._depths.get(key) if view.in_map else None
        if kept is None:
            points = self._points(view) if view.in_map else np.concatenate([self._points(v) for v in group])
            kept = _nearest_depth(points, view, self._truth[view.name], grid)
            with self._lock:
                if view.in_map:  # the depth of others depends on the group
                    self._depths[key] = kept
                if len(self._depths) > _KEPT:
                    self._depths.popitem(last=False)
        return kept * (1 + self._noise["depth_noise"] * self._random(names, view.name, "depth").normal(size=kept.shape))

    def _points(self, view: View) -> Floats:
        """Return points (P, 3) that a map image sees, of the map, else of its depth maps; none of another image."""
        session = session_id(view.name.split("/", 1)[0])
        found = self._map(session) if view.in_map else None
        if found is None or view.name not in found.index_of:
            return np.zeros((0, 3))
        points = found.points[np.unique(found.observations(found.index_of[view.name])[1])]
        if len(points) >= _FEW_POINTS:
            return points
        seen = self._depth_maps[session].of(self._rows[view.name])
        if not len(seen):
            return points
        return geometry.transform(self._truth[view.name], lifted(view.camera, seen.pixels, seen.depth_m))

    @cached_property
    def _depth_maps(self) -> dict[str, DepthMaps]:
        return {key: DepthMaps(session) for key, session in self._sessions.items()}

    def _load_map(self, session: str) -> LocalMap | None:
        path = None if self._map_dir is None else map_path(self._map_dir, session, self._features)
        return LocalMap.load(path) if path is not None and path.exists() else None


def _nearest_depth(points: Floats, view: View, world_from_cam: Floats, grid: Ints) -> Floats:
    """Return depth in meters, (h, w), the median of the points nearest to each pixel of a grid; NaN without points."""
    in_cam = geometry.transform(geometry.invert(world_from_cam), points)
    in_cam = in_cam[in_view(in_cam[None], view_bounds(view.camera)[None])[0]] if len(in_cam) else in_cam
    if not len(in_cam):
        return np.full(grid[::-1], np.nan)
    pixels = np.asarray(view.camera.img_from_cam(in_cam)) * grid / [view.camera.width, view.camera.height]
    kept = np.isfinite(pixels).all(axis=1)
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in grid))
    if not kept.any():
        return np.full(x.shape, np.nan)
    count = min(_NEAREST, int(kept.sum()))
    _, nearest = KDTree(pixels[kept]).query(np.stack([x, y], -1).reshape(-1, 2), k=np.arange(1, count + 1))
    return np.asarray(np.median(in_cam[kept, 2][nearest], axis=1)).reshape(x.shape)
