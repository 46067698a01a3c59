"""PSNR over training seconds: one wide network, one narrow network, and Voronoi cells of narrow networks.

    python benchmarks/time_to_quality.py --data builtin --budget 120
    python benchmarks/time_to_quality.py --data DIR --downscale 4 --budget 480 --variants w64 voronoi-16

All variants train the same scene for the same time with the same settings except for the networks. They take
turns of a few seconds in one process, so that the noise of a shared machine falls on all of them alike. The JSON holds
every evaluation; the plot shows them.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from harness import metadata
from turns import take_turns

from voronerf.cli.main import EXPECTED
from voronerf.data import load_scene
from voronerf.evaluation.panels import write_panels
from voronerf.evaluation.plots import plot_curves
from voronerf.files import write_text
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.run_directory import read_metrics
from voronerf.training.trainer import Trainer


@dataclass(frozen=True)
class Options:
    """What to compare, on which scene, for how long."""

    data: str = "builtin"
    """Scene folder or "builtin"."""
    downscale: int = 1
    """Factor by which the images are made smaller on load."""
    budget: float = 120.0
    """Training seconds of every variant."""
    variants: tuple[str, ...] = ("w256", "w64", "voronoi-16")
    """wN: one network of width N. voronoi-K or voronoi-KxK: K cells (per level) of width 64. Followed by @LR, with that
    learning rate."""
    seeds: int = 1
    """Runs of every variant, seeds 0, 1, ..."""
    turn: float = 10.0
    """Seconds that a variant trains before the next one has its turn."""
    evaluations: int = 8
    """Evaluations during the budget."""
    eval_views: int = 20
    """Test views of each evaluation, the last one included."""
    rays: int = TrainConfig.rays
    """Rays per step."""
    samples: int = 64
    """Samples per ray."""
    lr: float | None = None
    """Learning rate at the start; default: that of `voronerf train`, which depends on the width."""
    backend: str = "auto"
    """Backend of the operations."""
    json: Path | None = None
    """Where the results go; default: printed only."""
    plot: Path | None = None
    """Where the plot goes."""
    panels: Path | None = None
    """Folder for picture panels of each variant's first seed."""


def configuration(name: str, options: Options, seed: int, out: Path) -> TrainConfig:
    """The training configuration that a variant's name stands for.

    Raises:
        ConfigError: For a name of another form.
    """
    match = re.fullmatch(r"(w(?P<width>\d+)|voronoi-(?P<cells>\d+(x\d+)*))(@(?P<lr>[\d.e-]+))?", name)
    if match is None:
        raise ConfigError(f"--variants must be wN, voronoi-K or voronoi-KxK, got {name!r}")
    return TrainConfig(
        data=options.data,
        downscale=options.downscale,
        out=out,
        seed=seed,
        budget=options.budget,
        evaluations=options.evaluations,
        eval_views=options.eval_views,
        final_views=options.eval_views,
        rays=options.rays,
        samples=options.samples,
        lr=float(match["lr"]) if match["lr"] else options.lr,
        backend=options.backend,
        checkpoint_every=1e9,
        cells=tuple(int(k) for k in match["cells"].split("x")) if match["cells"] else (),
        width=int(match["width"] or 64),
    )


def compare(options: Options, folder: Path) -> dict[str, Any]:
    """Trains every variant and seed in turns; returns {metadata, results}."""
    scene = load_scene(options.data, downscale=options.downscale)
    trainers: dict[tuple[str, int], Trainer] = {}
    for name in options.variants:
        for seed in range(options.seeds):
            config = configuration(name, options, seed, folder / f"{name}-{seed}")
            trainers[name, seed] = Trainer(config, scene, on_event=lambda line, label=name: print(f"{label:12} {line}"))
    take_turns(trainers.values(), budget=options.budget, turn=options.turn)
    results = []
    for (name, seed), trainer in trainers.items():
        summary = trainer.run()
        lr = trainer.config.lr
        results.append({"variant": name, "seed": seed, "lr": lr, **summary, "curve": read_metrics(trainer.out)})
        if options.panels is not None and seed == 0:
            write_panels(trainer.renderer, trainer.router.diagram, scene, options.panels / name, views=3)
    description = metadata(
        benchmark="time_to_quality",
        scene=scene.name,
        downscale=options.downscale,
        train_views=len(scene.train),
        budget_seconds=options.budget,
        rays=options.rays,
        samples=options.samples,
        backend=options.backend,
    )
    return {"metadata": description, "results": results}


def table(outcome: dict[str, Any]) -> str:
    """PSNR at every evaluation, a line per run."""
    lines = [f"{'variant':14} {'seed':>4} {'steps':>7} {'parameters':>10}  psnr [dB] at [s]"]
    for r in outcome["results"]:
        points = "  ".join(f"{m['psnr']:.2f} @ {m['seconds']:.0f}" for m in r["curve"])
        lines.append(f"{r['variant']:14} {r['seed']:4} {r['steps']:7} {r['parameters']:10}  {points}")
    return "\n".join(lines)


def main(options: Options) -> None:
    """Runs the comparison and writes what was asked for."""
    with tempfile.TemporaryDirectory() as folder:
        outcome = compare(options, Path(folder))
    print(table(outcome))
    if options.json is not None:
        write_text(options.json, json.dumps(outcome, indent=1) + "\n")
    if options.plot is not None:
        results = outcome["results"]
        curves = {f"{r['variant']} ({r['seed']})": [(m["seconds"], m["psnr"]) for m in r["curve"]] for r in results}
        splits = {f"{r['variant']} ({r['seed']})": [s["started_at_second"] for s in r["stages"][1:]] for r in results}
        plot_curves(options.plot, curves, splits=splits, title=f"{outcome['metadata']['scene']}, equal training time")


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, config=(tyro.conf.OmitArgPrefixes,)))
    except EXPECTED as error:
        sys.exit(f"time_to_quality: error: {error}")
