"""The visualize stage on poses written by hand: what goes to drawing is what was localized, the worst first."""

import shutil

import h5py
import numpy as np
import pytest

from tests.localized import instants, some_correspondences, stored, write_pair
from toolkit import visualize
from toolkit.capture import Capture
from toolkit.errors import ArtifactError, CaptureError
from toolkit.figures.style import new_figure
from toolkit.geometry import pose_error
from toolkit.results.pair import query_group
from toolkit.visualize import sample_pictures, visualize_scene

QUICK = {"session_recordings": False, "matched_queries": 2}


@pytest.fixture
def drawn(monkeypatch):
    """What the stage gives to draw: the samples, the worst, and the details in recordings."""
    given = {"samples": [], "worst": [], "recorded": [], "clouds": []}

    def draw(kind, queries):
        given[kind].extend(queries)
        figure = new_figure(1, 1)
        figure.subplots()
        return figure

    monkeypatch.setattr(visualize, "draw_localization", lambda query, *_: draw("samples", [query]))
    monkeypatch.setattr(visualize, "draw_worst", lambda queries, *_: draw("worst", queries))

    def record(out, name, poses, points, colors, queries, details, **_):
        given["clouds"].append(points)
        given["recorded"].append(dict(details))

    monkeypatch.setattr(visualize, "record_localizations", record)
    return given


def queries_of(capture, device, count):
    """Return queries of a device, each with some more matches than the one before."""
    session, image = capture[f"{device}_query"], capture["ios_map"].image_name(0)
    rows = session.rows_of_keyframes(instants(session)[:count])
    found = [some_correspondences([0] * (k + 2), [True] * (k + 1) + [False], references=1) for k in range(count)]
    return [stored([session.image_name(rows[k][0])], [image], [], found[k]) for k in range(count)]


def test_the_worst_come_first_by_error_and_pictures_show_their_own_inliers(small_capture, drawn, tmp_path):
    capture = Capture.open(small_capture)
    queries = queries_of(capture, "ios", 3)
    write_pair(capture, tmp_path, "ios", "ios", queries, off_m=[0.0, 0.3, 0.1], num_inliers=[1, 2, 3])
    write_pair(capture, tmp_path, "ios", "hl", queries_of(capture, "hl", 1), off_m=[0.2])
    table = visualize_scene(small_capture / "sessions", tmp_path, tmp_path, tmp_path / "out", QUICK)
    assert table[["map_device", "query_device", "queries", "localized"]].to_numpy().tolist() == [
        ["ios", "ios", 3, 3],
        ["ios", "hl", 1, 1],
    ]
    cameras = [details.cameras[0] for _, details in drawn["worst"]]
    worst = [round(float(pose_error(one.world_from_cam, one.world_from_cam_true)[1]), 6) for one in cameras]
    assert worst == [0.3, 0.2, 0.1, 0.0]
    pairs = [caption.partition(": off by ")[0] for caption, _ in drawn["worst"]]
    assert pairs == [f"{device} in the ios map" for device in ("ios", "hl", "ios", "ios")]
    assert drawn["worst"][0][0].endswith("°, 30 cm; ok, 2 inliers")
    np.testing.assert_array_equal(cameras[0].pixels, queries[1].correspondences.pixels)
    assert [query.cameras[0].num_agreeing for query in drawn["samples"]] == [2, 1, 1]
    assert sorted(drawn["recorded"][0]) == [1, 2]
    np.testing.assert_allclose(drawn["recorded"][0][2].cameras[0].points, queries[2].correspondences.points)
    assert all((tmp_path / "out").joinpath(path).is_file() for path in table["still"])


def test_without_truth_the_weakest_are_shown_not_the_strongest(small_capture, drawn, tmp_path):
    shutil.copytree(small_capture, tmp_path / "SMALL")
    for name in ("trajectories.txt", "proc/alignment_trajectories.txt"):
        (tmp_path / "SMALL" / "sessions" / "ios_query" / name).unlink(missing_ok=True)
    capture = Capture.open(tmp_path / "SMALL")
    poses = tmp_path / "poses"
    poses.mkdir()
    write_pair(
        capture, poses, "ios", "ios", queries_of(capture, "ios", 3),
        status=["ok", "failed: too few inliers", "low_confidence"], num_inliers=[593, 3, 20], num_matches=[900, 9, 30],
    )  # fmt: skip
    visualize_scene(tmp_path / "SMALL" / "sessions", poses, None, tmp_path / "out", QUICK)
    captions, failed = [caption for caption, _ in drawn["worst"]], "failed: too few inliers, 9 matches, 3 inliers"
    reasons = [failed, "low_confidence, 30 matches, 20 inliers", "ok, 900 matches, 593 inliers"]
    assert captions == [f"ios in the ios map: {reason}" for reason in reasons]
    assert sorted(drawn["recorded"][0]) == [1, 2]


def test_only_the_pairs_asked_for_and_none_without_poses(small_capture, drawn, tmp_path):
    capture = Capture.open(small_capture)
    for device, error, named in (("all", ArtifactError, "Localize"), ("drone", CaptureError, "drone")):
        with pytest.raises(error, match=named):
            visualize_scene(small_capture / "sessions", tmp_path, None, tmp_path / "out", QUICK, map_device=device)
    for device in ("ios", "hl"):
        write_pair(capture, tmp_path, "ios", device, queries_of(capture, device, 1))
    pairs = [["ios", "hl"], ["hl", "hl"]]
    table = visualize_scene(small_capture / "sessions", tmp_path, None, tmp_path / "out", QUICK, pairs=pairs)
    assert table["query_device"].tolist() == ["hl"]


def test_a_pair_that_was_left_out_has_its_reason_and_no_pictures(small_capture, drawn, tmp_path):
    capture, out = Capture.open(small_capture), tmp_path / "out"
    write_pair(capture, tmp_path, "ios", "ios", queries_of(capture, "ios", 1))
    (tmp_path / "SMALL_map_ios_query_hl.left_out.json").write_text('{"reason": "a dragon"}')
    out.mkdir()
    stale = [out / "SMALL_map_ios_query_hl.png", out / "localization_SMALL_map_ios_query_hl_1.png"]
    for path in stale:
        path.touch()
    table = visualize_scene(small_capture / "sessions", tmp_path, None, out, QUICK, map_device="ios")
    assert table.set_index("query_device")["reason"].to_dict() == {"ios": "", "hl": "a dragon"}
    assert not any(path.exists() for path in stale)
    with pytest.raises(ArtifactError):
        visualize_scene(small_capture / "sessions", tmp_path, None, out, QUICK, map_device="ios", query_device="hl")
    assert not (out / "worst_SMALL.png").exists(), "it was of the run before"


def test_a_pair_with_a_damaged_query_is_left_out_with_the_reason(small_capture, drawn, tmp_path):
    capture = Capture.open(small_capture)
    for device in ("ios", "hl"):
        stem = write_pair(capture, tmp_path, "ios", device, queries_of(capture, device, 1))
    with h5py.File(f"{stem}.h5", "a") as file:
        del file[query_group(*instants(capture["hl_query"]).iloc[0])]["points"]
    table = visualize_scene(small_capture / "sessions", tmp_path, None, tmp_path / "out", QUICK)
    reasons = table.set_index("query_device")["reason"]
    assert reasons["ios"] == ""
    assert f"{stem.name}.h5" in reasons["hl"]


def test_pictures_of_an_earlier_run_go(small_capture, drawn, tmp_path):
    """Also those with a larger number and the recordings; those of pairs that were not asked for stay."""
    capture, out = Capture.open(small_capture), tmp_path / "out"
    write_pair(capture, tmp_path, "ios", "ios", queries_of(capture, "ios", 3))
    out.mkdir()
    name = "SMALL_map_ios_query_ios"
    other = f"localization_{name}_2_1.png"
    stale = [f"localization_{name}_3.png", f"{name}.rrd", f"{name}_sequence.png", "SMALL_ios_map.rrd"]
    for path in (*stale, other, f"localization_{name}_12.png"):
        (out / path).touch()
    assert [path.stem.rpartition("_")[2] for path in sample_pictures(out, name)] == ["3", "12"]
    settings = QUICK | {"samples": 2, "recordings": False}
    visualize_scene(small_capture / "sessions", tmp_path, None, out, settings, pairs=[["ios", "ios"]])
    assert [path.stem.rpartition("_")[2] for path in sample_pictures(out, name)] == ["1", "2"]
    assert [path for path in stale if (out / path).exists()] == []
    assert (out / other).exists(), "of a device called ios_2"


def test_a_recording_of_keyframes_has_those_of_the_list_and_is_thinned_by_their_number(
    small_capture, drawn, monkeypatch, tmp_path
):
    shutil.copytree(small_capture, tmp_path / "SMALL")
    session = tmp_path / "SMALL" / "sessions" / "hl_query"
    (session / "proc" / "keyframes_pruned_subsampled.txt").rename(session / "queries.txt")
    capture = Capture.open(tmp_path / "SMALL")
    listed = sum(map(len, capture["hl_query"].rows_of_keyframes(capture["hl_query"].keyframes("queries"))))
    assert 0 < listed + 1 <= len(capture["hl_query"].images)
    write_pair(capture, tmp_path, "hl", "hl", queries_of(capture, "hl", 1))
    recorded = []
    monkeypatch.setattr(visualize, "record_session", lambda *_, **options: recorded.append(options))
    monkeypatch.setattr(visualize, "MAX_FRAMES", listed + 1)
    settings = {"keyframes_only": True, "samples": 0, "recordings": False}
    visualize_scene(capture.path / "sessions", tmp_path, None, tmp_path / "out", settings, queries="queries")
    assert [(one["keyframes_only"], one["queries"]) for one in recorded] == [(False, "queries"), (True, "queries")]
    assert recorded[1]["every"] == 1
