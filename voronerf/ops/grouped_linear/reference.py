"""One linear layer for each cell, on samples sorted by cell. n samples, k cells, i inputs, o outputs.

Each of the two operators is the gradient of the other, so derivatives of every order exist:

    voronerf::grouped_product   y[r] = W[c] x[r]                     for the rows r of cell c
    voronerf::grouped_outer     W[c] = sum over r of g[r] x[r]^T

The host reads ``offsets``, which ``torch.compile`` cannot trace; hence the custom operators.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.checks import dtype_under_autocast
from voronerf.ops.grouped_linear.activation import activate

_PIECE = 1024


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none"
) -> Tensor:
    """Applies the layer of each sample's cell; see ``voronerf.ops.grouped_linear``."""
    dtype = dtype_under_autocast(x.dtype, x)
    # Operands are rounded to half types but multiplied in float32: torch's float16 products take a minute on a CPU.
    wide = torch.promote_types(dtype, torch.float32)
    x, weight = x.to(dtype).to(wide), weight.to(dtype).to(wide)
    if bias is not None:
        # The bias is the weight of an additional input that is 1.
        x = torch.nn.functional.pad(x, (0, 1), value=1.0)
        weight = torch.cat([weight, bias.to(dtype).to(wide)[:, :, None]], dim=2)
    # Custom ops have no gradient within torch.func transforms.
    product = _product_in_torch if torch._C._are_functorch_transforms_active() else torch.ops.voronerf.grouped_product
    y = activate(activation, product(x, offsets, weight))
    row = torch.arange(x.shape[0], device=x.device)
    inside = (row >= offsets[0]) & (row < offsets[-1])
    return torch.where(inside[:, None], y, 0).to(dtype)


def check_offsets(op: str, offsets: Tensor, n: int) -> list[int]:
    """Returns the offsets on the host; raises ValueError unless they ascend from at least 0 to at most n."""
    bounds: list[int] = offsets.tolist()
    if bounds[0] < 0 or bounds[-1] > n or bounds != sorted(bounds):
        raise ValueError(f"{op}: offsets must ascend within 0 to {n} (the number of rows), got {bounds}")
    return bounds


def _pieces(offsets: Tensor, n: int) -> Iterator[tuple[int, slice]]:
    """Yields pairs of a cell and a slice of its rows; a slice has at most ``_PIECE`` rows.

    Sums over a short slice have small rounding errors, and the operands of a product stay in the cache.
    """
    for cell, (low, high) in enumerate(itertools.pairwise(check_offsets("grouped_linear", offsets, n))):
        for start in range(low, high, _PIECE):
            yield cell, slice(start, min(start + _PIECE, high))


def _product_in_torch(x: Tensor, offsets: Tensor, weight: Tensor) -> Tensor:
    n = x.shape[0]
    bounds = check_offsets("grouped_linear", offsets, n)
    parts = [x[low:high] @ weight[cell].t() for cell, (low, high) in enumerate(itertools.pairwise(bounds))]
    return torch.nn.functional.pad(torch.cat(parts), (0, 0, bounds[0], n - bounds[-1]))


@torch.library.custom_op("voronerf::grouped_product", mutates_args=())
def _product(x: Tensor, offsets: Tensor, weight: Tensor) -> Tensor:
    y = x.new_zeros(x.shape[0], weight.shape[1])
    for cell, rows in _pieces(offsets, x.shape[0]):
        torch.mm(x[rows], weight[cell].t(), out=y[rows])  # writes into y, also under autocast
    return y


@torch.library.custom_op("voronerf::grouped_outer", mutates_args=())
def _outer(g: Tensor, x: Tensor, offsets: Tensor) -> Tensor:
    weight = x.new_zeros(offsets.shape[0] - 1, g.shape[1], x.shape[1])
    piece = torch.empty_like(weight[0])
    for cell, rows in _pieces(offsets, x.shape[0]):
        weight[cell] += torch.mm(g[rows].t(), x[rows], out=piece)
    return weight


@_product.register_fake
def _(x: Tensor, offsets: Tensor, weight: Tensor) -> Tensor:
    return x.new_empty(x.shape[0], weight.shape[1])


@_outer.register_fake
def _(g: Tensor, x: Tensor, offsets: Tensor) -> Tensor:
    return x.new_empty(offsets.shape[0] - 1, g.shape[1], x.shape[1])


def _keep(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _product_backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
    x, offsets, weight = ctx.saved_tensors
    of_x, _, of_weight = ctx.needs_input_grad
    return (
        _product(g, offsets, weight.transpose(1, 2)) if of_x else None,
        None,
        _outer(g, x, offsets) if of_weight else None,
    )


def _outer_backward(ctx: Any, w: Tensor) -> tuple[Tensor | None, ...]:
    g, x, offsets = ctx.saved_tensors
    of_g, of_x, _ = ctx.needs_input_grad
    return _product(x, offsets, w) if of_g else None, _product(g, offsets, w.transpose(1, 2)) if of_x else None, None


_product.register_autograd(_product_backward, setup_context=_keep)
_outer.register_autograd(_outer_backward, setup_context=_keep)
