"""Find what is up in a capture's world, and the quarter turns that make the images of each sensor upright.

Headset and robot cameras are mounted rotated, and phones store portrait images in landscape. Networks trained on
upright images expect upright images. `k` is always the number of COUNTER-CLOCKWISE quarter turns of the image, as
in `np.rot90`.

    turns = quarter_turns([capture["hl_map"], capture["ios_map"]], world_up=None)
    k = turns.of(capture["hl_query"])
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from toolkit.capture.session import IMPORT_RECORD, Capture, Rows, Session
from toolkit.errors import CaptureError
from toolkit.files import fingerprint, read_json
from toolkit.geometry import Floats, Ints, unit
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

    It is z where the import of a session has made it so, by GPS or known positions.

    Cameras are held or mounted near a multiple of 90 degrees of roll, so one axis of each image is level for any pitch.
    Up is perpendicular to all level axes: the eigenvector with the smallest eigenvalue of the sum of their outer
    products, with less weight for tilted images (Huber 1981). Which axis is level is decided for each camera of a
    device; a share of its images may be held differently. If all cameras look the same way, many directions are
    perpendicular to their level axes. Weak priors then decide: cameras look near the horizon, are rather upright than
    rolled and move along the ground, and the world's z axis is vertical. The mean of the cameras' ups is simpler, but
    40 degrees off with a camera mounted rolled, 27 to 30 where a handheld one looks down, and 24 with mixed phones.

    Upright cameras distinguish up from down. If the cameras do not, up is +z if z is within 25 degrees of the axis (the
    convention of CroCoDL and LaMAR), else the sign is arbitrary; `known` is False in both cases. Cameras that all look
    along -z are taken for those of a drone; whether z is up, they cannot tell. Raise CaptureError if no image has a
    pose.
    """
    axes, centers, groups = _posed_cameras(sessions)
    count = len(axes)
    if not count:
        names = ", ".join(session.id for session in sessions) or "none"
        fault = f"No image of the map sessions ({names}) has a pose, so the up direction cannot be estimated"
        raise CaptureError(f"{fault}: expected poses in trajectories.txt. Or set `world_up` in the manifest.")
    for record in (read_json(session.path / IMPORT_RECORD) for session in sessions):
        if record.get("z is up"):
            return WorldUp(np.array([0.0, 0.0, 1.0]), True, record["up"])
    if look_down_z(axes):
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
    if not len(poses) or look_down_z(poses[:, :3, :3]):
        return np.array([0.0, 0.0, 1.0])
    return _most_upright(poses[:, :3, :3], poses[:, :3, 3], np.zeros(len(poses), np.int64))[0]


def look_down_z(axes: Floats) -> bool:
    """Tell whether cameras with these axes (N, 3, 3) or poses (N, 4, 4) look along -z: level axes then tell nothing."""
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
        world_from_cam, rows = posed_images(session)
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


def posed_images(session: Session) -> tuple[Floats, Ints]:
    """Return world_from_cam, (n, 4, 4), of the images of a session that have a pose, and their rows (n,)."""
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
        """Return, for ups (c, 3), likelihoods that images need 0 to 3 turns, (4, n, c), and sines of pitch (n, c)."""
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


log = logging.getLogger(__name__)

CLEAR = 0.15  # smallest margin of votes that decides; one image has at most 1 vote
MAJORITY = 2 / 3  # share of the votes that decides for similar sensors, as opposed to the same sensor
# Share of the votes needed for a decision, for each kind of name by which sensors are looked up.
SHARES = {"sensor": 0.0, "role": MAJORITY, "name": MAJORITY, "device": MAJORITY}


@dataclass(frozen=True)
class _TurnsByName:
    """Quarter turns (n,) by sensor name, decided by the votes of map images, -1 if they do not decide; and mean up
    directions `ups` (n, 3) in camera coordinates, unit length.
    """

    names: pd.Index
    turns: Ints
    ups: Floats

    @classmethod
    def learn(cls, names: pd.Series, up_in_cams: Floats, share: float) -> "_TurnsByName":
        """Decide by the votes of images, each with a sensor name (None: no vote) and an up direction (3,) in the
        camera; `share` is that of a name's votes needed for a decision.
        """
        codes, unique = pd.factorize(names, sort=True)
        up_in_cams, codes = up_in_cams[codes >= 0], codes[codes >= 0]
        right, down = up_in_cams[:, 0], up_in_cams[:, 1]
        turns = np.stack([-down, right, down, -right], -1).argmax(-1)
        votes, ups = np.zeros((len(unique), 4)), np.zeros((len(unique), 3))
        np.add.at(votes, (codes, turns), np.abs(np.abs(right) - np.abs(down)))
        np.add.at(ups, codes, up_in_cams)
        ordered = np.sort(votes, axis=1)
        clear = (ordered[:, 3] - ordered[:, 2] >= CLEAR) & (ordered[:, 3] >= share * ordered.sum(1))
        return cls(pd.Index(unique, dtype=object), np.where(clear, votes.argmax(1), -1), unit(ups))

    def find(self, names: pd.Series) -> tuple[Ints, Floats]:
        """Return turns (n,), -1 if unknown, and up directions (n, 3), zero if unknown."""
        rows = self.names.get_indexer(names.to_numpy(object)) if len(self.names) else np.full(len(names), -1)
        return np.append(self.turns, -1)[rows], np.vstack([self.ups, np.zeros(3)])[rows]


@dataclass
class Turns:
    """The quarter turns that make the images of each sensor upright; see `quarter_turns`."""

    world_up: WorldUp | None
    _by_name: dict[str, _TurnsByName]
    _of_sensors: dict[Path, tuple[Ints, Ints]] = field(default_factory=dict)

    def of(self, session: Session, rows: Rows = None) -> Ints:
        """Return counter-clockwise quarter turns, 0 to 3, for images of a map or query session, (n,) int64.

        A sensor is looked up by its kind of device and, in turn, its id, the part of its id after the last `/`
        (recordings prefix ids), and its name. If it is not found, its turns follow from the known cameras of its rig;
        failing that, from two thirds or more of the map images of its kind of device. Otherwise it is not turned. The
        turns are logged once per session.

        Args:
            rows: rows of `session.images`; None means all.
        """
        key = session.path.absolute()
        if key not in self._of_sensors:
            self._of_sensors[key] = self._look_up(session)
        codes, turns = self._of_sensors[key]
        selected = codes[rows if rows is None or isinstance(rows, slice) else np.atleast_1d(np.asarray(rows))]
        return turns[selected.reshape(-1)]

    def fingerprint(self, sessions: Sequence[Session]) -> str:
        """Return 16 hex digits that identify the turns of all images of the sessions."""
        return fingerprint([self.of(session).tolist() for session in sessions])

    def _look_up(self, session: Session) -> tuple[Ints, Ints]:
        """Return the index of each image's sensor, and the turns of each sensor; log them."""
        codes, ids = pd.factorize(session.images["sensor_id"])
        sensors = pd.Series(np.asarray(ids, object), dtype=object)
        names = sensor_names(session, sensors)
        turns, ups = np.full(len(sensors), -1, np.int64), np.zeros((len(sensors), 3))
        for kind in ("sensor", "role", "name"):
            turns_of_kind, ups_of_kind = self._by_name[kind].find(names[kind])
            new = (turns < 0) & (turns_of_kind >= 0)
            turns[new], ups[new] = turns_of_kind[new], ups_of_kind[new]
        if np.any(turns >= 0) and np.any(turns < 0):
            turns = _from_rigs(session, sensors, turns, ups)
        turns = np.where(turns < 0, self._by_name["device"].find(names["device"])[0], turns)
        _report(session, names["role"], turns)
        return codes.astype(np.int64), np.maximum(turns, 0)


@fixed_sums
def quarter_turns(maps: Sequence[Session], world_up: ArrayLike | None = None) -> Turns:
    """Find how each camera is mounted or held, from the poses of a capture's map sessions.

    Each image votes for the quarter turns that bring the up direction closest to its top. The weight of the vote is
    zero for an image that looks straight up or down, or is rolled by 45 degrees.

    Args:
        maps: all map sessions of one capture.
        world_up: up direction (3,) of the world, any length but 0; None: `estimate_world_up`.

    Returns:
        The turns. Without any posed image, no image is turned, and a warning is logged.
    """
    up = None if world_up is None else WorldUp(np.asarray(world_up) / np.linalg.norm(world_up), True, "given")
    tables = [pd.DataFrame({kind: [] for kind in SHARES}, dtype=object)]
    rotations = [np.zeros((0, 3, 3))]
    for session in maps:
        world_from_cam, rows = posed_images(session)
        tables.append(sensor_names(session, session.images["sensor_id"].iloc[rows]))
        rotations.append(world_from_cam[:, :3, :3])
    names = pd.concat(tables[1:] or tables, ignore_index=True)
    up_in_cams = np.zeros((0, 3))
    if not len(names):
        sessions = ", ".join(session.id for session in maps) or "no session"
        log.warning("Upright: no image of the map (%s) has a pose, so no image is turned.", sessions)
    else:
        if up is None:
            up = estimate_world_up(maps)
            log.log(logging.INFO if up.known else logging.WARNING, "Upright: up is %s.", up.reason)
        up_in_cams = np.einsum("nij,i->nj", np.concatenate(rotations), up.direction)
    return Turns(up, {kind: _TurnsByName.learn(names[kind], up_in_cams, share) for kind, share in SHARES.items()})


_KEPT = WeakKeyDictionary[Capture, dict[str, Turns]]()


def upright_turns(capture: Capture, world_up: Sequence[float] | None = None) -> Turns:
    """Return the turns according to all map sessions of a capture, found once; see `quarter_turns`."""
    kept, key = _KEPT.setdefault(capture, {}), str(world_up)
    if key not in kept:
        kept[key] = quarter_turns(capture.usable("map"), world_up)
    return kept[key]


def _from_rigs(session: Session, sensors: pd.Series, turns: Ints, ups: Floats) -> Ints:
    """Return the turns, with unknown ones derived from the known cameras of the same rig."""
    if session.rigs is None:
        return turns
    rig, _ = pd.factorize(session.rigs["rig_id"])
    sensor = pd.Index(sensors).get_indexer(session.rigs["sensor_id"].to_numpy(object))
    rotations = session.rig_from_sensor_table[:, :3, :3]
    known = (sensor >= 0) & (turns[sensor] >= 0)
    up_in_rig = np.zeros((len(np.unique(rig)), 3))
    np.add.at(up_in_rig, rig[known], np.einsum("nij,nj->ni", rotations[known], ups[sensor[known]]))
    up_in_cams = np.einsum("nij,ni->nj", rotations, unit(up_in_rig)[rig])
    unknown = (sensor >= 0) & ~known
    names = sensors.iloc[sensor[unknown]].reset_index(drop=True)
    learned = _TurnsByName.learn(names, up_in_cams[unknown], MAJORITY)
    return np.where(turns < 0, learned.find(sensors)[0], turns)


def _report(session: Session, roles: pd.Series, turns: Ints) -> None:
    """Log the turns of a session in one line; sensors whose ids differ only in long numbers are merged."""
    short = roles.str.replace(r"^[^/]*/", "", regex=True).str.replace(r"\d{4,}", "*", regex=True)
    table = pd.DataFrame({"sensor": short, "turns": turns})
    texts = {-1: "unknown, not turned", 0: "upright already"}
    parts = []
    for turn, group in table.groupby("turns"):
        counts = group["sensor"].value_counts().sort_index()
        names = [f"{name} ({count})" if count > 1 else str(name) for name, count in counts.items()]
        shown = ", ".join(names[:6]) + (f", ... {len(names) - 6} more" if len(names) > 6 else "")
        parts.append(f"{texts.get(int(turn), f'turned by {90 * int(turn)} degrees counter-clockwise')}: {shown}")
    log.info("Upright: %s: %s.", session.id, "; ".join(parts) or "no images")
