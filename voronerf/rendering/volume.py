"""Volume rendering: rays to colours through a field.

r rays, s samples a ray, n = r * s samples, h x w pixels. Colours are in 0..1, distances in world units along unit
directions, densities per unit length.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops.composite import composite
from voronerf.rendering.cameras import Cameras, Rays
from voronerf.rendering.field import Field
from voronerf.rendering.marching import render_until_opaque
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.rays import intersect_box
from voronerf.rendering.sampling import stratified_depths


class Rendered(NamedTuple):
    """What `render_rays` returns.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r], 0..1: the sum of the weights.
        depth: [r], expected distance, normalised by the opacity; `far` for a ray with none.
        weights: [r, s], each sample's contribution.
        positions: [r, s, 3].
        rgb: [r, s, 3], each sample's colour.
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    weights: Tensor
    positions: Tensor
    rgb: Tensor


class RenderedImage(NamedTuple):
    """What `render_image` returns.

    Attributes:
        colour: [h, w, 3], the background included.
        opacity: [h, w].
        depth: [h, w], as in `Rendered`.
        heaviest: [h, w, 3], position of each ray's heaviest sample: whose cell the pixel shows. Rays without samples
            have the point at their far end (opacity 0).
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    heaviest: Tensor


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
        field: called once, on all r * s samples, a ray's samples being consecutive.
        rays: r rays.
        near: start of the integral, [r] or one for all.
        far: end, [r] or one for all. A ray with far == near gets the background.
        samples: s, one in each of s strata.
        background: [3] or [r, 3], seen through what is transparent; None is black.
        jitter: stratified random samples, else the strata's middles.
        generator: of the jitter.
        spacing: of the strata, "linear" or "disparity".
        backend: of the composite op.
    """
    near, far = _per_ray(near, rays), _per_ray(far, rays)
    depths, deltas, _ = stratified_depths(near, far, samples, jitter=jitter, spacing=spacing, generator=generator)
    positions = torch.addcmul(rays.origins[:, None, :], depths[:, :, None], rays.directions[:, None, :])
    # A copy of an expanded view: repeat_interleave would gather.
    index = torch.arange(len(rays), device=positions.device, dtype=torch.int32)[:, None].expand(-1, samples).reshape(-1)
    rgb, sigma = field(positions.reshape(-1, 3), rays.directions, index)
    # a field under autocast answers in a half type: the sums along a ray are float32's
    rgb = rgb.reshape(len(rays), samples, 3).to(depths.dtype)
    sigma = sigma.reshape(len(rays), samples).to(depths.dtype)
    result = composite(sigma, rgb, depths, deltas, background=background, backend=backend)
    seen = result.opacity > 0
    depth = torch.where(seen, result.depth / torch.where(seen, result.opacity, 1), far)
    return Rendered(result.colour, result.opacity, depth, result.weights, positions, rgb)


@torch.no_grad()
def render_image(
    field: Field,
    cameras: Cameras,
    index: int,
    *,
    near: float,
    far: float,
    box: Tensor | None = None,
    samples: int,
    background: Tensor | None = None,
    spacing: str = "linear",
    occupancy: OccupancyGrid | None = None,
    heaviest: bool = True,
    chunk: int | None = None,
    backend: str = "auto",
) -> RenderedImage:
    """One camera's whole image, without gradients and without randomness.

    Args:
        field: as for `render_rays`.
        cameras: on the field's device.
        index: the camera.
        near: nearest distance of interest.
        far: farthest.
        box: [2, 3] outside of which nothing is; rays that miss it show the background without asking the field.
        samples: s, per ray, inside the box.
        background: [3], None is black.
        spacing: of the strata.
        occupancy: which cells of the box are empty; the field is asked about the others alone, up to where a ray is
            opaque. None asks about every sample.
        heaviest: whether to look for each ray's heaviest sample; without it the result has every ray's far end instead.
        chunk: rays rendered at a time; bounds the memory. Default 4,096, and with a grid, which leaves few samples of
            a ray, 32,768.
        backend: of the ops.
    """
    if chunk is None:
        chunk = 4096 if occupancy is None else 32_768
    if chunk < 1:
        raise ValueError(f"render_image: chunk must be >= 1, got {chunk}")
    rays = cameras.image_rays(index)
    first, last, hit = intersect_box(rays.origins, rays.directions, box, near, far)
    colour = torch.zeros_like(rays.origins) if background is None else background.to(rays.origins).repeat(len(rays), 1)
    opacity = torch.zeros_like(first)
    depth = torch.full_like(first, far)
    places = rays.origins + far * rays.directions
    for rows in hit.nonzero()[:, 0].split(chunk):
        if occupancy is not None:
            seen = render_until_opaque(
                field,
                rays[rows],
                first[rows],
                last[rows],
                occupancy,
                samples=samples,
                background=background,
                spacing=spacing,
                heaviest=heaviest,
                backend=backend,
            )
            colour[rows], opacity[rows], depth[rows], places[rows] = seen
            continue
        part = render_rays(
            field,
            rays[rows],
            first[rows],
            last[rows],
            samples=samples,
            background=background,
            spacing=spacing,
            backend=backend,
        )
        colour[rows] = part.colour.to(colour.dtype)
        opacity[rows] = part.opacity.to(opacity.dtype)
        depth[rows] = part.depth.to(depth.dtype)
        if heaviest:
            top = part.weights.argmax(-1)
            places[rows] = part.positions[torch.arange(len(rows), device=rows.device), top]
    size = (cameras.height, cameras.width)
    return RenderedImage(colour.reshape(*size, 3), opacity.reshape(size), depth.reshape(size), places.reshape(*size, 3))


def _per_ray(distance: Tensor | float, rays: Rays) -> Tensor:
    if isinstance(distance, Tensor):
        return distance.expand(len(rays))
    return torch.full_like(rays.origins[:, 0], distance)
