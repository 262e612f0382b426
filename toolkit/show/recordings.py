"""Rerun recordings of sessions to walk around in: images on a timeline, cameras where they stood, points, depth.

What all recordings share is here too: pictures made small, cameras, the viewer's layout, the command that opens a file.
"""

import logging
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from toolkit.capture import DEPTH_SCALE, Capture, Session, Trajectory
from toolkit.capture.devices import color_of
from toolkit.capture.images import default_workers, prefetch, read_for_display, read_image
from toolkit.capture.tables import read_query_table
from toolkit.capture.upright import up_of_cameras
from toolkit.errors import ArtifactError, CaptureError, ImageError
from toolkit.files import file_fingerprint, files_fingerprint, write_atomic, write_sidecar
from toolkit.geometry import rotation_to_quaternion
from toolkit.localizers.mapping import LocalMap
from toolkit.show.figures import GRAY, ORANGE
from toolkit.show.top_view import places_of

if TYPE_CHECKING:
    import pycolmap
    import rerun as rr

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

APPLICATION = "visual-localization"
FRAME, CAPTURE_TIME = "frame", "capture_time"
"""Timelines: index of the frame in its session, and the timestamp of the files as a duration (microseconds)."""
POINT_COLOR = GRAY
MAX_TABS = 12
HIDDEN_M = 1e-3
"""Depth of a camera that is not there now: too small to be seen."""


# What all recordings share


@contextmanager
def open_recording(out: str | Path, name: str, blueprint: Any) -> "Iterator[rr.RecordingStream]":
    """Yield a stream whose entries go to the file `out`, which stands whole when the block ends, or not at all."""
    import rerun as rr

    with write_atomic(out) as temporary:
        # A fixed id: opened again after another run, it replaces the old one in the viewer.
        stream = rr.RecordingStream(APPLICATION, recording_id=name)
        # Only the timelines that mean something; the time of writing would make every file differ.
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        try:
            # Before the first entry: batches are handed to the file as they fill.
            stream.save(temporary, default_blueprint=blueprint)
            stream.send_recording_name(name)
            yield stream
            stream.flush()
        finally:
            stream.disconnect()


def open_command(path: str | Path) -> str:
    """Return the command that opens a recording in the viewer."""
    return f"rerun {path}"


def spawn_viewer(path: str | Path) -> None:
    """Open a recording in a viewer of its own, which stays when this process ends."""
    subprocess.Popen(
        [sys.executable, "-m", "rerun_cli", str(path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def entity(*parts: str) -> str:
    """Return the path of an entity; parts may hold any character."""
    import rerun as rr

    return "/".join(rr.escape_entity_path_part(part) for part in parts)


def small_jpeg(image: Image, size: int, quality: int = 75) -> tuple[bytes, tuple[int, int]]:
    """Return an image, (H, W, 3) RGB or (H, W), reduced to `size` pixels on its longer side, as JPEG; and (w, h)."""
    scale = min(1.0, size / max(image.shape[:2]))
    width, height = (max(1, round(scale * side)) for side in image.shape[1::-1])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) if scale < 1 else image
    bgr = np.ascontiguousarray(small[..., ::-1]) if small.ndim == 3 else small
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes(), (width, height)


def shown_intrinsics(camera: "pycolmap.Camera", shown: tuple[int, int]) -> Array:
    """Return the matrix (3, 3) of a camera for its image at another size (w, h), pixels.

    The top-left corner of the image is (0, 0) at every size, so the matrix scales by rows. Distortion is left out:
    the viewer draws pinholes, and at this size it hardly shows.
    """
    return np.diag([shown[0] / camera.width, shown[1] / camera.height, 1.0]) @ camera.calibration_matrix()


def pinhole_of(camera: "pycolmap.Camera", shown: tuple[int, int], depth_m: float, color: str) -> "rr.Pinhole":
    """Return a pinhole for the image of a camera at the size shown, drawn `depth_m` deep."""
    import rerun as rr

    return rr.Pinhole(
        image_from_camera=shown_intrinsics(camera, shown),
        resolution=shown,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=depth_m,
        color=rgb(color),
    )


def transform_of(parent_from_child: ArrayLike) -> "rr.Transform3D":
    """Return the pose (4, 4) of an entity in its parent."""
    import rerun as rr

    pose = np.asarray(parent_from_child, np.float64)
    w, x, y, z = rotation_to_quaternion(pose[:3, :3])
    return rr.Transform3D(translation=pose[:3, 3], quaternion=rr.Quaternion(xyzw=[x, y, z, w]))


def jpeg_of(data: bytes) -> "rr.EncodedImage":
    """Return a JPEG as the viewer takes it."""
    import rerun as rr

    return rr.EncodedImage(contents=data, media_type="image/jpeg")


def world_axes(up: Array) -> Any:
    """Return the viewer's coordinates for the world axis that is nearest to `up`."""
    import rerun as rr

    axis = int(np.argmax(np.abs(up)))
    return getattr(rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}")


def scene_view(poses: Array, up: Array, name: str) -> Any:
    """Return the view of the 3D scene: from behind and above the place with the most cameras (N, 4, 4)."""
    import rerun.blueprint as rrb

    eye = None
    if len(poses):
        place = places_of(poses[:, :3, 3])
        here = poses[place == np.bincount(place).argmax()]
        center, view = here[:, :3, 3].mean(0), here[:, :3, 2].mean(0)
        view -= up * (view @ up)
        reach = max(3.0, float(np.linalg.norm(np.ptp(here[:, :3, 3], axis=0))))
        target = center + 0.3 * reach * view
        eye = rrb.EyeControls3D(position=target - reach * view + 0.7 * reach * up, look_target=target, eye_up=up)
    return rrb.Spatial3DView(origin="world", name=name, eye_controls=eye)


def camera_depth_m(centers: Array) -> float:
    """Return how deep to draw the cameras at (N, 3): about half the usual step between neighbors."""
    from scipy.spatial import cKDTree

    spots = np.unique(np.round(centers, 2), axis=0)
    if len(spots) < 2:
        return 0.3
    return float(np.clip(np.median(cKDTree(spots).query(spots, k=2)[0][:, 1]) / 2, 0.05, 1.0))


def log_points(stream: "rr.RecordingStream", points: ArrayLike, colors: NDArray[np.uint8] | None) -> None:
    """Log the map's points (P, 3), colors (P, 3) RGB or None, as `world/points`."""
    import rerun as rr

    cloud = rr.Points3D(points, colors=rgb(POINT_COLOR) if colors is None else colors, radii=rr.Radius.ui_points(1.5))
    stream.log("world/points", cloud, static=True)


def sure_points(local_map: LocalMap) -> tuple[Array, NDArray[np.uint8]]:
    """Return the points that at least three images see, (P, 3), and their colors (P, 3); the rest is noisy."""
    sure = local_map.track_lengths >= 3
    return local_map.points[sure], local_map.colors[sure]


def posed(poses: Array) -> NDArray[np.bool_]:
    """Return which of poses (N, 4, 4) are finite."""
    return np.asarray(np.isfinite(poses).all((1, 2)), bool)


def rgb(color: str) -> list[int]:
    """Return the three numbers of `#rrggbb`."""
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]


# A session


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
        return open_command(self.path)


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
    image_size: int = 480,
    quality: int = 75,
    world_up: ArrayLike | None = None,
    workers: int | None = None,
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
        scene: capture folder.
        split: `map` or `query`.
        device: device key; with `split` it names the session.
        subsession: `all`, or one.
        keyframes_only: only frames in the session's keyframe list `queries`.
        every: every so many frames (after `keyframes_only`).
        spawn: open the viewer when done.
        vis_retrieve_queries: with `queries_pose`, join each query with the references that it was localized by.
        queries_pose: trajectories file, world_from_device of queries. In a query session, cameras stand where it
            says (else: at the ground truth); in a map session, its poses are drawn in the map.
        out: file to write; None: `<scene>_<device>_<split>.rrd` in the working directory.
        map_dir: folder of triangulated maps: the points of the session's map are shown; of a query session, the
            points of the map that `queries_pose` is named after.
        queries: keyframe list.
        image_size: longer side of the images shown, pixels; depth maps have half of it.
        quality: of JPEG, 1 to 100.
        world_up: direction (3,) that is up; None: estimated from the cameras.
        workers: threads that read and shrink; None: the cores at hand.
        progress: show a bar.

    Raises:
        CaptureError: unknown session, subsession or keyframe list.
        ArtifactError: `vis_retrieve_queries` without the csv of `queries_pose`, or for another session.
    """
    started = time.perf_counter()
    if every < 1:
        raise CaptureError(f"every={every}: expected 1 (every frame) or more.")
    capture = Capture.open(scene)
    session = capture[f"{device}_{split}"]
    path = Path(out) if out is not None else Path(f"{capture.name}_{session.id}.rrd")
    asked = None if queries_pose is None else _Queries.read(Path(queries_pose), capture, session, vis_retrieve_queries)
    if asked is None and vis_retrieve_queries:
        raise ArtifactError("vis_retrieve_queries shows what `queries_pose` was localized by; give that file too.")
    points_file = _points_file(session, asked, map_dir)
    settings = {
        "images": session.files_fingerprint, "subsession": subsession,
        "session": files_fingerprint([*sorted(session.path.glob("*.txt")), *sorted(session.path.glob("proc/*.txt"))]),
        "keyframes": queries if keyframes_only else "", "every": every, "image_size": image_size, "quality": quality,
        "queries_pose": "" if queries_pose is None else file_fingerprint(queries_pose),
        "retrieve": vis_retrieve_queries, "points": "" if points_file is None else file_fingerprint(points_file),
        "world_up": None if world_up is None else np.asarray(world_up, float).tolist(),
    }  # fmt: skip
    plan = _Plan.of(session, subsession, queries if keyframes_only else None, every, asked)
    finite = plan.all_poses[posed(plan.all_poses)]
    up = np.asarray(up_of_cameras(finite) if world_up is None else world_up, np.float64)
    without = []
    if map_dir is not None and points_file is None:
        without = [f"{map_dir}: holds no map for this recording, so no points are shown."]
    unposed = [] if len(finite) else [f"{session.id}: no frame has a pose; images are shown without a place."]
    messages = [*unposed, *without]
    counts: dict[str, int] = {"frames": len(plan.frames), "images": 0, "unreadable": 0, "unposed": 0, "depth_maps": 0}
    with open_recording(path, f"{capture.name}_{session.id}", _session_layout(plan, finite, up)) as stream:
        stream.log("world", world_axes(up), static=True)
        if points_file is not None:
            points, colors = sure_points(LocalMap.load(points_file))
            log_points(stream, points, colors)
            counts["points"] = len(points)
        _log_trajectories(stream, plan, session.device)
        if asked is not None:
            counts["queries"] = _log_asked(stream, asked, session)
        size = camera_depth_m(finite[:, :3, 3])
        writer = _FrameWriter(stream, session, size, color_of(session.device))
        writer.announce(plan.frames)

        def load(number: int) -> list["_Loaded"]:
            return [_load(session, shot, image_size, quality) for shot in plan.shots(number)]

        loaded = prefetch(load, range(len(plan.frames)), workers or default_workers())
        for number, shots in enumerate(
            tqdm(loaded, total=len(plan.frames), desc=session.id, unit="frame", disable=not progress)
        ):
            for name, value in writer.write(plan.frames[number], shots).items():
                counts[name] += value
        writer.finish()
    if counts["unreadable"]:
        messages.append(f"{session.id}: {counts['unreadable']} images or depth maps cannot be read.")
    seconds, size_bytes = round(time.perf_counter() - started, 2), path.stat().st_size
    holds = {**counts, "seconds": seconds, "bytes": size_bytes, "messages": messages}
    write_sidecar(path, settings)
    recording = SessionRecording(path, **holds)  # type: ignore[arg-type]
    logger.info("%s: %d frames, %d images in %.0f s, %.1f MB", path, recording.frames, recording.images, seconds,
                size_bytes / 1e6)  # fmt: skip
    if spawn:
        spawn_viewer(path)
    return recording


@dataclass(frozen=True)
class _Shot:
    """A picture or depth map of a frame: what to read, and where it goes."""

    slot: str
    """Name of its camera in the recording, the same from frame to frame."""
    sensor_id: str
    rig_from_sensor: Array | None
    """(4, 4); None for a camera without a rig."""
    path: Path
    is_depth: bool = False


@dataclass(frozen=True)
class _Loaded:
    """A shot, read and made small."""

    shot: _Shot
    data: bytes
    """JPEG, or 16-bit PNG of millimeters; empty where a depth map cannot be read."""
    size: tuple[int, int]
    """Width and height shown."""
    readable: bool


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
    world_from_device: Array
    """(4, 4), NaN without a pose."""
    rows: NDArray[np.int64]
    """Of the session's images."""
    slots: tuple[str, ...]


@dataclass
class _Plan:
    """What is to be recorded of a session, without a picture read yet."""

    session: Session
    frames: list[_Frame]
    tracks: dict[str, list[Array]]
    """World positions (n, 3) along each device's way, of every subsession shown, thinned or not."""
    all_poses: Array
    """world_from_cam (n, 4, 4) of one camera a frame shown."""
    depths: dict[tuple[int, str], list[int]]
    """Rows of the session's depth maps by timestamp and device."""
    rig_from_depth: Array

    @classmethod
    def of(
        cls, session: Session, subsession: str, keyframes: str | None, every: int, asked: "_Queries | None"
    ) -> "_Plan":
        if subsession != "all" and subsession not in session.subsessions:
            raise CaptureError(
                f"Session {session.id} has no subsession {subsession!r}; known: {', '.join(session.subsessions)}, all."
            )
        table = _slots(session)
        if subsession != "all":
            table = table[table["subsession"] == subsession]
        trajectory = session.ground_truth if session.split == "query" else session.trajectory
        if asked is not None and session.split == "query":
            trajectory = asked.poses
        groups = table.groupby(["index", "device_slot"], sort=False)
        first = table.loc[groups.head(1).index]
        poses = np.full((len(first), 4, 4), np.nan)
        if trajectory is not None:
            poses = trajectory.lookup(first["timestamp"].to_numpy(), first["device_id"].to_numpy(str))
        tracks = _tracks(first, poses)
        shown = np.ones(len(first), bool)
        if keyframes is not None:
            wanted = set(session.keyframes(keyframes).itertuples(index=False, name=None))
            keys = zip(first["timestamp"], first["device_id"], strict=True)
            shown = np.array([key in wanted for key in keys], bool)
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
        return cls(session, frames, tracks, cameras, depths, rig_from_depth)

    def shots(self, number: int) -> list[_Shot]:
        """Return what is to be read for a frame."""
        frame, session = self.frames[number], self.session
        sensors = session.images["sensor_id"].iloc[frame.rows].tolist()
        in_rig = frame.device != ""
        poses = session.rig_from_cam(frame.rows)
        shots = [
            _Shot(slot, sensor, pose if in_rig else None, session.image_path(int(row)))
            for slot, sensor, pose, row in zip(frame.slots, sensors, poses, frame.rows, strict=True)
        ]
        slot_of = dict(zip(sensors, frame.slots, strict=True))
        for rank, row in enumerate(self.depths.get((frame.timestamp, frame.device_id), [])):
            sensor = str(session.depths["sensor_id"].iloc[row])  # type: ignore[index]
            path = session.depth_path(frame.timestamp, sensor)
            if path is not None:
                pose = self.rig_from_depth[row] if in_rig else None
                slot = f"{slot_of.get(sensor, rank)}_depth"
                shots.append(_Shot(slot, sensor, pose, path, is_depth=True))
        return shots


def session_tracks(session: Session) -> list[Array]:
    """Return the ways of a session's cameras, a list of world positions (n, 3), meters, a subsession and device.

    Of a rig its first camera's; of a map by the trajectory, of queries by the ground truth.
    """
    table = _slots(session)
    first = table.loc[table.groupby(["index", "device_slot"], sort=False).head(1).index]
    rows = first["row"].to_numpy()
    return [t for ts in _tracks(first, session.world_from_cam(rows, session.split == "query")).values() for t in ts]


def _tracks(frames: pd.DataFrame, poses: Array) -> dict[str, list[Array]]:
    """Return the positions of frames that have a pose, by subsession, a list a device."""
    tracks: dict[str, list[Array]] = {}
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
    subsessions = pd.Series(session.subsession_of(rows)).replace("", session.id)
    order = {name: rank for rank, name in enumerate(session.subsessions)}
    table = pd.DataFrame(
        {
            "row": rows,
            "subsession": subsessions,
            "timestamp": session.images["timestamp"].to_numpy(np.int64)[rows],
            "sensor_id": session.images["sensor_id"].to_numpy(str)[rows],
            "device_id": session.device_ids[rows].astype(str),
        }
    )
    table["rank"] = table["subsession"].map(order).fillna(len(order))
    table = table.sort_values(["rank", "subsession", "timestamp", "device_id", "sensor_id"], kind="stable")
    table = table.reset_index(drop=True)
    instant = ["subsession", "timestamp"]
    table["index"] = table.groupby(instant, sort=False).ngroup()
    in_rig = (table["device_id"] != table["sensor_id"]).to_numpy(bool)
    devices = table.drop_duplicates([*instant, "device_id"]).copy()
    devices["name"] = _names(devices, "device_id", instant, "rig")
    of_device = table.merge(devices[[*instant, "device_id", "name"]], on=[*instant, "device_id"], how="left")
    table["device_slot"] = np.where(in_rig, of_device["name"], "")
    table["slot"] = _names(table, "sensor_id", [*instant, "device_slot"], "camera")
    return table


def _names(table: pd.DataFrame, column: str, frame: list[str], kind: str) -> pd.Series:
    """Return a name for each row's id, without the subsession; by rank in its `frame` where ids are made anew."""
    instants = table.groupby("subsession")["timestamp"].transform("nunique")
    anew = (table.groupby(["subsession", column])["timestamp"].transform("nunique") == 1) & (instants > 1)
    ranks = table[anew].groupby(frame).cumcount()
    names = pd.Series(
        [name.removeprefix(f"{sub}/") for name, sub in zip(table[column], table["subsession"], strict=True)],
        index=table.index,
        dtype=object,
    )
    names[anew] = [f"{kind}_{rank}" for rank in ranks]
    return names


def _load(session: Session, shot: _Shot, image_size: int, quality: int) -> _Loaded:
    """Read a picture or depth map and make it small; in a thread."""
    if shot.is_depth:
        depth = cv2.imread(str(shot.path), cv2.IMREAD_UNCHANGED)
        if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
            return _Loaded(shot, b"", (0, 0), False)
        scale = min(1.0, image_size / 2 / max(depth.shape))
        width, height = (max(1, round(scale * side)) for side in depth.shape[::-1])
        # Nearest: means across edges would hang in the air.
        small = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
        return _Loaded(shot, cv2.imencode(".png", small)[1].tobytes(), (width, height), True)
    try:
        image, readable = read_image(shot.path), True
    except ImageError:
        camera = session.camera(shot.sensor_id)
        blank = read_for_display(shot.path)
        image, readable = np.asarray(cv2.resize(blank, (camera.width, camera.height)), np.uint8), False
    data, size = small_jpeg(image, image_size, quality)
    return _Loaded(shot, data, size, readable)


class _FrameWriter:
    """Logs frames in order; what has not changed since the last frame is not logged again."""

    def __init__(self, stream: "rr.RecordingStream", session: Session, size: float, color: str) -> None:
        self._stream, self._session, self._size, self._color = stream, session, size, color
        self._last: dict[str, tuple[float, ...]] = {}
        """Numbers last logged, by entity and kind."""
        self._alive: dict[tuple[str, str], dict[str, _Loaded]] = {}
        """Entities of cameras that show something, and what, by subsession and device."""
        self._now: _Frame | None = None

    def write(self, frame: _Frame, shots: list[_Loaded]) -> dict[str, int]:
        """Log a frame; return how many of what it held."""
        import rerun as rr

        if self._now is not None and self._now.subsession != frame.subsession:
            self.finish()
        self._now = frame
        self._set_time(frame.index, frame.timestamp)
        known = bool(np.isfinite(frame.world_from_device).all())
        parts = ["world" if known else "unposed", frame.subsession, *([frame.device] if frame.device else [])]
        root = entity(*parts)
        shown: dict[str, _Loaded] = {}
        # A camera without a rig carries its pose itself.
        if known and frame.device:
            self._stream.log(root, transform_of(frame.world_from_device))
        counts = {"images": 0, "unreadable": 0, "unposed": 0, "depth_maps": 0}
        for loaded in shots:
            shot = loaded.shot
            path = f"{root}/{entity(shot.slot)}"
            if shot.is_depth and not loaded.readable:
                counts["unreadable"] += 1
                continue
            shown[path] = loaded
            if known and not frame.device:
                self._stream.log(path, transform_of(frame.world_from_device))
            elif known and shot.rig_from_sensor is not None:
                self._log_changed(path, "pose", shot.rig_from_sensor, lambda s=shot: transform_of(s.rig_from_sensor))
            self._log_intrinsics(path, loaded)
            if shot.is_depth:
                depth = rr.EncodedDepthImage(loaded.data, media_type="image/png", meter=DEPTH_SCALE)
                self._stream.log(f"{path}/depth", depth)
                counts["depth_maps"] += 1
                continue
            self._stream.log(f"{path}/image", jpeg_of(loaded.data))
            counts["images"] += 1
            counts["unreadable"] += not loaded.readable
            counts["unposed"] += not known
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
            if np.isfinite(frame.world_from_device).all():
                parts = ["world", frame.subsession, *([frame.device] if frame.device else [])]
                for slot in frame.slots:
                    begin.setdefault(entity(*parts, slot), frame.index)
        for path in [path for path, index in begin.items() if index > frames[0].index]:
            self._stream.log(path, rr.Pinhole(focal_length=1, width=1, height=1, image_plane_distance=HIDDEN_M))

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

    def _hide(self, cameras: dict[str, _Loaded]) -> None:
        for path, last in cameras.items():
            camera = self._session.camera(last.shot.sensor_id)
            self._stream.log(path, pinhole_of(camera, last.size, HIDDEN_M, self._color))
            self._last.pop(f"{path}|pinhole", None)

    def _log_changed(self, path: str, kind: str, numbers: ArrayLike, make: Any) -> None:
        values = tuple(np.ravel(numbers).tolist())
        if self._last.get(f"{path}|{kind}") != values:
            self._stream.log(path, make())
            self._last[f"{path}|{kind}"] = values

    def _log_intrinsics(self, path: str, loaded: _Loaded) -> None:
        camera = self._session.camera(loaded.shot.sensor_id)
        numbers = [*shown_intrinsics(camera, loaded.size).ravel(), *loaded.size]
        self._log_changed(path, "pinhole", numbers, lambda: pinhole_of(camera, loaded.size, self._size, self._color))


def _session_layout(plan: _Plan, poses: Array, up: Array) -> Any:
    """Return the viewer's layout: the scene, and beside it the cameras of each subsession."""
    import rerun.blueprint as rrb

    tabs: dict[str, dict[str, str]] = {}
    for frame in plan.frames:
        known = bool(np.isfinite(frame.world_from_device).all())
        parts = ["world" if known else "unposed", frame.subsession, *([frame.device] if frame.device else [])]
        for slot in frame.slots:
            tabs.setdefault(frame.subsession, {})[entity(*parts, slot)] = slot
    views = [
        rrb.Grid(*[rrb.Spatial2DView(origin=path, name=slot) for path, slot in cameras.items()], name=name)
        for name, cameras in list(tabs.items())[:MAX_TABS]
    ]
    scene = scene_view(poses, up, plan.session.id)
    panel = rrb.TimePanel(state="collapsed", timeline=FRAME, play_state="paused")
    layout = rrb.Horizontal(scene, rrb.Tabs(*views), column_shares=[2, 1]) if views else rrb.Horizontal(scene)
    return rrb.Blueprint(layout, panel, collapse_panels=True)


def _log_trajectories(stream: "rr.RecordingStream", plan: _Plan, device: str) -> None:
    """Log the way of each device, a line a subsession: recordings joined would draw paths nobody went."""
    import rerun as rr

    color = rgb(color_of(device))
    for name, tracks in plan.tracks.items():
        lines = rr.LineStrips3D([track for track in tracks if len(track) > 1], colors=color)
        stream.log(f"world/{entity(name)}/trajectory", lines, static=True)


# Queries in a session's recording


@dataclass(frozen=True)
class _Queries:
    """Poses of queries from a trajectories file, and what they were localized by."""

    poses: Trajectory
    map_device: str
    """Of the pair that the file is named after; empty where its name says none."""
    query_device: str
    references: dict[tuple[int, str], list[str]]
    """Names of map images of a query; empty where they are not asked for."""
    centers: dict[str, Array]
    """World positions (3,) of the references."""

    @classmethod
    def read(cls, path: Path, capture: Capture, session: Session, with_references: bool) -> "_Queries":
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
        references: dict[tuple[int, str], list[str]] = {}
        centers: dict[str, Array] = {}
        if with_references:
            table = path.with_suffix(".csv")
            if not named or not table.is_file():
                raise ArtifactError(
                    f"{path}: which references a query was localized by stands in the table beside it, "
                    f"{prefix}<M>_query_<Q>.csv; not found. Localize again, or leave vis_retrieve_queries out."
                )
            rows = read_query_table(table, ["references"])
            for row in rows.itertuples():
                if isinstance(row.references, str) and row.references:
                    references[int(row.timestamp), str(row.device_id)] = row.references.split(";")
            map_session = capture[f"{map_device}_map"]
            wanted = {name for names in references.values() for name in names}
            images = [k for k in range(len(map_session)) if map_session.image_name(k) in wanted]
            found = map_session.world_from_cam(np.array(images, np.int64))
            centers = {map_session.image_name(k): pose[:3, 3] for k, pose in zip(images, found, strict=True)}
        return cls(poses, map_device, query_device, references, centers)


def _points_file(session: Session, asked: _Queries | None, map_dir: str | Path | None) -> Path | None:
    """Return the map file whose points belong into a session's recording, None if there is none."""
    device = session.device if session.split == "map" else (asked.map_device if asked is not None else "")
    path = None if map_dir is None or not device else Path(map_dir) / f"{device}_map.npz"
    return path if path is not None and path.is_file() else None


def _log_asked(stream: "rr.RecordingStream", asked: _Queries, session: Session) -> int:
    """Log where queries are, joined with their references; return how many. In a query session, lines only."""
    import rerun as rr

    poses = asked.poses.world_from_device
    keys = list(zip(asked.poses.timestamps.tolist(), asked.poses.device_ids.tolist(), strict=True))
    kept = np.flatnonzero(posed(poses))
    if session.split == "map":
        color = rgb(color_of(asked.query_device))
        labels = [f"{time} {device}" for time, device in (keys[k] for k in kept)]
        dots = rr.Points3D(poses[kept, :3, 3], colors=color, radii=rr.Radius.ui_points(4), labels=labels,
                           show_labels=False)  # fmt: skip
        stream.log("world/queries/poses", dots, static=True)
    lines = [
        np.stack([poses[k, :3, 3], asked.centers[name]])
        for k in kept
        for name in asked.references.get(keys[k], [])
        if name in asked.centers
    ]
    if lines:
        stream.log("world/queries/references", rr.LineStrips3D(lines, colors=rgb(ORANGE)), static=True)
    return len(kept)
