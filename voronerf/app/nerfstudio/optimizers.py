"""Optimisers and schedulers for nerfstudio's trainer, with the settings of ``voronerf train``."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from voronerf.nerf.adam import Adam


@dataclasses.dataclass
class AdamConfig(OptimizerConfig):
    """Adam with the settings of :meth:`voronerf.nerf.Adam.of`."""

    _target: type = Adam
    lr: float = 0.02
    eps: float = 1e-15
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay of the averages of gradients and of their squares."""
    sparse: bool = False
    """On a CPU, do not update entries without a gradient."""

    def setup(self, params: Iterable[nn.Parameter]) -> Adam:
        """Returns the optimiser of one group of parameters."""
        params = list(params)
        sparse = self.sparse and params[0].device.type == "cpu"
        groups = [{"params": params, "sparse": sparse}]
        return Adam(groups, lr=self.lr, betas=self.betas, eps=self.eps)


@dataclasses.dataclass
class DecaySchedulerConfig(SchedulerConfig):
    """Settings of a linear warm-up of the learning rate, followed by an exponential decay.

    nerfstudio's own scheduler stores NumPy numbers, which torch 2.6 and newer refuse to load from a checkpoint.
    """

    _target: type = dataclasses.field(default_factory=lambda: DecayScheduler)
    lr_final: float = 0.001
    """Learning rate at the end."""
    warmup_steps: int = 100
    """Warm-up steps, from a hundredth of the learning rate; at most a fiftieth of the run."""
    max_steps: int | None = None
    """Steps until the end; default: max_num_iterations of the trainer."""


class DecayScheduler(Scheduler):
    """The scheduler of :class:`DecaySchedulerConfig`."""

    config: DecaySchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> Any:
        """Returns the scheduler of one optimiser with initial learning rate ``lr_init``."""
        config, steps = self.config, self.config.max_steps
        assert steps is not None
        warmup = max(1, min(config.warmup_steps, steps // 50))

        def factor(step: int) -> float:
            rise = min(1.0, 0.01 + 0.99 * step / warmup)
            return rise * (config.lr_final / lr_init) ** min(1.0, step / steps)

        return LambdaLR(optimizer, factor)
