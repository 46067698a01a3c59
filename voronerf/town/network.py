"""The networks of cells, as a file has them; the router is made of them when it is asked for."""

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
    """The networks of cells: settings and tensors."""

    def __init__(self, checkpoint: Checkpoint, device: torch.device | str = "cpu", backend: str = "auto") -> None:
        self.checkpoint, self.device, self.backend = checkpoint, device, backend
        self.diagram = VoronoiDiagram.from_state(checkpoint.group("router"), "diagram.")

    @classmethod
    def of(cls, router: VoronoiRouter, config: TrainConfig) -> StoredRouter:
        """Those of a router, and the settings that its network is made of."""
        tensors = {f"router.{name}": tensor for name, tensor in router.state_dict().items()}
        network = cls(Checkpoint(tensors, {"config": replace(config, sampling="stratified").to_values()}))
        network.router = router
        return network

    @functools.cached_property
    def router(self) -> VoronoiRouter:
        """With averaged weights, in evaluation mode."""
        return open_routers(config_of(self.checkpoint), self.checkpoint, self.device, self.backend)["field"]

    def part(self, cells: Sequence[int] | Tensor) -> StoredRouter:
        """Those of some of the cells."""
        return StoredRouter.of(self.router.part(cells), config_of(self.checkpoint))

    def stored(self) -> Checkpoint:
        """The checkpoint without what only a training needs."""
        shown = {k: v for k, v in self.checkpoint.tensors.items() if k.startswith("router") or k.endswith(".average")}
        tensors = {name: tensor.cpu() for name, tensor in shown.items()}
        return Checkpoint(tensors, {"config": self.checkpoint.values["config"]})


def config_of(checkpoint: Checkpoint) -> TrainConfig:
    """The settings in a checkpoint."""
    return TrainConfig.from_values(checkpoint.values["config"], checkpoint.source)
