"""Gradients of tables of which a step touches few entries, on the CPU. n entries.

No custom ops, because nothing is traced or differentiated through what ranks send.
"""

from __future__ import annotations

from torch import Tensor

from voronerf import native


def pack_entries(gradient: Tensor) -> Tensor:
    """A bit for each entry that is not zero, as bits of float32, and behind them these; see ``voronerf.ops``."""
    n = len(gradient)
    message = gradient.new_empty(-(-n // 32) + n + 16)
    return message[: native.compiled.pack_touched(gradient, n, message, native.cpu())]


def add_entries(message: Tensor, total: Tensor) -> None:
    """Adds the entries of a message to all [n]; see ``voronerf.ops``."""
    native.compiled.add_touched(message, len(message), len(total), total, native.cpu())
