"""Masks: which map images a query may retrieve, according to radio signals, GPS fixes or rough poses.

Radio: the signals that a device receives within some seconds are compared with those received at the map images, as in
the LaMAR benchmark (P.-E. Sarlin et al., "LaMAR: Benchmarking Localization and Mapping for Augmented Reality", ECCV
2022). The benchmark compares levels in dB of the emitters that the query received. Here the angle between the vectors
of all strengths is compared, because receivers of different devices differ by several dB.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from toolkit.capture.session import SUBSESSIONS, Session
from toolkit.capture.tables import SIGNALS, Trajectory, as_strings, codes_of, times_of
from toolkit.errors import ManifestError
from toolkit.files import file_fingerprint
from toolkit.geometry import Floats, Ints
from toolkit.manifest import MaskSettings

Bools = NDArray[np.bool_]
MAX_ANGLE_DEG = 90.0
"""Largest angle between the viewing directions of a rough pose and a map camera, degrees; roll is ignored."""
GPS_MARGIN_M = 25.0
"""Largest distance between two GPS fixes, meters, beyond twice the sum of their stated accuracies."""
RADIO_SHARE = 0.025
"""Share of the map images that a radio mask keeps, as in the benchmark."""
WINDOW_S = 2.0
"""Largest time difference between an image and the radio scans and GPS fixes used for it, seconds."""
_CHOICE = 3
"""Map images that a radio mask leaves per reference, at least. Radio knows the place but not the viewing direction, so
the descriptors must have some to choose from."""
Images = tuple[Session, Ints]
"""Images of the map, N, or queries, Q: their session, and their rows in it."""

_BLOCK = 1 << 24  # pairs of a query and a map image that are processed at a time
_FAINTEST_DBM = -100.0  # zero of the scale of strengths: weaker signals are hardly received
# Radius that contains the true position in 99 % of cases if errors are normal, in stated accuracies (68 % radii).
_ACCURACIES = 2.0


@dataclass(frozen=True)
class Masks:
    """Which of N map images each of Q queries may retrieve; N / 8 bytes per distinct mask."""

    count: int  # N, the number of map images
    bits: NDArray[np.uint8]  # (M, N / 8) the distinct masks, the first map image in the lowest bit
    which: Ints  # (Q,) row in `bits` of each query's mask; -1: all map images are allowed

    @classmethod
    def of(cls, masks: Iterable[Bools], which: Ints, count: int) -> "Masks":
        """Make masks from blocks (m, N) of distinct masks; a mask that allows no map image is ignored."""
        bits = [np.zeros((0, -(-count // 8)), np.uint8)]
        bits += [np.packbits(block, axis=1, bitorder="little") for block in masks]
        stacked = np.concatenate(bits)
        some = np.append(stacked.any(axis=1), False)  # the last entry is for -1
        return cls(count, stacked, np.where(some[which], which, -1))

    def __len__(self) -> int:
        return len(self.which)

    def choose(self, queries: Ints | slice) -> "Masks":
        """Return the masks of some of the queries."""
        return replace(self, which=self.which[queries])

    def rows(self, start: int, stop: int) -> Bools:
        """Return which of the map images from `start` to `stop` each query may retrieve, (Q, stop - start)."""
        first, last, limited = start // 8, -(-stop // 8), self.which >= 0
        packed = np.full((len(self), last - first), 255, np.uint8)
        packed[limited] = self.bits[self.which[limited], first:last]
        unpacked = np.unpackbits(packed, axis=1, bitorder="little").view(bool)
        return unpacked[:, start - 8 * first : stop - 8 * first]

    def distinct(self) -> Iterator[tuple[Ints, Bools | None]]:
        """Yield for each distinct mask the queries that have it, and the mask (N,); None: all map images."""
        order = np.argsort(self.which, kind="stable")
        masks, starts = np.unique(self.which[order], return_index=True)
        for mask, queries in zip(masks, np.split(order, starts[1:]), strict=True):
            yield queries, None if mask < 0 else self.choose(queries[:1]).rows(0, self.count)[0]

    @classmethod
    def stack(cls, sets: Sequence["Masks"]) -> "Masks":
        """Concatenate the masks of several sets of queries over the same map images."""
        starts = np.cumsum([0, *(len(masks.bits) for masks in sets)])
        which = [np.where(masks.which < 0, -1, masks.which + start) for masks, start in zip(sets, starts, strict=False)]
        return cls(sets[0].count, np.concatenate([masks.bits for masks in sets]), np.concatenate(which))


def combine(priors: Sequence[Masks]) -> tuple[Masks, list[int]]:
    """Return the map images that all priors allow, and for each prior the number of queries that it does not limit.

    For each query, a prior without information, or one that contradicts those before it, is ignored.
    """
    combinations, which = np.unique(np.stack([prior.which for prior in priors], axis=1), axis=0, return_inverse=True)
    which = which.reshape(-1)
    bits = np.full((len(combinations), priors[0].bits.shape[1]), 255, np.uint8)
    without = []
    for prior, mask in zip(priors, combinations.T, strict=True):
        counts = np.flatnonzero(mask >= 0)
        both = bits[counts] & prior.bits[mask[counts]]
        some = both.any(axis=1)
        bits[counts[some]] = both[some]
        without.append(int(len(which) - np.isin(which, counts[some]).sum()))
    limited = combinations.max(axis=1) >= 0  # the first prior of a query has nothing to contradict
    return Masks(priors[0].count, bits, np.where(limited[which], which, -1)), without


def enabled_priors(settings: MaskSettings) -> list[str]:
    """Return the names of the enabled priors, as settings have them."""
    return [name for name in ("poses", "gps", "radio") if getattr(settings, name)]


class Priors:
    """The priors on the location of queries that the settings enable: rough poses, GPS, radio signals."""

    def __init__(self, settings: MaskSettings) -> None:
        """Raise ManifestError if the file of rough poses is missing, CaptureError if it is malformed."""
        if settings.poses is not None and not Path(settings.poses).is_file():
            expected = "Expected poses as in trajectories.txt."
            raise ManifestError(f"retrieve.mask.poses: found no file {settings.poses}. {expected}")
        self.settings = settings
        self.poses = None if settings.poses is None else Trajectory.read(settings.poses)

    def masks(self, map_images: Images, query_images: Images, topk: int) -> tuple[Masks | None, dict[str, int]]:
        """Return the map images that each query image may find as one of `topk` references, None: all; and by the name
        of each prior the number of query images that it leaves the whole map.
        """
        images, priors = (map_images, query_images), dict[str, Masks]()
        if self.poses is not None:
            priors["poses"] = pose_masks(self.poses, *images, self.settings.poses_distance, MAX_ANGLE_DEG)
        if self.settings.gps:
            priors["gps"] = gps_masks(*images, GPS_MARGIN_M, WINDOW_S)
        if self.settings.radio:
            least = max(_CHOICE * topk, int(np.ceil(RADIO_SHARE * len(map_images[1]))))
            priors["radio"] = radio_masks(*images, least, WINDOW_S)
        if not priors:
            return None, {}
        masks, counts = combine(list(priors.values()))
        return masks, dict(zip(priors, counts, strict=True))

    def record(self, *sessions: Session) -> dict[str, Any]:
        """Return the settings and fingerprints of the files that masks depend on; empty without priors."""
        settings, record, names = self.settings, dict[str, Any](), list[str]()
        if settings.poses:
            record["poses"] = [file_fingerprint(settings.poses), settings.poses_distance, MAX_ANGLE_DEG]
        if settings.gps:
            record["gps"], names = [GPS_MARGIN_M, WINDOW_S], ["gps.txt"]
        if settings.radio:
            record["radio"], names = [RADIO_SHARE, WINDOW_S], [*names, *SIGNALS]
        if names:
            paths = [session.path / name for session in sessions for name in (*names, SUBSESSIONS)]
            record["files"] = [file_fingerprint(path) if path.exists() else None for path in paths]
        return {"mask": record} if record else {}


def near(world_from_cams: Floats, world_from_cam: Floats, distance: float, angle_deg: float = 180.0) -> Bools:
    """Return which of N map cameras may see the same scene as a camera at a roughly known pose, (N,) bool.

    Roll about the viewing direction is ignored, because it only rotates the image.

    Args:
        world_from_cams: (N, 4, 4) poses of the map cameras, OpenCV axes; a NaN pose is not near.
        world_from_cam: (4, 4) pose of the query, in the map's frame.
        distance: largest distance between the camera centers, in the unit of the poses.
        angle_deg: largest angle between the viewing directions (z axes).
    """
    is_near = np.linalg.norm(world_from_cams[:, :3, 3] - world_from_cam[:3, 3], axis=1) <= distance
    forward = world_from_cams[is_near, :3, 2], world_from_cam[:3, 2]
    # atan2 is exact near 0 and 180 degrees, where the arccos of rounded numbers is not.
    sine, cosine = np.linalg.norm(np.cross(*forward), axis=1), forward[0] @ forward[1]
    is_near[is_near] = np.degrees(np.arctan2(sine, cosine)) <= angle_deg
    return is_near


def pose_masks(poses: Trajectory, map_images: Images, query_images: Images, distance: float, angle_deg: float) -> Masks:
    """Return masks of the map images that are `near` the roughly known poses, world_from_device, of query images."""
    session, rows = query_images
    times, sensors = times_of(session.images)[rows], session.images["sensor_id"].iloc[rows]
    of_rig = poses.lookup(times, session.device_ids[rows]) @ session.rig_from_cam(rows)
    world_from_cams = np.where(np.isnan(of_rig[:, :1, :1]), poses.lookup(times, sensors), of_rig)
    return near_masks(map_images, world_from_cams, distance, angle_deg)


def near_masks(map_images: Images, world_from_cams: Floats, distance: float, angle_deg: float) -> Masks:
    """Return masks of the map images that are `near` the poses (Q, 4, 4) of query images; NaN is not known."""
    which = np.where(np.isnan(world_from_cams[:, 0, 0]), -1, np.arange(len(world_from_cams)))
    of_map = map_images[0].world_from_cam(map_images[1])
    masks = (near(of_map, pose, distance, angle_deg)[None] for pose in world_from_cams)
    return Masks.of(masks, which, len(of_map))


def gps_masks(map_images: Images, query_images: Images, margin_m: float, window_s: float) -> Masks:
    """Return masks of the map images whose GPS fixes are near those of query images.

    Two fixes are near if their distance is at most the margin plus twice both accuracies. A map image without a fix is
    allowed if the query is near any other map image.

    Args:
        margin_m: largest distance between a query and a map image that show the same scene.
        window_s: largest time difference between an image and its fixes.
    """
    count, fixes = len(map_images[1]), [_fixes(session) for session, _ in (map_images, query_images)]
    if fixes[0].empty or fixes[1].empty:
        return Masks.of([], np.full(len(query_images[1]), -1), count)
    origin = fixes[0].iloc[0]
    map_means, map_which = _mean_fix(map_images, fixes[0], origin, window_s)
    query_means, which = _mean_fix(query_images, fixes[1], origin, window_s)

    def blocks() -> Iterator[Bools]:
        for block in _blocks(query_means, max(count, len(map_means))):
            reach = margin_m + _ACCURACIES * (block[:, None, 2] + map_means[:, 2])
            is_near = np.hypot(*np.moveaxis(block[:, None, :2] - map_means[:, :2], -1, 0)) <= reach
            yield np.hstack([is_near, is_near.any(axis=1, keepdims=True)])[:, map_which]  # -1, no fix, is the last

    return Masks.of(blocks(), which, count)


def _fixes(session: Session) -> pd.DataFrame:
    """Return the rows of gps.txt that have a fix."""
    table = session.gps if session.gps is not None else pd.DataFrame({"horizontal_accuracy_m": []})
    return table[table["horizontal_accuracy_m"] >= 0].reset_index(drop=True)


def _mean_fix(images: Images, table: pd.DataFrame, origin: "pd.Series[float]", window_s: float) -> tuple[Floats, Ints]:
    """Return mean fixes (S, 3), meters east and north of `origin` and accuracy, and the mean's row for each image."""
    names = ["longitude_deg", "latitude_deg"]
    offsets = np.radians((table[names] - origin[names].astype(float) + 180) % 360 - 180).to_numpy()
    # Tangent plane of the WGS 84 ellipsoid, with its radii of curvature across and along the meridian.
    sine = np.sin(np.radians(float(origin["latitude_deg"])))
    across = 6378137.0 / np.sqrt(1 - 0.00669437999014 * sine**2)
    along = across * (1 - 0.00669437999014) / (1 - 0.00669437999014 * sine**2)
    meters = offsets * [across * np.sqrt(1 - sine**2), along]
    fixes = np.column_stack([meters, table["horizontal_accuracy_m"]])
    within, which = _within(images, table, window_s)
    return within @ fixes / np.maximum(within.sum(axis=1), 1)[:, None], which


def radio_masks(map_images: Images, query_images: Images, least: int, window_s: float) -> Masks:
    """Return masks of the map images with the radio signals most similar to those at query images.

    The similarity is the cosine between the vectors of strengths of all emitters, in dB above -100 dBm, 0 for an
    emitter that was not received. A map image without a scan uses the scan of the nearest map image that has one.

    Args:
        map_images, query_images: N and Q images; map images have poses.
        least: number of map images to allow: fewer if fewer received any of the query's emitters, more if some are
            equally similar.
        window_s: largest time difference between an image and its scans.
    """
    count, map_signals = len(map_images[1]), _signals(map_images[0])
    emitters = pc.unique(as_strings(map_signals["emitter"]))
    map_strengths, map_which = _strengths(map_images, map_signals, emitters, window_s)
    query_strengths, which = _strengths(query_images, _signals(query_images[0]), emitters, window_s)
    known = map_which >= 0
    if not known.any():
        return Masks.of([], np.full(len(which), -1), count)
    centers = map_images[0].world_from_cam(map_images[1])[:, :3, 3]
    map_which[~known] = map_which[known][cKDTree(centers[known]).query(centers[~known])[1]]
    images = np.bincount(map_which, minlength=map_strengths.shape[0])

    def blocks() -> Iterator[Bools]:
        for block in _blocks(query_strengths, max(count, len(images))):
            similarity = (block @ map_strengths.T).toarray()
            order = np.argsort(-similarity, axis=1)
            enough = np.argmax(np.cumsum(images[order], axis=1) >= min(least, count), axis=1)[:, None]
            lowest = np.take_along_axis(similarity, np.take_along_axis(order, enough, axis=1), axis=1)
            yield ((similarity >= lowest) & (similarity > 0))[:, map_which]

    return Masks.of(blocks(), which, count)


def _blocks(of_queries: "Floats | csr_array", width: int) -> Iterator["Floats | csr_array"]:
    step = max(1, _BLOCK // width)
    for start in range(0, of_queries.shape[0], step):
        yield of_queries[start : start + step]


def _signals(session: Session) -> pd.DataFrame:
    """Return all WiFi and Bluetooth signals of a session, table [timestamp, sensor_id, emitter, rssi_dbm]."""
    tables = [pd.DataFrame({"timestamp": np.zeros(0, np.int64), "sensor_id": [], "emitter": [], "rssi_dbm": []})]
    for table, name in ((session.wifi, "mac_addr"), (session.bluetooth, "id")):
        if table is not None and len(table):
            emitters = table[name].str.lower()  # as in the benchmark, because programs write addresses differently
            tables.append(table.assign(emitter=emitters)[list(tables[0])])
    return pd.concat(tables[1:] or tables, ignore_index=True)


def _strengths(images: Images, signals: pd.DataFrame, emitters: pa.Array, window_s: float) -> tuple[csr_array, Ints]:
    """Return mean strengths (S, E) of emitters, scaled to unit rows, and the row of each image, -1 without a scan."""
    codes = codes_of(as_strings(signals["emitter"]), emitters)
    signals, codes = signals[codes >= 0], codes[codes >= 0]
    strength = np.maximum(signals["rssi_dbm"].to_numpy(np.float64) - _FAINTEST_DBM, 1)
    within, which = _within(images, signals, window_s)
    sums, times = (
        within @ csr_array((values, codes, np.arange(len(codes) + 1)), (len(codes), len(emitters)))
        for values in (strength, np.ones(len(codes)))
    )
    sums.sort_indices()
    times.sort_indices()
    sums.data /= times.data
    lengths = np.sqrt(sums.multiply(sums).sum(axis=1))
    sums.data /= np.repeat(lengths, np.diff(sums.indptr))
    return sums, which


def _within(images: Images, table: pd.DataFrame, window_s: float) -> tuple[csr_array, Ints]:
    """Return which of L lines of a table belong to an image: those of its recording within the time window.

    A line belongs to the recording whose name its sensor id begins with; without such a name, to all recordings. The
    result is a matrix (S, L), a row per distinct set of lines; and the row of each image, -1 without any line.
    """
    session, rows = images
    names = sorted(session.subsessions, key=len)
    sensors, of_line = as_strings(table["sensor_id"]), np.full(len(table), -1)
    for number, name in enumerate(names):
        of_line[pc.starts_with(sensors, f"{name}/").to_numpy(zero_copy_only=False)] = number
    of_image = pd.Index(names, dtype=object).get_indexer(session.subsession_of(rows))
    order = np.lexsort((times_of(table), of_line))
    times, of_line = times_of(table)[order], of_line[order]
    image_times, window = times_of(session.images)[rows], round(window_s * 1e6)
    spans = np.zeros((len(rows), 2, 2), np.int64)  # lines of the image's recording, and lines of no recording
    for number in np.unique(of_image):
        here = np.flatnonzero(of_image == number)
        for span, recording in enumerate((number, -1)):
            first, last = np.searchsorted(of_line, [recording, recording + 1])
            spans[here, span, 0] = first + np.searchsorted(times[first:last], image_times[here] - window)
            spans[here, span, 1] = first + np.searchsorted(times[first:last], image_times[here] + window, side="right")
    spans[of_image < 0, 0] = 0
    spans[spans[..., 0] == spans[..., 1]] = 0
    distinct, which = np.unique(spans.reshape(-1, 4), axis=0, return_inverse=True)
    members = []
    for first, last in (distinct[:, :2].T, distinct[:, 2:].T):
        starts = np.concatenate([[0], np.cumsum(last - first)])
        lines = order[np.arange(starts[-1]) + np.repeat(first - starts[:-1], last - first)]
        members.append(csr_array((np.ones(len(lines)), lines, starts), (len(distinct), len(table))))
    which = which.reshape(-1)
    return members[0] + members[1], np.where(distinct.max(axis=1)[which] > 0, which, -1)
