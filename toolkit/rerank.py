"""The rerank stage: the retrieved map images of every query, ordered by how many matches agree with a relative pose.

Global descriptors confuse places that look alike. Local features that match *and* obey one essential matrix of the two
calibrated cameras are rarely found between different places, so the right reference comes first.
"""

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from scipy.special import gammaln
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session
from toolkit.capture.images import default_workers, prefetch
from toolkit.errors import ArtifactError
from toolkit.features.features import LocalFeatures
from toolkit.features.groups import GroupWriter
from toolkit.features.matching import LocalMethod, Matcher, create_local_methods
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import (
    file_fingerprint,
    image_name,
    is_current,
    pair_name,
    read_references,
    write_sidecar,
    write_text,
)
from toolkit.manifest import RerankSettings

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

MAP_IMAGES_KEPT = 256
"""Map images whose features stay in memory: some 60 MB."""


def rerank_pairs(
    sessions_root: str | Path,
    retrieval_dir: str | Path,
    features_dir: str | Path,
    out_dir: str | Path,
    settings: RerankSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    skip_existing: bool = True,
    workers: int = 0,
) -> pd.DataFrame:
    """Write, for every pair of devices, the retrieved map images of each query image in order of verified inliers.

    The files have the retrieval stage's format. `score` is the number of inliers, 0 where chance would give as many;
    equal ones keep the order of retrieval. Beside it stand `retrieval_score` and `retrieval_rank`, and
    `num_matches`, of which the inliers are. A query image that cannot be verified keeps the order of retrieval, and its
    `reason` says why. Every image of a rig is looked at on its own.

    Args:
        sessions_root: `<capture>/sessions`.
        retrieval_dir: folder of the retrieval stage's files.
        features_dir: folder of local features, shared with the other stages.
        out_dir: folder of the reranked files.
        settings: see `RerankSettings`; a dict holds what differs from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` that the capture has.
        skip_existing: reuse what was made from the same inputs and settings, and go on where a run was killed.
        workers: threads; 0 takes the number of cores, at most 8.

    Returns:
        One row a pair: map_device, query_device, queries (images) = confirmed + kept, changed (confirmed ones that have
        another first reference than before), seconds, skipped, path.

    Raises:
        ManifestError: topk is below 1 or above topn; unknown features, or a matcher that does not suit them.
        WeightsError: a network has no weights.
        CaptureError: unknown device.
        ArtifactError: the retrieval of a pair is missing, torn, or of another capture.
    """
    settings = RerankSettings.of(settings)
    capture = Capture.from_sessions_root(sessions_root)
    method = create_local_methods(
        settings.features, settings.matcher, settings.compute_device, settings.dtype_compute
    )[0]
    workers = workers or default_workers()
    table = []
    cv2_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # queries are the parallel dimension, and sums stay in one order
    try:
        with threadpool_limits(1, "blas"):
            for mapped in capture.devices_with("map", map_device):
                for asked in capture.devices_with("query", query_device):
                    started = time.perf_counter()
                    pair = _Pair(capture, mapped, asked, Path(retrieval_dir), Path(out_dir))
                    record = pair.record(settings, method)
                    skipped = skip_existing and is_current(pair.path, record)
                    if not skipped:
                        _rerank_pair(pair, settings, method, Path(features_dir), record, workers, skip_existing)
                    table.append(
                        {"map_device": mapped, "query_device": asked}
                        | _counts(read_references(pair.path))
                        | {"seconds": round(time.perf_counter() - started, 2)}
                        | {"skipped": skipped, "path": str(pair.path)}
                    )
    finally:
        cv2.setNumThreads(cv2_threads)
    return pd.DataFrame(table)


class Verifier:
    """Counts, for a query image and map images, the matches that agree with one relative pose.

    Safe to use from several threads. The features of the map images used last stay in memory.
    """

    def __init__(self, settings: RerankSettings, matcher: Matcher, store: Mapping[str, LocalFeatures]):
        """
        Args:
            settings, matcher: how to verify and to match.
            store: the features of the map images.
        """
        self.settings = settings
        self.matcher = matcher
        self._map_features = lru_cache(MAP_IMAGES_KEPT)(lambda name: self._strongest(store[name]))

    def verify(
        self,
        features: LocalFeatures,
        camera: pycolmap.Camera,
        references: Sequence[str],
        cameras: Sequence[pycolmap.Camera],
    ) -> tuple[list[int], list[int]]:
        """Return the inliers and the matches of a query image with each reference.

        Args:
            features, camera: of the query image.
            references, cameras: names and cameras of map images, all of which have features.
        """
        features = self._strongest(features)
        map_features = [self._map_features(name) for name in references]
        matched = self.matcher.match([(features, other) for other in map_features])
        inliers = [
            count_inliers(
                camera,
                features.keypoints[matches.indices[:, 0]],
                other_camera,
                other.keypoints[matches.indices[:, 1]],
                matches.scores,
                self.settings,
                tests=len(references),
            )
            for matches, other, other_camera in zip(matched, map_features, cameras, strict=True)
        ]
        return inliers, [len(matches) for matches in matched]

    def _strongest(self, features: LocalFeatures) -> LocalFeatures:
        return features.take(slice(self.settings.max_features))


def count_inliers(
    camera_a: pycolmap.Camera,
    pixels_a: NDArray[np.floating],
    camera_b: pycolmap.Camera,
    pixels_b: NDArray[np.floating],
    scores: NDArray[np.floating],
    settings: RerankSettings,
    tests: int = 1,
) -> int:
    """Return how many matches agree with one essential matrix, or 0 where chance would give as many.

    Matches that share a keypoint with another inlier count once. The essential matrix is that of D. Nister, "An
    Efficient Solution to the Five-Point Relative Pose Problem", PAMI 2004, drawn in the order of the matches' scores
    (O. Chum, J. Matas, "Matching with PROSAC", CVPR 2005).

    Args:
        camera_a, camera_b: intrinsics, with their distortion.
        pixels_a, pixels_b: (K, 2) matched pixels.
        scores: (K,) how sure the matches are.
        tests: how many pairs are looked at together; among more, chance does more.
    """
    if len(scores) < 6:  # five always agree
        return 0
    order = np.argsort(-scores, kind="stable")
    pixels_a, pixels_b = (np.asarray(pixels, np.float64)[order] for pixels in (pixels_a, pixels_b))
    rays_a, rays_b = np.asarray(camera_a.cam_from_img(pixels_a)), np.asarray(camera_b.cam_from_img(pixels_b))
    finite = np.isfinite(rays_a).all(axis=1) & np.isfinite(rays_b).all(axis=1)  # far out, distortion has no inverse
    if finite.sum() < 6:
        return 0
    options = cv2.UsacParams()
    options.sampler = cv2.SAMPLING_PROSAC
    options.score = cv2.SCORE_METHOD_MSAC
    options.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    options.loIterations, options.loSampleSize = 5, 20
    options.confidence = 0.999
    options.maxIterations = settings.max_trials
    options.randomGeneratorState = settings.seed
    options.isParallel = False
    options.threshold = float(np.tan(np.radians(settings.max_error_deg)))
    pinhole = np.eye(3), np.eye(3), np.zeros(5), np.zeros(5)  # the rays are calibrated already
    _, mask = cv2.findEssentialMat(rays_a[finite], rays_b[finite], *pinhole, options)
    agree = np.flatnonzero(finite)[:0] if mask is None else np.flatnonzero(finite)[np.ravel(mask) > 0]
    inliers = min(len(np.unique(pixels[agree], axis=0)) for pixels in (pixels_a, pixels_b))
    chance = max(_chance(camera, options.threshold) for camera in (camera_a, camera_b))
    return inliers if is_meaningful(inliers, len(scores), chance, tests) else 0


def is_meaningful(inliers: int, matches: int, chance: float, tests: int = 1) -> bool:
    """Tell whether less than one such agreement is expected among random matches.

    The number of false alarms of L. Moisan, B. Stival, "A Probabilistic Criterion to Detect Rigid Point Matches Between
    Two Images and Estimate the Fundamental Matrix", IJCV 2004, for a model of five matches, at a fixed threshold.

    Args:
        inliers: matches that agree with a model.
        matches: of so many.
        chance: probability that a random match agrees with a model.
        tests: how many sets of matches are looked at.
    """
    if inliers <= 5:
        return False

    def log_choose(n: int, k: int) -> float:
        return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))

    models = 10  # that five matches allow, at most
    ways = np.log(models * (matches - 5)) + log_choose(matches, inliers) + log_choose(inliers, 5)
    return bool(np.log(tests) + ways + (inliers - 5) * np.log(min(chance, 1.0)) < 0)


def _chance(camera: pycolmap.Camera, threshold: float) -> float:
    """Return how much of an image lies within the threshold of a line through it, at most."""
    # Sampson's error shares a deviation among both images, so that in one of them it may be sqrt(2) times larger.
    band_px = 2 * np.sqrt(2) * threshold * camera.mean_focal_length()
    return float(band_px * np.hypot(camera.width, camera.height) / (camera.width * camera.height))


@dataclass(frozen=True)
class _Pair:
    """One map device x query device: where its files are."""

    capture: Capture
    map_device: str
    query_device: str
    retrieval_dir: Path
    out_dir: Path

    @property
    def retrieval(self) -> Path:
        return self.retrieval_dir / f"{pair_name(self.capture.name, self.map_device, self.query_device)}.jsonl"

    @property
    def path(self) -> Path:
        return self.out_dir / self.retrieval.name

    @property
    def sessions(self) -> tuple[Session, Session]:
        return self.capture[f"{self.map_device}_map"], self.capture[f"{self.query_device}_query"]

    def record(self, settings: RerankSettings, method: LocalMethod) -> dict[str, Any]:
        """Return what the reranked file depends on."""
        if not self.retrieval.exists():
            read_references(self.retrieval)  # says what is missing
        return {
            "retrieval": file_fingerprint(self.retrieval),
            "features": method.extractor.settings,
            "matcher": method.matcher.settings,
            **settings.model_dump(
                exclude={"features", "matcher", "compute_device", "dtype_compute"}  # told by the two below
            ),
            "images": [session.files_fingerprint for session in self.sessions],
            "sensors": [file_fingerprint(session.path / "sensors.txt") for session in self.sessions],
        }


def _rerank_pair(
    pair: _Pair,
    settings: RerankSettings,
    method: LocalMethod,
    features_dir: Path,
    record: dict[str, Any],
    workers: int,
    skip_existing: bool,
) -> None:
    """Write the reranked file of a pair; rows that a stopped run finished are taken over."""
    queries = read_references(pair.retrieval, "path")
    map_session, query_session = pair.sessions
    query_rows = _rows_of(query_session, [_name(query) for query in queries], pair.retrieval)
    names = list(dict.fromkeys(_name(reference) for query in queries for reference in query["topk"][: settings.topn]))
    map_rows = _rows_of(map_session, names, pair.retrieval)
    query_store = extract_session(query_session, features_dir, method.extractor, query_rows, workers)
    map_store = extract_session(map_session, features_dir, method.extractor, map_rows, workers)
    verifier = Verifier(settings, method.matcher, map_store)

    def rerank(index: int) -> tuple[int, dict[str, Any]]:
        query = queries[index]
        try:
            return index, _reranked(query, verifier, query_session, query_store, map_session, map_store)
        except Exception as error:  # one bad query never ends a run
            log.exception("reranking %s", query["path"])
            return index, _kept(query, settings.topk, f"{type(error).__name__}: {error}")

    with GroupWriter(pair.path, record) as progress:
        if not skip_existing:
            progress.discard()
        todo = [index for index in range(len(queries)) if str(index) not in progress.notes()]
        # Queries with the same best reference follow each other: what they share is read once.
        todo.sort(key=lambda index: _name(queries[index]["topk"][0]) if queries[index]["topk"] else "")
        label = f"rerank {pair.query_device} in {pair.map_device}"
        # A network matches the references of one query as a batch, and keeps the device busy by that.
        threads = workers if method.extractor.threaded else 1
        for index, row in tqdm(prefetch(rerank, todo, threads), total=len(todo), desc=label, unit="image"):
            progress.add(str(index), note=row)
        rows = progress.notes()
        write_text(pair.path, "".join(json.dumps(rows[str(index)]) + "\n" for index in range(len(queries))))
        write_sidecar(pair.path, record)
        progress.discard()


def _reranked(
    query: dict[str, Any],
    verifier: Verifier,
    query_session: Session,
    query_store: FeatureStore,
    map_session: Session,
    map_store: FeatureStore,
) -> dict[str, Any]:
    topn, topk = verifier.settings.topn, verifier.settings.topk
    if _name(query) not in query_store:
        return _kept(query, topk, query_store.failed.get(_name(query), "no local features of the query image"))
    found = query["topk"][:topn]
    readable = [reference for reference in found if _name(reference) in map_store]
    if not readable:
        return _kept(query, topk, "no reference has local features")
    inliers, matches = verifier.verify(
        query_store[_name(query)],
        query_session.camera(query["sensor_id"]),
        [_name(reference) for reference in readable],
        [map_session.camera(reference["sensor_id"]) for reference in readable],
    )
    if not any(inliers):
        return _kept(query, topk, "no reference agrees with the query by more than chance")
    counted = {_name(ref): pair for ref, pair in zip(readable, zip(inliers, matches, strict=True), strict=True)}
    rows = [_entry(reference, *counted.get(_name(reference), (0, 0))) for reference in found]
    rows.sort(key=lambda row: (-row["score"], row["retrieval_rank"]))
    return _row(query, rows[:topk], "")


def _kept(query: dict[str, Any], topk: int, reason: str) -> dict[str, Any]:
    """Return a query image's row in the order of retrieval."""
    return _row(query, [_entry(reference, 0, 0) for reference in query["topk"][:topk]], reason)


def _entry(reference: dict[str, Any], inliers: int, matches: int) -> dict[str, Any]:
    before = {"retrieval_score": reference["score"], "retrieval_rank": reference["rank"]}
    return reference | {"score": inliers, "num_matches": matches} | before


def _row(query: dict[str, Any], references: list[dict[str, Any]], reason: str) -> dict[str, Any]:
    ranked = [reference | {"rank": rank} for rank, reference in enumerate(references, start=1)]
    return query | {"topk": ranked, "reason": reason}


def _counts(rows: list[dict[str, Any]]) -> dict[str, int]:
    kept = sum(bool(row["reason"]) for row in rows)
    changed = sum(bool(row["topk"]) and row["topk"][0]["retrieval_rank"] != 1 for row in rows)
    return {"queries": len(rows), "confirmed": len(rows) - kept, "kept": kept, "changed": changed}


def _name(entry: dict[str, Any]) -> str:
    """Return the name of a retrieved or asked image."""
    return image_name(str(entry["path"]))


def _rows_of(session: Session, names: Sequence[str], path: Path) -> NDArray[np.int64]:
    """Return the rows of `session.images` of image names.

    Raises:
        ArtifactError: an image is not in the session.
    """
    prefix = f"{session.id}/raw_data/"
    rows = pd.Index(session.images["path"]).get_indexer([name.removeprefix(prefix) for name in names])
    if (rows < 0).any():
        raise ArtifactError(
            f"{path}: {(rows < 0).sum()} images are not in {session.path / 'images.txt'}, first "
            f"{names[int(np.argmax(rows < 0))]}. The file is of another capture: retrieve again."
        )
    return np.asarray(rows, np.int64)
