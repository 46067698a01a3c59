"""Renders and learns rays that pass through the cells of several ranks. Only partial sums of rays travel.

Before the first split all ranks have the same network, and each evaluates its slice of the rays. Afterwards each
evaluates its own cells on all rays. Each rank puts a slice of the rays together: it gets a partial sum of each run from
those that evaluated it, 24 bytes, and answers with what its gradients follow from (Li et al. 2024, NeRF-XL).

r rays, m own samples, q runs.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from voronerf import backends
from voronerf.distributed.group import Group
from voronerf.distributed.sharing import Sharing, voxels_of_ranks
from voronerf.distributed.sums import Samples, along_rays, compose, own_samples, sum_runs
from voronerf.ops.march_rays import March
from voronerf.rendering.cameras import Rays
from voronerf.rendering.comparison import compare_samples, compares_outputs
from voronerf.rendering.marching import Seen, draw_seed
from voronerf.rendering.occupancy import HIDDEN, OccupancyGrid, density_of
from voronerf.rendering.renderer import RenderedImage, Renderer
from voronerf.rendering.sampling import NEARBY, stratified_depths
from voronerf.rendering.volume import weaken_near
from voronerf.router import VoronoiRouter

#: Rays of a picture at a time: no ray ends at the first surface, since other ranks do not know it in time.
PICTURE_CHUNK = 16_384


class Learnt(NamedTuple):
    """What a step finds, beside the gradients that it leaves.

    Attributes:
        loss: [], the part of the rays that this rank puts together.
        positions: [m, 3] of own samples.
        density: [m].
        deltas: [m].
        weights: [m], their contributions to their rays.
        importance: [m], the weights times the errors of the rays.
    """

    loss: Tensor
    positions: Tensor
    density: Tensor
    deltas: Tensor
    weights: Tensor
    importance: Tensor


class RankRenderer(Renderer):
    """A renderer in one pass over points, for all ranks at once: each of them calls the same methods.

    Attributes:
        group: The ranks.
        sharing: Which of them owns which cells; None while all have the same network, like the next two.
        reached: bool [v], the voxels of the grid that own cells reach.
        several: bool [v], those that cells of two or more ranks reach.
    """

    group: Group
    sharing: Sharing | None = None
    reached: Tensor | None = None
    several: Tensor | None = None
    _numbers: Tensor  # int32 [k], of each cell among own ones, or -1

    def join(self, group: Group) -> None:
        """Renders with the ranks of a group."""
        self.group = group

    def own_cells(self, sharing: Sharing) -> None:
        """Renders only the cells of this rank from now on; the grid forgets what they do not reach."""
        self.sharing = sharing
        own = sharing.owner == self.group.rank
        self._numbers = torch.where(own, own.cumsum(0) - 1, -1).to(torch.int32)
        if self.occupancy is not None:
            reached = voxels_of_ranks(sharing, self.occupancy, self.group.size)
            self.reached, self.several = reached[self.group.rank], reached.sum(0) > 1
            self.forget_others(self.occupancy)

    @property
    def _natively(self) -> bool:
        return self.device.type == "cpu" and backends.missing("native", self.device) is None

    # --- samples ---------------------------------------------------------------------------------------------------

    def _slices(self, rays: int) -> list[int]:
        """The rays of each rank: from the first number to before the next."""
        return [rays * rank // self.group.size for rank in range(self.group.size + 1)]

    def _owns(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """The cell of each position, and whether this rank evaluates it."""
        if self.sharing is None:
            cells = torch.zeros(len(positions), dtype=torch.int32, device=positions.device)
            return cells, torch.ones_like(cells, dtype=torch.bool)
        cells = self.sharing.diagram.locate(positions, backend=self.backend)
        return cells, self.sharing.owner[cells] == self.group.rank

    def samples_of(
        self, rays: Rays, near: Tensor, far: Tensor, *, jitter: bool = False, generator: torch.Generator | None = None
    ) -> Samples:
        """The samples that this rank evaluates: those that one process would, with the same random numbers."""
        first, last = 0, len(rays)
        if self.sharing is None:
            first, last = self._slices(len(rays))[self.group.rank :][:2]
        grid, kept = self.occupancy, slice(first, last)
        strata = self.samples if jitter or grid is None else self.picture_samples
        if grid is None:
            depths, deltas, _ = stratified_depths(
                near, far, self.samples, jitter=jitter, spacing=self.spacing, generator=generator
            )
            depths, deltas = depths[kept], deltas[kept]
            positions = torch.addcmul(rays.origins[kept, None, :], depths[:, :, None], rays.directions[kept, None, :])
            positions = positions if self.contraction is None else self.contraction.points(positions)
            index = torch.arange(first, last, device=near.device, dtype=torch.int32).repeat_interleave(self.samples)
            found = positions.reshape(-1, 3), index, depths.reshape(-1), deltas.reshape(-1)
        else:
            # A ray's jitter follows from the sum of seed and number.
            seed = draw_seed(near.device, generator) + first if jitter else None
            given: dict[str, Any] = {"seed": seed, "spacing": self.spacing, "backend": self.backend}
            march = grid.march(rays[kept], near[kept], far[kept], strata, **given)
            found = march.positions, march.ray_index + first, march.depths, march.deltas
        hidden = self.sharing is not None and grid is not None
        return own_samples(*found, *self._owns(found[0]), hidden=hidden, bent=self.contraction is not None)

    # --- a step ----------------------------------------------------------------------------------------------------

    def learn(
        self,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        target: Tensor,
        *,
        background: Tensor | None = None,
        generator: torch.Generator | None = None,
        seen: Tensor | None = None,
    ) -> Learnt:
        """Renders rays, the same on all ranks, and leaves the gradients of their loss, see :meth:`Renderer.loss`.

        Gradients of parameters that several ranks have are sums over the samples of this one.

        Args:
            rays: r rays.
            near: [r].
            far: [r].
            target: [r, 3].
            background: [3] or [r, 3]; None is black.
            generator: Of the samples, in the same state on all ranks.
            seen: [s], the distances of points at which the last s rays end, or None.
        """
        own = slice(*self._slices(len(rays))[self.group.rank :][:2])
        background = None if background is None else background.expand_as(target)
        if self.occupancy is not None and seen is None and compares_outputs(self):
            if self.sharing is None:
                march = self._march(self.occupancy, rays[own], near[own], far[own], generator, own.start)
                return self._learn_slice(rays, march, target, background, own)
            if self._natively and self.full_gradient is None:
                march = self._march(self.occupancy, rays, near, far, generator, 0)
                return self._learn_natively(rays, march, target, background, own)
        samples = self.samples_of(rays, near, far, jitter=True, generator=generator)
        colour, density = self.field(samples.positions, rays.directions, samples.ray_index)
        colour, density = colour.to(near.dtype), density.to(near.dtype)
        weaken_near(self.full_gradient, samples.depths, colour, density)
        c, points = 3, None
        if seen is not None:  # the light from where points were seen is a fourth colour
            c, points = 4, torch.full_like(near, float("nan"))
            points[len(rays) - len(seen) :] = seen
            colour = torch.cat((colour, _lies_at(points, samples)[:, None]), 1)
        runs = sum_runs(samples, colour, density, self.backend)
        sums = torch.cat((runs.colour, runs.optical[:, None], runs.start[:, None], runs.ray[:, None]), 1).detach()
        parts, sizes = self._tell_sums(sums, len(rays))
        shown = None if background is None else background[own]
        given = torch.cat(parts), own.start, target[own], shown, None if points is None else points[own]
        answers, loss = self._answer(*given, rays=len(rays), seen=0 if seen is None else len(seen))
        answers = torch.cat(self.group.swap("sums", answers.split(list(map(len, parts))), sizes))
        run, front = torch.repeat_interleave(samples.run_offsets.diff()), torch.exp(-answers[:, c + 1])
        weights = runs.weights * front[run]
        if self.occupancy is not None:
            hidden = weights <= HIDDEN * -torch.expm1(-density.detach() * samples.deltas)
            colour.register_hook(lambda gradient: gradient.masked_fill(hidden[:, None], 0))
            density.register_hook(lambda gradient: gradient.masked_fill(hidden, 0))
        torch.autograd.backward((runs.colour, runs.optical), (front[:, None] * answers[:, :c], -answers[:, c]))
        importance = weights * answers[run, c + 2]
        return Learnt(loss, samples.positions, density.detach(), samples.deltas, weights, importance)

    def _march(
        self,
        grid: OccupancyGrid,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        generator: torch.Generator | None,
        first: int,
    ) -> March:
        """The samples of rays from a first one on, with the jitter of all: a ray's follows from seed plus number."""
        seed = draw_seed(near.device, generator) + first
        return grid.march(rays, near, far, self.samples, seed=seed, spacing=self.spacing, backend=self.backend)

    def _learn_slice(self, rays: Rays, march: March, target: Tensor, background: Tensor | None, own: slice) -> Learnt:
        """:meth:`learn` where all ranks have the same network: no ray is split."""
        found = compare_samples(self, rays[own], march, target[own], None if background is None else background[own])
        loss = found.loss * (len(found.error) / len(rays))
        loss.backward()
        assert found.density is not None
        weights, importance = found.weights, found.importance()
        return Learnt(loss.detach(), march.positions, found.density, march.deltas, weights, importance)

    def _learn_natively(
        self, rays: Rays, march: March, target: Tensor, background: Tensor | None, own: slice
    ) -> Learnt:
        """:meth:`learn` from the outputs of the networks, where these mean a colour and a density."""
        from voronerf.ops.ray_runs import native as ray_runs

        assert self.sharing is not None
        field = cast(VoronoiRouter, self.field)
        scale = float(cast(Any, field.module).density_scale)
        cells = self.sharing.diagram.locate(march.positions, backend=self.backend)
        samples = ray_runs.own_samples(march, cells, self._numbers, bent=self.contraction is not None)
        routed = field.table_arguments(samples.positions, rays.directions, samples.ray_index)
        assert routed is not None
        networks = ray_runs.Networks(routed, samples.cells)
        sums, density = ray_runs.run_sums(networks.out, samples, scale)
        parts, sizes = self._tell_sums(sums, len(rays))
        behind = None if background is None else background[own]
        every = torch.cat(parts)
        answers, loss = ray_runs.compose_runs(every, target[own], behind, first=own.start, rays=len(rays))
        answers = torch.cat(self.group.swap("sums", answers.split(list(map(len, parts))), sizes))
        gradient, weights, importance = ray_runs.run_gradients(networks.out, samples, answers, scale, HIDDEN)
        networks.backward(gradient)
        return Learnt(loss, samples.positions, density, samples.deltas, weights, importance)

    def _tell_sums(self, sums: Tensor, rays: int) -> tuple[list[Tensor], list[int]]:
        """Sends sums [q, c], by ascending rays, to the ranks that put these together.

        Returns:
            The sums that come from each rank, and how many went there.
        """
        bounds = torch.tensor(self._slices(rays), dtype=sums.dtype, device=sums.device)
        cuts = torch.searchsorted(sums[:, -1].contiguous(), bounds).tolist()
        sizes = [end - begin for begin, end in itertools.pairwise(cuts)]
        return self.group.exchange("sums", sums.split(sizes)), sizes

    def _answer(
        self,
        sums: Tensor,
        first: int,
        target: Tensor,
        shown: Tensor | None,
        points: Tensor | None,
        *,
        rays: int,
        seen: int,
    ) -> tuple[Tensor, Tensor]:
        """What runs must be told of their rays, those from a first one on.

        Args:
            sums: [q, c + 3] of all ranks: colours, optical depth, start, ray.
            first: The number of the first ray.
            target: [r, 3], the colours of these rays.
            shown: [r, 3], what is behind them, or None.
            points: [r], the distance of the point at the end of each or NaN, or None.
            rays: How many all ranks have.
            seen: Those of them that end at points.

        Returns:
            For each run [q, c + 3] the gradients of its ray's colours, what light behind it adds to the loss, the
            optical depth in front of it, and the error of its ray; and the part [] that these rays have in the loss.
        """
        c = sums.shape[1] - 3
        order = along_rays(sums[:, c + 2].long(), sums[:, c + 1])
        part, optical, ray = sums[order, :c], sums[order, c], sums[order, c + 2].long() - first
        whole = compose(part, optical, ray, len(target))
        behind = torch.zeros_like(whole.colour)
        if shown is not None:
            behind[:, :3] = shown
        off = whole.colour[:, :3] + whole.through[:, None] * behind[:, :3] - target
        error = off.square().sum(-1)
        slopes, loss = torch.zeros_like(behind), error.sum() / (3 * rays)
        slopes[:, :3] = off * (2 / (3 * rays))
        if points is not None:  # as `sighting_loss`
            light, ends = whole.colour[:, 3], ~points.isnan()
            share = self.sightings / seen
            slopes[:, 3] = torch.where(ends & (light >= 1e-3) & (light <= 1), -share / light, 0)
            loss = loss - share * torch.log(light[ends].clamp(1e-3, 1)).sum()
        answers = torch.empty_like(sums)
        answers[order, :c], answers[order, c] = slopes[ray], whole.behind(part, ray, slopes, behind)
        answers[order, c + 1], answers[order, c + 2] = whole.before, error[ray]
        return answers, loss

    # --- the grid --------------------------------------------------------------------------------------------------

    def revisited(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """The field of all ranks, for the grid: each evaluates the positions that it owns."""
        _, own = self._owns(positions)
        if self.sharing is None:
            own[:] = False
            bounds = self._slices(len(positions))
            own[bounds[self.group.rank] : bounds[self.group.rank + 1]] = True
        density = torch.zeros_like(positions[:, 0])
        density[own] = density_of(self.field, positions[own])
        return torch.zeros_like(positions), self.group.largest(density)

    def forget_others(self, grid: OccupancyGrid) -> None:
        """Empties the voxels that own cells do not reach; they have no samples then."""
        if self.reached is not None:
            grid.density.view(-1)[~self.reached] = 0
            grid.occupied.view(-1)[~self.reached] = False

    # --- pictures --------------------------------------------------------------------------------------------------

    def look(self, rays: Rays, near: Tensor, far: Tensor, background: Tensor | None, heaviest: bool) -> Seen:
        """As that of a renderer; every rank gets the same."""
        samples = self.samples_of(rays, near, far)
        colour, density = self.field(samples.positions, rays.directions, samples.ray_index)
        runs = sum_runs(samples, colour.to(near.dtype), density.to(near.dtype), self.backend)
        columns = [runs.colour, *(x[:, None] for x in (runs.optical, runs.start, runs.ray, runs.depth))]
        if heaviest:
            run = torch.repeat_interleave(samples.run_offsets.diff())
            top = torch.zeros_like(runs.optical).scatter_reduce(0, run, runs.weights, "amax")
            at = torch.where(runs.weights == top[run], samples.depths, float("inf"))
            columns += [top[:, None], torch.full_like(top, float("inf")).scatter_reduce(0, run, at, "amin")[:, None]]
        parts = self.group.share("pictures", torch.cat([column.to(near.dtype) for column in columns], 1))
        sums = torch.cat(parts)
        sums = sums[along_rays(sums[:, 5].long(), sums[:, 4])]
        ray = sums[:, 5].long()
        whole = compose(sums[:, :3], sums[:, 3], ray, len(rays))
        seen, opacity = whole.colour, 1 - whole.through
        if background is not None:
            seen = seen + whole.through[:, None] * background.to(seen)
        depth = torch.zeros_like(near).index_add(0, ray, whole.front * sums[:, 6])
        depth = torch.where(opacity > 0, depth / torch.where(opacity > 0, opacity, 1), far)
        places = rays.origins
        if heaviest:
            weight = whole.front * sums[:, 7]
            top = torch.zeros_like(near).scatter_reduce(0, ray, weight, "amax")
            chosen = (weight == top[ray]) & (weight > 0)
            at = far.clone()
            at[ray[chosen]] = sums[chosen, 8]
            places = rays.origins + at[:, None] * rays.directions
            places = places if self.contraction is None else self.contraction.points(places)
        return Seen(seen, opacity, depth, places)

    def image(self, *args: Any, chunk: int | None = None, **given: Any) -> RenderedImage:
        """As that of a renderer; every rank gets the same."""
        return super().image(*args, chunk=PICTURE_CHUNK if chunk is None else chunk, **given)


def _lies_at(distances: Tensor, samples: Samples) -> Tensor:
    """Whether each sample [m] lies where a point was seen, at the distance [r] of its ray or NaN: 0 or 1."""
    at = distances[samples.ray_index]
    return ((samples.depths - at).abs() <= NEARBY * at + samples.deltas).to(samples.depths.dtype)
