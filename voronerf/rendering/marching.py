"""Pictures through an occupancy grid: rays are walked in waves, and end at the first surface.

r rays, s strata of a ray. Units as in `voronerf.rendering.volume`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops.composite import composite
from voronerf.rendering.cameras import Rays
from voronerf.rendering.field import Field
from voronerf.rendering.samplers import Occupancy
from voronerf.rendering.volume import Samples, normalised

OPAQUE = 0.02  # a ray ends when it lets less than this through: what is behind counts as of the colour before it
#: Samples of a ray in a wave: fewer need more waves, more evaluate samples behind the surface in vain. Pictures of
#: contracted space, photographs, have so many rays that a wave's own costs count less.
WAVE, CONTRACTED_WAVE = 12, 8


class Seen(NamedTuple):
    """What the rays of a picture see.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r].
        depth: [r], as in `Rendered`.
        heaviest: [r, 3], the position of the heaviest sample of each ray, or its far end if it has no samples.

    Examples:
        >>> import torch
        >>> from voronerf.rendering import Rays, Renderer, Stratified
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]))
        >>> seen = Renderer({"field": fog}, Stratified(8)).see(rays, torch.zeros(1), torch.ones(1))
        >>> seen.opacity.round(decimals=4)  # 1 - exp(-0.5)
        tensor([0.3935])
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    heaviest: Tensor


@torch.no_grad()
def render_until_opaque(
    field: Field,
    rays: Rays,
    near: Tensor,
    far: Tensor,
    sampler: Occupancy,
    *,
    background: Tensor | None = None,
    heaviest: bool = True,
) -> Seen:
    """`render_rays` for pictures, without gradients: rays are walked in waves, and end when they are opaque.

    A wave is a few samples of every ray that is not opaque yet. So the field evaluates little more than the samples in
    front of the first surface of each ray. A ray that has ended counts as opaque, with the colour that it has by then.

    Args:
        field: called once for each wave.
        rays: r rays.
        near: [r].
        far: [r].
        sampler: which space is empty; the samples are the middles of its strata for pictures.
        background: [3] or [r, 3]; None is black.
        heaviest: whether to find the heaviest sample of each ray, which takes a tenth of the time of a picture.
            Without it, `heaviest` is the far end of the ray.

    Examples:
        >>> import torch
        >>> from voronerf import OccupancyGrid
        >>> from voronerf.rendering import Occupancy, Rays, render_until_opaque
        >>> def wall(positions, directions, ray_index):  # from z = 0 on
        ...     return torch.ones_like(positions), torch.where(positions[:, 2] > 0, 1e9, 0.0)
        >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 4, threshold=0.1)
        >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_until_opaque(wall, rays, torch.zeros(1), torch.full((1,), 4.0), Occupancy(grid, 8))
        >>> result.colour, result.depth
        (tensor([[1., 1., 1.]]), tensor([2.2500]))
    """
    r, contraction = len(rays), sampler.space.contraction
    wave = WAVE if contraction is None else CONTRACTED_WAVE
    colour, opacity, depth = torch.zeros_like(rays.origins), torch.zeros_like(near), torch.zeros_like(near)
    through, top = torch.ones_like(near), torch.zeros_like(near)
    at = far.clone()
    live, start = torch.arange(r, device=near.device), None
    while live.numel() > 0:
        now = rays if live.numel() == r else rays[live]
        samples, stop = sampler.march(now, near[live], far[live], start=start, most=wave, picture=True)
        found = field(samples.inputs, now.directions, samples.ray_index)
        rgb, sigma = (values.to(near.dtype) for values in found)
        along = samples.depths, samples.deltas
        part = composite(sigma, rgb, *along, ray_offsets=samples.ray_offsets, backend=sampler.backend)
        light = through[live]
        colour[live] += light[:, None] * part.colour
        opacity[live] += light * part.opacity
        depth[live] += light * part.depth
        if heaviest:
            weight, place = _heaviest(samples, part.weights, len(live), wave)
            weight = weight * light
            better = weight > top[live]
            top[live[better]], at[live[better]] = weight[better], place[better]
        light = light * (1 - part.opacity)
        through[live] = light
        more = ((stop < sampler.picture_samples) & (light > OPAQUE)).nonzero()[:, 0]
        live, start = live[more], stop[more]
    depth = normalised(depth, opacity, far)
    ended = through <= OPAQUE
    colour /= torch.where(ended, opacity, 1)[:, None]
    opacity = torch.where(ended, 1, opacity)
    if background is not None:
        colour += (1 - opacity)[:, None] * background.to(colour)
    places = rays.origins + at[:, None] * rays.directions
    places = places if contraction is None else contraction.points(places)
    return Seen(colour, opacity, depth, places)


def _heaviest(samples: Samples, weights: Tensor, rays: int, most: int) -> tuple[Tensor, Tensor]:
    """Weight and depth [r] of the heaviest sample of each ray, of which there are at most `most`; -1 without any."""
    row = torch.arange(len(weights), device=weights.device) - samples.ray_offsets[samples.ray_index]
    table = weights.new_full((2, rays * most), -1.0)
    table[:, samples.ray_index.long() * most + row] = torch.stack((weights, samples.depths))
    weight, column = table[0].reshape(-1, most).max(dim=1)
    return weight, table[1].reshape(-1, most).gather(1, column[:, None])[:, 0]
