"""Rerun recordings to walk around in: maps, and queries in them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray

from toolkit.figures import ESTIMATED, MAP, TRUE
from toolkit.files import write_atomic
from toolkit.geometry import rotation_to_quaternion
from toolkit.images import read_for_display
from toolkit.top_view import places_of
from toolkit.upright import up_of_cameras

if TYPE_CHECKING:
    import rerun as rr

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Views:
    """Posed photographs, to be drawn as cameras."""

    world_from_cam: Array
    """(N, 4, 4); NaN for a photograph without a pose."""
    cameras: Sequence[pycolmap.Camera]
    images: Sequence[Path | Image]
    """Files, or (H, W, 3) uint8 RGB."""
    names: Sequence[str]


@dataclass(frozen=True)
class Queries:
    """Results of the queries of one device."""

    estimated: Array
    """world_from_cam, (Q, 4, 4); NaN where there is no pose."""
    true: Array | None = None
    """The same, true; None where there is no ground truth."""
    names: Sequence[str] = ()
    status: Sequence[str] = ()
    views: Views | None = None
    """A photograph a query, at its estimated pose."""


def _known(poses: Array) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(poses).all((1, 2)), bool)


def _finite(poses: ArrayLike) -> Array:
    poses = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    return poses[_known(poses)]


def record_scene(
    out: str | Path,
    map_views: Views,
    points: ArrayLike,
    colors: NDArray[np.uint8] | None,
    queries: Mapping[str, Queries],
    up: ArrayLike | None = None,
    max_images: int = 60,
    image_size: int = 480,
    name: str = "scene",
) -> Path:
    """Write a rerun recording (.rrd) of a map and of queries in it, and return its path.

    Entities: `world/map/{points,trajectory,cameras/<k>}` and, for each device,
    `world/queries/<device>/{estimated,true,error,view}`; `view` and `query/<device>` (its image)
    change along the timeline `query`: one steps through the queries. Open it with `rerun FILE`.

    Args:
        out: file to write.
        map_views: all map images; at most `max_images`, a regular choice, are drawn with their picture.
        points: (P, 3), metres.
        colors: (P, 3) RGB or None.
        queries: results by device.
        up: direction (3,) that is up; None: estimated from the map's cameras.
        max_images: pictures at most of the map, and of each device's queries.
        image_size: longer side of the pictures, pixels.
        name: of the recording.
    """
    import rerun as rr

    poses = _finite(map_views.world_from_cam)
    up = np.asarray(up_of_cameras(poses) if up is None else up, np.float64)
    size = _camera_size(poses)
    pictured = [device for device, results in queries.items() if results.views is not None]
    with write_atomic(out) as temporary:
        # A fixed id: opened again after another run, it replaces the old one in the viewer.
        stream = rr.RecordingStream("visual-localization", recording_id=name)
        # Before the first entity: batches are handed to the file as they fill.
        stream.save(temporary, default_blueprint=_blueprint(pictured, poses, up))
        stream.send_recording_name(name)
        stream.log("world", _view_coordinates(up), static=True)
        stream.log(
            "world/map/points",
            rr.Points3D(points, colors=colors, radii=rr.Radius.ui_points(1.5)),
            static=True,
        )
        _log_trajectory(stream, map_views)
        for k in _choice(len(map_views.images), max_images):
            entity = f"world/map/cameras/{k}"
            _log_view(stream, entity, map_views, int(k), image_size, size, MAP, static=True)
        for device, results in queries.items():
            _log_queries(stream, device, results, max_images, image_size, size)
        stream.flush()
        stream.disconnect()
    return Path(out)


def _blueprint(devices: list[str], poses: Array, up: Array) -> Any:
    """Return the layout of the viewer: from behind and above the place with the most cameras, at rest."""
    import rerun.blueprint as rrb

    eye = None
    if len(poses):
        place = places_of(poses[:, :3, 3])
        here = poses[place == np.bincount(place).argmax()]
        centre, view = here[:, :3, 3].mean(0), here[:, :3, 2].mean(0)
        view -= up * (view @ up)
        reach = max(3.0, float(np.linalg.norm(np.ptp(here[:, :3, 3], axis=0))))
        target = centre + 0.3 * reach * view
        eye = rrb.EyeControls3D(
            position=target - reach * view + 0.7 * reach * up, look_target=target, eye_up=up
        )
    scene = rrb.Spatial3DView(origin="world", name="map and queries", eye_controls=eye)
    time = rrb.TimePanel(state="collapsed", timeline="query", play_state="paused")
    if not devices:
        return rrb.Blueprint(scene, time, collapse_panels=True)
    images = rrb.Vertical(*[rrb.Spatial2DView(origin=f"query/{d}", name=f"{d} query") for d in devices])
    return rrb.Blueprint(rrb.Horizontal(scene, images, column_shares=[3, 1]), time, collapse_panels=True)


def _view_coordinates(up: Array) -> Any:
    import rerun as rr

    axis = int(np.argmax(np.abs(up)))
    return getattr(rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}")


def _log_trajectory(stream: "rr.RecordingStream", views: Views) -> None:
    """Log one line a folder of images, in order of names: recordings joined would draw paths nobody went."""
    import rerun as rr

    finite = np.isfinite(views.world_from_cam).all((1, 2))
    centres = views.world_from_cam[:, :3, 3]
    tracks: dict[str, list[Array]] = {}
    for k in sorted(np.flatnonzero(finite).tolist(), key=lambda k: views.names[k]):
        tracks.setdefault(str(views.names[k]).rpartition("/")[0], []).append(centres[k])
    strips = [np.array(track) for track in tracks.values()]
    stream.log("world/map/trajectory", rr.LineStrips3D(strips, colors=_rgb(MAP)), static=True)


def _log_queries(
    stream: "rr.RecordingStream", device: str, results: Queries, max_images: int, image_size: int, size: float
) -> None:
    import rerun as rr

    root = f"world/queries/{device}"
    estimated = np.asarray(results.estimated, np.float64)
    found = _known(estimated)
    labels = list(results.names) or [str(k) for k in range(len(estimated))]

    def log_points(entity: str, poses: Array, rows: NDArray[np.bool_], colour: str) -> None:
        names = [labels[k] for k in np.flatnonzero(rows)]
        dots = rr.Points3D(
            poses[rows, :3, 3],
            colors=_rgb(colour),
            radii=rr.Radius.ui_points(4),
            labels=names,
            show_labels=False,
        )
        stream.log(f"{root}/{entity}", dots, static=True)

    log_points("estimated", estimated, found, ESTIMATED)
    if results.true is not None:
        true = np.asarray(results.true, np.float64)
        known = _known(true)
        log_points("true", true, known, TRUE)
        both = found & known
        lines = np.stack([estimated[both, :3, 3], true[both, :3, 3]], axis=1)
        stream.log(f"{root}/error", rr.LineStrips3D(list(lines), colors=_rgb(ESTIMATED)), static=True)
    if results.views is None:
        return
    for k in _choice(len(estimated), max_images):
        stream.set_time("query", sequence=int(k))
        text = f"{labels[k]}: {results.status[k]}" if len(results.status) else labels[k]
        stream.log(f"query/{device}/text", rr.TextLog(text))
        image = _small_jpeg(results.views.images[k], image_size)[0]
        stream.log(f"query/{device}", image)
        if not found[k]:
            stream.log(f"{root}/view", rr.Clear(recursive=True))  # or the last one's camera would stay
        _log_view(
            stream, f"{root}/view", results.views, int(k), image_size, 2 * size, ESTIMATED, static=False
        )
    stream.reset_time()


def _log_view(
    stream: "rr.RecordingStream",
    entity: str,
    views: Views,
    k: int,
    image_size: int,
    size: float,
    colour: str,
    static: bool,
) -> None:
    """Log a posed photograph; nothing where it has no pose."""
    import rerun as rr

    pose = np.asarray(views.world_from_cam[k], np.float64)
    if not np.isfinite(pose).all():
        return
    image, scale = _small_jpeg(views.images[k], image_size)
    camera = views.cameras[k]
    w, x, y, z = rotation_to_quaternion(pose[:3, :3])
    stream.log(
        entity,
        rr.Transform3D(translation=pose[:3, 3], quaternion=rr.Quaternion(xyzw=[x, y, z, w])),
        static=static,
    )
    # Rerun draws pinholes; distortion is left out, which at this size does not show.
    pinhole = rr.Pinhole(
        image_from_camera=np.diag([scale, scale, 1.0]) @ camera.calibration_matrix(),
        resolution=[round(camera.width * scale), round(camera.height * scale)],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=size,
        color=_rgb(colour),
    )
    stream.log(entity, pinhole, static=static)
    stream.log(f"{entity}/image", image, static=static)


def _small_jpeg(source: Path | Image, size: int) -> tuple[Any, float]:
    """Return a picture reduced to `size` pixels on its longer side, as JPEG, and its scale."""
    import rerun as rr

    image = read_for_display(source) if isinstance(source, str | Path) else source
    scale = min(1.0, size / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    bgr = np.ascontiguousarray(small[..., ::-1]) if small.ndim == 3 else small
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg"), scale


def _camera_size(poses: Array) -> float:
    """Return how deep to draw a camera, metres: about half the usual step between neighbours."""
    from scipy.spatial import cKDTree

    spots = np.unique(np.round(poses[:, :3, 3], 2), axis=0)
    if len(spots) < 2:
        return 0.3
    return float(np.clip(np.median(cKDTree(spots).query(spots, k=2)[0][:, 1]) / 2, 0.05, 1.0))


def _choice(count: int, limit: int) -> NDArray[np.int64]:
    """Return at most `limit` of `count` indices, evenly spread."""
    return (
        np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))
        if count
        else np.zeros(0, int)
    )


def _rgb(colour: str) -> list[int]:
    return [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
