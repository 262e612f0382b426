"""A matrix written row by row: whole or not at all, and gone on with after a kill."""

from pathlib import Path

import numpy as np
import pytest

from toolkit.embedders.matrix import MatrixWriter
from toolkit.errors import ArtifactError

RECORD = {"model": "x"}


def rows(start: int, stop: int) -> np.ndarray:
    return np.arange(3 * start, 3 * stop, dtype=np.float32).reshape(-1, 3)


def write(path: Path, batches: list[tuple[int, int]], finish: bool = True, **options: object) -> MatrixWriter:
    with MatrixWriter(path, 3, "float32", options.pop("record", RECORD), **options) as writer:  # type: ignore[arg-type]
        for start, stop in batches:
            writer.append(rows(start, stop), {"upto": stop})
        if finish:
            writer.finish()
    return writer


@pytest.mark.parametrize("dtype", ["float32", "float16"])
@pytest.mark.parametrize("count", [0, 1, 12, 10_001])
def test_the_file_is_what_numpy_writes(tmp_path: Path, dtype: str, count: int) -> None:
    with MatrixWriter(tmp_path / "a.npy", 3, dtype, RECORD) as writer:
        for start in range(0, count, 5_000):
            writer.append(rows(start, min(start + 5_000, count)))
        writer.finish()
    np.save(tmp_path / "b.npy", rows(0, count).astype(dtype))
    assert (tmp_path / "a.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npy", "b.npy"]


def test_a_killed_writer_is_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "m.npy"
    write(path, [(0, 4), (4, 8)], finish=False)
    assert not path.exists()
    with MatrixWriter(path, 3, "float32", RECORD) as writer:
        assert (writer.count, writer.notes) == (8, [{"upto": 4}, {"upto": 8}])
        writer.append(rows(8, 9))
        writer.finish()
    np.testing.assert_array_equal(np.load(path), rows(0, 9))


@pytest.mark.parametrize("lost", ["half a line", "a line", "rows", "all rows", "the lines"])
def test_what_a_kill_may_tear(tmp_path: Path, lost: str) -> None:
    path = tmp_path / "m.npy"
    write(path, [(0, 4), (4, 8)], finish=False)
    data, lines = tmp_path / ".m.npy.partial", tmp_path / ".m.npy.partial.jsonl"
    if lost == "half a line":
        lines.write_text(lines.read_text()[:-5])
    elif lost == "a line":
        lines.write_text("".join(lines.read_text().splitlines(keepends=True)[:-1]))
    elif lost == "rows":
        data.write_bytes(data.read_bytes()[:-5])
    elif lost == "all rows":
        data.unlink()
    else:
        lines.unlink()
    kept = 0 if lost in ("all rows", "the lines") else 4
    with MatrixWriter(path, 3, "float32", RECORD) as writer:
        assert writer.count == kept
        assert writer.notes == ([{"upto": 4}] if kept else [])
        writer.append(rows(kept, 9))
        writer.finish()
    np.testing.assert_array_equal(np.load(path), rows(0, 9))


@pytest.mark.parametrize("change", [{"record": {"model": "y"}}, {"resume": False}])
def test_rows_made_from_something_else_are_dropped(tmp_path: Path, change: dict[str, object]) -> None:
    write(tmp_path / "m.npy", [(50, 54)], finish=False)
    writer = write(tmp_path / "m.npy", [(0, 2)], **change)
    assert writer.notes == []
    np.testing.assert_array_equal(np.load(tmp_path / "m.npy"), rows(0, 2))


def test_the_former_matrix_stands_until_the_end(tmp_path: Path) -> None:
    write(tmp_path / "m.npy", [(0, 2)])
    write(tmp_path / "m.npy", [(5, 9)], finish=False)
    np.testing.assert_array_equal(np.load(tmp_path / "m.npy"), rows(0, 2))


def test_rows_of_another_length(tmp_path: Path) -> None:
    writer = MatrixWriter(tmp_path / "m.npy", 4, "float32", RECORD)
    with writer, pytest.raises(ValueError, match=r"\(2, 3\); expected \(B, 4\)"):
        writer.append(rows(0, 2))


def test_two_writers_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "m.npy"
    with MatrixWriter(path, 3, "float32", RECORD) as first:
        first.append(rows(0, 2))
        for record in (RECORD, {"model": "y"}):
            with pytest.raises(ArtifactError, match=r"m\.npy is being written by another process"):
                MatrixWriter(path, 3, "float32", record)
        first.append(rows(2, 4))
        first.finish()
    np.testing.assert_array_equal(np.load(path), rows(0, 4))
    assert write(path, [(0, 1)]).count == 1, "the lock is gone"
