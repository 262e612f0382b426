"""Recordings read back: they hold the frames, poses and queries that the files say, and nothing else."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pycolmap
import pytest

from tests.localized import stored, write_queries
from toolkit import geometry
from toolkit.capture import Capture, Trajectory, write_depth, write_session
from toolkit.errors import ArtifactError, CaptureError
from toolkit.geometry import make_pose, quaternion_to_rotation
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import split_status
from toolkit.results.localized import Localizations, QueryDetails, ShownImage
from toolkit.viewer.queries import record_localizations, scene_view, shown_intrinsics, small_jpeg, spawn_viewer
from toolkit.viewer.sessions import record_session, session_tracks

START = 93_003_175_602  # microseconds, as captures count them


def rotation(angle_deg):
    half = np.radians(angle_deg) / 2
    return quaternion_to_rotation([np.cos(half), 0, np.sin(half), 0])


def read_back(path):
    """Return {entity: [(frame or query or None, microseconds or None, {component: value})]}."""
    import rerun as rr

    found: dict = {}
    for chunk in rr.chunk.RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = {name: batch.column(name) for name in batch.schema.names}
        if "capture_time" in columns:
            columns["capture_time"] = columns["capture_time"].cast(pa.int64())
        for row in range(batch.num_rows):
            entry = {}
            for name, column in columns.items():
                if ":" in name and column[row].as_py() is not None:
                    entry[name] = column[row].as_py()
            times = [columns[name][row].as_py() if name in columns else None for name in ("frame", "capture_time")]
            index = columns["query"][row].as_py() if "query" in columns else times[0]
            found.setdefault(chunk.entity_path, []).append((index, times[1], entry))
    return found


def logged(entries, component):
    """Return [(index, nanoseconds, value)] of a component in order of the timeline."""
    rows = [(index, time, entry[component]) for index, time, entry in entries if component in entry]
    return sorted(rows, key=lambda row: -1 if row[0] is None else row[0])


def pose_of(entry):
    ((x, y, z, w),) = entry["Transform3D:quaternion"]
    (translation,) = entry["Transform3D:translation"]
    return make_pose(quaternion_to_rotation([w, x, y, z]), translation)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A headset with two cameras and a rig id a frame, two subsessions, depth; queries of it; a phone."""
    import cv2

    root = tmp_path_factory.mktemp("data") / "PLACE"
    rng = np.random.default_rng(0)
    rig_from = {"lf": make_pose(rotation(20), [0.1, 0, 0]), "rf": make_pose(rotation(-20), [-0.1, 0, 0])}

    def write(split, subs, posed_frames, truth):
        folder = root / "sessions" / f"hl_{split}"
        images, rigs, times, devices, poses, depths = [], [], [], [], [], []
        sensors = [(f"{sub}/{c}", c, "camera", "PINHOLE", 96, 128, 100, 110, 50, 60) for sub in subs for c in rig_from]
        frame = 0
        for sub in subs:
            for _ in range(4):
                time = START + 50_001 * frame
                rig = f"{sub}/rig_{time}"
                for name, pose in rig_from.items():
                    images.append((time, f"{sub}/{name}", f"{sub}/images/{name}/{time}.jpg"))
                    rigs.append((rig, f"{sub}/{name}", pose))
                    file = folder / "raw_data" / images[-1][2]
                    file.parent.mkdir(parents=True, exist_ok=True)
                    cv2.imwrite(str(file), rng.integers(0, 255, (128, 96, 3), np.uint8))
                if frame in posed_frames:
                    times.append(time)
                    devices.append(rig)
                    poses.append(make_pose(rotation(10 * frame), [frame, 0.5 * frame, 1]))
                if frame == 1:
                    depths.append((time, f"{sub}/lf", f"{sub}/depths/{time}.png"))
                    write_depth(folder / "raw_data" / depths[-1][2], np.full((64, 48), 2.5))
                frame += 1
        trajectory = Trajectory.from_poses(times, devices, np.array(poses))
        keys = pd.DataFrame({"timestamp": times[::2], "device_id": devices[::2]})
        write_session(
            folder, sensors, rigs, None if truth else trajectory, images, depths or None, subs,
            {"pruned_subsampled": keys} if truth else None, trajectory if truth else None,
        )  # fmt: skip

    write("map", ["morning", "noon"], {0, 1, 2, 3, 4, 6, 7}, truth=False)
    write("query", ["night"], {0, 1, 2, 3}, truth=True)
    # A phone: no rig, and a sensor id made anew each frame.
    folder = root / "sessions" / "ios_map"
    times = [START + 100 * k for k in range(3)]
    ids = [f"walk/cam_{time}" for time in times]
    images = [(time, sensor, f"walk/images/{time}.jpg") for time, sensor in zip(times, ids, strict=True)]
    (folder / "raw_data" / "walk" / "images").mkdir(parents=True)
    for _, _, path in images[:2]:  # the third is missing
        cv2.imwrite(str(folder / "raw_data" / path), rng.integers(0, 255, (48, 64, 3), np.uint8))
    sensors = [(s, "cam", "camera", "SIMPLE_PINHOLE", 64, 48, 50 + k // 2, 32, 24) for k, s in enumerate(ids)]
    poses = np.array([make_pose(rotation(0), [0, 0, k]) for k in range(3)])
    write_session(folder, sensors, None, Trajectory.from_poses(times, ids, poses), images, subsessions=["walk"])
    return root


@pytest.fixture(scope="module")
def map_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    rng = np.random.default_rng(1)
    camera = pycolmap.Camera(model="PINHOLE", width=96, height=128, params=[100, 110, 50, 60])
    points, colors = rng.normal(size=(3, 3)), rng.integers(0, 255, (3, 3), np.uint8)
    images = np.array([0, 0, 1, 1, 2, 2])
    observed = np.array([0, 1, 0, 1, 0, 2])  # point 0 is seen by three, the others by fewer
    poses = np.tile(np.eye(4), (3, 1, 1))
    keypoints, noise_px = np.arange(6), np.ones(3, np.float32)
    local_map = LocalMap(["a", "b", "c"], [camera] * 3, poses, points, colors, images, keypoints, observed, noise_px)
    local_map.save(folder / "hl_map-superpoint.npz")
    return folder


def test_a_map_recording_holds_the_frames_and_poses_of_the_files(capture, map_dir, tmp_path):
    done = record_session(
        capture, "map", "hl", out=tmp_path / "map.rrd", map_dir=map_dir, image_size=64, progress=False
    )
    assert (done.frames, done.images, done.unposed, done.depth_maps, done.points) == (8, 16, 2, 1, 1)
    assert done.bytes == done.path.stat().st_size
    assert done.command == f"rerun {done.path}"
    found = read_back(done.path)
    session = Capture.open(capture)["hl_map"]

    poses = {}
    for sub in ("morning", "noon"):
        for index, time, entry in found[f"/world/{sub}/rig_0"]:
            poses[index] = (time, pose_of(entry))
    wanted = session.trajectory
    assert sorted(poses) == [0, 1, 2, 3, 4, 6, 7]
    for index, (time, pose) in poses.items():
        timestamp = START + 50_001 * index
        assert time == 1000 * timestamp
        row = int(np.flatnonzero(wanted.timestamps == timestamp)[0])
        np.testing.assert_allclose(pose, wanted.world_from_device[row], atol=1e-6)
    for camera, angle in (("lf", 20), ("rf", -20)):
        path = f"/world/morning/rig_0/{camera}"
        assert [row[0] for row in logged(found[f"{path}/image"], "EncodedImage:blob")] == [0, 1, 2, 3]
        # Once: the rig does not change from frame to frame, though its id does.
        mounted = logged(found[path], "Transform3D:translation")
        assert [row[0] for row in mounted] == [0]
        entry = next(entry for _, _, entry in found[path] if "Transform3D:quaternion" in entry)
        np.testing.assert_allclose(pose_of(entry)[:3, :3], rotation(angle), atol=1e-6)
        (matrix,) = logged(found[path], "Pinhole:image_from_camera")[0][2]
        np.testing.assert_allclose(np.reshape(matrix, (3, 3)).T, [[50, 0, 25], [0, 55, 30], [0, 0, 1]])
        assert logged(found[path], "Pinhole:resolution")[0][2] == [[48, 64]]
        # Intrinsics once; and the instant after the subsession's last frame shows nothing.
        depths = logged(found[path], "Pinhole:image_plane_distance")
        assert [(row[0], row[2][0] < 0.01) for row in depths] == [(0, False), (4, True)]
    # The frame without a pose: not in the scene, where its camera would stand at the last place.
    assert [row[0] for row in logged(found["/unposed/noon/rig_0/lf/image"], "EncodedImage:blob")] == [5]
    assert [row[0] for row in logged(found["/world/noon/rig_0/lf/image"], "EncodedImage:blob")] == [4, 6, 7]
    depths = logged(found["/world/noon/rig_0/lf"], "Pinhole:image_plane_distance")
    assert [(row[0], row[2][0] < 0.01) for row in depths] == [(0, True), (4, False), (5, True), (6, False), (8, True)]
    ((index, _, _),) = logged(found["/world/morning/rig_0/lf_depth/depth"], "EncodedDepthImage:blob")
    assert index == 1
    ((line,),) = [row[2] for row in logged(found["/world/morning/trajectory"], "LineStrips3D:strips")]
    np.testing.assert_allclose(line, wanted.world_from_device[:4, :3, 3], atol=1e-6)
    assert len(logged(found["/world/points"], "Points3D:positions")[0][2]) == 1
    np.testing.assert_allclose(session_tracks(session)[0][0], session.world_from_cam([0])[0, :3, 3])


def test_thinned_recordings_keep_the_numbers_of_the_whole(capture, tmp_path):
    done = record_session(capture, "map", "hl", "noon", every=2, out=tmp_path / "a.rrd", progress=False)
    found = read_back(done.path)
    assert not any("morning" in path for path in found)
    assert [row[0] for row in logged(found["/world/noon/rig_0/lf/image"], "EncodedImage:blob")] == [4, 6]
    done = record_session(capture, "query", "hl", keyframes_only=True, out=tmp_path / "b.rrd", progress=False)
    frames = logged(read_back(done.path)["/world/night/rig_0/rf/image"], "EncodedImage:blob")
    assert [(index, time) for index, time, _ in frames] == [(0, START * 1000), (2, (START + 2 * 50_001) * 1000)]


def test_a_phone_with_a_sensor_a_frame_is_one_camera(capture, tmp_path):
    done = record_session(capture, "map", "ios", out=tmp_path / "a.rrd", progress=False)
    assert (done.images, done.unreadable) == (3, 1)
    assert len(done.messages) == 1
    found = read_back(done.path)
    path = "/world/walk/camera_0"
    assert [row[0] for row in logged(found[f"{path}/image"], "EncodedImage:blob")] == [0, 1, 2]
    assert [row[2] for row in logged(found[path], "Transform3D:translation")] == [[[0, 0, 0]], [[0, 0, 1]], [[0, 0, 2]]]
    # Its intrinsics are logged again only where they change.
    assert [row[0] for row in logged(found[path], "Pinhole:image_from_camera")] == [0, 2, 3]


def test_queries_stand_where_a_trajectories_file_says(capture, map_dir, tmp_path):
    session = Capture.open(capture)["hl_query"]
    truth = session.ground_truth
    estimated = truth.world_from_device[1:3].copy()
    estimated[:, :3, 3] += 1
    file = tmp_path / "PLACE_map_hl_query_hl.txt"
    Trajectory.from_poses(truth.timestamps[1:3], truth.device_ids[1:3], estimated).write(file)
    names = [Capture.open(capture)["hl_map"].image_name(row) for row in (0, 4)]
    keys = zip(truth.timestamps[1:3].tolist(), truth.device_ids[1:3].tolist(), strict=True)
    queries = dict(zip(keys, [stored(references=names), stored()], strict=True))
    write_queries(file.with_suffix(".h5"), queries, ["hl_map-superpoint.npz"])
    asked = {"queries_pose": file, "vis_retrieve_queries": True, "map_dir": map_dir, "progress": False}
    done = record_session(capture, "query", "hl", out=tmp_path / "query.rrd", **asked)
    assert (done.images, done.unposed, done.points) == (8, 4, 1)
    found = read_back(done.path)
    rows = sorted(found["/world/night/rig_0"], key=lambda row: row[0])
    assert [row[0] for row in rows] == [1, 2]
    np.testing.assert_allclose([pose_of(row[2]) for row in rows], estimated, atol=1e-6)
    (lines,) = [row[2] for row in logged(found["/world/queries/references"], "LineStrips3D:strips")]
    centers = Capture.open(capture)["hl_map"].world_from_cam([0, 4])[:, :3, 3]
    np.testing.assert_allclose(lines, [[estimated[0, :3, 3], center] for center in centers], atol=1e-6)
    # The same file in the map's recording: points where the queries are.
    done = record_session(capture, "map", "hl", out=tmp_path / "map.rrd", **asked)
    (dots,) = [row[2] for row in logged(read_back(done.path)["/world/queries/poses"], "Points3D:positions")]
    assert done.queries == 2
    np.testing.assert_allclose(dots, estimated[:, :3, 3], atol=1e-6)
    # Poses of the sequence stage belong to the same pair.
    asked["queries_pose"] = shutil.copy(file, tmp_path / "PLACE_map_hl_query_hl_sequence.txt")
    done = record_session(capture, "query", "hl", out=tmp_path / "sequence.rrd", **asked)
    assert (done.images, done.points) == (8, 1)
    assert logged(read_back(done.path)["/world/queries/references"], "LineStrips3D:strips")
    with pytest.raises(ArtifactError, match="nothing to do with session ios_map"):
        record_session(capture, "map", "ios", out=tmp_path / "x.rrd", **asked)


def test_wrong_choices_are_named(capture, tmp_path):
    for given, options, error, named in (
        (["dusk"], {}, CaptureError, "no subsession 'dusk'; known: morning, noon, all"),
        ([], {"every": 0}, CaptureError, "every=0"),
        ([], {"vis_retrieve_queries": True}, ArtifactError, "queries_pose"),
    ):
        with pytest.raises(error, match=named):
            record_session(capture, "map", "hl", *given, out=tmp_path / "x.rrd", **options)
    assert not list(tmp_path.iterdir())


def test_a_folder_without_the_map_is_said(capture, tmp_path):
    done = record_session(capture, "map", "hl", map_dir=tmp_path, out=tmp_path / "x.rrd", progress=False)
    assert done.points == 0
    assert done.messages == [f"{tmp_path}: holds no map for this recording, so no points are shown."]


def test_the_viewer_is_opened_when_asked_for(capture, tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("toolkit.viewer.queries.subprocess.Popen", lambda command, **_: opened.append(command))
    record_session(capture, "map", "ios", spawn=True, out=tmp_path / "a.rrd", progress=False)
    spawn_viewer("b.rrd")
    assert [command[-1] for command in opened] == [str(tmp_path / "a.rrd"), "b.rrd"]


def test_pictures_and_intrinsics_change_size_together():
    camera = pycolmap.Camera(model="OPENCV", width=101, height=60, params=[80, 82, 50, 30, 0.1, 0, 0, 0])
    data, shown = small_jpeg(np.zeros((60, 101, 3), np.uint8), 50)
    assert shown == (50, 30)
    assert data[:2] == b"\xff\xd8"
    matrix = shown_intrinsics(camera, shown)
    # The image's far corner stays its far corner.
    np.testing.assert_allclose(matrix @ [(101 - 50) / 80, (60 - 30) / 82, 1], [50, 30, 1])
    assert small_jpeg(np.zeros((60, 101), np.uint8), 500)[1] == (101, 60)


def test_a_localization_view_holds_the_queries(capture, tmp_path, monkeypatch):
    monkeypatch.setattr("toolkit.viewer.queries.IMAGE_SIZE", 64)
    rng = np.random.default_rng(0)
    session = Capture.open(capture)["hl_map"]
    camera, file = session.camera("morning/lf"), session.image_path(0)
    map_poses = session.world_from_cam()
    true = np.tile(np.eye(4), (4, 1, 1))
    true[:, 0, 3] = range(4)
    estimated = true.copy()
    estimated[1, 1, 3] += 0.5
    estimated[2] = np.nan
    true[3] = np.nan
    references = np.full((4, 3), np.nan)
    references[2] = [7, 8, 9]
    errors = {"rotation_error_deg": [0, 0, np.inf, np.nan], "translation_error_m": [0, 0.5, np.inf, np.nan]}
    columns = {"status": ["ok", "ok", "failed: dark", "ok"], "num_inliers": [9, 8, 0, 7]}
    table = split_status(pd.DataFrame({**columns, **errors}))
    queries = Localizations(list("abcd"), table, estimated, true, references)
    points = rng.uniform([-0.3, -0.3, 2], [0.3, 0.3, 4], (6, 3))
    pixels = rng.uniform(0, 90, (6, 2))
    agrees = np.arange(6) < 5
    placed = points + estimated[1, :3, 3]
    shown = ShownImage("b.jpg", file, camera, estimated[1], pixels, placed, np.arange(6), agrees, true[1])
    reference = ShownImage("r.jpg", file, camera, map_poses[0], pixels[:2], placed[:2], np.arange(2), agrees[:2])
    lost = ShownImage("c.jpg", file, camera, np.full((4, 4), np.nan))
    details = [(1, QueryDetails([shown], [reference])), (2, QueryDetails([lost], [reference]))]
    path = record_localizations(tmp_path / "v.rrd", "view", map_poses, points, None, queries, iter(details))
    found = read_back(path)
    (centers,) = [row[2] for row in logged(found["/world/queries/estimated"], "Points3D:positions")]
    np.testing.assert_allclose(centers, estimated[[0, 1, 3], :3, 3])
    (labels,) = [row[2] for row in logged(found["/world/queries/estimated"], "Points3D:labels")]
    assert labels[1] == "#1 b, ok, off by 0°, 0.5 m, 8 inliers"
    (lines,) = [row[2] for row in logged(found["/world/queries/error"], "LineStrips3D:strips")]
    np.testing.assert_allclose(
        lines, [[pose[:3, 3] for pose in pair] for pair in zip(estimated[:2], true[:2], strict=True)]
    )
    (failed,) = [row[2] for row in logged(found["/world/queries/failed"], "Points3D:positions")]
    assert failed == [[7, 8, 9]]
    assert len(logged(found["/world/map_cameras"], "LineStrips3D:strips")[0][2]) == 14
    images = logged(found["/world/chosen/camera_0/image"], "EncodedImage:blob")
    assert [row[0] for row in images] == [1, 2]
    (index, _, marks), (_, _, none) = logged(found["/world/chosen/camera_0/marks/reprojected"], "Points2D:positions")
    assert (index, none) == (1, [])  # nothing of the last query stays on a failed one
    wanted = camera.img_from_cam(points[:5]) / 2
    np.testing.assert_allclose(marks, wanted, atol=1e-4)
    (_, _, measured), _ = logged(found["/world/chosen/camera_0/marks/measured"], "Points2D:positions")
    np.testing.assert_allclose(measured, pixels[:5] / 2, atol=1e-5)
    (_, _, rejected), _ = logged(found["/world/chosen/camera_0/marks/rejected"], "Points2D:positions")
    np.testing.assert_allclose(rejected, pixels[5:] / 2, atol=1e-5)
    (_, _, dots), _ = logged(found["/world/chosen_points"], "Points3D:positions")
    np.testing.assert_allclose(dots, placed[:5], atol=1e-5)
    (_, _, at), *_ = logged(found["/world/truth/camera_0"], "Transform3D:translation")
    np.testing.assert_allclose(at, [true[1, :3, 3]])
    assert [row[0] for row in logged(found["/world/references/1/image"], "EncodedImage:blob")] == [1, 2]
    text = logged(found["/about"], "TextDocument:text")
    assert text[1][2][0].startswith("**query 2: c, failed: dark")


def test_a_world_far_from_its_origin_is_shown_without_jitter(small_capture: Path, tmp_path: Path) -> None:
    """The viewer has single precision: at 5,000 km its positions are multiples of half a meter."""
    offset = np.array([5e5, 5e6, 400.0])
    far = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    for path in far.glob("sessions/*_map/trajectories.txt"):
        near = Trajectory.read(path)
        path.unlink()
        shifted = geometry.shifted(near.world_from_device, offset)
        Trajectory.from_poses(near.timestamps, near.arrow_ids, shifted).write(path)
    poses = Capture.open(small_capture)["ios_map"].world_from_cam()
    camera = Capture.open(small_capture)["ios_map"].cameras([0])[0]
    file = Capture.open(small_capture)["ios_map"].image_path(0)
    correspondences = np.ones((2, 2)), poses[:2, :3, 3], np.arange(2), np.ones(2, bool)
    shown = ShownImage("b.jpg", file, camera, poses[1], *correspondences)
    errors = {"rotation_error_deg": [1, np.inf], "translation_error_m": [0.2, np.inf]}
    table = split_status(pd.DataFrame({"status": ["ok", "failed: dark"], "num_inliers": [9, 0], **errors}))
    estimated = np.stack([poses[1], np.full((4, 4), np.nan)])
    queries = Localizations(["a", "b"], table, estimated, poses[:2], poses[:2, :3, 3])
    views = []
    for name, shift, capture in (("near", np.zeros(3), small_capture), ("far", offset, far)):
        at = {"world_from_cam": geometry.shifted(poses[1], shift), "points": shown.points + shift}
        image = replace(shown, **at)
        moved = replace(
            queries,
            estimated=geometry.shifted(estimated, shift),
            true=geometry.shifted(poses[:2], shift),
            nearest_reference=poses[:2, :3, 3] + shift,
        )
        record_localizations(
            *(tmp_path / f"{name}.rrd", "view", geometry.shifted(poses, shift), poses[:, :3, 3] + shift, None),
            *(moved, [(0, QueryDetails([image], [image]))]),
            up=[0, 0, 1],
            tracks={"frames": [poses[:, :3, 3] + shift]},
        )
        record_session(capture, "map", "ios", out=tmp_path / f"{name}_session.rrd", world_up=[0, 0, 1], progress=False)
        views.append([read_back(tmp_path / f"{name}{end}.rrd") for end in ("", "_session")])
    for near_view, far_view in zip(*views, strict=True):
        compared = 0
        for entity, chunks in near_view.items():
            for kind in ("Points3D:positions", "LineStrips3D:strips", "Transform3D:translation"):
                for one, other in zip(logged(chunks, kind), logged(far_view[entity], kind), strict=True):
                    for expected, found in zip(one[2], other[2], strict=True):
                        np.testing.assert_allclose(found, expected, atol=1e-5)
                        compared += 1
        assert compared > 5


def test_a_view_without_queries_points_or_map(tmp_path):
    none = np.zeros((0, 4, 4))
    errors = pd.DataFrame(columns=["status", "rotation_error_deg", "translation_error_m"])
    queries = Localizations([], errors, none, none)
    assert record_localizations(tmp_path / "e.rrd", "e", none, np.zeros((0, 3)), None, queries).stat().st_size > 0


def test_the_length_of_the_up_direction_does_not_move_the_view() -> None:
    poses = np.stack([make_pose(rotation(angle), [angle, 0, 0]) for angle in (0.0, 20.0)])
    up = np.array([0.0, -1.0, 0.0])
    first, second = (scene_view(poses, scale * up, "view").properties["EyeControls3D"] for scale in (1.0, 5.0))
    assert first.position.as_arrow_array() == second.position.as_arrow_array()
