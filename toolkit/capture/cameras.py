"""Cameras: intrinsics in the format of sensors.txt, viewing rays, and the field of view."""

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.geometry import Floats, unit

CAMERA_TYPES = ("camera", "depth")  # sensor types with intrinsics; only `camera` takes photographs
WIDE = ("FISHEYE", "FOV", "EUCM")  # ends of the names of models for fields of view of 180 degrees and more
_LARGEST = 2**31 - 1  # largest image side, pixels; COLMAP cannot hold larger numbers


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
    """Tell which points (J, P, 3) in the frames of J cameras lie in their fields of view, `view_bounds` (J, 4); bool
    (J, P).
    """
    z = points_in_cams[..., 2]
    x, y = points_in_cams[..., 0] / np.maximum(z, 1e-6), points_in_cams[..., 1] / np.maximum(z, 1e-6)
    b = bounds[:, None]
    return (z > 0.1) & (x > b[..., 0]) & (x < b[..., 1]) & (y > b[..., 2]) & (y < b[..., 3])
