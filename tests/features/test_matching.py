"""Matching against brute force, with and without the epipolar geometry."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit import geometry
from toolkit.errors import ManifestError
from toolkit.features.features import DESCRIPTOR_SCALE, LocalFeatures, MutualMatcher, mutual_matches, unit_descriptors
from toolkit.features.matching import create_matcher, match_along_epipolar_lines, matchers_of

Floats = NDArray[np.float64]


def random_units(rng: np.random.Generator, count: int, dim: int = 128) -> NDArray[np.float32]:
    vectors = rng.normal(size=(count, dim))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def near_copies(rng: np.random.Generator, units: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    vectors = units + noise * random_units(rng, len(units), units.shape[1])
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def brute_force(scores: NDArray[np.float32], allowed: NDArray[np.bool_], ratio: float, min_score: float) -> list:
    """The definition, written as loops: best of its row and of its column, clearly better than the row's second."""
    masked = np.where(allowed, scores, np.float32(-2))
    matches = []
    for i in range(masked.shape[0]):
        order = np.argsort(-masked[i], kind="stable")
        j, top = order[0], masked[i, order[0]]
        second = max(masked[i, order[1]], -1) if len(order) > 1 else -1
        nearer = np.sqrt(max(1 - top, 0)) < ratio * np.sqrt(1 - second)
        if top > min_score and nearer and np.argmax(masked[:, j]) == i:
            matches.append((i, int(j)))
    return matches


def as_list(matches: NDArray[np.int64]) -> list:
    assert matches.dtype == np.int64
    assert matches.shape == (len(matches), 2)
    return [tuple(match) for match in matches.tolist()]


def test_unit_descriptors() -> None:
    stored = np.round(np.abs(random_units(np.random.default_rng(0), 50)) * DESCRIPTOR_SCALE).astype(np.uint8)
    unit = unit_descriptors(stored)
    assert unit.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1, atol=0.01)
    np.testing.assert_allclose((unit @ unit.T).diagonal(), 1, atol=0.02)
    assert unit_descriptors(np.zeros((0, 128), np.uint8)).shape == (0, 128)


@pytest.mark.parametrize("ratio", [0.7, 0.9, 1.0])
@pytest.mark.parametrize("min_score", [-1.0, 0.3])
def test_mutual_matches_are_the_brute_force_ones(ratio: float, min_score: float) -> None:
    rng = np.random.default_rng(0)
    for n, m, dim in [(40, 60, 8), (60, 40, 8), (1, 50, 8), (50, 2, 4), (200, 200, 32)]:
        a = random_units(rng, n, dim)
        b = np.concatenate([near_copies(rng, a[: min(n, m) // 2], 0.3), random_units(rng, m - min(n, m) // 2, dim)])
        scores = a @ b.T
        before = scores.copy()
        found = as_list(mutual_matches(scores, ratio, min_score))
        assert found == brute_force(before, np.ones((n, m), bool), ratio, min_score)
        np.testing.assert_array_equal(scores, before)  # the caller's array is as it was
        if n == 200:
            assert 50 < len(found) < 200


def test_mutual_matches_find_a_permutation() -> None:
    rng = np.random.default_rng(1)
    a, order = random_units(rng, 100), rng.permutation(100)
    found = mutual_matches(a @ near_copies(rng, a[order], 0.2).T)
    assert found[:, 0].tolist() == list(range(100))
    np.testing.assert_array_equal(order[found[:, 1]], np.arange(100))


def test_the_ratio_is_of_distances() -> None:
    # cos 0.92 and 0.82: squared distances 0.16 and 0.36, distances 0.4 and 0.6.
    scores = np.array([[0.92, 0.82]], np.float32)
    assert as_list(mutual_matches(scores, ratio=0.67)) == [(0, 0)]
    assert as_list(mutual_matches(scores, ratio=0.66)) == []


def test_two_alike_are_no_match_and_exclusion_is_respected() -> None:
    twins = np.array([[0.9, 0.9, 0.1]], np.float32)
    assert as_list(mutual_matches(twins)) == []
    excluded = np.array([[0.9, -2.0, 0.1], [-2.0, -2.0, -2.0]], np.float32)
    assert as_list(mutual_matches(excluded)) == [(0, 0)]  # and a row without a candidate has no match


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0)])
def test_nothing_matches_nothing(shape: tuple[int, int]) -> None:
    assert as_list(mutual_matches(np.zeros(shape, np.float32))) == []


def test_one_column_is_compared_with_the_worst_possible_second() -> None:
    scores = np.array([[0.2], [0.9], [-0.5]], np.float32)
    assert as_list(mutual_matches(scores)) == [(1, 0)]
    assert as_list(mutual_matches(scores, min_score=0.95)) == []
    # 1 - 0.2 = 0.8 against 0.64 * 2: far away, but nothing else is nearer.
    assert as_list(mutual_matches(np.array([[0.2]], np.float32))) == [(0, 0)]
    assert as_list(mutual_matches(np.array([[-0.5]], np.float32))) == []


# ------------------------------------------------------------------------------------ along epipolar lines

ANGLE = np.radians(0.3)


def noisy_rays(rng: np.random.Generator, points: Floats, noise_rad: float) -> Floats:
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    sideways = np.cross(rays, rng.normal(size=rays.shape))
    rays = rays + noise_rad * rng.uniform(-1, 1, (len(rays), 1)) * sideways / np.linalg.norm(sideways, axis=1)[:, None]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def epipolar_mask(rays_a: Floats, rays_b: Floats, b_from_a: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which pairs of rays (N, M) can be one point, and which are too close to a limit or epipole to tell.

    By the definition, not by angles about the axis: the distance of each ray to the half-plane of the other.
    """
    a = rays_a @ b_from_a[:3, :3].T
    axis = b_from_a[:3, 3] / np.linalg.norm(b_from_a[:3, 3])
    normal_a = np.cross(axis, a)
    sine_a = np.linalg.norm(normal_a, axis=1)
    normal_b = np.cross(axis, rays_b)
    sine_b = np.linalg.norm(normal_b, axis=1)
    to_plane_a = np.abs(a @ normal_b.T) / sine_b  # of rays of a, to the planes of b
    to_plane_b = np.abs(rays_b @ normal_a.T).T / sine_a[:, None]
    same_side = normal_a @ normal_b.T > 0
    angle_a, angle_b = np.arccos(a @ axis), np.arccos(rays_b @ axis)
    opens = angle_a[:, None] - angle_b[None] + 2 * ANGLE
    allowed = (to_plane_a < ANGLE) & (to_plane_b < ANGLE) & same_side & (opens > 0)
    unclear = (np.abs(to_plane_a - ANGLE) < 1e-9) | (np.abs(to_plane_b - ANGLE) < 1e-9) | (np.abs(opens) < 1e-9)
    unclear |= (sine_a < ANGLE)[:, None] | (sine_b < ANGLE)
    return allowed, unclear


def scene(
    seed: int, world_from_a: Floats, world_from_b: Floats, count: int, half_angle_deg: float, noise: float = 0.3
) -> tuple[NDArray[np.float32], NDArray[np.float32], Floats, Floats, Floats, NDArray[np.int64]]:
    """Return descriptors, rays, b_from_a, and for each ray of a its true partner in b or -1.

    Half of the points are seen by both cameras; the others by one.
    """
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(60 * count, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(1.5, 12, (60 * count, 1))

    def visible(in_cam: Floats) -> NDArray[np.bool_]:
        return in_cam[:, 2] > np.cos(np.radians(half_angle_deg)) * np.linalg.norm(in_cam, axis=1)

    in_a = geometry.transform(geometry.invert(world_from_a), points)
    in_b = geometry.transform(geometry.invert(world_from_b), points)
    both = np.flatnonzero(visible(in_a) & visible(in_b))[: count // 2]
    assert len(both) > 20
    only_a = np.setdiff1d(np.flatnonzero(visible(in_a)), both)[: count // 2]
    only_b = np.setdiff1d(np.flatnonzero(visible(in_b)), [*both, *only_a])[: count // 2]
    rays_a = noisy_rays(rng, in_a[[*both, *only_a]], noise * ANGLE)
    rays_b = noisy_rays(rng, in_b[[*both, *only_b]], noise * ANGLE)
    shared = random_units(rng, len(both))
    a = np.concatenate([shared, random_units(rng, len(only_a))])
    b = np.concatenate([near_copies(rng, shared, 0.4), random_units(rng, len(only_b))])
    order_a, order_b = rng.permutation(len(a)), rng.permutation(len(b))
    partner = np.concatenate([np.arange(len(both)), np.full(len(only_a), -1)])
    place_in_b = np.append(np.argsort(order_b), -1)
    b_from_a = geometry.invert(world_from_b) @ world_from_a
    return a[order_a], b[order_b], rays_a[order_a], rays_b[order_b], b_from_a, place_in_b[partner[order_a]]


def camera(yaw_deg: float, center: list[float], roll_deg: float = 0.0) -> Floats:
    rotation = Rotation.from_euler("YXZ", [yaw_deg, 10, roll_deg], degrees=True).as_matrix()
    return geometry.make_pose(rotation, center)


SCENES = {
    "sideways": (camera(0, [0, 0, 0]), camera(0, [1, 0, 0]), 30),
    "sideways, rolled by 90 degrees": (camera(0, [0, 0, 0]), camera(-10, [1, 0, 0], 90), 30),
    "upwards": (camera(0, [0, 0, 0]), camera(5, [0, -0.4, 0]), 30),
    "forwards: the epipole is in both images": (camera(0, [0, 0, -0.7]), camera(0, [0, 0, 0.2]), 35),
    "backwards": (camera(0, [0, 0, 0.2]), camera(0, [0, 0, -0.7]), 35),
    "face to face": (camera(0, [0, 0, -5]), camera(180, [0.5, 0, 5]), 35),
    "fisheye, beyond 180 degrees": (camera(0, [0, 0, 0]), camera(40, [0.6, 0.1, 0.3]), 105),
    "all around": (camera(0, [0, 0, 0]), camera(100, [-0.4, 0.3, 0.6]), 179),
}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("seed", [0, 1])
def test_true_correspondences_are_found_and_nothing_else_than_by_brute_force(name: str, seed: int) -> None:
    a, b, rays_a, rays_b, b_from_a, partner = scene(seed, *SCENES[name][:2], 400, SCENES[name][2])
    found = as_list(match_along_epipolar_lines(a, b, rays_a, rays_b, b_from_a, ANGLE, ANGLE))
    allowed, unclear = epipolar_mask(rays_a, rays_b, b_from_a)
    assert 0 < allowed.mean() < 0.1
    assert unclear.mean() < 0.02
    expected = brute_force(a @ b.T, allowed, 0.9, 0.6)
    assert {match for match in found if not unclear[match]} == {match for match in expected if not unclear[match]}
    true = [(i, j) for i, j in enumerate(partner.tolist()) if j >= 0 and not unclear[i, j]]
    assert len(true) > 20
    # Close to the epipole of one camera, noise there turns the plane by more than the other camera's limit.
    assert np.mean([allowed[match] for match in true]) > 0.98
    assert {match for match in true if allowed[match]} <= set(found)


def test_the_geometry_decides_between_twins() -> None:
    """Two points that look alike have no match by descriptors; each has one on its epipolar line."""
    twin = random_units(np.random.default_rng(0), 1)
    descriptors = np.repeat(twin, 2, axis=0)
    rays = np.array([[0.0, -0.2, 1], [0.0, 0.2, 1]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    b_from_a = geometry.make_pose(np.eye(3), [-0.1, 0, 0])
    assert len(mutual_matches(descriptors @ descriptors.T, 0.9)) == 0
    found = match_along_epipolar_lines(descriptors, descriptors, rays, rays[::-1], b_from_a, ANGLE, ANGLE)
    assert sorted(as_list(found)) == [(0, 1), (1, 0)]


def test_a_point_behind_is_not_matched() -> None:
    """On the epipolar line, but the rays diverge: they meet behind the cameras."""
    one = random_units(np.random.default_rng(0), 1)
    b_from_a = geometry.make_pose(np.eye(3), [-1.0, 0, 0])  # b stands to the right of a
    left, right = np.array([[-0.3, 0, 1.0]]), np.array([[0.3, 0, 1.0]])
    left, right = left / np.linalg.norm(left), right / np.linalg.norm(right)
    assert as_list(match_along_epipolar_lines(one, one, right, left, b_from_a, ANGLE, ANGLE)) == [(0, 0)]
    assert as_list(match_along_epipolar_lines(one, one, left, right, b_from_a, ANGLE, ANGLE)) == []


@pytest.mark.parametrize("turn_deg", range(0, 360, 15))
def test_turns_wrap_around(turn_deg: float) -> None:
    """Wherever about the baseline the scene lies, also across the place where the angle jumps."""
    turned = geometry.make_pose(Rotation.from_euler("X", turn_deg, degrees=True).as_matrix(), np.zeros(3))
    a, b, rays_a, rays_b, b_from_a, partner = scene(3, turned, turned @ camera(0, [0.8, 0, 0]), 120, 30)
    found = dict(as_list(match_along_epipolar_lines(a, b, rays_a, rays_b, b_from_a, ANGLE, ANGLE)))
    assert {i: j for i, j in enumerate(partner.tolist()) if j >= 0}.items() <= found.items()
    # The frames of both cameras turned alike, so that the angle itself goes round.
    a_turned, b_turned = rays_a @ turned[:3, :3].T, rays_b @ turned[:3, :3].T
    again = match_along_epipolar_lines(
        a, b, a_turned, b_turned, turned @ b_from_a @ geometry.invert(turned), ANGLE, ANGLE
    )
    assert dict(as_list(again)) == found


def test_rays_all_around_the_epipole_match_across_the_jump_of_the_angle() -> None:
    """Forward motion and few rays, so that they all are compared at once; b's are turned by 1 degree."""
    descriptors = random_units(np.random.default_rng(0), 60)
    b_from_a = geometry.make_pose(np.eye(3), [0, 0, 1.0])
    for start_deg in np.arange(0, 6, 0.5):
        turns = np.radians(start_deg + np.arange(60) * 6)
        rays = []
        for turn, opening in ((turns, np.radians(30)), (turns + np.radians(1), np.radians(20))):
            sideways = np.sin(opening) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            rays.append(np.column_stack([sideways, np.full(60, np.cos(opening))]))
        limit = np.radians(2.7)
        found = match_along_epipolar_lines(descriptors, descriptors, *rays, b_from_a, limit, limit)
        assert as_list(found) == [(index, index) for index in range(60)]


def test_the_other_way_round_gives_nearly_the_same() -> None:
    a, b, rays_a, rays_b, b_from_a, _ = scene(0, *SCENES["sideways"][:2], 400, 30)
    found = as_list(match_along_epipolar_lines(a, b, rays_a, rays_b, b_from_a, ANGLE, ANGLE))
    back = as_list(match_along_epipolar_lines(b, a, rays_b, rays_a, geometry.invert(b_from_a), ANGLE, ANGLE))
    common = set(found) & {(i, j) for j, i in back}
    assert len(common) > 0.97 * max(len(found), len(back))  # the ratio is of a's side


def test_each_side_has_its_own_limit() -> None:
    one = random_units(np.random.default_rng(0), 1)
    b_from_a = geometry.make_pose(np.eye(3), [-1.0, 0, 0])
    above, level = np.array([[0.3, 0.01, 1.0]]), np.array([[-0.3, 0.0, 1.0]])  # 0.01 rad off the line
    above, level = above / np.linalg.norm(above), level / np.linalg.norm(level)
    for wide_a, wide_b, expected in [(0.02, 0.02, 1), (0.005, 0.02, 0), (0.02, 0.005, 0)]:
        assert len(match_along_epipolar_lines(one, one, above, level, b_from_a, wide_a, wide_b)) == expected


def test_cameras_in_one_place_match_nothing() -> None:
    a, b, rays_a, rays_b, b_from_a, _ = scene(0, *SCENES["sideways"][:2], 100, 30)
    same_place = b_from_a.copy()
    same_place[:3, 3] = 0
    assert as_list(match_along_epipolar_lines(a, b, rays_a, rays_b, same_place, ANGLE, ANGLE)) == []


def test_no_features_match_nothing() -> None:
    one, ray, none = random_units(np.random.default_rng(0), 1), np.array([[0.0, 0, 1]]), np.zeros((0, 3))
    empty = np.zeros((0, 128), np.float32)
    pose = geometry.make_pose(np.eye(3), [1.0, 0, 0])
    assert as_list(match_along_epipolar_lines(empty, one, none, ray, pose, ANGLE, ANGLE)) == []
    assert as_list(match_along_epipolar_lines(one, empty, ray, none, pose, ANGLE, ANGLE)) == []
    assert as_list(match_along_epipolar_lines(empty, empty, none, none, pose, ANGLE, ANGLE)) == []


@pytest.mark.parametrize("side", ["a", "b"])
def test_a_ray_along_the_baseline_does_no_harm(side: str) -> None:
    """Its turn is not defined; the other features must still be matched."""
    a, b, rays_a, rays_b, b_from_a, partner = scene(5, *SCENES["forwards: the epipole is in both images"][:2], 200, 35)
    axis = b_from_a[:3, 3] / np.linalg.norm(b_from_a[:3, 3])
    alone = np.flatnonzero(partner < 0)[0]
    if side == "a":
        rays_a[alone] = -b_from_a[:3, :3].T @ axis
    else:
        rays_b[np.setdiff1d(np.arange(len(b)), partner)[0]] = -axis
    with np.errstate(all="raise"):
        found = as_list(match_along_epipolar_lines(a, b, rays_a, rays_b, b_from_a, ANGLE, ANGLE))
    assert len(found) >= 0.95 * (partner >= 0).sum()


# ------------------------------------------------------------------------------------------- matchers and files


def features_of(units: NDArray[np.float32]) -> LocalFeatures:
    ones = np.ones(len(units), np.float32)
    return LocalFeatures(np.zeros((len(units), 2), np.float32), ones, ones, units, (640, 480))


def test_the_mutual_matcher_takes_any_descriptors_and_gives_their_similarity() -> None:
    rng = np.random.default_rng(0)
    units = np.abs(random_units(rng, 40))
    order = rng.permutation(40)
    for stored in (units, units.astype(np.float16), np.round(units * DESCRIPTOR_SCALE).clip(0, 255).astype(np.uint8)):
        a, b = features_of(stored), features_of(stored[order])
        forth, back = MutualMatcher(ratio=0.9).match([(a, b), (b, a)])
        assert forth.indices.tolist() == [[i, int(np.flatnonzero(order == i)[0])] for i in range(40)]
        assert sorted(map(tuple, back.indices[:, ::-1].tolist())) == sorted(map(tuple, forth.indices.tolist()))
        np.testing.assert_allclose(forth.scores, 1, atol=0.03)
        nothing = a.take(slice(0))
        assert [len(found) for found in MutualMatcher().match([(a, nothing), (nothing, b)])] == [0, 0]


def test_matchers_by_name() -> None:
    matcher = create_matcher("mutual", ratio=0.7)
    assert matcher.settings == {"name": "mutual", "ratio": 0.7, "min_score": -1.0}
    assert matchers_of(["sift"]) == {"sift": "mutual"}
    assert matchers_of(["sift", "superpoint"]) == {"sift": "mutual", "superpoint": "lightglue"}
    assert matchers_of(["sift", "superpoint"], "lightglue") == {"sift": "mutual", "superpoint": "lightglue"}
    assert matchers_of(["superpoint"], "mutual") == {"superpoint": "mutual"}
    for wrong, text in (
        (lambda: create_matcher("flann"), "Unknown matcher 'flann'"),
        (lambda: matchers_of(["sift"], "lightglue"), "suits none of the features. Known for sift: mutual"),
        (lambda: matchers_of(["surf"], None), "Unknown local features 'surf'"),
    ):
        with pytest.raises(ManifestError, match=text):
            wrong()
