"""Where the milliseconds of a training step go.

    python benchmarks/step_profile.py --data DIR --downscale 4
    python benchmarks/step_profile.py --data builtin --json profile.json

Trains a scene until it has cells, then times whole steps, and profiles as many: the profiler's time of every
operator is added up by what the operator is for. What the operators do not account for is Python and the dispatcher.
The profiler makes small operators look slower than they are, so both times of a step are shown.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from harness import metadata
from torch.profiler import ProfilerActivity, profile

from voronerf.cli.main import EXPECTED
from voronerf.data import load_scene
from voronerf.files import write_text
from voronerf.training.config import SamplingName, TrainConfig
from voronerf.training.trainer import Trainer

# What operators are for, by what their names hold; the first that fits. The time of a forward pass that is recorded for
# autograd stands under a name such as GeneratedBackwardFor_voronerf_routed_mlp_native_default.
PARTS = {
    "route": ("routed_mlp", "grouped_mlp", "grouped_linear"),
    "cells": ("nearest_centre", "locate_cell", "cell_sort"),
    "composite": ("composite", "render_loss"),
    "batch": ("pixel_rays",),
    "march and occupancy": ("march_rays", "update_occupancy"),
    "encoding": ("hash_encode",),
    "optimiser": ("_fused_adam", "_foreach"),
    "other operators": ("",),
}


@dataclass(frozen=True)
class Options:
    """Which step to profile."""

    data: str = "builtin"
    """Scene folder or "builtin"."""
    downscale: int = 1
    """Factor by which the images are made smaller on load."""
    cells: int = 16
    """Cells; 1 is one network."""
    field: str = "nerf"
    """The networks, as for `voronerf train`."""
    sampling: SamplingName = "stratified"
    """Samples along a ray, likewise."""
    field_options: tuple[str, ...] = ()
    """Further options of the networks, each as NAME=VALUE."""
    occupancy: bool = False
    """Whether samples in empty space are left out; times are then also given for each sample that is kept."""
    width: int | None = None
    """Channels of the networks' hidden layers; default that of the field."""
    rays: int = 1024
    """Rays per step."""
    samples: int | None = None
    """Samples per ray; default that of the sampling."""
    bfloat16: bool = False
    """Networks under autocast to bfloat16."""
    warm: int = 20
    """Steps before, the split in their middle; an occupancy grid needs some 150 to find what is empty."""
    steps: int = 60
    """Steps to time, and as many to profile."""
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
    warm, every = options.warm, 2 * options.steps
    with tempfile.TemporaryDirectory() as folder:
        config = TrainConfig(
            data=options.data,
            downscale=options.downscale,
            out=Path(folder),
            # The split comes after the first tenth of the warm-up; nothing is evaluated or saved on the way.
            steps=warm + every + 1,
            cells=(options.cells,) if options.cells > 1 else (),
            split_at=(warm / 2 / (warm + every + 1),) if options.cells > 1 else None,
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
        kept: list[int] = []
        if trainer.occupancy is not None:
            march = trainer.occupancy.march

            def counted(*given: Any, **named: Any) -> Any:
                found = march(*given, **named)
                kept.append(len(found.positions))
                return found

            trainer.occupancy.march = counted  # type: ignore[method-assign]
        times = []
        used = time.process_time()
        for _ in range(options.steps):
            start = time.perf_counter()
            step()
            times.append(1e3 * (time.perf_counter() - start))
        used = time.process_time() - used
        samples = sum(kept) or options.steps * options.rays * int(trainer.config.samples or 0)
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
    for row in operators:
        name = row["operator"]
        sums[next(part for part, names in PARTS.items() if any(each in name for each in names))] += row["ms"]
    median = statistics.median(times)
    # Of the step as it is without the profiler: what is neither of the parts before it.
    accounted = sum(sums.values())
    sums["Python and dispatch"] = max(median - accounted, 0.0)
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
            step_ms=median,
            step_iqr_ms=_spread(times),
            profiled_step_ms=profiled_ms,
        ),
        "results": [
            *({"part": part, "ms": ms, "share": ms / median} for part, ms in sums.items()),
            *operators,
        ],
    }


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
            print(f"  {row['part']:22s} {row['ms']:8.3f} ms  {100 * row['share']:5.1f} %")
    for row in [row for row in rows if "operator" in row][:top]:
        print(f"    {row['operator']:44s} {row['ms']:8.3f} ms  {row['calls']:6.1f} calls")


def _spread(times: list[float]) -> float:
    quarters = statistics.quantiles(times, n=4)
    return quarters[2] - quarters[0]


if __name__ == "__main__":
    main()
