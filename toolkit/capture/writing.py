"""Write the text files of a session; read and write depth maps."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.tables import ALIGNED, times_of, write_table
from toolkit.capture.trajectory import Trajectory
from toolkit.errors import CaptureError, ImageError
from toolkit.files import write_atomic
from toolkit.geometry import qt_from_pose

UNKNOWN_DEPTH = 65535
DEPTH_SCALE = 1000.0  # depth maps are 16-bit PNGs in millimeters
_WIFI = "mac_addr, frequency_khz, rssi_dbm, name, scan_time_start_us, scan_time_end_us"
_BLUETOOTH = "id, rssi_dbm, name"
Records: TypeAlias = pd.DataFrame | Iterable[tuple[int, str, str]]


def write_session(
    path: str | Path,
    sensors: Iterable[Sequence[Any]],
    rigs: Iterable[tuple[str, str, ArrayLike]] | None,
    trajectory: Trajectory | None,
    images: Records,
    depths: Records | None = None,
    subsessions: Sequence[str] | None = None,
    keyframes: Mapping[str, pd.DataFrame] | None = None,
    ground_truth: Trajectory | None = None,
    wifi: Iterable[Sequence[Any]] | None = None,
    bt: Iterable[Sequence[Any]] | None = None,
) -> Path:
    """Write the text files of a session, not its images. Return the folder.

    Arguments that are None are not written. Raise ValueError if the format cannot store a value: it contains a comma or
    a line break, begins or ends with a space, or starts a line with #.

    Args:
        path: the session's folder; created if missing.
        sensors: rows (sensor_id, name, sensor_type, parameter, ...).
        rigs: rows (rig_id, sensor_id, rig_from_sensor), the pose as (4, 4) or as qw qx qy qz tx ty tz.
        trajectory: written to trajectories.txt: the poses of a map, or the odometry of queries.
        images, depths: rows (timestamp, sensor_id, path relative to raw_data/).
        keyframes: tables [timestamp, device_id] by name, e.g. `pruned_subsampled`.
        ground_truth: written to proc/alignment_trajectories.txt.
        wifi: rows (timestamp, sensor_id, MAC address, kHz, dBm, name, start and end of the scan, microseconds).
        bt: rows (timestamp, sensor_id, id, dBm, name), the id as `<guid>:<major>:<minor>`.
    """
    path = Path(path)
    write_table(path / "sensors.txt", "sensor_id, name, sensor_type, [sensor_params]+", map(_line, sensors))
    if rigs is not None:
        rows = (
            (rig, sensor, *(qt_from_pose(pose) if np.shape(pose) == (4, 4) else np.asarray(pose, np.float64)).tolist())
            for rig, sensor, pose in rigs
        )
        write_table(path / "rigs.txt", "rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz", map(_line, rows))
    for file, column, records in (("images.txt", "image_path", images), ("depths.txt", "depth_path", depths)):
        if records is not None:
            lines = records.itertuples(index=False) if isinstance(records, pd.DataFrame) else records
            write_table(path / file, f"timestamp, sensor_id, {column}", map(_line, lines))
    if trajectory is not None:
        trajectory.write(path / "trajectories.txt")
    if ground_truth is not None:
        ground_truth.write(path / ALIGNED)
    for file, columns, signals in (("wifi.txt", _WIFI, wifi), ("bt.txt", _BLUETOOTH, bt)):
        if signals is not None:
            write_table(path / file, f"timestamp, sensor_id, {columns}", map(_line, signals))
    # The benchmark's evaluation expects the files in proc/ without a header.
    if subsessions is not None:
        write_table(path / "proc" / "subsessions.txt", None, (_line([name]) for name in subsessions))
    for name, table in (keyframes or {}).items():
        file = f"keyframes_{name.removeprefix('keyframes_')}.txt"
        write_table(path / "proc" / file, None, map(_line, zip(times_of(table), table["device_id"], strict=True)))
    return path


def _line(values: Sequence[Any]) -> str:
    # repr of a float is the shortest text that reads back as the same number.
    texts = [repr(float(value)) if isinstance(value, float) else str(value) for value in values]
    for text in texts:
        if any(sign in text for sign in ",\n\r") or text != text.strip(" \t\r\v\f"):
            raise ValueError(f"The capture format cannot hold a comma, a line break or spaces at an end: {text!r}.")
    if texts[0].startswith("#"):
        raise ValueError(f"A line of the capture format that starts with # is a comment: {texts[0]!r}.")
    return ", ".join(texts)


def read_depth(path: str | Path) -> NDArray[np.float32]:
    """Return a depth map, (H, W) float32 meters along the camera's z axis, 0 where unknown.

    The largest number, 65535, means unknown, too, as in 7-Scenes. Raise CaptureError if the file cannot be read or is
    not a 16-bit image.
    """
    import cv2

    from toolkit.capture.images import decode

    try:
        depth = decode(path, cv2.IMREAD_UNCHANGED)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise ImageError(f"{depth.dtype} {depth.shape}")
    except ImageError as error:
        fault = f"no such file, or not a 16-bit image of one channel ({error})"
        raise CaptureError(f"Depth map {path}: {fault}. Expected a 16-bit PNG in millimeters.") from None
    depth[depth == UNKNOWN_DEPTH] = 0
    return (depth / np.float32(DEPTH_SCALE)).astype(np.float32)


def write_depth(path: str | Path, depth_m: ArrayLike) -> None:
    """Write a depth map (H, W), meters, as a 16-bit PNG in millimeters; depth beyond 65.5 m becomes 0, unknown."""
    import cv2

    millimeters = np.round(np.asarray(depth_m, np.float64) * DEPTH_SCALE)
    in_range = (millimeters >= 0) & (millimeters < UNKNOWN_DEPTH)  # False for NaN
    done, png = cv2.imencode(".png", np.where(in_range, millimeters, 0).astype(np.uint16))
    if not done:
        raise CaptureError(f"Depth map of shape {millimeters.shape} cannot be written to {path}; expected (H, W).")
    with write_atomic(path) as temporary:
        temporary.write_bytes(png.tobytes())
