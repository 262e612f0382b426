"""The triangulated map as arrays: posed images, points, and observations of points by keypoints."""

import json
import struct
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from mmap import ACCESS_READ, mmap
from os import SEEK_CUR
from pathlib import Path
from typing import Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.capture.images import camera_text, parse_camera, projection_jacobian
from toolkit.errors import COMMAND, ArtifactError
from toolkit.files import require_whole, write_atomic
from toolkit.geometry import Floats, Ints

_ARRAYS = ("world_from_cams", "points", "colors", "obs_image", "obs_keypoint", "obs_point", "noise_px")
ORDERS = ("image_starts", "by_point", "point_starts")
"""Arrays of a map file: fields of `LocalMap`, and sorting orders, which would take the whole map to compute."""
IN_MEMORY = 1 << 26
"""Largest map file in bytes that is read when it is opened, so that it can be overwritten. Larger ones are mapped."""
_BLOCK = 1 << 18  # number of points processed at once
OPENGL_AXES = "camera axes as in OpenGL (x right, y up, z backward)"
"""A convention that may fit an inconsistent map. It also fits poses whose axes were converted but should not have."""
_PADDING = 0xD935  # header ID of a zip extra field that readers ignore, as `zipalign` uses it


@dataclass(frozen=True)
class Consistency:
    """How well the poses of a map agree with its images."""

    verdict: str = "unknown"  # `consistent`, `inconsistent`, or `unknown` if there are too few matches to tell
    pairs: int = 0  # number of image pairs whose matches were verified without poses
    agreeing: int = 0  # number of these pairs whose matches agree with the poses
    fits: str = ""  # for an inconsistent map, the convention with which the poses would agree; empty if none was found
    seen_by_three: float = 0.0  # share of the points that at least three images observe
    wrong: list[str] = field(default_factory=list)  # images whose poses contradict those of the other images
    camera: str = ""  # for a map whose intrinsics do not fit its images, those that would fit
    rotation_noise_deg: float = 0.0  # standard deviation of the noise of the poses, per axis
    position_noise: float = 0.0  # in map lengths, see `LocalMap.length`, per axis
    direction_noise_deg: float = 0.0  # of the direction to a point at the median depth, due to both, per axis

    @property
    def trusted(self) -> bool:
        """Whether the map may give poses that are `ok`."""
        return self.verdict != "inconsistent" and not self.camera

    @property
    def text(self) -> str:
        """Warning for the user, one or two sentences; empty if there is none."""
        if self.verdict == "inconsistent":
            cause = f"They would agree with: {self.fits}." if self.fits else (
                "No usual convention fits: do the poses, names and intrinsics belong to these images?"
            )  # fmt: skip
            if self.fits.startswith(("rotations of cam_from_world", "camera centers that were")):
                cause += " If imported from a table: give `--poses-are rotation_of_cam_from_world`."
            if OPENGL_AXES in self.fits:
                cause += f" If imported: give the other `--axes`, opencv or opengl, to `{COMMAND} import`."
            agree = f"{self.agreeing} of {self.pairs} image pairs with verified matches agree with the poses"
            return f"the poses of the map contradict its images: {agree}. {cause}"
        if self.camera:
            return f"the intrinsics of the map contradict its images: {self.camera}. Correct them and localize again"
        if self.wrong:
            names = ", ".join(self.wrong[:8]) + (f" and {len(self.wrong) - 8} more" if len(self.wrong) > 8 else "")
            return f"{len(self.wrong)} map images have poses that contradict the others: {names}"
        if self.verdict == "unknown":
            found = f"{self.pairs} verified image pairs"
            found += f", {self.agreeing} of which agree with them" if self.pairs else ""
            return f"too few matches to tell whether the poses of the map are right ({found})"
        return ""


@dataclass(frozen=True)
class LocalMap:
    """Posed images and the points triangulated from them, as arrays.

    Observations are sorted by image: in observation o, keypoint `obs_keypoint[o]` of image `obs_image[o]` observes
    point `obs_point[o]`. The arrays of a large map stay in its file and are read only where they are used.
    """

    image_names: list[str]  # N names (`Session.image_name`)
    cameras: list[pycolmap.Camera]  # N cameras, with distortion, as in the capture
    world_from_cams: Floats  # (N, 4, 4)
    points: Floats  # (P, 3) in the world, meters
    colors: NDArray[np.uint8]  # (P, 3) RGB
    obs_image: Ints
    obs_keypoint: Ints
    obs_point: Ints
    noise_px: NDArray[np.float32]  # (P,) standard deviation of a point's observations per axis; equal for one kind
    length: float = 1.0  # that localizers treat as one meter, in the unit of the poses; see `PoseConsistency.length`
    consistency: Consistency = field(default_factory=Consistency)

    @cached_property
    def index_of(self) -> dict[str, int]:
        """Index of each image by its name."""
        return {name: index for index, name in enumerate(self.image_names)}

    @cached_property
    def cams_from_world(self) -> Floats:
        return geometry.invert(self.world_from_cams)

    @cached_property
    def focals_px(self) -> Floats:
        return np.array([camera.mean_focal_length() for camera in self.cameras])

    @cached_property
    def image_starts(self) -> Ints:
        """(N + 1,) index of the first observation of each image."""
        return np.searchsorted(self.obs_image, np.arange(len(self.image_names) + 1))

    @cached_property
    def by_point(self) -> Ints:
        """Indices of the observations, sorted by their points."""
        return np.argsort(self.obs_point, kind="stable")

    @cached_property
    def point_starts(self) -> Ints:
        """(P + 1,) index in `by_point` of the first observation of each point."""
        return np.searchsorted(self.obs_point[self.by_point], np.arange(len(self.points) + 1))

    def track_lengths(self, points: Ints) -> Ints:
        """Return the number of observations (n,) of each of n points."""
        return self.point_starts[points + 1] - self.point_starts[points]

    def observations(self, image: int) -> tuple[Ints, Ints]:
        """Return the keypoints (n,) of an image that observe a point, and these points (n,)."""
        part = slice(self.image_starts[image], self.image_starts[image + 1])
        return self.obs_keypoint[part], self.obs_point[part]

    def observations_of(self, points: Ints) -> Ints:
        """Return the indices of all observations of points, in the order of the points."""
        counts = self.track_lengths(points)
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        return self.by_point[np.repeat(self.point_starts[points], counts) + within]

    def point_covariances(self, points: Ints) -> Floats:
        """Return the covariances (n, 3, 3) of n points from least squares triangulation, square meters.

        They are NaN for points that fewer than two images observe.
        """
        which = np.repeat(np.arange(len(points)), self.track_lengths(points))  # the point of each observation
        image = self.obs_image[self.observations_of(points)]
        # Two keypoints of one image at one position (two orientations) are one view.
        which, image = geometry.unique_columns(np.stack([which, image]))
        views = np.bincount(which, minlength=len(points))
        in_cams = geometry.transform(self.cams_from_world[image], self.points[points[which], None])[:, 0]
        jacobian = projection_jacobian(in_cams, self.focals_px[image]) @ self.cams_from_world[image, :3, :3]
        information = np.zeros((len(points), 3, 3))
        np.add.at(information, which, np.einsum("oki,okj->oij", jacobian, jacobian))
        # With a little damping, two views from one position give a large covariance instead of a singular matrix.
        information += 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        covariances = np.full((len(points), 3, 3), np.nan)
        noise_px2 = self.noise_px[points].astype(np.float64) ** 2
        covariances[views > 1] = noise_px2[views > 1, None, None] * np.linalg.inv(information[views > 1])
        return covariances

    def images_seeing(self, points: Ints) -> Ints:
        """Return how many of the given points each image observes, (N,)."""
        counts = np.zeros(len(self.image_names), np.int64)
        for start in range(0, len(points), _BLOCK):
            images = self.obs_image[self.observations_of(points[start : start + _BLOCK])]
            counts += np.bincount(images, minlength=len(counts))
        return counts

    def shared_points(self, images: Ints) -> Ints:
        """Return the number of points that each two of n images share, (n, n)."""
        seen = [np.unique(self.observations(int(image))[1]) for image in images]
        return np.array([[len(np.intersect1d(a, b, assume_unique=True)) for b in seen] for a in seen], np.int64)

    def around(self, images: Ints) -> tuple["LocalMap", Ints]:
        """Return the part of the map that some images, and all images covisible with them, observe.

        Returns:
            A map of the same images with some of the points, and the indices of these points in this map.
        """
        seen = np.concatenate([np.zeros(0, np.int64), *(self.observations(int(image))[1] for image in images)])
        covisible = np.flatnonzero(self.images_seeing(np.unique(seen)))
        points = np.unique(np.concatenate([np.zeros(0, np.int64), *(self.observations(int(i))[1] for i in covisible)]))
        return self.part(points)._sharing(self), points

    def part(self, points: Ints) -> "LocalMap":
        """Return a map of the same images with some of the points, given by ascending index."""
        kept = np.sort(self.observations_of(points))
        return replace(
            self,
            points=self.points[points],
            colors=self.colors[points],
            obs_image=self.obs_image[kept],
            obs_keypoint=self.obs_keypoint[kept],
            obs_point=np.searchsorted(points, self.obs_point[kept]),
            noise_px=self.noise_px[points],
        )

    def scaled(self, factor: float) -> "LocalMap":
        """Return the map with all lengths multiplied by a factor."""
        if factor == 1.0:
            return self
        poses = geometry.make_pose(self.world_from_cams[:, :3, :3], factor * self.world_from_cams[:, :3, 3])
        scaled = replace(self, world_from_cams=poses, points=factor * self.points, length=factor * self.length)
        return scaled._ordered_as(self)

    @classmethod
    def pooled(cls, maps: Sequence["LocalMap"]) -> "LocalMap":
        """Return one map with the points of several maps of one session, one for each kind of features.

        The points are in the order of the maps, so the index of a point tells its kind. `obs_keypoint` counts the
        keypoints of that kind.
        """
        if len(maps) == 1:
            return maps[0]
        first = maps[0]
        same = all(one.image_names is first.image_names for one in maps)
        if same:
            names, cameras, poses = first.image_names, first.cameras, first.world_from_cams
            images = [one.obs_image for one in maps]
        else:
            posed: dict[str, tuple[pycolmap.Camera, Floats]] = {}
            for one in maps:
                for name, camera, pose in zip(one.image_names, one.cameras, one.world_from_cams, strict=True):
                    posed.setdefault(name, (camera, pose))
            names, cameras = list(posed), [camera for camera, _ in posed.values()]
            poses = np.stack([pose for _, pose in posed.values()])
            index_of = {name: index for index, name in enumerate(names)}
            images = [np.array([index_of[name] for name in one.image_names], np.int64)[one.obs_image] for one in maps]
        starts = np.cumsum([0, *(len(one.points) for one in maps)])
        image = np.concatenate(images)
        point = np.concatenate([one.obs_point + start for one, start in zip(maps, starts[:-1], strict=True)])
        order = np.argsort(image, kind="stable")
        names_of = ("points", "colors", "obs_keypoint", "noise_px")
        joined: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in maps]) for name in names_of}
        joined |= {"obs_image": image[order], "obs_keypoint": joined["obs_keypoint"][order], "obs_point": point[order]}
        pooled = replace(first, image_names=names, cameras=cameras, world_from_cams=poses, **joined)
        return pooled._sharing(first) if same else pooled

    def judged(self, consistency: Consistency) -> "LocalMap":
        """Return the map with another consistency."""
        return replace(self, consistency=consistency)._ordered_as(self)

    def knowing(self, **properties: Any) -> "LocalMap":
        """Set cached properties of this map, so that they are not computed; return the map."""
        vars(self).update(properties)
        return self

    def _ordered_as(self, other: "LocalMap") -> "LocalMap":
        """Return this map with the sorting orders that another map of the same observations has."""
        return self.knowing(**{name: order for name, order in vars(other).items() if name in ORDERS})

    def _sharing(self, other: "LocalMap") -> "LocalMap":
        """Return this map with the cached image properties of another map of the same images."""
        return self.knowing(**{name: getattr(other, name) for name in ("index_of", "cams_from_world", "focals_px")})

    def save(self, path: str | Path) -> None:
        """Write the map as one `.npz` file."""
        arrays: dict[str, Any] = {
            "image_names": np.array(self.image_names, np.str_),
            "cameras": np.array([camera_text(camera) for camera in self.cameras], np.str_),
            "length": np.float64(self.length),
            "consistency": np.array(json.dumps(asdict(self.consistency))),
        }
        arrays |= {name: getattr(self, name) for name in (*_ARRAYS, *ORDERS)}
        with write_atomic(path) as temporary, open(temporary, "wb") as stream, ZipFile(stream, "w") as archive:
            for name, array in arrays.items():
                member = ZipInfo(f"{name}.npy")
                # For memory mapping, arrays start at multiples of 64 bytes. As in `zipalign`, an extra field pads them:
                # it follows a header of 30 bytes, the name, and 20 bytes of sizes.
                padding = -(stream.tell() + 30 + len(member.filename) + 20 + 4) % 64
                member.extra = struct.pack("<HH", _PADDING, padding) + bytes(padding)
                with archive.open(member, "w", force_zip64=True) as out:
                    np.lib.format.write_array(out, np.asanyarray(array), allow_pickle=False)

    @classmethod
    def load(cls, path: str | Path) -> "LocalMap":
        """Open a map. The arrays of a map larger than `IN_MEMORY` stay in the file and are read where they are used.

        Raises:
            ArtifactError: the file is missing or damaged.
        """
        require_whole(path)
        parse = lru_cache(maxsize=None)(lambda text: parse_camera("camera", text))  # most images share a few
        try:
            arrays = _arrays_of(Path(path))
            opened = cls(
                image_names=arrays["image_names"].tolist(),
                cameras=[parse(text) for text in arrays["cameras"].tolist()],
                length=float(arrays["length"]),
                consistency=Consistency(**json.loads(str(arrays["consistency"]))),
                **{name: arrays[name] for name in _ARRAYS},
            ).knowing(**{name: arrays[name] for name in ORDERS})
        except (OSError, EOFError, ValueError, KeyError, TypeError, BadZipFile, struct.error) as error:
            raise ArtifactError(f"The map {path} cannot be read ({error}). Run the localize stage again.") from None
        return opened


def _arrays_of(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an uncompressed `.npz` file, read-only; those of a large file are memory-mapped."""
    arrays: dict[str, NDArray[Any]] = {}
    with open(path, "rb") as stream, ZipFile(stream) as archive:
        small = path.stat().st_size <= IN_MEMORY
        file = path.read_bytes() if small else mmap(stream.fileno(), 0, access=ACCESS_READ)
        for member in archive.infolist():
            if member.compress_type != ZIP_STORED:
                raise ValueError(f"{member.filename} is compressed")
            # Skip the local header (30 bytes, ending with two lengths), the name, and extra fields.
            stream.seek(member.header_offset + 26)
            stream.seek(sum(struct.unpack("<HH", stream.read(4))), SEEK_CUR)
            version = np.lib.format.read_magic(stream)
            read_header = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}[version[0]]
            shape, fortran, dtype = read_header(stream)
            arrays[member.filename.removesuffix(".npy")] = np.ndarray(
                shape, dtype, file, stream.tell(), order="F" if fortran else "C"
            )
    return arrays


def map_path(map_dir: str | Path, session_id: str, features: str = "sift") -> Path:
    """Return the map file of a session and a kind of features; for SIFT, the name omits the kind."""
    return Path(map_dir) / (f"{session_id}.npz" if features == "sift" else f"{session_id}-{features}.npz")
