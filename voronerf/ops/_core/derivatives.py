"""What the autograd of several ops shares. An op's own is in ``voronerf/ops/<op>/autograd.py``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.custom_op import Op


def asked_for(ctx: Any, inputs: Sequence[Tensor | None]) -> list[bool]:
    """For each tensor that an op took (None where an optional one is absent): will its gradient be used?

    ``ctx.needs_input_grad`` says which inputs require a gradient, not which the caller has asked for: in
    ``torch.autograd.grad(y, x, create_graph=True)`` the gradients of the weights would be computed and dropped, half of
    the products of an eikonal loss. torch's own layers ask the engine, and so does this.
    """
    edges = iter(ctx.next_functions)
    nodes = [None if tensor is None else next(edges)[0] for tensor in inputs]
    if _ask is None:
        return [node is not None for node in nodes]
    answers, sure = list[bool](), False
    # Parameters are the last inputs, and mostly leaves: after the first whose gradient is used, the leaves before it
    # count as asked for. The engine refuses to answer, in 10 us, for one that torch.autograd.grad was asked for.
    for node in reversed(nodes):
        leaf = type(node).__name__ == "AccumulateGrad"
        if node is None or (sure and leaf):
            answers.append(node is not None)
            continue
        try:
            answers.append(bool(_ask(node)))
        except RuntimeError:
            answers.append(True)
        sure = sure or (leaf and answers[-1])
    return answers[::-1]


# torch has no public name for this question; without the answer every gradient is computed.
_ask = getattr(torch._C, "_will_engine_execute_node", None)


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
    if not total.requires_grad:
        return [None] * len(tensors)
    present = [tensor for tensor in tensors if tensor is not None]
    seconds = iter(torch.autograd.grad(total, present, create_graph=graph, allow_unused=True))
    return [None if tensor is None else next(seconds) for tensor in tensors]


def register_derivatives(
    forward: Op,
    backward: Op,
    formula: Callable[..., Tensor | Sequence[Tensor]],
    places: Sequence[int],
    width: int,
    count: int,
) -> None:
    """Registers the derivatives of an op whose gradients are another op, and whose further ones are those of a formula.

    Args:
        forward: of ``width`` arguments; it gives ``count`` tensors.
        backward: takes what has arrived at the results, None for zero, the arguments of ``forward``, and a bool for
            each of those with gradients. It gives these in a list; what is not wanted or not there may be anything.
        formula: takes and gives what ``forward`` does.
        places: of the arguments with gradients.
        width: arguments of ``forward``.
        count: its results.
    """

    def placed(given: Sequence[Any], values: Sequence[Tensor | None]) -> list[Any]:
        found = list(given)
        for place, value in zip(places, values):
            found[place] = value
        return found

    nothing = [None] * width

    def first(ctx: Any, *arriving: Tensor | None) -> tuple[Any, ...]:
        given = _kept(ctx, forward)
        wanted = [ctx.needs_input_grad[place] for place in places]
        found: list[Tensor | None] = []
        if any(gradient is not None for gradient in arriving):
            parts = backward(*arriving, *given, wanted)
            found = [part if want else None for part, want in zip(parts, wanted)]
        return tuple(placed(nothing, found))

    def second(ctx: Any, cotangents: Sequence[Tensor | None]) -> tuple[Any, ...]:
        *flat, wanted = _kept(ctx, backward)
        arriving, given = flat[:count], flat[count:]
        leaves, graph = aliases([*arriving, *(given[place] for place in places)])
        inputs = leaves[count:]
        with torch.enable_grad():
            results = formula(*placed(given, inputs))
            outputs = zip((results,) if isinstance(results, Tensor) else results, leaves)
            pairs = [
                (leaf, cotangent)
                for leaf, cotangent, want in zip(inputs, cotangents, wanted)
                if want and leaf is not None and cotangent is not None
            ]
            used = [(part, gradient) for part, gradient in outputs if gradient is not None]
            found = second_derivatives(used, pairs, leaves, graph)
        return *found[:count], *placed(nothing, found[count:]), None

    forward.register_autograd(first, setup_context=_keeping(forward))
    backward.register_autograd(second, setup_context=_keeping(backward))


def _keeping(op: Op) -> Callable[..., None]:
    """Saves the arguments of an op."""

    def keep(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        rest = list(inputs)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*[rest[place] for place in op.tensors])
        for place in op.tensors:
            rest[place] = None
        ctx.rest = rest

    return keep


def _kept(ctx: Any, op: Op) -> list[Any]:
    found = list(ctx.rest)
    for place, tensor in zip(op.tensors, ctx.saved_tensors):
        found[place] = tensor
    return found


def learnt(loss: Tensor, defer: bool) -> Tensor:
    """A loss, after its backward pass unless that is deferred."""
    if defer:
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
