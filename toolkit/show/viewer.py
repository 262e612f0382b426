"""What all recordings for the rerun viewer share: files, pictures made small, cameras, layout, opening a file."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.files import write_atomic
from toolkit.geometry import Floats, rotation_to_quaternion
from toolkit.show.figures import GRAY
from toolkit.show.top_view import places_of

if TYPE_CHECKING:
    import pycolmap
    import rerun as rr

Image = NDArray[np.uint8]

APPLICATION = "visual-localization"
POINT_COLOR = GRAY
IMAGE_SIZE, JPEG_QUALITY = 480, 75
"""Longer side of the images shown, pixels, and how well they are kept, 1 to 100."""
HIDDEN_M = 1e-3
"""Depth of a camera that is not there now: too small to be seen."""


@contextmanager
def open_recording(out: str | Path, name: str, blueprint: Any) -> "Iterator[rr.RecordingStream]":
    """Yield a stream whose entries go to the file `out`, which stands whole when the block ends, or not at all."""
    import rerun as rr

    with write_atomic(out) as temporary:
        # A fixed id: opened again after another run, it replaces the old one in the viewer.
        stream = rr.RecordingStream(APPLICATION, recording_id=name)
        # Only the timelines that mean something; the time of writing would make every file differ.
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        try:
            # Before the first entry: batches are handed to the file as they fill.
            stream.save(temporary, default_blueprint=blueprint)
            stream.send_recording_name(name)
            yield stream
            stream.flush()
        finally:
            stream.disconnect()


def open_command(path: str | Path) -> str:
    """Return the command that opens a recording in the viewer."""
    return f"rerun {path}"


def spawn_viewer(path: str | Path) -> None:
    """Open a recording in a viewer of its own, which stays when this process ends."""
    subprocess.Popen(
        [sys.executable, "-m", "rerun_cli", str(path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def entity(*parts: str) -> str:
    """Return the path of an entity; parts may hold any character."""
    import rerun as rr

    return "/".join(rr.escape_entity_path_part(part) for part in parts)


def small_jpeg(image: Image, size: int) -> tuple[bytes, tuple[int, int]]:
    """Return an image, (H, W, 3) RGB or (H, W), reduced to `size` pixels on its longer side, as JPEG; and (w, h)."""
    scale = min(1.0, size / max(image.shape[:2]))
    width, height = (max(1, round(scale * side)) for side in image.shape[1::-1])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) if scale < 1 else image
    bgr = np.ascontiguousarray(small[..., ::-1]) if small.ndim == 3 else small
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes(), (width, height)


def shown_intrinsics(camera: "pycolmap.Camera", shown: tuple[int, int]) -> Floats:
    """Return the matrix (3, 3) of a camera for its image at another size (w, h), pixels.

    The top-left corner of the image is (0, 0) at every size, so the matrix scales by rows. Distortion is left out:
    the viewer draws pinholes, and at this size it hardly shows.
    """
    return np.diag([shown[0] / camera.width, shown[1] / camera.height, 1.0]) @ camera.calibration_matrix()


def pinhole_of(camera: "pycolmap.Camera", shown: tuple[int, int], depth_m: float, color: str) -> "rr.Pinhole":
    """Return a pinhole for the image of a camera at the size shown, drawn `depth_m` deep."""
    import rerun as rr

    return rr.Pinhole(
        image_from_camera=shown_intrinsics(camera, shown),
        resolution=shown,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=depth_m,
        color=rgb(color),
    )


def transform_of(parent_from_child: ArrayLike) -> "rr.Transform3D":
    """Return the pose (4, 4) of an entity in its parent."""
    import rerun as rr

    pose = np.asarray(parent_from_child, np.float64)
    w, x, y, z = rotation_to_quaternion(pose[:3, :3])
    return rr.Transform3D(translation=pose[:3, 3], quaternion=rr.Quaternion(xyzw=[x, y, z, w]))


def world_axes(up: Floats) -> Any:
    """Return the viewer's coordinates for the world axis that is nearest to `up`."""
    import rerun as rr

    axis = int(np.argmax(np.abs(up)))
    return getattr(rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}")


def scene_view(poses: Floats, up: Floats, name: str) -> Any:
    """Return the view of the 3D scene: from behind and above the place with the most cameras (N, 4, 4)."""
    import rerun.blueprint as rrb

    eye = None
    if len(poses):
        place = places_of(poses[:, :3, 3])
        here = poses[place == np.bincount(place).argmax()]
        center, view = here[:, :3, 3].mean(0), here[:, :3, 2].mean(0)
        view -= up * (view @ up)
        reach = max(3.0, float(np.linalg.norm(np.ptp(here[:, :3, 3], axis=0))))
        target = center + 0.3 * reach * view
        eye = rrb.EyeControls3D(position=target - reach * view + 0.7 * reach * up, look_target=target, eye_up=up)
    return rrb.Spatial3DView(origin="world", name=name, eye_controls=eye)


def camera_depth_m(centers: Floats) -> float:
    """Return how deep to draw the cameras at (N, 3): about half the usual step between neighbors."""
    from scipy.spatial import cKDTree

    spots = np.unique(np.round(centers, 2), axis=0)
    if len(spots) < 2:
        return 0.3
    return float(np.clip(np.median(cKDTree(spots).query(spots, k=2)[0][:, 1]) / 2, 0.05, 1.0))


def log_points(stream: "rr.RecordingStream", points: ArrayLike, colors: NDArray[np.uint8] | None) -> None:
    """Log the map's points (P, 3), colors (P, 3) RGB or None, as `world/points`."""
    import rerun as rr

    cloud = rr.Points3D(points, colors=rgb(POINT_COLOR) if colors is None else colors, radii=rr.Radius.ui_points(1.5))
    stream.log("world/points", cloud, static=True)


def rgb(color: str) -> list[int]:
    """Return the three numbers of `#rrggbb`."""
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]
