"""What all localizers share: a query with its references in, an estimate of its pose out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.features.features import LocalFeatures
from toolkit.features.matching import PairMatches
from toolkit.geometry import Floats, Ints
from toolkit.localizers.correspondences import Correspondences, Rival

SEARCH_DEG = (1.0, 6.0)
"""Limits of the radius in which features are sought about a prior."""
NEARBY_M = 3.0
"""Depth at which the uncertainty of a place is seen as an angle."""
CONFIRMED = (5.0, 0.5)  # degrees, meters: further apart, two answers contradict each other

CAMERA = "low_confidence: camera?"
"""Status of a pose whose matches contradict the intrinsics of the query."""

NetworkMatches = Callable[[str], PairMatches]
"""Returns the matches of a query image with a map image, given by its name, that a network made before."""


@dataclass(frozen=True)
class View:
    """One photograph as a localizer sees it."""

    name: str
    """`<session>/raw_data/<path>`, as `Session.image_name` gives it; any name for a picture of no session."""
    image: Path | NDArray[np.uint8]
    """The file, or pixels (H, W) or (H, W, 3) RGB."""
    camera: pycolmap.Camera
    in_map: bool
    """Whether it is a map image: others will ask for it again, so that its encoding is worth keeping."""
    turns: int = 0
    """Counter-clockwise quarter turns that bring gravity down, see `capture.upright`. A network is shown the image
    turned; what comes back is of the image as it is stored."""
    world_from_cam: Floats | None = None
    """(4, 4) of a map image, for networks that take known poses; see `Prediction.conditioned`."""


@dataclass(frozen=True)
class Query:
    """The C images of one query device at one instant: those of a rig, or one."""

    views: list[View]
    rig_from_cams: Floats
    """(C, 4, 4); the identity for a single camera."""
    features: Sequence[list[LocalFeatures] | str] = field(default_factory=list)
    """Of each image its local features, one a kind that the map has; or why the image has none."""
    network_matches: Sequence[list[NetworkMatches | None]] = field(default_factory=list)
    """Of each image and kind the matches with references that were made before; empty: none were."""

    def scaled(self, factor: float) -> "Query":
        """Return the query with the lengths of its rig times a factor."""
        return replace(self, rig_from_cams=_stretched(self.rig_from_cams, factor))

    def part(self, images: Sequence[int]) -> "Query":
        """Return the query with some of its images alone."""
        return replace(
            self,
            views=[self.views[index] for index in images],
            rig_from_cams=self.rig_from_cams[list(images)],
            features=[self.features[index] for index in images] if self.features else [],
            network_matches=[self.network_matches[index] for index in images] if self.network_matches else [],
        )


@dataclass(frozen=True)
class References:
    """The map images that were retrieved for one query image, best first."""

    images: Ints
    """(k,) indices of map images."""
    scores: Floats
    """(k,) similarities, larger is better."""

    @classmethod
    def of(cls, images: Sequence[int], scores: Sequence[float] | None = None) -> "References":
        """Return references; without scores, all are equally similar."""
        return cls(np.array(images, np.int64), np.array(scores if scores is not None else [1.0] * len(images)))

    def take(self, part: slice | NDArray[np.bool_]) -> "References":
        """Return some of them."""
        return References(self.images[part], self.scores[part])


Asked = tuple[Query, Sequence[References]]
"""A query with the references of each of its images."""


@dataclass(frozen=True)
class PoseEstimate:
    """The answer for one query device: a pose, or why there is none."""

    status: str
    """`ok`, `low_confidence`, `low_confidence: <reason>?`, or `failed: <reason>`."""
    world_from_rig: Floats | None = None
    """(4, 4); for a single camera the rig is the camera."""
    covariance: Floats | None = None
    """(6, 6) of a small motion of the rig in its own frame: rotation, radians, then translation, meters."""
    num_matches: int = 0
    """2D-3D matches found from descriptors alone."""
    num_inliers: int = 0
    """Of these, within `ransac_max_error_deg` of the final pose."""
    num_guided: int = 0
    """Matches that the final pose rests on, within `max_error_deg`."""
    rmse_px: float = float("nan")
    rival_support: float = 0.0
    """Guided matches of the best clearly different pose, relative to this one's; 0 where there is none."""
    rivals: tuple[Rival, ...] = ()
    """Clearly different poses that matches agree with, too, best supported first."""
    coverage: float = 0.0
    """Share of the cells, 16 a query image, in which an inlier lies."""
    agreement: int = 0
    """Inliers of the second best kind of features; 0 if there is one kind."""
    p_correct: float = float("nan")
    """Probability that the pose is within 5 degrees and 0.5 m, see `confidence`; NaN where it was not matched."""
    references: tuple[int, ...] = ()
    """Map images that the pose rests on."""
    correspondences: Correspondences = field(default_factory=Correspondences)
    """What the pose rests on, and what disagrees with it."""
    found_by: str = "pnp"
    """How the pose was found: `pnp`, `pnp+feed_forward` or `pnp+near` (from a prior), `lifted` (map features lifted by
    a capture's depth maps), `lifted+feed_forward` (by predicted depth, too), `feed_forward` (a prediction), `nearest`,
    `sequence`."""
    scale_std: float = float("nan")
    """Relative standard deviation of a prediction's scale; inf if unknown, NaN without a prediction."""
    rejected: tuple[int, ...] = ()
    """References whose predicted places contradict the others'."""
    reason: str = ""
    """What intrinsics fit the query better than the stated; of a prediction, what was left out or is unknown."""
    misfit: bool = False
    """Whether the matches contradict the intrinsics of the query, see `misfit`: more features cannot mend that. Where
    the contradiction is small, it shows in the covariance alone."""
    focals_px: tuple[float, ...] = ()
    """Of each query image the focal length that fits, if that is what contradicts, else NaN; empty: nothing does."""

    def scaled(self, factor: float) -> "PoseEstimate":
        """Return the estimate with all lengths times a factor."""
        pose, covariance, stretch = self.world_from_rig, self.covariance, np.repeat([1.0, factor], 3)
        return replace(
            self,
            world_from_rig=None if pose is None else _stretched(pose, factor),
            covariance=None if covariance is None else covariance * np.outer(stretch, stretch),
            correspondences=replace(self.correspondences, points=factor * self.correspondences.points),
            rivals=tuple(Rival(_stretched(rival.world_from_rig, factor), rival.support) for rival in self.rivals),
        )

    @property
    def position_std_m(self) -> float:
        return float("nan") if self.covariance is None else float(stds_of(self.covariance)[1])

    @property
    def rotation_std_deg(self) -> float:
        return float("nan") if self.covariance is None else float(stds_of(self.covariance)[0])

    @property
    def inlier_ratio(self) -> float:
        return self.num_inliers / self.num_matches if self.num_matches else 0.0


@dataclass(frozen=True)
class RoughPose:
    """About where a query is."""

    world_from_rig: Floats
    """(4, 4); of a single camera world_from_cam."""
    rotation_std_deg: float
    position_std_m: float


@dataclass(frozen=True)
class Prior:
    """A pose to look for, from elsewhere than matches."""

    world_from_rig: Floats
    """(4, 4)"""
    images: Ints
    """Map images that see what the query sees."""
    radius_deg: float
    """How far from where the pose puts a map point its feature may be."""
    source: str
    """What gave it: `feed_forward`, `near`."""

    @classmethod
    def about(
        cls, world_from_rig: Floats, images: Ints, rotation_std_deg: float, position_std_m: float, source: str
    ) -> "Prior":
        """Return a prior that is searched as far about as its standard deviations ask for."""
        spread_deg = rotation_std_deg + np.degrees(np.arctan(position_std_m / NEARBY_M))
        return cls(world_from_rig, images, float(np.clip(2 * spread_deg, *SEARCH_DEG)), source)

    def scaled(self, factor: float) -> "Prior":
        """Return the prior with all lengths times a factor."""
        return replace(self, world_from_rig=_stretched(self.world_from_rig, factor))


class Localizer(Protocol):
    """Localizes queries in one map. Safe to use from several threads; the map is never changed."""

    @property
    def image_names(self) -> list[str]:
        """Names of the map images that references and estimates count through."""

    @property
    def batch_size(self) -> int:
        """How many queries `predict` is best given at once."""

    def predict(self, queries: Sequence[Asked], following: Sequence[Asked] = ()) -> list[Any]:
        """Return what a network says of each query, or None of each where the method asks none. Not for threads.

        Args:
            queries: each with the references of its images.
            following: those of the next call, whose images are decoded meanwhile.

        Raises:
            ToolkitError: what no other query would do better with: no such device, other weights, too little memory.
        """

    def localize(
        self, query: Query, references: Sequence[References], prediction: Any = None, priors: Sequence[Prior] = ()
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera.

        Args:
            query: the images of one device at one instant.
            references: of each image.
            prediction: what `predict` returned for the query; None: it is asked here where it is needed.
            priors: poses to look for; methods that match nothing do not use them.
        """


class ScaledLocalizer:
    """A localizer of a map whose lengths are other multiples of the unit than those that limits are meant for."""

    def __init__(self, inner: Localizer, length: float) -> None:
        """
        Args:
            inner: of the map with all lengths divided by `length`.
            length: see `Survey.length`.
        """
        self.inner, self._length = inner, length
        self.image_names, self.batch_size = inner.image_names, inner.batch_size

    def predict(self, queries: Sequence[Asked], following: Sequence[Asked] = ()) -> list[Any]:
        """Return what a network says of each query, in lengths of the inner localizer; see `Localizer`."""
        return self.inner.predict(self._scaled(queries), self._scaled(following))

    def _scaled(self, queries: Sequence[Asked]) -> list[Asked]:
        return [(query.scaled(1 / self._length), references) for query, references in queries]

    def localize(
        self, query: Query, references: Sequence[References], prediction: Any = None, priors: Sequence[Prior] = ()
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; see `Localizer`."""
        near = [prior.scaled(1 / self._length) for prior in priors]
        return self.inner.localize(query.scaled(1 / self._length), references, prediction, near).scaled(self._length)


def _stretched(poses: Floats, factor: float) -> Floats:
    """Return poses (..., 4, 4) with their translations times a factor."""
    return geometry.make_pose(poses[..., :3, :3], factor * poses[..., :3, 3])


def stds_of(covariances: Floats) -> tuple[Floats, Floats]:
    """Return the standard deviations (...) of rotations, degrees, and places, meters, as lengths, of (..., 6, 6)."""
    rotation, position = (np.trace(covariances[..., s, s], axis1=-2, axis2=-1) for s in (slice(3), slice(3, 6)))
    return np.degrees(np.sqrt(rotation)), np.sqrt(position)


def carried_over(covariance: Floats, a_from_b: Floats) -> Floats:
    """Return the covariance (6, 6) of a pose as a motion in a's frame, from that in b's; b is mounted on a."""
    R, (x, y, z) = a_from_b[:3, :3], a_from_b[:3, 3]
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    adjoint = np.block([[R, np.zeros((3, 3))], [across @ R, R]])
    return np.asarray(adjoint @ covariance @ adjoint.T)


def rank(status: str) -> int:
    """Return 2 for `ok`, 1 for a pose of low confidence, 0 for none."""
    return {"ok": 2, "low_confidence": 1}.get(status.split(":")[0], 0)


def agree(world_from_rig: Floats | None, other: Floats | None) -> bool:
    """Tell whether two poses are near enough that one confirms the other."""
    if world_from_rig is None or other is None:
        return False
    rotation_deg, distance_m = geometry.pose_error(world_from_rig, other)
    return bool(rotation_deg <= CONFIRMED[0] and distance_m <= CONFIRMED[1])
