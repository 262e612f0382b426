"""The run folder: one run at a time, a log of everything, and nothing left of runs that were killed."""

import json
import logging
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from toolkit.errors import ToolkitError
from toolkit.files import is_left_over, read_json, sweep_partials, write_text
from toolkit.runs.record import RECORD

log = logging.getLogger(__name__)

LOG = "run.log"
LOG_VARIABLE = "TOOLKIT_RUN_LOG"
"""Tells the kernels of a run where its log is."""


@contextmanager
def held(run_dir: Path) -> Iterator[None]:
    """Hold a run folder against other runs, log to its `run.log`, and clear away what a killed run left in it.

    The system itself gives up the lock of a process that ends, however it ends.

    Raises:
        ToolkitError: another run holds it; names its process, host and start.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    lock, holder = FileLock(run_dir / ".run.lock"), run_dir / ".run.lock.json"
    try:
        lock.acquire(timeout=0)
    except Timeout:
        other = read_json(holder)
        who = f"process {other.get('pid', '?')} on {other.get('host', '?')}, since {other.get('since', '?')}"
        raise ToolkitError(
            f"{run_dir}: another run works in this folder: {who}. Wait until it ends, end it, or give this run "
            "another place (--set output_root=FOLDER)."
        ) from None
    try:
        me = {"pid": os.getpid(), "host": socket.gethostname()}
        with log_to(run_dir / LOG), _variable(LOG_VARIABLE, str((run_dir / LOG).absolute())):
            if before := read_json(holder):
                log.warning("The run of process %s on %s was killed.", before.get("pid"), before.get("host"))
            write_text(holder, json.dumps(me | {"since": datetime.now().isoformat(" ", "seconds")}) + "\n")
            _sweep(run_dir)
            yield
    finally:
        for path in (holder, run_dir / ".run.lock"):  # while it is held
            with suppress(OSError):
                path.unlink()
        lock.release()


@contextmanager
def _variable(name: str, value: str) -> Iterator[None]:
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]


def _sweep(run_dir: Path) -> None:
    """Remove temporary files and folders of killed runs, and say in their record that they have ended."""
    sweep_partials(run_dir)
    # The executed notebook is written by papermill, under a name without a process.
    for notebook in run_dir.glob("notebooks/.*.partial.ipynb"):
        notebook.unlink()
    for folder in Path(tempfile.gettempdir()).glob("kernel.*"):
        if is_left_over(folder.name):
            log.debug("removed %s of a killed run", folder)
            shutil.rmtree(folder, ignore_errors=True)
    record = read_json(run_dir / RECORD)
    if record.get("status") == "running":
        killed = {"status": "interrupted", "error": "The run was killed. The same command goes on from there."}
        write_text(run_dir / RECORD, json.dumps(record | killed, indent=1) + "\n")


def log_to(path: Path) -> ExitStack:
    """Write to a file, with times, what the toolkit logs, debug messages included, and what others warn of.

    Warnings appear on the terminal as without it.

    Returns:
        What ends it when it is closed.
    """
    root, own, ending = logging.getLogger(), logging.getLogger("toolkit"), ExitStack()
    file = logging.FileHandler(path, encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(process)d %(levelname)s %(name)s: %(message)s"))
    file.handleError = lambda record: None  # type: ignore[method-assign]  # a full disk is told once, not for each line
    handlers: list[logging.Handler] = [file]
    if not root.handlers and logging.lastResort is not None:
        handlers.append(logging.lastResort)  # what prints warnings where there is no handler
    for handler in handlers:
        root.addHandler(handler)
        ending.callback(root.removeHandler, handler)
    ending.callback(own.setLevel, own.level)
    own.setLevel(logging.DEBUG)
    ending.callback(_close, file)
    return ending


def warnings_of_kernels(path: Path, start: int) -> list[str]:
    """Return what kernels have warned of in a log after its first `start` bytes, each once.

    Warnings of this process are on the terminal already, those of kernels are not.
    """
    try:
        with path.open("rb") as file:
            file.seek(start)
            lines = file.read().decode("utf-8", errors="replace").splitlines()
    except OSError:
        return []
    found = (re.fullmatch(r"\S+ \S+ (\d+) WARNING toolkit\.\S+: (.+)", line) for line in lines)
    return list(dict.fromkeys(match[2] for match in found if match and int(match[1]) != os.getpid()))


def _close(file: logging.FileHandler) -> None:
    with suppress(OSError):  # a full disk; what stopped the run is the error to tell
        file.close()
