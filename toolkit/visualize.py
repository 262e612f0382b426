"""The visualize stage: recordings and still pictures of a scene, from the files that other stages left."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.images import read_for_display
from toolkit.errors import ArtifactError
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import pair_name
from toolkit.localizers.mapping import LocalMap
from toolkit.localizers.pnp import PnpLocalizer, PoseEstimate
from toolkit.manifest import VisualizeSettings
from toolkit.show.localization_view import Localizations, QueryDetails, ShownImage, record_localizations
from toolkit.show.recordings import SessionRecording, record_session, session_tracks, sure_points
from toolkit.show.stills import WorstQuery, draw_localization, draw_scene_png, draw_worst

Array = NDArray[np.float64]

REFERENCES = 4
"""References shown of a query, and matched with it again for the picture."""


WORST = 10
"""Queries of the sheet of the worst, over all pairs."""
MAX_FRAMES = 1000
"""Images of a session's recording at most, unless `every` says otherwise."""


@dataclass
class _Map:
    """A map session, and what was triangulated from it; the localizer is None where there is no such map."""

    session: Session
    localizer: PnpLocalizer | None
    store: FeatureStore | None

    def cloud(self) -> tuple[Array, NDArray[np.uint8] | None]:
        """Return the points, (P, 3), and their colors."""
        return (np.zeros((0, 3)), None) if self.localizer is None else sure_points(self.localizer.map)

    @cached_property
    def row_of(self) -> dict[str, int]:
        """Row of an image by its name."""
        return {self.session.image_name(row): row for row in range(len(self.session.images))}


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

    @cached_property
    def estimated(self) -> Array:
        """world_from_cam of the first images, (Q, 4, 4), NaN where there is no pose."""
        return self.world_from_rig @ self.session.rig_from_cam(np.array([rows[0] for rows in self.rows], int))

    def references(self, k: int) -> list[str]:
        """Names of the map images that query k was localized by, best first."""
        text = self.table["references"].iloc[k] if "references" in self.table else ""
        return text.split(";") if isinstance(text, str) and text else []

    def inliers(self) -> list[int]:
        return self.table["num_inliers"].fillna(0).astype(int).tolist()


def visualize_scene(
    sessions_root: str | Path,
    poses_dir: str | Path,
    features_dir: str | Path,
    map_dir: str | Path,
    out_dir: str | Path,
    settings: VisualizeSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    pairs: Sequence[Sequence[str]] | None = None,
) -> pd.DataFrame:
    """Draw every pair of a scene, and record every pair and session for the rerun viewer.

    Writes `<pair>.png`, the map from above; `localization_<pair>_<k>.png`, a query beside its references;
    `worst_<scene>.png`, the worst queries of all pairs; `<pair>.rrd`, the queries of a pair in their map; and
    `<scene>_<session>.rrd`, what a session holds.

    Args:
        sessions_root: folder `sessions` of the capture.
        poses_dir: folder of the poses, `<pair>.txt` and `<pair>.csv`.
        features_dir: folder of local features.
        map_dir: folder of the triangulated maps; a device without one is drawn without points.
        out_dir: where pictures and recordings go.
        settings: see `VisualizeSettings`; a dict holds what differs from the defaults. A query session without ground
            truth shows its cameras where they were localized.
        map_device: `all` or one device key; likewise `query_device`.
        pairs: only these [map device, query device]; None: all.

    Returns:
        One row a pair: map_device, query_device, queries, localized, seconds, still, recording.

    Raises:
        ArtifactError: there are no poses at all.
    """
    settings = VisualizeSettings.of(settings)
    capture, out = Capture.from_sessions_root(sessions_root), Path(out_dir)
    maps = [d for d in capture.devices if f"{d}_map" in capture and map_device in ("all", d)]
    askers = [d for d in capture.devices if f"{d}_query" in capture and query_device in ("all", d)]
    found: dict[tuple[str, str], _Results] = {}
    for pair in [(m, q) for m in maps for q in askers if pairs is None or [m, q] in [list(p) for p in pairs]]:
        stem = Path(poses_dir) / pair_name(capture.name, *pair)
        if stem.with_name(f"{stem.name}.txt").is_file():
            found[pair] = _load_results(stem, capture[f"{pair[1]}_query"])
    if not found:
        raise ArtifactError(f"{poses_dir}: no poses of {capture.name} for the devices asked for. Localize them first.")
    table, worst = [], []
    with tqdm(total=len(found), desc="visualize", unit="pair") as bar:
        for m in dict.fromkeys(m for m, _ in found):
            shown = _open_map(capture[f"{m}_map"], Path(features_dir), Path(map_dir))
            for q in [q for mapped, q in found if mapped == m]:
                started = time.perf_counter()
                name, results = pair_name(capture.name, m, q), found[m, q]
                located = _Pair(shown, results, Path(features_dir))
                draw_scene_png(
                    *shown.cloud(),
                    shown.session.world_from_cam(),
                    results.estimated,
                    results.true,
                    out / f"{name}.png",
                    up=settings.world_up,
                    title=f"{q} queries in the {m} map, seen from above",
                    map_tracks=session_tracks(shown.session),
                    query_tracks=session_tracks(results.session),
                )
                _draw_samples(out / f"localization_{name}", located, settings.samples)
                recording = out / f"{name}.rrd"
                if settings.recordings:
                    _record(recording, located, settings.matched_queries, settings.world_up)
                worst += [(located, int(k)) for k in located.localizations.worst_first()[:WORST]]
                row: dict[str, Any] = {"map_device": m, "query_device": q, "queries": len(results.table)}
                row["localized"] = int(np.isfinite(results.world_from_rig).all((1, 2)).sum())
                row["seconds"] = round(time.perf_counter() - started, 3)
                row |= {"still": str(out / f"{name}.png"), "recording": str(recording) if settings.recordings else ""}
                table.append(row)
                bar.update()
    _draw_worst(out / f"worst_{capture.name}.png", capture.name, worst)
    if settings.session_recordings:
        sides = dict.fromkeys((*((m, "map") for m, _ in found), *((q, "query") for _, q in found)))
        for device, split in sides:
            _record_session(out, capture, device, split, found, Path(poses_dir), Path(map_dir), settings)
    return pd.DataFrame(table)


def _load_results(stem: Path, session: Session) -> _Results:
    """Read the poses of a pair."""
    keys = {"timestamp": np.int64, "device_id": str}
    try:
        table = pd.read_csv(stem.with_name(f"{stem.name}.csv"), dtype=keys)
    except (OSError, ValueError) as error:
        raise ArtifactError(f"{stem}.csv cannot be read ({error}). Localize again.") from None
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
        return _Map(session, None, None)
    store = extract_session(session, features_dir, progress=False)
    return _Map(session, PnpLocalizer(LocalMap.load(path), store), store)


@dataclass
class _Pair:
    """The queries of a pair in their map. What a picture needs of a query is found when first asked for."""

    shown: _Map
    results: _Results
    features_dir: Path
    _details: dict[int, QueryDetails] = field(default_factory=dict)

    @cached_property
    def localizations(self) -> Localizations:
        results, row_of = self.results, self.shown.row_of
        centers = np.full((len(results.rows), 3), np.nan)
        poses = self.shown.session.world_from_cam()
        for k in range(len(centers)):
            known = [name for name in results.references(k) if name in row_of]
            if known:
                centers[k] = poses[row_of[known[0]], :3, 3]
        names = [results.session.image_name(int(rows[0])) for rows in results.rows]
        true = np.full_like(results.estimated, np.nan) if results.true is None else results.true
        return Localizations(
            names, results.table["status"].tolist(), results.estimated, true, results.inliers(), centers
        )

    def details(self, k: int) -> QueryDetails:
        """Return images, matches and references of query k, matched again: files of poses do not keep them."""
        if k not in self._details:
            self._details[k] = self._find_details(k)
        return self._details[k]

    def _find_details(self, k: int) -> QueryDetails:
        shown, results = self.shown, self.results
        session, rows = results.session, results.rows[k]
        store = extract_session(session, self.features_dir, rows=rows, progress=False)
        references = [name for name in results.references(k) if name in shown.row_of][:REFERENCES]
        found = _matches(shown, session, rows, store, references, str(results.table["method"].iloc[k]))
        poses = results.world_from_rig[k] @ session.rig_from_cam(rows)
        points = shown.localizer.map.points[found.point_index] if shown.localizer else np.zeros((0, 3))
        cameras = [
            ShownImage(
                session.image_name(int(row)), session.image_path(int(row)), _camera(session, int(row)), poses[number],
                found.pixels[found.camera_index == number], points[found.camera_index == number],
                found.point_index[found.camera_index == number],
            )
            for number, row in enumerate(rows)
        ]  # fmt: skip
        # Of a rig, the camera that contributes most comes first.
        cameras.sort(key=lambda camera: -len(camera.points))
        return QueryDetails(cameras, [self._reference(name, np.unique(found.point_index)) for name in references])

    def _reference(self, name: str, wanted: NDArray[np.int64]) -> ShownImage:
        shown, row = self.shown, self.shown.row_of[name]
        session = shown.session
        pose = session.world_from_cam(np.array([row]))[0]
        path, camera = session.image_path(row), _camera(session, row)
        if shown.localizer is None or shown.store is None or name not in shown.localizer.map.index_of:
            return ShownImage(name, path, camera, pose)
        local_map = shown.localizer.map
        keypoints, points = local_map.observations(local_map.index_of[name])
        seen = np.isin(points, wanted)
        pixels = shown.store[name].keypoints[keypoints[seen]].astype(np.float64)
        return ShownImage(name, path, camera, pose, pixels, local_map.points[points[seen]], points[seen])


def _camera(session: Session, row: int) -> pycolmap.Camera:
    return session.camera(str(session.images["sensor_id"].iloc[row]))


def _record(path: Path, pair: _Pair, matched_queries: int, world_up: ArrayLike | None) -> None:
    chosen = np.sort(pair.localizations.worst_first()[:matched_queries])
    details = ((int(k), pair.details(int(k))) for k in chosen)
    poses = pair.shown.session.world_from_cam()
    record_localizations(path, path.stem, poses, *pair.shown.cloud(), pair.localizations, details, up=world_up)


def _record_session(
    out: Path,
    capture: Capture,
    device: str,
    split: str,
    found: dict[tuple[str, str], _Results],
    poses_dir: Path,
    map_dir: Path,
    settings: VisualizeSettings,
) -> SessionRecording:
    session = capture[f"{device}_{split}"]
    poses = None
    if split == "query" and session.ground_truth is None:
        # The device's own map is the nearest to a truth that there is.
        maps = [m for m, q in found if q == device]
        poses = poses_dir / f"{pair_name(capture.name, device if device in maps else maps[0], device)}.txt"
    return record_session(
        capture.path,
        split,
        device,
        keyframes_only=settings.keyframes_only and split == "query",
        every=settings.every or 1 + len(session.images) // MAX_FRAMES,
        vis_retrieve_queries=poses is not None,
        queries_pose=poses,
        out=out / f"{capture.name}_{session.id}.rrd",
        map_dir=map_dir,
        world_up=settings.world_up,
        progress=False,
    )


def _draw_samples(stem: Path, pair: _Pair, samples: int) -> None:
    """Draw queries beside their references, from the least to the best supported."""
    results = pair.results
    order = np.argsort(results.inliers(), kind="stable")
    chosen = order[np.unique(np.linspace(0, len(order) - 1, min(samples, len(order))).round().astype(int))]
    for number, k in enumerate(chosen, start=1):
        details = pair.details(int(k))
        camera = details.cameras[0]
        rows = results.rows[k]
        row = next(row for row in rows if results.session.image_name(int(row)) == camera.name)
        truth = results.session.world_from_cam(np.array([row]), ground_truth=True)[0]
        references = [
            (read_for_display(image.path), f"reference {rank}")
            for rank, image in enumerate(details.references, start=1)
        ]
        draw_localization(
            read_for_display(camera.path),
            camera.camera,
            camera.world_from_cam,
            camera.points,
            references,
            stem.with_name(f"{stem.name}_{number}.png"),
            title=f"{results.session.device} query in the {pair.shown.session.device} map: "
            f"{results.table['status'].iloc[k]}",
            keypoints=camera.pixels,
            world_from_cam_true=truth if np.isfinite(truth).all() else None,
        )


def _draw_worst(path: Path, scene: str, worst: list[tuple[_Pair, int]]) -> None:
    """Draw the worst queries of all pairs: those without a pose, then by error."""

    def badness(entry: tuple[_Pair, int]) -> tuple[bool, float, int]:
        queries, k = entry[0].localizations, entry[1]
        lost = not np.isfinite(queries.estimated[k]).all()
        return not lost, -float(np.nan_to_num(queries.errors[1][k], nan=-1.0)), int(queries.inliers[k])

    shown = []
    for pair, k in sorted(worst, key=badness)[:WORST]:
        row, details = pair.results.table.iloc[k], pair.details(k)
        reason = str(row["status"])
        counts = [f"{row[name]:.0f} {text}" for name, text in (("num_matches", "matches"), ("num_inliers", "inliers"))
                  if name in row and pd.notna(row[name])]  # fmt: skip
        rotation_deg, error_m = (float(values[k]) for values in pair.localizations.errors)
        shown.append(
            WorstQuery(
                f"{pair.results.session.device} in the {pair.shown.session.device} map",
                ", ".join([reason, *counts]),
                details.cameras[0],
                details.references[0] if details.references else None,
                rotation_deg,
                error_m,
            )
        )
    draw_worst(shown, path, f"{scene}: the {len(shown)} worst queries of all pairs")


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
