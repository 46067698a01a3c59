"""Tests of programs on the emulated CUDA kernels, in several thread orders, against the reference in float64."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from emulated import emulated
from helpers import same
from torch import Tensor

from voronerf import HashGrid
from voronerf.ops import grouped_program
from voronerf.ops._core.program import FUNCTIONS, PARAMETER, VALUE, Builder, Columns, Program, Step, gradient
from voronerf.ops.network import native as plans

sys.path.insert(0, str(Path(__file__).parent.parent / "ops"))
from cases.grouped_program import GRID, encoded, every_step, smooth
from test_grouped_program import NUMBERS, arguments, check, offsets_of, random_program

KIB = 1024
TILES = [227 * KIB, 40 * KIB, 12 * KIB]
"""Bytes of shared memory. Where it suffices, each warp has its own rows. Otherwise, four warps share rows or, if even
these rows do not fit, values are in the workspace (device memory)."""
ALLOWED = {"float32": 2e-5, "tf32": 4e-3, "float16": 4e-3, "bfloat16": 3e-2}
"""Allowed relative errors (norm) by the precision of products."""


def tensors_of(
    program: Program, sizes: list[int], strays: int = 0, rays: int = 5, shared: bool = False
) -> list[Tensor]:
    """Draws inputs, then parameters; with ``shared``, every other parameter is shared by all cells."""
    generator, n, k = torch.Generator().manual_seed(3), sum(sizes) + strays, len(sizes)
    tensors = [
        torch.rand(rays if i in program.rays else n, w, generator=generator) for i, w in enumerate(program.inputs)
    ]
    for i, shape in enumerate(program.parameters):
        few = 1 if shared and i % 2 == 0 else k
        tensors.append(torch.randn(few, *shape, generator=generator) / shape[-1] ** 0.5)
    return tensors


def outcome(program: Program, tensors: list[Tensor], offsets: Tensor, products: str = "", **given: Any) -> list[Tensor]:
    """Returns results and gradients, from the float64 reference unless ``products`` is given."""
    count = len(program.inputs)

    def run(*leaves: Tensor) -> list[Tensor]:
        if not products:
            return grouped_program(
                leaves[:count], leaves[count:], offsets, program=program, backend="reference", **given
            )
        name = "float32" if products == "tf32" else products
        rows = offsets, given.get("order"), given.get("ray_index"), ()
        return plans.Run(leaves[:count], leaves[count:], *rows, program.text, products=name).results()

    before, generator = torch.backends.cuda.matmul.fp32_precision, torch.Generator().manual_seed(5)
    leaves = [(tensor if products else tensor.double()).clone().requires_grad_() for tensor in tensors]
    try:
        torch.backends.cuda.matmul.fp32_precision = "tf32" if products == "tf32" else "ieee"
        results = run(*leaves)
        weights = [torch.randn(t.shape, generator=generator, dtype=torch.float64).to(t.dtype) for t in results]
        gradients = torch.autograd.grad(results, leaves, weights, allow_unused=True, materialize_grads=True)
        return [tensor.detach() for tensor in (*results, *gradients)]
    finally:
        torch.backends.cuda.matmul.fp32_precision = before


def close(found: list[Tensor], exact: list[Tensor], allowed: float) -> None:
    for ours, right in zip(found, exact, strict=True):
        assert ours.shape == right.shape and ours.isfinite().all()
        distance = float((ours.double() - right).norm())
        assert distance <= allowed * float(right.norm()) + 1e-6, (list(ours.shape), distance, float(right.norm()))


def layers_of(widths: list[int]) -> Program:
    """Returns layers of given widths with smooth activations, and a second output of four columns."""
    b = Builder()
    x = h = b.input(widths[0])
    for i, (before, width) in enumerate(itertools.pairwise(widths)):
        bias = Columns(PARAMETER, b.parameter(width), 0, width)
        h = b.apply("sine" if i % 2 else "tanh", b.linear(h, b.parameter(width, before), width, add=bias), 1.0)
    return b.program([h, b.linear(x, b.parameter(4, widths[0]), 4)])


def test_values_and_derivatives_of_second_order() -> None:
    """Covers every kind of tile, cells that are no multiple of a tile, and an empty cell."""
    for seed, shared_bytes in enumerate(TILES):
        order = torch.randperm(70, generator=torch.Generator().manual_seed(seed)).int() if seed == 1 else None
        with emulated(seed=seed, shared_bytes=shared_bytes):
            check(every_step(), [37, 0, 33], shared=seed == 1, order=order)
            check(random_program(seed + 1), [37, 0, 33])


@pytest.mark.parametrize("products", ALLOWED)
@pytest.mark.parametrize(
    ("widths", "shared_bytes"),
    [([3, 5, 1], TILES[0]), *(([17, 70, 33, 66], size) for size in TILES), ([64, 64, 64, 4], TILES[0])],
    ids=str,
)
def test_products_of_every_precision(products: str, widths: list[int], shared_bytes: int) -> None:
    """Covers layers near 4, 16, 32 and 64 columns; kernels compute 64 columns at a time, or fewer in narrow layers."""
    program, sizes = layers_of(widths), [65, 0, 31, 1]
    tensors = tensors_of(program, sizes)
    exact = outcome(program, tensors, offsets_of(sizes))
    with emulated(shared_bytes=shared_bytes):
        found = outcome(program, tensors, offsets_of(sizes), products)
    close(found, exact, ALLOWED[products])
    rounded = max(float((a.double() - b).norm() / b.norm()) for a, b in zip(found, exact))
    assert products == "float32" or rounded > 1e-5, "operands are rounded"


@pytest.mark.parametrize(("capability", "compiled"), [(75, 120), (90, 75)])
@pytest.mark.parametrize(("products", "exactly"), [("tf32", True), ("bfloat16", True), ("float16", False)])
def test_products_before_ampere(products: str, exactly: bool, capability: int, compiled: int) -> None:
    """Checks that tf32 and bfloat16 fall back to float32 products, also in code for an older device."""
    program, sizes = layers_of([17, 70, 33]), [40, 9]
    tensors = tensors_of(program, sizes)
    with emulated(capability=capability, compiled=compiled, shared_bytes=64 * KIB):
        found = outcome(program, tensors, offsets_of(sizes), products)
        plain = outcome(program, tensors, offsets_of(sizes), "float32")
    assert all(map(torch.equal, found, plain)) == exactly
    close(found, outcome(program, tensors, offsets_of(sizes)), ALLOWED[products])


@pytest.mark.parametrize("shared_bytes", TILES[:2])
def test_sizes_around_tiles_and_tasks(shared_bytes: int) -> None:
    program = smooth()
    for n in (0, 1, 31, 32, 33, 63, 64, 65, 127, 128, 129, 257):
        tensors, offsets = tensors_of(program, [n]), offsets_of([n])
        exact = outcome(program, tensors, offsets)
        for products in ("float32", "bfloat16"):
            with emulated(shared_bytes=shared_bytes):
                found = outcome(program, tensors, offsets, products)
            close(found, exact, ALLOWED[products])


def learning_a_table() -> Program:
    """Returns a program in which the gradient of a table is the gradient of a value that the next product reads."""
    b = Builder()
    x, d = b.input(3), b.input(8)
    e = b.encode("hash", x, b.grid(GRID.text), b.parameter(*GRID.table_shape))
    h = b.apply("relu", b.linear(d, b.parameter(e.width, 8), e.width))
    z = b.linear(h, b.parameter(e.width, e.width), e.width, add=e)
    program = b.program([b.linear(z, b.parameter(4, e.width), 4)])
    return gradient(program, (False, False), (True, True, False, False), (True,), ())


def reading_a_part() -> Program:
    """Returns a program in which one product reads a whole value, and the next product reads a part of the value."""
    b = Builder()
    h = b.apply("relu", b.linear(b.input(32), b.parameter(32, 32), 32))
    whole = b.linear(h, b.parameter(48, 32), 48)
    return b.program([b.apply("relu", b.linear(h.part(16, 16), b.parameter(48, 16), 48, add=whole))])


def cut_by_its_input() -> Program:
    """Returns a program with a product that reads a ReLU and is masked by the same ReLU."""
    b = Builder()
    h = b.apply("relu", b.linear(b.input(128), b.parameter(128, 128), 128))
    return b.program([b.linear(b.binary("gate", b.linear(h, b.parameter(128, 128), 128), h), b.parameter(4, 128), 4)])


def learning_nothing() -> Program:
    """Returns a gradient program without steps."""
    b = Builder()
    program = b.program([b.apply("step", b.linear(b.input(4), b.parameter(3, 4), 3))])
    return gradient(program, (False,), (True,), (True,), ())


@pytest.mark.parametrize("products", ["bfloat16", "float16", "float32"])
@pytest.mark.parametrize("make", [learning_a_table, reading_a_part, cut_by_its_input, learning_nothing])
def test_what_must_not_stay_in_registers(make: Callable[[], Program], products: str) -> None:
    program, sizes = make(), [70, 0, 33]
    offsets, tensors, count = offsets_of(sizes), tensors_of(program, sizes), len(program.inputs)
    exact = [tensor.double() for tensor in tensors]
    right = grouped_program(exact[:count], exact[count:], offsets, program=program, backend="reference")
    assert any(part.any() for part in right) == (make is not learning_nothing)
    for shared_bytes in TILES:
        call = plans.Run(tensors[:count], tensors[count:], offsets, None, None, (), program.text, products=products)
        with emulated(shared_bytes=shared_bytes):
            found = plans.run(*call)
            close(found, right, 2 * ALLOWED[products])  # rounding switches a few units


@pytest.mark.parametrize("products", ["float32", "bfloat16"])
@pytest.mark.parametrize("shared", [False, True], ids=["tables of cells", "one table"])
@pytest.mark.parametrize("ordered", [False, True], ids=["sorted", "in any order"])
def test_encodings_rays_and_tables(products: str, shared: bool, ordered: bool) -> None:
    """Covers all encodings, per-ray inputs and outputs, rows of no cell, and all gradients, also of tables."""
    program, sizes = encoded(20), [37, 0, 70]
    n = sum(sizes) + 5
    generator = torch.Generator().manual_seed(1)
    tensors = tensors_of(program, sizes, 5, shared=shared)
    given = {
        "order": torch.randperm(n, generator=generator).int() if ordered else None,
        "ray_index": torch.randint(0, 4, (n,), generator=generator).int(),
    }
    offsets = offsets_of(sizes) + 2
    exact = outcome(program, tensors, offsets, **given)
    for seed, shared_bytes in enumerate(TILES):
        with emulated(seed=seed, shared_bytes=shared_bytes):
            found = outcome(program, tensors, offsets, products, **given)
        close(found, exact, ALLOWED[products])


def test_rows_of_no_cell_keep_nothing() -> None:
    """Checks that stored lookups are 0 in rows of no cell, before the first and after the last cell."""
    b = Builder()
    e = b.encode("hash", b.input(3), b.grid(GRID.text), b.parameter(*GRID.table_shape))
    program = b.program([e])
    x, table = torch.rand(200, 3), torch.randn(2, *GRID.table_shape)
    offsets = torch.tensor([30, 90, 150], dtype=torch.int32)
    with emulated():
        out, kept = plans.run(*plans.Run([x], [table], offsets, None, None, (), program.text, keep=True))
    assert not (kept[:30].any() or kept[150:].any()) and torch.equal(kept[30:150, : e.width], out[30:150])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("features", [1, 2, 4, 8])
def test_tables_of_every_kind(features: int, dtype: torch.dtype) -> None:
    """Compares values and the gradients of positions and table; the table's gradient has the table's dtype."""
    grid = HashGrid(levels=11, features=features, log2_entries=10, base=3, finest=50)
    b = Builder()
    e = b.encode("hash", b.input(3), b.grid(grid.text), b.parameter(*grid.table_shape))
    program, offsets = b.program([e]), offsets_of([33, 7])
    x, table = torch.rand(40, 3), torch.randn(1, *grid.table_shape).to(dtype)
    g, found = torch.randn(40, e.width), []
    for backend, of in (("reference", torch.float64), ("native", torch.float32)):
        leaves = [x.to(of).requires_grad_(), (table.double() if of == torch.float64 else table).requires_grad_()]
        with emulated():
            (out,) = grouped_program(leaves[:1], leaves[1:], offsets, program=program, backend=backend)
            found.append([out.detach(), *torch.autograd.grad(out, leaves, g.to(of))])
    assert found[1][2].dtype == dtype
    close(found[1], found[0], 1e-5 if dtype == torch.float32 else 1e-2)


def test_what_was_looked_up_is_not_looked_up_again() -> None:
    """Checks that the gradient program reads stored lookups: a table of NaN does not change the weight's gradient."""
    b = Builder()
    e = b.encode("hash", b.input(3), b.grid(GRID.text), b.parameter(*GRID.table_shape))
    program = b.program([b.linear(e, b.parameter(5, e.width), 5)])
    own = gradient(program, (False,), (False, True), (True,), ())
    x, table, weight = tensors_of(program, [70])
    first = plans.Run([x], [table, weight], offsets_of([70]), None, None, (), program.text, keep=True)
    with emulated():
        out, kept = plans.run(*first)
        assert kept.shape == (70, 16)
        for parameter in (table, torch.full_like(table, torch.nan)):
            call = first._replace(inputs=[x, torch.ones_like(out)], parameters=[parameter, weight], kept=[kept])
            (found,) = plans.run(*call._replace(text=own.text, keep=False))
            torch.testing.assert_close(found[0], kept[:, : e.width].sum(0).expand(5, -1), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_types_in_memory(dtype: torch.dtype) -> None:
    """Checks that results equal float32 results for the same arguments, rounded to the type."""
    program = every_step()
    rows, parameters, offsets = arguments(program, [40, 9], dtype)
    call = plans.Run(rows, [p.float() for p in parameters], offsets, None, None, (), program.text)
    with emulated():
        found = call.results()
        exact = call._replace(inputs=[x.float() for x in rows]).results()
    assert all(torch.equal(ours, right.to(dtype)) for ours, right in zip(found, exact, strict=True))


def test_every_function_and_turned_inputs() -> None:
    """Covers all functions in one program, with a column-major input."""
    b = Builder()
    x = b.input(5)
    names = [(name, f.orders) for name, f in FUNCTIONS.items() if name != "stop"]
    made = [
        b.function(name, x, *NUMBERS.get(name, (0.7, 0.0)), order=order)
        for name, orders in names
        for order in range(min(orders, 3) + 1)
    ]
    program = b.program([b.move(5 * len(made), [(columns, 5 * i) for i, columns in enumerate(made)])])
    rows = 0.1 + torch.rand(5, 40, generator=torch.Generator().manual_seed(0)).t()
    offsets = torch.tensor([0, 17, 40], dtype=torch.int32)
    (exact,) = grouped_program([rows.double()], [], offsets, program=program, backend="reference")
    for shared_bytes in TILES[::2]:
        with emulated(shared_bytes=shared_bytes):
            (found,) = grouped_program([rows], [], offsets, program=program, backend="native")
        torch.testing.assert_close(found.double(), exact, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("products", ALLOWED)
def test_results_are_the_same_in_every_order_of_threads(products: str) -> None:
    """Compares bit for bit, including sums over several tasks of a cell, and with deterministic algorithms."""
    program, sizes, found = random_program(3), [150, 0, 9], []
    tensors = tensors_of(program, sizes)
    try:
        for seed in (0, 1, 2):
            torch.use_deterministic_algorithms(seed == 2)
            with emulated(seed=seed):
                found.append(outcome(program, tensors, offsets_of(sizes), products))
    finally:
        torch.use_deterministic_algorithms(False)
    assert same(found[0], found[1]) and same(found[0], found[2])


@pytest.mark.parametrize("shared_bytes", TILES)
def test_rows_of_no_cell_and_unsound_indices(shared_bytes: int) -> None:
    """Checks that no memory outside the tensors is accessed, and that rows of no cell are 0."""
    program = encoded()
    for offsets, strays in (([3, 20, 30], [*range(3), *range(30, 33)]), ([0, 40, 50], []), ([5, 2, 33], [])):
        tensors = tensors_of(program, [20, 13])
        wild = torch.tensor([-(2**31), -1, 33, 2**31 - 1] * 8 + [0], dtype=torch.int32)
        index = torch.tensor(offsets, dtype=torch.int32)
        for order in (None, wild):
            with emulated(shared_bytes=shared_bytes):
                found = outcome(program, tensors, index, "float32", order=order, ray_index=wild)
            assert order is not None or not found[0][strays].any()


def test_cells_that_overlap_stay_inside_the_workspace(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checks cells with more tasks than partial sums: kernels must not read the NaN after the partial sums."""
    program, n, beyond = smooth(), 600, 1 << 20
    sizes = []
    with emulated() as loaded:
        size_of, run = loaded.grouped_program_workspace, loaded.grouped_program

        def larger(*given: Any) -> int:
            sizes.append(size_of(*given) + beyond)
            return sizes[-1]

        def poisoned(*given: Any) -> None:
            given[-2].fill_(0xFF)
            run(*given)

        monkeypatch.setattr(loaded, "grouped_program_workspace", larger)
        monkeypatch.setattr(loaded, "grouped_program", poisoned)
        offsets = torch.tensor([0, n, 0, n, 0, n], dtype=torch.int32)
        found = outcome(program, tensors_of(program, [n, 0, 0, 0, 0]), offsets, "float32")
    assert len(sizes) == 2 and all(part.isfinite().all() for part in found)


def test_numbers_that_are_none_stay_in_their_rows() -> None:
    program = layers_of([17, 70, 5])
    tensors = tensors_of(program, [70])
    tensors[0][5, 1], tensors[0][9, 0] = torch.nan, torch.inf
    for products in ALLOWED:
        with emulated(), torch.no_grad():
            rows, of = (offsets_of([70]), None, None, ()), products.replace("tf32", "float32")
            _, out = plans.Run(tensors[:1], tensors[1:], *rows, program.text, products=of).results()
        assert (~out.isfinite()).any(1).nonzero().flatten().tolist() in ([5, 9], [5]), products


def test_refuses_more_tensors_than_kernel_arguments_hold() -> None:
    b = Builder()
    columns: list[Columns] = [b.input(1) for _ in range(65)]
    many = b.program([b.move(65, [(c, i) for i, c in enumerate(columns)])])
    with emulated(), pytest.raises(ValueError, match="at most 64 inputs, parameters, outputs or sums on CUDA, got 65"):
        grouped_program([torch.zeros(3, 1)] * 65, [], torch.tensor([0, 3], dtype=torch.int32), program=many)


def test_values_of_many_columns() -> None:
    """Covers values that exceed shared memory: they lie in the workspace, and blocks run several tasks."""
    b = Builder()
    x = b.input(2000)
    wide = b.program([b.binary("add", b.apply("exp", x), b.apply("tanh", x))])
    rows = torch.rand(700, 2000)
    with emulated(shared_bytes=64 * KIB):
        (found,) = grouped_program([rows], [], offsets_of([700]), program=wide, backend="native")
    torch.testing.assert_close(found, rows.exp() + rows.tanh())


@pytest.mark.parametrize("products", ["float32", "bfloat16"])
def test_a_sum_of_no_columns_is_zero(products: str) -> None:
    """Writes of a value without columns would be outside of its slot, and loops over its columns would not end."""
    x, nothing = Columns(VALUE, 0, 0, 16), Columns(VALUE, 1, 0, 0)
    sums = (Step("columns", 0, 0, (nothing,), (0,)), Step("outer", 1, 0, (x, nothing), (0,)))
    steps = (Step("input", 0, 16, (), (0,)), Step("input", 1, 0, (), (1,)), *sums)
    program = Program((16, 0), (), steps, (x,), ((3,), (16, 4)))
    tensors = tensors_of(program, [600])
    with emulated():
        found = plans.Run(tensors, [], offsets_of([600]), None, None, (), program.text, products=products).results()
    assert torch.equal(found[0], tensors[0]) and not any(total.any() for total in found[1:])
