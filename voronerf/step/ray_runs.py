"""The loss of rays that pass through the cells of several ranks. Only partial sums of rays travel.

Each rank puts a slice of the rays together: it gets a partial sum of each run from those that evaluated it, 24 bytes,
and answers with what its gradients follow from (Li et al. 2024, NeRF-XL). r rays, m own samples, q runs, c colours.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor

from voronerf.distributed.sharing import Sharing
from voronerf.ops.composite import composite
from voronerf.ops.learn_outputs import learn_outputs
from voronerf.ops.learn_outputs.reference import with_gradients
from voronerf.ops.ray_runs import compose_runs, own_samples, run_gradients, run_sums
from voronerf.ops.ray_runs.reference import OwnSamples, along_rays, answer, compose, sum_runs
from voronerf.rendering.occupancy import HIDDEN
from voronerf.rendering.renderer import Renderer
from voronerf.rendering.samplers import Occupancy
from voronerf.rendering.sampling import colour_loss, seen_there, sighting_loss
from voronerf.rendering.volume import Samples, ask, gradient_shares
from voronerf.router import VoronoiRouter
from voronerf.router.table import parameters_of_table
from voronerf.step.ray_loss import Batch, Found, Fused, density_scale, why_not_fused

#: Answers to sums [q, c + 3] of runs, and the part [] of the loss, see `compose_runs`.
_Compose = Callable[[Tensor], tuple[Tensor, Tensor]]


class OverRanks:
    """The loss of a batch that all ranks have, each with the samples in its own cells.

    Gradients of parameters that several ranks have are sums over the samples of this one.

    Args:
        renderer: Of a single pass over points.
        sharing: Which cells are own ones.
        sightings: Factor of the `sighting_loss`; 0 is off.
    """

    def __init__(self, renderer: Renderer, sharing: Sharing, sightings: float) -> None:
        self.renderer, self.sharing, self.sightings = renderer, sharing, sightings

    def __call__(self, batch: Batch, generator: torch.Generator | None, *, backward: bool = False) -> Found:
        """As of `RayLoss`; the generator is in the same state on all ranks."""
        found = self._found(batch, generator)
        if backward:
            found.loss.backward()
            found = found._replace(loss=found.loss.detach())
        return found

    def _found(self, batch: Batch, generator: torch.Generator | None) -> Found:
        if batch.background is not None:
            batch = replace(batch, background=batch.background.expand_as(batch.target))
        if why_not_fused(self.renderer) is not None:
            return self._composed(batch, generator)
        if self.sharing.diagram is None:
            return self._whole_rays(batch, generator)
        seen = self.sightings and batch.seen is not None
        return self._composed(batch, generator) if seen else self._fused(batch, generator)

    def explain(self) -> str:
        """As of `RayLoss`."""
        rest = "one operation" if why_not_fused(self.renderer) is None else "separate operations"
        return f"partial sums of rays travel between {self.sharing.group.size} ranks; networks and gradients are {rest}"

    def _whole_rays(self, batch: Batch, generator: torch.Generator | None) -> Found:
        """Where all ranks have the same network no ray is split."""
        kept = self.sharing.slice(len(batch.rays))
        found = Fused(self.renderer, self.sightings)(batch, generator, kept=kept)
        return found._replace(loss=found.loss * (len(found.error) / len(batch.rays)))

    def _fused(self, batch: Batch, generator: torch.Generator | None) -> Found:
        """From what the networks put out."""
        renderer, rays = self.renderer, batch.rays
        field, space, backend = cast(VoronoiRouter, renderer.field), renderer.sampler.space, renderer.backend
        known = renderer.sampler.sample(rays, batch.near, batch.far, jitter=True, generator=generator)
        cells, numbers = self.sharing.owned(known.positions, backend)
        along = known.positions, known.ray_index, known.depths, known.deltas
        own = own_samples(*along, cells, numbers, bent=space.contraction is not None, backend=backend)
        shares, scale = gradient_shares(space.full_gradient, own.depths), density_scale(field)
        slice_ = self.sharing.slice(len(rays))
        behind = None if batch.background is None else batch.background[slice_]
        found: list[Tensor] = []

        def put_together(sums: Tensor) -> tuple[Tensor, Tensor]:
            given: dict[str, Any] = {"first": slice_.start, "rays": len(rays), "backend": backend}
            return compose_runs(sums, batch.target[slice_], background=behind, **given)

        def loss(raw: Tensor) -> tuple[Tensor, Tensor]:
            sums, density = run_sums(raw, own, density_scale=scale, backend=backend)
            answers, total = self._ask_others(sums, len(rays), put_together)
            rule: dict[str, Any] = {"density_scale": scale, "hidden": HIDDEN, "backend": backend}
            gradient, weights = run_gradients(raw, own, answers, **rule)
            found.extend((_errors(own, answers, len(rays)), weights, density))
            return total, gradient if shares is None else gradient * shares[:, None]

        network = {**parameters_of_table(field.field, field.num_cells), "cells": own.cells}
        if field.field.layers.uses_directions:
            network.update(directions=rays.directions, direction_index=own.ray_index)
        total = learn_outputs({"positions": own.positions, **network}, loss, backend=backend)
        errors, weights, density = found
        return Found(total, errors, weights, density, _samples(own))

    def _composed(self, batch: Batch, generator: torch.Generator | None) -> Found:
        """From colours and densities, which torch differentiates."""
        renderer, rays, sampler = self.renderer, batch.rays, self.renderer.sampler
        own = self.sharing.samples(sampler, rays, batch.near, batch.far, jitter=True, generator=generator)
        samples = _samples(own)
        colour, density = ask(renderer.field, rays, samples, sampler.space)
        points = None
        if batch.seen is not None and self.sightings:  # the light from where points were seen is a fourth colour
            points = torch.full_like(batch.near, float("nan"))
            points[len(rays) - len(batch.seen) :] = batch.seen
            there = seen_there(own.depths, own.deltas, points[own.ray_index])
            colour = torch.cat((colour, there[:, None].to(colour)), 1)
        blend = functools.partial(composite, backend=renderer.backend)
        runs, c = sum_runs(own, colour, density, blend), colour.shape[1]
        sums = torch.cat((runs.colour, runs.optical[:, None], runs.start[:, None], runs.ray[:, None]), 1).detach()
        answers, total = self._ask_others(sums, len(rays), lambda sums: self._put_together(sums, batch, points))
        run, front = torch.repeat_interleave(own.run_offsets.diff()), torch.exp(-answers[:, c + 1])
        weights = runs.weights * front[run]
        if isinstance(sampler, Occupancy):
            hidden = weights <= HIDDEN * -torch.expm1(-density.detach() * own.deltas)
            colour.register_hook(lambda gradient: gradient.masked_fill(hidden[:, None], 0))
            density.register_hook(lambda gradient: gradient.masked_fill(hidden, 0))
        total = with_gradients(total, [runs.colour, runs.optical], [front[:, None] * answers[:, :c], -answers[:, c]])
        return Found(total, _errors(own, answers, len(rays)), weights, density.detach(), samples)

    def _ask_others(self, sums: Tensor, rays: int, put_together: _Compose) -> tuple[Tensor, Tensor]:
        """Sends sums [q, c], by ascending rays, to the ranks that put these together; gets answers, and gives some.

        Args:
            sums: Of own runs.
            rays: How many all ranks have.
            put_together: Answers the sums of the rays of this rank.

        Returns:
            Answers to the own sums, and the part [] that the rays of this rank have in the loss.
        """
        bounds = torch.tensor(self.sharing.bounds(rays), dtype=sums.dtype, device=sums.device)
        cuts = torch.searchsorted(sums[:, -1].contiguous(), bounds).tolist()
        sizes = [end - begin for begin, end in itertools.pairwise(cuts)]
        parts = self.sharing.group.exchange("sums", sums.split(sizes))
        answers, loss = put_together(torch.cat(parts))
        return torch.cat(self.sharing.group.swap("sums", answers.split(list(map(len, parts))), sizes)), loss

    @torch.enable_grad()
    def _put_together(self, sums: Tensor, batch: Batch, points: Tensor | None) -> tuple[Tensor, Tensor]:
        """`compose_runs` with the loss of `Composed`, and c colours.

        Args:
            sums: [q, c + 3] of all ranks.
            batch: All rays.
            points: [r], the distance of the point at the end of each ray or NaN, or None.
        """
        c, rays, own = sums.shape[1] - 3, len(batch.rays), self.sharing.slice(len(batch.rays))
        ray, start = sums[:, c + 2].long() - own.start, sums[:, c + 1]
        order = along_rays(ray, start)
        part, optical, ray = sums[order, :c], sums[order, c], ray[order]
        target = batch.target[own]
        whole = compose(part, optical, ray, len(target))
        behind = whole.colour.new_zeros(len(target), c)
        if batch.background is not None:
            behind[:, :3] = batch.background[own]
        colour = (whole.colour + whole.through[:, None] * behind).detach().requires_grad_()
        loss = colour_loss(colour[:, :3], target) * (len(target) / rays) if len(target) else colour.sum()
        if points is not None and batch.seen is not None:
            ends = len(target) - max(own.start, rays - len(batch.seen)) + own.start  # of these rays, the last
            if ends > 0:
                light = colour[len(target) - ends :, 3]
                loss = loss + self.sightings * sighting_loss(light).sum() / len(batch.seen)
        (slopes,) = torch.autograd.grad(loss, colour)
        error = (colour[:, :3].detach() - target).square().sum(-1)
        blocked = whole.behind(part, ray, slopes, behind)
        return answer(order, whole, blocked, slopes[ray], error[ray]), loss.detach()


def _samples(own: OwnSamples) -> Samples:
    """Own samples as those of a sampler; their runs are no whole rays."""
    return Samples(own.positions, own.ray_index, own.run_offsets, own.depths, own.deltas)


def _errors(own: OwnSamples, answers: Tensor, rays: int) -> Tensor:
    """The error [r] of each ray that has an own run."""
    ray = own.ray_index[own.run_offsets[:-1].long()].long()
    return answers.new_zeros(rays).index_copy(0, ray, answers[:, -1])
