"""``routed_mlp`` of the compiled module: a layer table as a program on samples in any order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from voronerf.ops._core.layers import MLP
from voronerf.ops.grouped_mlp.network import Given, Network, as_network
from voronerf.ops.routed_program.native import of_cells, run_routed
from voronerf.ops.routed_program.reference import Where


def routed_mlp(
    positions: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor | None], **given: Any
) -> tuple[Tensor, Tensor]:
    """Output in the order of the positions, and the cells; see ``voronerf.ops.routed_mlp``."""
    (out,), cells = run_routed(*prepared(positions, weights, biases, **given))
    return out, cells


def prepared(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
    **places: Any,
) -> tuple[Network, Where]:
    """A network, and what tells the cells; ``places`` are those of `Where`. With neither cells nor centres there is one
    cell."""
    where = Where(**places)
    network = as_network(Given(positions, weights, biases, layers, directions, direction_index, features), "routed_mlp")
    return network, of_cells(where, weights[0].shape[0])
