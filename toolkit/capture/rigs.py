"""Which rig holds a sensor at a time."""

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

    Rig ids are often made anew for each frame, so a sensor can be in any number of rigs. The rig counts that has a
    pose, or is a keyframe, at that time. Where no file tells, it is the sensor's only rig or, as a last resort, the
    rig that is named after the timestamp.

    Args:
        rigs: table [rig_id, sensor_id].
        timestamps, sensors: n keys.
        posed: timestamps and device ids of poses and keyframes, the most telling file first.
    """
    rig_rows = np.full(len(timestamps), -1, np.int64)
    if rigs is None or rigs.empty:
        return rig_rows
    rig_ids, members = as_strings(rigs["rig_id"]), as_strings(rigs["sensor_id"])
    different_rigs = pc.unique(rig_ids)
    rows_of_rig = pd.DataFrame({"rig": codes_of(rig_ids, different_rigs), "row": np.arange(len(rigs))})
    unknown = np.ones(len(timestamps), bool)  # neither a rig nor a pose of the sensor itself is known yet
    for times, devices in posed:
        keys = np.flatnonzero(unknown)
        if not len(keys):
            return rig_rows
        rig_codes = codes_of(devices, different_rigs)
        if np.any(rig_codes < 0):  # a pose of the sensor itself comes before its rig's
            direct = KeyIndex(times, devices).find(timestamps[keys], sensors.take(pa.array(keys))) >= 0
            unknown[keys[direct]] = False
            keys = keys[~direct]
        held = pd.DataFrame({"time": times, "rig": rig_codes}).merge(rows_of_rig, on="rig")
        rows = held["row"].to_numpy(np.int64)
        index = KeyIndex(held["time"].to_numpy(np.int64), members.take(pa.array(rows)))
        places = index.find(timestamps[keys], sensors.take(pa.array(keys)))
        keys, places = keys[places >= 0], places[places >= 0]
        rig_rows[keys], unknown[keys] = rows[places], False

    keys = np.flatnonzero(unknown)
    if len(keys):
        alone = np.flatnonzero(~rigs["sensor_id"].duplicated(keep=False))
        places = codes_of(sensors.take(pa.array(keys)), members.take(pa.array(alone)))
        rig_rows[keys] = np.append(alone, -1)[places]
        keys = keys[places < 0]
    if len(keys):
        digits = pc.struct_field(pc.extract_regex(rig_ids, r"(?P<digits>[0-9]{1,18})[^/]*$"), "digits")
        rows = np.flatnonzero(pc.is_valid(digits).to_numpy(zero_copy_only=False))
        times = digits.take(pa.array(rows)).cast(pa.int64()).to_numpy()
        places = KeyIndex(times, members.take(pa.array(rows))).find(timestamps[keys], sensors.take(pa.array(keys)))
        rig_rows[keys] = np.append(rows, -1)[places]
    return rig_rows
