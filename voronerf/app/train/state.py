"""What a checkpoint keeps of a training."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch

from voronerf.app.train.checkpoint import (
    Checkpoint,
    CheckpointError,
    load_optimizer_tensors,
    optimizer_tensors,
)
from voronerf.app.train.config import TrainConfig, differences
from voronerf.app.train.networks import check_shapes, router_states
from voronerf.app.train.progress import Stage
from voronerf.app.train.schema import check_types
from voronerf.router import VoronoiRouter


@dataclass(frozen=True)
class Stored:
    """What a checkpoint keeps beside its tensors, by the names of a trainer."""

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
    scoring: float = 0.0
    view_seconds: float = 0.0


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
        times = [values.get(name, 0.0) for name in ("seconds", "scoring", "view_seconds")]
        if not (values["step"] >= 0 and all(0 <= each < math.inf for each in times) and values["stages"]):
            step, count = values["step"], len(values["stages"])
            raise ValueError(f"{source}: step, times and stages must be counts, got {step}, {times} and {count}")
    except ValueError as error:
        raise CheckpointError(str(error)) from None
    stored = Stored(**values)
    config = TrainConfig.from_json(json.dumps(stored.config), source)
    most = int(config.rays * (config.ray_growth or 1))
    if not config.rays <= stored.rays <= most:
        raise CheckpointError(f"{source}: rays must lie in {config.rays} to {most} by its settings, got {stored.rays}")
    return config, stored


def collect(
    stored: Stored,
    routers: Mapping[str, VoronoiRouter],
    optimizer: torch.optim.Optimizer,
    parts: Mapping[str, Mapping[str, Any]],
) -> Checkpoint:
    """A checkpoint of values, networks, moments and further tensors by the first words of their names."""
    every = {**router_states(routers), "optimizer": optimizer_tensors(optimizer), **parts}
    tensors = {
        f"{prefix}.{name}": torch.as_tensor(value).detach().to("cpu", copy=True).contiguous()  # training goes on
        for prefix, group in every.items()
        for name, value in group.items()
    }
    return Checkpoint(tensors, {**asdict(stored), "stages": list(stored.stages)})


def check_resumed(config: TrainConfig, checkpoint: Checkpoint) -> None:
    """Checks that the networks of a checkpoint are those of the settings to continue it with.

    Raises:
        CheckpointError: When it is of another configuration.
    """
    stored, _ = stored_values(checkpoint)
    different = differences(stored, config)
    if different:
        raise CheckpointError(f"{checkpoint.source}: a checkpoint of another configuration: {'; '.join(different)}")
    check_shapes(stored, checkpoint)


def load_moments(optimizer: torch.optim.Optimizer, checkpoint: Checkpoint, step: int) -> None:
    """Loads the moments of an optimiser after some steps.

    Raises:
        ValueError: When they are missing, or do not fit.
    """
    if step and not checkpoint.group("optimizer"):
        raise ValueError(f"no moments of the optimiser after {step} steps")
    load_optimizer_tensors(optimizer, checkpoint.group("optimizer"))
