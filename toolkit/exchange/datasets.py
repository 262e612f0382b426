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


def arrange(sessions: str | Path, names: Mapping[str, str]) -> list[str]:
    """Rename the sessions of a data set. Split a session by device if several new names refer to it.

    A session is split by its subsessions, whose names begin with `<device>_`. `queries.txt` is copied to
    `proc/keyframes_original.txt`. Images are moved, not copied. Return notes on what was left out.

    Args:
        sessions: folder of the sessions; changed in place. Sessions that are not in `names` stay as they are.
        names: for each new name, `<device>_<map or query>`, the session's name in the data set.

    Raises:
        CaptureError: a session to split has no subsession of a device, or an invalid subsession name.
    """
    sessions = Path(sessions)
    notes = []
    for old_name in dict.fromkeys(names.values()):
        old = sessions / old_name
        new = [sessions / name for name, source in names.items() if source == old_name]
        if not old.is_dir() or new == [old]:
            continue
        if len(new) == 1:
            old.rename(new[0])
        else:
            notes += _split(old, new)
        for session in new:
            if (session / "queries.txt").is_file():
                (session / "proc").mkdir(exist_ok=True)
                shutil.copyfile(session / "queries.txt", session / "proc" / "keyframes_original.txt")
    return notes


def _split(old: Path, new: list[Path]) -> list[str]:
    """Split a session into one per device; return notes on what was left out."""
    unclaimed = subsessions = set(_subsessions(old))
    for name in subsessions:
        require_name(name, "subsession", old / "proc" / "subsessions.txt")
    for session in new:
        device = session.name.rpartition("_")[0]
        own = {name for name in subsessions if name.startswith(f"{device}_")}
        if not own:
            raise CaptureError(
                f"{old.name}: expected subsessions of device {device!r}, named {device}_...; found "
                f"{', '.join(sorted(subsessions)[:3]) or 'none'}. Remove {session.name} from dataset.sessions."
            )
        unclaimed = unclaimed - own
        for file, column in _KEY_COLUMNS.items():
            if (old / file).is_file():
                _copy_rows(old / file, session / file, column, own)
        for name in own:
            if (old / "raw_data" / name).is_dir():
                (session / "raw_data").mkdir(parents=True, exist_ok=True)
                (old / "raw_data" / name).rename(session / "raw_data" / name)
    split_files = {old / file for file in _KEY_COLUMNS}
    other_files = [path for path in old.rglob("*") if path.is_file() and path not in split_files]
    shutil.rmtree(old)
    notes = []
    if unclaimed:
        notes.append(f"{old.name}: {len(unclaimed)} subsessions of other devices, such as {min(unclaimed)}")
    if other_files:
        example = other_files[0].name
        notes.append(f"{old.name}: {len(other_files)} files that cannot be split by device, such as {example}")
    return notes


def _subsessions(session: Path) -> list[str]:
    list_file = session / "proc" / "subsessions.txt"
    if list_file.is_file():
        lines = list_file.read_text(encoding="utf-8").splitlines()
        return [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    return sorted(path.name for path in (session / "raw_data").glob("*") if path.is_dir())


def _copy_rows(source: Path, target: Path, column: int, subsessions: set[str]) -> None:
    """Copy the comments and the rows of the given subsessions."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with open(source, encoding="utf-8") as lines, open(target, "w", encoding="utf-8") as out:
        for line in lines:
            cells = line.split(",", column + 1)
            if line.startswith("#") or (len(cells) > column and cells[column].strip().partition("/")[0] in subsessions):
                out.write(line)
