"""``forward_with_tape`` of the compiled module, in float32.

The gradients of the parameters are computed as soon as that of the outputs is known, and given to the parameters
themselves, where autograd would do no more: its own operations would keep a step from being recorded
(voronerf/ops/_core/recording.py). Else one node of autograd hands them over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.derivatives import learnt, with_gradients
from voronerf.ops.forward_with_tape.reference import Graph, Tape
from voronerf.ops.grouped_program.given import Given
from voronerf.ops.grouped_program.native import How, Network, Rows, run, run_gradient
from voronerf.ops.routed_program import of_samples
from voronerf.ops.routed_program.native import find, of_cells, routed_program
from voronerf.ops.routed_program.reference import cells_of, first_rows
from voronerf.ops.routed_program.where import Where


def forward_with_tape(given: Given, where: Where, leaves: Sequence[Tensor]) -> Tape:
    """The outputs and their tape, once differentiable; see ``voronerf.ops.forward_with_tape``. ``leaves``: inputs and
    parameters as the caller has them."""
    first, plain = leaves[0], all(tensor.dtype is torch.float32 for tensor in leaves)
    if torch.is_grad_enabled() and plain and not torch.is_autocast_enabled(first.device.type):
        with torch.no_grad():
            taken = Network.of(given)
            k = cells_of(taken.parameters)
            cells, order, offsets = find(first, of_cells(where, k), k, given.caller)
            rows, how = taken.rows(offsets, order), taken.how
            learning = any(tensor.requires_grad for tensor in leaves)
            out, *kept = run(rows, how._replace(keep=True) if learning else how)
            count = None if native.on_cuda(out) else where.rows  # CUDA has left out the others
            if count is not None:
                (out,), cells = first_rows([out], cells, count)
            return _Kept(out, rows._replace(kept=kept), how, leaves, count, cells, where.frozen)
    (out,), cells = routed_program(given, where)
    return Graph(out.detach().float(), out, cells, where.frozen)


@dataclass(eq=False)
class _Kept(Tape):
    """What the backward pass takes of the forward pass."""

    raw: Tensor
    taken: Rows
    how: How
    given: Sequence[Tensor]  # inputs and parameters as the caller has them
    count: Tensor | None
    cells: Tensor
    frozen: Tensor | None

    def _backward(self, loss: Tensor, gradient: Tensor, defer: bool) -> Tensor:
        wanted = [tensor.requires_grad for tensor in self.given]
        with torch.no_grad():
            found = self._gradients(gradient, wanted)
            learning = [tensor for tensor, want in zip(self.given, wanted) if want]
            pairs = zip(found, learning, strict=True)
            found = [slope if slope.dim() == tensor.dim() else slope.view_as(tensor) for slope, tensor in pairs]
            if not defer and all(map(_takes_gradients, learning)):
                _give(learning, found)
                return loss
        return learnt(with_gradients(loss, learning, found), defer)

    def _gradients(self, gradient: Tensor, wanted: Sequence[bool]) -> list[Tensor]:
        """Those of the inputs and parameters that are wanted."""
        if not any(wanted):
            return []
        if self.count is not None:
            (gradient,), _ = first_rows([gradient], self.cells, self.count)
        if self.frozen is not None:  # rows of zeros leave the backward pass
            gradient = gradient.masked_fill(of_samples(self.frozen, self.cells), 0)
        return run_gradient(self.taken, self.how, [gradient], wanted)


def _give(parameters: Sequence[Tensor], slopes: Sequence[Tensor]) -> None:
    totals, added = list[Tensor](), list[Tensor]()
    for parameter, slope in zip(parameters, slopes, strict=True):
        total = parameter.grad
        if total is None:
            parameter.grad = slope
        elif total.is_cpu and total.is_contiguous():
            totals.append(total)
            added.append(slope)
        else:
            total.add_(slope)
    if totals:  # not by torch, so that a recording can do it again
        native.compiled.add(added, totals, [total.numel() for total in totals], native.cpu())


def _takes_gradients(parameter: Tensor) -> bool:
    """Whether autograd would only add to the gradient: of a leaf without hooks."""
    return parameter.is_leaf and not parameter._backward_hooks and not parameter._post_accumulate_grad_hooks
