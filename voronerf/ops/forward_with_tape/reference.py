"""What networks put out, and what they learn from its gradient."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from voronerf.ops.routed_mlp import of_samples
from voronerf.ops.routed_mlp.reference import routed_mlp


class Tape(Protocol):
    """What outputs were computed from, for their backward pass."""

    def learn(self, loss: Tensor, gradient: Tensor, backward: bool) -> Tensor:
        """The loss with gradients; see `voronerf.ops.forward_with_tape.Outputs.learn`."""
        ...


def forward_with_tape(
    network: Mapping[str, Any], evaluate: Callable[..., tuple[Tensor, Tensor]] = routed_mlp
) -> tuple[Tensor, Tape]:
    """The outputs and their tape; see ``voronerf.ops.forward_with_tape``."""
    network = dict(network)
    frozen = network.pop("frozen", None)
    out, cells = evaluate(**network)
    return out.detach().float(), _Graph(out, cells, frozen)


@dataclass(frozen=True)
class _Graph:
    """That of torch's own autograd."""

    out: Tensor
    cells: Tensor
    frozen: Tensor | None

    def learn(self, loss: Tensor, gradient: Tensor, backward: bool) -> Tensor:
        if self.frozen is not None:
            gradient = gradient.masked_fill(of_samples(self.frozen, self.cells), 0)
        return learnt(with_gradients(loss, [self.out], [gradient]), backward)


def learnt(loss: Tensor, backward: bool) -> Tensor:
    """A loss, with ``backward`` after its backward pass."""
    if not backward:
        return loss
    loss.backward()
    return loss.detach()


def with_gradients(loss: Tensor, tensors: Sequence[Tensor], gradients: Sequence[Tensor]) -> Tensor:
    """A loss [] whose gradient to some tensors is known; it is handed over once."""
    total: Tensor = _Known.apply(loss, list(gradients), *tensors)
    return total


class _Known(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, loss: Tensor, gradients: list[Tensor], *tensors: Tensor) -> Tensor:
        ctx.gradients, ctx.dtypes = gradients, [tensor.dtype for tensor in tensors]
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, of_loss: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # what the gradients follow from is not known here
            raise RuntimeError("forward_with_tape: gradients are differentiable no further, got create_graph=True")
        found, ctx.gradients = ctx.gradients, None  # to be taken as they are, not copied
        if not of_loss.is_cpu or float(of_loss) != 1:  # nothing is read of a device
            found = [gradient * of_loss for gradient in found]
        # Narrowed last: a scaled loss keeps small ones.
        return (None, None, *(gradient.to(dtype) for gradient, dtype in zip(found, ctx.dtypes, strict=True)))
