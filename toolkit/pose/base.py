"""The interface of all localizers: a query and its references go in, its pose comes out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture.cameras import camera_text
from toolkit.capture.images import pixels_of, stored_size, thumbnails
from toolkit.errors import CameraError
from toolkit.features.features import KINDS, LocalFeatures, extract_turned, usable
from toolkit.features.matching import AnyMethod, PairMatches
from toolkit.geometry import Floats, Ints
from toolkit.pose.result import QueryResult, Status

SEARCH_DEG = (1.0, 6.0)
"""Smallest and largest radius of the search for keypoints around the projections of a prior pose, degrees."""
NEARBY_M = 3.0
"""Assumed depth of the scene, in map lengths (see `Survey.length`), to turn the uncertainty of a position into an
angle."""
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
    mask: Path | None = None
    """File that is black where to extract no features, of the image's size; None: no mask."""
    _decoded: dict[tuple[bool, int | None], NDArray[np.uint8]] = field(default_factory=dict, repr=False, compare=False)

    def read(self, color: bool, least_side: int | None = None) -> NDArray[np.uint8]:
        """Return the pixels in color, (H, W, 3), or gray, (H, W), decoded once; see `capture.images.read_image`.

        Raises:
            ImageError: the image cannot be read.
            CameraError: the image has another size than its camera.
        """
        if (color, least_side) not in self._decoded:
            pixels = pixels_of(self.image, not color, least_side)
            width, height = stored_size(self.image) if isinstance(self.image, Path) else pixels.shape[1::-1]
            if (self.camera.width, self.camera.height) != (width, height):
                raise CameraError(
                    f"The image is {width} x {height} pixels, its camera {self.camera.width} x "
                    f"{self.camera.height}. Give the intrinsics of the image as it is stored."
                )
            self._decoded[color, least_side] = pixels
        return self._decoded[color, least_side]

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
