"""Localize with map features lifted to 3D by depth, where the triangulated points do not suffice; and combine matching
with prediction: match alone, near the predicted pose, and with depth, and keep the best pose.

Depth comes from the capture's depth maps, else from the network that predicted the map image. A scale error in the
depth of an image scales its points about its camera and moves the query toward the image or away from it. If all
matches are with one image, no reprojection error shows this. So the covariance includes the uncertainty of that scale.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from toolkit import geometry
from toolkit.alignment.similarity import DEPTH_NOISE
from toolkit.capture import Session
from toolkit.geometry import Floats, Ints
from toolkit.manifest import LocalizeSettings, PnpSettings
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import (
    CELLS,
    Localizer,
    Matches,
    Prior,
    Query,
    QueryInput,
    QueryResult,
    References,
    RigQuery,
    Status,
    agree,
)
from toolkit.pose.map_matching import MAX_MAP_FEATURES, MappedFeatures
from toolkit.pose.pnp import PnpLocalizer, PnpMatches
from toolkit.prediction.depths import SeenDepth, lifted
from toolkit.prediction.feed_forward import CameraAnswer, FeedForwardAnswer, FeedForwardLocalizer, QueryPrediction
from toolkit.threads import fixed_sums

log = logging.getLogger(__name__)
DEPTH_MAP_STD = 0.01  # relative standard deviation of the scale of a depth map, before it is measured
MEASURED = 16  # map images, those with the most triangulated points, whose depth maps tell how wrong their scales are
MIN_LIFTED = 20  # features of a map image with depth from its depth maps; with fewer, predicted depth is used
MIN_RATIOS = 10  # fewest depth ratios that give the predicted depth of an image its own scale
MAX_RATIOS = 10  # most ratios that count as independent, as the depth errors of networks are spatially correlated
MAX_RATIO_SPREAD = 0.25  # relative spread of the ratios of an image above which its predicted depth is wrong
MAX_FEATURES = 4096  # of a map image, for depth maps alone: with fewer, those of triangulated points hide the others
CONTRADICTION = 3.0  # standard deviations per axis above which a pose contradicts the predicted camera
TINY = float(np.finfo(float).tiny)
TIE = 0.8  # share of the lifted pose's matches above which the pose from matching alone is kept


@dataclass(frozen=True)
class Depth:
    """Depth of features of one map image."""

    depth_m: Floats
    """(n,) NaN where unknown."""
    scale_std: float
    """Relative standard deviation of their common scale."""
    common_std: float = 0.0
    """The part of it that is common to the images, relative."""
    predicted: bool = False
    measured: bool = True
    """Whether the scale was checked against points of known depth in the image."""


@dataclass(frozen=True)
class LiftedMap:
    """Part of a map, with lifted points after the triangulated ones."""

    local_map: LocalMap
    """The images of the whole map; T triangulated points that the lifted images observe, then the lifted points."""
    triangulated: Ints
    """(T,) index of the triangulated points in the whole map."""
    image: Ints
    """(P,) map image that each point was lifted from; -1 for triangulated points."""
    depths: dict[int, Depth]
    """Depth of the lifted images, by index of the image."""


class DepthLifter:
    """Lifts features of map images, of the first kind that `pnp` has, and localizes with them. Thread-safe."""

    def __init__(self, pnp: PnpLocalizer, seen_depth: Callable[[int], SeenDepth], most: int = MAX_MAP_FEATURES) -> None:
        """`pnp` localizes with the triangulated points; `seen_depth` is as of `depth_of_images`; for `most` see
        `MappedFeatures`.
        """
        self._first, self._pnp, self._seen_depth, self._most = pnp.matcher.mapped[0], pnp, seen_depth, most
        self._log_scale = cache(self._find_log_scale)
        self._warned = False

    @fixed_sums
    def localize(
        self, query: Query, references: Sequence[References], answer: FeedForwardAnswer | None = None,
        priors: Sequence[Prior] = (),
    ) -> QueryResult | None:  # fmt: skip
        """Return a pose from triangulated and lifted features of the references; None if none can be lifted.

        The pose is `ok` by the rules of `PnpLocalizer`. Its covariance includes the unknown depth scale of each image.
        A pose from predicted depth of unmeasured scale is only `ok` if the predicted camera of the query agrees.
        Without the `answer` of `FeedForwardLocalizer`, only depth maps give depth.
        """
        count = len(self._first.map.image_names)  # larger indices are images of other kinds of features
        references = [retrieved.take(retrieved.images < count) for retrieved in references]
        query = replace(
            query,
            features=[kinds if isinstance(kinds, str) else kinds[:1] for kinds in query.features],
            network_matches=[kinds[:1] for kinds in query.network_matches],
        )
        images = list(dict.fromkeys(int(image) for retrieved in references for image in retrieved.images))
        lifted_map = self.lift(images, answer)
        if lifted_map is None:
            return None
        mapped = self._first.with_map(lifted_map.local_map, self._most)
        localizer = _LiftedLocalizer(lifted_map, mapped, self._pnp.settings, self._pnp.seed)
        estimate = localizer.localize(query, references, None, priors)
        matched = estimate.correspondences
        source = lifted_map.image[matched.point_index]
        guided = np.char.endswith(matched.found_by, "/guided") & (source >= 0)
        used = [lifted_map.depths[int(image)] for image in np.unique(source[guided])]
        whole_index = np.concatenate(
            [lifted_map.triangulated, np.full(len(lifted_map.image) - len(lifted_map.triangulated), -1)]
        )
        found_by = np.where(source >= 0, f"{self._first.name}/lifted", matched.found_by)
        estimate = replace(
            estimate,
            found_by="lifted+feed_forward" if any(depth.predicted for depth in used) else "lifted",
            correspondences=replace(matched, point_index=whole_index[matched.point_index], found_by=found_by),
        )
        unmeasured = any(not depth.measured for depth in used)
        if unmeasured and answer and estimate.status is Status.OK and not _consistent(estimate, answer.estimate):
            why = "the predicted camera contradicts the pose that its depth gives"
            return replace(estimate, status=Status.LOW_CONFIDENCE, remark=why)
        return estimate

    def lift(self, images: Sequence[int], answer: FeedForwardAnswer | None = None) -> LiftedMap | None:
        """Return the part of the map that images observe, with lifted points for features without triangulated ones.

        Returns None if no feature has depth.
        """
        local_map = self._first.map
        predictions = {} if answer is None else _predictions(answer)
        points, keypoints, source, depths = [], [], [], {}
        for image in images:
            xy = self._first.features[local_map.image_names[image]].keypoints.astype(np.float64)
            free = np.setdiff1d(np.arange(len(xy)), local_map.observations(image)[0])
            depth = self._depth(image, xy[free], predictions.get(image))
            if depth is None:
                continue
            in_cam = lifted(local_map.cameras[image], xy[free], depth.depth_m)
            finite = np.isfinite(in_cam).all(axis=1)
            if not finite.any():
                continue
            points.append(geometry.transform(local_map.world_from_cams[image], in_cam[finite]))
            keypoints.append(free[finite])
            source.append(np.full(finite.sum(), image))
            depths[image] = depth
        if not points:
            return None
        triangulated = np.unique(np.concatenate([local_map.observations(image)[1] for image in images]))
        part, lifted_from = local_map.part(triangulated), np.concatenate(source)
        new = [lifted_from, np.concatenate(keypoints), len(triangulated) + np.arange(len(lifted_from))]
        rows = np.hstack([[part.obs_image, part.obs_keypoint, part.obs_point], new]).T
        rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
        part = replace(
            part,
            points=np.concatenate([part.points, *points]),
            colors=np.concatenate([part.colors, np.full((len(lifted_from), 3), 128, np.uint8)]),
            obs_image=rows[:, 0],
            obs_keypoint=rows[:, 1],
            obs_point=rows[:, 2],
            noise_px=np.concatenate([part.noise_px, np.zeros(len(lifted_from), np.float32)]),
        )
        return LiftedMap(part, triangulated, np.concatenate([np.full(len(triangulated), -1), lifted_from]), depths)

    def _find_log_scale(self, image: int) -> float:
        """Return the median log ratio of depth maps to an image's triangulated points; NaN if it has too few."""
        local_map = self._first.map
        keypoints, points = local_map.observations(image)
        depth_m = self._seen_depth(image).at(self._first.features[local_map.image_names[image]].keypoints[keypoints])
        ratios = depth_m / geometry.transform(local_map.cams_from_world[image], local_map.points[points])[:, 2]
        ratios = ratios[ratios > 0]
        return float(np.log(np.median(ratios))) if len(ratios) >= MIN_RATIOS else np.nan

    @cached_property
    def _scale_stds(self) -> tuple[float, float]:
        """Relative standard deviation of the scale of a depth map of this map, and its part common to all of them.

        Depth maps of a sensor share errors, so those of images with triangulated points tell of the others;
        `DEPTH_MAP_STD`, half of it common, counts as one more of them.
        """
        seen = np.bincount(self._first.map.obs_image, minlength=len(self._first.map.image_names))
        most = np.argsort(-seen, kind="stable")[:MEASURED]
        errors = np.array([self._log_scale(image) for image in most[seen[most] > 0].tolist()])
        errors = errors[np.abs(errors) <= MAX_RATIO_SPREAD]
        common = DEPTH_MAP_STD**2 / 2 + errors.sum() ** 2 / max(len(errors), 1)
        variances = np.array([DEPTH_MAP_STD**2 + np.square(errors).sum(), common]) / (1 + len(errors))
        return float(np.sqrt(variances[0])), float(np.sqrt(variances[1]))

    def _fits(self, image: int) -> bool:
        """Tell whether depth maps agree with the triangulated points of an image, if it has enough of them."""
        log_scale = self._log_scale(image)
        if not abs(log_scale) > MAX_RATIO_SPREAD:
            return True
        if not self._warned:
            self._warned = True
            found = f"its depth map is not used: {np.exp(log_scale):.3g} of the depth of its map points, in the median"
            log.warning("%s: %s", self._first.map.image_names[image], found)
        return False

    def _depth(self, image: int, xy: Floats, predicted: tuple[CameraAnswer, int] | None) -> Depth | None:
        """Return the depth at pixels of a map image from the capture's depth maps, else the predicted depth."""
        depth_m = self._seen_depth(image).at(xy)
        if np.isfinite(depth_m).sum() >= MIN_LIFTED and self._fits(image):
            return Depth(depth_m, *self._scale_stds)
        if predicted is None:
            return None
        answer, view = predicted
        assert answer.prediction is not None
        assert answer.alignment is not None
        ratios = answer.depth_ratios[view - 1]
        ratios = np.log(ratios[ratios > 0])
        if len(ratios) >= MIN_RATIOS:
            middle = float(np.median(ratios))
            spread = 1.4826 * float(np.median(np.abs(ratios - middle)))  # standard deviation if Gaussian
            if spread > MAX_RATIO_SPREAD:
                return None
            scale, std, measured = np.exp(middle), spread / np.sqrt(min(len(ratios), MAX_RATIOS)), True
        elif answer.alignment.scale_known:
            # The scales of predicted depth and predicted cameras may differ slightly.
            scale, measured = answer.alignment.world_from_model.scale, False
            std = float(np.hypot(answer.alignment.scale_std, DEPTH_NOISE))
        else:
            return None
        std = max(std, DEPTH_MAP_STD)
        common_std = 0.0 if measured else std / np.sqrt(2)  # they share the scale of the alignment
        return Depth(scale * answer.prediction.depth_at(view, xy), std, common_std, True, measured)


def lifts(settings: LocalizeSettings, map_session: Session) -> bool:
    """Tell whether `pnp` lifts features of a map: it has depth maps, which are in meters, as its poses are.

    It does so for queries that have no pose without them. Other poses stay: features of many map images tell a pose
    better than the depth of a few.
    """
    return settings.method == "pnp" and settings.unit is not None and map_session.depths is not None


class _LiftedLocalizer(PnpLocalizer):
    """Localizes in a lifted map. Its covariance includes the uncertain depth scale of each lifted image."""

    def __init__(self, lifted_map: LiftedMap, mapped: MappedFeatures, settings: PnpSettings, seed: int) -> None:
        super().__init__([mapped], settings, seed)
        self._lifted_map = lifted_map

    def _covariance(self, query: RigQuery, rig_from_world: Floats, guided: Matches, inliers: Matches) -> Floats | None:
        covariance = super()._covariance(query, rig_from_world, guided, inliers)
        lifted_map, local_map = self._lifted_map, self._lifted_map.local_map
        source = lifted_map.image[guided.point]
        images = np.unique(source[source >= 0])
        if covariance is None or not len(images):
            return covariance
        of_pose, of_point = query.jacobians(rig_from_world, guided, local_map.points)
        of_scales = np.zeros((len(guided), 2, len(images)))
        for number, image in enumerate(images):
            rows = source == image
            # A relative change s of the scale moves a point by s times its offset from the camera of the image.
            offset = local_map.points[guided.point[rows]] - local_map.world_from_cams[image, :3, 3]
            of_scales[rows, :, number] = np.einsum("okj,oj->ok", of_point[rows], offset)
        # Of the pose, by a pixel of each match.
        moves: Floats = np.linalg.pinv(of_pose.reshape(-1, 6)).reshape(6, -1, 2).astype(np.float64)
        # The pose takes the scales as they are, so it moves by all of their errors.
        moved = np.einsum("akc,kcj->aj", moves, of_scales)
        scales = _scale_covariance([lifted_map.depths[int(image)] for image in images])
        excess = self._excess_of_errors(query, rig_from_world, guided, inliers, moves[3:])
        return np.asarray(excess * covariance + moved @ scales @ moved.T, np.float64)

    def _excess_of_errors(
        self, query: RigQuery, rig_from_world: Floats, guided: Matches, inliers: Matches, moves: Floats
    ) -> float:
        """Return how much larger the variance of a pose is than with independent errors as small as those of guided
        matches.

        Matches by descriptors tell how large errors are; guided matches are not kept if depth is too noisy. Points near
        each other share errors of depth: this is as the variance if errors are clustered by cells (Liang and Zeger
        1986, "Longitudinal data analysis using generalized linear models"). `moves` (3, K, 2) are those of the position
        by a pixel of each guided match.
        """
        points = self._lifted_map.local_map.points
        kept = inliers[np.isin(inliers.rows(), guided.rows())]
        found, small = (np.mean(query.errors_px(rig_from_world, some, points) ** 2) + TINY for some in (inliers, kept))
        pulls = np.einsum("akc,kc->ak", moves, guided.pixels - query.projected(rig_from_world, guided, points))
        cells, of_match = np.unique(query.cells(guided, 2 * CELLS), return_inverse=True)
        together = np.stack([np.bincount(of_match, along) for along in pulls])
        clustered = np.sum(together**2) / (np.sum(pulls**2) + TINY) * len(cells) / max(len(cells) - 3, 1)
        return max(1.0, float(found / small)) * max(1.0, float(clustered))

    def _noise_of_points(self, query: RigQuery, matches: Matches, of_point: Floats) -> Floats:
        noise = super()._noise_of_points(query, matches, of_point)
        noise[self._lifted_map.image[matches.point] >= 0] = 0  # their reprojection errors include it already
        return noise


def _scale_covariance(depths: Sequence[Depth]) -> Floats:
    """Return the covariance (J, J) of the relative errors of the depth scales of J images."""
    stds, common = np.array([(depth.scale_std, depth.common_std) for depth in depths]).T
    return np.asarray(np.diag(stds**2 - common**2) + np.outer(common, common), np.float64)


def _predictions(answer: FeedForwardAnswer) -> dict[int, tuple[CameraAnswer, int]]:
    """Return, by consistent reference, the result that contains its prediction, and the index of its view there."""
    predictions: dict[int, tuple[CameraAnswer, int]] = {}
    for camera in answer.cameras:
        if camera.prediction is None or camera.alignment is None or camera.world_from_cam is None:
            continue
        for view, image in enumerate(camera.references, start=1):
            if camera.alignment.consistent[view - 1]:
                predictions.setdefault(int(image), (camera, view))
    return predictions


def _consistent(estimate: QueryResult, predicted: QueryResult) -> bool:
    """Tell whether a pose and the predicted one agree within their uncertainty; False if either is unknown."""
    poses = estimate.world_from_rig, predicted.world_from_rig
    covariances = estimate.covariance, predicted.covariance
    if poses[0] is None or poses[1] is None or covariances[0] is None or covariances[1] is None:
        return False
    spread = np.sqrt(np.diagonal(covariances[0] + covariances[1]).reshape(2, 3).sum(axis=1))
    rotation_deg, distance_m = geometry.pose_error(poses[0], poses[1])
    limits = CONTRADICTION / np.sqrt(3) * spread  # spread is the length over three axes
    return bool(np.isfinite(spread).all() and np.radians(rotation_deg) <= limits[0] and distance_m <= limits[1])


# Matching and prediction


class HybridLocalizer(Localizer):
    """Adds a predicted pose to the hypotheses of a `PnpLocalizer`, and depth where its map points do not suffice."""

    def __init__(self, pnp: PnpLocalizer, feed_forward: FeedForwardLocalizer):
        self.pnp = pnp
        self.feed_forward = feed_forward
        self.lifter = DepthLifter(pnp, feed_forward.seen_depth)
        self.image_names, self.batch_size = pnp.image_names, feed_forward.batch_size
        self._index_of = {name: index for index, name in enumerate(self.image_names)}

    def predict(self, queries: Sequence[QueryInput]) -> list[QueryPrediction]:
        """Return the prediction of the network for each query; see `Localizer`."""
        return self.feed_forward.predict(queries)

    def match(self, query: Query, references: Sequence[References]) -> PnpMatches:
        """Return the matches of a query with its references; see `Localizer`."""
        return self.pnp.match(query, references)

    @fixed_sums
    def solve(
        self, matches: PnpMatches, prediction: QueryPrediction | None = None, priors: Sequence[Prior] = ()
    ) -> QueryResult:
        """Return one pose for the cameras of a rig, or for a single camera. `found_by` names its source:

        - `pnp`: matching alone; the prediction changed nothing.
        - `pnp+feed_forward`: matches guided by the predicted pose, with its consistent references, support a pose
          better than matches found without it.
        - `lifted`, `lifted+feed_forward`: neither is `ok`, and map features lifted by the depth maps of the capture, or
          also by predicted depth, support a pose better.
        - `feed_forward`: the predicted pose itself; matching finds no pose, or an uncertain one that a certain
          prediction contradicts.
        """
        query, references = matches.query, matches.references
        answer = self.feed_forward.answer(query, references, prediction)
        predicted = answer.estimate
        prior = self._prior(predicted)
        priors = (*priors, *(() if prior is None else (prior,)))
        estimate = self.pnp.solve(matches, None, priors)
        if estimate.status is not Status.OK and not estimate.camera_contradicted:
            lifted = self.lifter.localize(query, references, answer, priors)
            estimate = estimate if lifted is None else _better(estimate, lifted)
        if predicted.world_from_rig is None:
            return estimate
        no_pose = estimate.world_from_rig is None
        disagree = not agree(estimate.world_from_rig, predicted.world_from_rig)
        if no_pose or (disagree and estimate.status is not Status.OK and predicted.status is Status.OK):
            why = estimate.status_text if no_pose else "matching gives an uncertain pose elsewhere"
            return replace(predicted, remark="; ".join(filter(None, (predicted.remark, why))))
        remark = "; ".join(filter(None, (predicted.remark, estimate.remark)))
        return replace(estimate, scale_std=predicted.scale_std, rejected=predicted.rejected, remark=remark)

    def _prior(self, predicted: QueryResult) -> Prior | None:
        """Return the predicted pose as a prior for matching; None if its position is unknown."""
        if predicted.world_from_rig is None or not np.isfinite(predicted.position_std):
            return None
        images = np.array([self._index_of[name] for name in predicted.references], np.int64)
        stds = predicted.rotation_std_deg, predicted.position_std
        return Prior.about(predicted.world_from_rig, images, *stds, "feed_forward")


def _better(matched: QueryResult, lifted: QueryResult) -> QueryResult:
    """Return the pose with the better status; at equal status the lifted one only if it has clearly more matches."""
    rank_matched, rank_lifted = matched.status.rank, lifted.status.rank
    clearly_more = matched.num_guided <= TIE * lifted.num_guided
    return lifted if rank_lifted > rank_matched or (rank_lifted == rank_matched > 0 and clearly_more) else matched
