"""Whether the poses of a map are those of its images: what is noticed, what it is called, and what is not alarming."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.capture import Capture, Trajectory
from toolkit.capture.images import rays_of
from toolkit.features.features import KINDS, SiftExtractor
from toolkit.features.stores import FeatureStore
from toolkit.geometry import Floats
from toolkit.mapping.build import build_map, instants
from toolkit.mapping.local_map import Consistency, LocalMap
from toolkit.mapping.pose_consistency import MapImages, PoseConsistency
from toolkit.mapping.pose_noise import PosedPairs, _changed

Change = Callable[[Floats], Floats]
OPENGL = np.diag([1.0, -1.0, -1.0])
ROLLED = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def turned(axes: Floats) -> Change:
    """Return what gives cameras other axes."""
    return lambda poses: geometry.make_pose(poses[:, :3, :3] @ axes, poses[:, :3, 3])


def inverted_opengl(poses: Floats) -> Floats:
    return geometry.invert(turned(OPENGL)(poses))


def scaled(factor: float) -> Change:
    return lambda poses: geometry.make_pose(poses[:, :3, :3], factor * poses[:, :3, 3])


def mirrored(poses: Floats) -> Floats:
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    return flip @ poses @ flip


def quaternions_in_another_order(poses: Floats) -> Floats:
    quaternions = np.roll(geometry.rotation_to_quaternion(poses[:, :3, :3]), -1, axis=-1)
    return geometry.make_pose(geometry.quaternion_to_rotation(quaternions), poses[:, :3, 3])


def shuffled(poses: Floats, seed: int = 0) -> Floats:
    return poses[np.random.default_rng(seed).permutation(len(poses))]


def coarse(poses: Floats) -> Floats:
    """Poses that are off by 3 degrees and some centimeters, each in another direction."""
    rng = np.random.default_rng(0)
    axes = geometry.unit(rng.normal(size=(len(poses), 3)))
    turns = Rotation.from_rotvec(np.radians(3) * axes).as_matrix()
    return geometry.make_pose(poses[:, :3, :3] @ turns, poses[:, :3, 3] + 0.03 * rng.normal(size=(len(poses), 3)))


def upright_otherwise(poses: Floats) -> Floats:
    """Turn and move the world: no fault."""
    world = geometry.make_pose(Rotation.from_euler("xyz", [90, 10, -40], degrees=True).as_matrix(), [5.0, -200.0, 30.0])
    return world @ poses


def checked(
    capture: Path, features: Path, device: str, change: Change, count: int | None = None, scale: float = 1
) -> PoseConsistency:
    """Return the check of the first images of a map whose poses were changed, and the offsets of its rigs scaled."""
    session = Capture.open(capture)[f"{device}_map"]
    store = FeatureStore.of_session(features, session.id, SiftExtractor().settings)
    rows = np.arange(len(session.images))[:count]
    rig_from_cams = session.rig_from_cam(rows)
    poses = change(session.world_from_cam(rows) @ geometry.invert(rig_from_cams))
    if scale != 1:
        rig_from_cams = scaled(scale)(rig_from_cams)
    names, sensors = [session.image_name(int(row)) for row in rows], session.images["sensor_id"].tolist()[:count]
    images = MapImages(
        names,
        [session.camera(sensor) for sensor in sensors],
        poses,
        rig_from_cams,
        instants(session, rows),
        sensors,
    )
    return PoseConsistency(images, lambda index: store[names[index]], KINDS["sift"])


def consistency_of(check: PoseConsistency) -> Consistency:
    """Return the verdict over a map without points, in which every image has an equal part."""
    images, none = check.images, np.zeros(0, np.int64)
    empty = np.zeros((0, 3))
    return check.judge(
        LocalMap(
            list(images.names), list(images.cameras), images.world_from_cams, empty, empty.astype(np.uint8),
            none, none, none, np.zeros(0, np.float32),
        )
    )  # fmt: skip


@pytest.mark.parametrize(
    ("change", "scale"), [(np.array, 1), (upright_otherwise, 1), (scaled(100), 100)], ids=["right", "upright", "scaled"]
)
@pytest.mark.parametrize("device", ["ios", "hl", "spot"])
def test_right_poses_are_consistent(
    small_capture: Path, small_features: Path, device: str, change: Change, scale: float
) -> None:
    found = consistency_of(checked(small_capture, small_features, device, change, scale=scale))
    assert found.verdict == "consistent"
    assert found.agreeing > 0.9 * found.pairs
    assert not found.text


def noisy(rotation_deg: float, position_m: float, seed: int) -> Change:
    """Poses with noise of these standard deviations per axis."""

    def change(poses: Floats) -> Floats:
        rng = np.random.default_rng(seed)
        turns = Rotation.from_rotvec(np.radians(rotation_deg) * rng.normal(size=(len(poses), 3))).as_matrix()
        moved = poses[:, :3, 3] + position_m * rng.normal(size=(len(poses), 3))
        return geometry.make_pose(poses[:, :3, :3] @ turns, moved)

    return change


@pytest.mark.parametrize(("rotation_deg", "position_m"), [
    (0.3, 0.02), *(pytest.param(*noise, marks=pytest.mark.slow) for noise in ((0.3, 0.0), (1.0, 0.02), (0.0, 0.03))),
])  # fmt: skip
def test_the_noise_of_the_poses_is_measured(
    small_capture: Path, small_features: Path, rotation_deg: float, position_m: float
) -> None:
    found = [
        consistency_of(checked(small_capture, small_features, device, noisy(rotation_deg, position_m, seed)))
        for device in ("hl", "spot")
        for seed in (1, 2, 3)
    ]
    names = ("rotation_noise_deg", "position_noise")
    rotation, position = (np.median([getattr(one, name) for one in found]) for name in names)
    # Nearby, a turn looks like a step: their sum is known better than each.
    depth = 3.0
    expected = np.hypot(rotation_deg, np.degrees(position_m / depth))
    assert np.hypot(rotation, np.degrees(position / depth)) == pytest.approx(expected, rel=0.4)
    assert all(one.verdict == "consistent" and not one.camera for one in found)


def test_exact_poses_have_no_noise(small_capture: Path, small_features: Path) -> None:
    for device in ("ios", "hl", "spot"):
        found = consistency_of(checked(small_capture, small_features, device, np.array))
        assert (found.rotation_noise_deg, found.position_noise, found.direction_noise_deg) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("factor", "noise_deg"),
    [*((one, 0.0) for one in (0.5, 0.9, 1.05, 1.12, 2.0)), *((one, 0.15) for one in (0.5, 0.85, 1.15, 2.0))],
)
def test_a_wrong_focal_length_of_the_map_is_named(
    small_capture: Path, small_features: Path, factor: float, noise_deg: float
) -> None:
    check = checked(small_capture, small_features, "spot", noisy(noise_deg, 0.0, 1))
    cameras, pairs = [], []
    for camera in check.images.cameras:
        other = pycolmap.Camera(camera.todict())
        params = other.params
        params[[int(index) for index in other.focal_length_idxs()]] *= factor
        other.params = params
        cameras.append(other)
    for pair in check.sample:
        pixels = [
            np.asarray(check.images.cameras[index].img_from_cam(rays))
            for index, rays in ((pair.i, pair.rays_i), (pair.j, pair.rays_j))
        ]
        rays = [rays_of(cameras[index], xy) for index, xy in zip((pair.i, pair.j), pixels, strict=True)]
        pairs.append(pair._replace(rays_i=rays[0], rays_j=rays[1]))
    text = PosedPairs(pairs, check.images.world_from_cams).check_intrinsics(cameras)
    assert text.startswith("the focal length")
    if "times" in text:
        found = 1 / float(text.split(" are ")[1].split()[0])
    else:
        found = float(text.split("given ")[1]) / float(text.split(" is ")[1].split()[0])
    assert found == pytest.approx(factor, rel=0.03 if noise_deg == 0 else 0.05)


def test_what_errors_of_slam_imitate_is_not_blamed_on_the_camera(small_capture: Path, small_features: Path) -> None:
    """KinectFusion's poses of KITCHEN ask for 2 % of the focal length; of 25 images, 2 draws in 40 were blamed."""
    for seed in (15, 16, 17):
        check = checked(small_capture, small_features, "spot", noisy(0.5, 0.01, seed))
        change = np.array([-0.025, 0, 0, 0])
        pairs = [
            pair._replace(rays_i=_changed(pair.rays_i, change), rays_j=_changed(pair.rays_j, change))
            for pair in check.sample
        ]
        assert not PosedPairs(pairs, check.images.world_from_cams).check_intrinsics(check.images.cameras)


def test_a_focal_length_one_percent_off_is_not_worth_a_word(small_capture: Path, small_features: Path) -> None:
    check = checked(small_capture, small_features, "spot", np.array)
    change = np.array([0.01, 0, 0, 0])
    pairs = [
        pair._replace(rays_i=_changed(pair.rays_i, change), rays_j=_changed(pair.rays_j, change))
        for pair in check.sample
    ]
    assert not PosedPairs(pairs, check.images.world_from_cams).check_intrinsics(check.images.cameras)


def rotations_of_cam_from_world(poses: Floats) -> Floats:
    """As NVM, Bundler and the Cambridge Landmarks have them, with the camera's center."""
    return geometry.make_pose(np.swapaxes(poses[:, :3, :3], 1, 2), poses[:, :3, 3])


@pytest.mark.parametrize(
    ("device", "change", "fits"),
    [
        ("ios", turned(OPENGL), "camera axes as in OpenGL (x right, y up, z backward)"),
        ("ios", geometry.invert, "poses of cam_from_world"),
        ("hl", geometry.invert, "poses of cam_from_world"),
        ("ios", inverted_opengl, "poses of cam_from_world, camera axes as in OpenGL"),
        ("spot", mirrored, "a mirrored world"),
        ("ios", turned(ROLLED), "images turned by -90 degrees"),
        ("ios", quaternions_in_another_order, "quaternions in the order x, y, z, w"),
        ("ios", rotations_of_cam_from_world, "rotations of cam_from_world"),
        ("ios", lambda poses: geometry.invert(rotations_of_cam_from_world(poses)), "camera centers that were"),
        ("ios", shuffled, ""),
    ],
    ids=["opengl", "inverted", "inverted rig", "both", "mirrored", "rolled", "quaternions", "centers",
         "inverted centers", "shuffled"],
)
def test_the_convention_that_would_fit_is_found(
    small_capture: Path, small_features: Path, device: str, change: Change, fits: str
) -> None:
    found = consistency_of(checked(small_capture, small_features, device, change))
    assert found.verdict == "inconsistent"
    assert found.fits.startswith(fits)
    assert bool(found.fits) == bool(fits)
    assert found.text
    assert ("rotation_of_cam_from_world" in found.text) == fits.startswith(("rotations of", "camera centers"))
    assert ("the other `--axes`" in found.text) == ("OpenGL" in fits), "where an import has turned them, they are not"


@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize("device", ["ios", "spot"])
def test_shuffled_poses_of_a_small_room_are_inconsistent(
    small_capture: Path, small_features: Path, device: str, seed: int
) -> None:
    """There, a wrong pose is rarely far from an epipolar line, but the images are turned otherwise."""
    found = consistency_of(checked(small_capture, small_features, device, lambda poses: shuffled(poses, seed)))
    assert found.verdict == "inconsistent"


def test_coarse_poses_are_consistent(small_capture: Path, small_features: Path) -> None:
    found = consistency_of(checked(small_capture, small_features, "ios", coarse))
    assert found.agreeing < 0.5 * found.pairs
    assert found.verdict == "consistent"


def test_a_few_images_tell_nothing(small_capture: Path, small_features: Path) -> None:
    found = consistency_of(checked(small_capture, small_features, "ios", turned(OPENGL), count=3))
    assert found.verdict == "unknown"
    assert "too few" in found.text


def test_lengths_follow_the_depth_of_the_scene(small_capture: Path, small_features: Path) -> None:
    check = checked(small_capture, small_features, "ios", np.array)
    assert check.length(metric=True) == 1.0, "a room is of a usual depth"
    assert check.typical_depth() == pytest.approx(5, abs=2)
    for factor in (0.01, 100.0):
        other = checked(small_capture, small_features, "ios", scaled(factor))
        assert other.length(metric=False) == pytest.approx(factor * check.length(metric=False), rel=1e-9)
        assert 2 <= other.typical_depth() / other.length(metric=True) <= 16


@pytest.mark.slow
def test_a_single_wrong_pose_is_listed(small_capture: Path, small_features: Path, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    path = capture / "sessions" / "ios_map" / "trajectories.txt"
    before = Trajectory.read(path)
    poses = geometry.pose_from_qt(before.qt)
    wrong = 2
    poses[wrong] = upright_otherwise(poses[wrong : wrong + 1])[0]
    path.unlink()
    Trajectory(before.timestamps, before.arrow_ids, geometry.qt_from_pose(poses)).write(path)
    session = Capture.open(capture)["ios_map"]
    store = FeatureStore.of_session(small_features, session.id, SiftExtractor().settings)
    found = build_map(session, store, tmp_path / "ios_map.npz").consistency
    assert found.verdict == "consistent"
    assert found.wrong == [session.image_name(wrong)]
    assert found.wrong[0] in found.text
    assert LocalMap.load(tmp_path / "ios_map.npz").consistency == found


def test_what_little_a_small_map_tells_of_its_poses_is_said():
    assert "(3 verified image pairs, 0 of which agree with them)" in Consistency(pairs=3, agreeing=0).text
    assert "(0 verified image pairs)" in Consistency().text
