"""A query from any images with cameras, and checks of what a person gives; the references of an image in the map of a
finished run, found as its stages embed, retrieve and rerank do; and what references, matches and results need to show
themselves, and to be tried with changes.
"""

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.capture import Session
from toolkit.capture.images import (
    GuessedCamera,
    camera_text,
    exif_camera,
    exif_key,
    find_mask,
    parse_camera,
    read_header,
    stored_size,
    turn_image,
)
from toolkit.embedders import Embedder, Vectors, create_embedder, embedding_folders, open_descriptors, shows_upright
from toolkit.embedders.search import VectorIndex, embedder_fingerprint, fuse, load_index, search
from toolkit.errors import COMMAND, ArtifactError, CameraError, ImageError, ManifestError
from toolkit.features.features import KINDS, SiftExtractor, usable
from toolkit.features.matching import LocalMethod, Verifier, create_local_methods
from toolkit.features.stores import FeatureStore
from toolkit.files import SceneFiles, image_name
from toolkit.geometry import Floats, unit
from toolkit.manifest import EmbedSettings, RerankSettings, RetrieveSettings, nearest
from toolkit.manifest.manifest import nested
from toolkit.pose.base import Query, QueryMatches, QueryResult, References, RoughPose, View
from toolkit.pose.pnp import PnpMatches
from toolkit.results.localized import ShownImage
from toolkit.results.pair import read_settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from toolkit.figures.answers import Answer, Comparison
    from toolkit.viewer.queries import View3D

_MAX_DEVIATION = 1e-3
"""Largest deviation of R @ R.T from the identity for a rotation R; rounding to float32 or in files stays below."""
FOCAL_PRIOR = 1.2  # focal length of a camera that nothing is known of, in multiples of the longer side
Image = Any
"""A file (str, Path), or pixels as `pixels_from` takes them."""
Map = Any
"""A `scene.map.Map`, which imports this module."""
CHANGEABLE = ("localize", "retrieve.topk")
"""Sections and keys of a manifest that can be changed for one query."""
MAX_IN_MEMORY = 1 << 30
"""Largest size in bytes of global descriptors (float64) that an open map keeps in memory; larger ones stay on disk."""
Ranked = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Rows (k,) of map images in their session, best first, and their scores (k,)."""


def query_from(
    image: Image | Sequence[Image],
    camera: pycolmap.Camera | Sequence[pycolmap.Camera],
    rig_from_cams: NDArray[np.float64] | None = None,
    turns: Sequence[int] | None = None,
) -> Query:
    """Return a query of one image, or of those that the cameras of a rig took at one instant.

    Args:
        image: a file, which may have a mask, see `find_mask`; or pixels as `pixels_from` takes them; for a rig, a
            sequence of C images.
        camera: intrinsics, with the size of the image; for a rig, a sequence of C cameras.
        rig_from_cams: (C, 4, 4), for a rig.
        turns: for each image, the counter-clockwise quarter turns that bring gravity down; None: all are upright.
            Only learned embedders and networks use them.

    Raises:
        ImageError: an image is neither a file nor pixels.
        CameraError: an invalid camera, pose or turn. It is an ImageError.
    """
    images = list(image) if _are_several(image) else [image]
    cameras: list[Any] = list(camera) if isinstance(camera, list | tuple) else [camera]
    for intrinsics in cameras:
        _check_camera(intrinsics)
    poses = np.eye(4)[None] if rig_from_cams is None else _poses(rig_from_cams)
    quarter_turns = [0] * len(cameras) if turns is None else _turns(turns)
    if not 0 < len(images) == len(cameras) == len(poses) == len(quarter_turns):
        raise CameraError(
            f"Found {len(images)} images, {len(cameras)} cameras, {len(poses)} rig_from_cams and "
            f"{len(quarter_turns)} turns: expected the same number of each, and at least one."
        )
    pixels = [Path(one) if isinstance(one, str | Path) else pixels_from(one) for one in images]
    numbered = enumerate(zip(pixels, cameras, quarter_turns, strict=True), start=1)
    masks = [find_mask(one) if isinstance(one, Path) else None for one in pixels]
    views = [View(f"image {k}", image, one, False, turn, masks[k - 1]) for k, (image, one, turn) in numbered]
    return Query(views, poses)


def pixels_from(image: Any) -> NDArray[np.uint8]:
    """Return the pixels, (H, W) or (H, W, 3) RGB uint8, of an image in one of the forms that other libraries use.

    Args:
        image: an array or tensor (H, W), (H, W, 1), (H, W, 3), (1, H, W) or (3, H, W), a nest of lists, or a Pillow
            image. uint8 and other integers from 0 to 255; uint16 from 0 to 65535; floats from 0 to 1 or, if one is
            larger, to 255; bool. uint16 up to 255 counts as uint8.

    Raises:
        ImageError: anything else.
    """
    expected = "Expected a file or the pixels of an image: (H, W) or (H, W, 3) RGB, uint8."
    if hasattr(image, "getbands"):  # a Pillow image
        image = image if image.mode in ("1", "L", "RGB", "F") or image.mode.startswith("I") else image.convert("RGB")
    try:
        pixels = np.asarray(image)
    except (ValueError, TypeError, RuntimeError) as error:  # lists of different lengths; a tensor on a GPU
        raise ImageError(f"Found a {type(image).__name__} that is not an array ({error}). {expected}") from None
    found = f"a {type(image).__name__} of pixels {pixels.shape} {pixels.dtype}"
    if pixels.ndim == 3 and pixels.shape[0] in (1, 3) and pixels.shape[2] not in (1, 3):
        pixels = np.moveaxis(pixels, 0, 2)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    shape_fits = pixels.ndim in (2, 3) and pixels.shape[2:] in ((), (3,)) and pixels.size
    if not shape_fits or pixels.dtype.kind not in "buif":
        raise ImageError(f"Found {found}. {expected}")
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == bool:
        return pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype == np.uint16 and pixels.max() > 255:  # up to 255, a library has put 8 bits into 16
        return (pixels >> 8).astype(np.uint8)  # as a 16-bit file is decoded
    low, high = pixels.min(), pixels.max()
    if not (low >= 0 and high <= 255):
        raise ImageError(f"Found {found} from {low:g} to {high:g}; expected 0 to 1, or 0 to 255.")
    scale = 255 if pixels.dtype.kind == "f" and high <= 1 else 1
    return np.round(pixels * scale).astype(np.uint8)


def guessed_camera(image: Image, known: Sequence[pycolmap.Camera]) -> GuessedCamera:
    """Return a camera of an image whose focal length is from EXIF, the only known one of its size, or a guess.

    Raises:
        ImageError: the image cannot be read.
    """
    is_file = isinstance(image, str | Path)
    if is_file:
        try:
            return exif_camera(Path(image))
        except ImageError:  # no focal length, or no image, which the next line says
            width, height = stored_size(image)
    else:
        height, width = pixels_from(image).shape[:2]
    alike = {camera_text(camera): camera for camera in known if (camera.width, camera.height) == (width, height)}
    if len(alike) == 1:
        return GuessedCamera(next(iter(alike.values())), "that of the map's camera")
    params = [FOCAL_PRIOR * max(width, height), width / 2, height / 2]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)
    return GuessedCamera(camera, f"a guess, {FOCAL_PRIOR:g} times the longer side")


def camera_key(image: Image, camera: pycolmap.Camera) -> tuple[Any, ...]:
    """Return what images of one camera have in common: size, and what EXIF says of the camera."""
    exif = read_header(Path(image))[1] if isinstance(image, str | Path) else {}
    return camera.width, camera.height, *exif_key(exif)


def with_focal(camera: pycolmap.Camera, focal_px: float) -> pycolmap.Camera:
    """Return a camera with another focal length, in x, pixels."""
    params = np.array(camera.params)
    params[list(camera.focal_length_idxs())] *= focal_px / camera.mean_focal_length()
    return pycolmap.Camera(model=camera.model.name, width=camera.width, height=camera.height, params=params.tolist())


def _are_several(image: Any) -> bool:
    """Tell whether this is a sequence of images rather than one image, which may be nested lists of numbers."""
    return isinstance(image, list | tuple) and not (image and isinstance(image[0], list | tuple | int | float))


def _check_camera(camera: Any) -> None:
    """Raise CameraError if an object is not a camera with valid intrinsics."""
    if not isinstance(camera, pycolmap.Camera):
        raise CameraError(
            f"camera: found {camera!r}, a {type(camera).__name__}; expected a pycolmap.Camera. To make one: "
            "parse_camera('camera', 'PINHOLE, 640, 480, 500, 500, 320, 240') of toolkit.capture."
        )
    try:
        parse_camera("camera", camera_text(camera))
    except ValueError as error:
        raise CameraError(f"camera: {error}") from None


def _poses(rig_from_cams: Any) -> NDArray[np.float64]:
    """Return the poses of a rig, (C, 4, 4), after checking that their rotations neither scale nor mirror."""
    try:
        poses = np.asarray(rig_from_cams, np.float64)
    except (ValueError, TypeError):
        raise CameraError(f"rig_from_cams: found {rig_from_cams!r}, expected (C, 4, 4) numbers.") from None
    if poses.shape[-2:] != (4, 4) or not np.isfinite(poses).all():
        raise CameraError(f"rig_from_cams: found {poses.shape}, expected (C, 4, 4) finite numbers, a pose per camera.")
    poses = poses.reshape(-1, 4, 4)
    rotations = poses[:, :3, :3]
    deviations = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(axis=(1, 2))
    deviations = np.maximum(deviations, np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1))
    for number in np.flatnonzero((deviations > _MAX_DEVIATION) | (np.linalg.det(rotations) < 0))[:1].tolist():
        raise CameraError(
            f"rig_from_cams: found no pose for image {number + 1}: {poses[number].tolist()}. Expected a rotation, "
            "which neither scales nor mirrors, a translation, and 0, 0, 0, 1 in the last row."
        )
    return poses


def _turns(turns: Any) -> list[int]:
    try:
        return [operator.index(turn) for turn in turns]
    except TypeError:
        raise CameraError(f"turns: found {turns!r}, expected whole numbers of quarter turns, one per image.") from None


# A query in its map


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
        from toolkit.viewer.queries import View3D

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


# The search for references


class ReferenceSearch:
    """The embedders of a finished run, and the descriptors of its map images."""

    def __init__(self, files: SceneFiles, session: Session, reranked: bool) -> None:
        """Take the files of the run, the map session, and whether the run localized with reranked references."""
        self.files, self.session, self.reranked = files, session, reranked

    def load(self) -> None:
        """Load what all queries share, before several threads find it missing: `cached_property` has no lock."""
        _ = self.embedders, self._descriptors, self._index
        if self.reranked:
            _ = self._verification

    @property
    def shows_upright(self) -> bool:
        """Whether the run turned images upright for an embedder, or for the features that it reranked with."""
        upright = any(shows_upright(embedder, self.embed_settings.upright) for embedder in self.embedders)
        return upright or (self.reranked and KINDS[self._verification[0].name].upright)

    def describe(self, query: Query, kinds: Sequence[LocalMethod]) -> list[NDArray[np.float32]]:
        """Return for each embedder the global descriptors (C, D) of a query's images; `kinds` are its features."""
        return [embedder.embed(self._inputs(embedder, query, kinds)) for embedder in self.embedders]

    def _inputs(self, embedder: Embedder, query: Query, kinds: Sequence[LocalMethod]) -> list[Any]:
        if embedder.inputs != "features":
            turned, side = shows_upright(embedder, self.embed_settings.upright), embedder.least_side
            images = (turn_image(view.read(True, side), view.turns if turned else 0) for view in query.views)
            return [embedder.prepare(image) for image in images]
        sift, settings = self._sift, [kind.extractor.settings for kind in kinds]
        if query.features and sift.settings in settings:  # the embedder can use the features of the localizer
            at = settings.index(sift.settings)
            return [features[at] for features in query.features if not isinstance(features, str)]
        extracted = sift.extract([view.read(color=False) for view in query.views])
        views = zip(extracted, query.views, strict=True)
        return [usable(features, view.mask, view.camera) for features, view in views]

    @cached_property
    def _sift(self) -> SiftExtractor:
        return SiftExtractor()

    def find(
        self, query: Query, k: int | None = None, allowed: Sequence[NDArray[np.bool_] | None] = ()
    ) -> list[Ranked]:
        """Return the references of each image of a query with the descriptors of `describe`, as the run would find
        them.

        By default, there are `k` as in the run; `allowed` has, for each image, a mask over the rows `rows`, or None.
        Raise ArtifactError if the map was embedded by another embedder.
        """
        for embedder, described, dim in zip(self.embedders, query.descriptors, self._stored[0].dims, strict=True):
            if described.shape[1] != dim:
                raise ArtifactError(
                    f"{self.files.embeddings}: found descriptors of {dim} dimensions for the map, expected "
                    f"{described.shape[1]} of {embedder.name}. Run the embed stage again."
                )
        searched = np.hstack([self._as_searched(vectors) for vectors in query.descriptors])
        topk = self.retrieve_settings.topk if k is None or self.reranked else k
        masks = list(allowed) or [None] * len(searched)
        ranked = [self._nearest(vector, topk, mask) for vector, mask in zip(searched, masks, strict=True)]
        if self.reranked:
            ranked = [self._rerank(of_image, view) for of_image, view in zip(ranked, query.views, strict=True)]
        return [(of_image[:k], scores[:k]) for of_image, scores in ranked]

    def _nearest(self, vector: NDArray[np.float32], k: int, allowed: NDArray[np.bool_] | None) -> Ranked:
        """Return the k map images that are most similar to a vector, with the scores and in the order of `search`."""
        of_map, rows, dims = self._descriptors, self.rows, self._stored[0].dims
        if self._index is not None or isinstance(of_map, Vectors):
            found = search(vector[None], of_map, k, "torch", "cpu", index=self._index, allowed=allowed, dims=dims)
            scores, nearest = (of_vector[0, found[1][0] >= 0] for of_vector in found)
            return rows[nearest], scores.astype(np.float64)
        ends = np.cumsum(dims)[:-1]
        parts = zip(np.split(of_map, ends, axis=1), np.split(vector.astype(np.float64), ends), strict=True)
        products = [np.einsum("nd,d->n", descriptors, described) for descriptors, described in parts]
        scores = (products[0] if len(products) == 1 else fuse(products)).astype(np.float32)
        if not np.isfinite(scores).all():
            raise ValueError("The descriptors of the query or of the map have NaN or infinite values.")
        candidates = np.arange(len(rows)) if allowed is None else np.flatnonzero(allowed)
        nearest = candidates[np.argsort(-scores[candidates], kind="stable")[:k]]
        return rows[nearest], scores[nearest].astype(np.float64)

    def _rerank(self, ranked: Ranked, view: View) -> Ranked:
        """Return rows of map images and their numbers of verified matches, most first, as the rerank stage does."""
        method, verifier = self._verification
        rows = ranked[0][: verifier.settings.topn]
        names = [self.session.image_name(int(row)) for row in rows]
        verified, _ = verifier.verify(view.extract(method), view.camera, names, self.session.cameras(rows))
        order = np.argsort(-np.array(verified), kind="stable")[: verifier.settings.topk]
        return rows[order], np.array(verified, np.float64)[order]

    def _as_searched(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return descriptors normalized and rounded like those of the map, which were written to a file."""
        if self.embed_settings.normalize:
            vectors = unit(vectors)
        vectors = vectors.astype(self.embed_settings.dtype).astype(np.float32)
        return unit(vectors) if self.retrieve_settings.normalize else vectors

    @property
    def rows(self) -> NDArray[np.int64]:
        """Rows (N,) of the map images that are searched, in the session."""
        return self._stored[1]

    @cached_property
    def embed_settings(self) -> EmbedSettings:
        return read_settings(self.files.embeddings / "settings.json", EmbedSettings)

    @cached_property
    def retrieve_settings(self) -> RetrieveSettings:
        return read_settings(self.files.retrieval_dir / "settings.json", RetrieveSettings)

    @cached_property
    def embedders(self) -> list[Embedder]:
        """The embedders that the run used; ArtifactError is raised if the map's vectors are from another one."""
        settings = self.embed_settings
        folders = embedding_folders(self.files.embeddings).values()
        learned = {
            "checkpoint": settings.checkpoint,
            "device": settings.compute_device,
            "dtype_compute": settings.dtype_compute,
            "image_size": settings.image_size,
        }
        embedders = [
            create_embedder(name, **({"vocabulary": folder / "vlad.npz"} if name == "vlad" else learned))
            for name, folder in zip(settings.models, folders, strict=True)
        ]
        for embedder, vectors in zip(embedders, self._stored[0].parts.values(), strict=True):
            if vectors.embedder not in ("", embedder_fingerprint(embedder.settings)):
                raise ArtifactError(
                    f"{vectors.paths[0]} was made by another embedder or vocabulary than the run's {embedder.name} of "
                    "now. Run the embed stage again."
                )
        return embedders

    @cached_property
    def _stored(self) -> tuple[Vectors, NDArray[np.int64]]:
        """Global descriptors (N, D) of the posed map images, on disk, as they are searched; rows of the images (N,)."""
        normalize = self.retrieve_settings.normalize
        vectors, table = open_descriptors(self.files.embeddings, self.session.id, normalize)
        rows = np.array([self.session.row_of_name[image_name(path)] for path in table["abs_path"]], np.int64)
        posed = np.isfinite(self.session.world_from_cam(rows)).reshape(-1, 16).all(axis=1)
        return vectors.choose(np.flatnonzero(posed)), rows[posed]

    @cached_property
    def _descriptors(self) -> Floats | Vectors:
        """Those of `_stored`, in memory unless the map is large."""
        vectors = self._stored[0]
        in_memory = np.dtype(np.float64).itemsize * vectors.shape[1] * len(vectors) < MAX_IN_MEMORY
        return vectors[:].astype(np.float64) if in_memory else vectors

    @cached_property
    def _index(self) -> VectorIndex | None:
        """The index of the descriptors, if the run has one."""
        settings = self.retrieve_settings.model_copy(update={"faiss_gpu": False})  # this machine may have no GPU
        return load_index(self.files.embeddings, self.session.id, self._stored[0], settings)

    @cached_property
    def _verification(self) -> tuple[LocalMethod, Verifier]:
        """Features and verifier of the run's rerank stage."""
        settings = read_settings(self.files.reranked_dir / "settings.json", RerankSettings)
        (method,) = create_local_methods(settings)
        store = FeatureStore.of_session(self.files.features, self.session.id, method.extractor.settings)
        return method, Verifier(settings, method.matcher, store)
