"""HDF5 files of groups: what is written is read, and what other tools write is read with care."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from toolkit.errors import DamagedError
from toolkit.store import hdf5


def test_any_array_comes_back_with_its_checksum(tmp_path: Path) -> None:
    arrays = {
        "empty": np.zeros((0, 2), np.float32), "number": np.array(3), "half": np.ones(3, np.float16),
        "flags": np.array([True, False]), "texts": np.array(["ä", ""], object),
        "strided": np.arange(12).reshape(3, 4)[:, ::2],
    }  # fmt: skip
    path = tmp_path / "file.h5"
    hdf5.write_groups(path, [("a", arrays), ("b/c", {})], {"by": "us"})
    with h5py.File(path) as file:
        assert file.attrs["by"] == "us"
        assert hdf5.read_group(file, "b/c") == {}
        found = hdf5.read_group(file, "a")
    assert found.keys() == arrays.keys()
    assert found["texts"].tolist() == ["ä".encode(), b""]
    for name in arrays.keys() - {"texts"}:
        np.testing.assert_array_equal(found[name], arrays[name])
        assert found[name].dtype == arrays[name].dtype


def test_a_changed_number_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    hdf5.write_groups(path, [(name, {"values": np.arange(3.0)}) for name in "ab"], {})
    with h5py.File(path, "a") as file:
        file["a/values"][1] = 7
        assert hdf5.read_group(file, "b")["values"].tolist() == [0, 1, 2]
        with pytest.raises(DamagedError):
            hdf5.read_group(file, "a")


def external(file: h5py.File) -> None:
    file["a/values"] = h5py.ExternalLink("other.h5", "/secret")


def soft(file: h5py.File) -> None:
    file["secret"] = np.arange(3)
    file["a/values"] = h5py.SoftLink("/secret")


def linked_group(file: h5py.File) -> None:
    file["a"] = h5py.ExternalLink("other.h5", "/")


def external_storage(file: h5py.File) -> None:
    file.create_dataset("a/values", (3,), "u1", external=[("other.h5", 0, 3)])


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((3,), "i8")
    layout[:] = h5py.VirtualSource("other.h5", "secret", (3,))
    file.create_virtual_dataset("a/values", layout)


def huge(file: h5py.File) -> None:
    file.create_dataset("a/values", (1 << 40, 1 << 20), "f4", chunks=(1024, 1024))


def many(file: h5py.File) -> None:
    for number in range(20):
        file.create_dataset(f"a/{number}", (1 << 20,), "f4", chunks=(1024,))


def texts(file: h5py.File) -> None:
    file.create_dataset("a/values", (1 << 20,), h5py.string_dtype())


def compound(file: h5py.File) -> None:
    file["a/values"] = np.zeros(3, [("x", "f4"), ("y", "i8")])


def references(file: h5py.File) -> None:
    file.create_dataset("a/values", data=[file.ref], dtype=h5py.ref_dtype)


def ragged(file: h5py.File) -> None:
    file.create_dataset("a/values", (3,), h5py.vlen_dtype(np.int64))


def nothing(file: h5py.File) -> None:
    file["a/values"] = h5py.Empty("f4")


def array_instead_of_group(file: h5py.File) -> None:
    file["a"] = np.zeros(3)


@pytest.mark.parametrize("make", [
    external, soft, linked_group, external_storage, virtual, huge, many, texts, compound, references, ragged, nothing,
    array_instead_of_group,
])  # fmt: skip
def test_what_a_group_must_not_be_is_refused_by_name(tmp_path: Path, make: Callable[[h5py.File], None]) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["secret"] = np.arange(3)
    with h5py.File(tmp_path / "file.h5", "w", libver="latest") as file:
        make(file)
    with h5py.File(tmp_path / "file.h5") as file:
        assert hdf5.has_group(file, "a")
        with pytest.raises(DamagedError, match=r"file\.h5 is damaged at a "):
            hdf5.read_group(file, "a")


@pytest.mark.slow
def test_names_of_groups_are_found_without_following_links(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "file.h5", "w", libver="latest") as file:
        file["x/y/1.jpg/keypoints"] = np.zeros((3, 2))
        file["x/0.jpg/keypoints"] = np.zeros((3, 2))
        file["x/self"] = file["x"]
        file["out"] = h5py.ExternalLink("other.h5", "/")
        file["/".join(["deep"] * 3000)] = np.zeros(3)
    with h5py.File(tmp_path / "file.h5") as file:
        assert hdf5.group_names_of(file, "keypoints") == ["x/0.jpg", "x/y/1.jpg"]
