"""Photographs to a map: what is registered, held out, left out, found again; cameras and frames of videos."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pycolmap
import pytest
from typer.testing import CliRunner

from toolkit import pipeline
from toolkit.__main__ import app
from toolkit.capture import Capture, Session
from toolkit.capture.images import camera_text
from toolkit.capture.session import RECONSTRUCTION_RECORD
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange import reconstruct as module
from toolkit.exchange.interchange import import_colmap
from toolkit.exchange.photographs import choose_frames, gather, initial_cameras
from toolkit.exchange.reconstruct import add_recording, reconstruct
from toolkit.features.features import SiftExtractor
from toolkit.features.stores import extract_session, features_path
from toolkit.files import read_json
from toolkit.geometry import Floats, qt_from_pose
from toolkit.scene.map import Map


@pytest.fixture(scope="session")
def photographs(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The 6 photographs of the phone's map, one that is blank and one file that is no image."""
    folder = tmp_path_factory.mktemp("photographs")
    session = Capture.open(small_capture)["ios_map"]
    for row in range(len(session.images)):
        shutil.copy(session.image_path(row), folder / f"{row:03d}{session.image_path(row).suffix}")
    camera = session.camera(session.images["sensor_id"].iloc[0])
    PIL.Image.new("RGB", (camera.width, camera.height), (90, 90, 90)).save(folder / "blank.png")
    (folder / "torn.jpg").write_bytes(b"not an image")
    return folder


@pytest.fixture(scope="session")
def place(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Capture.reconstruct([photographs], tmp_path_factory.mktemp("place") / "PLACE", hold_out=4).path


def estimated_cameras(session: Session) -> set[str]:
    """Return the intrinsics that `Map` takes for estimated."""
    return Map.estimated_cameras.func(SimpleNamespace(session=session))  # type: ignore[attr-defined]


def relative_rotations_deg(ours: Floats, true: Floats) -> Floats:
    """Angles between the relative rotations of neighbors."""
    apart = [poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3] for poses in (ours, true)]
    trace = np.einsum("nij,nij->n", *apart)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def test_cameras_that_were_estimated_are_known_to_the_map(place: Path, small_capture: Path) -> None:
    session = Capture.open(place)["ios_map"]
    assert estimated_cameras(session) == {camera_text(session.camera(session.images["sensor_id"].iloc[0]))}
    assert estimated_cameras(Capture.open(small_capture)["ios_map"]) == set()


def test_poses_are_those_of_the_truth(place: Path, small_capture: Path) -> None:
    capture, true = Capture.open(place), Capture.open(small_capture)["ios_map"].world_from_cam()
    poses = {}
    for session in (capture["ios_map"], capture["ios_query"]):
        assert session.ground_truth is not None
        for row, pose in enumerate(session.world_from_cam(ground_truth=True)):
            poses[session.image_path(row).stem] = pose
    assert sorted(poses) == [f"{number:03d}" for number in range(6)]
    ours = np.stack([poses[name] for name in sorted(poses)])
    assert relative_rotations_deg(ours, true).max() < 1.0
    a, b = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (ours, true))
    found = pycolmap.estimate_sim3d(a, b)
    assert found is not None
    spread = np.linalg.norm(b, axis=1).mean()
    assert np.linalg.norm(found * a - b, axis=1).max() < 0.1 * spread
    assert capture.unit is None


def test_every_photograph_has_a_row(place: Path) -> None:
    import pandas as pd

    rows = pd.concat(
        [pd.read_csv(place / "sessions" / name / "proc/import.csv") for name in ("ios_map", "ios_query")]
    ).set_index("image")["status"]
    assert len(rows) == 8
    assert (rows == "imported").sum() == 6
    assert "no matches" in rows["blank.png"]
    assert "image" in rows["torn.jpg"]
    record = read_json(place / "sessions/ios_map" / RECONSTRUCTION_RECORD)
    assert (record["photographs"], record["registered"]) == (8, 6)


def test_a_run_takes_the_features(place: Path, tmp_path: Path) -> None:
    for name in ("ios_map", "ios_query"):
        session = Capture.open(place)[name]
        made = {shard.name for shard in (session.path / "proc/features").glob("sift-*/*.shard")}
        store = extract_session(session, tmp_path)
        path = features_path(tmp_path, name, SiftExtractor().settings)
        assert {shard.name for shard in path.glob("*.shard")} == made != set()
        assert set(session.image_names) <= set(store)


def test_a_second_one_computes_only_the_model(
    photographs: Path, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = tmp_path / "PLACE"
    shutil.copytree(place / module.FOLDER, again / module.FOLDER, symlinks=True)

    def refuse(*_: Any) -> None:
        raise AssertionError("extracted or matched again")

    monkeypatch.setattr(SiftExtractor, "extract", refuse)
    monkeypatch.setattr(module._Mutual, "match_unit", refuse)
    reconstruct([photographs], again)
    assert len(Capture.open(again)["ios_map"].images) == 6


def test_known_cameras_and_rough_poses(photographs: Path, small_capture: Path, tmp_path: Path) -> None:
    session, rng = Capture.open(small_capture)["ios_map"], np.random.default_rng(0)
    true, camera = session.world_from_cam(), session.camera(session.images["sensor_id"].iloc[0])
    table, prior = tmp_path / "cameras.txt", tmp_path / "prior.csv"
    names = sorted(path.name for path in photographs.glob("0*"))
    params = " ".join(map(str, camera.params))
    table.write_text("\n".join(f"{name} {camera.model.name} {camera.width} {camera.height} {params}" for name in names))
    rough = true @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes
    rough[:, :3, 3] += 0.03 * rng.normal(size=(len(true), 3))
    rows = [",".join(map(str, (name, *qt))) for name, qt in zip(names, qt_from_pose(rough), strict=True)]
    prior.write_text("\n".join(["image,qw,qx,qy,qz,tx,ty,tz", *rows]))
    result = reconstruct([photographs], tmp_path / "PLACE", table=table, poses_prior=prior, axes="opengl")
    capture = result.capture
    found = capture["ios_map"]
    assert capture.unit == "m"
    assert camera_text(found.camera(found.images["sensor_id"].iloc[0])) == camera_text(camera)
    assert estimated_cameras(found) == set()
    apart = true[:, :3, 3] - found.world_from_cam()[:, :3, 3]
    assert np.linalg.norm(apart, axis=1).max() < 0.08
    assert relative_rotations_deg(found.world_from_cam(), true).max() < 0.2
    assert "rough poses" in result.report.record["meters"]
    with pycolmap.Database.open(str(tmp_path / "PLACE" / module.FOLDER / "database.db")) as database:
        assert database.num_pose_priors() == len(true)  # for the mapper


def test_neighbors_by_rough_poses_look_into_similar_directions() -> None:
    work, back = object.__new__(module._Work), np.diag([-1.0, 1.0, -1.0, 1.0])
    work.prior = np.stack([np.eye(4), np.eye(4), back, np.full((4, 4), np.nan)])
    work.prior[1, 0, 3] = 2.0
    apart = work._apart_by_prior()
    assert apart[0, 1] == apart[1, 0] == 2
    assert np.isinf(np.delete(apart.ravel(), [1, 4])).all()


@pytest.mark.slow
def test_a_rig_of_folders(small_capture: Path, tmp_path: Path) -> None:
    session, folder = Capture.open(small_capture)["spot_map"], tmp_path / "photographs"
    assert session.rigs is not None
    truth = {}
    for row, (time, sensor) in enumerate(zip(session.images["timestamp"], session.images["sensor_id"], strict=True)):
        name = f"{sensor.rpartition('/')[2]}/{time}{session.image_path(row).suffix}"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(session.image_path(row), folder / name)
        truth[name] = session.rig_from_cam([row])[0]
    reconstruct([folder], tmp_path / "PLACE", "spot", rig="folders", hold_out=4)
    capture = Capture.open(tmp_path / "PLACE")
    for found in (capture["spot_map"], capture["spot_query"]):
        assert found.rigs is not None
        assert len(found.rigs) == found.images["sensor_id"].nunique() == 3
        assert found.images["timestamp"].nunique() == len(found.images) / len(found.rigs)
        names = found.own_names([np.array([row]) for row in range(len(found.images))])
        ours, true = found.rig_from_cam(), np.stack([truth[name] for name in names])
        assert relative_rotations_deg(ours, true).max() < 1.0
    with pytest.raises(CaptureError, match="has rigs"):
        add_recording([folder], tmp_path / "PLACE", "spot")


CAMERA_TABLE = "image,model,width,height,params\nother.jpg,PINHOLE,64,48,50 50 32 24\n"


@pytest.mark.parametrize(("content", "options", "error", "named"), [
    ("{", ["rig"], CaptureError, "COLMAP reads"),
    ('[{"cameras": 3}]', ["rig"], CaptureError, "COLMAP reads"),
    ('[{"cameras": [{"image_prefix": "a/", "ref_sensor": true}]}]', ["rig"], CaptureError, "two cameras"),
    (None, ["rig"], CaptureError, "two cameras"),
    (CAMERA_TABLE, ["table"], CaptureError, r"given.*other.jpg.*expected '000"),
    (CAMERA_TABLE, ["poses_prior", "positions"], ManifestError, "poses-prior"),
])  # fmt: skip
def test_rigs_and_tables_of_other_photographs_are_refused(
    content: str | None, options: list[str], error: type[Exception], named: str, photographs: Path, tmp_path: Path
) -> None:
    given = tmp_path / "given"
    given.write_text(content or "")
    with pytest.raises(error, match=named):
        reconstruct([photographs], tmp_path / "PLACE", **dict.fromkeys(options, given if content else "folders"))


def test_two_cameras_with_one_center_do_not_bend_the_model() -> None:
    """Cameras of a rig often have one center, and COLMAP fixes the scale by the distance of two cameras."""
    rng, camera = np.random.default_rng(0), pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, camera_id=1)
    camera.params = [600.0, 320.0, 240.0]
    centers, points = rng.uniform(-3, 3, (10, 3)) * [1, 1, 0.3], rng.uniform([-3, -3, 7], [3, 3, 13], (150, 3))
    centers[1] = centers[0]
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    seen = points[None] - centers[:, None]
    pixels = 600 * seen[..., :2] / seen[..., 2:] + [320, 240]
    for number, center in enumerate(centers + 0.05 * rng.normal(size=centers.shape), start=1):
        image = pycolmap.Image(name=f"{number}", camera_id=1, image_id=number, keypoints=pixels[number - 1])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -center))
    for row, point in enumerate(points + 0.05 * rng.normal(size=points.shape)):
        track = [pycolmap.TrackElement(number, row) for number in range(1, len(centers) + 1)]
        model.add_point3D(point, pycolmap.Track(track))
    work = object.__new__(module._Work)
    work.cameras, work.camera_ids, work.known = [camera], [1], {0}
    work._refine(model)
    ours = np.stack([model.image(number).projection_center() for number in range(1, len(centers) + 1)])
    found = pycolmap.estimate_sim3d(ours, centers)
    assert found is not None
    assert np.linalg.norm(found * ours - centers, axis=1).max() < 1e-6


@pytest.mark.slow
def test_two_places_are_two_models(photographs: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    for path in sorted(photographs.glob("0*")):
        with PIL.Image.open(path) as image:
            mirrored = np.asarray(image.convert("RGB"))[:, ::-1]
        PIL.Image.fromarray(255 - mirrored).save(other / f"{path.stem}.png")
    (other / "000.png").unlink()
    (other / "001.png").unlink()
    result = reconstruct([photographs, other], tmp_path / "PLACE")
    record = read_json(tmp_path / "PLACE/sessions/ios_map" / RECONSTRUCTION_RECORD)
    assert (record["registered"], record["other models"]) == (6, [4])
    left = result.report.images.set_index("image")["status"]
    assert "in model 1, of 4 photographs" in left["other/002.png"]
    models = tmp_path / "PLACE/reconstruction/models/1"
    assert f"models of 4 in {models}; IMAGES: {tmp_path / 'PLACE/reconstruction/sessions'}" in result.report.text()
    other_place = import_colmap(models, tmp_path / "PLACE/reconstruction/sessions", tmp_path / "OTHER")
    assert other_place.record["used"] == 4


def test_the_capture_is_in_the_folder_of_the_photographs(tmp_path: Path) -> None:
    for name in ("a.jpg", "PLACE/reconstruction/sessions/ios_map/raw_data/a.jpg", "PLACE/reconstruction/images/b.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.new("RGB", (64, 48)).save(tmp_path / name)
    assert [item.name for item in gather([tmp_path], tmp_path / "PLACE/reconstruction/images")[0]] == ["a.jpg"]


@pytest.mark.parametrize(
    ("readable", "named"),
    [(3, "fit together"), (1, r"1 photographs can be read, expected 3 or more\. 1\.png: cannot be read")],
)
def test_nothing_fits(readable: int, named: str, tmp_path: Path) -> None:
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    rng = np.random.default_rng(0)
    for number in range(3):
        PIL.Image.fromarray(rng.integers(0, 255, (240, 320, 3), np.uint8)).save(photographs / f"{number}.png")
    if readable == 1:
        (photographs / "0.png").unlink()
        (photographs / "1.png").write_bytes(b"no image")
    with pytest.raises(CaptureError, match=named):
        reconstruct([photographs], tmp_path / "PLACE")
    assert not (tmp_path / "PLACE/sessions").exists()


def test_a_focal_length_in_exif_that_no_model_fits_is_estimated(
    photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was kept as the start, and "no two of 3 photographs fit together" did not name it."""
    exif = PIL.Image.Exif()
    exif[0x0110], exif.get_ifd(0x8769)[0xA405] = "Camera 5", 400
    for path in sorted(photographs.glob("0*"))[:3]:
        PIL.Image.open(path).save(tmp_path / f"{path.stem}.png", exif=exif)
    made = reconstruct([tmp_path], tmp_path / "PLACE")
    assert made.report.images["status"].eq("imported").all()
    text = made.report.text()
    assert "started at 1.2 times the longer side, as the focal length in EXIF fits no model" in text
    assert "the focal length in EXIF of 3 photographs is not used" in text
    monkeypatch.setattr(module._Work, "_models", lambda *_: [])
    with pytest.raises(CaptureError, match=r"no two of 3 .* in the model, also without its focal length in EXIF"):
        reconstruct([tmp_path], tmp_path / "PLACE", device="other")


def test_a_focal_length_in_exif_is_tried_again_with_learned_features(
    photographs: Path, small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forgotten because SIFT found no model, it stayed so for the model with ALIKED."""
    exif, session = PIL.Image.Exif(), Capture.open(small_capture)["ios_map"]
    camera = session.camera(session.images["sensor_id"].iloc[0])
    film_mm = camera.mean_focal_length() * np.hypot(36, 24) / np.hypot(camera.width, camera.height)
    exif[0x0110], exif.get_ifd(0x8769)[0xA405] = "Camera 5", round(film_mm)
    for path in sorted(photographs.glob("0*"))[:3]:
        PIL.Image.open(path).save(tmp_path / f"{path.stem}.png", exif=exif)
    match = module._Work.match

    def only_learned(work: module._Work, _: object) -> list[str]:
        work.extract(work.kinds[0][0], range(len(work)))
        match(work, 1, work.choose_pairs())
        return []

    monkeypatch.setattr(module._Work, "match", lambda *_: None)
    monkeypatch.setattr(module, "_escalate", only_learned)
    made = reconstruct([tmp_path], tmp_path / "PLACE")
    assert made.report.images["status"].eq("imported").all()
    assert "started at EXIF" in made.report.text()
    assert "is not used" not in made.report.text()


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"hold_out": 1}, ManifestError),
        ({"hold_out": 9}, ManifestError),
        ({"mapper": "magic"}, ManifestError),
        ({"camera": "PINHOLE, 10"}, ManifestError),
        ({"positions": "missing.csv"}, CaptureError),
    ],
)
def test_malformed_arguments(photographs: Path, tmp_path: Path, options: dict[str, Any], error: type) -> None:
    with pytest.raises(error):
        reconstruct([photographs], tmp_path / "PLACE", **options)


def test_sources_that_are_none(photographs: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no image")
    for sources, named in (
        ([tmp_path / "missing"], "missing"),
        ([tmp_path / "notes.txt"], "notes.txt"),
        ([next(photographs.glob("000*"))] * 2, "one name"),
    ):
        with pytest.raises(CaptureError, match=named):
            gather(sources, tmp_path / "PLACE/reconstruction/images")


def test_other_formats_are_converted_with_their_tags(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    exif = PIL.Image.Exif()
    exif[0x0110] = "Camera 5"
    exif[0x0112] = 6
    gps = exif.get_ifd(0x8825)
    gps.update({1: "S", 2: (12.0, 30.0, 36.0), 3: "E", 4: (7.0, 15.0, 0.0), 5: b"\x01", 6: 30.0})
    PIL.Image.fromarray(pixels).save(tmp_path / "a.tiff", exif=exif)
    PIL.Image.fromarray(pixels).save(tmp_path / "b.webp", lossless=True, exif=exif)
    found, _ = gather([tmp_path], tmp_path / "PLACE/reconstruction/images")
    assert [item.name for item in found] == ["a.tiff.png", "b.webp.png"]
    for item in found:
        turned = item.name.startswith("a")  # Pillow turns a TIFF upright
        np.testing.assert_array_equal(np.asarray(PIL.Image.open(item.path)), np.rot90(pixels, -1) if turned else pixels)
        assert item.exif[0x0110] == "Camera 5"
        assert item.quarter_turns == (0 if turned else 3)
    assert found[1].geo == pytest.approx((-12.51, 7.25, -30.0))  # Pillow does not write GPS into a TIFF


def test_cameras_are_shared_by_folder_size_and_tags(tmp_path: Path) -> None:
    def write(name: str, size: tuple[int, int], film_mm: int | None = None) -> None:
        exif = PIL.Image.Exif()
        if film_mm:
            exif.get_ifd(0x8769)[0xA405] = film_mm
        (tmp_path / name).parent.mkdir(exist_ok=True)
        PIL.Image.new("RGB", size).save(tmp_path / name, exif=exif)

    write("a/1.jpg", (64, 48), 28)
    write("a/2.jpg", (64, 48), 28)
    write("a/3.jpg", (64, 48), 50)
    write("b/1.jpg", (64, 48))
    write("b/2.jpg", (64, 48))
    for number, width in enumerate((60, 70, 80, 80)):
        write(f"c/{number}.jpg", (width, 48))
    found, _ = gather([tmp_path], tmp_path / "PLACE/reconstruction/images")
    numbers, cameras = initial_cameras(found, {})
    assert numbers == [0, 0, 1, 2, 2, 3, 4, 5, 6]
    assert cameras[0].mean_focal_length() == pytest.approx(28 * 80 / np.hypot(36, 24))
    assert cameras[0].has_prior_focal_length
    assert not cameras[2].has_prior_focal_length
    assert cameras[2].mean_focal_length() == pytest.approx(1.2 * 64)


def test_frames_of_a_video_move_and_are_sharp(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(0, 255, (60, 200, 3), np.uint8), (1600, 480), interpolation=cv2.INTER_CUBIC)
    video = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), 10, (640, 480))
    for number in range(60):  # 10 frames of rest, then 8 pixels a frame; every other frame is blurred
        x = 8 * max(0, number - 10)
        frame = wall[:, x : x + 640]
        writer.write(cv2.GaussianBlur(frame, (0, 0), 4) if number % 2 else frame)
    writer.release()
    chosen = [number for number, _ in choose_frames(video)]
    assert all(number % 2 == 0 for number in chosen[1:])
    assert sum(number <= 10 for number in chosen) <= 2
    steps = np.diff([number for number in chosen if number > 10])
    assert steps.min() >= 2
    assert steps.max() <= 8
    assert len(list(choose_frames(video, fps=2))) == pytest.approx(12, abs=1)
    names = [item.name for item in gather([video], tmp_path / "PLACE/reconstruction/images", 1)[0]]
    assert names[0].startswith("walk/frame_")
    for fps in (None, 1):  # the frames of another rate are replaced
        again = [item.name for item in gather([video], tmp_path / "PLACE/reconstruction/images", fps)[0]]
        assert (again == names) == (fps == 1)
    (tmp_path / "torn.mp4").write_bytes(b"no video")
    with pytest.raises(CaptureError, match=r"torn\.mp4"):
        list(choose_frames(tmp_path / "torn.mp4"))
    found, unreadable = gather([tmp_path], tmp_path / "PLACE/reconstruction/images", 1)
    assert [item.name for item in found] == names
    assert "no frame can be read" in unreadable["torn.mp4"]


def test_a_killed_command_goes_on_from_its_model(
    photographs: Path, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It asked for other photographs, and no manifest was there."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(place / module.FOLDER, tmp_path / "PLACE" / module.FOLDER, symlinks=True)
    ran = list[Any]()

    def kill(*arguments: Any, **_: Any) -> Path:
        ran.append(arguments)
        if len(ran) == 1:
            raise KeyboardInterrupt
        return tmp_path

    monkeypatch.setattr(pipeline, "run", kill)
    command = ["reconstruct", str(photographs), "PLACE"]
    assert CliRunner().invoke(app, command).exit_code != 0
    before = (tmp_path / "PLACE/sessions/ios_map/trajectories.txt").stat().st_mtime_ns
    done = CliRunner().invoke(app, command)
    assert "from the same photographs, kept" in done.stdout
    assert len(ran) == 2
    assert (tmp_path / "PLACE/sessions/ios_map/trajectories.txt").stat().st_mtime_ns == before
    for other in (["--fps", "3"], ["--hold-out", "2"]):
        assert CliRunner().invoke(app, [*command, *other]).exit_code != 0


def test_the_command_line_explains_what_is_missing(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["reconstruct", str(tmp_path)])
    assert isinstance(result.exception, ManifestError)


def synthetic_model(center: tuple[float, float], noise_px: float) -> tuple[Any, pycolmap.Reconstruction]:
    """Return a model of points all around cameras with this principal point, which say that it is in the middle."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_frames_per_rig=10, num_points3D=400)
    options.camera_params = [1280.0, *center, 0.0]
    model, rng = pycolmap.synthesize_dataset(options), np.random.default_rng(0)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + rng.normal(0, noise_px, 2)
    for camera in model.cameras.values():
        camera.principal_point_x, camera.principal_point_y = 512, 384
    work = object.__new__(module._Work)
    work.known, work.camera_ids, work.cameras = set(), [*model.cameras], [*model.cameras.values()]
    return work, model


def test_principal_points_move_to_where_they_fit_but_not_far_from_the_middle_of_the_image() -> None:
    for center, low, high in (((518.0, 380.0), 0.85, 1.05), ((612.0, 384.0), 0.2, 0.95)):
        work, model = synthetic_model(center, 0.3)
        work._refine(model)
        way = np.subtract(center, (512, 384))
        for camera in model.cameras.values():
            moved = np.array([camera.principal_point_x - 512, camera.principal_point_y - 384])
            assert low < moved @ way / (way @ way) < high
    _, model = synthetic_model((518.0, 380.0), 0.3)
    for number in list(model.points3D)[20:]:
        model.delete_point3D(number)
    work._refine(model)  # each image keeps too few points
    assert model.num_reg_images() == 0
    work, model = synthetic_model((518.0, 380.0), 0.3)
    work.known = {0, 1}  # given intrinsics stay
    work._refine(model)
    assert {tuple(camera.params[1:3]) for camera in model.cameras.values()} == {(512.0, 384.0)}
