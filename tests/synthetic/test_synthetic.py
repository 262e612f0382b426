"""The rendered capture: is it exact, deterministic, whole, and what it says it is?"""

import hashlib
import json
import os
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pycolmap
import pytest

from benchmarks.common import scaled
from toolkit.capture import Capture, read_depth
from toolkit.capture import images as capture_images
from toolkit.capture.check import check_capture
from toolkit.capture.images import read_image
from toolkit.errors import CaptureError, ImageError, ManifestError
from toolkit.geometry import invert, make_pose, rotation_angle_deg, transform
from toolkit.synthetic import capture as capture_writing
from toolkit.synthetic import render_capture, textures
from toolkit.synthetic.capture import (
    DEVICES,
    HARD,
    WRONG_FOCAL,
    Emitter,
    Sensor,
    World,
    emitters_of,
    looking,
    odometry_of,
    received,
    scans,
    walks,
)
from toolkit.synthetic.render import Quad, Rays, Scene, build_room, named_rng, paint, render


def coarse_room(seed: int, index: int, look: int | None = None) -> Scene:
    """A room whose textures have few texels, so that a capture is rendered in seconds."""
    scene = build_room(seed, index, look)
    for quad in scene.quads:
        quad.ppm /= 4
    return scene


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of a coarse room, two frames a session: for what does not depend on what is in the pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture_writing, "build_room", coarse_room)
        return render_capture(tmp_path_factory.mktemp("synthetic") / "TINY", 1, 2, seed=3, progress=False)


def checker(rng: np.random.Generator, h: int, w: int, ppm: float) -> np.ndarray:
    """Squares of 32 texels."""
    y, x = np.mgrid[0:h, 0:w] // 32
    return np.repeat(((x + y) % 2 * 200 + 30).astype(np.uint8)[..., None], 3, axis=2)


def looking_at_wall() -> tuple[Scene, np.ndarray]:
    """A wall of 3.2 x 3.2 m with squares of 0.2 m, and a camera that sees it askew."""
    scene = Scene(np.zeros(3), (9.0, 9.0, 9.0), False)
    scene.plate((-1.6, 4.0, 1.6), (1, 0, 0), (0, 0, -1), 3.2, 3.2, checker, 160)
    paint(scene, 0, 0, 0)
    return scene, make_pose(looking(76.0, 4.0, 9.0), (-0.3, 0.4, 0.1))


@pytest.mark.parametrize("sensor", [s for d in DEVICES.values() for s in d.sensors], ids=lambda s: s.name)
def test_texture_corners_appear_where_the_camera_projects_them(sensor: Sensor) -> None:
    camera = pycolmap.Camera(
        model=sensor.model, width=sensor.size[0], height=sensor.size[1], params=list(sensor.params)
    )
    scene, world_from_cam = looking_at_wall()
    picture, depth = render(scene.quads, world_from_cam, Rays.of(camera), gray=True)
    a, b = np.meshgrid(np.arange(3, 14), np.arange(3, 14))
    corners = np.stack([-1.6 + 0.2 * a.ravel(), np.full(a.size, 4.0), 1.6 - 0.2 * b.ravel()], -1)
    in_cam = transform(invert(world_from_cam), corners)
    expected = np.asarray(camera.img_from_cam(in_cam))
    inside = ((expected > 14) & (expected < np.array(sensor.size) - 14)).all(1)
    assert inside.sum() > 40
    # OpenCV counts the center of the first pixel as 0; it starts a pixel away and must come back.
    start = np.ascontiguousarray((expected[inside] - 0.5 + 0.7)[:, None], np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    found = cv2.cornerSubPix(picture, start, (5, 5), (-1, -1), criteria)[:, 0] + 0.5
    error = found - expected[inside]
    assert np.abs(np.median(error, axis=0)).max() < 0.03
    assert np.abs(error).max() < 0.3
    column, row = expected[inside].astype(int).T
    rays = np.c_[np.asarray(camera.cam_from_img(np.c_[column, row] + 0.5)), np.ones(len(row))]
    on_wall = transform(world_from_cam, rays * depth[row, column, None])
    np.testing.assert_allclose(on_wall[:, 1], 4.0, atol=1e-3)


def test_rectangles_behind_and_across_the_camera_are_clipped() -> None:
    scene = Scene(np.zeros(3), (9.0, 9.0, 9.0), False)
    scene.plate((-4, 4, 0), (1, 0, 0), (0, -1, 0), 8, 8, checker, 60)  # the floor, also behind
    scene.plate((4, -3, 2), (-1, 0, 0), (0, 0, -1), 8, 2, checker, 60)  # a wall behind
    for number in range(2):
        paint(scene, 0, 0, number)
    camera = pycolmap.Camera(model="PINHOLE", width=96, height=72, params=[70, 70, 48, 36])
    world_from_cam = make_pose(looking(90, -20, 0), (0, 0, 1.0))
    picture, depth = render(scene.quads, world_from_cam, Rays.of(camera), gray=False)
    assert picture.shape == (72, 96, 3)
    v = np.arange(72) + 0.5
    down = np.sin(np.radians(20)) + (v - 36) / 70 * np.cos(np.radians(20))  # of the ray of z = 1
    expected = np.where(down > 0.25, 1.0 / np.maximum(down, 1e-3), 0)
    np.testing.assert_allclose(depth[expected > 0, 48], expected[expected > 0], rtol=1e-4)


def test_the_nearer_rectangle_hides_the_farther() -> None:
    scene, world_from_cam = looking_at_wall()
    plain = partial(textures.plain, color=(0, 0, 255))
    scene.plate((-0.2, 2.0, 0.6), (1, 0, 0), (0, 0, -1), 0.5, 0.5, plain, 100)
    paint(scene, 0, 0, 1)
    camera = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[260, 260, 160, 120])
    picture, depth = render(scene.quads, world_from_cam, Rays.of(camera), gray=False)
    middle = transform(invert(world_from_cam), np.array([[0.05, 2.0, 0.35]]))
    column, row = np.asarray(camera.img_from_cam(middle))[0].astype(int)
    assert picture[row, column].tolist() == [0, 0, 255]
    assert depth[row, column] == pytest.approx(middle[0, 2], abs=0.02)


def test_the_brightness_of_a_rectangle_follows_from_its_normal_but_lamps_and_the_sky_shine() -> None:
    gray = partial(textures.plain, color=(100, 100, 100))
    floor, ceiling = ((1, 0, 0), (0, -1, 0)), ((1, 0, 0), (0, 1, 0))
    to_x, to_y = ((0, 1, 0), (0, 0, -1)), ((-1, 0, 0), (0, 0, -1))  # normals x and y
    for (right, down), brightness in {floor: 1.0, ceiling: 0.7, to_x: 0.93, to_y: 0.7}.items():
        scene = Scene(np.zeros(3), (9.0, 9.0, 9.0), False)
        for material in (gray, textures.lamp, textures.clouds):
            scene.plate((3, 2, 1), right, down, 1, 1, material, 64)
            paint(scene, 0, 0, len(scene.quads) - 1)
        plain, lamp, sky = (quad.color[0] for quad in scene.quads)
        assert np.unique(plain).tolist() == [round(100 * brightness)]
        assert lamp[32, 32].tolist() == [250, 250, 250]
        assert np.array_equal(sky, textures.clouds(named_rng(0, 0, "quad", 2), 64, 64, 64))


def test_two_views_agree_through_depth_and_poses(small_capture: Path) -> None:
    capture = Capture.open(small_capture)
    for name in ("ios_map", "spot_map", "hl_map"):
        session = capture[name]
        poses = session.world_from_cam()
        step = len(DEVICES[name.split("_")[0]].sensors)
        first, second = 0, step  # the same camera, one frame later
        rows = session.images.iloc
        cameras = [session.camera(rows[i].sensor_id) for i in (first, second)]
        images = [cv2.imread(str(session.image_path(i)), cv2.IMREAD_GRAYSCALE) for i in (first, second)]
        depths = []
        assert session.depths is not None
        paths = session.depths.set_index(["timestamp", "sensor_id"])["path"]
        for i in (first, second):
            path = paths[rows[i].timestamp, rows[i].sensor_id]
            depths.append(read_depth(session.path / "raw_data" / path))
        h, w = images[0].shape
        u, v = np.meshgrid(np.arange(0, w, 5) + 0.5, np.arange(0, h, 5) + 0.5)
        pixels = np.stack([u.ravel(), v.ravel()], -1)
        z = depths[0][v.astype(int).ravel(), u.astype(int).ravel()]
        points = np.c_[np.asarray(cameras[0].cam_from_img(pixels)) * z[:, None], z]
        seen = transform(invert(poses[second]) @ poses[first], points)
        target = np.asarray(cameras[1].img_from_cam(np.where(seen[:, 2:] > 0.1, seen, 1.0)))
        good = (z > 0) & (seen[:, 2] > 0.1) & (target > 1).all(1) & (target < np.array([w, h]) - 1).all(1)
        column, row = target[good].astype(int).T
        apart = np.abs(depths[1][row, column] - seen[good, 2])
        unhidden = (depths[1][row, column] > 0) & (apart < 0.05)
        assert unhidden.mean() > 0.7
        assert np.median(apart[unhidden]) < 0.01
        where = target[good][unhidden].astype(np.float32) - 0.5
        warped = cv2.remap(images[1], where[None, :, 0], where[None, :, 1], cv2.INTER_LINEAR)[0]
        original = images[0][v.astype(int).ravel(), u.astype(int).ravel()][good][unhidden]
        assert np.corrcoef(warped, original)[0, 1] > 0.8


def test_the_format_is_whole(small_capture: Path) -> None:
    capture = Capture.open(small_capture)
    assert capture.session_ids == ["hl_map", "hl_query", "ios_map", "ios_query", "spot_map", "spot_query"]
    for name in capture:
        session, (device, split) = capture[name], name.split("_")
        frames = 6 if split == "map" else 3
        assert len(session.images) == frames * len(DEVICES[device].sensors)
        assert len(session.subsessions) == 2
        assert (session.odometry is None) == (split == "map")
        assert (session.rigs is None) == (device == "ios")
        assert session.ground_truth is not None
        assert len(session.ground_truth) == frames
        assert np.isfinite(session.world_from_cam(ground_truth=True)).all()
        for row in range(len(session.images)):
            camera = session.camera(session.images.sensor_id[row])
            image = cv2.imread(str(session.image_path(row)), cv2.IMREAD_UNCHANGED)
            assert image.shape[:2] == (camera.height, camera.width)
            assert image.ndim == (3 if device == "ios" else 2)
            assert 20 < image.mean() < 230
            assert image.std() > 15
        if split == "query":
            lists = [session.keyframes(n) for n in ("pruned_subsampled", "pruned", "original")]
            keys = [set(zip(table.timestamp, table.device_id, strict=True)) for table in lists]
            assert keys[0] <= keys[1] <= keys[2]
            assert keys[0]
            assert len(keys[2]) == frames


def test_rigs_have_real_baselines_and_a_rolled_camera(small_capture: Path) -> None:
    capture = Capture.open(small_capture)
    for name, low, high in (("hl_map", 0.08, 0.13), ("spot_map", 0.1, 0.35)):
        session = capture[name]
        count = len(DEVICES[name.split("_")[0]].sensors)
        poses = session.rig_from_cam()[:count]
        for i in range(count):
            for j in range(i):
                assert low < np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3]) < high
    left_from_right = (invert(capture["hl_map"].world_from_cam()[0]) @ capture["hl_map"].world_from_cam()[1])[:3, :3]
    assert abs(left_from_right[1, 0]) > 0.9  # the right camera's x axis points down
    focal = {tuple(capture["ios_map"].camera(s).params) for s in capture["ios_map"].images.sensor_id}
    assert len(focal) == 6


def test_queries_are_away_from_the_map_but_see_it() -> None:
    for seed in range(3):
        for index in range(2):
            scene = build_room(seed, index)
            for name in DEVICES:
                paths = walks(scene, seed, index, 12, name)
                mapped = np.concatenate([paths["map", 0], paths["map", 1]])
                query = np.concatenate([paths["query", 0], paths["query", 1]])
                assert (len(mapped), len(query)) == (12, 6)
                distance = np.linalg.norm(query[:, None, :3, 3] - mapped[None, :, :3, 3], axis=-1)
                assert distance.min() > 0.3
                assert distance.min(axis=1).max() < 1.1
                nearest = mapped[distance.argmin(axis=1)]
                angle = rotation_angle_deg((invert(nearest) @ query)[:, :3, :3])
                assert angle.min() > 10
                assert angle.max() < 30
                w, d, _ = scene.size
                local = np.concatenate([mapped, query])[:, :3, 3] - scene.origin
                assert (np.abs(local[:, :2]) < [w / 2 - 0.8, d / 2 - 0.8]).all()
                assert (local[:, 2] > 0.5).all()
                assert (local[:, 2] < 2).all()


def digest(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.slow
def test_same_seed_same_bytes_on_any_number_of_cores(
    coarse: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture_writing, "build_room", coarse_room)
    monkeypatch.setattr(capture_images, "default_workers", lambda: 3 if os.cpu_count() == 1 else 1)
    again = render_capture(tmp_path / "AGAIN", 1, 2, seed=3, progress=False)
    assert digest(again) == digest(coarse)


def test_other_seeds_and_rooms_look_different() -> None:
    def texture(seed: int, index: int) -> np.ndarray:
        scene = build_room(seed, index)
        paint(scene, seed, index, 0)
        return scene.quads[0].gray[3][:30, :30]

    assert not np.array_equal(texture(0, 0), texture(4, 0))  # the same kind of room
    assert not np.array_equal(texture(0, 0), texture(0, 4))


@pytest.mark.slow
def test_a_complete_capture_is_left_as_it_is_and_an_incomplete_one_is_not(
    coarse: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [p.name for p in coarse.parent.iterdir()] == ["TINY"]
    settings = json.loads((coarse / "demo.json").read_text())
    assert (settings["rooms"], settings["frames"], settings["seed"]) == (1, 2, 3)
    out = tmp_path / "C"
    shutil.copytree(coarse, out)

    def started(*_: object, **__: object) -> None:
        raise InterruptedError("renders anew")

    monkeypatch.setattr(capture_writing, "paint", started)
    assert render_capture(out, 1, 2, seed=3, progress=False) == out
    with pytest.raises(InterruptedError):
        render_capture(out, 1, 2, seed=4, progress=False)
    next(out.rglob("*.jpg")).unlink()
    with pytest.raises(InterruptedError):
        render_capture(out, 1, 2, seed=3, progress=False)
    assert (out / "demo.json").exists()  # the old one stays until a new one can take its place


def test_what_was_added_to_a_rendered_capture_is_kept(tmp_path: Path) -> None:
    out = render_bare(tmp_path / "C", 1, 2, seed=1)
    image = next(out.rglob("*.jpg"))
    (out / "sessions" / ".DS_Store").touch()
    before = image.stat().st_ino
    assert render_bare(out, 1, 2, seed=1) == out
    assert image.stat().st_ino == before, "rendered anew"

    added = out / "sessions" / "drone_query" / "images.txt"
    added.parent.mkdir()
    added.write_text("mine")
    assert render_bare(out, 1, 2, seed=1) == out
    for seed in (5, 1):  # another, and that of a capture that lost an image
        with pytest.raises(CaptureError, match=r"would delete sessions/drone_query/images\.txt"):
            render_bare(out, 1, 2, seed=seed)
        image.unlink(missing_ok=True)
    shutil.rmtree(added.parent)
    render_bare(out, 1, 2, seed=1)
    assert image.exists()


def test_a_rendering_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("disk full")

    monkeypatch.setattr(capture_writing, "paint", fail)
    with pytest.raises(RuntimeError):
        render_capture(tmp_path / "C", 1, 2, progress=False)
    assert not list(tmp_path.iterdir())


def render_bare(out: Path, *given: int, **more: Any) -> Path:
    """Render rooms by a phone, quickly: there is one wall in each."""

    def bare_room(seed: int, index: int, look: int | None = None) -> Scene:
        scene = build_room(seed, index, look)
        del scene.quads[1:]
        scene.quads[0].ppm = 20
        return scene

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture_writing, "build_room", bare_room)
        patch.setattr(capture_writing, "DEVICES", {"ios": scaled(DEVICES["ios"], 0.5)})
        return render_capture(out, *given, progress=False, **more)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rooms that look alike: recordings of 60 s, a loss, a gap, and radio."""
    out = tmp_path_factory.mktemp("recorded") / "LONG"
    return render_bare(out, 2, 8, seed=1, alike=True, seconds=60, losses=1, gaps=1, radio=True)


def test_a_recording_has_odometry_between_its_pictures_with_a_loss_and_a_gap(recorded: Path) -> None:
    session = Capture.open(recorded)["ios_query"]
    truth, odometry = session.ground_truth, session.odometry
    assert truth is not None
    assert odometry is not None
    assert np.isfinite(session.world_from_cam(ground_truth=True)).all()
    assert len(session.images) == len(session.keyframes("original")) == 8
    assert not check_capture(recorded).problems
    for recording in session.subsessions:
        rows, true_rows = ([id_.startswith(f"{recording}/") for id_ in one.device_ids] for one in (odometry, truth))
        times, true_times = odometry.timestamps[rows], truth.timestamps[true_rows]
        assert len(true_times) == 300
        assert 59 < np.ptp(true_times) / 1e6 < 60
        gap = np.flatnonzero(np.diff(times) > 1e6)
        assert len(gap) == 1
        assert 3.8 < (times[gap + 1] - times[gap]) / 1e6 < 4.5
        true_poses = truth.lookup(times, odometry.device_ids[rows])
        by_odometry, by_truth = (
            invert(poses[:-1]) @ poses[1:] for poses in (odometry.world_from_device[rows], true_poses)
        )
        off = np.linalg.norm((by_odometry - by_truth)[:, :3, 3], axis=1)
        off = off / np.maximum(np.linalg.norm(by_truth[:, :3, 3], axis=1), 0.1)
        (lost,) = np.flatnonzero(off > 0.5)
        assert np.delete(off, lost).max() < 0.3
        # All drift of a minute is of the size that it has at a pose a picture.
        last = invert(odometry.world_from_device[rows][lost + 1]) @ odometry.world_from_device[rows][-1]
        expected = invert(true_poses[lost + 1]) @ true_poses[-1]
        assert rotation_angle_deg((invert(expected) @ last)[None, :3, :3])[0] < 5
        assert np.linalg.norm((invert(expected) @ last)[:3, 3]) < 2


def test_the_last_room_can_look_as_the_first(recorded: Path) -> None:
    def texture(look: int | None) -> np.ndarray:
        scene = build_room(0, 2, look)
        paint(scene, 0, 2 if look is None else look, 0)
        return scene.quads[0].gray[2]

    assert World(rooms=3, frames=8, alike=True).look(2) == 0
    assert [World(rooms=3, frames=8, alike=True).look(index) for index in range(2)] == [0, 1]
    first, copy = build_room(0, 0), build_room(0, 2, 0)
    away = copy.origin - first.origin
    assert np.linalg.norm(away) > 50
    for one, other in zip(first.quads, copy.quads, strict=True):
        np.testing.assert_allclose(one.corners + away, other.corners, atol=1e-9)
    assert texture(0).shape != texture(None).shape or np.any(texture(0) != texture(None))


def test_radio_fades_with_distance_and_walls_and_tells_rooms(recorded: Path) -> None:
    rng, room = np.random.default_rng(0), build_room(0, 0)
    beacon = Emitter("b", room.origin + np.array([0.0, 0.0, 1.5]), -59.0)
    away = np.array([0.5, 1.0, 2.0, 5.0])
    places = beacon.position + np.stack([away, 0 * away, 0 * away], axis=1)
    levels = np.nanmean([received(rng, [beacon], places, [room])[:, 0] for _ in range(400)], axis=0)
    expected = -59 - 25 * np.log10(away) - [0, 0, 0, 6.9]  # the last is outside
    np.testing.assert_allclose(levels, expected, atol=0.6)
    assert np.isnan(received(rng, [beacon], places + 300.0, [room])).all()
    capture = Capture.open(recorded)
    for session in (capture["ios_map"], capture["ios_query"]):
        assert not (session.path / "wifi.txt").exists()
        table = pd.read_csv(session.path / "bt.txt", sep=", ", engine="python")
        assert list(table) == ["# timestamp", "sensor_id", "id", "rssi_dbm", "name"]
        assert set(table["sensor_id"]) == {f"{name}/bt_sensor" for name in session.subsessions}
        assert table["id"].str.fullmatch(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}:[01]:[0-3]").all()
        loudest = table.loc[table.groupby("# timestamp")["rssi_dbm"].idxmax()]
        truth = session.ground_truth
        assert truth is not None
        nearest = np.abs(truth.timestamps - loudest["# timestamp"].to_numpy()[:, None]).argmin(axis=1)
        x = truth.world_from_device[nearest, 0, 3]
        in_room = np.abs(x - 28 * (x > 14)) < 4
        right = (loudest["id"].str.split(":").str[1].astype(int) == (x > 14)).to_numpy()
        assert in_room.sum() > 20
        assert right[in_room].mean() > 0.9


def test_scans_of_wifi_have_what_the_format_asks_for() -> None:
    rooms = [build_room(0, 0)]
    poses = make_pose(np.eye(3), np.tile(rooms[0].origin + 1.5, (2, 1)))
    times = np.array([10_000_000, 30_000_000])
    emitters = emitters_of(0, rooms, "wifi")
    rows = list(scans(np.random.default_rng(0), times, poses, emitters, rooms, "r/wifi_sensor"))
    assert {row[2] for row in rows} == {emitter.id for emitter in emitters}
    stamps = np.unique([row[0] for row in rows])
    assert set(np.diff(stamps)) == {4_000_000}
    for time, sensor, address, frequency_khz, dbm, _, start, end in rows:
        assert times[0] <= time <= times[1]
        assert (sensor, end) == ("r/wifi_sensor", time)
        assert start < end
        assert len(address) == 17
        assert frequency_khz in (2_412_000, 2_437_000, 5_180_000, 5_260_000)
        assert -92 < dbm < -20


def test_a_short_recording_with_losses_has_a_map_of_few_images(tmp_path: Path) -> None:
    capture = render_bare(tmp_path / "SHORT", 2, 4, seed=5, alike=True, seconds=40, losses=3, gaps=1)
    assert not check_capture(capture).problems


@pytest.mark.slow
def test_hard_images_are_added_and_the_easy_ones_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture_writing, "build_room", coarse_room)
    first, hard = (
        render_capture(tmp_path / str(added), 1, 4, 0, hard=added, progress=False) for added in (False, True)
    )
    easy = {path.relative_to(first): path.read_bytes() for path in first.rglob("*.jpg")}
    assert all((hard / path).read_bytes() == content for path, content in easy.items())
    session = Capture.open(hard)["ios_query"]
    added = {path.stem.partition("-")[2]: path for path in (hard / "sessions" / "ios_query").rglob("*-*.jpg")}
    assert list(HARD) == [name for name in HARD if name in added]
    assert len(session) == len(Capture.open(first)["ios_query"]) + len(HARD)
    assert np.isfinite(session.world_from_cam(ground_truth=True)).all()
    asked = session.keyframes("pruned_subsampled")
    assert asked["timestamp"].isin(session.images["timestamp"].iloc[-len(HARD) :]).sum() == len(HARD), "all are queries"
    with pytest.raises(ImageError):
        read_image(added["torn"])
    wrong, right = (session.camera(session.images["sensor_id"].iloc[row]) for row in (-2, -6))
    assert wrong.params[0] == pytest.approx(WRONG_FOCAL * right.params[0], rel=0.02)
    assert read_image(added["night"]).mean() < 0.1 * read_image(added["two-places"]).mean()


def test_refusals(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for folder, options, error, named in (
        ("C", {"rooms": 1, "frames": 1}, ManifestError, "frames"),
        ("C", {"rooms": 2, "frames": 8, "seconds": 39}, CaptureError, "seconds >= 40"),
        ("C", {"rooms": 1, "frames": 7, "seconds": 60}, CaptureError, "frames >= 4"),
        ("C", {"losses": 1}, CaptureError, "set seconds"),
        ("", {"rooms": 1, "frames": 2}, CaptureError, r"demo\.json"),
    ):
        with pytest.raises(error, match=named):
            render_capture(tmp_path / folder, **options)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_quad_faces_the_side_it_is_seen_from() -> None:
    quad = Quad(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, -1.0]), 1, 1, textures.plain, 10)
    np.testing.assert_array_equal(quad.normal, [0, -1, 0])  # right and down as seen from -y


def test_odometry_drifts_from_the_truth_in_an_upright_frame_of_its_own(small_capture: Path) -> None:
    session = Capture.open(small_capture)["spot_query"]
    truth, odometry = session.ground_truth, session.odometry
    assert truth is not None
    assert odometry is not None
    assert odometry.device_ids.tolist() == truth.device_ids.tolist()
    recording = [device.startswith(f"{session.subsessions[0]}/") for device in truth.device_ids]
    poses, measured = truth.world_from_device[recording], odometry.world_from_device[recording]
    odom_from_world = measured @ invert(poses)
    assert rotation_angle_deg(odom_from_world[0, :3, :3]) > 1.0
    tilt = np.degrees(np.arccos(odom_from_world[:, 2, 2]))
    assert tilt.max() < 2.0
    steps, taken = invert(poses[:-1]) @ poses[1:], invert(measured[:-1]) @ measured[1:]
    lengths, found = (np.linalg.norm(step[:, :3, 3], axis=1) for step in (steps, taken))
    assert (found != lengths).all()
    np.testing.assert_allclose(found, lengths, rtol=0.15)
    assert 0 < rotation_angle_deg((invert(steps) @ taken)[:, :3, :3]).max() < 1.0


def test_drift_of_odometry_is_as_large_as_stated() -> None:
    straight = np.tile(np.eye(4), (4001, 1, 1))
    straight[:, 0, 3] = 0.5 * np.arange(4001)
    measured = odometry_of(np.random.default_rng(0), straight, 2.0)
    steps = invert(measured[:-1]) @ measured[1:]
    assert np.degrees(steps[:, 2, 1].std()) == pytest.approx(0.2, rel=0.1)
    np.testing.assert_allclose(steps[:, :3, 3].std(axis=0), 0.02 * 0.5, rtol=0.1)
    assert steps[:, 0, 3].mean() == pytest.approx(0.5, rel=0.06)
