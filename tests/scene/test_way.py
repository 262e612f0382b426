"""The way of an image from `Map.locate` to its pose stays short enough to read."""

from pathlib import Path

import pytest

from benchmarks.way import way_of
from toolkit.pose.base import Status
from toolkit.scene import Run

FILES, LINES = 10, 1600


@pytest.mark.slow
def test_a_sure_image_in_an_open_map_enters_few_files_and_lines(small_run: Path, released_weights: None) -> None:
    scene_map = Run.open(small_run).map("ios")
    session = scene_map.capture["ios_query"]
    keyframes = session.rows_of_keyframes(session.keyframes("all"))
    results = [scene_map.locate(scene_map.query_of_session(session, rows)) for rows in keyframes]  # opens files, too
    sure = [result.status is Status.OK and result.first_status is None for result in results].index(True)
    way = way_of(scene_map, scene_map.query_of_session(session, keyframes[sure]))
    counts = {name: count for name, (count, _) in way.items()}
    print(f"{sum(counts.values())} lines in {len(counts)} files: {counts}")
    assert {"scene/map.py", "features/features.py", "pose/pnp.py", "capture/images.py"} <= counts.keys()
    assert len(counts) <= FILES, counts
    assert sum(counts.values()) <= LINES, counts
