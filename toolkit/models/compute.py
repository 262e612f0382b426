"""Devices and precisions of the networks, and batches that do not fit the memory of the device."""

import logging
import os
import platform
import re
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from toolkit.errors import ManifestError, ToolkitError, first_line

if TYPE_CHECKING:
    import torch

# oneDNN caches a primitive for each input shape, and images differ in their number of features: its default of 1,024
# primitives takes gigabytes. It reads this variable at its first use.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "64")
Item = TypeVar("Item")
Result = TypeVar("Result")

log = logging.getLogger(__name__)

DEVICE_NAME = r"auto|cpu|mps|cuda(:\d+)?"
"""Regular expression of device names."""
PRECISIONS = ("auto", "float32", "bfloat16", "float16")
RUNNING = threading.RLock()
"""Held while a network runs. Networks in several threads at once would need their memory together, and would restore
the settings of torch (`full_float32`, `without_cudnn`, number of threads) that another has set."""


def resolve_device(name: str = "auto") -> "torch.device":
    """Return the device named `auto` (the first GPU, else Apple's, else the CPU), `cpu`, `cuda`, `cuda:<i>` or `mps`.

    Raise ManifestError for an unknown name; ToolkitError if torch finds no such device on this machine.
    """
    import torch

    if not re.fullmatch(DEVICE_NAME, name):
        raise ManifestError(f"compute_device is {name!r}; expected auto, cpu, cuda, cuda:<number> or mps.")
    # With a driver too old for this torch, torch counts GPUs that it cannot use.
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    apple = torch.backends.mps.is_available()
    if name == "auto":
        name = "cuda" if gpus else "mps" if apple else "cpu"
    kind, _, number = name.partition(":")
    if kind == "cuda" and int(number or 0) >= gpus:
        seen = f"{gpus} GPU{'s' if gpus > 1 else ''}, cuda:0 to cuda:{gpus - 1}" if gpus else "no GPU"
        raise ToolkitError(f"compute_device is {name}, but torch sees {seen}. Set compute_device: auto or cpu.")
    if kind == "mps" and not apple:
        raise ToolkitError("compute_device is mps, but torch sees no Apple GPU. Set compute_device: auto or cpu.")
    return torch.device(name)


def resolve_precision(name: str, device: "torch.device") -> "torch.dtype":
    """Return the data type in which a network computes; raise ManifestError for none of `PRECISIONS`.

    `auto`: bfloat16 where the device multiplies it natively (GPUs since Ampere; CPUs with AMX or AVX512-BF16), float16
    on older GPUs, else float32.
    """
    import torch

    if name not in PRECISIONS:
        raise ManifestError(f"dtype_compute is {name!r}; expected one of {', '.join(PRECISIONS)}.")
    if name != "auto":
        dtype: torch.dtype = getattr(torch, name)
        return dtype
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.get_device_capability(device) >= (8, 0) else torch.float16
    return torch.bfloat16 if device.type == "cpu" and cpu_multiplies_bfloat16() else torch.float32


def has_accelerator(name: str) -> bool:
    """Tell whether a device name resolves to another device than the CPU; imports torch only if there may be one."""
    if name == "auto" and sys.platform == "linux":
        drivers = ("nvidiactl", "kfd", "dxg")
        if not any(Path("/dev", driver).exists() for driver in drivers):
            return False
    return resolve_device(name).type != "cpu"


def cpu_multiplies_bfloat16() -> bool:
    """Tell whether this CPU has instructions for bfloat16 matrix products: AMX or AVX512-BF16.

    Other CPUs emulate them, about ten times slower than float32.
    """
    import torch

    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    # torch before 2.8 does not list capabilities, but detects AMX.
    amx = getattr(torch.cpu, "_is_amx_tile_supported", bool)()
    return bool(amx or capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))


def has_onednn(x: "torch.Tensor") -> bool:
    """Tell whether `linear` can use oneDNN for this tensor."""
    import torch

    if (
        x.device.type != "cpu"
        or torch.is_grad_enabled()
        or not torch.backends.mkldnn.is_available()
        or platform.machine().lower() not in ("x86_64", "amd64")
        or not hasattr(torch.ops.mkldnn, "_linear_pointwise")
    ):
        return False
    # Few CPUs multiply float16, and oneDNN multiplies bfloat16 only with AVX-512.
    return x.dtype == torch.float32 or (x.dtype == torch.bfloat16 and torch.ops.mkldnn._is_mkldnn_bf16_supported())


def linear(x: "torch.Tensor", weight: "torch.Tensor", bias: "torch.Tensor | None" = None) -> "torch.Tensor":
    """Return `torch.nn.functional.linear(x, weight, bias)`, through oneDNN if possible.

    On a CPU, torch multiplies float32 with MKL, which does not use AVX-512 on AMD processors. oneDNN, which torch uses
    for bfloat16, is then twice as fast.

    Args:
        x, weight, bias: of one data type; `weight` is contiguous, or the transpose of a contiguous matrix.
    """
    import torch
    import torch.nn.functional as F

    if has_onednn(x):
        product: torch.Tensor = torch.ops.mkldnn._linear_pointwise(x.contiguous(), weight, bias, "none", [], "")
        return product
    return F.linear(x, weight, bias)


def in_single_threads(run: "Callable[[Item], Result]", items: "Iterable[Item]") -> "list[Result]":
    """Return `run(item)` of each item on the CPU: several items at a time, each with a single torch thread.

    Threads within one operation wait for each other, long if other processes share the cores, and the last digits of
    their result depend on the number of threads. Running whole items in parallel avoids both.
    """
    import torch

    def run_one(item: Item) -> Result:
        with torch.inference_mode():  # the mode is per thread
            return run(item)

    with RUNNING:
        threads = torch.get_num_threads()
        try:
            with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
                return list(pool.map(run_one, items))
        finally:
            torch.set_num_threads(threads)  # restore it also for threads that start later


def upload(batch: "torch.Tensor", device: "torch.device") -> "torch.Tensor":
    """Copy a CPU tensor to a device.

    The copy to a GPU goes through page-locked memory on a separate stream, so a thread can upload a batch while the
    network runs on another. The copy is complete on return.
    """
    import torch

    if device.type != "cuda":
        return batch.to(device)
    stream = _copy_stream(device)
    with torch.cuda.stream(stream):
        copied = batch.pin_memory().to(device, non_blocking=True)
    stream.synchronize()
    # The memory belongs to the copy stream, which must not reuse it before the network is done with it.
    copied.record_stream(torch.cuda.current_stream(device))
    return copied


def on_device(model: "torch.nn.Module", device: "torch.device", title: str) -> "torch.nn.Module":
    """Move a network to a device; raise ToolkitError, with its title, if its weights do not fit the memory there."""
    try:
        return model.to(device)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        reason = first_line(error)
    do = "Free some, use dtype_compute: bfloat16, or compute_device: cpu."
    raise ToolkitError(f"The memory of {device} does not hold the weights of {title} ({reason}). {do}")


@contextmanager
def full_float32(device: "torch.device") -> Iterator[None]:
    """Multiply float32 in full precision on a GPU inside the context, whatever the process has set.

    By default, cuDNN rounds the factors in convolutions to TF32, which has 10 bits of mantissa like float16.
    """
    import torch

    cudnn: Any = torch.backends.cudnn
    matmul: Any = torch.backends.cuda.matmul
    # torch 2.9 has new flags; once they are set, reading the old ones fails.
    new = hasattr(cudnn, "conv")
    owners = [] if device.type != "cuda" else [cudnn.conv, matmul] if new else [cudnn, matmul]
    name, exact = ("fp32_precision", "ieee") if new else ("allow_tf32", False)
    before = [getattr(owner, name) for owner in owners]
    try:
        for owner in owners:
            setattr(owner, name, exact)
        yield
    finally:
        for owner, value in zip(owners, before, strict=True):
            setattr(owner, name, value)


@contextmanager
def without_cudnn() -> Iterator[None]:
    """Convolve on a GPU by matrix products, not with cuDNN, inside the context.

    For 3 x 3 convolutions in full float32, cuDNN may prefer Fourier transforms: for six maps of 256 x 84 x 148 they
    take 36 GB, and many times as long. Holds `RUNNING`, because the choice is that of the process.
    """
    import torch

    with RUNNING:
        before = torch.backends.cudnn.enabled
        try:
            torch.backends.cudnn.enabled = False
            yield
        finally:
            torch.backends.cudnn.enabled = before


@cache
def _copy_stream(device: "torch.device") -> "torch.cuda.Stream":
    """Return the stream for copies to a GPU. There is only one, because torch keeps separate memory for each stream."""
    import torch

    return torch.cuda.Stream(device)


class Fitting:
    """Runs a function on a device, one at a time; splits batches into smaller ones after one did not fit its memory."""

    def __init__(
        self, run: "Callable[[torch.Tensor], torch.Tensor]", what: str, device: "torch.device | None" = None
    ) -> None:
        """`run` maps a tensor (B, ...) to (B, ...), each row independently; `what` names the rows in the plural, for
        messages.

        Without a device, it runs on that of the batch.
        """
        self._run = run
        self._device = device
        self._what = what
        self._limit: int | None = None

    def __call__(self, batch: "torch.Tensor") -> "torch.Tensor":
        """Return `run(batch)`; raise ToolkitError if not even one row fits.

        If the batch does not fit, halves it as often as needed, logs a warning, and remembers the size that fits. Moves
        the parts of the batch to the device. Computes float32 in full precision, see `full_float32`.
        """
        import torch

        parts = []
        start = 0
        device = self._device or batch.device
        while start < len(batch):
            count = min(self._limit or len(batch), len(batch) - start)
            try:
                with RUNNING, full_float32(device):
                    parts.append(self._run(batch[start : start + count].to(device)))
                start += count
                continue
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
                reason = first_line(error)
            # Not in the handler, whose traceback would keep the tensors of the failed attempt alive.
            if count == 1:
                fault = f"The memory of {device} does not hold the network with one of the {self._what} ({reason})"
                do = "Use a smaller image_size, dtype_compute: bfloat16, or compute_device: cpu."
                raise ToolkitError(f"{fault}. {do}")
            self._limit = count // 2
            log.warning("%d %s do not fit the memory of %s, continuing with %d at a time",
                        count, self._what, device, self._limit)  # fmt: skip
            if device.type == "cuda":
                torch.cuda.empty_cache()
        return parts[0] if len(parts) == 1 else torch.cat(parts)


_NO_MEMORY = re.compile(
    r"out of memory|can't allocate memory|CU(BLAS|DNN|SOLVER|SPARSE)_STATUS_ALLOC_FAILED"
    r"|unable to find an engine|Invalid buffer size", re.IGNORECASE
)  # fmt: skip
"""Messages of CUDA's libraries, of cuDNN when none of its engines fits, of Metal, and of the CPU's allocator."""


def is_out_of_memory(error: Exception) -> bool:
    """Tell whether a torch error means that a device is out of memory."""
    import torch

    return isinstance(error, torch.OutOfMemoryError) or bool(_NO_MEMORY.search(str(error)))
