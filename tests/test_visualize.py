import numpy as np
import pycolmap
import pytest
from PIL import Image

from toolkit.geometry import make_pose, project
from toolkit.recordings import Queries, Views, record_scene
from toolkit.stills import draw_localization, draw_scene_png
from toolkit.top_view import ground_axes, places_of
from toolkit.upright import up_of_cameras

CAMERA = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24])


def looking(headings_deg, up_axis=2, roll_deg=0.0, pitch_deg=0.0, step=1.0):
    """Return world_from_cam of cameras in a row; the axis of the world that is up can be chosen."""
    poses = []
    for k, heading in enumerate(np.radians(headings_deg)):
        forward, up = np.array([np.cos(heading), np.sin(heading), 0]), np.array([0, 0, 1.0])
        pitch, roll = np.radians(pitch_deg), np.radians(roll_deg)
        z = np.cos(pitch) * forward + np.sin(pitch) * up
        right = np.cross(forward, up)
        down = np.cross(z, right)
        x = np.cos(roll) * right + np.sin(roll) * down
        rotation = np.roll(np.stack([x, np.cross(z, x), z], axis=1), up_axis + 1, axis=0)
        poses.append(make_pose(rotation, np.roll([step * k, 0.1 * k, 0], up_axis + 1)))
    return np.array(poses)


@pytest.mark.parametrize("up_axis", [0, 1, 2])
@pytest.mark.parametrize("roll_deg", [0, 90, -90])
def test_up_is_found_in_level_pitched_and_rolled_cameras(up_axis, roll_deg):
    headings = [20, 60, 100, 140, 170]
    poses = np.concatenate(
        [looking(headings, up_axis, pitch_deg=10), looking(headings, up_axis, roll_deg, pitch_deg=10)]
    )
    up = up_of_cameras(np.concatenate([poses, np.full((1, 4, 4), np.nan)]))
    assert up @ np.eye(3)[up_axis] > np.cos(np.radians(1))


def test_up_of_cameras_that_all_look_one_way_and_of_none():
    assert up_of_cameras(looking([90] * 5))[2] > 0.99
    assert up_of_cameras(np.zeros((0, 4, 4))).tolist() == [0, 0, 1]


def test_ground_axes_are_seen_from_above():
    for up in ([0, 0, -1], [0, 1, 0], [0.1, 0.2, 0.9]):
        axes, labels = ground_axes(up)
        np.testing.assert_allclose(np.cross(*axes), up / np.linalg.norm(up), atol=1e-12)
        assert len(labels) == 2
    assert ground_axes([0, 0, -1])[1] == ["x [m]", "−y [m]"]


def test_far_apart_places_are_told_apart():
    rng = np.random.default_rng(0)
    row = np.stack([np.arange(20.0), np.zeros(20)], axis=1)
    east, north = np.array([100, 0]), np.array([0, 90])
    positions = np.concatenate([row + east, row + east, row, rng.normal(size=(30, 2)) + north])
    place = places_of(positions)
    assert place.tolist() == [0] * 40 + [1] * 20 + [2] * 30
    assert set(places_of(row)) == {0}
    assert places_of(np.zeros((3, 2))).tolist() == [0, 0, 0]
    assert len(places_of(np.zeros((0, 2)))) == 0


def test_projection_has_half_pixel_centres_and_leaves_out_what_is_behind():
    pixels, visible = project(np.array([[0, 0, 2.0], [0.4, 0, 2], [0, 0, -1]]), CAMERA, np.eye(4))
    np.testing.assert_allclose(pixels[:2], [[32, 24], [42, 24]])
    assert visible.tolist() == [True, True, False]


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    poses = np.concatenate([looking([80, 90, 100])] * 2)
    poses[3:, 0, 3] += 100
    estimated, true = poses[[0, 1, 4]].copy(), poses[[0, 1, 4]].copy()
    estimated[0, 0, 3] += 0.5
    estimated[1, 0, 3] += 500  # far outside
    estimated[2] = np.nan
    points = rng.normal([2, 5, 0], size=(200, 3))
    colors = rng.integers(0, 255, (200, 3), np.uint8)
    return points, colors, poses, estimated, true


def test_scene_picture(scene, tmp_path):
    figure = draw_scene_png(*scene, tmp_path / "scene.png", title="a <map>")
    titles = [axis.get_title() for axis in figure.axes if axis.get_visible()]
    assert titles == [
        "place 1: 2 of 2 queries have a pose, 1 estimated outside the picture",
        "place 2: 0 of 1 queries have a pose",
    ]
    with Image.open(tmp_path / "scene.png") as image:
        assert image.text["Description"] == "a <map>"
        assert min(image.size) > 300


def test_scene_picture_without_points_truth_or_queries(scene):
    _, _, poses, estimated, _ = scene
    assert draw_scene_png(np.zeros((0, 3)), None, poses, estimated, None, up=[0, 0, 1])
    assert draw_scene_png(np.zeros((0, 3)), None, poses[:1], np.zeros((0, 4, 4)), None)


def test_localization_pictures_of_success_and_failure(tmp_path):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (48, 64, 3), np.uint8)
    points = rng.uniform([-1, -1, 3], [1, 1, 6], (20, 3))
    keypoints, _ = project(points, CAMERA, np.eye(4))
    inliers = np.arange(20) < 15
    references = [(image, "reference 1"), (image[:, :30], "reference 2"), (image[..., 0], "reference 3")]
    true = make_pose(np.eye(3), [0.02, 0, 0])
    done = draw_localization(
        image,
        CAMERA,
        np.eye(4),
        points,
        references,
        tmp_path / "done.png",
        "query 7: ok",
        keypoints,
        inliers,
        true,
    )
    assert done.get_suptitle() == "query 7: ok · off by 0°, 2 cm"
    assert done.axes[0].get_title() == "query: 15 of 20 map points agree"
    for missing in (None, np.full((4, 4), np.nan)):
        failed = draw_localization(
            image, CAMERA, missing, np.zeros((0, 3)), [], tmp_path / "failed.png", "query 8"
        )
        assert failed.axes[0].get_title() == "query: not localized"
    assert (tmp_path / "failed.png").is_file()


def test_recording_holds_the_scene(scene, tmp_path):
    import rerun as rr

    points, colors, poses, estimated, true = scene
    files = []
    for k in range(6):
        files.append(tmp_path / f"{k}.jpg")
        Image.fromarray(np.full((48, 64, 3), 40 * k, np.uint8)).save(files[-1])
    views = Views(poses, [CAMERA] * 6, files, [f"ios_map/a/{k}.jpg" for k in range(6)])
    of_queries = Views(estimated, [CAMERA] * 3, files[:3], ["a", "b", "c"])
    queries = {"hl": Queries(estimated, true, ["a", "b", "c"], ["ok", "ok", "failed: x"], of_queries)}
    path = record_scene(tmp_path / "scene.rrd", views, points, colors, queries, max_images=3, image_size=32)
    assert [p.name for p in tmp_path.glob("*.rrd")] == ["scene.rrd"]
    rows: dict[str, int] = {}
    for chunk in rr.chunk.RrdReader(path).stream().to_chunks():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    wanted = ["map/points", "map/trajectory", "map/cameras/0", "map/cameras/0/image", "map/cameras/5"]
    wanted += [f"queries/hl/{name}" for name in ("estimated", "true", "error", "view", "view/image")]
    assert {f"/world/{name}" for name in wanted} | {"/query/hl"} <= set(rows)
    assert "/world/map/cameras/1" not in rows
    assert rows["/query/hl"] == 3


def test_recording_without_queries_or_images(tmp_path):
    empty = Views(np.zeros((0, 4, 4)), [], [], [])
    assert record_scene(tmp_path / "empty.rrd", empty, np.zeros((0, 3)), None, {}).stat().st_size > 0
