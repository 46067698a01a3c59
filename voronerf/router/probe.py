"""Finds the fastest evaluation (fused or grouped) whose results agree with the loop over cells.

Each evaluation runs once on a few samples of the first batch, in a copy of the module whose cells have different
parameters. Its results and gradients are compared with the loop's.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.tolerances import AGREE, agree, agree_gradients
from voronerf.router.axes import multiple
from voronerf.router.cells import clone_module
from voronerf.router.double import Double, Forbidden, items_of, restore_items
from voronerf.router.fused import Fused
from voronerf.router.grouped import (
    CallAxes,
    Grouped,
    Loop,
    NoRandomness,
    Recorder,
    Ungroupable,
    Way,
    steps_of,
    text_of_line,
)
from voronerf.router.grouping import CHANGES, Grouping, cell_parameters, parts_of
from voronerf.router.layout import BROADCAST, RAY, Call, Results, as_plain, map_tensors, map_tree, tensors_of
from voronerf.router.trace import Unfusable
from voronerf.router.watch import Inputs, Source

_OP = "VoronoiRouter"
FEWEST = 8  # minimum number of samples in a probe; a smaller batch is extended by similar samples
_SAMPLES, _CELLS = 41, 3  # numbers of samples and cells of a probe
_COUNTS = (_SAMPLES, 37)  # numbers of samples of two runs; sizes that change between them count samples
_CHECKED = 8  # rows for the check whether a module needs a subclass of tensors
_PIECE = 8 << 20  # bytes of the largest tensor in a piece of rows on a CPU; larger tensors outgrow the cache

_OWN = frozenset(vars(nn.Module()))  # attributes that every module has

Outcome = tuple[Results, list[Tensor]]  # results and gradients


@dataclass(frozen=True)
class Options:
    """The options of a router that decide which evaluations (fused, grouped) are tried."""

    fuse: bool  # user promises that ``forward`` is a pure function
    way: str  # the first evaluation to try: "fused", "grouped" or "loop"
    many_methods: bool  # whether several methods are routed; if so, a method that cannot be fused is no error
    names: tuple[str, ...]  # names of the parameters that the module was wrapped with


class ProbeRuns(NamedTuple):
    """Two runs of a module: the functions they call, the leaves of their results by name, and the double that ran."""

    runs: tuple[Recorder, Recorder]
    leaves: list[dict[str, Any]]
    double: Double


class Probe:
    """A copy of a module with three cells of different parameters, and a few samples of a call in these cells.

    ``others`` are values of arguments, attributes and buffers that replace the current values.
    """

    def __init__(
        self,
        call: Call,
        grouping: Grouping,
        dtype: torch.dtype | None = None,
        others: Sequence[tuple[Source, Any]] = (),
    ) -> None:
        self._source, self._others = (call, grouping), others
        self.refused = ""  # why a changed value cannot be an input
        self.counts: dict[str, int] = {}  # for each number in the results that counts samples, its multiple of n
        device, generator = grouping.device, torch.Generator().manual_seed(0)
        call = _widened(call, generator) if call.layout.n < FEWEST else call
        picked = torch.arange(_SAMPLES, device=device) * call.layout.n // _SAMPLES
        cells = (torch.arange(_SAMPLES, device=device) * 7 % 5 // 2).int()
        self._entries = Grouping(cells, _SAMPLES, _CELLS, device, grouping.backend, rows=picked)
        self._entries.source, self._entries.occupied  # noqa: B018  cached, since a mode would import torch's compiler
        memo = {id(p): _perturbed(p, generator) for p in cell_parameters(call.module)}
        module = clone_module(call.module, memo).to(dtype)
        self._leaves: list[Tensor] = []

        def leaf(value: Tensor) -> Tensor:
            """Returns a detached copy of an argument, as a leaf tensor with a gradient if the argument has one."""
            copied = value.detach().to(dtype if value.is_floating_point() else None)
            if value.requires_grad and torch.is_grad_enabled():
                self._leaves.append(copied.requires_grad_())
            return copied

        args, kwargs = map_tensors((call.args, call.kwargs), leaf)
        parts, arguments = [*parts_of(module).values()], {s: value for s, value in others if isinstance(s, str)}
        self._call = replace(call, module=module, args=args, kwargs=kwargs)
        if arguments:
            self._call = self._call.with_leaves(arguments.get)
        for source, value in others:
            if not isinstance(source, str):
                part = parts[source[0]]
                (part._buffers if source[1] in part._buffers else vars(part))[source[1]] = value

    def find_way(
        self, options: Options, warn_once: Callable[[str, str], None], inputs: Sequence[Inputs], too_many: str = ""
    ) -> tuple[Way, Loop, bool]:
        """Returns the fastest evaluation equal to the loop, the loop, and whether another batch may run grouped.

        The module is fused with the first of ``inputs`` that succeeds. It is not fused if its constants have changed
        too often; ``too_many`` is then the explanation, otherwise it is empty.

        Raises:
            TypeError: If the module changes its parameters or mixes samples.
            ValueError: If fusion is required, but fails, and only one method of the module is routed.
        """
        call = self._call
        steps: Callable[[], list[CallAxes]] = self.steps
        try:
            steps = functools.partial(steps_of, self.note_changes(warn_once).runs, _COUNTS)
        except Forbidden:
            raise
        except Exception:  # the result's ``why`` names the reason
            pass
        for loop in (Loop(), Loop(again=True)):
            try:
                expected = self._outcome(loop)
                break
            except Forbidden:
                raise
            except Exception as error:  # perhaps because code runs again in the backward pass
                why = f"its forward fails on a few samples ({type(error).__name__}: {error})"
        else:
            return (loop := Loop(why)), loop, False
        may_group, unfused = False, too_many
        if unfused:
            warn_once(f"changes {call.method}", f"{call.name} is {unfused}")
        elif options.fuse and options.way == "fused":
            try:
                return self._fused(loop, expected, inputs), loop, False
            except Exception as error:
                self._check_rows(loop)
                why = str(error) if isinstance(error, Unfusable) else f"{type(error).__name__}: {error}"
                message = f"fuse=True needs a network that can be fused, but in {call.name} {why}"
                if not options.many_methods:
                    raise ValueError(f"{_OP}: {message}") from error
                unfused = f"not fused, since {why}"
                warn_once(f"fuse {call.method}", message)
        if options.way != "loop":
            try:
                grouped = Grouped([steps()], quiet=True)
                if self._agrees(grouped, loop, expected):
                    piece = min(max(_PIECE * _SAMPLES // grouped.widest, 1 << 10), 1 << 16)
                    return Grouped(grouped.records, piece, why=unfused), loop, False
                loop.why = "its forward on the samples of all cells gives other results than the loop over cells"
            except BackendUnavailable:
                raise
            except Ungroupable as error:
                loop.why, may_group = str(error), error.of_batch
            except Exception as error:
                loop.why = f"its forward fails on the samples of all cells ({type(error).__name__}: {error})"
        self._check_rows(loop)
        return loop, loop, may_group

    def steps(self) -> list[CallAxes]:
        """Returns the module's function calls, recorded in two runs (:class:`ProbeRuns`)."""
        return steps_of(self.record().runs, _COUNTS)

    def confirmed_steps(self) -> list[CallAxes]:
        """Returns the module's calls if its grouped run equals the loop over cells; or raises :class:`Ungroupable`."""
        steps, loop = self.steps(), Loop()
        if not self._agrees(Grouped([steps], quiet=True), loop, self._outcome(loop)):
            raise Ungroupable("its forward gives other results than the loop over cells", of_batch=True)
        return steps

    def record(self, reads: set[tuple[int, str]] | None = None) -> ProbeRuns:
        """Runs the first cell's module with two numbers of samples, and records the runs."""
        rows, runs, leaves = self._call.arranged(self._entries), (Recorder(), Recorder()), list[dict[str, Any]]()
        cell = {id(parameter): parameter[0] for parameter in cell_parameters(self._call.module)}
        double = Double(self._call.module, reads)
        if self._containers():
            self.run_once(self._call.module)

        def note(name: str, leaf: Any, nested: bool) -> Any:
            leaves[-1][name] = leaf
            return leaf

        with NoRandomness():
            for count, recorder in zip(_COUNTS, runs, strict=True):
                leaves.append({})
                map_tree(double.run(self._call, [tensor[:count] for tensor in rows], cell, recorder), note)
        return ProbeRuns(runs, leaves, double)

    def run_once(self, module: nn.Module) -> None:
        """Runs the first cell of a module for both numbers of samples, which fills caches in dicts and lists."""
        rows = self._call.arranged(self._entries)
        for count in _COUNTS:
            Double(module).run(self._call, [tensor[:count] for tensor in rows])

    def _containers(self) -> dict[tuple[int, str], Any]:
        """Returns the items of the lists, dicts and sets of the module, by submodule and attribute."""
        return {
            (place, name): items_of([value])
            for place, part in enumerate(parts_of(self._call.module).values())
            for name, value in vars(part).items()
            if isinstance(value, (list, dict, set)) and name not in _OWN
        }

    def note_changes(self, warn_once: Callable[[str, str], None]) -> ProbeRuns:
        """Records two runs of the module; stores the names of the containers that they change (CHANGES).

        The items of these containers are restored after each call. Numbers are left to :meth:`_note_numbers`.
        """
        initial, call = self._containers(), self._source[0]
        if initial:
            self.run_once(self._call.module)
        filled, recording = self._containers(), self.record()
        trees = [[*parts_of(module).values()] for module in (self._call.module, call.module)]
        for (place, name), items in filled.items():
            if not all(_same_items(*pair) for pair in items):
                restore_items(initial[place, name])
                for parts in trees:
                    changes = vars(parts[place]).get(CHANGES, ())
                    vars(parts[place])[CHANGES] = (*dict.fromkeys((*changes, name)),)
                what = f"changes the items of {type(parts[place]).__name__}.{name}"
                warn_once(f"items {call.name}", f"{call.name} {what}, which are restored after the call")
        if initial:
            self.run_once(call.module)
        self._note_numbers(recording, warn_once)
        return recording

    def _note_numbers(self, recording: ProbeRuns, warn_once: Callable[[str, str], None]) -> None:
        """Finds the results that count samples; warns of other numbers that change, in results or in attributes.

        Raises Forbidden for results whose width depends on the number of samples.
        """
        name, (ours, theirs), counts = self._call.name, recording.leaves, dict[str, int]()
        for key, number in ours.items():
            other: Any = theirs.get(key)
            shapes = [leaf.shape for leaf in (number, other) if isinstance(leaf, Tensor)]
            # A call of one sample mixes nothing, and its arguments [1, f] may be shared.
            if len({shape[1:] for shape in shapes}) > 1 and self._source[0].layout.n > 1:
                widths = " and ".join(f"{list(shape)} for {n} samples" for shape, n in zip(shapes, _COUNTS))
                raise Forbidden(f"{_OP}: module must treat samples one by one, but {name} returns {widths}")
            if type(number) not in (int, float) or type(other) is not type(number) or number == other:
                continue
            m = multiple((number, other), _COUNTS) if type(number) is int and len(self._call.layout.lead) == 1 else 0
            if m:
                counts[key] = m
            else:
                what = f"a number{f' in {key!r}' if key else ''} that depends on the samples of a cell"
                warn_once(f"number {name}", f"{name} returns {what}; the router returns the number of one cell")
        self.counts = counts
        if recording.double.assigned:
            parts = [*parts_of(self._call.module).values()]
            for (place, key), line in self.record(set()).double.writes.items():
                if (place, key) in recording.double.assigned:
                    what = f"{type(parts[place]).__name__}.{key}{text_of_line(*line)}"
                    rule = "set it outside of forward, since assignments in forward are lost after the call"
                    warn_once(f"assigns {name}", f"{name} changes {what} and reads it; {rule}")

    def is_groupable(self) -> bool:
        """Returns whether the module runs without error for all cells at once on this batch."""
        try:
            with torch.no_grad():
                self._run(Grouped([self.steps()], quiet=True))
        except Exception:
            return False
        return True

    def _run(self, way: Way) -> Results:
        """Returns the results of an evaluation, with random numbers of 0."""
        with NoRandomness() if isinstance(way, Loop) else contextlib.nullcontext():  # fused networks draw no numbers
            return way.run(self._call, self._entries)

    def _outcome(self, way: Way) -> Outcome:
        """Returns the results of an evaluation, and the gradients of a weighted sum of them."""
        results, generator, total = self._run(way), torch.Generator().manual_seed(7), []
        for tensor in results.tensors:
            tensor = torch.view_as_real(tensor) if tensor.is_complex() else tensor
            weights = torch.randn(tensor.shape, generator=generator, device="cpu")  # drawn for constants too
            if tensor.requires_grad:
                total.append((tensor * weights.to(tensor)).sum().float())
        if not total or not torch.is_grad_enabled():
            return results, []
        torch.stack(total).sum().backward()  # some checkpoints refuse torch.autograd.grad
        leaves = [t for t in (*self._call.module.parameters(), *self._leaves) if t.requires_grad]
        gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in leaves]
        for leaf in leaves:
            leaf.grad = None
        return results, gradients

    def _agrees(self, way: Way, loop: Way, expected: Outcome) -> bool:
        """Returns whether the results and gradients of an evaluation agree with the loop.

        If they differ, both are computed and compared again without autocast, and then in float64. With autocast,
        rounding errors exceed the tolerance; in a deep network of sines of high frequency, they are as large as the
        results.
        """
        outcome, device = self._outcome(way), self._entries.device.type
        if self._same(outcome, expected):
            return True
        if _kinds(outcome) != _kinds(expected):
            return False
        dtypes = (None, torch.float64) if torch.is_autocast_enabled(device) else (torch.float64,)
        with torch.autocast(device, enabled=False):
            for dtype in dtypes:
                with contextlib.suppress(Exception):
                    exact = Probe(*self._source, dtype, self._others)
                    if exact._same(exact._outcome(way), exact._outcome(loop)):
                        return True
        return False

    def _same(self, outcome: Outcome, expected: Outcome) -> bool:
        """Returns whether results and gradients agree within the rounding of the lowest precision among them."""
        (a, our_gradients), (b, their_gradients) = outcome, expected
        if len(a.tensors) != len(b.tensors) or len(our_gradients) != len(their_gradients):
            return False
        dtypes = [t.dtype for t in (*b.tensors, *self._call.module.parameters()) if t.dtype in AGREE]
        lowest = max(dtypes, key=AGREE.__getitem__, default=torch.float32)
        same_results = all(agree(x, y, AGREE[lowest]) for x, y in zip(a.tensors, b.tensors))
        return same_results and agree_gradients(our_gradients, their_gradients)

    def _fused(self, loop: Way, expected: Outcome, inputs: Sequence[Inputs]) -> Way:
        """Returns the fused evaluation; raises an exception if the network cannot be fused."""
        for candidate in inputs:
            try:
                with NoRandomness():
                    call = replace(self._call, module=self._source[0].module)
                    way = Fused(call, self._call.arranged(self._entries), candidate)
                if not self._agrees(way, loop, expected):
                    raise Unfusable("the traced network gives other results than its forward")
                if candidate.others:
                    probe = Probe(*self._source, others=candidate.others)
                    if not probe._agrees(way, loop, probe._outcome(loop)):
                        raise Unfusable("the traced network gives other results for an earlier value")
                return way
            except Exception as error:
                if candidate is inputs[-1]:
                    raise
                self.refused = str(error)
        raise AssertionError

    def _check_rows(self, loop: Loop) -> None:
        """Raises TypeError if results for a sample depend on the other samples."""
        bounds = [(cell, first, (first + last) // 2, last) for cell, first, last in self._entries.occupied]
        halves = [half for cell, a, b, c in bounds for half in ((cell, a, b), (cell, b, c))]
        with NoRandomness():
            apart = loop.on(self._call, self._entries, halves)
        results, buffers = self._run(loop).tensors, dict(self._call.module.named_buffers())
        old = {key: buffer.clone() for key, buffer in buffers.items()}
        again, name = self._run(loop).tensors, type(self._call.module).__name__
        if not all(map(agree, results, again)):
            written = [key for key, buffer in buffers.items() if not torch.equal(buffer, old[key])]
            what = (
                "makes layers or draws numbers inside of its forward; make layers in __init__, and pass numbers as an"
            )
            what = (
                f"writes into its buffer {written[0]!r}; write it outside of forward" if written else f"{what} argument"
            )
            raise TypeError(f"{_OP}: module must give the same results for the same samples, but {name} {what}")
        if not all(map(agree, apart.tensors, results)):
            raise TypeError(
                f"{_OP}: module must treat samples one by one, but {name} gives other results for a sample when other "
                "samples are left out: it mixes samples (attention or statistics over a batch)"
            )


def _same_items(container: Any, items: Any) -> bool:
    """Returns whether a list, dict or set still has the same items."""
    if len(container) != len(items) or isinstance(container, set):
        return bool(container == items)
    pairs = (
        zip((*container, *container.values()), (*items, *items.values()))
        if isinstance(items, dict)
        else zip(container, items)
    )
    return all(x is y for x, y in pairs)


def _kinds(outcome: Outcome) -> list[tuple[torch.Size, torch.dtype]]:
    return [(tensor.shape, tensor.dtype) for tensors in (outcome[0].tensors, outcome[1]) for tensor in tensors]


@torch.no_grad()
def _widened(call: Call, generator: torch.Generator) -> Call:
    """Extends a smaller call to at least ``FEWEST`` different samples, near its own samples.

    Identical samples could not show that a module mixes samples.
    """
    lead = call.layout.lead
    count = -(-FEWEST // call.layout.n)

    def widen(tensor: Tensor, kind: str) -> Tensor:
        if tensor.shape[0] == 1 != lead[0]:  # broadcast along the first dimension
            return tensor
        rows = tensor.detach().repeat(count, *[1] * (tensor.dim() - 1))
        if rows.is_floating_point():  # towards 0.3, which lies in the usual boxes of positions, [0, 1] and [-1, 1]
            noise = torch.rand(rows.shape, generator=generator, device="cpu").to(rows)
            rows = rows.lerp(torch.full_like(rows, 0.3), 0.1 * noise)
        return rows.requires_grad_(tensor.requires_grad)

    args, kwargs = call.changed(widen)
    return replace(call, layout=replace(call.layout, lead=(count * lead[0], *lead[1:])), args=args, kwargs=kwargs)


@torch.no_grad()
def _perturbed(parameter: Tensor, generator: torch.Generator) -> nn.Parameter:
    """Returns a parameter for the cells of a probe, [3, ...]: the router's own values with noise."""
    with torch.inference_mode(False):
        values = parameter.detach()[torch.arange(_CELLS, device=parameter.device) % parameter.shape[0]].clone()
        if (values.is_floating_point() or values.is_complex()) and values.numel():
            numbers = torch.view_as_real(values) if values.is_complex() else values
            size = float(numbers.float().square().mean().sqrt()) or 0.1
            noise = torch.randn(numbers.shape, generator=generator, device="cpu")
            numbers += (0.2 * size * noise).to(numbers)
        return nn.Parameter(values, requires_grad=parameter.requires_grad)


def check_rays(call: Call) -> None:
    """Raises ValueError if a module's results for [n, 1, f] and [rays, samples, f] differ; tests a few samples."""
    lead = call.layout.lead
    for samples in (6, lead[-1]):  # a module may need a certain number of samples
        try:
            whole, alone = _of_few(call, (*[1] * (len(lead) - 2), min(lead[-2], 2), min(lead[-1], samples)))
        except Exception:
            continue
        if len(whole) != len(alone) or not all(agree(b.flatten(), a.flatten()) for a, b in zip(whole, alone)):
            raise ValueError(
                f"{_OP}: module must give the same results for [n, 1, f] as for [rays, samples, f], but "
                f"{type(call.module).__name__} does not: it mixes the samples of a ray, or squeezes or flattens its "
                "arguments; in that case, layout='flat' calls it with [n, f]"
            )
        return


def _of_few(call: Call, few: tuple[int, ...]) -> list[list[Tensor]]:
    """Returns the first cell's results for a few samples, in two shapes.

    The module gets the samples first as [rays, samples, f], then in the shapes that the router passes. ``few`` has the
    leading dimensions of the few samples.
    """
    tensors: list[Tensor] = []

    def first(tensor: Tensor, kind: str) -> Tensor:
        if kind == BROADCAST:
            tensor = tensor.expand(*call.layout.lead, *tensor.shape[len(few) :])
        tensors.append(tensor.detach()[tuple(slice(size) for size in (few[:-1] if kind == RAY else few))])
        return tensors[-1]

    args, kwargs = call.changed(first)
    small = replace(call, layout=replace(call.layout, lead=few), args=args, kwargs=kwargs)
    with torch.no_grad(), NoRandomness():
        return [tensors_of(Double(call.module).run(small, rows)) for rows in (tensors, small.arranged(None))]


def check_subclasses(call: Call, plain: Call) -> None:
    """Raises TypeError if a call gives other results for a few plain tensors than for tensors of a subclass."""
    rows: list[Tensor] = []

    def first(tensor: Tensor, kind: str) -> Tensor:
        rows.append(tensor[:_CHECKED])
        return tensor

    with torch.no_grad(), NoRandomness():
        expected = None
        with contextlib.suppress(Exception):  # a slice of a subclass may be invalid
            call.changed(first)
            expected = tensors_of(Double(call.module).run(call, rows))
        try:
            rows.clear()
            plain.changed(first)
            results = tensors_of(Double(call.module).run(plain, rows))
            same = expected is None or (
                len(results) == len(expected) and all(map(agree, map(as_plain, results), map(as_plain, expected)))
            )
            why = "" if same else "its results differ"
        except Exception as error:
            if expected is None and not isinstance(error, AttributeError):
                return  # the call itself raises a better error
            why = f"{type(error).__name__}: {error}"
    if why:
        kind = next(type(x).__name__ for x in tensors_of((call.args, call.kwargs)) if as_plain(x) is not x)
        raise TypeError(
            f"{_OP}: {call.name} must work with plain tensors, which hold the rows of a cell, but "
            f"needs a {kind} ({why}); extract what it needs from the {kind} before the call"
        )
