"""Replaces sines and cosines of octaves in a program by one step, the frequency encoding.

A wave is sin(a x) or cos(a x) for a column x and a factor a. One step takes less time than separate waves, and
concatenations in the step's order need no copy. The step's second derivatives run in PyTorch, so the replacement is for
programs that are differentiated once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import NamedTuple

from voronerf.ops._core.program import PARAMETER, VALUE, Columns, Program, Step, pruned

_Column = tuple[int, int]  # (value, column in it)
_Waves = dict[_Column, dict[float, dict[int, list[_Column]]]]  # column: {factor: {0 for sine or 1 for cosine: copies}}
_PHASES = {0.0: 0, round(math.pi / 2, 6): 1}
MOST_PARTS = 3  # maximum number of parts of a layer's input that are read separately
_CLOSE = 3e-7  # maximum relative error of an octave


class _Group(NamedTuple):
    """Adjacent columns of a value whose waves have the same factors; each factor is twice the previous one."""

    columns: list[_Column]
    factors: list[float]


def with_encodings(program: Program, constants: Mapping[int, Sequence[float]]) -> Program:
    """Returns the program with waves replaced by ``encode`` steps.

    Args:
        program: The program, which must not have sums over rows.
        constants: The entries of constant parameters, by their index.
    """
    steps_by_value = {step.out: step for step in program.steps}
    waves, new, steps = _waves(program, steps_by_value, constants), 1 + max(steps_by_value, default=0), list[Step]()
    moves = dict[int, Step]()  # move steps by their value
    group_at = {min(_outputs(waves, group)): group for group in _groups(waves)}
    places: dict[_Column, _Column] = {}  # new places of waves and of moved columns
    for step in program.steps:
        if step.out in group_at:
            group = group_at[step.out]
            width, octaves, factor = len(group.columns), len(group.factors), group.factors[0]
            x = Columns(VALUE, *group.columns[0], width)
            if factor != 1:
                steps.append(Step("function", new, width, (x,), (0, factor, 0.0), "affine"))
                x, new = Columns(VALUE, new, 0, width), new + 1
            steps.append(Step("encode", new, width * (1 + 2 * octaves), (x,), (octaves, 0, 0, 0), "frequency"))
            for at, column in enumerate(group.columns):
                for octave, multiple in enumerate(group.factors):
                    for phase, copies in waves[column][multiple].items():
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
            moves[step.out] = step
        *parts, step = _by_parts(step, moves, new)
        new += len(parts)
        steps += [*parts, step]
    outputs = tuple(_elsewhere(c, places) for c in program.outputs)
    return pruned(replace(program, steps=tuple(steps), outputs=outputs))


def _by_parts(step: Step, moves: Mapping[int, Step], new: int) -> list[Step]:
    """Splits a layer whose input is joined from a few parts into one layer for each part, whose results are added."""
    move = moves.get(step.operands[0].index) if step.op == "linear" and step.operands[0].of == VALUE else None
    if move is None or step.numbers[2] or step.operands[0].width != move.width or len(move.operands) > MOST_PARTS:
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


def _waves(program: Program, steps_by_value: Mapping[int, Step], constants: Mapping[int, Sequence[float]]) -> _Waves:
    """Finds the sines and cosines of each column that is not itself an affine function of another column."""
    waves: _Waves = {}
    for step in program.steps:
        if step.name != "sine" or step.numbers[0] or len(step.operands) > 1:
            continue
        for column in range(step.width):
            source_column = _column(step.operands[0], column)
            if source_column is None:
                continue
            source, factor, phase = _source(source_column, steps_by_value, constants, *step.numbers[1:])
            if (phase := _PHASES.get(round(phase, 6), -1)) >= 0:
                waves.setdefault(source, {}).setdefault(factor, {}).setdefault(phase, []).append((step.out, column))
    return waves


def _column(c: Columns, column: int) -> _Column | None:
    return (c.index, c.start + (0 if c.spread else column)) if c.of == VALUE else None


def _source(
    source: _Column,
    steps_by_value: Mapping[int, Step],
    constants: Mapping[int, Sequence[float]],
    factor: float,
    offset: float,
) -> tuple[_Column, float, float]:
    """Returns a column x and the numbers a and b such that factor * source + offset = a x + b."""
    (value, column), by, plus = source, 1.0, 0.0
    step, columns = steps_by_value[value], list[_Column | None]()
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
        return source, factor, offset
    return _source(read, steps_by_value, constants, factor * by, factor * plus + offset)


def _groups(waves: _Waves) -> Iterator[_Group]:
    """Yields groups of adjacent columns with the same octaves of sines and cosines."""
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
    """Yields the values that hold the waves of a group."""
    for column in group.columns:
        for factor in group.factors:
            for copies in waves[column][factor].values():
                yield from (out for out, _ in copies)


def _elsewhere(c: Columns, places: Mapping[_Column, _Column]) -> Columns:
    """Returns columns at their new places if they are adjacent there too, else the same columns."""
    if c.of != VALUE or (c.index, c.start) not in places:
        return c
    value, start = places[c.index, c.start]
    width = 1 if c.spread else c.width
    same = all(places.get((c.index, c.start + i)) == (value, start + i) for i in range(width))
    return c._replace(index=value, start=start) if same else c


def _moved(step: Step, places: dict[_Column, _Column]) -> Step:
    """Returns a move step that reads as few pieces as possible; records the sources of its columns in ``places``."""
    sources: dict[int, _Column] = {}
    for c, at in zip(step.operands, map(int, step.numbers), strict=True):
        columns = ((c.index, c.start + i) for i in range(c.width))
        sources.update({at + i: places.get(column, column) for i, column in enumerate(columns)})
    if len(sources) != sum(c.width for c in step.operands):
        return step  # a column is the sum of several pieces
    pieces: list[tuple[Columns, int]] = []
    for at, (value, column) in sorted(sources.items()):
        places[step.out, at] = value, column
        last, first = pieces[-1] if pieces else (Columns(VALUE, -1, 0, 0), 0)
        if (last.index, last.start + last.width, first + last.width) == (value, column, at):
            pieces[-1] = last._replace(width=last.width + 1), first
        else:
            pieces.append((Columns(VALUE, value, column, 1), at))
    return step._replace(operands=tuple(c for c, _ in pieces), numbers=tuple(at for _, at in pieces))
