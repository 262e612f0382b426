"""Devices, precisions, and batches that do not fit."""

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Self
from unittest.mock import MagicMock, call

import pytest
import torch

from toolkit.errors import ManifestError, ToolkitError
from toolkit.models import compute
from toolkit.models.compute import (
    Fitting,
    full_float32,
    in_single_threads,
    linear,
    on_device,
    resolve_device,
    resolve_precision,
    upload,
)


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:x", "cuda0", "", "CPU", "xpu"])
def test_unknown_devices(name: str) -> None:
    with pytest.raises(ManifestError, match=f"compute_device is {name!r}"):
        resolve_device(name)


def test_auto_is_a_device_that_is_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert resolve_device("auto").type == "cpu"
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert resolve_device("auto").type == "cpu", "GPUs that the driver is too old for"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert resolve_device("auto").type == "cuda"
    assert resolve_device("cuda:1").index == 1


@pytest.mark.parametrize(("gpus", "asked", "named"), [
    (0, "cuda", "compute_device is cuda"),
    (0, "mps", "compute_device is mps"),
    (2, "cuda:2", "cuda:2.*cuda:0 to cuda:1"),
])  # fmt: skip
def test_devices_that_are_not_here_are_refused(
    gpus: int, asked: str, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(ToolkitError, match=named):
        resolve_device(asked)


def test_precisions(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    assert resolve_precision("float16", cpu) == torch.float16
    monkeypatch.setattr("toolkit.models.compute.cpu_multiplies_bfloat16", lambda: True)
    assert resolve_precision("auto", cpu) == torch.bfloat16
    monkeypatch.setattr("toolkit.models.compute.cpu_multiplies_bfloat16", lambda: False)
    assert resolve_precision("auto", cpu) == torch.float32
    assert resolve_precision("auto", torch.device("mps")) == torch.float32
    for capability, expected in {(7, 5): torch.float16, (8, 0): torch.bfloat16, (9, 0): torch.bfloat16}.items():
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _, value=capability: value)
        assert resolve_precision("auto", gpu) == expected
    with pytest.raises(ManifestError, match="dtype_compute is 'half'"):
        resolve_precision("half", cpu)


def test_on_the_cpu_nothing_is_copied() -> None:
    batch = torch.arange(6).reshape(2, 3)
    assert upload(batch, torch.device("cpu")) is batch


def test_a_gpu_is_sent_page_locked_memory_beside_what_it_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    """No GPU is asked: what is called, in which order, and that the copies have one stream of their own."""
    gpu, device = MagicMock(), torch.device("cuda:1")
    for name in ("Stream", "stream", "current_stream"):
        monkeypatch.setattr(torch.cuda, name, getattr(gpu, name))
    compute._copy_stream.cache_clear()
    sent = gpu.batch.pin_memory().to()
    gpu.reset_mock()
    assert upload(gpu.batch, device) is upload(gpu.batch, device) is sent
    compute._copy_stream.cache_clear()
    once = [
        call.stream(gpu.Stream()),
        call.stream().__enter__(),
        call.batch.pin_memory(),
        call.batch.pin_memory().to(device, non_blocking=True),
        call.stream().__exit__(None, None, None),
        call.Stream().synchronize(),
        call.current_stream(device),
        call.batch.pin_memory().to().record_stream(gpu.current_stream()),
    ]
    assert gpu.mock_calls[: len(once) + 1] == [call.Stream(device), *once]
    assert gpu.mock_calls.count(call.Stream(device)) == 1


class Memory:
    """A network that holds `most` rows."""

    def __init__(self, most: int, message: str = "CUDA out of memory. Tried to allocate 2 GiB") -> None:
        self.most, self.message = most, message
        self.tried: list[int] = []

    def __call__(self, batch: torch.Tensor) -> torch.Tensor:
        self.tried.append(len(batch))
        if len(batch) > self.most:
            raise torch.OutOfMemoryError(self.message)
        return batch * 2


def test_a_batch_that_does_not_fit_is_halved(caplog: pytest.LogCaptureFixture) -> None:
    memory = Memory(3)
    fitting = Fitting(memory, "images")
    batch = torch.arange(10)
    with caplog.at_level(logging.WARNING):
        torch.testing.assert_close(fitting(batch), batch * 2)
    assert memory.tried == [10, 5, 2, 2, 2, 2, 2]
    assert "10 images do not fit the memory of cpu, continuing with 5" in caplog.text
    torch.testing.assert_close(fitting(batch), batch * 2)
    assert memory.tried[7:] == [2, 2, 2, 2, 2], "what fits is remembered"


def test_not_even_one_row_fits() -> None:
    with pytest.raises(ToolkitError, match=r"images.*Tried to allocate.*image_size"):
        Fitting(Memory(0), "images")(torch.arange(3))


@pytest.mark.parametrize(
    "message",
    [
        "DefaultCPUAllocator: can't allocate memory",
        "MPS backend out of memory",
        "Invalid buffer size: 24.00 GiB",
        "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
        "cuDNN error: CUDNN_STATUS_ALLOC_FAILED",
        "GET was unable to find an engine to execute this computation",
    ],
)
def test_other_devices_say_it_in_words(message: str) -> None:
    tried: list[int] = []

    def run(batch: torch.Tensor) -> torch.Tensor:
        tried.append(len(batch))
        if len(batch) > 2:
            raise RuntimeError(message)
        return batch

    assert len(Fitting(run, "images")(torch.arange(4))) == 4
    assert tried == [4, 2, 2]


class Full(torch.nn.Module):
    """A network that a device has no room for, or does not know."""

    def __init__(self, message: str) -> None:
        super().__init__()
        self.message = message

    def to(self, *_: object) -> Self:
        raise RuntimeError(self.message)


@pytest.mark.parametrize(("text", "error", "named"), [
    ("CUDA out of memory. Tried to allocate 2 GiB", ToolkitError,
     "memory of cuda:0.*weights of VGGT.*Tried to allocate"),
    ("no kernel image is available", RuntimeError, "no kernel image"),
])  # fmt: skip
def test_weights_that_do_not_fit(text: str, error: type[Exception], named: str) -> None:
    with pytest.raises(error, match=named):
        on_device(Full(text), torch.device("cuda:0"), "VGGT")


def test_a_gpu_multiplies_float32_in_full_and_then_as_before() -> None:
    flags = [torch.backends.cudnn.conv, torch.backends.cuda.matmul]
    before = [owner.fp32_precision for owner in flags]
    assert before[0] == "tf32", "cuDNN's default"
    with full_float32(torch.device("cuda")):
        assert [owner.fp32_precision for owner in flags] == ["ieee", "ieee"]
    assert [owner.fp32_precision for owner in flags] == before
    assert torch.get_float32_matmul_precision() == "highest"


def test_a_batch_is_moved_by_the_parts_that_fit() -> None:
    """On a device without memory for any numbers, that of `torch.device("meta")`, where they are stays to be seen."""
    seen: list[tuple[int, str]] = []

    def run(batch: torch.Tensor) -> torch.Tensor:
        seen.append((len(batch), batch.device.type))
        if len(batch) > 2:
            raise torch.OutOfMemoryError
        return batch

    Fitting(run, "images", torch.device("meta"))(torch.arange(4))
    assert seen == [(4, "meta"), (2, "meta"), (2, "meta")]


@pytest.mark.parametrize(
    "through",
    [lambda run: Fitting(run, "images")(torch.arange(1)), lambda run: in_single_threads(run, [torch.arange(1)])],
    ids=["Fitting", "in_single_threads"],
)
def test_networks_of_several_threads_run_one_after_the_other(through: Callable[[Callable], object]) -> None:
    running: list[int] = []
    together: list[int] = []

    def run(batch: torch.Tensor) -> torch.Tensor:
        running.append(1)
        time.sleep(0.02)
        together.append(len(running))
        running.pop()
        return batch

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: through(run), range(4)))
    assert together == [1] * 4


def test_an_error_does_not_leave_later_threads_with_one_thread_of_torch() -> None:
    def threads_of_new_thread() -> int:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(torch.get_num_threads).result()

    def fail(_: int) -> int:
        raise ArithmeticError

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(ArithmeticError):
            in_single_threads(fail, range(2))
        assert threads_of_new_thread() == 3
    finally:
        torch.set_num_threads(before)


def test_a_layer_in_any_precision() -> None:
    x, weight, bias = torch.rand(3, 5), torch.rand(4, 5), torch.rand(4)
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        with torch.inference_mode():
            found = linear(x.to(dtype), weight.to(dtype), bias.to(dtype))
        torch.testing.assert_close(found.float(), x @ weight.T + bias, atol=2e-2, rtol=2e-2)


def test_a_layer_in_bfloat16_on_a_processor_that_onednn_has_no_product_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: False)
    monkeypatch.setattr(torch.ops.mkldnn, "_linear_pointwise", MagicMock(side_effect=RuntimeError("no primitive")))
    x, weight = torch.rand(3, 5).bfloat16(), torch.rand(4, 5).bfloat16()
    with torch.inference_mode():
        torch.testing.assert_close(linear(x, weight), x @ weight.T)


def test_other_errors_are_not_taken_for_it() -> None:
    def run(_: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("shapes do not fit")

    with pytest.raises(RuntimeError):
        Fitting(run, "images")(torch.arange(4))
