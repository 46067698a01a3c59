"""Programs of a tile: what an op does with the rows of one cell, step by step.

A program takes rows, [n, w] for each of its inputs, and parameters, [k, o, i] or [k, w], one for each cell. Its steps
make values of rows, [n, w], and sums over the rows of a cell. The gradient of a program is a program
(:func:`gradient`), so derivatives of every order run as the program itself does.

Letters: n rows, k cells, w columns of a value, o outputs and i inputs of a matrix.

The steps:

    input      the columns of an input
    linear     x W^T, or x W if transposed, of columns ``start`` on of a matrix's inputs, and what is added to it
    function   f(x) of :data:`FUNCTIONS`, or one of its derivatives; times another value
    binary     one of :data:`BINARY` of two values
    total      sums over groups of columns next to each other
    move       columns of values, put next to each other or added up
    outer      g^T x, summed over the rows of a cell: the gradient of a matrix
    columns    the sum over the rows of a cell: the gradient of a vector
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

VALUE, PARAMETER = "value", "parameter"
_ANY = 1 << 30


class Function(NamedTuple):
    """A function of each entry, with two numbers a and b.

    Attributes:
        formula: (x, a, b) -> f(x), in PyTorch. The compiled module has f and its derivatives, in a line of its own
            (csrc/network/functions.h).
        orders: the highest derivative that is not 0.
    """

    formula: Callable[[Tensor, float, float], Tensor]
    orders: int = _ANY


FUNCTIONS = {
    "copy": Function(lambda x, a, b: x.clone(), 1),
    "stop": Function(lambda x, a, b: x.detach().clone(), 0),
    "step": Function(lambda x, a, b: (x > 0).to(x.dtype), 0),
    "at_least": Function(lambda x, a, b: (x >= 0).to(x.dtype), 0),
    "floor": Function(lambda x, a, b: x.floor(), 0),
    "affine": Function(lambda x, a, b: a * x + b, 1),
    "relu": Function(lambda x, a, b: x.relu(), 1),
    "leaky_relu": Function(lambda x, a, b: F.leaky_relu(x, a), 1),
    "abs": Function(lambda x, a, b: x.abs(), 1),
    "clamp": Function(lambda x, a, b: x.clamp(a, b), 1),
    "elu": Function(lambda x, a, b: F.elu(x, a)),
    "softplus": Function(lambda x, a, b: F.softplus(x, a, b)),
    "sigmoid": Function(lambda x, a, b: x.sigmoid()),
    "tanh": Function(lambda x, a, b: x.tanh()),
    "silu": Function(lambda x, a, b: F.silu(x)),
    "gelu": Function(lambda x, a, b: F.gelu(x)),
    "gelu_tanh": Function(lambda x, a, b: F.gelu(x, approximate="tanh")),
    "sine": Function(lambda x, a, b: torch.sin(a * x + b)),
    "exp": Function(lambda x, a, b: x.exp()),
    "log": Function(lambda x, a, b: x.log()),
    "power": Function(lambda x, a, b: x**a),
    "erf": Function(lambda x, a, b: x.erf()),
    "atan": Function(lambda x, a, b: x.atan()),
}
"""By their names in the compiled module."""

BINARY: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "div": torch.div,
    "gate": lambda x, y: torch.where(y != 0, x, 0),  # x where y is not 0, else 0
}
"""Of two values, by their names in the compiled module."""


class Columns(NamedTuple):
    """Columns of a value or of a parameter, as a step reads them.

    Attributes:
        of: "value" or "parameter".
        index: of the value or parameter.
        start: the first column; of a parameter, the first of its entries in a row.
        width: how many.
        spread: one column, in the place of ``width``.
    """

    of: str
    index: int  # type: ignore[assignment]  # a tuple's method
    start: int
    width: int
    spread: bool = False

    def part(self, start: int, width: int) -> Columns:
        """Some of these columns."""
        return self._replace(start=self.start + (0 if self.spread else start), width=width)


class Step(NamedTuple):
    """One step.

    Attributes:
        op: one of the table above.
        out: the value that it makes; of outer and columns, the sum that it adds to.
        width: columns that it makes.
        operands: what it reads. linear: x, then what is added if anything is, then the value of ``relu_slope``;
            function: x, then what it is multiplied by if anything is.
        numbers: input: (index,). linear: (parameter, start, transposed). function: (order, a, b). total: (columns of a
            group,). move: for each operand where its columns go. outer, columns: (start,).
        name: of the function or of the binary one. linear: "relu" or "relu_slope", done on the way.
    """

    op: str
    out: int
    width: int
    operands: tuple[Columns, ...] = ()
    numbers: tuple[float, ...] = ()
    name: str = ""


@dataclass(frozen=True)
class Program:
    """What is done with the rows of a cell.

    Raises:
        ValueError: a step, an output or a sum of anything that is not there: what runs a program trusts it.
    """

    inputs: tuple[int, ...]  # columns of each input
    parameters: tuple[tuple[int, ...], ...]  # shape for one cell of each parameter, (o, i) or (w,)
    steps: tuple[Step, ...]  # in their order
    outputs: tuple[Columns, ...]  # columns that are results, [n, w] each
    sums: tuple[tuple[int, ...], ...] = ()  # shape for one cell of each result that is a sum over its rows
    text: str = field(init=False, compare=False)  # the program as a string, which ops take
    orders: int = field(init=False, compare=False)  # the highest derivative of a function in it

    def __post_init__(self) -> None:
        check(self)
        parts = [self.inputs, self.parameters, self.steps, self.outputs, self.sums]
        object.__setattr__(self, "text", json.dumps(parts))
        orders = [int(step.numbers[0]) for step in self.steps if step.op == "function"]
        object.__setattr__(self, "orders", max(orders, default=0))

    @staticmethod
    @functools.lru_cache(maxsize=1024)
    def parse(text: str) -> Program:
        """The program of a string."""
        inputs, parameters, steps, outputs, sums = json.loads(text)
        shapes = [tuple(map(tuple, given)) for given in (parameters, sums)]
        known = [
            Step(op, out, width, tuple(Columns(*each) for each in operands), tuple(numbers), name)
            for op, out, width, operands, numbers, name in steps
        ]
        return Program(tuple(inputs), shapes[0], tuple(known), tuple(Columns(*each) for each in outputs), shapes[1])


_WIDEST = 1 << 20  # columns
_ORDERS = 20  # of derivatives


def check(program: Program) -> None:
    """Raises ValueError unless a program reads and writes what is there alone."""
    inputs, parameters, sums = program.inputs, program.parameters, program.sums
    values: dict[int, int] = {}  # their columns
    _rule("inputs", _sizes(inputs), inputs)
    for name, shapes in (("parameters", parameters), ("sums", sums)):
        known = isinstance(shapes, tuple) and all(_sizes(shape) and len(shape) in (1, 2) for shape in shapes)
        _rule(name, known, shapes)

    def fits(columns: Any, *widths: int, rows: bool = False) -> bool:
        """Whether columns are there, of one of these widths if any are given; or even each a column of a value."""
        if not isinstance(columns, Columns) or not _sizes(columns[1:4]) or not isinstance(columns.spread, bool):
            return False
        of, index, start, width, spread = columns
        if of == VALUE:
            there = values.get(index, -1)
        else:
            there = math.prod(parameters[index]) if of == PARAMETER and index < len(parameters) else -1
        inside = start + (1 if spread else width) <= there
        return inside and (not widths or width in widths) and not (rows and (spread or of != VALUE))

    def right(step: Step) -> bool:
        op, _, width, operands, numbers, name = step
        count, whole = len(operands), _sizes(numbers)
        if op == "input":
            return whole and len(numbers) == 1 and numbers[0] < len(inputs) and width == inputs[int(numbers[0])]
        if op == "function":
            known = name in FUNCTIONS and len(numbers) == 3 and _sizes(numbers[:1]) and numbers[0] < _ORDERS
            return known and count in (1, 2) and all(fits(each, width) for each in operands)
        if op == "binary":
            return name in BINARY and count == 2 and all(fits(each, width) for each in operands)
        if op == "total":
            return whole and len(numbers) == count == 1 and fits(operands[0], width * int(numbers[0]), rows=True)
        if op == "move":
            places = whole and len(numbers) == count and all(map(fits, operands))
            return places and all(at + each.width <= width for each, at in zip(operands, numbers))
        if op == "linear":
            known = whole and len(numbers) == 3 and name in _FINISHES
            if not (known and numbers[0] < len(parameters) and numbers[2] < 2):
                return False
            (matrix, start, transposed), extra = map(int, numbers), name == "relu_slope"
            o, i = (*parameters[matrix], -1)[:2]
            if not (count in (1 + extra, 2 + extra) and fits(operands[0], rows=True)):
                return False
            depth = operands[0].width
            inside = (depth, start + width) if transposed else (width, start + depth)
            others = all(fits(each, width, rows=each.of == VALUE) for each in operands[1:])
            return inside[0] == o and inside[1] <= i and others
        if op not in ("outer", "columns") or step.out >= len(sums) or not (whole and len(numbers) == 1):
            return False
        shape, start = sums[step.out], int(numbers[0])
        if op == "columns":
            return count == 1 and fits(operands[0], width, rows=True) and start + width <= math.prod(shape)
        last = count == len(shape) == 2 and fits(operands[1], width, rows=True) and start + width <= shape[1]
        return last and fits(operands[0], shape[0], rows=True)

    _rule("steps", isinstance(program.steps, tuple), program.steps)
    for step in program.steps:
        made = isinstance(step, Step) and _sizes(step[1:3]) and step.op in _STEPS
        made = made and isinstance(step.operands, tuple) and isinstance(step.numbers, tuple)
        _rule("steps", made and right(step) and (_sums(step) or step.out not in values), step)
        if not _sums(step):
            values[step.out] = step.width
    _rule("outputs", isinstance(program.outputs, tuple) and all(map(fits, program.outputs)), program.outputs)


_FINISHES = ("", "relu", "relu_slope")
_STEPS = ("input", "linear", "function", "binary", "total", "move", "outer", "columns")


def _sizes(values: Any) -> bool:
    """Whether all values are columns that can be counted."""
    return isinstance(values, tuple) and all(type(value) is int and 0 <= value <= _WIDEST for value in values)


def _rule(name: str, kept: bool, given: object) -> None:
    if not kept:
        raise ValueError(f"Program: {name} must be of values, parameters and sums that are there, got {given!r:.100}")


class Builder:
    """Makes a program step by step. A step that is there already is not made twice.

    Args:
        program: to start from.
    """

    def __init__(self, program: Program | None = None) -> None:
        program = program or Program((), (), (), ())
        self.inputs, self.parameters = list(program.inputs), list(program.parameters)
        self.steps = list(program.steps)
        self.sums = list(program.sums)
        self._makers = {step.out: step for step in self.steps if not _sums(step)}
        self._values = max(self._makers, default=-1) + 1
        self._made: dict[Step, Columns] = {}

    def program(self, outputs: Iterable[Columns]) -> Program:
        """What has been made."""
        return Program(tuple(self.inputs), tuple(self.parameters), tuple(self.steps), tuple(outputs), tuple(self.sums))

    def emit(
        self, op: str, width: int, operands: Sequence[Columns] = (), numbers: Sequence[float] = (), name: str = ""
    ) -> Columns:
        """Adds a step and gives the columns of its value."""
        key = Step(op, 0, width, tuple(operands), tuple(numbers), name)
        if key not in self._made:
            self._made[key] = Columns(VALUE, self._values, 0, width)
            self.steps.append(key._replace(out=self._values))
            self._makers[self._values] = self.steps[-1]
            self._values += 1
        return self._made[key]

    def input(self, width: int) -> Columns:
        """Another input."""
        self.inputs.append(width)
        return self.emit("input", width, (), (len(self.inputs) - 1,))

    def parameter(self, *shape: int) -> int:
        """Another parameter: its number."""
        self.parameters.append(shape)
        return len(self.parameters) - 1

    def linear(
        self, x: Columns, matrix: int, width: int, start: int = 0, transposed: bool = False, add: Columns | None = None
    ) -> Columns:
        """``x W[:, start:]^T``, or ``x W[:, start:]`` if transposed, of so many columns, and what is added to it."""
        operands = (self.rows(x),) if add is None else (self.rows(x), self.rows(add) if add.spread else add)
        return self.emit("linear", width, operands, (matrix, start, int(transposed)))

    def function(
        self, name: str, x: Columns, a: float = 0.0, b: float = 0.0, order: int = 0, times: Columns | None = None
    ) -> Columns | None:
        """A derivative of a function, times a value; None where it is 0."""
        if order > FUNCTIONS[name].orders or (name == "power" and a == int(a) and 0 <= a < order):
            return None
        if order == 1 and times is not None and name in ("copy", "affine"):
            return times if name == "copy" or a == 1 else self.function("affine", times, a)
        before = self._makers[x.index] if x.of == VALUE and order == 0 and name in ("affine", "sine") else None
        if before is not None and before.name == "affine" and before.numbers[0] == 0 and len(before.operands) == 1:
            x = before.operands[0].part(x.start, x.width)._replace(spread=x.spread or before.operands[0].spread)
            a, b = a * before.numbers[1], a * before.numbers[2] + b
        operands = (x,) if times is None else (x, times)
        return self.emit("function", x.width, operands, (order, float(a), float(b)), name)

    def apply(self, name: str, x: Columns, a: float = 0.0, b: float = 0.0) -> Columns:
        """A function itself."""
        made = self.function(name, x, a, b)
        assert made is not None
        return made

    def binary(self, name: str, x: Columns, y: Columns) -> Columns:
        """One of :data:`BINARY`."""
        return self.emit("binary", x.width, (x, y), (), name)

    def total(self, x: Columns, group: int) -> Columns:
        """Sums over groups of columns."""
        return self.emit("total", x.width // group, (self.rows(x),), (group,))

    def move(self, width: int, parts: Sequence[tuple[Columns, int]]) -> Columns:
        """Columns, each added to what is at its place among ``width``; 0 where nothing is."""
        if len(parts) == 1 and parts[0][0].width == width and not parts[0][0].spread and parts[0][0].of == VALUE:
            return parts[0][0]
        return self.emit("move", width, [columns for columns, _ in parts], [at for _, at in parts])

    def rows(self, columns: Columns) -> Columns:
        """The same as a value of rows, with each of its columns."""
        return self.apply("copy", columns) if columns.of == PARAMETER or columns.spread else columns

    def add_outer(self, index: int, g: Columns, x: Columns, start: int) -> None:
        """Adds ``g^T x`` to columns ``start`` on of a sum [o, i]."""
        self.steps.append(Step("outer", index, x.width, (self.rows(g), self.rows(x)), (start,)))

    def add_columns(self, index: int, g: Columns, start: int) -> None:
        """Adds the rows to entries ``start`` on of a sum."""
        if g.spread and g.of == VALUE and g.width == 1:
            g = g._replace(spread=False)
        self.steps.append(Step("columns", index, g.width, (self.rows(g),), (start,)))


def _sums(step: Step) -> bool:
    return step.op in ("outer", "columns")


# Gradients ------------------------------------------------------------------------------------------------------------


class _Arriving:
    """Gradients on their way to the values and parameters of a program."""

    def __init__(self, builder: Builder, active: set[int], sums: dict[int, int], widths: dict[int, int]) -> None:
        self.builder, self.active, self.sums, self.widths = builder, active, sums, widths
        self.parts: dict[int, list[tuple[Columns, int]]] = {}

    def wants(self, columns: Columns) -> bool:
        """Whether a gradient of these columns is asked for."""
        return columns.index in (self.active if columns.of == VALUE else self.sums)

    def add(self, columns: Columns, g: Columns | None) -> None:
        """A gradient of some columns."""
        if g is None or not self.wants(columns):
            return
        if columns.spread and columns.width > 1:
            g, columns = self.builder.total(g, g.width), columns._replace(width=1)
        if columns.of == PARAMETER:
            self.builder.add_columns(self.sums[columns.index], g, columns.start)
        else:
            self.parts.setdefault(columns.index, []).append((g, columns.start))

    def whole(self, value: int) -> Columns | None:
        """A gradient of a whole value that has arrived and to which another may be added on the way."""
        found = self.parts.get(value, [])
        for i, (g, start) in enumerate(found):
            if start == 0 and g.width == self.widths[value] and g.of == VALUE and not g.spread:
                return found.pop(i)[0]
        return None

    def take(self, value: int) -> Columns | None:
        """The sum of all that has arrived at a value."""
        parts, width = self.parts.pop(value, []), self.widths[value]
        whole = [g for g, start in parts if g.width == width]
        rest = [part for part in parts if part[0].width != width]
        if rest:
            whole.append(self.builder.move(width, rest))
        total = whole[0] if whole else None
        for g in whole[1:]:
            total = self.builder.binary("add", total, g)  # type: ignore[arg-type]
        return total


@functools.lru_cache(maxsize=1024)
def gradient(
    program: Program,
    inputs: tuple[bool, ...],
    parameters: tuple[bool, ...],
    outputs: tuple[bool, ...],
    sums: tuple[bool, ...],
) -> Program:
    """The program of the gradients of another.

    Args:
        program: to differentiate.
        inputs: which of its inputs' gradients are asked for.
        parameters: which of its parameters'.
        outputs: which of its outputs have a gradient.
        sums: which of its sums have one.

    Returns:
        A program whose inputs are those of ``program``, then the gradients of its outputs that have one; whose
        parameters are its parameters, then the gradients of its sums; whose outputs are the gradients of inputs, and
        whose sums are those of parameters.
    """
    b = Builder(replace(program, steps=tuple(step for step in program.steps if not _sums(step)), sums=()))
    wanted = {p: i for i, p in enumerate(p for p, want in enumerate(parameters) if want)}
    b.sums = [program.parameters[p] for p in wanted]
    active: set[int] = set()
    for step in b.steps:
        at = step.operands
        if step.op == "input":
            depends = inputs[int(step.numbers[0])]
        else:
            depends = any(c.index in (active if c.of == VALUE else wanted) for c in at)
            depends = depends or (step.op == "linear" and int(step.numbers[0]) in wanted)
        if depends and step.name != "stop":
            active.add(step.out)
    widths = {step.out: step.width for step in b.steps}
    arriving = _Arriving(b, active, wanted, widths)
    for columns, given in zip(program.outputs, outputs, strict=True):
        if given:
            arriving.add(columns, b.input(columns.width))
    of_sums = [b.parameter(*shape) if given else None for shape, given in zip(program.sums, sums, strict=True)]
    found: dict[int, Columns] = {}
    for step in reversed(program.steps):
        if _sums(step):
            matrix = of_sums[step.out]
            if matrix is not None:
                _of_sum(b, arriving, step, matrix)
            continue
        g = arriving.take(step.out) if step.out in active else None
        if g is None:
            continue
        if step.op == "input":
            found[int(step.numbers[0])] = g
        elif step.op == "linear":
            _of_linear(b, arriving, step, g)
        elif step.op == "function":
            _of_function(b, arriving, step, g)
        elif step.op == "binary":
            _of_binary(b, arriving, step, g)
        elif step.op == "total":
            (x,), group = step.operands, int(step.numbers[0])
            if step.width == 1:
                arriving.add(x, g._replace(width=group, spread=True))
            else:
                parts = [(g.part(i, group)._replace(spread=True), i * group) for i in range(step.width)]
                arriving.add(x, b.move(x.width, parts))
        else:
            for columns, at_ in zip(step.operands, step.numbers, strict=True):
                arriving.add(columns, g.part(int(at_), columns.width))
    results = [found.get(i) or b.move(program.inputs[i], []) for i, want in enumerate(inputs) if want]
    return pruned(b.program(results))


def _of_sum(b: Builder, arriving: _Arriving, step: Step, parameter: int) -> None:
    start = int(step.numbers[0])
    if step.op == "columns":
        arriving.add(step.operands[0], Columns(PARAMETER, parameter, start, step.width))
        return
    g, x = step.operands
    if arriving.wants(g):
        arriving.add(g, b.linear(x, parameter, g.width, start))
    if arriving.wants(x):
        arriving.add(x, b.linear(g, parameter, x.width, start, transposed=True))


def _of_linear(b: Builder, arriving: _Arriving, step: Step, g: Columns) -> None:
    (x, *rest), (matrix, start, transposed) = step.operands, map(int, step.numbers)
    for add in rest:
        arriving.add(add, g)
    g = b.rows(g)
    if matrix in arriving.sums:
        b.add_outer(arriving.sums[matrix], *((x, g) if transposed else (g, x)), start)
    if arriving.wants(x):
        whole = x.start == 0 and x.width == arriving.widths[x.index]
        before = arriving.whole(x.index) if whole else None
        arriving.add(x, b.linear(g, matrix, x.width, start, not transposed, add=before))


def _of_function(b: Builder, arriving: _Arriving, step: Step, g: Columns) -> None:
    (x, *rest), (order, a, c) = step.operands, step.numbers
    if rest:
        arriving.add(rest[0], b.function(step.name, x, a, c, int(order), g))
        if arriving.wants(x) and order + 1 <= FUNCTIONS[step.name].orders:
            arriving.add(x, b.function(step.name, x, a, c, int(order) + 1, b.binary("mul", g, rest[0])))
    elif arriving.wants(x):
        # What ReLU returns tells its slope too, and the value before it need not be kept.
        known = Columns(VALUE, step.out, 0, step.width) if step.name == "relu" and order == 0 else x
        arriving.add(x, b.function(step.name, known, a, c, int(order) + 1, g))


def _of_binary(b: Builder, arriving: _Arriving, step: Step, g: Columns) -> None:
    x, y = step.operands
    if step.name in ("add", "sub"):
        arriving.add(x, g)
        if arriving.wants(y):
            arriving.add(y, g if step.name == "add" else b.apply("affine", g, -1.0))
    elif step.name == "mul":
        if arriving.wants(x):
            arriving.add(x, b.binary("mul", g, y))
        if arriving.wants(y):
            arriving.add(y, b.binary("mul", g, x))
    elif step.name == "div":
        if arriving.wants(x):
            arriving.add(x, b.binary("div", g, y))
        if arriving.wants(y):
            product = b.binary("mul", g, Columns(VALUE, step.out, 0, step.width))
            arriving.add(y, b.apply("affine", b.binary("div", product, y), -1.0))
    else:
        arriving.add(x, b.binary("gate", g, y))


def pruned(program: Program) -> Program:
    """The same without steps whose values are not used."""
    needed = {columns.index for columns in program.outputs if columns.of == VALUE}
    kept: list[Step] = []
    for step in reversed(program.steps):
        if _sums(step) or step.out in needed:
            kept.append(step)
            needed.update(columns.index for columns in step.operands if columns.of == VALUE)
    return replace(program, steps=tuple(reversed(kept)))


def merged(program: Program) -> Program:
    """The same with ReLU done on the way of the layer before it: for running, not for :func:`gradient`."""
    kept, uses = list(program.steps), dict[int, int]()
    for columns in (*program.outputs, *(c for step in kept for c in step.operands)):
        if columns.of == VALUE:
            uses[columns.index] = uses.get(columns.index, 0) + 1
    made = {step.out: place for place, step in enumerate(kept) if not _sums(step)}
    dropped = set()
    for place, step in enumerate(kept):
        if step.op != "function" or step.name != "relu":
            continue
        slope = step.numbers[0] == 1
        source = step.operands[-1] if slope and len(step.operands) == 2 else step.operands[0]
        if source.of != VALUE or source.spread or source.start or uses[source.index] != 1:
            continue
        before = kept[made[source.index]]
        plain = before.op == "linear" and not before.name and before.width == source.width
        if slope:
            known = step.operands[0]
            first = made.get(known.index, place)
            plain = plain and len(step.operands) == 2 and known.of == VALUE and first < made[source.index]
            if not plain or known.spread or known.start or kept[first].width != step.width:
                continue
            kept[made[source.index]] = before._replace(
                out=step.out, operands=(*before.operands, known), name="relu_slope"
            )
        elif not plain or step.numbers[0] or len(step.operands) > 1:
            continue
        else:
            kept[made[source.index]] = before._replace(out=step.out, name="relu")
        made[step.out] = made[source.index]
        dropped.add(place)
    steps = tuple(step for place, step in enumerate(kept) if place not in dropped)
    return replace(program, steps=steps)
