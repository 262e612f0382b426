"""What notebook 01 says of a capture with sessions that cannot be used."""

from pathlib import Path

from tests.test_embed import write_tiny_capture
from toolkit.capture import Capture
from toolkit.show.explore import describe, draw_samples, draw_top_view


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
    assert len(draw_samples(capture, 1).axes) == 3
    assert "[m]" in draw_top_view(capture).axes[0].get_xlabel()
    assert "[" not in draw_top_view(capture, unit=None).axes[0].get_xlabel()
