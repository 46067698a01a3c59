"""Programs on Warp: its kernels run layers, and PyTorch runs the other steps."""

from __future__ import annotations

import functools

import pytest
import torch
from op_cases import offsets_of
from test_grouped_mlp import TABLES
from test_grouped_program import check, random_program

from voronerf.ops import grouped_program
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops._core.program import PARAMETER, Builder, Columns, Program, pruned

pytest.importorskip("warp")
from voronerf import kernels
from voronerf.kernels.network import lower  # imports Warp

GRID = HashGrid(levels=2, features=2, log2_entries=10, finest=20)
HASHED = MLP((Layer((POSITIONS,), 8, "relu"), Layer((0, DIRECTIONS), 3)), (1,), None, 2, "hash", GRID)


def layers_of(program):
    """Returns the number of layers of each run of the kernel, and the number of linear steps that PyTorch runs."""
    counts, text = [], program.text
    while (parts := lower(text)) is not None:
        counts.append(len(parts.layers))
        text = parts.after.text
    return counts, sum(step.op == "linear" for step in Program.parse(text).steps)


@pytest.mark.parametrize("table", [*TABLES.values(), HASHED], ids=[*TABLES, "hash"])
@pytest.mark.parametrize("ray", [True, False])
def test_networks_run_in_the_kernel_at_once(table, ray):
    biased = tuple(layer != 1 for layer in range(len(table.layers)))
    widths = 6 if table.integrated else 3, 3 * table.uses_directions
    (_,), left = layers_of(table.program(*widths, None, biased, ray and table.uses_directions))
    assert left == 0


def vector(b, start, width, spread=False):
    return Columns(PARAMETER, b.parameter(50), start, width, spread)


# A function (builder, input [n, 3], layer [n, 40], index of a matrix [2, 40]) -> output, then the numbers of layers_of.
CASES = {
    "another activation": (lambda b, x, h, m: b.linear(b.apply("tanh", h), m, 2), [1, 1], 0),
    "another softplus": (lambda b, x, h, m: b.linear(b.apply("softplus", h, 2.0, 20.0), m, 2), [1, 1], 0),
    "a scaled activation": (lambda b, x, h, m: b.linear(b.function("relu", h, times=h), m, 2), [1, 1], 0),
    "features": (lambda b, x, h, m: b.linear(h.part(13, 20), m, 2, add=b.linear(x.part(1, 2), m, 2, 20)), [2], 0),
    "activated features": (lambda b, x, h, m: b.linear(b.apply("sigmoid", h.part(3, 30)).part(11, 18), m, 2), [2], 0),
    "a layer and its activation": (
        lambda b, x, h, m: b.linear(h, m, 2, add=b.linear(b.apply("relu", h), m, 2)),
        [2],
        0,
    ),
    "an output and its activation": (lambda b, x, h, m: b.move(80, [(h, 0), (b.apply("relu", h), 40)]), [1], 0),
    "an activation as an output": (lambda b, x, h, m: b.apply("sigmoid", h.part(2, 2)), [1], 0),
    "spread": (lambda b, x, h, m: b.linear(b.apply("relu", h._replace(width=9, spread=True)), m, 2), [1, 1], 0),
    "a transposed matrix": (lambda b, x, h, m: b.linear(b.linear(h, m, 2), m, 17, 20, transposed=True), [3], 0),
    "a sum of layers": (lambda b, x, h, m: b.linear(b.binary("add", h, b.linear(x, 0, 40)), m, 2), [2], 0),
    "a late bias": (lambda b, x, h, m: b.linear(b.binary("add", h, vector(b, 7, 40)), m, 2), [2], 0),
    "a broadcast bias": (lambda b, x, h, m: b.linear(b.binary("add", h, vector(b, 7, 40, True)), m, 2), [1, 1], 0),
    "a factor": (lambda b, x, h, m: b.binary("mul", h, vector(b, 0, 40)), [1], 0),
    "a product with an input": (lambda b, x, h, m: b.binary("mul", h.part(0, 3), x), [1], 0),
    "a function of an input": (lambda b, x, h, m: b.linear(b.apply("tanh", x), m, 2), [1], 0),
    "an encoded layer": (lambda b, x, h, m: b.linear(b.encode("frequency", h.part(0, 2), 1), m, 2), [1, 1], 0),
    "encodings": (lambda b, x, h, m: b.linear(b.encode("frequency", b.encode("frequency", x, 1), 1), m, 2), [1], 0),
    "a slope": (lambda b, x, h, m: b.linear(b.encode("frequency", x, 1, along=[x]), m, 2), [1], 0),
    "an addend that is no layer": (lambda b, x, h, m: b.linear(b.linear(h, m, 2, add=x.part(0, 2)), m, 2), [1], 2),
    "a fused activation": (lambda b, x, h, m: b.emit("linear", 2, [h], (m, 0, 0), "relu"), [1], 1),
    "no layer": (lambda b, x, h, m: b.apply("relu", x), [], 0),
}


@pytest.mark.parametrize("name", CASES)
def test_which_layers_run_in_the_kernel(name):
    b, (output, counts, left) = Builder(), CASES[name]
    x, matrices = b.input(3), (b.parameter(40, 3), b.parameter(2, 40))
    h = b.linear(x, matrices[0], 40, add=vector(b, 5, 40))
    program = pruned(b.program([output(b, x, h, matrices[1])]))
    assert layers_of(program) == (counts, left)
    check(program, [67, 0, 3], backend="warp")


@pytest.mark.parametrize("seed", range(16))
def test_random_programs(seed):
    check(random_program(seed), [67, 0, 3], shared=seed % 2 == 0, backend="warp")


def test_inputs_and_outputs_of_rays():
    b = Builder()
    y = b.linear(b.input(3, ray=True), b.parameter(2, 3), 2)
    rays, weight, index = torch.rand(2, 3), torch.randn(1, 2, 3), torch.tensor([1, 0, 1, 1, 0]).int()
    arguments = {"program": b.program([y, y], by_ray=[1]), "ray_index": index, "backend": "warp"}
    samples, sums = grouped_program([rays], [weight], offsets_of([5]), **arguments)
    torch.testing.assert_close(samples, rays[index] @ weight[0].T)
    torch.testing.assert_close(sums, torch.tensor([[2.0], [3.0]]) * (rays @ weight[0].T))


def test_several_runs_of_the_kernel_compile():
    b = Builder()
    h = b.apply("tanh", b.linear(b.input(3), b.parameter(4, 3), 4))
    program, offsets = b.program([b.linear(h, b.parameter(2, 4), 2)]), offsets_of([3, 2])
    parameters = [torch.randn(2, *shape) for shape in program.parameters]
    run = functools.partial(grouped_program, parameters=parameters, offsets=offsets, program=program, backend="warp")
    compiled = torch.compile(run, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled([x := torch.rand(5, 3)]), run([x]))


def test_what_a_step_needs_is_loaded_before_it():
    loads = kernels.loads(torch.device("cpu"), torch.float32)
    assert len(loads) == 10
    for load in loads:
        load()
