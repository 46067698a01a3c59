"""The paper's experiment on balance: std(W / max W) of 16 cells before and after balancing, over 100 diagrams."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from paper.runs import Run, Settings, Variant, default_scenes, make_run
from voronerf.diagram.balance import balance

CELLS, DIAGRAMS = 16, 100
#: The published std(W / max W) before and after balancing, medians of 100 diagrams.
PUBLISHED = (0.246, 0.0018)
OBJECTS, COUNT = 9, 10_000
Samples = tuple[Tensor, Tensor]  # points [m, 3] and importance [m]


def runs(settings: Settings) -> list[Run]:
    """Returns the trainings, which keep the samples of their first split."""
    variant = Variant(f"{settings.cells} Voronoi cells", {"cells": (settings.cells,)})
    scenes = settings.scene or default_scenes()
    return [make_run(variant, scene, seed, settings) for scene in scenes for seed in range(settings.seeds)]


def separate_objects(seed: int) -> Samples:
    """Draws samples near the surfaces of balls of different sizes and weights, scattered in a box of side 6."""
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(OBJECTS, 3, generator=generator) * 6 - 3
    radii = torch.rand(OBJECTS, generator=generator) * 0.5 + 0.15
    member = torch.multinomial(torch.rand(OBJECTS, generator=generator) + 0.2, COUNT, True, generator=generator)
    normals = torch.nn.functional.normalize(torch.randn(COUNT, 3, generator=generator), dim=1)
    distance = radii[member, None] * (1 + 0.02 * torch.randn(COUNT, 1, generator=generator))
    importance = torch.randn(COUNT, generator=generator).exp() * (1 + 3 * normals[:, 0].clamp(min=0))
    return places[member] + normals * distance, importance


def load_samples(path: Path) -> Samples:
    """Loads the samples that a training kept for its split."""
    with np.load(path) as file:
        return torch.from_numpy(file["points"]), torch.from_numpy(file["importance"])


def measure(
    trained: Sequence[Run], backend: str, say: Callable[[str], None] = print, *, diagrams: int = DIAGRAMS
) -> list[dict[str, Any]]:
    """Balances diagrams for the samples of each training and of separate objects; returns the rows."""
    kept: dict[str, list[Samples]] = {}
    for run in trained:
        samples = load_samples(run.folder / "samples" / "level-1.npz")
        kept.setdefault(f"kept by a training, {Path(run.scene).name}", []).append(samples)
    sources: dict[str, Callable[[int], Samples]] = {
        name: lambda number, sets=sets: sets[number % len(sets)] for name, sets in kept.items()
    }
    sources["separate objects"] = separate_objects
    rows = []
    for name, drawn in sources.items():
        results = [
            balance(*drawn(n), CELLS, generator=torch.Generator().manual_seed(n), backend=backend)
            for n in range(diagrams)
        ]
        before, after = [r.imbalance_before for r in results], [r.imbalance_after for r in results]
        first, last = statistics.median(before), statistics.median(after)
        rows.append({"variant": name, "before": first, "after": last, "before_all": before, "after_all": after})
        text = f"std(W / max W) of {CELLS} cells, median of {diagrams} diagrams, {name}"
        say(f"{text}: {first:.3f} -> {last:.4f}, published {PUBLISHED[0]} -> {PUBLISHED[1]}")
    return rows
