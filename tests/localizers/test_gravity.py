"""Which direction is up in odometry, and what that is good for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.localizers.drifting import Drive, drive
from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.localizers.gravity import Gravity, measured_gravity
from toolkit.localizers.odometry import UNKNOWN_COVARIANCE, Odometry, PosedQueries
from toolkit.manifest import SequenceSettings

pytest.importorskip("gtsam")
from toolkit.localizers.pose_graph import place_piece

SETTINGS = SequenceSettings(gravity_std_deg=0.5)
UP = np.array([0.0, 0.0, 1.0])
KNOWN = Gravity(UP, UP, 0.5)
Y_UP = Rotation.from_euler("x", -90, degrees=True)


def turned(way: Drive, by: Rotation) -> tuple[Odometry, PosedQueries]:
    """Return a drive's odometry in another frame, and its queries."""
    poses = geometry.make_pose(by.as_matrix(), np.zeros(3)) @ way.odometry.odom_from_rig
    return replace(way.odometry, odom_from_rig=poses), way.queries


def pieces(lean_deg: float = 0.0, wrong: float = 0.0) -> list[tuple[Odometry, PosedQueries]]:
    """Return three pieces of any heading, each of which leans by so much in a frame that has y up."""
    ways = [drive(np.random.default_rng(seed), wrong=wrong) for seed in range(3)]
    frame = Rotation.from_euler("z", lean_deg, degrees=True) * Y_UP
    headings = (Rotation.from_euler("z", heading, degrees=True) for heading in (0, 77, 205))
    return [turned(way, frame * heading) for way, heading in zip(ways, headings, strict=True)]


@pytest.mark.parametrize("wrong", [0.0, 0.15])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_axis_that_is_up_is_found(wrong: float, sign: float) -> None:
    """A map may have any axis up, such as -z."""
    gravity = measured_gravity(pieces(wrong=wrong), lambda: sign * np.array([0.2, -0.1, 1.0]), SETTINGS)
    assert gravity is not None
    np.testing.assert_allclose(gravity.in_odometry, [0, sign, 0], atol=1e-9)
    np.testing.assert_allclose(gravity.in_map, sign * UP, atol=0.02)
    assert 0.5 < gravity.std_deg < 1.5


def test_where_it_is_not_known_nothing_is_assumed() -> None:
    def none(found: list[tuple[Odometry, PosedQueries]], up: Floats = UP) -> bool:
        return measured_gravity(found, lambda: up, SETTINGS) is None

    assert not none(pieces())
    assert none(pieces(lean_deg=15)), "its frame does not stand upright"
    assert none(pieces(), np.array([1.0, 0.0, 0.0])), "another direction is up"
    assert none([])
    odometry, queries = pieces()[0]
    assert none([(odometry, queries), (odometry, queries)]), "of one heading, its other axes are as steady"
    assert none([(motion, few.choose(np.arange(1))) for motion, few in pieces()]), "too few"
    assert none([(motion, replace(all_, trusted=np.zeros(len(all_), bool))) for motion, all_ in pieces()])


@pytest.mark.parametrize("settings", [SequenceSettings(), SequenceSettings(gravity_std_deg=0.5, online=True)])
def test_by_default_and_online_nothing_is_asked_for(settings: SequenceSettings) -> None:
    def up() -> Floats:
        raise AssertionError

    assert measured_gravity(pieces(), up, settings) is None


def test_a_pose_that_would_make_odometry_lean_has_no_voice() -> None:
    """Two poses agree that the device lies on its side, one says that it does not."""
    way = drive(np.random.default_rng(0))
    aside = geometry.make_pose(Rotation.from_rotvec([1.5, 0, 0]).as_matrix(), [40.0, 0, 0])
    queries = way.queries.choose(np.array([3, 9, 15]))
    poses = queries.world_from_rig.copy()
    poses[:2] = aside @ poses[:2]
    queries = replace(queries, world_from_rig=poses, trusted=np.zeros(3, bool))
    right = way.world_from_rig[way.queries.frames[15]]
    for gravity in (None, KNOWN):
        placed = place_piece(way.odometry, queries, SETTINGS, gravity)
        _, off_m = geometry.pose_error(placed.world_from_rig[way.queries.frames[15]][None], right[None])
        assert (off_m[0] < 0.5) == (gravity is not None)


def test_queries_that_are_right_keep_their_voice() -> None:
    """Odometry may drift by more than it may lean, and a pose may not know its rotation."""
    way = drive(np.random.default_rng(2), frames=600, every=20)
    frame = way.world_from_rig[:, :3, :3] @ way.odometry.odom_from_rig[:, :3, :3].transpose(0, 2, 1)
    assert np.degrees(np.arccos(frame[:, 2, 2])).max() > 5
    assert KNOWN.upright(way.odometry, way.queries, SETTINGS).trusted.all()
    tilt = geometry.make_pose(Rotation.from_rotvec([0.3, 0, 0]).as_matrix(), np.zeros(3))
    queries = replace(way.queries, world_from_rig=way.queries.world_from_rig @ tilt)
    few = replace(queries.choose(np.arange(2)), trusted=np.array([True, False]))
    assert not KNOWN.upright(way.odometry, few, SETTINGS).weights.any()
    unknown = replace(few, covariances=np.tile(UNKNOWN_COVARIANCE, (2, 1, 1)))
    assert KNOWN.upright(way.odometry, unknown, SETTINGS).weights.all()


def test_gravity_holds_upright_what_queries_do_not() -> None:
    way = drive(np.random.default_rng(2), drift=0.01)
    lean = geometry.make_pose(Rotation.from_rotvec([0.06, 0, 0]).as_matrix(), np.zeros(3))
    queries = way.queries.choose(np.array([4]))
    covariance = np.diag(np.repeat([0.1, 0.05], 3) ** 2)[None]
    queries = replace(queries, world_from_rig=queries.world_from_rig @ lean, covariances=covariance)

    def tilt_deg(gravity: Gravity | None) -> float:
        placed = place_piece(way.odometry, queries, SETTINGS, gravity)
        ups = placed.world_from_rig[:, :3, :3] @ way.odometry.odom_from_rig[:, :3, :3].transpose(0, 2, 1) @ UP
        return float(np.degrees(np.arccos(ups[0] @ UP)))

    assert tilt_deg(None) > 3
    assert tilt_deg(KNOWN) < 0.5


@pytest.mark.parametrize("lean_deg", [3.0, 20.0, 90.0])
def test_a_piece_that_leans_follows_its_queries(lean_deg: float) -> None:
    """Gravity is wrong there: neither the places nor what is said of them suffer."""
    way = drive(np.random.default_rng(5))
    odometry, queries = turned(way, Rotation.from_euler("x", lean_deg, degrees=True))
    without, placed = (place_piece(odometry, queries, SETTINGS, gravity) for gravity in (None, KNOWN))
    assert (placed.status == without.status).all()
    assert placed.used.all()
    errors = [geometry.pose_error(each.world_from_rig, way.world_from_rig) for each in (without, placed)]
    assert np.median(errors[1], axis=1) == pytest.approx(np.median(errors[0], axis=1), rel=0.1)
    assert errors[1][0].max() < errors[0][0].max() + 0.3
