"""Autograd of ``spherical_harmonics``, shared by native and Warp, and its further derivatives by the reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from voronerf.derivatives import aliases, second_derivatives
from voronerf.ops.spherical_harmonics.reference import spherical_harmonics


def harmonics_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    """Keeps directions and degree."""
    directions, ctx.degree = inputs
    ctx.save_for_backward(directions)


def harmonics_gradient(backward: Callable[..., Tensor]) -> Callable[..., tuple[Tensor, None]]:
    """Backward of spherical_harmonics by a backend's op, which takes the gradient, the directions and the degree."""

    def run(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (directions,) = ctx.saved_tensors
        return backward(gradient, directions, ctx.degree), None

    return run


def harmonics_backward_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    """Keeps the arguments of the backward op."""
    gradient, directions, ctx.degree = inputs
    ctx.save_for_backward(gradient, directions)


def harmonics_backward_backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
    """Derivative of the gradient of spherical_harmonics."""
    leaves, graph = aliases(ctx.saved_tensors)
    with torch.enable_grad():
        gradient, directions = leaves
        assert directions is not None
        out = spherical_harmonics(directions, ctx.degree)
        return (*second_derivatives([(out, gradient)], [(directions, cotangent)], leaves, graph), None)
