"""Formulas that references of operations share with the rest of the library, in plain PyTorch.

r rays, m samples of all rays (packed), q runs of samples, c colours, n points, s strata of a ray.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.ops.composite import Composite


def in_pieces(run: Callable[..., Tensor], rows: int, *tensors: Tensor) -> Tensor:
    """``run`` on so many rows of the tensors at a time; a compiler, which would unroll the loop, gets them whole."""
    if torch.compiler.is_compiling() or tensors[0].shape[0] <= rows:
        return run(*tensors)
    return torch.cat([run(*piece) for piece in zip(*(tensor.split(max(1, rows)) for tensor in tensors))])


# Depths ---------------------------------------------------------------------------------------------------------------

SPACINGS = ("linear", "disparity")
"""How strata of a ray are spaced."""


def depth_of(near: Tensor, far: Tensor, fraction: Tensor, spacing: str) -> Tensor:
    """The distance at a fraction of the way, in equal steps of distance or of 1 / distance."""
    if spacing == "linear":
        return near + (far - near) * fraction
    # 1 / lerp(1 / near, 1 / far), without the two roundings of the reciprocals, and without 0 / 0 where near is 0
    inverse = far * (1 - fraction) + near * fraction
    return near * far / inverse.clamp_min(torch.finfo(near.dtype).tiny)


# Boxes ----------------------------------------------------------------------------------------------------------------


def meet_box(origins: Tensor, directions: Tensor, box: Tensor, near: float, far: float) -> tuple[Tensor, Tensor]:
    """Where rays [r, 3] enter and leave a box [2, 3] between `near` and `far` (slab method); equal if they miss it."""
    low, high = (box[0] - origins) / directions, (box[1] - origins) / directions
    first, last = torch.minimum(low, high), torch.maximum(low, high)
    # 0 / 0 and +-inf: a ray parallel to a slab is inside it at all distances or at none
    parallel = directions == 0
    if not parallel.is_cpu or torch.compiler.is_compiling() or bool(parallel.any()):
        inside = (origins >= box[0]) & (origins <= box[1])
        infinity = torch.full_like(first, float("inf"))
        first = torch.where(parallel, torch.where(inside, -infinity, infinity), first)
        last = torch.where(parallel, torch.where(inside, infinity, -infinity), last)
    (a, b, c), (x, y, z) = first.unbind(-1), last.unbind(-1)  # in half the time of amax and amin
    enter = a.maximum(b).maximum(c).clamp(near, far)
    return enter, torch.maximum(enter, x.minimum(y).minimum(z).clamp(near, far))


def voxels_of(points: Tensor, box: Tensor, shape: torch.Size) -> Tensor:
    """Flat numbers int32 [n] of the voxels that points [n, 3] lie in; outside the box the nearest at its border."""
    places = (points - box[0]) / (box[1] - box[0])
    x, y, z = ((places[:, i] * size).nan_to_num(0).clamp(0, size - 1).int() for i, size in enumerate(shape))
    return (x * shape[1] + y) * shape[2] + z


# Light ----------------------------------------------------------------------------------------------------------------


def activate(raw: Tensor, density_scale: float = 1.0, activated: bool = False) -> tuple[Tensor, Tensor]:
    """Colours [m, 3] and densities [m] of what networks put out [m, 4]; as they are where they are activated."""
    if activated:
        return raw[:, :3], raw[:, 3]
    return torch.sigmoid(raw[:, :3]), F.softplus(raw[:, 3]) * density_scale


class RaysSeen(NamedTuple):
    """What rays see.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r], 1 for a ray that has ended.
        depth: [r], the mean by weight; the far end for a ray without any.
        light: [r], the share of the light that is left. A ray that has ended has the colour of what it has met by then.
        heaviest: [r], the depth of the heaviest sample; the far end for a ray without any.

    Examples:
        >>> from voronerf.ops import RaysSeen
        >>> RaysSeen._fields
        ('colour', 'opacity', 'depth', 'light', 'heaviest')
    """

    colour: Annotated[Tensor, "same [r, 3]"]
    opacity: Annotated[Tensor, "same [r]"]
    depth: Annotated[Tensor, "same [r]"]
    light: Annotated[Tensor, "same [r]"]
    heaviest: Annotated[Tensor, "same [r]"]


class Wave(NamedTuple):
    """Samples of rays, as they were seen.

    Attributes:
        seen: Of the rays, by these samples alone.
        ray_index: int32 [m].
        ray_offsets: int32 [rays + 1].
        depths: [m].
        stop: int32 [rays], the strata at which the rays go on.
    """

    seen: Composite
    ray_index: Tensor
    ray_offsets: Tensor
    depths: Tensor
    stop: Tensor


@torch.no_grad()
def walk(
    look: Callable[[Tensor, Tensor | None], Wave],
    far: Tensor,
    samples: int,
    wave: int,
    opaque: float,
    background: Tensor | None,
    heaviest: bool,
) -> RaysSeen:
    """Walks rays in waves, each until it is opaque, and returns what they see.

    Args:
        look: The next wave of some rays, int64, from strata int32 on, or with None from the first.
        far: [r].
        samples: s.
        wave: Samples of a ray in a wave, at the most.
        opaque: Rays end with a wave after which no more light than this is left.
        background: [3] or [r, 3]; None is black.
        heaviest: Whether to find the heaviest samples.
    """
    colour, opacity, depth = far.new_zeros(len(far), 3), torch.zeros_like(far), torch.zeros_like(far)
    through, top, at = torch.ones_like(far), torch.zeros_like(far), far.clone()
    live, start = torch.arange(len(far), device=far.device), None
    while live.numel() > 0:
        found = look(live, start)
        part, light = found.seen, through[live]
        colour[live] += light[:, None] * part.colour
        opacity[live] += light * part.opacity
        depth[live] += light * part.depth
        if heaviest:
            weight, place = _heaviest(found, wave)
            weight = weight * light
            better = weight > top[live]
            top[live[better]], at[live[better]] = weight[better], place[better]
        light = light * (1 - part.opacity)
        through[live] = light
        more = ((found.stop < samples) & (light > opaque)).nonzero()[:, 0]
        live, start = live[more], found.stop[more]
    depth = torch.where(opacity > 0, depth / opacity, far)
    ended = through <= opaque
    colour, opacity = torch.where(ended[:, None], colour / opacity[:, None], colour), opacity.masked_fill(ended, 1)
    if background is not None:
        colour = colour + (1 - opacity)[:, None] * background.to(colour)
    return RaysSeen(colour, opacity, depth, through, at)


def _heaviest(wave: Wave, most: int) -> tuple[Tensor, Tensor]:
    """Weight and depth [r] of the heaviest sample of each ray, of which there are at most `most`; -1 without any."""
    weights, rays = wave.seen.weights, len(wave.stop)
    row = torch.arange(len(weights), device=weights.device) - wave.ray_offsets[wave.ray_index]
    table = weights.new_full((2, rays * most), -1.0)
    table[:, wave.ray_index.long() * most + row] = torch.stack((weights, wave.depths))
    weight, column = table[0].reshape(-1, most).max(dim=1)
    return weight, table[1].reshape(-1, most).gather(1, column[:, None])[:, 0]


class Composed(NamedTuple):
    """Rays made of runs."""

    colour: Tensor  # [r, c], without a background
    through: Tensor  # [r], the light that passes all of them
    before: Tensor  # [q], the optical depth in front of each run
    place: Tensor  # int64 [q], where each run is in a table with a row for each ray
    width: int  # the columns of the table

    @property
    def front(self) -> Tensor:
        """[q], the light that arrives at each run."""
        return torch.exp(-self.before)

    def behind(self, colour: Tensor, ray: Tensor, slopes: Tensor, background: Tensor) -> Tensor:
        """[q], the loss due to light from behind each run, which more optical depth takes away.

        Args:
            colour: [q, c], of the runs.
            ray: int64 [q], their rays.
            slopes: [r, c], the gradient of each ray's colour over its background.
            background: [r, c].
        """
        table = slopes.new_zeros(len(slopes), self.width)
        table.view(-1)[self.place] = self.front * (slopes[ray] * colour).sum(1)
        table = torch.cat((table[:, 1:], (self.through * (slopes * background).sum(1))[:, None]), 1)
        return table.flip(1).cumsum(1).flip(1).view(-1)[self.place]


def compose(colour: Tensor, optical: Tensor, ray: Tensor, rays: int) -> Composed:
    """Puts runs together, without gradients of its own.

    Args:
        colour: [q, c].
        optical: [q].
        ray: int64 [q], ascending; the runs of a ray from near to far.
        rays: r.
    """
    counts = torch.bincount(ray, minlength=rays)
    slot = torch.arange(len(ray), device=ray.device) - (counts.cumsum(0) - counts)[ray]
    width = int(counts.max()) if len(ray) else 1
    place = ray * width + slot
    table = optical.new_zeros(rays, width)
    table.view(-1)[place] = optical
    # The sum is shifted: less its last term it would be inf - inf for an opaque run.
    before = F.pad(table[:, :-1], (1, 0)).cumsum(1).view(-1)[place]
    whole = colour.new_zeros(rays, colour.shape[1]).index_add(0, ray, torch.exp(-before)[:, None] * colour)
    return Composed(whole, torch.exp(-table.sum(1)), before, place, width)


def along_rays(ray: Tensor, start: Tensor) -> Tensor:
    """The order of runs [q] by their rays, int64, and from near to far, by their starts >= 0."""
    bits = start.float().view(torch.int32)  # as large as the floats themselves
    return ((ray << 32) + bits).argsort(stable=True)
