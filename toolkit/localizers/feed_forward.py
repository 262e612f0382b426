"""Localize by what a feed-forward network says of a query and its references, aligned to the map. No matching."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from toolkit import geometry
from toolkit.capture import Session
from toolkit.capture.depths import DepthMaps, SeenDepth, lifted
from toolkit.capture.upright import Turns
from toolkit.errors import first_line, reason_of
from toolkit.geometry import Floats, Ints
from toolkit.localizers.alignment import Alignment, align_to_map, is_trustworthy, query_pose
from toolkit.localizers.base import CAMERA, PoseEstimate, Prior, Query, QueryInput, References, View, carried_over
from toolkit.localizers.local_map import LocalMap
from toolkit.localizers.pose_mean import robust_mean_pose
from toolkit.localizers.prediction import Prediction, Predictor
from toolkit.localizers.references import select_references
from toolkit.localizers.robust import AlignmentError
from toolkit.manifest import PredictorSettings

log = logging.getLogger(__name__)

FOCAL_TOLERANCE = 0.2
"""Difference of the logarithms of predicted and stated focal length, beside that of the references, that tells a wrong
camera: several times what networks err by."""


@dataclass(frozen=True)
class CameraAnswer:
    """What came out for one image of a query."""

    references: Ints
    """(k,) map images chosen, in order of choice."""
    prediction: Prediction | None = None
    """Of the query, first, and the references."""
    alignment: Alignment | None = None
    world_from_cam: Floats | None = None
    """(4, 4), None without a known rotation; where the scale is unknown, at the place of the first consistent
    reference."""
    covariance: Floats | None = None
    """(6, 6), in the convention of `PoseEstimate`."""
    reason: str = ""
    """What was left out or is unknown; without a pose, why there is none."""
    depth_ratios: tuple[Floats, ...] = ()
    """For each reference, metric over predicted depth at points that the map knows."""
    focal_px: float = np.nan
    """What the network sees, where the camera says something else; NaN where they agree or nothing is known."""


@dataclass(frozen=True)
class Predicted:
    """What a network says of a query, not yet aligned to the map."""

    references: tuple[Ints, ...]
    """Those chosen for each image of the query, see `CameraAnswer`."""
    predictions: tuple[Prediction | str, ...]
    """Of each image; why there is none."""


@dataclass(frozen=True)
class FeedForwardAnswer:
    """The estimate for a query device, and how it came about."""

    estimate: PoseEstimate
    cameras: tuple[CameraAnswer, ...] = ()


_Groups = tuple[list[list[Ints]], dict[tuple[int, int], list[View]]]
"""The references chosen for each image of each query, and the groups of views by query and image."""


class FeedForwardLocalizer:
    """Localizes queries in one map by a predictor's cameras."""

    def __init__(
        self,
        local_map: LocalMap,
        session: Session,
        predictor: Predictor,
        settings: PredictorSettings | None = None,
        turns: Turns | None = None,
        length: float = 1.0,
    ):
        """`session` has the map's images and depth maps, whose depths are divided by `length`; `turns` makes images
        upright, None leaves them as they are."""
        self.map = local_map
        self.predictor = predictor
        self.settings = settings or PredictorSettings()
        self._session = session
        self._depths = DepthMaps(session)
        self._length = length
        self._upright = turns is not None
        self._turns = np.zeros(len(session.images), np.int64) if turns is None else turns.of(session)
        self._next: tuple[Sequence[QueryInput], _Groups] = (), ([], {})
        """The queries of the next call."""
        self.image_names, self.batch_size = local_map.image_names, self.settings.batch_size

    def localize(
        self,
        query: Query,
        references: Sequence[References],
        prediction: Predicted | None = None,
        priors: Sequence[Prior] = (),
    ) -> PoseEstimate:
        """Return the predicted pose of a query; see `Localizer`."""
        return self.answer(query, references, prediction).estimate

    def answer(
        self, query: Query, references: Sequence[References], prediction: Predicted | None = None
    ) -> FeedForwardAnswer:
        """Return the predicted pose of a query, and how it came about; the arguments are those of `localize`.

        Nothing that goes wrong is raised: the answer says `failed: <reason>`.
        """
        predicted = self.predict([(query, references)])[0] if prediction is None else prediction
        found = zip(query.views, predicted.references, predicted.predictions, strict=True)
        cameras = tuple(self._camera_answer(*one) for one in found)
        return FeedForwardAnswer(_combine(query, cameras), cameras)

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[Predicted]:
        """Return what the predictor, asked once for all, says of each query; see `Localizer`.

        Aligning it to the map is left to `localize`, which other threads can do while the network goes on. Nothing that
        goes wrong with one query is raised or touches another.

        Raises:
            Exception: what no other query would do better with: no such device, other weights, too little memory; see
                `errors.reason_of`.
        """
        expected, known = self._next
        chosen, groups = known if queries is expected else self._groups(queries)
        next_groups = self._groups(following)
        self._next = following, next_groups
        found = self._predict(list(groups.values()), list(next_groups[1].values()))
        predictions = dict(zip(groups, found, strict=True))
        return [
            Predicted(
                tuple(references),
                tuple(predictions.get((number, camera), "no references") for camera in range(len(references))),
            )
            for number, references in enumerate(chosen)
        ]

    def _groups(self, queries: Sequence[QueryInput]) -> _Groups:
        chosen = [[self._choose(retrieved) for retrieved in references] for _, references in queries]
        groups = {
            (number, camera): [self._as_shown(query.views[camera]), *(self.view(int(index)) for index in references)]
            for number, (query, _) in enumerate(queries)
            for camera, references in enumerate(chosen[number])
            if len(references)
        }
        return chosen, groups

    def _as_shown(self, view: View) -> View:
        return view if self._upright else replace(view, turns=0)

    def view(self, index: int) -> View:
        """Return a map image as a network is shown it."""
        name = self.map.image_names[index]
        row = self._session.row_of_name[name]
        turns = int(self._turns[row])
        pose = self.map.world_from_cams[index]
        return View(name, self._session.image_path(row), self.map.cameras[index], True, turns, pose)

    def _choose(self, references: References) -> Ints:
        """Return the references of one query image to use."""
        known = references.images < len(self.map.image_names)  # further images are those of other kinds of features
        near, scores = references.images[known][: self.settings.candidates], references.scores[known]
        if not len(near):
            return near
        points = np.concatenate([self.map.observations(int(index))[1] for index in near])
        images = np.repeat(near, [len(self.map.observations(int(index))[1]) for index in near])
        depth = np.einsum("oj,oj->o", self.map.cams_from_world[images, 2, :3], self.map.points[points])
        depth += self.map.cams_from_world[images, 2, 3]
        chosen = select_references(
            scores[: len(near)],
            self.map.world_from_cams[near],
            self.settings.num_references,
            [self.map.cameras[int(index)] for index in near],
            self.map.shared_points(near),
            **({"depth_m": float(np.median(depth))} if len(depth) else {}),
        )
        return near[chosen]

    def _predict(self, groups: list[list[View]], following: Sequence[list[View]] = ()) -> list[Prediction | str]:
        """Return predictions, or why there is none."""
        try:
            return [*self.predictor.predict(groups, following)] if groups else []
        except Exception as error:  # one bad query never ends a run
            if len(groups) == 1:
                return [reason_of(error, f"predicting {groups[0][0].name}")]
        return [prediction for group in groups for prediction in self._predict([group])]

    def _camera_answer(self, view: View, references: Ints, prediction: Prediction | str) -> CameraAnswer:
        if isinstance(prediction, str):
            return CameraAnswer(references, reason=prediction)
        try:
            cameras = [view.camera, *(self.map.cameras[int(index)] for index in references)]
            return replace(self._align(references, prediction), focal_px=_other_focal(prediction, cameras))
        except AlignmentError as error:  # of this prediction alone
            return CameraAnswer(references, prediction, reason=first_line(error))
        except Exception as error:  # a prediction may be anything
            return CameraAnswer(references, prediction, reason=reason_of(error, "aligning a prediction"))

    def _align(self, references: Ints, prediction: Prediction) -> CameraAnswer:
        model = np.asarray(prediction.model_from_cams, np.float64)
        if not np.isfinite(model[0]).all():
            reason = prediction.reason or "the predicted camera is not finite"
            return CameraAnswer(references, prediction, reason=reason)
        ratios = [self._depth_ratios(int(index), prediction, view) for view, index in enumerate(references, start=1)]
        world = self.map.world_from_cams[references]
        told = np.zeros(len(references), bool) if prediction.conditioned is None else prediction.conditioned[1:]
        alignment = align_to_map(model[1:], world, ~told, ratios if any(len(r) for r in ratios) else None)
        if not np.isfinite(alignment.rotation_std_deg):
            reason = alignment.reason or "the rotation is unknown"
            return CameraAnswer(references, prediction, alignment, reason=reason, depth_ratios=tuple(ratios))
        pose, covariance = query_pose(alignment, model[0])
        if not alignment.scale_known:
            # Whatever scale was taken, the query may be put anywhere along a line; near a reference is a better guess.
            pose[:3, 3] = world[int(np.argmax(alignment.inliers)), :3, 3]
        return CameraAnswer(references, prediction, alignment, pose, covariance, alignment.reason, tuple(ratios))

    def _depth_ratios(self, image: int, prediction: Prediction, view: int) -> Floats:
        """Return metric over predicted depth (R,) at points that a map image sees."""
        points = self._points(image)
        in_cam = geometry.transform(self.map.cams_from_world[image], points)
        in_cam = in_cam[in_cam[:, 2] > 0.1]
        pixels = np.asarray(self.map.cameras[image].img_from_cam(in_cam), np.float64).reshape(-1, 2)
        ratios = in_cam[:, 2] / prediction.depth_at(view, pixels)
        return np.asarray(ratios[np.isfinite(ratios)], np.float64)

    def _points(self, image: int) -> Floats:
        """Return points (P, 3) in the world that a map image sees: triangulated, else of the capture's depth maps."""
        points = np.unique(self.map.observations(image)[1])
        if len(points) >= self.settings.least_points:
            order = np.argsort(-self.map.track_lengths(points), kind="stable")[: self.settings.depth_points]
            return self.map.points[points[order]]
        seen = self.seen_depth(image)
        part = np.linspace(0, len(seen) - 1, min(len(seen), self.settings.depth_points)).astype(np.int64)
        if not len(part):
            return self.map.points[points]
        in_cam = lifted(self.map.cameras[image], seen.pixels[part], seen.depth_m[part])
        return geometry.transform(self.map.world_from_cams[image], in_cam)

    def seen_depth(self, image: int) -> SeenDepth:
        """Return what the capture's depth maps say of a map image."""
        seen = self._depths.of(self._session.row_of_name[self.map.image_names[image]])
        return replace(seen, depth_m=seen.depth_m / self._length)


def _combine(query: Query, cameras: tuple[CameraAnswer, ...]) -> PoseEstimate:
    """Return one pose of the device from those of its cameras."""
    count = sum(len(answer.references) for answer in cameras if answer.prediction is not None)
    reasons = "; ".join(dict.fromkeys(answer.reason for answer in cameras if answer.reason))
    posed = [index for index, answer in enumerate(cameras) if answer.world_from_cam is not None]
    if not posed:
        return PoseEstimate(f"failed: {reasons}", num_matches=count, found_by="feed_forward")
    known = [index for index in posed if np.isfinite(_covariance(cameras[index])).all()]
    if known:
        poses = np.stack([_pose(cameras[index]) for index in known]) @ geometry.invert(query.rig_from_cams[known])
        covariances = np.stack([
            carried_over(_covariance(cameras[index]), query.rig_from_cams[index]) for index in known
        ])  # fmt: skip
        mean = robust_mean_pose(poses, covariances)
        pose, covariance = mean.world_from_cam, mean.covariance
        kept = [index for index, inside in zip(known, mean.inliers, strict=True) if inside]
        reasons = "; ".join(part for part in (reasons, mean.reason) if part)
        agreed = np.isfinite(covariance).all() and 2 * len(kept) > len(known)
        sure = agreed and any(is_trustworthy(_alignment(cameras[index]), covariance) for index in kept)
    else:
        kept = [min(posed, key=lambda index: _alignment(cameras[index]).rotation_std_deg)]
        rig_from_cam = query.rig_from_cams[kept[0]]
        pose, sure = _pose(cameras[kept[0]]) @ geometry.invert(rig_from_cam), False
        turn, covariance = rig_from_cam[:3, :3], np.diag(np.full(6, np.inf))
        covariance[:3, :3] = turn @ _covariance(cameras[kept[0]])[:3, :3] @ turn.T
    focals = tuple(answer.focal_px for answer in cameras)
    misfit = bool(np.isfinite(focals).any())
    if misfit:
        seen = ", ".join(f"{focal:.0f}" for focal in focals if np.isfinite(focal))
        reasons = "; ".join(part for part in (reasons, f"the network sees a focal length of {seen} px") if part)
    consistent = [int(i) for c in kept for i in cameras[c].references[_alignment(cameras[c]).inliers]]
    shown = [int(i) for answer in cameras if answer.prediction is not None for i in answer.references]
    return PoseEstimate(
        status=CAMERA if misfit else "ok" if sure else "low_confidence",
        world_from_rig=pose,
        covariance=covariance,
        num_matches=count,
        num_inliers=len(consistent),
        references=tuple(dict.fromkeys(consistent)),
        found_by="feed_forward",
        scale_std=min(_alignment(cameras[index]).scale_std for index in kept),
        rejected=tuple(index for index in dict.fromkeys(shown) if index not in consistent),
        reason=reasons,
        misfit=misfit,
        focals_px=focals if misfit else (),
    )


def _other_focal(prediction: Prediction, cameras: Sequence[pycolmap.Camera]) -> float:
    """Return the focal length that a network sees in the first of a group's photographs, if its camera is wrong.

    A network errs by some percent, of all photographs of a group alike: the references tell by how much.
    """
    if prediction.intrinsics is None:
        return np.nan
    predicted_px = prediction.intrinsics[:, [0, 1], [0, 1]].mean(axis=1)
    ratios = predicted_px / [camera.mean_focal_length() for camera in cameras]
    logs = np.log(np.where(np.isfinite(ratios) & (ratios > 0), ratios, np.nan))
    told = np.zeros(len(cameras), bool) if prediction.conditioned is None else prediction.conditioned
    known = logs[1:][np.isfinite(logs[1:]) & ~told[1:]]
    if not len(known) or not np.isfinite(logs[0]):
        return np.nan
    middle = float(np.median(known))
    limit = max(FOCAL_TOLERANCE, 4 * float(np.median(np.abs(known - middle))))
    return float(cameras[0].mean_focal_length() * np.exp(logs[0] - middle)) if abs(logs[0] - middle) > limit else np.nan


def _alignment(answer: CameraAnswer) -> Alignment:
    assert answer.alignment is not None
    return answer.alignment


def _pose(answer: CameraAnswer) -> Floats:
    assert answer.world_from_cam is not None
    return answer.world_from_cam


def _covariance(answer: CameraAnswer) -> Floats:
    assert answer.covariance is not None
    return answer.covariance
