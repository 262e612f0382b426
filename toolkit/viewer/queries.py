"""Record the queries of one pair in their map for the rerun viewer: poses, references, correspondences, errors."""

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.images import prefetch, read_for_display
from toolkit.capture.upright import up_of_cameras
from toolkit.figures.scene_3d import pyramids
from toolkit.figures.style import ESTIMATED, GREEN, MAP, ORANGE, SKY, TRUE, draw_error_legend, error_colors
from toolkit.geometry import Floats, local_origin, project, rotation_to_quaternion, shifted
from toolkit.results.localized import REFERENCES, Localizations, QueryDetails, ShownImage, support_of
from toolkit.results.metrics import is_posed, named_as_meters
from toolkit.viewer import blueprint as viewer

logger = logging.getLogger(__name__)

QUERY = "query"
"""Timeline of the query numbers, which are the rows of the pair's csv."""
MAX_CAMERAS = 4
"""Images of a query that are shown, at most."""
KEPT_JPEGS = 256
"""References that are encoded once though several queries show them."""
WHITE = [255, 255, 255]
SURE_3D = 2.7955
"""Radius of the 95 % region of a 3D normal distribution, standard deviations."""


def record_localizations(
    out: str | Path,
    name: str,
    map_poses: Floats,
    points: ArrayLike,
    colors: NDArray[np.uint8] | None,
    localizations: Localizations,
    details: Iterable[tuple[int, QueryDetails]] = (),
    up: ArrayLike | None = None,
    tracks: Mapping[str, Sequence[Floats]] | None = None,
    rays: bool = False,
) -> Path:
    """Write a recording of queries in a map, and return its path.

    Entities: `world/{points,map_cameras}`, `world/queries/{estimated,true,error,failed}`,
    `world/recording/{odometry,frames}`. For the query chosen on the timeline `query`: `world/chosen/camera_<k>`,
    `world/truth/camera_0`, `world/references/<rank>`, `world/chosen_points`, `world/uncertainty` (95 % region of the
    position), `world/rivals`, `world/rays`, and `about`, a page of text. Errors are colored by `figures.error_colors`.
    The viewer has numbers of single precision, so a world far from its origin (UTM, ECEF) is shifted, see
    `geometry.local_origin`.

    Args:
        map_poses: world_from_cam (N, 4, 4) of the map's images; NaN rows are skipped.
        points: (P, 3), meters.
        colors: (P, 3) RGB or None.
        details: number and details of the queries that can be chosen; few are in memory at a time.
        up: up direction (3,); None: estimated from the map's cameras.
        tracks: positions (n, 3) of each piece of the query recordings: `odometry`, rigidly placed in the map, and
            `frames`, as estimated by the sequence stage.
        rays: join the camera of the chosen query with the map points that it sees.
    """
    started = time.perf_counter()
    poses = map_poses[is_posed(map_poses)]
    shift = -local_origin(poses[:, :3, 3])
    poses = shifted(poses, shift)
    up = np.asarray(up_of_cameras(poses) if up is None else up, np.float64)
    size = viewer.camera_depth_m(poses[:, :3, 3])
    count = 0
    with viewer.open_recording(out, name, _layout(name, poses, up, len(localizations.names) > 0)) as stream:
        stream.log("world", viewer.world_axes(up), static=True)
        viewer.log_points(stream, np.asarray(points) + shift, colors)
        _log_map_cameras(stream, poses, size)
        _log_overview(stream, localizations, shift)
        for kind, color in (("odometry", ORANGE), ("frames", SKY)):
            if tracks and tracks.get(kind):
                viewer.log_lines(stream, f"world/recording/{kind}", [track + shift for track in tracks[kind]], color)
        writer = _ChosenWriter(stream, localizations, 2 * size, shift, rays)
        for number, chosen in prefetch(writer.read, details):
            writer.write(number, chosen)
            count += 1
    logger.info("%s: %d queries, %d of them with details, in %.0f s", out, len(localizations.names), count,
                time.perf_counter() - started)  # fmt: skip
    return Path(out)


def _layout(name: str, poses: Floats, up: Floats, has_queries: bool) -> Any:
    """Return the viewer's layout: the scene, and beside it the chosen query, its references and a text page."""
    scene = viewer.scene_view(poses, up, name)
    if not has_queries:
        return rrb.Blueprint(scene, collapse_panels=True)
    cameras = {f"query, camera {k}": f"world/chosen/camera_{k}" for k in range(MAX_CAMERAS)}
    ranked = {f"reference {rank}": f"world/references/{rank}" for rank in range(1, REFERENCES + 1)}
    # Show marks only in the 2D views: on the image planes of the 3D scene they would hide it.
    scene.contents = ["+ $origin/**", *(f"- /{path}/marks/**" for path in (cameras | ranked).values())]
    query = rrb.Tabs(*(rrb.Spatial2DView(origin=path, name=name) for name, path in cameras.items()))
    references = rrb.Grid(*(rrb.Spatial2DView(origin=path, name=name) for name, path in ranked.items()), grid_columns=2)
    about = rrb.Horizontal(
        rrb.TextDocumentView(origin="about", name="about the query"),
        rrb.Spatial2DView(origin="legend", name="colors"),
        column_shares=[2, 1],
    )
    side = rrb.Vertical(query, references, about, row_shares=[4, 4, 2])
    panel = rrb.TimePanel(state="collapsed", timeline=QUERY, play_state="paused")
    return rrb.Blueprint(rrb.Horizontal(scene, side, column_shares=[3, 2]), panel, collapse_panels=True)


def _log_map_cameras(stream: rr.RecordingStream, poses: Floats, size: float) -> None:
    """Log the map's cameras as small pyramids, all in one entity."""
    lines = rr.LineStrips3D(pyramids(poses, size).astype(np.float32), colors=viewer.rgb(MAP))
    stream.log("world/map_cameras", lines, static=True)


def _log_overview(stream: rr.RecordingStream, queries: Localizations, shift: Floats) -> None:
    """Log all queries: estimates and error lines colored by error, true positions, failures at their references."""
    located, has_truth = is_posed(queries.estimated), is_posed(queries.true)
    colors = error_colors(named_as_meters(queries.errors)["translation_error_m"])
    labels = np.array([f"#{k} {describe(queries, k)}" for k in range(len(queries.names))], object)

    def dots(path: str, rows: NDArray[np.bool_], centers: Floats, color: Any, radius: float) -> None:
        style = {"colors": color, "radii": rr.Radius.ui_points(radius), "show_labels": False}
        stream.log(path, rr.Points3D(centers[rows] + shift, labels=labels[rows].tolist(), **style), static=True)

    dots("world/queries/true", has_truth, queries.true[:, :3, 3], viewer.rgb(TRUE), 3)
    dots("world/queries/estimated", located, queries.estimated[:, :3, 3], colors[located], 5)
    both = located & has_truth
    lines = np.stack([queries.estimated[both, :3, 3], queries.true[both, :3, 3]], axis=1) + shift
    stream.log("world/queries/error", rr.LineStrips3D(lines.astype(np.float32), colors=colors[both]), static=True)
    if len(queries.nearest_reference):
        lost = ~located & np.isfinite(queries.nearest_reference).all(1)
        dots("world/queries/failed", lost, queries.nearest_reference, viewer.rgb(ESTIMATED), 9)
    legend = draw_error_legend(queries.unit[0])
    stream.log("legend", rr.EncodedImage(contents=legend, media_type="image/png"), static=True)


class _ChosenWriter:
    """Logs one query at a time, each in place of the one before; `shift` (3,) is added to all positions."""

    def __init__(
        self, stream: rr.RecordingStream, queries: Localizations, camera_depth_m: float, shift: Floats, rays: bool
    ) -> None:
        self._rays = rays
        self._stream, self._queries, self._depth_m, self._shift = stream, queries, camera_depth_m, shift
        self._sizes: dict[str, tuple[int, int]] = {}
        """Width and height of the images last logged, by entity."""
        self._jpeg_of = lru_cache(KEPT_JPEGS)(_jpeg_of)

    def _jpeg(self, image: ShownImage) -> tuple[bytes, tuple[int, int]]:
        pixels = image.image
        return self._jpeg_of(pixels) if isinstance(pixels, Path) else viewer.small_jpeg(pixels, viewer.IMAGE_SIZE)

    def read(self, numbered: tuple[int, QueryDetails]) -> tuple[int, QueryDetails]:
        """Read the images of a query and keep them; return the arguments of `write`; thread-safe."""
        _, query = numbered
        for image in (*query.cameras[:MAX_CAMERAS], *(image for image, _, _ in query.captioned_references())):
            self._jpeg(image)
        return numbered

    def write(self, number: int, query: QueryDetails) -> None:
        """Log a query. Entities that it lacks are cleared, or those of the last query would stay."""
        import rerun as rr

        stream, references, center = self._stream, query.captioned_references(), self._queries.estimated[number, :3, 3]
        stream.set_time(QUERY, sequence=number)
        for k, image in zip_longest(range(MAX_CAMERAS), query.cameras[:MAX_CAMERAS]):
            self._log_image(f"world/chosen/camera_{k}", image, ESTIMATED, residuals=True)
        for rank, reference in zip_longest(range(1, REFERENCES + 1), references):
            image, _, agrees = reference or (None, "", True)
            self._log_image(f"world/references/{rank}", image, SKY if agrees else ORANGE, residuals=False)
        if query.cameras:
            camera, true = query.cameras[0].camera, query.cameras[0].world_from_cam_true
            has_truth = bool(is_posed(true))
            if has_truth:
                stream.log("world/truth/camera_0", viewer.transform_of(shifted(true, self._shift)))
            depth_m = self._depth_m if has_truth else viewer.HIDDEN_M
            pinhole = viewer.pinhole_of(camera, (camera.width, camera.height), depth_m, TRUE)
            stream.log("world/truth/camera_0", pinhole)
        points = np.concatenate([np.zeros((0, 3)), *(image.points[image.agrees] for image in query.cameras)])
        dots = rr.Points3D(points + self._shift, colors=viewer.rgb(GREEN), radii=rr.Radius.ui_points(3))
        stream.log("world/chosen_points", dots)
        located = bool(np.isfinite(center).all())
        ends = [image.world_from_cam[:3, 3] for image in query.references if located]
        lines = [np.stack([center, end]) + self._shift for end in ends]
        stream.log("world/lines", rr.LineStrips3D(lines, colors=viewer.rgb(ORANGE)))
        self._log_doubt(query, points if self._rays and located else points[:0], center)
        text = [f"**query {number}: {describe(self._queries, number)}**", ""]
        text += [f"- {image.name}" for image in query.cameras]
        if query.has_matches:
            rejected = sum(len(image.matches) for image in query.cameras) - len(points)
            text += ["", f"{len(points)} map points agree: green projections, white measured keypoints. "
                     f"{rejected} rejected matches: orange.", ""]  # fmt: skip
        elif located:
            text += ["", "No matches: the pose comes from the references as a whole.", ""]
        text += [f"{rank}. {image.name}: {caption}" for rank, (image, caption, _) in enumerate(references, start=1)]
        stream.log("about", rr.TextDocument("\n".join(text), media_type="text/markdown"))

    def _log_doubt(self, query: QueryDetails, seen: Floats, center: Floats) -> None:
        """Log the 95 % region of the position, the rival poses, and rays from the center (3,) to points (n, 3)."""
        values, vectors = np.zeros(0), np.eye(3)
        if query.position_covariance is not None:
            values, vectors = np.linalg.eigh(query.position_covariance)
            vectors = vectors * np.sign(np.linalg.det(vectors))
        w, x, y, z = rotation_to_quaternion(vectors)
        region = rr.Ellipsoids3D(
            half_sizes=[SURE_3D * np.sqrt(np.maximum(values, 0))] if len(values) else [],
            centers=[center + self._shift] if len(values) else [],
            quaternions=[rr.Quaternion(xyzw=[x, y, z, w])] if len(values) else [],
            colors=viewer.rgb(ESTIMATED),
            fill_mode="majorwireframe",
        )
        self._stream.log("world/uncertainty", region)
        poses = np.array([pose for pose, _ in query.rivals]).reshape(-1, 4, 4)
        labels = [f"rival, {support:.0%} of the support" for _, support in query.rivals]
        color = viewer.rgb(TRUE)
        lines = pyramids(shifted(poses, self._shift) if len(poses) else poses, self._depth_m / 2).astype(np.float32)
        self._stream.log("world/rivals", rr.LineStrips3D(lines, labels=labels, colors=color, show_labels=False))
        rays = [np.stack([center, point]) + self._shift for point in seen]
        self._stream.log("world/rays", rr.LineStrips3D(rays, colors=viewer.rgb(GREEN), radii=rr.Radius.ui_points(0.5)))

    def _log_image(self, path: str, image: ShownImage | None, color: str, residuals: bool) -> None:
        """Log an image (None: a gray one) with its camera, keypoints and, for `residuals`, projected points."""
        import rerun as rr

        stream, measured, agrees = self._stream, np.zeros((0, 2)), np.zeros(0, bool)
        predicted, lines = np.zeros((0, 2)), np.zeros((0, 2, 2))
        if image is None:
            # Keep the size of the last image: the viewer treats the images of an entity as frames of a video.
            width, height = self._sizes.get(path, (4, 3))
            data, _ = viewer.small_jpeg(np.full((height, width, 3), 60, np.uint8), max(width, height))
            stream.log(path, viewer.hidden_camera())
        else:
            data, self._sizes[path] = self._jpeg(image)
            located = bool(is_posed(image.world_from_cam))
            if located:
                stream.log(path, viewer.transform_of(shifted(image.world_from_cam, self._shift)))
            depth_m = self._depth_m if located else viewer.HIDDEN_M
            stream.log(path, viewer.pinhole_of(image.camera, self._sizes[path], depth_m, color))
            scale = np.array(self._sizes[path]) / [image.camera.width, image.camera.height]
            measured, agrees = image.pixels * scale, image.agrees
            if located and residuals and agrees.any():
                pixels, visible = project(image.points[agrees], image.camera, image.world_from_cam)
                predicted = pixels[visible] * scale
                lines = np.stack([measured[agrees][visible], predicted], axis=1)
        stream.log(f"{path}/image", rr.EncodedImage(contents=data, media_type="image/jpeg"))
        for name, marks, shade, radius in (
            ("reprojected", predicted, viewer.rgb(GREEN), 2.5),
            ("measured", measured[agrees], WHITE, 1.5),
            ("rejected", measured[~agrees], viewer.rgb(ORANGE), 1.5),
        ):
            dots = rr.Points2D(marks, colors=shade, radii=rr.Radius.ui_points(radius))
            stream.log(f"{path}/marks/{name}", dots)
        stream.log(f"{path}/marks/residuals", rr.LineStrips2D(lines.astype(np.float32), colors=WHITE))


def _jpeg_of(path: Path) -> tuple[bytes, tuple[int, int]]:
    return viewer.small_jpeg(read_for_display(path, viewer.IMAGE_SIZE), viewer.IMAGE_SIZE)


def describe(queries: Localizations, k: int) -> str:
    """Return one line of text about a query: name, status, errors, inliers."""
    row = named_as_meters(queries.errors.iloc[[k]]).iloc[0]
    parts = [str(queries.names[k]), str(row["status"])]
    if np.isfinite(row["translation_error_m"]):
        parts.append(f"off by {row['rotation_error_deg']:.2g}°, {row['translation_error_m']:.3g} {queries.unit[0]}")
    return ", ".join(filter(None, [*parts, support_of(row)]))
