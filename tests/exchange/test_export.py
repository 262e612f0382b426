"""Export: the map as COLMAP reads it, retrieval as hloc reads it; and back."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from toolkit.__main__ import app
from toolkit.capture import Capture, Session
from toolkit.errors import ArtifactError, ManifestError
from toolkit.exchange.export import export_colmap, export_pairs, export_table
from toolkit.exchange.interchange import import_colmap, import_images
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import SceneFiles, pair_name
from toolkit.localizers.correspondences import MAPS
from toolkit.localizers.local_map import LocalMap
from toolkit.localizers.mapping import build_map


def write_localization(files: SceneFiles, map_device: str, query_device: str, maps: list[str]) -> None:
    """Write what the localize stage says of the maps that a pair was localized in."""
    files.poses_dir.mkdir(parents=True, exist_ok=True)
    with h5py.File(files.poses_dir / f"{pair_name(files.scene, map_device, query_device)}.h5", "w") as file:
        file.attrs[MAPS] = json.dumps(maps)


@pytest.fixture(scope="module")
def run(small_capture: Path, small_features: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    """A run that has built the headset's map; do not write to it."""
    files = SceneFiles(tmp_path_factory.mktemp("run"), small_capture.name)
    session = Capture.open(small_capture)["hl_map"]
    shutil.copytree(small_features, files.features)
    store = extract_session(session, files.features, workers=1, progress=False)
    build_map(session, store, files.maps / "hl_map.npz")
    write_localization(files, "hl", "hl", [])  # `nearest` uses no map
    write_localization(files, "hl", "ios", ["hl_map.npz"])
    return files


@pytest.fixture(scope="module")
def model(run: SceneFiles, small_capture: Path) -> Path:
    export_colmap(run.run, run.scene, "hl", run.run / "model", small_capture)
    return run.run / "model"


def session_of(capture: Path) -> Session:
    return Capture.open(capture)["hl_map"]


def test_the_model_has_the_poses_and_cameras_of_the_capture(model: Path, small_capture: Path) -> None:
    read, session = pycolmap.Reconstruction(str(model)), session_of(small_capture)
    assert read.is_valid()
    assert read.num_images() == read.num_reg_images() == len(session)
    for row, world_from_cam in enumerate(session.world_from_cam()):
        image = read.find_image_with_name(session.image_name(row))
        np.testing.assert_allclose(image.projection_center(), world_from_cam[:3, 3], rtol=0, atol=1e-9)
        rotation = image.cam_from_world().rotation.matrix()
        np.testing.assert_allclose(rotation, world_from_cam[:3, :3].T, rtol=0, atol=1e-12)
        camera = session.camera(session.images["sensor_id"].iloc[row])
        assert (image.camera.model, image.camera.params.tolist()) == (camera.model, camera.params.tolist())


def test_rigs_that_are_made_anew_for_each_frame_are_one(model: Path, small_capture: Path) -> None:
    read, session = pycolmap.Reconstruction(str(model)), session_of(small_capture)
    assert session.rigs is not None
    assert session.rigs["rig_id"].nunique() == read.num_frames() == 6
    assert sorted(rig.num_sensors() for rig in read.rigs.values()) == [2, 2]  # one a recording
    assert read.num_cameras() == session.images["sensor_id"].nunique() == 4


def test_points_have_their_tracks_colors_and_pixels(model: Path, run: SceneFiles) -> None:
    read, local_map = pycolmap.Reconstruction(str(model)), LocalMap.load(run.maps / "hl_map.npz")
    store = FeatureStore.of_session(run.features, "hl_map")
    assert read.num_points3D() == len(local_map.points) > 100
    assert read.compute_num_observations() == len(local_map.obs_point)
    points = [read.points3D[key] for key in sorted(read.points3D)]
    np.testing.assert_array_equal([point.xyz for point in points], local_map.points)
    np.testing.assert_array_equal([point.color for point in points], local_map.colors)
    np.testing.assert_array_equal([point.track.length() for point in points], np.diff(local_map.point_starts))
    for index, name in enumerate(local_map.image_names):
        image = read.find_image_with_name(name)
        np.testing.assert_array_equal([p.xy for p in image.points2D], store[name].keypoints.astype(float))
        keypoints, seen = local_map.observations(index)
        assert [image.points2D[int(k)].has_point3D() for k in keypoints] == [True] * len(seen)
    # Half a pixel off would be half a pixel more: pixels are COLMAP's.
    assert read.compute_mean_reprojection_error() < 0.8


def test_the_map_is_that_of_the_features_that_the_run_localized_with(
    run: SceneFiles, small_capture: Path, tmp_path: Path
) -> None:
    """A run with SuperPoint has no `hl_map.npz`; one with two kinds of features has two maps."""
    local_map = LocalMap.load(run.maps / "hl_map.npz")
    (features,) = (run.features / "hl_map").glob("sift-*.h5")
    store, names = FeatureStore.open(features), local_map.image_names
    files = SceneFiles(tmp_path / "run", run.scene)
    for kind in ("sift", "superpoint"):
        copy = files.features / "hl_map" / features.name.replace("sift", kind)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(features, copy)
    replace(local_map, points=local_map.points + 1).save(files.maps / "hl_map-superpoint.npz")
    write_localization(files, "hl", "spot", ["hl_map-superpoint.npz"])
    one = export_colmap(files.run, files.scene, "hl", tmp_path / "one", small_capture)
    np.testing.assert_array_equal([one.points3D[key].xyz for key in sorted(one.points3D)], local_map.points + 1)
    local_map.save(files.maps / "hl_map.npz")
    write_localization(files, "hl", "spot", ["hl_map.npz", "hl_map-superpoint.npz"])
    both = export_colmap(files.run, files.scene, "hl", tmp_path / "both", small_capture)
    points = [both.points3D[key].xyz for key in sorted(both.points3D)]
    np.testing.assert_array_equal(points, np.concatenate([local_map.points, local_map.points + 1]))
    for index, name in enumerate(names):
        image, count = both.find_image_with_name(name), len(store[name].keypoints)
        np.testing.assert_array_equal([p.xy for p in image.points2D[count:]], store[name].keypoints.astype(float))
        seen = np.flatnonzero([p.has_point3D() for p in image.points2D])
        keypoints = np.unique(local_map.observations(index)[0])
        np.testing.assert_array_equal(seen, np.concatenate([keypoints, keypoints + count]))
    shutil.copyfile(features, copy.with_name("superpoint-0.h5"))  # of other settings
    with pytest.raises(ArtifactError, match="2 files of superpoint features"):
        export_colmap(files.run, files.scene, "hl", tmp_path / "third", small_capture)


def test_there_and_back_again(model: Path, small_capture: Path, tmp_path: Path) -> None:
    import_colmap(model, small_capture / "sessions", tmp_path / "BACK", "hl")
    back, session = session_of(tmp_path / "BACK"), session_of(small_capture)
    places = dict(zip(back.images["path"], back.world_from_cam(), strict=True))
    for row, world_from_cam in enumerate(session.world_from_cam()):
        found = places[f"import/images/{session.image_name(row)}"]
        np.testing.assert_allclose(found, world_from_cam, rtol=0, atol=1e-9)
    assert sorted(np.unique(back.device_ids, return_counts=True)[1]) == [6, 6]


def test_nothing_is_overwritten_and_what_is_missing_is_named(
    model: Path, run: SceneFiles, small_capture: Path, tmp_path: Path
) -> None:
    with pytest.raises(ManifestError, match="model: "):
        export_colmap(run.run, run.scene, "hl", model, small_capture)
    with pytest.raises(ManifestError, match="--capture PATH/SMALL"):
        export_colmap(run.run, run.scene, "hl", tmp_path / "model")
    with pytest.raises(ArtifactError, match=r"toolkit run MANIFEST --only localize"):
        export_colmap(run.run, run.scene, "ios", tmp_path / "model", small_capture)
    changed = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    images = changed / "sessions" / "hl_map" / "images.txt"
    images.write_text("\n".join(images.read_text().splitlines()[:-1]) + "\n")
    with pytest.raises(ArtifactError, match=r"hl_map: image hl_map/raw_data/"):
        export_colmap(run.run, run.scene, "hl", tmp_path / "model", changed)
    assert not (tmp_path / "model").exists()


def test_retrieval_becomes_a_list_of_pairs(tmp_path: Path) -> None:
    files = SceneFiles(tmp_path, "PLACE")
    files.retrieval_dir.mkdir(parents=True)
    row = {
        "path": "PLACE/sessions/hl_query/raw_data/s/1.jpg",
        "timestamp": "1",
        "sensor_id": "s/hetlf",
        "topk": [{"path": f"PLACE/sessions/ios_map/raw_data/s/{i}.jpg"} for i in (7, 5, 6)],
    }
    path = files.retrieval("ios", "hl")
    path.write_text(json.dumps(row) + "\n" + json.dumps(row | {"topk": []}) + "\n")
    assert export_pairs(tmp_path, "PLACE", "ios", "hl", tmp_path / "pairs.txt") == 3
    lines = [f"hl_query/raw_data/s/1.jpg ios_map/raw_data/s/{i}.jpg\n" for i in (7, 5, 6)]
    assert (tmp_path / "pairs.txt").read_text() == "".join(lines)
    command = ["export", "pairs", str(tmp_path), "PLACE", "ios", "hl", str(tmp_path / "p.txt"), "--topk", "1"]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert (tmp_path / "p.txt").read_text() == lines[0]
    path.write_text(json.dumps(row | {"path": "PLACE/sessions/hl query/1.jpg"}))
    with pytest.raises(ArtifactError, match=r"_query_hl\.jsonl: .*'hl query/1\.jpg'"):
        export_pairs(tmp_path, "PLACE", "ios", "hl", tmp_path / "pairs.txt")
    path.write_text("{}\n")
    with pytest.raises(ArtifactError, match=r"_query_hl\.jsonl, line 1: "):
        export_pairs(tmp_path, "PLACE", "ios", "hl", tmp_path / "pairs.txt")
    path.write_text(json.dumps(row | {"path": "hl_query/1.jpg"}) + "\n")
    with pytest.raises(ArtifactError, match=r"_query_hl\.jsonl: .*'hl_query/1\.jpg'"):
        export_pairs(tmp_path, "PLACE", "ios", "hl", tmp_path / "pairs.txt")
    with pytest.raises(ArtifactError, match=r"_map_hl_query_hl\.jsonl"):
        export_pairs(tmp_path, "PLACE", "hl", "hl", tmp_path / "pairs.txt")


def test_a_table_of_a_session_makes_the_same_session(small_capture: Path, tmp_path: Path) -> None:
    for name, split in (("hl_map", "map"), ("hl_query", "query")):
        session = Capture.open(small_capture)[name]
        table = export_table(session, tmp_path / f"{name}.csv", ground_truth=split == "query")
        import_images(session.path / "raw_data", tmp_path / "BACK", "hl", split, table)
        back = Capture.open(tmp_path / "BACK")[name]
        places = dict(zip(back.images["path"], back.world_from_cam(ground_truth=split == "query"), strict=True))
        for row, expected in enumerate(session.world_from_cam(ground_truth=split == "query")):
            found = places[f"import/images/{session.images['path'].iloc[row]}"]
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
        assert {tuple(back.camera(s).params) for s in back.sensors["sensor_id"]} == {
            tuple(session.camera(s).params) for s in session.sensors["sensor_id"]
        }
    # Queries have no poses but their ground truth: odometry is no place in the map.
    odometry = shutil.copytree(session.path, tmp_path / "PLACE" / "hl_query", symlinks=True) / "trajectories.txt"
    shutil.copy(odometry.parent / "proc" / "alignment_trajectories.txt", odometry)
    session = Session.open(odometry.parent)
    header = export_table(session, tmp_path / "cameras.csv").read_text().splitlines()[0]
    assert header == "image,model,width,height,params"
