"""Names in a capture: the kinds of devices and their sessions, and what names and links may be.

Each folder `<kind>_map` or `<kind>_query` of a capture is a session of that kind. A row of the table of kinds sets the
label, the color and the session names of a kind; kinds without a row work too. A manifest adds rows with
`extra_devices`; a run passes them to its notebooks in an environment variable.

Names become paths of outputs, so they are validated once, when a capture is read. A name is one or more parts separated
by `/`. It has no control characters, and no part is empty or begins with a dot, so a name cannot leave its folder or
hide a file. All files must lie, after resolving links, in the capture or in the session's folder, which may itself be a
link to another disk.
"""

import json
import os
import re
import stat
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from toolkit.errors import CaptureError
from toolkit.files import environment_variable

EXTRA_DEVICES = "TOOLKIT_EXTRA_DEVICES"  # environment variable with the rows that a manifest adds, in JSON
SPLITS = ("map", "query")
# LaMAR has a single map with images of all its devices.
OTHER_SESSIONS = {"map": ("mixed", "map")}
_FURTHER_COLORS = ("#CC79A7", "#8C6D1F", "#332288", "#882255")
ALLOW_OUTSIDE = "TOOLKIT_ALLOW_OUTSIDE"  # environment variable; `1` allows images outside of the capture
LINKED_HERE = "proc/links.txt"
"""File that `import` writes into a session of links: the inode of the session folder, which an archive cannot forge."""
LONGEST = {"capture": 100, "session": 40, "subsession": 200}
"""Largest number of bytes in a part of a name. File systems allow 255, of which names of outputs need some."""
HOW_TO_ALLOW = f"allow_outside: true in the manifest (elsewhere {ALLOW_OUTSIDE}=1) permits it"
# C0 and C1 controls, and Unicode characters that break a line or change its direction.
_CONTROL = r"[\x00-\x1f\x7f-\x{9f}\x{200e}\x{200f}\x{2028}-\x{202e}\x{2066}-\x{2069}]"
_PART = r"(^|/)(\.|/|$)"
EXPECTED_NAME = "a name without control characters whose parts between `/` are not empty and do not begin with a dot"


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


# Names and links


def outside_allowed() -> bool:
    """Tell whether images may lie outside of the capture."""
    return os.environ.get(ALLOW_OUTSIDE) == "1"


def allow_outside(allowed: bool = True) -> AbstractContextManager[None]:
    """Allow images outside of the capture within the context, in this process and in the processes that it starts."""
    return environment_variable(ALLOW_OUTSIDE, "1") if allowed else nullcontext()


def bad_names(names: pa.Array, may_leave: bool = False) -> pa.Array:
    """Tell which names are refused; with `may_leave`, names may be absolute and have parts that begin with a dot."""
    return pc.match_substring_regex(names, f"{_CONTROL}|^$" if may_leave else f"{_CONTROL}|{_PART}")


def is_bad_name(name: str) -> bool:
    """Tell whether a name is refused; also if it has surrogates, that is, is not valid Unicode."""
    broken = re.search("[\ud800-\udfff]", name) is not None
    return broken or bool(bad_names(pa.array([name], pa.large_string()))[0].as_py())


def has_long_part(name: str, kind: str) -> bool:
    """Tell whether a part of a name is longer than `LONGEST` allows for this kind."""
    return max(map(len, os.fsencode(name).split(b"/"))) > LONGEST[kind]


def require_name(name: str, kind: str, place: str | Path) -> None:
    """Raise CaptureError at a place if outputs cannot be named after a kind: `capture`, `session` or `subsession`."""
    if is_bad_name(name) or ("/" in name and kind != "subsession"):
        raise CaptureError(f"{place}: found the {kind} {name!r}, expected {EXPECTED_NAME}. Rename it.")
    if has_long_part(name, kind):
        fault = f"has a name of more than {LONGEST[kind]} bytes, too long for names of files"
        raise CaptureError(f"{place}: the {kind} {name[:40]!r}... {fault}. Rename it.")


def leads_out(path: Path, roots: Sequence[Path]) -> Path | None:
    """Return the target of a path, with links resolved, if it is outside of all `roots`; else None."""
    target = Path(os.path.realpath(path))
    return None if any(target.is_relative_to(root) for root in roots) else target


def links_out(folder: Path, paths: "pd.Series[str]", roots: Sequence[Path]) -> dict[int, Path]:
    """Return the files, relative to `folder`, that links lead out of the `roots`: their rows in `paths` and targets.

    Each folder is resolved once; of its files, only links.
    """
    folders = paths.str.replace(r"[^/]*$", "", regex=True)
    outside = {name: leads_out(folder / name, roots) is not None for name in folders.unique()}
    targets: dict[int, Path] = {}
    for row, (is_outside, path) in enumerate(zip(folders.map(outside), paths, strict=True)):
        is_link = is_outside or os.path.islink(f"{folder}/{path}")  # noqa: PTH114 - Path takes three times as long
        if is_link and (target := leads_out(folder / path, roots)):
            targets[row] = target
    return targets


def is_linked_here(session: Path) -> bool:
    """Tell whether `import` made this session folder on this disk, with links to the user's own images.

    A copy from elsewhere has another inode than the one in its file.
    """
    note = session / LINKED_HERE
    try:  # reading a pipe could block, a device never ends
        status = note.lstat()
        plain = stat.S_ISREG(status.st_mode) and status.st_size < 32
        return plain and int(note.read_text(encoding="utf-8")) == session.stat().st_ino
    except (OSError, ValueError):
        return False


def note_linked_here(session: Path) -> None:
    """Record in a session's folder that its links are the user's own."""
    (session / LINKED_HERE).unlink(missing_ok=True)  # it may be a hard link to that of an older folder
    (session / LINKED_HERE).write_text(f"{session.stat().st_ino}\n", encoding="utf-8")
