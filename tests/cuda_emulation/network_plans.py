"""What the launches of a network would be on a CUDA device: the emulated module's plans of layer tables."""

import torch
from emulated import module
from emulated_networks import KIB

from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops._core.native import compiled
from voronerf.ops.grouped_mlp import network as grouped_mlp

PRECISIONS = compiled.MlpPrecision
WAYS = grouped_mlp.WAYS
MANY = 1 << 22


def nerf(width, depth):
    """The architecture of the original, in any size."""
    trunk = tuple(Layer((index - 1,) if index else (POSITIONS,), width, "relu") for index in range(depth))
    heads = (Layer((depth - 1,), 1), Layer((depth - 1,), width), Layer((depth + 1, DIRECTIONS), width // 2, "relu"))
    return MLP((*trunk, *heads, Layer((depth + 2,), 3)), (depth + 3, depth), 10, 4)


def plain(width, depth):
    """ReLU layers and a head of four outputs."""
    hidden = [Layer((index - 1,) if index else (POSITIONS,), width, "relu") for index in range(depth)]
    return MLP((*hidden, Layer((depth - 1,), 4)), (depth,), position_octaves=10)


def table(layers, d=None):
    """A table as the compiled module takes it."""
    d = d or (6 if layers.integrated else 3)
    seen = torch.zeros(1, 3) if layers.uses_directions else None
    weights = [torch.zeros(1, o, i) for o, i in layers.weight_shapes(d, 3 if layers.uses_directions else 0)]
    call = grouped_mlp.Given(torch.zeros(1, d), weights, [None] * len(weights), layers, seen)
    given, _ = grouped_mlp.as_network(call, None, hashed_before=False)
    key = grouped_mlp.table_key(given.table, given.positions, given.weights, given.directions)
    return grouped_mlp.table_of(*key)


def plan(layers, n=MANY, k=16, *, precision="bfloat16", backward=True, d=None, asked="auto"):
    """What the launches would be on the emulated device."""
    operands = PRECISIONS.index(precision)
    return module().grouped_mlp_plan(table(layers, d), operands, n, k, backward, WAYS.index(asked))


def way(layers, precision, *, backward=False, **options):
    """The way through the network on the emulated device."""
    return WAYS[plan(layers, precision=precision, backward=backward, **options)["way"]]


def chain(layers, *, d=None, precision="bfloat16", n=MANY, k=16, **device):
    """The chained plan, or the rule that the table breaks, on an H200 unless another device is given."""
    known = {"capability": 90, "shared_bytes": 227 * KIB, "multiprocessors": 132} | device
    operands = PRECISIONS.index(precision)
    return module().chain_plan(table(layers, d), operands, n, k, *known.values())
