"""Running a module on rows that are sorted by cell: in a loop over cells, which defines the result, or once for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from voronerf.router.grouped import GroupedRun, PerCell, Ungroupable
from voronerf.router.grouping import Grouping, Part, Tables
from voronerf.router.layout import Call, Given, Layout
from voronerf.router.parameters import cell_parameters, clone_module, in_place_of_parameters
from voronerf.router.trees import rebuild, tensors_of
from voronerf.tolerances import agree

_DRAWS = """
    rand_like randn_like randint_like bernoulli normal_ uniform_ bernoulli_ exponential_ random_ cauchy_ log_normal_
    geometric_ dropout dropout_ alpha_dropout feature_alpha_dropout rrelu rand randn randint randperm normal multinomial
"""
RANDOM = frozenset(
    getattr(place, name) for place in (torch, torch.Tensor, F) for name in _DRAWS.split() if hasattr(place, name)
)
"""What draws random numbers."""


class NoRandomness(TorchFunctionMode):
    """Random numbers are 0 and dropout does nothing, so that two calls can be compared."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func not in RANDOM:
            return func(*args, **kwargs)
        if "dropout" in getattr(func, "__name__", ""):
            return args[0] if args else kwargs["input"]
        return func(*args, **kwargs).zero_()


@dataclass
class Results:
    """What a method returned for rows.

    Attributes:
        value: Of any structure.
        tensors: Its tensors, [n * m, ...] where they have rows.
        rows: Which of them have rows.
        flattened: Which of them are [n, ...] though the module saw [1, n, ...].
    """

    value: Any
    tensors: list[Tensor]
    rows: list[bool]
    flattened: list[bool]


def run_cells(call: Call, given: Given, grouping: Grouping, *, again: bool = False) -> Results:
    """A module's results for sorted rows, one call for each cell that has any.

    Where its code runs ``again`` in the backward pass (``torch.utils.checkpoint``), every cell has a copy of the
    module, which keeps the cell's parameters.

    Raises:
        ValueError: For a result without a row for each sample, or other results in some cells.
    """
    module, occupied = call.module, grouping.occupied()
    parameters = {id(p): p for _, _, p in cell_parameters(module)}
    pieces = {key: parameter.unbind(0) for key, parameter in parameters.items()}
    results = []
    for cell, first, last in occupied:
        own: dict[int, Any] = {key: values[cell] for key, values in pieces.items()}
        part = given if len(occupied) == 1 else given.part(first, last, call.layout.axis)
        if again:
            kept = {id(tensor): tensor for tensor in (*module.buffers(), *module.parameters())}
            results.append(replace(call, module=clone_module(module, kept | own)).run(part))
            continue
        with in_place_of_parameters(module, own):
            results.append(call.run(part))
    return _join(results, [last - first for _, first, last in occupied], module, call.layout)


def _join(results: list[Any], counts: list[int], module: nn.Module, layout: Layout) -> Results:
    """The results of cells as one."""
    parts = [tensors_of(result) for result in results]
    if any(len(part) != len(parts[0]) for part in parts):
        raise ValueError("VoronoiRouter: module must return as many tensors for every cell, got different numbers")
    same = {id(buffer) for buffer in module.buffers()}
    joined = Results(results[0], [], [], [])
    for pieces in zip(*parts, strict=True):
        constant = id(pieces[0]) in same
        rows = [layout.rows_of(piece) for piece in pieces]
        m = rows[0].shape[0] // counts[0] if rows[0].dim() else 0
        if not constant and (m == 0 or any(r.dim() == 0 or r.shape[0] != m * n for r, n in zip(rows, counts))):
            raise ValueError(
                "VoronoiRouter: results must have a row for each sample, got "
                f"{list(pieces[0].shape)} for {counts[0]} samples"
            )
        joined.tensors.append(pieces[0] if constant else rows[0] if len(rows) == 1 else torch.cat(rows))
        joined.rows.append(not constant)
        joined.flattened.append(layout.axis > 0 and pieces[0].shape == rows[0].shape)
    return joined


def check_rows(call: Call, given: Given, grouping: Grouping, again: bool) -> None:
    """Finds out whether a module gives other results for samples when other samples are left out.

    Raises:
        TypeError: When it does.
    """
    cell, first, last = max(grouping.occupied(), key=lambda bounds: bounds[2] - bounds[1])
    middle = (first + last) // 2
    outcomes = []
    for a, b in ((first, last), (first, middle), (middle, last)):
        part = given.part(a, b, call.layout.axis)
        cells = torch.full((b - a,), cell, dtype=torch.int32, device=grouping.device)
        alone = Grouping(cells, b - a, grouping.k, grouping.device, grouping.backend)
        outcomes.append(run_cells(call, part, alone, again=again))
    whole, *halves = outcomes
    for i, tensor in enumerate(whole.tensors):
        if whole.rows[i] and not agree(torch.cat([half.tensors[i] for half in halves]), tensor):
            raise TypeError(
                f"VoronoiRouter: module must treat samples one by one, but {type(call.module).__name__} gives other "
                "results for a sample when other samples are left out: it mixes samples (attention or statistics over "
                "a batch)"
            )


def run_grouped(call: Call, grouping: Grouping, piece: int) -> Results:
    """A module's results for the samples of all cells, in one run, or on a CPU in pieces of so many rows.

    Raises:
        Ungroupable: Where that is not possible.
    """
    parts = grouping.parts(piece) if grouping.device.type == "cpu" else [grouping]
    tables, chunks = Tables(), _chunks(call.module, parts)
    found = [
        run_part(call, call.arranged(part), part, chunk, tables)[0] for part, chunk in zip(parts, chunks, strict=True)
    ]
    first = found[0]
    if len(found) == 1:
        return first
    tensors = [
        torch.cat([results.tensors[i] for results in found]) if first.rows[i] else tensor
        for i, tensor in enumerate(first.tensors)
    ]
    return replace(first, tensors=tensors)


def _chunks(module: nn.Module, parts: list[Grouping]) -> list[dict[int, Tensor] | None]:
    """For each part the parameters of its cells, by the ids of those of all cells; None for all of them.

    They are split once for all parts: their gradient is then put together once, where that of a slice would fill a
    tensor of all cells for each part.
    """
    own = [part for part in parts if isinstance(part, Part)]
    if not own:
        return [None] * len(parts)
    sizes = {part.start: part.k for part in own}
    pieces = {id(p): p.split(list(sizes.values())) for _, _, p in cell_parameters(module)}
    number = {start: i for i, start in enumerate(sizes)}
    return [{key: split[number[part.start]] for key, split in pieces.items()} for part in own]


def run_part(
    call: Call,
    given: Given,
    part: Grouping,
    chunk: dict[int, Tensor] | None = None,
    tables: Tables | None = None,
) -> tuple[Results, GroupedRun]:
    """The results for some rows, and the run that gave them; ``chunk`` is None where the part has all cells."""
    module, layout = call.module, call.layout
    run = GroupedRun(part, layout.axis, tables)
    for tensor in given.rows:
        run.mark(tensor)
    stand_ins: dict[int, Tensor] = {
        id(p): PerCell(p if chunk is None else chunk[id(p)], is_parameter=True, origin=(p, part.start))
        for _, _, p in cell_parameters(module)
    }
    with in_place_of_parameters(module, stand_ins), run:
        value = call.run(given)
    if run.failed is not None:
        raise run.failed
    results = Results(value, [], [], [])
    buffers = {id(buffer) for buffer in module.buffers()}
    for tensor in tensors_of(value):
        if isinstance(tensor, PerCell):
            raise Ungroupable("a result is made of parameters alone")
        marked, rows = run.is_rows(tensor), layout.rows_of(tensor)
        if marked and (rows.dim() == 0 or not rows.shape[0] or rows.shape[0] % part.n):
            raise Ungroupable(f"a result of shape {list(tensor.shape)} has no row for each of {part.n} samples", True)
        if not marked and rows.shape[:1] == (part.n,) and id(tensor) not in buffers:
            raise Ungroupable("a result has rows that no PyTorch function was seen to make")
        results.tensors.append(rows if marked else tensor)
        results.rows.append(marked)
        results.flattened.append(layout.axis > 0 and rows.shape == tensor.shape)
    return results, run


def restored(results: Results, layout: Layout, grouping: Grouping | None, flat: Sequence[bool]) -> Any:
    """Results in the caller's order, with the leading dimensions of the call.

    They are in that order already where ``grouping`` is None; ``flat`` says which tensors the module itself flattens to
    [rays * samples, ...].
    """
    tensors = []
    for i, tensor in enumerate(results.tensors):
        if results.rows[i]:
            tensor = _unsorted(tensor, layout, grouping)
            tensor = layout.restore(tensor, results.flattened[i] or (i < len(flat) and flat[i]))
        tensors.append(tensor)
    return rebuild(results.value, tensors)


def _unsorted(rows: Tensor, layout: Layout, grouping: Grouping | None) -> Tensor:
    if grouping is None:
        return rows
    m = rows.shape[0] // grouping.n
    if m > 1:
        rows = rows.reshape(grouping.n, m, *rows.shape[1:])
    rows = grouping.unsort(rows)
    if not layout.n:
        rows = rows[:0]
    return rows.flatten(0, 1) if m > 1 else rows
