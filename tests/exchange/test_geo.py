"""Poses on the Earth: headings with known answers, tables of a run, position and direction in copies of pictures."""

import json
import shutil
from fractions import Fraction
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pandas as pd
import PIL.Image
import pytest
from typer.testing import CliRunner

from tests.rendered import LIST, prepared
from toolkit.__main__ import app
from toolkit.capture import Capture
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.export import export_exif, export_geo, geo_table
from toolkit.exchange.georeference import (
    GEO_COLUMNS,
    WORLD_DEVIATION,
    east_north_up,
    geographic,
    geographic_poses,
    origin_of,
)
from toolkit.exchange.photographs import gather
from toolkit.geometry import Floats, make_pose
from toolkit.localize import localize_pairs
from toolkit.results.pair import PairResults

RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
DEVICES = ("hl", "ios")
ORIGIN = np.array([-33.8568, 151.2153, 5.0])


def looking(direction: list[float], position: Floats | None = None) -> Floats:
    """world_from_cam (1, 4, 4) of a camera whose optical axis has this direction: east, north, up."""
    z = np.array(direction) / np.linalg.norm(direction)
    x = np.cross(z, [0, 0, 1] if abs(z[2]) < 0.9 else [0, 1, 0])
    x /= np.linalg.norm(x)
    return make_pose(np.stack([x, np.cross(z, x), z], axis=1), np.zeros(3) if position is None else position)[None]


@pytest.mark.parametrize("origin", [ORIGIN, np.array([47.4, 8.5, 400.0]), np.array([0.0, -179.99, 0.0])])
def test_geographic_undoes_the_local_frame(origin: Floats) -> None:
    local = np.random.default_rng(0).normal(size=(50, 3)) * [20_000, 20_000, 500]
    assert np.allclose(east_north_up(geographic(local, origin), origin), local, atol=1e-5)


@pytest.mark.parametrize(
    ("direction", "heading", "pitch"),
    [([0, 1, 0], 0, 0), ([1, 0, 0], 90, 0), ([0, -1, 0], 180, 0), ([-1, 0, 0], 270, 0), ([1, 1, np.sqrt(2)], 45, 45),
     ([-1, 1, 0], 315, 0)],
)  # fmt: skip
def test_heading_is_clockwise_from_north(direction: list[float], heading: float, pitch: float) -> None:
    assert geographic_poses(looking(direction), ORIGIN)[0] == pytest.approx([*ORIGIN, heading, pitch], abs=1e-6)


def test_a_vertical_camera_has_no_heading_and_a_missing_pose_nothing() -> None:
    down, nothing = geographic_poses(np.concatenate([looking([0, 0, -1]), np.full((1, 4, 4), np.nan)]), ORIGIN)
    assert np.isnan(down[3])
    assert down[4] == pytest.approx(-90)
    assert np.isnan(nothing).all()


def test_north_is_that_at_the_camera() -> None:
    # 100 km east at 45 degrees are 1.268 degrees of longitude; meridians converge by their sine of the latitude.
    pose = looking([0, 1, 0], np.array([100_000.0, 0, 0]))
    heading = geographic_poses(pose, np.array([45.0, 7.0, 0.0]))[0, 3]
    assert heading == pytest.approx(1.268 * np.sin(np.pi / 4), abs=0.01)


@pytest.fixture(scope="module")
def localized(small_capture: Path, small_features: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has localized the phone and the headset, a rig, in the phone's map."""
    folder = tmp_path_factory.mktemp("localized")
    files = prepared(folder, small_capture, small_features, DEVICES)
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    for device in DEVICES:
        localize_pairs(
            small_capture / "sessions", *folders, queries=LIST, workers=1, map_device="ios", query_device=device
        )
    return folder


@pytest.fixture
def placed(small_capture: Path, tmp_path: Path) -> Path:
    """The small capture, whose map has an origin."""
    capture = tmp_path / small_capture.name
    shutil.copytree(small_capture, capture)
    record = capture / "sessions/ios_map/proc/import.json"
    origin = dict(zip(GEO_COLUMNS, ORIGIN.tolist(), strict=False))
    record.write_text(json.dumps({"unit": "m", "origin": origin}))
    return capture


def test_tables_have_a_row_for_every_image(localized: Path, placed: Path, tmp_path: Path) -> None:
    table = geo_table(localized, placed)
    assert set(table["map_device"]) == {"ios"}
    poses = localized / placed.name / "poses"
    results = {device: PairResults.of(poses, placed.name, "ios", device) for device in DEVICES}
    images = [names for result in results.values() for names in result.table["image"]]
    assert len(table) == sum(len(str(names).split(";")) for names in images)
    known = table[table["latitude_deg"].notna()]
    row = known.iloc[0]
    session = Capture.open(placed)[f"{row['query_device']}_query"]
    world_from_rig = results[row["query_device"]].trajectory.lookup([row["timestamp"]], [row["device_id"]])[0]
    world_from_cam = world_from_rig @ session.rig_from_cam([session.row_of_name[row["image"]]])[0]
    east, north, _ = world_from_cam[:3, 3]
    assert row["latitude_deg"] - ORIGIN[0] == pytest.approx(north / 110_922, rel=1e-3)  # meters per degree there
    assert row["longitude_deg"] - ORIGIN[1] == pytest.approx(east / 92_556, rel=1e-3)
    axis = world_from_cam[:3, 2]
    assert row["heading_deg"] == pytest.approx(np.degrees(np.arctan2(axis[0], axis[1])) % 360, abs=1e-3)
    count = export_geo(localized, tmp_path / "q.csv", placed)
    assert count == len(known)
    record = placed / "sessions/ios_map/proc/import.json"
    record.write_text(json.dumps({**json.loads(record.read_text()), WORLD_DEVIATION: 3.0}))
    unsure = geo_table(localized, placed)["position_std_m"]
    assert np.allclose(unsure, np.hypot(table["position_std_m"], 3.0), equal_nan=True)
    assert pd.read_csv(tmp_path / "q.csv")["heading_deg"].notna().sum() == count
    assert export_geo(localized, tmp_path / "q.geojson", placed) == count
    features = json.loads((tmp_path / "q.geojson").read_text())["features"]
    assert len(features) == len(table)
    point = next(feature["geometry"] for feature in features if feature["geometry"])
    assert point["coordinates"] == pytest.approx([row["longitude_deg"], row["latitude_deg"], row["altitude_m"]])


def test_copies_have_position_direction_and_the_same_pixels(localized: Path, placed: Path, tmp_path: Path) -> None:
    sessions = placed / "sessions"
    (first, *_) = sorted((sessions / "ios_query/raw_data").rglob("*.jpg"))
    exif = PIL.Image.Exif()
    exif[0x010F], exif[0x8825] = "Maker", {1: "N", 2: (1.0, 2.0, 3.0), 17: 5.0, 29: "2026:01:02"}
    with PIL.Image.open(first) as image:
        image.save(first, "MPO", save_all=True, append_images=[image.reduce(4)], quality=97, exif=exif)  # as phones do
    arguments = ["export", "exif", localized, tmp_path / "out", "--capture", placed]
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0, result.output
    table = geo_table(localized, placed).query("status == 'ok'").drop_duplicates("image").set_index("image")
    copies = {path.relative_to(tmp_path / "out").as_posix(): path for path in (tmp_path / "out").rglob("*.jpg")}
    assert set(copies) == set(table.index)
    for name, path in copies.items():
        row = table.loc[name]
        (photograph,), _ = gather([path], tmp_path / "PLACE/reconstruction/images")
        assert photograph.geo == pytest.approx(row[list(GEO_COLUMNS[:3])].tolist(), abs=1e-3)
        assert photograph.geo[:2] == pytest.approx(row[list(GEO_COLUMNS[:2])].tolist(), abs=1e-8)
        with PIL.Image.open(path) as image:
            tags = image.getexif().get_ifd(0x8825)
        assert float(tags[17]) == pytest.approx(row["heading_deg"] % 360, abs=0.006)
        assert (tags[1], tags[3], tags[16]) == ("S", "E", "T")
        assert np.array_equal(cv2.imread(str(path)), cv2.imread(str(sessions / name)))
    with PIL.Image.open(tmp_path / "out" / first.relative_to(sessions)) as image:
        assert (image.format, image.n_frames, image.getexif()[0x010F]) == ("MPO", 2, "Maker")
        assert image.getexif().get_ifd(0x8825)[29] == "2026:01:02"
    with pytest.raises(ManifestError):
        export_exif(localized, tmp_path / "out", placed)


def test_xmp_beside_the_pictures(localized: Path, placed: Path, tmp_path: Path) -> None:
    table = geo_table(localized, placed).query("status == 'ok'").drop_duplicates("image").set_index("image")
    assert export_exif(localized, tmp_path / "out", placed, xmp=True) == len(table)
    for name, row in table.iterrows():
        (description,) = ElementTree.parse((tmp_path / "out" / str(name)).with_suffix(".xmp")).iter(f"{RDF}Description")
        tags = {key.partition("}")[2]: value for key, value in description.items() if "exif" in key}
        degrees, minutes = tags["GPSLatitude"].removesuffix("S").split(",")
        assert -(float(degrees) + float(minutes) / 60) == pytest.approx(row["latitude_deg"], abs=1e-8)
        assert tags["GPSLongitude"].endswith("E")
        assert float(Fraction(tags["GPSAltitude"])) == pytest.approx(abs(row["altitude_m"]), abs=1e-3)
        assert float(Fraction(tags["GPSImgDirection"])) == pytest.approx(row["heading_deg"] % 360, abs=0.006)


def test_what_is_refused(localized: Path, small_capture: Path, placed: Path, tmp_path: Path) -> None:
    def origin(found: object) -> None:
        (placed / "sessions/ios_map/proc/import.json").write_text(json.dumps({"origin": found}))
        origin_of(Capture.open(placed)["ios_map"])

    beyond = {"latitude_deg": 99, "longitude_deg": 1, "altitude_m": 1}
    for wrong, error, named in (
        (lambda: geo_table(localized, small_capture), CaptureError, "no origin"),
        (lambda: export_geo(localized, tmp_path / "q.kml", placed), ManifestError, "geojson"),
        (lambda: origin([1, 2, 3]), CaptureError, r"import\.json: origin"),
        (lambda: origin(beyond), CaptureError, r"import\.json: origin"),
        (lambda: origin({"latitude_deg": 1}), CaptureError, r"import\.json: origin"),
    ):
        with pytest.raises(error, match=named):
            wrong()


@pytest.mark.slow
def test_localize_tells_where_on_the_earth(
    small_run: Path, small_capture: Path, released_weights: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Capture.open(small_capture)["ios_query"]
    row = session.rows_of_keyframes(session.keyframes("all"))[0][0]
    arguments = ["localize", str(small_run), str(session.image_path(int(row))), "--json"]
    assert "latitude_deg" not in json.loads(CliRunner().invoke(app, arguments).stdout)["photographs"][0]
    with monkeypatch.context() as patch:
        patch.setattr("toolkit.exchange.georeference.origin_of", lambda session: ORIGIN)
        (found,) = json.loads(CliRunner().invoke(app, arguments).stdout)["photographs"]
    expected = geographic_poses(np.array([found["world_from_cam"]]), ORIGIN)[0]
    assert [found[name] for name in GEO_COLUMNS] == pytest.approx(expected.tolist())
