"""Folders of items that grow one by one: features of an image, matches of a pair, results of a query, vectors.

An item has a name, the fingerprint of what it was made from, arrays, and a note. Items are written in shards: files
that appear whole (written under a hidden name and renamed) and never change. So a killed run loses the items of the
last seconds only, and any number of processes can write to a folder and read from it at the same time, without locks.
The workers of a cluster are such processes.

The name of a shard is its number and the fingerprint of the names and sources of its items. A later number replaces
items of the same name; processes that make the same items at the same time leave the same content. A shard holds the
items one after another, an index with a checksum of each, and a footer with the checksum of the index.
"""

import json
import logging
import math
import shutil
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
import xxhash
from numpy.typing import NDArray

from toolkit import __version__
from toolkit.errors import DamagedError, first_line
from toolkit.files import fingerprint, sweep_partials, write_atomic
from toolkit.runs.cluster import current_cluster

log = logging.getLogger(__name__)

SHARD_BYTES, SHARD_SECONDS = 1 << 26, 5.0
"""A shard is written at this size or after these seconds, whichever comes first. A killed run loses at most one."""
_FOOTER, _MAGIC = struct.Struct("<QQ8s"), b"tkitems1"
"""Length of the index, its checksum, and the format."""
_BROKEN = (OSError, ValueError, TypeError, KeyError)

P = ParamSpec("P")
Result = TypeVar("Result")
Item = TypeVar("Item", bound=tuple[Any, ...])
"""Work for one item: its name, the fingerprint of its sources, and further arguments."""
Arrays = Mapping[str, NDArray[Any]]


class _Entry(NamedTuple):
    """Where an item is, and what is known of it without reading it."""

    shard: Path
    version: str  # of the toolkit that made it
    source: str
    note: Any
    offset: int
    size: int
    checksum: int

    def read(self, name: str) -> bytes:
        try:
            with open(self.shard, "rb", buffering=0) as stream:
                stream.seek(self.offset)
                data = stream.read(self.size)
            if xxhash.xxh3_64_intdigest(data) != self.checksum:
                raise ValueError("its content is not what was written")
        except _BROKEN as error:
            why = f"{self.shard} is damaged at {name} ({first_line(error)}). Run the stage that makes it again: "
            raise DamagedError(self.shard, why + "each damaged item is made again.") from None
        return data


class Items(Mapping[str, dict[str, NDArray[Any]]]):
    """The items of a folder: mapping from names to arrays, and context manager that adds items.

    Reading is thread-safe; one thread adds items. They can be read when the context ends, or after `flush`.
    """

    def __init__(self, folder: str | Path, made_by: Any = None, skip_existing: bool = True, since: int = 0) -> None:
        """Open a folder, which need not exist.

        Args:
            made_by: settings, JSON, stored with new items; None: those of the items that are there.
            skip_existing: False: make all items again; `left` returns also those that are there.
            since: number of the first shard whose items need not be made again, for a worker.
        """
        self.folder, self.made_by = Path(folder), made_by
        self._shards: dict[Path, dict[str, _Entry]] = {}
        self._entries: dict[str, _Entry] = {}
        self._added: dict[str, tuple[str, Any, bytes]] = {}
        self._bytes, self._written = 0, time.monotonic()
        self.refresh()
        self._since = since if skip_existing else self._next_number()

    def refresh(self) -> None:
        """Find the shards that this and other processes have written since."""
        known, entries = self._shards, dict[str, _Entry]()
        paths = sorted(self.folder.glob("[0-9]*.shard"))
        shards = {path: known[path] if path in known else self._index_of(path) for path in paths}
        for shard in shards.values():
            entries |= shard
        self._shards, self._entries = shards, entries

    def _index_of(self, path: Path) -> dict[str, _Entry]:
        """Return the items of a shard; none, with a warning, if it is torn."""
        try:
            with open(path, "rb") as stream:
                end = stream.seek(-_FOOTER.size, 2)
                length, checksum, magic = _FOOTER.unpack(stream.read())
                stream.seek(end - length)
                data = stream.read(length)
            if magic != _MAGIC or xxhash.xxh3_64_intdigest(data) != checksum:
                raise ValueError("its index is not what was written")
            index = json.loads(data)
            self.made_by = index["made_by"] if self.made_by is None else self.made_by
            return {name: _Entry(path, index["version"], *entry) for name, *entry in index["items"]}
        except _BROKEN as error:
            if path.exists():  # else a later one has replaced it
                log.warning("%s is damaged (%s): what it held is made again.", path, first_line(error))
            return {}

    def __getitem__(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the arrays of an item; raise KeyError if there is none, DamagedError if it has changed."""
        entry = self._entries[name]
        if not entry.shard.exists():  # another process has put it into a later one
            self.refresh()
            later = self._entries.get(name, entry)
            entry = later if later.source == entry.source else entry
        data = entry.read(name)
        try:
            return _unpacked(data)
        except _BROKEN as error:
            raise DamagedError(entry.shard, f"{entry.shard} is damaged at {name} ({first_line(error)}).") from None

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def note(self, name: str) -> Any:
        """Return the note of an item."""
        return self._entries[name].note

    def source(self, name: str) -> str:
        """Return the fingerprint of what an item was made from."""
        return self._entries[name].source

    def is_current(self, name: str, source: str) -> bool:
        """Tell whether an item is there that this version of the toolkit made from these sources."""
        entry = self._entries.get(name)
        return entry is not None and entry[1:3] == (__version__, source) and _number(entry.shard) >= self._since

    def left(self, items: Iterable[Item]) -> list[Item]:
        """Return the items that are not there yet, or were made from other sources."""
        return [item for item in items if not self.is_current(item[0], item[1])]

    def distribute(
        self, function: Callable[..., object], items: Sequence[Item], arguments: tuple[Any, ...], label: str, unit: str,
        multiple: int = 1,
    ) -> list[Item]:  # fmt: skip
        """Let the workers of the cluster, if there is one, make items; return those that are left for this process.

        `function(folder, items, *arguments)` makes the items of a share that are not there yet, in this folder, opened
        by the worker. Shares have a multiple of `multiple` items; `label` and `unit` are of the progress bar.
        """
        cluster = current_cluster() if items else None
        if cluster is None:
            return list(items)
        self.flush()
        shares = cluster.cut(items, multiple)
        tasks = [(self.folder, self.made_by, self._since, share, function, arguments) for share in shares]
        cluster.run(_do_share, tasks, [len(share) for share in shares], label, unit)
        self.refresh()
        return self.left(items)

    def add(self, name: str, source: str = "", arrays: Arrays | None = None, note: Any = None) -> None:
        """Add an item, which replaces one of the same name: arrays of numbers, or of texts as objects.

        `source` is a fingerprint of what it was made from, besides the settings `made_by`; the note, any JSON, is in
        memory while the folder is open.
        """
        data = _packed(arrays or {})
        self._added[name] = source, note, data
        self._bytes += len(data)
        if self._bytes >= SHARD_BYTES or time.monotonic() - self._written >= SHARD_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write the items that were added."""
        if self._added:
            self._write(self._next_number(), __version__, self._added)
            self._added = {}
            self.refresh()
        self._bytes, self._written = 0, time.monotonic()

    def _write(self, number: int, version: str, items: Mapping[str, tuple[str, Any, bytes]]) -> None:
        index, offset = [], 0
        for name, (source, note, data) in items.items():
            index.append([name, source, note, offset, len(data), xxhash.xxh3_64_intdigest(data)])
            offset += len(data)
        content = {"version": version, "made_by": self.made_by, "items": index}
        encoded = json.dumps(content, separators=(",", ":")).encode()
        path = self.folder / f"{number:06d}-{fingerprint([entry[:2] for entry in index])}.shard"
        self._shards.pop(path, None)
        try:
            with write_atomic(path) as temporary, open(temporary, "wb") as stream:
                stream.writelines([*(data for _, _, data in items.values()), encoded])
                stream.write(_FOOTER.pack(len(encoded), xxhash.xxh3_64_intdigest(encoded), _MAGIC))
        except OSError as error:  # of a full disk, which names no file
            raise OSError(error.errno, error.strerror, error.filename or str(path)) from None

    def _next_number(self) -> int:
        return max(map(_number, self._shards), default=-1) + 1

    def __enter__(self) -> "Items":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.flush()  # also after an error, to keep what was added before it
        if kind is None:
            with suppress(OSError):  # a read-only folder
                for path in self._shards.keys() - {entry.shard for entry in self._entries.values()}:
                    path.unlink(missing_ok=True)
                sweep_partials(self.folder)

    def drop_damaged(self) -> bool:
        """Read all items, drop the damaged ones, and tell whether there were any; a warning names the first."""
        found = False
        for path, entries in list(self._shards.items()):
            whole, damaged = dict[str, tuple[str, Any, bytes]](), list[str]()
            for name, entry in entries.items():
                try:
                    whole[name] = entry.source, entry.note, entry.read(name)
                except DamagedError:
                    damaged.append(name)
            if damaged:
                log.warning("%s: %d of %d items are damaged, first %s; they are made again.",
                            path, len(damaged), len(entries), damaged[0])  # fmt: skip
                if whole:
                    self._write(_number(path), entries[damaged[0]].version, whole)
                path.unlink(missing_ok=True)
                found = True
        self.refresh()
        return found


def items_beside(path: Path) -> Path:
    """Return the hidden folder of the items that a file is written from, when all are there."""
    return path.with_name(f".{path.name}.items")


def remove_items(path: Path) -> None:
    """Remove the items that a finished file was written from."""
    shutil.rmtree(items_beside(path), ignore_errors=True)


def retry_damaged(stage: Callable[P, Result]) -> Callable[P, Result]:
    """Decorate a stage: if it finds damaged items, drop them and call it again, which makes them; once a folder."""

    @wraps(stage)
    def run(*args: P.args, **kwargs: P.kwargs) -> Result:
        tried = set[Path]()
        while True:
            try:
                return stage(*args, **kwargs)
            except DamagedError as error:
                folder = error.path.parent
                if error.path.suffix != ".shard" or folder in tried or not Items(folder).drop_damaged():
                    raise
                tried.add(folder)

    return run


def _do_share(folder: Path, made_by: Any, since: int, items: Sequence[Item], function: Callable[..., object],
              arguments: tuple[Any, ...]) -> None:  # fmt: skip
    """Do a share of `Items.distribute` on a worker."""
    with Items(folder, made_by, since=since) as opened:
        function(opened, opened.left(items), *arguments)


def _number(shard: Path) -> int:
    return int(shard.name.partition("-")[0])


def _packed(arrays: Arrays) -> bytes:
    """Return arrays as bytes: the length of a header, the header (name, type and shape of each), and their content."""
    header, content = [], []
    for key, array in arrays.items():
        texts = array.dtype.kind == "O"
        content.append(json.dumps(array.tolist()).encode() if texts else array.tobytes())
        header.append([key, "" if texts else array.dtype.str, array.shape, len(content[-1])])
    encoded = json.dumps(header, separators=(",", ":")).encode()
    return b"".join([len(encoded).to_bytes(4, "little"), encoded, *content])


def _unpacked(data: bytes) -> dict[str, NDArray[Any]]:
    start = 4 + int.from_bytes(data[:4], "little")
    arrays: dict[str, NDArray[Any]] = {}
    for key, kind, shape, length in json.loads(data[4:start]):
        if not kind:
            array = np.array(json.loads(data[start : start + length]), object)
        elif np.dtype(kind).kind in "biuf":
            array = np.frombuffer(data, kind, math.prod(shape), start)
        else:
            raise ValueError(f"{key} is of the type {kind}; expected numbers or texts")
        arrays[key] = array.reshape(shape).copy()  # writable, and without the other arrays of the item
        start += length
    return arrays
