"""Linear layers of many cells on samples sorted by cell. n samples, k cells, i inputs, o outputs.

Three operators closed under differentiation, each one loop over cells of dense products into slices of one result:

    voronerf::grouped_linear   y[r] = W[c] x[r] + b[c]           for the rows r of cell c
    voronerf::grouped_outer    W[c] = sum over r of g[r] x[r]^T
    voronerf::grouped_sum      b[c] = sum over r of g[r]

The gradients of each are the other two, so derivatives of every order exist. Where no second derivative is asked for,
``voronerf::grouped_linear_backward`` takes all gradients of a layer in one pass. The loops, and the reading of
``offsets`` on the host that they need, are inside the operators: ``torch.compile`` sees shapes alone.
``voronerf.reference.specification`` says the same in three lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.reference.activation import FROM_OUTPUT, activate, activate_, times_derivative, times_derivative_
from voronerf.reference.piecewise import add_product, compute_dtype, pieces, wide_dtype, zero_strays


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, *, activation: str = "none"
) -> Tensor:
    """Every sample through the layer of its cell; see ``voronerf.ops.grouped_linear``."""
    x, weight, bias = autocast(x), autocast(weight), None if bias is None else autocast(bias)
    fused = activation if activation in FROM_OUTPUT else "none"
    y = torch.ops.voronerf.grouped_linear(x, offsets, weight, bias, fused)
    return y if fused == activation else activate(activation, y)


def autocast(tensor: Tensor) -> Tensor:
    """The tensor in autocast's dtype, where it is on; float64 stays, as in torch's own layers."""
    kind = tensor.device.type
    if not torch.is_autocast_enabled(kind) or tensor.dtype == torch.float64:
        return tensor
    return tensor.to(torch.get_autocast_dtype(kind))


@torch.library.custom_op("voronerf::grouped_linear", mutates_args=())
def _linear(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    dtype = compute_dtype(x)
    y = x.new_empty(x.shape[0], weight.shape[1])
    transposed = weight.to(dtype).transpose(1, 2).unbind()
    biases = None if bias is None else bias.to(dtype).unbind()
    for cell, rows in pieces("grouped_linear", offsets, x.shape[0]):
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


@torch.library.custom_op("voronerf::grouped_linear_backward", mutates_args=())
def _linear_backward_op(
    g: Tensor, x: Tensor, offsets: Tensor, weight: Tensor, output: Tensor | None, activation: str, needs: Sequence[bool]
) -> list[Tensor]:
    needs_x, needs_weight, needs_bias = needs
    dtype, wide = compute_dtype(x), wide_dtype(x)
    matrices = weight.to(dtype).unbind()
    to_x = torch.empty_like(x, memory_format=torch.contiguous_format) if needs_x else None
    to_weight = weight.new_zeros(weight.shape, dtype=wide) if needs_weight else None
    to_bias = weight.new_zeros(weight.shape[:2], dtype=wide) if needs_bias else None
    for cell, rows in pieces("grouped_linear", offsets, x.shape[0]):
        gradient = g[rows].to(dtype)
        if output is not None:
            gradient = times_derivative_(activation, gradient.clone(), output[rows].to(dtype))
        if to_bias is not None:
            to_bias[cell] += gradient.sum(dim=0, dtype=wide)
        if to_weight is not None:
            add_product(to_weight[cell], gradient.t(), x[rows].to(dtype))
        if to_x is not None and dtype == x.dtype:
            torch.mm(gradient, matrices[cell], out=to_x[rows])
        elif to_x is not None:
            to_x[rows] = torch.mm(gradient, matrices[cell])
    if to_x is not None:
        zero_strays(to_x, offsets)
    return [total.to(x.dtype) for total in (to_x, to_weight, to_bias) if total is not None]


@_linear_backward_op.register_fake
def _(
    g: Tensor, x: Tensor, offsets: Tensor, weight: Tensor, output: Tensor | None, activation: str, needs: Sequence[bool]
) -> list[Tensor]:
    shapes = (x.shape, weight.shape, weight.shape[:2])
    return [x.new_empty(shape) for shape, need in zip(shapes, needs) if need]


@torch.library.custom_op("voronerf::grouped_outer", mutates_args=())
def _outer(g: Tensor, x: Tensor, offsets: Tensor) -> Tensor:
    dtype, wide = compute_dtype(x), wide_dtype(x)
    total = x.new_zeros(offsets.shape[0] - 1, g.shape[1], x.shape[1], dtype=wide)
    for cell, rows in pieces("grouped_linear", offsets, x.shape[0]):
        add_product(total[cell], g[rows].to(dtype).t(), x[rows].to(dtype))
    return total.to(x.dtype)


@_outer.register_fake
def _(g: Tensor, x: Tensor, offsets: Tensor) -> Tensor:
    return x.new_empty(offsets.shape[0] - 1, g.shape[1], x.shape[1])


@torch.library.custom_op("voronerf::grouped_sum", mutates_args=())
def _sum(g: Tensor, offsets: Tensor) -> Tensor:
    wide = wide_dtype(g)
    total = g.new_zeros(offsets.shape[0] - 1, g.shape[1], dtype=wide)
    for cell, rows in pieces("grouped_linear", offsets, g.shape[0]):
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
    needs_x, _, needs_weight, needs_bias, _ = ctx.needs_input_grad
    ops = torch.ops.voronerf
    if not torch.is_grad_enabled():
        needs = [needs_x, needs_weight, needs_bias]
        found = iter(ops.grouped_linear_backward(g, x, offsets, weight, output, ctx.activation, needs))
        to_x, to_weight, to_bias = (next(found) if need else None for need in needs)
        return to_x, None, to_weight, to_bias, None
    # To be differentiated again: the same from operators that can be.
    if output is not None:
        g = times_derivative(ctx.activation, g, output)
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
