"""Whether matches contradict the intrinsics of a query: known answers, and what noise alone does."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.pose.base import CAMERA, Correspondences, Matches, Query, QueryResult, RigQuery, Status, View
from toolkit.pose.map_matching import MAX_SHARES, OWN_FOCAL_STD, IntrinsicsCheck, check_intrinsics, with_own_focals

Floats = NDArray[np.float64]
MAX_ERROR_DEG = 0.45
SIZE = {"width": 960, "height": 640}
TRUE = pycolmap.Camera(model="PINHOLE", **SIZE, params=[925, 925, 481.8, 317.9])
TURNED = geometry.make_pose(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([0.2, 0.0, 0.1]))


def changed(f: float = 1.0, x: float = 0.0, k1: float = 0.0) -> pycolmap.Camera:
    """Return the true camera with another focal length, principal point (by the width) or radial distortion."""
    params = [925 * f, 925 * f, 481.8 + 960 * x, 317.9, k1, 0, 0, 0]
    return pycolmap.Camera(model="OPENCV", **SIZE, params=params)


def scene(rng: np.random.Generator, rig_from_cams: Floats, count: int, depth: tuple[float, float]) -> tuple:
    """Return matches of what true cameras see of points at some depth, with 0.7 px noise and a fifth of outliers."""
    pixels, points, camera = [], [], []
    for index, rig_from_cam in enumerate(rig_from_cams):
        xy = rng.uniform(0, (960, 640), (count, 2))
        in_cam = np.column_stack([np.asarray(TRUE.cam_from_img(xy)), np.ones(count)])
        in_cam *= rng.uniform(*depth, (count, 1))
        xy += rng.normal(0, 0.7, xy.shape)
        xy[: count // 5] = rng.uniform(0, (960, 640), (count // 5, 2))
        pixels.append(xy)
        points.append(geometry.transform(rig_from_cam, in_cam))
        camera.append(np.full(count, index))
    matches = Matches(np.concatenate(camera), np.concatenate(pixels), np.arange(count * len(rig_from_cams)))
    return matches, np.concatenate(points)


def judged(
    cameras: list[pycolmap.Camera],
    seed: int = 0,
    count: int = 300,
    depth: tuple[float, float] = (4.0, 15.0),
    rig_from_cams: Floats | None = None,
) -> tuple[IntrinsicsCheck | None, Floats]:
    """Return what is said of cameras, and the pose found with them: the true one is the identity."""
    rig_from_cams = np.stack([np.eye(4), TURNED])[: len(cameras)] if rig_from_cams is None else rig_from_cams
    matches, points = scene(np.random.default_rng(seed), rig_from_cams, count, depth)
    query = RigQuery(cameras, rig_from_cams, [[] for _ in cameras])
    inliers = matches[query.errors_deg(np.eye(4), matches, points) < 3]
    pose = query.refine(np.eye(4), inliers, points)
    assert pose is not None
    return check_intrinsics(query, pose, matches, points, MAX_ERROR_DEG), pose


@pytest.mark.parametrize("factor", [0.6, 0.75, 0.9, 0.98, 1.02, 1.1, 1.37])
def test_a_wrong_focal_length_is_found_with_the_one_that_fits(factor: float) -> None:
    camera = changed(factor)
    check, pose = judged([camera])
    assert check is not None
    assert check.doubtful
    assert check.focals_px([camera]) == pytest.approx([925], rel=0.004)
    assert "the focal length that fits is 92" in check.reason([camera])
    # The shift leads from the pose with the wrong focal length to the true one.
    off_m = np.linalg.norm(geometry.invert(pose)[:3, 3])
    assert np.linalg.norm(check.shift[3:]) == pytest.approx(off_m, abs=0.03)


def test_a_wrong_principal_point_and_a_distortion_left_out_are_no_focal_length() -> None:
    for camera, says in ((changed(x=0.03), "principal point that fits is 48"), (changed(k1=0.1), "radial distortion")):
        check, _ = judged([camera])
        assert check is not None
        assert check.doubtful
        assert np.isnan(check.focals_px([camera])).all()
        assert says in check.reason([camera])


def test_noise_does_not_look_like_a_wrong_camera() -> None:
    """Of 300 right cameras, with few matches and with many, none is doubted."""
    said = [judged([TRUE], seed, count)[0] for seed in range(100) for count in (20, 60, 300)]
    assert [check for check in said if check is not None] == []


def test_a_plane_that_faces_the_camera_says_nothing_of_the_focal_length() -> None:
    check, pose = judged([changed(1.1)], depth=(8.0, 8.0))
    assert check is None
    assert abs(geometry.invert(pose)[2, 3]) > 0.5, "the distance makes up for it"


def test_of_a_rig_the_wrong_camera_is_named() -> None:
    cameras = [TRUE, changed(0.9)]
    check, _ = judged(cameras)
    assert check is not None
    right, wrong = check.focals_px(cameras)
    assert np.isnan(right)
    assert wrong == pytest.approx(925, rel=0.004)
    assert check.reason(cameras).startswith("camera 2 of 2: ")


def test_all_cameras_of_a_rig_may_be_wrong() -> None:
    cameras = [changed(0.9), changed(0.9)]
    check, _ = judged(cameras)
    assert check is not None
    assert check.focals_px(cameras) == pytest.approx([925, 925], rel=0.004)


def test_a_small_contradiction_is_significant_but_no_reason_to_doubt() -> None:
    check, _ = judged([changed(x=0.02)], count=3000)
    assert check is not None
    assert 0 < check.shares.max() == check.shares[0, 1] < MAX_SHARES[1]
    assert not check.doubtful


@pytest.mark.parametrize("factor", [0.1, 0.2, 0.33, 3.0, 5.0, 10.0])
def test_an_absurd_focal_length_is_found_from_the_pose_that_it_gave(factor: float) -> None:
    """RANSAC finds some pose with it, from which no fit begins."""
    camera = changed(factor)
    matches, points = scene(np.random.default_rng(1), np.eye(4)[None], 300, (4.0, 15.0))
    query = RigQuery([camera], np.eye(4)[None], [[]])
    pose = query.ransac(matches, points, MAX_ERROR_DEG, seed=0, max_trials=1000)
    assert pose is not None
    check = check_intrinsics(query, pose, matches, points, MAX_ERROR_DEG)
    assert check is not None
    assert check.doubtful
    assert check.focals_px([camera]) == pytest.approx([925], rel=0.01)


@pytest.mark.parametrize("camera", [changed(x=-0.5), changed(k1=-44.0), changed(k1=5.0)], ids=["center", "fold", "k1"])
def test_other_absurd_intrinsics_are_doubted(camera: pycolmap.Camera) -> None:
    matches, points = scene(np.random.default_rng(1), np.eye(4)[None], 300, (4.0, 15.0))
    query = RigQuery([camera], np.eye(4)[None], [[]])
    pose = query.ransac(matches, points, MAX_ERROR_DEG, seed=0)
    check = None if pose is None else check_intrinsics(query, pose, matches, points, MAX_ERROR_DEG)
    assert pose is None or (check is not None and check.doubtful)


def test_another_camera_with_more_inliers_all_over_the_same_image_is_no_contradiction() -> None:
    """By night, where windows repeat, few matches are right, and more may fit another camera and pose."""
    rng = np.random.default_rng(0)
    right, points = scene(rng, np.eye(4)[None], 100, (4.0, 15.0))
    xy = rng.uniform(0, (960, 640), (130, 2))
    rays = np.column_stack([(xy - (480, 320)) / 3840, np.ones(130)])
    repeated = geometry.transform(TURNED, rays * rng.uniform(4, 15, (130, 1)))
    strays = rng.uniform(0, (960, 640), (320, 2))
    pixels = np.concatenate([right.pixels, xy + rng.normal(0, 0.7, xy.shape), strays])
    points = np.concatenate([points, repeated, rng.uniform(-5, 15, (320, 3))])
    matches = Matches(np.zeros(len(pixels), np.int64), pixels, np.arange(len(pixels)))
    query = RigQuery([TRUE], np.eye(4)[None], [[]])
    pose = query.refine(np.eye(4), matches[np.arange(20, 100)], points)
    assert check_intrinsics(query, pose, matches, points, MAX_ERROR_DEG) is None


def test_errors_that_neighbors_share_do_not_look_like_a_wrong_camera() -> None:
    """A rolling shutter moves each row of the image by another amount: for a moment, it looks like other intrinsics."""
    doubted = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        matches, points = scene(rng, np.eye(4)[None], 400, (4.0, 15.0))
        phase, pixels = rng.uniform(0, 6, 2), matches.pixels
        shift = 2 * np.sin(pixels[:, 1:] / 200 + phase)  # 2 px, with a period of twice the height
        shaken = Matches(matches.camera, pixels + shift, matches.point)
        query = RigQuery([TRUE], np.eye(4)[None], [[]])
        pose = query.refine(np.eye(4), shaken[query.errors_deg(np.eye(4), shaken, points) < 3], points)
        check = check_intrinsics(query, pose, shaken, points, MAX_ERROR_DEG)
        doubted += check is not None and check.doubtful
    assert doubted == 0


def test_noise_of_the_poses_of_the_map_is_not_blamed_on_the_camera() -> None:
    camera, rig = changed(x=0.03), np.eye(4)[None]
    matches, points = scene(np.random.default_rng(0), rig, 300, (4.0, 15.0))
    query = RigQuery([camera], rig, [[]])
    pose = query.refine(np.eye(4), matches[query.errors_deg(np.eye(4), matches, points) < 3], points)
    assert check_intrinsics(query, pose, matches, points, MAX_ERROR_DEG) is not None
    assert check_intrinsics(query, pose, matches, points, MAX_ERROR_DEG, noise_deg=2.0) is None


def localized(depth: tuple[float, float], focals: tuple[float, ...]) -> tuple[Query, QueryResult]:
    """Return a query whose cameras have other focal lengths than the true ones, and its result with these."""
    cameras, rig_from_cams = list(map(changed, focals)), np.stack([np.eye(4), TURNED])[: len(focals)]
    matches, points = scene(np.random.default_rng(3), rig_from_cams, 300, depth)
    rig = RigQuery(cameras, rig_from_cams, [[] for _ in cameras])
    agrees = rig.errors_deg(np.eye(4), matches, points) < MAX_ERROR_DEG
    world_from_rig = geometry.invert(rig.refine(np.eye(4), matches[agrees], points))
    found = Correspondences(matches.camera, matches.pixels, points, matches.point, agrees)
    result = QueryResult(
        Status.OK, world_from_rig=world_from_rig, covariance=np.zeros((6, 6)), remark="first", correspondences=found
    )
    return Query([View("", "", camera, False) for camera in cameras], rig_from_cams), result


@pytest.mark.parametrize("focals", [(0.993,), (1.008,), (0.995, 1.006)])
def test_an_image_has_its_own_focal_length_near_that_of_its_camera(focals: tuple[float, ...]) -> None:
    query, result = localized((4.0, 15.0), focals)
    own = with_own_focals(query, result, MAX_ERROR_DEG)
    assert own.world_from_rig is not None
    assert result.world_from_rig is not None
    before, after = (np.linalg.norm(pose[:3, 3]) for pose in (result.world_from_rig, own.world_from_rig))
    assert after < 0.5 * before
    found = own.remark.removeprefix("first; focal length of the image ").removesuffix(" px").split(", ")
    assert [float(focal) for focal in found] == pytest.approx([925] * len(focals), rel=0.002)
    # What the matches leave open of the focal lengths is in the covariance, which was 0.
    assert after < 3 * own.position_std < 3 * before
    assert np.linalg.eigvalsh(own.covariance).min() > -1e-12


def test_where_matches_do_not_tell_the_focal_length_it_stays() -> None:
    query, result = localized((8.0, 8.0), (1.0,))
    own = with_own_focals(query, result, MAX_ERROR_DEG)
    assert own.world_from_rig == pytest.approx(result.world_from_rig, abs=3e-3)
    assert own.position_std == pytest.approx(8.0 * OWN_FOCAL_STD, rel=0.1)  # the plane is 8 m away


def test_a_result_that_is_not_ok_stays() -> None:
    query, result = localized((4.0, 15.0), (0.993,))
    for one in (QueryResult.failed("dark"), replace(result, status=Status.LOW_CONFIDENCE, reason=CAMERA)):
        assert with_own_focals(query, one, MAX_ERROR_DEG) is one
