"""Local features of a session's images, and matches of two sessions' images, in folders of items.

Each session has one folder of features per kind and settings, with an item per image, by the image's name. Two sessions
have one folder of matches per kind and settings, with an item per pair of images. For hloc's files see
`exchange.export`.
"""

import logging
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Session
from toolkit.capture.images import camera_text, default_workers, prefetch, read_image, sees_all
from toolkit.errors import ArtifactError, DamagedError, ImageError
from toolkit.features.features import (
    KINDS,
    Extractor,
    LocalFeatures,
    PairMatches,
    SiftExtractor,
    extract_turned,
    usable,
)
from toolkit.features.matching import Matcher
from toolkit.files import files_fingerprint, fingerprint, link_folder
from toolkit.geometry import Ints
from toolkit.store.items import Items
from toolkit.threads import one_thread

log = logging.getLogger(__name__)

KEPT_IMAGES = 256  # number of images whose features `OnDemandFeatures` keeps in memory

_Todo = tuple[str, str, int, int]
"""An image to extract features from: name, fingerprint of the sources, row of the session, quarter turns."""
_ToMatch = tuple[str, str, str, str]
"""A pair to match: name of its item, fingerprint of the sources, names of the two images."""


def features_path(out: str | Path, session_id: str, settings: Mapping[str, Any]) -> Path:
    """Return the folder of a session's features by an extractor's settings; `out` is the folder of all features."""
    return Path(out) / session_id / f"{settings['name']}-{fingerprint(settings)}"


@dataclass(eq=False)
class FeatureStore(Mapping[str, LocalFeatures]):
    """Read access to the local features of many images, by image name (`Session.image_name`).

    Thread-safe. Each access reads a file.
    """

    path: Path
    made_from: Mapping[str, str]  # name of an image -> fingerprint of the sources of its features
    failed: Mapping[str, str] = field(default_factory=dict)  # name of an image that could not be read -> reason
    settings: Mapping[str, Any] = field(default_factory=dict)  # of the extractor; empty if unknown
    stored: Items | None = None  # None: opened at the first access

    @classmethod
    def open(cls, path: str | Path) -> "FeatureStore":
        """Open a folder of features, without a check whether its images have changed.

        Raise ArtifactError if the folder is missing, or has no features. Damaged features raise `DamagedError` later,
        when they are read.
        """
        items = Items(path)
        if not items:
            raise ArtifactError(f"{path}: found no local features. Extract them again.")
        return cls._of(Path(path), items, items)

    @classmethod
    def _of(cls, path: Path, items: Items, names: Iterable[str]) -> "FeatureStore":
        failed = {name: items.note(name)["failed"] for name in names if items.note(name)}
        made_from = {name: items.source(name) for name in names if name not in failed}
        return cls(path, made_from, failed, items.made_by or {}, items)

    @classmethod
    def of_session(cls, out: str | Path, session_id: str, settings: Mapping[str, Any] | None = None) -> "FeatureStore":
        """Open a session's features by an extractor's settings, None: SIFT; `out` is the folder of all features."""
        return cls.open(features_path(out, session_id, settings or SiftExtractor().settings))

    def only(self, names: Iterable[str]) -> "FeatureStore":
        """Return the store with only these images."""
        chosen = {*names}
        made_from, failed = ({n: kept[n] for n in kept if n in chosen} for kept in (self.made_from, self.failed))
        return replace(self, made_from=made_from, failed=failed)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the path. A process opens the folder at the first unpickling, and again if it has changed."""
        return _reopened, (self.path, files_fingerprint(sorted(self.path.glob("*.shard"))))

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
        self.stored = Items(self.path) if self.stored is None else self.stored
        arrays = self.stored[name]
        width, height, turns = arrays.pop("image").tolist()
        return LocalFeatures(**arrays, image_size=(width, height), turns=turns)


@lru_cache(maxsize=16)
def _reopened(path: Path, state: str) -> FeatureStore:
    return FeatureStore.open(path)


def write_features(items: Items, name: str, made_from: str, features: LocalFeatures) -> None:
    """Add the features of an image to a folder."""
    arrays = {key: getattr(features, key) for key in ("keypoints", "scales", "scores", "descriptors")}
    items.add(name, made_from, arrays | {"image": np.array([*features.image_size, features.turns], np.int64)})


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

    A killed run loses at most one shard of `Items`. Memory does not grow with the session.

    Args:
        session: the session; only its camera images are read.
        out: folder of all features; that of this session is `features_path`.
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
    given = session.path / "proc" / "features" / path.name  # from a reconstruction
    if not path.exists() and given.is_dir():
        link_folder(given, path)
    with Items(path, extractor.settings, skip_existing=skip_existing) as items:
        todo = items.left((name, source, row_of[name], int(turns[row_of[name]])) for name, source in made_from.items())
        if todo and skip_existing and given.is_dir():  # it has grown
            reconstructed = Items(given, extractor.settings)
            for name, source, *_ in todo:
                if reconstructed.is_current(name, source):
                    with suppress(DamagedError):  # it is extracted
                        items.add(name, source, reconstructed[name], reconstructed.note(name))
            items.flush()
            todo = items.left(todo)
        if todo and any(path.parent.glob(f"{path.name.partition('-')[0]}-*.h5")):
            log.warning("%s: features in .h5 files, of an older version of the toolkit, are not used.", path.parent)
        todo = items.distribute(_extract_into, todo, (session, extractor), label, "image")
        _extract_into(items, todo, session, extractor, workers, label if progress and todo else "")
    return FeatureStore._of(path, items, made_from)


def _extract_into(
    items: Items, todo: Sequence[_Todo], session: Session, extractor: Extractor, workers: int = 0, label: str = ""
) -> None:
    """Extract the features of images into a folder, or record why that failed. An empty `label` hides the bar."""
    with one_thread():  # images are processed in parallel instead
        results = _extract(session, [item[2:] for item in todo], extractor, workers or default_workers())
        bar = tqdm(todo, desc=label, unit="image", disable=not label)
        for (name, source, *_), features in zip(bar, results, strict=True):
            if isinstance(features, str):
                items.add(name, source, note={"failed": features})
            else:
                write_features(items, name, source, features)


class OnDemandFeatures:
    """The features of a session's images by name: from the session's folder, or else extracted at the first access.

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
        """Extract the features of images into the folder, and return them; see `extract_session`."""
        rows = np.array([self._session.row_of_name[name] for name in names], np.int64)
        made = self._session, self._out, self._extractor, rows, workers, skip_existing
        self._store = extract_session(*made, turns=self._turns)
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
        return features


def _made_from(session: Session, row: int, turns: int) -> str:
    """Return a fingerprint of an image: its files' names, sizes and times of change, camera size, and turns."""
    camera = session.camera(session.images["sensor_id"].iloc[row])
    cut = [] if sees_all(camera) else [f"without pixels that have no ray, {camera_text(camera)}"]
    turned, files = [turns] if turns else [], [session.image_path(row), *session.mask_paths([row])]
    return fingerprint([files_fingerprint(files), camera.width, camera.height, *turned, *cut])


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
            said = f"sensors.txt says {camera.width} x {camera.height} for {sensors[row]}: {session.image_path(row)}"
            return f"Image of {image.shape[1]} x {image.shape[0]} pixels, but {said}"
        return image

    def only_usable(row: int, features: LocalFeatures) -> LocalFeatures | str:
        try:
            return usable(features, session.mask_path(row), session.camera(sensors[row]))
        except ImageError as error:
            return str(error)

    def read_and_extract(item: tuple[int, int]) -> LocalFeatures | str:
        row, turns = item
        image = read(row)
        return image if isinstance(image, str) else only_usable(row, extract_turned(extractor, [image], [turns])[0])

    if extractor.threaded:
        yield from prefetch(read_and_extract, images, workers)
        return
    pixels = prefetch(read, (row for row, _ in images), workers, ahead=2 * extractor.batch_size)
    turned = zip(pixels, images, strict=True)
    while batch := list(islice(turned, extractor.batch_size)):
        readable = [(image, turns) for image, (_, turns) in batch if not isinstance(image, str)]
        features = iter(extract_turned(extractor, *zip(*readable, strict=True)) if readable else [])
        for image, (row, _) in batch:
            yield image if isinstance(image, str) else only_usable(row, next(features))


def matches_path(out: str | Path, session0: str, session1: str, made_by: Mapping[str, Any]) -> Path:
    """Return the folder of the matches of two sessions; `made_by` has the `features` of each, and `matcher`."""
    features, matcher = made_by["features"][0].get("name", "features"), made_by["matcher"]["name"]
    return Path(out) / f"{session0}-{session1}" / f"{features}-{matcher}-{fingerprint(made_by)}"


class MatchStore:
    """Thread-safe read access to the matches of two sessions' images."""

    def __init__(self, path: str | Path, items: Items | None = None):
        self.path = Path(path)
        self._items = Items(path) if items is None else items

    def __getitem__(self, names: tuple[str, str]) -> PairMatches:
        """Return the matches of two images, which the folder may have in either order; raise KeyError if it has not,
        and DamagedError if they are not what was written.
        """
        step = 1 if match_name(*names) in self._items else -1
        arrays = self._items[match_name(*names[::step])]
        return PairMatches(arrays["indices"].astype(np.int64)[:, ::step], arrays["scores"].astype(np.float32))


def match_name(name0: str, name1: str) -> str:
    """Return the name of the item of two images; names of images have no line breaks."""
    return f"{name0}\n{name1}"


def write_matches(items: Items, name: str, made_from: str, matches: PairMatches) -> None:
    """Add the matches of two images, named by `match_name`, to a folder, in the order of the first image's features."""
    order = np.argsort(matches.indices[:, 0], kind="stable")
    indices = matches.indices[order]
    small = indices.max(initial=0) <= np.iinfo(np.uint16).max
    arrays = {"indices": indices.astype(np.uint16 if small else np.int32)}
    items.add(name, made_from, arrays | {"scores": matches.scores[order].astype(np.float16)})


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
    with Items(path, made_by, skip_existing=skip_existing) as items:
        readable = dict.fromkeys((name0, name1) for name0, name1 in pairs if name0 in stores[0] and name1 in stores[1])
        sources = (stores[0].made_from[first] + stores[1].made_from[second] for first, second in readable)
        todo = items.left((match_name(*names), source, *names) for names, source in zip(readable, sources, strict=True))
        label = f"{matcher.settings['name']} {' '.join(sessions)}"
        todo = items.distribute(_match_into, todo, (stores, matcher, label), label, "pair", matcher.batch_size)
        _match_into(items, todo, stores, matcher, label)
    return MatchStore(path, items)


def _match_into(
    items: Items, todo: Sequence[_ToMatch], stores: tuple[FeatureStore, FeatureStore], matcher: Matcher, label: str
) -> None:
    """Add the matches of pairs to a folder."""
    with tqdm(total=len(todo), desc=label, unit="pair", disable=not todo) as bar:
        for start in range(0, len(todo), matcher.batch_size):
            batch = todo[start : start + matcher.batch_size]
            # The same object for each occurrence of an image, so that the matcher prepares it only once.
            first, second = (
                {name: store[name] for name in {pair[side] for pair in batch}} for side, store in enumerate(stores, 2)
            )
            features = [(first[name0], second[name1]) for _, _, name0, name1 in batch]
            for pair, matches in zip(batch, matcher.match(features), strict=True):
                write_matches(items, *pair[:2], matches)
            bar.update(len(batch))
