"""Poses of devices over time: read, write and look up by timestamp and device."""

import logging
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray

from toolkit.capture import tables
from toolkit.geometry import Floats, pose_from_qt, qt_from_pose

log = logging.getLogger(__name__)


class Trajectory:
    """Poses of devices over time, world_from_device.

    Attributes:
        timestamps: (N,) int64 microseconds.
        qt: (N, 7) float64, qw qx qy qz tx ty tz, as in the file.
        arrow_ids: N device ids as an Arrow array.
    """

    def __init__(
        self,
        timestamps: ArrayLike,
        device_ids: Any,
        qt: ArrayLike,
        covariances: ArrayLike | None = None,
        source: Path | None = None,
    ) -> None:
        """Make a trajectory. Covariances are given, (N, 6, 6), or read from the file `source` at first use."""
        self.timestamps = np.asarray(timestamps, np.int64)
        self.arrow_ids = tables.as_strings(device_ids)
        self.qt = np.asarray(qt, np.float64).reshape(-1, 7)
        if not len(self.timestamps) == len(self.arrow_ids) == len(self.qt):
            found = f"{len(self.timestamps)}, {len(self.arrow_ids)} and {len(self.qt)}"
            raise ValueError(f"Expected equally many timestamps, device ids and poses, got {found}.")
        self._covariances = None if covariances is None else np.asarray(covariances, np.float64).reshape(-1, 6, 6)
        self._source = source

    @classmethod
    def from_poses(
        cls, timestamps: ArrayLike, device_ids: Any, world_from_device: ArrayLike, covariances: ArrayLike | None = None
    ) -> "Trajectory":
        """Make a trajectory from poses (N, 4, 4)."""
        return cls(timestamps, device_ids, qt_from_pose(world_from_device), covariances)

    @classmethod
    def read(cls, path: str | Path) -> "Trajectory":
        """Read a trajectories file. Columns after the pose are ignored unless they are a covariance.

        Raises:
            CaptureError: the file is missing or has a malformed line.
        """
        return cls.from_table(tables.read_table(Path(path), tables.COLUMNS["trajectories.txt"]))

    @classmethod
    def from_table(cls, table: tables.TextTable) -> "Trajectory":
        """Make a trajectory from the table of a trajectories file."""
        source = table.path if table.has_extra and not table.problems else None
        times, devices = table.columns["timestamp"].to_numpy(), table.columns["device_id"]
        return cls(times, devices, table.numbers(tables.POSE_NAMES), source=source)

    def write(self, path: str | Path) -> None:
        """Write the file atomically, with numbers that read back exactly. NaN covariances are omitted."""
        covariances, values = self.covariances, self.qt.tolist()
        if covariances is not None:
            finite = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
            flat = covariances.reshape(-1, 36).tolist()
            values = [[*pose, *more] if has else pose for pose, more, has in zip(values, flat, finite, strict=True)]
        rows = zip(self.timestamps.tolist(), self.arrow_ids.to_pylist(), values, strict=True)
        lines = (f"{time}, {device}, {', '.join(map(repr, numbers))}" for time, device, numbers in rows)
        tables.write_table(Path(path), "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz, *covar", lines)

    def __len__(self) -> int:
        return len(self.timestamps)

    @cached_property
    def device_ids(self) -> NDArray[np.object_]:
        """Device ids, (N,) array of str."""
        return self.arrow_ids.to_numpy(zero_copy_only=False)

    @property
    def covariances(self) -> Floats | None:
        """Pose covariances (N, 6, 6), NaN in rows without one; None without any. Read from the file at first use.

        A covariance with a value that is not a finite number counts as none, with a warning.
        """
        if self._covariances is None and self._source is not None:
            table = tables.read_table(self._source, tables.COLUMNS["trajectories.txt"], extra=True)
            extra, self._source = table.columns["extra"], None
            rows = np.flatnonzero(pc.equal(pc.count_substring(extra, ","), 35).to_numpy(zero_copy_only=False))
            covariances = np.full((len(self), 6, 6), np.nan)
            for block in np.split(rows, range(4096, len(rows), 4096)):  # bounds the memory
                values = pc.split_pattern(extra.take(pa.array(block)), ",").flatten()
                numbers, wrong = tables.convert(pc.ascii_trim_whitespace(values), tables.NUMBER)
                finite = ~wrong.reshape(-1, 36).any(axis=1)
                covariances[block[finite]] = numbers.to_numpy().reshape(-1, 6, 6)[finite]
            malformed = rows[np.isnan(covariances[rows, 0, 0])]
            if len(malformed):
                more = f", and in {len(malformed) - 1} more lines" if len(malformed) > 1 else ""
                fault = f"the covariance has values that are not finite numbers{more}; such a covariance is not used"
                log.warning("%s: %s.", table.where(malformed[0]), fault)
            self._covariances = covariances if len(rows) else None
        return self._covariances

    @property
    def world_from_device(self) -> Floats:
        """(N, 4, 4) float64, meters."""
        return pose_from_qt(self.qt)

    @cached_property
    def index(self) -> tables.KeyIndex:
        """Index of the rows by (timestamp, device_id)."""
        return tables.KeyIndex(self.timestamps, self.arrow_ids)

    def lookup(self, timestamps: ArrayLike, device_ids: Any) -> Floats:
        """Return world_from_device, (n, 4, 4), for n keys; NaN for keys without a pose."""
        rows = self.index.find(np.atleast_1d(np.asarray(timestamps, np.int64)), tables.as_strings(device_ids))
        poses = np.full((len(rows), 4, 4), np.nan)
        poses[rows >= 0] = pose_from_qt(self.qt[rows[rows >= 0]])
        return poses
