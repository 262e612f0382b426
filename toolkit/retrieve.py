"""The retrieve stage: the K most similar map images of every query image, for all pairs of map and query device."""

import json
import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session
from toolkit.embedders import Vectors, embedding_folders, load_embeddings
from toolkit.embedders.embedded import Embedded
from toolkit.embedders.masks import Masks, Priors
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
from toolkit.errors import ArtifactError, ManifestError
from toolkit.files import file_fingerprint, fingerprint, is_current, pair_name, write_atomic, write_sidecar
from toolkit.manifest import RetrieveSettings
from toolkit.runs.pairs import PairRows

__all__ = ["load_embeddings", "retrieve_pairs", "search"]

log = logging.getLogger(__name__)

_INDEX_SETTINGS = {"index", "index_candidates", "nprobe"}


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
    priors = Priors(settings.mask)
    if settings.mask.poses is not None:  # an open map reads the file again, from another folder perhaps
        mask = settings.mask.model_copy(update={"poses": str(Path(settings.mask.poses).resolve())})
        settings = settings.model_copy(update={"mask": mask})

    @cache
    def load_queries(device: str) -> Embedded:
        return _load_queries(capture[f"{device}_query"], embeddings, queries, settings.normalize)

    @lru_cache(maxsize=1)
    def load_database(device: str) -> Embedded:
        return _load_database(capture[f"{device}_map"], embeddings, settings.normalize)

    for map_device in dict.fromkeys(of_map for of_map, _ in chosen):
        todo: dict[str, tuple[Embedded, Path, dict[str, Any]]] = {}
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
                    **priors.record(database.session, query.session),
                }
                images = (database.session, database.rows), (query.session, query.rows)
                masks, without = priors.masks(*images, settings.topk)
                for prior, count in without.items():
                    if count:
                        message = "map %s, query %s: %s leaves the whole map to %d of %d query images"
                        log.warning(message, database.session.id, query.session.id, prior, count, len(query.rows))
                skipped = skip_existing and is_current(path, record)
                # Single images that are localized later search the map's index, too.
                skipped = skipped and is_index_current(embeddings, database.session.id, database.vectors, settings)
                if not skipped:
                    require_same_embedder(query.vectors, database.vectors)
                    todo[device] = replace(query, masks=masks), path, record
                row |= query.counts | database.counts | {f"without_{prior}": count for prior, count in without.items()}
                row |= {"skipped": skipped, "path": str(path)}
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


def _load_database(session: Session, embeddings: Path, normalize: bool) -> Embedded:
    images = Embedded.of_map(session, embeddings, normalize)
    if unposed := images.counts["unposed"]:
        count = sum(images.counts.values())
        log.warning("%s: %d of %d images have no pose and are left out", session.id, unposed, count)
    return images


def _load_queries(session: Session, embeddings: Path, queries: str, normalize: bool) -> Embedded:
    keyframes = session.keyframes(queries)
    images = Embedded.open(session, embeddings, normalize)
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


def _search(
    queries: Mapping[str, Embedded], database: Embedded, settings: RetrieveSettings, embeddings: Path, rebuild: bool
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


def _write_pair(path: Path, query: Embedded, database: Embedded, found: Found) -> None:
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
