"""The run folder: one run at a time, what killed runs left, and the log."""

import errno
import json
import logging
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from toolkit.errors import ToolkitError
from toolkit.files import is_left_over, process_tag, write_atomic
from toolkit.runs import folder
from toolkit.runs.folder import LOG, counted, counts_text, held, log_to, warnings_of_kernels


@pytest.fixture(scope="module")
def dead() -> int:
    """The id of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_second_run_is_told_who_works_in_the_folder(tmp_path: Path) -> None:
    message = rf"{os.getpid()} on {socket.gethostname()}, since 20"
    with held(tmp_path), pytest.raises(ToolkitError, match=message), held(tmp_path):
        pass
    with held(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == [LOG]


def test_the_lock_of_a_killed_run_is_taken_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = (
        "import os; from pathlib import Path; from toolkit.runs.folder import held\n"
        f"with held(Path({str(tmp_path)!r})): os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", script]).returncode == -9
    killed = json.loads((tmp_path / ".run.lock.json").read_text())["pid"]
    with held(tmp_path):
        assert json.loads((tmp_path / ".run.lock.json").read_text())["pid"] == os.getpid()
    assert f"The run of process {killed} " in (tmp_path / LOG).read_text()


@pytest.mark.parametrize("name", ["ENOLCK", "EOPNOTSUPP", "ENOSYS"])
def test_a_file_system_without_locks_still_has_one_writer(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(file: int, operation: int) -> None:
        raise OSError(getattr(errno, name), os.strerror(getattr(errno, name)))

    monkeypatch.setattr("fcntl.flock", flock)
    with held(tmp_path):
        with pytest.raises(ToolkitError, match=rf"{os.getpid()} on .*delete .*\.run\.lock"), held(tmp_path):
            pass
        assert "has no locks" in (tmp_path / LOG).read_text()
        assert os.environ["HDF5_USE_FILE_LOCKING"] == "FALSE", "HDF5 would fail there, too"
    assert [path.name for path in tmp_path.iterdir()] == [LOG]
    with held(tmp_path):
        (mark,) = [path for path in tmp_path.glob(".run.lock*") if path.suffix != ".json" and path.read_bytes()]
        left = mark.read_text()
    mark.write_text(left.replace(socket.gethostname(), "node17"))  # of a run that was killed on another computer
    with pytest.raises(ToolkitError, match=f"delete {mark}") as error, held(tmp_path):
        pass
    Path(str(error.value).split("delete ")[1].split(": ")[0]).unlink()
    with held(tmp_path):
        pass


def test_what_a_killed_run_left_is_removed_and_what_lives_is_kept(tmp_path: Path, dead: int) -> None:
    machine = process_tag().partition("-")[2]
    left = [f".poses.txt.{dead}-{machine}-abcd1234.partial.txt", ".P_04.partial.ipynb"]
    kept = [f".poses.txt.{process_tag()}-abcd1234.partial.txt", f".x.{dead}-00000000-a.partial", "poses.txt"]
    place = tmp_path / "notebooks"
    place.mkdir(parents=True)
    for name in left + kept:
        (place / name).touch()
    sockets = Path(tempfile.mkdtemp(prefix=f"kernel.{dead}-{machine}-"))
    mine = Path(tempfile.mkdtemp(prefix=f"kernel.{process_tag()}-"))
    (sockets / "s-1").touch()
    (tmp_path / "run.json").write_text('{"status": "running", "name": "a"}')
    try:
        with held(tmp_path):
            record = json.loads((tmp_path / "run.json").read_text())
        assert record["status"] == "interrupted"
        assert "killed" in record["error"]
        assert sorted(path.name for path in place.iterdir()) == sorted(kept)
        assert not sockets.exists()
        assert mine.exists()
    finally:
        mine.rmdir()


def test_temporary_names_tell_whose_they_are(tmp_path: Path) -> None:
    with write_atomic(tmp_path / "a.csv") as temporary:
        assert process_tag() in temporary.name
        assert not is_left_over(temporary.name)
        temporary.touch()


def test_warnings_of_kernels_are_found_once_and_ours_are_not(tmp_path: Path) -> None:
    path = tmp_path / LOG
    with log_to(path):
        logging.getLogger("toolkit.localize").warning("of an earlier stage")
    start = path.stat().st_size
    with log_to(path):
        logging.getLogger("toolkit.localize").warning("camera 1: WARNING toolkit.x: é")
        logging.getLogger("toolkit.localize").info("no warning")
        logging.getLogger("others").warning("not ours")
    assert warnings_of_kernels(path, start) == []
    path.write_text(path.read_text().replace(f" {os.getpid()} ", " 1 ") * 2)
    assert warnings_of_kernels(path, start) == ["camera 1: WARNING toolkit.x: é", "of an earlier stage"]


def test_the_log_has_times_and_debug_messages_and_the_terminal_warnings_alone(tmp_path: Path) -> None:
    script = (
        "import logging; from pathlib import Path; from toolkit.runs.folder import held\n"
        f"with held(Path({str(tmp_path)!r})):\n"
        "    logging.getLogger('toolkit.x').debug('a detail')\n"
        "    logging.getLogger('toolkit.x').warning('take care')\n"
        "    logging.getLogger('else').info('noise')\n"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stderr
    assert shown == "take care\n"
    lines = (tmp_path / LOG).read_text().splitlines()
    assert [line.split(" ", 4)[3:] for line in lines] == [
        ["DEBUG", "toolkit.x: a detail"], ["WARNING", "toolkit.x: take care"]
    ]  # fmt: skip
    assert lines[0].startswith("20")
    assert logging.getLogger("toolkit").level == logging.NOTSET


def test_one_is_singular() -> None:
    assert [counted(n, "pairs of devices") for n in (0, 1, 2)] == [
        "0 pairs of devices", "1 pair of devices", "2 pairs of devices",
    ]  # fmt: skip
    assert counts_text({"query_images": 1, "queries": 1, "ok": 1, "inconsistent_maps": 2}) == (
        "1 query image, 1 query, 1 ok, 2 inconsistent maps"
    )


def test_the_record_names_the_machine_and_the_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = folder.machine()
    assert list(machine) == ["cpu", "cores", "memory_gb", "gpu", "platform"]
    assert all(machine.values())
    assert machine["memory_gb"] > 0.1
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path)]
    source = tmp_path / "toolkit" / "runs" / "folder.py"
    source.parent.mkdir(parents=True)
    source.write_text("")
    monkeypatch.setattr(folder, "__file__", str(source))
    commit = folder.commit.__wrapped__
    assert commit() == "", "no repository"
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        subprocess.run([*git, *command], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout
    assert commit() == head[:12]
    source.write_text("changed")
    assert commit() == f"{head[:12]}-dirty"
