"""Pictures of a field's density on a plane through the scene. Densities are per scene unit."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from voronerf.app.evaluate.panels import mapped
from voronerf.app.scenes import Scene

#: The density of the last colour of the map; a wall of this density, 0.01 thick, transmits a third of the light.
DENSEST = 100.0


def slice_points(scene: Scene, *, size: int) -> Tensor:
    """Returns points [size, size, 3] of a horizontal plane through the scene's box, at a third of its height."""
    assert scene.box is not None
    steps = (torch.arange(size) + 0.5) / size
    points = torch.lerp(scene.box[0], scene.box[1], 1 / 3).repeat(size, size, 1)
    points[..., 0] = torch.lerp(scene.box[0, 0], scene.box[1, 0], steps)[None, :]
    points[..., 1] = torch.lerp(scene.box[1, 1], scene.box[0, 1], steps)[:, None]
    return points


@torch.no_grad()
def slice_density(field: nn.Module, points: Tensor, *, cones: bool = False) -> Tensor:
    """Returns the density [h, w] of a field in eval mode at points [h, w, 3], or of cubes around them (``cones``)."""
    device = next(field.parameters()).device
    flat = points.reshape(-1, 3).to(device)
    if cones:
        # A cube's side is the distance between neighbouring points; its variance along each axis is side^2 / 12.
        side = (points[-1, -1] - points[0, 0]).abs().amax() / max(max(points.shape[:2]) - 1, 1)
        flat = torch.cat([flat, (side.square() / 12).to(flat).expand(len(flat), 3)], 1)
    was = field.training
    field.eval()
    try:
        index = torch.zeros(len(flat), dtype=torch.int32, device=device)
        _, density = field(flat, torch.tensor([[0.0, 0.0, -1.0]], device=device), index)
    finally:
        field.train(was)
    return density.float().cpu().reshape(points.shape[:-1])


def picture_of_density(density: Tensor) -> Tensor:
    """Maps densities [h, w] to colours uint8 [h, w, 3] on a log scale: 0 is black, `DENSEST` and above pale yellow.

    The scale log(1 + density) / log(1 + DENSEST) shows both walls and the faint fog around them.
    """
    return mapped(torch.log1p(density.float().clamp(min=0)).cpu() / math.log1p(DENSEST), "magma")
