"""The networks of a training step, its loss and its gradients in one node of autograd, on the CPU.

Checks and nodes of ``routed_mlp``, ``render_loss`` and their backward passes take a tenth of a step of a few thousand
samples. Here the gradients of the parameters are computed with the loss, and the backward pass hands them over. r rays,
m samples of all rays (packed).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.grouped_mlp import native as grouped_mlp
from voronerf.ops.march_rays.reference import March
from voronerf.ops.render_loss import native as render_loss
from voronerf.ops.render_loss.reference import RenderLoss
from voronerf.ops.routed_mlp import native as routed_mlp


def learn_rays(
    march: March,
    routed: dict[str, Any],
    target: Tensor,
    *,
    background: Tensor | None,
    density_scale: float,
    hidden: float,
) -> RenderLoss:
    """``render_loss`` of what ``routed_mlp`` gives; only once differentiable. Shapes and dtypes have been validated.

    Args:
        march: Of the samples.
        routed: The arguments of ``routed_mlp``; the positions are those of the samples. In float32.
        target: As for ``render_loss``, like the rest.
        background: Likewise.
        density_scale: Likewise.
        hidden: Likewise.
    """
    where = routed_mlp.Where(**{name: routed[name] for name in routed_mlp.Where._fields if name in routed})
    network = {name: value for name, value in routed.items() if name not in routed_mlp.Where._fields}
    call, _ = routed_mlp.prepared(**network, where=where)
    rays = march.deltas, march.ray_offsets, target, background, density_scale, hidden
    taken = call.network
    return RenderLoss(*_Learn.apply(call, rays, *taken.weights, *taken.biases, taken.features))


class _Learn(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, call: routed_mlp.Call, rays: tuple[Any, ...], *parameters: Tensor | None
    ) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        out, _, order, offsets, encoded = routed_mlp.forward.inside(*call)
        *found, gradient = render_loss.forward.inside(out, *rays)
        ctx.mark_non_differentiable(*found[1:])
        *needs, to_features = ctx.needs_input_grad[2:]
        if any(needs) or to_features:
            wanted = [any(needs), False, False, to_features]
            sorted_by = order if order.numel() else None
            results = grouped_mlp.backward.inside(gradient, call.network, offsets, sorted_by, encoded, wanted)
            *of_parameters, _, _, of_features = results
            ctx.gradients = [*of_parameters, of_features]
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, of_loss: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        found, ctx.gradients = ctx.gradients, None  # to be taken as they are, not copied
        factor = 0.0 if of_loss is None else float(of_loss)
        needs = ctx.needs_input_grad[2:]
        if factor != 1:
            found = [gradient * factor for gradient in found]
        return (None, None, *(gradient if need else None for gradient, need in zip(found, needs, strict=True)))
