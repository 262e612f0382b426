"""A device that drives through the world, its odometry, and poses of single queries, with the truth."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.manifest import SequenceSettings
from toolkit.sequences.odometry import MIN_STD_DEG, MIN_STD_M, Odometry, PosedQueries

PLACE = geometry.make_pose(Rotation.from_rotvec([0.0, 0.0, 2.3]).as_matrix(), [100.0, -20.0, 3.0])
"""world_from_odom."""


@dataclass(frozen=True)
class Drive:
    world_from_rig: Floats
    odometry: Odometry
    queries: PosedQueries
    is_wrong: NDArray[np.bool_]


def drive(
    rng: np.random.Generator,
    frames: int = 40,
    every: int = 2,
    wrong: float = 0.0,
    noise: float = 1.0,
    drift: float = 1.0,
) -> Drive:
    """Drive along an arc, a frame a second; noise and drift are in units of what the default settings expect."""
    settings = SequenceSettings()
    heading = Rotation.from_rotvec(np.linspace([0, 0, 0], [0, 0, np.pi / 2], frames)).as_matrix()
    places = np.cumsum(heading @ [1.0, 0.0, 0.0], axis=0)
    moved = geometry.make_pose(heading, places)
    steps = geometry.invert(moved[:-1]) @ moved[1:]
    turn, shift = drift * np.deg2rad(settings.rotation_drift_deg), drift * settings.position_drift
    measured = [moved[0]]
    for step in steps:
        measured.append(measured[-1] @ step @ small_motion(rng, turn, shift))
    times = (np.arange(frames) * 1_000_000).astype(np.int64)
    world_from_rig = PLACE @ moved
    asked = np.arange(0, frames, every)
    stds = np.deg2rad(0.3), 0.05
    poses = np.stack([world_from_rig[frame] @ small_motion(rng, *(noise * std for std in stds)) for frame in asked])
    is_wrong = np.zeros(len(asked), bool)
    is_wrong[rng.permutation(len(asked))[: round(wrong * len(asked))]] = True
    for number in np.flatnonzero(is_wrong):
        poses[number] = geometry.make_pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-100, 100, 3))
    least = np.deg2rad(MIN_STD_DEG), MIN_STD_M  # which is added
    covariance = np.diag(np.repeat(np.square(stds) - np.square(least), 3))
    queries = PosedQueries(
        asked, poses, np.tile(covariance, (len(asked), 1, 1)), np.full(len(asked), 0.9), np.ones(len(asked), bool)
    )
    return Drive(world_from_rig, Odometry(times, np.stack(measured)), queries, is_wrong)


def lost_in_a_gap(way: Drive, at: int = 21, frames: int = 3) -> Drive:
    """Return a drive without some frames, and with another frame of odometry after them."""
    kept = np.delete(np.arange(len(way.odometry)), np.arange(at, at + frames))
    elsewhere = geometry.make_pose(Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix(), [1.0, -2.0, 0.0])
    poses = way.odometry.odom_from_rig.copy()
    poses[at:] = elsewhere @ geometry.invert(poses[at]) @ poses[at:]
    own = np.isin(way.queries.frames, kept)
    queries = replace(way.queries.choose(own), frames=np.searchsorted(kept, way.queries.frames[own]))
    odometry = Odometry(way.odometry.timestamps[kept], poses[kept])
    return Drive(way.world_from_rig[kept], odometry, queries, way.is_wrong[own])


def small_motion(rng: np.random.Generator, turn: float, shift: float) -> Floats:
    """Return a random motion with standard deviations by axis, radians and meters."""
    return geometry.make_pose(Rotation.from_rotvec(turn * rng.normal(size=3)).as_matrix(), shift * rng.normal(size=3))
