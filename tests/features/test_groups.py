"""Files of groups: several writers at once, and files that are torn."""

import logging
import signal
import subprocess
import sys
import threading
from pathlib import Path

import h5py
import numpy as np
import pytest

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
