"""Rename and split the sessions of other data sets as the capture format has them.

LaMAR (Sarlin, Dusmanu et al., ECCV 2022) has one session `map` of phones and headsets together, and lists its queries
in `queries.txt`; here a session is of one device, and lists of queries are `proc/keyframes_*.txt`.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path

from toolkit.capture.names import require_name
from toolkit.errors import CaptureError

# Files of a session, with the column whose values begin with the subsession: `<subsession>/<sensor>`.
_KEY_COLUMNS = {
    "sensors.txt": 0,
    "rigs.txt": 0,
    "images.txt": 1,
    "depths.txt": 1,
    "trajectories.txt": 1,
    "wifi.txt": 1,
    "bt.txt": 1,
    "pointclouds.txt": 1,
    "queries.txt": 1,
    "proc/alignment_trajectories.txt": 1,
    "proc/subsessions.txt": 0,
}


def arrange(sessions: str | Path, names: Mapping[str, str]) -> list[str]:
    """Rename the sessions of a data set, and split by device a session that several names stand for.

    A session is split by its subsessions, whose names begin with `<device>_`. A list `queries.txt` becomes
    `proc/keyframes_original.txt`. Images are moved, not copied. Return what was left
    out, in words.

    Args:
        sessions: folder of the sessions; changed in place. A session that `names` does not have stays as it is.
        names: for each new name, `<device>_<map or query>`, the session's name in the data set.

    Raises:
        CaptureError: a session to split has no subsession of a device, or one whose name leads out of it.
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
    """Split a session into one of each device; return what was left out."""
    unclaimed = subsessions = set(_subsessions(old))
    for name in subsessions:
        require_name(name, "subsession", old / "proc" / "subsessions.txt")
    for session in new:
        device = session.name.rpartition("_")[0]
        own = {name for name in subsessions if name.startswith(f"{device}_")}
        if not own:
            raise CaptureError(
                f"{old.name}: has no subsession of device {device!r}, whose names begin with {device}_; found "
                f"{', '.join(sorted(subsessions)[:3]) or 'none'}. Take {session.name} out of dataset.sessions."
            )
        unclaimed = unclaimed - own
        for file, column in _KEY_COLUMNS.items():
            if (old / file).is_file():
                _copy_rows(old / file, session / file, column, own)
        for name in own:
            if (old / "raw_data" / name).is_dir():
                (session / "raw_data").mkdir(parents=True, exist_ok=True)
                (old / "raw_data" / name).rename(session / "raw_data" / name)
    split = {old / file for file in _KEY_COLUMNS}
    others = [path for path in old.rglob("*") if path.is_file() and path not in split]
    shutil.rmtree(old)
    notes = []
    if unclaimed:
        notes.append(f"{old.name}: {len(unclaimed)} subsessions of other devices, such as {min(unclaimed)}")
    if others:
        notes.append(f"{old.name}: {len(others)} files that cannot be split by device, such as {others[0].name}")
    return notes


def _subsessions(session: Path) -> list[str]:
    listed = session / "proc" / "subsessions.txt"
    if listed.is_file():
        lines = listed.read_text(encoding="utf-8").splitlines()
        return [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    return sorted(path.name for path in (session / "raw_data").glob("*") if path.is_dir())


def _copy_rows(source: Path, target: Path, column: int, subsessions: set[str]) -> None:
    """Copy the comments, and the rows whose key begins with one of the subsessions."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with open(source, encoding="utf-8") as lines, open(target, "w", encoding="utf-8") as out:
        for line in lines:
            cells = line.split(",", column + 1)
            if line.startswith("#") or (len(cells) > column and cells[column].strip().partition("/")[0] in subsessions):
                out.write(line)
