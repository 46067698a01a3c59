"""Autograd helpers shared by several ops. The rest of an op's autograd is in ``voronerf/ops/<op>/autograd.py``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.custom_op import Op


def needed_gradients(ctx: Any, inputs: Sequence[Tensor | None]) -> list[bool]:
    """Returns for each input of an op whether its gradient will be used; an absent optional input is None.

    ``ctx.needs_input_grad`` says which inputs require a gradient, not which gradients the caller has asked for. If
    the caller asks only for the gradient of x, as an eikonal loss does with ``create_graph=True``, the gradients of the
    weights would be computed too, and dropped: half of all products. This function asks the autograd engine, as torch's
    layers do.
    """
    edges = iter(ctx.next_functions)
    nodes = [None if tensor is None else next(edges)[0] for tensor in inputs]
    if _ask is None:
        return [node is not None for node in nodes]
    answers, sure = list[bool](), False
    # Parameters are the last inputs, and mostly leaves. Once the gradient of one leaf is needed, all leaves before it
    # count as needed, without a query. A query for a leaf that is an input of torch.autograd.grad raises RuntimeError:
    # the leaf's gradient is needed. Such a query takes 10 us.
    for node in reversed(nodes):
        leaf = type(node) is _LEAF
        if node is None or (sure and leaf):
            answers.append(node is not None)
            continue
        try:
            answers.append(bool(_ask(node)))
        except RuntimeError:
            answers.append(True)
        sure = sure or (leaf and answers[-1])
    return answers[::-1]


# torch has no public names for this function and class. Without the function, every gradient is computed.
_ask = getattr(torch._C, "_will_engine_execute_node", None)
_LEAF = getattr(torch._C._functions, "AccumulateGrad", None)


def aliases(tensors: Sequence[Tensor | None]) -> tuple[list[Tensor | None], bool]:
    """Returns the inputs of a double backward, and whether its results must be differentiable.

    If the results must be differentiable, a tensor that requires a gradient becomes an alias within the caller's graph.
    Any other tensor becomes a detached leaf. If a tensor y was computed from a tensor x, a derivative with respect to
    the alias of x does not include the dependence of y on x, because the caller's graph accounts for it. Call this
    function before ``torch.enable_grad``.
    """
    graph = torch.is_grad_enabled()
    leaves = [
        None if t is None else t.view_as(t) if graph and t.requires_grad else t.detach().requires_grad_()
        for t in tensors
    ]
    return leaves, graph


def second_derivatives(
    outputs: Sequence[tuple[Tensor, Tensor | None]],
    firsts: Sequence[tuple[Tensor, Tensor]],
    tensors: Sequence[Tensor | None],
    graph: bool,
) -> list[Tensor | None]:
    """Returns the second derivatives of a formula: the derivatives of its gradients.

    Args:
        outputs: pairs of a result of the formula and the gradient that arrives at it.
        firsts: pairs of an input of the formula and the cotangent of its gradient.
        tensors: the inputs to differentiate by, None for an absent one.
        graph: whether the results are differentiated again.

    Returns:
        The derivative for each of ``tensors``, None if there is none.
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
    """Registers the derivatives of an op: another op is its backward, and a formula gives its second derivatives.

    Args:
        forward: the op, with ``width`` arguments and ``count`` results.
        backward: the op that takes the results' gradients (None for zero), the arguments of ``forward``, and a list of
            bools: whether the gradient of each differentiable argument is wanted. It returns the list of these
            gradients; the entry of an unwanted gradient or an absent argument is ignored.
        formula: a differentiable function with the arguments and results of ``forward``.
        places: the indices of the differentiable arguments.
        width: the number of arguments of ``forward``.
        count: the number of results of ``forward``.
    """

    def placed(arguments: Sequence[Any], values: Sequence[Tensor | None]) -> list[Any]:
        entries = list(arguments)
        for place, value in zip(places, values):
            entries[place] = value
        return entries

    nothing = [None] * width

    def first(ctx: Any, *arriving: Tensor | None) -> tuple[Any, ...]:
        arguments = _saved(ctx, forward)
        wanted = [ctx.needs_input_grad[place] for place in places]
        entries: list[Tensor | None] = []
        if any(gradient is not None for gradient in arriving):
            parts = backward(*arriving, *arguments, wanted)
            entries = [part if want else None for part, want in zip(parts, wanted)]
        return tuple(placed(nothing, entries))

    def second(ctx: Any, cotangents: Sequence[Tensor | None]) -> tuple[Any, ...]:
        *flat, wanted = _saved(ctx, backward)
        arriving, arguments = flat[:count], flat[count:]
        leaves, graph = aliases([*arriving, *(arguments[place] for place in places)])
        inputs = leaves[count:]
        with torch.enable_grad():
            results = formula(*placed(arguments, inputs))
            outputs = zip((results,) if isinstance(results, Tensor) else results, leaves)
            pairs = [
                (leaf, cotangent)
                for leaf, cotangent, want in zip(inputs, cotangents, wanted)
                if want and leaf is not None and cotangent is not None
            ]
            used = [(part, gradient) for part, gradient in outputs if gradient is not None]
            entries = second_derivatives(used, pairs, leaves, graph)
        return *entries[:count], *placed(nothing, entries[count:]), None

    forward.register_autograd(first, setup_context=_saver(forward))
    backward.register_autograd(second, setup_context=_saver(backward))


def _saver(op: Op) -> Callable[..., None]:
    """Returns a ``setup_context`` that saves the arguments of an op."""

    def keep(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        rest = list(inputs)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*[rest[place] for place in op.tensors])
        for place in op.tensors:
            rest[place] = None
        ctx.rest = rest

    return keep


def _saved(ctx: Any, op: Op) -> list[Any]:
    arguments = list(ctx.rest)
    for place, tensor in zip(op.tensors, ctx.saved_tensors):
        arguments[place] = tensor
    return arguments


def run_backward(loss: Tensor, defer: bool) -> Tensor:
    """Runs the backward pass of a loss and returns the loss, detached; with ``defer`` only returns the loss."""
    if defer:
        return loss
    loss.backward()
    return loss.detach()


def with_gradients(loss: Tensor, tensors: Sequence[Tensor], gradients: Sequence[Tensor]) -> Tensor:
    """Returns a loss [] whose single backward pass gives precomputed gradients to ``tensors``."""

    def scaled(scale: Tensor | None) -> Sequence[Tensor]:
        return gradients if scale is None else [gradient * scale for gradient in gradients]

    total: Tensor = _KnownGradients.apply(loss, scaled, *tensors)
    return total


def add_gradients(
    loss: Tensor, tensors: Sequence[Tensor], slopes: Callable[[Tensor | None], Sequence[Tensor | None]], defer: bool
) -> Tensor:
    """Adds the gradients of a loss to ``.grad`` of tensors that require gradients.

    If autograd would only add the gradients to ``.grad``, this function does so itself, because autograd's operations
    would prevent the recording of a step (voronerf/ops/_core/recording.py).

    Args:
        loss: [], the loss.
        tensors: the tensors.
        slopes: a function from the factor of the loss (None: 1) to the gradient of each tensor, or None.
        defer: whether to add the gradients only when ``backward`` of the returned loss is called.

    Returns:
        The loss [], detached unless deferred.
    """
    if not tensors and torch.is_grad_enabled():
        return loss
    if defer or not tensors or not all(map(_takes_gradients, tensors)):
        return run_backward(_KnownGradients.apply(loss, slopes, *tensors), defer)
    for tensor, slope in zip(tensors, slopes(None), strict=True):
        if slope is not None:
            tensor.grad = slope if tensor.grad is None else tensor.grad.add_(slope)
    return loss


def _takes_gradients(tensor: Tensor) -> bool:
    """Returns whether autograd would only add to ``.grad``: a leaf tensor without hooks."""
    return tensor.is_leaf and not tensor._backward_hooks and not tensor._post_accumulate_grad_hooks


class _KnownGradients(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, loss: Tensor, slopes: Callable[[Tensor | None], Sequence[Any]], *tensors: Tensor) -> Tensor:
        ctx.slopes, ctx.dtypes = slopes, [tensor.dtype for tensor in tensors]
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, of_loss: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # the gradients have no graph
            raise RuntimeError("Tape.learn: the gradients cannot be differentiated again, got create_graph=True")
        slopes, ctx.slopes = ctx.slopes, None  # released, so that autograd can take the gradients without a copy
        is_one = of_loss.is_cpu and float(of_loss) == 1  # reading the value on a GPU would synchronise
        gradients = slopes(None if is_one else of_loss)
        # The cast comes last, so that a scaled loss keeps small gradients.
        cast = [None if g is None else g.to(dtype) for g, dtype in zip(gradients, ctx.dtypes, strict=True)]
        return None, None, *cast
