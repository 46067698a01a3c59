"""The training loop: coarse stage, splits, local stages; evaluations and checkpoints on the way.

Time means training time: steps and splits count, evaluations and checkpoints do not.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from voronerf import backends
from voronerf.data import Scene
from voronerf.data.record import write_scene
from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.reservoir import SampleReservoir
from voronerf.diagram.subdivision import Split
from voronerf.evaluation.lpips import Lpips, find_lpips
from voronerf.evaluation.scores import evaluate
from voronerf.files import write_text
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.renderer import Renderer
from voronerf.router import VoronoiRouter
from voronerf.training.average import averages_in_place, update_averages
from voronerf.training.batches import RayBatches
from voronerf.training.checkpoint import Checkpoint, CheckpointWriter, checkpoint_paths, last_checkpoint
from voronerf.training.config import TrainConfig
from voronerf.training.cuda_graph import GraphedStep, set_learning_rate
from voronerf.training.divergence import PATIENCE, GradientGuard, all_finite
from voronerf.training.networks import (
    check_backend,
    check_memory,
    computes_natively,
    make_optimizer,
    make_routers,
    resolve_config,
)
from voronerf.training.occupancy import make_grid, observe_samples, revisit_cells
from voronerf.training.progress import Progress, Stage, TrainingError
from voronerf.training.rates import learning_rate, next_rays, sharpness, temperature
from voronerf.training.records import record_scores, summarise
from voronerf.training.renderers import make_renderer
from voronerf.training.resume import resume_training, resumed_checkpoint, training_state
from voronerf.training.run_directory import read_metrics
from voronerf.training.splitting import split_by_samples, split_cells

#: Steps between evaluations of random cells of the occupancy grid.
OCCUPANCY_EVERY = 16
#: On a GPU, steps between two times that the host reads the loss and thereby waits for the device.
READ_EVERY = 50
#: The dtype of autocast for each precision but float32.
HALVES = {"bf16": torch.bfloat16, "fp16": torch.float16}
#: Steps between tries to split the worst cell.
SPLIT_EVERY = 5


class Trainer:
    """Trains one scene by the whole method and keeps its run directory.

    Args:
        config: The settings; ``config.out`` names the run directory.
        scene: The scene that ``config.data`` names.
        on_step: Called after every step with a :class:`Progress`.
        on_event: Called with one line of text for each split and evaluation.
        clock: Counts the seconds of training; default ``time.perf_counter``.

    Raises:
        CheckpointError: With ``config.resume``, when there is no checkpoint or it is of another configuration.
    """

    #: What renders, and whether this process writes the files of the run; the ranks of a joint training have their own.
    renderer_type: type[Renderer] = Renderer
    writes = True

    def __init__(
        self,
        config: TrainConfig,
        scene: Scene,
        *,
        on_step: Callable[[Progress], None] | None = None,
        on_event: Callable[[str], None] | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        if config.out is None:
            raise ValueError("Trainer: config.out must name the run directory, got None")
        self.out = config.out
        config = resolve_config(config, scene)
        check_memory(config)
        checkpoint = resumed_checkpoint(config, self.out) if config.resume else None
        self.config = config
        self.plan = config.planned_splits
        self.scene = scene
        self.on_step = on_step
        self.on_event = on_event
        self.clock = clock or time.perf_counter
        self.device = torch.device(config.device)
        check_backend(config, self.device)
        self.generator = torch.Generator().manual_seed(config.seed)
        # Random numbers are drawn on the device that uses them: the host need not wait, and a graph can draw them.
        self.draws = self.generator
        if self.device.type == "cuda":
            self.draws = torch.Generator(self.device).manual_seed(config.seed)
        self.lpips, self.lpips_source = find_lpips(config.lpips, config.data, scene.test.cameras.smallest[::-1])
        self.batches = RayBatches(scene, self.device, cones=config.field_type.cones, sightings=bool(config.sightings))
        self.routers = make_routers(config, self.device)
        for router in self.routers.values():
            router.generator = self.draws
        #: Whether native ops compute the networks: then steps are the same bit for bit on any number of threads.
        self.any_threads = computes_natively(self.routers, config)
        self.optimizer = make_optimizer(self.routers, config)
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=config.precision == "fp16")
        self.reservoir = SampleReservoir(config.reservoir, config.reservoir_batches, device=self.device)
        self.occupancy = make_grid(config, scene, self.device) if config.occupancy else None
        self.renderer = make_renderer(config, scene, self.routers, occupancy=self.occupancy, kind=self.renderer_type)
        self.guard = GradientGuard(self.device)
        self.rate_factor = 1.0  # 0.5 after a divergence
        self.one_colour: float | None = None
        self.step = 0
        self.seconds = 0.0
        #: Rays of the next step, and of all steps so far.
        self.rays, self.rays_done = config.rays, 0
        self.stages = [Stage(1, 0.0, 0, None, None, 0)]
        self.evaluated = 0
        self.metrics: list[dict[str, Any]] = []
        self.stopped = self.described = False
        self.loss = math.nan
        self.writer = CheckpointWriter(self.out, config.keep_checkpoints)
        if checkpoint is not None:
            self._resume(checkpoint)
        self.saved_at = self.seconds
        self._compute = self._make_step()

    @property
    def router(self) -> VoronoiRouter:
        """The router whose colours count."""
        return self.routers["field"]

    @property
    def diagram(self) -> VoronoiDiagram:
        """All cells of the run."""
        return self.router.diagram

    @property
    def parameter_count(self) -> int:
        """Parameters of all networks of all cells."""
        return sum(p.numel() for router in self.routers.values() for p in router.parameters())

    # --- progress ------------------------------------------------------------------------------------------------

    @property
    def fraction(self) -> float:
        """How much of the run is done, 0..1."""
        if self.config.steps is not None:
            return min(1.0, self.step / self.config.steps)
        return min(1.0, self.seconds / float(self.config.budget or 1.0))

    def _now(self) -> float:
        """The time in the unit of the planned splits."""
        return {"fraction": self.fraction, "seconds": self.seconds, "steps": float(self.step)}[self.config.split_unit]

    @property
    def level(self) -> int:
        """Splits done."""
        return len(self.stages) - 1

    def learning_rate(self) -> float:
        """Of the next step, see :func:`voronerf.training.rates.learning_rate`; half of it after a divergence."""
        return learning_rate(self.config, self.fraction, self.step, self.level) * self.rate_factor

    def averaged(self) -> AbstractContextManager[None]:
        """A context in which the networks have their averaged weights, for pictures; not for training."""
        return averages_in_place(self.optimizer)

    def request_stop(self) -> None:
        """Ends training after the step or the view in hand, with a checkpoint; what Ctrl-C does."""
        self.stopped = True

    # --- the loop ------------------------------------------------------------------------------------------------

    def run(self) -> dict[str, Any]:
        """Trains to the end of the budget, or until :meth:`request_stop`; returns what ``summary.json`` holds.

        Raises:
            TrainingError: When the loss or the moments stop being finite, with half the learning rate again or before
                the first checkpoint; the last checkpoint is left as it was.
            OSError: When a checkpoint cannot be written.
        """
        self.advance()
        while not self._check_moments():
            self.advance()
        self.save()
        if self.fraction >= 1:
            self.stopped = False  # a stop that came in the last step has nothing to end
            left = len(self.plan) - self.level
            if left:
                self.say(f"{left} of {len(self.plan)} planned splits not made: the run ended before")
            for router in self.routers.values():
                router.blend = self.config.blend
            self._evaluate(self.config.final_views, self.lpips)
        return summarise(self)

    def advance(self, until: float = math.inf) -> None:
        """Trains until ``until`` training seconds or the end of the budget, whichever comes first.

        :meth:`run` calls it once, and evaluates. Calls in turns let several trainers share a machine, so that its noise
        affects all of them alike.

        Raises:
            As :meth:`run`.
        """
        loss = None
        while self.fraction < 1 and self.seconds < until and not self.stopped:
            if self._due() > self.evaluated:
                self._evaluate(self.config.eval_views)
                continue
            started = self.clock()
            if self.split_is_due():
                self.split()
            self.rays_done += self.rays
            loss = self.train_step()
            self.step += 1
            self.seconds += self.clock() - started
            if self.device.type == "cpu" or self.step % READ_EVERY == 0:
                self._read(loss)
            if self.on_step is not None:
                speed = self.rays_done / max(self.seconds, 1e-9)
                psnr = self.metrics[-1].get("psnr") if self.metrics else None
                self.on_step(
                    Progress(self.step, self.seconds, self.fraction, self.loss, speed, self.diagram.num_cells, psnr)
                )
            saving = self.seconds - self.saved_at >= self.config.checkpoint_every and not self.writer.busy
            if saving or self._due() > self.evaluated:
                self._read(loss)
            if saving and self._check_moments():
                self.save(wait=False)
        if loss is not None:
            self._read(loss)
        self.writer.wait()

    def _read(self, loss: Tensor) -> None:
        """Waits for a step's loss; the wait is training time.

        Raises:
            TrainingError: When steps are skipped again and again, see :meth:`_go_back`.
        """
        started = self.clock()
        self.loss, in_a_row = torch.stack((loss.float(), self.guard.in_a_row)).tolist()
        self.seconds += self.clock() - started
        if in_a_row >= PATIENCE:
            self._go_back(f"gradients of {int(in_a_row)} steps in a row not finite")

    def _check_moments(self) -> bool:
        """Whether parameters and moments are finite; goes back to the last checkpoint where they are not."""
        finite = all_finite(self.optimizer)
        if not finite:
            self._go_back("parameters or moments of Adam not finite")
        return finite

    def _go_back(self, reason: str) -> None:
        """Goes on from the last checkpoint with half the learning rate, once in a run.

        Raises:
            TrainingError: The second time, or without a checkpoint.
        """
        self.writer.wait()
        at, there = self.step, bool(checkpoint_paths(self.out))
        if self.rate_factor < 1 or not there:
            kept = "with half the rate again; the checkpoint is as it was" if there else "there is no checkpoint"
            raise TrainingError(f"{self.out}: {reason} at step {at}, try a smaller --lr; {kept}")
        skipped = int(self.guard.skipped)
        self._resume(last_checkpoint(self.out))
        self.guard.skipped.fill_(skipped)
        self.rate_factor = 0.5
        self.saved_at = self.seconds
        self._compute = self._make_step()
        self.say(f"{reason} at step {at}: back to step {self.step}, with half the learning rate")

    def _make_step(self) -> Callable[[], tuple[Tensor, Tensor | None, Tensor | None]]:
        """The function of a step: the plain one, or a new CUDA graph of it."""
        return GraphedStep(self._forward_backward, [self.draws]) if self.config.cuda_graph else self._forward_backward

    def train_step(self) -> Tensor:
        """One step of :meth:`advance` without its count and clock; returns the loss, which may not be computed yet."""
        with backends.torch_on_one_thread() if self.any_threads else nullcontext():
            return self._train_step()

    def _train_step(self) -> Tensor:
        set_learning_rate(self.optimizer, self.learning_rate())
        for router in self.routers.values():
            router.temperature = temperature(self.config, self.fraction)
        self.renderer.sharpness = sharpness(self.config, self.fraction)
        if self.occupancy is not None and self.step % OCCUPANCY_EVERY == 0:
            self.router.eval()
            self._revisit(self.occupancy)
        if not self.router.training:
            self.renderer.train()
        loss, positions, importance = self._compute()
        if self.config.average:
            update_averages(self.optimizer, self.config.average, self.step)
        if positions is not None and importance is not None:
            self.reservoir.add(positions, importance)
        return loss

    def _revisit(self, grid: OccupancyGrid) -> None:
        revisit_cells(grid, self.renderer.field, self.generator, backend=self.config.backend)

    def _forward_backward(self) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Updates the parameters; returns the loss, and until the last split positions [n, 3] and importance [n]."""
        config = self.config
        batch = self.batches.draw(self.rays, self.draws, random_background=config.background == "random")
        half = HALVES.get(config.precision)
        with nullcontext() if half is None else torch.autocast(self.device.type, half, cache_enabled=False):
            given: dict[str, Any] = {"background": batch.background, "generator": self.draws, "seen": batch.seen}
            found = self.renderer.compare(batch.rays, batch.near, batch.far, batch.target, **given)
        if self.occupancy is not None:
            observe_samples(self.occupancy, found, backend=config.backend)
            self.rays = next_rays(config, self.rays, len(found.positions))
        loss = found.loss
        self.optimizer.zero_grad(set_to_none=True)
        # Nothing is read on the host: the fused optimiser skips a step whose gradients have overflowed by itself.
        self.scaler.scale(loss).backward()
        self.guard.watch(loss, self.optimizer, scaled=self.scaler.is_enabled())
        self.scaler.step(self.optimizer)
        self.scaler.update()
        if self.level >= len(self.plan):
            return loss.detach(), None, None
        return loss.detach(), found.positions, found.importance()

    def split_is_due(self) -> bool:
        """Whether :meth:`advance` splits before the next step."""
        if self.level >= len(self.plan):
            return False
        planned = self.plan[self.level]
        # While no cell holds enough samples, a split of the worst cell is tried again.
        return self._now() >= planned.at - 1e-9 and (planned.most is None or self.step % SPLIT_EVERY == 0)

    def split(self) -> None:
        """Splits the cells by the kept samples; cells that hold too few of them stay as they are."""
        with backends.torch_on_one_thread() if self.any_threads else nullcontext():
            if not split_cells(self):
                return  # the reservoir goes on collecting samples
        self.reservoir = SampleReservoir(self.config.reservoir, self.config.reservoir_batches, device=self.device)
        self._compute = self._make_step()  # a graph would update the parameters from before the split

    def find_split(self, k: int, points: Tensor, importance: Tensor) -> Split | None:
        """The next split of every cell, or of the worst, into k; None if there are fewer samples than that."""
        planned = self.plan[self.level]
        return split_by_samples(self.config, planned, self.diagram, k, points, importance, self.generator)

    def divide(self, split: Split) -> None:
        """Gives the networks the cells of a split."""
        inherit = self.config.init == "inherit"
        for name, router in self.routers.items():
            if name != "proposal" or self.config.split_proposal:
                router.subdivide(split.diagram, split.parents, optimizer=self.optimizer, inherit=inherit)

    # --- evaluation and files --------------------------------------------------------------------------------------

    def _due(self) -> int:
        """Number of evaluations that are due by now."""
        return int(self.fraction * self.config.evaluations + 1e-9)

    def _evaluate(self, views: int | None, lpips: Lpips | None = None) -> None:
        """Scores test views; where a stop is asked for meanwhile, not all of them, and without a trace."""
        with self.averaged():
            scores = evaluate(self.renderer, self.scene, views=views, lpips=lpips, stop=lambda: self.stopped)
        if self.stopped:
            return
        self.evaluated = self._due()
        record_scores(self, scores)

    def save(self, *, wait: bool = True) -> None:
        """Writes ``checkpoints/last.safetensors``; without ``wait`` it is begun, and :attr:`writer` ends it."""
        if self.writes and not self.described:  # not earlier: a run whose first step fails leaves nothing
            write_text(self.out / "config.json", self.config.to_json())
            write_scene(self.out / "scene.json", self.scene)
            self.described = True
        self.writer.write(training_state(self))
        self.saved_at = self.seconds
        if wait:
            self.writer.wait()

    def _resume(self, checkpoint: Checkpoint) -> None:
        """Goes on from a checkpoint of this run."""
        resume_training(self, checkpoint)
        self.evaluated = min(self.evaluated, self._due())  # fewer where the run was made longer
        # Evaluations made after the checkpoint will be made again.
        self.metrics = [m for m in read_metrics(self.out) if m["step"] <= self.step]

    def say(self, line: str) -> None:
        """Tells whoever listens, see ``on_event``."""
        if self.on_event is not None:
            self.on_event(line)
