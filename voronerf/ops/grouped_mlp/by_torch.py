"""bfloat16 networks on the CPU by torch's products, a cell and layer at a time, where they are the fastest way.

Processors with AMX multiply bfloat16 several times as fast as the kernels here, which have no code for it. torch has,
by oneDNN, but sends every layer through memory. So both are timed, once for each table and number of rows of a cell.
On a Xeon with AMX torch is 0.25 x as fast as the kernels with four layers of 64, and 1.3 x with four of 256. Where
there is no AMX, nothing is timed and the kernels are taken.

n samples, k cells, i inputs and o outputs of a layer, p and q features of a raw position and direction.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import linear

from voronerf.ops._core import native
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops.frequency_encode.native import frequency_encode
from voronerf.ops.grouped_linear.activation import activate
from voronerf.ops.grouped_mlp.layer_table import Given, encoded_already, storage
from voronerf.ops.grouped_mlp.reference import check_direction_index, encode_directions, encode_positions
from voronerf.ops.grouped_mlp.reference import grouped_mlp as compose

Run = Callable[[Given, Tensor], Tensor]
"""A network by its arguments and offsets."""
_CELLS, _MOST_ROWS = 8, 4096


@functools.cache
def available() -> bool:
    """Whether torch may multiply by AMX, and nobody asks for an instruction set (VORONERF_ISA)."""
    supported = getattr(torch.cpu, "_is_amx_tile_supported", None)
    return supported is not None and bool(supported()) and not os.environ.get("VORONERF_ISA")


def is_faster(given: Given, kernel: Run) -> bool:
    """Whether torch is to multiply instead of the kernel."""
    positions, weights, _, layers, directions, *_ = given
    if torch.compiler.is_compiling() or not available() or positions.device.type != "cpu" or native.on_cuda(positions):
        return False
    if storage(positions, weights) != torch.bfloat16 or layers.grid is not None or positions.shape[0] == 0:
        return False
    rows = min(_MOST_ROWS, 1 << (positions.shape[0] // weights[0].shape[0]).bit_length())
    q = 0 if directions is None else directions.shape[1]
    return gain(kernel, layers, positions.shape[1], q, rows) >= native.LEAST_GAIN


@functools.lru_cache(maxsize=256)
def gain(kernel: Run, layers: MLP, p: int, q: int, rows: int) -> float:
    """How many times as fast as the kernel torch is, forward, with so many rows a cell: the best of five of each."""
    draws = torch.Generator().manual_seed(0)
    n = _CELLS * rows
    weights = [torch.rand(_CELLS, *shape, generator=draws).sub_(0.5).bfloat16() for shape in layers.weight_shapes(p, q)]
    directions = torch.rand(n, q, generator=draws) if q else None
    given = Given(torch.rand(n, p, generator=draws), weights, [None] * len(weights), layers, directions)
    offsets = torch.arange(_CELLS + 1, dtype=torch.int32) * rows
    best = []
    with torch.no_grad(), torch.autocast("cpu", enabled=False):
        for way in (kernel, run):
            times = []
            for _ in range(5):
                begin = time.perf_counter()
                way(given, offsets)
                times.append(time.perf_counter() - begin)
            best.append(min(times))
    return best[0] / best[1]


def describe(kernel: Run) -> str:
    """What ``voronerf info`` says of it."""
    if not available():
        return "not used: no AMX, or VORONERF_ISA asks for an instruction set"
    said = []
    for width in (64, 256):
        hidden = MLP(tuple(Layer((index - 1,) if index else (POSITIONS,), width, "relu") for index in range(4)), (3,))
        said.append(f"4 layers of {width} {gain(kernel, hidden, width, 0, _MOST_ROWS):.2g} x as fast as the kernels")
    return f"{', '.join(said)}; used from {native.LEAST_GAIN} on"


def run(given: Given, offsets: Tensor) -> Tensor:
    """Every sample through the network of its cell, in bfloat16."""
    positions, weights, biases, layers, directions, direction_index, _ = given
    check_direction_index("grouped_mlp", directions, direction_index)
    if layers.position_octaves is not None and not layers.integrated:
        positions = frequency_encode(positions.float(), layers.position_octaves)
    else:
        positions = encode_positions(positions, layers)
    rest = {"directions": None if directions is None else encode_directions(directions, layers)}
    with torch.autocast("cpu", enabled=False):
        return compose(
            positions,
            offsets,
            [weight.bfloat16() for weight in weights],
            [None if bias is None else bias.bfloat16() for bias in biases],
            layers=encoded_already(layers, POSITIONS + DIRECTIONS),
            direction_index=direction_index,
            linear=_linear,
            **rest,
        )


def _linear(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, *, activation: str) -> Tensor:
    """[n, o] of [n, i], a product a cell; rows of no cell are 0."""
    before, *parts, behind = x.tensor_split(offsets.tolist())
    biases = [None] * len(parts) if bias is None else bias.unbind()
    found = [activate(activation, linear(*each)) for each in zip(parts, weight.unbind(), biases, strict=True)]
    outside = [x.new_zeros(end.shape[0], weight.shape[1]) for end in (before, behind)]
    return torch.cat([outside[0], *found, outside[1]])
