"""Show pictures, recordings and a map in 3D in a notebook; the viewer only in an interactive session."""

import html
import io
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit.capture import Session
from toolkit.capture.upright import up_of_cameras
from toolkit.errors import ArtifactError
from toolkit.figures.answers import Answer
from toolkit.figures.query_images import shown_name
from toolkit.figures.scene_3d import Eye, draw_scene_3d
from toolkit.figures.style import BLUE, ESTIMATED, TRUE, as_jpeg, mime_type, picture_of, zoomable
from toolkit.files import relative_url
from toolkit.geometry import Floats
from toolkit.mapping.local_map import LocalMap
from toolkit.results.localized import Localizations, sure_points
from toolkit.results.metrics import is_posed
from toolkit.runs.kernel import TEXT_BARS
from toolkit.viewer.blueprint import camera_depth_m, open_command
from toolkit.viewer.queries import record_localizations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ASSETS = "RERUN_NOTEBOOK_ASSET"
"""Environment variable that tells rerun_notebook where to load the viewer from; read on import."""
MAX_INLINE_BYTES = 200_000_000
"""Size of a recording up to which the notebook shows it."""


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
        table = pd.DataFrame({
            "status": [answer.result.status_text for answer in self.answers],
            "method": [answer.result.found_by for answer in self.answers],
            "num_inliers": [answer.result.num_inliers for answer in self.answers],
            "rotation_error_deg": [error[0] for error in errors],
            "translation_error_m": [error[1] for error in errors],
        })  # fmt: skip
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
