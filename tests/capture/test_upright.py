import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from toolkit.capture import Capture, Session, Trajectory, write_session
from toolkit.capture.images import turned_from_cam
from toolkit.capture.session import IMPORT_RECORD
from toolkit.capture.upright import estimate_world_up, quarter_turns, up_of_cameras
from toolkit.errors import CaptureError
from toolkit.files import write_text
from toolkit.geometry import invert, make_pose

# Simulated captures: a world with z up, then turned as a whole


def _pose(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Return world_from_cam in a world with z up; `roll` quarter turns ccw of its image make it upright."""
    a, b, c = np.radians([heading, pitch, roll])
    forward = np.array([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
    right = np.array([np.sin(a), -np.cos(a), 0])
    down = np.cross(forward, right)
    # Up is along (sin c, -cos c) in the image: at the right side for c = 90.
    axes = np.stack([np.cos(c) * right - np.sin(c) * down, np.cos(c) * down + np.sin(c) * right, forward], -1)
    return make_pose(axes, np.zeros(3))


def test_the_simulated_camera_needs_the_quarter_turns_it_is_made_for() -> None:
    for k in range(4):
        up_in_turned = turned_from_cam(k)[:3, :3] @ _pose(40, 0, 90 * k)[:3, :3].T @ [0, 0, 1]
        np.testing.assert_allclose(up_in_turned, [0, -1, 0], atol=1e-12)


Frame = tuple[str, np.ndarray]  # sensor id, world_from_cam


def _frames(
    sensor: str,
    k: int,
    count: int = 30,
    headings: float = 180,
    pitch: float = 0,
    noise: float = 4,
    odd: Sequence[int] = (),
    seed: int = 0,
) -> list[Frame]:
    """Return frames of a camera that needs k turns, but odd[i] in its first ones; `*` in the id is the number."""
    rng = np.random.default_rng([seed, k, len(sensor)])
    frames = []
    for i in range(count):
        turns = odd[i] if i < len(odd) else k
        pose = _pose(rng.uniform(-headings, headings), *rng.normal([pitch, 90 * turns], noise))
        pose[:3, 3] = *rng.uniform(-5, 5, 2), rng.normal(1.6, 0.1)
        frames.append((sensor.replace("*", str(630000000000 + 1000 * i)), pose))
    return frames


Write = Callable[..., Session]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a session of free cameras; `posed=False` is a query session."""

    def write(
        name: str,
        frames: Sequence[Frame],
        posed: bool = True,
        world: np.ndarray | None = None,
        names: dict[str, str] | None = None,
    ) -> Session:
        pinhole = ("camera", "PINHOLE", 64, 48, 50.0, 50.0, 32.0, 24.0)
        ids = [sensor for sensor, _ in frames]
        times = range(1, len(frames) + 1)
        poses = np.array([pose for _, pose in frames]).reshape(-1, 4, 4)
        if world is not None:
            poses = world @ poses
        return Session.open(
            write_session(
                tmp_path / "SCENE" / "sessions" / name,
                [(sensor, (names or {}).get(sensor, ""), *pinhole) for sensor in dict.fromkeys(ids)],
                None,
                Trajectory.from_poses(list(times), ids, poses) if posed else None,
                [(time, sensor, f"r/{time}.jpg") for time, sensor in zip(times, ids, strict=True)],
            )
        )

    return write


def _angle(a: np.ndarray, b: Any) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ np.asarray(b, float), -1, 1))))


TILTED = make_pose(cv2.Rodrigues(np.array([1.1, -0.7, 0.4]))[0], np.array([5.0, 6.0, 7.0]))


@pytest.mark.parametrize("world", [np.eye(4), TILTED], ids=["z up", "tilted"])
@pytest.mark.parametrize(
    "frames",
    [
        _frames("r/cam", 0),
        _frames("r/cam", 0, headings=8),
        _frames("r/cam", 0, pitch=-40),
        _frames("r/cam", 0, pitch=-40, headings=30),
        _frames("r/cam", 0, count=3, noise=2),
        _frames("r/cam", 0, count=1, noise=1),
        _frames("r/up", 0) + _frames("r/up2", 0, seed=3) + _frames("r/roll", 1) + _frames("r/below", 2),
        _frames("r/up", 0, headings=10) + _frames("r/b", 0, headings=10) + _frames("r/rolled", 3, headings=10),
        _frames("r/cam_*", 0, count=40, odd=[1] * 12),
        _frames("r/cam_*", 1, count=40, odd=[0] * 12),
        [*_frames("r/cam", 0), ("r/stray", _pose(10, -90, 20)), ("r/stray2", _pose(50, 90, 70))],
        [*_frames("r/cam", 0, count=4, noise=2), ("r/stray", _pose(10, -89, 0))],
    ],
    ids=[
        *("upright", "one heading", "pitched", "pitched, few headings", "three", "one", "four mounts"),
        *("a mount and one heading", "landscape phones", "portrait phones", "strays", "few and a stray"),
    ],
)  # fmt: skip
def test_world_up_is_found(write: Write, frames: list[Frame], world: np.ndarray) -> None:
    up = estimate_world_up([write("ios_map", frames, world=world)])
    assert up.known
    assert np.linalg.norm(up.direction) == pytest.approx(1)
    assert _angle(up.direction, world[:3, 2]) < 10


def test_world_up_of_many_images_is_exact_to_a_few_degrees(write: Write) -> None:
    frames = _frames("r/a", 0, count=200) + _frames("r/b", 1, count=200, pitch=-30, odd=[3] * 40)
    assert _angle(estimate_world_up([write("hl_map", frames, world=TILTED)]).direction, TILTED[:3, 2]) < 1.5


@pytest.mark.parametrize("headings", [3, 180])
def test_a_drone_that_looks_straight_down_does_not_tell_where_up_is(write: Write, headings: float) -> None:
    up = estimate_world_up([write("ios_map", _frames("r/cam", 0, pitch=-88, headings=headings, noise=2))])
    assert not up.known
    assert up.direction.tolist() == [0, 0, 1]
    assert "straight down, if z is up" in up.reason
    session = write("ios_map", _frames("r/cam", 0, pitch=-88, headings=headings, noise=2))
    for made, known in (("by the cameras", False), ("by GPS in EXIF", True)):
        write_text(session.path / IMPORT_RECORD, json.dumps({"up": f"z, {made}", "z is up": known}))
        assert estimate_world_up([session]).known == known
        assert made in estimate_world_up([session]).reason or not known
    poses = np.array([pose for _, pose in _frames("r/cam", 0, pitch=-88, headings=headings, noise=2)])
    assert up_of_cameras(poses).tolist() == [0, 0, 1]


def test_all_cameras_rolled_leave_the_sign_to_a_guess(write: Write) -> None:
    up = estimate_world_up([write("hl_map", _frames("r/a", 1))])
    assert not up.known
    assert "guess" in up.reason
    assert "+z" in up.reason
    assert _angle(up.direction, [0, 0, 1]) < 5
    up = estimate_world_up([write("hl_map", _frames("r/a", 1), world=TILTED)])
    assert not up.known
    assert "+z" not in up.reason
    assert min(_angle(up.direction, TILTED[:3, 2]), _angle(-up.direction, TILTED[:3, 2])) < 5


def test_many_images_of_many_sessions_are_sampled_over_all_cameras(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("toolkit.capture.upright.MAX_IMAGES", 30)
    # Every third image is of the rolled camera: a plain stride of 3 would see no other.
    a, b, c = (_frames(f"r/{name}", k, count=60, seed=k) for name, k in (("a", 1), ("b", 0), ("c", 0)))
    mixed = [frame for triple in zip(a, b, c, strict=True) for frame in triple]
    up = estimate_world_up([write("hl_map", mixed), write("spot_map", mixed)])
    assert up.known
    assert "60 images" in up.reason
    assert _angle(up.direction, [0, 0, 1]) < 5


# Turns


def test_turns_follow_the_mount_of_each_camera(write: Write) -> None:
    frames = [frame for k in range(4) for frame in _frames(f"r/cam{k}", k, odd=[2, 1, 0], pitch=-35)]
    frames += _frames("r/cam0b", 0)
    hl_map = write("hl_map", frames, world=TILTED)
    turns = quarter_turns([hl_map])
    expected = [int(sensor[5]) for sensor, _ in frames]
    assert turns.of(hl_map).tolist() == expected
    assert turns.of(hl_map).dtype == np.int64
    assert turns.of(hl_map, [31, 0, 95]).tolist() == [1, 0, 3]
    assert turns.of(hl_map, slice(28, 32)).tolist() == [0, 0, 1, 1]
    assert turns.of(hl_map, np.array([], int)).tolist() == []
    # A query of another recording: the ids differ before the slash.
    query = write("hl_query", [("q/cam3", np.eye(4)), ("q/x/cam1", np.eye(4))], posed=False)
    assert turns.of(query).tolist() == [3, 1]


def test_turned_images_have_up_at_the_top(write: Write) -> None:
    frames = _frames("r/a", 0) + _frames("r/b", 3, pitch=20) + _frames("r/c", 2) + _frames("r/d", 0, seed=1)
    session = write("hl_map", frames, world=TILTED)
    turns = quarter_turns([session])
    world_from_turned = session.world_from_cam() @ invert(turned_from_cam(turns.of(session)))
    up_in_turned = np.einsum("nij,i->nj", world_from_turned[:, :3, :3], TILTED[:3, 2])
    assert np.all(up_in_turned[:, 1] < -0.8)


def test_all_rolled_with_world_up_given_or_guessed(write: Write) -> None:
    rolled = write("hl_map", _frames("r/a", 1))
    assert set(quarter_turns([rolled], [0, 0, 2.5]).of(rolled)) == {1}
    assert set(quarter_turns([rolled], [0, 0, -1]).of(rolled)) == {3}
    assert set(quarter_turns([rolled]).of(rolled)) == {1}
    assert set(quarter_turns([rolled], [0, 0, -0.1]).of(rolled)) == {3}


def test_phones_are_turned_each_in_the_map_and_by_majority_in_queries(write: Write) -> None:
    frames = _frames("r/cam_phone_*", 1, count=20, odd=[0] * 6)
    ios_map = write("ios_map", [*frames, ("r/cam_phone_down", _pose(0, -90, 0))])
    turns = quarter_turns([ios_map], [0, 0, 1])
    assert turns.of(ios_map).tolist() == [0] * 6 + [1] * 14 + [1]  # the last says nothing: as most
    query = write("ios_query", [("q/cam_phone_9", np.eye(4)), ("q/cam_phone_8", np.eye(4))], posed=False)
    assert turns.of(query).tolist() == [1, 1]


def test_phones_without_a_clear_majority_are_left(write: Write, caplog: pytest.LogCaptureFixture) -> None:
    ios_map = write("ios_map", _frames("r/cam_phone_*", 1, count=20, odd=[0] * 9))
    turns = quarter_turns([ios_map], [0, 0, 1])
    query = write("ios_query", [("q/cam_phone_123456789", np.eye(4))], posed=False)
    with caplog.at_level(logging.INFO, "toolkit.capture.upright"):
        assert turns.of(query).tolist() == [0]
        turns.of(query)
    lines = [line for line in caplog.messages if "ios_query" in line]
    assert lines == ["Upright: ios_query: unknown, not turned: cam_phone_*."]


def test_a_camera_is_known_by_its_name(write: Write) -> None:
    frames = _frames("r/1", 0) + _frames("r/2", 1)
    turns = quarter_turns([write("hl_map", frames, names={"r/1": "left", "r/2": "right"})], [0, 0, 1])
    names = {"q/8": "right", "q/9": "left", "q/7": ""}
    query = write("hl_query", [(sensor, np.eye(4)) for sensor in names], posed=False, names=names)
    assert turns.of(query).tolist() == [1, 0, 0]


def test_a_device_without_a_map_is_not_turned(write: Write, caplog: pytest.LogCaptureFixture) -> None:
    turns = quarter_turns([write("hl_map", _frames("r/cam", 1))], [0, 0, 1])
    # The same short id, but another kind of device.
    query = write("spot_query", [("q/cam", np.eye(4))], posed=False)
    with caplog.at_level(logging.INFO, "toolkit.capture.upright"):
        assert turns.of(query).tolist() == [0]
    assert "unknown, not turned: cam." in caplog.text


def test_an_unknown_camera_follows_from_its_rig(tmp_path: Path) -> None:
    pinhole = ("camera", "PINHOLE", 64, 48, 50.0, 50.0, 32.0, 24.0)
    # In the rig's frame z is up; the rig is pitched in the world, so an upright camera is not one in the rig.
    rig = {"a": _pose(0, -30, 0), "b": _pose(90, -25, 90), "c": _pose(-90, 10, 180)}

    def session(name: str, cameras: str, posed: bool) -> Session:
        times, prefix = range(1, 9), name
        world = [make_pose(_pose(40 * t, 0, 0)[:3, :3] @ _pose(0, 0, 0)[:3, :3].T, [t, 0, 0]) for t in times]
        return Session.open(
            write_session(
                tmp_path / name,
                [(f"{prefix}/{c}", "", *pinhole) for c in cameras],
                [(f"{prefix}/rig{t}", f"{prefix}/{c}", rig[c]) for t in times for c in cameras],
                Trajectory.from_poses(list(times), [f"{prefix}/rig{t}" for t in times], world) if posed else None,
                [(t, f"{prefix}/{c}", f"{c}/{t}.jpg") for t in times for c in cameras],
            )
        )

    turns = quarter_turns([session("hl_map", "a", True)], [0, 0, 1])
    assert turns.of(session("hl_query", "bac", False))[:3].tolist() == [1, 0, 2]


def test_without_poses_nothing_is_turned_and_a_warning_says_so(write: Write, caplog: pytest.LogCaptureFixture) -> None:
    session = write("hl_map", _frames("r/a", 1, count=4), posed=False)
    for sessions, named in (([session], "world_up"), ([], "none")):
        with pytest.raises(CaptureError, match=named):
            estimate_world_up(sessions)
    for up in (None, [0, 0, 1]):
        caplog.clear()
        turns = quarter_turns([session], up)
        assert "no image is turned" in caplog.text
        assert turns.of(session).tolist() == [0] * 4
    assert quarter_turns([]).of(session).tolist() == [0] * 4


def test_images_without_pose_take_the_turn_of_their_sensor(tmp_path: Path, write: Write) -> None:
    frames = _frames("r/a", 1, count=8)
    session = write("hl_map", frames)
    session.trajectory = session.ground_truth = Trajectory.from_poses(
        [1, 2, 3], ["r/a"] * 3, [p for _, p in frames[:3]]
    )
    session.__dict__.pop("_devices", None)
    assert np.isnan(session.world_from_cam([7])).all()
    assert quarter_turns([session], [0, 0, 1]).of(session).tolist() == [1] * 8


def test_a_world_up_of_any_length_is_made_unit() -> None:
    up = quarter_turns([], [0, 3, -4]).world_up
    assert up is not None
    np.testing.assert_allclose(up.direction, [0, 0.6, -0.8])


def test_the_fingerprint_changes_with_the_turns_of_the_sessions_alone(write: Write) -> None:
    session, query = write("hl_map", _frames("r/a", 0) + _frames("r/b", 1)), write("hl_query", _frames("q/b", 1))
    one, again = quarter_turns([session]), quarter_turns([Session.open(session.path)])
    assert one.fingerprint([session]) == again.fingerprint([session]) != one.fingerprint([session, query])
    # A phone in the map changes what is known, not how this session is turned.
    more = quarter_turns([session, write("ios_map", _frames("r/p*", 0, count=5))])
    assert more.fingerprint([session]) == one.fingerprint([session])
    assert quarter_turns([session], [0, 0, -1]).fingerprint([session]) != one.fingerprint([session])


# Rendered and real captures


def test_up_and_turns_of_the_rendered_capture(small_capture: Path) -> None:
    capture = Capture.open(small_capture)
    maps = [capture[name] for name in capture if name.endswith("_map")]
    up = estimate_world_up(maps)
    assert up.known
    assert _angle(up.direction, [0, 0, 1]) < 3
    turns = quarter_turns(maps)
    for name in capture:
        rolled = capture[name].images["sensor_id"].str.endswith("/hetrf").to_numpy(bool)
        assert turns.of(capture[name]).tolist() == np.where(rolled, 3, 0).tolist()
        assert rolled.any() == name.startswith("hl")


@pytest.mark.parametrize("scene", ["STRECHA", "STRECHA_HARD"])
def test_up_and_turns_of_real_captures(captures_root: Path, scene: str) -> None:
    capture = Capture.open(captures_root / scene)
    maps = [capture[name] for name in capture if name.endswith("_map")]
    for sessions in (maps, *([session] for session in maps)):
        up = estimate_world_up(sessions)
        assert up.known
        assert _angle(up.direction, [0, 0, -1]) < 3
    turns = quarter_turns(maps)
    for name in capture:
        session = capture[name]
        rolled = session.images["sensor_id"].str.endswith("/hetrf").to_numpy(bool)
        # Seen in the pictures: the walls of hetrf lie on their right side, so they need a turn clockwise.
        assert turns.of(session).tolist() == np.where(rolled, 3, 0).tolist()
        # As the queries' true poses say, which were not used.
        poses = session.world_from_cam(ground_truth=True) @ invert(turned_from_cam(turns.of(session)))
        assert np.all(poses[np.isfinite(poses[:, 0, 0]), 2, 1] > 0.7)
