"""The grouped operations in as few lines as they can be said in: what the faster forms beside this file are tested
against.

n samples, r rays, k cells, i inputs and o outputs of a layer, p and q raw features of a position and a direction.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from voronerf.layers import DIRECTIONS, MLP, POSITIONS
from voronerf.reference.activation import activate
from voronerf.reference.frequency_encode import frequency_encode
from voronerf.reference.integrated_encode import integrated_encode

Linear = Callable[..., Tensor]


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, *, activation: str = "none"
) -> Tensor:
    """One plain linear layer after another, over the rows of each cell."""
    y = x.new_zeros(x.shape[0], weight.shape[1])
    for cell, (start, stop) in enumerate(itertools.pairwise(offsets.tolist())):
        linear = torch.nn.functional.linear(x[start:stop], weight[cell], None if bias is None else bias[cell])
        y = torch.cat([y[:start], activate(activation, linear), y[stop:]])
    return y


def grouped_mlp(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    linear: Linear = grouped_linear,
) -> Tensor:
    """Encode, then every layer of the table on the concatenation of its sources, by whichever ``linear``."""
    dtype = weights[0].dtype
    sources: dict[int | str, Tensor] = {POSITIONS: encode_positions(positions, layers).to(dtype)}
    if directions is not None:
        encoded = encode(directions, layers.direction_octaves).to(dtype)
        sources[DIRECTIONS] = encoded if direction_index is None else encoded[direction_index]
    for index, (layer, weight, bias) in enumerate(zip(layers.layers, weights, biases)):
        x = torch.cat([sources[source] for source in layer.inputs], dim=1)
        sources[index] = linear(x, offsets, weight, bias, activation=layer.activation)
    return torch.cat([sources[index] for index in layers.outputs], dim=1)


def encode_positions(positions: Tensor, layers: MLP) -> Tensor:
    """Positions as the layers of a table read them."""
    if not layers.integrated:
        return encode(positions, layers.position_octaves)
    assert layers.position_octaves is not None
    means, variances = positions.to(torch.promote_types(positions.dtype, torch.float32)).chunk(2, dim=1)
    return integrated_encode(means, variances, layers.position_octaves)


def encode(x: Tensor, octaves: int | None) -> Tensor:
    """Raw features encoded, in float32 at least; what is encoded already as it is."""
    return x if octaves is None else frequency_encode(x.to(torch.promote_types(x.dtype, torch.float32)), octaves)
