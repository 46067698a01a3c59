"""Checkpoints of a training over ranks: each writes its cells, and rank 0 what all have in common."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.distributed.group import RankLost
from voronerf.distributed.sharing import assign_cells
from voronerf.router.grouping import cell_parameters
from voronerf.training.checkpoint import (
    VOXELS,
    Checkpoint,
    CheckpointError,
    CheckpointWriter,
    save_checkpoint,
    shard_path,
)

if TYPE_CHECKING:
    from voronerf.distributed.trainer import RankTrainer


def ownership(checkpoint: Checkpoint, diagram: VoronoiDiagram, ranks: int) -> tuple[Tensor, Tensor]:
    """The rank of each cell and the weights of the cells, for a training that goes on.

    With as many ranks as before they keep their cells; another number shares them anew, by the importance that they had
    at the last split.

    Raises:
        CheckpointError: For more ranks than cells.
    """
    k, stored = diagram.num_cells, checkpoint.group("sharing")
    if k < ranks:
        raise CheckpointError(f"{checkpoint.source}: --nproc-per-node must be at most its {k} cells, got {ranks} ranks")
    weights = stored.get("weights", torch.ones(k))
    weights = weights if len(weights) == k else torch.ones(k)
    owner = stored.get("owner", torch.zeros(0, dtype=torch.int64))
    if len(owner) == k and torch.equal(owner.unique(), torch.arange(ranks)):
        return owner, weights
    return assign_cells(diagram.leaf_centres, weights, ranks), weights


def names_of_cells(trainer: RankTrainer) -> list[str]:
    """The tensors of a checkpoint that have an entry for each cell."""
    own = {id(parameter) for parameter in cell_parameters(trainer.router.module)}
    names = [f"router.module.{name}" for name, p in trainer.router.module.named_parameters() if id(p) in own]
    numbered = enumerate(p for group in trainer.optimizer.param_groups for p in group["params"])
    for number, parameter in numbered:
        state = trainer.optimizer.state.get(parameter, {}) if id(parameter) in own else {}
        names += [f"optimizer.{number}.{key}" for key, value in state.items() if value.dim() > 0]
    return names


class RankWriter(CheckpointWriter):
    """Writes a file for the cells of each rank, and when all are there the checkpoint that names them.

    Every rank calls the same methods. A checkpoint counts from the moment that rank 0 has written it.
    """

    #: Whether something is being written differs between ranks; a new checkpoint waits for the one before.
    busy = False

    def __init__(self, trainer: RankTrainer) -> None:
        super().__init__(trainer.out, trainer.config.keep_checkpoints)
        self.trainer = trainer
        self._shard: Path | None = None
        self._index: Checkpoint | None = None

    @property
    def ready(self) -> bool:
        """Whether this rank has written its cells, for a checkpoint that is not there yet."""
        return self._index is not None and not super().busy and self._error is None

    def write(self, checkpoint: Checkpoint) -> None:
        """Begins to write a checkpoint of all ranks.

        Args:
            checkpoint: The state of this rank.

        Raises:
            OSError: When the one before could not be written.
            RankLost: When that is so on another rank.
        """
        self.wait()
        trainer, group = self.trainer, self.trainer.group
        if trainer.sharing is None:
            self._index = checkpoint
            return
        token = group.from_first(f"{trainer.step}-{secrets.token_hex(4)}")
        names = [shard_path(self.run, token, rank).name for rank in range(group.size)]
        cells = trainer.sharing.cells(group.rank).tolist()
        own = [*names_of_cells(trainer), *([VOXELS] if trainer.occupancy is not None else [])]
        self._index = self._without_cells(checkpoint, own, names)
        self._shard = shard_path(self.run, token, group.rank)
        self._begin(Checkpoint({name: checkpoint.tensors[name] for name in own}, {"cells": cells}))

    def commit(self) -> None:
        """Begins to write the checkpoint itself, when all ranks are :attr:`ready`."""
        super().wait()
        index, self._index, self._shard = self._index, None, None
        if index is not None and self.trainer.writes:
            self._begin(index)

    def wait(self) -> None:
        """Returns when the checkpoint is written on all ranks.

        Raises:
            OSError: When it could not be.
            RankLost: When it could not be on another rank.
        """
        self._join()
        if self._index is not None:
            self.commit()
            self._join()

    def _join(self) -> None:
        failure: OSError | None = None
        try:
            super().wait()
        except OSError as error:
            failure = error
        failed = torch.tensor(float(failure is not None), device=self.trainer.device)
        if self.trainer.group.largest(failed) > 0:
            raise failure or RankLost("another rank could not write the checkpoint")

    def _save(self, checkpoint: Checkpoint) -> None:
        if self._shard is None:
            super()._save(checkpoint)
        else:
            save_checkpoint(self._shard, checkpoint)

    def _without_cells(self, state: Checkpoint, own: list[str], shards: list[str]) -> Checkpoint:
        """What all ranks have, with the diagram of all cells."""
        sharing = self.trainer.sharing
        assert sharing is not None
        diagram = "router.diagram."
        tensors = {n: t for n, t in state.tensors.items() if n not in own and not n.startswith(diagram)}
        for name, tensor in sharing.diagram.state_dict().items():
            tensors[diagram + name] = tensor.detach().to("cpu", copy=True)
        tensors["sharing.owner"], tensors["sharing.weights"] = sharing.owner.cpu(), self.trainer.weights
        return Checkpoint(tensors, {**state.values, "shards": shards})
