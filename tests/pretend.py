"""A device that is not there: tensors that hold their numbers on the CPU and refuse what an accelerator refuses.

It refuses operations on tensors of two devices, numbers in float64 (Apple's GPUs) and `.numpy()`. It stands behind
the name of a type of device that torch knows and brings no code for.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only

DEVICE = torch.device("lazy:0")
_BETWEEN_DEVICES = ("aten::_to_copy", "aten::copy_")


class PretendTensor(torch.Tensor):
    """A tensor on the device."""

    held: torch.Tensor
    """Its numbers, on the CPU."""

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> "PretendTensor":
        if held.dtype == torch.float64:
            raise TypeError("the device has no float64")
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, held.size(), device=DEVICE, **layout)
        made.held = held
        return made

    def __repr__(self, *_: Any, **__: Any) -> str:
        return f"PretendTensor({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, operation: Any, _: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {})


class _Pretending(TorchDispatchMode):
    """Makes tensors of the device where those of the CPU are moved there, or new ones are asked for there."""

    def __torch_dispatch__(self, operation: Any, _: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {})


class _FromNumbers(TorchFunctionMode):
    """Makes tensors of Python's numbers on the CPU and moves them: torch makes them below the other mode."""

    def __torch_function__(self, function: Any, _: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if function is torch.Tensor.new_tensor:
            return torch.tensor(*args[1:], dtype=kwargs.get("dtype", args[0].dtype)).to(args[0].device)
        if function is torch.tensor and kwargs.get("device") is not None:
            device = kwargs.pop("device")
            return torch.tensor(*args, **kwargs).to(device)
        return function(*args, **kwargs)


def _run(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name, tensors = operation._schema.name, [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
    there = any(isinstance(x, PretendTensor) for x in tensors)
    elsewhere = [x for x in tensors if not isinstance(x, PretendTensor) and x.ndim]
    if there and elsewhere and name not in _BETWEEN_DEVICES:
        raise RuntimeError(f"{name}: expected all tensors to be on the same device, found {DEVICE} and cpu")
    held_args, held_kwargs = tree_map_only(PretendTensor, lambda x: x.held, (args, kwargs))
    if held_kwargs.get("device") is not None:
        there = torch.device(held_kwargs["device"]).type == DEVICE.type
        held_kwargs["device"] = torch.device("cpu")
    if name == "aten::copy_":
        there = isinstance(args[0], PretendTensor)
    found = operation(*held_args, **held_kwargs)
    if not there:
        return found
    # What works in place returns the tensor that it was given.
    given = {id(x.held): x for x in tensors if isinstance(x, PretendTensor)}
    return tree_map_only(torch.Tensor, lambda x: given[id(x)] if id(x) in given else PretendTensor(x), found)


@contextmanager
def pretending() -> Iterator[None]:
    """Let tensors be moved to `DEVICE` and made there, in this thread."""
    with _Pretending(), _FromNumbers():
        yield


def resolved(_: str = "auto") -> torch.device:
    """Stand for `resolve_device`."""
    return DEVICE
