"""The map of one device, and the way of an image through it: query, describe, retrieve, match, solve, locate."""

import copy
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture import Capture, Session
from toolkit.capture.images import camera_text, thumbnails
from toolkit.capture.session import RECONSTRUCTION_RECORD
from toolkit.capture.upright import Turns, upright_turns
from toolkit.embedders import embedding_folders
from toolkit.embedders.embedded import Describer, Embedded
from toolkit.embedders.masks import Masks, Priors, enabled_priors, near_masks
from toolkit.embedders.masks import near as within
from toolkit.embedders.search import embedder_fingerprint, load_index, search
from toolkit.errors import ArtifactError
from toolkit.features.features import KINDS, LocalFeatures, SiftExtractor
from toolkit.features.matching import (
    AnyMethod,
    DeferredMethod,
    LocalMethod,
    MutualMatcher,
    Verifier,
    create_local_methods,
    create_methods,
    needs_upright,
)
from toolkit.features.stores import FeatureStore, OnDemandFeatures, extract_session
from toolkit.files import RAW_DATA, SceneFiles, map_record_path, read_json, require_current
from toolkit.geometry import Floats, Ints, unit
from toolkit.manifest import EmbedSettings, LocalizeSettings, RerankSettings, RetrieveSettings
from toolkit.mapping.build import build_map
from toolkit.mapping.local_map import Consistency, LocalMap, map_path
from toolkit.mapping.pose_consistency import NOMINAL_DEPTH, remarks
from toolkit.pose.base import (
    NOISE,
    SEARCH_DEG,
    Localizer,
    NearestLocalizer,
    Prior,
    Query,
    QueryInput,
    QueryMatches,
    QueryResult,
    References,
    Rival,
    RoughPose,
    Status,
    View,
    agree,
)  # fmt: skip
from toolkit.pose.local_triangulation import OnDemandLocalizer, PosedImages
from toolkit.pose.map_matching import MappedFeatures, with_own_focals
from toolkit.pose.pnp import RIVAL_DISTANCE, PnpLocalizer, bounded_by_rivals, clarity_of_support
from toolkit.prediction.feed_forward import FeedForwardLocalizer, depth_of_images
from toolkit.prediction.hybrid import MAX_FEATURES, DepthLifter, HybridLocalizer, lifts
from toolkit.prediction.interface import Predictor
from toolkit.prediction.network import open_predictor
from toolkit.results.metrics import UNKNOWN_UNIT, length_unit
from toolkit.results.pair import (
    RETRIEVAL,
    SESSION_FILES,
    SESSIONS_ROOT,
    Localized,
    find_query,
    how_localized,
    last_localized,
    map_inputs,
    pairs_in_map,
)  # fmt: skip
from toolkit.scene.query import MapCameras, answer_of, query_from, show_matches, what_if, with_changes
from toolkit.threads import fixed_sums

if TYPE_CHECKING:
    from toolkit.figures.answers import Answer, Comparison
    from toolkit.viewer.queries import View3D

log = logging.getLogger(__name__)

WITHOUT_FEATURES = ("feed_forward", "nearest")
"""Methods that need no local features of the queries."""
NEAR, NEAR_DEG = 10.0, 60.0
"""Largest distance (map lengths, see `LocalMap.length`) and angle (degrees) between a camera and a map image that may
show the same scene."""
MAX_SURE_STD_M = 0.05
"""An `ok` pose with at most this standard deviation of the position, meters, is precise enough. Otherwise the fallback
features are used too."""
FEW_REFERENCES = 4
"""How many references, those that support an `ok` pose most, fallback features are matched with at first."""
MAX_KNOWN = 3
"""Largest number of earlier poses of a query that the fallback features judge, too."""
MAX_IN_MEMORY = 1 << 29
"""Largest size in bytes of global descriptors (float32) that an open map keeps in memory; larger ones stay on disk."""
Ranked = tuple[Ints, Floats]
"""Rows (k,) of map images in their session, best first, and their scores (k,)."""


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
    """Fallback features for queries whose pose is not sure without them; the map has no points of these kinds."""
    features_dir: Path | None = None
    """Folder of all local features."""
    files: SceneFiles | None = None
    """Files of the run; None: images from outside a session cannot be localized, as that needs the run's embedder."""
    reranked: bool = False
    """Whether the run localized with reranked references."""
    predictor: Predictor | None = None
    """Network of `feed_forward` and `hybrid`; None: opened as the settings say."""
    original: LocalMap | None = None
    """The run's first map, for a map with changed settings: its length and consistency hold for that one, too."""

    def build(self, workers: int = 1, skip_existing: bool = True) -> "Map":
        """Extract features of the map session and triangulate points, or load them; return the map with them."""
        mapped, settings, built = list[MappedFeatures](), self.settings, copy.copy(self)
        built.mapped = mapped
        session = built.session
        for kind in self.kinds if settings.map is not None else ():
            assert settings.map is not None
            assert self.features_dir is not None
            turns = built.turns_of(kind, session)
            store = extract_session(session, self.features_dir, kind.extractor, workers=workers, turns=turns)
            inputs = map_inputs(session, store)
            local_map = build_map(
                session, store, map_path(self.map_dir, session.id, kind.name), settings.map, settings.seed,
                skip_existing, inputs, workers, settings.unit is not None, built.refined_poses or None,
            )  # fmt: skip
            mapped.append(MappedFeatures(local_map, store, kind.name, kind.matcher))
        if built.remarks:
            log.warning("%s: %s", session.id, built.remarks)
        return built

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
        pairs, alone = pairs_in_map(files, device), map_record_path(files.poses_dir, scene, device).with_suffix(".h5")
        of_map = [".jsonl", ".npz", *(f"/{device}_map/{name}" for name in (*SESSION_FILES, RAW_DATA))]
        try:
            for pair in pairs:
                require_current(pair.with_suffix(".txt"), "localize", of_map, missing=False)
        except ArtifactError:  # of an earlier map; one that was made without queries since is opened
            if not alone.is_file():
                raise
            pairs = [alone]
        localized = last_localized(files, pairs)
        reranked = Path(localized[1][RETRIEVAL]).name == files.reranked_dir.name
        return replace(cls.of_pair(localized, device, files.features, files.maps), files=files, reranked=reranked)

    @classmethod
    def of_pair(cls, poses: Path | Localized, device: str, features_dir: Path, map_dir: Path) -> "Map":
        """Open the map of a finished pair, with the settings that the pair was localized with, from the given files.

        Args:
            poses: `poses/<pair>.h5`, or what `how_localized` returns for it.
            device: the map device.
            features_dir, map_dir: as given to `localize_pairs`.

        Raises:
            ArtifactError, WeightsError: as `open`.
        """
        settings, h5_attributes, names = how_localized(poses) if isinstance(poses, Path) else poses
        (kinds, escalation), mapped = create_methods(settings), list[MappedFeatures]()
        root = Path(h5_attributes[SESSIONS_ROOT])
        for name, kind in zip(names, kinds if settings.map is not None else (), strict=True):
            store = FeatureStore.of_session(features_dir, f"{device}_map", kind.extractor.settings)
            session = Capture.from_sessions_root(root)[f"{device}_map"]
            require_current(map_dir / name, "localize", inputs=map_inputs(session, store))
            mapped.append(MappedFeatures(LocalMap.load(map_dir / name), store, kind.name, kind.matcher))
        return cls(device, root, map_dir, settings, kinds, mapped, escalation, features_dir)

    @cached_property
    def capture(self) -> Capture:
        return Capture.from_sessions_root(self.sessions_root)

    @cached_property
    def session(self) -> Session:
        """The map session."""
        return self.capture[f"{self.device}_map"]

    def _repr_html_(self) -> str:
        session, points = self.session, self.points
        kinds: list[AnyMethod] = [*self.kinds, *self.escalation]
        features = ", ".join(kind.name for kind in kinds) or "no features"
        text = f"{len(session)} images, {0 if points is None else len(points.points)} points; "
        text += f"{self.settings.method} with {features}. {self.remarks}"
        rows = session.camera_rows[:: max(1, len(session) // 6)][:6].tolist()
        head = f"<p><b>map of {escape(self.device)}</b> in {escape(self.capture.name)}: {escape(text)}</p>"
        return head + thumbnails(session.image_path(row) for row in rows)

    # The way of an image

    query = staticmethod(query_from)

    def query_of_session(self, session: Session, rows: Ints) -> Query:
        """Return a query of images that one device took at one instant, given by their rows in a session."""
        turns = np.zeros(len(rows), np.int64) if self.turns is None else self.turns.of(session, rows)
        views = [
            View(session.image_name(row), session.image_path(row), camera, False, turn, session.mask_path(row))
            for row, camera, turn in zip(rows.tolist(), session.cameras(rows), turns.tolist(), strict=True)
        ]
        return Query(views, session.rig_from_cam(rows))

    @fixed_sums
    def describe(self, query: Query) -> Query:
        """Return a query with its local features and, if the map is of a run, its global descriptors.

        Raises:
            ImageError: an image cannot be read, or has another size than its camera.
        """
        query = self._with_features(query)
        if self.files is None or len(query.descriptors):
            return query
        return replace(query, descriptors=self.search.describe(query, self.kinds))

    @fixed_sums
    def retrieve(self, query: Query, k: int | None = None, near: RoughPose | None = None) -> "Retrieved":
        """Return the references of each image of a query, as the run would find them.

        Args:
            query: described here if it is not.
            k: number of references; None: as many as in the run.
            near: a rough pose of the query. Its references then look the same way from nearby, if there are any.
                Without it, the run's priors (`retrieve.mask`) limit those of images of a session; others have none.

        Raises:
            ArtifactError: the map was not opened from a run, or was embedded by another embedder.
        """
        query = self.describe(query)
        references = Retrieved(self, query)
        for rows, scores in self.search.find(query, k, None if near is None else self._near(query, near)):
            indices = np.array([self.index_of.get(self.session.image_names[row], -1) for row in rows], np.int64)
            references.append(References(indices[indices >= 0], scores[indices >= 0]))
        return references

    def match(self, query: Query, references: Sequence[References], localizer: Localizer | None = None) -> QueryMatches:
        """Return the matches of a query with its references; they are computed when they are needed.

        Localizers assume map lengths, and so do the matches. `localizer` is that of the map or, with the fallback
        features, `fallback`; the same one solves the matches.
        """
        return (localizer or self.localizer).match(self._with_features(query).scaled(1 / self.length), references)

    show_matches = show_matches

    def show_3d(self) -> "View3D":
        """Return the map in 3D: points and cameras; see `QueryResult.show_3d`."""
        from toolkit.viewer.queries import View3D

        return View3D([], False, self.session, self.points, self.settings.world_up, length_unit(self.record()))

    def find_image(self, name: str) -> int:
        """Return the index of a map image, as `References` have it, given its name or a unique end of it.

        Raises:
            ArtifactError: no map image has this name, or several do; names the nearest.
        """
        return find_query(name, self.index_of, len(self.index_of), "map image")

    @fixed_sums
    def solve(
        self,
        query: Query,
        matches: QueryMatches,
        prediction: Any = None,
        priors: Sequence[Prior] = (),
        localizer: Localizer | None = None,
    ) -> QueryResult:
        """Return the pose of a query from its matches, in the unit of the map's poses; see `Localizer.solve`."""
        in_lengths = [prior.scaled(1 / self.length) for prior in priors]
        result = (localizer or self.localizer).solve(matches, prediction, in_lengths)
        if self.estimated_cameras.issuperset(camera_text(view.camera) for view in query.views):
            result = with_own_focals(matches.query, result, self.settings.pnp.ransac_max_error_deg)
        result = self.finished(query, result.scaled(self.length))
        # Results may be many, so they keep neither pixels of files nor features.
        views = [replace(view, _decoded={}) for view in query.views]
        lean, references = replace(query, views=views, features=[], network_matches=[]), matches.references
        context = Located(partial(answer_of, self, lean, references), lambda: (self, lean, references))
        return replace(result, context=context)

    @fixed_sums
    def locate(
        self,
        query: Query,
        near: RoughPose | None = None,
        references: Sequence[References] | None = None,
        prediction: Any = None,
    ) -> QueryResult:
        """Return the pose of a query: describe, retrieve, match and solve, and the fallback features if it is unsure.

        Args:
            query: with or without features.
            near: a rough pose, if it is known. References are then map images that look the same way from nearby, and
                features are also matched near the projections of the map points at this pose.
            references: those of each image; None: retrieve them.
            prediction: of a network for this query, see `predict`; None: predicted here if it is needed.

        Returns:
            The result. Its `world_from_rig` (4, 4) is world_from_cam for a single image, and None if `status` is
            `failed`.

        Raises:
            ImageError: an image cannot be read, or has another size than its camera (CameraError).
            ArtifactError: files of the run are missing.
        """
        started = time.perf_counter()
        query = self.describe(query) if references is None else self._with_features(query)
        references = self.retrieve(query, near=near) if references is None else references
        priors = [] if near is None else [self._prior(near, references)]
        result = self.solve(query, self.match(query, references), prediction, priors)
        results = [replace(result, seconds=time.perf_counter() - started)]
        while asked := self.asked_next(query, references, results):
            query = self._with_fallback_features(query) if len(results) == 1 else query
            matches = self.match(query, asked, self.fallback)
            query = replace(query, network_matches=matches.query.network_matches)  # the next round has them again
            results.append(self.retry(query, matches, results[-1], priors))
        return replace(results[-1], seconds=time.perf_counter() - started)

    def predict(self, queries: Sequence[QueryInput]) -> list[Any]:
        """Return a network's prediction for each query, for `locate`; see `Localizer.predict`."""
        return self.localizer.predict([(query.scaled(1 / self.length), references) for query, references in queries])

    def is_unsure(self, result: QueryResult) -> bool:
        """Tell whether fallback features, if there are any, might find a better pose."""
        if self.fallback is None or result.camera_contradicted or result.reason == NOISE:  # no features repair that
            return False
        limit = MAX_SURE_STD_M * (1.0 if self.settings.unit else self.length)
        # A pose without matches has no deviation (NaN) and counts as precise.
        return result.status is not Status.OK or result.position_std > limit

    def asked_next(
        self, query: Query, references: Sequence[References], results: Sequence[QueryResult]
    ) -> Sequence[References]:
        """Return the references that fallback features are matched with in the next round, for `retry`; empty if there
        is none. `results` are those of the rounds so far: the first without fallback features.

        An `ok` pose only lacks precision, so the references that support it most are asked before all are: these only
        if the few have not made the pose sure, or have moved it elsewhere.
        """
        first, latest = results[0], results[-1]
        readable = zip(query.features, references, strict=True)
        if not self.is_unsure(first) or all(isinstance(has, str) or not len(found.images) for has, found in readable):
            return []
        best = [self.index_of[name] for name in first.references[:FEW_REFERENCES] if first.status is Status.OK]
        few = [found.take(np.isin(found.images, best)) for found in references]
        counts = [sum(len(found.images) for found in asked) for asked in (few, references)]
        rounds = [few, references] if 0 < counts[0] < counts[1] else [references]
        goes_on = self.is_unsure(latest) or self._differ(first.world_from_rig, latest.world_from_rig)
        return rounds[len(results) - 1] if len(results) <= len(rounds) and goes_on else []

    @fixed_sums
    def retry(
        self, query: Query, matches: QueryMatches, first: QueryResult, priors: Sequence[Prior] = ()
    ) -> QueryResult:
        """Retry an unsure query with its matches of `fallback`; return the better of both results.

        `first` is the latest result. `found_by` names the fallback features if the pose was computed with them.
        """
        poses = [first.world_from_rig, *(rival.world_from_rig for rival in first.rivals)]
        # As read from a file, so that results do not depend on whether the poses were stored.
        known = [geometry.pose_from_qt(geometry.qt_from_pose(pose)) for pose in poses[:MAX_KNOWN] if pose is not None]
        # The earlier poses are judged by all kinds of features.
        known_priors = [
            Prior(pose, images, SEARCH_DEG[0], "first") for pose in known if len(images := self._images_near(pose))
        ]
        result = self.solve(query, matches, None, [*priors, *known_priors], self.fallback)
        result = replace(result, found_by="+".join([result.found_by, *(kind.name for kind in self.escalation)]))
        if first.status is Status.OK:
            result = self._with_rivals_of(first, result)
        # Not `ok` beside its rivals, even if all else is certain: what was first may be one of them.
        rivaled = self._beside(1.0, result.rivals) < self.settings.pnp.ok_probability
        better = result.status.rank >= max(first.status.rank, 1) or (result.status is Status.LOW_CONFIDENCE and rivaled)
        earlier = first.first_seconds
        return replace(
            result if better else first,
            first_status=first.first_status or first.status_text,
            first_seconds=round(first.seconds, 4) if earlier is None else earlier,
            context=first.context,  # it has all references
        )

    def _beside(self, probability: float, rivals: Sequence[Rival]) -> float:
        """Return the probability that a pose is correct, bounded by its rivals in this map."""
        clarity = clarity_of_support(self.consistency.direction_noise_deg, self.settings.pnp.max_error_deg)
        return bounded_by_rivals(probability, [rival.support for rival in rivals], clarity)

    def _with_rivals_of(self, first: QueryResult, result: QueryResult) -> QueryResult:
        """Return a result that also has the rivals of an `ok` first one, whose places few references may not show."""
        poses = [result.world_from_rig, *(rival.world_from_rig for rival in result.rivals)]
        forgotten = [rival for rival in first.rivals if all(self._differ(rival.world_from_rig, pose) for pose in poses)]
        if not forgotten or result.world_from_rig is None:
            return result
        rivals = sorted([*result.rivals, *forgotten], key=lambda rival: -rival.support)
        probability = self._beside(result.p_correct, rivals)
        return replace(
            result,
            status=Status.LOW_CONFIDENCE if probability < self.settings.pnp.ok_probability else result.status,
            p_correct=probability,
            rivals=tuple(rivals),
            rival_support=rivals[0].support,
        )

    def _differ(self, world_from_rig: Floats | None, other: Floats | None) -> bool:
        """Tell whether two poses are clearly different, in the lengths of the map."""
        if world_from_rig is None or other is None:
            return True
        factor = 1 / self.length
        return not agree(geometry.scaled(world_from_rig, factor), geometry.scaled(other, factor), RIVAL_DISTANCE)

    def finished(self, query: Query, result: QueryResult) -> QueryResult:
        """Return a result with the names of images and method; with low confidence if the map contradicts itself."""
        posed, images = result.world_from_rig is not None, tuple(view.name for view in query.views)
        method = result.found_by if posed else ""
        if self.settings.predictor.name == "simulated" and self.settings.predicts:
            method = f"{self.settings.method}:simulated" + (f"/{method}" if method else "")
        result = replace(result, images=images, found_by=method or self.settings.method)
        if self.consistency.trusted or not posed:
            return result
        # There, a contradiction says nothing about the query's camera, and what is called noise has another cause.
        blamed = result.camera_contradicted or result.reason == NOISE
        remark = "; ".join(filter(None, ["" if blamed else result.remark, self.consistency.text]))
        what = "poses" if self.consistency.verdict == "inconsistent" else "intrinsics"
        reason = f"the {what} of the map contradict its images"
        return replace(result, status=Status.LOW_CONFIDENCE, reason=reason, remark=remark, focals_px=(), centers_px=())

    def _prior(self, near: RoughPose, references: Sequence[References]) -> Prior:
        images = np.unique(np.concatenate([retrieved.images for retrieved in references]))
        position_std = near.position_std / self.length  # the depth that it is compared with is in map lengths
        return Prior.about(near.world_from_rig, images, near.rotation_std_deg, position_std, "near")

    def _near(self, query: Query, near: RoughPose) -> Masks:
        """Return which searched map images may show what the images of a query at a rough pose see."""
        limits = NEAR * self.length + 3 * near.position_std, NEAR_DEG + 3 * near.rotation_std_deg
        of_map = self.session, self.search.images.rows
        return near_masks(of_map, near.world_from_rig @ query.rig_from_cams, *limits)

    def _images_near(self, world_from_rig: Floats) -> Ints:
        """Return the map images, by index, that may show what a rig at a pose (4, 4) sees."""
        return np.flatnonzero(within(self._world_from_cams, world_from_rig, NEAR * self.length, NEAR_DEG))

    @cached_property
    def _world_from_cams(self) -> Floats:
        """Poses (N, 4, 4) of the images of the localizer."""
        rows = np.array([self.session.row_of_name[name] for name in self.localizer.image_names], np.int64)
        return self.session.world_from_cam(rows)

    def _with_features(self, query: Query) -> Query:
        if query.features or self.settings.method in WITHOUT_FEATURES or not self.kinds:
            return query
        return replace(query, features=[[view.extract(kind) for kind in self.kinds] for view in query.views])

    def _with_fallback_features(self, query: Query) -> Query:
        features = [
            first if isinstance(first, str) else [*first, *(view.extract(kind) for kind in self.escalation)]
            for view, first in zip(query.views, query.features, strict=True)
        ]
        return replace(query, features=features, network_matches=[])

    # What the way is made of

    @cached_property
    def localizer(self) -> Localizer:
        """The localizer of the map's settings, in map lengths.

        Raises:
            ArtifactError: the map was built for `nearest` and has no points.
            WeightsError: the network has no weights.
        """
        settings = self.settings
        if settings.method == "nearest":
            posed = PosedImages.of_session(self.session, None, self.length)
            return NearestLocalizer(posed.names, posed.world_from_cams)
        if self._unmapped and not settings.predicts:
            return self._on_demand_localizer(self._unmapped)
        if not self.mapped:
            fault = f"The map of {self.device!r} was built for another method than {settings.method!r}"
            do = f"Localize with {settings.method!r} first."
            raise ArtifactError(f"{fault} and has no points, which it needs. {do}")
        pnp = PnpLocalizer(self.in_lengths, settings.pnp, settings.seed)
        if settings.method != "feed_forward":
            for kind in self.in_lengths:
                kind.load()
        if not settings.predicts:
            if lifts(settings, self.session):
                of_image = depth_of_images(self.session, pnp.image_names, self.length)
                pnp.lift = DepthLifter(pnp, of_image, MAX_FEATURES).localize
            return pnp
        predictor = self.predictor or open_predictor(settings, self.capture, self.map_dir)
        unit = ("m", 1 / self.length) if self.settings.unit else (UNKNOWN_UNIT, 1.0)
        feed_forward = FeedForwardLocalizer(
            self.in_lengths[0].map, self.session, predictor, settings.predictor, self.turns, self.length, unit
        )
        return feed_forward if settings.method == "feed_forward" else HybridLocalizer(pnp, feed_forward)

    @cached_property
    def fallback(self) -> Localizer | None:
        """Localizer with the fallback features besides; None if there are none."""
        applies = self.escalation and self.settings.method in ("pnp", "hybrid")
        if not applies or not self.consistency.trusted:  # no features make up for a wrong map
            return None
        kinds: list[AnyMethod] = [*self._unmapped, *self.escalation]
        return self._on_demand_localizer(kinds, self.localizer.image_names)

    @property
    def _unmapped(self) -> list[LocalMethod]:
        """Kinds of features without points in the map: their points are triangulated for each query."""
        mapped = {kind.name for kind in self.mapped}
        return [kind for kind in self.kinds if kind.name not in mapped]

    def _on_demand_localizer(self, kinds: Sequence[AnyMethod], names: list[str] | None = None) -> OnDemandLocalizer:
        """Return a localizer with the points of the map, and for the given kinds points triangulated for each query.

        `names` are the names of its images; None: all map images with a pose.
        """
        settings = self.settings
        return OnDemandLocalizer(
            PosedImages.of_session(self.session, names, self.length, self.refined_poses),
            self.in_lengths,
            [(kind, partial(lambda kind, name: self.on_demand(kind)(name), kind)) for kind in kinds],
            settings.map,
            settings.pnp,
            settings.seed,
        )

    changed = with_changes

    @cached_property
    def search(self) -> "ReferenceSearch":
        """The embedders and descriptors of the run.

        Raises:
            ArtifactError: the map was not opened from a run.
        """
        if self.files is None:
            raise ArtifactError("This map was not opened from a run, so its embedder is unknown. Use Map.open.")
        return ReferenceSearch(self.files, self.capture, self.device, self.reranked)

    def load(self) -> None:
        """Load what all queries share, before several threads find it missing: `cached_property` has no lock."""
        _ = self.localizer, self.index_of, self.fallback, self.session.image_names
        _ = self.search
        for kind in self.escalation:
            _ = kind.extractor

    @cached_property
    def index_of(self) -> dict[str, int]:
        """Index of each map image in `localizer.image_names`, by its name."""
        return {name: index for index, name in enumerate(self.localizer.image_names)}

    @property
    def turns(self) -> Turns | None:
        """The turns that make the capture's images upright; None if no network of the run needs upright images."""
        upright = needs_upright(self.settings, [*self.kinds, *self.escalation])
        return self._upright if upright or (self.files is not None and self.search.shows_upright) else None

    @cached_property
    def _upright(self) -> Turns:
        return upright_turns(self.capture, self.settings.world_up)

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
    def _first(self) -> LocalMap | None:
        return self.original or (self.mapped[0].map if self.mapped else None)

    @property
    def consistency(self) -> Consistency:
        """How well the poses of the map agree with its images; unknown if the map has no points."""
        return self._first.consistency if self._first else Consistency()

    @property
    def refined_poses(self) -> dict[str, Floats]:
        """Pose (4, 4) of each map image by its name, if the map was built with refined poses; else empty."""
        if not self._first or self.settings.map is None or not self.settings.map.refine_poses:
            return {}
        return dict(zip(self._first.image_names, self._first.world_from_cams, strict=True))

    @cached_property
    def cameras(self) -> MapCameras:
        """The cameras of its images, among which that of an image without intrinsics is looked for."""
        return MapCameras(self.session)

    @cached_property
    def estimated_cameras(self) -> set[str]:
        """Intrinsics, as `camera_text` writes them, that a reconstruction estimated, for all images of a camera."""
        given = read_json(self.session.path / RECONSTRUCTION_RECORD).get("given intrinsics")
        if given is None:
            return set()
        sensors = self.session.images["sensor_id"].iloc[self.session.camera_rows].unique()
        return {camera_text(self.session.camera(str(one))) for one in sensors} - {*given}

    @property
    def length(self) -> float:
        """The length that localizers treat as one meter, in the unit of the poses; see `LocalMap.length`."""
        return self._first.length if self._first else 1.0

    @cached_property
    def points(self) -> LocalMap | None:
        """The triangulated points of all kinds of features; None without points."""
        return LocalMap.pooled([kind.map for kind in self.mapped]) if self.mapped else self.original

    @cached_property
    def in_lengths(self) -> list[MappedFeatures]:
        """`mapped`, with points and poses divided by the map's length."""
        return [kind.with_map(kind.map.scaled(1 / self.length)) for kind in self.mapped]

    @property
    def remarks(self) -> str:
        """Warnings for the user about the map; empty if there are none, or if the map has no points."""
        metric = bool(self.settings.unit)
        return "" if self._first is None else remarks(self.consistency, self.length, metric)

    def record(self) -> dict[str, Any]:
        """Return the unit, depth, length and consistency of the map, for JSON."""
        depth = self.length * NOMINAL_DEPTH if self.settings.unit is None else None
        unit = {"unit": self.settings.unit, "depth": depth, "length": self.length}
        return {**unit, "text": self.remarks, **asdict(self.consistency)}


# The references of a query, and what its results need


class Retrieved(list[References]):
    """The references of each image of a query. A notebook displays them as a figure."""

    def __init__(self, scene_map: Map, query: Query) -> None:
        super().__init__()
        self._map, self._query = scene_map, query

    def names(self, image: int = 0) -> list[str]:
        """Return the names of the references of one image of the query, best first."""
        return [self._map.localizer.image_names[index] for index in self[image].images]

    def _repr_html_(self) -> str:
        from toolkit.figures.query_images import draw_query_and_references
        from toolkit.figures.style import picture_of, zoomable

        of_query = [self._paths(image) for image in range(len(self))]
        figure = draw_query_and_references([view.image for view in self._query.views], of_query)
        return zoomable(picture_of(figure), "references of the query")

    def _paths(self, image: int) -> list[tuple[Any, float]]:
        files = map(self._map.capture.image_path, self.names(image))
        return list(zip(files, self[image].scores.tolist(), strict=True))


class Located:
    """A query in its map. What needs the map or features is opened when it is first asked for."""

    def __init__(
        self,
        answer: Callable[[QueryResult], "Answer"],
        open_query: Callable[[], tuple[Map, Query, Sequence[References]]],
    ) -> None:
        """`answer` returns how the query was localized, given a result; `open_query` what is needed to do it again."""
        self.answer, self.open = answer, open_query

    def __deepcopy__(self, memo: Any) -> "Located":
        """Return itself: copies of a result share the map."""
        return self

    def show_3d(self, results: Sequence[QueryResult], rays: bool = False) -> "View3D":
        """See `QueryResult.show_3d`."""
        from toolkit.viewer.queries import View3D

        return View3D.of([result.show() for result in results], rays)

    @cached_property
    def _opened(self) -> tuple[Map, Query, Sequence[References]]:
        return self.open()

    @property
    def what_if(self) -> Callable[..., "Comparison"]:
        """See `scene.query.what_if`; the first three arguments are given."""
        return partial(what_if, *self._opened)


class ReferenceSearch:
    """The embedders of a finished run, its map images, and the features that it reranked with: as in the stages."""

    def __init__(self, files: SceneFiles, capture: Capture, device: str, reranked: bool) -> None:
        """Load what all queries share; `reranked` tells whether the run localized with reranked references.

        Raise ArtifactError if files are missing, or the map was embedded by another embedder.
        """
        self.files, self.capture, self.session, self._told = files, capture, capture[f"{device}_map"], False
        self.embed_settings = EmbedSettings.read(files.embeddings)
        self.retrieve_settings = settings = RetrieveSettings.read(files.retrieval_dir)
        self.images = Embedded.of_map(self.session, files.embeddings, settings.normalize)
        vectors, folders = self.images.vectors, embedding_folders(files.embeddings).values()
        named = zip(self.embed_settings.models, folders, strict=True)
        self.embedders = [Describer.open(name, self.embed_settings, folder).embedder for name, folder in named]
        for embedder, part in zip(self.embedders, vectors.parts.values(), strict=True):
            if part.embedder not in ("", embedder_fingerprint(embedder.settings)):
                fault = f"was made by another embedder or vocabulary than the run's {embedder.name} of now"
                raise ArtifactError(f"{part.paths[0]} {fault}. Run the embed stage again.")
        in_memory = np.dtype(np.float32).itemsize * vectors.shape[1] * len(vectors) < MAX_IN_MEMORY
        self.vectors = vectors[:] if in_memory else vectors
        self._prior_names = enabled_priors(settings.mask)
        of_cpu = settings.model_copy(update={"faiss_gpu": False})  # this machine may have no GPU
        self._index = load_index(files.embeddings, self.session.id, vectors, of_cpu)
        self._sift = LocalMethod("sift", SiftExtractor(), MutualMatcher.of(KINDS["sift"]))
        self.verification: tuple[LocalMethod, Verifier] | None = None
        if reranked:
            reranking = RerankSettings.read(files.reranked_dir)
            (method,) = create_local_methods(reranking)
            store = FeatureStore.of_session(files.features, self.session.id, method.extractor.settings)
            self.verification = method, Verifier(reranking, method.matcher, store)

    @property
    def shows_upright(self) -> bool:
        """Whether the run turned images upright for an embedder, or for the features that it reranked with."""
        upright = any(Describer(embedder, self.embed_settings).upright for embedder in self.embedders)
        return upright or (self.verification is not None and KINDS[self.verification[0].name].upright)

    def describe(self, query: Query, kinds: Sequence[LocalMethod]) -> list[NDArray[np.float32]]:
        """Return for each embedder the global descriptors (C, D) of a query's images; `kinds` are its features."""
        described = []
        for describer in (Describer(embedder, self.embed_settings) for embedder in self.embedders):
            if describer.embedder.inputs == "features":
                inputs = self._features(query, kinds)
            else:
                side, up = describer.embedder.min_side, self.embed_settings.world_up
                views = [self._turned(view, up) if describer.upright else view for view in query.views]
                inputs = [describer.prepare(view.read(True, side), view.turns) for view in views]
            vectors = describer.embedder.embed(inputs)
            described.append(unit(vectors) if self.embed_settings.normalize else vectors)
        return described

    def _features(self, query: Query, kinds: Sequence[LocalMethod]) -> list[LocalFeatures]:
        """Return the SIFT features of the images: those of the localizer, if it has them."""
        settings = [kind.extractor.settings for kind in kinds]
        if query.features and self._sift.extractor.settings in settings:
            at = settings.index(self._sift.extractor.settings)
            return [features[at] for features in query.features if not isinstance(features, str)]
        return [view.extract(self._sift) for view in query.views]

    def find(self, query: Query, k: int | None = None, near: Masks | None = None) -> list[Ranked]:
        """Return the references of each image of a query that `describe` has described, as the run would find them.

        By default, there are `k` as in the run. With `near`, these of `images` may be found, whatever the run's priors
        say. Raise ArtifactError if the map was embedded by another embedder.
        """
        settings, dims = self.retrieve_settings, self.images.vectors.dims
        for embedder, described, dim in zip(self.embedders, query.descriptors, dims, strict=True):
            if described.shape[1] != dim:
                found, expected = f"map descriptors of {dim} dimensions", f"{described.shape[1]} of {embedder.name}"
                raise ArtifactError.at(self.files.embeddings, found, expected, "Run the embed stage again.")
        topk = settings.topk if k is None or self.verification else k
        # As they are read from a file.
        stored = (one.astype(self.embed_settings.dtype).astype(np.float32) for one in query.descriptors)
        vectors = np.hstack([unit(one) if settings.normalize else one for one in stored])
        masks = self._masks(query, topk) if near is None else near
        if masks is None and self._index is None and len(dims) == 1 and isinstance(self.vectors, np.ndarray):
            ranked = [self._nearest(vector, self.vectors, topk) for vector in vectors]
        else:
            scored = search(vectors, self.vectors, topk, "numpy", index=self._index, allowed=masks, dims=dims)
            both = ((scores, best[best >= 0]) for scores, best in zip(*scored, strict=True))
            ranked = [(self.images.rows[best], scores[: len(best)].astype(np.float64)) for scores, best in both]
        if self.verification:
            ranked = [self.rerank(of_image, view) for of_image, view in zip(ranked, query.views, strict=True)]
        return [(rows[:k], scores[:k]) for rows, scores in ranked]

    def _nearest(self, vector: NDArray[np.float32], of_map: NDArray[np.float32], k: int) -> Ranked:
        """Return what `search` does for one descriptor in memory: the usual case, short enough to read."""
        scores = np.einsum("nd,d->n", of_map, vector.astype(np.float64)).astype(np.float32)
        if not np.isfinite(scores).all():
            raise ValueError("The descriptors of the query or of the map have NaN or infinite values.")
        best = np.argsort(-scores, kind="stable")[:k]
        return self.images.rows[best], scores[best].astype(np.float64)

    def rerank(self, ranked: Ranked, view: View) -> Ranked:
        """Return rows of map images and their numbers of verified matches with an image, most first."""
        assert self.verification is not None
        method, verifier = self.verification
        view = self._turned(view, verifier.settings.world_up) if KINDS[method.name].upright else view
        names = [self.session.image_names[row] for row in ranked[0]]
        best = verifier.rank(view.extract(method), view.camera, names, self.session.cameras(ranked[0]))
        return ranked[0][[at for at, *_ in best]], np.array([verified for _, verified, _ in best], np.float64)

    def _turned(self, view: View, world_up: Sequence[float] | None) -> View:
        """Return an image of a session with the turns that a stage found for it; other images as they are."""
        if (found := self.capture.find_image(view.name)) is None:
            return view
        turns = upright_turns(self.capture, world_up).of(found[0], [found[1]])
        return replace(view, turns=int(turns[0]))

    def _masks(self, query: Query, topk: int) -> Masks | None:
        """Return the map images that the run's priors let each image find, None: all, as for images of no session."""
        if not self._prior_names:
            return None
        found = [place for view in query.views if (place := self.capture.find_image(view.name)) is not None]
        if len(found) < len(query.views):
            if not self._told:
                message = "%s: images from outside a session are searched without %s"
                log.warning(message, self.session.id, " and ".join(self._prior_names))
            self._told = True
            return None
        images = found[0][0], np.array([row for _, row in found], np.int64)
        return self._priors.masks((self.session, self.images.rows), images, topk)[0]

    @cached_property
    def _priors(self) -> Priors:
        return Priors(self.retrieve_settings.mask)
