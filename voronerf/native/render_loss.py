"""``render_loss`` of the compiled module. r rays, m samples of all rays (packed).

The gradient of the loss is computed with it, so the backward pass only scales it. Where the gradient is differentiated
again, it comes from the reference formula.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from voronerf import native
from voronerf.native.custom_op import custom_op
from voronerf.reference import render_loss as reference
from voronerf.reference.render_loss import RenderLoss


def render_loss(
    raw: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    target: Tensor,
    *,
    background: Tensor | None = None,
    density_scale: float,
) -> RenderLoss:
    """Activations, compositing and squared error; see ``voronerf.ops.render_loss``."""
    *parts, _ = _render_loss(raw.float(), deltas, ray_offsets, target, background, density_scale)
    return RenderLoss(*parts)


@custom_op("render_loss_native")
def _render_loss(
    raw: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    target: Tensor,
    background: Tensor | None,
    density_scale: float,
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]]:
    r, m = target.shape[0], raw.shape[0]
    loss, colour, error = raw.new_empty(()), raw.new_empty(r, 3), raw.new_empty(r)
    weights, density, gradient = raw.new_empty(m), raw.new_empty(m), raw.new_empty(m, 4)
    yield loss, colour, weights, density, error, gradient
    compiled = native.compiled
    given = compiled.RenderLossInputs(
        raw=raw,
        deltas=deltas,
        offsets=ray_offsets,
        target=target,
        background=background,
        background_per_ray=background is not None and background.dim() == 2,
        density_scale=density_scale,
        r=r,
        m=m,
    )
    results = compiled.RenderLossOutputs(
        loss=loss, colour=colour, weights=weights, density=density, error=error, gradient=gradient
    )
    compiled.render_loss(given, results, native.machine(raw))


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, ctx.density_scale = inputs
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(*output[1:])
    ctx.save_for_backward(*tensors, output[-1])


def _backward(ctx: Any, of_loss: Tensor | None, *_: Tensor | None) -> tuple[Tensor | None, ...]:
    *tensors, gradient = ctx.saved_tensors
    if of_loss is None:
        found = None
    elif torch.is_grad_enabled():
        raw, deltas, ray_offsets, target, background = tensors
        given = {"background": background, "density_scale": ctx.density_scale}
        loss = reference.render_loss(raw, deltas, ray_offsets, target, **given).loss
        (found,) = torch.autograd.grad(loss, raw, of_loss, create_graph=True)
    else:
        found = of_loss * gradient
    return found, None, None, None, None, None


_render_loss.register_autograd(_backward, setup_context=_setup)
