"""A step of Adam, of whole parameters or on the entries of a table that have a gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, Implementation
from voronerf.checks import (
    check_dtype,
    check_integer,
    check_number,
    check_same_device,
    check_shape,
    check_tensor,
    check_writable,
)
from voronerf.ops.sparse_adam.reference import Guard, Rule

_OP = backends.declare(
    "sparse_adam",
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
)
_ALL = backends.declare(
    "adam",
    native=Implementation(EVERYWHERE, (torch.float32,), file="sparse_adam"),
    reference=Implementation(file="sparse_adam"),
)


@torch.no_grad()
def adam(
    rules: Sequence[Rule],
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    *,
    guard: Guard | None = None,
    loss: Tensor | None = None,
    backend: str = "auto",
) -> None:
    """A step of Adam (Kingma and Ba 2015, algorithm 1) of several parameters, in place; no device value is read.

    Args:
        rules: One for each parameter.
        parameters: float32, any shapes, contiguous.
        gradients: float32, of the same shapes. Not differentiable.
        means: float32, of the same shapes, contiguous: the first moments.
        squares: float32, of the same shapes, contiguous, >= 0: the second moments.
        guard: Leaves the step out where it has ``found`` something; None for never.
        loss: float32 [], of the step. With it the guard judges first: the step is left out, and counted as such, unless
            the magnitudes of the loss, and of the gradients whose rule has ``every``, are all below the limit.
        backend: "auto", "reference" or "native".

    Raises:
        ValueError: a tensor that is not contiguous, lists of other lengths, a loss without a guard.

    Examples:
        >>> import torch
        >>> from voronerf.ops import Rule, adam
        >>> steps, weight, mean, square = torch.zeros(()), torch.zeros(2), torch.zeros(2), torch.zeros(2)
        >>> adam([Rule(steps, 0.25)], [weight], [torch.tensor([0.5, -2.0])], [mean], [square])
        >>> weight, steps
        (tensor([-0.2500,  0.2500]), tensor(1.))
    """
    lists = {"parameters": parameters, "gradients": gradients, "means": means, "squares": squares}
    for name, given in {"rules": rules, **lists}.items():
        if not isinstance(given, Sequence):
            raise TypeError(f"{_ALL}: {name} must be a list, got {type(given).__name__}")
        if len(given) != len(rules):
            raise ValueError(f"{_ALL}: {name} must be as many as the {len(rules)} rules, got {len(given)}")
    if not rules:
        return
    before: Any = None
    for rule in rules:
        if not isinstance(rule, Rule):
            raise TypeError(f"{_ALL}: rules must hold a Rule for each parameter, got {type(rule).__name__}")
        if before is None or rule[1:] != before[1:]:  # a training has the same rule many times
            _check_rule(_ALL, rule)
        before = rule
    steps = [rule.step for rule in rules]
    if not _are_plain(parameters, gradients, means, squares) or not _are_scalars(steps, parameters[0].device):
        for own in zip(*lists.values(), strict=True):
            _check(_ALL, dict(zip(lists, own, strict=True)))
        check_same_device(_ALL, **{f"parameters[{index}]": tensor for index, tensor in enumerate(parameters)})
        for step in steps:
            _check_scalar("step", step, parameters[0])
    if guard is not None:
        if not isinstance(guard, Guard):
            raise TypeError(f"{_ALL}: guard must be a Guard, got {type(guard).__name__}")
        check_number(_ALL, "limit", guard.limit)
        for name, scalar in zip(guard._fields, guard[:4]):
            if scalar is not None:
                _check_scalar(name, scalar, parameters[0])
    if loss is not None:
        if guard is None:
            raise ValueError(f"{_ALL}: loss must come with a guard, got none")
        _check_scalar("loss", loss, parameters[0])
        loss = loss.detach()
    run = backends.resolve(_ALL, backend=backend, device=parameters[0].device, dtype=torch.float32)
    run(rules, [gradient.contiguous() for gradient in gradients], parameters, means, squares, guard, loss)


@torch.no_grad()
def sparse_adam(
    parameter: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    *,
    step: int,
    learning_rate: float,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
    backend: str = "auto",
) -> None:
    """Updates the entries of a parameter whose gradient is not zero, in place, by Adam.

    An entry without a gradient keeps its value and both moments: they do not decay, and the entry does not move on by
    its old mean, as tiny-cuda-nn does it with its hash grids. Where the gradient is not zero, the update is that of
    Kingma and Ba 2015, algorithm 1, and of ``torch.optim.Adam``:

        mean    <- b1 mean + (1 - b1) g
        square  <- b2 square + (1 - b2) g^2
        p       <- p - rate / (1 - b1^step) mean / (sqrt(square) / sqrt(1 - b2^step) + epsilon)

    ``step`` counts the steps of the whole parameter, whether an entry had a gradient in them or not. So an entry that
    gets its first gradient late moves by less than the rate at first, by (1 - b1) / sqrt(1 - b2) of it.

    Args:
        parameter: float32, any shape, contiguous.
        gradient: float32, of the same shape. Not differentiable.
        mean: float32, of the same shape, contiguous: the first moment.
        square: float32, of the same shape, contiguous, >= 0: the second moment.
        step: the number of this step, from 1.
        learning_rate: the rate.
        betas: decay of the two moments, in [0, 1).
        epsilon: > 0, added outside of the root.
        backend: "auto", "reference", "native" or "warp".

    Raises:
        ValueError: a tensor that is not contiguous.

    Examples:
        >>> import torch
        >>> from voronerf.ops import sparse_adam
        >>> table, mean, square = torch.zeros(3, 2), torch.zeros(3, 2), torch.zeros(3, 2)
        >>> gradient = torch.tensor([[0.0, 0.0], [0.5, -2.0], [0.0, 0.0]])
        >>> sparse_adam(table, gradient, mean, square, step=1, learning_rate=0.25)
        >>> table
        tensor([[ 0.0000,  0.0000],
                [-0.2500,  0.2500],
                [ 0.0000,  0.0000]])
    """
    if not _are_plain([parameter], [gradient], [mean], [square]):
        _check(_OP, {"parameters": parameter, "gradients": gradient, "means": mean, "squares": square})
    check_integer(_OP, "step", step, 1)
    check_number(_OP, "learning_rate", learning_rate)
    _check_decay(_OP, betas, epsilon)
    run = backends.resolve(_OP, backend=backend, device=parameter.device, dtype=torch.float32)
    first, second = betas
    rate, epsilon = corrected(step, learning_rate, betas, epsilon)
    run(parameter, gradient.contiguous(), mean, square, rate, first, second, epsilon)


def _are_plain(*lists: Sequence[Any]) -> bool:
    """Whether the tensors of all parameters keep all rules, found in one pass without names for messages."""
    if not isinstance(lists[0][0], Tensor):
        return False
    device = lists[0][0].device
    for own in zip(*lists, strict=True):
        shape: torch.Size | None = None
        for tensor in own:
            if not isinstance(tensor, Tensor) or tensor.layout is not torch.strided or tensor.is_nested:
                return False
            shape = tensor.shape if shape is None else shape
            if tensor.dtype is not torch.float32 or tensor.shape != shape or tensor.device != device:
                return False
            if not tensor.is_contiguous() or tensor.is_neg():
                return False
    return True


def _check(op: str, tensors: dict[str, Tensor]) -> None:
    """Checks the tensors of one parameter, named after their lists."""
    check_tensor(op, "parameter", tensors["parameters"])
    shape = tensors["parameters"].shape
    for name, tensor in tensors.items():
        one = name[:-1]
        check_tensor(op, one, tensor)
        check_dtype(op, one, tensor, (torch.float32,))
        if tensor.shape != shape:
            raise ValueError(f"{op}: {one} must have shape {list(shape)}, got {list(tensor.shape)}")
        if one != "gradient":
            check_writable(op, one, tensor)
    check_same_device(op, **{name[:-1]: tensor for name, tensor in tensors.items()})


def _are_scalars(steps: Sequence[Any], device: torch.device) -> bool:
    """Whether the steps keep all rules."""
    return all(
        isinstance(step, Tensor) and step.dtype is torch.float32 and not step.shape and step.device == device
        for step in steps
    )


def _check_scalar(name: str, tensor: Tensor, parameter: Tensor) -> None:
    check_shape(_ALL, name, tensor, ())
    check_dtype(_ALL, name, tensor, (torch.float32,))
    check_same_device(_ALL, **{"parameters[0]": parameter, name: tensor})


def _check_rule(op: str, rule: Rule) -> None:
    if not isinstance(rule.learning_rate, Tensor):
        check_number(op, "learning_rate", rule.learning_rate)
    _check_decay(op, rule.betas, rule.epsilon)


def _check_decay(op: str, betas: tuple[float, float], epsilon: float) -> None:
    check_number(op, "epsilon", epsilon)
    if not isinstance(betas, (tuple, list)) or len(betas) != 2:
        raise TypeError(f"{op}: betas must be a pair of numbers, got {betas!r:.60}")
    for beta in betas:
        check_number(op, "betas", beta)
        if not 0 <= beta < 1:
            raise ValueError(f"{op}: betas must lie in [0, 1), got {betas}")
    if not epsilon > 0:
        raise ValueError(f"{op}: epsilon must be positive, got {epsilon}")


def corrected(step: int, learning_rate: float, betas: tuple[float, float], epsilon: float) -> tuple[float, float]:
    """Rate and epsilon with which the moments need no correction for their start at zero."""
    first, second = betas
    root = (1 - second**step) ** 0.5
    return learning_rate * root / (1 - first**step), epsilon * root
