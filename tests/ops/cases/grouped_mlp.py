"""Draws valid arguments of ``grouped_mlp`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import ACTIVATIONS, DIRECTIONS, MLP, POSITIONS, Layer

_PLAIN = MLP((Layer((POSITIONS,), 6, "sine"), Layer((0, DIRECTIONS), 4, "sigmoid")), (1, 0), 2, 1)
# 16 features fill whole vectors, so the encodings that a forward pass keeps have no (uninitialised) padding lanes.
_GRID = HashGrid(levels=8, features=2, log2_entries=10, base=3, finest=40)
GAUSSIANS = {"layers": MLP(_PLAIN.layers, _PLAIN.outputs, 2, 1, "integrated")}
HASHED = {"layers": MLP(_PLAIN.layers, _PLAIN.outputs, None, 1, "hash", _GRID)}


def layer_table(draw: Draw) -> MLP:
    """Draws a table of layers, each of which reads earlier layers, positions or directions."""
    if not draw.free:
        return _PLAIN
    layers: list[Layer] = []
    for number in range(draw.number("layers of it", 2, 1, 4)):
        first = number - 1 if number else POSITIONS
        second = draw.among("second", *(s for s in (None, None, POSITIONS, DIRECTIONS, *range(number)) if s != first))
        inputs = (first,) if second is None else (first, second)
        layers.append(Layer(inputs, draw.among("width", 6, 1, 3, 8, 17), draw.among("activation", *ACTIVATIONS)))
    last = len(layers) - 1
    outputs = (
        (last,) if last == 0 or draw.among("outputs", True, False) else (draw.number("output", 0, 0, last - 1), last)
    )
    return MLP(tuple(layers), outputs, draw.among("octaves", 2, 0, 4), draw.among("direction octaves", 1, 0, 2))


def network(draw: Draw, n: int, k: int) -> Arguments:
    """Draws n samples, and the parameters of k cells."""
    layers, dtype = draw.among("layers", layer_table(draw)), draw.dtype()
    p = 6 if layers.integrated else 3
    shapes = layers.weight_shapes(p, 3)
    call: Arguments = {"positions": draw.uniform(n, p, dtype=dtype), "layers": layers}
    call["weights"] = [(draw.normal(k, o, i) / max(i, 1) ** 0.5).to(dtype) for o, i in shapes]
    biased = [draw.among("biased", number == 0, True, False) for number in range(len(shapes))]
    call["biases"] = [draw.normal(k, o, dtype=dtype) if bias else None for (o, _), bias in zip(shapes, biased)]
    if layers.grid is not None:
        call["features"] = draw.normal(*layers.grid.table_shape)
    if layers.uses_directions:
        rays = draw.among("rays", 4, None, 1, 5)
        call["directions"] = draw.unit(n if rays is None else rays, dtype)
        call["direction_index"] = None if rays is None else draw.integers(0, rays, n)
    return call


def _make(draw: Draw, n: int) -> Arguments:
    k = draw.among("k", 2, 1, 9)
    return {**network(draw, n, k), "offsets": draw.offsets(n, k)}


CASE = Case(
    _make,
    {"": {}, "integrated": GAUSSIANS, "hashed": HASHED},
    refused={
        "layers must be an MLP, got NoneType": {"layers": None},
        "weights must be a list, got NoneType": {"weights": None},
        "biases must have one entry for each of 2 layers, got 0": {"biases": []},
        "features must be None for layers without a hash grid, got [1]": {"features": torch.zeros(1)},
    },
    differentiable=True,
    hostile="indices",
)
