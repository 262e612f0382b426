"""Local features of images: RootSIFT, extracted once an image and kept for every later stage.

The cache of a session is a folder of HDF5 shards, each written whole: a killed run loses at most the shard it was
working on. A shard holds one group an image with `keypoints`, `descriptors`, `scales`, `image_size`.
"""

import json
import threading
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Session
from toolkit.errors import ImageError
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
SHARD_IMAGES = 64


@dataclass(frozen=True)
class FeatureSettings:
    """How local features are extracted; part of every fingerprint that rests on them."""

    name: str = "sift"
    min_long_side: int = 640
    """Smaller images are enlarged to this long side, pixels, before detection."""
    max_long_side: int = 1600
    """Larger images are reduced to this long side, pixels, before detection."""
    max_keypoints: int = 3072
    """The strongest responses are kept."""
    contrast_threshold: float = 0.01
    """Least contrast of a keypoint, after the image's contrast has been stretched to the full range."""


@dataclass(frozen=True)
class LocalFeatures:
    """Local features of one image, strongest response first, in the pixels of the image as stored."""

    keypoints: NDArray[np.float32]
    """(N, 2) x y, pixels; the centre of the top-left pixel is (0.5, 0.5)."""
    scales: NDArray[np.float32]
    """(N,) size of the keypoints, the standard deviation of the blob, pixels."""
    descriptors: NDArray[np.uint8]
    """(N, 128) RootSIFT, a unit vector times `DESCRIPTOR_SCALE`."""
    image_size: tuple[int, int]
    """Width, height of the image, pixels."""

    def __len__(self) -> int:
        return len(self.keypoints)


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

    def __init__(self, settings: FeatureSettings | None = None):
        self.settings = settings or FeatureSettings()
        self._local = threading.local()

    def __call__(self, gray: NDArray[np.uint8]) -> LocalFeatures:
        """Return the features of a grey image (H, W) uint8."""
        settings = self.settings
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
                np.zeros((0, 128), np.uint8),
                (width, height),
            )
        scale = np.array([width / size[0], height / size[1]])
        order = np.argsort([-keypoint.response for keypoint in keypoints], kind="stable")[: settings.max_keypoints]
        keypoints, descriptors = [keypoints[index] for index in order], descriptors[order]
        xy = np.array([keypoint.pt for keypoint in keypoints])
        # OpenCV puts the centre of the top-left pixel at 0.
        xy = (xy + 0.5) * scale
        sigma = np.array([keypoint.size for keypoint in keypoints]) / 2 * scale.mean()
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6))
        quantised = np.clip(np.round(root * DESCRIPTOR_SCALE), 0, 255).astype(np.uint8)
        return LocalFeatures(xy.astype(np.float32), sigma.astype(np.float32), quantised, (width, height))

    def _sift(self) -> Any:
        # OpenCV's detector keeps buffers between calls: one a thread.
        if not hasattr(self._local, "sift"):
            self._local.sift = cv2.SIFT.create(
                nfeatures=self.settings.max_keypoints,
                contrastThreshold=self.settings.contrast_threshold,
                enable_precise_upscale=True,
            )
        return self._local.sift


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
                group["descriptors"][()],
                (int(group["image_size"][0]), int(group["image_size"][1])),
            )


def extract_session(
    session: Session,
    out: str | Path,
    settings: FeatureSettings | None = None,
    rows: NDArray[np.int64] | None = None,
    workers: int = 2,
    skip_existing: bool = True,
    progress: bool = True,
) -> FeatureStore:
    """Extract the local features of a session's images, or reuse those that are there.

    Args:
        session: the session; only its camera images are read.
        out: folder of all features; this session's go to `<out>/<session id>/`.
        settings: how to extract.
        rows: rows of `session.images` that are needed now; all where None. The shards they fall in are extracted.
        workers: threads.
        skip_existing: reuse shards made from the same images and settings.

    Returns:
        The store of the features of (at least) the rows asked for. Unreadable images are in its `failed`.
    """
    settings = settings or FeatureSettings()
    folder = Path(out) / session.id
    store = FeatureStore(folder)
    extractor = SiftExtractor(settings)
    cameras = session.camera_rows
    wanted = cameras if rows is None else np.intersect1d(cameras, rows)
    shards = list(_shards(session, cameras))
    calibration = file_fingerprint(session.path / "sensors.txt")
    todo: list[tuple[Path, dict[str, Any], NDArray[np.int64]]] = []
    for path, members in ((folder / name, members) for name, members in shards):
        if not np.isin(members, wanted).any():
            continue
        images = files_fingerprint([session.image_path(int(row)) for row in members])
        record = {"features": asdict(settings), "images": images, "sensors": calibration}
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
    path: Path, session: Session, rows: NDArray[np.int64], extractor: SiftExtractor, workers: int, bar: Any
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
        return extractor(image)

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
                group["descriptors"] = features.descriptors
                group["image_size"] = np.array(features.image_size, np.int64)
            bar.update()
        # Attributes are limited to 64 kB in HDF5's old layout: 64 names stay below it.
        shard.attrs["names"] = json.dumps(names)
        shard.attrs["failed"] = json.dumps(failed)
