"""The stored networks of cells; a router is made from them on first use."""

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
    """A stored router: the settings and the tensors of its checkpoint."""

    def __init__(self, checkpoint: Checkpoint, device: torch.device | str = "cpu", backend: str = "auto") -> None:
        self.checkpoint, self.device, self.backend = checkpoint, device, backend
        self.diagram = VoronoiDiagram.from_state(checkpoint.group("router"), "diagram.")

    @classmethod
    def of(cls, router: VoronoiRouter, config: TrainConfig) -> StoredRouter:
        """Returns the stored form of a router and its settings."""
        tensors = {f"router.{name}": tensor for name, tensor in router.state_dict().items()}
        network = cls(Checkpoint(tensors, {"config": replace(config, sampling="stratified").to_values()}))
        network.router = router
        return network

    @functools.cached_property
    def router(self) -> VoronoiRouter:
        """The router with averaged weights, in evaluation mode."""
        return open_routers(config_of(self.checkpoint), self.checkpoint, self.device, self.backend)["field"]

    def part(self, cells: Sequence[int] | Tensor) -> StoredRouter:
        """Returns a StoredRouter with only the given cells."""
        return StoredRouter.of(self.router.part(cells), config_of(self.checkpoint))

    def stored(self) -> Checkpoint:
        """Returns the checkpoint on the CPU, without the tensors that are needed only in training."""
        kept = {k: v for k, v in self.checkpoint.tensors.items() if k.startswith("router") or k.endswith(".average")}
        tensors = {name: tensor.cpu() for name, tensor in kept.items()}
        return Checkpoint(tensors, {"config": self.checkpoint.values["config"]})


def config_of(checkpoint: Checkpoint) -> TrainConfig:
    """Returns the settings in a checkpoint."""
    return TrainConfig.from_values(checkpoint.values["config"], checkpoint.source)
