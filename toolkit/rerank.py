"""The rerank stage: orders the references of every query image by the number of matches that fit one relative pose.

Global descriptors confuse places that look alike. Images of different places rarely have many local matches that also
fit one essential matrix of the two calibrated cameras, so the right reference comes first.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session
from toolkit.capture.images import default_workers, prefetch
from toolkit.capture.upright import Turns, upright_turns
from toolkit.errors import INTERNAL, ArtifactError, reason_of
from toolkit.features.features import KINDS
from toolkit.features.matching import LocalMethod, Verifier, create_local_methods, resolve_auto
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import (
    file_fingerprint,
    fingerprint,
    image_name,
    is_current,
    pair_name,
    read_references,
    write_sidecar,
    write_text,
)  # fmt: skip
from toolkit.geometry import Ints
from toolkit.manifest import RerankSettings
from toolkit.runs.pairs import PairRows
from toolkit.store.items import Items, items_beside, remove_items, retry_damaged
from toolkit.threads import one_thread


@retry_damaged
def rerank_pairs(
    sessions_root: str | Path,
    retrieval_dir: str | Path,
    features_dir: str | Path,
    out_dir: str | Path,
    settings: RerankSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    pairs: Sequence[Sequence[str]] | None = None,
    skip_existing: bool = True,
    workers: int = 0,
) -> pd.DataFrame:
    """Write, for every pair of devices, the references of each query image in order of verified matches.

    The files have the retrieval stage's format. `score` is the number of verified matches, which fit one essential
    matrix, or 0 if as many occur by chance; references with equal scores keep their order. Each reference also has
    `retrieval_score`, `retrieval_rank`, and `num_matches`, of which the verified ones are a part. A query image that
    cannot be verified keeps the order of retrieval, and its `reason` says why. Every image of a rig is verified
    separately.

    Args:
        sessions_root: `<capture>/sessions`.
        retrieval_dir: folder of the retrieval stage's files.
        features_dir: folder of local features, shared with the other stages.
        out_dir: folder of the reranked files.
        settings: see `RerankSettings`; a dict needs only the values that differ from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` devices of the capture.
        pairs: only these [map device, query device]; None: all of the chosen devices.
        skip_existing: reuse files made from the same inputs and settings, and continue a killed run.
        workers: threads; 0: one per core.

    Returns:
        One row per pair: map_device, query_device, query_images = confirmed + kept, changed (confirmed query images
        with a new first reference), seconds, skipped, path, reason. A pair that fails has zeros and the `reason`.

    Raises:
        ManifestError: topk is below 1 or above topn; unknown features, or a matcher that does not suit them.
        WeightsError: the weights of a network are missing.
        CaptureError: unknown device.
        ArtifactError: all pairs fail, and the retrieval of one is missing, torn, or of another capture.
    """
    settings = resolve_auto(RerankSettings.of(settings))
    capture = Capture.from_sessions_root(sessions_root)
    (method,) = create_local_methods(settings)
    turns = upright_turns(capture, settings.world_up) if KINDS[method.name].upright else None
    workers = workers or default_workers()
    table = PairRows(capture.name, Path(out_dir), Path(retrieval_dir))
    with one_thread():  # queries are the parallel dimension
        for devices in capture.pairs(map_device, query_device, pairs):
            with table.row(*devices) as row:
                table.check_upstream()
                sessions = capture[f"{devices[0]}_map"], capture[f"{devices[1]}_query"]
                name = f"{pair_name(capture.name, *devices)}.jsonl"
                pair = _Pair(*sessions, Path(retrieval_dir) / name, Path(out_dir) / name, method, settings, turns)
                skipped = skip_existing and is_current(pair.path, pair.record)
                if skipped:
                    remove_items(pair.path)
                else:
                    pair.rerank(Path(features_dir), workers, skip_existing)
                row |= _counts(read_references(pair.path)) | {"skipped": skipped, "path": str(pair.path)}
    return table.frame(settings)


@dataclass(frozen=True)
class _Pair:
    """A map session and a query session, the retrieved and the reranked file, and how to match images."""

    map_session: Session
    query_session: Session
    retrieval: Path
    path: Path
    """The reranked file."""
    method: LocalMethod
    settings: RerankSettings
    turns: Turns | None
    """Turns that make images upright for the features; None shows them as stored."""

    @cached_property
    def record(self) -> dict[str, Any]:
        """Settings and fingerprints of the inputs of the reranked file."""
        if not self.retrieval.exists():
            read_references(self.retrieval)  # raises the error that says what to do
        sessions = self.map_session, self.query_session
        return {
            "retrieval": file_fingerprint(self.retrieval),
            "features": self.method.extractor.settings,
            "matcher": self.method.matcher.settings,
            **self.settings.model_dump(exclude={"features", "matcher", "compute_device", "dtype_compute"}),
            "images": [session.files_fingerprint for session in sessions],
            "sensors": [file_fingerprint(session.path / "sensors.txt") for session in sessions],
            **({} if self.turns is None else {"turns": self.turns.fingerprint(sessions)}),
        }

    def rerank(self, features_dir: Path, workers: int, skip_existing: bool) -> None:
        """Write the reranked file; reuse the rows that a stopped run finished."""
        queries = read_references(self.retrieval, "path")
        references = [reference for query in queries for reference in query["topk"][: self.settings.topn]]
        stores = [
            extract_session(
                session,
                features_dir,
                self.method.extractor,
                self._rows(session, images),
                workers,
                turns=None if self.turns is None else self.turns.of(session),
            )
            for session, images in ((self.map_session, references), (self.query_session, queries))
        ]
        verifier = Verifier(self.settings, self.method.matcher, stores[0])

        def rerank(index: int) -> tuple[int, dict[str, Any]]:
            try:
                return index, self._reranked(queries[index], verifier, *stores)
            except Exception as error:  # one bad query must not end the run
                return index, self._row(queries[index], reason_of(error, f"reranking {queries[index]['path']}"))

        source = fingerprint(self.record)
        with Items(items_beside(self.path), skip_existing=skip_existing) as progress:
            todo = [int(name) for name, _ in progress.left((str(index), source) for index in range(len(queries)))]
            # Queries with the same first reference run one after another, so that it is read once.
            todo.sort(key=lambda index: _name(queries[index]["topk"][0]) if queries[index]["topk"] else "")
            label = f"rerank {self.query_session.device} in {self.map_session.device}"
            # One thread suffices for a network: a query's references are one batch, which keeps the device busy.
            threads = workers if self.method.extractor.threaded else 1
            broken: dict[str, dict[str, Any]] = {}  # rows of internal errors: written, but tried again by the next run
            for index, row in tqdm(prefetch(rerank, todo, threads), total=len(todo), desc=label, unit="image"):
                if row["reason"].startswith(INTERNAL):
                    broken[str(index)] = row
                else:
                    progress.add(str(index), source, note=row)
            progress.flush()
            rows = {name: progress.note(name) for name in progress} | broken
            write_text(self.path, "".join(json.dumps(rows[str(index)]) + "\n" for index in range(len(queries))))
            write_sidecar(self.path, self.record, made_from=[self.retrieval], unfinished=bool(broken))
        if not broken:
            remove_items(self.path)

    def _rows(self, session: Session, images: Sequence[dict[str, Any]]) -> Ints:
        """Return the rows of `session.images` of images in the retrieval file; raise if the session lacks one."""
        names = list(dict.fromkeys(_name(image) for image in images))
        if lacking := [name for name in names if name not in session.row_of_name]:
            fault = f"{len(lacking)} images are not in {session.path / 'images.txt'}, first {lacking[0]}"
            raise ArtifactError(f"{self.retrieval}: {fault}. The file belongs to another capture: retrieve again.")
        return np.array([session.row_of_name[name] for name in names], np.int64)

    def _reranked(
        self, query: dict[str, Any], verifier: Verifier, map_store: FeatureStore, query_store: FeatureStore
    ) -> dict[str, Any]:
        """Return a query image's row with its references in order of verified matches."""
        name, references = _name(query), query["topk"][: self.settings.topn]
        if name not in query_store:
            return self._row(query, query_store.failed.get(name, "no local features of the query image"))
        names = [_name(reference) for reference in references]
        if not any(name in map_store for name in names):
            return self._row(query, "no reference has local features")
        cameras = [self.map_session.camera(reference["sensor_id"]) for reference in references]
        camera = self.query_session.camera(query["sensor_id"])
        ranked = verifier.rank(query_store[name], camera, names, cameras)
        if not ranked[0][1]:
            return self._row(query, "no reference agrees with the query by more than chance")
        return self._row(query, "", ranked)

    def _row(self, query: dict[str, Any], reason: str, ranked: Sequence[tuple[int, int, int]] = ()) -> dict[str, Any]:
        """Return a query image's row; `ranked` as by `Verifier.rank`, empty: references keep their order."""
        topk = list[dict[str, Any]]()
        kept = [(index, 0, 0) for index in range(len(query["topk"]))][: self.settings.topk]
        for index, verified, matches in ranked or kept:
            reference = query["topk"][index]
            before = {"retrieval_score": reference["score"], "retrieval_rank": reference["rank"]}
            topk.append(reference | {"score": verified, "num_matches": matches, **before, "rank": len(topk) + 1})
        return query | {"topk": topk, "reason": reason}


def _counts(rows: list[dict[str, Any]]) -> dict[str, int]:
    kept = sum(bool(row["reason"]) for row in rows)
    changed = sum(bool(row["topk"]) and row["topk"][0]["retrieval_rank"] != 1 for row in rows)
    return {"query_images": len(rows), "confirmed": len(rows) - kept, "kept": kept, "changed": changed}


def _name(entry: dict[str, Any]) -> str:
    """Return the name of an image in the retrieval file."""
    return image_name(str(entry["path"]))
