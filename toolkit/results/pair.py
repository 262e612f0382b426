"""The one reader of the localize stage's results for a pair of devices: poses, table and correspondences; how a run
localized: its settings; and messages about runs, scenes and devices that do not exist.

The group `<timestamp>/<device_id>` of a query in `poses/<pair>.h5` holds the arrays of `QueryResult.arrays`. Figures,
exports and evaluations read this file, so they use exactly the correspondences of the localization.
"""

import difflib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd

from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.tables import POSES_UNIT, read_query_table
from toolkit.errors import COMMAND, ArtifactError, CaptureError, DamagedError, ToolkitError, first_line
from toolkit.features.matching import LocalMethod
from toolkit.features.stores import FeatureStore
from toolkit.files import (
    RAW_DATA,
    SceneFiles,
    file_fingerprint,
    fingerprint,
    image_name,
    map_record_path,
    of_sequence,
    pair_devices,
    pair_name,
    read_map_record,
    require_whole,
    write_atomic,
)  # fmt: skip
from toolkit.geometry import Floats
from toolkit.manifest import LocalizeSettings, nearest, unreadable
from toolkit.mapping.local_map import LocalMap, map_path
from toolkit.pose.base import QueryResult, Status, split_status
from toolkit.results.metrics import is_posed, length_unit, named_by_unit, pose_errors
from toolkit.runs.folder import RECORD
from toolkit.store.hdf5 import HDF5_ERRORS, has_group, read_group

MAPS = "maps"
"""Attribute of `poses/<pair>.h5`: names of the triangulated maps in the folder of maps, one per kind of features."""
SETTINGS, SESSIONS_ROOT, RETRIEVAL = "settings", "sessions_root", "retrieval_dir"
"""Attributes of `poses/<pair>.h5`: the settings that the pair was localized with, the `sessions` folder of the capture,
and the folder of the references."""
_FIRST = f"Localize first: {COMMAND} run MANIFEST, or build the map alone: add --only map."
Localized = tuple[LocalizeSettings, dict[str, Any], list[str]]
"""Settings that a pair was localized with, attributes of its `.h5` file, and the file names of its maps."""


def query_group(timestamp: int, device_id: str) -> str:
    """Return the name of a query's group. A `/` in a device id is written as `%2F`, as it would add a level."""
    return f"{timestamp}/{device_id.replace('%', '%25').replace('/', '%2F')}"


@dataclass(frozen=True, eq=False)
class PairResults:
    """The stored results of the Q queries of a pair, in the order of its table; poses are read when they are needed."""

    path: Path
    """`poses/<pair>.txt`."""
    table: pd.DataFrame
    """`poses/<pair>.csv`: one row per query. `status` is the value of `Status`; the file's text, with the reason, is
    `status_text`. Lengths are in the unit of the poses."""

    @classmethod
    def open(cls, path: str | Path, whole: bool = True) -> "PairResults":
        """Open a pair's results, given any file of it: `poses/<pair>.txt`, `.csv` or `.h5`.

        If there is no table, because another tool computed the poses, every pose counts as `ok`.

        Args:
            whole: refuse files that differ from their record: in a truncated file, missing queries would look like
                queries without a pose.

        Raises:
            ArtifactError: a file is missing or torn.
        """
        poses, csv = Path(path).with_suffix(".txt"), Path(path).with_suffix(".csv")
        if whole:
            require_whole(poses)
            require_whole(csv, of=poses)
        if csv.is_file() or not poses.is_file():
            return cls(poses, split_status(read_query_table(csv, ["status"])))
        try:
            read = Trajectory.read(poses)
        except CaptureError as error:
            raise ArtifactError(str(error)) from None
        keys = {"timestamp": read.timestamps, "device_id": np.asarray(read.device_ids, object)}
        return cls(poses, split_status(pd.DataFrame({**keys, "status": str(Status.OK)})))

    @classmethod
    def of(cls, poses_dir: str | Path, scene: str, map_device: str, query_device: str) -> "PairResults":
        """Open the results of a pair in a folder of poses; see `open`."""
        return cls.open(Path(poses_dir) / f"{pair_name(scene, map_device, query_device)}.txt")

    def at(self, keys: pd.DataFrame) -> "PairResults":
        """Return the results of queries, a table with `timestamp` and `device_id`; NaN for one without a row."""
        key = ["timestamp", "device_id"]
        return replace(self, table=keys.merge(self.table.drop_duplicates(key), "left", key))

    @property
    def devices(self) -> tuple[str, str]:
        """Map device and query device."""
        return pair_devices(self.path.stem)

    @property
    def h5(self) -> Path:
        return self.path.with_suffix(".h5")

    @cached_property
    def trajectory(self) -> Trajectory:
        return Trajectory.read(self.path)

    @cached_property
    def poses(self) -> Floats:
        """world_from_rig (Q, 4, 4), NaN without a pose; for a single camera, the rig is the camera."""
        return self.trajectory.lookup(self.table["timestamp"].to_numpy(), self.table["device_id"])

    @cached_property
    def covariances(self) -> Floats:
        """(Q, 6, 6), see `QueryResult.covariance`; NaN if unknown."""
        at = self.trajectory.index.find(self.table["timestamp"].to_numpy(), self.table["device_id"].to_numpy(str))
        covariances = np.full((len(self), 6, 6), np.nan)
        if self.trajectory.covariances is not None:
            covariances[at >= 0] = self.trajectory.covariances[at[at >= 0]]
        return covariances

    @cached_property
    def _keys(self) -> dict[tuple[int, str], int]:
        return {key: n for n, key in enumerate(zip(self.table["timestamp"], self.table["device_id"], strict=True))}

    @cached_property
    def _images(self) -> dict[str, int]:
        listed = self.table["image"].astype(object) if "image" in self.table else ()  # other tools may not list them
        named = enumerate("" if pd.isna(images) else str(images) for images in listed)
        return {image: number for number, images in named for image in images.split(";") if image}

    @cached_property
    def unit(self) -> tuple[str, float]:
        """The unit that lengths are shown in, see `metrics.length_unit`."""
        scene = self.path.stem.rpartition("_map_")[0]
        return length_unit(read_map_record(map_record_path(self.path.parent, scene, self.devices[0])))

    @cached_property
    def _file(self) -> h5py.File:
        return _open(self.h5)

    @cached_property
    def maps(self) -> list[str]:
        """Names of the triangulated maps that `Correspondences.point_index` counts through."""
        return names_of_maps(self.h5)

    def local_map(self, map_dir: str | Path | None) -> LocalMap | None:
        """Return the triangulated maps of these poses pooled into one; None if none of them can be read."""
        return load_maps(map_files(map_dir, f"{self.devices[0]}_map", self.h5))

    def __len__(self) -> int:
        return len(self.table)

    def __iter__(self) -> Iterator[QueryResult]:
        return (self[number] for number in range(len(self)))

    def number(self, query: int | str | tuple[int, str]) -> int:
        """Return the number of a query in the table; see `__getitem__`."""
        number = self._keys.get(query) if isinstance(query, tuple) else find_query(query, self._images, len(self))
        if number is None:
            raise ArtifactError(f"{self.path}: no query {query}.")
        return number

    def __getitem__(self, query: int | str | tuple[int, str]) -> QueryResult:
        """Return the result of a query by its number in the table, its (timestamp, device id), or the name of one of
        its images, or a unique end of that.

        Raises:
            ArtifactError: there is no such query, or its correspondences are damaged (DamagedError) or cannot be read.
        """
        number = self.number(query)
        pose, covariance = self.poses[number], self.covariances[number]
        return replace(
            self.stored(self.table.iloc[number].to_dict()),
            world_from_rig=pose if is_posed(pose) else None,
            covariance=None if np.isnan(covariance).all() else covariance,
        )

    def stored(self, row: Mapping[str, Any]) -> QueryResult:
        """Return the result of the query of a row, with its arrays if the stage could process it."""
        name = query_group(int(row["timestamp"]), str(row["device_id"]))
        try:
            return QueryResult.from_row(row, read_group(self._file, name) if has_group(self._file, name) else None)
        except (*HDF5_ERRORS, AttributeError) as error:
            fault = f"{self.h5}: {name} is not as a run writes it ({first_line(error)}). Localize again."
            raise DamagedError(self.h5, fault) from None

    def errors(self, truth: Trajectory | Floats) -> pd.DataFrame:
        """Return the table with `rotation_error_deg` and `translation_error_m`, by `metrics.pose_errors`; or `_L`.

        Args:
            truth: true world_from_rig: a trajectory, or (Q, 4, 4).

        Errors are infinite without a pose and NaN without a true pose. Lengths are in `unit`, and named by it.
        """
        turned, moved = pose_errors(self.poses, truth, self.table[["timestamp", "device_id"]])
        table = self.table.rename(columns=POSES_UNIT).assign(rotation_error_deg=turned, translation_error_m=moved)
        lengths = table.columns.intersection(["translation_error_m", "position_std_m"])
        return named_by_unit(table.assign(**table[lengths] / self.unit[1]), self.unit[0])


def _open(h5: Path) -> h5py.File:
    try:
        return h5py.File(h5, "r")
    except HDF5_ERRORS as error:
        fault = f"the correspondences of the poses cannot be read ({error})"
        raise ArtifactError(f"{h5}: {fault}. Localize again.") from None


def names_of_maps(h5: Path) -> list[str]:
    """Return the names of the triangulated maps that a pair was localized in, from the file of its correspondences.

    Raises:
        ArtifactError: the file is missing or damaged.
    """
    try:
        with _open(h5) as file:
            return list(json.loads(file.attrs.get(MAPS, "[]")))
    except HDF5_ERRORS as error:
        raise ArtifactError(f"{h5}: its maps cannot be read ({error}). Localize again.") from None


def map_files(map_dir: str | Path | None, session_id: str, h5: Path | None = None) -> tuple[Path, ...]:
    """Return the existing triangulated maps of a session, one per kind of features.

    Args:
        map_dir: folder of the maps; None: there are none.
        session_id: id of the map session.
        h5: file of a pair's correspondences; only maps used for its poses are returned. None, or a file that is missing
            or does not record the maps: every map of the session in the folder.
    """
    if map_dir is None:
        return ()
    names = names_of_maps(h5) if h5 is not None and h5.is_file() else []
    paths = [Path(map_dir) / name for name in names] or sorted(Path(map_dir).glob(f"{session_id}*.npz"))
    return tuple(path for path in paths if path.is_file())


def load_maps(paths: Sequence[Path]) -> LocalMap | None:
    """Return the maps of one session pooled into one, skipping files that are not maps; None if there is no map."""
    maps = []
    for path in paths:
        with suppress(ArtifactError):
            maps.append(LocalMap.load(path))
    return LocalMap.pooled(maps) if maps else None


def pairs_of(poses_dir: str | Path, suffix: str = ".csv") -> dict[tuple[str, str], Path]:
    """Return a file of each pair in a folder of poses, by default its table, by (map device, query device)."""
    paths = [path for path in sorted(Path(poses_dir).glob(f"*{suffix}")) if not of_sequence(path.stem)]
    return {devices: path for path in paths if all(devices := pair_devices(path.stem))}


def find_query(query: object, images: Mapping[str, int], count: int, what: str = "query") -> int:
    """Return the number of a query, or of what else images have.

    Args:
        query: its number, the name of one of its images, or a unique end of the name.
        images: number of the query by the name of each image.
        count: number of queries.
        what: what it is, for messages.

    Raises:
        ArtifactError: no query matches, or several do; names the nearest.
    """
    if isinstance(query, int | np.integer) and not isinstance(query, bool):
        if 0 <= query < count:
            return int(query)
        known = f", expected a number from 0 to {count - 1}, or the name of an image." if count else ". There are none."
        raise ArtifactError(f"{what}: found {query}{known}")
    if not isinstance(query, str | Path):
        raise ArtifactError(f"{what}: found {query!r}, expected a number or the name of an image.")
    name = image_name(str(query))
    numbers = {images[name]} if name in images else {images[image] for image in images if image.endswith(f"/{name}")}
    if len(numbers) == 1:
        return numbers.pop()
    if numbers:
        raise ArtifactError(f"{what}: {len(numbers)} have an image name that ends in {name!r}; give more of it.")
    close = difflib.get_close_matches(name, images, n=1, cutoff=0.0)
    hint = f"The nearest of its {len(images)} images is {close[0]!r}." if close else "There are none."
    raise ArtifactError(f"{what}: no {what} has an image {str(query)!r}. {hint}")


# Runs, and how they localized


def no_such_run(run: Path, parameter: str = "") -> ArtifactError:
    """Return an error that lists the runs beside a folder that is none, the value of a notebook's parameter or not."""
    known = [path.parent.name for path in run.parent.glob(f"*/{RECORD}")]
    return ArtifactError(f"{f'{parameter}: ' if parameter else ''}{run}: no such run. {nearest(run.name, known)}")


def localized_scenes(run: Path) -> list[str]:
    """Return the names of the captures that a run has localized, in order, or raise ArtifactError if it is none."""
    if not run.is_dir():
        raise no_such_run(run)
    return sorted(path.parent.name for path in run.glob("*/poses"))


def pairs_in_map(files: SceneFiles, device: str) -> list[Path]:
    """Return `poses/<pair>.h5` of all pairs with a map device; of a map without queries, its own file.

    Raise ArtifactError for an unknown run, scene or device; the message lists the known ones.
    """
    if files.scene not in (scenes := localized_scenes(files.run)):
        known = nearest(files.scene, scenes)
        raise ArtifactError(f"{files.run}: no poses of the scene {files.scene!r}. {known} {_FIRST}")
    maps = opened_by(files)
    if device not in maps:
        known = nearest(device, maps)
        raise ArtifactError(f"{files.poses_dir}: no map of {device!r}. {known} {_FIRST}")
    return maps[device]


def opened_by(files: SceneFiles) -> dict[str, list[Path]]:
    """Return for each map device the files that say how its map is opened: `<pair>.h5`, or of a map without queries
    `<scene>_map_<device>.h5`."""
    found: dict[str, list[Path]] = {}
    paths = sorted(files.poses_dir.glob("*.h5"))
    for path in paths:
        if device := pair_devices(path.stem)[0]:
            found.setdefault(device, []).append(path)
    for path in paths:
        if not pair_devices(path.stem)[0]:
            found.setdefault(path.stem.rpartition("_map_")[2], [path])
    return found


def how_localized(pair: Path) -> Localized:
    """Return how the queries of `poses/<pair>.h5` were localized; raise ArtifactError if the file does not say it."""
    try:
        with h5py.File(pair, "r") as file:
            attributes = dict(file.attrs)
        return LocalizeSettings.of(json.loads(attributes[SETTINGS])), attributes, json.loads(attributes[MAPS])
    except (*HDF5_ERRORS, ToolkitError) as error:
        raise unreadable(pair, error) from None


def last_localized(files: SceneFiles, pairs: Sequence[Path]) -> Localized:
    """Return how a pair of the last run was localized; pairs of earlier runs may have other settings.

    The last run is known by its settings file. File times would be unreliable, as clocks can be set back.
    """
    last, localized, errors = None, list[Localized](), list[ArtifactError]()
    with suppress(ArtifactError):  # the run is of a version that wrote no such file, or other settings
        last = LocalizeSettings.read(files.poses_dir)
    for pair in pairs:
        try:
            localized.append(how_localized(pair))
        except ArtifactError as error:
            errors.append(error)
    if not localized:
        raise errors[-1]
    return next((one for one in localized if one[0] == last), localized[-1])


SESSION_FILES = "sensors.txt", "images.txt", "rigs.txt", "trajectories.txt"
"""Files of the calibration, the images and the poses of a session; not each session has all of them."""


def session_files(*sessions: Session) -> list[Path]:
    """Return the existing files of `SESSION_FILES`."""
    return [path for one in sessions for name in SESSION_FILES if (path := one.path / name).exists()]


def pose_sources(*sessions: Session) -> list[Path]:
    """Return what poses are made from in a capture: `session_files`, and the folders that stand for the images."""
    return [*session_files(*sessions), *(one.path / RAW_DATA for one in sessions)]


def session_fingerprint(session: Session) -> str:
    """Return 16 hex digits that identify the calibration, poses and image list of a session."""
    return fingerprint(list(map(file_fingerprint, session_files(session))))


def map_inputs(session: Session, features: FeatureStore) -> str:
    """Return 16 hex digits that identify a map's `inputs`: its session and the features of its images."""
    return fingerprint([session_fingerprint(session), features.only(session.image_names).fingerprint])


def attributes(
    settings: LocalizeSettings, kinds: Sequence[LocalMethod], capture: Capture, device: str, retrieval_dir: Path
) -> dict[str, str]:
    """Return the attributes of a pair's `.h5` file from which `Map.open` opens the map: with what its queries were
    localized, and where the capture and the references are.
    """
    return {
        MAPS: json.dumps([map_path("", f"{device}_map", kind.name).name for kind in kinds if settings.map is not None]),
        SETTINGS: settings.model_dump_json(),
        SESSIONS_ROOT: str(capture.path / "sessions"),
        RETRIEVAL: str(retrieval_dir),
    }


def update_attributes(path: Path, attributes: Mapping[str, str]) -> bool:
    """Update the attributes of a file if equivalent settings made it or its capture moved; tell if any changed."""
    with h5py.File(path, "r") as file:
        current = {name: file.attrs.get(name) for name in attributes} == dict(attributes)
    if not current:
        with write_atomic(path) as temporary:
            shutil.copyfile(path, temporary)
            with h5py.File(temporary, "a", libver="latest") as file:
                file.attrs.update(attributes)
    return not current
