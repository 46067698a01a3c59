"""Gradients of tables that all ranks have, of which a step touches few entries: these alone travel.

n entries of all tables.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def pack_entries(gradient: Tensor) -> Tensor:
    """What another rank must be told of a gradient float32 [n].

    It has the numbers of the entries that are not zero, as bits of int32, and behind them their values. Where that
    would be as long, it is the gradient itself.
    """
    touched = gradient != 0
    if gradient.device.type == "cpu":  # torch takes three times as long
        numbers = torch.from_numpy(np.flatnonzero(touched.numpy()))
    else:
        numbers = touched.nonzero()[:, 0]
    if 2 * len(numbers) >= len(gradient):
        return gradient
    return torch.cat((numbers.int().view(torch.float32), gradient.index_select(0, numbers)))


def add_entries(parts: Sequence[Tensor], n: int) -> Tensor:
    """The sum [n] of what :func:`pack_entries` gave on each rank, in their order, so that all ranks get the same.

    Examples:
        >>> import torch
        >>> from voronerf.distributed.gradients import add_entries, pack_entries
        >>> first, second = torch.tensor([0.0, 0, 0, 2, 0]), torch.tensor([1.0, 2, 3, 4, 5])
        >>> len(pack_entries(first)), len(pack_entries(second))
        (2, 5)
        >>> add_entries([pack_entries(first), pack_entries(second)], 5)
        tensor([1., 2., 3., 6., 5.])
    """
    total = parts[0].new_zeros(n)
    for part in parts:
        if len(part) == n:
            total += part
        else:
            numbers, values = part.view(2, -1)
            total.index_add_(0, numbers.view(torch.int32), values)
    return total
