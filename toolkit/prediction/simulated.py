"""A simulated network for tests and for trials without weights: it looks up the ground truth.

Poses come from the ground truth of the capture, depth from triangulated map points, else from the depth maps of the
capture. Both get noise and a random similarity. Results that depend on it say nothing about a real network and are
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
from toolkit.mapping.local_map import LocalMap, map_path
from toolkit.pose.base import View
from toolkit.prediction.interface import Prediction

_GRID = 96  # longer side of a depth map, pixels
_NEAREST = 5  # points whose median depth a pixel gets, as some triangulated points are wrong
_FEW_POINTS = 20  # with fewer triangulated points, the depth maps of a map image are used
_KEPT = 256  # depth maps of map images kept in memory


class SimulatedPredictor:
    """Predicts the ground truth with noise, under a random similarity per group.

    A prediction depends only on the seed and on the names in the group, not on their order, other groups or threads.
    The depth at a pixel of the small depth map is the median over the nearest projected points: triangulated ones, or
    points from the capture's depth maps if there are few.
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
        """Take the sessions of the views, with ground truth. Without `map_dir`, or without a map of a session, from
        features of this kind, there is no depth. Noise is a standard deviation, of the depth a relative one;
        `wrong_references` is the share of map images that get a random position and orientation.
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
    def _truth(self) -> dict[str, Floats]:
        return {
            name: pose
            for session in self._sessions.values()
            for name, pose in zip(session.image_names, session.world_from_cam(ground_truth=True), strict=True)
        }

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        """Return a prediction for each group of views; raise CaptureError if the true pose of a view is unknown."""
        return [self._predict(list(group)) for group in groups]

    def _random(self, *key: Any) -> np.random.Generator:
        text = json.dumps([self._noise["seed"], *key])
        return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16]))

    def _predict(self, group: list[View]) -> Prediction:
        names = sorted(view.name for view in group)
        for view in group:
            if view.name not in self._truth or not np.isfinite(self._truth[view.name]).all():
                raise CaptureError(
                    f"The simulated predictor has no true pose of {view.name}: it works only if "
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
            depth = self._depths.get(key) if view.in_map else None
        if depth is None:
            points = self._points(view) if view.in_map else np.concatenate([self._points(v) for v in group])
            depth = _nearest_depth(points, view, self._truth[view.name], grid)
            with self._lock:
                if view.in_map:  # the depth of a query depends on its group
                    self._depths[key] = depth
                if len(self._depths) > _KEPT:
                    self._depths.popitem(last=False)
        noise = self._random(names, view.name, "depth").normal(size=depth.shape)
        return depth * (1 + self._noise["depth_noise"] * noise)

    def _points(self, view: View) -> Floats:
        """Return world points (P, 3) that a map image observes, else of its depth maps; none for a query image."""
        session = session_id(view.name.split("/", 1)[0])
        local_map = self._map(session) if view.in_map else None
        if local_map is None or view.name not in local_map.index_of:
            return np.zeros((0, 3))
        points = local_map.points[np.unique(local_map.observations(local_map.index_of[view.name])[1])]
        if len(points) >= _FEW_POINTS:
            return points
        seen = self._depth_maps[session].of(self._sessions[session].row_of_name[view.name])
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
    """Return depth (h, w) in meters, the median over the projections nearest to each pixel; NaN without points."""
    in_cam = geometry.transform(geometry.invert(world_from_cam), points)
    in_cam = in_cam[in_view(in_cam[None], view_bounds(view.camera)[None])[0]] if len(in_cam) else in_cam
    if not len(in_cam):
        return np.full(grid[::-1], np.nan)
    pixels = np.asarray(view.camera.img_from_cam(in_cam)) * grid / [view.camera.width, view.camera.height]
    finite = np.isfinite(pixels).all(axis=1)
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in grid))
    if not finite.any():
        return np.full(x.shape, np.nan)
    count = min(_NEAREST, int(finite.sum()))
    _, nearest = KDTree(pixels[finite]).query(np.stack([x, y], -1).reshape(-1, 2), k=np.arange(1, count + 1))
    return np.asarray(np.median(in_cam[finite, 2][nearest], axis=1)).reshape(x.shape)
