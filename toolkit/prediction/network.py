"""A network as a predictor: batching of views, choice of device, and cache of encodings. Opens predictors by name, also
a simulated one for tests and for trials without weights, which looks up the ground truth.

The simulated poses come from the ground truth of the capture, depth from triangulated map points, else from the depth
maps of the capture. Both get noise and a random similarity. Results that depend on it say nothing about a real network
and are labeled `simulated` everywhere.
"""

import hashlib
import json
import logging
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.capture import Capture, Session
from toolkit.capture.images import (
    default_workers,
    in_view,
    prefetch,
    read_image,
    turn_image,
    turned_from_cam,
    view_bounds,
)
from toolkit.capture.names import session_id
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.files import files_fingerprint
from toolkit.geometry import Floats, Ints, invert, make_pose
from toolkit.manifest import LocalizeSettings
from toolkit.mapping.local_map import LocalMap, map_path
from toolkit.models.compute import PRECISIONS, Fitting, on_device, resolve_device, resolve_precision
from toolkit.models.weights import resolve_weights
from toolkit.pose.base import View
from toolkit.prediction.depths import DepthMaps, lifted
from toolkit.prediction.interface import (
    ARCHITECTURES,
    HEADS,
    Architecture,
    PlacedView,
    Prediction,
    Predictor,
    Size,
    shown_size,
)

if TYPE_CHECKING:
    import torch
    from torch import Tensor

log = logging.getLogger(__name__)
_GRID = 96  # longer side of a depth map, pixels
_NEAREST = 5  # points whose median depth a pixel gets, as some triangulated points are wrong
_FEW_POINTS = 20  # with fewer triangulated points, the depth maps of a map image are used
_KEPT = 256  # depth maps of map images kept in memory
CACHE_BYTES = 2 << 30
"""Size of the cache for encodings of map images: 500 of them at 518 x 392 in float32, twice as many in bfloat16."""
_GROUPS_AT_A_TIME = 8  # on a CPU 1: one group keeps it busy, and a batch needs more memory and is not faster
_IMAGES_AT_A_TIME = 8  # decoded ahead and encoded together; more need more memory
_loaded: dict[tuple[Any, ...], Any] = {}
"""The network that was loaded last, by its key; at most one."""


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
        self.settings: dict[str, Any] = {
            "rotation_noise_deg": rotation_noise_deg,
            "position_noise_m": position_noise_m,
            "depth_noise": depth_noise,
            "wrong_references": wrong_references,
            "seed": seed,
        }
        self._map = cache(self._load_map)
        self._depths: OrderedDict[str, Floats] = OrderedDict()

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
        text = json.dumps([self.settings["seed"], *key])
        return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16]))

    def _predict(self, group: list[View]) -> Prediction:
        names = sorted(view.name for view in group)
        for view in group:
            if view.name not in self._truth or not np.isfinite(self._truth[view.name]).all():
                do = "Put one into proc/alignment_trajectories.txt, or use another predictor or method."
                raise CaptureError(f"The simulated predictor has no true pose of {view.name}. {do}")
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
        turn = Rotation.from_rotvec(rng.normal(size=3) * np.radians(self.settings["rotation_noise_deg"]) / np.sqrt(3))
        moved = rng.normal(size=3) * self.settings["position_noise_m"] / np.sqrt(3)
        if view.in_map and rng.random() < self.settings["wrong_references"]:
            turn = Rotation.random(random_state=rng)
            moved = rng.normal(size=3) * max(2.0, float(np.ptp(group[:, :3, 3], axis=0).max()))
        return geometry.make_pose(world_from_cam[:3, :3] @ turn.as_matrix(), world_from_cam[:3, 3] + moved)

    def _depth(self, view: View, group: list[View], names: list[str], grid: Ints) -> Floats:
        key = f"{view.name} {grid}"
        depth = self._depths.get(key) if view.in_map else None
        if depth is None:
            points = self._points(view) if view.in_map else np.concatenate([self._points(v) for v in group])
            depth = _nearest_depth(points, view, self._truth[view.name], grid)
            if view.in_map:  # the depth of a query depends on its group
                self._depths[key] = depth
                if len(self._depths) > _KEPT:
                    self._depths.popitem(last=False)
        noise = self._random(names, view.name, "depth").normal(size=depth.shape)
        return depth * (1 + self.settings["depth_noise"] * noise)

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


# Networks


def open_predictor(settings: LocalizeSettings, capture: Capture, map_dir: Path) -> Predictor:
    """Return the predictor of the settings. Warn about the simulated one, which uses the ground truth.

    Raise ManifestError if the device or the precision does not exist; WeightsError if the weights are missing.
    """
    predictor = settings.predictor
    if predictor.name != "simulated":
        return NetworkPredictor(
            predictor.checkpoint,
            settings.compute_device,
            settings.dtype_compute,
            architecture=ARCHITECTURES[predictor.name],
        )
    _warn_of_simulation()
    sessions = [*capture.usable("map"), *capture.usable("query")]
    return SimulatedPredictor(sessions, map_dir, settings.features.kinds[0], seed=settings.seed)


@cache
def _warn_of_simulation() -> None:
    log.warning("predictor: simulated looks up the true poses of the queries. Its poses are no results.")


class TokenCache:
    """Least recently used cache of encodings of map images. Not thread-safe."""

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes, self.bytes = max_bytes, 0
        self._kept: OrderedDict[Any, Tensor] = OrderedDict()

    def __contains__(self, key: Any) -> bool:
        return key in self._kept

    def get(self, key: Any) -> "Tensor | None":
        if key in self._kept:
            self._kept.move_to_end(key)
        return self._kept.get(key)

    def put(self, key: Any, tokens: "Tensor") -> None:
        """Add an encoding and drop old ones to make room; an encoding larger than the cache is not kept."""
        if key in self._kept or tokens.nbytes > self.max_bytes:
            return
        self._kept[key] = tokens
        self.bytes += tokens.nbytes
        while self.bytes > self.max_bytes:
            self.bytes -= self._kept.popitem(last=False)[1].nbytes


class NetworkPredictor:
    """Runs a network. The constructor finds the weights, the first prediction loads them.

    Encodings of map images are cached; for VGGT, encoding is a fifth of the work.
    """

    simulated = False

    def __init__(
        self,
        checkpoint: str | Path | None = None,
        compute_device: str = "auto",
        dtype_compute: str = "auto",
        *,
        batch_size: int | None = None,
        cache_bytes: int = CACHE_BYTES,
        architecture: Architecture = ARCHITECTURES["vggt"],
    ) -> None:
        """Find the weights: the file `checkpoint`, else the hub's, which is downloaded if need be.

        Raise ManifestError if the precision does not exist or is float16; WeightsError if the weights are missing.

        Args:
            compute_device, dtype_compute: see `models.compute`. float16 is refused, as activations of the trunk may
                overflow it; `auto` takes float32 where it would choose float16. The heads always run in float32.
            batch_size: largest number of groups per batch; None takes a default for the device.
            cache_bytes: memory of the CPU for encodings of map images.
        """
        expected = [name for name in PRECISIONS if name != "float16"]
        if dtype_compute not in expected:
            title = architecture.title
            raise ManifestError(f"dtype_compute is {dtype_compute!r}; {title} expects one of {', '.join(expected)}.")
        self._architecture, self.name = architecture, architecture.name
        self.checkpoint = resolve_weights(architecture.weights, checkpoint)
        self.compute_device, self.dtype_compute = compute_device, dtype_compute
        self._batch_size = batch_size
        self._cache = TokenCache(cache_bytes)
        self._fitting: dict[tuple[int, Size], Fitting] = {}

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Everything besides the views that the predictions depend on. The device only changes rounding."""
        weights = files_fingerprint([self.checkpoint])
        precision = str(self._dtype).removeprefix("torch.")
        return {"name": self.name, "weights": weights, "dtype_compute": precision, "depth": True}

    @cached_property
    def _device(self) -> "torch.device":
        return resolve_device(self.compute_device)

    @cached_property
    def _dtype(self) -> "torch.dtype":
        import torch

        dtype = resolve_precision(self.dtype_compute, self._device)
        return torch.float32 if dtype == torch.float16 else dtype

    @cached_property
    def _model(self) -> Any:
        return _load_network(self._architecture, self.checkpoint, self._dtype, self._device)

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        """Return a prediction for each group of views. The first view of a group is the query.

        A prediction has as many views as its group. Views that the network did not get, because the file is missing,
        cannot be decoded, or does not have the size of its camera, have NaN in `model_from_cams` and `depth`, and 0 in
        `depth_conf`; the log says why. If this is the query, the whole prediction is NaN, without depth, and gives the
        reason. Groups do not influence each other: those with equal numbers of views and equal image size run in one
        batch, which is halved if it does not fit the memory. Raise WeightsError at the first call if the file does not
        belong to this network; ToolkitError if the device does not exist, or its memory does not hold a group.
        """
        placed = [self._place(group) if group else [] for group in groups]
        results = [_nothing(len(group)) for group in groups]
        alike: dict[tuple[int, Size], list[int]] = {}
        for number, group in enumerate(placed):
            if group:
                alike.setdefault((len(group), group[0].size), []).append(number)
        batch_size = self._batch_size or (1 if self._device.type == "cpu" else _GROUPS_AT_A_TIME)
        for numbers in alike.values():
            batches = [numbers[start : start + batch_size] for start in range(0, len(numbers), batch_size)]
            encoded = self._encoded([[placed[number] for number in batch] for batch in batches])
            for batch, tokens in zip(batches, encoded, strict=True):
                self._run(batch, [placed[number] for number in batch], tokens, results)
        return results

    def _place(self, group: Sequence[View]) -> list[PlacedView]:
        """Return the views of a group with their places in network images of one size."""
        layout = self._architecture.lay_out([shown_size(view) for view in group])
        return [PlacedView(view, layout, number) for number, view in enumerate(group)]

    def _encoded(self, batches: Sequence[Sequence[Sequence[PlacedView]]]) -> "Iterator[dict[Any, Tensor | str]]":
        """Yield, per batch, the tokens (P, C) of its views by key, or the reason why a view cannot be read.

        Other threads decode the next images in the meantime, except those whose encoding is cached.
        """
        views = {placed.key: placed for batch in batches for group in batch for placed in group}
        unread = {key: placed for key, placed in views.items() if key not in self._cache}
        decoded = prefetch(self._read, list(unread.values()), workers=default_workers(), ahead=_IMAGES_AT_A_TIME)
        for batch in batches:
            tokens: dict[Any, Tensor | str] = {}
            waiting: dict[Any, tuple[PlacedView, Tensor]] = {}
            for key, placed in {placed.key: placed for group in batch for placed in group}.items():
                cached = self._cache.get(key)
                if cached is not None:
                    tokens[key] = cached
                    continue
                # The encoding of an image that was read before has been dropped from the cache since.
                image = next(decoded) if unread.pop(key, None) else self._read(placed)
                if isinstance(image, ImageError):
                    log.warning("%s: left out. %s", placed.view.name, image)
                    tokens[key] = str(image)
                else:
                    waiting[key] = (placed, image)
            tokens.update(self._encode(list(waiting.values())))
            yield tokens

    def _read(self, placed: PlacedView) -> "Tensor | ImageError":
        """Return the network image (3, H, W) of a view, or the error if it cannot be read."""
        try:
            image, turns = placed.view.image, placed.view.turns
            if turns:
                image = turn_image(read_image(image) if isinstance(image, Path) else image, turns)
            pixels, actual = self._architecture.read(image, placed.layout)
        except ImageError as error:
            return error
        expected = shown_size(placed.view)
        if actual != expected:
            turned = " when upright" if turns else ""
            return ImageError(
                f"Image of {actual[0]} x {actual[1]} pixels{turned}: {placed.view.name}; its camera has "
                f"{expected[0]} x {expected[1]}. Correct the size in `sensors.txt`, or the image."
            )
        return pixels

    def _encode(self, images: "Sequence[tuple[PlacedView, Tensor]]") -> "dict[Any, Tensor]":
        """Return tokens (P, C) of images (3, H, W) of one size, by key; cache those of map images."""
        import torch

        # Measured: tokens in float16 change depth by 1.2e-4 of its value; a trunk in bfloat16 changes it by 4e-3.
        dtype = torch.float32 if self._dtype == torch.float32 else torch.float16
        fitting = Fitting(self._model.encode, "images", self._device)
        tokens = {}
        for start in range(0, len(images), _IMAGES_AT_A_TIME):
            part = images[start : start + _IMAGES_AT_A_TIME]
            batch = torch.stack([image for _, image in part])
            for (placed, _), of_image in zip(part, fitting(batch).to("cpu", dtype), strict=True):
                tokens[placed.key] = of_image.clone()  # a view would keep the whole batch in memory
                if placed.view.in_map:
                    self._cache.put(placed.key, tokens[placed.key])
        return tokens

    def _run(
        self,
        numbers: Sequence[int],
        groups: Sequence[list[PlacedView]],
        tokens: "dict[Any, Tensor | str]",
        results: list[Prediction],
    ) -> None:
        """Predict a batch of groups, with the tokens of their views; `results` gets them at the groups' numbers."""
        import torch

        alike: dict[int, list[tuple[int, list[PlacedView], list[int], Tensor]]] = {}
        for number, group in zip(numbers, groups, strict=True):
            of_query = tokens[group[0].key]
            if isinstance(of_query, str):
                results[number] = _nothing(len(group), of_query)
                continue
            encoded = {index: tokens[placed.key] for index, placed in enumerate(group)}
            readable = {index: one for index, one in encoded.items() if not isinstance(one, str)}
            stacked = torch.stack(list(readable.values()))
            alike.setdefault(len(readable), []).append((number, group, list(readable), stacked))
        for rows in alike.values():
            output = self._forward(torch.stack([stacked for *_, stacked in rows]), rows[0][1][0].size).numpy()
            for (number, group, shown, _), values in zip(rows, output, strict=True):
                results[number] = self._prediction(group, shown, values)

    def _forward(self, tokens: "Tensor", size: Size) -> "Tensor":
        """Return outputs (B, S, 9 + 2 H W) on the CPU for tokens (B, S, P, C) of images (H, W)."""
        import torch

        what = (
            f"groups of {tokens.shape[1]} views of {size[1]} x {size[0]} pixels (`localize.predictor.num_references`)"
        )
        run = self._fitting.setdefault((tokens.shape[1], size), Fitting(partial(self._heads, size), what, self._device))
        with torch.inference_mode():
            return run(tokens)

    def _heads(self, size: Size, tokens: "Tensor") -> "Tensor":
        import torch

        images = torch.empty(*tokens.shape[:2], 3, *size, device="meta")
        output = self._model(images, HEADS, tokens.float())
        dense = [output[name].flatten(2) for name in ("depth", "depth_conf")]
        return torch.cat([output["pose_enc"], *dense], dim=-1).cpu()

    def _prediction(self, group: list[PlacedView], shown: Sequence[int], output: NDArray[np.float32]) -> Prediction:
        """Convert the network output (shown views, 9 + 2 H W) to the prediction of a group."""
        poses, intrinsics = np.full((len(group), 4, 4), np.nan), np.full((len(group), 3, 3), np.nan)
        size = group[0].size
        for index, encoding in zip(shown, output[:, :9].astype(np.float64), strict=True):
            if np.isfinite(encoding).all() and encoding[3:7].any():
                cam_from_model, K = self._architecture.cameras(encoding, size)
                model_from_turned = invert(make_pose(cam_from_model[:, :3], cam_from_model[:, 3]))
                poses[index] = model_from_turned @ turned_from_cam(group[index].view.turns)
                intrinsics[index] = group[index].intrinsics(K)
        map_from_image = np.stack([placed.map_from_image for placed in group])
        depth = [placed.turned_back(np.full(size, np.nan, np.float32)) for placed in group]
        confidence = [placed.turned_back(np.zeros(size, np.float32)) for placed in group]
        maps = output[:, 9:].reshape(len(shown), 2, *size)
        for index, (depth_map, confidence_map) in zip(shown, maps, strict=True):
            placed, outside = group[index], group[index].outside
            depth[index] = placed.turned_back(np.where(outside, np.float32(np.nan), depth_map))
            confidence[index] = placed.turned_back(np.where(outside, np.float32(np.nan), confidence_map))
        return Prediction(poses, depth, confidence, map_from_image, intrinsics)


def _load_network(
    architecture: Architecture,
    checkpoint: Path,
    dtype: "torch.dtype",
    device: "torch.device",
) -> Any:
    """Return a network, ready to run. The last one stays loaded: a notebook that inspects a query after a run creates a
    new predictor, and loading gigabytes of weights again would be slow.
    """
    key = (checkpoint.resolve(), files_fingerprint([checkpoint]), architecture.name, dtype, device)
    if key not in _loaded:
        _loaded.clear()  # before loading, as the memory may hold only one network
        _loaded[key] = on_device(architecture.load(checkpoint, dtype), device, architecture.title)
    return _loaded[key]


def _nothing(views: int, reason: str = "") -> Prediction:
    return Prediction(np.full((views, 4, 4), np.nan), reason=reason)
