"""The devices of the rendered capture, a phone, a headset and a robot: their cameras and trajectories, and what they
record between their images: odometry with drift, losses and gaps, and radio scans."""

import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from toolkit.geometry import Floats, Ints, invert, make_pose, quaternion_to_rotation, rotation_angle_deg
from toolkit.synthetic.scene import Scene, named_rng
from toolkit.synthetic.textures import Rng


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


RATE_HZ = 5.0  # of odometry
PICTURE_S = 1.4  # between two images of a recording without a given length
GAP_S = 4.0  # length of a gap in odometry


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


WIFI_S, BLUETOOTH_S = 4.0, 1.0  # between two scans
SCAN_US = 600_000  # duration of a WiFi scan
PATH_LOSS, WALL_DB, FADING_DB, MIN_DBM = 2.5, 6.9, 3.0, -92.0
"""Path-loss exponent (log-distance model: T. S. Rappaport, Wireless Communications, 2002), loss per wall (COST 231
multi-wall model), standard deviation of a reading, and the level below which nothing is received."""
RADIOS = {"ios": ("bt",), "hl": ("wifi", "bt"), "spot": ("wifi", "bt")}  # iOS does not let an app scan WiFi


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
