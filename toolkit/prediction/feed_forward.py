"""Localize without matching: align a network's predicted cameras of the query and its references to the map.

The most similar map images are often near-duplicates: they add no information, and without a baseline they give no
scale. The map poses are known, so the choice of references considers covisibility and baselines too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import ArrayLike

from toolkit import geometry
from toolkit.alignment.robust import AlignmentError, robust_mean_pose
from toolkit.alignment.similarity import Alignment, align_to_map, is_trustworthy, query_pose
from toolkit.capture import Session
from toolkit.capture.images import in_view, view_bounds
from toolkit.capture.upright import Turns
from toolkit.errors import first_line, reason_of
from toolkit.geometry import Floats, Ints
from toolkit.manifest import PredictorSettings
from toolkit.mapping.local_map import LocalMap
from toolkit.models.compute import RUNNING
from toolkit.pose.base import (
    CAMERA,
    Localizer,
    Prior,
    Query,
    QueryInput,
    QueryMatches,
    QueryResult,
    References,
    Status,
    View,
    carried_over,
)
from toolkit.prediction.depths import DepthMaps, SeenDepth, lifted
from toolkit.prediction.interface import Prediction, Predictor
from toolkit.threads import fixed_sums

WIDE_BASELINE = 0.25  # baseline over depth; a wider one counts no more
NEAR_DUPLICATE = 0.03  # baseline over depth; below, two images are near-duplicates
MIN_SIMILARITY = 0.25  # similarity of the worst candidate, where that of the best one is 1
ALL_SHARED = 50  # shared points from which two images count as fully covisible
_LAST = 1e-3  # factor that puts near-duplicates and images without shared view last
FOCAL_TOLERANCE = 0.2
"""Difference between the log focal length ratios (predicted over stated) of query and references above which the stated
focal length is wrong; several times the usual error of the networks."""
MAX_DEPTH_POINTS = 200
"""Largest number of map points per reference whose depth is compared with the prediction; those with the longest tracks
are used."""
MIN_POINTS = 20
"""If a reference sees fewer map points, its depth map in the capture is used instead, if there is one."""


def select_references(
    scores: ArrayLike,
    world_from_cams: ArrayLike,
    k: int,
    cameras: Sequence[pycolmap.Camera],
    shared_points: ArrayLike | None = None,
    depth_m: float = 5.0,
) -> Ints:
    """Choose references that are similar to the query, covisible, and apart from each other.

    The choice is greedy. The first reference has the best score; if other candidates share views, it must share one
    too. Each next reference maximizes the product of its similarity, the view it shares with those chosen, and its
    baseline to the nearest of them. Near-duplicates and images without shared view come last.

    Args:
        scores: (N,) similarities, higher is better.
        world_from_cams: (N, 4, 4) map poses.
        k: number of references to choose.
        cameras: N cameras. Their views are compared by points at half, once and twice the depth.
        shared_points: (N, N) number of triangulated points that both images observe, if known. Overlapping frusta
            alone do not reveal a wall in between.
        depth_m: typical depth of the scene, meters.

    Returns:
        At most k indices in order of choice. A candidate whose pose or score is not finite is never chosen. Ties go to
        the earlier candidate.
    """
    score = np.asarray(scores, np.float64).reshape(-1)
    poses = np.asarray(world_from_cams, np.float64).reshape(-1, 4, 4)
    usable = np.flatnonzero(np.isfinite(score) & np.isfinite(poses).all(axis=(1, 2)))
    if not len(usable) or k < 1:
        return np.zeros(0, np.int64)
    score, poses = score[usable], poses[usable]
    spread, similarity = score.max() - score.min(), np.ones(len(score))
    if spread > 0:
        similarity = MIN_SIMILARITY + (1 - MIN_SIMILARITY) * (score - score.min()) / spread
    shared = _shared_view(poses, [cameras[int(index)] for index in usable], depth_m)
    if shared_points is not None:
        counts = np.asarray(shared_points, np.float64)[np.ix_(usable, usable)]
        shared = (shared + np.minimum(counts / ALL_SHARED, 1.0)) / 2
    np.fill_diagonal(shared, 0.0)
    baseline = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1) / depth_m
    gain = np.clip(baseline / WIDE_BASELINE, 0.0, 1.0)
    gain[baseline < NEAR_DUPLICATE] = _LAST

    connected = shared.max(axis=1) > 0.02
    first = similarity if connected[np.argmax(score)] or not connected.any() else similarity * connected
    chosen = [int(np.argmax(first))]
    while len(chosen) < min(k, len(usable)):
        value = similarity * np.maximum(shared[:, chosen].max(axis=1), _LAST) * gain[:, chosen].min(axis=1)
        value[chosen] = -1.0
        chosen.append(int(np.argmax(value)))
    return usable[chosen]


def _shared_view(world_from_cams: Floats, cameras: Sequence[pycolmap.Camera], depth_m: float) -> Floats:
    """Return the share (N, N) of one camera's view that the other sees too, averaged over both directions."""
    bounds = np.stack([view_bounds(camera) for camera in cameras])
    steps = np.linspace(0.1, 0.9, 5)
    x = bounds[:, :1] + steps * (bounds[:, 1:2] - bounds[:, :1])
    y = bounds[:, 2:3] + steps * (bounds[:, 3:] - bounds[:, 2:3])
    depths = depth_m * np.array([0.5, 1.0, 2.0])
    rays = np.stack(np.broadcast_arrays(x[:, None, :], y[:, :, None], 1.0), axis=-1).reshape(len(x), 1, -1, 3)
    points = geometry.transform(world_from_cams, (rays * depths[:, None, None]).reshape(len(x), -1, 3))
    cams_from_world = geometry.invert(world_from_cams)
    seen = np.stack([in_view(geometry.transform(cams_from_world, p[None]), bounds).mean(axis=1) for p in points])
    return (seen + seen.T) / 2


@dataclass(frozen=True)
class CameraAnswer:
    """The result for one image of a query."""

    references: Ints
    """(k,) map images given to the network, in order of choice."""
    prediction: Prediction | None = None
    """Prediction for the query, first, and its references."""
    alignment: Alignment | None = None
    world_from_cam: Floats | None = None
    """(4, 4); None if the rotation is unknown. If the scale is unknown, the position is that of the first consistent
    reference."""
    covariance: Floats | None = None
    """(6, 6), see `QueryResult.covariance`."""
    reason: str = ""
    """What was left out or is unknown; without a pose, why there is none."""
    depth_ratios: tuple[Floats, ...] = ()
    """For each reference, metric over predicted depth at points of known depth."""
    focal_px: float = np.nan
    """Predicted focal length if it contradicts the camera, else NaN."""


@dataclass(frozen=True)
class QueryPrediction:
    """A network's predictions for a query, not yet aligned to the map."""

    references: tuple[Ints, ...]
    """References chosen for each image of the query, see `CameraAnswer`."""
    predictions: tuple[Prediction | str, ...]
    """Prediction for each image, or the reason why there is none."""


@dataclass(frozen=True)
class FeedForwardAnswer:
    """The estimate for a query device, and the results per image that it combines."""

    estimate: QueryResult
    cameras: tuple[CameraAnswer, ...] = ()


class FeedForwardLocalizer(Localizer):
    """Localizes queries in one map by predicted cameras."""

    def __init__(
        self,
        local_map: LocalMap,
        session: Session,
        predictor: Predictor,
        settings: PredictorSettings | None = None,
        turns: Turns | None = None,
        length: float = 1.0,
        unit: tuple[str, float] = ("m", 1.0),
    ):
        """Depths of the depth maps of the map's session are divided by `length`, see `LocalMap.length`; `turns` make
        images upright for the predictor; `unit` is the one that lengths are shown in, with its length in the map.
        """
        self.map, self.predictor, self.unit = local_map, predictor, unit
        self.settings = settings or PredictorSettings()
        self._session = session
        self.seen_depth = depth_of_images(session, local_map.image_names, length)
        self._upright = turns is not None
        self._turns = np.zeros(len(session.images), np.int64) if turns is None else turns.of(session)
        self.image_names, self.batch_size = local_map.image_names, self.settings.batch_size

    @fixed_sums
    def solve(
        self, matches: QueryMatches, prediction: QueryPrediction | None = None, priors: Sequence[Prior] = ()
    ) -> QueryResult:
        """Return the predicted pose of a query; see `Localizer`."""
        return self.answer(matches.query, matches.references, prediction).estimate

    @fixed_sums
    def answer(
        self, query: Query, references: Sequence[References], prediction: QueryPrediction | None = None
    ) -> FeedForwardAnswer:
        """Return the predicted pose of a query with the results per image; the arguments are those of `localize`.

        Errors are not raised: the status of the estimate becomes `failed: <reason>`.
        """
        if prediction is None:
            with RUNNING:  # `localize` is thread-safe, `predict` is not
                (prediction,) = self.predict([(query, references)])
        images = zip(query.views, prediction.references, prediction.predictions, strict=True)
        cameras = tuple(self._camera_answer(*image) for image in images)
        return FeedForwardAnswer(_combine(query, cameras, self.image_names), cameras)

    def predict(self, queries: Sequence[QueryInput]) -> list[QueryPrediction]:
        """Return the predictions for each query, made in one call of the predictor; see `Localizer`.

        `localize` aligns them to the map, in other threads while the network continues. An error in one query is not
        raised and does not affect the others; one of all queries is, such as of the device, weights or memory, see
        `errors.reason_of`.
        """
        chosen = [[self._choose(retrieved) for retrieved in references] for _, references in queries]
        groups = {
            (number, camera): [self._as_shown(query.views[camera]), *(self.view(int(index)) for index in references)]
            for number, (query, _) in enumerate(queries)
            for camera, references in enumerate(chosen[number])
            if len(references)
        }
        results = self._predict(list(groups.values()))
        predictions = dict(zip(groups, results, strict=True))
        return [
            QueryPrediction(
                tuple(references),
                tuple(predictions.get((number, camera), "no references") for camera in range(len(references))),
            )
            for number, references in enumerate(chosen)
        ]

    def _as_shown(self, view: View) -> View:
        return view if self._upright else replace(view, turns=0)

    def view(self, index: int) -> View:
        """Return a map image as the network gets it."""
        name = self.map.image_names[index]
        row = self._session.row_of_name[name]
        return View(name, self._session.image_path(row), self.map.cameras[index], True, int(self._turns[row]))

    def _choose(self, references: References) -> Ints:
        in_map = references.images < len(self.map.image_names)  # larger indices are images of other kinds of features
        candidates = references.images[in_map]
        if not len(candidates):
            return candidates
        points = [self.map.observations(int(index))[1] for index in candidates]
        images = np.repeat(candidates, [len(observed) for observed in points])
        depth = np.einsum("oj,oj->o", self.map.cams_from_world[images, 2, :3], self.map.points[np.concatenate(points)])
        depth += self.map.cams_from_world[images, 2, 3]
        chosen = select_references(
            references.scores[in_map],
            self.map.world_from_cams[candidates],
            self.settings.num_references,
            [self.map.cameras[int(index)] for index in candidates],
            self.map.shared_points(candidates),
            **({"depth_m": float(np.median(depth))} if len(depth) else {}),
        )
        return candidates[chosen]

    def _predict(self, groups: list[list[View]]) -> list[Prediction | str]:
        """Return a prediction per group, or the reason why there is none."""
        try:
            return [*self.predictor.predict(groups)] if groups else []
        except Exception as error:  # one bad query must not end a run; the groups are tried one by one
            if len(groups) == 1:
                return [reason_of(error, f"predicting {groups[0][0].name}")]
        return [prediction for group in groups for prediction in self._predict([group])]

    def _camera_answer(self, view: View, references: Ints, prediction: Prediction | str) -> CameraAnswer:
        if isinstance(prediction, str):
            return CameraAnswer(references, reason=prediction)
        try:
            cameras = [view.camera, *(self.map.cameras[int(index)] for index in references)]
            return replace(self._align(references, prediction), focal_px=_other_focal(prediction, cameras))
        except AlignmentError as error:
            return CameraAnswer(references, prediction, reason=first_line(error))
        except Exception as error:  # a predictor may return anything
            return CameraAnswer(references, prediction, reason=reason_of(error, "aligning a prediction"))

    def _align(self, references: Ints, prediction: Prediction) -> CameraAnswer:
        model = np.asarray(prediction.model_from_cams, np.float64)
        if not np.isfinite(model[0]).all():
            reason = prediction.reason or "the predicted camera is not finite"
            return CameraAnswer(references, prediction, reason=reason)
        ratios = [self._depth_ratios(int(index), prediction, view) for view, index in enumerate(references, start=1)]
        world = self.map.world_from_cams[references]
        alignment = align_to_map(model[1:], world, depth_ratios=ratios if any(len(r) for r in ratios) else None)
        if not np.isfinite(alignment.rotation_std_deg):
            reason = alignment.reason or "the rotation is unknown"
            return CameraAnswer(references, prediction, alignment, reason=reason, depth_ratios=tuple(ratios))
        pose, covariance = query_pose(alignment, model[0])
        if not alignment.scale_known:
            # An arbitrary scale moves the query along a line; the position of a reference is a better guess.
            pose[:3, 3] = world[int(np.argmax(alignment.consistent)), :3, 3]
        return CameraAnswer(references, prediction, alignment, pose, covariance, alignment.reason, tuple(ratios))

    def _depth_ratios(self, image: int, prediction: Prediction, view: int) -> Floats:
        """Return metric over predicted depth (R,) at points that a map image observes."""
        points = self._points(image)
        in_cam = geometry.transform(self.map.cams_from_world[image], points)
        in_cam = in_cam[in_cam[:, 2] > 0.1]
        pixels = np.asarray(self.map.cameras[image].img_from_cam(in_cam), np.float64).reshape(-1, 2)
        ratios = in_cam[:, 2] / prediction.depth_at(view, pixels)
        return np.asarray(ratios[np.isfinite(ratios)], np.float64)

    def _points(self, image: int) -> Floats:
        """Return world points (P, 3) that a map image observes: triangulated, else from the capture's depth maps."""
        points = np.unique(self.map.observations(image)[1])
        if len(points) >= MIN_POINTS:
            order = np.argsort(-self.map.track_lengths(points), kind="stable")[:MAX_DEPTH_POINTS]
            return self.map.points[points[order]]
        seen = self.seen_depth(image)
        sample = np.linspace(0, len(seen) - 1, min(len(seen), MAX_DEPTH_POINTS)).astype(np.int64)
        if not len(sample):
            return self.map.points[points]
        in_cam = lifted(self.map.cameras[image], seen.pixels[sample], seen.depth_m[sample])
        return geometry.transform(self.map.world_from_cams[image], in_cam)


def depth_of_images(session: Session, names: Sequence[str], length: float = 1.0) -> Callable[[int], SeenDepth]:
    """Return a function that returns the depth of a map image, by its index in `names`, from the session's depth maps,
    divided by `length`, see `LocalMap.length`.
    """
    depths = DepthMaps(session)

    def of_image(image: int) -> SeenDepth:
        seen = depths.of(session.row_of_name[names[image]])
        return replace(seen, depth_m=seen.depth_m / length)

    return of_image


def _combine(query: Query, cameras: tuple[CameraAnswer, ...], image_names: Sequence[str]) -> QueryResult:
    """Combine the poses of the cameras of a device into one estimate."""
    reasons = "; ".join(dict.fromkeys(answer.reason for answer in cameras if answer.reason))
    alignments = {index: answer.alignment for index, answer in enumerate(cameras) if answer.alignment is not None}
    poses = {index: answer.world_from_cam for index, answer in enumerate(cameras) if answer.world_from_cam is not None}
    covariances = {index: answer.covariance for index, answer in enumerate(cameras) if answer.covariance is not None}
    if not poses:
        return QueryResult.failed(reasons, found_by="feed_forward")
    known = [index for index in poses if np.isfinite(covariances[index]).all()]
    if known:
        mean = robust_mean_pose(
            np.stack([poses[index] for index in known]) @ geometry.invert(query.rig_from_cams[known]),
            np.stack([carried_over(covariances[index], query.rig_from_cams[index]) for index in known]),
        )
        pose, covariance = mean.world_from_cam, mean.covariance
        kept = [index for index, inside in zip(known, mean.consistent, strict=True) if inside]
        reasons = "; ".join(filter(None, (reasons, mean.reason)))
        agreed = np.isfinite(covariance).all() and 2 * len(kept) > len(known)
        sure = agreed and any(is_trustworthy(alignments[index], covariance) for index in kept)
    else:
        best = min(poses, key=lambda index: alignments[index].rotation_std_deg)
        rig_from_cam = query.rig_from_cams[best]
        kept, pose, sure = [best], poses[best] @ geometry.invert(rig_from_cam), False
        R, covariance = rig_from_cam[:3, :3], np.diag(np.full(6, np.inf))
        covariance[:3, :3] = R @ covariances[best][:3, :3] @ R.T
    focals = tuple(answer.focal_px for answer in cameras)
    contradicted = bool(np.isfinite(focals).any())
    if contradicted:
        seen = ", ".join(f"{focal:.0f}" for focal in focals if np.isfinite(focal))
        reasons = "; ".join(filter(None, (reasons, f"the network sees a focal length of {seen} px")))
    consistent = [int(i) for index in kept for i in cameras[index].references[alignments[index].consistent]]
    shown = [int(i) for answer in cameras if answer.prediction is not None for i in answer.references]
    return QueryResult(
        Status.OK if sure and not contradicted else Status.LOW_CONFIDENCE,
        CAMERA if contradicted else "",
        world_from_rig=pose,
        covariance=covariance,
        references=tuple(image_names[index] for index in dict.fromkeys(consistent)),
        found_by="feed_forward",
        scale_std=min(alignments[index].scale_std for index in kept),
        rejected=tuple(image_names[index] for index in dict.fromkeys(shown) if index not in consistent),
        remark=reasons,
        camera_contradicted=contradicted,
        focals_px=focals if contradicted else (),
    )


def _other_focal(prediction: Prediction, cameras: Sequence[pycolmap.Camera]) -> float:
    """Return the predicted focal length of the first image of a group if it contradicts the camera, else NaN.

    A network errs by some percent, equally for all images of a group, so the references give its error.
    """
    if prediction.intrinsics is None:
        return np.nan
    predicted_px = prediction.intrinsics[:, [0, 1], [0, 1]].mean(axis=1)
    ratios = predicted_px / [camera.mean_focal_length() for camera in cameras]
    logs = np.log(np.where(np.isfinite(ratios) & (ratios > 0), ratios, np.nan))
    of_references = logs[1:][np.isfinite(logs[1:])]
    if not len(of_references) or not np.isfinite(logs[0]):
        return np.nan
    middle = float(np.median(of_references))
    limit = max(FOCAL_TOLERANCE, 4 * float(np.median(np.abs(of_references - middle))))
    return float(cameras[0].mean_focal_length() * np.exp(logs[0] - middle)) if abs(logs[0] - middle) > limit else np.nan
