"""Generates the WGSL shader of a run: constants, march.wgsl, and the program of the networks.

A field is a program, a list of operations called steps (`voronerf.ops._core.program`). The result of a step becomes an
array of vec4f, with four columns in each vec4f; padding lanes are finite, and their weights are 0. A matrix becomes
blocks of four outputs and four inputs, since a product of a mat4x4f and a vec4f needs no sums across lanes.
`ParameterOffsets` has the offsets of a cell's blocks and biases; `voronerf.app.web.packing` writes both.

o outputs and i inputs of a matrix, w columns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

from voronerf.app.train.config import ConfigError
from voronerf.nerf.radiance import Networks
from voronerf.ops._core.encodings import harmonics
from voronerf.ops._core.grids import GridLevel, HashGrid
from voronerf.ops._core.program import HASH, PARAMETER, VALUE, Columns, Program, Step

#: WGSL of the functions of one value x with numbers a and b; finite for every finite x.
FUNCTIONS = {
    "copy": "x",
    "affine": "{a} * x + {b}",
    "relu": "max(x, vec4f())",
    "leaky_relu": "select({a} * x, x, x > vec4f())",
    "abs": "abs(x)",
    **dict.fromkeys(("clamp", "hardtanh"), "clamp(x, vec4f({a}), vec4f({b}))"),
    "softplus": "softplus({a} * x) / {a}",
    "sigmoid": "sigmoid(x)",
    "tanh": "tanh(clamp(x, vec4f(-15), vec4f(15)))",
    "silu": "x * sigmoid(x)",
    "sine": "sin(turned({a} * x + {b}))",
}
BINARY = {"add": "+", "sub": "-", "mul": "*"}
#: Greatest number of floats of a sample: WGSL allows a function 8,192 bytes of variables.
MOST_NUMBERS = 2000
#: Replaces infinity, which WGSL lacks.
GREATEST = 3.4e38
#: Number of float16 in a vec4u, the unit in which parameters are read, and in a block of a matrix.
WORD, BLOCK = 8, 16


class CannotDraw(ConfigError):
    """A trained scene that the WebGPU page cannot draw.

    Args:
        reason: The reason, as a clause about the trained scene.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(f"a page cannot draw this run: {reason}")


@dataclass
class ParameterOffsets:
    """The offsets of a cell's parameters, counted in float16 elements from the cell's first parameter.

    Attributes:
        matrices: For each step of the program that reads a matrix: the number of the parameter, its first column that
            is read, rows o, columns i, and the offset of the matrix, which is stored in blocks.
        vectors: For each bias: the number of the parameter, its first element that is read, width, and offset.
        size: Number of parameters of a cell, including padding.
    """

    matrices: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    vectors: list[tuple[int, int, int, int]] = field(default_factory=list)
    size: int = 0

    def place(self, count: int) -> int:
        """Reserves space for ``count`` numbers, aligned to words; returns its offset."""
        offset = self.size
        self.size += -(-count // WORD) * WORD
        return offset


def fours(width: int) -> int:
    """Returns the number of vec4f that hold ``width`` columns."""
    return -(-width // 4)


def networks_text(networks: Networks, layout: ParameterOffsets) -> str:
    """Returns the WGSL function ``evaluate``, which computes colour and density at a position; fills ``layout``.

    Raises:
        CannotDraw: A step of the program has no counterpart in WGSL, or a sample needs more than `MOST_NUMBERS`.
    """
    program = networks.program
    numbers = sum(4 * fours(step.width) for step in program.steps)
    if numbers > MOST_NUMBERS:
        raise CannotDraw(f"its networks need {numbers:,} numbers per sample, a page allows {MOST_NUMBERS:,}")
    grids = [HashGrid.parse(text) for text in program.grids]
    lines, steps = [], {step.out: step for step in program.steps}
    readers = [columns.index for step in program.steps for columns in step.operands if columns.of == VALUE]
    readers += [columns.index for columns in program.outputs]
    fused: set[int] = set()
    for number, step in enumerate(program.steps):
        if number in fused:
            continue
        # A ReLU is fused into its layer if nothing else reads the layer's output.
        after, name = program.steps[number + 1] if number + 1 < len(program.steps) else None, step.name
        if step.op == "linear" and after is not None and _is_relu_of(after, step) and readers.count(step.out) == 1:
            fused.add(number + 1)
            step, name = step._replace(out=after.out), "relu"
        lines += _step(program, step, name, layout, grids, steps)
    (out,) = program.outputs
    lines.append(f"return vec4f({', '.join(_column(out, steps, number) for number in range(4))});")
    body = "".join(f"  {line}\n" for line in lines)
    return (
        "// Colour and density of a cell's networks at a place, seen along a direction.\n"
        "fn evaluate(cell: u32, place: vec3f, direction: vec3f) -> vec4f {\n"
        f"  let own = cell * {layout.size // WORD}u;\n{body}}}\n" + "".join(_grid_text(grid) for grid in grids[:1])
    )


def _is_relu_of(after: Step, step: Step) -> bool:
    output = Columns(VALUE, step.out, 0, step.width)
    return after.op == "function" and after.name == "relu" and after.operands == (output,) and after.numbers[0] == 0


def _step(
    program: Program, step: Step, name: str, layout: ParameterOffsets, grids: list[HashGrid], steps: dict[int, Step]
) -> list[str]:
    """Returns the WGSL lines of a step of the program."""
    out, wide = f"v{step.out}", fours(step.width)
    declare = f"var {out}: array<vec4f, {wide}>;"
    loop = f"for (var o = 0u; o < {wide}u; o++)"
    if step.op == "input":
        return [declare, f"{out}[0] = vec4f({'direction' if step.numbers[0] in program.rays else 'place'}, 0);"]
    if step.op == "encode":
        x, size = step.operands[0], int(step.numbers[0])
        if step.numbers[2] or name not in (*ENCODINGS, HASH) or x.width != 3 or x.start:
            raise CannotDraw(f"its networks encode by {name} encoding of {x.width} numbers")
        place = f"v{x.index}[0].xyz"
        if name == HASH:
            return [declare, *_hash_grid(grids, size, place, out, wide)]
        return [
            declare,
            "{",
            f"  let s = {place};  // {name}",
            *(f"  {line}" for line in ENCODINGS[name](out, size)),
            "}",
        ]
    if step.op == "linear":
        return [declare, *_linear(program, step, name, layout, steps)]
    if step.op == "function" and step.numbers[0] == 0 and name in FUNCTIONS:
        setup, operand = _whole(step.operands[0], steps, f"{out}_of")
        a, b = (_number(value) for value in step.numbers[1:])
        value = f"({FUNCTIONS[name].format(a=a, b=b)})"
        for factor in step.operands[1:]:
            extra, name_of_factor = _whole(factor, steps, f"{out}_by")
            setup, value = [*setup, *extra], f"{value} * {name_of_factor}[o]"
        return [*setup, declare, f"{loop} {{ let x = {operand}[o]; {out}[o] = {value}; }}  // {name}"]
    if step.op == "binary" and name in BINARY:
        (setup, left), (more, right) = (_whole(columns, steps, f"{out}_{n}") for n, columns in enumerate(step.operands))
        return [*setup, *more, declare, f"{loop} {{ {out}[o] = {left}[o] {BINARY[name]} {right}[o]; }}"]
    if step.op == "move":
        lines = [declare]
        for columns, first in zip(step.operands, step.numbers):
            if columns.of != VALUE:
                raise CannotDraw("its networks return parameters unchanged")
            for number in range(columns.width):
                column = int(first) + number
                lines.append(f"{out}[{column // 4}].{'xyzw'[column % 4]} += {_column(columns, steps, number)};")
        return lines
    raise CannotDraw(f"its networks have a step {step.op} {name}".rstrip())


def _linear(program: Program, step: Step, name: str, layout: ParameterOffsets, steps: dict[int, Step]) -> list[str]:
    """Returns the WGSL lines of a linear layer, block by block, with its bias."""
    matrix, start, transposed = map(int, step.numbers)
    if transposed or name not in ("", "relu"):
        raise CannotDraw("its networks have a transposed product")
    x, *added = step.operands
    setup, source = _whole(x, steps, f"v{step.out}_of")
    o, i, out = step.width, x.width, f"v{step.out}"
    place = layout.place(fours(o) * fours(i) * BLOCK)
    layout.matrices.append((matrix, start, o, i, place))
    first = "vec4f()"
    if added and added[0].of == PARAMETER:
        bias = layout.place(4 * fours(o))
        layout.vectors.append((added[0].index, added[0].start, o, bias))
        first = f"bias(own + {bias // WORD}u, o)"
    elif added:
        extra, value = _whole(added[0], steps, f"v{step.out}_plus")
        setup, first = [*setup, *extra], f"{value}[o]"
    last = "max(sum, vec4f())" if name == "relu" else "sum"
    return [
        *setup,
        f"for (var o = 0u; o < {fours(o)}u; o++) {{  // linear, {i} to {o}{', relu' if name else ''}",
        f"  var sum = {first};",
        f"  let row = own + {place // WORD}u + o * {fours(i) * BLOCK // WORD}u;",
        f"  for (var i = 0u; i < {fours(i)}u; i++) {{ sum += block(row + {BLOCK // WORD}u * i) * {source}[i]; }}",
        f"  {out}[o] = {last};",
        "}",
    ]


def _hash_grid(grids: list[HashGrid], number: int, x: str, out: str, wide: int) -> list[str]:
    grid = grids[number]
    if len(grids) > 1:
        raise CannotDraw("its networks have several hash grids")
    lines = [f"let inside = clamp(({x} - GRID_LOW) * GRID_INVERSE, vec3f(), vec3f(1));  // hash grid"]
    levels = [_level(level, half) for level in grid.rows for half in range(-(-grid.features // 4))]
    per = max(1, 4 // grid.features)  # levels in a vec4f
    levels += [f"vec{grid.features}f()" if grid.features > 1 else "0.0"] * (-len(levels) % per)
    for number in range(wide):
        parts = ",\n  ".join(levels[per * number : per * (number + 1)])
        lines += f"{out}[{number}] = vec4f(\n  {parts});".split("\n")
    return lines


def _level(level: GridLevel, half: int) -> str:
    hashed = "true" if level.hashed else "false"
    numbers = f"{_number(level.scale)}, {_number(level.shift)}, {level.side}u, {level.entries}u, {level.offset}u"
    return f"features_of(cell * TABLE_OF_CELL, inside, Level({numbers}, {hashed}, {half}u))"


def _grid_text(grid: HashGrid) -> str:
    """Returns the WGSL of a hash grid: its constants, and the functions that read and interpolate the table."""
    low, high = grid.box
    inverse = [1 / (b - a) for a, b in zip(low, high)]
    kind = "f32" if grid.features == 1 else f"vec{min(grid.features, 4)}f"
    read = {
        1: "unpack2x16float(table[entry / 2u])[entry % 2u]",
        2: "unpack2x16float(table[entry])",
        4: "vec4f(unpack2x16float(table[2u * entry]), unpack2x16float(table[2u * entry + 1u]))",
        8: "vec4f(unpack2x16float(table[4u * entry + 2u * half]), unpack2x16float(table[4u * entry + 2u * half + 1u]))",
    }[grid.features]
    return (
        f"const GRID_LOW = {_vector(low)};\nconst GRID_INVERSE = {_vector(inverse)};\n"
        f"alias Features = {kind};\n"
        f"fn entry_of(entry: u32, half: u32) -> Features {{ return {read}; }}\n"
    ) + resources.files(__package__).joinpath("grid.wgsl").read_text()


def _frequency(out: str, octaves: int) -> list[str]:
    return [  # x, sin x, cos x, sin 2x, cos 2x, ...
        f"{out}[0] = vec4f(s, 0);",
        f"for (var octave = 0u; octave < {octaves}u; octave++) {{",
        "  let angle = turned(vec4f(s * exp2(f32(octave)), 0));",
        "  let sines = sin(angle);",
        "  let cosines = cos(angle);",
        "  for (var axis = 0u; axis < 3u; axis++) {",
        "    let at = 3u + 6u * octave + axis;",
        f"    {out}[at / 4u][at % 4u] = sines[axis];",
        f"    {out}[(at + 3u) / 4u][(at + 3u) % 4u] = cosines[axis];",
        "  }",
        "}",
    ]


class _Term(str):
    """A WGSL expression with Python's operators, so that Python formulas can be applied to it."""

    def __mul__(self, other: object) -> _Term:
        return _Term(f"{self} * {other}")

    def __rmul__(self, other: object) -> _Term:
        return _Term(f"{other} * {self}")

    def __sub__(self, other: object) -> _Term:
        return _Term(f"({self} - {other})")

    def __rsub__(self, other: object) -> _Term:
        return _Term(f"({other} - {self})")


def _spherical(out: str, degree: int) -> list[str]:
    terms = harmonics(_Term("s.x"), _Term("s.y"), _Term("s.z"), degree)
    return [f"{out}[{n // 4}].{'xyzw'[n % 4]} = {term};" for n, term in enumerate(terms)]


ENCODINGS: dict[str, Callable[[str, int], list[str]]] = {"frequency": _frequency, "spherical": _spherical}
"""Functions that return the WGSL lines of an encoding of a vec3f s, from the output's name and the encoding's size."""


def _whole(columns: Columns, steps: dict[int, Step], name: str) -> tuple[list[str], str]:
    """Returns WGSL lines that make an array of exactly these columns, and the name of the array."""
    if columns.of != VALUE:
        raise CannotDraw("its networks use parameters that are neither weights nor biases")
    if not columns.spread and columns.start == 0 and columns.width == steps[columns.index].width:
        return [], f"v{columns.index}"
    lines = [f"var {name}: array<vec4f, {fours(columns.width)}>;"]
    for number in range(columns.width):
        lines.append(f"{name}[{number // 4}].{'xyzw'[number % 4]} = {_column(columns, steps, number)};")
    return lines, name


def _column(columns: Columns, steps: dict[int, Step], number: int) -> str:
    if columns.of != VALUE:
        raise CannotDraw("its networks return parameters unchanged")
    at = columns.start + (0 if columns.spread else number)
    return f"v{columns.index}[{at // 4}].{'xyzw'[at % 4]}"


def _number(value: Any) -> str:
    """Formats a number as a WGSL float, in parentheses if negative."""
    text = repr(min(max(float(value), -GREATEST), GREATEST))
    text = text if any(mark in text for mark in ".e") else f"{text}.0"
    return f"({text})" if text.startswith("-") else text


def _vector(values: Any) -> str:
    values = list(values)
    return f"vec{len(values)}f({', '.join(_number(value).strip('()') for value in values)})"


def shader_text(networks: str, constants: dict[str, Any]) -> str:
    """Returns the source of the whole shader.

    Args:
        networks: The text from `networks_text`.
        constants: Booleans, ints, floats or lists of three, by their names in march.wgsl.
    """
    lines = []
    for name, value in constants.items():
        if isinstance(value, bool):
            text = str(value).lower()
        elif isinstance(value, int):
            text = f"{value}u"
        else:
            text = _number(value) if isinstance(value, float) else _vector(value)
        lines.append(f"const {name} = {text};\n")
    march = resources.files(__package__).joinpath("march.wgsl").read_text()
    return "".join(lines) + "\n" + march + "\n" + networks
