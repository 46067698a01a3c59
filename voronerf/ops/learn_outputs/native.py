"""``learn_outputs`` of the compiled module: one node of autograd in float32.

Checks and nodes of ``routed_mlp``, a loss and their backward passes take a tenth of a step of a few thousand samples.
Here the gradients of the parameters are computed with the loss, and the backward pass hands them over; or they are
given to the parameters themselves, where autograd would do no more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf import native
from voronerf.ops.grouped_mlp import native as grouped_mlp
from voronerf.ops.learn_outputs import reference
from voronerf.ops.learn_outputs.reference import Loss
from voronerf.ops.routed_mlp import native as routed_mlp
from voronerf.ops.routed_mlp import of_samples


def learn_outputs(network: Mapping[str, Any], loss: Loss, backward: bool) -> Tensor:
    """The loss, with gradients, once differentiable; see ``voronerf.ops.learn_outputs``."""
    floats = (network["positions"], *network["weights"], *network["biases"], network.get("features"))
    plain = all(tensor is None or tensor.dtype == torch.float32 for tensor in floats)
    if not plain or torch.is_autocast_enabled(network["positions"].device.type) or not torch.is_grad_enabled():
        return reference.learn_outputs(network, loss, backward, routed_mlp.routed_mlp)
    frozen = network.get("frozen")
    names = routed_mlp.Where._fields
    where = routed_mlp.Where(**{name: network[name] for name in names if name in network})
    rest = {name: value for name, value in network.items() if name not in (*names, "frozen")}
    call, _ = routed_mlp.prepared(**rest, where=where)
    taken = call.network
    parameters = [*taken.weights, *taken.biases, taken.features, taken.positions, taken.directions]
    if backward and all(map(_takes_gradients, parameters)):
        needs = [parameter is not None and parameter.requires_grad for parameter in parameters]
        with torch.no_grad():
            total, gradients = _learn(call, loss, frozen, needs)
            for parameter, gradient, need in zip(parameters, gradients, needs, strict=bool(gradients)):
                if need and parameter is not None:
                    parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)
        return total
    learnt: Tensor = _Learn.apply(call, loss, frozen, *parameters)
    if not backward:
        return learnt
    learnt.backward()
    return learnt.detach()


def _takes_gradients(parameter: Tensor | None) -> bool:
    """Whether autograd would only add to the gradient: of a leaf without hooks, and of what has no gradient."""
    if parameter is None or not parameter.requires_grad:
        return True
    return parameter.is_leaf and not parameter._backward_hooks and not parameter._post_accumulate_grad_hooks


def _learn(
    call: routed_mlp.Call, loss: Loss, frozen: Tensor | None, needs: Sequence[bool]
) -> tuple[Tensor, list[Tensor]]:
    """The loss, and gradients of weights, biases, features, positions and directions where any is needed."""
    out, cells, order, offsets, encoded = routed_mlp.forward.inside(*call)
    rows = None if native.on_cuda(out) else call.where.rows  # CUDA has left out the others
    out, cells = routed_mlp.first_rows(out, cells if call.where.cells is None else call.where.cells, rows)
    total, gradient = loss(out)
    if rows is not None:
        gradient, _ = routed_mlp.first_rows(gradient, cells, rows)
    if frozen is not None:  # rows of zeros leave the backward pass
        gradient = gradient.masked_fill(of_samples(frozen, cells), 0)
    *of_layers, of_features, of_positions, of_directions = needs
    if not any(needs):
        return total, []
    wanted = [any(of_layers), of_positions, of_directions, of_features]
    sorted_by = order if order.numel() else None
    found = grouped_mlp.backward.inside(gradient, call.network, offsets, sorted_by, encoded, wanted)
    *of_parameters, positions, directions, features = found
    return total, [*of_parameters, features, positions, directions]


class _Learn(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, call: routed_mlp.Call, loss: Loss, frozen: Tensor | None, *parameters: Tensor | None
    ) -> Tensor:
        total, ctx.gradients = _learn(call, loss, frozen, ctx.needs_input_grad[3:])
        return total

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_loss: Tensor) -> tuple[Tensor | None, ...]:
        found, ctx.gradients = ctx.gradients, None  # to be taken as they are, not copied
        needs = ctx.needs_input_grad[3:]
        if not of_loss.is_cpu or float(of_loss) != 1:  # nothing is read of a device
            found = [gradient * of_loss for gradient in found]
        return (None, None, None, *(gradient if need else None for gradient, need in zip(found, needs, strict=True)))
