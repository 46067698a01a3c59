"""A step of Adam, for whole parameters or only for the entries with a gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, PLAIN, Implementation
from voronerf.ops._core.checks import TensorRule, check_flag, check_kind, check_number, check_rules
from voronerf.ops.adam.reference import Guard, UpdateRule

_OP = backends.declare("adam", native=Implementation(EVERYWHERE, (torch.float32,)), warp=PLAIN)
_DTYPES = (torch.float32,)
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
    lists = {"parameters": parameters, "gradients": gradients, "means": means, "squares": squares}
    _check_all(rules, lists, guard, loss)
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
    if not isinstance(share, Tensor):
        check_number(_AVERAGE, "share", share, "0 to 1", (0, 1))
    _check_lists(_AVERAGE, lists, "", [("share", share)] if isinstance(share, Tensor) else [])
    run = backends.resolve(_AVERAGE, backend=backend, device=averages[0].device, dtype=torch.float32)
    run(averages, parameters, share)


def _check_all(
    rules: Sequence[UpdateRule], lists: dict[str, Sequence[Tensor]], guard: Guard | None, loss: Tensor | None
) -> None:
    if not _are_lists(_OP, lists, "rules", rules):
        return
    checked, scalars = None, list[tuple[str, Any]]()
    for index, rule in enumerate(rules):
        check_kind(_OP, f"rules[{index}]", rule, UpdateRule)
        scalars.append(("step", rule.step))
        if checked is None or any(part is not previous for part, previous in zip(rule[1:], checked[1:])):
            _check_rule(rule, scalars)  # equal rules in a row are checked once
        checked = rule
    if guard is not None:
        check_kind(_OP, "guard", guard, Guard)
        check_number(_OP, "limit", guard.limit)
        members = zip(guard._fields, guard[:4])
        scalars += [(name, value) for name, value in members if value is not None or name != "scale"]
    if loss is not None:
        if guard is None:
            raise ValueError(f"{_OP}: loss must come with a guard, got none")
        scalars.append(("loss", loss))
    _check_lists(_OP, lists, "gradients", scalars)


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


def _check_lists(op: str, lists: dict[str, Sequence[Tensor]], read: str, scalars: list[tuple[str, Any]]) -> None:
    """Checks lists of tensors, and scalars (name, tensor []); tensors of the list ``read`` need not be contiguous."""
    tensors = [tensor for tensors in zip(*lists.values()) for tensor in tensors]
    shapes = tuple([getattr(tensor, "shape", ()) for tensor in next(iter(lists.values()))])
    names = tuple([name for name, _ in scalars])
    tensors += [tensor for _, tensor in scalars]
    check_rules(op, _rules, tensors, tuple(lists), read, shapes, names, smooth=False)


def _rules(lists: Sequence[str], read: str, shapes: Sequence[Any], scalars: Sequence[str]) -> list[TensorRule]:
    """Returns the rules of the tensors: for each parameter, one tensor of each list; then the scalars, tensors []."""
    rows = [TensorRule(name[:-1], _DTYPES, tuple(shape), written=name != read) for shape in shapes for name in lists]
    return [*rows, *(TensorRule(name, _DTYPES, ()) for name in scalars)]


def _check_rule(rule: UpdateRule, scalars: list[tuple[str, Any]]) -> None:
    """Checks the numbers of a rule; adds a learning rate that is a tensor to ``scalars``."""
    if isinstance(rule.learning_rate, Tensor):
        scalars.append(("learning_rate", rule.learning_rate))
    else:
        check_number(_OP, "learning_rate", rule.learning_rate)
    check_number(_OP, "epsilon", rule.epsilon, "positive")
    check_flag(_OP, "dense", rule.dense)
    betas = rule.betas
    if not isinstance(betas, (tuple, list)) or len(betas) != 2:
        raise TypeError(f"{_OP}: betas must be a pair of numbers, got {betas!r:.60}")
    for beta in betas:
        check_number(_OP, "betas", beta)
        if not 0 <= beta < 1:
            raise ValueError(f"{_OP}: betas must lie in [0, 1), got {betas}")
