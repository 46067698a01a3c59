"""Gradients of tables of which a step touches a part, for ``voronerf.distributed``, on the CPU. n entries."""

from __future__ import annotations

from torch import Tensor

from voronerf import native


def pack_touched(gradient: Tensor) -> Tensor:
    """A bit for each entry of a gradient float32 [n] that is not zero, as bits of float32, and behind them these."""
    n = len(gradient)
    message = gradient.new_empty(-(-n // 32) + n + 16)
    return message[: native.compiled.pack_touched(gradient, n, message, native.cpu())]


def add_touched(message: Tensor, total: Tensor) -> None:
    """Adds the entries of a message to all [n]."""
    native.compiled.add_touched(message, len(message), len(total), total, native.cpu())
