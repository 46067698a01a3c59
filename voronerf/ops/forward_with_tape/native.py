"""``forward_with_tape`` of the compiled module, in float32.

``backward`` computes the gradients immediately. If autograd would only add them to ``.grad``, ``backward`` does so
itself, because autograd's operations would prevent the recording of a step (voronerf/ops/_core/recording.py). Otherwise
one autograd node passes the gradients to autograd.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.derivatives import run_backward, with_gradients
from voronerf.ops.forward_with_tape.reference import Graph, Tape
from voronerf.ops.grouped_program.arguments import ProgramArguments
from voronerf.ops.grouped_program.native import Network, RunOptions, RunTensors, run, run_gradient
from voronerf.ops.routed_program import frozen_rows
from voronerf.ops.routed_program.native import find, normalise_routing, routed_program
from voronerf.ops.routed_program.reference import count_cells, mask_rows
from voronerf.ops.routed_program.routing import Routing


def forward_with_tape(arguments: ProgramArguments, routing: Routing, leaves: Sequence[Tensor]) -> Tape:
    """Returns the outputs and their tape, with first derivatives; see ``voronerf.ops.forward_with_tape``.

    ``leaves`` are the inputs and parameters of the caller.
    """
    first, plain = leaves[0], all(tensor.dtype is torch.float32 for tensor in leaves)
    if torch.is_grad_enabled() and plain and not torch.is_autocast_enabled(first.device.type):
        with torch.no_grad():
            network = Network.of(arguments)
            k = count_cells(network.parameters)
            cells, order, offsets = find(first, normalise_routing(routing, k), k, arguments.caller)
            rows, options = network.rows(offsets, order), network.options
            learning = any(tensor.requires_grad for tensor in leaves)
            out, *kept = run(rows, options._replace(keep=True) if learning else options)
            count = None if native.on_cuda(out) else routing.rows  # on CUDA rows that do not count have no cell
            if count is not None:
                (out,), cells = mask_rows([out], cells, count)
            return _NativeTape(out, rows._replace(kept=kept), options, leaves, count, cells, routing.frozen)
    (out,), cells = routed_program(arguments, routing)
    return Graph(out.detach().float(), out, cells, routing.frozen)


@dataclass(eq=False)
class _NativeTape(Tape):
    """The tape that keeps the tensors of the forward pass for the native backward pass."""

    raw: Tensor
    rows: RunTensors
    options: RunOptions
    leaves: Sequence[Tensor]  # inputs and parameters of the caller
    count: Tensor | None
    cells: Tensor
    frozen: Tensor | None

    def _backward(self, loss: Tensor, gradient: Tensor, defer: bool) -> Tensor:
        wanted = [tensor.requires_grad for tensor in self.leaves]
        with torch.no_grad():
            slopes = zip(self._gradients(gradient, wanted), self.leaves, strict=True)
            pairs = [(slope, tensor) for slope, tensor in slopes if slope is not None]
            learning = [tensor for _, tensor in pairs]
            gradients = [slope if slope.dim() == tensor.dim() else slope.view_as(tensor) for slope, tensor in pairs]
            if not defer and all(map(_takes_gradients, learning)):
                _add_gradients(learning, gradients)
                return loss
        return run_backward(with_gradients(loss, learning, gradients), defer)

    def _gradients(self, gradient: Tensor, wanted: Sequence[bool]) -> list[Tensor | None]:
        """Returns the gradient of each leaf; None if it is unwanted, or if the outputs do not depend on the leaf."""
        if not any(wanted):
            return [None] * len(wanted)
        if self.count is not None:
            (gradient,), _ = mask_rows([gradient], self.cells, self.count)
        if self.frozen is not None:  # the backward pass drops rows with a zero gradient
            gradient = gradient.masked_fill(frozen_rows(self.frozen, self.cells), 0)
        return run_gradient(self.rows, self.options, [gradient], wanted)


def _add_gradients(parameters: Sequence[Tensor], slopes: Sequence[Tensor]) -> None:
    for parameter, slope in zip(parameters, slopes, strict=True):
        if parameter.grad is None:
            parameter.grad = slope
        else:
            parameter.grad.add_(slope)


def _takes_gradients(parameter: Tensor) -> bool:
    """Returns whether autograd would only add to ``.grad``: the parameter is a leaf tensor without hooks."""
    return parameter.is_leaf and not parameter._backward_hooks and not parameter._post_accumulate_grad_hooks
