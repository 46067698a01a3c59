"""Gradients of tables that all ranks have, of which a step touches few entries: these alone travel.

n entries of all tables.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf import backends

_WORD = 32  # entries that share a number of bits


def pack_entries(gradient: Tensor) -> Tensor:
    """What another rank must be told of a gradient float32 [n].

    It has a bit for each entry that says whether it is not zero, as bits of float32, and behind them the values of
    these. Where that would be as long, it is the gradient itself.
    """
    if _natively(gradient):
        from voronerf.ops.touched_entries.native import pack_touched  # which is there where the compiled module is

        message = pack_touched(gradient)
    else:
        touched = gradient != 0
        bits = torch.nn.functional.pad(touched, (0, -len(gradient) % _WORD)).view(-1, _WORD).long()
        words = (bits << torch.arange(_WORD, device=gradient.device)).sum(1).to(torch.int32)
        message = torch.cat((words.view(torch.float32), gradient[touched]))
    return message if len(message) < len(gradient) else gradient


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
        elif _natively(part):
            from voronerf.ops.touched_entries.native import add_touched

            add_touched(part, total)
        else:
            words, values = part.tensor_split((-(-n // _WORD),))
            bits = words.view(torch.int32)[:, None] >> torch.arange(_WORD, device=part.device, dtype=torch.int32)
            total[(bits & 1).bool().view(-1)[:n]] += values
    return total


def _natively(tensor: Tensor) -> bool:
    return tensor.device.type == "cpu" and backends.missing("native", tensor.device) is None
