"""Autograd of both frequency encodings, shared by native and Warp, and its further derivatives by the reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from voronerf.derivatives import aliases, second_derivatives
from voronerf.ops.frequency_encode.reference import frequency_encode
from voronerf.ops.integrated_encode.reference import integrated_encode


def encode_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    """Keeps x, variances (None for the plain encoding), octaves and include_input."""
    x, variances, ctx.octaves, ctx.include_input = inputs
    ctx.save_for_backward(x, variances)


def encode_gradients(backward: Callable[..., list[Tensor]]) -> Callable[..., tuple[Tensor | None, ...]]:
    """Backward of the encodings by a backend's op, which takes the gradient and what `encode_setup` keeps."""

    def run(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, variances = ctx.saved_tensors
        of_x, of_variances = backward(gradient, x, variances, ctx.octaves, ctx.include_input)
        return of_x, None if variances is None else of_variances, None, None

    return run


def encode_backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    """Keeps the arguments of the backward op."""
    gradient, x, variances, ctx.octaves, ctx.include_input = inputs
    ctx.save_for_backward(gradient, x, variances)


def encode_backward_backward(ctx: Any, cotangents: list[Tensor]) -> tuple[Tensor | None, ...]:
    """Derivative of the gradients of the encodings."""
    leaves, graph = aliases(ctx.saved_tensors)
    with torch.enable_grad():
        gradient, x, variances = leaves
        assert x is not None
        if variances is None:
            out = frequency_encode(x, ctx.octaves, include_input=ctx.include_input)
            inputs = [x]
        else:
            out = integrated_encode(x, variances, ctx.octaves)
            inputs = [x, variances]
        pairs = list(zip(inputs, cotangents))
        return (*second_derivatives([(out, gradient)], pairs, leaves, graph), None, None)
