"""A training between two steps."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from voronerf.app.scenes import Scene
from voronerf.app.train.config import TrainConfig
from voronerf.nerf import schedule
from voronerf.nerf.adam import Adam
from voronerf.nerf.batches import RayBatches
from voronerf.nerf.loss import RayLoss
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import Sampler
from voronerf.nerf.schedule import learning_rate, next_rays
from voronerf.nerf.segment import in_python
from voronerf.nerf.split import SplitDone, Strategy
from voronerf.nerf.step import StepOutput, TrainingStep
from voronerf.ops import Guard
from voronerf.ops._core import backends
from voronerf.router import VoronoiRouter

#: The dtype of autocast for each precision but float32.
HALVES = {"bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass(frozen=True)
class Stage:
    """A period of training on one diagram.

    ``balance_before`` and ``balance_after`` are std(W / max W) over the new cells of a parent, and of these the median
    over the parents that were split; None for the coarse stage.
    """

    cells: int
    started_at_second: float
    started_at_step: int
    balance_before: float | None
    balance_after: float | None
    split_cells: int


@dataclass
class State:
    """A training between two steps.

    :func:`voronerf.app.train.build` makes it, :func:`voronerf.app.train.train` moves it on.

    Attributes:
        config: The settings, with every default filled in.
        scene: The scene.
        routers: The networks by name; "field" gives the colours.
        renderer: Networks and sampler.
        ray_loss: From a batch of rays to a loss.
        optimizer: Of all networks.
        strategy: When and how cells split.
        batches: Of rays.
        generator: Of random choices on the host.
        draws: Of random choices on the device; the same on a CPU.
        scaler: Of the loss in float16.
        guard: Of steps whose loss or gradients are not finite.
        on_event: Called with a line of text for what happens; None for no calls.
        step: Steps done.
        seconds: Training time.
        evaluation_seconds: Of evaluations so far that count towards the budget.
        reserved_seconds: Of the budget, for the last evaluation.
        rays: Of the next step.
        unseen_share: The part of the training in which batches have rays that no picture shows.
        rays_done: Of all steps.
        loss: Of the last step that the host has read.
        skipped_in_a_row: Steps that the guard has left out since the last good one.
        stages: Periods of training: one more than splits, and one for each new start of the coarse stage.
        stopped: Whether somebody asked to end the training.
        training_step: Of these objects.
    """

    config: TrainConfig
    scene: Scene
    routers: dict[str, VoronoiRouter]
    renderer: Renderer
    ray_loss: RayLoss
    optimizer: Adam
    strategy: Strategy
    batches: RayBatches
    generator: torch.Generator
    draws: torch.Generator
    scaler: torch.amp.GradScaler
    guard: Guard
    rays: int
    unseen_share: float = 0.0
    on_event: Callable[[str], None] | None = None
    step: int = 0
    seconds: float = 0.0
    evaluation_seconds: float = 0.0
    reserved_seconds: float = 0.0
    rays_done: int = 0
    loss: float = math.nan
    skipped_in_a_row: int = 0
    stages: list[Stage] = field(default_factory=lambda: [Stage(1, 0.0, 0, None, None, 0)])
    stopped: bool = False
    training_step: TrainingStep = field(init=False)

    def __post_init__(self) -> None:
        self.training_step = TrainingStep(
            self.batches,
            self.ray_loss,
            self.optimizer,
            strategy=self.strategy,
            guard=self.guard,
            generator=self.draws,
            autocast=HALVES.get(self.config.precision),
            scaler=self.scaler,
        )

    @property
    def device(self) -> torch.device:
        """The device of the networks."""
        return torch.device(self.config.device)

    @property
    def router(self) -> VoronoiRouter:
        """The router of the network that gives the colours."""
        return self.routers["field"]

    @property
    def sampler(self) -> Sampler:
        """Where along rays the networks are asked."""
        return self.renderer.sampler

    @property
    def fraction(self) -> float:
        """How much of the training is done, 0..1."""
        return self.fraction_at(self.step)

    def fraction_at(self, step: int) -> float:
        """How much of the training is done after so many steps, if they are made by now."""
        if self.config.steps is not None:
            return min(1.0, step / self.config.steps)
        training = float(self.config.budget or 1.0) - self.evaluation_seconds - self.reserved_seconds
        return min(1.0, self.seconds / max(training, 1e-9))

    @property
    def skipped(self) -> int:
        """Steps that were left out, since a loss or gradients were not finite; waits for the device."""
        return int(self.guard.skipped)

    @property
    def parameter_count(self) -> int:
        """Parameters of all networks of all cells."""
        return sum(p.numel() for router in self.routers.values() for p in router.parameters())

    @property
    def thread_deterministic(self) -> bool:
        """Whether native ops compute all networks: then steps are the same bits on any number of threads."""
        chosen = backends.chosen("routed_mlp", self.device, torch.float32, backend=self.config.backend)
        native = self.device.type == "cpu" and chosen == "native"
        return native and all(map(self._is_one_program, self.routers.values()))

    def _is_one_program(self, router: VoronoiRouter) -> bool:
        """Whether all that a router computes is one program, whatever its timings."""
        if router.fuse and router.way != "fused":  # timings may decide for another way
            return False
        return not isinstance(router.program(*_samples(6 if self.renderer.cones else 3), trace=True), str)

    def learning_rate(self) -> float:
        """The learning rate of the next step: that of the middle of its group."""
        group = schedule.GROUP
        middle = self.step - (self.step - self.began) % group + group // 2
        highest, hold = float(self.config.lr or 0), self.config.field_type.lr_hold
        return learning_rate(highest, self.fraction_at(middle), middle, hold=hold, began=self.began)

    def steps_alike(self) -> int:
        """How many of the next steps can be made in one call: nothing changes between them."""
        if any(in_python(self.strategy, hook) for hook in ("is_due", "step_pre_backward")):
            return 1
        age = self.step - self.began
        most = min(schedule.GROUP - age % schedule.GROUP, self.sampler.steps_alike(age))
        if self.config.steps is not None:
            most = min(most, self.config.steps - self.step)
        due = (n for n in range(1, most) if self.strategy.is_due(self.fraction_at(self.step + n), self.step + n))
        return next(due, most)

    @property
    def began(self) -> int:
        """The step at which the coarse stage began, for the last time: see `voronerf.app.train.start`."""
        return max((stage.started_at_step for stage in self.stages if stage.cells == 1), default=0)

    def averaged(self) -> AbstractContextManager[None]:
        """A context in which the networks have their averaged weights, for pictures; not for training."""
        return self.optimizer.averaged()

    def read_output(self, made: StepOutput) -> None:
        """Reads loss, guard and number of samples of a step, which waits for the device; finds the rays of the next."""
        self.loss, self.skipped_in_a_row = float(made.loss), int(self.guard.in_a_row)
        if self.sampler.grid is not None and (self.step - self.began) % schedule.GROUP == 0:
            self.rays = next_rays(
                self.rays,
                made.samples,
                rays=int(self.config.rays or 0),
                samples=self.sampler.strata,
                growth=self.config.field_type.ray_growth,
                contracted=self.config.contraction != "none",
            )

    def count_evaluation(self, seconds: float, reserved: float) -> None:
        """Takes seconds of an evaluation from the budget, and reserves some of it for the last one."""
        self.evaluation_seconds, self.reserved_seconds = self.evaluation_seconds + seconds, reserved

    def begin_stage(self, done: SplitDone) -> None:
        """Counts a split, after which a new stage of training begins."""
        balances = list(done.split.balances.values())
        before, after = (
            float(torch.tensor([getattr(balance, name) for balance in balances]).median()) if balances else None
            for name in ("imbalance_before", "imbalance_after")
        )
        self.stages.append(Stage(self.router.num_cells, self.seconds, self.step, before, after, len(balances)))

    def begin_again(self) -> None:
        """Counts a new start of the coarse stage."""
        self.rays = int(self.config.rays or 0)
        self.stages.append(Stage(1, self.seconds, self.step, None, None, 0))

    def count_steps(self, count: int, rays: int) -> None:
        """Counts steps with so many rays each."""
        self.step += count
        self.rays_done += count * rays

    def add_seconds(self, seconds: float) -> None:
        """Counts seconds of training."""
        self.seconds += seconds

    def restore(self, skipped: int, stages: Sequence[Mapping[str, Any]], **counters: float) -> None:
        """Takes the counters of a checkpoint, by their names here."""
        self.guard.begin(skipped)
        self.stages[:] = (Stage(**stage) for stage in stages)
        for name, value in counters.items():
            setattr(self, name, value)

    def clear_stop(self) -> None:
        """Forgets a request to stop that came during the last step."""
        self.stopped = False

    def stop(self) -> None:
        """Ends the training after the step or the view in hand, with a checkpoint, as Ctrl-C does."""
        self.stopped = True

    def report(self, line: str) -> None:
        """Calls ``on_event``, if set."""
        if self.on_event is not None:
            self.on_event(line)


@functools.cache
def _samples(columns: int) -> tuple[Tensor, Tensor]:
    """Some on which networks can be traced: positions or Gaussians [16, columns], and directions."""
    points = torch.linspace(-1, 1, 16 * columns).reshape(16, columns)
    return points, torch.nn.functional.normalize(points[:, :3], dim=-1)
