"""Start and end the kernels of a run, and measure their memory."""

import asyncio
import os
import signal
import tempfile
import threading
from collections.abc import Coroutine
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from toolkit.errors import FREE_MEMORY, StageError, first_line
from toolkit.files import process_tag

TEXT_BARS = "TOOLKIT_TEXT_BARS"
"""Environment variable that makes progress bars text; set in kernels, whose widgets no one sees."""
_PATIENCE_S = 10.0
"""Timeout for a kernel or the thread to end."""
_ARGUMENTS = [
    # Hides the kernel's messages about its own shutdown.
    "--log-level=CRITICAL",
    # Slow imports run early, while the previous notebook still runs. The garbage collector ignores what they leave: it
    # would search these 200,000 objects again and again (15 % of the imports' time, 5 % of that of drawing).
    "--IPKernelApp.exec_lines=import gc; gc.disable(); __import__('toolkit.notebook'); __import__('toolkit.evaluate'); "
    "__import__('matplotlib.figure'); __import__('matplotlib.backends.backend_agg'); gc.freeze(); gc.enable(); del gc",
]


def kernel_error(error: Exception, ended_by: int | None, memory_mb: float, output: Path) -> StageError:
    """Return the error for a kernel that died, or did not start; `ended_by` as of `RunningKernel`."""
    if ended_by == -9:
        text = (
            f"Out of memory, most likely: the system killed the notebook's kernel (signal 9; {memory_mb:.0f} MB were "
            f"in use). {FREE_MEMORY}"
        )
    elif ended_by is not None:
        by = f"signal {-ended_by}, {signal.strsignal(-ended_by)}" if ended_by < 0 else f"exit code {ended_by}"
        text = f"The notebook's kernel died ({by}; {memory_mb:.0f} MB were in use)."
    else:
        text = f"The notebook's kernel did not start or answer ({first_line(error)})."
    return StageError(f"{text}\nThe executed notebook shows where: {output}")


@dataclass(frozen=True)
class RunningKernel:
    """A kernel that has started or is starting."""

    manager: Any
    """`AsyncKernelManager` of `jupyter_client`."""
    folder: tempfile.TemporaryDirectory[str]
    """Folder of the connection file and the sockets."""
    started: Future[None]
    """Done when the kernel has started."""
    clients: list[Any]
    """Clients of `jupyter_client` that are connected to the kernel."""

    @property
    def ended_by(self) -> int | None:
        """Exit status, negative for a signal; None while the kernel lives."""
        process = getattr(self.manager.provisioner, "process", None)
        return None if process is None else process.poll()


class Kernels:
    """Kernels of a run's notebooks. The next kernel starts while a notebook runs; kernels end in the background."""

    def __init__(self, cwd: Path) -> None:
        """`cwd` is the working folder of the kernels; it is created with the first one."""
        self._cwd = cwd
        self.left = 1
        """Largest number of notebooks that are still to run; no kernel is started for more."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._spare: RunningKernel | None = None
        self._started: list[RunningKernel] = []
        self._ended: dict[str, Future[None]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End all kernels."""
        for kernel in self._started:
            self.end(kernel, by_force=True)
        for kernel in self._started:
            with suppress(Exception):
                self._ended[kernel.folder.name].result(timeout=_PATIENCE_S)
            _end_children(kernel.folder.name)
            kernel.folder.cleanup()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_PATIENCE_S)

    def prepare(self) -> None:
        """Begin to start the kernel of the next notebook if there is one."""
        if self._spare is None and self.left > 0:
            self._spare = self._start()

    def take(self) -> RunningKernel:
        """Return a kernel, and begin to start the kernel of the next notebook if there is one."""
        kernel, self._spare = self._spare or self._start(), None
        self.left -= 1
        self.prepare()
        return kernel

    def end(self, kernel: RunningKernel, by_force: bool) -> None:
        """Begin to end a kernel, once."""
        if kernel.folder.name not in self._ended:
            for client in kernel.clients:  # nbclient closes only the clients of kernels that it started
                client.stop_channels()
            self._ended[kernel.folder.name] = self._in_thread(_shut_down(kernel, by_force))

    def _start(self) -> RunningKernel:
        from jupyter_client.manager import AsyncKernelManager
        from traitlets.config import Config

        self._cwd.mkdir(parents=True, exist_ok=True)
        # Sockets in the file system, which other users of the machine cannot open. Their paths have a length limit.
        folder = tempfile.TemporaryDirectory(prefix=f"kernel.{process_tag()}-", ignore_cleanup_errors=True)
        ipc = os.name == "posix" and len(folder.name) < 80
        sockets = {"transport": "ipc", "ip": f"{folder.name}/s"} if ipc else {}
        config = Config({"KernelManager": {"connection_file": f"{folder.name}/kernel.json"} | sockets})
        manager = AsyncKernelManager(kernel_name="python3", config=config)
        options = {"cwd": str(self._cwd), "env": os.environ | {TEXT_BARS: "1"}, "extra_arguments": _ARGUMENTS}
        connect, clients = manager.client, []

        def client(**options: Any) -> Any:
            clients.append(connect(**options))
            return clients[-1]

        manager.client = client  # type: ignore[method-assign]
        kernel = RunningKernel(manager, folder, self._in_thread(_start_up(manager, options)), clients)
        self._started.append(kernel)
        return kernel

    def _in_thread(self, work: Coroutine[Any, Any, None]) -> Future[None]:
        return asyncio.run_coroutine_threadsafe(work, self._loop)


async def _start_up(manager: Any, options: dict[str, Any]) -> None:
    await manager.start_kernel(**options)
    import papermill  # noqa: F401  # takes seconds, and is needed as soon as the kernel is


async def _shut_down(kernel: RunningKernel, by_force: bool) -> None:
    with suppress(Exception):  # a kernel that failed to start need not be ended
        await asyncio.wrap_future(kernel.started)
    if kernel.manager.has_kernel and by_force:
        # The manager's own kill interrupts the kernel first, and a kernel that is starting then prints a traceback.
        await kernel.manager.provisioner.kill()
        await kernel.manager.provisioner.wait()
        await kernel.manager.cleanup_resources()
    elif kernel.manager.has_kernel:
        await kernel.manager.shutdown_kernel()


def _end_children(folder: str) -> None:
    """Kill the kernel with its connection file in this folder: it was starting when the run was interrupted."""
    import psutil

    for child in psutil.Process().children():
        with suppress(psutil.Error):
            if any(folder in part for part in child.cmdline()):
                child.kill()
                child.wait(5)


class MemoryWatch(threading.Thread):
    """Sample the memory of this process and all its descendants, so that worker processes of a kernel count too."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._ended = threading.Event()
        self._peak_mb = 0.0
        self.start()

    def run(self) -> None:
        """Sample until stopped."""
        import psutil

        me = psutil.Process()
        while not self._ended.wait(0.5):
            total = 0
            for process in [me, *me.children(recursive=True)]:
                with suppress(psutil.Error):
                    info = process.memory_full_info()
                    # Proportional set size: pages shared between forked workers count once.
                    total += getattr(info, "pss", info.rss)
            self._peak_mb = max(self._peak_mb, total / 2**20)

    def stop(self) -> float:
        """Stop sampling and return the peak of the sum, in MB."""
        self._ended.set()
        self.join()
        return self._peak_mb
