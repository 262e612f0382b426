"""The kernels of a run: how they ended, how much memory they took."""

import signal
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from toolkit.errors import FREE_MEMORY, StageError, first_line


def kernel_error(error: Exception, ended_by: int | None, memory_mb: float, output: Path) -> StageError:
    """Return what to tell of a kernel that did not start, or that died."""
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
    where = f"\nThe executed notebook shows where: {output}"
    return StageError(text + where)


def kernel_class() -> Any:
    """Return a class of kernel managers that keeps how its kernel ended."""
    from jupyter_client.manager import AsyncKernelManager

    class Kernel(AsyncKernelManager):
        ended_by: int | None = None
        """Exit status, negative for a signal; None: no kernel has died."""

        async def is_alive(self) -> bool:  # type: ignore[override]
            status = await self.provisioner.poll() if self.provisioner else None
            type(self).ended_by = status or type(self).ended_by
            return bool(await super().is_alive())

    return Kernel


def end_children(folder: str) -> None:
    """End the kernel whose connection file lies in a folder: one that was starting when the run was interrupted."""
    import psutil

    for child in psutil.Process().children():
        with suppress(psutil.Error):
            if any(folder in part for part in child.cmdline()):
                child.kill()
                child.wait(5)


class MemoryWatch(threading.Thread):
    """Samples the memory of this process and its children, so that workers of a kernel count as well."""

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
        """End the sampling and return the highest sum seen, in MB."""
        self._ended.set()
        self.join()
        return self._peak_mb
