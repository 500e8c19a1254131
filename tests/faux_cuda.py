"""A CUDA device for machines without one: its tensors refuse what CUDA refuses.

The values lie in CPU memory and the arithmetic is the CPU's, so that results can be compared; what
is tested is where tensors live. As on a GPU an operation on tensors of two devices is an error,
except those that CUDA allows (numbers of no dimension, copies, indices that lie on the CPU), and so
is NumPy's view of a tensor that was not brought back. Code that asks for the device is told "cuda"
and takes its paths for that. What this cannot tell: speed, memory, streams and graphs, and how
CUDA's own kernels round.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import torch
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

CUDA = torch.device("cuda", 0)
aten = torch.ops.aten
#: Operations between devices that CUDA allows.
_ACROSS = {aten.copy_.default, aten._to_copy.default}
#: Likewise of a tensor on the GPU with indices on the CPU.
_INDEXED = {
    aten.index.Tensor,
    aten.index_put.default,
    aten.index_put_.default,
    aten._index_put_impl_.default,
}
#: What the driver would be asked for.
_DRIVER = {
    "is_available": lambda: True,
    "device_count": lambda: 1,
    "set_device": lambda _: None,
    "device": lambda _: contextlib.nullcontext(),
    "is_bf16_supported": lambda **_: True,
    "synchronize": lambda *_: None,
    "empty_cache": lambda: None,
    "reset_peak_memory_stats": lambda *_: None,
    "max_memory_allocated": lambda *_: 0,
}


class FauxCuda(torch.Tensor):
    """A tensor of the device; `held` are its values. Torch itself takes it for one of "meta"."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> FauxCuda:
        return torch.Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device="meta",
        )

    def __init__(self, held: torch.Tensor) -> None:
        self.held = held

    device = property(lambda self: CUDA)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)
    is_meta = property(lambda self: False)

    def __repr__(self, **_: Any) -> str:
        return f"FauxCuda({self.held})"

    def numpy(self, **_: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def __array__(self, *_: Any, **__: Any) -> Any:
        return self.numpy()

    def tolist(self) -> Any:
        return self.held.tolist()

    # Torch puts the numbers of a list onto what it takes for the device, where they have no values.
    def __getitem__(self, index: Any) -> torch.Tensor:
        return super().__getitem__(_indices(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(_indices(index), value)

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(func, args, kwargs or {})


def _indices(index: Any) -> Any:
    if isinstance(index, tuple):
        return tuple(_indices(part) for part in index)
    return FauxCuda(torch.tensor(index)) if isinstance(index, list) else index


class _Device(TorchDispatchMode):
    # That of FakeTensorMode: with it torch does not look for a driver.
    _mode_key = torch._C._TorchDispatchModeKey.FAKE

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(func, args, kwargs or {})


def _dispatch(func: Any, args: Any, kwargs: Any) -> Any:
    # Inference mode asks for operations as a whole that are otherwise asked for part by part.
    if torch._C._dispatch_has_kernel_for_dispatch_key(func.name(), "CompositeImplicitAutograd"):
        with _Device():
            return func.decompose(*args, **kwargs)
    return _run(func, args, kwargs)


# Tensors of inference mode have no versions, which wrapped ones want.
@torch.inference_mode(mode=False)
@torch.no_grad()
def _run(func: Any, args: Any, kwargs: Any) -> Any:
    """`func` of the values held, on the device where CUDA would have the result."""
    tensors = [a for a in tree_leaves((args, kwargs)) if isinstance(a, torch.Tensor)]
    there = [isinstance(t, FauxCuda) for t in tensors]
    if any(t.is_meta for t in tensors):
        raise RuntimeError(f"{func}: a tensor without values")
    if any(there) and not all(there) and func not in _ACROSS:
        strangers = [t for t, on in zip(tensors, there, strict=True) if not on and t.ndim]
        if strangers and not (func in _INDEXED and there[0]):
            raise RuntimeError(f"{func}: expected all tensors to be on the same device")
    asked = kwargs.get("device")
    if asked is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if func is aten.copy_.default:
        onto = there[0]
    elif asked is not None:
        onto = torch.device(asked).type in ("cuda", "meta")  # "meta": that of a FauxCuda
    else:
        onto = any(there)

    def held(a: Any) -> Any:
        return a.held if isinstance(a, FauxCuda) else a

    found = func(*tree_map(held, args), **tree_map(held, kwargs))
    if not onto:
        return found
    found = tree_map(lambda a: FauxCuda(a) if isinstance(a, torch.Tensor) else a, found)
    return return_and_correct_aliasing(func, args, kwargs, found) if any(there) else found


def _numbered(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `function`, which would ask the driver for the number of a device that has none: it is 0.
    Of `x.to(y)` the device is that of y, which torch takes for "meta"."""

    def name(a: Any) -> Any:
        return CUDA if isinstance(a, (str, torch.device)) and str(a) == "cuda" else a

    def asked(*args: Any, **kwargs: Any) -> Any:
        if len(args) == 2 and isinstance(args[1], FauxCuda):
            args = (args[0], CUDA, args[1].dtype)
        return function(*tree_map(name, args), **tree_map(name, kwargs))

    return asked


@contextlib.contextmanager
def faux_cuda() -> Iterator[None]:
    """Within it the device "cuda" is there, for this thread."""
    torch._C._ensureCUDADeviceGuardSet()
    lifted = torch._C._only_lift_cpu_tensors()
    with contextlib.ExitStack() as stack:
        for name, function in _DRIVER.items():
            stack.enter_context(mock.patch.object(torch.cuda, name, function))
        for owner, name in ((torch.Tensor, "to"), (torch, "tensor"), (torch, "as_tensor")):
            asked = _numbered(getattr(owner, name))
            stack.enter_context(mock.patch.object(owner, name, asked))
        stack.callback(torch._C._set_only_lift_cpu_tensors, lifted)
        torch._C._set_only_lift_cpu_tensors(True)
        stack.enter_context(_Device())
        yield


def on_both(run: Callable[[str], Any]) -> tuple[Any, Any]:
    """What `run`, given the name of a device, makes on the CPU and on the stand-in."""
    here = run("cpu")
    with faux_cuda():
        return here, run("cuda")
