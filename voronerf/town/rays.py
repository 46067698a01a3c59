"""The loss of rays that pass through several territories, each with networks of its own: only partial sums travel.

Every territory draws rays from its own views, and evaluates its own part of them first. A ray that has not ended by
then goes to the other territories that it meets. Each answers with a partial sum, 24 bytes; the territory that drew the
ray puts it together, and answers with what the gradients of the sum follow from, 24 bytes (Li et al. 2024, NeRF-XL).
What a territory computes does not depend on which rank has it. r rays, m samples, q runs, T territories.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.loss import Batch, RenderOutput
from voronerf.nerf.occupancy import HIDDEN
from voronerf.nerf.radiance import radiance_of
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.volume import Samples
from voronerf.ops.forward_with_tape import Tape, forward_with_tape
from voronerf.ops.ray_runs import OwnSamples, compose_runs, own_samples, run_gradients, run_sums
from voronerf.ops.scale_gradient import scale_gradient
from voronerf.town.group import Group, Key
from voronerf.town.territories import Place

#: Light that is worth a message, one level of an 8-bit image.
FAINT = 1 / 255
#: Columns of the rays that go to another territory, and of sums and answers.
RAY, SUM = 8, 6


@dataclass(frozen=True)
class Territory:
    """A territory of this rank."""

    place: Place
    renderer: Renderer
    generator: torch.Generator


class Pass:
    """Rays [r] in one territory: its sums of them, and from the answers to these its gradients.

    Attributes:
        ids: int64, the numbers of the rays that meet the territory's box.
        sums: [q, 6] of its runs; the last column is a number in ``ids``.
        end: [r], the depth at which a ray has ended here, or infinity.

    Args:
        territory: Whose networks are asked.
        rays: r rays.
        near: [r].
        far: [r].
    """

    def __init__(self, territory: Territory, rays: Rays, near: Tensor, far: Tensor) -> None:
        renderer, place = territory.renderer, territory.place
        self.renderer, self.ids = renderer, torch.arange(len(near), device=near.device)
        self.end, bent = torch.full_like(near, math.inf), renderer.contraction is not None
        if not bent:
            first, last, _ = intersect_box(rays.origins, rays.directions, place.box.to(near.device), 0.0, math.inf)
            near, far = torch.maximum(near, first), torch.minimum(far, last)
            self.ids = (far > near).nonzero()[:, 0]
            rays, near, far = rays[self.ids], near[self.ids], far[self.ids]
        self.sums = near.new_empty(0, SUM)
        if not len(near):
            return
        known = renderer.sampler.sample(rays, near, far, jitter=True, generator=territory.generator).counted()
        cells = place.cells(known.positions, renderer.backend)
        along = known.ray_index, known.depths, known.deltas, cells, place.own.to(cells.device)
        self.own: OwnSamples = own_samples(known.positions, *along, bent=bent, backend=renderer.backend)
        if not len(self.own.depths):
            return
        field = radiance_of(renderer.field, backend=renderer.backend)
        if isinstance(field, str) or field.networks.density_scale is None:
            raise ValueError(f"Pass: field must put out what comes before its activations, got {field}")
        self.scale = field.networks.density_scale
        network = field.arguments(self.own.positions, rays.directions, self.own.ray_index, renderer.backend)
        self.tape: Tape = forward_with_tape(network, backend=renderer.backend)
        self.sums, self.density = run_sums(self.tape.raw, self.own, density_scale=self.scale, backend=renderer.backend)
        ray = self.sums[:, -1].long()
        optical = torch.zeros_like(near).index_add_(0, ray, self.sums[:, 3])
        last = torch.zeros_like(near).scatter_reduce_(
            0, ray, self.own.depths[self.own.run_offsets[1:].long() - 1], "amax"
        )
        self.end[self.ids] = torch.where(optical > -math.log(FAINT), last, math.inf)

    def learn(self, answers: Tensor, loss: Tensor) -> RenderOutput | None:
        """Adds gradients to those of the parameters; returns what was found, None without samples.

        Args:
            answers: [q, 6], to the sums.
            loss: [], of the rays.
        """
        if not len(self.sums):
            return None
        rule: dict[str, Any] = {"density_scale": self.scale, "hidden": HIDDEN, "backend": self.renderer.backend}
        gradient, weights = run_gradients(self.tape.raw, self.own, answers, **rule)
        if (full := self.renderer.sampler.space.full_gradient) is not None:
            scale_gradient(gradient, self.own.depths, full, backend=self.renderer.backend)
        error = weights.new_zeros(len(self.ids))
        error[self.sums[:, -1].long()] = answers[:, -1]
        own = self.own
        samples = Samples(own.positions, own.ray_index, own.run_offsets, own.depths, own.deltas)
        loss = self.tape.backward(loss, gradient)
        return RenderOutput(loss, error, weights, self.density, samples, weights.new_empty(0, 3))


def meet(bounds: Tensor, rays: Rays, near: Tensor, far: Tensor) -> Tensor:
    """Which rays [r] meet which boxes [T, 2, 3] between near and far: bool [T, r]; swapped corners are an empty box."""
    inverse = 1 / torch.where(rays.directions == 0, 1e-12, rays.directions)
    low, high = ((bounds[:, None, end] - rays.origins) * inverse for end in (0, 1))
    first, last = torch.minimum(low, high).amax(-1), torch.maximum(low, high).amin(-1)
    there = (bounds[:, 0] <= bounds[:, 1]).all(1)
    return (torch.maximum(first, near) < torch.minimum(last, far)) & there[:, None]


def step_together(
    group: Group,
    territories: Mapping[int, Territory],
    owner: Sequence[int],
    bounds: Tensor,
    batches: Mapping[int, Batch],
) -> dict[int, RenderOutput]:
    """The loss of the batches of all territories, and its gradients; all ranks call it together.

    Args:
        group: The ranks.
        territories: Of this rank, by their numbers.
        owner: The rank of each territory, [T].
        bounds: [T, 2, 3], around what of each is not empty.
        batches: The rays that each own territory draws.

    Returns:
        What was found, for each own territory: on its own rays, and on those of others. A loss is that of its own rays.
    """
    count, bounds = len(owner), bounds.to(group.device)
    homes: dict[int, Pass] = {}
    gone: dict[Key, Tensor] = {}  # the rays that go from one territory to another
    sizes = torch.zeros(count, count, dtype=torch.int64)
    for number, batch in batches.items():
        home = homes[number] = Pass(territories[number], batch.rays, batch.near, batch.far)
        met = meet(bounds, batch.rays, batch.near, torch.minimum(batch.far, home.end))
        for other in range(count):
            if other != number:
                gone[number, other] = met[other].nonzero()[:, 0]
                sizes[number, other] = len(gone[number, other])
    sizes = group.total(sizes)
    parts = {key: _table(batches[key[0]], rows) for key, rows in gone.items()}
    came = group.send(parts, sizes, owner, RAY)
    guests: dict[int, Pass] = {}
    sums: dict[Key, Tensor] = {}
    found = torch.zeros_like(sizes)
    for number in territories:
        keys = [key for key in came if key[1] == number]
        if keys:
            table = torch.cat([came[key] for key in keys])
            rays = Rays(table[:, :3].contiguous(), table[:, 3:6].contiguous())
            guest = guests[number] = Pass(territories[number], rays, *table[:, 6:].T.contiguous())
            for key, part in zip(keys, _parted(guest, [int(sizes[key]) for key in keys]), strict=True):
                sums[key], found[key] = part, len(part)
    found = group.total(found)
    came = group.send(sums, found, owner, SUM, back=True)
    answers: dict[Key, Tensor] = {}
    outputs: dict[int, list[RenderOutput]] = {number: [] for number in territories}
    for number, home in homes.items():
        keys, batch = [key for key in came if key[0] == number], batches[number]
        rows = [home.ids[home.sums[:, -1].long()], *(gone[key][came[key][:, -1].long()] for key in keys)]
        every = torch.cat([home.sums, *(came[key] for key in keys)])
        every[:, -1] = torch.cat(rows).to(every.dtype)
        given: dict[str, Any] = {"background": batch.background, "first": 0, "rays": len(batch.target)}
        told, loss = compose_runs(every, batch.target, **given, backend=home.renderer.backend)
        own, *rest = told.split([len(each) for each in rows])
        answers |= zip(keys, rest, strict=True)
        learnt = home.learn(own, loss)
        outputs[number].append(_nothing(loss) if learnt is None else learnt)
    came = group.send(answers, found, owner, SUM)
    for number, guest in guests.items():
        own = torch.cat([guest.sums[:0], *(came[key] for key in came if key[1] == number)])
        if (learnt := guest.learn(own, own.new_zeros(()))) is not None:
            outputs[number].append(learnt)
    return {number: functools.reduce(_both, each) for number, each in outputs.items() if each}


def _table(batch: Batch, rows: Tensor) -> Tensor:
    """Some rays as rows of numbers, [n, 8]."""
    rays = batch.rays[rows]
    return torch.cat((rays.origins, rays.directions, batch.near[rows, None], batch.far[rows, None]), 1)


def _parted(guest: Pass, sizes: Sequence[int]) -> list[Tensor]:
    """The sums of rays that came in parts of these sizes, rays numbered in each."""
    number = guest.ids[guest.sums[:, -1].long()]
    ends = torch.tensor([0, *sizes], device=number.device).cumsum(0)
    each = torch.searchsorted(number, ends).diff()
    sums = guest.sums.clone()
    sums[:, -1] = (number - torch.repeat_interleave(ends[:-1], each)).to(sums.dtype)
    return list(sums.split(each.tolist()))


def _nothing(loss: Tensor) -> RenderOutput:
    """What is found where no ray has samples."""
    none, index = loss.new_empty(0), torch.empty(0, dtype=torch.int32, device=loss.device)
    samples = Samples(loss.new_empty(0, 3), index, index.new_zeros(1), none, none)
    return RenderOutput(loss, none, none, none, samples, loss.new_empty(0, 3))


def _both(one: RenderOutput, two: RenderOutput) -> RenderOutput:
    """What a territory has found on its own rays and on those of others."""
    a, b = one.samples, two.samples
    samples = Samples(
        torch.cat((a.inputs, b.inputs)),
        torch.cat((a.ray_index, b.ray_index + len(one.error))),
        torch.cat((a.ray_offsets, b.ray_offsets[1:] + len(one.weights))),
        torch.cat((a.depths, b.depths)),
        torch.cat((a.deltas, b.deltas)),
    )
    values = {n: torch.cat((getattr(one, n), getattr(two, n))) for n in ("error", "weights", "density")}
    return RenderOutput(one.loss + two.loss, samples=samples, colour=one.colour, **values)
