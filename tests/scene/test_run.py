"""A run in the hand."""

from pathlib import Path

import pandas as pd
import pytest

from toolkit.errors import ArtifactError
from toolkit.files import SceneFiles
from toolkit.scene import Run


def test_a_run_has_its_settings_maps_and_queries(small_run: Path) -> None:
    run = Run.open(small_run)
    assert run.scenes == ["SMALL"]
    assert run.settings["name"] == small_run.name
    queries = run.queries
    poses = SceneFiles(small_run, "SMALL").poses_dir
    tables = {path.stem: pd.read_csv(path) for path in poses.glob("*_query_??*.csv") if "_sequence" not in path.stem}
    assert len(queries) == sum(map(len, tables.values()))
    (device, *_) = queries["map_device"]
    assert run.map(device).device == device
    of_device = queries[queries["map_device"] == device]
    assert set(of_device["status"]) == set(
        pd.concat([table for stem, table in tables.items() if f"_map_{device}_query_" in stem])["status"]
    )


def test_what_is_no_run_names_those_beside_it(small_run: Path) -> None:
    with pytest.raises(ArtifactError, match=small_run.name):
        Run.open(small_run.with_name(small_run.name[:-1]))
    with pytest.raises(ArtifactError, match="SMALL"):
        Run.open(small_run).map("ios", "OTHER")
