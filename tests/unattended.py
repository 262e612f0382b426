"""Runs that can be killed at a chosen moment, without the seconds that kernels take to start.

`python -m tests.unattended MANIFEST` imports all that a run needs, and then forks a process for each line of its
standard input, a JSON object {stage, event, delay_s, signal}: the process runs the manifest, the real notebooks' cells
executed in it, and is sent the signal `delay_s` after its file operation number `event` in that stage, or the first of
a later stage if there are fewer; `{}` lets it run to its end. One line of JSON comes back: {stopped, status, events}:
whether the signal was sent, how the process ended, and, of one that ended well, the number of file operations of each
stage.
"""

import ast
import json
import os
import select
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat
import pytest
from IPython.core.formatters import DisplayFormatter
from nbformat.v4 import new_output

# Imported before the first fork, all that the cells need.
from toolkit import embed, evaluate, localize, notebook, pipeline, rerank, retrieve, visualize  # noqa: F401
from toolkit.figures import explore  # noqa: F401
from toolkit.files import write_atomic
from toolkit.manifest import STAGES
from toolkit.report import page  # noqa: F401
from toolkit.runs.kernel import TEXT_BARS

CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir"}
"""Audit events that change a folder; `open` for writing is the other."""
STAGE_OF = {path.name: path.stem.partition("_")[2] for path in notebook.NOTEBOOKS.glob("*.ipynb")}
ORDER = ("", *STAGES)


class Events:
    """Counts the operations on files below a folder by stage, and tells when one of them is about to happen."""

    def __init__(self, folder: Path, stage: str | None, event: int, tell: int) -> None:
        """`tell`: a file descriptor that gets a byte at operation number `event`, from 1, of `stage`, or after it."""
        self.counts = Counter[str]()
        self.stage = ""
        self._folder, self._tell = str(folder), tell
        self._at = (ORDER.index(stage), event) if stage else None
        sys.addaudithook(self._hook)

    def _hook(self, name: str, arguments: tuple[Any, ...]) -> None:
        writes = bool(arguments[2] & (os.O_WRONLY | os.O_RDWR)) if name == "open" else name in CHANGES
        if writes and str(arguments[0]).startswith(self._folder):
            self.counts[self.stage] += 1
            if self._at and (ORDER.index(self.stage), self.counts[self.stage]) >= self._at:
                self._at = None
                os.write(self._tell, b"!")


def run_cells(
    content: Any, variables: dict[str, Any], parameters: dict[str, Any], show: Callable[[Any], object] | None = None
) -> None:
    """Execute the cells of a notebook in this process, with these variables; as papermill, with these parameters.

    `show` gets what a cell ends with.
    """
    for cell in content.cells:
        if cell.cell_type == "code":
            source = "\n".join(line for line in cell.source.split("\n") if not line.startswith("%"))
            *lines, last = ast.parse(source).body
            if show is None or not isinstance(last, ast.Expr) or source.endswith(";"):
                exec(compile(source, cell.id, "exec"), variables)
            else:
                exec(compile(ast.Module(lines, []), cell.id, "exec"), variables)
                value = eval(compile(ast.Expression(last.value), cell.id, "eval"), variables)
                if value is not None:
                    show(value)
            if "parameters" in cell.metadata.get("tags", []):
                variables |= parameters


def execute_cells(
    events: Events | SimpleNamespace, path: Path, output: Path, parameters: dict[str, Any], *_: object,
    show: Callable[[Any], object] | None = None,
) -> tuple[Any, float]:  # fmt: skip
    """Do what `toolkit.notebook.execute` does, in this process; of what cells display, counts alone are kept."""
    import IPython.display

    events.stage = STAGE_OF[path.name]
    notebook.check_parameters(path, parameters)
    content = nbformat.read(path, as_version=4)
    outputs: list[Any] = []

    def display(*data: Any, raw: bool = False, **_: Any) -> None:
        if raw:
            outputs.extend(new_output("display_data", data=one) for one in data)

    IPython.display.display = display
    variables: dict[str, Any] = {"display": display}
    notebook._user_names = lambda: variables
    run_cells(content, variables, parameters, show)
    content.cells[-1].outputs = outputs
    with write_atomic(output) as temporary:
        nbformat.write(content, temporary)
    return content, 1.0


@contextmanager
def no_kernels() -> Iterator[None]:
    """Runs execute the cells of their notebooks in this process, in the folder where a kernel would.

    What a cell ends with is made into HTML and pictures as in a kernel; nothing is kept of it.
    """

    def execute_here(path: Path, output: Path, *arguments: Any) -> tuple[Any, float]:
        with pytest.MonkeyPatch.context() as inside:
            inside.setenv(TEXT_BARS, "1")  # as in a kernel
            inside.setattr("IPython.display.display", None)  # what follows changes these two, which are put back
            inside.setattr(notebook, "_user_names", dict)
            output = output.resolve()
            output.parent.mkdir(exist_ok=True)
            inside.chdir(output.parent)
            return execute_cells(SimpleNamespace(), path, output, *arguments, show=DisplayFormatter().format)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "execute", execute_here)
        yield


def run_in_child(manifest: Path, asked: dict[str, Any], tell: int, answer: int) -> None:
    """Run a manifest, and write the number of operations to the file descriptor `answer`."""
    os.setsid()
    log = os.open(manifest.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    import pycolmap  # noqa: F401 - installs a handler of SIGTERM that may wait for memory forever, as it prints a trace

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    events = Events(manifest.parent / manifest.stem, asked.get("stage"), asked.get("event", 0), tell)
    pipeline.execute = lambda *arguments: execute_cells(events, *arguments)
    pipeline.run(manifest)
    os.write(answer, json.dumps(events.counts).encode())


def attempt(manifest: Path, asked: dict[str, Any]) -> dict[str, Any]:
    """Run a manifest in a process of its own, and kill that at the moment asked for."""
    (told, tell), (result, answer) = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        try:
            run_in_child(manifest, asked, tell, answer)
            os._exit(0)
        except BaseException:
            import traceback

            traceback.print_exc()
            os._exit(1)
    os.close(tell)
    os.close(answer)
    select.select([told], [], [])
    stopped = os.read(told, 1) == b"!"  # else it has ended
    if stopped:
        time.sleep(asked["delay_s"])
        os.kill(child, asked["signal"])
    counts = os.read(result, 1 << 16)
    _, status = os.waitpid(child, 0)
    os.close(told)
    os.close(result)
    return {"stopped": stopped, "status": status, "events": json.loads(counts or b"{}")}


if __name__ == "__main__":
    import gc

    # What a child would import with its first query or figure.
    import matplotlib as mpl
    import matplotlib.pyplot
    import pandas.io.formats.style  # noqa: F401
    import scipy.cluster.hierarchy  # noqa: F401
    import torch  # noqa: F401
    from IPython.display import HTML  # noqa: F401
    from matplotlib.backends import backend_agg  # noqa: F401
    from PIL import Image

    from toolkit import scene  # noqa: F401
    from toolkit.viewer import queries  # noqa: F401

    Image.init()
    mpl.use("Agg")
    os.environ[TEXT_BARS] = "1"  # as in the kernels of a run, which show no viewer
    gc.freeze()  # children look through what they make, and share what is here
    for line in sys.stdin:
        print(json.dumps(attempt(Path(sys.argv[1]), json.loads(line))), flush=True)
