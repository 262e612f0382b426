"""The kinds of devices: rows of a table, and what their sessions are called.

A capture's sessions say which kinds it has: every folder `<kind>_map` or `<kind>_query` is a session of that kind, and
a kind that no row is about takes part like the others. Rows hold what a name alone does not tell. A manifest adds rows
with `extra_devices`; a run hands them to its notebooks in the environment.
"""

import json
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field

EXTRA_DEVICES = "TOOLKIT_EXTRA_DEVICES"
"""Variable of the environment that holds the rows a manifest adds, as JSON."""
SPLITS = ("map", "query")


@dataclass(frozen=True)
class DeviceKind:
    """One kind of device."""

    key: str
    """In session names, file names and tables."""
    label: str
    """For people."""
    color: str
    """In figures, as #rrggbb."""
    sessions: Mapping[str, str] = field(default_factory=dict)
    """Name of the session folder by split, where a data set does not call it `<key>_<split>`."""


# Colors of Okabe and Ito, which people with any color vision tell apart. Session names are those of LaMAR.
TABLE = (
    DeviceKind("ios", "phone", "#0072B2", {"query": "query_phone"}),
    DeviceKind("hl", "headset", "#D55E00", {"query": "query_hololens"}),
    DeviceKind("spot", "robot", "#009E73"),
)
# LaMAR has one map, which all its devices took.
OTHER_SESSIONS = {"map": ("mixed", "map")}
_FURTHER_COLORS = ("#CC79A7", "#8C6D1F", "#332288", "#882255")


def kinds() -> tuple[DeviceKind, ...]:
    """Return the rows of the table, with those that the manifest of this run adds or replaces."""
    rows = {kind.key: kind for kind in TABLE}
    for row in json.loads(os.environ.get(EXTRA_DEVICES, "[]")):
        known = rows.get(row["key"])
        label = row.get("label") or (known.label if known else row["key"])
        color = row.get("color") or (known.color if known else _color_of_other(row["key"]))
        rows[row["key"]] = DeviceKind(row["key"], label, color, row.get("sessions") or {})
    return tuple(rows.values())


@contextmanager
def extra_devices(rows: Sequence[Mapping[str, object]]) -> Iterator[None]:
    """Add rows to the table, here and in processes that are started meanwhile.

    Args:
        rows: `key`, and where they are given `label`, `color`, `sessions`, as in `DeviceKind`.
    """
    before = os.environ.get(EXTRA_DEVICES)
    os.environ[EXTRA_DEVICES] = json.dumps([dict(row) for row in rows])
    try:
        yield
    finally:
        del os.environ[EXTRA_DEVICES]
        if before is not None:
            os.environ[EXTRA_DEVICES] = before


def table_record() -> list[dict[str, object]]:
    """Return the table as JSON, for what is made from it."""
    return [asdict(kind) for kind in kinds()]


def color_of(key: str) -> str:
    """Return the color of a kind of device, #rrggbb; one of a few for a kind that has no row."""
    return next((kind.color for kind in kinds() if kind.key == key), _color_of_other(key))


def in_order(keys: Iterable[str]) -> list[str]:
    """Return different keys in the order of the table, and after those the ones that have no row, by name."""
    present = set(keys)
    known = [kind.key for kind in kinds() if kind.key in present]
    return known + sorted(present - set(known))


def session_of(folder: str) -> tuple[str, str]:
    """Return kind and split of the session in a folder of this name; another folder's split is none of `SPLITS`."""
    other = {name: (kind.key, split) for kind in kinds() for split, name in kind.sessions.items()}
    if folder in (names := OTHER_SESSIONS | other):
        return names[folder]
    key, _, split = folder.rpartition("_")
    return key, split


def session_id(folder: str) -> str:
    """Return what the session in a folder of this name is called in all outputs, `<key>_<split>`."""
    key, split = session_of(folder)
    return f"{key}_{split}" if split in SPLITS else folder


def _color_of_other(key: str) -> str:
    return _FURTHER_COLORS[zlib.crc32(key.encode()) % len(_FURTHER_COLORS)]
