"""``voronerf train`` on one of the ranks that torchrun has started."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from voronerf.data import load_scene
from voronerf.distributed.group import joined, local_rank, restarts, world_size
from voronerf.distributed.same import check_same, check_same_scene
from voronerf.distributed.trainer import check_ranks
from voronerf.training.checkpoint import checkpoint_paths
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.config_checks import check_device
from voronerf.training.run_directory import choose_directory


def train_on_ranks(config: TrainConfig, run_training: Callable[..., dict[str, Any]], *, view: bool) -> int:
    """Trains together with the other ranks; all of them call it, and rank 0 alone writes files.

    Args:
        config: The settings.
        run_training: Of ``voronerf.cli.commands``.
        view: Whether a viewer was asked for.

    Raises:
        ConfigError: For what is not done over ranks.
        RankLost: When another rank ends, or says what is wrong.
    """
    device = torch.device(f"cuda:{local_rank()}" if config.device == "cuda" else config.device)
    config = replace(config, device=str(device))
    check_device(config.device)
    with joined(device) as group:
        check_same(group, config)
        if view:
            raise ConfigError("--view must be off with several ranks")
        check_ranks(config, world_size())
        assert config.out is not None
        scene = load_scene(config.data, allow_outside=config.allow_outside, **config.reading)
        check_same_scene(group, scene)
        if group.rank == 0:  # alone, for what it writes is there already when others look
            again = restarts() > 0 and bool(checkpoint_paths(config.out))
            config = choose_directory(replace(config, resume=config.resume or again), scene)
        config = replace(config, resume=group.from_first(config.resume))
        summary = run_training(config, scene, group=group)
    return 0 if summary["complete"] else 130
