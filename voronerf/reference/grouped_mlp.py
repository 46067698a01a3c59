"""The whole per-cell network. n samples, r rays, k cells, p and q raw features of a position and a direction."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf.layers import DIRECTIONS, MLP, POSITIONS
from voronerf.reference.frequency_encode import frequency_encode
from voronerf.reference.grouped_linear import grouped_linear


def grouped_mlp(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
) -> Tensor:
    """Every sample through the network of its cell; see ``voronerf.ops.grouped_mlp``."""
    sources: dict[int | str, Tensor] = {POSITIONS: _encode(positions, layers.position_octaves).to(weights[0].dtype)}
    if directions is not None:
        encoded = _encode(directions, layers.direction_octaves).to(weights[0].dtype)
        sources[DIRECTIONS] = encoded if direction_index is None else encoded[direction_index]
    for index, (layer, weight, bias) in enumerate(zip(layers.layers, weights, biases)):
        x = torch.cat([sources[source] for source in layer.inputs], dim=1)
        sources[index] = grouped_linear(x, offsets, weight, bias, activation=layer.activation)
    return torch.cat([sources[index] for index in layers.outputs], dim=1)


def _encode(x: Tensor, octaves: int | None) -> Tensor:
    return x if octaves is None else frequency_encode(x, octaves)
