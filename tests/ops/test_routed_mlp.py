from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from helpers import on_any_number_of_threads, same
from op_cases import refusals, refused
from test_grouped_mlp import CPU, Case, check
from torch import Tensor

from voronerf.ops import frequency_encode, grouped_mlp, locate_cell, nearest_centre, routed_mlp
from voronerf.ops._core.layers import MLP, POSITIONS, Layer

pytestmark = pytest.mark.op("routed_mlp")

# A tree of two levels: leaf 0 in the root, leaves 1 to 3 in diagram 1, leaves 4 and 5 in diagram 2.
TREE = {
    "child_offsets": torch.tensor([0, 3, 6, 8], dtype=torch.int32),
    "child": torch.tensor([-1, 1, 2, -2, -3, -4, -5, -6], dtype=torch.int32),
}


@dataclass
class Routed(Case):
    """A network, its samples and the source of their cells."""

    where: dict[str, Any] = field(default_factory=dict)
    cells: Tensor | None = None
    """The expected cells."""

    @classmethod
    def make(cls, name="nerf", source="flat", n=61, rays=5, dtype=torch.float32):
        k = 1 if source == "one" else 6
        case = super().make(name, [n, *[0] * (k - 1)], dtype, rays)
        points, case.where = case.inputs[0][:, :3], {"centres": torch.rand(8 if source == "tree" else k, 3) - 0.5}
        if source == "cells":  # some cells stay empty
            case.cells = torch.randint(1, 4, (n,), dtype=torch.int32)
            case.where = {"cells": case.cells}
        elif source == "tree":
            case.where |= {**TREE, "depth": 2}
            case.cells = locate_cell(points, **case.where, backend="reference")
        else:
            case.cells = nearest_centre(points, **case.where, backend="reference")
        return case

    def routed(self, leaves, **changed):
        device = leaves[0].device
        where = {key: value.to(device) if isinstance(value, Tensor) else value for key, value in self.where.items()}
        return routed_mlp(**{**self.arguments(leaves), **where, **changed})

    def run(self, mlp, leaves, **options):
        """Evaluates the op, or a function of sorted samples."""
        if mlp is routed_mlp:
            return self.routed(leaves, **options)[0]
        arguments, order = self.arguments(leaves), self.cells.argsort(stable=True)
        for key in ("positions", "directions" if self.direction_index is None else "direction_index"):
            arguments[key] = None if arguments[key] is None else arguments[key][order]
        offsets = torch.tensor([0, *self.cells.bincount(minlength=len(self.inputs[2]))]).cumsum(0).int()
        return mlp(**arguments, offsets=offsets)[order.argsort()]


@pytest.mark.parametrize(
    ("name", "source", "rays"),
    [
        *(("nerf", source, rays) for source in ("flat", "tree", "cells", "one") for rays in (5, None)),
        *(("plain", "tree", 5), ("tangled", "one", 5), ("spherical", "cells", None), ("integrated", "flat", 5)),
    ],
)
def test_output_cells_and_gradients(device, backend, name, source, rays):
    case = Routed.make(name, source, rays=rays)
    check(case.results, routed_mlp, device, backend)
    out, cells = case.routed([tensor.to(device) for tensor in case.inputs], backend=backend)
    assert cells.dtype == torch.int32 and torch.equal(cells.cpu(), case.cells)
    assert out.shape == (61, case.table.out_features)


def test_float64_positions_and_half_coordinates(device, backend):
    case = Routed.make()
    leaves = [tensor.to(device) for tensor in case.inputs]
    expected, _ = case.routed(leaves, backend=backend)
    actual, cells = case.routed([leaves[0].double(), *leaves[1:]], backend=backend)
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)
    assert torch.equal(cells.cpu(), case.cells)
    halves = leaves[0].half()
    _, cells = case.routed(leaves, coords=halves, backend=backend)
    assert torch.equal(cells, nearest_centre(halves, case.where["centres"].to(device)))


def test_coordinates_beside_encoded_positions(device, backend):
    case = Routed.make("plain", "tree")
    leaves = [tensor.to(device) for tensor in case.inputs]
    raw, _ = case.routed(leaves, backend=backend)
    encoded = frequency_encode(leaves[0], 4)
    case.table = replace(case.table, position_octaves=None)
    for arguments in ({}, {"coords": leaves[0]}):
        result, cells = case.routed([encoded, *leaves[1:]], **arguments, backend=backend)
        torch.testing.assert_close(result, raw, rtol=1e-5, atol=1e-5)
        assert torch.equal(cells.cpu(), case.cells)
    _, elsewhere = case.routed([encoded, *leaves[1:]], coords=leaves[0] + 9, backend=backend)
    assert not torch.equal(elsewhere.cpu(), case.cells)


def test_samples_nowhere_go_to_the_first_cell(device, backend):
    for source in ("flat", "tree"):
        case = Routed.make("nerf", source)
        plain, cells = case.routed([tensor.to(device) for tensor in case.inputs], backend=backend)
        rows = [3, 17, 40]
        for row, value in zip(rows, (torch.nan, torch.inf, -torch.inf)):
            case.inputs[0][row] = value
        leaves = case.leaves(torch.float32, device)
        out, result = case.routed(leaves, backend=backend)
        others = [row for row in range(61) if row not in rows]
        assert (result[rows] == 0).all() and torch.equal(result[others], cells[others])
        torch.testing.assert_close(out[others], plain[others], rtol=1e-5, atol=1e-6)
        out[others].sum().backward()
        assert leaves[0].grad[others].isfinite().all() and leaves[2].grad[1:].isfinite().all()


@pytest.mark.parametrize("rays", [3, None])
def test_second_derivatives(device, backend, rays):
    check(Routed.make("integrated", "flat", n=9, rays=rays).penalty, routed_mlp, device, backend)


def test_auto_composes_where_nothing_is_fused():
    case = Routed.make("nerf", "tree", dtype=torch.float64)
    assert case.routed(case.inputs)[0].dtype == torch.float64
    check(case.results, routed_mlp, CPU, "auto", torch.float64)


def test_cells_outside_are_refused(backend):
    case = Routed.make("nerf", "cells")
    for value in (-1, 6):
        case.where["cells"][5] = value
        with pytest.raises(ValueError, match=r"^routed_mlp: cells must lie in 0 to 5, got values from"):
            case.routed(case.inputs, backend=backend)


def test_errors():
    case, op = Routed.make("nerf", "flat"), "routed_mlp"
    cells, nothing = case.cells, [tensor[:0] for tensor in case.inputs[2:9]]
    refuses = refusals(functools.partial(case.routed, case.inputs), op)
    refuses("centres must be None where cells are given, got both", cells=cells)
    refuses("centres or cells must be given for 6 cells, got neither", centres=None)
    refuses("child must come with centres, got no centres", centres=None, cells=cells, child=TREE["child"])
    refuses("child_offsets and child must come together, got no child_offsets", child=TREE["child"])
    refuses("depth must be 1 for a flat diagram, got 2", depth=2)
    refuses("cells must have shape [n] with n = 61, got [60]", centres=None, cells=cells[1:])
    refuses("coords require centres, got no centres", centres=None, cells=cells, coords=case.inputs[0])
    refuses("coords must have shape [n, 3] with n = 61, got [61, 2]", coords=case.inputs[0][:, :2])
    refuses("directions must be given for layers that read them, got None", directions=None, direction_index=None)
    refuses("weights must have one entry for each of 7 layers, got 0", weights=[])
    refuses("weights[0] must hold at least one cell, got [0, 16, 21]", weights=nothing, biases=[None] * 7)
    narrow = Routed.make("one layer")
    narrow.inputs[0], narrow.inputs[2] = narrow.inputs[0][:, :2], narrow.inputs[2][:, :, :2]
    with refused(ValueError, f"{op}: coords must be given for positions with fewer than 3 features, got 2"):
        narrow.routed(narrow.inputs)
    integrated = Routed.make("integrated")
    message = "positions must have 6 features, mean and variance, where they are integrated, got 3"
    positions = integrated.inputs[0][:, :3]
    with refused(ValueError, f"{op}: {message}"):
        integrated.routed(integrated.inputs, positions=positions)
    with refused(ValueError, f"grouped_mlp: {message}"):
        grouped_mlp(positions, torch.zeros(7).int(), [], [], layers=integrated.table, directions=positions)


@pytest.mark.native
def test_errors_of_the_kernel():
    tree = Routed.make("nerf", "tree")
    run = functools.partial(tree.routed, tree.inputs, backend="native")
    refuses = refusals(run, "locate_cell")
    refuses("child must name a diagram (below the number of diagrams) or a leaf (negative)", child=TREE["child"] + 9)
    refuses("depth must be the number of levels of the tree, got 1, which is too few", depth=1)
    # This leaf has no network.
    leaf = torch.where(TREE["child"] == -6, -7, TREE["child"])
    refusals(run, "cell_sort")("cells must lie in 0 to 5, got values from ...", child=leaf)
    for bad, backend in itertools.product((-1, 5), ("reference", "native")):  # the reference runs separate operations
        index = tree.direction_index.clone()
        index[-1] = bad
        with refused(ValueError, f"routed_mlp: direction_index must be 0 to 4, got {bad}"):
            tree.routed(tree.inputs, backend=backend, direction_index=index)


@pytest.mark.native
@pytest.mark.parametrize("name", ["wide", "nerf", "integrated", "tangled"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_same_bits_as_the_separate_operations_on_any_number_of_threads(name, dtype):
    wide = MLP((Layer((POSITIONS,), 64, "relu"), Layer((0,), 64, "relu"), Layer((1,), 4)), (2,), position_octaves=10)
    case = Routed.make("nerf" if name == "wide" else name, n=3001)
    if name == "wide":
        case.table, case.bias = wide, [False] * 3
        case.inputs[2:] = [torch.randn(6, o, i) / i**0.5 for o, i in wide.weight_shapes(3)]
    case.inputs[2:] = [tensor.to(dtype) for tensor in case.inputs[2:]]

    def results(mlp, **options):
        leaves = [tensor.detach().requires_grad_() for tensor in case.inputs]
        y = case.run(mlp, leaves, **options)
        g = torch.linspace(-1, 2, y.numel()).view_as(y).to(y.dtype)
        return [y, *torch.autograd.grad(y, leaves, g, allow_unused=True, materialize_grads=True)]

    actual = on_any_number_of_threads(lambda: results(routed_mlp, backend="native"))
    assert same(actual, results(grouped_mlp))


@pytest.mark.parametrize("rows", [0, 1, 23, 40])
@pytest.mark.parametrize("source", ["one", "flat"])
def test_rows_beyond_those_that_count_are_in_no_cell(device, backend, source, rows):
    """Rows beyond the row count may hold anything, like unused rows of a march with a capacity."""
    case, results = Routed.make("plain", source, n=40), []
    if source == "one":
        case.where = {}
    for more in ({}, {"rows": torch.tensor([rows], dtype=torch.int32, device=device)}):
        positions, *others = case.leaves(torch.float32, device)
        out, cells = case.routed([positions if more else positions[:rows], *others], backend=backend, **more)
        out.square().sum().backward()
        results.append((out, cells, [leaf.grad for leaf in others[1:]]))
    (out, cells, gradients), (all_out, all_cells, all_gradients) = results
    torch.testing.assert_close(all_out[:rows], out)
    assert torch.equal(all_cells[:rows], cells) and not all_out[rows:].any()
    assert bool((all_cells[rows:] == -1).all())
    torch.testing.assert_close(all_gradients, gradients)
