"""Measures the cost of extending a training step: the examples of docs/extend.md, compared with the default step.

    OMP_WAIT_POLICY=passive GOMP_SPINCOUNT=1000 python benchmarks/own_parts.py --data DATA --json FILE

Each training of Lego at 100 x 100 uses one of the examples. After the split into cells, the trainings run 32 steps each
in turns, with 512 or 2,048 rays a step. Ratios to the default step are medians over the turns.
"""

from __future__ import annotations

import json
import os
import re
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from harness import Parser, threads, write_results

from voronerf.app.scenes import Scene, load_scene
from voronerf.app.train import Callback, State, TrainConfig, build, train
from voronerf.nerf.schedule import GROUP

PAGE = Path(__file__).resolve().parents[1] / "docs" / "extend.md"
BEFORE, TURN = 20 * GROUP, 2 * GROUP  # steps


def examples() -> dict[str, Any]:
    """Returns all names that the Python code of docs/extend.md defines."""
    names: dict[str, Any] = {}
    for code in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL):
        exec(code, names)
    return names


def add_term(name: str, *arguments: float) -> Callable[[State, dict[str, Any]], None]:
    """Returns a function that adds the example ``name`` to a training's loss terms.

    An example that is a class is constructed with ``arguments``.
    """

    def change(state: State, own: dict[str, Any]) -> None:
        term = own[name](*arguments) if arguments else own[name]
        state.ray_loss.terms = (*state.ray_loss.terms, term)

    return change


def set_strategy(name: str) -> Callable[[State, dict[str, Any]], None]:
    """Returns a function that replaces a training's split strategy by the example ``name``.

    The function is called after the last split, so that only the strategy's cost per step is measured.
    """

    def change(state: State, own: dict[str, Any]) -> None:
        state.strategy.__class__ = own[name]

    return change


def set_sampler(state: State, own: dict[str, Any]) -> None:
    """Replaces the sampler by `Annealed` after its last annealing step, when rays have their full length."""
    state.sampler.__class__ = own["Annealed"]
    state.sampler.done = state.sampler.steps


def run_as_it_is(state: State, own: dict[str, Any]) -> None:
    """Runs all steps eagerly, without recordings."""
    state.training_step._standing_obstacle = lambda: "it is timed"  # type: ignore[method-assign]


WAYS: dict[str, Callable[[State, dict[str, Any]], None]] = {
    "as it stands": lambda state, own: None,
    "a split strategy (`WhenFlat`)": set_strategy("WhenFlat"),
    "a strategy that is `replayed` (`Twice`)": set_strategy("Twice"),
    "a sampler (`Annealed`)": set_sampler,
    "a term of one line (`clear`)": add_term("clear"),
    "a term of eight lines (`distortion`)": add_term("distortion"),
    "the same with its gradient (`Distortion`)": add_term("Distortion", 0.01),
    "nothing recorded": run_as_it_is,
}


class Until(Callback):
    """A callback that stops after a number of steps and fixes the number of rays."""

    group = GROUP

    def __init__(self, rays: int) -> None:
        self.rays, self.last = rays, 0

    def after_step(self, state: State) -> None:
        """Stops the training at step ``last``."""
        state.rays = self.rays
        if state.step >= self.last:
            state.stop()

    def go_on(self, state: State, steps: int) -> float:
        """Trains for ``steps`` further steps; returns milliseconds a step."""
        state.clear_stop()
        began, self.last, first = time.perf_counter(), state.step + steps, state.step
        train(state, [self])
        return 1e3 * (time.perf_counter() - began) / (state.step - first)


def measure(scene: Scene, data: str, rays: int, turns: int) -> dict[str, Any]:
    """Returns milliseconds a step of each training, the ratios, and the steps' `explain()` texts."""
    own, states = examples(), dict[str, State]()
    for name, change in WAYS.items():
        torch.manual_seed(0)
        state = states[name] = build(TrainConfig(data=data, downscale=4, steps=BEFORE + 3 * (turns + 2) * TURN), scene)
        state.rays = rays
        until = Until(rays)
        until.go_on(state, BEFORE)
        while state.strategy.remaining:  # the split is due at a fraction of the steps
            until.go_on(state, GROUP)
        change(state, own)
        state.training_step.forget()
        until.go_on(state, TURN)
    ms: dict[str, list[float]] = {name: [] for name in states}
    for turn in range(turns):
        for name in [*states][:: 1 if turn % 2 else -1]:
            until.go_on(states[name], GROUP)
            ms[name].append(until.go_on(states[name], TURN))
    first = ms["as it stands"]
    ratios = {name: statistics.median(a / b for a, b in zip(each, first, strict=True)) for name, each in ms.items()}
    return {
        "rays": rays,
        "samples": states["as it stands"].training_step(rays).samples,
        "cells": states["as it stands"].router.num_cells,
        "ms": {name: round(statistics.median(each), 3) for name, each in ms.items()},
        "x": {name: round(ratio, 2) for name, ratio in ratios.items()},
        "explained": {name: state.training_step.explain() for name, state in states.items()},
    }


def main(arguments: list[str] | None = None) -> None:
    """Prints the results and writes the JSON."""
    parser = Parser("own_parts", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="the folder of the scenes")
    parser.add_argument("--turns", type=int, default=24, help="turns of each training")
    parser.add_argument("--json", type=Path, metavar="FILE", help="a JSON file for the results")
    options = parser.parse_args(arguments)
    data = str(options.data / "lego")
    scene, results = load_scene(data, downscale=4), []
    for count in (1, 2):
        for rays in (512, 2048):
            with threads(count):
                results.append({"threads": count, **measure(scene, data, rays, options.turns)})
            print(json.dumps(results[-1], indent=2), flush=True)
    columns = [f"threads: {result['threads']}, rays: {result['rays']:,}" for result in results]
    print(f"| x of the step as it stands | {' | '.join(columns)} |")
    for name in WAYS:
        print(f"| {name} | {' | '.join(format(result['x'][name], '.2f') for result in results)} |")
    waiting = {name: os.environ.get(name) for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    write_results(options.json, results, benchmark="own_parts", seed=0, **waiting)


if __name__ == "__main__":
    main()
