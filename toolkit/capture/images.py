"""Image files, with errors that distinguish missing from unreadable files, their EXIF tags, and the cameras of images.

Also numbers of threads for loops over images, and a guess of intrinsics from EXIF.
"""

import base64
import os
import re
import stat
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

import cv2
import numpy as np
import PIL.Image
import psutil
import pycolmap
from numpy.typing import ArrayLike, NDArray
from PIL import JpegImagePlugin, PngImagePlugin

from toolkit.errors import ImageError
from toolkit.files import MASKS
from toolkit.geometry import Floats, unit

T = TypeVar("T")
R = TypeVar("R")
WORKERS = "TOOLKIT_WORKERS"  # environment variable with the number of threads that this process may use
THREAD_BYTES = 1 << 29  # memory to reserve for each thread, bytes: SIFT of 4000 x 3000 pixels takes 460 MB
MAX_BYTES = 1 << 30  # largest size of an image file, bytes
MAX_PIXELS = 1 << 28  # of a decoded image: 268 million, 0.8 GB in color; a tiny file can declare many more
# JPEG and PNG bypass `PIL.Image.open`, whose limit of pixels is below the resolution of recent phones.
_HEADER_READERS: dict[bytes, Callable[[Any], PIL.Image.Image]] = {
    b"\xff\xd8": JpegImagePlugin.JpegImageFile,
    b"\x89PNG\r\n\x1a\n": PngImagePlugin.PngImageFile,
    b"": PIL.Image.open,
}
_HEIC = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1")  # brands of ISO files, ISO/IEC 23008-12
CONVERT = "convert them to JPEG or PNG"
HEIC_HOW = f"pip install pillow-heif, or {CONVERT}"
_REDUCED = {8: cv2.IMREAD_REDUCED_COLOR_8, 4: cv2.IMREAD_REDUCED_COLOR_4, 2: cv2.IMREAD_REDUCED_COLOR_2}
_CGROUPS = Path("/sys/fs/cgroup")  # file names differ between versions 2 and 1
HEADER_ERRORS = (OSError, SyntaxError, ValueError, PIL.Image.DecompressionBombError)
# Numbers of the EXIF tags, and the length in millimeters of each value of FocalPlaneResolutionUnit.
ORIENTATION, _EXIF, _TIME, _SUBSECOND, _ZONE = 0x0112, 0x8769, 0x9003, 0x9291, 0x9011
_MAKE, _MODEL, _FOCAL_MM, _FOCAL_35MM, _WIDTH, _HEIGHT = 0x010F, 0x0110, 0x920A, 0xA405, 0xA002, 0xA003
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
_UNIT_MM = {0.0: 25.4, 2.0: 25.4, 3.0: 10.0, 4.0: 1.0}  # 0, a missing tag, means inches
_MASK_DEPTH = 4  # largest number of folders and files in the path of an image below the folder of images
NO_FILE = "no such file"
_FILM_DIAGONAL_MM = float(np.hypot(36, 24))
CAMERA_TYPES = ("camera", "depth")  # sensor types with intrinsics; only `camera` takes images
WIDE = ("FISHEYE", "FOV", "EUCM")  # ends of the names of models for fields of view of 180 degrees and more
_LARGEST = 2**31 - 1  # largest image side, pixels; COLMAP cannot hold larger numbers


# Image files


def read_file(path: str | Path) -> bytes:
    """Return the content of an image file.

    Raise ImageError if the file is missing, cannot be read, is too large, or is a folder, a pipe or a device.
    """
    with _open(path) as stream:
        return stream.read()


@contextmanager
def _open(path: str | Path) -> Iterator[BinaryIO]:
    try:
        status = os.stat(path)  # noqa: PTH116 - twice as fast as Path.stat
        if not stat.S_ISREG(status.st_mode):  # opening a pipe blocks forever, reading a device never ends
            raise ImageError(f"Image cannot be read: {path} is a folder, a pipe or a device, expected a file")
        if status.st_size > MAX_BYTES:
            raise ImageError(f"Image cannot be read: {path} has more than {MAX_BYTES:,} bytes")
        with open(path, "rb") as stream:
            yield stream
    except FileNotFoundError:
        target = f", a link to {os.readlink(path)}" if os.path.islink(path) else ""  # noqa: PTH114, PTH115
        raise ImageError(f"Image not found: {path}{target}") from None
    except (OSError, ValueError) as error:  # ValueError: the name is not valid for a file
        raise ImageError(f"Image cannot be read: {path} ({error})") from None


def stored_size(path: str | Path) -> tuple[int, int]:
    """Return width and height of an image file, from its header. Raise ImageError if it has none."""
    with _open(path) as stream:
        try:
            return open_lazily(stream, np.inf).size
        except HEADER_ERRORS as error:
            raise ImageError(f"Image cannot be decoded ({error}): {path}") from None


def open_lazily(stream: BinaryIO, max_pixels: float = MAX_PIXELS) -> PIL.Image.Image:
    """Return an image of which only the header is read yet. Raise one of `HEADER_ERRORS` if it has too many pixels."""
    first = stream.read(12)
    stream.seek(0)
    if _is_heic(first) and not heic_is_read():
        raise ValueError(f"HEIC is not read: {HEIC_HOW}")
    image = next(read for start, read in _HEADER_READERS.items() if first.startswith(start))(stream)
    if image.width * image.height > max_pixels:
        raise ValueError(f"{image.width} x {image.height} pixels, more than {max_pixels:,}")
    return image


def _is_heic(data: bytes) -> bool:
    return data[4:8] == b"ftyp" and data[8:12] in _HEIC


def heic_is_read() -> bool:
    """Tell whether Pillow reads HEIC, with the optional package pillow-heif."""
    try:
        import pillow_heif
    except ImportError:
        return False
    pillow_heif.register_heif_opener()
    return True


def decode(path: str | Path, flags: int, min_side: int | None = None, longest: int | None = None) -> NDArray[Any]:
    """Return the pixels of an image file as OpenCV decodes it with `flags`; HEIC by Pillow, upright.

    Args:
        min_side, longest: see `read_image`; a JPEG is decoded at a smaller size that suffices. Both add to `flags`.

    Raises:
        ImageError: see `read_file`; or the file is not an image, is truncated, or has more than `MAX_PIXELS` pixels.
    """
    data = read_file(path)
    size = 0, 0
    try:
        if _is_heic(data):
            gray = not flags & cv2.IMREAD_COLOR
            pixels = np.asarray(open_lazily(BytesIO(data)).convert("L" if gray else "RGB"))
            return pixels if gray else np.ascontiguousarray(pixels[..., ::-1])
        with suppress(*HEADER_ERRORS[:-1]):  # OpenCV decides whether it is an image
            size = open_lazily(BytesIO(data), np.inf).size
        if size[0] * size[1] > MAX_PIXELS:
            raise ValueError(f"{size[0]} x {size[1]} pixels, more than {MAX_PIXELS:,}")
        if data.startswith(b"\xff\xd8") and (min_side or longest):  # reducing saves time only for JPEG
            most = min(size) // min_side if min_side else max(size) // (longest or 1)
            # With a remainder, the last row and column would cover fewer pixels and shift all others.
            fitting = (flag for factor, flag in _REDUCED.items() if factor <= most and not np.any(np.mod(size, factor)))
            flags |= next(fitting, 0)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except (*HEADER_ERRORS, cv2.error) as error:
        raise ImageError(f"Image cannot be decoded ({getattr(error, 'err', error)}): {path}") from None
    if image is None:
        raise ImageError(f"Image cannot be decoded ({len(data)} bytes; expected a whole JPEG or PNG): {path}")
    return np.asarray(image)


def read_image(
    path: str | Path, gray: bool = False, min_side: int | None = None, longest: int | None = None
) -> NDArray[np.uint8]:
    """Return an image as stored, (H, W, 3) RGB uint8, or (H, W) if `gray`.

    EXIF orientation is ignored, because a capture's intrinsics refer to the stored pixels. Raise ImageError if the file
    is missing or cannot be decoded; see `decode`.

    Args:
        min_side: decode a color JPEG at 1/8, 1/4 or 1/2 of its size if both sides stay whole numbers and the shorter
            one has at least this many pixels. Saves time for callers that reduce the image anyway. None: full size.
        longest: reduce the image to a longer side of at most this many pixels, without aliasing. None: do not.
    """
    flags = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR
    sizes = (None, None) if gray else (min_side, longest)
    image = decode(path, flags | cv2.IMREAD_IGNORE_ORIENTATION, *sizes)
    image = np.asarray(image if gray else cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
    return image if longest is None else shrunk(image, longest)


def pixels_of(image: Path | NDArray[np.uint8], gray: bool, min_side: int | None) -> NDArray[np.uint8]:
    """Return an image in gray, (H, W), or in color, (H, W, 3) RGB.

    Args:
        image: a file, see `read_image` also for the errors; or pixels (H, W) or (H, W, 3) RGB.
    """
    if isinstance(image, Path):
        return read_image(image, gray, min_side)
    if gray == (image.ndim == 2):
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY if gray else cv2.COLOR_GRAY2RGB), np.uint8)


def shrunk(image: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """Reduce an image, (H, W, 3) or (H, W), to a longer side of at most `longest` pixels, without aliasing."""
    scale = longest / max(image.shape[:2])
    size = [max(1, round(scale * side)) for side in image.shape[1::-1]]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8) if scale < 1 else image


def read_for_display(path: str | Path, longest: int) -> NDArray[np.uint8]:
    """Return an image, (H, W, 3) RGB, of at most `longest` pixels; for an unreadable file, one that says so."""
    try:
        return read_image(path, longest=longest)
    except ImageError:
        blank = np.full((240, 320, 3), 200, np.uint8)
        cv2.putText(blank, "unreadable", (60, 130), cv2.FONT_HERSHEY_SIMPLEX, 1.1, (90, 90, 90), 2)
        return shrunk(blank, longest)


def thumbnails(images: Iterable[Path | NDArray[np.uint8]], size: int = 110) -> str:
    """Return `<img>` elements of small copies, `size` pixels on the longer side, of images, files or pixels, in RGB."""
    elements = []
    for image in images:
        small = read_for_display(image, size) if isinstance(image, Path) else shrunk(image, size)
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]) if small.ndim == 3 else small)
        text = base64.b64encode(data.tobytes()).decode()
        elements.append(f"<img src='data:image/jpeg;base64,{text}' alt='' style='display:inline-block;margin:2px'>")
    return "".join(elements)


def default_workers() -> int:
    """Return the default number of threads: the value of `WORKERS`, else the number of usable cores.

    It is limited by the CPU affinity of the process, the CPU quota of its container, and the memory of the machine and
    the container, with `THREAD_BYTES` per thread.
    """
    if (workers := os.environ.get(WORKERS, "")).isdecimal():
        return max(1, int(workers))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limits = [cores, psutil.virtual_memory().total / THREAD_BYTES]
    for files in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        limits += [quota / period for quota, period in _of_control_group(*files) if quota > 0]
    for file in ("memory.max", "memory/memory.limit_in_bytes"):
        limits += [limit / THREAD_BYTES for (limit,) in _of_control_group(file)]
    return max(1, int(min(limits)))


def _of_control_group(*files: str) -> list[list[int]]:
    """Return the numbers in files of this process's control group; empty without a group or a limit (`max`)."""
    with suppress(OSError, ValueError):
        return [[int(text) for file in files for text in (_CGROUPS / file).read_text().split()]]
    return []


def prefetch(function: Callable[[T], R], items: Iterable[T], workers: int = 2, ahead: int = 4) -> Iterator[R]:
    """Yield `function(item)` in order, while `workers` threads process up to `ahead` further items.

    Memory is bounded for any number of items. Meant for functions that release the interpreter lock (decoding, SIFT,
    RANSAC). An exception of `function` is raised at its item's turn.
    """
    pool = ThreadPoolExecutor(workers)
    pending: deque[Future[R]] = deque()
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > workers + ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        for future in pending:
            future.cancel()
        pool.shutdown(wait=True)


def is_file(path: Path) -> bool:
    """Tell whether a file exists; False for a name that is too long for a file."""
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises for too long a name


def find_mask(image: Path, masks: Path | None = None) -> Path | None:
    """Return the mask of an image file, which is black where to extract no features; None without one.

    As in COLMAP, that of `images/a/1.jpg` is `masks/a/1.jpg.png`; the folder `masks` may also be in `images` or in `a`.

    Args:
        masks: folder of the masks, if it is another one.
    """
    path = image.absolute()
    for depth in range(min(_MASK_DEPTH, len(path.parts) - 2), 0, -1):  # of the image in the folder of images
        name = Path(*path.parts[-depth:-1], f"{path.name}.png")
        roots = [masks] if masks is not None else [path.parents[depth - 1] / MASKS, path.parents[depth] / MASKS]
        if found := next((root / name for root in roots if is_file(root / name)), None):
            return found
    return None


def read_header(path: Path) -> tuple[tuple[int, int], dict[int, Any]]:
    """Return the stored width and height of an image, and its EXIF tags by number.

    Raise ImageError if the file is missing, not an image, or has more than `MAX_PIXELS` pixels.
    """
    if not is_file(path):
        raise ImageError(NO_FILE)
    try:
        with open(path, "rb") as stream:
            image = open_lazily(stream)
            exif = image.getexif()
            return image.size, {**exif, **exif.get_ifd(_EXIF)}
    except HEADER_ERRORS as error:
        raise not_an_image(error) from None


def not_an_image(error: Exception) -> ImageError:
    """Return the reason why the header of a file cannot be read, one of `HEADER_ERRORS`."""
    unknown = isinstance(error, PIL.UnidentifiedImageError)
    return ImageError(f"cannot be read as an image ({'of no known format, or damaged' if unknown else error})")


def time_taken(exif: Mapping[int, Any]) -> int | None:
    """Return the time on the camera's clock, microseconds since 1970 in an unknown time zone; None without a tag."""
    try:
        taken = datetime.strptime(str(exif[_TIME]), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except (KeyError, ValueError):
        return None
    digits = str(exif.get(_SUBSECOND, "")).strip()
    return int(taken.timestamp()) * 10**6 + (int(f"{digits:0<6}"[:6]) if digits.isdecimal() else 0)


def zone_of(exif: Mapping[int, Any]) -> int | None:
    """Return the offset of the camera's clock from UTC, microseconds, from OffsetTimeOriginal; None without it."""
    match = re.fullmatch(r"([+-])(\d\d):(\d\d)", str(exif.get(_ZONE, "")).strip(" \0"))
    return None if match is None else int(f"{match[1]}1") * (int(match[2]) * 60 + int(match[3])) * 60 * 10**6


def read_number(exif: Mapping[int, Any], tag: int) -> float:
    """Return the value of a tag as a number; 0 if it is missing, not a number or not finite."""
    try:
        number = float(exif.get(tag, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if np.isfinite(number) else 0.0


def exif_key(exif: Mapping[int, Any]) -> tuple[str, ...]:
    """Return make, model and focal lengths of a camera, empty where EXIF has none."""
    return tuple(str(exif.get(tag, "")) for tag in (_MAKE, _MODEL, _FOCAL_MM, _FOCAL_35MM))


class GuessedCamera(NamedTuple):
    """Intrinsics of an image that nobody gave."""

    camera: pycolmap.Camera
    origin: str
    """Where the focal length is from, in words."""
    cropped: bool = False
    """The image is a part of the one that EXIF describes, so its principal point may be anywhere."""


def camera_from_exif(size: tuple[int, int], exif: Mapping[int, Any]) -> GuessedCamera:
    """Guess the intrinsics of an image from its header: no distortion, principal point in the image center.

    FocalLengthIn35mmFilm refers to the diagonal of 36 mm x 24 mm film (CIPA DC-008). Without that tag, the focal length
    is FocalLength times FocalPlaneXResolution, scaled if the image was resized later. An image whose sides have another
    ratio than in EXIF was cropped; the tags are those of the whole image. Raise ImageError if EXIF has no focal
    length.

    Returns:
        A SIMPLE_PINHOLE camera, and a phrase that names the tags used.
    """
    width, height = size
    focal_mm, film_mm = read_number(exif, _FOCAL_MM), read_number(exif, _FOCAL_35MM)
    plane_x, unit_mm = read_number(exif, _PLANE_X), _UNIT_MM.get(read_number(exif, _PLANE_UNIT))
    whole = sorted([read_number(exif, _WIDTH), read_number(exif, _HEIGHT)])
    sides = sorted([width, height])
    cropped = whole[0] > 0 and abs(whole[1] * sides[0] / (whole[0] * sides[1]) - 1) > 0.02
    cropped = cropped and sides[0] <= whole[0] and sides[1] <= whole[1]
    if film_mm > 0:
        diagonal = np.hypot(*(whole if cropped else sides))
        focal_px, how = film_mm * diagonal / _FILM_DIAGONAL_MM, "FocalLengthIn35mmFilm"
    elif focal_mm > 0 and plane_x > 0 and unit_mm:
        stored = read_number(exif, _WIDTH)
        focal_px = focal_mm * plane_x / unit_mm * (width / stored if stored > 0 and not cropped else 1.0)
        how = "FocalLength and FocalPlaneXResolution"
    else:
        such_as = f"'SIMPLE_PINHOLE,{width},{height},FOCAL_PX,{width / 2:g},{height / 2:g}'"
        options = f"--camera 'MODEL,W,H,...', such as {such_as}, with --cameras, or in the table"
        raise ImageError(f"no focal length in EXIF: give the intrinsics with {options}")
    how += " of the whole image, which was cropped" if cropped else ""
    params = [float(focal_px), width / 2, height / 2]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)
    return GuessedCamera(camera, f"a guess from EXIF ({how}), without distortion", cropped)


# Cameras


def parse_camera(sensor_type: str, params: str) -> pycolmap.Camera:
    """Return the camera of a line of sensors.txt: its type, `camera` or `depth`, and the text after it.

    Raise ValueError if the sensor is not a camera, or its model, size or parameters are not valid.
    """
    if sensor_type not in CAMERA_TYPES:
        raise ValueError(f"found type {sensor_type!r}, expected one with intrinsics: {' or '.join(CAMERA_TYPES)}.")
    model, *values = [value.strip() for value in params.split(",")]
    models = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"})
    if model == "EQUIRECTANGULAR":
        raise ValueError("found camera model 'EQUIRECTANGULAR': cut such images into views by `import panoramas`.")
    if model not in models:
        raise ValueError(f"found camera model {model!r}, expected one of {', '.join(models)}.")
    count = len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)
    try:
        # The benchmark writes `960`, other tools `960.0`. Python accepts `9_60`, which is refused here.
        numbers = np.array([float(value.replace("_", " ")) for value in values if value], np.float64)
    except ValueError as error:
        raise ValueError(f"found {params!r}, expected numbers after the model ({error}).") from None
    if len(numbers) != count + 2 or not np.all(np.isfinite(numbers)):
        found = f"found {max(len(numbers) - 2, 0)} parameters for model {model} in {params!r}"
        raise ValueError(f"{found}, expected width, height and {count} finite numbers.")
    width, height = numbers[:2]
    if not all(1 <= size <= _LARGEST and size % 1 == 0 for size in (width, height)):
        raise ValueError(f"found image size {width:g} x {height:g}, expected whole numbers from 1 to {_LARGEST:,}.")
    camera = pycolmap.Camera(model=model, width=int(width), height=int(height), params=numbers[2:])
    if any(camera.params[index] <= 0 for index in camera.focal_length_idxs()):
        raise ValueError(f"found a focal length that is not positive in {params!r}, expected pixels.")
    for index, size in zip(camera.principal_point_idxs(), (width, height), strict=False):
        if not -size <= camera.params[index] <= 2 * size:
            found = f"found a principal point at {camera.params[index]:g} in {params!r}"
            raise ValueError(f"{found}, further outside the image than its size ({size:g}); expected pixels.")
    return camera


def camera_text(camera: pycolmap.Camera) -> str:
    """Return a camera as `MODEL, width, height, parameter, ...`, with all digits; `parse_camera` reads it."""
    params = (repr(float(value)) for value in camera.params)
    return ", ".join([camera.model.name, str(camera.width), str(camera.height), *params])


def invertible_share(camera: pycolmap.Camera) -> float:
    """Return the share of the image in which the camera's distortion can be inverted, on a grid of 15 x 15 pixels.

    There, the ray of a pixel projects to it, and so does no ray closer to the axis. Of fisheye lenses, only the circle
    that touches the longer sides counts: the corners may be black.
    """
    is_fisheye = "FISHEYE" in camera.model.name
    if not is_fisheye and not np.any(camera.params[list(camera.extra_params_idxs())]):
        return 1.0
    size = np.array([camera.width, camera.height], np.float64)
    pixels = np.stack(np.meshgrid(*np.linspace(np.zeros(2), size, 15).T), -1).reshape(-1, 2)
    if is_fisheye:
        pixels = pixels[np.linalg.norm(pixels - size / 2, axis=1) <= size.min() / 2]
    rays = rays_of(camera, pixels)
    angles = np.linspace(1 / 16, 1, 16) * np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])[:, None]  # (N, 16)
    across = unit(rays[:, :2], 1e-9)[:, None] * np.sin(angles)[..., None]
    on_the_way = np.concatenate([across, np.cos(angles)[..., None]], axis=2)
    projected = np.asarray(camera.img_from_cam(on_the_way.reshape(-1, 3))).reshape(*angles.shape, 2)
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    grows = np.diff(np.linalg.norm(projected - center, axis=2), axis=1) > -1e-3 * size.max()
    returns = np.linalg.norm(projected[:, -1] - pixels, axis=1) < 0.01 * size.max()
    return float((returns & grows.all(axis=1)).mean())


def rays_of(camera: pycolmap.Camera, pixels: NDArray[np.floating]) -> Floats:
    """Return the unit viewing rays (N, 3), in the camera's frame, of pixels (N, 2)."""
    if not len(pixels):
        return np.zeros((0, 3))
    return unit(np.asarray(camera.cam_ray_from_img(np.asarray(pixels, np.float64))))


def invertible(camera: pycolmap.Camera, pixels: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Tell which pixels (N, 2) have a viewing ray.

    Fisheye models of COLMAP give wrong rays, without a word, for pixels 90 degrees or more from the optical axis.
    """
    if not camera.model.name.endswith(WIDE) or not len(pixels):
        return np.ones(len(pixels), bool)
    xy = np.asarray(pixels, np.float64)
    again = np.asarray(camera.img_from_cam(np.asarray(camera.cam_ray_from_img(xy)))).reshape(-1, 2)
    return np.asarray(np.abs(again - xy).max(axis=1) < 0.5)  # also False for NaN


def sees_all(camera: pycolmap.Camera) -> bool:
    """Tell whether all pixels of an image have a viewing ray."""
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * [camera.width, camera.height]
    return bool(invertible(camera, corners).all())


def projection_jacobian(in_cams: Floats, focals_px: Floats) -> Floats:
    """Return the Jacobians (n, 2, 3), pixels per meter, of the projections (f x/z, f y/z) of points (n, 3).

    Points are in the cameras' frames. Depths z below 1 mm are raised to 1 mm.
    """
    z = np.maximum(in_cams[:, 2], 1e-3)
    scale = focals_px / z
    jacobian = np.zeros((len(in_cams), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = scale
    jacobian[:, :, 2] = -scale[:, None] * in_cams[:, :2] / z[:, None]
    return jacobian


def view_bounds(camera: pycolmap.Camera) -> Floats:
    """Return x_min, x_max, y_min, y_max of the field of view at depth 1."""
    w, h = camera.width, camera.height
    edges = np.array([[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]])
    ends = np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]])
    rays = np.where(invertible(camera, edges)[:, None], rays_of(camera, edges), ends)
    rays = rays / np.maximum(rays[:, 2:], 0.2)  # fields of view wider than 157 degrees are clipped
    return np.array([rays[0, 0], rays[1, 0], rays[2, 1], rays[3, 1]])


def in_view(points_in_cams: Floats, bounds: Floats) -> NDArray[np.bool_]:
    """Tell (J, P) which points (J, P, 3), in the frames of J cameras, lie in their views, `view_bounds` (J, 4)."""
    z = points_in_cams[..., 2]
    x, y = points_in_cams[..., 0] / np.maximum(z, 1e-6), points_in_cams[..., 1] / np.maximum(z, 1e-6)
    b = bounds[:, None]
    return (z > 0.1) & (x > b[..., 0]) & (x < b[..., 1]) & (y > b[..., 2]) & (y < b[..., 3])


# Quarter turns


def turn_image(image: NDArray[Any], k: int) -> NDArray[Any]:
    """Return an image (H, W) or (H, W, 3) after k counter-clockwise quarter turns, contiguous; itself for k = 0."""
    codes = (cv2.ROTATE_90_COUNTERCLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_CLOCKWISE)
    image = np.ascontiguousarray(image)
    return image if k % 4 == 0 else cv2.rotate(image, codes[k % 4 - 1])


def turn_points(xy: ArrayLike, width: int, height: int, k: int) -> Floats:
    """Return the pixel positions (N, 2) after k quarter turns of an image of this size, (N, 2).

    The center of the top-left pixel is (0.5, 0.5), before and after.
    """
    x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
    turned = [(x, y), (y, width - x), (width - x, height - y), (height - y, x)][k % 4]
    return np.stack(turned, axis=-1)


def turned_from_cam(k: ArrayLike) -> Floats:
    """Return turned_from_cam, (..., 4, 4), of k quarter turns (...): from the camera's coordinates to the turned one's.

    The pose of a turned image is world_from_cam @ invert(turned_from_cam(k)).
    """
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, 1], [-1, 0]]  # right becomes up (-y)
    return np.stack([np.linalg.matrix_power(quarter, turn) for turn in range(4)])[np.asarray(k) % 4]
