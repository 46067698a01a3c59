"""Finding the fastest way to run a kind of call that gives what the loop over cells gives.

The ways run once on a few samples of the batch, in a copy of the module whose cells have parameters of their own, and
their results and gradients are compared with the loop's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.backends import BackendUnavailable
from voronerf.router.fused import Program
from voronerf.router.grouped import Ungroupable
from voronerf.router.grouping import Entries, Grouping
from voronerf.router.layout import RAY, SHARED, Call, Given
from voronerf.router.loop import NoRandomness, Results, check_rows, run_cells, run_part
from voronerf.router.parameters import cell_parameters, clone_module, in_place_of_parameters, owned_parameters
from voronerf.router.tracing import ROWS, Unfusable
from voronerf.router.trees import map_tree, tensors_of
from voronerf.tolerances import agree, agree_gradients

_OP = "VoronoiRouter"
_TRIED, _CELLS = 41, 3  # samples of a comparison, unlike any number of features, and their cells
_PIECE = 4 << 20  # bytes of the largest tensor of a piece of rows on a CPU; larger ones are fetched from memory


@dataclass
class Choice:
    """How calls of a kind are carried out.

    Attributes:
        way: "fused", "grouped" or "cell by cell".
        why: What stands in the way of a faster one; empty where nothing does.
        flat: For the tensors of a result, whether the module itself flattens them to [rays * samples, ...].
        piece: Rows that a grouped module runs on at once on a CPU.
        most: Samples a cell up to which the grouped way is the faster one.
        again: Whether the module's code runs again in the backward pass.
        open: Whether another batch may be carried out in a faster way.
        fusable: Whether ``fuse=True`` would serve.
        program: The fused network.
    """

    way: str
    why: str = ""
    flat: tuple[bool, ...] = ()
    piece: int = 1 << 16
    most: float = math.inf
    again: bool = False
    open: bool = False
    fusable: bool = False
    program: Program | None = None


def admitted(trial: Trial, fuse: bool) -> Choice:
    """The fastest way that gives what the loop gives."""
    again = False
    try:
        try:
            expected = trial.outcome(trial.by_cells)
        except Exception:  # perhaps its code runs again in the backward pass
            again = trial.again = True
            expected = trial.outcome(trial.by_cells)
    except Exception as error:
        return Choice("cell by cell", f"its forward fails on a few samples ({type(error).__name__}: {error})")
    if fuse:
        program, why = None, ""
        try:
            program = traced = trial.traced()
            if not trial.agrees(lambda one: one.fused(traced), expected):
                why = "the traced network gives other results than its forward"
        except Unfusable as error:
            why = str(error)
        except Exception as error:
            why = f"the traced network fails for other samples ({type(error).__name__}: {error})"
        if why:
            trial.check_rows()
            raise ValueError(
                f"{_OP}: fuse=True needs a network that a layer table describes, but in {trial.call.name} {why}"
            )
        return Choice("fused", program=program)
    why, open_ = "", False
    try:
        if trial.agrees(lambda one: one.grouped, expected):
            piece = min(max(_PIECE * _TRIED // trial.widest, 1 << 10), 1 << 16)
            return Choice("grouped", piece=piece, most=trial.most, again=again, fusable=trial.is_fusable(expected))
        why = "its forward on the samples of all cells gives other results than on those of one cell"
    except BackendUnavailable:
        raise
    except Ungroupable as error:
        why, open_ = str(error), error.of_batch
    except Exception as error:
        why = f"its forward fails on the samples of all cells ({type(error).__name__}: {error})"
    trial.check_rows()
    return Choice("cell by cell", why, again=again, open=open_)


Run = Callable[[Given], Results]


class Trial:
    """A copy of a module and a few samples of a call, in cells of their own whose parameters differ.

    Neither the module nor the arguments nor their gradients are touched.
    """

    def __init__(self, call: Call, grouping: Grouping, dtype: torch.dtype | None = None) -> None:
        self.made_of, self.dtype, self.again = (call, grouping), dtype, False
        device = grouping.device
        picked = torch.arange(_TRIED, device=device) * call.layout.n // _TRIED
        cells = (torch.arange(_TRIED, device=device) * 7 % 5 // 2).int()
        self.entries = Entries(picked, cells, _CELLS, grouping.backend)
        self.widest, self.most = 0, math.inf
        generator = torch.Generator().manual_seed(0)
        memo: dict[int, Any] = {}
        for _, _, parameter in cell_parameters(call.module):
            if id(parameter) not in memo:
                memo[id(parameter)] = _made_different(parameter, generator)
        module = clone_module(call.module, memo).to(dtype)
        self._leaves: list[Tensor] = []
        args, kwargs = map_tree((call.args, call.kwargs), self._leaf)
        self.call = replace(call, module=module, args=args, kwargs=kwargs)

    def _leaf(self, name: str, tensor: Tensor, nested: bool) -> Tensor:
        """An argument with a gradient of its own, where it takes one."""
        leaf = tensor.detach().to(self.dtype if tensor.is_floating_point() else None)
        if tensor.requires_grad and torch.is_grad_enabled():
            self._leaves.append(leaf.requires_grad_())
        return leaf

    def given(self) -> Given:
        """The arguments, fresh for each run."""
        return self.call.arranged(self.entries)

    def outcome(self, run: Run) -> tuple[Results, list[Tensor]]:
        """Results, and gradients of a weighted sum of them."""
        with NoRandomness():
            results = run(self.given())
        generator, total = torch.Generator().manual_seed(7), []
        for tensor in results.tensors:
            if tensor.requires_grad and tensor.is_floating_point():
                weights = torch.randn(tensor.shape, generator=generator).to(tensor)
                total.append((tensor * weights).sum().float())
        leaves = [t for t in (*self.call.module.parameters(), *self._leaves) if t.requires_grad]
        gradients: list[Tensor] = []
        if total and torch.is_grad_enabled():
            torch.stack(total).sum().backward()
            gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in leaves]
            for leaf in leaves:
                leaf.grad = None
        return results, gradients

    def same(self, found: tuple[Results, list[Tensor]], expected: tuple[Results, list[Tensor]]) -> bool:
        """Whether two ways gave the same."""
        (a, ours), (b, theirs) = found, expected
        if (a.rows, a.flattened, len(ours)) != (b.rows, b.flattened, len(theirs)):
            return False
        pairs = zip(a.tensors, b.tensors, strict=True)
        return all(agree(x, y) for x, y in pairs) and agree_gradients(ours, theirs)

    def agrees(self, way: Callable[[Trial], Run], expected: tuple[Results, list[Tensor]]) -> bool:
        """Whether a way gives what the loop gives; where it does not, whether it does in float64.

        A deep network of fast sines makes its own rounding as large as its results.
        """
        if self.same(self.outcome(way(self)), expected):
            return True
        try:
            exact = Trial(*self.made_of, dtype=torch.float64)
            exact.again = self.again
            return exact.same(exact.outcome(way(exact)), exact.outcome(exact.by_cells))
        except Exception:
            return False

    def by_cells(self, given: Given) -> Results:
        """The loop."""
        return run_cells(self.call, given, self.entries, again=self.again)

    def grouped(self, given: Given) -> Results:
        """All cells at once."""
        results, run = run_part(self.call, given, self.entries)
        self.most = run.most
        self.widest = max(run.widest, *[t.numel() * t.element_size() for t in given.rows], 1)
        return results

    def fused(self, program: Program) -> Run:
        """As one operation, with the parameters of the copy."""
        here = program.with_parameters_of(self.call.module)
        return lambda given: here.run(given.rows, self.entries)

    def is_groupable(self) -> bool:
        """Whether the module runs for all cells at once on this batch, right or wrong."""
        try:
            with torch.no_grad(), NoRandomness():
                self.grouped(self.given())
        except Exception:
            return False
        return True

    def traced(self) -> Program:
        """The network as a layer table."""
        if self.call.layout.axis:
            raise Unfusable("the module sees one ray, [1, samples, f]; layout='flat' gives it [samples, f]")
        module = self.made_of[0].module
        with NoRandomness():
            try:
                return Program(module, self.call, self.given().part(0, ROWS, 0))
            except Unfusable as error:
                if len(cell_parameters(module)) == len(owned_parameters(module)):
                    raise
                try:  # layers that all cells share may be part of an encoding
                    return Program(module, self.call, self.given().part(0, ROWS, 0), shared_layers=False)
                except Unfusable:
                    raise error from None

    def is_fusable(self, expected: tuple[Results, list[Tensor]]) -> bool:
        """Whether ``fuse=True`` would serve."""
        try:
            program = self.traced()
            return self.agrees(lambda one: one.fused(program), expected)
        except Exception:
            return False

    def check_rows(self) -> None:
        """Raises TypeError where the module mixes samples."""
        with NoRandomness():
            check_rows(self.call, self.given(), self.entries, self.again)


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


# Rays -----------------------------------------------------------------------------------------------------------------


def flattened(call: Call, device: torch.device) -> tuple[bool, ...]:
    """For each tensor that a call with rays returns, whether the module itself makes [rays * samples, ...] of it.

    The module runs on a few samples of two rays, as rays and as it would see them.

    Raises:
        TypeError: When the samples of a ray meet in the module.
        ValueError: When the module gives other results for [n, 1, f] than for [rays, samples, f].
    """
    *outer, rays, along = call.layout.lead
    name = type(call.module).__name__
    for samples in (6, along):  # a module may be made for a number of samples
        lead = (*[1] * len(outer), min(rays, 2), min(along, samples))
        n = lead[-1] * lead[-2]
        picked = torch.arange(lead[-2], device=device)[:, None] * along + torch.arange(lead[-1], device=device)
        one = Entries(picked.flatten(), picked.new_zeros(n, dtype=torch.int32), 1, "auto")
        try:
            whole = _in_first(call, _on_rays(call, lead, picked))
            alone = _in_first(call, call.arranged(one))
            changed = _in_first(call, _on_rays(call, lead, picked, change=True))
        except Exception:
            continue
        for a, b in zip(whole, changed, strict=True):
            if a.dim() > len(lead) and a.shape[: len(lead)] == lead and not agree(b[..., 0, :], a[..., 0, :]):
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
        return tuple(tuple(a.shape[: len(lead)]) != lead and a.shape[:1] == (n,) for a in whole)
    return ()


def _on_rays(call: Call, lead: tuple[int, ...], picked: Tensor, change: bool = False) -> Given:
    """The arguments for [rays, samples] samples alone; ``change`` alters all but the first sample of each ray."""
    layout = call.layout

    def pick(name: str, value: Any, nested: bool) -> Any:
        if not isinstance(value, Tensor):
            shape = tuple(value.shape)
            if shape not in (layout.lead, layout.lead[:-1]):
                return value
            some = picked if shape == layout.lead else picked[:, 0] // layout.lead[-1]
            return value.flatten()[some.flatten()].reshape(lead[: len(shape)])
        kind = layout.kind(name, value, nested)
        if kind == SHARED:
            return value
        some = picked[:, 0] // layout.lead[-1] if kind == RAY else picked
        found = layout.flatten(value.detach(), kind)[some]
        if change and kind != RAY and found.is_floating_point():
            found = torch.cat([found[:, :1], found[:, 1:] * 0.7 + 0.01], 1)
        return found.reshape(*lead[: len(lead) - (kind == RAY)], *found.shape[some.dim() :])

    return call.changed(pick)


def _in_first(call: Call, given: Given) -> list[Tensor]:
    """The tensors that the module returns with the parameters of its first cell."""
    first = {id(parameter): parameter.detach()[0] for _, _, parameter in cell_parameters(call.module)}
    with torch.no_grad(), NoRandomness(), in_place_of_parameters(call.module, first):
        return tensors_of(call.run(given))
