"""Trains one scene with 1, 16 and very many cells for the same time: PSNR, and step time per sample.

    python benchmarks/many_cells.py --data builtin-city:8x8 --cells 1 16 65536 --seconds 60 --json FILE

All trainings have the same field, rays and learning rate. A coarse stage first trains one network for a fifth of the
time. The centres are then computed from its samples (`VoronoiDiagram.from_points`), and the networks of all cells begin
as copies of the coarse network. Computing the centres counts as training time.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from harness import Parser, threads, write_results

from voronerf import OccupancyGrid, VoronoiDiagram, VoronoiRouter
from voronerf.app.evaluate import evaluate, mean_scores
from voronerf.app.scenes import Scene, load_scene
from voronerf.nerf import Adam, Occupancy, RayBatches, RayLoss, Renderer, TrainingStep
from voronerf.nerf.fields import FIELDS
from voronerf.nerf.schedule import GROUP, learning_rate

COARSE = 0.2  # fraction of the time


def measure(scene: Scene, cells: int, options: argparse.Namespace) -> dict[str, Any]:
    """Trains with ``cells`` cells and returns the row of results."""
    torch.manual_seed(0)
    kind, generator, space = FIELDS[options.field], torch.Generator().manual_seed(0), scene.space()
    field = kind.build(json.loads(options.options))
    router = VoronoiRouter(field, torch.zeros(1, 3), coords="first3", **kind.router_options)
    grid = OccupancyGrid.for_training(scene.box, options.samples, contraction=space.contraction)
    sampler = Occupancy(grid, options.samples, space=space)
    renderer = Renderer({"field": router}, sampler).train()
    optimizer = Adam.of({"field": router}, lr=options.lr, views=len(scene.train), sparse=kind.sparse_parameters)
    where: dict[str, Any] = {
        "near": scene.near,
        "far": scene.far,
        "box": scene.box,
        "background": scene.background_colour(),
    }
    batches = RayBatches(scene.train.cameras, scene.train.images, masks=scene.train.masks, **where)
    training_step = TrainingStep(batches, RayLoss(renderer), optimizer, generator=generator)
    step = samples = since = 0
    points, placed, spent, start = list[torch.Tensor](), 0.0, 0.0, time.process_time()
    while (fraction := (time.process_time() - start) / options.seconds) < 1:
        if router.num_cells < cells and fraction > COARSE and sum(map(len, points)) >= 4 * cells:
            began = time.process_time()
            diagram = VoronoiDiagram.from_points(torch.cat(points), cells, generator=generator)
            router.subdivide(diagram, optimizer=optimizer)
            placed = time.process_time() - began
            points, samples, since, spent = [], 0, 0, 0.0
        optimizer.set_learning_rate(learning_rate(options.lr, fraction, step + GROUP // 2, hold=0.25))
        began = time.process_time()
        result = training_step(options.rays, GROUP, at=step)
        if since:  # the first group is recorded and not timed
            spent += time.process_time() - began
            samples += GROUP * result.samples
        step, since = step + GROUP, since + 1
        if router.num_cells < cells and fraction > COARSE / 2:
            points.append(result.output.samples.inputs.detach().clone())
    with optimizer.averaged():
        sampler.finish(router, seed=0)
        psnr = mean_scores(evaluate(renderer, scene, views=options.views))["psnr"]
    timed = (since - 1) * GROUP
    return {
        "cells": router.num_cells,
        "psnr": psnr,
        "steps": step,
        "ms": 1e3 * spent / timed,
        "samples": samples / timed,
        "us_a_sample": 1e6 * spent / samples,
        "placing_s": placed,
        "parameters": sum(p.numel() for p in router.parameters()),
    }


def main(arguments: list[str] | None = None) -> None:
    """Prints the results and writes the JSON."""
    parser = Parser("many_cells", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", default="builtin-city:8x8")
    parser.add_argument("--cells", type=int, nargs="+", default=[1, 16, 65_536])
    parser.add_argument("--seconds", type=float, default=60.0, help="processor seconds of each training")
    parser.add_argument("--field", default="nerf")
    parser.add_argument(
        "--options", default='{"width": 16, "depth": 1, "position_octaves": 5}', help="field options as JSON"
    )
    parser.add_argument("--rays", type=int, default=1024, help="rays of a step")
    parser.add_argument("--samples", type=int, default=128, help="strata of a ray")
    parser.add_argument("--lr", type=float, default=0.01)
    parser.add_argument("--views", type=int, default=24, help="number of evaluated views")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--json", type=Path, metavar="FILE", help="a JSON file for the results")
    options = parser.parse_args(arguments)
    scene, results = load_scene(options.data, downscale=options.downscale), []
    print("| cells | PSNR [dB] | steps | step [ms] | samples a step | a sample [us] |\n|---|---|---|---|---|---|")
    for cells in options.cells:
        with threads(1):
            results.append(result := measure(scene, cells, options))
        row = f"{result['psnr']:.2f} | {result['steps']} | {result['ms']:.1f} | {result['samples']:,.0f}"
        print(f"| {result['cells']:,} | {row} | {result['us_a_sample']:.2f} |", flush=True)
    asked = {name: value for name, value in vars(options).items() if name != "json"}
    write_results(options.json, results, benchmark="many_cells", seed=0, **asked)


if __name__ == "__main__":
    main()
