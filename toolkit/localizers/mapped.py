"""The features of one kind that a map's points are seen by, and a query's matched with them."""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from toolkit.features.features import KINDS, FeatureKind, LocalFeatures
from toolkit.features.matching import Matcher, MutualMatcher, PairMatches
from toolkit.localizers.mapping import LocalMap

Ints = NDArray[np.int64]

CACHED_IMAGES = 256
"""Map images whose features are kept in memory."""


@dataclass(frozen=True)
class MapImage:
    """The features of a map image that see a point, longest tracks first."""

    features: LocalFeatures
    points: Ints
    """(N,) the map point that each sees."""


Known = Callable[[str], PairMatches]
"""Returns the matches of a query image with a map image, given by its name, that were made before."""


class MappedFeatures:
    """One kind of local features of a map. Safe to use from several threads; the map is never changed."""

    def __init__(
        self,
        local_map: LocalMap,
        features: Mapping[str, LocalFeatures],
        kind: FeatureKind = KINDS["sift"],
        matcher: Matcher | None = None,
    ):
        """
        Args:
            local_map: triangulated from these features.
            features: of the map's images, by name.
            kind: what is peculiar to these features.
            matcher: of a query with a reference; None: mutual nearest neighbors, as suits the kind.
        """
        self.map = local_map
        self.features = features
        self.kind = kind
        self.matcher = matcher or MutualMatcher(kind.ratio, kind.min_score)
        self._cache: OrderedDict[tuple[int, int], MapImage] = OrderedDict()
        self._lock = Lock()
        self._one_at_a_time = Lock()

    def match(
        self,
        query: LocalFeatures,
        references: Sequence[str],
        max_query_features: int,
        max_map_features: int,
        known: Known | None = None,
    ) -> tuple[Ints, Ints]:
        """Match a query image with references; returns keypoints of the query and map points, each (K,).

        Args:
            query: its features.
            references: names of map images; those that the map does not have give no match.
            max_query_features: features of the query that `mutual` is given, the strongest.
            max_map_features: features of a map image that `mutual` is given, those of the longest tracks.
            known: matches that a network has made before.
        """
        indices = [index for name in references if (index := self.map.index_of.get(name)) is not None]
        if isinstance(self.matcher, MutualMatcher):
            query = query.take(slice(max_query_features))
            members = [self.image(index, max_map_features) for index in indices]
            found = self.matcher.match([(query, member.features) for member in members])
            points = [member.points for member in members]
        else:  # a network looks at a feature among its neighbors, those without a point too
            names = [self.map.image_names[index] for index in indices]
            if known is not None:
                found = [known(name) for name in names]
            else:
                with self._one_at_a_time:
                    found = self.matcher.match([(query, self.features[name]) for name in names])
            points = [self._point_of_each_feature(index) for index in indices]
        nothing = np.zeros(0, np.int64)
        keypoint = np.concatenate([nothing, *(one.indices[:, 0] for one in found)])
        point = np.concatenate([nothing, *(of[one.indices[:, 1]] for of, one in zip(points, found, strict=True))])
        return keypoint[point >= 0], point[point >= 0]

    def image(self, index: int, max_features: int) -> MapImage:
        """Return the features of a map image that see points, those of the longest tracks."""
        key = (index, max_features)
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        keypoint, point = self.map.observations(index)
        order = np.argsort(-self.map.track_lengths[point], kind="stable")[:max_features]
        image = MapImage(self.features[self.map.image_names[index]].take(keypoint[order]), point[order])
        with self._lock:
            self._cache[key] = image
            if len(self._cache) > CACHED_IMAGES:
                self._cache.popitem(last=False)
        return image

    def _point_of_each_feature(self, index: int) -> Ints:
        """Return the point that each feature of a map image sees, -1 for none."""
        keypoint, point = self.map.observations(index)
        points = np.full(len(self.features[self.map.image_names[index]]), -1, np.int64)
        points[keypoint] = point
        return points
