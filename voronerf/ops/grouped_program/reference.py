"""Programs of a tile in plain PyTorch. n rows, k cells, w columns of a value."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range
from voronerf.ops._core.program import BINARY, FUNCTIONS, VALUE, Columns, Program, Step
from voronerf.ops.grouped_linear.reference import check_offsets, grouped_linear
from voronerf.ops.grouped_mlp.reference import cells_of


def grouped_program(
    inputs: Sequence[Tensor], parameters: Sequence[Tensor], offsets: Tensor, order: Tensor | None, text: str
) -> list[Tensor]:
    """A program on the rows of each cell; see ``voronerf.ops.grouped_program``. ``text`` is that of a program."""
    check_offsets("grouped_program", offsets, inputs[0].shape[0])
    if order is not None:
        check_range("grouped_program", "order", order, inputs[0].shape[0])
        inputs = [x.index_select(0, order) for x in inputs]
    program = Program.parse(text)
    run = _Run(program, inputs, parameters, offsets)
    results = [run.columns(columns) for columns in program.outputs]
    rows = torch.arange(len(inputs[0]), device=offsets.device)
    inside = ((rows >= offsets[0]) & (rows < offsets[-1]))[:, None]
    results = [torch.where(inside, result, 0) for result in results]
    if order is not None:
        results = [torch.empty_like(result).index_copy(0, order.long(), result) for result in results]
    return [*results, *run.sums]


class _Run:
    """The values of a program."""

    def __init__(
        self, program: Program, inputs: Sequence[Tensor], parameters: Sequence[Tensor], offsets: Tensor
    ) -> None:
        self.inputs, self.offsets, self.k = inputs, offsets, len(offsets) - 1
        self.parameters = [p.expand(self.k, *p.shape[1:]) for p in parameters]
        self.cells = cells_of(offsets, inputs[0])
        self.values: dict[int, Tensor] = {}
        self.sums = [inputs[0].new_zeros(self.k, *shape) for shape in program.sums]
        for step in program.steps:
            if step.op in ("outer", "columns"):
                self.sums[step.out] = self.sums[step.out] + self.summed(step, self.sums[step.out])
            else:
                self.values[step.out] = self.value(step)

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
        if step.op == "binary":
            return BINARY[step.name](operands[0], operands[1])
        if step.op == "total":
            return operands[0].unflatten(1, (step.width, int(step.numbers[0]))).sum(2)
        result = self.inputs[0].new_zeros(len(self.inputs[0]), step.width)
        for x, at in zip(operands, map(int, step.numbers), strict=True):
            result = result + torch.nn.functional.pad(x, (at, step.width - at - x.shape[1]))
        return result

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


def derivative(name: str, x: Tensor, a: float, b: float, order: int) -> Tensor:
    """A derivative of a function, which may be differentiated further."""
    formula, orders = FUNCTIONS[name]
    if order == 0:
        return formula(x, a, b)
    if order > orders:
        return torch.zeros_like(x)
    differentiable = torch.is_grad_enabled() and x.requires_grad
    with torch.enable_grad():
        leaf = x if differentiable else x.detach().requires_grad_()
        found = formula(leaf, a, b)
        for _ in range(order):
            if not found.requires_grad:
                return torch.zeros_like(x)
            (found,) = torch.autograd.grad(found.sum(), leaf, create_graph=True)
    return found if differentiable else found.detach()
