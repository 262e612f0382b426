"""Export: the map as COLMAP reads it, retrieval as hloc reads it; and back."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pycolmap
import pytest
from typer.testing import CliRunner

from tests.rendered import copy_shared
from toolkit.__main__ import app
from toolkit.capture import Capture, Session
from toolkit.errors import COMMAND, ArtifactError, ManifestError
from toolkit.exchange.export import colmap_model, export_colmap, export_pairs, export_poses, export_table
from toolkit.exchange.interchange import import_colmap, import_images
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import SceneFiles, pair_name
from toolkit.geometry import invert, pose_from_qt
from toolkit.mapping.build import build_map
from toolkit.mapping.local_map import LocalMap
from toolkit.results.pair import MAPS


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
    copy_shared(small_features, files.features)
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
    (features,) = (run.features / "hl_map").glob("sift-*")
    store, names = FeatureStore.open(features), local_map.image_names
    files = SceneFiles(tmp_path / "run", run.scene)
    for kind in ("sift", "superpoint"):
        copy = files.features / "hl_map" / features.name.replace("sift", kind)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(features, copy)
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
    shutil.copytree(features, copy.with_name("superpoint-0"))  # of other settings
    with pytest.raises(ArtifactError, match="2 folders of superpoint features"):
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
    changed = Path(shutil.copytree(small_capture, tmp_path / small_capture.name))
    images = changed / "sessions" / "hl_map" / "images.txt"
    images.write_text("\n".join(images.read_text().splitlines()[:-1]) + "\n")
    new = tmp_path / "model"
    for device, out, capture, error, named in (
        ("hl", model, small_capture, ManifestError, "model: "),
        ("hl", new, None, ManifestError, "--capture PATH/SMALL"),
        ("ios", new, small_capture, ArtifactError, f"{COMMAND} run MANIFEST --only localize"),
        ("hl", new, changed, ArtifactError, "hl_map: image hl_map/raw_data/"),
    ):
        with pytest.raises(error, match=named):
            export_colmap(run.run, run.scene, device, out, capture)
    assert not new.exists()


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
    for device, wrong, named in (
        ("ios", row | {"path": "PLACE/sessions/hl query/1.jpg"}, r"_query_hl\.jsonl: .*'hl query/1\.jpg'"),
        ("ios", {}, r"_query_hl\.jsonl, line 1: "),
        ("ios", row | {"path": "hl_query/1.jpg"}, r"_query_hl\.jsonl: .*'hl_query/1\.jpg'"),
        ("hl", row, r"_map_hl_query_hl\.jsonl"),
    ):
        path.write_text(json.dumps(wrong) + "\n")
        with pytest.raises(ArtifactError, match=named):
            export_pairs(tmp_path, "PLACE", device, "hl", tmp_path / "pairs.txt")


@pytest.fixture
def imported_run(small_capture: Path, tmp_path: Path) -> SceneFiles:
    """A run on images that were imported from folders of a user's own: a map, and a rig as queries, with poses."""
    sessions, place = small_capture / "sessions", tmp_path / "PLACE"
    map_session, queries = Session.open(sessions / "ios_map"), Session.open(sessions / "hl_query")
    table = export_table(map_session, tmp_path / "map.csv")
    import_images(map_session.path / "raw_data", place, "ios", "map", table)
    model = pycolmap.Reconstruction()
    for row, path in enumerate(queries.images["path"]):
        camera = pycolmap.Camera(queries.camera(queries.images["sensor_id"].iloc[row]).todict())
        camera.camera_id = row + 1
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(path, camera_id=camera.camera_id, image_id=row + 1)
        pose = invert(queries.world_from_cam([row], ground_truth=True)[0])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    (tmp_path / "model").mkdir()
    model.write(tmp_path / "model")
    import_colmap(tmp_path / "model", queries.path / "raw_data", place, "hl", "query")
    truth = Capture.open(place)["hl_query"].ground_truth
    assert truth is not None
    files = SceneFiles(tmp_path / "run", "PLACE")
    files.poses_dir.mkdir(parents=True)
    truth.write(files.poses_txt("ios", "hl"))
    keys = pd.DataFrame({"timestamp": truth.timestamps, "device_id": truth.device_ids, "status": "ok"})
    keys.to_csv(files.poses_csv("ios", "hl"), index=False)
    return files


def test_poses_and_intrinsics_are_hlocs_under_the_names_that_were_imported(
    imported_run: SceneFiles, small_capture: Path, tmp_path: Path
) -> None:
    run, place = str(imported_run.run), str(tmp_path / "PLACE")
    arguments = [run, "PLACE", "ios", "hl"]
    for what in ("poses", "intrinsics"):
        command = ["export", what, *arguments, str(tmp_path / f"{what}.txt"), "--capture", place]
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output
    queries = Session.open(small_capture / "sessions" / "hl_query")
    lines = [(tmp_path / f"{what}.txt").read_text().splitlines() for what in ("poses", "intrinsics")]
    assert len(lines[0]) == len(lines[1]) == len(queries)
    poses, cameras = ({name: values for name, *values in map(str.split, of)} for of in lines)
    assert set(poses) == set(cameras) == set(queries.images["path"])
    for row, name in enumerate(queries.images["path"]):
        cam_from_world = pose_from_qt(np.array(poses[name], float))
        expected = invert(queries.world_from_cam([row], ground_truth=True)[0])
        np.testing.assert_allclose(cam_from_world, expected, rtol=0, atol=1e-12)
        camera = queries.camera(queries.images["sensor_id"].iloc[row])
        model, width, height, *params = cameras[name]
        assert (model, int(width), int(height)) == (camera.model.name, camera.width, camera.height)
        assert [float(one) for one in params] == camera.params.tolist()
    assert export_poses(run, "PLACE", "ios", "hl", tmp_path / "p.txt", place, names="capture") == len(queries)
    assert (tmp_path / "p.txt").read_text().startswith("hl_query/raw_data/import/images/")
    for device, names, error, named in (
        ("hl", "own", ArtifactError, r"_map_hl_query_hl\.txt is missing"),
        ("ios", "mine", ManifestError, "names: unknown 'mine'"),
    ):
        with pytest.raises(error, match=named):
            export_poses(run, "PLACE", device, "hl", tmp_path / "p.txt", place, names=names)


def test_a_rig_has_a_line_for_each_of_its_cameras(small_capture: Path, tmp_path: Path) -> None:
    """The pose of a rig and where its cameras are in it, together, are the poses of its cameras."""
    session, files = Capture.open(small_capture)["hl_query"], SceneFiles(tmp_path, small_capture.name)
    assert session.ground_truth is not None
    files.poses_dir.mkdir(parents=True)
    session.ground_truth.write(files.poses_txt("ios", "hl"))
    count = export_poses(tmp_path, files.scene, "ios", "hl", tmp_path / "p.txt", small_capture)
    read = {name: values for name, *values in map(str.split, (tmp_path / "p.txt").read_text().splitlines())}
    assert count == len(read) == len(session) == 2 * len(session.ground_truth)
    for row, expected in enumerate(session.world_from_cam(ground_truth=True)):
        found = pose_from_qt(np.array(read[session.image_name(row)], float))
        np.testing.assert_allclose(found, invert(expected), rtol=0, atol=1e-12)


def test_a_model_has_the_names_that_were_imported_again(
    run: SceneFiles, small_capture: Path, imported_run: SceneFiles, tmp_path: Path
) -> None:
    """The map of the headset, as if its images had been imported."""
    session = session_of(small_capture)
    table = export_table(session, tmp_path / "hl.csv")
    import_images(session.path / "raw_data", tmp_path / "PLACE", "hl", "map", table)
    place, local_map = Capture.open(tmp_path / "PLACE")["hl_map"], LocalMap.load(run.maps / "hl_map.npz")
    renamed = [name.replace("raw_data/", "raw_data/import/images/") for name in local_map.image_names]
    store = FeatureStore.of_session(run.features, "hl_map")
    keypoints = {new: store[old].keypoints for new, old in zip(renamed, local_map.image_names, strict=True)}
    for names, expected in (("own", set(session.images["path"])), ("capture", set(renamed))):
        model = colmap_model(replace(local_map, image_names=renamed), place, keypoints, names)
        assert {image.name for image in model.images.values()} == expected


def test_pairs_with_one_name_for_two_images_are_refused(tmp_path: Path) -> None:
    files = SceneFiles(tmp_path, "PLACE")
    files.retrieval_dir.mkdir(parents=True)
    paths = [f"PLACE/sessions/ios_{split}/raw_data/import/images/a/1.jpg" for split in ("query", "map")]
    row = {"path": paths[0], "timestamp": "1", "sensor_id": "cam_1", "topk": [{"path": paths[1]}]}
    files.retrieval("ios", "ios").write_text(json.dumps(row) + "\n")
    with pytest.raises(ArtifactError, match=r"'a/1\.jpg' is the name of a query and of a reference.* --names capture"):
        export_pairs(tmp_path, "PLACE", "ios", "ios", tmp_path / "pairs.txt")
    assert export_pairs(tmp_path, "PLACE", "ios", "ios", tmp_path / "pairs.txt", names="capture") == 1
    row["topk"] = [{"path": paths[1].replace("1.jpg", "2.jpg")}]
    files.retrieval("ios", "ios").write_text(json.dumps(row) + "\n")
    assert export_pairs(tmp_path, "PLACE", "ios", "ios", tmp_path / "pairs.txt") == 1
    assert (tmp_path / "pairs.txt").read_text() == "a/1.jpg a/2.jpg\n"


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
