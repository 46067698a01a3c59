"""Programs of a tile in plain PyTorch. n rows, r rays, k cells, w columns of a value."""

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
from voronerf.ops._core.program import BINARY, FUNCTIONS, PARAMETER, VALUE, Columns, Program, Step
from voronerf.ops.grouped_linear.reference import check_offsets, grouped_linear
from voronerf.ops.grouped_program.given import Given, index_name
from voronerf.ops.hash_encode.reference import interpolate


def grouped_program(given: Given, offsets: Tensor, order: Tensor | None) -> list[Tensor]:
    """A program on the rows of each cell; see ``voronerf.ops.grouped_program``. Of halves, products are rounded."""
    check_rows(given, offsets, order)
    text, inputs, parameters, ray_index, dtype, _ = given
    wide = torch.promote_types(dtype, torch.float32)
    with torch.autocast(offsets.device.type, enabled=False):
        taken = [x.to(wide) for x in inputs], [p.to(wide) for p in parameters]
        results = evaluate(*taken, offsets, order, ray_index, text, dtype)
    return [result.to(dtype) for result in results]


def evaluate(
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    order: Tensor | None,
    ray_index: Tensor | None,
    text: str,
    products: torch.dtype | None = None,
) -> list[Tensor]:
    """The results of a program, given by its text, of tensors of one dtype that have been checked; ``products`` are
    rounded to a dtype with their operands."""
    program = parsed(text)
    n = len(inputs[0] if ray_index is None else ray_index)
    if order is not None and ray_index is not None:
        ray_index = ray_index.index_select(0, order)
    row = torch.arange(n, device=offsets.device)
    inside = ((row >= offsets[0]) & (row < offsets[-1]))[:, None]
    rows: list[Tensor] = []
    for i, x in enumerate(inputs):
        place = ray_index if i in program.rays else order
        rows.append(torch.where(inside, x if place is None else x.index_select(0, place), 0))
    run = _Run(program, rows, parameters, offsets, inside, products)
    results = [torch.where(inside, run.columns(columns), 0) for columns in program.outputs]
    for i, result in enumerate(results):
        if i in program.by_ray:
            assert ray_index is not None
            results[i] = result.new_zeros(len(inputs[program.rays[0]]), result.shape[1]).index_add(0, ray_index, result)
        elif order is not None:
            results[i] = torch.empty_like(result).index_copy(0, order.long(), result)
    return [*results, *run.sums]


@constant_result
def parsed(text: str) -> Program:
    """The program of a text."""
    return Program.parse(text)


@constant_result
def _grid(text: str) -> HashGrid:
    grid = HashGrid.parse(text)
    assert grid.rows  # which a compiler finds, but does not compute
    return grid


def check_rows(given: Given, offsets: Tensor, order: Tensor | None) -> None:
    """Raises ValueError for offsets, an order or an index of rays that name no row; on the CPU, as it reads them."""
    if offsets.device.type != "cpu" or torch.compiler.is_compiling():
        return
    index, n = given.ray_index, len(given.inputs[0] if given.ray_index is None else given.ray_index)
    check_offsets(given.caller, offsets, n)
    if order is not None:
        check_range(given.caller, "order", order, n)
    if index is not None and len(index):
        last = len(given.inputs[parsed(given.text).rays[0]]) - 1
        low, high = (int(bound) for bound in index.aminmax())
        if low < 0 or high > last:
            wrong = low if low < 0 else high
            raise ValueError(f"{given.caller}: {index_name(given.caller)} must be 0 to {last}, got {wrong}")


def of_rows(inputs: Sequence[Tensor], text: str) -> list[Tensor]:
    """The outputs of a program without parameters, for which rows need no cells; nothing is read on the host."""
    program = parsed(text)
    run = _Run(program, inputs, [], torch.zeros(1, dtype=torch.int32), None)
    return [run.columns(columns) for columns in program.outputs]


class _Run:
    """The values of a program; ``inside``, bool [n, 1], says of rows whether they are of a cell."""

    def __init__(
        self,
        program: Program,
        inputs: Sequence[Tensor],
        parameters: Sequence[Tensor],
        offsets: Tensor,
        inside: Tensor | None,
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
        """[n, w] of an operand."""
        width = 1 if columns.spread else columns.width
        if columns.of == VALUE:
            found = self.values[columns.index][:, columns.start : columns.start + width]
        else:
            ones = self.inputs[0].new_ones(len(self.inputs[0]), 1)  # whose product sums the gradient in pieces
            found = grouped_linear(ones, self.offsets, self.vectors(columns, width).unsqueeze(2))
        return found.expand(-1, columns.width)

    def vectors(self, columns: Columns, width: int) -> Tensor:
        """[k, w], columns of a parameter."""
        return self.parameters[columns.index].flatten(1)[:, columns.start : columns.start + width]

    def value(self, step: Step) -> Tensor:
        """What a step makes, [n, w]."""
        if step.op == "input":
            return self.inputs[int(step.numbers[0])]
        if step.op == "linear":
            return self.layer(step)
        operands = [self.columns(columns) for columns in step.operands]
        if step.op == "function":
            order, a, b = step.numbers
            found = derivative(step.name, operands[0], a, b, int(order))
            return found * operands[1] if len(operands) > 1 else found
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
        """A product, what is added to it, and its ReLU, [n, w]."""
        (read, *others), (matrix, start, transposed) = step.operands, map(int, step.numbers)
        x, weight = self.columns(read), self.parameters[matrix][:, :, start:]
        weight = weight[:, :, : step.width].transpose(1, 2) if transposed else weight[:, :, : x.shape[1]]
        bias = self.vectors(others.pop(0), step.width) if others and others[0].of == PARAMETER else None
        y = grouped_linear(x.to(self.products), self.offsets, weight.to(self.products), bias).to(x.dtype)
        if len(others) > (step.name == "relu_slope"):
            y = y + self.columns(others[0])
        if step.name == "relu_slope":
            return torch.where(self.columns(others[-1]) > 0, y, 0)
        return y.relu() if step.name == "relu" else y

    def encoded(self, step: Step, operands: Sequence[Tensor]) -> Tensor:
        """An encoding, or one of its derivatives, [n, w]."""
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
        """The encoding of rows, with a table [k, e, f] of cells or [1, e, f] of all of them."""
        if name in ENCODINGS:
            return ENCODINGS[name].formula(x, size)
        assert table is not None
        return interpolate(x, table, self.grids[size], self.cells if len(table) > 1 else None)

    def scattered(self, step: Step) -> Tensor:
        """What a step adds to the sum of a table, [k, e, f] or [1, e, f]."""
        grid, parameter, _ = map(int, step.numbers)
        assert self.inside is not None
        x, g, *directions = (self.columns(columns) for columns in step.operands)

        def encoded(table: Tensor) -> Tensor:
            return along(functools.partial(self.encoding, "hash", grid, table=table), directions)(x)

        with recording():  # the same for every table, as an encoding is linear in it
            inside = torch.where(self.inside, g, 0)
            return torch.func.vjp(encoded, torch.zeros_like(self.tables[parameter]))[1](inside)[0]

    def summed(self, step: Step, like: Tensor) -> Tensor:
        """What a step adds to a sum, [k, ...]."""
        start = int(step.numbers[0])
        g, x = (self.columns(step.operands[i % len(step.operands)]) for i in range(2))
        if step.op == "columns":
            x = torch.ones_like(g[:, :1])
        found = torch.ops.voronerf.grouped_outer(g, x, self.offsets)
        if step.op == "outer":
            return torch.nn.functional.pad(found, (start, like.shape[-1] - start - found.shape[-1]))
        flat = torch.nn.functional.pad(found[:, :, 0], (start, like[0].numel() - start - found.shape[1]))
        return flat.reshape(like.shape)


def cells_of(offsets: Tensor, rows: Tensor) -> Tensor:
    """int32 [n], the cell of each row that is sorted by cell; the nearest one for a row of no cell."""
    index = torch.arange(rows.shape[0], dtype=torch.int32, device=rows.device)
    return torch.searchsorted(offsets[1:-1].contiguous(), index, right=True, out_int32=True)


@contextlib.contextmanager
def recording() -> Iterator[None]:
    """Has autograd record within a custom op too: what PyTorch calls there it does not see, and gradients would be 0.

    There is no public way to ask for this.
    """
    left_out = torch._C._dispatch_tls_local_exclude_set()
    for key in ("AutogradCPU", "AutogradCUDA", "ADInplaceOrView"):
        left_out = left_out.remove(getattr(torch._C.DispatchKey, key))
    with torch._C._ForceDispatchKeyGuard(torch._C._dispatch_tls_local_include_set(), left_out):
        yield


def along(encode: Callable[[Tensor], Tensor], directions: Sequence[Tensor]) -> Callable[[Tensor], Tensor]:
    """The derivative of an encoding along directions, which may be differentiated further."""
    for direction in directions:
        encode = functools.partial(_slope, encode, direction)
    return encode


def _slope(encode: Callable[[Tensor], Tensor], direction: Tensor, x: Tensor) -> Tensor:
    y, back, *_ = torch.func.vjp(encode, x)
    # The gradient of <direction, back(v)> to v; PyTorch's forward mode compiles TorchScript.
    return torch.func.vjp(lambda v: back(v)[0], torch.zeros_like(y))[1](direction)[0]


def derivative(name: str, x: Tensor, a: float, b: float, order: int) -> Tensor:
    """A derivative of a function, which may be differentiated further."""
    formula, orders = FUNCTIONS[name]
    if order == 0:
        return formula(x, a, b)
    if order > orders:
        return torch.zeros_like(x)
    differentiable = torch.is_grad_enabled() and x.requires_grad
    with torch.enable_grad(), recording():
        leaf = x if differentiable else x.detach().requires_grad_()
        found = formula(leaf, a, b)
        for _ in range(order):
            if not found.requires_grad:
                return torch.zeros_like(x)
            (found,) = torch.autograd.grad(found.sum(), leaf, create_graph=True)
    return found if differentiable else found.detach()
