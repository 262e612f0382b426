"""Each method's pictures show what its poses rest on: its own inliers, points and references."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from tests.localized import instants, some_correspondences, stored, write_pair, write_queries
from toolkit.capture import Capture
from toolkit.errors import ArtifactError
from toolkit.figures.query_images import draw_localization
from toolkit.files import write_sidecar
from toolkit.geometry import make_pose
from toolkit.mapping.local_map import LocalMap
from toolkit.results import localized as images
from toolkit.results import pair as localized
from toolkit.results.localized import LocalizedPair, support_of, sure_points
from toolkit.results.pair import load_maps, map_files

INLIERS = [True, False, True, True, False, True]


@pytest.fixture
def capture(small_capture):
    return Capture.open(small_capture)


@pytest.fixture
def open_pair(capture, tmp_path):
    """Write one localized query of a device in the phone's map, and open the pair."""

    def write_and_open(query_device, query, **columns):
        write_pair(capture, tmp_path, "ios", query_device, [query], **{k: [v] for k, v in columns.items()})
        return LocalizedPair.open(capture, "ios", query_device, tmp_path, None)

    return write_and_open


def names(session, count):
    return [session.image_name(row) for row in range(count)]


def query_images(capture, device):
    session = capture[f"{device}_query"]
    return [session.image_name(int(row)) for row in session.rows_of_keyframes(instants(session)[:1])[0]]


def drawn(axis):
    """Return the positions of the dots of an axis, in the file's pixels, a list a color."""
    dots = [c.get_offsets() for c in axis.collections if not hasattr(c, "get_segments")]
    return [np.asarray(xy) for xy in dots]


@pytest.mark.parametrize("point_index", [None, -1])  # -1: lifted points, which no map holds
def test_a_single_camera_shows_its_inliers_and_where_its_references_see_them(capture, open_pair, point_index):
    found = some_correspondences([0] * 6, INLIERS, point_index=point_index)
    query = stored(query_images(capture, "ios"), names(capture["ios_map"], 2), [], found)
    details = open_pair("ios", query).details(0)
    (camera,) = details.cameras
    np.testing.assert_array_equal(camera.pixels, found.pixels)
    np.testing.assert_allclose(camera.points, found.points)
    assert camera.agrees.tolist() == INLIERS
    assert [image.name for image in details.references] == list(query.references)
    second = details.references[1]
    assert second.matches.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(second.pixels, found.view_pixels[found.view_reference == 1])
    figure = draw_localization(details)
    rejected, _ = drawn(figure.axes[0])
    np.testing.assert_allclose(rejected, found.pixels[~found.agrees])
    assert figure.axes[0].get_title() == "query: 4 of 6 map points agree"
    titles = [axis.get_title() for axis in figure.axes[1:]]
    assert titles == ["reference 1: sees 4 points", "reference 2: sees 2 points"]
    rejected, agreeing = drawn(figure.axes[2])
    np.testing.assert_allclose(agreeing, second.pixels[:2])
    np.testing.assert_allclose(rejected, second.pixels[2:])


def test_a_rig_shows_the_camera_with_the_most_inliers_first(capture, open_pair):
    images = query_images(capture, "hl")
    found = some_correspondences([0, 0, 0, 1, 1, 1], [True, False, False, True, True, True])
    details = open_pair("hl", stored(images[::-1], names(capture["ios_map"], 1), [], found)).details(0)
    assert [camera.name for camera in details.cameras[:2]] == [images[-2], images[-1]]
    assert [camera.num_agreeing for camera in details.cameras[:2]] == [3, 1]
    np.testing.assert_array_equal(details.cameras[0].pixels, found.pixels[3:])
    figure = draw_localization(details)
    titles = [axis.get_title() for axis in figure.axes]
    assert titles == ["query: 3 of 3 map points agree", "reference 1: sees 3 points"]
    # Its true pose is its own, not that of the rig's first camera.
    session = capture["hl_query"]
    row = names(session, len(session)).index(images[-2])
    np.testing.assert_allclose(details.cameras[0].world_from_cam_true, session.world_from_cam([row], True)[0])
    np.testing.assert_allclose(details.cameras[0].world_from_cam, details.cameras[0].world_from_cam_true)


def test_errors_are_those_of_the_device_as_in_the_evaluation(capture, open_pair):
    pair = open_pair("hl", stored(query_images(capture, "hl"), names(capture["ios_map"], 1)))
    turn = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.zeros(3))
    vars(pair.results)["poses"] = pair.results.poses @ turn
    shown = pair.localizations
    assert shown.errors["rotation_error_deg"].item() == pytest.approx(90)
    assert shown.errors["translation_error_m"].item() == pytest.approx(0, abs=1e-9)
    assert np.linalg.norm((shown.estimated - shown.true)[0, :3, 3]) > 0.01, "the camera stands beside the rig's center"


def test_a_network_shows_consistent_and_rejected_references_and_claims_no_matches(capture, open_pair):
    images = names(capture["ios_map"], 4)
    query = stored(query_images(capture, "ios"), images[:2], images[2:])
    method = "hybrid:simulated/feed_forward"
    pair = open_pair("ios", query, method=method, num_inliers=0, references=";".join(images[:2]))
    details = pair.details(0)
    assert support_of(pair.localizations.errors.iloc[0]) == "2 consistent references"
    assert [image.name for image in details.references] == images[:2]
    assert [image.name for image in details.rejected] == images[2:]
    figure = draw_localization(details)
    assert figure.axes[0].get_title() == "query: no matches, the pose comes from the references"
    captions = [axis.get_title() for axis in figure.axes[1:]]
    assert captions == ["reference 1", "reference 2", *["rejected: contradicts the others"] * 2]
    assert not any(len(xy) for axis in figure.axes for xy in drawn(axis))


def test_a_failed_query_shows_its_matches_and_stands_at_its_first_reference(capture, open_pair):
    found = some_correspondences([0] * 4, [False] * 4)
    query = stored(query_images(capture, "ios"), ["gone.jpg", *names(capture["ios_map"], 2)], [], found)
    pair = open_pair("ios", query, status="failed: too few inliers")
    center = capture["ios_map"].world_from_cam([0])[0, :3, 3]
    np.testing.assert_allclose(pair.localizations.nearest_reference, [center])
    figure = draw_localization(pair.details(0))
    assert figure.axes[0].get_title() == "query: not localized, 4 matches"
    np.testing.assert_allclose(drawn(figure.axes[0])[0], found.pixels)
    # References keep their numbers where one is no longer in the capture.
    assert pair.details(0).references[0].matches.tolist() == [0, 2]


def test_a_query_that_the_stage_could_not_begin_has_its_images(capture, open_pair):
    pair = open_pair("ios", stored(), status="failed: no readable image")
    (camera,) = pair.details(0).cameras
    assert camera.name == query_images(capture, "ios")[0]
    assert not len(camera.pixels)


@pytest.mark.parametrize(("suffix", "why"), [("txt", " is damaged"), ("csv", " is damaged"), ("h5", "")])
def test_files_of_a_run_that_were_cut_off_or_removed_are_an_error(capture, tmp_path, suffix, why):
    stem = write_pair(capture, tmp_path, "ios", "ios", [stored(), stored()])
    poses, table, torn = (stem.with_name(f"{stem.name}.{end}") for end in ("txt", "csv", suffix))
    write_sidecar(poses, {}, [table])
    assert len(LocalizedPair.open(capture, "ios", "ios", tmp_path, None).results.table) == 2
    if suffix == "h5":
        torn.unlink()
    else:
        torn.write_text("".join(torn.read_text().splitlines(True)[:-1]))
    with pytest.raises(ArtifactError, match=rf"\.{suffix}{why}"):
        LocalizedPair.open(capture, "ios", "ios", tmp_path, None)


def test_maps_are_those_that_the_poses_were_found_with(tmp_path):
    empty = {"points": np.zeros((1, 3)), "colors": np.zeros((1, 3), np.uint8), "noise_px": np.ones(1, np.float32)}
    index = np.zeros(1, np.int64)
    local_map = LocalMap(["a"], [], np.eye(4)[None], obs_image=index, obs_keypoint=index, obs_point=index, **empty)
    h5 = tmp_path / "PLACE.v2_map_ios_query_hl.h5"
    for name in ("ios_map.npz", "ios_map-superpoint.npz", "ios_map-other.npz"):
        replace(local_map, cameras=[]).save(tmp_path / name)
    (tmp_path / "ios_map-other.npz").write_bytes(b"no map")
    assert len(map_files(tmp_path, "ios_map")) == 3
    assert map_files(None, "ios_map") == ()
    assert map_files(tmp_path, "hl_map") == ()
    write_queries(h5, {}, ["ios_map-superpoint.npz", "ios_map-gone.npz"])
    assert [path.name for path in map_files(tmp_path, "ios_map", h5)] == ["ios_map-superpoint.npz"]
    assert load_maps([tmp_path / "ios_map-other.npz"]) is None


def test_a_scene_with_a_dot_in_its_name_has_its_maps(small_capture, tmp_path):
    shutil.copytree(small_capture, tmp_path / "HGE.v2")
    capture, asked = Capture.open(tmp_path / "HGE.v2"), []
    write_pair(capture, tmp_path, "ios", "ios", [stored()], ["ios_map-other.npz"])
    for name in ("ios_map.npz", "ios_map-other.npz"):
        (tmp_path / name).touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(localized, "load_maps", asked.extend)
        LocalizedPair.open(capture, "ios", "ios", tmp_path, tmp_path)
    assert [path.name for path in asked] == ["ios_map-other.npz"]


def test_of_a_large_map_a_regular_choice_of_points_is_shown(monkeypatch):
    seen_by = np.array([3, 2, 3, 4, 3, 3, 1, 3, 3])  # images, of each point
    obs_point = np.repeat(np.arange(9), seen_by)
    obs_image = np.concatenate([np.arange(count) for count in seen_by])
    points, colors = np.arange(27.0).reshape(9, 3), np.arange(27, dtype=np.uint8).reshape(9, 3)
    poses = np.tile(np.eye(4), (4, 1, 1))
    local_map = LocalMap(list("abcd"), [], poses, points, colors, obs_image, obs_point, obs_point, np.ones(9))
    for most, shown in ((7, [0, 2, 3, 4, 5, 7, 8]), (6, [0, 3, 5, 8]), (3, [0, 4, 8])):
        monkeypatch.setattr(images, "MAX_POINTS", most)
        chosen, their_colors = sure_points(local_map)
        np.testing.assert_array_equal(chosen, points[shown])
        np.testing.assert_array_equal(their_colors, colors[shown])
