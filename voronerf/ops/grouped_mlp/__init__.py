"""A whole network for each cell. n samples, r rays, k cells, p and q features of a position and a direction."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.checks import INDEX, TensorRule
from voronerf.ops._core.layers import MLP
from voronerf.ops.grouped_mlp.checks import Layered

_OP = backends.declare("grouped_mlp", runs="grouped_program")
_OFFSETS = TensorRule("offsets", INDEX, ("k+1",), empty="must have at least two entries")


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
    backend: str = "auto",
) -> Tensor:
    """Evaluates every sample with the network of its cell, including encodings.

    Equivalent to the encodings, followed by one ``grouped_linear`` for each layer on the concatenation of its sources.
    The encodings are ``frequency_encode`` (or ``integrated_encode``) if ``layers`` has octaves, ``hash_encode`` if it
    has a grid, and ``spherical_harmonics`` of the directions if it has a degree. Positions, directions, features,
    weights and biases have gradients of every order. With 16-bit weights, and under ``torch.autocast``, the operands
    of products and the result are rounded to 16 bits; all other values are float32 at least.

    Args:
        positions: [n, p] floating point, sorted by cell, n < 2**31; raw if ``layers`` encodes them, else already
            encoded. p >= 1 if a layer reads positions, and q >= 1 if a layer reads directions. For the integrated
            encoding p = 6: mean and diagonal variance.
        offsets: int32 [k + 1], ascending; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells
            (before ``offsets[0]`` or from ``offsets[k]`` on) give 0. Cells may be empty.
        weights: one [k, o, i] for each layer, all of one dtype; i is ``layers.input_width``.
        biases: one [k, o] or None for each layer.
        layers: the layer table.
        directions: [n, q], or [r, q] with ``direction_index``; None if no layer reads directions. For spherical
            harmonics q = 3: unit vectors.
        direction_index: int32 [n], values 0 to r - 1: the row of ``directions`` of each sample.
        features: the table of the hash encoding: one [e, f] for all cells (``layers.grid.table_shape``), or [k, e, f],
            one table for each cell; None without a grid.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        [n, layers.out_features] in the dtype of the weights (or of autocast, if it is enabled).

    Raises:
        ValueError: offsets decrease or exceed n, or a direction_index is outside 0 to r - 1 (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer, grouped_mlp
        >>> table = MLP((Layer(("positions",), 16, "relu"), Layer((0,), 4)), outputs=(1,), position_octaves=6)
        >>> weights = [torch.ones(2, o, i) / i for o, i in table.weight_shapes(3)]  # two cells
        >>> biases = [torch.zeros(2, layer.width) for layer in table.layers]
        >>> positions = torch.zeros(5, 3)
        >>> offsets = torch.tensor([0, 3, 5], dtype=torch.int32)
        >>> out = grouped_mlp(positions, offsets, weights, biases, layers=table)
        >>> out.shape
        torch.Size([5, 4])
    """
    network = Layered(positions, weights, biases, layers, directions, direction_index, features)
    network.check(_OP, ([_OFFSETS], [offsets]))
    (out,) = network.arguments(_OP).run(offsets, backend=backend, op=_OP)
    return out
