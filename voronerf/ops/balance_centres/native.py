"""``balance_centres`` of the compiled module. m samples, k centres."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("balance_centres")
_inputs = _OP.inputs(native.compiled.BalanceInputs, neighbours=lambda given: min(given.neighbours, given.k - 1))


@_OP.custom_op("balance_centres_native", devices=("cpu",))
def balance_centres(given: Any, found: tuple[Tensor, Tensor]) -> None:
    """The published update, repeated; see ``voronerf.ops.balance_centres``."""
    moved, weights = found
    cells = moved.new_empty(given.m, dtype=torch.int32)
    workspace = weights.new_empty(native.compiled.balance_centres_workspace(given.k))
    moved.copy_(given.centres)
    native.compiled.balance_centres(_inputs(given), moved, weights, cells, workspace, native.cpu())
