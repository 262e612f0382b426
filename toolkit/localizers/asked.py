"""Queries as a run asks them: their images, the features and matches that were stored, the references of each."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.capture import Session
from toolkit.capture.upright import Turns
from toolkit.features.stores import FeatureStore, MatchStore
from toolkit.files import image_name, read_references
from toolkit.geometry import Ints
from toolkit.localizers.base import NetworkMatches, PoseEstimate, Query, References, View
from toolkit.localizers.correspondences import LocalizedQuery

ReferencesOfImage = Mapping[tuple[int, str], References]
"""References of a query image, by its timestamp and sensor."""


def references_of_images(path: str | Path, index_of: Mapping[str, int]) -> dict[tuple[int, str], References]:
    """Return what a file of references says, in indices of map images; those that the map does not have are left out.

    Args:
        path: `retrieval/<pair>.jsonl`.
        index_of: index of a map image by its name.

    Raises:
        ArtifactError: see `files.read_references`.
    """
    found = {}
    for row in read_references(path):
        hits = [(image_name(hit["path"]), float(hit["score"])) for hit in row["topk"]]
        known = [(index_of[name], score) for name, score in hits if name in index_of]
        key = int(row["timestamp"]), str(row["sensor_id"])
        found[key] = References.of([index for index, _ in known], [score for _, score in known])
    return found


def stored_query(
    session: Session,
    rows: Ints,
    references: ReferencesOfImage,
    stores: Sequence[FeatureStore] = (),
    matches: Sequence[MatchStore | None] = (),
    turns: Turns | None = None,
) -> tuple[Query, list[References]]:
    """Return a query with the references of each of its images.

    Args:
        session: of the queries.
        rows: of the images of one device at one instant.
        references: of all query images; one that is not in it has none.
        stores: features of the session, one a kind; none: the query needs none.
        matches: of each kind the matches that a network made before, None where none did.
        turns: what makes images upright for a network that is shown them; None: they are shown as they are.
    """
    images = session.images.iloc[rows]
    keys = list(zip(images["timestamp"].tolist(), images["sensor_id"].tolist(), strict=True))
    of_rows = np.zeros(len(rows), int) if turns is None else turns.of(session, rows)
    names = [session.image_name(int(row)) for row in rows]
    views = [
        View(name, session.image_path(int(row)), session.camera(sensor), in_map=False, turns=int(turn))
        for row, name, (_, sensor), turn in zip(rows, names, keys, of_rows, strict=True)
    ]
    query = Query(
        views,
        session.rig_from_cam(rows),
        [_features(stores, name) for name in names] if stores else [],
        [_network_matches(matches, name) for name in names] if any(matches) else [],
    )
    return query, [references.get(key, References.of([])) for key in keys]


def localized_query(query: Query, estimate: PoseEstimate, image_names: Sequence[str]) -> LocalizedQuery:
    """Return what a pose rests on, with the names of its images.

    Args:
        image_names: of the map's images, as the localizer counts them.
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
