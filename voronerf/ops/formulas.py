"""Formulas in plain PyTorch that the reference implementations share with the rest of the library.

r rays, m samples of all rays (packed), n points, s strata of a ray.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.ops.composite import Composite


def in_pieces(run: Callable[..., Tensor], rows: int, *tensors: Tensor) -> Tensor:
    """Calls ``run`` on slices of ``rows`` rows and concatenates the results.

    In a compiled graph, ``run`` gets all rows at once, because the compiler would unroll the loop.
    """
    if torch.compiler.is_compiling() or tensors[0].shape[0] <= rows:
        return run(*tensors)
    return torch.cat([run(*piece) for piece in zip(*(tensor.split(max(1, rows)) for tensor in tensors))])


# Depths ---------------------------------------------------------------------------------------------------------------

SPACINGS = ("linear", "disparity")
"""The spacings of the strata of a ray."""


def depth_of(near: Tensor, far: Tensor, fraction: Tensor, spacing: str) -> Tensor:
    """Returns the distance at a fraction of the ray: linear in the distance, or in 1 / distance for "disparity"."""
    if spacing == "linear":
        return near + (far - near) * fraction
    # Equals 1 / lerp(1 / near, 1 / far), without rounding the reciprocals and without 0 / 0 for near = 0.
    inverse = far * (1 - fraction) + near * fraction
    return near * far / inverse.clamp_min(torch.finfo(near.dtype).tiny)


# Boxes ----------------------------------------------------------------------------------------------------------------


def meet_box(origins: Tensor, directions: Tensor, box: Tensor, near: float, far: float) -> tuple[Tensor, Tensor]:
    """Returns the distances [r] at which rays [r, 3] enter and leave a box [2, 3], by the slab method.

    Both distances are clamped to `near` and `far`. They are equal if a ray misses the box.
    """
    low, high = (box[0] - origins) / directions, (box[1] - origins) / directions
    first, last = torch.minimum(low, high), torch.maximum(low, high)
    # NaN and infinity guard: a ray parallel to a slab is inside the slab at all distances or at none.
    parallel = directions == 0
    if not parallel.is_cpu or torch.compiler.is_compiling() or bool(parallel.any()):
        inside = (origins >= box[0]) & (origins <= box[1])
        infinity = torch.full_like(first, float("inf"))
        first = torch.where(parallel, torch.where(inside, -infinity, infinity), first)
        last = torch.where(parallel, torch.where(inside, infinity, -infinity), last)
    (a, b, c), (x, y, z) = first.unbind(-1), last.unbind(-1)  # half the time of amax and amin
    enter = a.maximum(b).maximum(c).clamp(near, far)
    return enter, torch.maximum(enter, x.minimum(y).minimum(z).clamp(near, far))


def voxels_of(points: Tensor, box: Tensor, shape: torch.Size) -> Tensor:
    """Returns int32 [n], the row-major index of each point's voxel; points [n, 3] are clamped to the box."""
    places = (points - box[0]) / (box[1] - box[0])
    x, y, z = ((places[:, i] * size).nan_to_num(0).clamp(0, size - 1).int() for i, size in enumerate(shape))
    return (x * shape[1] + y) * shape[2] + z


# Light ----------------------------------------------------------------------------------------------------------------


def activate(raw: Tensor, density_scale: float = 1.0, activated: bool = False) -> tuple[Tensor, Tensor]:
    """Returns colours [m, 3] and densities [m] from the networks' outputs [m, 4]; `activated` skips the activations."""
    if activated:
        return raw[:, :3], raw[:, 3]
    return torch.sigmoid(raw[:, :3]), F.softplus(raw[:, 3]) * density_scale


class RenderedRays(NamedTuple):
    """The rendered colours, opacities and depths of rays.

    A ray is terminated when its transmittance is at most ``opaque``, as in `render_opaque`.

    Attributes:
        colour: [r, 3], with the background. The colour of a terminated ray is divided by its accumulated opacity.
        opacity: [r], 1 for a terminated ray.
        depth: [r], the weighted mean depth of the samples; the far end for a ray of opacity 0.
        light: [r], the remaining transmittance, 0 to 1.
        heaviest: [r], the depth of the sample with the largest weight; the far end for a ray without samples.

    Examples:
        >>> from voronerf.ops import RenderedRays
        >>> RenderedRays._fields
        ('colour', 'opacity', 'depth', 'light', 'heaviest')
    """

    colour: Annotated[Tensor, "same [r, 3]"]
    opacity: Annotated[Tensor, "same [r]"]
    depth: Annotated[Tensor, "same [r]"]
    light: Annotated[Tensor, "same [r]"]
    heaviest: Annotated[Tensor, "same [r]"]


class Wave(NamedTuple):
    """The composited samples of one wave. A wave contains the next few samples of each ray that is not yet opaque.

    Attributes:
        composite: The result of compositing only the samples of this wave.
        ray_index: int32 [m], the ray of each sample.
        ray_offsets: int32 [rays + 1], the first sample of each ray, then m.
        depths: [m], the distances of the samples along the rays.
        stop: int32 [rays], the stratum from which the next wave continues each ray; s for a finished ray.
    """

    composite: Composite
    ray_index: Tensor
    ray_offsets: Tensor
    depths: Tensor
    stop: Tensor


@torch.no_grad()
def walk(
    render_wave: Callable[[Tensor, Tensor | None], Wave],
    far: Tensor,
    samples: int,
    wave: int,
    opaque: float,
    background: Tensor | None,
    heaviest: bool,
) -> RenderedRays:
    """Renders rays in waves of samples, each ray until it is opaque.

    Args:
        render_wave: A function that evaluates the next wave. Its arguments are the indices of the rays (int64) and
            their first strata (int32, or None for 0).
        far: [r], the far ends of the rays.
        samples: The number of strata of a ray, s.
        wave: The largest number of samples of a ray in a wave.
        opaque: A ray ends after a wave if its transmittance is at most this value.
        background: [3] or [r, 3]; None is black.
        heaviest: Whether to find the heaviest samples.
    """
    colour, opacity, depth = far.new_zeros(len(far), 3), torch.zeros_like(far), torch.zeros_like(far)
    through, heaviest_weight, heaviest_depth = torch.ones_like(far), torch.zeros_like(far), far.clone()
    live, start = torch.arange(len(far), device=far.device), None
    while live.numel() > 0:
        step = render_wave(live, start)
        part, light = step.composite, through[live]
        colour[live] += light[:, None] * part.colour
        opacity[live] += light * part.opacity
        depth[live] += light * part.depth
        if heaviest:
            weight, depths_at = _heaviest(step, wave)
            weight = weight * light
            better = weight > heaviest_weight[live]
            heaviest_weight[live[better]], heaviest_depth[live[better]] = weight[better], depths_at[better]
        light = light * (1 - part.opacity)
        through[live] = light
        more = ((step.stop < samples) & (light > opaque)).nonzero()[:, 0]
        live, start = live[more], step.stop[more]
    depth = torch.where(opacity > 0, depth / opacity, far)
    ended = through <= opaque
    colour, opacity = torch.where(ended[:, None], colour / opacity[:, None], colour), opacity.masked_fill(ended, 1)
    if background is not None:
        colour = colour + (1 - opacity)[:, None] * background.to(colour)
    return RenderedRays(colour, opacity, depth, through, heaviest_depth)


def _heaviest(wave: Wave, most: int) -> tuple[Tensor, Tensor]:
    """Returns weight and depth [r] of the heaviest sample of each ray; both are -1 for a ray without samples.

    `most` is the largest number of samples of a ray.
    """
    weights, rays = wave.composite.weights, len(wave.stop)
    row = torch.arange(len(weights), device=weights.device) - wave.ray_offsets[wave.ray_index]
    table = weights.new_full((2, rays * most), -1.0)
    table[:, wave.ray_index.long() * most + row] = torch.stack((weights, wave.depths))
    weight, column = table[0].reshape(-1, most).max(dim=1)
    return weight, table[1].reshape(-1, most).gather(1, column[:, None])[:, 0]
