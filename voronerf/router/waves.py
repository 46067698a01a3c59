"""Sines and cosines of octaves, as codebases write them out, as one step of a program: the frequency encoding.

It takes less time than single waves, and what is put next to each other again in its order is not copied. Its second
derivatives run in PyTorch, so this is for what is differentiated once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import NamedTuple

from voronerf.ops._core.program import PARAMETER, VALUE, Columns, Program, Step, pruned

_Column = tuple[int, int]  # a value and a column of it
_Waves = dict[_Column, dict[float, dict[int, list[_Column]]]]  # of a column, by factor and 0 or 1 for sine or cosine
_PHASES = {0.0: 0, round(math.pi / 2, 6): 1}
_FEW = 3  # parts of what a layer reads
_CLOSE = 3e-7  # the rounding of a power of two


class _Group(NamedTuple):
    """Columns of a value whose waves are octaves."""

    columns: list[_Column]
    factors: list[float]


def with_encodings(program: Program, constants: Mapping[int, Sequence[float]]) -> Program:
    """The same with ``encode`` steps in the place of waves.

    Args:
        program: Without sums.
        constants: The entries of parameters that are numbers, by their index.
    """
    made = {step.out: step for step in program.steps}
    waves, new, steps = _waves(program, made, constants), 1 + max(made, default=0), list[Step]()
    joined = dict[int, Step]()  # moves by their values
    first = {min(_outputs(waves, group)): group for group in _groups(waves)}
    places: dict[_Column, _Column] = {}  # of waves, and of what a move only puts elsewhere
    for step in program.steps:
        if step.out in first:
            group = first[step.out]
            width, octaves, factor = len(group.columns), len(group.factors), group.factors[0]
            x = Columns(VALUE, *group.columns[0], width)
            if factor != 1:
                steps.append(Step("function", new, width, (x,), (0, factor, 0.0), "affine"))
                x, new = Columns(VALUE, new, 0, width), new + 1
            steps.append(Step("encode", new, width * (1 + 2 * octaves), (x,), (octaves, 0, 0, 0), "frequency"))
            for at, column in enumerate(group.columns):
                for octave, each in enumerate(group.factors):
                    for phase, copies in waves[column][each].items():
                        places.update(dict.fromkeys(copies, (new, width * (1 + 2 * octave + phase) + at)))
                if factor == 1:
                    places[column] = new, at
            new += 1
        if step.name == "sine" and all((step.out, column) in places for column in range(step.width)):
            step = Step("move", step.out, step.width, (Columns(VALUE, step.out, 0, step.width),), (0,))
        if step.op == "move" and all(c.of == VALUE and not c.spread for c in step.operands):
            step = _moved(step, places)
        if step.op != "encode":
            step = step._replace(operands=tuple(_elsewhere(c, places) for c in step.operands))
        if step.op == "move":
            joined[step.out] = step
        *parts, step = _by_parts(step, joined, new)
        new += len(parts)
        steps += [*parts, step]
    outputs = tuple(_elsewhere(c, places) for c in program.outputs)
    return pruned(replace(program, steps=tuple(steps), outputs=outputs))


def _by_parts(step: Step, joined: Mapping[int, Step], new: int) -> list[Step]:
    """A layer that reads what is joined of a few parts as one layer for each part, added up; their values are new."""
    move = joined.get(step.operands[0].index) if step.op == "linear" and step.operands[0].of == VALUE else None
    if move is None or step.numbers[2] or step.operands[0].width != move.width or len(move.operands) > _FEW:
        return [step]
    if any(c.of != VALUE or c.spread for c in move.operands) or sum(c.width for c in move.operands) != move.width:
        return [step]
    matrix, start, _ = step.numbers
    steps, add = list[Step](), step.operands[1:]
    for part, (c, at) in enumerate(zip(move.operands, move.numbers, strict=True)):
        out = step.out if part == len(move.operands) - 1 else new + part
        steps.append(Step("linear", out, step.width, (c, *add), (matrix, start + at, 0)))
        add = (Columns(VALUE, out, 0, step.width),)
    return steps


def _waves(program: Program, made: Mapping[int, Step], constants: Mapping[int, Sequence[float]]) -> _Waves:
    """The waves of each column that is not itself a x + b of another one."""
    waves: _Waves = {}
    for step in program.steps:
        if step.name != "sine" or step.numbers[0] or len(step.operands) > 1:
            continue
        for column in range(step.width):
            of = _column(step.operands[0], column)
            if of is None:
                continue
            source, factor, phase = _source(of, made, constants, *step.numbers[1:])
            if (phase := _PHASES.get(round(phase, 6), -1)) >= 0:
                waves.setdefault(source, {}).setdefault(factor, {}).setdefault(phase, []).append((step.out, column))
    return waves


def _column(c: Columns, column: int) -> _Column | None:
    return (c.index, c.start + (0 if c.spread else column)) if c.of == VALUE else None


def _source(
    of: _Column, made: Mapping[int, Step], constants: Mapping[int, Sequence[float]], factor: float, offset: float
) -> tuple[_Column, float, float]:
    """The column x of which another one, times a factor and plus an offset, is a x + b; and a and b."""
    (value, column), by, plus = of, 1.0, 0.0
    step, columns = made[value], list[_Column | None]()
    if step.op == "move":
        parts = [(c, int(at)) for c, at in zip(step.operands, step.numbers) if at <= column < at + c.width]
        columns = [_column(c, column - at) for c, at in parts]
    elif step.name == "affine" and step.numbers[0] == 0 and len(step.operands) == 1:
        columns, by, plus = [_column(step.operands[0], column)], *step.numbers[1:]
    elif step.name == "mul":
        (x, y) = step.operands if step.operands[0].of == VALUE else step.operands[::-1]
        if y.of == PARAMETER and y.index in constants:
            columns, by = [_column(x, column)], constants[y.index][y.start + (0 if y.spread else column)]
    read = columns[0] if len(columns) == 1 else None
    if read is None:
        return of, factor, offset
    return _source(read, made, constants, factor * by, factor * plus + offset)


def _groups(waves: _Waves) -> Iterator[_Group]:
    """Columns next to each other with the same octaves of sines and cosines."""
    group = _Group([], [])
    for column in sorted(waves):
        factors = sorted(factor for factor, phases in waves[column].items() if factor > 0 and len(phases) == 2)
        ratios = [factor / factors[0] / 2**i - 1 for i, factor in enumerate(factors)]
        octaves = [factor for factor, _ in takewhile(lambda pair: abs(pair[1]) < _CLOSE, zip(factors, ratios))]
        if group.columns and octaves == group.factors and column == (group.columns[-1][0], group.columns[-1][1] + 1):
            group.columns.append(column)
            continue
        if group.columns:
            yield group
        group = _Group([column] if octaves else [], octaves)
    if group.columns:
        yield group


def _outputs(waves: _Waves, group: _Group) -> Iterator[int]:
    """The steps that make the waves of a group."""
    for column in group.columns:
        for factor in group.factors:
            for copies in waves[column][factor].values():
                yield from (out for out, _ in copies)


def _elsewhere(c: Columns, places: Mapping[_Column, _Column]) -> Columns:
    """The same columns where they are next to each other in one other value; else as they are."""
    if c.of != VALUE or (c.index, c.start) not in places:
        return c
    value, start = places[c.index, c.start]
    width = 1 if c.spread else c.width
    same = all(places.get((c.index, c.start + i)) == (value, start + i) for i in range(width))
    return c._replace(index=value, start=start) if same else c


def _moved(step: Step, places: dict[_Column, _Column]) -> Step:
    """A move in as few pieces as may be; what it only puts elsewhere is noted in ``places``."""
    taken: dict[int, _Column] = {}
    for c, at in zip(step.operands, map(int, step.numbers), strict=True):
        columns = ((c.index, c.start + i) for i in range(c.width))
        taken.update({at + i: places.get(column, column) for i, column in enumerate(columns)})
    if len(taken) != sum(c.width for c in step.operands):
        return step  # columns that are added up
    pieces: list[tuple[Columns, int]] = []
    for at, (value, column) in sorted(taken.items()):
        places[step.out, at] = value, column
        last, first = pieces[-1] if pieces else (Columns(VALUE, -1, 0, 0), 0)
        if (last.index, last.start + last.width, first + last.width) == (value, column, at):
            pieces[-1] = last._replace(width=last.width + 1), first
        else:
            pieces.append((Columns(VALUE, value, column, 1), at))
    return step._replace(operands=tuple(c for c, _ in pieces), numbers=tuple(at for _, at in pieces))
