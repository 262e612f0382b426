"""The K most similar map images of every query image, for all map x query device pairs."""

import json
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session
from toolkit.embedders import load_embeddings
from toolkit.errors import ArtifactError, ManifestError, ToolkitError
from toolkit.files import (
    file_fingerprint,
    fingerprint,
    is_current,
    pair_name,
    sidecar_path,
    write_atomic,
    write_sidecar,
)
from toolkit.manifest import RetrieveSettings
from toolkit.models.compute import resolve_device

log = logging.getLogger(__name__)

Backend = Literal["faiss", "torch"]
_BLOCK_BYTES = 64 << 20


def search(
    query: ArrayLike,
    database: ArrayLike,
    k: int,
    backend: Backend = "faiss",
    compute_device: str = "cpu",
    faiss_gpu: bool = False,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the rows of the database with the largest dot products, best first; equal ones by index.

    The backend finds candidates; their scores are then computed alike for all backends, so that the result
    does not depend on it.

    Args:
        query: (Q, D), any float type.
        database: (N, D).
        k: how many; at most N are returned.
        backend: `faiss` or `torch`.
        compute_device: where torch computes: `auto`, `cpu`, `cuda`, `cuda:<i>`, `mps`.
        faiss_gpu: let faiss compute on the GPU (needs a faiss built for it).

    Returns:
        Scores (Q, K) float32 and indices (Q, K) int64, K = min(k, N).

    Raises:
        ValueError: shapes do not fit, k is below 1, or a value is not finite.
    """
    query, database = _matrix(query, "query"), _matrix(database, "database")
    if query.shape[1] != database.shape[1]:
        raise ValueError(f"query has {query.shape[1]} dimensions, the database {database.shape[1]}.")
    if k < 1:
        raise ValueError(f"k is {k}; expected at least 1.")
    count = len(database)
    k = min(k, count)
    scores, indices = np.zeros((len(query), k), np.float32), np.zeros((len(query), k), np.int64)
    if not len(query) or not k:
        return scores, indices
    norm = float(np.sqrt((database**2).sum(axis=1).max()))
    tolerance = 1e-5 * norm * np.linalg.norm(query, axis=1)
    pending, width = np.arange(len(query)), min(count, k + 16)
    while len(pending):
        found, candidates = _candidates(query[pending], database, width, backend, compute_device, faiss_gpu)
        # Rounding in the backend cuts nothing off once the last candidate is clearly below rank k.
        done = (found[:, -1] < found[:, k - 1] - tolerance[pending]) | (width == count)
        rows = pending[done]
        step = max(1, _BLOCK_BYTES // (8 * width * query.shape[1]))
        for start in range(0, len(rows), step):
            part, chosen = rows[start : start + step], np.sort(candidates[done][start : start + step], axis=1)
            exact = np.einsum(
                "qd,qkd->qk", query[part].astype(np.float64), database[chosen].astype(np.float64)
            )
            exact = exact.astype(np.float32)
            order = np.argsort(-exact, axis=1, kind="stable")[:, :k]
            scores[part] = np.take_along_axis(exact, order, axis=1)
            indices[part] = np.take_along_axis(chosen, order, axis=1)
        pending, width = pending[~done], min(count, 4 * width)
    return scores, indices


def retrieve_pairs(
    sessions_root: str | Path,
    map_feats_root: str | Path,
    out_jsonl: str | Path | None = None,
    settings: RetrieveSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    queries: str = "keyframes_pruned_subsampled",
    skip_existing: bool = True,
) -> pd.DataFrame:
    """Write, for every pair of devices, one JSON line a query image with its `topk` map images.

    Args:
        sessions_root: `<capture>/sessions`.
        map_feats_root: the embeddings folder, of map and query sessions.
        out_jsonl: a folder, or for one pair a file `*.jsonl`; `<map_feats_root>/../retrieval` where None.
        settings: see `RetrieveSettings`; a dict holds what differs from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` that the capture has.
        queries: the keyframe list that says which devices are asked for, or `all`.
        skip_existing: reuse files made from the same embeddings, poses and settings.

    Returns:
        One row a pair: map_device, query_device, keyframes, keyframes_missing (no image of theirs has an
        embedding), queries and images_missing (images of the keyframes, with and without an embedding),
        database, unposed (map images left out for want of a pose), seconds, skipped, path.

    Raises:
        ToolkitError: see the message: unknown device or list, embeddings missing or of different dimensions.
    """
    settings = RetrieveSettings.of(settings)
    capture = Capture.from_sessions_root(sessions_root)
    maps = capture.devices_with("map", map_device)
    askers = capture.devices_with("query", query_device)
    embeddings = Path(map_feats_root)
    out = Path(out_jsonl) if out_jsonl is not None else embeddings.parent / "retrieval"
    if out.suffix == ".jsonl" and len(maps) * len(askers) != 1:
        raise ManifestError(
            f"out_jsonl is one file ({out}) for {len(maps) * len(askers)} pairs; give a folder."
        )
    asked = [_load_queries(capture[f"{device}_query"], embeddings, queries) for device in askers]
    table = []
    for device in maps:
        database: _Images | None = None
        for query in asked:
            started = time.perf_counter()
            path = (
                out
                if out.suffix == ".jsonl"
                else out / f"{pair_name(capture.name, device, query.session.device)}.jsonl"
            )
            session = capture[f"{device}_map"]
            record = {
                "map": _inputs(session, embeddings),
                "query": _inputs(query.session, embeddings),
                "rows": fingerprint(query.rows.tolist()),
                "topk": settings.topk,
                "normalize": settings.normalize,
            }
            skipped = skip_existing and is_current(path, record)
            if database is None:
                database = _load_database(session, embeddings)
            if not skipped:
                _write_pair(path, query, database, settings)
                write_sidecar(path, record)
            table.append(
                {
                    "map_device": device,
                    "query_device": query.session.device,
                    "keyframes": query.keyframes,
                    "keyframes_missing": query.keyframes_missing,
                    "queries": len(query.rows),
                    "images_missing": query.images_missing,
                    "database": len(database.rows),
                    "unposed": database.unposed,
                    "seconds": round(time.perf_counter() - started, 3),
                    "skipped": skipped,
                    "path": str(path),
                }
            )
    return pd.DataFrame(table)


@dataclass(frozen=True)
class _Images:
    """Embedded images of a session: rows of `session.images` with their vectors and lines of manifest."""

    session: Session
    rows: NDArray[np.int64]
    vectors: NDArray[np.float32]
    table: pd.DataFrame
    keyframes: int = 0
    keyframes_missing: int = 0
    images_missing: int = 0
    unposed: int = 0


def _load(session: Session, embeddings: Path) -> _Images:
    folder = embeddings / session.id
    vectors, table = load_embeddings(folder)
    names = table["abs_path"].str.split(f"/sessions/{session.path.name}/raw_data/", n=1, regex=False).str[-1]
    rows = pd.Index(session.images["path"]).get_indexer(names)
    if (rows < 0).any():
        raise ArtifactError(
            f"{folder}: {(rows < 0).sum()} embedded images are not in {session.path / 'images.txt'}, first "
            f"{table['abs_path'][int(np.argmax(rows < 0))]}. They are of another capture: embed again."
        )
    return _Images(session, rows, vectors, table)


def _load_database(session: Session, embeddings: Path) -> _Images:
    images = _load(session, embeddings)
    posed = np.isfinite(session.world_from_cam(images.rows)).reshape(-1, 16).all(axis=1)
    if not posed.any():
        raise ToolkitError(
            f"No embedded image of {session.id} has a pose ({session.path / 'trajectories.txt'})."
        )
    if not posed.all():
        log.warning(
            "%s: %d of %d images have no pose and are left out", session.id, np.sum(~posed), posed.size
        )
    return _Images(
        session, images.rows[posed], images.vectors[posed], images.table[posed].reset_index(drop=True),
        unposed=int(np.sum(~posed)),
    )  # fmt: skip


def _load_queries(session: Session, embeddings: Path, queries: str) -> _Images:
    keyframes = session.keyframes(queries)
    images = _load(session, embeddings)
    wanted = session.rows_of_keyframes(keyframes)
    position = np.full(len(session.images), -1)
    position[images.rows] = np.arange(len(images.rows))
    missing = [index for index, rows in enumerate(wanted) if not (position[rows] >= 0).any()]
    if missing:
        first = keyframes.iloc[missing[0]]
        log.warning(
            "%s: %d of %d keyframes have no embedded image and are not searched for, first (%s, %s)",
            session.id, len(missing), len(keyframes), first["timestamp"], first["device_id"],
        )  # fmt: skip
    rows = np.unique(np.concatenate([np.zeros(0, np.int64), *wanted]))
    chosen = position[rows][position[rows] >= 0]
    return _Images(
        session,
        images.rows[chosen],
        images.vectors[chosen],
        images.table.iloc[chosen].reset_index(drop=True),
        keyframes=len(keyframes),
        keyframes_missing=len(missing),
        images_missing=len(rows) - len(chosen),
    )


def _write_pair(
    path: Path,
    query: _Images,
    database: _Images,
    settings: RetrieveSettings,
) -> None:
    pair = f"map {database.session.id}, query {query.session.id}"
    if query.vectors.shape[1] != database.vectors.shape[1]:
        raise ArtifactError(
            f"{pair}: the map's embeddings have {database.vectors.shape[1]} dimensions, the query's "
            f"{query.vectors.shape[1]}. They are of different models: embed both again with one."
        )
    asked, known = (_unit(part.vectors) if settings.normalize else part.vectors for part in (query, database))
    try:
        scores, indices = search(
            asked,
            known,
            settings.topk,
            "faiss" if settings.use_faiss else "torch",
            settings.compute_device,
            settings.faiss_gpu,
        )
    except ValueError as error:
        raise ArtifactError(f"{pair}: {error}") from error
    world_from_sensor = database.session.world_from_cam(database.rows).tolist()
    rig_from_sensor = query.session.rig_from_cam(query.rows).tolist()
    references = _records(database.table)
    with write_atomic(path) as temporary, open(temporary, "w", encoding="utf-8") as stream:
        lines = zip(_records(query.table), rig_from_sensor, scores.tolist(), indices.tolist(), strict=True)
        for image, pose, row_scores, row_indices in tqdm(
            lines, total=len(scores), desc=f"retrieve {path.stem}"
        ):
            record = {
                key: image[key] for key in ("path", "subsession", "device_id", "sensor_id", "timestamp")
            }
            record["Trs"] = pose
            record["topk"] = [
                {
                    "rank": rank,
                    "score": score,
                    **{
                        key: references[index][key]
                        for key in ("subsession", "timestamp", "sensor_id", "path")
                    },
                    "Tws": world_from_sensor[index],
                }
                for rank, (score, index) in enumerate(zip(row_scores, row_indices, strict=True), start=1)
            ]
            stream.write(json.dumps(record) + "\n")


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    strings = table.assign(timestamp=table["timestamp"].astype(str)).rename(columns={"abs_path": "path"})
    return strings.to_dict("records")


def _inputs(session: Session, embeddings: Path) -> list[Any]:
    """Identify what a session contributes to a pair's file: its embeddings, poses and calibration."""
    matrices = sorted((embeddings / session.id).rglob("*.npy"))
    texts = [session.path / name for name in ("images.txt", "trajectories.txt", "rigs.txt")]
    return [
        # The record beside a matrix says what it was made from, and is small; a foreign matrix may have none.
        [
            [path.name, file_fingerprint(sidecar_path(path) if sidecar_path(path).exists() else path)]
            for path in matrices
        ],
        [file_fingerprint(path) for path in texts if path.exists()],
    ]


def _matrix(values: ArrayLike, name: str) -> NDArray[np.float32]:
    matrix = np.ascontiguousarray(values, np.float32)
    if matrix.ndim != 2:
        raise ValueError(f"{name} has shape {matrix.shape}; expected two dimensions, one row a vector.")
    bad = ~np.isfinite(matrix).all(axis=1)
    if bad.any():
        raise ValueError(
            f"{name} has {bad.sum()} rows with NaN or infinite values, first row {int(bad.argmax())}."
        )
    return matrix


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    unit: NDArray[np.float32] = rows / np.maximum(
        np.linalg.norm(rows, axis=1, keepdims=True), np.float32(1e-12)
    )
    return unit


def _candidates(
    query: NDArray[np.float32],
    database: NDArray[np.float32],
    width: int,
    backend: Backend,
    compute_device: str,
    faiss_gpu: bool,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the `width` best (scores, indices) (Q, width) of each query, best first, up to rounding."""
    if backend == "torch":
        return _torch_candidates(query, database, width, compute_device)
    if backend != "faiss":
        raise ValueError(f"Unknown backend {backend!r}; expected faiss or torch.")
    import faiss

    if not faiss_gpu:
        scores, indices = faiss.knn(query, database, width, metric=faiss.METRIC_INNER_PRODUCT)
        return scores, indices
    if not hasattr(faiss, "StandardGpuResources"):
        raise ToolkitError(
            "faiss_gpu is set, but the installed faiss has no GPU support (faiss-cpu). "
            "Set faiss_gpu: false, or use_faiss: false with compute_device: cuda."
        )
    scores, indices = faiss.knn_gpu(
        faiss.StandardGpuResources(), query, database, width, metric=faiss.METRIC_INNER_PRODUCT
    )
    return scores, indices


def _torch_candidates(
    query: NDArray[np.float32], database: NDArray[np.float32], width: int, compute_device: str
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Search the database in blocks, so that the scores of all its rows are never in memory together."""
    import torch

    device = resolve_device(compute_device)
    queries = torch.from_numpy(query).to(device)
    scores = torch.zeros((len(query), 0), device=device)
    indices = torch.zeros((len(query), 0), dtype=torch.int64, device=device)
    step = max(1, _BLOCK_BYTES // (4 * len(query)))
    for start in range(0, len(database), step):
        block = queries @ torch.from_numpy(database[start : start + step]).to(device).T
        numbers = torch.arange(start, start + block.shape[1], device=device).expand(block.shape)
        scores, best = torch.cat([scores, block], 1).topk(min(width, scores.shape[1] + block.shape[1]))
        indices = torch.cat([indices, numbers], 1).gather(1, best)
    return scores.cpu().numpy(), indices.cpu().numpy()
