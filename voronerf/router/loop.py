"""The loop over cells, which defines the results, and the comparison of other ways with it.

Another way to run a kind of call is admitted if it gives what the loop gives. They run once on a few samples of the
batch, in a copy of the module whose cells have parameters of their own, and results and gradients are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from voronerf.backends import BackendUnavailable
from voronerf.router.cells import cell_parameters, cells_of, clone_module, in_place_of_parameters
from voronerf.router.fused import ROWS, Program, Unfusable
from voronerf.router.grouped import RANDOM, Ungroupable, run_grouped
from voronerf.router.grouping import Grouping
from voronerf.router.layout import RAY, Call, Results, map_tree, split_rows, tensors_of
from voronerf.tolerances import agree, agree_gradients

_OP = "VoronoiRouter"
_TRIED, _CELLS = 41, 3  # samples of a comparison, unlike any number of features, and their cells
_PIECE = 4 << 20  # bytes of the largest tensor of a piece of rows on a CPU; larger ones are fetched from memory


def run_cells(call: Call, given: list[Tensor], bounds: list[tuple[int, int, int]], *, again: bool = False) -> Results:
    """A module's results for sorted rows, one call for each (cell, first row, row behind the last).

    Where its code runs ``again`` in the backward pass (``torch.utils.checkpoint``), every cell has a copy of the
    module, which keeps the cell's parameters.
    """
    module, counts = call.module, [last - first for _, first, last in bounds]
    pieces = {id(p): cells_of(p) for p in cell_parameters(module)}
    values = []
    for (cell, _, _), part in zip(bounds, split_rows(given, counts), strict=True):
        own: dict[int, Any] = {key: piece[cell] for key, piece in pieces.items()}
        if again:
            kept = {id(tensor): tensor for tensor in (*module.buffers(), *module.parameters())}
            values.append(replace(call, module=clone_module(module, kept | own)).run(part))
            continue
        with in_place_of_parameters(module, own):
            values.append(call.run(part))
    return Results.joined(values, counts, module)


# Comparison -----------------------------------------------------------------------------------------------------------


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
class Choice:
    """How calls of a kind are carried out.

    Attributes:
        way: "fused", "grouped" or "cell by cell".
        why: What stands in the way of a faster one; empty where nothing does.
        flat: For the tensors of a result, whether the module itself flattens them to [rays * samples, ...].
        piece: Rows that a grouped module runs on at once on a CPU.
        again: Whether the module's code runs again in the backward pass.
        open: Whether another batch may be carried out in a faster way.
        fusable: Whether ``fuse=True`` would serve.
        program: The fused network.
    """

    way: str
    why: str = ""
    flat: tuple[bool, ...] = ()
    piece: int = 1 << 16
    again: bool = False
    open: bool = False
    fusable: bool = False
    program: Program | None = None


Outcome = tuple[Results, list[Tensor]]  # and gradients


class Trial:
    """A copy of a module and a few samples of a call, in cells of their own whose parameters differ.

    Neither the module nor the arguments nor their gradients are touched.
    """

    def __init__(self, call: Call, grouping: Grouping, dtype: torch.dtype | None = None) -> None:
        self.made_of, self.again, self.widest = (call, grouping), False, 1
        device = grouping.device
        picked = torch.arange(_TRIED, device=device) * call.layout.n // _TRIED
        cells = (torch.arange(_TRIED, device=device) * 7 % 5 // 2).int()
        self.entries = Grouping({"cells": cells}, _TRIED, _CELLS, device, grouping.backend, rows=picked)
        generator = torch.Generator().manual_seed(0)
        memo: dict[int, Any] = {id(p): _made_different(p, generator) for p in cell_parameters(call.module)}
        module = clone_module(call.module, memo).to(dtype)
        self._leaves: list[Tensor] = []

        def leaf(name: str, value: Any, nested: bool) -> Any:
            """An argument with a gradient of its own, where it takes one."""
            if not isinstance(value, Tensor):
                return value
            own = value.detach().to(dtype if value.is_floating_point() else None)
            if value.requires_grad and torch.is_grad_enabled():
                self._leaves.append(own.requires_grad_())
            return own

        args, kwargs = map_tree((call.args, call.kwargs), leaf)
        self.call = replace(call, module=module, args=args, kwargs=kwargs)

    def given(self) -> list[Tensor]:
        """The rows of the arguments, fresh for each run."""
        return self.call.arranged(self.entries)

    def outcome(self, way: Callable[[Trial, list[Tensor]], Results]) -> Outcome:
        """Results, and gradients of a weighted sum of them."""
        with NoRandomness():
            results = way(self, self.given())
        generator, total = torch.Generator().manual_seed(7), []
        for tensor in results.tensors:
            if tensor.requires_grad and tensor.is_floating_point():
                weights = torch.randn(tensor.shape, generator=generator).to(tensor)
                total.append((tensor * weights).sum().float())
        leaves = [t for t in (*self.call.module.parameters(), *self._leaves) if t.requires_grad]
        if not total or not torch.is_grad_enabled():
            return results, []
        torch.stack(total).sum().backward()
        gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in leaves]
        for leaf in leaves:
            leaf.grad = None
        return results, gradients

    def agrees(self, way: Callable[[Trial, list[Tensor]], Results], expected: Outcome) -> bool:
        """Whether a way gives what the loop gives; where it does not, whether it does in float64.

        A deep network of fast sines makes its own rounding as large as its results.
        """
        if _same(self.outcome(way), expected):
            return True
        try:
            exact = Trial(*self.made_of, dtype=torch.float64)
            exact.again = self.again
            return _same(exact.outcome(way), exact.outcome(Trial.by_cells))
        except Exception:
            return False

    def by_cells(self, given: list[Tensor]) -> Results:
        """The loop."""
        return run_cells(self.call, given, self.entries.occupied, again=self.again)

    def grouped(self, given: list[Tensor]) -> Results:
        """All cells at once."""
        results, self.widest = run_grouped(self.call, given, self.entries, _TRIED)
        return results

    def is_groupable(self) -> bool:
        """Whether the module runs for all cells at once on this batch, right or wrong."""
        try:
            with torch.no_grad(), NoRandomness():
                self.grouped(self.given())
        except Exception:
            return False
        return True

    def fused(self, expected: Outcome) -> tuple[Program | None, str]:
        """The network as one operation, or what stands in the way."""
        try:
            with NoRandomness():
                program = Program(self.made_of[0].module, self.call, [rows[:ROWS] for rows in self.given()])
            same = self.agrees(lambda t, rows: program.with_parameters_of(t.call.module).run(rows, t.entries), expected)
        except Unfusable as error:
            return None, str(error)
        except Exception as error:
            return None, f"the traced network fails for other samples ({type(error).__name__}: {error})"
        return (program, "") if same else (None, "the traced network gives other results than its forward")

    def check_rows(self) -> None:
        """Raises TypeError where results for samples change when others are left out."""
        halves = []
        for cell, first, last in self.entries.occupied:
            middle = (first + last) // 2
            halves += [(cell, first, middle), (cell, middle, last)]
        with NoRandomness():
            whole, apart = self.by_cells(self.given()), run_cells(self.call, self.given(), halves, again=self.again)
        if not all(agree(a, b) for a, b in zip(apart.tensors, whole.tensors, strict=True)):
            raise TypeError(
                f"{_OP}: module must treat samples one by one, but {type(self.call.module).__name__} gives other "
                "results for a sample when other samples are left out: it mixes samples (attention or statistics over "
                "a batch)"
            )


def _same(found: Outcome, expected: Outcome) -> bool:
    (a, ours), (b, theirs) = found, expected
    if a.rows != b.rows or len(ours) != len(theirs):
        return False
    return all(agree(x, y) for x, y in zip(a.tensors, b.tensors, strict=True)) and agree_gradients(ours, theirs)


@torch.no_grad()
def _made_different(parameter: Tensor, generator: torch.Generator) -> nn.Parameter:
    """Entries for the cells of a trial, [3, ...], each some way off the router's own."""
    cells = torch.arange(_CELLS, device=parameter.device) % parameter.shape[0]
    with torch.inference_mode(False):
        values = parameter.detach()[cells].clone()
        if values.is_floating_point() and values.numel():
            size = float(values.float().square().mean().sqrt()) or 0.1
            noise = torch.randn(values.shape, generator=generator)
            values += (0.2 * size * noise).to(values)
        return nn.Parameter(values, requires_grad=parameter.requires_grad)


def admitted(trial: Trial, fuse: bool) -> Choice:
    """The fastest way that gives what the loop gives; an error where the module has to fuse and does not."""
    for trial.again in (False, True):
        try:
            expected = trial.outcome(Trial.by_cells)
            break
        except Exception as error:  # perhaps its code runs again in the backward pass
            why = f"its forward fails on a few samples ({type(error).__name__}: {error})"
    else:
        return Choice("cell by cell", why)
    if fuse:
        program, why = trial.fused(expected)
        if program is not None:
            return Choice("fused", program=program)
        trial.check_rows()
        raise ValueError(
            f"{_OP}: fuse=True needs a network that a layer table describes, but in {trial.call.name} {why}"
        )
    choice = Choice("cell by cell", again=trial.again)
    try:
        if trial.agrees(Trial.grouped, expected):
            piece = min(max(_PIECE * _TRIED // trial.widest, 1 << 10), 1 << 16)
            return replace(choice, way="grouped", piece=piece, fusable=trial.fused(expected)[0] is not None)
        choice.why = "its forward on the samples of all cells gives other results than on those of one cell"
    except BackendUnavailable:
        raise
    except Ungroupable as error:
        choice.why, choice.open = str(error), error.of_batch
    except Exception as error:
        choice.why = f"its forward fails on the samples of all cells ({type(error).__name__}: {error})"
    trial.check_rows()
    return choice


# Rays -----------------------------------------------------------------------------------------------------------------


def flattened(call: Call) -> tuple[bool, ...]:
    """For each tensor that a call with rays returns, whether the module itself makes [rays * samples, ...] of it.

    The module runs on a few samples of two rays. It is refused if the samples of a ray meet in it, or if it gives other
    results for [n, 1, f] than for [rays, samples, f].
    """
    name, lead = type(call.module).__name__, call.layout.lead
    for samples in (6, lead[-1]):  # a module may be made for a number of samples
        few = (*[1] * (len(lead) - 2), min(lead[-2], 2), min(lead[-1], samples))
        try:
            whole, alone, other = _of_few(call, few)
        except Exception:
            continue
        for a, b in zip(whole, other, strict=True):
            if a.dim() > len(few) and a.shape[: len(few)] == few and not agree(b[..., 0, :], a[..., 0, :]):
                raise TypeError(
                    f"{_OP}: module must treat samples one by one, but {name} gives other results for a sample when "
                    "others along its ray change: it mixes the samples of a ray"
                )
        if len(whole) != len(alone) or not all(
            a.numel() == b.numel() and a.dtype == b.dtype and agree(b.flatten(), a.flatten())
            for a, b in zip(whole, alone)
        ):
            raise ValueError(
                f"{_OP}: module must give for [n, 1, f] what it gives for [rays, samples, f], but {name} does not; "
                "layout='flat' calls it with [n, f], for modules that squeeze or flatten their arguments"
            )
        return tuple(tuple(a.shape[: len(few)]) != few and a.shape[:1] == (math.prod(few),) for a in whole)
    return ()


def _of_few(call: Call, few: tuple[int, ...]) -> list[list[Tensor]]:
    """The tensors that the module's first cell returns for the first samples of the first rays.

    They are seen as rays, as the module would see them, and as rays with others behind the first sample of each.
    """
    found, others = [], []

    def first(tensor: Tensor, kind: str) -> Tensor:
        found.append(tensor.detach()[tuple(slice(size) for size in (few[:-1] if kind == RAY else few))])
        others.append(found[-1].clone())
        if kind != RAY and tensor.is_floating_point():
            others[-1][(slice(None),) * (len(few) - 1) + (slice(1, None),)].mul_(0.7).add_(0.01)
        return found[-1]

    args, kwargs = call.changed(first)
    small = replace(call, layout=replace(call.layout, lead=few), args=args, kwargs=kwargs)
    cell = {id(parameter): parameter.detach()[0] for parameter in cell_parameters(call.module)}
    with torch.no_grad(), NoRandomness(), in_place_of_parameters(call.module, cell):
        return [tensors_of(small.run(rows)) for rows in (found, small.arranged(None), others)]
