"""HDF5 files of named groups of arrays: added to run by run, safe against a kill.

HDF5 itself is not: a file that was open for writing when its writer died cannot be read. So a run writes what it makes
to hidden parts, each of which is complete or absent, and joins them to the file when it ends; the next run takes up the
parts that a stopped run left. The record beside the file tells for each group what it was made from.
"""

import logging
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from toolkit.files import fingerprint, read_sidecar, sidecar_path, write_atomic, write_sidecar

log = logging.getLogger(__name__)

PART_GROUPS = 64
PART_SECONDS = 5.0
"""A part is closed after so many groups or seconds, whichever comes first. A kill costs at most one part."""


@dataclass
class Index:
    """What a file or a part holds."""

    groups: dict[str, str] = field(default_factory=dict)
    """Name of a group -> fingerprint of what it was made from."""
    failed: dict[str, list[str]] = field(default_factory=dict)
    """Name of what could not be made -> the fingerprint of what it should have been made from, and the reason."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Name of a group -> its note, any JSON."""

    def update(self, later: "Index") -> None:
        """Take over what was made later; it replaces what was there."""
        for name in (*later.groups, *later.failed):
            for entries in (self.groups, self.failed, self.notes):
                entries.pop(name, None)
        self.groups |= later.groups
        self.failed |= later.failed
        self.notes |= later.notes


def read_index(path: Path, made_by: Mapping[str, Any]) -> Index | None:
    """Return what a file holds; None if it is absent, torn, or was made by other settings."""
    record = read_sidecar(path)
    if record is None or fingerprint(record.get("made_by")) != fingerprint(made_by):
        return None
    try:
        with h5py.File(path, "r"):  # HDF5 notices a file that is shorter than it was
            return Index(record["groups"], record["failed"], record.get("notes", {}))
    except (OSError, KeyError):
        return None


class GroupWriter:
    """Adds groups to a file; a context, whose work stands when `finish` returns.

    One process at a time adds to a file; another that wants to waits, and then goes on from what is there. Others may
    read it meanwhile: it is replaced, never changed.

    A stage whose result is another kind of file keeps its progress in groups too: it reads them back with `notes` and
    `read`, writes its file at `path` itself, and calls `discard` instead of `finish`.
    """

    def __init__(self, path: Path, made_by: Mapping[str, Any], attributes: Mapping[str, Any] | None = None):
        """Groups made by something else than `made_by`, JSON, are not kept; other readers see the `attributes`."""
        self.path = path
        self.index = Index()
        """What the file and the complete parts hold."""
        self._made_by = made_by
        self._attributes = attributes or {}
        self._folder = path.with_name(f".{path.name}.parts")
        self._parts: dict[Path, Index] = {}
        self._open: tuple[Path, h5py.File, Index] | None = None
        self._locked, self._writing = ExitStack(), ExitStack()
        self._wait_for_others()
        self._whole = read_index(path, made_by)
        if path.exists() and read_sidecar(path) is None:
            log.warning("%s is torn, or of another version of the toolkit: what it held is made again.", path)
        for part in sorted(self._folder.glob("[!.]*.h5")):
            index = read_index(part, made_by)
            if index is None:
                part.unlink(missing_ok=True)
                sidecar_path(part).unlink(missing_ok=True)
            else:
                self._parts[part] = index
        for index in (self._whole, *self._parts.values()):
            if index is not None:
                self.index.update(index)
        self._part_closed = time.monotonic()

    def __enter__(self) -> "GroupWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._close_part()  # also after an error: what was added before it is kept
        finally:
            self._locked.close()

    def add(
        self,
        name: str,
        made_from: str = "",
        arrays: Mapping[str, NDArray[Any]] | None = None,
        attributes: Mapping[str, Mapping[str, Any]] | None = None,
        note: Any = None,
    ) -> None:
        """Write a group; it replaces one of the same name.

        Args:
            made_from: fingerprint of what it was made from, besides what the file was made by.
            attributes: of some of the arrays.
            note: about the group, any JSON; `notes` returns it.
        """
        file, index = self._part()
        if name in index.groups:
            del file[name]
        group = file.create_group(name)
        for key, array in (arrays or {}).items():
            group[key] = array
        for key, values in (attributes or {}).items():
            group[key].attrs.update(values)
        index.groups[name] = made_from
        if note is not None:
            index.notes[name] = note
        self._close_if_full(index)

    def fail(self, name: str, made_from: str, reason: str) -> None:
        """Note why there is no such group."""
        _, index = self._part()
        index.failed[name] = [made_from, reason]
        self._close_if_full(index)

    def notes(self) -> dict[str, Any]:
        """Return the notes of all groups, those of earlier runs first."""
        return self.index.notes | (self._open[2].notes if self._open else {})

    def read(self) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        """Yield name and arrays of the groups that are in parts, in the order in which they were added."""
        self._close_part()
        for path, index in self._parts.items():
            with h5py.File(path, "r") as file:
                for name in index.groups:
                    yield name, {key: array[()] for key, array in file[name].items()}

    def finish(self) -> None:
        """Join all parts to the file; without any group the file is empty."""
        if self._whole is None and not self._parts:
            self._part()
        self._close_part()
        if self._parts:
            self._join()
        self._remove_parts()

    def discard(self) -> None:
        """Forget all groups, also those of the file: `finish` replaces it by what is added from now on."""
        self._close_part()
        self._whole, self._parts, self.index = None, {}, Index()
        self._remove_parts()

    def _remove_parts(self) -> None:
        # With what a killed run was writing, here and beside the file.
        shutil.rmtree(self._folder, ignore_errors=True)
        for torn in self.path.parent.glob(f".{self.path.name}.*.partial{self.path.suffix}"):
            _remove_quietly(torn)

    def _join(self) -> None:
        joined = Index() if self._whole is None else self._whole
        parts = dict(self._parts)
        if self._whole is None:  # a kill before the new record is there must not leave the old one with the new file
            sidecar_path(self.path).unlink(missing_ok=True)
        with write_atomic(self.path) as temporary:
            if self._whole is None:
                first = next(iter(parts))
                joined.update(parts.pop(first))
                shutil.copyfile(first, temporary)
            else:
                shutil.copyfile(self.path, temporary)
            with h5py.File(temporary, "a", libver="latest") as file:
                for part, index in parts.items():
                    joined.update(index)
                    for name in (*index.groups, *index.failed):
                        if name in file:
                            del file[name]
                    with h5py.File(part, "r") as source:
                        for name in index.groups:
                            source.copy(name, file, name)
        write_sidecar(self.path, {"made_by": self._made_by, **asdict(joined)})
        self._whole, self.index = joined, joined
        self._parts = {}

    def _wait_for_others(self) -> None:
        """Hold the file against other writers until the context ends. A killed process holds nothing."""
        place = self.path.with_name(f".{self.path.name}.lock")
        lock = FileLock(place)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            try:
                lock.acquire(timeout=0)
            except Timeout:
                log.warning("%s: another process adds to it; waiting until it is done.", self.path)
                lock.acquire()
        except OSError:  # a folder that is only read: what is there can be reused, and adding says why it cannot
            return
        self._locked.callback(lock.release)
        self._locked.callback(_remove_quietly, place)  # while it is held: who waits for it sees that it is gone

    def _part(self) -> tuple[h5py.File, Index]:
        """Return the part that is being written, a new one where there is none."""
        if self._open is None:
            last = max((int(path.stem) for path in self._parts), default=-1)
            path = self._folder / f"{last + 1:05d}.h5"
            temporary = self._writing.enter_context(write_atomic(path))
            file = self._writing.enter_context(h5py.File(temporary, "w", libver="latest"))
            file.attrs.update(self._attributes)
            self._open = path, file, Index()
        return self._open[1:]

    def _close_if_full(self, index: Index) -> None:
        full = len(index.groups) + len(index.failed) >= PART_GROUPS
        if full or time.monotonic() - self._part_closed >= PART_SECONDS:
            self._close_part()

    def _close_part(self) -> None:
        if self._open is not None:
            path, _, index = self._open
            self._open = None
            self._writing.close()
            write_sidecar(path, {"made_by": self._made_by, **asdict(index)})
            self._parts[path] = index
            self.index.update(index)
            self._part_closed = time.monotonic()


def _remove_quietly(path: Path) -> None:
    with suppress(OSError):  # some systems do not remove an open file
        path.unlink()
