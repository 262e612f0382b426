"""A map and results in it in 3D, inline in a notebook: the rerun viewer, or a picture where there is none."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit.capture import Session
from toolkit.capture.world_up import up_of_cameras
from toolkit.figures.answers import Answer
from toolkit.figures.query_images import shown_name
from toolkit.figures.scene_3d import Eye, draw_scene_3d
from toolkit.figures.style import BLUE, ESTIMATED, TRUE, mime_type, picture_of
from toolkit.geometry import Floats
from toolkit.mapping.local_map import LocalMap
from toolkit.results.localized import Localizations, sure_points
from toolkit.results.metrics import is_posed
from toolkit.viewer.blueprint import camera_depth_m
from toolkit.viewer.inline import open_viewer
from toolkit.viewer.queries import record_localizations

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
