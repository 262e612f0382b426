"""Which images of a map a query can show, by what is known of its place: radio signals, GPS fixes, rough poses.

Radio: what a device receives within some seconds is compared with what was received at the map's images, as the LaMAR
benchmark does (P.-E. Sarlin et al., "LaMAR: Benchmarking Localization and Mapping for Augmented Reality", ECCV 2022).
There levels are compared in dB, where the query received any; here all strengths by the angle between them, as the
receivers of different devices differ by several dB.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from toolkit.capture.session import Session
from toolkit.capture.tables import as_strings, codes_of, times_of
from toolkit.capture.trajectory import Trajectory
from toolkit.geometry import Floats, Ints

Bools = NDArray[np.bool_]

_BLOCK = 1 << 24
"""Pairs of a query and a map image that are looked at at a time."""
_FAINTEST_DBM = -100.0
"""Weaker signals are hardly received; strengths count from here."""
_ACCURACIES = 2.0
"""A fix is within so many accuracies, the radius of 68 %, in 99 % of cases, where errors are normal."""


@dataclass(frozen=True)
class Masks:
    """Which of N rows each of Q queries may find, in N / 8 bytes a distinct mask."""

    count: int
    """N."""
    bits: NDArray[np.uint8]
    """(M, N / 8) the distinct masks, the first row in the lowest bit."""
    which: Ints
    """(Q,) the mask of each query; -1: it may find all rows."""

    @classmethod
    def of(cls, masks: Iterable[Bools], which: Ints, count: int) -> "Masks":
        """Make masks of blocks (m, N) of distinct ones; one that leaves no row limits no query."""
        bits = [np.zeros((0, -(-count // 8)), np.uint8)]
        bits += [np.packbits(block, axis=1, bitorder="little") for block in masks]
        stacked = np.concatenate(bits)
        some = np.append(stacked.any(axis=1), False)  # for -1, which comes last
        return cls(count, stacked, np.where(some[which], which, -1))

    def __len__(self) -> int:
        return len(self.which)

    def choose(self, queries: Ints | slice) -> "Masks":
        """Return those of some of the queries."""
        return replace(self, which=self.which[queries])

    def rows(self, start: int, stop: int) -> Bools:
        """Return what each query may find of some of the rows, (Q, stop - start)."""
        first, last, limited = start // 8, -(-stop // 8), self.which >= 0
        packed = np.full((len(self), last - first), 255, np.uint8)
        packed[limited] = self.bits[self.which[limited], first:last]
        unpacked = np.unpackbits(packed, axis=1, bitorder="little").view(bool)
        return unpacked[:, start - 8 * first : stop - 8 * first]

    def distinct(self) -> Iterator[tuple[Ints, Bools | None]]:
        """Yield for each distinct mask the queries that have it, and the mask (N,); None: they may find all rows."""
        order = np.argsort(self.which, kind="stable")
        masks, starts = np.unique(self.which[order], return_index=True)
        for mask, queries in zip(masks, np.split(order, starts[1:]), strict=True):
            yield queries, None if mask < 0 else self.choose(queries[:1]).rows(0, self.count)[0]

    @classmethod
    def stack(cls, parts: Sequence["Masks"]) -> "Masks":
        """Return several sets of queries, of the same rows, one below the other."""
        starts = np.cumsum([0, *(len(part.bits) for part in parts)])
        which = [np.where(part.which < 0, -1, part.which + start) for part, start in zip(parts, starts, strict=False)]
        return cls(parts[0].count, np.concatenate([part.bits for part in parts]), np.concatenate(which))


def combine(priors: Sequence[Masks]) -> tuple[Masks, list[int]]:
    """Return what all priors allow, and for each how many queries it does not limit.

    A prior that has nothing to say about a query, or contradicts those before it there, does not count for it.
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
    limited = combinations.max(axis=1) >= 0  # the first prior of a query cannot contradict another
    return Masks(priors[0].count, bits, np.where(limited[which], which, -1)), without


def near(world_from_cams: Floats, world_from_cam: Floats, distance_m: float, angle_deg: float = 180.0) -> Bools:
    """Return which of N map cameras could see what a camera at a roughly known pose sees, (N,) bool.

    Roll about the viewing direction does not count: it moves what is seen only within the image.

    Args:
        world_from_cams: (N, 4, 4) of the map, OpenCV axes; one that is NaN is not near.
        world_from_cam: (4, 4) of the query, in the map's frame.
        distance_m: most distance between the camera centers, in the unit of the poses.
        angle_deg: most angle between the viewing directions (z axes).
    """
    found = np.linalg.norm(world_from_cams[:, :3, 3] - world_from_cam[:3, 3], axis=1) <= distance_m
    forward = world_from_cams[found, :3, 2], world_from_cam[:3, 2]
    # atan2 is exact near 0 and 180 degrees, where the arccos of rounded numbers is not.
    sine, cosine = np.linalg.norm(np.cross(*forward), axis=1), forward[0] @ forward[1]
    found[found] = np.degrees(np.arctan2(sine, cosine)) <= angle_deg
    return found


def pose_masks(
    poses: Trajectory,
    mapped: Session,
    map_rows: Ints,
    asked: Session,
    rows: Ints,
    distance_m: float,
    angle_deg: float,
) -> Masks:
    """Return the masks of map images that are `near` roughly known poses of query images.

    Args:
        poses: world_from_device of query devices, the rigs' or else the cameras', in the map's frame.
        map_rows, rows: of the images of the two sessions, (N,) and (Q,).
    """
    times, sensors = times_of(asked.images)[rows], asked.images["sensor_id"].iloc[rows]
    world_from_cams = poses.lookup(times, asked.device_ids[rows]) @ asked.rig_from_cam(rows)
    of_camera = poses.lookup(times, sensors)
    unknown = np.isnan(world_from_cams[:, 0, 0])
    world_from_cams[unknown] = of_camera[unknown]
    which = np.where(np.isnan(world_from_cams[:, 0, 0]), -1, np.arange(len(rows)))
    of_map = mapped.world_from_cam(map_rows)
    masks = (near(of_map, pose, distance_m, angle_deg)[None] for pose in world_from_cams)
    return Masks.of(masks, which, len(map_rows))


def gps_masks(mapped: Session, map_rows: Ints, asked: Session, rows: Ints, margin_m: float, window_s: float) -> Masks:
    """Return the masks of map images whose GPS fix can be where that of a query image is.

    Two fixes can be within the margin of each other if their distance is at most that and twice both accuracies. A map
    image without a fix can be anywhere, if the query is where any other is.

    Args:
        map_rows, rows: of the images of the two sessions, (N,) and (Q,).
        margin_m: most distance between a query and a map image that shows what it shows.
        window_s: a fix counts for images so long before and after it.
    """
    count, nowhere = len(map_rows), np.full(len(rows), -1)
    tables = [_fixes(mapped), _fixes(asked)]
    if any(table.empty for table in tables):
        return Masks.of([], nowhere, count)
    origin = tables[0].iloc[0]
    place, where = _mean_fix(mapped, map_rows, tables[0], origin, window_s)
    place_asked, which = _mean_fix(asked, rows, tables[1], origin, window_s)

    def blocks() -> Iterator[Bools]:
        for part in _blocks(place_asked, max(count, len(place))):
            reach = margin_m + _ACCURACIES * (part[:, None, 2] + place[:, 2])
            can_be = np.hypot(*np.moveaxis(part[:, None, :2] - place[:, :2], -1, 0)) <= reach
            yield np.hstack([can_be, can_be.any(axis=1, keepdims=True)])[:, where]  # -1, no fix, takes the last

    return Masks.of(blocks(), which, count)


def _fixes(session: Session) -> pd.DataFrame:
    table = session.gps
    if table is None:
        return pd.DataFrame({"timestamp": []})
    return table[table["horizontal_accuracy_m"] >= 0].reset_index(drop=True)


def _mean_fix(
    session: Session, rows: Ints, table: pd.DataFrame, origin: "pd.Series[float]", window_s: float
) -> tuple[Floats, Ints]:
    """Return means (S, 3) of fixes, meters east and north of `origin` and accuracy, and that of each image."""
    names = ["longitude_deg", "latitude_deg"]
    away = np.radians((table[names] - origin[names].astype(float) + 180) % 360 - 180).to_numpy()
    # On the tangent plane of the ellipsoid of WGS 84: its radii of curvature across and along the meridian.
    sine = np.sin(np.radians(float(origin["latitude_deg"])))
    across = 6378137.0 / np.sqrt(1 - 0.00669437999014 * sine**2)
    along = across * (1 - 0.00669437999014) / (1 - 0.00669437999014 * sine**2)
    meters = away * [across * np.sqrt(1 - sine**2), along]
    fixes = np.column_stack([meters, table["horizontal_accuracy_m"]])
    within, which = _within(session, rows, table, window_s)
    return within @ fixes / np.maximum(within.sum(axis=1), 1)[:, None], which


def radio_masks(mapped: Session, map_rows: Ints, asked: Session, rows: Ints, least: int, window_s: float) -> Masks:
    """Return the masks of the map images that received most nearly what a device received at query images.

    The likeness is the cosine between the strengths of all emitters, in dB above -100 dBm and 0 where they were not
    received. Map images without a scan take that of the nearest one that has any.

    Args:
        map_rows, rows: of the images of the two sessions, (N,) and (Q,); those of the map have poses.
        least: so many of the map's images are allowed, if so many received any of the query's emitters; more where
            they are equal.
        window_s: a scan counts for images so long before and after it.
    """
    count = len(map_rows)
    heard = [_heard(mapped), _heard(asked)]
    emitters = pc.unique(as_strings(heard[0]["emitter"]))
    strengths, where = _strengths(mapped, map_rows, heard[0], emitters, window_s)
    strengths_asked, which = _strengths(asked, rows, heard[1], emitters, window_s)
    known = where >= 0
    if not known.any():
        return Masks.of([], np.full(len(rows), -1), count)
    centers = mapped.world_from_cam(map_rows)[:, :3, 3]
    where[~known] = where[known][cKDTree(centers[known]).query(centers[~known])[1]]
    images = np.bincount(where, minlength=strengths.shape[0])

    def blocks() -> Iterator[Bools]:
        for part in _blocks(strengths_asked, max(count, len(images))):
            likeness = (part @ strengths.T).toarray()
            order = np.argsort(-likeness, axis=1)
            enough = np.argmax(np.cumsum(images[order], axis=1) >= min(least, count), axis=1)[:, None]
            lowest = np.take_along_axis(likeness, np.take_along_axis(order, enough, axis=1), axis=1)
            yield ((likeness >= lowest) & (likeness > 0))[:, where]

    return Masks.of(blocks(), which, count)


def _blocks(of_queries: "Floats | csr_array", width: int) -> Iterator["Floats | csr_array"]:
    step = max(1, _BLOCK // width)
    for start in range(0, of_queries.shape[0], step):
        yield of_queries[start : start + step]


def _heard(session: Session) -> pd.DataFrame:
    """Return all signals of a session, table [timestamp, sensor_id, emitter, rssi_dbm]."""
    parts = [pd.DataFrame({"timestamp": np.zeros(0, np.int64), "sensor_id": [], "emitter": [], "rssi_dbm": []})]
    for table, name in ((session.wifi, "mac_addr"), (session.bluetooth, "id")):
        if table is not None and len(table):
            emitters = table[name].str.lower()  # as the benchmark does: programs differ in how they write an address
            parts.append(table.assign(emitter=emitters)[list(parts[0])])
    return pd.concat(parts[1:] or parts, ignore_index=True)


def _strengths(
    session: Session, rows: Ints, heard: pd.DataFrame, emitters: pa.Array, window_s: float
) -> tuple[csr_array, Ints]:
    """Return mean strengths (S, E) of emitters, rows of length 1, and the row of each image, -1 without a scan."""
    codes = codes_of(as_strings(heard["emitter"]), emitters)
    heard, codes = heard[codes >= 0], codes[codes >= 0]
    strength = np.maximum(heard["rssi_dbm"].to_numpy(np.float64) - _FAINTEST_DBM, 1)
    within, which = _within(session, rows, heard, window_s)
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


def _within(session: Session, rows: Ints, table: pd.DataFrame, window_s: float) -> tuple[csr_array, Ints]:
    """Return which of L lines of a table are of the recordings and times of images.

    A line is of the recording whose name its sensor's id begins with; without such a name it is of all.

    Returns:
        A matrix (S, L), with a row for each distinct set of lines, 1 where a line is in it; and the row of each image,
        -1 without a line.
    """
    names = sorted(session.subsessions, key=len)
    sensors, of_line = as_strings(table["sensor_id"]), np.full(len(table), -1)
    for number, name in enumerate(names):
        of_line[pc.starts_with(sensors, f"{name}/").to_numpy(zero_copy_only=False)] = number
    of_image = pd.Index(names, dtype=object).get_indexer(session.subsession_of(rows))
    order = np.lexsort((times_of(table), of_line))
    times, of_line = times_of(table)[order], of_line[order]
    asked, window = times_of(session.images)[rows], round(window_s * 1e6)
    spans = np.zeros((len(rows), 2, 2), np.int64)  # of its own recording, and of none
    for number in np.unique(of_image):
        images = np.flatnonzero(of_image == number)
        for span, recording in enumerate((number, -1)):
            first, last = np.searchsorted(of_line, [recording, recording + 1])
            spans[images, span, 0] = first + np.searchsorted(times[first:last], asked[images] - window)
            spans[images, span, 1] = first + np.searchsorted(times[first:last], asked[images] + window, side="right")
    spans[of_image < 0, 0] = 0
    spans[spans[..., 0] == spans[..., 1]] = 0
    distinct, which = np.unique(spans.reshape(-1, 4), axis=0, return_inverse=True)
    parts = [csr_array((len(distinct), len(table)))]
    for first, last in (distinct[:, :2].T, distinct[:, 2:].T):
        starts = np.concatenate([[0], np.cumsum(last - first)])
        lines = order[np.arange(starts[-1]) + np.repeat(first - starts[:-1], last - first)]
        parts.append(csr_array((np.ones(len(lines)), lines, starts), parts[0].shape))
    found, which = parts[1] + parts[2], which.reshape(-1)
    return found, np.where(distinct.max(axis=1)[which] > 0, which, -1)
