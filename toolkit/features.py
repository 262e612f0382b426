"""Local features of images, of several kinds: extracted once an image and kept for every later stage.

The cache of a session is a folder of HDF5 shards, each written whole: a killed run loses at most the shard it was
working on. A shard holds one group an image with `keypoints`, `descriptors`, `scales`, `image_size`.
"""

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Session
from toolkit.errors import ImageError, ManifestError
from toolkit.files import (
    file_fingerprint,
    files_fingerprint,
    fingerprint,
    is_current,
    sidecar_path,
    write_atomic,
    write_sidecar,
)
from toolkit.images import prefetch, read_image

# RootSIFT vectors have length 1; times 512 they fill the range of a byte, as COLMAP stores them.
DESCRIPTOR_SCALE = 512.0
Descriptors = NDArray[np.uint8] | NDArray[np.float16] | NDArray[np.float32]
SHARD_IMAGES = 64


@dataclass(frozen=True)
class LocalFeatures:
    """Local features of one image, strongest response first, in the pixels of the image as stored."""

    keypoints: NDArray[np.float32]
    """(N, 2) x y, pixels; the centre of the top-left pixel is (0.5, 0.5)."""
    scales: NDArray[np.float32]
    """(N,) size of the keypoints, the standard deviation of the blob, pixels; 1 for detectors that tell none."""
    scores: NDArray[np.float32]
    """(N,) response of the detector, larger is better; comparable within one kind alone."""
    descriptors: Descriptors
    """(N, D): unit vectors, or uint8: non-negative unit vectors times `DESCRIPTOR_SCALE` (RootSIFT)."""
    image_size: tuple[int, int]
    """Width, height of the image, pixels."""

    def __len__(self) -> int:
        return len(self.keypoints)

    def take(self, part: slice | NDArray[np.int64]) -> "LocalFeatures":
        """Return some of the features, by index."""
        return LocalFeatures(
            self.keypoints[part], self.scales[part], self.scores[part], self.descriptors[part], self.image_size
        )


class Extractor(Protocol):
    """What finds local features of one kind."""

    colour: bool
    """Whether images are (H, W, 3) RGB, else (H, W) grey."""
    batch_size: int
    """How many images a call is best given."""
    threaded: bool
    """Whether `extract` is called best with one image at a time, from several threads at once."""

    @property
    def settings(self) -> dict[str, Any]:
        """All that the features depend on besides the images, `name` first; part of their fingerprint."""
        ...

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        """Return the features of images, uint8, of any sizes."""
        ...


@dataclass(frozen=True)
class FeatureKind:
    """What is peculiar to one kind of local features. Scores are cosine similarities of descriptors."""

    extractor: str
    """`module:callable` that makes the extractor, imported when it is asked for."""
    matcher: str
    """The matcher of queries with references where none is asked for; see `toolkit.matching`."""
    ratio: float
    """Lowe's ratio of `mutual` between a query and a reference; 1: no such test."""
    min_score: float
    """Least score of a match of `mutual` between a query and a reference."""
    epipolar_min_score: float
    """Least score of a match between map images, sought along the epipolar line."""
    guided_min_score: float
    """Least score of a match near where a pose puts a map point."""
    scale_octaves: float
    """How far the size of a keypoint may be from what the map tells, as a factor of two to this power."""


KINDS: dict[str, FeatureKind] = {
    # RootSIFT has no negative entries: unrelated patches already score about 0.5, so the ratio test decides, and the
    # less geometry says, the more a score has to.
    "sift": FeatureKind(
        "toolkit.features:SiftExtractor.create", "mutual", 0.85, -1.0, epipolar_min_score=0.6, guided_min_score=0.75,
        scale_octaves=1.0,
    ),
    # Scores of unrelated patches scatter about 0, and look-alikes are common: the usual test is a distance below 0.7
    # (hloc's NN-superpoint), which is a cosine of 1 - 0.7^2 / 2, and none of the ratio. One scale: sizes say nothing.
    "superpoint": FeatureKind(
        "toolkit.models.superpoint:SuperPointExtractor", "lightglue", 1.0, 0.755, epipolar_min_score=0.755,
        guided_min_score=0.755, scale_octaves=float("inf"),
    ),
}  # fmt: skip
"""The kinds of local features that a manifest can name."""


def feature_kind(name: str) -> FeatureKind:
    """Return what is known of a kind of features.

    Raises:
        ManifestError: it is not known.
    """
    if name not in KINDS:
        raise ManifestError(f"Unknown local features {name!r}. Known: {', '.join(KINDS)}.")
    return KINDS[name]


def create_extractor(
    name: str, *, checkpoint: str | Path | None = None, device: str = "auto", dtype: str = "auto", **settings: Any
) -> Extractor:
    """Return a ready extractor.

    Args:
        name: a key of `KINDS`.
        checkpoint: file with a network's weights; None: the hub's cache, else a download. `sift` needs none.
        device: where a network runs: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
        dtype: what a network computes in: `auto`, `float32`, `bfloat16`, `float16`.
        settings: the extractor's own: the fields of `SiftSettings` of `sift`.

    Raises:
        ManifestError: unknown features or settings.
        WeightsError: the network has no weights.
    """
    module, _, path = feature_kind(name).extractor.partition(":")
    make: Any = import_module(module)
    for attribute in path.split("."):
        make = getattr(make, attribute)
    factory: Callable[..., Extractor] = make
    if name == "sift":
        return factory(**settings)
    return factory(checkpoint=checkpoint, device=device, dtype=dtype, **settings)


@dataclass(frozen=True)
class SiftSettings:
    """How SIFT features are extracted; part of every fingerprint that rests on them."""

    min_long_side: int = 640
    """Smaller images are enlarged to this long side, pixels, before detection."""
    max_long_side: int = 1600
    """Larger images are reduced to this long side, pixels, before detection."""
    max_keypoints: int = 3072
    """The strongest responses are kept."""
    contrast_threshold: float = 0.01
    """Least contrast of a keypoint, after the image's contrast has been stretched to the full range."""


def stretch_contrast(gray: NDArray[np.uint8], max_gain: float = 8.0) -> NDArray[np.uint8]:
    """Return the image with its 1st to 99th percentile spread over the whole range, by a gain of at most `max_gain`.

    A SIFT descriptor does not change with gain, but a dark image has no keypoint above a fixed contrast.
    """
    low, high = np.percentile(gray[::4, ::4], (1.0, 99.0))
    gain = min(255.0 / max(high - low, 1.0), max_gain)
    table = np.clip((np.arange(256) - low) * gain, 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(gray, table), np.uint8)


class SiftExtractor:
    """Extracts RootSIFT features; one instance may be used by several threads."""

    colour = False
    batch_size = 1
    threaded = True

    def __init__(self, settings: SiftSettings | None = None):
        self._settings = settings or SiftSettings()
        self._local = threading.local()

    @classmethod
    def create(cls, **settings: Any) -> "SiftExtractor":
        """Return an extractor with some of the fields of `SiftSettings` changed."""
        if unknown := sorted(settings.keys() - SiftSettings.__dataclass_fields__.keys()):
            known = ", ".join(SiftSettings.__dataclass_fields__)
            raise ManifestError(f"Local features sift have no setting {unknown[0]!r}. Known: {known}.")
        return cls(SiftSettings(**settings))

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": "sift", **asdict(self._settings)}

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        """Return the features of images, (H, W) grey or (H, W, 3) RGB, uint8."""
        return [self._extract(image if image.ndim == 2 else _gray(image)) for image in images]

    def _extract(self, gray: NDArray[np.uint8]) -> LocalFeatures:
        settings = self._settings
        height, width = gray.shape
        long_side = max(height, width)
        target = float(np.clip(long_side, settings.min_long_side, settings.max_long_side))
        size = (max(1, round(width * target / long_side)), max(1, round(height * target / long_side)))
        image = stretch_contrast(gray)
        if size != (width, height):
            interpolation = cv2.INTER_AREA if size[0] < width else cv2.INTER_CUBIC
            image = np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)
        keypoints, descriptors = self._sift().detectAndCompute(image, None)
        if descriptors is None or not len(keypoints):
            return LocalFeatures(
                np.zeros((0, 2), np.float32),
                np.zeros(0, np.float32),
                np.zeros(0, np.float32),
                np.zeros((0, 128), np.uint8),
                (width, height),
            )
        scale = np.array([width / size[0], height / size[1]])
        responses = np.array([keypoint.response for keypoint in keypoints], np.float32)
        order = np.argsort(-responses, kind="stable")[: settings.max_keypoints]
        keypoints, descriptors = [keypoints[index] for index in order], descriptors[order]
        xy = np.array([keypoint.pt for keypoint in keypoints])
        # OpenCV puts the centre of the top-left pixel at 0.
        xy = (xy + 0.5) * scale
        sigma = np.array([keypoint.size for keypoint in keypoints]) / 2 * scale.mean()
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6))
        quantised = np.clip(np.round(root * DESCRIPTOR_SCALE), 0, 255).astype(np.uint8)
        return LocalFeatures(
            xy.astype(np.float32), sigma.astype(np.float32), responses[order], quantised, (width, height)
        )

    def _sift(self) -> Any:
        # OpenCV's detector keeps buffers between calls: one a thread.
        if not hasattr(self._local, "sift"):
            self._local.sift = cv2.SIFT.create(
                nfeatures=self._settings.max_keypoints,
                contrastThreshold=self._settings.contrast_threshold,
                enable_precise_upscale=True,
            )
        return self._local.sift


def _gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


class FeatureStore:
    """Read access to the extracted features of one session, keyed by image name (`Session.image_name`)."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self.failed: dict[str, str] = {}
        """Images that could not be read, with the reason."""
        self._shard_of: dict[str, Path] = {}
        self._open: dict[Path, h5py.File] = {}
        self._lock = threading.Lock()

    @classmethod
    def open(cls, folder: str | Path) -> "FeatureStore":
        """Open all features of a session that are on disk, whatever they were made from."""
        store = cls(Path(folder))
        for path in sorted(Path(folder).rglob("[!.]*.h5")):
            store.add_shard(path)
        return store

    def add_shard(self, path: Path) -> bool:
        """Take up the images of a shard; False if the file is torn."""
        try:
            with h5py.File(path, "r") as shard:
                names, failed = json.loads(shard.attrs["names"]), json.loads(shard.attrs["failed"])
        except (OSError, KeyError):
            return False
        self._shard_of.update(dict.fromkeys(names, path))
        self.failed.update(failed)
        return True

    @property
    def fingerprint(self) -> str:
        """16 hex digits that identify the images and settings that the features were made from."""
        shards = sorted({*self._shard_of.values()})
        return fingerprint([[path.name, file_fingerprint(sidecar_path(path))] for path in shards])

    @property
    def names(self) -> list[str]:
        return list(self._shard_of)

    def __contains__(self, name: str) -> bool:
        return name in self._shard_of

    def __getitem__(self, name: str) -> LocalFeatures:
        path = self._shard_of[name]
        with self._lock:  # HDF5 is not safe to use from several threads
            if path not in self._open:
                self._open[path] = h5py.File(path, "r")
            group = self._open[path][name]
            return LocalFeatures(
                group["keypoints"][()],
                group["scales"][()],
                group["scores"][()],
                group["descriptors"][()],
                (int(group["image_size"][0]), int(group["image_size"][1])),
            )


def extract_session(
    session: Session,
    out: str | Path,
    extractor: Extractor | None = None,
    rows: NDArray[np.int64] | None = None,
    workers: int = 2,
    skip_existing: bool = True,
    progress: bool = True,
) -> FeatureStore:
    """Extract the local features of a session's images, or reuse those that are there.

    Args:
        session: the session; only its camera images are read.
        out: folder of all features; this session's go to `<out>/<session id>/`.
        extractor: how to extract; None: SIFT.
        rows: rows of `session.images` that are needed now; all where None. The shards they fall in are extracted.
        workers: threads.
        skip_existing: reuse shards made from the same images and settings.

    Returns:
        The store of the features of (at least) the rows asked for. Unreadable images are in its `failed`.
    """
    extractor = extractor or SiftExtractor()
    folder = Path(out) / session.id
    store = FeatureStore(folder)
    cameras = session.camera_rows
    wanted = cameras if rows is None else np.intersect1d(cameras, rows)
    shards = list(_shards(session, cameras))
    calibration = file_fingerprint(session.path / "sensors.txt")
    todo: list[tuple[Path, dict[str, Any], NDArray[np.int64]]] = []
    for path, members in ((folder / name, members) for name, members in shards):
        if not np.isin(members, wanted).any():
            continue
        images = files_fingerprint([session.image_path(int(row)) for row in members])
        record = {"features": extractor.settings, "images": images, "sensors": calibration}
        if not (skip_existing and is_current(path, record) and store.add_shard(path)):
            todo.append((path, record, members))
    total = sum(len(members) for _, _, members in todo)
    cv2_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the images are the parallel dimension
    try:
        with tqdm(total=total, desc=f"features {session.id}", unit="image", disable=not progress or not total) as bar:
            for path, record, members in todo:
                _write_shard(path, session, members, extractor, workers, bar)
                write_sidecar(path, record)
                store.add_shard(path)
    finally:
        cv2.setNumThreads(cv2_threads)
    return store


def _shards(session: Session, rows: NDArray[np.int64]) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Cut the rows into shards that do not cross subsessions; yields file names and rows."""
    subsessions = session.subsession_of(rows)
    for subsession in dict.fromkeys(subsessions):
        members = rows[subsessions == subsession]
        for start in range(0, len(members), SHARD_IMAGES):
            yield f"{subsession}/{start // SHARD_IMAGES:05d}.h5", members[start : start + SHARD_IMAGES]


def _write_shard(
    path: Path, session: Session, rows: NDArray[np.int64], extractor: Extractor, workers: int, bar: Any
) -> None:
    def extract(row: int) -> LocalFeatures | str:
        try:
            image = read_image(session.image_path(row), gray=True)
        except ImageError as error:
            return str(error)
        camera = session.camera(sensors[row])
        if image.shape != (camera.height, camera.width):
            return (
                f"Image of {image.shape[1]} x {image.shape[0]} pixels, but sensors.txt says {camera.width} x "
                f"{camera.height} for {sensors[row]}: {session.image_path(row)}"
            )
        return extractor.extract([image])[0]

    sensors = session.images["sensor_id"].to_numpy()
    names: list[str] = []
    failed: dict[str, str] = {}
    with write_atomic(path) as temporary, h5py.File(temporary, "w") as shard:
        for row, features in zip(rows, prefetch(extract, rows.tolist(), workers), strict=True):
            name = session.image_name(int(row))
            if isinstance(features, str):
                failed[name] = features
            elif name not in shard:  # a line of images.txt may be there twice
                names.append(name)
                group = shard.create_group(name)
                group["keypoints"] = features.keypoints
                group["scales"] = features.scales
                group["scores"] = features.scores
                group["descriptors"] = features.descriptors
                group["image_size"] = np.array(features.image_size, np.int64)
            bar.update()
        # Attributes are limited to 64 kB in HDF5's old layout: 64 names stay below it.
        shard.attrs["names"] = json.dumps(names)
        shard.attrs["failed"] = json.dumps(failed)
