"""Estimate which direction is up in the world of a capture, from the poses of its map images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from toolkit.capture.session import Session
from toolkit.errors import CaptureError, ManifestError
from toolkit.geometry import Floats, Ints

MAX_IMAGES = 2000  # of a session
SIGMA_ROLL = 0.1  # radians; how far from a multiple of 90 degrees cameras are held
SIGMA_PITCH, SIGMA_PULL = np.radians(40.0), np.radians(25.0)
ODD = 0.1  # share of images that are held in another way than most of their sensor
# The share of each quarter turn among the odd images of a sensor; a row for each turn that most of its images need. A
# phone that mostly lies on its side is rather turned upright.
ODD_PRIOR = np.array([[0.25] * 4, [0.4, 0.2, 0.2, 0.2], [0.25] * 4, [0.4, 0.2, 0.2, 0.2]])
OUTLIER = 0.005
SENSOR_PRIOR = np.array([0.0, -1.0, -2.0, -1.0])  # log; upright is likelier than on the side than upside down
Z_BONUS, Z_NEAR = 1.5, np.radians(10.0)  # log, radians: worlds are mostly made with z along gravity
WALK_BONUS = 2.0  # log: people walk on the ground, so cameras spread least along up
DECISIVE = 0.5  # log; the least difference between up and down that is not a guess


@dataclass(frozen=True, eq=False)
class WorldUp:
    """The direction that is up in the world of a capture.

    Attributes:
        direction: (3,) float64, unit.
        known: False where its sign is a guess.
        reason: how it was determined, for messages.
    """

    direction: Floats
    known: bool
    reason: str


def given_world_up(direction: ArrayLike) -> WorldUp:
    """Return the direction (3,) that a manifest gives, of any length, as a unit vector.

    Raises:
        ManifestError: not three finite numbers, or all zero.
    """
    try:
        up = np.asarray(direction, np.float64)
    except (TypeError, ValueError):
        up = np.zeros(0)
    length = float(np.linalg.norm(up)) if up.shape == (3,) else 0.0
    if not np.isfinite(length) or length < 1e-9:
        raise ManifestError(
            f"Found world_up: {direction!r}; expected three finite numbers, not all zero, the direction that is "
            "up in the captures' world, e.g. [0, 0, 1]. Leave it out to have it estimated."
        )
    return WorldUp(up / length, True, "given")


def estimate_world_up(sessions: Sequence[Session]) -> WorldUp:
    """Estimate the direction that is up in a capture from the poses of its map sessions, which share one world.

    Cameras are held or mounted near a multiple of 90 degrees of roll, so one axis of each image is level, whatever
    the pitch. Up is perpendicular to all level axes: it is the eigenvector with the smallest eigenvalue of the sum of
    their outer products, with less weight for images that are held askew (Huber 1981). Which axis is level is decided
    for each camera of a device; a share of its images may be held otherwise. Where all cameras look one way, many
    directions are perpendicular to their level axes. Then weak priors decide: cameras look near the horizon, are
    rather upright than rolled and are carried along the ground, and the world's z is vertical.

    Upright cameras tell up from down. Where cameras do not tell, up is +z if z is within 25 degrees of the axis (the
    convention of CroCoDL and LaMAR), else the sign is arbitrary; `known` is False in both cases.

    Raises:
        CaptureError: no image has a pose.
    """
    axes, centers, groups = _posed_cameras(sessions)
    count = len(axes)
    if not count:
        names = ", ".join(session.id for session in sessions) or "none"
        raise CaptureError(
            f"No image of the map sessions ({names}) has a pose, so the direction that is up cannot be "
            "estimated: expected poses in trajectories.txt. Give `world_up` in the manifest instead."
        )
    up, difference = _most_upright(axes, centers, groups)
    known, how = difference >= DECISIVE, "as most of its cameras are held"
    if not known:
        near_z = abs(up[2]) >= np.cos(np.radians(25.0))
        up = up * np.sign(up[2] if near_z else up[int(np.argmax(np.abs(up)))])
        how = "its sign is a guess: its cameras do not tell up from down" + (", so +z" if near_z else "")
    numbers = ", ".join(f"{value:.3f}" for value in up + 0.0)
    return WorldUp(up, known, f"({numbers}), estimated from {count} images, {how}")


def up_of_cameras(world_from_cams: ArrayLike) -> Floats:
    """Return the direction (3,) that is up for cameras (N, 4, 4), as `estimate_world_up` does; z without any pose.

    All cameras count as one sensor; poses that are not finite are left out.
    """
    poses = np.asarray(world_from_cams, np.float64).reshape(-1, 4, 4)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    poses = poses[_evenly(len(poses), MAX_IMAGES)]
    if not len(poses):
        return np.array([0.0, 0.0, 1.0])
    return _most_upright(poses[:, :3, :3], poses[:, :3, 3], np.zeros(len(poses), np.int64))[0]


def _most_upright(axes: Floats, centers: Floats, groups: Ints) -> tuple[Floats, float]:
    """Return the direction (3,) that explains the cameras best, and by how much it beats its opposite (log)."""
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
    """Return axes (n, 3, 3), centers (n, 3) and groups (n,) of up to MAX_IMAGES cameras a session, in the world.

    The columns of the axes are right, down and forward. A group is one camera of a device in all its recordings. The
    cameras that took only a few of a device's images (a phone may have one sensor id for each image) form one group.
    """
    poses: list[Floats] = []
    roles: list[pd.Series] = []
    for session in sessions:
        world_from_cam, rows = posed_photographs(session)
        role = sensor_names(session, session.images["sensor_id"]).iloc[rows]["role"]
        # One camera after the other: a stride through a rig's frames could meet the same camera each time.
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
    """Return world_from_cam, (n, 4, 4), of the photographs of a session that have a pose, and their rows."""
    poses = session.world_from_cam(ground_truth=session.trajectory is None)
    rows = session.camera_rows
    rows = rows[np.isfinite(poses[rows]).all((1, 2))]
    return poses[rows], rows


def _evenly(count: int, most: int) -> Ints:
    """Return at most `most` of the first `count` numbers, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _candidates(axes: Floats) -> Floats:
    """Return directions that may be up, (c, 3) unit: axes of images, cross products of two of them, and z."""
    few = axes[_evenly(len(axes), 40)]
    x, y = few[:, :, 0], few[:, :, 1]
    half = max(1, len(few) // 2)
    across = [np.cross(a, np.roll(b, shift, 0)) for shift in (half, max(1, half // 2)) for a in (x, y) for b in (x, y)]
    directions = np.concatenate([x, y, *across, np.eye(3)[2:]])
    length = np.linalg.norm(directions, axis=1)
    directions = directions[length > 0.1] / length[length > 0.1, None]
    return np.concatenate([directions, -directions])


def _distinct(directions: Floats, count: int) -> Floats:
    """Return the first directions (at most `count`) that are 15 degrees or more from the ones before, and opposites."""
    kept = directions[:1]
    for direction in directions[1:]:
        if len(kept) < count and np.abs(kept @ direction).max() < np.cos(np.radians(15.0)):
            kept = np.vstack([kept, direction])
    return kept


class _UpLikelihood:
    """How well a direction that may be up explains the way cameras are held: a log likelihood with weak priors.

    An image is held near one of four rolls, mostly that of its group, with any pitch that is not too steep; or it is
    an outlier. Images of a walk are not independent, so all together count as at most 100; else the noise of a
    thousand images would outweigh every prior.
    """

    def __init__(self, axes: Floats, centers: Floats, groups: Ints) -> None:
        """Take the arrays of `_posed_cameras`."""
        self.axes = axes
        self.member = (groups[:, None] == np.unique(groups)).astype(np.float64)
        offsets = centers - centers.mean(0)
        self.spread = offsets.T @ offsets / max(float((offsets**2).sum()), 1e-9)
        self.weight = min(1.0, 100 / len(axes))

    def _likelihoods(self, ups: Floats) -> tuple[Floats, Floats]:
        """Return the likelihood of each image to need 0 to 3 quarter turns, (4, n, c), and sines of pitch, (n, c)."""
        right, down, forward = np.moveaxis(np.einsum("nij,ci->jnc", self.axes, ups), 0, 0)
        roll = np.exp(-0.5 * (np.stack([right, down]) / SIGMA_ROLL) ** 2)
        pitch = np.exp(-0.5 * (np.arcsin(np.clip(forward, -1, 1)) / SIGMA_PITCH) ** 2)
        tops = np.stack([-down, right, down, -right])
        return roll[[0, 1, 0, 1]] * pitch * (tops > 0), forward

    def _by_group(self, likely: Floats, forward: Floats) -> Floats:
        """Return the log likelihood of each group to need 0 to 3 quarter turns, (4, g, c)."""
        mixed = OUTLIER + (1 - ODD) * likely + ODD * np.einsum("kj,jnc->knc", ODD_PRIOR, likely, optimize=True)
        logs = np.einsum("ng,knc->kgc", self.member, np.log(mixed), optimize=True)
        # How a camera that looks straight up or down is turned says nothing about up.
        clarity = self.member.T @ (1 - np.clip(forward, -1, 1) ** 2) / self.member.sum(0)[:, None]
        return logs * self.weight + SENSOR_PRIOR[:, None, None] * clarity

    def scores(self, ups: Floats) -> Floats:
        """Return the score of directions (c, 3), (c,)."""
        held = self._by_group(*self._likelihoods(ups)).max(0).sum(0)
        from_z = np.arccos(np.clip(np.abs(ups[:, 2]), 0, 1))
        walk = np.einsum("ci,ij,cj->c", ups, self.spread, ups)
        return held + Z_BONUS * np.exp(-0.5 * (from_z / Z_NEAR) ** 2) - WALK_BONUS * walk

    def _scatter(self, up: Floats) -> tuple[Floats, Floats]:
        """Return the mean outer products (3, 3) of the axes that are level if `up` is up, and of view directions."""
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
        """Return the direction (3,) near `up` that level axes agree on, with a weak pull towards level views.

        Without the pull, cameras that all look one way would leave the angle about their level axes open.
        """
        pull = max(0.15, min(1.0, 6 / len(self.axes))) * (SIGMA_ROLL / SIGMA_PULL) ** 2
        for _ in range(10):
            level, views = self._scatter(up)
            up = _smallest(level + pull * views, up)
        return up

    def polished(self, up: Floats) -> Floats:
        """Return `up` refined without the pull, if level axes alone determine it; else `up`.

        The pull bends the result where all cameras look down. Level axes are enough where their second eigenvalue,
        which comes from different headings, is clearly above the effect of cameras that are held askew.
        """
        polished = up
        for _ in range(5):
            level, _ = self._scatter(polished)
            askew, second, _ = np.linalg.eigvalsh(level) + (SIGMA_ROLL / 2) ** 2
            if second < 4 * askew:
                return up
            polished = _smallest(level, polished)
        return polished


def _smallest(scatter: Floats, near: Floats) -> Floats:
    """Return the eigenvector (3,) of the smallest eigenvalue, in the direction that is nearer to `near`."""
    smallest: Floats = np.linalg.eigh(scatter)[1][:, 0]
    return smallest if smallest @ near >= 0 else -smallest


def sensor_names(session: Session, sensors: pd.Series) -> pd.DataFrame:
    """Return the names under which sensors (n,) can be looked up: columns sensor (id), role, name and device.

    The role is the id after the last `/`, as recordings prefix their ids. All names start with the kind of device.
    """
    ids = sensors.reset_index(drop=True).astype(object)
    names = session.sensors.drop_duplicates("sensor_id").set_index("sensor_id")["name"]
    name = ids.map(names).astype(object).fillna("")
    kind = f"{session.device}/"
    return pd.DataFrame(
        {
            "sensor": kind + ids,
            "role": kind + ids.str.replace(r"^.*/", "", regex=True),
            "name": (kind + name).where(name != "", None),
            "device": session.device,
        }
    )
