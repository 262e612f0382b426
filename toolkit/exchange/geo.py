"""Results on the Earth: tables for maps and GIS, and position and direction in the EXIF tags of the pictures.

Only for maps with an origin, see `georeference.origin_of`. Altitudes are those of the GPS that placed the map.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import pandas as pd
import PIL.Image

from toolkit.capture.images import HEADER_ERRORS
from toolkit.errors import ArtifactError, CaptureError, ImageError, ManifestError
from toolkit.exchange.georeference import GEO_COLUMNS, geographic_poses, origin_of
from toolkit.exchange.submission import open_captures
from toolkit.files import SceneFiles, image_name, own_name, write_atomic, write_folder, write_text
from toolkit.geometry import Floats
from toolkit.pose.result import Status, statuses
from toolkit.results.opening import localized_scenes
from toolkit.results.pair import PairResults, pairs_of

KEYS = ("scene", "map_device", "query_device", "image", "timestamp", "device_id", "status")
FORMATS = (".csv", ".geojson")
_GPS, _EXIF_HEAD, _LONGEST_SEGMENT = 0x8825, b"Exif\0\0", 0xFFFF - 2
_DENOMINATOR = 10**6  # of the seconds of arc: 0.03 mm


def geo_table(run: str | Path, capture: str | Path | None = None) -> pd.DataFrame:
    """Return a row per query image of a run and map with an origin: `KEYS`, `georeference.GEO_COLUMNS`, `num_inliers`,
    `position_std_m` and `path`, the file. The columns of the pose are NaN without a pose. `capture` is its folder, if
    it has moved since the run.

    Raises:
        CaptureError: no map has an origin.
        ArtifactError: there are no poses, or they are of older references or of an older map.
    """
    run, tables, refused = Path(run), list[pd.DataFrame](), list[CaptureError]()
    scenes = localized_scenes(run)
    with open_captures([run], [] if capture is None else [capture], scenes) as capture_of:
        for scene in scenes:
            for path in pairs_of(SceneFiles(run, scene).poses_dir):
                results = PairResults.open(path)
                results.require_current()
                map_device, query_device = results.devices
                try:
                    origin = origin_of(capture_of(scene)[f"{map_device}_map"])
                except CaptureError as error:
                    refused.append(error)
                    continue
                tables.append(_table_of(results, capture_of(scene)[f"{query_device}_query"], origin, scene))
    if not tables:
        raise refused[0] if refused else ArtifactError(f"{run}: no query was localized. Run the localize stage first.")
    return pd.concat(tables, ignore_index=True)


def _table_of(results: PairResults, session: Any, origin: Floats, scene: str) -> pd.DataFrame:
    numbers, rows = [], []
    for number, of_query in enumerate(session.rows_of_keyframes(results.table)):
        numbers += [number] * len(of_query)
        rows += of_query.tolist()
    table = results.table.iloc[numbers].reset_index(drop=True)
    world_from_cams = results.poses[numbers] @ session.rig_from_cam(rows)
    table = table.assign(
        scene=scene, map_device=results.devices[0], query_device=results.devices[1],
        image=[session.image_name(row) for row in rows], path=[session.image_path(row) for row in rows],
    )  # fmt: skip
    table[list(GEO_COLUMNS)] = geographic_poses(world_from_cams, origin)
    return table.reindex(columns=[*KEYS, *GEO_COLUMNS, "num_inliers", "position_std_m", "path"])


def export_geo(run: str | Path, out: str | Path, capture: str | Path | None = None) -> int:
    """Write `geo_table` as CSV, or as GeoJSON (RFC 7946), where images without a pose have no geometry.

    Return the number of images with a pose.

    Raises:
        ManifestError: the file's name ends neither in .csv nor in .geojson; and as for `geo_table`.
    """
    out = Path(out)
    if out.suffix.lower() not in FORMATS:
        raise ManifestError(f"{out}: found the ending {out.suffix!r}, expected {' or '.join(FORMATS)}.")
    table = geo_table(run, capture).drop(columns="path").assign(image=lambda rows: rows["image"].map(own_name))
    if out.suffix.lower() == ".csv":
        with write_atomic(out) as temporary:
            table.to_csv(temporary, index=False)
        return int(table["latitude_deg"].notna().sum())
    features = []
    for row in json.loads(table.to_json(orient="records", double_precision=15)):  # NaN becomes null
        latitude, longitude, altitude = (row[name] for name in GEO_COLUMNS[:3])
        point = {"type": "Point", "coordinates": [longitude, latitude, altitude]} if latitude is not None else None
        features.append({"type": "Feature", "geometry": point, "properties": row})
    write_text(out, json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n")
    return sum(feature["geometry"] is not None for feature in features)


def export_exif(
    run: str | Path, out: str | Path, capture: str | Path | None = None, unsure: bool = False, xmp: bool = False
) -> int:  # fmt: skip
    """Write copies of the query pictures with position and direction in EXIF; the pixels of JPEGs stay byte for byte.

    With `xmp`, write XMP files with these tags instead, `a.xmp` of `a.jpg`, to lie beside the pictures. Of a picture
    that was localized in several maps, the pose with the most inliers, then the surest, is taken; with `unsure`, also
    one of low confidence. Times and other tags stay. Return the number of pictures.

    Raises:
        ManifestError: the folder `out` contains files; or two XMP files would have one name.
        ImageError: a picture cannot be read; and as for `geo_table`.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ManifestError(f"{out}: contains files already. Give an empty or new folder.")
    table = geo_table(run, capture)
    table = table.assign(sure=statuses(table["status"]) == str(Status.OK))
    table = table[table["latitude_deg"].notna() & (table["sure"] | unsure)]
    best_first = ["sure", "num_inliers", "position_std_m"]
    table = table.sort_values(best_first, ascending=[False, False, True], kind="stable")
    table = table.drop_duplicates(["scene", "image"])
    if not len(table):
        raise ArtifactError(f"{run}: no query has a pose that is sure. Take the others by --unsure.")
    names = table["image"].map(own_name)
    if names.duplicated().any():  # of several sessions or scenes
        names = table["scene"] + "/" + table["image"].map(image_name)
    if xmp:
        names = names.map(lambda name: PurePosixPath(name).with_suffix(".xmp").as_posix())
        if names.duplicated().any():
            raise ManifestError(f"xmp: two pictures would have the file {names[names.duplicated()].iloc[0]}.")
    with write_folder(out) as folder:
        for name, row in zip(names, table.to_dict("records"), strict=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            if xmp:
                write_text(folder / name, _xmp(row))
            else:
                _write_with_gps(Path(row["path"]), folder / name, row)
    return len(table)


def _degrees(value: float) -> tuple[int, int, float]:
    """Return whole degrees, whole minutes, and seconds."""
    parts = round(abs(value) * 3600 * _DENOMINATOR)
    minutes, seconds = divmod(parts, 60 * _DENOMINATOR)
    return *divmod(minutes, 60), seconds / _DENOMINATOR


def _write_with_gps(source: Path, target: Path, row: Mapping[Any, Any]) -> None:
    """Write a copy of a picture with other GPS tags."""
    try:
        with PIL.Image.open(source) as image:
            exif, kind, jpeg = image.getexif(), image.format, source.read_bytes()
            tags = exif.get_ifd(_GPS)
            latitude, longitude, altitude, heading = (row[name] for name in GEO_COLUMNS[:4])
            tags |= {
                0: b"\x02\x03\x00\x00", 1: "NS"[latitude < 0], 2: _degrees(latitude), 3: "EW"[longitude < 0],
                4: _degrees(longitude), 5: b"\x01" if altitude < 0 else b"\x00", 6: round(abs(altitude), 3),
                18: "WGS-84",
            }  # fmt: skip
            for tag in (16, 17, 31):
                tags.pop(tag, None)
            if math.isfinite(heading):
                tags |= {16: "T", 17: round(heading, 2) % 360}
            if math.isfinite(row["position_std_m"]):
                tags[31] = round(row["position_std_m"], 4)
            exif[_GPS] = tags
            if not jpeg.startswith(b"\xff\xd8"):  # of a JPEG with several pictures, Pillow says MPO
                image.save(target, format=kind, exif=exif, icc_profile=image.info.get("icc_profile"))
                return
        content = _EXIF_HEAD + exif.tobytes().removeprefix(_EXIF_HEAD)
        target.write_bytes(_with_exif(jpeg, content))
    except HEADER_ERRORS as error:
        raise ImageError(f"{source}: EXIF tags cannot be written ({error}).") from None


def _xmp(row: Mapping[Any, Any]) -> str:
    """Return XMP with the tags of position and direction (XMP Specification, part 2, "Exif schema")."""
    latitude, longitude, altitude, heading = (row[name] for name in GEO_COLUMNS[:4])

    def angle(value: float, letters: str) -> str:
        degrees, minutes = divmod(round(abs(value) * 60, 8), 60)
        return f"{degrees:.0f},{minutes:.8f}{letters[value < 0]}"

    tags = {
        "GPSVersionID": "2.3.0.0", "GPSLatitude": angle(latitude, "NS"), "GPSLongitude": angle(longitude, "EW"),
        "GPSAltitudeRef": int(altitude < 0), "GPSAltitude": f"{round(abs(altitude) * 1000)}/1000",
        "GPSMapDatum": "WGS-84",
    }  # fmt: skip
    if math.isfinite(heading):
        tags |= {"GPSImgDirectionRef": "T", "GPSImgDirection": f"{round(heading * 100) % 36000}/100"}
    if math.isfinite(row["position_std_m"]):
        tags["GPSHPositioningError"] = f"{round(row['position_std_m'] * 10000)}/10000"
    lines = "".join(f'\n   exif:{name}="{value}"' for name, value in tags.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        f'  <rdf:Description rdf:about="" xmlns:exif="http://ns.adobe.com/exif/1.0/"{lines}/>\n'
        " </rdf:RDF>\n</x:xmpmeta>\n"
    )


def _with_exif(jpeg: bytes, exif: bytes) -> bytes:
    """Return a JPEG with this EXIF segment in place of its own (Exif 2.3, 4.5.4)."""
    if len(exif) > _LONGEST_SEGMENT:
        raise ValueError(f"{len(exif)} bytes of EXIF tags, at most {_LONGEST_SEGMENT} fit")
    kept, at = bytearray(), 2
    while jpeg[at : at + 1] == b"\xff" and jpeg[at + 1] != 0xDA:  # up to the start of the scan
        end = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if not (jpeg[at + 1] == 0xE1 and jpeg[at + 4 : at + 10] == _EXIF_HEAD):
            kept += jpeg[at:end]
        at = end
    if jpeg[at : at + 2] != b"\xff\xda":
        raise ValueError("no start of a scan")
    return jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + bytes(kept) + jpeg[at:]
