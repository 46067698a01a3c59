"""The paper's experiment on balance: std(W / max W) of 16 cells before and after, over 100 diagrams."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from balance import load_samples, separate_objects
from harness import metadata
from torch import Tensor

from paper.claims import NOT_MEASURED, Claim
from paper.published import BALANCE
from paper.runs import Run, Variant, default_scenes, make_run
from paper.settings import Settings
from voronerf.diagram.balance import balance
from voronerf.files import write_text

CELLS, DIAGRAMS = 16, 100
KEPT, MADE = "kept by a training", "separate objects"
OBJECTS, COUNT, TAIL = 9, 10_000, 1.0


def runs(settings: Settings) -> list[Run]:
    """Trainings that keep samples for their first split."""
    variant = Variant(f"{settings.cells} Voronoi cells", {"cells": (settings.cells,)})
    scenes = settings.scene or default_scenes()
    return [make_run(variant, scene, seed, settings) for scene in scenes for seed in range(settings.seeds)]


def samples_path(run: Run) -> Path:
    """The samples that a training kept for its first split; results from a record have none."""
    return run.folder / "samples" / "level-1.npz"


def without_samples(settings: Settings) -> list[str]:
    """The trainings without kept samples."""
    absent = [run for run in runs(settings) if not samples_path(run).is_file()]
    return [f"samples of {Path(run.scene).name}, seed {run.seed}" for run in absent]


def sample_sets(settings: Settings) -> dict[str, Callable[[int], tuple[Tensor, Tensor]]]:
    """For each source the samples of its diagram number i: points [m, 3] and importance [m]."""
    paths: dict[str, list[Path]] = {}
    for run in runs(settings):
        path = samples_path(run)
        if path.is_file():
            paths.setdefault(f"{KEPT}, {Path(run.scene).name}", []).append(path)
    found: dict[str, Callable[[int], tuple[Tensor, Tensor]]] = {}
    for name, files in paths.items():
        loaded = [load_samples(path) for path in files]
        found[name] = lambda i, loaded=loaded: loaded[i % len(loaded)]
    found[MADE] = lambda i: separate_objects(i, COUNT, OBJECTS, TAIL)
    return found


def measure(settings: Settings, say: Callable[[str], None] = print, *, diagrams: int = DIAGRAMS) -> dict[str, Any]:
    """Balances the diagrams of every source; returns {metadata, results, claims}."""
    results = []
    for name, samples in sample_sets(settings).items():
        pairs = list(_balanced(samples, diagrams, settings.backend))
        before, after = ([pair[i] for pair in pairs] for i in (0, 1))
        row = {
            "variant": name,
            "before": statistics.median(before),
            "after": statistics.median(after),
            "before_all": before,
            "after_all": after,
        }
        results.append(row)
        say(f"{name:34} std(W / max W) {row['before']:.4f} -> {row['after']:.4f}, median of {len(pairs)}")
    outcome = {
        "metadata": metadata(
            benchmark="paper",
            experiment="balance",
            kind="figure",
            scenes=[Path(name).name for name in settings.scene or default_scenes()],
            diagrams=diagrams,
            cells=CELLS,
            seeds=len({run.seed for run in runs(settings) if samples_path(run).is_file()}) or settings.seeds,
            budget_seconds=settings.budget,
            missing=without_samples(settings),
        ),
        "results": results,
        "claims": [claim.to_dict() for claim in claims(results)],
    }
    write_text(settings.out / "balance.json", json.dumps(outcome, indent=1) + "\n")
    return outcome


def _balanced(
    samples: Callable[[int], tuple[Tensor, Tensor]], diagrams: int, backend: str
) -> Iterator[tuple[float, float]]:
    for number in range(diagrams):
        points, importance = samples(number)
        generator = torch.Generator().manual_seed(number)
        result = balance(points, importance, CELLS, generator=generator, backend=backend)
        yield result.imbalance_before, result.imbalance_after


def claims(results: Sequence[dict[str, Any]]) -> list[Claim]:
    """Whether cells are as even as published, for every source of samples."""
    found = []
    for row in results:
        here = f"{row['before']:.3f} -> {row['after']:.4f}"
        text = f"std(W / max W) of {CELLS} cells, median of {len(row['after_all'])} diagrams, {row['variant']}"
        found.append(Claim(text, f"{BALANCE[0]} -> {BALANCE[1]}", here, balance_verdict(row["before"], row["after"])))
    return found


def balance_verdict(before: float | None, after: float | None) -> str:
    """Whether balancing reaches the published figure, at least its factor, or neither."""
    if before is None or after is None:
        return NOT_MEASURED
    if after >= before:
        return "does not hold"
    if after <= BALANCE[1]:
        return "holds"
    factor, published = before / after, BALANCE[0] / BALANCE[1]
    if factor >= published:
        return f"the factor holds: {factor:.0f}, published {published:.0f}"
    return f"evener by a factor of {factor:.0f}, published {published:.0f}"
