"""What native and Warp share of ``render_loss``: memory for its results, and its derivatives by the reference."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.custom_op import Op
from voronerf.ops.render_loss.reference import RenderLossInputs, render_loss

Results = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def results(given: RenderLossInputs) -> Results:
    """Memory for loss, colour, weights, density, error, and the gradient of the loss to ``raw``."""
    raw, r, m = given.raw, given.target.shape[0], given.raw.shape[0]
    loss, colour, error = raw.new_empty(()), raw.new_empty(r, 3), raw.new_empty(r)
    return loss, colour, raw.new_empty(m), raw.new_empty(m), error, raw.new_empty(m, 4)


def register(forward: Op) -> None:
    """Registers the derivatives of an op that gives `results`."""
    forward.register_autograd(_backward, setup_context=_setup)


def _setup(ctx: Any, inputs: tuple[RenderLossInputs], output: Results) -> None:
    *tensors, ctx.density_scale, ctx.hidden = inputs[0]
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(*output[1:])
    ctx.save_for_backward(*tensors, output[-1])


def _backward(ctx: Any, of_loss: Tensor | None, *_: Tensor | None) -> tuple[Any]:
    """Scales the gradient; where that is differentiated again, it comes from the reference formula."""
    *tensors, gradient = ctx.saved_tensors
    found = None
    if of_loss is not None and torch.is_grad_enabled():
        given = RenderLossInputs._make([*tensors, ctx.density_scale, ctx.hidden])
        (found,) = torch.autograd.grad(render_loss(given).loss, given.raw, of_loss, create_graph=True)
    elif of_loss is not None:
        found = of_loss * gradient
    return (RenderLossInputs._make([found, *[None] * 6]),)
