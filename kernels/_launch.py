"""Helpers of all kernel files: Warp views of torch's tensors, and launches on torch's stream."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
import warp as wp
from torch import Tensor


def array(tensor: Tensor | None, like: Tensor, dtype: torch.dtype = torch.float32) -> Any:
    """Returns a Warp view of a tensor, with its strides and without a copy.

    For None, returns an empty array of `dtype` on the device of `like`: Warp requires an array argument, but kernels do
    not read this one.
    """
    if tensor is None:
        tensor = like.new_empty(0, dtype=dtype)
    if tensor.dtype == torch.bool:
        tensor = tensor.view(torch.uint8)
    # PyTorch's dispatcher would resolve the negative bit of a tensor, but most calls of ops bypass the dispatcher.
    return wp.from_torch(tensor.detach().resolve_neg())


def filled(struct: Any, **fields: Any) -> Any:
    """Sets fields of a struct to numbers, or to views of tensors, and returns the struct."""
    for name, value in fields.items():
        setattr(struct, name, array(value, value) if isinstance(value, Tensor) else value)
    return struct


def of_both_dtypes(kernel: Any) -> None:
    """Registers overloads of a kernel for float32 and for float64 arguments ``points`` and ``centres``.

    Registered overloads are compiled together with the other kernels of the file.
    """
    for scalar in (wp.float32, wp.float64):
        wp.overload(kernel, dict.fromkeys(("points", "centres"), wp.array2d(dtype=scalar)))


def on_stream(tensor: Tensor) -> AbstractContextManager[Any]:
    """Returns a context in which Warp uses torch's current stream, for calls without a stream argument."""
    if not tensor.is_cuda:
        return nullcontext()
    context: AbstractContextManager[Any] = wp.ScopedStream(wp.stream_from_torch(tensor.device), sync_enter=False)
    return context


def launch(kernel: Any, threads: int | Sequence[int], inputs: Sequence[Any], tensor: Tensor) -> None:
    """Runs a kernel on a tensor's device and torch's current stream; with 0 threads it is a no-op."""
    if (threads if isinstance(threads, int) else min(threads)) == 0:
        return
    stream = wp.stream_from_torch(tensor.device) if tensor.is_cuda else None
    wp.launch(kernel, dim=threads, inputs=inputs, device=wp.device_from_torch(tensor.device), stream=stream)


def launch_tiles(kernel: Any, tiles: int, threads: int, inputs: Sequence[Any], tensor: Tensor) -> None:
    """Runs a kernel as `launch` does, with a block of threads for each tile."""
    if tiles == 0:
        return
    stream = wp.stream_from_torch(tensor.device) if tensor.is_cuda else None
    device = wp.device_from_torch(tensor.device)
    wp.launch_tiled(kernel, dim=[tiles], inputs=inputs, block_dim=threads, device=device, stream=stream)
