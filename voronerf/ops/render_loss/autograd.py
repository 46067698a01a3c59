"""The derivatives of ``render_loss`` for its native and Warp kernels, which compute the gradient with the loss."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.custom_op import Op
from voronerf.ops.render_loss.reference import render_loss


def register(forward: Op) -> None:
    """Registers the derivatives of an op that returns the results of ``render_loss_gradient``."""
    forward.register_autograd(_backward, setup_context=_setup)


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, density_scale, activated, hidden, robust, triples = inputs
    ctx.rule = density_scale, activated, hidden, robust, triples
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(*output[1:])
    ctx.save_for_backward(*tensors, output[-1])


def _backward(ctx: Any, of_loss: Tensor | None, *_: Tensor | None) -> tuple[Tensor | None, ...]:
    """Returns the scaled gradient, or the gradient of the reference formula for higher derivatives."""
    raw, *others, gradient = ctx.saved_tensors
    gradient_to_raw = None
    if of_loss is not None and torch.is_grad_enabled():
        loss = render_loss(raw, *others, *ctx.rule).loss
        (gradient_to_raw,) = torch.autograd.grad(loss, raw, of_loss, create_graph=True)
    elif of_loss is not None:
        gradient_to_raw = of_loss * gradient
    return gradient_to_raw, *[None] * 9
