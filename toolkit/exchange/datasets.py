"""Rename and split the sessions of other data sets to match the capture format.

In LaMAR (Sarlin, Dusmanu et al., ECCV 2022) one session `map` holds phones and headsets, and `queries.txt` lists the
queries. Here each session has one device, and `proc/keyframes_*.txt` list the queries.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path

from toolkit.capture.names import require_name
from toolkit.capture.tables import COLUMNS
from toolkit.errors import CaptureError

# For each file of a session, the column whose values are `<subsession>/<sensor>` or `<subsession>`.
_KEY_COLUMNS = {file: int(columns[0][0] == "timestamp") for file, columns in COLUMNS.items()}
_KEY_COLUMNS |= {"pointclouds.txt": 1, "queries.txt": 1}


def arrange(sessions: Path, names: Mapping[str, str]) -> list[str]:
    """Rename the sessions of a data set. Split a session by device if several new names refer to it.

    A session is split by its subsessions, whose names begin with `<device>_`. `queries.txt` is copied to
    `proc/keyframes_original.txt`. Images are moved, not copied. Return notes on what was left out.

    Args:
        sessions: folder of the sessions; changed in place. Sessions that are not in `names` stay as they are.
        names: for each new name, `<device>_<map or query>`, the session's name in the data set.

    Raises:
        CaptureError: a session to split has no subsession of a device, or an invalid subsession name.
    """
    notes = []
    for old in [sessions / name for name in dict.fromkeys(names.values())]:
        new = [sessions / name for name, source in names.items() if source == old.name]
        if not old.is_dir() or new == [old]:
            continue
        if len(new) > 1:
            notes += _split(old, new)
        else:
            old.rename(new[0])
        for session in [session for session in new if (session / "queries.txt").is_file()]:
            (session / "proc").mkdir(exist_ok=True)
            shutil.copyfile(session / "queries.txt", session / "proc" / "keyframes_original.txt")
    return notes


def _split(old: Path, new: list[Path]) -> list[str]:
    """Split a session into one per device; return notes on what was left out."""
    list_file = old / "proc" / "subsessions.txt"
    lines = list_file.read_text(encoding="utf-8").splitlines() if list_file.is_file() else []
    subsessions = {line.strip() for line in lines if line.strip() and not line.startswith("#")}
    subsessions = subsessions or {path.name for path in (old / "raw_data").glob("*") if path.is_dir()}
    for name in subsessions:
        require_name(name, "subsession", list_file)
    unclaimed = set(subsessions)
    for session in new:
        device = session.name.rpartition("_")[0]
        own = {name for name in subsessions if name.startswith(f"{device}_")}
        unclaimed -= own
        if not own:
            raise CaptureError(
                f"{old.name}: expected subsessions of device {device!r}, named {device}_...; found "
                f"{', '.join(sorted(subsessions)[:3]) or 'none'}. Remove {session.name} from dataset.sessions."
            )
        for file, column in _KEY_COLUMNS.items():
            if (old / file).is_file():
                (session / file).parent.mkdir(parents=True, exist_ok=True)
                with open(old / file, encoding="utf-8") as rows, open(session / file, "w", encoding="utf-8") as out:
                    for row in rows:
                        key = (*row.split(","), *[""] * column)[column].strip().partition("/")[0]
                        if row.startswith("#") or key in own:
                            out.write(row)
        (session / "raw_data").mkdir(parents=True, exist_ok=True)
        for folder in [old / "raw_data" / name for name in own if (old / "raw_data" / name).is_dir()]:
            folder.rename(session / "raw_data" / folder.name)
    others = {path.relative_to(old).as_posix() for path in old.rglob("*") if path.is_file()} - _KEY_COLUMNS.keys()
    shutil.rmtree(old)
    left_out = {"subsessions of other devices": unclaimed, "files that cannot be split by device": others}
    return [f"{old.name}: {len(items)} {what}, such as {min(items)}" for what, items in left_out.items() if items]
