"""Render a synthetic capture: textured rooms seen by a phone, a headset and a robot, with exact ground truth.

The devices have cameras and trajectories, and record between their images odometry with drift, losses and gaps, and
radio scans. Poses, intrinsics and depths are exact. The world frame has z up and is in meters; the rooms are far apart.
Each random generator is seeded by the seed and the name of the thing it draws, not by the order of work, so the bytes
do not depend on the number of cores.
"""

import json
import shutil
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from toolkit.errors import CaptureError
from toolkit.files import read_json, write_folder
from toolkit.geometry import Floats, Ints, invert, make_pose, pose_from_qt, quaternion_to_rotation, rotation_angle_deg
from toolkit.manifest import DemoData
from toolkit.synthetic.render import Quad, Rays, Scene, build_room, named_rng, paint, render
from toolkit.synthetic.textures import Image, Rng
from toolkit.threads import release_memory

if TYPE_CHECKING:
    import pandas as pd
    import pycolmap

    from toolkit.capture import Trajectory

RATE_HZ = 5.0  # of odometry
IMAGE_PERIOD_S = 1.4  # between two images of a recording without a given length
GAP_S = 4.0  # length of a gap in odometry
WIFI_S, BLUETOOTH_S = 4.0, 1.0  # between two scans
SCAN_US = 600_000  # duration of a WiFi scan
PATH_LOSS, WALL_DB, FADING_DB, MIN_DBM = 2.5, 6.9, 3.0, -92.0
"""Path-loss exponent (log-distance model: T. S. Rappaport, Wireless Communications, 2002), loss per wall (COST 231
multi-wall model), standard deviation of a reading, and the level below which nothing is received."""
RADIOS = {"ios": ("bt",), "hl": ("wifi", "bt"), "spot": ("wifi", "bt")}  # iOS does not let an app scan WiFi
FORMAT = 4  # increase it when the same settings produce other bytes
WRONG_FOCAL = 1.12  # clearly wrong, and still localizable


# Devices


@dataclass(frozen=True)
class Sensor:
    """One camera of a device, with its position (meters) and angles in the body frame (x forward, y left, z up)."""

    name: str
    model: str
    size: tuple[int, int]
    params: tuple[float, ...]
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def body_from_cam(self) -> Floats:
        """The camera's pose (4, 4) in the body frame."""
        return make_pose(looking(self.yaw_deg, self.pitch_deg, self.roll_deg), self.at)


@dataclass(frozen=True)
class Device:
    """Cameras, motion and image properties of one kind of device."""

    sensors: tuple[Sensor, ...]
    height_m: float
    sway_deg: float  # amplitude of the rotation by hand or gait
    gray: bool
    brightness: float  # target mean of the exposure control, gray levels
    gamma: float
    tint: tuple[float, float, float]  # BGR
    vignette: float
    noise: float  # standard deviation, gray levels
    quality: int  # JPEG
    rig_from_body: tuple[float, ...] | None = None  # qw qx qy qz tx ty tz; None: a single camera without a rig
    drift: float = 1.0  # of the odometry, see `odometry_of`


DEVICES = {
    "ios": Device(
        (Sensor("cam_phone", "PINHOLE", (960, 720), (735.0, 735.0, 481.8, 357.9)),),
        1.5, 4.0, False, 122.0, 0.95, (0.92, 1.0, 1.06), 0.12, 2.0, 93,
    ),
    "hl": Device(
        (
            Sensor("hetlf", "SIMPLE_RADIAL", (480, 640), (402.0, 243.1, 316.4, -0.021),
                   (0.02, 0.052, 0.0), 12.0),
            Sensor("hetrf", "SIMPLE_RADIAL", (480, 640), (405.0, 237.4, 322.9, -0.018),
                   (0.02, -0.05, 0.004), -12.0, 0.0, 90.0),
        ),
        1.65, 5.0, True, 98.0, 1.12, (1.0, 1.0, 1.0), 0.25, 3.5, 91,
        (0.36, 0.55, -0.42, 0.63, 0.08, -0.22, 0.31), 0.7,
    ),
    "spot": Device(
        (
            Sensor("frontleft", "OPENCV", (640, 480),
                   (432.0, 430.0, 318.7, 242.2, -0.062, 0.011, 0.0004, -0.0003),
                   (0.38, 0.07, 0.0), -9.0, 2.0),
            Sensor("frontright", "OPENCV", (640, 480),
                   (428.0, 427.0, 322.6, 237.3, -0.058, 0.009, -0.0002, 0.0004),
                   (0.38, -0.07, 0.0), 9.0, 2.0),
            Sensor("left", "OPENCV", (640, 480),
                   (436.0, 434.0, 315.9, 239.7, -0.065, 0.012, 0.0001, 0.0002),
                   (0.16, 0.15, 0.02), 78.0, 4.0),
        ),
        0.7, 1.5, True, 126.0, 0.86, (1.0, 1.0, 1.0), 0.2, 3.0, 90,
        (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 1.5,
    ),
}  # fmt: skip


def looking(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Floats:
    """Return the rotation level_from_cam (3, 3), z up: yaw to the left of x, pitch up, roll clockwise."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward], axis=-1)


BODY_FROM_LEVEL_CAM = make_pose(looking(0, 0, 0), (0, 0, 0))


def _walk(rng: Rng, scene: Scene, device: Device, radius: float, angles: Floats) -> Floats:
    """Return poses world_from_body (N, 4, 4) on an ellipse around the room's center, looking across the center.

    `angles` (N,) are the viewing directions, radians; `radius` is a fraction of the room's sides. The body sways by a
    sum of slow sine waves of the angle, so the walk is smooth for any number of frames.
    """

    def wave(amplitude: float) -> Floats:
        a, b = rng.uniform(0, 2 * np.pi, 2)
        return amplitude * (0.6 * np.sin(1.7 * angles + a) + 0.4 * np.sin(4.1 * angles + b))

    w, d, _ = scene.size
    across = np.stack([w * np.cos(angles), d * np.sin(angles)], -1)
    x, y = (scene.origin[:2] - (radius + wave(0.008)[:, None]) * across).T
    z = device.height_m + wave(0.05 * device.sway_deg / 4)
    yaw = np.degrees(np.arctan2(across[:, 1], across[:, 0])) + wave(7)
    pitch, roll = -3 + wave(device.sway_deg), wave(device.sway_deg)
    rotations = np.stack([looking(*turn) for turn in zip(yaw, pitch, roll, strict=True)])
    return make_pose(rotations, np.stack([x, y, z], -1)) @ invert(BODY_FROM_LEVEL_CAM)


def _turn(poses: Floats, degrees: Floats) -> Floats:
    """Rotate poses world_from_body about the vertical axes through their positions."""
    a = np.radians(degrees)
    spin = np.zeros((len(poses), 3, 3))
    spin[:, 0, 0] = spin[:, 1, 1] = np.cos(a)
    spin[:, 1, 0] = np.sin(a)
    spin[:, 0, 1] = -spin[:, 1, 0]
    spin[:, 2, 2] = 1
    return make_pose(spin @ poses[:, :3, :3], poses[:, :3, 3])


def walks(scene: Scene, seed: int, index: int, frames: int, name: str) -> dict[tuple[str, int], Floats]:
    """Return the poses world_from_body (N, 4, 4) of one device in one room, by split and subsession number.

    The two map walks follow an outer and an inner ring. The queries follow the ring between them, rotated by 10 to 25
    degrees from the nearest map pose. The viewing direction changes by at most 15 degrees between frames, so neighbors
    overlap even if there are few frames.
    """
    device, rng = DEVICES[name], named_rng(seed, index, "walk", name)
    start = named_rng(seed, index, "start").uniform(0, 2 * np.pi)
    span = np.radians(min(360, 15 * frames))
    poses: dict[tuple[str, int], Floats] = {}
    for split, total in (("map", frames), ("query", max(2, frames // 2))):
        phase = rng.uniform(0, 0.3)
        for part, count in enumerate((total - total // 2, total // 2)):
            share = (np.arange(count) + 0.5 * part + phase) / count
            margin = 0.0 if split == "map" else 0.1  # queries look only in directions covered by the map
            angles = start + span * (margin + (1 - 2 * margin) * share)
            radius = (0.32, 0.17)[part] if split == "map" else (0.235, 0.255)[part]
            poses[split, part] = _walk(rng, scene, device, radius, angles)
    mapped = np.concatenate([poses["map", 0], poses["map", 1]])
    for part in range(2):
        query = poses["query", part]
        nearest = np.argmin(np.linalg.norm(query[:, None, :3, 3] - mapped[None, :, :3, 3], axis=-1), axis=1)
        best, cost = np.zeros(len(query)), np.full(len(query), np.inf)
        for turn in np.arange(-30.0, 31.0, 1.0):
            turned = _turn(query, np.full(len(query), turn))
            angle = rotation_angle_deg(invert(mapped[nearest])[:, :3, :3] @ turned[:, :3, :3])
            # Prefer the smallest sufficient rotation, to the left on the first walk and to the right on the second.
            turn_cost = abs(turn) + 100 * ((angle < 11) | (angle > 24)) + 8 * ((turn > 0) == bool(part))
            best, cost = np.where(turn_cost < cost, turn, best), np.minimum(turn_cost, cost)
        poses["query", part] = _turn(query, best)
    return poses


def every_frame(times: Ints, world_from_rig: Floats, start: int, seconds: float) -> tuple[Ints, Floats]:
    """Interpolate the poses of a recording of a length at `RATE_HZ`, from those of its images, (M >= 2,) and (M, 4, 4).

    The path between two images is straight; before the first and after the last image the device stands still. Return
    times (N,), microseconds, and poses world_from_rig (N, 4, 4), including those of the images.
    """
    period = round(1e6 / RATE_HZ)
    grid = np.arange(start, start + round(seconds * 1e6), period)
    grid = grid[np.abs(grid[:, None] - times).min(axis=1) > period / 2]
    all_times = np.union1d(grid, times)
    at = np.clip(all_times, times[0], times[-1])
    rotations = Slerp(times, Rotation.from_matrix(world_from_rig[:, :3, :3]))(at).as_matrix()
    poses = make_pose(rotations, _positions(at, times, world_from_rig))
    poses[np.searchsorted(all_times, times)] = world_from_rig
    return all_times, poses


def _positions(at: Ints, times: Ints, poses: Floats) -> Floats:
    return np.stack([np.interp(at, times, poses[:, axis, 3]) for axis in range(3)], axis=-1)


def odometry_of(rng: Rng, world_from_rig: Floats, drift: float, parts: float = 1.0) -> Floats:
    """Simulate the odometry of a recording: odom_from_rig (N, 4, 4) in an arbitrary frame.

    The frame is upright to within 0.3 degrees. At `drift` 1, all lengths have a common error of 1 %, and each step has
    errors of another 1 % of its length and of 0.1 degrees (standard deviations; the errors of a step are per axis).
    Such a step is made up of `parts` poses.
    """

    def rotation(degrees: Floats) -> Floats:
        angle = max(float(np.linalg.norm(degrees)), 1e-12)
        half = np.radians(angle) / 2
        return quaternion_to_rotation([np.cos(half), *(np.sin(half) * degrees / angle)])

    heading = np.array([0.0, 0.0, rng.uniform(-180, 180)])
    odom_from_world = make_pose(rotation(rng.normal(0, 0.3, 3) * [1, 1, 0]) @ rotation(heading), rng.uniform(-5, 5, 3))
    scale = 1 + 0.01 * drift * rng.normal()
    poses = [odom_from_world @ make_pose(np.eye(3), -world_from_rig[0, :3, 3]) @ world_from_rig[0]]
    for step in invert(world_from_rig[:-1]) @ world_from_rig[1:]:
        # A random walk: the square roots make its variance independent of the number of parts per step.
        length = float(np.linalg.norm(step[:3, 3])) * np.sqrt(parts)
        moved = scale * step[:3, 3] + 0.01 * drift * length * rng.normal(size=3)
        turn = 0.1 * drift * rng.normal(size=3) / np.sqrt(parts)
        poses.append(poses[-1] @ make_pose(step[:3, :3] @ rotation(turn), moved))
    return np.stack(poses)


def tracked(
    rng: Rng, times: Ints, world_from_rig: Floats, drift: float, parts: float, losses: int, gaps: int
) -> tuple[NDArray[np.bool_], Floats]:
    """Simulate the odometry of a recording with interruptions, see `odometry_of`, at (N,) times and poses (N, 4, 4).

    After each loss of tracking, it continues in another frame and with another scale; a gap without odometry lasts
    `GAP_S`. Return which frames have odometry, (N,), and odom_from_rig (N, 4, 4).
    """
    count = losses + gaps
    is_loss = rng.permutation(np.arange(count) < losses)
    # Divide the recording evenly and interrupt it near the middle of each part, so that no piece is too short.
    at = ((np.arange(count) + rng.uniform(0.25, 0.75, count)) / max(count, 1) * len(times)).astype(int)
    ends = [0, *at[is_loss].tolist(), len(times)]
    pieces = [odometry_of(rng, world_from_rig[start:end], drift, parts) for start, end in pairwise(ends)]
    kept = np.ones(len(times), bool)
    for start in times[at[~is_loss]]:
        kept &= (times < start) | (times >= start + GAP_S * 1e6)
    return kept, np.concatenate(pieces)


@dataclass(frozen=True)
class Emitter:
    """A WiFi access point or a Bluetooth beacon."""

    id: str
    position: Floats  # (3,) in the world, meters
    dbm: float  # signal strength at 1 m
    frequency_khz: int = 0  # of WiFi; 0 for Bluetooth


def emitters_of(seed: int, rooms: Sequence[Scene], kind: str) -> list[Emitter]:
    """Return the two WiFi access points (`wifi`) or four beacons (`bt`) of each room, the last one outside of it."""
    guid = uuid.UUID(bytes=named_rng(seed, "beacons").bytes(16), version=4)
    count, emitters = {"wifi": 2, "bt": 4}[kind], list[Emitter]()
    for index, room in enumerate(rooms):
        rng, (w, d, h) = named_rng(seed, index, kind), room.size
        for number in range(count):
            position = np.array([*(rng.uniform(-0.45, 0.45, 2) * [w, d]), rng.uniform(0.7, 1.0) * h])
            if number == count - 1:
                angle, radius = rng.uniform(0, 2 * np.pi), np.hypot(w, d) / 2 + rng.uniform(0.5, 3)
                position = np.array([radius * np.cos(angle), radius * np.sin(angle), 2.5])
            position += room.origin
            if kind == "wifi":
                mhz = int(rng.choice([2412, 2437, 5180, 5260]))
                emitters.append(Emitter("02:" + rng.bytes(5).hex(":"), position, -40.0, mhz * 1000))
            else:
                emitters.append(Emitter(f"{guid}:{index}:{number}", position, -59.0))
    return emitters


def received(rng: Rng, emitters: Sequence[Emitter], positions: Floats, rooms: Sequence[Scene]) -> Floats:
    """Return the signal strengths (N, E) of E emitters at N positions (N, 3): integral dBm, NaN if too faint."""
    sources = np.stack([emitter.position for emitter in emitters])
    rays = sources - positions[:, None]
    distance = np.maximum(np.linalg.norm(rays, axis=-1), 0.5)
    dbm = np.array([emitter.dbm for emitter in emitters]) - 10 * PATH_LOSS * np.log10(distance)
    for room in rooms:
        half = np.array(room.size[:2]) / 2
        start = (positions[:, :2] - room.origin[:2])[:, None]
        inverse = 1 / np.where(np.abs(rays[..., :2]) < 1e-9, 1e-9, rays[..., :2])
        enter = (-start * inverse - np.abs(half * inverse)).max(axis=-1)
        leave = (-start * inverse + np.abs(half * inverse)).min(axis=-1)
        for wall in (enter, leave):
            dbm -= WALL_DB * ((enter < leave) & (wall > 0) & (wall < 1))
    dbm = np.round(dbm + FADING_DB * rng.normal(size=dbm.shape))
    return np.where(dbm > MIN_DBM, dbm, np.nan)


def scans(
    rng: Rng, times: Ints, poses: Floats, emitters: Sequence[Emitter], rooms: Sequence[Scene], sensor_id: str
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a recording in wifi.txt or bt.txt, depending on the kind of the emitters.

    Its frames have `times` (N,), microseconds, and poses (N, 4, 4); the path between two frames is straight.
    """
    wifi = bool(emitters[0].frequency_khz)
    period_us = round(1e6 * (WIFI_S if wifi else BLUETOOTH_S))
    at = np.arange(times[0] + rng.integers(period_us), times[-1] + 1, period_us)
    dbm = received(rng, emitters, _positions(at, times, poses), rooms)
    for scan, number in np.argwhere(np.isfinite(dbm)).tolist():
        time, emitter, level = int(at[scan]), emitters[number], float(dbm[scan, number])
        if wifi:
            yield time, sensor_id, emitter.id, emitter.frequency_khz, level, "campus", time - SCAN_US, time
        else:
            yield time, sensor_id, emitter.id, level, "beacon"


# The capture


class World(DemoData):
    """Settings of the rendered world."""

    @property
    def queries(self) -> int:
        """Query frames per room."""
        return max(2, self.frames // 2)

    @property
    def hours(self) -> int:
        """Whole hours that are long enough for one subsession."""
        return 1 + int(max(IMAGE_PERIOD_S * self.rooms * (self.frames + 8), self.seconds) / 3600)

    @property
    def stay_s(self) -> float:
        """Seconds spent in each room of a recording of length `seconds`; the walk to the next room takes half of it."""
        return self.seconds / (1.5 * self.rooms - 0.5)

    def look(self, index: int) -> int:
        """Return the index of the room whose appearance a room has."""
        return 0 if self.alike and index == self.rooms - 1 else index

    def build(self, index: int) -> Scene:
        """Return a room without textures."""
        return build_room(self.seed, index, self.look(index))


def _night(image: Image, rng: Rng) -> Image:
    """Underexpose an image, with the noise of a high gain."""
    return np.clip(0.05 * image + 4 * rng.standard_normal(image.shape) + 0.5, 0, 255).astype(np.uint8)


def shaken(image: Any, length: int, angle: float = 0.3) -> Any:
    """Blur an image along a line of `length` pixels, at an angle (radians) from the horizontal."""
    reach = 0.5 * (length - 1) * np.array([np.cos(angle), np.sin(angle)])
    middle, kernel = length // 2, np.zeros((length, length), np.float32)
    start, end = (np.round(middle + side * reach).astype(int).tolist() for side in (-1, 1))
    cv2.line(kernel, start, end, 1.0)
    return cv2.filter2D(image, -1, kernel / kernel.sum())


HARD: dict[str, Callable[[Image, Rng], Image] | None] = {
    "night": _night,
    "blurred": lambda image, _: shaken(image, 33),
    "two-places": None,
    "torn": None,
    "wrong-focal": None,
    "elsewhere": None,
}
"""Hard images of a phone: what each is called, and what is done to an image of the easy queries. `two-places`: the
right half shows another room, as a large screen would. `torn`: the end of the file is missing. `wrong-focal`: a camera
of its own, whose focal length is stated `WRONG_FOCAL` times too long. `elsewhere`: a room that is in no map."""


@dataclass
class Shot:
    """One image to render."""

    session: str
    timestamp: int
    sensor_id: str
    path: str  # relative to raw_data/
    depth_path: str | None
    camera: "pycolmap.Camera"
    world_from_cam: Floats
    device: Device


@dataclass
class Tables:
    """The rows of a session's text files."""

    sensors: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    rigs: list[tuple[int, str, str, Floats]] = field(default_factory=list)
    poses: list[tuple[int, str, Floats]] = field(default_factory=list)
    images: list[tuple[int, str, str]] = field(default_factory=list)
    depths: list[tuple[int, str, str]] = field(default_factory=list)
    subsessions: dict[str, int] = field(default_factory=dict)  # start time of each, microseconds

    def add_frame(
        self, name: str, device: Device, subsession: str, timestamp: int, zoom: float = 1.0
    ) -> tuple[str, Floats]:
        """Add the sensors of a frame; return the id of the camera or rig to be posed, and body_from_device (4, 4)."""
        if name == "ios":  # a phone refocuses for each image, so each image has its own intrinsics
            (sensor,) = device.sensors
            sensor_id, *_ = names_of(name, sensor, subsession, timestamp)
            params = [round(f * zoom, 3) for f in sensor.params[:2]] + list(sensor.params[2:])
            label = f"phone camera for timestamp {timestamp}"
            self.sensors[sensor_id] = (sensor_id, label, "camera", sensor.model, *sensor.size, *params)
            return sensor_id, sensor.body_from_cam
        rig_id = f"{subsession}/" + (f"hetrig_{timestamp}" if name == "hl" else f"{timestamp}-body")
        assert device.rig_from_body is not None
        rig_from_body = pose_from_qt(device.rig_from_body)
        for sensor in device.sensors:
            sensor_id, *_ = names_of(name, sensor, subsession, timestamp)
            label = sensor_id.removeprefix(f"{subsession}/")
            self.sensors[sensor_id] = (sensor_id, label, "camera", sensor.model, *sensor.size, *sensor.params)
            self.rigs.append((timestamp, rig_id, sensor_id, rig_from_body @ sensor.body_from_cam))
        return rig_id, invert(rig_from_body)

    def write(
        self, path: Path, trajectory: "Trajectory", odometry: "Trajectory | None", keyframes: "dict[str, pd.DataFrame]",
        **scans: Any,
    ) -> None:  # fmt: skip
        """Write a session: a map with its trajectory; or queries with odometry, `keyframes`, and it as ground truth."""
        from toolkit.capture import write_session

        is_map = path.name.endswith("_map")
        write_session(
            path, self.sensors.values(), [row[1:] for row in sorted(self.rigs, key=lambda row: row[:3])] or None,
            trajectory if is_map else odometry, sorted(self.images), depths=sorted(self.depths) or None,
            subsessions=[*self.subsessions], keyframes=None if is_map else keyframes,
            ground_truth=None if is_map else trajectory, **scans,
        )  # fmt: skip


def subsession_of(name: str, split: str, part: int, hours: int) -> tuple[str, int]:
    """Return a subsession's name and its start on the device's clock, microseconds."""
    offset_s = (2 * part + (split == "query")) * hours * 3600 + {"ios": 0, "hl": 600, "spot": 1200}[name]
    offset_us = offset_s * 10**6
    start_us = 1714557600 * 10**6 + offset_us  # 2024-05-01 10:00 UTC
    date = time.gmtime(start_us // 10**6)
    if name == "ios":
        return time.strftime("ios_%Y-%m-%d_%H.%M.%S_000", date), 630_000_000_000 + offset_us
    if name == "hl":
        return time.strftime("hl_%Y-%m-%d-%H-%M-%S-417", date), 93_000_000_000 + offset_us
    return time.strftime("spot_%Y-%m-%d-%H-%M", date), start_us


def names_of(name: str, sensor: Sensor, subsession: str, timestamp: int) -> tuple[str, str, str]:
    """Return a sensor's id, the folder of its images and the file stem of the image at a timestamp."""
    if name == "ios":
        return f"{subsession}/cam_phone_{timestamp}", "images/", str(timestamp)
    if name == "hl":
        return f"{subsession}/{sensor.name}", f"images/{sensor.name}/", str(timestamp)
    label = f"spot-camera-{sensor.name}-image"
    return f"{subsession}/{label}", f"{label}/", f"{timestamp}-{label}"


def _plan_room(world: World, scene: Scene, index: int, tables: dict[str, Tables]) -> Iterator[Shot]:
    """Add one room's frames to the tables of all sessions, and yield its images."""
    import pycolmap

    for name, device in DEVICES.items():
        for (split, part), bodies in walks(scene, world.seed, index, world.frames, name).items():
            session, table = f"{name}_{split}", tables[f"{name}_{split}"]
            subsession, start = subsession_of(name, split, part, world.hours)
            table.subsessions[subsession] = start
            rng = named_rng(world.seed, index, "frames", name, split, part)
            for i, world_from_body in enumerate(bodies):
                if world.seconds and split == "query":
                    offset_s = world.stay_s * (1.5 * index + (i + rng.uniform(0.2, 0.8)) / len(bodies))
                    timestamp = start + int(1e6 * offset_s)
                else:
                    offset_s = 5 + IMAGE_PERIOD_S * (index * (world.frames + 8) + i)
                    timestamp = start + int(1e6 * offset_s + rng.integers(0, 700_000))
                zoom = float(np.round(rng.normal(1, 0.004), 5))
                device_id, body_from_device = table.add_frame(name, device, subsession, timestamp, zoom)
                table.poses.append((timestamp, device_id, world_from_body @ body_from_device))
                for sensor in device.sensors:
                    sensor_id, folder, stem = names_of(name, sensor, subsession, timestamp)
                    _, _, _, model, width, height, *params = table.sensors[sensor_id]
                    camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
                    path = f"{subsession}/{folder}{stem}.jpg"
                    table.images.append((timestamp, sensor_id, path))
                    depth_path = None
                    if split == "map":
                        depth_path = f"{subsession}/depths/{folder.removeprefix('images/')}{stem}.png"
                        table.depths.append((timestamp, sensor_id, depth_path))
                    world_from_cam = world_from_body @ sensor.body_from_cam
                    yield Shot(session, timestamp, sensor_id, path, depth_path, camera, world_from_cam, device)


def _take(shot: Shot, quads: list[Quad], rays: Rays | None, sessions: Path, seed: int) -> None:
    """Render one image with its device's exposure, tint and noise, and its depth, into the session's raw_data."""
    device = shot.device
    rendered, depth = render(quads, shot.world_from_cam, rays or Rays.of(shot.camera), device.gray)
    h, w = depth.shape
    y, x = np.ogrid[0:h, 0:w]
    radius2 = ((x - w / 2) ** 2 + (y - h / 2) ** 2).astype(np.float32) / ((w / 2) ** 2 + (h / 2) ** 2)
    # Exposure compensates for the scene's brightness only in part, like a camera that must not flicker.
    gain = (device.brightness / max(float(rendered.mean()), 20.0)) ** 0.7
    rendered = np.clip(rendered * (gain / 255), 0, None) ** device.gamma * 255
    rendered *= (1 - device.vignette * radius2).reshape(h, w, *[1] * (rendered.ndim - 2))
    if not device.gray:
        rendered *= np.asarray(device.tint, np.float32)
    rng = named_rng(seed, "noise", shot.sensor_id, str(shot.timestamp))
    noise = device.noise * rng.standard_normal(rendered.shape, np.float32)
    image = np.clip(rendered + noise + 0.5, 0, 255).astype(np.uint8)
    raw = sessions / shot.session / "raw_data"
    save_image(raw / shot.path, image, [cv2.IMWRITE_JPEG_QUALITY, device.quality])
    if shot.depth_path is not None:
        millimeters = np.where(depth < 65.0, depth * 1000 + 0.5, 0).astype(np.uint16)
        save_image(raw / shot.depth_path, millimeters, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def save_image(path: Path, image: Image, options: list[int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, encoded = cv2.imencode(path.suffix, image, options)
    if not ok:
        raise CaptureError(f"{path}: cannot encode an image of shape {image.shape} and type {image.dtype}.")
    path.write_bytes(encoded.tobytes())


def _add_hard(sessions: Path, world: World, table: Tables, elsewhere: Scene) -> None:
    """Add a recording of hard images to the phone's query session.

    The phone walks through the first room again, there and back: its images are those of the easy queries, changed as
    `HARD` says, with their true poses. The last one is taken a few seconds later, in a painted room that is in no map.
    """
    import pycolmap

    device, raw = DEVICES["ios"], sessions / "ios_query" / "raw_data"
    subsession, start = subsession_of("ios", "query", 2, world.hours)
    table.subsessions[subsession] = start
    easy = [(table.sensors[row[1]], row[2], image[2]) for row, image in zip(table.poses, table.images, strict=True)]
    there = world.queries - world.queries // 2
    way = [*range(there), *reversed(range(there, world.queries))]
    for number, (name, worsen) in enumerate(HARD.items()):
        timestamp = start + round(1e6 * (IMAGE_PERIOD_S * (number + 1) + (6 if name == "elsewhere" else 0)))
        (_, _, *sensor), pose, source = easy[way[number % len(way)]]
        sensor_id = f"{subsession}/{'cam_wide' if name == 'wrong-focal' else 'cam_phone'}_{timestamp}"
        path = f"{subsession}/images/{timestamp}-{name}.jpg"
        if name == "elsewhere":
            pose = walks(elsewhere, world.seed, world.rooms, world.frames, "ios")["query", 0][-1]
            pose = pose @ device.sensors[0].body_from_cam
            _, model, width, height, *params = sensor
            camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
            shot = Shot("ios_query", timestamp, sensor_id, path, None, camera, pose, device)
            _take(shot, elsewhere.quads, None, sessions, world.seed)
        else:
            if name == "wrong-focal":
                sensor[4:6] = [round(WRONG_FOCAL * focal, 3) for focal in sensor[4:6]]
            image = cv2.imread(str(raw / source))
            assert image is not None
            if worsen is not None:
                image = worsen(image, named_rng(world.seed, "hard", name))
            if name == "two-places":
                half, other = image.shape[1] // 2, cv2.imread(str(raw / easy[-1][2]))
                assert other is not None
                image[:, half:] = other[:, half:]
            save_image(raw / path, image, [cv2.IMWRITE_JPEG_QUALITY, device.quality])
            if name == "torn":
                whole = (raw / path).read_bytes()
                (raw / path).write_bytes(whole[: len(whole) // 3])
        table.sensors[sensor_id] = (sensor_id, f"phone camera for {name}", *sensor)
        table.poses.append((timestamp, sensor_id, pose))
        table.images.append((timestamp, sensor_id, path))


def _poses_between(table: Tables, world: World, name: str) -> list[tuple[int, str, Floats]]:
    """Return the poses of all frames of recordings of length `world.seconds`. Only some frames have images."""
    poses = []
    for recording, start in table.subsessions.items():
        rows = sorted((row for row in table.poses if row[1].startswith(f"{recording}/")), key=lambda row: row[:2])
        device_ids = {time: device_id for time, device_id, _ in rows}
        times, image_poses = np.array([row[0] for row in rows]), np.stack([row[2] for row in rows])
        for time_us, pose in zip(*every_frame(times, image_poses, start, world.seconds), strict=True):
            if int(time_us) not in device_ids:
                device_ids[int(time_us)] = table.add_frame(name, DEVICES[name], recording, int(time_us))[0]
            poses.append((int(time_us), device_ids[int(time_us)], pose))
    return poses


def _write_session(path: Path, world: World, table: Tables, rooms: list[Scene]) -> None:
    """Write the text files of a session, rows ordered by time. Query sessions get odometry instead of true poses.

    Radio signals are scanned in all `rooms`, if any.
    """
    import pandas as pd

    from toolkit.capture import Trajectory

    name, _, split = path.name.rpartition("_")
    with_image = sorted(row[:2] for row in table.poses)
    long = world.seconds > 0 and split == "query"
    poses = sorted(_poses_between(table, world, name) if long else table.poses, key=lambda row: row[:2])
    times, ids = np.array([row[0] for row in poses], np.int64), [row[1] for row in poses]
    trajectory = Trajectory.from_poses(times, ids, np.stack([row[2] for row in poses]))
    measured = trajectory.world_from_device
    kept, scanned = np.ones(len(ids), bool), dict[str, list[tuple[Any, ...]]]()
    for recording in table.subsessions:
        rows = np.array([row for row, id_ in enumerate(ids) if id_.startswith(f"{recording}/")], int)
        if not len(rows):
            continue
        for kind in RADIOS[name] if rooms else ():
            sensor_id = f"{recording}/{kind}_sensor"
            table.sensors[sensor_id] = (sensor_id, f"{kind} sensor", {"bt": "bluetooth"}.get(kind, kind))
            rng, emitters = named_rng(world.seed, kind, recording), emitters_of(world.seed, rooms, kind)
            scanned.setdefault(kind, []).extend(scans(rng, times[rows], measured[rows], emitters, rooms, sensor_id))
        if split == "query":  # in a map session of few images, some pieces of odometry would contain no image
            rng, device = named_rng(world.seed, "odometry", recording), DEVICES[name]
            parts = IMAGE_PERIOD_S * RATE_HZ if long else 1.0
            kept[rows], measured[rows] = tracked(
                rng, times[rows], measured[rows], device.drift, parts, world.losses, world.gaps
            )
    odometry = Trajectory.from_poses(times[kept], np.array(ids, object)[kept].tolist(), measured[kept])
    frames = pd.DataFrame(with_image, columns=["timestamp", "device_id"])
    # Hard images are the last ones, and all of them are queries.
    hard = np.arange(len(frames)) >= len(frames) - len(HARD) * (world.hard and path.name == "ios_query")
    pruned = frames[(np.arange(len(frames)) % 6 != 5) | hard]
    subsampled = pruned[(np.arange(len(pruned)) % 3 != 1) | hard[pruned.index]]
    keyframes = {"original": frames, "pruned": pruned, "pruned_subsampled": subsampled}
    table.write(path, trajectory, odometry, keyframes, **{kind: sorted(rows) or None for kind, rows in scanned.items()})


def render_capture(
    out: str | Path, rooms: int = 2, frames: int = 12, seed: int = 0, progress: bool = True, **options: int
) -> Path:
    """Render a capture of `rooms` rooms by a phone, a headset and a robot; return its folder.

    Each device has a map and a query session of two subsessions; each subsession walks through all rooms. If the folder
    contains this capture already, nothing is done. Time grows with rooms * frames, memory does not.

    The name of `out` is the scene's name; `demo.json` in it records the settings `DemoData` of a manifest. The same
    seed gives the same bytes. A query recording of given length (`seconds`, at least 20 per room) has odometry at 5 Hz.
    Without, it has one image per 1.4 s, and odometry at the images only.

    Raise ManifestError for an invalid setting; CaptureError for those that exclude each other, or if `out` contains
    something other than a rendered capture.
    """
    world = World.of({"rooms": rooms, "frames": frames, "seed": seed, **options})
    seconds = world.seconds
    if seconds and (seconds < 20 * rooms or rooms * (frames // 4) < 2):
        expected = f"seconds >= {20 * rooms}, 20 per room, and frames >= 4, or 8 for a single room"
        raise CaptureError(f"Found {seconds=} for {rooms=} and {frames=}; expected {expected}.")
    if (world.losses or world.gaps) and not seconds:
        raise CaptureError("Losses and gaps concern the odometry between images, so set seconds too.")
    given = {name: int(value) for name, value in world.model_dump().items() if value or name == "seed"}
    return _render(Path(out), world, {"format": FORMAT} | given, progress)


def _render(out: Path, world: World, settings: dict[str, int], progress: bool) -> Path:
    """Render a capture into a temporary folder and move it to `out`, unless it is there already."""
    if _is_complete(out, settings):
        return out
    if added := sorted(_files(out) - _rendered(out)[1]):
        reason = f"which would delete {added[0]}: its demo.json does not list it"
        raise CaptureError(f"{out} has to be rendered anew, {reason}. Move it, delete the folder, or choose another.")
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)  # the renderer's pool already has one thread per core
        with write_folder(out) as folder:
            _render_sessions(folder, world, progress)
            record = {**settings, "files": sorted(_files(folder))}
            (folder / "demo.json").write_text(json.dumps(record, indent=1) + "\n")
            if out.exists() and not _is_complete(out, settings):
                shutil.rmtree(out)
    except OSError:
        if not _is_complete(out, settings):  # otherwise another process finished first
            raise
    finally:
        cv2.setNumThreads(threads)
        release_memory()
    return out


def _render_sessions(out: Path, world: World, progress: bool) -> None:
    """Render the images of all sessions, room by room, and write the sessions' files."""
    from tqdm.auto import tqdm

    from toolkit.capture.images import default_workers

    sessions = out / "sessions"
    tables = {f"{name}_{split}": Tables() for name in DEVICES for split in ("map", "query")}
    images = world.rooms * sum(len(d.sensors) for d in DEVICES.values()) * (world.frames + world.queries)
    images += len(HARD) * world.hard
    rays: dict[tuple[float, ...], Rays] = {}
    with (
        tqdm(total=images, desc="render", unit="image", disable=not progress) as bar,
        ThreadPoolExecutor(default_workers()) as pool,  # a thread may need 150 MB
    ):
        try:
            for index in range(world.rooms + world.hard):
                scene = world.build(index)
                paint_quad = partial(paint, scene, world.seed, world.look(index))
                for _ in pool.map(paint_quad, range(len(scene.quads))):
                    pass
                if index == world.rooms:
                    _add_hard(sessions, world, tables["ios_query"], scene)
                    bar.update(len(HARD))
                    break
                tasks = []
                for shot in _plan_room(world, scene, index, tables):
                    key = tuple(shot.camera.params)
                    if shot.device.rig_from_body is not None and key not in rays:
                        rays[key] = Rays.of(shot.camera)
                    tasks.append(pool.submit(_take, shot, scene.quads, rays.get(key), sessions, world.seed))
                for task in tasks:
                    task.result()
                    bar.update()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    rooms = [world.build(index) for index in range(world.rooms)] if world.radio else []
    for session, table in tables.items():
        _write_session(sessions / session, world, table, rooms)


def _is_complete(out: Path, settings: dict[str, int]) -> bool:
    """Return whether `out` contains the complete capture with these settings, and perhaps more."""
    written, files = _rendered(out)
    return written == settings and files <= _files(out)


def _rendered(out: Path) -> tuple[dict[str, Any], set[str]]:
    """Return settings and files of a rendered capture."""
    written = read_json(out / "demo.json")
    files = written.pop("files", None)
    return written, set(files) if isinstance(files, list) else set()


def _files(out: Path) -> set[str]:
    """Return the files of a capture except demo.json, and except those that macOS adds to every folder it shows."""
    paths = (path for path in out.rglob("*") if path.is_symlink() or path.is_file())
    return {path.relative_to(out).as_posix() for path in paths if path.name != ".DS_Store"} - {"demo.json"}
