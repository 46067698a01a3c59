"""Linear layers of many cells on samples sorted by cell. n samples, k cells, i inputs, o outputs.

Three operators closed under differentiation, each one loop over cells of dense products into slices of one result:

    voronerf::grouped_linear   y[r] = W[c] x[r] + b[c]           for the rows r of cell c
    voronerf::grouped_outer    W[c] = sum over r of g[r] x[r]^T
    voronerf::grouped_sum      b[c] = sum over r of g[r]

The gradients of each are the other two, so derivatives of every order exist. The loops, and the reading of ``offsets``
on the host that they need, are inside the operators: ``torch.compile`` sees shapes alone.
``voronerf.reference.specification`` says the same in three lines.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from voronerf.reference.activation import FROM_OUTPUT, activate, activate_, times_derivative

PIECE = 4096
"""Most rows of one product: inputs and outputs of a piece stay in the second-level cache between product and
activation."""


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, *, activation: str = "none"
) -> Tensor:
    """Every sample through the layer of its cell; see ``voronerf.ops.grouped_linear``."""
    x, weight, bias = autocast(x, weight, bias)
    fused = activation if activation in FROM_OUTPUT else "none"
    y = torch.ops.voronerf.grouped_linear(x, offsets, weight, bias, fused)
    return y if fused == activation else activate(activation, y)


def autocast(x: Tensor, weight: Tensor, bias: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """The arguments in autocast's dtype, where it is on; float64 stays, as in torch's own layers."""
    kind = x.device.type
    if not torch.is_autocast_enabled(kind):
        return x, weight, bias
    dtype = torch.get_autocast_dtype(kind)
    x, weight = (tensor if tensor.dtype == torch.float64 else tensor.to(dtype) for tensor in (x, weight))
    return x, weight, None if bias is None else bias.to(weight.dtype)


def pieces(offsets: Tensor, rows: int, size: int) -> Iterator[tuple[int, slice]]:
    """Cells with samples, cut into slices of at most ``size`` rows. Reads ``offsets`` on the host."""
    bounds = offsets.tolist()
    if bounds[-1] > rows or any(low > high for low, high in itertools.pairwise(bounds)) or bounds[0] < 0:
        raise ValueError(f"offsets must rise from 0 or more to at most the number of rows, {rows}, got {bounds}")
    for cell, (low, high) in enumerate(itertools.pairwise(bounds)):
        for start in range(low, high, size):
            yield cell, slice(start, min(start + size, high))


def zero_strays(y: Tensor, offsets: Tensor) -> None:
    """Zeroes the rows that belong to no cell, before ``offsets[0]`` and from ``offsets[k]`` on."""
    first, last = int(offsets[0]), int(offsets[-1])
    y[:first].zero_()
    y[last:].zero_()


def compute_dtype(tensor: Tensor) -> torch.dtype:
    """What products run in. On a CPU torch's float16 products take minutes where float32 takes milliseconds."""
    if tensor.dtype == torch.float16 and tensor.device.type == "cpu":
        return torch.float32
    return tensor.dtype


@torch.library.custom_op("voronerf::grouped_linear", mutates_args=())
def _linear(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    dtype = compute_dtype(x)
    y = x.new_empty(x.shape[0], weight.shape[1])
    transposed = weight.to(dtype).transpose(1, 2).unbind()
    biases = None if bias is None else bias.to(dtype).unbind()
    for cell, rows in pieces(offsets, x.shape[0], PIECE):
        out = y[rows] if dtype == x.dtype else torch.empty_like(y[rows], dtype=dtype)
        if biases is None:
            torch.mm(x[rows].to(dtype), transposed[cell], out=out)
        else:
            torch.addmm(biases[cell], x[rows].to(dtype), transposed[cell], out=out)
        activate_(activation, out)
        if dtype != x.dtype:
            y[rows] = out
    zero_strays(y, offsets)
    return y


@_linear.register_fake
def _(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    return x.new_empty(x.shape[0], weight.shape[1])


@torch.library.custom_op("voronerf::grouped_outer", mutates_args=())
def _outer(g: Tensor, x: Tensor, offsets: Tensor) -> Tensor:
    wide = torch.promote_types(x.dtype, torch.float32)
    dtype = compute_dtype(x)
    total = x.new_zeros(offsets.shape[0] - 1, g.shape[1], x.shape[1], dtype=wide)
    for cell, rows in pieces(offsets, x.shape[0], PIECE):
        left, right = g[rows].to(dtype).t(), x[rows].to(dtype)
        if dtype == wide:
            total[cell].addmm_(left, right)
        else:
            total[cell] += torch.mm(left, right)
    return total.to(x.dtype)


@_outer.register_fake
def _(g: Tensor, x: Tensor, offsets: Tensor) -> Tensor:
    return x.new_empty(offsets.shape[0] - 1, g.shape[1], x.shape[1])


@torch.library.custom_op("voronerf::grouped_sum", mutates_args=())
def _sum(g: Tensor, offsets: Tensor) -> Tensor:
    wide = torch.promote_types(g.dtype, torch.float32)
    total = g.new_zeros(offsets.shape[0] - 1, g.shape[1], dtype=wide)
    for cell, rows in pieces(offsets, g.shape[0], PIECE):
        total[cell] += g[rows].sum(dim=0, dtype=wide)
    return total.to(g.dtype)


@_sum.register_fake
def _(g: Tensor, offsets: Tensor) -> Tensor:
    return g.new_empty(offsets.shape[0] - 1, g.shape[1])


def _linear_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    x, offsets, weight, _, activation = inputs
    ctx.activation = activation
    ctx.save_for_backward(x, offsets, weight, None if activation == "none" else output)


def _linear_backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
    x, offsets, weight, output = ctx.saved_tensors
    if output is not None:
        g = times_derivative(ctx.activation, g, output)
    needs_x, _, needs_weight, needs_bias, _ = ctx.needs_input_grad
    ops = torch.ops.voronerf
    return (
        ops.grouped_linear(g, offsets, weight.transpose(1, 2), None, "none") if needs_x else None,
        None,
        ops.grouped_outer(g, x, offsets) if needs_weight else None,
        ops.grouped_sum(g, offsets) if needs_bias else None,
        None,
    )


def _outer_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _outer_backward(ctx: Any, total: Tensor) -> tuple[Tensor | None, ...]:
    g, x, offsets = ctx.saved_tensors
    ops = torch.ops.voronerf
    needs_g, needs_x, _ = ctx.needs_input_grad
    return (
        ops.grouped_linear(x, offsets, total, None, "none") if needs_g else None,
        ops.grouped_linear(g, offsets, total.transpose(1, 2), None, "none") if needs_x else None,
        None,
    )


def _sum_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    g, offsets = inputs
    ctx.rows = g.shape[0]
    ctx.save_for_backward(offsets)


def _sum_backward(ctx: Any, total: Tensor) -> tuple[Tensor, None]:
    (offsets,) = ctx.saved_tensors
    # Every row gets its cell's entry: the bias of a layer without inputs.
    x, weight = total.new_zeros(ctx.rows, 1), total.new_zeros(*total.shape, 1)
    return torch.ops.voronerf.grouped_linear(x, offsets, weight, total, "none"), None


_linear.register_autograd(_linear_backward, setup_context=_linear_setup)
_outer.register_autograd(_outer_backward, setup_context=_outer_setup)
_sum.register_autograd(_sum_backward, setup_context=_sum_setup)
