"""The lowering of programs to the records of the compiled module (csrc/network/program_code.h), once for each program.

A pair is two 16-bit numbers in the space of one float; kernels read the operands of 16-bit products as pairs. A pack is
data that kernels prepare once for each cell: a part of a parameter in their layout, or the table of an encoding. The
workspace of a tile has slots for its values. A value may instead be in a buffer of the call, which holds the value for
all rows, in the order of the cells. The variables called ``memory`` are indices of such buffers.

Letters: n rows, k cells, w columns of a value.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from voronerf.ops._core import native
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.memory import LARGE, on_huge_pages
from voronerf.ops._core.program import (
    HASH,
    PARAMETER,
    VALUE,
    Columns,
    Program,
    Step,
    encoded_columns,
    merged,
)
from voronerf.ops.hash_encode.native import compiled_grid

_ORDERS = 3  # the highest order of derivatives in the compiled module
_FLOATS = 96 << 10  # the most floats of the values of a tile, which share the L2 cache with the weights
_ROWS = (24, 96)  # the fewest and the most rows of a tile; both are whole blocks of products (gemm_tile.h)
_WHOLE = 48  # the fewest rows of a tile if encodings write whole vectors of rows
_TILE = 32  # rows of a block of products in tile registers
_GRANULE = 16  # widths are padded to multiples of this number of floats
_NARROW = 4  # layers of at most this width use the kernel for few outputs (few_outputs_tile.h)
_NONE = -1


_SumPart = tuple[int, str, int, int, int, int, int, int, int, int]  # the members of a ProgramSum except `adds`


class Lookup(NamedTuple):
    """A lookup in a hash grid: the indices of the input (the points), the parameter (the table) and the grid."""

    input: int
    parameter: int
    grid: int


@dataclass(frozen=True)
class Lowered:
    """A lowered program, ready to run.

    Attributes:
        program: the program object of the C++ extension.
        lookups: the hash-grid lookups whose features, [n, width] each, sorted by cell, can be kept for the gradient.
        widths: the number of floats in a row of the features, for each lookup.
        sizes: the number of entries of each parameter for one cell.
        tables: the indices of the parameters that are tables of hash grids.
        call: a callable that allocates the results and runs the program on the CPU.
    """

    program: native.compiled.Program
    lookups: tuple[Lookup, ...]
    widths: tuple[int, ...]
    sizes: tuple[int, ...]
    tables: tuple[int, ...]
    call: native.compiled.ProgramCall


@functools.lru_cache(maxsize=1024)
def compiled_runs(text: str) -> bool:
    """Returns whether the compiled module can run a program and all its derivatives."""
    program = Program.parse(text)
    sums = [step.out for step in program.steps if step.op == "scatter"]
    return program.orders <= _ORDERS and len(sums) == len(set(sums))


@functools.lru_cache(maxsize=1024)
def lower(text: str, layout: str = "floats", cuda: bool = False) -> Lowered:
    """Returns the lowered program, cached.

    Args:
        text: the text of the program.
        layout: the layout of the operands of products: "floats"; "pairs" of bfloat16; "tiles", pairs for tile
            registers; or "parts", floats split into a high and a low part for tile registers.
        cuda: whether the program is for CUDA. There a linear step multiplies only one operand, and the layout is
            "floats" or "tiles" (of any 16-bit type).
    """
    return _Lowering(merged(Program.parse(text)), layout, cuda).lowered()


def _padded(width: int, to: int = _GRANULE) -> int:
    return -(-width // to) * to


class _Slots:
    """An allocator of columns for values in the workspace of a tile; it reuses freed slots of equal width."""

    def __init__(self) -> None:
        self.size = 0
        self._free: list[tuple[int, int]] = []  # (width, place)

    def take(self, width: int) -> int:
        """Allocates a slot of ``width`` columns and returns its first column."""
        fitting = [slot for slot in self._free if slot[0] == width]
        if fitting:
            self._free.remove(fitting[-1])
            return fitting[-1][1]
        self.size += width
        return self.size - width

    def give(self, width: int, place: int) -> None:
        """Frees a slot."""
        self._free.append((width, place))


@dataclass
class _Value:
    """The places of a value, -1 for none: the slots of its floats and pairs, a buffer of the call, or an input.

    A row of floats has ``stride`` entries, including padding.
    """

    width: int
    stride: int
    slot: int = _NONE
    memory: int = _NONE
    input: int = _NONE  # the input that steps may read in place
    pairs: int = _NONE
    floats: bool = True  # whether any step reads the floats; if not, only the pairs are written
    waves: int = _NONE  # on CUDA, the pack in whose order an encoding has its pairs (WaveOrder in index_maps.h)


class _Lowering:
    """The lowering of one program: the state while its records are made."""

    def __init__(self, program: Program, layout: str, cuda: bool) -> None:
        self.program, self.layout, self.cuda = program, layout, cuda
        self.half, self.tiles, self.parts = layout != "floats", layout in ("tiles", "parts"), layout == "parts"
        self.compiled = native.compiled
        self.slots, self.values = _Slots(), dict[int, _Value]()
        self.packs: dict[tuple[Any, ...], tuple[int, int]] = {}  # the number of each pack, and its position
        self.packed, self.partial = 0, 0
        self.at, self.in_registers = 0, _NONE  # the number of the current step; the value in registers (CUDA)
        self.steps: list[Any] = []
        self.operands: list[Any] = []
        self.sums: list[_SumPart] = []
        self.memories: list[int] = []
        self.lookups: list[tuple[Lookup, int]] = []
        self.scatters: list[tuple[Lookup, int, int]] = []
        self.output_memories: dict[int, int] = {}  # output -> its buffer, if a step writes the output directly
        self.work = self._in_order()
        if cuda and self.half:
            self.work = _delayed(self.work)
        elif not cuda and not self.half:
            self.work = _joined(self.work)
        self.readers: dict[int, list[tuple[Step, int]]] = {}
        for step in self.work:
            for place, c in enumerate(step.operands):
                if c.of == VALUE:
                    self.readers.setdefault(c.index, []).append((step, place))
        self.scratch_width = self._scratch()
        parts = 3 if self.tiles else 2
        self.scratch = self.slots.take(parts * self.scratch_width) if self.scratch_width else 0

    # The order of steps -----------------------------------------------------------------------------------------------

    def _in_order(self) -> list[Step]:
        """Returns the steps, followed by steps that write outputs.

        If a move only concatenates values for an output, it is dropped and each part is written directly.
        """
        program, fresh = self.program, 1 + max((s.out for s in self.program.steps if not _sums(s)), default=0)
        steps, uses = list[Step](), dict[int, int]()
        for step in program.steps:
            if _sums(step) and not all(c.width for c in step.operands):
                continue  # the sum stays 0
            if step.op == "scatter" and not self._whole(step.operands[1]):
                g = step.operands[1]
                steps.append(Step("function", fresh, g.width, (g,), (0, 0.0, 0.0), "copy"))
                step = step._replace(operands=(step.operands[0], Columns(VALUE, fresh, 0, g.width)))
                fresh += 1
            steps.append(step)
        for c in (*program.outputs, *(c for step in steps for c in step.operands)):
            if c.of == VALUE:
                uses[c.index] = uses.get(c.index, 0) + 1
        makers = {step.out: step for step in steps if not _sums(step)}
        written: list[Step] = []
        for number, c in enumerate(program.outputs):
            maker = makers.get(c.index) if c.of == VALUE else None
            parts: list[tuple[Columns, float]] = [(c, 0)]
            alone = maker is not None and uses[c.index] == 1 and _all_of(c, maker.width)
            if maker is not None and alone and maker.op == "move" and _covered(maker):
                steps.remove(maker)
                parts = list(zip(maker.operands, maker.numbers))
            written += [Step("output", number, part.width, (part,), (number, at)) for part, at in parts]
        return [*steps, *written]

    def _whole(self, g: Columns) -> bool:
        """Returns whether ``g`` is the whole value of a step, so that a buffer of the call can hold the value."""
        makers = {step.out: step for step in self.program.steps if not _sums(step)}
        scattered = [step.operands[1].index for step in self.program.steps if step.op == "scatter"]
        step = makers[g.index]
        alone = scattered.count(g.index) == 1 and step.op not in ("input", "encode")
        return alone and g.start == 0 and g.width == step.width and not g.spread

    def _scratch(self) -> int:
        """Returns the number of columns of each part of the scratch memory; 0 if no step needs it.

        A step copies its operands into the parts, in the layout that its kernel reads.
        """
        widths = [0]
        for step in [] if self.cuda else self.work:
            if step.op == "encode" and step.name == HASH:
                widths.append(_GRANULE)
            if self.half and step.op == "linear":
                widths.append(self.pairs_of(step.operands[0].width))
            if self.half and step.op == "outer":
                widths.append(max(self.pairs_of(c.width) for c in step.operands))
        return _padded(max(widths))

    def pairs_of(self, width: int) -> int:
        """Returns the number of floats in a row of pairs; in the layout "parts" the rounding remainders double it."""
        return _padded(width, 2 * _GRANULE) // 2 * (2 if self.parts else 1)

    def padded_outputs(self, width: int) -> int:
        """Returns the number of floats, with padding, in a row of packed weights that has one float per output."""
        return _padded(width, 2 * _GRANULE if self.cuda else _GRANULE)

    def padded_sums(self, width: int) -> int:
        """Returns the number of floats in a row of a partial sum; CUDA adds sums of pairs in blocks of 16 by 32."""
        return _padded(width, 2 * _GRANULE if self.cuda and self.half else _GRANULE)

    # Records ----------------------------------------------------------------------------------------------------------

    def pack(
        self, kind: str, parameter: int, start: int, width: int, floats: int, shape: tuple[int, int], waves: int = _NONE
    ) -> int:
        """Returns the index of the pack for a part of a parameter, ``floats`` in size; adds the pack if it is new."""
        key = (kind, parameter, *shape, start, width, waves)
        if key not in self.packs:
            self.packs[key] = len(self.packs), self.packed
            self.packed += _padded(floats)
        return self.packs[key][0]

    def shape(self, parameter: int) -> tuple[int, int]:
        """Returns the shape of a parameter as a matrix; a vector is one row."""
        shape = self.program.parameters[parameter]
        return (shape[0], shape[1]) if len(shape) == 2 else (1, shape[0])

    def operand(self, c: Columns, place: int = 0, *, product: bool = False, waves: bool = False) -> Any:
        """Returns the record of an operand.

        Args:
            c: the columns of the operand.
            place: the first target column of the operand of a move; 0 for other steps.
            product: whether the record also refers to the pairs of the value, if it has them. Kernels read the x of a
                linear step as pairs. With tile registers they also read pairs for ``relu_slope`` and for sums.
            waves: whether the pairs may be in the order of `_Value.waves`.
        """
        fields: dict[str, Any] = dict.fromkeys(("memory", "input", "pairs"), _NONE)
        fields |= {"start": c.start, "width": c.width, "place": place, "spread": c.spread}
        if c.of == PARAMETER:
            width = 1 if c.spread else c.width
            floats = self.padded_outputs(width) * (2 if self.cuda else 1)
            number = self.pack("vector", c.index, c.start, width, floats, self.shape(c.index))
            return self.compiled.ProgramOperand(parameter=True, slot=number, stride=0, **(fields | {"start": 0}))
        value = self.values[c.index]
        fields |= {"memory": value.memory, "input": value.input}
        if product and _all_of(c, value.width) and (waves or value.waves == _NONE):
            fields["pairs"] = value.pairs
        return self.compiled.ProgramOperand(parameter=False, slot=max(value.slot, 0), stride=value.stride, **fields)

    def waves(self, step: Step, place: int) -> int:
        """Returns the pack in whose order a step reads the columns of an operand, or -1 for the program's order."""
        c = step.operands[place]
        value = self.values[c.index] if c.of == VALUE and _in_any_order(step, place) else None
        return value.waves if value is not None and _all_of(c, value.width) else _NONE

    def emit(self, op: str, operands: Iterable[Any] = (), value: _Value | None = None, **members: Any) -> None:
        """Appends the record of a step."""
        operands = list(operands)
        fields: dict[str, Any] = {"function": "copy", "binary": "add", "encoding": "frequency", "finish": "none"}
        fields |= {"to_registers": "nothing", "from_registers": False}
        fields |= {
            "order": 0,
            "width": 0,
            "slot": 0,
            "stride": 0,
            "memory": _NONE,
            "number": 0,
            "depth": 0,
            "sources": 1,
        }
        fields |= {"parameter": 0, "pairs": _NONE, "floats": True, "points": False, "in_place": False}
        fields |= {"a": 0.0, "b": 0.0}
        if value is not None:
            fields |= {"width": value.width, "slot": max(value.slot, 0), "stride": value.stride}
            fields |= {"memory": value.memory, "pairs": value.pairs, "floats": value.floats}
        fields |= {"first": len(self.operands), "operand_count": len(operands)}
        self.steps.append(self.compiled.ProgramStep(op=op, **(fields | members)))
        self.operands += operands

    def memory(self, width: int) -> int:
        """Adds a buffer of the call, [n, width], and returns its index."""
        self.memories.append(width)
        return len(self.memories) - 1

    # Steps ------------------------------------------------------------------------------------------------------------

    def lowered(self) -> Lowered:
        """Makes all records and returns the lowered program."""
        last = {c.index: at for at, step in enumerate(self.work) for c in step.operands if c.of == VALUE}
        for at, step in enumerate(self.work):
            self.at, dying = at, {c.index for c in step.operands if c.of == VALUE and last[c.index] == at}
            if step.op != "linear":
                self.in_registers = _NONE
            lower: Callable[[Step, set[int]], None] = getattr(self, f"_{step.op}")
            lower(step, dying)
            for value in dying:
                self.free(value)
            if not _sums(step) and step.op != "output" and step.out not in last:
                self.free(step.out)
        return self.finished()

    def free(self, value: int) -> None:
        """Frees the slots of a value after its last use."""
        location = self.values[value]
        if location.slot != _NONE:
            self.slots.give(location.stride, location.slot)
        if location.pairs != _NONE:
            self.slots.give(self.pairs_of(location.width), location.pairs)

    def make(self, step: Step, dying: set[int], entrywise: Iterable[Columns] = (), stride: int = 0) -> _Value:
        """Allocates a step's value: in a new slot, or in the slot of an elementwise operand that is not read later."""
        value = _Value(step.width, stride or _padded(step.width))
        self.values[step.out] = value
        if step.op not in ("input", "encode"):
            value.memory = self._own_output(step)
        scattered = [reader for reader, place in self.readers.get(step.out, []) if reader.op == "scatter" and place]
        if scattered:
            value.memory = self.memory(value.stride)
        if self.cuda and self.half and any(as_pairs := self._as_pairs(step)):  # any step can write pairs on CUDA
            looked_up = step.op == "encode" and step.name == HASH  # its floats may be kept
            if len(self._multipliers(step)) < len(as_pairs):
                place = self._slope_of(step, dying)
                value.pairs = self.slots.take(self.pairs_of(step.width)) if place is None else place
            value.floats = value.memory != _NONE or looked_up or not all(as_pairs)
        value.floats = value.floats and not self._carries(self.at)
        if scattered or not value.floats:
            return value
        for c in entrywise:
            location = self.values[c.index] if c.of == VALUE else None
            if location is None or c.index not in dying or c.spread or c.start or location.stride != value.stride:
                continue
            others = [other for other in step.operands if other.of == VALUE and other.index == c.index]
            here = location.slot != _NONE and location.memory == _NONE and location.input == _NONE
            if here and all(other.start == 0 and not other.spread for other in others):
                value.slot, location.slot = location.slot, _NONE
                return value
        value.slot = self.slots.take(value.stride)
        return value

    def _carries(self, at: int) -> bool:
        """Returns whether a step on CUDA leaves its sums in registers for the next step, their only reader."""
        if not (self.half and self.cuda) or at + 1 == len(self.work):
            return False
        step = self.work[at]
        alone = _adds(self.work[at + 1], step) and len(self.readers[step.out]) == 1
        return alone and step.width <= self.compiled.most_held

    def _multipliers(self, step: Step) -> list[Step]:
        """Returns the later steps that can read a linear step's packed values from registers, on CUDA."""
        steps = list[Step]()
        # A scattered value does not stay in registers, because the warp scatters it before the next step.
        scattered = any(reader.op == "scatter" for reader, _ in self.readers.get(step.out, []))
        if not (self.half and self.cuda) or step.op != "linear" or scattered or self._carries(self.at):
            return steps
        for at in range(self.at + 1, len(self.work)):
            after = self.work[at]
            if after.op != "linear" or max(step.width, after.width) > self.compiled.most_held:
                break
            if after.operands[0][:2] == (VALUE, step.out) and _all_of(after.operands[0], step.width):
                steps.append(after)
            if not self._carries(at):
                break
        return steps

    def _slope_of(self, step: Step, dying: set[int]) -> int | None:
        """Returns the slot with the pairs of a ReLU's output, if a ``relu_slope`` step can overwrite them; else None.

        The step masks its gradient with the ReLU's output, which no later step may read.
        """
        if step.name != "relu_slope" or step.operands[0][:2] == step.operands[-1][:2]:
            return None
        location = self.values[step.operands[-1].index]
        if location.floats or step.operands[-1].index not in dying:
            return None
        place, location.pairs = location.pairs, _NONE
        return place

    def _own_output(self, step: Step) -> int:
        """Returns the buffer of an output into which a step can write its value directly, else -1.

        The output must be the whole value, and its rows must have no padding.
        """
        for reader, _ in self.readers.get(step.out, []):
            whole = step.width % _GRANULE == 0 and self._within(step, step.width)
            if reader.op == "output" and whole and _all_of(reader.operands[0], step.width):
                number, first = map(int, reader.numbers)
                if number not in self.program.by_ray and self.program.outputs[number].width == step.width and not first:
                    return self.output_memories.setdefault(number, self.memory(step.width))
        return _NONE

    def _input(self, step: Step, dying: set[int]) -> None:
        number, readers = int(step.numbers[0]), self.readers.get(step.out, [])
        encoded = [reader.op in ("encode", "scatter") and place == 0 for reader, place in readers]
        value = self.make(step, dying, stride=step.width if readers and all(encoded) else 0)
        plain = number not in self.program.rays
        whole = value.stride == step.width and not all(encoded) and self._within(step, value.stride)
        if plain and readers and (whole or all(self._product(reader, place) for reader, place in readers)):
            value.input = number
        hashed = [reader.op == "scatter" or (reader.name == HASH and not reader.numbers[2]) for reader, _ in readers]
        points = bool(readers) and all(hashed)
        if self.tiles and not self.cuda and any(as_pairs := self._as_pairs(step)):
            value.pairs, value.floats = self.slots.take(self.pairs_of(step.width)), not all(as_pairs)
        self.emit("input", value=value, number=number, points=points, in_place=value.input != _NONE)

    def _within(self, step: Step, stride: int) -> bool:
        """Returns whether vector loads stay within a value's rows of ``stride`` columns, and so within its tensor."""
        columns = [r.operands[p] for r, p in self.readers.get(step.out, []) if r.op not in ("move", "total", "output")]
        return all(c.spread or c.start + _padded(c.width) <= stride for c in columns)

    def _product(self, step: Step, place: int) -> bool:
        """Returns whether a step reads exactly the columns of an operand, without padding lanes.

        This holds for x of a linear step and for the broadcast operand of a sum.
        """
        if step.op == "linear":
            return place < _sources(step)
        return step.op == "outer" and not self.half and place == (0 if self._by_outputs(step) else 1)

    def _linear(self, step: Step, dying: set[int]) -> None:
        matrix, start, transposed = map(int, step.numbers[:3])
        o, i = self.shape(matrix)
        count, relu_slope = _sources(step), step.name == "relu_slope"
        sources, added = step.operands[:count], step.operands[count : len(step.operands) - relu_slope]
        depth, unit = sum(c.width for c in sources), 2 * _GRANULE if self.half else _GRANULE
        few = step.width <= _NARROW and not relu_slope and all(c.width % unit == 0 for c in sources) and not self.tiles
        few = few and not self.cuda
        few = few and all(c.of == PARAMETER for c in added)
        order = 0 if not few else 1 if step.width == 1 else _NARROW
        kind, width = ("transposed", step.width) if transposed else ("matrix", depth)
        kind = f"few{'_transposed' * transposed}" if few else kind
        deep = self.pairs_of(depth) if self.tiles else -(-depth // 2) if self.half else depth
        deep = _padded(depth) if self.cuda and not self.half else deep
        deep *= order or self.padded_outputs(step.width)
        number = self.pack(kind, matrix, start, width, deep, (o, i), self.waves(step, 0))
        slope = len(step.operands) - 1 if relu_slope and self.tiles else _NONE
        records = [
            self.operand(c, product=at < count or at == slope, waves=_in_any_order(step, at))
            for at, c in enumerate(step.operands)
        ]
        entrywise = [c for c in step.operands[count:] if all(c[:2] != x[:2] for x in sources)]
        value = self.make(step, dying, entrywise)
        as_pairs = self._as_pairs(step)
        narrow = self.half and not self.cuda and any(as_pairs) and not few and (self.tiles or not relu_slope)
        filled = value.stride % (2 * _GRANULE) == 0 and step.width % 2 == 0 and value.memory == _NONE
        if self.tiles:  # addends could write infinities to padding lanes
            filled = step.width % _GRANULE == 0 or all(c.of == PARAMETER for c in added)
        if narrow and filled:
            floats = value.memory != _NONE or not all(as_pairs)
            value.pairs, value.floats = self.slots.take(self.pairs_of(step.width)), floats
        members = {"order": order, "number": number, "depth": depth, "sources": count, "finish": step.name or "none"}
        held = sources[0][:2] == (VALUE, self.in_registers)
        members["from_registers"] = held and _all_of(sources[0], self.values[self.in_registers].width)
        kept = "sums" if self._carries(self.at) else "words" if self._multipliers(step) else "nothing"
        members["to_registers"] = kept
        if kept != "sums":
            self.in_registers = step.out if kept == "words" else _NONE
        self.emit("linear", records, value, **members)

    def _as_pairs(self, step: Step) -> list[bool]:
        """Returns, for each reader of a step's value, whether the reader takes pairs."""

        def takes(reader: Step, place: int) -> bool:
            if not _all_of(reader.operands[place], step.width):
                return False
            if self._reorders(step) and not _in_any_order(reader, place):
                return False
            if reader.op == "linear":
                slope = reader.name == "relu_slope" and place == len(reader.operands) - 1
                return place == 0 or (self.tiles and slope)
            return self.tiles and (reader.op == "outer" or (reader.op == "columns" and not self.parts))

        return [takes(reader, place) for reader, place in self.readers.get(step.out, [])]

    def _function(self, step: Step, dying: set[int]) -> None:
        records = [self.operand(c) for c in step.operands]
        value = self.make(step, dying, step.operands)
        order, a, b = step.numbers
        self.emit("function", records, value, function=step.name, order=int(order), a=float(a), b=float(b))

    def _binary(self, step: Step, dying: set[int]) -> None:
        records = [self.operand(c) for c in step.operands]
        self.emit("binary", records, self.make(step, dying, step.operands), binary=step.name)

    def _total(self, step: Step, dying: set[int]) -> None:
        records = [self.operand(c) for c in step.operands]
        self.emit("total", records, self.make(step, dying), number=int(step.numbers[0]))

    def _move(self, step: Step, dying: set[int]) -> None:
        records = [self.operand(c, int(at)) for c, at in zip(step.operands, step.numbers)]
        self.emit("move", records, self.make(step, dying), order=int(_covered(step)))

    def _encode(self, step: Step, dying: set[int]) -> None:
        size, parameter, order, _ = map(int, step.numbers)
        records = [self.operand(c) for c in step.operands]
        value = self.make(step, dying)
        members: dict[str, Any] = {"encoding": step.name, "order": order, "parameter": parameter}
        members |= {"number": size, "depth": size}
        if step.name == HASH and not order and self._within(step, value.stride):
            value.memory = self.memory(value.stride)
            source = self._input_of(step.operands[0])
            self.lookups.append((Lookup(source, parameter, size), value.memory))
        if octaves := _by_octaves(step):
            raw = step.operands[0].width
            width = _padded(encoded_columns(step.name, raw, size))
            members["number"] = self.pack("waves", 0, int(octaves == 1), width, 3 * width, (size, raw // octaves))
            if self._reorders(step) and value.pairs != _NONE:
                value.waves = members["number"]
        if self.tiles and not self.cuda and not order and octaves == 1 and any(as_pairs := self._as_pairs(step)):
            value.pairs = self.slots.take(self.pairs_of(step.width))
            value.floats = value.memory != _NONE or not all(as_pairs)
        self.emit("encode", records, value, **members)

    def _reorders(self, step: Step) -> bool:
        """Returns whether a step writes pairs in the order of `_Value.waves`."""
        return self.cuda and step.op == "encode" and _by_octaves(step) > 0 and not int(step.numbers[2])

    def _input_of(self, x: Columns) -> int:
        (number,) = [int(step.numbers[0]) for step in self.work if step.op == "input" and step.out == x.index]
        return number

    def _scatter(self, step: Step, dying: set[int]) -> None:
        grid, parameter, _ = map(int, step.numbers)
        x, g = step.operands
        self.scatters.append((Lookup(self._input_of(x), parameter, grid), self.values[g.index].memory, step.out))

    def _output(self, step: Step, dying: set[int]) -> None:
        number, first = map(int, step.numbers)
        self.emit("output", [self.operand(step.operands[0])], width=step.width, number=number, depth=first)

    def _by_outputs(self, step: Step) -> bool:
        """Returns whether an outer step stores its partial sum as [outputs, inputs]: with shorter padded rows."""
        o, i = step.operands[0].width, step.operands[1].width
        return o * _padded(i) < i * _padded(o)

    def _outer(self, step: Step, dying: set[int]) -> None:
        shape, start, at = self.program.sums[step.out], int(step.numbers[0]), self.partial
        by_outputs = self._by_outputs(step)
        o, i = step.operands[0].width, step.operands[1].width
        stride = self.padded_sums(i if by_outputs else o)
        rows = o if by_outputs else i
        self.partial += stride * (_padded(rows) if self.cuda and self.half else rows)
        kind = "outputs_inputs" if by_outputs else "inputs_outputs"
        size = shape[0] * shape[1]
        self.sums.append((step.out, kind, at, o, shape[1], start, i, stride, size, self.waves(step, 1)))
        broadcast = 0 if by_outputs else 1
        records = [
            self.operand(c, product=self.tiles or place == broadcast, waves=_in_any_order(step, place))
            for place, c in enumerate(step.operands)
        ]
        self.emit("outer", records, number=at, stride=stride, order=int(by_outputs))

    def _columns(self, step: Step, dying: set[int]) -> None:
        shape, start, at = self.program.sums[step.out], int(step.numbers[0]), self.partial
        size, stride = shape[0] * (shape[1] if len(shape) > 1 else 1), self.padded_sums(step.width)
        self.partial += stride
        self.sums.append((step.out, "vector", at, 1, size, start, step.width, stride, size, _NONE))
        records = [self.operand(step.operands[0], product=self.tiles and not self.parts)]
        self.emit("columns", records, number=at, stride=stride, width=step.width)

    def finished(self) -> Lowered:
        """Assembles the records into the lowered program."""
        program, compiled = self.program, self.compiled
        scattered = [out for _, _, out in self.scatters]
        for i, shape in enumerate(program.sums):
            if i not in scattered and not any(record[0] == i for record in self.sums):
                size = shape[0] * (shape[1] if len(shape) > 1 else 1)
                self.sums.append((i, "none", 0, 0, 0, 0, 0, 0, size, _NONE))
        self.sums.sort()
        outputs = []
        for number, c in enumerate(program.outputs):
            ray = number in program.by_ray
            outputs.append(
                compiled.ProgramOutput(
                    c.width, ray, self.memory(c.width) if ray else self.output_memories.get(number, _NONE)
                )
            )
        steps = [
            step._replace(memory=outputs[step.number].memory)
            if step.op == "output" and step.number in program.by_ray
            else step
            for step in self.steps
        ]
        whole = any(step.op == "encode" and step.name != HASH and not _by_octaves(step) for step in self.work)
        fewest, most = (_WHOLE if whole else _ROWS[0]), _ROWS[1]
        if self.tiles:
            fewest = most if whole else _TILE
        fitting = _FLOATS // max(self.slots.size, 1) // fewest * fewest
        table = compiled.ProgramTable(
            packs=[compiled.ProgramPack(*key, at) for key, (_, at) in self.packs.items()],
            steps=steps,
            operands=self.operands,
            sums=_sum_records(self.sums),
            inputs=[compiled.ProgramInput(w, i in program.rays) for i, w in enumerate(program.inputs)],
            outputs=outputs,
            memories=self.memories,
            lookups=[compiled.ProgramLookup(*lookup, memory) for lookup, memory in self.lookups],
            scatters=[compiled.ProgramScatter(*lookup, memory, out) for lookup, memory, out in self.scatters],
            grids=[compiled_grid(text) for text in program.grids],
            sum_tensors=len(program.sums),
            parameters=len(program.parameters),
            tile=min(max(fitting, fewest), most),
            columns=self.slots.size,
            packed=self.packed,
            partial=self.partial,
            scratch=self.scratch,
            scratch_width=self.scratch_width,
            layout=self.layout,
        )
        compiled_program = compiled.make_program(table)
        widths = tuple(self.memories[memory] for _, memory in self.lookups)
        sizes = tuple(map(math.prod, program.parameters))
        call = compiled.ProgramCall(
            compiled_program,
            [(columns.width, i in program.by_ray) for i, columns in enumerate(program.outputs)],
            [(-1 if of is None else of, shape) for of, shape in zip(program.sum_tables, program.sums)],
            widths,
            program.tables,
            sizes,
            program.rays[0] if program.rays else -1,
            LARGE,
            on_huge_pages,
        )
        return Lowered(
            compiled_program, tuple(lookup for lookup, _ in self.lookups), widths, sizes, program.tables, call
        )


def _sum_records(parts: list[_SumPart]) -> list[Any]:
    """Returns the records of the parts of sums, in order.

    If the parts of a sum cover it without overlap, they overwrite its memory. Otherwise they are added to it.
    """
    spans: dict[int, list[tuple[int, int]]] = {}
    for out, _, _, _, _, start, width, _, _, _ in parts:
        spans.setdefault(out, []).append((start, start + width))
    records = []
    for part in parts:
        ends = sorted(spans[part[0]])
        beside = all(end == start for (_, end), (start, _) in itertools.pairwise(ends))
        whole = beside and part[1] != "none" and (ends[0][0], ends[-1][1]) == (0, part[4])
        records.append(native.compiled.ProgramSum(*part[:2], not whole, *part[2:]))
    return records


def _all_of(c: Columns, width: int) -> bool:
    """Returns whether columns are all columns of a value."""
    return c.start == 0 and c.width == width and not c.spread


def _sums(step: Step) -> bool:
    return step.op in ("outer", "columns", "scatter")


def _by_octaves(step: Step) -> int:
    """Returns `Encoding.octaves` of a step: the columns of x for one angle; 0 if it encodes no sines and cosines."""
    return ENCODINGS[step.name].octaves if step.name in ENCODINGS else 0


def _in_any_order(step: Step, place: int) -> bool:
    """Returns whether a step can read an operand in another order of columns: as inputs of a layer's weights."""
    return (step.op == "linear" and place == 0 and not int(step.numbers[2])) or (step.op == "outer" and place == 1)


def _sources(step: Step) -> int:
    """Returns the number of operands that a linear step concatenates and multiplies by its weights."""
    return int(step.numbers[3]) if len(step.numbers) > 3 else 1


def _adds(step: Step, to: Step) -> bool:
    """Returns whether a linear step adds its product to the value of ``to``, a linear step without activation."""
    added = step.operands[1 : len(step.operands) - (step.name == "relu_slope")] if step.op == "linear" else ()
    plain = to.op == "linear" and not to.name
    return plain and any(c.of == VALUE and c.index == to.out and _all_of(c, to.width) for c in added)


def _delayed(steps: list[Step]) -> list[Step]:
    """Moves each product directly before the step that adds to it, if no other step reads it; returns the steps."""
    uses = [c.index for step in steps for c in step.operands if c.of == VALUE]
    result = list(steps)
    for step in reversed(steps):
        for to in [to for to in steps if _adds(step, to) and uses.count(to.out) == 1]:
            result.remove(to)
            result.insert(result.index(step), to)
    return result


def _joined(steps: list[Step]) -> list[Step]:
    """Joins the linear steps of a layer that reads several sources into one linear step; returns the steps.

    The columns of the sources must be adjacent in the weights. The number of sources becomes the fourth number of the
    step. The sums stay in registers from source to source.
    """
    uses = [c.index for step in steps for c in step.operands if c.of == VALUE]
    makers = {step.out: step for step in steps if not _sums(step) and step.op != "output"}
    joined: set[int] = set()
    for place, step in enumerate(steps):
        add = step.operands[1] if step.op == "linear" and len(step.operands) == 2 else None
        before = makers.get(add.index) if add is not None and add.of == VALUE else None
        if add is None or before is None or before.op != "linear" or before.name or uses.count(before.out) > 1:
            continue
        (matrix, start, transposed), count = step.numbers[:3], _sources(before)
        width = sum(c.width for c in before.operands[:count])
        follows = before.numbers[:3] == (matrix, start - width, transposed) and not transposed
        if not follows or not _all_of(add, before.width) or count >= native.compiled.most_sources:
            continue
        operands = (*before.operands[:count], step.operands[0], *before.operands[count:])
        steps[place] = makers[step.out] = step._replace(
            operands=operands, numbers=(matrix, start - width, transposed, count + 1)
        )
        joined.add(before.out)
    return [step for step in steps if _sums(step) or step.op == "output" or step.out not in joined]


def _covered(step: Step) -> bool:
    """Returns whether each column of a move comes from exactly one part."""
    columns = [column for c, at in zip(step.operands, step.numbers) for column in range(int(at), int(at) + c.width)]
    return sorted(columns) == list(range(step.width))
