"""`grouped_program`: each step against autograd in float64, and random programs against the reference."""

from __future__ import annotations

import ctypes
import mmap
import random
import sys
from dataclasses import replace

import pytest
import torch
from cases.grouped_program import GRID, encoded, every_step
from helpers import refuses
from programs import ByPrograms
from programs import derivatives as of_every_order
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from voronerf.ops import grouped_program, hash_encode
from voronerf.ops._core import native
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.program import FUNCTIONS, PARAMETER, VALUE, Builder, Columns, Program, Step, gradient
from voronerf.ops._core.tolerances import agree
from voronerf.ops.network import native as plans
from voronerf.ops.network.reference import cells_of

NUMBERS = {"softplus": (3.0, 20.0), "sine": (1.7, 0.3), "clamp": (-0.5, 0.6), "power": (1.5, 0.0), "affine": (2.0, 1.0)}
NUMBERS["hardtanh"] = NUMBERS["clamp"]
SIZES = ([0], [1], [5, 0, 24], [96, 1], [97, 0, 3], [0, 95, 200, 23])


def offsets_of(sizes: list[int]) -> Tensor:
    return torch.tensor([0, *sizes], dtype=torch.int32).cumsum(0).int()


def random_program(seed: int) -> Program:
    """Returns a program of random steps on random operands."""
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
    """Returns the results, their gradients, and the gradients of a weighted sum of these gradients."""
    arguments = {"offsets": offsets, "program": program, "order": order, "backend": backend}

    def run(*leaves: Tensor) -> list[Tensor]:
        return grouped_program(leaves[: len(rows)], leaves[len(rows) :], **arguments)

    return of_every_order(run, [*rows, *parameters], 2)


def check(
    program: Program, sizes: list[int], shared: bool = False, order: Tensor | None = None, backend: str = "native"
) -> None:
    """Compares a backend with the float64 reference; allows twice the error of the float32 reference."""
    wide = derivatives(program, *arguments(program, sizes, torch.float64, shared), "reference", order)
    narrow = derivatives(program, *arguments(program, sizes, torch.float32, shared), "reference", order)
    actual = derivatives(program, *arguments(program, sizes, torch.float32, shared), backend, order)
    for exact, other, ours in zip(wide, narrow, actual, strict=True):
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
    """Each derivative in functions_tile.h equals autograd of the function's formula."""
    b = Builder()
    x = b.input(19)
    columns = b.function(name, x, *NUMBERS.get(name, (0.7, 0.0)), order=order)
    assert columns is not None
    program = b.program([columns])
    generator = torch.Generator().manual_seed(1)
    rows = 3 * torch.randn(101, 19, generator=generator, dtype=torch.float64)
    rows = rows.abs() + 0.1 if name in ("log", "log1p", "power") else rows
    offsets = offsets_of([40, 61])
    (exact,) = grouped_program([rows], [], offsets, program=program, backend="reference")
    (ours,) = grouped_program([rows.float()], [], offsets, program=program, backend="native")
    torch.testing.assert_close(ours.double(), exact, rtol=3e-6, atol=3e-6 * max(1.0, float(exact.abs().max())))


@pytest.mark.parametrize("width", [2, 6, 16, 34, 80])
def test_integrated_encoding_of_any_width(width: int) -> None:
    b = Builder()
    x = b.input(width)
    program = b.program([b.encode("integrated", x, 3), b.linear(x, b.parameter(5, width), 5)])
    for isa in native.SUPPORTED_ISAS:
        with native.using_isa(isa):
            check(program, [40, 0, 23])


FAR = [*(sign * 10.0**size for size in (-30, -3, 0, 1, 1.5, 2, 3, 10, 19, 30, 38) for sign in (-1, 1)), 0.0, 88.5]
SPECIAL = [
    *((name, (1.0, 20.0), FAR) for name in ("exp", "sigmoid", "tanh", "silu", "gelu", "softplus", "elu")),
    *((name, (1.0, 20.0), FAR) for name in ("relu", "abs", "erf", "atan")),
    *((name, (-1.0, 10.0), [*FAR, float("nan")]) for name in ("clamp", "hardtanh")),
    ("expm1", (0.0, 0.0), [x for x in FAR if x < 80]),
    ("log1p", (0.0, 0.0), [*(x for x in FAR if x > -1), 1e-7, -1e-7, float("inf")]),
    *(("power", (p,), [0.001, 0.3, 1.0, 1.5, 2.7, 0.0, -1.5]) for p in (0.3, -1.25, 2.4, 1 / 3, 5.0, -3.5, 70.0)),
]
"""Functions, their numbers, and arguments: very small and very large ones, 0, and the places of kinks. Powers may be
integer, half-integer or others; their arguments are positive and negative numbers."""


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize(("name", "numbers", "values"), SPECIAL)
def test_derivatives_of_special_numbers(name: str, numbers: tuple[float, ...], values: list, order: int) -> None:
    b = Builder()
    columns = b.function(name, b.input(1), *numbers, order=order)
    if columns is None:
        assert name != "power"
        return
    rows, program = torch.tensor(values)[:, None], b.program([columns])
    arguments = [], offsets_of([len(rows)])
    (exact,) = grouped_program([rows.double()], *arguments, program=program, backend="reference")
    for isa in native.SUPPORTED_ISAS:
        with native.using_isa(isa):
            (ours,) = grouped_program([rows], *arguments, program=program, backend="native")
        torch.testing.assert_close(ours, exact.float(), rtol=2e-5, atol=3e-7, equal_nan=True)


@pytest.mark.parametrize("isa", native.SUPPORTED_ISAS)
@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_columns_do_not_touch_each_other(name: str, isa: str) -> None:
    """The bits of a column do not depend on other columns, nor on stale floats after the last column."""
    b = Builder()
    program = b.program([b.apply(name, b.input(5), *NUMBERS.get(name, (0.7, 0.0)))])
    rows = 3 * torch.randn(64, 5, generator=torch.Generator().manual_seed(0))
    results = []
    for odd in (1.0, 1e5, 1e30, torch.nan):
        rows[:, 4] = odd
        with native.using_isa(isa):
            (result,) = grouped_program([rows], [], offsets_of([64]), program=program, backend="native")
        results.append(result[:, :4].clone())
    for others in results[1:]:
        torch.testing.assert_close(others, results[0], rtol=0, atol=0, equal_nan=True)


def test_sums_spread_over_a_layer_and_products_with_relu() -> None:
    """A layer adds a sum broadcast to all columns; the ReLU of a layer is multiplied by an input."""
    b = Builder()
    x, y = b.input(5), b.input(7)
    one = b.total(x, 5)._replace(width=7, spread=True)
    h = b.linear(x, b.parameter(7, 5), 7, add=one)
    gated = b.function("relu", b.linear(x, b.parameter(7, 5), 7), times=y)
    assert gated is not None
    check(b.program([h, gated]), [97, 0, 30])


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("shared", [False, True])
def test_every_step(sizes: list[int], shared: bool) -> None:
    """Values, gradients and second derivatives are correct for cells of all sizes."""
    check(every_step(), sizes, shared)


@pytest.mark.parametrize("seed", range(24))
def test_random_programs(seed: int) -> None:
    """Values, gradients and second derivatives of random programs are correct."""
    check(random_program(seed), [97, 0, 30])


@pytest.mark.parametrize("order_of", [1, 2])
@pytest.mark.parametrize("seed", range(12))
def test_gradient_program_against_autograd(seed: int, order_of: int) -> None:
    """The gradient program equals autograd of the program; the same holds for the gradient program's own gradient."""
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
        actual = grouped_program(rows, parameters, offsets, program=program, backend="reference")
        for ours, exact in zip(actual, expected, strict=True):
            torch.testing.assert_close(ours, exact, rtol=1e-9, atol=1e-9)


def test_order_strays_and_layouts() -> None:
    """Results are correct for rows in any order, rows of no cell, and inputs that are not contiguous."""
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
        options = {"program": program, "order": order, "backend": "native"}
        for ours, theirs in zip(*(grouped_program(r, parameters, offsets, **options) for r in (turned, rows))):
            assert torch.equal(ours, theirs)


@pytest.mark.parametrize("isa", native.SUPPORTED_ISAS)
def test_instruction_sets(isa: str) -> None:
    """Results are correct with every instruction set of this machine."""
    program = every_step()
    with native.using_isa(isa):
        check(program, [97, 0, 30])
        check(random_program(7), [97, 0, 30])


@pytest.mark.parametrize("backend", ["reference", "native"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("width", [1, 2, 33])
def test_one_column_in_the_place_of_all_is_put_out(width: int, dtype: torch.dtype, backend: str) -> None:
    """A column marked `spread` is broadcast to all columns: in an output, and in the gradient of a sum over columns."""
    b = Builder()
    x = b.input(width)
    program = b.program([x.part(width - 1, 1)._replace(width=width, spread=True), b.total(x, width)])
    rows = torch.rand(60, width).to(dtype).requires_grad_()
    spread, total = grouped_program([rows], [], offsets_of([7, 53]), program=program, backend=backend)
    assert torch.equal(spread, rows[:, -1:].expand(-1, width))
    torch.testing.assert_close(total, rows.sum(1, keepdim=True))
    weight = torch.rand(60, 1).to(dtype)
    (slope,) = torch.autograd.grad(total, rows, weight)
    assert torch.equal(slope, weight.expand(-1, width))


@pytest.mark.parametrize("backend", ["reference", "native"])
@pytest.mark.parametrize("wrong", [4, -1, 2**31 - 1, -(2**31)])
def test_an_order_that_leaves_the_rows_is_refused(backend, wrong):
    b = Builder()
    program = b.program([b.apply("exp", b.input(2))])
    order = torch.tensor([3, 1, wrong, 0], dtype=torch.int32)
    arguments = [torch.rand(4, 2)], [], torch.tensor([0, 1, 3], dtype=torch.int32)
    message = f"grouped_program: order must lie in 0 to 3, got values from {min(0, wrong)} to {max(3, wrong)}"
    refuses(message, grouped_program, *arguments, program=program, order=order, backend=backend)


def test_a_spread_parameter_in_what_a_linear_step_adds_is_refused():
    """The compiled module would read a parameter marked `spread` as consecutive columns."""
    b = Builder()
    x, matrix, bias = b.input(3), b.parameter(4, 3), b.parameter(4)
    added = Columns(PARAMETER, bias, 0, 4, spread=True)
    result = b.linear(x, matrix, 4, add=added)
    program = b.program([result])
    (linear,) = (step for step in program.steps if step.op == "linear")
    assert not linear.operands[1].spread  # the builder copies the value to all columns
    steps = tuple(step._replace(operands=(x, added)) if step is linear else step for step in program.steps)
    rule = "Program: steps must be without spread columns in the addends of a linear step, got Step(op='linear'"
    refuses(rule, replace, program, steps=steps)


def test_a_program_of_what_is_not_there_is_refused():
    """The constructor of Program refuses every number out of range, since the compiled module does not check."""

    def larger(value):
        if isinstance(value, tuple):
            for place, part in enumerate(value):
                for other in larger(part):
                    changed = (*value[:place], other, *value[place + 1 :])
                    yield type(value)(*changed) if hasattr(value, "_fields") else changed
        elif type(value) is int:
            yield from (value + 100, -1, 2**31, 10**30)

    def allowed(program):
        for name in ("inputs", "parameters", "outputs", "steps", "sums", "rays", "by_ray"):
            for other in larger(getattr(program, name)):
                try:
                    replace(program, **{name: other})
                    yield name, other
                except ValueError as error:
                    assert str(error).startswith("Program: ") and "\n" not in str(error)

    assert len([*allowed(every_step())]) == 4  # larger parameters with unread entries, and two steps with zero columns
    program = gradient(gradient(encoded(), *ALL), (True,) * 5, (True,) * 3, (True,) * 3, (True,) * 3)
    assert {"encode", "scatter"} <= {step.op for step in program.steps}
    kept = [*allowed(program)]
    steps = [new for name, other in kept if name == "steps" for new, old in zip(other, program.steps) if new != old]
    assert not any(step.op in ("encode", "scatter") for step in steps)


ALL = (True,) * 3, (True,) * 3, (True,) * 2, ()
"""The arguments of ``gradient`` for :func:`encoded`: all gradients are wanted, and all outputs have gradients."""
ENCODED = {
    **{
        name: (name, *next((d, size) for d in (3, 6) for size in (4, 2) if encoding.fits(d, size)))
        for name, encoding in ENCODINGS.items()
    },
    "no octaves": ("frequency", 5, 0),
    "constant": ("spherical", 3, 1),
    "hash": ("hash", 3, 0),
    "hash of each cell": ("hash", 3, 0),
}


def of_encoding(kind: str, ray: bool = False) -> Program:
    """Returns a program with the outputs sin(W e(x)) for each row and e(x) * other summed by ray."""
    name, raw, size = ENCODED[kind]
    b = Builder()
    x = b.input(raw, ray=ray)
    table = b.parameter(*GRID.table_shape) if name == "hash" else 0
    e = b.encode(name, x, b.grid(GRID.text) if name == "hash" else size, table)
    other = b.input(e.width, ray=not ray)
    h = b.apply("sine", b.linear(e, b.parameter(2, e.width), 2), 1.0)
    return b.program([h, b.binary("mul", e, other)], by_ray=[1])


def formula(kind: str, x: Tensor, table: Tensor | None, cells: Tensor) -> Tensor:
    """Computes the encoding without programs."""
    name, _, size = ENCODED[kind]
    if name in ENCODINGS:
        return ENCODINGS[name].formula(x, size)
    assert table is not None
    own = len(table) > 1
    return hash_encode(x, table if own else table[0], GRID, cells=cells if own else None, backend="reference")


def encoding_arguments(program: Program, kind: str, sizes: list[int], rays: int) -> list[Tensor]:
    """Returns float64 inputs, followed by parameters; in the kind "hash of each cell" each cell has a table."""
    generator, n, k = torch.Generator().manual_seed(3), sum(sizes) + 5, len(sizes)
    tensors = [
        torch.rand(rays if i in program.rays else n, w, generator=generator, dtype=torch.float64)
        for i, w in enumerate(program.inputs)
    ]
    for i, shape in enumerate(program.parameters):
        few = 1 if i in program.tables and kind != "hash of each cell" else k
        tensors.append(torch.randn(few, *shape, generator=generator, dtype=torch.float64) / shape[-1] ** 0.5)
    return tensors


@pytest.mark.parametrize(("ray", "ordered"), [(False, False), (False, True), (True, True)])
@pytest.mark.parametrize("kind", ENCODED)
def test_encodings_against_autograd(kind: str, ray: bool, ordered: bool) -> None:
    """Values and three orders of gradients are correct: with autograd of the reference, and with gradient programs."""
    if ray and kind.endswith(("hash", "cell")):
        pytest.skip("the positions of a grid are samples")
    program = of_encoding(kind, ray)
    sizes, rays = [4, 0, 5], 6
    tensors = encoding_arguments(program, kind, sizes, rays)
    offsets = offsets_of(sizes) + 2  # two rows before the cells, three after them
    n = sum(sizes) + 5
    generator = torch.Generator().manual_seed(1)
    order = torch.randperm(n, generator=generator).int() if ordered else None
    ray_index = torch.randint(0, rays - 1, (n,), generator=generator).int()  # the last ray has no samples

    def by_hand(*leaves: Tensor) -> list[Tensor]:
        x, other, *parameters = leaves
        x, other = (x[ray_index.long()], other) if ray else (x, other[ray_index.long()])
        table = parameters[0] if program.tables else None
        place = torch.arange(n) if order is None else torch.empty(n).long().index_copy(0, order.long(), torch.arange(n))
        cells = cells_of(offsets, x)[place]
        inside = ((place >= offsets[0]) & (place < offsets[-1]))[:, None]
        e = formula(kind, x, table, cells)
        h = (parameters[-1][cells.long()] @ e[:, :, None])[:, :, 0].sin()
        product = torch.where(inside, e * other, 0)
        return [torch.where(inside, h, 0), e.new_zeros(rays, e.shape[1]).index_add(0, ray_index, product)]

    def by_reference(*leaves: Tensor) -> list[Tensor]:
        options = {"program": program, "order": order, "ray_index": ray_index, "backend": "reference"}
        return grouped_program(leaves[:2], leaves[2:], offsets, **options)

    def by_programs(*leaves: Tensor) -> list[Tensor]:
        return ByPrograms.apply(program.text, offsets, order, ray_index, *leaves)

    expected = of_every_order(by_hand, tensors)
    for run in (by_reference, by_programs):
        for actual, exact in zip(of_every_order(run, tensors), expected, strict=True):
            torch.testing.assert_close(actual, exact, rtol=1e-9, atol=1e-9)


@pytest.mark.native
@pytest.mark.skipif(sys.platform == "win32", reason="pages are protected otherwise")
@pytest.mark.parametrize("name", ENCODINGS)
def test_nothing_is_read_behind_a_gradient(name: str) -> None:
    """An encoding's incoming gradient, which is read in place for few rows, ends at the start of a protected page."""
    _, raw, size = ENCODED[name]
    b = Builder()
    program = b.program([b.encode(name, b.input(raw), size)])
    n, width, page = 5, program.outputs[0].width, mmap.PAGESIZE
    pages = mmap.mmap(-1, 2 * page)
    behind = ctypes.addressof(ctypes.c_char.from_buffer(pages)) + page
    g = (
        torch.frombuffer(pages, dtype=torch.float32, count=n * width, offset=page - 4 * n * width)
        .view(n, width)
        .fill_(1)
    )
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(behind), page, 0) == 0
    generator = torch.Generator().manual_seed(0)
    x, _ = torch.rand(n, raw, generator=generator), g.uniform_(generator=generator)
    arguments = [x, g], [], offsets_of([n])
    options = {"program": gradient(program, (True,), (), (True,), ())}
    actual, exact = (grouped_program(*arguments, **options, backend=backend) for backend in ("native", "reference"))
    torch.testing.assert_close(actual, exact)


def test_which_derivatives_the_compiled_module_has() -> None:
    """The compiled module runs an encoding (F_0) and its gradients with respect to x (G_1) and to the table (T_0).

    For a program with any other derivative of an encoding, `orders` exceeds 3, the limit of the compiled module.
    """
    program = encoded()
    first = gradient(program, *ALL)
    assert program.orders == 0 and first.orders == 1
    numbers = {step.numbers[2:] for step in first.steps if step.op == "encode"}
    assert numbers == {(0, 0), (1, 1)} and [s.numbers for s in first.steps if s.op == "scatter"] == [(0, 0, 0)]
    assert gradient(first, (True,) * 5, (False,) * 3, (True,) * 3, (False,) * 3).orders > 3
    # A second derivative with respect to the table alone is a look-up in the incoming gradient of the table.
    last = [i == 0 for i in range(len(first.sums))]
    only = gradient(first, (False,) * 3 + (True,) * 2, (False,) * 3, (False,) * 3, tuple(last))
    assert only.orders <= 3 and 3 in only.tables


def test_tables_have_dtypes_of_their_own() -> None:
    """Tables may have another dtype than the inputs, and the gradient of a table has its dtype."""
    program = encoded()
    generator = torch.Generator().manual_seed(0)
    inputs = [torch.rand(4 if i in program.rays else 7, w, generator=generator) for i, w in enumerate(program.inputs)]
    parameters = [torch.randn(1, *shape, generator=generator) for shape in program.parameters]
    arguments = {"program": program, "ray_index": torch.arange(7).int() % 4}
    for dtype in (torch.float16, torch.bfloat16, torch.float32):
        table = parameters[0].to(dtype).requires_grad_()
        for of, backend in ((torch.float32, "native"), (torch.float64, "reference"), (torch.bfloat16, "native")):
            rows, (_, *others) = [x.to(of) for x in inputs], [p.to(of) for p in parameters]
            wide = torch.promote_types(of, torch.float32)
            actual = grouped_program(rows, [table, *others], offsets_of([3, 4]), **arguments, backend=backend)
            exact = grouped_program(
                [x.to(wide) for x in rows],
                [table.to(wide), *(p.to(wide) for p in others)],
                offsets_of([3, 4]),
                **arguments,
                backend="reference",
            )
            for ours, theirs in zip(actual, exact, strict=True):
                assert ours.dtype == of
                assert agree(ours, theirs.to(of))
            (slope,) = torch.autograd.grad(actual[0].sum(), table)
            (right,) = torch.autograd.grad(exact[0].sum(), table)
            assert slope.dtype == dtype
            torch.testing.assert_close(slope, right, rtol=2e-2, atol=2e-2)


@pytest.mark.parametrize("backend", ["reference", "native"])
def test_the_sum_of_a_shared_table_is_one(backend: str) -> None:
    """A shared table has a single gradient sum; other parameters and tables of cells have one for each cell."""
    program = gradient(encoded(), *ALL)
    rays, n = 4, 7
    inputs = [torch.rand(rays if i in program.rays else n, w) for i, w in enumerate(program.inputs)]
    for few in (1, 3):
        parameters = [torch.randn(few, *shape) for shape in program.parameters]
        arguments = {"program": program, "ray_index": torch.arange(n).int() % rays, "backend": backend}
        result = grouped_program(inputs, parameters, offsets_of([3, 0, 4]), **arguments)
        assert [len(tensor) for tensor in result] == [n, n, rays, few, 3, 3]


@pytest.mark.parametrize("backend", ["reference", "native"])
def test_programs_without_rays_run(backend: str) -> None:
    program = encoded()
    inputs = [torch.rand(0, w) for w in program.inputs]
    parameters = [torch.randn(2, *shape) for shape in program.parameters]
    arguments = {"program": program, "ray_index": torch.zeros(0).int(), "backend": backend}
    assert [len(tensor) for tensor in grouped_program(inputs, parameters, offsets_of([0, 0]), **arguments)] == [0, 0]


def test_high_derivatives_within_a_custom_op() -> None:
    """Derivatives are correct inside a custom op, where, as under torch.compile, autograd records nothing."""
    b = Builder()
    x, along = b.input(3), b.input(3)
    sine = b.function("sine", x, 1.0, order=4)
    assert sine is not None
    program = b.program([sine, b.encode("frequency", x, 1, along=[along, along])])
    rows = [torch.rand(5, 3), torch.rand(5, 3)]
    how = (program.text, "grouped_program", "ray_index", "float32", False, -1)
    result = torch.ops.voronerf.network(rows, [], offsets_of([5]), None, None, [], *how)
    torch.testing.assert_close(result[0], rows[0].sin())
    second = -rows[1].square() * torch.stack([rows[0].sin(), rows[0].cos()])
    torch.testing.assert_close(result[1], torch.cat([torch.zeros(5, 3), *second], dim=1))


def test_programs_of_rays_compile() -> None:
    """The program compiles to one graph for any number of rays, although the compiler makes integers symbolic."""
    torch.compiler.reset()
    program = encoded()
    parameters = [torch.rand(1, *shape).requires_grad_() for shape in program.parameters]

    def run(inputs: list[Tensor], ray_index: Tensor) -> list[Tensor]:
        return grouped_program(inputs, parameters, offsets_of([3, 6]), program=program, ray_index=ray_index)

    compiled = torch.compile(run, fullgraph=True, dynamic=True, backend="aot_eager")
    for rays in (4, 5):
        inputs = [torch.rand(rays if i in program.rays else 9, w) for i, w in enumerate(program.inputs)]
        ray_index = torch.arange(9).int() % rays
        actual, expected = compiled(inputs, ray_index), run(inputs, ray_index)
        slopes = [torch.autograd.grad(sum(t.sum() for t in part), parameters) for part in (actual, expected)]
        for ours, theirs in zip((*actual, *slopes[0]), (*expected, *slopes[1]), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_refuses_rays_that_do_not_fit() -> None:
    """Every rule about rays and tables has its own message; the op's case covers all other rules."""
    program = encoded()
    inputs = [torch.rand(4 if i in program.rays else 6, w) for i, w in enumerate(program.inputs)]
    parameters = [torch.rand(1, *shape) for shape in program.parameters]
    index = torch.tensor([0, 1, 2, 3, 0, 1], dtype=torch.int32)

    def refused(message: str, error: type = ValueError, **changed: object) -> None:
        arguments = {"inputs": inputs, "parameters": parameters, "offsets": offsets_of([6]), "program": program}
        arguments = {**arguments, "ray_index": index, **changed}
        refuses(f"grouped_program: {message}", grouped_program, error=error, **arguments)

    refused("ray_index must be given for a program with inputs of rays, got None", ray_index=None)
    refused("ray_index must have shape [n] with n = 6, got [5]", ray_index=index[1:])
    for wrong in (7, -1, 2**31 - 1, -(2**31)):
        strange = index.clone()
        strange[3] = wrong
        refused(f"ray_index must be 0 to 3, got {wrong}", ray_index=strange)
    refused("inputs[2] must hold a row for the ray_index, got [0, 3]", inputs=[*inputs[:2], inputs[2][:0]])
    refused("inputs[2] must have shape [r, 3], got [4, 2]", inputs=[*inputs[:2], inputs[2][:, 1:]])
    message = "parameters[0] must have dtype float16, bfloat16, float32 or float64, got int32"
    refused(message, TypeError, parameters=[parameters[0].int(), *parameters[1:]])
    # An order does not replace a missing ray index, even after a successful call with a ray index.
    grouped_program(inputs, parameters, offsets_of([6]), program=program, ray_index=index)
    refused("ray_index must be given for a program with inputs of rays, got None", ray_index=None, order=index)


def test_programs_of_rays_and_grids_that_are_not_there_are_refused() -> None:
    """Every rule about encodings has its own message."""
    program = encoded()
    refuses("Program: rays must be distinct indices of inputs, got (3,)", replace, program, rays=(3,))
    refuses("Program: rays must be distinct indices of inputs, got (2, 2)", replace, program, rays=(2, 2))
    rule = "distinct indices of outputs, in a program with per-ray inputs"
    refuses(f"Program: by_ray must be {rule}, got (2,)", replace, program, by_ray=(2,))
    refuses(f"Program: by_ray must be {rule}, got (1,)", replace, program, rays=())
    for grids in (("x",), ("{}",), (7,), ("[1]",), ("null",), GRID.text):
        refuses("Program: grids must be texts of hash grids, got ", replace, program, grids=grids)
    refuses("Program: steps must be made of existing values, parameters and sums, got ", replace, program, grids=())
    place, hashed = next((i, step) for i, step in enumerate(program.steps) if step.name == "hash")

    def changed(**fields: object) -> tuple[Step, ...]:
        return (*program.steps[:place], hashed._replace(**fields), *program.steps[place + 1 :])

    replace(program, steps=(*program.steps, hashed._replace(out=90)))
    direction = next(step for step in program.steps if step.op == "input" and step.numbers == (2,))
    spread = Columns(VALUE, hashed.operands[0].index, 0, 3, True)
    of_a_ray = Columns(VALUE, direction.out, 0, 3)
    for fields in (
        {"operands": (of_a_ray,)},
        {"operands": (spread,)},
        {"operands": (Columns(PARAMETER, 1, 0, 3),)},
        {"operands": ()},
        {"name": "wave"},
        {"numbers": (0, 0, 0)},
        {"numbers": (0, 0, 0, 1)},
        {"numbers": (0, 1, 0, 0)},
        {"name": "spherical", "numbers": (5, 0, 0, 0)},
        {"name": "frequency", "numbers": (1, 1, 0, 0)},
    ):
        refuses("Program: steps must be made of existing", replace, program, steps=changed(**fields))
    # Only steps that look up tables may read a table, and only scatter steps may add to a table's gradient.
    b = Builder(program)
    refuses(
        "Program: steps must be made of existing", b.program, [b.binary("mul", of_a_ray, Columns(PARAMETER, 0, 0, 3))]
    )
    refuses("Program: outputs must be made of existing", replace, program, outputs=(Columns(PARAMETER, 0, 0, 3),))
    first = gradient(program, *ALL)
    scatter = next(step for step in first.steps if step.op == "scatter")
    column = Step("columns", scatter.out, 3, (of_a_ray,), (0,))
    for steps in ((*first.steps, column), (first.steps[0], column._replace(out=scatter.out), *first.steps[1:])):
        refuses("Program: steps must be made of existing", replace, first, steps=steps)
    # The step of the gradient with respect to x (G_1) must read the encoding of the same x.
    back = next(step for step in first.steps if step.op == "encode" and step.numbers[3] and step.name == "hash")
    wrong = back._replace(operands=(*back.operands[:2], back.operands[1]))
    steps = tuple(wrong if step == back else step for step in first.steps)
    refuses("Program: steps must be made of existing", replace, first, steps=steps)


def test_texts_of_programs() -> None:
    """Parsing the text of a program returns an equal program."""
    for program in (every_step(), encoded(), gradient(encoded(), *ALL)):
        assert Program.parse(program.text) == program
        assert Program.parse(program.text).text == program.text
    assert gradient(encoded(), *ALL).rays == (2, 4) and gradient(encoded(), *ALL).by_ray == (2,)


def test_rows_without_a_gradient_where_tensors_lie_turned() -> None:
    """Rows with a zero gradient are left out, also if inputs and gradients are stored as [w, n]."""
    b, n = Builder(), 200
    x = b.input(5)
    program = b.program([b.linear(x, b.parameter(4, 5), 4)])
    generator = torch.Generator().manual_seed(0)
    rows, weights = torch.randn(5, n, generator=generator), torch.randn(2, 4, 5, generator=generator)
    gradient_of = torch.randn(4, n, generator=generator)
    gradient_of[:, 60:] = 0
    for turned in (rows.t(), rows.t().contiguous()):
        slopes = []
        for backend in ("reference", "native"):
            leaf = weights.clone().requires_grad_()
            (out,) = grouped_program([turned], [leaf], offsets_of([80, 120]), program=program, backend=backend)
            (out.t() * gradient_of).sum().backward()
            slopes.append(leaf.grad)
        torch.testing.assert_close(*slopes, rtol=1e-5, atol=1e-5)


def test_rows_of_rays_that_lie_turned() -> None:
    """Results for column-major rays are correct, also for as many rays as samples."""
    b, n = Builder(), 6
    program = b.program([b.binary("add", b.input(4), b.input(4, ray=True))])
    x, rays = torch.rand(n, 4), torch.rand(4, n).t()
    index = torch.arange(n).flip(0).int()
    result = grouped_program([x, rays], [], offsets_of([2, 4]), program=program, ray_index=index, backend="native")
    torch.testing.assert_close(result[0], x + rays.flip(0))


def test_second_derivatives_where_rows_have_no_gradient() -> None:
    """Second derivatives include rows whose gradient is zero; a program with a hash grid leaves no rows out."""
    b, n = Builder(), 40
    table = b.parameter(*GRID.table_shape)
    e = b.encode("hash", b.input(3), b.grid(GRID.text), table)
    program = b.program([b.apply("sigmoid", b.linear(e, b.parameter(2, e.width), 2))])
    x, light = torch.rand(n, 3), torch.rand(n, 2)
    light[5:] = 0
    arguments, results = [torch.randn(1, *shape) for shape in program.parameters], []
    for backend in ("reference", "native"):
        leaves = [parameter.clone().requires_grad_() for parameter in arguments]
        (out,) = grouped_program([x], leaves, offsets_of([10, 30]), program=program, backend=backend)
        first = torch.autograd.grad((out * light).sum(), leaves, create_graph=True)
        results.append(torch.autograd.grad(sum((slope**2).sum() for slope in first), leaves))
    for ours, exact in zip(*results, strict=True):
        torch.testing.assert_close(ours, exact, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("wanted", [(0,), (1,), (0, 1)])
def test_gradients_of_some_tables_of_a_product(wanted: tuple[int, ...]) -> None:
    """The gradient of one table needs the features of the other table alone."""
    b = Builder()
    x, y, grid = b.input(3), b.input(3), b.grid(GRID.text)
    tables = [b.parameter(*GRID.table_shape) for _ in range(2)]
    product = b.binary("mul", *(b.encode("hash", at, grid, table) for at, table in zip((x, y), tables)))
    program, generator = b.program([product]), torch.Generator().manual_seed(0)
    rows = [torch.rand(40, 3, generator=generator) for _ in range(2)]
    values, results = [torch.randn(1, *shape, generator=generator) for shape in program.parameters], []
    for backend in ("reference", "native"):
        leaves = [value.clone().requires_grad_(i in wanted) for i, value in enumerate(values)]
        (out,) = grouped_program(rows, leaves, offsets_of([10, 30]), program=program, backend=backend)
        results.append(torch.autograd.grad(out.sin().sum(), [leaves[i] for i in wanted]))
    for ours, exact in zip(*results, strict=True):
        torch.testing.assert_close(ours, exact, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("products", ["float32", "bfloat16"])
def test_shapes_of_a_gpu_that_is_not_there(products):
    """A run with fake tensors on a GPU device returns fake results with the right shapes; it works without a GPU."""
    b = Builder()
    program = b.program([b.linear(b.input(5), b.parameter(7, 5), 7)])
    with FakeTensorMode():
        x, weight = torch.empty(9, 5, device="cuda"), torch.empty(2, 7, 5, device="cuda")
        offsets = torch.zeros(3, dtype=torch.int32, device="cuda")
        result = plans.run(*plans.Run([x], [weight], offsets, None, None, (), program.text, products=products))
        assert [tuple(t.shape) for t in result] == [(9, 7)]
