"""The loss of rays that pass through several territories, each with networks of its own: only partial sums travel.

Every territory draws rays from its own views, and evaluates its own part of them first. A ray that has not ended by
then goes to the other territories that it meets. Each answers with a partial sum, 24 bytes; the territory that drew the
ray puts it together, and answers with what the gradients of the sum follow from, 24 bytes (Li et al. 2024, NeRF-XL).
What a territory computes does not depend on which rank has it. r rays, m samples, q runs, T territories.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.occupancy import HIDDEN
from voronerf.nerf.radiance import Radiance, radiance_of
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.segment import Made
from voronerf.nerf.step import StepOutput, TrainingStep
from voronerf.nerf.volume import Batch, RenderOutput, Samples, shares_of
from voronerf.ops.formulas import along_rays, compose
from voronerf.ops.forward_with_tape import Tape, forward_with_tape
from voronerf.ops.ray_runs import OwnSamples, compose_runs, own_samples, run_gradients, run_sums
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
    step: TrainingStep

    @property
    def renderer(self) -> Renderer:
        """Networks and sampler."""
        return self.step.loss.renderer


class Looked(NamedTuple):
    """What the networks of a territory put out for its samples of rays."""

    samples: OwnSamples
    tape: Tape
    sums: Tensor
    density: Tensor


class Learnt(NamedTuple):
    """What a territory has learnt of the answers to its sums."""

    weights: Tensor
    gradients: list[tuple[torch.nn.Parameter, Tensor]]


class Pass:
    """Rays [r] in one territory: its sums of them, and from the answers to these its gradients.

    Attributes:
        sums: [q, 6] of its runs.
        learnt: The segment that has left gradients at the parameters, if it had samples.

    Args:
        name: Of its segments of the step.
        territory: Whose networks are asked.
        rays: r rays.
        near: [r].
        far: [r].
    """

    def __init__(self, name: str, territory: Territory, rays: Rays, near: Tensor, far: Tensor) -> None:
        self.name, self.territory, self.rays = name, territory, len(near)
        self.found: Made | None = None
        self.learnt: list[Made] = []
        step, place, renderer = territory.step, territory.place, territory.renderer
        if renderer.contraction is None:
            first, last, _ = intersect_box(rays.origins, rays.directions, place.box.to(near.device), 0.0, math.inf)
            near, far = torch.maximum(near, first), torch.minimum(far, last)  # without samples where the box is missed
        self.sums = near.new_empty(0, SUM)
        if not len(near):
            return
        given = rays.origins, rays.directions, near, far
        drawn = step.do(f"{name}: samples", self._draw, *given)
        positions, ray_index, depths, deltas, cells = drawn.now(drawn.value)
        along = ray_index, depths, deltas, cells, place.own.to(near.device)
        bent = renderer.contraction is not None
        own: OwnSamples = own_samples(positions, *along, bent=bent, backend=renderer.backend)
        if not len(own.depths):
            return
        self.found = step.do(f"{name}: networks", self._look, rays.directions, *own)
        self.sums, self.own = self.found.now(self.found.value.sums), own

    def _draw(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, ...]:
        step, renderer = self.territory.step, self.territory.renderer
        rays = Rays(origins, directions)
        known = renderer.sampler.sample(rays, near, far, jitter=True, generator=step.generator).counted()
        cells = self.territory.place.cells(known.positions, renderer.backend)
        return known.positions, known.ray_index, known.depths, known.deltas, cells

    def _look(self, directions: Tensor, *given: Tensor) -> Looked:
        samples, backend, field = OwnSamples(*given), self.territory.renderer.backend, self._field()
        tape = forward_with_tape(field.arguments(samples.positions, directions, samples.ray_index), backend=backend)
        return Looked(samples, tape, *run_sums(tape.raw, samples, **field.rule, backend=backend))

    def _field(self) -> Radiance:
        renderer = self.territory.renderer
        field = radiance_of(renderer.field)
        if isinstance(field, str) or field.networks.density_scale is None:
            raise ValueError(f"Pass: field must put out what comes before its activations, got {field}")
        return field

    def end(self) -> Tensor:
        """[r], the depth at which a ray has ended here, or infinity."""
        sums = self.sums
        if not len(sums):
            return sums.new_full((self.rays,), math.inf)
        ray, last = sums[:, -1].long(), self.own.depths[self.own.run_offsets[1:].long() - 1]
        optical = sums.new_zeros(self.rays).index_add_(0, ray, sums[:, 3])
        deepest = sums.new_zeros(self.rays).scatter_reduce_(0, ray, last, "amax")
        return torch.where(optical > -math.log(FAINT), deepest, math.inf)

    def learn(self, answers: Tensor, loss: Tensor, *before: Made) -> RenderOutput | None:
        """Adds gradients to those of the parameters; returns what was found, None without samples.

        Args:
            answers: [q, 6], to the sums.
            loss: [], of the rays.
            before: The segments that have left gradients before.
        """
        if self.found is None:
            return None
        name = f"{self.name}: gradients beside {len(before)}"
        made = self.territory.step.do(name, self._learn, self.found, answers, loss, *before)
        for parameter, gradient in made.value.gradients:
            parameter.grad = gradient
        self.learnt = [made]
        own, weights = self.own, made.now(made.value.weights)
        error = weights.new_zeros(self.rays)
        error[self.sums[:, -1].long()] = answers[:, -1]
        samples = Samples(own.positions, own.ray_index, own.run_offsets, own.depths, own.deltas)
        density = self.found.now(self.found.value.density)
        return RenderOutput(loss, error, weights, density, samples, weights.new_empty(0, 3))

    def _learn(self, found: Looked, answers: Tensor, loss: Tensor, *before: Learnt) -> Learnt:
        renderer, optimizer = self.territory.renderer, self.territory.step.optimizer
        rule: dict[str, Any] = {**self._field().rule, "hidden": HIDDEN, "backend": renderer.backend}
        gradient, weights = run_gradients(found.tape.raw, found.samples, answers, **rule)
        if (full := renderer.sampler.space.full_gradient) is not None:
            gradient.mul_(shares_of(found.samples.depths, full)[:, None])
        found.tape.backward(loss, gradient)
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        return Learnt(weights, [(each, each.grad) for each in parameters if each.grad is not None])


class Crossing(StepOutput):
    """What a step of a territory has found, whose rays pass through others, too."""

    def __init__(self, batch: Batch, output: RenderOutput, sums: Tensor) -> None:
        super().__init__(batch, output)
        self._sums = sums

    def whole(self) -> StepOutput:
        """The same rays through all territories, as if each had one sample."""
        batch, sums = self.batch, self._sums[along_rays(self._sums[:, 5].long(), self._sums[:, 4])]
        found = compose(sums[:, :3], sums[:, 3], sums[:, 5].long(), len(batch.rays))
        behind = torch.zeros_like(batch.target) if batch.background is None else batch.background
        index = torch.arange(len(batch.rays), device=sums.device)
        samples = self.output.samples._replace(ray_index=index)
        colour = found.colour + found.through[:, None] * behind
        return StepOutput(batch, self.output._replace(weights=1 - found.through, samples=samples, colour=colour))


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
    rays: Mapping[int, int],
    at: Mapping[int, int],
) -> dict[int, Crossing]:
    """A step of all territories; all ranks call it together.

    Args:
        group: The ranks.
        territories: Of this rank, by their numbers.
        owner: The rank of each territory, [T].
        bounds: [T, 2, 3], around what of each is not empty.
        rays: How many each own territory draws.
        at: Steps that it has done since it began.

    Returns:
        What each own territory has found: on its own rays, and on those of others. A loss is that of its own rays.
    """
    count, bounds = len(owner), bounds.to(group.device)
    batches, homes = dict[int, Batch](), dict[int, Pass]()
    gone: dict[Key, Tensor] = {}  # the rays that go from one territory to another
    sizes = torch.zeros(count, count, dtype=torch.int64)
    for number, territory in territories.items():
        territory.step.begin(at[number])
        batch = batches[number] = territory.step.draw(rays[number])
        home = homes[number] = Pass("own rays", territory, batch.rays, batch.near, batch.far)
        met = meet(bounds, batch.rays, batch.near, torch.minimum(batch.far, home.end()))
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
            given = Rays(table[:, :3].contiguous(), table[:, 3:6].contiguous()), *table[:, 6:].T.contiguous()
            guest = guests[number] = Pass("others' rays", territories[number], *given)
            for key, part in zip(keys, _parted(guest, [int(sizes[key]) for key in keys]), strict=True):
                sums[key], found[key] = part, len(part)
    found = group.total(found)
    came = group.send(sums, found, owner, SUM, back=True)
    answers: dict[Key, Tensor] = {}
    outputs: dict[int, RenderOutput] = {}
    whole: dict[int, Tensor] = {}
    for number, home in homes.items():
        keys, batch = [key for key in came if key[0] == number], batches[number]
        rows = [home.sums[:, -1].long(), *(gone[key][came[key][:, -1].long()] for key in keys)]
        every = torch.cat([home.sums, *(came[key] for key in keys)])
        every[:, -1] = torch.cat(rows).to(every.dtype)
        whole[number] = every
        told, loss = compose_runs(
            every,
            batch.target,
            background=batch.background,
            first=0,
            rays=len(batch.target),
            robust=territories[number].step.loss.robust,
            backend=territories[number].renderer.backend,
        )
        own, *rest = told.split([len(each) for each in rows])
        answers |= zip(keys, rest, strict=True)
        outputs[number] = home.learn(own, loss) or _nothing(loss)
    came = group.send(answers, found, owner, SUM)
    made = dict[int, Crossing]()
    for number, output in outputs.items():
        learnt = homes[number].learnt
        if number in guests and len(guests[number].sums):
            own = torch.cat([came[key] for key in came if key[1] == number])
            also = guests[number].learn(own, own.new_zeros(()), *learnt)
            output, learnt = output if also is None else _both(output, also), learnt + guests[number].learnt
        territories[number].step.end(at[number] + 1, output, *learnt)
        made[number] = Crossing(batches[number], output, whole[number])
    return made


def _table(batch: Batch, rows: Tensor) -> Tensor:
    """Some rays as rows of numbers, [n, 8]."""
    rays = batch.rays[rows]
    return torch.cat((rays.origins, rays.directions, batch.near[rows, None], batch.far[rows, None]), 1)


def _parted(guest: Pass, sizes: Sequence[int]) -> list[Tensor]:
    """The sums of rays that came in parts of these sizes, rays numbered in each."""
    number = guest.sums[:, -1].long()
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
