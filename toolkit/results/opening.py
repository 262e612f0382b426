"""How a run localized: its settings, and messages about runs, scenes and devices that do not exist."""

import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import h5py

from toolkit.capture import Capture, Session
from toolkit.errors import COMMAND, ArtifactError, ManifestError, ToolkitError
from toolkit.features.matching import LocalMethod
from toolkit.features.stores import FeatureStore
from toolkit.files import SceneFiles, file_fingerprint, fingerprint, pair_devices, write_atomic
from toolkit.manifest import LocalizeSettings, Settings, nearest
from toolkit.mapping.local_map import map_path
from toolkit.results.pair import MAPS
from toolkit.runs.folder import RECORD
from toolkit.store.hdf5 import HDF5_ERRORS

SETTINGS, SESSIONS_ROOT, RETRIEVAL = "settings", "sessions_root", "retrieval_dir"
"""Attributes of `poses/<pair>.h5`: the settings that the pair was localized with, the `sessions` folder of the capture,
and the folder of the references."""
_FIRST = f"Localize first: {COMMAND} run MANIFEST, or build the map alone: add --only map."


def no_such_run(run: Path) -> ArtifactError:
    """Return an error that lists the runs beside a folder that is none."""
    known = [path.parent.name for path in run.parent.glob(f"*/{RECORD}")]
    return ArtifactError(f"{run}: no such run. {nearest(run.name, known)}")


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


Localized = tuple[LocalizeSettings, dict[str, Any], list[str]]
"""Settings that a pair was localized with, attributes of its `.h5` file, and the file names of its maps."""


def _unreadable(path: Path, error: Exception) -> ArtifactError:
    other = "another version of the toolkit wrote it"
    problem = other if isinstance(error, ManifestError) else f"cannot read its settings ({error})"
    return ArtifactError(f"{path}: {problem}. Run its stage again.")


def how_localized(pair: Path) -> Localized:
    """Return how the queries of a pair, `poses/<pair>.h5`, were localized; raise ArtifactError if the file does not say
    it.
    """
    try:
        with h5py.File(pair, "r") as file:
            attributes = dict(file.attrs)
        return LocalizeSettings.of(json.loads(attributes[SETTINGS])), attributes, json.loads(attributes[MAPS])
    except (*HDF5_ERRORS, ToolkitError) as error:
        raise _unreadable(pair, error) from None


def last_localized(files: SceneFiles, pairs: Sequence[Path]) -> Localized:
    """Return how a pair of the last run was localized; pairs of earlier runs may have other settings.

    The last run is known by its settings file. File times would be unreliable, as clocks can be set back.
    """
    last, localized, errors = None, list[Localized](), list[ArtifactError]()
    with suppress(ArtifactError):  # the run is of a version that wrote no such file, or other settings
        last = read_settings(files.poses_dir / "settings.json", LocalizeSettings)
    for pair in pairs:
        try:
            localized.append(how_localized(pair))
        except ArtifactError as error:
            errors.append(error)
    if not localized:
        raise errors[-1]
    return next((one for one in localized if one[0] == last), localized[-1])


AnySettings = TypeVar("AnySettings", bound=Settings)


def read_settings(path: Path, model: type[AnySettings]) -> AnySettings:
    """Return the settings that a stage wrote beside its results; raise ArtifactError if it did not, or in another
    version.
    """
    try:
        return model.of(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, ManifestError) as error:
        raise _unreadable(path, error) from None


def session_fingerprint(session: Session) -> str:
    """Return 16 hex digits that identify the calibration, poses and image list of a session."""
    files = ["sensors.txt", "images.txt", "rigs.txt", "trajectories.txt"]
    return fingerprint([file_fingerprint(session.path / name) for name in files if (session.path / name).exists()])


def map_inputs(session: Session, features: FeatureStore) -> str:
    """Return 16 hex digits that identify what a map is made of, `inputs` of its record: its session and the features of
    its images.
    """
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
