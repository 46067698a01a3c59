"""Programs of a tile in plain PyTorch. n rows, r rays, k cells, w columns of a value."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.program import BINARY, FUNCTIONS, VALUE, Columns, Program, Step
from voronerf.ops.grouped_linear.reference import check_offsets, grouped_linear
from voronerf.ops.grouped_mlp.reference import cells_of
from voronerf.ops.hash_encode.reference import interpolate


def grouped_program(
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    order: Tensor | None,
    ray_index: Tensor | None,
    text: str,
) -> list[Tensor]:
    """A program on the rows of each cell; see ``voronerf.ops.grouped_program``. ``text`` is that of a program."""
    program = Program.parse(text)
    n, rays = (inputs[0] if ray_index is None else ray_index).shape[0], None
    low, *_, high = check_offsets("grouped_program", offsets, n)
    if order is not None:
        check_range("grouped_program", "order", order, n)
        ray_index = None if ray_index is None else ray_index.index_select(0, order)
    rows = [x if order is None or i in program.rays else x.index_select(0, order) for i, x in enumerate(inputs)]
    for i in program.rays:
        assert ray_index is not None
        rays = inputs[i].shape[0]
        if n and (int(ray_index.min()) < 0 or int(ray_index.max()) >= rays):
            wrong = int(ray_index.min() if ray_index.min() < 0 else ray_index.max())
            raise ValueError(f"grouped_program: ray_index must be 0 to {rays - 1}, got {wrong}")
        rows[i] = inputs[i].index_select(0, ray_index)
    run = _Run(program, rows, parameters, offsets, slice(low, high))
    results = [run.columns(columns) for columns in program.outputs]
    index = torch.arange(n, device=offsets.device)
    inside = ((index >= low) & (index < high))[:, None]
    for i, result in enumerate(results):
        if i in program.by_ray:
            assert rays is not None and ray_index is not None
            results[i] = result.new_zeros(rays, result.shape[1]).index_add(0, ray_index[low:high], result[low:high])
            continue
        results[i] = torch.where(inside, result, 0)
        if order is not None:
            results[i] = torch.empty_like(result).index_copy(0, order.long(), results[i])
    return [*results, *run.sums]


def of_rows(inputs: Sequence[Tensor], text: str) -> list[Tensor]:
    """The outputs of a program without parameters, for which rows need no cells; nothing is read on the host."""
    program = Program.parse(text)
    run = _Run(program, inputs, [], torch.zeros(1, dtype=torch.int32), slice(0))
    return [run.columns(columns) for columns in program.outputs]


class _Run:
    """The values of a program; ``inside`` are the rows of cells."""

    def __init__(
        self,
        program: Program,
        inputs: Sequence[Tensor],
        parameters: Sequence[Tensor],
        offsets: Tensor,
        inside: slice,
    ) -> None:
        self.inputs, self.offsets, self.k, self.inside = inputs, offsets, len(offsets) - 1, inside
        self.tables = {i: parameters[i].to(inputs[0].dtype) for i in program.tables}
        self.grids = [HashGrid.parse(text) for text in program.grids]
        self.parameters = [p.expand(self.k, *p.shape[1:]) for p in parameters]
        self.values: dict[int, Tensor] = {}
        counts = program.cells_of_sums(parameters, self.k)
        self.sums = [inputs[0].new_zeros(count, *shape) for count, shape in zip(counts, program.sums)]
        for step in program.steps:
            if step.op == "scatter":
                self.sums[step.out] = self.sums[step.out] + self.scattered(step)
            elif step.op in ("outer", "columns"):
                self.sums[step.out] = self.sums[step.out] + self.summed(step, self.sums[step.out])
            else:
                self.values[step.out] = self.value(step)

    @functools.cached_property
    def cells(self) -> Tensor:
        """int32 [n]."""
        return cells_of(self.offsets, self.inputs[0])

    def columns(self, columns: Columns) -> Tensor:
        """[n, w] of an operand."""
        width = 1 if columns.spread else columns.width
        if columns.of == VALUE:
            found = self.values[columns.index][:, columns.start : columns.start + width]
        else:
            stacked = self.parameters[columns.index].flatten(1)[:, columns.start : columns.start + width]
            found = stacked.index_select(0, self.cells)
        return found.expand(-1, columns.width)

    def value(self, step: Step) -> Tensor:
        """What a step makes, [n, w]."""
        if step.op == "input":
            return self.inputs[int(step.numbers[0])]
        operands = [self.columns(columns) for columns in step.operands]
        if step.op == "linear":
            matrix, start, transposed = map(int, step.numbers)
            part = self.parameters[matrix][:, :, start:][:, :, : step.width if transposed else operands[0].shape[1]]
            y = grouped_linear(operands[0], self.offsets, part.transpose(1, 2) if transposed else part)
            if len(operands) > 1 + (step.name == "relu_slope"):
                y = y + operands[1]
            return y.relu() if step.name == "relu" else torch.where(operands[-1] > 0, y, 0) if step.name else y
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

    def encoded(self, step: Step, operands: Sequence[Tensor]) -> Tensor:
        """An encoding, or one of its derivatives, [n, w]."""
        size, parameter, order, back = map(int, step.numbers)
        table = self.tables.get(parameter) if step.name == "hash" else None
        encode = functools.partial(self.encoding, step.name, size, table=table, rows=slice(None))
        with recording():
            if not back:
                return along(encode, operands[1:])(operands[0])
            x, g, *directions = operands[: order + 1]
            return torch.func.vjp(along(encode, directions), x)[1](g)[0]

    def encoding(self, name: str, size: int, x: Tensor, table: Tensor | None, rows: slice) -> Tensor:
        """The encoding of some rows, with a table [k, e, f] of cells or [1, e, f] of all of them."""
        if name in ENCODINGS:
            return ENCODINGS[name].formula(x, size)
        assert table is not None
        return interpolate(x, table, self.grids[size], self.cells[rows] if len(table) > 1 else None)

    def scattered(self, step: Step) -> Tensor:
        """What a step adds to the sum of a table, [k, e, f] or [1, e, f]."""
        grid, parameter, _ = map(int, step.numbers)
        x, g, *directions = (self.columns(columns)[self.inside] for columns in step.operands)

        def encoded(table: Tensor) -> Tensor:
            return along(functools.partial(self.encoding, "hash", grid, table=table, rows=self.inside), directions)(x)

        with recording():  # the same for every table, as an encoding is linear in it
            return torch.func.vjp(encoded, torch.zeros_like(self.tables[parameter]))[1](g)[0]

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
