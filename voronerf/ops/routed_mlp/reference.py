"""The whole route: locate, sort, run every sample through the network of its cell, put the results back in order.

n samples, r rays, k cells, m centres of all diagrams together, g diagrams, p and q features of a position and a
direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.layers import MLP
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.grouped_mlp import grouped_mlp
from voronerf.ops.grouped_mlp.reference import check_direction_index
from voronerf.ops.routed_program.reference import Where, find_cells, first_rows


def routed_mlp(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
    backend: str = "reference",
    **where: Any,
) -> tuple[Tensor, Tensor]:
    """Output [n, out] in the order of the positions, and the cells; see ``voronerf.ops.routed_mlp``.

    ``backend`` is that of the operations it is made of.
    """
    places = Where(**where)
    k, n = weights[0].shape[0], positions.shape[0]
    check_direction_index("routed_mlp", directions, direction_index)
    read: dict[str, Any] = {"layers": layers, "directions": directions, "direction_index": direction_index}
    read |= {"features": features, "backend": backend}
    cells = find_cells("routed_mlp", places, k, backend)
    if cells is None:
        offsets = torch.tensor([0, n], dtype=torch.int32, device=positions.device)
        out = grouped_mlp(positions, offsets, weights, biases, **read)
        cells = torch.zeros(n, dtype=torch.int32, device=positions.device)
        (out,), cells = first_rows([out], cells, places.rows)
        return out, cells
    order, offsets = cell_sort(cells, k, backend=backend)
    if direction_index is not None:
        read["direction_index"] = direction_index[order]
    elif directions is not None:
        read["directions"] = directions[order]
    out = grouped_mlp(positions[order], offsets, weights, biases, **read)
    # The backward of index_copy is a gather, where that of an index would be a scatter that adds.
    (out,), cells = first_rows([torch.zeros_like(out).index_copy(0, order.long(), out)], cells, places.rows)
    return out, cells


# A compiler that traces this finds only the implementations that are loaded before.
for _op in ("nearest_centre", "locate_cell", "cell_sort", "grouped_mlp"):
    backends.chosen(_op, torch.device("cpu"), torch.float32, backend="reference")
