"""What networks put out, and what they learn from its gradient."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from voronerf.ops._core.checks import check_flag, check_shape
from voronerf.ops._core.derivatives import learnt, with_gradients
from voronerf.ops.grouped_program.given import Given
from voronerf.ops.routed_program import of_samples, run
from voronerf.ops.routed_program.where import Where


class Tape(ABC):
    """What networks put out, to learn from.

    Attributes:
        raw: float32 [n, out], without gradients.

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
        """Adds to ``.grad`` of the parameters what follows from the gradient of a loss to ``raw``. To be called once.

        Args:
            loss: [].
            gradient: [n, out], of the loss to ``raw``.
            defer: Whether that waits for the ``backward`` of the result.

        Returns:
            The loss [], without gradients unless deferred.

        Raises:
            ValueError: a loss or gradient of another shape.
        """
        check_shape("forward_with_tape", "loss", loss, ())
        check_shape("forward_with_tape", "gradient", gradient, self.raw.shape)
        check_flag("forward_with_tape", "defer", defer)
        return self._backward(loss.detach(), gradient.detach(), defer)

    @abstractmethod
    def _backward(self, loss: Tensor, gradient: Tensor, defer: bool) -> Tensor: ...


def forward_with_tape(given: Given, where: Where, leaves: Sequence[Tensor], backend: str = "reference") -> Tape:
    """The outputs and their tape; see ``voronerf.ops.forward_with_tape``."""
    (out,), cells = run(given, where._replace(frozen=None), backend=backend)
    return Graph(out.detach().float(), out, cells, where.frozen)


@dataclass(frozen=True)
class Graph(Tape):
    """That of torch's own autograd."""

    raw: Tensor
    out: Tensor
    cells: Tensor
    frozen: Tensor | None

    def _backward(self, loss: Tensor, gradient: Tensor, defer: bool) -> Tensor:
        if self.frozen is not None:
            gradient = gradient.masked_fill(of_samples(self.frozen, self.cells), 0)
        return learnt(with_gradients(loss, [self.out], [gradient]), defer)
