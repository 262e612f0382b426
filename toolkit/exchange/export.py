"""Export for other tools: a COLMAP model of the map; retrieval, poses and intrinsics as hloc lists; a table of poses;
local features and matches in the HDF5 files of hloc (https://github.com/cvg/Hierarchical-Localization), which are also
imported; results on the Earth: tables for maps and GIS, and position and direction in the EXIF tags of the images.

With `names="own"`, images have the names that the user knows (`files.own_name`), with `names="capture"` their paths
relative to `sessions`, as in files of local features and matches. `capture` is the new folder of a capture that has
moved since the run. All exports raise ManifestError for an unknown choice of names, a capture that is in neither place,
or one with another name.

A file of features of hloc has one group per image, with the image's name: `keypoints` (N, 2), `descriptors` (D, N) of
unit length, `scores` (N,), `image_size` (2,) and, beyond hloc, `scales` (N,) of the keypoints. The center of the
top-left pixel is at 0, and an attribute of the file says so; in `LocalFeatures` it is at 0.5. A file of matches has one
group per pair of images, `<image>/<image>` with `/` in the names replaced by `-`: `matches0` (N,), for each feature of
the first image the index of the matching feature of the second image or -1, and `matching_scores0` (N,).

On the Earth are only maps with an origin, see `georeference.origin_of`; altitudes are of the GPS that placed the map.
"""

import json
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np
import pandas as pd
import PIL.Image
import pycolmap
from numpy.typing import NDArray

from toolkit.capture import Session
from toolkit.capture.images import HEADER_ERRORS, camera_text
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import COMMAND, ArtifactError, CaptureError, DamagedError, ImageError, ManifestError, first_line
from toolkit.exchange.georeference import GEO_COLUMNS, deviation_of, geographic_poses, origin_of
from toolkit.features.features import DESCRIPTOR_SCALE, LocalFeatures, PairMatches
from toolkit.features.stores import FeatureStore, MatchStore, features_path, match_name, write_features, write_matches
from toolkit.files import (
    SceneFiles,
    files_fingerprint,
    image_name,
    own_name,
    read_references,
    read_sidecar,
    require_current,
    write_csv,
    write_folder,
    write_text,
)
from toolkit.geometry import Floats, invert, qt_from_pose
from toolkit.manifest import require_known
from toolkit.mapping.local_map import LocalMap, map_path
from toolkit.pose.base import Status
from toolkit.results.pair import PairResults, localized_scenes, map_inputs, names_of_maps, pairs_of
from toolkit.runs.folder import open_captures
from toolkit.store.hdf5 import HDF5_ERRORS, group_names_of, has_group, read_group, write_groups
from toolkit.store.items import Items

log = logging.getLogger(__name__)
NAMES = ("own", "capture", "file")
_LOCALIZE = f"Run the localize stage first ({COMMAND} run MANIFEST --only localize)."
Keypoints = Mapping[str, NDArray[np.floating]]
PIXEL_CENTER = "top_left_pixel_center"
"""Attribute of a file of features: the coordinate of the center of the top-left pixel."""
_HALF_PIXEL = np.float32(0.5)
KEYS = ("scene", "map_device", "query_device", "image", "timestamp", "device_id", "status")
FORMATS = (".csv", ".geojson")
_GPS, _EXIF_HEAD, _LONGEST_SEGMENT = 0x8825, b"Exif\0\0", 0xFFFF - 2
_DENOMINATOR = 10**6  # of the seconds of arc: 0.03 mm


def export_colmap(
    run: str | Path, scene: str, device: str, out: str | Path, capture: str | Path | None = None, names: str = "own"
) -> pycolmap.Reconstruction:
    """Write the triangulated map that a run localized with as a binary COLMAP model.

    All keypoints are written, including those without a point; those of several kinds of features are concatenated. The
    center of the top-left pixel is (0.5, 0.5), as here. The rig frame is that of its first camera, as COLMAP requires;
    rigs with the same cameras at the same poses are merged. Raise ArtifactError if the run has not localized in such a
    map, or that map was built again since, or from other images or features; ManifestError if `out` contains files.
    """
    require_known("names", names, NAMES)
    files, session_id, out = SceneFiles(Path(run), scene), f"{device}_map", Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ManifestError(f"{out}: contains files already. Give an empty or new folder.")
    session = session_of_run(run, scene, session_id, capture)
    maps, keypoints = [], dict[str, NDArray[np.floating]]()
    for path in _maps_of(files, device):
        kind = path.stem.removeprefix(session_id).removeprefix("-") or "sift"  # the naming of `mapping.map_path`
        local_map, store = LocalMap.load(path), FeatureStore.open(only_features(files, session_id, kind))
        require_current(path, "localize", inputs=map_inputs(session, store))
        # In each image, the keypoints of this kind follow those of the kinds before.
        before = [keypoints.get(name, np.zeros((0, 2))) for name in local_map.image_names]
        starts = np.array([len(xy) for xy in before], np.int64)
        maps.append(replace(local_map, obs_keypoint=local_map.obs_keypoint + starts[local_map.obs_image]))
        for name, xy in zip(local_map.image_names, before, strict=True):
            keypoints[name] = np.concatenate([xy, store[name].keypoints])
    model = colmap_model(LocalMap.pooled(maps), session, keypoints, names)
    with write_folder(out) as folder:
        model.write_binary(str(folder))
    return model


def _maps_of(files: SceneFiles, device: str) -> list[Path]:
    """Return the files of the triangulated maps that a run localized with, one per kind of features."""
    for (map_device, _), path in pairs_of(files.poses_dir, ".h5").items():
        if map_device == device and (maps := [files.maps / name for name in names_of_maps(path)]):
            require_current(path.with_suffix(".txt"), "localize", (".npz",))
            return maps
    raise ArtifactError(f"{files.poses_dir}: no query was localized in a triangulated map of {device}. {_LOCALIZE}")


def only_features(files: SceneFiles, session_id: str, kind: str) -> Path:
    """Return the folder of a session's features of a kind. Raise ArtifactError if a run has none or several."""
    folder = files.features / session_id
    stores = [path for path in sorted(folder.glob(f"{kind}-*")) if path.is_dir()]
    if len(stores) != 1:
        found = f"{len(stores)} folders of {kind} features, expected one"
        raise ArtifactError(f"{folder}: {found}. Delete this folder and run the localize stage again.")
    return stores[0]


def colmap_model(
    local_map: LocalMap, session: Session, keypoints: Keypoints, names: str = "own"
) -> pycolmap.Reconstruction:
    """Return a map as a COLMAP model; the map's observations index the keypoints (n, 2) of each image."""
    row_of = session.row_of_name
    if missing := [name for name in local_map.image_names if name not in row_of]:
        raise ArtifactError(f"{session.path}: image {missing[0]} of the map is not in it. Run the map's stages again.")
    rows = np.array([row_of[name] for name in local_map.image_names], np.int64)
    sensors = session.images["sensor_id"].to_numpy(str)[rows]
    model = pycolmap.Reconstruction()
    rigs: dict[object, tuple[int, list[int]]] = {}  # id of each rig and ids of its cameras
    # A frame is all images of a device at a timestamp, in order of camera ids.
    images = session.images.iloc[rows][["timestamp", "sensor_id"]].assign(device=session.device_ids[rows])
    by_frame = images.reset_index(drop=True).sort_values("sensor_id", kind="stable").groupby(["timestamp", "device"])
    for frame_id, members in enumerate((group.index.tolist() for _, group in by_frame), start=1):
        # Captures often have a new rig id for each frame, so a rig is identified by its cameras and their poses.
        rig_from_cams = session.rig_from_cam(rows[members])
        first_from_cams = invert(rig_from_cams[0]) @ rig_from_cams
        key = (tuple(sensors[members]), tuple(np.round(first_from_cams, 12).ravel()))
        if key not in rigs:
            rigs[key] = _add_rig(model, [local_map.cameras[i] for i in members], first_from_cams)
        rig_id, camera_ids = rigs[key]
        frame = pycolmap.Frame()
        frame.frame_id, frame.rig_id = frame_id, rig_id
        for member, camera_id in zip(members, camera_ids, strict=True):
            frame.add_data_id(pycolmap.data_t(model.camera(camera_id).sensor_id, member + 1))
        frame.rig_from_world = _rigid(local_map.cams_from_world[members[0]])
        model.add_frame(frame)
        for member, camera_id in zip(members, camera_ids, strict=True):
            name = local_map.image_names[member]
            image = pycolmap.Image(_exported(name, names), keypoints[name].astype(np.float64), camera_id, member + 1)
            image.frame_id = frame_id
            model.add_image(image)
    for point, (xyz, color) in enumerate(zip(local_map.points, local_map.colors, strict=True)):
        track = pycolmap.Track()
        for obs in local_map.by_point[slice(*local_map.point_starts[point : point + 2])]:
            track.add_element(int(local_map.obs_image[obs]) + 1, int(local_map.obs_keypoint[obs]))
        model.add_point3D(xyz, track, color)
    model.update_point_3d_errors()
    return model


def _add_rig(
    model: pycolmap.Reconstruction, cameras: Sequence[pycolmap.Camera], first_from_cams: Floats
) -> tuple[int, list[int]]:
    rig, camera_ids = pycolmap.Rig(), list[int]()
    rig.rig_id = model.num_rigs() + 1
    for camera, first_from_cam in zip(cameras, first_from_cams, strict=True):
        camera = pycolmap.Camera(camera.todict())
        camera.camera_id = model.num_cameras() + 1  # a copy, because in COLMAP a camera belongs to one rig
        model.add_camera(camera)
        if camera_ids:
            rig.add_sensor(camera.sensor_id, _rigid(invert(first_from_cam)))
        else:
            rig.add_ref_sensor(camera.sensor_id)
        camera_ids.append(camera.camera_id)
    model.add_rig(rig)
    return rig.rig_id, camera_ids


def _rigid(pose: Floats) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])


def export_table(session: Session, out: str | Path, ground_truth: bool = False) -> Path:
    """Write the cameras and poses of a session's images as the table that `interchange.import_images` reads.

    Image names are relative to the session's `raw_data`, poses are world_from_cam: with `ground_truth` the true ones,
    else those of a map. Images without a pose are left out, unless none has one: the table then has cameras only.
    """
    rows = session.camera_rows
    poses = session.world_from_cam(rows, ground_truth)
    if session.split == "query" and not ground_truth:
        poses[:] = np.nan  # odometry is not in the map's frame
    posed = np.isfinite(poses).all((1, 2))
    if posed.any():
        rows, poses = rows[posed], poses[posed]
    table = session.images.iloc[rows][["path"]].rename(columns={"path": "image"}).reset_index(drop=True)
    if posed.any():
        table[list(POSE_NAMES)] = qt_from_pose(poses)
    cameras = session.cameras(rows)
    table["model"] = [camera.model.name for camera in cameras]
    table["width"], table["height"] = [c.width for c in cameras], [c.height for c in cameras]
    table["params"] = [" ".join(repr(float(value)) for value in camera.params) for camera in cameras]
    write_csv(out, table)
    return Path(out)


def export_pairs(
    run: str | Path, scene: str, map_device: str, query_device: str, out: str | Path, topk: int | None = None,
    names: str = "own",
) -> int:  # fmt: skip
    """Write the retrieval of a pair in hloc's format, `query reference` per line, and return the number of lines.

    Queries have `topk` references; None: all. Raise ArtifactError if the run has no such retrieval, it is of older
    vectors or malformed, a name contains a space, or a query and a reference have the same name.
    """
    require_known("names", names, NAMES)
    path = SceneFiles(Path(run), scene).retrieval(map_device, query_device)
    require_current(path, "retrieve", missing=False)
    pairs = []
    for row in read_references(path, "path"):
        paths = [str(entry["path"]) for entry in (row, *row["topk"][:topk])]
        if invalid := [name for name in paths if "/sessions/" not in name]:
            raise ArtifactError(f"{path}: expected images as SCENE/sessions/..., found {invalid[0]!r}. Retrieve again.")
        query, *references = (_listed(image_name(name), names, path) for name in paths)
        pairs += [(query, reference) for reference in references]
    if shared := {query for query, _ in pairs} & {reference for _, reference in pairs}:
        both = f"{min(shared)!r} is the name of a query and of a reference"
        raise ArtifactError(f"{path}: {both}, which hloc cannot tell apart. Use --names capture.")
    return _write_list(out, pairs)


def export_poses(
    run: str | Path, scene: str, map_device: str, query_device: str, out: str | Path, capture: str | Path | None = None,
    names: str = "own",
) -> int:  # fmt: skip
    """Write the poses of a pair's queries in hloc's format, `name qw qx qy qz tx ty tz` for each image.

    Poses are cam_from_world in the unit of the capture; a rig has one line per camera, a query without a pose none.
    Names are complete paths; `file`: file names only, as visuallocalization.net has them. Return the number of lines.
    Raise ArtifactError if the run has no such poses, they are of older references or of an older map, or a name
    contains a space.
    """
    require_known("names", names, NAMES)
    path, lines = _require_poses(SceneFiles(Path(run), scene).poses_txt(map_device, query_device)), []
    session, poses = session_of_run(run, scene, f"{query_device}_query", capture), PairResults.open(path).trajectory
    keys = pd.DataFrame({"timestamp": poses.timestamps, "device_id": poses.device_ids})
    for rows, world_from_rig in zip(session.rows_of_keyframes(keys), poses.world_from_device, strict=True):
        for row, cam_from_world in zip(rows, invert(world_from_rig @ session.rig_from_cam(rows)), strict=True):
            numbers = (repr(float(value)) for value in qt_from_pose(cam_from_world))
            lines.append((_listed(session.image_name(row), names, path), *numbers))
    return _write_list(out, lines)


def export_intrinsics(
    run: str | Path, scene: str, map_device: str, query_device: str, out: str | Path, capture: str | Path | None = None,
    names: str = "own",
) -> int:  # fmt: skip
    """Write the cameras of a pair's queries in hloc's format, `name MODEL width height parameters` for each image.

    Queries without a pose are included. Returns and errors are those of `export_poses`.
    """
    require_known("names", names, NAMES)
    path = _require_poses(SceneFiles(Path(run), scene).poses_csv(map_device, query_device))
    session = session_of_run(run, scene, f"{query_device}_query", capture)
    rows = [row for rows in session.rows_of_keyframes(PairResults.open(path).table) for row in rows]
    cameras = [camera_text(camera).replace(",", "") for camera in session.cameras(rows)]
    listed = [_listed(session.image_name(row), names, path) for row in rows]
    return _write_list(out, zip(listed, cameras, strict=True))


def _write_list(out: str | Path, rows: Iterable[tuple[str, ...]]) -> int:
    lines = [f"{' '.join(row)}\n" for row in rows]
    write_text(out, "".join(lines))
    return len(lines)


def _exported(name: str, names: str) -> str:
    return own_name(name) if names == "own" else name if names == "capture" else name.rpartition("/")[2]


def _listed(name: str, names: str, path: Path) -> str:
    """Return the exported name of an image. Raise ArtifactError if it contains the separator of hloc's lists."""
    name = _exported(name, names)
    if len(name.split()) != 1:
        raise ArtifactError(f"{path}: hloc's lists cannot hold the space in {name!r}. Rename the image.")
    return name


def _require_poses(path: Path) -> Path:
    """Return the path of a result of the localize stage. Raise ArtifactError if it is missing or outdated."""
    if not path.is_file():
        raise ArtifactError(f"No poses: {path} is missing. {_LOCALIZE}")
    require_current(path.with_suffix(".txt"), "localize", missing=False)
    return path


def session_of_run(run: str | Path, scene: str, session_id: str, capture: str | Path | None) -> Session:
    """Return a session of a run's capture, which may have moved to `capture`."""
    with open_captures([Path(run)], [] if capture is None else [capture], [scene]) as capture_of:
        return capture_of(scene)[session_id]


# Features and matches of hloc


def export_features(run: str | Path, scene: str, session: str, out: str | Path, kind: str = "sift") -> int:
    """Write the features of a session, such as `ios_map`, as a file of hloc; return the number of images.

    Raise ArtifactError if the run has no such features, or several.
    """
    store = FeatureStore.open(only_features(SceneFiles(Path(run), scene), session, kind))
    write_groups(Path(out), ((name, _to_hloc(store[name])) for name in store), {PIXEL_CENTER: 0.0})
    return len(store)


def _to_hloc(features: LocalFeatures) -> dict[str, NDArray[Any]]:
    descriptors = features.descriptors
    if descriptors.dtype == np.uint8:  # without loss: a byte over a power of two has 8 significant bits, float16 has 11
        descriptors = (descriptors / np.float32(DESCRIPTOR_SCALE)).astype(np.float16)
    size = np.array(features.image_size, np.int64)
    arrays = {"keypoints": features.keypoints - _HALF_PIXEL, "scales": features.scales, "scores": features.scores}
    return arrays | {"descriptors": np.ascontiguousarray(descriptors.T), "image_size": size}


def import_features(path: str | Path, out: str | Path) -> FeatureStore:
    """Copy a file of features, by hloc or `export_features`, to a folder, and return its content.

    Raise ArtifactError if the file is missing, torn, or has no features in the layout of hloc.
    """
    path, made_from = Path(path), files_fingerprint([Path(path)])
    with _opened(path) as file, Items(out, {"name": "hloc"}) as items:
        offset = _HALF_PIXEL - np.float32(file.attrs.get(PIXEL_CENTER, 0.0))
        names = group_names_of(file, "keypoints")
        if not names:
            raise ArtifactError(f"{path} holds no local features; expected a group with `keypoints` for each image.")
        for name in names:
            try:
                features = _from_hloc(read_group(file, name), offset)
            except HDF5_ERRORS as error:
                why = f"{path}: {name} is not in the layout of hloc ({first_line(error)})."
                raise DamagedError(path, why) from None
            write_features(items, name, made_from, features)
    return FeatureStore.open(out)


def _from_hloc(arrays: Mapping[str, NDArray[Any]], offset: np.float32) -> LocalFeatures:
    """Return the features of an image; files of hloc may lack scores, and lack scales. Raise ValueError or KeyError."""
    keypoints = arrays["keypoints"].astype(np.float32, copy=False) + offset
    descriptors, (width, height) = arrays["descriptors"], arrays["image_size"].tolist()
    ones = np.ones(len(keypoints), np.float32)
    scales, scores = arrays.get("scales", ones), arrays.get("scores", ones)
    shapes = [keypoints.shape, scales.shape, scores.shape, descriptors.shape]
    count = shapes[0][0] if keypoints.ndim == 2 else 0
    if shapes != [(count, 2), (count,), (count,), (*descriptors.shape[:1], count)] or descriptors.dtype.kind != "f":
        raise ValueError(f"keypoints, scales, scores and {descriptors.dtype} descriptors have the shapes {shapes}")
    scales, scores = (array.astype(np.float32, copy=False) for array in (scales, scores))
    return LocalFeatures(keypoints, scales, scores, np.ascontiguousarray(descriptors.T), (int(width), int(height)))


def export_matches(
    run: str | Path, scene: str, session0: str, session1: str, out: str | Path, kind: str = "sift",
    capture: str | Path | None = None,
) -> int:  # fmt: skip
    """Write the matches of two sessions as a file of hloc, and return the number of pairs.

    Sessions are such as `ios_query` and `ios_map`; twice the same for the pairs of a map, whose `capture` may have
    moved. Raise ArtifactError if the run has no such matches, those of several settings or of older features, or pairs
    that hloc cannot tell apart.
    """
    files = SceneFiles(Path(run), scene)
    folder = files.maps / f"{session0}-{session1}"
    tiles = [Items(path) for path in sorted(folder.glob(f"{kind}-*")) if path.is_dir()]  # a large map has several
    made_by = [{key: value for key, value in tile.made_by.items() if key != "tile"} for tile in tiles if tile]
    if not made_by or any(other != made_by[0] for other in made_by):
        found = f"found matches of {kind} of {len(made_by)} settings, expected one"
        raise ArtifactError(f"{folder}: {found}. Delete this folder and run the localize stage again.")
    paths = zip((session0, session1), made_by[0]["features"], strict=True)
    first, second = (FeatureStore.open(features_path(files.features, *of_session)) for of_session in paths)
    of_map, path = session0 == session1, map_path(files.maps, session0, kind)
    if of_map and (read_sidecar(path) or {}).get("inputs"):
        require_current(path, "localize", inputs=map_inputs(session_of_run(run, scene, session0, capture), first))
    groups: dict[str, tuple[str, str]] = {}
    older: list[tuple[str, str]] = []

    def written() -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        for tile in tiles:
            matches = MatchStore(tile.folder, tile)
            for item in tile:
                name0, _, name1 = item.partition("\n")
                names = name0, name1
                if not of_map and tile.source(item) != first.made_from.get(name0, "") + second.made_from.get(name1, ""):
                    older.append(names)
                    continue
                if names != groups.setdefault(_group(*names), names):
                    other = groups[_group(*names)]
                    raise ArtifactError(f"{folder}: hloc cannot tell the pairs {names} and {other} apart. Rename one.")
                yield _group(*names), _matches_to_hloc(matches[names], len(first[names[0]]))

    write_groups(Path(out), written(), {})
    if older:
        log.warning("%s: %d pairs of older features are left out. Run the localize stage again.", folder, len(older))
    return len(groups)


def _matches_to_hloc(matches: PairMatches, count: int) -> dict[str, NDArray[Any]]:
    # 16 bits as in hloc; few networks find more features.
    matches0 = np.full(count, -1, np.int16 if matches.indices.max(initial=0) <= np.iinfo(np.int16).max else np.int32)
    scores = np.zeros(count, np.float16)
    matches0[matches.indices[:, 0]] = matches.indices[:, 1]
    scores[matches.indices[:, 0]] = matches.scores
    return {"matches0": matches0, "matching_scores0": scores}


def import_matches(path: str | Path, pairs: Iterable[tuple[str, str]], out: str | Path) -> MatchStore:
    """Copy matches of pairs of images, by name in either order, from a file of hloc to a folder; return its content.

    Raise ArtifactError if the file is missing, torn or of another layout, or lacks a pair.
    """
    path, made_from = Path(path), files_fingerprint([Path(path)])
    with _opened(path) as file, Items(out, {"name": "hloc"}) as items:
        for names in pairs:
            step = next((step for step in (1, -1) if has_group(file, _group(*names[::step]))), 0)
            if not step:
                raise ArtifactError(f"{path}: has no matches of {names[0]} and {names[1]}.")
            arrays = read_group(file, _group(*names[::step]))
            partners, scores = (arrays.get(key, np.zeros(())) for key in ("matches0", "matching_scores0"))
            if partners.ndim != 1 or partners.dtype.kind not in "iu" or scores.shape != partners.shape:
                expected = "expected matches0 (N,), whole numbers, and matching_scores0 (N,)"
                raise DamagedError(path, f"{path}: {names} are not in the layout of hloc; {expected}.")
            at = np.flatnonzero(partners >= 0)
            indices = np.stack([at, partners[at].astype(np.int64)], axis=1)[:, ::step]
            write_matches(items, match_name(*names), made_from, PairMatches(indices, scores[at].astype(np.float32)))
    return MatchStore(out)


def _group(name0: str, name1: str) -> str:
    return f"{name0.replace('/', '-')}/{name1.replace('/', '-')}"


def _opened(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise ArtifactError(f"{path} cannot be read as HDF5 ({first_line(error)}).") from None


# Results on the Earth


def geo_table(run: str | Path, capture: str | Path | None = None) -> pd.DataFrame:
    """Return a row per query image of a run and map with an origin: `KEYS`, `georeference.GEO_COLUMNS`, `num_inliers`,
    `position_std_m` with that of the map's place, `path`, the file, and `sure`, whether the status is `ok`. The pose's
    columns are NaN without a pose.

    Raise CaptureError if no map has an origin; ArtifactError if there are no poses, or only outdated ones.
    """
    run, tables, refused = Path(run), list[pd.DataFrame](), list[CaptureError]()
    scenes = localized_scenes(run)
    with open_captures([run], [] if capture is None else [capture], scenes) as capture_of:
        for scene in scenes:
            for (map_device, query_device), path in pairs_of(SceneFiles(run, scene).poses_dir).items():
                results = PairResults.open(path)
                require_current(results.path, "localize", missing=False)
                mapped = capture_of(scene)[f"{map_device}_map"]
                try:
                    origin = origin_of(mapped)
                except CaptureError as error:
                    refused.append(error)
                    continue
                table = _table_of(results, capture_of(scene)[f"{query_device}_query"], origin, scene)
                table["position_std_m"] = np.hypot(table["position_std_m"], deviation_of(mapped))
                tables.append(table)
    if not tables:
        raise refused[0] if refused else ArtifactError(f"{run}: no query was localized. Run the localize stage first.")
    return pd.concat(tables, ignore_index=True)


def _table_of(results: PairResults, session: Any, origin: Floats, scene: str) -> pd.DataFrame:
    of_query = session.rows_of_keyframes(results.table)
    numbers = np.repeat(np.arange(len(results)), [*map(len, of_query)])
    rows = [int(row) for images in of_query for row in images]
    table = results.table.iloc[numbers].reset_index(drop=True)
    world_from_cams = results.poses[numbers] @ session.rig_from_cam(rows)
    table = table.assign(
        sure=table["status"] == Status.OK, status=table["status_text"],
        scene=scene, map_device=results.devices[0], query_device=results.devices[1],
        image=[session.image_name(row) for row in rows], path=[session.image_path(row) for row in rows],
    )  # fmt: skip
    table[list(GEO_COLUMNS)] = geographic_poses(world_from_cams, origin)
    return table.reindex(columns=[*KEYS, *GEO_COLUMNS, "num_inliers", "position_std_m", "path", "sure"])


def export_geo(run: str | Path, out: str | Path, capture: str | Path | None = None) -> int:
    """Write `geo_table` as CSV, or as GeoJSON (RFC 7946), where images without a pose have no geometry.

    Return the number of images with a pose. Raise ManifestError for another ending of the file's name; and as
    `geo_table`.
    """
    out = Path(out)
    if out.suffix.lower() not in FORMATS:
        raise ManifestError(f"{out}: found the ending {out.suffix!r}, expected {' or '.join(FORMATS)}.")
    table = geo_table(run, capture).drop(columns=["path", "sure"])
    table["image"] = table["image"].map(own_name)
    if out.suffix.lower() == ".csv":
        write_csv(out, table)
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
    """Write copies of the query images with position and direction in EXIF; the pixels of JPEGs stay byte for byte.

    With `xmp`, write XMP files with these tags instead, `a.xmp` of `a.jpg`, to lie beside the images. Of an image
    that was localized in several maps, the pose with the most inliers, then the surest, is taken; with `unsure`, also
    one of low confidence. Times and other tags stay. Return the number of images. Raise ManifestError if `out`
    contains files, or two XMP files would have one name; ImageError if an image cannot be read; and as `geo_table`.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ManifestError(f"{out}: contains files already. Give an empty or new folder.")
    table = geo_table(run, capture)
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
            raise ManifestError(f"xmp: two images would have the file {names[names.duplicated()].iloc[0]}.")
    with write_folder(out) as folder:
        for name, row in zip(names, table.to_dict("records"), strict=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            if xmp:
                write_text(folder / name, _xmp(row))
            else:
                _write_with_gps(Path(row["path"]), folder / name, row)
    return len(table)


def _degrees(value: float) -> tuple[int, int, float]:
    parts = round(abs(value) * 3600 * _DENOMINATOR)
    minutes, seconds = divmod(parts, 60 * _DENOMINATOR)
    return *divmod(minutes, 60), seconds / _DENOMINATOR


def _write_with_gps(source: Path, target: Path, row: Mapping[Any, Any]) -> None:
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
            if not jpeg.startswith(b"\xff\xd8"):  # of a JPEG with several images, Pillow says MPO
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
