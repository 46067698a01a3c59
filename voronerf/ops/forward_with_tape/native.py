"""``forward_with_tape`` of the compiled module, in float32.

Checks and nodes of ``routed_mlp``, a loss and their backward passes take a tenth of a step of a few thousand samples.
Here the gradients of the parameters are computed as soon as that of the outputs is known, and given to the parameters
themselves, where autograd would do no more; or one node of autograd hands them over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops.forward_with_tape import reference
from voronerf.ops.forward_with_tape.reference import Tape, learnt, with_gradients
from voronerf.ops.grouped_mlp import network as grouped_mlp
from voronerf.ops.routed_mlp import native as routed_mlp
from voronerf.ops.routed_mlp import of_samples


def forward_with_tape(network: Mapping[str, Any]) -> Tape:
    """The outputs and their tape, once differentiable; see ``voronerf.ops.forward_with_tape``."""
    floats = (network["positions"], *network["weights"], *network["biases"], network.get("features"))
    plain = all(tensor is None or tensor.dtype == torch.float32 for tensor in floats)
    if not plain or torch.is_autocast_enabled(network["positions"].device.type) or not torch.is_grad_enabled():
        return reference.forward_with_tape(network, "native")
    given = dict(network)
    frozen = given.pop("frozen", None)
    call, _ = routed_mlp.prepared(**given)
    with torch.no_grad():
        out, cells, order, offsets, encoded = routed_mlp.forward.inside(*call)
        if call.where.cells is not None:
            cells = call.where.cells
        rows = None if native.on_cuda(out) else call.where.rows  # CUDA has left out the others
        if rows is not None:
            out, cells = routed_mlp.first_rows(out, cells, rows)
    return _Kept(out, call, rows, cells, order, offsets, encoded, frozen)


@dataclass(frozen=True)
class _Kept(Tape):
    """What the backward pass takes of the forward pass."""

    raw: Tensor
    call: routed_mlp.Call
    rows: Tensor | None
    cells: Tensor
    order: Tensor
    offsets: Tensor
    encoded: Tensor
    frozen: Tensor | None

    def _backward(self, loss: Tensor, gradient: Tensor, defer: bool) -> Tensor:
        taken = self.call.network
        parameters = [*taken.weights, *taken.biases, taken.features, taken.positions, taken.directions]
        needs = [parameter is not None and parameter.requires_grad for parameter in parameters]
        with torch.no_grad():
            found = self._gradients(gradient, needs)
            learning = [each for each in parameters if each is not None and each.requires_grad]
            if not defer and all(map(_takes_gradients, learning)):
                for parameter, slope in zip(learning, found, strict=True):
                    parameter.grad = slope if parameter.grad is None else parameter.grad.add_(slope)
                return loss
        return learnt(with_gradients(loss, learning, found), defer)

    def _gradients(self, gradient: Tensor, needs: Sequence[bool]) -> list[Tensor]:
        """Those of the weights, biases, features, positions and directions that need them."""
        if self.rows is not None:
            gradient, _ = routed_mlp.first_rows(gradient, self.cells, self.rows)
        if self.frozen is not None:  # rows of zeros leave the backward pass
            gradient = gradient.masked_fill(of_samples(self.frozen, self.cells), 0)
        *of_layers, of_features, of_positions, of_directions = needs
        if not any(needs):
            return []
        wanted = [any(of_layers), of_positions, of_directions, of_features]
        sorted_by = self.order if self.order.numel() else None
        found = grouped_mlp.backward.inside(gradient, self.call.network, self.offsets, sorted_by, self.encoded, wanted)
        *of_parameters, positions, directions, features = found
        every = [*of_parameters, features, positions, directions]
        return [slope for slope, need in zip(every, needs, strict=True) if need]


def _takes_gradients(parameter: Tensor) -> bool:
    """Whether autograd would only add to the gradient: of a leaf without hooks."""
    return parameter.is_leaf and not parameter._backward_hooks and not parameter._post_accumulate_grad_hooks
