"""The occupancy grid of a run: made, taught by the samples of training, or made for pictures of a trained field."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import nn

from voronerf.data import Scene
from voronerf.fields.radiance import INITIAL_DENSITY
from voronerf.rendering.comparison import Comparison
from voronerf.rendering.field import Field
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.config_checks import why_no_occupancy
from voronerf.training.renderers import make_contraction

#: A cell is empty if a sample in it would take less of the light than this, were the cell that dense throughout: for
#: pictures of a field that was trained without a grid, and in training with one. Most of what a young field has spread
#: through empty space lies between the two, and would keep a third of the samples.
LEAST_OPACITY, TRAINING_OPACITY = 0.02, 0.05
#: Density of an empty cell of contracted space, a quarter of that of an untrained field.
FOG = INITIAL_DENSITY / 4
#: The factor on what a cell remembers for each sample of a batch in it, and how many such samples in a row empty a new
#: cell: about thirty steps, until which the field has said nothing about most cells.
OCCUPANCY_DECAY, OCCUPANCY_PATIENCE = 0.8, 8
#: The share of all cells that are evaluated at random from time to time.
OCCUPANCY_SHARE = 1 / 8
#: Of a grid made for pictures alone: cells along each axis, and points evaluated in each.
PICTURE_RESOLUTION, PICTURE_POINTS = 128, 2


def make_grid(
    config: TrainConfig,
    scene: Scene,
    device: torch.device | str,
    resolution: int | None = None,
    least_opacity: float = TRAINING_OPACITY,
) -> OccupancyGrid:
    """A grid over the scene's box, or over the cube of its contraction, that is occupied everywhere.

    A cell is empty below the density with which an average stratum, the box's diagonal divided by the samples of a ray,
    takes `least_opacity` of the light; with a contraction below `FOG`, since the thin fog that a young field fills
    space with is at first all that it has of the scene.

    Raises:
        ConfigError: When the scene has no box and is not contracted.
    """
    contraction = None if config.contraction == "none" else make_contraction(scene, config.contraction, device)
    if contraction is not None:
        box, threshold = contraction.cube, FOG
    elif scene.box is not None:
        box = scene.box
        threshold = -math.log1p(-least_opacity) * int(config.samples or 0) / float((box[1] - box[0]).norm())
    else:
        raise ConfigError(f"--occupancy needs a scene with a box or --contraction, {scene.name} has no box")
    size = resolution or int(config.occupancy_resolution or 0)
    remembered = OCCUPANCY_DECAY**-OCCUPANCY_PATIENCE
    return OccupancyGrid(box, size, threshold=threshold, remembered=remembered, contraction=contraction, device=device)


def make_picture_grid(config: TrainConfig, scene: Scene, field: Field, *, backend: str = "auto") -> OccupancyGrid:
    """The occupancy grid of a field that was trained without one, made by asking the field in every cell.

    Raises:
        ConfigError: As `make_grid`, or when the run's sampling has no use for a grid.
    """
    obstacle = why_no_occupancy(replace(config, cuda_graph=False))
    if obstacle is not None:
        raise ConfigError(f"--occupancy does not work with {obstacle}")
    device = next(field.parameters()).device if isinstance(field, nn.Module) else "cpu"
    grid = make_grid(config, scene, device, PICTURE_RESOLUTION, LEAST_OPACITY)
    generator = torch.Generator().manual_seed(0)
    for points in range(PICTURE_POINTS):
        grid.update(field, decay=float(points > 0), generator=generator, backend=backend)
    return grid


def observe_samples(grid: OccupancyGrid, found: Comparison, *, backend: str) -> None:
    """Teaches a grid what the samples of a training step found."""
    assert found.density is not None and found.deltas is not None
    backend = "auto" if backend == "warp" else backend  # there is no Warp kernel of it
    grid.observe(found.positions, found.density, found.deltas, found.weights, decay=OCCUPANCY_DECAY, backend=backend)


def revisit_cells(grid: OccupancyGrid, field: Field, generator: torch.Generator, *, backend: str) -> None:
    """Evaluates the field in random cells, so that a cell that was wrongly found empty is found occupied again."""
    every = grid.occupied.numel()
    count = max(1, int(every * OCCUPANCY_SHARE))
    cells = torch.randint(every, (count,), generator=generator, device=generator.device)
    grid.update(field, cells.to(grid.occupied.device), decay=1.0, generator=generator, backend=backend)
