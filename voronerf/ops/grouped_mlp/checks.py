"""Checks that the operations on whole networks share. n samples, r rays, k cells, p and q features of a position and a
direction."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf.ops._core.checks import FLOATING, INDEX, check_dtype, check_same_dtype, check_shape, check_tensor
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS


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
