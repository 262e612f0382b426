"""Estimate the up direction of a capture's world from the poses of its map images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from toolkit.capture.session import Session
from toolkit.errors import CaptureError
from toolkit.geometry import Floats, Ints
from toolkit.threads import fixed_sums

MAX_IMAGES = 2000  # images used per session
SIGMA_ROLL = 0.1  # radians; standard deviation of the roll from the nearest multiple of 90 degrees
SIGMA_PITCH, SIGMA_PULL = np.radians(40.0), np.radians(25.0)  # standard deviations of pitch: likelihood, refinement
ODD = 0.1  # share of images with another roll than most images of their sensor
# Shares of the quarter turns among the odd images of a sensor; one row for each quarter turn that most of its images
# need. The odd images of a phone that mostly lies on its side are more often upright.
ODD_PRIOR = np.array([[0.25] * 4, [0.4, 0.2, 0.2, 0.2], [0.25] * 4, [0.4, 0.2, 0.2, 0.2]])
OUTLIER = 0.005  # likelihood of an outlier, an image held in any other way
SENSOR_PRIOR = np.array([0.0, -1.0, -2.0, -1.0])  # log prior: most likely upright, least likely upside down
Z_BONUS, Z_NEAR = 1.5, np.radians(10.0)  # log, radians; prior that the world's z axis is vertical
WALK_BONUS = 2.0  # log; prior that cameras spread least along up, because people walk on the ground
NADIR = np.radians(25.0)  # largest angle to -z of views that look straight down
DECISIVE = 0.5  # log; smallest difference of the scores of up and down that decides between them


@dataclass(frozen=True, eq=False)
class WorldUp:
    """The up direction (3,) of a capture's world, unit length; whether its sign is `known`; how it was determined."""

    direction: Floats
    known: bool
    reason: str


@fixed_sums
def estimate_world_up(sessions: Sequence[Session]) -> WorldUp:
    """Estimate the up direction of a capture from the poses of its map sessions, which share one world.

    Cameras are held or mounted near a multiple of 90 degrees of roll, so one axis of each image is level for any pitch.
    Up is perpendicular to all level axes: the eigenvector with the smallest eigenvalue of the sum of their outer
    products, with less weight for tilted images (Huber 1981). Which axis is level is decided for each camera of a
    device; a share of its images may be held differently. If all cameras look the same way, many directions are
    perpendicular to their level axes. Weak priors then decide: cameras look near the horizon, are rather upright than
    rolled and move along the ground, and the world's z axis is vertical.

    Upright cameras distinguish up from down. If the cameras do not, up is +z if z is within 25 degrees of the axis (the
    convention of CroCoDL and LaMAR), else the sign is arbitrary; `known` is False in both cases. Cameras that all look
    along -z are taken for those of a drone; whether z is up, they cannot tell.

    Raises:
        CaptureError: no image has a pose.
    """
    axes, centers, groups = _posed_cameras(sessions)
    count = len(axes)
    if not count:
        names = ", ".join(session.id for session in sessions) or "none"
        fault = f"No image of the map sessions ({names}) has a pose, so the up direction cannot be estimated"
        raise CaptureError(f"{fault}: expected poses in trajectories.txt. Or set `world_up` in the manifest.")
    if _look_down_z(axes):
        reason = f"(0, 0, 1), a guess from {count} images that all look along -z: straight down, if z is up"
        return WorldUp(np.array([0.0, 0.0, 1.0]), False, reason)
    up, difference = _most_upright(axes, centers, groups)
    known, how = difference >= DECISIVE, "as most of its cameras are held"
    if not known:
        near_z = abs(up[2]) >= np.cos(np.radians(25.0))
        up = up * np.sign(up[2] if near_z else up[int(np.argmax(np.abs(up)))])
        how = "its sign is a guess: its cameras do not tell up from down" + (", so +z" if near_z else "")
    numbers = ", ".join(f"{value:.3f}" for value in up + 0.0)
    return WorldUp(up, known, f"({numbers}), estimated from {count} images, {how}")


def up_of_cameras(world_from_cams: ArrayLike) -> Floats:
    """Return the up direction (3,) of cameras (N, 4, 4), estimated as in `estimate_world_up`; z without any pose.

    All cameras are treated as one sensor; poses that are not finite are ignored.
    """
    poses = np.asarray(world_from_cams, np.float64).reshape(-1, 4, 4)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    poses = poses[_evenly(len(poses), MAX_IMAGES)]
    if not len(poses) or _look_down_z(poses[:, :3, :3]):
        return np.array([0.0, 0.0, 1.0])
    return _most_upright(poses[:, :3, :3], poses[:, :3, 3], np.zeros(len(poses), np.int64))[0]


def _look_down_z(axes: Floats) -> bool:
    """Tell whether cameras with these axes (N, 3, 3) all look along -z, so that level axes tell nothing."""
    along = -axes[:, 2, 2]
    return bool(len(axes) > 2 and np.quantile(along, 0.1) > np.cos(NADIR))


def _most_upright(axes: Floats, centers: Floats, groups: Ints) -> tuple[Floats, float]:
    """Return the up direction (3,) with the highest score, and its lead over the opposite direction (log)."""
    order = np.argsort(groups, kind="stable")
    few = order[_evenly(len(order), 300)]
    likelihood = _UpLikelihood(axes, centers, groups)
    candidates = _candidates(axes[few])
    order = np.argsort(-_UpLikelihood(axes[few], centers[few], groups[few]).scores(candidates), kind="stable")
    ups = _distinct(candidates[order], 4)
    ups = np.concatenate([ups, np.stack([likelihood.refined(up) for up in ups])])
    up = likelihood.polished(ups[int(np.argmax(likelihood.scores(ups)))])
    score, opposite = likelihood.scores(np.stack([up, -up]))
    return (up, float(score - opposite)) if score >= opposite else (-up, float(opposite - score))


def _posed_cameras(sessions: Sequence[Session]) -> tuple[Floats, Floats, Ints]:
    """Return axes (n, 3, 3), centers (n, 3) and groups (n,) of up to MAX_IMAGES cameras per session, in the world.

    The columns of the axes are right, down and forward. A group is one camera of a device in all its recordings. All
    cameras with few of a device's images form one group, because a phone may have one sensor id per image.
    """
    poses: list[Floats] = []
    roles: list[pd.Series] = []
    for session in sessions:
        world_from_cam, rows = posed_photographs(session)
        role = sensor_names(session, session.images["sensor_id"]).iloc[rows]["role"]
        # Sort by camera before sampling: a stride through a rig's frames could always pick the same camera.
        order = np.argsort(pd.factorize(role)[0], kind="stable")
        order = order[_evenly(len(order), MAX_IMAGES)]
        poses.append(world_from_cam[order])
        roles.append(role.iloc[order])
    if not poses:
        return np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, np.int64)
    role = pd.concat(roles, ignore_index=True)
    device = role.str.replace(r"/.*$", "", regex=True)
    images, of_device = role.map(role.value_counts()), device.map(device.value_counts())
    small = (images < 0.01 * of_device) | ((images < 3) & (device.map(role.groupby(device).nunique()) > 8))
    world_from_cam, groups = np.concatenate(poses), pd.factorize(role.where(~small, device))[0]
    return world_from_cam[:, :3, :3], world_from_cam[:, :3, 3], groups.astype(np.int64)


def posed_photographs(session: Session) -> tuple[Floats, Ints]:
    """Return world_from_cam, (n, 4, 4), of the photographs of a session that have a pose, and their rows (n,)."""
    poses = session.world_from_cam(ground_truth=session.trajectory is None)
    rows = session.camera_rows
    rows = rows[np.isfinite(poses[rows]).all((1, 2))]
    return poses[rows], rows


def _evenly(count: int, most: int) -> Ints:
    """Return at most `most` indices, evenly spread from 0 to `count` - 1."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _candidates(axes: Floats) -> Floats:
    """Return candidate up directions, (c, 3) unit: image axes, cross products of image axes, z, and their opposites."""
    few = axes[_evenly(len(axes), 40)]
    x, y = few[:, :, 0], few[:, :, 1]
    half = max(1, len(few) // 2)
    across = [np.cross(a, np.roll(b, shift, 0)) for shift in (half, max(1, half // 2)) for a in (x, y) for b in (x, y)]
    directions = np.concatenate([x, y, *across, np.eye(3)[2:]])
    length = np.linalg.norm(directions, axis=1)
    directions = directions[length > 0.1] / length[length > 0.1, None]
    return np.concatenate([directions, -directions])


def _distinct(directions: Floats, count: int) -> Floats:
    """Return the first directions, at most `count`, 15 degrees or more from earlier ones and their opposites."""
    kept = directions[:1]
    for direction in directions[1:]:
        if len(kept) < count and np.abs(kept @ direction).max() < np.cos(np.radians(15.0)):
            kept = np.vstack([kept, direction])
    return kept


class _UpLikelihood:
    """Log likelihood, with weak priors, of candidate up directions given the camera rotations.

    An image is held near one of four rolls, mostly the one of its group, at a moderate pitch; or it is an outlier.
    Images of a walk are not independent, so together they count as at most 100; otherwise the noise of a thousand
    images would outweigh every prior. The arguments are the arrays of `_posed_cameras`.
    """

    def __init__(self, axes: Floats, centers: Floats, groups: Ints) -> None:
        self.axes = axes
        self.member = (groups[:, None] == np.unique(groups)).astype(np.float64)
        offsets = centers - centers.mean(0)
        self.spread = offsets.T @ offsets / max(float((offsets**2).sum()), 1e-9)
        self.weight = min(1.0, 100 / len(axes))

    def _likelihoods(self, ups: Floats) -> tuple[Floats, Floats]:
        """Return the likelihoods that each image needs 0 to 3 turns, (4, n, c), for ups (c, 3), and sines of pitch (n,
        c).
        """
        right, down, forward = np.moveaxis(np.einsum("nij,ci->jnc", self.axes, ups), 0, 0)
        roll = np.exp(-0.5 * (np.stack([right, down]) / SIGMA_ROLL) ** 2)
        pitch = np.exp(-0.5 * (np.arcsin(np.clip(forward, -1, 1)) / SIGMA_PITCH) ** 2)
        tops = np.stack([-down, right, down, -right])
        return roll[[0, 1, 0, 1]] * pitch * (tops > 0), forward

    def _by_group(self, likely: Floats, forward: Floats) -> Floats:
        """Return the log likelihood that each group needs 0 to 3 quarter turns, (4, g, c)."""
        mixed = OUTLIER + (1 - ODD) * likely + ODD * np.einsum("kj,jnc->knc", ODD_PRIOR, likely, optimize=True)
        logs = np.einsum("ng,knc->kgc", self.member, np.log(mixed), optimize=True)
        # The roll of a camera that looks straight up or down tells nothing about the up direction.
        clarity = self.member.T @ (1 - np.clip(forward, -1, 1) ** 2) / self.member.sum(0)[:, None]
        return logs * self.weight + SENSOR_PRIOR[:, None, None] * clarity

    def scores(self, ups: Floats) -> Floats:
        """Return the scores (c,) of candidate up directions (c, 3)."""
        held = self._by_group(*self._likelihoods(ups)).max(0).sum(0)
        from_z = np.arccos(np.clip(np.abs(ups[:, 2]), 0, 1))
        walk = np.einsum("ci,ij,cj->c", ups, self.spread, ups)
        return held + Z_BONUS * np.exp(-0.5 * (from_z / Z_NEAR) ** 2) - WALK_BONUS * walk

    def _scatter(self, up: Floats) -> tuple[Floats, Floats]:
        """Return the mean outer products (3, 3) of the level axes, given `up`, and of the view directions."""
        likely, forward = self._likelihoods(up[None])
        held = self.member @ np.eye(4)[self._by_group(likely, forward)[..., 0].argmax(0)]
        shares = (held @ ((1 - ODD) * np.eye(4) + ODD * ODD_PRIOR)).T * likely[..., 0]
        clarity = 1 - np.clip(forward[:, 0], -1, 1) ** 2
        shares *= clarity / (OUTLIER + shares.sum(0))
        weights = np.stack([shares[0] + shares[2], shares[1] + shares[3], clarity], axis=-1)
        weights /= max(float(shares.sum()), 1e-9)
        outer = np.einsum("nij,nj,nkj->jik", self.axes, weights, self.axes, optimize=True)
        return outer[0] + outer[1], outer[2]

    def refined(self, up: Floats) -> Floats:
        """Refine `up`, (3,), by the level axes, with a weak pull towards level view directions.

        Without the pull, cameras that all look the same way do not determine the angle about their level axes.
        """
        pull = max(0.15, min(1.0, 6 / len(self.axes))) * (SIGMA_ROLL / SIGMA_PULL) ** 2
        for _ in range(10):
            level, views = self._scatter(up)
            up = _smallest(level + pull * views, up)
        return up

    def polished(self, up: Floats) -> Floats:
        """Refine `up` without the pull if the level axes alone determine it; else return it unchanged.

        The pull biases the result if all cameras look down. The level axes suffice if their second eigenvalue, due to
        different headings, is clearly larger than the effect of tilted cameras.
        """
        polished = up
        for _ in range(5):
            level, _ = self._scatter(polished)
            tilt, second, _ = np.linalg.eigvalsh(level) + (SIGMA_ROLL / 2) ** 2
            if second < 4 * tilt:
                return up
            polished = _smallest(level, polished)
        return polished


def _smallest(scatter: Floats, near: Floats) -> Floats:
    """Return the eigenvector (3,) of the smallest eigenvalue, with the sign that is closer to `near`."""
    smallest: Floats = np.linalg.eigh(scatter)[1][:, 0]
    return smallest if smallest @ near >= 0 else -smallest


def sensor_names(session: Session, sensors: pd.Series) -> pd.DataFrame:
    """Return the names by which sensors (n,) are looked up: columns sensor (id), role, name and device.

    The role is the part of the id after the last `/`, because recordings prefix ids. All names start with the kind of
    device.
    """
    ids = sensors.reset_index(drop=True).astype(object)
    names = session.sensors.drop_duplicates("sensor_id").set_index("sensor_id")["name"]
    name, kind = ids.map(names).astype(object).fillna(""), f"{session.device}/"
    named, role = (kind + name).where(name != "", None), kind + ids.str.replace(r"^.*/", "", regex=True)
    return pd.DataFrame({"sensor": kind + ids, "role": role, "name": named, "device": session.device})
