"""Make a reconstruction level and metric by GPS, known positions or a distance, and find its poses on the Earth."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pycolmap

from toolkit.alignment.similarity import align_to_map
from toolkit.capture import Session
from toolkit.capture.images import HEADER_ERRORS, ORIENTATION, read_number, turned_from_cam
from toolkit.capture.session import IMPORT_RECORD, RECONSTRUCTION_RECORD
from toolkit.capture.upright import up_of_cameras
from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.colmap_model import inverse
from toolkit.exchange.recordings import numbers_in, read_csv
from toolkit.files import IMPORTED, own_name, read_json
from toolkit.geometry import Floats, invert

MAX_ERRORS_M = (0.1, 0.3, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Limits of the error of a known position; the smallest that `MIN_AGREEING` of the positions meet is used."""
MIN_AGREEING = 0.6  # of the positions; the others may be blunders
OUTLIER = 2.5  # smallest error of an outlier, in multiples of the median; for Gaussian noise, 3.8 standard deviations
MAX_SCALE_DEVIATION = 0.1  # largest relative standard deviation of a scale that is used
MAX_TILT_DEG = 2.0  # largest standard deviation of the vertical by known positions; else the cameras tell it
NEAR_PX = 0.02  # largest distance of a point's observations from the given pixel, in multiples of the image's width
MAX_DEPTHS = 1.15  # largest ratio of the depths of the points there
WORLD_DEVIATION = "deviation of the world, m"  # in records: standard deviation of the map's place by known positions
GEO_COLUMNS = ("latitude_deg", "longitude_deg", "altitude_m", "heading_deg", "pitch_deg")
_EARTH_M, _FLATTENING = 6378137.0, 1 / 298.257223563  # WGS 84
_SQUARE = _FLATTENING * (2 - _FLATTENING)  # squared eccentricity
_MIN_HORIZONTAL = 1e-3  # smallest horizontal part of an optical axis that has a heading
GPS = "GPS in EXIF"
PRIOR = "rough poses"
PRIOR_NOISE_M = 0.05  # expected noise of a rough position; within a small factor, the data decide
MAX_ALIGNED = 60  # images by which a model is aligned to rough poses
_GPS_TAGS = 0x8825  # number of the EXIF tag


@dataclass
class Placing:
    """How the world of a model was chosen."""

    unit: str | None  # "m", or None if it is unknown
    record: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    prior_noise_m: float | None = None  # standard deviation of a coordinate of the rough poses that it is by


def place(
    model: pycolmap.Reconstruction, quarter_turns: Mapping[str, int], geo: Mapping[str, tuple[float, float, float]],
    distance: tuple[str, str, float] | None = None, positions: Mapping[str, Floats] | None = None,
    prior: Mapping[str, Floats] | None = None,
) -> Placing:  # fmt: skip
    """Transform a model in place: z up, and meters if they are known.

    Args:
        quarter_turns: by the user's name of an image: counter-clockwise turns that make it upright, from EXIF.
        geo: latitude and longitude, degrees, and altitude, meters.
        distance, positions: see `reconstruct.reconstruct`.
        prior: rough world_from_cam (4, 4) by name, in meters, whose world the model gets.

    Raises:
        ManifestError: a distance between points that are not known or not clear.
    """
    images = {own_name(image.name): image for image in model.images.values() if image.has_pose}
    up = up_of_cameras([_upright(image, quarter_turns.get(name, 0)) for name, image in images.items()])
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(_rotation_to_z(up)), np.zeros(3)))
    record: dict[str, Any] = {"up": "by the cameras"}
    if prior:
        return _place_by_poses(model, images, prior, record)
    if distance is not None:
        ends = [_point(model, images, text) for text in distance[:2]]
        length = float(np.linalg.norm(ends[0] - ends[1]))
        if not length > 0 or not 0 < distance[2] < np.inf:
            raise ManifestError(f"distance: found {length:g} in the model and {distance[2]:g} m, expected two lengths.")
        model.transform(pycolmap.Sim3d(distance[2] / length, pycolmap.Rotation3d(), np.zeros(3)))
        how = f"a distance of {distance[2]:g} m"
        return Placing("m", record | {"meters": how}, [f"meters: from {how}; up: by the cameras"])
    how = "known positions" if positions is not None else GPS
    origin = None
    if positions is None:
        known = [geo[name] for name in images if name in geo]
        origin = np.median(known, axis=0) if known else np.zeros(3)
        positions = {name: east_north_up(np.array(geo[name]), origin) for name in images if name in geo}
    common = [name for name in images if name in positions]
    if len(common) < 3:
        return Placing(None, record, [f"{how}: {len(common)} photographs, expected 3"] if common else [])
    source = np.array([images[name].projection_center() for name in common])
    target = np.array([positions[name] for name in common])
    fitted = fit(source, target)
    if fitted is None:
        return Placing(None, record, [f"{how}: does not fit the model"])
    new_from_old, fitting, residual_m, scale_deviation, level = fitted
    facts = f"{np.count_nonzero(fitting)} of {len(common)} photographs, residual {residual_m:.2g} m in the median, "
    facts += f"scale known to {float(f'{100 * scale_deviation:.1g}'):g} %"
    if scale_deviation > MAX_SCALE_DEVIATION:
        return Placing(None, record, [f"{how}: of no use for the scale, as the cameras are too close ({facts})"])
    model.transform(new_from_old)
    by = how if level else "the cameras"
    record |= {"meters": how, "residual_m": residual_m, "scale deviation": scale_deviation, "up": f"by {by}"}
    record |= {"z is up": level, WORLD_DEVIATION: residual_m / np.sqrt(np.count_nonzero(fitting))}
    if origin is not None:
        record["origin"] = dict(zip(GEO_COLUMNS[:3], origin.tolist(), strict=True))
        record["axes"] = "x east, y north, z up"
    return Placing("m", record, [f"meters: from {how}, {facts}; up: by {by}"])


def _place_by_poses(
    model: pycolmap.Reconstruction, images: Mapping[str, pycolmap.Image], prior: Mapping[str, Floats],
    record: dict[str, Any],
) -> Placing:  # fmt: skip
    """Transform a model to the world of rough poses; orientations tell up, also where positions are on a line."""
    every = sorted(name for name in images if name in prior)
    names = every[:: -(-len(every) // MAX_ALIGNED) or 1]
    if not names:
        return Placing(None, record, [f"{PRIOR}: none of a photograph in the model"])
    ours = np.stack([_upright(images[name], 0) for name in names])
    found = align_to_map(ours, np.stack([prior[name] for name in names]), center_noise_m=PRIOR_NOISE_M)
    facts = f"{found.num_consistent} of {len(names)} photographs, residual {found.rmse_m:.2g} m, "
    facts += f"scale known to {float(f'{100 * found.scale_std:.1g}'):g} %"
    if not found.scale_std <= MAX_SCALE_DEVIATION:
        return Placing(None, record, [f"{PRIOR}: of no use for the scale ({facts}; {found.reason})"])
    by = found.world_from_model
    model.transform(pycolmap.Sim3d(by.scale, pycolmap.Rotation3d(by.rotation), by.translation))
    record = {"meters": PRIOR, "residual_m": found.rmse_m, "scale deviation": found.scale_std}
    note = f"meters and world: from {PRIOR}, {facts}"
    errors = np.array([images[name].projection_center() - prior[name][:3, 3] for name in every])
    return Placing("m", record, [note], found.center_noise_m / np.sqrt(3) * drift_factor(errors, found.center_noise_m))


def drift_factor(errors: Floats, noise_m: float) -> float:
    """Return by how much the noise of positions counts more, as errors (N, 3), meters, are like those of neighbors.

    Tracking drifts, and positions with equal errors tell no more than one of them. If neighbors have the correlation r
    (first-order autoregression), the variance of a mean is (1 + r) / (1 - r) times that of independent errors. Errors
    above 3 times `noise_m` are outliers.
    """
    errors = errors[np.linalg.norm(errors, axis=1) <= 3 * noise_m]
    r = np.clip((errors[1:] * errors[:-1]).sum() / max((errors**2).sum(), 1e-12), 0, 0.99)
    return float(np.sqrt((1 + r) / (1 - r)))


def alignment(
    world_from_cams: Mapping[str, Floats], quarter_turns: Mapping[str, int],
    geo: Mapping[str, tuple[float, float, float]], positions: Mapping[str, Floats] | None,
) -> tuple[Placing, pycolmap.Sim3d]:  # fmt: skip
    """Return how `place` would transform posed images, (4, 4) by name, and that similarity, new_from_old."""
    model = pycolmap.Reconstruction()
    for number, (name, world_from_cam) in enumerate(world_from_cams.items(), start=1):
        camera = pycolmap.Camera(camera_id=number, model="SIMPLE_PINHOLE", width=2, height=2, params=[1, 1, 1])
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(f"{IMPORTED}{name}", camera_id=number, image_id=number)  # `place` wants the user's name
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(world_from_cam)[:3]))
    before = np.vstack([np.zeros(3), np.eye(3)])
    corners = [model.add_point3D(corner, pycolmap.Track()) for corner in before]
    placed = place(model, quarter_turns, geo, None, positions)
    origin, *axes = (np.asarray(model.points3D[corner].xyz) for corner in corners)
    columns = np.stack(axes, axis=1) - origin[:, None]
    scale = float(np.cbrt(np.linalg.det(columns)))
    return placed, pycolmap.Sim3d(scale, pycolmap.Rotation3d(columns / scale), origin)


def fit(source: Floats, target: Floats) -> tuple[pycolmap.Sim3d, Floats, float, float, bool] | None:
    """Fit a similarity to positions (N, 3) with outliers; z is up in both, and stays so if they do not tell it better.

    Returns:
        target_from_source, fitting (N,), the median of their errors, the relative standard deviation of the scale, and
        whether the positions told what is up; None if nothing fits.
    """
    for max_error in MAX_ERRORS_M:
        options = pycolmap.RANSACOptions(max_error=max_error, random_seed=0)
        found: Any = pycolmap.estimate_sim3d_robust(source, target, options)
        if found is not None and found["num_inliers"] >= max(3, MIN_AGREEING * len(source)):
            break
    else:
        return None
    new_from_old = found["tgt_from_src"]
    for _ in range(3):
        errors = np.linalg.norm(new_from_old * source - target, axis=1)
        fitting = errors <= max(OUTLIER * np.median(errors), 1e-9)
        a, b = source[fitting], target[fitting]
        new_from_old = pycolmap.estimate_sim3d(a, b) or new_from_old
    errors = np.linalg.norm(new_from_old * a - b, axis=1)
    # Of the model: noise spreads the known positions, which would then state a scale surer than it is.
    spread = new_from_old.scale * np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
    sigma = np.sqrt((errors**2).sum() / max(3 * len(a) - 7, 1))
    level = bool(np.degrees(sigma / max(spread[1], 1e-9)) < MAX_TILT_DEG)
    if not level:  # rotate about z only
        from_plane, to_plane = ((points - points.mean(axis=0))[:, :2] @ [1, 1j] for points in (a, b))
        turn = np.vdot(from_plane, to_plane) / np.vdot(from_plane, from_plane).real
        cos, sin = turn.real / abs(turn), turn.imag / abs(turn)
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        shift = b.mean(axis=0) - abs(turn) * rotation @ a.mean(axis=0)
        new_from_old = pycolmap.Sim3d(abs(turn), pycolmap.Rotation3d(rotation), shift)
        errors = np.linalg.norm(new_from_old * a - b, axis=1)
        sigma = np.sqrt((errors**2).sum() / max(3 * len(a) - 5, 1))
    return new_from_old, fitting, float(np.median(errors)), float(sigma / max(np.linalg.norm(spread), 1e-9)), level


def read_positions(path: Path) -> dict[str, Floats]:
    """Read a CSV file with the columns image, x, y, z: camera centers, meters.

    Raises:
        CaptureError: the file cannot be read, or a row is malformed; names the line.
    """
    rows = read_csv(path)
    values = numbers_in(rows, ("x", "y", "z"), path)
    if "image" not in rows:
        raise CaptureError(f"{path}: column 'image' is missing; expected image,x,y,z.")
    return dict(zip(rows["image"].str.strip(), values, strict=True))


def quarter_turns(exif: Mapping[int, Any]) -> int:
    """Return the counter-clockwise quarter turns that make an image upright, from the orientation in EXIF."""
    return {3: 2, 6: 3, 8: 1}.get(int(read_number(exif, ORIENTATION)), 0)


def gps_position(path: Path) -> tuple[float, float, float] | None:
    """Return latitude, longitude and altitude of the GPS tags; None without them."""
    try:
        with PIL.Image.open(path) as image:
            tags = image.getexif().get_ifd(_GPS_TAGS)
        degrees = [float(np.dot([float(value) for value in tags[key]], [1, 1 / 60, 1 / 3600])) for key in (2, 4)]
        latitude, longitude = (value * (-1 if str(tags[key]).upper() in "SW" else 1)
                               for key, value in zip((1, 3), degrees, strict=True))  # fmt: skip
        altitude = float(tags.get(6, 0.0)) * (-1 if tags.get(5) in (1, b"\x01") else 1)
    except (*HEADER_ERRORS, KeyError, TypeError, ZeroDivisionError):
        return None
    return (latitude, longitude, altitude) if np.isfinite([latitude, longitude, altitude]).all() else None


def _upright(image: pycolmap.Image, quarter_turns: int) -> Floats:
    """Return world_from_cam (4, 4) of the camera as if it had been held upright."""
    return inverse(image.cam_from_world()) @ invert(turned_from_cam(quarter_turns))


def _rotation_to_z(up: Floats) -> Floats:
    """Return the smallest rotation (3, 3) that turns a unit vector to z."""
    v, c = np.cross(up, [0.0, 0.0, 1.0]), up[2]
    if c < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + c))


def _point(model: pycolmap.Reconstruction, images: Mapping[str, pycolmap.Image], text: str) -> Floats:
    """Return the point (3,) at `IMAGE:x,y`, at the depth of the model's points near the pixel; or a camera's center."""
    name, colon, pixel = text.rpartition(":")
    image = images.get(name if colon else text)
    try:
        xy = np.array([float(value) for value in pixel.split(",")]) if colon else np.zeros(2)
    except ValueError:
        xy = np.zeros(0)
    if image is None or xy.shape != (2,):
        expected = f"IMAGE or IMAGE:x,y with an image of the model: {', '.join(list(images)[:3])}"
        raise ManifestError(f"distance: found {text!r}, expected {expected}.")
    if not colon:
        return np.asarray(image.projection_center())
    camera, world_from_cam = image.camera, image.cam_from_world().inverse()
    assert camera is not None
    seen = [point for point in image.points2D if point.has_point3D()]
    away = np.linalg.norm(np.array([point.xy for point in seen]).reshape(-1, 2) - xy, axis=1)
    near = [seen[index] for index in np.argsort(away, kind="stable")[:5] if away[index] < NEAR_PX * camera.width]
    if not near:
        do = "Choose a corner or a pattern, no plain area."
        raise ManifestError(f"distance: the model has no point near {text}. {do}")
    depths = np.array([(image.cam_from_world() * model.points3D[point.point3D_id].xyz)[2] for point in near])
    if depths.max() > MAX_DEPTHS * depths.min():
        apart = 100 * (depths.max() / depths.min() - 1)
        found = f"distance: points near {text} are at depths that differ by {apart:.0f} %"
        raise ManifestError(f"{found}. Choose a pixel away from edges of objects.")
    ray = np.asarray(camera.cam_from_img(xy[None]))[0]
    return np.asarray(world_from_cam * (np.append(ray, 1.0) * np.median(depths)))


def east_north_up(positions: Floats, origin: Floats) -> Floats:
    """Return positions (N, 3), latitude, longitude (degrees) and altitude (meters), in the local frame at `origin`.

    WGS 84 to Earth-centered, Earth-fixed coordinates and to local ones, B. Hofmann-Wellenhof et al., "GNSS", 2008.
    """
    return (_earth_fixed(positions) - _earth_fixed(origin)) @ _local_axes(origin).T


def geographic(positions: Floats, origin: Floats) -> Floats:
    """Return the inverse of `east_north_up`: latitudes, longitudes and altitudes (N, 3) of positions (N, 3)."""
    return np.asarray(pycolmap.GPSTransform().enu_to_ellipsoid(np.asarray(positions, np.float64), *origin))


def geographic_poses(world_from_cams: Floats, origin: Floats) -> Floats:
    """Return `GEO_COLUMNS` (N, 5) of camera poses (N, 4, 4) in the local frame at `origin`; NaN for poses of NaN.

    The heading is that of the optical axis, clockwise from true north at the camera, 0 to 360 degrees; NaN if it is
    vertical. The pitch is its angle above the horizon.
    """
    geo = geographic(world_from_cams[:, :3, 3], origin)
    axes = np.stack([_local_axes(one) for one in geo]).reshape(-1, 3, 3)
    # From the frame at the origin to that at each camera, where north has another direction.
    east, north, up = np.einsum("nij,kj,nk->in", axes, _local_axes(origin), world_from_cams[:, :3, 2])
    heading = np.degrees(np.arctan2(east, north)) % 360
    heading[np.hypot(east, north) < _MIN_HORIZONTAL] = np.nan
    return np.column_stack([geo, heading, np.degrees(np.arcsin(np.clip(up, -1, 1)))])


def origin_of(session: Session) -> Floats:
    """Return latitude, longitude (degrees) and altitude (meters) of the origin of a map.

    Raises:
        CaptureError: the map has no origin on the Earth, or a malformed one.
    """
    for name in (RECONSTRUCTION_RECORD, IMPORT_RECORD):
        origin = read_json(session.path / name).get("origin")
        if origin is not None:
            try:
                values = np.array([float(origin[key]) for key in GEO_COLUMNS[:3]])
            except (KeyError, TypeError, ValueError):
                values = np.full(3, np.nan)
            if not np.isfinite(values).all() or abs(values[0]) > 90:
                expected = f"expected the numbers {', '.join(GEO_COLUMNS[:3])}"
                raise CaptureError(f"{session.path / name}: origin: found {origin!r}, {expected}.")
            return values
    fault = "the map has no origin on the Earth, so its poses have no latitude and longitude"
    do = "Reconstruct it from photographs with GPS. Or, if its axes are east, north and up, in meters, write the key"
    keys = f"`origin` with {', '.join(GEO_COLUMNS[:3])} into {IMPORT_RECORD}"
    raise CaptureError(f"{session.path}: {fault}. {do} {keys}.")


def deviation_of(session: Session) -> float:
    """Return the standard deviation of a map's place on the Earth, meters; 0 if it is not known."""
    records = [read_json(session.path / name) for name in (RECONSTRUCTION_RECORD, IMPORT_RECORD)]
    return float(next((record[WORLD_DEVIATION] for record in records if WORLD_DEVIATION in record), 0.0))


def _earth_fixed(geo: Floats) -> Floats:
    """Return Earth-centered, Earth-fixed coordinates (..., 3), meters."""
    latitude, longitude, altitude = np.radians(geo[..., 0]), np.radians(geo[..., 1]), geo[..., 2]
    normal = _EARTH_M / np.sqrt(1 - _SQUARE * np.sin(latitude) ** 2)
    flat = (normal + altitude) * np.cos(latitude)
    z = (normal * (1 - _SQUARE) + altitude) * np.sin(latitude)
    return np.stack([flat * np.cos(longitude), flat * np.sin(longitude), z], axis=-1)


def _local_axes(origin: Floats) -> Floats:
    """Return the directions east, north and up at a place, the rows of (3, 3), in Earth-fixed coordinates."""
    lat, lon = np.radians(origin[:2])
    return np.array([
        [-np.sin(lon), np.cos(lon), 0.0],
        [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
        [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
    ])  # fmt: skip
