"""Makes random changes between recorded training steps, whose results must equal eager steps bit for bit."""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from attempts import RIGHT, Failed
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from voronerf import OccupancyGrid
from voronerf.nerf import Batch, PlannedSplit, RayValues, RenderOutput, SplitStrategy

sys.path.append(str(Path(__file__).resolve().parents[1]))  # the tests' helpers

from step_training import BOX, Scaled, Training, same

#: The number of changes in a sequence, with steps between the changes.
CHANGES = 8


def changed_steps(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Compares two trainings with the same random changes between their steps: one recorded, one eager."""
    options = {"cells": rng.choice((1, 1, 3)), "photograph": rng.random() < 0.3}
    if rng.random() < 0.3:
        options |= {"field": Scaled, "fuse": True}
    trainings = [Training(**options) for _ in range(2)]
    trainings[1].run_as_it_is()
    hooks = rng.sample([*HOOKS], rng.choice((0, 0, 1, 2)))
    for training in trainings:
        for name in hooks:
            HOOKS[name](training)
    average, threads, said = rng.choice((0.0, 0.9)), torch.get_num_threads(), hooks[:]
    for training in trainings:
        training.optimizer.average = average
    try:
        for _ in range(2):
            _steps(rng, trainings, said)
        if "record" not in trainings[0].step.explain():
            raise Failed(f"the first steps are not recorded: {trainings[0].step.explain()}")
        for _ in range(CHANGES):
            name = rng.choice([*EVENTS])
            said.append(name)
            seed = rng.getrandbits(32)
            for training in trainings:
                torch.manual_seed(seed)
                EVENTS[name](training, random.Random(seed))
            _steps(rng, trainings, said)
    finally:
        torch.set_num_threads(threads)
    return RIGHT


class Own(SplitStrategy):
    """A split strategy that counts samples, and then runs its base class."""

    seen = 0

    def step_post_backward(self, output: RenderOutput) -> None:
        self.seen += len(output.weights)
        super().step_post_backward(output)


def _set_strategy(training: Training) -> None:
    plan = [PlannedSplit(at=10_000, children=2)]
    training.step.strategy = Own({"field": training.router}, plan, generator=torch.Generator().manual_seed(0))


def _add_term(training: Training) -> None:
    def clear(rays: RayValues, batch: Batch) -> Tensor:
        return 0.1 * (rays.opacity * (1 - rays.opacity)).mean() + 0.01 * (rays.colour * rays.weights.sum()).mean()

    training.loss.terms = (*training.loss.terms, clear)


def _fetch(training: Training) -> None:
    training.batches.fetch = lambda pixels: None


#: Functions that add Python code to each step of a sequence.
HOOKS: dict[str, Callable[[Training], None]] = {
    "a strategy": _set_strategy,
    "a term": _add_term,
    "pictures on disk": _fetch,
}


def _steps(rng: random.Random, trainings: list[Training], said: list[str]) -> None:
    """Runs some steps of both trainings and compares the results."""
    for _ in range(rng.randint(1, 3)):
        rays, steps, at = rng.choice((64, 64, 50, 90)), rng.choice((1, 1, 2, 7, 16)), rng.choice((None, True))
        said.append(f"{steps} steps of {rays} rays{' at' if at else ''}")
        outcomes = []
        for training in trainings:
            result, error = None, ""
            try:
                result = training.step(rays, steps, at=training.done if at else None)
            except RuntimeError as raised:
                error = str(raised)
            training.done += steps
            training.optimizer.steps_done = training.done
            tensors = [each for each in training.everything() if each is not None]
            if result is not None:
                tensors += [result.loss, result.output.weights, result.output.colour, result.batch.target]
            outcomes.append((error, [tensor.detach().clone() for tensor in tensors]))
        if outcomes[0][0] != outcomes[1][0] or not same(outcomes[0][1], outcomes[1][1]):
            raise Failed(f"another result after {'; '.join(said)} ({outcomes[0][0]!r}, {outcomes[1][0]!r})")


def _parameters(training: Training) -> list[Tensor]:
    return list(training.router.parameters())


def _tensors(training: Training) -> list[Tensor]:
    """Returns all tensors that a step may read or write."""
    state = [value for each in training.optimizer.state.values() for value in each.values()]
    gradients = [p.grad for p in _parameters(training) if p.grad is not None]
    batches, grid = training.batches, training.sampler.grid
    sparse = [] if batches.sparse is None else [*batches.sparse]
    around = [batches.images, batches.background, batches.cameras.poses, training.router.diagram.centres, *sparse]
    return [*_parameters(training), *gradients, *state, *around, grid.density, grid.occupied, *training.guard[:3]]


def _move(training: Training, rng: random.Random) -> None:
    for tensor in rng.sample(_tensors(training), rng.randint(1, 4)):
        tensor.data = tensor.data.clone()


def _lay_out(training: Training, rng: random.Random) -> None:
    """Transposes or flips the tensor of the images or of the poses, or expands its first entry to all entries."""
    tensor = rng.choice((training.batches.images, training.batches.cameras.poses))
    first = tensor.data[:1].expand(len(tensor), *[-1] * (tensor.dim() - 1))
    tensor.data = rng.choice((tensor.data.transpose(1, 2), first, tensor.data.flip(1)))


def _move_all(training: Training, rng: random.Random) -> None:
    for tensor in _tensors(training):
        tensor.data = tensor.data.clone()


def _move_in_place(training: Training, rng: random.Random) -> None:
    tensor = rng.choice([tensor for tensor in _tensors(training) if not tensor.requires_grad])
    with torch.no_grad():
        tensor.set_(tensor.clone())


def _share(training: Training, rng: random.Random) -> None:
    rng.choice(_parameters(training)).share_memory_()


def _write(training: Training, rng: random.Random) -> None:
    training.router.unfreeze()  # frozen cells must not be written to
    with torch.no_grad():
        rng.choice(_parameters(training)).mul_(0.9)
    pictures = rng.choice((training.batches.images, training.batches.cameras.poses))
    pictures.data = pictures.data.contiguous()  # may be expanded from one
    pictures.copy_(pictures.flip(0))


def _empty(training: Training, rng: random.Random) -> None:
    grid, slices = training.sampler.grid, rng.randint(0, 16)
    grid.occupied[:], grid.density[:] = False, 0
    grid.occupied[:slices], grid.density[:slices] = True, 1e3


def _set(training: Training, rng: random.Random) -> None:
    loss, sampler, batches = training.loss, training.sampler, training.batches
    owner, name, value = rng.choice(
        (
            (sampler, "samples", rng.choice((16, 32))),
            (sampler, "settling", rng.random() < 0.5),
            (sampler, "grid", OccupancyGrid.for_training(BOX, 32, resolution=rng.choice((8, 16)))),
            (loss, "robust", rng.choice((0.0, 0.1))),
            (loss, "sparse_depth", rng.choice((0.0, 0.3))),
            (batches, "background", torch.rand(3)),
            (batches, "random_background", rng.random() < 0.5),
            (batches, "near", rng.choice((0.5, 1.0))),
            (training.step, "guard", rng.choice((None, training.guard))),
        )
    )
    setattr(owner, name, value)


def _set_field(training: Training, rng: random.Random) -> None:
    module = training.router.module
    setattr(module, "scale" if hasattr(module, "scale") else "density_scale", rng.choice((0.5, 1.0, 3.0)))


def _set_group(training: Training, rng: random.Random) -> None:
    group = rng.choice(training.optimizer.param_groups)
    key, value = rng.choice((("lr", 0.003), ("eps", 1e-8), ("betas", [0.5, 0.6]), ("shrink", 0.1), ("sparse", False)))
    group[key] = value
    if rng.random() < 0.3:
        group["betas"][0] = 0.7


def _reload(training: Training, rng: random.Random) -> None:
    training.optimizer.load_state_dict(training.optimizer.state_dict())
    for group in training.optimizer.param_groups:
        group["betas"] = list(group["betas"])


def _drop(training: Training, rng: random.Random) -> None:
    rng.choice((training.optimizer.state.clear, training.step.forget))()


def _no_gradients(training: Training, rng: random.Random) -> None:
    for parameter in rng.sample(_parameters(training), rng.randint(1, 2)):
        parameter.grad = rng.choice((None, torch.zeros_like(parameter)))


def _hook(training: Training, rng: random.Random) -> None:
    """Replaces the hook of a parameter, or removes it."""
    for handle in training.handles:
        handle.remove()
    parameter = rng.choice(_parameters(training))
    hooks = [] if not parameter.requires_grad else [
        lambda: parameter.register_hook(lambda gradient: 2 * gradient),
        lambda: parameter.register_post_accumulate_grad_hook(lambda p: p.grad.mul_(0.5)),
    ]  # fmt: skip
    training.handles = [rng.choice(hooks)()] if hooks and rng.random() < 0.7 else []


def _learn(training: Training, rng: random.Random) -> None:
    parameter = rng.choice(_parameters(training))
    parameter.requires_grad_(not parameter.requires_grad)


def _second_optimizer(training: Training, rng: random.Random) -> None:
    """Moves a parameter to a second optimiser; if there is one, runs its step and may move the parameter back."""
    group = training.optimizer.param_groups[0]
    if training.other is None:
        parameter = rng.choice(group["params"])
        group["params"] = [p for p in group["params"] if p is not parameter]
        training.optimizer.state.pop(parameter, None)
        training.other = torch.optim.SGD([parameter], lr=0.1)
        return
    training.router.unfreeze()  # SGD does not know of frozen cells and would move them
    training.other.step()
    training.other.zero_grad()
    if rng.random() < 0.5:
        group["params"].append(training.other.param_groups[0]["params"][0])
        training.other = None


def _freeze(training: Training, rng: random.Random) -> None:
    router, cells = training.router, [rng.randrange(training.router.num_cells)]
    rng.choice((router.freeze, router.unfreeze))(cells)


def _split(training: Training, rng: random.Random) -> None:
    if training.router.num_cells < 8:
        points = torch.rand(500, 3) - 0.5
        training.router.subdivide(2, points=points, weights=torch.ones(500), optimizer=training.optimizer)


def _convert(training: Training, rng: random.Random) -> None:
    training.router.to(torch.float64).to(torch.float32)


def _average(training: Training, rng: random.Random) -> None:
    with training.optimizer.averaged(), torch.no_grad():
        training.router(torch.rand(9, 3), torch.rand(9, 3))


def _set_threads(training: Training, rng: random.Random) -> None:
    torch.set_num_threads(rng.choice((1, 2, 5)))


class _Seen(TorchDispatchMode):
    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        return function(*arguments, **(named or {}))


def _step_within(training: Training, rng: random.Random) -> None:
    """Runs a step in a context that prevents replays or learning."""
    with rng.choice((torch.no_grad, _Seen))(), contextlib.suppress(RuntimeError):
        training.step(64)


EVENTS: dict[str, Callable[[Training, random.Random], None]] = {
    "tensors move": _move,
    "all tensors move": _move_all,
    "tensors are laid out anew": _lay_out,
    "a tensor is set": _move_in_place,
    "a parameter is shared": _share,
    "values are written": _write,
    "the grid is emptied": _empty,
    "an attribute is set": _set,
    "an attribute of the field is set": _set_field,
    "a group is changed": _set_group,
    "the optimiser is loaded": _reload,
    "something is forgotten": _drop,
    "gradients are dropped": _no_gradients,
    "a hook": _hook,
    "a parameter learns, or not": _learn,
    "a second optimiser": _second_optimizer,
    "cells are frozen": _freeze,
    "cells are split": _split,
    "other dtypes": _convert,
    "averages are shown": _average,
    "threads": _set_threads,
    "a step within a context": _step_within,
}
