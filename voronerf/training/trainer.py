"""The training loop: coarse stage, splits, local stages; evaluations and checkpoints on the way.

Time means training time: steps and splits count, evaluations and checkpoints do not.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.data import Scene
from voronerf.diagram import VoronoiDiagram
from voronerf.fields import NeRF
from voronerf.rendering.volume import render_rays
from voronerf.router import VoronoiRouter
from voronerf.subdivision import split_diagram
from voronerf.training.batches import RayBatches
from voronerf.training.checkpoint import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_optimizer_tensors,
    optimizer_tensors,
    save_checkpoint,
    write_text,
)
from voronerf.training.config import TrainConfig, differences
from voronerf.training.evaluation import ViewScore, evaluate, mean_scores
from voronerf.training.reservoir import SampleReservoir


class TrainingError(RuntimeError):
    """Training cannot go on; the message says why and what is left on disk."""


@dataclass(frozen=True)
class Stage:
    """A period of training on one diagram.

    ``balance_before`` and ``balance_after`` are std(W / max W) over the new cells of one parent, the median over the
    parents that were split; None for the coarse stage.
    """

    cells: int
    started_at_second: float
    started_at_step: int
    balance_before: float | None
    balance_after: float | None
    split_cells: int


@dataclass(frozen=True)
class Progress:
    """What a display shows of a running training; one is passed to the caller's callback after every step."""

    step: int
    seconds: float
    fraction: float
    loss: float
    rays_per_second: float
    cells: int
    psnr: float | None


def make_field(config: TrainConfig) -> NeRF:
    """The field that a configuration describes, freshly initialised from torch's global generator."""
    return NeRF(
        width=config.width,
        depth=config.depth,
        skips=config.skips,
        position_octaves=config.position_octaves,
        direction_octaves=config.direction_octaves,
        view_directions=config.view_directions,
    )


def make_router(config: TrainConfig) -> VoronoiRouter:
    """A router of one cell around the configured field: the coarse stage. Depends on the seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        field = make_field(config)
    router = VoronoiRouter(
        field,
        VoronoiDiagram(torch.zeros(1, 3)),
        assignment=config.assignment,
        temperature=config.temperature,
        backend=config.backend,
    )
    return router.to(config.device)


class Trainer:
    """Trains one scene by the whole method and keeps its run directory.

    Args:
        config: The settings; ``config.out`` names the run directory.
        scene: The scene that ``config.data`` names.
        on_step: Called after every step with a :class:`Progress`.
        on_event: Called with one line of text for each split and evaluation.

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
    ) -> None:
        if config.out is None:
            raise ValueError("Trainer: config.out must name the run directory, got None")
        self.config = config
        self.scene = scene
        self.out = config.out
        self.on_step = on_step
        self.on_event = on_event
        self.device = torch.device(config.device)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.batches = RayBatches(scene, self.device)
        self.background = scene.background_colour(self.device)
        self.router = make_router(config)
        self.router.generator = self.generator
        self.optimizer = torch.optim.Adam(self.router.parameters(), lr=config.lr, eps=1e-15, fused=True)
        self.reservoir = SampleReservoir(config.reservoir, config.reservoir_batches)
        self.step = 0
        self.seconds = 0.0
        self.stages = [Stage(1, 0.0, 0, None, None, 0)]
        self.evaluated = 0
        self.last: dict[str, Any] = {}
        self.stopped = False
        if config.resume:
            self._load()
        write_text(self.out / "config.json", config.to_json())

    # --- progress ------------------------------------------------------------------------------------------------

    @property
    def fraction(self) -> float:
        """How much of the run is done, 0..1."""
        if self.config.steps is not None:
            return min(1.0, self.step / self.config.steps)
        return min(1.0, self.seconds / float(self.config.budget or 1.0))

    @property
    def level(self) -> int:
        """Splits done."""
        return len(self.stages) - 1

    def learning_rate(self) -> float:
        """Exponential decay from ``lr`` to ``lr * lr_final``, after a linear rise over the warm-up."""
        config, done = self.config, self.fraction
        rise = 1.0 if done >= config.warmup else 0.01 + 0.99 * done / config.warmup
        return config.lr * rise * math.exp(math.log(config.lr_final) * done)

    def request_stop(self) -> None:
        """Ends training after the step in hand, with a checkpoint; what Ctrl-C does."""
        self.stopped = True

    # --- the loop ------------------------------------------------------------------------------------------------

    def run(self) -> dict[str, Any]:
        """Trains to the end of the budget, or until :meth:`request_stop`; returns what ``summary.json`` holds.

        Raises:
            TrainingError: When the loss stops being finite; the last checkpoint is left as it was.
            OSError: When a checkpoint cannot be written.
        """
        self.advance()
        self.save()
        if not self.stopped:
            self._evaluate(self.config.evaluations, self.config.final_views)
        return self._summarise()

    def advance(self, until: float = math.inf) -> None:
        """Trains until ``until`` training seconds or the end of the budget, whichever comes first.

        :meth:`run` is this, once, and the final evaluation; calling it in turns lets several trainers share a machine
        so that its noise falls on all of them alike.

        Raises:
            As :meth:`run`.
        """
        saved_at = self.seconds
        while self.fraction < 1 and self.seconds < until and not self.stopped:
            started = time.perf_counter()
            if self.level < len(self.config.cells) and self.fraction >= self.config.splits[self.level]:
                self._split()
            loss = self._step()
            self.step += 1
            self.seconds += time.perf_counter() - started
            if not math.isfinite(loss):
                raise TrainingError(
                    f"the loss is {loss} at step {self.step}; the last checkpoint in {self.out} is untouched; "
                    "a smaller --lr helps"
                )
            if self.on_step is not None:
                speed = self.step * self.config.rays / max(self.seconds, 1e-9)
                psnr = self.last.get("psnr")
                self.on_step(Progress(self.step, self.seconds, self.fraction, loss, speed, self.router.num_cells, psnr))
            due = int(self.fraction * self.config.evaluations + 1e-9)
            if due > self.evaluated and self.fraction < 1:
                self._evaluate(due, self.config.eval_views)
            if self.seconds - saved_at >= self.config.checkpoint_every:
                self.save()
                saved_at = self.seconds

    def _step(self) -> float:
        config = self.config
        rate = self.learning_rate()
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        batch = self.batches.draw(config.rays, self.generator)
        background = self.background
        if batch.alpha is not None and config.background == "random":
            background = torch.rand(config.rays, 3, generator=self.generator).to(self.device)
        self.router.train()
        rendered = render_rays(
            self.router,
            batch.rays,
            batch.near,
            batch.far,
            samples=config.samples,
            background=background,
            jitter=True,
            generator=self.generator,
            spacing=self.scene.spacing,
            backend=config.backend,
        )
        error = (rendered.colour - batch.target(background)).square()
        loss = error.mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        if self.level < len(config.cells):
            # Importance of a sample: its weight in the image times its ray's error (section 3.1 of the paper).
            importance = rendered.weights.detach() * error.detach().sum(-1, keepdim=True)
            self.reservoir.add(rendered.positions.detach().reshape(-1, 3), importance.reshape(-1))
        return float(loss.detach())

    def _split(self) -> None:
        """Splits the cells by the kept samples; where there are too few of them, the diagram stays as it is."""
        config = self.config
        points, importance = self.reservoir.samples()
        split = split_diagram(
            self.router.diagram,
            points,
            importance,
            config.cells[self.level],
            cells="all" if self.level == 0 else config.split,
            centres=config.centres,
            method=config.balance,
            min_samples=config.min_cell_samples,
            generator=self.generator,
            backend=config.backend,
        )
        before = [b.imbalance_before for b in split.balances.values()]
        after = [b.imbalance_after for b in split.balances.values()]
        self.router.subdivide(split.diagram, split.parents, optimizer=self.optimizer, inherit=config.init == "inherit")
        self.stages.append(
            Stage(self.router.num_cells, self.seconds, self.step, _median(before), _median(after), len(before))
        )
        _save_samples(self.out / "samples" / f"level-{self.level}.npz", points, importance)
        self.reservoir = SampleReservoir(config.reservoir, config.reservoir_batches)
        balance = f", std(W / max W) {before_after(self.stages[-1])}" if before else ""
        self._say(f"split into {self.router.num_cells} cells at {self.seconds:.0f} s, step {self.step}{balance}")

    # --- evaluation and files --------------------------------------------------------------------------------------

    def _evaluate(self, number: int, views: int | None) -> list[ViewScore]:
        self.evaluated = number
        scores = evaluate(
            self.router, self.scene, samples=self.config.samples, views=views, backend=self.config.backend
        )
        self.last = {
            "step": self.step,
            "seconds": round(self.seconds, 3),
            "cells": self.router.num_cells,
            "learning_rate": self.learning_rate(),
            "views": len(scores),
            **mean_scores(scores),
        }
        with open(self.out / "metrics.jsonl", "a") as file:
            file.write(json.dumps(self.last) + "\n")
        self._say(
            f"{self.seconds:7.1f} s  step {self.step:6d}  {self.router.num_cells:4d} cells  "
            f"psnr {self.last['psnr']:6.2f}  ssim {self.last['ssim']:.4f}  ({len(scores)} views)"
        )
        return scores

    def _summarise(self) -> dict[str, Any]:
        summary = {
            "psnr": self.last.get("psnr"),
            "ssim": self.last.get("ssim"),
            "views": self.last.get("views"),
            "complete": self.fraction >= 1,
            "seconds": self.seconds,
            "steps": self.step,
            "rays_per_second": self.step * self.config.rays / max(self.seconds, 1e-9),
            "parameters": sum(p.numel() for p in self.router.parameters()),
            "cells": self.router.num_cells,
            "stages": [asdict(stage) for stage in self.stages],
        }
        write_text(self.out / "summary.json", json.dumps(summary, indent=2) + "\n")
        return summary

    def save(self) -> None:
        """Writes ``checkpoints/last.safetensors``."""
        tensors: dict[str, Tensor] = {}
        parts = {
            "router": self.router.state_dict(),
            "optimizer": optimizer_tensors(self.optimizer),
            "reservoir": self.reservoir.state_dict(),
            "generator": {"state": self.generator.get_state()},
        }
        for prefix, group in parts.items():
            tensors |= {f"{prefix}.{name}": torch.as_tensor(value) for name, value in group.items()}
        values = {
            "config": json.loads(self.config.to_json()),
            "step": self.step,
            "seconds": self.seconds,
            "evaluated": self.evaluated,
            "last": self.last,
            "stages": [asdict(stage) for stage in self.stages],
        }
        save_checkpoint(checkpoint_path(self.out), Checkpoint(tensors, values))

    def _load(self) -> None:
        path = checkpoint_path(self.out)
        checkpoint = load_checkpoint(path)
        stored = TrainConfig.from_json(json.dumps(checkpoint.values["config"]), str(path))
        different = differences(stored, self.config)
        if different:
            raise CheckpointError(f"{path}: a checkpoint of another configuration: {'; '.join(different)}")
        restore_router(self.router, checkpoint)
        self.optimizer = torch.optim.Adam(self.router.parameters(), lr=self.config.lr, eps=1e-15, fused=True)
        load_optimizer_tensors(self.optimizer, checkpoint.group("optimizer"))
        self.reservoir.load_state_dict(checkpoint.group("reservoir"))
        self.generator.set_state(checkpoint.group("generator")["state"])
        self.step = checkpoint.values["step"]
        self.seconds = checkpoint.values["seconds"]
        self.evaluated = checkpoint.values["evaluated"]
        self.last = checkpoint.values["last"]
        self.stages = [Stage(**stage) for stage in checkpoint.values["stages"]]
        _drop_later_lines(self.out / "metrics.jsonl", self.step)

    def _say(self, line: str) -> None:
        if self.on_event is not None:
            self.on_event(line)


def checkpoint_path(run: Path) -> Path:
    """Where a run directory keeps its last checkpoint."""
    return run / "checkpoints" / "last.safetensors"


def restore_router(router: VoronoiRouter, checkpoint: Checkpoint) -> None:
    """Fills a router with a checkpoint's cells, whatever the number of them.

    Raises:
        CheckpointError: When the checkpoint's parameters are of another architecture.
    """
    state = checkpoint.group("router")
    try:
        router.load_state_dict(state)
    except RuntimeError as error:
        raise CheckpointError(f"the checkpoint is of another architecture: {str(error).splitlines()[-1]}") from None


def load_run(run: Path, *, device: str = "cpu", backend: str = "auto") -> tuple[TrainConfig, VoronoiRouter]:
    """The configuration and the trained router of a run directory.

    Raises:
        CheckpointError: When ``run`` holds no usable checkpoint.
    """
    path = checkpoint_path(run)
    checkpoint = load_checkpoint(path)
    config = TrainConfig.from_json(json.dumps(checkpoint.values["config"]), str(path))
    router = make_router(config)
    restore_router(router, checkpoint)
    router.backend = backend
    return config, router.to(device).eval()


def before_after(stage: Stage) -> str:
    """ "0.25 -> 0.002", the balance of a stage's split."""
    return f"{stage.balance_before:.3f} -> {stage.balance_after:.4f}"


def _median(values: list[float]) -> float | None:
    return float(torch.tensor(values).median()) if values else None


def _save_samples(path: Path, points: Tensor, importance: Tensor) -> None:
    """The samples that a split was made from, for a later look (and ``benchmarks/balance.py``)."""
    import io

    import numpy as np

    from voronerf.training.checkpoint import write_bytes

    buffer = io.BytesIO()
    np.savez(buffer, points=points.cpu().numpy(), importance=importance.cpu().numpy())
    write_bytes(path, buffer.getvalue())


def _drop_later_lines(path: Path, step: int) -> None:
    """Takes out the evaluations made after the checkpoint that a run is continued from."""
    if path.is_file():
        lines = [line for line in path.read_text().splitlines() if json.loads(line)["step"] <= step]
        write_text(path, "".join(line + "\n" for line in lines))
