"""What errors a training leaves in each cell: by them an update sees what has changed.

r rays, k cells.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from voronerf.app.train.batches import RayBatches
from voronerf.nerf import Batch
from voronerf.nerf.renderer import Renderer

#: Rays that errors are taken from, and how many of them are rendered at a time.
RAYS, CHUNK = 1 << 13, 1 << 12
#: The share of a cell's training rays with a smaller error than the one that is kept.
QUANTILE = 0.9
#: Rays that a cell needs for an error of its own; one with fewer has that of all rays.
FEWEST = 32


class Cells(Protocol):
    """What says which cell holds a position: a router, or the parts of a run."""

    @property
    def num_cells(self) -> int:
        """k."""
        ...

    def assign(self, positions: Tensor) -> Tensor:
        """[n, 3] -> int32 [n]; -1 for none."""
        ...


class SeenErrors(NamedTuple):
    """How far rays are off."""

    error: Tensor  # [r], the squared error of the colour, summed over the channels
    lighter: Tensor  # [r, 3], the colour that is rendered less that of the pixel
    cell: Tensor  # int64 [r], the cell of the heaviest sample; k for rays that see the background
    depth: Tensor  # [r], the distance of the heaviest sample; that of the far end for rays that see the background


@torch.no_grad()
def see_errors(renderer: Renderer, cells: Cells, batch: Batch) -> SeenErrors:
    """Renders rays and compares them with their pixels.

    Args:
        renderer: In evaluation mode.
        cells: The cells of its field.
        batch: The rays.
    """
    found = []
    for rows in torch.arange(len(batch.rays), device=batch.near.device).split(CHUNK):
        background = batch.background
        if background is not None and background.dim() == 2:
            background = background[rows]
        rays, near, far = batch.rays[rows], batch.near[rows], batch.far[rows]
        last = renderer.render(rays, near, far, background=background)[-1]
        lighter = last.colour - batch.target[rows]
        offsets, weights = last.samples.ray_offsets.long(), last.weights
        # The heaviest sample of each ray: the first that has the ray's largest weight.
        index = last.samples.ray_index.long()
        largest = weights.new_zeros(len(rows)).scatter_reduce(0, index, weights, "amax")
        hit = (weights == largest[index]).nonzero()[:, 0]
        heaviest = torch.zeros_like(offsets[:-1]).scatter_reduce(0, index[hit], hit, "amin", include_self=False)
        solid = last.opacity > 0.5
        cell = torch.full_like(heaviest, cells.num_cells)
        depth = far.clone()
        chosen = heaviest[solid]
        owner = cells.assign(last.samples.positions[chosen]).long()
        cell[solid] = torch.where(owner < 0, cells.num_cells, owner)
        depth[solid] = last.samples.depths[chosen]
        found.append(SeenErrors(lighter.square().sum(-1), lighter, cell, depth))
    return SeenErrors(*(torch.cat(column) for column in zip(*found, strict=True)))


def usual_errors(renderer: Renderer, cells: Cells, batches: RayBatches, rays: int = RAYS) -> Tensor:
    """The error that nine of ten training rays stay below, by the cell of their heaviest sample.

    Args:
        renderer: With the networks that pictures use.
        cells: The cells of its field.
        batches: Of the training views.
        rays: How many are rendered.

    Returns:
        float32 [k + 1], the last for rays that see the background.
    """
    renderer.train(False)
    generator = torch.Generator(batches.device).manual_seed(0)
    count = min(rays, len(batches))
    seen = see_errors(renderer, cells, batches.draw(count, generator, random_background=False))
    usual = seen.error.quantile(QUANTILE).repeat(cells.num_cells + 1)
    order, counts = seen.cell.argsort(), seen.cell.bincount(minlength=cells.num_cells + 1)
    for cell, errors in enumerate(seen.error[order].split(counts.tolist())):
        if len(errors) >= FEWEST:
            usual[cell] = errors.quantile(QUANTILE)
    return usual
