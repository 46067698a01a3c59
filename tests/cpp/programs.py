"""Writes random programs as numbers for programs.cpp: ``programs.py CASES FILE [FIRST]``, FIRST for other cases.

The cases are, in turn: a layer table, the gradient of a layer table, a program with all kinds of steps, and the first
or second gradient of such a program. The requested gradients are random too. Each program is lowered for every operand
layout of products. The numbers have the order of the records' members; enumerators are written as numbers.
"""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from voronerf import MLP, HashGrid, Layer
from voronerf.ops._core import native
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.layers import ACTIVATIONS
from voronerf.ops._core.program import FUNCTIONS, HASH, PARAMETER, Builder, Columns, Program, gradient
from voronerf.ops.network import lowering

compiled = native.compiled
WIDTHS = (1, 3, 4, 5, 15, 16, 17, 33, 48, 63, 64, 65, 90, 129, 130)
CONVENTIONS = ("tiny-cuda-nn", "torch-ngp", "nerfstudio")
JUMPS = ("step", "at_least", "floor")  # applied to inputs only, which are equal for all instruction sets
POSITIVE = ("log", "log1p", "power")


def grid(draw: random.Random) -> HashGrid:
    """Draws a grid of up to five levels, whose first levels are dense."""
    given = {"levels": draw.randint(1, 5), "features": draw.choice((1, 2, 4, 8)), "base": draw.randint(2, 5)}
    box = (-1, -1, -1), (0.5, 1, 2)
    return HashGrid(log2_entries=10, finest=18, box=box, convention=draw.choice(CONVENTIONS), **given)


def layer_table(draw: random.Random) -> Program:
    """Draws the program of a random network."""
    position = draw.choice(("none", "frequency", "integrated", "hash"))
    direction = draw.choice(("none", "frequency", "spherical"))
    layers = []
    for index in range(draw.randint(1, 5)):
        known = ["positions", "directions", *range(index)]
        sources = [draw.choice(known) for _ in range(draw.choice((1, 1, 2, 3, 4, 12)))]
        layers.append(Layer(tuple(sources), draw.choice(WIDTHS), draw.choice(ACTIVATIONS)))
    outputs = [draw.randrange(len(layers)) for _ in range(draw.randint(1, 3))]
    if draw.random() < 0.5:  # a head with few outputs runs as dot products
        layers.append(Layer(("positions",), 32 * draw.randint(1, 3), "relu"))
        layers.append(Layer((len(layers) - 1,), draw.randint(1, 4), draw.choice(ACTIVATIONS)))
        outputs.append(len(layers) - 1)
    table = MLP(
        tuple(layers),
        tuple(outputs),
        position_octaves=draw.randint(1, 4) if position in ("frequency", "integrated") else None,
        direction_octaves=draw.randint(0, 2) if direction == "frequency" else None,
        position_encoding=position if position in ("integrated", "hash") else "frequency",
        grid=grid(draw) if position == "hash" else None,
        direction_encoding="spherical" if direction == "spherical" else "frequency",
        direction_degree=draw.randint(1, 4) if direction == "spherical" else None,
    )
    p = {"integrated": 6, "hash": 3}.get(position, draw.randint(1, 20))
    q = 3 if direction == "spherical" else draw.randint(1, 4)
    biased = tuple(draw.random() < 0.7 for _ in layers)
    return table.program(p, q if table.uses_directions else 0, None, biased, draw.random() < 0.5)


def any_steps(draw: random.Random) -> Program:
    """Draws a program with every kind of step and only finite values."""
    b = Builder()
    inputs = [b.input(draw.choice(WIDTHS)), b.input(3), b.input(3, ray=draw.random() < 0.5)]
    values = list(inputs)
    vector = Columns(PARAMETER, b.parameter(140), 0, 140)

    def some(width: int) -> Columns:
        """Draws ``width`` columns of a value or of a parameter, or one broadcast column."""
        wide = [value for value in values if value.width >= width]
        kind = draw.random()
        if kind < 0.2 or not wide:
            return vector.part(draw.randint(0, 140 - width), width)
        if kind < 0.4:
            x = draw.choice([*values, vector])
            return x.part(draw.randrange(x.width), 1)._replace(width=width, spread=True)
        x = draw.choice(wide)
        return x.part(draw.choice((0, draw.randint(0, x.width - width))), width)

    def encoded(name: str) -> Columns:
        if name == HASH:
            own = grid(draw)
            return b.encode(name, inputs[1], b.grid(own.text), b.parameter(*own.table_shape))
        wide = b.move(4, [(b.binary("mul", inputs[1], inputs[1]), 0)])  # squares, as variances are not negative
        fitting = [
            (x, size)
            for x in (wide, *(inputs[1:] if name != "integrated" else ()))
            for size in range(5)
            if ENCODINGS[name].fits(x.width, size)
        ]
        return b.encode(name, *draw.choice(fitting))

    def step(kind: str) -> Columns:
        width = draw.choice(WIDTHS)
        if kind == "linear":
            x, start, transposed = b.rows(some(draw.choice(WIDTHS))), draw.randint(0, 3), draw.random() < 0.4
            shape = (x.width, start + width) if transposed else (width, start + x.width + draw.randint(0, 2))
            add = some(width) if draw.random() < 0.5 else None
            made = b.linear(x, b.parameter(*shape), width, start, transposed, add=add)
            return b.apply("relu", made) if draw.random() < 0.5 else made
        if kind == "function":
            name = draw.choice([name for name in FUNCTIONS if name not in JUMPS])
            x = b.apply("tanh", some(width))
            if name in POSITIVE:
                x = b.apply("affine", x, 0.5, 1.0)
            scale, shift = draw.choice((0.5, 2.0)), draw.choice((0.0, 1.0))
            return b.apply(name, x, *((-0.5, 0.5) if name in ("clamp", "hardtanh") else (scale, shift)))
        if kind == "jump":
            x = draw.choice(inputs)
            return b.apply(draw.choice(JUMPS), x)
        if kind == "binary":
            name = draw.choice(("add", "sub", "mul", "div", "gate"))
            x, y = some(width), some(width)
            if name == "div":
                y = b.apply("affine", b.apply("sigmoid", y), 1.0, 0.5)
            if name == "gate":
                y = b.apply("step", draw.choice(inputs))
                x = some(y.width)
            return b.binary(name, x, y)
        if kind == "total":
            x = draw.choice(values)
            return b.total(x, draw.choice([group for group in range(1, x.width + 1) if x.width % group == 0]))
        if kind == "move":
            parts = [some(draw.randint(1, width)) for _ in range(draw.randint(1, 4))]
            return b.move(width, [(part, draw.randint(0, width - part.width)) for part in parts])
        return encoded(kind)

    kinds = ["linear", "linear", "function", "function", "jump", "binary", "binary", "total", "move"]
    for kind in draw.choices([*kinds, *ENCODINGS, HASH], k=draw.randint(2, 14)):
        values.append(step(kind))
    outputs = [some(draw.choice(WIDTHS)) if draw.random() < 0.5 else draw.choice(values[-3:]) for _ in range(3)]
    outputs.append(b.apply("tanh", b.move(5, [(value.part(0, 1), i % 5) for i, value in enumerate(values)])))
    outputs = outputs[draw.randint(0, 3) :]
    return b.program(outputs, [i for i in range(len(outputs)) if b.rays and draw.random() < 0.3])


def random_program(draw: random.Random, number: int) -> tuple[Program, int]:
    """Returns a random program, and the index of its first gradient input, or -1.

    The compiled module leaves out the rows in which all gradient inputs are 0. The index is -1 if the program has no
    gradient inputs, or if such rows contribute to its results.
    """
    while True:
        program, first = (layer_table if number % 4 < 2 else any_steps)(draw), -1
        for _ in range(draw.choice(((0,), (1,), (0,), (1, 1, 2))[number % 4])):
            shown, few = [draw.random() < 0.8 for _ in program.outputs], draw.random() < 0.4
            shown[-1:] = [True for _ in shown[-1:]]
            own = gradient(
                program,
                tuple(draw.random() < 0.6 and not few for _ in program.inputs),
                tuple(draw.random() < 0.8 for _ in program.parameters),
                tuple(shown),
                tuple(True for _ in program.sums),
            )
            first = len(program.inputs)  # as in Run.backward of network/native.py
            first = first if not own.outputs and not program.sums and max(own.rays, default=-1) < first else -1
            program = own
        if (program.outputs or program.sums) and lowering.compiled_runs(program.text):
            return program, first


def table_of(program: Program, layout: str) -> Any:
    """Returns the records that the compiled module would get."""
    records: list[Any] = []
    make, compiled.make_program = compiled.make_program, records.append
    lowering.lower.__wrapped__(program.text, layout)
    compiled.make_program = make
    return records[0]


_NAMES = "Op", "Function", "Binary", "Encoding", "Finish", "Layout"
ENUMERATORS = {name.lower(): f"Program{name}" for name in _NAMES} | {"to_registers": "ProgramToRegisters"}


def numbers(record: Any) -> Iterator[str]:
    """Yields all numbers of a record; a list starts with its length."""
    if isinstance(record, (list, tuple)):
        names = getattr(record, "_fields", None)
        if names is None:
            yield str(len(record))
        for name, value in zip(names or [""] * len(record), record, strict=True):
            if isinstance(value, str):
                kind = f"{type(record).__name__}Kind" if name == "kind" else ENUMERATORS[name]
                value = getattr(compiled, kind).index(value)
            yield from numbers(value)
    else:
        yield repr(float(record)) if isinstance(record, float) else str(int(record))


def main() -> None:
    """Writes the programs to a file."""
    first = int(sys.argv[3]) if len(sys.argv) > 3 else 0
    with Path(sys.argv[2]).open("w") as out:
        for number in range(4 * first, 4 * (first + int(sys.argv[1]))):
            program, first_gradient = random_program(random.Random(number), number)
            of_inputs = {step.out: int(step.numbers[0]) for step in program.steps if step.op == "input"}
            encoded = {step.operands[0].index for step in program.steps if step.name == "integrated"}
            gaussians = [of_inputs[value] for value in sorted(encoded & set(of_inputs))]
            parameters = []
            for i, shape in enumerate(program.parameters):
                depth = max(shape) if len(shape) > 1 and i not in program.tables else 1
                parameters.append([math.prod(shape), depth, i in program.tables])
            tables = [table_of(program, layout) for layout in compiled.ProgramLayout]
            for part in (*tables, parameters, gaussians, first_gradient):
                out.write(" ".join(numbers(part)) + "\n")


if __name__ == "__main__":
    main()
