"""The map of one device, and the way of an image through it: query, describe, retrieve, match, solve, locate."""

import copy
import logging
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit import geometry
from toolkit.capture import Capture, Session, masks
from toolkit.capture.images import sees_all, thumbnails
from toolkit.capture.upright import Turns, upright_turns
from toolkit.errors import COMMAND, ArtifactError, CameraError, ImageError, ManifestError, reason_of
from toolkit.features.features import KINDS
from toolkit.features.matching import (
    AnyMethod,
    DeferredMethod,
    LocalMethod,
    create_local_methods,
    resolve_auto,
    weights_files,
)
from toolkit.features.stores import FeatureStore, OnDemandFeatures, extract_session
from toolkit.files import RAW_DATA, SceneFiles, require_current
from toolkit.geometry import Floats, Ints
from toolkit.manifest import LocalizeSettings
from toolkit.manifest.settings import expand
from toolkit.mapping.build import build_map
from toolkit.mapping.local_map import Consistency, LocalMap, map_path
from toolkit.mapping.pose_consistency import NOMINAL_DEPTH, USUAL_DEPTHS_M
from toolkit.pose.base import (
    CAMERA,
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
from toolkit.pose.map_matching import MappedFeatures
from toolkit.pose.pnp import RIVAL_DISTANCE, PnpLocalizer, bounded_by_rivals, clarity_of_support
from toolkit.prediction.feed_forward import FeedForwardLocalizer, depth_of_images
from toolkit.prediction.hybrid import HybridLocalizer, LiftingLocalizer, lifts
from toolkit.prediction.interface import Predictor
from toolkit.prediction.network import open_predictor
from toolkit.results.metrics import UNKNOWN_UNIT, is_posed, length_unit
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
from toolkit.scene.query import (
    Image,
    Located,
    ReferenceSearch,
    Retrieved,
    camera_key,
    guessed_camera,
    query_from,
    ranks,
    show_matches,
    with_focal,
)
from toolkit.threads import fixed_sums

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from toolkit.figures.answers import Answer
    from toolkit.viewer.queries import View3D

log = logging.getLogger(__name__)

WITHOUT_FEATURES = ("feed_forward", "nearest")
"""Methods that need no local features of the queries."""
MAP_CAMERAS = 1000  # cameras of the map among which that of an image of equal size is looked for, at most
FOCAL_STEPS, FOCAL_DOUBT = 3, 1.3
"""Steps of the estimate of an unknown focal length; the matches must contradict one that is larger or smaller by a
factor."""
CENTER_DOUBT = 0.1
"""Shift of the principal point of a cropped image, in focal lengths, that the matches must contradict, too: 6 deg."""
FIXED_BY_MAP = ("unit", "world_up")
"""Settings that the length of the map and the turns of its images depend on, so they cannot change for a query."""
ODD_DEPTHS_M = (0.1, 200.0)
"""Plausible range of a map's median depth, meters; outside, the map may be in another unit."""
NEAR, NEAR_DEG = 10.0, 60.0
"""Largest distance (in map lengths, see `Survey.length`) and angle (degrees) between a camera and a map image that may
show the same scene."""
WORTH_DEG, WORTH_LENGTHS = 0.05, 0.005
"""Noise of the map's poses, degrees and map lengths per axis, from which the user is told of it."""
MAX_SURE_STD_M = 0.05
"""An `ok` pose with at most this standard deviation of the position, meters, is precise enough. Otherwise the fallback
features are used too."""
FEW_REFERENCES = 4
"""How many references, those that support an `ok` pose most, fallback features are matched with at first."""
MAX_KNOWN = 3
"""Largest number of earlier poses of a query that the fallback features judge, too."""


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
        localized = last_localized(files, pairs := pairs_in_map(files, device))
        of_map = [".jsonl", ".npz", *(f"/{device}_map/{name}" for name in (*SESSION_FILES, RAW_DATA))]
        for pair in pairs:
            require_current(pair.with_suffix(".txt"), "localize", of_map, missing=False)
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
    def _stored_in(cls, device: str, localized: Localized, features_dir: Path, map_dir: Path) -> "Map":
        settings, h5_attributes, names = localized
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

        Raises:
            ArtifactError: the map was not opened from a run, or was embedded by another embedder.
        """
        query = self.describe(query)
        references, allowed = Retrieved(self, query), list[NDArray[np.bool_] | None]()
        if near is not None:
            allowed = [self._may_show(pose, near) for pose in near.world_from_rig @ query.rig_from_cams]
        for rows, scores in self.search.find(query, k, allowed):
            indices = np.array([self.index_of.get(self.session.image_names[row], -1) for row in rows], np.int64)
            references.append(References(indices[indices >= 0], scores[indices >= 0]))
        return references

    def match(self, query: Query, references: Sequence[References], localizer: Localizer | None = None) -> QueryMatches:
        """Return the matches of a query with its references; they are computed when they are needed.

        Localizers assume map lengths, and so do the matches. `localizer` is that of the map or, with the fallback
        features, `fallback`; the same one solves the matches.
        """
        return (localizer or self.localizer).match(self._with_features(query).scaled(1 / self.length), references)

    def show_matches(self, matches: QueryMatches, reference: int = 1, image: int = 0) -> "Figure":
        """Draw the matches by descriptors of one image of a query with one of its references.

        Args:
            matches: what `match` returned.
            reference: rank of the reference, from 1.
            image: number of the query image, from 0.

        Raises:
            ArtifactError: there is no such image or reference, or the method does not match keypoints.
        """
        return show_matches(self, matches, reference, image)

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
        result = self.finished(query, result.scaled(self.length))
        # Results may be many, so they keep neither pixels of files nor features.
        views = [replace(view, _decoded={}) for view in query.views]
        lean, references = replace(query, views=views, features=[], network_matches=[]), matches.references
        context = Located(partial(self._answer, lean, references), lambda: (self, lean, references))
        return replace(result, context=context)

    @fixed_sums
    def locate(
        self,
        query: Query,
        near: RoughPose | None = None,
        references: Sequence[References] | None = None,
        prediction: Any = None,
        fallback: bool = True,
    ) -> QueryResult:
        """Return the pose of a query: describe, retrieve, match and solve, and the fallback features if it is unsure.

        Args:
            query: with or without features.
            near: a rough pose, if it is known. References are then map images that look the same way from nearby, and
                features are also matched near the projections of the map points at this pose.
            references: those of each image; None: retrieve them.
            prediction: of a network for this query, see `predict`; None: predicted here if it is needed.
            fallback: whether fallback features may be used; the localize stage extracts those of many queries at once.

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
        result = replace(result, seconds=time.perf_counter() - started)
        if not fallback or not self.needs_fallback(query, references, result):
            return result
        query, first = self._with_fallback_features(query), result
        for asked in self.rounds(references, first):
            result = self.retry(query, asked, result, priors)
            if self.is_settled(first, result):
                break
        return result

    def predict(self, queries: Sequence[QueryInput]) -> list[Any]:
        """Return a network's prediction for each query, for `locate`; see `Localizer.predict`."""
        return self.localizer.predict([(query.scaled(1 / self.length), references) for query, references in queries])

    def is_unsure(self, result: QueryResult) -> bool:
        """Tell whether fallback features, if there are any, might find a better pose."""
        if self.fallback is None or result.misfit or result.reason == NOISE:  # no features repair that
            return False
        limit = MAX_SURE_STD_M * (1.0 if self.settings.unit else self.length)
        # A pose without matches has no deviation (NaN) and counts as precise.
        return result.status is not Status.OK or result.position_std > limit

    def needs_fallback(self, query: Query, references: Sequence[References], result: QueryResult) -> bool:
        """Tell whether a result is not sure, and the query has what fallback features need."""
        readable = zip(query.features, references, strict=True)
        return self.is_unsure(result) and any(
            not isinstance(features, str) and len(found.images) for features, found in readable
        )

    def rounds(self, references: Sequence[References], first: QueryResult) -> list[Sequence[References]]:
        """Return the references that fallback features are matched with, in turn until the pose is sure.

        An `ok` pose only lacks precision, so the references that support it most are asked before all are.
        """
        if first.status is not Status.OK:
            return [references]
        best = [self.index_of[name] for name in first.references[:FEW_REFERENCES]]
        few = [found.take(np.isin(found.images, best)) for found in references]
        counts = [sum(len(found.images) for found in asked) for asked in (few, references)]
        return [few, references] if 0 < counts[0] < counts[1] else [references]

    def is_settled(self, first: QueryResult, result: QueryResult) -> bool:
        """Tell whether few references have made the pose of the first result sure, and have not moved it elsewhere."""
        return not self.is_unsure(result) and not self._differ(first.world_from_rig, result.world_from_rig)

    @fixed_sums
    def retry(
        self, query: Query, references: Sequence[References], first: QueryResult, priors: Sequence[Prior] = ()
    ) -> QueryResult:
        """Retry an unsure query with the fallback features, which it has; return the better of both results.

        `first` is the latest result. `found_by` names the fallback features if the pose was computed with them.
        """
        assert self.fallback is not None
        started = time.perf_counter()
        poses = [first.world_from_rig, *(rival.world_from_rig for rival in first.rivals)]
        known = [_canonical(pose) for pose in poses[:MAX_KNOWN] if pose is not None]
        # The earlier poses are judged by all kinds of features.
        known_priors = [
            Prior(pose, images, SEARCH_DEG[0], "first") for pose in known if len(images := self._images_near(pose))
        ]
        matches = self.match(query, references, self.fallback)
        result = self.solve(query, matches, None, [*priors, *known_priors], self.fallback)
        result = replace(result, found_by="+".join([result.found_by, *(kind.name for kind in self.escalation)]))
        if first.status is Status.OK:
            result = self._with_rivals_of(first, result)
        better = result.status.rank >= max(first.status.rank, 1) or self._finds_rival(result)
        earlier = first.first_seconds
        return replace(
            result if better else first,
            seconds=first.seconds + time.perf_counter() - started,
            first_status=first.first_status or first.status_text,
            first_seconds=round(first.seconds, 4) if earlier is None else earlier,
            context=first.context,  # it has all references
        )

    def _finds_rival(self, result: QueryResult) -> bool:
        """Tell whether a pose cannot be `ok` beside its rivals, even if all else is certain."""
        beside = self._beside(1.0, result.rivals)
        return result.status is Status.LOW_CONFIDENCE and beside < self.settings.pnp.ok_probability

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
        # In such a map, a misfit says nothing about the query's camera.
        remark = "; ".join(filter(None, ["" if result.misfit else result.remark, self.consistency.text]))
        what = "poses" if self.consistency.verdict == "inconsistent" else "intrinsics"
        reason = f"the {what} of the map contradict its images"
        return replace(result, status=Status.LOW_CONFIDENCE, reason=reason, remark=remark, focals_px=(), centers_px=())

    def _prior(self, near: RoughPose, references: Sequence[References]) -> Prior:
        images = np.unique(np.concatenate([retrieved.images for retrieved in references]))
        position_std = near.position_std / self.length  # the depth that it is compared with is in map lengths
        return Prior.about(near.world_from_rig, images, near.rotation_std_deg, position_std, "near")

    def _may_show(self, world_from_cam: Floats, near: RoughPose) -> NDArray[np.bool_] | None:
        """Return which searched map images (N,) may show what a camera at a rough pose sees; None if none may."""
        mask = masks.near(
            self.session.world_from_cam(self.search.rows),
            world_from_cam,
            NEAR * self.length + 3 * near.position_std,
            NEAR_DEG + 3 * near.rotation_std_deg,
        )
        return mask if mask.any() else None

    def _images_near(self, world_from_rig: Floats) -> Ints:
        """Return the map images, by index, that may show what a rig at a pose (4, 4) sees."""
        return np.flatnonzero(masks.near(self._world_from_cams, world_from_rig, NEAR * self.length, NEAR_DEG))

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

    def _answer(self, query: Query, references: Sequence[References], result: QueryResult) -> "Answer":
        from toolkit.figures.answers import Answer

        return Answer(
            result, self.settings, query.views, query.rig_from_cams, self.session, self.points,
            length_unit(self.record()), self._true_pose(query), "query", None, ranks(self, references),
        )  # fmt: skip

    def _true_pose(self, query: Query) -> Floats | None:
        """Return world_from_rig (4, 4) of a query of a session by its ground truth; None if that is unknown."""
        session_id, _, path = query.views[0].name.partition("/")
        session = self.capture[session_id] if path and session_id in self.capture else None
        row = None if session is None else session.row_of_name.get(query.views[0].name)
        if session is None or row is None:
            return None
        true = session.world_from_cam([row], ground_truth=True)[0] @ geometry.invert(query.rig_from_cams[0])
        return true if is_posed(true) else None

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
            raise ArtifactError(
                f"The map of {self.device!r} was built for another method than {settings.method!r} and has no points, "
                f"which it needs. Localize with {settings.method!r} first."
            )
        pnp = PnpLocalizer(self.in_lengths, settings.pnp, settings.seed)
        if not settings.predicts:
            of_image = depth_of_images(self.session, pnp.image_names, self.length)
            return LiftingLocalizer(pnp, of_image) if lifts(settings, self.session) else pnp
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

    def changed(self, changes: Mapping[str, Any]) -> "Map":
        """Return the map with changed settings of the localize stage; it shares what stays the same with this one.

        If features, or the settings of the map's points, change, points are triangulated for each query from its
        references, as the map has none of this kind.

        Raises:
            ManifestError: a setting is unknown, or the unit or the up direction of the map would change.
            WeightsError: a network of the changed settings has no weights.
        """
        before, changes = self.settings, expand(LocalizeSettings, changes)
        features = changes.get("features", {})
        if "kinds" in features and "escalation" not in features:
            rest = [name for name in before.features.escalation if name not in features["kinds"]]
            changes |= {"features": {**features, "escalation": rest}}
        try:
            settings = LocalizeSettings.of(before, changes)
        except ManifestError as error:
            raise ManifestError(re.sub(r"^\w+:\s+", "localize: ", str(error))) from None
        if fixed := [name for name in FIXED_BY_MAP if getattr(settings, name) != getattr(before, name)]:
            raise ManifestError(
                f"localize.{fixed[0]}: cannot change for one query, as the whole map depends on it. "
                f"To change it: {COMMAND} run MANIFEST --set localize.{fixed[0]}=..."
            )
        other = copy.copy(self)
        other.settings, other.original = settings, self._first
        for name in ("localizer", "fallback", "index_of", "in_lengths", "points", "_world_from_cams"):
            other.__dict__.pop(name, None)
        if settings.map != before.map and not settings.predicts:
            other.mapped = []
        anew = settings.features != before.features or settings.matcher != before.matcher
        if anew or not self.kinds:
            kinds, other.escalation = create_methods(resolve_auto(settings))
            extracted = {kind.name: kind.extractor.settings for kind in self.kinds}
            kept = {kind.name: kind for kind in kinds if extracted.get(kind.name) == kind.extractor.settings}
            other.mapped = [
                MappedFeatures(kind.map, kind.features, kind.name, kept[kind.name].matcher)
                for kind in other.mapped
                if kind.name in kept
            ]
            mapped = [kind.name for kind in other.mapped]
            other.kinds = sorted(kinds, key=lambda kind: kind.name not in mapped)  # as `OnDemandLocalizer` wants them
            other.__dict__.pop("_on_demand", None)
        return other

    @cached_property
    def search(self) -> ReferenceSearch:
        """The embedders and descriptors of the run.

        Raises:
            ArtifactError: the map was not opened from a run.
        """
        if self.files is None:
            raise ArtifactError("This map was not opened from a run, so its embedder is unknown. Use Map.open.")
        return ReferenceSearch(self.files, self.session, self.reranked)

    def load(self) -> None:
        """Load what all queries share, before several threads find it missing: `cached_property` has no lock."""
        _ = self.localizer, self.index_of, self.fallback, self.session.image_names
        self.search.load()
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
        refined = self._first and self.settings.map is not None and self.settings.map.refine_poses
        return self._first.poses if self._first and refined else {}

    @property
    def length(self) -> float:
        """The length that localizers treat as one meter, in the unit of the poses; see `Survey.length`."""
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
        if self._first is None:
            return ""
        parts, depth = [self.consistency.text, self._noise], self.length * USUAL_DEPTHS_M[int(self.length > 1)]
        metric = self.settings.unit and self.length != 1 and self.consistency.verdict != "inconsistent"
        if metric and not ODD_DEPTHS_M[0] < depth < ODD_DEPTHS_M[1]:
            parts.append(
                f"the median depth of the map is {depth:.3g} m: if its poses are not in meters, write `unit: null` in "
                "the manifest, or import them with their `--unit`"
            )
        return "; ".join(filter(None, parts))

    @property
    def _noise(self) -> str:
        """How good the poses are, if their noise is worth a word."""
        noise = self.consistency
        small = noise.rotation_noise_deg < WORTH_DEG and noise.position_noise < WORTH_LENGTHS
        if small or not noise.trusted:  # wrong intrinsics look like noise of the poses
            return ""
        unit, factor = ("cm", self.length) if self.settings.unit else ("% of the median depth", 1 / NOMINAL_DEPTH)
        rotation_deg, position = np.sqrt(3) * noise.rotation_noise_deg, np.sqrt(3) * noise.position_noise * factor
        return f"the poses of the map are good to about {rotation_deg:.2g} deg, {100 * position:.2g} {unit}"

    def record(self) -> dict[str, Any]:
        """Return the unit, depth, length and consistency of the map, for JSON."""
        depth = self.length * NOMINAL_DEPTH if self.settings.unit is None else None
        unit = {"unit": self.settings.unit, "depth": depth, "length": self.length}
        return {**unit, "text": self.remarks, **asdict(self.consistency)}


def _canonical(pose: Floats) -> Floats:
    """Return a pose (4, 4) as it is read from a file, so that results do not depend on whether it was stored."""
    return geometry.pose_from_qt(geometry.qt_from_pose(pose))


def localize_image(
    scene_map: Map,
    image: Image | Sequence[Image],
    camera: pycolmap.Camera | Sequence[pycolmap.Camera] | None = None,
    rig_from_cams: NDArray[np.float64] | None = None,
    turns: Sequence[int] | None = None,
    near: RoughPose | None = None,
) -> QueryResult:
    """Localize one image, or those of a rig, as the run of the map would: `Map.query` and `Map.locate` in one call.

    Without a camera, the focal length of one image is estimated from its matches. It starts at that of EXIF, at that of
    the map's camera with equal image size, or at 1.2 times the longer side; `remark` says which one was used. If the
    matches do not tell it, for example on a plane, the pose is `low_confidence: camera?`.

    Args:
        scene_map: an open map, see `Map.open`; it is not changed.
        image, camera, rig_from_cams, turns: see `scene.query.query_from`.
        near: a rough pose, if it is known; see `Map.locate`.

    Raises:
        ImageError, CameraError, ArtifactError: see `Map.query` and `Map.locate`.
    """
    if not isinstance(scene_map, Map):
        raise ArtifactError(f"Found {type(scene_map).__name__} for a map, expected what `Map.open` returns.")
    if camera is None:
        if rig_from_cams is not None or isinstance(image, list | tuple):
            raise CameraError("camera: found None for several images, expected a camera for each.")
        return _UnknownFocal(scene_map, image, turns, near).estimate()[0]
    return scene_map.locate(scene_map.query(image, camera, rig_from_cams, turns), near)


def localize_images(
    scene_map: Map, images: Sequence[Image], camera: pycolmap.Camera | None = None
) -> list[QueryResult]:
    """Localize images, each alone, as `localize_image` does. Without a camera, images of one camera help each other.

    Those with equal size, and in EXIF equal camera and focal length, are of one camera. The median of the focal lengths
    that matches of its `ok` images tell, weighted by inliers, is tried for the other images.

    Returns:
        One result per image. If an image cannot be read or does not fit the camera, it is `failed`, with the reason.

    Raises:
        ArtifactError: see `localize_image`.
    """
    results, cameras = list[QueryResult](), dict[Any, list[tuple[int, _UnknownFocal, float | None]]]()
    for number, image in enumerate(tqdm(images, "localize", unit="image", disable=len(images) < 2)):
        try:
            if camera is not None:
                results.append(localize_image(scene_map, image, camera))
                continue
            unknown = _UnknownFocal(scene_map, image)
            result, told_px = unknown.estimate()
            results.append(result)
            sure_px = told_px if result.status is Status.OK else None
            cameras.setdefault(camera_key(image, unknown.camera), []).append((number, unknown, sure_px))
        except ImageError as error:
            results.append(QueryResult.failed(reason_of(error, f"localizing {image}")))
    for of_camera in cameras.values():
        sure = sorted((sure_px, number) for number, _, sure_px in of_camera if sure_px is not None)
        if not sure:
            continue
        inliers = np.cumsum([results[number].num_inliers for _, number in sure])
        focal_px, _ = sure[np.searchsorted(inliers, inliers[-1] / 2)]
        for number, unknown, sure_px in of_camera:
            if sure_px is not None:
                continue
            result = unknown.locate(focal_px)
            if result.status.rank >= results[number].status.rank and not result.misfit:
                text = f"focal length {focal_px:.0f} px, from {len(sure)} other photographs of its camera"
                results[number] = replace(result, remark="; ".join(filter(None, [text, result.remark])))
    return results


class _UnknownFocal:
    """An image in a map, without a camera."""

    def __init__(
        self, scene_map: Map, image: Image, turns: Sequence[int] | None = None, near: RoughPose | None = None
    ) -> None:
        self.scene_map, self.image, self.turns, self.near = scene_map, image, turns, near
        sensors = scene_map.session.sensors
        ids = sensors.loc[sensors["sensor_type"] == "camera", "sensor_id"].head(MAP_CAMERAS)
        known = [scene_map.session.camera(str(name)) for name in ids]
        self.camera, self.origin, self.cropped = guessed_camera(image, known)
        self.described: Query | None = None  # with features, while different intrinsics are tried

    def locate(self, focal_px: float, right: float = 0.0, down: float = 0.0) -> QueryResult:
        """Localize with a focal length, and the principal point moved by shares of it."""
        camera = with_focal(self.camera, focal_px)
        camera.principal_point_x += right * focal_px
        camera.principal_point_y += down * focal_px
        query = self.scene_map.query(self.image, camera, None, self.turns)
        if sees_all(camera):  # else features depend on the focal length
            self.described = self.described or self.scene_map.describe(query)
            query = replace(query, features=self.described.features, descriptors=self.described.descriptors)
        return self.scene_map.locate(query, self.near)

    def estimate(self) -> tuple[QueryResult, float | None]:
        """Localize again with the focal length that fits the matches, until none fits better.

        Returns:
            The result, and the focal length in pixels; None if the matches do not contradict the guess.
        """
        started = time.perf_counter()
        focal_px, told = self.camera.mean_focal_length(), False
        result = self.locate(focal_px)
        for _ in range(FOCAL_STEPS):
            fitting = result.focals_px[0] if result.focals_px else np.nan
            if not np.isfinite(fitting):
                break
            focal_px, told = float(fitting), True
            result = self.locate(focal_px)
        text = f"focal length {focal_px:.0f} px, {'which fits its matches' if told else self.origin}"
        others: list[tuple[float, ...]] = [(focal_px * FOCAL_DOUBT, 0.0, 0.0), (focal_px / FOCAL_DOUBT, 0.0, 0.0)]
        if self.cropped:
            others += [(focal_px, *(sign * CENTER_DOUBT)) for sign in (*np.eye(2), *-np.eye(2))]
        if result.status == Status.OK and not all(self.locate(*other).misfit for other in others):
            result = replace(result, status=Status.LOW_CONFIDENCE, reason=CAMERA)
            text += ", as other intrinsics do" if told else ", and the matches do not tell it"
        self.described = None
        remark, seconds = "; ".join(filter(None, [text, result.remark])), time.perf_counter() - started
        return replace(result, remark=remark, seconds=seconds), focal_px if told else None


def needs_upright(settings: LocalizeSettings, kinds: Sequence[AnyMethod]) -> bool:
    """Tell whether a network that localizes needs upright images; `kinds` are the kinds of features."""
    return settings.predicts or any(KINDS[kind.name].upright for kind in kinds)


def create_methods(settings: LocalizeSettings) -> tuple[list[LocalMethod], list[DeferredMethod]]:
    """Return the kinds of features that every query needs, and those for queries without a sure pose.

    Raise WeightsError if a network has no weights.
    """
    if settings.method == "nearest":
        return [], []
    further = settings.features.escalation if settings.method in ("pnp", "hybrid") else []
    if further:
        weights_files(settings)
    return create_local_methods(settings), [DeferredMethod(settings, name) for name in further]
