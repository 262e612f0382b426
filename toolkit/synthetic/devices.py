"""The devices of the rendered capture, a phone, a headset and a robot: their cameras and trajectories."""

from dataclasses import dataclass

import numpy as np

from toolkit.geometry import Floats, invert, make_pose, rotation_angle_deg
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
