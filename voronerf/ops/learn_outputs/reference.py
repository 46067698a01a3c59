"""Networks, a loss of their outputs and the gradients of their parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from voronerf.ops.routed_mlp import of_samples
from voronerf.ops.routed_mlp.reference import routed_mlp

#: Loss [] and its gradient [n, out], given outputs [n, out].
Loss = Callable[[Tensor], tuple[Tensor, Tensor]]


def learn_outputs(
    network: Mapping[str, Any], loss: Loss, backward: bool, evaluate: Callable[..., tuple[Tensor, Tensor]] = routed_mlp
) -> Tensor:
    """The loss, with gradients; see ``voronerf.ops.learn_outputs``."""
    network = dict(network)
    frozen = network.pop("frozen", None)
    out, cells = evaluate(**network)
    with torch.no_grad():
        total, gradient = loss(out.detach().float())
        if frozen is not None:
            gradient = gradient.masked_fill(of_samples(frozen, cells), 0)
    total = with_gradients(total, [out], [gradient])
    if not backward:
        return total
    total.backward()
    return total.detach()


def with_gradients(loss: Tensor, tensors: list[Tensor], gradients: list[Tensor]) -> Tensor:
    """A loss [] whose gradient to some tensors is known."""
    total: Tensor = _Known.apply(loss, gradients, *tensors)
    return total


class _Known(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, loss: Tensor, gradients: list[Tensor], *tensors: Tensor) -> Tensor:
        ctx.gradients, ctx.dtypes = gradients, [tensor.dtype for tensor in tensors]
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, of_loss: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # what the gradients follow from is not known here
            raise RuntimeError("learn_outputs: gradients are differentiable no further, got create_graph=True")
        found = zip(ctx.gradients, ctx.dtypes, strict=True)  # narrowed last: a scaled loss keeps small ones
        return (None, None, *((gradient * of_loss).to(dtype) for gradient, dtype in found))
