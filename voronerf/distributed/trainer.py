"""The training loop on one of several ranks: they take the same steps, and each holds the networks of its own cells."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor, nn

from voronerf.data import Scene
from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.balance import cell_weights
from voronerf.diagram.subdivision import Split
from voronerf.distributed.checkpoint import RankWriter, ownership
from voronerf.distributed.group import Group
from voronerf.distributed.renderer import RankRenderer
from voronerf.distributed.sharing import Sharing, assign_cells
from voronerf.ops.select_heaviest import select_heaviest
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.router.grouping import cell_parameters
from voronerf.training.checkpoint import Checkpoint
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.divergence import all_finite
from voronerf.training.occupancy import OCCUPANCY_DECAY, revisit_cells
from voronerf.training.progress import Progress
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
        super().__init__(config, scene, on_step=on_step, on_event=on_event, clock=lambda: self._agreed)
        self.renderer.join(group)
        self.writer = RankWriter(self)

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

    def _shared(self) -> list[nn.Parameter]:
        """The parameters that all ranks have."""
        every = list(self.router.parameters())
        if self.sharing is None:
            return every
        own = {id(parameter) for parameter in cell_parameters(self.router.module)}
        return [parameter for parameter in every if id(parameter) not in own]

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
        config = self.config
        batch = self.batches.draw(config.rays, self.draws, random_background=config.background == "random")
        self.optimizer.zero_grad(set_to_none=True)
        found = self.renderer.learn(
            batch.rays, batch.near, batch.far, batch.target, background=batch.background, generator=self.draws
        )
        if self.occupancy is not None:
            backend = "auto" if config.backend == "warp" else config.backend
            self.renderer.observe(self.occupancy, found, decay=OCCUPANCY_DECAY, backend=backend)
        loss = self._add_up(found.loss)
        self.optimizer.step()
        if self.level >= len(self.plan):
            return loss, None, None
        quota = self.reservoir.quota
        heaviest, importance = select_heaviest(found.positions, found.importance, quota)
        kept = heaviest.new_zeros(quota, 4)
        kept[: len(heaviest), :3], kept[: len(heaviest), 3] = heaviest, importance
        kept = self.group.share("samples", kept)
        return loss, kept[:, :3], kept[:, 3]

    def _add_up(self, loss: Tensor) -> Tensor:
        """Sums the loss and the gradients of what all ranks have; agrees on the time, on a stop and on a bad step."""
        for parameter in self.router.parameters():
            if parameter.grad is None:  # no sample of this rank
                parameter.grad = torch.zeros_like(parameter)
        shared = self._shared()
        ids = {id(parameter) for parameter in shared}
        dense = [p for g in self.optimizer.param_groups if not g.get("sparse") for p in g["params"]]
        own = torch.stack([loss, *(p.grad.sum() for p in dense if id(p) not in ids)]).sum()
        passed = (self._measured - self._told) * (self.group.rank == 0)
        self._told = self._measured
        agreed = own.new_tensor((passed, float(self._asked), float(self.writer.ready)))
        news = torch.cat((torch.stack((loss, own)), agreed))
        gradients = [p.grad for p in shared if p.grad is not None]
        flat = self.group.total(torch.cat([news, *(gradient.reshape(-1) for gradient in gradients)]))
        rest = flat[5:]
        for parameter in shared:
            part, rest = rest[: parameter.numel()], rest[parameter.numel() :]
            parameter.grad = part.view_as(parameter)
        total = sum((p.grad.sum() for p in dense if id(p) in ids), flat[1])
        self.guard.judge(total, self.optimizer)
        self._agreed += float(flat[2])
        self.stopped |= bool(flat[3] > 0)
        if flat[4] == self.group.size:
            self.writer.commit()
        return flat[0]

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
            cells = split.diagram.locate(points, backend=self.config.backend)
            self.weights = cell_weights(cells.cpu(), importance.cpu(), split.diagram.num_cells)
        found: Split | None = split
        return found

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

    def _resume(self, checkpoint: Checkpoint) -> None:
        self.sharing = self.renderer.sharing = None
        super()._resume(checkpoint)
        whole = self.router.diagram
        if whole.num_cells == 1:
            return
        owner, self.weights = ownership(checkpoint, whole, self.group.size)
        sharing = Sharing(whole, owner.to(self.device))
        cells = sharing.cells(self.group.rank).cpu()
        self.router.subdivide(whole.part(cells), cells, optimizer=self.optimizer)
        self._own(sharing)
