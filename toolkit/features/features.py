"""Local features of images, of several kinds: extracted once an image and kept for every later stage.

Those of a session are kept in one HDF5 file for each kind and settings, in the layout of hloc
(https://github.com/cvg/Hierarchical-Localization): a group an image, under the image's name, with `keypoints` (N, 2),
`descriptors` (D, N) of unit length, `scores` (N,) and `image_size` (2,), and the `scales` (N,) of keypoints. There the
center of the top-left pixel is at 0, as the attribute of the file says; here, and in `LocalFeatures`, at 0.5.
"""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Session
from toolkit.capture.images import prefetch, read_image
from toolkit.errors import ArtifactError, ImageError, ManifestError
from toolkit.features.groups import GroupWriter
from toolkit.files import files_fingerprint, fingerprint, read_sidecar
from toolkit.manifest import FeaturesSettings, SiftSettings

# RootSIFT vectors have length 1; times 512 they fill the range of a byte, as COLMAP stores them.
DESCRIPTOR_SCALE = 512.0
Descriptors = NDArray[np.uint8] | NDArray[np.float16] | NDArray[np.float32]
PIXEL_CENTER = "top_left_pixel_center"
"""Attribute of a file: where the center of the top-left pixel is."""
SCALE = "scale"
"""Attribute of the descriptors of a file: they were bytes, over this."""
# Files have bytes as float16, exactly: a byte over a power of two has 8 significant bits, float16 holds 11. A look-up
# is several times quicker than a product and a conversion.
_HALVES = (np.arange(256) / DESCRIPTOR_SCALE).astype(np.float16)
_BYTES = np.zeros(1 << 16, np.uint8)
_BYTES[_HALVES.view(np.uint16)] = np.arange(256)


@dataclass(frozen=True)
class LocalFeatures:
    """Local features of one image, strongest response first, in the pixels of the image as stored."""

    keypoints: NDArray[np.float32]
    """(N, 2) x y, pixels; the center of the top-left pixel is (0.5, 0.5)."""
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

    color: bool
    """Whether images are (H, W, 3) RGB, else (H, W) gray."""
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
    matchers: tuple[str, ...]
    """What can match queries with references, the first where none is asked for; see `toolkit.features.matching`."""
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
        "toolkit.features.features:SiftExtractor", ("mutual",), 0.85, -1.0, epipolar_min_score=0.6,
        guided_min_score=0.75, scale_octaves=1.0,
    ),
    # Scores of unrelated patches scatter about 0, and look-alikes are common: the usual test is a distance below 0.7
    # (hloc's NN-superpoint), which is a cosine of 1 - 0.7^2 / 2, and none of the ratio. One scale: sizes say nothing.
    "superpoint": FeatureKind(
        "toolkit.features.superpoint:SuperPointExtractor", ("lightglue", "mutual"), 1.0, 0.755,
        epipolar_min_score=0.755, guided_min_score=0.755, scale_octaves=float("inf"),
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


def create_extractor(name: str, settings: FeaturesSettings, device: str = "auto", dtype: str = "auto") -> Extractor:
    """Return a ready extractor.

    Args:
        name: a key of `KINDS`.
        settings: holds those of each kind under its name.
        device: where a network runs: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
        dtype: what a network computes in: `auto`, `float32`, `bfloat16`, `float16`.

    Raises:
        ManifestError: unknown features.
        WeightsError: the network has no weights.
    """
    module, _, attribute = feature_kind(name).extractor.partition(":")
    factory: Callable[..., Extractor] = getattr(import_module(module), attribute)
    own = getattr(settings, name)
    if name == "sift":
        return factory(own)
    return factory(checkpoint=settings.checkpoint, device=device, dtype=dtype, settings=own)


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

    color = False
    batch_size = 1
    threaded = True

    def __init__(self, settings: SiftSettings | None = None):
        self._settings = settings or SiftSettings()
        self._local = threading.local()

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": "sift", **self._settings.model_dump()}

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        """Return the features of images, (H, W) gray or (H, W, 3) RGB, uint8."""
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
        # OpenCV puts the center of the top-left pixel at 0.
        xy = (xy + 0.5) * scale
        sigma = np.array([keypoint.size for keypoint in keypoints]) / 2 * scale.mean()
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6))
        quantized = np.clip(np.round(root * DESCRIPTOR_SCALE), 0, 255).astype(np.uint8)
        return LocalFeatures(
            xy.astype(np.float32), sigma.astype(np.float32), responses[order], quantized, (width, height)
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


def features_path(out: str | Path, session_id: str, settings: Mapping[str, Any]) -> Path:
    """Return the file of a session's features in the folder of all features, by the extractor's settings."""
    return Path(out) / session_id / f"{settings['name']}-{fingerprint(settings)}.h5"


class FeatureStore(Mapping[str, LocalFeatures]):
    """Read access to the local features of many images, by image name (`Session.image_name`).

    Safe to use from several threads. The features of an image are read when they are asked for.
    """

    def __init__(
        self,
        path: Path,
        made_from: Mapping[str, str],
        failed: Mapping[str, str] | None = None,
        settings: Mapping[str, Any] | None = None,
    ):
        self.path = path
        self.made_from = dict(made_from)
        """Name of an image -> fingerprint of what its features were made from."""
        self.failed = dict(failed or {})
        """Images that could not be read, with the reason."""
        self.settings = dict(settings or {})
        """Of the extractor; empty where they are not known."""
        self._file: h5py.File | None = None
        self._bytes = False
        self._offset = np.float32(0)
        self._lock = threading.Lock()

    @classmethod
    def open(cls, path: str | Path) -> "FeatureStore":
        """Open a file of features, the toolkit's or hloc's, whatever it was made from.

        Raises:
            ArtifactError: it is missing, torn, or holds no features.
        """
        record = read_sidecar(path)
        if record is not None and "groups" in record:
            failed = {name: reason for name, (_, reason) in record["failed"].items()}
            return cls(Path(path), record["groups"], failed, record["made_by"])
        names: list[str] = []

        def visit(name: str, item: h5py.HLObject) -> None:
            if isinstance(item, h5py.Dataset) and name.endswith("/keypoints"):
                names.append(name.removesuffix("/keypoints"))

        try:
            with h5py.File(path, "r") as file:
                file.visititems(visit)
        except OSError as error:
            raise ArtifactError(f"Local features {path} cannot be read ({error}). Extract them again.") from None
        if not names:
            raise ArtifactError(
                f"{path} holds no local features; expected a group an image with `keypoints` and `descriptors`."
            )
        return cls(Path(path), dict.fromkeys(names, files_fingerprint([Path(path)])))

    @classmethod
    def of_session(cls, out: str | Path, session_id: str, settings: Mapping[str, Any] | None = None) -> "FeatureStore":
        """Open all features of a session that are there.

        Args:
            out: folder of all features.
            session_id: the session's.
            settings: of the extractor; None: of SIFT.

        Raises:
            ArtifactError: there are none, or the file is torn.
        """
        return cls.open(features_path(out, session_id, settings or SiftExtractor().settings))

    @property
    def fingerprint(self) -> str:
        """16 hex digits that identify the images and settings that the features were made from."""
        return fingerprint([self.settings, self.made_from, sorted(self.failed)])

    @property
    def names(self) -> list[str]:
        return list(self.made_from)

    def __contains__(self, name: object) -> bool:
        return name in self.made_from

    def __iter__(self) -> Iterator[str]:
        return iter(self.made_from)

    def __len__(self) -> int:
        return len(self.made_from)

    def __getitem__(self, name: str) -> LocalFeatures:
        if name not in self.made_from:
            raise KeyError(name)
        with self._lock:
            try:
                group = (self._file or self._open(name))[name]
                arrays = {key: item[()] for key, item in group.items() if isinstance(item, h5py.Dataset)}
            except (OSError, RuntimeError, KeyError) as error:  # what HDF5 raises for what is not its format
                raise ArtifactError(
                    f"Local features {self.path} are damaged at {name} ({error}). Delete the file: it is made again."
                ) from None
        try:
            keypoints = arrays["keypoints"].astype(np.float32, copy=False) + self._offset
            descriptors = arrays["descriptors"]
            size = arrays["image_size"]
        except KeyError as error:
            raise ArtifactError(
                f"{self.path}: {name} has no {error}; expected the layout of hloc. If a run made the file, delete it: "
                "it is made again."
            ) from None
        if self._bytes:
            descriptors = np.take(_BYTES, descriptors.view(np.uint16))
        ones = np.ones(len(keypoints), np.float32)
        return LocalFeatures(
            keypoints,
            arrays.get("scales", ones).astype(np.float32, copy=False),
            arrays.get("scores", ones).astype(np.float32, copy=False),
            _transposed(descriptors),
            (int(size[0]), int(size[1])),
        )

    def _open(self, name: str) -> h5py.File:
        """Open the file; what holds for one image holds for all."""
        file = h5py.File(self.path, "r")
        self._offset = np.float32(0.5 - file.attrs.get(PIXEL_CENTER, 0.0))
        self._bytes = file[name]["descriptors"].attrs.get(SCALE) == DESCRIPTOR_SCALE
        self._file = file
        return file


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

    A killed run goes on where it was, but for at most `groups.PART_GROUPS` images. Memory does not grow with the
    session.

    Args:
        session: the session; only its camera images are read.
        out: folder of all features; this session's go to `features_path`.
        extractor: how to extract; None: SIFT.
        rows: rows of `session.images` that are needed; all where None.
        workers: threads.
        skip_existing: reuse the features of images that have not changed since.

    Returns:
        The store of the features of the rows asked for. Unreadable images are in its `failed`.
    """
    extractor = extractor or SiftExtractor()
    wanted = session.camera_rows if rows is None else np.intersect1d(session.camera_rows, rows)
    row_of: dict[str, int] = {}
    for row in wanted.tolist():
        row_of.setdefault(session.image_name(row), row)  # a line of images.txt may be there twice
    made_from = {name: _made_from(session, row) for name, row in row_of.items()}
    path, label = features_path(out, session.id, extractor.settings), f"{extractor.settings['name']} {session.id}"
    with GroupWriter(path, extractor.settings, {PIXEL_CENTER: 0.0}) as writer:
        index = writer.index
        done = {*index.groups.items(), *((name, note[0]) for name, note in index.failed.items())}
        todo = [item for item in made_from.items() if not (skip_existing and item in done)]
        cv2_threads = cv2.getNumThreads()
        cv2.setNumThreads(1)  # the images are the parallel dimension
        try:
            with tqdm(total=len(todo), desc=label, unit="image", disable=not progress or not todo) as bar:
                found = _extract(session, [row_of[image] for image, _ in todo], extractor, workers)
                for (image, source), features in zip(todo, found, strict=True):
                    if isinstance(features, str):
                        writer.fail(image, source, features)
                    else:
                        _write(writer, image, source, features)
                    bar.update()
        finally:
            cv2.setNumThreads(cv2_threads)
        writer.finish()
        index = writer.index
    failed = {name: index.failed[name][1] for name in made_from if name in index.failed}
    known = {name: source for name, source in made_from.items() if name in index.groups}
    return FeatureStore(path, known, failed, extractor.settings)


def _transposed(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return a copy (M, N) of a matrix (N, M)."""
    # OpenCV is ten times quicker at it, but knows no matrix without entries, and no float16 in some versions.
    return cv2.transpose(matrix) if matrix.size and matrix.dtype == np.uint8 else np.ascontiguousarray(matrix.T)


def _made_from(session: Session, row: int) -> str:
    """Identify an image by name, size and time of change of its file, and by the size that its camera has."""
    camera = session.camera(session.images["sensor_id"].iloc[row])
    return fingerprint([files_fingerprint([session.image_path(row)]), camera.width, camera.height])


def _extract(
    session: Session, rows: list[int], extractor: Extractor, workers: int
) -> Iterator[LocalFeatures | str]:
    """Yield the features of each image, or why it has none."""
    sensors = session.images["sensor_id"].to_numpy()

    def read(row: int) -> NDArray[np.uint8] | str:
        try:
            image = read_image(session.image_path(row), gray=not extractor.color)
        except ImageError as error:
            return str(error)
        camera = session.camera(sensors[row])
        if image.shape[:2] != (camera.height, camera.width):
            return (
                f"Image of {image.shape[1]} x {image.shape[0]} pixels, but sensors.txt says {camera.width} x "
                f"{camera.height} for {sensors[row]}: {session.image_path(row)}"
            )
        return image

    def both(row: int) -> LocalFeatures | str:
        image = read(row)
        return image if isinstance(image, str) else extractor.extract([image])[0]

    if extractor.threaded:
        yield from prefetch(both, rows, workers)
        return
    images = prefetch(read, rows, workers, ahead=2 * extractor.batch_size)
    while batch := list(islice(images, extractor.batch_size)):
        found = iter(extractor.extract([image for image in batch if not isinstance(image, str)]))
        for image in batch:
            yield image if isinstance(image, str) else next(found)


def _write(writer: GroupWriter, name: str, made_from: str, features: LocalFeatures) -> None:
    """Write the features of an image as hloc has them."""
    descriptors = _transposed(features.descriptors)
    quantized = descriptors.dtype == np.uint8
    arrays = {
        # Exact from 0.5 px on, where the difference has no more digits than the number.
        "keypoints": features.keypoints - np.float32(0.5),
        "scales": features.scales,
        "scores": features.scores,
        "descriptors": np.take(_HALVES, descriptors) if quantized else descriptors,
        "image_size": np.array(features.image_size, np.int64),
    }
    writer.add(name, made_from, arrays, {"descriptors": {SCALE: DESCRIPTOR_SCALE}} if quantized else {})
