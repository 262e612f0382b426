"""How a run ends when something is wrong: the state in `run.json`, one sentence, the exit code, nothing left behind."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from tests.test_pipeline import execute_here, place, write_notebook
from toolkit import __main__, notebook, pipeline
from toolkit.errors import (
    OF_THE_DATA,
    CaptureError,
    ManifestError,
    StageError,
    ToolkitError,
    exit_code,
    sentence,
    shortage,
)
from toolkit.manifest import STAGES
from toolkit.runs.folder import LOG, RunLog, held

__all__ = ["place"]

PARAMETERS = 'out_jsonl = None\ntopk = 10\nmap_device = "all"\nquery_device = "all"\nsettings = {}'


def quiet(*args: object, **options: object) -> None:
    """Say nothing."""


def record_of(place: Path) -> dict[str, Any]:
    return dict(json.loads((place / "runs/run/run.json").read_text()))


@pytest.fixture
def here(place: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The place, its notebooks executed in this process."""

    def execute(*args: Any, **options: Any) -> Any:
        try:
            return execute_here(*args, **options)
        except OF_THE_DATA as error:
            raise StageError(str(error), of_the_data=True) from error

    monkeypatch.setattr(pipeline, "execute", execute)
    return place


@pytest.fixture
def command(place: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """The command line in this process: takes arguments, returns the exit code."""

    def run(*arguments: str) -> int:
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["toolkit", *arguments])
            with pytest.raises(SystemExit) as end:
                __main__.main()
        return int(end.value.code or 0)

    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    monkeypatch.chdir(place)
    yield run
    for number, handler in before.items():
        signal.signal(number, handler)


def raising(error: BaseException) -> Callable[..., Any]:
    def execute(*args: object, **options: object) -> Any:
        raise error

    return execute


@pytest.mark.parametrize(
    ("error", "status", "code", "text"),
    [
        (KeyError("dragon"), "failed", 3, "KeyError: 'dragon'"),
        (MemoryError("Unable to allocate 9 GiB"), "failed", 1, "Out of memory"),
        (OSError(errno.ENOSPC, "No space left on device", "a.h5"), "failed", 1, "The disk is full: a.h5"),
        (PermissionError(errno.EACCES, "Permission denied", "b.csv"), "failed", 1, "b.csv cannot be read or written"),
        (KeyboardInterrupt(), "interrupted", 130, "Interrupted"),
        (KeyboardInterrupt(signal.SIGTERM), "interrupted", 143, "Interrupted"),
        (StageError("no weights"), "failed", 1, "no weights"),
    ],
)
def test_any_error_leaves_a_truthful_state(
    here: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, status: str, code: int, text: str
) -> None:
    monkeypatch.setattr(pipeline, "execute", raising(error))
    with pytest.raises(BaseException) as caught:  # noqa: PT011 - also Ctrl-C
        pipeline.run(here / "run.yaml", say=quiet)
    assert exit_code(caught.value) == code
    record = record_of(here)
    assert (record["status"], record["exit_code"]) == (status, code)
    assert text in record["error"]
    assert "Traceback" not in record["error"]
    assert [row["status"] for row in record["stages"]] == [status]
    log = (here / "runs/run" / LOG).read_text()
    assert "Traceback (most recent call last)" in log
    if code == 3:
        assert str(here / "runs/run" / LOG) in str(caught.value)


def test_a_full_disk_leaves_no_record_rather_than_a_wrong_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = RunLog(tmp_path, pipeline.load_manifest(_manifest(tmp_path)), {}, "code")
    record.write()
    full = OSError(errno.ENOSPC, "No space left on device", "run.json")
    monkeypatch.setattr(RunLog, "write", raising(full))
    record.end(full)
    assert not (tmp_path / "run.json").exists()
    with pytest.raises(OSError, match="No space"):
        record.end()


def _manifest(folder: Path) -> Path:
    path = folder / "run.yaml"
    path.write_text("captures: [P]\n")
    return path


@pytest.mark.parametrize(
    ("kind", "text", "found"),
    [
        ("OSError", "[Errno 28] No space left on device: 'a/b.csv'", "The disk is full: a/b.csv"),
        ("OSError", "[Errno 122] Disk quota exceeded: 'a' -> 'b'", "The disk is full: b"),
        (
            "OSError",
            "Unable to synchronously create file (unable to open file: name = '/x/y.h5', errno = 28, error message = "
            "'No space left on device', flags = 15, o_flags = c2)",
            "The disk is full: /x/y.h5",
        ),
        (
            "RuntimeError",
            "Can't decrement id ref count (file write failed: time = Sun, filename = '/x/z.h5', file descriptor = 44, "
            "errno = 28, error message = 'No space left on device', buf = 0x1)",
            "The disk is full: /x/z.h5",
        ),
        ("OSError", str(OSError(28, "No space left on device", "Tom's/b.csv")), "The disk is full: Tom's/b.csv"),
        (
            "OSError",
            "Unable to synchronously create file (unable to open file: name = '/Tom's/y.h5', errno = 28, error message "
            "= 'No space left on device', flags = 15, o_flags = c2)",
            "The disk is full: /Tom's/y.h5",
        ),
        ("PermissionError", "[Errno 13] Permission denied: 'p'", "p cannot be read or written (Permission denied)"),
        ("NotADirectoryError", "[Errno 20] Not a directory: 'file/x'", "file/x cannot be"),
        ("OSError", "[Errno 30] Read-only file system: 'r'", "r cannot be"),
        ("_ArrayMemoryError", "Unable to allocate 4.00 TiB for an array", "Out of memory"),
        ("OutOfMemoryError", "CUDA out of memory. Tried to allocate 20 MiB", "Out of memory"),
        ("error", "OpenCV(4.10) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate", "Out of memory"),
        ("RuntimeError", "[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory", "Out of memory"),
    ],
)
def test_memory_disk_and_place_are_told_in_a_sentence(kind: str, text: str, found: str) -> None:
    told = shortage(kind, text)
    assert told is not None
    assert told.startswith(found)
    assert "\n" not in told


def test_other_errors_are_bugs() -> None:
    assert shortage("KeyError", "'a'") is None
    assert shortage("OSError", "[Errno 5] Input/output error: 'a'") is None
    assert exit_code(KeyError("a")) == 3
    assert sentence(KeyError("a")) == "Internal error: KeyError: 'a'. This is a bug."
    assert exit_code(FileNotFoundError(errno.ENOENT, "No such file or directory", "x")) == 1


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs signals")
def test_a_killed_kernel_is_told_as_out_of_memory_and_leaves_nothing(place: Path) -> None:
    mine = f"kernel.{os.getpid()}-*"  # others may be at work
    before = set(Path(tempfile.gettempdir()).glob(mine))
    write_notebook(place / "notebooks", "retrieve", PARAMETERS, "import os\nos.kill(os.getpid(), 9)")
    with pytest.raises(StageError, match=r"Out of memory.*signal 9"):
        pipeline.run(place / "run.yaml", say=quiet, only="retrieve")
    record = record_of(place)
    assert (record["status"], record["exit_code"]) == ("failed", 1)
    assert "signal 9" in record["error"]
    assert set(Path(tempfile.gettempdir()).glob(mine)) == before


@pytest.mark.slow
def test_a_kernel_that_dies_at_its_start_is_told(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = place / "jupyter" / "kernels" / "python3"
    kernel.mkdir(parents=True)
    dies = [sys.executable, "-c", "import sys; sys.exit(7)", "{connection_file}"]
    (kernel / "kernel.json").write_text(json.dumps({"argv": dies, "display_name": "x", "language": "python"}))
    monkeypatch.setenv("JUPYTER_PATH", str(place / "jupyter"))
    with pytest.raises(StageError, match=r"kernel died.*exit code 7"):
        pipeline.run(place / "run.yaml", say=quiet, only="retrieve")
    assert record_of(place)["status"] == "failed"


@pytest.mark.parametrize(
    ("raised", "code"),
    [
        pytest.param("MemoryError()", 1, marks=pytest.mark.slow),
        pytest.param("OSError(28, 'No space', 'a')", 1, marks=pytest.mark.slow),
        ("1 / 0", 3),
    ],
)
def test_an_error_in_a_cell_has_its_exit_code(place: Path, raised: str, code: int) -> None:
    code_cell = raised if "/" in raised else f"raise {raised}"
    write_notebook(place / "notebooks", "retrieve", PARAMETERS, code_cell)
    with pytest.raises(StageError) as error:
        pipeline.run(place / "run.yaml", say=quiet, only="retrieve")
    assert exit_code(error.value) == record_of(place)["exit_code"] == code
    assert len(str(error.value).splitlines()) == 2
    assert "Traceback (most recent call last)" in (place / "runs/run" / LOG).read_text()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_run_its_kernels_and_sockets(place: Path, number: signal.Signals) -> None:
    code = "from pathlib import Path\nimport time, os\nPath(out_jsonl).parent.mkdir(parents=True, exist_ok=True)\n"
    code += "Path(out_jsonl).write_text(str(os.getpid()))\ntime.sleep(600)"
    write_notebook(place / "notebooks", "retrieve", PARAMETERS, code)
    script = (
        # A shell that starts the tests in the background has them ignore Ctrl-C.
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "import sys; from pathlib import Path; from toolkit import __main__, notebook, pipeline;"
        f"notebook.NOTEBOOKS = Path({str(place / 'notebooks')!r}); pipeline.STAGES = ('retrieve',);"
        f"sys.argv = ['toolkit', 'run', {str(place / 'run.yaml')!r}, '--only', 'retrieve', '--json']; __main__.main()"
    )
    pipe = subprocess.PIPE
    process = subprocess.Popen([sys.executable, "-c", script], stdout=pipe, stderr=pipe, text=True)
    written, deadline = place / "runs/run/P/retrieval", time.monotonic() + 120
    while not written.exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.1)
    process.send_signal(number)
    out, shown = process.communicate(timeout=60)
    assert process.returncode == 128 + number, shown
    assert "Interrupted" in shown
    assert "Traceback" not in shown
    summary = json.loads(out)
    assert (summary["status"], summary["exit_code"]) == ("interrupted", 128 + number)
    assert (record_of(place)["status"], record_of(place)["exit_code"]) == ("interrupted", 128 + number)
    assert not psutil.pid_exists(int(written.read_text()))
    assert not list(Path(tempfile.gettempdir()).glob(f"kernel.{process.pid}-*"))


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
def test_a_signal_is_heard_whatever_a_command_imports() -> None:
    # pycolmap takes SIGTERM for itself: its handler shows a stack of C++ and ends the process.
    script = (
        "import os, signal, sys; from toolkit import __main__;"
        "stop = lambda: (__import__('pycolmap'), os.kill(os.getpid(), signal.SIGTERM));"
        "__main__.app.command('stop')(stop); __main__.main()"
    )
    done = subprocess.run([sys.executable, "-c", script, "stop"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (143, "Interrupted. The same command goes on from here.\n")


def test_a_folder_has_one_run_at_a_time(here: Path) -> None:
    with held(here / "runs" / "run"), pytest.raises(ToolkitError):
        pipeline.run(here / "run.yaml", say=quiet)
    pipeline.run(here / "run.yaml", say=quiet)
    assert record_of(here)["status"] == "done"


def test_a_notebook_that_a_full_disk_cuts_short_does_not_hide_why(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    import papermill

    def cut_short(source: str, output: str, **_: object) -> None:
        Path(output).write_text('{"cells": [')
        raise OSError(errno.ENOSPC, "No space left on device", output)

    def no_report(run_dir: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(run_dir / "report.html"))

    write_notebook(place / "notebooks", "retrieve", PARAMETERS, "pass")
    monkeypatch.setattr(papermill, "execute_notebook", cut_short)
    monkeypatch.setattr(pipeline, "_write_report", no_report)
    with pytest.raises(OSError, match="No space left"):
        pipeline.run(place / "run.yaml", say=quiet, only="retrieve")
    assert record_of(place)["error"].startswith("The disk is full: ")
    assert record_of(place)["exit_code"] == 1
    assert "Traceback" not in capfd.readouterr().err
    assert not list((place / "runs/run/notebooks").glob("*"))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    done = mount and subprocess.run([mount, "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True)
    if not done or done.returncode:
        pytest.skip("needs the right to mount a small file system")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("used", [0, 60, 64])
def test_a_disk_of_64_kb_is_told_in_a_sentence(
    here: Path, small_disk: Path, used: int, command: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "notebooks/02_embed.ipynb").unlink()
    parameters = 'sessions_root = None\nout_dir = None\nmodel = "vlad"\nskip_existing = True'
    big = 'from pathlib import Path\nPath(out_dir).mkdir(parents=True)\nPath(out_dir, "x").write_bytes(bytes(10**6))'
    write_notebook(here / "notebooks", "embed", parameters, big)
    (small_disk / "other").write_bytes(bytes(used * 1024))
    assert command("run", "run.yaml", "--set", f"output_root={small_disk}") == 1
    shown = capsys.readouterr().err
    assert "The disk is full" in shown
    assert "Traceback" not in shown
    record = small_disk / "run" / "run.json"
    assert not record.exists() or json.loads(record.read_text())["status"] == "failed"


def test_the_exit_codes_and_the_summary(
    here: Path, command: Callable[..., int], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(*arguments: str) -> tuple[int, dict[str, Any], str]:
        capsys.readouterr()
        code = command("run", "run.yaml", "--json", *arguments)
        out, err = capsys.readouterr()
        return code, json.loads(out), err

    code, summary, shown = asked()
    assert (code, summary["status"], summary["exit_code"], summary["error"]) == (0, "done", 0, None)
    assert [row["status"] for row in summary["stages"]] == ["done", "done"]
    assert "[1/2] embed" in shown, "the story is on stderr"
    code, summary, shown = asked("--set", "embed.modell=vlad")
    assert (code, summary["status"], summary["exit_code"]) == (1, "failed", 1)
    assert "embed.modell" in summary["error"]
    code, summary, shown = asked("--set", "retrieve.topk=99")
    assert (code, summary["status"], summary["stages"][-1]["status"]) == (1, "failed", "failed")
    assert "dragon" in shown
    assert command("run", "--nonsense") == 1
    assert command("run", "no.yaml") == 1

    parameters = 'sessions_root = None\nout_dir = None\nmodel = "vlad"\nskip_existing = True'
    counts = "from toolkit import notebook\nnotebook.finish(images=100, unreadable=29)"
    write_notebook(here / "notebooks", "embed", parameters, counts)
    code, summary, shown = asked()
    assert (code, summary["status"], summary["exit_code"]) == (2, "incomplete", 2)
    assert "29 of 100 images" in summary["error"]
    assert asked()[0] == 2, "also where all is reused"
    code, summary, shown = asked("--sweep", "retrieve.topk=3,5")
    assert (code, summary["status"], summary["exit_code"]) == (2, "incomplete", 2)
    assert asked("--set", "tolerate_failed.images=0.28")[0] == 2
    assert asked("--set", "tolerate_failed.images=0.29")[0] == 0, "0.29 * 100 is rounded to less than 29"

    monkeypatch.setattr(pipeline, "execute", raising(KeyError("dragon")))
    code, summary, shown = asked("--force")
    assert (code, summary["status"], summary["exit_code"]) == (3, "failed", 3)
    assert "Traceback" not in shown


def test_a_sweep_whose_runs_cannot_be_compared_is_done(
    here: Path, command: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("run", "run.yaml", "--json", "--sweep", "retrieve.topk=3,5") == 0
    out, err = capsys.readouterr()
    runs = {f"run-topk-{k}": str(here / f"runs/run-topk-{k}") for k in (3, 5)}
    assert json.loads(out)["runs"] == runs
    assert "Nothing to compare: " in err
    assert command("run", "run.yaml", "--sweep", "retrieve.topk=3,5") == 0
    assert "Nothing to compare: " in capsys.readouterr().out


def test_one_capture_that_fails_does_not_stop_the_others(here: Path, command: Callable[..., int]) -> None:
    shutil.copytree(here / "P", here / "Q")
    code = "from toolkit.errors import CaptureError\nif '/P/' in out_jsonl:\n    raise CaptureError('a dragon')"
    write_notebook(here / "notebooks", "retrieve", PARAMETERS, code)
    assert command("run", "run.yaml", "--set", "captures=[P, Q]", "--in-place") == 2
    record = record_of(here)
    assert record["status"] == "incomplete"
    assert {(row["scene"], row["stage"]): row["status"] for row in record["stages"]} == {
        ("P", "embed"): "done", ("P", "retrieve"): "failed", ("Q", "embed"): "done", ("Q", "retrieve"): "done"
    }  # fmt: skip
    assert "a dragon" in record["error"]


def test_pairs_that_fail_are_counted_against_what_is_tolerated(here: Path) -> None:
    code = "import pandas as pd\nfrom toolkit import notebook\nreasons = ['a dragon', '']\n"
    code += "notebook.finish(pd.DataFrame({'map_device': 'ios', 'query_device': ['hl', 'ios'], 'reason': reasons}))"
    write_notebook(here / "notebooks", "retrieve", PARAMETERS, code)
    pipeline.run(here / "run.yaml", say=quiet)
    record = record_of(here)
    assert (record["status"], record["exit_code"]) == ("incomplete", 2)
    assert record["failed"]["pairs"] == {"failed": 1, "of": 2}
    assert "a dragon" in record["error"]
    assert "`devices:`" in record["error"]
    pipeline.run(here / "run.yaml", overrides=["tolerate_failed.pairs=0.5"], say=quiet, in_place=True)
    assert record_of(here)["exit_code"] == 0


def test_what_builds_on_a_failed_stage_is_skipped(here: Path) -> None:
    parameters = 'sessions_root = None\nout_dir = None\nmodel = "vlad"\nskip_existing = True'
    code = "from toolkit.errors import CaptureError\nraise CaptureError('a dragon')"
    write_notebook(here / "notebooks", "embed", parameters, code)
    with pytest.raises(StageError, match="a dragon"):
        pipeline.run(here / "run.yaml", say=quiet)
    record = record_of(here)
    assert [row["status"] for row in record["stages"]] == ["failed", "skipped"]
    assert (record["status"], record["exit_code"]) == ("failed", 1)


@pytest.mark.parametrize("unit", [None, 1, 0.01])
def test_the_unit_of_poses_may_be_a_whole_number_or_unknown(unit: float | None, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").touch()
    images = {"map_images": str(tmp_path), "map_table": str(tmp_path / "poses.csv"), "query_images": str(tmp_path)}
    notebook.check_values("own_images", images | {"unit_m": unit})


@pytest.mark.parametrize("name", [*STAGES, "own_images", "compare"])
def test_notebook_parameters_as_committed_fit(name: str) -> None:
    notebook.check_values(name, notebook.notebook_parameters(notebook.notebook_path(name)))


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({"In": ["# Parameters\nquery_image = 'x'\n"]}, "query_image: 00_own_images.ipynb has no such parameter"),
        ({"map_images": 5}, "map_images: found 5"),
    ],
)
def test_a_notebook_that_is_no_stage_looks_at_its_parameters(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, Any], said: str
) -> None:
    shell = SimpleNamespace(user_ns=variables)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    with pytest.raises(ManifestError, match=said):
        notebook.check_given("own_images")


INJECTED = {"In": ["", "topk = 10  # a user's cell", "# Parameters\ntop_k = 5\n"]}  # by papermill


@pytest.mark.parametrize(("stage", "asked", "error", "message"), [
    ("localize", {"map_device": "all", "query_device": "oss"}, CaptureError, "device 'oss'.*: ios"),
    ("localize", {"queries": "keyframes_evry"}, CaptureError, "'keyframes_evry'.*every"),
    ("retrieve", {"topk": "ten"}, ManifestError, "topk"),
    ("retrieve", INJECTED, ManifestError, r"top_k: 03_retrieve\.ipynb .*topk"),
])  # fmt: skip
def test_a_notebook_looks_for_what_it_is_asked_before_earlier_stages_are_made(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stage: str,
    asked: dict[str, Any],
    error: type[Exception],
    message: str,
) -> None:
    for session in ("ios_map", "ios_query"):
        (tmp_path / "P" / "sessions" / session / "proc").mkdir(parents=True)
        for name in ("images.txt", "sensors.txt"):
            (tmp_path / "P" / "sessions" / session / name).touch()
    (tmp_path / "P" / "sessions" / "ios_query" / "proc" / "keyframes_every.txt").touch()
    shell = SimpleNamespace(user_ns={"In": [""], **asked})
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setattr(notebook, "_make_upstream", lambda *_: pytest.fail("made"))
    with pytest.raises(error, match=message):
        notebook.start(stage, sessions_root=str(tmp_path / "P" / "sessions"))


def test_an_error_of_a_place_says_what_was_found_expected_and_is_to_do() -> None:
    assert str(ManifestError.at("a.yaml: k", "3", "a text", "Quote it.")) == (
        "a.yaml: k: found 3, expected a text. Quote it."
    )
    assert str(CaptureError.at("a.txt", expected="a line")) == "a.txt: expected a line."
