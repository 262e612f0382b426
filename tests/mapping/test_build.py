"""The triangulated map: which images are paired, where the points come out, and its file."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory, write_session
from toolkit.capture.images import in_view, invertible_share, rays_of, view_bounds
from toolkit.errors import ArtifactError
from toolkit.features.features import KINDS, SiftExtractor, SiftSettings
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import sidecar_path
from toolkit.mapping import build as mapping
from toolkit.mapping.build import MapSettings, build_map, select_pairs
from toolkit.mapping.local_map import LocalMap
from toolkit.mapping.triangulation import MAX_REPROJECTION_ERROR_PX, refine_points, triangulate

Floats = NDArray[np.float64]

CAMERAS = {
    "PINHOLE": pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[520, 510, 318, 243]),
    "OPENCV": pycolmap.Camera(
        model="OPENCV", width=640, height=480, params=[520, 510, 318, 243, -0.2, 0.06, 0.002, -0.001]
    ),
    "OPENCV_FISHEYE": pycolmap.Camera(
        model="OPENCV_FISHEYE", width=640, height=480, params=[330, 332, 322, 238, 0.02, -0.01, 0.003, 0.001]
    ),
}
PINHOLE = CAMERAS["PINHOLE"]


def looking_at(center: list[float] | Floats, target: list[float] | Floats, roll_deg: float = 0.0) -> Floats:
    """Return world_from_cam of a camera at `center`; the world's z is up."""
    forward = np.asarray(target, np.float64) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    roll = Rotation.from_euler("Z", roll_deg, degrees=True).as_matrix()
    return geometry.make_pose(rotation @ roll, center)


def ring(count: int, radius: float = 6.0, sector_deg: float = 120.0) -> Floats:
    turns = np.radians(np.linspace(0, sector_deg, count))
    centers = np.stack([radius * np.cos(turns), radius * np.sin(turns), 0.5 * np.sin(3 * turns)], axis=1)
    return np.stack([looking_at(c, [0, 0, 0], roll_deg=90.0 * (i % 3 == 2)) for i, c in enumerate(centers)])


class Ring:
    """Cameras on an arc about a cloud of known points, with exact keypoints in a random order."""

    def __init__(self, camera: pycolmap.Camera, count: int = 8, points: int = 300, seed: int = 0, noise_px: float = 0):
        rng = np.random.default_rng(seed)
        self.points = rng.uniform(-1.5, 1.5, (points, 3))
        self.world_from_cams = ring(count)
        self.cameras = [camera] * count
        self.names = [f"ios_map/raw_data/{index}.jpg" for index in range(count)]
        self.keypoints: list[NDArray[np.float32]] = []
        self.point_of: list[NDArray[np.int64]] = []  # the true point of each keypoint
        for pose in geometry.invert(self.world_from_cams):
            pixels = np.asarray(camera.img_from_cam(geometry.transform(pose, self.points)))
            inside = np.flatnonzero(((pixels > 0) & (pixels < [640, 480])).all(axis=1))
            order = rng.permutation(inside)
            noise = noise_px * rng.normal(size=(len(order), 2))
            self.keypoints.append((pixels[order] + noise).astype(np.float32))
            self.point_of.append(order)
        self.pairs = np.array([(i, j) for i in range(count) for j in range(i + 1, count)], np.int64)
        self.matches = [self.common(i, j) for i, j in self.pairs]

    def common(self, i: int, j: int) -> NDArray[np.int64]:
        _, in_i, in_j = np.intersect1d(self.point_of[i], self.point_of[j], return_indices=True)
        return np.stack([in_i, in_j], axis=1)

    def triangulate(self, settings: MapSettings | None = None) -> LocalMap:
        return triangulate(
            self.names, self.cameras, self.world_from_cams, self.keypoints, self.pairs, self.matches, settings
        )

    def truth(self, local_map: LocalMap) -> NDArray[np.int64]:
        """Return the true point of each observation."""
        pairs = zip(local_map.obs_image, local_map.obs_keypoint, strict=True)
        return np.array([self.point_of[image][keypoint] for image, keypoint in pairs], np.int64)


# --------------------------------------------------------------------------------------------------- views


@pytest.mark.parametrize("model", CAMERAS)
def test_rays_are_unit_and_project_back(model: str) -> None:
    camera = CAMERAS[model]
    pixels = np.random.default_rng(0).uniform([20, 20], [620, 460], (100, 2))
    rays = rays_of(camera, pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(camera.img_from_cam(7.0 * rays), pixels, atol=1e-3)
    assert rays_of(camera, np.zeros((0, 2))).shape == (0, 3)


def test_the_view_of_a_pinhole() -> None:
    bounds = view_bounds(PINHOLE)
    np.testing.assert_allclose(bounds, [-318 / 520, (640 - 318) / 520, -243 / 510, (480 - 243) / 510], atol=1e-12)
    points = np.array([[0, 0, 2], [1.2, 0, 2], [1.3, 0, 2], [0, 0, -2], [0, 0, 0.05], [0, 0.93, 2], [0, -1, 2.0]])
    assert in_view(points[None], bounds[None])[0].tolist() == [True, True, False, False, False, False, False]


@pytest.mark.parametrize(
    ("camera", "at_least", "below"),
    [
        (("OPENCV", [520, 510, 318, 243, -0.2, 0.06, 0.002, -0.001]), 1.0, 1.1),
        (("OPENCV", [500, 500, 320, 240, -44, 300, 0, 0]), 0.0, 0.1),  # grows, shrinks and grows again
        (("FULL_OPENCV", [500, 500, 320, 240, 0, 0, 0, 0, 0, -8, 0, 0]), 0.0, 0.5),  # a pole
        (("SIMPLE_RADIAL", [500, 320, 240, -2]), 0.0, 0.5),
        (("EUCM", [300, 300, 320, 240, 0.6, 40]), 0.0, 0.5),
        (("EUCM", [300, 300, 320, 240, 0.6, 1.1]), 1.0, 1.1),
        (("FOV", [400, 400, 320, 240, 1.4]), 1.0, 1.1),
        (("OPENCV_FISHEYE", [230, 230, 320, 240, 0, 0, 0, 0]), 1.0, 1.1),
        (("OPENCV_FISHEYE", [120, 120, 320, 240, 0, 0, 0, 0]), 0.0, 0.8),  # 229 degrees
    ],
)
def test_the_share_of_an_image_whose_distortion_can_be_inverted(
    camera: tuple[str, list[float]], at_least: float, below: float
) -> None:
    model, params = camera
    share = invertible_share(pycolmap.Camera(model=model, width=640, height=480, params=params))
    assert at_least <= share < below


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("FULL_OPENCV", [520, 510, 318, 243, 5, 3, 0, 0, 2, 5, 3, 2]),  # calibrated so by Azure Kinect: a pinhole
        ("EUCM", [520, 510, 318, 243, 0, 40]),
        ("PINHOLE", [6500, 6500, 320, 240]),
        ("PINHOLE", [520, 510, 700, -20]),  # of a crop
    ],
)
def test_cameras_that_colmap_silently_ignores_have_points(model: str, params: list[float]) -> None:
    scene = Ring(pycolmap.Camera(model=model, width=640, height=480, params=params))
    found = scene.triangulate()
    truth = scene.truth(found)
    assert len(found.points) > 5
    seen = [len(np.intersect1d(a, b)) for a, b in zip(scene.point_of, scene.point_of[1:], strict=False)]
    assert len(found.points) > 0.5 * max(seen)
    np.testing.assert_allclose(found.points[found.obs_point], scene.points[truth], atol=1e-3)


# --------------------------------------------------------------------------------------------------- pairs


def test_pairs_have_a_baseline_a_common_view_and_no_common_group() -> None:
    poses = np.stack(
        [
            looking_at([0, 0, 0], [0, 9, 0]),
            looking_at([0.01, 0, 0], [0, 9, 0]),  # 1: next to no baseline
            looking_at([0.8, 0, 0], [0, 9, 0]),  # 2: a good one
            looking_at([0.5, -0.5, 0], [0.5, -9, 0]),  # 3: back to back
            looking_at([500, 0, 0], [500, 9, 0]),  # 4: elsewhere
        ]
    )
    cameras, alone = [PINHOLE] * 5, np.arange(5)
    best = select_pairs(poses, cameras, alone, per_image=1)
    assert (best == [0, 2]).all(axis=1).any()
    assert not (best == [0, 1]).all(axis=1).any()
    everything = select_pairs(poses, cameras, alone).tolist()
    assert [0, 2] in everything
    assert not [pair for pair in everything if 3 in pair or 4 in pair]
    # The same, but 0 and 2 are cameras of one rig at one instant.
    assert [0, 2] not in select_pairs(poses, cameras, np.array([0, 1, 0, 2, 3])).tolist()


def test_pairs_are_sorted_unique_and_limited() -> None:
    poses = ring(20, sector_deg=60)
    pairs = select_pairs(poses, [PINHOLE] * 20, np.arange(20), per_image=3)
    assert pairs.dtype == np.int64
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert pairs.tolist() == sorted(map(list, set(map(tuple, pairs.tolist()))))
    assert 20 * 3 / 2 <= len(pairs) <= 20 * 3
    assert set(pairs.ravel()) == set(range(20))


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_images_for_a_pair(count: int) -> None:
    assert select_pairs(np.tile(np.eye(4), (count, 1, 1)), [PINHOLE] * count, np.arange(count)).shape == (0, 2)


def test_images_in_one_place_in_one_group_have_no_pair() -> None:
    assert select_pairs(np.tile(np.eye(4), (4, 1, 1)), [PINHOLE] * 4, np.zeros(4, np.int64)).shape == (0, 2)


# ------------------------------------------------------------------------------------------- triangulation


@pytest.mark.parametrize("model", CAMERAS)
def test_points_come_out_where_they_are(model: str) -> None:
    data = Ring(CAMERAS[model])
    local_map = data.triangulate()
    truth = data.truth(local_map)
    # Every keypoint of a point names that point, and each point is there once.
    true_point = np.full(len(local_map.points), -1)
    true_point[local_map.obs_point] = truth
    np.testing.assert_array_equal(true_point[local_map.obs_point], truth)
    assert len(np.unique(true_point)) == len(true_point) > 0.98 * len(data.points)
    assert np.linalg.norm(local_map.points - data.points[true_point], axis=1).max() < 1e-3
    assert np.diff(local_map.point_starts).mean() > 6
    # The poses are the capture's, bit for bit.
    assert local_map.world_from_cams.tobytes() == data.world_from_cams.tobytes()
    assert local_map.image_names == data.names
    assert local_map.colors.shape == (len(local_map.points), 3)


def test_noise_is_averaged_over_the_views() -> None:
    data = Ring(PINHOLE, count=10, noise_px=0.5)
    local_map = data.triangulate()
    true_point = np.zeros(len(local_map.points), np.int64)
    true_point[local_map.obs_point] = data.truth(local_map)
    errors = np.linalg.norm(local_map.points - data.points[true_point], axis=1)
    # 0.5 px of 520 at 6 m are 6 mm a view and axis; ten views over 120 degrees make it less than that in space.
    assert np.median(errors) < 5e-3


@pytest.mark.parametrize("count", [2, 4])
def test_the_scatter_of_points_is_their_covariance(count: int) -> None:
    data = Ring(PINHOLE, count=count, points=3000, noise_px=0.5)
    local_map = data.triangulate()
    np.testing.assert_allclose(local_map.noise_px, 0.5, rtol=0.05)
    true_point = np.zeros(len(local_map.points), np.int64)
    true_point[local_map.obs_point] = data.truth(local_map)
    asked = np.random.default_rng(0).permutation(len(local_map.points))
    covariances = local_map.point_covariances(asked)
    errors = (local_map.points - data.points[true_point])[asked]
    round_errors = np.linalg.solve(np.linalg.cholesky(covariances), errors[..., None])[..., 0]
    scatter = round_errors.T @ round_errors / len(errors)
    np.testing.assert_allclose(np.linalg.eigvalsh(scatter), 1, atol=0.15)


def test_a_point_of_one_view_has_no_covariance() -> None:
    data = Ring(PINHOLE, count=3)
    local_map = data.triangulate()
    first = local_map.obs_image == 0
    seen_once = replace(
        local_map,
        obs_image=local_map.obs_image[first],
        obs_keypoint=local_map.obs_keypoint[first],
        obs_point=local_map.obs_point[first],
    )
    assert np.isnan(seen_once.point_covariances(np.arange(5))).all()
    assert seen_once.point_covariances(np.zeros(0, np.int64)).shape == (0, 3, 3)


def test_wrong_matches_are_dropped() -> None:
    data, rng = Ring(PINHOLE), np.random.default_rng(1)
    wrong = 0
    for matches in data.matches:
        swapped = rng.choice(len(matches), len(matches) // 5, replace=False)
        matches[swapped, 1] = matches[np.roll(swapped, 1), 1]
        wrong += len(swapped)
    local_map = data.triangulate()
    truth = data.truth(local_map)
    errors = np.linalg.norm(local_map.points[local_map.obs_point] - data.points[truth], axis=1)
    assert wrong > 1000
    assert (errors > 0.05).mean() < 0.01
    assert len(np.unique(truth)) > 0.95 * len(data.points)


def test_observations_agree_with_the_points() -> None:
    data = Ring(CAMERAS["OPENCV"], noise_px=0.5)
    local_map = data.triangulate()
    assert (np.diff(local_map.obs_image) >= 0).all()
    for image in range(len(local_map.image_names)):
        keypoint, point = local_map.observations(image)
        in_cam = geometry.transform(local_map.cams_from_world[image], local_map.points[point])
        projected = np.asarray(local_map.cameras[image].img_from_cam(in_cam))
        error = np.linalg.norm(projected - data.keypoints[image][keypoint], axis=1)
        assert error.max() < 1.5 * MAX_REPROJECTION_ERROR_PX
    # Every point is seen by two images at least, and the counts are those of the observations.
    views = {(i, p) for i, p in zip(local_map.obs_image.tolist(), local_map.obs_point.tolist(), strict=True)}
    counts = np.bincount([p for _, p in views], minlength=len(local_map.points))
    assert counts.min() >= 2
    lengths = local_map.track_lengths(np.arange(len(local_map.points)))
    np.testing.assert_array_equal(lengths, np.bincount(local_map.obs_point))
    some = np.array([0, 5, 7])
    expected = [sum((i, int(p)) in views for p in some) for i in range(len(data.names))]
    assert local_map.images_seeing(some).tolist() == expected
    assert local_map.images_seeing(np.zeros(0, np.int64)).tolist() == [0] * len(data.names)
    assert local_map.index_of[data.names[3]] == 3


def test_points_under_a_small_angle_are_not_kept() -> None:
    data = Ring(PINHOLE, count=2)
    data.world_from_cams = np.stack([looking_at([6, 0, 0], [0, 0, 0]), looking_at([6, 0.01, 0], [0, 0.01, 0])])
    for index, pose in enumerate(geometry.invert(data.world_from_cams)):
        pixels = PINHOLE.img_from_cam(geometry.transform(pose, data.points))
        data.keypoints[index] = np.asarray(pixels, np.float32)
        data.point_of[index] = np.arange(len(data.points))
    data.matches = [data.common(0, 1)]
    assert len(data.triangulate().points) == 0


@pytest.mark.parametrize("pairs", [0, 3])
def test_no_matches_give_a_map_without_points(pairs: int) -> None:
    data = Ring(PINHOLE, count=3)
    data.pairs, data.matches = data.pairs[:pairs], [np.zeros((0, 2), np.int64)] * pairs
    local_map = data.triangulate()
    assert local_map.points.shape == (0, 3)
    assert local_map.obs_image.shape == (0,)
    assert local_map.images_seeing(np.zeros(0, np.int64)).tolist() == [0, 0, 0]
    assert [len(part) for part in local_map.observations(1)] == [0, 0]


def test_triangulation_is_the_same_each_time() -> None:
    first, second = (Ring(PINHOLE, noise_px=0.5).triangulate() for _ in range(2))
    assert first.points.tobytes() == second.points.tobytes()
    np.testing.assert_array_equal(first.obs_keypoint, second.obs_keypoint)


# ------------------------------------------------------------------------------------------------ the file


def assert_equal(a: LocalMap, b: LocalMap) -> None:
    assert a.image_names == b.image_names
    assert [(c.model, c.width, c.height, list(c.params)) for c in a.cameras] == [
        (c.model, c.width, c.height, list(c.params)) for c in b.cameras
    ]
    for name in ("world_from_cams", "points", "colors", "obs_image", "obs_keypoint", "obs_point", "noise_px"):
        first, second = getattr(a, name), getattr(b, name)
        assert first.dtype == second.dtype
        np.testing.assert_array_equal(first, second)


def test_a_written_map_reads_back_equal(tmp_path: Path) -> None:
    data = Ring(PINHOLE, count=3)
    data.cameras = list(CAMERAS.values())
    data.names[1] = "ios_map/raw_data/ä b/1.jpg"
    local_map = replace(data.triangulate(), colors=np.zeros((0, 3), np.uint8))
    local_map = replace(local_map, colors=np.arange(3 * len(local_map.points), dtype=np.uint8).reshape(-1, 3))
    local_map.save(tmp_path / "map.npz")
    assert_equal(LocalMap.load(tmp_path / "map.npz"), local_map)


def test_a_map_without_points_reads_back(tmp_path: Path) -> None:
    data = Ring(PINHOLE, count=1)
    local_map = data.triangulate()
    local_map.save(tmp_path / "map.npz")
    assert_equal(LocalMap.load(tmp_path / "map.npz"), local_map)


@pytest.mark.parametrize("keep", ["nothing", "something else", 0, 3, 50, 0.5, 0.99])
def test_a_missing_or_torn_map_or_a_file_of_something_else_says_what_to_do(tmp_path: Path, keep: float | str) -> None:
    path = tmp_path / "map.npz"
    if keep == "something else":
        np.savez(path, vectors=np.zeros(3))
    elif not isinstance(keep, str):
        Ring(PINHOLE, count=3, points=50).triangulate().save(path)
        content = path.read_bytes()
        path.write_bytes(content[: int(keep * len(content)) if 0 < keep < 1 else int(keep)])
    with pytest.raises(ArtifactError, match=r"map\.npz cannot be read.*localize stage"):
        LocalMap.load(path)


# ----------------------------------------------------------------------------------------------- build_map


@pytest.fixture(scope="module")
def phone(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, FeatureStore]:
    """The phone's map session of the rendered capture, and its features."""
    session = Capture.open(small_capture)["ios_map"]
    sift = SiftExtractor(SiftSettings(max_keypoints=800))
    return session, extract_session(session, tmp_path_factory.mktemp("features"), sift, progress=False)


def test_a_map_of_photographs(phone: tuple[Session, FeatureStore], tmp_path: Path) -> None:
    session, store = phone
    local_map = build_map(session, store, tmp_path / "ios_map.npz")
    assert local_map.image_names == [session.image_name(row) for row in range(len(session.images))]
    np.testing.assert_array_equal(local_map.world_from_cams, session.world_from_cam())
    assert len(local_map.points) > 200
    for image in range(len(local_map.image_names)):
        keypoint, point = local_map.observations(image)
        in_cam = geometry.transform(local_map.cams_from_world[image], local_map.points[point])
        projected = np.asarray(local_map.cameras[image].img_from_cam(in_cam))
        error = np.linalg.norm(projected - store[local_map.image_names[image]].keypoints[keypoint], axis=1)
        assert np.median(error) < 1
    # The points wear the colors of the photographs, not the gray they start with.
    assert np.std(local_map.colors.astype(float), axis=0).min() > 10
    assert_equal(LocalMap.load(tmp_path / "ios_map.npz"), local_map)


def test_a_current_map_is_loaded_and_another_is_built(
    phone: tuple[Session, FeatureStore], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, store = phone
    path, quick = tmp_path / "ios_map.npz", MapSettings(pairs_per_image=2)
    first = build_map(session, store, path, quick, inputs="a")
    built = []
    work = mapping.match_pairs
    monkeypatch.setattr(mapping, "match_pairs", lambda *args: built.append(1) or work(*args))
    assert_equal(build_map(session, store, path, quick, inputs="a"), first)
    assert not built
    assert json.loads(sidecar_path(path).read_text())["settings"]["map"]["pairs_per_image"] == 2
    for more in [
        {"inputs": "b"},
        {"inputs": "b", "settings": quick.model_copy(update={"pairs_per_image": 3})},
        {"inputs": "b", "settings": quick.model_copy(update={"pairs_per_image": 3}), "skip_existing": False},
    ]:
        built.clear()
        build_map(session, store, path, **({"settings": quick} | more))
        assert built
    built.clear()
    build_map(session, store, path, quick, inputs="b")
    monkeypatch.setitem(KINDS, "sift", replace(KINDS["sift"], shorten=None))
    again = build_map(session, store, path, quick, inputs="b")
    assert len(built) == 2, "descriptors are compared in another way"
    assert not np.array_equal(again.points, first.points)


def test_after_a_change_only_the_pairs_of_the_changed_image_are_matched(
    phone: tuple[Session, FeatureStore], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, store = phone
    quick = MapSettings(pairs_per_image=2)
    asked: list[list[list[int]]] = []
    work = mapping.match_pairs
    monkeypatch.setattr(mapping, "match_pairs", lambda pairs, *args: asked.append(pairs.tolist()) or work(pairs, *args))
    first = build_map(session, store, tmp_path / "ios_map.npz", quick, inputs="a")
    changed = {**store.made_from, next(iter(store)): "another image"}
    other = FeatureStore(store.path, changed, settings=store.settings)
    assert_equal(build_map(session, other, tmp_path / "ios_map.npz", quick, inputs="b"), first)
    everything, again = asked
    assert again == [pair for pair in everything if 0 in pair]
    assert 0 < len(again) < len(everything)


def test_a_torn_map_with_a_valid_record_is_built_anew(phone: tuple[Session, FeatureStore], tmp_path: Path) -> None:
    session, store = phone
    path, quick = tmp_path / "ios_map.npz", MapSettings(pairs_per_image=2)
    first = build_map(session, store, path, quick)
    path.write_bytes(path.read_bytes()[:5000])
    assert_equal(build_map(session, store, path, quick), first)


def test_images_without_features_or_pose_are_left_out(phone: tuple[Session, FeatureStore], tmp_path: Path) -> None:
    session, store = phone
    partial = FeatureStore(store.path, dict(list(store.made_from.items())[:5]), settings=store.settings)
    local_map = build_map(session, partial, tmp_path / "ios_map.npz")
    assert sorted(local_map.image_names) == sorted(partial)
    assert 0 < len(partial) < len(session.images)
    with pytest.raises(ArtifactError, match="ios_map has no image with a pose and local features"):
        build_map(session, FeatureStore(store.path, {}), tmp_path / "other.npz")


def test_a_map_of_a_single_image_has_no_points(tmp_path: Path) -> None:
    path = tmp_path / "CAP" / "sessions" / "ios_map"
    image = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    (path / "raw_data").mkdir(parents=True)
    cv2.imwrite(str(path / "raw_data" / "0.png"), cv2.GaussianBlur(image, (0, 0), 2))
    sensor = ("cam", "cam", "camera", "PINHOLE", 320, 240, 300, 300, 160, 120)
    write_session(path, [sensor], None, Trajectory.from_poses([5], ["cam"], np.eye(4)[None]), [(5, "cam", "0.png")])
    session = Session.open(path)
    store = extract_session(session, tmp_path / "features", progress=False)
    assert len(store[session.image_name(0)]) > 10
    local_map = build_map(session, store, tmp_path / "map.npz")
    assert local_map.image_names == ["ios_map/raw_data/0.png"]
    assert len(local_map.points) == 0
    assert len(LocalMap.load(tmp_path / "map.npz").points) == 0


def test_points_that_earlier_tiles_have_taken_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    ring = Ring(PINHOLE)
    found = triangulate(ring.names, ring.cameras, ring.world_from_cams, ring.keypoints, ring.pairs, ring.matches)
    observations = np.column_stack([found.obs_image, found.obs_keypoint, found.obs_point])
    observations = observations[observations[:, 2] > 0]
    monkeypatch.setattr("toolkit.mapping.triangulation._CHUNK", 1)  # the first chunk has no observation
    refined = refine_points(found.points, observations, ring.cameras, ring.world_from_cams, ring.keypoints)
    assert len(refined.points) == len(found.points) - 1
