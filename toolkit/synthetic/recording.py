"""What a device records between its pictures: its own motion, which it loses at times, and radio signals."""

import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from toolkit.geometry import Floats, Ints, invert, make_pose, quaternion_to_rotation
from toolkit.synthetic.scene import Scene, named_rng
from toolkit.synthetic.textures import Rng

RATE_HZ = 5.0
PICTURE_S = 1.4
"""Between two pictures, where a recording is no longer than they take."""
GAP_S = 4.0


def every_frame(times: Ints, world_from_rig: Floats, start: int, seconds: float) -> tuple[Ints, Floats]:
    """Return times (N,), microseconds, and poses (N, 4, 4) of a recording of so many seconds, `RATE_HZ` a second.

    Args:
        times, world_from_rig: those of its pictures, (M >= 2,) and (M, 4, 4), which are among them. The way between
            two is straight; before the first and after the last the device stands still.
        start: of the recording, microseconds.
    """
    period = round(1e6 / RATE_HZ)
    grid = np.arange(start, start + round(seconds * 1e6), period)
    grid = grid[np.abs(grid[:, None] - times).min(axis=1) > period / 2]
    every = np.union1d(grid, times)
    at = np.clip(every, times[0], times[-1])
    turns = Slerp(times, Rotation.from_matrix(world_from_rig[:, :3, :3]))(at).as_matrix()
    poses = make_pose(turns, _places(at, times, world_from_rig))
    poses[np.searchsorted(every, times)] = world_from_rig
    return every, poses


def _places(at: Ints, times: Ints, poses: Floats) -> Floats:
    return np.stack([np.interp(at, times, poses[:, axis, 3]) for axis in range(3)], axis=-1)


def odometry_of(rng: Rng, world_from_rig: Floats, drift: float, parts: float = 1.0) -> Floats:
    """Return odom_from_rig (N, 4, 4): the motion of a recording as its device measures it, in a frame of its own.

    The frame is upright up to 0.3 degrees. At `drift` 1 all lengths are wrong by 1 %, each step by another 1 %, and by
    0.1 degrees (standard deviations; those of the step and the rotation by axis).

    Args:
        parts: so many poses make one such step.
    """

    def turned(degrees: Floats) -> Floats:
        angle = max(float(np.linalg.norm(degrees)), 1e-12)
        half = np.radians(angle) / 2
        return quaternion_to_rotation([np.cos(half), *(np.sin(half) * degrees / angle)])

    heading = np.array([0.0, 0.0, rng.uniform(-180, 180)])
    odom_from_world = make_pose(turned(rng.normal(0, 0.3, 3) * [1, 1, 0]) @ turned(heading), rng.uniform(-5, 5, 3))
    scale = 1 + 0.01 * drift * rng.normal()
    poses = [odom_from_world @ make_pose(np.eye(3), -world_from_rig[0, :3, 3]) @ world_from_rig[0]]
    for step in invert(world_from_rig[:-1]) @ world_from_rig[1:]:
        # A random walk: its variance grows with the way and the time, in however many parts.
        length = float(np.linalg.norm(step[:3, 3])) * np.sqrt(parts)
        moved = scale * step[:3, 3] + 0.01 * drift * length * rng.normal(size=3)
        turn = 0.1 * drift * rng.normal(size=3) / np.sqrt(parts)
        poses.append(poses[-1] @ make_pose(step[:3, :3] @ turned(turn), moved))
    return np.stack(poses)


def tracked(
    rng: Rng, times: Ints, world_from_rig: Floats, drift: float, parts: float, losses: int, gaps: int
) -> tuple[NDArray[np.bool_], Floats]:
    """Return which frames of a recording have odometry, (N,), and odom_from_rig (N, 4, 4), see `odometry_of`.

    Args:
        times, world_from_rig: those of all frames, (N,) microseconds and (N, 4, 4).
        losses: how often tracking is lost; from there on the frame and the scale are others.
        gaps: how often nothing is measured for `GAP_S`; the frame stays.
    """
    count = losses + gaps
    is_loss = rng.permutation(np.arange(count) < losses)
    # One in the middle of each share of the recording: a piece is never too short to be anything.
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
    place: Floats
    """(3,) in the world, meters."""
    dbm: float
    """What is received at 1 m."""
    frequency_khz: int = 0
    """Of WiFi."""


WIFI_S, BLUETOOTH_S = 4.0, 1.0
"""Between two scans."""
SCAN_US = 600_000
"""That a scan of WiFi takes."""
PATH_LOSS, WALL_DB, FADING_DB, FAINTEST_DBM = 2.5, 6.9, 3.0, -92.0
"""Exponent of the loss with distance (log-distance model: T. S. Rappaport, Wireless Communications, 2002), loss in a
wall (COST 231 multi-wall model), standard deviation of a reading, and what is no longer received."""
RADIOS = {"ios": ("bt",), "hl": ("wifi", "bt"), "spot": ("wifi", "bt")}
"""The system of the phone tells an app nothing about WiFi."""


def emitters_of(seed: int, rooms: Sequence[Scene], kind: str) -> list[Emitter]:
    """Return the access points (`wifi`) or beacons (`bt`) of rooms: of two or four a room, the last stands outside."""
    guid = uuid.UUID(bytes=named_rng(seed, "beacons").bytes(16), version=4)
    count, found = {"wifi": 2, "bt": 4}[kind], list[Emitter]()
    for index, room in enumerate(rooms):
        rng, (w, d, h) = named_rng(seed, index, kind), room.size
        for number in range(count):
            place = np.array([*(rng.uniform(-0.45, 0.45, 2) * [w, d]), rng.uniform(0.7, 1.0) * h])
            if number == count - 1:
                angle, away = rng.uniform(0, 2 * np.pi), np.hypot(w, d) / 2 + rng.uniform(0.5, 3)
                place = np.array([away * np.cos(angle), away * np.sin(angle), 2.5])
            place += room.origin
            if kind == "wifi":
                mhz = int(rng.choice([2412, 2437, 5180, 5260]))
                found.append(Emitter("02:" + rng.bytes(5).hex(":"), place, -40.0, mhz * 1000))
            else:
                found.append(Emitter(f"{guid}:{index}:{number}", place, -59.0))
    return found


def received(rng: Rng, emitters: Sequence[Emitter], places: Floats, rooms: Sequence[Scene]) -> Floats:
    """Return what is received of E emitters in N places (N, 3): (N, E) dBm, whole numbers; NaN is too faint."""
    sources = np.stack([emitter.place for emitter in emitters])
    ways = sources - places[:, None]
    distance = np.maximum(np.linalg.norm(ways, axis=-1), 0.5)
    dbm = np.array([emitter.dbm for emitter in emitters]) - 10 * PATH_LOSS * np.log10(distance)
    for room in rooms:
        half = np.array(room.size[:2]) / 2
        start = (places[:, :2] - room.origin[:2])[:, None]
        inverse = 1 / np.where(np.abs(ways[..., :2]) < 1e-9, 1e-9, ways[..., :2])
        enter = (-start * inverse - np.abs(half * inverse)).max(axis=-1)
        leave = (-start * inverse + np.abs(half * inverse)).min(axis=-1)
        for cut in (enter, leave):
            dbm -= WALL_DB * ((enter < leave) & (cut > 0) & (cut < 1))
    dbm = np.round(dbm + FADING_DB * rng.normal(size=dbm.shape))
    return np.where(dbm > FAINTEST_DBM, dbm, np.nan)


def scans(
    rng: Rng, times: Ints, poses: Floats, emitters: Sequence[Emitter], rooms: Sequence[Scene], sensor_id: str
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows that a recording adds to wifi.txt or bt.txt, whichever its emitters are.

    Args:
        times, poses: of the recording, (N,) microseconds and (N, 4, 4); the way between two is straight.
    """
    wifi = bool(emitters[0].frequency_khz)
    every = round(1e6 * (WIFI_S if wifi else BLUETOOTH_S))
    at = np.arange(times[0] + rng.integers(every), times[-1] + 1, every)
    dbm = received(rng, emitters, _places(at, times, poses), rooms)
    for scan, number in np.argwhere(np.isfinite(dbm)).tolist():
        time, emitter, level = int(at[scan]), emitters[number], float(dbm[scan, number])
        if wifi:
            yield time, sensor_id, emitter.id, emitter.frequency_khz, level, "campus", time - SCAN_US, time
        else:
            yield time, sensor_id, emitter.id, level, "beacon"
