"""The table of device kinds, and the names of their sessions.

Each folder `<kind>_map` or `<kind>_query` of a capture is a session of that kind. A row of the table sets the label,
the color and the session names of a kind; kinds without a row work too. A manifest adds rows with `extra_devices`; a
run passes them to its notebooks in an environment variable.
"""

import json
import os
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace

from toolkit.files import environment_variable

EXTRA_DEVICES = "TOOLKIT_EXTRA_DEVICES"  # environment variable with the rows that a manifest adds, in JSON
SPLITS = ("map", "query")


@dataclass(frozen=True)
class DeviceKind:
    """One kind of device."""

    key: str  # name in session folders, file names and tables
    label: str  # name in figures and the report
    color: str  # color in figures, #rrggbb
    sessions: Mapping[str, str] = field(default_factory=dict)
    """Name of the session folder by split, for data sets that do not name it `<key>_<split>`."""


# Colors of Okabe and Ito, which color-blind people can distinguish. Session names of LaMAR.
TABLE = (
    DeviceKind("ios", "phone", "#0072B2", {"query": "query_phone"}),
    DeviceKind("hl", "headset", "#D55E00", {"query": "query_hololens"}),
    DeviceKind("spot", "robot", "#009E73"),
)
# LaMAR has a single map with images of all its devices.
OTHER_SESSIONS = {"map": ("mixed", "map")}
_FURTHER_COLORS = ("#CC79A7", "#8C6D1F", "#332288", "#882255")


def kinds() -> tuple[DeviceKind, ...]:
    """Return the rows of the table, including those that the manifest of this run adds or replaces."""
    rows = {kind.key: kind for kind in TABLE}
    for row in json.loads(os.environ.get(EXTRA_DEVICES, "[]")):
        default = rows.get(row["key"]) or DeviceKind(row["key"], row["key"], _color_of_other(row["key"]))
        rows[row["key"]] = replace(default, **{name: value for name, value in row.items() if value})
    return tuple(rows.values())


def extra_devices(rows: Sequence[Mapping[str, object]]) -> AbstractContextManager[None]:
    """Add rows to the table within the context, in this process and in the processes that it starts.

    Args:
        rows: mappings with `key` and optionally `label`, `color` and `sessions`, as in `DeviceKind`.
    """
    return environment_variable(EXTRA_DEVICES, json.dumps([dict(row) for row in rows]))


def table_record() -> list[dict[str, object]]:
    """Return the table as JSON, for fingerprints of artifacts that depend on it."""
    return [asdict(kind) for kind in kinds()]


def color_of(key: str) -> str:
    """Return the color of a kind of device, #rrggbb; a kind without a row gets one of a few further colors."""
    return next((kind.color for kind in kinds() if kind.key == key), _color_of_other(key))


def in_order(keys: Iterable[str]) -> list[str]:
    """Return the distinct keys in the order of the table; keys without a row come last, sorted by name."""
    order = [kind.key for kind in kinds()]
    return sorted(set(keys), key=lambda key: (order.index(key) if key in order else len(order), key))


def session_of(folder: str) -> tuple[str, str]:
    """Return kind and split of a session by its folder name; for other folders the split is not in `SPLITS`."""
    names = {name: (kind.key, split) for kind in kinds() for split, name in kind.sessions.items()}
    key, _, split = folder.rpartition("_")
    return (OTHER_SESSIONS | names).get(folder, (key, split))


def session_id(folder: str) -> str:
    """Return the name of a session in all outputs, `<key>_<split>`, by its folder name."""
    key, split = session_of(folder)
    return f"{key}_{split}" if split in SPLITS else folder


def _color_of_other(key: str) -> str:
    return _FURTHER_COLORS[zlib.crc32(key.encode()) % len(_FURTHER_COLORS)]
