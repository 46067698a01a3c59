"""How evenly a diagram's cells share the importance: std(W / max W) before and after, by method and number of cells.

    python benchmarks/balance.py                                        separate objects computed here
    python benchmarks/balance.py --samples runs/lego/samples/level-1.npz   what a training run kept for its split

Every method draws its first centres with seeds 0, 1, ...; medians over the seeds are printed, with the worst seed and
the time of one call. "heaviest" is the heaviest single sample in units of a cell's fair share: a sample cannot be
divided, so values near 1 and above limit what any method reaches.
"""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from harness import metadata
from torch import Tensor

from voronerf.diagram.balance import balance
from voronerf.diagram.transport import fair_share
from voronerf.files import write_text

METHODS: dict[str, dict[str, Any]] = {
    "published": {},
    "published, global": {"normalise": "global"},
    "published, weighted": {"init": "weighted"},
    "transport": {"method": "transport"},
    "centroidal": {"method": "centroidal"},
    "centroidal-transport": {"method": "centroidal-transport"},
}


@dataclass(frozen=True)
class Options:
    """Which samples, how many cells, by which methods."""

    samples: Path | None = None
    """File with points [m, 3] and importance [m] (.npz); default: separate objects, other ones for every seed."""
    cells: tuple[int, ...] = (4, 16, 32, 64, 256)
    """Numbers of cells."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Rows of the table, of: published; published, global; published, weighted; transport; centroidal;
    centroidal-transport."""
    seeds: int = 5
    """Calls of each row, with seeds 0, 1, ..."""
    objects: int = 9
    """Separate objects, where there is no file."""
    tail: float = 1.0
    """Standard deviation of the logarithm of their samples' importance."""
    count: int = 10_000
    """Number of their samples."""
    backend: str = "auto"
    """Backend of the cell queries."""
    json: Path | None = None
    """Where the results go; default: printed only."""


def separate_objects(seed: int, count: int, objects: int, tail: float) -> tuple[Tensor, Tensor]:
    """Samples near the surfaces of balls of different sizes and shares, scattered in a box of side 6, some touching."""
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(objects, 3, generator=generator) * 6 - 3
    radii = torch.rand(objects, generator=generator) * 0.5 + 0.15
    member = torch.multinomial(torch.rand(objects, generator=generator) + 0.2, count, True, generator=generator)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    distance = radii[member, None] * (1 + 0.02 * torch.randn(count, 1, generator=generator))
    importance = (tail * torch.randn(count, generator=generator)).exp() * (1 + 3 * normals[:, 0].clamp(min=0))
    return places[member] + normals * distance, importance


def load_samples(path: Path) -> tuple[Tensor, Tensor]:
    """The arrays "points" and "importance" of a file that a training run has written."""
    with np.load(path) as file:
        return torch.from_numpy(file["points"]), torch.from_numpy(file["importance"])


def measure(options: Options) -> dict[str, Any]:
    """Runs every method on every number of cells with every seed; returns {metadata, results}."""
    unknown = [name for name in options.methods if name not in METHODS]
    if unknown:
        raise SystemExit(f"balance: methods must be of {'; '.join(METHODS)}, got {'; '.join(unknown)}")
    kept = None if options.samples is None else load_samples(options.samples)
    drawn = [kept or separate_objects(s, options.count, options.objects, options.tail) for s in range(options.seeds)]
    results = []
    for k in options.cells:
        heaviest = [float(w.double().max()) / fair_share(w.double(), k) for _, w in drawn]
        for name in options.methods:
            runs = []
            for seed, (points, importance) in enumerate(drawn):
                generator = torch.Generator().manual_seed(seed)
                start = time.perf_counter()
                result = balance(points, importance, k, generator=generator, backend=options.backend, **METHODS[name])
                seconds = time.perf_counter() - start
                runs.append((result.imbalance_before, result.imbalance_after, seconds))
            before, after, times = (list(column) for column in zip(*runs))
            row = {
                "cells": k,
                "method": name,
                "before": statistics.median(before),
                "after": statistics.median(after),
                "after_worst": max(after),
                "after_all": after,
                "seconds": statistics.median(times),
                "heaviest": statistics.median(heaviest),
            }
            results.append(row)
            print(line(row), flush=True)
    return {
        "metadata": metadata(
            benchmark="balance",
            samples="separate objects" if options.samples is None else options.samples.name,
            count=drawn[0][0].shape[0],
            objects=None if kept else options.objects,
            tail=None if kept else options.tail,
            seeds=options.seeds,
        ),
        "results": results,
    }


def line(row: dict[str, Any]) -> str:
    """One row of the printed table."""
    return (
        f"{row['cells']:5d}  {row['method']:20} {row['before']:7.4f} {row['after']:8.4f} {row['after_worst']:8.4f}"
        f" {row['seconds']:8.2f} {row['heaviest']:9.2f}"
    )


def main(options: Options) -> None:
    """Measures, prints and stores."""
    print(f"{'cells':>5}  {'method':20} {'before':>7} {'after':>8} {'worst':>8} {'seconds':>8} {'heaviest':>9}")
    outcome = measure(options)
    if options.json is not None:
        write_text(options.json, json.dumps(outcome, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, config=(tyro.conf.OmitArgPrefixes,)))
