"""The run folder: lock it against other runs, log to it, and clean up after killed runs."""

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
from toolkit.files import environment_variable, is_left_over, read_json, sweep_partials, write_text
from toolkit.runs.record import RECORD

log = logging.getLogger(__name__)

LOG = "run.log"
LOG_VARIABLE = "TOOLKIT_RUN_LOG"
"""Environment variable with the path of the log, for the kernels of a run."""


@contextmanager
def held(run_dir: Path) -> Iterator[None]:
    """Lock a run folder, log to its `run.log`, and remove the leftovers of a killed run.

    The operating system releases the lock when the process ends, however it ends.

    Raises:
        ToolkitError: another run holds the lock; the message names its process, host and start.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    lock, holder = FileLock(run_dir / ".run.lock"), run_dir / ".run.lock.json"
    try:
        lock.acquire(timeout=0)
    except Timeout:
        other = read_json(holder)
        who = f"process {other.get('pid', '?')} on {other.get('host', '?')}, since {other.get('since', '?')}"
        raise ToolkitError(
            f"{run_dir}: another run is using this folder: {who}. Wait until it ends, stop it, or write this run to "
            "another folder (--set output_root=FOLDER)."
        ) from None
    try:
        me = {"pid": os.getpid(), "host": socket.gethostname()}
        with log_to(run_dir / LOG), environment_variable(LOG_VARIABLE, str((run_dir / LOG).absolute())):
            if before := read_json(holder):
                log.warning("The run of process %s on %s was killed.", before.get("pid"), before.get("host"))
            write_text(holder, json.dumps(me | {"since": datetime.now().isoformat(" ", "seconds")}) + "\n")
            _sweep(run_dir)
            yield
    finally:
        for path in (holder, run_dir / ".run.lock"):  # before the release, so that no other run's files are removed
            with suppress(OSError):
                path.unlink()
        lock.release()


def _sweep(run_dir: Path) -> None:
    """Remove temporary files and folders of killed runs, and mark a record that still says `running` as interrupted."""
    sweep_partials(run_dir)
    # Papermill writes the executed notebook under a name without a process id, which `sweep_partials` does not know.
    for notebook in run_dir.glob("notebooks/.*.partial.ipynb"):
        notebook.unlink()
    for folder in Path(tempfile.gettempdir()).glob("kernel.*"):
        if is_left_over(folder.name):
            log.debug("Removed %s of a killed run.", folder)
            shutil.rmtree(folder, ignore_errors=True)
    record = read_json(run_dir / RECORD)
    if record.get("status") == "running":
        killed = {"status": "interrupted", "error": "The run was killed. The same command continues it."}
        write_text(run_dir / RECORD, json.dumps(record | killed, indent=1) + "\n")


def log_to(path: Path) -> ExitStack:
    """Log to a file, with times: all messages of the toolkit, debug included, and warnings of other libraries.

    Warnings still appear on the terminal.

    Returns:
        Context that ends the logging when it closes.
    """
    root, own, ending = logging.getLogger(), logging.getLogger("toolkit"), ExitStack()
    file = logging.FileHandler(path, encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(process)d %(levelname)s %(name)s: %(message)s"))
    # A full disk would print a traceback for each line; the run itself fails with the error.
    file.handleError = lambda record: None  # type: ignore[method-assign]
    handlers: list[logging.Handler] = [file]
    if not root.handlers and logging.lastResort is not None:
        handlers.append(logging.lastResort)  # prints warnings; logging skips it as soon as there is another handler
    for handler in handlers:
        root.addHandler(handler)
        ending.callback(root.removeHandler, handler)
    ending.callback(own.setLevel, own.level)
    own.setLevel(logging.DEBUG)
    ending.callback(_close, file)
    return ending


def warnings_of_kernels(path: Path, start: int) -> list[str]:
    """Return the distinct warnings of other processes (kernels) in a log after its first `start` bytes.

    Warnings of this process are already on the terminal.
    """
    try:
        with path.open("rb") as file:
            file.seek(start)
            lines = file.read().decode("utf-8", errors="replace").splitlines()
    except OSError:
        return []
    matches = (re.fullmatch(r"\S+ \S+ (\d+) WARNING toolkit\.\S+: (.+)", line) for line in lines)
    return list(dict.fromkeys(match[2] for match in matches if match and int(match[1]) != os.getpid()))


def _close(file: logging.FileHandler) -> None:
    with suppress(OSError):  # a full disk: report the error that stopped the run, not this one
        file.close()
