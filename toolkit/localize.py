"""The localize stage: references and local features in, one pose a query device out."""

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.images import default_workers, prefetch, read_image
from toolkit.capture.upright import Turns, upright_turns
from toolkit.embedders import Embedder, create_embedder, load_embeddings
from toolkit.errors import ArtifactError, ImageError
from toolkit.features.features import KINDS, LocalFeatures, SiftExtractor
from toolkit.features.matching import LocalMethod, MutualMatcher, create_local_methods
from toolkit.features.stores import FeatureStore, MatchStore, extract_session, match_sessions
from toolkit.files import (
    SceneFiles,
    file_fingerprint,
    fingerprint,
    image_name,
    is_current,
    open_progress,
    pair_name,
    read_references,
    write_atomic,
    write_sidecar,
)
from toolkit.localizers.hybrid import HybridLocalizer
from toolkit.localizers.lifting import DepthLifter
from toolkit.localizers.mapped import Known, MappedFeatures
from toolkit.localizers.mapping import LocalMap, build_map, map_path, map_settings
from toolkit.localizers.pnp import PnpLocalizer, PoseEstimate
from toolkit.localizers.prediction import Predictor, View
from toolkit.localizers.predictors import create_predictor
from toolkit.localizers.vggt import VggtAnswer, VggtLocalizer, VggtQuery
from toolkit.manifest import LocalizeSettings

log = logging.getLogger(__name__)

COLUMNS = [
    "timestamp", "device_id", "status", "method", "num_inliers", "num_matches", "inlier_ratio", "num_guided",
    "rmse_px", "rival_support", "position_std_m", "rotation_std_deg", "references", "seconds",
]  # fmt: skip
PREDICTION_COLUMNS = ["scale_std", "rejected", "reason"]
"""Further columns of the methods that predict."""


def localize_pairs(
    sessions_root: str | Path,
    retrieval_dir: str | Path,
    out_dir: str | Path,
    features_dir: str | Path,
    map_dir: str | Path,
    settings: LocalizeSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    queries: str = "keyframes_pruned_subsampled",
    skip_existing: bool = True,
    workers: int = 0,
) -> pd.DataFrame:
    """Write, for every pair of devices, the poses of the queries (`.txt`) and how they came about (`.csv`).

    Args:
        sessions_root: `<capture>/sessions`.
        retrieval_dir: folder of the retrieval stage's files.
        out_dir: folder of the poses.
        features_dir: folder of local features, shared with the embed stage.
        map_dir: folder of the triangulated maps, `<device>_map.npz`, and of matches.
        settings: see `LocalizeSettings`; a dict holds what differs from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` that the capture has.
        queries: the keyframe list that says which devices are asked for, or `all`.
        skip_existing: reuse what was made from the same inputs and settings, and go on where a run was killed.
        workers: threads; 0 takes the number of cores, at most 8.

    Returns:
        One row a pair: map_device, query_device, queries, ok, low_confidence, failed, seconds, skipped, path.

    Raises:
        ManifestError: unknown method, predictor, features or matcher, or a number that is not positive.
        WeightsError: the network has no weights, before any work is done.
        CaptureError: unknown device or list.
        ArtifactError: the retrieval of a pair is missing.
    """
    settings = LocalizeSettings.of(settings)
    method = settings.method
    capture = Capture.from_sessions_root(sessions_root)
    workers = workers or default_workers()
    guide: _Guide | None = None
    kinds: list[LocalMethod] = []
    if method != "nearest":
        kinds = create_local_methods(
            settings.features, settings.matcher, settings.compute_device, settings.dtype_compute
        )
    if settings.predicts:
        guide = _Guide(_open_predictor(settings, capture, map_dir), settings, _turns(settings, capture))
    table = []
    with threadpool_limits(1, "blas"):  # queries are the parallel dimension, and sums stay in one order
        for mapped in capture.devices_with("map", map_device):
            solver: _Solver | None = None
            for asked in capture.devices_with("query", query_device):
                started = time.perf_counter()
                pair = _Pair(capture, mapped, asked, Path(retrieval_dir), Path(out_dir), queries)
                record = pair.record(settings, kinds)
                if guide is not None:
                    record |= guide.record(capture[f"{mapped}_map"])
                skipped = skip_existing and is_current(pair.txt, record) and pair.csv.exists()
                if not skipped:
                    if solver is None:
                        session = capture[f"{mapped}_map"]
                        folders = Path(features_dir), Path(map_dir)
                        solver = _open_solver(session, *folders, settings, kinds, guide, workers, skip_existing)
                    rows = _localize_pair(pair, solver, *folders, record, workers, skip_existing)
                    _write_poses(pair, rows, COLUMNS if guide is None else [*COLUMNS, *PREDICTION_COLUMNS])
                    write_sidecar(pair.txt, record)
                counts = pd.read_csv(pair.csv)["status"].str.split(":").str[0].value_counts()
                table.append(
                    {
                        "map_device": mapped,
                        "query_device": asked,
                        "queries": int(counts.sum()),
                        **{status: int(counts.get(status, 0)) for status in ("ok", "low_confidence", "failed")},
                        "seconds": round(time.perf_counter() - started, 2),
                        "skipped": skipped,
                        "path": str(pair.txt),
                    }
                )
    return pd.DataFrame(table)


def _open_predictor(settings: LocalizeSettings, capture: Capture, map_dir: str | Path) -> Predictor:
    """Return the predictor for the images of a capture; warn of one that looks up the answers."""
    name = settings.predictor.name
    predictor = create_predictor(
        name,
        sessions=[capture[key] for key in capture.session_ids] if name == "simulated" else (),
        map_dir=map_dir,
        checkpoint=settings.predictor.checkpoint,
        compute_device=settings.compute_device,
        dtype_compute=settings.dtype_compute,
        seed=settings.seed,
    )
    if predictor.simulated:
        log.warning("predictor: %s looks up the true poses of the queries. What comes out is no result.", name)
    return predictor


def _turns(settings: LocalizeSettings, capture: Capture) -> Turns | None:
    """Return what makes the images of a capture upright, None where they are shown as they are."""
    return upright_turns(capture, settings.world_up) if settings.predictor.upright else None


@dataclass(frozen=True)
class _Guide:
    """What predicts, and how it is asked."""

    predictor: Predictor
    settings: LocalizeSettings
    turns: Turns | None

    def record(self, mapped: Session) -> dict[str, Any]:
        """Return what poses in the map of a session depend on, besides what those of `pnp` do."""
        predictor = {"name": self.predictor.name} | self.predictor.settings
        turns = None if self.turns is None else self.turns.record()
        vggt = self.settings.predictor.model_dump(exclude={"name", "checkpoint", "batch_size"})
        return {"predictor": predictor, "vggt": vggt, "turns": turns, "depths": mapped.depths_fingerprint}


@dataclass(frozen=True)
class _Solver:
    """The localizers of one map that a method asks; without any, the method is `nearest`."""

    pnp: PnpLocalizer | None = None
    kinds: Sequence[LocalMethod] = ()
    stores: Sequence[FeatureStore] = ()
    """Of each kind, the map's features."""
    vggt: VggtLocalizer | None = None
    method: str = "nearest"
    batch_size: int = 1
    turns: Turns | None = None

    @property
    def lifter(self) -> DepthLifter | None:
        return None if self.pnp is None or self.vggt is None else DepthLifter(self.pnp, self.vggt)

    def label(self, found_by: str) -> str:
        """Return what the column `method` says of a pose that was found by some method, or of none."""
        if self.vggt is not None and self.vggt.predictor.simulated:
            return f"{self.method}:simulated" + (f"/{found_by}" if found_by else "")
        return found_by or self.method


@dataclass(frozen=True)
class _Pair:
    """One map device x query device: where its files are, and what is asked."""

    capture: Capture
    map_device: str
    query_device: str
    retrieval_dir: Path
    out_dir: Path
    queries: str

    @property
    def name(self) -> str:
        return pair_name(self.capture.name, self.map_device, self.query_device)

    @property
    def retrieval(self) -> Path:
        return self.retrieval_dir / f"{self.name}.jsonl"

    @property
    def txt(self) -> Path:
        return self.out_dir / f"{self.name}.txt"

    @property
    def csv(self) -> Path:
        return self.out_dir / f"{self.name}.csv"

    @property
    def session(self) -> Session:
        return self.capture[f"{self.query_device}_query"]

    def record(self, settings: LocalizeSettings, kinds: Sequence[LocalMethod]) -> dict[str, Any]:
        """Return what the poses depend on."""
        keyframes = self.session.keyframes(self.queries)
        if not self.retrieval.exists():
            read_references(self.retrieval)  # says what is missing
        return {
            "method": settings.method,
            "pnp": settings.pnp.model_dump() | {"seed": settings.seed},
            "map": map_settings(settings.map, settings.seed),
            "features": [kind.extractor.settings for kind in kinds],
            "matchers": [kind.matcher.settings for kind in kinds],
            "retrieval": file_fingerprint(self.retrieval),
            "map_session": session_fingerprint(self.capture[f"{self.map_device}_map"]),
            "query_session": session_fingerprint(self.session),
            "images": [self.capture[f"{self.map_device}_map"].files_fingerprint, self.session.files_fingerprint],
            "keyframes": fingerprint([keyframes["timestamp"].astype(str).tolist(), keyframes["device_id"].tolist()]),
        }

    def references(self) -> dict[tuple[int, str], list[dict[str, Any]]]:
        """Return for each query image (timestamp, sensor) the retrieved map images, best first."""
        rows = read_references(self.retrieval)
        return {(int(row["timestamp"]), str(row["sensor_id"])): row["topk"] for row in rows}


def session_fingerprint(session: Session) -> str:
    """Return 16 hex digits that identify the calibration, poses and image list of a session."""
    files = ["sensors.txt", "images.txt", "rigs.txt", "trajectories.txt"]
    return fingerprint([file_fingerprint(session.path / name) for name in files if (session.path / name).exists()])


def _open_solver(
    session: Session,
    features_dir: Path,
    map_dir: Path,
    settings: LocalizeSettings,
    kinds: Sequence[LocalMethod],
    guide: _Guide | None,
    workers: int,
    skip_existing: bool,
) -> _Solver:
    """Return the localizers of a map session; its triangulated maps are built or loaded where they need them."""
    method = settings.method
    if method == "nearest":
        return _Solver()
    stores, mapped = [], []
    for kind in kinds:
        store = extract_session(session, features_dir, kind.extractor, workers=workers)
        inputs = fingerprint([session_fingerprint(session), store.fingerprint])
        path = map_path(map_dir, session.id, kind.name)
        local_map = build_map(
            session, store, path, settings.map, settings.seed, skip_existing, inputs, workers
        )
        stores.append(store)
        mapped.append(MappedFeatures(local_map, store, KINDS[kind.name], kind.matcher))
    pnp = PnpLocalizer.of(mapped, settings.pnp, settings.seed)
    if guide is None:
        return _Solver(pnp, kinds, stores, method=method)
    vggt = VggtLocalizer(mapped[0].map, session, guide.predictor, settings.predictor, guide.turns)
    return _Solver(
        pnp if method == "hybrid" else None, kinds, stores, vggt, method, settings.predictor.batch_size, guide.turns
    )


@dataclass(frozen=True)
class _Asked:
    """The local features of a query session, and what networks have matched of them."""

    stores: Sequence[FeatureStore]
    """Of each kind."""
    matches: Sequence[MatchStore | None]
    """Of each kind that a network matches."""

    def usable(self, name: str) -> bool:
        return all(name in store for store in self.stores)

    def reason(self, name: str) -> str:
        """Return why an image is not usable."""
        return next((store.failed[name] for store in self.stores if name in store.failed), "no features")

    def features(self, name: str) -> list[LocalFeatures]:
        return [store[name] for store in self.stores]

    def known(self, name: str) -> list[Known | None]:
        """Return what gives the matches of an image, of each kind."""

        def of(store: MatchStore) -> Known:
            return lambda reference: store[name, reference]

        return [None if store is None else of(store) for store in self.matches]


def _ask(
    pair: _Pair,
    solver: _Solver,
    pnp: PnpLocalizer,
    rows: NDArray[np.int64],
    references: dict[tuple[int, str], list[dict[str, Any]]],
    features_dir: Path,
    map_dir: Path,
    workers: int,
    skip_existing: bool,
) -> _Asked:
    """Extract the features of query images, and match them with their references where that takes a network."""
    session = pair.session
    stores = [extract_session(session, features_dir, kind.extractor, rows, workers) for kind in solver.kinds]
    images = session.images.iloc[rows]
    keys = zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True)
    asked = [
        (session.image_name(int(row)), name)
        for row, key in zip(rows, keys, strict=True)
        for name in map(_reference_name, references.get(key, []))
        if name in pnp.map.index_of
    ]
    sessions = session.id, f"{pair.map_device}_map"
    matches = [
        None
        if isinstance(kind.matcher, MutualMatcher)
        else match_sessions(both, asked, kind.matcher, map_dir, sessions, skip_existing)
        for kind, both in zip(solver.kinds, zip(stores, solver.stores, strict=True), strict=True)
    ]
    return _Asked(stores, matches)


def _localize_pair(
    pair: _Pair,
    solver: _Solver,
    features_dir: Path,
    map_dir: Path,
    record: dict[str, Any],
    workers: int,
    skip_existing: bool,
) -> list[dict[str, Any]]:
    """Localize the queries of a pair that a killed run has not; returns a row for each, in the list's order."""
    session = pair.session
    keyframes = session.keyframes(pair.queries)
    keys = list(zip(keyframes["timestamp"].tolist(), keyframes["device_id"].tolist(), strict=True))
    members = session.rows_of_keyframes(keyframes)
    references = pair.references()
    local = None
    if solver.pnp is not None:
        rows = np.unique(np.concatenate([*members, np.zeros(0, np.int64)]))
        folders = features_dir, map_dir
        local = _ask(pair, solver, solver.pnp, rows, references, *folders, workers, skip_existing)

    def solve(task: tuple[int, _QueryDevice, VggtAnswer | None, float]) -> dict[str, Any]:
        index, query, answer, seconds = task
        started = time.perf_counter() - seconds
        estimate, names = PoseEstimate("failed: no images of this device at this time"), list[str]()
        if query.names and solver.pnp is not None and local is not None:
            estimate, names = _pnp(query, solver, local, answer)
        elif query.names and answer is not None and solver.vggt is not None:
            estimate, names = answer.estimate, _names(solver.vggt.map, answer.estimate.references)
        elif query.names:
            estimate, names = _nearest(query)
        found_by = "" if estimate.world_from_rig is None else estimate.found_by
        row = _row(keys[index], estimate, names, solver.label(found_by), started)
        if solver.vggt is not None:
            row["scale_std"], row["reason"] = round(estimate.scale_std, 6), estimate.reason
            row["rejected"] = ";".join(_names(solver.vggt.map, estimate.rejected))
        return row

    def tasks(indices: Sequence[int]) -> Iterator[tuple[int, _QueryDevice, VggtAnswer | None, float]]:
        """Yield the queries, and what a network says of them, which is asked for some at a time."""
        for start in range(0, len(indices), solver.batch_size):
            part = indices[start : start + solver.batch_size]
            asked = [_read_query(session, members[index], references, solver.turns) for index in part]
            if solver.vggt is None:
                yield from ((index, query, None, 0.0) for index, query in zip(part, asked, strict=True))
                continue
            started = time.perf_counter()
            answers = solver.vggt.localize([_vggt_query(session, query, solver.vggt.map) for query in asked])
            seconds = (time.perf_counter() - started) / len(part)
            for index, query, answer in zip(part, asked, answers, strict=True):
                yield index, query, answer, seconds

    progress = pair.out_dir / f".{pair.name}.partial.jsonl"
    with open_progress(progress, record, keep=skip_existing) as finished:
        done = {(row["timestamp"], row["device_id"]): row for row in finished.rows}
        todo = [index for index, key in enumerate(keys) if key not in done]
        label = f"localize {pair.query_device} in {pair.map_device}"
        for row in tqdm(prefetch(solve, tasks(todo), workers), total=len(todo), desc=label, unit="query"):
            finished.add(row)
            done[row["timestamp"], row["device_id"]] = row
    return [done[key] for key in keys]


@dataclass(frozen=True)
class _QueryDevice:
    """The images of one query device at one instant."""

    names: list[str]
    cameras: list[pycolmap.Camera]
    rig_from_cams: NDArray[np.float64]
    references: list[list[dict[str, Any]]]
    turns: list[int]


def _read_query(
    session: Session,
    rows: NDArray[np.int64],
    references: dict[tuple[int, str], list[dict[str, Any]]],
    turns: Turns | None = None,
) -> _QueryDevice:
    images = session.images.iloc[rows]
    keys = list(zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True))
    return _QueryDevice(
        names=[session.image_name(int(row)) for row in rows],
        cameras=[session.camera(sensor) for _, sensor in keys],
        rig_from_cams=session.rig_from_cam(rows),
        references=[references.get(key, []) for key in keys],
        turns=[0] * len(rows) if turns is None else turns.of(session, rows).tolist(),
    )


def _reference_name(reference: dict[str, Any]) -> str:
    return image_name(str(reference["path"]))


def _vggt_query(session: Session, query: _QueryDevice, local_map: LocalMap) -> VggtQuery:
    """Return the query as a network is asked it."""
    index_of = local_map.index_of
    known = [
        [(index_of[name], float(row["score"])) for row in rows if (name := _reference_name(row)) in index_of]
        for rows in query.references
    ]
    return VggtQuery(
        views=[
            View(name, session.path.parent / name, camera, known=False, turns=turns)
            for name, camera, turns in zip(query.names, query.cameras, query.turns, strict=True)
        ],
        rig_from_cams=query.rig_from_cams,
        references=[np.array([index for index, _ in rows], np.int64) for rows in known],
        scores=[np.array([score for _, score in rows], np.float64) for rows in known],
    )


def _names(local_map: LocalMap, images: Sequence[int]) -> list[str]:
    return [local_map.image_names[index] for index in images]


def _pnp(
    query: _QueryDevice, solver: _Solver, local: _Asked, answer: VggtAnswer | None = None
) -> tuple[PoseEstimate, list[str]]:
    """Localize by matching; with what a network says of the query, by both."""
    usable = [index for index, name in enumerate(query.names) if local.usable(name)]
    if not usable:
        reasons = "; ".join(local.reason(name) for name in query.names)
        return PoseEstimate(f"failed: no readable image ({reasons})"), []
    localizer = solver.pnp
    assert localizer is not None
    index_of = localizer.map.index_of
    references = [
        [index_of[name] for name in map(_reference_name, query.references[index]) if name in index_of]
        for index in usable
    ]
    cameras, rig_from_cams = [query.cameras[index] for index in usable], query.rig_from_cams[usable]
    features = [local.features(query.names[index]) for index in usable]
    known = [local.known(query.names[index]) for index in usable]
    try:
        if answer is None:
            estimate = localizer.localize(cameras, rig_from_cams, features, references, known=known)
        else:
            hybrid = HybridLocalizer(localizer, solver.lifter)
            estimate = hybrid.localize(cameras, rig_from_cams, features, references, answer, known)
    except Exception as error:  # one bad query never ends a run
        log.exception("localizing %s", query.names[0])
        return PoseEstimate(f"failed: {type(error).__name__}: {error}"), []
    return estimate, _names(localizer.map, estimate.references)


def _nearest(query: _QueryDevice) -> tuple[PoseEstimate, list[str]]:
    """Return the pose that puts the camera with the best score at its first reference."""
    best = [(refs[0]["score"], index) for index, refs in enumerate(query.references) if refs]
    if not best:
        return PoseEstimate("failed: no references"), []
    index = max(best)[1]
    reference = query.references[index][0]
    world_from_rig = np.array(reference["Tws"], np.float64) @ geometry.invert(query.rig_from_cams[index])
    return PoseEstimate("low_confidence", world_from_rig, found_by="nearest"), [_reference_name(reference)]


def _row(
    key: tuple[int, str], estimate: PoseEstimate, references: list[str], method: str, started: float
) -> dict[str, Any]:
    pose = None if estimate.world_from_rig is None else geometry.qt_from_pose(estimate.world_from_rig).tolist()
    covariance = None if estimate.covariance is None else estimate.covariance.ravel().tolist()
    return {
        "timestamp": key[0],
        "device_id": key[1],
        "status": estimate.status,
        "method": method,
        "num_inliers": estimate.num_inliers,
        "num_matches": estimate.num_matches,
        "inlier_ratio": round(estimate.inlier_ratio, 4),
        "num_guided": estimate.num_guided,
        "rmse_px": round(estimate.rmse_px, 4),
        "rival_support": round(estimate.rival_support, 4),
        "position_std_m": round(estimate.position_std_m, 6),
        "rotation_std_deg": round(estimate.rotation_std_deg, 6),
        "references": ";".join(references),
        "seconds": round(time.perf_counter() - started, 4),
        "qt": pose,
        "covariance": covariance,
    }


def _write_poses(pair: _Pair, rows: list[dict[str, Any]], columns: list[str]) -> None:
    """Write both files of a pair, the poses last: they stand for a finished pair."""
    with write_atomic(pair.csv) as temporary:
        pd.DataFrame(rows, columns=columns).to_csv(temporary, index=False)
    posed = [row for row in rows if row["qt"] is not None]
    unknown = [float("nan")] * 36
    covariances = [row["covariance"] or unknown for row in posed]
    trajectory = Trajectory(
        np.array([row["timestamp"] for row in posed], np.int64),
        [row["device_id"] for row in posed],
        np.array([row["qt"] for row in posed], np.float64).reshape(-1, 7),
        np.array(covariances, np.float64).reshape(-1, 6, 6) if any(row["covariance"] for row in posed) else None,
    )
    trajectory.write(pair.txt)
    (pair.out_dir / f".{pair.name}.partial.jsonl").unlink(missing_ok=True)


def explain_query(
    sessions_root: str | Path,
    retrieval_dir: str | Path,
    map_dir: str | Path,
    map_device: str,
    query_device: str,
    settings: LocalizeSettings | None = None,
    queries: str = "keyframes_pruned_subsampled",
    index: int = 0,
) -> tuple[VggtLocalizer, VggtQuery, VggtAnswer]:
    """Ask the predictor about one query of a finished run again, and return all that it said.

    Args:
        settings: with which the run was made.
        index: of the query in the keyframe list. The other arguments are those of `localize_pairs`.

    Returns:
        What `toolkit.show.visualize_prediction.draw_prediction` takes.

    Raises:
        ArtifactError: the retrieval or the triangulated map is missing.
    """
    capture = Capture.from_sessions_root(sessions_root)
    pair = _Pair(capture, map_device, query_device, Path(retrieval_dir), Path(retrieval_dir), queries)
    settings = settings or LocalizeSettings()
    local_map = LocalMap.load(map_path(map_dir, f"{map_device}_map", settings.features.kinds[0]))
    network, turns = _open_predictor(settings, capture, map_dir), _turns(settings, capture)
    localizer = VggtLocalizer(local_map, capture[f"{map_device}_map"], network, settings.predictor, turns)
    rows = pair.session.rows_of_keyframes(pair.session.keyframes(queries).iloc[[index]])[0]
    query = _vggt_query(pair.session, _read_query(pair.session, rows, pair.references(), turns), local_map)
    return localizer, query, localizer.localize([query])[0]


@dataclass(frozen=True)
class Map:
    """One device's map, ready for single pictures; nothing in it changes."""

    local_map: LocalMap
    localizer: PnpLocalizer
    embedder: Embedder
    descriptors: NDArray[np.float32]
    """(N, D) global descriptors of the posed map images."""
    images: NDArray[np.int64]
    """(N,) their indices in `local_map`."""

    @classmethod
    def open(cls, run: str | Path, scene: str, device: str, embedder: Embedder | None = None) -> "Map":
        """Open the map of a finished run.

        Args:
            run: the run folder, `<output_root>/<manifest name>`.
            scene: the capture's name.
            device: `ios`, `hl`, `spot`.
            embedder: the one that the run was embedded with; None: `vlad`.

        Raises:
            ArtifactError: the run has no such map yet, or was embedded by another embedder.
        """
        files = SceneFiles(Path(run), scene)
        session = f"{device}_map"
        local_map = LocalMap.load(files.maps / f"{session}.npz")
        vectors, table = load_embeddings(files.embeddings / session)
        names = [image_name(path) for path in table["abs_path"]]
        indices = np.array([local_map.index_of.get(name, -1) for name in names], np.int64)
        store = FeatureStore.of_session(files.features, session)
        localizer = PnpLocalizer(local_map, store)
        if embedder is None:
            embedder = create_embedder("vlad", vocabulary=files.embeddings / "vlad.npz")
        if embedder.dim != vectors.shape[1]:
            raise ArtifactError(
                f"{files.embeddings / session}: descriptors of length {vectors.shape[1]}, but `{embedder.name}` makes "
                f"{embedder.dim}. Give the embedder that this run was made with: Map.open(..., embedder=...)."
            )
        return cls(local_map, localizer, embedder, vectors[indices >= 0], indices[indices >= 0])


def localize_image(
    map: Map,  # noqa: A002 - the word of the trade
    image: str | Path | NDArray[np.uint8],
    camera: pycolmap.Camera,
    topk: int = 10,
) -> PoseEstimate:
    """Localize one picture in a map, which stays as it is.

    Args:
        map: an open map.
        image: a file, or pixels (H, W) or (H, W, 3) RGB uint8; upright, if the map's embedder is a learned one.
        camera: its intrinsics, with the size of the picture.
        topk: references to match with.

    Returns:
        The estimate: `world_from_rig` is world_from_cam, (4, 4), or None where `status` says why there is none.

    Raises:
        ImageError: the file cannot be read, or its size is not the camera's.
    """
    learned = map.embedder.inputs == "images"
    if isinstance(image, (str, Path)):
        gray = read_image(image, gray=True)  # as the map's images were read
        image = read_image(image) if learned else gray
    else:
        gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    if (camera.width, camera.height) != (image.shape[1], image.shape[0]):
        raise ImageError(
            f"The image is {image.shape[1]} x {image.shape[0]} pixels, its camera {camera.width} x {camera.height}. "
            "Give the intrinsics of the image as it is stored."
        )
    features: LocalFeatures = SiftExtractor().extract([gray])[0]
    scores = map.descriptors @ map.embedder.embed([image if learned else features])[0]
    best = np.argsort(-scores, kind="stable")[:topk]
    return map.localizer.localize([camera], np.eye(4)[None], [features], [map.images[best].tolist()])
