"""Autograd of ``render_loss``, shared by native and Warp, and its further derivatives by the reference."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.render_loss.reference import render_loss


def render_loss_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    """Of the forward op of render_loss, the last of whose results is the gradient of the loss."""
    *tensors, ctx.density_scale, ctx.hidden = inputs
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(*output[1:])
    ctx.save_for_backward(*tensors, output[-1])


def render_loss_backward(ctx: Any, of_loss: Tensor | None, *_: Tensor | None) -> tuple[Tensor | None, ...]:
    """Scales the gradient; where that is differentiated again, it comes from the reference formula."""
    *tensors, gradient = ctx.saved_tensors
    if of_loss is None:
        found = None
    elif torch.is_grad_enabled():
        raw, deltas, ray_offsets, target, background = tensors
        given = {"background": background, "density_scale": ctx.density_scale, "hidden": ctx.hidden}
        loss = render_loss(raw, deltas, ray_offsets, target, **given).loss
        (found,) = torch.autograd.grad(loss, raw, of_loss, create_graph=True)
    else:
        found = of_loss * gradient
    return found, None, None, None, None, None, None
