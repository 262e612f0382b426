"""The correspondences behind each pose of a pair, in one HDF5 file beside the poses.

The group `<timestamp>/<device_id>` of a query holds the arrays of `Correspondences` and the names of `LocalizedQuery`.
Figures, exports and evaluations read this file, so they use exactly the correspondences of the localization.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import h5py
import numpy as np
from numpy.typing import NDArray

from toolkit.errors import ArtifactError, DamagedError, first_line
from toolkit.geometry import Floats, Ints
from toolkit.store.hdf5 import HDF5_ERRORS, group_names_of, has_group, read_group

MAPS = "maps"
"""File attribute: names of the triangulated maps in the folder of maps, one per kind of features."""
_NAMES = ("images", "references", "rejected")
_RIVALS = ("rivals", "rival_supports")


class Rival(NamedTuple):
    """A pose that clearly differs from the estimate but is supported by matches too."""

    world_from_rig: Floats
    """(4, 4)"""
    support: float
    """Support by its guided matches, divided by that of the estimate, see `PoseEstimate.rival_support`."""


@dataclass(frozen=True)
class Correspondences:
    """K correspondences between a query device and the map, and M observations of their points in the references."""

    camera: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K,) index of the query image."""
    pixels: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """(K, 2) in the query image; the center of the top-left pixel is (0.5, 0.5)."""
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(K, 3) in the world, meters."""
    point_index: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K,) index of the map point, counted through all maps in order; -1 for a point lifted by depth."""
    inlier: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(K,) whether it is an inlier of the pose."""
    found_by: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, "U1"))
    """(K,) `<kind of features>/<descriptors, guided or lifted>`."""
    view_of: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(M,) index of the correspondence whose point is observed."""
    view_reference: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(M,) index of the reference that observes it."""
    view_pixels: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """(M, 2) pixel of the observation in the reference."""

    def __len__(self) -> int:
        return len(self.camera)

    def in_camera(self, camera: int) -> Ints:
        """Return the indices of the correspondences of one query image."""
        return np.flatnonzero(self.camera == camera)


_ARRAYS = tuple(Correspondences.__dataclass_fields__)


def _shape_of(name: str, correspondences: Correspondences) -> tuple[int, ...]:
    count = len(correspondences.view_of) if name.startswith("view_") else len(correspondences.camera)
    width = {"pixels": 2, "points": 3, "view_pixels": 2}.get(name)
    return (count,) if width is None else (count, width)


@dataclass(frozen=True)
class LocalizedQuery:
    """How one query device was localized."""

    images: list[str] = field(default_factory=list)
    """Names of the C query images."""
    references: list[str] = field(default_factory=list)
    """Names of the map images that support the pose, best first."""
    rejected: list[str] = field(default_factory=list)
    """Names of the references that contradict the other ones."""
    correspondences: Correspondences = field(default_factory=Correspondences)
    rivals: Sequence[Rival] | None = ()
    """Clearly different poses that matches support, best supported first; None in files of older runs."""

    def arrays(self) -> dict[str, Any]:
        """Return the datasets of the query's group, by name; texts as objects."""
        arrays = dict(vars(self.correspondences))
        labels, codes = np.unique(arrays.pop("found_by"), return_inverse=True)
        names = {name: np.array(getattr(self, name), object) for name in _NAMES}
        # float32 makes the file smaller and keeps pixels of any image exact to a hundredth.
        arrays |= {key: arrays[key].astype(np.float32) for key in ("pixels", "view_pixels")}
        arrays |= {key: arrays[key].astype(np.int32) for key in ("camera", "point_index", "view_of", "view_reference")}
        arrays |= {"found_by": codes.astype(np.uint8), "found_by_labels": labels.astype(object)}
        if self.rivals is not None:
            arrays["rivals"] = np.array([rival.world_from_rig for rival in self.rivals]).reshape(-1, 4, 4)
            arrays["rival_supports"] = np.array([rival.support for rival in self.rivals], np.float64)
        return arrays | names


def query_group(timestamp: int, device_id: str) -> str:
    """Return the name of a query's group. A `/` in a device id is written as `%2F`, as it would add a level."""
    return f"{timestamp}/{device_id.replace('%', '%25').replace('/', '%2F')}"


class LocalizedQueries(Mapping[tuple[int, str], LocalizedQuery]):
    """The queries of one pair, by timestamp and device id; each is read on access."""

    def __init__(self, path: str | Path):
        """Open `poses/<pair>.h5`.

        Raises:
            ArtifactError: the file is missing or damaged.
        """
        self.path = Path(path)
        try:
            self._file = h5py.File(self.path, "r")
            maps = json.loads(self._file.attrs.get(MAPS, "[]"))
        except HDF5_ERRORS as error:
            raise ArtifactError(
                f"{self.path}: the correspondences of the poses cannot be read ({error}). Localize again."
            ) from None
        self.maps: list[str] = maps
        """Names of the triangulated maps whose points `point_index` counts through."""

    def __contains__(self, key: object) -> bool:
        return isinstance(key, tuple) and len(key) == 2 and has_group(self._file, query_group(*key))

    def __getitem__(self, key: tuple[int, str]) -> LocalizedQuery:
        name = query_group(*key)
        if not has_group(self._file, name):
            raise KeyError(key)
        try:
            stored = read_group(self._file, name)
            labels = np.array([label.decode() for label in stored.pop("found_by_labels")], np.str_)
            codes = stored.pop("found_by").astype(np.int64)
            names = {key: [text.decode() for text in stored.pop(key)] for key in _NAMES}
            rivals = None
            if "rivals" in stored:
                poses, supports = (stored.pop(key) for key in _RIVALS)
                pairs = zip(poses.reshape(-1, 4, 4), supports.tolist(), strict=True)
                rivals = tuple(Rival(pose, support) for pose, support in pairs)
            wide = {"f": np.float64, "i": np.int64, "b": np.bool_}
            arrays: dict[str, Any] = {key: array.astype(wide[array.dtype.kind]) for key, array in stored.items()}
            found_by = labels[codes] if len(labels) else np.zeros(0, "U1")
            read = Correspondences(**{name: arrays[name] for name in arrays if name in _ARRAYS}, found_by=found_by)
            if wrong := [name for name in _ARRAYS if getattr(read, name).shape != _shape_of(name, read)]:
                raise ValueError(f"{wrong[0]} has the shape {getattr(read, wrong[0]).shape}")
            return LocalizedQuery(**names, correspondences=read, rivals=rivals)
        except (*HDF5_ERRORS, AttributeError) as error:
            raise DamagedError(self.path, f"{self.path}: {name} is not as a run writes it ({first_line(error)}). "
                               "Localize again.") from None  # fmt: skip

    def __iter__(self) -> Iterator[tuple[int, str]]:
        try:
            keys = [name.split("/") for name in group_names_of(self._file, "camera")]
            yield from [(int(timestamp), unquote(device)) for timestamp, device in keys]
        except HDF5_ERRORS as error:
            raise DamagedError(
                self.path, f"{self.path}: its queries cannot be listed ({first_line(error)}). Localize again."
            ) from None

    def __len__(self) -> int:
        return len(list(iter(self)))

    def close(self) -> None:
        """Close the file."""
        self._file.close()
