"""Sessions as other data sets name them, brought into the names and the split by device of the capture format.

LaMAR (Sarlin, Dusmanu et al., ECCV 2022) has one session `map` of phones and headsets together, and lists its queries
in `queries.txt`; here a session is of one device, and lists of queries are `proc/keyframes_*.txt`.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path

from toolkit.errors import CaptureError

# Files of a session, with the column that begins with the subsession: `<subsession>/<sensor>`.
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
    """Give sessions the names that they have here, and split one that several devices share.

    A session that is named for several is split by its subsessions, whose names begin with `<device>_`. A list
    `queries.txt` becomes `proc/keyframes_original.txt`. Images are moved, not copied.

    Args:
        sessions: folder of the sessions; changed in place. What `names` does not have stays.
        names: for each session's name here, `<device>_<map or query>`, its name there.

    Returns:
        What was left out, in words.

    Raises:
        CaptureError: a session to split has no subsession of a device.
    """
    sessions = Path(sessions)
    notes = []
    for there in dict.fromkeys(names.values()):
        old = sessions / there
        heirs = [name for name, source in names.items() if source == there]
        if not old.is_dir() or heirs == [there]:
            continue
        if len(heirs) == 1:
            old.rename(sessions / heirs[0])
        else:
            notes += _split(old, [sessions / heir for heir in heirs])
        for heir in heirs:
            queries = sessions / heir / "queries.txt"
            if queries.is_file():
                keyframes = sessions / heir / "proc" / "keyframes_original.txt"
                keyframes.parent.mkdir(exist_ok=True)
                shutil.copyfile(queries, keyframes)
    return notes


def _split(old: Path, heirs: list[Path]) -> list[str]:
    subsessions = _subsessions(old)
    unclaimed = set(subsessions)
    for heir in heirs:
        device = heir.name.rpartition("_")[0]
        own = {name for name in subsessions if name.startswith(f"{device}_")}
        if not own:
            raise CaptureError(
                f"{old.name}: has no subsession of device {device!r}, whose names begin with {device}_; found "
                f"{', '.join(subsessions[:3]) or 'none'}. Take {heir.name} out of dataset.sessions."
            )
        unclaimed -= own
        for file, column in _KEY_COLUMNS.items():
            if (old / file).is_file():
                _copy_rows(old / file, heir / file, column, own)
        for name in sorted(own):
            if (old / "raw_data" / name).is_dir():
                (heir / "raw_data").mkdir(parents=True, exist_ok=True)
                (old / "raw_data" / name).rename(heir / "raw_data" / name)
    known = {old / file for file in _KEY_COLUMNS}
    others = [path for path in old.rglob("*") if path.is_file() and path not in known]
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
            if line.startswith("#") or (
                len(cells) > column and cells[column].strip().partition("/")[0] in subsessions
            ):
                out.write(line)
