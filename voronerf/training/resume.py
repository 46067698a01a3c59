"""What a checkpoint keeps of a training, and how a training goes on from it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.training.checkpoint import (
    Checkpoint,
    CheckpointError,
    last_checkpoint,
    load_optimizer_tensors,
    optimizer_tensors,
)
from voronerf.training.config import TrainConfig, differences
from voronerf.training.divergence import GradientGuard
from voronerf.training.networks import check_shapes, make_optimizer, restore_routers, router_states
from voronerf.training.progress import Stage
from voronerf.training.schema import check_types

if TYPE_CHECKING:
    from voronerf.training.trainer import Trainer


@dataclass(frozen=True)
class Stored:
    """What a checkpoint keeps beside its tensors."""

    config: dict[str, Any]
    step: int
    seconds: float
    rays: int
    rays_done: int
    stages: tuple[dict[str, Any], ...]
    evaluated: int
    skipped: int
    rate_factor: float
    threads: int


def stored_values(checkpoint: Checkpoint) -> tuple[TrainConfig, Stored]:
    """The settings of a checkpoint's training, and how far it is.

    Raises:
        CheckpointError: When a value is missing or of another type.
    """
    source, values = checkpoint.source, dict(checkpoint.values)
    try:
        if isinstance(values.get("stages"), list):
            values["stages"] = tuple(values["stages"])
        check_types(source, Stored, values)
        for number, stage in enumerate(values["stages"]):
            check_types(f"{source}: stage {number}", Stage, stage)
        if not (values["step"] >= 0 and 0 <= values["seconds"] < math.inf and values["stages"]):
            step, seconds, count = values["step"], values["seconds"], len(values["stages"])
            raise ValueError(f"{source}: step, seconds and stages must be counts, got {step}, {seconds} and {count}")
    except ValueError as error:
        raise CheckpointError(str(error)) from None
    stored = Stored(**values)
    config = TrainConfig.from_json(json.dumps(stored.config), source)
    most = int(config.rays * (config.ray_growth or 1))
    if not config.rays <= stored.rays <= most:
        raise CheckpointError(f"{source}: rays must lie in {config.rays} to {most} by its settings, got {stored.rays}")
    return config, stored


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
        for name, value in group.items():  # copies, since training goes on while they are written
            tensors[f"{prefix}.{name}"] = torch.as_tensor(value).detach().to("cpu", copy=True).contiguous()
    values = {
        "config": json.loads(trainer.config.to_json()),
        "step": trainer.step,
        "seconds": trainer.seconds,
        "rays": trainer.rays,
        "rays_done": trainer.rays_done,
        "stages": [asdict(stage) for stage in trainer.stages],
        "evaluated": trainer.evaluated,
        "skipped": int(trainer.guard.skipped),
        "rate_factor": trainer.rate_factor,
        "threads": torch.get_num_threads(),
    }
    return Checkpoint(tensors, values)


def resumed_checkpoint(config: TrainConfig, run: Path) -> Checkpoint:
    """The last checkpoint of a run, whose networks are those of the settings to continue it with.

    Raises:
        CheckpointError: When there is no checkpoint, or one of another configuration.
    """
    checkpoint = last_checkpoint(run)
    stored, _ = stored_values(checkpoint)
    different = differences(stored, config)
    if different:
        raise CheckpointError(f"{checkpoint.source}: a checkpoint of another configuration: {'; '.join(different)}")
    check_shapes(stored, checkpoint)
    return checkpoint


def resume_training(trainer: Trainer, checkpoint: Checkpoint) -> None:
    """Puts a trainer where the training was that wrote a checkpoint of its settings; it gets a new optimiser.

    Raises:
        CheckpointError: When something is missing or does not fit.
    """
    path = checkpoint.source
    _, stored = stored_values(checkpoint)
    restore_routers(trainer.routers, checkpoint)
    trainer.optimizer = make_optimizer(trainer.routers, trainer.config)
    try:
        if stored.step and not checkpoint.group("optimizer"):
            raise ValueError(f"no moments of the optimiser after {stored.step} steps")
        load_optimizer_tensors(trainer.optimizer, checkpoint.group("optimizer"))
        trainer.scaler.load_state_dict({name: value.item() for name, value in checkpoint.group("scaler").items()})
        trainer.reservoir.load_state_dict(checkpoint.group("reservoir"))
        if trainer.occupancy is not None:
            state, contraction = checkpoint.group("occupancy"), trainer.renderer.contraction
            trainer.occupancy = OccupancyGrid.from_state(state, contraction=contraction, device=trainer.device)
            trainer.renderer.occupancy = trainer.occupancy
        generators = checkpoint.group("generator")
        trainer.generator.set_state(generators["state"])
        drawn = generators["draws"]
        if trainer.draws is not trainer.generator and drawn.shape == trainer.draws.get_state().shape:
            trainer.draws.set_state(drawn)  # else the run began on another kind of device
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{path}: not a checkpoint of a training: {error}") from None
    threads = torch.get_num_threads()
    if stored.threads != threads and trainer.device.type == "cpu" and not trainer.any_threads:
        trainer.say(
            f"not bit for bit: {path} was written on {stored.threads} threads, now there are {threads}, and torch "
            "computes these networks"
        )
    trainer.step = stored.step
    trainer.seconds = stored.seconds
    trainer.rays, trainer.rays_done = stored.rays, stored.rays_done
    trainer.stages = [Stage(**stage) for stage in stored.stages]
    trainer.evaluated = stored.evaluated
    trainer.guard = GradientGuard(trainer.device, stored.skipped)
    trainer.rate_factor = stored.rate_factor
