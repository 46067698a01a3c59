"""A router over ranks: each has the networks of its own cells, and samples travel to the rank of their cell and back.

All ranks have the whole diagram, so the rank of a sample knows its cell. A call sorts samples by cell and says to each
rank how many its cells get; then the rows of all arguments travel in one message to each rank. Results come back the
same way, and so do gradients.

n samples of this rank, m samples that it evaluates, k cells.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import torch
import torch.distributed as dist
from torch import Tensor

from voronerf.compiler import not_compiled
from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.blending import Mixture
from voronerf.router.cells import CellModules, Finer
from voronerf.router.evaluate import Choices, carry_out, check_rays, choose, evaluate, kind_of
from voronerf.router.exchange import Shards, deal_cells
from voronerf.router.fused import LayeredField, run_table
from voronerf.router.grouping import Grouping, cell_parameters
from voronerf.router.layout import RAY, SAMPLE, SHARED, Call, Results, tensors_of
from voronerf.router.optimizers import check_optimizer

_STORED = "cells_of_rank"  # in the state of a router that has some of the cells


# Calls ----------------------------------------------------------------------------------------------------------------


def evaluate_over_ranks(
    shards: Shards | None, call: Call, grouping: Grouping, mixture: Mixture | None, choices: Choices, fuse: bool
) -> Any:
    """What :func:`voronerf.router.evaluate.evaluate` gives, with the networks on the ranks of their cells."""
    if shards is None:
        return evaluate(call, grouping, mixture, choices, fuse=fuse)
    layout, kind = call.layout, kind_of(call, grouping.device, fuse)
    if len(layout.lead) > 1 and layout.lead[-1] > 1 and layout.n and not layout.flat and kind not in choices.checked:
        with torch.random.fork_rng([grouping.device] if grouping.device.type == "cuda" else []):
            check_rays(call)  # here, since the ranks that evaluate samples do not see their rays
        choices.checked.add(kind)
    entries = _entries(grouping, mixture)
    results = _carried_out(shards, call, entries, choices, fuse)
    if mixture is None:
        return results.restored(layout, entries)
    n, rows = grouping.n, [entries.unsort(tensor) for tensor in results.tensors]
    results.tensors = [mixture.mix(tensor[:n], tensor[n:]) for tensor in rows]
    return results.restored(layout, None)


def _entries(grouping: Grouping, mixture: Mixture | None) -> Grouping:
    """The samples in their own cells and behind them those of a mixture, which make one trip."""
    if mixture is None:
        return grouping
    assert grouping.cells is not None
    rows = torch.arange(grouping.n, device=mixture.rows.device)
    return grouping.of_entries(torch.cat([rows, mixture.rows]), torch.cat([grouping.cells, mixture.cells]))


def _carried_out(shards: Shards, call: Call, grouping: Grouping, choices: Choices, fuse: bool) -> Results:
    """Results sorted by cell, of the networks of all ranks."""
    rows, given = call.arranged(grouping), (*call.args, *call.kwargs.values())
    same: list[Any] = [value for value in given if isinstance(value, (bool, int, float, str))]
    changed = tensors_of(call.changed(lambda tensor, kind: tensor.view_as(tensor)))
    same += [tensor for tensor, other in zip(tensors_of(given), changed, strict=True) if tensor is other]
    trip = shards.plan(grouping.offsets, rows, call.method, call.module.training, *same)
    came, m, k = iter(trip.send(rows)), len(trip.cells), shards.own.stop - shards.own.start

    # A ray of one sample is what the module sees of each sample in any case.
    lead = (m, *[1] * (0 if call.layout.flat else len(call.layout.lead) - 1))
    per_ray = RAY if not call.layout.flat else SAMPLE
    args, kwargs = call.changed(lambda tensor, kind: next(came))
    kinds = {name: kind if kind == SHARED else per_ray if kind == RAY else SAMPLE for name, kind in call.kinds.items()}
    own = replace(call, layout=replace(call.layout, lead=lead), args=args, kwargs=kwargs, kinds=kinds)

    placed = trip.cells if m else torch.zeros(2, dtype=torch.int32, device=grouping.device)  # placeholders
    where = {"cells": placed} if k > 1 else {}
    cells = Grouping(where, len(placed), k, grouping.device, grouping.backend)
    results, choice = carry_out(own, cells, choices, choose(own, cells, choices, fuse))
    tensors = results.tensors
    if choice.program is None or not m:
        tensors = [cells.unsort(tensor)[:m] for tensor in tensors]
    return Results(results.value, trip.give_back(tensors))


# Cells ----------------------------------------------------------------------------------------------------------------


class ShardedCells(CellModules):
    """Cells that can be shared out between ranks."""

    _shards: Shards | None = None

    @property
    def own_cells(self) -> range:
        """The cells whose parameters this process has: all of them, or those of its rank."""
        own = slice(0, self.num_cells) if self._shards is None else self._shards.own
        return range(own.start, own.stop)

    @torch.no_grad()
    def shard(
        self,
        process_group: Any = None,
        *,
        weights: Tensor | None = None,
        optimizer: torch.optim.Optimizer | None = None,
    ) -> None:
        """Shares the cells out between the ranks of a process group. Afterwards each has the parameters of its own.

        Every rank calls the router with its own samples, any number of them. A sample, with all that is per sample or
        per ray, travels to the rank of its cell; results come back, and so do gradients. So all ranks make the same
        calls in the same order, ``backward`` too. The gradient of a cell's parameters is that of the sum of the losses
        of all ranks. Parameters that all cells share (``share=``) stay on every rank: :meth:`sum_gradients` sums their
        gradients before a step of the optimiser.

        As in ``DistributedDataParallel``, all ranks begin with the values of rank 0. Arguments that are the same for
        all samples must be the same on all ranks. Called again, the method deals the cells anew.

        Args:
            process_group: Of ``torch.distributed``; None for all processes.
            weights: [k], the importance of the cells. Each rank gets neighbours in the order of the cells that are
                about equally important together, or as many cells as another for None.
            optimizer: The optimiser that holds this router's parameters. It keeps the state of this rank's cells.

        Raises:
            RuntimeError: If ``torch.distributed`` is not initialised.
            ValueError: For more ranks than cells, for wrong weights, or where ranks have other diagrams, modules or
                weights.

        Examples:
            >>> import torch, torch.distributed as dist
            >>> from voronerf import VoronoiRouter
            >>> dist.init_process_group("gloo", store=dist.HashStore(), rank=0, world_size=1)  # torchrun does it
            >>> router = VoronoiRouter(torch.nn.Linear(3, 2), torch.randn(4, 3), coords="first3")
            >>> router.shard()
            >>> router(torch.randn(10, 3)).shape, router.own_cells
            (torch.Size([10, 2]), range(0, 4))
            >>> dist.destroy_process_group()
        """
        if not dist.is_available() or not dist.is_initialized():
            raise RuntimeError(
                "VoronoiRouter.shard: torch.distributed must be initialised; start the script by torchrun, and call "
                "torch.distributed.init_process_group() in it"
            )
        k, ranks = self.num_cells, dist.get_world_size(process_group)
        if ranks > k:
            raise ValueError(
                f"VoronoiRouter.shard: process_group must have at most {k} ranks, one for each cell, got {ranks}"
            )
        if weights is None:
            weights = torch.ones(k)
        if weights.shape != (k,) or not (weights.isfinite() & (weights >= 0)).all():
            got = list(weights.shape) if weights.shape != (k,) else f"{weights.min()} to {weights.max()}"
            raise ValueError(f"VoronoiRouter.shard: weights must be [{k}], finite and at least 0, got {got}")
        check_optimizer(optimizer, self.module, "shard")
        shards, every = Shards(process_group, deal_cells(weights, ranks)), torch.arange(k)
        shards.check_same("shard: diagram", k, *self.diagram.state_dict().values())
        shards.check_same("shard: module", [(name, tuple(p.shape[1:])) for name, p in self.module.named_parameters()])
        shards.check_same("shard: weights", shards.bounds)
        present, own = self._shards, shards.own
        if present is None:
            for tensor in (*self.module.parameters(), *self.module.buffers()):
                dist.broadcast(tensor.detach(), group=process_group, group_src=0)

        def take(stacked: Tensor) -> Tensor:
            return stacked[own].clone() if present is None else present.take(stacked, every, shards.bounds)

        self._become(Finer(self.diagram, every, take, own, shards), optimizer, every < 0)
        if optimizer is None:
            self._watch_optimizers("router.shard(optimizer=optimizer)")

    def sum_gradients(self) -> None:
        """Sums the gradients of parameters that all cells share over the ranks, before a step of the optimiser.

        Every rank calls it, after ``backward``. A router that is not sharded is left alone.
        """
        own = {id(parameter) for parameter in cell_parameters(self.module)}
        if self._shards is None:
            return
        for parameter in self.module.parameters():
            if id(parameter) not in own and parameter.requires_grad:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                dist.all_reduce(parameter.grad, group=self._shards.group)

    # States -----------------------------------------------------------------------------------------------------------

    def gather_state_dict(self) -> dict[str, Any]:
        """The state of all cells on rank 0, as the ``state_dict()`` of a router that is not sharded; empty elsewhere.

        Every rank calls it. Any router loads it: one that is not sharded, or over any number of ranks.
        """
        state = dict(self.state_dict())
        if self._shards is None:
            return state
        state.pop(_STORED)
        for name in self._names():
            state[name] = self._shards.join(state[name])
        return state if self._shards.rank == 0 else {}

    def gather_optimizer_state_dict(self, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
        """The ``state_dict()`` of an optimiser for all cells on rank 0; empty elsewhere. Every rank calls it.

        The optimiser of a router that is not sharded loads it; ``shard(optimizer=optimizer)`` keeps what is a rank's.
        """
        check_optimizer(optimizer, self.module, "gather_optimizer_state_dict")
        state, shards = optimizer.state_dict(), self._shards
        if shards is None:
            return state
        own = {id(parameter) for parameter in cell_parameters(self.module)}
        held = enumerate(parameter for group in optimizer.param_groups for parameter in group["params"])
        for number, parameter in held:
            values = state["state"].get(number, {}) if id(parameter) in own else {}
            stacked = {key: v for key, v in values.items() if isinstance(v, Tensor) and v.shape == parameter.shape}
            if stacked:
                state["state"][number] = {**values, **{key: shards.join(value) for key, value in stacked.items()}}
        return state if shards.rank == 0 else {}

    def _names(self) -> list[str]:
        """Those of the state's tensors that have an entry for each cell."""
        own = {id(parameter) for parameter in cell_parameters(self.module)}
        named = self.module.named_parameters(prefix="module", remove_duplicate=False)
        return [name for name, parameter in named if id(parameter) in own]

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if self._shards is not None:
            own = self._shards.own
            destination[f"{prefix}{_STORED}"] = torch.tensor([own.start, own.stop, self.num_cells])

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Takes this rank's cells of a whole state, or the state that this rank has stored."""
        stored, own = state_dict.pop(f"{prefix}{_STORED}", None), self.own_cells
        if stored is not None and stored.tolist() != [own.start, own.stop, self.num_cells]:
            first, stop, k = stored.tolist()
            raise ValueError(
                "VoronoiRouter.load_state_dict: state_dict must be whole, as gather_state_dict() gives it, or of cells "
                f"{own.start} to {own.stop - 1} of {self.num_cells}, got cells {first} to {stop - 1} of {k}"
            )
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        if self._shards is not None and stored is None:
            for name in self._names():
                if f"{prefix}{name}" in state_dict:
                    state_dict[f"{prefix}{name}"] = state_dict[f"{prefix}{name}"][self._shards.own]

    # Hooks of the router ----------------------------------------------------------------------------------------------

    def _check_index(self, method: str, index: int) -> int:
        index = super()._check_index(method, index)
        if self._shards is None:
            return index
        index, shards = index % self.num_cells, self._shards
        if index not in self.own_cells:
            raise IndexError(
                f"VoronoiRouter.{method}: index must be of {shards.cells_text(shards.rank)}, which rank {shards.rank} "
                f"has, got {index}, which rank {int(shards.owners[index])} has"
            )
        return index - self.own_cells.start

    def _finer(self, diagram: Any, parents: Any, points: Any, weights: Any, split: dict[str, Any]) -> Finer:
        """As of a router that is not sharded, with the samples of all ranks; rank 0 splits, and deals the cells."""
        shards = self._shards
        if shards is None:
            return super()._finer(diagram, parents, points, weights, split)
        given, found = shards.gather((points, weights)), cast(Any, None)
        try:
            if shards.rank == 0:
                if not isinstance(diagram, VoronoiDiagram) and all(p is not None and w is not None for p, w in given):
                    device = self.diagram.centres.device
                    points, weights = (torch.cat([one.to(device) for one in every]) for every in zip(*given))
                finer = super()._finer(diagram, parents, points, weights, split)
                cells = torch.arange(finer.diagram.num_cells) if points is None else finer.diagram.locate(points).cpu()
                importance = torch.ones(len(cells)) if weights is None else weights.cpu()
                loads = importance.new_zeros(finer.diagram.num_cells).index_add_(0, cells.long(), importance)
                if len(loads) < shards.size:
                    raise ValueError(
                        f"VoronoiRouter.subdivide: diagram must have at least {shards.size} cells, one for each rank, "
                        f"got {len(loads)}"
                    )
                tables = {name: table.cpu() for name, table in finer.diagram.state_dict().items()}
                found = tables, finer.parents.cpu(), deal_cells(loads, shards.size)
        except (TypeError, ValueError) as error:
            found = error
        found = shards.from_first(found)
        if isinstance(found, Exception):
            raise found
        state, parents, bounds = found
        after = replace(shards, bounds=bounds)
        return Finer(
            VoronoiDiagram.from_state(state),
            parents,
            lambda stacked: shards.take(stacked, parents, bounds),
            after.own,
            after,
        )

    def _become(self, finer: Finer, *args: Any) -> None:
        super()._become(finer, *args)
        self._shards = finer.shards if finer.shards is not None else self._shards

    def _explain_shards(self) -> str:
        shards = self._shards
        if shards is None:
            return ""
        cells = f"{shards.cells_text(shards.rank)} of {self.num_cells}"
        return f"\nsharded: rank {shards.rank} of {shards.size} has {cells}"

    @not_compiled
    def _run_over_ranks(
        self,
        raw: bool,
        mixture: Mixture | None,
        where: dict[str, Tensor],
        positions: Tensor,
        directions: Tensor | None,
        ray_index: Tensor | None,
    ) -> Any:
        """What a field with a layer table gives for samples whose networks are on the ranks of their cells."""
        shards, n, field = self._shards, len(positions), cast(LayeredField, self.module)
        assert shards is not None
        if directions is not None and ray_index is not None:
            directions = directions.index_select(0, ray_index)
        entries = _entries(Grouping(where, n, self.num_cells, positions.device, self.backend), mixture)
        rows = [entries.sort(tensor) for tensor in (positions, directions) if tensor is not None]
        trip = shards.plan(entries.offsets, rows, "table", self.training)
        came, k = trip.send(rows), len(self.own_cells)
        own = {"cells": trip.cells} if k > 1 else {}
        found = run_table(field, k, self.backend, came[0], came[1] if len(came) > 1 else None, None, own)
        outputs = entries.unsort(trip.give_back([found])[0])
        if raw:
            return outputs
        colour, density = field.activate(outputs)
        if mixture is None:
            return colour, density
        return mixture.mix(colour[:n], colour[n:]), mixture.mix(density[:n], density[n:])
