"""The retrieve stage: the K most similar map images of every query image, for all pairs of map and query device."""

import json
import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.session import SUBSESSIONS
from toolkit.capture.tables import SIGNALS
from toolkit.embedders import Vectors, embedding_folders, load_embeddings, open_descriptors
from toolkit.embedders.masks import Masks, combine, gps_masks, pose_masks, radio_masks
from toolkit.embedders.search import (
    EXACT,
    Backend,
    Found,
    is_index_current,
    make_index,
    matrix_fingerprints,
    require_same_embedder,
    search,
)
from toolkit.errors import ArtifactError, CaptureError, ManifestError
from toolkit.files import file_fingerprint, fingerprint, is_current, pair_name, write_atomic, write_sidecar
from toolkit.geometry import Ints
from toolkit.manifest import MaskSettings, RetrieveSettings
from toolkit.runs.pairs import PairRows

__all__ = ["load_embeddings", "retrieve_pairs", "search"]

log = logging.getLogger(__name__)

_INDEX_SETTINGS = {"index", "index_candidates", "nprobe"}
MAX_ANGLE_DEG = 90.0
"""Largest angle between the viewing directions of a rough pose and a map camera, degrees; roll is ignored."""
GPS_MARGIN_M = 25.0
"""Largest distance between two GPS fixes, meters, beyond twice the sum of their stated accuracies."""
RADIO_SHARE = 0.025
"""Share of the map images that a radio mask keeps, as in the benchmark."""
WINDOW_S = 2.0
"""Largest time difference between an image and the radio scans and GPS fixes used for it, seconds."""
_CHOICE = 3
"""Map images that a radio mask leaves per reference, at least. Radio knows the place but not the viewing direction, so
the descriptors must have some to choose from."""


def retrieve_pairs(
    sessions_root: str | Path,
    map_feats_root: str | Path,
    out_jsonl: str | Path | None = None,
    settings: RetrieveSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    pairs: Sequence[Sequence[str]] | None = None,
    queries: str = "keyframes_pruned_subsampled",
    skip_existing: bool = True,
) -> pd.DataFrame:
    """Write, for every pair of devices, one JSON line per query image with its `topk` map images.

    Args:
        sessions_root: `<capture>/sessions`.
        map_feats_root: the embeddings folder, of map and query sessions.
        out_jsonl: a folder, or for one pair a file `*.jsonl`; None: `<map_feats_root>/../retrieval`.
        settings: see `RetrieveSettings`; a dict needs only the values that differ from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` devices of the capture.
        pairs: only these [map device, query device]; None: all of the chosen devices.
        queries: name of the keyframe list whose keyframes are the queries, or `all`.
        skip_existing: reuse files made from the same embeddings, poses and settings.

    Returns:
        One row per pair: map_device, query_device, keyframes, keyframes_missing (without any embedded image),
        query_images and images_missing (images of the keyframes, with and without an embedding), database, unposed
        (map images left out because they have no pose), seconds, skipped, path, reason. A pair that fails has zeros
        and the `reason`. For each mask in the settings, such as `radio`, also without_radio: the number of queries
        that it leaves the whole map.

    Raises:
        ToolkitError: unknown device; the file of `mask.poses` is missing or malformed; or all pairs fail: there is no
            such list, embeddings are missing or have different dimensions. The message says which.
    """
    settings = RetrieveSettings.of(settings)
    capture = Capture.from_sessions_root(sessions_root)
    chosen = capture.pairs(map_device, query_device, pairs)
    embeddings = Path(map_feats_root)
    out = Path(out_jsonl) if out_jsonl is not None else embeddings.parent / "retrieval"
    if out.suffix == ".jsonl" and len(chosen) != 1:
        raise ManifestError(f"out_jsonl is one file ({out}) for {len(chosen)} pairs; give a folder.")
    folder = out.parent if out.suffix == ".jsonl" else out
    table = PairRows(capture.name, folder)
    if (rough := settings.mask.poses) is not None and not Path(rough).is_file():
        raise ManifestError(f"retrieve.mask.poses: found no file {rough}. Expected poses as in trajectories.txt.")
    poses = None if rough is None else Trajectory.read(rough)

    @cache
    def load_queries(device: str) -> _Images:
        return _load_queries(capture[f"{device}_query"], embeddings, queries, settings.normalize)

    @lru_cache(maxsize=1)
    def load_database(device: str) -> _Images:
        return _load_database(capture[f"{device}_map"], embeddings, settings.normalize)

    for map_device in dict.fromkeys(of_map for of_map, _ in chosen):
        todo: dict[str, tuple[_Images, Path, dict[str, Any]]] = {}
        for device in (query for of_map, query in chosen if of_map == map_device):
            with table.row(map_device, device) as row:
                query, database = load_queries(device), load_database(map_device)
                path = out if out.suffix == ".jsonl" else out / f"{pair_name(capture.name, map_device, device)}.jsonl"
                record = {
                    "map": _inputs(database.session, embeddings),
                    "query": _inputs(query.session, embeddings),
                    "rows": fingerprint(query.rows.tolist()),
                    "topk": settings.topk,
                    "normalize": settings.normalize,
                    **({} if settings.index == EXACT else settings.model_dump(include=_INDEX_SETTINGS)),
                    **_mask_record(settings.mask, database.session, query.session),
                }
                masks, without = _masks(settings, poses, database, query)
                skipped = skip_existing and is_current(path, record)
                # Single images that are localized later search the map's index, too.
                skipped = skipped and is_index_current(embeddings, database.session.id, database.vectors, settings)
                if not skipped:
                    _require_same_dimension(query, database)
                    require_same_embedder(query.vectors, database.vectors)
                    todo[device] = replace(query, masks=masks), path, record
                row |= query.counts | database.counts | without | {"skipped": skipped, "path": str(path)}
        if not todo:
            continue
        found: dict[str, Found] = {}
        started = time.perf_counter()
        find = partial(_search, database=database, settings=settings, embeddings=embeddings, rebuild=not skip_existing)
        with suppress(ArtifactError):  # a value is not finite: search pair by pair, so that only its row fails
            found = find({device: query for device, (query, _, _) in todo.items()})
        shared = (time.perf_counter() - started) / len(todo)
        for device, (query, path, record) in todo.items():
            with table.row(map_device, device) as row:
                found = found or find({device: query})
                _write_pair(path, query, database, found.pop(device))
                write_sidecar(path, record, made_from=_matrices(query.session, database.session, embeddings=embeddings))
                row["seconds"] += shared
    return table.frame(settings)


def index_maps(
    sessions_root: str | Path, map_feats_root: str | Path, out_dir: str | Path, settings: RetrieveSettings,
    devices: Sequence[str],
) -> None:  # fmt: skip
    """Do what `retrieve_pairs` does for the maps of `devices`, without queries: indexes, and the settings in a file.

    Raise CaptureError or ArtifactError if a map has no embedded image with a pose, or a value is not finite.
    """
    capture, embeddings = Capture.from_sessions_root(sessions_root), Path(map_feats_root)
    for device in devices:
        database = _load_database(capture[f"{device}_map"], embeddings, settings.normalize)
        try:
            make_index(embeddings, database.session.id, database.vectors, settings)
        except ValueError as error:
            raise ArtifactError(f"map {database.session.id}: {error}") from error
    PairRows(capture.name, Path(out_dir)).frame(settings)


@dataclass(frozen=True)
class _Images:
    """Embedded images of a session."""

    session: Session
    rows: Ints
    """Rows of `session.images`."""
    vectors: Vectors
    table: pd.DataFrame
    """Their lines of the manifests."""
    counts: dict[str, int] = field(default_factory=dict)
    """Columns of a pair's row."""
    masks: Masks | None = None
    """For query images: the map images that each may find."""

    def take(self, positions: Ints) -> "_Images":
        table = self.table.iloc[positions].reset_index(drop=True)
        return replace(self, rows=self.rows[positions], vectors=self.vectors.choose(positions), table=table)


def _load(session: Session, embeddings: Path, normalize: bool) -> _Images:
    vectors, table = open_descriptors(embeddings, session.id, normalize)
    names = table["abs_path"].str.split(f"/sessions/{session.path.name}/raw_data/", n=1, regex=False).str[-1]
    rows = pd.Index(session.images["path"]).get_indexer(names)
    if (rows < 0).any():
        first = table["abs_path"][int(np.argmax(rows < 0))]
        fault = f"{(rows < 0).sum()} embedded images are not in {session.path / 'images.txt'}, first {first}"
        raise ArtifactError(f"{embeddings / session.id}: {fault}. They belong to another capture: embed again.")
    return _Images(session, rows, vectors, table)


def _load_database(session: Session, embeddings: Path, normalize: bool) -> _Images:
    images = _load(session, embeddings, normalize)
    posed = np.isfinite(session.world_from_cam(images.rows)).reshape(-1, 16).all(axis=1)
    if not posed.any():
        raise CaptureError(f"No embedded image of {session.id} has a pose ({session.path / 'trajectories.txt'}).")
    if not posed.all():
        log.warning("%s: %d of %d images have no pose and are left out", session.id, np.sum(~posed), posed.size)
    counts = {"database": int(posed.sum()), "unposed": int(np.sum(~posed))}
    return replace(images.take(np.flatnonzero(posed)), counts=counts)


def _load_queries(session: Session, embeddings: Path, queries: str, normalize: bool) -> _Images:
    keyframes = session.keyframes(queries)
    images = _load(session, embeddings, normalize)
    rows_of_each = session.rows_of_keyframes(keyframes)
    position = np.full(len(session.images), -1)
    position[images.rows] = np.arange(len(images.rows))
    missing = [index for index, rows in enumerate(rows_of_each) if not (position[rows] >= 0).any()]
    if missing:
        first = keyframes.iloc[missing[0]]
        log.warning(
            "%s: %d of %d keyframes have no embedded image and are not searched for, first (%s, %s)",
            session.id, len(missing), len(keyframes), first["timestamp"], first["device_id"],
        )  # fmt: skip
    rows = np.unique(np.concatenate([np.zeros(0, np.int64), *rows_of_each]))
    chosen = position[rows][position[rows] >= 0]
    counts = {"keyframes": len(keyframes), "keyframes_missing": len(missing), "query_images": len(chosen)}
    return replace(images.take(chosen), counts=counts | {"images_missing": len(rows) - len(chosen)})


def _require_same_dimension(query: _Images, database: _Images) -> None:
    if query.vectors.dims != database.vectors.dims:
        ours, theirs = (" + ".join(map(str, images.vectors.dims)) for images in (database, query))
        fault = f"the map's embeddings have {ours} dimensions, the query's {theirs}"
        place = f"map {database.session.id}, query {query.session.id}"
        raise ArtifactError(f"{place}: {fault}. Embed both again with the same model.")


def _search(
    queries: Mapping[str, _Images], database: _Images, settings: RetrieveSettings, embeddings: Path, rebuild: bool
) -> dict[str, Found]:
    """Return the best map images of several sets of queries, with one pass over the map; all values must be finite."""
    stacked = Vectors.stack([query.vectors for query in queries.values()])
    backend: Backend = "faiss" if settings.use_faiss else "torch"
    masks = [query.masks for query in queries.values() if query.masks is not None]
    try:
        index = make_index(embeddings, database.session.id, database.vectors, settings, not rebuild)
        found = search(
            stacked, database.vectors, settings.topk, backend, settings.compute_device, settings.faiss_gpu, index,
            Masks.stack(masks) if masks else None, database.vectors.dims,
        )  # fmt: skip
    except ValueError as error:
        names = ", ".join(query.session.id for query in queries.values())
        raise ArtifactError(f"map {database.session.id}, query {names}: {error}") from error
    cuts = np.cumsum([len(query.rows) for query in queries.values()])[:-1]
    return dict(zip(queries, zip(*(np.split(array, cuts) for array in found), strict=True), strict=True))


def _write_pair(path: Path, query: _Images, database: _Images, found: Found) -> None:
    scores, indices = found
    world_from_sensor = database.session.world_from_cam(database.rows).tolist()
    rig_from_sensor = query.session.rig_from_cam(query.rows).tolist()
    map_images = _records(database.table, "subsession", "timestamp", "sensor_id", "path")
    query_images = _records(query.table, "path", "subsession", "device_id", "sensor_id", "timestamp")
    with write_atomic(path) as temporary, open(temporary, "w", encoding="utf-8") as stream:
        lines = zip(query_images, rig_from_sensor, scores.tolist(), indices.tolist(), strict=True)
        for image, pose, image_scores, best in tqdm(lines, total=len(query_images), desc=f"retrieve {path.stem}"):
            topk = [
                {"rank": rank, "score": score, **map_images[index], "Tws": world_from_sensor[index]}
                for rank, (score, index) in enumerate(zip(image_scores, best, strict=True), start=1)
                if index >= 0
            ]
            stream.write(json.dumps({**image, "Trs": pose, "topk": topk}) + "\n")


def _records(table: pd.DataFrame, *columns: str) -> list[dict[str, Any]]:
    strings = table.assign(timestamp=table["timestamp"].astype(str)).rename(columns={"abs_path": "path"})
    return strings[list(columns)].to_dict("records")


def _inputs(session: Session, embeddings: Path) -> list[Any]:
    """Return fingerprints of a session's embeddings, poses and calibration, on which a pair's file depends."""
    matrices = _matrices(session, embeddings=embeddings)
    texts = [session.path / name for name in ("images.txt", "trajectories.txt", "rigs.txt")]
    return [matrix_fingerprints(matrices), [file_fingerprint(path) for path in texts if path.exists()]]


def _matrices(*sessions: Session, embeddings: Path) -> list[Path]:
    """Return the files of the sessions' embeddings."""
    folders = [folder / session.id for session in sessions for folder in embedding_folders(embeddings).values()]
    return [path for folder in folders for path in sorted(folder.rglob("*.npy"))]


def _masks(
    settings: RetrieveSettings, poses: Trajectory | None, database: _Images, query: _Images
) -> tuple[Masks | None, dict[str, int]]:
    """Return the map images that each query image may find, None: all; and columns of the pair's row."""
    mask = settings.mask
    images = (database.session, database.rows), (query.session, query.rows)
    priors = dict[str, Masks]()
    if poses is not None:
        priors["poses"] = pose_masks(poses, *images, mask.poses_distance, MAX_ANGLE_DEG)
    if mask.gps:
        priors["gps"] = gps_masks(*images, GPS_MARGIN_M, WINDOW_S)
    if mask.radio:
        least = max(_CHOICE * settings.topk, int(np.ceil(RADIO_SHARE * len(database.rows))))
        priors["radio"] = radio_masks(*images, least, WINDOW_S)
    if not priors:
        return None, {}
    masks, counts = combine(list(priors.values()))
    for prior, count in zip(priors, counts, strict=True):
        if count:
            message = "map %s, query %s: %s leaves the whole map to %d of %d query images"
            log.warning(message, database.session.id, query.session.id, prior, count, len(masks))
    return masks, {f"without_{prior}": count for prior, count in zip(priors, counts, strict=True)}


def _mask_record(settings: MaskSettings, *sessions: Session) -> dict[str, Any]:
    """Return the settings and fingerprints of the files that masks depend on; empty without masks."""
    record: dict[str, Any] = {}
    names: list[str] = []
    if settings.poses:
        record["poses"] = [file_fingerprint(settings.poses), settings.poses_distance, MAX_ANGLE_DEG]
    if settings.gps:
        record["gps"], names = [GPS_MARGIN_M, WINDOW_S], ["gps.txt"]
    if settings.radio:
        record["radio"], names = [RADIO_SHARE, WINDOW_S], [*names, *SIGNALS]
    if names:
        paths = [session.path / name for session in sessions for name in (*names, SUBSESSIONS)]
        record["files"] = [file_fingerprint(path) if path.exists() else None for path in paths]
    return {"mask": record} if record else {}
