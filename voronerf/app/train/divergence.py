"""How a training that goes wrong is noticed: by its gradients, its moments and its scores."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from voronerf.app.evaluate.scores import view_numbers
from voronerf.app.scenes import Scene
from voronerf.app.train.checkpoint import checkpoint_paths
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.progress import TrainingError

#: Skipped steps in a row after which waiting is of no use.
PATIENCE = 10
#: Decibels below the best evaluation so far that are a collapse.
COLLAPSE = 5.0
#: A run is compared with pictures of one colour from its middle on, and from this step.
SETTLED = 100


def check_can_go_back(out: Path, reason: str, step: int, rate_factor: float) -> None:
    """A run goes back once, to a checkpoint.

    Raises:
        TrainingError: Where it went back before, as its rate tells, or has no checkpoint.
    """
    there = bool(checkpoint_paths(out))
    if rate_factor < 1 or not there:
        kept = "with half the rate again; the checkpoint is as it was" if there else "there is no checkpoint"
        raise TrainingError(f"{out}: {reason} at step {step}, try a smaller --lr; {kept}")


def all_finite(optimizer: torch.optim.Optimizer) -> bool:
    """Whether all parameters of an optimiser and its moments are finite; reads all of them."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = [entry for state in optimizer.state.values() for entry in state.values() if isinstance(entry, Tensor)]
    return bool(get_total_norm([tensor.detach() for tensor in (*parameters, *moments)], math.inf).isfinite())


def one_colour_psnr(scene: Scene, views: int = 5) -> float:
    """PSNR in dB of test views that are painted in their mean colour."""
    background = scene.background_colour()
    pixels = torch.cat([scene.test.truth(i, background).reshape(-1, 3) for i in view_numbers(len(scene.test), views)])
    return -10 * math.log10(max(float(pixels.var(0, correction=0).mean()), 1e-10))


def why_scores_are_poor(
    metrics: Sequence[Mapping[str, Any]], config: TrainConfig, one_colour: float, *, settled: bool
) -> str | None:
    """What is wrong with the last evaluation of a run and probably its cause, in a line; None if nothing is.

    Args:
        metrics: All evaluations.
        config: The settings of the run.
        one_colour: See :func:`one_colour_psnr`.
        settled: Whether the run is so far that it must have learnt something.
    """
    *earlier, now = (math.nan if m["psnr"] is None else m["psnr"] for m in metrics)
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
