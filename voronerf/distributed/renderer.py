"""Renders and learns rays that pass through the cells of several ranks. Only partial sums of rays travel.

Before the first split all ranks have the same network, and each evaluates its slice of the rays. Afterwards each
evaluates its own cells on all rays. Each rank puts a slice of the rays together: it gets a partial sum of each run from
those that evaluated it, 24 bytes, and answers with its gradients (Li et al. 2024, NeRF-XL).

r rays, m own samples, q runs.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.distributed.group import Group
from voronerf.distributed.sharing import Sharing, voxels_of_ranks
from voronerf.distributed.sums import Samples, along_rays, compose, own_samples, sum_runs
from voronerf.rendering.cameras import Rays
from voronerf.rendering.marching import Seen, draw_seed
from voronerf.rendering.occupancy import HIDDEN, OccupancyGrid, density_of
from voronerf.rendering.renderer import RenderedImage, Renderer
from voronerf.rendering.sampling import NEARBY, stratified_depths
from voronerf.rendering.volume import weaken_near

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
        sharing: Which of them owns which cells; None while all have the same network.
    """

    group: Group
    sharing: Sharing | None = None
    _reached: Tensor  # bool [v], the voxels of the grid that own cells reach
    _several: Tensor  # bool [v], those that cells of two or more ranks reach

    def join(self, group: Group) -> None:
        """Renders with the ranks of a group."""
        self.group = group

    def own_cells(self, sharing: Sharing) -> None:
        """Renders only the cells of this rank from now on; the grid forgets what they do not reach."""
        self.sharing = sharing
        if self.occupancy is not None:
            reached = voxels_of_ranks(sharing, self.occupancy, self.group.size)
            self._reached, self._several = reached[self.group.rank], reached.sum(0) > 1
            self.forget_others(self.occupancy)

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
            march = grid.march(
                rays[kept],
                near[kept],
                far[kept],
                strata,
                seed=seed,
                spacing=self.spacing,
                backend=self.backend,
            )
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
        bounds = self._slices(len(rays))
        cuts = torch.searchsorted(runs.ray, torch.tensor(bounds, device=near.device)).tolist()
        sizes = [end - begin for begin, end in itertools.pairwise(cuts)]
        parts = self.group.exchange("sums", sums.split(sizes))
        own = slice(*bounds[self.group.rank :][:2])
        shown = None if background is None else background.expand_as(target)[own]
        given = torch.cat(parts), own.start, target[own], shown, None if points is None else points[own]
        answers, loss = self._answer(*given, rays=len(rays), seen=0 if seen is None else len(seen))
        answers = torch.cat(self.group.swap("sums", answers.split(list(map(len, parts))), sizes))
        run = torch.repeat_interleave(samples.run_offsets.diff())
        weights = runs.weights * answers[run, c + 1]
        if self.occupancy is not None:
            hidden = weights <= HIDDEN * -torch.expm1(-density.detach() * samples.deltas)
            colour.register_hook(lambda gradient: gradient.masked_fill(hidden[:, None], 0))
            density.register_hook(lambda gradient: gradient.masked_fill(hidden, 0))
        torch.autograd.backward((runs.colour, runs.optical), (answers[:, :c], answers[:, c]))
        importance = weights * answers[run, c + 2]
        return Learnt(loss, samples.positions, density.detach(), samples.deltas, weights, importance)

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
            For each run [q, c + 3] the gradients of its colours and its optical depth, the light that arrives at it,
            and the error of its ray; and the part [] that these rays have in the loss.
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
        answers[order, : c + 1] = whole.gradients(part, ray, slopes, behind)
        answers[order, c + 1], answers[order, c + 2] = whole.front, error[ray]
        return answers, loss

    # --- the grid --------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def observations(self, grid: OccupancyGrid, found: Learnt) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """What samples say of the voxels that they are in.

        Returns:
            Positions [m, 3] and densities [m] of own samples, and of those in voxels that other ranks reach too voxel
            and density, [c, 2], which these should know.
        """
        density = found.density.float().nan_to_num(nan=float("inf"), posinf=float("inf"))
        visible = found.weights > HIDDEN * -torch.expm1(-density * found.deltas)
        density = torch.where(visible, density, 0)
        positions, cells = found.positions, grid.cells(found.positions)
        if grid.contraction is not None:  # the grid will stretch them as at the middle of their voxel
            middle = grid.contraction.stretch(grid.points(cells.long()))
            density = density * grid.contraction.stretch(positions) / middle
            positions = grid.points(cells.long())
        told = torch.stack((cells.view(torch.float32), density), 1)
        return (positions, density), told if self.sharing is None else told[self._several[cells]]

    def observe(
        self, grid: OccupancyGrid, own: tuple[Tensor, Tensor], others: Tensor, *, decay: float, backend: str
    ) -> None:
        """Teaches the grid what all ranks found in the voxels that own cells reach.

        Args:
            grid: Of this rank.
            own: The first part of this rank's :meth:`observations`.
            others: [c, 2], the second of all other ranks.
            decay: As of a grid.
            backend: As of a grid.
        """
        cells = others[:, 0].contiguous().view(torch.int32)
        if self.sharing is not None:
            ours = self._reached[cells]
            cells, others = cells[ours], others[ours]
        positions = torch.cat((own[0], grid.points(cells.long())))
        density = torch.cat((own[1], others[:, 1]))
        ones = torch.ones_like(density)  # what counts has been decided
        grid.observe(positions, density, ones, ones, decay=decay, backend=backend)

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
        if self.sharing is not None:
            grid.density.view(-1)[~self._reached] = 0
            grid.occupied.view(-1)[~self._reached] = False

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
