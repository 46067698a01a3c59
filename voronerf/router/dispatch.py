"""Runs routed calls in one of three ways: fused, grouped or cell by cell.

The loop over cells defines the result. Calls are of one kind if they have the same method, modes, and types and sizes
of arguments. The first call of a kind makes a :class:`CallPlan`: its way is the first of the three that is possible and
whose results agree with the loop (:mod:`voronerf.router.probe`). The option ``way`` of a router names the way to begin
with.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
import traceback
import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.checks import MAX_COUNT
from voronerf.ops._core.unchanged import Stale
from voronerf.router import rules  # noqa: F401  registers the rules
from voronerf.router.call_cache import CachedCall
from voronerf.router.cells import refuse_statistics
from voronerf.router.double import Double, Forbidden
from voronerf.router.fused import Fused
from voronerf.router.grouped import Grouped, Loop, Ungroupable, Way
from voronerf.router.grouping import Grouping, cell_parameters, parts_of
from voronerf.router.layout import SHARED, Call, Results, map_tree, tensors_of
from voronerf.router.probe import FEWEST, Options, Probe, check_rays, check_subclasses
from voronerf.router.program import CellProgram
from voronerf.router.trace import Unfusable
from voronerf.router.transforms import hooked, is_intercepted, untransformed
from voronerf.router.watch import NUMBERS, Inputs, Source, Watch, is_number, lookup, module_dependencies, same

_OP = "VoronoiRouter"
_PLANS = 256  # maximum number of kinds of calls with plans
_TRACES = 8  # maximum number of traces for a kind of call; a module that changes more often runs grouped
_OF_DTYPES = re.compile("same dtype|expected scalar type|Input type")  # PyTorch's messages about dtypes
_LIBRARY_FOLDERS = tuple(
    str(Path(file).absolute().parents[up]) + os.sep for file, up in ((str(torch.__file__), 0), (__file__, 1))
)


class _Checked(NamedTuple):
    """The last check of parameters, replaced as a whole since other threads may read it.

    Attributes:
        k: The number of cells.
        shapes: The names, shapes and dtypes of one cell's parameters.
        statistics: The submodules that mix the samples of a batch in training.
        dependencies: The parameters and submodules.
    """

    k: int
    shapes: list[Any]
    statistics: list[nn.Module]
    dependencies: Any


@dataclass
class CallPlan:
    """The evaluation of calls with the same method, argument types and sizes, and the values on which it depends.

    Attributes:
        way: The fused, grouped or cell-by-cell evaluation: the first that is possible and agrees with the loop.
        loop: The loop over cells, which runs the batches for which ``way`` is impossible.
        may_group: Whether another batch may run grouped although the first did not.
        small: Whether the plan was made for fewer than ``FEWEST`` samples; the first larger call makes another plan.
        constants: The arguments of the traced call that are not tensors, by name; only for the fused way.
        watch: The values of the module that the trace has read; only for the fused way.
        counts: For each number in the results that counts samples, by name, its multiple of n.
        skip: The number of calls that run cell by cell before another way is tried again.
        wait: The value of ``skip`` after the next batch that cannot be grouped.
    """

    way: Way
    loop: Loop
    may_group: bool = False
    small: bool = False
    constants: dict[str, Any] = field(default_factory=dict)
    watch: Watch | None = None
    counts: dict[str, int] = field(default_factory=dict)
    skip: int = 0
    wait: int = 0

    @property
    def fused(self) -> Fused | None:
        """The fused module, or None if these calls do not run fused."""
        return self.way if isinstance(self.way, Fused) else None

    def changed(self, constants: dict[str, Any]) -> list[Source]:
        """Lists the arguments, attributes and buffers that have changed since the module was traced."""
        if self.fused is None or self.watch is None:
            return []
        both = constants.keys() | self.constants.keys() if constants.keys() != self.constants.keys() else constants
        inputs = self.fused.inputs.sources
        names = [n for n in both if not same(constants.get(n), self.constants.get(n)) and n not in inputs]
        return [*names, *self.watch.changed()]

    def postpone(self) -> None:
        """Makes the next calls run cell by cell, twice as many after each failure."""
        self.skip, self.wait = self.wait, 2 * self.wait or 1


class Dispatch:
    """The plans of a router's calls. A copy of a router starts without plans."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # held while a plan is made
        self.forget()

    def __reduce__(self) -> tuple[type[Dispatch], tuple[()]]:
        return Dispatch, ()

    def forget(self) -> None:
        """Drops all plans after a change of the dtype, the device or the names of parameters."""
        self.plans: dict[Any, list[CallPlan]] = {}  # by key: one plan for each trace, the latest first
        self._refused_inputs: dict[Any, tuple[set[Source], str]] = {}  # values that cannot be inputs, and why
        self.cached: dict[Any, CachedCall] = {}  # by `call_key`
        self._checked = _Checked(0, [], [], Stale())
        self._subclasses: set[Any] = set()  # (method, tensor types) that work with plain tensors
        self._warned: set[str] = set()
        self._latest_ways: dict[str, dict[str, str]] = {}

    def explain(self, methods: tuple[str, ...], default_ways: Mapping[str, str]) -> str:
        """Returns a line for each method: whether it ran fused, grouped or cell by cell, and why; or its default."""
        latest = [(m, self._latest_ways.get(m, {default_ways.get(m, "not called yet"): ""})) for m in methods]
        ways = [(method, *way) for method, ways in latest for way in list(ways.items())]
        return "\n".join(f"{method}: {name}{f': {why}' if why else ''}" for method, name, why in ways)

    def program(
        self, call: Call, grouping: Grouping | None, device: torch.device, k: int, options: Options, backend: str
    ) -> CellProgram | str:
        """Returns the program of calls like this one, or the reason why it is unknown.

        Args:
            call: The call.
            grouping: The samples of the call by cell, with which the call is traced if no earlier trace fits; None to
                trace nothing.
            device: The device of the samples.
            k: The number of cells.
            options: The user's options.
            backend: The backend of operations on parameters.
        """
        if not options.fuse:
            return f"{call.name} is not traced without fuse=True"
        if torch.is_autocast_enabled(device.type):
            return f"{call.name} runs under autocast"
        self._check_parameters(call, k, options.names)
        constants = call.constants()
        plans = [plan for plan in self.plans.get(_plan_key(call, device), []) if plan.fused or not plan.small]
        plan = next((plan for plan in plans if not plan.changed(constants)), None)
        if plan is None and grouping is None:
            return f"{call.name} is traced at its {'next' if plans else 'first'} call"
        plan = plan or self._plan(call, cast(Grouping, grouping), options)
        if plan.fused is None:
            return f"{call.name} runs {plan.way.name}: {plan.way.why}"
        program = plan.fused.whole_program
        if isinstance(program, str):
            return f"{call.name} is not one program: {program}"
        shapes, encoded = tuple(shape for shape, _ in program.results), plan.fused.encoded
        return CellProgram(encoded, program.reads, shapes, plan.fused.parameters(k, device, backend))

    def evaluate(self, call: Call, grouping: Grouping, options: Options, frozen: Tensor | None) -> Results:
        """Runs a call on the samples of all cells, or on two placeholder samples if there are none.

        Args:
            call: The call.
            grouping: The samples of the call by cell.
            options: The user's options.
            frozen: The mask of frozen cells, bool [k], which are evaluated without gradients; None for no cells.
        """
        checked = self._check_parameters(call, grouping.k, options.names)
        refuse_statistics(checked.statistics)
        call = self._plain(call)
        plan = self._plan(call, grouping, options)
        if frozen is None or not torch.is_grad_enabled() or not call.layout.n:
            results = self._run(plan, call, grouping)
        else:
            results = self._run_apart(plan, call, grouping, frozen)
        if plan.counts:
            n, counts = call.layout.n, plan.counts
            results.value = map_tree(results.value, lambda name, leaf, _: n * counts[name] if name in counts else leaf)
        elif call.key is not None and plan.fused is not None and plan.watch is not None and not is_intercepted():
            # A plan of few samples is not for many: the first larger call makes another plan.
            most = FEWEST - 1 if plan.small else MAX_COUNT
            if cached := CachedCall.of(plan.fused, plan.watch, most, call, grouping):
                self.cached = self.cached if len(self.cached) < _PLANS else {}
                self.cached[call.key] = cached
        return results

    def _plain(self, call: Call) -> Call:
        """Returns the call with plain tensors instead of tensors of a subclass.

        Raises TypeError if the module gives other results for plain tensors. This is checked once for each method and
        set of tensor types.
        """
        if (plain := call.plain()) is not call:
            key = call.method, frozenset(map(type, tensors_of((call.args, call.kwargs))))
            if key not in self._subclasses:
                check_subclasses(call, plain)
            self._subclasses.add(key)
        return plain

    def find(self, key: Any, compiles: bool) -> CachedCall | None:
        """Returns a cached call; None if dependencies changed or transforms are active (unchecked in compilation)."""
        cached = self.cached.get(key)
        if cached is None or compiles:
            return cached
        return cached if not is_intercepted() and cached.dependencies.holds() else None

    def _check_parameters(self, call: Call, k: int, names: Collection[str]) -> _Checked:
        """Raises TypeError if the module lacks parameters, and ValueError if stacked parameters are not [k, ...].

        With a parametrisation or another shape, kernels would access memory outside of the parameters.
        """
        checked = self._checked
        if k == checked.k and checked.dependencies.holds():
            return checked
        named = dict(call.module.named_parameters())
        if lost := [name for name in names if name not in named]:
            raise TypeError(
                f"{_OP}: module must keep the parameters that it was wrapped with, but {lost[0]!r} is gone; change a "
                "module (weight_norm, parametrizations, pruning) before it is wrapped"
            )
        cells = set(map(id, cell_parameters(call.module)))
        for name, p in named.items():
            if id(p) in cells and p.shape[:1] != (k,):
                raise ValueError(
                    f"{_OP}: parameters of module must be [{k}, ...], one for each cell, but {name!r} is "
                    f"{list(p.shape)}"
                )
        cell_shapes = [(name, p.shape[id(p) in cells :], p.dtype) for name, p in named.items()]
        if cell_shapes != checked.shapes:
            self.forget()
        parts = parts_of(call.module).values()
        statistics: list[nn.Module] = [p for p in parts if isinstance(p, nn.modules.batchnorm._BatchNorm)]
        checked = self._checked = _Checked(k, cell_shapes, statistics, module_dependencies(call.module))
        return checked

    def _plan(self, call: Call, grouping: Grouping, options: Options) -> CallPlan:
        """Returns the plan for a call; makes a plan for the first call of a kind, and if constants have changed."""
        layout, key = call.layout, _plan_key(call, grouping.device)
        constants, few = call.constants() if options.fuse else {}, layout.n < FEWEST
        plans = [plan for plan in self.plans.get(key, []) if few or not plan.small]
        plan = next((plan for plan in plans if not plan.changed(constants)), None)
        if plan is not None and (few or not plan.may_group or plan.skip or hooked()):
            return plan
        if not layout.n:
            return CallPlan(loop := Loop("no samples yet"), loop)
        with self._lock, _own_randomness(grouping), untransformed(call) as copied:
            probe = Probe(copied, grouping)
            if plan is not None and not probe.is_groupable():
                plan.postpone()
                return plan
            inputs, too_many = self._inputs(call, constants, plans, key) if plan is None and plans else ([Inputs()], "")
            # If a new trace fails, calls run grouped without an error.
            options = replace(options, many_methods=options.many_methods or bool(plans))
            try:
                if len(layout.lead) > 1 and layout.lead[-1] > 1 and not layout.flat:
                    check_rays(copied)
                way, loop, may_group = probe.find_way(
                    options, (lambda *_: None) if few else self.warn_once, inputs, too_many
                )
            except (TypeError, ValueError) as error:
                if not few or isinstance(error, Forbidden):
                    raise
                way, may_group = (loop := Loop()), False  # with one sample, a tensor [1, f] may also be shared
            if few and way is loop and options.way != "loop":
                loop.why = f"first calls of fewer than {FEWEST} samples"
        self.plans = self.plans if len(self.plans) < _PLANS else {}
        self.cached = self.cached if self.plans and key not in self.plans else {}  # drops calls of the old plans
        fused = way if isinstance(way, Fused) else None
        watch = None if fused is None else Watch(call.module, fused.reads, fused.inputs)
        new_plan = CallPlan(way, loop, may_group, few, constants, watch, probe.counts)
        if probe.refused and fused is not None:
            refused = self._refused_inputs.setdefault(key, (set(), probe.refused))[0]
            refused.update(*(other.sources - fused.inputs.sources for other in inputs))
        self.plans[key] = [new_plan, *(other for other in plans if fused is not None and other is not plan)]
        return new_plan

    def _inputs(
        self, call: Call, constants: dict[str, Any], plans: list[CallPlan], key: Any
    ) -> tuple[list[Inputs], str]:
        """Returns a list of alternative inputs of a new trace, to be tried in this order, and an empty text.

        Numbers, and tensors in attributes, that have changed since the last trace become inputs. If the module was
        traced too often, the list is empty, and the text is the reason.
        """
        fused, watch = plans[0].fused, plans[0].watch
        assert fused is not None and watch is not None
        changed, parts = plans[0].changed(constants), list(parts_of(call.module).values())
        refused, why = self._refused_inputs.get(key, (set(), ""))

        def named(source: Source) -> str:
            if isinstance(source, str):
                return f"argument {source}"
            return f"{type(parts[source[0]]).__name__}.{source[1]}"

        if len(plans) >= _TRACES:
            names = " and ".join(dict.fromkeys(map(named, changed)))
            rule = "changes between calls but is a constant of the trace"
            self._latest_ways.pop(call.method, None)
            return [], f"no longer fused, since {names} {rule}{f': as an input of the trace {why}' if why else ''}"

        def value(source: Source) -> Any:
            return constants.get(source) if isinstance(source, str) else lookup(parts[source[0]], source[1])

        new = {source for source in changed if source not in refused and is_number(value(source))}
        sources = frozenset(new | fused.inputs.sources)
        present = [fused.inputs] if fused.inputs.sources else []
        earlier = [(s, plans[0].constants.get(s) if isinstance(s, str) else watch.value(s)) for s in new]
        others = tuple((source, old) for source, old in earlier if is_number(old) and old is not value(source))
        tried = [Inputs(sources, dtype, others) for dtype in NUMBERS] if new else []
        return [*tried, *present, Inputs()], ""

    def _run(self, plan: CallPlan, call: Call, grouping: Grouping) -> Results:
        """Runs a call as planned, or cell by cell if its batch cannot be grouped."""
        way, loop = plan.way, plan.loop
        latest, warns = self._latest_ways.setdefault(call.method, {}), way is loop
        if plan.skip:
            plan.skip = max(plan.skip - (not hooked()), 0)  # another thread may have lowered it
            way = loop
        why = way.why
        if isinstance(way, Fused) or (isinstance(way, Grouped) and grouping.k > 1):
            try:
                results, plan.wait = self._run_once(way, call, grouping), 0
                latest[way.name] = why
                return results
            except Exception as error:
                fatal = (BackendUnavailable, MemoryError, torch.OutOfMemoryError)
                if isinstance(error, fatal) or "can't allocate memory" in str(error):
                    raise
                if isinstance(way, Fused) and not isinstance(error, Unfusable):
                    raise
                if not hooked():
                    plan.postpone()
                reason = error if isinstance(error, (Ungroupable, Unfusable)) else f"its forward fails ({error})"
                why, warns = f"for some batches, since {reason}", True
        layout = call.layout
        try:
            results = loop.run(call, grouping)
        except Exception as error:
            shown = _misfit(error, call, grouping) or error
            if len(layout.lead) > 1 and not layout.flat and len(shown.args) == 1 and isinstance(shown.args[0], str):
                hint = f"{_OP}: the module saw [n, 1, f] for [rays, samples, f]; layout='flat' gives it [n, f]"
                shown.args = (f"{shown.args[0]}\n{hint}",)
            if shown is error:
                raise
            raise shown from error
        if grouping.k == 1:
            latest["the module itself"] = "there is one cell"
            return results
        latest[loop.name] = why
        if why and warns and layout.n >= FEWEST:
            self.warn_once(f"cells {call.method}", f"{call.name} runs cell by cell: {why}")
        return results

    def _run_once(self, way: Fused | Grouped, call: Call, grouping: Grouping) -> Results:
        """Runs a call for all cells at once; if a grouped module calls other functions than before, records them."""
        try:
            return way.run(call, grouping)
        except Ungroupable as error:
            if isinstance(way, Fused) or not error.is_new or hooked():
                raise
        with self._lock, _own_randomness(grouping), untransformed(call) as copied:
            way.records = [*way.records[1 - _TRACES :], Probe(copied, grouping).confirmed_steps()]
        return way.run(call, grouping)

    def _run_apart(self, plan: CallPlan, call: Call, grouping: Grouping, frozen: Tensor) -> Results:
        """Runs a call without gradients for samples in frozen cells, bool [k], and with gradients for other samples."""
        k, device, backend, cells = grouping.k, grouping.device, grouping.backend, grouping.cells
        cells = torch.zeros(grouping.n, dtype=torch.int32, device=device) if cells is None else cells
        is_frozen = frozen.index_select(0, cells)
        rows = [mask.nonzero()[:, 0] for mask in (~is_frozen, is_frozen)]
        parts = [Grouping(cells[index], len(index), k, device, backend, index) for index in rows]
        outcomes = list[Results]()
        for part, has_gradients in zip(parts, (True, False), strict=True):
            if part.n:
                with torch.set_grad_enabled(has_gradients):
                    outcomes.append(self._run(plan, call, part))
        order, tensors = torch.cat(rows), []
        for pair in zip(*(results.unsorted for results in outcomes), strict=True):
            joined = torch.cat(pair)
            # The backward of index_copy is a gather, while the backward of indexing is a scatter-add.
            joined = torch.zeros_like(joined).index_copy(0, order, joined)
            if joined.is_floating_point() and not len(rows[0]):  # so that backward raises no error
                joined = _Constant.apply(joined, *(p for p in cell_parameters(call.module) if p.requires_grad))
            tensors.append(joined)
        return Results(outcomes[0].value, tensors)

    def warn_once(self, topic: str, message: str) -> None:
        """Warns once for each topic, at the line that called the router."""
        if topic not in self._warned:
            files = [frame.f_code.co_filename for frame, _ in traceback.walk_stack(sys._getframe())]
            level = next((i for i, file in enumerate(files) if not file.startswith(_LIBRARY_FOLDERS)), len(files))
            warnings.warn(f"{_OP}: {message}", stacklevel=level + 1)
        self._warned.add(topic)


def _own_randomness(grouping: Grouping) -> Any:
    """Returns a context that restores the random generators of torch and of the grouping's device."""
    return torch.random.fork_rng([grouping.device] if grouping.device.type == "cuda" else [])


def _misfit(error: Exception, call: Call, grouping: Grouping) -> Exception | None:
    """Returns a clearer error than PyTorch's if arguments do not fit the module's layers, else None."""
    if not isinstance(error, RuntimeError):
        return None
    tensors = {n: v for n, v in zip(call.names, (*call.args, *call.kwargs.values())) if isinstance(v, Tensor)}
    dtypes = {p.dtype for p in call.module.parameters() if p.is_floating_point()}
    other = {name: x.dtype for name, x in tensors.items() if x.is_floating_point() and x.dtype not in dtypes}
    if len(dtypes) == 1 and other and _OF_DTYPES.search(str(error)):
        (dtype,), names = dtypes, ", ".join(other)
        return TypeError(
            f"{_OP}: {names} must be {dtype}, as the parameters of {type(call.module).__name__} are, got "
            f"{', '.join(map(str, other.values()))}; pass {next(iter(other))}.to({dtype}), or call router.to(dtype)"
        )
    double, misfits = Double(call.module), list[tuple[nn.Module, int]]()

    def note(layer: Any, args: tuple[Any, ...]) -> None:
        if args and isinstance(args[0], Tensor) and args[0].shape[-1:] != (layer.in_features,):
            misfits.append((layer, args[0].shape[-1]))

    for place, layer in enumerate(double.parts):
        if isinstance(layer, nn.Linear):
            double.replace(place, "_forward_pre_hooks", {**layer._forward_pre_hooks, "misfit": note})
    with torch.no_grad(), contextlib.suppress(Exception):  # the call fails again
        double.run(call, call.arranged(grouping))
    if not misfits:
        return None
    layer, features = misfits[0]
    shapes = ", ".join(str(list(tensor.shape)) for tensor in tensors.values())
    rule = f"{_OP}: {', '.join(tensors)} must fit {call.name}, whose {layer} gets {features} features"
    fits = any(tensor.shape[-1:] == (features,) for tensor in tensors.values())
    remedy = "; pass the module's own arguments, and separate positions as coords=" if fits else ""
    return ValueError(f"{rule}, got {shapes}{remedy}")


def _plan_key(call: Call, device: torch.device) -> Any:
    """Returns the key of a call's plans, which does not depend on the number of samples.

    The key holds the method, the modes (training, gradients, autocast), and the kinds, types and sizes of the
    arguments. Raises ValueError for tensors that are neither per sample nor per ray, or could be both.
    """
    autocast = torch.get_autocast_dtype(device.type) if torch.is_autocast_enabled(device.type) else None
    lead, d = call.layout.lead, len(call.layout.lead)
    call.changed(lambda tensor, kind: tensor)
    if not set(call.kinds.values()) - {SHARED}:
        raise ValueError(f"{_OP}: arguments of {call.name} must include a tensor with a row for each sample, got none")
    has_rays = d > 1 and lead[-1] > 1  # rays of one sample cannot show that a module mixes the samples of a ray
    modes = call.method, call.module.training, torch.is_grad_enabled(), autocast
    kind: list[Any] = [*modes, tuple(call.kwargs), d, has_rays, *call.kinds.items()]
    for value in (*call.args, *call.kwargs.values()):
        if isinstance(value, Tensor):
            kind.append((tuple(value.shape[d:]), value.dim(), value.dtype, value.requires_grad))
        else:
            kind.append(value if isinstance(value, (type(None), bool, str)) else type(value))
    return tuple(kind)


class _Constant(torch.autograd.Function):
    """An identity that records a dependence on parameters in the autograd tape, but passes no gradients."""

    @staticmethod
    def forward(values: Tensor, *parameters: Tensor) -> Tensor:
        return values.view_as(values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.count = len(inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, ...]:
        return (None,) * ctx.count
