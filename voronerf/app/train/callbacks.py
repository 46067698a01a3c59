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

from voronerf.app.evaluate.angles import FAR_ANGLE
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
from voronerf.app.train.start import rate_advice, usual_rate
from voronerf.app.train.state import State
from voronerf.nerf.schedule import GROUP
from voronerf.nerf.split import SplitDone

#: Seconds of training between checkpoints, and the number of kept checkpoints.
CHECKPOINT_EVERY, KEPT = 30.0, 3
#: The fraction of the budget for evaluations, half of it for the final evaluation; the maximum number of views in an
#: intermediate evaluation.
SHARE, VIEWS = 0.1, 20
#: Approximate number of pixels that are rendered to time a view. If only the centre of a view is rendered, each side of
#: it has at least `PROBE_SIDE` pixels.
PROBE, PROBE_SIDE = 1024, 31
#: The maximum number of views whose central parts are scored, if there is too little time for a whole view.
PARTS = 8
#: Side of the corner of a view on which LPIPS is timed.
LPIPS_PROBE = 128
#: The entries of the last evaluation that are copied to summary.json.
FIGURES = ("psnr", "ssim", "lpips", "psnr_of_mean_error", "far_views", "views", "part")
#: Number of consecutive skipped steps after which a training has diverged.
PATIENCE = 10
#: Drop of the PSNR from its best value, in dB, that counts as a collapse.
COLLAPSE = 5.0
#: From this step on, but only in the second half of a run, the PSNR is compared with the PSNR of a single colour.
SETTLED = 100
#: With another learning rate than the default, a training has learnt little if its PSNR is less than this number of dB
#: above the PSNR of a single colour.
LITTLE = 3.0


class Checkpoints(Callback):
    """Writes checkpoints at regular times, in a thread, and at the end; also writes the samples of each split.

    Args:
        out: The run directory.
        interval: Seconds of training between two checkpoints.
    """

    group = GROUP

    def __init__(self, out: Path, interval: float = CHECKPOINT_EVERY) -> None:
        self.out, self.interval = out, interval
        self.writer = CheckpointWriter(out, KEPT)
        self.saved_at, self.described = 0.0, False

    def on_start(self, state: State) -> None:
        """Starts the timer at the state's training time."""
        self.saved_at = state.seconds

    def after_split(self, state: State, done: SplitDone) -> None:
        """Writes the samples on which a split is based, and reports the new cells."""
        buffer, stage = io.BytesIO(), state.stages[-1]  # benchmarks/paper/balance.py reads the samples
        np.savez(buffer, points=done.points.cpu().numpy(), importance=done.importance.cpu().numpy())
        write_bytes(self.out / "samples" / f"level-{state.strategy.splits}.npz", buffer.getvalue())
        when = f"at {state.seconds:.0f} s, step {state.step}"
        if stage.split_cells:
            balance = f", imbalance of their importance {stage.balance_before:.3f} -> {stage.balance_after:.4f}"
            state.report(
                f"{counted(stage.cells, 'cell')} {when}{balance if state.config.centres == 'balanced' else ''}"
            )
        else:
            state.report(f"no cell split {when}: none holds enough distinct samples of the {len(done.points)} kept")

    def after_step(self, state: State) -> None:
        """Starts writing a checkpoint when it is due, unless another one is being written.

        ``on_end`` writes the one after the last step, since the training ends by cleaning its grid.
        """
        if state.fraction < 1 and state.seconds - self.saved_at >= self.interval and not self.writer.busy:
            self.save(state)

    def on_end(self, state: State) -> None:
        """Writes the last checkpoint, and waits until it is written."""
        self.save(state)
        self.writer.wait()

    def save(self, state: State) -> None:
        """Starts writing a checkpoint, after the previous checkpoint is written.

        Raises:
            TrainingError: When parameters or moments are not finite; the last checkpoint stays unchanged.
            OSError: When the previous checkpoint could not be written.
        """
        if not all_finite(state.optimizer):
            raise diverged(self.out, "parameters or moments of Adam are not finite", state)
        if not self.described:  # not earlier, so that a run whose first step fails leaves no files
            write_text(self.out / "config.json", state.config.to_json())
            write_scene(self.out / "scene.json", state.scene)
            self.described = True
        self.writer.write(snapshot(state))
        self.saved_at = state.seconds


class Divergence(Callback):
    """Ends a training with an error if its gradients become infinite or NaN.

    Args:
        out: The run directory, for the error message.
    """

    group = GROUP

    def __init__(self, out: Path) -> None:
        self.out = out

    def after_step(self, state: State) -> None:
        """Raises TrainingError after `PATIENCE` consecutive skipped steps."""
        if state.skipped_in_a_row >= PATIENCE:
            raise diverged(
                self.out, f"the gradients of {state.skipped_in_a_row} consecutive steps are not finite", state
            )


def diverged(out: Path, reason: str, state: State) -> TrainingError:
    """Returns the error of a training that cannot continue."""
    remark = "the last checkpoint is unchanged" if checkpoint_paths(out) else "there is no checkpoint"
    return TrainingError(f"{out}: {reason}, at step {state.step}; {rate_advice(state.config, lower=True)}; {remark}")


def all_finite(optimizer: torch.optim.Optimizer) -> bool:
    """Returns whether all parameters and moments of an optimiser are finite."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = [entry for state in optimizer.state.values() for entry in state.values() if isinstance(entry, Tensor)]
    return bool(get_total_norm([tensor.detach() for tensor in (*parameters, *moments)], math.inf).isfinite())


class Scores(Callback):
    """Scores test views at regular intervals and at the end, into ``metrics.jsonl``, and writes ``summary.json``.

    With ``config.budget`` and without ``config.eval_views``, the time of evaluations is limited. Intermediate
    evaluations take at most a twentieth of the elapsed time; if necessary, they score fewer views or none. All
    evaluations together take at most a tenth of the budget. If there is too little time for a view at the end, only the
    central parts of some views are scored.

    Args:
        out: The run directory; None to write no files.
        lpips: The LPIPS network for the final evaluation, or None.
        track: Function that shows progress: takes a sequence and the task's name, and yields the items.
        clock: Function that returns the time in seconds.

    Attributes:
        metrics: All evaluations, in order.
        summary: The contents of ``summary.json``, after the end of the training.
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
        """Loads the evaluations of a resumed run."""
        if self.out is not None:
            self.metrics = [line for line in read_metrics(self.out) if line["step"] <= state.step]
        self.done = min(len(self.metrics), self._due(state))
        self.after_step(state)  # scores an evaluation that was interrupted

    def _due(self, state: State) -> int:
        return int(state.fraction * state.config.evaluations + 1e-9)

    def after_step(self, state: State) -> None:
        """Scores test views when an evaluation is due."""
        if self._due(state) > self.done and state.fraction < 1:
            self.done = self._due(state)
            self._evaluate(state, last=False)

    def on_end(self, state: State) -> None:
        """Scores the test views of a finished training, and writes the summary."""
        if state.fraction >= 1:
            state.clear_stop()
            if remaining := state.strategy.remaining:
                state.report(f"Run ended before {remaining} of {state.strategy.splits + remaining} planned splits.")
            self._evaluate(state, last=True)
        last = self.metrics[-1] if self.metrics else {}
        self.summary = {
            **{key: last.get(key) for key in FIGURES},
            "complete": state.fraction >= 1 and not state.stopped,
            "seconds": state.seconds,
            "steps": state.step,
            "rays_per_second": state.rays_done / max(state.seconds, 1e-9),
            "parameters": state.parameter_count,
            "cells": state.router.num_cells,
            "splits_left": state.strategy.remaining,
            "skipped_steps": state.skipped,
            "width": state.config.width,
            "stages": [asdict(stage) for stage in state.stages],
        }
        if self.out is not None:
            write_text(self.out / "summary.json", json_text(self.summary, indent=2) + "\n")

    def _evaluate(self, state: State, *, last: bool) -> None:
        """Scores test views; discards the scores if a stop is requested meanwhile."""
        config, lpips, all_views = state.config, self.lpips if last else None, len(state.scene.test)
        views, middle = min(all_views, config.eval_views or (all_views if last else VIEWS)), 1
        remaining, started, budget = math.inf, self.clock(), None if config.eval_views else config.budget
        if budget is not None:
            remaining = (SHARE * budget if last else SHARE / 2 * state.seconds) - state.evaluation_seconds
            most_parts = max(1, min(state.scene.test.cameras.smallest) // PROBE_SIDE)
            if not 0 < self.view_seconds <= remaining and 4 * self.probe_seconds <= remaining:
                self._probe(state, most_parts)
            per_view = self.view_seconds + (0.0 if lpips is None else self._seconds_of(lpips, state))
            remaining -= self.clock() - started
            views = min(views, int(max(remaining, 0) / max(per_view, 1e-9)))
            if last and views < 1:
                affordable = max(remaining, 1e-9) / max(per_view, 1e-9)  # number of views, below 1
                views = max(1, min(all_views, PARTS, int(affordable * most_parts**2)))
                middle = min(most_parts, math.ceil(math.sqrt(views / affordable)))
        if views:
            begin = self.clock()
            stop = lambda: state.stopped or self.clock() - begin > remaining  # noqa: E731
            scores = self._score(state, views, lpips, middle, stop=stop, track=self.track)
            if middle == 1:
                self.view_seconds = (self.clock() - begin) / len(scores)
            if not state.stopped:
                self._record(state, scores, middle)
        if budget is not None and not last:
            state.count_evaluation(self.clock() - started, min(self.view_seconds * all_views, SHARE / 2 * budget))

    def affordable(self, budget: float | None, most: int) -> int:
        """Returns how many views, 1 to ``most``, can be scored in a tenth of a budget (seconds); None is no limit.

        The time of a view is known from the last evaluation.
        """
        return most if budget is None else max(1, min(most, int(SHARE * budget / max(self.view_seconds, 1e-9))))

    def _seconds_of(self, lpips: Lpips, state: State) -> float:
        """Estimates the seconds of LPIPS for a view, by timing it on a corner of the view."""
        truth = state.scene.test.truth(0, state.scene.background_colour()).to(state.device)
        corner, started = truth[:LPIPS_PROBE, :LPIPS_PROBE], self.clock()
        float(lpips(corner, corner))
        return (self.clock() - started) * truth.numel() / corner.numel()

    def _probe(self, state: State, most: int) -> None:
        """Estimates the seconds for a view by scoring its central part, at least 1 / ``most`` as wide as the view."""
        width, height = state.scene.test.cameras.size(0)
        factor, started = min(most, max(1, round(math.sqrt(width * height / PROBE)))), self.clock()
        self._score(state, 1, None, factor)
        self.probe_seconds = self.clock() - started
        self.view_seconds = self.probe_seconds * factor**2

    def _score(self, state: State, views: int, lpips: Lpips | None, middle: int, **options: Any) -> list[ViewScore]:
        with state.averaged():
            return evaluate(state.renderer, state.scene, views=views, lpips=lpips, middle=middle, **options)

    def _record(self, state: State, scores: list[ViewScore], middle: int) -> None:
        """Adds an evaluation to ``metrics.jsonl``, and reports its scores and, if they are poor, the probable cause.

        Width and height of the scored views were divided by ``middle``.
        """
        entry = {
            "step": state.step,
            "seconds": round(state.seconds, 3),
            "cells": state.router.num_cells,
            "learning_rate": state.learning_rate(),
            "views": len(scores),
            "part": 1 / middle**2,
            **mean_scores(scores),
            "scores": [asdict(score) for score in scores],
        }
        self.metrics = [line for line in self.metrics if line["step"] < state.step] + [entry]
        if self.out is not None:
            write_text(self.out / "metrics.jsonl", "".join(json_text(line) + "\n" for line in self.metrics))
        state.report(
            f"{state.seconds:7.1f} s  step {state.step:6d}  {entry['cells']:4d} cell{'s' * (entry['cells'] != 1)}  "
            f"psnr {entry['psnr']:6.2f}  ssim {entry['ssim']:.4f}  ({views_of(entry)})"
        )
        if math.isnan(self.one_colour):
            self.one_colour = one_colour_psnr(state.scene)
        settled = state.step >= SETTLED and state.fraction >= 0.5
        fault = why_scores_are_poor(self.metrics, state.config, self.one_colour, settled=settled)
        if fault is not None:
            state.report(fault)


def views_of(scores: Mapping[str, Any]) -> str:
    """Describes the scored views, such as "3 views" or "the middle 6% of 1 view"; empty if unknown."""
    views, part, far = scores.get("views"), scores.get("part", 1), scores.get("far_views", 0)
    if not isinstance(views, int) or not isinstance(part, int | float):
        return ""
    distant = f", {far} over {FAR_ANGLE:g} degrees from the training cameras" if far and isinstance(far, int) else ""
    return f"the middle {part:.0%} of " * (part < 1) + counted(views, "view") + distant


def counted(count: int, noun: str) -> str:
    """Returns a number with its noun, such as "1 cell" or "16 cells"."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


def one_colour_psnr(scene: Scene) -> float:
    """Returns the PSNR in dB of a prediction that paints test views in their mean colour."""
    background = scene.background_colour()
    pixels = torch.cat([scene.test.truth(i, background).reshape(-1, 3) for i in view_numbers(len(scene.test), 5)])
    return -10 * math.log10(max(float(pixels.var(0, correction=0).mean()), 1e-10))


def why_scores_are_poor(
    metrics: Sequence[Mapping[str, Any]], config: TrainConfig, one_colour: float, *, settled: bool
) -> str | None:
    """Returns the fault of a run's last evaluation and its probable cause, in a line; None if there is no fault.

    Args:
        metrics: All evaluations.
        config: The settings of the run.
        one_colour: The PSNR of a single colour, see :func:`one_colour_psnr`.
        settled: Whether the run is long enough for scores above a single colour's.
    """
    if metrics[-1].get("part", 1) < 1:
        return None  # scores of the views' middles are not comparable
    *earlier, now = (math.nan if line["psnr"] is None else line["psnr"] for line in metrics if line.get("part", 1) == 1)
    best = max((psnr for psnr in earlier if math.isfinite(psnr)), default=-math.inf)
    assert config.lr is not None
    usual = usual_rate(config)
    if best - now > COLLAPSE:
        return f"psnr fell from {best:.2f} to {now:.2f} dB: {rate_advice(config, lower=True)}"
    if settled and not now > one_colour + (config.lr != usual) * LITTLE:
        other_causes = "" if config.lr > usual else ", or cameras, near and far do not fit the images"
        return (
            f"{'little' if now > one_colour else 'nothing'} is learnt: psnr is {now:.2f} dB, where a single colour "
            f"gives {one_colour:.2f}; {rate_advice(config)}{other_causes}"
        )
    return None


def tensorboard_writer() -> Any:
    """Returns TensorBoard's writer class; raises ImportError if TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ImportError("--tensorboard needs tensorboard: pip install 'voronerf[tensorboard]'") from None
    return SummaryWriter


class TensorBoard(Callback):
    """Writes loss, speed, cells and scores for TensorBoard.

    Args:
        folder: The folder of the event files.
        scores: The callback whose evaluations are written; it must precede this callback.

    Raises:
        ImportError: If TensorBoard is not installed.

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
        """Opens the event file; on a resume, TensorBoard hides the old entries of later steps."""
        self.writer = self._make(str(self.folder), purge_step=state.step + 1)
        self.written = sum(line["step"] < state.step for line in self.scores.metrics)  # `scores` may have added one

    def after_step(self, state: State) -> None:
        """Writes the state after a step, and new evaluations."""
        if state.step % GROUP == 0:
            speed = state.rays_done / max(state.seconds, 1e-9)
            for name, value in (("loss", state.loss), ("rays_per_second", speed), ("cells", state.router.num_cells)):
                self.writer.add_scalar(f"train/{name}", value, state.step)
        self._write_scores()

    def on_end(self, state: State) -> None:
        """Writes the last evaluations, and closes the file."""
        self._write_scores()
        self.writer.close()

    def _write_scores(self) -> None:
        for line in self.scores.metrics[self.written :]:
            for name in ("psnr", "ssim", "lpips", "learning_rate"):
                if line.get(name) is not None:
                    self.writer.add_scalar(f"test/{name}", line[name], line["step"])
        self.written = len(self.scores.metrics)
