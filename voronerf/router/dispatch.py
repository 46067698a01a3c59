"""How a routed call runs: fused, grouped or cell by cell.

The loop over cells defines the result. The first call of a kind makes a :class:`CallPlan` with the ways that give the
same (:mod:`voronerf.router.probe`). Of these each call takes the one that was fastest for the first batch of about its
size, or with ``way=`` the one that was named.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.unchanged import unchanged
from voronerf.router import rules  # noqa: F401  registers the rules
from voronerf.router.double import Double, Forbidden
from voronerf.router.fused import Fused
from voronerf.router.grouped import Grouped, Loop, Ungroupable, Way
from voronerf.router.grouping import Grouping, cell_parameters, owned_parameters, parts_of
from voronerf.router.known import KnownCall
from voronerf.router.layout import Call, Results, map_tensors, tensors_of
from voronerf.router.plan import SLICE, CallPlan, measured_samples
from voronerf.router.probe import FEWEST, Options, Probe, check_rays, check_subclasses
from voronerf.router.program import CellProgram
from voronerf.router.transforms import aside, is_watched, outside, recorded
from voronerf.router.watch import NUMBERS, Inputs, Source, Watch, is_number, lookup

_OP = "VoronoiRouter"
_PLANS = 256  # kinds of calls that are remembered
_TRACES = 8  # of one kind of call; a module that changes more often runs grouped
_TURNS, _SECONDS = 8, 0.08  # a way is measured at most so often, and no more than twice after so many seconds
_BEHIND = 1.5  # times behind the fastest, so not measured again
_LOOKS, _APART, _CLEAR = 3, 1.0, 1.3  # measurements that a fused way must lose, seconds between them, factor of time
_EQUAL = 1.02  # of the least time: an earlier way of a plan is taken unless it is slower by more
_OF_DTYPES = re.compile("same dtype|expected scalar type|Input type")  # in messages of PyTorch
_OWN = tuple(str(Path(file).absolute().parents[up]) + os.sep for file, up in ((str(torch.__file__), 0), (__file__, 1)))


class Dispatch:
    """The plans of a router. Copies of a router begin anew."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # held while a plan is made
        self.forget()

    def __reduce__(self) -> tuple[type[Dispatch], tuple[()]]:
        return Dispatch, ()

    def forget(self) -> None:
        """Drops all plans, after a change of dtype, device or parameters' names."""
        self.plans: dict[Any, list[CallPlan]] = {}  # the latest first; several where they are traced with other values
        self._fixed: dict[Any, tuple[set[Source], str]] = {}  # what cannot be an input of a trace, and why
        self.known: dict[Any, KnownCall] = {}  # by `kind_of`
        self._parts: Any = unchanged()  # parameters and parts of the module, at the last call
        self._k = 0  # cells, then
        self._inner: list[Any] = []  # shapes of one cell's parameters
        self._subclasses: set[Any] = set()  # methods and tensor types that are known to work with plain tensors
        self._warned: set[str] = set()
        self._latest: dict[str, dict[str, str]] = {}

    def explain(self, methods: tuple[str, ...], known: Mapping[str, str]) -> str:
        """How each method has run so far, and why; of some it is known beforehand."""
        latest = [(m, self._latest.get(m, {known.get(m, "not called yet"): ""})) for m in methods]
        ways = [(method, *way) for method, ways in latest for way in list(ways.items())]
        return "\n".join(f"{method}: {name}{f': {why}' if why else ''}" for method, name, why in ways)

    def program(
        self, call: Call, grouping: Grouping | None, device: torch.device, k: int, options: Options, backend: str
    ) -> CellProgram | str:
        """The program of a call of this kind; or the reason why it is unknown.

        Args:
            call: The call.
            grouping: Its samples by cell, on which it is traced where no earlier one was; None for no trace.
            device: Of the samples.
            k: Cells.
            options: What the user asked for.
            backend: Of operations on parameters.
        """
        if not options.fuse:
            return f"{call.name} is not traced without fuse=True"
        if torch.is_autocast_enabled(device.type):
            return f"{call.name} rounds as autocast does"
        self._check_parameters(call, k, options.names)
        constants = call.constants()
        plans = [plan for plan in self.plans.get(_kind_of(call, device), []) if plan.fused or not plan.few]
        plan = next((plan for plan in plans if not plan.changed(constants)), None)
        if plan is None and grouping is None:
            return f"{call.name} is traced at its {'next' if plans else 'first'} call"
        plan = plan or self._plan(call, cast(Grouping, grouping), options)
        if plan.fused is None:
            return f"{call.name} runs {plan.ways[0].name}: {plan.ways[0].why}"
        whole = plan.fused.whole
        if isinstance(whole, str):
            return f"{call.name} is not one program: {whole}"
        shapes, encoded = tuple(shape for shape, _ in whole.results), plan.fused.encoded
        return CellProgram(encoded, whole.reads, shapes, plan.fused.parameters(k, device, backend))

    def evaluate(self, call: Call, grouping: Grouping, options: Options, frozen: Tensor | None) -> Results:
        """Runs a call on the samples of all cells, or on two placeholders.

        Args:
            call: The call.
            grouping: Its samples by cell.
            options: What the user asked for.
            frozen: bool [k]; samples in these cells are evaluated without gradients.
        """
        self._check_parameters(call, grouping.k, options.names)
        call = self._plain(call)
        plan = self._plan(call, grouping, options)
        if frozen is None or not torch.is_grad_enabled() or not call.layout.n:
            results = self._run(plan, call, grouping)
        else:
            results = self._run_apart(plan, call, grouping, frozen)
        if call.like is not None and not is_watched() and (known := KnownCall.of(plan, call, grouping)):
            if len(self.known) >= _PLANS:
                self.known = {}
            self._guard(known)
            self.known[call.like] = known
        return results

    def _plain(self, call: Call) -> Call:
        """The call with plain tensors; raises TypeError, the first time, where the module needs those of a subclass."""
        if (plain := call.plain()) is not call:
            key = call.method, frozenset(map(type, tensors_of((call.args, call.kwargs))))
            if key not in self._subclasses:
                check_subclasses(call, plain)
            self._subclasses.add(key)
        return plain

    def find(self, kind: Any, k: int) -> KnownCall | None:
        """The known call of a kind, if the module has not changed; while it compiles this is assumed."""
        entry = self.known.get(kind)
        if entry is None or torch.compiler.is_compiling():
            return entry
        if is_watched() or k != self._k:
            return None
        if not entry.unchanged.holds():
            if not self._parts.holds() or entry.plan.watch.changed():
                return None
            self._guard(entry)  # of values that are equal, or parameters that are replaced by others of their kind
        return entry

    def _guard(self, entry: KnownCall) -> None:
        entry.unchanged = unchanged()
        self._note_parts(entry.unchanged, entry.module)
        entry.plan.watch.note(entry.unchanged)

    @staticmethod
    def _note_parts(guard: Any, module: nn.Module) -> None:
        """Which parameters and parts a module has."""
        for part, name, _ in owned_parameters(module):
            guard.kind(part._parameters, name)
        for part in parts_of(module).values():
            if part._modules:
                guard.contents(part._modules)

    def _check_parameters(self, call: Call, k: int, names: Collection[str]) -> None:
        """Raises TypeError or ValueError where the module has not the parameters of k cells that it was wrapped with.

        A parametrisation, or memory of another shape, would send kernels to memory that is not theirs.
        """
        if k == self._k and self._parts.holds():
            return
        now = dict(call.module.named_parameters())
        if gone := [name for name in names if name not in now]:
            raise TypeError(
                f"{_OP}: module must keep the parameters that it was wrapped with, but {gone[0]!r} is gone; change a "
                "module (weight_norm, parametrizations, pruning) before it is wrapped"
            )
        cells = set(map(id, cell_parameters(call.module)))
        for name, p in now.items():
            if id(p) in cells and p.shape[:1] != (k,):
                raise ValueError(
                    f"{_OP}: parameters of module must be [{k}, ...], one for each cell, but {name!r} is "
                    f"{list(p.shape)}"
                )
        inner = [(name, p.shape[id(p) in cells :], p.dtype) for name, p in now.items()]
        if inner != self._inner:
            self.forget()
        self._inner, self._k, self._parts = inner, k, unchanged()
        self._note_parts(self._parts, call.module)

    def _plan(self, call: Call, grouping: Grouping, options: Options) -> CallPlan:
        """The plan for calls of this kind, which the first of them makes, and one that finds other values."""
        layout, key = call.layout, _kind_of(call, grouping.device)
        constants, few = call.constants() if options.fuse else {}, layout.n < FEWEST
        plans = [plan for plan in self.plans.get(key, []) if few or not plan.few]
        plan = next((plan for plan in plans if not plan.changed(constants)), None)
        if plan is not None and (few or not plan.open or plan.skip or recorded()):
            return plan
        if not layout.n:
            return CallPlan([Loop("no samples yet")])
        generators = [grouping.device] if grouping.device.type == "cuda" else []
        with self._lock, torch.random.fork_rng(generators), aside(call) as beside:
            probe = Probe(beside, grouping)
            if plan is not None and not probe.is_groupable():
                plan.postpone()
                return plan
            inputs, over = self._inputs(call, constants, plans, key) if plan is None and plans else ([Inputs()], "")
            # What was fused once goes on grouped where it cannot be fused again.
            options = replace(options, several=options.several or bool(plans))
            try:
                if len(layout.lead) > 1 and layout.lead[-1] > 1 and not layout.flat:
                    check_rays(beside)
                ways, is_open = probe.find_ways(options, (lambda *_: None) if few else self.warn_once, inputs, over)
            except (TypeError, ValueError) as error:
                if not few or isinstance(error, Forbidden):
                    raise
                ways, is_open = [Loop()], False  # a tensor [1, f] beside one sample may be what all samples share
            if few and isinstance(ways[0], Loop) and options.way != "loop":
                ways[0].why = f"first calls of fewer than {FEWEST} samples"
        if len(self.plans) >= _PLANS:
            self.plans, self.known = {}, {}
        made = CallPlan(ways, options.way == "fastest", is_open, few, constants=constants)
        if made.fused is not None:
            made.watch = Watch.of(call.module, made.fused.reads, made.fused.inputs)
        if probe.refused and made.fused is not None:
            fixed = self._fixed.setdefault(key, (set(), probe.refused))[0]
            fixed.update(*(other.sources - made.fused.inputs.sources for other in inputs))
        before = set(map(id, self.plans.get(key, [])))
        self.known = {like: other for like, other in self.known.items() if id(other.plan) not in before}
        if plans and [way.name for way in plans[0].ways] == [way.name for way in ways]:
            made.chosen, made.lost = plans[0].chosen, plans[0].lost
        self.plans[key] = [made] if made.fused is None else [made, *(other for other in plans if other is not plan)]
        return made

    def _inputs(
        self, call: Call, constants: dict[str, Any], plans: list[CallPlan], key: Any
    ) -> tuple[list[Inputs], str]:
        """Attributes that a new trace takes as inputs, after a change; or none, and that they changed too often."""
        fused = plans[0].fused
        assert fused is not None
        changed, parts = plans[0].changed(constants), list(parts_of(call.module).values())
        fixed, why = self._fixed.get(key, (set(), ""))

        def named(source: Source) -> str:
            if isinstance(source, str):
                return f"argument {source}"
            return f"{type(parts[source[0]]).__name__}.{source[1]}"

        if len(plans) >= _TRACES:
            names = " and ".join(dict.fromkeys(map(named, changed)))
            rule = "changes from call to call, and a trace takes it as fixed"
            self._latest.pop(call.method, None)
            return [], f"not fused any more, since {names} {rule}{f': as an input of the trace {why}' if why else ''}"

        def value(source: Source) -> Any:
            return constants.get(source) if isinstance(source, str) else lookup(parts[source[0]], source[1])

        new = {source for source in changed if source not in fixed and is_number(value(source))}
        sources = frozenset(new | fused.inputs.sources)
        kept = [fused.inputs] if fused.inputs.sources else []
        tried = [Inputs(sources, dtype) for dtype in NUMBERS] if new else []
        return [*tried, *kept, Inputs()], ""

    def _choose(self, plan: CallPlan, call: Call, grouping: Grouping) -> tuple[Way, str]:
        """The way of a call, and why."""
        n, k = call.layout.n, grouping.k
        ways = [way for way in plan.ways if k > 1 or not isinstance(way, Grouped)]
        if plan.skip:
            plan.skip -= not recorded()
            ways = ways[-1:]
        if not plan.measured or len(ways) == 1 or n < FEWEST:
            return ways[0], ways[0].why
        size, n = plan.size(n, k), min(n, measured_samples(ways))
        lost, again, why = plan.lost.get(size, (0, 0.0, ""))
        if lost and size not in plan.chosen and (recorded() or time.monotonic() < again):
            return ways[0], why
        if size not in plan.chosen:
            with self._lock, aside(call) as beside:
                times = measure(ways, beside, grouping)
            fused = isinstance(ways[0], Fused)  # who asked for it has it, unless it is clearly slower again and again
            loses = fused and times[0] > _CLEAR * min(times)
            lost += loses
            first = next(i for i, seconds in enumerate(times) if seconds <= _EQUAL * min(times))
            first = 0 if fused and not (loses and lost == _LOOKS) else first
            texts = [f"{way.name} {1e3 * seconds:.3g} ms" for way, seconds in zip(ways, times, strict=True)]
            others = ", ".join(texts[:first] + texts[first + 1 :])
            why = f"{1e3 * times[first]:.3g} ms for {n} samples, {others}" if min(times) else ""
            if loses and first == 0:
                why = "; ".join(filter(None, (ways[0].why, f"{why}, to be measured again")))
                plan.lost[size] = lost, time.monotonic() + _APART, why
                return ways[0], why
            plan.chosen[size] = first, why
        first, why = plan.chosen[size]
        return ways[first], "; ".join(filter(None, (ways[first].why, why)))

    def _run(self, plan: CallPlan, call: Call, grouping: Grouping) -> Results:
        """Runs a call as planned, or cell by cell where its batch cannot be grouped."""
        way, why = self._choose(plan, call, grouping)
        latest, warns = self._latest.setdefault(call.method, {}), len(plan.ways) == 1
        if isinstance(way, Grouped):
            try:
                results, plan.wait = way.run(call, grouping), 0
                latest[way.name] = why
                return results
            except Exception as error:
                lacking = (BackendUnavailable, MemoryError, torch.OutOfMemoryError)
                if isinstance(error, lacking) or "can't allocate memory" in str(error):
                    raise
                if not recorded():
                    plan.postpone()
                reason = error if isinstance(error, Ungroupable) else f"its forward fails ({error})"
                way, why, warns = plan.ways[-1], f"for some batches, since {reason}", True
        layout = call.layout
        try:
            results = way.run(call, grouping)
        except Exception as error:
            shown = _misfit(error, call) or error
            if len(layout.lead) > 1 and not layout.flat and len(shown.args) == 1 and isinstance(shown.args[0], str):
                hint = f"{_OP}: the module saw [n, 1, f] for [rays, samples, f]; layout='flat' gives it [n, f]"
                shown.args = (f"{shown.args[0]}\n{hint}",)
            if shown is error:
                raise
            raise shown from error
        if grouping.k == 1 and isinstance(way, Loop):
            latest["the module itself"] = "there is one cell"
            return results
        latest[way.name] = why
        if why and warns and grouping.k > 1 and layout.n >= FEWEST:
            self.warn_once(f"cells {call.method}", f"{call.name} runs cell by cell: {why}")
        return results

    def _run_apart(self, plan: CallPlan, call: Call, grouping: Grouping, frozen: Tensor) -> Results:
        """Runs a call for samples in frozen cells, bool [k], without gradients, and for the others with them."""
        k, device, backend, cells = grouping.k, grouping.device, grouping.backend, grouping.cells
        with outside():  # within a transform of torch.func all that is computed belongs to it
            cells = torch.zeros(grouping.n, dtype=torch.int32, device=device) if cells is None else cells
            still = frozen.index_select(0, cells)
            rows = [mask.nonzero()[:, 0] for mask in (~still, still)]
            parts = [Grouping(cells[index], len(index), k, device, backend, index) for index in rows]
        outcomes = list[Results]()
        for part, learns in zip(parts, (True, False), strict=True):
            if part.n:
                with torch.set_grad_enabled(learns):
                    outcomes.append(self._run(plan, call, part))
        order, tensors = torch.cat(rows), []
        for both in zip(*(results.unsorted for results in outcomes), strict=True):
            joined = torch.cat(both)
            # The backward of index_copy is a gather, where that of an index would add up.
            joined = torch.zeros_like(joined).index_copy(0, order, joined)
            if joined.is_floating_point() and not len(rows[0]):  # a batch without samples to learn from is no error
                joined = _Constant.apply(joined, *(p for p in cell_parameters(call.module) if p.requires_grad))
            tensors.append(joined)
        return Results(outcomes[0].value, tensors)

    def warn_once(self, topic: str, message: str) -> None:
        """Warns, the first time that a topic comes up, at the line that called the router."""
        if topic not in self._warned:
            files = [frame.f_code.co_filename for frame, _ in traceback.walk_stack(sys._getframe())]
            level = next((i for i, file in enumerate(files) if not file.startswith(_OWN)), len(files))
            warnings.warn(f"{_OP}: {message}", stacklevel=level + 1)
        self._warned.add(topic)


def _misfit(error: Exception, call: Call) -> Exception | None:
    """The error to show in the place of PyTorch's where arguments do not fit the layers of the module; or None."""
    if not isinstance(error, RuntimeError):
        return None
    tensors = {n: v for n, v in zip(call.names, (*call.args, *call.kwargs.values())) if isinstance(v, Tensor)}
    own = {p.dtype for p in call.module.parameters() if p.is_floating_point()}
    other = {name: x.dtype for name, x in tensors.items() if x.is_floating_point() and x.dtype not in own}
    if len(own) == 1 and other and _OF_DTYPES.search(str(error)):
        (dtype,), names = own, ", ".join(other)
        return TypeError(
            f"{_OP}: {names} must be {dtype}, as the parameters of {type(call.module).__name__} are, got "
            f"{', '.join(map(str, other.values()))}; pass {next(iter(other))}.to({dtype}), or call router.to(dtype)"
        )
    for frame, _ in traceback.walk_tb(error.__traceback__):
        layer, x = frame.f_locals.get("self"), frame.f_locals.get("input")
        if not isinstance(layer, nn.Linear) or not isinstance(x, Tensor) or x.shape[-1:] == (layer.in_features,):
            continue
        shapes = ", ".join(str(list(tensor.shape)) for tensor in tensors.values())
        rule = f"{_OP}: {', '.join(tensors)} must fit {call.name}, whose {layer} gets {x.shape[-1]} features"
        given = any(tensor.shape[-1:] == x.shape[-1:] for tensor in tensors.values())
        remedy = "; pass what the module itself takes, and positions that are no part of it as coords=" if given else ""
        return ValueError(f"{rule}, got {shapes}{remedy}")
    return None


def _kind_of(call: Call, device: torch.device) -> Any:
    """Returns the key of plans: modes, and kinds, types and sizes of arguments without the number of samples.

    Raises ValueError for tensors that are neither per sample nor per ray, or could be both.
    """
    autocast = torch.get_autocast_dtype(device.type) if torch.is_autocast_enabled(device.type) else None
    lead, d = call.layout.lead, len(call.layout.lead)
    call.changed(lambda tensor, kind: tensor)
    several = d > 1 and lead[-1] > 1  # rays of one sample show nothing of a module that mixes the samples of a ray
    modes = call.method, call.module.training, torch.is_grad_enabled(), autocast
    kind: list[Any] = [*modes, tuple(call.kwargs), d, several, *call.kinds.items()]
    for value in (*call.args, *call.kwargs.values()):
        if isinstance(value, Tensor):
            kind.append((tuple(value.shape[d:]), value.dim(), value.dtype, value.requires_grad))
        else:
            kind.append(value if isinstance(value, (type(None), bool, str)) else type(value))
    return tuple(kind)


class _Constant(torch.autograd.Function):
    """Values that depend on parameters, with no gradient to them."""

    @staticmethod
    def forward(values: Tensor, *parameters: Tensor) -> Tensor:
        return values.view_as(values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.count = len(inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, ...]:
        return (None,) * ctx.count


def measure(ways: list[Way], call: Call, grouping: Grouping) -> list[float]:
    """Seconds that each way takes for a part of a batch, forward and, where there are gradients, backward.

    The ways take turns, and the least time of each counts; the loop has one turn where it is far behind. A double of
    the module takes what they write and the gradients; random numbers go on as if nothing had run.
    """
    most, times = measured_samples(ways), _least_times(ways, call, grouping, SLICE, 2)
    return _least_times(ways, call, grouping, most, 1) if min(most, call.layout.n) > 2 * SLICE else times


def _least_times(ways: list[Way], call: Call, grouping: Grouping, most: int, fewest: int) -> list[float]:
    """The least times of at least so many turns, on so many samples at most."""
    k, device, picked = grouping.k, grouping.device, call.part(most) if grouping.rows is None else None
    if picked is not None:
        call, rows = picked
        cells = None if grouping.cells is None else grouping.cells.index_select(0, rows)
        grouping = Grouping(cells, len(rows), k, device, grouping.backend)
    double, leaves = Double(call.module), list[Tensor]()

    def leaf(value: Tensor) -> Tensor:
        taken = value.detach().requires_grad_(value.requires_grad and torch.is_grad_enabled())
        leaves.extend([taken] * taken.requires_grad)
        return taken

    double.fill({id(p): leaf(p) for _, _, p in owned_parameters(call.module)})
    double.own_buffers()
    args, kwargs = map_tensors((call.args, call.kwargs), leaf)
    again, cuda = replace(call, module=double.module, args=args, kwargs=kwargs), device.type == "cuda"

    # Beside other work the processor's time says more, but it leaves out what other threads do.
    clock = time.perf_counter if cuda or torch.get_num_threads() > 1 else time.thread_time

    def seconds(way: Way) -> float:
        if cuda:
            torch.cuda.synchronize(device)
        start = clock()
        outputs = [t for t in way.run(again, grouping.anew()).unsorted if t.requires_grad and t.is_floating_point()]
        if outputs and leaves:
            # Of a sum: with gradients of their own for the outputs torch imports sympy.
            total = torch.stack([(t * torch.ones_like(t)).sum().float() for t in outputs]).sum()
            torch.autograd.grad(total, leaves, allow_unused=True)
        if cuda:
            torch.cuda.synchronize(device)
        return clock() - start

    times, turns, began = [float("inf")] * len(ways), 0, clock()
    with torch.random.fork_rng([device] if cuda else []):
        while turns < fewest or (turns < _TURNS and clock() - began < _SECONDS):
            for i, way in enumerate(ways):
                if turns == 0 or not isinstance(way, Loop) or times[i] < _BEHIND * min(times):
                    times[i] = min(times[i], seconds(way))
            turns += 1
    return times
