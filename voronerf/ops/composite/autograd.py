"""Autograd of ``composite``, shared by native and Warp, and its further derivatives by the reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from voronerf.derivatives import aliases, second_derivatives
from voronerf.ops.composite.reference import composite


def composite_forward_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    """Keeps sigma, rgb, depths, deltas, ray_offsets and background."""
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs)


def composite_forward_backward(backward: Callable[..., list[Tensor]]) -> Callable[..., tuple[Tensor | None, ...]]:
    """Backward of composite by a backend's op, which takes the gradients of the four outputs (None for zero), the six
    inputs and which of the five gradients are wanted."""

    def run(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        needs = ctx.needs_input_grad
        if all(gradient is None for gradient in gradients):
            return (None,) * len(inputs)
        wanted = [*needs[:4], needs[5]]
        results = backward(*gradients, *inputs, wanted)
        found = [result if need else None for result, need in zip(results, wanted)]
        return (*found[:4], None, found[4])

    return run


def composite_backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    """Keeps the arguments of the backward op."""
    *tensors, ctx.wanted = inputs
    ctx.save_for_backward(*tensors)


def composite_backward_backward(ctx: Any, cotangents: list[Tensor | None]) -> tuple[Tensor | None, ...]:
    """Derivative of the gradients of composite."""
    *smooth, ray_offsets, background = ctx.saved_tensors
    leaves, graph = aliases([*smooth, None, background])
    with torch.enable_grad():
        *gradients, sigma, rgb, depths, deltas, _, background = leaves
        samples = sigma, rgb, depths, deltas
        parts = composite(*samples, ray_offsets=ray_offsets, background=background)  # type: ignore[arg-type]
        inputs = *samples, background
        outputs = [(part, gradient) for part, gradient in zip(parts, gradients) if gradient is not None]
        pairs = [
            (tensor, cotangent)
            for tensor, cotangent, want in zip(inputs, cotangents, ctx.wanted)
            if want and tensor is not None and cotangent is not None
        ]
        return (*second_derivatives(outputs, pairs, leaves, graph), None)
