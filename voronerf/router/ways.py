"""How a routed call is carried out: chosen once for a kind of call, and admitted by one comparison with the loop.

The loop over cells defines the result. The faster ways are the module's own ``forward`` once for the rows of all cells
(:mod:`voronerf.router.grouped`) and, where the user said ``fuse=True``, one operation (:mod:`voronerf.router.fused`).
A faster way is admitted if it gives what the loop gives: both run once on a few samples of the batch, in a copy of the
module whose cells have parameters of their own, and results and gradients are compared.
"""

from __future__ import annotations

import inspect
import os
import threading
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.backends import BackendUnavailable
from voronerf.diagram.blending import Mixture
from voronerf.router import rules  # noqa: F401  registers the rules
from voronerf.router.cells import clone_module
from voronerf.router.fused import fuse
from voronerf.router.grouped import Grouped, Loop, NoRandomness, Ungroupable, Way
from voronerf.router.grouping import Grouping, cell_parameters, in_place_of_parameters, keep_freed_memory
from voronerf.router.layout import RAY, Call, Results, map_tensors, rebuild, tensors_of
from voronerf.router.trace import ROWS, Unfusable
from voronerf.tolerances import agree, agree_gradients

_OP = "VoronoiRouter"
_FEWEST = 8  # samples below which nothing is found out about a kind of call, and the loop runs
_TRIED, _CELLS = 41, 3  # samples of a comparison, unlike any number of features, and their cells
_PIECE = 8 << 20  # bytes of the largest tensor of a piece of rows on a CPU; larger ones are fetched from memory
_KINDS = 256  # kinds of calls that are remembered
_OWN = tuple(str(Path(file).absolute().parents[up]) + os.sep for file, up in ((str(torch.__file__), 0), (__file__, 1)))


class Choices:
    """What a router has found out about its module. Copies of a router begin anew."""

    def __init__(self) -> None:
        self.lock = threading.RLock()  # held during a call: stand-ins are in the place of the module's parameters
        self.forget()

    def forget(self) -> None:
        """Begins anew, after a change of dtype, device or parameters' names."""
        self.kinds: dict[Any, Way] = {}
        self._said: set[str] = set()
        self._latest: dict[str, dict[str, str]] = {}

    def note(self, call: Call, name: str, why: str) -> None:
        """For :meth:`explain`: how a method was carried out."""
        self._latest.setdefault(call.method, {})[name] = why

    def explain(self, methods: tuple[str, ...]) -> str:
        """How each method has been carried out so far, and why."""
        ways = [(method, way) for method in methods for way in self._latest.get(method, {"not called yet": ""}).items()]
        return "\n".join(f"{method}: {way}{f': {why}' if why else ''}" for method, (way, why) in ways)

    def say_once(self, topic: str, message: str) -> None:
        """Warns, the first time that a topic comes up, at the line that called the router."""
        if topic not in self._said:
            files = [frame.filename for frame in inspect.stack(context=0)]
            level = next((i for i, file in enumerate(files) if not file.startswith(_OWN)), len(files))
            warnings.warn(f"{_OP}: {message}", stacklevel=level + 1)
        self._said.add(topic)

    def __reduce__(self) -> tuple[type[Choices], tuple[()]]:
        return Choices, ()


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


def evaluate(call: Call, grouping: Grouping, mixture: Mixture | None, choices: Choices, *, fused: bool) -> Any:
    """What a method returns for the samples of all cells (or two placeholders), some mixed with those of others."""
    if grouping.device.type == "cpu":
        keep_freed_memory()
    way = choose(call, grouping, choices, fused)
    own = carry_out(way, call, grouping, choices).restored(call.layout)
    if mixture is None:
        return own
    entries, tensors = grouping.of_entries(mixture.rows, mixture.cells), tensors_of(own)
    for i, tensor in enumerate(carry_out(way, call, entries, choices).unsorted):
        tensors[i] = mixture.mix(tensors[i], tensor.reshape(entries.n, -1))
    return rebuild(own, tensors)


def carry_out(way: Way, call: Call, grouping: Grouping, choices: Choices) -> Results:
    """The results of a way, or of the loop where a batch cannot be grouped."""
    if isinstance(way, Grouped):
        if grouping.k == 1:
            choices.note(call, "the module itself", "there is one cell")
            return Loop().run(call, grouping)
        try:
            results = way.run(call, grouping)
            choices.note(call, way.name, way.why)
            return results
        except Exception as error:
            lacking = (BackendUnavailable, MemoryError, torch.OutOfMemoryError)
            if isinstance(error, lacking) or "can't allocate memory" in str(error):
                raise
            why = error if isinstance(error, Ungroupable) else f"its forward fails ({error})"
            way = Loop(f"for some batches, since {why}")
    try:
        results = way.run(call, grouping)
    except Exception as error:
        if hasattr(error, "add_note") and len(call.layout.lead) > 1 and not call.layout.flat:  # since Python 3.11
            error.add_note(f"{_OP}: the module saw [n, 1, f] for [rays, samples, f]; layout='flat' gives it [n, f]")
        raise
    choices.note(call, way.name, way.why)
    if isinstance(way, Loop) and grouping.k > 1 and way.why and call.layout.n >= _FEWEST:
        choices.say_once(f"cells {call.method}", f"{call.name} runs cell by cell: {way.why}")
    return results


def choose(call: Call, grouping: Grouping, choices: Choices, fused: bool) -> Way:
    """How to carry out a call of this kind, found out if it is the first."""
    layout, kind = call.layout, kind_of(call, grouping.device, fused)
    way = choices.kinds.get(kind)
    if way is not None and not getattr(way, "open", False):
        return way
    if layout.n < _FEWEST:
        return Loop(f"for fewer than {_FEWEST} samples") if way is None else way
    call.changed(lambda tensor, kind: tensor)  # arguments that are refused are so before anything is found out
    with torch.random.fork_rng([grouping.device] if grouping.device.type == "cuda" else []):
        trial = Trial(call, grouping)
        if way is not None and not trial.is_groupable():
            return way
        if len(layout.lead) > 1 and layout.lead[-1] > 1 and not layout.flat:
            check_rays(call)
        found = admitted(trial, fused)
    if len(choices.kinds) >= _KINDS:
        choices.kinds.clear()
    choices.kinds[kind] = found
    return found


# Comparison -----------------------------------------------------------------------------------------------------------


Outcome = tuple[Results, list[Tensor]]  # and gradients


class Trial:
    """A copy of a module and a few samples of a call, in cells of their own whose parameters differ."""

    def __init__(self, call: Call, grouping: Grouping, dtype: torch.dtype | None = None) -> None:
        self.made_of = call, grouping
        device = grouping.device
        picked = torch.arange(_TRIED, device=device) * call.layout.n // _TRIED
        cells = (torch.arange(_TRIED, device=device) * 7 % 5 // 2).int()
        self.entries = Grouping({"cells": cells}, _TRIED, _CELLS, device, grouping.backend, rows=picked)
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
        """The results of a way."""
        with NoRandomness():
            return way.run(self.call, self.entries)

    def outcome(self, way: Way) -> Outcome:
        """Results, and gradients of a weighted sum of them."""
        results, generator, total = self.run(way), torch.Generator().manual_seed(7), []
        for tensor in results.tensors:
            if tensor.requires_grad and tensor.is_floating_point():
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

    def is_groupable(self) -> bool:
        """Whether the module runs for all cells at once on this batch, right or wrong."""
        try:
            with torch.no_grad():
                self.run(Grouped())
        except Exception:
            return False
        return True

    def fused(self, loop: Way, expected: Outcome) -> Way:
        """The network as one operation; raises where something stands in the way."""
        with NoRandomness():
            rows = [rows[:ROWS] for rows in self.call.arranged(self.entries)]
            way = fuse(replace(self.call, module=self.made_of[0].module), rows)
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
        if values.is_floating_point() and values.numel():
            size = float(values.float().square().mean().sqrt()) or 0.1
            noise = torch.randn(values.shape, generator=generator)
            values += (0.2 * size * noise).to(values)
        return nn.Parameter(values, requires_grad=parameter.requires_grad)


def admitted(trial: Trial, fused: bool) -> Way:
    """The fastest way that gives what the loop gives, or an error where that must be the fused one."""
    for loop in (Loop(), Loop(again=True)):
        try:
            expected = trial.outcome(loop)
            break
        except Exception as error:  # perhaps its code runs again in the backward pass
            why = f"its forward fails on a few samples ({type(error).__name__}: {error})"
    else:
        return Loop(why)
    if fused:
        try:
            return trial.fused(loop, expected)
        except Exception as error:
            trial.check_rows(loop)
            why = str(error) if isinstance(error, Unfusable) else f"{type(error).__name__}: {error}"
        raise ValueError(
            f"{_OP}: fuse=True needs a network that a layer table describes, but in {trial.call.name} {why}"
        )
    try:
        way = Grouped()
        if trial.agrees(way, loop, expected):
            way.piece = min(max(_PIECE * _TRIED // way.widest, 1 << 10), 1 << 16)
            return way
        loop.why = "its forward on the samples of all cells gives other results than on those of one cell"
    except BackendUnavailable:
        raise
    except Ungroupable as error:
        loop.why, loop.open = str(error), error.of_batch
    except Exception as error:
        loop.why = f"its forward fails on the samples of all cells ({type(error).__name__}: {error})"
    trial.check_rows(loop)
    return loop


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
    with torch.no_grad(), NoRandomness(), in_place_of_parameters(call.module, cell):
        return [tensors_of(small.run(rows)) for rows in (found, small.arranged(None))]
