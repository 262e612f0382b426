"""HDF5 files of named groups of arrays: the correspondences of a pair, and the layout of hloc.

Files may come from other tools, so what is read is checked: only numbers and texts that the file itself contains, and
not more than fit into it. A group that the toolkit wrote has a checksum, which is verified when the group is read.
"""

import math
import re
from collections.abc import Iterable, Mapping
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
CHECKSUM = "xxh3"
"""Attribute of a group: XXH3 of its name and arrays. Files of other tools lack it."""
MAX_BYTES = 1 << 26
"""Memory limit for the arrays of a group, bytes; a larger file may fill as much memory as its own size."""
MAX_TEXTS = 1 << 12
"""Limit of texts in an array."""


def write_groups(
    path: Path, groups: Iterable[tuple[str, Mapping[str, NDArray[Any]]]], attributes: Mapping[str, Any]
) -> None:
    """Write, or replace, a file of groups, by name and arrays of numbers or texts, with `attributes`."""
    text = h5py.string_dtype()
    with write_atomic(path) as temporary, h5py.File(temporary, "w", libver="latest") as file:
        file.attrs.update(attributes)
        for name, arrays in groups:
            group = file.create_group(name)
            for key, array in arrays.items():
                group[key] = array.astype(text) if array.dtype.kind == "O" else array
            group.attrs[CHECKSUM] = np.uint64(group_checksum(name, arrays))


def read_group(file: h5py.File, name: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a group, from a file of this toolkit or of another tool; raise DamagedError if they are not
    whole.

    Reads only numbers and texts that the file itself contains, and not more than fit into it: a malicious file of a few
    bytes could declare huge arrays, or link to other files.
    """
    try:
        group = _open_owned(file, name)
        if not isinstance(group, h5py.Group):
            raise ValueError("it is not a group")
        room, arrays = max(MAX_BYTES, file.id.get_filesize()), dict[str, NDArray[Any]]()
        for key in group:
            item = _open_owned(group, key)
            if isinstance(item, h5py.Dataset):
                room -= _bytes_of(item)
                if room < 0:
                    raise ValueError(f"{key} of shape {item.shape} is larger than the file")
                arrays[key] = np.asarray(item[()])
        expected = group.attrs.get(CHECKSUM)
        if expected is not None and int(expected) != group_checksum(name, arrays):
            raise ValueError("its content is not what was written")
    except HDF5_ERRORS as error:
        text = f"{file.filename} is damaged at {name} ({first_line(error)}). If a run made it, run its stage again with"
        raise DamagedError(Path(file.filename), f"{text} --force: each damaged group is made again.") from None
    return arrays


def _open_owned(parent: h5py.Group, name: str) -> Any:
    """Open an object in a file or a group; raise KeyError if it is missing, ValueError for links to elsewhere."""
    for end in [match.start() for match in re.finditer("/", name)] + [len(name)]:
        if not parent.id.links.exists(name[:end].encode()):
            raise KeyError(f"{name[:end]} is missing")
        if parent.id.links.get_info(name[:end].encode()).type != h5py.h5l.TYPE_HARD:
            raise ValueError(f"{name[:end]} is a link to elsewhere")
    return parent[name]


def _bytes_of(item: h5py.Dataset) -> int:
    """Return the memory of an array, bytes; raise ValueError unless it has numbers or texts within the file itself."""
    if item.is_virtual or item.external:
        raise ValueError("its data are in another file")
    count = math.prod(item.shape or ())
    if h5py.check_string_dtype(item.dtype) is not None:
        if count > MAX_TEXTS:
            raise ValueError(f"it has {count} texts in an array; expected at most {MAX_TEXTS}")
    elif item.shape is None or item.dtype.kind not in "biuf":
        raise ValueError(f"it has an array of the type {item.dtype}; expected numbers or texts")
    return int(count * item.dtype.itemsize)


def group_names_of(file: h5py.File, array: str) -> list[str]:
    """Return the names of the groups with an array of this name, in alphabetical order. Links are not followed."""
    names = list[str]()
    file.visit(names.append)
    return [name.removesuffix(f"/{array}") for name in names if name.endswith(f"/{array}")]


def has_group(file: h5py.File, name: str) -> bool:
    """Tell whether a file has an object of this name. A link counts as an object; it is not followed."""
    try:
        _open_owned(file, name)
    except KeyError:
        return False
    except HDF5_ERRORS:
        return True  # `read_group` refuses it later
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
