"""Which ways give what the loop over cells gives.

Each runs once on a few samples of the first batch, in a copy of the module whose cells have parameters of their own;
results and gradients are compared.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.tolerances import agree, agree_gradients
from voronerf.router.cells import clone_module
from voronerf.router.double import Double, Forbidden
from voronerf.router.fused import Fused
from voronerf.router.grouped import Grouped, Loop, NoRandomness, Ungroupable, Way
from voronerf.router.grouping import Grouping, cell_parameters
from voronerf.router.layout import BROADCAST, RAY, Call, Results, as_plain, map_tensors, tensors_of
from voronerf.router.trace import Unfusable, rows_for
from voronerf.router.watch import Inputs

_OP = "VoronoiRouter"
FEWEST = 8  # samples; a batch of fewer is probed with others close to them
_SAMPLES, _CELLS = (41, 43, 47, 53), 3  # numbers of samples of a probe, of which one is taken, and their cells
_FEW = 8  # rows that show whether a module needs a subclass of tensors
_PIECE = 8 << 20  # bytes of the largest tensor of a piece of rows on a CPU; larger ones are fetched from memory

Outcome = tuple[Results, list[Tensor]]  # and gradients


@dataclass(frozen=True)
class Options:
    """What the user asked for."""

    fuse: bool  # ``forward`` does the same in every call
    way: str  # "fastest", or the way that is taken without measuring: "fused", "grouped" or "loop"
    several: bool  # methods besides ``forward`` are routed; one that cannot be fused leaves the others fused
    names: tuple[str, ...]  # of the parameters that the module was wrapped with


class Probe:
    """A copy of a module and a few samples of a call, in cells of their own whose parameters differ."""

    def __init__(self, call: Call, grouping: Grouping, dtype: torch.dtype | None = None) -> None:
        self._made_of = call, grouping
        self.refused = ""  # why what changed cannot be an input
        device, generator = grouping.device, torch.Generator().manual_seed(0)
        call = _widened(call, generator) if call.layout.n < FEWEST else call
        self._n = n = rows_for(call.module, tensors_of((call.args, call.kwargs)), _SAMPLES)
        picked = torch.arange(n, device=device) * call.layout.n // n
        cells = (torch.arange(n, device=device) * 7 % 5 // 2).int()
        self._entries = Grouping(cells, n, _CELLS, device, grouping.backend, rows=picked)
        self._entries.source, self._entries.occupied  # noqa: B018  found here: under a mode torch imports its compiler
        memo = {id(p): _perturbed(p, generator) for p in cell_parameters(call.module)}
        module = clone_module(call.module, memo).to(dtype)
        self._leaves: list[Tensor] = []

        def leaf(value: Tensor) -> Tensor:
            """An argument with a gradient of its own, where it takes one."""
            copied = value.detach().to(dtype if value.is_floating_point() else None)
            if value.requires_grad and torch.is_grad_enabled():
                self._leaves.append(copied.requires_grad_())
            return copied

        args, kwargs = map_tensors((call.args, call.kwargs), leaf)
        self._call = replace(call, module=module, args=args, kwargs=kwargs)

    def find_ways(
        self, options: Options, warn_once: Callable[[str, str], None], inputs: Sequence[Inputs], over: str = ""
    ) -> tuple[list[Way], bool]:
        """The ways that give what the loop gives, the loop last; and whether another batch may have more of them.

        The first of ``inputs`` is taken with which the module can be fused; ``over`` says why it is not to be any more.

        Raises:
            TypeError: Where the module changes its parameters or mixes samples.
            ValueError: Where the one method cannot be fused, though it must be.
        """
        call = self._call
        for loop in (Loop(), Loop(again=True)):
            try:
                expected = self._outcome(loop)
                break
            except Forbidden:
                raise
            except Exception as error:  # perhaps its code runs again in the backward pass
                why = f"its forward fails on a few samples ({type(error).__name__}: {error})"
        else:
            return [Loop(why)], False
        ways, is_open, unfused = list[Way](), False, over
        if unfused:
            warn_once(f"changes {call.method}", f"{call.name} is {unfused}")
        elif options.fuse and options.way in ("fastest", "fused"):
            try:
                ways.append(self._fused(loop, expected, inputs))
            except Exception as error:
                self._check_rows(loop)
                why = str(error) if isinstance(error, Unfusable) else f"{type(error).__name__}: {error}"
                says = f"fuse=True needs a network that can be fused, but in {call.name} {why}"
                if not options.several:
                    raise ValueError(f"{_OP}: {says}") from error
                unfused = f"not fused, since {why}"
                warn_once(f"fuse {call.method}", says)
        if options.way in ("fastest", "grouped") or (options.way == "fused" and not ways):
            try:
                tried = Grouped(quiet=True)
                if self._agrees(tried, loop, expected):
                    piece = min(max(_PIECE * self._n // tried.widest, 1 << 10), 1 << 16)
                    ways.append(Grouped(piece, why=unfused))
                else:
                    loop.why = "its forward on the samples of all cells gives other results than on those of one cell"
            except BackendUnavailable:
                raise
            except Ungroupable as error:
                loop.why, is_open = str(error), error.of_batch
            except Exception as error:
                loop.why = f"its forward fails on the samples of all cells ({type(error).__name__}: {error})"
        if not ways:
            self._check_rows(loop)
        elif loop.again:
            ways = ways[:1]  # cannot be measured, since some checkpoints refuse torch.autograd.grad
        return [*ways, loop], is_open and not ways

    def is_groupable(self) -> bool:
        """Whether the module runs for all cells at once on this batch, right or wrong."""
        try:
            with torch.no_grad():
                self._run(Grouped(quiet=True))
        except Exception:
            return False
        return True

    def _run(self, way: Way) -> Results:
        """The results of a way, with random numbers of 0."""
        with NoRandomness() if isinstance(way, Loop) else contextlib.nullcontext():  # a fused network draws none
            return way.run(self._call, self._entries)

    def _outcome(self, way: Way) -> Outcome:
        """Results, and gradients of a weighted sum of them."""
        results, generator, total = self._run(way), torch.Generator().manual_seed(7), []
        for tensor in results.tensors:
            tensor = torch.view_as_real(tensor) if tensor.is_complex() else tensor
            weights = torch.randn(tensor.shape, generator=generator)  # also of a constant, for which ways may differ
            if tensor.requires_grad:
                total.append((tensor * weights.to(tensor)).sum().float())
        if not total or not torch.is_grad_enabled():
            return results, []
        torch.stack(total).sum().backward()  # not torch.autograd.grad, which some checkpoints refuse
        leaves = [t for t in (*self._call.module.parameters(), *self._leaves) if t.requires_grad]
        gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in leaves]
        for leaf in leaves:
            leaf.grad = None
        return results, gradients

    def _agrees(self, way: Way, loop: Way, expected: Outcome) -> bool:
        """Whether a way gives what the loop gives; where it does not, whether it does without autocast or in float64.

        Autocast rounds more than ways may differ, and a deep network of fast sines makes its own rounding as large as
        its results.
        """
        outcome, device = self._outcome(way), self._entries.device.type
        if _same(outcome, expected):
            return True
        if _kinds(outcome) != _kinds(expected):
            return False
        dtypes = (None, torch.float64) if torch.is_autocast_enabled(device) else (torch.float64,)
        with torch.autocast(device, enabled=False):
            for dtype in dtypes:
                with contextlib.suppress(Exception):
                    exact = Probe(*self._made_of, dtype=dtype)
                    if _same(exact._outcome(way), exact._outcome(loop)):
                        return True
        return False

    def _fused(self, loop: Way, expected: Outcome, inputs: Sequence[Inputs]) -> Way:
        """The network as one operation; raises where something stands in the way."""
        for tried in inputs:
            try:
                with NoRandomness():
                    module, tensors = self._made_of[0].module, self._call.arranged(self._entries)
                    count = rows_for(module, tensors)
                    way = Fused(replace(self._call, module=module), [rows[:count] for rows in tensors], tried)
                if not self._agrees(way, loop, expected):
                    raise Unfusable("the traced network gives other results than its forward")
                return way
            except Exception as error:
                if tried is inputs[-1]:
                    raise
                self.refused = str(error)
        raise AssertionError

    def _check_rows(self, loop: Loop) -> None:
        """Raises TypeError where results for samples change when others are left out."""
        bounds = [(cell, first, (first + last) // 2, last) for cell, first, last in self._entries.occupied]
        halves = [half for cell, a, b, c in bounds for half in ((cell, a, b), (cell, b, c))]
        with NoRandomness():
            apart = loop.on(self._call, self._entries, halves)
        once, again = self._run(loop).tensors, self._run(loop).tensors
        name = type(self._call.module).__name__
        if not all(map(agree, once, again)):
            raise TypeError(
                f"{_OP}: module must give the same results for the same samples, but {name} makes layers or draws "
                "numbers inside of its forward; make layers in __init__, and pass numbers as an argument"
            )
        if not all(map(agree, apart.tensors, once)):
            raise TypeError(
                f"{_OP}: module must treat samples one by one, but {name} gives other results for a sample when other "
                "samples are left out: it mixes samples (attention or statistics over a batch)"
            )


def _same(outcome: Outcome, expected: Outcome) -> bool:
    (a, ours), (b, theirs) = outcome, expected
    alike = len(a.tensors) == len(b.tensors) and len(ours) == len(theirs)
    return alike and all(map(agree, a.tensors, b.tensors)) and agree_gradients(ours, theirs)


def _kinds(outcome: Outcome) -> list[tuple[torch.Size, torch.dtype]]:
    return [(tensor.shape, tensor.dtype) for tensors in (outcome[0].tensors, outcome[1]) for tensor in tensors]


@torch.no_grad()
def _widened(call: Call, generator: torch.Generator) -> Call:
    """Returns a call of at least ``FEWEST`` different samples near those of a call that has fewer.

    A module that mixes its samples could not be told by identical ones.
    """
    lead = call.layout.lead
    count = -(-FEWEST // call.layout.n)

    def widen(tensor: Tensor, kind: str) -> Tensor:
        if tensor.shape[0] == 1 != lead[0]:  # the same for all of the first dimension
            return tensor
        rows = tensor.detach().repeat(count, *[1] * (tensor.dim() - 1))
        if rows.is_floating_point():  # towards a number in the boxes that positions are in, [0, 1] or [-1, 1]
            rows = rows.lerp(torch.full_like(rows, 0.3), 0.1 * torch.rand(rows.shape, generator=generator).to(rows))
        return rows.requires_grad_(tensor.requires_grad)

    args, kwargs = call.changed(widen)
    return replace(call, layout=replace(call.layout, lead=(count * lead[0], *lead[1:])), args=args, kwargs=kwargs)


@torch.no_grad()
def _perturbed(parameter: Tensor, generator: torch.Generator) -> nn.Parameter:
    """Entries for the cells of a probe, [3, ...], each some way off the router's own."""
    with torch.inference_mode(False):
        values = parameter.detach()[torch.arange(_CELLS, device=parameter.device) % parameter.shape[0]].clone()
        if (values.is_floating_point() or values.is_complex()) and values.numel():
            numbers = torch.view_as_real(values) if values.is_complex() else values
            size = float(numbers.float().square().mean().sqrt()) or 0.1
            numbers += (0.2 * size * torch.randn(numbers.shape, generator=generator)).to(numbers)
        return nn.Parameter(values, requires_grad=parameter.requires_grad)


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
    """What the first cell's module returns for a few samples as rays, and as the router passes them."""
    tensors: list[Tensor] = []

    def first(tensor: Tensor, kind: str) -> Tensor:
        if kind == BROADCAST:
            tensor = tensor.expand(*call.layout.lead, *tensor.shape[len(few) :])
        tensors.append(tensor.detach()[tuple(slice(size) for size in (few[:-1] if kind == RAY else few))])
        return tensors[-1]

    args, kwargs = call.changed(first)
    small = replace(call, layout=replace(call.layout, lead=few), args=args, kwargs=kwargs)
    cell = {id(parameter): parameter.detach()[0] for parameter in cell_parameters(call.module)}
    with torch.no_grad(), NoRandomness():
        return [tensors_of(Double(call.module).run(small, rows, cell)) for rows in (tensors, small.arranged(None))]


def check_subclasses(call: Call, plain: Call) -> None:
    """Raises TypeError where a call gives something else for a few plain tensors than for those of a subclass."""
    rows: list[Tensor] = []

    def first(tensor: Tensor, kind: str) -> Tensor:
        rows.append(tensor[:_FEW])
        return tensor

    cell = {id(parameter): parameter.detach()[0] for parameter in cell_parameters(call.module)}
    with torch.no_grad(), NoRandomness():
        expected = None
        with contextlib.suppress(Exception):  # a piece of a tensor may lack what its class needs
            call.changed(first)
            expected = tensors_of(Double(call.module).run(call, rows, cell))
        try:
            rows.clear()
            plain.changed(first)
            results = tensors_of(Double(call.module).run(plain, rows, cell))
            same = expected is None or (
                len(results) == len(expected) and all(map(agree, map(as_plain, results), map(as_plain, expected)))
            )
            why = "" if same else "its results differ"
        except Exception as error:
            if expected is None and not isinstance(error, AttributeError):
                return  # the call itself says what is wrong
            why = f"{type(error).__name__}: {error}"
    if why:
        kind = next(type(x).__name__ for x in tensors_of((call.args, call.kwargs)) if as_plain(x) is not x)
        raise TypeError(
            f"{_OP}: {call.name} must work with plain tensors, as rows of cells are, but needs a {kind} ({why}); "
            f"extract what it needs from the {kind} before the call"
        )
