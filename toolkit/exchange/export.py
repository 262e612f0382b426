"""What other tools read: the map as a COLMAP model, retrieval as a list of pairs for hloc."""

import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.capture import Session
from toolkit.capture.tables import POSE_NAMES
from toolkit.errors import ArtifactError, ManifestError
from toolkit.exchange.submission import Captures
from toolkit.features.stores import FeatureStore
from toolkit.files import SceneFiles, image_name, read_references, write_atomic, write_text
from toolkit.geometry import invert, qt_from_pose
from toolkit.localizers.mapping import LocalMap


def export_colmap(
    run: str | Path, scene: str, device: str, out: str | Path, capture: str | Path | None = None
) -> pycolmap.Reconstruction:
    """Write the triangulated map of a run as a COLMAP model, binary.

    Image names are relative to the capture's folder `sessions`. All keypoints are written, also those that see no
    point, in COLMAP's pixels, which are ours: the center of the top-left pixel is (0.5, 0.5). A rig's frame is that of
    its first camera, as COLMAP wants it; rigs with the same cameras at the same places are one rig.

    Args:
        run: the run folder.
        scene: the capture's name.
        device: whose map.
        out: folder of the model; it must be empty or absent.
        capture: the capture, where it is no longer where the run found it.

    Raises:
        ArtifactError: the run has no such map.
        ManifestError: there are files in `out`, or the capture is not found.
    """
    files, session_id, out = SceneFiles(Path(run), scene), f"{device}_map", Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ManifestError(f"{out}: there are files already. Give an empty or new folder.")
    session = Captures([Path(run)], [] if capture is None else [capture], [scene])[scene][session_id]
    local_map = LocalMap.load(files.maps / f"{session_id}.npz")
    model = colmap_model(local_map, session, FeatureStore.of_session(files.features, session_id))
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as folder:
        part = Path(folder) / "model"
        part.mkdir()
        model.write_binary(str(part))
        if out.exists():
            out.rmdir()
        part.rename(out)
    return model


def colmap_model(local_map: LocalMap, session: Session, store: FeatureStore) -> pycolmap.Reconstruction:
    """Return a map as a COLMAP model.

    Args:
        local_map: the map of the session.
        session: what the images were taken with.
        store: local features of its images.

    Raises:
        ArtifactError: the session does not list an image of the map.
    """
    row_of = {session.image_name(row): row for row in range(len(session.images))}
    unknown = [name for name in local_map.image_names if name not in row_of]
    if unknown:
        raise ArtifactError(f"{session.path}: image {unknown[0]} of the map is not in it. Run the map's stages again.")
    rows = np.array([row_of[name] for name in local_map.image_names], np.int64)
    sensors = session.images["sensor_id"].to_numpy(str)[rows]
    frames = _frames(session, rows)
    model = pycolmap.Reconstruction()
    builder = _Builder(model)
    for frame_id, members in enumerate(frames, start=1):
        # Rig ids are often made anew for each frame; the cameras and their places say which rig it is.
        rig_from_cams = session.rig_from_cam(rows[members])
        rig_id, camera_ids = builder.rig(
            [str(sensor) for sensor in sensors[members]], [local_map.cameras[i] for i in members], rig_from_cams
        )
        frame = pycolmap.Frame()
        frame.frame_id, frame.rig_id = frame_id, rig_id
        for member, camera_id in zip(members, camera_ids, strict=True):
            frame.add_data_id(pycolmap.data_t(model.camera(camera_id).sensor_id, int(member) + 1))
        frame.rig_from_world = _rigid(local_map.cams_from_world[members[0]])
        model.add_frame(frame)
        for member, camera_id in zip(members, camera_ids, strict=True):
            keypoints = store[local_map.image_names[member]].keypoints.astype(np.float64)
            image = pycolmap.Image(
                name=local_map.image_names[member], keypoints=keypoints, camera_id=camera_id, image_id=int(member) + 1
            )
            image.frame_id = frame_id
            model.add_image(image)
    order = np.argsort(local_map.obs_point, kind="stable")
    starts = np.searchsorted(local_map.obs_point[order], np.arange(len(local_map.points) + 1))
    for point, (xyz, color) in enumerate(zip(local_map.points, local_map.colors, strict=True)):
        track = pycolmap.Track()
        for obs in order[starts[point] : starts[point + 1]]:
            track.add_element(int(local_map.obs_image[obs]) + 1, int(local_map.obs_keypoint[obs]))
        model.add_point3D(xyz, track, color)
    model.update_point_3d_errors()
    return model


def export_table(session: Session, out: str | Path, ground_truth: bool = False) -> Path:
    """Write the cameras and poses of a session's images as the table that `interchange.import_images` reads.

    Image names are relative to the session's `raw_data`, poses are world_from_cam. Without any pose the table has
    cameras only; an image without a pose is left out where others have one.

    Args:
        session: the session.
        out: the CSV file.
        ground_truth: write the poses of `session.ground_truth`, instead of `session.trajectory`.
    """
    rows = session.camera_rows
    poses = session.world_from_cam(rows, ground_truth)
    posed = np.isfinite(poses).all((1, 2))
    if posed.any():
        rows, poses = rows[posed], poses[posed]
    table = session.images.iloc[rows][["path"]].rename(columns={"path": "image"}).reset_index(drop=True)
    if posed.any():
        table[list(POSE_NAMES)] = qt_from_pose(poses)
    cameras = [session.camera(str(sensor)) for sensor in session.images["sensor_id"].iloc[rows]]
    table["model"] = [camera.model.name for camera in cameras]
    table["width"], table["height"] = [c.width for c in cameras], [c.height for c in cameras]
    table["params"] = [" ".join(repr(float(value)) for value in camera.params) for camera in cameras]
    with write_atomic(out) as temporary:
        table.to_csv(temporary, index=False)
    return Path(out)


def export_pairs(
    run: str | Path, scene: str, map_device: str, query_device: str, out: str | Path, topk: int | None = None
) -> int:
    """Write the retrieval of a pair as hloc reads it, `query reference` a line, and return the number of lines.

    Names are relative to the capture's folder `sessions`, as those of `export_colmap`.

    Args:
        run, scene: the run folder, and the capture's name.
        map_device, query_device: the pair.
        out: the text file.
        topk: so many references a query; None: all that were retrieved.

    Raises:
        ArtifactError: the run has no such retrieval, a line of it is malformed, or a name has a space in it.
    """
    path = SceneFiles(Path(run), scene).retrieval(map_device, query_device)
    pairs = []
    for row in read_references(path, "path"):
        paths = [str(entry["path"]) for entry in (row, *row["topk"][:topk])]
        strange = [name for name in paths if "/sessions/" not in name]
        if strange:
            raise ArtifactError(f"{path}: expected images as SCENE/sessions/..., found {strange[0]!r}. Retrieve again.")
        names = [image_name(name) for name in paths]
        spaced = [name for name in names if len(name.split()) != 1]
        if spaced:
            raise ArtifactError(f"{path}: hloc's lists cannot hold the space in {spaced[0]!r}.")
        pairs += [f"{names[0]} {name}" for name in names[1:]]
    write_text(out, "".join(f"{pair}\n" for pair in pairs))
    return len(pairs)


class _Builder:
    """Adds cameras and rigs to a model, each once."""

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self._model = model
        self._rigs: dict[object, tuple[int, dict[str, int]]] = {}

    def rig(
        self, sensors: list[str], cameras: list[pycolmap.Camera], rig_from_cams: NDArray[np.float64]
    ) -> tuple[int, list[int]]:
        """Return the id of the rig of these cameras, and those of its cameras."""
        places = tuple(np.round(invert(rig_from_cams[0]) @ rig_from_cams, 12).ravel().tolist())
        key = (tuple(sensors), places)
        if key not in self._rigs:
            rig, camera_ids = pycolmap.Rig(), {}
            rig.rig_id = len(self._rigs) + 1
            for index, (sensor, known) in enumerate(zip(sensors, cameras, strict=True)):
                camera = pycolmap.Camera(known.todict())
                # COLMAP lets a camera be in one rig only.
                camera.camera_id = camera_ids[sensor] = self._model.num_cameras() + 1
                self._model.add_camera(camera)
                if index == 0:
                    rig.add_ref_sensor(camera.sensor_id)
                else:
                    rig.add_sensor(camera.sensor_id, _rigid(invert(rig_from_cams[index]) @ rig_from_cams[0]))
            self._model.add_rig(rig)
            self._rigs[key] = rig.rig_id, camera_ids
        rig_id, camera_ids = self._rigs[key]
        return rig_id, [camera_ids[sensor] for sensor in sensors]


def _frames(session: Session, rows: NDArray[np.int64]) -> list[list[int]]:
    """Return the positions in `rows` of the images of each device at each time, cameras in order of their ids."""
    images = session.images.iloc[rows]
    keys = zip(images["timestamp"].tolist(), session.device_ids[rows], images["sensor_id"], strict=True)
    frames: dict[tuple[int, str], list[tuple[str, int]]] = {}
    for position, (time, device, sensor) in enumerate(keys):
        frames.setdefault((time, device), []).append((sensor, position))
    return [[position for _, position in sorted(members)] for _, members in sorted(frames.items())]


def _rigid(pose: NDArray[np.float64]) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
