"""Localize again with further kinds of local features if the first pose is uncertain."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from toolkit import geometry
from toolkit.capture.images import pixels_of
from toolkit.features.features import KINDS, LocalFeatures, extract_turned
from toolkit.features.matching import AnyMethod
from toolkit.geometry import Floats, Ints
from toolkit.pose.base import SEARCH_DEG, Localizer, PoseEstimate, Prior, Query, QueryInput, References, rank

MAX_KNOWN = 3
"""Largest number of earlier poses of a query that all kinds of features judge."""

SURE_POSITION_STD_M = 0.05
"""An `ok` pose with at most this standard deviation of the position, meters, is precise enough; otherwise the further
features of `escalation` are used too."""


def is_sure(status: str, position_std_m: float, limit_m: float) -> bool:
    """Tell whether a pose is `ok` and precise, so that it needs no further features."""
    return status == "ok" and not position_std_m > limit_m  # NaN for a pose without matches counts as precise


def can_gain(query: Query, references: Sequence[References]) -> bool:
    """Tell whether further features could find a pose: at least one readable image has references."""
    return any(
        not isinstance(features, str) and len(retrieved.images)
        for features, retrieved in zip(query.features, references, strict=True)
    )


def is_better(status: str, first_status: str) -> bool:
    """Tell by their statuses whether the pose from all features replaces the first pose."""
    return rank(status) >= max(rank(first_status), 1)


def known_poses(estimate: PoseEstimate) -> list[Floats]:
    """Return the pose of an estimate and those of its best rivals, as quaternion and translation (7,) each."""
    poses = [estimate.world_from_rig, *(rival.world_from_rig for rival in estimate.rivals)]
    return [geometry.qt_from_pose(pose) for pose in poses[:MAX_KNOWN] if pose is not None]


class EscalatingLocalizer:
    """Runs a localizer, and where its pose is uncertain a second one that has more kinds of features."""

    def __init__(
        self,
        first: Localizer,
        second: Localizer,
        further: Sequence[AnyMethod],
        sure_position_std_m: float,
        images_near: Callable[[Floats], Ints],
    ) -> None:
        """
        Args:
            first: localizes every query.
            second: its kinds of features are those of `first`, followed by the further ones.
            further: the further kinds of features.
            sure_position_std_m: `SURE_POSITION_STD_M` in the unit of the poses.
            images_near: returns the map images that may show what a rig at a pose (4, 4) sees.
        """
        self.first, self.second, self._further, self._limit_m = first, second, further, sure_position_std_m
        self._images_near = images_near
        self.image_names, self.batch_size = first.image_names, first.batch_size

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[Any]:
        """Return the predictions of the first localizer; see `Localizer`."""
        return self.first.predict(queries, following)

    def localize(
        self, query: Query, references: Sequence[References], prediction: Any = None, priors: Sequence[Prior] = ()
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; see `Localizer`.

        `found_by` names the further kinds if the pose was computed with them.
        """
        estimate = self.first.localize(query, references, prediction, priors)
        sure = is_sure(estimate.status, estimate.position_std_m, self._limit_m)
        if sure or estimate.misfit or not can_gain(query, references):  # no features repair wrong intrinsics
            return estimate
        escalated = self.escalate(self._with_all_features(query), references, known_poses(estimate), priors)
        return escalated if is_better(escalated.status, estimate.status) else estimate

    def escalate(
        self,
        query: Query,
        references: Sequence[References],
        known: Sequence[Floats] = (),
        priors: Sequence[Prior] = (),
    ) -> PoseEstimate:
        """Return the pose from all kinds of features, for a query that has them all; see `localize`.

        Args:
            query, references, priors: see `Localizer`.
            known: `known_poses` of the first estimate. All kinds of features judge them, too.
        """
        again = [
            Prior(pose, images, SEARCH_DEG[0], "first")
            for pose in map(geometry.pose_from_qt, known)
            if len(images := self._images_near(pose))
        ]
        escalated = self.second.localize(query, references, None, [*priors, *again])
        return replace(escalated, found_by="+".join([escalated.found_by, *(kind.name for kind in self._further)]))

    def _with_all_features(self, query: Query) -> Query:
        """Add the further kinds of features to a query."""
        features: list[list[LocalFeatures] | str] = []
        for view, first in zip(query.views, query.features, strict=True):
            if isinstance(first, str):
                features.append(first)
                continue
            further = []
            for method in self._further:
                pixels = pixels_of(view.image, gray=not method.extractor.color)
                turns = view.turns if KINDS[method.name].upright else 0
                further += extract_turned(method.extractor, [pixels], [turns])
            features.append([*first, *further])
        return replace(query, features=features, network_matches=[])
