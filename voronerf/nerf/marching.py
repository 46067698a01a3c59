"""Pictures through an occupancy grid: rays are walked in waves, and end at the first surface.

r rays, s strata of a ray. Units as in `voronerf.nerf.volume`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.field import Field
from voronerf.nerf.radiance import radiance_of, router_of
from voronerf.ops.composite import composite
from voronerf.ops.formulas import Wave, walk
from voronerf.ops.render_opaque import OF_PROGRAM

if TYPE_CHECKING:
    from voronerf.nerf.samplers import Occupancy

OPAQUE = 0.05  # a ray ends when it lets less than this through: what is behind counts as of the colour before it
#: Samples of a ray in a wave: fewer need more waves, more evaluate samples behind the surface in vain. Pictures of
#: contracted space, photographs, have so many rays that a wave's own costs count less.
WAVE, CONTRACTED_WAVE = 12, 8
#: The same where one operation takes all waves, which cost next to nothing then.
FINE_WAVE = 4


class RayColours(NamedTuple):
    """Colours and depths of the rays of a picture.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r].
        depth: [r], as in `Rendered`.
        heaviest: [r, 3], the position of the heaviest sample of each ray, or its far end if it has no samples.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays, Renderer, Stratified
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
) -> RayColours:
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
        heaviest: whether to find the heaviest sample of each ray; without it that part of the result means nothing.

    Examples:
        >>> import torch
        >>> from voronerf import OccupancyGrid
        >>> from voronerf.nerf import Occupancy, Rays, render_until_opaque
        >>> def wall(positions, directions, ray_index):  # from z = 0 on
        ...     return torch.ones_like(positions), torch.where(positions[:, 2] > 0, 1e9, 0.0)
        >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 4, threshold=0.1)
        >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_until_opaque(wall, rays, torch.zeros(1), torch.full((1,), 4.0), Occupancy(grid, 8))
        >>> result.colour, result.depth
        (tensor([[1., 1., 1.]]), tensor([2.1250]))
    """
    contraction = sampler.space.contraction
    network = _network(field, rays, sampler)
    if network is not None:
        rule = {"spacing": sampler.space.spacing, "backend": sampler.backend, "heaviest": heaviest}
        rule |= {"wave": FINE_WAVE, "opaque": OPAQUE, "background": None if background is None else background.to(near)}
        seen = sampler.grid.see(rays, near, far, sampler.picture_samples, **network, **rule)
    else:
        wave = WAVE if contraction is None else CONTRACTED_WAVE

        def look(live: Tensor, start: Tensor | None) -> Wave:
            now = rays if start is None else rays[live]
            samples, stop = sampler.march(now, near[live], far[live], start=start, most=wave, picture=True)
            rgb, sigma = (each.to(near.dtype) for each in field(samples.inputs, now.directions, samples.ray_index))
            along = samples.depths, samples.deltas
            part = composite(sigma, rgb, *along, ray_offsets=samples.ray_offsets, backend=sampler.backend)
            return Wave(part, samples.ray_index, samples.ray_offsets, samples.depths, stop)

        seen = walk(look, far, sampler.picture_samples, wave, OPAQUE, background, heaviest)
    places = rays.origins
    if heaviest:
        places = rays.origins + seen.heaviest[:, None] * rays.directions
        places = places if contraction is None else contraction.points(places)
    return RayColours(seen.colour, seen.opacity, seen.depth, places)


def _network(field: Field, rays: Rays, sampler: Occupancy) -> dict[str, Any] | None:
    """The arguments with which ``render_opaque`` asks a field; None if it is more than networks, for Warp and CUDA."""
    router = router_of(field)
    if router is None or not rays.origins.is_cpu or "warp" in (sampler.backend, router.backend):
        return None
    known = radiance_of(field, (rays.origins, rays.directions))
    if isinstance(known, str):
        return None
    arguments = known.arguments(rays.origins, rays.directions, torch.empty(0, dtype=torch.int32))
    if "cells" in arguments:  # which each sample has of its own
        return None
    return {"network": {name: value for name, value in arguments.items() if name in OF_PROGRAM}, **known.rule}
