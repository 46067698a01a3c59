"""A whole network for each cell. n samples, r rays, k cells, p and q raw features of a position and a direction."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from voronerf.ops._core.encodings import ENCODINGS, wide
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS
from voronerf.ops.grouped_linear.reference import check_offsets, grouped_linear
from voronerf.ops.hash_encode.reference import hash_encode


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
    linear: Callable[..., Tensor] = grouped_linear,
) -> Tensor:
    """Every sample through the network of its cell; see ``voronerf.ops.grouped_mlp``. ``linear`` runs each layer."""
    if not torch.compiler.is_compiling():
        check_offsets("grouped_mlp", offsets, positions.shape[0])
    check_direction_index("grouped_mlp", directions, direction_index)
    dtype = weights[0].dtype
    own = features is not None and features.dim() == 3
    encoded = encode_positions(positions, layers, features, cells_of(offsets, positions) if own else None)
    sources: dict[int | str, Tensor] = {POSITIONS: encoded.to(dtype)}
    if directions is not None and layers.uses_directions:
        encoded = encode_directions(directions, layers).to(dtype)
        sources[DIRECTIONS] = encoded if direction_index is None else encoded[direction_index]
    for index, (layer, weight, bias) in enumerate(zip(layers.layers, weights, biases)):
        x = torch.cat([sources[source] for source in layer.inputs], dim=1)
        sources[index] = linear(x, offsets, weight, bias, activation=layer.activation)
    return torch.cat([sources[index] for index in layers.outputs], dim=1)


def encode_positions(
    positions: Tensor, layers: MLP, features: Tensor | None = None, cells: Tensor | None = None
) -> Tensor:
    """Positions as the layers of a table read them; ``cells`` where each has features of its own."""
    if layers.grid is not None:
        assert features is not None
        return hash_encode(positions, features, layers.grid, cells=cells)
    return _encoded(positions, layers, POSITIONS)


def encode_directions(directions: Tensor, layers: MLP) -> Tensor:
    """Directions as the layers of a table read them."""
    return _encoded(directions, layers, DIRECTIONS)


def _encoded(x: Tensor, layers: MLP, source: str) -> Tensor:
    """Raw features encoded, in float32 at least; what is encoded already as it is."""
    encoding = layers.encoding(source)
    return x if encoding is None else ENCODINGS[encoding[0]].formula(wide(x), encoding[1])


def cells_of(offsets: Tensor, rows: Tensor) -> Tensor:
    """int32 [n], the cell of each row that is sorted by cell; the nearest one for a row of no cell."""
    index = torch.arange(rows.shape[0], dtype=torch.int32, device=rows.device)
    return torch.searchsorted(offsets[1:-1].contiguous(), index, right=True, out_int32=True)


def check_direction_index(op: str, directions: Tensor | None, direction_index: Tensor | None) -> None:
    """Raises ValueError for an index that names no ray; on the CPU, as it reads the index."""
    if directions is None or direction_index is None or direction_index.numel() == 0:
        return
    if direction_index.device.type != "cpu" or torch.compiler.is_compiling():
        return
    low, high = (int(bound) for bound in direction_index.aminmax())
    if low < 0 or high >= directions.shape[0]:
        last = directions.shape[0] - 1
        raise ValueError(f"{op}: direction_index must be 0 to {last}, got {low if low < 0 else high}")
