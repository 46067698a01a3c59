"""The stored networks of cells, and the voxels in which they have learnt; a router is made on first use."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from voronerf.app.train.checkpoint import Checkpoint
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.resume import open_routers
from voronerf.diagram import VoronoiDiagram
from voronerf.router import VoronoiRouter


class StoredRouter:
    """A stored router: the settings and the tensors of its checkpoint.

    Attributes:
        voxels: The box [2, 3] and the occupied voxels, bool [x, y, z], of the training's grid; None without a grid.
            Networks have learnt nothing in empty voxels.
    """

    def __init__(self, checkpoint: Checkpoint, device: torch.device | str = "cpu", backend: str = "auto") -> None:
        self.checkpoint, self.device, self.backend = checkpoint, device, backend
        self.diagram = VoronoiDiagram.from_state(checkpoint.group("router"), "diagram.")
        grid = checkpoint.group("occupancy")
        self.voxels = (grid["box"].to(device), grid["occupied"].to(device)) if grid else None

    @classmethod
    def of(
        cls, router: VoronoiRouter, config: TrainConfig, voxels: tuple[Tensor, Tensor] | None = None
    ) -> StoredRouter:
        """Returns the stored form of a router, its settings and the voxels in which it has learnt."""
        tensors = {f"router.{name}": tensor for name, tensor in router.state_dict().items()}
        if voxels is not None:
            tensors |= {"occupancy.box": voxels[0], "occupancy.occupied": voxels[1]}
        network = cls(Checkpoint(tensors, {"config": replace(config, sampling="stratified").to_values()}))
        network.router = router
        return network

    @functools.cached_property
    def router(self) -> VoronoiRouter:
        """The router with averaged weights, in evaluation mode."""
        return open_routers(config_of(self.checkpoint), self.checkpoint, self.device, self.backend)["field"]

    def part(self, cells: Sequence[int] | Tensor) -> StoredRouter:
        """Returns a StoredRouter with only the given cells."""
        return StoredRouter.of(self.router.part(cells), config_of(self.checkpoint), self.voxels)

    def stored(self) -> Checkpoint:
        """Returns the checkpoint on the CPU, without the tensors that are needed only in training."""
        starts = "router", "occupancy.box", "occupancy.occupied"
        shown = (name for name in self.checkpoint.tensors if name.startswith(starts) or name.endswith(".average"))
        tensors = {name: self.checkpoint.tensors[name].cpu() for name in shown}
        return Checkpoint(tensors, {"config": self.checkpoint.values["config"]})


def config_of(checkpoint: Checkpoint) -> TrainConfig:
    """Returns the settings in a checkpoint."""
    return TrainConfig.from_values(checkpoint.values["config"], checkpoint.source)
