"""Snapshots of a training ("looks"): a held-out view, a slice of the density, the cells.

A look is a file looks/NAME.npz of a run directory. NAME is "before" or "after" (the first split), or "end".
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from turns import Training

from paper.slices import slice_density, slice_points
from voronerf.app.evaluate.metrics import psnr
from voronerf.app.files import write_bytes
from voronerf.app.render.camera import render_camera
from voronerf.app.scenes import Scene
from voronerf.app.train import State

VERSION = 1  # format version of looks; looks of other versions are ignored
#: Fraction of the run between the looks "before" and "after". The look "after" shows inherited or random networks
#: soon after the first split.
AFTER = 0.04
SLICE = 96  # points along each side of a slice


def stops(training: Training) -> list[tuple[str, float]]:
    """Returns (name, training seconds) of each look of a run except the look "end"."""
    config = training.state.config
    if not config.plan or config.plan[0].at + AFTER >= 1:
        return []
    at, budget = config.plan[0].at, config.budget or 0.0
    return [("before", at * budget), ("after", (at + AFTER) * budget)]


def held_out_view(scene: Scene) -> int:
    """Returns the index of the test view that the looks show."""
    return len(scene.test) // 3


def reached(training: Training, second: float) -> None:
    """Writes the looks of a training that are due at ``second`` training seconds."""
    names = [name for name, at in stops(training) if at == second]
    if "after" in names and training.state.strategy.splits == 0:
        # If a single step passes both "before" and "after", the split is still due. One more step performs it.
        training.advance(math.nextafter(training.seconds, math.inf))
    for name in names:
        look(training, second, name)


@torch.no_grad()
def look(training: Training, second: float, name: str = "end") -> None:
    """Writes a look of a training's current state; ``second`` is its due time."""
    data = io.BytesIO()
    np.savez_compressed(data, **picture(training.state), at=second, seconds=training.seconds, step=training.state.step)
    write_bytes(training.out / "looks" / f"{name}.npz", data.getvalue())


def picture(state: State) -> dict[str, Any]:
    """Returns the arrays of a look."""
    scene, router = state.scene, state.router
    view = held_out_view(scene)
    with state.averaged():
        image = render_camera(state.renderer, scene, scene.test.cameras, view)
    cells = router.diagram.locate(image.heaviest.reshape(-1, 3), backend=state.config.backend)
    found = {
        "colour": (image.colour.clamp(0, 1) * 255).round().to(torch.uint8),
        "opacity": (image.opacity.clamp(0, 1) * 255).round().to(torch.uint8),
        "cells": cells.reshape(image.opacity.shape).int(),
        "truth": (scene.test.truth(view, scene.background_colour()) * 255).round().to(torch.uint8),
    }
    points = slice_points(scene, size=SLICE)
    found["density"] = slice_density(router, points, cones=state.config.field_type.cones).half()
    score = psnr(found["colour"].float() / 255, found["truth"].float() / 255)
    arrays = {name: value.cpu().numpy() for name, value in found.items()}
    return {**arrays, "num_cells": router.num_cells, "psnr": float(score)}


def load(folder: Path, name: str) -> dict[str, Any] | None:
    """Loads the arrays of a run's look; None if there is no look."""
    path = folder / "looks" / f"{name}.npz"
    if not path.is_file():
        return None
    with np.load(path) as file:
        return {key: file[key] for key in file.files}


def numbers(folder: Path) -> list[dict[str, Any]]:
    """Returns the scalars of each look of a run (its times, PSNR and number of cells), sorted by time."""
    found = []
    for path in (folder / "looks").glob("*.npz"):
        with np.load(path) as file:
            values = {key: file[key].item() for key in file.files if file[key].ndim == 0}
        found.append({"look": path.stem, **values})
    return sorted(found, key=lambda entry: entry["at"])
