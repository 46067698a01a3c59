"""``balance_centres`` of the compiled module. m samples, k centres."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("balance_centres")
_inputs = _OP.inputs(
    native.compiled.BalanceInputs, neighbours=lambda arguments: min(arguments.neighbours, arguments.k - 1)
)


@_OP.custom_op("balance_centres_native", devices=("cpu",))
def balance_centres(arguments: Any, results: tuple[Tensor, Tensor]) -> None:
    """Repeats the update of Elsner et al. 2023; see ``voronerf.ops.balance_centres``."""
    moved, weights = results
    cells = moved.new_empty(arguments.m, dtype=torch.int32)
    workspace = weights.new_empty(native.compiled.balance_centres_workspace(arguments.k))
    moved.copy_(arguments.centres)
    native.compiled.balance_centres(_inputs(arguments), moved, weights, cells, workspace, native.cpu())
