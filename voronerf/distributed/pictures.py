"""Pictures of a field whose cells are on several ranks. r rays, q runs."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from voronerf.distributed.sharing import Sharing
from voronerf.ops.composite import composite
from voronerf.ops.ray_runs.reference import along_rays, compose, sum_runs
from voronerf.rendering.cameras import Rays
from voronerf.rendering.marching import Seen
from voronerf.rendering.renderer import Renderer
from voronerf.rendering.volume import normalised


class LookOverRanks:
    """What the rays of a picture see, for ``Renderer.look``: every rank calls it, and gets the same.

    No ray ends at the first surface, since other ranks do not know it in time.

    Args:
        renderer: Of this rank.
        sharing: Which cells it has.
    """

    def __init__(self, renderer: Renderer, sharing: Sharing) -> None:
        self.renderer, self.sharing = renderer, sharing

    @torch.no_grad()
    def __call__(self, rays: Rays, near: Tensor, far: Tensor, background: Tensor | None, heaviest: bool) -> Seen:
        """Colour, opacity, depth and, where asked for, the heaviest sample of each ray."""
        renderer, contraction = self.renderer, self.renderer.contraction
        samples = self.sharing.samples(renderer.sampler, rays, near, far, picture=True)
        found = renderer.field(samples.positions, rays.directions, samples.ray_index)
        blend = functools.partial(composite, backend=renderer.backend)
        colour, density = (values.to(near.dtype) for values in found)
        runs = sum_runs(samples, colour, density, blend)
        columns = [runs.colour, *(x[:, None] for x in (runs.optical, runs.start, runs.ray, runs.depth))]
        if heaviest:
            run = torch.repeat_interleave(samples.run_offsets.diff())
            top = torch.zeros_like(runs.optical).scatter_reduce(0, run, runs.weights, "amax")
            at = torch.where(runs.weights == top[run], samples.depths, float("inf"))
            columns += [top[:, None], torch.full_like(top, float("inf")).scatter_reduce(0, run, at, "amin")[:, None]]
        parts = self.sharing.group.share("pictures", torch.cat([column.to(near.dtype) for column in columns], 1))
        sums = torch.cat(parts)
        sums = sums[along_rays(sums[:, 5].long(), sums[:, 4])]
        ray = sums[:, 5].long()
        whole = compose(sums[:, :3], sums[:, 3], ray, len(rays))
        seen, opacity = whole.colour, 1 - whole.through
        if background is not None:
            seen = seen + whole.through[:, None] * background.to(seen)
        depth = torch.zeros_like(near).index_add(0, ray, whole.front * sums[:, 6])
        places = rays.origins
        if heaviest:
            weight = whole.front * sums[:, 7]
            top = torch.zeros_like(near).scatter_reduce(0, ray, weight, "amax")
            chosen = (weight == top[ray]) & (weight > 0)
            at = far.clone()
            at[ray[chosen]] = sums[chosen, 8]
            places = rays.origins + at[:, None] * rays.directions
            places = places if contraction is None else contraction.points(places)
        return Seen(seen, opacity, normalised(depth, opacity, far), places)
