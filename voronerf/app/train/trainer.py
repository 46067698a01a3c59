"""The training loop: coarse stage, splits, local stages; evaluations and checkpoints on the way.

Time means training time: steps and splits. Evaluations take a share of the budget, checkpoints are written meanwhile.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from voronerf.app.evaluate.lpips import Lpips, find_lpips
from voronerf.app.evaluate.scores import ViewScore, evaluate, mean_scores
from voronerf.app.files import json_text, write_bytes, write_text
from voronerf.app.scenes import Scene
from voronerf.app.scenes.record import write_scene
from voronerf.app.train import state
from voronerf.app.train.appearance import Appearance
from voronerf.app.train.batches import RayBatches
from voronerf.app.train.checkpoint import Checkpoint, CheckpointError, CheckpointWriter, last_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.cuda_graph import GraphedStep, set_learning_rate
from voronerf.app.train.divergence import (
    PATIENCE,
    SETTLED,
    all_finite,
    check_can_go_back,
    one_colour_psnr,
    why_scores_are_poor,
)
from voronerf.app.train.networks import (
    SHRINK_EVERY,
    check_backend,
    check_memory,
    computes_natively,
    make_optimizer,
    make_routers,
    resolve_config,
    restore_routers,
)
from voronerf.app.train.progress import Progress, Stage, TrainingError
from voronerf.app.train.rates import learning_rate, next_rays
from voronerf.app.train.refinement import EVERY, START, Refinement
from voronerf.app.train.renderers import make_grid, make_renderer
from voronerf.app.train.run_directory import read_metrics
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf import Batch, Cells, RenderOutput, Step
from voronerf.nerf.average import averages_in_place, drop_averages, update_averages
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.ray_loss import why_not_fused
from voronerf.ops import Guard
from voronerf.ops._core import backends
from voronerf.ops.adam.reference import judge
from voronerf.router import VoronoiRouter

#: On a GPU, steps between two times that the host reads the loss and thereby waits for the device.
READ_EVERY = 50
#: The dtype of autocast for each precision but float32.
HALVES = {"bf16": torch.bfloat16, "fp16": torch.float16}
#: Entries of the last evaluation that summary.json repeats.
FIGURES = ("psnr", "ssim", "lpips", "psnr_of_mean_error", "views")


class Trainer:
    """Trains one scene by the whole method and keeps its run directory.

    Args:
        config: The settings; ``config.out`` names the run directory.
        scene: The scene that ``config.data`` names.
        on_step: Called after every step with a :class:`Progress`.
        on_event: Called with one line of text for each split and evaluation.
        clock: Counts the seconds of training; default ``time.perf_counter``.
        batches: Draws the rays; default from all training views of the scene.
        checkpoint: Of these settings, to go on from; default with ``config.resume`` the last one in ``config.out``.

    Raises:
        CheckpointError: With ``config.resume``, when there is no checkpoint or it is of another configuration.
    """

    def __init__(
        self,
        config: TrainConfig,
        scene: Scene,
        *,
        on_step: Callable[[Progress], None] | None = None,
        on_event: Callable[[str], None] | None = None,
        clock: Callable[[], float] | None = None,
        batches: RayBatches | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        if config.out is None:
            raise ValueError("Trainer: config.out must name the run directory, got None")
        if config.resume:
            checkpoint = last_checkpoint(config.out)
        self.out, self.scene = config.out, scene
        self.on_step, self.on_event, self.clock = on_step, on_event, clock or time.perf_counter
        self.device = torch.device(config.device)
        config = resolve_config(config, scene)
        check_memory(config)
        if config.resume and checkpoint is not None:
            state.check_resumed(config, checkpoint)
        self.config, self.plan = config, config.planned_splits
        check_backend(config, self.device)
        self.generator = torch.Generator().manual_seed(config.seed)
        # Random numbers are drawn on the device that uses them: the host need not wait, and a graph can draw them.
        self.draws = self.generator
        if self.device.type == "cuda":
            self.draws = torch.Generator(self.device).manual_seed(config.seed)
        self.lpips, self.lpips_source = find_lpips(config.lpips, config.data, scene.test.cameras.smallest[::-1])
        self.batches = batches or RayBatches(
            scene,
            self.device,
            cones=config.field_type.cones,
            sightings=bool(config.sightings),
            appearance=Appearance(len(scene.train.names), self.device) if config.appearance else None,
            refinement=Refinement(scene.train.cameras.to(self.device)) if config.refine_cameras else None,
            backend=config.backend,
        )
        self.routers = make_routers(config, self.device)
        for router in self.routers.values():
            router.generator = self.draws
        #: Whether native ops compute the networks: then steps are the same bit for bit on any number of threads.
        self.thread_deterministic = computes_natively(self.routers, config)
        self.optimizer = make_optimizer(self.routers, config, views=len(scene.train))
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=config.precision == "fp16")
        grid = make_grid(config, scene, self.device) if config.occupancy else None
        self.renderer = make_renderer(config, scene, self.routers, occupancy=grid)
        self.cells = Cells(
            self.renderer,
            self.routers,
            self.plan,
            config.split_rule,
            generator=self.generator,
        )
        self.learner = Step(self.renderer, sightings=config.sightings or 0.0)
        obstacle = why_not_fused(self.renderer)
        if config.refine_cameras and obstacle is not None:
            raise ConfigError(f"--refine-cameras must be off where a step is not one operation: {obstacle}")
        self.guard = Guard.on(self.device)  # of steps whose loss or gradients are not finite
        self.rate_factor = 1.0  # 0.5 after a divergence
        self.one_colour: float | None = None
        self.step, self.seconds = 0, 0.0
        self._rows: Tensor | None = None  # how many samples the last step had, where no host has read it
        #: Seconds of all evaluations but the last, and of a view in the latest.
        self.scoring, self.view_seconds = 0.0, 0.0
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
        self._begin_stage()

    @property
    def skipped(self) -> int:
        """Steps that were left out, since a loss or gradients were not finite; waits for the device."""
        return int(self.guard.skipped)

    @property
    def router(self) -> VoronoiRouter:
        """The router whose colours count."""
        return self.routers["field"]

    @property
    def diagram(self) -> VoronoiDiagram:
        """All cells of the run."""
        return self.cells.diagram

    @property
    def occupancy(self) -> OccupancyGrid | None:
        """The grid of what is empty."""
        return self.renderer.occupancy

    @property
    def learnt_of_pictures(self) -> dict[str, Appearance | Refinement]:
        """What is learnt of each training picture beside the field, by the names of a checkpoint."""
        learnt = {"appearance": self.batches.appearance, "cameras": self.batches.refinement}
        return {name: each for name, each in learnt.items() if each is not None}

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
        return min(1.0, self.seconds / self._training_time)

    @property
    def _training_time(self) -> float:
        """Seconds of the budget for training: what evaluations have taken, and the last one will take, is less."""
        budget = float(self.config.budget or 1.0)
        if not self._counts_evaluation:
            return budget
        views = len(self.scene.test.names)
        last = self.view_seconds * min(views, self.config.final_views or views)
        if self.config.final_views is None:
            last = min(last, self.config.evaluation_share * budget / 2)
        return max(budget - self.scoring - last, 1e-9)

    @property
    def _counts_evaluation(self) -> bool:
        """Whether evaluations are part of the budget."""
        return self.config.budget is not None and self.config.evaluation_share > 0

    @property
    def level(self) -> int:
        """Splits done."""
        return self.cells.splits

    def learning_rate(self) -> float:
        """Of the next step, see :func:`voronerf.app.train.rates.learning_rate`; half of it after a divergence."""
        return learning_rate(self.config, self.fraction, self.step) * self.rate_factor

    def averaged(self) -> AbstractContextManager[None]:
        """A context in which the networks have their averaged weights, for pictures; not for training."""
        return averages_in_place(self.optimizer)

    def request_stop(self) -> None:
        """Ends training after the step or the view in hand, with a checkpoint, as Ctrl-C does."""
        self.stopped = True

    def _count(self, started: float) -> None:
        """Counts the time since then."""
        self.seconds += self.clock() - started

    # --- the loop ------------------------------------------------------------------------------------------------

    def run(self) -> dict[str, Any]:
        """Trains to the end of the budget, or until :meth:`request_stop`; returns what ``summary.json`` holds.

        Raises:
            TrainingError: When the loss or the moments stop being finite, with half the learning rate again or before
                the first checkpoint; the last checkpoint is left as it was.
            OSError: When a checkpoint cannot be written.
        """
        self.train()
        if self.fraction >= 1:
            self.stopped = False  # a stop that came in the last step has nothing to end
            left = len(self.plan) - self.level
            if left:
                self.say(f"Run ended before {left} of {len(self.plan)} planned splits.")
            self._evaluate(self.config.final_views, self.lpips, last=True)
        return self._summarise()

    def train(self) -> None:
        """Trains to the end and saves, as :meth:`run` does before the last evaluation.

        Raises:
            TrainingError: As :meth:`run`.
            OSError: As :meth:`run`.
        """
        self.advance()
        while not self._check_moments():
            self.advance()
        self.save()

    def advance(self, until: float = math.inf) -> None:
        """Trains until ``until`` training seconds or the end of the budget, whichever comes first.

        :meth:`run` calls it once, and evaluates. Calls in turns let several trainers share a machine, so that its noise
        affects all of them alike.

        Raises:
            TrainingError: As :meth:`run`.
            OSError: As :meth:`run`.
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
            self._count(started)
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
            if self.fraction >= 1:
                started = self.clock()
                with self.averaged():
                    self.cells.fill_holes(self.config.seed)
                self._count(started)
        self.writer.wait()

    def _read(self, loss: Tensor) -> None:
        """Waits for a step's loss; the wait is training time.

        Raises:
            TrainingError: When steps are skipped again and again, see :meth:`_go_back`.
        """
        started = self.clock()
        figures = [loss.float(), self.guard.in_a_row]
        if self._rows is not None:
            figures.append(self._rows[0].float())
        self.loss, in_a_row, *samples = torch.stack(figures).tolist()
        if samples and self.occupancy is not None:
            rays = next_rays(self.config, self.rays, int(samples[0]))
            if self.config.cuda_graph:  # which is captured anew for other numbers of rays
                rays -= rays % self.config.rays
            if rays != self.rays:
                self.rays = rays
                self._begin_stage()
        self._count(started)
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
        at = self.step
        check_can_go_back(self.out, reason, at, self.rate_factor)
        skipped = self.skipped
        self._resume(last_checkpoint(self.out))
        self.guard = Guard.on(self.device, skipped)
        self.rate_factor = 0.5
        self.saved_at = self.seconds
        self._begin_stage()
        self.say(f"{reason} at step {at}: back to step {self.step}, with half the learning rate")

    def _begin_stage(self) -> None:
        """After parameters have become others: ends the CUDA graph of the old ones."""
        graphed = self.config.cuda_graph
        self._compute = GraphedStep(self._forward_backward, [self.draws]) if graphed else self._forward_backward

    def train_step(self) -> Tensor:
        """One step of :meth:`advance` without its count and clock; returns the loss, which may not be computed yet."""
        with backends.torch_on_one_thread() if self.thread_deterministic else nullcontext():
            self.prepare()
            loss, kept = self._compute()
            self.finish(kept)
            return loss

    def prepare(self) -> None:
        """What comes before the batch of a step."""
        set_learning_rate(self.optimizer, self.learning_rate())
        self.cells.revisit(self.step)
        if not self.router.training:
            self.renderer.train()

    def _forward_backward(self) -> tuple[Tensor, Tensor]:
        """Draws a batch and learns from it; returns what :meth:`learn` does."""
        batch, refinement = self.draw(), self.batches.refinement
        moves = refinement is not None and self.step >= START and self.step % EVERY == 0
        if moves:
            batch = Refinement.asked(batch)
        self.optimizer.zero_grad(set_to_none=True)
        with self.precision():
            found = self.learner.run(batch, self.draws, backward=self.config.precision == "fp32")
        if self.batches.appearance is not None and found.colour is not None:
            self.batches.appearance.learn(batch, found.colour)
        if moves and refinement is not None:
            refinement.learn(batch, self.learning_rate() / float(self.config.lr or 1.0))
        return self.learn(found)

    def draw(self, share: float = 1.0) -> Batch:
        """The batch of a step; ``share`` is a factor on its rays."""
        rays = max(1, round(share * self.rays))
        return self.batches.draw(rays, self.draws, random_background=self.config.background == "random")

    def precision(self) -> AbstractContextManager[Any]:
        """In which the networks are asked."""
        half = HALVES.get(self.config.precision)
        return nullcontext() if half is None else torch.autocast(self.device.type, half, cache_enabled=False)

    def learn(self, found: RenderOutput) -> tuple[Tensor, Tensor]:
        """Updates the parameters after gradients were dropped and a step has found these, or a loss that has them.

        Returns:
            The loss, and the heaviest samples [n, 4], until the last split.
        """
        if found.loss.requires_grad:
            self.scaler.scale(found.loss).backward()
        loss = found.loss.detach()
        self._rows = found.samples.rows
        self.cells.observe(found)
        if self.occupancy is not None and self._rows is None:
            self.rays = next_rays(self.config, self.rays, len(found.weights))
        # Nothing is read on the host: the optimiser leaves out a step by what is found on the device.
        if self.scaler.is_enabled():
            judge(self.guard, loss, [])
            self.scaler.step(self.optimizer)
            self.scaler.update()
        else:
            self.optimizer.update(self.guard, loss)
        return loss, self.cells.heaviest(found)

    def finish(self, kept: Tensor) -> None:
        """What comes after a step that :meth:`learn` made."""
        if self.step % SHRINK_EVERY == 0:
            self.optimizer.shrink(SHRINK_EVERY)
        if self.config.average:
            update_averages(self.optimizer, self.config.average, self.step)
        if len(kept):
            self.cells.reservoir.add(kept[:, :3], kept[:, 3])

    # --- cells -----------------------------------------------------------------------------------------------------

    def split_is_due(self) -> bool:
        """Whether :meth:`advance` splits before the next step."""
        now = self.fraction if self.config.split_unit == "fraction" else float(self.step)
        return self.cells.is_due(now, self.step)

    def split(self) -> None:
        """Splits the cells by the kept samples; cells that hold too few of them stay as they are."""
        with backends.torch_on_one_thread() if self.thread_deterministic else nullcontext():
            if self._split():  # else the reservoir goes on collecting samples
                self.cells.empty_reservoir()
                self._begin_stage()

    def _split(self) -> bool:
        """Makes the split that is due, as far as the cells hold enough samples; False to try again later.

        Raises:
            TrainingError: When the first split has more cells than samples; after a checkpoint.
        """
        cells, level, k = self.cells, self.level, self.cells.children
        points, importance = cells.reservoir.samples()
        if level == 0 and len(points) < k:
            self.save()
            raise TrainingError(
                f"{self.out}: more cells than samples: --cells asks for {k}, {len(points)} samples were kept in "
                f"{self.step} steps; in another --out, split later or keep more a batch (--reservoir, "
                "--reservoir-batches)"
            )
        split = cells.find_split()
        balances = [] if split is None else list(split.balances.values())
        if self.plan[level].most is not None and not balances:
            return False
        kept = io.BytesIO()  # which benchmarks/balance.py can read
        np.savez(kept, points=points.cpu().numpy(), importance=importance.cpu().numpy())
        write_bytes(self.out / "samples" / f"level-{level + 1}.npz", kept.getvalue())
        if split is not None and balances:
            cells.divide(split, self.optimizer)
        if self.config.init == "random":  # the averages are of other networks
            drop_averages(self.optimizer)
        before, after = (
            _median([getattr(balance, name) for balance in balances])
            for name in ("imbalance_before", "imbalance_after")
        )
        now, when = self.diagram.num_cells, f"at {self.seconds:.0f} s, step {self.step}"
        self.stages.append(Stage(now, self.seconds, self.step, before, after, len(balances)))
        cells.splits += 1
        if balances:
            self.say(f"{now} cells {when}, imbalance of their importance {before:.3f} -> {after:.4f}")
        else:
            need = max(k, self.config.min_cell_samples)
            self.say(f"no cell split {when}: none holds {need} of the {len(points)} samples kept")
        return True

    # --- evaluation and files --------------------------------------------------------------------------------------

    def _due(self) -> int:
        """Number of evaluations that are due by now."""
        return int(self.fraction * self.config.evaluations + 1e-9)

    def _evaluate(self, views: int | None, lpips: Lpips | None = None, *, last: bool = False) -> None:
        """Scores test views; where a stop is asked for meanwhile, not all of them, and without a trace."""
        count = self._affordable(views, lpips, last) if self._counts_evaluation else views
        scores = [] if count == 0 else self._score(count, lpips, last)[0]
        if self.stopped:
            return
        self.evaluated = self._due()
        if scores:
            self._record(scores)

    def _affordable(self, views: int | None, lpips: Lpips | None, last: bool) -> int:
        """How many of the views the share of the budget allows, from what one takes; 0 to leave out an evaluation."""
        every, share = len(self.scene.test.names), self.config.evaluation_share
        wanted, budget = every if views is None else min(views, every), float(self.config.budget or 0.0)
        if last and self.config.final_views is not None:
            return wanted
        one, probed = self.view_seconds, 0.0
        if one == 0 or lpips is not None:
            one = probed = self._score(1, lpips, last)[1]
        left = share * budget - self.scoring - probed if last else share / 2 * self.seconds - self.scoring
        return min(wanted, max(int(left / max(one, 1e-9)), int(last)))

    def _score(self, views: int | None, lpips: Lpips | None, last: bool) -> tuple[list[ViewScore], float]:
        """Scores of test views, and the seconds that they took, which are counted before the last evaluation."""
        started = self.clock()
        with self.averaged():
            scores = evaluate(self.renderer, self.scene, views=views, lpips=lpips, stop=lambda: self.stopped)
        passed = self.clock() - started
        if not last:
            self.scoring += passed
            self.view_seconds = passed / max(len(scores), 1)
        return scores, passed

    def _record(self, scores: list[ViewScore]) -> None:
        """Adds an evaluation to ``metrics.jsonl`` and tells it, with what makes it poor."""
        now = {
            "step": self.step,
            "seconds": round(self.seconds, 3),
            "cells": self.diagram.num_cells,
            "learning_rate": self.learning_rate(),
            "views": len(scores),
            **mean_scores(scores),
        }
        self.metrics = [m for m in self.metrics if m["step"] < self.step] + [now]
        write_text(self.out / "metrics.jsonl", "".join(json_text(m) + "\n" for m in self.metrics))
        self.say(
            f"{self.seconds:7.1f} s  step {self.step:6d}  {self.diagram.num_cells:4d} cells  "
            f"psnr {now['psnr']:6.2f}  ssim {now['ssim']:.4f}  ({len(scores)} views)"
        )
        if self.one_colour is None:
            self.one_colour = one_colour_psnr(self.scene)
        settled = self.step >= SETTLED and self.fraction >= 0.5
        poor = why_scores_are_poor(self.metrics, self.config, self.one_colour, settled=settled)
        if poor is not None:
            self.say(poor)

    def _summarise(self) -> dict[str, Any]:
        """Writes ``summary.json``; returns what it holds."""
        summary = {
            **{key: self.metrics[-1].get(key) if self.metrics else None for key in FIGURES},
            "complete": self.fraction >= 1 and not self.stopped,
            "seconds": self.seconds,
            "steps": self.step,
            "rays_per_second": self.rays_done / max(self.seconds, 1e-9),
            "parameters": self.parameter_count,
            "cells": self.diagram.num_cells,
            "splits_left": len(self.plan) - self.level,
            "skipped_steps": self.skipped,
            "width": self.config.width,
            "stages": [asdict(stage) for stage in self.stages],
        }
        write_text(self.out / "summary.json", json_text(summary, indent=2) + "\n")
        return summary

    def save(self, *, wait: bool = True) -> None:
        """Writes ``checkpoints/last.safetensors``; without ``wait`` it is begun, and :attr:`writer` ends it."""
        refinement = self.batches.refinement
        if not self.described:  # not earlier: a run whose first step fails leaves nothing
            write_text(self.out / "config.json", self.config.to_json())
        if refinement is not None or not self.described:
            write_scene(self.out / "scene.json", self.scene)
        self.described = True
        self.writer.write(self.state())
        self.saved_at = self.seconds
        if wait:
            self.writer.wait()

    def state(self) -> Checkpoint:
        """All that a training needs to go on bit for bit: parameters, moments, samples, random numbers, counters."""
        stored = state.Stored(
            config=self.config.to_values(),
            step=self.step,
            seconds=self.seconds,
            rays=self.rays,
            rays_done=self.rays_done,
            stages=tuple(asdict(stage) for stage in self.stages),
            evaluated=self.evaluated,
            scoring=self.scoring,
            view_seconds=self.view_seconds,
            skipped=self.skipped,
            rate_factor=self.rate_factor,
            threads=torch.get_num_threads(),
        )
        parts = {
            "reservoir": self.cells.reservoir.state_dict(),
            "generator": {"state": self.generator.get_state(), "draws": self.draws.get_state()},
        }
        if self.occupancy is not None:
            parts["occupancy"] = self.occupancy.state_dict()
        for name, learnt in self.learnt_of_pictures.items():
            parts[name] = learnt.state_dict()
        if self.scaler.is_enabled():
            parts["scaler"] = self.scaler.state_dict()
        return state.collect(stored, self.routers, self.optimizer, parts)

    def _resume(self, checkpoint: Checkpoint) -> None:
        """Puts this trainer where the training was that wrote a checkpoint of its settings; it gets a new optimiser.

        Raises:
            CheckpointError: When something is missing or does not fit.
        """
        _, stored = state.stored_values(checkpoint)
        restore_routers(self.routers, checkpoint)
        self.optimizer = make_optimizer(self.routers, self.config, views=len(self.scene.train))
        try:
            state.load_moments(self.optimizer, checkpoint, stored.step)
            self.scaler.load_state_dict({name: value.item() for name, value in checkpoint.group("scaler").items()})
            if self.occupancy is not None:
                self.occupancy.load_state_dict(checkpoint.group("occupancy"))
            for name, learnt in self.learnt_of_pictures.items():
                learnt.load_state_dict(checkpoint.group(name))
            self.cells.reservoir.load_state_dict(checkpoint.group("reservoir"))
            generators = checkpoint.group("generator")
            self.generator.set_state(generators["state"])
            drawn = generators["draws"]
            if self.draws is not self.generator and drawn.shape == self.draws.get_state().shape:
                self.draws.set_state(drawn)  # else the run began on another kind of device
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            raise CheckpointError(f"{checkpoint.source}: not a checkpoint of a training: {error}") from None
        threads = torch.get_num_threads()
        if stored.threads != threads and self.device.type == "cpu" and not self.thread_deterministic:
            self.say(
                f"not bit for bit: {checkpoint.source} was written on {stored.threads} threads, now there are {threads}"
                ", and torch computes these networks"
            )
        self.step, self.seconds = stored.step, stored.seconds
        self.scoring, self.view_seconds = stored.scoring, stored.view_seconds
        self.rays, self.rays_done = stored.rays, stored.rays_done
        self.stages = [Stage(**stage) for stage in stored.stages]
        self.cells.splits = len(self.stages) - 1
        self.guard = Guard.on(self.device, stored.skipped)
        self.rate_factor = stored.rate_factor
        self.evaluated = min(stored.evaluated, self._due())  # fewer where the run was made longer
        # Evaluations made after the checkpoint will be made again.
        self.metrics = [m for m in read_metrics(self.out) if m["step"] <= self.step]

    def say(self, line: str) -> None:
        """Tells whoever listens, see ``on_event``."""
        if self.on_event is not None:
            self.on_event(line)


def _median(values: list[float]) -> float | None:
    """The median, of an even number the lower middle value; None for an empty list."""
    return float(torch.tensor(values).median()) if values else None
