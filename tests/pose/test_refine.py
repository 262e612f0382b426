"""The refinement of a pose: against COLMAP's, with distorted lenses and rigs, and lenses that PoseLib does not know."""

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.pose.base import Matches, RigQuery

SIZE = {"width": 960, "height": 640}
CAMERAS = [
    pycolmap.Camera(model="PINHOLE", **SIZE, params=[925, 915, 481.8, 317.9]),
    pycolmap.Camera(model="OPENCV_FISHEYE", **SIZE, params=[500, 505, 478, 322, 0.05, -0.01, 0, 0]),
    pycolmap.Camera(model="RADIAL", **SIZE, params=[700, 480, 320, 0.1, -0.02]),
]
STRANGE = [
    pycolmap.Camera(model="FOV", **SIZE, params=[500, 500, 480, 320, 0.8]),
    pycolmap.Camera(model="THIN_PRISM_FISHEYE", **SIZE, params=[500, 505, 478, 322, 0.05, *[0.0] * 5, 0.01, 0]),
    pycolmap.Camera(model="RADIAL_FISHEYE", **SIZE, params=[500, 480, 320, 0.05, -0.01]),
]
TURN = Rotation.from_rotvec(np.radians([[0, 0, 0], [0, 90, 0], [0, 180, 0]])).as_matrix()
RIG_FROM_CAMS = geometry.make_pose(TURN, np.array([[0.0, 0, 0], [0.2, 0, 0.1], [0, 0.1, -0.2]]))


def scene(number: int, count: int = 200) -> tuple[RigQuery, Matches, NDArray[np.float64]]:
    """Return the first cameras at the origin, and matches with 0.5 px of noise, a tenth of them wrong."""
    rng, pixels, points = np.random.default_rng(number), [], []
    for camera, rig_from_cam in zip(CAMERAS[:number], RIG_FROM_CAMS, strict=False):
        xy = rng.uniform(50, (910, 590), (count, 2))
        rays = np.column_stack([np.asarray(camera.cam_from_img(xy)), np.ones(count)])
        points.append(geometry.transform(rig_from_cam, rays * rng.uniform(4, 15, (count, 1))))
        xy += rng.normal(0, 0.5, xy.shape)
        xy[: count // 10] += rng.normal(0, 20, (count // 10, 2))
        pixels.append(xy)
    which = np.repeat(np.arange(number), count)
    query = RigQuery(CAMERAS[:number], RIG_FROM_CAMS[:number], [[] for _ in range(number)])
    return query, Matches(which, np.concatenate(pixels), np.arange(number * count)), np.concatenate(points)


def refined_by_colmap(
    query: RigQuery, start: NDArray[np.float64], matches: Matches, points: NDArray[np.float64], scale_px: float
) -> NDArray[np.float64]:
    refined = pycolmap.refine_generalized_absolute_pose(
        pycolmap.Rigid3d(start[:3]),
        matches.pixels,
        points,
        np.ones(len(matches), bool),
        matches.camera.tolist(),
        [pycolmap.Rigid3d(cam[:3]) for cam in geometry.invert(query.rig_from_cams)],
        query.cameras,
        pycolmap.AbsolutePoseRefinementOptions(gradient_tolerance=1e-9, loss_function_scale=scale_px),
    )
    assert refined is not None
    return np.vstack([refined["rig_from_world"].matrix(), [0, 0, 0, 1]])


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_pose_is_that_of_colmap(number: int) -> None:
    query, matches, points = scene(number)
    start = geometry.make_pose(Rotation.from_rotvec([0.02, -0.01, 0.01]).as_matrix(), [0.1, 0.05, -0.1])
    pose = query.refine(start, matches, points)
    rotation_deg, distance_m = geometry.pose_error(pose, refined_by_colmap(query, start, matches, points, 1.0))
    assert rotation_deg < 3e-4
    assert distance_m < 5e-5
    off_deg, off_m = geometry.pose_error(pose, np.eye(4))
    assert off_deg < 0.02
    assert off_m < 0.01


@pytest.mark.parametrize("camera", STRANGE, ids=lambda camera: camera.model.name)
def test_a_lens_that_poselib_does_not_know(camera: pycolmap.Camera) -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(50, (910, 590), (200, 2))
    points = np.column_stack([np.asarray(camera.cam_from_img(xy)), np.ones(200)]) * rng.uniform(4, 15, (200, 1))
    query = RigQuery([camera], RIG_FROM_CAMS[:1], [[]])
    start = geometry.make_pose(Rotation.from_rotvec([0.02, -0.01, 0.01]).as_matrix(), [0.1, 0.05, -0.1])
    pose = query.refine(start, Matches(np.zeros(200, int), xy, np.arange(200)), points)
    rotation_deg, distance_m = geometry.pose_error(pose, np.eye(4))
    assert rotation_deg < 1e-5
    assert distance_m < 1e-5


def test_points_behind_the_camera_have_no_say() -> None:
    query, matches, points = scene(1)
    points[150:] *= -1
    pose = query.refine(np.eye(4), matches, points)
    assert geometry.pose_error(pose, np.eye(4))[1] < 0.01


@pytest.mark.parametrize("number", [1, 3])
def test_from_a_close_pose_the_scale_of_the_loss_follows_the_errors(number: int) -> None:
    query, matches, points = scene(number)
    start = geometry.make_pose(np.eye(3), [0.002, 0, 0])
    scale_px = 0.6 * (1 + 5 / (len(matches) - 6)) * float(np.median(query.errors_px(start, matches, points)))
    assert 0.3 < scale_px < 0.6
    pose = query.refine(start, matches, points, close=True)
    theirs = refined_by_colmap(query, start, matches, points, scale_px)
    rotation_deg, distance_m = geometry.pose_error(pose, theirs)
    assert rotation_deg < 1e-3
    assert distance_m < 1e-4
    with_one_px = geometry.pose_error(refined_by_colmap(query, start, matches, points, 1.0), theirs)
    assert with_one_px[1] > 2e-4


@pytest.mark.parametrize("count", [6, 7])
def test_from_a_close_pose_few_matches_keep_the_scale_of_one_pixel(count: int) -> None:
    """Seven matches of six unknowns fit too well for their errors to tell the noise: they have its limit, 1 px."""
    query, matches, points = scene(1)
    few = matches[np.arange(20, 20 + count)]
    start = geometry.make_pose(np.eye(3), [0.002, 0, 0])
    pose, theirs = (
        query.refine(start, few, points, close=True),
        refined_by_colmap(query, start, few, points[few.point], 1.0),
    )
    rotation_deg, distance_m = geometry.pose_error(pose, theirs)
    assert rotation_deg < 1e-3
    assert distance_m < 1e-4
