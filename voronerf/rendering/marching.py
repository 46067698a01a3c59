"""Volume rendering through an occupancy grid: only samples in occupied cells reach the field.

r rays, s strata of a ray, m samples of all rays (packed). Units as in `voronerf.rendering.volume`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops.composite import composite
from voronerf.ops.march_rays import March
from voronerf.rendering.cameras import Rays
from voronerf.rendering.field import Field
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.volume import weaken_near

OPAQUE = 4e-3  # a ray ends when it lets less than this through, one level of an 8-bit image
WAVE = 6  # samples of a ray in a wave: fewer need more waves, more evaluate samples behind the surface in vain


class Marched(NamedTuple):
    """The result of `render_marched`.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r], 0..1: the sum of the weights.
        depth: [r], expected distance, normalised by the opacity; `far` for a ray with opacity 0.
        weights: [m], the contribution of each sample.
        positions: [m, 3].
        rgb: [m, 3], the colour of each sample.
        ray_index: int32 [m], the ray of each sample.
        density: [m].
        deltas: [m], the length of the stratum of each sample.

    Examples:
        >>> import torch
        >>> from voronerf import OccupancyGrid
        >>> from voronerf.rendering import Rays, render_marched
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 4, threshold=0.1)
        >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_marched(fog, rays, torch.zeros(1), torch.full((1,), 4.0), grid, samples=8)
        >>> result.positions[:, 2], result.ray_index  # the samples inside of the box
        (tensor([-0.7500, -0.2500,  0.2500,  0.7500]), tensor([0, 0, 0, 0], dtype=torch.int32))
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    weights: Tensor
    positions: Tensor
    rgb: Tensor
    ray_index: Tensor
    density: Tensor
    deltas: Tensor


class Seen(NamedTuple):
    """The result of `render_until_opaque`: as `Marched`, with `heaviest` [r, 3], the position of the heaviest sample of
    each ray, or its far end if it has no samples."""

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    heaviest: Tensor


def render_marched(
    field: Field,
    rays: Rays,
    near: Tensor,
    far: Tensor,
    grid: OccupancyGrid,
    *,
    samples: int,
    background: Tensor | None = None,
    jitter: bool = False,
    generator: torch.Generator | None = None,
    spacing: str = "linear",
    full_gradient: float | None = None,
    backend: str = "auto",
) -> Marched:
    """`render_rays` without the samples in empty cells of a grid; differentiable, for training.

    Args:
        field: called once, on the remaining samples, possibly none.
        rays: r rays.
        near: [r], start of the integral.
        far: [r], end.
        grid: which space is empty; all space outside its box is. With a contraction the field's positions are of the
            contracted space.
        samples: s, strata of a ray.
        background: [3] or [r, 3]; None is black.
        jitter: random samples in the strata, else their middles.
        generator: of the jitter.
        spacing: of the strata, "linear" or "disparity".
        full_gradient: distance from which the gradients of samples are whole, nearer ones have smaller; None for any.
        backend: of the ops.

    Examples:
        >>> import torch
        >>> from voronerf import OccupancyGrid
        >>> from voronerf.rendering import Rays, render_marched
        >>> def ball(positions, directions, ray_index):  # of radius 0.5
        ...     return torch.ones_like(positions), torch.where(positions.norm(dim=-1) < 0.5, 10.0, 0.0)
        >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 8, threshold=1.0)
        >>> grid.update(ball)
        >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_marched(ball, rays, torch.zeros(1), torch.full((1,), 4.0), grid, samples=64)
        >>> len(result.positions) < 20, result.opacity.round(decimals=2)
        (True, tensor([1.]))
    """
    march = march_grid(rays, near, far, grid, samples, jitter, generator, spacing, backend)
    index = march.ray_index
    rgb, sigma = field(march.positions, rays.directions, index)
    # a field under autocast answers in a half type: the sums along a ray are float32's
    rgb, sigma = rgb.to(near.dtype), sigma.to(near.dtype)
    weaken_near(full_gradient, march.depths, rgb, sigma)
    result = composite(
        sigma,
        rgb,
        march.depths,
        march.deltas,
        ray_offsets=march.ray_offsets,
        background=background,
        backend=backend,
    )
    return Marched(
        result.colour,
        result.opacity,
        _normalised(result.depth, result.opacity, far),
        result.weights,
        march.positions,
        rgb,
        index,
        sigma,
        march.deltas,
    )


def draw_seed(device: torch.device, generator: torch.Generator | None) -> Tensor:
    """A seed of jitter for ``march_rays``, int32 [1]; the device is that of the rays."""
    drawn_on = device if generator is None else generator.device
    return torch.randint(-(2**31), 2**31, (1,), device=drawn_on, dtype=torch.int32, generator=generator).to(device)


def march_grid(
    rays: Rays,
    near: Tensor,
    far: Tensor,
    grid: OccupancyGrid,
    samples: int,
    jitter: bool,
    generator: torch.Generator | None,
    spacing: str,
    backend: str,
) -> March:
    """The samples of `render_marched`, whose arguments these are."""
    seed = draw_seed(near.device, generator) if jitter else None
    return grid.march(rays, near, far, samples, seed=seed, spacing=spacing, backend=backend)


@torch.no_grad()
def render_until_opaque(
    field: Field,
    rays: Rays,
    near: Tensor,
    far: Tensor,
    grid: OccupancyGrid,
    *,
    samples: int,
    background: Tensor | None = None,
    spacing: str = "linear",
    heaviest: bool = True,
    backend: str = "auto",
) -> Seen:
    """`render_marched` for images, without gradients: rays are walked in waves, and end when they are opaque.

    A wave is a few samples of every ray that is not opaque yet. So the field evaluates little more than the samples in
    front of the first surface of each ray.

    Args:
        field: called once for each wave.
        rays: r rays.
        near: [r].
        far: [r].
        grid: which space is empty.
        samples: s, strata of a ray; the samples are their middles.
        background: [3] or [r, 3]; None is black.
        spacing: of the strata.
        heaviest: whether to find the heaviest sample of each ray, which takes a tenth of the time of a picture.
            Without it, `heaviest` is the far end of the ray.
        backend: of the ops.

    Examples:
        >>> import torch
        >>> from voronerf import OccupancyGrid
        >>> from voronerf.rendering import Rays, render_until_opaque
        >>> def wall(positions, directions, ray_index):  # from z = 0 on
        ...     return torch.ones_like(positions), torch.where(positions[:, 2] > 0, 1e9, 0.0)
        >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 4, threshold=0.1)
        >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_until_opaque(wall, rays, torch.zeros(1), torch.full((1,), 4.0), grid, samples=8)
        >>> result.colour, result.depth
        (tensor([[1., 1., 1.]]), tensor([2.2500]))
    """
    r = len(rays)
    colour, opacity, depth = torch.zeros_like(rays.origins), torch.zeros_like(near), torch.zeros_like(near)
    through, top = torch.ones_like(near), torch.zeros_like(near)
    at = far.clone()
    live, start = torch.arange(r, device=near.device), None
    while live.numel() > 0:
        whole = live.numel() == r
        now = rays if whole else rays[live]
        march = grid.march(
            now, near[live], far[live], samples, spacing=spacing, start=start, most=WAVE, backend=backend
        )
        index = march.ray_index
        rgb, sigma = field(march.positions, now.directions, index)
        rgb, sigma = rgb.to(near.dtype), sigma.to(near.dtype)
        part = composite(sigma, rgb, march.depths, march.deltas, ray_offsets=march.ray_offsets, backend=backend)
        light = through[live]
        colour[live] += light[:, None] * part.colour
        opacity[live] += light * part.opacity
        depth[live] += light * part.depth
        if heaviest:
            _keep_heaviest(top, at, live, light, part.weights, march.depths, march.ray_offsets, index, WAVE)
        light = light * (1 - part.opacity)
        through[live] = light
        more = ((march.stop < samples) & (light > OPAQUE)).nonzero()[:, 0]
        live, start = live[more], march.stop[more]
    if background is not None:
        colour += (1 - opacity)[:, None] * background.to(colour)
    place = rays.origins + at[:, None] * rays.directions
    place = place if grid.contraction is None else grid.contraction.points(place)
    return Seen(colour, opacity, _normalised(depth, opacity, far), place)


def _keep_heaviest(
    top: Tensor,
    at: Tensor,
    live: Tensor,
    light: Tensor,
    weights: Tensor,
    depths: Tensor,
    ray_offsets: Tensor,
    index: Tensor,
    most: int,
) -> None:
    """Updates depth `at` [r] and weight `top` [r] of the heaviest sample of each ray so far."""
    row = torch.arange(len(index), device=index.device) - ray_offsets[index]
    place = index.long() * most + row
    table = weights.new_full((2, len(live) * most), -1.0)
    table[0, place], table[1, place] = weights, depths
    weight, column = table[0].reshape(-1, most).max(dim=1)
    weight = weight * light
    better = weight > top[live]
    rays = live[better]
    top[rays] = weight[better]
    at[rays] = table[1].reshape(-1, most).gather(1, column[:, None])[:, 0][better]


def _normalised(depth: Tensor, opacity: Tensor, far: Tensor) -> Tensor:
    seen = opacity > 0
    return torch.where(seen, depth / torch.where(seen, opacity, 1), far)
