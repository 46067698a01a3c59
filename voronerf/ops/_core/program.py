"""Programs of a tile: what an op does with the rows of one cell, step by step.

A program takes rows, [n, w] for each of its inputs, and parameters, [k, o, i] or [k, w], one for each cell. Its steps
make values of rows, [n, w], and sums over the rows of a cell. Rows are samples of rays: an input may have one row for
each ray, [r, w], and an output may be the sum over each ray's samples. The gradient of a program is a program
(:func:`gradient`), so derivatives of every order run as the program itself does.

Letters: n rows, r rays, k cells, w columns of a value, o outputs and i inputs of a matrix, e entries and f features of
the table of a hash grid, m the order of a derivative.

The steps:

    input      the columns of an input
    linear     x W^T, or x W if transposed, of columns ``start`` on of a matrix's inputs, and what is added to it
    function   f(x) of :data:`FUNCTIONS`, or one of its derivatives; times another value
    binary     one of :data:`BINARY` of two values
    total      sums over groups of columns next to each other
    move       columns of values, put next to each other or added up
    encode     one of :data:`ENCODINGS` of columns, or "hash", or one of its derivatives
    outer      g^T x, summed over the rows of a cell: the gradient of a matrix
    columns    the sum over the rows of a cell: the gradient of a vector
    scatter    the gradient of a table, summed over the rows of a cell, or over all rows where cells share the table

Derivatives of an encoding e(x), with the table T where it has one, close under differentiation:

    F_m(x; h_1 .. h_m)        the m-th derivative of e at x along h_1, ..., h_m: as many columns as e(x) has
    G_m(x, g; h_1 .. h_m-1)   the gradient to x of <g, F_m-1(x; h_1 .. h_m-1)>: as many columns as x has
    T_m(x, g; h_1 .. h_m)     the gradient to the table of <g, F_m(x; h_1 .. h_m)>, which a scatter adds up
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.grids import HashGrid

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

HASH = "hash"
"""The name of ``hash_encode``, the encoding that has a parameter, beside :data:`ENCODINGS`."""


def encoded_columns(name: str, raw: int, size: int, grids: Sequence[str] = ()) -> int:
    """How many columns an encoding gives.

    Args:
        name: one of :data:`ENCODINGS`, or "hash".
        raw: columns that are encoded.
        size: the encoding's; for "hash" the number of the grid.
        grids: texts of the grids.
    """
    return HashGrid.parse(grids[size]).out_features if name == HASH else ENCODINGS[name].columns(raw, size)


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
        out: the value that it makes; of outer, columns and scatter, the sum that it adds to.
        width: columns that it makes; of a scatter, those of g.
        operands: what it reads. linear: x, then what is added if anything is, then the value of ``relu_slope``;
            function: x, then what it is multiplied by if anything is. encode, scatter: rows alone, as F_m, G_m and T_m
            name them; G_1 has the value F_0(x) as a third one, which kernels use. It has no gradient of its own: what
            it says is known from x and the table.
        numbers: input: (index,). linear: (parameter, start, transposed). function: (order, a, b). total: (columns of a
            group,). move: for each operand where its columns go. outer, columns: (start,). encode: (size, parameter, m,
            back), the size as in :func:`encoded_columns`, the parameter that is the table of "hash", else 0, and 0 for
            F_m or 1 for G_m. scatter: (grid, parameter, m), with the table whose layout the sum has.
        name: of the function, of the binary one or of the encoding. linear: "relu" or "relu_slope", done on the way.
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
    parameters: tuple[tuple[int, ...], ...]  # shape for one cell of each parameter, (o, i), (w,) or (e, f)
    steps: tuple[Step, ...]  # in their order
    outputs: tuple[Columns, ...]  # columns that are results, [n, w] each
    sums: tuple[tuple[int, ...], ...] = ()  # shape for one cell of each result that is a sum over its rows
    rays: tuple[int, ...] = ()  # inputs that have one row for each ray, [r, w]
    by_ray: tuple[int, ...] = ()  # outputs that are sums over the samples of each ray, [r, w], 0 without samples
    grids: tuple[str, ...] = ()  # texts of hash grids
    text: str = field(init=False, compare=False)  # the program as a string, which ops take
    orders: int = field(init=False, compare=False)  # the highest derivative of a function in it; see _order
    tables: tuple[int, ...] = field(init=False, compare=False)  # parameters that are tables of grids
    sum_tables: tuple[int | None, ...] = field(init=False, compare=False)  # the table whose layout each sum has

    def __post_init__(self) -> None:
        check(self)
        parts = [self.inputs, self.parameters, self.steps, self.outputs, self.sums, self.rays, self.by_ray, self.grids]
        object.__setattr__(self, "text", json.dumps(parts))
        object.__setattr__(self, "orders", max(map(_order, self.steps), default=0))
        read = {int(step.numbers[1]) for step in self.steps if _reads_table(step)}
        object.__setattr__(self, "tables", tuple(sorted(read)))
        of_sums = {step.out: int(step.numbers[1]) for step in self.steps if step.op == "scatter"}
        object.__setattr__(self, "sum_tables", tuple(of_sums.get(index) for index in range(len(self.sums))))

    def __hash__(self) -> int:
        return hash(self.text)  # which is kept

    @staticmethod
    @functools.lru_cache(maxsize=1024)
    def parse(text: str) -> Program:
        """The program of a string."""
        inputs, parameters, steps, outputs, sums, *others = json.loads(text)
        shapes = [tuple(map(tuple, given)) for given in (parameters, sums)]
        known = [
            Step(op, out, width, tuple(Columns(*each) for each in operands), tuple(numbers), name)
            for op, out, width, operands, numbers, name in steps
        ]
        results = tuple(Columns(*each) for each in outputs)
        return Program(tuple(inputs), shapes[0], tuple(known), results, shapes[1], *map(tuple, others))

    def cells_of_sums(self, parameters: Sequence[Tensor], k: int) -> list[int]:
        """For how many cells each sum has entries: 1 if it is that of a table [1, e, f] that all share, else k."""
        return [k if table is None else parameters[table].shape[0] for table in self.sum_tables]


_WIDEST = 1 << 20  # columns
_ORDERS = 20  # of derivatives


def _order(step: Step) -> int:
    """The derivative of a function in a step. Of encodings the compiled module has F_0, G_1 and T_0, and any further
    derivative counts as one that it has of no function."""
    if step.op == "function":
        return int(step.numbers[0])
    further = step.op == "encode" and step.numbers[2] > step.numbers[3]
    return _ORDERS if further or (step.op == "scatter" and step.numbers[2] > 0) else 0


def check(program: Program) -> None:
    """Raises ValueError unless a program reads and writes what is there alone."""
    inputs, parameters, sums, grids = program.inputs, program.parameters, program.sums, program.grids
    values: dict[int, Step] = {}  # what makes them
    tables: dict[int, bool] = {}  # whether a parameter that is read is the table of a grid
    summed: dict[int, int] = {}  # the table whose gradient a sum is; -1 for none
    _rule("inputs", _sizes(inputs), inputs)
    _rule("grids", isinstance(grids, tuple) and all(map(_is_grid, grids)), grids, "texts of hash grids")
    large = {HashGrid.parse(text).table_shape for text in grids}
    for name, shapes in (("parameters", parameters), ("sums", sums)):
        known = isinstance(shapes, tuple)
        known = known and all((_sizes(shape) and len(shape) in (1, 2)) or shape in large for shape in shapes)
        _rule(name, known, shapes)
    _rule("rays", _numbers(program.rays, len(inputs)), program.rays, "numbers of inputs, each once")

    def fits(columns: Any, *widths: int, rows: bool = False) -> bool:
        """Whether columns are there, of one of these widths if any are given; or even each a column of a value."""
        if not isinstance(columns, Columns) or not _sizes(columns[1:4]) or not isinstance(columns.spread, bool):
            return False
        of, index, start, width, spread = columns
        if of == VALUE:
            there = values[index].width if index in values else -1
        else:
            known = of == PARAMETER and index < len(parameters) and not tables.setdefault(index, False)
            there = math.prod(parameters[index]) if known else -1
        inside = start + (1 if spread else width) <= there
        return inside and (not widths or width in widths) and not (rows and (spread or of != VALUE))

    def hashed(x: Columns, grid: int, table: int) -> bool:
        """Whether columns are positions for a grid, a whole input that is not of rays, and a parameter is its table."""
        maker = values[x.index]
        whole = maker.op == "input" and maker.numbers[0] not in program.rays and x.width == maker.width == 3
        there = whole and grid < len(grids) and table < len(parameters)
        return there and parameters[table] == HashGrid.parse(grids[grid]).table_shape and tables.setdefault(table, True)

    def encodes(step: Step) -> bool:
        operands, numbers = step.operands, step.numbers
        if not (operands and all(fits(each, rows=True) for each in operands) and _sizes(numbers) and len(numbers) == 4):
            return False
        (x, *rest), (size, table, order, back) = operands, map(int, numbers)
        if step.name == HASH:
            known = hashed(x, size, table)
        else:
            known = table == 0 and step.name in ENCODINGS and ENCODINGS[step.name].fits(x.width, size)
        if not (known and back < 2 and back <= order < _ORDERS):
            return False
        encoded = encoded_columns(step.name, x.width, size, grids)
        widths = [encoded] * back + [x.width] * (order - back)
        if order == back == 1:
            value = Step("encode", rest[-1].index, encoded, (x,), (size, table, 0, 0), step.name)
            if values[rest[-1].index] != value:
                return False
            widths.append(encoded)
        return step.width == (x.width if back else encoded) and [each.width for each in rest] == widths

    def scatters(step: Step) -> bool:
        operands, numbers = step.operands, step.numbers
        if not (len(operands) > 1 and all(fits(each, rows=True) for each in operands)):
            return False
        if not (_sizes(numbers) and len(numbers) == 3 and numbers[2] < _ORDERS):
            return False
        (x, *rest), (grid, table, order) = operands, map(int, numbers)
        if not (hashed(x, grid, table) and sums[step.out] == parameters[table]):
            return False
        encoded = encoded_columns(HASH, 3, grid, grids)
        return [step.width, *(each.width for each in rest)] == [encoded, encoded] + [3] * order

    def right(step: Step) -> bool:
        op, _, width, operands, numbers, name = step
        count, whole = len(operands), _sizes(numbers)
        if op == "input":
            return whole and len(numbers) == 1 and numbers[0] < len(inputs) and width == inputs[int(numbers[0])]
        if op == "encode":
            return encodes(step)
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
            if not (depth and width):  # the products walk them with loops that test at the end
                return False
            inside = (depth, start + width) if transposed else (width, start + depth)
            spread = any(isinstance(each, Columns) and each.spread for each in operands[1:])
            _rule("steps", not spread, step, "without spread columns in what a linear one adds")
            others = all(fits(each, width, rows=each.of == VALUE) for each in operands[1:])
            return inside[0] == o and inside[1] <= i and others and not tables.setdefault(matrix, False)
        if not _sums(step) or step.out >= len(sums):
            return False
        if op == "scatter":
            return scatters(step) and summed.setdefault(step.out, int(numbers[1])) == numbers[1]
        if not (whole and len(numbers) == 1) or summed.setdefault(step.out, -1) >= 0:
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
            values[step.out] = step
    _rule("outputs", isinstance(program.outputs, tuple) and all(map(fits, program.outputs)), program.outputs)
    known = _numbers(program.by_ray, len(program.outputs)) and bool(program.rays or not program.by_ray)
    _rule("by_ray", known, program.by_ray, "numbers of outputs, each once, of a program with rays")


_FINISHES = ("", "relu", "relu_slope")
_STEPS = ("input", "linear", "function", "binary", "total", "move", "encode", "outer", "columns", "scatter")


def _sizes(values: Any) -> bool:
    """Whether all values are columns that can be counted."""
    return isinstance(values, tuple) and all(type(value) is int and 0 <= value <= _WIDEST for value in values)


def _numbers(values: Any, count: int) -> bool:
    """Whether values are different numbers of so many things."""
    return _sizes(values) and all(value < count for value in values) and len(set(values)) == len(values)


def _is_grid(text: Any) -> bool:
    """Whether something is the text of a grid."""
    try:
        return isinstance(text, str) and HashGrid.parse(text).text == text
    except (ValueError, TypeError, LookupError, AttributeError):
        return False


def _rule(name: str, kept: bool, given: object, rule: str = "of values, parameters and sums that are there") -> None:
    if not kept:
        raise ValueError(f"Program: {name} must be {rule}, got {given!r:.100}")


class Builder:
    """Makes a program step by step. A step that is there already is not made twice.

    Args:
        program: to start from.
    """

    def __init__(self, program: Program | None = None) -> None:
        program = program or Program((), (), (), ())
        self.inputs, self.parameters = list(program.inputs), list(program.parameters)
        self.steps = list(program.steps)
        self.sums, self.rays, self.grids = list(program.sums), list(program.rays), list(program.grids)
        self._makers = {step.out: step for step in self.steps if not _sums(step)}
        self._values = max(self._makers, default=-1) + 1
        made = self._makers.values()
        self._made = {step._replace(out=0): Columns(VALUE, step.out, 0, step.width) for step in made}

    def program(self, outputs: Iterable[Columns], by_ray: Iterable[int] = ()) -> Program:
        """What has been made; ``by_ray`` numbers the outputs that are sums over the samples of each ray."""
        given = (self.inputs, self.parameters, self.steps, outputs, self.sums, self.rays, by_ray, self.grids)
        return Program(*map(tuple, given))  # type: ignore[arg-type]

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

    def input(self, width: int, ray: bool = False) -> Columns:
        """Another input, with one row for each ray if ``ray``."""
        self.inputs.append(width)
        if ray:
            self.rays.append(len(self.inputs) - 1)
        return self.emit("input", width, (), (len(self.inputs) - 1,))

    def parameter(self, *shape: int) -> int:
        """Another parameter: its number."""
        self.parameters.append(shape)
        return len(self.parameters) - 1

    def grid(self, text: str) -> int:
        """The number of a hash grid, by its text."""
        if text not in self.grids:
            self.grids.append(text)
        return self.grids.index(text)

    def replay(self, program: Program, inputs: Mapping[int, Columns]) -> list[Columns]:
        """Adds the steps of a program without sums, and gives its outputs; its parameters become further ones.

        Args:
            program: whose steps.
            inputs: what takes the place of its inputs that are read, by their numbers.
        """
        first, grids = len(self.parameters), [self.grid(text) for text in program.grids]
        self.parameters += program.parameters
        values: dict[int, Columns] = {}

        def own(c: Columns) -> Columns:
            if c.of == PARAMETER:
                return c._replace(index=first + c.index)
            return values[c.index].part(c.start, c.width)._replace(spread=c.spread)

        for step in program.steps:
            numbers = step.numbers
            if step.op == "input":
                values[step.out] = self.rows(inputs[int(numbers[0])])
                continue
            if step.op == "linear":
                numbers = (first + int(numbers[0]), *numbers[1:])
            elif step.op == "encode" and step.name == HASH:
                numbers = (grids[int(numbers[0])], first + int(numbers[1]), *numbers[2:])
            values[step.out] = self.emit(step.op, step.width, [own(c) for c in step.operands], numbers, step.name)
        return [own(c) for c in program.outputs]

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

    def side_by_side(self, parts: Sequence[Columns]) -> Columns:
        """Columns next to each other; as they are where they lie so already."""
        joined, places, at = parts[0], [], 0
        for each in parts[1:]:
            following = joined.part(joined.width, each.width)
            joined = joined._replace(width=joined.width + each.width) if following == each else joined
        width = sum(each.width for each in parts)
        if joined.width == width and joined.of == VALUE and not joined.spread:
            return joined
        for each in parts:
            places.append((each, at))
            at += each.width
        return self.move(width, places)

    def encode(self, name: str, x: Columns, size: int, parameter: int = 0, along: Sequence[Columns] = ()) -> Columns:
        """An encoding F_0(x), or its derivative F_m along m values.

        Args:
            name: one of :data:`ENCODINGS`, or "hash".
            x: to encode; of "hash" a whole input.
            size: the encoding's; of "hash" the number of the grid.
            parameter: the table of "hash".
            along: the directions of the derivative, each as wide as x.
        """
        operands = [self.rows(each) for each in (x, *along)]
        width = encoded_columns(name, x.width, size, self.grids)
        return self.emit("encode", width, operands, (size, parameter, len(along), 0), name)

    def encode_backward(
        self, name: str, x: Columns, g: Columns, size: int, parameter: int = 0, along: Sequence[Columns] = ()
    ) -> Columns:
        """The gradient to x of ``<g, F_m(x; along)>``, which is G_m+1; arguments as of :meth:`encode`."""
        operands = [self.rows(each) for each in (x, g, *along)]
        if not along:
            operands.append(self.encode(name, x, size, parameter))
        return self.emit("encode", x.width, operands, (size, parameter, len(along) + 1, 1), name)

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

    def add_scatter(
        self, index: int, x: Columns, g: Columns, grid: int, parameter: int, along: Sequence[Columns] = ()
    ) -> None:
        """Adds the gradient to a table of ``<g, F_m(x; along)>`` to a sum [e, f]."""
        operands = tuple(self.rows(each) for each in (x, g, *along))
        self.steps.append(Step("scatter", index, g.width, operands, (grid, parameter, len(along))))


def _sums(step: Step) -> bool:
    return step.op in ("outer", "columns", "scatter")


def _reads_table(step: Step) -> bool:
    return step.op == "scatter" or (step.op == "encode" and step.name == HASH)


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
        whose sums are those of parameters. Gradients of inputs of rays are summed by ray, those of outputs that are
        summed by ray are inputs of rays. The gradient of a table that all cells share is [1, e, f], that of any other
        parameter has k cells.
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
            depends = depends or (_reads_table(step) and int(step.numbers[1]) in wanted)
        if depends and step.name != "stop":
            active.add(step.out)
    widths = {step.out: step.width for step in b.steps}
    arriving = _Arriving(b, active, wanted, widths)
    for index, (columns, given) in enumerate(zip(program.outputs, outputs, strict=True)):
        if given:
            arriving.add(columns, b.input(columns.width, ray=index in program.by_ray))
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
        elif step.op == "encode":
            _of_encode(b, arriving, step, g)
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
    asked = [i for i, want in enumerate(inputs) if want]
    results = [found.get(i) or b.move(program.inputs[i], []) for i in asked]
    return pruned(b.program(results, [at for at, i in enumerate(asked) if i in program.rays]))


def _of_sum(b: Builder, arriving: _Arriving, step: Step, parameter: int) -> None:
    if step.op == "scatter":
        # <C, T_m(x, g; h ..)> is <g, F_m(x; h ..)> with C as the table.
        x, g, *along = step.operands
        _of_product(b, arriving, HASH, int(step.numbers[0]), parameter, x, g, along)
        return
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
        if step.name == "relu" and order == 0:
            # What ReLU returns tells its slope too, and the value before it need not be kept. It stops any gradient, as
            # in PyTorch: 0 times an infinite one would be NaN.
            arriving.add(x, b.binary("gate", g, Columns(VALUE, step.out, 0, step.width)))
            return
        arriving.add(x, b.function(step.name, x, a, c, int(order) + 1, g))


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


def _of_encode(b: Builder, arriving: _Arriving, step: Step, g: Columns) -> None:
    size, parameter, order, back = map(int, step.numbers)
    x, *along = step.operands
    if back:
        # Where c arrives, <c, G_m(x, g; h ..)> is <g, F_m(x; h .., c)>. An encoded value has no gradient of its own.
        g, along = along[0], [*along[1:order], g]
    _of_product(b, arriving, step.name, size, parameter, x, g, along)


def _of_product(
    b: Builder,
    arriving: _Arriving,
    name: str,
    size: int,
    parameter: int,
    x: Columns,
    g: Columns,
    along: Sequence[Columns],
) -> None:
    """The gradients of ``<g, F_m(x; along)>`` to all that it reads. What has arrived itself wants none."""
    if arriving.wants(g):
        arriving.add(g, b.encode(name, x, size, parameter, along))
    if arriving.wants(x):
        arriving.add(x, b.encode_backward(name, x, g, size, parameter, along))
    for place, direction in enumerate(along):
        if arriving.wants(direction):
            others = [*along[:place], *along[place + 1 :]]
            arriving.add(direction, b.encode_backward(name, x, g, size, parameter, others))
    if name == HASH and parameter in arriving.sums:
        b.add_scatter(arriving.sums[parameter], x, g, size, parameter, along)


class Ahead(NamedTuple):
    """An encoding that is computed before a program runs: of ``width`` columns of an input from ``start`` on."""

    input: int
    start: int
    width: int
    name: str
    size: int


@functools.lru_cache(maxsize=64)
def encoded_ahead(program: Program, chosen: tuple[bool, ...]) -> tuple[Program, tuple[Ahead, ...]]:
    """The same with further inputs in the place of encodings, but for hash grids, of those inputs that are chosen."""
    ahead, steps, inputs, rays = list[Ahead](), list[Step](), list(program.inputs), list(program.rays)
    read = {step.out: int(step.numbers[0]) for step in program.steps if step.op == "input"}
    for step in program.steps:
        number = read.get(step.operands[0].index, -1) if step.op == "encode" and step.name != HASH else -1
        if number >= 0 and chosen[number] and not step.numbers[2]:
            _, _, start, width, _ = step.operands[0]
            ahead.append(Ahead(number, start, width, step.name, int(step.numbers[0])))
            step = Step("input", step.out, step.width, (), (len(inputs),))
            rays += [len(inputs)] if number in program.rays else []
            inputs.append(step.width)
        steps.append(step)
    return replace(program, inputs=tuple(inputs), steps=tuple(steps), rays=tuple(rays)), tuple(ahead)


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
        slope = step.op == "binary" and step.name == "gate"
        if not slope and (step.op != "function" or step.name != "relu" or step.numbers[0] or len(step.operands) > 1):
            continue
        source, *known = step.operands
        if any(c.of != VALUE or c.spread or c.start for c in step.operands) or uses[source.index] != 1:
            continue
        before = kept[made[source.index]]
        if before.op != "linear" or before.name or before.width != source.width:
            continue
        if slope:
            first = kept[made[known[0].index]]  # what is not 0 behind a ReLU is where it lets gradients through
            there = made[known[0].index] < made[source.index] and first.width == step.width
            if not there or first.name != "relu":
                continue
            kept[made[source.index]] = before._replace(
                out=step.out, operands=(*before.operands, known[0]), name="relu_slope"
            )
        else:
            kept[made[source.index]] = before._replace(out=step.out, name="relu")
        made[step.out] = made[source.index]
        dropped.add(place)
    steps = tuple(step for place, step in enumerate(kept) if place not in dropped)
    return replace(program, steps=steps)
