"""What the autograd of several ops shares. An op's own is in ``voronerf/ops/<op>/autograd.py``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def asked_for(ctx: Any, inputs: Sequence[Tensor | None]) -> list[bool]:
    """For each tensor that an op took (None where an optional one is absent): will its gradient be used?

    ``ctx.needs_input_grad`` says which inputs require a gradient, not which the caller has asked for: in
    ``torch.autograd.grad(y, x, create_graph=True)`` the gradients of the weights would be computed and dropped, half of
    the products of an eikonal loss. torch's own layers ask the engine, and so does this.
    """
    edges = iter(ctx.next_functions)
    return [tensor is not None and _runs(next(edges)[0]) for tensor in inputs]


def _runs(node: Any) -> bool:
    # torch has no public name for this question; without the answer every gradient is computed.
    ask = getattr(torch._C, "_will_engine_execute_node", None)
    if node is None or ask is None:
        return node is not None
    # For leaves that torch.autograd.grad was asked for the engine refuses to answer, which takes 30 us: too long to ask
    # unless a whole graph is being made.
    if type(node).__name__ == "AccumulateGrad" and not torch.is_grad_enabled():
        return True
    try:
        return bool(ask(node))
    except RuntimeError:
        return True


def aliases(tensors: Sequence[Tensor | None]) -> tuple[list[Tensor | None], bool]:
    """Tensors to differentiate by within the derivative of a backward op, and whether that is differentiated again.

    Where it is, they stay parts of the caller's graph, as aliases: where one of them was computed from another, that
    path is the caller's. To be called before gradients are switched on.
    """
    graph = torch.is_grad_enabled()
    found = [
        None if t is None else t.view_as(t) if graph and t.requires_grad else t.detach().requires_grad_()
        for t in tensors
    ]
    return found, graph


def second_derivatives(
    outputs: Sequence[tuple[Tensor, Tensor | None]],
    firsts: Sequence[tuple[Tensor, Tensor]],
    tensors: Sequence[Tensor | None],
    graph: bool,
) -> list[Tensor | None]:
    """The derivative of gradients.

    Args:
        outputs: results of a formula, each with the gradient that arrives at it.
        firsts: tensors that the formula read, each with the cotangent of the gradient that it has got.
        tensors: the inputs to differentiate by, None for an absent one.
        graph: whether the results are differentiated again.

    Returns:
        For each of the tensors its derivative, None where there is none.
    """
    if not firsts:
        return [None] * len(tensors)
    parts, arriving = zip(*outputs, strict=True)
    sources, cotangents = zip(*firsts, strict=True)
    gradients = torch.autograd.grad(
        parts, sources, arriving, create_graph=True, allow_unused=True, materialize_grads=True
    )
    total = parts[0].new_zeros(())
    for gradient, cotangent in zip(gradients, cotangents, strict=True):
        total = total + (gradient * cotangent).sum()
    present = [tensor for tensor in tensors if tensor is not None]
    seconds = iter(torch.autograd.grad(total, present, create_graph=graph, allow_unused=True))
    return [None if tensor is None else next(seconds) for tensor in tensors]
