from __future__ import annotations

from dataclasses import dataclass, replace

import loops
import pytest
import torch
from op_cases import COUNTS, HALVES, need, offsets_of, refusals, refused
from tolerances import assert_as_exact, error
from torch import Tensor

from voronerf.ops import grouped_mlp
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer

pytestmark = pytest.mark.op("grouped_mlp")

CPU = torch.device("cpu")
TABLES = {
    "one layer": MLP((Layer((POSITIONS,), 1),), (0,), position_octaves=0),
    "plain": MLP((Layer((POSITIONS,), 9, "softplus"), Layer((0,), 4)), (1,), position_octaves=4),
    # A small version of the original NeRF: a skip connection, a density head and a view branch.
    "nerf": MLP(
        (
            Layer((POSITIONS,), 16, "sine"),
            Layer((0,), 16, "softplus"),
            Layer((POSITIONS, 1), 16, "softplus"),
            Layer((2,), 1, "softplus"),
            Layer((2,), 8),
            Layer((4, DIRECTIONS), 7, "sine"),
            Layer((5,), 3, "sigmoid"),
        ),
        outputs=(6, 3),
        position_octaves=3,
        direction_octaves=2,
    ),
    # Three layers read harmonics of the direction: two with other inputs, one without.
    "spherical": MLP(
        (
            Layer((POSITIONS,), 16, "softplus"),
            Layer((0, DIRECTIONS), 7, "sine"),
            Layer((DIRECTIONS, 1, POSITIONS), 5, "sigmoid"),
            Layer((DIRECTIONS,), 2),
        ),
        outputs=(2, 3),
        position_octaves=3,
        direction_encoding="spherical",
        direction_degree=4,
    ),
    # The positions are Gaussians, as in mip-NeRF.
    "integrated": MLP(
        (Layer((POSITIONS,), 9, "softplus"), Layer((0, POSITIONS), 6, "sine"), Layer((DIRECTIONS, 1), 4)),
        outputs=(2, 0),
        position_octaves=5,
        position_encoding="integrated",
    ),
    # One layer is read three times, one is an output and an input, one is not read, and one output is listed twice.
    "tangled": MLP(
        (
            Layer((DIRECTIONS, POSITIONS, DIRECTIONS), 5, "sigmoid"),
            Layer((0, 0, POSITIONS), 3, "sine"),
            Layer((1,), 2, "relu"),
            Layer((0, 1), 4),
        ),
        outputs=(3, 0, 3),
        direction_octaves=1,
    ),
}


@dataclass
class Case:
    """A network, its samples and its options."""

    table: MLP
    offsets: Tensor
    inputs: list[Tensor]
    """Positions, directions, then weights, then biases."""
    direction_index: Tensor | None
    bias: list[bool]

    @classmethod
    def make(cls, name, counts, dtype=torch.float32, rays=5):
        table, n, k = TABLES.get(name, name), sum(counts), len(counts)
        positions = 2 * torch.rand(n, 3) - 1
        if table.integrated:
            positions = torch.cat([positions, 0.1 * torch.rand(n, 3)], dim=1)
        directions = torch.nn.functional.normalize(torch.randn(n if rays is None else rays, 3), dim=1)
        index = None if rays is None else torch.randint(0, rays, (n,), dtype=torch.int32)
        weights = [torch.randn(k, o, i) / i**0.5 for o, i in table.weight_shapes(positions.shape[1], 3)]
        bias = [index != 1 for index in range(len(weights))]
        biases = [torch.randn(k, weight.shape[1]) for weight, has in zip(weights, bias) if has]
        inputs = [tensor.to(dtype) for tensor in (positions, directions, *weights, *biases)]
        return cls(table, offsets_of(counts), inputs, index, bias)

    def arguments(self, leaves):
        """Returns the samples and the network by name."""
        positions, directions, *parameters = leaves
        biases, seen = iter(parameters[len(self.bias) :]), self.table.uses_directions
        index = self.direction_index if seen else None
        return {
            "positions": positions,
            "weights": parameters[: len(self.bias)],
            "biases": [next(biases) if has else None for has in self.bias],
            "layers": self.table,
            "directions": directions if seen else None,
            "direction_index": None if index is None else index.to(positions.device),
        }

    def run(self, mlp, leaves, **options):
        return mlp(**self.arguments(leaves), offsets=self.offsets.to(leaves[0].device), **options)

    def leaves(self, dtype, device=CPU):
        return [tensor.detach().to(device, dtype).requires_grad_() for tensor in self.inputs]

    def results(self, mlp, dtype, device=CPU, **options):
        leaves = self.leaves(dtype, device)
        y = self.run(mlp, leaves, **options)
        g = torch.randn(y.shape, generator=torch.Generator().manual_seed(1)).to(device, dtype)
        return [y, *torch.autograd.grad(y, leaves, g, allow_unused=True, materialize_grads=True)]

    def penalty(self, mlp, dtype, device=CPU, **options):
        """Returns the gradients of a loss on slopes."""
        leaves = self.leaves(dtype, device)
        (slope,) = torch.autograd.grad(self.run(mlp, leaves, **options).square().sum(), leaves[0], create_graph=True)
        return torch.autograd.grad(slope.square().sum(), leaves, allow_unused=True, materialize_grads=True)


def check(results, op, device, backend, dtype=torch.float32):
    """Compares ``results`` of an op, on a backend, with the definition, a loop over cells."""
    exact, plain = results(loops.grouped_mlp, torch.float64), results(loops.grouped_mlp, dtype)
    for part, same, right in zip(results(op, dtype, device, backend=backend), plain, exact, strict=True):
        assert_as_exact(part, same, right)


# A tile of Warp's kernel has 64 rows.
CELLS = {**COUNTS, "tiles": [65, 0, 63, 64, 128, 0], "many": [1] * 70, "few": [300, *[0] * 40]}
SIZES = [*((name, "odd") for name in TABLES), *((name, size) for name in ("nerf", "tangled") for size in CELLS)]


@pytest.mark.parametrize(("name", "size"), dict.fromkeys(SIZES))
def test_output_and_gradients_match_the_specification(device, backend, name, size):
    check(Case.make(name, CELLS[size]).results, grouped_mlp, device, backend)


@pytest.mark.parametrize("width", [1, 15, 16, 17, 256, 270])
def test_any_width(device, backend, width):
    layers = Layer((POSITIONS,), width, "relu"), Layer((0, POSITIONS), width, "softplus"), Layer((1,), 3, "sine")
    check(Case.make(MLP(layers, (2, 0), position_octaves=2), [70, 3]).results, grouped_mlp, device, backend)


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("name", ["nerf", "spherical", "integrated"])
def test_half_types(device, backend, name, dtype):
    need("grouped_mlp", backend, device, dtype)
    check(Case.make(name, COUNTS["odd"], dtype).results, grouped_mlp, device, backend, dtype)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_of_lower_degrees(device, backend, degree):
    table = replace(TABLES["spherical"], direction_degree=degree)
    check(Case.make(table, COUNTS["odd"]).results, grouped_mlp, device, backend)


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_large_gaussians(device, backend, scale):
    case = Case.make("integrated", COUNTS["odd"])
    case.inputs[0] *= scale  # larger than the range of the vector sine
    case.inputs[0][:3, 3:] = torch.tensor([[0.0], [1e5], [torch.inf]])
    check(case.results, grouped_mlp, device, backend)


@pytest.mark.parametrize("width", [15, 30, 31, 32, 63])
def test_infinity_in_bfloat16_stays_what_it_is(device, backend, width, request):
    """CUDA and Warp pad columns to pairs; the padding times infinity is NaN, which stays in its row."""
    cuda = device.type == "cuda" or request.config.getoption("--emulate-cuda") is not None
    padded = backend == "warp" or (backend == "native" and cuda)
    weights = [torch.ones(1, width, 2, device=device), torch.ones(1, 5, width, device=device)]
    weights[0][:, :, 0] = -1
    table = MLP((Layer((POSITIONS,), width, "relu"), Layer((0,), 5)), (1,))
    x = torch.tensor([[torch.inf, 1.0], [1.0, 3.0]], device=device)
    offsets = torch.tensor([0, 2], dtype=torch.int32, device=device)
    half = [weight.bfloat16() for weight in weights]
    need("grouped_mlp", backend, device, torch.bfloat16)
    result = grouped_mlp(x.bfloat16(), offsets, half, [None, None], layers=table, backend=backend)
    assert result[1].tolist() == [2.0 * width] * 5
    assert result[0].nan_to_num(0.0).tolist() == [0.0] * 5 and (padded or not bool(result.isnan().any()))


def test_wide_positions_with_half_weights_keep_their_octaves(device, backend):
    need("grouped_mlp", backend, device, torch.bfloat16)
    case = Case.make("plain", COUNTS["odd"])
    case.table = MLP(case.table.layers, case.table.outputs, position_octaves=10)
    case.inputs[2] = torch.randn(len(COUNTS["odd"]), 9, 63) / 8
    halves = [case.inputs[0], case.inputs[1], *(tensor.bfloat16() for tensor in case.inputs[2:])]
    exact = case.run(loops.grouped_mlp, [tensor.double() for tensor in halves])
    actual = case.run(grouped_mlp, [tensor.to(device) for tensor in halves], backend=backend)
    assert actual.dtype == torch.bfloat16
    # Positions rounded to bfloat16 before the encoding would give angles wrong by 512 / 256 radians.
    assert error(actual, exact) < 0.02


def test_rows_of_no_cell_are_zero(device, backend):
    case = Case.make("nerf", [4, 4, 4])
    case.offsets = torch.tensor([2, 5, 5, 9], dtype=torch.int32)
    leaves = case.leaves(torch.float32, device)
    y = case.run(grouped_mlp, leaves, backend=backend)
    assert (y[:2] == 0).all() and (y[9:] == 0).all() and (y[2:9] != 0).all()
    y.sum().backward()
    assert (leaves[0].grad[:2] == 0).all() and (leaves[0].grad[9:] == 0).all()
    assert all((leaf.grad[1] == 0).all() for leaf in leaves[2:])


def test_what_is_not_a_number_stays_in_its_cell(device, backend):
    case = Case.make("nerf", [4, 5, 6], rays=None)
    case.inputs[0][6, 1] = torch.nan
    leaves = case.leaves(torch.float32, device)
    y = case.run(grouped_mlp, leaves, backend=backend)
    y.sum().backward()
    others = [row for row in range(15) if row != 6]
    assert y[others].isfinite().all() and not y[6].isfinite().any()
    assert leaves[0].grad[others].isfinite().all() and leaves[1].grad[others].isfinite().all()
    assert all(leaf.grad[[0, 2]].isfinite().all() for leaf in leaves[2:])
    case.inputs[2][1, 0, 1] = torch.inf
    y = case.run(grouped_mlp, case.leaves(torch.float32, device), backend=backend)
    assert y[:4].isfinite().all() and not y[4:9].isfinite().all() and y[9:].isfinite().all()


def test_second_derivatives(device, backend):
    check(Case.make("nerf", [3, 0, 2]).penalty, grouped_mlp, device, backend)


def test_second_derivatives_where_one_input_is_computed_from_another():
    case = Case.make("nerf", [3, 0, 2], torch.float64, rays=None)

    def penalty(mlp):
        positions, _, *parameters = case.leaves(torch.float64)
        y = case.run(mlp, [positions, positions.square(), *parameters])
        (slope,) = torch.autograd.grad(y.sum(), positions, create_graph=True)
        return torch.cat([slope, *torch.autograd.grad(slope.square().sum(), positions)])

    torch.testing.assert_close(penalty(grouped_mlp), penalty(loops.grouped_mlp))


def test_slopes_of_no_samples_by_frozen_networks(device, backend):
    """A loss on normals needs these derivatives of zero samples if a march finds only empty space."""
    case = Case.make("nerf", COUNTS["none"])
    x, *others = [tensor.to(device) for tensor in case.inputs]
    y = case.run(grouped_mlp, [x.requires_grad_(), *others], backend=backend)
    (slope,) = torch.autograd.grad(y.sum(), x, create_graph=True)
    slope.square().sum().backward()
    assert x.grad is None or x.grad.shape == (0, 3)


def test_inputs_without_features_are_refused(device, backend):
    positions, offsets, index = torch.rand(5, 3, device=device), offsets_of([2, 3], device), torch.zeros(5).int()
    table = MLP((Layer((POSITIONS, DIRECTIONS), 4, "relu"), Layer((0,), 2)), (1,), 2, 1)
    message = "grouped_mlp: ... must have at least one feature where a layer reads them, got 0"

    def call(layers, p, q, **changed):
        weights = [torch.rand(2, o, i, device=device) for o, i in layers.weight_shapes(p, q)]
        biases = [None] * len(weights)
        return grouped_mlp(positions[:, :p], offsets, weights, biases, layers=layers, backend=backend, **changed)

    for octaves in (2, None):
        layers = MLP(table.layers, table.outputs, octaves, octaves)
        assert call(layers, 3, 3, directions=positions).shape == (5, 2)
        with refused(ValueError, message.replace("...", "positions")):
            call(layers, 0, 3, directions=positions)
        with refused(ValueError, message.replace("...", "directions")):
            call(layers, 3, 0, directions=positions[:, :0])
        with refused(ValueError, message.replace("...", "directions")):
            call(layers, 3, 0, directions=positions[:4, :0], direction_index=index.to(device))
    # An input that no layer reads may be empty.
    unread = MLP((Layer((DIRECTIONS,), 4, "relu"),), (0,))
    assert call(unread, 0, 3, directions=positions).shape == (5, 4)


def test_errors():
    case = Case.make("nerf", [2, 3])
    good = {**case.arguments(case.inputs), "biases": [None] * 7, "offsets": case.offsets}
    directions, weights, refuses = case.inputs[1], good["weights"], refusals(grouped_mlp, **good)
    refuses("offsets must have at least two entries, got [1]", offsets=case.offsets[:1])
    refuses("positions must have shape [n, p], got [5]", positions=case.inputs[0][:, 0])
    refuses("directions must be given for layers that read them, got None", directions=None, direction_index=None)
    harmonics = MLP((Layer((DIRECTIONS,), 4),), (0,), direction_encoding="spherical", direction_degree=2)
    two = directions[:, :2]
    refuses("directions must have 3 features where they are spherical, got 2", directions=two, layers=harmonics)
    refuses("direction_index must come with directions, got no directions", directions=None, layers=TABLES["plain"])
    refuses("directions must have shape [n, 3] with n = 5, got [4, 3]", directions=directions[:4], direction_index=None)
    refuses("direction_index must have shape [n] with n = 5, got [4]", direction_index=case.direction_index[1:])
    for bad in (-1, 5):
        index = case.direction_index.clone()
        index[3] = bad
        refuses(f"direction_index must be 0 to 4, got {bad}", direction_index=index)
    refuses("weights must have one entry for each of 7 layers, got 6", weights=weights[1:])
    refuses("biases must have one entry for each of 7 layers, got 0", biases=[])
    refuses(
        "weights[2] must have shape [k, 16, 37] with k = 2, got [2, 16, 16]",
        weights=[*weights[:2], weights[1], *weights[3:]],
    )
    refuses(
        "weights[1] must have the dtype of weights[0], float32, got float64",
        weights=[weights[0], *(weight.double() for weight in weights[1:])],
    )
    refuses("biases[0] must have shape [k, 16] with k = 2, got [2, 15]", biases=[torch.zeros(2, 15), *[None] * 6])
    refuses(
        "biases[0] must have the dtype of weights[0], float32, got float16",
        biases=[torch.zeros(2, 16).half(), *[None] * 6],
    )
    refuses("weights[0] must be on the device of offsets, cpu, got meta", weights=[weights[0].to("meta"), *weights[1:]])
