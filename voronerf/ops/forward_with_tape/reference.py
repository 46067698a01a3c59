"""Tapes of a forward pass of networks: the interface, and the tape of torch.autograd."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from voronerf.ops._core.checks import check_flag, check_shape
from voronerf.ops._core.derivatives import run_backward, with_gradients
from voronerf.ops.grouped_program.arguments import ProgramArguments
from voronerf.ops.routed_program import frozen_rows, run
from voronerf.ops.routed_program.routing import Routing


class Tape(ABC):
    """The tape of a forward pass: the outputs of the networks, and their backward pass.

    Attributes:
        raw: float32 [n, out], the outputs, detached from the autograd graph.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import forward_with_tape
        >>> weight = torch.tensor([[[2.0]]], requires_grad=True)
        >>> program = MLP((Layer(("positions",), 1),), outputs=(0,)).program(1, 0, None, (False,))
        >>> network = {"program": program, "inputs": [torch.ones(4, 1)], "parameters": [weight]}
        >>> tape = forward_with_tape(network)
        >>> loss = tape.backward(tape.raw.square().mean(), tape.raw * (2 / 4))
        >>> float(loss), float(weight.grad)
        (4.0, 4.0)
    """

    raw: Tensor

    def backward(self, loss: Tensor, gradient: Tensor, *, defer: bool = False) -> Tensor:
        """Adds the gradients of a loss to ``.grad`` of the inputs and parameters. Call ``backward`` only once.

        Args:
            loss: [], the loss.
            gradient: [n, out], the gradient of the loss with respect to ``raw``.
            defer: Whether to add the gradients only when ``backward`` of the returned loss is called.

        Returns:
            The loss [], detached unless deferred.

        Raises:
            ValueError: ``loss`` or ``gradient`` has another shape.
        """
        check_shape("forward_with_tape", "loss", loss, ())
        check_shape("forward_with_tape", "gradient", gradient, self.raw.shape)
        check_flag("forward_with_tape", "defer", defer)
        return self._backward(loss.detach(), gradient.detach(), defer)

    @abstractmethod
    def _backward(self, loss: Tensor, gradient: Tensor, defer: bool) -> Tensor: ...


def forward_with_tape(
    arguments: ProgramArguments, routing: Routing, leaves: Sequence[Tensor], backend: str = "reference"
) -> Tape:
    """Returns the outputs and their tape; see ``voronerf.ops.forward_with_tape``."""
    (out,), cells = run(arguments, routing._replace(frozen=None), backend=backend)
    return Graph(out.detach().float(), out, cells, routing.frozen)


@dataclass(frozen=True)
class Graph(Tape):
    """The tape that delegates to torch.autograd."""

    raw: Tensor
    out: Tensor
    cells: Tensor
    frozen: Tensor | None

    def _backward(self, loss: Tensor, gradient: Tensor, defer: bool) -> Tensor:
        if self.frozen is not None:
            gradient = gradient.masked_fill(frozen_rows(self.frozen, self.cells), 0)
        return run_backward(with_gradients(loss, [self.out], [gradient]), defer)
