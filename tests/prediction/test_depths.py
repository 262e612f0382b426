"""Depth maps of a capture, as its photographs see them: rendered, with exact poses, against the rendered truth."""

import logging
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.capture import Session, Trajectory, read_depth, write_depth, write_session
from toolkit.prediction.depths import MAX_OFFSET_US, DepthMaps, SeenDepth
from toolkit.synthetic.render import Rays, Scene, paint, render

Floats = NDArray[np.float64]

PHOTO = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[260.0, 262.0, 161.0, 119.0])
DEPTH = pycolmap.Camera(model="SIMPLE_PINHOLE", width=160, height=120, params=[100.0, 80.5, 61.0])
RIG_FROM_CAM = geometry.make_pose(Rotation.from_euler("xyz", [1, -2, 3], degrees=True).as_matrix(), [0.02, 0, 0.01])
RIG_FROM_DEPTH = geometry.make_pose(Rotation.from_euler("xyz", [4, 3, -6], degrees=True).as_matrix(), [-0.1, 0.05, 0])
TIME, OFFSET = 1_000_000, 40_000


@dataclass
class Recorded:
    """A session of one photograph, and the true depth of its pixels."""

    session: Session
    depth_m: Floats


def plain(rng: np.random.Generator, h: int, w: int, ppm: float) -> NDArray[np.uint8]:
    return np.full((h, w, 3), 128, np.uint8)


@lru_cache
def furnished() -> Scene:
    """A wall, a floor, and two boards before the wall."""
    scene = Scene(np.zeros(3), (12.0, 12.0, 6.0), False)
    scene.plate((-5, 4, 4), (1, 0, 0), (0, 0, -1), 10, 4, plain, 16)
    scene.plate((-5, 4, 0), (1, 0, 0), (0, -1, 0), 10, 8, plain, 16)
    scene.plate((-1.2, 2.5, 2.4), (1, 0, 0), (0, 0, -1), 0.8, 1.2, plain, 16)
    scene.plate((0.3, 3.0, 2.0), (0.8, 0.6, 0), (0, 0, -1), 1.0, 1.5, plain, 16)
    for number in range(len(scene.quads)):
        paint(scene, 0, 0, number)
    return scene


def moving(share: float) -> Floats:
    """Return world_from_rig of a device that turns and walks, `share` of the way between two poses."""
    turn = Rotation.from_euler("z", 10 * share, degrees=True).as_matrix()
    look = Rotation.from_euler("x", -90, degrees=True).as_matrix()  # z up in the world, y down in a camera
    return geometry.make_pose(turn @ look, [0.2 * share - 0.5, 0.1 * share - 0.5, 1.5])


def record(path: Path, offset_us: int = OFFSET, posed: bool = False, poses: bool = True) -> Recorded:
    """Render a session whose depth sensor has its own size, place and time.

    The rig has poses at 1 s and at 1.2 s, and at the depth map's time only if `posed`.
    """
    room = furnished()
    times = [TIME, TIME + 200_000] + ([TIME + offset_us] if posed else [])
    shares = [(time - TIME) / 200_000 for time in times]
    trajectory = Trajectory.from_poses(times, ["rig"] * len(times), np.stack([moving(share) for share in shares]))
    params = [(c.model.name, c.width, c.height, *c.params) for c in (PHOTO, DEPTH)]
    write_session(
        path,
        sensors=[("cam", "", "camera", *params[0]), ("tof", "", "depth", *params[1])],
        rigs=[("rig", "cam", RIG_FROM_CAM), ("rig", "tof", RIG_FROM_DEPTH)],
        trajectory=trajectory if poses else None,
        images=[(TIME, "cam", "1.jpg")],
        depths=[(TIME + offset_us - 3_000_000, "tof", "old.png"), (TIME + offset_us, "tof", "d.png")],
    )
    _, seen = render(room.quads, moving(offset_us / 200_000) @ RIG_FROM_DEPTH, Rays.of(DEPTH), gray=True)
    write_depth(path / "raw_data" / "d.png", seen)
    _, depth = render(room.quads, moving(0.0) @ RIG_FROM_CAM, Rays.of(PHOTO), gray=True)
    return Recorded(Session.open(path), depth.astype(np.float64))


def relative_errors(seen: SeenDepth, depth_m: Floats) -> Floats:
    """Return |found / true - 1| at points, by the true depth of the pixel that each is in."""
    column, row = seen.pixels.astype(int).T
    true = depth_m[row, column]
    return np.abs(seen.depth_m / np.where(true > 0, true, np.nan) - 1)


@pytest.mark.parametrize("posed", [True, False])
def test_depth_of_another_sensor_is_that_of_the_photograph(tmp_path: Path, posed: bool) -> None:
    """Another size, place and time; the pose at that time is given, or lies between two."""
    made = record(tmp_path / "ios_map", posed=posed)
    seen = DepthMaps(made.session).of(0)
    assert seen.reason == ""
    assert len(seen) > 3000
    errors = relative_errors(seen, made.depth_m)
    assert np.nanmedian(errors) < 0.005
    assert np.nanmean(errors < 0.02) > 0.97
    grid = np.stack(np.meshgrid(np.arange(2, 320, 6) + 0.5, np.arange(2, 240, 6) + 0.5), -1).reshape(-1, 2)
    at = seen.at(grid)
    true = made.depth_m[grid[:, 1].astype(int), grid[:, 0].astype(int)]
    known = np.isfinite(at) & (true > 0)
    assert known.mean() > 0.4
    assert np.median(np.abs(at[known] / true[known] - 1)) < 0.002
    assert np.mean(np.abs(at[known] / true[known] - 1) < 0.02) > 0.98


def test_without_the_sensors_own_time_depth_would_be_wrong(tmp_path: Path) -> None:
    """The check above tells a pose at the photograph's time from one at the depth map's."""
    made = record(tmp_path / "ios_map")
    maps = DepthMaps(made.session)
    maps._track_of = lambda _: (np.array([TIME + OFFSET]), (moving(0.0) @ RIG_FROM_DEPTH)[None])
    assert np.nanmean(relative_errors(maps.of(0), made.depth_m) < 0.02) < 0.9


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"offset_us": MAX_OFFSET_US + 1}, "no depth map of this image"),
        ({"offset_us": -OFFSET}, "has no pose at that time"),
        ({"poses": False}, "has no pose at that time"),
    ],
)
def test_depth_that_cannot_be_placed_is_left_out(tmp_path: Path, settings: dict, reason: str) -> None:
    made = record(tmp_path / "ios_map", **settings)
    seen = DepthMaps(made.session).of(0)
    assert len(seen) == 0
    assert reason in seen.reason
    assert np.isnan(seen.at([[10, 10]])).all()


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda path: path.unlink(), "no such file"),
        (lambda path: path.write_bytes(b"torn"), "not a 16-bit image"),
        (lambda path: cv2.imwrite(str(path), np.ones((120, 160), np.uint8)), "not a 16-bit image"),
        (lambda path: cv2.imwrite(str(path), np.ones((60, 80), np.uint16)), "80 x 60 pixels, expected 160 x 120"),
    ],
)
def test_a_bad_depth_map_is_left_out_with_a_reason(
    tmp_path: Path, spoil: object, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    made = record(tmp_path / "ios_map")
    spoil(tmp_path / "ios_map" / "raw_data" / "d.png")  # type: ignore[operator]
    with caplog.at_level(logging.WARNING):
        maps = DepthMaps(made.session)
        seen = maps.of(0)
        maps.of.cache_clear()
        maps.of(0)
    assert len(seen) == 0
    assert reason in seen.reason
    assert caplog.text.count(reason) == 1, "said once"


def test_the_nearest_hides_what_is_behind_it(tmp_path: Path) -> None:
    """A sensor beside the camera sees a wall behind a board that hides it from the camera."""
    write_session(
        tmp_path / "hl_map",
        sensors=[("cam", "", "camera", "PINHOLE", 100, 100, 100, 100, 50, 50),
                 ("tof", "", "depth", "PINHOLE", 100, 100, 100, 100, 50, 50)],
        rigs=[("rig", "cam", np.eye(4)), ("rig", "tof", geometry.make_pose(np.eye(3), [0.5, 0, 0]))],
        trajectory=Trajectory.from_poses([5], ["rig"], np.eye(4)[None]),
        images=[(5, "cam", "1.jpg")],
        depths=[(5, "tof", "d.png")],
    )  # fmt: skip
    depth = np.full((100, 100), 4.0)
    depth[:, :20] = 1.0  # the board, x from 0 to 0.2 m at 1 m: columns 50 to 70 of the camera
    write_depth(tmp_path / "hl_map" / "raw_data" / "d.png", depth)
    seen = DepthMaps(Session.open(tmp_path / "hl_map")).of(0)
    behind = (seen.pixels[:, 0] > 51) & (seen.pixels[:, 0] < 69)
    assert behind.sum() > 700
    np.testing.assert_allclose(seen.depth_m[behind], 1.0)
    np.testing.assert_allclose(seen.at([[60, 50], [90, 50]]), [1, 4], rtol=1e-3)
    assert np.isnan(seen.at([[10, 50]])).all(), "no depth is known there"


@pytest.mark.parametrize("sensor", ["s/cam_phone_7", "render/s/cam_phone_7", "s/depth_phone_7"])
def test_depth_maps_of_the_photograph_itself(tmp_path: Path, sensor: str) -> None:
    """Rendered ones have the photograph's sensor, with or without a prefix; a phone's the same place."""
    sensors = [("s/cam_phone_7", "", "camera", "PINHOLE", 64, 48, 50, 50, 32, 24)]
    if sensor == "s/depth_phone_7":
        sensors.append((sensor, "", "depth", "PINHOLE", 32, 24, 25, 25, 16, 12))
    write_session(tmp_path / "ios_map", sensors, None, None, [(7, "s/cam_phone_7", "7.jpg")], [(7, sensor, "7.png")])
    write_depth(tmp_path / "ios_map" / "raw_data" / "7.png", np.tile(np.linspace(2, 3, 32), (24, 1)))
    seen = DepthMaps(Session.open(tmp_path / "ios_map")).of(0)
    assert len(seen) > 300
    np.testing.assert_allclose(seen.at([[32, 24]]), [2.5], rtol=2e-3)
    write_depth(tmp_path / "ios_map" / "raw_data" / "7.png", np.ones((30, 30)))
    seen = DepthMaps(Session.open(tmp_path / "ios_map")).of(0)
    assert "30 x 30 pixels" in seen.reason


def test_a_session_without_depth_maps(tmp_path: Path) -> None:
    write_session(tmp_path / "ios_map", [("c", "", "camera", "SIMPLE_PINHOLE", 8, 6, 5, 4, 3)], None, None,
                  [(1, "c", "1.jpg")])  # fmt: skip
    seen = DepthMaps(Session.open(tmp_path / "ios_map")).of(0)
    assert seen.reason == "no depth map of this image"


def test_the_largest_number_of_a_depth_map_is_unknown(tmp_path: Path) -> None:
    """As in 7-Scenes."""
    cv2.imwrite(str(tmp_path / "depth.png"), np.array([[0, 1], [65534, 65535]], np.uint16))
    np.testing.assert_allclose(read_depth(tmp_path / "depth.png"), [[0, 0.001], [65.534, 0]], atol=1e-6)
