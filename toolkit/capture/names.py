"""What a capture may name and reach: checked once, where it is read, since its names become paths of outputs.

A name is one or more parts separated by `/`. No part is empty or begins with a dot, so no name leads out of its folder
or hides a file, and there are no control characters. Whatever is read lies, links followed, in the capture or in the
session's folder, which may itself be a link to another disk.
"""

import os
import re
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from toolkit.errors import CaptureError

ALLOW_OUTSIDE = "TOOLKIT_ALLOW_OUTSIDE"
"""Environment variable, `1` where images may lie outside of the capture."""
LINKED_HERE = "proc/links.txt"
"""File of a session that `import` filled with links: the inode of the folder, which an archive cannot know."""
LONGEST = {"capture": 100, "session": 40, "subsession": 200}
"""Bytes of a part: file systems take 255, and names of outputs add theirs."""
HOW_TO_ALLOW = f"allow_outside: true in the manifest (elsewhere {ALLOW_OUTSIDE}=1) permits it"

# C0 and C1 controls, and what breaks or turns a line of Unicode text.
_CONTROL = r"[\x00-\x1f\x7f-\x{9f}\x{200e}\x{200f}\x{2028}-\x{202e}\x{2066}-\x{2069}]"
_PART = r"(^|/)(\.|/|$)"
EXPECTED_NAME = "a name without control characters whose parts between `/` are not empty and do not begin with a dot"


def outside_allowed() -> bool:
    """Tell whether images may lie outside of the capture."""
    return os.environ.get(ALLOW_OUTSIDE) == "1"


@contextmanager
def allow_outside(allowed: bool = True) -> Iterator[None]:
    """Let images lie outside of the capture, in this process and in those that it starts within the context."""
    before = os.environ.get(ALLOW_OUTSIDE)
    if allowed:
        os.environ[ALLOW_OUTSIDE] = "1"
    try:
        yield
    finally:
        if allowed:
            del os.environ[ALLOW_OUTSIDE]
            if before is not None:
                os.environ[ALLOW_OUTSIDE] = before


def bad_names(names: pa.Array, may_leave: bool = False) -> pa.Array:
    """Tell which names are refused; those that `may_leave` may be absolute and have parts that begin with a dot."""
    if _are_plain(names):
        return pa.array(np.zeros(len(names), bool))
    return pc.match_substring_regex(names, f"{_CONTROL}|^$" if may_leave else f"{_CONTROL}|{_PART}")


def _are_plain(names: pa.Array) -> bool:
    """Tell whether all names are surely good, as those of most files are, at a fraction of the time of the pattern."""
    if not len(names):
        return True
    places = np.frombuffer(names.buffers()[1], np.int64)[names.offset : names.offset + len(names) + 1]
    if not np.all(places[1:] > places[:-1]):
        return False
    letters = np.frombuffer(names.buffers()[2], np.uint8)[places[0] : places[-1]]
    if letters.min() < ord(" ") or letters.max() > ord("~"):
        return False
    slash, starts = letters == ord("/"), places[:-1] - places[0]
    opens = slash | (letters == ord("."))  # what no part begins with
    return not (np.any(slash[:-1] & opens[1:]) or np.any(opens[starts]) or np.any(slash[starts - 1]))


def is_bad_name(name: str) -> bool:
    """Tell whether a name is refused; also one that is not Unicode, which has surrogates."""
    broken = re.search("[\ud800-\udfff]", name) is not None
    return broken or bool(bad_names(pa.array([name], pa.large_string()))[0].as_py())


def has_long_part(name: str, kind: str) -> bool:
    """Tell whether a part of a name is longer than names of this kind may be."""
    return max(map(len, os.fsencode(name).split(b"/"))) > LONGEST[kind]


def require_name(name: str, kind: str, place: str | Path) -> None:
    """Refuse the name of a capture, session or subsession that outputs cannot be called by.

    Raises:
        CaptureError: naming `place`.
    """
    if is_bad_name(name) or ("/" in name and kind != "subsession"):
        raise CaptureError(f"{place}: found the {kind} {name!r}, expected {EXPECTED_NAME}. Rename it.")
    if has_long_part(name, kind):
        raise CaptureError(
            f"{place}: the {kind} {name[:40]!r}... has a name of more than {LONGEST[kind]} bytes, too many for the "
            "files that are called after it. Rename it."
        )


def roots_of(session: Path) -> list[Path]:
    """Return the folders, links followed, that the files of a session may lie in: its own and its capture's."""
    session = session.absolute()
    roots = [session]
    if session.parent.name == "sessions":
        roots += [session.parent, session.parent.parent]
    return [root.resolve() for root in roots]


def leads_out(path: Path, roots: Sequence[Path]) -> Path | None:
    """Return where a path leads, links followed, if that is in none of the folders; else None."""
    target = Path(os.path.realpath(path))
    return None if any(target.is_relative_to(root) for root in roots) else target


def links_out(folder: Path, paths: "pd.Series[str]", roots: Sequence[Path]) -> dict[int, Path]:
    """Return the files relative to `folder` that links put out of the `roots`: their places in `paths`, and targets.

    Each folder is resolved and listed once, which takes no look at the single files.
    """
    found: dict[int, Path] = {}
    folder_of = paths.str.replace(r"[^/]*$", "", regex=True)
    for part in folder_of.unique():
        outside = leads_out(folder / part, roots)
        try:
            with os.scandir(folder / part) as entries:
                links = {part + entry.name for entry in entries if outside or entry.is_symlink()}
        except OSError:
            continue
        if links:
            for row in (paths.isin(links) & (folder_of == part)).to_numpy().nonzero()[0].tolist():
                if target := leads_out(folder / paths.iloc[row], roots):
                    found[row] = target
    return dict(sorted(found.items()))


def is_linked_here(session: Path) -> bool:
    """Tell whether `import` has made this folder on this disk, with links to images that the user has named.

    A copy from elsewhere has another inode, whatever it says of itself.
    """
    note = session / LINKED_HERE
    try:  # a pipe would be waited for, a device has no end
        found = note.lstat()
        plain = stat.S_ISREG(found.st_mode) and found.st_size < 32
        return plain and int(note.read_text(encoding="utf-8")) == session.stat().st_ino
    except (OSError, ValueError):
        return False


def note_linked_here(session: Path) -> None:
    """Note in a session's folder that its links are the user's own."""
    (session / LINKED_HERE).write_text(f"{session.stat().st_ino}\n", encoding="utf-8")
