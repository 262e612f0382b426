"""Common parts of recordings for the rerun viewer: files, reduced images, cameras, layout."""

import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.images import shrunk
from toolkit.figures.scene_3d import Eye
from toolkit.figures.style import GRAY
from toolkit.files import write_atomic
from toolkit.geometry import Floats, rotation_to_quaternion

if TYPE_CHECKING:
    import pycolmap

Image = NDArray[np.uint8]

APPLICATION = "visual-localization"
POINT_COLOR = GRAY
IMAGE_SIZE, JPEG_QUALITY = 480, 75
"""Longer side of the images shown, pixels, and their JPEG quality, 1 to 100."""
HIDDEN_M = 1e-3
"""Image plane distance of a hidden camera, meters: too small to see."""


@contextmanager
def open_recording(out: str | Path, name: str, blueprint: Any) -> Iterator[rr.RecordingStream]:
    """Yield a stream that writes to the file `out`; after an error in the block, `out` is not written."""
    with write_atomic(out) as temporary:
        # A fixed id, so that a recording replaces an older one of the same name in the viewer.
        stream = rr.RecordingStream(APPLICATION, recording_id=name)
        # Without the time of writing, which would make every file differ.
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        try:
            # Call save before logging, so that entries go to the file at once instead of filling memory.
            stream.save(temporary, default_blueprint=blueprint)
            stream.send_recording_name(name)
            yield stream
            stream.flush()
        finally:
            stream.disconnect()


def open_command(path: str | Path) -> str:
    """Return the command that opens a recording in the viewer."""
    return shlex.join(["rerun", str(path)])


def spawn_viewer(path: str | Path) -> None:
    """Open a recording in a separate viewer process, which outlives this process."""
    subprocess.Popen(
        [sys.executable, "-m", "rerun_cli", str(path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def entity(*parts: str) -> str:
    """Return the path of an entity; parts may contain any character."""
    return "/".join(rr.escape_entity_path_part(part) for part in parts)


def small_jpeg(image: Image, size: int) -> tuple[bytes, tuple[int, int]]:
    """Reduce an image, (H, W, 3) RGB or (H, W), to a longer side of `size` pixels; return a JPEG and (w, h)."""
    small = shrunk(image, size)
    bgr = np.ascontiguousarray(small[..., ::-1]) if small.ndim == 3 else small
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes(), (small.shape[1], small.shape[0])


def shown_intrinsics(camera: "pycolmap.Camera", shown: tuple[int, int]) -> Floats:
    """Return the calibration matrix (3, 3) of a camera for its image at another size (w, h), pixels.

    The top-left corner of the image is (0, 0) at every size, so scaling multiplies the rows of the matrix. Distortion
    is ignored: the viewer draws pinhole cameras, and at this size it is hardly visible.
    """
    return np.diag([shown[0] / camera.width, shown[1] / camera.height, 1.0]) @ camera.calibration_matrix()


def pinhole_of(camera: "pycolmap.Camera", shown: tuple[int, int], depth_m: float, color: str) -> rr.Pinhole:
    """Return a pinhole camera for an image at the size shown (w, h), with the image plane at `depth_m`."""
    return rr.Pinhole(
        image_from_camera=shown_intrinsics(camera, shown),
        resolution=shown,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=depth_m,
        color=rgb(color),
    )


def transform_of(parent_from_child: ArrayLike) -> rr.Transform3D:
    """Return the pose (4, 4) of an entity in its parent."""
    pose = np.asarray(parent_from_child, np.float64)
    w, x, y, z = rotation_to_quaternion(pose[:3, :3])
    return rr.Transform3D(translation=pose[:3, 3], quaternion=rr.Quaternion(xyzw=[x, y, z, w]))


def world_axes(up: Floats) -> Any:
    """Return the viewer's coordinate system whose up axis is the world axis nearest to `up`."""
    axis = int(np.argmax(np.abs(up)))
    return getattr(rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}")


def scene_view(poses: Floats, up: Floats, name: str) -> Any:
    """Return the 3D view, from behind and above the place with the most cameras (N, 4, 4); up (3,) has any length."""
    controls = None
    if len(poses):
        eye = Eye.of(poses, up)
        controls = rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up)
    return rrb.Spatial3DView(origin="world", name=name, eye_controls=controls)


def camera_depth_m(centers: Floats) -> float:
    """Return the image plane distance to draw cameras at (N, 3) with: half the median distance between neighbors."""
    from scipy.spatial import cKDTree

    spots = np.unique(np.round(centers, 2), axis=0)
    if len(spots) < 2:
        return 0.3
    return float(np.clip(np.median(cKDTree(spots).query(spots, k=2)[0][:, 1]) / 2, 0.05, 1.0))


def log_points(stream: rr.RecordingStream, points: ArrayLike, colors: NDArray[np.uint8] | None) -> None:
    """Log the map's points (P, 3), colors (P, 3) RGB or None, as `world/points`."""
    cloud = rr.Points3D(points, colors=rgb(POINT_COLOR) if colors is None else colors, radii=rr.Radius.ui_points(1.5))
    stream.log("world/points", cloud, static=True)


def log_lines(stream: rr.RecordingStream, path: str, lines: Sequence[Floats], color: str) -> None:
    """Log lines, (n, 3) each."""
    stream.log(path, rr.LineStrips3D(lines, colors=rgb(color)), static=True)


def hidden_camera() -> rr.Pinhole:
    """Return any camera that is too small to see."""
    return rr.Pinhole(focal_length=1, width=1, height=1, image_plane_distance=HIDDEN_M)


def rgb(color: str) -> list[int]:
    """Return the red, green and blue values of `#rrggbb`."""
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]
