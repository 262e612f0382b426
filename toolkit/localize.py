"""The localize stage: references and local features in, one pose a query device out."""

import json
import logging
import time
from dataclasses import asdict, dataclass
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
from toolkit.embedders import Embedder, create_embedder, load_embeddings
from toolkit.errors import ArtefactError, ImageError, ManifestError
from toolkit.features import FeatureSettings, FeatureStore, LocalFeatures, SiftExtractor, extract_session
from toolkit.files import (
    SceneFiles,
    file_fingerprint,
    fingerprint,
    is_current,
    pair_name,
    write_atomic,
    write_sidecar,
    write_text,
)
from toolkit.images import default_workers, prefetch, read_image
from toolkit.localizers.pnp import PnpLocalizer, PnpSettings, PoseEstimate
from toolkit.mapping import LocalMap, MapSettings, build_map

log = logging.getLogger(__name__)

METHODS = ("pnp", "nearest")
COLUMNS = [
    "timestamp", "device_id", "status", "method", "num_inliers", "num_matches", "inlier_ratio", "num_guided",
    "rmse_px", "rival_support", "position_std_m", "rotation_std_deg", "references", "seconds",
]  # fmt: skip


def localize_pairs(
    sessions_root: str | Path,
    retrieval_dir: str | Path,
    out_dir: str | Path,
    features_dir: str | Path,
    map_dir: str | Path,
    map_device: str = "all",
    query_device: str = "all",
    method: str = "pnp",
    queries: str = "keyframes_pruned_subsampled",
    skip_existing: bool = True,
    workers: int = 0,
    seed: int = 0,
) -> pd.DataFrame:
    """Write, for every pair of devices, the poses of the queries (`.txt`) and how they came about (`.csv`).

    Args:
        sessions_root: `<capture>/sessions`.
        retrieval_dir: folder of the retrieval stage's files.
        out_dir: folder of the poses.
        features_dir: folder of local features, shared with the embed stage.
        map_dir: folder of the triangulated maps, `<device>_map.npz`.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` that the capture has.
        method: `pnp`, or the baseline `nearest`: the pose of the best reference, marked so in the table.
        queries: the keyframe list that says which devices are asked for, or `all`.
        skip_existing: reuse what was made from the same inputs and settings, and go on where a run was killed.
        workers: threads; 0 takes the number of cores, at most 8.
        seed: of RANSAC. Equal seeds give equal files, whatever the number of threads.

    Returns:
        One row a pair: map_device, query_device, queries, ok, low_confidence, failed, seconds, skipped, path.

    Raises:
        ManifestError: unknown method.
        CaptureError: unknown device or list.
        ArtefactError: the retrieval of a pair is missing.
    """
    if method not in METHODS:
        raise ManifestError(f"Unknown method {method!r}. Known: {', '.join(METHODS)}.")
    capture = Capture.from_sessions_root(sessions_root)
    settings = PnpSettings(seed=seed)
    workers = workers or default_workers()
    table = []
    with threadpool_limits(1, "blas"):  # queries are the parallel dimension, and sums stay in one order
        for mapped in capture.devices_with("map", map_device):
            localizer: PnpLocalizer | None = None
            for asked in capture.devices_with("query", query_device):
                started = time.perf_counter()
                pair = _Pair(capture, mapped, asked, Path(retrieval_dir), Path(out_dir), queries)
                record = pair.record(settings, method)
                skipped = skip_existing and is_current(pair.txt, record) and pair.csv.exists()
                if not skipped:
                    if method == "pnp" and localizer is None:
                        session = capture[f"{mapped}_map"]
                        localizer = _open_localizer(
                            session, Path(features_dir), Path(map_dir), settings, workers, skip_existing
                        )
                    rows = _localize_pair(pair, localizer, Path(features_dir), record, workers, skip_existing)
                    _write_poses(pair, rows)
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
        path = self.retrieval_dir / f"{self.name}.jsonl"
        if not path.exists():
            raise ArtefactError(
                f"No retrieval of map {self.map_device} and query {self.query_device}: {path} is missing. "
                "Run the retrieve stage first (python -m toolkit run MANIFEST --only retrieve)."
            )
        return path

    @property
    def txt(self) -> Path:
        return self.out_dir / f"{self.name}.txt"

    @property
    def csv(self) -> Path:
        return self.out_dir / f"{self.name}.csv"

    @property
    def session(self) -> Session:
        return self.capture[f"{self.query_device}_query"]

    def record(self, settings: PnpSettings, method: str) -> dict[str, Any]:
        """Return what the poses depend on."""
        keyframes = self.session.keyframes(self.queries)
        return {
            "method": method,
            "pnp": asdict(settings),
            "map": asdict(MapSettings(seed=settings.seed)),
            "features": asdict(FeatureSettings()),
            "retrieval": file_fingerprint(self.retrieval),
            "map_session": session_fingerprint(self.capture[f"{self.map_device}_map"]),
            "query_session": session_fingerprint(self.session),
            "images": [self.capture[f"{self.map_device}_map"].files_fingerprint, self.session.files_fingerprint],
            "keyframes": fingerprint([keyframes["timestamp"].astype(str).tolist(), keyframes["device_id"].tolist()]),
        }

    def references(self) -> dict[tuple[int, str], list[dict[str, Any]]]:
        """Return for each query image (timestamp, sensor) the retrieved map images, best first."""
        found = {}
        with open(self.retrieval, encoding="utf-8") as lines:
            for number, line in enumerate(lines, start=1):
                try:
                    row = json.loads(line)
                    found[int(row["timestamp"]), str(row["sensor_id"])] = row["topk"]
                except (ValueError, KeyError, TypeError) as error:
                    raise ArtefactError(
                        f"{self.retrieval}, line {number}: not a retrieval row ({error!r}). Retrieve again."
                    ) from None
        return found


def session_fingerprint(session: Session) -> str:
    """Return 16 hex digits that identify the calibration, poses and image list of a session."""
    files = ["sensors.txt", "images.txt", "rigs.txt", "trajectories.txt"]
    return fingerprint([file_fingerprint(session.path / name) for name in files if (session.path / name).exists()])


def _open_localizer(
    session: Session,
    features_dir: Path,
    map_dir: Path,
    settings: PnpSettings,
    workers: int,
    skip_existing: bool,
) -> PnpLocalizer:
    """Build or load the triangulated map of a session."""
    store = extract_session(session, features_dir, workers=workers)
    inputs = fingerprint([session_fingerprint(session), store.fingerprint])
    path = map_dir / f"{session.id}.npz"
    local_map = build_map(session, store, path, MapSettings(seed=settings.seed), skip_existing, inputs, workers)
    return PnpLocalizer(local_map, store, settings)


def _localize_pair(
    pair: _Pair,
    localizer: PnpLocalizer | None,
    features_dir: Path,
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
    store = None
    if localizer is not None:
        rows = np.unique(np.concatenate([*members, np.zeros(0, np.int64)]))
        store = extract_session(session, features_dir, rows=rows, workers=workers)

    def solve(index: int) -> dict[str, Any]:
        started = time.perf_counter()
        query = _read_query(session, members[index], references)
        estimate, names = PoseEstimate("failed: no images of this device at this time"), list[str]()
        if query.names and localizer is not None and store is not None:
            estimate, names = _pnp(query, localizer, store)
        elif query.names:
            estimate, names = _nearest(query)
        return _row(keys[index], estimate, names, "nearest" if localizer is None else "pnp", started)

    progress = pair.out_dir / f".{pair.name}.partial.jsonl"
    done = _read_progress(progress, record) if skip_existing else {}
    todo = [index for index, key in enumerate(keys) if key not in done]
    finished = [{"record": fingerprint(record)}, *done.values()]
    write_text(progress, "".join(json.dumps(line) + "\n" for line in finished))
    with open(progress, "a", encoding="utf-8") as stream:
        label = f"localize {pair.query_device} in {pair.map_device}"
        for row in tqdm(prefetch(solve, todo, workers), total=len(todo), desc=label, unit="query"):
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            done[row["timestamp"], row["device_id"]] = row
    return [done[key] for key in keys]


def _read_progress(path: Path, record: dict[str, Any]) -> dict[tuple[int, str], dict[str, Any]]:
    """Return the rows that a killed run finished, if it was asked the same."""
    if not path.exists():
        return {}
    done: dict[tuple[int, str], dict[str, Any]] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines()):
        try:
            row = json.loads(line)
        except ValueError:
            break  # the line that was being written
        if number == 0:
            if row != {"record": fingerprint(record)}:
                return {}
        else:
            done[row["timestamp"], row["device_id"]] = row
    return done


@dataclass(frozen=True)
class _QueryDevice:
    """The images of one query device at one instant."""

    names: list[str]
    cameras: list[pycolmap.Camera]
    rig_from_cams: NDArray[np.float64]
    references: list[list[dict[str, Any]]]


def _read_query(
    session: Session, rows: NDArray[np.int64], references: dict[tuple[int, str], list[dict[str, Any]]]
) -> _QueryDevice:
    images = session.images.iloc[rows]
    keys = list(zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True))
    return _QueryDevice(
        names=[session.image_name(int(row)) for row in rows],
        cameras=[session.camera(sensor) for _, sensor in keys],
        rig_from_cams=session.rig_from_cam(rows),
        references=[references.get(key, []) for key in keys],
    )


def _reference_name(reference: dict[str, Any]) -> str:
    """Return the image name (`<session>/raw_data/<path>`) of a retrieved image (`<scene>/sessions/<name>`)."""
    return str(reference["path"]).split("/sessions/", 1)[-1]


def _pnp(query: _QueryDevice, localizer: PnpLocalizer, store: FeatureStore) -> tuple[PoseEstimate, list[str]]:
    usable = [index for index, name in enumerate(query.names) if name in store]
    if not usable:
        reasons = "; ".join(store.failed.get(name, "no features") for name in query.names)
        return PoseEstimate(f"failed: no readable image ({reasons})"), []
    index_of = localizer.map.index_of
    references = [
        [index_of[name] for name in map(_reference_name, query.references[index]) if name in index_of]
        for index in usable
    ]
    try:
        estimate = localizer.localize(
            [query.cameras[index] for index in usable],
            query.rig_from_cams[usable],
            [store[query.names[index]] for index in usable],
            references,
        )
    except Exception as error:  # one bad query never ends a run
        log.exception("localizing %s", query.names[0])
        return PoseEstimate(f"failed: {type(error).__name__}: {error}"), []
    return estimate, [localizer.map.image_names[index] for index in estimate.references]


def _nearest(query: _QueryDevice) -> tuple[PoseEstimate, list[str]]:
    """Return the pose that puts the camera with the best score at its first reference."""
    best = [(refs[0]["score"], index) for index, refs in enumerate(query.references) if refs]
    if not best:
        return PoseEstimate("failed: no references"), []
    index = max(best)[1]
    reference = query.references[index][0]
    world_from_rig = np.array(reference["Tws"], np.float64) @ geometry.invert(query.rig_from_cams[index])
    return PoseEstimate("low_confidence", world_from_rig), [_reference_name(reference)]


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


def _write_poses(pair: _Pair, rows: list[dict[str, Any]]) -> None:
    """Write both files of a pair, the poses last: they stand for a finished pair."""
    with write_atomic(pair.csv) as temporary:
        pd.DataFrame(rows, columns=[*COLUMNS]).to_csv(temporary, index=False)
    posed = [row for row in rows if row["qt"] is not None]
    covariances = [row["covariance"] for row in posed]
    trajectory = Trajectory(
        np.array([row["timestamp"] for row in posed], np.int64),
        [row["device_id"] for row in posed],
        np.array([row["qt"] for row in posed], np.float64).reshape(-1, 7),
        np.array(covariances, np.float64).reshape(-1, 6, 6) if posed and None not in covariances else None,
    )
    trajectory.write(pair.txt)
    (pair.out_dir / f".{pair.name}.partial.jsonl").unlink(missing_ok=True)


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
            ArtefactError: the run has no such map yet, or was embedded by another embedder.
        """
        files = SceneFiles(Path(run), scene)
        session = f"{device}_map"
        local_map = LocalMap.load(files.maps / f"{session}.npz")
        vectors, table = load_embeddings(files.embeddings / session)
        names = [path.split("/sessions/", 1)[-1] for path in table["abs_path"]]
        indices = np.array([local_map.index_of.get(name, -1) for name in names], np.int64)
        localizer = PnpLocalizer(local_map, FeatureStore.open(files.features / session))
        if embedder is None:
            embedder = create_embedder("vlad", vocabulary=files.embeddings / "vlad.npz")
        if embedder.dim != vectors.shape[1]:
            raise ArtefactError(
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
    features: LocalFeatures = SiftExtractor()(gray)
    scores = map.descriptors @ map.embedder.embed([image if learned else features])[0]
    best = np.argsort(-scores, kind="stable")[:topk]
    return map.localizer.localize([camera], np.eye(4)[None], [features], [map.images[best].tolist()])
