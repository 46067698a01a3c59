"""Where the milliseconds of a training step go.

    python benchmarks/step_profile.py --data DIR --downscale 4 --threads 1
    python benchmarks/step_profile.py --data builtin --field nerf --json profile.json

Trains a scene until it has cells and knows its empty space, then times whole steps, and in as many more the processor
time of every call of the compiled module. What these do not account for is PyTorch and Python. A third run under
PyTorch's profiler lists operators; it makes them look slower than they are.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import metadata
from torch.profiler import ProfilerActivity, profile

from voronerf import native
from voronerf.cli.main import EXPECTED
from voronerf.data import load_scene
from voronerf.files import write_text
from voronerf.training.config import SamplingName, TrainConfig
from voronerf.training.trainer import Trainer

# What the compiled functions of a step are for, by how their names begin; the first that fits.
PARTS = {
    "batch": ("draw_pixels", "pixel_rays", "camera_rays"),
    "march": ("march_rays",),
    "cells": ("nearest_centre", "locate_cell", "cell_sort", "draw_cell"),
    "backward": ("grouped_mlp_backward", "grouped_linear_backward", "hash_encode_backward"),
    "forward": ("grouped_mlp", "grouped_linear", "hash_encode", "encode"),
    "loss": ("render_loss", "composite", "resample"),
    "occupancy": ("observe_occupancy", "update_occupancy"),
    "Adam": ("sparse_adam", "adam"),
    "PyTorch and Python": ("",),
}
REST = "PyTorch and Python"


@dataclass(frozen=True)
class Options:
    """Which step to profile."""

    data: str = "builtin"
    """Scene folder or "builtin"."""
    downscale: int = 1
    """Factor by which the images are made smaller on load."""
    cells: int = 16
    """Cells; 1 is one network."""
    field: str = "hashgrid"
    """The networks, as for `voronerf train`."""
    sampling: SamplingName = "stratified"
    """Samples along a ray, likewise."""
    field_options: tuple[str, ...] = ()
    """Further options of the networks, each as NAME=VALUE."""
    occupancy: bool = True
    """Whether samples in empty space are left out, where that works; times are given for each sample that is kept."""
    width: int | None = None
    """Channels of the networks' hidden layers; default that of the field."""
    rays: int = 512
    """Rays per step, of the first steps."""
    samples: int | None = None
    """Samples per ray; default that of the sampling."""
    bfloat16: bool = False
    """Networks under autocast to bfloat16."""
    warm: int = 1000
    """Steps before, the split after a fifth of them; an occupancy grid needs some 150 to find what is empty."""
    steps: int = 100
    """Steps to time, and as many again with a clock around each compiled function, and under the profiler."""
    threads: int | None = None
    """Threads; default PyTorch's number."""
    backend: str = "auto"
    """Backend of the operations."""
    top: int = 12
    """Operators listed one by one."""
    json: Path | None = None
    """File for the result, {metadata, results}."""


def main() -> None:
    """Profiles and prints."""
    options = tyro.cli(Options, description=__doc__)
    try:
        result = measure(options)
    except EXPECTED as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    show(result, options.top)
    if options.json is not None:
        write_text(options.json, json.dumps(result, indent=2) + "\n")


def measure(options: Options) -> dict[str, Any]:
    """Metadata, and rows {part, ms, share} and {operator, ms, calls} of a step."""
    warm, every = options.warm, 3 * options.steps
    torch.set_num_threads(options.threads or torch.get_num_threads())
    with tempfile.TemporaryDirectory() as folder:
        config = TrainConfig(
            data=options.data,
            downscale=options.downscale,
            out=Path(folder),
            # The split comes after a fifth of the warm-up; nothing is evaluated or saved on the way.
            steps=warm + every + 1,
            cells=(options.cells,) if options.cells > 1 else (),
            split_at=(warm / 5 / (warm + every + 1),) if options.cells > 1 else None,
            evaluations=1,
            field=options.field,
            field_options=options.field_options,
            occupancy=options.occupancy,
            sampling=options.sampling,
            width=options.width,
            rays=options.rays,
            samples=options.samples,
            backend=options.backend,
            precision="bf16" if options.bfloat16 else "fp32",
            checkpoint_every=float("inf"),
        )
        trainer = Trainer(config, load_scene(options.data, downscale=options.downscale))

        def step() -> None:
            stop = trainer.step + 1
            trainer.on_step = lambda progress: trainer.request_stop() if progress.step >= stop else None
            trainer.stopped = False
            trainer.advance()

        for _ in range(warm):
            step()
        counts: list[int] = []
        if trainer.occupancy is not None:
            march = trainer.occupancy.march

            def counted(*given: Any, **named: Any) -> Any:
                found = march(*given, **named)
                counts.append(len(found.positions))
                return found

            trainer.occupancy.march = counted  # type: ignore[method-assign]
        times = []
        used = time.process_time()
        for _ in range(options.steps):
            start = time.perf_counter()
            step()
            times.append(1e3 * (time.perf_counter() - start))
        used = time.process_time() - used
        samples = sum(counts) or options.steps * options.rays * int(trainer.config.samples or 0)
        with clocked() as clock:
            for _ in range(options.steps):
                step()
        with profile(activities=[ProfilerActivity.CPU]) as profiled:
            start = time.perf_counter()
            for _ in range(options.steps):
                step()
            profiled_ms = 1e3 * (time.perf_counter() - start) / options.steps
    operators = [
        {
            "operator": event.key,
            "ms": event.self_cpu_time_total / 1e3 / options.steps,
            "calls": event.count / options.steps,
        }
        for event in profiled.key_averages()
    ]
    operators.sort(key=lambda row: -row["ms"])
    sums = dict.fromkeys(PARTS, 0.0)
    for name, seconds in clock.items():
        part = next(part for part, names in PARTS.items() if name.startswith(names))
        sums[part] += 1e3 * seconds / options.steps
    whole = 1e3 * used / options.steps
    sums[REST] = max(whole - sum(sums.values()), 0.0)
    return {
        "metadata": metadata(
            benchmark="step_profile",
            data=Path(options.data).name,
            downscale=options.downscale,
            cells=trainer.router.num_cells,
            field=options.field,
            sampling=options.sampling,
            width=trainer.config.width,
            rays=options.rays,
            samples=trainer.config.samples,
            bfloat16=options.bfloat16,
            steps=options.steps,
            occupancy=options.occupancy,
            samples_a_step=samples / options.steps,
            ns_a_sample=1e9 * used / samples,
            step_ms=statistics.median(times),
            processor_ms=whole,
            step_iqr_ms=_spread(times),
            profiled_step_ms=profiled_ms,
        ),
        "results": [
            *(
                {"part": part, "ms": ms, "share": ms / whole, "ns": 1e6 * ms * options.steps / samples}
                for part, ms in sums.items()
            ),
            *operators,
        ],
    }


@contextlib.contextmanager
def clocked() -> Iterator[Counter[str]]:
    """The seconds of processor time that each compiled function has taken since, by its name."""
    spent: Counter[str] = Counter()

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            start = time.process_time()
            result = function(*given)
            spent[name] += time.process_time() - start
            return result

        return call

    compiled = native.compiled
    every = [key for key in vars(compiled) if key[0].islower() and callable(getattr(compiled, key))]
    before = {name: getattr(compiled, name) for name in every}
    for name, function in before.items():
        setattr(compiled, name, timed(name, function))
    try:
        yield spent
    finally:
        for name, function in before.items():
            setattr(compiled, name, function)


def show(result: dict[str, Any], top: int) -> None:
    """Prints the parts of a step and its slowest operators."""
    about = result["metadata"]
    print(
        f"{about['data']}, {about['field']}, {about['sampling']}, {about['cells']} cells of width {about['width']}, "
        f"{about['rays']} rays x "
        f"{about['samples']} samples, {about['threads']} threads: {about['step_ms']:.2f} ms a step "
        f"(spread {about['step_iqr_ms']:.2f}; profiled {about['profiled_step_ms']:.2f}); {about['ns_a_sample']:.0f} ns "
        f"of processor time for each of {about['samples_a_step']:.0f} samples"
    )
    rows = result["results"]
    for row in rows:
        if "part" in row:
            print(f"  {row['part']:22s} {row['ms']:8.3f} ms  {100 * row['share']:5.1f} %  {row['ns']:6.1f} ns a sample")
    for row in [row for row in rows if "operator" in row][:top]:
        print(f"    {row['operator']:44s} {row['ms']:8.3f} ms  {row['calls']:6.1f} calls")


def _spread(times: list[float]) -> float:
    quarters = statistics.quantiles(times, n=4)
    return quarters[2] - quarters[0]


if __name__ == "__main__":
    main()
