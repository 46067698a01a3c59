"""Layer tables as programs, for the ops that run them. n samples, r rays, k cells, p and q features of a raw position
and direction.

Samples are read and results written as they are stored where all are bfloat16; else, and parameters always, a cell
having few of them, they are cast to float32 on the way in and back on the way out. With bfloat16 storage, or
under autocast to it, products take bfloat16 operands where the processor multiplies them faster (AVX512-BF16, AMX), and
float32 ones elsewhere; sums are float32 always.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.layers import MLP, program_text
from voronerf.ops.grouped_mlp.reference import encode_directions, encode_positions
from voronerf.ops.grouped_program.native import How, Rows, run_program


class Given(NamedTuple):
    """Samples and parameters as the public functions take them."""

    positions: Tensor
    weights: Sequence[Tensor]
    biases: Sequence[Tensor | None]
    layers: MLP
    directions: Tensor | None = None
    direction_index: Tensor | None = None
    features: Tensor | None = None


class Network(NamedTuple):
    """A network as the program op takes it.

    Attributes:
        inputs: positions, and directions if any layer reads them, in float32, or all in the bfloat16 of the result.
        parameters: weights, biases and the table of a hash grid, in float32 but for that.
        ray_index: int32 [n] where directions have one row for each ray, or None.
        how: it runs.
        dtype: of the result: that of the weights, or autocast's where that is on.
        given: what inputs and parameters were made of, in their order.
    """

    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    ray_index: Tensor | None
    how: How
    dtype: torch.dtype
    given: Sequence[Tensor]

    def rows(self, offsets: Tensor, order: Tensor | None = None) -> Rows:
        """What the program runs on, for rows of cells by offsets [k + 1] and an order."""
        return Rows(self.inputs, self.parameters, offsets, order, self.ray_index)

    def run(self, offsets: Tensor, order: Tensor | None = None) -> list[Tensor]:
        """The results, [n, w] each."""
        found = run_program(self.rows(offsets, order), self.how)
        return [out if out.dtype is self.dtype else out.to(self.dtype) for out in found]


def half_products(dtype: torch.dtype) -> str:
    """What products take for results of a dtype."""
    return _HALF.get(dtype, "float32")


_HALF = {torch.bfloat16: "bfloat16", torch.float16: "float16"}


def as_network(given: Given, caller: str) -> Network:
    """A layer table with its tensors; ``caller``: the op that errors name. Octaves and harmonics of float64 are
    computed in float64, beforehand."""
    positions, weights, biases, layers, directions, index, features = given
    kind = positions.device.type
    dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else weights[0].dtype
    if positions.dtype == torch.float64 and layers.position_octaves is not None:
        positions = encode_positions(positions, layers)
        layers = replace(layers, position_octaves=None, position_encoding="frequency")
    encoded = layers.direction_octaves is not None or layers.direction_degree is not None
    if directions is not None and directions.dtype == torch.float64 and encoded:
        directions = encode_directions(directions, layers)
        layers = replace(layers, direction_octaves=None, direction_encoding="frequency", direction_degree=None)
    taken = [*weights, *(bias for bias in biases if bias is not None)]
    parameters = [p if p.dtype is torch.float32 else p.float() for p in taken]
    if features is not None:
        taken.append(features)
        features = features.float() if features.dtype == torch.float64 else features
        parameters.append(features if features.dim() == 3 else features[None])
    rows = [positions]
    if directions is not None and layers.uses_directions:
        rows.append(directions)
    else:
        index = None
    stored = dtype is torch.bfloat16 and features is None  # hash grids read float32
    stored = stored and all(x.dtype is torch.bfloat16 for x in rows)
    inputs = rows if stored else [x if x.dtype is torch.float32 else x.float() for x in rows]
    p, q, *widths = [len(range(x.shape[1])) for x in (rows[0], rows[-1], *weights)]  # no symbols
    biased = tuple([bias is not None for bias in biases])
    text = program_text(layers.text, p, q if len(rows) > 1 else 0, tuple(widths), biased, index is not None)
    return Network(inputs, parameters, index, How(text, caller, half_products(dtype)), dtype, [*rows, *taken])
