"""Files of local features and of matches, in the layout of hloc (https://github.com/cvg/Hierarchical-Localization).

Each session has one HDF5 file of features per kind and settings. It has one group per image, with the image's name:
`keypoints` (N, 2), `descriptors` (D, N) of unit length, `scores` (N,), `image_size` (2,) and, beyond hloc, `scales`
(N,) of the keypoints. In the file, the center of the top-left pixel is at 0, and an attribute of the file says so; here
and in `LocalFeatures` it is at 0.5.

Two sessions have one HDF5 file of matches, with one group per pair of images, `<image>/<image>` with `/` in the names
replaced by `-` (see `group_names` for names that become equal): `matches0` (N,), for each feature of the first image
the index of the matching feature of the second image or -1, and `matching_scores0` (N,).
"""

import logging
import threading
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Session
from toolkit.capture.images import default_workers, prefetch, read_image
from toolkit.errors import ArtifactError, DamagedError, ImageError, first_line
from toolkit.features.features import DESCRIPTOR_SCALE, KINDS, Extractor, LocalFeatures, extract_turned
from toolkit.features.groups import HDF5_ERRORS, GroupWriter, group_names_of, has_group, read_group
from toolkit.features.matching import Matcher, PairMatches
from toolkit.features.sift import SiftExtractor
from toolkit.files import files_fingerprint, fingerprint, read_sidecar
from toolkit.geometry import Ints
from toolkit.threads import one_thread

log = logging.getLogger(__name__)

PIXEL_CENTER = "top_left_pixel_center"
"""Attribute of a file of features: the coordinate of the center of the top-left pixel."""
SCALE = "scale"
"""Attribute of descriptors that were bytes: the divisor that made them floats."""
KEPT_IMAGES = 256
"""Number of images whose features `OnDemandFeatures` keeps in memory."""
_HALF_PIXEL = np.float32(0.5)
# Files store bytes as float16 without loss: a byte over a power of two has 8 significant bits, float16 has 11. A
# look-up table is several times faster than multiplication and conversion.
_HALVES = (np.arange(256) / DESCRIPTOR_SCALE).astype(np.float16)
_BYTES = np.zeros(1 << 16, np.uint8)
_BYTES[_HALVES.view(np.uint16)] = np.arange(256)


_Todo = tuple[str, str, int, int]
"""An image to extract features from: name, fingerprint of the sources, row of the session, quarter turns."""
_ToMatch = tuple[str, str, str, str]
"""A pair to match: group in the file, fingerprint of the sources, names of the two images."""


def features_path(out: str | Path, session_id: str, settings: Mapping[str, Any]) -> Path:
    """Return the file of a session's features by an extractor's settings; `out` is the folder of all features."""
    return Path(out) / session_id / f"{settings['name']}-{fingerprint(settings)}.h5"


def as_stored(features: LocalFeatures) -> LocalFeatures:
    """Return the features as if read from a file, where keypoints next to the image's border lose their last bits."""
    return _from_arrays(_to_arrays(features), _HALF_PIXEL, features.descriptors.dtype == np.uint8)


def _to_arrays(features: LocalFeatures) -> dict[str, NDArray[Any]]:
    """Return the features of an image in hloc's layout."""
    descriptors = _transposed(features.descriptors)
    return {
        # The difference is exact for coordinates of at least 0.5 px.
        "keypoints": features.keypoints - _HALF_PIXEL,
        "scales": features.scales,
        "scores": features.scores,
        "descriptors": np.take(_HALVES, descriptors) if descriptors.dtype == np.uint8 else descriptors,
        "image_size": np.array(features.image_size, np.int64),
        **({"turns": np.array(features.turns, np.int64)} if features.turns else {}),
    }


def _from_arrays(arrays: Mapping[str, NDArray[Any]], offset: np.float32, quantized: bool) -> LocalFeatures:
    """Return the features of an image from the arrays of a file; hloc's files may lack scores and scales.

    Args:
        offset: added to keypoints, so that the center of the top-left pixel is at 0.5.
        quantized: convert descriptors back to bytes.

    Raises:
        ValueError: shapes or types do not fit the layout.
    """
    keypoints = arrays["keypoints"].astype(np.float32, copy=False) + offset
    descriptors, (width, height) = arrays["descriptors"], arrays["image_size"]
    ones = np.ones(len(keypoints), np.float32)
    scales, scores = arrays.get("scales", ones), arrays.get("scores", ones)
    shapes = [keypoints.shape, scales.shape, scores.shape, descriptors.shape]
    count = shapes[0][0] if keypoints.ndim == 2 else 0
    if shapes != [(count, 2), (count,), (count,), (*descriptors.shape[:1], count)]:
        raise ValueError(f"keypoints, scales, scores and descriptors have the shapes {shapes}")
    if descriptors.dtype.kind != "f" or (quantized and descriptors.dtype != np.float16):
        raise ValueError(f"descriptors are of the type {descriptors.dtype}")
    return LocalFeatures(
        keypoints,
        scales.astype(np.float32, copy=False),
        scores.astype(np.float32, copy=False),
        _transposed(np.take(_BYTES, descriptors.view(np.uint16)) if quantized else descriptors),
        (int(width), int(height)),
        int(arrays.get("turns", 0)),
    )


def _transposed(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return a copy (M, N) of a matrix (N, M)."""
    # OpenCV is ten times faster, but fails for empty matrices and, in some versions, for float16.
    return cv2.transpose(matrix) if matrix.size and matrix.dtype == np.uint8 else np.ascontiguousarray(matrix.T)


class FeatureStore(Mapping[str, LocalFeatures]):
    """Read access to the local features of many images, by image name (`Session.image_name`).

    Thread-safe. Each access reads the file.
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
        """Name of an image -> fingerprint of the sources of its features."""
        self.failed = dict(failed or {})
        """Name of an image that could not be read -> reason."""
        self.settings = dict(settings or {})
        """Settings of the extractor; empty if unknown."""
        self._file: h5py.File | None = None
        self._quantized = False
        self._offset = np.float32(0)
        self._lock = threading.Lock()

    @classmethod
    def open(cls, path: str | Path) -> "FeatureStore":
        """Open a file of features by the toolkit or hloc, without a check whether its images have changed.

        Raises:
            ArtifactError: the file is missing, torn, or has no features. Damaged features raise `DamagedError` later,
                when they are read.
        """
        record = read_sidecar(path)
        if record is not None and "groups" in record:
            failed = {name: reason for name, (_, reason) in record["failed"].items()}
            return cls(Path(path), record["groups"], failed, record["made_by"])
        try:
            with h5py.File(path, "r") as file:
                names = group_names_of(file, "keypoints")
        except HDF5_ERRORS as error:
            raise ArtifactError(f"Local features {path} cannot be read ({error}). Extract them again.") from None
        if not names:
            raise ArtifactError(
                f"{path} holds no local features; expected a group for each image with `keypoints` and `descriptors`."
            )
        return cls(Path(path), dict.fromkeys(names, files_fingerprint([Path(path)])))

    @classmethod
    def of_session(cls, out: str | Path, session_id: str, settings: Mapping[str, Any] | None = None) -> "FeatureStore":
        """Open the file with all extracted features of a session.

        Args:
            out: folder of all features.
            settings: settings of the extractor; None: SIFT.

        Raises:
            ArtifactError: the file is missing or torn.
        """
        return cls.open(features_path(out, session_id, settings or SiftExtractor().settings))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the path. A process opens the file at the first unpickling, and again if it has changed."""
        return _reopened, (self.path, files_fingerprint([self.path]))

    @property
    def fingerprint(self) -> str:
        """Fingerprint, 16 hex digits, of the images and settings that the features were made from."""
        return fingerprint([self.settings, self.made_from, sorted(self.failed)])

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
            if self._file is None:
                self._open(name)
            arrays = read_group(self._file, name)
        try:
            return _from_arrays(arrays, self._offset, self._quantized)
        except HDF5_ERRORS as error:
            raise DamagedError(
                self.path, f"{self.path}: {name} is not in the layout of hloc ({first_line(error)})."
            ) from None

    def _open(self, name: str) -> None:
        """Open the file; read the pixel convention and quantization, the same for all images, at one image."""
        try:
            file = h5py.File(self.path, "r")
            read_group(file, name)  # refuses links to elsewhere
            self._offset = _HALF_PIXEL - np.float32(file.attrs.get(PIXEL_CENTER, 0.0))
            self._quantized = bool(file[name]["descriptors"].attrs.get(SCALE) == DESCRIPTOR_SCALE)
        except HDF5_ERRORS as error:
            raise DamagedError(
                self.path, f"Local features {self.path} cannot be read ({first_line(error)}). Extract them again."
            ) from None
        self._file = file


@lru_cache(maxsize=16)
def _reopened(path: Path, state: str) -> FeatureStore:
    return FeatureStore.open(path)


def extract_session(
    session: Session,
    out: str | Path,
    extractor: Extractor | None = None,
    rows: Ints | None = None,
    workers: int = 2,
    skip_existing: bool = True,
    progress: bool = True,
    turns: Ints | None = None,
) -> FeatureStore:
    """Extract the local features of a session's images, or reuse earlier ones.

    A killed run loses at most one part of `GroupWriter`. Memory does not grow with the session.

    Args:
        session: the session; only its camera images are read.
        out: folder of all features; this session's file is `features_path`.
        extractor: the extractor; None: SIFT.
        rows: rows of `session.images` to extract; None: all.
        skip_existing: reuse the features of unchanged images.
        turns: quarter turns that make each image of the session upright, see `capture.upright`; None: images stay as
            they are. Ignored for kinds of features that do not need upright images.

    Returns:
        The store of the features of these rows. Unreadable images are in its `failed`.
    """
    extractor = extractor or SiftExtractor()
    chosen = session.camera_rows if rows is None else np.intersect1d(session.camera_rows, rows)
    row_of: dict[str, int] = {}
    for row in chosen.tolist():
        row_of.setdefault(session.image_name(row), row)  # images.txt may have an image twice
    if turns is None or not KINDS[extractor.settings["name"]].upright:
        turns = np.zeros(len(session.images), np.int64)
    made_from = {name: _made_from(session, row, int(turns[row])) for name, row in row_of.items()}
    path, label = features_path(out, session.id, extractor.settings), f"{extractor.settings['name']} {session.id}"
    with GroupWriter(path, extractor.settings, {PIXEL_CENTER: 0.0}) as writer:
        todo = [(name, source, row_of[name], int(turns[row_of[name]])) for name, source in made_from.items()]
        todo = writer.left(todo) if skip_existing else todo
        todo = writer.spread(_extract_into, todo, (session, extractor), label, "image")
        _extract_into(writer, todo, session, extractor, workers, label if progress and todo else "")
        writer.finish()
        index = writer.index
    failed = {name: index.failed[name][1] for name in made_from if name in index.failed}
    readable = {name: source for name, source in made_from.items() if name in index.groups}
    return FeatureStore(path, readable, failed, extractor.settings)


def _extract_into(
    writer: GroupWriter,
    todo: Sequence[_Todo],
    session: Session,
    extractor: Extractor,
    workers: int = 0,
    label: str = "",
) -> None:
    """Extract the features of images into a file, or record why that failed. An empty `label` hides the bar."""
    with one_thread():  # images are processed in parallel instead
        results = _extract(session, [item[2:] for item in todo], extractor, workers or default_workers())
        bar = tqdm(todo, desc=label, unit="image", disable=not label)
        for (name, source, *_), features in zip(bar, results, strict=True):
            if isinstance(features, str):
                writer.fail(name, source, features)
            else:
                quantized = features.descriptors.dtype == np.uint8
                attributes = {"descriptors": {SCALE: DESCRIPTOR_SCALE}} if quantized else {}
                writer.add(name, source, _to_arrays(features), attributes)


class OnDemandFeatures:
    """The features of a session's images by name: from the session's file, or else extracted at the first access.

    Thread-safe. Features that were extracted last stay in memory.
    """

    def __init__(self, session: Session, out: str | Path, extractor: Extractor, turns: Ints | None = None):
        """For the arguments see `extract_session`."""
        self._session, self._out, self._extractor = session, Path(out), extractor
        self._turns = np.zeros(len(session.images), np.int64) if turns is None else turns
        self._store: FeatureStore | None = None
        if features_path(out, session.id, extractor.settings).exists():
            self._store = FeatureStore.of_session(out, session.id, extractor.settings)
        self._extract = lru_cache(KEPT_IMAGES)(self._extract_one)
        self._lock = threading.Lock()

    def prepare(self, names: Iterable[str], workers: int, skip_existing: bool = True) -> FeatureStore:
        """Extract the features of images into the file, and return it; see `extract_session`."""
        rows = np.array([self._session.row_of_name[name] for name in names], np.int64)
        self._store = extract_session(
            self._session, self._out, self._extractor, rows, workers, skip_existing, turns=self._turns
        )
        return self._store

    def __call__(self, name: str) -> LocalFeatures:
        """Return the features of an image; empty if it cannot be read."""
        if self._store is not None and name in self._store:
            return self._store[name]
        with self._lock:
            return self._extract(name)

    def _extract_one(self, name: str) -> LocalFeatures:
        row = self._session.row_of_name[name]
        features = next(_extract(self._session, [(row, int(self._turns[row]))], self._extractor, workers=1))
        if isinstance(features, str):
            log.warning("%s", features)
            camera = self._session.camera(self._session.images["sensor_id"].iloc[row])
            return LocalFeatures.none((camera.width, camera.height))
        return as_stored(features)


def _made_from(session: Session, row: int, turns: int) -> str:
    """Return a fingerprint of an image: its file's name, size and time of change, its camera's size, and its turns."""
    camera = session.camera(session.images["sensor_id"].iloc[row])
    turned = [turns] if turns else []
    return fingerprint([files_fingerprint([session.image_path(row)]), camera.width, camera.height, *turned])


def _extract(
    session: Session, images: list[tuple[int, int]], extractor: Extractor, workers: int
) -> Iterator[LocalFeatures | str]:
    """Yield for each image, given as (row, turns), its features or the reason why it cannot be read."""
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

    def read_and_extract(item: tuple[int, int]) -> LocalFeatures | str:
        row, turns = item
        image = read(row)
        return image if isinstance(image, str) else extract_turned(extractor, [image], [turns])[0]

    if extractor.threaded:
        yield from prefetch(read_and_extract, images, workers)
        return
    pictures = prefetch(read, (row for row, _ in images), workers, ahead=2 * extractor.batch_size)
    turned = zip(pictures, (turns for _, turns in images), strict=True)
    while batch := list(islice(turned, extractor.batch_size)):
        readable = [(image, turns) for image, turns in batch if not isinstance(image, str)]
        features = iter(extract_turned(extractor, *zip(*readable, strict=True)) if readable else [])
        for image, _ in batch:
            yield image if isinstance(image, str) else next(features)


def matches_path(out: str | Path, session0: str, session1: str, made_by: Mapping[str, Any]) -> Path:
    """Return the file of the matches of two sessions.

    Args:
        made_by: settings, `features` (a list with those of each session) and `matcher`.
    """
    features, matcher = made_by["features"][0].get("name", "features"), made_by["matcher"]["name"]
    return Path(out) / f"{session0}-{session1}" / f"{features}-{matcher}-{fingerprint(made_by)}.h5"


class MatchStore:
    """Thread-safe read access to the matches of two sessions' images, in a file by the toolkit or hloc."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._lock = threading.Lock()

    def __getitem__(self, names: tuple[str, str]) -> PairMatches:
        """Return the matches of two images, which the file may have in either order.

        Raises:
            KeyError: the file does not have the pair.
            ArtifactError: the file cannot be read.
        """
        with self._lock:
            if self._file is None:
                try:
                    self._file = h5py.File(self.path, "r")
                except OSError as error:
                    raise DamagedError(
                        self.path, f"Matches {self.path} cannot be read ({first_line(error)}). Match again."
                    ) from None
            candidates = ((of(*names[::step]), step) for step in (1, -1) for of in (_own_group, _shared_group))
            group, step = next(((group, step) for group, step in candidates if has_group(self._file, group)), ("", 0))
            if not group:
                raise KeyError(names)
            arrays = read_group(self._file, group)
        partners, scores = (arrays.get(key, np.zeros(())) for key in ("matches0", "matching_scores0"))
        if partners.ndim != 1 or partners.dtype.kind not in "iu" or scores.shape != partners.shape:
            raise DamagedError(
                self.path,
                f"{self.path}: {group} is not in the layout of hloc; expected matches0 (N,), whole numbers, and "
                f"matching_scores0 (N,), found {', '.join(f'{key} {array.shape}' for key, array in arrays.items())}.",
            )
        first = np.flatnonzero(partners >= 0)
        indices = np.stack([first, partners[first].astype(np.int64)], axis=1)
        return PairMatches(indices[:, ::step], scores[first].astype(np.float32))


def write_matches(
    writer: GroupWriter, group: str, made_from: str, counts: tuple[int, int], matches: PairMatches
) -> None:
    """Add the matches of two images to a file, as a group of `group_names`; `counts` are the images' features."""
    # 16 bits as in hloc; few networks find more features.
    matches0 = np.full(counts[0], -1, np.int16 if max(counts) <= np.iinfo(np.int16).max else np.int32)
    scores = np.zeros(counts[0], np.float16)
    matches0[matches.indices[:, 0]] = matches.indices[:, 1]
    scores[matches.indices[:, 0]] = matches.scores
    writer.add(group, made_from, {"matches0": matches0, "matching_scores0": scores})


def match_sessions(
    stores: tuple[FeatureStore, FeatureStore],
    pairs: Iterable[tuple[str, str]],
    matcher: Matcher,
    out: str | Path,
    sessions: tuple[str, str],
    skip_existing: bool = True,
) -> MatchStore:
    """Match pairs of images of two sessions, or reuse earlier matches. After a kill, the next call continues.

    Args:
        stores: features of the first and of the second session.
        pairs: names of the two images, the first session's first.
        out: folder of all matches, see `matches_path`.
        skip_existing: reuse the matches of unchanged features.

    Returns:
        The store of the matches of at least these pairs, without pairs in which an image has no features.
    """
    made_by = {"features": [store.settings for store in stores], "matcher": matcher.settings}
    path = matches_path(out, *sessions, made_by)
    with GroupWriter(path, made_by) as writer:
        readable = [(name0, name1) for name0, name1 in pairs if name0 in stores[0] and name1 in stores[1]]
        todo = [
            (group, stores[0].made_from[name0] + stores[1].made_from[name1], name0, name1)
            for (name0, name1), group in group_names(readable, writer.index.groups).items()
        ]
        todo = writer.left(todo) if skip_existing else todo
        label = f"{matcher.settings['name']} {' '.join(sessions)}"
        todo = writer.spread(_match_into, todo, (stores, matcher, label), label, "pair", matcher.batch_size)
        _match_into(writer, todo, stores, matcher, label)
        writer.finish()
    return MatchStore(path)


def _match_into(
    writer: GroupWriter,
    todo: Sequence[_ToMatch],
    stores: tuple[FeatureStore, FeatureStore],
    matcher: Matcher,
    label: str,
) -> None:
    """Add the matches of pairs to a file."""
    with tqdm(total=len(todo), desc=label, unit="pair", disable=not todo) as bar:
        for start in range(0, len(todo), matcher.batch_size):
            batch = todo[start : start + matcher.batch_size]
            # The same object for each occurrence of an image, so that the matcher prepares it only once.
            first, second = (
                {name: store[name] for name in {pair[side] for pair in batch}} for side, store in enumerate(stores, 2)
            )
            features = [(first[name0], second[name1]) for _, _, name0, name1 in batch]
            for pair, both, matches in zip(batch, features, matcher.match(features), strict=True):
                write_matches(writer, *pair[:2], (len(both[0]), len(both[1])), matches)
            bar.update(len(batch))


def group_names(pairs: Iterable[tuple[str, str]], existing: Container[str] = ()) -> dict[tuple[str, str], str]:
    """Return the name of the group of each pair of images: hloc's name, unless several pairs share it.

    Pairs whose image names differ only in `-` versus `/` share hloc's name. Each of them gets a unique name, which
    readers of hloc's layout do not find.

    Args:
        existing: groups in the file; an existing unique name is kept.
    """
    shared = {pair: _shared_group(*pair) for pair in pairs}
    count = Counter(shared.values())
    return {
        pair: own if (own := _own_group(*pair)) in existing or count[group] > 1 else group
        for pair, group in shared.items()
    }


def _shared_group(name0: str, name1: str) -> str:
    return f"{name0.replace('/', '-')}/{name1.replace('/', '-')}"


def _own_group(name0: str, name1: str) -> str:
    return f"{_shared_group(name0, name1)}~{fingerprint([name0, name1])}"
