"""Gather images for a reconstruction: files, folders and frames of videos, with what their EXIF tags tell; and
rigs: images with equal names in several folders, taken at the same time.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture.images import (
    HEADER_ERRORS,
    HEIC_HOW,
    camera_from_exif,
    camera_text,
    exif_key,
    find_mask,
    heic_is_read,
    not_an_image,
    read_header,
)  # fmt: skip
from toolkit.errors import CaptureError, ImageError
from toolkit.exchange.drafts import (
    CONVERTED_SUFFIXES,
    HEIC_SUFFIXES,
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    list_images,
    write_png,
)
from toolkit.exchange.georeference import gps_position, quarter_turns
from toolkit.files import write_atomic
from toolkit.scene.query import FOCAL_PRIOR

TAKEN_SUFFIXES = (*IMAGE_SUFFIXES, *CONVERTED_SUFFIXES, *VIDEO_SUFFIXES)
"""Formats of which images are made."""
STEP = 0.06  # motion of the image between chosen frames of a video, in multiples of its width
_SMALL = 320  # width of the frames whose motion is measured, pixels
FOLDERS = "folders"
"""What is given instead of a file if all folders with images are the cameras of one rig."""
Prefixes = list[list[str]]
"""For each rig, how the names of the images of each camera begin; the reference camera is the first."""


@dataclass(frozen=True)
class SourceImage:
    """An image of a reconstruction."""

    name: str  # relative path that it gets in the capture
    path: Path  # the JPEG or PNG file
    exif: Mapping[int, Any]
    geo: tuple[float, float, float] | None  # latitude and longitude, degrees, and altitude, meters
    mask: Path | None = None

    @property
    def quarter_turns(self) -> int:
        """Counter-clockwise quarter turns that make the image upright, from the orientation in EXIF."""
        return quarter_turns(self.exif)


def gather(
    sources: Sequence[Path], made: Path, fps: float | None = None, masks: Path | None = None, prefixed: bool = False
) -> tuple[list[SourceImage], dict[str, str]]:
    """Return the images of files, folders and videos, and the reason for each that cannot be read, by name.

    Names are paths in the source. If there are several sources, or with `prefixed`, the source's name comes first.

    Frames of videos, and images in other formats than JPEG and PNG, are written to the folder `made`, once. For
    `masks` see `images.find_mask`. Raise CaptureError if a source is missing or is no image or video, or two
    images would have one name.
    """
    items, unreadable = list[SourceImage](), dict[str, str]()
    for name, source in _files(sources, made, fps, prefixed or len(sources) > 1, unreadable):
        try:
            name, path = _converted(name, source, made)
            _, exif = read_header(path)
            items.append(SourceImage(name, path, exif, gps_position(path), find_mask(source, masks)))
        except ImageError as error:
            unreadable[name] = str(error)
    twice = {item.name for item in items}
    if len(twice) < len(items):
        raise CaptureError(f"{', '.join(map(str, sources))}: two photographs have one name. Rename a file or folder.")
    if masks is not None and items and not any(item.mask for item in items):
        name = items[0].name
        raise CaptureError(f"{masks}: no mask of a photograph in it. Expected that of {name} as {name}.png.")
    return items, unreadable


def _files(
    sources: Sequence[Path], made: Path, fps: float | None, prefixed: bool, unreadable: dict[str, str]
) -> Iterator[tuple[str, Path]]:
    """Yield name and file of each image; note videos in folders that cannot be read."""
    for source in sources:
        prefix = f"{source.stem if source.is_file() else source.resolve().name}/" if prefixed else ""
        if source.is_dir():
            for name in list_images(source, TAKEN_SUFFIXES):
                if (source / name).absolute().is_relative_to(made.absolute().parents[1]):
                    continue  # the capture is in the folder of the images, from a command that was stopped
                if name.lower().endswith(VIDEO_SUFFIXES):
                    video = Path(name).with_suffix("").as_posix()
                    try:
                        yield from _frames(source / name, made, f"{prefix}{video}/", fps)
                    except CaptureError as error:
                        unreadable[prefix + name] = str(error)
                else:
                    yield prefix + name, source / name
        elif source.suffix.lower() in VIDEO_SUFFIXES:
            yield from _frames(source, made, f"{source.stem}/", fps)
        elif source.is_file() and source.suffix.lower() in TAKEN_SUFFIXES:
            yield source.name, source
        else:
            expected = f"Expected a folder, or a file ending in {', '.join(TAKEN_SUFFIXES)}"
            raise CaptureError(f"{source}: no folder, image or video. {expected}.")


def _converted(name: str, path: Path, made: Path) -> tuple[str, Path]:
    """Return name and file of a JPEG or PNG with the same pixels and EXIF tags."""
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return name, path
    target = made / f"{name}.png"
    if not target.exists():
        if path.suffix.lower() in HEIC_SUFFIXES and not heic_is_read():
            raise ImageError(f"HEIC is not read: {HEIC_HOW}")
        try:
            with write_atomic(target) as temporary:
                write_png(path, temporary)
        except HEADER_ERRORS as error:
            raise not_an_image(error) from None
    return f"{name}.png", target


# Videos


def _frames(video: Path, made: Path, prefix: str, fps: float | None) -> Iterator[tuple[str, Path]]:
    """Yield names and files of the frames of a video, which are written once."""
    folder = made / prefix
    done = folder / f".{'motion' if fps is None else fps}-{video.stat().st_mtime_ns}"
    if not done.exists():
        for old in [*folder.glob("*.jpg"), *folder.glob(".*-*")]:
            old.unlink()
        for number, frame in choose_frames(video, fps):
            with write_atomic(folder / f"frame_{number:06d}.jpg") as temporary:
                cv2.imwrite(str(temporary), frame, [cv2.IMWRITE_JPEG_QUALITY, 97])
        folder.mkdir(parents=True, exist_ok=True)
        done.touch()
    for path in sorted(folder.glob("frame_*.jpg")):
        yield prefix + path.name, path


def choose_frames(video: Path, fps: float | None = None) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield number and pixels (H, W, 3) BGR of the sharpest frame of each stretch of a video.

    A stretch ends when the image has moved by `STEP` since the last chosen frame, or after 1 / `fps` seconds. Of its
    second half, the frame with the largest variance of the Laplacian is taken, so that neighbors differ. Raise
    CaptureError if OpenCV cannot read the video.
    """
    reader = cv2.VideoCapture(str(video))
    total, rate = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)), reader.get(cv2.CAP_PROP_FPS) or 30.0
    found, score, start = 0, -1.0, 0
    best: tuple[int, NDArray[np.uint8], NDArray[np.uint8]] | None = None
    reference: NDArray[np.uint8] | None = None
    for number in tqdm(range(max(total, 1)), desc=video.name, unit="frame"):
        ok, frame = reader.read()
        if not ok:
            break
        found += 1
        small = cv2.resize(
            frame, (_SMALL, max(1, round(_SMALL * frame.shape[0] / frame.shape[1]))), interpolation=cv2.INTER_AREA
        )
        gray, share = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8), 1.0
        if reference is not None:  # the first frame opens the video
            share = _motion(reference, gray) / STEP if fps is None else (number - start) * fps / rate
        sharp = float(cv2.Laplacian(gray, cv2.CV_64F).var())
        if share >= 0.5 and sharp > score:
            best, score = (number, np.asarray(frame, np.uint8), gray), sharp
        if share >= 1 and best is not None:
            yield best[0], best[1]
            start, reference, best, score = number, best[2], None, -1.0
    reader.release()
    if not found:
        raise CaptureError(f"{video}: no frame can be read. Convert it to H.264 in an .mp4 file.")


def _motion(before: NDArray[np.uint8], now: NDArray[np.uint8]) -> float:
    """Return the median motion of corners between two gray frames, in multiples of the width; inf if they are lost."""
    corners = cv2.goodFeaturesToTrack(before, 150, 0.01, 7)
    if corners is None or not len(corners):  # nothing to see
        return 0.0
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, np.zeros_like(corners))
    kept = found.ravel() == 1
    if kept.mean() < 0.5:
        return np.inf
    return float(np.median(np.linalg.norm((moved - corners)[kept, 0], axis=1)) / before.shape[1])


# EXIF


def initial_cameras(
    items: Iterable[SourceImage], known: Mapping[str, pycolmap.Camera], rigs: Sequence[Sequence[str]] = ()
) -> tuple[list[int], list[pycolmap.Camera]]:
    """Return for each image the number of its camera, and the cameras before they are estimated.

    Images with equal `known` intrinsics, by name, share a camera; of the others, those of one folder with one
    size, make, model and focal length in EXIF. Without these tags, they do so only if all in the folder have one size,
    as those that a person collected have several. Those whose names begin with one of the prefixes of `rigs` share one.

    Raises:
        CaptureError: the images of a camera of a rig have several sizes or known intrinsics.
    """
    items = list(items)
    sizes = [read_header(item.path)[0] for item in items]
    folders = [Path(item.name).parent for item in items]
    different = Counter(folder for folder, _ in {*zip(folders, sizes, strict=True)})
    keys, of_prefix = dict[Any, int](), dict[str, Any]()
    numbers, cameras = list[int](), list[pycolmap.Camera]()
    for index, (item, size, folder) in enumerate(zip(items, sizes, folders, strict=True)):
        tags = exif_key(item.exif)
        given = known.get(item.name)
        alone = index if different[folder] > 2 and not any(tags) else None
        key = (folder, size, tags, alone) if given is None else camera_text(given)
        if prefix := next((one for rig in rigs for one in rig if item.name.startswith(one)), None):
            if of_prefix.setdefault(prefix, (size, given and key)) != (size, given and key):
                raise CaptureError(f"rig: photographs in {prefix} have several cameras, as {item.name}; expected one.")
            key = prefix
        if key not in keys:
            keys[key] = len(cameras)
            cameras.append(_initial(size, item.exif) if given is None else pycolmap.Camera(given.todict()))
        numbers.append(keys[key])
    return numbers, cameras


def _initial(size: tuple[int, int], exif: Mapping[int, Any]) -> pycolmap.Camera:
    width, height = size
    try:
        focal_px, known = camera_from_exif(size, exif).camera.mean_focal_length(), True
    except ImageError:
        focal_px, known = FOCAL_PRIOR * max(size), False
    params = [focal_px, width / 2, height / 2, 0.0]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
    camera.has_prior_focal_length = known
    return camera


# Rigs


def read_rigs(rig: str | Path, items: Sequence[SourceImage]) -> Prefixes:
    """Return the rigs of `FOLDERS`, or of a file in COLMAP's format `rig_config.json`.

    Poses of cameras in the rig are not taken from the file, but found.

    Raises:
        CaptureError: the file cannot be read, or a rig does not have two cameras, each with images.
    """
    if str(rig) == FOLDERS:
        found = [sorted({f"{Path(item.name).parent.as_posix()}/" for item in items})]
    else:
        try:
            configs = pycolmap.read_rig_config(rig)
        except (RuntimeError, ValueError) as error:
            raise CaptureError(f"{rig}: no configuration of rigs that COLMAP reads ({error}).") from None
        cameras = [sorted(config.cameras, key=lambda camera: not camera.ref_sensor) for config in configs]
        found = [[camera.image_prefix for camera in each] for each in cameras]
    for prefixes in found:
        counts = {prefix: sum(item.name.startswith(prefix) for item in items) for prefix in prefixes}
        if len(prefixes) < 2 or not all(counts.values()):
            example = items[0].name
            expected = "two cameras or more, each with photographs in its folder"
            raise CaptureError(f"rig: {rig}: found {counts}, expected {expected}. A photograph: {example}.")
    return found


def join(model: pycolmap.Reconstruction, database: Path, rigs: Prefixes, folder: str) -> None:
    """Join the images of a model to frames of rigs, whose extrinsics follow from the poses of the images.

    Args:
        database: COLMAP's, which gets the rigs, too.
        folder: of the images, in COLMAP's names.

    Raises:
        CaptureError: no frame has poses for the reference camera and another one.
    """
    configs = []
    for prefixes in rigs:
        cameras = [
            pycolmap.RigConfigCamera(ref_sensor=at == 0, image_prefix=folder + prefix)
            for at, prefix in enumerate(prefixes)
        ]
        configs.append(pycolmap.RigConfig(cameras=cameras))
    with pycolmap.Database.open(str(database)) as opened:
        try:
            pycolmap.apply_rig_config(configs, opened, model)
        except (RuntimeError, ValueError) as error:
            do = "Are the names equal, and the first camera in the model?"
            raise CaptureError(f"rig: cameras {rigs} do not join to a rig ({error}). {do}") from None
