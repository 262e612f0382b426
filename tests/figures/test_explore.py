"""What notebook 01 says of a capture with sessions that cannot be used."""

import shutil
from pathlib import Path

import numpy as np

from tests.test_embed import write_tiny_capture
from toolkit.capture import Capture, Trajectory
from toolkit.figures.explore import (
    describe,
    draw_samples,
    draw_statuses,
    draw_top_view,
    list_poses,
    list_unsure,
)


def test_unusable_sessions_have_a_reason_and_the_others_are_drawn(tmp_path: Path) -> None:
    sessions = write_tiny_capture(tmp_path / "TINY") / "sessions"
    (sessions / "hl_query" / "images.txt").write_text("a line\n")
    (sessions / "hl_map" / "trajectories.txt").unlink()
    (sessions / "ios_query" / "proc" / "keyframes_pruned_subsampled.txt").unlink()
    capture = Capture.open(tmp_path / "TINY")
    table = describe(capture)
    assert "line 1" in table["reason"]["hl_query"]
    assert table["reason"]["hl_map"] == "a map without poses"
    assert "keyframe list" in table["reason"]["ios_query"]
    assert table["reason"]["ios_map"] == ""
    assert table["images"]["hl_query"] == 0
    samples = draw_samples(capture, 1).axes
    assert [axis.get_title("left") for axis in samples] == ["hl_map", "ios_map", "ios_query"]
    assert "[m]" in draw_top_view(capture).axes[0].get_xlabel()
    assert "[" not in draw_top_view(capture, unit=None).axes[0].get_xlabel()


def test_a_capture_without_a_usable_session_says_so(tmp_path: Path) -> None:
    sessions = write_tiny_capture(tmp_path / "TINY") / "sessions"
    for session in sessions.iterdir():
        (session / "images.txt").write_text("a line\n")
    capture = Capture.open(tmp_path / "TINY")
    assert describe(capture)["reason"].str.contains("line 1").all()
    for figure in (draw_samples(capture), draw_top_view(capture)):
        assert "can be used" in figure.texts[0].get_text()


def test_odometry_and_radio_are_told(small_capture: Path, tmp_path: Path) -> None:
    table = describe(Capture.open(small_capture))
    assert table["odometry"]["ios_map"] == table["radio"]["ios_query"] == ""
    assert table["odometry"]["ios_query"] == "3 poses, 2 s, 2 pieces"
    shutil.copytree(small_capture, tmp_path / "C")
    session = tmp_path / "C/sessions/ios_query"
    (session / "bt.txt").touch()
    (session / "trajectories.txt").unlink()
    table = describe(Capture.open(tmp_path / "C"))
    assert (table["odometry"]["ios_query"], table["radio"]["ios_query"]) == ("", "bt")


def test_queries_without_inliers_are_at_the_left_edge(tmp_path: Path) -> None:
    path = tmp_path / "PLACE_map_ios_query_hl.csv"
    path.write_text("timestamp,device_id,status,num_inliers\n1,hl,low_confidence,0\n2,hl,ok,40\n")
    (plot,) = draw_statuses([path]).axes
    assert plot.get_xlim()[0] == 0.5 == min(x for dots in plot.collections for x, _ in dots.get_offsets())
    assert [label.get_text() for label in plot.get_yticklabels()] == ["hl in ios map"]


def test_unsure_queries_are_listed_with_their_reasons(tmp_path: Path) -> None:
    paths = [tmp_path / f"PLACE_map_ios_query_{device}.csv" for device in ("hl", "ios")]
    paths[0].write_text("timestamp,device_id,status,num_inliers\n1,hl,ok,40\n2,hl,failed: too few inliers (3: no),3\n")
    paths[1].write_text("timestamp,device_id,status,num_inliers\n1,ios,ok,40\n")
    (row,) = list_unsure(paths).to_dict("records")
    assert (row["pair"], row["status"], row["num_inliers"]) == ("hl in ios", "failed: too few inliers (3: no)", 3)
    Trajectory.from_poses([1], ["hl"], np.eye(4)[None]).write(paths[0].with_suffix(".txt"))
    assert list(list_poses(paths[0])["status"]) == ["ok", "failed: too few inliers (3: no)"]


def test_a_session_without_poses_is_not_in_the_legend(small_capture: Path, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    for truth in (capture / "sessions" / "ios_query").rglob("*trajector*"):
        truth.unlink()
    (legend,) = draw_top_view(Capture.open(capture)).legends
    names = [text.get_text() for text in legend.get_texts()]
    assert "hl_query" in names
    assert "ios_query" not in names
