"""Callbacks of a training: checkpoints, scores, a check for divergence, TensorBoard."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from voronerf.app.evaluate.lpips import Lpips
from voronerf.app.evaluate.scores import Track, ViewScore, evaluate, in_silence, mean_scores, view_numbers
from voronerf.app.files import json_text, write_bytes, write_text
from voronerf.app.scenes import Scene
from voronerf.app.scenes.record import write_scene
from voronerf.app.train.checkpoint import CheckpointWriter, checkpoint_paths
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.loop import Callback, TrainingError
from voronerf.app.train.resume import snapshot
from voronerf.app.train.run_directory import read_metrics
from voronerf.app.train.state import State
from voronerf.nerf.schedule import GROUP
from voronerf.nerf.split import MIN_SAMPLES, SplitDone

#: Seconds of training between checkpoints, and how many are kept.
CHECKPOINT_EVERY, KEPT = 30.0, 3
#: Share of the budget for evaluations, half of it for the final one; and the most views of one on the way.
SHARE, VIEWS = 0.1, 20
#: About the pixels that are rendered to learn what a view takes, and the least side of a part of one, for LPIPS.
PROBE, PROBE_SIDE = 1024, 31
#: The most views whose middle is scored where time is short for one.
PARTS = 8
#: Side of the corner of a view that tells what LPIPS takes.
LPIPS_PROBE = 128
#: Entries of the last evaluation that summary.json repeats.
FIGURES = ("psnr", "ssim", "lpips", "psnr_of_mean_error", "views", "part")
#: Skipped steps in a row after which waiting is of no use.
PATIENCE = 10
#: Decibels below the best evaluation so far that are a collapse.
COLLAPSE = 5.0
#: A run is compared with pictures of one colour from its middle on, and from this step.
SETTLED = 100


class Checkpoints(Callback):
    """Writes a checkpoint now and then, beside the training, and at the end; and the samples of each split.

    Args:
        out: The run directory.
        every: Seconds of training between two checkpoints.
    """

    group = GROUP

    def __init__(self, out: Path, every: float = CHECKPOINT_EVERY) -> None:
        self.out, self.every = out, every
        self.writer = CheckpointWriter(out, KEPT)
        self.saved_at, self.described = 0.0, False

    def on_start(self, state: State) -> None:
        """Counts from the state's time on."""
        self.saved_at = state.seconds

    def after_split(self, state: State, done: SplitDone) -> None:
        """Writes the samples that decided a split, and says what it made."""
        kept, stage = io.BytesIO(), state.stages[-1]  # benchmarks/paper/balance.py reads them
        np.savez(kept, points=done.points.cpu().numpy(), importance=done.importance.cpu().numpy())
        write_bytes(self.out / "samples" / f"level-{state.strategy.splits}.npz", kept.getvalue())
        when = f"at {state.seconds:.0f} s, step {state.step}"
        if stage.split_cells:
            balance = f", imbalance of their importance {stage.balance_before:.3f} -> {stage.balance_after:.4f}"
            state.report(
                f"{counted(stage.cells, 'cell')} {when}{balance if state.config.centres == 'balanced' else ''}"
            )
        else:
            state.report(f"no cell split {when}: none holds {MIN_SAMPLES} of the {len(done.points)} samples kept")

    def after_step(self, state: State) -> None:
        """Begins to write a checkpoint when it is time, unless one is being written."""
        if state.seconds - self.saved_at >= self.every and not self.writer.busy:
            self.save(state)

    def on_end(self, state: State) -> None:
        """Writes the last checkpoint, and waits for it."""
        self.save(state)
        self.writer.wait()

    def save(self, state: State) -> None:
        """Begins to write a checkpoint, after the one before.

        Raises:
            TrainingError: When parameters or moments are not finite; the last checkpoint stays as it was.
            OSError: When the one before could not be written.
        """
        if not all_finite(state.optimizer):
            raise diverged(self.out, "parameters or moments of Adam not finite", state.step)
        if not self.described:  # not earlier: a run whose first step fails leaves nothing
            write_text(self.out / "config.json", state.config.to_json())
            write_scene(self.out / "scene.json", state.scene)
            self.described = True
        self.writer.write(snapshot(state))
        self.saved_at = state.seconds


class Divergence(Callback):
    """Ends a training whose gradients stop being finite.

    Args:
        out: The run directory, for the message.
    """

    group = GROUP

    def __init__(self, out: Path) -> None:
        self.out = out

    def after_step(self, state: State) -> None:
        """Raises TrainingError after `PATIENCE` steps that were left out in a row."""
        if state.skipped_in_a_row >= PATIENCE:
            raise diverged(self.out, f"gradients of {state.skipped_in_a_row} steps in a row not finite", state.step)


def diverged(out: Path, reason: str, step: int) -> TrainingError:
    """The error of a training that cannot continue."""
    kept = "the last checkpoint is unchanged" if checkpoint_paths(out) else "there is no checkpoint"
    return TrainingError(f"{out}: {reason} at step {step}, try a smaller --lr; {kept}")


def all_finite(optimizer: torch.optim.Optimizer) -> bool:
    """Whether all parameters of an optimiser and its moments are finite; reads all of them."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = [entry for state in optimizer.state.values() for entry in state.values() if isinstance(entry, Tensor)]
    return bool(get_total_norm([tensor.detach() for tensor in (*parameters, *moments)], math.inf).isfinite())


class Scores(Callback):
    """Scores test views at even times and at the end, into ``metrics.jsonl``, and writes ``summary.json``.

    With ``config.budget`` and without ``config.eval_views``, evaluations on the way take at most a twentieth of the
    time so far: fewer views are scored where that is too short, or none. All evaluations take at most a tenth of the
    budget. Where that is too short for one view at the end, the middle of it is scored.

    Args:
        out: The run directory; None to write nothing.
        lpips: For the final evaluation; None for none.
        track: Shows progress: yields the items of a sequence, and is given its name.
        clock: Counts seconds.

    Attributes:
        metrics: All evaluations, in order.
        summary: What ``summary.json`` holds, after the end.
    """

    group = GROUP

    def __init__(
        self,
        out: Path | None,
        lpips: Lpips | None = None,
        track: Track = in_silence,
        *,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.out, self.lpips, self.track, self.clock = out, lpips, track, clock
        self.metrics: list[dict[str, Any]] = []
        self.summary: dict[str, Any] = {}
        self.done, self.view_seconds, self.probe_seconds, self.one_colour = 0, 0.0, 0.0, math.nan

    def on_start(self, state: State) -> None:
        """Goes on after the evaluations that a resumed run has made."""
        if self.out is not None:
            self.metrics = [line for line in read_metrics(self.out) if line["step"] <= state.step]
        self.done = min(len(self.metrics), self._due(state))
        self.after_step(state)  # of one that was stopped

    def _due(self, state: State) -> int:
        return int(state.fraction * state.config.evaluations + 1e-9)

    def after_step(self, state: State) -> None:
        """Scores test views when it is time."""
        if self._due(state) > self.done and state.fraction < 1:
            self.done = self._due(state)
            self._evaluate(state, last=False)

    def on_end(self, state: State) -> None:
        """Scores the test views of a finished training, and writes the summary."""
        if state.fraction >= 1:
            state.clear_stop()
            if left := state.strategy.left:
                state.report(f"Run ended before {left} of {state.strategy.splits + left} planned splits.")
            self._evaluate(state, last=True)
        now = self.metrics[-1] if self.metrics else {}
        self.summary = {
            **{key: now.get(key) for key in FIGURES},
            "complete": state.fraction >= 1 and not state.stopped,
            "seconds": state.seconds,
            "steps": state.step,
            "rays_per_second": state.rays_done / max(state.seconds, 1e-9),
            "parameters": state.parameter_count,
            "cells": state.router.num_cells,
            "splits_left": state.strategy.left,
            "skipped_steps": state.skipped,
            "width": state.config.width,
            "stages": [asdict(stage) for stage in state.stages],
        }
        if self.out is not None:
            write_text(self.out / "summary.json", json_text(self.summary, indent=2) + "\n")

    def _evaluate(self, state: State, *, last: bool) -> None:
        """Scores test views; where a stop is asked for meanwhile, not all of them, and without a trace."""
        config, lpips, every = state.config, self.lpips if last else None, len(state.scene.test)
        views, middle = min(every, config.eval_views or (every if last else VIEWS)), 1
        left, started, budget = math.inf, self.clock(), None if config.eval_views else config.budget
        if budget is not None:
            left = (SHARE * budget if last else SHARE / 2 * state.seconds) - state.evaluation_seconds
            most = max(1, min(state.scene.test.cameras.smallest) // PROBE_SIDE)
            if not 0 < self.view_seconds <= left and 4 * self.probe_seconds <= left:
                self._probe(state, most)
            each = self.view_seconds + (0.0 if lpips is None else self._seconds_of(lpips, state))
            left -= self.clock() - started
            views = min(views, int(max(left, 0) / max(each, 1e-9)))
            if last and views < 1:
                afford = max(left, 1e-9) / max(each, 1e-9)  # views, of which this is less than one
                views = max(1, min(every, PARTS, int(afford * most**2)))
                middle = min(most, math.ceil(math.sqrt(views / afford)))
        if views:
            begun = self.clock()
            stop = lambda: state.stopped or self.clock() - begun > left  # noqa: E731
            scores = self._score(state, views, lpips, middle, stop=stop, track=self.track)
            if middle == 1:
                self.view_seconds = (self.clock() - begun) / len(scores)
            if not state.stopped:
                self._record(state, scores, middle)
        if budget is not None and not last:
            state.count_evaluation(self.clock() - started, min(self.view_seconds * every, SHARE / 2 * budget))

    def affordable(self, budget: float | None, most: int) -> int:
        """How many views a tenth of a budget in seconds allows, by what one took last; at least one."""
        return most if budget is None else max(1, min(most, int(SHARE * budget / max(self.view_seconds, 1e-9))))

    def _seconds_of(self, lpips: Lpips, state: State) -> float:
        """The seconds of LPIPS for a view, measured on a corner of it."""
        truth = state.scene.test.truth(0, state.scene.background_colour()).to(state.device)
        corner, started = truth[:LPIPS_PROBE, :LPIPS_PROBE], self.clock()
        float(lpips(corner, corner))
        return (self.clock() - started) * truth.numel() / corner.numel()

    def _probe(self, state: State, most: int) -> None:
        """Learns what a view takes from its middle, which is at most so many times narrower."""
        width, height = state.scene.test.cameras.size(0)
        factor, started = min(most, max(1, round(math.sqrt(width * height / PROBE)))), self.clock()
        self._score(state, 1, None, factor)
        self.probe_seconds = self.clock() - started
        self.view_seconds = self.probe_seconds * factor**2

    def _score(self, state: State, views: int, lpips: Lpips | None, middle: int, **options: Any) -> list[ViewScore]:
        with state.averaged():
            return evaluate(state.renderer, state.scene, views=views, lpips=lpips, middle=middle, **options)

    def _record(self, state: State, scores: list[ViewScore], middle: int) -> None:
        """Adds an evaluation to ``metrics.jsonl`` and says it, with what makes it poor."""
        now = {
            "step": state.step,
            "seconds": round(state.seconds, 3),
            "cells": state.router.num_cells,
            "learning_rate": state.learning_rate(),
            "views": len(scores),
            "part": 1 / middle**2,
            **mean_scores(scores),
        }
        self.metrics = [line for line in self.metrics if line["step"] < state.step] + [now]
        if self.out is not None:
            write_text(self.out / "metrics.jsonl", "".join(json_text(line) + "\n" for line in self.metrics))
        state.report(
            f"{state.seconds:7.1f} s  step {state.step:6d}  {now['cells']:4d} cell{'s' * (now['cells'] != 1)}  "
            f"psnr {now['psnr']:6.2f}  ssim {now['ssim']:.4f}  ({views_of(now)})"
        )
        if math.isnan(self.one_colour):
            self.one_colour = one_colour_psnr(state.scene)
        settled = state.step >= SETTLED and state.fraction >= 0.5
        poor = why_scores_are_poor(self.metrics, state.config, self.one_colour, settled=settled)
        if poor is not None:
            state.report(poor)


def views_of(scores: Mapping[str, Any]) -> str:
    """The views behind scores, such as "3 views" or "the middle 6% of 1 view"; empty if unknown."""
    views, part = scores.get("views"), scores.get("part", 1)
    if not isinstance(views, int) or not isinstance(part, int | float):
        return ""
    return f"the middle {part:.0%} of " * (part < 1) + counted(views, "view")


def counted(count: int, noun: str) -> str:
    """A number of things, such as "1 cell" or "16 cells"."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


def one_colour_psnr(scene: Scene) -> float:
    """PSNR in dB of test views that are painted in their mean colour."""
    background = scene.background_colour()
    pixels = torch.cat([scene.test.truth(i, background).reshape(-1, 3) for i in view_numbers(len(scene.test), 5)])
    return -10 * math.log10(max(float(pixels.var(0, correction=0).mean()), 1e-10))


def why_scores_are_poor(
    metrics: Sequence[Mapping[str, Any]], config: TrainConfig, one_colour: float, *, settled: bool
) -> str | None:
    """The fault of the last evaluation of a run and its probable cause, in a line; None if it is good.

    Args:
        metrics: All evaluations.
        config: The settings of the run.
        one_colour: See :func:`one_colour_psnr`.
        settled: Whether the run is so far that it must have learnt something.
    """
    if metrics[-1].get("part", 1) < 1:
        return None  # the middle of views has scores of its own
    *earlier, now = (math.nan if m["psnr"] is None else m["psnr"] for m in metrics if m.get("part", 1) == 1)
    best = max((psnr for psnr in earlier if math.isfinite(psnr)), default=-math.inf)
    assert config.lr is not None
    usual = config.field_type.learning_rate(config.network_options)
    rate = usual if config.lr > usual else config.lr / 4
    if best - now > COLLAPSE:
        return f"psnr fell from {best:.2f} to {now:.2f} dB: the learning rate is probably too high, try --lr {rate:.2g}"
    if settled and not now > one_colour:
        other = "" if config.lr > usual else ", or cameras, near and far do not fit the images"
        return (
            f"nothing is learnt: psnr is {now:.2f} dB, where a single colour gives {one_colour:.2f}; the learning rate "
            f"is probably too high, try --lr {rate:.2g}{other}"
        )
    return None


def tensorboard_writer() -> Any:
    """The class that writes files of TensorBoard; raises ImportError where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ImportError("--tensorboard needs tensorboard: pip install 'voronerf[tensorboard]'") from None
    return SummaryWriter


class TensorBoard(Callback):
    """Writes loss, speed, cells and scores for TensorBoard.

    Args:
        folder: Of the event files.
        scores: Whose evaluations are written; comes before this one among the callbacks.

    Raises:
        ImportError: TensorBoard is not installed.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from voronerf.app.train import Scores, TensorBoard
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     scores = Scores(None)
        ...     beside = [scores, TensorBoard(Path(folder), scores)]  # callbacks of `run`
    """

    group = GROUP

    def __init__(self, folder: Path, scores: Scores) -> None:
        self._make, self.folder, self.scores, self.written = tensorboard_writer(), folder, scores, 0
        self.writer: Any = None

    def on_start(self, state: State) -> None:
        """Opens the file; what an earlier part of the run has written of later steps is hidden."""
        self.writer, self.written = self._make(str(self.folder), purge_step=state.step + 1), len(self.scores.metrics)

    def after_step(self, state: State) -> None:
        """Writes the state after a step, and the evaluations since the step before."""
        if state.step % GROUP == 0:
            speed = state.rays_done / max(state.seconds, 1e-9)
            for name, value in (("loss", state.loss), ("rays_per_second", speed), ("cells", state.router.num_cells)):
                self.writer.add_scalar(f"train/{name}", value, state.step)
        self._write_scores()

    def on_end(self, state: State) -> None:
        """Writes the last evaluations, and ends the file."""
        self._write_scores()
        self.writer.close()

    def _write_scores(self) -> None:
        for line in self.scores.metrics[self.written :]:
            for name in ("psnr", "ssim", "lpips", "learning_rate"):
                if line.get(name) is not None:
                    self.writer.add_scalar(f"test/{name}", line[name], line["step"])
        self.written = len(self.scores.metrics)
