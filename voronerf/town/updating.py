"""A run brought up to date with new pictures: cells whose error has grown learn, all others keep their bits.

r rays, k cells.
"""

from __future__ import annotations

import copy
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from voronerf.app.scenes import Scene
from voronerf.app.train.batches import RayBatches
from voronerf.app.train.checkpoint import Checkpoint
from voronerf.app.train.config import ConfigError
from voronerf.app.train.networks import SHRINK_EVERY, TABLE_DECAY
from voronerf.app.train.rates import learning_rate, next_rays
from voronerf.app.train.renderers import make_contraction, make_renderer
from voronerf.app.train.state import stored_values
from voronerf.app.train.trainer import Trainer
from voronerf.diagram import balance
from voronerf.nerf.adam import Adam
from voronerf.nerf.average import averages_in_place, update_averages
from voronerf.nerf.cameras import Rays
from voronerf.nerf.cells import DECAY, MOST_REVISITED, REVISIT_EVERY, REVISITED
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.occupancy import HIDDEN, OccupancyGrid
from voronerf.nerf.ray_loss import Networks, why_not_fused
from voronerf.nerf.sampling import colour_loss
from voronerf.nerf.volume import Samples, gradient_shares, render_samples
from voronerf.ops.render_loss import render_loss_gradient
from voronerf.router import VoronoiRouter
from voronerf.town.changes import (
    LEAST_MET,
    MOST_OFF,
    Changes,
    Voxels,
    find_changes,
    near_by,
    space_voxels,
)
from voronerf.town.editing import Source, new_folder
from voronerf.town.errors import usual_errors
from voronerf.town.parts import Asked, Part, Parts
from voronerf.town.run_parts import grouped_parameters

#: Rays that are drawn at a time to find those that meet cells that learn, how many of these there are to be, and the
#: share of an update that is spent on it before the first step at most, and the share that is left for steps at least.
DRAWN, POOL, FINDING, LEARNING = 1 << 15, 1 << 17, 0.4, 0.25
#: How often a ray is learnt from before others are found, and in how many searches old pictures take part once where
#: there are as many new ones: few of their rays are left in the end. Where there are fewer, more often.
AGAIN, OLD_EVERY = 2, 8
#: The share of a step's rays that are drawn by their errors, more often the larger the root of the squared error.
BY_ERROR = 0.5
#: The weight decay of tables, of that of a training: what is left of the old scene has fewer steps to go in.
FORGET = 5.0
#: Rays learn if this share of the light reaches the cells that learn; they end where, behind the first of these, others
#: of more than that optical depth begin, unless this share of the light reaches cells that learn behind them.
LEAST_LIGHT, MOST_BETWEEN = 0.05, 0.05
#: A cell whose space has changed in part is divided into at most so many cells for what has changed, and for what has
#: not; each has so many places.
CHILDREN, PLACES = 8, 8


@dataclass(frozen=True)
class Update:
    """What an update did.

    Attributes:
        source: The run that it makes.
        cells: bool [k], those of its cells that learnt.
        changes: What the new pictures showed.
        steps: Steps of training.
        seconds: Of training, finding the changes included.
    """

    source: Source
    cells: Tensor
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
    began = clock()
    contraction = next((part.contraction for part in source.parts if part.contraction is not None), None)
    if contraction is None and source.scene.box is None:
        contraction = cast(Contraction, make_contraction(source.scene))
    box = cast(Tensor, source.scene.box) if contraction is None else contraction.cube
    # Rays are drawn from all pixels; those that miss the box show the background.
    pictures = list[RayBatches]()
    for scene in (new, old):
        if scene is not None:
            pictures.append(RayBatches(replace(scene, box=None), device, backend=source.config.backend))
            pictures[-1].box = scene.box
    generator = torch.Generator().manual_seed(seed)
    changes, k = compare(source, usual, space_voxels(box, contraction), *pictures), source.parts.num_cells
    voxels, count = changes.voxels, int((changes.worse | changes.rebuilt).sum())
    say(f"{changes.off:.1%} of the new rays that meet the scene are off: {count} of {k} cells learn")
    if not count:
        raise ConfigError(
            f"--data shows nothing new: {changes.off:.1%} of the rays that meet the scene are off, as in training"
        )
    divided, cells = divide(source, changes, generator)
    if divided.num_cells > k:
        say(f"these are divided, so that what has not changed in them stays: {int(cells.sum())} smaller ones learn")
    parts, learners = split_off(divided, cells)
    grid, own = source.grid, torch.empty(0, dtype=torch.int64)
    if grid is not None:
        own = voxels_of(grid, parts, cells)
        own = own[may_fill(source, own, changes)]
        grid = opened(grid, own)
    session = Session(replace(source, parts=parts, grid=grid), source.parts, cells, learners, own, voxels, generator)
    count = DRAWN if grid is not None else DRAWN // 4  # of rays that skip nothing
    rays, searches = [0, 0], itertools.count()
    seldom = max(1, round(OLD_EVERY * min(1.0, len(pictures[0]) / len(pictures[-1]))))

    def more(known: Sequence[Pool]) -> Pool:
        """Rays to learn from: those that are known and others, the last `POOL` of them."""
        search = next(searches)
        for number, batches in enumerate(pictures):
            if not number or search % seldom == 0:
                known = [*known, session.pool(batches, count >> number, agree=number > 0)]
                rays[number] += len(known[-1])
        return Pool.joined(known, POOL)

    pool = more([])
    while clock() - began < FINDING * seconds and len(pool) < POOL:
        pool = more([pool])
    say(f"learning from {rays[0]} rays of the new pictures and {rays[1]} of the old ones")
    if not rays[0]:
        raise ConfigError("--data must show the cells that have changed, got pictures that see them through others")
    steps, drawn, started = 0, 0, clock() - began
    left = max(seconds - started, LEARNING * seconds)
    while (done := (clock() - began - started) / left) < 1:
        if drawn > AGAIN * len(pool):
            pool, drawn = more([pool]), 0
        drawn += session.step(pool, steps, done)
        steps += 1
    session.keep_grid()
    learnt = [parameter for router in learners for parameter in router.parameters()]
    with averages_in_place(session.optimizer):
        averages = [parameter.data for parameter in learnt]
    for parameter, average in zip(learnt, averages, strict=True):
        parameter.data = average
    for router in learners:
        router.eval()
    return Update(session.source, cells, changes, steps, clock() - began)


def train_on(
    checkpoint: Checkpoint,
    scene: Scene,
    out: Path,
    *,
    seconds: float,
    data: str | None = None,
    seed: int = 0,
    clock: Callable[[], float] = time.perf_counter,
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Goes on with a training on other pictures of its scene, in a new run directory, whole or not at all.

    The learning rate begins anew: where it went on from its fall, fox had 0.4 dB less of the pictures that came later.
    What the first pictures showed to be empty is opened: else fox at 270 x 480 had 0.3 and 0.7 dB less, though none at
    1080 x 1920.

    Args:
        checkpoint: The last one of the run.
        scene: The pictures, in the space of the run (`placed`).
        out: A new directory.
        seconds: To train for.
        data: Where the pictures were loaded from; None for where those of the run were.
        seed: Of the rays that are drawn.
        clock: Counts seconds.
        say: Told a line for an event.

    Raises:
        ConfigError: For a run of several territories.
        OSError: When it cannot be written; nothing is left then.
    """
    config, _ = stored_values(checkpoint)
    if (config.territories or 1) > 1:
        raise ConfigError(f"--more needs a run of one territory, got {config.territories}")
    config = replace(
        config,
        data=data or config.data,
        budget=seconds,
        steps=None,
        evaluations=1,
        evaluation_share=0.0,
        refine_cameras=False,  # those of the scene are as the run has moved them
        resume=False,
    )
    with new_folder(out) as partial:
        trainer = Trainer(replace(config, out=partial), scene, on_event=say, clock=clock, checkpoint=checkpoint)
        trainer.config = replace(trainer.config, out=out)
        trainer.seconds = 0.0  # of this training
        trainer.draws.manual_seed(seed)
        if trainer.occupancy is not None:
            open_voxels(trainer.occupancy, torch.arange(trainer.occupancy.occupied.numel()))
        trainer.train()


def compare(
    source: Source, usual: Tensor | None, space: Voxels, new: RayBatches, old: RayBatches | None = None
) -> Changes:
    """What new pictures show; takes what :func:`update` and :func:`find_changes` take.

    Raises:
        ConfigError: For pictures that show nothing of the scene, or another one.
    """
    renderer = make_renderer(source.config, source.scene, {"field": source.parts}, occupancy=source.grid)
    if usual is None:
        if old is None:
            raise ConfigError(
                "the run keeps no errors to compare with, as those that were joined, cut, placed or updated: its old "
                "pictures are needed, so leave out --no-use-old"
            )
        usual = usual_errors(renderer, source.parts, old)
    changes = find_changes(renderer, source.parts, new, usual, space, old)
    if changes.met < LEAST_MET:
        raise ConfigError(f"--data must show the scene of the run, {changes.met:.2%} of its rays meet it")
    if changes.off > MOST_OFF:
        raise ConfigError(
            f"--data shows another scene, or this one in another frame: {changes.off:.0%} of what it shows differs; "
            "--more takes it for more pictures of the same"
        )
    return changes


def divide(source: Source, changes: Changes, generator: torch.Generator) -> tuple[Parts, Tensor]:
    """Divides the cells whose space has changed in part, into some for what has changed and some for what has not.

    Returns:
        The parts, which look the same, and which of their cells are to learn, bool [k].
    """
    parts, voxels, grid = source.parts, changes.voxels, source.grid
    moved, still = voxels.centres(), replace(voxels, chosen=~voxels.chosen).centres()
    if grid is not None:  # what is empty needs no cell
        still = grid.points(grid.occupied.view(-1).nonzero()[:, 0])
        still = still[~voxels.has(still)]
    owners = [(places, parts.assign(places).long()) for places in (moved, still)]
    made, parents = list[Part](), list[Tensor]()
    for part, first in zip(parts, parts.starts, strict=False):
        children: dict[int, Tensor] = {}
        for cell in changes.rebuilt[first : first + part.num_cells].nonzero()[:, 0].tolist():
            centres = []
            for places, owner in owners:
                own = part.contracted(part.own_points(places[owner == first + cell]))
                if count := min(CHILDREN, len(own) // PLACES):
                    found = balance(own, own.new_ones(len(own)), count, method="centroidal", generator=generator)
                    centres.append(found.centres.to(own))
            if len(centres) > 1:
                children[cell] = torch.cat(centres)
        part, of = part.divide(children)
        made.append(part)
        parents.append(of + first)
    divided, of = Parts(made, backend=parts.backend), torch.cat(parents)
    owner = divided.assign(moved).long()
    changed = owner[owner >= 0].bincount(minlength=len(of)) > 0
    return divided, changes.worse[of] | (changes.rebuilt[of] & changed)


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
    return Parts(made, backend=parts.backend), learners


def opened(grid: OccupancyGrid, rows: Tensor) -> OccupancyGrid:
    """A grid in which some voxels, int64 [q], may be occupied; the others are as they were."""
    again = type(grid).from_state(grid.state_dict(), contraction=grid.contraction, device=grid.box.device)
    open_voxels(again, rows)
    return again


def open_voxels(grid: OccupancyGrid, rows: Tensor) -> None:
    """Lets some voxels, int64 [q], be occupied until steps have found them empty."""
    grid.density.view(-1)[rows] = grid.density.view(-1)[rows].clamp(min=grid.threshold / DECAY**8)
    grid.occupied.view(-1)[rows] = True


def may_fill(source: Source, rows: Tensor, changes: Changes) -> Tensor:
    """Which voxels of the grid of a run, int64 [q], may be occupied after an update, bool [q].

    Those that are, those in and around space that has changed, and all of cells that learn whole. Samples in all space
    of cells that learn were most of those of the first steps, and left fog.
    """
    grid, voxels = source.grid, changes.voxels
    assert grid is not None
    points = grid.points(rows)
    near = replace(voxels, chosen=near_by(voxels.chosen) > 0).has(points)
    owner = source.parts.assign(points).long()
    return grid.occupied.view(-1)[rows] | near | (changes.worse[owner.clamp(min=0)] & (owner >= 0))


def around(grid: OccupancyGrid, rows: Tensor) -> OccupancyGrid:
    """A grid in which only some voxels, int64 [q], and those that touch them are occupied, where they were before."""
    again = type(grid).from_state(grid.state_dict(), contraction=grid.contraction, device=grid.box.device)
    chosen = torch.zeros_like(grid.occupied)
    chosen.view(-1)[rows] = True
    again.occupied &= near_by(chosen) > 0
    return again


def voxels_of(grid: OccupancyGrid, parts: Parts, cells: Tensor) -> Tensor:
    """The voxels of a grid whose middles lie in cells, bool [k]: int64 [q]."""
    every = torch.arange(grid.occupied.numel(), device=grid.box.device)
    owner = torch.cat([parts.assign(grid.points(rows)) for rows in every.split(1 << 17)]).long()
    return every[cells[owner.clamp(min=0)] & (owner >= 0)]


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
        end: [p], the depth from which cells that learn are hidden by others, or infinity.
        error: [p], the squared errors when the rays were last learnt from, 0 where they met no sample; 1 before.
    """

    rays: Rays
    near: Tensor
    far: Tensor
    target: Tensor
    before: Tensor
    light: Tensor
    behind: Tensor
    end: Tensor
    error: Tensor

    def __len__(self) -> int:
        return len(self.rays)

    @staticmethod
    def joined(pools: Sequence[Pool], most: int) -> Pool:
        """The rays of several pools, the last of them if there are more than ``most``."""

        def last(values: Sequence[Tensor]) -> Tensor:
            return torch.cat([*values])[-most:]

        rays = Rays(*(last([getattr(pool.rays, name) for pool in pools]) for name in ("origins", "directions")))
        names = [field.name for field in fields(Pool)][1:]
        return Pool(rays, *(last([getattr(pool, name) for pool in pools]) for name in names))

    def part(self, rows: Tensor) -> Pool:
        """Some of the rays, int64 [r]."""
        rays = Rays(self.rays.origins.index_select(0, rows), self.rays.directions.index_select(0, rows))
        names = [field.name for field in fields(Pool)][1:]
        return Pool(rays, *(getattr(self, name).index_select(0, rows) for name in names))

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """The numbers int64 [count] of rays for a step: some by chance, the others by their errors."""
        chosen = torch.randint(len(self), (count,), generator=generator)
        sums, several = self.error.sqrt().cumsum(0).cpu(), int(BY_ERROR * count)
        chosen[:several] = torch.searchsorted(sums, sums[-1] * torch.rand(several, generator=generator))
        return chosen.clamp(max=len(self) - 1).to(self.near.device)


class Session:
    """The training of some routers of a run of parts, among others that are frozen.

    Attributes:
        source: What is trained.
        optimizer: Of the routers that learn.

    Args:
        source: Parts of which some routers learn, and the grid, which changes in their cells alone.
        before: The parts before they were divided and began to learn.
        cells: bool [k], those that learn.
        learners: Their routers.
        own: int64 [q], the voxels of the grid in these cells that may be occupied.
        changed: The space that has changed.
        generator: Of random numbers.
    """

    def __init__(
        self,
        source: Source,
        before: Parts,
        cells: Tensor,
        learners: list[VoronoiRouter],
        own: Tensor,
        changed: Voxels,
        generator: torch.Generator,
    ) -> None:
        self.source, self.before, self.cells, self.learners, self.own_voxels = source, before, cells, learners, own
        self.config, self.parts, self.generator = source.config, source.parts, generator
        if len(source.parts) == 1:
            part = source.parts[0]
            self.leaves = torch.zeros_like(part.owner, dtype=torch.bool)
            self.leaves[part.leaves] = cells
        field = {"field": source.parts}
        self.renderer = make_renderer(self.config, source.scene, field, occupancy=source.grid)
        # Steps take samples near cells that learn alone; the grid of the source says where others are.
        self.grid = None if source.grid is None else around(source.grid, own)
        self.learning = make_renderer(self.config, source.scene, field, occupancy=self.grid)
        self.rays = self.config.rays
        for router in learners:
            router.requires_grad_().train()
        dense, tables = grouped_parameters(learners)
        groups = [
            {"params": dense, "sparse": False},
            {"params": tables, "sparse": True, "shrink": TABLE_DECAY * FORGET},
        ]
        assert self.config.lr is not None
        given: dict[str, Any] = {"betas": (0.9, 0.99), "eps": 1e-15, "backend": self.config.backend}
        self.optimizer = Adam([group for group in groups if group["params"]], lr=self.config.lr, **given)
        self.contradicting = replace(changed, chosen=near_by(changed.chosen) > 0)
        self.is_fused = why_not_fused(self.renderer) is None

    def learns(self, positions: Tensor) -> Tensor:
        """Which positions [n, 3] lie in cells that learn."""
        if len(self.parts) == 1:  # whose region is the scene
            part = self.parts[0]
            leaf = part.diagram.locate(part.contracted(part.own_points(positions)), backend=self.parts.backend)
            return self.leaves.index_select(0, leaf)
        owner = self.parts.assign(positions).long()
        return self.cells[owner.clamp(min=0)] & (owner >= 0)

    def asked(self, samples: Samples, directions: Tensor) -> list[Asked]:
        """Which routers are asked about samples in cells that learn."""
        if len(self.parts) > 1 or len(self.learners) > 1:
            return self.parts.asked(samples.positions, directions, samples.ray_index)
        part = self.parts[0]
        points, directions = (
            part.contracted(part.own_points(samples.positions)),
            part.frame.inverse.directions(directions),
        )
        return [Asked(self.learners[0], None, points, directions, samples.ray_index, part.frame.scale)]

    @torch.no_grad()
    def pool(self, batches: RayBatches, count: int, *, agree: bool = False) -> Pool:
        """Those of so many rays that meet cells that learn, and through no other surface.

        Args:
            batches: Of pictures.
            count: Rays to draw.
            agree: Leave out rays through space that has changed.
        """
        batch = batches.draw(count, self.generator, random_background=self.config.background == "random")
        samples = self.learning.sampler.sample(batch.rays, batch.near, batch.far)
        own, device = self.learns(samples.positions), samples.positions.device
        meets = torch.zeros(len(batch.rays), dtype=torch.bool, device=device)
        meets[samples.ray_index.long()[own]] = True
        rays = meets.nonzero()[:, 0]
        self.keep_grid()
        samples = self.renderer.sampler.sample(batch.rays[rays], batch.near[rays], batch.far[rays])
        own = self.learns(samples.positions)
        index, r, number = samples.ray_index.long(), len(rays), torch.arange(len(own), device=device)
        starts, ends = samples.ray_offsets[:-1].long(), samples.ray_offsets[1:].long() - 1
        rgb, density = samples.inputs.new_zeros(len(own), 3), samples.deltas.new_zeros(len(own))

        def ask(which: Tensor) -> None:
            chosen = which.nonzero()[:, 0]
            given = samples.inputs[chosen], batch.rays.directions[rays], samples.ray_index[chosen]
            rgb[chosen], density[chosen] = self.before(*given)

        none = torch.full((r,), len(own), device=device)
        first = none.scatter_reduce(0, index[own], number[own], "amin")
        ahead = number < first[index]
        if agree:  # what cells that learn showed before they did says where rays of old pictures end, and nothing else
            ask(torch.ones_like(own))
        else:
            ask(ahead)
            dark = samples.deltas.new_zeros(r).index_add(0, index, density * samples.deltas)
            ask(~own & ~ahead & (dark < -math.log(LEAST_LIGHT))[index])
        thick = (density * samples.deltas).double()  # optical depths
        frozen = thick.masked_fill(own, 0)
        total = frozen.cumsum(0)
        until = total - frozen  # up to each sample, and of the rays before
        since = until - until[first][index]
        hides = (number > first[index]) & (since + frozen > MOST_BETWEEN)
        cut = none.scatter_reduce(0, index[hides], number[hides], "amin")
        learns, hidden = own & (number < cut[index]), own & (number > cut[index])
        last = torch.zeros_like(none).scatter_reduce(0, index[learns], number[learns], "amax")
        taken = (-torch.expm1(-frozen)).float()[:, None] * rgb

        def light(rows: Tensor, since: Tensor) -> Tensor:
            share = torch.exp(since[index[rows]] - until[rows]).float()[:, None]
            return rgb.new_zeros(r, 3).index_add(0, index[rows], share * taken[rows])

        before, behind = light(ahead, until[starts]), light(number > last[index], total[last])
        passes = torch.exp(until[starts] - until[first]).float()[:, None]
        if batch.background is not None:
            background = batch.background[rays] if batch.background.dim() == 2 else batch.background
            behind = behind + torch.exp(total[last] - total[ends]).float()[:, None] * background
        good = passes[:, 0] > LEAST_LIGHT
        good[index[hidden & (since < -math.log(LEAST_LIGHT))]] = False
        depths = torch.nn.functional.pad(samples.depths, (0, 1), value=math.inf)
        if agree:
            # Up to where half of the light has gone.
            whole = thick.cumsum(0)
            gone = whole - (whole - thick)[starts][index] > math.log(2)
            stop = depths[none.scatter_reduce(0, index[gone], number[gone], "amin")]
            far = torch.minimum(stop, batch.far[rays])
            good &= ~self.contradicting.meet(batch.rays[rays], batch.near[rays], far)
        rows, rays = good.nonzero()[:, 0], rays[good]
        found = before[rows], passes[rows], behind[rows], depths[cut[rows]], passes.new_ones(len(rows))
        return Pool(batch.rays[rays], batch.near[rays], batch.far[rays], batch.target[rays], *found)

    def keep_grid(self) -> None:
        """Tells the grid of the source what steps have found in the voxels of cells that learn."""
        if self.grid is not None and self.source.grid is not None:
            own, kept = self.own_voxels, self.source.grid
            kept.density.view(-1)[own] = self.grid.density.view(-1)[own]
            kept.occupied.view(-1)[own] = self.grid.occupied.view(-1)[own]

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
        chosen = pool.draw(self.rays, self.generator)
        drawn = pool.part(chosen)
        rays, far = drawn.rays, drawn.far
        samples = self.learning.sampler.sample(rays, drawn.near, far, jitter=True, generator=self.generator)
        shown = samples.depths < drawn.end.index_select(0, samples.ray_index)
        samples = samples.part(shown & self.learns(samples.positions))
        self.optimizer.zero_grad()
        seen = drawn.target, drawn.before, drawn.light, drawn.behind
        density, weights, error = (self.learn_fused if self.is_fused else self.learn)(rays, far, samples, *seen)
        pool.error[chosen] = error.masked_fill(samples.ray_offsets.diff() == 0, 0)
        self.optimizer.step()
        if number % SHRINK_EVERY == 0:
            self.optimizer.shrink(SHRINK_EVERY)
        if config.average:
            update_averages(self.optimizer, config.average, number)
        if self.grid is not None:
            found = samples.positions, density, samples.deltas, weights
            self.grid.observe(*found, decay=DECAY, backend=config.backend)
            self.rays = next_rays(config, self.rays, len(samples.deltas))
        return len(chosen)

    def learn(
        self, rays: Rays, far: Tensor, samples: Samples, target: Tensor, before: Tensor, light: Tensor, behind: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients of the colours' errors; density [m] and weights [m] of the samples, and the squared errors [r].

        Arguments as of `Pool`.
        """
        space, backend = self.renderer.sampler.space, self.config.backend
        seen = render_samples(self.parts, rays, far, samples, space, background=behind, backend=backend)
        colour = before + light * seen.colour
        colour_loss(colour, target).backward()
        return seen.density.detach(), seen.weights.detach(), (colour.detach() - target).square().sum(-1)

    def learn_fused(
        self, rays: Rays, far: Tensor, samples: Samples, target: Tensor, before: Tensor, light: Tensor, behind: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`learn`, in one operation, see `voronerf.nerf.ray_loss.Fused`."""
        networks, backend = Networks(self.asked(samples, rays.directions), samples), self.config.backend
        wanted, factor = (target - before) / light, light.square().index_select(0, samples.ray_index)
        shares = gradient_shares(self.learning.sampler.space.full_gradient, samples.depths)
        factor = factor if shares is None else factor * shares[:, None]
        found, gradient = render_loss_gradient(
            networks.evaluate(backend),
            networks.deltas,
            samples.ray_offsets,
            wanted,
            background=behind,
            density_scale=networks.density_scale,
            hidden=HIDDEN,
            backend=backend,
        )
        networks.learn(found.loss, gradient * factor, backward=True)
        return networks.density(found), found.weights, found.error * light[:, 0].square()

    def revisit(self, number: int) -> None:
        """Before some steps, evaluates the field in random voxels of cells that learn."""
        grid, own = self.grid, self.own_voxels
        if grid is None or number % REVISIT_EVERY or not len(own):
            return
        count = min(math.ceil(len(own) * REVISITED), MOST_REVISITED)
        chosen = own[torch.randint(len(own), (count,), generator=self.generator).to(own.device)]
        grid.update(self.parts, chosen, decay=1.0, generator=self.generator, backend=self.config.backend)
