"""Random valid calls of every op: sizes about those of tiles and blocks, dtypes, strides, empty and unequal cells."""

from __future__ import annotations

import random
from typing import Any

import torch
from torch import Tensor

from voronerf import HashGrid, backends, ops
from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer

FLOATS = (torch.float32, torch.float32, torch.float64, torch.float16, torch.bfloat16)
SIZES = (0, 1, 2, 3, 7, 8, 9, 15, 16, 17, 31, 33, 64, 100)
ACTIVATIONS = ("none", "relu", "softplus", "sigmoid", "sine")
Call = dict[str, Any]


def spread(rng: random.Random, tensor: Tensor) -> Tensor:
    """The same values in another place of memory, with other strides."""
    kind = rng.randrange(6)
    if kind == 0 and tensor.dim():
        wide = tensor.new_empty(*tensor.shape[:-1], 2 * tensor.shape[-1])
        wide[..., ::2] = tensor
        return wide[..., ::2]
    if kind == 1 and tensor.dim() > 1:
        return tensor.transpose(0, -1).contiguous().transpose(0, -1)
    if kind == 2 and tensor.dim():  # not where vectors are aligned
        shifted = tensor.new_empty(tensor.numel() + 1)
        shifted[1:] = tensor.reshape(-1)
        return shifted[1:].view(tensor.shape)
    return tensor


def offsets(rng: random.Random, n: int, k: int, *, all_rows: bool = False) -> Tensor:
    """int32 [k + 1]: rising, empty cells among them; without ``all_rows`` some rows may belong to no cell."""
    cuts = sorted(rng.randint(0, n) for _ in range(k + 1))
    if all_rows or rng.random() < 0.7:
        cuts[0], cuts[-1] = 0, n
    return torch.tensor(cuts, dtype=torch.int32)


def index(n: int, below: int) -> Tensor:
    return torch.randint(max(below, 1), (n,), dtype=torch.int32)


def points(rng: random.Random, n: int, dtype: torch.dtype) -> Tensor:
    """On a lattice, where distances are equal, at random, or far away."""
    kind = rng.randrange(4)
    found = torch.randint(-2, 3, (n, 3)).double() if kind == 0 else torch.randn(n, 3, dtype=torch.float64)
    return spread(rng, (found * (1000.0 if kind == 1 else 1.0)).to(dtype))


def unit(n: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=1).to(dtype)


def tree(rng: random.Random) -> tuple[Call, int]:
    """Tables of a diagram of diagrams, and how many cells it has."""
    levels, counts, child = [1], [], []
    depth, diagrams, leaves = rng.randint(1, 3), 1, 0
    for level in range(depth):
        below = 0
        for _ in range(levels[level]):
            k = rng.randint(1, 9)
            counts.append(k)
            for centre in range(k):
                if level + 1 < depth and (rng.random() < 0.4 or (centre == 0 and below == 0)):
                    child.append(diagrams)
                    diagrams += 1
                    below += 1
                else:
                    leaves += 1
                    child.append(-leaves)
        levels.append(below)
    starts = torch.tensor([0, *counts]).cumsum(0).to(torch.int32)
    tables = {"centres": torch.randn(len(child), 3), "child_offsets": starts}
    return {**tables, "child": torch.tensor(child, dtype=torch.int32), "depth": depth}, leaves


def nearest_centre(rng: random.Random, n: int) -> Call:
    dtype, k = rng.choice(FLOATS), rng.choice((1, 2, 9, 33, 300))
    centres = points(rng, k, rng.choice(FLOATS))
    call: Call = {"points": points(rng, n, dtype), "centres": centres}
    if rng.random() < 0.4:
        call["weights"] = torch.rand(k).to(rng.choice(FLOATS))
    if rng.random() < 0.2:
        call["grid"] = ops.centre_grid(centres, weights=call.get("weights"))
    return call


def locate_cell(rng: random.Random, n: int) -> Call:
    tables, _ = tree(rng)
    weights = torch.rand(len(tables["child"])) if rng.random() < 0.3 else None
    return {"points": points(rng, n, rng.choice(FLOATS)), **tables, "weights": weights}


def draw_cell(rng: random.Random, n: int) -> Call:
    call = {**locate_cell(rng, n), "points": points(rng, n, rng.choice((torch.float32, torch.float16)))}
    return {**call, "uniforms": torch.rand(n, call["depth"]), "temperature": rng.choice((1e-3, 0.1, 1.0, 100.0))}


def cell_sort(rng: random.Random, n: int) -> Call:
    k = rng.choice((1, 2, 17, 300, 5000))
    return {"cells": spread(rng, index(n, k)), "k": k}


def select_heaviest(rng: random.Random, n: int) -> Call:
    return {"points": torch.rand(n, 3), "importance": torch.rand(n), "count": rng.randint(1, 50)}


def balance_centres(rng: random.Random, n: int) -> Call:
    call: Call = {"samples": torch.rand(n, 3), "masses": torch.rand(n).double()}
    call |= {"centres": torch.rand(rng.randint(1, 20), 3), "steps": rng.randint(0, 3)}
    return {**call, "neighbours": rng.randint(1, 9), "alpha": 0.05, "global_norm": rng.random() < 0.5}


def cameras(rng: random.Random, c: int) -> Call:
    intrinsics = torch.cat([30 + 10 * torch.rand(c, 2), 4 * torch.rand(c, 2)], dim=1)
    lens = {"distortion": 0.01 * torch.randn(c, 8), "models": rng.choice((None, index(c, 3)))}
    return {"poses": torch.eye(4).repeat(c, 1, 1), "intrinsics": intrinsics, **lens}


def camera_rays(rng: random.Random, n: int) -> Call:
    c = rng.randint(1, 4)
    return {**cameras(rng, c), "x": 8 * torch.rand(n), "y": 8 * torch.rand(n), "camera": index(n, c)}


def pixel_rays(rng: random.Random, n: int) -> Call:
    c, h, w, channels = rng.randint(1, 4), rng.randint(1, 9), rng.randint(1, 9), rng.choice((3, 4))
    call: Call = {**cameras(rng, c), "images": torch.randint(256, (c, h, w, channels), dtype=torch.uint8)}
    call |= {"index": torch.randint(c * h * w, (n,)), "near": 0.1, "far": 5.0, "background": torch.rand(n, 3)}
    return {**call, "box": rng.choice((None, torch.tensor([[-1.0] * 3, [1.0] * 3])))}


def cast_solids(rng: random.Random, n: int) -> Call:
    s = rng.randint(0, 9)
    frames = torch.cat([torch.eye(3).expand(s, 3, 3), torch.randn(s, 1, 3)], dim=1)
    call: Call = {"kinds": index(s, 4), "frames": frames, "sizes": 0.1 + torch.rand(s, 3)}
    return {**call, "origins": 3 * torch.randn(n, 3), "directions": unit(n)}


def march_rays(rng: random.Random, n: int) -> Call:
    dtype, samples = rng.choice(FLOATS[:3]), rng.choice((1, 7, 64, 130))
    sides = [rng.randint(1, 9) for _ in range(3)]
    call: Call = {"origins": 2 * torch.randn(n, 3, dtype=dtype), "directions": unit(n, dtype)}
    call |= {"near": torch.rand(n, dtype=dtype), "far": 4 * torch.rand(n, dtype=dtype), "samples": samples}
    call |= {"occupied": torch.rand(*sides) < rng.random(), "spacing": rng.choice(("linear", "disparity"))}
    call["box"] = torch.tensor([[-1.0] * 3, [1.0] * 3], dtype=dtype)
    call["near"] += 0.01
    if rng.random() < 0.5:
        call["uniforms"] = torch.rand(n, samples, dtype=dtype)
    elif rng.random() < 0.5:
        call["seed"] = torch.randint(-(2**31), 2**31, (1,), dtype=torch.int32)
    if rng.random() < 0.3:
        call |= {"start": index(n, samples), "most": rng.randint(1, 9), "capacity": rng.randint(1, 200)}
    call["contraction"] = rng.choice((None, torch.rand(4, dtype=dtype) + 0.1, torch.rand(5, 3, dtype=dtype) + 0.1))
    return call


def update_occupancy(rng: random.Random, n: int) -> Call:
    sides = [rng.randint(1, 9) for _ in range(3)]
    density = torch.rand(*sides)
    return {
        "density": density,
        "cells": index(n, density.numel()),
        "values": torch.rand(n),
        "decay": rng.random(),
        "threshold": rng.random(),
    }


def observe_occupancy(rng: random.Random, n: int) -> Call:
    density, threshold = torch.rand(*(rng.randint(1, 9) for _ in range(3))), rng.random()
    call: Call = {"density": density, "occupied": density >= threshold, "threshold": threshold}
    call["box"] = torch.tensor([[-1.0] * 3, [1.0] * 3])
    call |= {name: torch.rand(n) for name in ("sigma", "deltas", "weights")}
    return {**call, "positions": torch.randn(n, 3), "decay": rng.random(), "hidden": rng.random()}


def resample(rng: random.Random, n: int) -> Call:
    dtype, s, count = rng.choice(FLOATS[:3]), rng.choice((1, 7, 8, 33)), rng.choice((1, 5, 16, 33))
    edges = (torch.rand(n, s + 1, dtype=dtype) + 0.01).cumsum(1)
    call: Call = {"weights": spread(rng, torch.rand(n, s, dtype=dtype) + 0.01), "edges": edges, "count": count}
    return call if rng.random() < 0.5 else {**call, "uniforms": torch.rand(n, count, dtype=dtype)}


def composite(rng: random.Random, n: int) -> Call:
    dtype, s, c = rng.choice(FLOATS), rng.choice((0, 1, 7, 16, 33, 64)), rng.choice((1, 3, 3, 3, 5))
    packed = rng.random() < 0.5
    shape = (n * s,) if packed else (n, s)
    call: Call = {name: spread(rng, torch.rand(shape).to(dtype)) for name in ("sigma", "depths", "deltas")}
    call["rgb"] = spread(rng, torch.rand(*shape, c).to(dtype))
    if packed:
        call["ray_offsets"] = offsets(rng, n * s, n)
    if rng.random() < 0.5:
        call["background"] = torch.rand(*rng.choice(((c,), (n, c)))).to(dtype)
    return call


def render_loss(rng: random.Random, n: int) -> Call:
    r, dtype = rng.choice(SIZES), rng.choice(FLOATS)
    wide = torch.promote_types(dtype, torch.float32)
    call: Call = {"raw": spread(rng, torch.randn(n, 4).to(dtype)), "deltas": torch.rand(n, dtype=wide)}
    call |= {"ray_offsets": offsets(rng, n, r), "target": torch.rand(r, 3, dtype=wide), "density_scale": 3.0}
    call["hidden"] = rng.choice((0.0, 1e-3, 0.5))
    return {**call, "background": rng.choice((None, torch.rand(3, dtype=wide), torch.rand(r, 3, dtype=wide)))}


def frequency_encode(rng: random.Random, n: int) -> Call:
    x = spread(rng, torch.randn(n, rng.choice((1, 2, 3, 7))).to(rng.choice(FLOATS)))
    return {"x": x, "octaves": rng.choice((0, 1, 4, 10)), "include_input": rng.random() < 0.7}


def integrated_encode(rng: random.Random, n: int) -> Call:
    dtype = rng.choice(FLOATS)
    call: Call = {name: spread(rng, torch.rand(n, 3).to(dtype)) for name in ("means", "variances")}
    return {**call, "octaves": rng.choice((0, 1, 4, 10))}


def spherical_harmonics(rng: random.Random, n: int) -> Call:
    return {"directions": spread(rng, unit(n).to(rng.choice(FLOATS))), "degree": rng.randint(1, 4)}


def hash_grid(rng: random.Random) -> HashGrid:
    levels, features = rng.randint(1, 5), rng.choice((1, 2, 4))
    smooth = rng.choice(("linear", "smoothstep"))
    base = rng.randint(2, 9)
    return HashGrid(
        levels=levels,
        features=features,
        log2_entries=rng.randint(10, 12),
        base=base,
        finest=base + rng.randint(1, 50),
        interpolation=smooth,
    )


def hash_encode(rng: random.Random, n: int) -> Call:
    grid, k = hash_grid(rng), rng.choice((None, None, 1, 3))
    table = torch.randn(*grid.table_shape if k is None else (k, *grid.table_shape)).to(rng.choice(FLOATS))
    positions = 3 * torch.rand(n, 3, dtype=rng.choice(FLOATS[:3])) - 1.5
    return {
        "positions": spread(rng, positions),
        "table": table,
        "grid": grid,
        "cells": None if k is None else index(n, k),
    }


def grouped_linear(rng: random.Random, n: int) -> Call:
    k, i, o = rng.choice((1, 2, 17)), rng.choice((1, 3, 16, 33)), rng.choice((1, 4, 16, 33))
    dtype = rng.choice(FLOATS)
    call: Call = {"x": spread(rng, torch.randn(n, i).to(dtype)), "offsets": offsets(rng, n, k)}
    call["weight"] = spread(rng, (torch.randn(k, o, i) / i**0.5).to(dtype))
    call["bias"] = None if rng.random() < 0.3 else torch.randn(k, o).to(dtype)
    return {**call, "activation": rng.choice(ACTIVATIONS)}


def layer_table(rng: random.Random) -> MLP:
    """Some layers, each of which reads earlier ones, positions or directions."""
    layers: list[Layer] = []
    for number in range(rng.randint(1, 4)):
        sources = [POSITIONS, DIRECTIONS, *range(number)]
        first = number - 1 if number else POSITIONS
        inputs = (first, *(rng.sample([s for s in sources if s != first], k=rng.choice((0, 0, 1)))))
        layers.append(Layer(inputs, rng.choice((1, 3, 8, 17)), rng.choice(ACTIVATIONS)))
    count = rng.randint(1, min(2, len(layers)))
    outputs = (*sorted(rng.sample(range(len(layers) - 1), k=count - 1)), len(layers) - 1)
    return MLP(tuple(layers), outputs, rng.choice((0, 2, 4)), rng.choice((0, 1, 2)))


def network(rng: random.Random, n: int, k: int) -> Call:
    layers, dtype = layer_table(rng), rng.choice(FLOATS)
    shapes = layers.weight_shapes(3, 3)
    weights = [(torch.randn(k, o, i) / max(i, 1) ** 0.5).to(dtype) for o, i in shapes]
    biases = [None if rng.random() < 0.3 else torch.randn(k, o).to(dtype) for o, _ in shapes]
    call: Call = {"positions": spread(rng, torch.rand(n, 3).to(dtype)), "weights": weights, "biases": biases}
    call["layers"] = layers
    if layers.uses_directions:
        rays = rng.choice((None, 1, 5))
        call["directions"] = unit(n if rays is None else rays).to(dtype)
        call["direction_index"] = None if rays is None else index(n, rays)
    return call


def grouped_mlp(rng: random.Random, n: int) -> Call:
    k = rng.choice((1, 2, 9))
    return {**network(rng, n, k), "offsets": offsets(rng, n, k)}


def routed_mlp(rng: random.Random, n: int) -> Call:
    if rng.random() < 0.3:
        k = rng.choice((1, 2, 9))
        return {**network(rng, n, k), "cells": index(n, k)}
    tables, k = tree(rng)
    return {**network(rng, n, k), **tables}


def sparse_adam(rng: random.Random, n: int) -> Call:
    call: Call = {"parameter": torch.randn(n, 2), "gradient": torch.randn(n, 2) * (torch.rand(n, 1) < 0.5)}
    call |= {"mean": torch.randn(n, 2), "square": torch.rand(n, 2), "step": rng.randint(1, 9)}
    return {**call, "learning_rate": 0.01}


CALLS = {name: globals()[name] for name in backends.ops() if name in globals()}
