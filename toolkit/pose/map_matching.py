"""Match query images with map points: by descriptors alone, or near the projections of the points at a pose; and tell
whether matches made without the pose contradict the intrinsics of the query.

The pose absorbs most of an error of the intrinsics: a wrong focal length changes the distance, a wrong principal point
the rotation. A pattern remains in the reprojection errors, as near and far points, image center and border, and the
cameras of a rig need different corrections. So pose and intrinsics are estimated together, as in bundle adjustment, and
the result is compared with the stated intrinsics.

Errors of neighboring matches are not independent: a rolling shutter, noise of the map's poses and a lens that the model
describes only roughly move them together, and such a pattern looks like other intrinsics. So all matches in a cell of
the image count as one observation.

Some scenes do not determine the intrinsics: for a plane that faces the camera, every focal length fits at some
distance. The standard deviation of the focal length is then so large that no difference is significant, and the stated
one is accepted.

Absurd intrinsics (ten times the focal length) give a pose from which no fit begins. Then other cameras are tried.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from toolkit import geometry
from toolkit.alignment.robust import Bools
from toolkit.capture.images import in_view, projection_jacobian
from toolkit.features.features import KINDS, FeatureKind, LocalFeatures, MutualMatcher, unit_descriptors
from toolkit.features.matching import Matcher
from toolkit.geometry import Floats, Ints
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import AGREEMENT, Matches, NetworkMatches, Query, QueryResult, References, RigQuery, Status
from toolkit.threads import fixed_sums

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
Candidates = tuple[Matches, Ints]
"""K candidate matches of a query image and one kind of features, highest score first, with the indices (K,) of their
keypoints in the image. A keypoint or a point may be in several of them."""

# Of the check of the intrinsics
SIGNIFICANCE = 1e-4
"""False alarm rate: the probability that noise alone makes correct intrinsics look wrong."""
MAX_SHARES = (0.1, 0.3, 0.1)
"""Largest motion of the pose to that of the intrinsics that fit, as a share of what `ok` allows (5 degrees, 0.5 m): due
to focal length, principal point, radial distortion. Nominal principal points are often 1 % of the focal length off."""
SUSPICIOUS = 0.01  # largest probability of the first step (a cheap test) for which the full test runs
CERTAIN = 1e-6  # largest probability of the first step for which intrinsics are wrong even if no others are found
WIDENINGS = (8.0, 8.0, 4.0, 2.0)  # factors of the inlier limit in the first steps: wrong intrinsics enlarge errors
STEPS = 15  # of the refinement of intrinsics, at most
SETTLED_PX = 0.02  # largest motion of a projection in a step at which the fit has converged
MIN_SCALE_PX = 0.5  # least scale of the Cauchy weights
PRIOR_STD = (0.2, 0.02, 0.02, 0.05)  # prior standard deviations of the four `IntrinsicsCheck.parameters`
FOCALS = (0.45, 0.7, 1.1, 1.7, 2.6, 4.0)  # focal lengths of the cameras to try, over the longer side of the image
MORE = 3.0
"""Such a camera fits if its odds of an inlier, times the cells that have one, are so many times those of the stated.
A wrong camera fits a part of the image: where focal lengths, distortions or principal points are absurd, or images are
cropped off-center, the ratio is 4.5 and more; of right cameras by night, where windows repeat, at most 2.6."""
MIN_INLIERS = 12  # its inliers must be more than these
FEW = 0.3  # share of inliers among the matches below which other cameras are tried if the first step is certain
VERY_FEW = 0.2  # share below which they are tried in any case
TRIALS = 1000  # samples of their RANSAC
ABSURD = 0.2  # smallest change of the intrinsics, relatively, that makes another camera another

OWN_FOCAL_STD = 3e-3
"""Relative standard deviation of the focal lengths of images of one camera: between 0, of a fixed focus, and 0.5 %, of
a phone, which focuses each image anew. The images of a map do not tell which it is, as its points make up for it."""


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

    @fixed_sums
    def load(self) -> None:
        """Read the features of all map images, if the cache holds so many: 1 ms for each."""
        names = self.map.image_names
        for index in range(len(names)) if len(names) <= CACHED_IMAGES else ():
            if names[index] in self.features:
                self.image(index)

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
    ) -> Iterator[Candidates]:
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
            yield Matches(np.full(len(good), camera), pixels, point[near_point]), keypoint


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
        unique = [np.unique(matches.point, return_index=True, return_inverse=True) for matches, _ in candidates]
        self._once = [matches[first] for (matches, _), (_, first, _) in zip(candidates, unique, strict=True)]
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
        of_groups = zip(self._project(rig_from_world), self._which, self._candidates, strict=True)
        for projected, which, (matches, keypoint) in of_groups:
            near = np.flatnonzero(self._near(projected[which], matches.pixels, matches, radius_deg))
            mutual = near[_is_first(keypoint[near]) & _is_first(matches.point[near])]
            chosen.append(matches[mutual[:limit]])
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

    def vicinity(self, query: RigQuery, rig_from_world: Floats, points: Ints, radius_deg: float) -> Vicinity:
        """Return the candidate matches around a pose with the points of the map images that observe the most of some
        points, at most `MAX_GUIDED_IMAGES`.
        """
        counts = self.map.images_seeing(np.unique(points))
        images = np.flatnonzero(counts)
        images = images[np.argsort(-counts[images], kind="stable")[:MAX_GUIDED_IMAGES]]
        candidates = [
            (replace(matches, point=matches.point + int(self._first_point[kind])), keypoint)
            for kind, features in enumerate(self.mapped)
            for matches, keypoint in features.candidates(
                query, kind, rig_from_world, self._of_kind(kind, images), radius_deg
            )
        ]
        return Vicinity(query, candidates, self.map.points, rig_from_world, radius_deg)

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


# The check of the intrinsics


@dataclass(frozen=True)
class IntrinsicsCheck:
    """Intrinsics that fit the matches of a pose significantly better than the stated ones."""

    shift: Floats
    """(6,) motion of the rig, in its own frame, to the pose with these intrinsics: rotation in radians, then
    translation in meters."""
    parameters: Floats
    """(C, 4) change of the intrinsics of each camera: relative change of the focal length; shift of the principal point
    in x and y, in focal lengths; and radial distortion, as the relative change of the distance from the principal point
    at an image corner. NaN if the intrinsics that fit are unknown."""
    shares: Floats
    """(C, 3) how far the changes of focal length, principal point and distortion move the pose, as a share of what `ok`
    allows; 0 if a change is not significant."""

    @property
    def doubtful(self) -> bool:
        """Whether a significant change moves the pose beyond `MAX_SHARES`, or the intrinsics that fit are unknown."""
        return bool(np.isnan(self.parameters).any() or (self.shares > MAX_SHARES).any())

    @property
    def _at_fault(self) -> Ints:
        """(C,) what is most at fault: focal length (0), principal point (1), distortion (2) or nothing (-1)."""
        excess = self.shares / MAX_SHARES
        return np.where(excess.any(axis=1), excess.argmax(axis=1), -1)

    def focals_px(self, cameras: list[pycolmap.Camera]) -> tuple[float, ...]:
        """Return the focal length that fits each camera; NaN if something else or nothing is at fault."""
        return tuple(np.where(self._at_fault == 0, self._fitted(cameras)[:, 0], np.nan).tolist())

    def centers_px(self, cameras: list[pycolmap.Camera]) -> tuple[tuple[float, float], ...]:
        """Return the principal point that fits each camera; NaN if something else or nothing is at fault."""
        centers = np.where(self._at_fault[:, None] == 1, self._fitted(cameras)[:, 1:], np.nan)
        return tuple((x, y) for x, y in centers.tolist())

    def _fitted(self, cameras: list[pycolmap.Camera]) -> Floats:
        """Return focal length and principal point x, y that fit each camera, (C, 3), pixels."""
        stated = _stated(cameras)
        focal, *center = self.parameters[:, :3].T
        return np.column_stack([stated[:, 0] * (1 + focal), stated[:, 1:] + stated[:, :1] * np.transpose(center)])

    def reason(self, cameras: list[pycolmap.Camera]) -> str:
        """Return a text that compares, for each camera at fault, the fitted and the stated value."""
        if np.isnan(self.parameters).any():
            return "the matches contradict the intrinsics, and no others were found that fit: check model and numbers"
        texts, stated, fitted = [], _stated(cameras), self._fitted(cameras)
        for number in np.flatnonzero(self._at_fault >= 0):
            (focal_px, x, y), (fitted_px, fitted_x, fitted_y) = stated[number], fitted[number]
            corners = 100 * self.parameters[number, 3]
            text = (
                f"the focal length that fits is {fitted_px:.1f} px, its intrinsics say {focal_px:.1f} px",
                f"the principal point that fits is {fitted_x:.1f}, {fitted_y:.1f}, its intrinsics say {x:.1f}, {y:.1f}",
                f"the radial distortion that fits moves the corners by {corners:+.1f} % against its intrinsics",
            )[self._at_fault[number]]
            texts.append(f"camera {number + 1} of {len(cameras)}: {text}" if len(cameras) > 1 else text)
        return "; ".join(texts)


def _stated(cameras: list[pycolmap.Camera]) -> Floats:
    """Return mean focal length and principal point x, y of cameras, (C, 3), pixels."""
    return np.array([(one.mean_focal_length(), one.principal_point_x, one.principal_point_y) for one in cameras])


def check_intrinsics(
    query: RigQuery,
    rig_from_world: Floats,
    matches: Matches,
    points: Floats,
    max_error_deg: float,
    focal_alone: bool = False,
    noise_deg: float = 0.0,
) -> IntrinsicsCheck | None:
    """Return the intrinsics that fit significantly better than the stated ones; None if there are none.

    Gauss-Newton with Cauchy weights fits pose and intrinsics. An F-test tells whether the change is significant.

    Args:
        query: the cameras.
        rig_from_world: the pose (4, 4) found with the stated intrinsics.
        matches: all matches from descriptors alone, inliers and outliers. Guided matches cannot be used: they were
            searched near the pose, so they agree with it even if it is wrong.
        points: (P, 3) the map points.
        max_error_deg: largest error of an inlier.
        focal_alone: keep principal points and distortions as stated; changing them can make wrong poses look correct.
        noise_deg: standard deviation of the direction to map points due to noise of the map's poses, degrees.
    """
    problem = _Problem(query, matches, points, max_error_deg)
    which = np.arange(problem.unknowns)
    pose = which < 6
    free = pose | (which % 4 == 2) if focal_alone else ~np.zeros(problem.unknowns, bool)
    start = _Estimate(rig_from_world, problem.unchanged)
    first = problem.step(start, free, WIDENINGS[0])
    by_chance = 1.0 if first is None else first.probability(first.change, free & ~pose)
    inliers = problem.inliers(start)
    share = float(inliers.mean()) if inliers.size else 1.0
    if by_chance > SUSPICIOUS and share > VERY_FEW:
        return None
    fitted = problem.fit(start, free)
    if share < VERY_FEW or (by_chance < CERTAIN and (fitted is None or problem.inliers(fitted).mean() < FEW)):
        other = _try_cameras(problem, start, problem.inliers(fitted or start))
        if other is not None:
            return other
    if fitted is None or by_chance > SUSPICIOUS:
        unknown = np.full((len(query.cameras), 4), np.nan)
        return IntrinsicsCheck(np.zeros(6), unknown, np.zeros((len(unknown), 3))) if by_chance < CERTAIN else None
    return problem.check(start, fitted, free, float(np.tan(np.radians(noise_deg)) * query.focals_px.mean()))


def with_own_focals(query: Query, result: QueryResult, max_error_deg: float) -> QueryResult:
    """Return a result with the pose, and in its remark the focal lengths, that fit its correspondences best.

    Each focal length has a normal prior around the stated one, see `OWN_FOCAL_STD`. Errors in a cell of an image are
    alike, so correspondences count as many as there are cells with one. A result that is not `ok` is returned as it
    is. The covariance grows by what the focal lengths leave open.

    Args:
        query: in the lengths of the result.
        result: of the stated intrinsics.
        max_error_deg: largest error of an inlier.
    """
    found, cameras = result.correspondences, [view.camera for view in query.views]
    if result.status is not Status.OK or result.world_from_rig is None or not found.agrees.any():
        return result
    rig, chosen = RigQuery(cameras, query.rig_from_cams, [[] for _ in cameras]), np.flatnonzero(found.agrees)
    matches = Matches(found.camera[chosen], found.pixels[chosen], chosen)
    alike = len(matches) / max(rig.num_cells(matches), 1)
    problem = _Problem(rig, matches, found.points, max_error_deg, np.full(4, OWN_FOCAL_STD / np.sqrt(alike)))
    which = np.arange(problem.unknowns)
    free = (which < 6) | (which % 4 == 2)
    fitted = problem.fit(_Estimate(geometry.invert(result.world_from_rig), problem.unchanged), free)
    if fitted is None:
        return result
    unsure, sure = (problem.step(fitted, one, 1.0) for one in (free, which < 6))
    if unsure is None or sure is None:
        return result
    opened = alike * (unsure.covariance - sure.covariance)[:6, :6]
    focals = rig.focals_px * (1 + fitted.parameters[::4])
    text = f"focal length of the image {', '.join(f'{focal:.1f}' for focal in focals)} px"
    return replace(
        result,
        world_from_rig=geometry.invert(fitted.rig_from_world),
        covariance=None if result.covariance is None else result.covariance + opened,
        remark="; ".join(filter(None, [result.remark, text])),
    )


def _try_cameras(stated: "_Problem", start: "_Estimate", inliers: Bools) -> IntrinsicsCheck | None:
    """Return the check of stated cameras to which others are clearly preferable; None if there are no such others.

    The others have the principal point in the center of the image and, to start with, no distortion.

    Args:
        stated, start: the matches with the stated cameras, and the pose found with them.
        inliers: (K,) whether matches are inliers of the stated cameras, with small changes of the intrinsics.
    """

    def fit_of(inliers: Bools) -> float:
        """Return the odds of an inlier, times the cells that have one."""
        return stated.query.num_cells(stated.matches[inliers]) * int(inliers.sum()) / max(int((~inliers).sum()), 1)

    best, check = MORE * fit_of(inliers), None
    for share in FOCALS:
        cameras = [_simple(camera, share) for camera in stated.query.cameras]
        query = RigQuery(cameras, stated.query.rig_from_cams, [[] for _ in cameras])
        pose = query.ransac(stated.matches, stated.points, stated.max_error_deg, seed=0, max_trials=TRIALS)
        if pose is None:
            continue
        problem = _Problem(query, stated.matches, stated.points, stated.max_error_deg)
        fitted = problem.fit(_Estimate(pose, problem.unchanged), ~np.zeros(problem.unknowns, bool))
        if fitted is not None and (found := problem.inliers(fitted)).sum() > MIN_INLIERS and fit_of(found) > best:
            best = fit_of(found)
            changes = np.array(list(map(_change, stated.query.cameras, cameras, fitted.parameters.reshape(-1, 4))))
            # If it is nearly the stated camera, the fit will tell.
            focal, right, down, distortion = changes.T  # and how far they move pixels, relatively
            sizes = np.column_stack([np.abs(np.log1p(focal)), np.hypot(right, down), np.abs(distortion)])
            largest = np.where(sizes == sizes.max(axis=1, keepdims=True), 1.0, 0.0)
            check = IntrinsicsCheck(_motion(start, fitted), changes, largest) if sizes.max() > ABSURD else None
    return check


def _simple(camera: pycolmap.Camera, share: float) -> pycolmap.Camera:
    """Return a camera for the same images without distortion, with a focal length of a share of the longer side."""
    width, height = camera.width, camera.height
    params = [share * max(width, height), width / 2, height / 2]
    return pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)


def _change(stated: pycolmap.Camera, other: pycolmap.Camera, parameters: Floats) -> Floats:
    """Return `IntrinsicsCheck.parameters` (4,) from stated intrinsics to those at a change (4,) of another camera."""
    (focal_px, *center), (other_px, *other_center) = _stated([stated, other])
    center, other_center = np.array(center), other_center + other_px * parameters[1:3]
    corner = np.hypot(stated.width, stated.height) / 2 / focal_px
    seen = np.asarray(stated.img_from_cam(np.array([[corner, 0.0, 1.0]]))).ravel()
    distortion = float(np.nan_to_num(np.linalg.norm(seen - center) / (corner * focal_px) - 1, nan=-1.0))
    focal = other_px * (1 + parameters[0]) / focal_px - 1
    return np.array([focal, *((other_center - center) / focal_px), parameters[3] - distortion])


def _motion(start: "_Estimate", end: "_Estimate") -> Floats:
    """Return `IntrinsicsCheck.shift` (6,) from one pose to another."""
    return geometry.small_motions((start.rig_from_world @ geometry.invert(end.rig_from_world))[None])[0]


class _Estimate(NamedTuple):
    rig_from_world: Floats
    parameters: Floats
    """(4 C,) changes of the intrinsics, `IntrinsicsCheck.parameters` flattened."""


class _Step(NamedTuple):
    """A step of Gauss-Newton."""

    change: Floats
    """(U,) change of the unknowns."""
    largest_px: float
    """Largest weighted motion of a projection, per coordinate."""
    covariance: Floats
    """(U, U), 0 for unknowns that are not free."""
    freedom: int
    """Degrees of freedom."""

    def probability(self, values: Floats, tested: Bools) -> float:
        """Return the probability (F-test) that noise alone makes the tested ones of values (U,) this large."""
        values, covariance = values[tested], self.covariance[np.ix_(tested, tested)]
        squares = float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)
        return float(fdtrc(len(values), self.freedom, max(squares, 0.0) / len(values)))


class _Problem:
    """U unknowns, the pose and the intrinsics of a query, and the K matches to fit them to."""

    def __init__(
        self, query: RigQuery, matches: Matches, points: Floats, max_error_deg: float, prior_std: ArrayLike = PRIOR_STD
    ) -> None:
        self.query, self.matches, self.points, self.max_error_deg = query, matches, points, max_error_deg
        self._limits_px = np.tan(np.radians(max_error_deg)) * query.focals_px[matches.camera]
        self._prior = np.diag(np.concatenate([np.zeros(6), np.tile(1 / np.square(prior_std), len(query.cameras))]))
        self.unknowns = len(self._prior)
        self.unchanged = np.zeros(self.unknowns - 6)

    def linearize(self, estimate: _Estimate) -> tuple[Floats, Floats]:
        """Return residuals (K, 2), infinite behind a camera, and the Jacobian (K, 2, U) of the projections."""
        residuals = np.full((len(self.matches), 2), np.inf)
        jacobian = np.zeros((len(self.matches), 2, self.unknowns))
        in_rig = geometry.transform(estimate.rig_from_world, self.points[self.matches.point])
        for index, camera in enumerate(self.query.cameras):
            rows = np.flatnonzero(self.matches.camera == index)
            cam_from_rig = geometry.invert(self.query.rig_from_cams[index])
            in_cam = geometry.transform(cam_from_rig, in_rig[rows])
            projected = np.asarray(camera.img_from_cam(in_cam), np.float64).reshape(-1, 2)
            visible = (in_cam[:, 2] > 1e-3) & np.isfinite(projected).all(axis=1)
            rows, in_cam, projected = rows[visible], in_cam[visible], projected[visible]
            focal_px, changes = self.query.focals_px[index], estimate.parameters[4 * index : 4 * index + 4]
            offsets = projected - (camera.principal_point_x, camera.principal_point_y)
            corner_px2 = (camera.width**2 + camera.height**2) / 4
            of_intrinsics = np.zeros((len(rows), 2, 4))
            of_intrinsics[:, :, 0] = offsets
            of_intrinsics[:, 0, 1] = of_intrinsics[:, 1, 2] = focal_px
            of_intrinsics[:, :, 3] = offsets * ((offsets**2).sum(axis=1) / corner_px2)[:, None]
            residuals[rows] = self.matches.pixels[rows] - projected - of_intrinsics @ changes
            of_point = projection_jacobian(in_cam, np.full(len(rows), focal_px * (1 + changes[0])))
            of_point = of_point @ cam_from_rig[:3, :3]  # with the point in the rig frame
            # A motion of the rig moves a point in it by -(rotation x point) - translation.
            jacobian[rows, :, :3] = np.cross(of_point, in_rig[rows, None])
            jacobian[rows, :, 3:6] = -of_point
            jacobian[rows, :, 6 + 4 * index : 10 + 4 * index] = of_intrinsics
        return residuals, jacobian

    def step(self, estimate: _Estimate, free: Bools, widening: float) -> _Step | None:
        """Return the next step of the free unknowns (U,); None if the matches do not determine them.

        Inliers have errors up to `widening` times the limit.
        """
        residuals, jacobian = self.linearize(estimate)
        errors = np.linalg.norm(residuals, axis=1)
        inliers = errors < widening * self._limits_px
        freedom = 2 * int(inliers.sum()) - int(free.sum())
        if freedom < 1:
            return None
        errors = errors[inliers]
        # Square roots of the Cauchy weights.
        roots = 1 / np.sqrt(1 + (errors / max(float(np.median(errors)), MIN_SCALE_PX)) ** 2)
        weighted = roots[:, None, None] * jacobian[inliers][:, :, free]
        residuals = roots[:, None] * residuals[inliers]
        variance = float((residuals**2).sum()) / freedom
        prior = self._prior[np.ix_(free, free)]
        flat = weighted.reshape(-1, weighted.shape[2])
        information = flat.T @ flat + variance * prior
        if np.linalg.cond(information) > 1e14:
            return None
        inverse = np.linalg.inv(information)
        so_far = np.concatenate([np.zeros(6), estimate.parameters])[free]
        solved = inverse @ (flat.T @ residuals.ravel() - variance * (prior @ so_far))
        if not np.isfinite(solved).all():
            return None
        change, covariance = np.zeros(self.unknowns), np.zeros((self.unknowns, self.unknowns))
        change[free], covariance[np.ix_(free, free)] = solved, variance * inverse
        return _Step(change, float(np.abs(flat @ solved).max()), covariance, freedom)

    def fit(self, start: _Estimate, free: Bools) -> _Estimate | None:
        """Return the estimate at the minimum; each step selects inliers again. None if there is no minimum."""
        estimate = start
        for number in range(STEPS):
            step = self.step(estimate, free, WIDENINGS[number] if number < len(WIDENINGS) else 1.0)
            if step is None:
                return None
            motion = geometry.make_pose(Rotation.from_rotvec(step.change[:3]).as_matrix(), step.change[3:6])
            estimate = _Estimate(
                geometry.invert(motion) @ estimate.rig_from_world, estimate.parameters + step.change[6:]
            )
            if number >= len(WIDENINGS) and step.largest_px < SETTLED_PX:
                break
        return estimate

    def inliers(self, estimate: _Estimate) -> Bools:
        """Tell which matches (K,) are inliers."""
        return np.linalg.norm(self.linearize(estimate)[0], axis=1) < self._limits_px

    def check(self, start: _Estimate, fitted: _Estimate, free: Bools, noise_px: float) -> IntrinsicsCheck | None:
        """Return what fitted intrinsics say of the stated ones; None if noise alone may explain the difference.

        Args:
            start: the pose with the stated intrinsics.
            fitted: the estimate at the minimum.
            free: (U,) the unknowns that were fitted.
            noise_px: standard deviation of projections due to noise of the map's poses.
        """
        residuals, jacobian = self.linearize(fitted)
        errors = np.linalg.norm(residuals, axis=1)
        inliers = errors < self._limits_px
        observations, cameras = self.query.num_cells(self.matches[inliers]), len(self.query.cameras)
        freedom = 2 * observations - int(free.sum())
        if freedom < 1:
            return None
        errors = errors[inliers]
        weights = 1 / (1 + (errors / max(float(np.median(errors)), MIN_SCALE_PX)) ** 2)
        variance = float((weights * errors**2).sum()) / max(2 * len(errors) - int(free.sum()), 1)
        information = np.einsum("k,kia,kib->ab", weights, jacobian[inliers], jacobian[inliers])
        # The covariance if all errors in a cell are equal, and noise of the map's poses comes on top.
        excess = len(errors) / observations * (1 + noise_px**2 / variance)
        inverse = np.linalg.inv((information / variance + self._prior)[np.ix_(free, free)])
        covariance = np.zeros_like(information)
        covariance[np.ix_(free, free)] = excess * inverse @ information[np.ix_(free, free)] @ inverse / variance
        changes = np.concatenate([np.zeros(6), fitted.parameters])
        step = _Step(changes, 0.0, covariance, freedom)
        which = np.arange(self.unknowns)
        if step.probability(changes, free & (which >= 6)) > SIGNIFICANCE:
            return None
        by_chance, shares = np.ones((cameras, 3)), np.zeros((cameras, 3))
        for camera in range(cameras):
            for kind, columns in enumerate(([0], [1, 2], [3])):
                tested = np.isin(which, 6 + 4 * camera + np.array(columns)) & free
                if tested.any():
                    by_chance[camera, kind] = step.probability(changes, tested)
                    motion = np.linalg.solve(information[:6, :6], information[:6, tested] @ changes[tested])
                    sizes = np.degrees(np.linalg.norm(motion[:3])), np.linalg.norm(motion[3:])
                    shares[camera, kind] = max(np.divide(sizes, AGREEMENT))
        shares[~(by_chance <= max(SIGNIFICANCE, float(by_chance.min())))] = 0.0
        return IntrinsicsCheck(_motion(start, fitted), fitted.parameters.reshape(-1, 4), shares)
