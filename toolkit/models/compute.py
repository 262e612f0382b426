"""Devices and precisions that networks run in, and batches that do not fit the memory of the device."""

import logging
import os
import platform
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from toolkit.errors import ManifestError, ToolkitError, first_line

if TYPE_CHECKING:
    import torch

# oneDNN keeps what it made for each shape, and images differ in their numbers of features: 1,024 shapes, its default,
# take gigabytes. It reads this when it is first used.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "64")
Item = TypeVar("Item")
Result = TypeVar("Result")

log = logging.getLogger(__name__)

DEVICE_NAME = r"auto|cpu|mps|cuda(:\d+)?"
"""Regular expression of the names of devices."""
PRECISIONS = ("auto", "float32", "bfloat16", "float16")


def resolve_device(name: str = "auto") -> "torch.device":
    """Return the device that `auto`, `cpu`, `cuda`, `cuda:<i>` or `mps` stands for.

    `auto`: the first GPU, else Apple's, else the CPU.

    Raises:
        ManifestError: another name.
        ToolkitError: torch finds no such device on this machine.
    """
    import torch

    if not re.fullmatch(DEVICE_NAME, name):
        raise ManifestError(f"compute_device is {name!r}; expected auto, cpu, cuda, cuda:<number> or mps.")
    # Where the driver is too old for this torch, GPUs are counted and cannot be used.
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
    """Return the type in which a network computes.

    `auto`: bfloat16 where the device multiplies it natively (GPUs since Ampere; CPUs with AMX or AVX512-BF16),
    float16 on older GPUs, else float32.

    Raises:
        ManifestError: not one of `PRECISIONS`.
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
    """Tell whether a device is, or `auto` would be, another than the CPU; imports torch only if there may be one."""
    if name == "auto" and sys.platform == "linux":
        drivers = ("nvidiactl", "kfd", "dxg")
        if not any(Path("/dev", driver).exists() for driver in drivers):
            return False
    return resolve_device(name).type != "cpu"


def precision_of_matches(name: str, device: "torch.device") -> "torch.dtype":
    """Return the type in which networks for local features compute: as `resolve_precision`, but on a CPU `auto` is
    float32, so that equal photographs give equal matches on any of them. bfloat16 changes a few percent of the matches.
    """
    return resolve_precision("float32" if name == "auto" and device.type == "cpu" else name, device)


def cpu_multiplies_bfloat16() -> bool:
    """Tell whether this CPU has instructions for products of bfloat16 matrices: AMX or AVX512-BF16.

    Other CPUs emulate them, some ten times slower than float32.
    """
    import torch

    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    # torch before 2.8 has no list of capabilities, but can tell AMX.
    amx = getattr(torch.cpu, "_is_amx_tile_supported", bool)()
    return bool(amx or capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))


def has_onednn(x: "torch.Tensor") -> bool:
    """Tell whether `linear` uses oneDNN for this tensor."""
    import torch

    if (
        x.device.type != "cpu"
        or torch.is_grad_enabled()
        or not torch.backends.mkldnn.is_available()
        or platform.machine().lower() not in ("x86_64", "amd64")
        or not hasattr(torch.ops.mkldnn, "_linear_pointwise")
    ):
        return False
    # Few processors have products of float16; without AVX-512 there are none of bfloat16.
    return x.dtype == torch.float32 or (x.dtype == torch.bfloat16 and torch.ops.mkldnn._is_mkldnn_bf16_supported())


def linear(x: "torch.Tensor", weight: "torch.Tensor", bias: "torch.Tensor | None" = None) -> "torch.Tensor":
    """Return `torch.nn.functional.linear(x, weight, bias)`, which have one type; `weight` is contiguous or transposed.

    On a CPU, torch leaves products in float32 to MKL, which does not use AVX-512 on processors of AMD: oneDNN, which
    torch uses for bfloat16 and in compiled models, is then twice as fast.
    """
    import torch
    import torch.nn.functional as F

    if has_onednn(x):
        product: torch.Tensor = torch.ops.mkldnn._linear_pointwise(x.contiguous(), weight, bias, "none", [], "")
        return product
    return F.linear(x, weight, bias)


def in_single_threads(run: "Callable[[Item], Result]", items: "Iterable[Item]") -> "list[Result]":
    """Return `run(item)` of each item on the CPU: several at a time, each with a single thread of torch.

    Threads within operations wait for each other, long where cores are shared; and what they compute differs in the
    last digits with their number. Items by themselves do neither.
    """
    import torch

    def run_one(item: Item) -> Result:
        with torch.inference_mode():  # each thread has a mode of its own
            return run(item)

    threads = torch.get_num_threads()
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        results = list(pool.map(run_one, items))
    torch.set_num_threads(threads)  # also of threads that are not started yet
    return results


def upload(batch: "torch.Tensor", device: "torch.device") -> "torch.Tensor":
    """Return a tensor of the CPU on a device.

    To a GPU it is copied from page-locked memory, on a stream of its own: a thread can do this while the network runs
    on another batch. The copy is complete when this returns.
    """
    import torch

    if device.type != "cuda":
        return batch.to(device)
    stream = _copy_stream(device)
    with torch.cuda.stream(stream):
        copied = batch.pin_memory().to(device, non_blocking=True)
    stream.synchronize()
    # Its memory is of the stream of copies, which shall not have it back before the network is done with it.
    copied.record_stream(torch.cuda.current_stream(device))
    return copied


def on_device(model: "torch.nn.Module", device: "torch.device", title: str) -> "torch.nn.Module":
    """Return a network that was moved to a device; `title` is its name, for messages.

    Raises:
        ToolkitError: the device's memory does not hold its weights.
    """
    try:
        return model.to(device)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        reason = first_line(error)
    raise ToolkitError(
        f"The memory of {device} does not hold the weights of {title} ({reason}). Free some, use dtype_compute: "
        "bfloat16, or compute_device: cpu."
    )


def free_bytes(device: "torch.device") -> int:
    """Return the memory of a device that nobody uses; of Apple's, that of the machine."""
    import psutil
    import torch

    if device.type == "cuda":
        # What torch has reserved and not handed out is as good as free.
        reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return int(torch.cuda.mem_get_info(device)[0]) + reserved
    return int(psutil.virtual_memory().available)


@contextmanager
def full_float32(device: "torch.device") -> Iterator[None]:
    """Multiply float32 as float32 on a GPU, whatever the process has chosen; then as before.

    By its default, cuDNN rounds what a convolution multiplies to TF32, which has the 10 bits of float16.
    """
    import torch

    cudnn: Any = torch.backends.cudnn
    matmul: Any = torch.backends.cuda.matmul
    # torch 2.9 has new flags; with them set, the older ones cannot be read.
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


@cache
def _copy_stream(device: "torch.device") -> "torch.cuda.Stream":
    """Return the stream for copies to a GPU: one, as torch keeps memory apart for each stream that had some."""
    import torch

    return torch.cuda.Stream(device)


class Fitting:
    """Runs a function on a device; splits batches into smaller parts once one did not fit its memory."""

    def __init__(self, run: "Callable[..., torch.Tensor]", what: str, device: "torch.device | None" = None) -> None:
        """`run` maps (B, ...), and what else it takes, to (B, ...), each row on its own; `what` the rows are, in the
        plural, is for messages."""
        self._run = run
        self._device = device
        self._what = what
        self._limit: int | None = None

    def __call__(self, batch: "torch.Tensor", *others: "torch.Tensor") -> "torch.Tensor":
        """Return `run(batch, *others)`; halves the batch as often as needed, logs a warning, and remembers the size
        that fits.

        A batch that is elsewhere is moved to the device by parts; others (B, ...) are cut alike and stay where they
        are. float32 is computed in full, see `full_float32`.

        Raises:
            ToolkitError: not even one row fits.
        """
        import torch

        parts = []
        start = 0
        device = self._device or batch.device
        while start < len(batch):
            count = min(self._limit or len(batch), len(batch) - start)
            try:
                with full_float32(device):
                    part = slice(start, start + count)
                    parts.append(self._run(batch[part].to(device), *(other[part] for other in others)))
                start += count
                continue
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
                reason = first_line(error)
            # Outside the handler, where the traceback would keep the tensors of the failed attempt alive.
            if count == 1:
                raise ToolkitError(
                    f"The memory of {device} does not hold the network with one of the {self._what} "
                    f"({reason}). Use a smaller image_size, dtype_compute: bfloat16, or compute_device: cpu."
                )
            self._limit = count // 2
            log.warning("%d %s do not fit the memory of %s, going on with %d at a time",
                        count, self._what, device, self._limit)  # fmt: skip
            if device.type == "cuda":
                torch.cuda.empty_cache()
        return parts[0] if len(parts) == 1 else torch.cat(parts)


_NO_MEMORY = re.compile(
    r"out of memory|can't allocate memory|CU(BLAS|DNN|SOLVER|SPARSE)_STATUS_ALLOC_FAILED"
    r"|unable to find an engine|Invalid buffer size", re.IGNORECASE
)  # fmt: skip
"""What CUDA's libraries, cuDNN without room for any of its engines, Metal and the CPU's allocator say."""


def is_out_of_memory(error: Exception) -> bool:
    """Tell whether torch says by an error that a device's memory does not suffice."""
    import torch

    return isinstance(error, torch.OutOfMemoryError) or bool(_NO_MEMORY.search(str(error)))
