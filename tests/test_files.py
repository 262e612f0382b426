"""Artifacts: whole or absent, and reused only if made from the same things."""

import json
import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from toolkit import files
from toolkit.errors import ArtifactError


def test_a_failing_writer_leaves_the_old_file_and_no_litter(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "poses.txt"
    files.write_text(path, "old")

    def fail() -> None:
        with files.write_atomic(path) as temporary:
            temporary.write_text("half of the n")
            assert path.read_text() == "old"
            raise RuntimeError("disk")

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert list(path.parent.iterdir()) == [path]


def test_a_failing_first_writer_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with files.write_atomic(tmp_path / "map.npz") as temporary:
            temporary.write_bytes(b"PK")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert not list(tmp_path.iterdir())


def test_a_killed_writer_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("old")
    script = (
        "import os, sys; from toolkit.files import write_atomic\n"
        "with write_atomic(sys.argv[1]) as t:\n    t.write_text('new'); os.kill(os.getpid(), 9)"
    )
    repository = Path(files.__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", script, str(path)], cwd=repository, check=False).returncode == -9
    assert path.read_text() == "old"


def test_the_temporary_name_keeps_the_suffix_and_is_hidden(tmp_path: Path) -> None:
    # numpy, cv2 and matplotlib choose the format by the suffix; readers skip hidden files.
    with files.write_atomic(tmp_path / "a.npy") as temporary:
        assert temporary.suffix == ".npy"
        assert temporary.name.startswith(".")
        assert temporary.parent == tmp_path
        np.save(temporary, np.arange(3))
    assert np.load(tmp_path / "a.npy").tolist() == [0, 1, 2]


@pytest.fixture
def umask() -> Iterator[None]:
    old = os.umask(0o027)
    yield
    os.umask(old)


@pytest.mark.usefixtures("umask")
def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    files.write_text(tmp_path / "a", "x")
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_the_umask_of_other_threads_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is the process's: two writers that change it for a moment may leave it at 0."""
    monkeypatch.setattr(os, "umask", lambda mask: pytest.fail("the umask is changed"))
    files.write_text(tmp_path / "a", "x")


def test_fingerprint_is_stable() -> None:
    a = {"x": 1, "y": [1.5, None, "é"], "z": {"p": Path("a/b"), "q": True}}
    b = {"z": {"q": True, "p": Path("a/b")}, "y": [1.5, None, "é"], "x": 1}
    assert files.fingerprint(a) == files.fingerprint(b)
    assert len(files.fingerprint(a)) == 16
    int(files.fingerprint(a), 16)
    assert files.fingerprint({"n": np.int64(3), "f": np.float64(0.1)}) == files.fingerprint({"n": 3, "f": 0.1})
    # It is the same in every process: it must not rest on hash() or on addresses.
    script = "from toolkit.files import fingerprint; print(fingerprint({'b': [1, 'x'], 'a': None}))"
    out = subprocess.run([sys.executable, "-c", script], cwd=Path(files.__file__).parents[1], capture_output=True)
    assert out.stdout.decode().strip() == files.fingerprint({"a": None, "b": [1, "x"]})


@pytest.mark.parametrize(
    "other", [{"a": 2}, {"a": "1"}, {"a": 1.5}, {"a": None}, {"b": 1}, {"a": 1, "b": 1}, {"a": [1]}, {}]
)
def test_fingerprint_tells_different_values_apart(other: dict) -> None:
    assert files.fingerprint(other) != files.fingerprint({"a": 1})


def test_fingerprint_respects_the_order_of_lists_and_refuses_objects() -> None:
    assert files.fingerprint([1, 2]) != files.fingerprint([2, 1])
    with pytest.raises(TypeError):
        files.fingerprint({"a": object()})


def test_file_fingerprint_is_of_the_bytes(tmp_path: Path) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_bytes(b"x" * 3_000_000)
    b.write_bytes(b"x" * 3_000_000)
    os.utime(b, (1, 1))
    assert files.file_fingerprint(a) == files.file_fingerprint(b)
    b.write_bytes(b"x" * 2_999_999 + b"y")
    assert files.file_fingerprint(a) != files.file_fingerprint(b)


def test_files_fingerprint_sees_a_change_a_removal_and_a_swap(tmp_path: Path) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_text("1")
    b.write_text("22")
    first = files.files_fingerprint([a, b])
    assert files.files_fingerprint([a, b]) == first
    assert files.files_fingerprint([b, a]) != first
    os.utime(a, ns=(1, 1))
    changed = files.files_fingerprint([a, b])
    assert changed != first
    b.unlink()
    assert files.files_fingerprint([a, b]) not in (first, changed)


def test_current_only_with_the_same_settings(tmp_path: Path) -> None:
    path, settings = tmp_path / "map.npz", {"seed": 0, "radii": [0.7, 0.35], "inputs": "abc"}
    assert not files.is_current(path, settings)
    path.write_text("x")
    assert not files.is_current(path, settings)  # no record
    files.write_sidecar(path, settings)
    assert files.sidecar_path(path) == tmp_path / "map.npz.meta.json"
    assert files.is_current(path, settings)
    assert files.is_current(path, dict(reversed(settings.items())))
    assert not files.is_current(path, settings | {"seed": 1})
    assert not files.is_current(path, settings | {"more": None})
    path.unlink()
    assert not files.is_current(path, settings)  # a record without its artifact


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"\xff\xfe\x00",
        b"{}",
        *(b"null", b"[]", b'"text"', b"3"),
    ],
)
def test_a_garbage_record_is_not_current(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.npy"
    path.write_text("x")
    files.sidecar_path(path).write_bytes(content)
    assert files.is_current(path, {"a": 1}) is False


def test_a_record_of_another_version_is_not_current(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    path.write_text("x")
    files.write_sidecar(path, {"a": 1})
    record = json.loads(files.sidecar_path(path).read_text())
    assert record["settings"] == {"a": 1}
    files.sidecar_path(path).write_text(json.dumps(record | {"version": "0.0.0"}))
    assert not files.is_current(path, {"a": 1})


def test_an_older_record_without_sources_is_not_called_damaged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.npy"
    path.write_text("x")
    files.write_sidecar(path, {"a": 1})
    record = json.loads(files.sidecar_path(path).read_text())
    older = {key: value for key, value in record.items() if key not in ("made_from", "sources")}
    files.sidecar_path(path).write_text(json.dumps(older))
    assert not files.is_current(path, {"a": 1})
    assert "of an older version" in caplog.text
    assert "damaged" not in caplog.text


def flip(path: Path) -> None:
    """Change one bit; size and time of change stay."""
    data, state = bytearray(path.read_bytes()), path.stat()
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    files._checksum.cache_clear()  # clocks of file systems are coarse


@pytest.mark.parametrize("which", ["a.npy", "a.csv"])
def test_an_artifact_is_current_only_as_it_was_written(
    tmp_path: Path, which: str, caplog: pytest.LogCaptureFixture
) -> None:
    path, table = tmp_path / "a.npy", tmp_path / "a.csv"
    path.write_bytes(b"vectors")
    table.write_text("rows")
    files.write_sidecar(path, {"a": 1}, [table])
    assert files.is_current(path, {"a": 1})
    files.require_whole(path)
    files.require_whole(table, of=path)
    flip(tmp_path / which)
    assert not files.is_current(path, {"a": 1})
    assert f"{tmp_path / which} is damaged (its content" in caplog.text
    with pytest.raises(ArtifactError, match=rf"{which} is damaged.*delete .*a\.npy\.meta\.json"):
        files.require_whole(tmp_path / which, of=path)
    other = path if which == "a.csv" else table
    files.require_whole(other, of=path)
    (tmp_path / which).unlink()
    assert not files.is_current(path, {"a": 1})
    files.sidecar_path(path).unlink()
    files.require_whole(other, of=path)  # another tool's


def test_a_file_is_read_once_for_its_checksum(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"x" * 100)
    files._checksum.cache_clear()
    assert files.checksum(path) == files.checksum(path)
    assert files._checksum.cache_info().misses == 1
    path.write_bytes(b"x" * 101)
    files.checksum(path)
    assert files._checksum.cache_info().misses == 2


def test_what_is_unfinished_is_used_but_not_reused(tmp_path: Path) -> None:
    path = tmp_path / "poses" / "map_a.txt"
    files.write_text(path, "x")
    files.write_sidecar(path, {"a": 1}, unfinished=True)
    files.require_whole(path)
    assert not files.is_current(path, {"a": 1})


@pytest.mark.parametrize("found", [{}, {"../a": [1, None]}, {"a": 3}, ["a"], {"a": ["1", 2]}, {"a": [None, None]}])
def test_a_record_with_other_files_than_its_own_is_damaged(tmp_path: Path, found: object) -> None:
    path = tmp_path / "a"
    path.write_text("x")
    files.write_sidecar(path, {"a": 1})
    record = json.loads(files.sidecar_path(path).read_text()) | {"files": found}
    files.sidecar_path(path).write_text(json.dumps(record))
    assert not files.is_current(path, {"a": 1})


def test_paths_of_a_scene_are_the_contract() -> None:
    scene = files.SceneFiles(Path("runs/demo"), "HYDRO")
    root = Path("runs/demo/HYDRO")
    assert scene.embeddings == root / "embeddings"
    assert scene.retrieval("ios", "hl") == root / "retrieval" / "HYDRO_map_ios_query_hl.jsonl"
    assert scene.poses_txt("spot", "ios") == root / "poses" / "HYDRO_map_spot_query_ios.txt"
    assert scene.poses_csv("spot", "ios") == root / "poses" / "HYDRO_map_spot_query_ios.csv"
    assert (scene.evaluation, scene.visualization) == (root / "evaluation", root / "visualization")


def test_what_killed_writers_left_is_swept_and_nothing_else(tmp_path: Path) -> None:
    script = (
        "import os, sys; from toolkit.files import write_atomic\n"
        "with write_atomic(sys.argv[1]) as t:\n    os.kill(os.getpid(), 9)"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "deep" / "a.txt")]
    subprocess.run(command, cwd=Path(files.__file__).parents[1], check=False)
    assert len(list((tmp_path / "deep").iterdir())) == 1
    with files.write_atomic(tmp_path / "deep" / "b.txt") as temporary:
        (tmp_path / ".mine.partial").touch()
        files.sweep_partials(tmp_path)
        assert temporary.exists()
        assert {path.name for path in tmp_path.rglob("*")} == {"deep", ".mine.partial", temporary.name}


def test_a_killed_writer_of_a_folder_leaves_what_the_next_one_removes(tmp_path: Path) -> None:
    script = (
        "import os, sys; from toolkit.files import write_folder\n"
        "with write_folder(sys.argv[1]) as f:\n    (f / 'a.txt').touch(); os.kill(os.getpid(), 9)"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "model[1]")]
    subprocess.run(command, cwd=Path(files.__file__).parents[1], check=False)
    assert [path.name.startswith(".model[1].") for path in tmp_path.iterdir()] == [True]
    with files.write_folder(tmp_path / "model[1]") as folder:
        (folder / "b.txt").touch()
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == ["model[1]", "model[1]/b.txt"]
