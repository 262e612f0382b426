"""A rerun recording of the queries of one pair in their map: where each is, by what, and how far off."""

import logging
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.images import read_for_display
from toolkit.capture.upright import up_of_cameras
from toolkit.geometry import pose_error, project
from toolkit.show.figures import ESTIMATED, GREEN, MAP, ORANGE, SKY, TRUE, draw_error_legend, error_colors
from toolkit.show.recordings import (
    HIDDEN_M,
    camera_depth_m,
    jpeg_of,
    log_points,
    open_recording,
    pinhole_of,
    posed,
    rgb,
    scene_view,
    small_jpeg,
    transform_of,
    world_axes,
)

if TYPE_CHECKING:
    import pycolmap
    import rerun as rr

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

QUERY = "query"
"""The timeline: one steps through the queries, numbered as the rows of the pair's csv."""
MAX_CAMERAS, MAX_REFERENCES = 4, 4


@dataclass(frozen=True)
class ShownImage:
    """A posed photograph, and the map points matched in it."""

    name: str
    path: Path
    camera: "pycolmap.Camera"
    world_from_cam: Array
    """(4, 4); NaN where it is not known."""
    pixels: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(n, 2) where the points were measured, in the full image."""
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) the points, meters; projecting them gives what the pose predicts."""
    point_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(n,) which points of the map they are: the same number in two images is a match."""


@dataclass(frozen=True)
class QueryDetails:
    """What is shown of one query when it is chosen."""

    cameras: Sequence[ShownImage]
    """Its images, at the estimated pose, with the inliers that it rests on."""
    references: Sequence[ShownImage] = ()
    """Map images it was localized by, best first, with the same points as they saw them."""


@dataclass(frozen=True)
class Localizations:
    """The queries of a pair, one row each; the first image of a rig stands for it."""

    names: Sequence[str]
    status: Sequence[str]
    estimated: Array
    """world_from_cam (Q, 4, 4), NaN where there is no pose."""
    true: Array
    """The same, true; NaN where it is not known."""
    inliers: Sequence[int] = ()
    nearest_reference: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """World position (Q, 3) of each query's first reference; NaN where it has none."""

    @cached_property
    def errors(self) -> tuple[Array, Array]:
        """Rotation, degrees, and translation, meters, (Q,) each; NaN without a pose or a true one."""
        both = posed(self.estimated) & posed(self.true)
        rotation_deg, translation_m = np.full(len(both), np.nan), np.full(len(both), np.nan)
        if both.any():
            rotation_deg[both], translation_m[both] = pose_error(self.estimated[both], self.true[both])
        return rotation_deg, translation_m

    def worst_first(self) -> NDArray[np.int64]:
        """Return the rows: those without a pose, then by error, or by few inliers where the truth is unknown."""
        _, error_m = self.errors
        support = -np.asarray(self.inliers if len(self.inliers) else np.zeros(len(self.names)), np.float64)
        found = posed(self.estimated)
        return np.lexsort((support, -np.nan_to_num(error_m, nan=-1.0), found))


def record_localizations(
    out: str | Path,
    name: str,
    map_poses: ArrayLike,
    points: ArrayLike,
    colors: NDArray[np.uint8] | None,
    localizations: Localizations,
    details: Iterable[tuple[int, QueryDetails]] = (),
    up: ArrayLike | None = None,
    image_size: int = 480,
) -> Path:
    """Write a recording of queries in a map, and return its path.

    Entities: `world/{points,map_cameras}`, `world/queries/{estimated,true,error,failed}`; and for the query chosen on
    the timeline `query`: `world/chosen/camera_<k>`, `world/truth/camera_0`, `world/references/<rank>`,
    `world/chosen_points`, and a page about it, `about`. Errors are colored by `figures.error_colors`.

    Args:
        out: file to write.
        name: of the recording.
        map_poses: world_from_cam (N, 4, 4) of the map's images; NaN rows are passed over.
        points: (P, 3), meters.
        colors: (P, 3) RGB or None.
        localizations: all queries.
        details: number and details of those that can be chosen; taken one at a time.
        up: direction (3,) that is up; None: estimated from the map's cameras.
        image_size: longer side of the images, pixels.
    """
    started = time.perf_counter()
    poses = np.asarray(map_poses, np.float64).reshape(-1, 4, 4)
    poses = poses[posed(poses)]
    up = np.asarray(up_of_cameras(poses) if up is None else up, np.float64)
    size = camera_depth_m(poses[:, :3, 3])
    count = 0
    sizes: dict[str, tuple[int, int]] = {}
    with open_recording(out, name, _layout(name, poses, up)) as stream:
        stream.log("world", world_axes(up), static=True)
        log_points(stream, points, colors)
        _log_map_cameras(stream, poses, size)
        _log_overview(stream, localizations)
        for number, chosen in details:
            stream.set_time(QUERY, sequence=number)
            _log_chosen(stream, localizations, number, chosen, image_size, 2 * size, sizes)
            count += 1
    logger.info("%s: %d queries, %d of them with matches, in %.0f s", out, len(localizations.names), count,
                time.perf_counter() - started)  # fmt: skip
    return Path(out)


def _layout(name: str, poses: Array, up: Array) -> Any:
    """Return the viewer's layout: the scene, and beside it the chosen query, its references, and a page about it."""
    import rerun.blueprint as rrb

    scene = scene_view(poses, up, name)
    # The pictures' marks belong on the pictures; on the image planes in the scene they would hide it.
    hidden = [f"- /world/chosen/camera_{k}/marks/**" for k in range(MAX_CAMERAS)]
    hidden += [f"- /world/references/{rank}/marks/**" for rank in range(1, MAX_REFERENCES + 1)]
    scene.contents = ["+ $origin/**", *hidden]
    query = rrb.Tabs(
        *[rrb.Spatial2DView(origin=f"world/chosen/camera_{k}", name=f"query, camera {k}") for k in range(MAX_CAMERAS)]
    )
    references = rrb.Grid(
        *[
            rrb.Spatial2DView(origin=f"world/references/{rank}", name=f"reference {rank}")
            for rank in range(1, MAX_REFERENCES + 1)
        ],
        grid_columns=2,
    )
    about = rrb.Horizontal(
        rrb.TextDocumentView(origin="about", name="about the query"),
        rrb.Spatial2DView(origin="legend", name="colors"),
        column_shares=[2, 1],
    )
    side = rrb.Vertical(query, references, about, row_shares=[4, 4, 2])
    panel = rrb.TimePanel(state="collapsed", timeline=QUERY, play_state="paused")
    return rrb.Blueprint(rrb.Horizontal(scene, side, column_shares=[3, 2]), panel, collapse_panels=True)


def _log_map_cameras(stream: "rr.RecordingStream", poses: Array, size: float) -> None:
    """Log the map's cameras as small pyramids, all in one entity."""
    import rerun as rr

    corners = size * np.array([[0, 0, 0], [-0.4, -0.3, 1], [0.4, -0.3, 1], [0.4, 0.3, 1], [-0.4, 0.3, 1.0]])
    outline = corners[[0, 1, 2, 0, 3, 4, 0, 1, 4, 3, 2]]
    lines = np.einsum("nij,kj->nki", poses[:, :3, :3], outline) + poses[:, None, :3, 3]
    stream.log("world/map_cameras", rr.LineStrips3D(list(lines), colors=rgb(MAP)), static=True)


def _log_overview(stream: "rr.RecordingStream", queries: Localizations) -> None:
    """Log all queries: estimates and error lines colored by error, true places, failures at their references."""
    import rerun as rr

    found, known = posed(queries.estimated), posed(queries.true)
    colors = error_colors(queries.errors[1])
    labels = [f"#{k} {describe(queries, k)}" for k in range(len(queries.names))]

    def dots(path: str, rows: NDArray[np.bool_], centers: Array, color: Any, radius: float) -> None:
        points = rr.Points3D(
            centers[rows],
            colors=color,
            radii=rr.Radius.ui_points(radius),
            labels=[labels[k] for k in np.flatnonzero(rows)],
            show_labels=False,
        )
        stream.log(path, points, static=True)

    dots("world/queries/true", known, queries.true[:, :3, 3], rgb(TRUE), 3)
    dots("world/queries/estimated", found, queries.estimated[:, :3, 3], colors[found], 5)
    both = found & known
    lines = np.stack([queries.estimated[both, :3, 3], queries.true[both, :3, 3]], axis=1)
    stream.log("world/queries/error", rr.LineStrips3D(list(lines), colors=colors[both]), static=True)
    centers = queries.nearest_reference.reshape(-1, 3)
    if len(centers):
        lost = ~found & np.isfinite(centers).all(1)
        dots("world/queries/failed", lost, centers, rgb(ESTIMATED), 9)
    stream.log("legend", rr.EncodedImage(contents=draw_error_legend(), media_type="image/png"), static=True)


def _log_chosen(
    stream: "rr.RecordingStream",
    queries: Localizations,
    number: int,
    chosen: QueryDetails,
    image_size: int,
    size: float,
    sizes: dict[str, tuple[int, int]],
) -> None:
    """Log one query at the current place of the timeline, in place of the one before."""
    import rerun as rr

    # What this query lacks is overwritten by nothing, or the last one's would stay.
    for k in range(MAX_CAMERAS):
        image = chosen.cameras[k] if k < len(chosen.cameras) else None
        _log_image(stream, f"world/chosen/camera_{k}", image, image_size, size, ESTIMATED, sizes, residuals=True)
    for rank in range(1, MAX_REFERENCES + 1):
        image = chosen.references[rank - 1] if rank <= len(chosen.references) else None
        _log_image(stream, f"world/references/{rank}", image, image_size, size, SKY, sizes, residuals=False)
    if chosen.cameras:
        camera, known = chosen.cameras[0].camera, bool(posed(queries.true[number : number + 1])[0])
        if known:
            stream.log("world/truth/camera_0", transform_of(queries.true[number]))
        shown = (camera.width, camera.height)
        stream.log("world/truth/camera_0", pinhole_of(camera, shown, size if known else HIDDEN_M, TRUE))
    points = np.concatenate([image.points for image in chosen.cameras] or [np.zeros((0, 3))])
    dots = rr.Points3D(points, colors=rgb(GREEN), radii=rr.Radius.ui_points(3))
    stream.log("world/chosen_points", dots)
    lines = []
    if posed(queries.estimated[number : number + 1])[0]:
        center = queries.estimated[number, :3, 3]
        lines = [np.stack([center, image.world_from_cam[:3, 3]]) for image in chosen.references]
    stream.log("world/lines", rr.LineStrips3D(lines, colors=rgb(ORANGE)))
    text = [f"**query {number}: {describe(queries, number)}**", "", *(f"- {image.name}" for image in chosen.cameras)]
    matched = sum(len(image.points) for image in chosen.cameras)
    text += ["", f"{matched} inliers shown: green where the pose puts a point, white where it was measured.", ""]
    text += [
        f"{rank}. {image.name}: sees {len(image.points)} of the points"
        for rank, image in enumerate(chosen.references, start=1)
    ]
    stream.log("about", rr.TextDocument("\n".join(text), media_type="text/markdown"))


def _log_image(
    stream: "rr.RecordingStream",
    path: str,
    image: ShownImage | None,
    image_size: int,
    size: float,
    color: str,
    sizes: dict[str, tuple[int, int]],
    residuals: bool,
) -> None:
    """Log a photograph with its camera, and on it where points were measured and where the pose puts them.

    Where there is none, nothing but gray; `sizes` are of the pictures last logged.
    """
    import rerun as rr

    measured, predicted = np.zeros((0, 2)), np.zeros((0, 2))
    lines: list[Array] = []
    if image is None:
        # Of the last one's size: the viewer takes pictures of an entity for frames of a film.
        width, height = sizes.get(path, (4, 3))
        blank = np.full((height, width, 3), 60, np.uint8)
        stream.log(f"{path}/image", jpeg_of(small_jpeg(blank, max(blank.shape))[0]))
        # A camera of any kind, too small to be seen.
        stream.log(path, rr.Pinhole(focal_length=1, width=1, height=1, image_plane_distance=HIDDEN_M))
    else:
        data, shown = small_jpeg(read_for_display(image.path), image_size)
        sizes[path] = shown
        located = bool(np.isfinite(image.world_from_cam).all())
        if located:
            stream.log(path, transform_of(image.world_from_cam))
        stream.log(path, pinhole_of(image.camera, shown, size if located else HIDDEN_M, color))
        stream.log(f"{path}/image", jpeg_of(data))
        scale = np.array(shown) / [image.camera.width, image.camera.height]
        measured = image.pixels * scale
        if located and residuals and len(measured):
            pixels, visible = project(image.points, image.camera, image.world_from_cam)
            predicted = pixels[visible] * scale
            lines = list(np.stack([measured[visible], predicted], axis=1))
    white, green = rr.Radius.ui_points(1.5), rr.Radius.ui_points(2.5)
    stream.log(f"{path}/marks/reprojected", rr.Points2D(predicted, colors=rgb(GREEN), radii=green))
    stream.log(f"{path}/marks/measured", rr.Points2D(measured, colors=[255, 255, 255], radii=white))
    stream.log(f"{path}/marks/residuals", rr.LineStrips2D(lines, colors=[255, 255, 255]))


def describe(queries: Localizations, k: int) -> str:
    """Return a line about a query: name, status, errors, inliers."""
    rotation_deg, error_m = (values[k] for values in queries.errors)
    parts = [str(queries.names[k]), str(queries.status[k])]
    if np.isfinite(error_m):
        parts.append(f"off by {rotation_deg:.2g}°, {error_m:.3g} m")
    if len(queries.inliers):
        parts.append(f"{int(queries.inliers[k])} inliers")
    return ", ".join(parts)
