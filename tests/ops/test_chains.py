"""Programs on Warp: its kernel runs chains of layers, and PyTorch runs later steps and all other programs."""

from __future__ import annotations

import pytest
import torch
from op_cases import offsets_of
from test_grouped_mlp import TABLES

from voronerf.ops import grouped_program
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops._core.program import PARAMETER, Builder, Columns

pytest.importorskip("warp")
from voronerf.kernels.network import chain_of  # imports Warp

GRID = HashGrid(levels=2, features=2, log2_entries=10, finest=20)
KINDS = {
    **TABLES,
    "hash": MLP((Layer((POSITIONS,), 8, "relu"), Layer((0, DIRECTIONS), 3)), (1,), None, 2, "hash", GRID),
    "gaussians": MLP((Layer((POSITIONS,), 8, "relu"), Layer((0,), 4)), (1,), 2, None, "integrated"),
}


def with_activations(table, biased, ray):
    """Returns the program of a layer table, with halved outputs and a second result of two columns.

    With t, the tanh of the table's first output, the columns of the second result are t squared and t.
    """
    inner = table.program(6 if table.integrated else 3, 3 if table.uses_directions else 0, None, biased, ray)
    b = Builder()
    inputs = {i: b.input(width, ray=i in inner.rays) for i, width in enumerate(inner.inputs)}
    (raw,) = b.replay(inner, inputs)
    first = b.apply("tanh", raw.part(0, 1))
    return b.program([b.apply("affine", raw, 0.5), b.move(2, [(first, 1), (b.binary("mul", first, first), 0)])])


def call_of(name, shared, ray):
    table = KINDS[name]
    shapes = table.weight_shapes(6 if table.integrated else 3, 3)
    biased = tuple(number != 1 for number in range(len(shapes)))
    program = with_activations(table, biased, ray and table.uses_directions)
    generator = torch.Generator().manual_seed(0)
    inputs = [torch.rand(5 if i in program.rays else 40, w, generator=generator) for i, w in enumerate(program.inputs)]
    if len(inputs) > 1:
        inputs[1] = torch.nn.functional.normalize(inputs[1], dim=-1)
    parameters = [torch.randn(1 if shared else 3, *shape, generator=generator) / 3 for shape in program.parameters]
    index = torch.randint(0, 5, (40,), generator=generator).int() if program.rays else None
    return program, [x.requires_grad_() for x in (*inputs, *parameters)], len(inputs), index


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(("shared", "ray", "ordered"), [(False, True, True), (True, False, False)])
def test_chains_are_those_of_the_reference(name, shared, ray, ordered):
    program, tensors, count, index = call_of(name, shared, ray)
    assert chain_of(program.text) is not None
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1)).int() if ordered else None
    offsets = offsets_of([11, 0, 25]) + 2  # two rows before the cells and two after them
    outcomes = []
    for backend in ("warp", "reference"):
        arguments = {"program": program, "order": order, "ray_index": index, "backend": backend}
        results = grouped_program(tensors[:count], tensors[count:], offsets, **arguments)
        total = sum(result.square().sum() for result in results)
        outcomes.append([*results, *torch.autograd.grad(total, tensors, materialize_grads=True, allow_unused=True)])
    for a, b in zip(*outcomes, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "change",
    [
        lambda b, x, m, n: b.linear(b.apply("tanh", b.linear(x, m, 4)), n, 2),
        lambda b, x, m, n: b.linear(b.linear(x.part(0, 2), m, 4), n, 2),
        lambda b, x, m, n: b.linear(b.linear(x, m, 4).part(1, 2), n, 2),
        lambda b, x, m, n: b.linear(b.linear(x, m, 4), n, 2, add=b.linear(b.linear(x, m, 4), n, 2)),
        lambda b, x, m, n: b.linear(b.linear(b.linear(x, m, 4), m, 3, transposed=True), m, 4),
        lambda b, x, m, n: b.linear(b.linear(x, m, 4), b.parameter(2, 5), 2),
        lambda b, x, m, n: b.binary("mul", b.linear(x, m, 4), Columns(PARAMETER, b.parameter(4), 0, 4)),
        lambda b, x, m, n: b.encode("frequency", b.linear(x, m, 4), 1),
        lambda b, x, m, n: b.linear(b.encode("frequency", b.encode("frequency", x, 1), 1), b.parameter(2, 27), 2),
        lambda b, x, m, n: b.binary("mul", b.linear(x, m, 4).part(0, 3), x),
        lambda b, x, m, n: b.linear(b.encode("frequency", x, 1), b.parameter(4, 9), 4, add=b.linear(x, m, 4)),
    ],
)
def test_what_is_no_chain_runs_all_the_same(change):
    b = Builder()
    out = change(b, b.input(3), b.parameter(4, 3), b.parameter(2, 4))
    program = b.program([out])
    assert chain_of(program.text) is None
    inputs, parameters = [torch.rand(6, 3)], [torch.randn(2, *shape) for shape in program.parameters]
    both = [
        grouped_program(inputs, parameters, offsets_of([2, 4]), program=program, backend=backend)[0]
        for backend in ("warp", "reference")
    ]
    torch.testing.assert_close(*both)


def test_positions_of_rays_are_no_chain():
    b = Builder()
    program = b.program([b.linear(b.input(3, ray=True), b.parameter(2, 3), 2)])
    rays, weight, index = torch.rand(2, 3), torch.randn(1, 2, 3), torch.tensor([1, 0, 1, 1, 0]).int()
    arguments = {"program": program, "ray_index": index, "backend": "warp"}
    (out,) = grouped_program([rays], [weight], offsets_of([5]), **arguments)
    torch.testing.assert_close(out, rays[index] @ weight[0].T)


def test_an_activation_of_a_part_of_a_layer():
    """An activation of only some columns of a layer is a separate step after the layers."""
    b = Builder()
    raw = b.linear(b.input(3), b.parameter(4, 3), 4)
    program = b.program([b.apply("sigmoid", raw.part(2, 2))])
    assert chain_of(program.text).layers.layers[0].activation == "none"
    x, weight = torch.rand(6, 3) - 0.5, torch.randn(1, 4, 3)
    (out,) = grouped_program([x], [weight], offsets_of([6]), program=program, backend="warp")
    torch.testing.assert_close(out, (x @ weight[0].T)[:, 2:].sigmoid())


def test_an_output_that_a_layer_reads_is_kept_before_its_activation():
    """The activation is a separate step if another step reads the value before it."""
    b = Builder()
    raw = b.linear(b.input(3), b.parameter(4, 3), 4)
    program = b.program([b.apply("relu", raw), raw])
    chain = chain_of(program.text)
    assert chain is not None and chain.layers.layers[0].activation == "none"
    x, weight = torch.rand(6, 3) - 0.5, torch.randn(1, 4, 3)
    bent, plain = grouped_program([x], [weight], offsets_of([6]), program=program, backend="warp")
    torch.testing.assert_close(plain, x @ weight[0].T)
    torch.testing.assert_close(bent, plain.relu())
