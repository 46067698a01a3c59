"""Averages of the weights over the last steps, which pictures and scores use.

Each cell meets few of a batch's samples, so its weights jitter around what they would be with more of them. An average
lies in the optimiser's state, beside Adam's moments: splits, checkpoints and resumed runs carry it as they do those.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from voronerf.app.train.checkpoint import Checkpoint, CheckpointError
from voronerf.router.optimizers import trained_parts

#: Steps from one update of the averages to the next: weights of steps in between are much the same, and a large table
#: takes time to read.
AVERAGE_EVERY = 8
#: The window of an average is at most this part of the steps done, since weights move far in the first steps.
WINDOW = 1 / 30
_KEY = "average"


def update_averages(optimizer: torch.optim.Optimizer, decay: float, step: int) -> None:
    """Adds the weights after a step, the first being 0, to their exponential averages, at every eighth step.

    The decay per step is 1 - 1 / w with the window w = ``WINDOW`` * step, until it reaches ``decay``.
    """
    if step % AVERAGE_EVERY:
        return
    fading = min(decay, 1 - 1 / max(1, WINDOW * step)) ** AVERAGE_EVERY
    parameters = _parameters(optimizer)
    for parameter in parameters:
        if _KEY not in optimizer.state[parameter]:
            optimizer.state[parameter][_KEY] = parameter.detach().clone()
    averages, weights = [], []
    for parameter, parts in zip(parameters, trained_parts(parameters), strict=True):
        average = optimizer.state[parameter][_KEY]
        averages += [average[part] for part in parts]
        weights += [parameter.detach()[part] for part in parts]
    get_ema_multi_avg_fn(fading)(averages, weights, None)


def drop_averages(optimizer: torch.optim.Optimizer) -> None:
    """Begins all averages anew at the next update."""
    for parameter in _parameters(optimizer):
        optimizer.state[parameter].pop(_KEY, None)


@contextmanager
def averages_in_place(optimizer: torch.optim.Optimizer) -> Iterator[None]:
    """Puts the averages where the weights are, as long as the context lasts; weights without an average stay."""
    held = [parameter for parameter in _parameters(optimizer) if _KEY in optimizer.state[parameter]]
    weights = [parameter.data for parameter in held]
    for parameter in held:
        parameter.data = optimizer.state[parameter][_KEY]
    try:
        yield
    finally:
        for parameter, own in zip(held, weights, strict=True):
            parameter.data = own


def load_averages(parameters: Sequence[Tensor], checkpoint: Checkpoint) -> None:
    """Replaces weights, in the optimiser's order, by the averages that a checkpoint has of them.

    Raises:
        CheckpointError: When an average has another shape.
    """
    for index, parameter in enumerate(parameters):
        name = f"optimizer.{index}.{_KEY}"
        average = checkpoint.tensors.get(name)
        if average is None:
            continue
        if average.shape != parameter.shape:
            wanted, came = list(parameter.shape), list(average.shape)
            raise CheckpointError(f"{checkpoint.source}: {name} must have shape {wanted}, got {came}")
        parameter.data = average.to(parameter)


def _parameters(optimizer: torch.optim.Optimizer) -> list[torch.nn.Parameter]:
    """Those that the optimiser has state of: it would take state that is not its own for all of it."""
    return [p for group in optimizer.param_groups for p in group["params"] if optimizer.state.get(p)]
