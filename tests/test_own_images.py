"""Notebook 00, which is no stage: clean as committed, and it runs."""

import json
import re
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pandas as pd
import PIL.Image
import pytest

from toolkit.capture import Session, Trajectory
from toolkit.errors import CaptureError, ManifestError, StageError
from toolkit.exchange.interchange import import_images, import_once
from toolkit.figures.explore import list_poses
from toolkit.geometry import make_pose
from toolkit.notebook import NOTEBOOKS, check_values, notebook_parameters, own_folder
from toolkit.pipeline import execute

PATH = NOTEBOOKS / "00_own_images.ipynb"


def test_it_is_committed_clean() -> None:
    content = nbformat.read(PATH, as_version=4)
    nbformat.validate(content)
    code = [cell for cell in content.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
    assert content.cells[0].source.startswith("# ")
    assert "notebook.finish(" in content.cells[-1].source
    assert all(len(cell.source.splitlines()) <= 18 for cell in code)
    assert [cell.id for cell in content.cells] == [f"00-{i:02d}" for i in range(len(content.cells))]
    parameters = [line for line in content.cells[1].source.splitlines() if line and not line.startswith("# ")]
    assert all("  # " in line for line in parameters)
    assert "notebook.check_given(" in content.cells[2].source
    assert notebook_parameters(PATH)["poses_are"] == "world_from_cam"


def test_results_are_beside_the_pictures(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    assert own_folder(None, "own-images", str(photos)) == tmp_path / "photos-localized"
    assert own_folder(str(tmp_path / "there"), "own-images", str(photos)) == tmp_path / "there"
    assert own_folder(None, "own-images") == NOTEBOOKS.parent / "data" / "own-images"


def test_other_input_is_named_and_never_gets_an_earlier_result(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        PIL.Image.new("RGB", (64, 48)).save(tmp_path / name / "1.jpg")
    camera, place = "SIMPLE_PINHOLE, 64, 48, 50, 32, 24", tmp_path / "PLACE"

    def again(folder: Path, **options: Any) -> str:
        return import_once(folder, place, "ios", "query", **{"table": None, "camera": camera} | options)

    assert "used of 1 in" in again(tmp_path / "a")
    session = place / "sessions" / "ios_query"
    before = session.stat().st_mtime_ns
    assert again(tmp_path / "a") == f"{session}: imported before from the same input, kept"
    table = tmp_path / "table.csv"
    table.write_text("image\n1.jpg\n")
    for options, named in (
        ({"folder": tmp_path / "b"}, f"images: then '{tmp_path / 'a'}', now '{tmp_path / 'b'}'"),
        ({"camera": None}, f"camera: then '{camera}', now None"),
        ({"table": table}, f"table: then None, now '{table}'"),
    ):
        with pytest.raises(CaptureError, match=f"^{session} was imported from other input .*{re.escape(named)}"):
            again(**{"folder": tmp_path / "a"} | options)
    PIL.Image.new("RGB", (64, 48)).save(tmp_path / "a" / "2.jpg")
    for folder, named in (("a", "files of images: have changed"), ("none", "^query_images: .*no image")):
        with pytest.raises(CaptureError, match=named):
            again(tmp_path / folder)
    assert session.stat().st_mtime_ns == before


def test_a_camera_given_for_others_changes_nothing(tmp_path: Path) -> None:
    """As for a map whose table has cameras, where the queries turn out to need `camera`."""
    (tmp_path / "a").mkdir()
    PIL.Image.new("RGB", (64, 48)).save(tmp_path / "a" / "1.jpg")
    camera, other = "SIMPLE_PINHOLE, 64, 48, 50, 32, 24", "SIMPLE_PINHOLE, 64, 48, 60, 32, 24"
    with_model, with_id, listed = tmp_path / "model.csv", tmp_path / "id.csv", tmp_path / "cameras.txt"
    with_model.write_text("image,model,width,height,params\n1.jpg,SIMPLE_PINHOLE,64,48,50 32 24\n")
    with_id.write_text("image,camera_id\n1.jpg,1\n")
    listed.write_text("1 SIMPLE_PINHOLE 64 48 50 32 24\n")
    for number, options in enumerate(({"table": with_model}, {"table": with_id, "cameras": listed})):
        place = tmp_path / f"PLACE_{number}"
        for given in (None, camera, other):
            said = import_once(tmp_path / "a", place, "ios", "query", **options, camera=given)
            assert ("used of 1 in" if given is None else "kept") in said
        session = Session.open(place / "sessions" / "ios_query")
        assert session.camera(str(session.images["sensor_id"].iloc[0])).params.tolist() == [50, 32, 24]


def test_a_transforms_json_is_taken_as_a_table(tmp_path: Path) -> None:
    place, images, file = tmp_path / "PLACE", tmp_path / "a", tmp_path / "a" / "transforms.json"
    images.mkdir()
    PIL.Image.new("RGB", (64, 48)).save(images / "1.jpg")
    frame = {"file_path": "1.jpg", "transform_matrix": np.diag([1, -1, -1, 1]).tolist()}
    file.write_text(json.dumps({"fl_x": 50, "frames": [frame]}))
    for said in ("used of 1 in", "imported before from the same input, kept"):
        assert said in import_once(images, place, "ios", "map", table=file, unit_m=None, camera="of the queries")
    session = Session.open(place / "sessions" / "ios_map")
    assert session.camera("import/cam_1").params.tolist() == [50, 50, 32, 24]
    np.testing.assert_array_equal(session.world_from_cam()[0], np.eye(4))
    assert json.loads((session.path / "proc" / "import.json").read_text())["unit"] is None
    for take, folder, device, split, options, error, named in (
        (import_once, images, "ios", "map", {"table": file, "unit_m": 2.0}, CaptureError, "unit_m: then None, now 2"),
        (import_once, tmp_path, "ios", "query", {"table": file}, ManifestError,
         "query_images: found .*, expected the folder of .*transforms.json"),
        (import_once, images, "ios", "query", {"table": file, "poses_are": "cam_from_world"}, ManifestError,
         "poses_are: found 'cam_from_world', expected world_from_cam"),
        (import_images, images, "ios", "query", {"table": file}, CaptureError,
         "not a CSV table. .* visloc import transforms"),
        (import_images, images, "hl", "map", {}, CaptureError,
         "A map needs poses: .*, or import a transforms.json or a COLMAP model"),
    ):  # fmt: skip
        with pytest.raises(error, match=named):
            take(folder, place, device, split, **options)


def test_poses_are_listed_with_the_names_of_images(tmp_path: Path) -> None:
    pose = make_pose(np.eye(3), [1.0, 2.0, 3.0])
    Trajectory.from_poses([1], ["import/cam_1"], pose[None]).write(tmp_path / "pair.txt")
    rows = {"timestamp": [1, 2], "device_id": "import/cam_1", "image": ["1.jpg", "2.jpg"]}
    rows["status"] = ["ok", f"failed: no readable image ({tmp_path}/{'long/' * 20}2.jpg)"]
    pd.DataFrame(rows).to_csv(tmp_path / "pair.csv", index=False)
    table = list_poses(tmp_path / "pair.csv")
    assert list(table.columns) == ["image", "status", "qw", "qx", "qy", "qz", "tx", "ty", "tz"]
    assert table.iloc[0].tolist() == ["1.jpg", "ok", 1, 0, 0, 0, 1, 2, 3]
    assert table.iloc[1][["tx", "qw"]].isna().all()
    assert table["status"][1] == "failed: no readable image", "paths pushed the poses out of the page"


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"map_table": "HERE"}, "map_table: found .*, which has no effect without map_images"),
        ({"query_table": "HERE", "photographs": "HERE"}, "query_table: .* no effect without query_images"),
        ({"camera": "PINHOLE, 1, 1"}, "camera: .* no effect without"),
        ({"unit_m": None, "photographs": "HERE"}, "unit_m: found None, which has no effect without"),
        ({"hold_out": 4}, "hold_out: .* no effect without photographs"),
        ({"hold_out": 4, "photographs": "HERE", "query_images": "HERE"}, "hold_out: .* no effect with query_images"),
        ({"hold_out": 1, "photographs": "HERE"}, "hold_out: found 1, expected 2"),
        ({"photographs": "HERE", "map_images": "HERE"}, "photographs: .* no effect with map_images"),
        ({"sessions_root": "HERE", "photographs": "HERE"}, "sessions_root: .* no effect with photographs"),
        ({"run": "runs/fox", "photographs": "HERE"}, "run: found 'runs/fox', which has no effect with photographs"),
        ({"run": "runs/fox", "sessions_root": "HERE"}, "run: .* no effect with sessions_root"),
        ({"map_images": "HERE/none", "map_table": "HERE"}, "map_images: found '.*/none', which does not exist"),
        ({"map_images": "HERE", "query_images": "HERE"}, "map_table: found None, but a map needs poses"),
        ({"map_images": "HERE", "map_table": "HERE"}, "query_images: found None"),
        ({"query_images": "HERE"}, "map_images: found None"),
    ],
)
def test_a_parameter_without_effect_is_refused_by_its_name(given: dict[str, Any], named: str, tmp_path: Path) -> None:
    values = {name: str(value).replace("HERE", str(tmp_path)) if isinstance(value, str) else value
              for name, value in given.items()}  # fmt: skip
    with pytest.raises(ManifestError, match=f"^{named}"):
        check_values("own_images", notebook_parameters(PATH) | values)
    check_values("own_images", notebook_parameters(PATH) | {"photographs": str(tmp_path), "hold_out": 4})


@pytest.mark.slow
def test_photographs_without_poses_become_map_and_queries(small_capture: Path, tmp_path: Path) -> None:
    photographs, session = tmp_path / "photographs", Session.open(small_capture / "sessions" / "ios_map")
    photographs.mkdir()
    for row in range(6):
        (photographs / session.image_path(row).name).symlink_to(session.image_path(row))
    given = {"photographs": str(photographs), "hold_out": 4}
    for said in ("6 of 6 photographs in the model", "imported before from the same input, kept"):
        execute(PATH, tmp_path / "out.ipynb", given)
        assert said in (tmp_path / "out.ipynb").read_text()
    assert "there and back: 5 images" in (tmp_path / "out.ipynb").read_text()
    with pytest.raises(StageError, match="hold_out: then 4, now 3"):
        execute(PATH, tmp_path / "out.ipynb", given | {"hold_out": 3})


@pytest.mark.slow
def test_it_runs_again_and_stops_where_the_input_is_another(
    small_run: Path, small_capture: Path, tmp_path: Path
) -> None:
    folders = {"run": str(small_run), "out_dir": str(tmp_path / "OWN")}
    for _ in range(2):
        execute(PATH, tmp_path / "out.ipynb", folders)
        page = (tmp_path / "out.ipynb").read_text()
        moved = re.search(r"there and back: 6 images, at most (\S+) m and (\S+) degrees", page)
        assert moved is not None
        assert float(moved[1]) < 1e-9
        assert float(moved[2]) < 1e-9
        assert "OWN_map_ios_query_ios.txt" in page
    assert "imported before from the same input, kept" in page
    table = str(next((tmp_path / "OWN").rglob("map.csv")))
    photos = str(small_capture / "sessions" / "ios_map" / "raw_data")
    other = {"out_dir": folders["out_dir"], "map_images": photos, "map_table": table, "query_images": photos}
    with pytest.raises(StageError, match=r"ios_query was imported from other input \(images: then "):
        execute(PATH, tmp_path / "other.ipynb", other)
