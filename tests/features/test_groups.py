"""Files of groups: several writers at once, and files that are torn."""

import logging
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
    with pytest.raises(ValueError, match="exists"), GroupWriter(path, MADE_BY) as writer:
        add(writer, "a", "a")
    with GroupWriter(path, MADE_BY) as writer:
        assert not writer.index.groups
        add(writer, "b")
        writer.finish()
    assert not list(tmp_path.glob(".*.lock"))


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
