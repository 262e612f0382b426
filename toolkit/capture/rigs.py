"""Find the rig that holds a sensor at a given time."""

from collections.abc import Iterable

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from toolkit.capture.tables import KeyIndex, as_strings, codes_of
from toolkit.geometry import Ints


def find_rigs(
    rigs: pd.DataFrame | None, timestamps: Ints, sensors: pa.Array, posed: Iterable[tuple[Ints, pa.Array]]
) -> Ints:
    """Return the row of rigs.txt for each (timestamp, sensor), (n,), -1 where no rig holds the sensor.

    A sensor can be in any number of rigs, because rig ids often differ from frame to frame. The rig is the one with a
    pose or a keyframe at that time; without any, the sensor's only rig; as a last resort, the rig named after the
    timestamp.

    Args:
        rigs: table [rig_id, sensor_id].
        timestamps, sensors: n keys.
        posed: timestamps and device ids of poses and keyframes, one pair per file; the first file with an entry wins.
    """
    rig_rows = np.full(len(timestamps), -1, np.int64)
    if rigs is None or rigs.empty:
        return rig_rows
    rig_ids, members = as_strings(rigs["rig_id"]), as_strings(rigs["sensor_id"])
    different_rigs = pc.unique(rig_ids)
    rows_of_rig = pd.DataFrame({"rig": codes_of(rig_ids, different_rigs), "row": np.arange(len(rigs))})
    unknown = np.ones(len(timestamps), bool)  # keys without a rig or a pose of the sensor itself so far
    for times, devices in posed:
        keys = np.flatnonzero(unknown)
        if not len(keys):
            return rig_rows
        rig_codes = codes_of(devices, different_rigs)
        if np.any(rig_codes < 0):  # a pose of the sensor itself takes precedence over that of its rig
            direct = KeyIndex(times, devices).find(timestamps[keys], sensors.take(pa.array(keys))) >= 0
            unknown[keys[direct]] = False
            keys = keys[~direct]
        held = pd.DataFrame({"time": times, "rig": rig_codes}).merge(rows_of_rig, on="rig")
        rows = held["row"].to_numpy(np.int64)
        index = KeyIndex(held["time"].to_numpy(np.int64), members.take(pa.array(rows)))
        matches = index.find(timestamps[keys], sensors.take(pa.array(keys)))
        keys, matches = keys[matches >= 0], matches[matches >= 0]
        rig_rows[keys], unknown[keys] = rows[matches], False

    keys = np.flatnonzero(unknown)
    if len(keys):
        only_rigs = np.flatnonzero(~rigs["sensor_id"].duplicated(keep=False))
        matches = codes_of(sensors.take(pa.array(keys)), members.take(pa.array(only_rigs)))
        rig_rows[keys] = np.append(only_rigs, -1)[matches]
        keys = keys[matches < 0]
    if len(keys):
        digits = pc.struct_field(pc.extract_regex(rig_ids, r"(?P<digits>[0-9]{1,18})[^/]*$"), "digits")
        rows = np.flatnonzero(pc.is_valid(digits).to_numpy(zero_copy_only=False))
        times = digits.take(pa.array(rows)).cast(pa.int64()).to_numpy()
        matches = KeyIndex(times, members.take(pa.array(rows))).find(timestamps[keys], sensors.take(pa.array(keys)))
        rig_rows[keys] = np.append(rows, -1)[matches]
    return rig_rows
