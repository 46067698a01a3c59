"""The evaluation of samples by the networks of their cells. n samples, r rays, k cells, m centres of all diagrams
together, g diagrams, p and q features of a position and a direction."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.layers import MLP
from voronerf.ops.grouped_mlp import layered
from voronerf.ops.network import OP, Cells

_OP = backends.declare("routed_mlp", runs=OP)


def routed_mlp(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    centres: Tensor | None = None,
    child_offsets: Tensor | None = None,
    child: Tensor | None = None,
    depth: int = 1,
    cells: Tensor | None = None,
    coords: Tensor | None = None,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
    frozen: Tensor | None = None,
    rows: Tensor | None = None,
    centre_index: Tensor | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Evaluates every sample with the network of its cell; results are in the order of the samples.

    Equivalent to ``locate_cell``, ``cell_sort``, permuting the inputs, ``grouped_mlp``, and undoing the permutation.
    The native CPU implementation gathers and scatters rows inside the tiles of the network. It makes no permuted copy,
    and for the backward pass keeps only the order (int32) and the features of hashed positions. Positions,
    directions, features, weights and biases have gradients of every order; the choice of the cell has none. A sample
    whose coordinates are not finite goes to the first cell, as in ``locate_cell``. With one cell
    (k = 1), neither ``centres`` nor ``cells`` is needed, and the samples are neither located nor sorted.

    Args:
        positions: [n, p] floating point, n < 2**31: the input of the layers, as in ``grouped_mlp``.
        weights: one [k, o, i] for each layer, all of one dtype.
        biases: one [k, o] or None for each layer.
        layers: the layer table.
        centres: [m, 3], the centres of the tree as in ``locate_cell``; or [k, 3], the centres of a flat diagram,
            without ``child_offsets`` and ``child``.
        child_offsets: int32 [g + 1], or None for a flat diagram.
        child: int32 [m], or None for a flat diagram. The leaves are the cells, 0 to k - 1.
        depth: the number of levels of the tree.
        cells: int32 [n], the cell of each sample, 0 to k - 1, for example a stochastic or a reused assignment; given
            instead of ``centres``, ``child_offsets`` and ``child``.
        coords: [n, 3] floating point, the locations of the samples; None uses the first three features of the
            positions.
        directions: [n, q], or [r, q] with ``direction_index``; None if no layer reads directions.
        direction_index: int32 [n], values 0 to r - 1: the row of ``directions`` of each sample.
        features: the table of the hash encoding, as in ``grouped_mlp``; None without a grid.
        frozen: bool [k], the frozen cells, or None. Samples of frozen cells have no gradients at all. The CPU drops
            them from the backward pass, unless positions or directions have gradients.
        rows: int32 [1], the number of valid leading samples, for example from `march_rays` with a capacity; None for
            all. Later samples have output 0, no gradient, and cell -1. On CUDA the host does not wait for this number.
        centre_index: the index of the centres of a flat diagram by `index_centres`, or None.
        backend: "auto", "reference", "native" or "warp". Without a fused implementation, "auto" calls the separate
            operations, each with its own choice of backend.

    Returns:
        The output [n, layers.out_features] in the dtype of the weights (or of autocast, if it is enabled), and cells
        int32 [n].

    Raises:
        ValueError: ``child_offsets`` and ``child`` do not form a tree, a cell is outside 0 to k - 1, or a
            direction_index is outside 0 to r - 1 (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer, routed_mlp
        >>> table = MLP((Layer(("positions",), 1),), outputs=(0,))  # one linear layer, no encoding
        >>> weights = [torch.tensor([[[1.0, 0, 0]], [[100.0, 0, 0]]])]
        >>> positions = torch.tensor([[0.9, 0, 0], [0.1, 0, 0], [0.8, 0, 0]])
        >>> centres = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
        >>> out, cells = routed_mlp(positions, weights, [None], layers=table, centres=centres)
        >>> cells
        tensor([1, 0, 1], dtype=torch.int32)
        >>> out.flatten().round(decimals=4)  # in the order of the positions
        tensor([90.0000,  0.1000, 80.0000])
    """
    where = Cells(None, None, cells, centres, child_offsets, child, depth, coords, centre_index, rows, frozen)
    network, inputs = layered(_OP, layers, positions, directions, direction_index, weights, biases, features)
    (out,), found = network(inputs, where, ray_index=direction_index if len(inputs) > 1 else None, backend=backend)
    assert found is not None
    return out, found
