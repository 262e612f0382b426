"""Export for other tools: a COLMAP model of the map; retrieval, poses and intrinsics as hloc lists; a table of poses.

`names="own"` gives images the names that the user knows (`files.own_name`): an imported image has its path in the
folder it was imported from, other images have their path relative to the capture's folder `sessions`. With
`names="capture"` all paths are relative to `sessions`, as in files of local features and matches, see `exchange.hloc`.

The run records where its captures are; `capture` is the new folder of one that has moved. All exports raise
ManifestError for an unknown choice of names, a capture that is in neither place, or a capture with another name.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from toolkit.capture import Session, Trajectory
from toolkit.capture.cameras import camera_text
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import COMMAND, ArtifactError, ManifestError
from toolkit.exchange.submission import open_captures
from toolkit.features.stores import FeatureStore
from toolkit.files import (
    SceneFiles,
    image_name,
    own_name,
    pair_name,
    read_references,
    require_current,
    require_whole,
    write_atomic,
    write_folder,
    write_text,
)
from toolkit.geometry import Floats, invert, pose_from_qt, qt_from_pose
from toolkit.manifest import nearest
from toolkit.mapping.local_map import LocalMap
from toolkit.results.opening import map_inputs
from toolkit.results.pair import PairResults, names_of_maps

NAMES = ("own", "capture", "file")
_LOCALIZE = f"Run the localize stage first ({COMMAND} run MANIFEST --only localize)."
Keypoints = Mapping[str, NDArray[np.floating]]


def export_colmap(
    run: str | Path, scene: str, device: str, out: str | Path, capture: str | Path | None = None, names: str = "own"
) -> pycolmap.Reconstruction:
    """Write the triangulated map that a run localized with as a binary COLMAP model.

    All keypoints are written, including those without a point. Pixel coordinates are the same in COLMAP and here: the
    center of the top-left pixel is (0.5, 0.5). If the run used several kinds of features, their keypoints and points
    are concatenated. The rig frame is the frame of its first camera, as COLMAP requires; rigs with the same cameras at
    the same poses are merged into one.

    Raises:
        ArtifactError: the run has not localized in such a map, the map was built again since, or it was built from
            other images or features than those that are there.
        ManifestError: the folder `out` contains files.
    """
    _require_names(names)
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
    for path in sorted(files.poses_dir.glob(f"{pair_name(files.scene, device, '*')}.h5")):
        maps = [files.maps / name for name in names_of_maps(path)]
        if maps:
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
    missing = [name for name in local_map.image_names if name not in row_of]
    if missing:
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
    """Add a rig and its cameras to a model; return their ids."""
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

    Image names are relative to the session's `raw_data`, poses are world_from_cam. If some images have poses, the
    others are left out. If none has, the table has cameras only. With `ground_truth`, poses are those of
    `session.ground_truth`; otherwise, map sessions have those of `session.trajectory` and query sessions none.
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
    with write_atomic(out) as temporary:
        table.to_csv(temporary, index=False)
    return Path(out)


def export_pairs(
    run: str | Path, scene: str, map_device: str, query_device: str, out: str | Path, topk: int | None = None,
    names: str = "own",
) -> int:  # fmt: skip
    """Write the retrieval of a pair in hloc's format, `query reference` per line, and return the number of lines.

    Queries have `topk` references; None: all retrieved ones. Raise ArtifactError if the run has no such retrieval, it
    is of older vectors, a line of it is malformed, a name contains a space, or a query and a reference have the same
    name.
    """
    _require_names(names)
    path = SceneFiles(Path(run), scene).retrieval(map_device, query_device)
    require_current(path, "retrieve", missing=False)
    pairs = []
    for row in read_references(path, "path"):
        paths = [str(entry["path"]) for entry in (row, *row["topk"][:topk])]
        invalid = [name for name in paths if "/sessions/" not in name]
        if invalid:
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

    Poses are cam_from_world in the unit of the capture; a rig has one line per camera. Queries without a pose are left
    out. Names are complete paths; `file`: file names only, as hloc and visuallocalization.net have them. Return the
    number of lines. Raise ArtifactError if the run has no such poses, they are of older references or of an older map,
    or a name contains a space.
    """
    _require_names(names)
    path = _require_poses(SceneFiles(Path(run), scene).poses_txt(map_device, query_device))
    session, poses = session_of_run(run, scene, f"{query_device}_query", capture), Trajectory.read(path)
    lines = []
    keys = pd.DataFrame({"timestamp": poses.timestamps, "device_id": poses.device_ids})
    for rows, world_from_rig in zip(session.rows_of_keyframes(keys), pose_from_qt(poses.qt), strict=True):
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
    _require_names(names)
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


def _require_names(names: str) -> None:
    if names not in NAMES:
        raise ManifestError(f"names: unknown {names!r}. {nearest(names, NAMES)}")


def _exported(name: str, names: str) -> str:
    """Return the exported name of an image, given its name in the capture."""
    return own_name(name) if names == "own" else name if names == "capture" else name.rpartition("/")[2]


def _listed(name: str, names: str, path: Path) -> str:
    """Return the exported name of an image. Raise ArtifactError if it contains the separator of hloc's lists."""
    name = _exported(name, names)
    if len(name.split()) != 1:
        raise ArtifactError(f"{path}: hloc's lists cannot hold the space in {name!r}. Rename the image.")
    return name


def _require_poses(path: Path) -> Path:
    """Return the path of a result of the localize stage. Raise ArtifactError if it is missing or damaged."""
    if not path.is_file():
        raise ArtifactError(f"No poses: {path} is missing. {_LOCALIZE}")
    require_whole(path, of=path.with_suffix(".txt"))
    require_current(path.with_suffix(".txt"), "localize", missing=False)
    return path


def session_of_run(run: str | Path, scene: str, session_id: str, capture: str | Path | None) -> Session:
    """Return a session of a run's capture, which may have moved to `capture`."""
    with open_captures([Path(run)], [] if capture is None else [capture], [scene]) as capture_of:
        return capture_of(scene)[session_id]
