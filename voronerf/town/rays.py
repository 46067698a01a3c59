"""The loss of rays that pass through several territories with networks of their own: only partial sums are sent.

Every territory draws rays from its own views, and first evaluates the part of each ray in its own space. If the ray is
not opaque yet, it is sent to the other territories that it meets. Each of these territories returns a partial sum of 24
bytes. The home territory, which drew the ray, merges the sums and sends an answer of 24 bytes to each territory, which
then computes its gradients (Li et al. 2024, NeRF-XL). The results of a territory do not depend on its rank. r rays, m
samples, q runs of samples, T territories.
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
from voronerf.nerf.segment import SegmentResult
from voronerf.nerf.step import StepOutput, TrainingStep
from voronerf.nerf.volume import Batch, RenderOutput, Samples, gradient_factors
from voronerf.ops.formulas import along_rays, compose
from voronerf.ops.forward_with_tape import Tape, forward_with_tape
from voronerf.ops.ray_runs import OwnSamples, compose_runs, own_samples, run_gradients, run_sums
from voronerf.town.group import Group, Key
from voronerf.town.territories import Place

#: The minimum transmittance of a ray that is sent to other territories: one level of an 8-bit image.
FAINT = 1 / 255
#: Number of columns of a sent ray, and of a sum or an answer.
RAY, SUM = 8, 6


@dataclass(frozen=True)
class Territory:
    """A territory of this rank."""

    place: Place
    step: TrainingStep

    @property
    def renderer(self) -> Renderer:
        """The renderer, with networks and sampler."""
        return self.step.loss.renderer


class Evaluated(NamedTuple):
    """The outputs of a territory's networks for its samples, with the autograd tape and the sums of the sample runs."""

    samples: OwnSamples
    tape: Tape
    sums: Tensor
    density: Tensor


class Gradients(NamedTuple):
    """The weights of a territory's samples, and the gradients of its parameters."""

    weights: Tensor
    gradients: list[tuple[torch.nn.Parameter, Tensor]]


class Pass:
    """One territory's part of a step: partial sums of its rays [r], then gradients from the merged result.

    Attributes:
        sums: [q, 6], the partial sum of each run of samples, see `voronerf.ops.run_sums`.
        learnt: A list with the `SegmentResult` of :meth:`learn`, which has set the gradients of the parameters; empty
            before :meth:`learn`, and without samples.

    Args:
        name: The prefix of the segments' names, see `TrainingStep.run_segment`.
        territory: The territory whose networks are evaluated.
        rays: The r rays to evaluate, the territory's own or another's.
        near: [r], the distance at which each ray begins.
        far: [r], the distance at which each ray ends.
    """

    def __init__(self, name: str, territory: Territory, rays: Rays, near: Tensor, far: Tensor) -> None:
        self.name, self.territory, self.rays = name, territory, len(near)
        self.found: SegmentResult | None = None
        self.learnt: list[SegmentResult] = []
        step, place, renderer = territory.step, territory.place, territory.renderer
        if renderer.contraction is None:
            first, last, _ = intersect_box(rays.origins, rays.directions, place.box.to(near.device), 0.0, math.inf)
            near, far = torch.maximum(near, first), torch.minimum(far, last)  # rays that miss the box have no interval
        self.sums = near.new_empty(0, SUM)
        if not len(near):
            return
        inputs = rays.origins, rays.directions, near, far
        drawn = step.run_segment(f"{name}: samples", self._draw, *inputs)
        positions, ray_index, depths, deltas, cells = drawn.now(drawn.value)
        details = ray_index, depths, deltas, cells, place.own.to(near.device)
        curved = renderer.contraction is not None
        own_samples_of_rays: OwnSamples = own_samples(positions, *details, curved=curved, backend=renderer.backend)
        if not len(own_samples_of_rays.depths):
            return
        self.found = step.run_segment(f"{name}: networks", self._look, rays.directions, *own_samples_of_rays)
        self.sums, self.own = self.found.now(self.found.value.sums), own_samples_of_rays

    def _draw(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, ...]:
        step, renderer = self.territory.step, self.territory.renderer
        rays = Rays(origins, directions)
        samples = renderer.sampler.sample(rays, near, far, jitter=True, generator=step.generator).counted()
        cells = self.territory.place.cells(samples.positions, renderer.backend)
        return samples.positions, samples.ray_index, samples.depths, samples.deltas, cells

    def _look(self, directions: Tensor, *tensors: Tensor) -> Evaluated:
        samples, backend, field = OwnSamples(*tensors), self.territory.renderer.backend, self._field()
        tape = forward_with_tape(field.arguments(samples.positions, directions, samples.ray_index), backend=backend)
        return Evaluated(samples, tape, *run_sums(tape.raw, samples, **field.rule, backend=backend))

    def _field(self) -> Radiance:
        renderer = self.territory.renderer
        field = radiance_of(renderer.field)
        if isinstance(field, str) or field.networks.density_scale is None:
            raise ValueError(f"Pass: field must return its values before the activations, got {field}")
        return field

    def end(self) -> Tensor:
        """Returns [r], the depth at which a ray becomes opaque in this territory, or infinity."""
        sums = self.sums
        if not len(sums):
            return sums.new_full((self.rays,), math.inf)
        ray, last = sums[:, -1].long(), self.own.depths[self.own.run_offsets[1:].long() - 1]
        optical = sums.new_zeros(self.rays).index_add_(0, ray, sums[:, 3])
        deepest = sums.new_zeros(self.rays).scatter_reduce_(0, ray, last, "amax")
        return torch.where(optical > -math.log(FAINT), deepest, math.inf)

    def learn(self, answers: Tensor, loss: Tensor, *before: SegmentResult) -> RenderOutput | None:
        """Accumulates gradients of the parameters; returns the output of the step, or None without samples.

        Args:
            answers: [q, 6], the results of `voronerf.ops.compose_runs` for the runs in ``sums``.
            loss: [], the loss of the rays; 0 for rays that another territory has drawn.
            before: The segments whose gradients are already in the parameters.
        """
        if self.found is None:
            return None
        name = f"{self.name}: gradients beside {len(before)}"
        segment = self.territory.step.run_segment(name, self._learn, self.found, answers, loss, *before)
        for parameter, gradient in segment.value.gradients:
            parameter.grad = gradient
        self.learnt = [segment]
        own, weights = self.own, segment.now(segment.value.weights)
        error = weights.new_zeros(self.rays)
        error[self.sums[:, -1].long()] = answers[:, -1]
        samples = Samples(own.positions, own.ray_index, own.run_offsets, own.depths, own.deltas)
        density = self.found.now(self.found.value.density)
        return RenderOutput(loss, error, weights, density, samples, weights.new_empty(0, 3))

    def _learn(self, evaluated: Evaluated, answers: Tensor, loss: Tensor, *before: Gradients) -> Gradients:
        renderer, optimizer = self.territory.renderer, self.territory.step.optimizer
        rule: dict[str, Any] = {**self._field().rule, "hidden": HIDDEN, "backend": renderer.backend}
        gradient, weights = run_gradients(evaluated.tape.raw, evaluated.samples, answers, **rule)
        if (full := renderer.sampler.space.full_gradient) is not None:
            gradient.mul_(gradient_factors(evaluated.samples.depths, full)[:, None])
        evaluated.tape.backward(loss, gradient)
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        return Gradients(weights, [(tensor, tensor.grad) for tensor in parameters if tensor.grad is not None])


class Crossing(StepOutput):
    """The result of a territory's step with rays that also pass through other territories."""

    def __init__(self, batch: Batch, output: RenderOutput, sums: Tensor) -> None:
        super().__init__(batch, output)
        self._sums = sums

    def whole(self) -> StepOutput:
        """Returns the output of the territory's own rays along their whole lengths, in all territories.

        All samples of a ray are merged into one.
        """
        batch, sums = self.batch, self._sums[along_rays(self._sums[:, 5].long(), self._sums[:, 4])]
        composed = compose(sums[:, :3], sums[:, 3], sums[:, 5].long(), len(batch.rays))
        behind = torch.zeros_like(batch.target) if batch.background is None else batch.background
        index = torch.arange(len(batch.rays), device=sums.device)
        samples = self.output.samples._replace(ray_index=index)
        colour = composed.colour + composed.through[:, None] * behind
        return StepOutput(batch, self.output._replace(weights=1 - composed.through, samples=samples, colour=colour))


def meet(bounds: Tensor, rays: Rays, near: Tensor, far: Tensor) -> Tensor:
    """Intersects rays [r] with boxes [T, 2, 3] between near and far; a box with swapped corners is empty.

    Returns:
        bool [T, r], whether each ray meets each box.
    """
    inverse = 1 / torch.where(rays.directions == 0, 1e-12, rays.directions)
    low, high = ((bounds[:, None, end] - rays.origins) * inverse for end in (0, 1))
    first, last = torch.minimum(low, high).amax(-1), torch.maximum(low, high).amin(-1)
    not_empty = (bounds[:, 0] <= bounds[:, 1]).all(1)
    return (torch.maximum(first, near) < torch.minimum(last, far)) & not_empty[:, None]


def step_together(
    group: Group,
    territories: Mapping[int, Territory],
    owner: Sequence[int],
    bounds: Tensor,
    rays: Mapping[int, int],
    at: Mapping[int, int],
) -> dict[int, Crossing]:
    """Runs a step of all territories; all ranks call it together.

    Args:
        group: The ranks.
        territories: The territories of this rank, by number.
        owner: The rank of each territory, [T].
        bounds: [T, 2, 3], a box around the occupied space of each territory.
        rays: The number of rays that each of ``territories`` draws.
        at: The number of steps that each of ``territories`` has done since its coarse stage began.

    Returns:
        The result of each of ``territories`` on its own rays and on other territories' rays; the loss counts its own
        rays only.
    """
    count, bounds = len(owner), bounds.to(group.device)
    batches, homes = dict[int, Batch](), dict[int, Pass]()
    sent_rays: dict[Key, Tensor] = {}  # numbers of the rays that are sent from one territory to another
    sizes = torch.zeros(count, count, dtype=torch.int64)
    for number, territory in territories.items():
        territory.step.begin(at[number])
        batch = batches[number] = territory.step.draw(rays[number])
        home = homes[number] = Pass("own rays", territory, batch.rays, batch.near, batch.far)
        hits = meet(bounds, batch.rays, batch.near, torch.minimum(batch.far, home.end()))
        for other in range(count):
            if other != number:
                sent_rays[number, other] = hits[other].nonzero()[:, 0]
                sizes[number, other] = len(sent_rays[number, other])
    sizes = group.total(sizes)
    parts = {key: _table(batches[key[0]], rows) for key, rows in sent_rays.items()}
    received = group.send(parts, sizes, owner, RAY)
    guests: dict[int, Pass] = {}
    sums: dict[Key, Tensor] = {}
    sum_counts = torch.zeros_like(sizes)
    for number in territories:
        keys = [key for key in received if key[1] == number]
        if keys:
            table = torch.cat([received[key] for key in keys])
            inputs = Rays(table[:, :3].contiguous(), table[:, 3:6].contiguous()), *table[:, 6:].T.contiguous()
            guest = guests[number] = Pass("others' rays", territories[number], *inputs)
            for key, part in zip(keys, _split_sums(guest, [int(sizes[key]) for key in keys]), strict=True):
                sums[key], sum_counts[key] = part, len(part)
    sum_counts = group.total(sum_counts)
    received = group.send(sums, sum_counts, owner, SUM, back=True)
    answers: dict[Key, Tensor] = {}
    outputs: dict[int, RenderOutput] = {}
    merged_sums: dict[int, Tensor] = {}
    for number, home in homes.items():
        keys, batch = [key for key in received if key[0] == number], batches[number]
        rows = [home.sums[:, -1].long(), *(sent_rays[key][received[key][:, -1].long()] for key in keys)]
        all_sums = torch.cat([home.sums, *(received[key] for key in keys)])
        all_sums[:, -1] = torch.cat(rows).to(all_sums.dtype)
        merged_sums[number] = all_sums
        merged, loss = compose_runs(
            all_sums,
            batch.target,
            background=batch.background,
            first=0,
            rays=len(batch.target),
            robust=territories[number].step.loss.robust,
            backend=territories[number].renderer.backend,
        )
        own_answers, *guest_answers = merged.split([len(each) for each in rows])
        answers |= zip(keys, guest_answers, strict=True)
        outputs[number] = home.learn(own_answers, loss) or _empty_output(loss)
    received = group.send(answers, sum_counts, owner, SUM)
    results = dict[int, Crossing]()
    for number, output in outputs.items():
        learnt = homes[number].learnt
        if number in guests and len(guests[number].sums):
            own_answers = torch.cat([received[key] for key in received if key[1] == number])
            guest_output = guests[number].learn(own_answers, own_answers.new_zeros(()), *learnt)
            output, learnt = (
                output if guest_output is None else _joined(output, guest_output),
                learnt + guests[number].learnt,
            )
        territories[number].step.end(at[number] + 1, output, *learnt)
        results[number] = Crossing(batches[number], output, merged_sums[number])
    return results


def _table(batch: Batch, rows: Tensor) -> Tensor:
    """Packs some rays of a batch into rows, [n, 8]: origin, direction, near, far."""
    rays = batch.rays[rows]
    return torch.cat((rays.origins, rays.directions, batch.near[rows, None], batch.far[rows, None]), 1)


def _split_sums(guest: Pass, sizes: Sequence[int]) -> list[Tensor]:
    """Splits the sums by the senders of the rays; rays are renumbered within each sender's part."""
    number = guest.sums[:, -1].long()
    ends = torch.tensor([0, *sizes], device=number.device).cumsum(0)
    counts = torch.searchsorted(number, ends).diff()
    sums = guest.sums.clone()
    sums[:, -1] = (number - torch.repeat_interleave(ends[:-1], counts)).to(sums.dtype)
    return list(sums.split(counts.tolist()))


def _empty_output(loss: Tensor) -> RenderOutput:
    """Returns the output of rays without samples."""
    none, index = loss.new_empty(0), torch.empty(0, dtype=torch.int32, device=loss.device)
    samples = Samples(loss.new_empty(0, 3), index, index.new_zeros(1), none, none)
    return RenderOutput(loss, none, none, none, samples, loss.new_empty(0, 3))


def _joined(one: RenderOutput, two: RenderOutput) -> RenderOutput:
    """Concatenates the outputs of a territory on its own rays and on other territories' rays."""
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
