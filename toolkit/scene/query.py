"""A query from any images with cameras, and checks of what a person gives; and what matches and results need to show
themselves, and to be tried with changes.
"""

import operator
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture import Session
from toolkit.capture.images import (
    GuessedCamera,
    camera_from_exif,
    camera_text,
    exif_key,
    find_mask,
    parse_camera,
    read_header,
    stored_size,
)
from toolkit.errors import COMMAND, ArtifactError, CameraError, ImageError, ManifestError
from toolkit.features.matching import create_methods, resolve_auto
from toolkit.geometry import Floats
from toolkit.manifest import LocalizeSettings, nearest
from toolkit.manifest.manifest import nested
from toolkit.manifest.settings import expand
from toolkit.pose.base import Query, QueryMatches, QueryResult, References, RoughPose, View
from toolkit.pose.map_matching import MappedFeatures
from toolkit.pose.pnp import PnpMatches
from toolkit.results.localized import ShownImage
from toolkit.results.metrics import is_posed, length_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from toolkit.figures.answers import Answer, Comparison

_MAX_DEVIATION = 1e-3
"""Largest deviation of R @ R.T from the identity for a rotation R; rounding to float32 or in files stays below."""
MAX_MAP_CAMERAS = 1000  # cameras of the map among which that of an image is looked for, at most
SAME_CAMERA = 5e-3  # difference of two estimates of a parameter: relative, or of a coefficient of distortion
FOCAL_PRIOR = 1.2  # focal length of a camera that nothing is known of, in multiples of the longer side
Image = Any
"""A file (str, Path), or pixels as `pixels_from` takes them."""
Map = Any
"""A `scene.map.Map`, which imports this module."""
FIXED_BY_MAP = ("unit", "world_up")
"""Settings that the length of the map and the turns of its images depend on, so they cannot change for a query."""
_OF_SESSION = ("capture", "session", "search", "cameras", "estimated_cameras", "_upright")
"""What a map keeps that depends on no setting that can change."""
CHANGEABLE = ("localize", "retrieve.topk")
"""Sections and keys of a manifest that can be changed for one query."""


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
        found = f"{len(images)} images, {len(cameras)} cameras, {len(poses)} rig_from_cams, {len(quarter_turns)} turns"
        raise CameraError(f"Found {found}: expected the same number of each, and at least one.")
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


class MapCameras:
    """The cameras of a map, among which that of another image is looked for."""

    def __init__(self, session: Session) -> None:
        """Take the map's session; raise CaptureError if the intrinsics of a camera are malformed."""
        first = session.images["sensor_id"].iloc[session.camera_rows].drop_duplicates().head(MAX_MAP_CAMERAS)
        self._session, self._cameras = session, {str(name): session.camera(str(name)) for name in first}
        self._images = {str(name): session.image_path(row) for row, name in first.items()}
        """The first image of each camera."""
        self._keys = dict[str, tuple[str, ...]]()
        self._found = dict[Any, GuessedCamera | None]()

    def find(self, size: tuple[int, int], key: tuple[str, ...], folder: str, loosely: bool) -> GuessedCamera | None:
        """Return the intrinsics of the only camera that may have taken an image; None if there is none, or several.

        Args:
            size: width and height of the image.
            key: of the image in EXIF, see `exif_key`. That of the camera's first image is equal.
            folder: name of the image's folder. Of several cameras, those with images in a folder of this name count.
            loosely: if there is no such camera, one whose EXIF does not contradict is enough.
        """
        found = self._only_one(size, key, folder, False) if any(key) else None
        return self._only_one(size, key, folder, True) if found is None and loosely else found

    def _only_one(self, *asked: Any) -> GuessedCamera | None:
        """Return the intrinsics that all cameras have which may be meant, up to the errors of two estimates."""
        size, key, folder, loosely = asked
        if asked not in self._found:
            fitting = [name for name, one in self._cameras.items() if (one.width, one.height) == size]
            alike = {name: self._cameras[name] for name in fitting if self._is(name, key, loosely)}
            if len(alike) > 1:
                alike = {name: one for name, one in alike.items() if folder in self._folders[name]} or alike
            first = next(iter(alike.values()), None)
            same = first is not None and all(
                one.model == first.model and np.allclose(one.params, first.params, SAME_CAMERA, SAME_CAMERA)
                for one in alike.values()
            )
            self._found[asked] = GuessedCamera(first, "that of the map's camera") if first and same else None
        return self._found[asked]

    def _is(self, sensor: str, key: tuple[str, ...], loosely: bool) -> bool:
        """Tell whether EXIF says that a sensor took an image; loosely, that it does not say the opposite."""
        if loosely and not any(key):
            return True
        if sensor not in self._keys:
            self._keys[sensor] = _exif_key_of(self._images[sensor])
        own = self._keys[sensor]
        return all(one == other or (loosely and not (one and other)) for one, other in zip(own, key, strict=True))

    @cached_property
    def _folders(self) -> dict[str, set[str]]:
        """Names of the folders with images of each sensor."""
        names = self._session.images["path"].astype(str).str.rpartition("/")[0].str.rpartition("/")[2]
        listed = names.groupby(self._session.images["sensor_id"].astype(str)).unique()
        return {str(sensor): set(found) for sensor, found in listed.items()}


def _exif_key_of(path: Path) -> tuple[str, ...]:
    try:
        return exif_key(read_header(path)[1])
    except ImageError:
        return exif_key({})


def known_camera(image: Image, cameras: MapCameras | None = None) -> GuessedCamera:
    """Return the camera of an image without intrinsics: that of the map's camera that took it, or one from EXIF.

    A camera of the map is known better than EXIF knows one. It took the image if its first image has the same size,
    make, model and focal length in EXIF; of several such, that of a folder of the same name. For an image whose EXIF
    does not give a focal length in pixels, an equal size is enough if EXIF does not contradict.

    Args:
        image: file or pixels.
        cameras: of the map; None: there is no map.

    Raises:
        ImageError: the image cannot be read, or its camera is not known.
    """
    guess: GuessedCamera | ImageError = ImageError("pixels have no EXIF: give the intrinsics")
    if isinstance(image, str | Path):
        (size, exif), folder = read_header(Path(image)), Path(image).parent.name
        try:
            guess = camera_from_exif(size, exif)
        except ImageError as error:
            guess = error
    else:
        height, width = pixels_from(image).shape[:2]
        size, exif, folder = (width, height), dict[int, Any](), ""
    unknown = isinstance(guess, ImageError)
    found = None if cameras is None else cameras.find(size, exif_key(exif), folder, unknown)
    if isinstance(guess, GuessedCamera):
        return guess if found is None else found._replace(cropped=guess.cropped)
    if found is None:
        raise guess
    return found


def guessed_camera(image: Image, cameras: MapCameras | None = None) -> GuessedCamera:
    """Return `known_camera`, or a guess if it is not known.

    Raises:
        ImageError: the image cannot be read.
    """
    try:
        return known_camera(image, cameras)
    except ImageError:  # no focal length, or no image, which the next line says
        width, height = stored_size(image) if isinstance(image, str | Path) else pixels_from(image).shape[1::-1]
    params = [FOCAL_PRIOR * max(width, height), width / 2, height / 2]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)
    return GuessedCamera(camera, f"a guess, {FOCAL_PRIOR:g} times the longer side")


def camera_key(image: Image, camera: pycolmap.Camera) -> tuple[Any, ...]:
    """Return what images of one camera have in common: the first guess of it, and what EXIF says of it."""
    exif = read_header(Path(image))[1] if isinstance(image, str | Path) else {}
    return camera_text(camera), *exif_key(exif)


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
        do = "Make one by toolkit.capture.parse_camera('camera', 'PINHOLE, 640, 480, 500, 500, 320, 240')."
        raise CameraError.at("camera", f"{camera!r}, a {type(camera).__name__}", "a pycolmap.Camera", do)
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
        found = f"no pose for image {number + 1}: {poses[number].tolist()}"
        expected = "a rotation, which neither scales nor mirrors, a translation, and a last row 0, 0, 0, 1"
        raise CameraError.at("rig_from_cams", found, expected)
    return poses


def _turns(turns: Any) -> list[int]:
    try:
        return [operator.index(turn) for turn in turns]
    except TypeError:
        raise CameraError(f"turns: found {turns!r}, expected whole numbers of quarter turns, one per image.") from None


# A query in its map


def what_if(
    scene_map: Map,
    query: Query,
    found: Sequence[References],
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
        scene_map, query, found: the map, the query, and the references of its images.
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

    sections = nested(changes)
    for section in sections.keys() - {"localize", "retrieve"}:
        do = f"{nearest(section, CHANGEABLE)} To change it for all queries: {COMMAND} run MANIFEST --set {section}..."
        raise ManifestError(f"{section}: cannot change for one query. {do}")
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
    relocalized = other.locate(query, near, [_in(other, scene_map, retrieved) for retrieved in found])
    said = {
        "references": references,
        "drop": list(drop),
        "focal_px": focal_px,
        "camera": camera and f"{camera.model_name} {camera.params_to_string()}",
        "near": near and "a rough pose",
    }
    before, retrieved = result.show(), ranks(scene_map, found)
    after = replace(before, result=relocalized, settings=other.settings, views=query.views, retrieved=retrieved)
    return Comparison(before, after, {**changes, **{name: value for name, value in said.items() if value}})


def with_changes(scene_map: Map, changes: Mapping[str, Any]) -> Map:
    """Return a map with changed settings of the localize stage; it shares what stays the same with the given one.

    If features, or the settings of the map's points, change, points are triangulated for each query from its
    references, as the map has none of this kind.

    Raises:
        ManifestError: a setting is unknown, or the unit or the up direction of the map would change.
        WeightsError: a network of the changed settings has no weights.
    """
    before, changes = scene_map.settings, expand(LocalizeSettings, changes)
    features = changes.get("features", {})
    if "kinds" in features and "escalation" not in features:
        rest = [name for name in before.features.escalation if name not in features["kinds"]]
        changes |= {"features": {**features, "escalation": rest}}
    try:
        settings = LocalizeSettings.of(before, changes)
    except ManifestError as error:
        raise ManifestError(re.sub(r"^\w+:\s+", "localize: ", str(error))) from None
    if fixed := [name for name in FIXED_BY_MAP if getattr(settings, name) != getattr(before, name)]:
        do = f"To change it: {COMMAND} run MANIFEST --set localize.{fixed[0]}=..."
        raise ManifestError(f"localize.{fixed[0]}: cannot change for one query, as the whole map depends on it. {do}")
    anew = settings.features != before.features or settings.matcher != before.matcher or not scene_map.kinds
    kinds, escalation = create_methods(resolve_auto(settings)) if anew else (scene_map.kinds, scene_map.escalation)
    extracted = {kind.name: kind.extractor.settings for kind in scene_map.kinds}
    kept = {kind.name: kind for kind in kinds if extracted.get(kind.name) == kind.extractor.settings}
    mapped = [
        MappedFeatures(kind.map, kind.features, kind.name, kept[kind.name].matcher)
        for kind in (scene_map.mapped if settings.map == before.map or settings.predicts else ())
        if kind.name in kept
    ]
    names = [kind.name for kind in mapped]
    kinds = sorted(kinds, key=lambda kind: kind.name not in names)  # as `OnDemandLocalizer` wants them
    changed = {"settings": settings, "kinds": kinds, "mapped": mapped, "escalation": escalation}
    other = replace(scene_map, original=scene_map._first, **changed)
    shared = _OF_SESSION if anew else (*_OF_SESSION, "_on_demand")
    vars(other).update((name, value) for name, value in vars(scene_map).items() if name in shared)
    return other


def answer_of(scene_map: Map, query: Query, references: Sequence[References], result: QueryResult) -> "Answer":
    """Return how a query was localized in a map, given one of its results."""
    from toolkit.figures.answers import Answer

    return Answer(
        result, scene_map.settings, query.views, query.rig_from_cams, scene_map.session, scene_map.points,
        length_unit(scene_map.record()), _true_pose(scene_map, query), "query", None, ranks(scene_map, references),
    )  # fmt: skip


def _true_pose(scene_map: Map, query: Query) -> Floats | None:
    """Return world_from_rig (4, 4) of a query of a session by its ground truth; None if that is unknown."""
    found = scene_map.capture.find_image(query.views[0].name)
    if found is None:
        return None
    true: Floats = found[0].world_from_cam([found[1]], ground_truth=True)[0] @ geometry.invert(query.rig_from_cams[0])
    return true if is_posed(true) else None


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


def show_matches(scene_map: Map, matches: QueryMatches, reference: int = 1, image: int = 0) -> "Figure":
    """Draw the matches by descriptors of one image of a query with one of its references.

    Args:
        matches: what `Map.match` returned.
        reference: rank of the reference, from 1.
        image: number of the query image, from 0.

    Raises:
        ArtifactError: there is no such image or reference, or the method does not match keypoints.
    """
    from toolkit.figures.query_images import draw_pair

    found = matches.references[image].images.tolist() if 0 <= image < len(matches.references) else list[int]()
    if not isinstance(matches, PnpMatches) or not 0 < reference <= len(found) or image not in matches.usable:
        known = f"an image with features from 0 to {len(matches.references) - 1}, a reference from 1 to {len(found)}"
        expected = f"{known}, and a method that matches keypoints"
        raise ArtifactError.at(f"image {image}, reference {reference}", "no matches", expected)
    at, index, matcher = matches.usable.index(image), found[reference - 1], matches.localizer.matcher
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

    of_map = shown(name, scene_map.session.image_path(row), scene_map.session.cameras([row])[0], pixels)
    query = shown(view.name, view.image, view.camera, of_pair.pixels[seen])
    return draw_pair(query, of_map, f"{len(seen)} matches by descriptors with reference {reference}")
