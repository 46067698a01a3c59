"""``grouped_mlp`` of the compiled module: a program on rows that are sorted by cell."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from voronerf.ops._core.layers import MLP
from voronerf.ops.grouped_mlp.network import Given, as_network


def grouped_mlp(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
) -> Tensor:
    """Every sample through the network of its cell; see ``voronerf.ops.grouped_mlp``."""
    given = Given(positions, weights, biases, layers, directions, direction_index, features)
    (out,) = as_network(given, "grouped_mlp").run(offsets)
    return out
