"""The density of a field on a plane through the scene, as a picture.

size x size points; densities are per scene unit.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from voronerf.data import Scene
from voronerf.evaluation.panels import mapped
from voronerf.rendering.contraction import Contraction, Perspective

#: Half the side of a slice through a scene without a box, in scene units.
EXTENT = 1.5
#: Density of the last colour of the map; a wall of this density and a thickness of 0.01 passes a third of the light.
DENSEST = 100.0


def slice_points(scene: Scene, *, axis: int = 2, at: float = 1 / 3, size: int = 96) -> Tensor:
    """Points [size, size, 3] of a plane across the scene's box, at the middles of the picture's pixels.

    The picture's right is the lower of the other two axes, its top the higher.

    Args:
        scene: the plane fills its box, or a cube of 3 units for a scene without a box.
        axis: the axis that the plane is perpendicular to, 0 to 2.
        at: position of the plane on this axis, as a fraction of the box.
        size: points along a side.

    Raises:
        ValueError: an axis or size out of range.
    """
    if axis not in (0, 1, 2):
        raise ValueError(f"slice_points: axis must be 0, 1 or 2, got {axis}")
    if size < 1:
        raise ValueError(f"slice_points: size must be at least 1, got {size}")
    box = torch.tensor(((-EXTENT,) * 3, (EXTENT,) * 3)) if scene.box is None else scene.box
    right, up = (other for other in range(3) if other != axis)
    steps = (torch.arange(size) + 0.5) / size
    points = torch.lerp(box[0], box[1], at).repeat(size, size, 1)
    points[..., right] = torch.lerp(box[0, right], box[1, right], steps)[None, :]
    points[..., up] = torch.lerp(box[1, up], box[0, up], steps)[:, None]
    return points


@torch.no_grad()
def slice_density(
    field: nn.Module, points: Tensor, *, cones: bool = False, contraction: Contraction | Perspective | None = None
) -> Tensor:
    """Density [h, w] of a field in evaluation mode, so that a router with a `blend` blends.

    Args:
        field: takes positions, directions and ray indices, as `Renderer.field` does; its mode is restored.
        points: [h, w, 3].
        cones: evaluate the field on Gaussians [n, 6], means and variances of cubes that fill the slice, as mip-NeRF
            needs them.
        contraction: of the space that the field lives in, see `Renderer.contraction`.
    """
    device = next(field.parameters()).device
    flat = points.reshape(-1, 3).to(device)
    if cones:
        # The side of a cube is the distance between neighbours; its variance along each axis is side^2 / 12.
        side = (points[-1, -1] - points[0, 0]).abs().amax() / max(max(points.shape[:2]) - 1, 1)
        variance = (side.square() / 12).to(flat).expand(len(flat), 1)
        spread = variance.expand(-1, 3)
        if contraction is not None:
            any_axis = torch.tensor([[0.0, 0.0, 1.0]], device=device)
            flat, spread = contraction.gaussians(flat, any_axis, variance, variance)
        flat = torch.cat([flat, spread], 1)
    elif contraction is not None:
        flat = contraction.points(flat)
    down = torch.tensor([[0.0, 0.0, -1.0]], device=device)
    index = torch.zeros(len(flat), dtype=torch.int32, device=device)
    was = field.training
    field.eval()
    try:
        _, density = field(flat, down, index)
    finally:
        field.train(was)
    return density.float().cpu().reshape(points.shape[:-1])


def picture_of_density(density: Tensor) -> Tensor:
    """Densities [h, w] as uint8 [h, w, 3]: 0 is black, `DENSEST` and above pale yellow, on a logarithmic scale.

    The scale log(1 + density) / log(1 + DENSEST) shows both walls and the faint fog before and behind them.
    """
    return mapped(torch.log1p(density.float().clamp(min=0)).cpu() / math.log1p(DENSEST), "magma")
