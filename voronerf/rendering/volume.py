"""Volume rendering: rays to colours through a field.

r rays, s samples a ray, n = r * s samples. Colours are in 0..1, distances in world units along unit
directions, densities per unit length.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops.composite import composite
from voronerf.rendering.cameras import Rays
from voronerf.rendering.cones import frustum_gaussians
from voronerf.rendering.contraction import Contraction, Perspective
from voronerf.rendering.field import Field
from voronerf.rendering.sampling import stratified_depths


class Rendered(NamedTuple):
    """What `render_rays` returns.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r], 0..1: the sum of the weights.
        depth: [r], expected distance, normalised by the opacity; the last edge for a ray with opacity 0.
        weights: [r, s], the contribution of each sample.
        positions: [r, s, 3].
        rgb: [r, s, 3], the colour of each sample.
        depths: [r, s], the distance of each sample.
        edges: [r, s + 1], the ends of the parts of the ray that the samples stand for.

    Examples:
        >>> import torch
        >>> from voronerf.rendering import Rays, render_rays
        >>> def wall(positions, directions, ray_index):  # from z = 1 on
        ...     return torch.ones_like(positions), torch.where(positions[:, 2] > 1, 1e9, 0.0)
        >>> rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_rays(wall, rays, 0.0, 2.0, samples=8)
        >>> result.depth, result.weights.shape
        (tensor([1.1250]), torch.Size([1, 8]))
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    weights: Tensor
    positions: Tensor
    rgb: Tensor
    depths: Tensor
    edges: Tensor


def render_rays(
    field: Field,
    rays: Rays,
    near: Tensor | float,
    far: Tensor | float,
    *,
    samples: int,
    background: Tensor | None = None,
    jitter: bool = False,
    generator: torch.Generator | None = None,
    spacing: str = "linear",
    backend: str = "auto",
) -> Rendered:
    """Colours of rays by quadrature of the volume rendering integral (Mildenhall et al. 2020, NeRF, eq. 3).

    Args:
        field: called once, on all r * s samples; the samples of a ray are consecutive.
        rays: r rays.
        near: start of the integral, [r] or one for all.
        far: end, [r] or one for all. A ray with far == near gets the background.
        samples: s, one in each of s strata.
        background: [3] or [r, 3], the colour behind the scene; None is black.
        jitter: random samples in the strata, else their middles.
        generator: of the jitter.
        spacing: of the strata, "linear" or "disparity".
        backend: of the composite op.

    Examples:
        >>> import torch
        >>> from voronerf.rendering import Rays, render_rays
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_rays(fog, rays, 0.0, 2.0, samples=64)
        >>> result.opacity.round(decimals=4)  # 1 - exp(-0.5 * 2)
        tensor([0.6321])
    """
    near, far = per_ray(near, rays), per_ray(far, rays)
    depths, _, edges = stratified_depths(near, far, samples, jitter=jitter, spacing=spacing, generator=generator)
    return render_samples(field, rays, depths, edges, background=background, backend=backend)


def render_samples(
    field: Field,
    rays: Rays,
    depths: Tensor,
    edges: Tensor,
    *,
    cones: bool = False,
    contraction: Contraction | Perspective | None = None,
    background: Tensor | None = None,
    full_gradient: float | None = None,
    backend: str = "auto",
) -> Rendered:
    """`render_rays` for given samples.

    Args:
        field: called once, on all r * s samples; the samples of a ray are consecutive. Its input is points [n, 3], or
            with cones Gaussians [n, 6].
        rays: r rays, with radii for cones.
        depths: [r, s].
        edges: [r, s + 1] around them.
        cones: evaluate the frustums of the cones between the edges.
        contraction: of the space that the field works in; the returned positions are contracted too.
        background: [3] or [r, 3].
        full_gradient: see `weaken_near`.
        backend: of the composite op.
    """
    samples = depths.shape[1]
    if cones:
        inputs = frustum_gaussians(rays, edges, contraction)
    else:
        inputs = torch.addcmul(rays.origins[:, None, :], depths[:, :, None], rays.directions[:, None, :])
        inputs = inputs if contraction is None else contraction.points(inputs)
    # A copy of an expanded view: repeat_interleave would gather.
    index = torch.arange(len(rays), device=depths.device, dtype=torch.int32)[:, None].expand(-1, samples).reshape(-1)
    rgb, sigma = field(inputs.reshape(-1, inputs.shape[-1]), rays.directions, index)
    # under autocast the field returns a half type; the sums along a ray are float32
    rgb = rgb.reshape(len(rays), samples, 3).to(depths.dtype)
    sigma = sigma.reshape(len(rays), samples).to(depths.dtype)
    weaken_near(full_gradient, depths, rgb, sigma)
    result = composite(sigma, rgb, depths, edges.diff(dim=-1), background=background, backend=backend)
    seen = result.opacity > 0
    depth = torch.where(seen, result.depth / torch.where(seen, result.opacity, 1), edges[:, -1])
    return Rendered(
        result.colour, result.opacity, depth, result.weights, inputs[..., :3], rgb, depths=depths, edges=edges
    )


def weaken_near(full: float | None, depths: Tensor, *outputs: Tensor) -> None:
    """Lets what a field has answered near the camera learn less: its gradients shrink with the square of the distance.

    A camera sees the space before it with more rays, and more samples, than others do: without this, fog that only one
    view shows is learnt there first. Source: Philip and Deschaintre 2023, "Floaters No More: Radiance Field Gradient
    Scaling for Improved Near-Camera Training".

    Args:
        full: the distance from which gradients are whole; None for any.
        depths: [...], of the samples.
        outputs: [...] or [..., f].
    """
    if full is None:
        return
    share = (depths / full).square().clamp(max=1)
    for output in outputs:
        if output.requires_grad:
            scale = share if output.dim() == share.dim() else share[..., None]
            output.register_hook(functools.partial(torch.mul, scale))


def per_ray(distance: Tensor | float, rays: Rays) -> Tensor:
    """One distance for each ray, given as one for all or as a tensor."""
    if isinstance(distance, Tensor):
        return distance.expand(len(rays))
    return torch.full_like(rays.origins[:, 0], distance)
