"""Queries as localizers take them, in few words."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture import Session
from toolkit.features.features import LocalFeatures
from toolkit.features.stores import FeatureStore
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import NetworkMatches, Query, QueryResult, References, View

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def query_of(
    cameras: Sequence[pycolmap.Camera],
    rig_from_cams: Floats,
    features: Sequence[LocalFeatures | list[LocalFeatures] | str] = (),
    names: Sequence[str] = (),
    network_matches: Sequence[list[NetworkMatches | None]] = (),
) -> Query:
    """Return a query of which a localizer needs no pixels.

    Args:
        cameras: of the C images.
        rig_from_cams: (C, 4, 4).
        features: of each image; those of a single kind need no list.
        names: of the images; none: any.
        network_matches: see `Query`.
    """
    pixels = np.zeros((1, 1), np.uint8)
    names = names or [f"ios_query/raw_data/{index}.jpg" for index in range(len(cameras))]
    return Query(
        [View(name, pixels, camera, in_map=False) for name, camera in zip(names, cameras, strict=True)],
        np.asarray(rig_from_cams),
        [[of_image] if isinstance(of_image, LocalFeatures) else of_image for of_image in features],
        network_matches,
    )


def ask(
    localizer: Any,
    cameras: Sequence[pycolmap.Camera],
    rig_from_cams: Floats,
    features: Sequence[LocalFeatures | list[LocalFeatures] | str],
    references: Sequence[Sequence[int]],
    network_matches: Sequence[list[NetworkMatches | None]] = (),
    **more: Any,
) -> QueryResult:
    """Localize a query, see `query_of`, with the map images of the given indices as references of each image.

    Args:
        more: what else the localizer's `localize` takes by name: `prediction`, `priors`.
    """
    query = query_of(cameras, rig_from_cams, features, network_matches=network_matches)
    estimate: QueryResult = localizer.localize(query, [References.of(images) for images in references], **more)
    return estimate


def indices_of(names: Sequence[str]) -> list[int]:
    """Return the numbers of images named by them, such as 3 of `ios_map/raw_data/3.jpg`."""
    return [int(name.rpartition("/")[2].removesuffix(".jpg")) for name in names]


def rests_on(estimate: QueryResult) -> tuple[Ints, Floats, Ints]:
    """Return query image (K,), pixels (K, 2) and map point (K,) of the guided matches that the pose agrees with."""
    matches = estimate.correspondences
    kept = matches.agrees & np.char.endswith(matches.found_by, "/guided")
    return matches.camera[kept], matches.pixels[kept], matches.point_index[kept]


def session_query(
    session: Session, rows: Ints, local_map: LocalMap, count: int = 10, store: FeatureStore | None = None
) -> tuple[Query, list[References]]:
    """Return images of a query session with the map images that stand and look most alike.

    Args:
        session: with true poses.
        rows: of the images of one device at one instant.
        local_map: the map.
        count: references of each image.
        store: features of the session; None: the query has none.
    """
    references = []
    for pose in session.world_from_cam(rows, ground_truth=True):
        score = likeness(local_map.world_from_cams, pose)
        best = np.argsort(-score, kind="stable")[:count]
        references.append(References(best, score[best]))
    sensors = session.images["sensor_id"].astype(str).to_numpy()
    names = [session.image_name(int(row)) for row in rows]
    views = [
        View(name, session.image_path(int(row)), session.camera(sensors[row]), in_map=False)
        for name, row in zip(names, rows, strict=True)
    ]
    features = [] if store is None else [[store[name]] for name in names]
    return Query(views, session.rig_from_cam(rows), features), references


def likeness(world_from_cams: Floats, world_from_query: Floats) -> Floats:
    """Return for N poses (N, 4, 4) how near they are to a query's (4, 4), larger is nearer."""
    rotation_deg, distance_m = geometry.pose_error(world_from_cams, world_from_query[None])
    return np.asarray(-rotation_deg / 20 - distance_m)
