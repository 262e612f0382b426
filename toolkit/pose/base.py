"""The interface of all localizers: a query and its references go in, an estimate of the pose comes out."""

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
from toolkit.pose.correspondences import Correspondences, Rival

SEARCH_DEG = (1.0, 6.0)
"""Smallest and largest radius of the search for keypoints around the projections of a prior pose, degrees."""
NEARBY_M = 3.0
"""Assumed depth of the scene, in map lengths (see `Survey.length`), to turn the uncertainty of a position into an
angle."""
CONFIRMED = (5.0, 0.5)  # degrees, meters: two poses within both confirm each other

CAMERA = "low_confidence: camera?"
"""Status of a pose whose matches contradict the intrinsics of the query."""

NetworkMatches = Callable[[str], PairMatches]
"""Returns the stored network matches between a query image and the map image of a given name."""


@dataclass(frozen=True)
class View:
    """One image with its camera."""

    name: str
    """`<session>/raw_data/<path>`, see `Session.image_name`; any name if the image belongs to no session."""
    image: Path | NDArray[np.uint8]
    """File, or pixels (H, W) or (H, W, 3) RGB."""
    camera: pycolmap.Camera
    in_map: bool
    """Whether it is a map image. Other queries use it too, so its encoding is worth caching."""
    turns: int = 0
    """Counter-clockwise quarter turns that make the image upright, see `capture.upright`. Networks get the turned
    image; their outputs are turned back to the stored image."""


@dataclass(frozen=True)
class Query:
    """The C images that one device took at one instant: all cameras of a rig, or a single camera."""

    views: list[View]
    rig_from_cams: Floats
    """(C, 4, 4); the identity for a single camera."""
    features: Sequence[list[LocalFeatures] | str] = field(default_factory=list)
    """Local features by image and kind of features in the map; a string gives the reason why an image has none."""
    network_matches: Sequence[list[NetworkMatches | None]] = field(default_factory=list)
    """Stored matches with references, by image and kind of features; empty if there are none."""

    def scaled(self, factor: float) -> "Query":
        """Return the query with the baselines of its rig multiplied by a factor."""
        return replace(self, rig_from_cams=_scaled_poses(self.rig_from_cams, factor))

    def part(self, images: Sequence[int]) -> "Query":
        """Return the query restricted to some of its images."""
        return replace(
            self,
            views=[self.views[index] for index in images],
            rig_from_cams=self.rig_from_cams[list(images)],
            features=[self.features[index] for index in images] if self.features else [],
            network_matches=[self.network_matches[index] for index in images] if self.network_matches else [],
        )


@dataclass(frozen=True)
class References:
    """The map images retrieved for one query image, best first."""

    images: Ints
    """(k,) indices of map images."""
    scores: Floats
    """(k,) similarities, larger is better."""

    @classmethod
    def of(cls, images: Sequence[int], scores: Sequence[float] | None = None) -> "References":
        """Return references from lists; without scores, all scores are 1."""
        return cls(np.array(images, np.int64), np.array(scores if scores is not None else [1.0] * len(images)))

    def take(self, part: slice | NDArray[np.bool_]) -> "References":
        """Return a subset."""
        return References(self.images[part], self.scores[part])


QueryInput = tuple[Query, Sequence[References]]
"""A query, and the references of each of its images."""


@dataclass(frozen=True)
class PoseEstimate:
    """The pose of one query, or why there is none."""

    status: str
    """`ok`, `low_confidence`, `low_confidence: <reason>?`, or `failed: <reason>`."""
    world_from_rig: Floats | None = None
    """(4, 4). For a single camera, the rig is the camera."""
    covariance: Floats | None = None
    """(6, 6) of a small motion of the rig in its own frame: rotation in radians, then translation in meters."""
    num_matches: int = 0
    """2D-3D matches found from descriptors alone."""
    num_inliers: int = 0
    """Those of `num_matches` within `ransac_max_error_deg` of the final pose."""
    num_guided: int = 0
    """Guided matches within `max_error_deg`, from which the final pose is computed."""
    rmse_px: float = float("nan")
    rival_support: float = 0.0
    """Support of the best clearly different pose (beyond 2.5 degrees or 0.25 m), divided by that of this pose; 0 if
    there is none. A guided match supports a pose by 1 - (error / `max_error_deg`)^2, at least 0."""
    rivals: tuple[Rival, ...] = ()
    """Clearly different poses that some matches support, best supported first."""
    coverage: float = 0.0
    """Share of grid cells with an inlier; each query image has 16 cells."""
    agreement: int = 0
    """Inliers of the second best kind of features; 0 if there is one kind."""
    p_correct: float = float("nan")
    """Probability that the pose is within 5 degrees and 0.5 m, see `confidence`; NaN if it is not from matches."""
    references: tuple[int, ...] = ()
    """Map images that support the pose."""
    correspondences: Correspondences = field(default_factory=Correspondences)
    """Inliers and outliers of the pose."""
    found_by: str = "pnp"
    """Method that found the pose: `pnp`; `pnp+feed_forward` or `pnp+near` (PnP from a prior); `lifted` (map features
    lifted by the capture's depth maps); `lifted+feed_forward` (also by predicted depth); `feed_forward` (a
    prediction); `nearest`; `sequence`."""
    scale_std: float = float("nan")
    """Relative standard deviation of the scale of a prediction; inf if unknown, NaN without a prediction."""
    rejected: tuple[int, ...] = ()
    """References whose predicted poses contradict those of the other references."""
    reason: str = ""
    """Intrinsics that fit the query better than the stated ones; for a prediction, what was left out or is unknown."""
    misfit: bool = False
    """Whether the matches contradict the intrinsics of the query, see `misfit`. More features cannot repair that. A
    small contradiction only widens the covariance."""
    focals_px: tuple[float, ...] = ()
    """Per query image, the focal length that fits, or NaN if the focal length is not the problem. Empty if the
    intrinsics are not contradicted."""
    centers_px: tuple[tuple[float, float], ...] = ()
    """Per query image, the principal point that fits, or NaN; as `focals_px`."""

    def scaled(self, factor: float) -> "PoseEstimate":
        """Return the estimate with all lengths multiplied by a factor."""
        pose, covariance, factors = self.world_from_rig, self.covariance, np.repeat([1.0, factor], 3)
        return replace(
            self,
            world_from_rig=None if pose is None else _scaled_poses(pose, factor),
            covariance=None if covariance is None else covariance * np.outer(factors, factors),
            correspondences=replace(self.correspondences, points=factor * self.correspondences.points),
            rivals=tuple(Rival(_scaled_poses(rival.world_from_rig, factor), rival.support) for rival in self.rivals),
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
    """An approximate pose of a query, with its uncertainty."""

    world_from_rig: Floats
    """(4, 4); world_from_cam for a single camera."""
    rotation_std_deg: float
    position_std_m: float


@dataclass(frozen=True)
class Prior:
    """A pose hypothesis that does not come from the matches of the query."""

    world_from_rig: Floats
    """(4, 4)"""
    images: Ints
    """Map images that are covisible with the query."""
    radius_deg: float
    """Search radius around the projection of a map point."""
    source: str
    """Origin of the prior: `feed_forward` or `near`."""

    @classmethod
    def about(
        cls, world_from_rig: Floats, images: Ints, rotation_std_deg: float, position_std_m: float, source: str
    ) -> "Prior":
        """Return a prior whose search radius covers two standard deviations, within `SEARCH_DEG`.

        `position_std_m` is in map lengths.
        """
        spread_deg = rotation_std_deg + np.degrees(np.arctan(position_std_m / NEARBY_M))
        return cls(world_from_rig, images, float(np.clip(2 * spread_deg, *SEARCH_DEG)), source)

    def scaled(self, factor: float) -> "Prior":
        """Return the prior with all lengths multiplied by a factor."""
        return replace(self, world_from_rig=_scaled_poses(self.world_from_rig, factor))


class Localizer(Protocol):
    """Localizes queries in one map and leaves the map unchanged. `localize` is thread-safe."""

    @property
    def image_names(self) -> list[str]:
        """Names of the map images; references and estimates hold indices into this list."""

    @property
    def batch_size(self) -> int:
        """Number of queries per call at which `predict` is efficient."""

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[Any]:
        """Return a network's prediction for each query, or None for each if the method uses no network.

        Not thread-safe.

        Args:
            queries: queries with the references of their images.
            following: the queries of the next call; their images are decoded while the network runs.

        Raises:
            ToolkitError: a problem of all queries: the device does not exist, the weights are of another network, or
                the memory is too small.
        """

    def localize(
        self, query: Query, references: Sequence[References], prediction: Any = None, priors: Sequence[Prior] = ()
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera.

        Args:
            query: the images of one device at one instant.
            references: the references of each image.
            prediction: the result of `predict` for this query; None calls `predict` here if it is needed.
            priors: pose hypotheses to test; methods without matching ignore them.
        """


class WithoutNetwork:
    """The part of a `Localizer` that is the same for all methods without a network."""

    batch_size = 1

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[None]:
        """Return None for each query: this method needs no prediction."""
        return [None] * len(queries)


class ScaledLocalizer:
    """Localizes in a map whose unit of length is not the meter that the limits of the inner localizer assume."""

    def __init__(self, inner: Localizer, length: float) -> None:
        """
        Args:
            inner: localizer of the map with all lengths divided by `length`.
            length: see `Survey.length`.
        """
        self.inner, self._length = inner, length
        self.image_names, self.batch_size = inner.image_names, inner.batch_size

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[Any]:
        """Return a prediction for each query, in the unit of the inner localizer; see `Localizer`."""
        return self.inner.predict(self._scaled(queries), self._scaled(following))

    def _scaled(self, queries: Sequence[QueryInput]) -> list[QueryInput]:
        return [(query.scaled(1 / self._length), references) for query, references in queries]

    def localize(
        self, query: Query, references: Sequence[References], prediction: Any = None, priors: Sequence[Prior] = ()
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; see `Localizer`."""
        scaled_priors = [prior.scaled(1 / self._length) for prior in priors]
        estimate = self.inner.localize(query.scaled(1 / self._length), references, prediction, scaled_priors)
        return estimate.scaled(self._length)


def _scaled_poses(poses: Floats, factor: float) -> Floats:
    """Return poses (..., 4, 4) with their translations multiplied by a factor."""
    return geometry.make_pose(poses[..., :3, :3], factor * poses[..., :3, 3])


def stds_of(covariances: Floats) -> tuple[Floats, Floats]:
    """Return rotation standard deviations (...) in degrees and position ones (...) in meters, from (..., 6, 6).

    Each is the root of a trace, that is, the root mean square length of the error vector.
    """
    rotation, position = (np.trace(covariances[..., s, s], axis1=-2, axis2=-1) for s in (slice(3), slice(3, 6)))
    return np.degrees(np.sqrt(rotation)), np.sqrt(position)


def carried_over(covariance: Floats, a_from_b: Floats) -> Floats:
    """Convert the covariance (6, 6) of a pose from motions in frame b to motions in frame a; b is mounted on a."""
    R, (x, y, z) = a_from_b[:3, :3], a_from_b[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    adjoint = np.block([[R, np.zeros((3, 3))], [cross @ R, R]])
    return np.asarray(adjoint @ covariance @ adjoint.T)


def rank(status: str) -> int:
    """Return 2 for `ok`, 1 for `low_confidence`, 0 without a pose."""
    return {"ok": 2, "low_confidence": 1}.get(status.split(":")[0], 0)


def agree(world_from_rig: Floats | None, other: Floats | None, share: float = 1.0) -> bool:
    """Tell whether two poses are close enough to confirm each other: within `share` of `CONFIRMED`."""
    if world_from_rig is None or other is None:
        return False
    rotation_deg, distance_m = geometry.pose_error(world_from_rig, other)
    return bool(rotation_deg <= share * CONFIRMED[0] and distance_m <= share * CONFIRMED[1])
