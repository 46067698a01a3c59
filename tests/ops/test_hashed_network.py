"""Networks with a hash grid on positions, against `hash_encode` followed by a network of its features."""

from __future__ import annotations

import pytest
import torch
from helpers import all_pairs, on_any_number_of_threads
from op_cases import offsets_of, refused

from voronerf import MLP, HashGrid, Layer
from voronerf.ops import grouped_mlp, hash_encode, nearest_centre, routed_mlp
from voronerf.ops.network.reference import cells_of

GRIDS = {
    "plain": HashGrid(levels=4, features=2, log2_entries=10, base=4, finest=64),
    "odd": HashGrid(levels=3, features=1, log2_entries=12, base=3, finest=9),
    "wide": HashGrid(levels=5, features=8, log2_entries=10, base=8, finest=100, box=((-1, -1, -1), (2, 2, 2))),
}
own_tables = pytest.mark.parametrize("own", [False, True], ids=["shared", "own tables"])
COUNTS = [5, 0, 130, 1]


def table_of(grid):
    """Returns a layer table with a layer on positions, a skip connection from positions, and a head with directions."""
    layers = (
        Layer(("positions",), 17, "relu"),
        Layer((0, "positions"), 16, "softplus"),
        Layer((1,), 1),
        Layer((1, "directions"), 3),
    )
    hashed = {"position_encoding": "hash", "grid": grid} if grid is not None else {}
    return MLP(layers, (3, 2), direction_octaves=2, **hashed)


def network(grid, own, device="cpu", dtype=torch.float32, k=4):
    generator = torch.Generator().manual_seed(1)

    def random(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64).to(device, dtype)

    shapes = table_of(grid).weight_shapes(3, 3)
    features = random(*([k] if own else []), *grid.table_shape)
    return [random(k, o, i) / i**0.5 for o, i in shapes], [random(k, o) / 4 for o, _ in shapes], features


def inputs(n, device="cpu", dtype=torch.float32):
    generator = torch.Generator().manual_seed(2)
    x = torch.rand(n, 3, generator=generator, dtype=torch.float64)
    rays, index = torch.randn(9, 3, generator=generator, dtype=torch.float64), torch.arange(n, dtype=torch.int32) % 9
    return x.to(device, dtype), rays.to(device, dtype), index.to(device)


@pytest.mark.parametrize(
    *all_pairs({"where": ["offsets", "centres", "cells", "one cell"], "name": GRIDS, "own": [False, True]})
)
@pytest.mark.op("routed_mlp")
def test_equals_encoding_and_network(device, backend, where, name, own):
    grid, k, n = GRIDS[name], 1 if where == "one cell" else len(COUNTS), sum(COUNTS)
    weights, biases, features = network(grid, own, device, k=k)
    x, rays, index = inputs(n, device)
    centres, offsets = torch.rand(k, 3, device=device), offsets_of(COUNTS, device)
    cells = cells_of(offsets, x) if where == "offsets" else nearest_centre(x, centres)
    leaves = [t.requires_grad_() for t in (x, rays, features, *weights, *biases)]
    arguments = {"directions": rays, "direction_index": index, "backend": backend}

    def run(positions, layers, place, **more):
        if where == "offsets":
            return grouped_mlp(positions, offsets, weights, biases, layers=layers, **more, **arguments)
        return routed_mlp(positions, weights, biases, layers=layers, **place, **more, **arguments)[0]

    place = {"centres": {"centres": centres}, "cells": {"cells": cells}}.get(where, {})
    actual = run(x, table_of(grid), place, features=features)
    encoded = hash_encode(x, features, grid, cells=cells if own else None, backend="reference")
    expected = run(encoded, table_of(None), {"cells": cells})
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)
    g = torch.randn_like(actual)
    for a, b in zip(torch.autograd.grad(actual, leaves, g), torch.autograd.grad(expected, leaves, g), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(*all_pairs({"own": [False, True], "kept": [0, 3, 40, 89], "where": ["cells", "one cell"]}))
@pytest.mark.op("routed_mlp")
def test_rows_without_a_gradient_teach_nothing(device, backend, own, kept, where):
    grid, k = GRIDS["plain"], 1 if where == "one cell" else len(COUNTS)
    weights, biases, features = network(grid, own, device, k=k)
    x, rays, index = inputs(90, device)
    cells = None if k == 1 else (torch.arange(90, dtype=torch.int32, device=device) * 7) % k
    leaves = [t.requires_grad_() for t in (features, *weights, *biases)]
    rows = torch.randperm(90, generator=torch.Generator().manual_seed(3))[:kept].sort().values.to(device)
    g = torch.zeros(90, 4, device=device).index_fill_(0, rows, 1.0)

    def gradients(x, index, cells, g):
        arguments = {"layers": table_of(grid), "features": features, "directions": rays, "direction_index": index}
        result, _ = routed_mlp(x, weights, biases, cells=cells, backend=backend, **arguments)
        return torch.autograd.grad(result, leaves, g)

    alone = gradients(x[rows], index[rows], None if cells is None else cells[rows], g[rows])
    counts = (1, 2, 3) if backend == "native" and device.type == "cpu" else (1,)
    for a, b in zip(on_any_number_of_threads(lambda: gradients(x, index, cells, g), counts), alone, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@own_tables
@pytest.mark.op("grouped_mlp")
def test_second_derivatives(device, backend, own):
    grid, offsets = GRIDS["odd"], offsets_of(COUNTS, device)
    x, rays, index = inputs(sum(COUNTS), device)

    def eikonal(dtype, backend):
        weights, biases, features = network(grid, own, device, dtype)
        leaves = [t.to(dtype).detach().requires_grad_() for t in (x, features, weights[0], biases[1])]
        at, features, weights[0], biases[1] = leaves
        arguments = {"directions": rays.to(dtype), "direction_index": index, "backend": backend}
        out = grouped_mlp(at, offsets, weights, biases, layers=table_of(grid), features=features, **arguments)
        (slope,) = torch.autograd.grad(out[:, 0].sum(), at, create_graph=True)
        return torch.autograd.grad(((slope.norm(dim=1) - 1) ** 2).sum(), leaves)

    for a, b in zip(eikonal(torch.float32, backend), eikonal(torch.float64, "reference"), strict=True):
        assert (a.double() - b).norm() <= 1e-4 * b.norm()


@pytest.mark.op("grouped_mlp")
def test_is_part_of_a_graph(device, backend):
    """Native has one opaque op; the compiler traces the grid itself on other backends, here with a shared table."""
    torch.compiler.reset()
    own, offsets = backend == "native", offsets_of(COUNTS, device)
    weights, biases, features = network(GRIDS["plain"], own, device)
    x, rays, index = inputs(sum(COUNTS), device)
    arguments = {"directions": rays, "direction_index": index, "layers": table_of(GRIDS["plain"]), "backend": backend}

    def run(x, features):
        return grouped_mlp(x, offsets, weights, biases, features=features, **arguments)

    compiled = torch.compile(run, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(x, features), run(x, features))


@own_tables
@pytest.mark.op("grouped_mlp")
def test_rows_of_no_cell_teach_nothing_whatever_they_hold(device, backend, own):
    weights, biases, features = network(GRIDS["plain"], own, device)
    x, rays, index = inputs(9, device)
    x[0], x[8] = torch.nan, torch.inf
    leaves = [leaf.requires_grad_() for leaf in (x, features, *weights)]
    arguments = {"directions": rays, "direction_index": index, "layers": table_of(GRIDS["plain"]), "backend": backend}
    out = grouped_mlp(x, offsets_of([3, 0, 2, 2], device) + 1, weights, biases, features=features, **arguments)
    result = torch.autograd.grad(out.square().sum(), leaves)
    assert out.isfinite().all() and all(slope.isfinite().all() for slope in result)


def test_errors():
    grid, offsets = GRIDS["plain"], offsets_of(COUNTS)
    weights, biases, features = network(grid, False)
    x, rays, index = inputs(sum(COUNTS))
    arguments = {"directions": rays, "direction_index": index, "layers": table_of(grid)}
    with refused(ValueError, "grouped_mlp: features must be given for layers with a hash grid, got None"):
        grouped_mlp(x, offsets, weights, biases, **arguments)
    e = len(features)
    with refused(ValueError, f"grouped_mlp: features must have shape [{e}, 2], got [{e - 1}, 2]"):
        grouped_mlp(x, offsets, weights, biases, features=features[1:], **arguments)
    with refused(ValueError, "grouped_mlp: positions must have 3 features where they are hashed, got 2"):
        grouped_mlp(x[:, :2], offsets, weights, biases, features=features, **arguments)
    with refused(ValueError, f"routed_mlp: features must be None for layers without a hash grid, got [{e}, 2]"):
        routed_mlp(x.repeat(1, 3), weights, biases, **{**arguments, "layers": table_of(None)}, features=features)
    rule = 'MLP: grid must be set if and only if position_encoding is "hash", without position_octaves'
    with refused(ValueError, f"{rule}, got hash ..."):
        MLP((Layer(("positions",), 4),), (0,), position_encoding="hash")
