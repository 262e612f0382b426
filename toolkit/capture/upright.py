"""Turn images so that gravity points down in them, by multiples of 90 degrees learned from the map's poses.

Headset and robot cameras are mounted rotated, phones are held upright while their sensor lies on its side. What
a network learned from upright photographs wants them upright. `k` is always a number of COUNTER-CLOCKWISE quarter
turns of the image, as in `np.rot90`; images, intrinsics, poses and pixel positions have each their function, and
they agree.

    turns = quarter_turns([capture["hl_map"], capture["ios_map"]], world_up=None)
    k = turns.of(capture["hl_query"])
"""

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.folder import Capture
from toolkit.capture.session import Rows, Session
from toolkit.errors import CaptureError, ManifestError, ToolkitError
from toolkit.geometry import Array

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

Ints = NDArray[np.int64]

MAX_IMAGES = 2000  # a session, for the world's up
SIGMA_ROLL = 0.1  # radians; how far from a multiple of 90 degrees cameras are held
SIGMA_PITCH, SIGMA_PULL = np.radians(40.0), np.radians(25.0)
ODD = 0.1  # share of images that are held in another way than most of their sensor
# ... and in which by quarter turns, a row for each way of most images: on its side, a phone is rather turned upright.
ODD_PRIOR = np.array([[0.25] * 4, [0.4, 0.2, 0.2, 0.2], [0.25] * 4, [0.4, 0.2, 0.2, 0.2]])
OUTLIER = 0.005
SENSOR_PRIOR = np.array([0.0, -1.0, -2.0, -1.0])  # log; upright is likelier than on the side than upside down
Z_BONUS, Z_NEAR = 1.5, np.radians(10.0)  # log, radians: worlds are mostly made with z along gravity
WALK_BONUS = 2.0  # log: people walk on the ground, so cameras spread least along up
DECISIVE = 0.5  # log; the least difference between up and down that is no guess
CLEAR = 0.15  # the least margin of votes that is a decision; one image's vote is at most 1
MAJORITY = 2 / 3  # of the votes of sensors that are not the same one


# ------------------------------------------------------------------------------------------------- world up


@dataclass(frozen=True, eq=False)
class WorldUp:
    """The direction that is up in the world of a capture.

    Attributes:
        direction: (3,) float64, unit.
        known: False where its sign is a guess.
        reason: how it was found.
    """

    direction: Array
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
    the pitch, and up is across all level axes: the smallest eigenvector of the sum of their outer products,
    reweighted (Huber 1981) against images that are held askew. Which axis is level is decided for each camera
    of a device, with some images that do otherwise. Where cameras all look one way, what lies across their level
    axes is not one direction; then weak beliefs decide: cameras look near the horizon, are rather upright than
    rolled, are carried along the ground, and the world's z is vertical.

    Cameras that are upright tell up from down. Where they do not, up is +z if z is within 25 degrees (the
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


def up_of_cameras(world_from_cams: ArrayLike) -> Array:
    """Return the direction (3,) that is up for cameras (N, 4, 4), as `estimate_world_up` does; z without any pose.

    All are taken as of one kind; rows that are not finite are left out.
    """
    poses = np.asarray(world_from_cams, np.float64).reshape(-1, 4, 4)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    poses = poses[_evenly(len(poses), MAX_IMAGES)]
    if not len(poses):
        return np.array([0.0, 0.0, 1.0])
    return _most_upright(poses[:, :3, :3], poses[:, :3, 3], np.zeros(len(poses), np.int64))[0]


def _most_upright(axes: Array, centers: Array, groups: Ints) -> tuple[Array, float]:
    """Return the direction (3,) that explains the cameras best, and how much better than its opposite."""
    order = np.argsort(groups, kind="stable")
    few = order[_evenly(len(order), 300)]
    votes, some = _Votes(axes, centers, groups), _Votes(axes[few], centers[few], groups[few])
    candidates = _candidates(some.axes)
    order = np.argsort(-some.scores(candidates), kind="stable")
    ups = _distinct(candidates[order], 4)
    ups = np.concatenate([ups, np.stack([votes.refined(up) for up in ups])])
    up = votes.polished(ups[int(np.argmax(votes.scores(ups)))])
    score, opposite = votes.scores(np.stack([up, -up]))
    return (up, float(score - opposite)) if score >= opposite else (-up, float(opposite - score))


def _posed_cameras(sessions: Sequence[Session]) -> tuple[Array, Array, Ints]:
    """Return axes (n, 3, 3), centers (n, 3) and groups (n,) of up to MAX_IMAGES cameras a session, in the world.

    The columns of the axes are right, down and forward. A group is a camera of a device over all recordings; cameras
    that took a few of a device's images only, as a phone's with one id an image, are one group.
    """
    poses: list[Array] = []
    roles: list[pd.Series] = []
    for session in sessions:
        world_from_cam, rows = _posed(session)
        role = _keys(session, session.images["sensor_id"]).iloc[rows]["role"]
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


def _posed(session: Session) -> tuple[Array, Ints]:
    """Return world_from_cam, (n, 4, 4), of the photographs of a session that have a pose, and their rows."""
    poses = session.world_from_cam(ground_truth=session.trajectory is None)
    rows = session.camera_rows
    rows = rows[np.isfinite(poses[rows]).all((1, 2))]
    return poses[rows], rows


def _evenly(count: int, most: int) -> Ints:
    """Return at most `most` of the first `count` numbers, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _candidates(axes: Array) -> Array:
    """Return directions that may be up, (c, 3) unit: axes of images, what is across two of them, and z."""
    few = axes[_evenly(len(axes), 40)]
    x, y = few[:, :, 0], few[:, :, 1]
    half = max(1, len(few) // 2)
    across = [np.cross(a, np.roll(b, shift, 0)) for shift in (half, max(1, half // 2)) for a in (x, y) for b in (x, y)]
    directions = np.concatenate([x, y, *across, np.eye(3)[2:]])
    length = np.linalg.norm(directions, axis=1)
    directions = directions[length > 0.1] / length[length > 0.1, None]
    return np.concatenate([directions, -directions])


def _distinct(directions: Array, count: int) -> Array:
    """Return the first directions that are 15 degrees apart from those before them, along either sign."""
    kept = directions[:1]
    for direction in directions[1:]:
        if len(kept) < count and np.abs(kept @ direction).max() < np.cos(np.radians(15.0)):
            kept = np.vstack([kept, direction])
    return kept


class _Votes:
    """How well directions that may be up explain how cameras are held: a log likelihood with weak priors.

    An image is held near one of four rolls, mostly that of its group, with any pitch that is not too steep, or
    it is an outlier. Images of a walk are not independent, so all of them count as at most 100; else a thousand
    images would be surer of noise than any belief.
    """

    def __init__(self, axes: Array, centers: Array, groups: Ints) -> None:
        self.axes = axes
        self.member = (groups[:, None] == np.unique(groups)).astype(np.float64)
        offsets = centers - centers.mean(0)
        self.spread = offsets.T @ offsets / max(float((offsets**2).sum()), 1e-9)
        self.weight = min(1.0, 100 / len(axes))

    def _likelihoods(self, ups: Array) -> tuple[Array, Array]:
        """Return how likely each image is turned by 0 to 3 quarters, (4, n, c), and the sine of its pitch, (n, c)."""
        right, down, forward = np.moveaxis(np.einsum("nij,ci->jnc", self.axes, ups), 0, 0)
        roll = np.exp(-0.5 * (np.stack([right, down]) / SIGMA_ROLL) ** 2)
        pitch = np.exp(-0.5 * (np.arcsin(np.clip(forward, -1, 1)) / SIGMA_PITCH) ** 2)
        tops = np.stack([-down, right, down, -right])
        return roll[[0, 1, 0, 1]] * pitch * (tops > 0), forward

    def _by_group(self, likely: Array, forward: Array) -> Array:
        """Return the log likelihood of each group being turned by 0 to 3 quarters, (4, g, c)."""
        mixed = OUTLIER + (1 - ODD) * likely + ODD * np.einsum("kj,jnc->knc", ODD_PRIOR, likely, optimize=True)
        logs = np.einsum("ng,knc->kgc", self.member, np.log(mixed), optimize=True)
        # How a camera that looks straight up or down is turned says nothing about up.
        clarity = self.member.T @ (1 - np.clip(forward, -1, 1) ** 2) / self.member.sum(0)[:, None]
        return logs * self.weight + SENSOR_PRIOR[:, None, None] * clarity

    def scores(self, ups: Array) -> Array:
        """Return the score of directions (c, 3), (c,)."""
        held = self._by_group(*self._likelihoods(ups)).max(0).sum(0)
        from_z = np.arccos(np.clip(np.abs(ups[:, 2]), 0, 1))
        walk = np.einsum("ci,ij,cj->c", ups, self.spread, ups)
        return held + Z_BONUS * np.exp(-0.5 * (from_z / Z_NEAR) ** 2) - WALK_BONUS * walk

    def _scatter(self, up: Array) -> tuple[Array, Array]:
        """Return the mean outer products (3, 3) of the axes that are level for `up`, and of the view directions."""
        likely, forward = self._likelihoods(up[None])
        held = self.member @ np.eye(4)[self._by_group(likely, forward)[..., 0].argmax(0)]
        shares = (held @ ((1 - ODD) * np.eye(4) + ODD * ODD_PRIOR)).T * likely[..., 0]
        clarity = 1 - np.clip(forward[:, 0], -1, 1) ** 2
        shares *= clarity / (OUTLIER + shares.sum(0))
        weights = np.stack([shares[0] + shares[2], shares[1] + shares[3], clarity], axis=-1)
        weights /= max(float(shares.sum()), 1e-9)
        outer = np.einsum("nij,nj,nkj->jik", self.axes, weights, self.axes, optimize=True)
        return outer[0] + outer[1], outer[2]

    def refined(self, up: Array) -> Array:
        """Return the direction (3,) near `up` that level axes agree on, with a weak pull to level views.

        Without the pull, cameras that look one way would have any direction across their level axes.
        """
        pull = max(0.15, min(1.0, 6 / len(self.axes))) * (SIGMA_ROLL / SIGMA_PULL) ** 2
        for _ in range(10):
            level, views = self._scatter(up)
            up = _smallest(level + pull * views, up)
        return up

    def polished(self, up: Array) -> Array:
        """Return `up` without the pull, which bends it where all look down, if level axes alone tell it.

        They do where their second spread, from different headings, is clear of the askew way cameras are held.
        """
        polished = up
        for _ in range(5):
            level, _ = self._scatter(polished)
            askew, second, _ = np.linalg.eigvalsh(level) + (SIGMA_ROLL / 2) ** 2
            if second < 4 * askew:
                return up
            polished = _smallest(level, polished)
        return polished


def _smallest(scatter: Array, near: Array) -> Array:
    """Return the eigenvector (3,) of the smallest eigenvalue, in the direction that is nearer to `near`."""
    smallest: Array = np.linalg.eigh(scatter)[1][:, 0]
    return smallest if smallest @ near >= 0 else -smallest


# ------------------------------------------------------------------------------------------- turns of sensors


@dataclass(frozen=True)
class _Learned:
    """Votes of map images for quarter turns, collected under some keys.

    Attributes:
        keys: (n,) texts.
        votes: (n, 4), a column a number of quarter turns.
        ups: (n, 3), the sum of the up directions in camera coordinates.
    """

    keys: pd.Index
    votes: Array
    ups: Array

    @classmethod
    def collect(cls, keys: pd.Series, k: Ints, weights: Array, up_in_cam: Array) -> "_Learned":
        """Sum the votes of images (n,) by key; images without a key do not vote."""
        codes, unique = pd.factorize(keys, sort=True)
        has = codes >= 0
        codes, k, weights, up_in_cam = codes[has], k[has], weights[has], up_in_cam[has]
        votes, ups = np.zeros((len(unique), 4)), np.zeros((len(unique), 3))
        np.add.at(votes, (codes, k), weights)
        np.add.at(ups, codes, up_in_cam)
        return cls(pd.Index(unique, dtype=object), votes, ups)

    def turns(self, share: float = 0.0) -> Ints:
        """Return the number of quarter turns for each key, (n,), -1 where it is not clear.

        Args:
            share: of the votes that it needs.
        """
        ordered = np.sort(self.votes, axis=1)
        clear = (ordered[:, 3] - ordered[:, 2] >= CLEAR) & (ordered[:, 3] >= share * ordered.sum(1))
        return np.where(clear, self.votes.argmax(1), -1)


@dataclass(frozen=True)
class _Table:
    """Decided turns by key, and the mean up direction in camera coordinates."""

    keys: pd.Index
    turns: Ints
    ups: Array

    def find(self, keys: pd.Series) -> tuple[Ints, Array]:
        """Return turns (n,), -1 where not known, and up directions (n, 3) of keys."""
        rows = self.keys.get_indexer(keys.to_numpy(object)) if len(self.keys) else np.full(len(keys), -1)
        turns = np.append(self.turns, -1)[rows]
        return np.where(rows < 0, -1, turns), np.vstack([self.ups, np.zeros(3)])[rows]


def _decide(learned: _Learned, share: float) -> _Table:
    length = np.linalg.norm(learned.ups, axis=1, keepdims=True)
    return _Table(learned.keys, learned.turns(share), learned.ups / np.maximum(length, 1e-12))


def _keys(session: Session, sensors: pd.Series) -> pd.DataFrame:
    """Return the names under which sensors (n,) may be known: their id, role, name and device kind."""
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


SHARES = {"sensor": 0.0, "role": MAJORITY, "name": MAJORITY, "device": MAJORITY}


@dataclass
class Turns:
    """How many quarter turns bring up to the top of the images of each sensor; see `quarter_turns`."""

    world_up: WorldUp | None
    _tables: dict[str, _Table]
    _of_sensors: dict[Path, tuple[Ints, Ints]] = field(default_factory=dict)

    def of(self, session: Session, rows: Rows = None) -> Ints:
        """Return counter-clockwise quarter turns, 0 to 3, for images of a map or query session, (n,) int64.

        A sensor is looked up by its id; by its device kind and the id after the last `/` (recordings prefix
        ids); by its device kind and name. A camera that is still not known follows from the others of its rig,
        and without those is turned as two thirds of its device kind's map images. Else it is left as it is.
        What was turned, and what is not known, is logged once a session.

        Args:
            rows: rows of `session.images`; None means all.
        """
        codes, turns = self._turns_of(session)
        selected = codes[rows if rows is None or isinstance(rows, slice) else np.atleast_1d(np.asarray(rows))]
        return turns[selected.reshape(-1)]

    @cached_property
    def _digest(self) -> str:
        digest = hashlib.sha256()
        for kind, table in self._tables.items():
            ups = np.round(table.ups, 1) + 0.0 if kind == "role" else np.zeros((len(table.keys), 0))
            for key, turn, up in zip(table.keys, table.turns.tolist(), ups.tolist(), strict=True):
                digest.update(f"{kind} {key} {turn} {up}\n".encode())
        return digest.hexdigest()[:16]

    def record(self, session: Session | None = None) -> dict[str, Any]:
        """Return what was learned, for fingerprints; the same maps give the same record.

        Args:
            session: one to limit it to: then the record changes only if an image of this session is turned
                differently, whatever else is added to the map.
        """
        if session is not None:
            codes, turns = self._turns_of(session)
            counts = np.bincount(turns[codes], minlength=4).tolist()
            ids = pd.factorize(session.images["sensor_id"])[1]
            lines = sorted(f"{sensor} {turn}\n" for sensor, turn in zip(ids, turns.tolist(), strict=True))
            return {"images": counts, "digest": hashlib.sha256("".join(lines).encode()).hexdigest()[:16]}
        by_device, sensors = self._tables["device"], self._tables["sensor"]
        return {
            "devices": dict(zip(map(str, by_device.keys), by_device.turns.tolist(), strict=True)),
            "sensors": np.bincount(sensors.turns[sensors.turns >= 0], minlength=4).tolist(),
            "digest": self._digest,
        }

    def _turns_of(self, session: Session) -> tuple[Ints, Ints]:
        key = session.path.absolute()
        if key not in self._of_sensors:
            self._of_sensors[key] = self._look_up(session)
        return self._of_sensors[key]

    def _look_up(self, session: Session) -> tuple[Ints, Ints]:
        """Return the sensor of each image, as a number, and the turns of each sensor; log them."""
        codes, unique = pd.factorize(session.images["sensor_id"])
        sensors = pd.Series(np.asarray(unique, object), dtype=object)
        keys = _keys(session, sensors)
        turns, ups = np.full(len(sensors), -1, np.int64), np.zeros((len(sensors), 3))
        for kind in ("sensor", "role", "name"):
            found, up = self._tables[kind].find(keys[kind])
            take = (turns < 0) & (found >= 0)
            turns[take], ups[take] = found[take], up[take]
        if np.any(turns >= 0) and np.any(turns < 0):
            turns = _from_rigs(session, sensors, turns, ups)
        by_device = self._tables["device"].find(keys["device"])[0]
        turns = np.where(turns < 0, by_device, turns)
        _report(session, keys["role"], turns)
        return codes.astype(np.int64), np.maximum(turns, 0)


def quarter_turns(maps: Sequence[Session], world_up: WorldUp | ArrayLike | None = None) -> Turns:
    """Learn how each camera is mounted or held from the poses of a capture's map sessions.

    Every image votes for the quarter turns that bring up nearest to its top, the more the clearer: not at all
    where it looks straight up or down or is held at 45 degrees.

    Args:
        maps: all map sessions of one capture.
        world_up: the direction (3,) that is up, of any length; None: `estimate_world_up`.

    Returns:
        The turns. Without any posed image nothing is known and nothing is turned, which is logged as a warning.

    Raises:
        ManifestError: `world_up` is not three finite numbers, or is zero.
    """
    up = world_up if world_up is None or isinstance(world_up, WorldUp) else given_world_up(world_up)
    parts: list[pd.DataFrame] = []
    rotations: list[Array] = []
    for session in maps:
        world_from_cam, rows = _posed(session)
        parts.append(_keys(session, session.images["sensor_id"].iloc[rows]))
        rotations.append(world_from_cam[:, :3, :3])
    keys = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame({kind: [] for kind in SHARES}, dtype=object)
    if not len(keys):
        log.warning(
            "Upright: no image of the map (%s) has a pose, so no image is turned.",
            ", ".join(session.id for session in maps) or "no session",
        )
    elif up is None:
        up = estimate_world_up(maps)
        log.log(logging.INFO if up.known else logging.WARNING, "Upright: up is %s.", up.reason)
    up_in_cam = np.zeros((0, 3))
    if up is not None and len(keys):
        up_in_cam = np.einsum("nij,i->nj", np.concatenate(rotations), up.direction)
    k, weights = _votes_of(up_in_cam)
    tables = {
        kind: _decide(_Learned.collect(keys[kind], k, weights, up_in_cam), share) for kind, share in SHARES.items()
    }
    return Turns(up, tables)


def upright_turns(capture: Capture, world_up: ArrayLike | None = None) -> Turns:
    """Return the turns learned from all map sessions of a capture; see `quarter_turns`."""
    return quarter_turns([capture[name] for name in capture if capture[name].split == "map"], world_up)


def _votes_of(up_in_cam: Array) -> tuple[Ints, Array]:
    """Return the quarter turns that bring up to the image's top, and how clear that is in [0, 1], (n,) each."""
    right, down = up_in_cam[:, 0], up_in_cam[:, 1]
    k = np.stack([-down, right, down, -right], -1).argmax(-1)
    return k.astype(np.int64), np.abs(np.abs(right) - np.abs(down))


def _from_rigs(session: Session, sensors: pd.Series, turns: Ints, ups: Array) -> Ints:
    """Return the turns with those added that follow from the known cameras of the same rig."""
    if session.rigs is None:
        return turns
    rig, _ = pd.factorize(session.rigs["rig_id"])
    sensor = pd.Index(sensors).get_indexer(session.rigs["sensor_id"].to_numpy(object))
    rotations = session.rig_from_sensor_table[:, :3, :3]
    known = (sensor >= 0) & (turns[sensor] >= 0)
    up_in_rig = np.zeros((len(np.unique(rig)), 3))
    np.add.at(up_in_rig, rig[known], np.einsum("nij,nj->ni", rotations[known], ups[sensor[known]]))
    length = np.linalg.norm(up_in_rig, axis=1, keepdims=True)
    up_in_rig = np.where(length > 0, up_in_rig / np.maximum(length, 1e-12), 0.0)
    up_in_cam = np.einsum("nij,ni->nj", rotations, up_in_rig[rig])
    k, weights = _votes_of(up_in_cam)
    asked = (sensor >= 0) & ~known
    learned = _Learned.collect(
        sensors.iloc[sensor[asked]].reset_index(drop=True), k[asked], weights[asked], up_in_cam[asked]
    )
    table = _decide(learned, MAJORITY)
    return np.where(turns < 0, table.find(sensors)[0], turns)


def _report(session: Session, roles: pd.Series, turns: Ints) -> None:
    """Log one line on a session; sensors whose ids differ in numbers only are one."""
    short = roles.str.replace(r"^[^/]*/", "", regex=True).str.replace(r"\d{4,}", "*", regex=True)
    table = pd.DataFrame({"sensor": short, "turns": turns})
    texts = {-1: "not known, left as they are", 0: "upright as they are"}
    parts = []
    for turn, group in table.groupby("turns"):
        counts = group["sensor"].value_counts().sort_index()
        names = [f"{name} ({count})" if count > 1 else str(name) for name, count in counts.items()]
        shown = ", ".join(names[:6]) + (f", ... {len(names) - 6} more" if len(names) > 6 else "")
        parts.append(f"{texts.get(int(turn), f'turned by {90 * int(turn)} degrees counter-clockwise')}: {shown}")
    log.info("Upright: %s: %s.", session.id, "; ".join(parts) or "no images")


# -------------------------------------------------------------------------- images, intrinsics, poses, pixels

# Distortion terms that have a direction in the image: index pairs of parameters that are the x and y of a vector.
# OpenCV's p1, p2 are such a vector in the order p2, p1, as its equations show.
DIRECTED: dict[str, list[tuple[int, int]]] = {
    "SIMPLE_PINHOLE": [], "PINHOLE": [], "SIMPLE_RADIAL": [], "RADIAL": [], "FOV": [], "EUCM": [],
    "SIMPLE_DIVISION": [], "DIVISION": [], "SIMPLE_FISHEYE": [], "FISHEYE": [],
    "SIMPLE_RADIAL_FISHEYE": [], "RADIAL_FISHEYE": [], "OPENCV_FISHEYE": [],
    "OPENCV": [(7, 6)],
    "FULL_OPENCV": [(7, 6)],
    "THIN_PRISM_FISHEYE": [(7, 6), (10, 11)],
    "RAD_TAN_THIN_PRISM_FISHEYE": [(10, 11), (12, 14), (13, 15)],
}  # fmt: skip


def turn_image(image: NDArray[Any], k: int) -> NDArray[Any]:
    """Return an image (H, W) or (H, W, 3) after k counter-clockwise quarter turns, contiguous.

    It is the array that was given where there is nothing to do.
    """
    import cv2

    codes = (cv2.ROTATE_90_COUNTERCLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_CLOCKWISE)
    image = np.ascontiguousarray(image)
    return image if k % 4 == 0 else cv2.rotate(image, codes[k % 4 - 1])


def turn_points(xy: ArrayLike, width: int, height: int, k: int) -> Array:
    """Return where pixel positions (N, 2) of an image of this size are after k quarter turns, (N, 2).

    The center of the top-left pixel is (0.5, 0.5), before and after.
    """
    x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
    turned = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)][k % 4]
    return np.stack(turned, axis=-1)


def turned_from_cam(k: ArrayLike) -> Array:
    """Return the pose of the camera in the coordinates of the camera after k quarter turns, (..., 4, 4).

    A turned image's pose is world_from_cam @ invert(turned_from_cam(k)).

    Args:
        k: quarter turns, any shape.
    """
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, 1], [-1, 0]]  # what pointed right points up, along -y
    return np.stack([np.linalg.matrix_power(quarter, turn) for turn in range(4)])[np.asarray(k) % 4]


def turn_camera(camera: "pycolmap.Camera", k: int) -> "pycolmap.Camera":
    """Return the intrinsics of the image after k quarter turns; distortion turns along.

    Raises:
        ToolkitError: the camera model has no turned version, as EQUIRECTANGULAR.
    """
    import pycolmap

    vectors = DIRECTED.get(camera.model_name)
    if vectors is None:
        raise ToolkitError(
            f"Found camera model {camera.model_name}, whose images cannot be turned by 90 degrees; expected one of "
            f"{', '.join(DIRECTED)}. Set `upright: false` for this capture, or undistort its images."
        )
    params, width, height = np.array(camera.params, np.float64), camera.width, camera.height
    focal, center = list(camera.focal_length_idxs()), list(camera.principal_point_idxs())
    params[center] = turn_points(params[center], width, height, k)
    if k % 2:
        params[focal] = params[focal[::-1]]
        width, height = height, width
    vector_turn = turned_from_cam(k)[:2, :2]
    for pair in vectors:
        params[list(pair)] = vector_turn @ params[list(pair)]
    turned = pycolmap.Camera(model=camera.model_name, width=width, height=height, params=params + 0.0)
    turned.camera_id = camera.camera_id
    turned.has_prior_focal_length = camera.has_prior_focal_length
    return turned
