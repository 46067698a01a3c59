"""Checks of layer tables and their tensors. n samples, r rays, k cells, p and q features of a position and a
direction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.checks import (
    FLOATING,
    INDEX,
    Others,
    TensorRule,
    check_rules,
    check_shape,
    check_tensor,
)
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, program_text
from voronerf.ops.grouped_program.arguments import ProgramArguments


class Layered(NamedTuple):
    """The network and the samples of `grouped_mlp` and `routed_mlp`."""

    positions: Tensor
    weights: Sequence[Tensor]
    biases: Sequence[Tensor | None]
    layers: MLP
    directions: Tensor | None
    direction_index: Tensor | None
    features: Tensor | None

    def check(self, op: str, behind: Others = ((), ()), last: Others = ((), ())) -> dict[str, int]:
        """Checks the layer table and its tensors, and returns the size of each letter in their shapes.

        Args:
            op: the name of the operation for error messages.
            behind: additional rules and their tensors, checked after the positions.
            last: additional rules and their tensors, checked last.
        """
        positions, weights, biases, layers, directions, direction_index, features = self
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
        p, q = positions.shape[1], 0 if directions is None else directions.shape[1]
        _check_widths(op, layers, p, q, directions is not None)
        count = len(layers.layers)
        for name, parameters in (("weights", weights), ("biases", biases)):
            if not isinstance(parameters, Sequence):
                raise TypeError(f"{op}: {name} must be a list, got {type(parameters).__name__}")
            if len(parameters) != count:
                raise ValueError(f"{op}: {name} must have one entry for each of {count} layers, got {len(parameters)}")
        check_tensor(op, "weights[0]", weights[0])
        form = direction_index is not None, 0 if features is None else features.dim(), directions is not None
        biased = tuple([bias is not None for bias in biases])
        read = [tensor for tensor in (directions, direction_index, features) if tensor is not None]
        parameters = [*weights, *[bias for bias in biases if bias is not None]]
        tensors = [positions, *behind[1], *read, *parameters, *last[1]]
        settings = layers, p, q, form, biased, weights[0].dtype, tuple(behind[0]), tuple(last[0])
        sizes = check_rules(op, _rows, tensors, *settings)
        if direction_index is not None and not sizes["r"] and sizes["n"]:
            assert directions is not None
            raise ValueError(f"{op}: directions must hold a row for the direction_index, got {list(directions.shape)}")
        return sizes

    def arguments(self, caller: str) -> ProgramArguments:
        """Returns the program of the table and its checked tensors, in the order of :meth:`MLP.program`."""
        inputs, parameters = [self.positions], [*self.weights, *(bias for bias in self.biases if bias is not None)]
        index = None
        if self.directions is not None and self.layers.uses_directions:
            inputs.append(self.directions)
            index = self.direction_index
        if self.features is not None:
            parameters.append(self.features if self.features.dim() == 3 else self.features[None])
        p, q = (len(range(x.shape[1])) for x in (self.positions, inputs[-1]))  # plain ints, not symbolic ones
        biased = tuple([bias is not None for bias in self.biases])
        text = program_text(self.layers.text, p, q if len(inputs) > 1 else 0, None, biased, index is not None)
        return ProgramArguments.of(caller, text, inputs, parameters, index)


def _check_widths(op: str, layers: MLP, p: int, q: int, directed: bool) -> None:
    """Checks the number of features of positions and directions."""
    if layers.integrated and p != 6:
        raise ValueError(f"{op}: positions must have 6 features, mean and variance, where they are integrated, got {p}")
    if directed and layers.direction_degree is not None and q != 3:
        raise ValueError(f"{op}: directions must have 3 features where they are spherical, got {q}")
    if layers.grid is not None and p != 3:
        raise ValueError(f"{op}: positions must have 3 features where they are hashed, got {p}")
    for source, width in ((POSITIONS, p), (DIRECTIONS, q)):
        if width < 1 and any(source in layer.inputs for layer in layers.layers):
            raise ValueError(f"{op}: {source} must have at least one feature where a layer reads them, got {width}")
        name, size = layers.encoding(source) or ("frequency", 0)
        if width and not ENCODINGS[name].fits(width, size):
            raise ValueError(f"{op}: {source} must fit the {name} encoding of size {size}, got {width} features")


def _rows(
    layers: MLP,
    p: int,
    q: int,
    form: tuple[bool, int, bool],
    biased: tuple[bool, ...],
    dtype: torch.dtype,
    behind: Sequence[TensorRule],
    last: Sequence[TensorRule],
) -> list[TensorRule]:
    """Returns the rules for the tensors of a network: positions, ``behind``, further inputs, parameters and ``last``.

    ``form`` is (whether directions have an index, the number of dimensions of the features or 0, whether there are
    directions).
    """
    indexed, dimensions, directed = form
    rows = [TensorRule("positions", FLOATING, ("n", "p")), *behind]
    if directed:
        rows.append(TensorRule("directions", FLOATING, ("r" if indexed else "n", "q")))
    if indexed:
        rows.append(TensorRule("direction_index", INDEX, ("n",)))
    if dimensions:
        assert layers.grid is not None
        shape = layers.grid.table_shape
        rows.append(TensorRule("features", FLOATING, ("k", *shape) if dimensions == 3 else shape))
    for i, shape in enumerate(layers.weight_shapes(p, q)):
        empty = "" if i else "must hold at least one cell"
        rows.append(TensorRule(f"weights[{i}]", (dtype,) if i else FLOATING, ("k", *shape), empty=empty))
    for i, layer in enumerate(layers.layers):
        if biased[i]:
            rows.append(TensorRule(f"biases[{i}]", (dtype,), ("k", layer.width), like="weights[0]"))
    return [*rows, *last]
