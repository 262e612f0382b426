"""Record sessions for the rerun viewer: images on a timeline, posed cameras, map points, depth maps."""

import logging
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike
from tqdm.auto import tqdm

from toolkit.capture import DEPTH_SCALE, Capture, Session, Trajectory
from toolkit.capture.images import default_workers, prefetch, read_for_display, read_image
from toolkit.capture.names import color_of
from toolkit.capture.tables import read_depth
from toolkit.capture.upright import up_of_cameras
from toolkit.errors import ArtifactError, CaptureError, ImageError
from toolkit.figures.style import ORANGE
from toolkit.files import RAW_DATA, pair_devices, write_sidecar
from toolkit.geometry import Floats, Ints, local_origin, shifted
from toolkit.results.localized import sure_points
from toolkit.results.metrics import is_posed
from toolkit.results.pair import PairResults, load_maps, map_files
from toolkit.viewer import queries as viewer

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger(__name__)

FRAME, CAPTURE_TIME = "frame", "capture_time"
"""Timelines: index of the instant in its session, and the timestamp of the files as a duration (microseconds)."""
MAX_TABS = 12
"""Tabs beside the scene, one per subsession; the cameras of further subsessions have none."""


@dataclass(frozen=True)
class SessionRecording:
    """The content of a session's recording, in numbers."""

    path: Path
    frames: int = 0
    """One per device and timestamp."""
    images: int = 0
    unreadable: int = 0
    """Images and depth maps; a gray image replaces an unreadable one."""
    unposed: int = 0
    """Images of frames without a pose, under `unposed/`: shown beside the scene."""
    depth_maps: int = 0
    points: int = 0
    queries: int = 0
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
    started = time.perf_counter()
    if every < 1:
        raise CaptureError(f"every={every}: expected 1 (every frame) or more.")
    capture = Capture.open(scene)
    session = capture[f"{device}_{split}"]
    path = Path(out) if out is not None else Path(f"{capture.name}_{session.id}.rrd")
    localized = None
    if queries_pose is not None:
        localized = _QueryPoses.read(Path(queries_pose), capture, session, vis_retrieve_queries)
    elif vis_retrieve_queries:
        raise ArtifactError("vis_retrieve_queries shows the references of `queries_pose`; give that file too.")
    map_device = device if split == "map" else "" if localized is None else localized.map_device
    maps = map_files(map_dir, f"{map_device}_map", localized.h5 if localized else None) if map_device else ()
    estimated = localized.poses if localized is not None and split == "query" else None
    frames, tracks, origin = _frames_of(session, subsession, queries if keyframes_only else None, every, estimated)
    rows = [frame.rows[0] for frame in frames]
    placed = np.array([frame.world_from_device for frame in frames]).reshape(-1, 4, 4) @ session.rig_from_cam(rows)
    placed = placed[is_posed(placed)]
    up = np.asarray(up_of_cameras(placed) if world_up is None else world_up, np.float64)
    local_map, messages = load_maps(maps), []
    if not len(placed):
        messages.append(f"{session.id}: no frame has a pose, so images are shown beside the scene.")
    if map_dir is not None and local_map is None:
        messages.append(f"{map_dir}: holds no map for this recording, so no points are shown.")
    counts = Counter(frames=len(frames))
    with viewer.open_recording(path, f"{capture.name}_{session.id}", _layout(session, frames, placed, up)) as stream:
        stream.log("world", viewer.world_axes(up), static=True)
        if local_map is not None:
            points, colors = sure_points(local_map)
            viewer.log_points(stream, points - origin, colors)
            counts["points"] = len(points)
        for name, of_devices in tracks.items():
            # One line per track: joined, they would show paths that nobody took.
            lines = [track for track in of_devices if len(track) > 1]
            viewer.log_lines(stream, f"world/{viewer.entity(name)}/trajectory", lines, color_of(session.device))
        if localized is not None:
            _log_queries(stream, localized, session, origin)
            counts["queries"] = len(localized.poses)
        reader = _Reader(session, image_size)
        writer = _FrameWriter(stream, viewer.camera_depth_m(placed[:, :3, 3]), color_of(session.device))
        writer.announce(frames)
        loaded = prefetch(reader.read, frames, default_workers())
        bar = tqdm(loaded, total=len(frames), desc=session.id, unit="frame", disable=not progress)
        for frame, shots in zip(frames, bar, strict=True):
            counts.update(writer.write(frame, shots))
        writer.end_subsession()
    if counts["unreadable"]:
        messages.append(f"{session.id}: {counts['unreadable']} images or depth maps cannot be read.")
    write_sidecar(path, {"every": every}, made_from=[] if queries_pose is None else [queries_pose])
    seconds = round(time.perf_counter() - started, 2)
    recording = SessionRecording(path, **counts, seconds=seconds, bytes=path.stat().st_size, messages=messages)
    logger.info("%s: %d frames, %d images in %.0f s, %.1f MB", path, recording.frames, recording.images, seconds,
                recording.bytes / 1e6)  # fmt: skip
    if spawn:
        viewer.spawn_viewer(path)
    return recording


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
    """Names of the images' cameras in the recording, the same in all frames."""

    @property
    def posed(self) -> bool:
        return bool(is_posed(self.world_from_device))

    @property
    def entity(self) -> str:
        """Path of the device, or of the subsession for a camera without a rig."""
        parts = ["world" if self.posed else "unposed", self.subsession, *([self.device] if self.device else [])]
        return viewer.entity(*parts)


def _frames_of(
    session: Session, subsession: str, keyframes: str | None, every: int, estimated: Trajectory | None
) -> tuple[list[_Frame], dict[str, list[Floats]], Floats]:
    """Return the frames to record, no image is read yet; the tracks; and the origin (3,) of both.

    Tracks are world positions (n, 3) of each device, by subsession; of all frames, also those that thinning drops.
    """
    if subsession not in ("all", *session.subsessions):
        known = ", ".join(session.subsessions)
        raise CaptureError(f"Session {session.id} has no subsession {subsession!r}; known: {known}, all.")
    table, key = _slots(session), ["timestamp", "device_id"]
    if subsession != "all":
        table = table[table["subsession"] == subsession]
    first = table.drop_duplicates(["instant", "device_slot"])
    trajectory = estimated or (session.ground_truth if session.split == "query" else session.trajectory)
    poses = np.full((len(first), 4, 4), np.nan)
    if trajectory is not None:
        poses = trajectory.lookup(first["timestamp"].to_numpy(), first["device_id"].to_numpy(str))
    origin = local_origin(poses[is_posed(poses), :3, 3])
    poses, shown = shifted(poses, -origin), np.ones(len(first), bool)
    if keyframes is not None:
        of_frames, listed = (each[key].astype(object) for each in (first, session.keyframes(keyframes)))
        shown = pd.MultiIndex.from_frame(of_frames).isin(pd.MultiIndex.from_frame(listed))
    shown &= np.isin(first["instant"], np.unique(first["instant"].to_numpy()[shown])[::every])
    of_frame = table.groupby(["instant", "device_slot"], sort=False).indices
    rows, slots, frames = table["row"].to_numpy(), table["slot"].to_numpy(), []
    for one, pose in zip(first[shown].itertuples(), poses[shown], strict=True):
        images = of_frame[one.instant, one.device_slot]
        device = one.subsession, one.device_slot, one.device_id
        frames.append(_Frame(one.instant, one.timestamp, *device, pose, rows[images], tuple(slots[images])))
    return frames, _tracks(first, poses), origin


def session_tracks(session: Session) -> list[Floats]:
    """Return the tracks of a session, one per subsession and device: world positions (n, 3), meters.

    A rig's track is that of its first camera. Maps have the poses of the trajectory, queries those of the ground truth.
    """
    first = _slots(session).drop_duplicates(["instant", "device_slot"])
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

    Columns row, subsession, timestamp, device_id, instant (its number), slot, device_slot. Some captures make new
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
    at = ["subsession", "timestamp"]
    table["instant"] = table.groupby(at, sort=False).ngroup()
    rigs = _stable_names(table, "device_id", at, "rig")
    table["device_slot"] = rigs.where(table["device_id"] != table["sensor_id"], "")
    table["slot"] = _stable_names(table, "sensor_id", [*at, "device_slot"], "camera")
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


@dataclass(frozen=True)
class _Shot:
    """An image or depth map of a frame, reduced: where to log it, and what."""

    slot: str
    """Name of its camera in the recording."""
    camera: "pycolmap.Camera"
    parent_from_sensor: Floats
    """rig_from_cam (4, 4); world_from_cam for a camera without a rig. NaN without a pose."""
    data: bytes
    """JPEG, or 16-bit PNG in millimeters; empty if a depth map cannot be read."""
    size: tuple[int, int]
    """Width and height as shown, pixels."""
    readable: bool
    is_depth: bool = False


class _Reader:
    """Reads the images and depth maps of frames; thread-safe."""

    def __init__(self, session: Session, image_size: int) -> None:
        self.session, self.image_size, self.depths = session, image_size, dict[tuple[int, str], Ints]()
        """Rows of the session's depth maps by timestamp and device."""
        if session.depths is not None:
            times = session.depths["timestamp"].to_numpy(np.int64)
            devices, self.rig_from_depth = session.devices_of(times, session.depths["sensor_id"])
            self.depths = pd.DataFrame([times, devices]).T.groupby([0, 1]).indices

    def read(self, frame: _Frame) -> list[_Shot]:
        """Return the images and depth maps of a frame."""
        session, shots = self.session, []
        sensors, poses = session.images["sensor_id"].iloc[frame.rows].tolist(), session.rig_from_cam(frame.rows)
        for slot, sensor, pose, row in zip(frame.slots, sensors, poses, frame.rows.tolist(), strict=True):
            camera, pose = session.camera(sensor), pose if frame.device else frame.world_from_device
            shots.append(_Shot(slot, camera, pose, *self._image(session.image_path(row), camera)))
        slot_of = dict(zip(sensors, frame.slots, strict=True))
        for rank, row in enumerate(self.depths.get((frame.timestamp, frame.device_id), [])):
            sensor, path = session.depths[["sensor_id", "path"]].iloc[row]  # type: ignore[index]
            pose = self.rig_from_depth[row] if frame.device else frame.world_from_device
            slot, read = f"{slot_of.get(sensor, rank)}_depth", self._depth(session.path / RAW_DATA / path)
            shots.append(_Shot(slot, session.camera(sensor), pose, *read, is_depth=True))
        return shots

    def _image(self, path: Path, camera: "pycolmap.Camera") -> tuple[bytes, tuple[int, int], bool]:
        try:
            image, readable = read_image(path, longest=self.image_size), True
        except ImageError:
            blank = cv2.resize(read_for_display(path, self.image_size), (camera.width, camera.height))
            image, readable = np.asarray(blank, np.uint8), False
        return *viewer.small_jpeg(image, self.image_size), readable

    def _depth(self, path: Path) -> tuple[bytes, tuple[int, int], bool]:
        try:
            depth = read_depth(path)
        except CaptureError:
            return b"", (0, 0), False
        scale = min(1.0, self.image_size / 2 / max(depth.shape))
        width, height = (max(1, round(scale * side)) for side in depth.shape[::-1])
        # Nearest: averages across depth edges would float in the air.
        small = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
        return cv2.imencode(".png", np.rint(small * DEPTH_SCALE).astype(np.uint16))[1].tobytes(), (width, height), True


class _FrameWriter:
    """Logs frames in order; poses and intrinsics that have not changed are not logged again."""

    def __init__(self, stream: rr.RecordingStream, size: float, color: str) -> None:
        self._stream, self._size, self._color = stream, size, color
        self._last: dict[tuple[str, str], list[float]] = {}
        """Values last logged, by entity and kind."""
        self._visible: dict[str, dict[str, _Shot]] = {}
        """Cameras that are shown now: shots by entity, by device."""
        self._frame: _Frame | None = None

    def write(self, frame: _Frame, shots: list[_Shot]) -> Counter[str]:
        """Log a frame; return the counts of its images and depth maps by kind."""
        if self._frame is not None and self._frame.subsession != frame.subsession:
            self.end_subsession()
        self._frame = frame
        self._set_time(frame.index, frame.timestamp)
        if frame.posed and frame.device:
            self._stream.log(frame.entity, viewer.transform_of(frame.world_from_device))
        shown: dict[str, _Shot] = {}
        counts: Counter[str] = Counter(unreadable=sum(not shot.readable for shot in shots))
        for shot in (shot for shot in shots if shot.data):
            path = f"{frame.entity}/{viewer.entity(shot.slot)}"
            shown[path] = shot
            if frame.posed and self._has_changed(path, "pose", shot.parent_from_sensor):
                self._stream.log(path, viewer.transform_of(shot.parent_from_sensor))
            intrinsics = np.append(viewer.shown_intrinsics(shot.camera, shot.size), shot.size)
            if self._has_changed(path, "pinhole", intrinsics):
                self._stream.log(path, viewer.pinhole_of(shot.camera, shot.size, self._size, self._color))
            if shot.is_depth:
                depth = rr.EncodedDepthImage(shot.data, media_type="image/png", meter=DEPTH_SCALE)
                self._stream.log(f"{path}/depth", depth)
            else:
                self._stream.log(f"{path}/image", rr.EncodedImage(contents=shot.data, media_type="image/jpeg"))
            counts["depth_maps" if shot.is_depth else "images"] += 1
            counts["unposed"] += not (frame.posed or shot.is_depth)
        # Hide the device's cameras of the last frame that this frame lacks, or they would stay at their old place.
        device = frame.device or frame.slots[0]
        self._hide({path: last for path, last in self._visible.get(device, {}).items() if path not in shown})
        self._visible[device] = shown
        return counts

    def announce(self, frames: list[_Frame]) -> None:
        """Log cameras that appear later, too small to see: the viewer complains about images without a camera."""
        if not frames:
            return
        self._set_time(frames[0].index, min(frame.timestamp for frame in frames))
        first = {
            f"{frame.entity}/{viewer.entity(slot)}": frame.index
            for frame in reversed(frames)
            if frame.posed
            for slot in frame.slots
        }
        for path in (path for path, index in first.items() if index > frames[0].index):
            self._stream.log(path, viewer.hidden_camera())

    def end_subsession(self) -> None:
        """Hide all cameras in the instant after the last frame."""
        if self._frame is not None:
            self._set_time(self._frame.index + 1, self._frame.timestamp + 1)
        for shown in self._visible.values():
            self._hide(shown)
        self._visible.clear()

    def _set_time(self, index: int, timestamp: int) -> None:
        self._stream.set_time(FRAME, sequence=index)
        self._stream.set_time(CAPTURE_TIME, duration=np.timedelta64(timestamp, "us"))

    def _hide(self, cameras: dict[str, _Shot]) -> None:
        for path, shot in cameras.items():
            self._stream.log(path, viewer.pinhole_of(shot.camera, shot.size, viewer.HIDDEN_M, self._color))
            self._last.pop((path, "pinhole"), None)

    def _has_changed(self, path: str, kind: str, numbers: Floats) -> bool:
        """Return whether numbers differ from those last asked about."""
        values = numbers.ravel().tolist()
        changed = self._last.get((path, kind)) != values
        self._last[path, kind] = values
        return changed


def _layout(session: Session, frames: list[_Frame], poses: Floats, up: Floats) -> Any:
    """Return the viewer's layout: the scene, and beside it a tab for each subsession with its cameras."""
    tabs: dict[str, dict[str, str]] = {}
    for frame in frames:
        for slot in frame.slots:
            tabs.setdefault(frame.subsession, {})[f"{frame.entity}/{viewer.entity(slot)}"] = slot
    views = [
        rrb.Grid(*[rrb.Spatial2DView(origin=path, name=slot) for path, slot in cameras.items()], name=name)
        for name, cameras in list(tabs.items())[:MAX_TABS]
    ]
    scene = viewer.scene_view(poses, up, session.id)
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
        poses, prefix, lines = Trajectory.read(path), f"{capture.name}_map_", list[Floats]()
        mapped, queried = pair_devices(path.stem) if path.stem.startswith(prefix) else ("", "")
        if mapped and session.device != (mapped if session.split == "map" else queried):
            found = f"{queried} queries in the {mapped} map, which has nothing to do with session {session.id}"
            raise ArtifactError(f"{path.name} holds {found}. Expected a file for that device.")
        h5 = path.with_name(f"{path.stem.removesuffix('_sequence')}.h5")
        if with_references:
            if not mapped:
                fault = f"this file is not named after a pair, {prefix}<M>_query_<Q>, whose h5 file has the references"
                do = "Give the poses of a pair, or leave out vis_retrieve_queries."
                raise ArtifactError(f"{path}: {fault}. {do}")
            results, map_session = PairResults.open(h5), capture[f"{mapped}_map"]
            center_of = dict(zip(map_session.image_names, map_session.world_from_cam()[:, :3, 3], strict=True))
            # The poses may be those of the sequence stage.
            own = poses.lookup(results.table["timestamp"], results.table["device_id"])
            for result, pose in zip(results, own, strict=True):
                names = [name for name in result.references if name in center_of and is_posed(pose)]
                lines += [np.stack([pose[:3, 3], center_of[name]]) for name in names]
        return cls(poses, mapped, queried, h5, lines)


def _log_queries(stream: rr.RecordingStream, queries: _QueryPoses, session: Session, origin: Floats) -> None:
    """Log the positions of queries (in a map session), and lines from queries to their references, from an origin."""
    poses = queries.poses
    if session.split == "map":
        labels = [f"{time} {device}" for time, device in zip(poses.timestamps, poses.device_ids, strict=True)]
        centers, color = poses.world_from_device[:, :3, 3] - origin, viewer.rgb(color_of(queries.query_device))
        radius = rr.Radius.ui_points(4)
        dots = rr.Points3D(centers, colors=color, radii=radius, labels=labels, show_labels=False)
        stream.log("world/queries/poses", dots, static=True)
    if queries.lines:
        viewer.log_lines(stream, "world/queries/references", [line - origin for line in queries.lines], ORANGE)
