"""Rerun recordings of sessions to walk around in: images on a timeline, cameras where they stood, points, depth."""

import logging
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from tqdm.auto import tqdm

from toolkit.capture import DEPTH_SCALE, Capture, Session, Trajectory
from toolkit.capture.devices import color_of
from toolkit.capture.images import decode, default_workers, prefetch, read_for_display, read_image
from toolkit.capture.world_up import up_of_cameras
from toolkit.errors import ArtifactError, CaptureError, ImageError
from toolkit.files import file_fingerprint, files_fingerprint, write_sidecar
from toolkit.geometry import Floats, Ints
from toolkit.localizers.correspondences import LocalizedQueries, LocalizedQuery
from toolkit.show import viewer
from toolkit.show.figures import ORANGE
from toolkit.show.localized import load_maps, map_files, sure_points
from toolkit.show.metrics import is_posed

if TYPE_CHECKING:
    import pycolmap
    import rerun as rr

logger = logging.getLogger(__name__)


FRAME, CAPTURE_TIME = "frame", "capture_time"
"""Timelines: index of the frame in its session, and the timestamp of the files as a duration (microseconds)."""
MAX_TABS = 12
"""Subsessions whose cameras have a tab beside the scene."""


@dataclass(frozen=True)
class SessionRecording:
    """What a recording of a session holds."""

    path: Path
    frames: int = 0
    """Instants recorded: one a device and time."""
    images: int = 0
    unreadable: int = 0
    """Images and depth maps that could not be read; a gray picture stands in for an image."""
    unposed: int = 0
    """Images of frames without a pose: shown beside the scene, under `unposed/`."""
    depth_maps: int = 0
    points: int = 0
    queries: int = 0
    """Queries drawn in a map."""
    seconds: float = 0.0
    bytes: int = 0
    messages: list[str] = field(default_factory=list)

    @property
    def command(self) -> str:
        """The command that opens it."""
        return viewer.open_command(self.path)


def record_session(
    scene: str | Path,
    split: str,
    device: str,
    subsession: str = "all",
    keyframes_only: bool = False,
    every: int = 1,
    spawn: bool = False,
    vis_retrieve_queries: bool = False,
    queries_pose: str | Path | None = None,
    out: str | Path | None = None,
    map_dir: str | Path | None = None,
    queries: str = "keyframes_pruned_subsampled",
    image_size: int = viewer.IMAGE_SIZE,
    world_up: ArrayLike | None = None,
    progress: bool = True,
) -> SessionRecording:
    """Record a session for the rerun viewer; memory does not grow with its length.

    Entities, where `<device>` is the rig, and is left out for a camera without one:

        world/<subsession>/<device>                    world_from_rig, once a frame
        world/<subsession>/<device>/<camera>           rig_from_cam and intrinsics, again only where they change
        world/<subsession>/<device>/<camera>/image     JPEG
        world/<subsession>/<device>/<camera>_depth/depth    depth map
        world/<subsession>/trajectory, world/points, world/queries/..., unposed/<subsession>/<device>/<camera>

    Sensors and rigs whose ids are made anew each frame share an entity. Timelines: `frame`, the index among all
    frames of the session, so that a thinned recording has the numbers of the whole; `capture_time`, the
    timestamp of the files.

    Args:
        split: `map` or `query`.
        device: device key; with `split` it names the session.
        subsession: `all`, or one.
        keyframes_only: only frames in the session's keyframe list `queries`.
        every: every so many frames (after `keyframes_only`).
        vis_retrieve_queries: with `queries_pose`, join each query with the references that it was localized by; they
            are read from the `.h5` file beside it.
        queries_pose: trajectories file, world_from_device of queries. In a query session, cameras stand where it
            says (else: at the ground truth); in a map session, its poses are drawn in the map.
        out: file to write; None: `<scene>_<device>_<split>.rrd` in the working directory.
        map_dir: folder of triangulated maps: the points of the session's map are shown; of a query session, the
            points of the map that `queries_pose` is named after. With `queries_pose`, of the maps that it was found
            with; else of all of the session.
        image_size: longer side of the images shown, pixels; depth maps have half of it.
        world_up: direction (3,) that is up; None: estimated from the cameras.

    Raises:
        CaptureError: unknown session, subsession or keyframe list.
        ArtifactError: `vis_retrieve_queries` without the h5 of `queries_pose`, or for another session.
    """
    import rerun as rr

    started = time.perf_counter()
    if every < 1:
        raise CaptureError(f"every={every}: expected 1 (every frame) or more.")
    capture = Capture.open(scene)
    session = capture[f"{device}_{split}"]
    path = Path(out) if out is not None else Path(f"{capture.name}_{session.id}.rrd")
    if queries_pose is None and vis_retrieve_queries:
        raise ArtifactError("vis_retrieve_queries shows what `queries_pose` was localized by; give that file too.")
    poses = None if queries_pose is None else Path(queries_pose)
    localized = None if poses is None else _QueryPoses.read(poses, capture, session, vis_retrieve_queries)
    map_device = device if split == "map" else "" if localized is None else localized.map_device
    maps = map_files(map_dir, f"{map_device}_map", poses) if map_device else ()
    settings = {
        "images": session.files_fingerprint, "subsession": subsession,
        "session": files_fingerprint([*sorted(session.path.glob("*.txt")), *sorted(session.path.glob("proc/*.txt"))]),
        "keyframes": queries if keyframes_only else "", "every": every,
        "image_size": image_size, "quality": viewer.JPEG_QUALITY,
        "queries_pose": "" if poses is None else file_fingerprint(poses), "retrieve": vis_retrieve_queries,
        "points": files_fingerprint(list(maps)),
        "world_up": None if world_up is None else np.asarray(world_up, float).tolist(),
    }  # fmt: skip
    plan = _Plan.of(session, subsession, queries if keyframes_only else None, every, localized)
    placed = plan.all_poses[is_posed(plan.all_poses)]
    up = np.asarray(up_of_cameras(placed) if world_up is None else world_up, np.float64)
    local_map = load_maps(maps)
    messages = []
    if not len(placed):
        messages.append(f"{session.id}: no frame has a pose; images are shown without a place.")
    if map_dir is not None and local_map is None:
        messages.append(f"{map_dir}: holds no map for this recording, so no points are shown.")
    counts = Counter(frames=len(plan.frames))
    with viewer.open_recording(path, f"{capture.name}_{session.id}", _session_layout(plan, placed, up)) as stream:
        stream.log("world", viewer.world_axes(up), static=True)
        if local_map is not None:
            points, colors = sure_points(local_map)
            viewer.log_points(stream, points, colors)
            counts["points"] = len(points)
        color = viewer.rgb(color_of(session.device))
        for name, tracks in plan.tracks.items():
            # A line a subsession: recordings joined would draw paths nobody went.
            lines = rr.LineStrips3D([track for track in tracks if len(track) > 1], colors=color)
            stream.log(f"world/{viewer.entity(name)}/trajectory", lines, static=True)
        if localized is not None:
            _log_queries(stream, localized, session)
            counts["queries"] = len(localized.poses)
        writer = _FrameWriter(stream, viewer.camera_depth_m(placed[:, :3, 3]), color_of(session.device))
        writer.announce(plan.frames)

        def load(number: int) -> list[_Shot]:
            return [_load(shot, image_size) for shot in plan.shots(number)]

        loaded = prefetch(load, range(len(plan.frames)), default_workers())
        bar = tqdm(loaded, total=len(plan.frames), desc=session.id, unit="frame", disable=not progress)
        for frame, shots in zip(plan.frames, bar, strict=True):
            counts.update(writer.write(frame, shots))
        writer.finish()
    if counts["unreadable"]:
        messages.append(f"{session.id}: {counts['unreadable']} images or depth maps cannot be read.")
    seconds, size_bytes = round(time.perf_counter() - started, 2), path.stat().st_size
    write_sidecar(path, settings)
    recording = SessionRecording(path, **counts, seconds=seconds, bytes=size_bytes, messages=messages)
    logger.info("%s: %d frames, %d images in %.0f s, %.1f MB", path, recording.frames, recording.images, seconds,
                size_bytes / 1e6)  # fmt: skip
    if spawn:
        viewer.spawn_viewer(path)
    return recording


@dataclass(frozen=True)
class _Shot:
    """A picture or depth map of a frame: what to read and where it goes; and, once read, what is shown."""

    slot: str
    """Name of its camera in the recording, the same from frame to frame."""
    camera: "pycolmap.Camera"
    parent_from_sensor: Floats
    """(4, 4) in the rig; of a camera without one, in the world; NaN where it has no pose."""
    path: Path
    is_depth: bool = False
    data: bytes = b""
    """JPEG, or 16-bit PNG of millimeters; empty where a depth map cannot be read."""
    size: tuple[int, int] = (0, 0)
    """Width and height shown."""
    readable: bool = False


@dataclass(frozen=True)
class _Frame:
    """What one device took at one time."""

    index: int
    """Of the instant, among all of the session."""
    timestamp: int
    subsession: str
    device: str
    """Name of the rig in the recording; empty for a camera without one."""
    device_id: str
    world_from_device: Floats
    """(4, 4), NaN without a pose."""
    rows: Ints
    """Of the session's images."""
    slots: tuple[str, ...]
    """Names of their cameras in the recording."""

    @property
    def posed(self) -> bool:
        return bool(is_posed(self.world_from_device))

    @property
    def entity(self) -> str:
        """Path of the device, or of the subsession for a camera without one."""
        parts = ["world" if self.posed else "unposed", self.subsession, *([self.device] if self.device else [])]
        return viewer.entity(*parts)


@dataclass
class _Plan:
    """What is to be recorded of a session, without a picture read yet."""

    session: Session
    frames: list[_Frame]
    tracks: dict[str, list[Floats]]
    """World positions (n, 3) along each device's way, of every subsession shown, thinned or not."""
    all_poses: Floats
    """world_from_cam (n, 4, 4) of one camera a frame shown."""
    depths: dict[tuple[int, str], list[int]]
    """Rows of the session's depth maps by timestamp and device."""
    rig_from_depth: Floats

    @classmethod
    def of(
        cls, session: Session, subsession: str, keyframes: str | None, every: int, localized: "_QueryPoses | None"
    ) -> "_Plan":
        if subsession != "all" and subsession not in session.subsessions:
            raise CaptureError(
                f"Session {session.id} has no subsession {subsession!r}; known: {', '.join(session.subsessions)}, all."
            )
        table = _slots(session)
        if subsession != "all":
            table = table[table["subsession"] == subsession]
        trajectory = session.ground_truth if session.split == "query" else session.trajectory
        if localized is not None and session.split == "query":
            trajectory = localized.poses
        groups = table.groupby(["index", "device_slot"], sort=False)
        first = table.loc[groups.head(1).index]
        poses = np.full((len(first), 4, 4), np.nan)
        if trajectory is not None:
            poses = trajectory.lookup(first["timestamp"].to_numpy(), first["device_id"].to_numpy(str))
        shown = np.ones(len(first), bool)
        if keyframes is not None:
            listed = pd.MultiIndex.from_frame(session.keyframes(keyframes)[["timestamp", "device_id"]].astype(object))
            shown = pd.MultiIndex.from_frame(first[["timestamp", "device_id"]].astype(object)).isin(listed)
        kept = np.unique(first["index"].to_numpy()[shown])[::every]
        shown &= np.isin(first["index"], kept)
        rows_of = groups.indices
        names = ["index", "timestamp", "subsession", "device_slot", "device_id"]
        image_rows, slots = table["row"].to_numpy(), table["slot"].to_numpy()
        frames = []
        for k, values in enumerate(first[names].itertuples(index=False, name=None)):
            if shown[k]:
                index, timestamp, name, device, device_id = values
                own = rows_of[index, device]
                frames.append(_Frame(index, timestamp, name, device, device_id, poses[k], image_rows[own],
                                     tuple(slots[own])))  # fmt: skip
        rows = np.array([frame.rows[0] for frame in frames], np.int64)
        cameras = poses[shown] @ session.rig_from_cam(rows) if len(rows) else np.zeros((0, 4, 4))
        depths: dict[tuple[int, str], list[int]] = {}
        rig_from_depth = np.zeros((0, 4, 4))
        if session.depths is not None:
            times = session.depths["timestamp"].to_numpy(np.int64)
            devices, rig_from_depth = session.devices_of(times, session.depths["sensor_id"])
            for row, key in enumerate(zip(times.tolist(), devices.tolist(), strict=True)):
                depths.setdefault(key, []).append(row)
        return cls(session, frames, _tracks(first, poses), cameras, depths, rig_from_depth)

    def shots(self, number: int) -> list[_Shot]:
        """Return what is to be read for a frame."""
        frame, session = self.frames[number], self.session
        in_rig = frame.device != ""
        sensors, poses = session.images["sensor_id"].iloc[frame.rows].tolist(), session.rig_from_cam(frame.rows)
        shots = [
            _Shot(slot, session.camera(sensor), pose if in_rig else frame.world_from_device, session.image_path(row))
            for slot, sensor, pose, row in zip(frame.slots, sensors, poses, frame.rows.tolist(), strict=True)
        ]
        slot_of = dict(zip(sensors, frame.slots, strict=True))
        for rank, row in enumerate(self.depths.get((frame.timestamp, frame.device_id), [])):
            sensor = str(session.depths["sensor_id"].iloc[row])  # type: ignore[index]
            path = session.depth_path(frame.timestamp, sensor)
            if path is not None:
                pose, slot = self.rig_from_depth[row] if in_rig else frame.world_from_device, slot_of.get(sensor, rank)
                shots.append(_Shot(f"{slot}_depth", session.camera(sensor), pose, path, is_depth=True))
        return shots


def session_tracks(session: Session) -> list[Floats]:
    """Return the ways of a session's cameras, a list of world positions (n, 3), meters, a subsession and device.

    Of a rig its first camera's; of a map by the trajectory, of queries by the ground truth.
    """
    table = _slots(session)
    first = table.loc[table.groupby(["index", "device_slot"], sort=False).head(1).index]
    rows = first["row"].to_numpy()
    return [t for ts in _tracks(first, session.world_from_cam(rows, session.split == "query")).values() for t in ts]


def _tracks(frames: pd.DataFrame, poses: Floats) -> dict[str, list[Floats]]:
    """Return the positions of frames that have a pose, by subsession, a list a device."""
    tracks: dict[str, list[Floats]] = {}
    groups = frames.reset_index(drop=True).groupby(["subsession", "device_slot"], sort=False)
    for (name, _), rows in groups.indices.items():
        centers = poses[rows, :3, 3]
        tracks.setdefault(str(name), []).append(centers[np.isfinite(centers).all(1)])
    return tracks


def _slots(session: Session) -> pd.DataFrame:
    """Return the photographs of a session in order of subsession and time, with names for their cameras and rigs.

    Columns row, subsession, timestamp, device_id, index (of the instant), slot, device_slot. An id that is used
    once in a recording of many instants was made for its frame; the camera is then named by its rank in it.
    """
    rows = session.camera_rows
    order = {name: rank for rank, name in enumerate(session.subsessions)}
    table = pd.DataFrame({
        "row": rows,
        "subsession": pd.Series(session.subsession_of(rows)).replace("", session.id),
        "timestamp": session.images["timestamp"].to_numpy(np.int64)[rows],
        "sensor_id": session.images["sensor_id"].to_numpy(str)[rows],
        "device_id": session.device_ids[rows].astype(str),
    })  # fmt: skip
    table["rank"] = table["subsession"].map(order).fillna(len(order))
    table = table.sort_values(["rank", "subsession", "timestamp", "device_id", "sensor_id"], ignore_index=True)
    instant = ["subsession", "timestamp"]
    table["index"] = table.groupby(instant, sort=False).ngroup()
    rigs = _names(table, "device_id", instant, "rig")
    table["device_slot"] = rigs.where(table["device_id"] != table["sensor_id"], "")
    table["slot"] = _names(table, "sensor_id", [*instant, "device_slot"], "camera")
    return table


def _names(table: pd.DataFrame, column: str, frame: list[str], kind: str) -> pd.Series:
    """Return a name for each row's id, without the subsession; by rank in its `frame` where ids are made anew."""
    instants = table.groupby("subsession")["timestamp"].transform("nunique")
    anew = (table.groupby(["subsession", column])["timestamp"].transform("nunique") == 1) & (instants > 1)
    codes = table[column].astype("category").cat.codes[anew].groupby([table[key][anew] for key in frame])
    ranks = codes.rank("dense").reindex(table.index, fill_value=1)
    ids = zip(table["subsession"], table[column], ranks, anew, strict=True)
    names = [f"{kind}_{rank - 1:.0f}" if made else name.removeprefix(f"{sub}/") for sub, name, rank, made in ids]
    return pd.Series(names, index=table.index, dtype=object)


def _load(shot: _Shot, image_size: int) -> _Shot:
    """Read a picture or depth map and make it small; in a thread."""
    if shot.is_depth:
        try:
            depth = decode(shot.path, cv2.IMREAD_UNCHANGED)
        except ImageError:
            return shot
        if depth.dtype != np.uint16 or depth.ndim != 2:
            return shot
        scale = min(1.0, image_size / 2 / max(depth.shape))
        width, height = (max(1, round(scale * side)) for side in depth.shape[::-1])
        # Nearest: means across edges would hang in the air.
        small = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
        data = cv2.imencode(".png", small)[1].tobytes()
        return replace(shot, data=data, size=(width, height), readable=True)
    try:
        image, readable = read_image(shot.path), True
    except ImageError:
        blank = cv2.resize(read_for_display(shot.path), (shot.camera.width, shot.camera.height))
        image, readable = np.asarray(blank, np.uint8), False
    data, size = viewer.small_jpeg(image, image_size)
    return replace(shot, data=data, size=size, readable=readable)


class _FrameWriter:
    """Logs frames in order; what has not changed since the last frame is not logged again."""

    def __init__(self, stream: "rr.RecordingStream", size: float, color: str) -> None:
        self._stream, self._size, self._color = stream, size, color
        self._last: dict[tuple[str, str], tuple[float, ...]] = {}
        """Numbers last logged, by entity and kind."""
        self._alive: dict[tuple[str, str], dict[str, _Shot]] = {}
        """Entities of cameras that show something, and what, by subsession and device."""
        self._now: _Frame | None = None

    def write(self, frame: _Frame, shots: list[_Shot]) -> Counter[str]:
        """Log a frame; return how many of what it held."""
        import rerun as rr

        if self._now is not None and self._now.subsession != frame.subsession:
            self.finish()
        self._now = frame
        self._set_time(frame.index, frame.timestamp)
        if frame.posed and frame.device:
            self._stream.log(frame.entity, viewer.transform_of(frame.world_from_device))
        shown: dict[str, _Shot] = {}
        counts: Counter[str] = Counter()
        for shot in shots:
            counts["unreadable"] += not shot.readable
            if not shot.data:
                continue
            path = f"{frame.entity}/{viewer.entity(shot.slot)}"
            shown[path] = shot
            if frame.posed:
                pose = shot.parent_from_sensor
                self._log_changed(path, "pose", pose, lambda pose=pose: viewer.transform_of(pose))
            numbers = [*viewer.shown_intrinsics(shot.camera, shot.size).ravel(), *shot.size]
            self._log_changed(path, "pinhole", numbers, lambda s=shot: self._pinhole(s, self._size))
            if shot.is_depth:
                depth = rr.EncodedDepthImage(shot.data, media_type="image/png", meter=DEPTH_SCALE)
                self._stream.log(f"{path}/depth", depth)
                counts["depth_maps"] += 1
            else:
                self._stream.log(f"{path}/image", rr.EncodedImage(contents=shot.data, media_type="image/jpeg"))
                counts["images"] += 1
                counts["unposed"] += not frame.posed
        # What this device showed before and does not now would hang on at its old place.
        device = (frame.subsession, frame.device or frame.slots[0])
        self._hide({path: last for path, last in self._alive.get(device, {}).items() if path not in shown})
        self._alive[device] = shown
        return counts

    def announce(self, frames: list[_Frame]) -> None:
        """Log cameras that come later, too small to be seen: the viewer complains of pictures without a camera."""
        import rerun as rr

        if not frames:
            return
        self._set_time(frames[0].index, min(frame.timestamp for frame in frames))
        begin: dict[str, int] = {}
        for frame in frames:
            for slot in frame.slots if frame.posed else ():
                begin.setdefault(f"{frame.entity}/{viewer.entity(slot)}", frame.index)
        for path in [path for path, index in begin.items() if index > frames[0].index]:
            self._stream.log(path, rr.Pinhole(focal_length=1, width=1, height=1, image_plane_distance=viewer.HIDDEN_M))

    def finish(self) -> None:
        """End a subsession: the instant after its last frame shows none of its cameras."""
        if self._now is None:
            return
        self._set_time(self._now.index + 1, self._now.timestamp + 1)
        for shown in self._alive.values():
            self._hide(shown)
        self._alive.clear()

    def _set_time(self, index: int, timestamp: int) -> None:
        self._stream.set_time(FRAME, sequence=index)
        self._stream.set_time(CAPTURE_TIME, duration=np.timedelta64(timestamp, "us"))

    def _pinhole(self, shot: _Shot, depth_m: float) -> "rr.Pinhole":
        return viewer.pinhole_of(shot.camera, shot.size, depth_m, self._color)

    def _hide(self, cameras: dict[str, _Shot]) -> None:
        for path, shot in cameras.items():
            self._stream.log(path, self._pinhole(shot, viewer.HIDDEN_M))
            self._last.pop((path, "pinhole"), None)

    def _log_changed(self, path: str, kind: str, numbers: ArrayLike, make: Any) -> None:
        values = tuple(np.ravel(numbers).tolist())
        if self._last.get((path, kind)) != values:
            self._stream.log(path, make())
            self._last[path, kind] = values


def _session_layout(plan: _Plan, poses: Floats, up: Floats) -> Any:
    """Return the viewer's layout: the scene, and beside it the cameras of each subsession."""
    import rerun.blueprint as rrb

    tabs: dict[str, dict[str, str]] = {}
    for frame in plan.frames:
        for slot in frame.slots:
            tabs.setdefault(frame.subsession, {})[f"{frame.entity}/{viewer.entity(slot)}"] = slot
    views = [
        rrb.Grid(*[rrb.Spatial2DView(origin=path, name=slot) for path, slot in cameras.items()], name=name)
        for name, cameras in list(tabs.items())[:MAX_TABS]
    ]
    scene = viewer.scene_view(poses, up, plan.session.id)
    panel = rrb.TimePanel(state="collapsed", timeline=FRAME, play_state="paused")
    layout = rrb.Horizontal(scene, rrb.Tabs(*views), column_shares=[2, 1]) if views else rrb.Horizontal(scene)
    return rrb.Blueprint(layout, panel, collapse_panels=True)


@dataclass(frozen=True)
class _QueryPoses:
    """Poses of queries from a trajectories file, and what they were localized by."""

    poses: Trajectory
    map_device: str
    """Of the pair that the file is named after; empty where its name says none."""
    query_device: str
    lines: list[Floats]
    """Positions (2, 3) of a query and of a reference that it was localized by; none where they are not wanted."""

    @classmethod
    def read(cls, path: Path, capture: Capture, session: Session, with_references: bool) -> "_QueryPoses":
        poses = Trajectory.read(path)
        prefix = f"{capture.name}_map_"
        named = path.stem.startswith(prefix) and "_query_" in path.stem
        map_device, _, query_device = path.stem.removeprefix(prefix).partition("_query_") if named else ("", "", "")
        of_session = map_device if session.split == "map" else query_device
        if named and of_session != session.device:
            raise ArtifactError(
                f"{path.name} holds {query_device} queries in the {map_device} map, which has nothing to do with "
                f"session {session.id}. Expected a file for that device."
            )
        if not with_references:
            return cls(poses, map_device, query_device, [])
        if not named:
            raise ArtifactError(
                f"{path}: which references a query was localized by stands in the file of a pair, "
                f"{prefix}<M>_query_<Q>.h5. Name such a pair's poses, or leave vis_retrieve_queries out."
            )
        queries, map_session = LocalizedQueries(path.with_suffix(".h5")), capture[f"{map_device}_map"]
        centers = map_session.world_from_cam()[:, :3, 3]
        center_of = dict(zip(map_session.image_names, centers, strict=True))
        keys = zip(poses.timestamps.tolist(), poses.device_ids.tolist(), strict=True)
        lines = [
            np.stack([pose[:3, 3], center_of[name]])
            for key, pose in zip(keys, poses.world_from_device, strict=True)
            for name in queries.get(key, LocalizedQuery()).references
            if name in center_of
        ]
        queries.close()
        return cls(poses, map_device, query_device, lines)


def _log_queries(stream: "rr.RecordingStream", queries: _QueryPoses, session: Session) -> None:
    """Log where queries are, joined with their references. In a query session, lines only."""
    import rerun as rr

    poses = queries.poses
    if session.split == "map":
        labels = [f"{time} {device}" for time, device in zip(poses.timestamps, poses.device_ids, strict=True)]
        dots = rr.Points3D(poses.world_from_device[:, :3, 3], colors=viewer.rgb(color_of(queries.query_device)),
                           radii=rr.Radius.ui_points(4), labels=labels, show_labels=False)  # fmt: skip
        stream.log("world/queries/poses", dots, static=True)
    if queries.lines:
        stream.log("world/queries/references", rr.LineStrips3D(queries.lines, colors=viewer.rgb(ORANGE)), static=True)
