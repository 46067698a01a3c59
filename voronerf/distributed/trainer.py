"""The training loop on one of several ranks: they take the same steps, and each holds the networks of its own cells."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.data import Scene
from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.subdivision import Split
from voronerf.distributed.checkpoint import RankWriter, ownership
from voronerf.distributed.gradients import add_entries, pack_entries
from voronerf.distributed.group import Group
from voronerf.distributed.observing import observations, observe
from voronerf.distributed.renderer import Learnt, RankRenderer
from voronerf.distributed.sharing import Sharing, assign_cells
from voronerf.ops.select_heaviest import select_heaviest
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.router.grouping import cell_parameters
from voronerf.training.checkpoint import Checkpoint
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.divergence import all_finite
from voronerf.training.occupancy import OCCUPANCY_DECAY, revisit_cells
from voronerf.training.progress import Progress
from voronerf.training.rates import next_rays
from voronerf.training.trainer import Trainer


def check_ranks(config: TrainConfig, ranks: int) -> None:
    """Refuses what is not done over ranks.

    Raises:
        ConfigError: Names the setting.
    """
    rules = {
        "out": (config.out is not None, "be given: a run that is started again goes on there"),
        "sampling": (config.sampling == "stratified", "be stratified"),
        "field": (not config.field_type.cones, "take points, not cones"),
        "assignment": (config.assignment == "nearest", "be nearest"),
        "init": (config.init == "inherit", "be inherit"),
        "blend": (config.blend == 0, "be 0"),
        "distortion": (config.distortion == 0, "be 0"),
        "precision": (config.precision == "fp32", "be fp32"),
        "cuda_graph": (not config.cuda_graph, "be off"),
        "cells": (not config.cells or config.cells[0] >= ranks, f"be at least the {ranks} ranks on the first level"),
        "rays": (config.rays >= ranks, f"be at least the {ranks} ranks"),
    }
    for name, (fits, rule) in rules.items():
        if not fits:
            raise ConfigError(
                f"--{name.replace('_', '-')} must {rule} with several ranks, got {getattr(config, name)!r}"
            )


class RankTrainer(Trainer):
    """Trains one scene on all ranks of a group; each makes one, with the same settings.

    Until the first split the one network is data-parallel. From then on a rank holds the parameters, the moments of
    Adam, the averages and the occupancy of its own cells. Random numbers are the same on all ranks, so that samples are
    those of one process, and so are the parameters but for rounding. Time is that of rank 0, which writes the files.

    Args:
        config: As of a trainer.
        scene: As of a trainer.
        group: The ranks.
        on_step: Called on every rank.
        on_event: Called on every rank.

    Raises:
        ConfigError: For what is not done over ranks.
        CheckpointError: As of a trainer.
    """

    renderer_type = RankRenderer
    renderer: RankRenderer
    writer: RankWriter

    def __init__(
        self,
        config: TrainConfig,
        scene: Scene,
        group: Group,
        *,
        on_step: Callable[[Progress], None] | None = None,
        on_event: Callable[[str], None] | None = None,
    ) -> None:
        check_ranks(config, group.size)
        self.group, self.writes = group, group.rank == 0
        self.sharing: Sharing | None = None
        self.weights = torch.ones(1)
        self._agreed = self._told = self._measured = 0.0
        self._asked = False
        self._whole: list[nn.Parameter] = []
        self._tables: list[nn.Parameter] = []
        super().__init__(config, scene, on_step=on_step, on_event=on_event, clock=lambda: self._agreed)
        self.renderer.join(group)
        self.writer = RankWriter(self)
        self._parameters = list(self.router.parameters())
        self._find_shared()

    @property
    def diagram(self) -> VoronoiDiagram:
        """All cells of the run."""
        return self.router.diagram if self.sharing is None else self.sharing.diagram

    @property
    def parameter_count(self) -> int:
        """Parameters of all networks of all cells."""
        of_cells = sum(p.numel() for p in cell_parameters(self.router.module))
        everything = sum(p.numel() for p in self.router.parameters())
        return everything + of_cells // self.router.num_cells * (self.diagram.num_cells - self.router.num_cells)

    def request_stop(self) -> None:
        """Ends training on all ranks after the next step."""
        self._asked = True

    def _find_shared(self) -> None:
        """Finds the parameters that all ranks have: those that a step updates whole, and tables."""
        own = set() if self.sharing is None else set(map(id, cell_parameters(self.router.module)))
        groups = self.optimizer.param_groups
        shared = [([p for p in group["params"] if id(p) not in own], group.get("sparse")) for group in groups]
        self._whole = [p for parameters, sparse in shared for p in parameters if not sparse]
        self._tables = [p for parameters, sparse in shared for p in parameters if sparse]

    # --- a step ----------------------------------------------------------------------------------------------------

    def train_step(self) -> Tensor:
        """One step of all ranks."""
        started = time.perf_counter()
        loss = super().train_step()
        self._measured += time.perf_counter() - started
        return loss

    def split(self) -> None:
        """Splits the cells; children stay with the rank of their parent."""
        started = time.perf_counter()
        super().split()
        self._measured += time.perf_counter() - started

    def _revisit(self, grid: OccupancyGrid) -> None:
        revisit_cells(grid, self.renderer.revisited, self.generator, backend=self.config.backend)
        self.renderer.forget_others(grid)

    def _forward_backward(self) -> tuple[Tensor, Tensor | None, Tensor | None]:
        config, grid = self.config, self.occupancy
        batch = self.batches.draw(self.rays, self.draws, random_background=config.background == "random")
        self.optimizer.zero_grad(set_to_none=True)
        given: dict[str, Any] = {"background": batch.background, "generator": self.draws, "seen": batch.seen}
        found = self.renderer.learn(batch.rays, batch.near, batch.far, batch.target, **given)
        for parameter in self._parameters:
            if parameter.grad is None:  # no sample of this rank
                parameter.grad = torch.zeros_like(parameter)
        summed = self._begin_sum()
        collects = self.level < len(self.plan)
        kept = found.positions.new_zeros(self.reservoir.quota if collects else 0, 4)
        if collects:
            heaviest, importance = select_heaviest(found.positions, found.importance, len(kept))
            kept[: len(heaviest), :3], kept[: len(heaviest), 3] = heaviest, importance
        seen = kept.new_empty(0, 2) if grid is None else observations(grid, found, self.renderer.several)
        total, loss, kept, others = self._tell(found, kept, seen)
        if grid is not None:
            backend = "auto" if config.backend == "warp" else config.backend
            observe(grid, found, others, self.renderer.reached, decay=OCCUPANCY_DECAY, backend=backend)
        self.guard.judge(total, self.optimizer)
        summed()
        self.optimizer.step()
        return (loss, kept[:, :3], kept[:, 3]) if collects else (loss, None, None)

    def _begin_sum(self) -> Callable[[], None]:
        """Begins to add up the gradients of what all ranks have but tables; what it returns waits for the end."""
        if not self._whole:
            return lambda: None
        flat = torch.cat([p.grad.reshape(-1) for p in self._whole if p.grad is not None])
        wait = self.group.begin_total(flat)

        def end() -> None:
            wait()
            _set_gradients(self._whole, flat)

        return end

    def _tell(self, found: Learnt, kept: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Tells all ranks what each has to say in a step: they add up the tables' gradients, and agree on the rest.

        That is the loss, the time, a stop, a checkpoint and the rays of the next step.

        Args:
            found: By this rank.
            kept: [n, 4], the heaviest samples, as many on all ranks.
            seen: [c, 2], see :func:`voronerf.distributed.observing.observations`.

        Returns:
            The sum of the loss and of all gradients that the guard reads; the loss; what all ranks have kept; and what
            the others have seen.
        """
        dense = [p for group in self.optimizer.param_groups if not group.get("sparse") for p in group["params"]]
        passed = (self._measured - self._told) * (self.group.rank == 0)
        self._told = self._measured
        samples = len(found.positions)
        news = kept.new_tensor((len(seen), passed, float(self._asked), float(self.writer.ready), samples, 0, 0))
        news[5] = found.loss
        news[6] = found.loss + sum(p.grad.sum() for p in dense if p.grad is not None)
        gradients = [p.grad.reshape(-1) for p in self._tables if p.grad is not None]
        flat = torch.cat(gradients) if len(gradients) > 1 else gradients[0] if gradients else news[:0]
        message = torch.cat((news, kept.view(-1), seen.view(-1), pack_entries(flat)))
        parts = [part[:, 0] for part in self.group.share("news", message[:, None])]
        said = torch.stack([part[:7] for part in parts])
        first = 7 + 4 * len(kept)
        ends = (first + 2 * said[:, 0]).int().tolist()
        if len(flat):
            entries = [part[end:] for part, end in zip(parts, ends, strict=True)]
            _set_gradients(self._tables, add_entries(entries, len(flat)))
        total = said.sum(0)
        _, passed, asked, ready, samples, *_ = total.tolist()
        self._agreed += passed
        self.stopped |= asked > 0
        if ready == self.group.size:
            self.writer.commit()
        if self.occupancy is not None:
            self.rays = next_rays(self.config, self.rays, int(samples))
        kept = torch.cat([part[7:first] for part in parts]).view(-1, 4)
        others = [
            part[first:end] for i, (part, end) in enumerate(zip(parts, ends, strict=True)) if i != self.group.rank
        ]
        return total[6], total[5], kept, torch.cat(others).view(-1, 2)

    def _check_moments(self) -> bool:
        finite = bool(self.group.largest(torch.tensor(float(not all_finite(self.optimizer)), device=self.device)) == 0)
        if not finite:
            self._go_back("parameters or moments of Adam not finite")
        return finite

    # --- cells -----------------------------------------------------------------------------------------------------

    def find_split(self, k: int, points: Tensor, importance: Tensor) -> Split | None:
        """As of a trainer; found by rank 0, for machines may round in other ways."""
        split = super().find_split(k, points, importance) if self.group.rank == 0 else None
        split, state = self.group.from_first((split, self.generator.get_state()))
        self.generator.set_state(state)
        if split is not None:
            self.weights = self._loads(split.diagram)
        found: Split | None = split
        return found

    def _loads(self, diagram: VoronoiDiagram) -> Tensor:
        """How many samples of a step each cell has, [k]: what its networks cost.

        They are of a batch drawn for this alone, so that the same is found again after a restart.
        """
        generator = torch.Generator(self.draws.device).manual_seed(self.step)
        batch = self.batches.draw(self.rays, generator)
        samples = self.renderer.samples_of(batch.rays, batch.near, batch.far, jitter=True, generator=generator)
        cells = diagram.locate(samples.positions, backend=self.config.backend)
        return self.group.total(torch.bincount(cells, minlength=diagram.num_cells).float()).cpu()

    def divide(self, split: Split) -> None:
        """Takes the own cells of a split."""
        before = torch.zeros(1, dtype=torch.int64)
        if self.sharing is None:
            owner = assign_cells(split.diagram.leaf_centres, self.weights, self.group.size)
            sharing = Sharing(split.diagram, owner.to(self.device))
        else:
            before = self.sharing.cells(self.group.rank).cpu()
            sharing = self.sharing.refined(split.diagram, split.parents)
        cells = sharing.cells(self.group.rank).cpu()
        parents = torch.searchsorted(before, split.parents.cpu()[cells])
        self.router.subdivide(sharing.diagram.part(cells), parents, optimizer=self.optimizer)
        self._own(sharing)

    def _own(self, sharing: Sharing) -> None:
        self.sharing = sharing
        self.renderer.join(self.group)
        self.renderer.own_cells(sharing)
        self._find_shared()

    def _resume(self, checkpoint: Checkpoint) -> None:
        self.sharing = self.renderer.sharing = self.renderer.reached = self.renderer.several = None
        super()._resume(checkpoint)
        self._find_shared()
        whole = self.router.diagram
        if whole.num_cells == 1:
            return
        owner, self.weights = ownership(checkpoint, whole, self.group.size)
        sharing = Sharing(whole, owner.to(self.device))
        cells = sharing.cells(self.group.rank).cpu()
        self.router.subdivide(whole.part(cells), cells, optimizer=self.optimizer)
        self._own(sharing)


def _set_gradients(parameters: list[nn.Parameter], flat: Tensor) -> None:
    for parameter, part in zip(parameters, flat.split([p.numel() for p in parameters]), strict=True):
        parameter.grad = part.view_as(parameter)
