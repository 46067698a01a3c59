"""What a checkpoint keeps of a training, and how a training goes on from it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.training.checkpoint import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_optimizer_tensors,
    optimizer_tensors,
)
from voronerf.training.config import TrainConfig, differences
from voronerf.training.networks import make_optimizer, restore_routers, router_states
from voronerf.training.progress import Stage

if TYPE_CHECKING:
    from voronerf.training.trainer import Trainer


def training_state(trainer: Trainer) -> Checkpoint:
    """All that a training needs to go on bit for bit: parameters, moments, kept samples, random numbers, counters."""
    tensors: dict[str, Tensor] = {}
    parts = {
        **router_states(trainer.routers),
        "optimizer": optimizer_tensors(trainer.optimizer),
        "reservoir": trainer.reservoir.state_dict(),
        "generator": {"state": trainer.generator.get_state(), "draws": trainer.draws.get_state()},
    }
    if trainer.occupancy is not None:
        parts["occupancy"] = trainer.occupancy.state_dict()
    if trainer.scaler.is_enabled():
        parts["scaler"] = trainer.scaler.state_dict()
    for prefix, group in parts.items():
        tensors |= {f"{prefix}.{name}": torch.as_tensor(value) for name, value in group.items()}
    values = {
        "config": json.loads(trainer.config.to_json()),
        "step": trainer.step,
        "seconds": trainer.seconds,
        "stages": [asdict(stage) for stage in trainer.stages],
    }
    return Checkpoint(tensors, values)


def resume_training(trainer: Trainer, path: Path) -> None:
    """Puts a trainer where the training was that wrote a checkpoint; it gets a new optimiser.

    Raises:
        CheckpointError: When there is no checkpoint, or one of another configuration.
    """
    checkpoint = load_checkpoint(path)
    stored = TrainConfig.from_json(json.dumps(checkpoint.values["config"]), str(path))
    different = differences(stored, trainer.config)
    if different:
        raise CheckpointError(f"{path}: a checkpoint of another configuration: {'; '.join(different)}")
    restore_routers(trainer.routers, checkpoint)
    trainer.optimizer = make_optimizer(trainer.routers, trainer.config)
    load_optimizer_tensors(trainer.optimizer, checkpoint.group("optimizer"))
    trainer.scaler.load_state_dict({name: value.item() for name, value in checkpoint.group("scaler").items()})
    trainer.reservoir.load_state_dict(checkpoint.group("reservoir"))
    occupancy = checkpoint.group("occupancy")
    if occupancy:
        trainer.occupancy = OccupancyGrid.from_state(occupancy, device=trainer.device)
        trainer.renderer.occupancy = trainer.occupancy
    generators = checkpoint.group("generator")
    trainer.generator.set_state(generators["state"])
    drawn = generators.get("draws", generators["state"])
    if trainer.draws is not trainer.generator and drawn.shape == trainer.draws.get_state().shape:
        trainer.draws.set_state(drawn)  # else the run began on another kind of device
    trainer.step = checkpoint.values["step"]
    trainer.seconds = checkpoint.values["seconds"]
    trainer.stages = [Stage(**stage) for stage in checkpoint.values["stages"]]
