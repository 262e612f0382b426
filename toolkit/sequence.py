"""The sequence stage: combine single query poses with odometry to estimate the pose of every frame of a recording."""

import glob
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

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
    pair_devices,
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
    device_names,
    recordings_of,
    vote_weights,
)
from toolkit.sequences.pose_graph import localize_pieces, pieces_of
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
        frames, steps, trajectory, met_a_bug = _localize(session, PairResults.open(poses), settings)
        unit = read_map_record(map_record_path(poses_dir, capture.name, map_device))["unit"]
        csvs = {out.with_suffix(".csv"): in_unit_of_poses(frames, unit), out.with_name(f"{out.stem}_steps.csv"): steps}
        for path, rows in csvs.items():
            write_csv(path, rows)
        trajectory.write(out)
        write_sidecar(out, record, list(csvs), made_from=inputs, unfinished=met_a_bug)
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


def _localize(
    session: Session, single: PairResults, settings: SequenceSettings
) -> tuple[pd.DataFrame, pd.DataFrame, Trajectory, bool]:
    """Localize the frames of a session's recordings, and keep the poses of queries without odometry.

    Return the table of all frames, the table of steps, the trajectory of the frames with a pose, and whether a query
    failed with an internal error, so that the next run must try it again.
    """
    rows = single.table.drop_duplicates(["timestamp", "device_id"], ignore_index=True)
    all_queries, status = _queries(replace(single, table=rows)), rows["status_text"].to_numpy(object)
    keys, motion, parts = _recordings(session, rows)
    index = KeyIndex(rows["timestamp"].to_numpy(), as_strings(rows["device_id"]))
    query = index.find(motion.timestamps, as_strings(keys["device_id"]))  # of each frame, -1 for none
    asked = np.flatnonzero(query >= 0)
    posed = asked[np.isfinite(all_queries.world_from_rig[query[asked]]).all(axis=(1, 2))]
    queries = replace(all_queries.choose(query[posed]), frames=posed)
    _warn_of_ground_truth(session, motion, queries)

    relocalize = _Relocalizer(single.path, session, keys)
    pieces, as_measured = pieces_of(motion, parts, queries, settings)
    done = localize_pieces(motion, queries, asked, as_measured, relocalize, pieces)
    placed, steps = done.placed, [_step_rows(keys.iloc[asked], done.piece[asked], done.steps)]
    if not settings.online:
        of_windows = dict[str, Floats]()
        for length_s in (*WINDOWS_S, None):
            past = settings.model_copy(update={"online": True, "length_s": length_s})
            name = "online" if length_s is None else f"online {length_s:g} s"
            # Not localized again, because later queries helped to predict the poses.
            online = localize_pieces(motion, queries, asked, past, None, parts)
            of_windows[name] = online.placed.world_from_rig[asked]
        steps.append(_step_rows(keys.iloc[asked], online.piece[asked], of_windows))

    frames = keys.reindex(columns=list(COLUMNS)).astype(object)
    first_piece = pd.Series(done.piece).groupby(keys["recording"]).transform("min")
    frames["piece"] = (done.piece - first_piece).astype(object)
    verdicts = zip(placed.status, placed.reason, strict=True)
    frames["status"] = [verdict.text(reason) if verdict else "" for verdict, reason in verdicts]
    frames["single_status"] = np.append(status, "")[query]
    frames.loc[list(done.relocalized), "again_status"] = [each.status_text for each in done.relocalized.values()]
    turned, moved = pose_error(placed.world_from_rig[posed], queries.world_from_rig)
    frames.loc[posed, "moved_m"], frames.loc[posed, "turned_deg"] = moved.round(6), turned.round(6)
    frames.loc[done.queries.frames, "used"] = False
    frames.loc[done.queries.frames[placed.used], "used"] = True
    alone = np.setdiff1d(np.arange(len(rows)), query)
    without = rows.loc[alone, ["timestamp", "device_id"]].assign(status=status[alone], single_status=status[alone])
    frames = pd.concat([frames, without.astype(object)], ignore_index=True)
    poses = np.concatenate([placed.world_from_rig, all_queries.world_from_rig[alone]])
    covariances = np.concatenate([placed.covariances, all_queries.covariances[alone]])
    kept = (frames["status"] != "").to_numpy()  # online, only queries have a status
    frames, poses, covariances = frames[kept], poses[kept], covariances[kept]
    has_pose = np.isfinite(poses).all(axis=(1, 2))
    for name, stds in zip(("rotation_std_deg", "position_std_m"), stds_of(covariances), strict=True):
        frames[name] = np.where(has_pose, stds, np.nan).round(6)
    times, device_ids = (frames.loc[has_pose, name].to_list() for name in ("timestamp", "device_id"))
    trajectory = Trajectory.from_poses(times, device_ids, poses[has_pose], covariances[has_pose])
    return frames, pd.concat(steps), trajectory, any(result.is_internal for result in done.relocalized.values())


def _queries(single: PairResults) -> PosedQueries:
    """Return all queries, NaN for one without a pose; `frames` counts them."""
    ok = (single.table["status"] == Status.OK).to_numpy(bool)
    evidence = single.table.reindex(columns=["p_correct", "rival_support"]).to_numpy(float)
    known = np.asarray(np.isfinite(single.covariances).all(axis=(1, 2)), bool)
    covariances = np.asarray(np.where(known[:, None, None], single.covariances, UNKNOWN_COVARIANCE))
    return PosedQueries(np.arange(len(ok)), single.poses, covariances, vote_weights(ok, *evidence.T), ok)


def _recordings(session: Session, queries: pd.DataFrame) -> tuple[pd.DataFrame, Odometry, list[slice]]:
    """Return the frames of a session's odometry, recording after recording; interpolated for queries between them.

    Return their table [timestamp, device_id, recording], their poses, and the slices between losses of tracking.
    """
    odometry = session.odometry
    assert odometry is not None
    poses = odometry.world_from_device
    has_frame = odometry.index.find(queries["timestamp"].to_numpy(), as_strings(queries["device_id"])) >= 0
    times, ids = (queries.loc[~has_frame, name].to_numpy() for name in ("timestamp", "device_id"))
    within, names = session.subsession_by_prefix(ids), device_names(times, ids)
    keys = [pd.DataFrame({"timestamp": np.zeros(0, np.int64), "device_id": "", "recording": ""})]
    joined, ends = [np.zeros((0, 4, 4))], [0]
    for recording, rows in recordings_of(session, odometry).items():
        own = np.flatnonzero((within == recording) | (names == recording))
        whole = Odometry(odometry.timestamps[rows], poses[rows])
        for part in whole.split():
            between, interpolated = whole.part(part).at(times[own])
            motion, order = whole.part(part).joined(times[own[between]], interpolated)
            devices = np.append(odometry.device_ids[rows[part]], ids[own[between]])[order]
            keys.append(pd.DataFrame({"timestamp": motion.timestamps, "device_id": devices, "recording": recording}))
            joined.append(motion.odom_from_rig)
            ends.append(ends[-1] + len(motion))
    frames = pd.concat(keys, ignore_index=True)
    parts = [slice(start, end) for start, end in pairwise(ends)]
    return frames, Odometry(frames["timestamp"].to_numpy(), np.concatenate(joined)), parts


def _step_rows(keys: pd.DataFrame, piece: Ints, steps: Mapping[str, Floats]) -> pd.DataFrame:
    """Return a table with `STEP_COLUMNS`, piece by piece, of the poses (A, 4, 4) of A queries after each step."""
    tables = list[pd.DataFrame]()
    for name, poses in steps.items():
        posed = np.isfinite(poses).all(axis=(1, 2))
        table = keys[posed].assign(step=name, piece=piece[posed])
        table[list(POSE_NAMES)] = geometry.qt_from_pose(poses[posed]).round(9)
        tables.append(table)
    return pd.concat(tables).sort_values("piece", kind="stable")[list(STEP_COLUMNS)]


def _warn_of_ground_truth(session: Session, motion: Odometry, queries: PosedQueries) -> None:
    """Warn if the odometry is already in the frame of the map, where `ok` queries are: then it may be ground truth."""
    sure = queries.choose(queries.trusted)
    turned_deg, moved_m = pose_error(motion.odom_from_rig[sure.frames], sure.world_from_rig)
    within = (turned_deg < 5.0) & (moved_m < 0.5)
    if len(within) >= 3 and np.mean(within) > 0.5:
        log.warning(
            "%s: %d of %d `ok` queries are within 5 degrees and 0.5 m of its trajectories.txt, so this file is in the "
            "frame of the map. Expected: the device's own odometry. If the file is ground truth, remove it, because "
            "the results of this stage would mean nothing.", session.id, sum(within), len(within),
        )  # fmt: skip


@dataclass
class _Relocalizer:
    """Localizes frames again near predicted poses, in the map of the run that made the first poses."""

    poses: Path
    session: Session
    keys: pd.DataFrame
    """Table [timestamp, device_id] of all frames."""

    @cached_property
    def _map(self) -> Map:
        folder, scene = self.poses.parent, self.poses.stem.rpartition("_map_")[0]
        files = SceneFiles(folder.parent.parent, scene)
        if files.poses_dir != folder:
            expected = f"RUN/{scene}/poses, in a run folder whose map can be opened to localize queries again"
            raise ArtifactError.at(folder, expected=expected, do="Write the poses there, or set relocalize: false.")
        return Map.open(files.run, scene, pair_devices(self.poses.stem)[0])

    def __call__(self, todo: Sequence[tuple[int, RoughPose]]) -> list[QueryResult]:
        self._map.load()
        rows_of_each = self.session.rows_of_keyframes(self.keys.iloc[[frame for frame, _ in todo]])

        def localize(number: int) -> QueryResult:
            rows = rows_of_each[number]
            try:
                return self._map.locate(self._map.query_of_session(self.session, rows), near=todo[number][1])
            except Exception as error:  # one bad query never ends a run
                path = self.session.image_path(int(rows[0]))
                return QueryResult.failed(reason_of(error, f"localizing {path} again"))

        return list(prefetch(localize, range(len(todo)), default_workers()))
