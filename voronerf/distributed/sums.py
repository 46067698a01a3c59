"""Partial sums: what a rank knows of a ray that passes through its cells, and how those of all ranks become a colour.

r rays, m samples of all rays (packed), q runs, c colours. A run is a piece of a ray on which no other rank has a sample
between two of its own. With the optical depth tau of the runs before, a ray has the colour ``sum exp(-tau) * colour of
run`` (NeRF, equation 3, in pieces; Li et al. 2024, NeRF-XL).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops.composite import composite

#: Stands for infinite density, as in `composite`.
_OPAQUE = 1e30


class Samples(NamedTuple):
    """Samples of this rank, ray after ray, near to far.

    Attributes:
        positions: [m, 3].
        ray_index: int32 [m].
        depths: [m].
        deltas: [m], the lengths of their strata.
        run_offsets: int32 [q + 1], where each run begins.
    """

    positions: Tensor
    ray_index: Tensor
    depths: Tensor
    deltas: Tensor
    run_offsets: Tensor


class Runs(NamedTuple):
    """The partial sums of runs. The first two have gradients.

    Attributes:
        colour: [q, c], as if nothing were in front.
        optical: [q], the optical depth.
        depth: [q], the sum of weight times depth.
        ray: int64 [q].
        start: [q], the depth of the first sample.
        weights: [m], contributions of the samples, as if nothing were in front of their run.
    """

    colour: Tensor
    optical: Tensor
    depth: Tensor
    ray: Tensor
    start: Tensor
    weights: Tensor


def own_samples(
    positions: Tensor,
    ray_index: Tensor,
    depths: Tensor,
    deltas: Tensor,
    cells: Tensor,
    own: Tensor,
    *,
    hidden: bool,
    bent: bool = False,
) -> Samples:
    """Keeps the samples in own cells, and finds their runs.

    Args:
        positions: [n, 3], all samples that this rank knows, in the order of :class:`Samples`, as the next three.
        ray_index: int32 [n].
        depths: [n].
        deltas: [n].
        cells: int32 [n], the cell of each.
        own: bool [n], whether it is one of this rank.
        hidden: Whether other ranks may have samples that are not among these. None lies between two neighbouring
            strata, nor, since a cell is convex, between two samples in one cell.
        bent: Whether rays are bent by a contraction, and may leave a cell and come back.
    """
    kept = own.nonzero()[:, 0]
    ray, at, length, cell = ray_index[kept], depths[kept], deltas[kept], cells[kept]
    begins = (kept.diff() != 1) | (ray.diff() != 0)
    if hidden:
        near = at.diff() < torch.minimum(length[1:], length[:-1])  # less than the stratum between would be long
        begins |= ~near if bent else (cell.diff() != 0) & ~near
    first = 1 + begins.nonzero()[:, 0]
    ends = torch.tensor([len(kept)], device=kept.device)
    offsets = torch.cat((ends.new_zeros(min(len(kept), 1)), first, ends)).to(torch.int32)
    return Samples(positions[kept], ray, at, length, offsets)


def sum_runs(samples: Samples, colour: Tensor, density: Tensor, backend: str) -> Runs:
    """The partial sums of the runs of samples with these colours [m, c] and densities [m]."""
    offsets = samples.run_offsets
    first = offsets[:-1].long()
    run = torch.repeat_interleave(offsets.diff())
    found = composite(density, colour, samples.depths, samples.deltas, ray_offsets=offsets, backend=backend)
    optical = torch.zeros_like(samples.depths[first]).index_add(0, run, density.clamp(max=_OPAQUE) * samples.deltas)
    ray, start = samples.ray_index[first].long(), samples.depths[first]
    return Runs(found.colour, optical, found.depth.detach(), ray, start, found.weights.detach())


class Composed(NamedTuple):
    """Rays made of runs.

    Attributes:
        colour: [r, c], without a background.
        through: [r], the light that passes all of them.
        before: [q], the optical depth in front of each run.
        place: int64 [q], where each run is in a table with a row for each ray.
        width: The columns of the table.
    """

    colour: Tensor
    through: Tensor
    before: Tensor
    place: Tensor
    width: int

    @property
    def front(self) -> Tensor:
        """[q], the light that arrives at each run."""
        return torch.exp(-self.before)

    def behind(self, colour: Tensor, ray: Tensor, slopes: Tensor, background: Tensor) -> Tensor:
        """What the light from behind each run [q] adds to the loss, which more optical depth takes away.

        Args:
            colour: [q, c], as of :func:`compose`.
            ray: int64 [q], likewise.
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
    before = torch.nn.functional.pad(table[:, :-1], (1, 0)).cumsum(1).view(-1)[place]
    whole = colour.new_zeros(rays, colour.shape[1]).index_add(0, ray, torch.exp(-before)[:, None] * colour)
    return Composed(whole, torch.exp(-table.sum(1)), before, place, width)


def along_rays(ray: Tensor, start: Tensor) -> Tensor:
    """The order of runs [q] by their rays, int64, and from near to far, by their starts >= 0."""
    bits = start.float().view(torch.int32)  # as large as the floats themselves
    return ((ray << 32) + bits).argsort(stable=True)
