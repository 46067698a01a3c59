from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import Any

import loops
import pytest
import torch
from helpers import on_any_number_of_threads, same
from op_cases import need, refusals, refused
from tolerances import assert_as_exact
from torch import Tensor

from voronerf.ops import cell_sort, frequency_encode, grouped_mlp, locate_cell, nearest_centre, routed_mlp
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer

pytestmark = pytest.mark.op("routed_mlp")

CPU = torch.device("cpu")
PLAIN = MLP((Layer((POSITIONS,), 9, "softplus"), Layer((0,), 4)), (1,), position_octaves=4)
# A skip connection, a density head and a view branch.
NERF = MLP(
    (
        Layer((POSITIONS,), 16, "sine"),
        Layer((POSITIONS, 0), 16, "softplus"),
        Layer((1,), 1, "softplus"),
        Layer((1, DIRECTIONS), 7, "softplus"),
        Layer((3,), 3, "sigmoid"),
    ),
    outputs=(4, 2),
    position_octaves=3,
    direction_octaves=2,
)
TABLES = {
    "plain": PLAIN,
    "raw": replace(PLAIN, position_octaves=None),
    "nerf": NERF,
    "spherical": replace(NERF, direction_octaves=None, direction_encoding="spherical", direction_degree=3),
    "integrated": replace(NERF, position_encoding="integrated"),
}
# A tree of two levels: leaf 0 in the root, leaves 1 to 3 in diagram 1, leaves 4 and 5 in diagram 2.
TREE = {
    "child_offsets": torch.tensor([0, 3, 6, 8], dtype=torch.int32),
    "child": torch.tensor([-1, 1, 2, -2, -3, -4, -5, -6], dtype=torch.int32),
}


@dataclass
class Case:
    """A network, its samples and the source of its cells."""

    table: MLP
    leaves: list[Tensor]
    """Positions, directions, then weights, then biases."""
    options: dict[str, Any]
    bias: list[bool]
    expected_cells: Tensor
    extra: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def make(cls, name="nerf", source="flat", n=61, rays=5, dtype=torch.float32):
        table = TABLES[name]
        k = {"flat": 6, "tree": 6, "cells": 6, "one": 1}[source]
        positions = 2 * torch.rand(n, 3) - 1
        centres = torch.rand(8 if source == "tree" else k, 3) - 0.5
        options = {"centres": centres}
        if source == "tree":
            options |= {**TREE, "depth": 2}
            cells = locate_cell(positions, centres, **TREE, depth=2, backend="reference")
        elif source == "cells":
            # Some cells stay empty.
            cells = torch.randint(1, 4, (n,), dtype=torch.int32)
            options = {"cells": cells}
        else:
            cells = nearest_centre(positions, centres, backend="reference")
        if table.integrated:
            positions = torch.cat([positions, 0.05 * torch.rand(n, 3)], dim=1)
        directions = torch.nn.functional.normalize(torch.randn(n if rays is None else rays, 3), dim=1)
        if table.uses_directions and rays is not None:
            options["direction_index"] = torch.randint(0, rays, (n,), dtype=torch.int32)
        weights = [torch.randn(k, o, i) / i**0.5 for o, i in table.weight_shapes(positions.shape[1], 3)]
        bias = [index != 1 for index in range(len(weights))]
        biases = [torch.randn(k, weight.shape[1]) for weight, has in zip(weights, bias) if has]
        leaves = [tensor.to(dtype) for tensor in (positions, directions, *weights, *biases)]
        return cls(table, leaves, options, bias, cells)

    def run(self, leaves, **changed):
        positions, directions, *parameters = leaves
        biases = iter(parameters[len(self.bias) :])
        device = positions.device
        options = {key: value.to(device) if isinstance(value, Tensor) else value for key, value in self.options.items()}
        arguments = {
            "positions": positions,
            "weights": parameters[: len(self.bias)],
            "biases": [next(biases) if has else None for has in self.bias],
            "layers": self.table,
            "directions": directions if self.table.uses_directions else None,
            **options,
            **changed,
        }
        return routed_mlp(**arguments)

    def leaf_tensors(self, dtype=torch.float32, device=CPU):
        return [tensor.detach().to(device, dtype).requires_grad_() for tensor in self.leaves]

    def specified(self, leaves):
        """Evaluates the definition, cell by cell."""
        positions, directions, *parameters = leaves
        index = self.options.get("direction_index")
        seen = directions if index is None else directions[index]
        order = self.expected_cells.argsort(stable=True)
        k = parameters[0].shape[0]
        biases = iter(parameters[len(self.bias) :])
        out = loops.grouped_mlp(
            positions[order],
            torch.tensor([0, *self.expected_cells.bincount(minlength=k)]).cumsum(0).int(),
            parameters[: len(self.bias)],
            [next(biases) if has else None for has in self.bias],
            layers=self.table,
            directions=seen[order] if self.table.uses_directions else None,
        )
        return out[order.argsort()]

    def results(self, run, dtype, device=CPU):
        leaves = self.leaf_tensors(dtype, device)
        y = run(leaves)
        g = torch.randn(y.shape, generator=torch.Generator().manual_seed(1)).to(device, dtype)
        return [y, *torch.autograd.grad(y, leaves, g, allow_unused=True, materialize_grads=True)]

    def check(self, device, backend, dtype=torch.float32):
        exact = self.results(self.specified, torch.float64)
        plain = self.results(self.specified, dtype)
        actual = self.results(lambda leaves: self.run(leaves, backend=backend)[0], dtype, device)
        for part, usual, right in zip(actual, plain, exact):
            assert_as_exact(part, usual, right)


@pytest.mark.parametrize("source", ["flat", "tree", "cells", "one"])
@pytest.mark.parametrize("name", TABLES)
def test_output_cells_and_gradients(device, backend, name, source):
    case = Case.make(name, source)
    case.check(device, backend)
    out, cells = case.run([tensor.to(device) for tensor in case.leaves], backend=backend)
    assert cells.dtype == torch.int32 and torch.equal(cells.cpu(), case.expected_cells)
    assert out.shape == (61, case.table.out_features)


@pytest.mark.parametrize("n", [95, 97, 2500])
def test_any_number_of_samples(device, backend, n):
    Case.make(n=n).check(device, backend)


def test_directions_of_each_sample(device, backend):
    Case.make(rays=None).check(device, backend)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("name", ["nerf", "integrated"])
def test_half_types(device, backend, name, dtype):
    need("routed_mlp", backend, device, dtype)
    case = Case.make(name, "cells", dtype=dtype)
    case.check(device, backend, dtype)


def test_float64_positions_and_half_coordinates(device, backend):
    case = Case.make()
    leaves = [tensor.to(device) for tensor in case.leaves]
    expected, _ = case.run(leaves, backend=backend)
    actual, cells = case.run([leaves[0].double(), *leaves[1:]], backend=backend)
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)
    assert torch.equal(cells.cpu(), case.expected_cells)
    halves = leaves[0].half()
    _, cells = case.run(leaves, coords=halves, backend=backend)
    assert torch.equal(cells, nearest_centre(halves, case.options["centres"].to(device)))


def test_coordinates_beside_encoded_positions(device, backend):
    case = Case.make("plain", "tree")
    leaves = [tensor.to(device) for tensor in case.leaves]
    raw, _ = case.run(leaves, backend=backend)
    encoded = frequency_encode(leaves[0], 4)
    case.table = replace(case.table, position_octaves=None)
    for arguments in ({}, {"coords": leaves[0]}):
        result, cells = case.run([encoded, *leaves[1:]], **arguments, backend=backend)
        torch.testing.assert_close(result, raw, rtol=1e-5, atol=1e-5)
        assert torch.equal(cells.cpu(), case.expected_cells)
    _, elsewhere = case.run([encoded, *leaves[1:]], coords=leaves[0] + 9, backend=backend)
    assert not torch.equal(elsewhere.cpu(), case.expected_cells)


def test_samples_nowhere_go_to_the_first_cell(device, backend):
    for source in ("flat", "tree"):
        case = Case.make("nerf", source)
        plain, cells = case.run([tensor.to(device) for tensor in case.leaves], backend=backend)
        rows = [3, 17, 40]
        for row, value in zip(rows, (torch.nan, torch.inf, -torch.inf)):
            case.leaves[0][row] = value
        leaves = case.leaf_tensors(torch.float32, device)
        out, result = case.run(leaves, backend=backend)
        others = [row for row in range(61) if row not in rows]
        assert (result[rows] == 0).all() and torch.equal(result[others], cells[others])
        torch.testing.assert_close(out[others], plain[others], rtol=1e-5, atol=1e-6)
        out[others].sum().backward()
        assert leaves[0].grad[others].isfinite().all() and leaves[2].grad[1:].isfinite().all()


@pytest.mark.parametrize("rays", [3, None])
def test_second_derivatives(device, backend, rays):
    case = Case.make("integrated", "flat", n=9, rays=rays)

    def penalty(run, dtype, device):
        leaves = case.leaf_tensors(dtype, device)
        (slope,) = torch.autograd.grad(run(leaves).square().sum(), leaves[0], create_graph=True)
        return list(torch.autograd.grad(slope.square().sum(), leaves, allow_unused=True, materialize_grads=True))

    exact = penalty(case.specified, torch.float64, CPU)
    plain = penalty(case.specified, torch.float32, CPU)
    actual = penalty(lambda leaves: case.run(leaves, backend=backend)[0], torch.float32, device)
    for part, usual, right in zip(actual, plain, exact):
        assert_as_exact(part, usual, right)


def test_auto_composes_where_nothing_is_fused():
    case = Case.make("nerf", "tree", dtype=torch.float64)
    assert case.run(case.leaves)[0].dtype == torch.float64
    case.check(CPU, "auto", torch.float64)


def test_cells_outside_are_refused(backend):
    case = Case.make("nerf", "cells")
    for value in (-1, 6):
        case.options["cells"][5] = value
        with pytest.raises(ValueError, match=r"^routed_mlp: cells must lie in 0 to 5, got values from"):
            case.run(case.leaves, backend=backend)


def test_errors():
    case, op = Case.make("nerf", "flat"), "routed_mlp"
    centres, cells = case.options["centres"], case.expected_cells
    refuses = refusals(functools.partial(case.run, case.leaves), op)
    refuses("positions must have shape [n, p], got [3]", positions=case.leaves[0][0])
    refuses("centres must be None where cells are given, got both", cells=cells)
    refuses("centres or cells must be given for 6 cells, got neither", centres=None)
    refuses("child must come with centres, got no centres", centres=None, cells=cells, child=TREE["child"])
    refuses("child_offsets and child must come together, got no child_offsets", child=TREE["child"])
    refuses("depth must be 1 for a flat diagram, got 2", depth=2)
    refuses("centres must have shape [k, 3] with k = 6, got [5, 3]", centres=centres[1:])
    refuses("centres must have dtype ..., got int32", centres=centres.int())
    refuses("cells must have shape [n] with n = 61, got [60]", centres=None, cells=cells[1:])
    refuses("cells must have dtype int32, got int64", centres=None, cells=cells.long())
    refuses("coords require centres, got no centres", centres=None, cells=cells, coords=case.leaves[0])
    refuses("coords must have shape [n, 3] with n = 61, got [61, 2]", coords=case.leaves[0][:, :2])
    refuses("directions must be given for layers that read them, got None", directions=None, direction_index=None)
    refuses("weights must have one entry for each of 5 layers, got 0", weights=[])
    refuses(
        "weights[0] must hold at least one cell, got [0, 16, 21]",
        weights=[tensor[:0] for tensor in case.leaves[2:7]],
        biases=[None] * 5,
    )
    refuses("centres must be on the device of positions, cpu, got meta", centres=centres.to("meta"))
    narrow = Case.make("raw")
    narrow.leaves[0], narrow.leaves[2] = narrow.leaves[0][:, :2], narrow.leaves[2][:, :, :2]
    with refused(ValueError, f"{op}: coords must be given for positions with fewer than 3 features, got 2"):
        narrow.run(narrow.leaves)
    integrated = Case.make("integrated")
    message = "positions must have 6 features, mean and variance, where they are integrated, got 3"
    with refused(ValueError, f"{op}: {message}"):
        integrated.run(integrated.leaves, positions=integrated.leaves[0][:, :3])
    with refused(ValueError, f"grouped_mlp: {message}"):
        grouped_mlp(
            integrated.leaves[0][:, :3],
            torch.zeros(7).int(),
            [],
            [],
            layers=integrated.table,
            directions=integrated.leaves[0][:, :3],
        )


@pytest.mark.native
def test_errors_of_the_kernel():
    tree = Case.make("nerf", "tree")
    run = functools.partial(tree.run, tree.leaves, backend="native")
    refuses = refusals(run, "locate_cell")
    refuses("child must name a diagram (below the number of diagrams) or a leaf (negative)", child=TREE["child"] + 9)
    refuses("depth must be the number of levels of the tree, got 1, which is too few", depth=1)
    # This leaf has no network.
    leaf = torch.where(TREE["child"] == -6, -7, TREE["child"])
    refusals(run, "cell_sort")("cells must lie in 0 to 5, got values from ...", child=leaf)
    refusals(run, "routed_mlp")(
        "direction_index must be 0 to 4, got 5",
        direction_index=tree.options["direction_index"] + 1 + (tree.options["direction_index"] == 3).int(),
    )


def test_an_index_of_no_ray_is_refused_where_the_operations_are_separate():
    case = Case.make("nerf", "tree")
    for bad in (-1, 5):
        index = case.options["direction_index"].clone()
        index[-1] = bad
        with refused(ValueError, f"routed_mlp: direction_index must be 0 to 4, got {bad}"):
            case.run(case.leaves, backend="reference", direction_index=index)


@pytest.mark.native
@pytest.mark.parametrize("name", ["wide", "nerf", "integrated", "raw"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_same_bits_as_the_separate_operations_on_any_number_of_threads(name, dtype):
    wide = MLP((Layer((POSITIONS,), 64, "relu"), Layer((0,), 64, "relu"), Layer((1,), 4)), (2,), position_octaves=10)
    case = Case.make("nerf" if name == "wide" else name, n=3001)
    if name == "wide":
        case.table, case.bias = wide, [False] * 3
        case.leaves[2:] = [torch.randn(6, o, i) / i**0.5 for o, i in wide.weight_shapes(3)]
        case.options.pop("direction_index")
    case.leaves[2:] = [tensor.to(dtype) for tensor in case.leaves[2:]]
    uses = case.table.uses_directions
    index = case.options.get("direction_index")

    def separate(leaves):
        positions, directions, *parameters = leaves
        order, offsets = cell_sort(nearest_centre(positions[:, :3], case.options["centres"]), 6)
        biases = iter(parameters[len(case.bias) :])
        out = grouped_mlp(
            positions[order],
            offsets,
            parameters[: len(case.bias)],
            [next(biases) if has else None for has in case.bias],
            layers=case.table,
            directions=directions if uses else None,
            direction_index=index[order] if uses else None,
        )
        return torch.zeros_like(out).index_copy(0, order.long(), out)

    def results(run):
        leaves = [tensor.detach().requires_grad_() for tensor in case.leaves]
        y = run(leaves)
        g = torch.linspace(-1, 2, y.numel()).view_as(y).to(y.dtype)
        return [y, *torch.autograd.grad(y, leaves, g, allow_unused=True, materialize_grads=True)]

    actual = on_any_number_of_threads(lambda: results(lambda leaves: case.run(leaves, backend="native")[0]))
    assert same(actual, results(separate))


@pytest.mark.parametrize("rows", [0, 1, 23, 40])
@pytest.mark.parametrize("k", [1, 3])
def test_rows_beyond_those_that_count_are_in_no_cell(device, backend, rows, k):
    """Rows beyond the row count may hold anything, like unused rows of a march with a capacity."""
    table = MLP((Layer(("positions",), 8, "relu"), Layer((0,), 2)), outputs=(1,))
    torch.manual_seed(0)
    results = []
    for count in (rows, 40):
        weights = [
            torch.ones(k, 8, 3, device=device).mul_(0.1),
            torch.linspace(-1, 1, 16 * k, device=device).view(k, 2, 8),
        ]
        weights = [weight.requires_grad_() for weight in weights]
        positions = torch.linspace(0, 1, 120, device=device).view(40, 3)[:count]
        arguments = {
            "layers": table,
            "centres": positions.new_tensor([[0.1] * 3, [0.5] * 3, [0.9] * 3]) if k > 1 else None,
        }
        if count == 40:
            arguments["rows"] = torch.tensor([rows], dtype=torch.int32, device=device)
        out, cells = routed_mlp(positions, weights, [None, None], **arguments, backend=backend)
        out.square().sum().backward()
        results.append((out, cells, [weight.grad for weight in weights]))
    (out, cells, gradients), (all_out, all_cells, all_gradients) = results
    torch.testing.assert_close(all_out[:rows], out)
    assert torch.equal(all_cells[:rows], cells) and not all_out[rows:].any()
    assert bool((all_cells[rows:] == -1).all())
    torch.testing.assert_close(all_gradients, gradients)
