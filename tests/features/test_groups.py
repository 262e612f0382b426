"""Files of groups: several writers at once, and files that are torn."""

import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from toolkit.errors import DamagedError
from toolkit.features import groups
from toolkit.features.groups import GroupWriter, read_index

MADE_BY = {"name": "test"}


def add(writer: GroupWriter, *names: str) -> None:
    for name in names:
        writer.add(name, "key", {"values": np.arange(3)})


def test_a_second_writer_waits_and_goes_on_from_what_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(groups, "PART_GROUPS", 2)
    path = tmp_path / "new" / "file.h5"
    opened, known = threading.Event(), dict[str, str]()

    def second() -> None:
        with GroupWriter(path, MADE_BY) as writer:
            opened.set()
            known.update(writer.index.groups)
            add(writer, "d")
            writer.finish()

    with GroupWriter(path, MADE_BY) as writer:
        add(writer, "a", "b")  # a part that another could take for one that a killed run has left
        other = threading.Thread(target=second)
        other.start()
        assert not opened.wait(0.5)
        add(writer, "c")
        writer.finish()
    other.join()
    assert known.keys() == {"a", "b", "c"}
    index = read_index(path, MADE_BY)
    assert index is not None
    assert index.groups.keys() == {"a", "b", "c", "d"}
    assert "another process" in caplog.text
    assert not list(path.parent.glob(".*"))


def test_a_writer_that_fails_lets_the_next_one_in(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    with pytest.raises(ZeroDivisionError), GroupWriter(path, MADE_BY) as writer:  # noqa: PT012
        add(writer, "a")
        1 / 0  # noqa: B018
    with GroupWriter(path, MADE_BY) as writer:
        assert writer.index.groups.keys() == {"a"}, "what was added before the error is kept"
        add(writer, "b")
        writer.finish()
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("apart", [False, True])
def test_a_group_replaces_the_one_that_had_its_name(
    tmp_path: Path, apart: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if apart:
        monkeypatch.setattr(groups, "PART_GROUPS", 1)
    path = tmp_path / "file.h5"
    with GroupWriter(path, MADE_BY) as writer:
        for value in (1.0, 2.0):
            writer.add("a", arrays={"x": np.array([value])}, note=value)
            writer.add("b", arrays={"x": np.array([0.0])})
        assert writer.notes()["a"] == 2.0
        writer.finish()
    with h5py.File(path, "r") as file:
        assert file["a/x"][()].tolist() == [2.0]
        assert set(file) == {"a", "b"}


def test_what_a_killed_writer_was_writing_does_not_stop_the_next_one(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    torn = tmp_path / ".file.h5.parts" / ".00000.h5.abc.partial.h5"
    for names in (["a"], ["b"], []):
        torn.parent.mkdir()
        torn.write_bytes(b"torn")
        (tmp_path / ".file.h5.abc.partial.h5").write_bytes(b"torn")
        with GroupWriter(path, MADE_BY) as writer:
            add(writer, *names)
            writer.finish()
        assert not list(tmp_path.glob(".*"))
    index = read_index(path, MADE_BY)
    assert index is not None
    assert index.groups.keys() == {"a", "b"}


@pytest.mark.parametrize("size", [0, 1000])
def test_a_torn_file_is_made_again_and_says_so(tmp_path: Path, size: int, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "file.h5"
    with GroupWriter(path, MADE_BY) as writer:
        add(writer, "a")
        writer.finish()
    with path.open("r+b") as stream:
        stream.truncate(size)
    with caplog.at_level(logging.WARNING), GroupWriter(path, MADE_BY) as writer:
        assert not writer.index.groups
        add(writer, "a")
        writer.finish()
    assert f"{path} is torn" in caplog.text
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["a/values"], [0, 1, 2])


def test_notes_and_arrays_outlive_the_writer_and_are_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(groups, "PART_GROUPS", 2)
    path = tmp_path / "file.h5"
    rows = {name: {"name": name, "value": [1.5, None, float("inf")]} for name in "abcde"}
    with GroupWriter(path, MADE_BY) as writer:  # ends without `finish`, as a stopped run does
        for name in "abc":
            writer.add(name, "key", {"values": np.full(2, ord(name))}, note=rows[name])
        assert writer.notes() == {name: rows[name] for name in "abc"}
    with GroupWriter(path, MADE_BY) as writer:
        assert writer.notes() == {name: rows[name] for name in "abc"}
        for name in "de":
            writer.add(name, "key", {"values": np.full(2, ord(name))}, note=rows[name])
        assert {name: arrays["values"].tolist() for name, arrays in writer.read()} == {n: [ord(n)] * 2 for n in "abcde"}
        writer.finish()
        assert writer.notes() == rows
    with GroupWriter(path, MADE_BY) as writer:
        assert writer.notes() == rows
        add(writer, "b")
        writer.fail("c", "key", "no such thing")
        writer.finish()
        assert writer.notes().keys() == {"a", "d", "e"}, "what replaces a group replaces its note"


@pytest.mark.parametrize(("seconds", "kept"), [(0.0, {"a", "b"}), (60.0, set())])
def test_slow_groups_outlive_a_kill_one_by_one(tmp_path: Path, seconds: float, kept: set[str]) -> None:
    path = tmp_path / "file.h5"
    code = f"""if True:
        import os, pathlib, signal
        from toolkit.features import groups
        groups.PART_SECONDS = {seconds}
        with groups.GroupWriter(pathlib.Path({str(path)!r}), {MADE_BY}) as writer:
            writer.add("a", note=1)
            writer.add("b", note=2)
            os.kill(os.getpid(), signal.SIGKILL)
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    with GroupWriter(path, MADE_BY) as writer:
        assert writer.notes().keys() == kept


@pytest.mark.parametrize("finished", [True, False])
def test_discarded_groups_are_in_no_file(tmp_path: Path, finished: bool) -> None:
    path = tmp_path / "file.h5"
    with GroupWriter(path, MADE_BY) as writer:
        add(writer, "a")
        if finished:
            writer.finish()
        add(writer, "b")
        writer.discard()
        assert not writer.index.groups
        add(writer, "c")
        writer.finish()
    with h5py.File(path) as file:
        assert list(file) == ["c"]
    assert not list(tmp_path.glob(".*"))


def test_groups_made_by_something_else_are_replaced_without_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "file.h5"
    for made_by in (MADE_BY, {"name": "other"}):
        with GroupWriter(path, made_by, {"by": made_by["name"]}) as writer:
            assert not writer.index.groups
            writer.finish()
        with h5py.File(path) as file:
            assert (list(file), file.attrs["by"]) == ([], made_by["name"]), "a file without groups is a file"
    assert not caplog.text


def damage(path: Path, name: str) -> None:
    """Change one byte of an array; size and time of change stay."""
    stat = path.stat()
    with h5py.File(path) as file:
        place = file[name].id.get_offset()
    with path.open("r+b") as stream:
        stream.seek(place)
        byte = stream.read(1)[0]
        stream.seek(place)
        stream.write(bytes([byte ^ 4]))
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_a_damaged_group_is_noticed_and_made_again_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, made = tmp_path / "file.h5", list[str]()

    @groups.heals
    def stage() -> dict[str, list[float]]:
        with GroupWriter(path, MADE_BY, {"by": "us"}) as writer:
            todo = [name for name in ("a/x", "a/y", "b") if name not in writer.notes()]
            for name in todo:
                writer.add(name, arrays={"values": np.arange(3.0)}, note=name)
            made.extend(todo)
            writer.finish()
        with h5py.File(path) as file:
            return {name: groups.read_group(file, name)["values"].tolist() for name in ("a/x", "a/y", "b")}

    first = stage()
    damage(path, "a/y/values")
    made.clear()
    assert stage() == first
    assert made == ["a/y"]
    assert f"{path}: 1 of 3 groups are damaged, first a/y" in caplog.text
    with h5py.File(path) as file:
        assert file.attrs["by"] == "us"
    made.clear()
    assert stage() == first
    assert made == []


def test_damage_that_comes_back_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    with GroupWriter(path, MADE_BY) as writer:
        add(writer, "a", "b")
        writer.finish()

    tries: list[Path] = []

    @groups.heals
    def stage() -> None:
        tries.append(path)
        with h5py.File(path) as file:
            groups.read_group(file, "a")

    damage(path, "a/values")
    with pytest.raises(DamagedError, match="damaged at a"):  # forgotten, and not made again
        stage()
    assert len(tries) == 2
    with h5py.File(tmp_path / "theirs.h5", "w") as file:
        file["a"] = 1
    path = tmp_path / "theirs.h5"
    with pytest.raises(DamagedError, match=r"theirs\.h5"):
        stage()
    assert path.exists(), "no run made it, so no run touches it"


def test_any_array_comes_back_with_its_checksum(tmp_path: Path) -> None:
    arrays = {
        "empty": np.zeros((0, 2), np.float32), "number": np.array(3), "half": np.ones(3, np.float16),
        "flags": np.array([True, False]), "texts": np.array(["ä", ""], object).astype(h5py.string_dtype()),
        "strided": np.arange(12).reshape(3, 4)[:, ::2],
    }  # fmt: skip
    path = tmp_path / "file.h5"
    with GroupWriter(path, MADE_BY) as writer:
        writer.add("a", arrays=arrays)
        writer.finish()
    with h5py.File(path) as file:
        found = groups.read_group(file, "a")
    assert found.keys() == arrays.keys()
    assert found["texts"].tolist() == ["ä".encode(), b""]
    for name in arrays.keys() - {"texts"}:
        np.testing.assert_array_equal(found[name], arrays[name])
        assert found[name].dtype == arrays[name].dtype


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
        assert groups.has_group(file, "a")
        with pytest.raises(DamagedError, match=r"file\.h5 is damaged at a "):
            groups.read_group(file, "a")


@pytest.mark.slow
def test_names_of_groups_are_found_without_following_links(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "file.h5", "w", libver="latest") as file:
        file["x/y/1.jpg/keypoints"] = np.zeros((3, 2))
        file["x/0.jpg/keypoints"] = np.zeros((3, 2))
        file["x/self"] = file["x"]
        file["out"] = h5py.ExternalLink("other.h5", "/")
        file["/".join(["deep"] * 3000)] = np.zeros(3)
    with h5py.File(tmp_path / "file.h5") as file:
        assert groups.group_names_of(file, "keypoints") == ["x/0.jpg", "x/y/1.jpg"]
