"""Find the number of quarter turns that make the images of each sensor upright, with gravity pointing down.

Headset and robot cameras are mounted rotated, and phones store portrait photographs in landscape. Networks trained on
upright photographs expect upright images. `k` is always the number of COUNTER-CLOCKWISE quarter turns of the image, as
in `np.rot90`.

    turns = quarter_turns([capture["hl_map"], capture["ios_map"]], world_up=None)
    k = turns.of(capture["hl_query"])
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.folder import Capture
from toolkit.capture.session import Rows, Session
from toolkit.capture.world_up import WorldUp, estimate_world_up, posed_photographs, sensor_names
from toolkit.files import fingerprint
from toolkit.geometry import Floats, Ints, unit
from toolkit.threads import fixed_sums

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
        world_from_cam, rows = posed_photographs(session)
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


def upright_turns(capture: Capture, world_up: ArrayLike | None = None) -> Turns:
    """Return the turns according to all map sessions of a capture; see `quarter_turns`."""
    return quarter_turns(capture.usable("map"), world_up)


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


def turn_image(image: NDArray[Any], k: int) -> NDArray[Any]:
    """Return an image (H, W) or (H, W, 3) after k counter-clockwise quarter turns, contiguous; itself for k = 0."""
    import cv2

    codes = (cv2.ROTATE_90_COUNTERCLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_CLOCKWISE)
    image = np.ascontiguousarray(image)
    return image if k % 4 == 0 else cv2.rotate(image, codes[k % 4 - 1])


def turn_points(xy: ArrayLike, width: int, height: int, k: int) -> Floats:
    """Return the pixel positions (N, 2) after k quarter turns of an image of this size, (N, 2).

    The center of the top-left pixel is (0.5, 0.5), before and after.
    """
    x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
    turned = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)][k % 4]
    return np.stack(turned, axis=-1)


def turned_from_cam(k: ArrayLike) -> Floats:
    """Return turned_from_cam, (..., 4, 4), of k quarter turns (...): from the camera's coordinates to the turned one's.

    The pose of a turned image is world_from_cam @ invert(turned_from_cam(k)).
    """
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, 1], [-1, 0]]  # right becomes up (-y)
    return np.stack([np.linalg.matrix_power(quarter, turn) for turn in range(4)])[np.asarray(k) % 4]
