"""The scores of a run in its files: ``metrics.jsonl`` during training, ``summary.json`` at its end."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from voronerf.evaluation.scores import ViewScore, mean_scores
from voronerf.files import json_text, write_text
from voronerf.training.divergence import SETTLED, one_colour_psnr, why_scores_are_poor

if TYPE_CHECKING:
    from voronerf.training.trainer import Trainer

#: Entries of the last evaluation that summary.json repeats.
FIGURES = ("psnr", "ssim", "lpips", "psnr_of_mean_error", "views")


def record_scores(trainer: Trainer, scores: list[ViewScore]) -> None:
    """Adds an evaluation to ``metrics.jsonl`` and tells it, with what makes it poor."""
    now = {
        "step": trainer.step,
        "seconds": round(trainer.seconds, 3),
        "cells": trainer.diagram.num_cells,
        "learning_rate": trainer.learning_rate(),
        "views": len(scores),
        **mean_scores(scores),
    }
    trainer.metrics = [m for m in trainer.metrics if m["step"] < trainer.step] + [now]
    if trainer.writes:
        write_text(trainer.out / "metrics.jsonl", "".join(json_text(m) + "\n" for m in trainer.metrics))
    trainer.say(
        f"{trainer.seconds:7.1f} s  step {trainer.step:6d}  {trainer.diagram.num_cells:4d} cells  "
        f"psnr {now['psnr']:6.2f}  ssim {now['ssim']:.4f}  ({len(scores)} views)"
    )
    if trainer.one_colour is None:
        trainer.one_colour = one_colour_psnr(trainer.scene)
    settled = trainer.step >= SETTLED and trainer.fraction >= 0.5
    poor = why_scores_are_poor(trainer.metrics, trainer.config, trainer.one_colour, settled=settled)
    if poor is not None:
        trainer.say(poor)


def summarise(trainer: Trainer) -> dict[str, Any]:
    """Writes ``summary.json``; returns what it holds."""
    summary = {
        **{key: trainer.metrics[-1].get(key) if trainer.metrics else None for key in FIGURES},
        "complete": trainer.fraction >= 1 and not trainer.stopped,
        "seconds": trainer.seconds,
        "steps": trainer.step,
        "rays_per_second": trainer.rays_done / max(trainer.seconds, 1e-9),
        "parameters": trainer.parameter_count,
        "cells": trainer.diagram.num_cells,
        "splits_left": len(trainer.plan) - trainer.level,
        "skipped_steps": int(trainer.guard.skipped),
        "width": trainer.config.width,
        "stages": [asdict(stage) for stage in trainer.stages],
    }
    if trainer.writes:
        write_text(trainer.out / "summary.json", json_text(summary, indent=2) + "\n")
    return summary
