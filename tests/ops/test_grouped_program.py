"""grouped_program: each step against autograd in float64, and random programs against the reference."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
import torch
from helpers import refuses
from torch import Tensor

from voronerf.ops import grouped_program
from voronerf.ops._core import native
from voronerf.ops._core.program import FUNCTIONS, PARAMETER, Builder, Columns, Program, gradient
from voronerf.ops.grouped_program.case import every_step

NUMBERS = {"softplus": (3.0, 20.0), "sine": (1.7, 0.3), "clamp": (-0.5, 0.6), "power": (1.5, 0.0), "affine": (2.0, 1.0)}
SIZES = ([0], [1], [5, 0, 24], [96, 1], [97, 0, 3], [0, 95, 200, 23])


def offsets_of(sizes: list[int]) -> Tensor:
    return torch.tensor([0, *sizes], dtype=torch.int32).cumsum(0).int()


def random_program(seed: int) -> Program:
    """Steps drawn at random, each of values drawn at random."""
    draw, b = random.Random(seed), Builder()
    values = [b.input(draw.choice([1, 3, 16, 33])) for _ in range(draw.randint(1, 3))]
    smooth = ["softplus", "sigmoid", "tanh", "silu", "gelu", "sine", "elu", "copy"]
    for _ in range(draw.randint(4, 14)):
        x = draw.choice(values)
        kind = draw.choice(["linear", "function", "binary", "total", "move", "vector"])
        if kind == "linear":
            width = draw.choice([1, 4, 17, 64, 70])
            bias = Columns(PARAMETER, b.parameter(width), 0, width) if draw.random() < 0.5 else None
            values.append(b.linear(x, b.parameter(width, x.width), width, add=bias))
        elif kind == "function":
            name = draw.choice(smooth)
            values.append(b.apply(name, x, *NUMBERS.get(name, (0.7, 0.0))))
        elif kind == "binary":
            same = [v for v in values if v.width == x.width]
            values.append(b.binary(draw.choice(["add", "sub", "mul"]), x, draw.choice(same)))
        elif kind == "vector":
            values.append(b.binary("mul", x, Columns(PARAMETER, b.parameter(x.width), 0, x.width)))
        elif kind == "total":
            values.append(b.total(x, x.width))
        else:
            y, start = draw.choice(values), draw.randrange(x.width)
            parts = [(x.part(start, x.width - start), 0), (y, x.width - start)]
            values.append(b.move(x.width - start + y.width, parts))
    return b.program(values[-2:])


def arguments(
    program: Program, sizes: list[int], dtype: torch.dtype, shared: bool = False
) -> tuple[list, list, Tensor]:
    generator = torch.Generator().manual_seed(3)
    k, n = len(sizes), sum(sizes)
    rows = [torch.randn(n, w, generator=generator, dtype=torch.float64) for w in program.inputs]
    parameters = []
    for i, shape in enumerate(program.parameters):
        few = 1 if shared and i % 2 == 0 else k
        p = torch.randn(few, *shape, generator=generator, dtype=torch.float64) / shape[-1] ** 0.5
        parameters.append(p)
    return [x.to(dtype) for x in rows], [p.to(dtype) for p in parameters], offsets_of(sizes)


def derivatives(program: Program, rows: list, parameters: list, offsets: Tensor, backend: str, order=None) -> list:
    """Results, their gradients, and the gradients of a function of those."""
    leaves = [t.clone().requires_grad_() for t in (*rows, *parameters)]
    given = leaves[: len(rows)], leaves[len(rows) :]
    results = grouped_program(*given, offsets, program=program, order=order, backend=backend)
    generator = torch.Generator().manual_seed(5)

    def weighted(tensors: list) -> Tensor:
        parts = []
        for t in tensors:
            weights = torch.randn(t.shape, generator=generator, dtype=torch.float64).to(t.dtype)
            if t.requires_grad:
                parts.append((t * weights).sum())
        return torch.stack(parts).sum() if parts else 0 * leaves[0].sum()

    firsts = torch.autograd.grad(
        weighted(results), leaves, create_graph=True, allow_unused=True, materialize_grads=True
    )
    seconds = torch.autograd.grad(weighted(firsts), leaves, allow_unused=True, materialize_grads=True)
    return [t.detach() for t in (*results, *firsts, *seconds)]


def check(program: Program, sizes: list[int], shared: bool = False, order: Tensor | None = None) -> None:
    """Native against the reference in float64, relative to what the reference in float32 reaches."""
    wide = derivatives(program, *arguments(program, sizes, torch.float64, shared), "reference", order)
    narrow = derivatives(program, *arguments(program, sizes, torch.float32, shared), "reference", order)
    native = derivatives(program, *arguments(program, sizes, torch.float32, shared), "native", order)
    for exact, other, ours in zip(wide, narrow, native, strict=True):
        assert ours.shape == exact.shape
        if exact.numel():
            size = float(exact.abs().max())
            allowed = 2 * float((other - exact).abs().max()) + 4e-6 * size + 1e-6
            assert float((ours - exact).abs().max()) <= allowed


@pytest.mark.parametrize(
    ("name", "order"),
    [(name, i) for name, f in FUNCTIONS.items() if name != "stop" for i in range(min(f.orders, 3) + 1)],
)
def test_derivative_of_every_function(name: str, order: int) -> None:
    """Each line of functions_tile.h against autograd of the formula."""
    b = Builder()
    x = b.input(19)
    found = b.function(name, x, *NUMBERS.get(name, (0.7, 0.0)), order=order)
    assert found is not None
    program = b.program([found])
    generator = torch.Generator().manual_seed(1)
    rows = 3 * torch.randn(101, 19, generator=generator, dtype=torch.float64)
    rows = rows.abs() + 0.1 if name in ("log", "power") else rows
    offsets = offsets_of([40, 61])
    (exact,) = grouped_program([rows], [], offsets, program=program, backend="reference")
    (ours,) = grouped_program([rows.float()], [], offsets, program=program, backend="native")
    torch.testing.assert_close(ours.double(), exact, rtol=3e-6, atol=3e-6 * max(1.0, float(exact.abs().max())))


FAR = [*(sign * 10.0**size for size in (-30, -3, 0, 1, 1.5, 2, 3, 10, 19, 30, 38) for sign in (-1, 1)), 0.0, 88.5]


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize(
    "name", ["exp", "sigmoid", "tanh", "silu", "gelu", "softplus", "elu", "clamp", "relu", "abs", "erf", "atan"]
)
def test_derivatives_far_away_and_at_borders(name: str, order: int) -> None:
    """Of arguments as large as they come, at 0, and where a function has its kinks."""
    b = Builder()
    found = b.function(name, b.input(1), *{"clamp": (-1.0, 10.0)}.get(name, (1.0, 20.0)), order=order)
    if found is None:
        return
    rows = torch.tensor([*FAR, float("nan")] if name == "clamp" else FAR)[:, None]
    given = [], offsets_of([len(rows)])
    (exact,) = grouped_program([rows.double()], *given, program=b.program([found]), backend="reference")
    for isa in native.SUPPORTED_ISAS:
        with native.using_isa(isa):
            (ours,) = grouped_program([rows], *given, program=b.program([found]), backend="native")
        torch.testing.assert_close(ours, exact.float(), rtol=2e-5, atol=3e-7, equal_nan=True)


@pytest.mark.parametrize("isa", native.SUPPORTED_ISAS)
@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_columns_do_not_touch_each_other(name: str, isa: str) -> None:
    """A column's bits are the same whatever stands beside it, as old floats stand behind the last one."""
    b = Builder()
    program = b.program([b.apply(name, b.input(5), *NUMBERS.get(name, (0.7, 0.0)))])
    rows = 3 * torch.randn(64, 5, generator=torch.Generator().manual_seed(0))
    found = []
    for odd in (1.0, 1e5, 1e30, torch.nan):
        rows[:, 4] = odd
        with native.using_isa(isa):
            (result,) = grouped_program([rows], [], offsets_of([64]), program=program, backend="native")
        found.append(result[:, :4].clone())
    for others in found[1:]:
        torch.testing.assert_close(others, found[0], rtol=0, atol=0, equal_nan=True)


def test_sums_spread_over_a_layer_and_products_with_relu() -> None:
    """Operands that a layer and a merged ReLU once left out."""
    b = Builder()
    x, y = b.input(5), b.input(7)
    one = b.total(x, 5)._replace(width=7, spread=True)
    h = b.linear(x, b.parameter(7, 5), 7, add=one)
    gated = b.function("relu", b.linear(x, b.parameter(7, 5), 7), times=y)
    assert gated is not None
    check(b.program([h, gated]), [97, 0, 30])


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize("power", [0.3, -1.25, 2.4, 1 / 3, 5.0, -3.5, 70.0])
def test_powers(power: float, order: int) -> None:
    """Whole, half and any other ones, of positive numbers, 0 and negative ones."""
    b = Builder()
    found = b.function("power", b.input(1), power, order=order)
    assert found is not None
    rows = torch.tensor([0.001, 0.3, 1.0, 1.5, 2.7, 0.0, -1.5])[:, None]
    given = [], offsets_of([len(rows)])
    (exact,) = grouped_program([rows.double()], *given, program=b.program([found]), backend="reference")
    for isa in native.SUPPORTED_ISAS:
        with native.using_isa(isa):
            (ours,) = grouped_program([rows], *given, program=b.program([found]), backend="native")
        torch.testing.assert_close(ours, exact.float(), rtol=2e-5, atol=3e-7, equal_nan=True)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("shared", [False, True])
def test_every_step(sizes: list[int], shared: bool) -> None:
    """Values, gradients and their gradients, for cells of all sizes."""
    check(every_step(), sizes, shared)


@pytest.mark.parametrize("seed", range(40))
def test_random_programs(seed: int) -> None:
    """Values, gradients and their gradients of programs that nobody has thought of."""
    check(random_program(seed), [97, 0, 30])


@pytest.mark.parametrize("order_of", [1, 2])
@pytest.mark.parametrize("seed", range(12))
def test_gradient_program_against_autograd(seed: int, order_of: int) -> None:
    """The program of a gradient, run in PyTorch, against autograd of the program; twice, too."""
    program = every_step() if seed == 0 else random_program(100 + seed)
    rows, parameters, offsets = arguments(program, [9, 0, 6], torch.float64)
    for _ in range(order_of):
        asked = (True,) * len(rows), (True,) * len(parameters)
        arriving = (True,) * len(program.outputs), (True,) * len(program.sums)
        leaves = [t.clone().requires_grad_() for t in (*rows, *parameters)]
        results = grouped_program(leaves[: len(rows)], leaves[len(rows) :], offsets, program=program)
        gradients = [torch.randn_like(t) for t in results]
        used = [(r, g) for r, g in zip(results, gradients) if r.requires_grad]
        expected = torch.autograd.grad(
            [r for r, _ in used], leaves, [g for _, g in used], allow_unused=True, materialize_grads=True
        )
        split = len(program.outputs)
        program = gradient(program, *asked, *arriving)
        rows, parameters = [*rows, *gradients[:split]], [*parameters, *gradients[split:]]
        found = grouped_program(rows, parameters, offsets, program=program, backend="reference")
        for ours, exact in zip(found, expected, strict=True):
            torch.testing.assert_close(ours, exact, rtol=1e-9, atol=1e-9)


def test_order_strays_and_layouts() -> None:
    """Rows anywhere, rows of no cell, and inputs that are not contiguous."""
    program = every_step()
    sizes = [30, 0, 71]
    check(program, sizes, order=torch.randperm(101, generator=torch.Generator().manual_seed(0)).int())
    rows, parameters, offsets = arguments(program, sizes, torch.float32)
    strays = torch.tensor([2, 40, 40, 90], dtype=torch.int32)
    both = [grouped_program(rows, parameters, strays, program=program, backend=b) for b in ("native", "reference")]
    for ours, theirs in zip(*both):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
        assert not ours[:2].any() and not ours[90:].any()
    turned = [x.t().contiguous().t() for x in rows]
    for order in (None, torch.randperm(101, generator=torch.Generator().manual_seed(0)).int()):
        given = {"program": program, "order": order, "backend": "native"}
        for ours, theirs in zip(*(grouped_program(r, parameters, offsets, **given) for r in (turned, rows))):
            assert torch.equal(ours, theirs)


@pytest.mark.parametrize("isa", native.SUPPORTED_ISAS)
def test_instruction_sets(isa: str) -> None:
    """Every instruction set of this machine."""
    program = every_step()
    with native.using_isa(isa):
        check(program, [97, 0, 30])
        check(random_program(7), [97, 0, 30])


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_types(dtype: torch.dtype) -> None:
    """By conversion: what float32 gives for the rounded arguments."""
    program = random_program(3)
    rows, parameters, offsets = arguments(program, [40, 9], dtype)
    wide = [[t.float() for t in part] for part in (rows, parameters)]
    for ours, exact in zip(
        grouped_program(rows, parameters, offsets, program=program), grouped_program(*wide, offsets, program=program)
    ):
        assert torch.equal(ours, exact.to(dtype))


def test_refuses_what_is_no_program() -> None:
    """The other rules are in the op's case."""
    with pytest.raises(TypeError, match="grouped_program: program must be a Program, got str"):
        grouped_program([torch.ones(2, 2)], [], offsets_of([2]), program="x")  # type: ignore[arg-type]
    rows, parameters, _ = arguments(every_step(), [6], torch.float32)
    for offsets in ([0, 7], [0, 3, 2], [-1, 6]):
        for backend in ("native", "reference"):
            with pytest.raises(ValueError, match="grouped_program: offsets must rise from 0 or more to at most"):
                given = torch.tensor(offsets, dtype=torch.int32)
                grouped_program(rows, [p[:1] for p in parameters], given, program=every_step(), backend=backend)


@pytest.mark.parametrize("backend", ["reference", "native"])
@pytest.mark.parametrize("wrong", [4, -1, 2**31 - 1, -(2**31)])
def test_an_order_that_leaves_the_rows_is_refused(backend, wrong):
    b = Builder()
    program = b.program([b.apply("exp", b.input(2))])
    order = torch.tensor([3, 1, wrong, 0], dtype=torch.int32)
    given = [torch.rand(4, 2)], [], torch.tensor([0, 1, 3], dtype=torch.int32)
    message = f"grouped_program: order must lie in 0 to 3, got values from {min(0, wrong)} to {max(3, wrong)}"
    refuses(message, grouped_program, *given, program=program, order=order, backend=backend)


def test_a_program_of_what_is_not_there_is_refused():
    """The compiled module trusts a program: each number of one, larger than it is, is refused where it is made."""
    program = every_step()

    def larger(value):
        if isinstance(value, tuple):
            for place, part in enumerate(value):
                for other in larger(part):
                    changed = (*value[:place], other, *value[place + 1 :])
                    yield type(value)(*changed) if hasattr(value, "_fields") else changed
        elif type(value) is int:
            yield from (value + 100, -1, 2**31, 10**30)

    taken = 0
    for name in ("inputs", "parameters", "outputs", "steps"):
        for other in larger(getattr(program, name)):
            try:
                replace(program, **{name: other})
                taken += 1
            except ValueError as error:
                assert str(error).startswith("Program: ") and "\n" not in str(error)
    assert taken == 4  # parameters with more entries than are read, and two steps with more columns, which are 0
