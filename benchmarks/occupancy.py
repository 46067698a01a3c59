"""The gain of skipping empty space: training in half the time, and pictures of a trained scene.

    python benchmarks/occupancy.py --budget 60 --json benchmarks/results/occupancy.json
    python benchmarks/occupancy.py --trained RUN      pictures of a finished run that was trained without a grid

Two runs of one scene take turns in one process: one without a grid, one with, which gets `--share` of the time. Then
test views of the first run are rendered at `--size`, alternately with every sample and through a grid
made from the field; the time to make the grid is given apart. The same for the run trained with the grid, by its own.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from harness import metadata

from voronerf.cli.main import EXPECTED
from voronerf.data import builtin_scene
from voronerf.evaluation.metrics import psnr
from voronerf.evaluation.scores import render_view
from voronerf.files import write_text
from voronerf.run import open_run
from voronerf.training.config import TrainConfig
from voronerf.training.occupancy import make_picture_grid
from voronerf.training.run_directory import read_metrics, stored_config
from voronerf.training.trainer import Trainer


@dataclass(frozen=True)
class Options:
    """How long to train, and what to render."""

    budget: float = 60.0
    """Training seconds of the run without a grid."""
    share: float = 0.5
    """Of them, what the run with a grid gets."""
    turn: float = 5.0
    """Seconds that the first run trains before the other has its turn."""
    eval_views: int = 5
    """Test views of each evaluation."""
    size: int = 400
    """Pixels along the side of the rendered pictures."""
    views: int = 3
    """Test views rendered; 0 for none."""
    trained: Path | None = None
    """Run directory, trained on the built-in scene without a grid: its pictures alone, no training."""
    repeats: int = 3
    """Times each is rendered; the median counts."""
    seed: int = 0
    """Of both runs."""
    json: Path | None = None
    """Where the results go; default: printed only."""


def train(options: Options, folder: Path) -> dict[str, Trainer]:
    """Both runs to the end of their time."""
    scene = builtin_scene(100)
    trainers = {}
    for name, share in (("plain", 1.0), ("occupancy", options.share)):
        config = TrainConfig(
            out=folder / name,
            budget=options.budget * share,
            field="nerf",
            occupancy=name == "occupancy",
            evaluations=4,
            eval_views=options.eval_views,
            final_views=options.eval_views,
            seed=options.seed,
            checkpoint_every=1e9,
        )
        trainers[name] = Trainer(config, scene, on_event=lambda line, label=name: print(f"{label:10} {line}"))
    done = 0.0
    while done < options.budget:
        done += options.turn
        trainers["plain"].advance(done)
        trainers["occupancy"].advance(done * options.share)
    for trainer in trainers.values():
        trainer.run()
    return trainers


def render(options: Options, folders: Mapping[str, Path]) -> list[dict[str, Any]]:
    """Seconds and PSNR of test views, dense and through a grid in turn."""
    if options.views < 1:
        return []
    scene = builtin_scene(options.size, train_views=1, test_views=options.views)
    background = scene.background_colour()
    results = []
    for name, folder in folders.items():
        run = open_run(folder, scene=scene)
        renderer, own = run.renderer, run.renderer.occupancy
        started = time.perf_counter()
        grid = own or make_picture_grid(run.config, scene, renderer.field)
        made_in = time.perf_counter() - started
        ways = {"dense": None, "grid": grid} if own is None else {"own grid": grid}
        seconds: dict[str, list[float]] = {way: [] for way in ways}
        scores: dict[str, list[float]] = {way: [] for way in ways}
        for repeat in range(options.repeats + 1):
            for view in range(options.views):
                truth = scene.test.truth(view, background)
                for way, occupancy in ways.items():
                    started = time.perf_counter()
                    renderer.occupancy = occupancy
                    image = render_view(renderer, scene, view, heaviest=False)
                    took = time.perf_counter() - started
                    if repeat > 0:  # the first warms up
                        seconds[way].append(took)
                    else:
                        scores[way].append(float(psnr(image.colour.clamp(0, 1), truth)))
        for way, occupancy in ways.items():
            results.append(
                {
                    "run": name,
                    "way": way,
                    "seconds": statistics.median(seconds[way]),
                    "spread": [min(seconds[way]), max(seconds[way])],
                    "psnr": statistics.fmean(scores[way]),
                    "occupied": None if occupancy is None else occupancy.share,
                    "grid_seconds": None if occupancy is None else made_in,
                }
            )
    return results


def main() -> int:
    """Measures, prints and, where asked to, writes."""
    options = tyro.cli(Options, description=__doc__)
    with tempfile.TemporaryDirectory() as folder:
        trainers = {} if options.trained is not None else train(options, Path(folder))
        folders = {name: trainer.out for name, trainer in trainers.items()}
        if options.trained is not None:
            folders[options.trained.name] = options.trained
        pictures = render(options, folders)
        runs = [
            {
                "run": name,
                "seconds": trainer.seconds,
                "steps": trainer.step,
                "psnr": trainer.metrics[-1]["psnr"],
                "curve": read_metrics(trainer.out),
            }
            for name, trainer in trainers.items()
        ]
    for run in runs:
        print(f"{run['run']:10} {run['seconds']:6.1f} s  {run['steps']:6d} steps  {run['psnr']:.2f} dB")
    for row in pictures:
        print(f"{row['run']:10} {row['way']:9} {row['seconds']:7.3f} s a picture  {row['psnr']:.2f} dB")
    both = {row["way"]: row for row in pictures}
    if "dense" in both:
        dense, grid = both["dense"], both["grid"]
        print(f"rendering: {dense['seconds'] / grid['seconds']:.1f} x, {grid['psnr'] - dense['psnr']:+.3f} dB")
    how: dict[str, Any] = {"budget": options.budget, "share": options.share}
    if options.trained is not None:
        config = stored_config(options.trained)
        names = ("data", "downscale", "steps", "budget", "rays", "samples", "seed")
        how = {"trained": {name: getattr(config, name) for name in names}}
    outcome = {
        "metadata": metadata(benchmark="occupancy", scene="builtin", size=options.size, **how),
        "results": {"training": runs, "rendering": pictures},
    }
    if options.json is not None:
        write_text(options.json, json.dumps(outcome, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except EXPECTED as error:
        sys.exit(f"occupancy: {error}")
