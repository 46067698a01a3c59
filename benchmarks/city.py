"""Quality at equal time as a scene grows: one network and cells in the built-in city of 1 x 1, 2 x 2, ... blocks.

    python benchmarks/city.py --json benchmarks/results/city.json

Every training has the same processor time, on one thread, so that other work on the machine takes none of it. The file
of `--json` is written after each training; the next call makes only the rows that it lacks. A row has PSNR and SSIM of
test views, half of them from the street, after half of the time too, and the time of a step and of a sample.

What a block is given does not depend on the city: grids have 128 cells along it, and views 50 x 50 pixels. Rays through
larger cities are longer, and have more samples, by the square root of the blocks on a side.
"""

from __future__ import annotations

import itertools
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from centres import PLACEMENTS
from harness import metadata

from voronerf.data import Scene, city_scene
from voronerf.files import write_text
from voronerf.training.config import TrainConfig
from voronerf.training.trainer import Trainer

#: Name, placement of `centres.py` and cells.
METHODS: dict[str, tuple[str, tuple[int, ...]]] = {
    "one network": ("single", ()),
    "16 balanced": ("centroidal-transport", (16,)),
    "16 regular": ("regular", (16,)),
    "16 random": ("random", (16,)),
    "16 x 16 balanced": ("centroidal-transport", (16, 16)),
}
#: Name and the settings of the training: a small network, and a hash grid of so few entries for each cell.
FIELDS: dict[str, dict[str, Any]] = {
    "hash grid 2^12": {"field": "hashgrid", "field_options": ("log2_entries=12",), "cell_tables": True},
    "MLP of 32": {"field": "kilonerf"},
}
#: When a run with so many levels splits, as fractions of it.
SPLITS = {0: None, 1: (0.1,), 2: (0.05, 0.15)}
KEY = ("field", "method", "seed")


@dataclass(frozen=True)
class Options:
    """What to train, and for how long."""

    blocks: tuple[int, ...] = (1, 2, 4, 8)
    """Blocks on a side of each city."""
    fields: tuple[str, ...] = tuple(FIELDS)
    """Of: "hash grid 2^12", "MLP of 32"."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Of: "one network", "16 balanced", "16 regular", "16 random", "16 x 16 balanced"."""
    seeds: tuple[int, ...] = (0,)
    """Of the trainings of each."""
    seconds: float = 60.0
    """Processor time of each."""
    size: int = 50
    """Pixels of an image's side."""
    rays: int = 256
    """Rays of the first steps; up to eight times as many where space is empty."""
    samples: int = 96
    """Samples of a ray through one block."""
    eval_views: int = 24
    """Test views that are scored."""
    json: Path | None = None
    """Where the rows go, and which of them are there already; default: printed only."""


def train(options: Options, scene: Scene, blocks: int, method: str, field: str, seed: int) -> dict[str, Any]:
    """Trains once; returns the figures."""
    placement, cells = METHODS[method]
    settings = dict(FIELDS[field])
    if settings["field"] == "hashgrid":
        settings["field_options"] += (f"finest={128 * blocks}",)
    with tempfile.TemporaryDirectory() as folder:
        config = TrainConfig(
            data=scene.name,
            out=Path(folder) / "run",
            seed=seed,
            budget=options.seconds,
            cells=cells,
            split_at=SPLITS[len(cells)],
            rays=options.rays,
            ray_growth=8.0,
            samples=round(options.samples * blocks**0.5),
            evaluations=2,
            eval_views=options.eval_views,
            final_views=options.eval_views,
            panels=0,
            lpips=Path("off"),
            checkpoint_every=1e9,
            **settings,
            **PLACEMENTS[placement],
        )
        trainer = Trainer(config, scene, clock=time.process_time)
        evaluated: list[int] = []
        assert trainer.occupancy is not None
        march = trainer.occupancy.march

        def counted(*given: Any, **named: Any) -> Any:
            found = march(*given, **named)
            if "start" not in named:  # not for a picture
                evaluated.append(len(found.positions))
            return found

        trainer.occupancy.march = counted  # type: ignore[method-assign]
        summary = trainer.run()
    found = {name: summary[name] for name in ("psnr", "ssim", "steps", "seconds", "parameters", "cells")}
    found["psnr_half"] = trainer.metrics[0]["psnr"]
    rays, samples = trainer.rays_done / summary["steps"], sum(evaluated)
    times = {"step_ms": 1e3 * summary["seconds"] / summary["steps"], "sample_ns": 1e9 * summary["seconds"] / samples}
    return found | times | {"rays": rays, "samples": samples / summary["steps"]}


def measure(options: Options) -> dict[str, Any]:
    """Trains what the file of results lacks; returns {metadata, results}."""
    names = ("seconds", "size", "rays", "samples", "eval_views")
    settings = {name: getattr(options, name) for name in names}
    outcome = {"metadata": metadata(benchmark="city", **settings), "results": []}
    if options.json is not None and options.json.is_file():
        outcome = json.loads(options.json.read_text())
        if any(outcome["metadata"][name] != value for name, value in settings.items()):
            raise SystemExit(f"--json must name a file of the same settings, got {options.json}")
    rows = {tuple(row[name] for name in KEY): row for row in outcome["results"]}
    scenes: dict[int, Scene] = {}
    asked = itertools.product(options.seeds, options.fields, options.methods, options.blocks)
    for seed, field, method, blocks in asked:
        key, city = (field, method, seed), f"{blocks} x {blocks}"
        row = rows.setdefault(key, dict(zip(KEY, key, strict=True)) | {"cities": {}})
        if city in row["cities"]:
            continue
        if blocks not in scenes:
            scenes[blocks] = city_scene(options.size, blocks=blocks, images="cached")
        found = train(options, scenes[blocks], blocks, method, field, seed)
        single = rows.get((field, "one network", seed), row)["cities"].get(city, found)
        row["cities"][city] = found | {"gain": found["psnr"] - single["psnr"]}
        outcome["results"] = list(rows.values())
        print(field, method, city, seed, row["cities"][city], flush=True)
        if options.json is not None:
            write_text(options.json, json.dumps(outcome, indent=1) + "\n")
    return outcome


def table(results: list[dict[str, Any]]) -> str:
    """PSNR, the gain over one network and the milliseconds of a step in each city, as Markdown."""
    cities = sorted({city for row in results for city in row["cities"]})
    heads = [f"{city}: {name}" for city in cities for name in ("PSNR [dB]", "gain", "step [ms]")]
    lines = [f"| field, cells, seed | {' | '.join(heads)} |", "| --- |" + " --- |" * len(heads)]
    for row in results:
        entries = []
        for city in cities:
            found = row["cities"].get(city)
            entries += (
                [f"{found['psnr']:.2f}", f"{found['gain']:+.2f}", f"{found['step_ms']:.1f}"] if found else ["-"] * 3
            )
        lines.append(f"| {row['field']}, {row['method']}, {row['seed']} | {' | '.join(entries)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(table(measure(tyro.cli(Options, description=__doc__))["results"]))
