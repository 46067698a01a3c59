"""A step of Adam, for whole parameters or only for the entries with a gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, PLAIN, Implementation
from voronerf.ops._core.checks import (
    alike,
    check_dtype,
    check_flag,
    check_interval,
    check_kind,
    check_number,
    check_same_device,
    check_shape,
    check_tensor,
    check_writable,
)
from voronerf.ops.adam.reference import Guard, UpdateRule

_OP = backends.declare("adam", native=Implementation(EVERYWHERE, (torch.float32,)), warp=PLAIN)
_AVERAGE = backends.declare(
    "average",
    native=Implementation(EVERYWHERE, (torch.float32,), file="adam"),
    warp=PLAIN,
    reference=Implementation(file="adam"),
)


def adam(
    rules: Sequence[UpdateRule],
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    *,
    guard: Guard | None = None,
    loss: Tensor | None = None,
    backend: str = "auto",
) -> None:
    """Makes a step of Adam for several parameters, in place; the host reads no device value.

    With the step number s, counted from 1 (Kingma and Ba 2015, algorithm 1):

        mean    <- b1 mean + (1 - b1) g
        square  <- b2 square + (1 - b2) g^2
        p       <- p - rate / (1 - b1^s) mean / (sqrt(square) / sqrt(1 - b2^s) + epsilon)

    If a parameter's rule has ``dense=False``, entries whose gradient is 0 keep their values and both moments, as in
    hash grids of tiny-cuda-nn. If an entry gets its first gradient after many steps, this entry moves by about
    (1 - b1) / sqrt(1 - b2) times the rate. Not differentiable.

    Args:
        rules: One rule for each parameter.
        parameters: The parameters to update, float32 of any shapes, contiguous.
        gradients: The gradients of the loss, float32, in the shapes of the parameters.
        means: The first moments, float32, in the shapes of the parameters, contiguous.
        squares: The second moments, >= 0, float32, in the shapes of the parameters, contiguous.
        guard: The NaN guard, which skips the step if its ``skip`` is not 0; None for no guard.
        loss: float32 [], the loss of the step. If there is a loss, the guard first checks this step. It skips and
            counts the step if the loss, or a gradient whose rule has ``dense``, is NaN or not below the limit in
            magnitude.
        backend: "auto", "reference", "native" or "warp".

    Raises:
        ValueError: a tensor that is not contiguous, lists of different lengths, a loss without a guard.

    Examples:
        >>> import torch
        >>> from voronerf.ops import UpdateRule, adam
        >>> steps, weight, mean, square = torch.zeros(()), torch.zeros(2), torch.zeros(2), torch.zeros(2)
        >>> adam([UpdateRule(steps, 0.25)], [weight], [torch.tensor([0.5, -2.0])], [mean], [square])
        >>> weight, steps
        (tensor([-0.2500,  0.2500]), tensor(1.))
        >>> table = [torch.zeros(3)]  # only one entry gets a gradient
        >>> gradients, rules = [torch.tensor([0.0, 1, 0])], [UpdateRule(steps, 0.25, dense=False)]
        >>> adam(rules, table, gradients, [torch.ones(3)], [torch.ones(3)])
        >>> (table[0] != 0).tolist()
        [False, True, False]
    """
    _check_all(rules, parameters, gradients, means, squares, guard, loss)
    if not rules:
        return
    loss = None if loss is None else loss.detach()
    run = backends.resolve(_OP, backend=backend, device=parameters[0].device, dtype=torch.float32)
    run(rules, parameters, [gradient.contiguous() for gradient in gradients], means, squares, guard, loss)


def average(
    averages: Sequence[Tensor], parameters: Sequence[Tensor] | None, share: float | Tensor, *, backend: str = "auto"
) -> None:
    """Moves averages towards the parameters, in place: ``averages += share * (parameters - averages)``.

    Not differentiable.

    Args:
        averages: the moving averages, float32 of any shapes, contiguous.
        parameters: the parameters, float32, in the shapes of the averages, contiguous; None for zeros.
        share: the fraction of the difference to move by: a number from 0 to 1, or float32 [].
        backend: "auto", "reference", "native" or "warp".

    Raises:
        ValueError: a tensor that is not contiguous, lists of different lengths.

    Examples:
        >>> import torch
        >>> from voronerf.ops import average
        >>> mean = torch.zeros(2)
        >>> average([mean], [torch.tensor([4.0, 8.0])], 0.25)
        >>> mean
        tensor([1., 2.])
    """
    lists = {"averages": averages} if parameters is None else {"averages": averages, "parameters": parameters}
    if not _are_lists(_AVERAGE, lists, "averages", averages):
        return
    _check_lists(_AVERAGE, lists, read="")
    if isinstance(share, Tensor):
        _check_scalar(_AVERAGE, "share", share, averages[0])
    else:
        check_interval(_AVERAGE, "share", share, 0, 1, "0 to 1")
    run = backends.resolve(_AVERAGE, backend=backend, device=averages[0].device, dtype=torch.float32)
    run(averages, parameters, share)


def _check_all(
    rules: Sequence[UpdateRule],
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    guard: Guard | None,
    loss: Tensor | None,
) -> None:
    lists = {"parameters": parameters, "gradients": gradients, "means": means, "squares": squares}
    if not _are_lists(_OP, lists, "rules", rules):
        return
    checked: Any = None
    for index, rule in enumerate(rules):
        check_kind(_OP, f"rules[{index}]", rule, UpdateRule)
        if checked is None or any(part is not previous for part, previous in zip(rule[1:], checked[1:])):
            _check_rule(rule, parameters[0])  # equal rules in a row are checked once
        checked = rule
    if guard is not None:
        check_kind(_OP, "guard", guard, Guard)
        check_number(_OP, "limit", guard.limit)
    if loss is not None and guard is None:
        raise ValueError(f"{_OP}: loss must come with a guard, got none")
    scalars: list[tuple[str, Any]] = [("step", rule.step) for rule in rules]
    if guard is not None:
        scalars += [
            (name, value) for name, value in zip(guard._fields, guard[:4]) if value is not None or name != "scale"
        ]
    if loss is not None:
        scalars.append(("loss", loss))
    _check_lists(_OP, lists, read="gradient", scalars=scalars)


def _are_lists(op: str, lists: dict[str, Sequence[Tensor]], name: str, first: Sequence[Any]) -> bool:
    """Returns False if the lists are empty, else True.

    Raises TypeError for an argument that is not a list, and ValueError unless all of ``lists`` have the length of the
    list ``first``. ``name`` is the name of ``first`` in the message.
    """
    for key, tensors in {name: first, **lists}.items():
        if not isinstance(tensors, Sequence):
            raise TypeError(f"{op}: {key} must be a list, got {type(tensors).__name__}")
        if len(tensors) != len(first):
            raise ValueError(f"{op}: {key} must have length {len(first)} like {name}, got {len(tensors)}")
    return bool(first)


def _check_lists(
    op: str, lists: dict[str, Sequence[Tensor]], read: str, scalars: Sequence[tuple[str, Any]] = ()
) -> None:
    """Checks dtype, shape and device of the tensors of each parameter, and that each scalar has shape [].

    All tensors must be contiguous, except in one list: ``read`` is the name of this list without its plural s, or empty
    if there is no such list.
    """
    if alike([*lists.values()], [name[:-1] != read for name in lists], [value for _, value in scalars]):
        return
    for tensors in zip(*lists.values(), strict=True):
        _check(op, {name[:-1]: tensor for name, tensor in zip(lists, tensors, strict=True)}, read)
    name, first = next(iter(lists.items()))
    check_same_device(op, **{f"{name}[{index}]": tensor for index, tensor in enumerate(first)})
    for key, scalar in scalars:
        _check_scalar(op, key, scalar, first[0])


def _check(op: str, tensors: dict[str, Tensor], read: str) -> None:
    """Checks the tensors of one parameter; the tensor named ``read`` need not be contiguous."""
    first, *_ = tensors.values()
    for name, tensor in tensors.items():
        check_tensor(op, name, tensor)
        check_dtype(op, name, tensor, (torch.float32,))
        if tensor.shape != first.shape:
            raise ValueError(f"{op}: {name} must have shape {list(first.shape)}, got {list(tensor.shape)}")
        if name != read:
            check_writable(op, name, tensor)
    check_same_device(op, **tensors)


def _check_scalar(op: str, name: str, tensor: Any, parameter: Tensor) -> None:
    check_shape(op, name, tensor, ())
    check_dtype(op, name, tensor, (torch.float32,))
    check_same_device(op, **{"parameters[0]": parameter, name: tensor})


def _check_rule(rule: UpdateRule, parameter: Tensor) -> None:
    if isinstance(rule.learning_rate, Tensor):
        _check_scalar(_OP, "learning_rate", rule.learning_rate, parameter)
    else:
        check_number(_OP, "learning_rate", rule.learning_rate)
    check_number(_OP, "epsilon", rule.epsilon)
    check_flag(_OP, "dense", rule.dense)
    betas = rule.betas
    if not isinstance(betas, (tuple, list)) or len(betas) != 2:
        raise TypeError(f"{_OP}: betas must be a pair of numbers, got {betas!r:.60}")
    for beta in betas:
        check_number(_OP, "betas", beta)
        if not 0 <= beta < 1:
            raise ValueError(f"{_OP}: betas must lie in [0, 1), got {betas}")
    if not rule.epsilon > 0:
        raise ValueError(f"{_OP}: epsilon must be positive, got {rule.epsilon}")
