"""Evaluates one network that a layer table describes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from voronerf.layers import MLP
from voronerf.ops.grouped_mlp import grouped_mlp


def run_network(
    layers: MLP,
    linears: Sequence[nn.Linear],
    positions: Tensor,
    directions: Tensor | None = None,
    ray_index: Tensor | None = None,
    features: Tensor | None = None,
) -> Tensor:
    """The raw outputs [n, layers.out_features] of one network.

    Args:
        layers: its table.
        linears: its layers, in the table's order.
        positions: [n, 3], or Gaussians [n, 6] for the integrated encoding.
        directions: [n, 3], or [r, 3] together with `ray_index`; None where no layer reads them.
        ray_index: int32 [n].
        features: the table of the hash encoding, where `layers` have a grid.

    Raises:
        ValueError: shapes that disagree.
    """
    offsets = torch.tensor([0, positions.shape[0]], dtype=torch.int32, device=positions.device)
    return grouped_mlp(
        positions,
        offsets,
        [layer.weight[None] for layer in linears],
        [layer.bias[None] for layer in linears],
        layers=layers,
        directions=directions,
        direction_index=ray_index,
        features=features,
    )
