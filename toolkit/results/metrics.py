"""Pose errors, recall, reasons of losses, the order of queries from worst to best, and overlap of images in view."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture.images import in_view, view_bounds
from toolkit.files import image_name
from toolkit.geometry import Floats, Ints, invert, pose_error, transform
from toolkit.manifest import PnpSettings
from toolkit.pose.base import Status
from toolkit.runs.folder import counted

if TYPE_CHECKING:
    import pycolmap

    from toolkit.capture import Session, Trajectory
    from toolkit.mapping.local_map import LocalMap

Threshold = tuple[float, float]
"""Degrees and meters."""

THRESHOLDS: tuple[Threshold, ...] = ((1, 0.1), (5, 0.5), (5, 1.0))
WRONG: Threshold = (5, 0.5)
"""An `ok` pose with larger errors counts as wrong (`ok_wrong`)."""
NO_REFERENCE, NO_POSE, WRONG_POSE = REASONS = ("no good reference", "no pose", "wrong pose")
"""Why a query misses a threshold."""
MIN_OVERLAP = 0.1
"""A reference overlaps with a query if the query sees at least this share of the points that the reference sees."""
UNKNOWN_UNIT = "L"
"""Replaces the meter if the unit of the poses is unknown: a tenth of the median scene depth of a map."""


def length_unit(record: Mapping[str, Any]) -> tuple[str, float]:
    """Return the unit that a map's lengths are shown in, and its length in that of the poses, by the map's record."""
    return ("m", 1.0) if record["unit"] or not record["depth"] else (UNKNOWN_UNIT, record["depth"] / 10)


def unit_of(*thresholds: str) -> str:
    """Return the unit of thresholds from their names or column names: `m`, also without names, `L`, or `m or L`."""
    ends = (("m", "m)"), (UNKNOWN_UNIT, f"{UNKNOWN_UNIT})"))
    return " or ".join(unit for unit, end in ends if any(name.endswith(end) for name in thresholds)) or "m"


def named_by_unit(table: pd.DataFrame, unit: str) -> pd.DataFrame:
    """Return a table whose columns of lengths say their unit: `translation_error_L`, not `translation_error_m`.

    A table of pairs with different units has a column for each; a length of all of them has no unit in its name.
    """
    end = f"_{unit}" if unit in ("m", UNKNOWN_UNIT) else ""
    return table.rename(columns=lambda name: re.sub(r"_m(_\d+)?$", rf"{end}\1", name))


def named_as_meters(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table that `named_by_unit` has named with one column for each length, as the toolkit computes."""
    others = {name: re.sub(f"_{UNKNOWN_UNIT}$", "_m", name) for name in table if name.endswith(f"_{UNKNOWN_UNIT}")}
    both = {name: meters for name, meters in others.items() if meters in table}
    joined = {meters: table[meters].fillna(table[name]) for name, meters in both.items()}
    return table.assign(**joined).drop(columns=[*both]).rename(columns=others)


def small_unit(unit: str) -> tuple[str, float]:
    """Return the unit that errors are shown in, and the factor from `unit` to it."""
    return ("cm", 100.0) if unit == "m" else (unit, 1.0)


def pose_errors(
    estimated: "Trajectory | Floats", truth: "Trajectory | Floats", keys: pd.DataFrame | None = None
) -> tuple[Floats, Floats]:
    """Return the rotation error, degrees, and the translation error, meters, of each query, (N,) each.

    The LaMAR benchmark defines them: angle and length of inverse(estimated) @ true. A query without an estimate has
    infinite errors; a query without a true pose, NaN.

    Args:
        estimated: world_from_device of the queries: a trajectory, or (N, 4, 4) with NaN for missing poses.
        truth: true world_from_device, in the same form.
        keys: the queries, columns `timestamp` and `device_id`; needed for trajectories.
    """
    estimates, truths = poses_of(estimated, keys), poses_of(truth, keys)
    if estimates.shape != truths.shape:
        raise ValueError(f"Expected one true pose per estimate, got {truths.shape} for {estimates.shape}.")
    has_truth, has_estimate = is_posed(truths), is_posed(estimates)
    rotation_deg = np.where(has_truth, np.inf, np.nan)
    translation = rotation_deg.copy()
    both = has_truth & has_estimate
    if both.any():
        rotation_deg[both], translation[both] = pose_error(estimates[both], truths[both])
    return rotation_deg, translation


def poses_of(poses: "Trajectory | Floats", keys: pd.DataFrame | None) -> Floats:
    """Return world_from_device (N, 4, 4) of queries (columns timestamp, device_id); NaN without a pose."""
    if isinstance(poses, np.ndarray):
        return poses
    if keys is None:
        raise ValueError("A trajectory needs `keys`: the queries, columns timestamp and device_id.")
    return poses.lookup(keys["timestamp"].to_numpy(np.int64), keys["device_id"].to_numpy(str))


def is_posed(poses: Floats) -> NDArray[np.bool_]:
    """Return which of poses (..., 4, 4) are finite."""
    return np.asarray(np.isfinite(poses).all((-1, -2)), bool)


def recall(rotation_deg: Floats, translation_m: Floats, thresholds: Sequence[Threshold] = THRESHOLDS) -> Floats:
    """Return the share of queries, 0 to 1, with both errors strictly below each (degrees, meters) pair.

    All queries count; a query without a pose has infinite errors and is a miss. NaN without queries.
    """
    rotation_deg, translation_m = np.asarray(rotation_deg), np.asarray(translation_m)
    if not len(rotation_deg):
        return np.full(len(thresholds), np.nan)
    return np.array([np.mean(is_below(rotation_deg, translation_m, threshold)) for threshold in thresholds])


def is_below(rotation_deg: Floats, translation: Floats, threshold: Threshold) -> NDArray[np.bool_]:
    """Return which queries have both errors strictly below a threshold."""
    return (rotation_deg < threshold[0]) & (translation < threshold[1])


def threshold_name(threshold: Threshold, unit: str = "m") -> str:
    """Return the name of a threshold in tables, such as `(1deg,0.1m)`."""
    return f"({threshold[0]:g}deg,{threshold[1]:g}{unit})"


def parse_threshold(name: str) -> Threshold:
    """Return the threshold of a name such as `(5deg,0.5m)` or `recall@(5deg,0.5m)`."""
    degrees, _, meters = name.rpartition("@")[2].strip("()").partition(",")
    return float(degrees.removesuffix("deg")), float(meters.rstrip(f"m{UNKNOWN_UNIT}"))


def threshold_text(name: str) -> str:
    """Return the name of a threshold, or of a column `recall@...`, as a person writes it."""
    degrees, length = parse_threshold(name)
    return f"{degrees:g}°, {length:g}\N{NO-BREAK SPACE}{unit_of(name)}"


def worst_first(queries: pd.DataFrame, threshold: Threshold = THRESHOLDS[0]) -> Ints:
    """Return the row positions of queries, ordered from worst to best.

    Failed queries come first. With ground truth, the others are ordered by their error: the larger of the rotation and
    the translation error, in units of `threshold`. Without, low confidence comes before ok, then few inliers before
    many, then a large stated deviation before a small one.

    Args:
        queries: one row per query. Column `status`; and, NaN or absent if unknown, `rotation_error_deg`,
            `translation_error_m`, `num_inliers` and `position_std_m`, or these lengths in `_L`.
        threshold: degrees and length that are equally bad.
    """
    queries = named_as_meters(queries)

    def column(name: str, unknown: float) -> Floats:
        values: Any = queries[name] if name in queries else np.full(len(queries), np.nan)
        values = np.asarray(values, np.float64)
        return np.where(np.isnan(values), unknown, values)

    status = queries["status"]
    ok, sure = (status != Status.FAILED).to_numpy(bool), (status != Status.LOW_CONFIDENCE).to_numpy(bool)
    rotation, translation = column("rotation_error_deg", -1) / threshold[0], column("translation_error_m", -1)
    error = np.maximum(rotation, translation / threshold[1])
    # lexsort: the last key is the primary one.
    return np.lexsort((-column("position_std_m", np.inf), column("num_inliers", 0), sure, -error, ok))


def worst_of_each(queries: pd.DataFrame, most: int, threshold: Threshold = THRESHOLDS[0]) -> Ints:
    """Return what `worst_first` does, at most `most` rows, each query only in the map in which it went worst."""
    order = worst_first(queries, threshold)
    keys = queries.iloc[order].reindex(columns=["query_device", "device_id", "timestamp"])
    return order[~keys.duplicated().to_numpy(bool)][:most]


def summary_of(
    rotation_deg: Floats, translation: Floats, thresholds: Sequence[Threshold], unit: str
) -> dict[str, float]:
    """Return recall at each threshold, `recall@<name>`, and the medians of both errors, all queries counted."""
    shares = recall(rotation_deg, translation, thresholds)
    return {
        **{f"recall@{threshold_name(t, unit)}": share for t, share in zip(thresholds, shares, strict=True)},
        "median_rotation_deg": float(np.median(rotation_deg)),
        f"median_translation_{unit}": float(np.median(translation)),
    }


def camera_messages(session: "Session", tables: Sequence[pd.DataFrame]) -> list[str]:
    """Return a message for each camera whose focal length or principal point does not fit most of its queries.

    Two images must tell, or one whose probability is that of `ok` poses: wrong matches fit some focal length, too.
    Cameras whose names differ only in a timestamp at the end count as one: a phone may have one for each image.

    Args:
        session: session of the queries.
        tables: `poses/<pair>.csv` of pairs with these queries: timestamp, device_id, status, status_text, p_correct,
            focal_px and principal_point_px.
    """
    posed, sensors, columns = Counter[str](), session.images["sensor_id"].to_numpy(), ("focal_px", "principal_point_px")
    fitted: dict[tuple[str, str], list[tuple[list[float], int, bool]]] = {}
    for table in tables:
        sure = table.reindex(columns=["p_correct"])["p_correct"].to_numpy(float) >= PnpSettings().ok_probability
        rows = table.reindex(columns=["status", "status_text", *columns]).astype(object)
        texts = rows.where(rows.notna(), "").astype(str).to_dict("records")
        for images, row, certain in zip(session.rows_of_keyframes(table), texts, sure, strict=True):
            if row["status"] in ("", Status.FAILED):
                continue
            in_doubt = row["status"] == Status.LOW_CONFIDENCE and row["status_text"] != row["status"]  # for a reason
            names = [re.sub(r"[_-]\d{6,}$", "", sensor_id) for sensor_id in sensors[images]]
            posed.update(names)
            for column in columns if in_doubt else ():
                for name, image, value in zip(names, images, row[column].split(";"), strict=False):
                    if value:
                        fit = [float(x) for x in value.split()], int(image), bool(certain)
                        fitted.setdefault((name, column), []).append(fit)
    messages = []
    for (name, column), found in fitted.items():
        values, seen_in, is_sure = zip(*found, strict=True)
        if len(found) < posed[name] / 2 or (len({*seen_in}) < 2 and not any(is_sure)):
            continue
        file, median_of = f"{session.id}/sensors.txt", f"(median of {counted(len(found), 'poses')})"
        fits_px, cameras = np.array(values), [session.camera(sensors[image]) for image in seen_in]
        if column == "focal_px":
            stated = np.array([camera.mean_focal_length() for camera in cameras])
            fits = f"the focal length that fits is {np.median(fits_px):.0f} px {median_of}, "
            fits += f"{file} says {stated[0]:.0f} px"
            if np.ptp(stated) > 0:
                ratio = np.median(fits_px[:, 0] / stated)
                fits = f"the focal lengths that fit are {ratio:.3f} times those in {file} {median_of}"
        else:
            x, y = np.median(fits_px, axis=0)
            stated_xy = f"{cameras[0].principal_point_x:.0f}, {cameras[0].principal_point_y:.0f}"
            fits = f"the principal point that fits is {x:.0f}, {y:.0f} px {median_of}, {file} says {stated_xy}"
        messages.append(f"camera {name}: {fits}. Correct it and localize again.")
    return messages


def overlap_in_view(points: Floats, reference: Floats, world_from_cam: Floats, camera: "pycolmap.Camera") -> float:
    """Return the share, 0 to 1, of a reference's points that lie in the view of another camera.

    D2-Net (M. Dusmanu et al., CVPR 2019) selects training pairs by such an overlap of sparse points. A point counts as
    not seen if the two lines of sight differ by more than 90 degrees, as it would be seen from behind.

    Args:
        points: (P, 3) triangulated points that the reference observes, world, meters.
        reference: (3,) center of the reference.
        world_from_cam: (4, 4) pose of the other camera.
        camera: intrinsics of the other camera.
    """
    if not len(points):
        return 0.0
    in_cam = transform(invert(world_from_cam), points)
    same_side = np.sum((points - reference) * (points - world_from_cam[:3, 3]), axis=1) > 0
    seen = in_view(in_cam[None], view_bounds(camera)[None])[0] & same_side
    return float(seen.mean())


def overlap_of(
    reference: Mapping[str, Any],
    session: "Session",
    local_map: "LocalMap | None",
    world_from_cam: Floats,
    camera: "pycolmap.Camera",
) -> float:
    """Return `overlap_in_view`, in the view of another image, for the points that a reference, as in a file of
    references, sees in the triangulated map of its session; without a map, for a grid of points in its view.
    """
    pose = np.array(reference["Tws"], float)
    if local_map is not None:
        image = local_map.index_of.get(image_name(str(reference["path"])))
        seen = np.zeros(0, np.int64) if image is None else np.unique(local_map.observations(image)[1])
        return overlap_in_view(local_map.points[seen], pose[:3, 3], world_from_cam, camera)
    left, right, top, bottom = view_bounds(session.camera(reference["sensor_id"]))
    x, y = np.meshgrid(np.linspace(left, right, 9), np.linspace(top, bottom, 9))
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(1, -1, 3)
    points = (rays * np.array([2.0, 4.0, 8.0, 16.0])[:, None, None]).reshape(-1, 3)
    return overlap_in_view(transform(pose, points), pose[:3, 3], world_from_cam, camera)
