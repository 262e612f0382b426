"""A run in the hand."""

from pathlib import Path

import pandas as pd
import pytest

from toolkit.errors import ArtifactError
from toolkit.files import SceneFiles
from toolkit.scene import Run


@pytest.mark.slow
def test_a_run_has_its_settings_maps_and_queries(small_run: Path, released_weights: None) -> None:
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
    row = of_device.iloc[-1]
    name, *others = row["image"].split(";")
    query = run[name]
    folder = run.map(device).capture[f"{row['query_device']}_query"].path / "raw_data"
    assert {view.image for view in query.views} == {folder / image for image in (name, *others)}
    assert run.map(device).locate(query).status == row["status"].partition(":")[0]
    with pytest.raises(ArtifactError, match=r"no query has an image 'nowhere.jpg'"):
        run["nowhere.jpg"]


def test_what_is_no_run_names_those_beside_it(tmp_path: Path) -> None:
    for name in ("fox", "castle"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text("{}")
    with pytest.raises(ArtifactError, match="fox"):
        Run.open(tmp_path / "fos")
    run = Run.open(tmp_path / "fox")
    assert run.queries.empty
    with pytest.raises(ArtifactError, match="found the scenes none"):
        run.map("ios")
