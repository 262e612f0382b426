"""The sequence stage: combine single query poses with odometry to estimate the pose of every frame of a recording."""

import glob
import logging
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.images import default_workers, prefetch
from toolkit.capture.tables import POSE_NAMES, KeyIndex, as_strings, in_unit_of_poses
from toolkit.errors import OF_THE_DATA, ArtifactError, reason_of
from toolkit.files import (
    SceneFiles,
    file_fingerprint,
    is_current,
    map_record_path,
    pair_name,
    read_map_record,
    read_sidecar,
    require_whole,
    write_csv,
    write_sidecar,
)
from toolkit.geometry import Floats, Ints, pose_error
from toolkit.manifest import SequenceSettings
from toolkit.pose.base import QueryResult, RoughPose, Status, status_counts, statuses, stds_of
from toolkit.results.pair import PairResults
from toolkit.scene.frames import LocalizedFrames, SequenceLocalizer, localize_sequence
from toolkit.scene.map import Map
from toolkit.sequences.odometry import (
    UNKNOWN_COVARIANCE,
    Odometry,
    PosedQueries,
    cut,
    device_names,
    recordings_of,
    vote_weights,
    with_measured_drift,
)
from toolkit.sequences.pose_graph import localize_piece, place_online
from toolkit.threads import fixed_sums

log = logging.getLogger(__name__)

__all__ = ["LocalizedFrames", "Odometry", "SequenceLocalizer", "localize_sequence", "sequence_pairs"]

SUFFIX = "_sequence"
"""Suffix of the stage's files, which lie beside those of the localize stage: `<pair>_sequence.txt`."""
COLUMNS = (
    "timestamp", "device_id", "recording", "piece", "status", "position_std_m", "rotation_std_deg", "single_status",
    "again_status", "used", "moved_m", "turned_deg",
)  # fmt: skip
"""Columns of `<pair>_sequence.csv`. `single_status` and `again_status` are the statuses of a query localized alone and
again near its predicted pose, empty for none. `used`: the query's own pose agrees with the result of its piece.
`moved_m` and `turned_deg` are the differences between the query's result and its first single pose. If the unit of the
poses is unknown, lengths are named by `in_unit_of_poses`."""
WINDOWS_S = (10.0, 20.0)
"""For comparison, the poses that the setting `online` would give from single queries are also written: for each of
these lengths of earlier data, in seconds, and for all earlier data."""
STEP_COLUMNS = ("step", "timestamp", "device_id", *POSE_NAMES)
"""Columns of `<pair>_sequence_steps.csv`: the poses of queries after each of `STEPS`."""


@fixed_sums
def sequence_pairs(
    sessions_root: str | Path,
    poses_dir: str | Path,
    settings: SequenceSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    pairs: Sequence[Sequence[str]] | None = None,
    skip_existing: bool = True,
) -> pd.DataFrame:
    """Write the poses of all frames of the queries' recordings, and a table of them, for each pair of devices.

    `<poses_dir>/<pair>_sequence.txt` has the poses of all frames of the odometry and of localized queries without
    odometry. `<pair>_sequence.csv` has a row with `COLUMNS` for each of them, including those without a pose.
    `<pair>_sequence_steps.csv` has the queries' poses after intermediate steps.

    Args:
        sessions_root: `<capture>/sessions`. The odometry is trajectories.txt of a query session, interpolated at
            queries between two of its poses.
        poses_dir: RUN/SCENE/poses, the folder of the localize stage's poses; the results go there, too.
        settings: see `SequenceSettings`; a dict holds values that differ from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` devices of the capture.
        pairs: only these [map device, query device]; None: all of the chosen devices.
        skip_existing: reuse results that were made from the same inputs and settings.

    Returns:
        One row per pair: map_device, query_device, frames = ok + low_confidence + failed, pieces, queries (with a
        single pose), again (localized again), used (their own pose agrees with the result), seconds, skipped, path,
        reason. A pair without odometry or poses has zeros and a `reason`.

    Raises:
        ManifestError: a setting is not valid, or GTSAM is not installed.
        CaptureError: unknown device.
    """
    settings = SequenceSettings.of(settings)
    capture = Capture.from_sessions_root(sessions_root)
    rows = []
    for devices in capture.pairs(map_device, query_device, pairs):
        row = {"map_device": devices[0], "query_device": devices[1], **dict.fromkeys(_COUNTS, 0)}
        row |= {"seconds": 0.0, "skipped": False, "path": "", "reason": ""}
        try:
            row |= _place_pair(capture, *devices, Path(poses_dir), settings, skip_existing)
        except OF_THE_DATA as error:
            row["reason"] = str(error)
            # Remove results of an earlier run, which would look like results of this one.
            stem = pair_name(capture.name, *devices)
            for stale in Path(poses_dir).glob(f"{glob.escape(stem)}{SUFFIX}*"):
                stale.unlink()
        rows.append(row)
    return pd.DataFrame(rows)


_COUNTS = ("frames", "ok", "low_confidence", "failed", "pieces", "queries", "again", "used")


def _place_pair(
    capture: Capture, map_device: str, query_device: str, poses_dir: Path, settings: SequenceSettings,
    skip_existing: bool,
) -> dict[str, Any]:  # fmt: skip
    started = time.perf_counter()
    session = capture[f"{query_device}_query"]
    stem = poses_dir / pair_name(capture.name, map_device, query_device)
    poses, table, out = (stem.with_name(f"{stem.name}{end}") for end in (".txt", ".csv", f"{SUFFIX}.txt"))
    if session.odometry is None:
        raise ArtifactError(f"{session.path} has no trajectories.txt: there is no odometry of {session.id}.")
    inputs = {poses: "poses", table: "table of the queries"}
    for path, what in inputs.items():
        if not path.exists():
            raise ArtifactError(f"{path}: no {what} of this pair. Localize first.")
    require_whole(poses)
    record: dict[str, Any] = {
        "sequence": settings.model_dump(),
        "poses": [file_fingerprint(path) for path in inputs],
        "odometry": file_fingerprint(session.path / "trajectories.txt"),
    }
    if settings.relocalize:
        record["localize"] = read_sidecar(poses)
    skipped = skip_existing and is_current(out, record)
    if not skipped:
        relocalizer = _Relocalizer(poses_dir, capture.name, map_device, session) if settings.relocalize else None
        frames, steps, trajectory = _frames(session, _SingleQueries.of(PairResults.open(poses)), settings, relocalizer)
        unit = read_map_record(map_record_path(poses_dir, capture.name, map_device))["unit"]
        csvs = {out.with_suffix(".csv"): in_unit_of_poses(frames, unit), out.with_name(f"{out.stem}_steps.csv"): steps}
        for path, rows in csvs.items():
            write_csv(path, rows)
        trajectory.write(out)
        write_sidecar(out, record, list(csvs), made_from=inputs, unfinished=bool(relocalizer and relocalizer.met_a_bug))
    frames = pd.read_csv(out.with_suffix(".csv"), keep_default_na=False)
    return {
        "frames": len(frames),
        **status_counts(statuses(frames["status"])),
        "pieces": len(frames[["recording", "piece"]].drop_duplicates()),
        "queries": int((frames["turned_deg"] != "").sum()),
        "again": int((frames["again_status"] != "").sum()),
        "used": int((frames["used"].astype(str) == "True").sum()),
        "seconds": round(time.perf_counter() - started, 2),
        "skipped": skipped,
        "path": str(out),
    }


@dataclass(frozen=True)
class _Piece:
    """A piece of a recording's odometry, N frames."""

    recording: str
    device_ids: NDArray[np.object_]
    """(N,)."""
    motion: Odometry
    query: Ints
    """(N,) index of each frame's query, -1 for none."""
    posed: PosedQueries
    """The queries that have a pose."""

    @property
    def query_frames(self) -> Ints:
        """(A,) frames of all queries."""
        return np.flatnonzero(self.query >= 0)

    def part(self, rows: slice) -> "_Piece":
        device_ids, posed = self.device_ids[rows], self.posed.part(rows)
        return _Piece(self.recording, device_ids, self.motion.part(rows), self.query[rows], posed)


@dataclass(frozen=True)
class _SingleQueries:
    """Q queries with the results of the localize stage."""

    keys: pd.DataFrame
    """Table [timestamp, device_id]."""
    status: NDArray[np.object_]
    results: PosedQueries
    """Of all queries, NaN for one without a pose; `frames` counts the queries."""

    @classmethod
    def of(cls, results: PairResults) -> "_SingleQueries":
        rows = results.table.drop_duplicates(["timestamp", "device_id"], ignore_index=True)
        results = replace(results, table=rows)
        status = rows["status_text"].to_numpy(object)
        evidence = rows.reindex(columns=["p_correct", "rival_support"]).to_numpy(float)
        ok = (rows["status"] == Status.OK).to_numpy(bool)
        known = np.asarray(np.isfinite(results.covariances).all(axis=(1, 2)), bool)
        covariances = np.asarray(np.where(known[:, None, None], results.covariances, UNKNOWN_COVARIANCE))
        queries = PosedQueries(np.arange(len(rows)), results.poses, covariances, vote_weights(ok, *evidence.T), ok)
        return cls(rows[["timestamp", "device_id"]], status, queries)

    def posed(self, rows: Ints) -> PosedQueries:
        """Return the queries with a pose among the frames of a piece; rows (N,) are the query of each, -1 for none."""
        frames = np.flatnonzero(rows >= 0)
        frames = frames[np.isfinite(self.results.world_from_rig[rows[frames]]).all(axis=(1, 2))]
        return replace(self.results.choose(rows[frames]), frames=frames)

    @cached_property
    def index(self) -> KeyIndex:
        return KeyIndex(self.keys["timestamp"].to_numpy(), as_strings(self.keys["device_id"]))


class _Relocalizer:
    """Localizes queries again near predicted poses, in the map of the run that made the first poses."""

    def __init__(self, poses_dir: Path, scene: str, map_device: str, session: Session) -> None:
        self._run, self._scene, self._device, self._session = poses_dir.parent.parent, scene, map_device, session
        self._expected = poses_dir
        self.met_a_bug = False
        """Whether a query failed with an internal error, so that the next run must try it again."""

    @cached_property
    def _map(self) -> Map:
        if SceneFiles(self._run, self._scene).poses_dir != self._expected:
            expected = f"RUN/{self._scene}/poses, in a run folder whose map can be opened to localize queries again"
            do = "Write the poses there, or set relocalize: false."
            raise ArtifactError.at(self._expected, expected=expected, do=do)
        return Map.open(self._run, self._scene, self._device)

    def __call__(self, keys: pd.DataFrame, todo: Sequence[tuple[int, RoughPose]]) -> list[QueryResult]:
        """Localize frames again, each near a pose.

        Args:
            keys: table [timestamp, device_id] of all frames of the piece.
            todo: frames and their predicted poses.
        """
        self._map.load()
        rows_of_each = self._session.rows_of_keyframes(keys.iloc[[frame for frame, _ in todo]])

        def localize(number: int) -> QueryResult:
            rows = rows_of_each[number]
            try:
                return self._map.locate(self._map.query_of_session(self._session, rows), near=todo[number][1])
            except Exception as error:  # one bad query never ends a run
                path = self._session.image_path(int(rows[0]))
                return QueryResult.failed(reason_of(error, f"localizing {path} again"))

        results = list(prefetch(localize, range(len(todo)), default_workers()))
        self.met_a_bug |= any(result.is_internal for result in results)
        return results


def _frames(
    session: Session, singles: _SingleQueries, settings: SequenceSettings, relocalizer: _Relocalizer | None
) -> tuple[pd.DataFrame, pd.DataFrame, Trajectory]:
    """Return the table of all frames and queries, the table of steps, and the trajectory of the frames with a pose."""
    tables, poses, covariances = list[pd.DataFrame](), list[Floats](), list[Floats]()
    steps, online = [pd.DataFrame(columns=list(STEP_COLUMNS))], list[pd.DataFrame]()
    with_odometry = np.zeros(len(singles.keys), bool)
    pieces = list(_pieces(session, singles, settings))
    _warn_of_ground_truth(session, pieces)
    if not settings.online:
        # Before drift is measured and pieces are cut, because both use later frames.
        for piece in pieces:
            online += _step_rows(piece, _online_steps(piece, settings))
        settings = with_measured_drift([(piece.motion, piece.posed) for piece in pieces], settings)
        pieces = [piece.part(rows) for piece in pieces for rows in cut(piece.motion, piece.posed, settings)]
    numbers = Counter[str]()
    for piece in pieces:
        motion, queries, frames = piece.motion, piece.posed, piece.posed.frames
        with_odometry[piece.query[piece.query_frames]] = True
        keys = pd.DataFrame({"timestamp": motion.timestamps, "device_id": piece.device_ids})
        relocalize = None if relocalizer is None else partial(relocalizer, keys)
        done = localize_piece(motion, queries, piece.query_frames, settings, relocalize)
        placed = done.placed
        steps += _step_rows(piece, done.steps)
        table = keys.reindex(columns=list(COLUMNS)).astype(object)
        verdicts = zip(placed.status, placed.reason, strict=True)
        table["status"] = [status.text(reason) if status else "" for status, reason in verdicts]
        table["recording"], table["piece"] = piece.recording, numbers[piece.recording]
        numbers[piece.recording] += 1
        table["single_status"] = np.append(singles.status, "")[piece.query]
        table.loc[list(done.relocalized), "again_status"] = [each.status_text for each in done.relocalized.values()]
        turned, moved = pose_error(placed.world_from_rig[frames], queries.world_from_rig)
        for name, values in (("moved_m", moved.round(6)), ("turned_deg", turned.round(6))):
            table.loc[frames, name] = values
        table.loc[done.queries.frames, "used"] = False
        table.loc[done.queries.frames[placed.used], "used"] = True
        tables.append(table)
        poses.append(placed.world_from_rig)
        covariances.append(placed.covariances)
    alone = np.flatnonzero(~with_odometry)
    table = singles.keys.iloc[alone].assign(status=singles.status[alone], single_status=singles.status[alone])
    tables.append(table.reindex(columns=list(COLUMNS)))
    all_poses = np.concatenate([*poses, singles.results.world_from_rig[alone]])
    all_covariances = np.concatenate([*covariances, singles.results.covariances[alone]])
    frames_table = pd.concat([part.astype(object) for part in tables], ignore_index=True)
    kept = (frames_table["status"] != "").to_numpy()  # online, only queries have a status
    frames_table, all_poses, all_covariances = frames_table[kept], all_poses[kept], all_covariances[kept]
    posed = np.isfinite(all_poses).all(axis=(1, 2))
    for name, stds in zip(("rotation_std_deg", "position_std_m"), stds_of(all_covariances), strict=True):
        frames_table[name] = np.where(posed, stds, np.nan).round(6)
    with_pose = frames_table[posed]
    times, device_ids = with_pose["timestamp"].to_numpy(np.int64), with_pose["device_id"].to_list()
    trajectory = Trajectory.from_poses(times, device_ids, all_poses[posed], all_covariances[posed])
    return frames_table, pd.concat([part.astype(object) for part in steps + online], ignore_index=True), trajectory


def _step_rows(piece: _Piece, steps: Mapping[str, Floats]) -> Iterator[pd.DataFrame]:
    """Yield a table with `STEP_COLUMNS` for each step, from the poses (A, 4, 4) of the piece's queries after it."""
    for name, poses in steps.items():
        posed = np.isfinite(poses).all(axis=(1, 2))
        rows = piece.query_frames[posed]
        table = pd.DataFrame({"step": name, "timestamp": piece.motion.timestamps[rows]})
        table["device_id"] = piece.device_ids[rows]
        table[list(POSE_NAMES)] = geometry.qt_from_pose(poses[posed]).round(9)
        yield table


def _online_steps(piece: _Piece, settings: SequenceSettings) -> dict[str, Floats]:
    """Return the queries' poses (A, 4, 4) from single queries of the past, by the name of the time window.

    Poses found again near a predicted pose are not used, because later queries helped to predict them.
    """
    steps, frames = {}, piece.query_frames
    for length_s in (*WINDOWS_S, None):
        past = settings.model_copy(update={"online": True, "length_s": length_s})
        name = "online" if length_s is None else f"online {length_s:g} s"
        steps[name] = place_online(piece.motion, piece.posed, frames, past).world_from_rig[frames]
    return steps


def _warn_of_ground_truth(session: Session, pieces: Sequence[_Piece]) -> None:
    """Warn if the odometry is already in the frame of the map, where `ok` queries are: then it may be ground truth."""
    within = list[bool]()
    for piece in pieces:
        sure = piece.posed.choose(piece.posed.trusted)
        turned_deg, moved_m = pose_error(piece.motion.odom_from_rig[sure.frames], sure.world_from_rig)
        within += ((turned_deg < 5.0) & (moved_m < 0.5)).tolist()
    if len(within) >= 3 and np.mean(within) > 0.5:
        log.warning(
            "%s: %d of %d `ok` queries are within 5 degrees and 0.5 m of its trajectories.txt, so this file is in the "
            "frame of the map. Expected: the device's own odometry. If the file is ground truth, remove it, because "
            "the results of this stage would mean nothing.", session.id, sum(within), len(within),
        )  # fmt: skip


def _pieces(session: Session, singles: _SingleQueries, settings: SequenceSettings) -> Iterator[_Piece]:
    """Yield the pieces of each recording's odometry in order of time, with frames interpolated for queries between."""
    odometry, queries = session.odometry, singles.keys
    assert odometry is not None
    poses = odometry.world_from_device
    has_frame = odometry.index.find(queries["timestamp"].to_numpy(), as_strings(queries["device_id"])) >= 0
    times, ids = (queries.loc[~has_frame, name].to_numpy() for name in ("timestamp", "device_id"))
    within, names = session.subsession_by_prefix(ids), device_names(times, ids)
    for recording, rows in recordings_of(session, odometry).items():
        own = np.flatnonzero((within == recording) | (names == recording))
        whole = Odometry(odometry.timestamps[rows], poses[rows])
        for part in whole.split():
            piece, devices = whole.part(part), odometry.device_ids[rows[part]]
            between, interpolated = piece.at(times[own])
            piece, order = piece.joined(times[own[between]], interpolated)
            devices = np.append(devices, ids[own[between]])[order]
            query = singles.index.find(piece.timestamps, as_strings(devices))
            yield _Piece(recording, devices, piece, query, singles.posed(query))
