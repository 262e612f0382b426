from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from tests.displayed import picture_of
from toolkit.capture.upright import up_of_cameras
from toolkit.figures.query_images import draw_localization, draw_worst, off_by, shown_name
from toolkit.figures.style import error_colors, new_figure, save_figure
from toolkit.figures.top_view import draw_scene
from toolkit.geometry import make_pose, project
from toolkit.results.localized import QueryDetails, ShownImage

CAMERA = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24])
HIGH = pycolmap.Camera(model="PINHOLE", width=64, height=96, params=[50, 50, 32, 48])


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


def test_projection_has_half_pixel_centers_and_leaves_out_what_is_behind():
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
    figure = draw_scene(*scene, title="a <map>")
    save_figure(figure, tmp_path / "scene.png", figure.get_suptitle())
    titles = [axis.get_title() for axis in figure.axes if axis.get_title()]
    assert titles == [
        "place 1: 2 of 2 queries have a pose, 1 estimated outside the picture",
        "place 2: 0 of 1 queries have a pose",
    ]
    with Image.open(tmp_path / "scene.png") as image:
        assert image.text["Description"] == "a <map>"
        assert min(image.size) > 300


def test_no_text_of_a_scene_picture_says_meters_where_the_unit_is_not_known(scene):
    figure = draw_scene(*scene, unit=("L", 3.0))
    texts = [label for axis in figure.axes for label in (axis.get_xlabel(), axis.get_ylabel()) if label]
    assert "position error [L]" in texts
    assert not any("[m]" in text for text in texts)


def test_scene_picture_without_points_truth_or_queries(scene):
    _, _, poses, estimated, _ = scene
    no_truth, no_queries = np.full_like(estimated, np.nan), np.zeros((0, 4, 4))
    assert draw_scene(np.zeros((0, 3)), None, poses, estimated, no_truth, up=[0, 0, 1])
    assert draw_scene(np.zeros((0, 3)), None, poses[:1], no_queries, no_queries)


def texts_of(figure):
    texts = [axis.get_title() for axis in figure.axes]
    return texts + [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_scene_picture_speaks_of_true_positions_only_where_they_are_known(scene):
    points, colors, poses, estimated, true = scene
    assert "query, estimated; a line joins it to its true position" in texts_of(draw_scene(*scene))
    texts = texts_of(draw_scene(points, colors, poses, estimated[:1], np.full_like(true[:1], np.nan)))
    assert "query, estimated" in texts
    assert "place 1: " in texts
    assert not any("true" in text or "of" in text.split() for text in texts)


@pytest.fixture
def images(tmp_path):
    """A query image with five matches, of which one is rejected, and a reference twice as high that sees two."""
    rng = np.random.default_rng(0)
    files = [tmp_path / "query.jpg", tmp_path / "reference.jpg"]
    Image.fromarray(rng.integers(0, 255, (48, 64, 3), np.uint8)).save(files[0])
    Image.fromarray(rng.integers(0, 255, (96, 64, 3), np.uint8)).save(files[1])
    points = rng.uniform([-1, -1, 3], [1, 1, 6], (5, 3))
    pixels, _ = project(points, CAMERA, np.eye(4))
    agrees, matches = np.array([True, True, False, True, True]), np.array([4, 7, 1, 2, 9])
    true = make_pose(np.eye(3), [0.02, 0, 0])
    kinds = np.array(["sift/guided"] * 5)
    query = ShownImage("q", files[0], CAMERA, np.eye(4), pixels, points, matches, agrees, true, kinds)
    seen = [4, 0, 2]
    seen_too = points[seen], matches[seen], agrees[seen], true, kinds[seen]
    reference = ShownImage("r", files[1], HIGH, np.eye(4), pixels[:3], *seen_too)
    return query, reference


def test_localization_pictures_of_success_and_failure(images):
    query, reference = images
    references = [reference, replace(reference, name="r2")]
    done = draw_localization(QueryDetails([query], references, references[:1]), "query 7: ok")
    assert done.get_suptitle() == "query 7: ok · off by 0°, 2 cm"
    titles = ["query: 4 of 5 map points agree", *(f"reference {k}: sees 2 points" for k in (1, 2))]
    assert [axis.get_title() for axis in done.axes] == [*titles, "rejected: contradicts the others"]
    lost = QueryDetails([ShownImage("q", query.image, CAMERA, np.full((4, 4), np.nan))])
    failed = draw_localization(lost, "query 8")
    assert failed.axes[0].get_title() == "query: not localized"


def test_the_worst_queries_are_drawn_with_the_matches_they_share_with_a_reference(images, tmp_path):
    query, reference = images
    imported = replace(query, name="hl_query/raw_data/import/images/7.jpg")
    gone = ShownImage("x", tmp_path / "gone.jpg", CAMERA, np.eye(4))
    unmatched = ShownImage("q", query.image, CAMERA, np.eye(4))
    worst = [
        ("hl in the ios map: failed: too few matches, 3 matches", QueryDetails([query])),
        (f"hl in the ios map: {off_by(2.0, 0.5, 'm')}; ok, 5 matches", QueryDetails([imported], [reference])),
        ("hl in the ios map: ok", QueryDetails([query], [gone])),
        ("hl in the ios map: ok", QueryDetails([unmatched], [], [reference])),
    ]
    deep = replace(query, name=f"s/raw_data/{'folder/' * 12}{'8' * 80}.jpg")
    worst[2] = worst[2][0], QueryDetails([deep], [gone])
    figure = draw_worst(worst, "the worst")
    first, second, third, fourth = figure.axes[:4]
    assert first.get_title(loc="left").startswith("1. hl in the ios map: failed: too few matches")
    assert second.get_title(loc="left") == "2. hl in the ios map: off by 2°, 50 cm; ok, 5 matches\n7.jpg"
    name = third.get_title(loc="left").split("\n")[1]
    assert (len(name), name[0], name[-6:]) == (50, "…", "88.jpg")
    assert shown_name(f"s/raw_data/{'folder/' * 12}8.jpg", 50) == "…/8.jpg", "what tells images apart"
    rejected, agreeing = (c.get_segments() for c in second.collections if hasattr(c, "get_segments"))
    # The reference, twice as high, is drawn at half its size beside the query.
    np.testing.assert_allclose([line[0] for line in agreeing], query.pixels[[0, 4]])
    np.testing.assert_allclose([line[1] for line in agreeing], reference.pixels[[1, 0]] / 2 + [64 * 1.02, 0])
    np.testing.assert_allclose([line[0] for line in rejected], query.pixels[[2]])
    assert [text.get_text() for text in third.texts] == ["no common points"]
    assert [text.get_text() for text in fourth.texts] == ["no matches; rejected: contradicts the others"]
    assert draw_worst([])


def test_errors_have_the_colors_of_the_legend_and_styles_stay_where_they_are():
    import matplotlib as mpl

    before = mpl.rcParams["figure.titleweight"]
    colors = error_colors([0.001, 0.01, 0.1, 1.0, 50.0, np.nan])
    assert (colors[0] == colors[1]).all()
    assert (colors[3] == colors[4]).all()
    assert len(np.unique(colors, axis=0)) == 4
    figure = draw_scene(np.zeros((0, 3)), None, looking([80, 90]), looking([80, 90]), looking([80, 90]))
    assert figure._suptitle.get_fontweight() == "bold"
    assert mpl.rcParams["figure.titleweight"] == before != "bold"


def test_a_notebook_shows_a_figure_as_a_file_has_it_with_what_reaches_beyond_its_border(tmp_path):
    def figure():
        made = new_figure(2, 1)
        made.subplots().plot([0, 1])
        made.suptitle("a title that is wider than the figure of two inches that it belongs to")
        return made

    whole, path = figure(), save_figure(figure(), tmp_path / "figure.png")
    np.testing.assert_array_equal(picture_of(whole), Image.open(path))
    with Image.open(path) as picture:
        assert picture.width > 2 * 160 + 32
