"""Start and end the kernels of a run, and measure their memory."""

import os
import signal
import tempfile
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from toolkit.errors import FREE_MEMORY, StageError, first_line
from toolkit.files import process_tag

TEXT_BARS = "TOOLKIT_TEXT_BARS"
"""Environment variable that makes progress bars text; set in kernels, whose widgets no one sees."""
HEAPS = str(max(os.cpu_count() or 1, 2))
"""Heaps of glibc in a kernel. By default, up to eight a core each keep what large arrays of their threads have freed:
1.8 instead of 1.35 GB with ALIKED (STRECHA_HARD, 2 cores), in the same time. `MALLOC_ARENA_MAX` of the user wins."""
_ARGUMENTS = [
    # Hides the kernel's messages about its own shutdown.
    "--log-level=CRITICAL",
    # Slow imports run early, while the previous notebook still runs. The garbage collector ignores what they leave: it
    # would search these 200,000 objects again and again (15 % of the imports' time, 5 % of that of drawing).
    "--IPKernelApp.exec_lines=import gc; gc.disable(); __import__('toolkit.notebook'); __import__('toolkit.evaluate'); "
    "__import__('matplotlib.figure'); __import__('matplotlib.backends.backend_agg'); __import__('toolkit.scene'); "
    "gc.freeze(); gc.enable(); del gc",
]


def kernel_error(error: Exception, ended_by: int | None, memory_mb: float, output: Path) -> StageError:
    """Return the error for a kernel that died, or did not start; `ended_by` as of `RunningKernel`."""
    if ended_by == -9:
        text = "Out of memory, most likely: the system killed the notebook's kernel (signal 9"
        text += f"; {memory_mb:.0f} MB were in use). {FREE_MEMORY}"
    elif ended_by is not None:
        by = f"signal {-ended_by}, {signal.strsignal(-ended_by)}" if ended_by < 0 else f"exit code {ended_by}"
        text = f"The notebook's kernel died ({by}; {memory_mb:.0f} MB were in use)."
    else:
        text = f"The notebook's kernel did not start or answer ({first_line(error)})."
    return StageError(f"{text}\nThe executed notebook shows where: {output}")


@dataclass
class RunningKernel:
    """A kernel that is starting or has started, in a folder for its connection file and sockets."""

    manager: Any
    """`AsyncKernelManager` of `jupyter_client`."""
    folder: tempfile.TemporaryDirectory[str]
    clients: list[Any]
    """Clients of `jupyter_client` that are connected to the kernel."""

    @property
    def ended_by(self) -> int | None:
        """Exit status, negative for a signal; None while the kernel lives."""
        status: int | None = self.manager.provisioner.process.poll()
        return status

    def end(self) -> None:
        """End the kernel, whose notebook has ended or failed."""
        from jupyter_core.utils import run_sync

        for client in self.clients:  # nbclient closes only the clients of kernels that it started
            client.stop_channels()
        # The manager's own kill interrupts the kernel first, and a kernel that is starting then prints a traceback.
        process = self.manager.provisioner.process
        process.kill()
        process.wait()
        run_sync(self.manager.cleanup_resources)()
        self.folder.cleanup()


class Kernels:
    """Kernels of a run's notebooks. The next kernel starts while a notebook runs, which hides seconds of imports."""

    def __init__(self, cwd: Path) -> None:
        """`cwd` is the working folder of the kernels; it is created with the first one."""
        self._cwd = cwd
        self.left = 1
        """Largest number of notebooks that are still to run; no kernel is started for more."""
        self._spare: RunningKernel | None = None
        self._running: list[RunningKernel] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End all kernels."""
        for kernel in list(self._running):
            self.end(kernel)

    def prepare(self) -> None:
        """Start the kernel of the next notebook, if there is one."""
        if self._spare is None and self.left > 0:
            self._spare = self._start()

    def take(self) -> RunningKernel:
        """Return a kernel, and start the kernel of the next notebook if there is one."""
        kernel, self._spare = self._spare or self._start(), None
        self.left -= 1
        self.prepare()
        return kernel

    def end(self, kernel: RunningKernel) -> None:
        """End a kernel."""
        self._running.remove(kernel)
        kernel.end()

    def _start(self) -> RunningKernel:
        from jupyter_client.manager import AsyncKernelManager
        from jupyter_core.utils import run_sync
        from traitlets.config import Config

        self._cwd.mkdir(parents=True, exist_ok=True)
        # Sockets in the file system, which other users of the machine cannot open. Their paths have a length limit.
        folder = tempfile.TemporaryDirectory(prefix=f"kernel.{process_tag()}-", ignore_cleanup_errors=True)
        ipc = os.name == "posix" and len(folder.name) < 80
        sockets = {"transport": "ipc", "ip": f"{folder.name}/s"} if ipc else {}
        config = Config({"KernelManager": {"connection_file": f"{folder.name}/kernel.json"} | sockets})
        manager = AsyncKernelManager(kernel_name="python3", config=config)
        connect, clients = manager.client, []

        def client(**options: Any) -> Any:
            clients.append(connect(**options))
            return clients[-1]

        manager.client = client  # type: ignore[method-assign]
        environment = {"MALLOC_ARENA_MAX": HEAPS} | os.environ | {TEXT_BARS: "1"}
        run_sync(manager.start_kernel)(cwd=str(self._cwd), env=environment, extra_arguments=_ARGUMENTS)
        self._running.append(RunningKernel(manager, folder, clients))
        return self._running[-1]


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
