"""The map of one device: its features, its triangulated points, and its localizer."""

import json
import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.capture import Capture, Session, masks
from toolkit.capture.upright import Turns, upright_turns
from toolkit.embedders import Embedder, Vectors, create_embedder, embedding_folders, open_descriptors, shows_upright
from toolkit.embedders.index import JoinedIndex, VectorIndex, load_index
from toolkit.embedders.search import search
from toolkit.embedders.stored import embedder_fingerprint
from toolkit.errors import ArtifactError, ManifestError, ToolkitError
from toolkit.features.features import KINDS, extract_turned
from toolkit.features.matching import AnyMethod, DeferredMethod, LocalMethod, create_local_methods, weights_files
from toolkit.features.stores import FeatureStore, OnDemandFeatures, extract_session
from toolkit.features.verification import Verifier
from toolkit.files import (
    SceneFiles,
    file_fingerprint,
    fingerprint,
    image_name,
    pair_devices,
    require_current,
    write_atomic,
)  # fmt: skip
from toolkit.geometry import Floats, Ints, unit
from toolkit.manifest import EmbedSettings, LocalizeSettings, RerankSettings, RetrieveSettings, Settings, nearest
from toolkit.mapping.build import build_map
from toolkit.mapping.local_map import Consistency, LocalMap, map_path
from toolkit.mapping.pose_consistency import NOMINAL_DEPTH, USUAL_DEPTHS_M
from toolkit.pose.base import Localizer, PoseEstimate, References, RoughPose, ScaledLocalizer
from toolkit.pose.correspondences import MAPS
from toolkit.pose.escalation import SURE_POSITION_STD_M, EscalatingLocalizer
from toolkit.pose.local_triangulation import OnDemandLocalizer, PosedImages
from toolkit.pose.map_matching import MappedFeatures
from toolkit.pose.nearest import NearestLocalizer
from toolkit.pose.pnp import PnpLocalizer
from toolkit.prediction.feed_forward import FeedForwardLocalizer
from toolkit.prediction.hybrid import HybridLocalizer
from toolkit.prediction.interface import Predictor
from toolkit.prediction.network import open_predictor
from toolkit.runs.record import RECORD
from toolkit.store.hdf5 import HDF5_ERRORS

log = logging.getLogger(__name__)

SETTINGS = "settings"
SESSIONS_ROOT = "sessions_root"
ODD_DEPTHS_M = (0.1, 200.0)
"""Plausible range of a map's median depth, meters; outside, the map may be in another unit."""
MOST_IN_MEMORY = 1 << 30
"""Largest size in bytes of global descriptors (float32) that an open map keeps in memory; larger ones stay on disk."""
NEAR, NEAR_DEG = 10.0, 60.0
"""Largest distance (in map lengths, see `Survey.length`) and angle (degrees) between a camera and a map image that may
show the same scene."""
WORTH_DEG, WORTH_LENGTHS = 0.05, 0.005
"""Noise of the map's poses, degrees and map lengths per axis, from which the user is told of it."""
RETRIEVAL = "retrieval_dir"
"""`SETTINGS`, `SESSIONS_ROOT` and `RETRIEVAL` are attributes of `poses/<pair>.h5`: the settings that the pair was
localized with, the `sessions` folder of the capture, and the folder of the references."""


@dataclass
class Map:
    """The map of one device, ready for queries. It is never changed."""

    device: str
    sessions_root: Path
    """`<capture>/sessions`."""
    map_dir: Path
    """Folder of the triangulated maps."""
    settings: LocalizeSettings
    kinds: Sequence[LocalMethod] = ()
    """Kinds of local features, with extractor and matcher; empty for `nearest`."""
    mapped: Sequence[MappedFeatures] = ()
    """The map's features of each kind, with their points; empty if `settings.map` is null."""
    escalation: Sequence[DeferredMethod] = ()
    """Additional kinds for queries whose pose is not sure without them; the map has no points of these kinds."""
    features_dir: Path | None = None
    """Folder of all local features."""
    files: SceneFiles | None = None
    """Files of the run; None: images from outside a session cannot be localized, as that needs the run's embedder."""
    reranked: bool = False
    """Whether the run localized with reranked references."""

    @classmethod
    def build(
        cls,
        capture: Capture,
        device: str,
        settings: LocalizeSettings,
        kinds: Sequence[LocalMethod],
        features_dir: Path,
        map_dir: Path,
        workers: int = 1,
        skip_existing: bool = True,
        escalation: Sequence[DeferredMethod] = (),
    ) -> "Map":
        """Extract the features of a map session and triangulate its points, or load existing ones."""
        session, mapped = capture[f"{device}_map"], list[MappedFeatures]()
        root = capture.path / "sessions"
        map_ = cls(device, root, map_dir, settings, kinds, mapped, escalation, features_dir)
        for kind in kinds if settings.map is not None else ():
            turns = map_.turns_of(kind, session)
            store = extract_session(session, features_dir, kind.extractor, workers=workers, turns=turns)
            inputs = fingerprint([session_fingerprint(session), store.fingerprint])
            path = map_path(map_dir, session.id, kind.name)
            assert settings.map is not None
            metric = settings.unit is not None
            local_map = build_map(
                session, store, path, settings.map, settings.seed, skip_existing, inputs, workers, metric,
                map_.refined_poses or None,
            )
            mapped.append(MappedFeatures(local_map, store, KINDS[kind.name], kind.matcher, kind.name))
        if mapped and map_.remarks:
            log.warning("%s: %s", session.id, map_.remarks)
        return map_

    @classmethod
    def open(cls, run: str | Path, scene: str, device: str) -> "Map":
        """Open the map of a finished run, with the settings that the run was localized with.

        Args:
            run: the run folder, `<output_root>/<manifest name>`.
            scene: the capture's name.
            device: `ios`, `hl`, `spot`.

        Raises:
            ArtifactError: unknown run, scene or device (the message lists the known ones), or missing files of the run.
            WeightsError: the weights of a network that the run used are missing.
        """
        for value, kind in ((run, str | Path), (scene, str), (device, str)):
            if not isinstance(value, kind):
                raise ArtifactError(f"Map.open: found {value!r}, expected a run folder, a scene name and a device key.")
        files = SceneFiles(Path(run), scene)
        pairs = sorted(files.poses_dir.glob(f"{scene}_map_{device}_query_*.h5"))
        if not pairs:
            raise ArtifactError(f"{_unknown(files, device)} Localize first: python -m toolkit run MANIFEST.")
        localized = _last_localized(files, pairs)
        for pair in pairs:
            require_current(pair.with_suffix(".txt"), "localize", missing=False)
        reranked = Path(localized[1][RETRIEVAL]).name == files.reranked_dir.name
        return replace(cls._stored_in(device, localized, files.features, files.maps), files=files, reranked=reranked)

    @classmethod
    def of_pair(cls, poses: str | Path, device: str, features_dir: str | Path, map_dir: str | Path) -> "Map":
        """Open the map of a finished pair, with the settings that the pair was localized with, from the given files.

        Args:
            poses: `poses/<pair>.h5`.
            device: the map device.
            features_dir, map_dir: as given to `localize_pairs`.

        Raises:
            ArtifactError, WeightsError: as `open`.
        """
        return cls._stored_in(device, how_localized(Path(poses)), Path(features_dir), Path(map_dir))

    @classmethod
    def _stored_in(cls, device: str, localized: "Localized", features_dir: Path, map_dir: Path) -> "Map":
        settings, h5_attributes, names = localized
        kinds, escalation = create_methods(settings)
        mapped = [
            MappedFeatures(
                LocalMap.load(map_dir / name),
                FeatureStore.of_session(features_dir, f"{device}_map", kind.extractor.settings),
                KINDS[kind.name],
                kind.matcher,
                kind.name,
            )
            for name, kind in zip(names, kinds if settings.map is not None else (), strict=True)
        ]
        root = Path(h5_attributes[SESSIONS_ROOT])
        return cls(device, root, map_dir, settings, kinds, mapped, escalation, features_dir)

    @cached_property
    def capture(self) -> Capture:
        return Capture.from_sessions_root(self.sessions_root)

    @cached_property
    def session(self) -> Session:
        """The map session."""
        return self.capture[f"{self.device}_map"]

    @cached_property
    def turns(self) -> Turns | None:
        """The turns that make the capture's images upright; None if no network of the run needs upright images."""
        if (turns := self.turns_for(self.settings)) is not None:
            return turns
        reranks = self.reranked and KINDS[self._verification[0].name].upright
        describes = self.files is not None and any(map(self.shows_upright, self.embedders))
        return self._upright if reranks or describes else None

    def turns_for(self, settings: LocalizeSettings) -> Turns | None:
        """Return the turns for a localizer in this map; None if it needs no upright images.

        Args:
            settings: those of the map, or others that need the same features.
        """
        if not needs_upright(settings, [*self.kinds, *self.escalation]):
            return None
        same = settings.world_up == self.settings.world_up
        return self._upright if same else upright_turns(self.capture, settings.world_up)

    @cached_property
    def _upright(self) -> Turns:
        return upright_turns(self.capture, self.settings.world_up)

    def shows_upright(self, embedder: Embedder) -> bool:
        """Tell whether the run turned images upright for one of its embedders."""
        return shows_upright(embedder, self.embed_settings.upright)

    def turns_of(self, kind: AnyMethod, session: Session) -> NDArray[np.int64] | None:
        """Return the turns that make a session's images upright; None if this kind of features does not need them."""
        return self._upright.of(session) if KINDS[kind.name].upright else None

    def on_demand(self, kind: AnyMethod) -> OnDemandFeatures:
        """Return the map images' features of a kind for which the map has no points."""
        if kind.name not in self._on_demand:
            assert self.features_dir is not None
            turns = self.turns_of(kind, self.session)
            self._on_demand[kind.name] = OnDemandFeatures(self.session, self.features_dir, kind.extractor, turns)
        return self._on_demand[kind.name]

    @cached_property
    def _on_demand(self) -> dict[str, OnDemandFeatures]:
        return {}

    @property
    def consistency(self) -> Consistency:
        """How well the poses of the map agree with its images; unknown if the map has no points."""
        return self.mapped[0].map.consistency if self.mapped else Consistency()

    @property
    def refined_poses(self) -> dict[str, Floats]:
        """Pose (4, 4) of each map image by its name, if the map was built with refined poses; else empty."""
        refined = self.mapped and self.settings.map is not None and self.settings.map.refine_poses
        return self.mapped[0].map.poses if refined else {}

    @property
    def length(self) -> float:
        """The length that localizers treat as one meter, in the unit of the poses; see `Survey.length`."""
        return self.mapped[0].map.length if self.mapped else 1.0

    @cached_property
    def in_lengths(self) -> list[MappedFeatures]:
        """`mapped`, with points and poses divided by the map's length."""
        return [kind.with_map(kind.map.scaled(1 / self.length)) for kind in self.mapped]

    @property
    def sure_position_std(self) -> float:
        """`SURE_POSITION_STD_M` in the unit of the poses."""
        return SURE_POSITION_STD_M * (1.0 if self.settings.unit else self.length)

    @property
    def remarks(self) -> str:
        """Warnings for the user about the map; empty if there are none, or if the map has no points."""
        if not self.mapped:
            return ""
        parts, depth = [self.consistency.text, self._noise], self.length * USUAL_DEPTHS_M[int(self.length > 1)]
        plausible = self.consistency.verdict != "inconsistent"
        if plausible and self.settings.unit and self.length != 1 and not ODD_DEPTHS_M[0] < depth < ODD_DEPTHS_M[1]:
            odd = f"the median depth of the map is {depth:.3g} m"
            fix = "write `unit: null` in the manifest, or import them with their `--unit`"
            parts.append(f"{odd}: if its poses are not in meters, {fix}")
        return "; ".join(filter(None, parts))

    @property
    def _noise(self) -> str:
        """How good the poses are, if their noise is worth a word."""
        noise = self.consistency
        if not noise.trusted:  # wrong intrinsics look like noise of the poses
            return ""
        if noise.rotation_noise_deg < WORTH_DEG and noise.position_noise < WORTH_LENGTHS:
            return ""
        unit, factor = ("m", 1.0) if self.settings.unit else ("of the median depth", 1 / NOMINAL_DEPTH)
        position = np.sqrt(3) * noise.position_noise * (self.length if self.settings.unit else factor)
        text = f"{100 * position:.2g} c{unit}" if unit == "m" else f"{100 * position:.2g} % {unit}"
        return f"the poses of the map are good to about {np.sqrt(3) * noise.rotation_noise_deg:.2g} deg, {text}"

    def record(self) -> dict[str, Any]:
        """Return the unit, depth, length and consistency of the map, for JSON."""
        depth = self.length * NOMINAL_DEPTH if self.settings.unit is None else None
        unit = {"unit": self.settings.unit, "depth": depth, "length": self.length}
        return {**unit, "text": self.remarks, **asdict(self.consistency)}

    def judged(self, estimate: PoseEstimate) -> PoseEstimate:
        """Return the estimate; with low confidence if the map's poses or intrinsics contradict its images."""
        if self.consistency.trusted or estimate.world_from_rig is None:
            return estimate
        # In such a map, a misfit says nothing about the query's camera.
        reason = "; ".join(filter(None, ["" if estimate.misfit else estimate.reason, self.consistency.text]))
        what = "poses" if self.consistency.verdict == "inconsistent" else "intrinsics"
        status = f"low_confidence: the {what} of the map contradict its images"
        return replace(estimate, status=status, reason=reason, focals_px=(), centers_px=())

    @cached_property
    def localizer(self) -> Localizer:
        """The localizer of the map's own settings."""
        return create_localizer(self.settings, self)

    def load(self) -> None:
        """Load what all queries share, before several threads find it missing: `cached_property` has no lock."""
        _ = self.localizer, self.index_of, self.embedders, self._descriptors, self._index
        if self.reranked:
            _ = self._verification
        for kind in self.escalation:
            _ = kind.extractor

    @cached_property
    def index_of(self) -> dict[str, int]:
        """Index of each map image in `localizer.image_names`, by its name."""
        return {name: index for index, name in enumerate(self.localizer.image_names)}

    @cached_property
    def embed_settings(self) -> EmbedSettings:
        """Embed settings of the run."""
        return _read_settings(self._run.embeddings / "settings.json", EmbedSettings)

    @cached_property
    def retrieve_settings(self) -> RetrieveSettings:
        """Retrieve settings of the run."""
        return _read_settings(self._run.retrieval_dir / "settings.json", RetrieveSettings)

    @cached_property
    def embedders(self) -> list[Embedder]:
        """The embedders that the run used.

        Raises:
            ArtifactError: the map's vectors are from another one.
        """
        settings = self.embed_settings
        folders = embedding_folders(self._run.embeddings).values()
        learned = {
            "checkpoint": settings.checkpoint,
            "device": settings.compute_device,
            "dtype_compute": settings.dtype_compute,
            "image_size": settings.image_size,
        }
        embedders = [
            create_embedder(name, **({"vocabulary": folder / "vlad.npz"} if name == "vlad" else learned))
            for name, folder in zip(settings.models, folders, strict=True)
        ]
        for embedder, vectors in zip(embedders, self._stored[0].each, strict=True):
            if vectors.embedder not in ("", embedder_fingerprint(embedder.settings)):
                raise ArtifactError(
                    f"{vectors.paths[0]} was made by another embedder or vocabulary than the run's {embedder.name} of "
                    "now. Run the embed stage again."
                )
        return embedders

    @property
    def _run(self) -> SceneFiles:
        if self.files is None:
            raise ArtifactError("This map was not opened from a run, so its embedder is unknown. Use Map.open.")
        return self.files

    @cached_property
    def _stored(self) -> tuple[Vectors, NDArray[np.int64]]:
        """Global descriptors (N, D) of the posed map images, on disk, as they are searched; rows of the images (N,)."""
        normalize = self.retrieve_settings.normalize
        vectors, table = open_descriptors(self._run.embeddings, f"{self.device}_map", normalize)
        rows = np.array([self.session.row_of_name[image_name(path)] for path in table["abs_path"]], np.int64)
        posed = np.isfinite(self.session.world_from_cam(rows)).reshape(-1, 16).all(axis=1)
        return vectors.choose(np.flatnonzero(posed)), rows[posed]

    @cached_property
    def _descriptors(self) -> tuple[NDArray[np.float32] | Vectors, NDArray[np.int64]]:
        """`_stored`, in memory unless the map is large."""
        vectors, rows = self._stored
        small = 4 * vectors.shape[1] * len(vectors) < MOST_IN_MEMORY
        return vectors[:] if small else vectors, rows

    @cached_property
    def _index(self) -> VectorIndex | JoinedIndex | None:
        """The index of the descriptors, if the run has one."""
        settings = self.retrieve_settings.model_copy(update={"faiss_gpu": False})  # this machine may have no GPU
        return load_index(self._run.embeddings, f"{self.device}_map", self._stored[0], settings)

    def retrieve(
        self,
        described: Sequence[NDArray[np.float32]],
        pictures: Sequence[Callable[[bool], NDArray[np.uint8]]] = (),
        cameras: Sequence[pycolmap.Camera] = (),
        turns: Sequence[int] = (),
        near: Sequence[RoughPose] = (),
    ) -> list[References]:
        """Return the references of Q query images, as the run would find them.

        Args:
            described: for each of the `embedders`, its global descriptors (Q, D) of the images.
            pictures: for each image a function that returns its pixels, in color if called with True. Needed only if
                the run reranks, like `cameras` and `turns`.
            cameras: intrinsics of the images.
            turns: quarter turns that make the images upright.
            near: rough poses of the cameras, to which retrieval is restricted; empty: no restriction.

        Raises:
            ArtifactError: the map was embedded by another embedder.
        """
        database, rows = self._descriptors
        dims = self._stored[0].dims
        for embedder, vectors, dim in zip(self.embedders, described, dims, strict=True):
            if vectors.shape[1] != dim:
                raise ArtifactError(
                    f"{self._run.embeddings}: found descriptors of {dim} dimensions for the map, expected "
                    f"{vectors.shape[1]} of {embedder.name}. Run the embed stage again."
                )
        query = np.hstack([self._as_searched(vectors) for vectors in described])
        topk = self.retrieve_settings.topk
        allowed = [self._may_show(rows, pose) for pose in near] or [None]
        parts = np.split(query, len(allowed))
        results = [
            search(part, database, topk, "torch", "cpu", index=self._index, allowed=mask, dims=dims)
            for part, mask in zip(parts, allowed, strict=True)
        ]
        all_scores, neighbors = (np.concatenate(arrays) for arrays in zip(*results, strict=True))
        ranked = [
            (rows[indices[indices >= 0]], scores[indices >= 0].astype(np.float64))
            for indices, scores in zip(neighbors, all_scores, strict=True)
        ]
        if self.reranked:
            ranked = [self._rerank(*image) for image in zip(ranked, pictures, cameras, turns, strict=True)]
        references = []
        for images, similarities in ranked:
            indices = np.array([self.index_of.get(self.session.image_name(int(row)), -1) for row in images], np.int64)
            references.append(References(indices[indices >= 0], similarities[indices >= 0]))
        return references

    def _may_show(self, rows: NDArray[np.int64], pose: RoughPose) -> NDArray[np.bool_] | None:
        """Return which map images (N,) may show what a camera at a rough pose sees; None if none may.

        Args:
            rows: of the map images in the session.
            pose: of the camera.
        """
        mask = masks.near(
            self.session.world_from_cam(rows),
            pose.world_from_rig,
            NEAR * self.length + 3 * pose.position_std_m,
            NEAR_DEG + 3 * pose.rotation_std_deg,
        )
        return mask if mask.any() else None

    def _as_searched(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return descriptors normalized and rounded like those of the map, which were written to a file."""
        if self.embed_settings.normalize:
            vectors = unit(vectors)
        vectors = vectors.astype(self.embed_settings.dtype).astype(np.float32)
        return unit(vectors) if self.retrieve_settings.normalize else vectors

    @cached_property
    def _verification(self) -> tuple[LocalMethod, Verifier]:
        """Features and verifier of the run's rerank stage."""
        settings = _read_settings(self._run.reranked_dir / "settings.json", RerankSettings)
        (method,) = create_local_methods(settings)
        store = FeatureStore.of_session(self._run.features, f"{self.device}_map", method.extractor.settings)
        return method, Verifier(settings, method.matcher, store)

    def _rerank(
        self,
        ranked: tuple[NDArray[np.int64], NDArray[np.float64]],
        picture: Callable[[bool], NDArray[np.uint8]],
        camera: pycolmap.Camera,
        turns: int,
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return rows of map images and their inlier counts, most inliers first, as the rerank stage does."""
        method, verifier = self._verification
        settings, rows = verifier.settings, ranked[0][: verifier.settings.topn]
        pixels = picture(method.extractor.color)
        turns = turns if KINDS[method.name].upright else 0
        (features,) = extract_turned(method.extractor, [pixels], [turns])
        readable = [index for index, row in enumerate(rows) if self.session.image_name(int(row)) in verifier.store]
        inliers = np.zeros(len(rows))
        inliers[readable], _ = verifier.verify(
            features,
            camera,
            [self.session.image_name(int(rows[index])) for index in readable],
            self.session.cameras(rows[readable]),
        )
        order = np.argsort(-inliers, kind="stable")[: settings.topk]
        return rows[order], inliers[order]


def no_such_run(run: Path) -> str:
    """Return a message that lists the runs beside a folder that is none."""
    return f"{run}: no such run. {nearest(run.name, [path.parent.name for path in run.parent.glob(f'*/{RECORD}')])}"


def localized_scenes(run: Path) -> list[str]:
    """Return the names of the captures that a run has localized, in order."""
    return sorted(path.parent.name for path in run.glob("*/poses"))


def _unknown(files: SceneFiles, device: str) -> str:
    """Return a message that says which of run, scene and device is unknown, and lists the known ones."""
    run = files.run
    if not run.is_dir():
        return no_such_run(run)
    scenes = localized_scenes(run)
    if files.scene not in scenes:
        return f"{run}: no poses of the scene {files.scene!r}. {nearest(files.scene, scenes)}"
    devices = {pair_devices(path.stem)[0] for path in files.poses_dir.glob("*.h5")}
    return f"{files.poses_dir}: no poses of queries in the map of {device!r}. {nearest(device, devices)}"


Localized = tuple[LocalizeSettings, dict[str, Any], list[str]]
"""Settings that a pair was localized with, attributes of its `.h5` file, and the file names of its maps."""


def how_localized(pair: Path) -> Localized:
    """Return how the queries of a pair were localized.

    Args:
        pair: `poses/<pair>.h5`.

    Raises:
        ArtifactError: the file is missing, damaged, or lacks the attributes.
    """
    try:
        with h5py.File(pair, "r") as file:
            attributes = dict(file.attrs)
            return LocalizeSettings.of(json.loads(attributes[SETTINGS])), attributes, json.loads(attributes[MAPS])
    except ManifestError:
        raise ArtifactError(f"{pair}: another version of the toolkit has localized it. Localize again.") from None
    except (*HDF5_ERRORS, ToolkitError) as error:
        raise ArtifactError(f"{pair}: cannot read how it was localized ({error}). Localize again.") from None


def _last_localized(files: SceneFiles, pairs: Sequence[Path]) -> Localized:
    """Return how a pair of the last run was localized; pairs of earlier runs may have other settings.

    The last run is known by its settings file. File times would be unreliable, as clocks can be set back.
    """
    last = None
    with suppress(ArtifactError):  # the run is of a version that wrote no such file, or other settings
        last = _read_settings(files.poses_dir / "settings.json", LocalizeSettings)
    localized, message = [], ""
    for pair in pairs:
        try:
            localized.append(how_localized(pair))
        except ArtifactError as error:
            message = str(error)
    if not localized:
        raise ArtifactError(message)
    return next((one for one in localized if one[0] == last), localized[-1])


AnySettings = TypeVar("AnySettings", bound=Settings)


def _read_settings(path: Path, model: type[AnySettings]) -> AnySettings:
    """Return the settings that a stage wrote beside its results.

    Raises:
        ArtifactError: the file is missing, damaged, or of another version.
    """
    try:
        return model.of(json.loads(path.read_text(encoding="utf-8")))
    except ManifestError:
        raise ArtifactError(f"{path}: another version of the toolkit wrote it. Run the stage again.") from None
    except (OSError, ValueError) as error:
        raise ArtifactError(f"{path}: cannot read the settings of the stage ({error}). Run the stage again.") from None


def session_fingerprint(session: Session) -> str:
    """Return 16 hex digits that identify the calibration, poses and image list of a session."""
    files = ["sensors.txt", "images.txt", "rigs.txt", "trajectories.txt"]
    return fingerprint([file_fingerprint(session.path / name) for name in files if (session.path / name).exists()])


def needs_upright(settings: LocalizeSettings, kinds: Sequence[AnyMethod]) -> bool:
    """Tell whether a network that localizes needs upright images; `kinds` are the kinds of features."""
    return settings.predicts or any(KINDS[kind.name].upright for kind in kinds)


def create_localizer(settings: LocalizeSettings, map: Map, predictor: Predictor | None = None) -> Localizer:  # noqa: A002
    """Return the localizer of `settings.method` for a map.

    Args:
        settings: those of the map, or others that need the same features.
        map: the map.
        predictor: for `feed_forward` and `hybrid`; None: opened according to the settings.

    Raises:
        ArtifactError: the map was built for `nearest` and has no points.
        WeightsError: the network has no weights.
    """
    if settings.method == "nearest":
        posed = PosedImages.of_session(map.session)
        return NearestLocalizer(posed.names, posed.world_from_cams)
    if not map.kinds:
        raise ArtifactError(
            f"The map of {map.device!r} was built for the method {map.settings.method!r} and has no points, which the "
            f"method {settings.method!r} needs. Localize with {settings.method!r} first."
        )
    if settings.map is None:
        return _escalating(_on_demand(settings, map, map.kinds), settings, map)
    pnp = PnpLocalizer(map.in_lengths, settings.pnp, settings.seed)
    if not settings.predicts:
        return _escalating(_scaled(pnp, map), settings, map)
    predictor = predictor or open_predictor(settings, map.capture, map.map_dir)
    local_map, turns = map.in_lengths[0].map, map.turns_for(settings)
    feed_forward = FeedForwardLocalizer(local_map, map.session, predictor, settings.predictor, turns, map.length)
    if settings.method == "feed_forward":
        return _scaled(feed_forward, map)
    return _escalating(_scaled(HybridLocalizer(pnp, feed_forward), map), settings, map)


def _scaled(localizer: Localizer, map: Map) -> Localizer:  # noqa: A002
    return localizer if map.length == 1.0 else ScaledLocalizer(localizer, map.length)


def _escalating(first: Localizer, settings: LocalizeSettings, map: Map) -> Localizer:  # noqa: A002
    """Return a localizer that uses the escalation features, if there are any, where `first` gives no sure pose."""
    if not map.escalation or not map.consistency.trusted:  # no features make up for a wrong map
        return first
    kinds: list[AnyMethod] = [*(map.kinds if settings.map is None else ()), *map.escalation]
    second = _scaled(_on_demand(settings, map, kinds, first.image_names), map)
    rows = np.array([map.session.row_of_name[name] for name in first.image_names], np.int64)
    near = partial(_images_near, map.session.world_from_cam(rows), NEAR * map.length)
    return EscalatingLocalizer(first, second, map.escalation, map.sure_position_std, near)


def _images_near(world_from_cams: Floats, distance: float, world_from_rig: Floats) -> Ints:
    """Return the map images, by index, that may show what a rig at a pose (4, 4) sees."""
    return np.flatnonzero(masks.near(world_from_cams, world_from_rig, distance, NEAR_DEG))


def _on_demand(
    settings: LocalizeSettings,
    map: Map,  # noqa: A002
    kinds: Sequence[AnyMethod],
    names: list[str] | None = None,
) -> OnDemandLocalizer:
    """Return a localizer with the points of the map, and for the given kinds points triangulated for each query.

    `names` are the names of its images; None: all map images with a pose.
    """
    return OnDemandLocalizer(
        PosedImages.of_session(map.session, names, map.length, map.refined_poses),
        map.in_lengths,
        [(kind, partial(lambda kind, name: map.on_demand(kind)(name), kind)) for kind in kinds],
        settings.map,
        settings.pnp,
        settings.seed,
    )


def create_methods(settings: LocalizeSettings) -> tuple[list[LocalMethod], list[DeferredMethod]]:
    """Return the kinds of features that every query needs, and those for queries without a sure pose.

    Raises:
        WeightsError: a network has no weights.
    """
    if settings.method == "nearest":
        return [], []
    further = settings.features.escalation if settings.method in ("pnp", "hybrid") else []
    if further:
        weights_files(settings)
    return create_local_methods(settings), [DeferredMethod(settings, name) for name in further]


def label(settings: LocalizeSettings, found_by: str) -> str:
    """Return the `method` column of a table row: how the pose was found; without a pose, the method of the run."""
    if settings.predicts and settings.predictor.name == "simulated":
        return f"{settings.method}:simulated" + (f"/{found_by}" if found_by else "")
    return found_by or settings.method


def attributes(
    settings: LocalizeSettings, kinds: Sequence[LocalMethod], capture: Capture, device: str, retrieval_dir: Path
) -> dict[str, str]:
    """Return the attributes of a pair's `.h5` file from which `Map.open` opens the map.

    Args:
        settings, kinds: those that the queries were localized with.
        capture: the capture.
        device: the map device.
        retrieval_dir: folder of the references.
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
