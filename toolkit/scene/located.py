"""A query in its map: what references, matches and results need to show themselves, and to be tried with changes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap

from toolkit.errors import COMMAND, ArtifactError, ManifestError
from toolkit.geometry import Floats
from toolkit.manifest import nearest
from toolkit.manifest.loading import nested
from toolkit.pose.base import Query, QueryMatches, References, RoughPose
from toolkit.pose.pnp import PnpMatches
from toolkit.pose.result import QueryResult
from toolkit.results.localized import ShownImage
from toolkit.scene.query import with_focal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from toolkit.figures.answers import Answer, Comparison
    from toolkit.viewer.inline import View3D

Map = Any
"""A `scene.map.Map`, which imports this module."""
CHANGEABLE = ("localize", "retrieve.topk")
"""Sections and keys of a manifest that can be changed for one query."""


class Retrieved(list[References]):
    """The references of each image of a query. A notebook displays them as a figure."""

    def __init__(self, scene_map: Map, query: Query, references: Sequence[References] = ()) -> None:
        super().__init__(references)
        self._map, self._query = scene_map, query

    def names(self, image: int = 0) -> list[str]:
        """Return the names of the references of one image of the query, best first."""
        return [self._map.localizer.image_names[index] for index in self[image].images]

    def _repr_html_(self) -> str:
        from toolkit.figures.query_images import draw_query_and_references
        from toolkit.figures.style import picture_of, zoomable

        of_query = [self._paths(image) for image in range(len(self))]
        figure = draw_query_and_references([view.image for view in self._query.views], of_query)
        return zoomable(picture_of(figure), "references of the query")

    def _paths(self, image: int) -> list[tuple[Any, float]]:
        files = map(self._map.capture.image_path, self.names(image))
        return list(zip(files, self[image].scores.tolist(), strict=True))


class Located:
    """A query in its map. What needs the map or features is opened when it is first asked for."""

    def __init__(
        self,
        answer: Callable[[QueryResult], "Answer"],
        open_query: Callable[[], tuple[Map, Query, Sequence[References]]],
    ) -> None:
        """`answer` returns how the query was localized, given one of its results; `open_query` what is needed to do it
        again.
        """
        self.answer, self.open = answer, open_query

    def __deepcopy__(self, memo: Any) -> "Located":
        """Return itself: copies of a result share the map."""
        return self

    @cached_property
    def _opened(self) -> tuple[Map, Query, Sequence[References]]:
        return self.open()

    def show_3d(self, results: Sequence[QueryResult], rays: bool = False) -> "View3D":
        """See `QueryResult.show_3d`."""
        from toolkit.viewer.inline import View3D

        return View3D.of([result.show() for result in results], rays)

    def what_if(
        self,
        result: QueryResult,
        changes: Mapping[str, Any],
        *,
        references: Sequence[str] | None = None,
        drop: Sequence[int | str] = (),
        focal_px: float | None = None,
        camera: pycolmap.Camera | None = None,
        near: RoughPose | None = None,
    ) -> "Comparison":
        """Localize the query again with something changed. Nothing is written.

        Args:
            result: the result to compare with.
            changes: settings by their keys in the manifest: `{"localize.pnp.max_error_deg": 0.1, "retrieve.topk": 5}`.
                Points of features that the map does not have, or of other settings of the map, are triangulated from
                the references of this query.
            references: names of map images, or unique ends of names, to use instead of the retrieved ones.
            drop: references to leave out, by rank from 1, or by name.
            focal_px: focal length of the query's cameras, pixels.
            camera: intrinsics of the query's images.
            near: a rough pose of the query.

        Returns:
            The answer before and the one after.

        Raises:
            ManifestError: a setting does not exist, or cannot change for one query.
            ArtifactError: no map image has a name; or features, weights or files of the run are missing.
            CameraError: the camera does not fit the image.
        """
        from toolkit.figures.answers import Comparison

        scene_map, query, found = self._opened
        sections = nested(changes)
        for section in sections.keys() - {"localize", "retrieve"}:
            raise ManifestError(
                f"{section}: cannot change for one query. {nearest(section, CHANGEABLE)} "
                f"To change it for all queries: {COMMAND} run MANIFEST --set {section}..."
            )
        retrieval = dict(sections.get("retrieve", {}))
        k = retrieval.pop("topk", None)
        if retrieval or not (k is None or (isinstance(k, int) and k > 0)):
            raise ManifestError.at("retrieve", sections["retrieve"], "topk alone, above 0, for one query")
        other = scene_map.changed(sections.get("localize", {}))
        cameras = [camera or view.camera for view in query.views]
        if camera is not None or focal_px is not None:
            cameras = cameras if focal_px is None else [with_focal(one, focal_px) for one in cameras]
            views = [replace(view, camera=one) for view, one in zip(query.views, cameras, strict=True)]
            query = replace(query, views=views)
        if k is not None:
            found = scene_map.retrieve(query, k)
        extracted = [[kind.extractor.settings for kind in of_map.kinds] for of_map in (scene_map, other)]
        query = replace(query, features=query.features if extracted[0] == extracted[1] else [], network_matches=[])
        if references is not None:
            images = [scene_map.find_image(name) for name in references]
            found = [References.of(images)] * len(query.views)
        dropped = [scene_map.find_image(name) for name in drop if not isinstance(name, int)]
        at = [rank - 1 for rank in drop if isinstance(rank, int)]
        found = [
            retrieved.take(~np.isin(retrieved.images, dropped) & ~np.isin(np.arange(len(retrieved.images)), at))
            for retrieved in found
        ]
        again = other.locate(query, near, [_in(other, scene_map, retrieved) for retrieved in found])
        said = {
            "references": references,
            "drop": list(drop),
            "focal_px": focal_px,
            "camera": camera and f"{camera.model_name} {camera.params_to_string()}",
            "near": near and "a rough pose",
        }
        before, retrieved = self.answer(result), ranks(scene_map, found)
        after = replace(before, result=again, settings=other.settings, views=query.views, retrieved=retrieved)
        return Comparison(before, after, {**changes, **{name: value for name, value in said.items() if value}})


def ranks(scene_map: Map, references: Sequence[References]) -> dict[str, tuple[int, float]]:
    """Return the best rank, from 1, and the score of each reference by its name, best first."""
    names = scene_map.localizer.image_names
    return best_ranks(
        [(names[image], score) for image, score in zip(found.images.tolist(), found.scores.tolist(), strict=True)]
        for found in references
    )


def best_ranks(references: Iterable[Iterable[tuple[str, float]]]) -> dict[str, tuple[int, float]]:
    """Return the best rank, from 1, and the score of each reference by its name, best first, of the names and scores of
    the references of each image of a query, best first.
    """
    best: dict[str, tuple[int, float]] = {}
    for of_image in references:
        for rank, (name, score) in enumerate(of_image, start=1):
            best[name] = min(best.get(name, (rank, score)), (rank, score), key=lambda one: (one[0], -one[1]))
    return dict(sorted(best.items(), key=lambda item: item[1][0]))


def _in(other: Map, scene_map: Map, references: References) -> References:
    """Return references of one map as those of another map of the same session, without images that it lacks."""
    names = [scene_map.localizer.image_names[index] for index in references.images]
    indices = np.array([other.index_of.get(name, -1) for name in names], np.int64)
    return References(indices, references.scores).take(indices >= 0)


def show_matches(scene_map: Map, matches: QueryMatches, rank: int, image: int) -> "Figure":
    """Draw the matches by descriptors of one image of a query with one of its references; see `Map.show_matches`."""
    from toolkit.figures.query_images import draw_pair

    found = matches.references[image].images.tolist() if 0 <= image < len(matches.references) else list[int]()
    if not isinstance(matches, PnpMatches) or not 0 < rank <= len(found) or image not in matches.usable:
        raise ArtifactError(
            f"image {image}, reference {rank}: found no matches. Expected an image with features from 0 to "
            f"{len(matches.references) - 1}, a reference from 1 to {len(found)}, and a method that matches keypoints."
        )
    at, index, matcher = matches.usable.index(image), found[rank - 1], matches.localizer.matcher
    alone = [References.of([index] if number == at else []) for number in range(len(matches.usable))]
    of_pair = matches.with_references(alone)
    seen, pixels = matcher.keypoints(index, of_pair.point)
    name, view = matches.localizer.image_names[index], matches.query.views[image]
    row, both = scene_map.session.row_of_name[name], np.arange(len(seen))
    ways = np.char.add(matcher.kind_names(of_pair.point[seen]), "/descriptors")

    def shown(name: str, file: Any, camera: pycolmap.Camera, at: Floats) -> ShownImage:
        points = np.zeros((len(seen), 3))
        agrees = np.ones(len(seen), bool)
        return ShownImage(name, file, camera, np.eye(4), at, points, both, agrees, found_by=ways)

    reference = shown(name, scene_map.session.image_path(row), scene_map.session.cameras([row])[0], pixels)
    query = shown(view.name, view.image, view.camera, of_pair.pixels[seen])
    return draw_pair(query, reference, f"{len(seen)} matches by descriptors with reference {rank}")
