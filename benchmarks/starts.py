"""Checks that training starts to learn with every seed, for several numbers of rays; runs only the first steps.

    python benchmarks/starts.py --data SHIP LEGO --downscale 4 --steps 300 --json benchmarks/results/starts.json
    python benchmarks/starts.py --data BONSAI --downscale 8 --steps 440 --json benchmarks/results/starts.json

A training fails if its PSNR is less than `ABOVE` dB above the PSNR of one-colour pictures. It also fails if its PSNR is
more than `BELOW` dB below the median of its scene's trainings with the fewest rays, because more rays per step should
not make a training worse. Seconds are processor time. To measure another version, put its folder into PYTHONPATH and
set ``--label``.
"""

from __future__ import annotations

import json
import statistics
import time
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

#: Thresholds of a failed training in decibels, see the module's docstring.
ABOVE, BELOW = 3.0, 4.0


@dataclass(frozen=True)
class Options:
    """The settings of the trainings."""

    data: tuple[str, ...] = ("builtin",)
    """Folders of scenes, or built-in scenes."""
    downscale: int = 1
    """The factor by which the images are downscaled on load."""
    rays: tuple[int, ...] = (512, 1024, 2048, 4096)
    """Numbers of rays in the first step."""
    seeds: int = 8
    """The number of seeds (0, 1, ...) for each number of rays."""
    steps: int = 400
    """The steps to run."""
    planned: int = 6000
    """The planned steps of the whole training; its schedules depend on them."""
    eval_views: int = 3
    """The test views of the final evaluation."""
    label: str = "now"
    """The label of the measured version."""
    json: Path | None = None
    """The JSON file that the results are added to. Default: results are only printed."""


class StopAt(Callback):
    """A callback that ends a training after ``step`` steps."""

    def __init__(self, step: int) -> None:
        self.step = step

    def after_step(self, state: State) -> None:
        """Stops the training at the last step."""
        if state.step >= self.step:
            state.stop()


def judged(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Marks failed trainings of one scene in ``rows``; returns failures and median PSNR by number of rays."""
    by_rays: dict[int, list[dict[str, Any]]] = {}
    for row in rows:
        by_rays.setdefault(row["rays"], []).append(row)
    medians = {rays: statistics.median(row["psnr"] for row in found) for rays, found in sorted(by_rays.items())}
    for row in rows:
        row["failed"] = not row["psnr"] >= max(row["one_colour"] + ABOVE, medians[min(medians)] - BELOW)
    names = ("label", "scene", "downscale", "steps", "planned")
    return {
        **{name: rows[0][name] for name in names},
        "seeds": len(by_rays[min(medians)]),
        "failures": {rays: sum(row["failed"] for row in by_rays[rays]) for rays in medians},
        "median_psnr": medians,
    }


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Adds the trainings of a scene to a file; replaces its trainings with the same scene and label."""
    stored = json.loads(path.read_text())["results"] if path.is_file() else {"scenes": [], "trainings": []}
    key = rows[0]["label"], rows[0]["scene"]
    kept = {name: [r for r in found if (r["label"], r["scene"]) != key] for name, found in stored.items()}
    results = {"scenes": [*kept["scenes"], judged(rows)], "trainings": [*kept["trainings"], *rows]}
    write_text(path, json_text({"metadata": metadata(benchmark="starts"), "results": results}, indent=1) + "\n")


def main(options: Options) -> None:
    """Trains, prints each training and the failures by number of rays, and writes the results."""
    torch.set_num_threads(1)
    for data in options.data:
        scene, rows = load_scene(data, downscale=options.downscale), list[dict[str, Any]]()
        common = {"label": options.label, "scene": scene.name, "downscale": options.downscale}
        common |= {"steps": options.steps, "planned": options.planned, "one_colour": one_colour_psnr(scene)}
        for rays in sorted(options.rays):
            for seed in range(options.seeds):
                config = TrainConfig(data=data, steps=options.planned, split_at=(0.9,), rays=rays, seed=seed)
                state, started = build(config, scene), time.process_time()
                train(state, [StopAt(options.steps)])
                seconds = time.process_time() - started
                with state.averaged():
                    psnr = mean_scores(evaluate(state.renderer, scene, views=options.eval_views))["psnr"]
                scores = {"rays": rays, "seed": seed, "samples": state.sampler.samples, "psnr": psnr}
                scores |= {"share": state.sampler.grid.share, "draws": len(state.stages), "cpu_seconds": seconds}
                rows.append({**common, **scores})
                print(f"{scene.name} {rays} rays, seed {seed}: {psnr:.2f} dB, {seconds:.1f} s", flush=True)
        print(f"{scene.name}: failures of {options.seeds} seeds {judged(rows)['failures']}", flush=True)
        if options.json is not None:
            write(options.json, rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=(__doc__ or "").split("\n\n")[0], config=(tyro.conf.OmitArgPrefixes,)))
