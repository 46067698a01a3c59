"""A whole network for each cell. n samples, r rays, k cells, p and q features of a position and a direction."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.checks import INDEX, Row
from voronerf.ops._core.layers import MLP
from voronerf.ops.grouped_mlp.checks import Layered

_OP = backends.declare("grouped_mlp", runs="grouped_program")
_OFFSETS = Row("offsets", INDEX, ("k+1",), empty="must have at least two entries")


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
    """Evaluates every sample by the network of its cell, encodings included.

    Equivalent to ``frequency_encode`` (or ``integrated_encode``) where ``layers`` has octaves, ``hash_encode`` where it
    has a grid, or ``spherical_harmonics`` of the directions where it has a degree, followed by one ``grouped_linear``
    for each layer on the concatenation of its sources. Gradients of every order to positions, directions, features,
    weights and biases. Of weights in 16 bits, and under ``torch.autocast``, operands of products are rounded, and the
    result; all else is float32 at least.

    Args:
        positions: [n, p] floating point, sorted by cell, n < 2**31; raw if the table has octaves, else already encoded.
            p >= 1 if a layer reads them, like q >= 1 for directions. p = 6, mean and diagonal variance, for the
            integrated encoding.
        offsets: int32 [k + 1], rising; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells
            (before ``offsets[0]``, from ``offsets[k]`` on) give 0. Cells may be empty.
        weights: one [k, o, i] for each layer, all of one dtype; i as ``layers.input_width`` says.
        biases: one [k, o] or None for each layer.
        layers: the layer table.
        directions: [n, q], or [r, q] with ``direction_index``; None where no layer reads directions. q = 3, unit
            vectors, for spherical harmonics.
        direction_index: int32 [n], values 0 to r - 1: the row of ``directions`` of each sample.
        features: the table of the hash encoding, [e, f] for all cells (``layers.grid.table_shape``), or [k, e, f] with
            one for each cell; None without a grid.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        [n, layers.out_features] in the dtype of the weights (of autocast, where it is on).

    Raises:
        ValueError: on the CPU offsets that fall or exceed n, and a direction_index outside 0 to r - 1.

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
    (out,) = network.given(_OP).run(offsets, backend=backend, op=_OP)
    return out
