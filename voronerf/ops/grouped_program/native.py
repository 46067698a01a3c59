"""Programs of the compiled module. n rows, k cells, w columns of a value.

The gradient of a program is a program, and runs by the same op; so do further derivatives. A program with higher
derivatives of a function than the compiled module has runs in PyTorch.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import asked_for
from voronerf.ops._core.program import BINARY, FUNCTIONS, PARAMETER, Columns, Program, Step, gradient, merged
from voronerf.ops.grouped_program.reference import grouped_program as in_torch

_OPS = ("input", "output", "linear", "function", "binary", "total", "move", "outer", "columns")
_ORDERS = 3  # of derivatives that the compiled module has
_FLOATS = 96 << 10  # of the values of a tile: they share the second cache level with the weights
_ROWS = (24, 96)  # of a tile, whole blocks of the products (gemm_tile.h)
_GRANULE = 16
_FEW = 4  # outputs of a layer that has a product of its own (few_outputs_tile.h)


@custom_op("grouped_program_native")
def grouped_program(
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    order: Tensor | None,
    ray_index: Tensor | None,
    text: str,
) -> Iterator[list[Tensor]]:
    """A program on the rows of each cell; see ``voronerf.ops.grouped_program``."""
    program, k = Program.parse(text), offsets.shape[0] - 1
    n, new = (inputs[0] if ray_index is None else ray_index).shape[0], inputs[0].new_empty
    rays = inputs[program.rays[0]].shape[0] if program.rays else 0
    counts = [rays if i in program.by_ray else n for i in range(len(program.outputs))]
    results = [new(count, columns.width) for count, columns in zip(counts, program.outputs)]
    sums = [new(count, *shape) for count, shape in zip(program.cells_of_sums(parameters, k), program.sums)]
    yield [*results, *sums]
    if program.orders > _ORDERS or program.rays or program.grids or any(step.op == "encode" for step in program.steps):
        every = in_torch(inputs, parameters, offsets, order, ray_index, text)
        for made, found in zip((*results, *sums), every, strict=True):
            made.copy_(found)
        return
    plan, machine = _plan(text), native.machine(inputs[0])
    turned = [not x.is_contiguous() and x.t().is_contiguous() for x in inputs]
    code, constants = plan.on(inputs[0].device)
    given = native.compiled.ProgramInputs(
        code=code,
        constants=constants,
        inputs=[x.t() if turn else x for x, turn in zip(inputs, turned)],
        turned=torch.tensor(turned, dtype=torch.int32),
        parameters=parameters,
        strides=torch.tensor([p[0].numel() if p.shape[0] > 1 else 0 for p in parameters], dtype=torch.int64),
        widths=plan.widths,
        outputs=len(results),
        offsets=offsets,
        order=order,
        n=n,
        k=k,
    )
    if isinstance(machine, native.compiled.Cpu):
        for result in results:
            native.on_huge_pages(result)
        native.compiled.grouped_program(given, results, sums, machine)
        return
    sizes = plan.sizes
    workspace = code.new_empty(native.compiled.grouped_program_workspace(sizes, n, k, machine), dtype=torch.uint8)
    native.compiled.grouped_program(given, sizes, results, sums, workspace, machine)


def _keep(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    rows, parameters, offsets, order, ray_index, ctx.text = inputs
    ctx.count, ctx.k = len(rows), offsets.shape[0] - 1
    ctx.shared = [p.shape[0] == 1 for p in parameters]
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*rows, *parameters, offsets, order, ray_index)


def _gradients(ctx: Any, arriving: Sequence[Tensor | None]) -> tuple[Any, ...]:
    *saved, offsets, order, ray_index = ctx.saved_tensors
    rows, parameters, count = saved[: ctx.count], saved[ctx.count :], ctx.count
    wanted = asked_for(ctx, saved)
    found: list[Tensor | None] = [None] * len(saved)
    program = Program.parse(ctx.text)
    given, split = [g is not None for g in arriving], len(program.outputs)
    if any(given) and any(wanted):
        which = tuple(wanted[:count]), tuple(wanted[count:]), tuple(given[:split]), tuple(given[split:])
        more = [[g.contiguous() for g in part if g is not None] for part in (arriving[:split], arriving[split:])]
        own = gradient(program, *which)
        results = grouped_program([*rows, *more[0]], [*parameters, *more[1]], offsets, order, ray_index, own.text)
        following = iter(results)
        found = [next(following) if want else None for want in wanted]
        for i, shared in enumerate(ctx.shared, start=count):
            if shared and ctx.k > 1 and found[i] is not None:
                found[i] = found[i].sum(0, keepdim=True)  # type: ignore[union-attr]
        found = [None if g is None else g.to(t.dtype) for g, t in zip(found, saved, strict=True)]
    return found[:count], found[count:], None, None, None, None


grouped_program.register_autograd(_gradients, setup_context=_keep)


# Plans ----------------------------------------------------------------------------------------------------------------


class Plan:
    """A program as the compiled module reads it (csrc/network/cpu/program_code.h).

    Attributes:
        widths: int64, columns of each output.
        sizes: what CUDA is told of it.
    """

    def __init__(
        self, code: list[int], constants: list[float], widths: list[int], sizes: native.compiled.ProgramSizes
    ) -> None:
        self._code, self._constants = torch.tensor(code, dtype=torch.int32), torch.tensor(constants)
        self.widths, self.sizes = torch.tensor(widths, dtype=torch.int64), sizes
        self._on = {torch.device("cpu"): (self._code, self._constants)}

    def on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Code and constants on a device, copied there once."""
        if device not in self._on:
            self._on[device] = self._code.to(device), self._constants.to(device)
        return self._on[device]


class _Slots:
    """Places of values in the workspace of a tile, in columns; one that is free again is used again."""

    def __init__(self) -> None:
        self.size = 0
        self._free: list[tuple[int, int]] = []  # (width, place)

    def take(self, width: int) -> int:
        """A place for so many columns."""
        fitting = [slot for slot in self._free if slot[0] == width]
        if fitting:
            self._free.remove(fitting[-1])
            return fitting[-1][1]
        self.size += width
        return self.size - width

    def give(self, width: int, place: int) -> None:
        """It is free again."""
        self._free.append((width, place))


def _padded(width: int) -> int:
    return -(-width // _GRANULE) * _GRANULE


@functools.lru_cache(maxsize=1024)
def _plan(text: str) -> Plan:
    program = merged(Program.parse(text))
    writing = _Writing(program)
    outputs = [Step("output", i, c.width, (c,), (i,)) for i, c in enumerate(program.outputs)]
    steps = [*program.steps, *outputs]
    last = {c.index: at for at, step in enumerate(steps) for c in step.operands if c.of != PARAMETER}
    for at, step in enumerate(steps):
        dying = {c.index for c in step.operands if c.of != PARAMETER and last[c.index] == at}
        writing.step(step, dying)
        if step.op not in ("outer", "columns", "output") and step.out not in last:
            writing.free(step.out)
    return writing.plan()


class _Writing:
    """A plan on its way."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.slots, self.where, self.packed, self.partial = _Slots(), dict[int, tuple[int, int]](), 0, 0
        self.packs: dict[tuple[int, ...], tuple[int, int]] = {}  # their number, and where they are
        self.code: list[int] = []
        self.constants: list[float] = [0.0, 0.0]
        self.sums: list[tuple[int, ...]] = []
        self.count = 0

    def free(self, value: int) -> None:
        """A value is not needed any more."""
        place, width = self.where[value]
        self.slots.give(width, place)

    def pack(self, kind: int, parameter: int, start: int, width: int, floats: int) -> int:
        """The number of the pack of a part of a parameter."""
        shape = self.program.parameters[parameter]
        o, i = shape if len(shape) == 2 else (1, shape[0])
        key = (kind, parameter, o, i, start, width)
        if key not in self.packs:
            self.packs[key] = len(self.packs), self.packed
            self.packed += floats
        return self.packs[key][0]

    def operand(self, c: Columns, place: int = 0) -> list[int]:
        """One operand's record."""
        if c.of == PARAMETER:
            width = 1 if c.spread else c.width
            at = self.pack(2, c.index, c.start, width, _padded(width))
            return [1, at, 0, 0, c.width, int(c.spread), place]
        at, stride = self.where[c.index]
        return [0, at, c.start, stride, c.width, int(c.spread), place]

    def step(self, step: Step, dying: set[int]) -> None:
        """Writes a step; values that are ``dying`` give their place to what it makes, if it is of their kind."""
        padded, number, depth, finish, constants, order, name = _padded(step.width), 0, 0, 0, 0, 0, 0
        places = [0] * len(step.operands)
        operands = [self.operand(c) for c in step.operands]
        slot = 0
        if step.op in ("input", "output"):
            number = int(step.numbers[0])
        elif step.op == "linear":
            matrix, start, transposed = map(int, step.numbers)
            o, _ = self.program.parameters[matrix]
            x = step.operands[0]
            depth, finish = x.width, ("", "relu", "relu_slope").index(step.name)
            added = step.operands[1 : len(step.operands) - (finish == 2)]
            if step.width <= _FEW and depth % _GRANULE == 0 and finish < 2 and all(c.of == PARAMETER for c in added):
                order = 1 if step.width == 1 else _FEW
            columns = order or padded
            kind, width = transposed + 4 * (order > 0), step.width if transposed else depth
            number = self.pack(kind, matrix, start, width, (o if transposed else depth) * columns)
        elif step.op == "function":
            order, name, constants = int(step.numbers[0]), list(FUNCTIONS).index(step.name), len(self.constants)
            self.constants += step.numbers[1:]
        elif step.op == "binary":
            name = list(BINARY).index(step.name)
        elif step.op == "total":
            number = int(step.numbers[0])
        elif step.op == "move":
            places = [int(at) for at in step.numbers]
            taken = [column for c, at in zip(step.operands, places) for column in range(at, at + c.width)]
            order = int(sorted(taken) == list(range(step.width)))
        else:
            number, padded, depth = self.sum(step)
        if step.op not in ("output", "outer", "columns"):
            slot = self._slot(step, padded, dying)
        for value in dying:
            self.free(value)
        for record, place in zip(operands, places):
            record[-1] = place
        self.code += [_OPS.index(step.op), name, order, step.width, slot, padded, number, depth, finish, constants]
        self.code += [len(operands), *(entry for record in operands for entry in record)]
        self.count += 1

    def _slot(self, step: Step, padded: int, dying: set[int]) -> int:
        """The place of a step's value: that of an operand that is read entry by entry and not needed any more."""
        entrywise = step.operands if step.op in ("function", "binary") else ()
        if step.op == "linear":
            entrywise = tuple(c for c in step.operands[1:] if c[:2] != step.operands[0][:2])
        for c in entrywise:
            if c.of != PARAMETER and c.index in dying and not c.spread and c.start == 0:
                place, width = self.where[c.index]
                others = [other for other in step.operands if other.of != PARAMETER and other.index == c.index]
                if width == padded and all(other.start == 0 and not other.spread for other in others):
                    dying.discard(c.index)
                    self.where[step.out] = place, padded
                    return place
        self.where[step.out] = self.slots.take(padded), padded
        return self.where[step.out][0]

    def sum(self, step: Step) -> tuple[int, int, int]:
        """The place of a sum in the partial, its stride, and whether its inputs are next to each other."""
        shape, start, at = self.program.sums[step.out], int(step.numbers[0]), self.partial
        size = shape[0] * (shape[1] if len(shape) > 1 else 1)
        if step.op == "columns":
            padded = _padded(step.width)
            self.partial += padded
            self.sums.append((step.out, 2, at, 1, size, start, step.width, padded, size))
            return at, padded, 0
        o, i = step.operands[0].width, step.operands[1].width
        by_outputs = int(o * _padded(i) < i * _padded(o))
        padded = _padded(i if by_outputs else o)
        self.partial += padded * (o if by_outputs else i)
        self.sums.append((step.out, by_outputs, at, o, shape[1], start, i, padded, size))
        return at, padded, by_outputs

    def plan(self) -> Plan:
        """What has been written."""
        for i, shape in enumerate(self.program.sums):
            if not any(record[0] == i for record in self.sums):
                size = shape[0] * (shape[1] if len(shape) > 1 else 1)
                self.sums.append((i, -1, 0, 0, 0, 0, 0, 0, size))
        self.sums.sort()
        fitting = _FLOATS // max(self.slots.size, 1) // _ROWS[0] * _ROWS[0]
        tile = min(max(fitting, _ROWS[0]), _ROWS[1])
        program, columns = self.program, self.slots.size
        header = [tile, columns, self.packed, self.partial, len(self.packs), self.count, len(self.sums)]
        packs = [entry for key, (_, at) in self.packs.items() for entry in (*key, at)]
        sums = [entry for record in self.sums for entry in record]
        counts = [len(part) for part in (program.inputs, program.parameters, program.outputs, program.sums)]
        sizes = native.compiled.ProgramSizes(columns, self.partial, *counts)
        widths = [c.width for c in program.outputs]
        return Plan([*header, *packs, *self.code, *sums], self.constants, widths, sizes)
