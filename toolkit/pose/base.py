"""A query and its references go into all localizers, its result comes out: status and reason, pose, evidence,
references, and correspondences. In between, the query's cameras compute poses, projections and errors of its matches.
"""

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from html import escape
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
import poselib
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit import geometry
from toolkit.capture.images import (
    camera_text,
    pixels_of,
    projection_jacobian,
    stored_size,
    thumbnails,
    view_bounds,
)
from toolkit.errors import INTERNAL, ArtifactError, CameraError
from toolkit.features.features import (
    KINDS,
    LocalFeatures,
    PairMatches,
    Shorten,
    extract_turned,
    unit_descriptors,
    usable,
)
from toolkit.features.matching import AnyMethod
from toolkit.geometry import Floats, Ints

CAMERA = "camera?"
"""Reason of a pose whose matches contradict the intrinsics of the query."""
NOISE = "noise of the map's poses"
"""Reason of a pose that would be `ok` if the poses of the map were exact."""
AGREEMENT = (5.0, 0.5)  # degrees, meters: two poses within both confirm each other
_NAMES = ("images", "references", "rejected")
_STORED: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "camera": (np.int32, ()),
    "pixels": (np.float32, (2,)),
    "points": (np.float64, (3,)),
    "point_index": (np.int32, ()),
    "agrees": (np.bool_, ()),
    "view_of": (np.int32, ()),
    "view_reference": (np.int32, ()),
    "view_pixels": (np.float32, (2,)),
}
"""Types of the arrays of `Correspondences` in a file, and shapes of their entries. float32 makes the file smaller and
keeps pixels of any image exact to a hundredth."""
_NUMBERS = {
    "num_inliers": 0, "num_matches": 0, "inlier_ratio": 4, "num_guided": 0, "rmse_px": 4, "rival_support": 4,
    "coverage": 4, "agreement": 0, "p_correct": 4, "position_std": 6, "rotation_std_deg": 6, "seconds": 4,
    "scale_std": 6,
}  # fmt: skip
"""Numbers in the table, and the decimals that they are rounded to."""
_FROM_OTHERS = ("inlier_ratio", "position_std", "rotation_std_deg")
"""Numbers that follow from other attributes."""
SEARCH_DEG = (1.0, 6.0)
"""Smallest and largest radius of the search for keypoints around the projections of a prior pose, degrees."""
NEARBY_M = 3.0
"""Assumed depth of the scene, in map lengths (see `LocalMap.length`), to turn the uncertainty of a position into an
angle."""
MAX_STATUS = 70
"""Letters of a status that tables and titles show; the tables of the poses have all of it."""
NetworkMatches = Callable[[str], PairMatches]
"""Returns the known network matches between a query image and the map image of a given name; else raises KeyError."""

# Of the poses of a rig
RANSAC_CONFIDENCE = 0.999
MAX_RANSAC_TRIALS = 5000
"""Largest number of RANSAC samples."""
MAX_RANSAC_MATCHES = 2500
"""Largest number of matches given to RANSAC, chosen at random; guided matching finds the others again."""
LOSS_PX = 1.0
"""Scale of the loss of a refinement from a rough pose, pixels."""
LOSS_SHARE = 0.6
"""Scale from a close pose, as a share of the median error. Errors of points and keypoints have heavy tails: with 1 px,
the position errors of the captures in docs/results.md are 4 % larger. With a smaller share, poses are clearly worse
where errors are Gaussian, and the covariance, which is that of plain least squares, is too small for them."""
MIN_LOSS_PX = 0.05
"""Smallest scale, pixels: exact matches have no error."""
STEP = 1e-8
"""Length of the step, meters and radians, after which a refinement ends. With 1e-6, 1.7 micrometers are left."""
CELLS = 4
"""Columns and rows of the cells of an image."""
POSELIB_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
"""COLMAP's names of the camera models that PoseLib 2.0.5 can refine with. With others it returns the pose unchanged."""
# PoseLib's solver for rigs uses the random generator of the C library, which all threads share. So that equal seeds
# give equal poses, it is seeded before each call, and only one call runs at a time. Other libraries (ZeroMQ in a
# notebook) may still draw from it and change the last digits: so the pose is rounded before it is refined.
_RIG_RANSAC = Lock()
_DECIMALS = 9


class Status(StrEnum):
    """Whether a query has a pose that can be relied on."""

    OK = "ok"
    LOW_CONFIDENCE = "low_confidence"
    FAILED = "failed"

    @classmethod
    def parse(cls, text: str) -> "tuple[Status, str]":
        """Return status and reason from a text such as `failed: too few matches`, column `status` of the tables."""
        status, _, reason = text.partition(": ")
        return cls(status), reason

    def text(self, reason: str) -> str:
        """Return status and reason as the text that `parse` reads."""
        return f"{self}: {reason}" if reason else str(self)

    @property
    def rank(self) -> int:
        """2 for `ok`, 1 for `low_confidence`, 0 without a pose."""
        return 2 - list(Status).index(self)


def statuses(texts: pd.Series) -> pd.Series:
    """Return the column `status` of a file without the reasons: values of `Status`."""
    return texts.astype(object).fillna("").astype(str).str.split(":", n=1).str[0]


def split_status(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table of a file: `status` is the value of `Status` alone, `status_text` is what the file says."""
    return table.assign(status=statuses(table["status"]), status_text=table["status"])


def short_status(text: str) -> str:
    """Return a status for a table or title: the details in parentheses, such as paths, are left out if it is long."""
    text = text if len(text) <= MAX_STATUS else re.sub(r" \(.*", "", text, flags=re.S)
    return textwrap.shorten(text, MAX_STATUS, placeholder=" …")


def status_counts(statuses: pd.Series) -> dict[str, int]:
    """Return how many rows of a table have each status."""
    return {str(status): int((statuses == status).sum()) for status in Status}


class Rival(NamedTuple):
    """A pose that clearly differs from the estimate but is supported by matches too."""

    world_from_rig: Floats
    """(4, 4)"""
    support: float
    """Support by its guided matches, divided by that of the estimate, see `QueryResult.rival_support`."""


@dataclass(frozen=True)
class Correspondences:
    """K correspondences between a query device and the map, and M observations of their points in the references."""

    camera: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K,) index of the query image."""
    pixels: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """(K, 2) in the query image; the center of the top-left pixel is (0.5, 0.5)."""
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(K, 3) in the world, meters."""
    point_index: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K,) index of the map point, counted through all maps in order; -1 for a point lifted by depth."""
    agrees: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(K,) whether it agrees with the pose: guided, or within `max_error_deg`. `num_inliers` is another number."""
    found_by: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, "U1"))
    """(K,) `<kind of features>/<descriptors, guided or lifted>`."""
    view_of: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(M,) index of the correspondence whose point is observed."""
    view_reference: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(M,) index of the reference that observes it."""
    view_pixels: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """(M, 2) pixel of the observation in the reference."""

    def __len__(self) -> int:
        return len(self.camera)


@dataclass(frozen=True, repr=False)
class QueryResult:
    """How one query was localized: its pose and how far to trust it, or why it has none."""

    status: Status
    reason: str = ""
    """Why it is not `ok`, in few words; empty for a pose with too little support."""
    world_from_rig: Floats | None = None
    """(4, 4). For a single camera, the rig is the camera."""
    covariance: Floats | None = None
    """(6, 6) of a small motion of the rig in its own frame: rotation in radians, then translation in meters."""
    num_matches: int = 0
    """2D-3D matches found from descriptors alone."""
    num_inliers: int = 0
    """Inliers: those of `num_matches` within `ransac_max_error_deg` of the final pose. Those that share a point or a
    keypoint count once."""
    num_guided: int = 0
    """Guided matches within `max_error_deg`, from which the final pose is computed."""
    rmse_px: float = float("nan")
    rival_support: float = 0.0
    """Support of the best clearly different pose (beyond 2.5 degrees or 0.25 m), divided by that of this pose; 0 if
    there is none. A guided match supports a pose by 1 - (error / `max_error_deg`)^2, at least 0. Of all matches and
    each kind of features with a quarter of the support, the largest ratio counts."""
    rivals: tuple[Rival, ...] = ()
    """Clearly different poses that some matches support, best supported first."""
    coverage: float = 0.0
    """Share of grid cells with an inlier; each query image has 16 cells."""
    agreement: int = 0
    """Inliers of the second best kind of features; 0 if there is one kind."""
    p_correct: float = float("nan")
    """Probability that the pose is within 5 degrees and 0.5 m, see `pose.pnp`; NaN if it is not from matches."""
    images: tuple[str, ...] = ()
    """Names of the C query images."""
    references: tuple[str, ...] = ()
    """Names of the map images that support the pose, best first."""
    correspondences: Correspondences = field(default_factory=Correspondences)
    """Matches that agree with the pose, and those that do not."""
    found_by: str = "pnp"
    """Method that found the pose: `pnp`; `pnp+feed_forward` or `pnp+near` (PnP from a prior); `lifted` (map features
    lifted by the capture's depth maps); `lifted+feed_forward` (also by predicted depth); `feed_forward` (a
    prediction); `nearest`; `sequence`."""
    scale_std: float = float("nan")
    """Relative standard deviation of the scale of a prediction; inf if unknown, NaN without a prediction."""
    rejected: tuple[str, ...] = ()
    """Names of references whose predicted poses contradict those of the other references."""
    remark: str = ""
    """Intrinsics that fit the query better than the stated ones; images that cannot be read; for a prediction, what was
    left out or is unknown. Column `reason` of the table."""
    camera_contradicted: bool = False
    """Whether the matches contradict the query's intrinsics, see `map_matching.check_intrinsics`. No other features
    repair that. A small contradiction only widens the covariance."""
    focals_px: tuple[float, ...] = ()
    """Per query image, the focal length that fits, or NaN if the focal length is not the problem. Empty if the
    intrinsics are not contradicted."""
    centers_px: tuple[tuple[float, float], ...] = ()
    """Per query image, the principal point that fits, or NaN; as `focals_px`."""
    seconds: float = float("nan")
    """Time that it took."""
    first_status: str | None = None
    """If fallback features were used: status and reason from the other features alone."""
    first_seconds: float | None = None
    """Time that the pose from the other features took."""
    context: Any = field(default=None, repr=False, compare=False)
    """The query in its map, `scene.map.Located`; None for a result that a `Map` or `Run` did not return."""

    def show(self) -> Any:
        """Return status and reason in words, numbers, matches, references and positions; a notebook shows a figure.

        Raises:
            ArtifactError: the result is not of a `Map` or `Run`.
        """
        return self._in_map.answer(self)

    def show_3d(self, *others: "QueryResult", rays: bool = False) -> Any:
        """Return this result and others in the map in 3D: cameras, uncertainty, rivals, references and map points.

        In a live notebook, it is shown by the rerun viewer; a saved notebook keeps a picture.

        Args:
            others: further results in the same map.
            rays: draw a ray from the camera through each match that agrees to its map point.

        Raises:
            ArtifactError: the result is not of a `Map` or `Run`.
        """
        return self._in_map.show_3d([self, *others], rays)

    def what_if(self, changes: Mapping[str, Any] | None = None, **more: Any) -> Any:
        """Localize the query again with something changed; see `scene.query.what_if`."""
        return self._in_map.what_if(self, changes or {}, **more)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle the result without its map."""
        return {**self.__dict__, "context": None}

    @property
    def _in_map(self) -> Any:
        if self.context is None:
            raise ArtifactError("This result belongs to no map. To get one that does: Map.locate, or Run.result.")
        return self.context

    def _repr_html_(self) -> str:
        return f"<p>{escape(self.status_text)}</p>" if self.context is None else str(self.context.answer(self).html)

    @classmethod
    def failed(cls, reason: str, **known: Any) -> Self:
        """Return a result without a pose."""
        return cls(Status.FAILED, reason, **known)

    @property
    def status_text(self) -> str:
        """Status and reason, column `status` of the table: `failed: too few matches`."""
        return self.status.text(self.reason)

    @property
    def position_std(self) -> float:
        """In the unit of the poses: meters, if it is known."""
        return float("nan") if self.covariance is None else float(stds_of(self.covariance)[1])

    @property
    def rotation_std_deg(self) -> float:
        return float("nan") if self.covariance is None else float(stds_of(self.covariance)[0])

    @property
    def inlier_ratio(self) -> float:
        return self.num_inliers / self.num_matches if self.num_matches else 0.0

    @property
    def is_internal(self) -> bool:
        """Whether an error of the toolkit, not of the data, is the reason. Such a query is tried again."""
        return INTERNAL in self.reason or INTERNAL in self.remark

    def __repr__(self) -> str:
        if self.world_from_rig is None:
            return f"QueryResult({self.status_text})"
        position = ", ".join(f"{x:.3f}" for x in self.world_from_rig[:3, 3])
        return f"QueryResult({self.status_text}, at ({position}), {self.num_inliers} inliers, {self.found_by})"

    def scaled(self, factor: float) -> Self:
        """Return the result with all lengths multiplied by a factor."""
        pose, covariance, factors = self.world_from_rig, self.covariance, np.repeat([1.0, factor], 3)
        return replace(
            self,
            world_from_rig=None if pose is None else geometry.scaled(pose, factor),
            covariance=None if covariance is None else covariance * np.outer(factors, factors),
            correspondences=replace(self.correspondences, points=factor * self.correspondences.points),
            rivals=tuple(Rival(geometry.scaled(rival.world_from_rig, factor), rival.support) for rival in self.rivals),
        )

    def to_row(self, timestamp: int, device_id: str) -> dict[str, Any]:
        """Return the row of the query in `poses/<pair>.csv`, without its column `image`."""
        focals = self.focals_px if np.isfinite(self.focals_px).any() else ()
        centers = self.centers_px if np.isfinite(self.centers_px).any() else ()
        numbers = {name: round(getattr(self, name), digits) for name, digits in _NUMBERS.items()}
        return {
            "timestamp": timestamp,
            "device_id": device_id,
            "status": self.status_text,
            "method": self.found_by,
            **numbers,
            "references": ";".join(self.references),
            "rejected": ";".join(self.rejected),
            "focal_px": ";".join("" if np.isnan(focal) else f"{focal:.1f}" for focal in focals),
            "principal_point_px": ";".join("" if np.isnan(x) else f"{x:.1f} {y:.1f}" for x, y in centers),
            "reason": self.remark,
            "first_status": self.first_status,
            "first_seconds": self.first_seconds,
        }

    @classmethod
    def from_row(cls, row: Mapping[str, Any], arrays: Mapping[str, Any] | None = None) -> Self:
        """Return the result of a row of `to_row` or `PairResults.table`, which may lack columns or values, and of its
        `arrays`; None: without a pose, names and correspondences.

        Raises:
            ValueError, KeyError: an array has another shape or is missing.
        """
        known = {name: value for name, value in row.items() if not pd.isna(value) and value != ""}
        status, reason = Status.parse(str(known.get("status_text", known["status"])))
        kinds = {name: type(getattr(cls, name)) for name in _NUMBERS if name not in _FROM_OTHERS}
        fitting = ("focal_px", "principal_point_px")
        focals, centers = (str(known[key]).split(";") if key in known else [] for key in fitting)
        return cls(
            status,
            reason,
            found_by=str(known.get("method", "")),
            remark=str(known.get("reason", "")),
            first_status=known.get("first_status"),
            first_seconds=known.get("first_seconds"),
            focals_px=tuple(float(focal or "nan") for focal in focals),
            centers_px=tuple((float(x), float(y)) for x, y in ((xy or "nan nan").split() for xy in centers)),
            **{name: kind(known[name]) for name, kind in kinds.items() if name in known},
            **({} if arrays is None else _of_arrays(arrays)),
        )

    def arrays(self) -> dict[str, Any]:
        """Return pose, correspondences, rivals and names as arrays by name; texts as objects; see `from_row`."""
        found = self.correspondences
        arrays: dict[str, Any] = {key: getattr(found, key).astype(dtype) for key, (dtype, _) in _STORED.items()}
        labels, codes = np.unique(found.found_by, return_inverse=True)
        arrays |= {"found_by": codes.astype(np.uint8), "found_by_labels": labels.astype(object)}
        arrays["world_from_rig"] = np.full((4, 4), np.nan) if self.world_from_rig is None else self.world_from_rig
        arrays["covariance"] = np.full((6, 6), np.nan) if self.covariance is None else self.covariance
        arrays["misfit"] = np.array(self.camera_contradicted)
        arrays["rivals"] = np.array([rival.world_from_rig for rival in self.rivals]).reshape(-1, 4, 4)
        arrays["rival_supports"] = np.array([rival.support for rival in self.rivals], np.float64)
        return arrays | {name: np.array(getattr(self, name), object) for name in _NAMES}


def _of_arrays(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a result in its arrays."""
    wide = {"f": np.float64, "i": np.int64, "b": np.bool_}
    labels = np.array([_text(label) for label in arrays["found_by_labels"]], np.str_)
    found_by = labels[arrays["found_by"].astype(np.int64)] if len(labels) else np.zeros(0, "U1")
    read = {key: arrays[key].astype(wide[arrays[key].dtype.kind]) for key in _STORED}
    for key, array in (read | {"found_by": found_by}).items():
        count = len(read["view_of" if key.startswith("view_") else "camera"])
        if array.shape != (count, *(_STORED[key][1] if key in _STORED else ())):
            raise ValueError(f"{key} has the shape {array.shape}")
    return {name: tuple(_text(text) for text in arrays[name]) for name in _NAMES} | {
        **{name: None if np.isnan(arrays[name]).all() else arrays[name] for name in ("world_from_rig", "covariance")},
        "correspondences": Correspondences(**read, found_by=found_by),
        "rivals": tuple(map(Rival, arrays["rivals"].reshape(-1, 4, 4), arrays["rival_supports"].tolist())),
        "camera_contradicted": bool(arrays["misfit"]),
    }


def _text(text: Any) -> str:
    return text.decode() if isinstance(text, bytes) else str(text)


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


def agree(world_from_rig: Floats | None, other: Floats | None, share: float = 1.0) -> bool:
    """Tell whether two poses are close enough to confirm each other: within `share` of `AGREEMENT`."""
    if world_from_rig is None or other is None:
        return False
    rotation_deg, distance_m = geometry.pose_error(world_from_rig, other)
    return bool(rotation_deg <= share * AGREEMENT[0] and distance_m <= share * AGREEMENT[1])


# Queries and localizers


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
    mask: Path | None = None
    """File that is black where to extract no features, of the image's size; None: no mask."""
    _decoded: dict[tuple[bool, int | None], NDArray[np.uint8]] = field(default_factory=dict, repr=False, compare=False)

    def read(self, color: bool, min_side: int | None = None) -> NDArray[np.uint8]:
        """Return the pixels in color, (H, W, 3), or gray, (H, W), decoded once; see `capture.images.read_image`.

        Raises:
            ImageError: the image cannot be read.
            CameraError: the image has another size than its camera.
        """
        if (color, min_side) not in self._decoded:
            pixels = pixels_of(self.image, not color, min_side)
            width, height = pixels.shape[1::-1]
            if min_side is not None and isinstance(self.image, Path):  # perhaps decoded at a smaller size
                width, height = stored_size(self.image)
            if (self.camera.width, self.camera.height) != (width, height):
                sizes = f"{width} x {height} pixels, its camera {self.camera.width} x {self.camera.height}"
                raise CameraError(f"The image is {sizes}. Give the intrinsics of the image as it is stored.")
            self._decoded[color, min_side] = pixels
        return self._decoded[color, min_side]

    def extract(self, method: AnyMethod) -> LocalFeatures:
        """Return the local features of one kind; see `read` and `usable` for the errors."""
        turns = self.turns if KINDS[method.name].upright else 0
        (features,) = extract_turned(method.extractor, [self.read(method.extractor.color)], [turns])
        return usable(features, self.mask, self.camera)


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
    descriptors: Sequence[NDArray[np.float32]] = ()
    """Global descriptors (C, D) of the images, by embedder of the map; empty if none were computed."""

    def _repr_html_(self) -> str:
        rows = "".join(f"<li>{escape(view.name)}: {escape(camera_text(view.camera))}</li>" for view in self.views)
        return f"{thumbnails((view.image for view in self.views), 240)}<ul>{rows}</ul>"

    def scaled(self, factor: float) -> "Query":
        """Return the query with the baselines of its rig multiplied by a factor."""
        return replace(self, rig_from_cams=geometry.scaled(self.rig_from_cams, factor))


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
class RoughPose:
    """An approximate pose of a query, with its uncertainty."""

    world_from_rig: Floats
    """(4, 4); world_from_cam for a single camera."""
    rotation_std_deg: float
    position_std: float
    """In the unit of the map's poses."""


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
        cls, world_from_rig: Floats, images: Ints, rotation_std_deg: float, position_std: float, source: str
    ) -> "Prior":
        """Return a prior whose search radius covers two standard deviations, within `SEARCH_DEG`.

        `position_std` is in map lengths.
        """
        spread_deg = rotation_std_deg + np.degrees(np.arctan(position_std / NEARBY_M))
        return cls(world_from_rig, images, float(np.clip(2 * spread_deg, *SEARCH_DEG)), source)

    def scaled(self, factor: float) -> "Prior":
        """Return the prior with all lengths multiplied by a factor."""
        return replace(self, world_from_rig=geometry.scaled(self.world_from_rig, factor))


@dataclass(frozen=True)
class QueryMatches:
    """A query with its references, from which a `Localizer` solves its pose; its subclasses hold matches."""

    query: Query
    references: Sequence[References]
    """Of each image of the query."""


class Localizer:
    """Localizes queries in one map and leaves the map unchanged. `match`, `solve` and `localize` are thread-safe."""

    batch_size = 1
    """Number of queries per call at which `predict` is efficient."""
    image_names: list[str]
    """Names of the map images; references hold indices into this list."""

    def predict(self, queries: Sequence[QueryInput]) -> list[Any]:
        """Return a network's prediction for each query, or None for each if the method uses no network.

        Not thread-safe. Raise ToolkitError for a problem of all queries: the device does not exist, the weights are of
        another network, or the memory is too small.
        """
        return [None] * len(queries)

    def match(self, query: Query, references: Sequence[References]) -> QueryMatches:
        """Return the matches of a query with its references; they are computed when they are needed."""
        return QueryMatches(query, references)

    def solve(self, matches: Any, prediction: Any = None, priors: Sequence[Prior] = ()) -> QueryResult:
        """Return one pose for the cameras of a rig, or for a single camera.

        Args:
            matches: what `match` returned.
            prediction: the result of `predict` for this query; None calls `predict` here if it is needed.
            priors: pose hypotheses to test; methods without matching ignore them.
        """
        raise NotImplementedError

    def localize(
        self, query: Query, references: Sequence[References], prediction: Any = None, priors: Sequence[Prior] = ()
    ) -> QueryResult:
        """Match and solve a query."""
        return self.solve(self.match(query, references), prediction, priors)


class NearestLocalizer(Localizer):
    """The simplest method, for comparison: the image with the best score gets the pose of its best reference."""

    def __init__(self, image_names: list[str], world_from_cams: Floats) -> None:
        """`world_from_cams` (N, 4, 4) are the poses of the N map images."""
        self.image_names = image_names
        self.world_from_cams = world_from_cams

    def solve(self, matches: QueryMatches, prediction: None = None, priors: Sequence[Prior] = ()) -> QueryResult:
        """Return the pose of the best reference, never `ok`; see `Localizer`."""
        query, references = matches.query, matches.references
        scores = [(float(best.scores[0]), camera) for camera, best in enumerate(references) if len(best.images)]
        if not scores:
            return QueryResult.failed("no references")
        camera = max(scores)[1]
        reference = int(references[camera].images[0])
        world_from_rig = self.world_from_cams[reference] @ geometry.invert(query.rig_from_cams[camera])
        names = (self.image_names[reference],)
        return QueryResult(Status.LOW_CONFIDENCE, "", world_from_rig, references=names, found_by="nearest")


# The cameras of a query, and their matches with map points


@dataclass(frozen=True)
class Matches:
    """K matches of query keypoints with map points."""

    camera: Ints
    """(K,) index of the query image."""
    pixels: Floats
    """(K, 2) keypoints in that image."""
    point: Ints
    """(K,) index of the map point."""

    @classmethod
    def pooled(cls, parts: "Sequence[Matches]") -> "Matches":
        """Return the matches of all parts, in order."""
        return cls(
            np.concatenate([np.zeros(0, np.int64), *(part.camera for part in parts)]),
            np.concatenate([np.zeros((0, 2)), *(part.pixels for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.point for part in parts)]),
        )

    def rows(self) -> NDArray[np.void]:
        """Return the matches (K,) as values that can be tested for equality."""
        rows = np.ascontiguousarray(np.column_stack([self.camera, self.point, self.pixels]))
        return rows.view([("", rows.dtype)] * rows.shape[1])[:, 0]

    def __len__(self) -> int:
        return len(self.point)

    def __getitem__(self, part: NDArray[np.bool_] | Ints) -> "Matches":
        return Matches(self.camera[part], self.pixels[part], self.point[part])


def cells_of(camera: Ints, pixels: Floats, cameras: Sequence[pycolmap.Camera], along: int = CELLS) -> Ints:
    """Return the cells (K,) of pixels (K, 2) in the images of cameras, given by index (K,), as numbers; an image has
    `along` columns and rows of them.
    """
    sizes = np.array([(one.width, one.height) for one in cameras])
    column, row = np.clip(along * pixels / sizes[camera], 0, along - 1).astype(np.int64).T
    return np.asarray((camera * along + row) * along + column, np.int64)


class RigQuery:
    """The cameras of a query and their features; computes poses, projections and errors of matches.

    A single camera is a rig of one.
    """

    def __init__(self, cameras: list[pycolmap.Camera], rig_from_cams: Floats, features: list[list[LocalFeatures]]):
        self.cameras = cameras
        self.rig_from_cams = rig_from_cams
        self.features = features  # [camera][kind]
        self._cams_from_rig = [_poselib(pose) for pose in geometry.invert(rig_from_cams)]
        self.focals_px = np.array([camera.mean_focal_length() for camera in cameras])
        self.bounds = np.stack([view_bounds(camera) for camera in cameras])
        self._unit: dict[tuple[int, int], NDArray[np.float32]] = {}
        self.trees = [
            [KDTree(f.keypoints) if len(f) else KDTree(np.zeros((1, 2)) - 1e9) for f in kinds] for kinds in features
        ]

    def unit_descriptors(self, camera: int, kind: int, shorten: Shorten | None) -> NDArray[np.float32]:
        """Return the `unit_descriptors` (N, D) of an image's features of one kind; `shorten` belongs to the kind."""
        if (camera, kind) not in self._unit:
            self._unit[camera, kind] = unit_descriptors(self.features[camera][kind].descriptors, shorten)
        return self._unit[camera, kind]

    def num_cells(self, matches: Matches) -> int:
        """Return the number of cells, of all images, with a match."""
        return len(np.unique(self.cells(matches)))

    def cells(self, matches: Matches, along: int = CELLS) -> Ints:
        """Return the cells (K,) of matches, see `cells_of`."""
        return cells_of(matches.camera, matches.pixels, self.cameras, along)

    def pixels(self, camera: Ints, keypoint: Ints, kind: int) -> Floats:
        """Return the pixels (K, 2) of keypoints of one kind, given by camera (K,) and index (K,)."""
        pixels = np.zeros((len(camera), 2))
        for index, kinds in enumerate(self.features):
            pixels[camera == index] = kinds[kind].keypoints[keypoint[camera == index]]
        return pixels

    def ransac(
        self,
        matches: Matches,
        points: Floats,
        max_error_deg: float,
        seed: int,
        min_inliers: int = 0,
        max_trials: int = MAX_RANSAC_TRIALS,
    ) -> Floats | None:
        """Return the pose rig_from_world (4, 4) with the most inliers, by LO-RANSAC (PoseLib), or None.

        Errors are measured on the undistorted image plane at depth 1, times the mean focal length.

        Args:
            matches: K matches.
            points: (P, 3) the map points.
            max_error_deg: inlier threshold, as an angle.
            seed: of the random generators.
            min_inliers: RANSAC may miss poses with fewer inliers, which saves time.
            max_trials: largest number of samples.
        """
        if len(np.unique(matches.point)) < 4:
            return None
        if len(matches) > MAX_RANSAC_MATCHES:
            chosen = np.random.default_rng(seed).permutation(len(matches))[:MAX_RANSAC_MATCHES]
            min_inliers = min_inliers * MAX_RANSAC_MATCHES // len(matches)
            matches = matches[np.sort(chosen)]
        min_share = np.clip(min_inliers / len(matches), 1e-3, 0.99)
        trials = np.log(1 - RANSAC_CONFIDENCE) / np.log1p(-(min_share**3))  # to draw one sample of three inliers
        options = {
            "success_prob": RANSAC_CONFIDENCE,
            "dyn_num_trials_mult": 1.0,
            "min_iterations": 100,
            "max_iterations": int(np.clip(trials, 100, max_trials)),
            "seed": seed,
            "max_reproj_error": float(np.tan(np.radians(max_error_deg)) * self.focals_px.mean()),
        }
        origin = geometry.local_origin(points[matches.point])
        pixels, xyz, cameras = self._by_camera(matches, points, origin, undistort=True)
        if sum(map(len, xyz)) < 4:
            return None
        if len(self.cameras) == 1:
            pose, info = poselib.estimate_absolute_pose(pixels[0], xyz[0], cameras[0], options)
        else:
            with _RIG_RANSAC:
                pycolmap.set_random_seed(seed)  # seeds the C library, too
                pose, info = poselib.estimate_generalized_absolute_pose(
                    pixels, xyz, self._cams_from_rig, cameras, options
                )
        if info["num_inliers"] < 4 or not np.isfinite(pose.Rt).all():
            return None
        if len(self.cameras) == 1:
            return _from_world(self.rig_from_cams[0] @ _matrix(pose.Rt), origin)
        rotation = geometry.quaternion_to_rotation(np.round(pose.q, _DECIMALS))
        return _from_world(geometry.make_pose(rotation, np.round(pose.t, _DECIMALS - 3)), origin)

    def _by_camera(
        self, matches: Matches, points: Floats, origin: Floats, undistort: bool
    ) -> tuple[list[Floats], list[Floats], list[dict[str, Any]]]:
        """Return pixels (n, 2) and points (n, 3) of the matches of each camera, and the cameras, as PoseLib takes them.

        Args:
            origin: (3,) in the world, origin of the returned points.
            undistort: return pixels of pinhole cameras with the mean focal length of the rig, not of the actual lenses.
        """
        focal_px = float(self.focals_px.mean())
        pixels, xyz, cameras = [], [], []
        for index, camera in enumerate(self.cameras):
            part = matches.camera == index
            xy, in_world = matches.pixels[part], points[matches.point[part]] - origin
            model, params = camera.model.name, camera.params.tolist()
            if undistort or model not in POSELIB_MODELS:
                xy = focal_px * np.asarray(camera.cam_from_img(xy)).reshape(-1, 2)
                finite = np.isfinite(xy).all(axis=1)
                xy, in_world = xy[finite], in_world[finite]
                model, params = "SIMPLE_PINHOLE", [focal_px, 0.0, 0.0]
            pixels.append(xy)
            xyz.append(in_world)
            cameras.append({"model": model, "width": camera.width, "height": camera.height, "params": params})
        return pixels, xyz, cameras

    def refine(self, rig_from_world: Floats, matches: Matches, points: Floats, close: bool = False) -> Floats:
        """Return rig_from_world (4, 4) that minimizes the reprojection errors of matches, by PoseLib.

        The loss is Cauchy's. For camera models that PoseLib does not know, errors are measured as in `ransac`.

        Args:
            rig_from_world: the pose to start from, (4, 4).
            matches: K matches.
            points: (P, 3) the map points.
            close: whether that pose is refined already. The scale of the loss then follows the errors, up to `LOSS_PX`,
                if PoseLib knows the lenses.
        """
        scale_px = LOSS_PX
        if close and len(matches) > 6 and all(camera.model.name in POSELIB_MODELS for camera in self.cameras):
            median_px = np.median(self.errors_px(rig_from_world, matches, points))
            # A pose fits few matches too well (Rousseeuw and Leroy 1987, "Robust Regression", section 5.1).
            scale_px = float(np.clip(LOSS_SHARE * (1 + 5 / (len(matches) - 6)) * median_px, MIN_LOSS_PX, LOSS_PX))
        origin = geometry.local_origin(points[matches.point])
        pixels, xyz, cameras = self._by_camera(matches, points, origin, undistort=False)
        options = {"loss_type": "CAUCHY", "loss_scale": scale_px, "step_tol": STEP}
        refined, _ = poselib.refine_generalized_absolute_pose(
            pixels, xyz, _poselib(_from_world(rig_from_world, -origin)), self._cams_from_rig, cameras, options
        )
        return _from_world(_matrix(refined.Rt), origin)

    def projected(self, rig_from_world: Floats, matches: Matches, points: Floats) -> Floats:
        """Return the projections (K, 2) of the matched points in their images, pixels; inf behind a camera."""
        pixels = np.full((len(matches), 2), np.inf)
        for index, camera in enumerate(self.cameras):
            part = np.flatnonzero(matches.camera == index)
            if not len(part):
                continue
            cam_from_world = geometry.invert(self.rig_from_cams[index]) @ rig_from_world
            in_cam = geometry.transform(cam_from_world, points[matches.point[part]])
            projected = np.asarray(camera.img_from_cam(in_cam))
            seen = (in_cam[:, 2] > 1e-3) & np.isfinite(projected).all(axis=1)
            pixels[part] = np.where(seen[:, None], projected, np.inf)
        return pixels

    def errors_px(self, rig_from_world: Floats, matches: Matches, points: Floats) -> Floats:
        """Return the reprojection errors (K,) of matches with points (P, 3), pixels; inf behind a camera."""
        errors = self.projected(rig_from_world, matches, points) - matches.pixels
        return np.asarray(np.linalg.norm(errors, axis=1), np.float64)

    def errors_deg(self, rig_from_world: Floats, matches: Matches, points: Floats) -> Floats:
        """Return the reprojection errors (K,) as angles."""
        errors = self.errors_px(rig_from_world, matches, points)
        return np.degrees(np.arctan(errors / self.focals_px[matches.camera]))

    def jacobians(self, rig_from_world: Floats, matches: Matches, points: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of the projections of K matches, in pixels.

        Returns:
            The derivatives by a small motion d of the rig, (K, 2, 6): rotation (radians) and translation (meters) in
            the rig's frame, world_from_rig @ Exp(d), as in the benchmark's covariances; and by a motion of the point in
            the world, (K, 2, 3).
        """
        of_pose, of_point = np.zeros((len(matches), 2, 6)), np.zeros((len(matches), 2, 3))
        for index in np.unique(matches.camera):
            part = matches.camera == index
            cam_from_rig = geometry.invert(self.rig_from_cams[index])
            in_rig = geometry.transform(rig_from_world, points[matches.point[part]])
            in_cam = geometry.transform(cam_from_rig, in_rig)
            # A motion d of the rig moves a point in its frame by -(rotation x point) - translation.
            x, y, z = in_rig.T
            zero = np.zeros_like(x)
            skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
            moved = np.concatenate([skew, np.broadcast_to(-np.eye(3), skew.shape)], axis=2)
            projection = projection_jacobian(in_cam, np.full(len(in_cam), self.focals_px[index]))
            of_pose[part] = projection @ (cam_from_rig[:3, :3] @ moved)
            of_point[part] = projection @ (cam_from_rig[:3, :3] @ rig_from_world[:3, :3])
        return of_pose, of_point


def _from_world(rig_from_local: Floats, origin: Floats) -> Floats:
    """Return rig_from_world (4, 4), given a pose in a frame whose origin (3,) is in the world; zero: the same frame."""
    if not origin.any():
        return np.asarray(rig_from_local, np.float64)
    return geometry.shifted(rig_from_local, -rig_from_local[:3, :3] @ origin)


def _poselib(pose: Floats) -> poselib.CameraPose:
    converted = poselib.CameraPose()
    converted.Rt = pose[:3]
    return converted


def _matrix(pose: Floats) -> Floats:
    """Return a pose (3, 4) as (4, 4)."""
    return np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
