"""The features of one kind that a map's points are seen by, and a query's matched with them."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from toolkit.features import KINDS, FeatureKind, LocalFeatures
from toolkit.mapping import LocalMap
from toolkit.matching import Matcher, MutualMatcher

Ints = NDArray[np.int64]

CACHED_IMAGES = 256
"""Map images whose features are kept in memory."""


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
    ):
        """
        Args:
            local_map: triangulated from these features.
            features: of the map's images, by name.
            kind: what is peculiar to these features.
            matcher: of a query with a reference; None: mutual nearest neighbours, as suits the kind.
        """
        self.map = local_map
        self.features = features
        self.kind = kind
        self.matcher = matcher or MutualMatcher(kind.ratio, kind.min_score)
        self._cache: OrderedDict[tuple[int, int], MapImage] = OrderedDict()
        self._lock = Lock()

    def match(
        self, query: LocalFeatures, references: Sequence[int], max_query_features: int, max_map_features: int
    ) -> tuple[Ints, Ints]:
        """Match a query image with references; returns keypoints of the query and map points, each (K,).

        Args:
            query: its features.
            references: map images.
            max_query_features: features of the query that are matched, the strongest.
            max_map_features: features of a map image that are matched, those of the longest tracks.
        """
        query = query.take(slice(max_query_features))
        members = [self.image(int(reference), max_map_features) for reference in references]
        found = self.matcher.match([(query, member.features) for member in members])
        keypoints = [matches.indices[:, 0] for matches in found]
        points = [member.points[matches.indices[:, 1]] for member, matches in zip(members, found, strict=True)]
        nothing = np.zeros(0, np.int64)
        return np.concatenate([nothing, *keypoints]), np.concatenate([nothing, *points])

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
