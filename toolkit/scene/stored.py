"""Queries as a run stored them: images, local features, matches and references."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from toolkit.capture import Session
from toolkit.errors import COMMAND, ArtifactError
from toolkit.features.stores import FeatureStore, MatchStore, features_path
from toolkit.files import image_name, read_references
from toolkit.geometry import Ints
from toolkit.pose.base import NetworkMatches, QueryInput, References
from toolkit.scene.map import WITHOUT_FEATURES, Map


class StoredQueries:
    """The queries of a session with what a run stored of them."""

    def __init__(self, session: Session, retrieval: str | Path) -> None:
        """Take the query session, and read the references of its images from `retrieval/<pair>.jsonl`."""
        self.session = session
        self.references = {
            (int(row["timestamp"]), str(row["sensor_id"])): [
                (image_name(hit["path"]), float(hit["score"])) for hit in row["topk"]
            ]
            for row in read_references(retrieval)
        }
        """Names and scores of the references of each query image, by timestamp and sensor id."""
        self.stores: list[FeatureStore] = []
        """Features of the session, one store per kind."""
        self.matches: list[MatchStore | None] = []
        """Per kind, the stored network matches, or None."""

    def open_features(self, scene_map: Map) -> None:
        """Open the features of the queries that a map's run has stored; raise ArtifactError if they are missing."""
        if scene_map.features_dir is None:
            return
        folder, session = scene_map.features_dir, self.session.id
        paths = [features_path(folder, session, kind.extractor.settings) for kind in scene_map.kinds]
        if missing := [path for path in paths if not path.exists()]:
            raise ArtifactError(
                f"{missing[0]}: no features of the queries. A run with the method `feed_forward` extracts none. To "
                f"change its method: {COMMAND} run MANIFEST --set localize.method=hybrid"
            )
        self.stores = [FeatureStore.open(path) for path in paths]

    def query(self, scene_map: Map, rows: Ints) -> QueryInput:
        """Return the query in rows of `session.images`, which one device took at one instant, and the references of
        each of its images in the map; an image without an entry has none.
        """
        query, images = scene_map.query_of_session(self.session, rows), self.session.images.iloc[rows]
        names, index_of = [view.name for view in query.views], scene_map.index_of
        stores = [] if scene_map.settings.method in WITHOUT_FEATURES else self.stores
        query = replace(
            query,
            features=[_features(stores, name) for name in names] if stores else [],
            network_matches=[_network_matches(self.matches, name) for name in names] if any(self.matches) else [],
        )
        references = []
        for key in zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True):
            found = [(index_of[name], score) for name, score in self.references.get(key, []) if name in index_of]
            references.append(References.of([index for index, _ in found], [score for _, score in found]))
        return query, references


def _features(stores: Sequence[FeatureStore], name: str) -> Any:
    missing = [store for store in stores if name not in store]
    if missing:
        return next((store.failed[name] for store in missing if name in store.failed), "no features")
    return [store[name] for store in stores]


def _network_matches(matches: Sequence[MatchStore | None], name: str) -> list[NetworkMatches | None]:
    def of(store: MatchStore) -> NetworkMatches:
        return lambda reference: store[name, reference]

    return [None if store is None else of(store) for store in matches]
