"""A run brought up to date with new pictures: cells whose error has grown learn, all others keep their bits.

r rays, k cells.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from voronerf.data import Scene
from voronerf.editing import Source
from voronerf.fields.radiance import activate_radiance
from voronerf.ops.learn_outputs import learn_outputs
from voronerf.ops.render_loss import RenderLoss, render_loss_gradient
from voronerf.rendering.cameras import Rays
from voronerf.rendering.contraction import Contraction
from voronerf.rendering.occupancy import HIDDEN, OccupancyGrid
from voronerf.rendering.sampling import colour_loss
from voronerf.rendering.volume import Samples, render_samples
from voronerf.router import Part, Parts, VoronoiRouter
from voronerf.step.cells import DECAY, REVISIT_EVERY, REVISITED
from voronerf.step.ray_loss import density_scale
from voronerf.training.adam import Adam
from voronerf.training.average import averages_in_place, update_averages
from voronerf.training.batches import RayBatches
from voronerf.training.changes import LEAST_MET, MOST_OFF, Changes, Voxels, find_changes, near_by, space_voxels
from voronerf.training.config import ConfigError
from voronerf.training.errors import usual_errors
from voronerf.training.parts import grouped_parameters
from voronerf.training.rates import learning_rate
from voronerf.training.renderers import as_field, make_contraction, make_renderer

#: Rays of a step, in multiples of ``--rays``.
RAYS = 1
#: Rays that are drawn at a time to find those that meet cells that learn, how many of these there are to be, and the
#: share of an update that is spent on it before the first step at most, and the share that is left for steps at least.
DRAWN, POOL, FINDING, LEARNING = 1 << 15, 1 << 17, 0.3, 0.25
#: How often a ray is learnt from before others are found.
AGAIN = 4
#: Rays learn if this share of the light reaches the cells that learn, and no more than that optical depth of others
#: lies between them.
LEAST_LIGHT, MOST_BETWEEN = 0.05, 0.05


@dataclass(frozen=True)
class Update:
    """What an update did.

    Attributes:
        source: The run that it makes.
        changes: What the new pictures showed.
        steps: Steps of training.
        seconds: Of training, finding the changes included.
    """

    source: Source
    changes: Changes
    steps: int
    seconds: float


def update(
    source: Source,
    new: Scene,
    old: Scene | None,
    usual: Tensor | None,
    *,
    seconds: float,
    seed: int = 0,
    clock: Callable[[], float] = time.perf_counter,
    say: Callable[[str], None] = lambda line: None,
) -> Update:
    """Trains the cells that new pictures show to be out of date.

    Args:
        source: The run, as `join` makes it of one; it is not changed.
        new: The new pictures, in the space of the run (`placed`).
        old: The pictures that the run was trained on; None to learn from the new ones alone.
        usual: [k + 1], the errors of the run, see `usual_errors`; None to find them from the old pictures.
        seconds: To train for, finding the changes included.
        seed: Of the rays that are drawn.
        clock: Counts seconds.
        say: Told a line for what is found.

    Raises:
        ConfigError: For pictures that show nothing new, nothing of the scene, another one, or one in another frame.
    """
    device = source.parts.diagram.centres.device
    Adam([torch.zeros(1, requires_grad=True)], lr=1.0)  # torch imports its compiler with the first; not on the clock
    began = clock()
    contraction = next((part.contraction for part in source.parts if part.contraction is not None), None)
    if contraction is None and source.scene.box is None:
        contraction = cast(Contraction, make_contraction(source.scene))
    box = cast(Tensor, source.scene.box) if contraction is None else contraction.cube
    renderer = make_renderer(source.config, source.scene, {"field": source.parts}, occupancy=source.grid)
    if usual is None:
        if old is None:
            raise ConfigError("the run has no errors to compare with, as its training keeps them; give --old DIR")
        usual = usual_errors(renderer, source.parts, RayBatches(old, device, backend=source.config.backend))
    # Rays are drawn from all pixels here; those that miss the box show the background.
    every = RayBatches(replace(new, box=None), device, backend=source.config.backend)
    every.box = new.box
    changes = find_changes(renderer, source.parts, every, usual, space_voxels(box, contraction))
    if changes.met < LEAST_MET:
        raise ConfigError(f"--data must show the scene of the run, {changes.met:.2%} of its rays meet it")
    if changes.off > MOST_OFF:
        raise ConfigError(
            f"--data shows another scene, or this one in another frame: {changes.off:.0%} of what it shows differs"
        )
    count, k = int(changes.cells.sum()), source.parts.num_cells
    say(f"{changes.off:.1%} of the new rays that meet the scene are off: {count} of {k} cells learn")
    if not count:
        raise ConfigError(
            f"--data shows nothing new: {changes.off:.1%} of the rays that meet the scene are off, as in training"
        )
    parts, learners = split_off(source.parts, changes.cells)
    grid = None if source.grid is None else opened(source.grid, source.parts, changes.cells)
    session = Session(replace(source, parts=parts, grid=grid), learners, changes, seed)
    through, backend = bounds(source, changes), source.config.backend
    given = [scene for scene in (new, old) if scene is not None]
    pictures = [RayBatches(scene, device, through=through, backend=backend) for scene in given]
    count = DRAWN if grid is not None else DRAWN // 4  # of rays that skip nothing
    pools: list[list[Pool]] = []

    def draw() -> Pool:
        """More rays to learn from, with those before; the oldest go."""
        found = [session.pool(batches, count >> number, agree=number > 0) for number, batches in enumerate(pictures)]
        pools.append(found)
        while sum(len(pool) for pair in pools[1:] for pool in pair) >= POOL:
            pools.pop(0)
        return Pool.joined([pool for pair in pools for pool in pair])

    pool = draw()
    while clock() - began < FINDING * seconds and len(pool) < POOL:
        pool = draw()
    rays = [sum(len(pair[number]) for pair in pools) for number in range(len(pictures))]
    say(f"learning from {rays[0]} rays of the new pictures and {sum(rays[1:])} of the old ones")
    if not rays[0]:
        raise ConfigError("--data must show the cells that have changed, got pictures that see them through others")
    steps, drawn, started = 0, 0, clock() - began
    left = max(seconds - started, LEARNING * seconds)
    while (done := (clock() - began - started) / left) < 1:
        if drawn > AGAIN * len(pool):
            pool, drawn = draw(), 0
        drawn += session.step(pool, steps, done)
        steps += 1
    if grid is not None and source.grid is not None and session.own_voxels is not None:
        # Voxels across a border have seen samples of cells that learn.
        others = torch.ones_like(grid.occupied).view(-1).index_fill(0, session.own_voxels, False).view_as(grid.occupied)
        grid.density[others], grid.occupied[others] = source.grid.density[others], source.grid.occupied[others]
    learnt = [parameter for router in learners for parameter in router.parameters()]
    with averages_in_place(session.optimizer):
        averages = [parameter.data for parameter in learnt]
    for parameter, average in zip(learnt, averages, strict=True):
        parameter.data = average
    for router in learners:
        router.eval()
    return Update(session.source, changes, steps, clock() - began)


def split_off(parts: Parts, cells: Tensor) -> tuple[Parts, list[VoronoiRouter]]:
    """Gives cells, bool [k], networks of their own, which look the same.

    Returns:
        The parts, and the routers of these cells; the other routers are as they were, or parts of them.
    """
    made, learners = list[Part](), list[VoronoiRouter]()
    for part, first in zip(parts, parts.starts, strict=False):
        own = cells[first : first + part.num_cells].nonzero()[:, 0]
        of = part.owner[part.leaves[own]]
        for number in of.unique().tolist():
            mine = own[of == number]
            before = len(part.routers)
            part = part.split(mine)
            if len(part.routers) == before:  # all cells of a router
                routers = [copy.deepcopy(router) if i == number else router for i, router in enumerate(part)]
                part = part.changed(routers=routers)
                learners.append(part[number])
            else:
                learners.append(part[len(part.routers) - 1])
        made.append(part)
    return Parts(made, backend=parts.backend, blend=parts.blend), learners


def opened(grid: OccupancyGrid, parts: Parts, cells: Tensor) -> OccupancyGrid:
    """A grid in which all voxels of some cells, bool [k], may be occupied; the others are as they were."""
    again = OccupancyGrid.from_state(grid.state_dict(), contraction=grid.contraction, device=grid.box.device)
    rows = voxels_of(again, parts, cells)
    again.density.view(-1)[rows] = again.density.view(-1)[rows].maximum(torch.tensor(again.threshold / DECAY**8))
    again.occupied.view(-1)[rows] = True
    return again


def voxels_of(grid: OccupancyGrid, parts: Parts, cells: Tensor) -> Tensor:
    """The voxels of a grid whose middles lie in cells, bool [k]: int64 [q]."""
    every = torch.arange(grid.occupied.numel(), device=grid.box.device)
    owner = torch.cat([parts.assign(grid.points(rows)) for rows in every.split(1 << 17)]).long()
    return every[cells[owner.clamp(min=0)] & (owner >= 0)]


def bounds(source: Source, changes: Changes) -> Tensor | None:
    """A box [2, 3] around what is and what was seen in the cells that learn; None where that is not known."""
    grid = source.grid
    if grid is None:
        return None
    rows = voxels_of(grid, source.parts, changes.cells)
    middles = torch.cat((grid.points(rows[grid.occupied.view(-1)[rows]]), changes.voxels.centres()))
    fewest = [min(pair) for pair in zip(grid.occupied.shape, changes.voxels.chosen.shape, strict=True)]
    side = (grid.box[1] - grid.box[0]) / torch.tensor(fewest, device=middles.device)
    return torch.stack((middles.amin(0) - side, middles.amax(0) + side)) if len(middles) else None


@dataclass(frozen=True)
class Pool:
    """Rays that meet cells that learn, with what frozen cells show before and behind them.

    A ray's colour is ``before + light * (colour of the cells that learn, over behind)``: a step asks these cells alone.

    Attributes:
        rays: p rays.
        near: [p].
        far: [p].
        target: [p, 3], the colours to learn.
        before: [p, 3], the light that comes from before the first sample in the cells.
        light: [p, 1], the share of the light that passes there.
        behind: [p, 3], the colour behind the last sample in the cells, background included.
    """

    rays: Rays
    near: Tensor
    far: Tensor
    target: Tensor
    before: Tensor
    light: Tensor
    behind: Tensor

    def __len__(self) -> int:
        return len(self.rays)

    @staticmethod
    def joined(pools: Sequence[Pool]) -> Pool:
        """The rays of several pools."""
        rays = Rays(*(torch.cat([getattr(pool.rays, name) for pool in pools]) for name in ("origins", "directions")))
        names = ("near", "far", "target", "before", "light", "behind")
        return Pool(rays, *(torch.cat([getattr(pool, name) for pool in pools]) for name in names))


class Session:
    """The training of some routers of a run of parts, among others that are frozen.

    Attributes:
        source: What is trained.
        optimizer: Of the routers that learn.

    Args:
        source: Parts of which some routers learn, and the grid, which changes in their cells alone.
        learners: These routers.
        changes: What is known of the scene.
        seed: Of random numbers.
    """

    def __init__(self, source: Source, learners: list[VoronoiRouter], changes: Changes, seed: int) -> None:
        self.source, self.cells, self.config, self.parts = source, changes.cells, source.config, source.parts
        self.learners = learners
        if len(source.parts) == 1:
            part = source.parts[0]
            self.leaves = torch.zeros_like(part.owner, dtype=torch.bool)
            self.leaves[part.leaves] = changes.cells
        self.renderer = make_renderer(self.config, source.scene, {"field": source.parts}, occupancy=source.grid)
        self.generator = torch.Generator().manual_seed(seed)
        for router in learners:
            router.requires_grad_().train()
        dense, tables = grouped_parameters(learners)
        groups = [{"params": dense, "sparse": False}, {"params": tables, "sparse": True}]
        assert self.config.lr is not None
        given: dict[str, Any] = {"betas": (0.9, 0.99), "eps": 1e-15, "backend": self.config.backend}
        self.optimizer = Adam([group for group in groups if group["params"]], lr=self.config.lr, **given)
        voxels = changes.voxels
        self.contradicting = Voxels(voxels.box, near_by(voxels.chosen) > 0, voxels.contraction)
        self.own_voxels = None if source.grid is None else voxels_of(source.grid, source.parts, changes.cells)

    def learns(self, positions: Tensor) -> Tensor:
        """Which positions [n, 3] lie in cells that learn."""
        if len(self.parts) == 1:  # whose region is the scene
            leaf = self.parts[0].diagram.locate(self.own_points(positions), backend=self.parts.backend)
            return self.leaves.index_select(0, leaf)
        owner = self.parts.assign(positions).long()
        return self.cells[owner.clamp(min=0)] & (owner >= 0)

    def field(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """What the cells that learn say of positions in them: colours [n, 3] and densities [n]."""
        if len(self.parts) > 1 or len(self.learners) > 1:
            colour, density = self.parts(positions, directions, ray_index)
            return colour, density
        frame, ask = self.parts[0].frame, as_field(self.learners[0])
        if frame.is_identity:
            return ask(self.own_points(positions), directions, ray_index)
        colour, density = ask(self.own_points(positions), frame.inverse.directions(directions), ray_index)
        return colour, density / frame.scale

    def own_points(self, positions: Tensor) -> Tensor:
        """Positions [n, 3] as the networks of the only part see them."""
        part = self.parts[0]
        return part.contracted(positions if part.frame.is_identity else part.own_points(positions))

    @torch.no_grad()
    def pool(self, batches: RayBatches, count: int, *, agree: bool = False) -> Pool:
        """Those of so many rays that meet cells that learn, and through no other surface.

        Args:
            batches: Of pictures.
            count: Rays to draw.
            agree: Leave out rays through space that has changed.
        """
        batch = batches.draw(count, self.generator, random_background=self.config.background == "random")
        samples = self.renderer.sampler.sample(batch.rays, batch.near, batch.far)
        own = self.learns(samples.positions)
        index, device = samples.ray_index.long(), own.device
        meets = torch.zeros(len(batch.rays), dtype=torch.bool, device=device)
        meets[index[own]] = True
        rays = meets.nonzero()[:, 0]
        own, samples = own[meets[index]], samples.of_rays(rays)
        index, r = samples.ray_index.long(), len(rays)
        rgb, density = self.parts(samples.inputs, batch.rays.directions[rays], samples.ray_index)
        thick = density * samples.deltas  # optical depths
        total = thick.double().cumsum(0)
        starts = samples.ray_offsets[:-1].long()
        until = total - thick  # up to each sample, and of the rays before
        number = torch.arange(len(own), device=device)
        none = torch.full((r,), len(own), device=device)
        first = none.scatter_reduce(0, index[own], number[own], "amin")
        last = torch.zeros_like(none).scatter_reduce(0, index[own], number[own], "amax")
        taken = (1 - torch.exp(-thick))[:, None] * rgb
        ahead, past = number < first[index], number > last[index]

        def light(rows: Tensor, since: Tensor) -> Tensor:
            share = torch.exp(since[index[rows]] - until[rows]).float()[:, None]
            return rgb.new_zeros(r, 3).index_add(0, index[rows], share * taken[rows])

        before, behind = light(ahead, until[starts]), light(past, total[last])
        passes = torch.exp(until[starts] - until[first]).float()[:, None]
        ends = samples.ray_offsets[1:].long() - 1
        if batch.background is not None:
            background = batch.background[rays] if batch.background.dim() == 2 else batch.background
            behind = behind + torch.exp(total[last] - total[ends]).float()[:, None] * background
        between = thick.new_zeros(r).index_add(0, index[~own & ~ahead & ~past], thick[~own & ~ahead & ~past])
        good = (passes[:, 0] > LEAST_LIGHT) & (between < MOST_BETWEEN)
        if agree:
            # Up to where half of the light has gone.
            gone = total - until[starts][index] > math.log(2)
            stop = none.scatter_reduce(0, index[gone], number[gone], "amin")
            far = torch.where(stop < len(own), samples.depths[stop.clamp(max=len(own) - 1)], batch.far[rays])
            good &= ~self.contradicting.meet(batch.rays[rays], batch.near[rays], far)
        rays, before, passes, behind = rays[good], before[good], passes[good], behind[good]
        kept = batch.rays[rays]
        return Pool(kept, batch.near[rays], batch.far[rays], batch.target[rays], before, passes, behind)

    def step(self, pool: Pool, number: int, done: float) -> int:
        """Moves the networks of the cells that learn; returns the rays that they have learnt from.

        Args:
            pool: The rays to draw from.
            number: Of the step.
            done: The share of the update before it, 0..1.
        """
        config = self.config
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(config, done, number)
        self.revisit(number)
        chosen = torch.randint(len(pool), (config.rays * RAYS,), generator=self.generator).to(pool.near.device)
        rays, near, far = pool.rays[chosen], pool.near[chosen], pool.far[chosen]
        samples = self.renderer.sampler.sample(rays, near, far, jitter=True, generator=self.generator)
        samples = samples.part(self.learns(samples.positions))
        self.optimizer.zero_grad()
        shown = pool.target[chosen], pool.before[chosen], pool.light[chosen], pool.behind[chosen]
        density, weights = (self.learn_fused if self.is_fused else self.learn)(rays, far, samples, *shown)
        self.optimizer.step()
        if config.average:
            update_averages(self.optimizer, config.average, number)
        if self.source.grid is not None:
            found = samples.positions, density, samples.deltas, weights
            self.source.grid.observe(*found, decay=DECAY, backend=config.backend)
        return len(chosen)

    def learn(
        self, rays: Rays, far: Tensor, samples: Samples, target: Tensor, before: Tensor, light: Tensor, behind: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Gradients of the colours' error; density [m] and weights [m] of the samples. Arguments as of `Pool`."""
        space, backend = self.renderer.sampler.space, self.config.backend
        seen = render_samples(self.field, rays, far, samples, space, background=behind, backend=backend)
        colour_loss(before + light * seen.colour, target).backward()
        return seen.density.detach(), seen.weights.detach()

    @property
    def is_fused(self) -> bool:
        """Whether networks, colours, loss and gradients are one operation, as in `voronerf.step.ray_loss.Fused`."""
        router = self.learners[0]
        known = getattr(type(router.module), "activate", None) is activate_radiance and router.by_table
        return known and len(self.parts) == len(self.learners) == 1

    def learn_fused(
        self, rays: Rays, far: Tensor, samples: Samples, target: Tensor, before: Tensor, light: Tensor, behind: Tensor
    ) -> tuple[Tensor, Tensor]:
        """As :meth:`learn`, for one router with a layer table."""
        router, frame, found = self.learners[0], self.parts[0].frame, list[RenderLoss]()
        wanted, factor = (target - before) / light, light.square().index_select(0, samples.ray_index)

        def loss(raw: Tensor) -> tuple[Tensor, Tensor]:
            result, gradient = render_loss_gradient(
                raw,
                samples.deltas / frame.scale,
                samples.ray_offsets,
                wanted,
                background=behind,
                density_scale=density_scale(router),
                hidden=HIDDEN,
                backend=self.config.backend,
            )
            found.append(result)
            return result.loss, gradient * factor

        directions = rays.directions if frame.is_identity else frame.inverse.directions(rays.directions)
        network = router.table_arguments(self.own_points(samples.positions), directions, samples.ray_index)
        assert network is not None
        learn_outputs(network, loss, backend=self.config.backend).backward()
        return found[0].density / frame.scale, found[0].weights

    def revisit(self, number: int) -> None:
        """Before some steps, evaluates the field in random voxels of cells that learn."""
        grid, own = self.source.grid, self.own_voxels
        if grid is None or own is None or number % REVISIT_EVERY or not len(own):
            return
        count = math.ceil(len(own) * REVISITED)
        chosen = own[torch.randint(len(own), (count,), generator=self.generator).to(own.device)]
        grid.update(self.parts, chosen, decay=1.0, generator=self.generator, backend=self.config.backend)
