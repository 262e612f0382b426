"""Record sessions for the rerun viewer: images on a timeline, posed cameras, map points, depth maps."""

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

from toolkit.capture import DEPTH_SCALE, RAW_DATA, Capture, Session, Trajectory
from toolkit.capture.devices import color_of
from toolkit.capture.images import decode, default_workers, prefetch, read_for_display, read_image
from toolkit.capture.world_up import up_of_cameras
from toolkit.errors import ArtifactError, CaptureError, ImageError
from toolkit.figures.style import ORANGE
from toolkit.files import file_fingerprint, files_fingerprint, pair_devices, write_sidecar
from toolkit.geometry import Floats, Ints, local_origin, shifted
from toolkit.results.images import sure_points
from toolkit.results.metrics import is_posed
from toolkit.results.pair import PairResults, load_maps, map_files
from toolkit.viewer import blueprint as viewer

if TYPE_CHECKING:
    import pycolmap
    import rerun as rr

logger = logging.getLogger(__name__)


FRAME, CAPTURE_TIME = "frame", "capture_time"
"""Timelines: index of the instant in its session, and the timestamp of the files as a duration (microseconds)."""
MAX_TABS = 12
"""Tabs beside the scene, one per subsession; the cameras of further subsessions have none."""


@dataclass(frozen=True)
class SessionRecording:
    """The content of a session's recording."""

    path: Path
    frames: int = 0
    """Recorded frames: one per device and timestamp."""
    images: int = 0
    unreadable: int = 0
    """Images and depth maps that could not be read; a gray picture replaces an unreadable image."""
    unposed: int = 0
    """Images of frames without a pose, under `unposed/`: shown beside the scene."""
    depth_maps: int = 0
    points: int = 0
    queries: int = 0
    """Queries drawn in the map."""
    seconds: float = 0.0
    bytes: int = 0
    messages: list[str] = field(default_factory=list)

    @property
    def command(self) -> str:
        """Command that opens the recording."""
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

    Entities (`<device>` is the rig; a camera without a rig has no such level):

        world/<subsession>/<device>                    world_from_rig, once per frame
        world/<subsession>/<device>/<camera>           rig_from_cam and intrinsics, repeated only when they change
        world/<subsession>/<device>/<camera>/image     JPEG
        world/<subsession>/<device>/<camera>_depth/depth    depth map
        world/<subsession>/trajectory, world/points, world/queries/..., unposed/<subsession>/<device>/<camera>

    Sensors and rigs with a new id in each frame share an entity. Timelines: `frame`, the index among all instants of
    the session, so a thinned recording keeps the numbers of the full one; `capture_time`, the timestamp of the files.
    The viewer has numbers of single precision, so a world far from its origin (UTM, ECEF) is shifted, see
    `geometry.local_origin`.

    Args:
        split: `map` or `query`.
        device: device key; with `split` it names the session.
        subsession: name of a subsession, or `all`.
        keyframes_only: record only frames in the session's keyframe list `queries`.
        every: record every n-th instant (after `keyframes_only`).
        vis_retrieve_queries: join each query of `queries_pose` with the references that it was localized with, read
            from the `.h5` file beside `queries_pose`.
        queries_pose: trajectories file, world_from_device of queries. The cameras of a query session have these poses
            (None: the ground truth); a map session shows them in the map.
        out: file to write; None: `<scene>_<device>_<split>.rrd` in the working directory.
        map_dir: folder of triangulated maps whose points are shown: those of the map session or, for a query session,
            of the map that `queries_pose` is named after. With `queries_pose`, only the maps used for those poses;
            else all maps of the session.
        image_size: longer side of the images shown, pixels; depth maps have half of it.
        world_up: up direction (3,); None: estimated from the cameras.

    Raises:
        CaptureError: unknown session, subsession or keyframe list.
        ArtifactError: `vis_retrieve_queries` without the h5 of `queries_pose`, or `queries_pose` of another session.
    """
    import rerun as rr

    started = time.perf_counter()
    if every < 1:
        raise CaptureError(f"every={every}: expected 1 (every frame) or more.")
    capture = Capture.open(scene)
    session = capture[f"{device}_{split}"]
    path = Path(out) if out is not None else Path(f"{capture.name}_{session.id}.rrd")
    if queries_pose is None and vis_retrieve_queries:
        raise ArtifactError("vis_retrieve_queries shows the references of `queries_pose`; give that file too.")
    poses = None if queries_pose is None else Path(queries_pose)
    localized = None if poses is None else _QueryPoses.read(poses, capture, session, vis_retrieve_queries)
    map_device = device if split == "map" else "" if localized is None else localized.map_device
    maps = map_files(map_dir, f"{map_device}_map", localized.h5 if localized else None) if map_device else ()
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
        messages.append(f"{session.id}: no frame has a pose, so images are shown beside the scene.")
    if map_dir is not None and local_map is None:
        messages.append(f"{map_dir}: holds no map for this recording, so no points are shown.")
    counts = Counter(frames=len(plan.frames))
    with viewer.open_recording(path, f"{capture.name}_{session.id}", _session_layout(plan, placed, up)) as stream:
        stream.log("world", viewer.world_axes(up), static=True)
        if local_map is not None:
            points, colors = sure_points(local_map)
            viewer.log_points(stream, points - plan.origin, colors)
            counts["points"] = len(points)
        color = viewer.rgb(color_of(session.device))
        for name, tracks in plan.tracks.items():
            # One line per track: joined, they would show paths that nobody took.
            lines = rr.LineStrips3D([track for track in tracks if len(track) > 1], colors=color)
            stream.log(f"world/{viewer.entity(name)}/trajectory", lines, static=True)
        if localized is not None:
            _log_queries(stream, localized, session, plan.origin)
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
    write_sidecar(path, settings, made_from=[] if queries_pose is None else [queries_pose])
    recording = SessionRecording(path, **counts, seconds=seconds, bytes=size_bytes, messages=messages)
    logger.info("%s: %d frames, %d images in %.0f s, %.1f MB", path, recording.frames, recording.images, seconds,
                size_bytes / 1e6)  # fmt: skip
    if spawn:
        viewer.spawn_viewer(path)
    return recording


@dataclass(frozen=True)
class _Shot:
    """An image or depth map of a frame: where to read it and where to log it; once read, also the data to show."""

    slot: str
    """Name of its camera in the recording, the same in all frames."""
    camera: "pycolmap.Camera"
    parent_from_sensor: Floats
    """rig_from_cam (4, 4); world_from_cam for a camera without a rig. NaN without a pose."""
    path: Path
    is_depth: bool = False
    data: bytes = b""
    """JPEG, or 16-bit PNG in millimeters; empty if a depth map cannot be read."""
    size: tuple[int, int] = (0, 0)
    """Width and height as shown, pixels."""
    readable: bool = False


@dataclass(frozen=True)
class _Frame:
    """The images of one device at one timestamp."""

    index: int
    """Index of the instant among all of the session."""
    timestamp: int
    subsession: str
    device: str
    """Name of the rig in the recording; empty for a camera without a rig."""
    device_id: str
    world_from_device: Floats
    """(4, 4), NaN without a pose."""
    rows: Ints
    """Rows of its images in the session."""
    slots: tuple[str, ...]
    """Names of the images' cameras in the recording."""

    @property
    def posed(self) -> bool:
        return bool(is_posed(self.world_from_device))

    @property
    def entity(self) -> str:
        """Path of the device, or of the subsession for a camera without a rig."""
        parts = ["world" if self.posed else "unposed", self.subsession, *([self.device] if self.device else [])]
        return viewer.entity(*parts)


@dataclass
class _Plan:
    """The frames of a session to record; no image is read yet."""

    session: Session
    frames: list[_Frame]
    tracks: dict[str, list[Floats]]
    """World positions (n, 3) of each device, by subsession; of all frames, also those that thinning drops."""
    all_poses: Floats
    """world_from_cam (n, 4, 4) of one camera of each frame in `frames`."""
    depths: dict[tuple[int, str], list[int]]
    """Rows of the session's depth maps by timestamp and device."""
    rig_from_depth: Floats
    origin: Floats
    """(3,) what is subtracted from all world positions."""

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
        first = table.drop_duplicates(["index", "device_slot"])
        poses = np.full((len(first), 4, 4), np.nan)
        if trajectory is not None:
            poses = trajectory.lookup(first["timestamp"].to_numpy(), first["device_id"].to_numpy(str))
        origin = local_origin(poses[is_posed(poses), :3, 3])
        poses = shifted(poses, -origin)
        shown = np.ones(len(first), bool)
        if keyframes is not None:
            listed = pd.MultiIndex.from_frame(session.keyframes(keyframes)[["timestamp", "device_id"]].astype(object))
            shown = pd.MultiIndex.from_frame(first[["timestamp", "device_id"]].astype(object)).isin(listed)
        kept = np.unique(first["index"].to_numpy()[shown])[::every]
        shown &= np.isin(first["index"], kept)
        rows_of = table.groupby(["index", "device_slot"], sort=False).indices
        image_rows, slots = table["row"].to_numpy(), table["slot"].to_numpy()
        columns = first.loc[shown, ["index", "timestamp", "subsession", "device_slot", "device_id"]]
        frames = []
        for values, pose in zip(columns.itertuples(index=False, name=None), poses[shown], strict=True):
            index, timestamp, name, device, device_id = values
            rows = rows_of[index, device]
            frames.append(
                _Frame(index, timestamp, name, device, device_id, pose, image_rows[rows], tuple(slots[rows]))
            )
        rows = np.array([frame.rows[0] for frame in frames], np.int64)
        cameras = poses[shown] @ session.rig_from_cam(rows) if len(rows) else np.zeros((0, 4, 4))
        depths: dict[tuple[int, str], list[int]] = {}
        rig_from_depth = np.zeros((0, 4, 4))
        if session.depths is not None:
            times = session.depths["timestamp"].to_numpy(np.int64)
            devices, rig_from_depth = session.devices_of(times, session.depths["sensor_id"])
            for row, key in enumerate(zip(times.tolist(), devices.tolist(), strict=True)):
                depths.setdefault(key, []).append(row)
        return cls(session, frames, _tracks(first, poses), cameras, depths, rig_from_depth, origin)

    def shots(self, number: int) -> list[_Shot]:
        """Return the images and depth maps to read for a frame."""
        frame, session = self.frames[number], self.session
        in_rig = frame.device != ""
        sensors, poses = session.images["sensor_id"].iloc[frame.rows].tolist(), session.rig_from_cam(frame.rows)
        shots = [
            _Shot(slot, session.camera(sensor), pose if in_rig else frame.world_from_device, session.image_path(row))
            for slot, sensor, pose, row in zip(frame.slots, sensors, poses, frame.rows.tolist(), strict=True)
        ]
        slot_of = dict(zip(sensors, frame.slots, strict=True))
        for rank, row in enumerate(self.depths.get((frame.timestamp, frame.device_id), [])):
            sensor, path = session.depths[["sensor_id", "path"]].iloc[row]  # type: ignore[index]
            pose, slot = self.rig_from_depth[row] if in_rig else frame.world_from_device, slot_of.get(sensor, rank)
            file = session.path / RAW_DATA / path
            shots.append(_Shot(f"{slot}_depth", session.camera(sensor), pose, file, is_depth=True))
        return shots


def session_tracks(session: Session) -> list[Floats]:
    """Return the tracks of a session, one per subsession and device: world positions (n, 3), meters.

    A rig's track is that of its first camera. Maps have the poses of the trajectory, queries those of the ground truth.
    """
    first = _slots(session).drop_duplicates(["index", "device_slot"])
    poses = session.world_from_cam(first["row"].to_numpy(), session.split == "query")
    return [track for tracks in _tracks(first, poses).values() for track in tracks]


def _tracks(frames: pd.DataFrame, poses: Floats) -> dict[str, list[Floats]]:
    """Return the positions of the frames with a pose, by subsession: one array per device."""
    tracks: dict[str, list[Floats]] = {}
    groups = frames.reset_index(drop=True).groupby(["subsession", "device_slot"], sort=False)
    for (name, _), rows in groups.indices.items():
        centers = poses[rows, :3, 3]
        tracks.setdefault(str(name), []).append(centers[np.isfinite(centers).all(1)])
    return tracks


def _slots(session: Session) -> pd.DataFrame:
    """Return the images of a session in order of subsession and time, with names for their cameras and rigs.

    Columns row, subsession, timestamp, device_id, index (of the instant), slot, device_slot. Some captures make new
    sensor ids for each frame: an id that occurs once in a subsession of several instants. Such a camera is named by its
    rank in the frame, so that it keeps its name.
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
    rigs = _stable_names(table, "device_id", instant, "rig")
    table["device_slot"] = rigs.where(table["device_id"] != table["sensor_id"], "")
    table["slot"] = _stable_names(table, "sensor_id", [*instant, "device_slot"], "camera")
    return table


def _stable_names(table: pd.DataFrame, column: str, frame: list[str], kind: str) -> pd.Series:
    """Return a name for each id in `column`: the id without its subsession, or its rank in the `frame` if it is new."""
    instants = table.groupby("subsession")["timestamp"].transform("nunique")
    is_new = (table.groupby(["subsession", column])["timestamp"].transform("nunique") == 1) & (instants > 1)
    codes = table[column].astype("category").cat.codes[is_new].groupby([table[key][is_new] for key in frame])
    ranks = codes.rank("dense").reindex(table.index, fill_value=1)
    ids = zip(table["subsession"], table[column], ranks, is_new, strict=True)
    names = [f"{kind}_{rank - 1:.0f}" if new else name.removeprefix(f"{sub}/") for sub, name, rank, new in ids]
    return pd.Series(names, index=table.index, dtype=object)


def _load(shot: _Shot, image_size: int) -> _Shot:
    """Read an image or depth map and reduce it; thread-safe."""
    if shot.is_depth:
        try:
            depth = decode(shot.path, cv2.IMREAD_UNCHANGED)
        except ImageError:
            return shot
        if depth.dtype != np.uint16 or depth.ndim != 2:
            return shot
        scale = min(1.0, image_size / 2 / max(depth.shape))
        width, height = (max(1, round(scale * side)) for side in depth.shape[::-1])
        # Nearest: averages across depth edges would float in the air.
        small = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
        data = cv2.imencode(".png", small)[1].tobytes()
        return replace(shot, data=data, size=(width, height), readable=True)
    try:
        image, readable = read_image(shot.path, longest=image_size), True
    except ImageError:
        blank = cv2.resize(read_for_display(shot.path, image_size), (shot.camera.width, shot.camera.height))
        image, readable = np.asarray(blank, np.uint8), False
    data, size = viewer.small_jpeg(image, image_size)
    return replace(shot, data=data, size=size, readable=readable)


class _FrameWriter:
    """Logs frames in order; poses and intrinsics that have not changed are not logged again."""

    def __init__(self, stream: "rr.RecordingStream", size: float, color: str) -> None:
        self._stream, self._size, self._color = stream, size, color
        self._last: dict[tuple[str, str], tuple[float, ...]] = {}
        """Values last logged, by entity and kind."""
        self._visible: dict[tuple[str, str], dict[str, _Shot]] = {}
        """Cameras that are shown now: shots by entity, by subsession and device."""
        self._last_frame: _Frame | None = None

    def write(self, frame: _Frame, shots: list[_Shot]) -> Counter[str]:
        """Log a frame; return the counts of its images and depth maps by kind."""
        import rerun as rr

        if self._last_frame is not None and self._last_frame.subsession != frame.subsession:
            self.finish()
        self._last_frame = frame
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
            intrinsics = [*viewer.shown_intrinsics(shot.camera, shot.size).ravel(), *shot.size]
            self._log_changed(path, "pinhole", intrinsics, lambda s=shot: self._pinhole(s, self._size))
            if shot.is_depth:
                depth = rr.EncodedDepthImage(shot.data, media_type="image/png", meter=DEPTH_SCALE)
                self._stream.log(f"{path}/depth", depth)
                counts["depth_maps"] += 1
            else:
                self._stream.log(f"{path}/image", rr.EncodedImage(contents=shot.data, media_type="image/jpeg"))
                counts["images"] += 1
                counts["unposed"] += not frame.posed
        # Hide the device's cameras of the last frame that this frame lacks, or they would stay at their old place.
        device = (frame.subsession, frame.device or frame.slots[0])
        self._hide({path: last for path, last in self._visible.get(device, {}).items() if path not in shown})
        self._visible[device] = shown
        return counts

    def announce(self, frames: list[_Frame]) -> None:
        """Log cameras that appear later, too small to see: the viewer complains about images without a camera."""
        import rerun as rr

        if not frames:
            return
        self._set_time(frames[0].index, min(frame.timestamp for frame in frames))
        first_index: dict[str, int] = {}
        for frame in frames:
            for slot in frame.slots if frame.posed else ():
                first_index.setdefault(f"{frame.entity}/{viewer.entity(slot)}", frame.index)
        for path, index in first_index.items():
            if index > frames[0].index:
                hidden = rr.Pinhole(focal_length=1, width=1, height=1, image_plane_distance=viewer.HIDDEN_M)
                self._stream.log(path, hidden)

    def finish(self) -> None:
        """End a subsession: hide all its cameras in the instant after its last frame."""
        if self._last_frame is None:
            return
        self._set_time(self._last_frame.index + 1, self._last_frame.timestamp + 1)
        for shown in self._visible.values():
            self._hide(shown)
        self._visible.clear()

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
    """Return the viewer's layout: the scene, and beside it a tab for each subsession with its cameras."""
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
    """Query poses from a trajectories file, and the references that they were localized with."""

    poses: Trajectory
    map_device: str
    """Map device from the name of the file; empty if the file is not named after a pair."""
    query_device: str
    h5: Path
    """The pair's correspondences, perhaps missing."""
    lines: list[Floats]
    """Positions (2, 3) of a query and of one of its references; empty unless read `with_references`."""

    @classmethod
    def read(cls, path: Path, capture: Capture, session: Session, with_references: bool) -> "_QueryPoses":
        poses = Trajectory.read(path)
        prefix = f"{capture.name}_map_"
        map_device, query_device = pair_devices(path.stem) if path.stem.startswith(prefix) else ("", "")
        is_pair = map_device != ""
        h5 = path.with_name(f"{path.stem.removesuffix('_sequence')}.h5")
        device = map_device if session.split == "map" else query_device
        if is_pair and device != session.device:
            raise ArtifactError(
                f"{path.name} holds {query_device} queries in the {map_device} map, which has nothing to do with "
                f"session {session.id}. Expected a file for that device."
            )
        if not with_references:
            return cls(poses, map_device, query_device, h5, [])
        if not is_pair:
            raise ArtifactError(
                f"{path}: the references of its queries are in the h5 file of a pair, {prefix}<M>_query_<Q>.h5, but "
                "this file is not named after a pair. Give the poses of a pair, or leave out vis_retrieve_queries."
            )
        results, map_session = PairResults.open(h5), capture[f"{map_device}_map"]
        centers = map_session.world_from_cam()[:, :3, 3]
        center_of = dict(zip(map_session.image_names, centers, strict=True))
        # The poses may be those of the sequence stage.
        own = poses.lookup(results.table["timestamp"], results.table["device_id"])
        lines = [
            np.stack([pose[:3, 3], center_of[name]])
            for result, pose in zip(results, own, strict=True)
            for name in result.references
            if name in center_of and is_posed(pose)
        ]
        return cls(poses, map_device, query_device, h5, lines)


def _log_queries(stream: "rr.RecordingStream", queries: _QueryPoses, session: Session, origin: Floats) -> None:
    """Log the positions of queries (in a map session), and lines from queries to their references, from an origin."""
    import rerun as rr

    poses = queries.poses
    if session.split == "map":
        labels = [f"{time} {device}" for time, device in zip(poses.timestamps, poses.device_ids, strict=True)]
        centers = poses.world_from_device[:, :3, 3] - origin
        dots = rr.Points3D(centers, colors=viewer.rgb(color_of(queries.query_device)), radii=rr.Radius.ui_points(4),
                           labels=labels, show_labels=False)  # fmt: skip
        stream.log("world/queries/poses", dots, static=True)
    if queries.lines:
        lines = rr.LineStrips3D([line - origin for line in queries.lines], colors=viewer.rgb(ORANGE))
        stream.log("world/queries/references", lines, static=True)
