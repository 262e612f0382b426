"""The visualize stage: recordings and still pictures of a scene, from the files that other stages left."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session, Trajectory
from toolkit.errors import ArtefactError
from toolkit.features import FeatureStore, extract_session
from toolkit.files import pair_name
from toolkit.images import read_for_display
from toolkit.localizers.pnp import PnpLocalizer, PoseEstimate
from toolkit.mapping import LocalMap
from toolkit.recordings import Queries, Views, record_scene
from toolkit.stills import draw_localization, draw_scene_png

Array = NDArray[np.float64]

REFERENCES = 4
"""References shown of a query, and matched with it again for the picture."""


@dataclass
class _Map:
    """A map session, and what was triangulated from it; the localizer is None where there is no such map."""

    session: Session
    localizer: PnpLocalizer | None

    def cloud(self) -> tuple[Array, NDArray[np.uint8] | None]:
        """Return the points that at least three images see, (P, 3), and their colours; the rest is noisy."""
        if self.localizer is None:
            return np.zeros((0, 3)), None
        sure = self.localizer.map.track_lengths >= 3
        return self.localizer.map.points[sure], self.localizer.map.colors[sure]


@dataclass
class _Results:
    """The queries of a pair, a row each; the first image of a device stands for it."""

    session: Session
    table: pd.DataFrame
    """The pair's csv, of the queries that have an image."""
    rows: list[NDArray[np.int64]]
    """Rows of the session's images of each query."""
    world_from_rig: Array
    """(Q, 4, 4), NaN where there is no pose."""
    true: Array | None
    """world_from_cam of the first images, (Q, 4, 4); None where the session has no ground truth."""

    @property
    def estimated(self) -> Array:
        return self.world_from_rig @ self.session.rig_from_cam(np.array([rows[0] for rows in self.rows], int))


def visualize_scene(
    sessions_root: str | Path,
    poses_dir: str | Path,
    features_dir: str | Path,
    map_dir: str | Path,
    out_dir: str | Path,
    map_device: str = "all",
    query_device: str = "all",
    samples: int = 2,
    recordings: bool = True,
    world_up: ArrayLike | None = None,
    pairs: Sequence[Sequence[str]] | None = None,
) -> pd.DataFrame:
    """Draw every pair of a scene, and record every map with its queries.

    Writes `<pair>.png`, the map from above; `localization_<pair>_<k>.png`, a query beside its references; and
    for each map `<scene>_map_<M>.rrd`, a recording for the rerun viewer.

    Args:
        sessions_root: folder `sessions` of the capture.
        poses_dir: folder of the poses, `<pair>.txt` and `<pair>.csv`.
        features_dir: folder of local features.
        map_dir: folder of the triangulated maps; a device without one is drawn without points.
        out_dir: where pictures and recordings go.
        map_device: `all` or one device key; likewise `query_device`.
        samples: queries shown of each pair, from the least to the best supported.
        recordings: whether to write recordings.
        world_up: direction (3,) that is up; None: estimated from the cameras.
        pairs: only these [map device, query device]; None: all.

    Returns:
        One row a pair: map_device, query_device, queries, localized, seconds, still, recording.

    Raises:
        ArtefactError: there are no poses at all.
    """
    capture, out = Capture.from_sessions_root(sessions_root), Path(out_dir)
    maps = [d for d in capture.devices if f"{d}_map" in capture and map_device in ("all", d)]
    askers = [d for d in capture.devices if f"{d}_query" in capture and query_device in ("all", d)]
    found: dict[tuple[str, str], _Results] = {}
    for pair in [(m, q) for m in maps for q in askers if pairs is None or [m, q] in [list(p) for p in pairs]]:
        stem = Path(poses_dir) / pair_name(capture.name, *pair)
        if stem.with_name(f"{stem.name}.txt").is_file():
            found[pair] = _load_results(stem, capture[f"{pair[1]}_query"])
    if not found:
        raise ArtefactError(
            f"{poses_dir}: no poses of {capture.name} for the devices asked for. Localize them first."
        )
    table = []
    with tqdm(total=len(found), desc="visualize", unit="pair") as bar:
        for m in dict.fromkeys(m for m, _ in found):
            of_map = {q: results for (mapped, q), results in found.items() if mapped == m}
            shown = _open_map(capture[f"{m}_map"], Path(features_dir), Path(map_dir))
            recording = out / f"{capture.name}_map_{m}.rrd"
            if recordings:
                _record(recording, shown, of_map, world_up)
            for q, results in of_map.items():
                started = time.perf_counter()
                name = pair_name(capture.name, m, q)
                draw_scene_png(
                    *shown.cloud(),
                    shown.session.world_from_cam(),
                    results.estimated,
                    results.true,
                    out / f"{name}.png",
                    up=world_up,
                    title=f"{q} queries in the {m} map, seen from above",
                )
                _draw_samples(out / f"localization_{name}", shown, results, Path(features_dir), samples)
                row: dict[str, Any] = {"map_device": m, "query_device": q, "queries": len(results.table)}
                row["localized"] = int(np.isfinite(results.world_from_rig).all((1, 2)).sum())
                row["seconds"] = round(time.perf_counter() - started, 3)
                row |= {"still": str(out / f"{name}.png"), "recording": str(recording) if recordings else ""}
                table.append(row)
                bar.update()
    return pd.DataFrame(table)


def _load_results(stem: Path, session: Session) -> _Results:
    """Read the poses of a pair."""
    keys = {"timestamp": np.int64, "device_id": str}
    try:
        table = pd.read_csv(stem.with_name(f"{stem.name}.csv"), dtype=keys)
    except (OSError, ValueError) as error:
        raise ArtefactError(f"{stem}.csv cannot be read ({error}). Localize again.") from None
    rows = session.rows_of_keyframes(table)
    have = np.array([len(part) > 0 for part in rows], bool)
    table, rows = table[have].reset_index(drop=True), [part for part in rows if len(part)]
    times, devices = table["timestamp"].to_numpy(), table["device_id"].to_numpy(str)
    poses = Trajectory.read(stem.with_name(f"{stem.name}.txt")).lookup(times, devices)
    first = np.array([part[0] for part in rows], int)
    true = None if session.ground_truth is None else session.world_from_cam(first, ground_truth=True)
    return _Results(session, table, rows, poses, true)


def _open_map(session: Session, features_dir: Path, map_dir: Path) -> _Map:
    path = map_dir / f"{session.id}.npz"
    if not path.is_file():
        return _Map(session, None)
    store = extract_session(session, features_dir, progress=False)
    return _Map(session, PnpLocalizer(LocalMap.load(path), store))


def _record(path: Path, shown: _Map, pairs: dict[str, _Results], world_up: ArrayLike | None) -> None:
    everything = np.arange(len(shown.session.images))
    poses = shown.session.world_from_cam()
    posed = everything[np.isfinite(poses).all((1, 2))]
    queries = {}
    for device, results in pairs.items():
        first = np.array([rows[0] for rows in results.rows], int)
        names = [results.session.image_name(int(row)) for row in first]
        views = _views(results.session, first, results.estimated)
        status = results.table["status"].tolist()
        queries[device] = Queries(results.estimated, results.true, names, status, views)
    views = _views(shown.session, posed, poses[posed])
    record_scene(path, views, *shown.cloud(), queries, up=world_up, name=path.stem)


def _views(session: Session, rows: NDArray[np.int64], world_from_cam: Array) -> Views:
    cameras = [session.camera(str(sensor)) for sensor in session.images["sensor_id"].iloc[rows]]
    names = [session.image_name(int(row)) for row in rows]
    return Views(world_from_cam, cameras, [session.image_path(int(row)) for row in rows], names)


def _draw_samples(stem: Path, shown: _Map, results: _Results, features_dir: Path, samples: int) -> None:
    """Draw queries beside their references, from the least to the best supported."""
    order = np.argsort(results.table["num_inliers"].fillna(0).to_numpy(), kind="stable")
    chosen = order[np.unique(np.linspace(0, len(order) - 1, min(samples, len(order))).round().astype(int))]
    rows = np.concatenate([results.rows[k] for k in chosen] or [np.zeros(0, np.int64)])
    store = extract_session(results.session, features_dir, rows=rows, progress=False) if len(rows) else None
    files = {
        shown.session.image_name(k): shown.session.image_path(k) for k in range(len(shown.session.images))
    }
    for number, k in enumerate(chosen, start=1):
        query, images = results.table.iloc[k], results.rows[k]
        text = query["references"] if isinstance(query["references"], str) else ""
        references = [name for name in text.split(";") if name in files][:REFERENCES]
        estimate = _matches(shown, results.session, images, store, references, str(query["method"]))
        # Of a rig, the camera that contributes most is shown.
        shares = np.bincount(estimate.camera_index, minlength=len(images))
        camera = int(np.argmax(shares))
        mine, row = estimate.camera_index == camera, images[camera : camera + 1]
        truth = results.session.world_from_cam(row, ground_truth=True)[0]
        draw_localization(
            read_for_display(results.session.image_path(int(row[0]))),
            results.session.camera(str(results.session.images["sensor_id"].iloc[int(row[0])])),
            results.world_from_rig[k] @ results.session.rig_from_cam(row)[0],
            shown.localizer.map.points[estimate.point_index[mine]] if shown.localizer else (),
            [(read_for_display(files[name]), f"reference {n}") for n, name in enumerate(references, start=1)],
            stem.with_name(f"{stem.name}_{number}.png"),
            title=f"{results.session.device} query in the {shown.session.device} map: {query['status']}",
            keypoints=estimate.pixels[mine],
            world_from_cam_true=truth if np.isfinite(truth).all() else None,
        )


def _matches(
    shown: _Map,
    session: Session,
    images: NDArray[np.int64],
    store: FeatureStore | None,
    references: list[str],
    method: str,
) -> PoseEstimate:
    """Match a query with its first references again: files of poses do not keep which points agreed."""
    names = [session.image_name(int(row)) for row in images]
    if "pnp" not in method or shown.localizer is None or store is None or any(n not in store for n in names):
        return PoseEstimate("failed: not matched")
    index_of = shown.localizer.map.index_of
    known = [index_of[name] for name in references if name in index_of]
    cameras = [session.camera(str(sensor)) for sensor in session.images["sensor_id"].iloc[images]]
    features = [store[name] for name in names]
    return shown.localizer.localize(cameras, session.rig_from_cam(images), features, [known] * len(images))
