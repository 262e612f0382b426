"""HDF5 files of named groups of arrays that grow run by run and survive a killed run.

HDF5 alone does not: a file cannot be read if its writer died while it was open. So a run writes groups to hidden part
files, each complete or absent, and joins them to the file at its end. The next run continues with the parts of a
stopped run. The record beside the file has the fingerprint of the sources of each group.

Each group has a checksum, which is verified when the group is read, because a file may be too large to read at every
start. Damaged groups are made again, see `heals`.
"""

import logging
import math
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from functools import wraps
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

import h5py
import numpy as np
import xxhash
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from toolkit.errors import DamagedError, first_line
from toolkit.files import fingerprint, read_sidecar, sidecar_path, write_atomic, write_sidecar
from toolkit.runs.cluster import current_cluster

log = logging.getLogger(__name__)

HDF5_ERRORS = (OSError, RuntimeError, LookupError, ValueError, TypeError, OverflowError)
"""Errors of HDF5 and h5py for files that are torn, of another format, or with content that numpy does not support."""
CHECKSUM = b"xxh3"
"""Attribute of a group: XXH3 of its name and arrays. Files of other tools lack it."""
MOST_BYTES = 1 << 26
"""Memory limit for the arrays of a group, bytes; a larger file may fill as much memory as its own size."""
MOST_TEXTS = 1 << 12
"""Limit of texts in an array."""

PART_GROUPS = 64
PART_SECONDS = 5.0
"""A part is closed after this many groups or seconds, whichever comes first. A killed run loses at most one part."""


@dataclass
class Index:
    """The content of a file or a part."""

    groups: dict[str, str] = field(default_factory=dict)
    """Name of a group -> fingerprint of its sources."""
    failed: dict[str, list[str]] = field(default_factory=dict)
    """Name of a group that could not be made -> fingerprint of its sources, and the reason."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Name of a group -> its note, any JSON."""

    def source_of(self, name: str) -> str | None:
        """Return the fingerprint of the sources of a group that was made or failed; None for any other group."""
        return self.groups[name] if name in self.groups else self.failed.get(name, [None])[0]

    def update(self, later: "Index") -> None:
        """Add the entries of a later index, which replace those of the same names."""
        for name in (*later.groups, *later.failed):
            for entries in (self.groups, self.failed, self.notes):
                entries.pop(name, None)
        self.groups |= later.groups
        self.failed |= later.failed
        self.notes |= later.notes


def read_group(file: h5py.File, name: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a group, from a file of this toolkit or of another tool.

    Reads only numbers and texts that the file itself contains, and not more than fit into it: a malicious file of a few
    bytes could declare huge arrays, or link to other files.

    Raises:
        DamagedError: the group is missing, or its content does not match its checksum.
    """
    # h5py's low-level interface takes half the time, and there are as many groups as pairs of images.
    try:
        group = _open_owned(file.id, name.encode())
        if not isinstance(group, h5py.h5g.GroupID):
            raise ValueError("it is not a group")
        room, arrays = max(MOST_BYTES, file.id.get_filesize()), dict[str, NDArray[Any]]()
        for key in group:
            item = _open_owned(group, key)
            if isinstance(item, h5py.h5d.DatasetID):
                room -= _bytes_of(item)
                if room < 0:
                    raise ValueError(f"{key.decode()} of shape {item.shape} is larger than the file")
                texts = item.dtype.kind == "O"
                arrays[key.decode()] = np.asarray(h5py.Dataset(item)[()], object) if texts else _read(item)
        if h5py.h5a.exists(group, CHECKSUM):
            expected = np.zeros((), np.uint64)
            h5py.h5a.open(group, CHECKSUM).read(expected)
            if int(expected) != group_checksum(name, arrays):
                raise ValueError("its content is not what was written")
    except HDF5_ERRORS as error:
        raise DamagedError(
            Path(file.filename),
            f"{file.filename} is damaged at {name} ({first_line(error)}). If a run made it, run its stage again with "
            "--force: each damaged group is made again.",
        ) from None
    return arrays


def _open_owned(parent: Any, name: bytes) -> Any:
    """Open an object in a file or a group; raise ValueError for links to other groups or files."""
    for prefix in _prefixes(name):
        if parent.links.get_info(prefix).type != h5py.h5l.TYPE_HARD:
            raise ValueError(f"{prefix.decode()} is a link to elsewhere")
    return h5py.h5o.open(parent, name)


def _prefixes(name: bytes) -> Iterator[bytes]:
    """Yield a/b/c as a, a/b, a/b/c."""
    end = name.find(b"/")
    while end >= 0:
        yield name[:end]
        end = name.find(b"/", end + 1)
    yield name


def _bytes_of(item: Any) -> int:
    """Return the memory of an array, bytes; raise ValueError unless it has numbers or texts within the file itself."""
    properties = item.get_create_plist()
    if properties.get_layout() == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise ValueError("its data are in another file")
    dtype, shape = item.dtype, item.shape
    count = math.prod(shape or ())
    if h5py.check_string_dtype(dtype) is not None:
        if count > MOST_TEXTS:
            raise ValueError(f"it has {count} texts in an array; expected at most {MOST_TEXTS}")
    elif shape is None or dtype.kind not in "biuf":
        raise ValueError(f"it has an array of the type {dtype}; expected numbers or texts")
    return int(count * dtype.itemsize)


def _read(item: Any) -> NDArray[Any]:
    array = np.empty(item.shape, item.dtype)
    item.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
    return array


def group_names_of(file: h5py.File, array: str) -> list[str]:
    """Return the names of the groups with an array of this name, in alphabetical order. Links are not followed."""
    names, seen, stack = list[str](), set[Any](), [b""]
    while stack:
        name = stack.pop()
        group = h5py.h5o.open(file.id, name or b"/")
        if name and array.encode() in group:
            names.append(name.decode())
        below = []
        for key in group:
            if group.links.get_info(key).type == h5py.h5l.TYPE_HARD:
                item = h5py.h5o.get_info(group, key)
                if item.type == h5py.h5o.TYPE_GROUP and item.addr not in seen:
                    seen.add(item.addr)
                    below.append(b"%b/%b" % (name, key) if name else key)
        stack += reversed(below)
    return names


def has_group(file: h5py.File, name: str) -> bool:
    """Return whether a file has an object of this name. Links are not followed; a link counts as an object."""
    links = file.id.links
    try:
        for prefix in _prefixes(name.encode()):
            if not links.exists(prefix):
                return False
            if links.get_info(prefix).type != h5py.h5l.TYPE_HARD:
                break
    except HDF5_ERRORS:
        return True  # `read_group` refuses it later, like a link
    return True


def group_checksum(name: str, arrays: Mapping[str, Any]) -> int:
    """Return the XXH3 of a group's name and arrays, 64 bits; texts are hashed as UTF-8."""
    digest = xxhash.xxh3_64(name.encode())
    for key in sorted(arrays):
        array = np.asarray(arrays[key])
        digest.update(f"\0{key}\0{array.dtype.str}{array.shape}".encode())
        if array.dtype.kind == "O":
            texts = (text if isinstance(text, bytes) else str(text).encode() for text in array.ravel())
            digest.update(b"\0".join(texts))
        else:
            digest.update(np.ascontiguousarray(array).data)
    return digest.intdigest()


P = ParamSpec("P")
Result = TypeVar("Result")
Item = TypeVar("Item", bound=tuple[Any, ...])
"""Work for one group: its name, the fingerprint of its sources, and further arguments."""


def heals(stage: Callable[P, Result]) -> Callable[P, Result]:
    """Decorate a stage: if it finds damaged groups in a file that a run made, drop them and call the stage again.

    The stage then makes these groups again and reuses the rest. Each file gets one such attempt.
    """

    @wraps(stage)
    def run(*args: P.args, **kwargs: P.kwargs) -> Result:
        tried = set[Path]()
        while True:
            try:
                return stage(*args, **kwargs)
            except DamagedError as error:
                if error.path in tried or not forget_damaged(error.path):
                    raise
                tried.add(error.path)

    return run


def forget_damaged(path: Path) -> bool:
    """Drop the damaged groups of a file. Return False if no run made the file, so that none can make it again."""
    record = read_sidecar(path)
    if record is None or "made_by" not in record:
        return False
    with GroupWriter(path, record["made_by"]) as writer:
        writer.drop_damaged()
    return True


def sweep(path: Path) -> None:
    """Remove leftover parts beside a finished file: the stage was killed during its `discard`."""
    if _parts_folder(path).exists():
        with GroupWriter(path, {}) as writer:  # waits if another process is rewriting the file
            writer.discard()


def _parts_folder(path: Path) -> Path:
    return path.with_name(f".{path.name}.parts")


def read_index(path: Path, made_by: Mapping[str, Any]) -> Index | None:
    """Return the content of a file; None if it is absent, torn, or made with other settings."""
    record = read_sidecar(path)
    if record is None or fingerprint(record.get("made_by")) != fingerprint(made_by):
        return None
    try:
        with h5py.File(path, "r"):  # HDF5 detects a truncated file
            return Index(record["groups"], record["failed"], record.get("notes", {}))
    except (OSError, KeyError):
        return None


def _is_of_another(path: Path, made_by: Mapping[str, Any]) -> bool:
    """Return whether the file's record has other settings: such a file is replaced without a warning."""
    record = read_sidecar(path)
    return record is not None and fingerprint(record.get("made_by")) != fingerprint(made_by)


class GroupWriter:
    """Context manager that adds groups to a file; the file is complete when `finish` returns.

    Only one process at a time adds to a file; a second one waits, and then continues with what the first has made.
    Processes may read the file meanwhile, because it is replaced, never changed.

    A stage with another kind of result also keeps its progress in groups: it reads them back with `notes` and `read`,
    writes its own file at `path`, and calls `discard` instead of `finish`.

    Workers of a cluster can do shares of the work, see `spread`.
    """

    def __init__(
        self,
        path: Path,
        made_by: Mapping[str, Any],
        attributes: Mapping[str, Any] | None = None,
        share: str | None = None,
    ):
        """Open a file to add groups.

        Args:
            made_by: settings, JSON. Groups made with other settings are dropped.
            attributes: attributes of the HDF5 file, for other readers.
            share: prefix of the names of the parts to write, for a writer that does a share of the work. It does not
                lock the file and sees no other parts. The writer that holds the file finds its parts.
        """
        self.path = path
        self.index: Index
        """Content of the file and the complete parts."""
        self._made_by = made_by
        self._attributes = attributes or {}
        self._folder = _parts_folder(path)
        self._parts: dict[Path, Index] = {}
        self._open: tuple[Path, h5py.File, Index] | None = None
        self._locked, self._writing = ExitStack(), ExitStack()
        self._share = share
        self._whole: Index | None = None
        if share is None:
            self._wait_for_others()
            self._whole = read_index(path, made_by)
            if self._whole is None and path.exists() and not _is_of_another(path, made_by):
                log.warning("%s is torn, or of another version of the toolkit: what it held is made again.", path)
        self._find_parts()
        self._part_closed = time.monotonic()

    def _find_parts(self) -> None:
        self._parts = {}
        for part in sorted(self._folder.glob(f"{self._share or '[!.]'}*.h5")):
            index = read_index(part, self._made_by)
            if index is None:
                part.unlink(missing_ok=True)
                sidecar_path(part).unlink(missing_ok=True)
            else:
                self._parts[part] = index
        self._index_all()

    def left(self, items: Iterable[Item]) -> list[Item]:
        """Return the items whose groups were neither made nor failed from the same sources."""
        return [item for item in items if self.index.source_of(item[0]) != item[1]]

    def spread(
        self,
        function: Callable[..., object],
        items: Sequence[Item],
        arguments: tuple[Any, ...],
        label: str,
        unit: str,
        multiple: int = 1,
        left: Callable[["GroupWriter", Sequence[Item]], list[Item]] | None = None,
    ) -> list[Item]:
        """Let the workers of the cluster, if there is one, do the work, and take over their parts.

        Args:
            function: does a share of the work; called as `function(writer, items, *arguments)` with a writer for the
                share and the items that are not done yet.
            arguments: further arguments of `function`.
            label, unit: of the progress bar.
            multiple: shares have a multiple of this number of items.
            left: returns the items that a writer has not done yet; None: `GroupWriter.left`.

        Returns:
            The items that are left to do in this process.
        """
        left = left or GroupWriter.left
        cluster = current_cluster() if items else None
        if cluster is None:
            return list(items)
        self._close_part()
        generation, shares = self._next_number(), cluster.cut(items, multiple)
        own = self.path, self._made_by, self._attributes
        tasks = [
            ((*own, f"{generation:05d}-{number:05d}-"), share, left, function, arguments)
            for number, share in enumerate(shares)
        ]
        cluster.run(_do_share, tasks, [len(share) for share in shares], label, unit)
        self._find_parts()
        return left(self, items)

    def _next_number(self) -> int:
        # Names of parts are <number> or, in shares, <number>-<share>-<number>. Later parts have higher numbers.
        digits = slice(-5, None) if self._share else slice(5)
        return max((int(path.stem[digits]) for path in self._parts), default=-1) + 1

    def __enter__(self) -> "GroupWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._close_part()  # also after an error, to keep the groups that were added before it
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
        """Write a group, which replaces one of the same name.

        Args:
            made_from: fingerprint of its sources, besides the settings `made_by` of the file.
            attributes: attributes of arrays, by the array's name.
            note: any JSON about the group; `notes` returns it.
        """
        file, index = self._part()
        if name in index.groups:
            del file[name]
        group = file.create_group(name)
        for key, array in (arrays or {}).items():
            group[key] = array
        checksum = h5py.h5a.create(group.id, CHECKSUM, h5py.h5t.NATIVE_UINT64, h5py.h5s.create(h5py.h5s.SCALAR))
        checksum.write(np.array(group_checksum(name, arrays or {}), np.uint64))
        for key, values in (attributes or {}).items():
            group[key].attrs.update(values)
        index.groups[name] = made_from
        if note is not None:
            index.notes[name] = note
        self._close_if_full(index)

    def annotate(self, name: str, note: Any) -> None:
        """Replace the note of an existing group, without changing its arrays."""
        _, index = self._part()
        index.notes[name] = note

    def fail(self, name: str, made_from: str, reason: str) -> None:
        """Record why a group could not be made."""
        _, index = self._part()
        index.failed[name] = [made_from, reason]
        self._close_if_full(index)

    def notes(self) -> dict[str, Any]:
        """Return the notes of all groups, including those of earlier runs, by the group's name."""
        return self.index.notes | (self._open[2].notes if self._open else {})

    def read(self) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        """Yield name and arrays of the groups in the parts, sorted by name."""
        self._close_part()
        part_of = {name: path for path, index in self._parts.items() for name in index.groups}
        for path, names in groupby(sorted(part_of), part_of.__getitem__):
            with h5py.File(path, "r") as file:
                for name in names:
                    yield name, read_group(file, name)

    def finish(self) -> None:
        """Join all parts to the file; without groups, write an empty file."""
        if self._whole is None and not self._parts:
            self._part()
        self._close_part()
        if self._parts:
            try:
                self._join()
            except HDF5_ERRORS:
                if self._whole is not None and self.drop_damaged():
                    raise DamagedError(self.path, f"{self.path} was damaged. Run its stage again.") from None
                raise
        self._remove_parts()

    def drop_damaged(self) -> list[str]:
        """Read all groups of the file, drop the damaged ones, and return their names."""
        if self._whole is None:
            return []
        names = list(self._whole.groups)
        try:
            with h5py.File(self.path, "r") as source:
                damaged = [name for name in names if not _is_whole(source, name)]
        except HDF5_ERRORS:
            damaged = names
        if not damaged:
            return []
        log.warning("%s: %d of %d groups are damaged, first %s; they are made again.",
                    self.path, len(damaged), len(names), damaged[0])  # fmt: skip
        if damaged == names:
            self._whole = None
            for path in (self.path, sidecar_path(self.path)):
                path.unlink(missing_ok=True)
        else:
            for name in damaged:
                del self._whole.groups[name]
                self._whole.notes.pop(name, None)
            with (
                write_atomic(self.path) as temporary,
                h5py.File(temporary, "w", libver="latest") as file,
                h5py.File(self.path, "r") as source,
            ):
                file.attrs.update(source.attrs)
                for name in self._whole.groups:
                    source.copy(name, file, name)
            self._write_record(self._whole)
        self._index_all()
        return damaged

    def _index_all(self) -> None:
        self.index = Index()
        for index in (self._whole, *self._parts.values()):
            if index is not None:
                self.index.update(index)

    def discard(self) -> None:
        """Drop all groups, including those of the file: `finish` then replaces the file by groups added after this."""
        self._close_part()
        self._whole, self._parts, self.index = None, {}, Index()
        self._remove_parts()

    def _remove_parts(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        for torn in self.path.parent.glob(f".{self.path.name}.*.partial{self.path.suffix}"):  # of a killed run
            _remove_quietly(torn)

    def _join(self) -> None:
        joined = Index() if self._whole is None else self._whole
        parts = dict(self._parts)
        if self._whole is None:  # if killed before the new record is written, the old one must not stay with the file
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
        self._write_record(joined)
        self._whole, self.index = joined, joined
        self._parts = {}

    def _write_record(self, index: Index) -> None:
        write_sidecar(self.path, {"made_by": self._made_by, **asdict(index)}, checksums=False)

    def _wait_for_others(self) -> None:
        """Lock the file against other writers until the context ends. The lock of a killed process is released."""
        lock_path = self.path.with_name(f".{self.path.name}.lock")
        lock = FileLock(lock_path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            try:
                lock.acquire(timeout=0)
            except Timeout:
                log.warning("%s: another process adds to it; waiting until it is done.", self.path)
                lock.acquire()
        except OSError:  # a read-only folder: its groups can be reused, and `add` will raise
            return
        self._locked.callback(lock.release)
        self._locked.callback(_remove_quietly, lock_path)  # before the release: a waiting process sees that it is gone

    def _part(self) -> tuple[h5py.File, Index]:
        """Return the part that is being written; create one if there is none."""
        if self._open is None:
            path = self._folder / f"{self._share or ''}{self._next_number():05d}.h5"
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


def _do_share(
    writer_arguments: tuple[Any, ...],
    items: Sequence[Item],
    left: Callable[[GroupWriter, Sequence[Item]], list[Item]],
    function: Callable[..., object],
    arguments: tuple[Any, ...],
) -> None:
    """Do a share of `GroupWriter.spread` on a worker."""
    with GroupWriter(*writer_arguments) as writer:
        function(writer, left(writer, items), *arguments)


def _is_whole(file: h5py.File, name: str) -> bool:
    try:
        read_group(file, name)
    except DamagedError:
        return False
    return True


def _remove_quietly(path: Path) -> None:
    with suppress(OSError):  # some systems do not remove an open file
        path.unlink()
