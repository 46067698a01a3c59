"""Trains with several learning rates, and records for each whether the training learns and what it reports.

    python benchmarks/learning_rates.py --data LEGO SHIP --json benchmarks/results/learning_rates.json
    python benchmarks/learning_rates.py --data FOX --downscale 4 --json benchmarks/results/learning_rates.json

Rays have the strata of a long training (480 seconds), since the threshold of the occupancy grid grows with them. A
training learns if its PSNR is at least `ABOVE` dB above the PSNR of one-colour pictures. Seconds are processor time. To
measure another version, put its folder into PYTHONPATH and set ``--label``.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import metadata

from voronerf.app.files import json_text, write_text
from voronerf.app.scenes import load_scene
from voronerf.app.train import Divergence, Scores, TrainConfig, TrainingError, build, run
from voronerf.app.train.callbacks import one_colour_psnr

#: The PSNR of a training that learns, in decibels above the PSNR of one-colour pictures.
ABOVE = 3.0


@dataclass(frozen=True)
class Options:
    """The settings of the trainings."""

    data: tuple[str, ...] = ("builtin",)
    """Folders of scenes, or built-in scenes."""
    downscale: int = 1
    """The factor by which the images are downscaled on load."""
    rates: tuple[float, ...] = (2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 0.02, 0.06, 0.2)
    """The learning rates."""
    budget: float = 15.0
    """The processor time of a training in seconds."""
    samples: int = 256
    """The strata per ray."""
    eval_views: int = 2
    """The test views of an evaluation."""
    label: str = "now"
    """The label of the measured version."""
    json: Path | None = None
    """The JSON file that the results are added to. Default: results are only printed."""


def trained(scene: Any, data: str, lr: float, options: Options) -> dict[str, Any]:
    """Trains a scene with a learning rate; returns scores, restarts and the reported lines other than scores."""
    more = {"samples": (options.samples,), "evaluations": 4, "eval_views": options.eval_views}
    config = TrainConfig(data=data, budget=options.budget, lr=lr, **more)
    said, scores = list[str](), Scores(None, clock=time.process_time)
    state = build(config, scene, on_event=said.append)
    try:
        run(state, [Divergence(Path(data)), scores], clock=time.process_time)
    except TrainingError as error:
        said.append(str(error))
    psnr, one_colour = scores.summary.get("psnr"), one_colour_psnr(scene)
    restarts = sum(stage.cells == 1 for stage in state.stages) - 1
    result = {"rate": lr, "psnr": psnr, "one_colour": one_colour, "learns": (psnr or 0.0) >= one_colour + ABOVE}
    lines = [line for line in said if "  psnr " not in line and " cells at " not in line]
    return {**result, "steps": state.step, "restarts": restarts, "reported": lines}


def write(path: Path, row: dict[str, Any]) -> None:
    """Adds a training to a file, or replaces the training of the same label, scene and rate; sums up each scene."""
    stored = json.loads(path.read_text())["results"]["trainings"] if path.is_file() else []
    key, rows = (
        ("label", "scene"),
        [r for r in stored if any(r[name] != row[name] for name in ("label", "scene", "rate"))],
    )
    groups = dict[tuple[str, ...], list[dict[str, Any]]]()
    for each in [*rows, row]:
        groups.setdefault(tuple(each[name] for name in key), []).append(each)
    scenes = [
        {**dict(zip(key, names)), "one_colour": found[0]["one_colour"], "psnr": {r["rate"]: r["psnr"] for r in found}}
        for names, found in groups.items()
    ]
    results = {"scenes": scenes, "trainings": [*rows, row]}
    write_text(path, json_text({"metadata": metadata(benchmark="learning_rates"), "results": results}, indent=1) + "\n")


def main(options: Options) -> None:
    """Trains, prints each training, and writes the results."""
    torch.set_num_threads(1)
    for data in options.data:
        scene = load_scene(data, downscale=options.downscale)
        for rate in options.rates:
            common = {"label": options.label, "scene": scene.name, "downscale": options.downscale}
            row = {**common, "budget": options.budget, **trained(scene, data, rate, options)}
            print(json_text(row), flush=True)
            if options.json is not None:
                write(options.json, row)


if __name__ == "__main__":
    main(tyro.cli(Options, description=(__doc__ or "").split("\n\n")[0], config=(tyro.conf.OmitArgPrefixes,)))
