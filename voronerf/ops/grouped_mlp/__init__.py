"""A whole network for each cell. n samples, r rays, k cells, p and q features of a position and a direction."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.checks import check_shape, check_tensor
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS
from voronerf.ops._core.program import Names, Program
from voronerf.ops.network import OP, Cells, Network

_OP = backends.declare("grouped_mlp", runs=OP)


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
    network, inputs = layered(_OP, layers, positions, directions, direction_index, weights, biases, features)
    index = direction_index if len(inputs) > 1 else None
    (out,), _ = network(inputs, Cells(offsets), ray_index=index, backend=backend)
    return out


def layered(
    op: str,
    layers: MLP,
    positions: Tensor,
    directions: Tensor | None,
    direction_index: Tensor | None,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    features: Tensor | None,
) -> tuple[Network, list[Tensor]]:
    """Returns the network of a layer table and the inputs that it reads; raises the errors that concern the table."""
    if not isinstance(layers, MLP):
        raise TypeError(f"{op}: layers must be an MLP, got {type(layers).__name__}")
    if directions is None and layers.uses_directions:
        raise ValueError(f"{op}: directions must be given for layers that read them, got None")
    if directions is None and direction_index is not None:
        raise ValueError(f"{op}: direction_index must come with directions, got no directions")
    if features is not None:
        check_tensor(op, "features", features)
        if layers.grid is None:
            came = list(features.shape)
            raise ValueError(f"{op}: features must be None for layers without a hash grid, got {came}")
    elif layers.grid is not None:
        raise ValueError(f"{op}: features must be given for layers with a hash grid, got None")
    if not isinstance(positions, Tensor) or positions.dim() != 2:
        check_shape(op, "positions", positions, ("n", "p"))
    if directions is not None and (not isinstance(directions, Tensor) or directions.dim() != 2):
        check_shape(op, "directions", directions, ("n" if direction_index is None else "r", "q"))
    inputs = [positions]
    if directions is not None and layers.uses_directions:
        inputs.append(directions)
    p, q = (len(range(x.shape[1])) for x in (positions, inputs[-1]))  # plain ints, not symbolic ones
    q = q if len(inputs) > 1 else 0
    _check_widths(op, layers, p, q)
    count = len(layers.layers)
    for name, tensors in (("weights", weights), ("biases", biases)):
        if not isinstance(tensors, Sequence):
            raise TypeError(f"{op}: {name} must be a list, got {type(tensors).__name__}")
        if len(tensors) != count:
            raise ValueError(f"{op}: {name} must have one entry for each of {count} layers, got {len(tensors)}")
    parameters = [*weights, *(bias for bias in biases if bias is not None)]
    if features is not None:
        parameters.append(features)
    biased = tuple([bias is not None for bias in biases])
    indexed = direction_index is not None and q > 0
    program, names = _named_program(op, layers.text, p, q, biased, indexed)
    return Network(program, parameters, names=names), inputs


@constant_result  # not on the cached function, which torch.compile would trace
def _named_program(op: str, text: str, *form: Any) -> tuple[Program, Names]:
    return _named_program_once(op, text, *form)


@functools.lru_cache(maxsize=256)
def _named_program_once(
    op: str, text: str, p: int, q: int, biased: tuple[bool, ...], indexed: bool
) -> tuple[Program, Names]:
    """Returns the program of a layer table, and the names of its tensors."""
    parameters = [f"weights[{i}]" for i in range(len(biased))]
    parameters += [f"biases[{i}]" for i, has in enumerate(biased) if has]
    names = Names(op, (POSITIONS, DIRECTIONS), (*parameters, "features"), "direction_index")
    return MLP.parse(text).program(p, q, None, biased, indexed), names


def _check_widths(op: str, layers: MLP, p: int, q: int) -> None:
    """Checks the number of features of positions and directions; q is 0 if no layer reads directions."""
    if layers.integrated and p != 6:
        raise ValueError(f"{op}: positions must have 6 features, mean and variance, where they are integrated, got {p}")
    if q and layers.direction_degree is not None and q != 3:
        raise ValueError(f"{op}: directions must have 3 features where they are spherical, got {q}")
    if layers.grid is not None and p != 3:
        raise ValueError(f"{op}: positions must have 3 features where they are hashed, got {p}")
    for source, width in ((POSITIONS, p), (DIRECTIONS, q)):
        if width < 1 and any(source in layer.inputs for layer in layers.layers):
            raise ValueError(f"{op}: {source} must have at least one feature where a layer reads them, got {width}")
        name, size = layers.encoding(source) or ("frequency", 0)
        if width and not ENCODINGS[name].fits(width, size):
            raise ValueError(f"{op}: {source} must fit the {name} encoding of size {size}, got {width} features")
