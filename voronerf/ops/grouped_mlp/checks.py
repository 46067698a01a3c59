"""Checks that the operations on whole networks share. n samples, r rays, k cells, m centres of all diagrams together, g
diagrams, p and q features of a position and a direction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.checks import (
    FLOATING,
    INDEX,
    Others,
    Row,
    check_integer,
    check_rows,
    check_shape,
    check_tensor,
    of_one_dtype,
)
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS

PLACES: dict[str, Any] = {
    **dict.fromkeys(("centres", "child_offsets", "child", "cells", "coords", "rows", "frozen")),
    "depth": 1,
}
"""Of the arguments that tell the cells of samples, and which of them count."""
_DEFAULTS = {**PLACES, **dict.fromkeys(("layers", "directions", "direction_index", "features"))}
"""Of the arguments of `routed_mlp` that are given by name."""
_OF_PLACES = {
    "cells": Row("cells", INDEX, ("n",)),
    "centres": Row("centres", FLOATING, ("k", 3)),
    "child_offsets": Row("child_offsets", INDEX, ("g+1",)),
    "child": Row("child", INDEX, ("m",)),
    "frozen": Row("frozen", (torch.bool,), ("k",)),
    "rows": Row("rows", INDEX, (1,)),
    "coords": Row("coords", FLOATING, ("n", 3)),
}
_OF_A_TREE = {**_OF_PLACES, "centres": Row("centres", FLOATING, ("m", 3))}


NETWORK = ("positions", "weights", "biases", "layers", "directions", "direction_index", "features")
"""Names of the arguments that `check_network` takes."""


def check_network(
    op: str, network: Mapping[str, Any], behind: Others = ((), ()), last: Others = ((), ())
) -> dict[str, int]:
    """Checks a layer table and its tensors, and gives what the letters of their shapes stand for.

    Args:
        op: operation named in errors.
        network: the arguments of `NETWORK`, as in `grouped_mlp`; the layers tell how many tensors there are.
        behind: rows of others that are checked behind the positions, and these.
        last: of others that are checked last.
    """
    positions, weights, biases, layers, directions, direction_index, features = [network[name] for name in NETWORK]
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
    known = layers, p, q, form, biased, weights[0].dtype, tuple(behind[0]), tuple(last[0])
    sizes = check_rows(op, _rows, tensors, *known)
    if direction_index is not None and not sizes["r"] and sizes["n"]:
        assert directions is not None
        raise ValueError(f"{op}: directions must hold a row for the direction_index, got {list(directions.shape)}")
    return sizes


def _check_widths(op: str, layers: MLP, p: int, q: int, directed: bool) -> None:
    """Checks how many features positions and directions have."""
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
    behind: Sequence[Row],
    last: Sequence[Row],
) -> list[Row]:
    """The rules for the tensors of a network: positions, what they are read with, and parameters, between others.

    ``form``: whether directions have an index, the dimensions of the features or 0, and whether there are directions.
    """
    indexed, dimensions, directed = form
    rows = [Row("positions", FLOATING, ("n", "p")), *behind]
    if directed:
        rows.append(Row("directions", FLOATING, ("r" if indexed else "n", "q")))
    if indexed:
        rows.append(Row("direction_index", INDEX, ("n",)))
    if dimensions:
        assert layers.grid is not None
        shape = layers.grid.table_shape
        rows.append(Row("features", FLOATING, ("k", *shape) if dimensions == 3 else shape))
    for i, shape in enumerate(layers.weight_shapes(p, q)):
        empty = "" if i else "must hold at least one cell"
        rows.append(Row(f"weights[{i}]", (dtype,) if i else FLOATING, ("k", *shape), empty=empty))
    for i, layer in enumerate(layers.layers):
        if biased[i]:
            rows.append(Row(f"biases[{i}]", (dtype,), ("k", layer.width), like="weights[0]"))
    return [*rows, *last]


def check_routed(
    op: str, /, positions: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor | None], **given: Any
) -> dict[str, Any]:
    """All arguments of `routed_mlp` but for the backend, checked; what is compared has one dtype."""
    network = {**_DEFAULTS, **given}
    if network.keys() != _DEFAULTS.keys():
        raise TypeError(f"{op}: unknown arguments {', '.join(network.keys() - _DEFAULTS.keys())}")
    known = {"positions": positions, "weights": weights, "biases": biases, **network}
    sizes = check_network(op, known, last=rows_of_places(op, network))
    check_places(op, network, sizes, positions.shape[1])
    return {"positions": positions, "weights": weights, "biases": biases, **with_coords(positions, network)}


def with_coords(positions: Tensor, network: dict[str, Any]) -> dict[str, Any]:
    """The same with the locations of the samples, if centres tell their cells."""
    coords, centres = network["coords"], network["centres"]
    if centres is not None:
        points = positions[:, :3] if coords is None else coords
        network["coords"], network["centres"] = of_one_dtype(points, centres)
    return network


def rows_of_places(op: str, network: dict[str, Any]) -> Others:
    """The rows of the tensors that tell the cells, and these, once it is clear that they may come together."""
    centres, child_offsets, child, depth = (network[name] for name in ("centres", "child_offsets", "child", "depth"))
    if centres is None:
        for name in ("child_offsets", "child"):
            if network[name] is not None:
                raise ValueError(f"{op}: {name} must come with centres, got no centres")
        if network["coords"] is not None:
            raise ValueError(f"{op}: coords must come with centres, got none to compare them with")
    else:
        if network["cells"] is not None:
            raise ValueError(f"{op}: centres must be None where cells are given, got both")
        if (child_offsets is None) != (child is None):
            missing = "child_offsets" if child_offsets is None else "child"
            raise ValueError(f"{op}: child_offsets and child must come together, got no {missing}")
        check_integer(op, "depth", depth, 1)
        if child is None and depth != 1:
            raise ValueError(f"{op}: depth must be 1 for a flat diagram, got {depth}")
    rows = _OF_PLACES if child is None else _OF_A_TREE
    there = [name for name in rows if network[name] is not None]
    return [rows[name] for name in there], [network[name] for name in there]


def check_places(op: str, network: dict[str, Any], sizes: dict[str, int], p: int) -> None:
    """Checks the numbers of cells and centres that the tensors have; ``p``: features of the positions."""
    if network["centres"] is None:
        if network["cells"] is None and sizes["k"] != 1:
            raise ValueError(f"{op}: centres or cells must be given for {sizes['k']} cells, got neither")
        return
    if network["child"] is not None and (sizes["m"] < 1 or sizes["g"] < 1):
        count = f"{sizes['m']} centres in {sizes['g']} diagrams"
        raise ValueError(f"{op}: centres must hold at least one centre of one diagram, got {count}")
    if network["coords"] is None and p < 3:
        raise ValueError(f"{op}: coords must be given for positions of less than 3 features, got {p}")
