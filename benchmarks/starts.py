"""Whether every training learns, whatever its seed: the first steps of a long one, for several numbers of rays.

    python benchmarks/starts.py --data SHIP LEGO --downscale 4 --json benchmarks/results/starts.json

A training has failed if its PSNR is less than `ABOVE` dB above that of pictures of one colour, or more than `BELOW` dB
below the median of its scene's trainings with the fewest rays: more rays a step must not teach less. Seconds are those
of the processor. To measure an older version, put its folder into PYTHONPATH.
"""

from __future__ import annotations

import statistics
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import metadata

from voronerf.app.evaluate.scores import evaluate, mean_scores
from voronerf.app.files import json_text, write_text
from voronerf.app.scenes import load_scene
from voronerf.app.train import Callback, State, TrainConfig, build, train
from voronerf.app.train.callbacks import one_colour_psnr

#: Decibels, see above.
ABOVE, BELOW = 3.0, 4.0


@dataclass(frozen=True)
class Options:
    """Which trainings."""

    data: tuple[str, ...] = ("builtin",)
    """Scene folders or built-in scenes."""
    downscale: int = 1
    """Factor by which the images are made smaller on load."""
    rays: tuple[int, ...] = (512, 1024, 2048, 4096)
    """Rays of the first step."""
    seeds: int = 8
    """Seeds 0, 1, ... of each."""
    steps: int = 400
    """Steps that are made."""
    planned: int = 6000
    """Steps of the whole training, on which its settings depend."""
    eval_views: int = 3
    """Test views of the evaluation at the end."""
    json: Path | None = None
    """Where the results go, after each training; default: printed only."""


class StopAt(Callback):
    """Ends a training after so many steps."""

    def __init__(self, step: int) -> None:
        self.step = step

    def after_step(self, state: State) -> None:
        """Asks the training to end when it is time."""
        if state.step >= self.step:
            state.stop()


def fails(row: dict[str, Any], usual: float) -> bool:
    """Whether a training has failed; ``usual`` is the median of those with the fewest rays."""
    return not (row["psnr"] >= row["one_colour"] + ABOVE and row["psnr"] >= usual - BELOW)


def main(options: Options) -> None:
    """Trains, prints a line for each training and the failures of each number of rays, and writes the results."""
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for data in options.data:
        scene, found = load_scene(data, downscale=options.downscale), list[dict[str, Any]]()
        one_colour = one_colour_psnr(scene)
        for rays in sorted(options.rays):
            for seed in range(options.seeds):
                config = TrainConfig(data=data, steps=options.planned, split_at=(0.9,), rays=rays, seed=seed)
                state, started = build(config, scene), time.process_time()
                train(state, [StopAt(options.steps)])
                seconds = time.process_time() - started
                with state.averaged():
                    psnr = mean_scores(evaluate(state.renderer, scene, views=options.eval_views))["psnr"]
                row = {"scene": scene.name, "downscale": options.downscale, "rays": rays, "seed": seed}
                row |= {"samples": state.sampler.samples, "psnr": psnr, "one_colour": one_colour}
                row |= {"share": state.sampler.grid.share, "stages": len(state.stages), "cpu_seconds": seconds}
                found.append(row)
                print(f"{scene.name} {rays} rays, seed {seed}: {psnr:.2f} dB, {seconds:.1f} s", flush=True)
        usual = statistics.median(row["psnr"] for row in found if row["rays"] == min(options.rays))
        for row in found:
            row["failed"] = fails(row, usual)
        rows += found
        failures = Counter(row["rays"] for row in found if row["failed"])
        print(f"{scene.name}: failures {dict(failures) or 'none'} of {options.seeds} each", flush=True)
        if options.json is not None:
            entries = {"benchmark": "starts", "steps": options.steps, "planned": options.planned}
            write_text(options.json, json_text({"metadata": metadata(**entries), "results": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=(__doc__ or "").split("\n\n")[0], config=(tyro.conf.OmitArgPrefixes,)))
