"""Programs: sequences of steps that an op runs on the rows of each cell.

A program takes inputs with one row for each sample, [n, w], and parameters with one entry for each cell, [k, o, i] or
[k, w]. Its steps compute values, [n, w], and sums over the rows of a cell. Rows are samples of rays: an input may have
one row for each ray, [r, w], and an output may be the sum over each ray's samples. The gradient of a program is a
program (:func:`gradient`), so the same kernels run derivatives of every order.

Letters: n rows, r rays, k cells, w columns of a value, o outputs and i inputs of a matrix, e entries and f features of
the table of a hash grid, m the order of a derivative.

The steps:

    input      the columns of an input
    linear     x W^T, or x W if transposed, plus an optional value; W is a matrix from its input column ``start`` on
    function   f(x), times an optional value; f is one of :data:`FUNCTIONS` or a derivative of one
    binary     one of :data:`BINARY` of two values
    total      the sums over groups of adjacent columns
    move       columns of values, placed side by side; overlapping columns are added
    encode     an encoding of columns (one of :data:`ENCODINGS`, or "hash"), or a derivative of one
    outer      g^T x, summed over the rows of a cell: the gradient of a matrix
    columns    the sum over the rows of a cell: the gradient of a vector
    scatter    the gradient of a table, summed over the rows of a cell, or over all rows if the cells share the table

The derivatives of an encoding e(x), which may have a table T, are closed under differentiation:

    F_m(x; h_1 .. h_m)        the m-th derivative of e at x along h_1, ..., h_m, with as many columns as e(x)
    G_m(x, g; h_1 .. h_m-1)   the gradient with respect to x of <g, F_m-1(x; h_1 .. h_m-1)>, with as many columns as x
    T_m(x, g; h_1 .. h_m)     the gradient with respect to the table of <g, F_m(x; h_1 .. h_m)>, which a scatter sums
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
    """An elementwise function with two numbers a and b.

    Attributes:
        formula: (x, a, b) -> f(x), in PyTorch. The compiled module has f and its derivatives
            (csrc/network/functions.h).
        orders: the order of the highest derivative that is not 0.
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
    "hardtanh": Function(lambda x, a, b: F.hardtanh(x, a, b), 1),
    "elu": Function(lambda x, a, b: F.elu(x, a)),
    "softplus": Function(lambda x, a, b: F.softplus(x, a, b)),
    "sigmoid": Function(lambda x, a, b: x.sigmoid()),
    "tanh": Function(lambda x, a, b: x.tanh()),
    "silu": Function(lambda x, a, b: F.silu(x)),
    "gelu": Function(lambda x, a, b: F.gelu(x)),
    "gelu_tanh": Function(lambda x, a, b: F.gelu(x, approximate="tanh")),
    "sine": Function(lambda x, a, b: torch.sin(a * x + b)),
    "exp": Function(lambda x, a, b: x.exp()),
    "expm1": Function(lambda x, a, b: x.expm1()),
    "log": Function(lambda x, a, b: x.log()),
    "log1p": Function(lambda x, a, b: x.log1p()),
    "power": Function(lambda x, a, b: x**a),
    "erf": Function(lambda x, a, b: x.erf()),
    "atan": Function(lambda x, a, b: x.atan()),
}
"""The elementwise functions, by name in the compiled module."""

BINARY: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "div": torch.div,
    "gate": lambda x, y: torch.where(y != 0, x, 0),  # x where y is not 0, else 0
}
"""The functions of two values, by name in the compiled module."""

HASH = "hash"
"""The name of ``hash_encode``, the only encoding with a parameter; it is not in :data:`ENCODINGS`."""


def encoded_columns(name: str, raw: int, size: int, grids: Sequence[str] = ()) -> int:
    """Returns the number of columns of an encoding.

    Args:
        name: one of :data:`ENCODINGS`, or "hash".
        raw: the number of columns before encoding.
        size: the encoding's size; for "hash" the index of the grid.
        grids: the texts of the grids.
    """
    return HashGrid.parse(grids[size]).out_features if name == HASH else ENCODINGS[name].columns(raw, size)


class Columns(NamedTuple):
    """A range of columns of a value or of a parameter: an operand of a step.

    Attributes:
        of: "value" or "parameter".
        index: the index of the value or parameter.
        start: the first column; for a parameter, the first entry in its flattened shape.
        width: the number of columns.
        spread: whether one column is broadcast to ``width`` columns.
    """

    of: str
    index: int  # type: ignore[assignment]  # hides a method of tuple
    start: int
    width: int
    spread: bool = False

    def part(self, start: int, width: int) -> Columns:
        """Returns a subrange of the columns."""
        return self._replace(start=self.start + (0 if self.spread else start), width=width)


class Step(NamedTuple):
    """One step of a program.

    Attributes:
        op: the name of the operation, see the table above.
        out: the index of the computed value; for outer, columns and scatter, the index of the sum.
        width: the number of columns of the value; for a scatter, the columns of g.
        operands: the columns that the step reads. linear: x, an optional addend, and the operand of ``relu_slope``.
            function: x and an optional factor. encode, scatter: the arguments of F_m, G_m or T_m, which are columns of
            values, not of parameters. G_1 has F_0(x) as a third operand, which kernels reuse. No gradient flows to this
            operand, because it depends on x and the table alone.
        numbers: input: (index,). linear: (parameter, start, transposed). function: (order, a, b). total: (group size,).
            move: the first target column of each operand. outer, columns: (start,). encode: (size, parameter, m, back):
            the size as in :func:`encoded_columns`, the parameter with the table of "hash" or 0, the order, and back = 0
            for F_m or 1 for G_m. scatter: (grid, parameter, m); the parameter's table has the layout of the sum.
        name: the name of the function, binary function or encoding. linear: "" or a fused "relu" or "relu_slope".
    """

    op: str
    out: int
    width: int
    operands: tuple[Columns, ...] = ()
    numbers: tuple[float, ...] = ()
    name: str = ""


@dataclass(frozen=True)
class Program:
    """A program on the rows of a cell.

    Raises:
        ValueError: a step, an output or a sum refers to something that does not exist. The kernels do not check this.
    """

    inputs: tuple[int, ...]  # the number of columns of each input
    parameters: tuple[tuple[int, ...], ...]  # the shape of each parameter for one cell, (o, i), (w,) or (e, f)
    steps: tuple[Step, ...]  # the steps, in order
    outputs: tuple[Columns, ...]  # the columns of each result, [n, w]
    sums: tuple[tuple[int, ...], ...] = ()  # the shape of each sum over rows, for one cell
    rays: tuple[int, ...] = ()  # the inputs with one row for each ray, [r, w]
    by_ray: tuple[int, ...] = ()  # the outputs summed over the samples of each ray, [r, w]
    grids: tuple[str, ...] = ()  # the texts of the hash grids
    text: str = field(init=False, compare=False)  # the program as JSON, the argument of ops
    orders: int = field(init=False, compare=False)  # the highest order of derivative of a step; see _order
    tables: tuple[int, ...] = field(init=False, compare=False)  # the parameters that are tables of grids
    first_layer: int = field(init=False, compare=False)  # the first parameter that is no table, or -1
    encodes: bool = field(init=False, compare=False)  # whether a step is an encoding without parameters
    sum_tables: tuple[int | None, ...] = field(init=False, compare=False)  # the table whose gradient each sum is

    def __post_init__(self) -> None:
        check(self)
        parts = [self.inputs, self.parameters, self.steps, self.outputs, self.sums, self.rays, self.by_ray, self.grids]
        object.__setattr__(self, "text", json.dumps(parts))
        object.__setattr__(self, "orders", max(map(_order, self.steps), default=0))
        read = {int(step.numbers[1]) for step in self.steps if _reads_table(step)}
        object.__setattr__(self, "tables", tuple(sorted(read)))
        first = next((i for i in range(len(self.parameters)) if i not in read), -1)
        object.__setattr__(self, "first_layer", first)
        encodes = any(step.op == "encode" and step.name != HASH for step in self.steps)
        object.__setattr__(self, "encodes", encodes)
        tables_of_sums = {step.out: int(step.numbers[1]) for step in self.steps if step.op == "scatter"}
        object.__setattr__(self, "sum_tables", tuple(tables_of_sums.get(index) for index in range(len(self.sums))))

    def __hash__(self) -> int:
        return hash(self.text)  # Python caches the hash of a str

    @staticmethod
    @functools.lru_cache(maxsize=1024)
    def parse(text: str) -> Program:
        """Parses a program from its text."""
        inputs, parameters, steps, outputs, sums, *others = json.loads(text)
        shapes = [tuple(map(tuple, shape_lists)) for shape_lists in (parameters, sums)]
        parsed_steps = [
            Step(op, out, width, tuple(Columns(*columns) for columns in operands), tuple(numbers), name)
            for op, out, width, operands, numbers, name in steps
        ]
        results = tuple(Columns(*columns) for columns in outputs)
        return Program(tuple(inputs), shapes[0], tuple(parsed_steps), results, shapes[1], *map(tuple, others))

    def cells_of_sums(self, parameters: Sequence[Tensor], k: int) -> list[int]:
        """Returns the number of cells of each sum: 1 if it is the gradient of a shared table [1, e, f], else k."""
        return [k if table is None else parameters[table].shape[0] for table in self.sum_tables]


class Names(NamedTuple):
    """The names of an op and of its tensors in error messages; by default ``inputs[0]``, ``parameters[0]`` and so on.

    Attributes:
        op: the name of the op.
        inputs: the name of each input.
        parameters: the name of each parameter.
        ray_index: the name of the ray index.
    """

    op: str = "Network"
    inputs: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    ray_index: str = "ray_index"

    def of(self, kind: str, i: int) -> str:
        """Returns the name of input or parameter ``i``; ``kind`` is "inputs" or "parameters"."""
        names: tuple[str, ...] = getattr(self, kind)
        return names[i] if names else f"{kind}[{i}]"


def among(i: int, numbers: Sequence[int]) -> bool:
    """Returns whether a number is in a list; ``in`` fails if torch.compile makes the list's numbers symbolic."""
    return any(i == number for number in numbers)


_WIDEST = 1 << 20  # the largest number of columns
_ORDERS = 20  # orders of derivatives are below this


def _order(step: Step) -> int:
    """Returns the order of derivative of a step.

    The compiled module has F_0, G_1 and T_0 of an encoding. Every higher derivative of an encoding counts as order
    `_ORDERS`, which exceeds every order that the compiled module supports.
    """
    if step.op == "function":
        return int(step.numbers[0])
    further = step.op == "encode" and step.numbers[2] > step.numbers[3]
    return _ORDERS if further or (step.op == "scatter" and step.numbers[2] > 0) else 0


def check(program: Program) -> None:
    """Raises ValueError unless all indices and column ranges of a program are within bounds."""
    inputs, parameters, sums, grids = program.inputs, program.parameters, program.sums, program.grids
    values: dict[int, Step] = {}  # the step that computes each value
    tables: dict[int, bool] = {}  # parameter -> whether it is the table of a grid
    summed: dict[int, int] = {}  # sum -> the table whose gradient it is, -1 if none
    _require("inputs", _are_sizes(inputs), inputs)
    _require("grids", isinstance(grids, tuple) and all(map(_is_grid, grids)), grids, "texts of hash grids")
    large = {HashGrid.parse(text).table_shape for text in grids}
    for name, shapes in (("parameters", parameters), ("sums", sums)):
        valid = isinstance(shapes, tuple)
        valid = valid and all((_are_sizes(shape) and len(shape) in (1, 2)) or shape in large for shape in shapes)
        _require(name, valid, shapes)
    _require("rays", _are_indices(program.rays, len(inputs)), program.rays, "distinct indices of inputs")

    def fits(columns: Any, *widths: int, rows: bool = False) -> bool:
        """Returns whether columns exist and have one of the widths; ``rows`` allows only values without broadcast."""
        if not isinstance(columns, Columns) or not _are_sizes(columns[1:4]) or not isinstance(columns.spread, bool):
            return False
        of, index, start, width, spread = columns
        if of == VALUE:
            available = values[index].width if index in values else -1
        else:
            valid = of == PARAMETER and index < len(parameters) and not tables.setdefault(index, False)
            available = math.prod(parameters[index]) if valid else -1
        inside = start + (1 if spread else width) <= available
        return inside and (not widths or width in widths) and not (rows and (spread or of != VALUE))

    def hashed(x: Columns, grid: int, table: int) -> bool:
        """Returns whether ``x`` is an entire per-sample input [n, 3], and the parameter can be the grid's table."""
        maker = values[x.index]
        whole = maker.op == "input" and maker.numbers[0] not in program.rays and x.width == maker.width == 3
        available = whole and grid < len(grids) and table < len(parameters)
        return (
            available
            and parameters[table] == HashGrid.parse(grids[grid]).table_shape
            and tables.setdefault(table, True)
        )

    def encodes(step: Step) -> bool:
        operands, numbers = step.operands, step.numbers
        if not (
            operands and all(fits(each, rows=True) for each in operands) and _are_sizes(numbers) and len(numbers) == 4
        ):
            return False
        (x, *rest), (size, table, order, back) = operands, map(int, numbers)
        if step.name == HASH:
            valid = hashed(x, size, table)
        else:
            valid = table == 0 and step.name in ENCODINGS and ENCODINGS[step.name].fits(x.width, size)
        if not (valid and back < 2 and back <= order < _ORDERS):
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
        if not (_are_sizes(numbers) and len(numbers) == 3 and numbers[2] < _ORDERS):
            return False
        (x, *rest), (grid, table, order) = operands, map(int, numbers)
        if not (hashed(x, grid, table) and sums[step.out] == parameters[table]):
            return False
        encoded = encoded_columns(HASH, 3, grid, grids)
        return [step.width, *(each.width for each in rest)] == [encoded, encoded] + [3] * order

    def step_is_valid(step: Step) -> bool:
        op, _, width, operands, numbers, name = step
        count, whole = len(operands), _are_sizes(numbers)
        if op == "input":
            return whole and len(numbers) == 1 and numbers[0] < len(inputs) and width == inputs[int(numbers[0])]
        if op == "encode":
            return encodes(step)
        if op == "function":
            valid = name in FUNCTIONS and len(numbers) == 3 and _are_sizes(numbers[:1]) and numbers[0] < _ORDERS
            return valid and count in (1, 2) and all(fits(each, width) for each in operands)
        if op == "binary":
            return name in BINARY and count == 2 and all(fits(each, width) for each in operands)
        if op == "total":
            return whole and len(numbers) == count == 1 and fits(operands[0], width * int(numbers[0]), rows=True)
        if op == "move":
            places = whole and len(numbers) == count and all(map(fits, operands))
            return places and all(at + each.width <= width for each, at in zip(operands, numbers))
        if op == "linear":
            valid = whole and len(numbers) == 3 and name in _FINISHES
            if not (valid and numbers[0] < len(parameters) and numbers[2] < 2):
                return False
            (matrix, start, transposed), extra = map(int, numbers), name == "relu_slope"
            o, i = (*parameters[matrix], -1)[:2]
            if not (count in (1 + extra, 2 + extra) and fits(operands[0], rows=True)):
                return False
            depth = operands[0].width
            if not (depth and width):  # the loops of the matrix products run at least once
                return False
            inside = (depth, start + width) if transposed else (width, start + depth)
            spread = any(isinstance(each, Columns) and each.spread for each in operands[1:])
            _require("steps", not spread, step, "without spread columns in the addends of a linear step")
            others = all(fits(each, width, rows=each.of == VALUE) for each in operands[1:])
            return inside[0] == o and inside[1] <= i and others and not tables.setdefault(matrix, False)
        if not _is_sum(step) or step.out >= len(sums):
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

    _require("steps", isinstance(program.steps, tuple), program.steps)
    for step in program.steps:
        well_formed = isinstance(step, Step) and _are_sizes(step[1:3]) and step.op in _STEPS
        well_formed = well_formed and isinstance(step.operands, tuple) and isinstance(step.numbers, tuple)
        _require("steps", well_formed and step_is_valid(step) and (_is_sum(step) or step.out not in values), step)
        if not _is_sum(step):
            values[step.out] = step
    _require("outputs", isinstance(program.outputs, tuple) and all(map(fits, program.outputs)), program.outputs)
    valid = _are_indices(program.by_ray, len(program.outputs)) and bool(program.rays or not program.by_ray)
    _require("by_ray", valid, program.by_ray, "distinct indices of outputs, in a program with per-ray inputs")


_FINISHES = ("", "relu", "relu_slope")
_STEPS = ("input", "linear", "function", "binary", "total", "move", "encode", "outer", "columns", "scatter")


def _are_sizes(values: Any) -> bool:
    """Returns whether the values are a tuple of integers from 0 to `_WIDEST`."""
    return isinstance(values, tuple) and all(type(value) is int and 0 <= value <= _WIDEST for value in values)


def _are_indices(values: Any, count: int) -> bool:
    """Returns whether the values are distinct indices below ``count``."""
    return _are_sizes(values) and all(value < count for value in values) and len(set(values)) == len(values)


def _is_grid(text: Any) -> bool:
    """Returns whether an object is the text of a grid."""
    try:
        return isinstance(text, str) and HashGrid.parse(text).text == text
    except (ValueError, TypeError, LookupError, AttributeError):
        return False


def _require(name: str, ok: bool, value: object, rule: str = "made of existing values, parameters and sums") -> None:
    if not ok:
        raise ValueError(f"Program: {name} must be {rule}, got {value!r:.100}")


class Builder:
    """A builder of programs, step by step. Instead of a step equal to an earlier one, it reuses the earlier value.

    Args:
        program: the program to extend; by default an empty one.
    """

    def __init__(self, program: Program | None = None) -> None:
        program = program or Program((), (), (), ())
        self.inputs, self.parameters = list(program.inputs), list(program.parameters)
        self.steps = list(program.steps)
        self.sums, self.rays, self.grids = list(program.sums), list(program.rays), list(program.grids)
        self._makers = {step.out: step for step in self.steps if not _is_sum(step)}
        self._values = max(self._makers, default=-1) + 1
        makers = self._makers.values()
        self._by_step = {step._replace(out=0): Columns(VALUE, step.out, 0, step.width) for step in makers}

    def program(self, outputs: Iterable[Columns], by_ray: Iterable[int] = ()) -> Program:
        """Returns the program; ``by_ray`` has the indices of the outputs that are summed over each ray's samples."""
        parts = (self.inputs, self.parameters, self.steps, outputs, self.sums, self.rays, by_ray, self.grids)
        return Program(*map(tuple, parts))  # type: ignore[arg-type]

    def emit(
        self, op: str, width: int, operands: Sequence[Columns] = (), numbers: Sequence[float] = (), name: str = ""
    ) -> Columns:
        """Adds a step, unless an equal one exists, and returns the columns of its value."""
        key = Step(op, 0, width, tuple(operands), tuple(numbers), name)
        if key not in self._by_step:
            self._by_step[key] = Columns(VALUE, self._values, 0, width)
            self.steps.append(key._replace(out=self._values))
            self._makers[self._values] = self.steps[-1]
            self._values += 1
        return self._by_step[key]

    def input(self, width: int, ray: bool = False) -> Columns:
        """Adds an input, with one row for each ray if ``ray``, and returns its columns."""
        self.inputs.append(width)
        if ray:
            self.rays.append(len(self.inputs) - 1)
        return self.emit("input", width, (), (len(self.inputs) - 1,))

    def parameter(self, *shape: int) -> int:
        """Adds a parameter and returns its index."""
        self.parameters.append(shape)
        return len(self.parameters) - 1

    def grid(self, text: str) -> int:
        """Returns the index of a hash grid, and adds the grid if it is new."""
        if text not in self.grids:
            self.grids.append(text)
        return self.grids.index(text)

    def replay(self, program: Program, inputs: Mapping[int, Columns]) -> list[Columns]:
        """Inlines a program without sums: adds its parameters and steps, and returns its outputs.

        Args:
            program: the program to inline.
            inputs: the columns that replace the inputs of the program, by index; unread inputs may be missing.
        """
        first, grids = len(self.parameters), [self.grid(text) for text in program.grids]
        self.parameters += program.parameters
        values: dict[int, Columns] = {}

        def mapped(c: Columns) -> Columns:
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
            values[step.out] = self.emit(step.op, step.width, [mapped(c) for c in step.operands], numbers, step.name)
        return [mapped(c) for c in program.outputs]

    def linear(
        self, x: Columns, matrix: int, width: int, start: int = 0, transposed: bool = False, add: Columns | None = None
    ) -> Columns:
        """Adds the step ``x W[:, start:]^T`` (if transposed, ``x W[:, start:]``) + ``add``, of ``width`` columns."""
        operands = (self.rows(x),) if add is None else (self.rows(x), self.rows(add) if add.spread else add)
        return self.emit("linear", width, operands, (matrix, start, int(transposed)))

    def function(
        self, name: str, x: Columns, a: float = 0.0, b: float = 0.0, order: int = 0, times: Columns | None = None
    ) -> Columns | None:
        """Adds a step with a derivative of a function, multiplied by ``times``; returns None if the derivative is 0."""
        if order > FUNCTIONS[name].orders or (name == "power" and a == int(a) and 0 <= a < order):
            return None
        if order == 1 and times is not None and name in ("copy", "affine"):
            return times if name == "copy" or a == 1 else self.function("affine", times, a)
        maker = self._makers[x.index] if x.of == VALUE and order == 0 and name in ("affine", "sine") else None
        if maker is not None and maker.name == "affine" and maker.numbers[0] == 0 and len(maker.operands) == 1:
            x = maker.operands[0].part(x.start, x.width)._replace(spread=x.spread or maker.operands[0].spread)
            a, b = a * maker.numbers[1], a * maker.numbers[2] + b
        operands = (x,) if times is None else (x, times)
        return self.emit("function", x.width, operands, (order, float(a), float(b)), name)

    def apply(self, name: str, x: Columns, a: float = 0.0, b: float = 0.0) -> Columns:
        """Adds a step with an elementwise function."""
        columns = self.function(name, x, a, b)
        assert columns is not None
        return columns

    def binary(self, name: str, x: Columns, y: Columns) -> Columns:
        """Adds a step with one of :data:`BINARY`."""
        return self.emit("binary", x.width, (x, y), (), name)

    def total(self, x: Columns, group: int) -> Columns:
        """Adds a step that sums groups of adjacent columns."""
        return self.emit("total", x.width // group, (self.rows(x),), (group,))

    def move(self, width: int, parts: Sequence[tuple[Columns, int]]) -> Columns:
        """Adds a step that places each part in ``width`` zero columns at its target column; overlaps are summed."""
        if len(parts) == 1 and parts[0][0].width == width and not parts[0][0].spread and parts[0][0].of == VALUE:
            return parts[0][0]
        return self.emit("move", width, [columns for columns, _ in parts], [at for _, at in parts])

    def side_by_side(self, parts: Sequence[Columns]) -> Columns:
        """Returns the parts side by side; adds no step if they are already adjacent columns of a value."""
        joined, places, start = parts[0], [], 0
        for part in parts[1:]:
            following = joined.part(joined.width, part.width)
            joined = joined._replace(width=joined.width + part.width) if following == part else joined
        width = sum(part.width for part in parts)
        if joined.width == width and joined.of == VALUE and not joined.spread:
            return joined
        for part in parts:
            places.append((part, start))
            start += part.width
        return self.move(width, places)

    def encode(self, name: str, x: Columns, size: int, parameter: int = 0, along: Sequence[Columns] = ()) -> Columns:
        """Adds a step with an encoding F_0(x), or with its derivative F_m along m directions.

        Args:
            name: one of :data:`ENCODINGS`, or "hash".
            x: the columns to encode; for "hash" a whole input.
            size: the encoding's size; for "hash" the index of the grid.
            parameter: the table of "hash".
            along: the directions of the derivative, each as wide as x.
        """
        operands = [self.rows(each) for each in (x, *along)]
        width = encoded_columns(name, x.width, size, self.grids)
        return self.emit("encode", width, operands, (size, parameter, len(along), 0), name)

    def encode_backward(
        self, name: str, x: Columns, g: Columns, size: int, parameter: int = 0, along: Sequence[Columns] = ()
    ) -> Columns:
        """Adds a step with G_m+1, the gradient of ``<g, F_m(x; along)>`` with respect to x; see :meth:`encode`."""
        operands = [self.rows(each) for each in (x, g, *along)]
        if not along:
            operands.append(self.encode(name, x, size, parameter))
        return self.emit("encode", x.width, operands, (size, parameter, len(along) + 1, 1), name)

    def rows(self, columns: Columns) -> Columns:
        """Returns the columns, or a copy of them as a value if they belong to a parameter or are a broadcast column."""
        return self.apply("copy", columns) if columns.of == PARAMETER or columns.spread else columns

    def add_outer(self, index: int, g: Columns, x: Columns, start: int) -> None:
        """Adds an outer step: adds ``g^T x`` to a sum [o, i], from column ``start`` on."""
        self.steps.append(Step("outer", index, x.width, (self.rows(g), self.rows(x)), (start,)))

    def add_columns(self, index: int, g: Columns, start: int) -> None:
        """Adds a columns step: adds the sum of g's rows to a sum, from entry ``start`` on."""
        if g.spread and g.of == VALUE and g.width == 1:
            g = g._replace(spread=False)
        self.steps.append(Step("columns", index, g.width, (self.rows(g),), (start,)))

    def add_scatter(
        self, index: int, x: Columns, g: Columns, grid: int, parameter: int, along: Sequence[Columns] = ()
    ) -> None:
        """Adds a scatter step: adds the table gradient of ``<g, F_m(x; along)>`` (T_m) to a sum [e, f]."""
        operands = tuple(self.rows(each) for each in (x, g, *along))
        self.steps.append(Step("scatter", index, g.width, operands, (grid, parameter, len(along))))


def _is_sum(step: Step) -> bool:
    return step.op in ("outer", "columns", "scatter")


def _reads_table(step: Step) -> bool:
    return step.op == "scatter" or (step.op == "encode" and step.name == HASH)


# Gradients ------------------------------------------------------------------------------------------------------------


class _Arriving:
    """The gradients that have arrived at the values and parameters of a program so far."""

    def __init__(self, builder: Builder, active: set[int], sums: dict[int, int], widths: dict[int, int]) -> None:
        self.builder, self.active, self.sums, self.widths = builder, active, sums, widths
        self.parts: dict[int, list[tuple[Columns, int]]] = {}

    def wants(self, columns: Columns) -> bool:
        """Returns whether a gradient of these columns is wanted."""
        return columns.index in (self.active if columns.of == VALUE else self.sums)

    def add(self, columns: Columns, g: Columns | None) -> None:
        """Adds a gradient of some columns, if it is wanted."""
        if g is None or not self.wants(columns):
            return
        if columns.spread and columns.width > 1:
            g, columns = self.builder.total(g, g.width), columns._replace(width=1)
        if columns.of == PARAMETER:
            self.builder.add_columns(self.sums[columns.index], g, columns.start)
        else:
            self.parts.setdefault(columns.index, []).append((g, columns.start))

    def take_full(self, value: int) -> Columns | None:
        """Removes and returns one gradient that covers all columns of a value, as the addend of a linear step."""
        parts = self.parts.get(value, [])
        for i, (g, start) in enumerate(parts):
            if start == 0 and g.width == self.widths[value] and g.of == VALUE and not g.spread:
                return parts.pop(i)[0]
        return None

    def take(self, value: int) -> Columns | None:
        """Removes the gradients of a value and returns their sum."""
        parts, width = self.parts.pop(value, []), self.widths[value]
        full = [g for g, start in parts if g.width == width]
        rest = [part for part in parts if part[0].width != width]
        if rest:
            full.append(self.builder.move(width, rest))
        total = full[0] if full else None
        for g in full[1:]:
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
    """Returns the program that computes the gradients of another program.

    Args:
        program: the program to differentiate.
        inputs: for each input, whether its gradient is wanted.
        parameters: for each parameter, whether its gradient is wanted.
        outputs: for each output, whether it has a gradient.
        sums: for each sum, whether it has a gradient.

    Returns:
        A program. Its inputs are the inputs of ``program``, then the gradients of the outputs that have one. Its
        parameters are the parameters of ``program``, then the gradients of the sums. Its outputs are the gradients of
        the inputs, and its sums are the gradients of the parameters. The gradient of a per-ray input is summed by ray;
        the gradient of an output that is summed by ray is a per-ray input. The gradient of a table that all cells share
        is [1, e, f]; the gradient of any other parameter has k cells.
    """
    b = Builder(replace(program, steps=tuple(step for step in program.steps if not _is_sum(step)), sums=()))
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
    for index, (columns, exists) in enumerate(zip(program.outputs, outputs, strict=True)):
        if exists:
            arriving.add(columns, b.input(columns.width, ray=index in program.by_ray))
    sum_gradients = [b.parameter(*shape) if exists else None for shape, exists in zip(program.sums, sums, strict=True)]
    input_gradients: dict[int, Columns] = {}
    for step in reversed(program.steps):
        if _is_sum(step):
            matrix = sum_gradients[step.out]
            if matrix is not None:
                _differentiate_sum(b, arriving, step, matrix)
            continue
        g = arriving.take(step.out) if step.out in active else None
        if g is None:
            continue
        if step.op == "input":
            input_gradients[int(step.numbers[0])] = g
        elif step.op == "linear":
            _differentiate_linear(b, arriving, step, g)
        elif step.op == "function":
            _differentiate_function(b, arriving, step, g)
        elif step.op == "binary":
            _differentiate_binary(b, arriving, step, g)
        elif step.op == "encode":
            _differentiate_encode(b, arriving, step, g)
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
    wanted_inputs = [i for i, want in enumerate(inputs) if want]
    results = [input_gradients.get(i) or b.move(program.inputs[i], []) for i in wanted_inputs]
    return pruned(b.program(results, [at for at, i in enumerate(wanted_inputs) if i in program.rays]))


def gradient_reaches(program: Program, outputs: Sequence[bool], sums: Sequence[bool]) -> tuple[bool, ...]:
    """Returns for each input, then for each parameter, whether a gradient reaches it; else autograd gives it None.

    No gradient passes ``stop`` or a comparison. A gradient of zeros, as ``floor`` has, counts as a gradient; so does
    the second derivative of ReLU, whose gradient is a ``gate`` by its output.

    Args:
        program: the program.
        outputs: for each output, whether it has a gradient.
        sums: for each sum, whether it has a gradient.
    """
    values, parameters, inputs = set[int](), set[int](), set[int]()

    def add(operands: Sequence[Columns]) -> None:
        for columns in operands:
            (values if columns.of == VALUE else parameters).add(columns.index)

    add([columns for columns, exists in zip(program.outputs, outputs, strict=True) if exists])
    for step in reversed(program.steps):
        exists = sums[step.out] if _is_sum(step) else step.out in values
        if not exists or step.name in ("stop", "step", "at_least"):
            continue
        add(step.operands)
        if step.op == "input":
            inputs.add(int(step.numbers[0]))
        elif step.op == "linear":
            parameters.add(int(step.numbers[0]))
        elif step.op == "encode" and step.name == HASH:
            parameters.add(int(step.numbers[1]))
    reached = [i in inputs for i in range(len(program.inputs))]
    return tuple(reached + [p in parameters for p in range(len(program.parameters))])


def _differentiate_sum(b: Builder, arriving: _Arriving, step: Step, parameter: int) -> None:
    if step.op == "scatter":
        # For a gradient C of the sum, <C, T_m(x, g; h ..)> is <g, F_m(x; h ..)> with C as the table.
        x, g, *along = step.operands
        _differentiate_product(b, arriving, HASH, int(step.numbers[0]), parameter, x, g, along)
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


def _differentiate_linear(b: Builder, arriving: _Arriving, step: Step, g: Columns) -> None:
    (x, *rest), (matrix, start, transposed) = step.operands, map(int, step.numbers)
    for add in rest:
        arriving.add(add, g)
    g = b.rows(g)
    if matrix in arriving.sums:
        b.add_outer(arriving.sums[matrix], *((x, g) if transposed else (g, x)), start)
    if arriving.wants(x):
        full = x.start == 0 and x.width == arriving.widths[x.index]
        addend = arriving.take_full(x.index) if full else None
        arriving.add(x, b.linear(g, matrix, x.width, start, not transposed, add=addend))


def _differentiate_function(b: Builder, arriving: _Arriving, step: Step, g: Columns) -> None:
    (x, *rest), (order, a, c) = step.operands, step.numbers
    if rest:
        arriving.add(rest[0], b.function(step.name, x, a, c, int(order), g))
        if arriving.wants(x) and order + 1 <= FUNCTIONS[step.name].orders:
            arriving.add(x, b.function(step.name, x, a, c, int(order) + 1, b.binary("mul", g, rest[0])))
    elif arriving.wants(x):
        if step.name == "relu" and order == 0:
            # The slope follows from ReLU's output, so its input need not be stored. "gate" blocks infinite gradients
            # too, as PyTorch does: 0 times infinity would be NaN.
            arriving.add(x, b.binary("gate", g, Columns(VALUE, step.out, 0, step.width)))
            return
        arriving.add(x, b.function(step.name, x, a, c, int(order) + 1, g))


def _differentiate_binary(b: Builder, arriving: _Arriving, step: Step, g: Columns) -> None:
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


def _differentiate_encode(b: Builder, arriving: _Arriving, step: Step, g: Columns) -> None:
    size, parameter, order, back = map(int, step.numbers)
    x, *along = step.operands
    if back:
        # With the arriving gradient c, <c, G_m(x, g; h ..)> is <g, F_m(x; h .., c)>. F_0(x) gets no gradient.
        g, along = along[0], [*along[1:order], g]
    _differentiate_product(b, arriving, step.name, size, parameter, x, g, along)


def _differentiate_product(
    b: Builder,
    arriving: _Arriving,
    name: str,
    size: int,
    parameter: int,
    x: Columns,
    g: Columns,
    along: Sequence[Columns],
) -> None:
    """Adds the gradients of ``<g, F_m(x; along)>`` with respect to its operands and its table."""
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
    """An encoding that is computed before a program runs: ``width`` columns of an input, from ``start`` on."""

    input: int
    start: int
    width: int
    name: str
    size: int


@functools.lru_cache(maxsize=64)
def encoded_ahead(program: Program, chosen: tuple[bool, ...]) -> tuple[Program, tuple[Ahead, ...]]:
    """Replaces the encodings of the chosen inputs, except hash encodings, with additional inputs."""
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
    """Removes the steps whose values are unused."""
    needed = {columns.index for columns in program.outputs if columns.of == VALUE}
    kept: list[Step] = []
    for step in reversed(program.steps):
        if _is_sum(step) or step.out in needed:
            kept.append(step)
            needed.update(columns.index for columns in step.operands if columns.of == VALUE)
    return replace(program, steps=tuple(reversed(kept)))


def merged(program: Program) -> Program:
    """Fuses ReLU and its gradient into the preceding linear step; :func:`gradient` cannot take the result."""
    kept, uses = list(program.steps), dict[int, int]()
    for columns in (*program.outputs, *(c for step in kept for c in step.operands)):
        if columns.of == VALUE:
            uses[columns.index] = uses.get(columns.index, 0) + 1
    place_of = {step.out: place for place, step in enumerate(kept) if not _is_sum(step)}
    dropped = set()
    for place, step in enumerate(kept):
        slope = step.op == "binary" and step.name == "gate"
        if not slope and (step.op != "function" or step.name != "relu" or step.numbers[0] or len(step.operands) > 1):
            continue
        source, *rest = step.operands
        if any(c.of != VALUE or c.spread or c.start for c in step.operands) or uses[source.index] != 1:
            continue
        linear = kept[place_of[source.index]]
        if linear.op != "linear" or linear.name or linear.width != source.width:
            continue
        if slope:
            first = kept[place_of[rest[0].index]]  # a ReLU's output is nonzero exactly where its slope is 1
            valid = place_of[rest[0].index] < place_of[source.index] and first.width == step.width
            if not valid or first.name != "relu":
                continue
            kept[place_of[source.index]] = linear._replace(
                out=step.out, operands=(*linear.operands, rest[0]), name="relu_slope"
            )
        else:
            kept[place_of[source.index]] = linear._replace(out=step.out, name="relu")
        place_of[step.out] = place_of[source.index]
        dropped.add(place)
    steps = tuple(step for place, step in enumerate(kept) if place not in dropped)
    return replace(program, steps=steps)
