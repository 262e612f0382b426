"""Match query images with map points: by descriptors alone, or near the projections of the points at a pose."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit import geometry
from toolkit.capture.images import in_view
from toolkit.features.features import KINDS, FeatureKind, LocalFeatures
from toolkit.features.matching import Matcher, MutualMatcher, unit_descriptors
from toolkit.geometry import Floats, Ints
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import NetworkMatches, References
from toolkit.pose.rig import Matches, RigQuery

MAX_MAP_FEATURES = 1000
"""Largest number of features per map image to match."""
MAX_QUERY_FEATURES = 1536
"""Largest number of features per query image to match by descriptors alone; those with the strongest response are used.
Guided matching uses all features."""
MAX_GUIDED_IMAGES = 12
"""Number of covisible map images whose points are projected for guided matching."""
CACHED_IMAGES = 256
"""Number of map images whose features stay in memory."""


MatchCache = dict[tuple[int, int, int], tuple[Ints, Ints]]
"""(query image, kind of features, map image) -> query keypoints (K,) and the map points (K,) that they match."""


@dataclass(frozen=True)
class MapImage:
    """The N features of a map image that observe a map point, longest tracks first."""

    points: Ints
    """(N,) the map point of each feature."""
    scales: NDArray[np.float32]
    """(N,) see `LocalFeatures`."""
    unit: NDArray[np.float32]
    """(N, D) see `unit_descriptors`."""
    keypoints: NDArray[np.float32]
    """(M, 2) pixels, of all features of the image."""


class MappedFeatures:
    """One kind of local features of a map. Safe to use from several threads; the map is never changed."""

    def __init__(
        self,
        local_map: LocalMap,
        features: Mapping[str, LocalFeatures],
        name: str = "sift",
        matcher: Matcher | None = None,
        kind: FeatureKind | None = None,
        most: int = MAX_MAP_FEATURES,
    ):
        """
        Args:
            local_map: the map triangulated from the features.
            features: features of the map images, by name.
            name: of the kind of features.
            matcher: None: `mutual` with the limits of the kind. Any `mutual` compares descriptors as the kind says.
            kind: None: that of the name in `KINDS`.
            most: features of a map image to match, at most; those of the points with the longest tracks are used.
        """
        self.map, self.features, self.name, self.most = local_map, features, name, most
        self.kind = kind or KINDS[name]
        self.matcher = matcher or MutualMatcher.of(self.kind)
        self.image = lru_cache(CACHED_IMAGES)(self._image)
        """Cached `_image`."""
        self._network = Lock()

    def with_map(self, local_map: LocalMap, most: int = MAX_MAP_FEATURES) -> "MappedFeatures":
        """Return the same features with another map of their images."""
        return MappedFeatures(local_map, self.features, self.name, self.matcher, self.kind, most)

    def match(
        self,
        query: RigQuery,
        camera: int,
        kind: int,
        references: Sequence[int],
        network_matches: NetworkMatches | None,
    ) -> list[tuple[Ints, Ints]]:
        """Match a query image with references.

        Args:
            query: the query's cameras and features.
            camera, kind: indices of a query image, and of this kind among its features.
            references: indices of images in this map.
            network_matches: matches that a network made earlier; None: match now.

        Returns:
            For each reference, the query keypoints (K,) and the map points (K,) that they match.
        """
        if isinstance(self.matcher, MutualMatcher):
            unit = query.unit_descriptors(camera, kind, self.kind.shorten)[:MAX_QUERY_FEATURES]
            images = [self.image(index) for index in references]
            pairs = [self.matcher.match_unit(unit, image.unit) for image in images]
            points = [image.points for image in images]
        else:  # a network needs the context of a feature, so it gets features without a point, too
            names = [self.map.image_names[index] for index in references]
            if network_matches is not None:
                pairs = [network_matches(name) for name in names]
            else:
                with self._network:
                    pairs = self.matcher.match([(query.features[camera][kind], self.features[name]) for name in names])
            points = [self._point_of_each_feature(index) for index in references]
        matches = []
        for pair, point_of_feature in zip(pairs, points, strict=True):
            keypoint, point = pair.indices[:, 0], point_of_feature[pair.indices[:, 1]]
            matches.append((keypoint[point >= 0], point[point >= 0]))
        return matches

    def _image(self, index: int) -> MapImage:
        """Return the features of a map image that observe points, at most `most`, longest tracks first."""
        keypoint, point = self.map.observations(index)
        order = np.argsort(-self.map.track_lengths(point), kind="stable")[: self.most]
        features = self.features[self.map.image_names[index]]
        kept = features.take(keypoint[order])
        unit = unit_descriptors(kept.descriptors, self.kind.shorten)
        return MapImage(point[order], kept.scales, unit, features.keypoints)

    def _point_of_each_feature(self, index: int) -> Ints:
        """Return the map point (N,) of each feature of a map image, -1 for none."""
        keypoint, point = self.map.observations(index)
        points = np.full(len(self.features[self.map.image_names[index]]), -1, np.int64)
        points[keypoint] = point
        return points

    def candidates(
        self, query: RigQuery, kind: int, rig_from_world: Floats, references: Sequence[int], radius_deg: float
    ) -> Iterator["Candidates"]:
        """Yield, for each query image, candidate matches of its keypoints with map points that project near them.

        Args:
            query: the query's cameras and features.
            kind: index of this kind among the query's features.
            rig_from_world: the pose, (4, 4).
            references: indices of images in this map; their points are projected.
            radius_deg: largest angle between a keypoint and the projection.
        """
        references = [index for index in references if len(self.map.observations(index)[0])]
        if not references:
            return
        images = [self.image(index) for index in references]
        # Several images may observe a point, which is projected once: `point`, `counts`, `starts` and `in_world` are
        # per point, `which`, `image_of`, `unit`, `depth` and `size` per observation.
        point, which = np.unique(np.concatenate([image.points for image in images]), return_inverse=True)
        by_point, counts = np.argsort(which, kind="stable"), np.bincount(which)
        starts, in_world = np.cumsum(counts) - counts, self.map.points[point]
        image_of = np.repeat(references, [len(image.points) for image in images])
        unit = np.concatenate([image.unit for image in images])
        depth = np.einsum("oj,oj->o", self.map.cams_from_world[image_of, 2, :3], in_world[which])
        depth += self.map.cams_from_world[image_of, 2, 3]
        # Size of the feature on the surface, in meters, which does not depend on the camera.
        size = np.concatenate([image.scales for image in images]) * depth / self.map.focals_px[image_of]
        for camera, kinds in enumerate(query.features):
            features = kinds[kind]
            radius = np.tan(np.radians(radius_deg)) * query.focals_px[camera]
            cam_from_world = geometry.invert(query.rig_from_cams[camera]) @ rig_from_world
            in_cam = geometry.transform(cam_from_world, in_world)
            visible = np.flatnonzero(in_view(in_cam[None], query.bounds[camera][None])[0])
            if not len(visible) or not len(features):
                continue
            projected = np.asarray(query.cameras[camera].img_from_cam(in_cam[visible]))
            finite = np.isfinite(projected).all(axis=1)
            visible, projected = visible[finite], projected[finite]
            tree = query.trees[camera][kind]
            near = KDTree(projected).sparse_distance_matrix(tree, radius, output_type="ndarray")
            near_point, keypoint = visible[near["i"]], near["j"]
            # Compare each near keypoint with all observations of the point; the most similar one counts.
            count = counts[near_point]
            pair = np.repeat(np.arange(len(near)), count)
            shift = starts[near_point] - (np.cumsum(count) - count)
            observation = by_point[np.arange(len(pair)) + np.repeat(shift, count)]
            expected_px = size * query.focals_px[camera] / np.maximum(in_cam[which, 2], 1e-6)
            expected, actual = (np.log2(np.maximum(px, 1e-6)) for px in (expected_px, features.scales.astype(float)))
            octaves = np.repeat(actual[keypoint], count)
            octaves -= expected[observation]
            similar = np.flatnonzero(np.abs(octaves, out=octaves) < self.kind.scale_octaves)
            pair, observation = pair[similar], observation[similar]
            unit_query = query.unit_descriptors(camera, kind, self.kind.shorten)
            scores = _similarities(unit, observation, unit_query, keypoint[pair])
            first = np.flatnonzero(np.diff(pair, prepend=-1))
            score, pair = np.maximum.reduceat(scores, first) if len(first) else scores, pair[first]
            good = np.flatnonzero(score > self.kind.guided_min_score)
            near_point, keypoint = near_point[pair[good]], keypoint[pair[good]]
            # Highest score first, then by point and keypoint, as one number: bits of positive floats sort as they do.
            bits = score[good].view(np.int32).astype(np.int64)
            order = np.argsort(near_point * len(features) + keypoint - (bits << 32))
            near_point, keypoint = near_point[order], keypoint[order]
            pixels = features.keypoints[keypoint].astype(np.float64)
            yield Candidates(Matches(np.full(len(good), camera), pixels, point[near_point]), keypoint)


def _similarities(
    unit_a: NDArray[np.float32], rows_a: Ints, unit_b: NDArray[np.float32], rows_b: Ints
) -> NDArray[np.float32]:
    """Return the cosine similarities (K,) of K pairs of rows of unit descriptors."""
    scores = np.empty(len(rows_a), np.float32)
    a, b = np.empty((2, 512, unit_a.shape[1]), np.float32)  # both sides of so many pairs fit into the cache
    for start in range(0, len(rows_a), len(a)):
        pairs = slice(start, start + len(a))
        some = slice(len(rows_a[pairs]))
        # With `clip`, NumPy writes to `out` at once.
        unit_a.take(rows_a[pairs], axis=0, out=a[some], mode="clip")
        unit_b.take(rows_b[pairs], axis=0, out=b[some], mode="clip")
        np.einsum("kd,kd->k", a[some], b[some], out=scores[pairs])
    return scores


class Candidates(NamedTuple):
    """K candidate matches of a query image and one kind of features, highest score first.

    A keypoint or a point may be in several of them.
    """

    matches: Matches
    keypoint: Ints
    """(K,) index of the keypoint in the query image."""


def _is_first(numbers: Ints) -> NDArray[np.bool_]:
    """Tell for each of K non-negative numbers whether it is the first of its value, (K,)."""
    positions = np.arange(len(numbers))
    first = np.zeros(numbers.max(initial=-1) + 1, np.int64)
    first[numbers[::-1]] = positions[::-1]  # the last assignment to an index wins: the first position
    return np.asarray(first[numbers] == positions, np.bool_)


class Vicinity:
    """Candidate matches around a pose: keypoints near the projections of map points. Poses close to it reuse them."""

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
            candidates: all keypoints within the radius of the projections, per query image and kind of features.
            points: (P, 3) the map points.
            rig_from_world: the pose, (4, 4).
            radius_deg: radius of the search.
        """
        self._query, self._candidates, self._points, self._radius_deg = query, candidates, points, radius_deg
        # A point has several candidates, but is projected once.
        unique = [np.unique(group.matches.point, return_index=True, return_inverse=True) for group in candidates]
        self._once = [group.matches[first] for group, (_, first, _) in zip(candidates, unique, strict=True)]
        self._which = [which for _, _, which in unique]
        self._projected = self._project(rig_from_world)

    def reaches(self, rig_from_world: Floats, radius_deg: float) -> bool:
        """Tell whether the candidates include all keypoints within a radius of the projections at another pose."""
        return all(
            self._near(projected, before, once, self._radius_deg - radius_deg).all()
            for projected, before, once in zip(self._project(rig_from_world), self._projected, self._once, strict=True)
        )

    def guided(self, rig_from_world: Floats, radius_deg: float, limit: int) -> Matches:
        """Return the mutual best matches at a pose.

        Args:
            rig_from_world: the pose, (4, 4).
            radius_deg: largest angle between a keypoint and the projection.
            limit: largest number of matches per camera and kind; those with the highest scores stay.
        """
        chosen = []
        for projected, which, group in zip(self._project(rig_from_world), self._which, self._candidates, strict=True):
            near = np.flatnonzero(self._near(projected[which], group.matches.pixels, group.matches, radius_deg))
            mutual = near[_is_first(group.keypoint[near]) & _is_first(group.matches.point[near])]
            chosen.append(group.matches[mutual[:limit]])
        return Matches.pooled(chosen)

    def _project(self, rig_from_world: Floats) -> list[Floats]:
        """Return the projections (P, 2) of the P points of each group of candidates at a pose."""
        return [self._query.projected(rig_from_world, once, self._points) for once in self._once]

    def _near(self, projected: Floats, pixels: Floats, matches: Matches, radius_deg: float) -> NDArray[np.bool_]:
        """Tell whether pixels (K, 2) are within a radius of projections (K, 2) in the images of K matches."""
        radius_px = np.tan(np.radians(radius_deg)) * self._query.focals_px[matches.camera]
        return np.asarray(np.linalg.norm(projected - pixels, axis=1) <= radius_px, np.bool_)


class MapMatcher:
    """Matches queries with a map of several kinds of features. Each kind is matched alone; the matches are pooled."""

    def __init__(self, mapped: Sequence[MappedFeatures]) -> None:
        self.mapped = list(mapped)
        self.map = LocalMap.pooled([features.map for features in mapped])
        """The map with the points of all kinds, one kind after the other."""
        self._first_point = np.cumsum([0, *(len(features.map.points) for features in mapped)])

    def by_descriptors(
        self,
        query: RigQuery,
        references: Sequence[References],
        network_matches: Sequence[Sequence[NetworkMatches | None]],
        cache: MatchCache,
    ) -> Matches:
        """Match each query image with its references by descriptors alone.

        Args:
            query: its cameras and features.
            references: references of each query image.
            network_matches: matches that networks made earlier, for each query image and kind; empty if there are none.
            cache: earlier matches of this query; new ones are added.
        """
        matches = []
        for kind, features in enumerate(self.mapped):
            columns = [np.zeros((3, 0), np.int64)]
            for camera, retrieved in enumerate(references):
                made_earlier = network_matches[camera][kind] if network_matches else None
                images = self._of_kind(kind, retrieved.images)
                new = [image for image in images if (camera, kind, image) not in cache]
                made_now = features.match(query, camera, kind, new, made_earlier)
                cache |= {(camera, kind, image): pairs for image, pairs in zip(new, made_now, strict=True)}
                for keypoint, point in (cache[camera, kind, image] for image in images):
                    columns.append(np.stack([np.full(len(point), camera), keypoint, point + self._first_point[kind]]))
            camera_index, keypoint, point = geometry.unique_columns(np.concatenate(columns, axis=1))
            matches.append(Matches(camera_index, query.pixels(camera_index, keypoint, kind), point))
        return Matches.pooled(matches)

    def vicinity(self, query: RigQuery, rig_from_world: Floats, images: Ints, radius_deg: float) -> Vicinity:
        """Return the candidate matches around a pose with the points of map images."""
        candidates = [
            Candidates(replace(matches, point=matches.point + int(self._first_point[kind])), keypoint)
            for kind, features in enumerate(self.mapped)
            for matches, keypoint in features.candidates(
                query, kind, rig_from_world, self._of_kind(kind, images), radius_deg
            )
        ]
        return Vicinity(query, candidates, self.map.points, rig_from_world, radius_deg)

    def covisible(self, points: Ints) -> Ints:
        """Return the map images that observe the most of some points, most first, at most `MAX_GUIDED_IMAGES`."""
        counts = self.map.images_seeing(points)
        images = np.flatnonzero(counts)
        return images[np.argsort(-counts[images], kind="stable")[:MAX_GUIDED_IMAGES]]

    def kind_names(self, points: Ints) -> NDArray[np.str_]:
        """Return the name of the kind of features of each point."""
        return np.array([features.name for features in self.mapped])[self.kind_of(points)]

    def kind_of(self, points: Ints) -> Ints:
        """Return the index of the kind of features of each point."""
        return np.searchsorted(self._first_point, points, side="right") - 1

    def keypoints(self, image: int, points: Ints) -> tuple[Ints, Floats]:
        """Return which points a map image observes, as indices (n,) into `points`, and its keypoints (n, 2), pixels."""
        keypoint, observed = self.map.observations(image)
        seen, first = np.unique(observed, return_index=True)
        at = np.flatnonzero(np.isin(points, seen))  # `points` may repeat a point that several cameras of a rig see
        observation = first[np.searchsorted(seen, points[at])]
        pixels = np.zeros((len(at), 2))
        kinds = self.kind_of(points[at])
        for kind in np.unique(kinds):
            seen_by = self.mapped[kind].image(self._of_kind(int(kind), [image])[0])
            pixels[kinds == kind] = seen_by.keypoints[keypoint[observation[kinds == kind]]]
        return at, pixels

    def _of_kind(self, kind: int, images: Ints | Sequence[int]) -> list[int]:
        """Return the indices of images in the map of one kind; images that it does not have are left out."""
        of_kind, names = self.mapped[kind].map, self.map.image_names
        if of_kind.image_names is names:
            return [int(image) for image in images]
        return [of_kind.index_of[names[image]] for image in images if names[image] in of_kind.index_of]
