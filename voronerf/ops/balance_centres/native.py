"""``balance_centres`` of the compiled module. m samples, k centres."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op


@custom_op("balance_centres_native", devices=("cpu",))
def balance_centres(
    samples: Tensor, masses: Tensor, centres: Tensor, steps: int, alpha: float, neighbours: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """The published update, repeated; see ``voronerf.ops.balance_centres``."""
    m, k = samples.shape[0], centres.shape[0]
    moved, weights = centres.new_empty(centres.shape), masses.new_empty(k)
    yield moved, weights
    compiled = native.compiled
    given = compiled.BalanceInputs(
        samples=samples, masses=masses, m=m, k=k, steps=steps, alpha=alpha, neighbours=min(neighbours, k - 1)
    )
    cells = samples.new_empty(m, dtype=torch.int32)
    workspace = masses.new_empty(compiled.balance_centres_workspace(k))
    compiled.balance_centres(given, moved.copy_(centres), weights, cells, workspace, native.cpu())
