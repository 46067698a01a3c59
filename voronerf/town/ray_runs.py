"""The loss of rays that pass through several territories, each with networks of its own: only partial sums travel.

Every territory draws rays from its own views, and evaluates its own part of them first. A ray that has not ended by
then goes to the other territories that it meets. Each answers with a partial sum, 24 bytes; the territory that drew the
ray puts it together, and answers with what the gradients of the sum follow from, 24 bytes (Li et al. 2024, NeRF-XL).
What a territory computes does not depend on which rank has it. r rays, m samples, q runs, c colours, T territories.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.marching import RayColours
from voronerf.nerf.occupancy import HIDDEN
from voronerf.nerf.ray_loss import Batch, RenderOutput, density_scale, why_not_fused
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import Occupancy
from voronerf.nerf.sampling import colour_loss
from voronerf.nerf.volume import Samples, ask, gradient_shares, normalised
from voronerf.ops.composite import composite
from voronerf.ops.forward_with_tape import forward_with_tape
from voronerf.ops.forward_with_tape.reference import with_gradients
from voronerf.ops.ray_runs import compose_runs, own_samples, run_gradients, run_sums
from voronerf.ops.ray_runs.reference import OwnSamples, along_rays, answer, compose, sum_runs
from voronerf.ops.ray_runs.reference import own_samples as keep_own
from voronerf.ops.sighting_gradient.reference import seen_there, sighting_loss
from voronerf.router import VoronoiRouter
from voronerf.town.distributed.group import Group
from voronerf.town.distributed.mail import Key, Route, expect, send
from voronerf.town.distributed.territories import Place

#: Most territories that the rays of one go to, and the share of its rays that has to meet one, or to get light there.
#: With 1 / 500 a third fewer messages go than to all, but city 4 x 4 loses .05 to .07 dB.
LINKS, LEAST = 32, 1 / 2000
#: Light that is worth a message, one level of an 8-bit image.
FAINT = 1 / 255
#: Steps after which territories tell all others what of them is not empty, and where their rays go; sooner at first.
#: In so many steps before, rays go to all that they meet, not only to those that bring them light.
SURVEY_EVERY, WIDE = 64, 4
#: Boxes in a box of the tree of all bounds.
FAN = 16
#: The most that a territory's share of the rays is above, or below, the mean.
UNEVEN = 4.0


@dataclass(frozen=True)
class Territory:
    """A territory of this rank.

    Attributes:
        place: Where it is.
        renderer: Its networks and its grid.
        generator: Of its samples.
    """

    place: Place
    renderer: Renderer
    generator: torch.Generator


@dataclass
class Map:
    """What all ranks know of all territories, 336 bytes of each; and a tree of the bounds, 26 bytes of each.

    Attributes:
        bounds: float32 [T, 2, 3], around what is not empty.
        links: int64 [T, LINKS], the territories that rays of each meet, and -1; those that bring them light first.
        lit: int64 [T], how many of them bring light.
        shares: float64 [T], of how many rays each draws, 1 in the mean: fewer where it has many of others, so that all
            evaluate as many samples.
    """

    bounds: Tensor
    links: Tensor
    lit: Tensor
    shares: Tensor

    def __post_init__(self) -> None:
        self._levels = [self.bounds]
        while len(self._levels[0]) > FAN:
            parts = self._levels[0].split(FAN)
            box = (torch.stack((part[:, 0].amin(0), part[:, 1].amax(0))) for part in parts)
            self._levels.insert(0, torch.stack(list(box)))

    @staticmethod
    def of(boxes: Tensor, centres: Tensor) -> Map:
        """Of territories of which nothing is known but their boxes [T, 2, 3] and centres [T, 3]."""
        nearest = torch.cdist(centres, centres).argsort(dim=1, stable=True)[:, 1 : LINKS + 1]
        links = torch.full((len(centres), LINKS), -1)
        links[:, : nearest.shape[1]] = nearest
        lit = torch.full((len(boxes),), nearest.shape[1])
        return Map(boxes.clone(), links, lit, torch.ones(len(boxes), dtype=torch.float64))

    def goes_to(self, number: int, wide: bool) -> Tensor:
        """Where rays of a territory go, int64, ascending: all that they meet if they go ``wide``."""
        links = self.links[number] if wide else self.links[number, : int(self.lit[number])]
        return links[links >= 0].sort().values

    def met(self, rays: Rays, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        """Which territories rays [r] may meet between near and far.

        Returns:
            Numbers of rays and of territories, int64 [p] each, sorted by territory, then by ray. The cost grows with p
            and with log T.
        """
        inverse = 1 / torch.where(rays.directions == 0, 1e-12, rays.directions)
        tops, *levels = (boxes.to(near.device) for boxes in self._levels)
        ends = rays.origins[:, None], inverse[:, None], near[:, None], far[:, None]
        ray, node = _meets(tops, *ends).nonzero(as_tuple=True)
        for boxes in levels:
            ray, node = ray.repeat_interleave(FAN), FAN * node[:, None] + torch.arange(FAN, device=node.device)
            node = node.reshape(-1)
            ray, node = ray[node < len(boxes)], node[node < len(boxes)]
            kept = _meets(boxes[node], rays.origins[ray], inverse[ray], near[ray], far[ray])
            ray, node = ray[kept], node[kept]
        order = (node * len(near) + ray).argsort()
        return ray[order], node[order]


def _meets(boxes: Tensor, origins: Tensor, inverse: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """Whether rays, by the inverse of their directions, meet boxes [..., 2, 3] that are not empty."""
    low, high = ((boxes[..., end, :] - origins) * inverse for end in (0, 1))
    first, last = torch.minimum(low, high).amax(-1), torch.maximum(low, high).amin(-1)
    return (torch.maximum(first, near) < torch.minimum(last, far)) & (boxes[..., 0, 0] <= boxes[..., 1, 0])


class JointLoss:
    """The loss of the batches of all territories, of which this rank has some.

    Args:
        group: The ranks.
        territories: Of this rank, by their numbers.
        owner: The rank of each territory, [T].
        known: What is known of all of them.
        sightings: Factor of the `sighting_loss`; 0 is off.
    """

    def __init__(
        self, group: Group, territories: Mapping[int, Territory], owner: Sequence[int], known: Map, sightings: float
    ) -> None:
        self.group, self.territories, self.owner = group, dict(territories), list(owner)
        self.map, self.sightings = known, sightings
        #: What each own territory counts: its rays that met each of all and had not ended, those that got light there,
        #: its rays, those of steps in which they go wide, its samples of them, and its samples of the rays of others.
        self.counts = {number: torch.zeros(2 * len(owner) + 4, dtype=torch.int64) for number in territories}
        self.wide = True
        self._chart()

    def survey(self, step: int) -> None:
        """At some steps, all territories tell what of them is not empty, and where their rays go."""
        self.wide = step < SURVEY_EVERY or step % SURVEY_EVERY >= SURVEY_EVERY - WIDE
        if step % SURVEY_EVERY and (step > SURVEY_EVERY or step & (step - 1)):
            return
        count = len(self.owner)
        record = torch.zeros(count, 10 + LINKS, dtype=torch.float64, device=self.group.device)
        for number, territory in self.territories.items():
            met, lit, (rays, wide, own, others) = self.counts[number].split((count, count, 4))
            links, bright = self.map.links[number], self.map.lit[number]
            if rays:
                order = (lit * rays + met).argsort(descending=True, stable=True)  # the light decides, then who is met
                links = order[met[order] > LEAST * rays][:LINKS]
                bright = (lit[links] > LEAST * wide).sum()
            record[number, :6] = territory.place.bounds(territory.renderer.occupancy).reshape(-1)
            record[number, 6:10] = torch.stack((own, others, bright, links.new_tensor(len(links))))
            record[number, 10 : 10 + len(links)] = links.double()
            self.counts[number].zero_()
        record = self.group.total(record).cpu()
        shares, own, others = self.map.shares, record[:, 6], record[:, 7]
        if bool((own > 0).all()):  # each is to evaluate the mean; most of the way, for what others send changes too
            mean = (own + others).mean()
            shares = (shares * (0.25 + 0.75 * (mean - others) / own)).clamp(1 / UNEVEN, UNEVEN)
            shares = shares / shares.mean()
        bright, many, links = record[:, 8].long(), record[:, 9:10], record[:, 10:].long()
        links[torch.arange(LINKS) >= many] = -1
        self.map = Map(record[:, :6].reshape(-1, 2, 3).float(), links, bright, shares)
        self._chart()

    def run(self, batches: Mapping[int, Batch], *, backward: bool = False) -> dict[int, RenderOutput]:
        """The loss and what was found, for each own territory.

        Args:
            batches: The rays that each own territory draws; not all need to draw some.
            backward: Whether gradients may be added to those of the parameters at once; a loss that has none then.
        """
        given: dict[str, Any] = {"sightings": self.sightings, "backward": backward}
        routes, width = self.routes[self.wide], 6 + (self.sightings > 0)
        back = [route.back() for route in routes]
        expect(self.group, "rays", width + 2, routes)
        expect(self.group, "sums", width, back)
        expect(self.group, "answers", width, routes)
        homes = {n: _Pass(self.territories[n], batch, **given) for n, batch in batches.items()}
        for home in homes.values():
            home.evaluate()
        left = {n: self._leave(n, home, batches[n]) for n, home in homes.items()}
        parts = {key: part for each in left.values() for key, part in each.parts.items()}
        came = send(self.group, "rays", width + 2, parts, routes)
        sizes: dict[int, dict[Key, int]] = {n: {} for n in self.territories}
        for key, table in came.items():
            sizes[key[1]][key] = len(table)
        guests: dict[int, _Pass] = {}
        for number, keys in sizes.items():
            if keys:
                table = torch.cat([came[key] for key in keys])
                seen = table[:, 8] if self.sightings else None
                guests[number] = _Pass(self.territories[number], _batch(table, seen), guest=True, **given)
                guests[number].evaluate()
        sums: dict[Key, Tensor] = {}
        for number, guest in guests.items():
            sums |= guest.parted(sizes[number])
        came = send(self.group, "sums", width, sums, back)
        answers: dict[Key, Tensor] = {}
        for number, home in homes.items():
            answers |= self._compose(number, home, batches[number], left[number], came)
        told = send(self.group, "answers", width, answers, routes)
        for number, guest in guests.items():
            guest.answers = torch.cat([told[key] for key in sizes[number]])
            guest.learn()
        for home in homes.values():
            home.learn()
        for number, counts in self.counts.items():
            counts[-2] += homes[number].samples if number in homes else 0
            counts[-1] += guests[number].samples if number in guests else 0
        return {n: _together(homes.get(n), guests.get(n)) for n in self.territories if n in homes or n in guests}

    def _chart(self) -> None:
        """The routes from each territory to those that its rays go to, where one of the two is here."""
        links, count = self.map.links, len(self.owner)
        here = torch.tensor(self.owner) == self.group.rank
        first = torch.arange(LINKS) < self.map.lit[:, None]
        #: Without those that bring no light, and with them.
        self.routes: list[list[Route]] = []
        for chosen in (first & (links >= 0), links >= 0):
            number, place = (chosen & (here[:, None] | here[links.clamp(min=0)])).nonzero(as_tuple=True)
            pairs = (number * count + links[number, place]).sort().values.tolist()
            keys = [divmod(pair, count) for pair in pairs]
            self.routes.append([Route(self.owner[n], self.owner[other], (n, other)) for n, other in keys])
        #: Where rays of each own territory go, numbers and marks, without those that bring no light and with them.
        self.ways: dict[int, list[tuple[Tensor, Tensor]]] = {}
        for own in self.territories:
            ways = [self.map.goes_to(own, wide) for wide in (False, True)]
            marks = [torch.zeros(count, dtype=torch.bool).index_fill_(0, links, True) for links in ways]
            device = self.group.device
            self.ways[own] = [(way.to(device), mark.to(device)) for way, mark in zip(ways, marks, strict=True)]

    def _leave(self, number: int, home: _Pass, batch: Batch) -> _Left:
        """The rays of a territory that go on."""
        count, counts, rays = len(self.owner), self.counts[number], len(batch.rays)
        ray, other = self.map.met(batch.rays, batch.near, torch.minimum(batch.far, home.end))
        away = other != number
        ray, other = ray[away], other[away]
        counts[:count] += torch.bincount(other, minlength=count).cpu()
        counts[2 * count : 2 * count + 2] += torch.tensor((rays, rays * self.wide))
        (links, sent), (_, linked) = self.ways[number][self.wide], self.ways[number][True]
        learnt, unknown = None, ray[~linked[other]]
        goes = sent[other]
        if len(unknown):  # what lies where rays never go is not known
            learnt = torch.ones(rays, dtype=torch.bool, device=ray.device)
            learnt[unknown] = False
            goes &= learnt[ray]
        ray, other = ray[goes], other[goes]
        sizes = torch.bincount(other, minlength=count)[links].tolist()
        parts = self._table(batch, ray).split(sizes)
        return _Left(links, ray, learnt, {(number, n): part for n, part in zip(links.tolist(), parts, strict=True)})

    def _table(self, batch: Batch, ray: Tensor) -> Tensor:
        """Some rays as rows of numbers."""
        rays = batch.rays[ray]
        columns = [rays.origins, rays.directions, batch.near[ray, None], batch.far[ray, None]]
        if self.sightings:
            columns.append(_points(batch)[ray, None])
        return torch.cat(columns, 1)

    def _compose(
        self, number: int, home: _Pass, batch: Batch, left: _Left, came: Mapping[Key, Tensor]
    ) -> dict[Key, Tensor]:
        """Puts the rays of a territory together; returns the answers to the others."""
        parts = [home.sums, *(came[key] for key in left.parts)]
        counts = [len(part) for part in parts]
        first = torch.tensor([0, len(home.ids), *(len(part) for part in left.parts.values())]).cumsum(0)
        each = torch.tensor(counts)
        starts = torch.repeat_interleave(first[:-1], each).to(home.near.device)
        every, numbers = torch.cat(parts), torch.cat((home.ids, left.rows))
        ray = numbers[starts + every[:, -1].long()]
        every[:, -1] = ray.to(every.dtype)
        known = None if left.learnt is None else left.learnt[ray]
        sums = every if known is None else every[known]
        target, background = batch.target, batch.background
        if every.shape[1] == 6:
            given: dict[str, Any] = {"background": background, "first": 0, "rays": len(target)}
            answers, loss = compose_runs(sums, target, **given, backend=home.renderer.backend)
        else:
            answers, loss = _put_together(sums, batch, self.sightings)
        if known is not None:
            told = answers.new_zeros(every.shape)
            told[known] = answers
            answers = told
        if self.wide:
            others, count = slice(counts[0], None), len(self.owner)
            light = torch.exp(-answers[others, -2]) * -torch.expm1(-every[others, -3])
            source = torch.repeat_interleave(left.links.cpu(), each[1:])[(light > FAINT).cpu()]
            self.counts[number][count : 2 * count] += torch.bincount(source, minlength=count)
        home.loss = loss
        home.answers, *rest = answers.split(counts)
        return dict(zip(left.parts, rest, strict=True))


class _Left(NamedTuple):
    """Rays of a batch [r] that go on to other territories.

    Attributes:
        links: int64, the territories, ascending.
        rows: int64 [n], the rays, territory after territory.
        learnt: bool [r], the rays that go to all that they meet; None for all rays.
        parts: For each territory what is said of its rays.
    """

    links: Tensor
    rows: Tensor
    learnt: Tensor | None
    parts: dict[Key, Tensor]


class _Pass:
    """Rays [r] in one territory: its sums of them, and from the answers to these its gradients.

    Attributes:
        ids: int64, the numbers of the rays that meet the territory's box.
        sums: [q, c + 3] of its runs; the last column is a number in ``ids``.
        answers: [q, c + 3], to be set before the gradients.
        loss: [], to be set where the rays are put together here.
        guest: Whether the rays are those of others.
        end: [r], the depth at which a ray has ended, or infinity; not known of those of others.
        found: What was found, for these rays.
    """

    def __init__(
        self,
        territory: Territory,
        batch: Batch,
        *,
        guest: bool = False,
        sightings: float = 0.0,
        backward: bool = False,
    ) -> None:
        self.territory, self.renderer, self.guest, self.backward = territory, territory.renderer, guest, backward
        self.rays, self.near, self.far = batch.rays, batch.near, batch.far
        self.points = _points(batch) if sightings else None
        self.ids = torch.arange(len(self.near), device=self.near.device)
        self.end = self.near if guest else torch.full_like(self.near, math.inf)
        if self.renderer.contraction is None:
            box = territory.place.box.to(self.near.device)
            first, last, _ = intersect_box(self.rays.origins, self.rays.directions, box, 0.0, math.inf)
            self.near, self.far = torch.maximum(self.near, first), torch.minimum(self.far, last)
            hit = self.far > self.near
            if not bool(hit.all()):
                self.ids = hit.nonzero()[:, 0]
                self.rays, self.near, self.far = self.rays[self.ids], self.near[self.ids], self.far[self.ids]
                self.points = None if self.points is None else self.points[self.ids]
        self.width = 6 + int(sightings > 0)
        self.sums = self.near.new_empty(0, self.width)
        self.answers, self.loss = self.sums, self.near.new_zeros(())
        self.total: Tensor | None = None
        self.found: RenderOutput | None = None
        self._going: Iterator[None] = iter(())

    @torch.enable_grad()
    def evaluate(self) -> None:
        """Makes the sums."""
        if not len(self.ids):
            return
        renderer, place = self.renderer, self.territory.place
        given: dict[str, Any] = {"jitter": True, "generator": self.territory.generator}
        known = renderer.sampler.sample(self.rays, self.near, self.far, **given)
        cells = place.cells(known.positions, renderer.backend)
        along = known.ray_index, known.depths, known.deltas, cells, place.own.to(cells.device)
        bent = renderer.contraction is not None
        if why_not_fused(renderer) is None and self.points is None:
            self._going = self._fused(own_samples(known.positions, *along, bent=bent, backend=renderer.backend))
        else:
            self._going = self._composed(keep_own(known.positions, *along, bent=bent))
        next(self._going, None)

    @torch.enable_grad()
    def learn(self) -> None:
        """Learns from the answers."""
        next(self._going, None)

    def _fused(self, own: OwnSamples) -> Iterator[None]:
        """From what the networks put out; pauses for the answers to the sums."""
        renderer, backend = self.renderer, self.renderer.backend
        if not len(own.depths):
            return
        field = cast(VoronoiRouter, renderer.field)
        shares, scale = gradient_shares(renderer.sampler.space.full_gradient, own.depths), density_scale(field)
        network = field.table_arguments(own.positions, self.rays.directions, own.ray_index)
        assert network is not None
        outputs = forward_with_tape(network, backend=backend)
        sums, density = run_sums(outputs.raw, own, density_scale=scale, backend=backend)
        self._told(sums, own)
        yield
        rule: dict[str, Any] = {"density_scale": scale, "hidden": HIDDEN, "backend": backend}
        gradient, weights = run_gradients(outputs.raw, own, self.answers, **rule)
        self._finds(own, weights, density)
        gradient = gradient if shares is None else gradient * shares[:, None]
        self.total = outputs.learn(self.loss, gradient, backward=self.backward)

    def _composed(self, own: OwnSamples) -> Iterator[None]:
        """From colours and densities, which torch differentiates; pauses for the answers to the sums."""
        renderer = self.renderer
        if not len(own.depths):
            return
        colour, density = ask(renderer.field, self.rays, _samples(own), renderer.sampler.space)
        if self.points is not None:  # the light from where points were seen is a fourth colour
            there = seen_there(own.depths, own.deltas, self.points[own.ray_index])
            colour = torch.cat((colour, there[:, None].to(colour)), 1)
        blend = functools.partial(composite, backend=renderer.backend)
        runs, c = sum_runs(own, colour, density, blend), colour.shape[1]
        columns = runs.colour, runs.optical[:, None], runs.start[:, None], runs.ray[:, None]
        self._told(torch.cat(columns, 1).detach().to(self.near.dtype), own)
        yield
        answers = self.answers
        run, front = torch.repeat_interleave(own.run_offsets.diff()), torch.exp(-answers[:, c + 1])
        weights = runs.weights * front[run]
        if isinstance(renderer.sampler, Occupancy):
            hidden = weights <= HIDDEN * -torch.expm1(-density.detach() * own.deltas)
            colour.register_hook(lambda gradient: gradient.masked_fill(hidden[:, None], 0))
            density.register_hook(lambda gradient: gradient.masked_fill(hidden, 0))
        slopes = [front[:, None] * answers[:, :c], -answers[:, c]]
        self.total = with_gradients(self.loss, [runs.colour, runs.optical], slopes)
        self._finds(own, weights, density.detach())

    def _told(self, sums: Tensor, own: OwnSamples) -> None:
        """Keeps the sums, and finds the rays that end here, if they are own ones."""
        self.sums = sums
        if self.guest:
            return
        ray = sums[:, -1].long()
        optical = torch.zeros_like(self.near).index_add_(0, ray, sums[:, -3])
        last = torch.zeros_like(self.near)
        last.scatter_reduce_(0, ray, own.depths[own.run_offsets[1:].long() - 1], "amax")
        self.end[self.ids] = torch.where(optical > -math.log(FAINT), last, math.inf)

    def _finds(self, own: OwnSamples, weights: Tensor, density: Tensor) -> None:
        error = weights.new_zeros(len(self.ids))
        ray = own.ray_index[own.run_offsets[:-1].long()].long()
        error.index_copy_(0, ray, self.answers[:, -1].to(error.dtype))
        self.found = RenderOutput(self.loss, error, weights, density, _samples(own))

    @property
    def samples(self) -> int:
        """How many were evaluated."""
        return 0 if self.found is None else len(self.found.weights)

    def parted(self, sizes: Mapping[Key, int]) -> dict[Key, Tensor]:
        """The sums of rays that came in parts of these sizes, by the keys of the parts, rays numbered in each."""
        number = self.ids[self.sums[:, -1].long()]
        ends = torch.tensor([0, *sizes.values()], device=number.device).cumsum(0)
        each = torch.searchsorted(number, ends).diff()
        sums = self.sums.clone()
        sums[:, -1] = (number - torch.repeat_interleave(ends[:-1], each)).to(sums.dtype)
        return dict(zip(sizes, sums.split(each.tolist()), strict=True))


def _together(home: _Pass | None, guest: _Pass | None) -> RenderOutput:
    """What a territory has found on its own rays and on those of others."""
    passes = [each for each in (home, guest) if each is not None]
    found = [each.found for each in passes if each.found is not None]
    totals = [each.total for each in passes if each.total is not None]
    loss = functools.reduce(torch.add, totals) if totals else passes[0].loss
    if home is not None and home.total is None:
        loss = loss + home.loss
    if len(found) == 1:
        return found[0]._replace(loss=loss)
    if not found:
        none = passes[0].near.new_empty(0)
        index = none.to(torch.int32)
        samples = Samples(none.new_empty(0, 3), index, index.new_zeros(1), none, none)
        return RenderOutput(loss, none, none, none, samples)
    first, second = found
    index = torch.cat((first.samples.ray_index, second.samples.ray_index + len(first.error)))
    offsets = torch.cat((first.samples.ray_offsets, second.samples.ray_offsets[1:] + len(first.weights)))
    values = (torch.cat((getattr(first.samples, n), getattr(second.samples, n))) for n in ("depths", "deltas"))
    samples = Samples(torch.cat((first.samples.inputs, second.samples.inputs)), index, offsets, *values)
    rest = {n: torch.cat((getattr(first, n), getattr(second, n))) for n in ("error", "weights", "density")}
    return RenderOutput(loss, **rest, samples=samples)


def _samples(own: OwnSamples) -> Samples:
    """Own samples as those of a sampler; their runs are no whole rays."""
    return Samples(own.positions, own.ray_index, own.run_offsets, own.depths, own.deltas)


def _batch(table: Tensor, seen: Tensor | None = None) -> Batch:
    """Rays of a table [r, 8]; their colours are known elsewhere."""
    rays = Rays(table[:, :3].contiguous(), table[:, 3:6].contiguous())
    return Batch(rays, table[:, 6].contiguous(), table[:, 7].contiguous(), table[:, :0], None, seen)


def _points(batch: Batch) -> Tensor:
    """The distance of the point at the end of each ray, or NaN."""
    points = torch.full_like(batch.near, math.nan)
    if batch.seen is not None:
        points[len(points) - len(batch.seen) :] = batch.seen
    return points


@torch.enable_grad()
def _put_together(sums: Tensor, batch: Batch, sightings: float) -> tuple[Tensor, Tensor]:
    """`compose_runs` with the loss of `Composed`, and four colours.

    Args:
        sums: [q, 7].
        batch: All rays.
        sightings: Factor of the `sighting_loss`.
    """
    c, target, ray, start = sums.shape[1] - 3, batch.target, sums[:, -1].long(), sums[:, -2]
    order = along_rays(ray, start)
    part, optical, ray = sums[order, :c], sums[order, c], ray[order]
    whole = compose(part, optical, ray, len(target))
    behind = whole.colour.new_zeros(len(target), c)
    if batch.background is not None:
        behind[:, :3] = batch.background
    colour = (whole.colour + whole.through[:, None] * behind).detach().requires_grad_()
    loss = colour_loss(colour[:, :3], target)
    if batch.seen is not None and len(batch.seen):
        loss = loss + sightings * sighting_loss(colour[len(target) - len(batch.seen) :, 3]).mean()
    (slopes,) = torch.autograd.grad(loss, colour)
    error = (colour[:, :3].detach() - target).square().sum(-1)
    blocked = whole.behind(part, ray, slopes, behind)
    return answer(order, whole, blocked, slopes[ray], error[ray]), loss.detach()


def see_together(joint: JointLoss, rays: Rays, near: Tensor, far: Tensor, background: Tensor | None) -> RayColours:
    """What rays of a picture see; all ranks call it at the same time, each with rays of its own or none.

    Rays go to all territories that they may meet, and do not end at the first surface.

    Args:
        joint: The territories.
        rays: r rays of this rank.
        near: [r].
        far: [r].
        background: [3] or [r, 3], or None.
    """
    group = joint.group
    ray, other = joint.map.met(rays, near, far)
    table = torch.cat((rays.origins, rays.directions, near[:, None], far[:, None]), 1)
    each = ray.split(torch.bincount(other, minlength=len(joint.owner)).tolist())
    rows = {(group.rank, number): chosen for number, chosen in enumerate(each)}
    routes = [Route(group.rank, owner, (group.rank, number)) for number, owner in enumerate(joint.owner)]
    routes += [Route(r, group.rank, (r, n)) for r in range(group.size) if r != group.rank for n in joint.territories]
    parts = {key: table[chosen] for key, chosen in rows.items()}
    came = send(group, "rays of pictures", 8, parts, routes)
    sums = {key: _pictured(joint.territories[key[1]], part) for key, part in came.items()}
    told = send(group, "sums of pictures", 7, sums, [route.back() for route in routes])
    found = []
    for key, part in told.items():
        part = part.clone()
        part[:, 5] = rows[key][part[:, 5].long()].to(part.dtype)
        found.append(part)
    whole = torch.cat(found)
    whole = whole[along_rays(whole[:, 5].long(), whole[:, 4])]
    ray = whole[:, 5].long()
    made = compose(whole[:, :3], whole[:, 3], ray, len(rays))
    seen, opacity = made.colour, 1 - made.through
    if background is not None:
        seen = seen + made.through[:, None] * background.to(seen)
    depth = torch.zeros_like(near).index_add(0, ray, made.front * whole[:, 6])
    return RayColours(seen, opacity, normalised(depth, opacity, far), rays.origins)


@torch.no_grad()
def _pictured(territory: Territory, table: Tensor) -> Tensor:
    """The partial sums [q, 7] of rays of pictures: colour, optical depth, start, ray and depth."""
    found = _Pass(territory, _batch(table))
    renderer, place, rays = found.renderer, territory.place, found.rays
    if not len(found.ids):
        return table.new_empty(0, 7)
    sampler = renderer.train(False).sampler
    if isinstance(sampler, Occupancy):
        known, _ = sampler.march(rays, found.near, found.far, picture=True)
    else:
        known = sampler.sample(rays, found.near, found.far)
    cells = place.cells(known.positions, renderer.backend)
    along = known.ray_index, known.depths, known.deltas, cells, place.own.to(cells.device)
    own = keep_own(known.positions, *along, bent=renderer.contraction is not None)
    if not len(own.depths):
        return table.new_empty(0, 7)
    colour, density = (v.to(table.dtype) for v in ask(renderer.field, rays, _samples(own), sampler.space))
    runs = sum_runs(own, colour, density, functools.partial(composite, backend=renderer.backend))
    ray = found.ids[runs.ray].to(table.dtype)
    columns = [runs.optical, runs.start, ray, runs.depth]
    return torch.cat((runs.colour, torch.stack(columns, 1)), 1)
