"""The state of a training between two steps."""

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
from voronerf.nerf.distributed import ALONE, Ranks
from voronerf.nerf.loss import RayLoss
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.replay import in_python
from voronerf.nerf.samplers import Sampler
from voronerf.nerf.schedule import learning_rate, next_rays
from voronerf.nerf.split import SplitDone, Strategy
from voronerf.nerf.step import StepOutput, TrainingStep
from voronerf.ops import Guard
from voronerf.ops._core import backends
from voronerf.router import VoronoiRouter

#: The dtype of autocast for each precision except float32.
HALVES = {"bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass(frozen=True)
class TrainingStage:
    """A period of training on one diagram.

    ``balance_before`` and ``balance_after`` measure the imbalance before and after the centres of new cells are moved:
    the median over the split cells of std(W / max W), where W are the importances of a split cell's new cells. Both are
    None for the coarse stage, the training with one cell.
    """

    cells: int
    started_at_second: float
    started_at_step: int
    balance_before: float | None
    balance_after: float | None
    split_cells: int


@dataclass
class State:
    """The state of a training between two steps.

    :func:`voronerf.app.train.build` builds it, and :func:`voronerf.app.train.train` advances it.

    Attributes:
        config: The settings, with every default filled in.
        scene: The scene.
        routers: The networks by name; "field" gives the colours.
        renderer: Networks and sampler.
        ray_loss: The loss of a batch of rays.
        optimizer: The optimiser of all networks.
        strategy: The strategy for splits of cells.
        batches: The source of ray batches.
        generator: The random generator of the host.
        draws: The random generator of the device; on a CPU the host's generator.
        scaler: The loss scaler for float16.
        guard: The NaN guard, which skips steps whose loss or gradients are not finite.
        on_event: Function that is called with a line of text for each event; None for no calls.
        step: The number of finished steps.
        seconds: The training time in seconds.
        evaluation_seconds: The time in seconds of evaluations that count for the budget.
        reserved_seconds: The seconds of the budget that are reserved for the last evaluation.
        rays: The number of rays of the next step.
        ranks: The processes of a data-parallel training.
        unseen_share: The fraction of the training in which batches have unseen rays, from positions without a camera.
        rays_done: The number of rays of all finished steps.
        loss: The loss of the last step that the host has read.
        skipped_in_a_row: The number of consecutive steps, up to the last one, that the guard has skipped.
        stages: The periods of training: the first one, one after each split, and one for each restart of the coarse
            stage.
        stopped: Whether a stop of the training is requested.
        training_step: The training step with the objects of this state.
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
    ranks: Ranks = ALONE
    unseen_share: float = 0.0
    on_event: Callable[[str], None] | None = None
    step: int = 0
    seconds: float = 0.0
    evaluation_seconds: float = 0.0
    reserved_seconds: float = 0.0
    rays_done: int = 0
    loss: float = math.nan
    skipped_in_a_row: int = 0
    stages: list[TrainingStage] = field(default_factory=lambda: [TrainingStage(1, 0.0, 0, None, None, 0)])
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
            ranks=self.ranks,
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
        """The sampler, which places samples along rays."""
        return self.renderer.sampler

    @property
    def fraction(self) -> float:
        """The finished fraction of the training, 0..1."""
        return self.fraction_at(self.step)

    def fraction_at(self, step: int) -> float:
        """Returns the finished fraction, 0..1, at a step; for a training with a budget, the current fraction."""
        if self.config.steps is not None:
            return min(1.0, step / self.config.steps)
        training = float(self.config.budget or 1.0) - self.evaluation_seconds - self.reserved_seconds
        return min(1.0, self.seconds / max(training, 1e-9))

    @property
    def skipped(self) -> int:
        """The number of steps that the guard has skipped; waits for the device."""
        return int(self.guard.skipped)

    @property
    def parameter_count(self) -> int:
        """The number of parameters of all networks of all cells."""
        return sum(p.numel() for router in self.routers.values() for p in router.parameters())

    @property
    def thread_deterministic(self) -> bool:
        """Returns whether native ops compute all networks, so that results do not depend on the number of threads."""
        chosen = backends.chosen("routed_mlp", self.device, torch.float32, backend=self.config.backend)
        native = self.device.type == "cpu" and chosen == "native"
        return native and all(map(self._is_one_program, self.routers.values()))

    def _is_one_program(self, router: VoronoiRouter) -> bool:
        """Returns whether a router runs as one fused program."""
        return not isinstance(router.program(*_samples(6 if self.renderer.cones else 3), trace=True), str)

    def learning_rate(self) -> float:
        """Returns the learning rate of the next step: the schedule's rate at the middle of its `GROUP` of steps."""
        group = schedule.GROUP
        middle = self.step - (self.step - self.began) % group + group // 2
        highest, hold = float(self.config.lr or 0) / self.relative_length, self.config.field_type.lr_hold
        return learning_rate(highest, self.fraction_at(middle), middle, hold=hold, began=self.began)

    @property
    def relative_length(self) -> float:
        """The length relative to a short training, see :func:`schedule.relative_length`; 1 for tables in a box."""
        if self.config.contraction == "none" and self._has_table:
            return 1.0
        return schedule.relative_length(self.step, self.fraction, self.config.steps)

    @property
    def _has_table(self) -> bool:
        return self.config.field_type.scene_options is not None

    def steps_per_update(self) -> int:
        """Returns the number of next steps that can be made in one call, because no setting changes between them."""
        if any(in_python(self.strategy, hook) for hook in ("is_due", "step_pre_backward")):
            return 1
        age = self.step - self.began
        most = min(schedule.GROUP - age % schedule.GROUP, self.sampler.steps_per_update(age))
        if self.config.steps is not None:
            most = min(most, self.config.steps - self.step)
        due = (n for n in range(1, most) if self.strategy.is_due(self.fraction_at(self.step + n), self.step + n))
        return next(due, most)

    @property
    def began(self) -> int:
        """The step at which the training with one cell last started or restarted, see `voronerf.app.train.start`."""
        return max((stage.started_at_step for stage in self.stages if stage.cells == 1), default=0)

    def agree(self, steps: int) -> int:
        """Copies times and the number of rays from rank 0 to all ranks; returns rank 0's ``steps`` (0: no more)."""
        names = "seconds", "evaluation_seconds", "reserved_seconds", "rays"
        numbers, steps = self.ranks.first(([getattr(self, name) for name in names], steps))
        for name, number in zip(names, numbers, strict=True):
            setattr(self, name, number)
        return steps

    def averaged(self) -> AbstractContextManager[None]:
        """Returns a context in which the networks have their averaged weights, for pictures but not for training."""
        return self.optimizer.averaged()

    def read_output(self, output: StepOutput) -> None:
        """Reads a step's loss, guard and sample count, which waits for the device; updates the number of rays."""
        self.loss, self.skipped_in_a_row = float(output.loss), int(self.guard.in_a_row)
        if self.sampler.grid is not None and (self.step - self.began) % schedule.GROUP == 0:
            more = self.relative_length**2 if self._has_table and self.config.budget is not None else 1.0
            least = int(self.config.rays or 0)
            rays = next_rays(
                self.rays,
                output.samples,
                rays=int(least * more),
                samples=self.sampler.strata,
                growth=self.config.field_type.ray_growth,
                contracted=self.config.contraction != "none",
            )
            self.rays = min(rays, max(least, schedule.MOST_STRATA // self.sampler.strata))

    def count_evaluation(self, seconds: float, reserved: float) -> None:
        """Subtracts an evaluation's seconds from the budget, and sets the seconds reserved for the last evaluation."""
        self.evaluation_seconds, self.reserved_seconds = self.evaluation_seconds + seconds, reserved

    def begin_stage(self, done: SplitDone) -> None:
        """Adds the period of training that begins after a split to ``stages``."""
        balances = list(done.split.balances.values())
        pairs = [(balance.imbalance_before, balance.imbalance_after) for balance in balances]
        imbalances = torch.tensor(pairs, dtype=torch.float32, device="cpu").view(-1, 2)
        before, after = imbalances.median(0).values.tolist() if balances else (None, None)
        self.stages.append(TrainingStage(self.router.num_cells, self.seconds, self.step, before, after, len(balances)))

    def begin_again(self) -> None:
        """Adds an entry to ``stages`` for a restart with one cell, and resets the number of rays."""
        self.rays = int(self.config.rays or 0)
        self.stages.append(TrainingStage(1, self.seconds, self.step, None, None, 0))

    def count_steps(self, count: int, rays: int) -> None:
        """Counts ``count`` steps with ``rays`` rays each in every process."""
        self.step += count
        self.rays_done += count * rays * self.ranks.size

    def add_seconds(self, seconds: float) -> None:
        """Adds seconds of training time."""
        self.seconds += seconds

    def restore(self, skipped: int, stages: Sequence[Mapping[str, Any]], **counters: float) -> None:
        """Restores the counters of a checkpoint, which are named like the attributes of a state."""
        self.guard.begin(skipped)
        self.stages[:] = (TrainingStage(**stage) for stage in stages)
        for name, value in counters.items():
            setattr(self, name, value)

    def clear_stop(self) -> None:
        """Clears a request to stop that came during the last step."""
        self.stopped = False

    def stop(self) -> None:
        """Ends the training after the current step or view, with a checkpoint, like Ctrl-C."""
        self.stopped = True

    def report(self, line: str) -> None:
        """Calls ``on_event``, if set."""
        if self.on_event is not None:
            self.on_event(line)


@functools.cache
def _samples(columns: int) -> tuple[Tensor, Tensor]:
    """Returns inputs for tracing networks: positions or Gaussians [16, columns], and directions [16, 3]."""
    points = torch.linspace(-1, 1, 16 * columns, dtype=torch.float32, device="cpu").reshape(16, columns)
    return points, torch.nn.functional.normalize(points[:, :3], dim=-1)
