"""Programs in plain PyTorch. n rows, r rays, k cells, w columns of a value."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.program import BINARY, FUNCTIONS, PARAMETER, VALUE, Columns, Names, Program, Step
from voronerf.ops.grouped_linear.reference import check_offsets, grouped_linear
from voronerf.ops.hash_encode.reference import interpolate
from voronerf.ops.network.cells import Sorted


def network(
    program: Program,
    parameters: Sequence[Tensor],
    names: Names,
    inputs: Sequence[Tensor],
    ray_index: Tensor | None,
    rows: Sorted,
    dtype: torch.dtype,
    run: Callable[..., Run] | None = None,
) -> list[Tensor]:
    """Runs a program on the rows of each cell; see ``voronerf.ops.network.Network``.

    With half types, the operands and results of products are rounded. ``run`` replaces the class `Run`.
    """
    _check_rows(program, names, inputs, ray_index, rows)
    wide = torch.promote_types(dtype, torch.float32)
    with torch.autocast(rows.offsets.device.type, enabled=False):
        cast = [x.to(wide) for x in inputs], [p.to(wide) for p in parameters]
        results = evaluate(*cast, rows.offsets, rows.order, ray_index, program, dtype, run)
    return [result.to(dtype) for result in results]


def evaluate(
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    order: Tensor | None,
    ray_index: Tensor | None,
    program: Program,
    products: torch.dtype | None = None,
    run: Callable[..., Run] | None = None,
) -> list[Tensor]:
    """Returns the results of a program, for checked tensors of one dtype.

    ``products`` is the dtype to which products and their operands are rounded, or None. ``run`` replaces the class
    `Run`.
    """
    n = len(inputs[0] if ray_index is None else ray_index)
    if order is not None and ray_index is not None:
        ray_index = ray_index.index_select(0, order)
    row = torch.arange(n, device=offsets.device)
    inside = ((row >= offsets[0]) & (row < offsets[-1]))[:, None]
    rows: list[Tensor] = []
    for i, x in enumerate(inputs):
        place = ray_index if i in program.rays else order
        rows.append(torch.where(inside, x if place is None else x.index_select(0, place), 0))
    values = (run or Run)(program, rows, parameters, offsets, inside, products)
    results = [torch.where(inside, values.columns(columns), 0) for columns in program.outputs]
    for i, result in enumerate(results):
        if i in program.by_ray:
            assert ray_index is not None
            results[i] = result.new_zeros(len(inputs[program.rays[0]]), result.shape[1]).index_add(0, ray_index, result)
        elif order is not None:
            results[i] = torch.empty_like(result).index_copy(0, order.long(), result)
    return [*results, *values.sums]


@constant_result
def _grid(text: str) -> HashGrid:
    grid = HashGrid.parse(text)
    assert grid.rows  # fills the cached property, which a compiler can read but not compute
    return grid


def _check_rows(program: Program, names: Names, inputs: Sequence[Tensor], index: Tensor | None, rows: Sorted) -> None:
    """Raises ValueError if offsets, an order or a ray index on the CPU are out of range."""
    if rows.offsets.device.type != "cpu" or torch.compiler.is_compiling():
        return
    n = len(inputs[0] if index is None else index)
    check_offsets(names.op, rows.offsets, n)
    if rows.order is not None:
        check_range(names.op, "order", rows.order, n)
    if index is not None and len(index):
        last = len(inputs[program.rays[0]]) - 1
        low, high = (int(bound) for bound in index.aminmax())
        if low < 0 or high > last:
            wrong = low if low < 0 else high
            raise ValueError(f"{names.op}: {names.ray_index} must be 0 to {last}, got {wrong}")


class Run:
    """An evaluation of a program, with its values. ``inside``: bool [n, 1], whether a row belongs to a cell."""

    def __init__(
        self,
        program: Program,
        inputs: Sequence[Tensor],
        parameters: Sequence[Tensor],
        offsets: Tensor,
        inside: Tensor,
        products: torch.dtype | None = None,
    ) -> None:
        self.inputs, self.offsets, self.k, self.inside = inputs, offsets, len(offsets) - 1, inside
        self.products = products or inputs[0].dtype
        self.cells = cells_of(offsets, inputs[0]) if program.grids else offsets  # int32 [n]
        self.tables = {i: parameters[i].to(inputs[0].dtype) for i in program.tables}
        self.grids = [_grid(text) for text in program.grids]
        self.parameters = [p.expand(self.k, *p.shape[1:]) for p in parameters]
        self.values: dict[int, Tensor] = {}
        counts = program.cells_of_sums(parameters, self.k) if program.sums else []
        self.sums = [inputs[0].new_zeros(count, *shape) for count, shape in zip(counts, program.sums)]
        for step in program.steps:
            if step.op == "scatter":
                self.sums[step.out] = self.sums[step.out] + self.scattered(step)
            elif step.op in ("outer", "columns"):
                self.sums[step.out] = self.sums[step.out] + self.summed(step, self.sums[step.out])
            else:
                self.values[step.out] = self.value(step)

    def columns(self, columns: Columns) -> Tensor:
        """Returns the values of an operand, [n, w]."""
        width = 1 if columns.spread else columns.width
        if columns.of == VALUE:
            values = self.values[columns.index][:, columns.start : columns.start + width]
        else:
            # A product, because its backward pass sums the gradient in pieces.
            ones = self.inputs[0].new_ones(len(self.inputs[0]), 1)
            values = grouped_linear(ones, self.offsets, self.vectors(columns, width).unsqueeze(2))
        return values.expand(-1, columns.width)

    def vectors(self, columns: Columns, width: int) -> Tensor:
        """Returns columns of a parameter, [k, w]."""
        return self.parameters[columns.index].flatten(1)[:, columns.start : columns.start + width]

    def value(self, step: Step) -> Tensor:
        """Returns the value of a step, [n, w]."""
        if step.op == "input":
            return self.inputs[int(step.numbers[0])]
        if step.op == "linear":
            return self.layer(step)
        operands = [self.columns(columns) for columns in step.operands]
        if step.op == "function":
            order, a, b = step.numbers
            slope = derivative(step.name, operands[0], a, b, int(order))
            return slope * operands[1] if len(operands) > 1 else slope
        if step.op == "encode":
            return self.encoded(step, operands)
        if step.op == "binary":
            return BINARY[step.name](operands[0], operands[1])
        if step.op == "total":
            return operands[0].unflatten(1, (step.width, int(step.numbers[0]))).sum(2)
        result = self.inputs[0].new_zeros(len(self.inputs[0]), step.width)
        for x, at in zip(operands, map(int, step.numbers), strict=True):
            result = result + torch.nn.functional.pad(x, (at, step.width - at - x.shape[1]))
        return result

    def layer(self, step: Step) -> Tensor:
        """Returns the value of a linear step, [n, w]: a product, with its addends and its ReLU."""
        x, others = self.columns(step.operands[0]), [*step.operands[1:]]
        bias = self.vectors(others.pop(0), step.width) if others and others[0].of == PARAMETER else None
        y = grouped_linear(x.to(self.products), self.offsets, self.matrix(step).to(self.products), bias).to(x.dtype)
        if len(others) > (step.name == "relu_slope"):
            y = y + self.columns(others[0])
        if step.name == "relu_slope":
            return torch.where(self.columns(others[-1]) > 0, y, 0)
        return y.relu() if step.name == "relu" else y

    def matrix(self, step: Step) -> Tensor:
        """Returns the matrix of a linear step, [k, o, i]: some columns of a parameter, or their transpose."""
        matrix, start, transposed = map(int, step.numbers)
        width = step.width if transposed else step.operands[0].width
        part = self.parameters[matrix][:, :, start : start + width]
        return part.transpose(1, 2) if transposed else part

    def encoded(self, step: Step, operands: Sequence[Tensor]) -> Tensor:
        """Returns an encoding or one of its derivatives, [n, w]."""
        size, parameter, order, back = map(int, step.numbers)
        table = self.tables.get(parameter) if step.name == "hash" else None
        encode = functools.partial(self.encoding, step.name, size, table=table)
        if not order:
            return encode(operands[0])
        with recording():
            if not back:
                return along(encode, operands[1:])(operands[0])
            x, g, *directions = operands[: order + 1]
            return torch.func.vjp(along(encode, directions), x)[1](g)[0]

    def encoding(self, name: str, size: int, x: Tensor, table: Tensor | None) -> Tensor:
        """Returns the encoding of rows; the table is [k, e, f], or [1, e, f] if all cells share it."""
        if name in ENCODINGS:
            return ENCODINGS[name].formula(x, size)
        assert table is not None
        return interpolate(x, table, self.grids[size], self.cells if len(table) > 1 else None)

    def scattered(self, step: Step) -> Tensor:
        """Returns the gradient that a step adds to the sum of a table, [k, e, f] or [1, e, f]."""
        grid, parameter, _ = map(int, step.numbers)
        x, g, *directions = (self.columns(columns) for columns in step.operands)

        def encoded(table: Tensor) -> Tensor:
            return along(functools.partial(self.encoding, "hash", grid, table=table), directions)(x)

        with recording():  # an encoding is linear in its table, so a table of zeros gives the same gradient
            inside = torch.where(self.inside, g, 0)
            return torch.func.vjp(encoded, torch.zeros_like(self.tables[parameter]))[1](inside)[0]

    def summed(self, step: Step, like: Tensor) -> Tensor:
        """Returns the term that a step adds to a sum, [k, ...]."""
        start = int(step.numbers[0])
        g, x = (self.columns(step.operands[i % len(step.operands)]) for i in range(2))
        if step.op == "columns":
            x = torch.ones_like(g[:, :1])
        term = torch.ops.voronerf.grouped_outer(g, x, self.offsets)
        if step.op == "outer":
            return torch.nn.functional.pad(term, (start, like.shape[-1] - start - term.shape[-1]))
        flat = torch.nn.functional.pad(term[:, :, 0], (start, like[0].numel() - start - term.shape[1]))
        return flat.reshape(like.shape)


def cells_of(offsets: Tensor, rows: Tensor) -> Tensor:
    """Returns int32 [n], the cell of each sorted row; the nearest cell for a row outside all cells."""
    index = torch.arange(rows.shape[0], dtype=torch.int32, device=rows.device)
    return torch.searchsorted(offsets[1:-1].contiguous(), index, right=True, out_int32=True)


@contextlib.contextmanager
def recording() -> Iterator[None]:
    """Lets autograd record operations within a custom op, where PyTorch disables it and gradients would be 0.

    It has no relation to recorded training steps. PyTorch has no public function for this.
    """
    left_out = torch._C._dispatch_tls_local_exclude_set()
    for key in ("AutogradCPU", "AutogradCUDA", "ADInplaceOrView"):
        left_out = left_out.remove(getattr(torch._C.DispatchKey, key))
    with torch._C._ForceDispatchKeyGuard(torch._C._dispatch_tls_local_include_set(), left_out):
        yield


def along(encode: Callable[[Tensor], Tensor], directions: Sequence[Tensor]) -> Callable[[Tensor], Tensor]:
    """Returns the derivative of an encoding along directions, as a differentiable function."""
    for direction in directions:
        encode = functools.partial(_slope, encode, direction)
    return encode


def _slope(encode: Callable[[Tensor], Tensor], direction: Tensor, x: Tensor) -> Tensor:
    y, back, *_ = torch.func.vjp(encode, x)
    # Two backward passes give the forward derivative: the gradient of <direction, back(v)> with respect to v. PyTorch's
    # own forward mode compiles TorchScript.
    return torch.func.vjp(lambda v: back(v)[0], torch.zeros_like(y))[1](direction)[0]


def derivative(name: str, x: Tensor, a: float, b: float, order: int) -> Tensor:
    """Returns the derivative of a function at x; the result is differentiable."""
    formula, orders = FUNCTIONS[name]
    if order == 0:
        return formula(x, a, b)
    if order > orders:
        return torch.zeros_like(x)
    differentiable = torch.is_grad_enabled() and x.requires_grad
    with torch.enable_grad(), recording():
        leaf = x if differentiable else x.detach().requires_grad_()
        value = formula(leaf, a, b)
        for _ in range(order):
            if not value.requires_grad:
                return torch.zeros_like(x)
            (value,) = torch.autograd.grad(value.sum(), leaf, create_graph=True)
    return value if differentiable else value.detach()
