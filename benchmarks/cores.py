"""Which part of a training step, and of a picture, is serial, and what more cores would give.

    python benchmarks/cores.py --data lego --json benchmarks/results/cores.json    half a minute of one core

All runs on one thread, by its processor time, so that other processes disturb little. Calls of the compiled module are
traced (csrc/common/trace.h): each run of items that threads would share is given to whichever of 2, 8, 16 and 32 would
be free first. What lies outside of such regions is serial: Python, torch's own operations, and the compiled module's
before and after its regions. A step on so many cores takes the serial time and the longest of the threads', or the time
in which memory moves the step's bytes.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch
from harness import Parser, metadata

from voronerf.app.files import write_text
from voronerf.app.scenes import load_scene
from voronerf.app.train import Callback, TrainConfig, build, train
from voronerf.app.train.state import State
from voronerf.ops._core import native

TEAMS = (2, 8, 16, 32)
REST = "Python and torch"
BANDWIDTHS = {"40": 40e9, "80": 80e9}
CASES: dict[str, tuple[dict[str, Any], int, int]] = {
    "default": ({"rays": 512}, 400, 64),
    "default, few samples": ({"rays": 64}, 400, 64),
    "nerf": ({"field": "nerf"}, 120, 12),
}
"""Settings, steps before those that are traced, and how many are."""
LINE, SAMPLE_BYTES, ENTRY_BYTES, TAUGHT_BYTES = 16, 450, 8, 24
"""Entries of a cache line; bytes that a step reads and writes of a sample (positions to gradients), of an entry (its
gradient, twice), and of one in a line with a gradient (itself and two moments, each read and written)."""


class Parts(Callback):
    """Traces the steps after ``warm`` of them, and stops after ``count`` more."""

    def __init__(self, warm: int, count: int) -> None:
        self.last, self.warm = warm + count, warm
        self.steps: list[dict[str, list[float]]] = []
        self.began = 0.0

    def after_step(self, state: State) -> None:
        """Keeps what was traced."""
        seconds, calls = time.process_time() - self.began, native.compiled.trace(state.step >= self.warm)
        if state.step > self.warm:
            self.steps.append(parts(seconds, calls))
        if state.step >= self.last:
            native.compiled.trace(False)
            state.stop()
        self.began = time.process_time()


def parts(seconds: float, calls: list[Any]) -> dict[str, list[float]]:
    """Of each compiled function and of the rest: seconds, those in regions, and what all takes on each of TEAMS."""
    found: dict[str, list[float]] = defaultdict(lambda: [0.0] * (2 + len(TEAMS)))
    for name, whole, _, inside, shared in calls:
        added = whole, inside, *(whole - inside + each for each in shared)
        found[name] = [a + b for a, b in zip(found[name], added, strict=True)]
    rest = seconds - sum(each[0] for each in found.values())
    found[REST] = [rest, 0.0, *[rest] * len(TEAMS)]
    return dict(found)


def row(case: str, found: list[dict[str, list[float]]], moved: float, **more: Any) -> dict[str, Any]:
    """A result: medians of the parts over the steps, in microseconds; the mean of what most steps do not have, and of
    Python and torch, which take several times as long in every 8th and 16th step."""
    table = {}
    for name in dict.fromkeys(name for each in found for name in each):
        own = [each.get(name, [0.0] * (2 + len(TEAMS))) for each in found]
        seldom = name == REST or 2 * sum(name in each for each in found) < len(found)
        middle = statistics.mean if seldom else statistics.median
        table[name] = [1e6 * middle(each) for each in zip(*own, strict=True)]
    whole, inside, *on = (sum(column) for column in zip(*table.values(), strict=True))
    serial = whole - inside
    times = {}
    for team, us in zip(TEAMS, on, strict=True):
        for name, rate in BANDWIDTHS.items():
            times[f"x on {team} cores at {name} GB/s"] = whole / (serial + max(us - serial, 1e6 * moved / rate))
    listed = {name: {"us": each[0], "serial_us": each[0] - each[1]} for name, each in table.items()}
    shown = {"case": case, **more, "ms": whole / 1e3, "serial_percent": 100 * serial / whole, "bytes": moved}
    return {**shown, **{name: round(value, 2) for name, value in times.items()}, "parts": listed}


def measure(case: str, data: Path) -> list[dict[str, Any]]:
    """The rows of a training's steps and, by default, of a picture of its field."""
    settings, warm, count = CASES[case]
    scene = load_scene(str(data))
    state = build(TrainConfig(data=str(data), steps=1500, **settings), scene)
    traced = Parts(warm, count)
    samples: list[int] = []
    inner = state.sampler.step_post_backward

    def post(output: Any) -> None:
        samples.append(len(output.weights))
        inner(output)

    state.sampler.step_post_backward = post  # type: ignore[method-assign]
    train(state, [traced])
    n = statistics.median(samples[warm:])
    gradients = [
        p.grad.view(-1) for router in state.routers.values() for p in router.parameters() if p.grad is not None
    ]
    lines = sum(int((each[: len(each) // LINE * LINE].view(-1, LINE) != 0).any(1).sum()) for each in gradients)
    moved = SAMPLE_BYTES * n + ENTRY_BYTES * state.parameter_count + TAUGHT_BYTES * LINE * lines
    rows = [row(case, traced.steps, moved, rays=state.rays, samples=n, parameters=state.parameter_count)]
    if case != "default":
        return rows
    state.renderer.train(False)
    view = scene.train
    found = []
    for _ in range(3):
        native.compiled.trace(True)
        began = time.process_time()
        state.renderer.image(view.cameras, 0, near=scene.near, far=scene.far, box=scene.box, heaviest=False)
        found.append(parts(time.process_time() - began, native.compiled.trace(False)))
    width, height = view.cameras.size(0)
    return [*rows, row(f"picture, {case}", found, 0.0, rays=width * height)]


def main(arguments: list[str] | None = None) -> None:
    """Prints the shares, and writes the JSON."""
    parser = Parser("cores", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="a scene")
    parser.add_argument("--case", choices=CASES, action="append", help="of these alone")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the results go as well")
    options: argparse.Namespace = parser.parse_args(arguments)
    torch.set_num_threads(1)
    results = []
    for case in options.case or CASES:
        for each in measure(case, options.data):
            results.append(each)
            print(*(f"{name} {value:.4g}" for name, value in each.items() if isinstance(value, float | int)), case)
            for name, part in sorted(each["parts"].items(), key=lambda item: -item[1]["us"]):
                print(f"    {name:24} {part['us']:9.0f} us, serial {part['serial_us']:7.0f}")
    if options.json is not None:
        known = metadata(command="python benchmarks/cores.py", benchmark="cores", scene=options.data.name)
        write_text(options.json, json.dumps({"metadata": known, "results": results}, indent=2) + "\n")


if __name__ == "__main__":
    main()
