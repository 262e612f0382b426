"""The sequence stage: the poses of single queries and the odometry between them in, a pose of every frame out."""

import glob
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.images import default_workers, prefetch
from toolkit.capture.tables import POSE_NAMES, KeyIndex, as_strings, read_query_table
from toolkit.capture.world_up import up_of_cameras
from toolkit.errors import OF_THE_DATA, ArtifactError, reason_of
from toolkit.files import (
    SceneFiles,
    file_fingerprint,
    is_current,
    pair_name,
    read_sidecar,
    require_whole,
    write_atomic,
    write_sidecar,
)
from toolkit.geometry import Floats, Ints, pose_error
from toolkit.localizers.base import PoseEstimate, RoughPose, stds_of
from toolkit.localizers.bundle import Observations
from toolkit.localizers.correspondences import LocalizedQueries
from toolkit.localizers.frames import LocalizedFrames, SequenceLocalizer, localize_sequence
from toolkit.localizers.gravity import measured_gravity
from toolkit.localizers.map import Map
from toolkit.localizers.odometry import (
    UNKNOWN_COVARIANCE,
    Odometry,
    PosedQueries,
    cut,
    device_names,
    recordings_of,
    subsessions_of,
    vote_weights,
    with_measured_drift,
)
from toolkit.localizers.picture import localize_image
from toolkit.localizers.pose_graph import place_online
from toolkit.localizers.recording import localize_piece
from toolkit.manifest import SequenceSettings

log = logging.getLogger(__name__)

__all__ = ["LocalizedFrames", "Odometry", "SequenceLocalizer", "localize_sequence", "sequence_pairs"]

SUFFIX = "_sequence"
"""Ends the name of what the stage makes of a pair, beside what localization has made of it."""
COLUMNS = (
    "timestamp", "device_id", "recording", "piece", "status", "position_std_m", "rotation_std_deg", "single_status",
    "again_status", "used", "moved_m", "turned_deg",
)  # fmt: skip
"""Of the table: `again_status` is that of a query that was localized again near its predicted pose, empty for others.
A query's own pose, the first or that found again, was `used` if it agrees with the others of its piece; `moved_m` and
`turned_deg` tell how far its pose is from the first."""
STEP_COLUMNS = ("step", "timestamp", "device_id", *POSE_NAMES)
"""Of `<pair>_sequence_steps.csv`: the poses of queries after each of `STEPS`."""


def sequence_pairs(
    sessions_root: str | Path,
    poses_dir: str | Path,
    settings: SequenceSettings | Mapping[str, Any] | None = None,
    *,
    map_device: str = "all",
    query_device: str = "all",
    skip_existing: bool = True,
) -> pd.DataFrame:
    """Write for each pair of devices the poses of all frames of the queries' recordings, and a table of them.

    `<poses_dir>/<pair>_sequence.txt` has every frame of the odometry, and every query without odometry that was
    localized; `<pair>_sequence.csv` has a row for each of them, with `COLUMNS`, also for those without a pose;
    `<pair>_sequence_steps.csv` has the queries' poses in between.

    Args:
        sessions_root: `<capture>/sessions`; the odometry is trajectories.txt of a query session. A query between two of
            its poses gets one by interpolation.
        poses_dir: RUN/SCENE/poses, the folder of the localize stage's poses; the results go there, too.
        settings: see `SequenceSettings`; a dict holds what differs from the defaults.
        map_device, query_device: `ios`, `hl`, `spot`, or `all` that the capture has.
        skip_existing: reuse what was made from the same inputs and settings.

    Returns:
        One row a pair: map_device, query_device, frames = ok + low_confidence + failed, pieces, queries that were
        localized at first, again (those that were localized again), used (those that agree), seconds, skipped, path,
        reason. A pair that cannot be done, for want of odometry or of poses, has zeros and the `reason`.

    Raises:
        ManifestError: a setting is not valid, or GTSAM is not installed.
        CaptureError: unknown device.
    """
    settings = SequenceSettings.of(settings)
    capture = Capture.from_sessions_root(sessions_root)
    rows = []
    for devices in product(capture.devices_with("map", map_device), capture.devices_with("query", query_device)):
        row = {"map_device": devices[0], "query_device": devices[1], **dict.fromkeys(_COUNTS, 0)}
        row |= {"seconds": 0.0, "skipped": False, "path": "", "reason": ""}
        try:
            row |= _place_pair(capture, *devices, Path(poses_dir), settings, skip_existing)
        except OF_THE_DATA as error:
            row["reason"] = str(error)
            # Those of an earlier run would be taken for results of this one.
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
    shown = [poses.with_suffix(".h5")] * settings.bundle_adjust
    for path, what in zip([poses, table, *shown], ("poses", "table of the queries", "correspondences"), strict=False):
        if not path.exists():
            raise ArtifactError(f"{path}: no {what} of this pair. Localize first.")
    require_whole(poses)
    record: dict[str, Any] = {
        "sequence": settings.model_dump(),
        "poses": [file_fingerprint(path) for path in (poses, table, *shown)],
        "odometry": file_fingerprint(session.path / "trajectories.txt"),
    }
    if settings.relocalize:
        record["localize"] = read_sidecar(poses)
    skipped = skip_existing and is_current(out, record)
    if not skipped:
        again = _Relocalizer(poses_dir, capture.name, map_device, session) if settings.relocalize else None
        answers, map_session = _Answers.read(poses, table), capture[f"{map_device}_map"]
        with closing(LocalizedQueries(shown[0])) if shown else nullcontext() as queries:
            frames, steps, trajectory = _frames(
                session, answers, settings, again, lambda: up_of_cameras(map_session.world_from_cam()), queries
            )
        csvs = {out.with_suffix(".csv"): frames, out.with_name(f"{out.stem}_steps.csv"): steps}
        for path, rows in csvs.items():
            with write_atomic(path) as temporary:
                rows.to_csv(temporary, index=False)
        trajectory.write(out)
        write_sidecar(out, record, list(csvs))
    frames = pd.read_csv(out.with_suffix(".csv"), keep_default_na=False)
    status = frames["status"].str.split(":").str[0].value_counts()
    return {
        "frames": len(frames),
        **{name: int(status.get(name, 0)) for name in ("ok", "low_confidence", "failed")},
        "pieces": len(frames[["recording", "piece"]].drop_duplicates()),
        "queries": int((frames["moved_m"] != "").sum()),
        "again": int((frames["again_status"] != "").sum()),
        "used": int((frames["used"].astype(str) == "True").sum()),
        "seconds": round(time.perf_counter() - started, 2),
        "skipped": skipped,
        "path": str(out),
    }


@dataclass(frozen=True)
class _Piece:
    """A piece of a recording's odometry."""

    recording: str
    device_ids: NDArray[np.object_]
    """(N,)."""
    motion: Odometry
    query: Ints
    """(N,) which query each frame is, -1 where it is none."""
    posed: PosedQueries
    """Those that have a pose."""

    @property
    def asked(self) -> Ints:
        """(A,) frames of all queries."""
        return np.flatnonzero(self.query >= 0)

    def part(self, rows: slice) -> "_Piece":
        own, posed = self.device_ids[rows], self.posed.part(rows)
        return _Piece(self.recording, own, self.motion.part(rows), self.query[rows], posed)


@dataclass(frozen=True)
class _Answers:
    """What localization says of Q queries."""

    keys: pd.DataFrame
    """Table [timestamp, device_id]."""
    status: NDArray[np.object_]
    weights: Floats
    """(Q,) probability that each pose is right."""
    poses: Floats
    """(Q, 4, 4), NaN where there is none."""
    covariances: Floats
    """(Q, 6, 6)."""

    @classmethod
    def read(cls, poses: Path, table: Path) -> "_Answers":
        rows, trajectory = read_query_table(table, ["status"]), Trajectory.read(poses)
        rows = rows.drop_duplicates(["timestamp", "device_id"], ignore_index=True)
        status = rows["status"].to_numpy(object)
        known = rows.reindex(columns=["p_correct", "rival_support"]).to_numpy(float)
        weights = vote_weights(np.asarray(status == "ok"), *known.T)
        at = trajectory.index.find(rows["timestamp"].to_numpy(), as_strings(rows["device_id"]))
        covariances = np.tile(UNKNOWN_COVARIANCE, (len(rows), 1, 1))
        if (given := trajectory.covariances) is not None:
            known = (at >= 0) & np.isfinite(given[at]).all(axis=(1, 2))
            covariances[known] = given[at[known]]
        found = trajectory.lookup(rows["timestamp"], rows["device_id"])
        return cls(rows[["timestamp", "device_id"]], status, weights, found, covariances)

    def posed(self, rows: Ints) -> PosedQueries:
        """Return those that have a pose, of the frames of a piece of odometry; rows (N,) are as `of` returns them."""
        frames = np.flatnonzero(rows >= 0)
        frames = frames[np.isfinite(self.poses[rows[frames]]).all(axis=(1, 2))]
        rows = rows[frames]
        trusted = np.asarray(self.status[rows] == "ok")
        return PosedQueries(frames, self.poses[rows], self.covariances[rows], self.weights[rows], trusted)

    def of(self, timestamps: Ints, device_ids: Any) -> Ints:
        """Return which query each frame (N,) is, -1 where it is none."""
        return self._index.find(timestamps, as_strings(device_ids))

    @cached_property
    def _index(self) -> KeyIndex:
        return KeyIndex(self.keys["timestamp"].to_numpy(), as_strings(self.keys["device_id"]))


class _Relocalizer:
    """Localizes queries again near predicted poses, in the map of the run that the first poses are of."""

    def __init__(self, poses_dir: Path, scene: str, map_device: str, session: Session) -> None:
        self._run, self._scene, self._device, self._session = poses_dir.parent.parent, scene, map_device, session
        self._expected = poses_dir

    @cached_property
    def _place(self) -> Map:
        if SceneFiles(self._run, self._scene).poses_dir != self._expected:
            raise ArtifactError(
                f"{self._expected}: found no folder of a run, RUN/{self._scene}/poses, whose map could be opened to "
                "localize again. Write the poses there, or set relocalize: false."
            )
        return Map.open(self._run, self._scene, self._device)

    def __call__(self, keys: pd.DataFrame, todo: Sequence[tuple[int, RoughPose]]) -> list[PoseEstimate]:
        """Return an estimate of some frames, of which `keys` has `timestamp` and `device_id`, each near a pose."""
        session, place = self._session, self._place
        _ = place.localizer, place.embedders  # opened before threads ask for them
        rows_of_each = session.rows_of_keyframes(keys.iloc[[frame for frame, _ in todo]])

        def localize(number: int) -> PoseEstimate:
            rows = rows_of_each[number]
            turns = None if place.turns is None else place.turns.of(session, rows).tolist()
            cameras = [session.camera(sensor) for sensor in session.images["sensor_id"].iloc[rows]]
            paths = [session.image_path(int(row)) for row in rows]
            try:
                poses = session.rig_from_cam(rows)
                return localize_image(place, paths, cameras, poses, turns, todo[number][1])
            except Exception as error:  # one bad query never ends a run
                return PoseEstimate(f"failed: {reason_of(error, f'localizing {paths[0]} again')}")

        with threadpool_limits(1, "blas"):
            return list(prefetch(localize, range(len(todo)), default_workers()))


def _frames(
    session: Session,
    answers: _Answers,
    settings: SequenceSettings,
    relocalizer: _Relocalizer | None,
    map_up: Callable[[], Floats],
    shown: LocalizedQueries | None,
) -> tuple[pd.DataFrame, pd.DataFrame, Trajectory]:
    """Return the table of all frames and queries, that of steps, and the poses of those frames that have one."""
    tables, poses, covariances = list[pd.DataFrame](), list[Floats](), list[Floats]()
    steps, online = [pd.DataFrame(columns=list(STEP_COLUMNS))], list[pd.DataFrame]()
    with_odometry = np.zeros(len(answers.keys), bool)
    pieces = list(_pieces(session, answers, settings))
    _warn_of_truth(session, pieces)
    if not settings.online:
        # Before the drift is measured and pieces are cut, of which the future tells.
        for piece in pieces:
            online += _step_rows(piece, _online_steps(piece, settings))
        settings = with_measured_drift([(piece.motion, piece.posed) for piece in pieces], settings)
        pieces = [piece.part(rows) for piece in pieces for rows in cut(piece.motion, piece.posed, settings)]
    gravity = measured_gravity([(piece.motion, piece.posed) for piece in pieces], map_up, settings)
    numbers = Counter[str]()
    for piece in pieces:
        motion, queries, frames = piece.motion, piece.posed, piece.posed.frames
        with_odometry[piece.query[piece.asked]] = True
        keys = pd.DataFrame({"timestamp": motion.timestamps, "device_id": piece.device_ids})
        again = None if relocalizer is None else partial(relocalizer, keys)
        observe = None if shown is None else partial(_observations, session, shown, keys)
        done = localize_piece(motion, queries, piece.asked, settings, again, gravity, observe)
        placed = done.placed
        steps += _step_rows(piece, done.steps)
        table = pd.DataFrame(dict.fromkeys(COLUMNS), index=range(len(motion)))
        table[list(keys)] = keys
        table["recording"], table["piece"], table["status"] = piece.recording, numbers[piece.recording], placed.status
        numbers[piece.recording] += 1
        table["single_status"] = np.append(answers.status, "")[piece.query]
        table.loc[list(done.again), "again_status"] = [estimate.status for estimate in done.again.values()]
        turned, moved = pose_error(placed.world_from_rig[frames], queries.world_from_rig)
        for name, values in (("moved_m", moved.round(6)), ("turned_deg", turned.round(6))):
            table.loc[frames, name] = values
        table.loc[done.queries.frames, "used"] = False
        table.loc[done.queries.frames[placed.used], "used"] = True
        tables.append(table)
        poses.append(placed.world_from_rig)
        covariances.append(placed.covariances)
    alone = np.flatnonzero(~with_odometry)
    table = answers.keys.iloc[alone].assign(status=answers.status[alone], single_status=answers.status[alone])
    tables.append(table.reindex(columns=list(COLUMNS)))
    every = np.concatenate([*poses, answers.poses[alone]])
    known = np.concatenate([*covariances, answers.covariances[alone]])
    frames_table = pd.concat([part.astype(object) for part in tables], ignore_index=True)
    asked_for = (frames_table["status"] != "").to_numpy()
    frames_table, every, known = frames_table[asked_for], every[asked_for], known[asked_for]
    posed = np.isfinite(every).all(axis=(1, 2))
    for name, stds in zip(("rotation_std_deg", "position_std_m"), stds_of(known), strict=True):
        frames_table[name] = np.where(posed, stds, np.nan).round(6)
    kept = frames_table[posed]
    times = kept["timestamp"].to_numpy(np.int64)
    trajectory = Trajectory.from_poses(times, kept["device_id"].to_list(), every[posed], known[posed])
    return frames_table, pd.concat([part.astype(object) for part in steps + online], ignore_index=True), trajectory


def _observations(
    session: Session, shown: LocalizedQueries, keys: pd.DataFrame, frame: int, again: PoseEstimate | None
) -> Observations | None:
    """Return what a frame shows: what its query's first pose rests on, or that which was found again."""
    query = keys.iloc[[frame]]
    key = int(query["timestamp"].iloc[0]), str(query["device_id"].iloc[0])
    if again is not None:
        [rows], found = session.rows_of_keyframes(query), again.correspondences
    elif key in shown:
        stored = shown[key]
        found = stored.correspondences
        if missing := [name for name in stored.images if name not in session.row_of_name]:
            raise ArtifactError(f"{shown.path}: {session.path} has no image {missing[0]}. Localize again.")
        rows = np.array([session.row_of_name[name] for name in stored.images], np.int64)
    else:
        return None
    cameras = [session.camera(sensor) for sensor in session.images["sensor_id"].iloc[rows]]
    return Observations.of(found, cameras, session.rig_from_cam(rows))


def _step_rows(piece: _Piece, steps: Mapping[str, Floats]) -> Iterator[pd.DataFrame]:
    """Yield tables with `STEP_COLUMNS` of the poses (A, 4, 4) of the frames that are asked for after each step."""
    for name, poses in steps.items():
        posed = np.isfinite(poses).all(axis=(1, 2))
        rows = piece.asked[posed]
        table = pd.DataFrame({"step": name, "timestamp": piece.motion.timestamps[rows]})
        table["device_id"] = piece.device_ids[rows]
        table[list(POSE_NAMES)] = geometry.qt_from_pose(poses[posed]).round(9)
        yield table


def _online_steps(piece: _Piece, settings: SequenceSettings) -> dict[str, Floats]:
    """Return poses (A, 4, 4) of the frames that are asked for, from single queries of the past, by the window's name.

    What was localized again near a predicted pose does not count: other queries, of the future too, predicted it.
    """
    if not settings.windows_s:
        return {}
    steps = {}
    for length_s in (*settings.windows_s, None):
        past = settings.model_copy(update={"online": True, "length_s": length_s})
        name = "online" if length_s is None else f"online {length_s:g} s"
        steps[name] = place_online(piece.motion, piece.posed, piece.asked, past).world_from_rig[piece.asked]
    return steps


def _warn_of_truth(session: Session, pieces: Sequence[_Piece]) -> None:
    """Warn if odometry has the places in the map that the queries have: then it is none."""
    within = list[bool]()
    for piece in pieces:
        sure = piece.posed.choose(piece.posed.trusted)
        turned_deg, moved_m = pose_error(piece.motion.odom_from_rig[sure.frames], sure.world_from_rig)
        within += ((turned_deg < 5.0) & (moved_m < 0.5)).tolist()
    if len(within) >= 3 and np.mean(within) > 0.5:
        log.warning(
            "%s: %d of %d `ok` queries are within 5 degrees and 0.5 m of its trajectories.txt, which is in the frame "
            "of the map. Expected is the device's own odometry. If it is ground truth, what this stage makes of it is "
            "no result: remove the file.", session.id, sum(within), len(within),
        )  # fmt: skip


def _pieces(session: Session, answers: _Answers, settings: SequenceSettings) -> Iterator[_Piece]:
    """Yield the pieces of each recording's odometry, in the order of time, with poses of queries between two of it."""
    odometry, queries = session.odometry, answers.keys
    assert odometry is not None
    poses = odometry.world_from_device
    known = odometry.index.find(queries["timestamp"].to_numpy(), as_strings(queries["device_id"])) >= 0
    times, ids = (queries.loc[~known, name].to_numpy() for name in ("timestamp", "device_id"))
    within, names = subsessions_of(session, ids), device_names(times, ids)
    for recording, rows in recordings_of(session, odometry).items():
        asked = np.flatnonzero((within == recording) | (names == recording))
        whole = Odometry(odometry.timestamps[rows], poses[rows])
        for part in whole.split(settings):
            piece, devices = whole.part(part), odometry.device_ids[rows[part]]
            between, found = piece.at(times[asked])
            piece, order = piece.joined(times[asked[between]], found)
            devices = np.append(devices, ids[asked[between]])[order]
            query = answers.of(piece.timestamps, devices)
            yield _Piece(recording, devices, piece, query, answers.posed(query))
