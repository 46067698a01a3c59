"""``learn_outputs`` of the compiled module: one node of autograd on the CPU in float32.

Checks and nodes of ``routed_mlp``, a loss and their backward passes take a tenth of a step of a few thousand samples.
Here the gradients of the parameters are computed with the loss, and the backward pass hands them over.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from voronerf.ops.grouped_mlp import native as grouped_mlp
from voronerf.ops.learn_outputs import reference
from voronerf.ops.learn_outputs.reference import Loss
from voronerf.ops.routed_mlp import native as routed_mlp
from voronerf.ops.routed_mlp import of_samples


def learn_outputs(network: Mapping[str, Any], loss: Loss) -> Tensor:
    """The loss, with gradients, once differentiable; see ``voronerf.ops.learn_outputs``."""
    floats = (network["positions"], *network["weights"], *network["biases"], network.get("features"))
    plain = all(tensor is None or (tensor.is_cpu and tensor.dtype == torch.float32) for tensor in floats)
    if not plain or torch.is_autocast_enabled("cpu") or not torch.is_grad_enabled():
        return reference.learn_outputs(network, loss, routed_mlp.routed_mlp)
    frozen = network.get("frozen")
    names = routed_mlp.Where._fields
    where = routed_mlp.Where(**{name: network[name] for name in names if name in network})
    rest = {name: value for name, value in network.items() if name not in (*names, "frozen")}
    call, _ = routed_mlp.prepared(**rest, where=where)
    taken = call.network
    total: Tensor = _Learn.apply(call, loss, frozen, *taken.weights, *taken.biases, taken.features)
    return total


class _Learn(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, call: routed_mlp.Call, loss: Loss, frozen: Tensor | None, *parameters: Tensor | None
    ) -> Tensor:
        out, cells, order, offsets, encoded = routed_mlp.forward.inside(*call)
        total, gradient = loss(out)
        if frozen is not None:  # rows of zeros leave the backward pass
            cells = cells if call.where.cells is None else call.where.cells
            gradient = gradient.masked_fill(of_samples(frozen, cells), 0)
        *needs, to_features = ctx.needs_input_grad[3:]
        if any(needs) or to_features:
            wanted = [any(needs), False, False, to_features]
            sorted_by = order if order.numel() else None
            results = grouped_mlp.backward.inside(gradient, call.network, offsets, sorted_by, encoded, wanted)
            *of_parameters, _, _, of_features = results
            ctx.gradients = [*of_parameters, of_features]
        return total

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_loss: Tensor) -> tuple[Tensor | None, ...]:
        found, ctx.gradients = ctx.gradients, None  # to be taken as they are, not copied
        needs, factor = ctx.needs_input_grad[3:], float(of_loss)
        if factor != 1:
            found = [gradient * factor for gradient in found]
        return (None, None, None, *(gradient if need else None for gradient, need in zip(found, needs, strict=True)))
