"""HDF5 files of named groups of arrays: the correspondences of a pair, and the layout of hloc.

Files may come from other tools, so what is read is checked: only numbers and texts that the file itself contains, and
not more than fit into it. A group that the toolkit wrote has a checksum, which is verified when the group is read.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xxhash
from numpy.typing import NDArray

from toolkit.errors import DamagedError, first_line
from toolkit.files import write_atomic

HDF5_ERRORS = (OSError, RuntimeError, LookupError, ValueError, TypeError, OverflowError)
"""Errors of HDF5 and h5py for files that are torn, of another format, or with content that numpy does not support."""
CHECKSUM = b"xxh3"
"""Attribute of a group: XXH3 of its name and arrays. Files of other tools lack it."""
MOST_BYTES = 1 << 26
"""Memory limit for the arrays of a group, bytes; a larger file may fill as much memory as its own size."""
MOST_TEXTS = 1 << 12
"""Limit of texts in an array."""


def write_groups(
    path: Path, groups: Iterable[tuple[str, Mapping[str, NDArray[Any]]]], attributes: Mapping[str, Any]
) -> None:
    """Write a file of groups, each given by its name and arrays of numbers or texts; it replaces an earlier file.

    Args:
        attributes: attributes of the file.
    """
    text = h5py.string_dtype()
    with write_atomic(path) as temporary, h5py.File(temporary, "w", libver="latest") as file:
        file.attrs.update(attributes)
        for name, arrays in groups:
            group = file.create_group(name)
            for key, array in arrays.items():
                group[key] = array.astype(text) if array.dtype.kind == "O" else array
            checksum = h5py.h5a.create(group.id, CHECKSUM, h5py.h5t.NATIVE_UINT64, h5py.h5s.create(h5py.h5s.SCALAR))
            checksum.write(np.array(group_checksum(name, arrays), np.uint64))


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
