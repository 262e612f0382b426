"""PnP in a synthetic map whose points, descriptors and poses are known."""

import ctypes
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from threading import Event, Thread

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.queries import ask, indices_of, rests_on
from toolkit import geometry
from toolkit.features.features import (
    DESCRIPTOR_SCALE,
    KINDS,
    LocalFeatures,
    MutualMatcher,
    PairMatches,
    unit_descriptors,
)
from toolkit.manifest import PnpSettings
from toolkit.mapping.local_map import Consistency, LocalMap
from toolkit.pose import map_matching as matches
from toolkit.pose import pnp
from toolkit.pose.base import CAMERA, NOISE, Matches, Prior, QueryResult, References, RigQuery, Status
from toolkit.pose.map_matching import MappedFeatures
from toolkit.pose.pnp import (
    FIRST_REFERENCES,
    GUIDED_WEIGHT,
    VIEWS,
    PnpLocalizer,
    _Hypothesis,
    _relative_support,
    _support,
    least_squares_covariance,
)

Floats = NDArray[np.float64]
SIZE_M = 0.02  # standard deviation of each point's blob on its surface

CAMERAS = {
    "PINHOLE": pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 505, 322, 239]),
    "OPENCV": pycolmap.Camera(
        model="OPENCV", width=640, height=480, params=[500, 505, 322, 239, -0.25, 0.08, 0.002, -0.001]
    ),
    "OPENCV_FISHEYE": pycolmap.Camera(
        model="OPENCV_FISHEYE", width=640, height=480, params=[300, 302, 322, 239, 0.03, -0.01, 0.002, 0.001]
    ),
}
PINHOLE = CAMERAS["PINHOLE"]


def random_descriptors(rng: np.random.Generator, count: int) -> Floats:
    vectors = np.abs(rng.normal(size=(count, 128)))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def stored(rng: np.random.Generator, descriptors: Floats, noise: float = 0.3) -> NDArray[np.uint8]:
    """Return what an image keeps of descriptors: each time a little different."""
    shaky = np.abs(descriptors + noise * rng.normal(size=descriptors.shape) / np.sqrt(128))
    shaky /= np.maximum(np.linalg.norm(shaky, axis=1, keepdims=True), 1e-9)
    return np.clip(np.round(shaky * DESCRIPTOR_SCALE), 0, 255).astype(np.uint8)


def project(
    camera: pycolmap.Camera, cam_from_world: Floats, points: Floats
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return pixels, depths and indices of the points that a camera sees."""
    in_cam = geometry.transform(cam_from_world, points)
    pixels = np.full((len(points), 2), np.nan)
    front = np.flatnonzero(in_cam[:, 2] > 0.2)
    pixels[front] = np.asarray(camera.img_from_cam(in_cam[front])).reshape(-1, 2)
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1))
    return pixels[inside], in_cam[inside, 2], inside


@dataclass
class World:
    """Points with descriptors, a map that sees them, and what a query would see."""

    points: Floats
    descriptors: Floats
    local_map: LocalMap
    features: dict[str, LocalFeatures]
    rng: np.random.Generator

    @classmethod
    def build(
        cls, points: Floats, world_from_cams: Floats, descriptors: Floats | None = None, sees: dict | None = None
    ) -> "World":
        """Make a map; `sees` limits what an image sees to some points."""
        rng = np.random.default_rng(7)
        descriptors = random_descriptors(rng, len(points)) if descriptors is None else descriptors
        names = [f"ios_map/raw_data/{index}.jpg" for index in range(len(world_from_cams))]
        features, observations = {}, []
        for index, (name, pose) in enumerate(zip(names, geometry.invert(world_from_cams), strict=True)):
            pixels, depth, seen = project(PINHOLE, pose, points)
            keep = np.isin(seen, (sees or {}).get(index, seen))
            pixels, depth, seen = pixels[keep], depth[keep], seen[keep]
            features[name] = LocalFeatures(
                pixels.astype(np.float32),
                (SIZE_M * PINHOLE.mean_focal_length() / depth).astype(np.float32),
                np.ones(len(pixels), np.float32),
                stored(rng, descriptors[seen]),
                (640, 480),
            )
            observations.append(np.column_stack([np.full(len(seen), index), np.arange(len(seen)), seen]))
        image, keypoint, point = np.concatenate(observations).astype(np.int64).T
        local_map = LocalMap(
            image_names=names,
            cameras=[PINHOLE] * len(names),
            world_from_cams=world_from_cams,
            points=points,
            colors=np.zeros((len(points), 3), np.uint8),
            obs_image=image,
            obs_keypoint=keypoint,
            obs_point=point,
            noise_px=np.zeros(len(points), np.float32),  # the points are exact
        )
        return cls(points, descriptors, local_map, features, rng)

    def localizer(self, **settings: object) -> PnpLocalizer:
        return PnpLocalizer([MappedFeatures(self.local_map, self.features)], PnpSettings(**settings))  # type: ignore[arg-type]

    def look(
        self,
        camera: pycolmap.Camera,
        world_from_cam: Floats,
        noise_px: float = 0.5,
        outliers: float = 0.0,
        limit: int | None = None,
        only: NDArray[np.int64] | None = None,
    ) -> LocalFeatures:
        """Return the features of a query; outliers wear the descriptor of another point that the map has."""
        pixels, depth, seen = project(camera, geometry.invert(world_from_cam), self.points)
        keep = np.isin(seen, only) if only is not None else np.ones(len(seen), bool)
        keep = self.rng.permutation(np.flatnonzero(keep))[:limit]
        pixels, depth, seen = pixels[keep], depth[keep], seen[keep]
        wrong = self.rng.random(len(seen)) < outliers
        pixels = pixels + noise_px * self.rng.normal(size=pixels.shape)
        pixels[wrong] = self.rng.uniform([0, 0], [camera.width, camera.height], (int(wrong.sum()), 2))
        return LocalFeatures(
            pixels.astype(np.float32),
            (SIZE_M * camera.mean_focal_length() / depth).astype(np.float32),
            np.ones(len(pixels), np.float32),
            stored(self.rng, self.descriptors[seen]),
            (camera.width, camera.height),
        )


def facing(x: float, y: float, z: float, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Floats:
    """Return world_from_cam; without a turn the camera looks along the world's z, y down."""
    turn = Rotation.from_euler("YXZ", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
    return geometry.make_pose(turn, [x, y, z])


MAP_POSES = np.stack([facing(x, y, 0, -6 * x) for x in (-2.0, -1.0, 0.0, 1.0, 2.0) for y in (-0.5, 0.5)])
REFERENCES = list(range(10))
QUERY = facing(0.4, -0.2, 0.7, yaw_deg=8, pitch_deg=-4, roll_deg=3)


@pytest.fixture(scope="module")
def room() -> World:
    """A cloud of points in front of ten cameras."""
    return World.build(np.random.default_rng(0).uniform([-4, -2.5, 3.5], [4, 2.5, 8], (1200, 3)), MAP_POSES)


def check(estimate: QueryResult, true: Floats, max_deg: float = 0.1, max_m: float = 0.01, status: str = "ok") -> None:
    assert estimate.status == status
    assert estimate.world_from_rig is not None
    rotation_deg, distance_m = geometry.pose_error(estimate.world_from_rig, true)
    assert rotation_deg < max_deg
    assert distance_m < max_m


@pytest.mark.parametrize("model", CAMERAS)
def test_a_single_camera(room: World, model: str) -> None:
    camera = CAMERAS[model]
    estimate = ask(room.localizer(), [camera], np.eye(4)[None], [room.look(camera, QUERY)], [REFERENCES])
    check(estimate, QUERY)
    assert min(estimate.num_guided, estimate.num_inliers) > 500
    assert estimate.num_matches >= estimate.num_inliers
    assert 0 < estimate.inlier_ratio <= 1
    assert 0.4 < estimate.rmse_px < 0.9  # of 0.5 px a coordinate
    assert set(indices_of(estimate.references)) <= set(REFERENCES)
    # What the pose rests on can be looked at: those points, projected, are those pixels.
    _, pixels, point_index = rests_on(estimate)
    assert len(pixels) == estimate.num_guided
    in_cam = geometry.transform(geometry.invert(estimate.world_from_rig), room.points[point_index])
    errors = np.linalg.norm(np.asarray(camera.img_from_cam(in_cam)) - pixels, axis=1)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(estimate.rmse_px, rel=0.01)


def test_exact_pixels_give_the_exact_pose(room: World) -> None:
    seen = room.look(PINHOLE, QUERY, noise_px=0)
    estimate = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
    check(estimate, QUERY, 1e-4, 1e-5)


def wrong(camera: pycolmap.Camera, factor: float) -> pycolmap.Camera:
    """Return the camera as one states it whose focal length is off."""
    params = np.array(camera.params) * [factor, factor, *[1.0] * (len(camera.params) - 2)]
    return pycolmap.Camera(model=camera.model.name, width=camera.width, height=camera.height, params=params)


@pytest.mark.parametrize("model", CAMERAS)
def test_a_wrong_focal_length_is_doubted_and_its_deviation_is_honest(room: World, model: str) -> None:
    camera = CAMERAS[model]
    seen = room.look(camera, QUERY)
    estimate = ask(room.localizer(), [wrong(camera, 1.1)], np.eye(4)[None], [seen], [REFERENCES])
    assert estimate.reason == CAMERA
    assert estimate.camera_contradicted
    assert estimate.focals_px == pytest.approx([camera.mean_focal_length()], rel=0.01)
    assert "the focal length that fits" in estimate.remark
    assert estimate.world_from_rig is not None
    error_m = float(geometry.pose_error(estimate.world_from_rig, QUERY)[1])
    assert error_m > 0.1
    assert estimate.position_std == pytest.approx(error_m, rel=0.2)


RIG_FROM_CAMS = np.stack(
    [
        facing(0.3, 0.1, 0.0, yaw_deg=15),
        facing(-0.3, -0.1, 0.05, yaw_deg=-20, roll_deg=90),
        facing(0.0, 0.3, -0.2, pitch_deg=12),
    ]
)
RIG_CAMERAS = [CAMERAS["OPENCV"], PINHOLE, CAMERAS["OPENCV_FISHEYE"]]


def test_the_pose_of_a_rig_is_the_rigs(room: World) -> None:
    features = [room.look(c, QUERY @ r) for c, r in zip(RIG_CAMERAS, RIG_FROM_CAMS, strict=True)]
    estimate = ask(room.localizer(), RIG_CAMERAS, RIG_FROM_CAMS, features, [REFERENCES] * 3)
    check(estimate, QUERY)
    assert not estimate.camera_contradicted
    assert set(rests_on(estimate)[0]) == {0, 1, 2}


def test_of_a_rig_the_wrong_camera_is_named_by_its_place_among_the_images(room: World) -> None:
    """An image without features is left out, and is counted."""
    features: list = [room.look(c, QUERY @ r) for c, r in zip(RIG_CAMERAS, RIG_FROM_CAMS, strict=True)]
    cameras = [RIG_CAMERAS[0], wrong(RIG_CAMERAS[1], 0.9), RIG_CAMERAS[2]]
    estimate = ask(room.localizer(), cameras, RIG_FROM_CAMS, ["unreadable", *features[1:]], [REFERENCES] * 3)
    assert estimate.reason == CAMERA
    assert np.isnan(np.array(estimate.focals_px)[[0, 2]]).all()
    assert estimate.focals_px[1] == pytest.approx(PINHOLE.mean_focal_length(), rel=0.01)


def test_one_camera_off_the_rigs_center_gives_the_rigs_pose(room: World) -> None:
    features = [room.look(PINHOLE, QUERY @ RIG_FROM_CAMS[1])]
    estimate = ask(room.localizer(), [PINHOLE], RIG_FROM_CAMS[1:2], features, [REFERENCES])
    check(estimate, QUERY)


def test_a_rig_needs_not_see_with_all_cameras(room: World) -> None:
    """One camera looks away, one was covered, and only one has references."""
    away = facing(0, 0, 0, yaw_deg=180)
    poses = np.stack([RIG_FROM_CAMS[0], away, RIG_FROM_CAMS[1]])
    nothing = np.zeros(0, np.float32)
    covered = LocalFeatures(nothing.reshape(0, 2), nothing, nothing, np.zeros((0, 128), np.uint8), (640, 480))
    noise = room.look(PINHOLE, QUERY, outliers=1.0)
    features = [room.look(PINHOLE, QUERY @ poses[0]), noise, covered]
    estimate = ask(room.localizer(), [PINHOLE] * 3, poses, features, [REFERENCES, [], REFERENCES])
    check(estimate, QUERY)
    assert set(rests_on(estimate)[0]) == {0}


@pytest.mark.parametrize("rig", [False, True])
def test_seventy_percent_outliers(room: World, rig: bool) -> None:
    cameras = RIG_CAMERAS if rig else [PINHOLE]
    poses = RIG_FROM_CAMS if rig else np.eye(4)[None]
    features = [room.look(c, QUERY @ p, outliers=0.7) for c, p in zip(cameras, poses, strict=True)]
    estimate = ask(room.localizer(), cameras, poses, features, [REFERENCES] * len(cameras))
    check(estimate, QUERY, 0.2, 0.02)
    assert estimate.inlier_ratio < 0.45


def test_points_on_one_plane() -> None:
    wall = np.random.default_rng(0).uniform([-4, -2.5, 6], [4, 2.5, 6], (800, 3))
    world = World.build(wall, MAP_POSES)
    for pose in (QUERY, facing(0, 0, 1)):  # aslant, and straight on
        estimate = ask(world.localizer(), [PINHOLE], np.eye(4)[None], [world.look(PINHOLE, pose)], [REFERENCES])
        check(estimate, pose, 0.2, 0.02)


def test_no_references(room: World) -> None:
    seen = room.look(PINHOLE, QUERY)
    estimate = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [[]])
    assert estimate.status_text == "failed: no references"
    assert estimate.world_from_rig is None
    assert estimate.covariance is None
    assert (estimate.num_matches, estimate.num_inliers, estimate.inlier_ratio) == (0, 0, 0.0)
    assert np.isnan([estimate.position_std, estimate.rotation_std_deg]).all()


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_matches(room: World, count: int) -> None:
    seen = room.look(PINHOLE, QUERY, limit=count)
    estimate = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
    assert estimate.status_text == "failed: too few matches"
    assert estimate.world_from_rig is None
    assert estimate.num_matches <= count * len(REFERENCES)


@pytest.mark.parametrize("rig", [False, True])
def test_eight_matches_are_no_pose(room: World, rig: bool) -> None:
    """Fewer than `min_inliers`, however well they agree."""
    cameras = RIG_CAMERAS if rig else [PINHOLE]
    poses = RIG_FROM_CAMS if rig else np.eye(4)[None]
    features = [room.look(c, QUERY @ p, limit=8 // len(cameras)) for c, p in zip(cameras, poses, strict=True)]
    estimate = ask(room.localizer(), cameras, poses, features, [REFERENCES] * len(cameras))
    assert estimate.status_text.startswith("failed: ")
    assert estimate.world_from_rig is None


@pytest.mark.parametrize(("above", "status"), [(-1e-6, "ok"), (1e-6, "low_confidence")])
def test_ok_is_a_probability(room: World, above: float, status: str) -> None:
    seen = room.look(PINHOLE, QUERY, limit=20)
    estimate = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
    assert 0.9 < estimate.p_correct < 1
    localizer = room.localizer(ok_probability=estimate.p_correct + above)
    again = ask(localizer, [PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
    assert (again.status, again.p_correct) == (status, estimate.p_correct)
    assert geometry.pose_error(again.world_from_rig, QUERY)[1] < 0.1


def test_inliers_all_over_the_image_cover_it(room: World) -> None:
    seen = room.look(PINHOLE, QUERY)
    assert ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES]).coverage == 1
    left = seen.take(np.flatnonzero(seen.keypoints[:, 0] < 320))
    assert ask(room.localizer(), [PINHOLE], np.eye(4)[None], [left], [REFERENCES]).coverage == 0.5


@pytest.mark.parametrize("seed", range(3))
def test_a_query_from_elsewhere_is_not_ok(room: World, seed: int) -> None:
    rng = np.random.default_rng(seed)
    stranger = LocalFeatures(
        rng.uniform([0, 0], [640, 480], (1000, 2)).astype(np.float32),
        rng.uniform(1, 4, 1000).astype(np.float32),
        np.ones(1000, np.float32),
        stored(rng, room.descriptors[rng.integers(0, 1200, 1000)]),  # matches, but nothing in its place
        (640, 480),
    )
    estimate = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [stranger], [REFERENCES])
    assert estimate.status != "ok"


def test_a_keypoint_near_a_point_is_one_candidate_by_its_best_image(room: World) -> None:
    seen, (mapped,) = room.look(PINHOLE, QUERY), room.localizer().matcher.mapped
    query = RigQuery([PINHOLE], np.eye(4)[None], [[seen]])
    ((matches, keypoint),) = mapped.candidates(query, 0, geometry.invert(QUERY), REFERENCES, 1.0)
    pairs = np.column_stack([keypoint, matches.point])
    assert len(np.unique(pairs, axis=0)) == len(pairs) > 500
    unit, best = unit_descriptors(seen.descriptors, mapped.kind.shorten), np.full(len(pairs), -1.0)
    for image in map(mapped.image, REFERENCES):
        row = np.full(len(room.points), -1)
        row[image.points] = np.arange(len(image.points))
        at = np.flatnonzero(row[pairs[:, 1]] >= 0)
        scores = (unit[pairs[at, 0]] * image.unit[row[pairs[at, 1]]]).sum(axis=1)
        best[at] = np.maximum(best[at], scores)
    assert best.min() > mapped.kind.guided_min_score - 1e-6
    assert (np.diff(best) < 1e-6).all()


def test_a_map_image_without_points_does_no_harm(room: World) -> None:
    none = np.zeros(0, np.int64)
    world = World.build(room.points, MAP_POSES, room.descriptors, sees={0: none, 1: none})
    seen = world.look(PINHOLE, QUERY)
    check(ask(world.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES]), QUERY)
    alone = ask(world.localizer(), [PINHOLE], np.eye(4)[None], [seen], [[0, 1]])
    assert alone.status_text == "failed: too few matches"


@pytest.mark.parametrize(("seed", "limit", "outliers"), [(0, 120, 0.85), (11, 80, 0.8), (5, 100, 0.85)])
def test_a_prior_confirms_the_doubtful_pose_that_it_leads_to(
    room: World, seed: int, limit: int, outliers: float
) -> None:
    """Both poses are the same up to rounding, so neither has clearly more support."""
    seen = replace(room, rng=np.random.default_rng(seed)).look(PINHOLE, QUERY, limit=limit, outliers=outliers)
    localize = partial(ask, room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
    alone = localize()
    assert alone.status == "low_confidence"
    prior = Prior(alone.world_from_rig, np.array(REFERENCES), 2.0, "near")
    confirmed = localize(priors=[prior])
    assert (confirmed.status, confirmed.found_by) == ("ok", "pnp+near")
    np.testing.assert_allclose(confirmed.world_from_rig, alone.world_from_rig, atol=1e-5)


def test_a_prior_is_kept_as_a_rival_where_ransac_leaves_it(room: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where windows repeat, and the pose off by one of them has more matches within RANSAC's limit."""
    localizer, wrong = room.localizer(), geometry.invert(QUERY @ facing(0.3, 0, 0))
    query = RigQuery([PINHOLE], np.eye(4)[None], [[room.look(PINHOLE, QUERY)]])
    judged: list[_Hypothesis] = []
    monkeypatch.setattr(localizer, "_ransac", lambda *_, **__: wrong)
    monkeypatch.setattr(localizer, "_estimate", lambda _, __, hypotheses, *___: judged.extend(hypotheses))
    none, estimate = Matches.pooled([]), QueryResult(Status.LOW_CONFIDENCE, world_from_rig=geometry.invert(wrong))
    prior = Prior(QUERY, np.array(REFERENCES), 2.0, "first")
    localizer._compare(query, none, [_Hypothesis(wrong, none, 1e4)], estimate, [References.of(REFERENCES)], prior)
    assert min(geometry.pose_error(one.world_from_rig, QUERY)[1] for one in judged) < 0.01


def test_a_prior_without_support_gives_no_pose(room: World) -> None:
    """Its few matches are all wrong."""
    seen = replace(room, rng=np.random.default_rng(0)).look(PINHOLE, QUERY, limit=8, outliers=1.0)
    prior = Prior(facing(0.0, 0.0, -3.0), np.array(REFERENCES), 10.0, "near")
    estimate = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES], priors=[prior])
    assert estimate.status.startswith("failed")
    assert estimate.world_from_rig is None


def twins(extra: int, unlike_m: float = 0.0, unmapped: int = 0) -> tuple[World, NDArray[np.int64]]:
    """Two copies of a structure 2 m apart, and `extra` points that are only once; what a query at the first sees.

    The points of the second copy are `unlike_m` off in each axis (standard deviation); of the first, the map lacks
    `unmapped` of 300.
    """
    rng = np.random.default_rng(0)
    first = rng.uniform([-0.8, -0.8, 4], [0.8, 0.8, 5], (300, 3))
    once = rng.uniform([-0.8, -0.8, 4], [0.8, 0.8, 5], (extra, 3))
    descriptors = random_descriptors(rng, 300)
    poses = np.stack([facing(x + shift, y, 0) for shift in (0, 2) for x in (-0.4, 0, 0.4) for y in (-0.3, 0.3)])
    a, b, c = np.arange(300), np.arange(300, 600), np.arange(600, 600 + extra)
    sees = {index: np.concatenate([a[unmapped:], c]) if index < 6 else b for index in range(12)}
    second = first + np.array([2, 0, 0]) + unlike_m * rng.normal(size=first.shape)
    points = np.concatenate([first, second, once])
    world = World.build(points, poses, np.concatenate([descriptors, descriptors, random_descriptors(rng, extra)]), sees)
    return world, np.concatenate([a, c])


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_of_two_like_places_none_is_ok(outliers: float) -> None:
    world, visible = twins(extra=0)
    seen = world.look(PINHOLE, facing(0.1, 0.1, 0.3), only=visible, outliers=outliers)
    estimate = ask(world.localizer(), [PINHOLE], np.eye(4)[None], [seen], [list(range(12))])
    assert estimate.status == "low_confidence"
    assert estimate.rival_support > 0.8
    (rival,) = estimate.rivals  # at the other of the two places, which are 2 m apart
    assert rival.support == estimate.rival_support
    apart = np.abs(rival.world_from_rig[:3, 3] - estimate.world_from_rig[:3, 3])
    np.testing.assert_allclose(apart, [2, 0, 0], atol=0.05)
    far = estimate.scaled(10.0).rivals[0].world_from_rig
    np.testing.assert_allclose(far[:3, 3], 10 * rival.world_from_rig[:3, 3])


@pytest.mark.parametrize(("off_m", "yaw_deg", "is_rival"), [(0.2, 2, False), (0.3, 0, True), (0, 3, True)])
def test_a_rival_is_so_far_away_that_one_of_both_is_wrong(
    room: World, off_m: float, yaw_deg: float, is_rival: bool
) -> None:
    """A second pose nearby, by much the same matches, is no reason to doubt the first."""
    none = Matches.pooled([])
    poses = [facing(0, 0, 0), facing(off_m, 0, 0, yaw_deg=yaw_deg)]
    hypotheses = [_Hypothesis(geometry.invert(pose), none, 10.0) for pose in poses]
    rivals = room.localizer()._rivals(hypotheses)
    assert [rival.support for rival in rivals] == [1.0] * is_rival


@pytest.mark.parametrize(("off_m", "support", "std_m"), [(0.2, 10.0, 0.2 / 2**0.5), (0.2, 5.0, 0.0), (0.3, 10.0, 0.0)])
def test_between_two_near_solutions_the_pose_is_uncertain(
    room: World, off_m: float, support: float, std_m: float
) -> None:
    """Unless one is clearly better; and a pose farther away is a rival."""
    none, poses = Matches.pooled([]), [facing(0, 0, 0), facing(off_m, 0, 0)]
    hypotheses = [_Hypothesis(geometry.invert(poses[0]), none, 10.0)]
    hypotheses += 3 * [_Hypothesis(geometry.invert(poses[1]), none, support)]  # found three times, it is still one
    stds = np.sqrt(np.diag(room.localizer()._spread(hypotheses)))
    np.testing.assert_allclose(stds, [0, 0, 0, std_m, 0, 0], atol=1e-3)


def test_a_few_matches_that_any_pose_fits_are_little_support() -> None:
    assert _support(np.zeros(4), 0.17) < 0.3 * _support(np.full(12, 0.04), 0.17)
    assert _support(np.zeros(3), 0.17) == _support(np.zeros(0), 0.17) == 0
    near_right, off_by_a_window = np.full(100, 0.04), np.full(160, 0.1)
    assert _support(near_right, 0.17) > 2 * _support(off_by_a_window, 0.17)


@pytest.mark.parametrize(("correct", "wrong_px", "off_m"), [(45, 2.0, 0.6), (8, 0.8, 0.3)])
def test_a_pose_off_by_a_window_does_not_hide_the_one_that_fewer_matches_fit_closely(
    room: World, correct: int, wrong_px: float, off_m: float
) -> None:
    """By the limits that both keep, the wrong pose has 75 inliers and the correct one 45, as on a facade by night.

    If the correct one has as few as 8, it is found by matching around the wrong pose.
    """
    rng = np.random.default_rng(3)
    wrong = QUERY @ facing(off_m, 0, 0, yaw_deg=-5 * off_m)
    pixels, points = [], []
    for pose, count, noise_px in ((QUERY, correct, 0.3), (wrong, 75, wrong_px), (QUERY, 300, 300.0)):
        seen_at, _, seen = project(PINHOLE, geometry.invert(pose), room.points)
        chosen = rng.permutation(len(seen))[:count]
        pixels.append(seen_at[chosen] + noise_px * rng.normal(size=(len(chosen), 2)))
        points.append(seen[chosen])
    point = np.concatenate(points)
    matches = Matches(np.zeros(len(point), np.int64), np.concatenate(pixels), point)
    query, localizer = RigQuery([PINHOLE], np.eye(4)[None], [[room.look(PINHOLE, QUERY)]]), room.localizer()
    first = localizer._ransac(query, matches, localizer.settings.ransac_max_error_deg)
    assert first is not None
    assert geometry.pose_error(geometry.invert(first), wrong)[1] < 0.1
    hypotheses = [_Hypothesis(first, matches, 10.0)]
    localizer._add_neighbor(query, matches, hypotheses)
    assert min(geometry.pose_error(one.world_from_rig, QUERY)[1] for one in hypotheses[1:]) < 0.02


@pytest.mark.parametrize("unmapped", [0, 60])
def test_of_two_places_the_one_that_matches_fit_better_wins(monkeypatch: pytest.MonkeyPatch, unmapped: int) -> None:
    """With 60 points unmapped, the other place gets more guided matches, but with larger errors."""
    world, visible = twins(extra=0, unlike_m=0.007, unmapped=unmapped)
    pose = facing(0.1, 0.1, 0.3)
    seen = world.look(PINHOLE, pose, noise_px=0.2, only=visible)
    monkeypatch.setattr(pnp, "MAX_RIVAL_SUPPORT", 0.9)
    estimate = ask(world.localizer(), [PINHOLE], np.eye(4)[None], [seen], [list(range(12))])
    check(estimate, pose, 0.2, 0.02)
    assert 0.2 < estimate.rival_support < (0.9 if unmapped else 0.75)


def test_what_is_there_once_decides_between_like_places() -> None:
    world, visible = twins(extra=250)
    pose = facing(0.1, 0.1, 0.3)
    seen = world.look(PINHOLE, pose, only=visible)
    estimate = ask(world.localizer(), [PINHOLE], np.eye(4)[None], [seen], [list(range(12))])
    check(estimate, pose, 0.2, 0.02)
    assert estimate.inlier_ratio > pnp.CLEAR_INLIER_RATIO
    assert 0.4 < estimate.rival_support < 0.8, "the other place is known, however clear the pose"


@pytest.mark.parametrize("place", range(5))
def test_the_right_one_of_many_like_places_is_found(monkeypatch: pytest.MonkeyPatch, place: int) -> None:
    """Only weak features, which are not matched at first, tell the places apart: each has to be tried."""
    rng = np.random.default_rng(0)
    shifts = np.array([[3.0 * index, 0, 0] for index in range(5)])
    like = rng.uniform([-0.8, -0.8, 4], [0.8, 0.8, 5], (200, 3))
    once = rng.uniform([-0.8, -0.8, 4], [0.8, 0.8, 5], (100, 3)) + shifts[place]
    poses = np.stack([facing(x + shift, 0, 0) for shift, _, _ in shifts for x in (-0.3, 0.3)])
    sees = {index: np.arange(200) + 200 * (index // 2) for index in range(10)}
    for index in (2 * place, 2 * place + 1):
        sees[index] = np.concatenate([sees[index], np.arange(1000, 1100)])
    descriptors = np.concatenate([*[random_descriptors(rng, 200)] * 5, random_descriptors(rng, 100)])
    world = World.build(np.concatenate([*(like + shift for shift in shifts), once]), poses, descriptors, sees)
    pose = facing(shifts[place, 0] + 0.1, 0.1, 0.3)
    strong = world.look(PINHOLE, pose, only=np.arange(200) + 200 * place)
    weak = world.look(PINHOLE, pose, only=np.arange(1000, 1100))
    both = {
        name: np.concatenate([getattr(strong, name), getattr(weak, name)])
        for name in ("keypoints", "scales", "scores", "descriptors")
    }
    seen = LocalFeatures(**both, image_size=(640, 480))
    monkeypatch.setattr(matches, "MAX_QUERY_FEATURES", len(strong))
    monkeypatch.setattr(pnp, "CONTESTED_REFERENCES", 10)
    estimate = ask(world.localizer(), [PINHOLE], np.eye(4)[None], [seen], [list(range(10))])
    check(estimate, pose, 0.2, 0.02, status="low_confidence")  # four rivals with two thirds of its support
    assert 0.5 < estimate.p_correct < 0.99


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "map_noise_px"), [(False, 0.0), (True, 0.0), (False, 1.0)])
def test_covariance_is_the_scatter_of_the_poses(rig: bool, map_noise_px: float) -> None:
    """Of world_from_rig @ Exp(d), d = rotation, then translation, in the rig's frame: by 200 noisy queries and maps.

    The camera has so many pixels that 1 px of noise stays far below the limit of an inlier.
    """
    rng = np.random.default_rng(0)
    world = World.build(rng.uniform([-4, -2.5, 3.5], [4, 2.5, 8], (400, 3)), MAP_POSES)
    camera = pycolmap.Camera(model="PINHOLE", width=1920, height=1440, params=[1500, 1500, 960, 720])
    cameras = [camera] * 2 if rig else [camera]
    poses = RIG_FROM_CAMS[:2] if rig else np.eye(4)[None]
    # A rig's frame far from its cameras and turned: its errors of rotation and place are bound together.
    rig_from_body = geometry.make_pose(Rotation.from_euler("Y", 90, degrees=True).as_matrix(), [0.5, 0, 0])
    poses = rig_from_body @ poses
    true = QUERY @ geometry.invert(rig_from_body)
    exact = [world.look(c, true @ p, noise_px=0, limit=150) for c, p in zip(cameras, poses, strict=True)]
    sure = replace(world.local_map, noise_px=np.full(400, map_noise_px, np.float32))
    spread_of_points = np.linalg.cholesky(sure.point_covariances(np.arange(400)) + 1e-18 * np.eye(3))
    motions, predicted = [], []
    for _ in range(200):
        moved = world.points + np.einsum("pij,pj->pi", spread_of_points, rng.normal(size=(400, 3)))
        localizer = PnpLocalizer([MappedFeatures(replace(sure, points=moved), world.features)])
        noisy = [
            replace(f, keypoints=(f.keypoints + rng.normal(size=f.keypoints.shape)).astype(np.float32)) for f in exact
        ]
        estimate = ask(localizer, cameras, poses, noisy, [REFERENCES] * len(cameras))
        assert estimate.status == "ok"
        motion = geometry.invert(true) @ estimate.world_from_rig
        motions.append([*Rotation.from_matrix(motion[:3, :3]).as_rotvec(), *motion[:3, 3]])
        predicted.append(estimate.covariance)
    scatter, covariance = np.cov(np.array(motions).T), np.mean(predicted, axis=0)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), np.sqrt(np.diag(scatter)), rtol=0.25)
    # Not only the sizes: in the coordinates in which the predicted covariance is round, so is the scatter.
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    spread = np.sqrt(np.linalg.eigvalsh(whiten @ scatter @ whiten.T))
    assert 0.6 < spread.min() < spread.max() < 1.5
    # And the summary that people read.
    assert estimate.position_std == pytest.approx(np.sqrt(np.trace(estimate.covariance[3:, 3:])))
    assert estimate.rotation_std_deg == pytest.approx(np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3]))))


def test_guided_matches_alone_count_less(room: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """They follow the pose that they were sought about."""
    seen = room.look(PINHOLE, QUERY)
    stds, guided = [], []
    for known_to_descriptors in (1536, 100):
        monkeypatch.setattr(matches, "MAX_QUERY_FEATURES", known_to_descriptors)
        found = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
        stds.append(found.position_std)
        guided.append(found.num_guided)
    assert guided[1] > 0.9 * guided[0] > 150
    assert 1.1 * stds[0] < stds[1] < np.sqrt(1 / GUIDED_WEIGHT) * 1.1 * stds[0]


def test_a_point_that_is_not_known_well_tells_less(room: World) -> None:
    """But never less than a match within the limit of an inlier does."""
    seen = room.look(PINHOLE, QUERY)

    def std(noise_px: float) -> float:
        local_map = replace(room.local_map, noise_px=np.full(len(room.points), noise_px, np.float32))
        localizer = PnpLocalizer([MappedFeatures(local_map, room.features)])
        return ask(localizer, [PINHOLE], np.eye(4)[None], [seen], [REFERENCES]).position_std

    exact, noisy, hopeless, worse = std(0), std(2), std(1e3), std(1e6)
    assert 1.2 * exact < noisy < hopeless
    assert worse == pytest.approx(hopeless, rel=1e-3)


def test_unknowns_that_move_projections_alike_have_no_covariance() -> None:
    rng = np.random.default_rng(0)
    of_one = rng.normal(size=(400, 2, 1))
    of_unknowns = np.concatenate([of_one, of_one], axis=2)
    errors, nothing = np.full(400, np.sqrt(2.0)), np.zeros((400, 2, 2))
    assert least_squares_covariance(of_unknowns, errors, nothing) is None
    alone = least_squares_covariance(of_one, errors, nothing)
    # Points without a covariance tell nothing.
    nothing[:200] = np.nan
    half = least_squares_covariance(of_one, errors, nothing)
    assert 1.7 < half[0, 0] / alone[0, 0] < 2.4


def test_more_noise_is_more_uncertainty(room: World) -> None:
    stds = []
    for noise in (0.2, 0.8):
        seen = room.look(PINHOLE, QUERY, noise_px=noise)
        stds.append(ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES]).position_std)
    assert 2 < stds[1] / stds[0] < 6


def test_noise_of_the_maps_poses_leaves_far_scenes_open(room: World) -> None:
    """At the same noise, a scene six times as far lets the pose move six times as far."""
    far = World.build(6 * room.points, MAP_POSES)

    def found(world: World, noise_deg: float) -> QueryResult:
        noisy = world.local_map.judged(Consistency("consistent", direction_noise_deg=noise_deg))
        localizer = PnpLocalizer([MappedFeatures(noisy, world.features)])
        return ask(localizer, [PINHOLE], np.eye(4)[None], [world.look(PINHOLE, QUERY)], [REFERENCES])

    for world, noise_deg in ((room, 0.0), (far, 0.0), (room, 0.4)):
        assert found(world, noise_deg).status == "ok"
    refused = found(far, 0.4)
    assert (refused.status, refused.reason) == ("low_confidence", NOISE)
    assert refused.p_correct < 0.99
    assert "refine_poses" in refused.remark


@pytest.mark.slow
def test_the_same_answer_in_whatever_order_threads_come(room: World) -> None:
    poses = [facing(x, 0.1, 0.3, yaw_deg=-5 * x) for x in np.linspace(-1.5, 1.5, 6)]
    queries = [room.look(PINHOLE, pose, outliers=0.5) for pose in poses]

    def answer(localizer: PnpLocalizer, index: int) -> tuple:
        estimate = ask(localizer, [PINHOLE], np.eye(4)[None], [queries[index]], [REFERENCES])
        return estimate.status, estimate.world_from_rig.tobytes(), estimate.covariance.tobytes(), estimate.num_guided

    alone = [answer(room.localizer(), index) for index in range(6)]
    for order in ([5, 0, 3, 1, 4, 2], [0, 1, 2, 3, 4, 5]):
        with ThreadPoolExecutor(3) as pool:
            answers = dict(zip(order, pool.map(partial(answer, room.localizer()), order), strict=True))
        assert [answers[index] for index in range(6)] == alone


@pytest.mark.slow
def test_a_rigs_pose_does_not_depend_on_who_else_draws_numbers(room: World) -> None:
    """PoseLib draws from the C library's generator, as ZeroMQ does in a kernel."""
    asked, draw, done = rig_asked(room, outliers=0.5), ctypes.CDLL(None).rand, Event()

    def others() -> None:
        while not done.wait(1e-4):
            draw()

    alone = ask(room.localizer(), *asked).world_from_rig
    thread = Thread(target=others)
    thread.start()
    poses = [ask(room.localizer(), *asked).world_from_rig for _ in range(6)]
    done.set()
    thread.join()
    assert all(np.array_equal(pose, alone) for pose in poses)


def test_localizing_leaves_the_map_as_it_is(room: World) -> None:
    before = {name: getattr(room.local_map, name).tobytes() for name in ("points", "world_from_cams", "obs_point")}
    ask(room.localizer(), [PINHOLE], np.eye(4)[None], [room.look(PINHOLE, QUERY)], [REFERENCES])
    assert all(getattr(room.local_map, name).tobytes() == content for name, content in before.items())


# ------------------------------------------------------------------------------------------- what a pose rests on


def errors_deg(points: Floats, estimate: QueryResult, cameras: list[pycolmap.Camera], rig_from_cams: Floats) -> Floats:
    """Return how far each correspondence's point is projected from its pixel, as an angle; inf behind the camera."""
    matches, errors = estimate.correspondences, np.full(len(estimate.correspondences), np.inf)
    np.testing.assert_array_equal(matches.points, points[matches.point_index])
    for index, (camera, rig_from_cam) in enumerate(zip(cameras, rig_from_cams, strict=True)):
        mine = np.flatnonzero(matches.camera == index)
        cam_from_world = geometry.invert(estimate.world_from_rig @ rig_from_cam)
        in_cam = geometry.transform(cam_from_world, matches.points[mine])
        errors_px = np.linalg.norm(np.asarray(camera.img_from_cam(in_cam)) - matches.pixels[mine], axis=1)
        errors[mine] = np.degrees(np.arctan(errors_px / camera.mean_focal_length()))
        errors[mine[in_cam[:, 2] <= 0]] = np.inf
    return errors


def rig_asked(world: World, **more: float) -> tuple:
    features = [world.look(c, QUERY @ r, **more) for c, r in zip(RIG_CAMERAS, RIG_FROM_CAMS, strict=True)]
    return RIG_CAMERAS, RIG_FROM_CAMS, features, [REFERENCES] * 3


@pytest.mark.parametrize("rig", [False, True])
def test_inliers_are_what_the_pose_agrees_with_and_the_rest_is_rejected(room: World, rig: bool) -> None:
    single = [PINHOLE], np.eye(4)[None], [room.look(PINHOLE, QUERY, outliers=0.5)], [REFERENCES]
    asked = rig_asked(room, outliers=0.5) if rig else single
    localizer = room.localizer()
    estimate = ask(localizer, *asked)
    check(estimate, QUERY, 0.2, 0.02)
    matches = estimate.correspondences
    errors = errors_deg(room.points, estimate, *asked[:2])
    # The pose is refined once more on its guided matches, which moves some of them a little beyond the limit.
    assert (errors[matches.agrees] < 1.2 * localizer.settings.max_error_deg).all()
    assert (errors[~matches.agrees] >= localizer.settings.max_error_deg).all()
    assert (~matches.agrees).sum() > 100
    guided = np.char.endswith(matches.found_by, "/guided")
    assert set(matches.found_by) == {"sift/guided", "sift/descriptors"}
    assert guided.sum() == estimate.num_guided
    assert matches.agrees[guided].all()
    # Each match is there once: those that descriptors found too are among the guided ones.
    rows = np.column_stack([matches.camera, matches.pixels, matches.point_index])
    assert len(np.unique(rows, axis=0)) == len(rows)
    # Each pixel is that of a feature.
    for camera, features in enumerate(asked[2]):
        mine = matches.pixels[matches.camera == camera]
        assert np.isin(mine.view("f8,f8"), features.keypoints.astype(np.float64).view("f8,f8")).all()


@pytest.mark.parametrize("rig", [False, True])
def test_views_are_the_keypoints_of_references_that_see_the_points(room: World, rig: bool) -> None:
    asked = rig_asked(room) if rig else ([PINHOLE], np.eye(4)[None], [room.look(PINHOLE, QUERY)], [REFERENCES])
    estimate = ask(room.localizer(), *asked)
    matches = estimate.correspondences
    shown = indices_of(estimate.references)[: matches.view_reference.max() + 1]
    assert len(shown) == VIEWS
    for rank, image in enumerate(shown):
        keypoint, point = room.local_map.observations(image)
        features = room.features[room.local_map.image_names[image]]
        pixels_of = dict(zip(point.tolist(), features.keypoints[keypoint].tolist(), strict=True))
        mine = matches.view_reference == rank
        expected = [pixels_of[point] for point in matches.point_index[matches.view_of[mine]].tolist()]
        np.testing.assert_array_equal(matches.view_pixels[mine], expected)
        # Every correspondence whose point the reference sees, also where two cameras of a rig see the point.
        assert sorted(matches.view_of[mine]) == np.flatnonzero(np.isin(matches.point_index, point)).tolist()


def test_references_that_see_the_most_come_first(room: World) -> None:
    seen_by = {index: np.arange(60 * index) for index in REFERENCES}
    world = World.build(room.points, MAP_POSES, room.descriptors, sees=seen_by)
    estimate = ask(world.localizer(), [PINHOLE], np.eye(4)[None], [world.look(PINHOLE, QUERY)], [REFERENCES])
    used = indices_of(estimate.references)
    assert set(used) == set(REFERENCES[1:])
    counts = [np.isin(rests_on(estimate)[2], world.local_map.observations(index)[1]).sum() for index in REFERENCES]
    assert [counts[index] for index in used] == sorted(counts[1:], reverse=True)


def test_without_a_pose_all_matches_are_rejected(room: World) -> None:
    seen = room.look(PINHOLE, QUERY, outliers=1.0)
    matches = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [[4]]).correspondences
    few = room.look(PINHOLE, QUERY, limit=3)
    estimate = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [few], [REFERENCES])
    assert estimate.status_text == "failed: too few matches"
    for rejected in (matches, estimate.correspondences):
        assert len(rejected)
        assert not rejected.agrees.any()
        assert set(rejected.found_by) == {"sift/descriptors"}
        assert len(rejected.view_of) == 0


def test_images_without_features_are_left_out_and_the_others_keep_their_numbers(room: World) -> None:
    cameras, poses, features, references = rig_asked(room)
    estimate = ask(room.localizer(), cameras, poses, ["torn", *features[1:]], references)
    check(estimate, QUERY)
    assert set(estimate.correspondences.camera) == {1, 2}
    assert estimate.remark == "torn"
    errors = errors_deg(room.points, estimate, cameras, poses)
    assert (errors[estimate.correspondences.agrees] < 1.2 * room.localizer().settings.max_error_deg).all()
    none = ask(room.localizer(), cameras, poses, ["torn", "no features", "torn"], references)
    assert none.status_text == "failed: no readable image (torn; no features; torn)"
    assert none.world_from_rig is None


# ------------------------------------------------------------------------------------- several kinds of features


def other_kind(world: World, seed: int) -> World:
    """The same room seen by another detector: other points, and float descriptors of another length."""
    rng = np.random.default_rng(seed)
    points = world.points + rng.normal(size=world.points.shape) * 0.05
    other = World.build(points, world.local_map.world_from_cams)
    mix = np.linalg.qr(rng.normal(size=(128, 128)))[0][:, :64]

    def mixed(features: LocalFeatures) -> LocalFeatures:
        units = features.descriptors.astype(np.float32) @ mix
        units /= np.linalg.norm(units, axis=1, keepdims=True)
        return replace(features, descriptors=units.astype(np.float16), scales=np.ones(len(features), np.float32))

    other.features = {name: mixed(features) for name, features in other.features.items()}
    look = other.look
    other.look = lambda *args, **more: mixed(look(*args, **more))  # type: ignore[method-assign]
    return other


SINGLE_SCALE = replace(KINDS["sift"], scale_octaves=float("inf"), shorten=None)


def test_several_kinds_of_features_give_one_pose_with_the_matches_of_all(room: World) -> None:
    other = other_kind(room, 5)
    kinds = [MappedFeatures(room.local_map, room.features),
             MappedFeatures(other.local_map, other.features, "other", kind=SINGLE_SCALE)]  # fmt: skip
    seen = [room.look(PINHOLE, QUERY, limit=45), other.look(PINHOLE, QUERY, limit=45)]  # all references are matched
    alone = [
        ask(PnpLocalizer([kind]), [PINHOLE], np.eye(4)[None], [one], [REFERENCES])
        for kind, one in zip(kinds, seen, strict=True)
    ]
    both = PnpLocalizer(kinds)
    estimate = ask(both, [PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
    check(estimate, QUERY)
    assert estimate.num_matches == sum(one.num_matches for one in alone)
    assert estimate.num_inliers >= max(one.num_inliers for one in alone)
    # Of each kind, points of its own: the second kind's follow the first's.
    _, pixels, point_index = rests_on(estimate)
    of_other = point_index >= len(room.local_map.points)
    assert 0 < of_other.sum() < len(of_other)
    matches = estimate.correspondences
    of_other = matches.point_index >= len(room.local_map.points)
    np.testing.assert_array_equal(of_other, np.char.startswith(matches.found_by, "other/"))
    # And so are the places where references show them.
    for rank in np.unique(matches.view_reference):
        mine = matches.view_reference == rank
        cam_from_world = geometry.invert(MAP_POSES[indices_of(estimate.references)[rank]])
        in_cam = geometry.transform(cam_from_world, matches.points[matches.view_of[mine]])
        np.testing.assert_allclose(PINHOLE.img_from_cam(in_cam), matches.view_pixels[mine], atol=0.01)
    projected = PINHOLE.img_from_cam(geometry.transform(geometry.invert(QUERY), both.map.points[point_index]))
    assert np.linalg.norm(projected - pixels, axis=1).max() < 6
    rig = ask(both, RIG_CAMERAS, RIG_FROM_CAMS, [
        [world.look(camera, QUERY @ pose) for world in (room, other)]
        for camera, pose in zip(RIG_CAMERAS, RIG_FROM_CAMS, strict=True)
    ], [REFERENCES] * 3)  # fmt: skip
    check(rig, QUERY)


def test_one_kind_that_sees_nothing_leaves_the_answer_of_the_other(room: World) -> None:
    other = other_kind(room, 5)
    kinds = [MappedFeatures(room.local_map, room.features),
             MappedFeatures(other.local_map, other.features, kind=SINGLE_SCALE)]  # fmt: skip
    seen = room.look(PINHOLE, QUERY)
    nothing = other.look(PINHOLE, QUERY, limit=0)
    expected = ask(room.localizer(), [PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
    estimate = ask(PnpLocalizer(kinds), [PINHOLE], np.eye(4)[None], [[seen, nothing]], [REFERENCES])
    np.testing.assert_array_equal(estimate.world_from_rig, expected.world_from_rig)
    assert estimate.num_inliers == expected.num_inliers


class Learned:
    """A matcher as a network is one: it wants all features of both images, and to be asked by one thread at a time."""

    batch_size = 4
    settings = {"name": "learned"}  # noqa: RUF012

    def __init__(self) -> None:
        self.sizes: list[tuple[int, int]] = []

    def match(self, pairs):  # type: ignore[no-untyped-def]
        self.sizes += [(len(a), len(b)) for a, b in pairs]
        return MutualMatcher(0.85).match(pairs)


def test_a_network_sees_all_features_and_is_not_asked_what_is_known(room: World) -> None:
    network = Learned()
    localizer = PnpLocalizer([MappedFeatures(room.local_map, room.features, matcher=network)])  # type: ignore[arg-type]
    seen = room.look(PINHOLE, QUERY)
    asked = ([PINHOLE], np.eye(4)[None], [seen], [REFERENCES])
    estimate = ask(localizer, *asked)
    check(estimate, QUERY)
    # The further references show the same place, and are not asked.
    first = REFERENCES[: next(iter(FIRST_REFERENCES))]
    sizes = [len(room.features[room.local_map.image_names[index]]) for index in first]
    assert network.sizes == [(len(seen), size) for size in sizes]
    network.sizes.clear()
    names = []

    def matched_before(name: str) -> PairMatches:
        names.append(name)
        return MutualMatcher(0.85).match([(seen, room.features[name])])[0]

    again = ask(localizer, *asked, network_matches=[[matched_before]])
    assert network.sizes == []
    assert names == [room.local_map.image_names[index] for index in first]
    np.testing.assert_array_equal(again.world_from_rig, estimate.world_from_rig)


@pytest.mark.parametrize("rig", [False, True])
def test_coordinates_of_a_country_give_the_same_pose(room: World, rig: bool) -> None:
    """UTM coordinates have millions of meters; squared in double precision, they leave millimeters."""
    far = np.array([500_000.0, 5_000_000.0, 400.0])
    cameras, poses = ([PINHOLE] * 2, RIG_FROM_CAMS[:2]) if rig else ([PINHOLE], np.eye(4)[None])
    seen = [room.look(camera, QUERY @ pose) for camera, pose in zip(cameras, poses, strict=True)]
    moved = replace(
        room.local_map,
        points=room.local_map.points + far,
        world_from_cams=geometry.shifted(room.local_map.world_from_cams, far),
    )
    near, there = (
        ask(PnpLocalizer([MappedFeatures(one, room.features)]), cameras, poses, seen, [REFERENCES] * len(cameras))
        for one in (room.local_map, moved)
    )
    assert near.world_from_rig is not None
    assert there.world_from_rig is not None
    np.testing.assert_allclose(there.world_from_rig[:3, 3] - far, near.world_from_rig[:3, 3], rtol=0, atol=2e-7)
    np.testing.assert_allclose(there.world_from_rig[:3, :3], near.world_from_rig[:3, :3], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("of_rival", "of_pose", "expected"),
    [
        ((60.0,), (100.0,), 0.6),
        ((85.0, 40.0), (100.0, 100.0), 0.85),
        ((110.0, 10.0), (100.0, 100.0), 1.1),
        ((9.0, 60.0), (10.0, 190.0), 69 / 200),  # ten matches do not judge
        ((0.0, 0.0), (0.0, 0.0), 0.0),
    ],
)
def test_a_rival_counts_as_the_kind_of_features_that_doubts_most(
    of_rival: tuple[float, ...], of_pose: tuple[float, ...], expected: float
) -> None:
    """SIFT saw two copies of a room as nearly equal, 0.86; with ALIKED's matches, the wrong one was ok at 0.59."""
    none = Matches(*(np.zeros(0, np.int64),) * 3)
    rival, pose = (_Hypothesis(np.eye(4), none, sum(supports), supports) for supports in (of_rival, of_pose))
    assert _relative_support(rival, pose) == pytest.approx(expected)
