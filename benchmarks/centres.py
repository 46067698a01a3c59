"""PSNR by where the centres of the cells lie, with how even and how compact these cells are.

Cells gain over one network with the same seed, which starts from the same weights and sees the same rays.

    python benchmarks/centres.py --scenes ../shared/data/lego --downscale 8 --steps 400 --cells 16 \\
        --fields nerf "hashgrid levels=8" --seeds 3 --json results/centres.json

Every placement trains for the same number of steps. The file of `--json` is written after each training; the next call
with the same settings makes only the rows that it lacks, so scenes, fields, cells, placements and seeds can be added.

A row: `imbalance` is std(W / max W) of the importance W of the final cells. `radius` is the root-mean-square distance
of a cell's samples from their mean, `diagonal` the diagonal of their box: mean and maximum over the cells with samples,
relative to the diagonal of the box of all samples. All by the samples that the run kept for its last split.
"""

from __future__ import annotations

import itertools
import json
import statistics
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from balance import load_samples
from harness import metadata
from torch import Tensor

from voronerf.cli.main import EXPECTED
from voronerf.data import load_scene
from voronerf.diagram import VoronoiDiagram, imbalance
from voronerf.diagram.balance import cell_weights
from voronerf.files import write_text
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.trainer import Trainer

PLACEMENTS: dict[str, dict[str, Any]] = {
    "single": {},
    "published": {"centres": "balanced"},
    "transport": {"centres": "balanced", "balance": "transport"},
    "centroidal": {},
    "centroidal-transport": {"balance": "transport"},
    "random": {"centres": "random"},
    "regular": {"centres": "uniform"},
}
KEY = ("scene", "field", "cells", "placement", "seed")


@dataclass(frozen=True)
class Options:
    """What to train, and for how long."""

    scenes: tuple[str, ...] = ("builtin",)
    """Scene folders or built-in scenes."""
    fields: tuple[str, ...] = ("nerf",)
    """Fields, each with its options in the same argument: "hashgrid levels=8 entries=4096"."""
    placements: tuple[str, ...] = tuple(PLACEMENTS)
    """Of: single (one network), published, transport, centroidal, centroidal-transport, random, regular."""
    cells: tuple[str, ...] = ("16",)
    """Numbers of cells; 16x16 is nested."""
    seeds: int = 3
    """Trainings of each, with seeds 0, 1, ..."""
    steps: int = 2000
    """Steps of each."""
    downscale: int = 1
    """Factor by which the images are made smaller."""
    rays: int = 1024
    """Rays per step."""
    samples: int = 64
    """Samples per ray."""
    occupancy: bool = False
    """Skip empty space."""
    eval_views: int = 20
    """Test views of the evaluation at the end."""
    backend: str = "auto"
    """Backend of the operations."""
    json: Path | None = None
    """Where the rows go, and which of them are there already; default: printed only."""


def configuration(options: Options, row: dict[str, Any], scene: str, out: Path) -> TrainConfig:
    """The settings of a row's training.

    Raises:
        ConfigError: for settings that do not exist or do not fit.
    """
    field, *field_options = row["field"].split()
    try:
        cells = () if row["placement"] == "single" else tuple(int(k) for k in row["cells"].split("x"))
    except ValueError:
        raise ConfigError(f"--cells must be numbers such as 16 or 16x16, got {row['cells']!r}") from None
    return TrainConfig(
        data=scene,
        downscale=options.downscale,
        out=out,
        seed=row["seed"],
        steps=options.steps,
        field=field,
        field_options=tuple(field_options),
        cells=cells,
        rays=options.rays,
        samples=options.samples,
        occupancy=options.occupancy,
        ray_growth=1.0,
        evaluations=1,
        eval_views=options.eval_views,
        final_views=options.eval_views,
        panels=0,
        lpips=Path("off"),
        checkpoint_every=1e9,
        backend=options.backend,
        **PLACEMENTS[row["placement"]],
    )


def shape_of_cells(diagram: VoronoiDiagram, points: Tensor, importance: Tensor) -> dict[str, float]:
    """Spread of importance [m] and extent of the cells of points [m, 3]; see the head of this file."""
    points = points.cpu().double()
    cells = diagram.locate(points.float().to(diagram.centres.device)).cpu()
    scene = float((points.amax(0) - points.amin(0)).norm())
    inside = [points[cells == cell] for cell in cells.unique().tolist()]
    radius = torch.stack([(own - own.mean(0)).square().sum(1).mean().sqrt() for own in inside]) / scene
    diagonal = torch.stack([(own.amax(0) - own.amin(0)).norm() for own in inside]) / scene
    return {
        "imbalance": imbalance(cell_weights(cells, importance.cpu(), diagram.num_cells)),
        "radius_mean": float(radius.mean()),
        "radius_max": float(radius.max()),
        "diagonal_mean": float(diagonal.mean()),
        "diagonal_max": float(diagonal.max()),
        "without_samples": diagram.num_cells - len(inside),
    }


def rows(options: Options) -> list[tuple[str, dict[str, Any]]]:
    """Path of the scene, and key, of every training that is asked for; one network is trained once for all cells."""
    unknown = [name for name in options.placements if name not in PLACEMENTS]
    if unknown:
        raise ConfigError(f"--placements must be of {', '.join(PLACEMENTS)}, got {', '.join(unknown)}")
    found = {}
    for scene, field, cells, seed, placement in itertools.product(
        options.scenes, options.fields, options.cells, range(options.seeds), options.placements
    ):
        values = (Path(scene).name, field, "1" if placement == "single" else cells, placement, seed)
        found[values] = (scene, dict(zip(KEY, values, strict=True)))
    return list(found.values())


def measure(options: Options) -> dict[str, Any]:
    """Trains what the file of results lacks; returns {metadata, results}."""
    names = ("steps", "downscale", "rays", "samples", "occupancy", "eval_views")
    settings = {name: getattr(options, name) for name in names}
    results: list[dict[str, Any]] = []
    if options.json is not None and options.json.is_file():
        stored = json.loads(options.json.read_text())
        made = {name: stored["metadata"].get(name) for name in names}
        if made != settings:
            raise ConfigError(f"--json must name a file of the same settings, got {options.json} of {made}")
        results = stored["results"]
    outcome = {"metadata": metadata(benchmark="centres", **settings), "results": results}
    there = {tuple(row[name] for name in KEY) for row in results}
    scenes: dict[str, Any] = {}
    for scene, row in rows(options):
        if tuple(row.values()) in there:
            continue
        if scene not in scenes:
            scenes = {scene: load_scene(scene, downscale=options.downscale)}
        with tempfile.TemporaryDirectory() as folder:
            trainer = Trainer(configuration(options, row, scene, Path(folder) / "run"), scenes[scene])
            summary = trainer.run()
            row |= {name: summary[name] for name in ("psnr", "steps", "seconds", "parameters")}
            if row["placement"] != "single":
                levels = len(trainer.config.cells)
                kept = load_samples(trainer.out / "samples" / f"level-{levels}.npz")
                row |= shape_of_cells(trainer.router.diagram, *kept)
        results.append(row)
        print(line(row), flush=True)
        if options.json is not None:
            write_text(options.json, json.dumps(outcome, indent=1) + "\n")
    return outcome


def line(row: dict[str, Any]) -> str:
    """One row of the printed table."""
    text = f"{row['scene']:10} {row['field']:16} {row['cells']:>6} {row['placement']:21} {row['seed']:4}"
    text += f" {row['psnr']:7.2f} {row['seconds']:8.1f}"
    if "imbalance" in row:
        for name in ("imbalance", "radius_mean", "radius_max", "diagonal_mean", "diagonal_max"):
            text += f" {row[name]:10.4f}"
    return text


def table(results: list[dict[str, Any]]) -> str:
    """Gain in dB over one network with the same seed: mean, least and most over the seeds, as Markdown.

    Imbalance and the largest radius are means over all runs of a placement.
    """
    single = {(r["scene"], r["field"], r["seed"]): r["psnr"] for r in results if r["placement"] == "single"}
    gains: dict[tuple[str, str, str], dict[str, list[float]]] = {}
    shapes: dict[str, list[tuple[float, float]]] = {}
    for row in results:
        one = single.get((row["scene"], row["field"], row["seed"]))
        if one is None or row["placement"] == "single":
            continue
        where = (row["scene"], row["field"], row["cells"])
        gains.setdefault(where, {}).setdefault(row["placement"], []).append(row["psnr"] - one)
        shapes.setdefault(row["placement"], []).append((row["imbalance"], row["radius_max"]))
    names = [name for name in PLACEMENTS if name in shapes]
    lines = [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for (scene, field, cells), found in gains.items():
        values = (found.get(name) for name in names)
        texts = [f"{statistics.mean(v):+.2f} ({min(v):+.2f} to {max(v):+.2f})" if v else "-" for v in values]
        lines.append(f"| {scene}, {field}, {cells} cells | {' | '.join(texts)} |")
    for i, what in enumerate(("imbalance", "largest radius")):
        means = (f"{statistics.mean(shape[i] for shape in shapes[name]):.3f}" for name in names)
        lines.append(f"| {what}, mean of all | {' | '.join(means)} |")
    return "\n".join(lines)


def main() -> int:
    """Measures, prints and stores."""
    options = tyro.cli(Options, description=__doc__)
    print(
        f"{'scene':10} {'field':16} {'cells':>6} {'placement':21} seed    PSNR  seconds"
        "  imbalance  r mean      r max     box mean    box max"
    )
    print(table(measure(options)["results"]))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except EXPECTED as error:
        sys.exit(f"centres: {error}")
