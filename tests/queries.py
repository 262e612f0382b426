"""Queries as localizers take them, in few words."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.features.features import LocalFeatures
from toolkit.localizers.base import NetworkMatches, PoseEstimate, Query, References, View

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
) -> PoseEstimate:
    """Localize a query, see `query_of`, with the map images of the given indices as references of each image.

    Args:
        more: what else the localizer's `localize` takes by name: `prediction`, `priors`.
    """
    query = query_of(cameras, rig_from_cams, features, network_matches=network_matches)
    estimate: PoseEstimate = localizer.localize(query, [References.of(images) for images in references], **more)
    return estimate


def rests_on(estimate: PoseEstimate) -> tuple[Ints, Floats, Ints]:
    """Return query image (K,), pixels (K, 2) and map point (K,) of the guided matches that the pose agrees with."""
    matches = estimate.correspondences
    kept = matches.inlier & np.char.endswith(matches.found_by, "/guided")
    return matches.camera[kept], matches.pixels[kept], matches.point_index[kept]
