"""Fuses a module whose ``forward`` is fixed: its functions become one program, or several programs.

The module is traced once (:mod:`voronerf.router.trace`). Functions that can be steps of a program (``router/lower.py``)
are joined into the largest possible subprograms, each of which is one operation; messages call them "runs". Functions
between subprograms, such as look-ups, run in PyTorch for the rows of all cells at once, or by the rules of
:mod:`voronerf.router.rules` if they take parameters of cells.

Letters: n samples, k cells, w columns.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, fx
from torch.fx.node import map_arg

from voronerf.ops._core.program import VALUE, Builder, Columns, Program, Step
from voronerf.ops._core.unchanged import Stale, unchanged
from voronerf.ops.grouped_program import grouped_program
from voronerf.router.axes import SampleCount
from voronerf.router.grouped import GroupedRun, PerCell, Ungroupable, name_of
from voronerf.router.grouping import Grouping, owned_parameters, parts_of
from voronerf.router.layout import Call, Results, map_tensors, recordable, tensors_of
from voronerf.router.lower import Entries, Lowering, NotAStep
from voronerf.router.trace import CELLS, SAMPLES, Trace, Unfusable, differentiable, is_custom
from voronerf.router.watch import Inputs, lookup
from voronerf.router.waves import with_encodings

HALF = (torch.bfloat16, torch.float16)  # programs compute these dtypes in float32, and round their results


class ParameterEntries:
    """A parameter of a program: selected entries [o, i] or [w] of a source, which is a tensor or a node's value."""

    def __init__(self, of: Any, codes: Tensor) -> None:
        self.of, self._shape, numbers = of, codes.shape, codes.flatten()
        self._is_of_cells = isinstance(of, fx.Node) and of.meta["on"] == CELLS
        every = torch.arange((of.meta["value"] if isinstance(of, fx.Node) else of).numel(), device="cpu")
        self._is_whole = torch.equal(numbers, every)
        self._is_transposed = codes.dim() == 2 and torch.equal(codes.t().flatten(), every)
        self._numbers = numbers.clone()  # a copy, because an inference tensor cannot be saved for a backward pass

    def constants(self) -> list[float] | None:
        """Returns the entries as numbers if the source is a constant, else None."""
        values: list[float] | None = None
        if isinstance(self.of, Tensor):
            values = self.of.detach().flatten().cpu()[self._numbers].tolist()
        return values

    def resolve(self, values: Mapping[Any, Any]) -> Tensor:
        """Returns the source itself if all entries are selected in its own shape; else the result of `select`."""
        value: Tensor = values.get(self.of, self.of)
        whole = self._is_whole and value.shape[self._is_of_cells :] == self._shape
        return value if whole else self.select(values)

    def select(self, values: Mapping[Any, Any]) -> Tensor:
        """Returns the selected entries, [k, ...], or [1, ...] if cells share the source."""
        value = values.get(self.of, self.of)
        flat = value.reshape(value.shape[0] if self._is_of_cells else 1, -1)
        if self._is_whole:
            return flat.reshape(-1, *self._shape)
        if self._is_transposed:
            return flat.reshape(-1, *self._shape[::-1]).transpose(1, 2)
        return flat.index_select(1, self._numbers.to(flat.device)).reshape(-1, *self._shape)


@dataclass
class Subprogram:
    """Adjacent steps as one program, with its outputs and with the tensors that its inputs and parameters read."""

    program: Program
    inputs: list[Any] = field(default_factory=list)  # nodes, or values of earlier subprograms
    parameters: list[ParameterEntries] = field(default_factory=list)
    outputs: list[Any] = field(default_factory=list)


class WholeProgram(NamedTuple):
    """A call as one program, the indices of the arguments it reads, and each result's shape and dtype per sample."""

    program: Program
    reads: tuple[int, ...]
    results: tuple[tuple[tuple[int, ...], torch.dtype], ...]


class Fused:
    """A call of the routed module as subprograms with PyTorch functions between them.

    The call is traced on rows of its arguments (:class:`voronerf.router.trace.Trace`). Raises :class:`Unfusable` if
    nothing can be fused, or if a function cannot be repeated for other samples.

    Attributes:
        inputs: The numbers and buffers that are looked up in each call.
        reads: The attributes that ``forward`` reads, as (index of the submodule in ``modules()``, name).
    """

    def __init__(self, call: Call, tensors: list[Tensor], inputs: Inputs) -> None:
        self.module, self.inputs = call.module, inputs
        trace = Trace(self._with_inputs(call, tensors[0].device), tensors, inputs)
        parts, self.reads = list(parts_of(call.module).values()), trace.reads
        self._places = [(parts[i], i, name) for i, name in trace.places]
        self._n, self._inputs, self._shared, self._parameters = trace.n, trace.inputs, trace.shared, trace.parameters
        self.result, self._outputs = trace.result, trace.outputs
        self._owned = [(owner, name) for owner, name, _ in owned_parameters(call.module)]
        if not all(isinstance(value, fx.Node) and value.meta["on"] == SAMPLES for value in self._outputs):
            raise Unfusable("a result depends on no sample")
        self._recorded = torch.is_grad_enabled() or any(node.meta.get("grad") for node in trace.graph.nodes)
        self._differentiates = any(node.target is torch.autograd.grad for node in trace.graph.nodes)
        self._lowering = Lowering(trace.rows)
        self._entries: dict[fx.Node, Entries] = {}  # entries of each value that steps compute or move
        self._ready: dict[fx.Node, int] = {}  # for values of PyTorch: the first subprogram that can read it
        self._reasons: dict[fx.Node, str] = {}
        for node in trace.graph.nodes:
            self._add(node)
        needed = self._needed()
        nodes = [node for node in trace.graph.nodes if node in needed and node.op == "call_function"]
        self._weights = [node for node in nodes if node.meta["on"] != SAMPLES]
        self._between = [node for node in nodes if node.meta["on"] == SAMPLES]
        for node in self._between:
            if is_custom(node) and any(source.meta["on"] == CELLS for source in node.all_input_nodes):
                raise Unfusable(
                    f"{name_of(node.target)}{node.meta['line']} is a custom function that takes parameters of cells; "
                    "write it with functions of PyTorch"
                )
        self._writes = any(node.meta.get("inplace") for node in self._between)
        if not self._writes:  # subprograms give contiguous results, of which a view may need a copy
            for node in self._between:
                if node.target is Tensor.view and not isinstance(node.args[1], torch.dtype):
                    node.target = Tensor.reshape
        self._runs = self._cut()
        if not any(run.parameters for run in self._runs.values()):
            first = next(iter(self._reasons.values()), "no result depends on a layer")
            raise Unfusable(f"no layer can be part of a run: {first}")
        self._sorted = any(_meets_cells(node) for node in self._between)
        lines: dict[str, dict[str, None]] = {}  # functions that are not steps, by line of the module
        for node in self._between:
            if node in self._reasons and node.target is not differentiable:
                lines.setdefault(node.meta["line"], {})[name_of(node.target)] = None
        texts = [f"{', '.join(functions)}{line}" for line, functions in lines.items()]
        self.name = "fused in runs" if len(self._runs) > 1 or texts else "fused"
        self.why = (
            f"{len(self._runs)} run{'s' * (len(self._runs) > 1)}, between them {'; '.join(texts)}" if texts else ""
        )
        for node in trace.graph.nodes:
            if isinstance(node.meta.get("value"), Tensor):
                node.meta["dtype"] = node.meta.pop("value").dtype
        del self._lowering, self._entries

    # Cutting ----------------------------------------------------------------------------------------------------------

    def _add(self, node: fx.Node) -> None:
        """Decides whether a node is computed by steps, or by PyTorch between subprograms."""
        if node.meta["on"] != SAMPLES or node.op == "placeholder" or isinstance(node.meta.get("value"), int):
            self._ready[node] = 0
            return
        if "results" not in node.meta:  # the node is one of several results of a function
            return
        try:
            self._lower(node)
            if self._is_left_to_torch(node):
                ready = max(self._ready[source] for source in node.all_input_nodes)
                self._ready.update(dict.fromkeys((node, *node.meta["results"]), ready))
        except Exception as error:  # NotAStep, or an unforeseen form of arguments
            self._reasons[node] = f"{name_of(node.target)}{node.meta['line']}, which cannot be a step: {error}"
            self._ready[node] = max((self._at(source) for source in node.all_input_nodes), default=0)
            for value in node.meta["results"]:
                self._ready[value] = self._ready[node]
                self._entries.pop(value, None)

    def _is_left_to_torch(self, node: fx.Node) -> bool:
        """Returns whether PyTorch computes a node, although the node could be steps of a program.

        Such a node takes no tensors, like ``zeros``, or only moves entries of arguments and of values that PyTorch
        computes.
        """
        sources = node.all_input_nodes
        if not all(source in self._ready for source in sources):
            return False
        values = set().union(*(self._lowering.values(self._entries[value].codes) for value in node.meta["results"]))
        return values <= self._lowering.sources.keys() or all(isinstance(s.meta.get("value"), int) for s in sources)

    def _at(self, node: fx.Node) -> int:
        """Returns the number of the first subprogram that can read a value."""
        if node in self._ready:
            return self._ready[node]
        return max(map(self._lowering.level, self._lowering.values(self._entries[node].codes)), default=-1) + 1

    def _entries_of(self, node: fx.Node) -> Entries:
        """Returns, for each entry of a node's value, the sample and column or the parameter entry that it equals."""
        if node not in self._entries:
            value = node.meta["value"]
            if not value.is_floating_point():
                raise NotAStep(f"a tensor of {value.dtype}")
            self._entries[node] = (
                self._lowering.input(node, value.shape, node.meta["axis"], self._ready[node])
                if node.meta["on"] == SAMPLES
                else Entries.whole(value, node)
            )
            _match_strides(self._entries[node], value)
        return self._entries[node]

    def _lower(self, node: fx.Node) -> None:
        values: dict[int, fx.Node] = {}

        def value_of(source: fx.Node) -> Any:
            value = source.meta["value"]
            if isinstance(value, Tensor) and not source.meta.get("counts"):
                values[id(value)] = source
            return value

        if is_custom(node):
            raise NotAStep("a custom function with its own backward; write it with functions of PyTorch")
        if node.target in (torch.autograd.grad, differentiable):
            raise NotAStep("a gradient")
        args, kwargs = map_arg((node.args, node.kwargs), value_of)

        def entries_of(value: Tensor) -> Entries | None:
            return self._entries_of(values[id(value)]) if id(value) in values else None

        function: Any = node.target
        written: Any = node.args[0] if node.meta["inplace"] else None
        old_entries = written and Entries(self._entries_of(written).codes.clone(), self._entries_of(written).of)
        # A plain dict, because map_tensors makes its result of the same type, and map_arg returns an immutable dict.
        result, args, entries = self._lowering.run(function, args, dict(kwargs), entries_of)
        entry_list = [entries(tensor) for tensor in ([args[0]] if written else tensors_of(result))]
        if written:  # the write changed these codes in place, for views too
            self._entries[written] = old_entries
        # The codes of a view of an argument share memory with the codes of the argument, so their strides stay.
        memory = {source.meta["value"].untyped_storage().data_ptr() for source in values.values()}
        for value, value_entries in zip(node.meta["results"], entry_list, strict=True):
            if value.meta["value"].untyped_storage().data_ptr() not in memory:
                _match_strides(value_entries, value.meta["value"])
            if self._recorded and not node.meta["grad"]:
                places, numbers = self._lowering.order(value_entries.codes)
                b = self._lowering.builder
                stopped = b.apply("stop", self._lowering.operand(numbers))
                codes = torch.empty_like(value_entries.codes).flatten()
                codes[places] = self._lowering._codes(stopped)
                value_entries = Entries(codes.reshape(value_entries.codes.shape))
            self._entries[value] = value_entries

    def _needed(self) -> set[fx.Node]:
        """Returns the nodes that PyTorch computes, and collects the steps that these nodes and the results need."""
        needed: set[fx.Node] = set()
        lowering, steps = self._lowering, self._lowering.builder.steps
        self._columns: dict[fx.Node, Columns] = {}
        self._live: set[int] = set()
        waiting = list(self._outputs)
        while waiting:
            node = waiting.pop()
            if node in needed or node in self._columns:
                continue
            if node in self._ready:
                needed.add(node)
                waiting += node.all_input_nodes
                continue
            self._columns[node] = self._columns_of(node)
            values = [self._columns[node].index]
            while values:
                step = steps[values.pop()]
                if step.out in self._live:
                    continue
                self._live.add(step.out)
                values += [c.index for c in step.operands if c.of == VALUE]
                used = [c.index for c in step.operands if c.of != VALUE]
                used += [int(step.numbers[0])] if step.op == "linear" else []
                sources = [lowering.parameters[index][0] for index in used]
                sources += [lowering.sources[step.out]] if step.op == "input" else []
                waiting += [source for source in sources if isinstance(source, fx.Node)]
        return needed

    def _columns_of(self, node: fx.Node) -> Columns:
        """Returns the columns of a node's value, and stores their layout in the node."""
        codes, axis = self._entries[node].codes, node.meta["axis"]
        turned = codes if axis is None else codes.movedim(axis.dim, 0).reshape(self._lowering.rows, -1)
        if axis is None or not self._lowering.is_by_row(turned):
            raise Unfusable(f"{name_of(node.target)}{node.meta.get('line', '')} mixes samples")
        node.meta["layout"] = [*codes.shape[: axis.dim], *codes.shape[axis.dim + 1 :]], *axis
        columns = self._lowering.operand(turned[0] & ((1 << 32) - 1))
        return columns if columns.index not in self._lowering.sources else self._lowering.builder.apply("copy", columns)

    def _cut(self) -> dict[int, Subprogram]:
        """Returns the subprograms, by number; the level of a step is the number of its subprogram."""
        lowering, steps = self._lowering, self._lowering.builder.steps
        live = self._live
        level = {value: lowering.level(value) for value in live}
        runs: dict[int, Subprogram] = {}
        for number in sorted({level[v] for v in live if v not in lowering.sources}):
            chosen = [steps[v] for v in sorted(live) if level[v] == number and v not in lowering.sources]
            later = {c.index for v in live if level[v] > number for c in steps[v].operands if c.of == VALUE}
            outputs: list[Any] = [step.out for step in chosen if step.out in later]
            operands = [Columns(VALUE, v, 0, steps[v].width) for v in outputs]
            for node, columns in self._columns.items():
                if level[columns.index] == number:
                    outputs.append(node)
                    operands.append(columns)
            runs[number] = run = _renumbered(chosen, operands, lowering, outputs)
            if not run.inputs:  # only constants; reads an argument for its number of rows
                run.inputs = self._inputs[:1]
                width = self._inputs[0].meta["value"].numel() // lowering.rows
                run.program = replace(run.program, inputs=(width,))
        return runs

    # Running ----------------------------------------------------------------------------------------------------------

    def run(self, call: Call, grouping: Grouping) -> Results:
        """Returns the method's results. Rows are sorted by cell only if a function between subprograms needs it."""
        sort = self._sorted or grouping.rows is not None or not call.layout.n
        call = self._with_inputs(call, grouping.device)
        rows, shared = call.arranged(grouping if sort else None), call.shared()
        owned, places = self._owned, self._places
        if call.module is not self.module:  # the call is on a copy of the module
            owned = [(owner, name) for owner, name, _ in owned_parameters(call.module)]
            parts = list(parts_of(call.module).values())
            places = [(parts[i], i, name) for _, i, name in places]
        shared += [self.inputs.tensor(lookup(part, name), grouping.device) for part, _, name in places]
        values: dict[Any, Any] = {self._n: rows[0].shape[0], **dict(zip(self._shared, shared, strict=True))}
        values.update(zip(self._inputs, [x.clone() for x in rows] if self._writes else rows))
        for node, place in self._parameters.items():
            owner, name = owned[place]
            values[node] = owner._parameters[name]
        is_recorded = torch.is_grad_enabled()
        with torch.set_grad_enabled(is_recorded or self._differentiates):
            self._compute(values, grouping, sort)
        outputs = [values[node] if is_recorded else values[node].detach() for node in self._outputs]
        return Results(self.result, outputs, grouping if sort else None)

    @functools.cached_property
    def whole_program(self) -> WholeProgram | str:
        """The program that computes the call without rearranging arguments or results, or why there is none."""
        if self.name != "fused":
            return self.why
        (run,) = self._runs.values()
        layouts = [node.meta["layout"] if node in run.outputs else None for node in self._outputs]
        moved = self._between or any(node not in self._inputs for node in run.inputs)
        if moved or any(layout is None or layout[1:] != (0, 1) for layout in layouts):
            return "arguments or results are rearranged"
        if len(self._shared) > len(self._places):
            return "arguments are the same for all samples"
        outputs = [run.program.outputs[run.outputs.index(node)] for node in self._outputs]
        reads = tuple(self._inputs.index(node) for node in run.inputs)
        results = tuple((tuple(node.meta["layout"][0]), node.meta["dtype"]) for node in self._outputs)
        return WholeProgram(Builder(run.program).program(outputs), reads, results)

    @functools.cached_property
    def encoded(self) -> Program:
        """The program of :attr:`whole_program`, in which `encode` steps replace sines and cosines of octaves."""
        (run,), whole_program = self._runs.values(), cast(WholeProgram, self.whole_program)
        constants = {i: entries.constants() for i, entries in enumerate(run.parameters)}
        return with_encodings(
            whole_program.program, {i: numbers for i, numbers in constants.items() if numbers is not None}
        )

    @property
    def computes(self) -> bool:
        """True if parameters are computed in each call, by functions of the module or from looked-up numbers."""
        return bool(self._weights or self._places)

    @functools.cached_property
    def _sources(self) -> list[tuple[dict[str, Any], str, ParameterEntries | None]]:
        """The source of each parameter of :attr:`whole_program`: (registry, name, selected entries or None for all)."""
        (run,) = self._runs.values()
        sources = list[tuple[dict[str, Any], str, ParameterEntries | None]]()
        for entries in run.parameters:
            if isinstance(entries.of, Tensor):
                sources.append(({"": entries.resolve({}).float()}, "", None))
                continue
            owner, name = self._owned[self._parameters[entries.of]]
            parameter = cast(Tensor, owner._parameters[name])
            as_it_is = parameter.dtype is torch.float32 and entries.resolve({entries.of: parameter}) is parameter
            sources.append((owner._parameters, name, None if as_it_is else entries))
        return sources

    def same_parameters(self) -> Any:
        """Returns dependencies (`voronerf.ops._core.unchanged`) that hold while :meth:`parameters` returns the same.

        Returns `Stale` if the tensors are computed, in this module or by the caller of ``torch.func.functional_call``.
        """
        if self.computes or any(entries or not owner[name].is_leaf for owner, name, entries in self._sources):
            return Stale()
        same = unchanged()
        for registry, name, _ in self._sources:
            same.entries(registry, [name])
        return same

    def parameters(self, k: int, device: torch.device, backend: str) -> list[Tensor]:
        """Returns the float32 parameters of :attr:`whole_program`: the module's own, or computed from them."""
        if not self.computes:
            return [
                registry[name] if entries is None else entries.resolve({entries.of: registry[name]}).float()
                for registry, name, entries in self._sources
            ]
        tensors = [self.inputs.tensor(lookup(part, name), device) for part, _, name in self._places]
        values: dict[Any, Any] = dict(zip(self._shared, tensors, strict=True))
        for node, place in self._parameters.items():
            owner, name = self._owned[place]
            values[node] = owner._parameters[name]
        cells = torch.zeros(2, dtype=torch.int32, device=device)  # placeholders, since weights do not depend on samples
        grouped = GroupedRun(Grouping(cells, 2, k, device, backend), {})
        for node in self._weights:
            if node not in values:
                _compute(node, values, grouped)
        (run,) = self._runs.values()
        return [entries.resolve(values).float() for entries in run.parameters]

    def _with_inputs(self, call: Call, device: torch.device) -> Call:
        """Returns the call with tensors instead of the numbers that are inputs of the trace."""
        names = {source for source in self.inputs.sources if isinstance(source, str)}
        if not names:
            return call
        return call.with_leaves(lambda name, leaf: self.inputs.tensor(leaf, device) if name in names else leaf)

    def _compute(self, values: dict[Any, Any], grouping: Grouping, sort: bool) -> None:
        order = None if sort else grouping.source
        grouped = GroupedRun(grouping, {})
        for node in self._weights:
            if node not in values:
                _compute(node, values, grouped)
        last = max(self._runs, default=-1)
        for number in range(last + 2):
            for node in self._between:
                if self._ready[node] == number or (number > last and self._ready[node] > last):
                    _compute(node, values, grouped)
            if number in self._runs:
                self._compute_run(self._runs[number], values, grouping, order)

    def _compute_run(self, run: Subprogram, values: dict[Any, Any], grouping: Grouping, order: Tensor | None) -> None:
        n = values[self._n]
        rows = [_flat(values[source], n, source) for source in run.inputs]
        dtype = torch.float64 if any(x.dtype == torch.float64 for x in rows) else torch.float32
        half = torch.is_autocast_enabled(grouping.device.type) or any(x.dtype in HALF for x in rows)
        parameters = [recordable(entries.select(values).to(dtype)) for entries in run.parameters]
        with torch.autocast(grouping.device.type, enabled=False):  # results are rounded below, as in cached calls
            outputs = grouped_program(
                [x.to(dtype) for x in rows],
                parameters,
                grouping.offsets,
                program=run.program,
                order=order,
                backend=grouping.backend,
            )
        for of, tensor in zip(run.outputs, outputs, strict=True):
            if isinstance(of, fx.Node):
                shape, at, m = of.meta["layout"]
                tensor = tensor.reshape(n * m, *shape).movedim(0, at) if at else tensor.reshape(n * m, *shape)
                tensor = tensor.to(of.meta["dtype"]) if half and of.meta["dtype"] in HALF else tensor
            values[of] = tensor


def _renumbered(steps: list[Step], results: list[Columns], lowering: Lowering, outputs: list[Any]) -> Subprogram:
    """Makes a subprogram of some steps; the values and parameters of its program are numbered anew.

    Args:
        steps: The steps of the subprogram.
        results: The columns that the program outputs.
        lowering: The lowering to which the steps belong.
        outputs: The node or value of each output.
    """
    b, run = Builder(), Subprogram(Program((), (), (), ()), outputs=outputs)
    values: dict[int, int] = {}
    parameters: dict[int, int] = {}

    def parameter(index: int) -> int:
        if index not in parameters:
            parameters[index] = b.parameter(*lowering.builder.parameters[index])
            run.parameters.append(ParameterEntries(*lowering.parameters[index]))
        return parameters[index]

    def columns(c: Columns) -> Columns:
        if c.of != VALUE:
            return c._replace(index=parameter(c.index))
        if c.index not in values:  # computed before this subprogram
            values[c.index] = b.input(lowering.builder.steps[c.index].width).index
            run.inputs.append(lowering.sources.get(c.index, c.index))
        return c._replace(index=values[c.index])

    for step in steps:
        operands, numbers = tuple(map(columns, step.operands)), step.numbers
        if step.op == "linear":
            numbers = (parameter(int(numbers[0])), *numbers[1:])
        values[step.out] = b.emit(step.op, step.width, operands, numbers, step.name).index
    run.program = b.program([columns(c) for c in results])
    return run


def _match_strides(entries: Entries, tensor: Tensor) -> None:
    """Gives the tensor of entry codes (`Entries`) its tensor's strides, by which PyTorch allows later views."""
    if entries.codes.stride() != tensor.stride() and 0 not in tensor.stride():
        codes = torch.empty_strided(tensor.shape, tensor.stride(), dtype=entries.codes.dtype, device="cpu")
        entries.codes = codes.copy_(entries.codes)


def _meets_cells(node: fx.Node) -> bool:
    return any(source.meta["on"] == CELLS for source in node.all_input_nodes)


def _compute(node: fx.Node, values: dict[Any, Any], grouped: GroupedRun) -> None:
    """Calls a node's function; a function of the cells' parameters is called for all cells at once."""
    meets_cells = _meets_cells(node)
    grouped.counted = any(type(values[source]) is int for source in node.all_input_nodes)

    def argument(source: fx.Node) -> Any:
        value = values[source]
        if meets_cells and source.meta["on"] == CELLS:
            return map_tensors(value, PerCell)
        if meets_cells and source.meta["on"] == SAMPLES:
            if isinstance(value, Tensor):
                grouped.mark(value, source.meta["axis"])
            return SampleCount(value) if type(value) is int else value
        return value

    args, kwargs = map_arg((node.args, node.kwargs), argument)
    is_recorded = torch.is_grad_enabled() and node.meta.get("grad", True)
    try:
        with grouped if meets_cells else contextlib.nullcontext(), torch.set_grad_enabled(is_recorded):
            result = node.target(*args, **kwargs)  # type: ignore[operator]
    except Ungroupable:
        message = f"{name_of(node.target)}{node.meta['line']} takes parameters, and has no rule for all cells at once"
        raise Unfusable(message) from None
    written = args[0] if node.meta.get("inplace") else result
    values[node] = map_tensors(written, lambda item: item.stacked if isinstance(item, PerCell) else item)


def _flat(value: Tensor, n: int, source: Any) -> Tensor:
    """Reshapes the value of a node, or of an earlier subprogram, to [n, w]."""
    dim = source.meta["axis"].dim if isinstance(source, fx.Node) else 0
    value = value.movedim(dim, 0) if dim else value
    return value.reshape(n, -1) if n else value.reshape(0, max(value.shape[1:].numel(), 1))
