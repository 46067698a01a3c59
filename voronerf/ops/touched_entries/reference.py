"""Gradients of tables of which a step touches few entries. n entries of all tables."""

from __future__ import annotations

import torch
from torch import Tensor

_WORD = 32  # entries that share a number of bits


def pack_entries(gradient: Tensor) -> Tensor:
    """A bit for each entry that is not zero, as bits of float32, and behind them these; see ``voronerf.ops``."""
    touched = gradient != 0
    bits = torch.nn.functional.pad(touched, (0, -len(gradient) % _WORD)).view(-1, _WORD).long()
    words = (bits << torch.arange(_WORD, device=gradient.device)).sum(1).to(torch.int32)
    return torch.cat((words.view(torch.float32), gradient[touched]))


def add_entries(message: Tensor, total: Tensor) -> None:
    """Adds the entries of a message to all [n]; see ``voronerf.ops``."""
    n, length = len(total), len(message)
    words, values = message.tensor_split((-(-n // _WORD),))
    bits = words.view(torch.int32)[:, None] >> torch.arange(_WORD, device=message.device, dtype=torch.int32)
    touched = (bits & 1).bool().view(-1)[:n]
    if len(words) != -(-n // _WORD) or int(touched.sum()) != len(values):
        raise ValueError(f"add_touched: bits of a message must tell its length, got {length} numbers for {n}")
    total[touched] += values
