"""Interrupts training steps at random moments; the steps after the interrupt must equal eager steps bit for bit."""

from __future__ import annotations

import copy
import random
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from attempts import RIGHT, Failed
from step_sequences import HOOKS
from torch.utils import _python_dispatch

from voronerf.nerf import TrainingStep
from voronerf.ops import nearest_centre
from voronerf.ops._core.active import active
from voronerf.ops._core.custom_op import has_listeners

sys.path.append(str(Path(__file__).resolve().parents[1]))  # the tests' helpers

from helpers import Interrupt
from step_training import Scaled, Training, same

#: The steps before the interrupted step, and a change that causes a new recording.
PHASES: dict[str, tuple[int, Callable[[TrainingStep], None]]] = {
    "the first step": (0, lambda step: None),
    "a recording": (2, TrainingStep.forget),
    "a replay": (3, lambda step: None),
}


def interrupted_step(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Interrupts a step once, and compares the following steps with eager steps of a copy."""
    options: dict[str, Any] = {"cells": rng.choice((1, 3)), "photograph": rng.random() < 0.3}
    if rng.random() < 0.3:
        options |= {"field": Scaled, "fuse": True}
    training, (phase, (steps, change)) = Training(**options), rng.choice([*PHASES.items()])
    hooks, step = rng.sample([*HOOKS], rng.choice((0, 0, 1))), training.step
    for name in hooks:
        HOOKS[name](training)
    del step._step._run  # it counts recordings of this step alone
    for _ in range(steps):
        step(64)
    with Interrupt() as counting:
        twin = copy.deepcopy(step)
        change(twin)
        counting.places = 0
        twin(64)
    said = f"{phase} {options} with {hooks}, interrupted at {(place := rng.randint(1, counting.places))}"
    change(step)
    try:
        with Interrupt(place):
            step(64)
    except KeyboardInterrupt:
        pass
    except BaseException as error:
        raise Failed(f"{type(error).__name__} in place of KeyboardInterrupt: {said}: {error}") from error
    torch.set_grad_enabled(True)  # an interrupt in the ``__exit__`` of torch.no_grad leaves gradients off
    points = torch.rand(4, 3)
    before = sys.getrefcount(points)
    nearest_centre(points, torch.rand(4, 3))
    flags = [name for name, value in vars(_python_dispatch).items() if name.startswith("_is_in_") and value is True]
    if has_listeners() or active.recording is not None or active.vary is not None or flags:
        raise Failed(f"a recording is left on: {said} {flags}")
    if sys.getrefcount(points) != before:
        raise Failed(f"the compiled module keeps its calls: {said}")
    eager = copy.deepcopy(step)
    eager._standing_obstacle = lambda: "the steps are compared"  # type: ignore[method-assign]
    for number in range(4):
        results = [_tensors(each, each(64)) for each in (step, eager)]
        if not same(*results):
            raise Failed(f"step {number} after the interrupt differs: {said}")
    if "recorded and replayed" not in step.explain():
        raise Failed(f"{said}: {step.explain()}")
    return RIGHT


def _tensors(step: TrainingStep, output: Any) -> list[torch.Tensor]:
    """Returns the tensors of a step's result and of everything that it changes."""
    field = step.loss.renderer.field
    moments = [value for each in step.optimizer.state.values() for value in each.values()]
    gradients = [p.grad for p in field.parameters() if p.grad is not None]  # type: ignore[union-attr]
    grid, results = step.loss.renderer.sampler.grid, (output.loss, output.output.weights, output.batch.target)
    tensors = [*results, *field.parameters(), *moments, *gradients, grid.density, grid.occupied]  # type: ignore[union-attr]
    return [tensor.detach().clone() for tensor in tensors]
