"""Folders of items: killed, damaged, full and shared, and what is then read from them."""

import errno
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DamagedError, sentence
from toolkit.files import sidecar_path
from toolkit.store import items as store
from toolkit.store.items import Items, retry_damaged


def add(items: Items, *names: str, source: str = "key") -> None:
    for name in names:
        items.add(name, source, {"values": np.full(3, ord(name[0]), np.float32)}, {"name": name})


def shards(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.shard"))


def damage(path: Path, value: float) -> None:
    """Change one byte of the array that is full of a value; size and time of change stay."""
    stat, data = path.stat(), bytearray(path.read_bytes())
    data[data.index(np.full(3, value, np.float32).tobytes())] ^= 4
    path.write_bytes(data)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_any_array_and_note_comes_back(tmp_path: Path) -> None:
    arrays = {
        "empty": np.zeros((0, 2), np.float32), "number": np.array(3), "half": np.ones(3, np.float16),
        "flags": np.array([True, False]), "texts": np.array(["ä", "\ud800", ""], object), "none": np.zeros(0, object),
        "strided": np.arange(12).reshape(3, 4)[:, ::2], "big": np.arange(3, dtype=">i4"),
    }  # fmt: skip
    note = {"row": [1.5, None, float("inf")], "ä": "ü"}
    with Items(tmp_path / "new" / "folder", {"by": 1}) as items:
        items.add("a\nb/ä", "key", arrays, note)
        items.add("nothing")
    again = Items(tmp_path / "new" / "folder")
    assert (again.made_by, list(again), again.note("a\nb/ä"), again.note("nothing")) == (
        {"by": 1}, ["a\nb/ä", "nothing"], note, None)  # fmt: skip
    assert again["nothing"] == {}
    found = again["a\nb/ä"]
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
        assert found[name].flags.writeable
    with pytest.raises(KeyError):
        again["c"]


def test_a_later_item_counts_and_shards_without_items_go(tmp_path: Path) -> None:
    with Items(tmp_path) as items:
        add(items, "a", "b", source="old")
        items.flush()
        add(items, "a", source="new")
        assert items.left([("a", "new"), ("b", "new"), ("c", "new")]) == [("a", "new"), ("b", "new"), ("c", "new")]
        items.flush()
        assert items.left([("a", "new"), ("b", "new"), ("c", "new")]) == [("b", "new"), ("c", "new")]
    assert len(shards(tmp_path)) == 2
    with Items(tmp_path) as items:
        assert items.source("a") == "new"
        add(items, "b", source="new")
    assert len(shards(tmp_path)) == 2, "the first has no item that counts any more"
    assert Items(tmp_path)["a"]["values"][0] == ord("a")


def test_items_can_all_be_made_again(tmp_path: Path) -> None:
    todo = [("a", "key"), ("b", "key")]
    with Items(tmp_path) as items:
        add(items, "a", "b")
    with Items(tmp_path, skip_existing=False) as items:
        assert items.left(todo) == todo
        add(items, "a")
        items.flush()
        assert items.left(todo) == todo[1:]
        assert items["b"]["values"][0] == ord("b"), "the others are still there"
    assert Items(tmp_path).left(todo) == []


def test_items_of_another_version_are_read_but_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(store, "__version__", "0.0")
        with Items(tmp_path) as items:
            add(items, "a")
    items = Items(tmp_path)
    assert items["a"]["values"][0] == ord("a")
    assert items.left([("a", "key")]) == [("a", "key")]


def test_an_error_keeps_what_was_added_before_it(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), Items(tmp_path) as items:  # noqa: PT012
        add(items, "a")
        1 / 0  # noqa: B018
    assert list(Items(tmp_path)) == ["a"]


@pytest.mark.parametrize(("limit", "kept"), [("SHARD_SECONDS = 0.0", ["a", "b"]), ("SHARD_BYTES = 1", ["a", "b"]),
                                             ("SHARD_SECONDS = 60.0", [])])  # fmt: skip
def test_a_killed_writer_loses_no_more_than_a_shard(tmp_path: Path, limit: str, kept: list[str]) -> None:
    code = f"""if True:
        import os, signal
        from toolkit.store import items
        items.{limit}
        with items.Items({str(tmp_path)!r}) as opened:
            opened.add("a")
            opened.add("b")
            writing = items.write_atomic({str(tmp_path / "000009-0.shard")!r})
            writing.__enter__().write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGKILL)
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    assert len(list(tmp_path.glob(".*.partial*"))) == 1
    with Items(tmp_path) as items:
        assert list(items) == kept
    assert not list(tmp_path.glob(".*")), "what was half written is swept"


def test_two_writers_of_the_same_items_both_end_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "SHARD_SECONDS", 0.0)
    names, errors = [f"{letter}{number}" for number in range(20) for letter in "xyz"], list[BaseException]()

    def work() -> None:
        try:
            with Items(tmp_path, {"by": 1}) as items:
                add(items, *(name for name, _ in items.left([(name, "key") for name in names])))
                assert [items[name]["values"][0] for name in names] == [ord(name[0]) for name in names]
        except BaseException as error:
            errors.append(error)

    writers = [threading.Thread(target=work) for _ in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert not errors
    items = Items(tmp_path)
    assert items.left([(name, "key") for name in names]) == []
    assert sum(len(part) for part in items._shards.values()) >= len(names)
    assert not list(tmp_path.glob(".*"))


def test_writers_in_other_processes_are_no_trouble(tmp_path: Path) -> None:
    code = f"""if True:
        from toolkit.store import items
        import numpy as np
        items.SHARD_SECONDS = 0.0
        with items.Items({str(tmp_path)!r}) as opened:
            for number in range(50):
                opened.add(str(number), "key", {{"values": np.full(100, number)}})
    """
    writers = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(2)]
    assert [writer.wait() for writer in writers] == [0, 0]
    items = Items(tmp_path)
    assert [int(items[str(number)]["values"][99]) for number in range(50)] == list(range(50))


def test_a_reader_follows_items_to_a_later_shard(tmp_path: Path) -> None:
    with Items(tmp_path) as items:
        add(items, "a")
    reader = Items(tmp_path)
    with Items(tmp_path, skip_existing=False) as items:
        add(items, "a", "b")
    assert len(shards(tmp_path)) == 1
    assert reader["a"]["values"][0] == ord("a")


@pytest.mark.parametrize("content", [b"", b"torn", b"\0" * 1000, -1, 0.5])
def test_a_torn_shard_is_named_and_made_again(
    tmp_path: Path, content: bytes | float, caplog: pytest.LogCaptureFixture
) -> None:
    with Items(tmp_path) as items:
        add(items, "a")
    (path,) = shards(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(content if isinstance(content, bytes) else whole[: -1 if content == -1 else len(whole) // 2])
    with caplog.at_level(logging.WARNING), Items(tmp_path) as items:
        assert items.left([("a", "key")]) == [("a", "key")]
        add(items, "a")
    assert str(path) in caplog.text
    assert len(shards(tmp_path)) == 1
    assert Items(tmp_path)["a"]["values"][0] == ord("a")


def test_whatever_byte_changes_no_other_number_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Items(tmp_path) as items:
        add(items, "a", "b")
    (path,) = shards(tmp_path)
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        found = Items(tmp_path)
        for name in found:
            try:
                assert found[name]["values"].tolist() == [ord(name)] * 3
            except DamagedError:
                continue


def test_a_damaged_item_is_noticed_and_made_again_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    made = list[str]()

    @retry_damaged
    def stage() -> dict[str, list[float]]:
        with Items(tmp_path) as items:
            todo = [name for name, _ in items.left([("a", "key"), ("b", "key"), ("c", "key")])]
            add(items, *todo)
            made.extend(todo)
        return {name: items[name]["values"].tolist() for name in ("a", "b", "c")}

    first = stage()
    (path,) = shards(tmp_path)
    damage(path, ord("b"))
    made.clear()
    assert stage() == first
    assert made == ["b"]
    assert f"{path}: 1 of 3 items are damaged, first b" in caplog.text
    made.clear()
    assert stage() == first
    assert made == []


def test_damage_that_comes_back_is_an_error(tmp_path: Path) -> None:
    tries: list[int] = []

    @retry_damaged
    def stage() -> None:
        tries.append(1)
        with Items(tmp_path) as items:
            add(items, *(name for name, _ in items.left([("a", "key"), ("b", "key")])))
        damage(shards(tmp_path)[-1], ord("a"))
        Items(tmp_path)["a"]

    with pytest.raises(DamagedError, match="damaged at a"):
        stage()
    assert len(tries) == 2

    @retry_damaged
    def other() -> None:
        raise DamagedError(tmp_path / "theirs.h5", "theirs.h5")

    with pytest.raises(DamagedError):
        other()


def test_a_full_disk_is_told_with_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = open

    class Full:
        def __init__(self, stream: Any) -> None:
            self.stream = stream

        def __enter__(self) -> "Full":
            return self

        def __exit__(self, *error: object) -> None:
            self.stream.close()

        def writelines(self, parts: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store, "open", lambda *how, **more: Full(opened(*how, **more)), raising=False)
    with pytest.raises(OSError, match="No space") as caught, Items(tmp_path / "f") as items:
        add(items, "a")
    assert sentence(caught.value).startswith(f"The disk is full: {tmp_path / 'f' / '000000-'}")
    assert not list((tmp_path / "f").iterdir())


def test_a_folder_that_cannot_be_written_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Items(tmp_path) as items:
        add(items, "a")

    def refuse(*arguments: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path))

    monkeypatch.setattr(store, "write_atomic", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    with Items(tmp_path) as items:
        assert items.left([("a", "key")]) == []
        assert items["a"]["values"][0] == ord("a")
    with pytest.raises(PermissionError), Items(tmp_path) as items:
        add(items, "b")


def test_kinds_of_arrays_that_are_no_numbers_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in ("|O", "|S3", "|V8", "<M8[s]"):
        packed: Callable[..., bytes] = store._packed

        def other(arrays: Any, kind: str = kind) -> bytes:
            return packed(arrays).replace(b'"<f8"', f'"{kind}"'.encode())  # noqa: B023

        with monkeypatch.context() as patch:
            patch.setattr(store, "_packed", other)
            with Items(tmp_path) as items:
                items.add("a", "key", {"values": np.zeros(3)})
        with pytest.raises(DamagedError):
            Items(tmp_path)["a"]
    assert not sidecar_path(tmp_path).exists()
