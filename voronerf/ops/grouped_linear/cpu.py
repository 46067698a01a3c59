"""One layer on the CPU as PyTorch ops. n samples, k cells, i inputs, o outputs.

Forward and backward, functional both, of float32 or bfloat16. With bfloat16 storage products take bfloat16 operands
where the processor multiplies them faster (AVX512-BF16), and float32 ones elsewhere; sums are float32 always.
Derivatives of every order are products of the same two ops. Shapes and dtypes have been validated by ``voronerf.ops``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import asked_for


@custom_op("grouped_linear_native", devices=("cpu",))
def layer(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Iterator[Tensor]:
    """Every sample through the layer of its cell, in the dtype of x."""
    out = x.new_empty(x.shape[0], weight.shape[1])
    yield out
    native.on_huge_pages(out)
    native.compiled.grouped_linear(_inputs(x, offsets, weight, bias, activation), out, native.cpu())


@custom_op("grouped_linear_native_backward", devices=("cpu",))
def _backward(
    gradient: Tensor,
    x: Tensor,
    offsets: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    activation: str,
    wanted: Sequence[bool],
) -> Iterator[list[Tensor]]:
    """Gradients of x, weight and bias, empty where not wanted: (x, weight and bias)."""
    chosen = (x if wanted[0] else None, weight if wanted[1] else None, bias if wanted[1] else None)
    results = [x.new_empty(0 if tensor is None else tensor.shape) for tensor in chosen]
    yield results
    for result in results:
        native.on_huge_pages(result)
    of_x, of_weight, of_bias = (None if tensor is None else result for tensor, result in zip(chosen, results))
    gradients = native.compiled.LinearGradients(out=gradient, x=of_x, weight=of_weight, bias=of_bias)
    native.compiled.grouped_linear_backward(_inputs(x, offsets, weight, bias, activation), gradients, native.cpu())


def _inputs(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, activation: str
) -> native.compiled.LinearInputs:
    k, o, i = weight.shape
    return native.compiled.LinearInputs(
        x=x,
        offsets=offsets,
        weight=weight,
        bias=bias,
        n=x.shape[0],
        k=k,
        i=i,
        o=o,
        activation=activation,
        bfloat16=x.dtype == torch.bfloat16,
    )


def _forward_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    x, offsets, weight, bias, ctx.activation = inputs
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(x, offsets, weight, bias)


def _forward_backward(ctx: Any, gradient: Tensor | None) -> tuple[Tensor | None, ...]:
    if gradient is None:
        return (None,) * 5
    saved = x, offsets, weight, bias = ctx.saved_tensors  # once: a checkpoint gives each tensor a single time
    to_x, _, to_weight, to_bias = asked_for(ctx, saved)
    results = _backward(gradient, x, offsets, weight, bias, ctx.activation, [to_x, to_weight or to_bias])
    found = [result if want else None for result, want in zip(results, (to_x, to_weight, to_bias))]
    return found[0], None, *found[1:], None


def _backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    *tensors, ctx.activation, ctx.wanted = inputs
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*tensors)


def _backward_backward(ctx: Any, cotangents: list[Tensor | None]) -> tuple[Tensor | None, ...]:
    """Derivative of the gradients, by the two ops themselves, so that every order exists.

    With z = W x + b and h = gradient * act'(z) the gradients are W^T h, sum h x^T and sum h.
    """
    saved = gradient, x, offsets, weight, bias = ctx.saved_tensors
    to_gradient, to_x, _, to_weight, to_bias = asked_for(ctx, saved)
    chosen = (ctx.wanted[0], ctx.wanted[1], ctx.wanted[1])
    of_x, of_weight, of_bias = (each if want else None for each, want in zip(cotangents, chosen))

    h, slope, curvature = gradient, None, None
    if ctx.activation != "none":
        slope, curvature = _derivatives(ctx.activation, layer(x, offsets, weight, bias, "none"))
        h = gradient * slope
    of_h = None
    if to_gradient or (curvature is not None and (to_x or to_weight or to_bias)):
        if of_x is not None:
            of_h = layer(of_x, offsets, weight, None, "none")
        if of_weight is not None or of_bias is not None:
            given = torch.zeros_like(weight) if of_weight is None else of_weight
            of_h = _add(of_h, layer(x, offsets, given, of_bias, "none"))
    of_gradient = of_h if of_h is None or slope is None else of_h * slope

    found: list[Tensor | None] = [None, None, None]
    if to_x and of_weight is not None:
        found[0] = _backward(h, x, offsets, of_weight, None, "none", [True, False])[0]
    if to_weight and of_x is not None:
        found[1] = _backward(h, of_x, offsets, weight, None, "none", [False, True])[1]
    if of_h is not None and curvature is not None and (to_x or to_weight or to_bias):
        through = of_h * gradient * curvature
        more = _backward(through, x, offsets, weight, bias, "none", [to_x, to_weight or to_bias])
        wanted = (to_x, to_weight, to_bias)
        found = [_add(one, other) if want else None for one, other, want in zip(found, more, wanted)]
    return of_gradient, found[0], None, found[1], found[2], None, None


def _derivatives(activation: str, z: Tensor) -> tuple[Tensor, Tensor | None]:
    """First and second derivative of an activation at ``z``; None for a second one that is 0."""
    if activation == "relu":
        return (z > 0).to(z.dtype), None
    if activation == "sine":
        return z.cos(), -z.sin()
    s = z.sigmoid()
    if activation == "softplus":
        return s, s * (1 - s)
    assert activation == "sigmoid"
    return s * (1 - s), s * (1 - s) * (1 - 2 * s)


def _add(one: Tensor | None, other: Tensor) -> Tensor:
    return other if one is None else one + other


layer.register_autograd(_forward_backward, setup_context=_forward_setup)
_backward.register_autograd(_backward_backward, setup_context=_backward_setup)
