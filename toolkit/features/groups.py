"""HDF5 files of named groups of arrays: added to run by run, safe against a kill.

HDF5 itself is not: a file that was open for writing when its writer died cannot be read. So a run writes what it makes
to hidden parts, each of which is complete or absent, and joins them to the file when it ends; the next run takes up the
parts that a stopped run left. The record beside the file tells for each group what it was made from.

Each group has a checksum, which is verified when the group is read: a file may be too large to be read at every start.
What turns out to be damaged is made again, see `heals`.
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
"""What HDF5 and h5py raise where a file is torn, of another format, or holds what numpy cannot."""
CHECKSUM = b"xxh3"
"""Attribute of a group: XXH3 of its name and its arrays. Files of other tools have none."""
MOST_BYTES = 1 << 26
MOST_TEXTS = 1 << 12
"""Memory for the arrays of a group, bytes: at most this or the size of the file; and texts in an array of them."""

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

    def source_of(self, name: str) -> str | None:
        """Return what a group was made from, or should have been made from; None: it was not tried."""
        return self.groups[name] if name in self.groups else self.failed.get(name, [None])[0]

    def update(self, later: "Index") -> None:
        """Take over what was made later; it replaces what was there."""
        for name in (*later.groups, *later.failed):
            for entries in (self.groups, self.failed, self.notes):
                entries.pop(name, None)
        self.groups |= later.groups
        self.failed |= later.failed
        self.notes |= later.notes


def read_group(file: h5py.File, name: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a group, of this toolkit's files or of another's.

    Memory is taken only for what can be in the file: numbers and texts that it has itself, under its own names. A few
    bytes could ask for more memory than there is, or for the content of other files.

    Raises:
        DamagedError: the file has no such group, or it is not what was written.
    """
    # By h5py's lower layer: the upper one takes twice as long, and there are as many groups as pairs of images.
    try:
        group = _open_owned(file.id, name.encode())
        if not isinstance(group, h5py.h5g.GroupID):
            raise ValueError("it is no group")
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
            "--force: what is damaged is made again.",
        ) from None
    return arrays


def _open_owned(place: Any, name: bytes) -> Any:
    """Return what a file or a group has under a name; refuses links to other places and other files."""
    for prefix in _prefixes(name):
        if place.links.get_info(prefix).type != h5py.h5l.TYPE_HARD:
            raise ValueError(f"{prefix.decode()} is a link to elsewhere")
    return h5py.h5o.open(place, name)


def _prefixes(name: bytes) -> Iterator[bytes]:
    """Yield a/b/c as a, a/b, a/b/c."""
    end = name.find(b"/")
    while end >= 0:
        yield name[:end]
        end = name.find(b"/", end + 1)
    yield name


def _bytes_of(item: Any) -> int:
    """Return the memory that an array of numbers or texts takes; refuses other types, and data that lie elsewhere."""
    made = item.get_create_plist()
    if made.get_layout() == h5py.h5d.VIRTUAL or made.get_external_count():
        raise ValueError("its data are in another file")
    kind, shape = item.dtype, item.shape
    count = math.prod(shape or ())
    if h5py.check_string_dtype(kind) is not None:
        if count > MOST_TEXTS:
            raise ValueError(f"it has {count} texts in an array; expected at most {MOST_TEXTS}")
    elif shape is None or kind.kind not in "biuf":
        raise ValueError(f"it has an array of the type {kind}; expected numbers or texts")
    return int(count * kind.itemsize)


def _read(item: Any) -> NDArray[Any]:
    array = np.empty(item.shape, item.dtype)
    item.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
    return array


def group_names_of(file: h5py.File, array: str) -> list[str]:
    """Return the names of the groups that hold an array of this name, in the order of names; links are not followed."""
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
    """Tell whether a file has something under a name, without following links to elsewhere."""
    links = file.id.links
    try:
        for prefix in _prefixes(name.encode()):
            if not links.exists(prefix):
                return False
            if links.get_info(prefix).type != h5py.h5l.TYPE_HARD:
                break
    except HDF5_ERRORS:
        return True  # refused when it is read, as such a link is
    return True


def group_checksum(name: str, arrays: Mapping[str, Any]) -> int:
    """Return the XXH3 of a group, 64 bits; texts count as their UTF-8."""
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
"""What is to be done for a group: its name, what it is made from, and more."""


def heals(stage: Callable[P, Result]) -> Callable[P, Result]:
    """Make a stage start again where it meets damaged groups of a file that a run made; it goes on where it was.

    The groups are forgotten, so that the stage makes them again, as if they had never been there.
    """

    @wraps(stage)
    def run(*args: P.args, **kwargs: P.kwargs) -> Result:
        met = set[Path]()
        while True:
            try:
                return stage(*args, **kwargs)
            except DamagedError as error:
                if error.path in met or not forget_damaged(error.path):
                    raise
                met.add(error.path)

    return run


def forget_damaged(path: Path) -> bool:
    """Forget the damaged groups of a file; False if no run made it, so that nothing would make them again."""
    record = read_sidecar(path)
    if record is None or "made_by" not in record:
        return False
    with GroupWriter(path, record["made_by"]) as writer:
        writer.drop_damaged()
    return True


def sweep(path: Path) -> None:
    """Remove what progress a stage left beside a file that it had written: it was killed before its `discard` ended."""
    if _parts_folder(path).exists():
        with GroupWriter(path, {}) as writer:  # waits for another process that makes the file again
            writer.discard()


def _parts_folder(path: Path) -> Path:
    return path.with_name(f".{path.name}.parts")


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


def _is_of_another(path: Path, made_by: Mapping[str, Any]) -> bool:
    """Tell whether a file is whole but made by other settings: it is replaced without a word."""
    record = read_sidecar(path)
    return record is not None and fingerprint(record.get("made_by")) != fingerprint(made_by)


class GroupWriter:
    """Adds groups to a file; a context, whose work stands when `finish` returns.

    One process at a time adds to a file; another that wants to waits, and then goes on from what is there. Others may
    read it meanwhile: it is replaced, never changed.

    A stage whose result is another kind of file keeps its progress in groups too: it reads them back with `notes` and
    `read`, writes its file at `path` itself, and calls `discard` instead of `finish`.

    Others may do shares of the work meanwhile: see `spread`.
    """

    def __init__(
        self,
        path: Path,
        made_by: Mapping[str, Any],
        attributes: Mapping[str, Any] | None = None,
        share: str | None = None,
    ):
        """Groups made by something else than `made_by`, JSON, are not kept; other readers see the `attributes`.

        A writer of a `share` writes parts of this name, and knows of no others; one that holds the file takes them.
        """
        self.path = path
        self.index: Index
        """What the file and the complete parts hold."""
        self._made_by = made_by
        self._attributes = attributes or {}
        self._folder = _parts_folder(path)
        self._parts: dict[Path, Index] = {}
        self._open: tuple[Path, h5py.File, Index] | None = None
        self._locked, self._writing = ExitStack(), ExitStack()
        self._share = share
        self._whole: Index | None = None
        if share is None:
            self._hold()
        self._find_parts()
        self._part_closed = time.monotonic()

    def _hold(self) -> None:
        self._wait_for_others()
        self._whole = read_index(self.path, self._made_by)
        if self._whole is None and self.path.exists() and not _is_of_another(self.path, self._made_by):
            log.warning("%s is torn, or of another version of the toolkit: what it held is made again.", self.path)

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
        """Return those of some items that are neither there nor known to fail."""
        return [item for item in items if self.index.source_of(item[0]) != item[1]]

    def spread(
        self,
        function: Callable[..., object],
        items: Sequence[Item],
        others: tuple[Any, ...],
        label: str,
        unit: str,
        multiple: int = 1,
        left: Callable[["GroupWriter", Sequence[Item]], list[Item]] | None = None,
    ) -> list[Item]:
        """Have work done by the workers of the cluster, if there is one, and take what they made.

        Args:
            function: does a share; called with a writer of its own, the items that this lacks, and the `others`.
            items: the work; a share has a `multiple` of them.
            label, unit: of the bar.
            left: returns those of some items that a writer does not hold; None: `GroupWriter.left`.

        Returns:
            The items that are left to do here.
        """
        left = left or GroupWriter.left
        cluster = current_cluster() if items else None
        if cluster is None:
            return list(items)
        self._close_part()
        generation, shares = self._next_number(), cluster.cut(items, multiple)
        own = self.path, self._made_by, self._attributes
        tasks = [
            ((*own, f"{generation:05d}-{number:05d}-"), share, left, function, others)
            for number, share in enumerate(shares)
        ]
        cluster.run(_do_share, tasks, [len(share) for share in shares], label, unit)
        self._find_parts()
        return left(self, items)

    def _next_number(self) -> int:
        # Parts are <number> or, of shares, <number>-<share>-<number>; what was made later comes later.
        digits = slice(-5, None) if self._share else slice(5)
        return max((int(path.stem[digits]) for path in self._parts), default=-1) + 1

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
        checksum = h5py.h5a.create(group.id, CHECKSUM, h5py.h5t.NATIVE_UINT64, h5py.h5s.create(h5py.h5s.SCALAR))
        checksum.write(np.array(group_checksum(name, arrays or {}), np.uint64))
        for key, values in (attributes or {}).items():
            group[key].attrs.update(values)
        index.groups[name] = made_from
        if note is not None:
            index.notes[name] = note
        self._close_if_full(index)

    def annotate(self, name: str, note: Any) -> None:
        """Replace the note of a group that is there, and leave its arrays."""
        _, index = self._part()
        index.notes[name] = note

    def fail(self, name: str, made_from: str, reason: str) -> None:
        """Note why there is no such group."""
        _, index = self._part()
        index.failed[name] = [made_from, reason]
        self._close_if_full(index)

    def notes(self) -> dict[str, Any]:
        """Return the notes of all groups, those of earlier runs first."""
        return self.index.notes | (self._open[2].notes if self._open else {})

    def read(self) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        """Yield name and arrays of the groups that are in parts, in the order of names."""
        self._close_part()
        part_of = {name: path for path, index in self._parts.items() for name in index.groups}
        for path, names in groupby(sorted(part_of), part_of.__getitem__):
            with h5py.File(path, "r") as file:
                for name in names:
                    yield name, read_group(file, name)

    def finish(self) -> None:
        """Join all parts to the file; without any group the file is empty."""
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
        """Read all groups of the file, forget those that are damaged, and return their names."""
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
        self._write_record(joined)
        self._whole, self.index = joined, joined
        self._parts = {}

    def _write_record(self, index: Index) -> None:
        write_sidecar(self.path, {"made_by": self._made_by, **asdict(index)}, checksums=False)

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
    made_with: tuple[Any, ...],
    items: Sequence[Item],
    left: Callable[[GroupWriter, Sequence[Item]], list[Item]],
    function: Callable[..., object],
    others: tuple[Any, ...],
) -> None:
    """Do a share of `GroupWriter.spread`, whose writer is made with these arguments."""
    with GroupWriter(*made_with) as writer:
        function(writer, left(writer, items), *others)


def _is_whole(file: h5py.File, name: str) -> bool:
    try:
        read_group(file, name)
    except DamagedError:
        return False
    return True


def _remove_quietly(path: Path) -> None:
    with suppress(OSError):  # some systems do not remove an open file
        path.unlink()
