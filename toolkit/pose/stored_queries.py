"""Read queries from what a run stored: images, local features, matches and references."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.capture import Session
from toolkit.capture.upright import Turns
from toolkit.features.stores import FeatureStore, MatchStore
from toolkit.files import image_name, read_references
from toolkit.geometry import Ints
from toolkit.pose.base import NetworkMatches, PoseEstimate, Query, References, View
from toolkit.pose.correspondences import LocalizedQuery

ReferencesOfImage = Mapping[tuple[int, str], References]
"""References of each query image, by timestamp and sensor id."""


def references_of_images(path: str | Path, index_of: Mapping[str, int]) -> dict[tuple[int, str], References]:
    """Read the references of query images, without those that are not in the map.

    Args:
        path: `retrieval/<pair>.jsonl`.
        index_of: index of each map image by name.

    Raises:
        ArtifactError: see `files.read_references`.
    """
    references = {}
    for row in read_references(path):
        hits = [(image_name(hit["path"]), float(hit["score"])) for hit in row["topk"]]
        in_map = [(index_of[name], score) for name, score in hits if name in index_of]
        key = int(row["timestamp"]), str(row["sensor_id"])
        references[key] = References.of([index for index, _ in in_map], [score for _, score in in_map])
    return references


def stored_query(
    session: Session,
    rows: Ints,
    references: ReferencesOfImage,
    stores: Sequence[FeatureStore] = (),
    matches: Sequence[MatchStore | None] = (),
    turns: Turns | None = None,
) -> tuple[Query, list[References]]:
    """Return a query and the references of each of its images.

    Args:
        session: the query session.
        rows: rows of `session.images` that one device took at one instant.
        references: references of all query images; an image without an entry has none.
        stores: features of the session, one store per kind; empty if the localizer needs no features.
        matches: per kind, the stored network matches, or None.
        turns: turns that make images upright for a network; None shows them as stored.
    """
    images = session.images.iloc[rows]
    keys = list(zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True))
    row_turns = np.zeros(len(rows), int) if turns is None else turns.of(session, rows)
    names = [session.image_name(int(row)) for row in rows]
    views = [
        View(name, session.image_path(int(row)), session.camera(sensor), in_map=False, turns=int(turn))
        for row, name, (_, sensor), turn in zip(rows, names, keys, row_turns, strict=True)
    ]
    query = Query(
        views,
        session.rig_from_cam(rows),
        [_features(stores, name) for name in names] if stores else [],
        [_network_matches(matches, name) for name in names] if any(matches) else [],
    )
    return query, [references.get(key, References.of([])) for key in keys]


def localized_query(query: Query, estimate: PoseEstimate, image_names: Sequence[str]) -> LocalizedQuery:
    """Return the correspondences of an estimate, with image names instead of indices.

    Args:
        image_names: `Localizer.image_names`.
    """
    return LocalizedQuery(
        [view.name for view in query.views],
        [image_names[index] for index in estimate.references],
        [image_names[index] for index in estimate.rejected],
        estimate.correspondences,
        estimate.rivals,
    )


def _features(stores: Sequence[FeatureStore], name: str) -> Any:
    missing = [store for store in stores if name not in store]
    if missing:
        return next((store.failed[name] for store in missing if name in store.failed), "no features")
    return [store[name] for store in stores]


def _network_matches(matches: Sequence[MatchStore | None], name: str) -> list[NetworkMatches | None]:
    def of(store: MatchStore) -> NetworkMatches:
        return lambda reference: store[name, reference]

    return [None if store is None else of(store) for store in matches]
