"""The rerank stage: the retrieved map images of every query, ordered by how many matches agree with a relative pose.

Global descriptors confuse places that look alike. Local features that match *and* obey one essential matrix of the two
calibrated cameras are rarely found between different places, so the right reference comes first.
"""

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
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
)  # fmt: skip
from toolkit.manifest import RerankSettings

log = logging.getLogger(__name__)

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
    references with the same score keep the order of retrieval. They have in addition `retrieval_score`,
    `retrieval_rank`, and `num_matches`, the matches among which the inliers are. A query image that cannot be verified
    keeps the order of retrieval, and its `reason` says why. Every image of a rig is verified on its own.

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
    (method,) = create_local_methods(
        settings.features, settings.matcher, settings.compute_device, settings.dtype_compute
    )
    workers = workers or default_workers()
    table = []
    cv2_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # queries are the parallel dimension, and sums stay in one order
    try:
        with threadpool_limits(1, "blas"):
            for devices in product(
                capture.devices_with("map", map_device), capture.devices_with("query", query_device)
            ):
                started = time.perf_counter()
                sessions = capture[f"{devices[0]}_map"], capture[f"{devices[1]}_query"]
                name = f"{pair_name(capture.name, *devices)}.jsonl"
                pair = _Pair(*sessions, Path(retrieval_dir) / name, Path(out_dir) / name, method, settings)
                skipped = skip_existing and is_current(pair.path, pair.record)
                if not skipped:
                    pair.rerank(Path(features_dir), workers, skip_existing)
                table.append(
                    {"map_device": devices[0], "query_device": devices[1]}
                    | _counts(read_references(pair.path))
                    | {"seconds": round(time.perf_counter() - started, 2), "skipped": skipped, "path": str(pair.path)}
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
    """A map session and a query session, the files of both, and how their images are compared."""

    map_session: Session
    query_session: Session
    retrieval: Path
    path: Path
    """The reranked file."""
    method: LocalMethod
    settings: RerankSettings

    @cached_property
    def record(self) -> dict[str, Any]:
        """What the reranked file depends on."""
        if not self.retrieval.exists():
            read_references(self.retrieval)  # says what is missing
        sessions = self.map_session, self.query_session
        return {
            "retrieval": file_fingerprint(self.retrieval),
            "features": self.method.extractor.settings,
            "matcher": self.method.matcher.settings,
            **self.settings.model_dump(exclude={"features", "matcher", "compute_device", "dtype_compute"}),
            "images": [session.files_fingerprint for session in sessions],
            "sensors": [file_fingerprint(session.path / "sensors.txt") for session in sessions],
        }

    def rerank(self, features_dir: Path, workers: int, skip_existing: bool) -> None:
        """Write the reranked file; take over the rows that a stopped run finished."""
        queries = read_references(self.retrieval, "path")
        references = [reference for query in queries for reference in query["topk"][: self.settings.topn]]
        stores = [
            extract_session(session, features_dir, self.method.extractor, self._rows(session, images), workers)
            for session, images in ((self.map_session, references), (self.query_session, queries))
        ]
        verifier = Verifier(self.settings, self.method.matcher, stores[0])

        def rerank(index: int) -> tuple[int, dict[str, Any]]:
            try:
                return index, self._reranked(queries[index], verifier, *stores)
            except Exception as error:  # one bad query never ends a run
                log.exception("reranking %s", queries[index]["path"])
                return index, self._kept(queries[index], f"{type(error).__name__}: {error}")

        with GroupWriter(self.path, self.record) as progress:
            if not skip_existing:
                progress.discard()
            todo = [index for index in range(len(queries)) if str(index) not in progress.notes()]
            # Queries with the same best reference follow each other: what they share is read once.
            todo.sort(key=lambda index: _name(queries[index]["topk"][0]) if queries[index]["topk"] else "")
            label = f"rerank {self.query_session.device} in {self.map_session.device}"
            # A network matches the references of one query as a batch, and keeps the device busy by that.
            threads = workers if self.method.extractor.threaded else 1
            for index, row in tqdm(prefetch(rerank, todo, threads), total=len(todo), desc=label, unit="image"):
                progress.add(str(index), note=row)
            rows = progress.notes()
            write_text(self.path, "".join(json.dumps(rows[str(index)]) + "\n" for index in range(len(queries))))
            write_sidecar(self.path, self.record)
            progress.discard()

    def _rows(self, session: Session, images: Sequence[dict[str, Any]]) -> NDArray[np.int64]:
        """Return the rows of `session.images` of images in the retrieval file.

        Raises:
            ArtifactError: an image is not in the session.
        """
        prefix = f"{session.path.name}/raw_data/"
        names = list(dict.fromkeys(_name(image) for image in images))
        rows = pd.Index(session.images["path"]).get_indexer([name.removeprefix(prefix) for name in names])
        if (rows < 0).any():
            raise ArtifactError(
                f"{self.retrieval}: {(rows < 0).sum()} images are not in {session.path / 'images.txt'}, first "
                f"{names[int(np.argmax(rows < 0))]}. The file is of another capture: retrieve again."
            )
        return np.asarray(rows, np.int64)

    def _reranked(
        self, query: dict[str, Any], verifier: Verifier, map_store: FeatureStore, query_store: FeatureStore
    ) -> dict[str, Any]:
        """Return a query image's row in the order of verified inliers."""
        name, references = _name(query), query["topk"][: self.settings.topn]
        if name not in query_store:
            return self._kept(query, query_store.failed.get(name, "no local features of the query image"))
        readable = [reference for reference in references if _name(reference) in map_store]
        if not readable:
            return self._kept(query, "no reference has local features")
        inliers, matches = verifier.verify(
            query_store[name],
            self.query_session.camera(query["sensor_id"]),
            [_name(reference) for reference in readable],
            [self.map_session.camera(reference["sensor_id"]) for reference in readable],
        )
        if not any(inliers):
            return self._kept(query, "no reference agrees with the query by more than chance")
        counted = dict(zip(map(_name, readable), zip(inliers, matches, strict=True), strict=True))
        rows = [_entry(reference, *counted.get(_name(reference), (0, 0))) for reference in references]
        rows.sort(key=lambda row: (-row["score"], row["retrieval_rank"]))
        return _row(query, rows[: self.settings.topk], "")

    def _kept(self, query: dict[str, Any], reason: str) -> dict[str, Any]:
        """Return a query image's row in the order of retrieval."""
        return _row(query, [_entry(reference, 0, 0) for reference in query["topk"][: self.settings.topk]], reason)


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
    """Return the name of an image in the retrieval file."""
    return image_name(str(entry["path"]))
