"""Record the queries of one pair in their map for the rerun viewer: poses, references, correspondences, errors; and
show pictures, recordings and a map in 3D in a notebook, with the viewer only in an interactive session.
"""

import html
import io
import logging
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray

from toolkit.capture import Session
from toolkit.capture.images import prefetch, read_for_display, shrunk
from toolkit.capture.upright import up_of_cameras
from toolkit.errors import ArtifactError
from toolkit.figures.answers import Answer
from toolkit.figures.query_images import shown_name
from toolkit.figures.style import (
    BLUE,
    ESTIMATED,
    GRAY,
    GREEN,
    MAP,
    ORANGE,
    SKY,
    TRUE,
    as_jpeg,
    draw_error_legend,
    error_colors,
    mime_type,
    picture_of,
    zoomable,
)
from toolkit.figures.top_view import Eye, draw_scene_3d, pyramids
from toolkit.files import relative_url, write_atomic
from toolkit.geometry import Floats, local_origin, project, rotation_to_quaternion, shifted
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import QueryResult, split_status
from toolkit.results.localized import REFERENCES, Localizations, QueryDetails, ShownImage, support_of, sure_points
from toolkit.results.metrics import is_posed, named_as_meters
from toolkit.runs.kernel import TEXT_BARS

if TYPE_CHECKING:
    import pycolmap
    from matplotlib.figure import Figure

Image = NDArray[np.uint8]
APPLICATION = "visual-localization"
IMAGE_SIZE, JPEG_QUALITY = 480, 75
"""Longer side of the images shown, pixels, and their JPEG quality, 1 to 100."""
HIDDEN_M = 1e-3
"""Image plane distance of a hidden camera, meters: too small to see."""
ASSETS = "RERUN_NOTEBOOK_ASSET"
"""Environment variable that tells rerun_notebook where to load the viewer from; read on import."""
MAX_INLINE_BYTES = 200_000_000
"""Size of a recording up to which the notebook shows it."""
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


@contextmanager
def open_recording(out: str | Path, name: str, blueprint: Any) -> Iterator[rr.RecordingStream]:
    """Yield a stream that writes to the file `out`; after an error in the block, `out` is not written."""
    with write_atomic(out) as temporary:
        # A fixed id, so that a recording replaces an older one of the same name in the viewer.
        stream = rr.RecordingStream(APPLICATION, recording_id=name)
        # Without the time of writing, which would make every file differ.
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        try:
            # Call save before logging, so that entries go to the file at once instead of filling memory.
            stream.save(temporary, default_blueprint=blueprint)
            stream.send_recording_name(name)
            yield stream
            stream.flush()
        finally:
            stream.disconnect()


def open_command(path: str | Path) -> str:
    """Return the command that opens a recording in the viewer."""
    return shlex.join(["rerun", str(path)])


def spawn_viewer(path: str | Path) -> None:
    """Open a recording in a separate viewer process, which outlives this process."""
    subprocess.Popen(
        [sys.executable, "-m", "rerun_cli", str(path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def entity(*parts: str) -> str:
    """Return the path of an entity; parts may contain any character."""
    return "/".join(rr.escape_entity_path_part(part) for part in parts)


def small_jpeg(image: Image, size: int) -> tuple[bytes, tuple[int, int]]:
    """Reduce an image, (H, W, 3) RGB or (H, W), to a longer side of `size` pixels; return a JPEG and (w, h)."""
    small = shrunk(image, size)
    bgr = np.ascontiguousarray(small[..., ::-1]) if small.ndim == 3 else small
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes(), (small.shape[1], small.shape[0])


def shown_intrinsics(camera: "pycolmap.Camera", shown: tuple[int, int]) -> Floats:
    """Return the calibration matrix (3, 3) of a camera for its image at another size (w, h), pixels.

    The top-left corner of the image is (0, 0) at every size, so scaling multiplies the rows of the matrix. Distortion
    is ignored: the viewer draws pinhole cameras, and at this size it is hardly visible.
    """
    return np.diag([shown[0] / camera.width, shown[1] / camera.height, 1.0]) @ camera.calibration_matrix()


def pinhole_of(camera: "pycolmap.Camera", shown: tuple[int, int], depth_m: float, color: str) -> rr.Pinhole:
    """Return a pinhole camera for an image at the size shown (w, h), with the image plane at `depth_m`."""
    return rr.Pinhole(
        image_from_camera=shown_intrinsics(camera, shown),
        resolution=shown,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=depth_m,
        color=rgb(color),
    )


def transform_of(parent_from_child: ArrayLike) -> rr.Transform3D:
    """Return the pose (4, 4) of an entity in its parent."""
    pose = np.asarray(parent_from_child, np.float64)
    w, x, y, z = rotation_to_quaternion(pose[:3, :3])
    return rr.Transform3D(translation=pose[:3, 3], quaternion=rr.Quaternion(xyzw=[x, y, z, w]))


def world_axes(up: Floats) -> Any:
    """Return the viewer's coordinate system whose up axis is the world axis nearest to `up`."""
    axis = int(np.argmax(np.abs(up)))
    return getattr(rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}")


def scene_view(poses: Floats, up: Floats, name: str) -> Any:
    """Return the 3D view, from behind and above the place with the most cameras (N, 4, 4); up (3,) has any length."""
    controls = None
    if len(poses):
        eye = Eye.of(poses, up)
        controls = rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up)
    return rrb.Spatial3DView(origin="world", name=name, eye_controls=controls)


def camera_depth_m(centers: Floats) -> float:
    """Return the image plane distance to draw cameras at (N, 3) with: half the median distance between neighbors."""
    from scipy.spatial import cKDTree

    spots = np.unique(np.round(centers, 2), axis=0)
    if len(spots) < 2:
        return 0.3
    return float(np.clip(np.median(cKDTree(spots).query(spots, k=2)[0][:, 1]) / 2, 0.05, 1.0))


def log_points(stream: rr.RecordingStream, points: ArrayLike, colors: NDArray[np.uint8] | None) -> None:
    """Log the map's points (P, 3), colors (P, 3) RGB or None, as `world/points`."""
    cloud = rr.Points3D(points, colors=rgb(GRAY) if colors is None else colors, radii=rr.Radius.ui_points(1.5))
    stream.log("world/points", cloud, static=True)


def log_lines(stream: rr.RecordingStream, path: str, lines: Sequence[Floats], color: str) -> None:
    """Log lines, (n, 3) each."""
    stream.log(path, rr.LineStrips3D(lines, colors=rgb(color)), static=True)


def hidden_camera() -> rr.Pinhole:
    """Return any camera that is too small to see."""
    return rr.Pinhole(focal_length=1, width=1, height=1, image_plane_distance=HIDDEN_M)


def rgb(color: str) -> list[int]:
    """Return the red, green and blue values of `#rrggbb`."""
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]


# In a notebook


def show_picture(path: str | Path) -> Any:
    """Return a picture file for a notebook, which enlarges it on a click: as it is, or as a JPEG if that is smaller."""
    import PIL.Image
    from IPython.display import HTML

    try:
        with PIL.Image.open(path) as picture:
            small = as_jpeg(picture, picture.width)
        return HTML(zoomable(min(Path(path).read_bytes(), small, key=len), Path(path).stem))
    except (OSError, SyntaxError, ValueError) as error:
        raise ArtifactError(f"{path}: cannot read the picture ({error}). Run the cells above again.") from None


def show_recording(path: str | Path, height: int = 600) -> Any:
    """Show a recording in a notebook: a link, the command that opens it, and the viewer itself, `height` pixels high.

    Return the viewer's widget; None without a viewer. Raise ArtifactError if the recording is missing.
    """
    from IPython.display import HTML, display

    path = Path(path)
    if not path.is_file():
        raise ArtifactError(f"{path}: no such recording. Run the cells above with recordings = True.")
    link = relative_url(path.resolve())
    size_mb = path.stat().st_size / 1e6
    display(
        HTML(
            f'<p>Recording: <a href="{link}" download>{html.escape(path.name)}</a> ({size_mb:.1f} MB). '
            f"Open it in the project's environment with<br><code>{html.escape(open_command(path.resolve()))}</code></p>"
        )
    )
    if path.stat().st_size > MAX_INLINE_BYTES:
        display(HTML("<p>It is too large to show here; use the command.</p>"))
        return None
    viewer = open_viewer(lambda: path, height)
    if viewer is not None:
        display(viewer)
    return viewer


def open_viewer(recording: Callable[[], Path], height: int = 600) -> Any:
    """Return a viewer's widget with a recording, which `recording` returns; None where no viewer can be shown.

    This process serves the viewer, so it needs no network. Saved pages do not store its content, so there is none when
    the pipeline runs the notebook.
    """
    if TEXT_BARS in os.environ:
        return None
    os.environ.setdefault(ASSETS, "serve-local")
    with redirect_stdout(io.StringIO()):  # hide the address that it prints
        import rerun_notebook

    viewer = rerun_notebook.Viewer(width="auto", height=height)
    viewer.send_rrd(recording().read_bytes())
    return viewer


@dataclass(frozen=True, repr=False)
class View3D:
    """A map in 3D, with results. A live notebook shows the rerun viewer; a saved one keeps a picture."""

    answers: Sequence[Answer]
    """Results in one map."""
    rays: bool
    """Whether rays join the cameras of the results with the map points that they see."""
    map_session: Session
    local_map: LocalMap | None
    world_up: ArrayLike | None = None
    unit: tuple[str, float] = ("m", 1.0)

    @classmethod
    def of(cls, answers: Sequence[Answer], rays: bool = False) -> "View3D":
        """Return the view of results, at least one, in the map of the first."""
        first = answers[0]
        return cls(answers, rays, first.map_session, first.local_map, first.settings.world_up, first.unit)

    @cached_property
    def _poses(self) -> Floats:
        poses = self.map_session.world_from_cam()
        return np.asarray(poses[is_posed(poses)])

    @cached_property
    def _cloud(self) -> tuple[Floats, NDArray[np.uint8] | None]:
        return sure_points(self.local_map)

    def save(self, path: str | Path) -> Path:
        """Write a recording for the rerun viewer, `.rrd`, and return its path."""
        cameras = [answer.details.cameras[0] for answer in self.answers]
        errors = [answer.error or (np.nan, np.nan) for answer in self.answers]
        turned, moved = np.reshape(errors, (-1, 2)).T
        columns = QueryResult.failed("").to_row(0, "")  # a map by itself has no answers
        rows = pd.DataFrame([answer.result.to_row(0, "") for answer in self.answers], columns=[*columns])
        table = split_status(rows).assign(rotation_error_deg=turned, translation_error_m=moved)
        estimated = np.array([camera.world_from_cam for camera in cameras]).reshape(-1, 4, 4)
        true = np.array([camera.world_from_cam_true for camera in cameras]).reshape(-1, 4, 4)
        names = [shown_name(answer.name) for answer in self.answers]
        queries = Localizations(names, table, estimated, true, unit=self.unit)
        details = ((number, answer.details) for number, answer in enumerate(self.answers))
        name = f"{self.map_session.id} {len(names)}"
        return record_localizations(path, name, self._poses, *self._cloud, queries, details, self.world_up,
                                    rays=self.rays)  # fmt: skip

    @cached_property
    def figure(self) -> "Figure":
        """The same as a picture, seen from behind the first result with a pose."""
        cameras, rays = list[tuple[Floats, str, str]](), list[tuple[Floats, Floats]]()
        for answer in self.answers:
            camera, name = answer.details.cameras[0], shown_name(answer.name, 40)
            several = f" of {name}" if len(self.answers) > 1 else ""
            poses = [(camera.world_from_cam, f"estimated{several}", ESTIMATED)]
            poses.append((camera.world_from_cam_true, f"true{several}", TRUE))
            poses += [(pose, f"rival, {support:.0%} of the support", BLUE) for pose, support in answer.details.rivals]
            cameras += [of_camera for of_camera in poses if is_posed(of_camera[0])]
            if self.rays and is_posed(camera.world_from_cam):
                rays.append((camera.world_from_cam[:3, 3], camera.points[camera.agrees]))
        up = np.asarray(up_of_cameras(self._poses) if self.world_up is None else self.world_up, np.float64)
        eye = Eye.of(self._poses, up, [pose for pose, _, _ in cameras]).farther(1.4)
        size, points = camera_depth_m(self._poses[:, :3, 3]), self._cloud[0]
        title = f"map of {self.map_session.device}: {len(self._poses)} images, {len(points)} points"
        return draw_scene_3d(*self._cloud, self._poses, eye, size, cameras, rays, title)

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        data = picture_of(self.figure)
        picture: dict[str, Any] = {mime_type(data): data}
        with tempfile.TemporaryDirectory() as folder:
            viewer = open_viewer(lambda: self.save(Path(folder) / "view.rrd"))
        return picture | (viewer._repr_mimebundle_()[0] if viewer is not None else {})


# The queries of a pair


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
    size = camera_depth_m(poses[:, :3, 3])
    count = 0
    with open_recording(out, name, _layout(name, poses, up, len(localizations.names) > 0)) as stream:
        stream.log("world", world_axes(up), static=True)
        log_points(stream, np.asarray(points) + shift, colors)
        cameras = rr.LineStrips3D(pyramids(poses, size).astype(np.float32), colors=rgb(MAP))
        stream.log("world/map_cameras", cameras, static=True)
        _log_overview(stream, localizations, shift)
        for kind, color in (("odometry", ORANGE), ("frames", SKY)):
            if tracks and tracks.get(kind):
                log_lines(stream, f"world/recording/{kind}", [track + shift for track in tracks[kind]], color)
        writer = _ChosenWriter(stream, localizations, 2 * size, shift, rays)
        for number, chosen in prefetch(writer.read, details):
            writer.write(number, chosen)
            count += 1
    logger.info("%s: %d queries, %d of them with details, in %.0f s", out, len(localizations.names), count,
                time.perf_counter() - started)  # fmt: skip
    return Path(out)


def _layout(name: str, poses: Floats, up: Floats, has_queries: bool) -> Any:
    """Return the viewer's layout: the scene, and beside it the chosen query, its references and a text page."""
    scene = scene_view(poses, up, name)
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


def _log_overview(stream: rr.RecordingStream, queries: Localizations, shift: Floats) -> None:
    """Log all queries: estimates and error lines colored by error, true positions, failures at their references."""
    located, has_truth = is_posed(queries.estimated), is_posed(queries.true)
    colors = error_colors(named_as_meters(queries.errors)["translation_error_m"])
    labels = np.array([f"#{k} {describe(queries, k)}" for k in range(len(queries.names))], object)

    def dots(path: str, rows: NDArray[np.bool_], centers: Floats, color: Any, radius: float) -> None:
        style = {"colors": color, "radii": rr.Radius.ui_points(radius), "show_labels": False}
        stream.log(path, rr.Points3D(centers[rows] + shift, labels=labels[rows].tolist(), **style), static=True)

    dots("world/queries/true", has_truth, queries.true[:, :3, 3], rgb(TRUE), 3)
    dots("world/queries/estimated", located, queries.estimated[:, :3, 3], colors[located], 5)
    both = located & has_truth
    lines = np.stack([queries.estimated[both, :3, 3], queries.true[both, :3, 3]], axis=1) + shift
    stream.log("world/queries/error", rr.LineStrips3D(lines.astype(np.float32), colors=colors[both]), static=True)
    if len(queries.nearest_reference):
        lost = ~located & np.isfinite(queries.nearest_reference).all(1)
        dots("world/queries/failed", lost, queries.nearest_reference, rgb(ESTIMATED), 9)
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
        self._jpeg_of = lru_cache(KEPT_JPEGS)(lambda path: small_jpeg(read_for_display(path, IMAGE_SIZE), IMAGE_SIZE))

    def _jpeg(self, image: ShownImage) -> tuple[bytes, tuple[int, int]]:
        pixels = image.image
        return self._jpeg_of(pixels) if isinstance(pixels, Path) else small_jpeg(pixels, IMAGE_SIZE)

    def read(self, numbered: tuple[int, QueryDetails]) -> tuple[int, QueryDetails]:
        """Read the images of a query and keep them; return the arguments of `write`; thread-safe."""
        _, query = numbered
        for image in (*query.cameras[:MAX_CAMERAS], *(image for image, _, _ in query.captioned_references())):
            self._jpeg(image)
        return numbered

    def write(self, number: int, query: QueryDetails) -> None:
        """Log a query. Entities that it lacks are cleared, or those of the last query would stay."""
        stream, references, center = self._stream, query.captioned_references(), self._queries.estimated[number, :3, 3]
        stream.set_time(QUERY, sequence=number)
        for k, image in zip_longest(range(MAX_CAMERAS), query.cameras[:MAX_CAMERAS]):
            self._log_image(f"world/chosen/camera_{k}", image, ESTIMATED, residuals=True)
        for rank, reference in zip_longest(range(1, REFERENCES + 1), references):
            image, _, agrees = reference or (None, "", True)
            self._log_image(f"world/references/{rank}", image, SKY if agrees else ORANGE, residuals=False)
        camera, true = query.cameras[0].camera, query.cameras[0].world_from_cam_true
        has_truth = bool(is_posed(true))
        if has_truth:
            stream.log("world/truth/camera_0", transform_of(shifted(true, self._shift)))
        depth_m = self._depth_m if has_truth else HIDDEN_M
        stream.log("world/truth/camera_0", pinhole_of(camera, (camera.width, camera.height), depth_m, TRUE))
        points = np.concatenate([np.zeros((0, 3)), *(image.points[image.agrees] for image in query.cameras)])
        dots = rr.Points3D(points + self._shift, colors=rgb(GREEN), radii=rr.Radius.ui_points(3))
        stream.log("world/chosen_points", dots)
        located = bool(np.isfinite(center).all())
        ends = [image.world_from_cam[:3, 3] for image in query.references if located]
        lines = [np.stack([center, end]) + self._shift for end in ends]
        stream.log("world/lines", rr.LineStrips3D(lines, colors=rgb(ORANGE)))
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
        covariance = query.position_covariance
        values, vectors = np.linalg.eigh(np.zeros((0, 3, 3)) if covariance is None else covariance[None])
        vectors = vectors * np.sign(np.linalg.det(vectors))[:, None, None]
        region = rr.Ellipsoids3D(
            half_sizes=SURE_3D * np.sqrt(np.maximum(values, 0)),
            centers=[center + self._shift] * len(values),
            quaternions=[rr.Quaternion(xyzw=np.roll(wxyz, -1)) for wxyz in rotation_to_quaternion(vectors)],
            colors=rgb(ESTIMATED),
            fill_mode="majorwireframe",
        )
        self._stream.log("world/uncertainty", region)
        poses = shifted(np.array([pose for pose, _ in query.rivals]).reshape(-1, 4, 4), self._shift)
        labels = [f"rival, {support:.0%} of the support" for _, support in query.rivals]
        lines = pyramids(poses, self._depth_m / 2).astype(np.float32)
        self._stream.log("world/rivals", rr.LineStrips3D(lines, labels=labels, colors=rgb(TRUE), show_labels=False))
        rays = [np.stack([center, point]) + self._shift for point in seen]
        self._stream.log("world/rays", rr.LineStrips3D(rays, colors=rgb(GREEN), radii=rr.Radius.ui_points(0.5)))

    def _log_image(self, path: str, image: ShownImage | None, color: str, residuals: bool) -> None:
        """Log an image (None: a gray one) with its camera, keypoints and, for `residuals`, projected points."""
        stream, measured, agrees = self._stream, np.zeros((0, 2)), np.zeros(0, bool)
        predicted, lines = np.zeros((0, 2)), np.zeros((0, 2, 2))
        if image is None:
            # Keep the size of the last image: the viewer treats the images of an entity as frames of a video.
            width, height = self._sizes.get(path, (4, 3))
            data, _ = small_jpeg(np.full((height, width, 3), 60, np.uint8), max(width, height))
            stream.log(path, hidden_camera())
        else:
            data, self._sizes[path] = self._jpeg(image)
            located = bool(is_posed(image.world_from_cam))
            if located:
                stream.log(path, transform_of(shifted(image.world_from_cam, self._shift)))
            depth_m = self._depth_m if located else HIDDEN_M
            stream.log(path, pinhole_of(image.camera, self._sizes[path], depth_m, color))
            scale = np.array(self._sizes[path]) / [image.camera.width, image.camera.height]
            measured, agrees = image.pixels * scale, image.agrees
            if located and residuals and agrees.any():
                pixels, visible = project(image.points[agrees], image.camera, image.world_from_cam)
                predicted = pixels[visible] * scale
                lines = np.stack([measured[agrees][visible], predicted], axis=1)
        stream.log(f"{path}/image", rr.EncodedImage(contents=data, media_type="image/jpeg"))
        for name, marks, shade, radius in (
            ("reprojected", predicted, rgb(GREEN), 2.5),
            ("measured", measured[agrees], WHITE, 1.5),
            ("rejected", measured[~agrees], rgb(ORANGE), 1.5),
        ):
            dots = rr.Points2D(marks, colors=shade, radii=rr.Radius.ui_points(radius))
            stream.log(f"{path}/marks/{name}", dots)
        stream.log(f"{path}/marks/residuals", rr.LineStrips2D(lines.astype(np.float32), colors=WHITE))


def describe(queries: Localizations, k: int) -> str:
    """Return one line of text about a query: name, status, errors, inliers."""
    row = named_as_meters(queries.errors.iloc[[k]]).iloc[0]
    parts = [str(queries.names[k]), str(row["status_text"])]
    if np.isfinite(row["translation_error_m"]):
        parts.append(f"off by {row['rotation_error_deg']:.2g}°, {row['translation_error_m']:.3g} {queries.unit[0]}")
    return ", ".join(filter(None, [*parts, support_of(row)]))
