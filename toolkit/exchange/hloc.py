"""Local features and matches in the HDF5 files of hloc (https://github.com/cvg/Hierarchical-Localization).

A file of features has one group per image, with the image's name: `keypoints` (N, 2), `descriptors` (D, N) of unit
length, `scores` (N,), `image_size` (2,) and, beyond hloc, `scales` (N,) of the keypoints. The center of the top-left
pixel is at 0, and an attribute of the file says so; in `LocalFeatures` it is at 0.5.

A file of matches has one group per pair of images, `<image>/<image>` with `/` in the names replaced by `-`: `matches0`
(N,), for each feature of the first image the index of the matching feature of the second image or -1, and
`matching_scores0` (N,).
"""

import logging
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from toolkit.errors import ArtifactError, DamagedError, first_line
from toolkit.exchange.export import only_features, session_of_run
from toolkit.features.features import DESCRIPTOR_SCALE, LocalFeatures
from toolkit.features.matching import PairMatches
from toolkit.features.stores import FeatureStore, MatchStore, features_path, match_name, write_features, write_matches
from toolkit.files import SceneFiles, files_fingerprint, read_sidecar, require_current
from toolkit.mapping.local_map import map_path
from toolkit.results.opening import map_inputs
from toolkit.store.hdf5 import HDF5_ERRORS, group_names_of, has_group, read_group, write_groups
from toolkit.store.items import Items

log = logging.getLogger(__name__)

PIXEL_CENTER = "top_left_pixel_center"
"""Attribute of a file of features: the coordinate of the center of the top-left pixel."""
_HALF_PIXEL = np.float32(0.5)


def export_features(run: str | Path, scene: str, session: str, out: str | Path, kind: str = "sift") -> int:
    """Write the features of a session, such as `ios_map`, as a file of hloc, and return the number of images.

    Raise ArtifactError if the run has no such features, or several.
    """
    store = FeatureStore.open(only_features(SceneFiles(Path(run), scene), session, kind))
    write_groups(Path(out), ((name, _to_hloc(store[name])) for name in store), {PIXEL_CENTER: 0.0})
    return len(store)


def _to_hloc(features: LocalFeatures) -> dict[str, NDArray[Any]]:
    descriptors = features.descriptors
    if descriptors.dtype == np.uint8:  # without loss: a byte over a power of two has 8 significant bits, float16 has 11
        descriptors = (descriptors / np.float32(DESCRIPTOR_SCALE)).astype(np.float16)
    return {
        "keypoints": features.keypoints - _HALF_PIXEL,
        "scales": features.scales,
        "scores": features.scores,
        "descriptors": np.ascontiguousarray(descriptors.T),
        "image_size": np.array(features.image_size, np.int64),
    }


def import_features(path: str | Path, out: str | Path) -> FeatureStore:
    """Copy a file of features, by hloc or `export_features`, to a folder, and return its content.

    Raise ArtifactError if the file is missing, torn, or has no features in the layout of hloc.
    """
    path, made_from = Path(path), files_fingerprint([Path(path)])
    with _opened(path) as file, Items(out, {"name": "hloc"}) as items:
        offset = _HALF_PIXEL - np.float32(file.attrs.get(PIXEL_CENTER, 0.0))
        names = group_names_of(file, "keypoints")
        if not names:
            raise ArtifactError(f"{path} holds no local features; expected a group with `keypoints` for each image.")
        for name in names:
            try:
                features = _from_hloc(read_group(file, name), offset)
            except HDF5_ERRORS as error:
                why = f"{path}: {name} is not in the layout of hloc ({first_line(error)})."
                raise DamagedError(path, why) from None
            write_features(items, name, made_from, features)
    return FeatureStore.open(out)


def _from_hloc(arrays: Mapping[str, NDArray[Any]], offset: np.float32) -> LocalFeatures:
    """Return the features of an image; files of hloc may lack scores, and lack scales. Raise ValueError or KeyError."""
    keypoints = arrays["keypoints"].astype(np.float32, copy=False) + offset
    descriptors, (width, height) = arrays["descriptors"], arrays["image_size"].tolist()
    ones = np.ones(len(keypoints), np.float32)
    scales, scores = arrays.get("scales", ones), arrays.get("scores", ones)
    shapes = [keypoints.shape, scales.shape, scores.shape, descriptors.shape]
    count = shapes[0][0] if keypoints.ndim == 2 else 0
    if shapes != [(count, 2), (count,), (count,), (*descriptors.shape[:1], count)] or descriptors.dtype.kind != "f":
        raise ValueError(f"keypoints, scales, scores and {descriptors.dtype} descriptors have the shapes {shapes}")
    scales, scores = (array.astype(np.float32, copy=False) for array in (scales, scores))
    return LocalFeatures(keypoints, scales, scores, np.ascontiguousarray(descriptors.T), (int(width), int(height)))


def export_matches(
    run: str | Path, scene: str, session0: str, session1: str, out: str | Path, kind: str = "sift",
    capture: str | Path | None = None,
) -> int:  # fmt: skip
    """Write the matches of two sessions as a file of hloc, and return the number of pairs.

    Sessions are such as `ios_query` and `ios_map`; twice the same for the pairs of a map, whose `capture` may have
    moved. Raise ArtifactError if the run has no such matches, those of several settings or of older features, or pairs
    that hloc cannot tell apart.
    """
    files = SceneFiles(Path(run), scene)
    folder = files.maps / f"{session0}-{session1}"
    tiles = [Items(path) for path in sorted(folder.glob(f"{kind}-*")) if path.is_dir()]  # a large map has several
    made_by = [{key: value for key, value in tile.made_by.items() if key != "tile"} for tile in tiles if tile]
    if not made_by or any(other != made_by[0] for other in made_by):
        found = f"found matches of {kind} of {len(made_by)} settings, expected one"
        raise ArtifactError(f"{folder}: {found}. Delete this folder and run the localize stage again.")
    paths = zip((session0, session1), made_by[0]["features"], strict=True)
    first, second = (FeatureStore.open(features_path(files.features, *of_session)) for of_session in paths)
    of_map, path = session0 == session1, map_path(files.maps, session0, kind)
    if of_map and (read_sidecar(path) or {}).get("inputs"):
        require_current(path, "localize", inputs=map_inputs(session_of_run(run, scene, session0, capture), first))
    groups: dict[str, tuple[str, str]] = {}
    older: list[tuple[str, str]] = []

    def written() -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        for tile in tiles:
            matches = MatchStore(tile.folder, tile)
            for item in tile:
                name0, _, name1 = item.partition("\n")
                names = name0, name1
                if not of_map and tile.source(item) != first.made_from.get(name0, "") + second.made_from.get(name1, ""):
                    older.append(names)
                    continue
                if names != groups.setdefault(_group(*names), names):
                    other = groups[_group(*names)]
                    raise ArtifactError(f"{folder}: hloc cannot tell the pairs {names} and {other} apart. Rename one.")
                yield _group(*names), _matches_to_hloc(matches[names], len(first[names[0]]))

    write_groups(Path(out), written(), {})
    if older:
        log.warning("%s: %d pairs of older features are left out. Run the localize stage again.", folder, len(older))
    return len(groups)


def _matches_to_hloc(matches: PairMatches, count: int) -> dict[str, NDArray[Any]]:
    # 16 bits as in hloc; few networks find more features.
    matches0 = np.full(count, -1, np.int16 if matches.indices.max(initial=0) <= np.iinfo(np.int16).max else np.int32)
    scores = np.zeros(count, np.float16)
    matches0[matches.indices[:, 0]] = matches.indices[:, 1]
    scores[matches.indices[:, 0]] = matches.scores
    return {"matches0": matches0, "matching_scores0": scores}


def import_matches(path: str | Path, pairs: Iterable[tuple[str, str]], out: str | Path) -> MatchStore:
    """Copy matches of pairs of images, by name in either order, from a file of hloc to a folder; return its content.

    Raise ArtifactError if the file is missing, torn or of another layout, or lacks a pair.
    """
    path, made_from = Path(path), files_fingerprint([Path(path)])
    with _opened(path) as file, Items(out, {"name": "hloc"}) as items:
        for names in pairs:
            step = next((step for step in (1, -1) if has_group(file, _group(*names[::step]))), 0)
            if not step:
                raise ArtifactError(f"{path}: has no matches of {names[0]} and {names[1]}.")
            arrays = read_group(file, _group(*names[::step]))
            partners, scores = (arrays.get(key, np.zeros(())) for key in ("matches0", "matching_scores0"))
            if partners.ndim != 1 or partners.dtype.kind not in "iu" or scores.shape != partners.shape:
                expected = "expected matches0 (N,), whole numbers, and matching_scores0 (N,)"
                raise DamagedError(path, f"{path}: {names} are not in the layout of hloc; {expected}.")
            at = np.flatnonzero(partners >= 0)
            indices = np.stack([at, partners[at].astype(np.int64)], axis=1)[:, ::step]
            write_matches(items, match_name(*names), made_from, PairMatches(indices, scores[at].astype(np.float32)))
    return MatchStore(out)


def _group(name0: str, name1: str) -> str:
    return f"{name0.replace('/', '-')}/{name1.replace('/', '-')}"


def _opened(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise ArtifactError(f"{path} cannot be read as HDF5 ({first_line(error)}).") from None
