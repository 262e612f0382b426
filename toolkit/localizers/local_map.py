"""The triangulated map as arrays: posed images, points, and which keypoint of which image sees which point."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture.cameras import camera_text, parse_camera, projection_jacobian
from toolkit.errors import ArtifactError
from toolkit.files import require_whole, write_atomic

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Consistency:
    """How well the poses of a map agree with its images."""

    verdict: str = "unknown"
    """`consistent`, `inconsistent` or `unknown`: too few matches to tell."""
    pairs: int = 0
    """Image pairs whose matches were verified without poses ..."""
    agreeing: int = 0
    """... and of these, such as the poses agree with."""
    fits: str = ""
    """Of an inconsistent map: the convention under which the poses would agree; empty: none of those tried."""
    seen_by_three: float = 0.0
    """Share of the points that at least three images see."""
    wrong: list[str] = field(default_factory=list)
    """Images whose poses contradict those of the others."""

    @property
    def text(self) -> str:
        """What people should know, in a sentence or two; empty where all is well."""
        if self.verdict == "inconsistent":
            cause = f"They would as: {self.fits}." if self.fits else (
                "No usual convention fits: do the poses, names and intrinsics belong to these images?"
            )  # fmt: skip
            return (
                "the poses of the map contradict its images: of "
                f"{self.pairs} image pairs whose matches were verified, {self.agreeing} agree with them. {cause}"
            )
        if self.wrong:
            shown = ", ".join(self.wrong[:8]) + (f" and {len(self.wrong) - 8} more" if len(self.wrong) > 8 else "")
            return f"{len(self.wrong)} map images have poses that contradict the others: {shown}"
        if self.verdict == "unknown":
            agree = f", {self.agreeing} of which agree with them" if self.pairs else ""
            return (
                "too few matches to tell whether the poses of the map are right "
                f"({self.pairs} verified image pairs{agree})"
            )
        return ""


@dataclass(frozen=True)
class LocalMap:
    """Posed images and the points triangulated from them, as arrays.

    Observations are sorted by image; observation o says that keypoint `obs_keypoint[o]` of image `obs_image[o]` sees
    point `obs_point[o]`.
    """

    image_names: list[str]
    """N names (`Session.image_name`)."""
    cameras: list[pycolmap.Camera]
    """N cameras, with distortion, as in the capture."""
    world_from_cams: Floats
    """(N, 4, 4)."""
    points: Floats
    """(P, 3) in the world, meters."""
    colors: NDArray[np.uint8]
    """(P, 3) RGB."""
    obs_image: NDArray[np.int64]
    obs_keypoint: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    noise_px: NDArray[np.float32]
    """(P,) standard deviation of the observations of each point, by axis; all of one kind of features have the same."""
    length: float = 1.0
    """What localizers take as a meter, in the unit of the poses; see `Survey.length`."""
    consistency: Consistency = field(default_factory=Consistency)

    @cached_property
    def index_of(self) -> dict[str, int]:
        """Index of an image by its name."""
        return {name: index for index, name in enumerate(self.image_names)}

    @cached_property
    def cams_from_world(self) -> Floats:
        return geometry.invert(self.world_from_cams)

    @cached_property
    def focals_px(self) -> Floats:
        return np.array([camera.mean_focal_length() for camera in self.cameras])

    @cached_property
    def track_lengths(self) -> NDArray[np.int64]:
        """(P,) images that see each point."""
        return np.bincount(self.obs_point, minlength=len(self.points))

    @cached_property
    def _image_starts(self) -> NDArray[np.int64]:
        return np.searchsorted(self.obs_image, np.arange(len(self.image_names) + 1))

    @cached_property
    def _by_point(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        order = np.argsort(self.obs_point, kind="stable")
        return order, np.searchsorted(self.obs_point[order], np.arange(len(self.points) + 1))

    def observations(self, image: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the keypoints (n,) of an image that see a point, and the points (n,)."""
        part = slice(self._image_starts[image], self._image_starts[image + 1])
        return self.obs_keypoint[part], self.obs_point[part]

    def point_covariances(self, points: NDArray[np.int64]) -> Floats:
        """Return the covariance (n, 3, 3) of the places of n points, square meters, as least squares triangulate them.

        A point that fewer than two images see has NaN.
        """
        order, starts = self._by_point
        counts = starts[points + 1] - starts[points]
        which = np.repeat(np.arange(len(points)), counts)  # the point of each observation
        within = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        image = self.obs_image[order[np.repeat(starts[points], counts) + within]]
        # Keypoints of one image at one place (two orientations) are one view.
        which, image = np.unique(np.column_stack([which, image]), axis=0).T
        views = np.bincount(which, minlength=len(points))
        in_cams = geometry.transform(self.cams_from_world[image], self.points[points[which], None])[:, 0]
        jacobian = projection_jacobian(in_cams, self.focals_px[image]) @ self.cams_from_world[image, :3, :3]
        information = np.zeros((len(points), 3, 3))
        np.add.at(information, which, np.einsum("oki,okj->oij", jacobian, jacobian))
        # A little damping, so that two views from one place are uncertain and not an error.
        information += 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        covariances = np.full((len(points), 3, 3), np.nan)
        noise_px2 = self.noise_px[points].astype(np.float64) ** 2
        covariances[views > 1] = noise_px2[views > 1, None, None] * np.linalg.inv(information[views > 1])
        return covariances

    def images_seeing(self, points: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many of the given points each image sees, (N,)."""
        order, starts = self._by_point
        seen = np.concatenate([order[starts[p] : starts[p + 1]] for p in points] or [np.zeros(0, np.int64)])
        return np.bincount(self.obs_image[seen], minlength=len(self.image_names))

    def shared_points(self, images: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many points each two of n images both see, (n, n)."""
        seen = [np.unique(self.observations(int(image))[1]) for image in images]
        return np.array([[len(np.intersect1d(a, b, assume_unique=True)) for b in seen] for a in seen], np.int64)

    def around(self, images: NDArray[np.int64]) -> tuple["LocalMap", NDArray[np.int64]]:
        """Return the part of the map that the images, and those that share points with them, see.

        Returns:
            A map of the same images with some of the points, and the index of each of these here.
        """
        seen = np.concatenate([np.zeros(0, np.int64), *(self.observations(int(image))[1] for image in images)])
        covisible = np.flatnonzero(self.images_seeing(np.unique(seen)))
        points = np.unique(np.concatenate([np.zeros(0, np.int64), *(self.observations(int(i))[1] for i in covisible)]))
        place = np.full(len(self.points), -1, np.int64)
        place[points] = np.arange(len(points))
        there = place[self.obs_point] >= 0
        part = replace(
            self,
            points=self.points[points],
            colors=self.colors[points],
            obs_image=self.obs_image[there],
            obs_keypoint=self.obs_keypoint[there],
            obs_point=place[self.obs_point[there]],
            noise_px=self.noise_px[points],
        )
        return part, points

    def scaled(self, factor: float) -> "LocalMap":
        """Return the map with all lengths times a factor."""
        if factor == 1.0:
            return self
        poses = geometry.make_pose(self.world_from_cams[:, :3, :3], factor * self.world_from_cams[:, :3, 3])
        return replace(self, world_from_cams=poses, points=factor * self.points, length=factor * self.length)

    @classmethod
    def pooled(cls, maps: Sequence["LocalMap"]) -> "LocalMap":
        """Return one map of maps of one session, each triangulated from another kind of features.

        The points of one map follow those of the map before. A keypoint is one of the kind that its point is of, so
        the point tells the kind.
        """
        if len(maps) == 1:
            return maps[0]
        cameras: dict[str, tuple[pycolmap.Camera, Floats]] = {}
        same = all(one.image_names is maps[0].image_names for one in maps)
        for one in maps[:1] if same else maps:
            for name, camera, pose in zip(one.image_names, one.cameras, one.world_from_cams, strict=True):
                cameras.setdefault(name, (camera, pose))
        index_of = {name: index for index, name in enumerate(cameras)}
        starts = np.cumsum([0, *(len(one.points) for one in maps)])
        image = np.concatenate(
            [np.array([index_of[name] for name in one.image_names], np.int64)[one.obs_image] for one in maps]
        )
        point = np.concatenate([one.obs_point + start for one, start in zip(maps, starts[:-1], strict=True)])
        order = np.argsort(image, kind="stable")
        return cls(
            image_names=list(cameras),
            cameras=[camera for camera, _ in cameras.values()],
            world_from_cams=np.stack([pose for _, pose in cameras.values()]),
            points=np.concatenate([one.points for one in maps]),
            colors=np.concatenate([one.colors for one in maps]),
            obs_image=image[order],
            obs_keypoint=np.concatenate([one.obs_keypoint for one in maps])[order],
            obs_point=point[order],
            noise_px=np.concatenate([one.noise_px for one in maps]),
            length=maps[0].length,
            consistency=maps[0].consistency,
        )

    def save(self, path: str | Path) -> None:
        """Write the map as one `.npz` file."""
        arrays: dict[str, Any] = {
            "image_names": np.array(self.image_names, np.str_),
            "cameras": np.array([camera_text(camera) for camera in self.cameras], np.str_),
        }
        for name in ("world_from_cams", "points", "colors", "obs_image", "obs_keypoint", "obs_point", "noise_px"):
            arrays[name] = getattr(self, name)
        arrays["length"] = np.float64(self.length)
        arrays["consistency"] = np.array(json.dumps(asdict(self.consistency)))
        with write_atomic(path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "LocalMap":
        """Read a map.

        Raises:
            ArtifactError: the file is missing or damaged.
        """
        require_whole(path)
        try:
            with np.load(path) as arrays:
                data = {name: arrays[name] for name in arrays.files}
            names, cameras = data.pop("image_names").tolist(), data.pop("cameras").tolist()
            return cls(
                image_names=names,
                cameras=[parse_camera("camera", text) for text in cameras],
                length=float(data.pop("length")),
                consistency=Consistency(**json.loads(str(data.pop("consistency")))),
                **data,
            )
        except (OSError, EOFError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise ArtifactError(
                f"The triangulated map {path} cannot be read ({error}). Build it with the localize stage."
            ) from None


def map_path(map_dir: str | Path, session_id: str, features: str = "sift") -> Path:
    """Return the file of a session's map of one kind of features; that of SIFT has the session's name alone."""
    return Path(map_dir) / (f"{session_id}.npz" if features == "sift" else f"{session_id}-{features}.npz")
