"""How a routed call is carried out: chosen once for a kind of call, and admitted by one comparison with the loop.

The loop over cells defines the result. The faster ways are the module's own ``forward`` once for the rows of all cells
(:mod:`voronerf.router.grouped`) and, where the user said ``fuse=True``, one operation (:mod:`voronerf.router.fused`).
A faster way is admitted if it gives what the loop gives: both run once on a few samples of the batch, in a copy of the
module whose cells have parameters of their own, and results and gradients are compared.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.tolerances import agree, agree_gradients
from voronerf.router import rules  # noqa: F401  registers the rules
from voronerf.router.cells import clone_module
from voronerf.router.double import Double, Forbidden
from voronerf.router.fused import Fused
from voronerf.router.grouped import Grouped, Loop, NoRandomness, Ungroupable, Way
from voronerf.router.grouping import Grouping, cell_parameters, keep_freed_memory, owned_parameters
from voronerf.router.layout import RAY, Call, Results, map_tensors, tensors_of
from voronerf.router.trace import Unfusable, rows_for

_OP = "VoronoiRouter"
_FEWEST = 8  # samples below which nothing is found out about a kind of call, and the loop runs
_TRIED, _CELLS = (41, 43, 47, 53), 3  # numbers of samples of a comparison, of which one is taken, and their cells
_PIECE = 8 << 20  # bytes of the largest tensor of a piece of rows on a CPU; larger ones are fetched from memory
_KINDS = 256  # kinds of calls that are remembered
_EQUAL = 1.02  # of the least time: what is not slower by more, and more promising, is taken
_TURNS, _ENOUGH = 8, 0.15  # most measurements of a way, and seconds after which there are no more than two
_OWN = tuple(str(Path(file).absolute().parents[up]) + os.sep for file, up in ((str(torch.__file__), 0), (__file__, 1)))


@dataclass
class Kind:
    """What is known about the calls of a kind.

    Attributes:
        ways: Those that give what the loop gives, the most promising first and the loop last.
        chosen: The fastest and what was measured, by the size of a batch and the number of cells.
        open: Whether another batch may run grouped, where the first did not.
        skip: Calls that run cell by cell before another way is tried again.
        wait: ``skip`` after the next batch that cannot be grouped.
    """

    ways: list[Way]
    open: bool = False
    chosen: dict[tuple[int, int], tuple[Way, str]] = field(default_factory=dict)
    skip: int = 0
    wait: int = 0

    def put_off(self) -> None:
        """Has the next calls run cell by cell, twice as many each time."""
        self.skip, self.wait = self.wait, 2 * self.wait or 1


class Choices:
    """What a router has found out about its module. Copies of a router begin anew."""

    def __init__(self) -> None:
        self.lock = threading.RLock()  # held while something is found out
        self.forget()

    def forget(self) -> None:
        """Begins anew, after a change of dtype, device or parameters' names."""
        self.kinds: dict[Any, Kind] = {}
        self.fused: set[str] = set()  # methods that have a fused way in all kinds of calls
        self._said: set[str] = set()
        self._latest: dict[str, dict[str, str]] = {}

    def note(self, call: Call, name: str, why: str) -> None:
        """For :meth:`explain`: how a method was carried out."""
        self._latest.setdefault(call.method, {})[name] = why

    def explain(self, methods: tuple[str, ...]) -> str:
        """How each method has been carried out so far, and why."""
        latest = [(method, self._latest.get(method, {"not called yet": ""})) for method in methods]
        ways = [(method, *way) for method, ways in latest for way in list(ways.items())]
        return "\n".join(f"{method}: {name}{f': {why}' if why else ''}" for method, name, why in ways)

    def say_once(self, topic: str, message: str) -> None:
        """Warns, the first time that a topic comes up, at the line that called the router."""
        if topic not in self._said:
            files = [frame.f_code.co_filename for frame, _ in traceback.walk_stack(sys._getframe())]
            level = next((i for i, file in enumerate(files) if not file.startswith(_OWN)), len(files))
            warnings.warn(f"{_OP}: {message}", stacklevel=level + 1)
        self._said.add(topic)

    def __reduce__(self) -> tuple[type[Choices], tuple[()]]:
        return Choices, ()


@dataclass(frozen=True)
class Wish:
    """What the user asked for.

    Attributes:
        fuse: Whether ``forward`` does the same in every call.
        way: "fastest", or the way that is taken without measuring: "fused", "grouped" or "loop".
        several: Whether methods besides ``forward`` are routed; then one that cannot be fused leaves the others fused.
        assume: What ``any()`` and ``all()`` of samples give in a fused method, by their code.
    """

    fuse: bool
    way: str
    several: bool
    assume: Mapping[str, bool] = field(default_factory=dict)


def kind_of(call: Call, device: torch.device, fused: bool) -> Any:
    """What tells kinds of calls apart: types and sizes of the arguments but for the number of samples, and modes.

    Numbers count by what they are only where they would go into a fused network.
    """
    autocast = torch.get_autocast_dtype(device.type) if torch.is_autocast_enabled(device.type) else None
    d = len(call.layout.lead)
    kind = [call.method, call.module.training, torch.is_grad_enabled(), autocast, tuple(call.kwargs), d]
    for value in (*call.args, *call.kwargs.values()):
        if isinstance(value, Tensor):
            ones = tuple(size == 1 for size in value.shape[:d])
            kind.append((tuple(value.shape[d:]), value.dim(), value.dtype, value.requires_grad, ones))
        else:
            by_value = (type(None), bool, str, int, float) if fused else (type(None), bool, str)
            kind.append(value if isinstance(value, by_value) else type(value))
    return tuple(kind)


# Carrying out ---------------------------------------------------------------------------------------------------------


def evaluate(call: Call, grouping: Grouping, choices: Choices, wish: Wish, frozen: Tensor | None) -> Any:
    """What a method returns for the samples of all cells (or two placeholders).

    Samples in ``frozen`` cells, bool [k], are evaluated apart, without gradients.
    """
    if grouping.device.type == "cpu":
        keep_freed_memory()
    kind = find_out(call, grouping, choices, wish)
    way, why = choose(kind, call, grouping, choices, wish)
    given = way, why, kind, call, grouping, choices
    frozen = frozen if torch.is_grad_enabled() and call.layout.n else None
    return (carry_out(*given) if frozen is None else carry_out_apart(*given, frozen)).restored(call.layout)


def find_out(call: Call, grouping: Grouping, choices: Choices, wish: Wish) -> Kind:
    """What is known about calls of this kind, found out if it is the first."""
    layout, key = call.layout, kind_of(call, grouping.device, wish.fuse)
    kind = choices.kinds.get(key)
    if kind is not None and not (kind.open and kind.skip == 0 and layout.n >= _FEWEST):
        return kind
    call.changed(lambda tensor, kind: tensor)  # arguments that are refused are so before anything is found out
    with choices.lock, torch.random.fork_rng([grouping.device] if grouping.device.type == "cuda" else []):
        if layout.n < _FEWEST:
            if layout.n:
                Trial(call, grouping).check_parameters()
            return Kind([Loop(f"first calls of fewer than {_FEWEST} samples")])
        trial = Trial(call, grouping)
        if kind is not None and not trial.is_groupable():
            kind.put_off()
            return kind
        if len(layout.lead) > 1 and layout.lead[-1] > 1 and not layout.flat:
            check_rays(call)
        found = admitted(trial, choices, wish)
    if len(choices.kinds) >= _KINDS:
        choices.kinds.clear()
    choices.kinds[key] = found
    return found


def choose(kind: Kind, call: Call, grouping: Grouping, choices: Choices, wish: Wish) -> tuple[Way, str]:
    """The way of a call, the fastest on the first batch of about its size, and what there is to say about it."""
    n, k = call.layout.n, grouping.k
    ways = [way for way in kind.ways if k > 1 or not isinstance(way, Grouped)]
    if kind.skip:
        kind.skip -= 1
        ways = ways[-1:]
    if wish.way != "fastest" or len(ways) == 1 or n < _FEWEST:
        return ways[0], ways[0].why
    size = n.bit_length() // 2, k  # batches of up to four times as many samples
    if size not in kind.chosen:
        with choices.lock:
            times = measured(ways, call, grouping)
        chosen = next(i for i, time in enumerate(times) if time <= _EQUAL * min(times))
        texts = [f"{way.name} {1e3 * time:.3g} ms" for way, time in zip(ways, times, strict=True)]
        others = ", ".join(texts[:chosen] + texts[chosen + 1 :])
        way, own = ways[chosen], f"{1e3 * times[chosen]:.3g} ms for {n} samples, {others}" if min(times) else ""
        kind.chosen[size] = way, "; ".join(filter(None, (way.why, own)))
    return kind.chosen[size]


def carry_out(way: Way, why: str, kind: Kind, call: Call, grouping: Grouping, choices: Choices) -> Results:
    """The results of a way, or of the loop where a batch cannot be grouped."""
    layout, alone, warns = call.layout, grouping.k == 1, len(kind.ways) == 1
    if isinstance(way, Grouped):
        try:
            results, kind.wait = way.run(call, grouping), 0
            choices.note(call, way.name, why)
            return results
        except Exception as error:
            lacking = (BackendUnavailable, MemoryError, torch.OutOfMemoryError)
            if isinstance(error, lacking) or "can't allocate memory" in str(error):
                raise
            kind.put_off()
            reason = error if isinstance(error, Ungroupable) else f"its forward fails ({error})"
            way, why, warns = kind.ways[-1], f"for some batches, since {reason}", True
    try:
        results = way.run(call, grouping)
    except Exception as error:
        if len(layout.lead) > 1 and not layout.flat and len(error.args) == 1 and isinstance(error.args[0], str):
            hint = f"{_OP}: the module saw [n, 1, f] for [rays, samples, f]; layout='flat' gives it [n, f]"
            error.args = (f"{error.args[0]}\n{hint}",)
        raise
    itself = alone and isinstance(way, Loop)
    choices.note(call, *(("the module itself", "there is one cell") if itself else (way.name, why)))
    if why and warns and not alone and layout.n >= _FEWEST:
        choices.say_once(f"cells {call.method}", f"{call.name} runs cell by cell: {why}")
    return results


def carry_out_apart(
    way: Way, why: str, kind: Kind, call: Call, grouping: Grouping, choices: Choices, frozen: Tensor
) -> Results:
    """The results of a way for samples in frozen cells, bool [k], without gradients, and for the others."""
    n, cells = grouping.n, grouping.cells
    cells = torch.zeros(n, dtype=torch.int32, device=grouping.device) if cells is None else cells
    still = frozen.index_select(0, cells)
    found, rows = list[Results](), list[Tensor]()
    for own, context in ((~still, contextlib.nullcontext()), (still, torch.no_grad())):
        rows.append(own.nonzero()[:, 0])
        if len(rows[-1]):
            part = grouping.of_entries(rows[-1], cells[rows[-1]])
            with context:
                found.append(carry_out(way, why, kind, call, part, choices))
    order = torch.cat(rows)
    tensors = []
    for parts in zip(*(results.unsorted for results in found), strict=True):
        joined = torch.cat(parts)
        # The backward of index_copy is a gather, where that of an index would add up.
        joined = torch.zeros_like(joined).index_copy(0, order, joined)
        if joined.is_floating_point() and not len(rows[0]):  # a batch without samples to learn from is no error
            joined = _Constant.apply(joined, *(p for p in cell_parameters(call.module) if p.requires_grad))
        tensors.append(joined)
    return Results(found[0].value, tensors)


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


def measured(ways: list[Way], call: Call, grouping: Grouping) -> list[float]:
    """Seconds that each way takes for the batch of a call, forward and, where there are gradients, backward.

    The ways take turns, and the least time of each counts. A double of the module takes what they write and the
    gradients; random numbers go on as if nothing had run.
    """
    double, leaves = Double(call.module), list[Tensor]()

    def leaf(value: Tensor) -> Tensor:
        taken = value.detach().requires_grad_(value.requires_grad and torch.is_grad_enabled())
        leaves.extend([taken] * taken.requires_grad)
        return taken

    double.fill({id(p): leaf(p) for _, _, p in owned_parameters(call.module)})
    double.own_buffers()
    args, kwargs = map_tensors((call.args, call.kwargs), leaf)
    again, cuda = replace(call, module=double.module, args=args, kwargs=kwargs), grouping.device.type == "cuda"

    # Beside other work the processor's time says more, but it leaves out what other threads do.
    clock = time.perf_counter if cuda or torch.get_num_threads() > 1 else time.thread_time

    def seconds(way: Way) -> float:
        if cuda:
            torch.cuda.synchronize(grouping.device)
        start = clock()
        outputs = [t for t in way.run(again, grouping.anew()).unsorted if t.requires_grad and t.is_floating_point()]
        if outputs and leaves:
            # Of a sum: with gradients of their own for the outputs torch imports sympy.
            total = torch.stack([(t * torch.ones_like(t)).sum().float() for t in outputs]).sum()
            torch.autograd.grad(total, leaves, allow_unused=True)
        if cuda:
            torch.cuda.synchronize(grouping.device)
        return clock() - start

    best, began = [float("inf")] * len(ways), clock()
    with torch.random.fork_rng([grouping.device] if cuda else []):
        for turn in range(_TURNS):
            for i, way in enumerate(ways):
                if turn < 2 or best[i] <= 1.5 * min(best):
                    best[i] = min(best[i], seconds(way))
            if turn and clock() - began > _ENOUGH:
                break
    return best


# Comparison -----------------------------------------------------------------------------------------------------------


Outcome = tuple[Results, list[Tensor]]  # and gradients


class Trial:
    """A copy of a module and a few samples of a call, in cells of their own whose parameters differ."""

    def __init__(self, call: Call, grouping: Grouping, dtype: torch.dtype | None = None) -> None:
        self.made_of = call, grouping
        device = grouping.device
        self.n = n = rows_for(call.module, tensors_of((call.args, call.kwargs)), _TRIED)
        picked = torch.arange(n, device=device) * call.layout.n // n
        cells = (torch.arange(n, device=device) * 7 % 5 // 2).int()
        self.entries = Grouping(cells, n, _CELLS, device, grouping.backend, rows=picked)
        self.entries.source, self.entries.occupied  # noqa: B018  found here: under a mode torch imports its compiler
        generator = torch.Generator().manual_seed(0)
        memo: dict[int, Any] = {id(p): _made_different(p, generator) for p in cell_parameters(call.module)}
        module = clone_module(call.module, memo).to(dtype)
        self._leaves: list[Tensor] = []

        def leaf(value: Tensor) -> Tensor:
            """An argument with a gradient of its own, where it takes one."""
            own = value.detach().to(dtype if value.is_floating_point() else None)
            if value.requires_grad and torch.is_grad_enabled():
                self._leaves.append(own.requires_grad_())
            return own

        args, kwargs = map_tensors((call.args, call.kwargs), leaf)
        self.call = replace(call, module=module, args=args, kwargs=kwargs)

    def run(self, way: Way) -> Results:
        """The results of a way, with random numbers of 0."""
        with NoRandomness() if isinstance(way, Loop) else contextlib.nullcontext():  # a fused network draws none
            return way.run(self.call, self.entries)

    def outcome(self, way: Way) -> Outcome:
        """Results, and gradients of a weighted sum of them."""
        results, generator, total = self.run(way), torch.Generator().manual_seed(7), []
        for tensor in results.tensors:
            if tensor.requires_grad:
                tensor = torch.view_as_real(tensor) if tensor.is_complex() else tensor
                weights = torch.randn(tensor.shape, generator=generator).to(tensor)
                total.append((tensor * weights).sum().float())
        if not total or not torch.is_grad_enabled():
            return results, []
        torch.stack(total).sum().backward()  # not torch.autograd.grad, which some checkpoints refuse
        leaves = [t for t in (*self.call.module.parameters(), *self._leaves) if t.requires_grad]
        gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in leaves]
        for leaf in leaves:
            leaf.grad = None
        return results, gradients

    def agrees(self, way: Way, loop: Way, expected: Outcome) -> bool:
        """Whether a way gives what the loop gives; where it does not, whether it does in float64.

        A deep network of fast sines makes its own rounding as large as its results.
        """
        if _same(self.outcome(way), expected):
            return True
        try:
            exact = Trial(*self.made_of, dtype=torch.float64)
            return _same(exact.outcome(way), exact.outcome(loop))
        except Exception:
            return False

    def check_parameters(self) -> None:
        """Raises TypeError where the module changes its parameters."""
        try:
            with torch.no_grad():
                self.run(Loop())
        except Forbidden:
            raise
        except Exception:
            return  # the call itself says so

    def is_groupable(self) -> bool:
        """Whether the module runs for all cells at once on this batch, right or wrong."""
        try:
            with torch.no_grad():
                self.run(Grouped(quiet=True))
        except Exception:
            return False
        return True

    def fused(self, loop: Way, expected: Outcome, assume: Mapping[str, bool]) -> Way:
        """The network as one operation; raises where something stands in the way."""
        with NoRandomness():
            module, given = self.made_of[0].module, self.call.arranged(self.entries)
            count = rows_for(module, given)
            way = Fused(replace(self.call, module=module), [rows[:count] for rows in given], assume)
        if not self.agrees(way, loop, expected):
            raise Unfusable("the traced network gives other results than its forward")
        return way

    def check_rows(self, loop: Loop) -> None:
        """Raises TypeError where results for samples change when others are left out."""
        bounds = [(cell, first, (first + last) // 2, last) for cell, first, last in self.entries.occupied]
        halves = [half for cell, a, b, c in bounds for half in ((cell, a, b), (cell, b, c))]
        with NoRandomness():
            apart = loop.on(self.call, self.entries, halves)
        if not all(map(agree, apart.tensors, self.run(loop).tensors)):
            name = type(self.call.module).__name__
            raise TypeError(
                f"{_OP}: module must treat samples one by one, but {name} gives other results for a sample when other "
                "samples are left out: it mixes samples (attention or statistics over a batch)"
            )


def _same(found: Outcome, expected: Outcome) -> bool:
    (a, ours), (b, theirs) = found, expected
    alike = len(a.tensors) == len(b.tensors) and len(ours) == len(theirs)
    return alike and all(map(agree, a.tensors, b.tensors)) and agree_gradients(ours, theirs)


@torch.no_grad()
def _made_different(parameter: Tensor, generator: torch.Generator) -> nn.Parameter:
    """Entries for the cells of a trial, [3, ...], each some way off the router's own."""
    with torch.inference_mode(False):
        values = parameter.detach()[torch.arange(_CELLS, device=parameter.device) % parameter.shape[0]].clone()
        if (values.is_floating_point() or values.is_complex()) and values.numel():
            numbers = torch.view_as_real(values) if values.is_complex() else values
            size = float(numbers.float().square().mean().sqrt()) or 0.1
            numbers += (0.2 * size * torch.randn(numbers.shape, generator=generator)).to(numbers)
        return nn.Parameter(values, requires_grad=parameter.requires_grad)


def admitted(trial: Trial, choices: Choices, wish: Wish) -> Kind:
    """The ways that give what the loop gives, or an error where the fused one must be among them."""
    for loop in (Loop(), Loop(again=True)):
        try:
            expected = trial.outcome(loop)
            break
        except Forbidden:
            raise
        except Exception as error:  # perhaps its code runs again in the backward pass
            why = f"its forward fails on a few samples ({type(error).__name__}: {error})"
    else:
        return Kind([Loop(why)])
    if loop.keeps:
        says = f"{trial.call.name} keeps a parameter as `{loop.keeps}`, which is of that call alone"
        choices.say_once(f"keeps {trial.call.method}", says)
    ways, is_open, unfused = list[Way](), False, ""
    if wish.fuse and wish.way in ("fastest", "fused"):
        try:
            ways.append(trial.fused(loop, expected, wish.assume))
            choices.fused.add(trial.call.method)
        except Exception as error:
            trial.check_rows(loop)
            why = str(error) if isinstance(error, Unfusable) else f"{type(error).__name__}: {error}"
            says = f"fuse=True needs a network that can be fused, but in {trial.call.name} {why}"
            if not wish.several:
                raise ValueError(f"{_OP}: {says}") from error
            unfused = f"not fused, since {why}"
            choices.say_once(f"fuse {trial.call.method}", says)
            choices.fused.discard(trial.call.method)
    if wish.way in ("fastest", "grouped") or (wish.way == "fused" and not ways):
        try:
            tried = Grouped(quiet=True)
            if trial.agrees(tried, loop, expected):
                ways.append(Grouped(min(max(_PIECE * trial.n // tried.widest, 1 << 10), 1 << 16), why=unfused))
            else:
                loop.why = "its forward on the samples of all cells gives other results than on those of one cell"
        except BackendUnavailable:
            raise
        except Ungroupable as error:
            loop.why, is_open = str(error), error.of_batch
        except Exception as error:
            loop.why = f"its forward fails on the samples of all cells ({type(error).__name__}: {error})"
    if not ways:
        trial.check_rows(loop)
    elif loop.again:
        ways = ways[:1]  # cannot be measured, since some checkpoints refuse torch.autograd.grad
    return Kind([*ways, loop], is_open and not ways)


# Rays -----------------------------------------------------------------------------------------------------------------


def check_rays(call: Call) -> None:
    """Raises ValueError where [n, 1, f] gives other results than [rays, samples, f], for a few samples of one cell."""
    lead = call.layout.lead
    for samples in (6, lead[-1]):  # a module may be made for a number of samples
        try:
            whole, alone = _of_few(call, (*[1] * (len(lead) - 2), min(lead[-2], 2), min(lead[-1], samples)))
        except Exception:
            continue
        if len(whole) != len(alone) or not all(agree(b.flatten(), a.flatten()) for a, b in zip(whole, alone)):
            raise ValueError(
                f"{_OP}: module must give for [n, 1, f] what it gives for [rays, samples, f], but "
                f"{type(call.module).__name__} does not: it mixes the samples of a ray, or squeezes or flattens its "
                "arguments; for that, layout='flat' calls it with [n, f]"
            )
        return


def _of_few(call: Call, few: tuple[int, ...]) -> list[list[Tensor]]:
    """What the first cell's module returns for a few samples, seen as rays and as the router shows them."""
    found: list[Tensor] = []

    def first(tensor: Tensor, kind: str) -> Tensor:
        found.append(tensor.detach()[tuple(slice(size) for size in (few[:-1] if kind == RAY else few))])
        return found[-1]

    args, kwargs = call.changed(first)
    small = replace(call, layout=replace(call.layout, lead=few), args=args, kwargs=kwargs)
    cell = {id(parameter): parameter.detach()[0] for parameter in cell_parameters(call.module)}
    with torch.no_grad(), NoRandomness():
        return [tensors_of(Double(call.module).run(small, rows, cell)) for rows in (found, small.arranged(None))]
