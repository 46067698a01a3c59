"""What the kernels' files share: views of torch's tensors, and launches on torch's stream."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
import warp as wp
from torch import Tensor


def array(tensor: Tensor | None, like: Tensor, dtype: torch.dtype = torch.float32) -> Any:
    """A view of a tensor with its strides, without a copy; for None an empty array of a dtype, on the device of `like`.

    Kernels do not read an absent array, but Warp needs one.
    """
    if tensor is None:
        tensor = like.new_empty(0, dtype=dtype)
    if tensor.dtype == torch.bool:
        tensor = tensor.view(torch.uint8)
    return wp.from_torch(tensor.detach().resolve_neg())  # which torch leaves to ops that take lists


def filled(struct: Any, **fields: Any) -> Any:
    """A struct with values in these fields: views of tensors, or numbers."""
    for name, value in fields.items():
        setattr(struct, name, array(value, value) if isinstance(value, Tensor) else value)
    return struct


def of_both_dtypes(kernel: Any) -> None:
    """Has a kernel of points and centres compiled for float32 and float64 when its file is."""
    for scalar in (wp.float32, wp.float64):
        wp.overload(kernel, dict.fromkeys(("points", "centres"), wp.array2d(dtype=scalar)))


def on_stream(tensor: Tensor) -> AbstractContextManager[Any]:
    """Makes torch's current stream Warp's, for calls without a stream argument."""
    if not tensor.is_cuda:
        return nullcontext()
    context: AbstractContextManager[Any] = wp.ScopedStream(wp.stream_from_torch(tensor.device), sync_enter=False)
    return context


def launch(kernel: Any, threads: int | Sequence[int], inputs: Sequence[Any], tensor: Tensor) -> None:
    """Runs a kernel on the device of a tensor, on torch's current stream; with 0 threads it launches nothing."""
    if (threads if isinstance(threads, int) else min(threads)) == 0:
        return
    stream = wp.stream_from_torch(tensor.device) if tensor.is_cuda else None
    wp.launch(kernel, dim=threads, inputs=inputs, device=wp.device_from_torch(tensor.device), stream=stream)


def launch_tiles(kernel: Any, tiles: int, threads: int, inputs: Sequence[Any], tensor: Tensor) -> None:
    """Runs a kernel with a block of threads for each tile; otherwise as `launch`."""
    if tiles == 0:
        return
    stream = wp.stream_from_torch(tensor.device) if tensor.is_cuda else None
    device = wp.device_from_torch(tensor.device)
    wp.launch_tiled(kernel, dim=[tiles], inputs=inputs, block_dim=threads, device=device, stream=stream)
