"""Match the images of a query with the points of a map: by descriptors alone, and near where a pose puts them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit import geometry
from toolkit.capture.cameras import in_view
from toolkit.features.features import KINDS, FeatureKind, LocalFeatures
from toolkit.features.matching import Matcher, MutualMatcher, unit_descriptors
from toolkit.geometry import Floats, Ints
from toolkit.localizers.base import NetworkMatches, References
from toolkit.localizers.local_map import LocalMap
from toolkit.localizers.rig import Matches, RigQuery
from toolkit.manifest import PnpSettings

CACHED_IMAGES = 256
"""Map images whose features are kept in memory."""


KnownMatches = dict[tuple[int, int, int], tuple[Ints, Ints]]
"""By query image, kind of features and map image: keypoints of the query and map points, each (K,)."""


@dataclass(frozen=True)
class MapImage:
    """The features of a map image that see a point, longest tracks first."""

    features: LocalFeatures
    points: Ints
    """(N,) the map point that each sees."""


class MappedFeatures:
    """One kind of local features of a map. Safe to use from several threads; the map is never changed."""

    def __init__(
        self,
        local_map: LocalMap,
        features: Mapping[str, LocalFeatures],
        kind: FeatureKind = KINDS["sift"],
        matcher: Matcher | None = None,
        name: str = "sift",
    ):
        """The map was triangulated from these features, by image name; without a matcher, `mutual` suits the kind."""
        self.map = local_map
        self.features = features
        self.kind = kind
        self.matcher = matcher or MutualMatcher(kind.ratio, kind.min_score)
        self.name = name
        self.image = lru_cache(CACHED_IMAGES)(self._image)
        """Returns what `_image` does, and keeps it for those that ask again."""
        self.keypoints = lru_cache(CACHED_IMAGES)(self._keypoints)
        """Returns what `_keypoints` does, and keeps it for those that ask again."""
        self._network = Lock()

    def match(
        self,
        query: LocalFeatures,
        references: Sequence[int],
        settings: PnpSettings,
        network_matches: NetworkMatches | None = None,
    ) -> list[tuple[Ints, Ints]]:
        """Match a query image with references; returns for each keypoints of the query and map points, each (K,).

        Args:
            references: indices of this map's images.
            settings: how many features `mutual` is given.
            network_matches: matches that a network made before.
        """
        if isinstance(self.matcher, MutualMatcher):
            query = query.take(slice(settings.max_query_features))
            images = [self.image(index, settings.max_map_features) for index in references]
            pairs = self.matcher.match([(query, image.features) for image in images])
            points = [image.points for image in images]
        else:  # a network looks at a feature among its neighbors, those without a point too
            names = [self.map.image_names[index] for index in references]
            if network_matches is not None:
                pairs = [network_matches(name) for name in names]
            else:
                with self._network:
                    pairs = self.matcher.match([(query, self.features[name]) for name in names])
            points = [self._point_of_each_feature(index) for index in references]
        found = []
        for pair, of_feature in zip(pairs, points, strict=True):
            keypoint, point = pair.indices[:, 0], of_feature[pair.indices[:, 1]]
            found.append((keypoint[point >= 0], point[point >= 0]))
        return found

    def _image(self, index: int, max_features: int) -> MapImage:
        """Return the features of a map image that see points, those of the longest tracks."""
        keypoint, point = self.map.observations(index)
        order = np.argsort(-self.map.track_lengths(point), kind="stable")[:max_features]
        return MapImage(self.features[self.map.image_names[index]].take(keypoint[order]), point[order])

    def _keypoints(self, index: int) -> NDArray[np.float32]:
        """Return where the features of a map image are, (N, 2) pixels."""
        return self.features[self.map.image_names[index]].keypoints

    def _point_of_each_feature(self, index: int) -> Ints:
        """Return the point that each feature of a map image sees, -1 for none."""
        keypoint, point = self.map.observations(index)
        points = np.full(len(self.features[self.map.image_names[index]]), -1, np.int64)
        points[keypoint] = point
        return points

    def candidates(
        self,
        query: RigQuery,
        kind: int,
        rig_from_world: Floats,
        references: Sequence[int],
        radius_deg: float,
        settings: PnpSettings,
    ) -> Iterator["Candidates"]:
        """Yield, for each query image, its keypoints near where a pose puts map points that look like them.

        Args:
            query: the query's cameras and features.
            kind: which of the query's features are of this kind.
            rig_from_world: the pose, (4, 4).
            references: indices of this map's images, whose points are projected.
            radius_deg: largest distance of a keypoint from the projection.
            settings: how many features of an image.
        """
        references = [index for index in references if len(self.map.observations(index)[0])]
        if not references:
            return
        images = [self.image(index, settings.max_map_features) for index in references]
        # A point that several images see is projected once.
        point, which = np.unique(np.concatenate([image.points for image in images]), return_inverse=True)
        by_point, counts = np.argsort(which, kind="stable"), np.bincount(which)
        starts, places = np.cumsum(counts) - counts, self.map.points[point]
        image_of = np.repeat(references, [len(image.points) for image in images])
        descriptors = np.concatenate([image.features.descriptors for image in images])
        depth = np.einsum("oj,oj->o", self.map.cams_from_world[image_of, 2, :3], places[which])
        depth += self.map.cams_from_world[image_of, 2, 3]
        # Size of the feature on the surface, meters: it looks that large from everywhere.
        size = np.concatenate([image.features.scales for image in images]) * depth / self.map.focals_px[image_of]
        for camera, kinds in enumerate(query.features):
            features = kinds[kind]
            radius = np.tan(np.radians(radius_deg)) * query.focals_px[camera]
            cam_from_world = geometry.invert(query.rig_from_cams[camera]) @ rig_from_world
            in_cam = geometry.transform(cam_from_world, places)
            visible = np.flatnonzero(in_view(in_cam[None], query.bounds[camera][None])[0])
            if not len(visible) or not len(features):
                continue
            projected = np.asarray(query.cameras[camera].img_from_cam(in_cam[visible]))
            finite = np.isfinite(projected).all(axis=1)
            visible, projected = visible[finite], projected[finite]
            tree = query.trees[camera][kind]
            near = KDTree(projected).sparse_distance_matrix(tree, radius, output_type="ndarray")
            seen = visible[near["i"]]
            keypoint = np.repeat(near["j"], counts[seen])
            within = np.arange(len(keypoint)) - np.repeat(np.cumsum(counts[seen]) - counts[seen], counts[seen])
            observed = by_point[np.repeat(starts[seen], counts[seen]) + within]
            expected = size[observed] * query.focals_px[camera] / in_cam[which[observed], 2]
            octaves = np.abs(np.log2(features.scales[keypoint] / np.maximum(expected, 1e-6)))
            similar = octaves < self.kind.scale_octaves
            observed, keypoint = observed[similar], keypoint[similar]
            score = np.einsum(
                "od,od->o", unit_descriptors(descriptors[observed]), query.descriptors(camera, kind)[keypoint]
            )
            alike = np.flatnonzero(score > self.kind.guided_min_score)
            alike = alike[np.lexsort((keypoint[alike], observed[alike], -score[alike]))]
            keypoint, of_camera = keypoint[alike], np.full(len(alike), camera)
            pixels = features.keypoints[keypoint].astype(np.float64)
            yield Candidates(Matches(of_camera, pixels, point[which[observed[alike]]]), keypoint)


@dataclass(frozen=True)
class Candidates:
    """K matches of a query image with one kind of features, the most alike first; some may exclude each other."""

    matches: Matches
    keypoint: Ints
    """(K,) of the query image."""

    def mutual(self, part: Ints) -> Ints:
        """Return those of a part, ascending, whose keypoint and point are the most alike to each other."""
        return part[_is_first(self.keypoint[part]) & _is_first(self.matches.point[part])]


def _unique_columns(numbers: Ints) -> tuple[Ints, ...]:
    """Return the different columns of integers (R, K), none negative, in ascending order: R arrays."""
    shape = tuple((numbers.max(axis=1, initial=0) + 1).tolist())
    # One number a column: `np.unique` takes five times as long with an axis.
    return np.unravel_index(np.unique(np.ravel_multi_index(tuple(numbers), shape)), shape)


def _is_first(numbers: Ints) -> NDArray[np.bool_]:
    """Return which of some numbers, none negative, did not occur before, (K,)."""
    positions = np.arange(len(numbers))
    first = np.zeros(numbers.max(initial=-1) + 1, np.int64)
    first[numbers[::-1]] = positions[::-1]  # of several values for one place, the last one stays
    return np.asarray(first[numbers] == positions, np.bool_)


class Vicinity:
    """What a query shows near where a pose puts the points of map images: poses nearby choose their matches from it."""

    def __init__(
        self,
        query: RigQuery,
        candidates: Sequence[Candidates],
        points: Floats,
        rig_from_world: Floats,
        radius_deg: float,
    ) -> None:
        """
        Args:
            query: its cameras and features.
            candidates: all that are within the radius of the projections.
            points: (P, 3) the map points.
            rig_from_world: the pose, (4, 4).
            radius_deg: of the search.
        """
        self._query, self._candidates, self._points, self._radius_deg = query, candidates, points, radius_deg
        self._projected = [query.projected(rig_from_world, part.matches, points) for part in candidates]

    def reaches(self, rig_from_world: Floats, radius_deg: float) -> bool:
        """Tell whether all that is within a radius of what another pose projects was found."""
        return all(
            (self._angles_deg(rig_from_world, part, before) <= self._radius_deg - radius_deg).all()
            for part, before in zip(self._candidates, self._projected, strict=True)
        )

    def guided(self, rig_from_world: Floats, radius_deg: float, most: int) -> Matches:
        """Return the matches of a pose.

        Args:
            rig_from_world: the pose, (4, 4).
            radius_deg: largest distance of a keypoint from the projection.
            most: matches of a camera and a kind at most, the most alike.
        """
        chosen = []
        for part in self._candidates:
            near = self._angles_deg(rig_from_world, part, part.matches.pixels) <= radius_deg
            chosen.append(part.matches[part.mutual(np.flatnonzero(near))[:most]])
        return Matches.pooled(chosen)

    def _angles_deg(self, rig_from_world: Floats, part: Candidates, pixels: Floats) -> Floats:
        """Return how far a pose puts the points of candidates from pixels (K, 2), as angles (K,)."""
        offsets = self._query.projected(rig_from_world, part.matches, self._points) - pixels
        return np.degrees(np.arctan(np.linalg.norm(offsets, axis=1) / self._query.focals_px[part.matches.camera]))


class MapMatcher:
    """Matches queries with a map of one or several kinds of features; the matches of all kinds are pooled."""

    def __init__(self, mapped: Sequence[MappedFeatures], settings: PnpSettings) -> None:
        self.mapped = list(mapped)
        self.settings = settings
        self.map = LocalMap.pooled([features.map for features in mapped])
        """The points of all kinds, one kind after the other."""
        self._first_point = np.cumsum([0, *(len(features.map.points) for features in mapped)])
        self._index_in = [
            None
            if features.map.image_names is self.map.image_names
            else [features.map.index_of.get(name, -1) for name in self.map.image_names]
            for features in mapped
        ]  # of each kind, the index of each image, None: the same; -1: that kind has it not

    def by_descriptors(
        self,
        query: RigQuery,
        references: Sequence[References],
        network_matches: Sequence[Sequence[NetworkMatches | None]] = (),
        known: KnownMatches | None = None,
    ) -> Matches:
        """Match each query image with its references by descriptors, those of each kind alone.

        Args:
            query: its cameras and features.
            references: of each query image.
            network_matches: those that networks made before, of each query image and kind.
            known: those of the query that were made before; the others are added.
        """
        parts, known = [], KnownMatches() if known is None else known
        for kind, features in enumerate(self.mapped):
            columns = [np.zeros((3, 0), np.int64)]
            for camera, retrieved in enumerate(references):
                before = network_matches[camera][kind] if network_matches else None
                images = self._of_kind(kind, retrieved.images)
                new = [image for image in images if (camera, kind, image) not in known]
                found = features.match(query.features[camera][kind], new, self.settings, before)
                known |= {(camera, kind, image): part for image, part in zip(new, found, strict=True)}
                for keypoint, point in (known[camera, kind, image] for image in images):
                    columns.append(np.stack([np.full(len(point), camera), keypoint, point + self._first_point[kind]]))
            camera_index, keypoint, point = _unique_columns(np.concatenate(columns, axis=1))
            parts.append(Matches(camera_index, query.pixels(camera_index, keypoint, kind), point))
        return Matches.pooled(parts)

    def vicinity(self, query: RigQuery, rig_from_world: Floats, images: Ints, radius_deg: float) -> Vicinity:
        """Return what is near where the pose puts the points of map images, those of each kind alone."""
        candidates = [
            replace(part, matches=replace(part.matches, point=part.matches.point + int(self._first_point[kind])))
            for kind, features in enumerate(self.mapped)
            for part in features.candidates(
                query, kind, rig_from_world, self._of_kind(kind, images), radius_deg, self.settings
            )
        ]
        return Vicinity(query, candidates, self.map.points, rig_from_world, radius_deg)

    def covisible(self, points: Ints) -> Ints:
        """Return the map images that see the most of the points, in a fixed order."""
        seen = self.map.images_seeing(points)
        some = np.flatnonzero(seen)
        return some[np.argsort(-seen[some], kind="stable")[: self.settings.guided_images]]

    def kind_names(self, points: Ints) -> NDArray[np.str_]:
        """Return the name of the kind of features that each point is of."""
        names = np.array([features.name for features in self.mapped])
        return names[np.searchsorted(self._first_point, points, side="right") - 1]

    def keypoints(self, image: int, points: Ints) -> tuple[Ints, Floats]:
        """Return which of the points a map image sees, as indices into `points`, and where, (n, 2) pixels."""
        keypoint, observed = self.map.observations(image)
        seen, first = np.unique(observed, return_index=True)
        at = np.flatnonzero(np.isin(points, seen))  # several cameras of a rig may see the same point
        where = first[np.searchsorted(seen, points[at])]
        pixels = np.zeros((len(at), 2))
        kinds = np.searchsorted(self._first_point, points[at], side="right") - 1
        for kind in np.unique(kinds):
            of_kind = self._of_kind(int(kind), [image])[0]
            pixels[kinds == kind] = self.mapped[kind].keypoints(of_kind)[keypoint[where[kinds == kind]]]
        return at, pixels

    def _of_kind(self, kind: int, images: Ints | Sequence[int]) -> list[int]:
        """Return the indices of images in the map of one kind; those that it does not have are left out."""
        index_in = self._index_in[kind]
        if index_in is None:
            return [int(image) for image in images]
        return [index for image in images if (index := index_in[int(image)]) >= 0]
