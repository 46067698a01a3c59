"""Checks that the operations on whole networks share. n samples, r rays, k cells, m centres of all diagrams together, g
diagrams, p and q features of a position and a direction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.checks import (
    FLOATING,
    INDEX,
    check_count,
    check_dtype,
    check_integer,
    check_no_inference,
    check_same_device,
    check_same_dtype,
    check_shape,
    check_tensor,
    of_one_dtype,
)
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS

PLACES: dict[str, Any] = {
    **dict.fromkeys(("centres", "child_offsets", "child", "cells", "coords", "rows", "frozen")),
    "depth": 1,
}
"""Of the arguments that tell the cells of samples, and which of them count."""
_DEFAULTS = {**PLACES, **dict.fromkeys(("layers", "directions", "direction_index", "features"))}
"""Of the arguments of `routed_mlp` that are given by name."""


def check_network(
    op: str,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    layers: MLP,
    directions: Tensor | None,
    direction_index: Tensor | None,
    features: Tensor | None,
    sizes: dict[str, int],
) -> None:
    """Checks parameters and directions against a layer table; ``sizes`` holds n and p, and k where it is known."""
    if not isinstance(layers, MLP):
        raise TypeError(f"{op}: layers must be an MLP, got {type(layers).__name__}")
    _check_directions(op, directions, direction_index, layers, sizes)
    if layers.integrated and sizes["p"] != 6:
        p = sizes["p"]
        raise ValueError(f"{op}: positions must have 6 features, mean and variance, where they are integrated, got {p}")
    if directions is not None and layers.direction_degree is not None and sizes["q"] != 3:
        raise ValueError(f"{op}: directions must have 3 features where they are spherical, got {sizes['q']}")
    _check_features(op, features, layers, sizes)
    count = len(layers.layers)
    for name, parameters in (("weights", weights), ("biases", biases)):
        if not isinstance(parameters, Sequence):
            raise TypeError(f"{op}: {name} must be a list, got {type(parameters).__name__}")
        if len(parameters) != count:
            raise ValueError(f"{op}: {name} must have one entry for each of {count} layers, got {len(parameters)}")
    for source, width in ((POSITIONS, sizes["p"]), (DIRECTIONS, sizes["q"])):
        if width < 1 and any(source in layer.inputs for layer in layers.layers):
            raise ValueError(f"{op}: {source} must have at least one feature where a layer reads them, got {width}")
    for index, (o, i) in enumerate(layers.weight_shapes(sizes["p"], sizes["q"])):
        weight, bias = weights[index], biases[index]
        if index == 0 or not _fits(weight, (sizes["k"], o, i), weights[0].dtype):
            check_shape(op, f"weights[{index}]", weight, ("k", o, i), sizes)
            check_dtype(op, f"weights[{index}]", weight, FLOATING if index == 0 else (weights[0].dtype,))
        if bias is not None and not _fits(bias, (sizes["k"], o), weights[0].dtype):
            check_shape(op, f"biases[{index}]", bias, ("k", o), sizes)
            check_same_dtype(op, **{"weights[0]": weights[0], f"biases[{index}]": bias})
    if sizes["k"] < 1:
        raise ValueError(f"{op}: weights[0] must hold at least one cell, got {list(weights[0].shape)}")


def check_together(
    op: str, weights: Sequence[Tensor], biases: Sequence[Tensor | None], tensors: dict[str, Tensor | None]
) -> None:
    """Checks that all are on one device, and that autograd can keep them where it has to."""
    every = (*tensors.values(), *weights, *biases)
    device = next(t.device for t in every if t is not None)
    if torch.compiler.is_compiling() or any(t is not None and (t.device != device or t.is_inference()) for t in every):
        for name, parameters in (("weights", weights), ("biases", biases)):  # named for an error alone
            tensors |= {f"{name}[{index}]": parameter for index, parameter in enumerate(parameters)}
        check_same_device(op, **tensors)
        check_no_inference(op, **tensors)


def _fits(tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> bool:
    """Whether a parameter keeps all rules; its name for a message is not made."""
    if not isinstance(tensor, Tensor) or tensor.layout is not torch.strided or tensor.is_nested:
        return False
    return tensor.dtype == dtype and tensor.shape == shape


def _check_directions(
    op: str, directions: Tensor | None, direction_index: Tensor | None, layers: MLP, sizes: dict[str, int]
) -> None:
    if directions is None:
        if layers.uses_directions:
            raise ValueError(f"{op}: directions must be given for layers that read them, got None")
        if direction_index is not None:
            raise ValueError(f"{op}: direction_index must come with directions, got no directions")
        sizes["q"] = 0
        return
    check_shape(op, "directions", directions, ("n", "q") if direction_index is None else ("r", "q"), sizes)
    check_dtype(op, "directions", directions)
    if direction_index is not None:
        check_shape(op, "direction_index", direction_index, ("n",), sizes)
        if not sizes["r"] and sizes["n"]:
            raise ValueError(f"{op}: directions must hold a row for the direction_index, got {list(directions.shape)}")
        check_dtype(op, "direction_index", direction_index, INDEX)


def _check_features(op: str, features: Tensor | None, layers: MLP, sizes: dict[str, int]) -> None:
    if layers.grid is None:
        if features is not None:
            check_tensor(op, "features", features)
            raise ValueError(f"{op}: features must be None for layers without a hash grid, got {list(features.shape)}")
        return
    if features is None:
        raise ValueError(f"{op}: features must be given for layers with a hash grid, got None")
    if sizes["p"] != 3:
        raise ValueError(f"{op}: positions must have 3 features where they are hashed, got {sizes['p']}")
    shape = layers.grid.table_shape
    check_tensor(op, "features", features)
    check_shape(op, "features", features, ("k", *shape) if features.dim() == 3 else shape, sizes)
    check_dtype(op, "features", features)


def check_routed(
    op: str, /, positions: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor | None], **given: Any
) -> dict[str, Any]:
    """All arguments of `routed_mlp` but for the backend, checked; what is compared has one dtype."""
    network = {**_DEFAULTS, **given}
    if network.keys() != _DEFAULTS.keys():
        raise TypeError(f"{op}: unknown arguments {', '.join(network.keys() - _DEFAULTS.keys())}")
    _check_routed(op, positions, weights, biases, network)
    return {"positions": positions, "weights": weights, "biases": biases, **with_coords(positions, network)}


def with_coords(positions: Tensor, network: dict[str, Any]) -> dict[str, Any]:
    """The same with the locations of the samples, if centres tell their cells."""
    coords, centres = network["coords"], network["centres"]
    if centres is not None:
        points = positions[:, :3] if coords is None else coords
        network["coords"], network["centres"] = of_one_dtype(points, centres)
    return network


def _check_routed(
    op: str, positions: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor | None], network: dict[str, Any]
) -> None:
    read = {name: network[name] for name in ("directions", "direction_index", "features")}
    sizes: dict[str, int] = {}
    check_shape(op, "positions", positions, ("n", "p"), sizes)
    check_dtype(op, "positions", positions)
    check_count(op, "positions", sizes["n"])
    check_network(op, weights, biases, network["layers"], **read, sizes=sizes)
    check_places(op, network, {"positions": positions, **read}, sizes, weights, biases)


def check_places(
    op: str,
    network: dict[str, Any],
    tensors: dict[str, Tensor | None],
    sizes: dict[str, int],
    weights: Sequence[Tensor] = (),
    biases: Sequence[Tensor | None] = (),
) -> None:
    """Checks what tells the cells, and that it is where the other tensors are; ``sizes`` holds n, p and k."""
    tables = {name: network[name] for name in ("centres", "child_offsets", "child", "cells")}
    frozen, coords, centres = network["frozen"], network["coords"], network["centres"]
    _check_tables(op, **tables, depth=network["depth"], sizes=sizes)
    if frozen is not None:
        check_shape(op, "frozen", frozen, ("k",), sizes)
        check_dtype(op, "frozen", frozen, (torch.bool,))
    rows = network["rows"]
    if rows is not None:
        check_shape(op, "rows", rows, (1,))
        check_dtype(op, "rows", rows, INDEX)
    if coords is not None:
        if centres is None:
            raise ValueError(f"{op}: coords must come with centres, got none to compare them with")
        check_shape(op, "coords", coords, ("n", 3), sizes)
        check_dtype(op, "coords", coords)
    elif centres is not None and sizes["p"] < 3:
        raise ValueError(f"{op}: coords must be given for positions of less than 3 features, got {sizes['p']}")
    check_together(op, weights, biases, {**tensors, "coords": coords, "frozen": frozen, **tables, "rows": rows})


def _check_tables(
    op: str,
    centres: Tensor | None,
    child_offsets: Tensor | None,
    child: Tensor | None,
    depth: int,
    cells: Tensor | None,
    sizes: dict[str, int],
) -> None:
    if cells is not None:
        if centres is not None:
            raise ValueError(f"{op}: centres must be None where cells are given, got both")
        check_shape(op, "cells", cells, ("n",), sizes)
        check_dtype(op, "cells", cells, INDEX)
    if centres is None:
        for name, value in (("child_offsets", child_offsets), ("child", child)):
            if value is not None:
                raise ValueError(f"{op}: {name} must come with centres, got no centres")
        if cells is None and sizes["k"] != 1:
            raise ValueError(f"{op}: centres or cells must be given for {sizes['k']} cells, got neither")
        return
    if (child_offsets is None) != (child is None):
        missing = "child_offsets" if child_offsets is None else "child"
        raise ValueError(f"{op}: child_offsets and child must come together, got no {missing}")
    check_shape(op, "centres", centres, ("k" if child is None else "m", 3), sizes)
    check_dtype(op, "centres", centres)
    check_integer(op, "depth", depth, 1)
    if child_offsets is None or child is None:
        if depth != 1:
            raise ValueError(f"{op}: depth must be 1 for a flat diagram, got {depth}")
        return
    check_shape(op, "child_offsets", child_offsets, ("g+1",), sizes)
    check_dtype(op, "child_offsets", child_offsets, INDEX)
    check_shape(op, "child", child, ("m",), sizes)
    check_dtype(op, "child", child, INDEX)
    if sizes["m"] < 1 or sizes["g"] < 1:
        count = f"{sizes['m']} centres in {sizes['g']} diagrams"
        raise ValueError(f"{op}: centres must hold at least one centre of one diagram, got {count}")
