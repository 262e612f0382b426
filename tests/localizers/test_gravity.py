"""Which direction is up in odometry, and what that is good for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.localizers.drifting import Drive, drive
from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.localizers.gravity import Gravity, measured_gravity
from toolkit.localizers.odometry import Odometry, PosedQueries
from toolkit.manifest import SequenceSettings

pytest.importorskip("gtsam")
from toolkit.localizers.pose_graph import place_piece

SETTINGS = SequenceSettings()
UP = np.array([0.0, 0.0, 1.0])


def turned(way: Drive, by: Floats) -> tuple[Odometry, PosedQueries]:
    """Return a drive's odometry in another frame, and its queries."""
    poses = geometry.make_pose(Rotation.from_rotvec(by).as_matrix(), np.zeros(3)) @ way.odometry.odom_from_rig
    return replace(way.odometry, odom_from_rig=poses), way.queries


def pieces(lean_deg: float = 0.0, wrong: float = 0.0) -> list[tuple[Odometry, PosedQueries]]:
    """Return three pieces of any heading, each of which leans by so much in a frame that has y up."""
    ways = [drive(np.random.default_rng(seed), wrong=wrong) for seed in range(3)]
    y_up = Rotation.from_euler("z", lean_deg, degrees=True) * Rotation.from_euler("x", -90, degrees=True)
    headings = (Rotation.from_euler("z", heading, degrees=True) for heading in (0, 77, 205))
    frames = [(y_up * heading).as_rotvec() for heading in headings]
    return [turned(way, frame) for way, frame in zip(ways, frames, strict=True)]


@pytest.mark.parametrize("wrong", [0.0, 0.15])
def test_the_axis_that_is_up_is_found(wrong: float) -> None:
    gravity = measured_gravity(pieces(wrong=wrong), [0.2, -0.1, 1.0], SETTINGS)  # type: ignore[arg-type]
    assert gravity is not None
    np.testing.assert_allclose(gravity.in_odometry, [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(gravity.in_map, UP, atol=0.02)


def test_where_it_is_not_known_nothing_is_assumed() -> None:
    assert measured_gravity(pieces(lean_deg=45), UP, SETTINGS) is None
    assert measured_gravity(pieces(), np.array([1.0, 0.0, 0.0]), SETTINGS) is None, "another direction is up"
    assert measured_gravity(pieces(), UP, SETTINGS.model_copy(update={"gravity_std_deg": None})) is None
    assert measured_gravity([], UP, SETTINGS) is None
    odometry, queries = pieces()[0]
    assert measured_gravity([(odometry, queries.choose(np.arange(5)))], UP, SETTINGS) is None, "too few"
    doubted = replace(queries, trusted=np.zeros(len(queries), bool))
    assert measured_gravity([(odometry, doubted)], UP, SETTINGS) is None
    wrong = [turned(drive(np.random.default_rng(seed), wrong=0.5), np.zeros(3)) for seed in range(2)]
    assert measured_gravity(wrong, UP, SETTINGS) is None


def test_a_pose_that_would_make_odometry_lean_has_no_voice() -> None:
    """Two poses agree that the device lies on its side, one says that it does not."""
    way = drive(np.random.default_rng(0))
    aside = geometry.make_pose(Rotation.from_rotvec([1.5, 0, 0]).as_matrix(), [40.0, 0, 0])
    queries = way.queries.choose(np.array([3, 9, 15]))
    poses = queries.world_from_rig.copy()
    poses[:2] = aside @ poses[:2]
    queries = replace(queries, world_from_rig=poses, trusted=np.array([False, False, True]))
    right = way.world_from_rig[way.queries.frames[15]]
    for gravity, expected_m in ((None, 10.0), (Gravity(UP, UP), 0.5)):
        placed = place_piece(way.odometry, replace(queries, trusted=np.zeros(3, bool)), SETTINGS, gravity)
        _, off_m = geometry.pose_error(placed.world_from_rig[way.queries.frames[15]][None], right[None])
        assert (off_m[0] < expected_m) == (gravity is not None)


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
    assert tilt_deg(Gravity(UP, UP)) < 0.5
