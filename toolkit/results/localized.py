"""Images of localized queries and of their references, with correspondences, as figures and the viewer draw them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture import Capture, Session
from toolkit.geometry import Floats, Ints, invert
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import QueryResult, Status, View, carried_over
from toolkit.results.metrics import is_posed
from toolkit.results.pair import PairResults

if TYPE_CHECKING:
    import pycolmap

REFERENCES = 4
"""References shown per query, at most."""
MAX_POINTS = 1_000_000
"""Points of a map that are shown, at most: a viewer needs about 30 bytes for each."""


def sure_points(local_map: LocalMap | None) -> tuple[Floats, NDArray[np.uint8] | None]:
    """Return the points seen by at least three images, (P, 3), and their colors (P, 3) RGB; other points are noisy.

    A large map is reduced to a regular sample of at most `MAX_POINTS`.
    """
    if local_map is None:
        return np.zeros((0, 3)), None
    sure = np.flatnonzero(np.diff(local_map.point_starts) >= 3)
    sure = sure[:: -(-len(sure) // MAX_POINTS) or 1]
    return local_map.points[sure], local_map.colors[sure]


@dataclass(frozen=True)
class ShownImage:
    """A posed image and its correspondences."""

    name: str
    image: Path | NDArray[np.uint8]
    """File, or pixels (H, W) or (H, W, 3) RGB."""
    camera: "pycolmap.Camera"
    world_from_cam: Floats
    """(4, 4); NaN if unknown."""
    pixels: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """(n, 2) measured keypoints, pixels of the full image."""
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) map points, world, meters."""
    matches: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(n,) numbers of the correspondences; pixels with the same number in two images match."""
    agrees: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(n,) whether each correspondence agrees with the pose."""
    world_from_cam_true: Floats = field(default_factory=lambda: np.full((4, 4), np.nan))
    """(4, 4); NaN if unknown."""
    found_by: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, np.str_))
    """(n,) how each correspondence was found, such as `sift/guided`."""

    @property
    def num_agreeing(self) -> int:
        """Number of correspondences that agree with the pose, guided ones too; not that of inliers."""
        return int(self.agrees.sum())

    @property
    def ratio(self) -> float:
        """Width by height."""
        return float(self.camera.width / self.camera.height)


_OF_A_MATCH = ("pixels", "points", "matches", "agrees", "found_by")


@dataclass(frozen=True)
class QueryDetails:
    """Images and correspondences of one query."""

    cameras: Sequence[ShownImage]
    """Its images, at the estimated pose; the one with the most points that agree first."""
    references: Sequence[ShownImage] = ()
    """Map images that it was localized with, best first."""
    rejected: Sequence[ShownImage] = ()
    """References that contradict the references used."""
    result: QueryResult = field(default_factory=lambda: QueryResult(Status.FAILED))
    rig_from_cam: Floats = field(default_factory=lambda: np.eye(4))
    """Pose of the first image, (4, 4)."""

    @property
    def has_matches(self) -> bool:
        """Whether the method matched keypoints, rather than used the poses of whole references."""
        return any(len(camera.matches) for camera in self.cameras)

    def of_first_camera(self) -> "QueryDetails":
        """Return the first image alone, and references with only its correspondences."""

        def reduced(image: ShownImage) -> ShownImage:
            chosen = np.isin(image.matches, self.cameras[0].matches)
            return replace(image, **{name: getattr(image, name)[chosen] for name in _OF_A_MATCH})

        return replace(self, cameras=self.cameras[:1], references=list(map(reduced, self.references)))

    @property
    def rivals(self) -> list[tuple[Floats, float]]:
        """world_from_cam (4, 4) of the first image at each rival pose, and the rival's share of the support."""
        return [(rival.world_from_rig @ self.rig_from_cam, rival.support) for rival in self.result.rivals]

    @property
    def position_covariance(self) -> Floats | None:
        """Covariance (3, 3) of the first image's position in the world, square meters; None if it is unknown."""
        pose, covariance = self.result.world_from_rig, self.result.covariance
        if pose is None or covariance is None:
            return None
        of_cam = carried_over(covariance, invert(self.rig_from_cam))[3:, 3:]
        R = pose[:3, :3] @ self.rig_from_cam[:3, :3]
        return R @ of_cam @ R.T

    def captioned_references(self) -> list[tuple[ShownImage, str, bool]]:
        """Return at most `REFERENCES` references, up to two of them rejected: image, caption, whether used."""
        agree = [
            (image, f"reference {rank}" + (f": sees {image.num_agreeing} points" if self.has_matches else ""), True)
            for rank, image in enumerate(self.references, start=1)
        ]
        rejected = [(image, "rejected: contradicts the others", False) for image in self.rejected]
        return [*agree[: REFERENCES - min(2, len(rejected))], *rejected][:REFERENCES]


def is_predicted(method: str) -> bool:
    """Tell whether a pose is that of a network, from the column `method`, such as `hybrid:vggt/feed_forward`."""
    return method.rpartition("/")[2].startswith("feed_forward")


def support_of(row: pd.Series) -> str:
    """Return the support of the pose in a row of a pair's csv as text, such as `120 inliers`; empty if it has none."""
    if row.get("num_inliers", 0) > 0:
        return f"{row['num_inliers']:.0f} inliers"
    if is_predicted(str(row.get("method"))) and pd.notna(references := row.get("references", np.nan)):
        return f"{references.count(';') + 1} consistent references"
    return ""


@dataclass(frozen=True)
class Localizations:
    """The queries of a pair, one row each; a rig is represented by its first image."""

    names: Sequence[str]
    errors: pd.DataFrame
    """The pair's csv with the errors of the rig, see `PairResults.errors`."""
    estimated: Floats
    """world_from_cam (Q, 4, 4), NaN without a pose."""
    true: Floats
    """True world_from_cam (Q, 4, 4), NaN where unknown."""
    nearest_reference: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """World position (Q, 3) of the first reference of each query without a pose; else NaN."""
    unit: tuple[str, float] = ("m", 1.0)
    """Unit that lengths are shown in, see `metrics.length_unit`."""


@dataclass
class LocalizedPair:
    """The queries of a pair in their map. Images and correspondences of a query are read on demand."""

    results: PairResults
    """Of the queries with an image."""
    map_session: Session
    query_session: Session
    rows: list[Ints]
    """For each query, the rows of its images in the session."""
    local_map: LocalMap | None
    """The triangulated maps that the run used, pooled."""

    @classmethod
    def open(
        cls, capture: Capture, map_device: str, query_device: str, poses_dir: str | Path, map_dir: str | Path | None
    ) -> "LocalizedPair":
        """Open the stored results of the localize stage for a pair; raise ArtifactError if they are missing or torn."""
        session = capture[f"{query_device}_query"]
        results = PairResults.of(poses_dir, capture.name, map_device, query_device)
        rows = session.rows_of_keyframes(results.table)
        has_image = np.array([len(images) > 0 for images in rows], bool)
        results = replace(results, table=results.table[has_image].reset_index(drop=True))
        _ = results.poses, results.maps  # a missing file is reported here
        images, local_map = [images for images in rows if len(images)], results.local_map(map_dir)
        return cls(results, capture[f"{map_device}_map"], session, images, local_map)

    @property
    def name(self) -> str:
        return self.results.path.stem

    @cached_property
    def true_poses(self) -> Floats:
        """True world_from_rig (Q, 4, 4), NaN where unknown."""
        truth, table = self.query_session.ground_truth, self.results.table
        unknown = np.full((len(table), 4, 4), np.nan)
        return unknown if truth is None else truth.lookup(table["timestamp"].to_numpy(), table["device_id"])

    @cached_property
    def localizations(self) -> Localizations:
        session, row_of_name = self.query_session, self.map_session.row_of_name
        first = np.array([rows[0] for rows in self.rows], np.int64)
        rig_from_cam = session.rig_from_cam(first)
        centers = np.full((len(first), 3), np.nan)
        for k in np.flatnonzero(~is_posed(self.results.poses)):
            if known := [row_of_name[name] for name in self.results[int(k)].references if name in row_of_name]:
                centers[k] = self.map_session.world_from_cam(known[:1])[0, :3, 3]
        return Localizations(
            [session.image_name(int(row)) for row in first],
            self.results.errors(self.true_poses),
            self.results.poses @ rig_from_cam,
            self.true_poses @ rig_from_cam,
            centers,
            self.results.unit,
        )

    def details(self, k: int) -> QueryDetails:
        """Return images, correspondences and references of query k."""
        true = self.true_poses[k]
        return query_details(self.results[k], *self.views(k), self.map_session, true if is_posed(true) else None)

    def views(self, k: int) -> tuple[list[View], Floats]:
        """Return the images of query k, and their rig_from_cam (C, 4, 4)."""
        session, rows = self.query_session, self.rows[k]
        named = ((session.image_name(row), session.image_path(row)) for row in rows.tolist())
        cameras = session.cameras(rows)
        views = [View(*of_file, camera, in_map=False) for of_file, camera in zip(named, cameras, strict=True)]
        return views, session.rig_from_cam(rows)


def query_details(
    result: QueryResult,
    views: Sequence[View],
    rig_from_cams: Floats,
    map_session: Session,
    world_from_rig_true: Floats | None = None,
) -> QueryDetails:
    """Return images, at their poses rig_from_cam (C, 4, 4), correspondences and references of a query."""
    unknown = np.full((4, 4), np.nan)
    pose = unknown if result.world_from_rig is None else result.world_from_rig
    true = unknown if world_from_rig_true is None else world_from_rig_true
    found, cameras = result.correspondences, []
    for view, rig_from_cam in zip(views, rig_from_cams, strict=True):
        number = result.images.index(view.name) if view.name in result.images else -1
        matches = np.flatnonzero(found.camera == number)
        of_image = view.name, view.image, view.camera, pose @ rig_from_cam
        cameras.append((_shown(result, matches, true @ rig_from_cam, *of_image, found.pixels[matches]), rig_from_cam))
    cameras.sort(key=lambda camera: -camera[0].num_agreeing)
    used = _references(map_session, result, {name: number for number, name in enumerate(result.references)})
    rejected = _references(map_session, result, dict.fromkeys(result.rejected, -1))
    return QueryDetails([image for image, _ in cameras], used, rejected, result, cameras[0][1])


def _references(session: Session, result: QueryResult, numbers: Mapping[str, int]) -> list[ShownImage]:
    """Return the first few map images with their correspondences; `numbers` are those of references by name."""
    matches, images = result.correspondences, []
    for name in [name for name in numbers if name in session.row_of_name][:REFERENCES]:
        row, views = session.row_of_name[name], np.flatnonzero(matches.view_reference == numbers[name])
        of_image = name, session.image_path(row), session.cameras([row])[0], session.world_from_cam([row])[0]
        true = session.world_from_cam([row], ground_truth=True)[0]
        images.append(_shown(result, matches.view_of[views], true, *of_image, matches.view_pixels[views]))
    return images


def _shown(result: QueryResult, matches: Ints, true: Floats, *of_image: Any) -> ShownImage:
    """Return an image (name, file, camera, pose, pixels of its matches) with its matches and its true pose."""
    found = result.correspondences
    of_matches = found.points[matches], matches, found.agrees[matches], true, found.found_by[matches]
    return ShownImage(*(*of_image, *of_matches))
