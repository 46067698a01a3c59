"""Checkpoints of a training over ranks: rank 0 writes what all of them have, as one process would."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.distributed.group import RankLost
from voronerf.distributed.sharing import assign_cells
from voronerf.router.grouping import cell_parameters
from voronerf.training.checkpoint import Checkpoint, CheckpointError, CheckpointWriter

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
    """Writes the checkpoints of all ranks into one file; every rank calls the same methods."""

    #: Whether a checkpoint is being written differs between ranks; a new one waits for it.
    busy = False

    def __init__(self, trainer: RankTrainer) -> None:
        super().__init__(trainer.out, trainer.config.keep_checkpoints)
        self.trainer = trainer

    def write(self, checkpoint: Checkpoint) -> None:
        """Begins to write a checkpoint of all ranks.

        Args:
            checkpoint: The state of this rank.

        Raises:
            OSError: When the one before could not be written.
            RankLost: When that is so on another rank.
        """
        self.wait()
        trainer = self.trainer
        if trainer.sharing is not None:
            names = [*names_of_cells(trainer), *(["occupancy.density"] if trainer.occupancy is not None else [])]
            parts = trainer.group.at_first({name: checkpoint.tensors[name] for name in names})
            if trainer.writes:
                checkpoint = self._whole(checkpoint, parts, trainer)
        if trainer.writes:
            self._begin(checkpoint)

    def wait(self) -> None:
        """Returns when the checkpoint is written on all ranks.

        Raises:
            OSError: When it could not be.
            RankLost: When it could not be on another rank.
        """
        failure: OSError | None = None
        try:
            super().wait()
        except OSError as error:
            failure = error
        failed = torch.tensor(float(failure is not None), device=self.trainer.device)
        if self.trainer.group.largest(failed) > 0:
            raise failure or RankLost("another rank could not write the checkpoint")

    def _whole(self, own: Checkpoint, parts: list[dict[str, Tensor]], trainer: RankTrainer) -> Checkpoint:
        """The checkpoint of one process that had all cells."""
        assert trainer.sharing is not None
        sharing, tensors = trainer.sharing, dict(own.tensors)
        for name in parts[0]:
            if name == "occupancy.density":
                tensors[name] = torch.stack([part[name] for part in parts]).amax(0)
                continue
            whole = parts[0][name].new_empty(sharing.diagram.num_cells, *parts[0][name].shape[1:])
            for rank, part in enumerate(parts):
                whole[sharing.cells(rank).cpu()] = part[name]
            tensors[name] = whole
        if trainer.occupancy is not None:
            tensors["occupancy.occupied"] = tensors["occupancy.density"] >= trainer.occupancy.threshold
        names = [name for name in tensors if name.startswith("router.diagram.")]
        tensors = {name: tensor for name, tensor in tensors.items() if name not in names}
        for name, tensor in sharing.diagram.state_dict().items():
            tensors[f"router.diagram.{name}"] = tensor.detach().to("cpu", copy=True)
        tensors["sharing.owner"], tensors["sharing.weights"] = sharing.owner.cpu(), trainer.weights
        return Checkpoint(tensors, own.values)
