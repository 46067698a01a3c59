"""Gradients of tables that all ranks have, of which a step touches few entries: these alone travel. n entries."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import Implementation
from voronerf.checks import Checked, check_integer

_NATIVE = Implementation(("cpu",), (torch.float32,), file="touched_entries")
_PACK, _ADD = (
    backends.declare(op, native=_NATIVE, reference=Implementation(file="touched_entries"))
    for op in ("pack_entries", "add_entries")
)


def pack_entries(gradient: Tensor, *, backend: str = "auto") -> Tensor:
    """What another rank must be told of a gradient.

    Args:
        gradient: float32 [n], n < 2**31.
        backend: "auto", "reference" or "native".

    Returns:
        float32: a bit for each entry that says whether it is not zero, as bits of float32, and behind them the values
        of these; the gradient itself where that would be as long.

    Raises:
        ValueError: A shape.
        TypeError: A dtype.
        BackendUnavailable: The named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf.ops import pack_entries
        >>> len(pack_entries(torch.tensor([0.0, 0, 0, 2, 0]))), len(pack_entries(torch.ones(5)))
        (2, 5)
    """
    Checked(_PACK).tensor("gradient", gradient, (torch.float32,), "n")
    if gradient.is_meta:
        raise ValueError(f"{_PACK}: gradient must have values, got a tensor on meta")
    run = backends.resolve(_PACK, backend=backend, device=gradient.device, dtype=gradient.dtype)
    message: Tensor = run(gradient.detach())
    return message if len(message) < len(gradient) else gradient


def add_entries(parts: Sequence[Tensor], n: int, *, backend: str = "auto") -> Tensor:
    """The sum of what `pack_entries` gave on each rank, in their order, so that all ranks get the same.

    Args:
        parts: float32, one message for each rank, at least one.
        n: Entries of the gradient.
        backend: "auto", "reference" or "native".

    Returns:
        float32 [n].

    Raises:
        ValueError: A message of another length; devices.
        TypeError: dtypes.
        BackendUnavailable: The named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf.ops import add_entries, pack_entries
        >>> first, second = torch.tensor([0.0, 0, 0, 2, 0]), torch.tensor([1.0, 2, 3, 4, 5])
        >>> add_entries([pack_entries(first), pack_entries(second)], 5)
        tensor([1., 2., 3., 6., 5.])
    """
    if not isinstance(parts, Sequence):
        raise TypeError(f"{_ADD}: parts must be a list, got {type(parts).__name__}")
    check_integer(_ADD, "n", n, 0)
    if not parts:
        raise ValueError(f"{_ADD}: parts must hold at least one message, got none")
    given = Checked(_ADD)
    for index, part in enumerate(parts):
        given.tensor(f"parts[{index}]", part, (torch.float32,), "length")
        given.sizes.clear()
    run = backends.resolve(_ADD, backend=backend, device=parts[0].device, dtype=parts[0].dtype)
    total = parts[0].new_zeros(n)
    for index, part in enumerate(parts):
        if len(part) == n:
            total += part
            continue
        try:
            run(part, total)
        except ValueError:
            raise ValueError(
                f"{_ADD}: parts[{index}] must be as long as its bits tell, got {len(part)} numbers for {n} entries"
            ) from None
    return total
